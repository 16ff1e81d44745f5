//! Gateways that know each other from their configuration, without discovery.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[path = "support/stranger.rs"]
mod stranger;
mod support;

use std::sync::Arc;
use std::time::Duration;

use fipa::admin::{contact, routes};
use fipa::{AgentId, Domain, Gateway, Kind, Letter, Message, Neighbor, Outcome, Performative};
use fipa_testbed::until_async;
use stranger::Stranger;
use support::config;
use tokio::io::AsyncReadExt;

fn address(gateway: &Gateway) -> String {
    let mut locations = gateway.locations().into_iter();
    let location = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
    location.address().to_owned()
}

fn knowing(name: &str, addresses: &[&str]) -> String {
    let addresses: Vec<String> = addresses.iter().map(|a| format!("\"tcp://{a}\"")).collect();
    format!(
        "discovery.static={{ \"{name}\" = [{}] }}",
        addresses.join(", ")
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn a_static_peer_is_connected_before_any_letter_and_again_after_its_restart() {
    let far_config = config(&[]);
    let far = Gateway::open(&far_config).await.unwrap();
    let at = address(&far);
    // No process listens on the first address.
    let near = config(&[&knowing("far", &["127.0.0.1:9", &at])]);
    let near = Gateway::open(&near).await.unwrap();
    let far_is = |neighbors: Vec<Neighbor>, incarnation| {
        let mut all = neighbors.into_iter();
        all.any(|it| it.entry.incarnation == incarnation && it.peer.as_deref() == Some("far"))
    };
    let first_incarnation = far.incarnation();
    until_async("the far gateway is a neighbor", || {
        far_is(near.neighbors(), first_incarnation)
    })
    .await;
    // It accepts gateways that are not in its configuration.
    until_async("the near gateway is a neighbor", || {
        let mut all = far.neighbors().into_iter();
        all.any(|it| it.entry.incarnation == near.incarnation())
    })
    .await;
    far.close().await;
    until_async("the connection has ended", || near.neighbors().is_empty()).await;
    let mut again = far_config.clone();
    again.transport.tcp.listen = vec![at];
    let far = Gateway::open(&again).await.unwrap();
    let second_incarnation = far.incarnation();
    assert_ne!(first_incarnation, second_incarnation);
    until_async("its next incarnation is a neighbor", || {
        far_is(near.neighbors(), second_incarnation)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_gateway_answers_an_unknown_ontology_with_not_understood() {
    let config = config(&[]);
    let gateway = Gateway::open(&config).await.unwrap();
    let domain = Domain::open(&config).await.unwrap();
    let rover = domain.register("rover").await.unwrap();
    let request = rover
        .message(Performative::Request)
        .receiver(AgentId::new(gateway.name()).unwrap())
        .ontology("tea")
        .reply_with("1")
        .content("make some")
        .build()
        .unwrap();
    assert!(rover.send(request).await.unwrap().all_succeeded());
    let answer = rover.receive().await.unwrap().into_message();
    assert_eq!(*answer.performative(), Performative::NotUnderstood);
    assert_eq!(answer.in_reply_to(), Some("1"));
    assert_eq!(answer.sender().unwrap().name(), gateway.name());
}

/// Routes contain the incarnations of agents and gateways, and an introduced agent takes a name.
#[tokio::test(flavor = "multi_thread")]
async fn another_host_gets_no_routes_and_introduces_no_agents() {
    let config = config(&[]);
    let gateway = Gateway::open(&config).await.unwrap();
    let domain = Domain::open(&config).await.unwrap();
    let arm = domain.register("arm").await.unwrap();
    let mut stranger = Stranger::new("stranger-mts", &gateway);
    let stolen = br#"{"version":1,"name":"thief","addresses":["tcp://127.0.0.1:9;fipa-services"]}"#;
    for (ontology, content) in [(routes::ONTOLOGY, &b""[..]), (contact::ONTOLOGY, stolen)] {
        let request = Message::builder(Performative::Request).ontology(ontology);
        stranger.send(request.reply_with(ontology).content(content));
        until_async("the answer", || stranger.reply_to(ontology).is_some()).await;
        let answer = stranger.reply_to(ontology).unwrap();
        assert_eq!(*answer.performative(), Performative::Refuse, "{answer}");
        let content = answer.content().unwrap();
        let told = String::from_utf8(content.to_vec()).unwrap();
        assert!(told.contains("agents of the gateway's host"), "{told}");
        let secret = arm.incarnation().to_string();
        assert!(!answer.to_string().contains(&secret), "{answer}");
    }
    assert!(gateway.directory().known("thief").is_none());
    domain.close().await;
    gateway.close().await;
}

/// Returns the entry of an agent of another host in the directory of a process.
fn seen(domain: &Domain, name: &str) -> Option<Arc<fipa::Entry>> {
    let found = domain.directory().known(name)?;
    matches!(found.reach, fipa::Reach::Remote { .. }).then_some(found)
}

#[tokio::test(flavor = "multi_thread")]
async fn gateways_exchange_their_agents_if_one_is_a_static_peer_of_the_other() {
    let far_config = config(&[]);
    let far = Gateway::open(&far_config).await.unwrap();
    let far_host = Domain::open(&far_config).await.unwrap();
    let arm = far_host.register("arm").await.unwrap();
    // Only one of them knows the other's address.
    let near_config = config(&[&knowing("far", &[&address(&far)])]);
    let near = Gateway::open(&near_config).await.unwrap();
    let near_host = Domain::open(&near_config).await.unwrap();
    let rover = near_host.register("rover").await.unwrap();

    until_async("the arm is known", || seen(&near_host, "arm").is_some()).await;
    until_async("the rover is known", || seen(&far_host, "rover").is_some()).await;
    let entry = near.directory().known("arm").unwrap();
    assert_eq!(entry.source, fipa::Source::Exchange);
    assert_eq!(entry.mts.incarnation, far.incarnation());
    // Both agents can send the first letter.
    for (from, to) in [(&rover, &arm), (&arm, &rover)] {
        let message = from
            .message(Performative::Inform)
            .receiver(AgentId::new(to.name()).unwrap())
            .content("hello")
            .build()
            .unwrap();
        assert!(from.send(message).await.unwrap().all_succeeded());
        let received = to.receive().await.unwrap().into_message();
        assert_eq!(received.content().unwrap().as_ref(), b"hello");
    }

    // Changes are exchanged.
    let leg = far_host.register("leg").await.unwrap();
    until_async("the leg is known", || seen(&near_host, "leg").is_some()).await;
    drop(leg);
    until_async("the leg is gone", || seen(&near_host, "leg").is_none()).await;
    // The entries are removed with their gateway.
    far.close().await;
    until_async("the arm is gone", || seen(&near_host, "arm").is_none()).await;
    assert!(seen(&near_host, "rover").is_none());
    near.close().await;
}

/// Returns the contested names in the report of the gateway, which `fipa doctor` shows.
async fn contested_names(gateway: &Gateway, domain: &Domain) -> Vec<(String, String)> {
    let asker = format!("asker of {}", gateway.name());
    let asker = domain.register(&asker).await.unwrap();
    let entry = domain.directory().lookup(gateway.name()).unwrap();
    let report = routes::of_gateway(&asker, &entry, None, Duration::from_secs(60)).await;
    let contested = report.unwrap().contested.into_iter();
    contested.map(|it| (it.name, it.gateway)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn both_agents_with_one_name_are_told_and_a_third_host_keeps_the_first() {
    let (far_config, third_config) = (config(&[]), config(&[]));
    let far = Gateway::open(&far_config).await.unwrap();
    let far_host = Domain::open(&far_config).await.unwrap();
    let one = far_host.register("arm").await.unwrap();
    let near_config = config(&[]);
    let near_host = Domain::open(&near_config).await.unwrap();
    // Registered while neither gateway knows the other registration.
    let other = near_host.register("arm").await.unwrap();
    let mut knows_both = near_config.clone();
    knows_both.discovery = config(&[&knowing("far", &[&address(&far)])]).discovery;
    let near = Gateway::open(&knows_both).await.unwrap();
    for (agent, gateway) in [(&one, &far), (&other, &near)] {
        let failure = agent.receive().await.unwrap().into_message();
        assert_eq!(*failure.performative(), Performative::Failure);
        assert_eq!(failure.sender().unwrap().name(), gateway.name());
        let content = String::from_utf8(failure.content().unwrap().to_vec()).unwrap();
        assert!(content.contains("also registered"), "{content}");
    }
    for (host, own) in [(&far_host, &one), (&near_host, &other)] {
        let known = host.directory().lookup("arm").unwrap();
        assert_eq!(known.incarnation, own.incarnation(), "its own");
    }
    for (gateway, domain, other) in [(&far, &far_host, &near), (&near, &near_host, &far)] {
        let report = contested_names(gateway, domain).await;
        assert_eq!(report, [("arm".to_owned(), other.name().to_owned())]);
    }
    // A third host connects with the gateway of the later one first.
    let mut watcher = third_config.clone();
    let near_at = address(&near);
    watcher.discovery = config(&[&knowing("near", &[&near_at])]).discovery;
    let mut third = Gateway::open(&watcher).await.unwrap();
    let known = |gateway: &Gateway| {
        let known = gateway.directory().known("arm");
        known.map(|known| known.incarnation)
    };
    until_async("the agent of the near host", || known(&third).is_some()).await;
    assert_eq!(known(&third), Some(other.incarnation()));
    let crane = far_host.register("crane").await.unwrap();
    let peers = format!(
        "discovery.static={{ \"near\" = [\"tcp://{near_at}\"], \"far\" = [\"tcp://{}\"] }}",
        address(&far)
    );
    watcher.discovery = config(&[&peers]).discovery;
    assert_eq!(third.reload(&watcher).unwrap().later, [""; 0]);
    until_async("the agents of the far host", || {
        third.directory().known("crane").is_some()
    })
    .await;
    assert_eq!(known(&third), Some(other.incarnation()));
    // After the agent leaves, the other one has the name.
    drop(other);
    until_async("the other has the name", || {
        known(&third) == Some(one.incarnation())
    })
    .await;
    drop(crane);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_static_legacy_peer_gets_its_letters_in_its_dialect() {
    // It reads one letter per connection, to the end of the stream.
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let at = format!("{};fipa-services", listener.local_addr().unwrap());
    let config = config(&[&knowing("old_arm", &[&at])]);
    let gateway = Gateway::open(&config).await.unwrap();
    let host = Domain::open(&config).await.unwrap();
    let rover = host.register("rover").await.unwrap();
    until_async("the legacy peer is known", || {
        host.directory().lookup("old_arm").is_some()
    })
    .await;
    let message = rover
        .message(Performative::Inform)
        .receiver(AgentId::new("old_arm").unwrap())
        .content("hello")
        .build()
        .unwrap();
    let read = tokio::spawn(async move {
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut letter = Vec::new();
        stream.read_to_end(&mut letter).await.unwrap();
        letter
    });
    let sent = rover.send(message).await.unwrap();
    let outcome = &sent.0[0].outcome;
    assert!(
        matches!(outcome, Outcome::Sent { via: Kind::Tcp, .. }),
        "{sent}"
    );
    let letter = read.await.unwrap();
    let (envelope, message) = Letter::decode(letter.into()).unwrap();
    assert_eq!(envelope.effective().intended_receivers[0].name(), "old_arm");
    let message = Message::decode(message.payload()).unwrap();
    assert_eq!(message.content().unwrap(), "hello");
    gateway.close().await;
}
