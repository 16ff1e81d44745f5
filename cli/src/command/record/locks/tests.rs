use std::collections::VecDeque;

use fastrand::Rng;
use fipa::AgentId;
use fipa_locking::codec::encode;
use fipa_locking::{
    Action, Algorithm, AnyAlgorithm, ClaimId, Event, LockDialect, LockMessage, LockPeer, Locks,
    Millis, Options, OwnerState, Resource,
};

use super::*;

fn at(millis: Millis) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_millis(millis)
}

fn granted(number: u64) -> Act {
    Act::Granted {
        fence: format!("7.{number}.00000000000000ff@owner#dock")
            .parse()
            .unwrap(),
        lease: 5000,
        asked: 0,
    }
}

/// Letters about the resource `dock`.
#[derive(Default)]
struct Letters(Grants);

impl Letters {
    /// Returns the event and its agent.
    fn act(
        &mut self,
        millis: Millis,
        [sender, receiver, conversation]: [&str; 3],
        act: Act,
    ) -> Option<LockEvent> {
        let lock = Lock {
            at: at(millis),
            sender,
            receiver,
            conversation,
            resource: "dock",
        };
        self.0.act(&lock, act)
    }

    fn ask(&mut self, millis: Millis, agent: &str, conversation: &str) {
        let ask = Act::Ask {
            asked: 0,
            place: None,
        };
        assert!(
            self.act(millis, [agent, "owner", conversation], ask)
                .is_none()
        );
    }

    fn grant(&mut self, millis: Millis, agent: &str, conversation: &str, number: u64) -> String {
        let event = self.act(millis, ["owner", agent, conversation], granted(number));
        event.map_or_else(String::new, |it| format!("{} {}", it.event, it.agent))
    }

    fn release(&mut self, millis: Millis, agent: &str, conversation: &str) -> String {
        let event = self.act(millis, [agent, "owner", conversation], Act::Release);
        event.map_or_else(String::new, |it| it.text)
    }
}

#[test]
fn a_lock_that_passes_on_without_a_release_is_lost() {
    let mut letters = Letters::default();
    assert_eq!(letters.grant(0, "a", "a_1", 1), "");
    // Extended, then released.
    assert_eq!(letters.grant(1, "a", "a_1", 1), "");
    assert_eq!(letters.release(2, "a", "a_1"), "");
    assert_eq!(letters.grant(3, "b", "b_1", 2), "");
    // The release of another agent changes nothing.
    assert_eq!(letters.release(4, "a", "a_1"), "");
    assert_eq!(letters.grant(5, "c", "c_1", 3), "lock_lost b");
}

#[test]
fn a_request_that_is_withdrawn_names_the_holder() {
    let mut letters = Letters::default();
    letters.ask(0, "a", "a_1");
    letters.grant(456, "a", "a_1", 1);
    letters.ask(1000, "b", "b_1");
    // A repeated request, and an extension.
    letters.ask(2000, "b", "b_1");
    letters.grant(3000, "a", "a_1", 1);
    let event = letters.act(8000, ["b", "owner", "b_1"], Act::Release);
    let event = event.unwrap();
    assert_eq!((event.event, event.agent.as_str()), ("lock_abandoned", "b"));
    assert_eq!(
        event.text,
        "b gave up waiting for dock after 7.0 s; a has held it since 1970-01-01T00:00:00.456Z with fence \
         7.1.00000000000000ff@owner#dock"
    );
    // The owner granted the lock while the withdrawal was under way, and then again.
    assert_eq!(letters.grant(8001, "b", "b_1", 2), "");
    assert_eq!(letters.release(8002, "b", "b_1"), "");
    assert_eq!(letters.release(8003, "a", "a_1"), "");
    assert_eq!(letters.grant(8004, "c", "c_1", 3), "");
}

#[test]
fn an_unknown_history_is_no_event() {
    let mut letters = Letters::default();
    // The request of a was not observed, and the time of the grant is not known.
    letters.grant(0, "a", "a_1", 1);
    letters.ask(1, "b", "b_1");
    letters.0.forget();
    assert_eq!(letters.release(2, "b", "b_1"), "");
    letters.grant(3, "a", "a_1", 1);
    letters.ask(4, "b", "b_2");
    // The agent ends, and its last letter is observed after that.
    letters.0.leave("b");
    let text = letters.release(5, "b", "b_2");
    assert!(text.contains("; a holds it with fence 7.1."), "{text}");
}

#[test]
fn the_memory_is_bounded() {
    let mut letters = Letters::default();
    for number in 0..3 * MAX_REQUESTS {
        let agent = format!("a{number}");
        letters.ask(0, &agent, "c");
        match number % 2 {
            0 => letters.0.leave(&agent),
            _ => drop(letters.release(0, &agent, "c")),
        }
    }
    assert!(letters.0.requests.len() <= MAX_REQUESTS);
    letters.ask(1000, "last", "c");
    assert_ne!(letters.release(2000, "last", "c"), "");
    letters.ask(0, "last", &"c".repeat(MAX_CONVERSATION + 1));
    letters.ask(0, &"a".repeat(MAX_NAME + 1), "c");
    let longest = letters.0.requests.iter();
    let longest = longest.map(|((agent, _), it)| agent.len().max(it.conversation.len()));
    assert!(longest.max().unwrap() <= MAX_CONVERSATION);
}

/// An agent with the cores of the library.
struct Agent {
    me: LockPeer,
    locks: Locks<AnyAlgorithm>,
    claim: Option<ClaimId>,
    is_acquired: bool,
}

/// A message that arrives at this time.
struct UnderWay {
    due: Millis,
    from: usize,
    to: usize,
    message: LockMessage,
}

struct Simulation {
    kind: Algorithm,
    now: Millis,
    random: Rng,
    agents: Vec<Agent>,
    messages: VecDeque<UnderWay>,
    grants: Grants,
    abandoned: usize,
    acquired: usize,
}

/// The content that the recorder did not observe.
fn without_content(message: &Message) -> Message {
    fipa::MessageBuilder::from(message.clone())
        .content("")
        .build()
        .unwrap()
}

impl Simulation {
    fn new(kind: Algorithm, seed: u64) -> Self {
        let options = Options::default();
        let agent = |number: u64| {
            let me = LockPeer::new(&format!("agent{number}"), number).unwrap();
            Agent {
                locks: Locks::new(me.clone(), kind, options),
                me,
                claim: None,
                is_acquired: false,
            }
        };
        let mut simulation = Self {
            kind,
            now: 1000,
            random: Rng::with_seed(seed),
            agents: (0..4).map(agent).collect(),
            messages: VecDeque::new(),
            grants: Grants::default(),
            abandoned: 0,
            acquired: 0,
        };
        for number in 0..4 {
            for other in 0..4 {
                let peer = simulation.agents[other].me.clone();
                if number != other {
                    simulation.call(number, |locks, now, out| {
                        locks.join(now, &peer, LockDialect::Own, out);
                    });
                }
            }
        }
        let state = OwnerState::first().next_life(options.lease);
        simulation.call(0, |locks, now, out| locks.own(now, &dock(), &state, out));
        simulation
    }

    /// Calls the core of an agent, and observes the messages that it sends.
    fn call<T>(
        &mut self,
        number: usize,
        call: impl FnOnce(&mut Locks<AnyAlgorithm>, Millis, &mut Vec<Action>) -> T,
    ) -> T {
        let mut out = Vec::new();
        let agent = &mut self.agents[number];
        let result = call(&mut agent.locks, self.now, &mut out);
        let was_acquired = agent.is_acquired;
        let from = AgentId::new(agent.me.name()).unwrap();
        for action in out {
            match action {
                Action::Event(Event::Acquired { .. }) => {
                    self.agents[number].is_acquired = true;
                    self.acquired += 1;
                }
                Action::Event(Event::Failed { .. }) => self.agents[number].claim = None,
                Action::Event(Event::Lost { .. }) => panic!("no lock is lost"),
                Action::Event(_) => {}
                Action::Send { to, message } => {
                    let encoded = encode(
                        &message,
                        self.kind,
                        &from,
                        &AgentId::new(to.name()).unwrap(),
                    )
                    .unwrap();
                    // Some contents are not observed.
                    let encoded = match self.random.u8(..) {
                        0..8 => without_content(&encoded),
                        _ => encoded,
                    };
                    let event = self
                        .grants
                        .handle_message(at(self.now), to.name(), &encoded);
                    if let Some(event) = event {
                        assert_eq!(
                            event.event, "lock_abandoned",
                            "{:?}: {}",
                            self.kind, event.text
                        );
                        assert_eq!(event.agent, from.name());
                        assert!(!was_acquired, "{}", event.text);
                        self.abandoned += 1;
                    }
                    let to = self.agents.iter().position(|it| it.me == to).unwrap();
                    let due = self.now + self.random.u64(1..60);
                    // The messages of a connection keep their order.
                    let of_pair = |it: &&UnderWay| (it.from, it.to) == (number, to);
                    let last = self.messages.iter().filter(of_pair).map(|it| it.due);
                    let due = due.max(last.max().unwrap_or(0));
                    let from = number;
                    self.messages.push_back(UnderWay {
                        due,
                        from,
                        to,
                        message,
                    });
                }
            }
        }
        result
    }

    fn step(&mut self) {
        self.now += self.random.u64(1..20);
        while let Some(at) = self.messages.iter().position(|it| it.due <= self.now) {
            let it = self.messages.remove(at).unwrap();
            let from = self.agents[it.from].me.clone();
            self.call(it.to, |locks, now, out| {
                locks.handle(now, &from, &it.message, out);
            });
        }
        for number in 0..self.agents.len() {
            let due = self.agents[number].locks.poll_timeout();
            if due.is_some_and(|due| due <= self.now) {
                self.call(number, |locks, now, out| locks.handle_timeout(now, out));
            }
        }
        // Agent 0 is the owner.
        let number = self.random.usize(1..self.agents.len());
        let agent = &self.agents[number];
        match agent.claim {
            None if self.random.u8(..) < 30 => {
                let within = self.random.bool().then(|| self.random.u64(1..800));
                self.agents[number].is_acquired = false;
                let claim = self.call(number, |locks, now, out| {
                    locks.lock(now, &dock(), within, out)
                });
                self.agents[number].claim = Some(claim);
            }
            Some(claim) if self.random.u8(..) < if agent.is_acquired { 20 } else { 2 } => {
                self.agents[number].claim = None;
                self.call(number, |locks, now, out| locks.release(now, claim, out));
            }
            _ => {}
        }
    }
}

fn dock() -> Resource {
    Resource::new("dock").unwrap()
}

#[test]
fn only_agents_without_the_lock_abandon_it() {
    for kind in Algorithm::ALL {
        let (mut abandoned, mut acquired) = (0, 0);
        for seed in 0..10 {
            let mut simulation = Simulation::new(kind, seed);
            for _ in 0..4000 {
                simulation.step();
            }
            abandoned += simulation.abandoned;
            acquired += simulation.acquired;
        }
        assert!(acquired > 500, "{kind:?}: {acquired}");
        if kind == Algorithm::OwnerQueue {
            assert!(abandoned > 50, "{abandoned}");
        }
    }
}
