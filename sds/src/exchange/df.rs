//! Entries of directory facilitators, which travel with the directory entries of their agents.
//!
//! A gateway sends the entries that agents of its host have in its directory facilitator (DF). This
//! crate does not read their text. A received entry belongs to the gateway whose connection carried
//! it, and to a registration that this gateway lists. It is removed with that registration. The
//! numbers and the bytes are bounded for one entry, one gateway and all gateways.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{Incarnation, Principal};

use super::{Exchange, wire};

/// The entry that an agent of this host has in the directory facilitator of this gateway.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(clippy::exhaustive_structs, reason = "the gateway creates it")]
pub struct OwnDfEntry {
    /// The name of the agent.
    pub name: Arc<str>,
    /// The registration of the agent.
    pub incarnation: Incarnation,
    /// The description of the agent in FIPA-SL, without its lease.
    pub text: Arc<str>,
    /// The addresses at which agents of other platforms reach the agent.
    pub addresses: Vec<String>,
    /// The end of the lease; `None` for an entry that ends with its agent only.
    pub lease: Option<Instant>,
}

/// The entry that an agent of another host has in the directory facilitator of its gateway.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct DfEntry {
    /// The name of the agent.
    pub name: Arc<str>,
    /// The registration of the agent.
    pub incarnation: Incarnation,
    /// The gateway that sent the entry.
    pub gateway: Incarnation,
    /// The identity that the links of the gateway prove.
    pub principal: Principal,
    /// The description of the agent, as its gateway sent it. It may be malformed.
    pub text: Arc<str>,
    /// The addresses at which agents of other platforms reach the agent, as its gateway sent them. They may be malformed.
    pub addresses: Vec<String>,
    /// Whether the entry has a lease, which ends at `ends` or later.
    pub has_lease: bool,
    /// The time at which the entry ends unless the gateway sends it again.
    pub ends: Instant,
}

/// DF entries of one gateway, by the names of their agents.
pub(super) type DfEntries = BTreeMap<Arc<str>, Arc<DfEntry>>;

impl OwnDfEntry {
    /// Returns the entry as part of a letter, unless its lease has ended.
    pub(super) fn to_wire(&self, now: Instant) -> Option<wire::DfEntry> {
        let time_left = self.lease.map(|ends| ends.saturating_duration_since(now));
        if time_left.is_some_and(|time_left| time_left.is_zero()) {
            return None;
        }
        let millis = |time_left: Duration| {
            u64::try_from(time_left.as_millis())
                .unwrap_or(u64::MAX)
                .max(1)
        };
        Some(wire::DfEntry {
            entry: self.text.to_string(),
            addresses: self.addresses.clone(),
            lease: time_left.map(millis),
        })
    }

    /// Maximum length of the entry in a letter, in which some characters are escaped.
    pub(super) fn weight(&self) -> usize {
        let escaped = |byte| match byte {
            b'"' | b'\\' => 2,
            0..=0x1f => 6,
            _ => 1,
        };
        let weight = |text: &str| text.bytes().map(escaped).sum::<usize>();
        let addresses = self.addresses.iter().map(|it| weight(it) + 3);
        weight(&self.text) + addresses.sum::<usize>() + 70
    }

    fn bytes(&self) -> usize {
        bytes(&self.text, &self.addresses)
    }
}

/// Returns the bytes of an entry that count.
fn bytes(text: &str, addresses: &[String]) -> usize {
    text.len() + addresses.iter().map(String::len).sum::<usize>()
}

impl DfEntry {
    fn bytes(&self) -> usize {
        bytes(&self.text, &self.addresses)
    }

    /// Reads an entry of a letter that arrived now from this gateway. Returns `None` if the entry is
    /// too long or its lease has ended. Addresses beyond the bounds are left out.
    pub(super) fn read(
        now: Instant,
        (gateway, principal): (Incarnation, Principal),
        (name, incarnation): (&Arc<str>, Incarnation),
        received: wire::DfEntry,
    ) -> Option<Arc<Self>> {
        let time_left = received.lease.map(Duration::from_millis);
        if received.entry.len() > Exchange::MAX_DF_ENTRY
            || time_left.is_some_and(|time_left| time_left.is_zero())
        {
            return None;
        }
        let lease = time_left.map_or(Exchange::MAX_DF_LEASE, |time_left| {
            time_left.min(Exchange::MAX_DF_LEASE)
        });
        Some(Arc::new(Self {
            name: Arc::clone(name),
            incarnation,
            gateway,
            principal,
            text: received.entry.into(),
            addresses: {
                let all = received.addresses.into_iter();
                let fitting = all.filter(|it| it.len() <= Exchange::MAX_DF_ADDRESS);
                fitting.take(Exchange::MAX_DF_ADDRESSES).collect()
            },
            has_lease: time_left.is_some(),
            ends: now + lease,
        }))
    }
}

/// Keeps the entries that are sent: the first ones, as far as the bounds allow. Returns the names of the
/// others.
pub(super) fn bounded(entries: Vec<OwnDfEntry>) -> (BTreeMap<Arc<str>, OwnDfEntry>, Vec<Arc<str>>) {
    let (mut admitted, mut others, mut used) = (BTreeMap::new(), Vec::new(), Use::default());
    for entry in entries {
        let with = used.with(entry.bytes());
        if entry.text.len() <= Exchange::MAX_DF_ENTRY && with.is_within(Use::OF_GATEWAY) {
            used = with;
            admitted.insert(Arc::clone(&entry.name), entry);
        } else {
            others.push(entry.name);
        }
    }
    (admitted, others)
}

/// A number of entries, and the bytes of their texts and addresses.
#[derive(Debug, Clone, Copy, Default)]
struct Use {
    entries: usize,
    bytes: usize,
}

impl Use {
    const OF_GATEWAY: Self = Self {
        entries: Exchange::MAX_DF_ENTRIES,
        bytes: Exchange::MAX_DF_BYTES,
    };
    const OF_ALL: Self = Self {
        entries: Exchange::MAX_TOTAL_DF_ENTRIES,
        bytes: Exchange::MAX_TOTAL_DF_BYTES,
    };
    const OF_UNPROVED: Self = Self {
        entries: Exchange::MAX_TOTAL_DF_ENTRIES / 2,
        bytes: Exchange::MAX_TOTAL_DF_BYTES / 2,
    };

    fn with(self, bytes: usize) -> Self {
        self.plus(Self { entries: 1, bytes })
    }

    fn without(self, bytes: usize) -> Self {
        Self {
            entries: self.entries.saturating_sub(1),
            bytes: self.bytes.saturating_sub(bytes),
        }
    }

    fn plus(self, other: Self) -> Self {
        Self {
            entries: self.entries + other.entries,
            bytes: self.bytes + other.bytes,
        }
    }

    fn is_within(self, bound: Self) -> bool {
        self.entries <= bound.entries && self.bytes <= bound.bytes
    }
}

/// The DF entries of all neighbors.
#[derive(Debug, Default)]
pub(super) struct ReceivedDf {
    of: HashMap<Incarnation, OfGateway>,
}

#[derive(Debug)]
struct OfGateway {
    principal: Principal,
    entries: DfEntries,
    used: Use,
}

impl ReceivedDf {
    /// Returns all entries, in no particular order.
    pub(super) fn all(&self) -> Vec<Arc<DfEntry>> {
        let all = self.of.values().flat_map(|of| of.entries.values());
        all.cloned().collect()
    }

    /// Replaces all entries of a gateway. Returns whether there were or are any.
    pub(super) fn replace(
        &mut self,
        gateway: Incarnation,
        principal: Principal,
        entries: DfEntries,
    ) -> bool {
        let had_any = self.forget(gateway);
        let entries = entries.into_iter();
        let has_any = self.change(
            gateway,
            principal,
            entries.map(|(name, entry)| (name, Some(entry))),
        );
        had_any || has_any
    }

    /// Sets or removes entries of a gateway. Entries for which there is no room are left out. Returns
    /// whether there were or are entries with these names.
    pub(super) fn change(
        &mut self,
        gateway: Incarnation,
        principal: Principal,
        changes: impl IntoIterator<Item = (Arc<str>, Option<Arc<DfEntry>>)>,
    ) -> bool {
        let is_certified = matches!(principal, Principal::Certificate(_));
        let (mut same, mut unproved, mut all) = (Use::default(), Use::default(), Use::default());
        for (_, other) in self.of.iter().filter(|(other, _)| **other != gateway) {
            all = all.plus(other.used);
            if is_certified && other.principal == principal {
                same = same.plus(other.used);
            }
            if !matches!(other.principal, Principal::Certificate(_)) {
                unproved = unproved.plus(other.used);
            }
        }
        let of = self.of.entry(gateway).or_insert_with(|| OfGateway {
            principal,
            entries: DfEntries::new(),
            used: Use::default(),
        });
        of.principal = principal;
        let (mut any, mut refused) = (false, 0_usize);
        for (name, entry) in changes {
            if let Some(before) = of.entries.remove(&name) {
                of.used = of.used.without(before.bytes());
                any = true;
            }
            let Some(entry) = entry else {
                continue;
            };
            let with = of.used.with(entry.bytes());
            let has_room = with.plus(same).is_within(Use::OF_GATEWAY)
                && with.plus(all).is_within(Use::OF_ALL)
                && (is_certified || with.plus(unproved).is_within(Use::OF_UNPROVED));
            if has_room {
                of.used = with;
                of.entries.insert(name, entry);
                any = true;
            } else {
                refused += 1;
            }
        }
        if of.entries.is_empty() {
            self.of.remove(&gateway);
        }
        if refused > 0 {
            tracing::debug!(%gateway, refused, "DF entries of a gateway ignored: there is no room for them");
        }
        any
    }

    /// Removes all entries of a gateway. Returns whether there were any.
    pub(super) fn forget(&mut self, gateway: Incarnation) -> bool {
        self.of.remove(&gateway).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(gateway: u64, number: usize, bytes: usize) -> (Arc<str>, Option<Arc<DfEntry>>) {
        let name: Arc<str> = format!("agent-{gateway}-{number}").into();
        let received = wire::DfEntry {
            entry: "x".repeat(bytes),
            addresses: Vec::new(),
            lease: None,
        };
        let agent = (&name, Incarnation::from_u64(1));
        let of = (Incarnation::from_u64(gateway), Principal::Unproved);
        let entry = DfEntry::read(Instant::now(), of, agent, received);
        (name, entry)
    }

    /// Adds this many entries of a gateway, and returns the number that was stored.
    fn add(all: &mut ReceivedDf, gateway: u64, principal: Principal, of: (usize, usize)) -> usize {
        let before = all.all().len();
        let (count, bytes) = of;
        let entries = (0..count).map(|number| entry(gateway, number, bytes));
        all.change(Incarnation::from_u64(gateway), principal, entries);
        all.all().len() - before
    }

    #[test]
    fn the_entries_of_a_gateway_and_of_a_certificate_are_bounded() {
        let mut all = ReceivedDf::default();
        let one = Principal::Certificate([1; 32]);
        assert_eq!(add(&mut all, 1, one, (200, 10)), 200);
        // Another gateway with the same certificate.
        assert_eq!(
            add(&mut all, 2, one, (200, 10)),
            Exchange::MAX_DF_ENTRIES - 200
        );
        let two = Principal::Certificate([2; 32]);
        let large = Exchange::MAX_DF_BYTES / Exchange::MAX_DF_ENTRY;
        assert_eq!(add(&mut all, 3, two, (100, Exchange::MAX_DF_ENTRY)), large);
        // Entries that are sent again need no further room, and those that leave make room.
        assert_eq!(add(&mut all, 3, two, (large, Exchange::MAX_DF_ENTRY)), 0);
        let (name, _) = entry(3, 0, 1);
        all.change(Incarnation::from_u64(3), two, [(name, None)]);
        assert_eq!(add(&mut all, 3, two, (large, Exchange::MAX_DF_ENTRY)), 1);
        assert!(all.forget(Incarnation::from_u64(1)));
        assert!(!all.forget(Incarnation::from_u64(1)));
        assert_eq!(add(&mut all, 2, one, (256, 10)), 200);
    }

    #[test]
    fn gateways_without_certificates_have_half_of_the_room() {
        let mut all = ReceivedDf::default();
        let unproved: usize = (1..=100)
            .map(|gateway| add(&mut all, gateway, Principal::Unproved, (256, 10)))
            .sum();
        assert_eq!(unproved, Exchange::MAX_TOTAL_DF_ENTRIES / 2);
        let certified: usize = (101..=200_u8)
            .map(|gateway| {
                let principal = Principal::Certificate([gateway; 32]);
                add(&mut all, gateway.into(), principal, (256, 10))
            })
            .sum();
        assert_eq!(certified, Exchange::MAX_TOTAL_DF_ENTRIES / 2);
    }

    #[test]
    fn the_first_own_entries_are_sent_and_the_others_are_named() {
        let own = |number: usize, bytes: usize| OwnDfEntry {
            name: format!("agent-{number}").into(),
            incarnation: Incarnation::from_u64(1),
            text: "x".repeat(bytes).into(),
            addresses: Vec::new(),
            lease: None,
        };
        let too_long = own(0, Exchange::MAX_DF_ENTRY + 1);
        let many = (1..300).map(|number| own(number, 10));
        let (admitted, others) = bounded([too_long].into_iter().chain(many).collect());
        assert_eq!(admitted.len(), Exchange::MAX_DF_ENTRIES);
        assert!(admitted.contains_key("agent-1"));
        assert_eq!(others.len(), 300 - Exchange::MAX_DF_ENTRIES);
        assert_eq!(&*others[0], "agent-0");
        let (admitted, _) = bounded((0..100).map(|it| own(it, Exchange::MAX_DF_ENTRY)).collect());
        let bytes: usize = admitted.values().map(|entry| entry.text.len()).sum();
        assert_eq!(bytes, Exchange::MAX_DF_BYTES);
    }

    #[test]
    fn leases_travel_as_the_time_that_is_left_and_are_capped() {
        let now = Instant::now();
        let own = |time_left: Option<Duration>| OwnDfEntry {
            name: "a".into(),
            incarnation: Incarnation::from_u64(1),
            text: "x".into(),
            addresses: Vec::new(),
            lease: time_left.map(|time_left| now + time_left),
        };
        let read = |received_entry| {
            let agent = (&"a".into(), Incarnation::from_u64(1));
            let of = (Incarnation::from_u64(2), Principal::Unproved);
            DfEntry::read(now, of, agent, received_entry)
        };
        let received = |time_left| read(own(time_left).to_wire(now)?);
        let second = Duration::from_secs(1);
        let entry = received(Some(second)).unwrap();
        assert_eq!((entry.has_lease, entry.ends), (true, now + second));
        assert_eq!(received(Some(Duration::ZERO)), None);
        for (time_left, has_lease) in [(None, false), (Some(second * 1_000_000), true)] {
            let entry = received(time_left).unwrap();
            assert_eq!(entry.has_lease, has_lease);
            assert_eq!(entry.ends, now + Exchange::MAX_DF_LEASE);
        }
        let with_lease = |lease| wire::DfEntry {
            entry: String::new(),
            addresses: Vec::new(),
            lease: Some(lease),
        };
        assert_eq!(read(with_lease(0)), None);
        assert_eq!(
            read(with_lease(u64::MAX)).unwrap().ends,
            now + Exchange::MAX_DF_LEASE
        );
    }

    #[test]
    fn addresses_beyond_the_bounds_are_left_out() {
        let read = |addresses: Vec<String>| {
            let agent = (&"a".into(), Incarnation::from_u64(1));
            let of = (Incarnation::from_u64(2), Principal::Unproved);
            let received = wire::DfEntry {
                entry: "x".to_owned(),
                addresses,
                lease: None,
            };
            DfEntry::read(Instant::now(), of, agent, received).unwrap()
        };
        let long = "x".repeat(Exchange::MAX_DF_ADDRESS);
        let most = vec![long.clone(); Exchange::MAX_DF_ADDRESSES];
        assert_eq!(read(most.clone()).addresses, most);
        assert_eq!(read(most.clone()).bytes(), 1 + most.len() * long.len());
        let many = [vec![long + "x"], most.clone(), vec![String::new()]].concat();
        assert_eq!(read(many).addresses, most);
    }

    #[test]
    fn the_weight_of_a_text_is_at_least_its_length_in_a_letter() {
        for text in ["plain", "\"\\\"", "\0\n\u{1b}\u{7f}", "né 🤖"] {
            let own = OwnDfEntry {
                name: "a".into(),
                incarnation: Incarnation::from_u64(1),
                text: text.into(),
                addresses: vec![text.to_owned(); 3],
                lease: Some(Instant::now() + Duration::from_millis(u64::MAX >> 20)),
            };
            let on_wire = serde_json::to_string(&own.to_wire(Instant::now())).unwrap();
            assert!(own.weight() >= on_wire.len(), "{on_wire}");
        }
    }
}
