//! Agents of legacy peers: delivery of letters to them, and failure messages about their own
//! letters.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use fipa_acl::{AgentId, Dialect, Letter, Message, Payload, Performative, Representation};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Received, Submission, Undecodable, Unframed};
use fipa_mts::{AccessGate, LetterParts, Link, letter_for};
use fipa_sds::{
    ContactDirectory, Directory, MemoryDirectory, MergedDirectory, MtsId, Registration,
    StaticDirectory,
};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Kind,
    LegacySource, Location, Outcome, Parcel, Principal, Reaction, Signature, TransportError,
    TransportErrorKind,
};

/// A recorded letter from a fipa_services agent, `cpp-sender`, to an agent `echo`.
const LETTER: &[u8] = include_bytes!("../../acl/tests/vectors/tcp_letter.bin");
/// A recorded failure message of the fipa_services service to `cpp-sender`.
const FAILURE: &[u8] = include_bytes!("../../acl/tests/vectors/failure_letter.bin");

/// Source address of that letter.
const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

/// The source of a letter from fipa_services at this address.
fn legacy(address: IpAddr) -> LegacySource {
    LegacySource {
        address,
        signature: Signature::FipaServices,
    }
}

const OLD_PEER: &str = "tcp://10.0.0.3:6789;fipa-services";

fn core(forwards: bool, knows: &[(&str, &str)]) -> Core {
    let known = knows
        .iter()
        .map(|(name, at)| (*name, vec![at.parse::<Location>().unwrap()]));
    let directory: Arc<dyn Directory> = Arc::new(StaticDirectory::new(known).unwrap());
    let config = CoreConfig {
        forwards,
        ..gateway(&[Kind::Shm, Kind::Tcp])
    };
    Core::new(config, directory.view())
}

fn gateway(kinds: &[Kind]) -> CoreConfig {
    CoreConfig {
        forwards: true,
        ..CoreConfig::new("gateway", Incarnation::from_u64(7), kinds.to_vec())
    }
}

fn now() -> Now {
    Now {
        instant: Instant::now(),
        utc: SystemTime::UNIX_EPOCH + Duration::from_secs(1 << 30),
    }
}

/// The next letter that the core dispatches.
fn dispatched(core: &mut Core) -> Option<(AttemptId, Location, Parcel)> {
    loop {
        match core.poll_action()? {
            Action::ContactSeen { .. } | Action::ContactSeenAgain { .. } | Action::Taken { .. } => {
            }
            Action::Refresh { number } => core.handle_refreshed(now(), number),
            Action::Dispatch {
                attempt,
                location,
                parcel,
            } => return Some((attempt, location, parcel)),
            other => panic!("{other:?}"),
        }
    }
}

fn message_of(parcel: &Parcel) -> Message {
    match &parcel.body {
        Body::Letter(letter) => Message::decode(letter.payload()).unwrap(),
        other => panic!("{other:?}"),
    }
}

/// The recorded letter, as the transport passes it on.
fn recorded(bytes: &'static [u8]) -> Letter {
    let (envelope, letter) = Letter::decode(Bytes::from_static(bytes)).unwrap();
    // Its extension without a stamp is not part of the standard.
    let mut envelope = envelope;
    envelope.extensions.retain(|one| one.received.is_some());
    Letter::new(
        envelope.encode_standard().unwrap(),
        letter.payload().clone(),
    )
}

fn nested(content: &[u8]) -> Message {
    let payload = Payload::from(Bytes::copy_from_slice(content));
    assert_eq!(
        Representation::detect(&payload.head),
        Some(Representation::String)
    );
    Message::decode(&payload).unwrap()
}

/// Only the beginning of such a letter arrives.
#[test]
fn the_sender_of_a_letter_that_its_transport_refuses_gets_a_failure_message() {
    let mut core = core(true, &[("cpp-sender", OLD_PEER)]);
    let letter = recorded(LETTER);
    let message = letter.payload().to_bytes();
    let cut = Letter::new(letter.envelope(), message.slice(..message.len() / 2));
    let reason = "the letter exceeds max_letter";
    let refused = Unframed::refused(cut, Kind::Udt, legacy(HERE), reason);
    core.handle_unframed(now(), Duration::from_secs(5), &mut refused.unwrap());
    let (_, location, parcel) = dispatched(&mut core).unwrap();
    assert_eq!(location.to_string(), OLD_PEER);
    let failure = message_of(&parcel);
    assert_eq!(*failure.performative(), Performative::Failure);
    assert_eq!(failure.receivers()[0].name(), "cpp-sender");
    let nested = nested(failure.content().unwrap());
    assert_eq!(nested.receivers()[0].name(), "echo");
    let text = String::from_utf8(nested.content().unwrap().to_vec()).unwrap();
    assert!(text.contains(reason), "{text}");
}

#[test]
fn the_sender_of_an_undeliverable_recorded_letter_gets_a_failure_message_in_its_dialect() {
    // Only the letter itself has the location of its sender.
    let mut core = core(true, &[]);
    core.handle_unframed(
        now(),
        Duration::from_secs(5),
        &mut read(&core, recorded(LETTER), Kind::Tcp, HERE),
    );
    let (attempt, location, parcel) = dispatched(&mut core).unwrap();
    assert_eq!(location.to_string(), "tcp://127.0.0.1:45615;fipa-services");
    let ours = message_of(&parcel);
    let theirs = Message::decode(recorded(FAILURE).payload()).unwrap();
    for message in [&ours, &theirs] {
        assert_eq!(*message.performative(), Performative::Failure);
        assert_eq!(message.receivers()[0].name(), "cpp-sender");
        assert_eq!(message.ontology(), Some("fipa-agent-management"));
        assert_eq!(message.in_reply_to(), Some("rw-1"));
        assert_eq!(message.conversation_id(), Some("conv-1"));
        let reported = nested(message.content().unwrap());
        assert_eq!(*reported.performative(), Performative::Inform);
        assert_eq!(reported.sender().unwrap().name(), "cpp-sender");
        assert_eq!(reported.receivers().len(), 1);
        assert_eq!(reported.language(), Some("internal-error"));
        let text = String::from_utf8(reported.content().unwrap().to_vec()).unwrap();
        assert!(
            text.starts_with("description: message delivery failed"),
            "{text}"
        );
        assert!(text.contains("\ndelivery path: send-mts,"), "{text}");
    }
    assert_eq!(ours.sender().unwrap().name(), "gateway");
    let reported = nested(ours.content().unwrap());
    assert_eq!(reported.receivers()[0].name(), "echo");
    let written = ours.encode(Representation::BitEfficient, Dialect::FipaServices);
    written.unwrap();

    // A failure message that cannot be delivered causes no other.
    let error = TransportError::new(TransportErrorKind::Unreachable, "gone");
    let later = Now {
        instant: now().instant + Duration::from_secs(60),
        ..now()
    };
    core.handle_conclusion(later, attempt, Conclusion::NotSent(error));
    core.handle_timeout(later);
    assert!(core.poll_action().is_none());
    assert!(!core.has_open_letters());
}

#[test]
fn each_failed_receiver_is_reported_once_and_failed_failure_messages_never() {
    let mut core = core(true, &[("old", OLD_PEER)]);
    let message = |performative| {
        Message::builder(performative)
            .sender(AgentId::new("old").unwrap())
            .receiver(AgentId::new("absent").unwrap())
            .receiver(AgentId::new("absent-else").unwrap())
            .content("x".repeat(600))
            .build()
            .unwrap()
    };
    let letter = |performative| letter_for(&message(performative), now().utc).unwrap();
    let deadline = Duration::from_secs(5);
    core.handle_unframed(
        now(),
        deadline,
        &mut read(&core, letter(Performative::Request), Kind::Tcp, HERE),
    );
    let mut reported = Vec::new();
    while let Some((_, location, parcel)) = dispatched(&mut core) {
        assert_eq!(location.to_string(), OLD_PEER);
        let content = message_of(&parcel).content().unwrap().clone();
        reported.push(nested(&content).receivers()[0].name().to_owned());
    }
    assert_eq!(reported, ["absent", "absent-else"]);
    core.handle_unframed(
        now(),
        deadline,
        &mut read(&core, letter(Performative::Failure), Kind::Tcp, HERE),
    );
    assert!(core.poll_action().is_none());
}

#[test]
fn a_location_on_another_host_than_the_source_gets_no_failure_message() {
    let mut core = core(true, &[]);
    let elsewhere = IpAddr::from([10, 0, 0, 66]);
    let deadline = Duration::from_secs(5);
    core.handle_unframed(
        now(),
        deadline,
        &mut read(&core, recorded(LETTER), Kind::Tcp, elsewhere),
    );
    assert!(core.poll_action().is_none(), "it came from {elsewhere}");
}

/// A gate that refuses all letters to agents whose names begin with this prefix.
struct Refusing(&'static str);

impl AccessGate for Refusing {
    fn read(&self, _: &Letter) -> LetterParts {
        LetterParts::default()
    }

    fn admits(&self, _: Instant, receiver: &str, _: &LetterParts, _: Link) -> Result<(), String> {
        match receiver.starts_with(self.0) {
            true => Err("a rule denies it".to_owned()),
            false => Ok(()),
        }
    }
}

#[test]
fn a_refused_sender_gets_failure_messages_in_its_dialect_at_a_limited_rate() {
    // The receiver of the recorded letter is on this host.
    let directory = MemoryDirectory::new(MtsId::new("process", Incarnation::from_u64(9)));
    let at = "shm://9#0000000000000009".parse().unwrap();
    let echo = Registration::new("echo", Incarnation::from_u64(5), vec![at]);
    directory.register(echo).unwrap();
    let mut core = Core::new(gateway(&[Kind::Shm, Kind::Tcp]), Arc::new(directory))
        .gated(Arc::new(Refusing("echo")));
    let (then, deadline) = (now(), Duration::from_secs(5));
    for _ in 0..200 {
        core.handle_unframed(
            then,
            deadline,
            &mut read(&core, recorded(LETTER), Kind::Tcp, HERE),
        );
    }
    let mut reported = 0;
    while let Some((attempt, location, parcel)) = dispatched(&mut core) {
        reported += 1;
        assert_eq!(location.to_string(), "tcp://127.0.0.1:45615;fipa-services");
        let message = message_of(&parcel);
        assert_eq!(*message.performative(), Performative::Failure);
        assert_eq!(message.receivers()[0].name(), "cpp-sender");
        assert_eq!(message.in_reply_to(), Some("rw-1"));
        let reported = nested(message.content().unwrap());
        assert_eq!(reported.receivers()[0].name(), "echo");
        let text = String::from_utf8(reported.content().unwrap().to_vec()).unwrap();
        assert!(text.contains("refused"), "{text}");
        core.handle_conclusion(then, attempt, Conclusion::Handed);
    }
    assert_eq!(reported, 20, "the limit per second");
}

/// The agents that became contacts, and their locations.
fn contacts_of(core: &mut Core) -> Vec<(String, String)> {
    let actions = std::iter::from_fn(|| core.poll_action());
    let contacts_of = actions.filter_map(|action| match action {
        Action::ContactSeen {
            name,
            agent,
            location,
            ..
        } => {
            assert!(!agent.is_known());
            Some((name, location.to_string()))
        }
        _ => None,
    });
    contacts_of.collect()
}

#[test]
fn the_sender_of_a_recorded_letter_becomes_a_contact_at_its_stated_address() {
    let host = || Core::new(gateway(&[Kind::Shm]), host_of("echo").view());
    let arrives = |core: &mut Core, letter, from| {
        let mut unframed = read(core, letter, Kind::Tcp, from);
        core.handle_unframed(now(), Duration::from_secs(5), &mut unframed);
    };
    let known = |at: &str| vec![("cpp-sender".to_owned(), at.to_owned())];
    let mut core = host();
    arrives(&mut core, recorded(LETTER), HERE);
    let at = "tcp://127.0.0.1:45615;fipa-services";
    assert_eq!(contacts_of(&mut core), known(at));

    // An address of another host is ignored.
    let mut core = host();
    arrives(&mut core, recorded(LETTER), IpAddr::from([10, 0, 0, 66]));
    assert_eq!(contacts_of(&mut core), []);

    // Without addresses in the message, those in the envelope count.
    let plain = Message::builder(Performative::Inform)
        .sender(AgentId::new("cpp-sender").unwrap())
        .receiver(AgentId::new("echo").unwrap())
        .build()
        .unwrap();
    let letter = Letter::new(recorded(LETTER).envelope(), plain.to_payload());
    arrives(&mut core, letter, HERE);
    assert_eq!(contacts_of(&mut core), known(at));
}

/// Handles a letter of each of these agents of one address.
fn written_by(core: &mut Core, then: Now, agents: std::ops::Range<u32>) {
    for number in agents {
        let name = format!("agent-{number}");
        let sender = AgentId::new(name).unwrap();
        let sender = sender.with_address("tcp://127.0.0.1:2009").unwrap();
        let message = Message::builder(Performative::Inform)
            .sender(sender)
            .receiver(AgentId::new("echo").unwrap())
            .build()
            .unwrap();
        let letter = letter_for(&message, then.utc).unwrap();
        let mut unframed = read(core, letter, Kind::Tcp, HERE);
        core.handle_unframed(then, Duration::from_secs(5), &mut unframed);
    }
}

#[test]
fn agents_become_known_by_letters_at_a_limited_rate() {
    let mut core = Core::new(gateway(&[Kind::Shm]), host_of("echo").view());
    let then = now();
    // The agents of a platform begin together.
    written_by(&mut core, then, 0..900);
    assert_eq!(contacts_of(&mut core).len(), 900);
    written_by(&mut core, then, 900..1100);
    assert_eq!(contacts_of(&mut core).len(), 100);
    let later = Now {
        instant: then.instant + Duration::from_secs(1),
        ..then
    };
    written_by(&mut core, later, 1100..1200);
    assert_eq!(contacts_of(&mut core).len(), 50);
}

#[test]
fn an_agent_that_became_known_by_a_letter_keeps_its_name_until_it_is_silent() {
    let contacts = Arc::new(ContactDirectory::new());
    let both = vec![host_of("echo"), Arc::clone(&contacts) as Arc<dyn Directory>];
    let mut core = Core::new(gateway(&[Kind::Shm]), Arc::new(MergedDirectory::new(both)));
    let start = Now {
        instant: Instant::now(),
        utc: SystemTime::now(),
    };
    let elsewhere = IpAddr::from([10, 0, 0, 66]);
    let mut writes = |seconds, from: IpAddr, port: u16| {
        let sender = AgentId::new("cpp-sender").unwrap();
        let at = format!("tcp://{from}:{port}");
        let message = Message::builder(Performative::Inform)
            .sender(sender.with_address(&at).unwrap())
            .receiver(AgentId::new("echo").unwrap())
            .build()
            .unwrap();
        let letter = letter_for(&message, start.utc).unwrap();
        let since = Duration::from_secs(seconds);
        let then = Now {
            instant: start.instant + since,
            utc: start.utc + since,
        };
        let mut unframed = read(&core, letter, Kind::Tcp, from);
        core.handle_unframed(then, Duration::from_secs(5), &mut unframed);
        let action = std::iter::from_fn(|| core.poll_action()).find_map(|action| match action {
            Action::ContactSeen {
                name,
                agent,
                location,
                ..
            } => {
                let contacts_of = contacts.record_sender(then.instant, &name, agent, location);
                Some(if contacts_of.is_ok() {
                    "known"
                } else {
                    "refused"
                })
            }
            Action::ContactSeenAgain { name } => {
                contacts.record_further_letter(then.instant, &name);
                Some("heard again")
            }
            _ => None,
        });
        action.unwrap_or("ignored")
    };
    assert_eq!(writes(0, HERE, 3000), "known");
    assert_eq!(writes(50, HERE, 3000), "heard again");
    assert_eq!(writes(100, elsewhere, 3000), "refused");
    assert_eq!(writes(101, HERE, 2000), "known", "its location has changed");
    assert_eq!(writes(160, elsewhere, 3000), "refused");
    let at = || contacts.lookup("cpp-sender").unwrap().locations[0].to_string();
    assert_eq!(at(), "tcp://127.0.0.1:2000;fipa-services");
    // It has been silent for a minute.
    assert_eq!(writes(161, elsewhere, 3000), "known");
    assert_eq!(at(), "tcp://10.0.0.66:3000;fipa-services");
}

/// A letter with a truncated message.
fn without_end(letter: &Letter) -> Letter {
    let payload = letter.payload().to_bytes();
    Letter::new(letter.envelope(), payload.slice(..payload.len() - 3))
}

#[test]
fn the_sender_of_a_recorded_letter_that_cannot_be_decoded_gets_a_failure_message() {
    let mut core = Core::new(gateway(&[Kind::Shm, Kind::Tcp]), host_of("echo").view());
    let letter = without_end(&recorded(LETTER));
    let deadline = Duration::from_secs(5);
    let mut unframed = read(&core, letter.clone(), Kind::Tcp, HERE);
    core.handle_unframed(now(), deadline, &mut unframed);
    let (_, location, parcel) = dispatched(&mut core).unwrap();
    // The envelope has the location of the sender, which other letters have in the message.
    assert_eq!(location.to_string(), "tcp://127.0.0.1:45615;fipa-services");
    let failure = message_of(&parcel);
    assert_eq!(*failure.performative(), Performative::Failure);
    assert_eq!(failure.receivers()[0].name(), "cpp-sender");
    let reported = nested(failure.content().unwrap());
    assert_eq!(reported.receivers()[0].name(), "echo");
    let text = String::from_utf8(reported.content().unwrap().to_vec()).unwrap();
    let expected = "description: message delivery failed: refused: the message cannot be decoded: ";
    assert!(text.starts_with(expected), "{text}");
    assert_eq!(text.lines().count(), 2, "{text}");
    // The letter is not delivered to the agent.
    assert!(core.poll_action().is_none());

    // An address of another host is ignored.
    let mut unframed = read(&core, letter, Kind::Tcp, IpAddr::from([10, 0, 0, 66]));
    core.handle_unframed(now(), deadline, &mut unframed);
    assert!(core.poll_action().is_none());
}

#[test]
fn the_sender_of_a_framed_letter_that_cannot_be_decoded_gets_a_failure_message() {
    let mut core = Core::new(
        CoreConfig::new("process", Incarnation::from_u64(7), vec![Kind::Shm]),
        host_of("rover").view(),
    );
    let rover = Incarnation::from_u64(5);
    let arm: Arc<str> = "arm".into();
    core.register(Arc::clone(&arm), Incarnation::from_u64(6));
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content("x")
        .build()
        .unwrap();
    let received = |sender| Received {
        letter: without_end(&letter_for(&message, now().utc).unwrap()),
        sender,
        via: Some(Kind::Shm),
        service: Incarnation::UNKNOWN,
        peer: fipa_transport::PeerId::THIS_HOST,
        remote: false,
    };
    let read = |received: &Received| Undecodable::read(received, &"for a test").unwrap();
    core.handle_undecodable(now(), &arm, read(&received(rover)));
    let (_, location, parcel) = dispatched(&mut core).unwrap();
    assert_eq!(location.kind(), Kind::Shm);
    assert_eq!(&*parcel.receiver, "rover");
    let failure = message_of(&parcel);
    assert_eq!(*failure.performative(), Performative::Failure);
    let reported = String::from_utf8(failure.content().unwrap().to_vec()).unwrap();
    assert!(reported.contains("refused: the message cannot be decoded: for a test"));

    // A letter of another agent under this name causes no failure message.
    let other = received(Incarnation::from_u64(66));
    core.handle_undecodable(now(), &arm, read(&other));
    assert!(core.poll_action().is_none());
}

/// The directory of a host on which one agent is registered.
fn host_of(agent: &str) -> Arc<dyn Directory> {
    let directory = MemoryDirectory::new(MtsId::new("process", Incarnation::from_u64(9)));
    let at = "shm://9#0000000000000009".parse().unwrap();
    let agent = Registration::new(agent, Incarnation::from_u64(5), vec![at]);
    directory.register(agent).unwrap();
    Arc::new(directory)
}

/// The recorded letter to an agent with another name, as the C++ library encodes it.
fn recorded_to(receiver: &str) -> Letter {
    let (mut envelope, letter) = Letter::decode(Bytes::from_static(LETTER)).unwrap();
    envelope.extensions.clear();
    envelope.base.to = vec![AgentId::new(receiver).unwrap()];
    envelope.base.intended_receivers = envelope.base.to.clone();
    let payload = letter.payload().clone();
    Letter::new(envelope.encode_standard().unwrap(), payload)
}

#[test]
fn letters_of_a_legacy_peer_wait_for_a_receiver_that_stands_still() {
    const LETTERS: usize = 5000;
    let mut core = Core::new(gateway(&[Kind::Shm, Kind::Tcp]), host_of("echo").view());
    let begun = now();
    let deadline = Duration::from_secs(60);
    let mut under_way = Vec::new();
    for number in 0..LETTERS {
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new("cpp-sender").unwrap())
            .receiver(AgentId::new("echo").unwrap())
            .content(number.to_string())
            .build()
            .unwrap();
        let letter = letter_for(&message, begun.utc).unwrap();
        let mut unframed = read(&core, letter, Kind::Tcp, HERE);
        core.handle_unframed(begun, deadline, &mut unframed);
        under_way.extend(std::iter::from_fn(|| dispatched(&mut core)));
    }
    // The receiver goes on.
    let mut taken = Vec::new();
    while !under_way.is_empty() {
        for (attempt, location, parcel) in std::mem::take(&mut under_way) {
            assert_eq!(location.kind(), Kind::Shm);
            let content = message_of(&parcel).content().unwrap().to_vec();
            taken.push(
                String::from_utf8(content)
                    .unwrap()
                    .parse::<usize>()
                    .unwrap(),
            );
            let accepted = Conclusion::Answered(Answer::Accepted);
            core.handle_conclusion(begun, attempt, accepted);
            under_way.extend(std::iter::from_fn(|| dispatched(&mut core)));
        }
    }
    assert_eq!(taken, (0..LETTERS).collect::<Vec<_>>());
    assert!(!core.has_open_letters());
}

#[test]
fn a_name_with_a_dot_is_reached_as_legacy_peers_write_it() {
    let mut core = Core::new(gateway(&[Kind::Shm]), host_of("arm.left").view());
    let deadline = Duration::from_secs(5);
    core.handle_unframed(
        now(),
        deadline,
        &mut read(&core, recorded_to("arm?left"), Kind::Tcp, HERE),
    );
    let (_, location, parcel) = dispatched(&mut core).unwrap();
    assert_eq!(location.kind(), Kind::Shm);
    assert_eq!(&*parcel.receiver, "arm.left");
    assert!(core.poll_action().is_none());
}

#[test]
fn a_sender_whose_letters_all_fail_does_not_use_up_the_limit_of_another() {
    let mut core = core(true, &[]);
    let deadline = Duration::from_secs(5);
    let letter_of = |name: &str| {
        let at = format!("tcp://127.0.0.1:{}", 2000 + name.len());
        let sender = AgentId::new(name).unwrap().with_address(&at).unwrap();
        let message = Message::builder(Performative::Inform)
            .sender(sender)
            .receiver(AgentId::new("absent").unwrap())
            .build()
            .unwrap();
        letter_for(&message, now().utc).unwrap()
    };
    let then = now();
    let reported = |core: &mut Core, name: &str| {
        let mut unframed = read(core, letter_of(name), Kind::Tcp, HERE);
        core.handle_unframed(then, deadline, &mut unframed);
        dispatched(core).is_some_and(|(attempt, _, parcel)| {
            assert_eq!(&*parcel.receiver, name);
            core.handle_conclusion(then, attempt, Conclusion::Handed);
            true
        })
    };
    let loud = (0..200).filter(|_| reported(&mut core, "loud")).count();
    assert_eq!(loud, 20);
    assert!(reported(&mut core, "quiet"));
}

/// The receivers that failure messages name after a letter to these receivers.
fn told_of(core: &mut Core, receivers: &[String]) -> Vec<String> {
    let mut message = Message::builder(Performative::Request).sender(AgentId::new("old").unwrap());
    for receiver in receivers {
        message = message.receiver(AgentId::new(receiver).unwrap());
    }
    let letter = letter_for(&message.build().unwrap(), now().utc).unwrap();
    let mut unframed = read(core, letter, Kind::Tcp, HERE);
    while !unframed.is_handled() {
        core.handle_unframed(now(), Duration::from_secs(5), &mut unframed);
    }
    let mut reported = Vec::new();
    while let Some((_, _, parcel)) = dispatched(core) {
        let content = message_of(&parcel).content().unwrap().clone();
        reported.push(nested(&content).receivers()[0].name().to_owned());
    }
    reported
}

#[test]
fn a_letter_to_too_many_receivers_or_patterns_is_refused_as_a_whole() {
    let names =
        |count: usize| -> Vec<String> { (0..count).map(|it| format!("absent-{it}")).collect() };
    let patterns =
        |count: usize| -> Vec<String> { (0..count).map(|it| format!("absent{{{it}}}")).collect() };
    for refused in [names(65), names(20_000), patterns(2), patterns(1_000)] {
        let mut core = core(true, &[("old", OLD_PEER)]);
        assert_eq!(told_of(&mut core, &refused), [refused[0].clone()]);
    }
    let long = format!("absent-{}.*", "x".repeat(120));
    let mut one = core(true, &[("old", OLD_PEER)]);
    assert_eq!(told_of(&mut one, std::slice::from_ref(&long)), [long]);

    // An allowed letter reaches its receivers. The sender gets failure messages about the others,
    // but no more bytes than it has sent.
    let mut core = core(true, &[("old", OLD_PEER), ("other.x", OLD_PEER)]);
    let reported = told_of(&mut core, &names(64));
    assert!((1..10).contains(&reported.len()), "{reported:?}");
}

#[test]
fn a_letter_to_a_legacy_peers_agent_is_sent_not_delivered() {
    // The sender's process uses the gateway's location, and the gateway the peer's own.
    let near = "tcp://10.0.0.1:7788#0000000000000007";
    let (mut process, mut gateway) = (
        core(false, &[("old", near)]),
        core(true, &[("old", OLD_PEER)]),
    );
    let rover = Incarnation::from_u64(1);
    process.register("rover".into(), rover);
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("old").unwrap())
        .content("hello")
        .build()
        .unwrap();
    let (_, outcomes) = process.submit(
        now(),
        Submission {
            sender: rover,
            letter: letter_for(&message, now().utc).unwrap(),
            receivers: vec!["old".into()],
            deadline: Duration::from_secs(5),
        },
    );
    assert_eq!(outcomes, Some(1));
    let (sent, to, parcel) = dispatched(&mut process).unwrap();
    assert_eq!(to.to_string(), near);

    let back: Location = "shm://1#0000000000000001".parse().unwrap();
    let arrival = Arrival {
        parcel,
        from: Hop {
            location: back,
            principal: Principal::Host,
        },
        ticket: None,
    };
    let verdict = gateway.handle_arrival(now(), Kind::Shm, arrival);
    assert_eq!(verdict, Reaction::Now(Answer::Custody));
    process.handle_conclusion(now(), sent, Conclusion::Answered(Answer::Custody));
    let (handed, to, parcel) = dispatched(&mut gateway).unwrap();
    assert_eq!(to.to_string(), OLD_PEER);
    assert_eq!(message_of(&parcel).content().unwrap(), "hello");

    gateway.handle_conclusion(now(), handed, Conclusion::Handed);
    let (_, _, report) = dispatched(&mut gateway).unwrap();
    let arrival = Arrival {
        parcel: report,
        from: Hop {
            location: near.parse().unwrap(),
            principal: Principal::Host,
        },
        ticket: None,
    };
    process.handle_arrival(now(), Kind::Shm, arrival);
    match process.poll_action() {
        Some(Action::Outcome { outcome, .. }) => {
            assert!(
                matches!(outcome, Outcome::Sent { via: Kind::Tcp, .. }),
                "{outcome}"
            );
        }
        other => panic!("{other:?}"),
    }
    assert!(process.poll_action().is_none());
}

#[test]
fn letters_to_an_unreachable_legacy_peer_fail_like_others() {
    let mut core = core(false, &[("old", OLD_PEER)]);
    let rover = Incarnation::from_u64(1);
    core.register("rover".into(), rover);
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("old").unwrap())
        .build()
        .unwrap();
    let start = now();
    core.submit(
        start,
        Submission {
            sender: rover,
            letter: letter_for(&message, start.utc).unwrap(),
            receivers: vec!["old".into()],
            deadline: Duration::from_secs(1),
        },
    );
    let (attempt, _, _) = dispatched(&mut core).unwrap();
    let error = TransportError::new(TransportErrorKind::Unreachable, "connection refused");
    core.handle_conclusion(start, attempt, Conclusion::NotSent(error));
    let over = Now {
        instant: start.instant + Duration::from_secs(1),
        ..start
    };
    core.handle_timeout(over);
    match core.poll_action() {
        Some(Action::Outcome {
            outcome: Outcome::Failed { reason, attempts },
            ..
        }) => {
            assert_eq!(reason, FailureReason::Unreachable);
            assert_eq!(attempts.len(), 1);
        }
        other => panic!("{other:?}"),
    }
    // The agent gets a failure message in its own process, in FIPA SL.
    let reported = core.take(rover).unwrap();
    let reported = Message::decode(reported.letter.payload()).unwrap();
    assert_eq!(*reported.performative(), Performative::Failure);
    assert_eq!(reported.language(), Some("fipa-sl"));
}

/// Parses the letter for this core.
fn read(core: &Core, letter: Letter, via: Kind, from: IpAddr) -> Unframed {
    Unframed::read(letter, via, legacy(from), &**core.view()).unwrap()
}

/// A letter of `cpp-sender` with this content.
fn letter_to(receiver: &str, content: &str) -> Letter {
    let content = content.to_owned();
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("cpp-sender").unwrap())
        .receiver(AgentId::new(receiver).unwrap())
        .content(content)
        .build()
        .unwrap();
    letter_for(&message, now().utc).unwrap()
}

/// The directory of a host with these agents, and `cpp-sender` at its own address.
fn host_of_all(agents: &[&str]) -> Arc<dyn Directory> {
    let here = MemoryDirectory::new(MtsId::new("process", Incarnation::from_u64(9)));
    for (number, agent) in (5..).zip(agents) {
        let at = "shm://9#0000000000000009".parse().unwrap();
        let agent = Registration::new(*agent, Incarnation::from_u64(number), vec![at]);
        here.register(agent).unwrap();
    }
    let there = [("cpp-sender", vec![OLD_PEER.parse::<Location>().unwrap()])];
    let there = StaticDirectory::new(there).unwrap();
    Arc::new(MergedDirectory::new(vec![Arc::new(here), Arc::new(there)]))
}

fn content_of(parcel: &Parcel) -> String {
    let content = message_of(parcel).content().unwrap().to_vec();
    String::from_utf8(content).unwrap()
}

#[test]
fn letters_beyond_the_share_of_a_receiver_wait_and_those_for_others_pass() {
    const LETTERS: usize = 40_000;
    let mut core = Core::new(
        gateway(&[Kind::Shm, Kind::Tcp]),
        host_of_all(&["echo", "quick"]).view(),
    );
    let begun = now();
    let deadline = Duration::from_secs(60);
    let arrives = |core: &mut Core, letter: Letter| {
        let mut unframed = read(core, letter, Kind::Tcp, HERE);
        core.handle_unframed(begun, deadline, &mut unframed);
    };
    let mut under_way = Vec::new();
    for number in 0..LETTERS {
        arrives(&mut core, letter_to("echo", &number.to_string()));
        under_way.extend(std::iter::from_fn(|| dispatched(&mut core)));
    }
    // The receiver stands still. A letter for another agent arrives.
    arrives(&mut core, letter_to("quick", "at once"));
    let (attempt, _, parcel) = dispatched(&mut core).unwrap();
    assert_eq!(content_of(&parcel), "at once");
    core.handle_conclusion(begun, attempt, Conclusion::Answered(Answer::Accepted));
    // The receiver goes on.
    let mut taken = Vec::new();
    while !under_way.is_empty() {
        for (attempt, location, parcel) in std::mem::take(&mut under_way) {
            assert_eq!(location.kind(), Kind::Shm, "{}", content_of(&parcel));
            taken.push(content_of(&parcel).parse::<usize>().unwrap());
            core.handle_conclusion(begun, attempt, Conclusion::Answered(Answer::Accepted));
            under_way.extend(std::iter::from_fn(|| dispatched(&mut core)));
        }
    }
    assert_eq!(taken, (0..LETTERS).collect::<Vec<_>>());
    assert!(!core.has_open_letters());
}

/// A gateway with the agent `echo` and a mebibyte for letters in custody.
fn core_with_a_mebibyte() -> Core {
    let config = CoreConfig {
        custody_bytes: 1 << 20,
        ..gateway(&[Kind::Shm, Kind::Tcp])
    };
    Core::new(config, host_of_all(&["echo"]).view())
}

#[test]
fn letters_beyond_the_share_of_an_address_fail_and_those_of_another_wait() {
    let mut core = core_with_a_mebibyte();
    let begun = now();
    let deadline = Duration::from_secs(60);
    let failed_of = |core: &mut Core, address: IpAddr, letters: usize| {
        let mut failed = Vec::new();
        for number in 0..letters {
            let mut unframed = read(
                core,
                letter_to("echo", &number.to_string()),
                Kind::Tcp,
                address,
            );
            core.handle_unframed(begun, deadline, &mut unframed);
            while let Some((attempt, location, _)) = dispatched(core) {
                if location.kind() == Kind::Tcp {
                    failed.push(number);
                    core.handle_conclusion(begun, attempt, Conclusion::Handed);
                }
            }
        }
        failed
    };
    // A third of the mebibyte in the lane, and a quarter of it beyond.
    let loud = failed_of(&mut core, IpAddr::from([10, 0, 0, 3]), 1000);
    let first = *loud.first().unwrap();
    assert!((380..=400).contains(&first), "{first}");
    // The sender gets a failure message for each of the first ones.
    assert_eq!(loud, (first..first + 20).collect::<Vec<_>>());
    let other = failed_of(&mut core, IpAddr::from([10, 0, 0, 4]), 100);
    assert_eq!(other, Vec::<usize>::new());
}

#[test]
fn letters_that_wait_for_a_receiver_fail_at_their_deadline() {
    let mut core = core_with_a_mebibyte();
    let begun = now();
    for number in 0..300 {
        let mut unframed = read(
            &core,
            letter_to("echo", &number.to_string()),
            Kind::Tcp,
            HERE,
        );
        core.handle_unframed(begun, Duration::from_secs(5), &mut unframed);
        while let Some((_, location, _)) = dispatched(&mut core) {
            assert_eq!(location.kind(), Kind::Shm);
        }
    }
    assert!(core.has_open_letters());
    // A letter of the gateway itself does not go before those that wait.
    let own = Submission {
        sender: Incarnation::from_u64(7),
        letter: letter_to("echo", "own"),
        receivers: vec!["echo".into()],
        deadline: Duration::from_secs(5),
    };
    core.submit(begun, own);
    let outcome = std::iter::from_fn(|| core.poll_action()).find_map(|action| match action {
        Action::Outcome { outcome, .. } => Some(outcome),
        _ => None,
    });
    let full = FailureReason::QueueFull;
    assert!(
        matches!(&outcome, Some(Outcome::Failed { reason, .. }) if *reason == full),
        "{outcome:?}"
    );
    let mut reported = Vec::new();
    let mut time = begun;
    while core.has_open_letters() {
        time.instant = core.poll_timeout().unwrap().max(time.instant);
        core.handle_timeout(time);
        while let Some(action) = core.poll_action() {
            match action {
                Action::Dispatch {
                    attempt,
                    location,
                    parcel,
                } if location.kind() == Kind::Tcp => {
                    let failure = message_of(&parcel);
                    reported.push(nested(failure.content().unwrap()));
                    core.handle_conclusion(time, attempt, Conclusion::Handed);
                }
                Action::Abandon { attempt, error, .. } => {
                    core.handle_conclusion(time, attempt, Conclusion::NotSent(error));
                }
                Action::Refresh { number } => core.handle_refreshed(time, number),
                _ => {}
            }
        }
        assert!(time.instant < begun.instant + Duration::from_secs(7));
    }
    assert!(reported.len() >= 20);
}

#[test]
fn failure_messages_beyond_the_rate_of_a_sender_are_one_summary() {
    const LETTERS: usize = 500;
    let mut core = core(true, &[("cpp-sender", OLD_PEER)]);
    let begun = now();
    let mut reported = Vec::new();
    for number in 0..LETTERS {
        let letter = letter_to("absent", &number.to_string());
        let mut unframed = read(&core, letter, Kind::Tcp, HERE);
        core.handle_unframed(begun, Duration::from_secs(5), &mut unframed);
        while let Some((attempt, _, parcel)) = dispatched(&mut core) {
            reported.push(content_of(&parcel));
            core.handle_conclusion(begun, attempt, Conclusion::Handed);
        }
    }
    assert_eq!(reported.len(), 20);
    assert!(!reported[19].contains("more letters"), "{}", reported[19]);
    let later = Now {
        instant: core.poll_timeout().unwrap(),
        ..begun
    };
    assert!(later.instant <= begun.instant + Duration::from_secs(1));
    core.handle_timeout(later);
    let (attempt, _, parcel) = dispatched(&mut core).unwrap();
    let text = content_of(&parcel);
    let expected = format!(
        "no such agent (and {} more letters were not delivered)",
        LETTERS - 21
    );
    assert!(text.contains(&expected), "{text}");
    core.handle_conclusion(later, attempt, Conclusion::Handed);
    assert!(dispatched(&mut core).is_none());
}
