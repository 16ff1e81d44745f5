//! A delivery core among peers with ten agents each, one letter at a time.

use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{Letter, Payload};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_sds::{Directory, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, Arrival, Body, Conclusion, Hop, Incarnation, Kind, Location, Parcel, Principal,
    Reaction, Stream, Ticket,
};

/// Number of agents of each peer.
const AGENTS: usize = 10;
/// Incarnation of the service.
const HERE: Incarnation = Incarnation::from_u64(0x4e5e);
/// Incarnation of the agent that sends and receives here.
const ROVER: Incarnation = Incarnation::from_u64(0x50e4);

/// The core with one agent, and all other agents.
pub(crate) struct Crowd {
    core: Core,
    letter: Letter,
    now: Now,
    name: Arc<str>,
    /// The hop from which letters arrive.
    peer: Location,
    /// Number of letters that arrived.
    arrived: u64,
}

impl Crowd {
    /// Names of the agents of this many peers.
    pub(crate) fn names(peers: usize) -> Vec<Arc<str>> {
        (0..peers * AGENTS)
            .map(|n| format!("arm_{n}").into())
            .collect()
    }

    /// A core whose directory has the agents of these names.
    pub(crate) fn new(names: &[Arc<str>]) -> Self {
        let config = CoreConfig::new("here-mts", HERE, vec![Kind::Tcp]);
        let mut core = Core::new(config, directory(names));
        let name: Arc<str> = "rover".into();
        core.register(Arc::clone(&name), ROVER);
        Self {
            core,
            letter: letter(),
            now: Now::read(),
            name,
            peer: peer(0),
            arrived: 0,
        }
    }

    /// The first route of a letter for this agent.
    pub(crate) fn route(&self, receiver: &str) -> Option<Location> {
        self.core.first_way(self.now, receiver)
    }

    /// A letter of 1 KB for this agent, from its submission to its outcome.
    pub(crate) fn send(&mut self, receiver: &Arc<str>) {
        self.send_and(receiver, Core::poll_action);
    }

    /// Sends a letter while letters are watched.
    #[allow(dead_code, reason = "only one of two benches uses it")]
    pub(crate) fn send_watched(&mut self, receiver: &Arc<str>) {
        self.core.watch(true);
        self.send_and(receiver, |core| {
            loop {
                match core.poll_action() {
                    Some(Action::Notice { .. }) => {}
                    other => return other,
                }
            }
        });
    }

    #[inline]
    fn send_and(&mut self, receiver: &Arc<str>, next: impl Fn(&mut Core) -> Option<Action>) {
        self.core.submit(
            self.now,
            Submission {
                sender: ROVER,
                letter: self.letter.clone(),
                receivers: vec![Arc::clone(receiver)],
                deadline: Duration::from_secs(5),
            },
        );
        let Some(Action::Dispatch { attempt, .. }) = next(&mut self.core) else {
            panic!("a letter that is not dispatched");
        };
        let conclusion = Conclusion::Answered(Answer::Accepted);
        self.core.handle_conclusion(self.now, attempt, conclusion);
        let Some(Action::Outcome { outcome, .. }) = next(&mut self.core) else {
            panic!("a letter without an outcome");
        };
        assert!(outcome.is_success());
        assert!(next(&mut self.core).is_none());
    }

    /// A letter of 1 KB for the agent here, from one of the others, until the agent has it.
    pub(crate) fn receive(&mut self, from: usize) {
        self.arrived += 1;
        let parcel = Parcel {
            receiver: Arc::clone(&self.name),
            stream: Stream::between(agent(from), ROVER),
            sequence: self.arrived,
            after: 0,
            remaining: Duration::from_secs(5),
            transfer: 0,
            body: Body::Letter(self.letter.clone()),
        };
        let from = Hop {
            location: self.peer.clone(),
            principal: Principal::Host,
        };
        let arrival = Arrival {
            parcel,
            from,
            ticket: Some(Ticket(self.arrived)),
        };
        let verdict = self.core.handle_arrival(self.now, Kind::Tcp, arrival);
        assert_eq!(verdict, Reaction::Now(Answer::Accepted));
        let Some(Action::Deliverable { agent }) = self.core.poll_action() else {
            panic!("a letter that is not delivered");
        };
        assert!(self.core.take(agent).is_some());
        assert!(self.core.poll_action().is_none());
    }
}

/// A directory with every agent at one of the peers.
fn directory(names: &[Arc<str>]) -> Arc<MemoryDirectory> {
    let directory = MemoryDirectory::new(MtsId::new("here-mts", HERE));
    let peers: Vec<Location> = (0..names.len() / AGENTS).map(peer).collect();
    for (n, (name, location)) in names.iter().zip(peers.iter().cycle()).enumerate() {
        let locations = vec![location.clone()];
        let agent = Registration::new(Arc::clone(name), agent(n), locations);
        directory.register(agent).unwrap();
    }
    Arc::new(directory)
}

fn peer(n: usize) -> Location {
    let address = format!("10.0.{}.{}:7788", n / 250, n % 250 + 1);
    let location = Location::new(Kind::Tcp, &address).unwrap();
    location.with_incarnation(Incarnation::from_u64(0x1_0000 + n as u64))
}

fn agent(n: usize) -> Incarnation {
    Incarnation::from_u64(0x100_0000 + n as u64)
}

fn letter() -> Letter {
    let payload = Payload {
        head: vec![1; 120].into(),
        content: vec![7; 1 << 10].into(),
        tail: vec![1].into(),
    };
    Letter::new(vec![2; 80].into(), payload)
}
