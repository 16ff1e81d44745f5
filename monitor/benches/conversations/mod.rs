//! Open conversations, for the benches of the monitor.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_monitor::{Header, Library, Monitor, MonitorLimits};

pub(crate) fn now() -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000)
}

pub(crate) fn id(number: usize) -> String {
    format!("9f0a1c2e-5b7d-4e21-8c3f-{number:012}")
}

pub(crate) fn message(
    act: Performative,
    from: &str,
    to: &str,
    protocol: &str,
    id: String,
) -> Message {
    Message::builder(act)
        .sender(AgentId::new(from).unwrap())
        .receiver(AgentId::new(to).unwrap())
        .protocol(protocol)
        .conversation_id(id)
        .build()
        .unwrap()
}

/// The rover and the arm of a conversation.
fn agents(number: usize) -> [String; 2] {
    [
        format!("rover_{}", number % 50),
        format!("arm_{}", number % 70),
    ]
}

/// A message of the arm of a conversation to its rover.
pub(crate) fn answer(act: Performative, protocol: &str, number: usize) -> Message {
    let [rover, arm] = agents(number);
    message(act, &arm, &rover, protocol, id(number))
}

/// A monitor with open subscriptions, and a further message of each.
pub(crate) fn with_open(count: usize) -> (Monitor, Vec<Message>) {
    let mut limits = MonitorLimits::default();
    limits.conversations = 2_000_000;
    limits.bytes = usize::MAX;
    let library = Arc::new(Library::standard());
    let mut monitor = Monitor::observer(library).with_limits(limits);
    let mut informs = Vec::new();
    for number in 0..count {
        let [rover, arm] = agents(number);
        let protocol = "fipa-subscribe";
        let ask = message(Performative::Subscribe, &rover, &arm, protocol, id(number));
        let agree = answer(Performative::Agree, protocol, number);
        for said in [&ask, &agree] {
            assert!(monitor.check(&Header::from(said), now()).is_accepted());
        }
        informs.push(answer(Performative::Inform, protocol, number));
    }
    (monitor, informs)
}
