//! The records of peers that are verified, and their times: by a doubt about their gateway, by a beacon that
//! contradicts them, and for legacy peers one by one. Knows the stored records by gateway.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;

use super::beacon::{Digest, StoredDigest};
use super::record;
use crate::Entry;

/// Maximum number of records that are verified at a time, and the pause afterwards: verifying
/// hundreds takes seconds instead of flooding the network.
const BATCH: usize = 25;
const PAUSE: Duration = Duration::from_millis(100);
/// Time after the start of a suspicion in which the removal of a queried record also casts doubt on the
/// rest of its gateway.
const DOUBT: Duration = Duration::from_secs(6);
/// Minimum time between two suspicions of a gateway whose records change.
const AGAIN: Duration = Duration::from_secs(1);

/// Records of other hosts by gateway, and the queue of those to verify.
#[derive(Debug, Default)]
pub(super) struct Verification {
    records: HashMap<Arc<str>, (Incarnation, Digest)>,
    gateways: HashMap<Incarnation, Gateway>,
    queue: VecDeque<Arc<str>>,
    /// Records in the queue that have no gateway (legacy peers).
    legacy_queued: HashSet<Arc<str>>,
    /// Records of gateways that have ended.
    ended: Vec<Arc<str>>,
    next: Option<Instant>,
}

#[derive(Debug)]
struct Gateway {
    stored: StoredDigest,
    records: HashSet<Arc<str>>,
    /// Start of the current suspicion, and the record that stands for the gateway.
    suspected: Option<(Instant, Arc<str>)>,
    /// Records that are verified during this suspicion.
    verified: HashSet<Arc<str>>,
}

impl Verification {
    /// Stores the record with this full name, or removes it if `entry` is `None`.
    pub(super) fn put(&mut self, now: Instant, fullname: &Arc<str>, entry: Option<&Entry>) {
        if let Some((gateway, digest)) = self.records.remove(fullname)
            && let Some(known) = self.gateways.get_mut(&gateway)
        {
            known.stored.digest.remove(digest);
            known.stored.changed = now;
            known.records.remove(fullname);
            let end = known
                .suspected
                .take_if(|(_, suspected)| entry.is_none() && suspected == fullname);
            if let Some((since, _)) = end
                && now < since + DOUBT
            {
                // The gateway did not answer for this record, so it probably does not answer for
                // the others either. Queues those that are not being verified yet.
                let waiting: HashSet<&Arc<str>> = self.queue.iter().collect();
                let rest = known.records.difference(&known.verified);
                let rest: Vec<Arc<str>> =
                    rest.filter(|it| !waiting.contains(it)).cloned().collect();
                self.queue.extend(rest);
            }
            let replaced = entry.is_some_and(|entry| entry.mts.incarnation == gateway);
            if known.records.is_empty() && !replaced {
                self.gateways.remove(&gateway);
            }
        }
        let Some(entry) = entry.filter(|entry| entry.mts.incarnation.is_known()) else {
            return;
        };
        let digest = Digest::of(&record::encode(entry));
        let gateway = entry.mts.incarnation;
        let known = self.gateways.entry(gateway).or_insert_with(|| Gateway {
            stored: StoredDigest {
                digest: Digest::default(),
                changed: now,
            },
            records: HashSet::new(),
            suspected: None,
            verified: HashSet::new(),
        });
        known.stored.digest.add(digest);
        known.stored.changed = now;
        known.records.insert(Arc::clone(fullname));
        self.records.insert(Arc::clone(fullname), (gateway, digest));
    }

    /// Digest of the stored records of this gateway.
    pub(super) fn of(&self, gateway: Incarnation) -> Option<StoredDigest> {
        self.gateways.get(&gateway).map(|known| known.stored)
    }

    /// Returns the gateways with stored records.
    pub(super) fn gateways(&self) -> impl Iterator<Item = Incarnation> {
        self.gateways.keys().copied()
    }

    /// Doubts the gateway: queues up to `BATCH` of its records for verification first. If it has
    /// more, one of these stands for the rest. Returns false when there are no records, or a suspicion
    /// has already started and no record changed since.
    pub(super) fn suspect(&mut self, now: Instant, gateway: Incarnation) -> bool {
        let Some(known) = self.gateways.get_mut(&gateway) else {
            return false;
        };
        let already = known.suspected.as_ref();
        if let Some((since, _)) = already {
            // Records that changed are a reason to ask again: the gateway may have moved again.
            let pause = match known.stored.changed > *since {
                true => AGAIN,
                false => DOUBT,
            };
            if now < *since + pause {
                return false;
            }
        }
        let asked: Vec<Arc<str>> = known.records.iter().take(BATCH).cloned().collect();
        let Some(first) = asked.first() else {
            return false;
        };
        // A gateway with at most `BATCH` records has all of them verified, and each expires
        // individually.
        known.suspected = Some((now, Arc::clone(first)));
        known.verified = asked.iter().cloned().collect();
        for fullname in asked.into_iter().rev() {
            self.queue.push_front(fullname);
        }
        self.shorten_queue();
        true
    }

    /// Drops later copies of queued names when half of the queue may be copies: a gateway that stays silent
    /// is suspected again and again, and the network decides how many gateways do so.
    fn shorten_queue(&mut self) {
        if self.queue.len() <= 2 * (self.records.len() + self.legacy_queued.len()) + BATCH {
            return;
        }
        let mut queued = HashSet::new();
        let (records, peers) = (&self.records, &self.legacy_queued);
        self.queue.retain(|name| {
            (records.contains_key(name) || peers.contains(name)) && queued.insert(Arc::clone(name))
        });
    }

    /// Ends all records of this gateway, which ended without a goodbye.
    pub(super) fn end(&mut self, gateway: Incarnation) {
        if let Some(known) = self.gateways.get(&gateway)
            && self.ended.len() <= self.records.len()
        {
            self.ended.extend(known.records.iter().cloned());
        }
    }

    /// Takes the full names of records that end now.
    pub(super) fn take_ended(&mut self) -> Vec<Arc<str>> {
        std::mem::take(&mut self.ended)
    }

    /// Queues a record of a legacy peer, which has no gateway, for verification.
    pub(super) fn verify(&mut self, fullname: &Arc<str>) {
        if self.legacy_queued.insert(Arc::clone(fullname)) {
            self.queue.push_front(Arc::clone(fullname));
        }
    }

    /// Queues all records of this gateway for verification.
    pub(super) fn verify_all(&mut self, gateway: Incarnation) {
        // Bounds the queue: queued records need not be queued again.
        if let Some(known) = self.gateways.get(&gateway)
            && self.queue.len() <= self.records.len()
        {
            self.queue.extend(known.records.iter().cloned());
        }
    }

    /// Takes the full names of records to verify now.
    pub(super) fn due(&mut self, now: Instant) -> Vec<Arc<str>> {
        if self.queue.is_empty() || self.next.is_some_and(|next| now < next) {
            return Vec::new();
        }
        self.next = Some(now + PAUSE);
        let batch = self.queue.len().min(BATCH);
        let (records, peers) = (&self.records, &mut self.legacy_queued);
        let batch = self.queue.drain(..batch);
        batch
            .filter(|name| peers.remove(name) || records.contains_key(name))
            .collect()
    }

    /// Time of the next verification.
    pub(super) fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        (!self.queue.is_empty()).then(|| self.next.unwrap_or(now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{MtsId, Reach, Role, Source};

    fn entry(number: u64, gateway: u64) -> Entry {
        let gateway = Incarnation::from_u64(gateway);
        Entry {
            name: format!("agent {number}").into(),
            agent_type: String::new(),
            incarnation: Incarnation::from_u64(number),
            locations: Vec::new(),
            mts: MtsId::new("mts", gateway),
            description: String::new(),
            registered: std::time::UNIX_EPOCH,
            source: Source::Mdns,
            reach: Reach::Remote { gateway },
            peer: fipa_transport::PeerId::THIS_HOST,
            role: Role::Agent,
        }
    }

    fn put(holdings: &mut Verification, now: Instant, number: u64, gateway: u64, there: bool) {
        let entry = entry(number, gateway);
        let entry = there.then_some(&entry);
        holdings.put(now, &number.to_string().into(), entry);
    }

    #[test]
    fn the_digest_of_a_gateway_follows_its_records() {
        let mut holdings = Verification::default();
        let now = Instant::now();
        for number in 1..=3 {
            put(&mut holdings, now, number, 7, true);
        }
        put(&mut holdings, now, 9, 8, true);
        let mut expected = Digest::default();
        for number in [1, 3] {
            expected.add(Digest::of(&record::encode(&entry(number, 7))));
        }
        put(&mut holdings, now, 2, 7, false);
        // An identical update changes nothing.
        put(&mut holdings, now, 3, 7, true);
        let stored = holdings.of(Incarnation::from_u64(7)).unwrap();
        assert_eq!(stored.digest, expected);
        for number in [1, 3, 9] {
            put(&mut holdings, now, number, 7, false);
        }
        assert!(holdings.of(Incarnation::from_u64(7)).is_none());
        assert!(holdings.gateways.is_empty() && holdings.records.is_empty());
        put(&mut holdings, now, 1, 0, true);
        assert!(holdings.records.is_empty(), "legacy peers have no beacons");
    }

    #[test]
    fn the_end_of_a_doubted_record_verifies_all_records_of_its_gateway() {
        let mut holdings = Verification::default();
        let (now, gateway) = (Instant::now(), Incarnation::from_u64(7));
        for number in 0..60 {
            put(&mut holdings, now, number, 7, true);
        }
        assert!(holdings.suspect(now, gateway));
        assert!(!holdings.suspect(now, gateway));
        // The first batch is queried at once.
        let verified = holdings.due(now);
        assert_eq!(verified.len(), BATCH);
        let [suspected, others @ ..] = &verified[..] else {
            panic!("no record was queried");
        };
        put(&mut holdings, now, others[0].parse().unwrap(), 7, false);
        assert_eq!(
            holdings.poll_timeout(now),
            None,
            "only one record was removed"
        );
        put(&mut holdings, now, suspected.parse().unwrap(), 7, false);
        let mut asked = Vec::new();
        let mut now = now;
        while let Some(due) = holdings.poll_timeout(now) {
            now = due;
            let batch = holdings.due(now);
            assert!(batch.len() <= BATCH);
            asked.extend(batch);
        }
        assert_eq!(
            asked.len(),
            60 - BATCH,
            "the records that were not queried yet"
        );
        // After the suspicion, the end of a record affects no others.
        assert!(holdings.suspect(now, gateway));
        let suspected = holdings.due(now + PAUSE);
        now += DOUBT;
        put(&mut holdings, now, suspected[0].parse().unwrap(), 7, false);
        assert_eq!(holdings.poll_timeout(now), None);
    }

    #[test]
    fn a_gateway_whose_records_change_is_doubted_again_after_a_second() {
        let mut holdings = Verification::default();
        let (start, gateway) = (Instant::now(), Incarnation::from_u64(7));
        put(&mut holdings, start, 1, 7, true);
        assert!(holdings.suspect(start, gateway));
        assert!(!holdings.suspect(start + AGAIN, gateway), "nothing changed");
        // The gateway moves, and answers for its record.
        let moved = start + Duration::from_millis(300);
        put(&mut holdings, moved, 1, 7, true);
        assert!(!holdings.suspect(start + AGAIN / 2, gateway), "too early");
        assert!(holdings.suspect(start + AGAIN, gateway));
        assert!(!holdings.suspect(start + 2 * AGAIN, gateway), "unchanged");
    }

    #[test]
    fn gateways_that_are_doubted_often_take_bounded_memory() {
        let mut holdings = Verification::default();
        let start = Instant::now();
        for number in 0..250 {
            put(&mut holdings, start, number, 1 + number % 10, true);
        }
        for round in 0..100 {
            let now = start + 2 * DOUBT * round;
            for gateway in 1..=10 {
                assert!(holdings.suspect(now, Incarnation::from_u64(gateway)));
            }
        }
        assert!(holdings.queue.len() <= 2 * 250 + BATCH);
        // Each record is still verified, those of the last suspicion first.
        let mut now = start;
        let last: HashSet<Arc<str>> = holdings.due(now).into_iter().collect();
        assert!(last.iter().all(|it| it.parse::<u64>().unwrap() % 10 == 9));
        let mut verified = last;
        while let Some(due) = holdings.poll_timeout(now) {
            now = due;
            verified.extend(holdings.due(now));
        }
        assert_eq!(verified.len(), 250);
    }
}
