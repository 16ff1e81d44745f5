//! Protocols between agents of two processes, as calls and with the checks of `[monitor]`. Each
//! process is a membership of its own, here in one test process.
//!
//! This file has the protocols with one participant and the contract net. `selling.rs` has auctions
//! and the iterated contract net, `proxies.rs` brokering and recruiting, and `blocking.rs` the sides
//! that are threads without a runtime.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod blocking;
mod moved;
mod openings;
mod proxies;
mod requests;
mod selling;
mod shares;
#[path = "../support/mod.rs"]
mod support;
mod unknown;
mod verdicts;

use std::time::Duration;

use fipa::error::{ErrorChain, OpenError, ReceiveError, SendError};
use fipa::monitor::ViolationKind;
use fipa::protocol::{Decision, DialogueError, Reply, Task};
use fipa::{Agent, AgentId, Config, Domain, Incoming, Message, MessageBuilder, Performative};

/// Time limit of all calls, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Waits for the next message of an agent. The test fails if none arrives.
async fn next_message(agent: &Agent) -> Result<Incoming, ReceiveError> {
    let received = tokio::time::timeout(TIMEOUT, agent.receive()).await;
    received.unwrap_or_else(|_| panic!("no message for {}", agent.name()))
}

/// Makes a configuration for a domain that no other test uses.
fn config(set: &[&str]) -> Config {
    support::config(&[&["mts.deadline=2min"], set].concat())
}

async fn two(set: &[&str]) -> (Domain, Domain) {
    support::two(&config(set)).await
}

/// Registers agents in a domain.
async fn registered<const N: usize>(domain: &Domain, names: [&str; N]) -> [Agent; N] {
    let mut agents = Vec::new();
    for name in names {
        agents.push(domain.register(name).await.unwrap());
    }
    agents.try_into().unwrap()
}

/// Registers a rover, and an arm of another process.
async fn pair(set: &[&str]) -> (Agent, Agent) {
    let (here, there) = two(set).await;
    (
        here.register("rover").await.unwrap(),
        there.register("arm").await.unwrap(),
    )
}

fn to(agent: &Agent, act: Performative, receiver: &Agent, content: &str) -> MessageBuilder {
    agent
        .message(act)
        .receiver(receiver.id().clone())
        .content(content.to_owned())
}

/// Takes part in the conversation of this message, and replies with the result of the handler.
async fn respond(
    agent: &Agent,
    first: &Incoming,
    handler: impl AsyncFnOnce(&mut Task) -> Result<Reply, DialogueError>,
) -> Result<(), DialogueError> {
    let mut task = agent.take_part(first)?;
    let reply = handler(&mut task).await?;
    task.reply(reply).await
}

fn text(message: &Message) -> &str {
    std::str::from_utf8(message.content().unwrap()).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_is_agreed_to_and_answered() {
    let (rover, arm) = pair(&["monitor.check=enforce"]).await;
    let initiator = async {
        let lift = to(&rover, Performative::Request, &arm, "lift");
        let mut request = rover.request(lift, TIMEOUT).await.unwrap();
        assert!(request.agreed().await.unwrap());
        assert_eq!(text(&request.result().await.unwrap()), "lifted");
    };
    let participant = async {
        let first = next_message(&arm).await.unwrap();
        assert_eq!(first.message().protocol(), Some("fipa-request"));
        assert!(first.message().reply_by().is_some() && first.message().reply_with().is_some());
        let handler = async |task: &mut Task| {
            assert_eq!(text(task.message()), "lift");
            task.agree("").await?;
            Ok(Reply::Inform("lifted".into()))
        };
        respond(&arm, &first, handler).await.unwrap();
    };
    tokio::join!(initiator, participant);
}

#[tokio::test(flavor = "multi_thread")]
async fn each_kind_of_answer_yields_its_result_or_error() {
    let (rover, arm) = pair(&[]).await;
    let initiator = async {
        let ask = |act| to(&rover, act, &arm, "?");
        let request = rover.request(ask(Performative::Request), TIMEOUT).await;
        let refused = request.unwrap().result().await;
        assert!(matches!(&refused, Err(DialogueError::Refused(why)) if text(why) == "busy"));
        // The participant answers without an `agree`.
        let query = rover.query(ask(Performative::QueryRef), TIMEOUT).await;
        let mut query = query.unwrap();
        assert!(!query.agreed().await.unwrap());
        assert_eq!(text(&query.result().await.unwrap()), "42");
        let when = rover
            .protocols()
            .request_when(ask(Performative::RequestWhen), TIMEOUT)
            .await;
        let mut when = when.unwrap();
        assert!(when.agreed().await.unwrap());
        assert!(matches!(when.result().await, Err(DialogueError::Failed(_))));
        let decided = rover
            .protocols()
            .propose(ask(Performative::Propose), TIMEOUT)
            .await;
        assert!(matches!(decided, Ok(Decision::Accepted(_))));
        let decided = rover
            .protocols()
            .propose(ask(Performative::Propose), TIMEOUT)
            .await;
        assert!(matches!(decided, Ok(Decision::Rejected(_))));
        // A message that does not begin the protocol is not sent.
        let wrong = rover.request(ask(Performative::Inform), TIMEOUT).await;
        assert!(matches!(wrong, Err(DialogueError::WouldViolate(_))));
        let to_unknown = rover
            .message(Performative::Request)
            .receiver(AgentId::new("unknown").unwrap());
        let unknown = rover.request(to_unknown, TIMEOUT).await;
        assert!(matches!(unknown, Err(DialogueError::NotDelivered { .. })));
    };
    let participant = async {
        for answer in [
            Reply::Refuse("busy".into()),
            Reply::Inform("42".into()),
            Reply::Failure("broken".into()),
            Reply::Accept("".into()),
            Reply::Reject("".into()),
        ] {
            let first = next_message(&arm).await.unwrap();
            let when = *first.message().performative() == Performative::RequestWhen;
            let handler = async |task: &mut Task| {
                if when {
                    task.agree("").await?;
                }
                Ok(answer)
            };
            respond(&arm, &first, handler).await.unwrap();
        }
    };
    tokio::join!(initiator, participant);
}

#[tokio::test(flavor = "multi_thread")]
async fn missing_and_invalid_answers_are_errors() {
    let (rover, arm) = pair(&[]).await;
    let lift = || to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift(), Duration::from_secs(4)).await.unwrap();
    assert!(matches!(
        request.result().await,
        Err(DialogueError::TimedOut)
    ));
    drop(request);
    let first = next_message(&arm).await.unwrap().into_message();
    // No call leads the conversation, so its message goes to `receive`.
    let late = arm.reply(&first, Performative::Agree).build().unwrap();
    assert!(arm.send(late).await.unwrap().all_succeeded());
    let late = next_message(&rover).await.unwrap().into_message();
    assert_eq!(*late.performative(), Performative::Agree);

    // No right answer follows the invalid one.
    let mut request = rover.request(lift(), Duration::from_secs(4)).await.unwrap();
    let first = next_message(&arm).await.unwrap().into_message();
    let invalid = arm.reply(&first, Performative::Propose).build().unwrap();
    arm.send(invalid).await.unwrap();
    match request.result().await {
        Err(DialogueError::Violation { violation, message }) => {
            assert_eq!(violation.kind, ViolationKind::Unexpected);
            assert_eq!(*message.performative(), Performative::Propose);
        }
        other => panic!("{other:?}"),
    }
    let mut request = rover.request(lift(), TIMEOUT).await.unwrap();
    let first = next_message(&arm).await.unwrap().into_message();
    let answer = arm
        .reply(&first, Performative::NotUnderstood)
        .build()
        .unwrap();
    arm.send(answer).await.unwrap();
    let result = request.result().await;
    assert!(matches!(result, Err(DialogueError::NotUnderstood(_))));
    // A reply that violates the protocol is not sent.
    let _request = rover.request(lift(), TIMEOUT).await.unwrap();
    let first = next_message(&arm).await.unwrap();
    let wrong = respond(&arm, &first, async |_| Ok(Reply::Accept("".into()))).await;
    assert!(matches!(wrong, Err(DialogueError::WouldViolate(_))));
}

#[tokio::test(flavor = "multi_thread")]
async fn other_messages_are_received_during_a_conversation() {
    let (rover, arm) = pair(&[]).await;
    let lift = to(&rover, Performative::Request, &arm, "lift");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    let first = next_message(&arm).await.unwrap();
    for number in 0..5 {
        let note = to(&arm, Performative::Inform, &rover, &number.to_string());
        arm.send(note.build().unwrap()).await.unwrap();
    }
    // Read before the result, and after it.
    let early = next_message(&rover).await.unwrap().into_message();
    assert_eq!(text(&early), "0");
    let result = tokio::join!(request.result(), async {
        respond(&arm, &first, async |_| Ok(Reply::Inform("done".into())))
            .await
            .unwrap();
    });
    assert_eq!(text(&result.0.unwrap()), "done");
    for number in 1..5 {
        let note = rover.try_receive().unwrap().unwrap().into_message();
        assert_eq!(text(&note), number.to_string());
    }
    assert!(rover.try_receive().unwrap().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_conversation_blocked_by_unread_messages_ends_with_the_domain() {
    let (rover, arm) = pair(&[]).await;
    let initiator = async {
        let subscribe = to(&rover, Performative::Subscribe, &arm, "pose");
        let mut poses = rover.subscribe(subscribe, TIMEOUT).await.unwrap();
        tokio::time::timeout(TIMEOUT, poses.next()).await.unwrap()
    };
    let participant = async {
        let first = next_message(&arm).await.unwrap();
        let mut task = arm.take_part(&first).unwrap();
        task.agree("").await.unwrap();
        // As many messages as can be set aside for `receive`, which the rover does not call.
        for number in 0..1_024 {
            let note = to(&arm, Performative::Inform, &rover, &number.to_string());
            let sent = arm.send(note.build().unwrap()).await.unwrap();
            assert!(sent.all_succeeded(), "{sent:?}");
        }
        rover.domain().clone().close().await;
    };
    let (next, ()) = tokio::join!(initiator, participant);
    let ended = next.unwrap_err();
    let closed = matches!(ended, DialogueError::Receive(ReceiveError::Closed));
    assert!(closed, "{ended}");
}

/// Sends the poses 0 to 9, and waits until the subscription is cancelled.
async fn ten_poses(task: &mut Task) -> Result<Reply, DialogueError> {
    task.agree("").await?;
    for number in 0..10 {
        task.inform(number.to_string()).await?;
    }
    task.cancelled().await?;
    task.confirm_cancel().await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_subscription_goes_on_until_it_is_cancelled() {
    let (rover, arm) = pair(&["monitor.check=enforce"]).await;
    let initiator = async {
        let subscribe = to(&rover, Performative::Subscribe, &arm, "pose");
        let mut poses = rover.subscribe(subscribe, TIMEOUT).await.unwrap();
        for number in 0..10 {
            assert_eq!(text(&poses.next().await.unwrap()), number.to_string());
        }
        poses.cancel(TIMEOUT).await.unwrap();
    };
    let participant = async {
        let first = next_message(&arm).await.unwrap();
        respond(&arm, &first, ten_poses).await.unwrap();
    };
    tokio::join!(initiator, participant);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dropped_subscription_is_cancelled_and_its_notifications_are_discarded() {
    let (rover, arm) = pair(&["monitor.check=enforce"]).await;
    let initiator = async {
        let subscribe = to(&rover, Performative::Subscribe, &arm, "pose");
        let mut poses = rover.subscribe(subscribe, TIMEOUT).await.unwrap();
        assert_eq!(text(&poses.next().await.unwrap()), "0");
    };
    let participant = async {
        let first = next_message(&arm).await.unwrap();
        respond(&arm, &first, ten_poses).await.unwrap();
        let hello = to(&arm, Performative::Inform, &rover, "hello");
        assert!(
            arm.send(hello.build().unwrap())
                .await
                .unwrap()
                .all_succeeded()
        );
    };
    tokio::join!(initiator, participant);
    assert_eq!(text(next_message(&rover).await.unwrap().message()), "hello");
}

#[test]
fn a_subscription_that_is_dropped_after_its_publisher_has_gone_keeps_no_thread_busy() {
    let (done, is_done) = std::sync::mpsc::channel();
    let test = async move {
        let (rover, arm) = pair(&[]).await;
        let initiator = async {
            let subscribe = to(&rover, Performative::Subscribe, &arm, "pose");
            rover.subscribe(subscribe, TIMEOUT).await.unwrap()
        };
        let participant = async {
            let first = next_message(&arm).await.unwrap();
            let mut task = arm.take_part(&first).unwrap();
            task.agree("").await.unwrap();
            task
        };
        let (poses, task) = tokio::join!(initiator, participant);
        // Without a last message, as if its process had been killed.
        arm.deregister().unwrap();
        drop(poses);
        // More than the time after which the subscriber learns that the publisher is gone.
        tokio::time::sleep(Duration::from_millis(200)).await;
        rover.domain().clone().close().await;
        drop(task);
        done.send(()).unwrap();
    };
    // A task that never waits would keep the one thread of this runtime.
    std::thread::spawn(|| {
        let runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = { runtime }.enable_all().build().unwrap();
        runtime.block_on(test);
    });
    is_done.recv_timeout(Duration::from_secs(20)).unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_that_arrives_before_its_server_starts_is_answered() {
    let (rover, arm) = pair(&[]).await;
    // It takes the letters of the agent, also those that are not for it.
    let _publisher = arm.publisher("charge").unwrap();
    let lift = rover.message(Performative::Request).receiver("arm");
    let mut request = rover.request(lift, TIMEOUT).await.unwrap();
    let subscribe = rover.message(Performative::Subscribe).receiver("arm");
    let subscribe = subscribe.content("charge");
    drop(rover.subscribe(subscribe, TIMEOUT).await.unwrap());
    let _server = arm.serve("fipa-request", async |_| {
        Ok::<_, DialogueError>(Reply::Inform("lifted".into()))
    });
    let answer = request.result().await.unwrap();
    assert_eq!(answer.text(), "lifted");
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_that_are_cancelled_at_once_are_cancelled() {
    let (rover, arm) = pair(&[]).await;
    let _server = arm.serve("fipa-request", async |mut task: Task| {
        task.agree("").await?;
        task.cancelled().await?;
        task.confirm_cancel().await
    });
    let cancel = async |rover: Agent| {
        let lift = rover.message(Performative::Request).receiver("arm");
        let mut request = rover.request(lift, TIMEOUT).await.unwrap();
        request.cancel(TIMEOUT).await
    };
    let all: Vec<_> = (0..600)
        .map(|_| tokio::spawn(cancel(rover.clone())))
        .collect();
    for canceled in all {
        assert!(canceled.await.unwrap().unwrap());
    }
    assert!(arm.try_receive().unwrap().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_is_cancelled() {
    let (rover, arm) = pair(&[]).await;
    let initiator = async {
        let lift = to(&rover, Performative::Request, &arm, "lift");
        let mut request = rover.request(lift, TIMEOUT).await.unwrap();
        assert!(request.agreed().await.unwrap());
        assert!(request.cancel(TIMEOUT).await.unwrap());
    };
    let participant = async {
        let first = next_message(&arm).await.unwrap();
        let handler = async |task: &mut Task| {
            task.agree("").await?;
            tokio::select! {
                () = std::future::pending() => Ok(Reply::Inform("lifted".into())),
                cancelled = task.cancelled() => {
                    cancelled?;
                    task.confirm_cancel().await
                }
            }
        };
        respond(&arm, &first, handler).await.unwrap();
    };
    tokio::join!(initiator, participant);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_contract_net_with_several_participants() {
    let (here, there) = two(&["monitor.check=enforce"]).await;
    let rover = here.register("rover").await.unwrap();
    let names = ["cheap", "dear", "lazy"];
    let arms = registered(&there, names).await;
    let mut called: Vec<AgentId> = arms.iter().map(|arm| arm.id().clone()).collect();
    called.push(AgentId::new("unknown").unwrap());
    let participants = async {
        let bid = async |arm: &Agent, price: &'static str| {
            let call = next_message(arm).await.unwrap();
            respond(arm, &call, async |task| {
                if task.propose(price, TIMEOUT).await? {
                    return Ok(Reply::Inform("carried".into()));
                }
                Ok(Reply::Nothing)
            })
            .await
            .unwrap();
        };
        let refuse = async |arm: &Agent| {
            let call = next_message(arm).await.unwrap();
            let answer = respond(arm, &call, async |_| Ok(Reply::Refuse("no".into())));
            answer.await.unwrap();
        };
        tokio::join!(bid(&arms[0], "10"), bid(&arms[1], "99"), refuse(&arms[2]));
    };
    let initiator = async {
        let call = rover.message(Performative::Cfp).content("carry");
        let mut net = rover.contract_net(call, &called, TIMEOUT).await.unwrap();
        let bids = net.bids().clone();
        assert_eq!(bids.refusals.len(), 1, "{bids:?}");
        assert_eq!(bids.silent, ["unknown"]);
        assert_eq!(bids.unreached, ["unknown"]);
        let cheap = bids.proposals.iter().find(|bid| text(bid) == "10");
        let cheap = cheap.unwrap().clone();
        let results = net.award(&[cheap], "", TIMEOUT).await.unwrap();
        assert_eq!(results.len(), 1);
        assert_eq!(results[0].agent, "cheap");
        assert_eq!(text(results[0].result.as_ref().unwrap()), "carried");
    };
    tokio::join!(initiator, participants);
}

fn in_protocol(from: &Agent, act: Performative, to_: &Agent, id: &str) -> Message {
    to(from, act, to_, "")
        .protocol("fipa-contract-net")
        .conversation_id(id)
        .build()
        .unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn enforcing_refuses_to_send_messages_that_violate_a_protocol() {
    let (rover, arm) = pair(&["monitor.check=enforce"]).await;
    let illegal = in_protocol(&rover, Performative::AcceptProposal, &arm, "c");
    let refused = rover.send(illegal).await;
    assert!(
        matches!(&refused, Err(SendError::Violation(why)) if why.kind == ViolationKind::NotOpened)
    );
    rover
        .send(in_protocol(&rover, Performative::Cfp, &arm, "c"))
        .await
        .unwrap();
    next_message(&arm).await.unwrap();
    let early = arm
        .send(in_protocol(&arm, Performative::Inform, &rover, "c"))
        .await;
    let Err(SendError::Violation(violation)) = early else {
        panic!("{early:?}");
    };
    assert_eq!(violation.state.as_deref(), Some("called"));
    assert!(rover.try_receive().unwrap().is_none());
    // Messages outside of a conversation are not checked.
    let note = to(&arm, Performative::Inform, &rover, "hello")
        .build()
        .unwrap();
    arm.send(note).await.unwrap();
    assert_eq!(text(next_message(&rover).await.unwrap().message()), "hello");
}

/// Registers agents in a process that checks messages, and in one that does not.
async fn only_one_checks(set: &[&str]) -> (Agent, Agent) {
    let unchecked = config(&[]);
    let mut checked = config(set);
    checked.domain.clone_from(&unchecked.domain);
    let here = Domain::open(&checked).await.unwrap();
    let there = Domain::open(&unchecked).await.unwrap();
    (
        here.register("rover").await.unwrap(),
        there.register("arm").await.unwrap(),
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn a_received_message_that_violates_a_protocol_is_returned_as_a_violation() {
    let (rover, arm) = only_one_checks(&["monitor.check=enforce", "monitor.answer=true"]).await;
    rover
        .send(in_protocol(&rover, Performative::Cfp, &arm, "c"))
        .await
        .unwrap();
    next_message(&arm).await.unwrap();
    arm.send(in_protocol(&arm, Performative::Inform, &rover, "c"))
        .await
        .unwrap();
    // It is a value: the agent goes on.
    let incoming = next_message(&rover).await.unwrap();
    assert_eq!(
        incoming.violation().unwrap().kind,
        ViolationKind::OutOfOrder
    );
    assert_eq!(*incoming.message().performative(), Performative::Inform);
    let answer = next_message(&arm).await.unwrap().into_message();
    assert_eq!(*answer.performative(), Performative::NotUnderstood);
    assert!(text(&answer).contains("expected refuse, propose from arm to rover"));
}

#[tokio::test(flavor = "multi_thread")]
async fn violations_pass_and_are_marked_if_the_check_is_warn() {
    let (rover, arm) = only_one_checks(&["monitor.check=warn"]).await;
    rover
        .send(in_protocol(&rover, Performative::Cfp, &arm, "c"))
        .await
        .unwrap();
    next_message(&arm).await.unwrap();
    arm.send(in_protocol(&arm, Performative::Inform, &rover, "c"))
        .await
        .unwrap();
    let incoming = next_message(&rover).await.unwrap();
    assert_eq!(
        incoming.violation().unwrap().kind,
        ViolationKind::OutOfOrder
    );
    let illegal = in_protocol(&rover, Performative::AcceptProposal, &arm, "c");
    rover.send(illegal).await.unwrap();
    let incoming = next_message(&arm).await.unwrap();
    assert_eq!(
        *incoming.message().performative(),
        Performative::AcceptProposal
    );
    assert!(incoming.violation().is_none(), "the arm does not check");
}

#[tokio::test(flavor = "multi_thread")]
async fn protocols_of_the_configuration_are_read_and_checked() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("handover.scxml");
    let own = r#"<scxml initial="1">
        <state id="1"><transition performative="propose" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="confirm" from="b" to="a" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#;
    std::fs::write(&file, own).unwrap();
    let set = format!("monitor.protocols={}", file.display());
    let (rover, arm) = pair(&["monitor.check=enforce", &set]).await;
    let message = |from: &Agent, act, receiver: &Agent| {
        let message = to(from, act, receiver, "").protocol("handover");
        message.conversation_id("c").build().unwrap()
    };
    rover
        .send(message(&rover, Performative::Propose, &arm))
        .await
        .unwrap();
    next_message(&arm).await.unwrap();
    let wrong = arm
        .send(message(&arm, Performative::AcceptProposal, &rover))
        .await;
    assert!(matches!(wrong, Err(SendError::Violation(_))));
    arm.send(message(&arm, Performative::Confirm, &rover))
        .await
        .unwrap();
    next_message(&rover).await.unwrap();

    // A state may have the same name as a state of the monitor, and still belongs to the protocol.
    let named = r#"<scxml initial="1">
        <state id="1"><transition performative="propose" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="a" to="b" target="cancelling"/></state>
        <state id="cancelling"><transition performative="agree" from="b" to="a" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#;
    std::fs::write(&file, named).unwrap();
    let (rover, arm) = pair(&[&set]).await;
    let propose = message(&rover, Performative::Propose, &arm);
    rover.send(propose).await.unwrap();
    let first = next_message(&arm).await.unwrap();
    let mut task = arm.take_part(&first).unwrap();
    let inform = message(&rover, Performative::Inform, &arm);
    rover.send(inform).await.unwrap();
    let second = task.next(TIMEOUT).await.unwrap();
    assert_eq!(*second.performative(), Performative::Inform);
    assert_eq!(task.state(), "cancelling");

    std::fs::write(&file, own.replace("target=\"3\"", "target=\"4\"")).unwrap();
    let error = Domain::open(&config(&[&set])).await.err().unwrap();
    assert!(matches!(error, OpenError::Protocol(_)));
    let text = ErrorChain(&error).to_string();
    assert!(
        text.contains("handover.scxml:3: there is no state \"4\""),
        "{text}"
    );
    std::fs::remove_file(&file).unwrap();
    let error = Domain::open(&config(&[&set])).await.err().unwrap();
    assert!(error.to_string().contains("cannot read"), "{error}");
}
