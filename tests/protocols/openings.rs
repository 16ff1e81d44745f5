//! Receivers that stand for several agents, openings, dropped tasks, servers, publishers, and messages
//! of outsiders.

use std::pin::Pin;
use std::sync::Arc;

use fipa::RegisterOptions;
use fipa::protocol::{Notification, PartnerEvent, Subscription};
use fipa_testbed::until_async;

use super::*;

fn ids(names: &[&str]) -> Vec<AgentId> {
    let names = names.iter();
    names.map(|name| AgentId::new(*name).unwrap()).collect()
}

/// Proposes the own name, and carries if the proposal is accepted.
async fn bid(arm: &Agent) {
    let call = next_message(arm).await.unwrap();
    let name = arm.name().to_owned();
    respond(arm, &call, async |task| {
        Ok(match task.propose(name, TIMEOUT).await? {
            true => Reply::Inform("carried".into()),
            false => Reply::Nothing,
        })
    })
    .await
    .unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_contract_net_reaches_the_members_of_patterns_and_coalitions_once() {
    let (here, there) = two(&["monitor.check=enforce"]).await;
    let rover = here.register("rover").await.unwrap();
    let arms = [
        there.register("arm_1").await.unwrap(),
        there.register("arm_2").await.unwrap(),
        there.register("leg").await.unwrap(),
    ];
    let members = ["rover", "arm_1", "leg", "lost"];
    let options = RegisterOptions::default;
    let _platoon = here
        .form("platoon", members, None, options())
        .await
        .unwrap();
    let _led = here
        .form("led", ["arm_1", "leg"], Some("leg"), options())
        .await
        .unwrap();
    let rounds: [(&[&str], &[&str], &[&str]); 4] = [
        (&["platoon"], &["arm_1", "leg"], &["lost"]),
        (&["led"], &["leg"], &[]),
        (&["arm_.*"], &["arm_1", "arm_2"], &[]),
        (
            &["leg", "leg", "platoon", "arm_.*"],
            &["leg", "arm_1", "arm_2"],
            &["lost"],
        ),
    ];
    for (receivers, members, silent) in rounds {
        let initiator = async {
            let call = rover.message(Performative::Cfp);
            let receivers = ids(receivers);
            let net = rover.contract_net(call, &receivers, TIMEOUT);
            let mut net = net.await.unwrap();
            let called: Vec<&str> = net.called().iter().map(AgentId::name).collect();
            assert_eq!(called, members);
            let bids = net.bids().clone();
            assert_eq!(bids.silent, silent);
            let mut proposals: Vec<&str> = bids.proposals.iter().map(text).collect();
            let mut expected = members.to_vec();
            proposals.sort_unstable();
            expected.sort_unstable();
            assert_eq!(proposals, expected);
            let awarded = net.award(&bids.proposals, "", TIMEOUT).await.unwrap();
            assert_eq!(awarded.len(), members.len());
            assert!(awarded.iter().all(|awarded| awarded.result.is_ok()));
        };
        let bids = arms.iter().filter(|arm| members.contains(&arm.name()));
        let bidding = join_all(bids.map(bid).map(Box::pin).collect());
        tokio::join!(initiator, bidding);
    }
}

/// Runs futures together to their ends.
async fn join_all(mut futures: Vec<Pin<Box<impl Future<Output = ()>>>>) {
    std::future::poll_fn(|context| {
        futures.retain_mut(|future| future.as_mut().poll(context).is_pending());
        match futures.is_empty() {
            true => std::task::Poll::Ready(()),
            false => std::task::Poll::Pending,
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_auction_reaches_the_members_of_a_coalition() {
    let (here, there) = two(&["monitor.check=enforce"]).await;
    let rover = here.register("rover").await.unwrap();
    let arms = [
        there.register("arm_1").await.unwrap(),
        there.register("arm_2").await.unwrap(),
    ];
    let options = RegisterOptions::default();
    let _platoon = here
        .form("platoon", ["arm_1", "arm_2"], None, options)
        .await
        .unwrap();
    let bidder = async |arm: &Agent| {
        let opening = next_message(arm).await.unwrap();
        let mut task = arm.take_part(&opening).unwrap();
        assert!(task.next_call(TIMEOUT).await.unwrap().is_some());
        task.propose("", TIMEOUT).await.unwrap();
        while task.next_call(TIMEOUT).await.unwrap().is_some() {}
    };
    let auctioneer = async {
        let opening = rover.message(Performative::Inform);
        let to = ids(&["platoon", "arm_1"]);
        let mut auction = rover
            .protocols()
            .english_auction(opening, &to)
            .await
            .unwrap();
        assert_eq!(auction.bidders(), ids(&["arm_1", "arm_2"]));
        let bids = auction.call("10", TIMEOUT).await.unwrap();
        assert_eq!(bids.proposals.len(), 2, "{bids:?}");
        auction.accept(&bids.proposals[0], "").await.unwrap();
        auction.close("").await.unwrap();
    };
    tokio::join!(auctioneer, bidder(&arms[0]), bidder(&arms[1]));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_bidders_of_an_auction_are_the_agents_that_its_receivers_stand_for() {
    let (here, there) = two(&["monitor.check=enforce"]).await;
    let rover = here.register("rover").await.unwrap();
    let _arms = [
        there.register("arm_1").await.unwrap(),
        there.register("arm_2").await.unwrap(),
    ];
    let both = ["arm_1", "arm_2"];
    let options = RegisterOptions::default;
    let _platoon = here.form("platoon", both, None, options()).await.unwrap();
    let _led = here
        .form("led", both, Some("arm_2"), options())
        .await
        .unwrap();
    let one = ["arm_2"];
    for (receivers, bidders) in [
        (&["platoon"][..], &both[..]),
        (&["led"], &one),
        (&["arm_.*"], &both),
        (&["led", "arm_2", "led"], &one),
    ] {
        let opening = || rover.message(Performative::Inform);
        let receivers = ids(receivers);
        let english = rover
            .protocols()
            .english_auction(opening(), &receivers)
            .await
            .unwrap();
        assert_eq!(english.bidders(), ids(bidders));
        let dutch = rover
            .protocols()
            .dutch_auction(opening(), &receivers)
            .await
            .unwrap();
        assert_eq!(dutch.bidders(), ids(bidders));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_needs_receivers_that_stand_for_one_agent() {
    let (here, there) = two(&["monitor.check=enforce"]).await;
    let rover = here.register("rover").await.unwrap();
    let arms = [
        there.register("arm_1").await.unwrap(),
        there.register("arm_2").await.unwrap(),
    ];
    let both = ["arm_1", "arm_2"];
    let options = RegisterOptions::default;
    let _platoon = here.form("platoon", both, None, options()).await.unwrap();
    let _led = here
        .form("led", both, Some("arm_2"), options())
        .await
        .unwrap();
    for several in ["platoon", "arm_.*"] {
        let to = |act| rover.message(act).receivers(ids(&[several]));
        let refused = [
            rover
                .request(to(Performative::Request), TIMEOUT)
                .await
                .err(),
            rover.query(to(Performative::QueryIf), TIMEOUT).await.err(),
            rover
                .protocols()
                .request_when(to(Performative::RequestWhen), TIMEOUT)
                .await
                .err(),
            rover
                .protocols()
                .propose(to(Performative::Propose), TIMEOUT)
                .await
                .err(),
            rover
                .subscribe(to(Performative::Subscribe), TIMEOUT)
                .await
                .err(),
            rover
                .protocols()
                .brokering(to(Performative::Proxy), TIMEOUT)
                .await
                .err(),
            rover
                .protocols()
                .recruiting(to(Performative::Proxy), TIMEOUT)
                .await
                .err(),
        ];
        for refused in refused {
            match refused {
                Some(DialogueError::Several { agents }) => assert_eq!(agents, both),
                other => panic!("{several}: {other:?}"),
            }
        }
    }
    for one in ["led", ".*_2"] {
        let lift = rover.message(Performative::Request).receivers(ids(&[one]));
        let mut request = rover.request(lift, TIMEOUT).await.unwrap();
        let first = next_message(&arms[1]).await.unwrap();
        respond(&arms[1], &first, async |_| Ok(Reply::Inform("done".into())))
            .await
            .unwrap();
        assert_eq!(text(&request.result().await.unwrap()), "done");
    }
    assert!(arms[0].try_receive().unwrap().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn only_a_message_that_opens_a_protocol_becomes_a_task() {
    let (rover, arm) = pair(&[]).await;
    for (act, protocol) in [
        (Performative::Inform, "fipa-request"),
        (Performative::Failure, "fipa-request"),
        (Performative::NotUnderstood, "fipa-request"),
        (Performative::Cancel, "fipa-request"),
        (Performative::AcceptProposal, "fipa-contract-net"),
        (Performative::Propose, "fipa-contract-net"),
        (Performative::Agree, "fipa-subscribe"),
    ] {
        let message = to(&rover, act.clone(), &arm, "").protocol(protocol);
        let message = message.conversation_id(format!("c-{act}")).build().unwrap();
        rover.send(message).await.unwrap();
        let message = next_message(&arm).await.unwrap();
        let refused = arm.take_part(&message);
        assert!(
            matches!(&refused, Err(DialogueError::NotOpening(_))),
            "{act} in {protocol}: {refused:?}"
        );
    }
    // A message that the agent itself has sent.
    let own = to(&rover, Performative::Request, &rover, "").protocol("fipa-request");
    let own = own.conversation_id("own").build().unwrap();
    rover.send(own).await.unwrap();
    let own = next_message(&rover).await.unwrap();
    let refused = rover.take_part(&own);
    assert!(matches!(refused, Err(DialogueError::NotOpening(_))));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dropped_task_tells_its_initiator() {
    let (rover, arm) = pair(&["monitor.check=enforce"]).await;
    let ask = async |act| {
        let request = rover.request(to(&rover, act, &arm, "lift"), TIMEOUT);
        let request = request.await.unwrap();
        let first = next_message(&arm).await.unwrap();
        (request, arm.take_part(&first).unwrap())
    };
    let (mut request, task) = ask(Performative::Request).await;
    drop(task);
    let result = request.result().await;
    assert!(matches!(result, Err(DialogueError::NotUnderstood(_))));
    let (mut request, mut task) = ask(Performative::Request).await;
    task.agree("").await.unwrap();
    drop(task);
    assert!(matches!(
        request.result().await,
        Err(DialogueError::Failed(_))
    ));
    // A task that is over, or was ended without a message, sends nothing.
    let (mut request, task) = ask(Performative::Request).await;
    task.reply(Reply::Inform("done".into())).await.unwrap();
    request.result().await.unwrap();
    let (_request, task) = ask(Performative::Request).await;
    task.reply(Reply::Nothing).await.unwrap();
    assert!(rover.try_receive().unwrap().is_none());
    // A bidder whose proposal is not decided on yet.
    let (dropped, is_dropped) = tokio::sync::oneshot::channel();
    let bidder = async {
        let call = next_message(&arm).await.unwrap();
        let mut task = arm.take_part(&call).unwrap();
        let late = task.propose("10", Duration::from_millis(50)).await;
        assert!(matches!(late, Err(DialogueError::TimedOut)));
        drop(task);
        dropped.send(()).unwrap();
    };
    let initiator = async {
        let call = rover.message(Performative::Cfp);
        let arms = ids(&["arm"]);
        let net = rover.contract_net(call, &arms, TIMEOUT);
        let mut net = net.await.unwrap();
        let bid = net.bids().proposals.clone();
        is_dropped.await.unwrap();
        let ended = next_in(&mut net, &bid).await;
        assert!(ended.is_err(), "{ended:?}");
    };
    tokio::join!(bidder, initiator);
}

/// Awards the bids, and returns the result of the first.
async fn next_in(
    net: &mut fipa::protocol::ContractNet,
    bids: &[Message],
) -> Result<Message, DialogueError> {
    let mut awarded = net.award(bids, "", TIMEOUT).await?;
    awarded.remove(0).result
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_runs_a_handler_for_each_opening() {
    let (rover, arm) = pair(&["monitor.check=enforce"]).await;
    let unknown = arm.serve("fipa-reqest", async |_| Ok::<_, String>(Reply::Nothing));
    assert!(matches!(unknown, Err(DialogueError::Unchecked(_))));
    let both = Arc::new(tokio::sync::Barrier::new(2));
    let mut server = arm
        .serve("fipa-request", move |mut task: Task| {
            let both = Arc::clone(&both);
            async move {
                let act = text(task.message()).to_owned();
                match act.as_str() {
                    "together" => {
                        task.agree("").await?;
                        // Two handlers run at the same time.
                        both.wait().await;
                        Ok(Reply::Inform("done".into()))
                    }
                    "by itself" => {
                        task.reply(Reply::Inform("done".into())).await?;
                        Ok(Reply::Nothing)
                    }
                    "fail" => {
                        task.agree("").await?;
                        Err("the gripper is stuck".into())
                    }
                    "panic" => panic!("a mistake of the handler"),
                    _ => Ok::<_, Box<dyn std::error::Error + Send + Sync>>(Reply::Refuse(
                        "unknown".into(),
                    )),
                }
            }
        })
        .unwrap();
    let ask = async |content: &str| {
        let request = to(&rover, Performative::Request, &arm, content);
        rover
            .request(request, TIMEOUT)
            .await
            .unwrap()
            .result()
            .await
    };
    let (one, two) = tokio::join!(ask("together"), ask("together"));
    assert_eq!((text(&one.unwrap()), text(&two.unwrap())), ("done", "done"));
    assert_eq!(text(&ask("by itself").await.unwrap()), "done");
    let failed = ask("fail").await;
    let is_failed =
        matches!(&failed, Err(DialogueError::Failed(why)) if text(why) == "the gripper is stuck");
    assert!(is_failed, "{failed:?}");
    let failed = ask("panic").await;
    assert!(
        matches!(failed, Err(DialogueError::NotUnderstood(_))),
        "{failed:?}"
    );
    assert!(matches!(ask("?").await, Err(DialogueError::Refused(_))));
    // Other messages, and openings of other protocols, go to `receive`.
    let note = to(&rover, Performative::Inform, &arm, "note");
    rover.send(note.build().unwrap()).await.unwrap();
    assert_eq!(text(next_message(&arm).await.unwrap().message()), "note");
    assert!(server.running() <= 1);
    drop(arm);
    let ended = tokio::time::timeout(TIMEOUT, server.ended()).await;
    ended.unwrap();
}

/// Takes the next item of a stream.
async fn item(subscription: &mut Subscription) -> Option<Result<Notification, DialogueError>> {
    use futures_core::Stream as _;
    std::future::poll_fn(|context| Pin::new(&mut *subscription).poll_next(context)).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_publisher_notifies_all_subscribers_and_drops_those_that_are_gone() {
    let (here, there) = two(&["monitor.check=enforce"]).await;
    let battery = there.register("battery").await.unwrap();
    let charge = battery.publisher("charge").unwrap();
    let [rover, leaver, quitter, other] = [
        here.register("rover").await.unwrap(),
        here.register("leaver").await.unwrap(),
        here.register("quitter").await.unwrap(),
        here.register("other").await.unwrap(),
    ];
    let subscribe = async |agent: &Agent, topic: &str| {
        let subscribe = to(agent, Performative::Subscribe, &battery, topic);
        agent.subscribe(subscribe, TIMEOUT).await
    };
    assert_eq!(charge.publish("100").await.subscribers(), 0);
    let mut at_rover = subscribe(&rover, "charge").await.unwrap();
    let at_leaver = subscribe(&leaver, "charge").await.unwrap();
    let at_quitter = subscribe(&quitter, "charge").await.unwrap();
    // Another topic has no publisher.
    let refused = subscribe(&other, "heat").await.unwrap_err().to_string();
    assert!(
        refused.contains("there is no such topic; topics: charge"),
        "{refused}"
    );

    // A subscriber that has received the `agree` gets the next notification.
    assert_eq!(charge.subscribers(), 3);
    assert_eq!(charge.names(), ["leaver", "quitter", "rover"]);
    assert_eq!(charge.publish("99").await.delivered().await, 3);
    assert_eq!(text(&at_rover.next().await.unwrap()), "99");
    at_quitter.cancel(TIMEOUT).await.unwrap();
    until_async("one has cancelled", || charge.subscribers() == 2).await;
    drop(leaver);
    until_async("one is gone", || charge.subscribers() == 1).await;
    drop(at_leaver);
    assert_eq!(charge.publish("98").await.delivered().await, 1);
    // The subscription does not borrow the agent, and is a stream.
    let mut at_rover = tokio::spawn(async move {
        let next = item(&mut at_rover).await.unwrap().unwrap();
        assert_eq!(text(&next), "98");
        // A wait that is dropped loses no notification.
        let none = tokio::time::timeout(Duration::from_millis(20), item(&mut at_rover)).await;
        assert!(none.is_err());
        at_rover
    })
    .await
    .unwrap();
    assert_eq!(charge.publish("97").await.delivered().await, 1);
    assert_eq!(text(&at_rover.next().await.unwrap()), "97");
    drop(charge);
    let ended = item(&mut at_rover).await.unwrap();
    assert!(matches!(ended, Err(DialogueError::Failed(_))), "{ended:?}");
    assert!(at_rover.goes_on());
    // The topic returns.
    let charge = battery.publisher("charge").unwrap();
    until_async("the subscriber returns", || charge.subscribers() == 1).await;
    assert_eq!(charge.publish("96").await.delivered().await, 1);
    let next = at_rover.next().await.unwrap();
    assert_eq!((text(&next), next.is_restart()), ("96", true));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_of_an_outsider_never_reaches_a_conversation() {
    let (rover, arm) = pair(&[]).await;
    let mallory = arm.domain().register("mallory").await.unwrap();
    let lift = to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    let first = next_message(&arm).await.unwrap();
    let id = request.conversation_id().to_owned();
    for act in [Performative::Inform, Performative::Failure] {
        let forged = to(&mallory, act, &rover, "forged")
            .protocol("fipa-request")
            .conversation_id(id.as_str())
            .ontology("fipa-agent-management")
            .in_reply_to(first.message().reply_with().unwrap());
        let sent = mallory.send(forged.build().unwrap()).await.unwrap();
        assert!(sent.all_succeeded());
    }
    let answered = async {
        // The forged messages arrive first.message().
        for _ in 0..2 {
            let forged = next_message(&rover).await.unwrap().into_message();
            assert_eq!(forged.sender().unwrap().name(), "mallory");
        }
        respond(&arm, &first, async |_| Ok(Reply::Inform("done".into())))
            .await
            .unwrap();
    };
    let (result, ()) = tokio::join!(request.result(), answered);
    assert_eq!(text(&result.unwrap()), "done");
    // A conversation that mallory begins with the same id exists beside it.
    let lift = to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    let opening = to(&mallory, Performative::Request, &rover, "open")
        .protocol("fipa-request")
        .conversation_id(request.conversation_id());
    mallory.send(opening.build().unwrap()).await.unwrap();
    let opening = next_message(&rover).await.unwrap();
    let task = rover.take_part(&opening).unwrap();
    let first = next_message(&arm).await.unwrap();
    respond(&arm, &first, async |_| Ok(Reply::Inform("done".into())))
        .await
        .unwrap();
    assert_eq!(text(&request.result().await.unwrap()), "done");
    task.reply(Reply::Refuse("no".into())).await.unwrap();
    let refused = next_message(&mallory).await.unwrap().into_message();
    assert_eq!(*refused.performative(), Performative::Refuse);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_application_watches_the_partners_of_its_own_conversations() {
    let (rover, arm) = pair(&[]).await;
    let mut partners = rover.watch_partners();
    let hello = to(&rover, Performative::Inform, &arm, "hello");
    rover.send(hello.build().unwrap()).await.unwrap();
    // The departure precedes the look-up.
    drop(arm);
    partners.add("arm");
    let event = tokio::time::timeout(TIMEOUT, partners.next()).await;
    let agent = "arm".to_owned();
    assert_eq!(event.unwrap(), PartnerEvent::Gone { agent });
}
