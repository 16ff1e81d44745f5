//! Letters with names that could look like other names, or that end a line, are refused where they enter
//! the service. Decoders accept them.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Dialect, Letter, Message, Payload, Performative, Representation};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Unframed};
use fipa_mts::letter_for;
use fipa_sds::{Directory, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, Arrival, Body, FailureReason, Hop, Incarnation, Kind, LegacySource, Parcel, Principal,
    Reaction, Signature, Stream,
};

const ARM: Incarnation = Incarnation::from_u64(0xa);
const PEER: LegacySource = LegacySource {
    address: IpAddr::V4(Ipv4Addr::LOCALHOST),
    signature: Signature::FipaServices,
};

fn now() -> Now {
    Now {
        instant: Instant::now(),
        utc: SystemTime::UNIX_EPOCH,
    }
}

/// A core with the agent `arm`: in its own process, or of another process whose letters it forwards.
fn core(forwards: bool) -> Core {
    let own = Incarnation::from_u64(7);
    let directory = MemoryDirectory::new(MtsId::new("mts", own));
    if forwards {
        let at = "shm://9#0000000000000009".parse().unwrap();
        let registration = Registration::new("arm", ARM, vec![at]);
        directory.register(registration).unwrap();
    }
    let config = CoreConfig {
        forwards,
        ..CoreConfig::new("mts", own, vec![Kind::Shm, Kind::Tcp])
    };
    let mut core = Core::new(config, Arc::new(directory));
    if !forwards {
        core.register("arm".into(), ARM);
    }
    core
}

fn id(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn message(sender: &str, receiver: &str, reply_to: &str) -> Message {
    let message = Message::builder(Performative::Inform)
        .sender(id(sender))
        .receiver(id(receiver))
        .reply_to(id(reply_to));
    message.build().unwrap()
}

fn letter(message: &Message) -> Letter {
    letter_for(message, SystemTime::UNIX_EPOCH).unwrap()
}

fn arrive(core: &mut Core, principal: Principal, sequence: u64, letter: Letter) -> Answer {
    let location = "tcp://192.0.2.1:7#0000000000000001".parse().unwrap();
    let arrival = Arrival {
        parcel: Parcel {
            receiver: "arm".into(),
            stream: Stream::between(Incarnation::from_u64(1), ARM),
            sequence,
            after: 0,
            remaining: Duration::from_secs(5),
            transfer: 0,
            body: Body::Letter(letter),
        },
        from: Hop {
            location,
            principal,
        },
        ticket: None,
    };
    match core.handle_arrival(now(), Kind::Tcp, arrival) {
        Reaction::Now(answer) => answer,
        verdict @ Reaction::Later => panic!("{verdict:?}"),
    }
}

/// Letters with a misleading name, and its first misleading character as the refusal shows it.
fn misleading() -> Vec<(Letter, &'static str)> {
    let clean = letter(&message("rover", "arm", "rover"));
    let payload = message("rov\n_1", "arm", "rover").to_payload();
    // A text that is split as only bit-efficient messages are.
    let text = message("rov\u{200b}er", "arm", "rover");
    let text = text
        .encode(Representation::String, Dialect::Standard)
        .unwrap();
    let split = Payload {
        head: text.slice(..20),
        content: text.slice(20..30),
        tail: text.slice(30..),
    };
    vec![
        (Letter::new(clean.envelope(), split), "U+200B"),
        (letter(&message("rov\n_1", "arm", "rover")), "U+000A"),
        (letter(&message("rover\u{3164}", "arm", "rover")), "U+3164"),
        (letter(&message(" rover", "arm", "rover")), "U+0020"),
        (letter(&message("rover", "arm\u{34f}", "rover")), "U+034F"),
        (letter(&message("rover", "arm", "rov\u{1b}er")), "U+001B"),
        // The message names another sender than the envelope.
        (Letter::new(clean.envelope(), payload), "U+000A"),
    ]
}

#[track_caller]
fn assert_refused(answer: &Answer, character: &str) {
    let Answer::Failed { reason, detail } = answer else {
        panic!("{answer:?}");
    };
    assert_eq!(*reason, FailureReason::Refused);
    assert!(detail.contains(character), "{detail}");
}

#[test]
fn letters_of_other_hosts_with_misleading_names_are_refused() {
    let services = [(false, Answer::Accepted), (true, Answer::Custody)];
    let principals = [Principal::Unproved, Principal::Certificate([1; 32])];
    for (principal, (forwards, taken)) in principals
        .into_iter()
        .flat_map(|principal| services.clone().map(|service| (principal, service)))
    {
        let mut core = core(forwards);
        let letters = misleading();
        let next = letters.len() as u64 + 1;
        for (sequence, (letter, character)) in (1..).zip(letters) {
            let answer = arrive(&mut core, principal, sequence, letter);
            assert_refused(&answer, character);
        }
        assert_eq!(core.waiting(ARM), 0);
        assert!(core.poll_action().is_none(), "a refusal causes no action");
        let clean = letter(&message("rover", "arm", "a b@host:1099/JADE"));
        assert_eq!(arrive(&mut core, principal, next, clean), taken);
    }
}

#[test]
fn a_gateway_refuses_letters_of_its_own_host_with_misleading_names() {
    let mut core = core(true);
    for (sequence, (letter, character)) in (1..).zip(misleading()) {
        let answer = arrive(&mut core, Principal::Host, sequence, letter);
        assert_refused(&answer, character);
    }
}

#[test]
fn letters_of_legacy_peers_with_misleading_names_are_refused() {
    for (letter, _) in misleading() {
        let mut core = core(false);
        let registration = Registration::new("arm", ARM, Vec::new());
        let directory = MemoryDirectory::new(MtsId::new("mts", Incarnation::from_u64(7)));
        directory.register(registration).unwrap();
        let mut unframed = Unframed::read(letter, Kind::Tcp, PEER, &directory).unwrap();
        core.handle_unframed(now(), Duration::from_secs(5), &mut unframed);
        assert!(unframed.is_handled());
        assert_eq!(core.waiting(ARM), 0);
        let contacts = std::iter::from_fn(|| core.poll_action());
        let mut contacts = contacts.filter(|it| matches!(it, Action::ContactSeen { .. }));
        assert!(contacts.next().is_none(), "the sender is no contact");
    }
    let mut core = core(false);
    let directory = MemoryDirectory::new(MtsId::new("mts", Incarnation::from_u64(7)));
    let registration = Registration::new("arm", ARM, Vec::new());
    directory.register(registration).unwrap();
    let clean = letter(&message("rover", "arm", "rover"));
    let mut unframed = Unframed::read(clean, Kind::Tcp, PEER, &directory).unwrap();
    core.handle_unframed(now(), Duration::from_secs(5), &mut unframed);
    assert_eq!(core.waiting(ARM), 1);
}

#[test]
fn recordings_with_such_names_decode() {
    for (letter, _) in misleading() {
        let mut bytes = letter.envelope().to_vec();
        bytes.extend(letter.payload().to_bytes());
        let (_, decoded) = Letter::decode(bytes.into()).unwrap();
        let message = Message::decode(decoded.payload()).unwrap();
        assert_eq!(Message::decode(letter.payload()).unwrap(), message);
    }
}
