//! Atomic visibility of coalition changes.
//!
//! A merger changes one record and withdraws another; a split changes one and adds one. The network
//! carries records one by one, and loses some. The beacon of a gateway ([`super::beacon`])
//! therefore has a digest of all coalitions that it announces, and is sent at once when they
//! change. Received coalition records of a gateway wait here until they match its beacon, and then
//! become visible as one update.
//!
//! The wait is bounded: records that do not match after [`TIMEOUT`] become visible as they are,
//! and so do those of a gateway whose beacons have stopped. A host that forges beacons can
//! therefore only delay coalition changes by that time. Agents never wait.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;

use super::beacon::{Digest, SILENCE};
use super::record;
use crate::{Entry, Role};

/// Maximum time for which a record waits: a changed record stays unchanged for three seconds, a new
/// one is probed for most of a second, and a lost beacon is repeated after two and a half.
const TIMEOUT: Duration = Duration::from_secs(7);
/// Maximum number of waiting records of all gateways.
const MAX_WAITING: usize = 1024;
/// Maximum number of gateways with waiting coalitions.
const MAX_GATEWAYS: usize = 1024;

/// New entries of the records with these full names; `None` for removed ones.
pub(super) type Updates = Vec<(Arc<str>, Option<Arc<Entry>>)>;

/// Coalition records of other gateways that are not visible yet.
#[derive(Debug, Default)]
pub(super) struct CoalitionSync {
    gateways: HashMap<Incarnation, Gateway>,
    /// The gateway of each coalition record, until its removal is visible.
    records: HashMap<Arc<str>, Incarnation>,
    /// Number of waiting records of all gateways.
    waiting: usize,
}

#[derive(Debug, Default)]
struct Gateway {
    /// Coalition digest of its last beacon, and its time.
    beacon: Option<(Instant, Digest)>,
    /// Digest of each received record.
    received: HashMap<Arc<str>, Digest>,
    /// Digest of all of them.
    digest: Digest,
    /// Received records that are not visible yet.
    waiting: HashMap<Arc<str>, Option<Arc<Entry>>>,
    /// Start of the wait.
    since: Option<Instant>,
}

impl CoalitionSync {
    /// Handles a record, or its removal, and returns the updates that become visible.
    pub(super) fn put(
        &mut self,
        now: Instant,
        fullname: &Arc<str>,
        entry: Option<Arc<Entry>>,
    ) -> Updates {
        let before = self.records.get(fullname).copied();
        let gateway = match &entry {
            Some(entry) => self.gateway_of(now, entry),
            None => before,
        };
        let mut visible = Updates::new();
        if let Some(before) = before
            && gateway != Some(before)
        {
            // The record now belongs to another gateway, and must not wait for the previous one.
            self.records.remove(fullname);
            if let Some(other) = self.gateways.get_mut(&before) {
                other.receive(fullname, None);
                self.waiting -= usize::from(other.waiting.remove(fullname).is_some());
            }
            visible = self.settle(now, before);
        }
        let Some(gateway) = gateway else {
            visible.push((Arc::clone(fullname), entry));
            return visible;
        };
        self.records.insert(Arc::clone(fullname), gateway);
        let known = self.gateways.entry(gateway).or_default();
        known.receive(fullname, entry.as_deref());
        let already = known.waiting.insert(Arc::clone(fullname), entry);
        self.waiting += usize::from(already.is_none());
        known.since.get_or_insert(now);
        visible.extend(match self.waiting > MAX_WAITING {
            true => self.show(gateway),
            false => self.settle(now, gateway),
        });
        visible
    }

    /// Handles the coalition digest of a beacon, and returns the updates that become visible.
    pub(super) fn handle_beacon(
        &mut self,
        now: Instant,
        gateway: Incarnation,
        digest: Digest,
    ) -> Updates {
        let unknown = !self.gateways.contains_key(&gateway);
        if unknown && (digest == Digest::default() || !self.has_room(now)) {
            return Updates::new();
        }
        let known = self.gateways.entry(gateway).or_default();
        known.beacon = Some((now, digest));
        self.settle(now, gateway)
    }

    /// Returns the updates whose wait has ended.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Updates {
        let due = |known: &Gateway| known.due().is_some_and(|due| due <= now);
        let due = self.gateways.iter().filter(|(_, known)| due(known));
        let due: Vec<Incarnation> = due.map(|(gateway, _)| *gateway).collect();
        due.into_iter().flat_map(|one| self.show(one)).collect()
    }

    /// Time at which a wait ends next.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        if self.waiting == 0 {
            return None;
        }
        self.gateways.values().filter_map(Gateway::due).min()
    }

    /// Returns the gateway whose beacon this entry must wait for, if any.
    fn gateway_of(&mut self, now: Instant, entry: &Entry) -> Option<Incarnation> {
        let gateway = entry.mts.incarnation;
        let waits = matches!(entry.role, Role::Coalition(_)) && gateway.is_known();
        let room = waits && (self.gateways.contains_key(&gateway) || self.has_room(now));
        room.then_some(gateway)
    }

    /// Whether another gateway can be stored.
    fn has_room(&mut self, now: Instant) -> bool {
        if self.gateways.len() >= MAX_GATEWAYS {
            // Drops gateways of which only an old beacon is stored.
            self.gateways.retain(|_, known| {
                let beacon = known.beacon.is_some_and(|(when, _)| now < when + SILENCE);
                beacon || !known.received.is_empty() || !known.waiting.is_empty()
            });
        }
        self.gateways.len() < MAX_GATEWAYS
    }

    fn settle(&mut self, now: Instant, gateway: Incarnation) -> Updates {
        let Some(known) = self.gateways.get(&gateway) else {
            return Updates::new();
        };
        let complete = known
            .beacon
            .is_some_and(|(_, beacon)| beacon == known.digest);
        if complete || known.due().is_some_and(|due| due <= now) {
            return self.show(gateway);
        }
        Updates::new()
    }

    /// Makes all waiting records of this gateway visible.
    fn show(&mut self, gateway: Incarnation) -> Updates {
        let Some(known) = self.gateways.get_mut(&gateway) else {
            return Updates::new();
        };
        known.since = None;
        let mut visible: Updates = known.waiting.drain().collect();
        self.waiting -= visible.len();
        // Additions come first, so that a record that continues under another label does not
        // disappear in between.
        visible.sort_by_key(|(_, entry)| entry.is_none());
        for (fullname, _) in visible.iter().filter(|(_, entry)| entry.is_none()) {
            self.records.remove(fullname);
        }
        let nothing_said = known.beacon.is_none_or(|(_, it)| it == Digest::default());
        if known.received.is_empty() && nothing_said {
            self.gateways.remove(&gateway);
        }
        visible
    }
}

impl Gateway {
    fn receive(&mut self, fullname: &Arc<str>, entry: Option<&Entry>) {
        if let Some(before) = self.received.remove(fullname) {
            self.digest.remove(before);
        }
        if let Some(entry) = entry {
            let digest = Digest::of(&record::encode(entry));
            self.digest.add(digest);
            self.received.insert(Arc::clone(fullname), digest);
        }
    }

    /// Time at which its waiting records become visible in any case.
    fn due(&self) -> Option<Instant> {
        let timeout = self.since? + TIMEOUT;
        let silent = self.beacon.map(|(when, _)| when + SILENCE);
        Some(silent.map_or(timeout, |silent| silent.min(timeout)))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, VecDeque};

    use super::*;
    use crate::{Members, MtsId, Reach, Source};

    /// Coalitions and their members.
    type State = BTreeMap<String, Vec<String>>;

    fn entry(gateway: u64, name: &str, members: &[String]) -> Arc<Entry> {
        let gateway = Incarnation::from_u64(gateway);
        let members = Members::new(members.iter().map(String::as_str), None).unwrap();
        Arc::new(Entry {
            name: name.into(),
            agent_type: String::new(),
            incarnation: Incarnation::from_u64(7),
            locations: Vec::new(),
            mts: MtsId::new("mts", gateway),
            description: String::new(),
            registered: std::time::UNIX_EPOCH,
            source: Source::Mdns,
            reach: Reach::Remote { gateway },
            peer: fipa_transport::PeerId::THIS_HOST,
            role: Role::Coalition(members),
        })
    }

    fn digest(gateway: u64, state: &State) -> Digest {
        let mut digest = Digest::default();
        for (name, members) in state {
            digest.add(Digest::of(&record::encode(&entry(gateway, name, members))));
        }
        digest
    }

    fn state(coalitions: &[(&str, &[&str])]) -> State {
        let own = |(name, members): &(&str, &[&str])| {
            let members = members.iter().map(ToString::to_string).collect();
            ((*name).to_owned(), members)
        };
        coalitions.iter().map(own).collect()
    }

    /// The state that a watcher sees.
    #[derive(Default)]
    struct Visible(State);

    impl Visible {
        fn apply(&mut self, updates: Updates) -> bool {
            for (fullname, entry) in &updates {
                match entry.as_deref() {
                    Some(entry) => {
                        let Role::Coalition(members) = &entry.role else {
                            panic!("{entry:?}");
                        };
                        let members = members.names().iter().map(ToString::to_string);
                        self.0.insert(fullname.to_string(), members.collect());
                    }
                    None => drop(self.0.remove(&**fullname)),
                }
            }
            !updates.is_empty()
        }
    }

    fn put(sync: &mut CoalitionSync, now: Instant, state: &State, name: &str) -> Updates {
        let entry = state.get(name).map(|members| entry(1, name, members));
        sync.put(now, &name.into(), entry)
    }

    #[test]
    fn a_merger_becomes_visible_when_it_is_complete() {
        let (mut sync, now, mut visible) =
            (CoalitionSync::default(), Instant::now(), Visible::default());
        let apart = state(&[("one", &["a", "b"]), ("two", &["c"])]);
        let merged = state(&[("one", &["a", "b", "c"])]);
        let gateway = Incarnation::from_u64(1);
        // The initial records also become visible only when they are complete.
        assert!(put(&mut sync, now, &apart, "one").is_empty());
        assert!(
            sync.handle_beacon(now, gateway, digest(1, &apart))
                .is_empty()
        );
        visible.apply(put(&mut sync, now, &apart, "two"));
        assert_eq!(visible.0, apart);
        assert_eq!(sync.poll_timeout(), None);

        assert!(put(&mut sync, now, &merged, "two").is_empty());
        assert!(put(&mut sync, now, &merged, "one").is_empty());
        visible.apply(sync.handle_beacon(now, gateway, digest(1, &merged)));
        assert_eq!(visible.0, merged);
        // After the last coalition left, no state remains.
        let none = State::new();
        assert!(put(&mut sync, now, &none, "one").is_empty());
        visible.apply(sync.handle_beacon(now, gateway, digest(1, &none)));
        assert_eq!(visible.0, none);
        assert!(sync.gateways.is_empty() && sync.records.is_empty());
    }

    #[test]
    fn an_incomplete_update_becomes_visible_after_the_timeout() {
        let (mut sync, now) = (CoalitionSync::default(), Instant::now());
        let half = state(&[("one", &["a"]), ("two", &["b"])]);
        let gateway = Incarnation::from_u64(1);
        sync.handle_beacon(now, gateway, digest(1, &half));
        assert!(put(&mut sync, now, &half, "one").is_empty());
        assert_eq!(sync.poll_timeout(), Some(now + TIMEOUT));
        assert!(sync.handle_timeout(now + TIMEOUT / 2).is_empty());
        assert_eq!(sync.handle_timeout(now + TIMEOUT).len(), 1);
        assert_eq!(sync.poll_timeout(), None);
        // A gateway without beacons is not waited for.
        let later = now + SILENCE;
        assert_eq!(put(&mut sync, later, &half, "two").len(), 1);
    }

    #[test]
    fn agents_and_records_that_change_their_gateway_do_not_wait() {
        let (mut sync, now) = (CoalitionSync::default(), Instant::now());
        let mut agent = Entry::clone(&entry(1, "one", &["a".to_owned()]));
        agent.role = Role::Agent;
        let name: Arc<str> = "one".into();
        let visible = sync.put(now, &name, Some(Arc::new(agent.clone())));
        assert_eq!(visible.len(), 1);
        assert!(sync.put(now, &name, None).len() == 1);
        let coalition = state(&[("one", &["a"])]);
        assert!(put(&mut sync, now, &coalition, "one").is_empty());
        assert!(sync.put(now, &name, None).is_empty(), "waits");
        // The label now belongs to another gateway, or to an agent: the waiting removal does not
        // apply to it.
        let other = entry(2, "one", &["b".to_owned()]);
        assert!(sync.put(now, &name, Some(other)).is_empty());
        assert_eq!(sync.put(now, &name, Some(Arc::new(agent))).len(), 1);
        assert_eq!(sync.waiting, 0);
        assert!(sync.handle_timeout(now + TIMEOUT).is_empty());
    }

    #[test]
    fn the_number_of_waiting_records_is_bounded() {
        let (mut sync, now) = (CoalitionSync::default(), Instant::now());
        let mut visible = 0;
        for number in 0..10_000_u64 {
            let name: Arc<str> = number.to_string().into();
            let entry = entry(number % 2000 + 1, &name, &["a".to_owned()]);
            visible += sync.put(now, &name, Some(entry)).len();
            assert!(sync.waiting <= MAX_WAITING);
        }
        assert!(sync.gateways.len() <= MAX_GATEWAYS);
        visible += sync.handle_timeout(now + TIMEOUT).len();
        assert_eq!((visible, sync.waiting), (10_000, 0));
    }

    /// Simulates mergers and splits, in bursts, on a network that delays each record independently,
    /// repeats some and loses beacons. A watcher must see only states that existed, and finally the
    /// current one.
    #[test]
    fn no_watcher_sees_a_state_that_never_existed() {
        let seeds = std::env::var("FIPA_SIM_SEEDS").ok();
        let seeds: u64 = seeds.map_or(40, |seeds| seeds.parse().unwrap());
        for seed in 0..seeds {
            simulate(seed);
        }
    }

    fn simulate(seed: u64) {
        let mut random = fastrand::Rng::with_seed(seed);
        let (start, gateway) = (Instant::now(), Incarnation::from_u64(1));
        let (mut sync, mut visible) = (CoalitionSync::default(), Visible::default());
        let mut is = state(&[("c0", &["a", "b", "c", "d", "e", "f"])]);
        let mut was = vec![State::new(), is.clone()];
        // Times at which records arrive; the content is that at the time of arrival.
        let mut records = vec![(0, "c0".to_owned())];
        let mut beacons: VecDeque<(u64, Digest)> = VecDeque::new();
        let (mut next_beacon, mut lost, mut next_change, mut named) = (0, false, 9_000, 1);
        for millis in (0..60_000).step_by(10) {
            let now = start + Duration::from_millis(millis);
            if millis == next_change && millis < 50_000 {
                let changed = change(&mut random, &mut is, &mut named);
                was.push(is.clone());
                for name in changed {
                    for _ in 0..random.u32(1..3) {
                        records.push((millis + random.u64(0..150) * 10, name.clone()));
                    }
                    // The final transmission; the earlier repetition may be lost.
                    records.push((millis + 1500, name));
                }
                let pause = if random.bool() { 300 } else { 9_000 };
                next_change += pause + random.u64(0..50) * 10;
                // The beacon is sent at once.
                next_beacon = millis;
            }
            if millis == next_beacon {
                next_beacon += 2_000 + random.u64(0..50) * 10;
                // Never two losses in a row.
                lost = !lost && random.u8(0..5) == 0;
                if !lost {
                    beacons.push_back((millis + random.u64(0..10) * 10, digest(1, &is)));
                }
            }
            let mut updates = Vec::new();
            records.retain(|(due, name)| {
                if *due <= millis {
                    updates.push(put(&mut sync, now, &is, name));
                }
                *due > millis
            });
            while beacons.front().is_some_and(|(due, _)| *due <= millis) {
                if let Some((_, digest)) = beacons.pop_front() {
                    updates.push(sync.handle_beacon(now, gateway, digest));
                }
            }
            updates.push(sync.handle_timeout(now));
            for update in updates {
                if visible.apply(update) {
                    assert!(was.contains(&visible.0), "seed {seed}: {:?}", visible.0);
                }
            }
        }
        assert_eq!(visible.0, is, "seed {seed}");
        assert_eq!(sync.poll_timeout(), None, "seed {seed}");
    }

    /// Performs a merger or a split, and returns the names of the changed coalitions.
    fn change(random: &mut fastrand::Rng, is: &mut State, named: &mut u32) -> Vec<String> {
        let names: Vec<String> = is.keys().cloned().collect();
        let one = random.choice(&names).unwrap().clone();
        let other = random.choice(&names).unwrap().clone();
        if one != other {
            let joining = is.remove(&other).unwrap();
            is.get_mut(&one).unwrap().extend(joining);
            return vec![one, other];
        }
        let members = is.get_mut(&one).unwrap();
        if members.len() < 2 {
            return Vec::new();
        }
        let parting = members.split_off(members.len() / 2);
        let new = format!("c{named}");
        *named += 1;
        is.insert(new.clone(), parting);
        vec![one, new]
    }
}
