//! Trusted peers that speak for others: with certificates, each peer speaks for itself and its agents.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::letter_for;
use fipa_sds::{ContactDirectory, Directory, MemoryDirectory, MergedDirectory, Mts, Registration};
use fipa_transport::{
    Answer, Arrival, Body, Conclusion, FailureReason, Hop, Incarnation, Introduction, Kind,
    Location, Mandate, Outcome, Parcel, Principal, Report, Stream, Ticket, Verdict,
};

const GATEWAY: Incarnation = Incarnation::from_u64(1);
/// A process of this host, with the agent `arm`.
const PROCESS: Incarnation = Incarnation::from_u64(2);
const ARM: Incarnation = Incarnation::from_u64(3);
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

fn letter() -> Letter {
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap();
    letter_for(&message, SystemTime::UNIX_EPOCH).unwrap()
}

impl Bench {
    fn new() -> Self {
        Self::with(&[("rover", ROVER, HONEST)])
    }

    /// A gateway that knows these agents at other gateways.
    fn with(agents: &[(&str, Incarnation, Incarnation)]) -> Self {
        let own = Arc::new(MemoryDirectory::new(Mts::new("mts", PROCESS)));
        let arm = vec![at(PROCESS, "shm://arms")];
        own.register(Registration::new("arm", ARM, arm)).unwrap();
        let contacts = Arc::new(ContactDirectory::new());
        for (name, agent, gateway) in agents {
            let location = at(*gateway, "tcp://192.0.2.4:1");
            let heard = contacts.heard(Instant::now(), name, *agent, location);
            heard.unwrap();
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
                dialled: None,
                mandate: Mandate::Unproved,
            };
            core.handle_introduced(now, &introduction);
        }
        Self {
            core,
            now,
            tickets: 0,
        }
    }

    fn arrives(
        &mut self,
        from: Hop,
        stream: (Incarnation, Incarnation),
        what: (u64, Body),
    ) -> Verdict {
        let ((sender, receiver), (sequence, body)) = (stream, what);
        self.tickets += 1;
        let parcel = Parcel {
            receiver: if receiver == GATEWAY { "mts" } else { "arm" }.into(),
            stream: Stream { sender, receiver },
            sequence,
            after: 0,
            transfer: 1,
            remaining: Duration::from_secs(5),
            body,
        };
        let ticket = Ticket(self.tickets);
        let arrival = Arrival {
            parcel,
            from,
            ticket,
        };
        self.core
            .handle_arrival(self.now, Kind::Tcp, false, arrival)
    }

    fn letter(&mut self, from: Hop, stream: (Incarnation, Incarnation), sequence: u64) -> Verdict {
        self.arrives(from, stream, (sequence, Body::Letter(letter())))
    }
}

fn is_refused(verdict: &Verdict) -> bool {
    let reason = FailureReason::Refused;
    matches!(verdict, Verdict::Now(Answer::Failed { reason: it, .. }) if *it == reason)
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
    assert_eq!(own, Verdict::Now(Answer::Accepted));
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
    assert_eq!(real, Verdict::Later);
    // Another host cannot speak for an agent of this one either.
    let own = bench.letter(link(LIAR, LIAR), (ARM, GATEWAY), 1);
    assert!(is_refused(&own), "{own:?}");
}

#[test]
fn an_unknown_sender_belongs_to_the_first_link() {
    let mut bench = Bench::new();
    let stranger = Incarnation::from_u64(99);
    let first = bench.letter(link(HONEST, HONEST), (stranger, ARM), 1);
    assert_eq!(first, Verdict::Later);
    let second = bench.letter(link(LIAR, LIAR), (stranger, ARM), 2);
    assert!(is_refused(&second), "{second:?}");
}

/// A hello that names the registration of an agent takes nothing from that agent.
#[test]
fn a_service_cannot_introduce_itself_as_the_agent_of_another_host() {
    let mut bench = Bench::new();
    let stranger = Incarnation::from_u64(99);
    let heard = bench.letter(link(HONEST, HONEST), (stranger, ARM), 1);
    assert_eq!(heard, Verdict::Later);
    for agent in [ROVER, stranger] {
        let introduction = Introduction {
            name: "rover".into(),
            hop: link(agent, LIAR),
            dialled: None,
            mandate: Mandate::Unproved,
        };
        assert!(!bench.core.accepts(&introduction), "as {agent}");
        bench.core.handle_introduced(bench.now, &introduction);
        let junk = bench.letter(link(agent, LIAR), (agent, ARM), 2);
        assert!(is_refused(&junk), "{junk:?}");
        let real = bench.letter(link(HONEST, HONEST), (agent, ARM), 2);
        assert_eq!(real, Verdict::Later, "of {agent}");
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
            dialled: None,
            mandate: Mandate::Unproved,
        })
    };
    assert!(accepts(HONEST, HONEST));
    assert!(!accepts(HONEST, LIAR));
    assert!(accepts(LIAR, LIAR));
    assert!(accepts(Incarnation::from_u64(77), LIAR));
    // Of agents, a gateway has connected and this host has one.
    assert!(!accepts(ROVER, LIAR));
    assert!(!accepts(ARM, LIAR));
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
    bench.core.send(bench.now, submission);
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
        dialled: None,
        mandate: Mandate::Unproved,
    };
    let claim = introduction("other", Principal::Unproved);
    bench.core.handle_introduced(bench.now, &claim);
    let proved = introduction("mts", link(service, HONEST).principal);
    assert!(bench.core.accepts(&proved));
    bench.core.handle_introduced(bench.now, &proved);
    assert!(!bench.core.accepts(&claim));
    // The end of the claimant's connection changes nothing.
    bench.core.handle_parted(bench.now, &claim);
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
    bench.core.send(bench.now, submission);
    let Some(Action::Dispatch {
        attempt, parcel, ..
    }) = bench.core.poll_action()
    else {
        panic!("the letter is dispatched");
    };
    let custody = Conclusion::Answered(Answer::Custody);
    bench.core.handle_conclusion(bench.now, attempt, custody);
    let report = |bench: &mut Bench, from| {
        let delivered = Outcome::Delivered {
            via: Kind::Tcp,
            attempts: Vec::new(),
        };
        let report = Parcel {
            body: Body::Report(Report::Settled(delivered)),
            ..parcel.clone()
        };
        bench.tickets += 1;
        let arrival = Arrival {
            parcel: report,
            from,
            ticket: Ticket(bench.tickets),
        };
        let now = bench.now;
        bench.core.handle_arrival(now, Kind::Tcp, false, arrival);
        let actions = std::iter::from_fn(|| bench.core.poll_action());
        actions
            .filter(|action| matches!(action, Action::Outcome { .. }))
            .count()
    };
    assert_eq!(report(&mut bench, link(LIAR, LIAR)), 0);
    assert_eq!(report(&mut bench, link(HONEST, LIAR)), 0);
    assert_eq!(report(&mut bench, link(HONEST, HONEST)), 1);
}

#[test]
fn a_report_from_the_network_in_the_name_of_a_local_process_is_ignored() {
    let mut bench = Bench::new();
    let taken = bench.letter(link(HONEST, HONEST), (ROVER, ARM), 1);
    assert_eq!(taken, Verdict::Later);
    let Some(Action::Dispatch {
        attempt,
        location,
        parcel,
    }) = std::iter::from_fn(|| bench.core.poll_action())
        .find(|action| matches!(action, Action::Dispatch { .. }))
    else {
        panic!("the letter is passed on");
    };
    assert_eq!(location.incarnation(), PROCESS);
    let custody = Conclusion::Answered(Answer::Custody);
    bench.core.handle_conclusion(bench.now, attempt, custody);
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
            ticket: Ticket(1000),
        };
        let now = bench.now;
        bench.core.handle_arrival(now, Kind::Tcp, false, arrival);
        std::iter::from_fn(|| bench.core.poll_action())
            .any(|action| matches!(action, Action::Answer { .. }))
    };
    assert!(!report(&mut bench, link(PROCESS, LIAR)));
    let process = Hop {
        location: at(PROCESS, "shm://arms"),
        principal: Principal::Host,
    };
    assert!(report(&mut bench, process));
}
