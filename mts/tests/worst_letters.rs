//! The most expensive letters within the limits: the number of steps of the core for each does not
//! depend on its bytes. In a release build, `--nocapture` shows the processor time that the core takes, during which
//! the runtime's lock is held.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
#![expect(clippy::print_stdout, reason = "it prints the time")]

use std::net::{IpAddr, Ipv4Addr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use fipa_acl::{
    AgentId, Envelope, EnvelopeParams, Letter, Message, MessageView, Performative, Time,
};
#[cfg(debug_assertions)]
use fipa_mts::core::work;
use fipa_mts::core::{Action, Core, CoreConfig, Now, Received, Undecodable, Unframed};
use fipa_mts::{AccessGate, LetterParts, Link, letter_for};
use fipa_sds::{Directory, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Hop, Incarnation, Kind, LegacySource, Location,
    Outcome, Parcel, Principal, Reaction, Report, Signature, Stream, Ticket, TransportError,
    TransportErrorKind,
};
use rustix::time::{ClockId, clock_gettime};

const AGENTS: u64 = 1000;
/// Maximum number of steps of the core under one lock.
const MOST_STEPS: u64 = 128;
/// The same for visits of a full lane, which look at each of its letters.
const MOST_STEPS_OF_A_LANE: u64 = MOST_STEPS + 4 * 1024;
/// More lanes than custody has room for.
const LANES: u64 = 70_000;
/// Time that letters have left.
const DEADLINE: Duration = Duration::from_secs(5);
/// Maximum number of actions that one call leaves to be carried out while the core is locked.
const MOST_ACTIONS: usize = 128;
const PEER: Incarnation = Incarnation::from_u64(2);
const PROCESS: Incarnation = Incarnation::from_u64(3);

fn core() -> (Core, Arc<dyn Directory>) {
    core_with(AGENTS)
}

fn core_with(agents: u64) -> (Core, Arc<dyn Directory>) {
    let directory = MemoryDirectory::new(MtsId::new("mts", PROCESS));
    for number in 0..agents {
        let at = Location::new(Kind::Shm, "process").unwrap();
        let at = vec![at.with_incarnation(PROCESS)];
        let agent = Incarnation::from_u64(100 + number);
        directory
            .register(Registration::new(format!("arm_{number}"), agent, at))
            .unwrap();
    }
    let directory: Arc<dyn Directory> = Arc::new(directory);
    let kinds = vec![Kind::Shm, Kind::Tcp];
    let config = CoreConfig {
        forwards: true,
        ..CoreConfig::new("gateway", Incarnation::from_u64(1), kinds)
    };
    (Core::new(config, directory.view()), directory)
}

/// The time of everything that happens without another time, however long the test takes.
fn now() -> Now {
    static BEGIN: LazyLock<Instant> = LazyLock::new(Instant::now);
    Now {
        instant: *BEGIN,
        utc: SystemTime::UNIX_EPOCH + Duration::from_secs(1 << 30),
    }
}

/// A letter to these receivers with this many user-defined parameters.
fn letter(receivers: &[String], parameters: usize) -> Letter {
    let mut message = Message::builder(Performative::Inform).sender(AgentId::new("liar").unwrap());
    for receiver in receivers {
        message = message.receiver(AgentId::new(receiver).unwrap());
    }
    for number in 0..parameters {
        message = message.user_defined(format!("x-{number}"), "value");
    }
    letter_for(&message.build().unwrap(), SystemTime::UNIX_EPOCH).unwrap()
}

/// Performs the work on one arrival that was read, or on a portion of it, while the core is locked. The number of
/// its steps has one bound for all letters.
fn bounded<R>(what: &str, bytes: usize, work: impl FnOnce() -> R) -> R {
    bounded_by(MOST_STEPS, what, bytes, work)
}

/// The same with this bound.
fn bounded_by<R>(most: u64, what: &str, bytes: usize, work: impl FnOnce() -> R) -> R {
    #[cfg(debug_assertions)]
    let _earlier = work::taken();
    let before = processor_time();
    let result = work();
    let took = processor_time() - before;
    #[cfg(debug_assertions)]
    {
        let steps = work::taken();
        println!("{what}: {bytes} bytes, {steps} steps");
        assert!(steps <= most, "{what}: {steps} steps for {bytes} bytes");
    }
    #[cfg(not(debug_assertions))]
    let _ = most;
    println!("{what}: {bytes} bytes, {took:?}");
    result
}

/// The processor time of this thread.
fn processor_time() -> Duration {
    clock_gettime(ClockId::ThreadCPUTime).try_into().unwrap()
}

fn arrives(core: &mut Core, stream: (u64, u64), sequence: u64, body: Body) -> Reaction {
    let arrival = arrival(stream, sequence, body);
    let read = core.reader().read_arrival(&arrival);
    core.handle_read_arrival(now(), Kind::Tcp, arrival, read)
}

fn arrival(stream: (u64, u64), sequence: u64, body: Body) -> Arrival {
    let (sender, receiver) = stream;
    let location = Location::new(Kind::Tcp, "192.0.2.1:1").unwrap();
    Arrival {
        parcel: Parcel {
            receiver: format!("arm_{}", receiver - 100).into(),
            stream: Stream::between(
                Incarnation::from_u64(sender),
                Incarnation::from_u64(receiver),
            ),
            sequence,
            after: sequence - 1,
            transfer: sequence,
            remaining: DEADLINE,
            body,
        },
        from: Hop {
            location: location.with_incarnation(PEER),
            principal: Principal::Unproved,
        },
        ticket: Some(Ticket(sequence)),
    }
}

/// Handles a letter of another gateway, which is read before, as the runtime does.
fn framed(core: &mut Core, what: &str, letter: Letter) -> Reaction {
    let bytes = letter.len();
    let arrival = arrival((9, 100), 1, Body::Letter(letter));
    let read = core.reader().read_arrival(&arrival);
    bounded(what, bytes, || {
        core.handle_read_arrival(now(), Kind::Tcp, arrival, read)
    })
}

fn unframed(core: &mut Core, directory: &dyn Directory, what: &str, letter: Letter) {
    let from = LegacySource {
        address: IpAddr::V4(Ipv4Addr::LOCALHOST),
        signature: Signature::FipaServices,
    };
    let bytes = letter.len();
    let read = Unframed::read(letter, Kind::Tcp, from, directory).unwrap();
    in_portions(core, what, (bytes, read));
}

/// Handles a letter of a legacy peer as the runtime does, with the core locked for one portion of the receivers at a
/// time. Returns the actions.
fn in_portions(core: &mut Core, what: &str, (bytes, mut read): (usize, Unframed)) -> Vec<Action> {
    let mut actions = Vec::new();
    for portion in 1.. {
        let what = format!("{what}, portion {portion}");
        bounded(&what, bytes, || {
            core.handle_unframed(now(), Duration::from_secs(5), &mut read);
        });
        actions.extend(std::iter::from_fn(|| core.poll_action()));
        if read.is_handled() {
            break;
        }
    }
    actions
}

#[test]
fn a_letter_of_a_legacy_peer_to_the_maximum_of_receivers() {
    let names: Vec<String> = (0..64).map(|number| format!("arm_{number}")).collect();
    let unknown: Vec<String> = (0..64).map(|number| format!("nobody_{number}")).collect();
    let pattern = vec!["arm_.*".to_owned()];
    for (what, receivers) in [
        ("64 agents", &names),
        ("64 unknown names", &unknown),
        ("a pattern for 1,000 agents", &pattern),
    ] {
        for parameters in [0, 1000, 20_000] {
            let (mut core, directory) = core();
            let what = format!("{what}, {parameters} parameters");
            unframed(&mut core, &*directory, &what, letter(receivers, parameters));
        }
    }
}

/// Number of agents that get a copy of a legacy peer's letter to these receivers.
fn copies(agents: u64, receivers: &[String]) -> usize {
    let (mut core, directory) = core_with(agents);
    let from = LegacySource {
        address: IpAddr::V4(Ipv4Addr::LOCALHOST),
        signature: Signature::FipaServices,
    };
    let letter = letter(receivers, 0);
    let bytes = letter.len();
    let read = Unframed::read(letter, Kind::Tcp, from, &*directory).unwrap();
    let sent = in_portions(&mut core, "copies", (bytes, read)).into_iter();
    let sent = sent.filter(|action| matches!(action, Action::Dispatch { .. }));
    sent.count()
}

/// Of 1,025 agents, one more than a letter of a legacy peer may be for, each would get a copy.
#[test]
fn a_letter_of_a_legacy_peer_to_too_many_agents_goes_to_none() {
    let all = ["arm_.*".to_owned()];
    assert_eq!(copies(1024, &all), 1024);
    assert_eq!(copies(1025, &all), 0);
}

#[test]
fn a_letter_of_a_legacy_peer_with_too_many_receivers_or_an_expensive_pattern_goes_to_none() {
    let names =
        |count: u64| -> Vec<String> { (0..count).map(|number| format!("arm_{number}")).collect() };
    assert_eq!(copies(100, &names(64)), 64);
    assert_eq!(copies(100, &names(65)), 0);
    let pattern = |len| format!("{:x<len$}", "arm_.*|");
    assert_eq!(copies(100, &[pattern(128)]), 100);
    assert_eq!(copies(100, &[pattern(129)]), 0);
    assert_eq!(copies(100, &[pattern(20), pattern(21)]), 0);
    // A pattern that ignores the case takes long to compile.
    let named = |pattern: &str| copies(100, &[pattern.to_owned()]);
    assert_eq!(named("(?:arm)_(?P<number>.*)"), 100);
    for flags in ["(?i)arm_.*", "(arm(?i:_).*)", "(?-u:arm_).*"] {
        assert_eq!(named(flags), 0, "{flags}");
    }
}

#[test]
fn a_letter_with_the_maximum_of_parameters() {
    for parameters in [0, 1000, 50_000] {
        let (mut core, _) = core();
        let letter = letter(&["arm_0".to_owned()], parameters);
        let what = format!("{parameters} parameters");
        let verdict = framed(&mut core, &what, letter);
        assert_eq!(verdict, Reaction::Later);
    }
}

/// Receivers with names of the maximum length, and parameters in the envelope.
#[test]
fn a_letter_with_long_names_and_a_large_envelope() {
    let long: Vec<String> = (0..64)
        .map(|number| format!("{number:x<width$}", width = fipa_sds::MAX_NAME))
        .collect();
    let (mut gateway, directory) = core();
    let what = "64 unknown names of the maximum length";
    unframed(&mut gateway, &*directory, what, letter(&long, 0));
    for parameters in [1000, 50_000] {
        let (mut core, _) = core();
        let arm = letter(&["arm_0".to_owned()], 0);
        let (mut envelope, arm) = Letter::decode(arm.to_bytes()).unwrap();
        for number in 0..parameters {
            let parameter = (format!("x-{number}"), "value".to_owned());
            envelope.base.user_defined.push(parameter);
        }
        let envelope = envelope.encode_standard().unwrap();
        let letter = Letter::new(envelope, arm.payload().clone());
        let what = format!("{parameters} parameters in the envelope");
        framed(&mut core, &what, letter);
    }
}

#[test]
fn a_letter_with_the_maximum_of_stamps() {
    for stamps in [1, 100, 5000] {
        let (mut core, _) = core();
        let mut letter = letter(&["arm_0".to_owned()], 0);
        let received = fipa_acl::Received {
            by: "another".into(),
            date: Time::from_system_time(SystemTime::UNIX_EPOCH).unwrap(),
            from: None,
            id: Some(PEER.to_string()),
            via: None,
            user_defined: Vec::new(),
        };
        let stamp = Envelope::encode_extension(&EnvelopeParams {
            received: Some(received),
            ..EnvelopeParams::default()
        });
        let stamp = Bytes::from(stamp.unwrap().repeat(stamps));
        letter = letter.stamped(stamp);
        let what = format!("{stamps} stamps");
        framed(&mut core, &what, letter);
    }
}

/// The failure message about a letter repeats parts of it.
#[test]
fn a_letter_whose_failure_message_repeats_long_parts() {
    let message =
        || Message::builder(Performative::Inform).receiver(AgentId::new("nobody").unwrap());
    let at_home = |agent: AgentId| agent.with_address("tcp://127.0.0.1:6789").unwrap();
    let liar = || at_home(AgentId::new("liar").unwrap());
    let mut addresses = liar();
    for number in 0..20_000 {
        addresses = addresses
            .with_address(format!("tcp://192.0.2.1:{number}"))
            .unwrap();
    }
    let long = "x".repeat(1_000_000);
    for (what, message) in [
        ("many addresses", message().sender(addresses)),
        (
            "a long address",
            // It is in the envelope and in the message.
            message().sender(liar().with_address(&long[..500_000]).unwrap()),
        ),
        (
            "a long conversation identifier",
            message().sender(liar()).conversation_id(&long),
        ),
        ("a long protocol", message().sender(liar()).protocol(&long)),
        (
            "a long reply-with",
            message().sender(liar()).reply_with(&long),
        ),
        (
            "a long user-defined parameter",
            message().sender(liar()).user_defined("x-y", &long),
        ),
    ] {
        let (mut core, directory) = core();
        let letter = letter_for(&message.build().unwrap(), SystemTime::UNIX_EPOCH).unwrap();
        let bytes = letter.len();
        let from = LegacySource {
            address: IpAddr::V4(Ipv4Addr::LOCALHOST),
            signature: Signature::FipaServices,
        };
        let read = Unframed::read(letter, Kind::Tcp, from, &*directory).unwrap();
        let what = format!("a failure message about a letter with {what}");
        let actions = in_portions(&mut core, &what, (bytes, read)).into_iter();
        let dispatches = actions.filter(|action| matches!(action, Action::Dispatch { .. }));
        assert_eq!(dispatches.count(), 1, "{what}");
    }
}

/// A letter of an agent of this host whose message cannot be decoded.
#[test]
fn a_long_letter_that_cannot_be_decoded() {
    let (mut core, directory) = core();
    let sender = directory.lookup("arm_7").unwrap();
    let letter = letter(&["arm_0".to_owned()], 0);
    let mut envelope = letter.parse_envelope().unwrap();
    envelope.base.from = Some(AgentId::new("arm_7").unwrap());
    for number in 0..50_000 {
        let parameter = (format!("x-{number}"), "value".to_owned());
        envelope.base.user_defined.push(parameter);
    }
    let envelope = envelope.encode_standard().unwrap();
    let received = Received {
        letter: Letter::new(envelope, Bytes::from(vec![b'('; 1 << 18])),
        sender: sender.incarnation,
        via: Some(Kind::Shm),
        service: PROCESS,
        peer: fipa_transport::PeerId::THIS_HOST,
        remote: false,
    };
    let bytes = received.letter.len();
    let undecodable = Undecodable::read(&received, &"for a test").unwrap();
    bounded("a letter that cannot be decoded", bytes, || {
        core.handle_undecodable(now(), &"arm_0".into(), undecodable);
    });
    assert!(matches!(core.poll_action(), Some(Action::Dispatch { .. })));
}

/// A full lane in which every letter waits for the one before it.
#[test]
fn a_letter_for_a_full_lane() {
    let (mut core, _) = core();
    let letter = letter(&["arm_0".to_owned()], 0);
    for sequence in (2..1024).rev() {
        arrives(&mut core, (9, 100), sequence, Body::Letter(letter.clone()));
    }
    bounded("the letter that 1,022 wait behind", letter.len(), || {
        arrives(&mut core, (9, 100), 1, Body::Letter(letter.clone()))
    });
    bounded("a letter too many", letter.len(), || {
        arrives(&mut core, (9, 100), 5000, Body::Letter(letter.clone()))
    });
    let report = Report::Settled(Outcome::Delivered {
        via: Kind::Tcp,
        attempts: Vec::new(),
    });
    for (what, body) in [
        ("a predecessor", Body::Predecessor),
        ("a credit", Body::Credit),
        ("a report", Body::Report(report)),
    ] {
        bounded(what, 64, || arrives(&mut core, (9, 100), 1023, body));
    }
}

/// A core with as many lanes as peers can have it keep, each with a letter of an invented sender. All letters came at
/// this time, and have the same deadline.
fn crowded(agents: u64) -> (Core, Arc<dyn Directory>, Instant) {
    let (mut core, directory) = core_with(agents);
    let letter = letter(&["arm_0".to_owned()], 0);
    let arrived_at = now();
    let mut lanes = 0;
    for sender in 0..LANES {
        let stream = (1_000_000 + sender, 100 + sender % agents);
        let arrival = arrival(stream, 1, Body::Letter(letter.clone()));
        let read = core.reader().read_arrival(&arrival);
        match core.handle_read_arrival(arrived_at, Kind::Tcp, arrival, read) {
            Reaction::Later => lanes += 1,
            verdict => assert_eq!(verdict, Reaction::Now(Answer::Busy)),
        }
        while let Some(action) = core.poll_action() {
            if let Action::Refresh { number } = action {
                core.handle_refreshed(arrived_at, number);
            }
        }
    }
    assert!(lanes > LANES / 2, "{lanes} lanes");
    // Letters of senders beyond the rate of new ones wait this long.
    let most = (MOST_STEPS, "first letters");
    timeouts(
        &mut core,
        most,
        arrived_at.instant + Duration::from_millis(500),
    );
    (core, directory, arrived_at.instant)
}

/// Handles timeouts as the runtime does, with the core locked for one call at a time, until none is due at this time.
/// Returns the actions.
fn timeouts(core: &mut Core, (most, what): (u64, &str), at: Instant) -> Vec<Action> {
    let mut actions = Vec::new();
    while core.poll_timeout().is_some_and(|due| due <= at) {
        let at = Now {
            instant: at,
            ..now()
        };
        bounded_by(most, what, 0, || core.handle_timeout(at));
        let before = actions.len();
        actions.extend(std::iter::from_fn(|| core.poll_action()));
        assert!(actions.len() - before <= MOST_ACTIONS, "{what}");
    }
    actions
}

/// The letters of many senders pass their deadlines at once.
#[test]
fn deadlines_of_many_lanes() {
    let (mut core, _, arrived_at) = crowded(AGENTS);
    let ended = timeouts(
        &mut core,
        (MOST_STEPS, "deadlines of many lanes"),
        arrived_at + DEADLINE,
    );
    let ended = ended.into_iter();
    let ended = ended.filter(|action| matches!(action, Action::Abandon { .. }));
    assert!(ended.count() as u64 > LANES / 2);
}

/// A full lane, whose letters came from another gateway to `arm_0` at this time and have the same deadline.
/// Also returns the attempts under way.
fn full_lane() -> (Core, Arc<dyn Directory>, Instant, Vec<AttemptId>) {
    let (mut core, directory) = core();
    let letter = letter(&["arm_0".to_owned()], 0);
    let arrived_at = now();
    for sequence in 1..1025 {
        let arrival = arrival((9, 100), sequence, Body::Letter(letter.clone()));
        let read = core.reader().read_arrival(&arrival);
        let verdict = core.handle_read_arrival(arrived_at, Kind::Tcp, arrival, read);
        assert_eq!(verdict, Reaction::Later);
    }
    let mut sent = Vec::new();
    while let Some(action) = core.poll_action() {
        match action {
            Action::Dispatch { attempt, .. } => sent.push(attempt),
            Action::Refresh { number } => core.handle_refreshed(arrived_at, number),
            _ => {}
        }
    }
    (core, directory, arrived_at.instant, sent)
}

/// All letters of a full lane pass their deadline at once.
#[test]
fn deadlines_of_a_full_lane() {
    let (mut core, _, arrived_at, sent) = full_lane();
    let what = (MOST_STEPS_OF_A_LANE, "deadlines of a full lane");
    let ended = timeouts(&mut core, what, arrived_at + DEADLINE);
    let answers = ended.iter();
    let answers = answers.filter(|action| matches!(action, Action::Answer { .. }));
    assert_eq!(answers.count(), 1024);
    let abandoned = ended.iter();
    let abandoned = abandoned.filter(|action| matches!(action, Action::Abandon { .. }));
    assert_eq!(abandoned.count(), sent.len());
}

/// The receiver of all letters of a full lane leaves, and its process refuses the letters that were sent.
#[test]
fn the_receiver_of_a_full_lane_leaves() {
    let (mut core, directory, arrived_at, sent) = full_lane();
    directory
        .deregister("arm_0", Incarnation::from_u64(100))
        .unwrap();
    drop(core.set_view(directory.view()));
    let now = Now {
        instant: arrived_at,
        ..now()
    };
    let what = "the receiver of a full lane leaves";
    bounded_by(MOST_STEPS_OF_A_LANE, what, 0, || {
        core.handle_directory_change(now);
    });
    for attempt in sent {
        let gone = TransportError::new(TransportErrorKind::WrongIncarnation, "");
        core.handle_conclusion(now, attempt, Conclusion::NotSent(gone));
    }
    // The runtime refreshes the directory without the core locked.
    let mut ended = 0;
    loop {
        let (mut refresh, mut actions) = (None, 0);
        while let Some(action) = core.poll_action() {
            actions += 1;
            assert!(actions <= MOST_ACTIONS, "{what}");
            match action {
                Action::Refresh { number } => refresh = Some(number),
                Action::Answer { .. } => ended += 1,
                _ => {}
            }
        }
        let Some(number) = refresh else { break };
        bounded_by(MOST_STEPS_OF_A_LANE, what, 0, || {
            core.handle_refreshed(now, number);
        });
    }
    assert_eq!(ended, 1024);
}

/// A peer can announce and withdraw agents while many lanes have letters.
#[test]
fn changes_of_the_directory_with_many_lanes() {
    let (mut core, directory, arrived_at) = crowded(AGENTS);
    for (name, agent) in [("arm_0", 100), ("arm_1", 101)] {
        let agent = Incarnation::from_u64(agent);
        let departed = directory.lookup(name).unwrap();
        directory.deregister(name, agent).unwrap();
        drop(core.set_view(directory.view()));
        bounded("a change of the directory", 0, || {
            let now = Now {
                instant: arrived_at,
                ..now()
            };
            core.handle_departure(now, &departed);
            core.handle_directory_change(now);
        });
        while core.poll_action().is_some() {}
        timeouts(
            &mut core,
            (MOST_STEPS, "a change of the directory, continued"),
            arrived_at,
        );
    }
}

/// A gate that reads every letter as the rules of `[access]` do, and admits it.
#[derive(Default)]
struct Reading(AtomicU64);

impl AccessGate for Reading {
    fn read(&self, letter: &Letter) -> LetterParts {
        self.0.fetch_add(1, Ordering::Relaxed);
        let message = MessageView::parse_payload(letter.payload()).unwrap();
        LetterParts {
            sender: message.sender().unwrap().name().to_string(),
            ..LetterParts::default()
        }
    }

    fn admits(&self, _: Instant, _: &str, letter: &LetterParts, _: Link) -> Result<(), String> {
        assert_eq!(letter.sender, "liar");
        Ok(())
    }
}

/// The letter is read once for all receivers, and before the core is locked.
#[test]
fn a_letter_that_rules_apply_to() {
    for parameters in [0, 1000, 50_000] {
        let gate = Arc::new(Reading::default());
        let (core, directory) = core();
        let mut core = core.gated(gate.clone());
        let letter = letter(&["arm_.*".to_owned()], parameters);
        let bytes = letter.len();
        let from = LegacySource {
            address: IpAddr::V4(Ipv4Addr::LOCALHOST),
            signature: Signature::FipaServices,
        };
        let read = Unframed::read(letter, Kind::Tcp, from, &*directory).unwrap();
        let read = read.read_by(core.reader());
        let what = format!("a pattern for 1,000 agents with rules, {parameters} parameters");
        let actions = in_portions(&mut core, &what, (bytes, read)).into_iter();
        let sent = actions.filter(|action| matches!(action, Action::Dispatch { .. }));
        // Custody has no room for a thousand large letters.
        assert!(sent.count() > 100);
        assert_eq!(gate.0.load(Ordering::Relaxed), 1);
    }
}
