//! The blocking calls of all protocols, with each side on a thread of its own.

use std::thread;

use fipa::blocking;

use super::*;

/// Runs a rover and an arm of two processes. The arm runs `arm_does` with its first message.
fn between<T: Send + 'static>(
    arm_does: impl FnOnce(&blocking::Agent, &Incoming) -> T + Send + 'static,
    rover_does: impl FnOnce(&blocking::Agent),
) -> T {
    let config = config(&["monitor.check=enforce"]);
    let here = blocking::Domain::open(&config).unwrap();
    let there = blocking::Domain::open(&config).unwrap();
    let rover = here.register("rover").unwrap();
    let arm = there.register("arm").unwrap();
    let arm = thread::spawn(move || {
        let first = arm.receive().unwrap();
        arm_does(&arm, &first)
    });
    rover_does(&rover);
    arm.join().unwrap()
}

fn to_arm(rover: &blocking::Agent, act: Performative) -> MessageBuilder {
    let message = rover.message(act).content("a crate");
    message.receiver(AgentId::new("arm").unwrap())
}

fn arm() -> [AgentId; 1] {
    [AgentId::new("arm").unwrap()]
}

#[test]
fn a_request_is_answered_and_another_cancelled() {
    let asked = between(
        |arm, first| {
            let mut task = arm.take_part(first).unwrap();
            task.agree("").unwrap();
            assert_eq!(text(task.message()), "a crate");
            task.reply(Reply::Inform("lifted".into())).unwrap();
            let second = arm.receive().unwrap();
            let mut task = arm.take_part(&second).unwrap();
            task.agree("").unwrap();
            let mut asked = 1;
            while !task.cancelled(Duration::from_millis(20)).unwrap() {
                asked += 1;
            }
            let nothing = task.confirm_cancel().unwrap();
            task.reply(nothing).unwrap();
            asked
        },
        |rover| {
            let lift = to_arm(rover, Performative::Request);
            let mut request = rover.request(lift.clone(), TIMEOUT).unwrap();
            assert!(request.agreed().unwrap());
            assert_eq!(text(&request.result().unwrap()), "lifted");
            let mut request = rover.request(lift, TIMEOUT).unwrap();
            assert!(!request.conversation_id().is_empty());
            assert!(request.agreed().unwrap());
            assert!(request.cancel(TIMEOUT).unwrap());
        },
    );
    assert!(asked > 0);
}

#[test]
fn query_request_when_propose_and_subscribe() {
    between(
        |arm, first| {
            let mut first = first.clone();
            for reply in [
                Reply::Inform("42".into()),
                Reply::Failure("no".into()),
                Reply::Accept("".into()),
            ] {
                let mut task = arm.take_part(&first).unwrap();
                if *first.message().performative() == Performative::RequestWhen {
                    task.agree("").unwrap();
                }
                task.reply(reply).unwrap();
                first = arm.receive().unwrap();
            }
            let mut task = arm.take_part(&first).unwrap();
            task.agree("").unwrap();
            task.inform("pose").unwrap();
            assert!(task.cancelled(TIMEOUT).unwrap());
            task.confirm_cancel().unwrap();
        },
        |rover| {
            let query = to_arm(rover, Performative::QueryRef);
            let result = rover.query(query, TIMEOUT).unwrap().result();
            assert_eq!(text(&result.unwrap()), "42");
            let when = to_arm(rover, Performative::RequestWhen);
            let result = rover.request_when(when, TIMEOUT).unwrap().result();
            assert!(matches!(result, Err(DialogueError::Failed(_))));
            let propose = to_arm(rover, Performative::Propose);
            let decided = rover.propose(propose, TIMEOUT).unwrap();
            assert!(matches!(decided, Decision::Accepted(_)));
            let subscribe = to_arm(rover, Performative::Subscribe);
            let mut poses = rover.subscribe(subscribe, TIMEOUT).unwrap();
            assert_eq!(text(&poses.next().unwrap()), "pose");
            poses.cancel(TIMEOUT).unwrap();
        },
    );
}

#[test]
fn contract_nets() {
    between(
        |arm, first| {
            let mut task = arm.take_part(first).unwrap();
            assert!(task.propose("10", TIMEOUT).unwrap());
            task.reply(Reply::Inform("done".into())).unwrap();
            let call = arm.receive().unwrap();
            let mut task = arm.take_part(&call).unwrap();
            assert!(!task.propose("10", TIMEOUT).unwrap());
            assert!(task.next_call(TIMEOUT).unwrap().is_some());
            let cancelled = task.propose("9", TIMEOUT);
            assert!(matches!(cancelled, Err(DialogueError::Cancelled(_))));
            task.confirm_cancel().unwrap();
        },
        |rover| {
            let call = || rover.message(Performative::Cfp);
            let mut net = rover.contract_net(call(), &arm(), TIMEOUT).unwrap();
            let bids = net.bids().proposals.clone();
            let results = net.award(&bids, "", TIMEOUT).unwrap();
            assert_eq!(text(results[0].result.as_ref().unwrap()), "done");
            let net = rover.iterated_contract_net(call(), &arm(), TIMEOUT);
            let mut net = net.unwrap();
            let bids = net.bids().proposals.clone();
            net.call_again(&bids, call(), TIMEOUT).unwrap();
            assert_eq!(text(&net.bids().proposals[0]), "9");
            net.cancel(TIMEOUT).unwrap();
        },
    );
}

#[test]
fn auctions() {
    let asked = between(
        |arm, first| {
            let mut task = arm.take_part(first).unwrap();
            assert!(task.next_call(TIMEOUT).unwrap().is_some());
            assert!(task.propose("", TIMEOUT).unwrap());
            assert!(task.next_call(TIMEOUT).unwrap().is_none());
            let opening = arm.receive().unwrap();
            let mut second = arm.take_part(&opening).unwrap();
            assert!(second.next_call(TIMEOUT).unwrap().is_some());
            assert!(second.propose("", TIMEOUT).unwrap());
            assert!(second.next_call(TIMEOUT).unwrap().is_none());
            text(&second.next(TIMEOUT).unwrap()).to_owned()
        },
        |rover| {
            let opening = || rover.message(Performative::Inform).content("a crate");
            let mut auction = rover.dutch_auction(opening(), &arm()).unwrap();
            let bids = auction.call("10", TIMEOUT).unwrap();
            auction.accept(&bids.proposals[0], "").unwrap();
            auction.close("").unwrap();
            let mut auction = rover.english_auction(opening(), &arm()).unwrap();
            let bids = auction.call("10", TIMEOUT).unwrap();
            auction.accept(&bids.proposals[0], "").unwrap();
            auction.close("").unwrap();
            assert_eq!(auction.leader().unwrap().name(), "arm");
            auction.ask_winner("take it").unwrap();
        },
    );
    assert_eq!(asked, "take it");
}

#[test]
fn brokering_and_recruiting() {
    between(
        |broker, first| {
            // The broker passes the query to the initiator itself.
            let query = || {
                let query = broker.message(Performative::QueryRef).content("load?");
                let query = query.protocol("fipa-query");
                query.receiver(AgentId::new("rover").unwrap())
            };
            let mut task = broker.take_part(first).unwrap();
            task.agree("").unwrap();
            let early = task.next_answer(TIMEOUT).unwrap();
            assert!(early.is_none(), "no message was passed on");
            task.inform("passed on").unwrap();
            let answer = broker.message(Performative::Confirm).build().unwrap();
            task.forward(&answer).unwrap();
            let second = broker.receive().unwrap();
            let mut task = broker.take_part(&second).unwrap();
            task.agree("").unwrap();
            task.pass_on(query(), TIMEOUT).unwrap();
            task.inform("recruited").unwrap();
        },
        |rover| {
            let proxy = || to_arm(rover, Performative::Proxy);
            let mut answers = rover.brokering(proxy(), TIMEOUT).unwrap();
            let answer = answers.next(TIMEOUT).unwrap();
            assert_eq!(*answer.performative(), Performative::Confirm);
            let answers = rover.recruiting(proxy(), TIMEOUT);
            drop(answers.unwrap());
        },
    );
}
