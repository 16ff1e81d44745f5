//! The access gate: called once for each letter, with the agent that receives it.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now};
use fipa_mts::{AccessGate, LetterParts, LetterSource, Link, letter_for};
use fipa_sds::{Directory, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, Arrival, Body, FailureReason, Hop, Incarnation, Kind, Location, Parcel, Principal,
    Reaction, Stream,
};
use parking_lot::Mutex;

const ARM: Incarnation = Incarnation::from_u64(0xa);
const BRAKE: Incarnation = Incarnation::from_u64(0xb);

/// Refuses all letters to `brake`, and records the receivers that it was called for.
#[derive(Default)]
struct Guarded(Mutex<Vec<String>>);

impl AccessGate for Guarded {
    fn read(&self, _: &Letter) -> LetterParts {
        LetterParts::default()
    }

    fn admits(
        &self,
        _: Instant,
        receiver: &str,
        _: &LetterParts,
        link: Link,
    ) -> Result<(), String> {
        assert_eq!(link.via, Kind::Shm);
        assert_eq!(link.service, Incarnation::from_u64(1), "the other end");
        assert_eq!(link.source, LetterSource::Process(Incarnation::from_u64(1)));
        self.0.lock().push(receiver.to_owned());
        match receiver {
            "brake" => Err("hands off".to_owned()),
            _ => Ok(()),
        }
    }
}

fn now() -> Now {
    Now {
        instant: Instant::now(),
        utc: SystemTime::UNIX_EPOCH,
    }
}

/// A letter to this registration of an agent, with this name in the parcel.
fn arrival(to: Incarnation, called: &str, sequence: u64) -> Arrival {
    let message = Message::builder(Performative::Request)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new(called).unwrap())
        .build()
        .unwrap();
    let parcel = Parcel {
        receiver: called.into(),
        stream: Stream::between(Incarnation::from_u64(1), to),
        sequence,
        after: sequence - 1,
        remaining: Duration::from_secs(5),
        transfer: 0,
        body: Body::Letter(letter_for(&message, SystemTime::UNIX_EPOCH).unwrap()),
    };
    let location: Location = "shm://1#0000000000000001".parse().unwrap();
    Arrival {
        parcel,
        from: Hop {
            location,
            principal: Principal::Host,
        },
        ticket: None,
    }
}

fn refused() -> Reaction {
    Reaction::Now(Answer::failed(FailureReason::Refused, "hands off"))
}

fn config(forwards: bool) -> CoreConfig {
    CoreConfig {
        forwards,
        queue: 2,
        ..CoreConfig::new("mts", Incarnation::from_u64(7), vec![Kind::Shm])
    }
}

#[test]
fn the_gate_is_called_once_per_letter_and_only_when_there_is_room() {
    let gate = Arc::new(Guarded::default());
    let directory = MemoryDirectory::new(MtsId::new("mts", Incarnation::from_u64(7)));
    let mut core = Core::new(config(false), Arc::new(directory)).gated(gate.clone());
    core.register("arm".into(), ARM);
    core.register("brake".into(), BRAKE);
    let mut arrive =
        |to, called, sequence| core.handle_arrival(now(), Kind::Shm, arrival(to, called, sequence));
    let accepted = Reaction::Now(Answer::Accepted);
    assert_eq!(arrive(ARM, "arm", 1), accepted);
    assert_eq!(arrive(ARM, "arm", 1), accepted, "a copy");
    assert_eq!(arrive(ARM, "arm", 2), accepted);
    assert_eq!(arrive(ARM, "arm", 3), Reaction::Now(Answer::Busy));
    assert_eq!(*gate.0.lock(), ["arm", "arm"]);
    // The registration is that of `brake`; the name in the parcel does not matter.
    assert_eq!(arrive(BRAKE, "arm", 1), refused());
    assert_eq!(core.waiting(BRAKE), 0);
    assert_eq!(core.waiting(ARM), 2);
}

#[test]
fn a_gateway_calls_the_gate_with_the_registered_name() {
    let gate = Arc::new(Guarded::default());
    let directory = MemoryDirectory::new(MtsId::new("process", Incarnation::from_u64(9)));
    for (name, life) in [("arm", ARM), ("brake", BRAKE)] {
        let at = "shm://9#0000000000000009".parse().unwrap();
        let agent = Registration::new(name, life, vec![at]);
        directory.register(agent).unwrap();
    }
    let mut core = Core::new(config(true), Arc::new(directory)).gated(gate.clone());
    let verdict = core.handle_arrival(now(), Kind::Shm, arrival(BRAKE, "brake", 1));
    assert_eq!(verdict, refused());
    // No agent has this registration and this name.
    let verdict = core.handle_arrival(now(), Kind::Shm, arrival(BRAKE, "arm", 1));
    let Reaction::Now(Answer::Failed { reason, .. }) = verdict else {
        panic!("{verdict:?}");
    };
    assert_eq!(reason, FailureReason::NoSuchAgent);
    assert!(core.poll_action().is_none(), "the refusal caused no action");
    for _ in 0..2 {
        let verdict = core.handle_arrival(now(), Kind::Shm, arrival(ARM, "arm", 1));
        assert_eq!(verdict, Reaction::Now(Answer::Custody));
    }
    assert_eq!(
        *gate.0.lock(),
        ["brake", "arm"],
        "the copy is in custody already"
    );
    assert!(matches!(core.poll_action(), Some(Action::Dispatch { .. })));
}
