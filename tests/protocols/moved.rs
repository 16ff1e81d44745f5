//! An agent that moves takes its conversations along.

use std::process::id as process;

use super::*;

/// Two processes that enforce the protocols, and one that does not.
async fn three() -> [Domain; 3] {
    let unchecked = config(&[]);
    let mut enforcing = config(&["monitor.check=enforce"]);
    enforcing.domain.clone_from(&unchecked.domain);
    [
        Domain::open(&enforcing).await.unwrap(),
        Domain::open(&enforcing).await.unwrap(),
        Domain::open(&unchecked).await.unwrap(),
    ]
}

#[tokio::test(flavor = "multi_thread")]
async fn a_moved_agent_continues_its_conversations_and_is_checked() {
    let [first, second, other] = three().await;
    let rover = other.register("rover").await.unwrap();
    let arm = first.register("arm").await.unwrap();
    let id = format!("c{}", process());
    let request = to(&rover, Performative::Request, &arm, "lift").protocol("fipa-request");
    let request = request.conversation_id(id.as_str()).reply_with("q");
    rover.send(request.build().unwrap()).await.unwrap();
    let asked = next_message(&arm).await.unwrap().into_message();
    let agree = arm.reply(&asked, Performative::Agree).build().unwrap();
    assert!(arm.send(agree).await.unwrap().all_succeeded());
    // A letter that waits for the agent takes part too.
    let second_request = to(&rover, Performative::Request, &arm, "turn").protocol("fipa-request");
    let second_request = second_request.conversation_id("d").build().unwrap();
    assert!(rover.send(second_request).await.unwrap().all_succeeded());

    let mut departure = arm.depart().unwrap();
    let unread = departure.take_unread();
    let waiting = unread.into_iter().next().unwrap().into_message();
    let conversations = departure.conversations();
    let arm = second.register("arm").await.unwrap();
    // Other bytes have no effect.
    let mut changed = conversations.clone();
    changed.truncate(changed.len() - 1);
    assert!(arm.protocols().restore_conversations(&changed).is_err());
    assert!(arm.protocols().restore_conversations(b"other").is_err());
    assert_eq!(
        arm.protocols()
            .restore_conversations(&conversations)
            .unwrap(),
        2
    );

    // An illegal continuation is refused: the arm has agreed, and has not agreed to the second request.
    for (message, act, kind) in [
        (&asked, Performative::Refuse, ViolationKind::Unexpected),
        (&asked, Performative::Propose, ViolationKind::Unexpected),
        (&waiting, Performative::Propose, ViolationKind::Unexpected),
    ] {
        let sent = arm.send(arm.reply(message, act).build().unwrap()).await;
        assert!(
            matches!(&sent, Err(SendError::Violation(why)) if why.kind == kind),
            "{sent:?}"
        );
    }
    let inform = arm.reply(&asked, Performative::Inform).build().unwrap();
    assert!(arm.send(inform).await.unwrap().all_succeeded());
    let refuse = arm.reply(&waiting, Performative::Refuse).build().unwrap();
    assert!(arm.send(refuse).await.unwrap().all_succeeded());
    // The conversation is over.
    let again = arm.reply(&asked, Performative::Failure).build().unwrap();
    assert!(matches!(
        arm.send(again).await,
        Err(SendError::Violation(_))
    ));
    // An illegal message of the other side is a violation.
    let late = to(&rover, Performative::AcceptProposal, &arm, "").protocol("fipa-request");
    let late = late.conversation_id(id.as_str()).build().unwrap();
    rover.send(late).await.unwrap();
    assert!(next_message(&arm).await.unwrap().violation().is_some());
}

#[tokio::test(flavor = "multi_thread")]
async fn without_checks_there_are_no_states() {
    let (here, _) = two(&[]).await;
    let arm = here.register("arm").await.unwrap();
    let conversations = arm.depart().unwrap().conversations();
    assert!(conversations.is_empty());
    let [checked, ..] = three().await;
    let arm = checked.register("arm").await.unwrap();
    assert_eq!(
        arm.protocols()
            .restore_conversations(&conversations)
            .unwrap(),
        0
    );
}
