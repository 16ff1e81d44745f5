//! Fences of an owner that starts without its state file, on another host, or with a file that is older than
//! a life elsewhere.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use fipa_locking::{
    Act, Action, Algorithm, AnyAlgorithm, Content, Conversation, Event, Fence, LockDialect,
    LockMessage, LockPeer, Locks, Millis, Options, OwnerState, Resource,
};

const LEASE: Millis = 15_000;

fn bay() -> Resource {
    Resource::new("bay").unwrap()
}

fn peer(name: &str, registration: u64) -> LockPeer {
    LockPeer::new(name, registration).unwrap()
}

fn fence(text: &str) -> Fence {
    text.parse().unwrap()
}

/// A fence of an earlier run of the crane.
const SEEN: &str = "7.3.00000000000000aa@crane#bay";

struct Agent {
    locks: Locks<AnyAlgorithm>,
    now: Millis,
    out: Vec<Action>,
}

impl Agent {
    fn new(name: &str, registration: u64) -> Self {
        let kind = Algorithm::RicartAgrawalaExtended;
        Self {
            locks: Locks::new(peer(name, registration), kind, Options::default()),
            now: 0,
            out: Vec::new(),
        }
    }

    /// The crane begins to own the bay, with the rover and the arm as members.
    fn crane(life: OwnerState) -> Self {
        let mut crane = Self::new("crane", 2);
        for member in ["rover", "arm"] {
            let member = peer(member, 1);
            crane
                .locks
                .join(0, &member, LockDialect::Own, &mut crane.out);
        }
        crane
            .locks
            .own(0, &bay(), &life.with_run(2), &mut crane.out);
        crane
    }

    fn pass_until(&mut self, end: Millis) {
        while let Some(due) = self.locks.poll_timeout().filter(|due| *due <= end) {
            self.now = due.max(self.now);
            self.locks.handle_timeout(self.now, &mut self.out);
        }
        self.now = end;
    }

    fn receive(&mut self, from: &LockPeer, conversation: &str, act: Act) {
        let message = LockMessage {
            conversation: Conversation::parse(conversation),
            dialect: LockDialect::Own,
            algorithm: None,
            content: Content::Lock {
                resource: bay(),
                act,
            },
        };
        self.locks.handle(self.now, from, &message, &mut self.out);
    }

    fn receives_report(&mut self, text: &str) {
        let act = Act::Seen { fence: fence(text) };
        self.receive(&peer("rover", 1), "rover_fence_1", act);
    }

    /// The rover or the arm reports that it has entered.
    fn asked_by(&mut self, name: &str) {
        let asked = Some(self.now);
        self.receive(&peer(name, 1), &format!("{name}_1"), Act::Confirm { asked });
    }

    fn leaves(&mut self, name: &str) {
        self.receive(&peer(name, 1), &format!("{name}_1"), Act::Release);
    }

    /// Fences that were granted, fences that were reported to the crane, and other events.
    fn took(&mut self) -> (Vec<String>, Vec<String>, Vec<Event>) {
        let (mut granted, mut reported, mut events) = (Vec::new(), Vec::new(), Vec::new());
        for action in self.out.drain(..) {
            match action {
                Action::Event(Event::Granted { grant, .. }) => {
                    granted.extend(grant.fence.map(|fence| fence.to_string()));
                }
                Action::Event(event) => events.push(event),
                Action::Send { to, message } => {
                    if let Content::Lock { act, .. } = message.content
                        && let Act::Seen { fence } = act
                    {
                        assert_eq!(to.name(), "crane");
                        reported.push(fence.to_string());
                    }
                }
            }
        }
        (granted, reported, events)
    }

    fn granted(&mut self) -> Vec<String> {
        self.took().0
    }

    fn raised(&mut self) -> Option<u64> {
        self.took().2.into_iter().find_map(|event| match event {
            Event::Raised { epoch, .. } => Some(epoch),
            _ => None,
        })
    }

    fn stored(&mut self, epoch: u64) {
        let now = self.now;
        self.locks.stored(now, &bay(), epoch, &mut self.out);
    }
}

#[test]
fn an_owner_without_file_and_clock_grants_above_the_report_and_after_it_is_stored() {
    let mut crane = Agent::crane(OwnerState::without_memory(LEASE));
    crane.receives_report("3.9.00000000000000bb@crane#bay");
    crane.receives_report(SEEN);
    crane.pass_until(LEASE - 1);
    crane.asked_by("arm");
    let (granted, _, events) = crane.took();
    // It owns nothing before the end of the silence.
    assert_eq!((granted, events), (Vec::new(), Vec::new()));
    crane.pass_until(LEASE);
    let (granted, _, events) = crane.took();
    let owning = Event::Owning { resource: bay() };
    let raised = Event::Raised {
        resource: bay(),
        epoch: 8,
    };
    assert_eq!(granted, Vec::<String>::new());
    assert!(
        events.contains(&owning) && events.contains(&raised),
        "{events:?}"
    );
    crane.stored(7);
    assert_eq!(crane.granted(), Vec::<String>::new());
    crane.stored(8);
    assert_eq!(crane.granted(), ["8.1.0000000000000002@crane#bay"]);
}

#[test]
fn an_owner_without_file_clock_and_report_owns_nothing() {
    let mut crane = Agent::crane(OwnerState::without_memory(LEASE));
    crane.pass_until(LEASE - 1);
    crane.asked_by("arm");
    crane.pass_until(LEASE);
    let (granted, _, events) = crane.took();
    assert_eq!(events, [Event::NoMemory { resource: bay() }]);
    assert_eq!(granted, Vec::<String>::new());
    assert!(crane.locks.owner(&bay()).is_none());
}

#[test]
fn a_clock_replaces_the_report_and_the_silence_stays() {
    let life = OwnerState::without_memory(1_000).with_clock(Some(1_800_000_000));
    let mut crane = Agent::crane(life);
    crane.pass_until(14_999);
    crane.asked_by("arm");
    assert_eq!(crane.granted(), Vec::<String>::new());
    crane.pass_until(15_000);
    assert_eq!(crane.granted(), ["1800000000.1.0000000000000002@crane#bay"]);
}

/// The owner was on another host meanwhile, where a grant may be live.
#[test]
fn a_report_of_a_life_elsewhere_makes_an_owner_with_a_file_silent() {
    let file = OwnerState::first().next_life(LEASE).closed();
    let mut crane = Agent::crane(file.next_life(LEASE));
    crane.receives_report(SEEN);
    crane.pass_until(LEASE - 1);
    crane.asked_by("arm");
    assert_eq!(crane.granted(), Vec::<String>::new());
    crane.pass_until(LEASE);
    assert_eq!(crane.raised(), Some(8));
    // A fence of a life that is in the file.
    let mut crane = Agent::crane(file.next_life(LEASE));
    crane.receives_report("1.9.00000000000000aa@crane#bay");
    crane.pass_until(1_000);
    crane.asked_by("arm");
    assert_eq!(crane.granted(), ["2.1.0000000000000002@crane#bay"]);
}

#[test]
fn a_report_ends_no_grant_and_raises_the_next_one() {
    let mut crane = Agent::crane(OwnerState::first().next_life(LEASE));
    crane.pass_until(LEASE);
    crane.asked_by("rover");
    let live = "1.1.0000000000000002@crane#bay";
    assert_eq!(crane.granted(), [live]);
    crane.receives_report(SEEN);
    assert_eq!(crane.raised(), None);
    assert!(crane.locks.admit(crane.now, &bay(), &fence(live)));
    // The late command of another run with the same position.
    let other_run = fence("1.1.00000000000000aa@crane#bay");
    assert!(!crane.locks.admit(crane.now, &bay(), &other_run));
    crane.asked_by("arm");
    crane.leaves("rover");
    assert_eq!(crane.raised(), Some(8));
    // A report that is heard meanwhile counts for the grant after the next one.
    crane.receives_report("8.1.00000000000000bb@crane#bay");
    crane.stored(8);
    assert_eq!(crane.raised(), Some(9));
    crane.stored(9);
    assert_eq!(crane.granted(), ["9.2.0000000000000002@crane#bay"]);
}

#[test]
fn reports_that_cannot_be_true_change_nothing() {
    let mut crane = Agent::crane(OwnerState::first().next_life(LEASE));
    for text in [
        "7.1.0000000000000002@crane#bay",
        "7.1.00000000000000aa@gate#bay",
        "7.1.00000000000000aa@crane#dock",
        "281474976710657.1.00000000000000aa@crane#bay",
        "0.1.00000000000000aa@crane#bay",
    ] {
        crane.receives_report(text);
    }
    crane.pass_until(1_000);
    crane.asked_by("arm");
    assert_eq!(crane.granted(), ["1.1.0000000000000002@crane#bay"]);
}

/// The rover has held the bay in the run of `crane` (registration 1).
fn rover() -> Agent {
    let mut rover = Agent::new("rover", 1);
    let crane = peer("crane", 1);
    rover
        .locks
        .owner_known(0, &bay(), &crane, LockDialect::Own, &mut rover.out);
    let claim = rover.locks.lock(0, &bay(), None, &mut rover.out);
    rover.receive(&crane, "rover_0", Act::Agree { clock: 1 });
    let granted = Act::Granted {
        fence: fence(SEEN),
        lease: LEASE,
        asked: 0,
    };
    rover.receive(&crane, "rover_0", granted);
    assert!(rover.locks.is_held(0, claim));
    rover.locks.release(0, claim, &mut rover.out);
    assert_eq!(rover.took().1, Vec::<String>::new());
    rover
}

#[test]
fn an_agent_tells_an_owner_that_starts_the_highest_fence() {
    let next = peer("crane", 2);
    // The claim of a new owner, its announcement, and the directory.
    let mut asked = rover();
    asked.receive(&next, "crane_discover_1", Act::Query { claim: true });
    assert_eq!(asked.took().1, [SEEN]);
    let mut asked = rover();
    asked.receive(&next, "crane_announce_1", Act::Owned);
    assert_eq!(asked.took().1, [SEEN]);
    let mut listed = rover();
    listed
        .locks
        .owner_known(0, &bay(), &next, LockDialect::Own, &mut listed.out);
    assert_eq!(listed.took().1, [SEEN]);
    // Another owner learns nothing.
    let mut asked = rover();
    let gate = peer("gate", 1);
    asked.receive(&gate, "gate_discover_1", Act::Query { claim: true });
    assert_eq!(asked.took().1, Vec::<String>::new());
    // A legacy owner does not know the message.
    let mut asked = rover();
    let legacy = LockMessage {
        conversation: Conversation::parse("crane_discover_1"),
        dialect: LockDialect::Legacy,
        algorithm: None,
        content: Content::Lock {
            resource: bay(),
            act: Act::Query { claim: true },
        },
    };
    asked.locks.handle(0, &next, &legacy, &mut asked.out);
    assert_eq!(asked.took().1, Vec::<String>::new());
}

#[test]
fn an_agent_tells_an_owner_of_a_higher_fence_than_that_of_its_grant() {
    let mut rover = rover();
    let next = peer("crane", 2);
    rover.locks.depart(0, &peer("crane", 1), &mut rover.out);
    rover.receive(&next, "crane_announce_1", Act::Owned);
    rover.took();
    rover.locks.lock(0, &bay(), None, &mut rover.out);
    rover.receive(&next, "rover_1", Act::Agree { clock: 9 });
    let granted = |text| Act::Granted {
        fence: fence(text),
        lease: LEASE,
        asked: 0,
    };
    let low = granted("7.9.00000000000000bb@crane#bay");
    rover.receive(&next, "rover_1", low);
    assert_eq!(rover.took().1, [SEEN]);
}

#[test]
fn a_device_tells_the_owner_the_fence_that_it_has_admitted() {
    let mut gate = Agent::new("gate", 1);
    let crane = peer("crane", 2);
    gate.locks.saw(0, &fence(SEEN), false, &mut gate.out);
    gate.receive(&crane, "crane_discover_1", Act::Query { claim: true });
    assert_eq!(gate.took().1, [SEEN]);
    gate.receive(&crane, "crane_announce_1", Act::Owned);
    assert_eq!(gate.took().1, [SEEN]);
    // A command with a fence of another run.
    gate.locks.saw(0, &fence(SEEN), true, &mut gate.out);
    assert_eq!(gate.took().1, [SEEN]);
}
