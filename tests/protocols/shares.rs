//! A host that begins many conversations.

use fipa::protocol::{DialogueError, Reply, Task};
use fipa::{Agent, Domain, Gateway, Kind, Message, Performative};
use fipa_testbed::until_async;

use super::{TIMEOUT, support, to};

/// More conversations than one host has places for.
const MANY: usize = 1_100;

/// Starts two hosts that know each other, with an agent each.
async fn two_hosts(listen: &str) -> [(Gateway, Domain, Agent); 2] {
    let listen = format!("transport.tcp.listen=[\"{listen}\"]");
    let set = ["mts.deadline=60s", "mts.queue=4000", &listen];
    let open = async |set: &[&str], name| {
        let config = support::config(set);
        let gateway = Gateway::open(&config).await.unwrap();
        let domain = Domain::open(&config).await.unwrap();
        let agent = domain.register(name).await.unwrap();
        (gateway, domain, agent)
    };
    let near = open(&set, "arm").await;
    let locations = near.0.locations();
    let at = locations.iter().find(|it| it.kind() == Kind::Tcp).unwrap();
    let peer = format!("discovery.static={{ near = [\"tcp://{}\"] }}", at.address());
    let far = open(&[&set[..], &[&peer]].concat(), "greedy").await;
    for (domain, other) in [(&near.1, "greedy"), (&far.1, "arm")] {
        until_async(other, || domain.directory().lookup(other).is_some()).await;
    }
    [near, far]
}

/// Sends messages that begin many conversations.
async fn flood(greedy: &Agent, arm: &Agent) {
    let mut sent = tokio::task::JoinSet::new();
    for number in 0..MANY {
        let message: Message = to(greedy, Performative::Request, arm, "lift")
            .protocol("fipa-request")
            .conversation_id(format!("lift-{number}"))
            .build()
            .unwrap();
        let greedy = greedy.clone();
        sent.spawn(async move { greedy.send(message).await.unwrap() });
        // No more than fit a queue.
        while sent.len() >= 32 || (number + 1 == MANY && !sent.is_empty()) {
            let sent = sent.join_next().await.unwrap().unwrap();
            assert!(sent.all_succeeded(), "{sent:?}");
        }
    }
}

async fn a_host_with_many_conversations_leaves_places_for_others(listen: &str) {
    let [(_near, domain, arm), (_far, _, greedy)] = two_hosts(listen).await;
    let rover = domain.register("rover").await.unwrap();
    let handler = async |mut task: Task| {
        task.agree("").await?;
        std::future::pending::<Result<Reply, DialogueError>>().await
    };
    let server = arm.serve("fipa-request", handler).unwrap();
    flood(&greedy, &arm).await;
    until_async("the places of one host are taken", || {
        server.running() >= 1_024
    })
    .await;
    let lift = to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    assert!(request.agreed().await.unwrap());
    assert_eq!(server.running(), 1_025);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_host_with_many_conversations_leaves_places_for_others_over_ipv4() {
    a_host_with_many_conversations_leaves_places_for_others("127.0.0.1:0").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_host_with_many_conversations_leaves_places_for_others_over_ipv6() {
    a_host_with_many_conversations_leaves_places_for_others("[::1]:0").await;
}
