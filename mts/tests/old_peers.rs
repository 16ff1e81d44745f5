//! Agents of old peers: how letters get to them, and what they are told of letters of theirs that
//! did not arrive.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use fipa_acl::{AgentId, Dialect, Letter, Message, Payload, Performative, Representation};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::{Gate, Link, letter_for};
use fipa_sds::{Directory, MemoryDirectory, Mts, Registration, StaticDirectory};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Kind, Location,
    Outcome, Parcel, Ticket, Verdict, WayError, WayFault,
};

/// What a fipa_services agent, `cpp-sender`, sent to an agent `echo`.
const LETTER: &[u8] = include_bytes!("../../acl/tests/vectors/tcp_letter.bin");
/// What the service of fipa_services told `cpp-sender` of a letter that failed.
const FAILURE: &[u8] = include_bytes!("../../acl/tests/vectors/failure_letter.bin");

/// Where that letter came from.
const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

const OLD_PEER: &str = "tcp://10.0.0.3:6789;fipa-services";

fn core(forwards: bool, knows: &[(&str, &str)]) -> Core {
    let known = knows
        .iter()
        .map(|(name, at)| (*name, vec![at.parse::<Location>().unwrap()]));
    let directory: Arc<dyn Directory> = Arc::new(StaticDirectory::new(known).unwrap());
    let config = CoreConfig {
        forwards,
        ..CoreConfig::new(
            "gateway",
            Incarnation::from_u64(7),
            vec![Kind::Shm, Kind::Tcp],
        )
    };
    Core::new(config, directory)
}

fn now() -> Now {
    Now {
        instant: Instant::now(),
        utc: SystemTime::UNIX_EPOCH + Duration::from_secs(1 << 30),
    }
}

/// The next letter that the core wants sent.
fn dispatched(core: &mut Core) -> Option<(AttemptId, Location, Parcel)> {
    match core.poll_action()? {
        Action::Dispatch {
            attempt,
            location,
            parcel,
        } => Some((attempt, location, parcel)),
        other => panic!("{other:?}"),
    }
}

fn message_of(parcel: &Parcel) -> Message {
    match &parcel.body {
        Body::Letter(letter) => Message::decode(letter.payload()).unwrap(),
        other => panic!("{other:?}"),
    }
}

/// The recorded letter, as the transport hands it on.
fn recorded(bytes: &'static [u8]) -> Letter {
    let (envelope, letter) = Letter::decode(Bytes::from_static(bytes)).unwrap();
    // Its extension without a stamp is no part of the standard's.
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

#[test]
fn who_sent_a_recorded_letter_to_nobody_is_told_in_its_own_words() {
    // Where it is, only its letter says.
    let mut core = core(true, &[]);
    core.handle_unframed(
        now(),
        Duration::from_secs(5),
        recorded(LETTER),
        Kind::Tcp,
        HERE,
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
        let told = nested(message.content().unwrap());
        assert_eq!(*told.performative(), Performative::Inform);
        assert_eq!(told.sender().unwrap().name(), "cpp-sender");
        assert_eq!(told.receivers().len(), 1);
        assert_eq!(told.language(), Some("internal-error"));
        let text = String::from_utf8(told.content().unwrap().to_vec()).unwrap();
        assert!(
            text.starts_with("description: message delivery failed"),
            "{text}"
        );
        assert!(text.contains("\ndelivery path: send-mts,"), "{text}");
    }
    assert_eq!(ours.sender().unwrap().name(), "gateway");
    let told = nested(ours.content().unwrap());
    assert_eq!(told.receivers()[0].name(), "echo");
    let written = ours.encode(Representation::BitEfficient, Dialect::FipaServices);
    written.unwrap();

    // It cannot be told: nobody is told of that.
    let error = WayError::new(WayFault::Unreachable, "gone");
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
fn each_receiver_is_told_of_once_and_failures_never() {
    let mut core = core(true, &[("old", OLD_PEER)]);
    let message = |performative| {
        Message::builder(performative)
            .sender(AgentId::new("old").unwrap())
            .receiver(AgentId::new("nobody").unwrap())
            .receiver(AgentId::new("nobody-else").unwrap())
            .content("x")
            .build()
            .unwrap()
    };
    let letter = |performative| letter_for(&message(performative), now().utc).unwrap();
    let deadline = Duration::from_secs(5);
    core.handle_unframed(
        now(),
        deadline,
        letter(Performative::Request),
        Kind::Tcp,
        HERE,
    );
    let mut told = Vec::new();
    while let Some((_, location, parcel)) = dispatched(&mut core) {
        assert_eq!(location.to_string(), OLD_PEER);
        let content = message_of(&parcel).content().unwrap().clone();
        told.push(nested(&content).receivers()[0].name().to_owned());
    }
    assert_eq!(told, ["nobody", "nobody-else"]);
    core.handle_unframed(
        now(),
        deadline,
        letter(Performative::Failure),
        Kind::Tcp,
        HERE,
    );
    assert!(core.poll_action().is_none());
}

#[test]
fn nobody_is_told_where_somebody_elses_letter_says_it_is() {
    let mut core = core(true, &[]);
    let elsewhere = IpAddr::from([10, 0, 0, 66]);
    let deadline = Duration::from_secs(5);
    core.handle_unframed(now(), deadline, recorded(LETTER), Kind::Tcp, elsewhere);
    assert!(core.poll_action().is_none(), "it came from {elsewhere}");
}

/// Lets nothing through to the agents whose names begin so.
struct Refusing(&'static str);

impl Gate for Refusing {
    fn admits(&self, _: Instant, receiver: &str, _: &Letter, _: Link) -> Result<(), String> {
        match receiver.starts_with(self.0) {
            true => Err("a rule denies it".to_owned()),
            false => Ok(()),
        }
    }
}

#[test]
fn who_is_refused_is_told_in_its_own_words_and_not_without_end() {
    // The receiver of the recorded letter is on this host.
    let directory = MemoryDirectory::new(Mts::new("process", Incarnation::from_u64(9)));
    let at = "shm://9#0000000000000009".parse().unwrap();
    let echo = Registration::new("echo", Incarnation::from_u64(5), vec![at]);
    directory.register(echo).unwrap();
    let config = CoreConfig {
        forwards: true,
        ..CoreConfig::new(
            "gateway",
            Incarnation::from_u64(7),
            vec![Kind::Shm, Kind::Tcp],
        )
    };
    let mut core = Core::new(config, Arc::new(directory)).gated(Arc::new(Refusing("echo")));
    let (then, deadline) = (now(), Duration::from_secs(5));
    for _ in 0..200 {
        core.handle_unframed(then, deadline, recorded(LETTER), Kind::Tcp, HERE);
    }
    let mut told = 0;
    while let Some((attempt, location, parcel)) = dispatched(&mut core) {
        told += 1;
        assert_eq!(location.to_string(), "tcp://127.0.0.1:45615;fipa-services");
        let message = message_of(&parcel);
        assert_eq!(*message.performative(), Performative::Failure);
        assert_eq!(message.receivers()[0].name(), "cpp-sender");
        assert_eq!(message.in_reply_to(), Some("rw-1"));
        let told = nested(message.content().unwrap());
        assert_eq!(told.receivers()[0].name(), "echo");
        let text = String::from_utf8(told.content().unwrap().to_vec()).unwrap();
        assert!(text.contains("refused"), "{text}");
        core.handle_conclusion(then, attempt, Conclusion::Handed);
    }
    assert_eq!(told, 20, "as many as a second has");
}

/// The directory of a host on which one agent is registered.
fn host_of(agent: &str) -> Arc<dyn Directory> {
    let directory = MemoryDirectory::new(Mts::new("process", Incarnation::from_u64(9)));
    let at = "shm://9#0000000000000009".parse().unwrap();
    let agent = Registration::new(agent, Incarnation::from_u64(5), vec![at]);
    directory.register(agent).unwrap();
    Arc::new(directory)
}

/// The recorded letter to an agent with another name, as the C++ library writes it.
fn recorded_to(receiver: &str) -> Letter {
    let (mut envelope, letter) = Letter::decode(Bytes::from_static(LETTER)).unwrap();
    envelope.extensions.clear();
    envelope.base.to = vec![AgentId::new(receiver).unwrap()];
    envelope.base.intended_receivers = envelope.base.to.clone();
    let payload = letter.payload().clone();
    Letter::new(envelope.encode_standard().unwrap(), payload)
}

#[test]
fn a_name_with_a_dot_is_reached_as_legacy_peers_write_it() {
    let config = CoreConfig {
        forwards: true,
        ..CoreConfig::new("gateway", Incarnation::from_u64(7), vec![Kind::Shm])
    };
    let mut core = Core::new(config, host_of("arm.left"));
    let deadline = Duration::from_secs(5);
    core.handle_unframed(now(), deadline, recorded_to("arm?left"), Kind::Tcp, HERE);
    let (_, location, parcel) = dispatched(&mut core).unwrap();
    assert_eq!(location.kind(), Kind::Shm);
    assert_eq!(&*parcel.receiver, "arm.left");
    assert!(core.poll_action().is_none());
}

#[test]
fn failure_messages_that_nobody_takes_are_bounded() {
    let mut core = core(true, &[]);
    let most = core.config().lane;
    // All at one moment, however long it takes: nothing may time out.
    let (then, deadline) = (now(), Duration::from_secs(5));
    for _ in 0..2 * most {
        core.handle_unframed(then, deadline, recorded(LETTER), Kind::Tcp, HERE);
    }
    let mut told = 0;
    while let Some((attempt, _, _)) = dispatched(&mut core) {
        told += 1;
        core.handle_conclusion(then, attempt, Conclusion::Handed);
    }
    assert_eq!(told, most);
}

#[test]
fn a_letter_to_an_old_peers_agent_is_sent_not_delivered() {
    // In the sender's process the way is the gateway's, in the gateway the peer's own.
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
    let (_, outcomes) = process.send(
        now(),
        Submission {
            sender: rover,
            letter: letter_for(&message, now().utc).unwrap(),
            receivers: vec!["old".into()],
            deadline: Duration::from_secs(5),
        },
    );
    assert_eq!(outcomes, 1);
    let (sent, to, parcel) = dispatched(&mut process).unwrap();
    assert_eq!(to.to_string(), near);

    let back: Location = "shm://1#0000000000000001".parse().unwrap();
    let arrival = Arrival {
        parcel,
        from: Hop {
            location: back,
            remote: false,
        },
        ticket: Ticket(1),
    };
    let verdict = gateway.handle_arrival(now(), Kind::Shm, true, arrival);
    assert_eq!(verdict, Verdict::Now(Answer::Custody));
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
            remote: false,
        },
        ticket: Ticket(2),
    };
    process.handle_arrival(now(), Kind::Shm, true, arrival);
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
fn an_old_peer_that_cannot_be_reached_fails_like_anybody() {
    let mut core = core(false, &[("old", OLD_PEER)]);
    let rover = Incarnation::from_u64(1);
    core.register("rover".into(), rover);
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("old").unwrap())
        .build()
        .unwrap();
    let start = now();
    core.send(
        start,
        Submission {
            sender: rover,
            letter: letter_for(&message, start.utc).unwrap(),
            receivers: vec!["old".into()],
            deadline: Duration::from_secs(1),
        },
    );
    let (attempt, _, _) = dispatched(&mut core).unwrap();
    let error = WayError::new(WayFault::Unreachable, "nobody listens");
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
    // The agent is told in its own process, in the standard's words.
    let told = core.take(rover).unwrap();
    let told = Message::decode(told.letter.payload()).unwrap();
    assert_eq!(*told.performative(), Performative::Failure);
    assert_eq!(told.language(), Some("fipa-sl"));
}
