//! Messages of conversations that the monitor of an agent does not know, receivers that stand for several
//! agents, and messages that were not delivered.

use fipa::RegisterOptions;
use fipa::monitor::History;

use super::*;

/// A process that checks messages, and one of the same domain that does not.
async fn checked_and_not(set: &[&str]) -> (Domain, Domain) {
    let unchecked = config(&[]);
    let mut checked = config(&[&["monitor.check=enforce"], set].concat());
    checked.domain.clone_from(&unchecked.domain);
    (
        Domain::open(&checked).await.unwrap(),
        Domain::open(&unchecked).await.unwrap(),
    )
}

fn answer(from: &Agent, receiver: &Agent, id: &str) -> Message {
    let inform = to(from, Performative::Inform, receiver, "").protocol("fipa-request");
    inform.conversation_id(id).build().unwrap()
}

/// Sends a message and returns the violation that its receiver finds.
async fn violation(from: &Agent, message: Message, receiver: &Agent) -> Option<ViolationKind> {
    from.send(message).await.unwrap();
    let received = next_message(receiver).await.unwrap();
    received.violation().map(|violation| violation.kind)
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unsolicited_answer_is_a_violation_if_its_conversation_cannot_have_begun() {
    let (here, there) = checked_and_not(&[]).await;
    let arm = there.register("arm").await.unwrap();
    let rover = here.register("rover").await.unwrap();
    let mallory = there.register("mallory").await.unwrap();
    let unsolicited = Some(ViolationKind::Unsolicited);
    let found = violation(&mallory, answer(&mallory, &rover, "c"), &rover).await;
    assert_eq!(found, unsolicited);
    // An earlier registration of the rover may have asked the arm.
    assert_eq!(
        violation(&arm, answer(&arm, &rover, "d"), &rover).await,
        None
    );
    // No earlier registration can have chosen the ids of this one.
    let next = rover.unique_id();
    let found = violation(&arm, answer(&arm, &rover, &next), &rover).await;
    assert_eq!(found, unsolicited);
    // Another agent names the rover in a `reply-to`.
    rover.protocols().expect_conversation("e");
    let designated = answer(&mallory, &rover, "e");
    assert_eq!(violation(&mallory, designated, &rover).await, None);
    // The rover restores its conversations.
    rover.protocols().set_history(History::Unknown);
    let restored = answer(&mallory, &rover, "f");
    assert_eq!(violation(&mallory, restored, &rover).await, None);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restarted_agent_may_continue_conversations_of_its_earlier_registration() {
    let (here, there) = checked_and_not(&[]).await;
    let rover = there.register("rover").await.unwrap();
    let arm = here.register("arm").await.unwrap();
    let mut request = to(&rover, Performative::Request, &arm, "lift").protocol("fipa-request");
    request = request.conversation_id("c");
    rover.send(request.build().unwrap()).await.unwrap();
    let asked = next_message(&arm).await.unwrap().into_message();
    arm.deregister().unwrap();
    let arm = here.register("arm").await.unwrap();
    let inform = arm.reply(&asked, Performative::Inform).build().unwrap();
    assert!(arm.send(inform).await.unwrap().all_succeeded());
    // Not with an agent that was registered later.
    let leg = there.register("leg").await.unwrap();
    let to_leg = arm.send(answer(&arm, &leg, "d")).await;
    assert!(
        matches!(&to_leg, Err(SendError::Violation(why)) if why.kind == ViolationKind::NotOpened),
        "{to_leg:?}"
    );
    // The conversations of an agent with a new name begin with it.
    let other = here.register("other").await.unwrap();
    other.protocols().set_history(History::Complete);
    let to_rover = other.send(answer(&other, &rover, "e")).await;
    assert!(
        matches!(to_rover, Err(SendError::Violation(_))),
        "{to_rover:?}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_without_a_conversation_id_and_misspelled_protocols_are_violations() {
    let (here, there) = checked_and_not(&["monitor.exempt=[\"fipa-query\"]"]).await;
    let arm = there.register("arm").await.unwrap();
    let rover = here.register("rover").await.unwrap();
    let message = |protocol: &str, id: Option<&str>| {
        let message = to(&arm, Performative::Request, &rover, "").protocol(protocol);
        match id {
            Some(id) => message.conversation_id(id),
            None => message,
        }
    };
    for (protocol, id, expected) in [
        ("fipa-request", None, Some(ViolationKind::NoConversation)),
        ("fipa-reqest", Some("c"), Some(ViolationKind::Misspelled)),
        ("fipa-query", None, None),
        ("fipa-qery", Some("d"), None),
        ("dance", None, None),
    ] {
        let message = message(protocol, id).build().unwrap();
        let found = violation(&arm, message, &rover).await;
        assert_eq!(found, expected, "{protocol}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn members_of_coalitions_and_patterns_answer_a_call_of_an_enforcing_agent() {
    let (here, there) = two(&["monitor.check=enforce"]).await;
    let rover = here.register("rover").await.unwrap();
    let arms = registered(&there, ["arm_1", "arm_2"]).await;
    let options = RegisterOptions::default;
    let members = ["rover", "arm_1", "arm_2"];
    let _platoon = here
        .form("platoon", members, None, options())
        .await
        .unwrap();
    let _led = here
        .form("led", members, Some("arm_2"), options())
        .await
        .unwrap();
    let calls: [(&[&str], usize); 4] = [
        (&["platoon"], 2),
        (&["led"], 1),
        (&["arm_.*"], 2),
        (&["platoon", "arm_1", "arm_.*"], 2),
    ];
    for (number, (receivers, count)) in calls.into_iter().enumerate() {
        let mut call = rover
            .message(Performative::Cfp)
            .protocol("fipa-contract-net");
        for receiver in receivers {
            call = call.receiver(AgentId::new(*receiver).unwrap());
        }
        let call = call.conversation_id(format!("c{number}")).reply_with("w");
        rover.send(call.build().unwrap()).await.unwrap();
        let called = match receivers[0] {
            "led" => &arms[1..],
            _ => &arms[..],
        };
        assert_eq!(called.len(), count);
        for arm in called {
            let call = next_message(arm).await.unwrap();
            assert_eq!(call.violation(), None, "{receivers:?}");
            let bid = arm.reply(call.message(), Performative::Propose);
            arm.send(bid.build().unwrap()).await.unwrap();
            let bid = next_message(&rover).await.unwrap();
            assert_eq!(bid.violation(), None, "{receivers:?}");
            let accept = rover.reply(bid.message(), Performative::AcceptProposal);
            rover.send(accept.build().unwrap()).await.unwrap();
            let accepted = next_message(arm).await.unwrap();
            assert_eq!(accepted.violation(), None, "{receivers:?}");
        }
        // Copies that the message also names by another name.
        for arm in called {
            while arm.try_receive().unwrap().is_some() {}
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_that_was_not_delivered_can_be_sent_again() {
    let (here, there) = checked_and_not(&[]).await;
    let rover = here.register("rover").await.unwrap();
    let receiver = AgentId::new("arm").unwrap();
    let request = rover.message(Performative::Request).receiver(receiver);
    let request = request.protocol("fipa-request").conversation_id("c");
    let request = request.reply_with("w").build().unwrap();
    let lost = rover.send(request.clone()).await.unwrap();
    assert!(!lost.all_succeeded());
    let arm = there.register("arm").await.unwrap();
    let sent = rover.send(request.clone()).await.unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    let agree = next_message(&arm).await.unwrap().into_message();
    let agree = arm.reply(&agree, Performative::Agree).build().unwrap();
    arm.send(agree).await.unwrap();
    // The message transport service has reported the first attempt, too.
    let agreed = loop {
        let received = next_message(&rover).await.unwrap();
        if *received.message().performative() == Performative::Agree {
            break received;
        }
    };
    assert_eq!(agreed.violation(), None);
    // A delivered message cannot be sent again.
    let again = rover.send(request).await;
    assert!(matches!(again, Err(SendError::Violation(_))), "{again:?}");
}
