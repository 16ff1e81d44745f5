//! Coalitions that change together are seen to change together.
//!
//! A merger changes one record and takes another one back; a split changes one and adds one. The
//! network carries records one by one, and loses some. So the beacon of a gateway
//! ([`super::beacon`]) has a digest of all coalitions that it announces, and is sent at once when
//! they change. What is heard of a gateway's coalitions waits here until all of it together is
//! what a beacon says, and is then shown in one go.
//!
//! Waiting ends: what is not complete after [`PATIENCE`] is shown as it is, and so is what comes
//! from a gateway whose beacons have stopped. So somebody who forges beacons delays what is told
//! of coalitions by that much, and nothing else. Agents never wait.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;

use super::beacon::{Digest, SILENCE};
use super::record;
use crate::{Entry, Role};

/// How long records wait for what belongs to them: a record that has just been changed stays so for
/// three seconds, a new one is probed for most of a second, and a beacon that was lost is repeated
/// after two and a half.
const PATIENCE: Duration = Duration::from_secs(7);
/// Most records that wait at one time, of all gateways.
const MAX_WAITING: usize = 1024;
/// Most gateways whose coalitions wait for each other.
const MAX_GATEWAYS: usize = 1024;

/// What the records with these full names are now, none for those that are gone.
pub(super) type Updates = Vec<(Arc<str>, Option<Arc<Entry>>)>;

/// What is heard of others' coalitions and not shown yet.
#[derive(Debug, Default)]
pub(super) struct Together {
    gateways: HashMap<Incarnation, Gateway>,
    /// Whose coalition a record is, from when it is heard until its end has been shown.
    records: HashMap<Arc<str>, Incarnation>,
    /// How many wait, of all gateways.
    waiting: usize,
}

#[derive(Debug, Default)]
struct Gateway {
    /// What its last beacon said of its coalitions, and when.
    said: Option<(Instant, Digest)>,
    /// What has been heard of each record.
    heard: HashMap<Arc<str>, Digest>,
    /// The digest of all that.
    digest: Digest,
    /// What has been heard and not been shown.
    waiting: HashMap<Arc<str>, Option<Arc<Entry>>>,
    /// Since when something waits.
    since: Option<Instant>,
}

impl Together {
    /// A record is that now, or gone: what is to be shown because of that.
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
        let mut shown = Updates::new();
        if let Some(before) = before
            && gateway != Some(before)
        {
            // It has become somebody else's, who need not wait for the other.
            self.records.remove(fullname);
            if let Some(other) = self.gateways.get_mut(&before) {
                other.hear(fullname, None);
                self.waiting -= usize::from(other.waiting.remove(fullname).is_some());
            }
            shown = self.settle(now, before);
        }
        let Some(gateway) = gateway else {
            shown.push((Arc::clone(fullname), entry));
            return shown;
        };
        self.records.insert(Arc::clone(fullname), gateway);
        let known = self.gateways.entry(gateway).or_default();
        known.hear(fullname, entry.as_deref());
        let already = known.waiting.insert(Arc::clone(fullname), entry);
        self.waiting += usize::from(already.is_none());
        known.since.get_or_insert(now);
        shown.extend(match self.waiting > MAX_WAITING {
            true => self.show(gateway),
            false => self.settle(now, gateway),
        });
        shown
    }

    /// A beacon of the gateway has said that of its coalitions: what is to be shown now.
    pub(super) fn said(&mut self, now: Instant, gateway: Incarnation, digest: Digest) -> Updates {
        let unknown = !self.gateways.contains_key(&gateway);
        if unknown && (digest == Digest::default() || !self.has_room(now)) {
            return Updates::new();
        }
        let known = self.gateways.entry(gateway).or_default();
        known.said = Some((now, digest));
        self.settle(now, gateway)
    }

    /// What has waited for long enough.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Updates {
        let due = |known: &Gateway| known.due().is_some_and(|due| due <= now);
        let due = self.gateways.iter().filter(|(_, known)| due(known));
        let due: Vec<Incarnation> = due.map(|(gateway, _)| *gateway).collect();
        due.into_iter().flat_map(|one| self.show(one)).collect()
    }

    /// When something will have waited for long enough.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        if self.waiting == 0 {
            return None;
        }
        self.gateways.values().filter_map(Gateway::due).min()
    }

    /// The gateway for whose beacons this entry has to wait, if it has to.
    fn gateway_of(&mut self, now: Instant, entry: &Entry) -> Option<Incarnation> {
        let gateway = entry.mts.incarnation;
        let waits = matches!(entry.role, Role::Coalition(_)) && gateway.is_known();
        let room = waits && (self.gateways.contains_key(&gateway) || self.has_room(now));
        room.then_some(gateway)
    }

    /// Whether one more gateway can be remembered.
    fn has_room(&mut self, now: Instant) -> bool {
        if self.gateways.len() >= MAX_GATEWAYS {
            // Those of whom nothing but an old beacon is known.
            self.gateways.retain(|_, known| {
                let said = known.said.is_some_and(|(when, _)| now < when + SILENCE);
                said || !known.heard.is_empty() || !known.waiting.is_empty()
            });
        }
        self.gateways.len() < MAX_GATEWAYS
    }

    fn settle(&mut self, now: Instant, gateway: Incarnation) -> Updates {
        let Some(known) = self.gateways.get(&gateway) else {
            return Updates::new();
        };
        let complete = known.said.is_some_and(|(_, said)| said == known.digest);
        if complete || known.due().is_some_and(|due| due <= now) {
            return self.show(gateway);
        }
        Updates::new()
    }

    /// All that waits of this gateway is shown.
    fn show(&mut self, gateway: Incarnation) -> Updates {
        let Some(known) = self.gateways.get_mut(&gateway) else {
            return Updates::new();
        };
        known.since = None;
        let mut shown: Updates = known.waiting.drain().collect();
        self.waiting -= shown.len();
        // A record that goes on under another label has not been away.
        shown.sort_by_key(|(_, entry)| entry.is_none());
        for (fullname, _) in shown.iter().filter(|(_, entry)| entry.is_none()) {
            self.records.remove(fullname);
        }
        let nothing_said = known.said.is_none_or(|(_, it)| it == Digest::default());
        if known.heard.is_empty() && nothing_said {
            self.gateways.remove(&gateway);
        }
        shown
    }
}

impl Gateway {
    fn hear(&mut self, fullname: &Arc<str>, entry: Option<&Entry>) {
        if let Some(before) = self.heard.remove(fullname) {
            self.digest.remove(before);
        }
        if let Some(entry) = entry {
            let digest = Digest::of(&record::encode(entry));
            self.digest.add(digest);
            self.heard.insert(Arc::clone(fullname), digest);
        }
    }

    /// When what waits is shown in any case.
    fn due(&self) -> Option<Instant> {
        let patience = self.since? + PATIENCE;
        let silent = self.said.map(|(when, _)| when + SILENCE);
        Some(silent.map_or(patience, |silent| silent.min(patience)))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, VecDeque};

    use super::*;
    use crate::{Members, Mts, Reach, Source};

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
            mts: Mts::new("mts", gateway),
            description: String::new(),
            registered: std::time::UNIX_EPOCH,
            source: Source::Mdns,
            reach: Reach::Remote { gateway },
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

    /// What a watcher sees.
    #[derive(Default)]
    struct Shown(State);

    impl Shown {
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

    fn put(together: &mut Together, now: Instant, state: &State, name: &str) -> Updates {
        let entry = state.get(name).map(|members| entry(1, name, members));
        together.put(now, &name.into(), entry)
    }

    #[test]
    fn a_merger_is_shown_when_all_of_it_is_there() {
        let (mut together, now, mut shown) =
            (Together::default(), Instant::now(), Shown::default());
        let apart = state(&[("one", &["a", "b"]), ("two", &["c"])]);
        let merged = state(&[("one", &["a", "b", "c"])]);
        let gateway = Incarnation::from_u64(1);
        // Nothing is shown of what is found one by one, either.
        assert!(put(&mut together, now, &apart, "one").is_empty());
        assert!(together.said(now, gateway, digest(1, &apart)).is_empty());
        shown.apply(put(&mut together, now, &apart, "two"));
        assert_eq!(shown.0, apart);
        assert_eq!(together.poll_timeout(), None);

        assert!(put(&mut together, now, &merged, "two").is_empty());
        assert!(put(&mut together, now, &merged, "one").is_empty());
        shown.apply(together.said(now, gateway, digest(1, &merged)));
        assert_eq!(shown.0, merged);
        // The last one leaves, and nothing is remembered.
        let none = State::new();
        assert!(put(&mut together, now, &none, "one").is_empty());
        shown.apply(together.said(now, gateway, digest(1, &none)));
        assert_eq!(shown.0, none);
        assert!(together.gateways.is_empty() && together.records.is_empty());
    }

    #[test]
    fn what_never_becomes_complete_is_shown_after_a_while() {
        let (mut together, now) = (Together::default(), Instant::now());
        let half = state(&[("one", &["a"]), ("two", &["b"])]);
        let gateway = Incarnation::from_u64(1);
        together.said(now, gateway, digest(1, &half));
        assert!(put(&mut together, now, &half, "one").is_empty());
        assert_eq!(together.poll_timeout(), Some(now + PATIENCE));
        assert!(together.handle_timeout(now + PATIENCE / 2).is_empty());
        assert_eq!(together.handle_timeout(now + PATIENCE).len(), 1);
        assert_eq!(together.poll_timeout(), None);
        // Who is silent is not waited for.
        let later = now + SILENCE;
        assert_eq!(put(&mut together, later, &half, "two").len(), 1);
    }

    #[test]
    fn agents_and_what_changes_hands_do_not_wait() {
        let (mut together, now) = (Together::default(), Instant::now());
        let mut agent = Entry::clone(&entry(1, "one", &["a".to_owned()]));
        agent.role = Role::Agent;
        let name: Arc<str> = "one".into();
        let shown = together.put(now, &name, Some(Arc::new(agent.clone())));
        assert_eq!(shown.len(), 1);
        assert!(together.put(now, &name, None).len() == 1);
        let coalition = state(&[("one", &["a"])]);
        assert!(put(&mut together, now, &coalition, "one").is_empty());
        assert!(together.put(now, &name, None).is_empty(), "waits");
        // The label is another gateway's now, or an agent's: what waited does not undo that.
        let other = entry(2, "one", &["b".to_owned()]);
        assert!(together.put(now, &name, Some(other)).is_empty());
        assert_eq!(together.put(now, &name, Some(Arc::new(agent))).len(), 1);
        assert_eq!(together.waiting, 0);
        assert!(together.handle_timeout(now + PATIENCE).is_empty());
    }

    #[test]
    fn what_waits_is_bounded() {
        let (mut together, now) = (Together::default(), Instant::now());
        let mut shown = 0;
        for number in 0..10_000_u64 {
            let name: Arc<str> = number.to_string().into();
            let entry = entry(number % 2000 + 1, &name, &["a".to_owned()]);
            shown += together.put(now, &name, Some(entry)).len();
            assert!(together.waiting <= MAX_WAITING);
        }
        assert!(together.gateways.len() <= MAX_GATEWAYS);
        shown += together.handle_timeout(now + PATIENCE).len();
        assert_eq!((shown, together.waiting), (10_000, 0));
    }

    /// Merges and splits, in bursts, on a network that delays each record by itself, repeats some
    /// and loses beacons: whoever watches sees what was once so and nothing else, and in the end
    /// what is.
    #[test]
    fn nobody_sees_a_state_that_never_was() {
        let seeds = std::env::var("FIPA_SIM_SEEDS").ok();
        let seeds: u64 = seeds.map_or(40, |seeds| seeds.parse().unwrap());
        for seed in 0..seeds {
            one_world(seed);
        }
    }

    fn one_world(seed: u64) {
        let mut random = fastrand::Rng::with_seed(seed);
        let (start, gateway) = (Instant::now(), Incarnation::from_u64(1));
        let (mut together, mut shown) = (Together::default(), Shown::default());
        let mut is = state(&[("c0", &["a", "b", "c", "d", "e", "f"])]);
        let mut was = vec![State::new(), is.clone()];
        // When which record is heard; what is heard is what it is then.
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
                    // The last word, of which the repetition may be lost.
                    records.push((millis + 1500, name));
                }
                let pause = if random.bool() { 300 } else { 9_000 };
                next_change += pause + random.u64(0..50) * 10;
                // Said at once.
                next_beacon = millis;
            }
            if millis == next_beacon {
                next_beacon += 2_000 + random.u64(0..50) * 10;
                // Not two in a row.
                lost = !lost && random.u8(0..5) == 0;
                if !lost {
                    beacons.push_back((millis + random.u64(0..10) * 10, digest(1, &is)));
                }
            }
            let mut updates = Vec::new();
            records.retain(|(due, name)| {
                if *due <= millis {
                    updates.push(put(&mut together, now, &is, name));
                }
                *due > millis
            });
            while beacons.front().is_some_and(|(due, _)| *due <= millis) {
                if let Some((_, digest)) = beacons.pop_front() {
                    updates.push(together.said(now, gateway, digest));
                }
            }
            updates.push(together.handle_timeout(now));
            for update in updates {
                if shown.apply(update) {
                    assert!(was.contains(&shown.0), "seed {seed}: {:?}", shown.0);
                }
            }
        }
        assert_eq!(shown.0, is, "seed {seed}");
        assert_eq!(together.poll_timeout(), None, "seed {seed}");
    }

    /// A merger or a split: the names of those that are different.
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
