//! The owner's queue: its order, places, suspected members, restarts of owners, and which algorithm a resource has.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use fipa_locking::{
    Act, Action, Algorithm, AnyAlgorithm, ClaimId, Content, Conversation, Event, Failure, Fence,
    LockDialect, LockMessage, LockPeer, Locks, Millis, Options, OwnerState, Refusal, Resource,
};

const OWN: LockDialect = LockDialect::Own;
const LEASE: Millis = 15_000;

fn bay() -> Resource {
    Resource::new("bay").unwrap()
}

type Letter = (LockPeer, LockPeer, LockMessage);

/// Agents with one clock, whose letters arrive at once and in order.
#[derive(Default)]
struct Net {
    agents: BTreeMap<String, Locks<AnyAlgorithm>>,
    now: Millis,
    under_way: VecDeque<Letter>,
    /// Agents that receive nothing, and whose letters are lost.
    cut: BTreeSet<String>,
    /// Agents that are stopped, and the letters that wait for them.
    paused: BTreeMap<String, Vec<Letter>>,
    /// All letters about the resource, as sender, receiver, conversation and act.
    sent: Vec<(String, String, String, Act)>,
    /// Receivers of probes.
    probed: Vec<String>,
    events: Vec<(String, Event)>,
}

impl Net {
    /// `crane` owns the resource. The members know it.
    fn new(members: &[&str]) -> Self {
        let mut net = Self::default();
        net.start("crane", 1, Algorithm::OwnerQueue, Options::default());
        net.own("crane", OwnerState::first().next_life(LEASE));
        net.run(1_000);
        for member in members {
            net.start(member, 1, Algorithm::OwnerQueue, Options::default());
        }
        net.clear();
        net
    }

    fn clear(&mut self) {
        self.sent.clear();
        self.probed.clear();
        self.events.clear();
    }

    fn start(&mut self, name: &str, registration: u64, kind: Algorithm, mut options: Options) {
        options.first_conversation = registration * 1_000;
        let me = LockPeer::new(name, registration).unwrap();
        self.agents
            .insert(name.to_owned(), Locks::new(me.clone(), kind, options));
        for other in self.agents.keys().cloned().collect::<Vec<_>>() {
            let peer = self.agents[&other].me().clone();
            let join = |locks: &mut Locks<_>, now, peer: &LockPeer, out: &mut Vec<_>| {
                locks.join(now, peer, OWN, out);
            };
            self.call(name, |locks, now, out| join(locks, now, &peer, out));
            self.call(&other, |locks, now, out| join(locks, now, &me, out));
        }
        self.deliver();
    }

    fn own(&mut self, name: &str, state: OwnerState) {
        self.call(name, |locks, now, out| locks.own(now, &bay(), &state, out));
    }

    fn call<T>(
        &mut self,
        name: &str,
        call: impl FnOnce(&mut Locks<AnyAlgorithm>, Millis, &mut Vec<Action>) -> T,
    ) -> T {
        let mut out = Vec::new();
        let locks = self.agents.get_mut(name).unwrap();
        let result = call(locks, self.now, &mut out);
        let me = locks.me().clone();
        for action in out {
            match action {
                Action::Send { to, message } => {
                    if let Content::Lock { act, .. } = &message.content {
                        let conversation = message.conversation.to_string();
                        let (from, to) = (me.name().to_owned(), to.name().to_owned());
                        self.sent.push((from, to, conversation, act.clone()));
                    } else if message.content == Content::Probe {
                        self.probed.push(to.name().to_owned());
                    }
                    self.under_way.push_back((to, me.clone(), message));
                }
                Action::Event(event) => self.events.push((name.to_owned(), event)),
            }
        }
        result
    }

    fn deliver(&mut self) {
        while let Some((to, from, message)) = self.under_way.pop_front() {
            let is_cut = self.cut.contains(to.name()) || self.cut.contains(from.name());
            let receiver = self.agents.get(to.name());
            if let Some(inbox) = self.paused.get_mut(to.name()) {
                inbox.push((to, from, message));
            } else if !is_cut && receiver.is_some_and(|locks| *locks.me() == to) {
                let name = to.name().to_owned();
                self.call(&name, |locks, now, out| {
                    locks.handle(now, &from, &message, out);
                });
            }
        }
    }

    /// Delivers all letters, and passes time.
    fn run(&mut self, span: Millis) {
        let end = self.now + span;
        loop {
            self.deliver();
            let due =
                |(name, locks): (&String, &Locks<_>)| Some((locks.poll_timeout()?, name.clone()));
            let running = self.agents.iter();
            let running = running.filter(|(name, _)| !self.paused.contains_key(*name));
            let next = running.filter_map(due).min();
            match next {
                Some((due, name)) if due <= end => {
                    self.now = due.max(self.now);
                    self.call(&name, |locks, now, out| locks.handle_timeout(now, out));
                }
                _ => break,
            }
        }
        self.now = end;
    }

    fn pause(&mut self, name: &str) {
        self.paused.insert(name.to_owned(), Vec::new());
    }

    fn resume(&mut self, name: &str) {
        self.under_way.extend(self.paused.remove(name).unwrap());
        self.deliver();
    }

    fn lock(&mut self, name: &str) -> ClaimId {
        self.lock_within(name, None)
    }

    fn lock_within(&mut self, name: &str, within: Option<Millis>) -> ClaimId {
        let owner = &self.agents["crane"];
        let (crane, owns) = (owner.me().clone(), owner.owner(&bay()).is_some());
        let claim = self.call(name, |locks, now, out| {
            if owns {
                locks.owner_named(now, &bay(), &crane, OWN, Some(Algorithm::OwnerQueue), out);
            }
            locks.lock(now, &bay(), within, out)
        });
        self.deliver();
        claim
    }

    fn release(&mut self, name: &str, claim: ClaimId) {
        self.call(name, |locks, now, out| locks.release(now, claim, out));
        self.deliver();
    }

    fn depart(&mut self, from: &str, gone: &LockPeer) {
        self.call(from, |locks, now, out| locks.depart(now, gone, out));
        self.deliver();
    }

    /// Ends the owner's process and starts it again.
    fn restart_owner(&mut self, state: OwnerState) {
        let before = self.agents.remove("crane").unwrap().me().clone();
        let others: Vec<_> = self.agents.keys().cloned().collect();
        for other in &others {
            self.depart(other, &before);
        }
        let registration = before.registration() + 1;
        self.start(
            "crane",
            registration,
            Algorithm::OwnerQueue,
            Options::default(),
        );
        self.own("crane", state);
        self.deliver();
    }

    fn holder(&self) -> Option<String> {
        let core = self.agents["crane"].owner(&bay())?;
        Some(core.live(self.now)?.holder.name().to_owned())
    }

    fn waiters(&self) -> Vec<String> {
        let core = self.agents["crane"].owner(&bay()).unwrap();
        core.waiters().map(|it| it.name().to_owned()).collect()
    }

    /// Places that were told, in order.
    fn places(&mut self) -> Vec<(String, u32)> {
        let told = self.sent.drain(..).filter_map(|(_, to, _, act)| match act {
            Act::Place { place } => Some((to, place)),
            _ => None,
        });
        told.collect()
    }

    fn failures(&mut self) -> Vec<(String, Failure)> {
        let events = std::mem::take(&mut self.events).into_iter();
        let failed = events.filter_map(|(name, event)| match event {
            Event::Failed { failure, .. } => Some((name, failure)),
            _ => None,
        });
        failed.collect()
    }
}

fn pair(name: &str, place: u32) -> (String, u32) {
    (name.to_owned(), place)
}

const TEN: [&str; 10] = ["a", "b", "c", "d", "e", "f", "g", "h", "i", "j"];

#[test]
fn grants_have_the_order_of_requests_and_the_first_eight_know_their_places() {
    let mut net = Net::new(&TEN);
    let mut claims = Vec::new();
    // Not in the order of their names.
    let order: Vec<&str> = TEN.into_iter().rev().collect();
    for name in &order {
        claims.push(net.lock(name));
    }
    assert_eq!(net.holder().as_deref(), Some("j"));
    assert_eq!(net.waiters(), order[1..]);
    let expected: Vec<_> = (1..=8).map(|it| pair(order[it as usize], it)).collect();
    assert_eq!(net.places(), expected, "the ninth is told nothing");
    for (index, claim) in claims.into_iter().enumerate() {
        assert_eq!(net.holder().as_deref(), Some(order[index]));
        net.sent.clear();
        net.release(order[index], claim);
        let first = index + 2;
        let expected = order.iter().skip(first).take(8).zip(1..);
        let expected: Vec<_> = expected.map(|(name, place)| pair(name, place)).collect();
        assert_eq!(net.places(), expected);
    }
    assert_eq!(net.holder(), None);
}

#[test]
fn a_lock_without_contention_needs_three_letters() {
    let mut net = Net::new(&TEN);
    let claim = net.lock("a");
    net.release("a", claim);
    net.run(10_000);
    let acts = net
        .sent
        .iter()
        .map(|(from, _, _, act)| (from.as_str(), act));
    let acts: Vec<_> = acts.collect();
    assert!(
        matches!(
            acts[..],
            [
                ("a", Act::Ask { place: None, .. }),
                ("crane", Act::Granted { .. }),
                ("a", Act::Release)
            ]
        ),
        "{acts:?}"
    );
}

/// Most agents of a domain use no locks, and do not answer a greeting. Only Ricart-Agrawala has to wait for it.
#[test]
fn a_request_to_a_queue_does_not_wait_for_answers_to_greetings() {
    for kind in Algorithm::ALL {
        let mut net = Net::default();
        net.start("crane", 1, kind, Options::default());
        net.own("crane", OwnerState::first().next_life(LEASE));
        net.run(1_000);
        net.start("a", 1, Algorithm::default(), Options::default());
        let silent = LockPeer::new("silent", 1).unwrap();
        let claim = net.call("a", |locks, now, out| {
            locks.expect(now, &silent);
            locks.lock(now, &bay(), None, out)
        });
        net.deliver();
        let is_held = |net: &Net| net.agents["a"].is_held(net.now, claim);
        assert_eq!(is_held(&net), !kind.needs_permission(), "{kind}");
        net.run(1_000);
        assert!(is_held(&net), "{kind}");
    }
}

#[test]
fn a_repeated_request_changes_nothing_and_a_later_one_keeps_the_place() {
    let mut net = Net::new(&["a", "b", "c"]);
    net.lock("a");
    let second = net.lock("b");
    net.lock("c");
    net.sent.clear();
    // Each waiting agent repeats its request.
    net.run(3_500);
    let asks = net.sent.iter().filter(|it| matches!(it.3, Act::Ask { .. }));
    assert_eq!(asks.count(), 6);
    assert_eq!(net.waiters(), ["b", "c"]);
    assert_eq!(net.places(), []);
    // The withdrawal is lost.
    net.cut.insert("b".to_owned());
    net.release("b", second);
    net.cut.clear();
    net.lock("b");
    assert_eq!(net.waiters(), ["b", "c"]);
    assert_eq!(net.places(), [pair("b", 1)], "for its new conversation");
}

#[test]
fn a_member_that_is_gone_leaves_the_queue_at_once() {
    let mut net = Net::new(&["a", "b", "c"]);
    for name in ["a", "b", "c"] {
        net.lock(name);
    }
    let gone = net.agents.remove("b").unwrap().me().clone();
    net.sent.clear();
    net.depart("crane", &gone);
    assert_eq!(net.waiters(), ["c"]);
    assert_eq!(net.places(), [pair("c", 1)]);
}

/// The time from the loss of contact until the suspicion.
const SUSPICION: Millis = 7_000;

#[test]
fn a_suspected_member_that_answers_in_its_turn_keeps_it() {
    let mut net = Net::new(&["a", "b", "c"]);
    let first = net.lock("a");
    net.lock("b");
    net.lock("c");
    net.pause("b");
    net.run(SUSPICION + 1_000);
    // It keeps its place.
    assert_eq!(net.waiters(), ["b", "c"]);
    net.probed.clear();
    net.release("a", first);
    assert_eq!(net.probed, ["b"]);
    net.run(1_999);
    assert_eq!(net.holder(), None, "the owner waits for the answer");
    net.resume("b");
    assert_eq!(net.holder().as_deref(), Some("b"));
    assert_eq!(net.waiters(), ["c"]);
}

/// The sign of life is the withdrawal of its request.
#[test]
fn a_suspected_member_that_withdraws_in_its_turn_gets_no_grant() {
    let mut net = Net::new(&["a", "b"]);
    let first = net.lock("a");
    let second = net.lock("b");
    net.pause("b");
    net.run(SUSPICION + 1_000);
    net.release("a", first);
    net.call("b", |locks, now, out| locks.release(now, second, out));
    net.events.clear();
    net.deliver();
    assert_eq!(net.waiters(), Vec::<String>::new());
    assert_eq!(net.events, []);
}

#[test]
fn a_suspected_member_without_an_answer_goes_to_the_end_once() {
    let mut net = Net::new(&["a", "b", "c", "d", "e"]);
    let first = net.lock("a");
    for name in ["b", "c", "d"] {
        net.lock(name);
    }
    net.pause("b");
    net.pause("c");
    net.run(SUSPICION + 1_000);
    net.probed.clear();
    net.release("a", first);
    // Both are asked at the same time, so they delay the next one once.
    assert_eq!(net.probed, ["b", "c"]);
    net.run(1_999);
    assert_eq!(net.holder(), None);
    net.run(1);
    assert_eq!(net.holder().as_deref(), Some("d"));
    assert_eq!(net.waiters(), ["b", "c"]);
    let fifth = net.lock("e");
    assert_eq!(net.waiters(), ["b", "c", "e"]);
    // Nobody answers in the second turn.
    let gone = net.agents.remove("d").unwrap().me().clone();
    net.depart("crane", &gone);
    net.run(2_000);
    assert_eq!(net.holder().as_deref(), Some("e"));
    assert_eq!(net.waiters(), Vec::<String>::new());
    // They ask again when they are back, after those that wait.
    net.resume("b");
    net.resume("c");
    net.run(1_000);
    assert_eq!(net.waiters().len(), 2);
    net.release("e", fifth);
    assert!(net.holder().is_some());
}

#[test]
fn a_lost_grant_is_repeated_and_a_lost_release_ends_with_the_lease() {
    let mut net = Net::new(&["a", "b"]);
    let first = net.lock("a");
    let second = net.lock("b");
    // The grant to b is lost.
    net.call("a", |locks, now, out| locks.release(now, first, out));
    let release = net.under_way.pop_front().unwrap();
    net.call("crane", |locks, now, out| {
        locks.handle(now, &release.1, &release.2, out);
    });
    net.under_way.clear();
    assert_eq!(net.holder().as_deref(), Some("b"));
    assert!(!net.agents["b"].is_held(net.now, second));
    net.run(1_000);
    assert!(net.agents["b"].is_held(net.now, second));
    // Its release is lost.
    net.call("b", |locks, now, out| locks.release(now, second, out));
    net.under_way.clear();
    net.lock("a");
    net.run(LEASE - 2_000);
    assert_eq!(net.holder().as_deref(), Some("b"));
    net.run(2_000);
    assert_eq!(net.holder().as_deref(), Some("a"));
}

#[test]
fn a_newer_request_of_the_holder_shows_that_its_release_was_lost() {
    let mut net = Net::new(&["a", "b"]);
    let first = net.lock("a");
    net.lock("b");
    net.call("a", |locks, now, out| locks.release(now, first, out));
    net.under_way.clear();
    net.lock("a");
    assert_eq!(net.holder().as_deref(), Some("b"));
    assert_eq!(net.waiters(), ["a"]);
}

#[test]
fn a_release_of_an_earlier_life_ends_no_grant() {
    let mut net = Net::new(&["a", "b"]);
    let first = net.lock("a");
    net.call("a", |locks, now, out| locks.release(now, first, out));
    let (to, from, late) = net.under_way.pop_front().unwrap();
    // The agent restarts, and gets the resource before its late release arrives.
    net.depart("crane", &from);
    net.start("a", 2, Algorithm::OwnerQueue, Options::default());
    let second = net.lock("a");
    net.call(to.name(), |locks, now, out| {
        locks.handle(now, &from, &late, out);
    });
    assert!(net.agents["a"].is_held(net.now, second));
    assert_eq!(net.holder().as_deref(), Some("a"));
}

#[test]
fn a_restarted_owner_is_silent_and_serves_the_earlier_order() {
    let mut net = Net::new(&TEN);
    for name in TEN {
        net.lock(name);
    }
    net.run(500);
    net.sent.clear();
    let state = OwnerState::first().next_life(LEASE).next_life(LEASE);
    // i asks at the end: with nine that wait, it has no place. a holds.
    net.restart_owner(state);
    let sorted = ["b", "c", "d", "e", "f", "g", "h", "i", "j"];
    assert_eq!(net.waiters(), sorted);
    net.events.clear();
    net.run(LEASE - 1);
    let granted = |(_, event): &(String, Event)| matches!(event, Event::Granted { .. });
    assert!(!net.events.iter().any(granted), "silent for the lease");
    assert_eq!(
        net.places(),
        [],
        "no place is told before the order is certain"
    );
    net.run(1);
    assert_eq!(net.holder().as_deref(), Some("b"));
    assert_eq!(net.waiters(), sorted[1..]);
    assert_eq!(net.failures(), []);
}

/// Members learn of the restart in the wrong order.
#[test]
fn requests_of_the_life_before_are_sorted_by_their_places() {
    let mut net = Net::new(&["a", "b", "c", "d", "e"]);
    for name in ["a", "b", "c", "d"] {
        net.lock(name);
    }
    net.cut.extend(["a", "b", "c", "d", "e"].map(str::to_owned));
    let before = net.agents.remove("crane").unwrap().me().clone();
    net.start("crane", 2, Algorithm::OwnerQueue, Options::default());
    net.own(
        "crane",
        OwnerState::first().next_life(LEASE).next_life(LEASE),
    );
    net.deliver();
    for name in ["e", "d", "b", "c"] {
        net.cut.remove(name);
        net.depart(name, &before);
        if name == "e" {
            net.lock("e");
        }
        net.run(1_100);
    }
    assert_eq!(net.waiters(), ["b", "c", "d", "e"]);
    assert_eq!(net.failures(), []);
}

#[test]
fn after_the_silence_a_place_of_the_life_before_does_not_count() {
    let mut net = Net::new(&["a", "b", "c", "d"]);
    for name in ["a", "b"] {
        net.lock(name);
    }
    net.lock("c");
    let before = net.agents.remove("crane").unwrap().me().clone();
    net.cut.extend(["b", "c"].map(str::to_owned));
    net.start("crane", 2, Algorithm::OwnerQueue, Options::default());
    net.own("crane", OwnerState::first().next_life(LEASE));
    net.run(1_000);
    net.lock("d");
    net.cut.clear();
    for name in ["c", "b"] {
        net.depart(name, &before);
        net.run(10);
    }
    assert_eq!(net.holder().as_deref(), Some("d"));
    assert_eq!(net.waiters(), ["c", "b"]);
}

#[test]
fn a_request_survives_a_short_absence_of_the_owner_only() {
    for within in [None, Some(1_500)] {
        let mut net = Net::new(&["a", "b"]);
        net.lock("a");
        net.lock_within("b", within);
        net.lock("b");
        let before = net.agents.remove("crane").unwrap().me().clone();
        net.events.clear();
        net.depart("b", &before);
        net.run(1_999);
        let early = net.failures();
        assert_eq!(early.len(), usize::from(within.is_some()), "{early:?}");
        net.run(2_001);
        let failures = net.failures();
        assert!(!failures.is_empty());
        for (name, failure) in failures {
            let is_lost = matches!(&failure, Failure::Unreachable { owner } if *owner == before)
                || matches!(failure, Failure::NoOwner);
            assert!(name == "b" && is_lost, "{name}: {failure}");
        }
    }
}

/// The owner is cut off only, so the withdrawal reaches it later.
#[test]
fn a_request_is_withdrawn_while_its_owner_is_lost() {
    let mut net = Net::new(&["a", "b"]);
    net.lock("a");
    let claim = net.lock("b");
    net.cut.insert("b".to_owned());
    net.run(SUSPICION + 500);
    net.cut.clear();
    net.call("b", |locks, now, out| locks.release(now, claim, out));
    net.deliver();
    assert_eq!(net.waiters(), Vec::<String>::new());
}

/// After a partition, two agents own the resource. Each admits its own fences only, and a member uses the first one until
/// it is lost.
#[test]
fn two_owners_have_a_queue_each() {
    let mut net = Net::new(&["a"]);
    let claim = net.lock("a");
    let fence = net.agents["a"].fence(net.now, claim, &bay()).unwrap();
    net.start("derrick", 1, Algorithm::OwnerQueue, Options::default());
    net.cut.insert("derrick".to_owned());
    net.own("derrick", OwnerState::first().next_life(LEASE));
    net.run(1_000);
    net.cut = BTreeSet::from(["crane".to_owned()]);
    net.start("b", 1, Algorithm::OwnerQueue, Options::default());
    net.cut.clear();
    let derrick = net.agents["derrick"].me().clone();
    let other = net.call("b", |locks, now, out| {
        locks.owner_known(now, &bay(), &derrick, OWN, out);
        locks.lock(now, &bay(), None, out)
    });
    net.deliver();
    let admits =
        |net: &Net, owner: &str, fence: &Fence| net.agents[owner].admit(net.now, &bay(), fence);
    let of_derrick = net.agents["b"].fence(net.now, other, &bay()).unwrap();
    assert_eq!(of_derrick.owner(), "derrick");
    assert!(admits(&net, "derrick", &of_derrick) && !admits(&net, "crane", &of_derrick));
    assert!(admits(&net, "crane", &fence) && !admits(&net, "derrick", &fence));
    net.release("b", other);
    // The other owner announces itself to a, which goes on with the first.
    net.release("a", claim);
    let again = net.lock("a");
    let fence = net.agents["a"].fence(net.now, again, &bay()).unwrap();
    assert_eq!(fence.owner(), "crane");
    net.release("a", again);
    let gone = net.agents["crane"].me().clone();
    net.depart("a", &gone);
    let last = net.call("a", |locks, now, out| locks.lock(now, &bay(), None, out));
    net.run(100);
    let fence = net.agents["a"].fence(net.now, last, &bay()).unwrap();
    assert_eq!(fence.owner(), "derrick");
}

// ----- algorithms

/// An owner with one algorithm, and a member that was told to use another. The member finds the owner by messages.
fn found(of_owner: Algorithm, of_member: Algorithm) -> (Net, ClaimId) {
    let mut net = Net::default();
    net.start("crane", 1, of_owner, Options::default());
    net.own("crane", OwnerState::first().next_life(LEASE));
    net.run(1_000);
    net.clear();
    net.start("a", 1, of_member, Options::default());
    let claim = net.call("a", |locks, now, out| locks.lock(now, &bay(), None, out));
    net.run(100);
    (net, claim)
}

#[test]
fn a_member_without_an_option_uses_the_algorithm_that_the_owner_names() {
    for kind in Algorithm::ALL {
        let (net, claim) = found(kind, Algorithm::default());
        assert!(
            net.agents["a"].fence(net.now, claim, &bay()).is_some(),
            "{kind}"
        );
        let asked = net.sent.iter().filter(|(from, ..)| from == "a");
        let used = |act: &Act| match act {
            Act::Ask { .. } => kind == Algorithm::OwnerQueue,
            Act::Request { .. } => kind.needs_permission(),
            Act::RequestToken { .. } => kind.has_token(),
            _ => true,
        };
        assert!(asked.clone().count() > 0 && asked.clone().all(|it| used(&it.3)));
    }
}

#[test]
fn a_member_with_another_algorithm_is_refused_with_a_text() {
    for of_owner in Algorithm::ALL {
        for of_member in Algorithm::ALL {
            if of_member == Algorithm::OwnerQueue || of_member == of_owner {
                continue;
            }
            let (mut net, _) = found(of_owner, of_member);
            let failure = Failure::Algorithm {
                owner: of_owner,
                own: of_member,
            };
            let text = format!(
                "the owner uses the algorithm {of_owner}, and this agent was told to use {of_member}"
            );
            assert_eq!(failure.to_string(), text);
            assert_eq!(net.failures(), [("a".to_owned(), failure)]);
            assert_eq!(
                net.agents["crane"].owner(&bay()).unwrap().waiters().count(),
                0
            );
        }
    }
}

fn letter(kind: Algorithm, conversation: &str, dialect: LockDialect, act: Act) -> LockMessage {
    LockMessage {
        conversation: Conversation::parse(conversation),
        dialect,
        algorithm: Some(kind),
        content: Content::Lock {
            resource: bay(),
            act,
        },
    }
}

/// Requests of agents that did not hear the owner's name of its algorithm: of an earlier version, or of
/// `distributed_locking`.
#[test]
fn an_owner_refuses_requests_of_other_algorithms_and_reports_them() {
    let asked = 7;
    let requests = [
        (
            Algorithm::OwnerQueue,
            Act::Ask { asked, place: None },
            asked,
        ),
        (Algorithm::RicartAgrawala, Act::Request { clock: 1 }, 0),
        (Algorithm::SuzukiKasami, Act::RequestToken { number: 1 }, 0),
        (
            Algorithm::RicartAgrawalaExtended,
            Act::Confirm { asked: Some(asked) },
            asked,
        ),
        (
            Algorithm::SuzukiKasamiExtended,
            Act::Confirm { asked: None },
            0,
        ),
    ];
    for of_owner in Algorithm::ALL {
        for dialect in [OWN, LockDialect::Legacy] {
            for (kind, act, asked) in requests.iter().cloned() {
                if kind == of_owner {
                    continue;
                }
                let mut net = Net::default();
                net.start("crane", 1, of_owner, Options::default());
                net.own("crane", OwnerState::first().next_life(LEASE));
                net.run(1_000);
                net.clear();
                let stranger = LockPeer::new("stranger", 1).unwrap();
                let request = letter(kind, "stranger_1", dialect, act);
                net.call("crane", |locks, now, out| {
                    locks.handle(now, &stranger, &request, out);
                });
                let reason = Refusal::Algorithm(of_owner);
                let refusal = Act::Refused { reason, asked };
                let (.., message) = net
                    .under_way
                    .iter()
                    .find(|(.., message)| {
                        message.content
                            == Content::Lock {
                                resource: bay(),
                                act: refusal.clone(),
                            }
                    })
                    .unwrap();
                assert_eq!(
                    message.algorithm,
                    Some(kind),
                    "in the protocol of the request"
                );
                let event = Event::OtherAlgorithm {
                    resource: bay(),
                    by: stranger.clone(),
                    algorithm: kind,
                };
                assert_eq!(net.events, [("crane".to_owned(), event)]);
                assert_eq!(net.holder(), None);
                assert_eq!(net.waiters(), Vec::<String>::new());
            }
        }
    }
    let text = Refusal::Algorithm(Algorithm::OwnerQueue).to_string();
    assert_eq!(text, "the resource uses the algorithm owner_queue");
}

/// The directory named an algorithm, and the owner has begun again with another one.
#[test]
fn a_refused_request_is_made_again_with_the_algorithm_of_the_refusal() {
    for (stale, kind) in [
        (Algorithm::RicartAgrawalaExtended, Algorithm::OwnerQueue),
        (Algorithm::OwnerQueue, Algorithm::RicartAgrawalaExtended),
        (Algorithm::OwnerQueue, Algorithm::SuzukiKasamiExtended),
    ] {
        let mut net = Net::default();
        net.start("crane", 1, kind, Options::default());
        net.own("crane", OwnerState::first().next_life(LEASE));
        net.run(1_000);
        let crane = net.agents["crane"].me().clone();
        net.start("a", 1, Algorithm::default(), Options::default());
        // The announcement of the owner is lost.
        net.agents.remove("a");
        net.start("b", 1, Algorithm::default(), Options::default());
        net.agents.insert(
            "a".to_owned(),
            Locks::new(
                LockPeer::new("a", 1).unwrap(),
                Algorithm::default(),
                Options::default(),
            ),
        );
        let claim = net.call("a", |locks, now, out| {
            locks.owner_named(now, &bay(), &crane, OWN, Some(stale), out);
            locks.lock(now, &bay(), None, out)
        });
        net.run(3_000);
        assert!(
            net.agents["a"].fence(net.now, claim, &bay()).is_some(),
            "{kind}"
        );
    }
}

#[test]
fn the_owner_of_a_resource_for_legacy_agents_uses_an_algorithm_of_theirs() {
    for (kind, legacy_algorithm, expected) in [
        (
            Algorithm::OwnerQueue,
            Algorithm::RicartAgrawalaExtended,
            Algorithm::RicartAgrawalaExtended,
        ),
        (
            Algorithm::OwnerQueue,
            Algorithm::SuzukiKasamiExtended,
            Algorithm::SuzukiKasamiExtended,
        ),
        (
            Algorithm::SuzukiKasami,
            Algorithm::RicartAgrawalaExtended,
            Algorithm::SuzukiKasami,
        ),
    ] {
        let mut options = Options::default();
        options.legacy_peers = true;
        options.legacy_algorithm = legacy_algorithm;
        let mut net = Net::default();
        net.start("crane", 1, kind, options);
        net.own("crane", OwnerState::first().next_life(LEASE));
        net.run(1_000);
        let member = LockPeer::new("a", 1).unwrap();
        net.call("crane", |locks, now, out| {
            locks.join(now, &member, OWN, out)
        });
        let named = net.under_way.iter().map(|(.., message)| message.algorithm);
        assert_eq!(named.collect::<Vec<_>>(), [Some(expected)]);
    }
}

#[test]
fn at_an_owner_of_the_cpp_library_the_configured_algorithm_of_the_paper_is_used() {
    for legacy_algorithm in [
        Algorithm::RicartAgrawalaExtended,
        Algorithm::SuzukiKasamiExtended,
    ] {
        let mut options = Options::default();
        options.legacy_algorithm = legacy_algorithm;
        let mut net = Net::default();
        net.start("a", 1, Algorithm::OwnerQueue, options);
        let owner = LockPeer::new("agent1", 0).unwrap();
        net.call("a", |locks, now, out| {
            locks.join(now, &owner, LockDialect::Legacy, out);
            locks.lock(now, &bay(), None, out)
        });
        let mut owned = letter(
            Algorithm::OwnerQueue,
            "a_discover_0",
            LockDialect::Legacy,
            Act::Owned,
        );
        owned.algorithm = None;
        net.under_way.clear();
        net.call("a", |locks, now, out| {
            locks.handle(now, &owner, &owned, out)
        });
        let (.., request) = net.under_way.front().unwrap();
        assert_eq!(request.algorithm, Some(legacy_algorithm));
    }
}

/// A member that does not know the owner must not keep others waiting, and no resource has two algorithms.
#[test]
fn a_member_agrees_to_requests_of_an_algorithm_that_it_does_not_use() {
    let ra = Algorithm::RicartAgrawalaExtended;
    let asker = LockPeer::new("b", 1).unwrap();
    let request = letter(ra, "b_1", OWN, Act::Request { clock: 4 });
    // It was told to use another one, it knows an owner with another one, or it is looking for the owner.
    for (kind, owner) in [
        (Algorithm::SuzukiKasami, None),
        (Algorithm::OwnerQueue, Some(Algorithm::OwnerQueue)),
        (Algorithm::OwnerQueue, None),
    ] {
        let mut net = Net::default();
        net.start("a", 1, kind, Options::default());
        let crane = LockPeer::new("crane", 1).unwrap();
        net.call("a", |locks, now, out| {
            if let Some(named) = owner {
                locks.owner_named(now, &bay(), &crane, OWN, Some(named), out);
            }
            locks.lock(now, &bay(), None, out);
            locks.handle(now, &asker, &request, out);
        });
        let agrees = net.under_way.iter().filter(|(to, _, message)| {
            let is_agree = matches!(
                message.content,
                Content::Lock {
                    act: Act::Agree { .. },
                    ..
                }
            );
            is_agree && *to == asker && message.algorithm == Some(ra)
        });
        assert_eq!(agrees.count(), 1, "{kind}, {owner:?}");
    }
}
