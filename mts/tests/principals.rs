//! Trusted peers that speak for others: with certificates, each peer speaks for itself and its agents.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::letter_for;
use fipa_sds::{
    ContactDirectory, Directory, MemoryDirectory, MergedDirectory, MtsId, Registration, Role,
};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Introduction,
    Kind, Location, Mandate, Outcome, Parcel, Principal, Reaction, Realm, Report, Stream, Ticket,
    TransportError, TransportErrorKind,
};

use self::common::letter;

const GATEWAY: Incarnation = Incarnation::from_u64(1);
/// A process of this host, with the agent `arm`.
const PROCESS: Incarnation = Incarnation::from_u64(2);
const ARM: Incarnation = Incarnation::from_u64(3);
const LAMP: Incarnation = Incarnation::from_u64(7);
/// A gateway of another host, with the agent `rover`.
const HONEST: Incarnation = Incarnation::from_u64(4);
const ROVER: Incarnation = Incarnation::from_u64(5);
/// Another gateway, with an equally trusted certificate.
const LIAR: Incarnation = Incarnation::from_u64(6);

/// The gateway of a host that has connections with both peers.
struct Bench {
    core: Core,
    now: Now,
    tickets: u64,
    /// The predecessor of letters.
    after: u64,
}

fn at(service: Incarnation, address: &str) -> Location {
    let location: Location = address.parse().unwrap();
    location.with_incarnation(service)
}

/// A link with one of the two peers that claims this service.
fn link(service: Incarnation, holder: Incarnation) -> Hop {
    let number = u8::try_from(holder.as_u64()).unwrap();
    Hop {
        location: at(service, "tcp://192.0.2.4:1"),
        principal: Principal::Certificate([number; 32]),
    }
}

/// A link of another host without keys that claims this service.
fn stranger(service: Incarnation) -> Hop {
    Hop {
        principal: Principal::Unproved,
        ..link(service, LIAR)
    }
}

impl Bench {
    fn new() -> Self {
        Self::with(&[("rover", ROVER, HONEST)])
    }

    /// A gateway that knows these agents at other gateways.
    fn with(agents: &[(&str, Incarnation, Incarnation)]) -> Self {
        Self::with_process(agents, "shm://arms")
    }

    /// The same, with the process of `arm` at this address.
    fn with_process(agents: &[(&str, Incarnation, Incarnation)], process: &str) -> Self {
        let own = Arc::new(MemoryDirectory::new(MtsId::new("mts", PROCESS)));
        let arm = vec![at(PROCESS, process)];
        own.register(Registration::new("arm", ARM, arm)).unwrap();
        let contacts = Arc::new(ContactDirectory::new());
        for (name, agent, gateway) in agents {
            let location = at(*gateway, "tcp://192.0.2.4:1");
            let reaction = contacts.record_sender(Instant::now(), name, *agent, location);
            reaction.unwrap();
        }
        let all: Vec<Arc<dyn Directory>> = vec![own, contacts];
        let config = CoreConfig {
            forwards: true,
            ..CoreConfig::new("mts", GATEWAY, vec![Kind::Shm, Kind::Tcp])
        };
        let mut core = Core::new(config, Arc::new(MergedDirectory::new(all)));
        let now = Now {
            instant: Instant::now(),
            utc: SystemTime::UNIX_EPOCH,
        };
        core.register("mts".into(), GATEWAY);
        for (name, peer) in [("honest", HONEST), ("liar", LIAR)] {
            let introduction = Introduction {
                name: name.into(),
                hop: link(peer, peer),
                dialed: None,
                mandate: Mandate::Unproved,
            };
            core.handle_introduced(now, &introduction);
        }
        Self {
            core,
            now,
            tickets: 0,
            after: 0,
        }
    }

    fn arrives(
        &mut self,
        from: Hop,
        stream: (Incarnation, Incarnation),
        what: (u64, Body),
    ) -> Reaction {
        let ((sender, receiver), (sequence, body)) = (stream, what);
        self.tickets += 1;
        let parcel = Parcel {
            receiver: match receiver {
                GATEWAY => "mts".into(),
                LAMP => "lamp".into(),
                ROVER => "rover".into(),
                _ => "arm".into(),
            },
            stream: Stream {
                realm: match from.is_remote() {
                    // The core sets it.
                    true => Realm::UNPROVED,
                    // A process repeats that of the parcel that it was handed.
                    false => Realm::of(&link(HONEST, HONEST).principal),
                },
                ..Stream::between(sender, receiver)
            },
            sequence,
            after: self.after,
            transfer: 1,
            remaining: Duration::from_secs(5),
            body,
        };
        let ticket = Ticket(self.tickets);
        let arrival = Arrival {
            parcel,
            from,
            ticket: Some(ticket),
        };
        self.core.handle_arrival(self.now, Kind::Tcp, arrival)
    }

    fn letter(&mut self, from: Hop, stream: (Incarnation, Incarnation), sequence: u64) -> Reaction {
        self.arrives(from, stream, (sequence, Body::Letter(letter())))
    }
}

fn is_refused(verdict: &Reaction) -> bool {
    let reason = FailureReason::Refused;
    matches!(verdict, Reaction::Now(Answer::Failed { reason: it, .. }) if *it == reason)
}

#[test]
fn a_gateway_speaks_for_itself() {
    let mut bench = Bench::new();
    let goodbye = bench.letter(link(LIAR, LIAR), (HONEST, GATEWAY), 1 << 48);
    assert!(is_refused(&goodbye), "{goodbye:?}");
    // Also when the liar introduces itself as the honest gateway.
    let goodbye = bench.letter(link(HONEST, LIAR), (HONEST, GATEWAY), 1 << 48);
    assert!(is_refused(&goodbye), "{goodbye:?}");
    let own = bench.letter(link(HONEST, HONEST), (HONEST, GATEWAY), 1);
    assert_eq!(own, Reaction::Now(Answer::Accepted));
}

/// Sequences begin with 1, and a predecessor is below its letter: what follows predecessors ends.
#[test]
fn a_letter_that_is_its_own_predecessor_is_refused() {
    let mut bench = Bench::new();
    for (sequence, after) in [(0, 0), (0, 1), (1, 1), (5, u64::MAX), (u64::MAX, u64::MAX)] {
        bench.after = after;
        let circular = bench.letter(link(HONEST, HONEST), (ROVER, ARM), sequence);
        assert!(is_refused(&circular), "{sequence} after {after}");
        let circular = bench.letter(link(HONEST, HONEST), (ROVER, GATEWAY), sequence);
        assert!(is_refused(&circular), "{sequence} after {after}");
    }
    bench.after = 4;
    let next = bench.letter(link(HONEST, HONEST), (ROVER, ARM), 5);
    assert_eq!(next, Reaction::Later);
}

#[test]
fn letters_in_the_stream_of_another_host_are_refused() {
    let mut bench = Bench::new();
    for sequence in 1..=98 {
        let junk = bench.letter(link(LIAR, LIAR), (ROVER, ARM), sequence);
        assert!(is_refused(&junk), "{junk:?}");
        let junk = bench.letter(link(HONEST, LIAR), (ROVER, ARM), sequence);
        assert!(is_refused(&junk), "{junk:?}");
    }
    let real = bench.letter(link(HONEST, HONEST), (ROVER, ARM), 1);
    assert_eq!(real, Reaction::Later);
    // Another host cannot speak for an agent of this one either.
    let own = bench.letter(link(LIAR, LIAR), (ARM, GATEWAY), 1);
    assert!(is_refused(&own), "{own:?}");
}

/// The gateway of the sender is listed and has not connected yet: no other peer sends in its stead.
#[test]
fn letters_of_a_listed_agent_wait_until_its_gateway_has_introduced_itself() {
    let away = Incarnation::from_u64(8);
    let mut bench = Bench::with(&[("rover", ROVER, away)]);
    let early = bench.letter(link(LIAR, LIAR), (ROVER, ARM), 1);
    assert_eq!(early, Reaction::Now(Answer::Busy));
    let introduction = Introduction {
        name: "away".into(),
        hop: link(away, away),
        dialed: None,
        mandate: Mandate::Unproved,
    };
    bench.core.handle_introduced(bench.now, &introduction);
    let junk = bench.letter(link(LIAR, LIAR), (ROVER, ARM), 1);
    assert!(is_refused(&junk), "{junk:?}");
    let real = bench.letter(link(away, away), (ROVER, ARM), 1);
    assert_eq!(real, Reaction::Later);
}

#[test]
fn letters_of_one_host_are_not_relayed_to_another() {
    let mut bench = Bench::new();
    let own = Incarnation::from_u64(99);
    let verdict = bench.letter(link(LIAR, LIAR), (own, ROVER), 1);
    let Reaction::Now(Answer::Failed { reason, .. }) = verdict else {
        panic!("{verdict:?}");
    };
    assert_eq!(reason, FailureReason::NoSuchAgent);
}

#[test]
fn an_unknown_sender_belongs_to_the_first_link() {
    let mut bench = Bench::new();
    let stranger = Incarnation::from_u64(99);
    let first = bench.letter(link(HONEST, HONEST), (stranger, ARM), 1);
    assert_eq!(first, Reaction::Later);
    let second = bench.letter(link(LIAR, LIAR), (stranger, ARM), 2);
    assert!(is_refused(&second), "{second:?}");
}

/// A hello that names the registration of an agent takes nothing from that agent.
#[test]
fn a_service_that_introduces_itself_as_an_agent_of_another_host_takes_nothing_from_it() {
    let mut bench = Bench::new();
    let stranger = Incarnation::from_u64(99);
    let reaction = bench.letter(link(HONEST, HONEST), (stranger, ARM), 1);
    assert_eq!(reaction, Reaction::Later);
    for agent in [ROVER, stranger] {
        let introduction = Introduction {
            name: "rover".into(),
            hop: link(agent, LIAR),
            dialed: None,
            mandate: Mandate::Unproved,
        };
        assert!(bench.core.accepts(&introduction), "as {agent}");
        bench.core.handle_introduced(bench.now, &introduction);
        let junk = bench.letter(link(LIAR, LIAR), (agent, ARM), 2);
        assert!(is_refused(&junk), "{junk:?}");
        // A letter of the service itself is of another realm.
        let own = bench.letter(link(agent, LIAR), (agent, ARM), 2);
        assert_eq!(own, Reaction::Later);
        let real = bench.letter(link(HONEST, HONEST), (agent, ARM), 2);
        assert_eq!(real, Reaction::Later, "of {agent}");
    }
}

/// A transport that knows the incarnation by its hello only would hand over letters for that service.
#[test]
fn a_connected_service_is_accepted_with_its_own_certificate_only() {
    let bench = Bench::new();
    let accepts = |claimed, principal| {
        bench.core.accepts(&Introduction {
            name: "mts".into(),
            hop: link(claimed, principal),
            dialed: None,
            mandate: Mandate::Unproved,
        })
    };
    assert!(accepts(HONEST, HONEST));
    assert!(!accepts(HONEST, LIAR));
    assert!(accepts(LIAR, LIAR));
    assert!(accepts(Incarnation::from_u64(77), LIAR));
    // What another gateway lists keeps no certificate out; what this host has does.
    assert!(accepts(ROVER, LIAR));
    assert!(!accepts(ARM, LIAR));
}

/// Registrations are public, so a gateway can list one of another gateway for an agent of its own, also before it
/// comes to know the other gateway.
#[test]
fn a_registration_that_two_certificates_list_is_two_senders() {
    let mut bench = Bench::with(&[("stray", ROVER, LIAR), ("rover", ROVER, HONEST)]);
    let letter = |bench: &mut Bench, holder, name: &str, sequence| {
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new(name).unwrap())
            .receiver(AgentId::new("arm").unwrap());
        let letter = letter_for(&message.build().unwrap(), SystemTime::UNIX_EPOCH).unwrap();
        let body = (sequence, Body::Letter(letter));
        bench.arrives(link(holder, holder), (ROVER, ARM), body)
    };
    for sequence in 1..=3 {
        let stray = letter(&mut bench, LIAR, "stray", sequence);
        assert_eq!(stray, Reaction::Later);
    }
    let mut realms = HashSet::new();
    for sequence in 1..=3 {
        let real = letter(&mut bench, HONEST, "rover", sequence);
        assert_eq!(real, Reaction::Later, "{sequence}");
    }
    while let Some((_, _, parcel)) = dispatched(&mut bench) {
        assert_eq!(parcel.stream.sender, ROVER);
        realms.insert(parcel.stream.realm);
    }
    assert_eq!(realms.len(), 2, "{realms:?}");
}

/// Another host may announce an agent of its own with the registration of the receiver.
#[test]
fn letters_go_to_the_registration_of_the_name_that_they_are_sent_to() {
    let mut bench = Bench::with(&[("stray", ROVER, LIAR), ("rover", ROVER, HONEST)]);
    let camera = Incarnation::from_u64(50);
    bench.core.register("camera".into(), camera);
    let submission = Submission {
        sender: camera,
        letter: letter(),
        receivers: vec!["rover".into()],
        deadline: Duration::from_secs(5),
    };
    bench.core.submit(bench.now, submission);
    let Some(Action::Dispatch { location, .. }) = bench.core.poll_action() else {
        panic!("the letter is dispatched");
    };
    assert_eq!(location.incarnation(), HONEST);
}

#[test]
fn a_certificate_replaces_a_claim_without_proof() {
    let mut bench = Bench::new();
    let service = Incarnation::from_u64(77);
    let introduction = |name: &str, principal| Introduction {
        name: name.into(),
        hop: Hop {
            principal,
            ..link(service, HONEST)
        },
        dialed: None,
        mandate: Mandate::Unproved,
    };
    let claim = introduction("other", Principal::Unproved);
    bench.core.handle_introduced(bench.now, &claim);
    let proved = introduction("mts", link(service, HONEST).principal);
    assert!(bench.core.accepts(&proved));
    bench.core.handle_introduced(bench.now, &proved);
    assert!(!bench.core.accepts(&claim));
    // The end of the claimant's connection changes nothing.
    bench.core.handle_disconnected(bench.now, &claim);
    assert!(!bench.core.accepts(&claim));
}

#[test]
fn only_a_service_that_was_handed_a_letter_can_report_on_it() {
    let mut bench = Bench::new();
    bench
        .core
        .register("camera".into(), Incarnation::from_u64(50));
    let submission = Submission {
        sender: Incarnation::from_u64(50),
        letter: letter(),
        receivers: vec!["rover".into()],
        deadline: Duration::from_secs(5),
    };
    bench.core.submit(bench.now, submission);
    let Some(Action::Dispatch {
        attempt, parcel, ..
    }) = bench.core.poll_action()
    else {
        panic!("the letter is dispatched");
    };
    let custody = Conclusion::Answered(Answer::Custody);
    bench.core.handle_conclusion(bench.now, attempt, custody);
    let report_on = |bench: &mut Bench, from, receiver| {
        let delivered = Outcome::Delivered {
            via: Kind::Tcp,
            attempts: Vec::new(),
        };
        let report = Parcel {
            stream: Stream {
                receiver,
                ..parcel.stream
            },
            body: Body::Report(Report::Settled(delivered)),
            ..parcel.clone()
        };
        bench.tickets += 1;
        let arrival = Arrival {
            parcel: report,
            from,
            ticket: Some(Ticket(bench.tickets)),
        };
        let now = bench.now;
        bench.core.handle_arrival(now, Kind::Tcp, arrival);
        let actions = std::iter::from_fn(|| bench.core.poll_action());
        actions
            .filter(|action| matches!(action, Action::Outcome { .. }))
            .count()
    };
    assert_eq!(report_on(&mut bench, link(LIAR, LIAR), ROVER), 0);
    assert_eq!(report_on(&mut bench, link(HONEST, LIAR), ROVER), 0);
    // About a letter for another registration of the name.
    assert_eq!(report_on(&mut bench, link(HONEST, HONEST), LAMP), 0);
    assert_eq!(report_on(&mut bench, link(HONEST, HONEST), ROVER), 1);
}

/// Hands the process of `arm` a letter of `rover`, which it takes into custody, and returns the
/// letter's parcel.
fn handed_to_process(bench: &mut Bench) -> Parcel {
    let taken = bench.letter(link(HONEST, HONEST), (ROVER, ARM), 1);
    assert_eq!(taken, Reaction::Later);
    let (attempt, location, parcel) = dispatched(bench).expect("the letter is passed on");
    assert_eq!(location.incarnation(), PROCESS);
    let custody = Conclusion::Answered(Answer::Custody);
    bench.core.handle_conclusion(bench.now, attempt, custody);
    parcel
}

fn dispatched(bench: &mut Bench) -> Option<(AttemptId, Location, Parcel)> {
    std::iter::from_fn(|| bench.core.poll_action()).find_map(|action| match action {
        Action::Dispatch {
            attempt,
            location,
            parcel,
        } => Some((attempt, location, parcel)),
        _ => None,
    })
}

fn process_at(address: &str) -> Hop {
    Hop {
        location: at(PROCESS, address),
        principal: Principal::Host,
    }
}

/// Also for a process that the gateway reaches over TCP.
#[test]
fn a_report_from_the_network_in_the_name_of_a_local_process_is_ignored() {
    for address in ["shm://arms", "tcp://127.0.0.1:9"] {
        let mut bench = Bench::with_process(&[("rover", ROVER, HONEST)], address);
        let parcel = handed_to_process(&mut bench);
        let delivered = Outcome::Delivered {
            via: Kind::Shm,
            attempts: Vec::new(),
        };
        let report = |bench: &mut Bench, from| {
            let arrival = Arrival {
                parcel: Parcel {
                    body: Body::Report(Report::Settled(delivered.clone())),
                    ..parcel.clone()
                },
                from,
                ticket: Some(Ticket(1000)),
            };
            let now = bench.now;
            bench.core.handle_arrival(now, Kind::Tcp, arrival);
            std::iter::from_fn(|| bench.core.poll_action())
                .any(|action| matches!(action, Action::Answer { .. }))
        };
        for other in [link(PROCESS, LIAR), stranger(PROCESS)] {
            assert!(!report(&mut bench, other), "at {address}");
        }
        assert!(report(&mut bench, process_at(address)), "at {address}");
    }
}

/// A credit makes a letter go again, so another peer could have it sent as often as it likes.
#[test]
fn only_the_service_that_was_busy_gives_credit() {
    for address in ["shm://arms", "tcp://127.0.0.1:9"] {
        let mut bench = Bench::with_process(&[("rover", ROVER, HONEST)], address);
        bench.letter(link(HONEST, HONEST), (ROVER, ARM), 1);
        let (attempt, _, _) = dispatched(&mut bench).expect("the letter is passed on");
        let busy = Conclusion::Answered(Answer::Busy);
        bench.core.handle_conclusion(bench.now, attempt, busy);
        for other in [link(LIAR, LIAR), link(PROCESS, LIAR), stranger(PROCESS)] {
            bench.arrives(other, (ROVER, ARM), (0, Body::Credit));
            assert!(dispatched(&mut bench).is_none(), "at {address}");
        }
        bench.arrives(process_at(address), (ROVER, ARM), (0, Body::Credit));
        assert!(dispatched(&mut bench).is_some(), "at {address}");
    }
}

/// The gateway of the receiver has not connected yet, so its incarnation is a claim.
#[test]
fn a_report_counts_only_from_a_service_that_introduced_itself_with_its_certificate() {
    let away = Incarnation::from_u64(8);
    let mut bench = Bench::with(&[("rover", ROVER, away)]);
    let camera = Incarnation::from_u64(50);
    bench.core.register("camera".into(), camera);
    let submission = Submission {
        sender: camera,
        letter: letter(),
        receivers: vec!["rover".into()],
        deadline: Duration::from_secs(5),
    };
    bench.core.submit(bench.now, submission);
    let (_, location, parcel) = dispatched(&mut bench).expect("the letter is dispatched");
    assert_eq!(location.incarnation(), away);
    let delivered = Outcome::Delivered {
        via: Kind::Tcp,
        attempts: Vec::new(),
    };
    let mut report = |principal| {
        let arrival = Arrival {
            parcel: Parcel {
                body: Body::Report(Report::Settled(delivered.clone())),
                ..parcel.clone()
            },
            from: Hop {
                principal,
                ..link(away, LIAR)
            },
            ticket: Some(Ticket(1)),
        };
        let now = bench.now;
        bench.core.handle_arrival(now, Kind::Tcp, arrival);
        std::iter::from_fn(|| bench.core.poll_action())
            .any(|action| matches!(action, Action::Outcome { .. }))
    };
    assert!(!report(link(away, LIAR).principal));
    assert!(report(Principal::Unproved), "without keys, claims count");
}

/// A lowered predecessor would let a letter pass over an earlier one.
#[test]
fn only_the_service_that_handed_a_letter_over_lowers_its_predecessor() {
    let mut bench = Bench::new();
    let camera = Incarnation::from_u64(50);
    let listed = vec![at(PROCESS, "tcp://127.0.0.1:9")];
    let own = Arc::new(MemoryDirectory::new(MtsId::new("mts", PROCESS)));
    own.register(Registration::new("camera", camera, listed.clone()))
        .unwrap();
    own.register(Registration::new("arm", ARM, listed)).unwrap();
    bench
        .core
        .set_view(Arc::new(MergedDirectory::new(vec![own])));
    let handed = bench.letter(process_at("tcp://127.0.0.1:9"), (camera, ARM), 7);
    assert_eq!(handed, Reaction::Later);
    let note = |bench: &mut Bench, from| bench.arrives(from, (camera, ARM), (7, Body::Predecessor));
    for other in [link(LIAR, LIAR), link(PROCESS, LIAR), stranger(PROCESS)] {
        let answer = note(&mut bench, other);
        assert_ne!(answer, Reaction::Now(Answer::Accepted));
    }
    let own = note(&mut bench, process_at("tcp://127.0.0.1:9"));
    assert_eq!(own, Reaction::Now(Answer::Accepted));
}

/// The names of gateways and agents of this host are public.
#[test]
fn no_other_host_is_a_service_that_this_host_lists() {
    let mut bench = Bench::new();
    let own = Arc::new(MemoryDirectory::new(MtsId::new("mts", GATEWAY)));
    let mut gateway = Registration::new("mts", GATEWAY, vec![at(GATEWAY, "shm://mts")]);
    gateway.role = Role::Gateway;
    own.register(gateway).unwrap();
    bench
        .core
        .set_view(Arc::new(MergedDirectory::new(vec![own])));
    let introduction = Introduction {
        name: "liar".into(),
        hop: link(GATEWAY, LIAR),
        dialed: None,
        mandate: Mandate::Unproved,
    };
    assert!(!bench.core.accepts(&introduction));
    let letter = bench.letter(link(GATEWAY, LIAR), (Incarnation::from_u64(99), ARM), 1);
    assert!(is_refused(&letter), "{letter:?}");
}

#[test]
fn letters_that_one_receiver_leaves_in_custody_do_not_use_up_the_room_of_others() {
    let own = Arc::new(MemoryDirectory::new(MtsId::new("mts", PROCESS)));
    for (name, agent) in [("arm", ARM), ("lamp", LAMP)] {
        let location = vec![at(PROCESS, "shm://arms")];
        own.register(Registration::new(name, agent, location))
            .unwrap();
    }
    let config = CoreConfig {
        forwards: true,
        custody_bytes: 200_000,
        ..CoreConfig::new("mts", GATEWAY, vec![Kind::Shm])
    };
    let mut bench = Bench::new();
    bench.core = Core::new(config, Arc::new(MergedDirectory::new(vec![own])));
    let fill = |bench: &mut Bench, receiver| {
        let verdict = |sequence| bench.letter(link(HONEST, HONEST), (ROVER, receiver), sequence);
        let verdicts = (1..=1000).map(verdict);
        verdicts.take_while(|it| *it == Reaction::Later).count()
    };
    let (arm, lamp) = (fill(&mut bench, ARM), fill(&mut bench, LAMP));
    assert!(arm < 1000, "the custody is bounded");
    assert!(lamp >= arm / 2, "{arm} letters, then {lamp}");
}

/// Invented senders, each with one small letter, from one link.
fn invent(bench: &mut Bench, senders: std::ops::Range<u64>) -> Vec<Reaction> {
    let senders = senders.map(|sender| Incarnation::from_u64(1000 + sender));
    let letters = senders.map(|sender| bench.letter(link(LIAR, LIAR), (sender, ARM), 1));
    letters.collect()
}

/// Each sender has a lane, whose state takes more memory than a small letter.
#[test]
fn letters_of_invented_senders_take_bounded_memory() {
    let own = Arc::new(MemoryDirectory::new(MtsId::new("mts", PROCESS)));
    let location = vec![at(PROCESS, "shm://arms")];
    own.register(Registration::new("arm", ARM, location))
        .unwrap();
    let config = CoreConfig {
        forwards: true,
        custody_bytes: 16 << 20,
        ..CoreConfig::new("mts", GATEWAY, vec![Kind::Shm])
    };
    let mut bench = Bench::new();
    bench.core = Core::new(config, Arc::new(MergedDirectory::new(vec![own])));
    let verdicts = invent(&mut bench, 0..10_000);
    let taken = verdicts.iter().filter(|it| **it == Reaction::Later).count();
    // Half of the custody is for other receivers.
    assert!((1000..=2048).contains(&taken), "{taken} letters");
    let held_back = |it: &&Reaction| **it == Reaction::Now(Answer::Busy);
    let held_back = verdicts.iter().filter(held_back).count();
    assert_eq!(taken + held_back, verdicts.len());
    let lanes = lanes(&mut bench);
    assert!(lanes <= 4096, "{lanes} lanes");
}

/// Each agent that becomes known by a letter is published to all processes of the host.
#[test]
fn a_peer_that_invents_senders_makes_few_of_them_known() {
    let mut bench = Bench::new();
    let reaction = |bench: &mut Bench, number: u64| {
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new(format!("invented_{number}")).unwrap())
            .receiver(AgentId::new("arm").unwrap());
        let letter = letter_for(&message.build().unwrap(), SystemTime::UNIX_EPOCH).unwrap();
        let stream = (Incarnation::from_u64(1000 + number), ARM);
        let verdict = bench.arrives(link(LIAR, LIAR), stream, (1, Body::Letter(letter)));
        assert_eq!(verdict, Reaction::Later);
        let actions = std::iter::from_fn(|| bench.core.poll_action());
        actions
            .filter(|action| matches!(action, Action::ContactSeen { .. }))
            .count()
    };
    let at_once: usize = (0..2000).map(|number| reaction(&mut bench, number)).sum();
    assert_eq!(at_once, 1000);
    bench.now.instant += Duration::from_secs(1);
    let later: usize = (2000..3000)
        .map(|number| reaction(&mut bench, number))
        .sum();
    assert_eq!(later, 50);
}

/// Number of letters that are handed over, after the requested refreshes.
fn handed_over(bench: &mut Bench) -> usize {
    let mut letters = 0;
    while let Some(action) = bench.core.poll_action() {
        match action {
            Action::Dispatch { parcel, .. } if matches!(parcel.body, Body::Letter(_)) => {
                letters += 1;
            }
            Action::Refresh { number } => bench.core.handle_refreshed(bench.now, number),
            _ => {}
        }
    }
    letters
}

/// An agent that registers often is announced by its gateway, and can then be answered.
#[test]
fn a_letter_of_an_agent_beyond_the_limit_waits_for_the_announcement() {
    let mut bench = Bench::with(&[]);
    for (number, count) in [(1000, 1), (1001, 1), (1002, 0)] {
        let stream = (Incarnation::from_u64(number), ARM);
        let verdict = bench.letter(link(LIAR, LIAR), stream, 1);
        assert_eq!(verdict, Reaction::Later);
        assert_eq!(handed_over(&mut bench), count);
    }
    for (wait, count) in [(499, 0), (1, 1)] {
        bench.now.instant += Duration::from_millis(wait);
        bench.core.handle_timeout(bench.now);
        assert_eq!(handed_over(&mut bench), count);
    }
}

/// The receiver may answer at once, and must find the sender in the directory of its own process.
#[test]
fn the_first_letter_of_an_agent_waits_until_its_host_sees_it() {
    let crane = Incarnation::from_u64(99);
    let mut bench = Bench::with(&[("rover", ROVER, HONEST), ("crane", crane, HONEST)]);
    let view = bench.core.set_view(Arc::new(MergedDirectory::new(vec![])));
    bench.core.set_view(view);
    bench.letter(link(HONEST, HONEST), (ROVER, ARM), 1);
    let refresh = bench.core.poll_action();
    let Some(Action::ContactSeenAgain { .. }) = refresh else {
        panic!("{refresh:?}");
    };
    let refresh = bench.core.poll_action();
    let Some(Action::Refresh { number }) = refresh else {
        panic!("{refresh:?}");
    };
    assert!(bench.core.poll_action().is_none());
    bench.core.handle_published();
    bench.core.handle_refreshed(bench.now, number);
    assert_eq!(handed_over(&mut bench), 1);
    // The next agent is published, too.
    bench.letter(link(HONEST, HONEST), (crane, ARM), 1);
    let actions = std::iter::from_fn(|| bench.core.poll_action());
    let refreshes = actions.filter(|it| matches!(it, Action::Refresh { .. }));
    assert_eq!(refreshes.count(), 0);
}

/// The state of a small letter takes more memory than its bytes.
#[test]
fn small_letters_take_bounded_memory() {
    let own = Arc::new(MemoryDirectory::new(MtsId::new("mts", PROCESS)));
    let location = vec![at(PROCESS, "shm://arms")];
    own.register(Registration::new("arm", ARM, location))
        .unwrap();
    let config = CoreConfig {
        forwards: true,
        custody_bytes: 16 << 20,
        ..CoreConfig::new("mts", GATEWAY, vec![Kind::Shm])
    };
    let mut bench = Bench::new();
    bench.core = Core::new(config, Arc::new(MergedDirectory::new(vec![own])));
    let mut taken = 0;
    for sender in 0..100 {
        let stream = (Incarnation::from_u64(1000 + sender), ARM);
        for sequence in 1..=1000 {
            let verdict = bench.letter(link(LIAR, LIAR), stream, sequence);
            taken += usize::from(verdict == Reaction::Later);
        }
    }
    // A letter has 71 bytes, and half of the custody is for other receivers.
    assert!((1000..=8192).contains(&taken), "{taken} letters");
}

/// A peer decides how often it connects.
#[cfg(debug_assertions)]
#[test]
fn an_introduction_takes_no_steps_for_letters_to_others() {
    let mut bench = Bench::new();
    invent(&mut bench, 0..1000);
    let stranger = Introduction {
        name: "stranger".into(),
        hop: stranger(Incarnation::from_u64(500)),
        dialed: None,
        mandate: Mandate::Unproved,
    };
    let _earlier = fipa_mts::core::work::taken();
    bench.core.handle_introduced(bench.now, &stranger);
    let steps = fipa_mts::core::work::taken();
    assert!(steps < 100, "{steps} steps");
}

/// The number of lanes: events that concern all lanes take at least as many steps.
fn lanes(bench: &mut Bench) -> u64 {
    #[cfg(debug_assertions)]
    {
        let _earlier = fipa_mts::core::work::taken();
        bench.core.handle_reachable(bench.now, None);
        fipa_mts::core::work::taken()
    }
    #[cfg(not(debug_assertions))]
    {
        let _uncounted = bench;
        0
    }
}

#[test]
fn lanes_of_invented_senders_are_dropped_with_their_letters() {
    let mut bench = Bench::new();
    for round in 0..40 {
        invent(&mut bench, round * 500..(round + 1) * 500);
        // The process of `arm` refuses some letters, and takes the others.
        while let Some(action) = bench.core.poll_action() {
            if let Action::Dispatch {
                attempt, parcel, ..
            } = action
            {
                let answer = match parcel.stream.sender.as_u64() % 2 {
                    0 => Answer::failed(FailureReason::Refused, ""),
                    _ => Answer::Accepted,
                };
                let conclusion = Conclusion::Answered(answer);
                bench.core.handle_conclusion(bench.now, attempt, conclusion);
            }
        }
        bench.now.instant += Duration::from_millis(100);
    }
    let lanes = lanes(&mut bench);
    assert!(lanes < 8_000, "{lanes} lanes");
}

/// The position of a letter for `rover` when the trust in its gateway is withdrawn.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Position {
    Waiting,
    UnderWay { arrives: bool },
    InCustody,
}

/// Returns the bench with a letter of the process of `arm` for `rover` in this position.
fn with_letter_for_rover(position: Position) -> (Bench, Option<AttemptId>) {
    let mut bench = Bench::new();
    let taken = bench.letter(process_at("shm://arms"), (ARM, ROVER), 1);
    assert_eq!(taken, Reaction::Later);
    let (attempt, location, _) = dispatched(&mut bench).expect("the letter is passed on");
    assert_eq!(location.incarnation(), HONEST);
    let conclusion = match position {
        Position::Waiting => Conclusion::NotSent(unreachable()),
        Position::InCustody => Conclusion::Answered(Answer::Custody),
        Position::UnderWay { .. } => return (bench, Some(attempt)),
    };
    bench.core.handle_conclusion(bench.now, attempt, conclusion);
    (bench, None)
}

fn unreachable() -> TransportError {
    TransportError::new(TransportErrorKind::Unreachable, "")
}

/// Withdraws the trust in the certificate of this service alone.
fn withdraw(bench: &mut Bench, service: Incarnation) -> Vec<Incarnation> {
    let Principal::Certificate(withdrawn) = link(service, service).principal else {
        panic!("no certificate");
    };
    let now = bench.now;
    let services = bench.core.handle_trust(now, |it| *it != withdrawn);
    services.into_iter().map(|(service, _)| service).collect()
}

/// Returns the end of a letter that was handed over, and its details: an answer, or a report after custody.
fn ended(bench: &mut Bench) -> Option<(FailureReason, String)> {
    std::iter::from_fn(|| bench.core.poll_action()).find_map(|action| match action {
        Action::Answer {
            answer: Answer::Failed { reason, detail },
            ..
        } => Some((reason, detail)),
        Action::Dispatch { parcel, .. } => match parcel.body {
            Body::Report(Report::Settled(Outcome::Failed { reason, attempts })) => {
                Some((reason, format!("{attempts:?}")))
            }
            _ => None,
        },
        _ => None,
    })
}

/// Whether a letter is handed over.
fn hands_over(bench: &mut Bench) -> bool {
    std::iter::from_fn(|| bench.core.poll_action()).any(|action| {
        matches!(action, Action::Dispatch { parcel, .. } if matches!(parcel.body, Body::Letter(_)))
    })
}

#[test]
fn letters_for_a_gateway_without_trust_end_as_refused_unless_it_may_have_taken_them() {
    use FailureReason::{Refused, Unconfirmed};

    for (position, expected) in [
        (Position::Waiting, Refused),
        (Position::UnderWay { arrives: false }, Refused),
        (Position::UnderWay { arrives: true }, Unconfirmed),
        (Position::InCustody, Unconfirmed),
    ] {
        let (mut bench, attempt) = with_letter_for_rover(position);
        assert_eq!(withdraw(&mut bench, HONEST), [HONEST]);
        if let Some(attempt) = attempt {
            let abandoned = std::iter::from_fn(|| bench.core.poll_action())
                .any(|action| matches!(action, Action::Abandon { .. }));
            assert!(abandoned, "{position:?}");
            let conclusion = match position {
                Position::UnderWay { arrives: true } => Conclusion::Unconfirmed(unreachable()),
                _ => Conclusion::NotSent(unreachable()),
            };
            bench.core.handle_conclusion(bench.now, attempt, conclusion);
        }
        let Some((reason, detail)) = ended(&mut bench) else {
            panic!("{position:?}: the letter has no end");
        };
        assert_eq!(reason, expected, "{position:?}: {detail}");
        assert!(
            detail.contains("the trust in the certificate of"),
            "{detail}"
        );
        // A later letter is not handed over either, while the directory still lists the receiver.
        bench.letter(process_at("shm://arms"), (ARM, ROVER), 2);
        assert!(!hands_over(&mut bench), "{position:?}");
        // Until the gateway is trusted again.
        assert!(withdraw(&mut bench, LIAR).contains(&LIAR));
        bench.letter(process_at("shm://arms"), (ARM, ROVER), 3);
        assert!(hands_over(&mut bench), "{position:?}");
    }
}

#[test]
fn withdrawn_trust_in_another_gateway_ends_no_letter() {
    let (mut bench, _) = with_letter_for_rover(Position::InCustody);
    withdraw(&mut bench, LIAR);
    assert_eq!(ended(&mut bench), None);
}

#[test]
fn letters_that_were_taken_from_a_gateway_before_it_lost_trust_are_delivered() {
    let mut bench = Bench::new();
    let taken = bench.letter(link(HONEST, HONEST), (ROVER, ARM), 1);
    assert_eq!(taken, Reaction::Later);
    let (attempt, _, _) = dispatched(&mut bench).expect("the letter is passed on");
    let busy = Conclusion::Answered(Answer::Busy);
    bench.core.handle_conclusion(bench.now, attempt, busy);
    withdraw(&mut bench, HONEST);
    assert_eq!(ended(&mut bench), None);
    bench.arrives(process_at("shm://arms"), (ROVER, ARM), (0, Body::Credit));
    assert!(hands_over(&mut bench), "the letter stays");
}
