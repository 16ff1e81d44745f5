//! Accepted messages between two agents do not allocate once the monitor has had as many
//! conversations before.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use allocation_counter::measure;
use fipa_acl::{AgentId, Message, MessageView, Payload, Performative};
use fipa_monitor::{Header, Library, Monitor};

#[test]
fn an_allocation_is_counted() {
    assert_eq!(
        measure(|| drop(std::hint::black_box(vec![1_u8]))).count_total,
        1
    );
}

/// The encoded messages of a whole request conversation.
fn request(number: usize) -> [Payload; 3] {
    let ask = Message::builder(Performative::Request)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm_1").unwrap())
        .protocol("fipa-request")
        .conversation_id(format!("rover--lift--{number:08}"))
        .reply_with(format!("lift-{number:08}"))
        .content("lift")
        .build()
        .unwrap();
    let answer = |act| {
        let answer = ask.reply(act).sender(AgentId::new("arm_1").unwrap());
        answer.build().unwrap().to_payload()
    };
    let (agree, inform) = (answer(Performative::Agree), answer(Performative::Inform));
    [ask.to_payload(), agree, inform]
}

#[test]
fn accepted_messages_do_not_allocate() {
    let mut now = SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000);
    let mut monitor = Monitor::observer(Arc::new(Library::standard()));
    let conversations: Vec<[Payload; 3]> = (0..300).map(request).collect();
    let (early, late) = conversations.split_at(200);
    let hear = |monitor: &mut Monitor, all: &[[Payload; 3]], now| {
        for payload in all.iter().flatten() {
            let view = MessageView::parse_payload(payload).unwrap();
            assert!(monitor.check(&Header::from(&view), now).is_accepted());
        }
    };
    hear(&mut monitor, early, now);
    now += Duration::from_secs(3_600);
    monitor.handle_timeout(now);
    assert!(monitor.is_empty());
    let info = measure(|| hear(&mut monitor, late, now));
    assert_eq!(info.count_total, 0);
    assert_eq!(monitor.len(), late.len());
}
