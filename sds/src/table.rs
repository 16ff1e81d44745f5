//! The index behind the back ends: the claims on each name, and its holder.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::hash::Hash;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};

use arc_swap::ArcSwap;
use fipa_transport::{Incarnation, PeerId};
use parking_lot::{Mutex, RwLock};

use crate::watch::Subscribers;
use crate::{Change, Entry, Snapshot, Subscriber, View};

/// Implements the part of [`Directory`](crate::Directory) that all back ends read from their
/// [`Table`]. The argument is the path of the table's field from `self`.
macro_rules! reads_its_table {
    ($($field:ident).+) => {
        fn known(&self, name: &str) -> Option<Arc<Entry>> {
            self.$($field).+.known(name)
        }

        fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
            self.$($field).+.known_incarnation(incarnation)
        }

        fn entries(&self) -> Arc<[Arc<Entry>]> {
            self.$($field).+.entries()
        }

        fn generation(&self) -> u64 {
            self.$($field).+.generation()
        }

        fn subscribe(&self, subscriber: &Subscriber) {
            self.$($field).+.subscribe(subscriber);
        }
    };
    (viewed $($field:ident).+) => {
        reads_its_table!($($field).+);

        fn view(&self) -> Arc<dyn crate::View> {
            self.$($field).+.view()
        }
    };
}

/// Entries by the origin that claims them (a process, a record). When several origins claim a name,
/// the entry that [precedes](Entry::precedes) the others holds it, and the others take over when it
/// leaves. Of equal entries the first claim holds the name. Proved origins come before all others, in
/// the order in which they claimed the name.
pub(crate) struct Table<O> {
    index: RwLock<Index<O>>,
    /// The holders of names for views, which do not wait for a large update.
    published: ArcSwap<Layers>,
    generation: AtomicU64,
    subscribers: Subscribers,
}

struct Index<O> {
    /// No list is empty; the first entry of a list holds the name.
    claims: HashMap<Arc<str>, Vec<(O, Arc<Entry>)>>,
    /// Names that more than one origin claims with the same proof.
    contested: BTreeSet<Arc<str>>,
    is_proved: fn(&O) -> bool,
    /// The entries that hold their names. Copied for a change, because a view has them.
    holders: Arc<Snapshot>,
    /// Entries that hold the names that no origin claims.
    beneath: Option<Arc<dyn View>>,
    /// The latest name claimed by each origin of a single entry.
    #[cfg(feature = "mdns")]
    origins: HashMap<O, Arc<str>>,
}

/// Returns the items of all lists: the first of each list, then the second ones, and so on.
fn in_turns<T>(lists: impl IntoIterator<Item = Vec<T>>) -> Vec<T> {
    let mut lists: VecDeque<_> = lists.into_iter().map(Vec::into_iter).collect();
    let mut all = Vec::new();
    while let Some(mut list) = lists.pop_front() {
        if let Some(item) = list.next() {
            all.push(item);
            lists.push_back(list);
        }
    }
    all
}

impl<O: Clone + Eq + Hash> Table<O> {
    pub(crate) fn new() -> Self {
        Self::proved_by(|_| false)
    }

    /// Creates a table in which `is_proved` selects the proved origins.
    pub(crate) fn proved_by(is_proved: fn(&O) -> bool) -> Self {
        Self {
            index: RwLock::new(Index {
                claims: HashMap::new(),
                contested: BTreeSet::new(),
                is_proved,
                holders: Arc::default(),
                beneath: None,
                #[cfg(feature = "mdns")]
                origins: HashMap::new(),
            }),
            published: ArcSwap::default(),
            generation: AtomicU64::new(0),
            subscribers: Subscribers::default(),
        }
    }

    pub(crate) fn known(&self, name: &str) -> Option<Arc<Entry>> {
        self.layers().named(name)
    }

    pub(crate) fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.layers().registered(incarnation)
    }

    /// Returns the present entries, after an update that has begun.
    fn layers(&self) -> Arc<Layers> {
        let _index = self.index.read();
        self.published.load_full()
    }

    /// Returns the entry that holds the name, and its origin.
    pub(crate) fn holder(&self, name: &str) -> Option<(O, Arc<Entry>)> {
        self.index.read().claims.get(name)?.first().cloned()
    }

    pub(crate) fn entries(&self) -> Arc<[Arc<Entry>]> {
        self.layers().all()
    }

    /// Replaces the [lost agents](crate::View::lost_agents). Watchers are not notified. Call it before the entry of a
    /// lost agent is removed, and after that of a returned one was inserted: no view is without both.
    pub(crate) fn set_lost(&self, lost: impl IntoIterator<Item = Arc<Entry>>) {
        let mut index = self.index.write();
        Arc::make_mut(&mut index.holders).set_lost(lost);
        self.publish(&index);
        self.touch();
    }

    /// Returns at most `most` pairs for names that several origins claim: the entry that holds the
    /// name, and each other entry. An entry without proof does not count beside a proved one, and neither do two
    /// proved entries of one peer.
    ///
    /// The claiming peers take turns, and for each of them the peers that hold the names, so that the conflicts of
    /// one peer do not hide those of others.
    pub(crate) fn contested(&self, most: usize) -> Vec<(Arc<Entry>, Arc<Entry>)> {
        let index = self.index.read();
        let mut of_peers: BTreeMap<&PeerId, BTreeMap<&PeerId, Vec<_>>> = BTreeMap::new();
        for name in &index.contested {
            let Some(((of, holder), others)) = index
                .claims
                .get(name)
                .and_then(|claims| claims.split_first())
            else {
                continue;
            };
            let is_proved = (index.is_proved)(of);
            for (origin, other) in others {
                let is_own = is_proved && other.peer == holder.peer;
                if (index.is_proved)(origin) == is_proved && !is_own {
                    let of_peer = of_peers.entry(&other.peer).or_default();
                    let pairs = of_peer.entry(&holder.peer).or_default();
                    pairs.push((holder, other));
                }
            }
        }
        let of_peers = of_peers.into_values();
        let pairs = in_turns(of_peers.map(|of_peer| in_turns(of_peer.into_values())));
        let pairs = pairs.into_iter().take(most);
        pairs
            .map(|(holder, other)| (Arc::clone(holder), Arc::clone(other)))
            .collect()
    }

    /// Tells all watchers to read again, because the mandates that a merged view applies to these
    /// entries changed.
    pub(crate) fn notify_reread(&self) {
        let _index = self.index.write();
        self.notify(Change::Lagged);
    }

    /// Returns a view of the entries that hold their names. Does not wait for an update: the delivery
    /// core is locked when it takes a view.
    pub(crate) fn view(&self) -> Arc<dyn View> {
        self.published.load_full()
    }

    /// Makes the entries visible to later views. Precedes the notifications of their changes.
    fn publish(&self, index: &Index<O>) {
        self.published.store(Arc::new(Layers {
            holders: Arc::clone(&index.holders),
            beneath: index.beneath.clone(),
            all: Mutex::default(),
        }));
    }

    /// Replaces the entries that hold the names that no origin claims, and the lost agents. Watchers are notified by
    /// [`changed_beneath`](Self::changed_beneath).
    pub(crate) fn set_beneath(
        &self,
        beneath: Arc<dyn View>,
        lost: impl IntoIterator<Item = Arc<Entry>>,
    ) {
        let mut index = self.index.write();
        index.beneath = Some(beneath);
        Arc::make_mut(&mut index.holders).set_lost(lost);
        self.publish(&index);
        self.touch();
    }

    /// Whether a watcher is to be notified of changes. A later watcher reads the entries that were set before
    /// this call.
    pub(crate) fn is_watched(&self) -> bool {
        self.subscribers.any()
    }

    /// Notifies watchers of changes beneath the names that no origin claims. `None` if there are more changes than
    /// a watch holds.
    pub(crate) fn changed_beneath(&self, changes: Option<Vec<Change>>) {
        let index = self.index.write();
        match changes {
            Some(mut changes) => {
                let is_claimed = |name: &Arc<str>| index.claims.contains_key(name);
                changes.retain(|change| !change.name().is_some_and(is_claimed));
                self.changed(&index, changes);
            }
            None => self.notify(Change::Lagged),
        }
    }

    /// Changes the generation, because data beside the entries changed.
    pub(crate) fn touch(&self) {
        self.generation.fetch_add(1, Ordering::Release);
    }

    pub(crate) fn generation(&self) -> u64 {
        self.generation.load(Ordering::Acquire)
    }

    pub(crate) fn subscribe(&self, subscriber: &Subscriber) {
        self.subscribers.subscribe(subscriber);
    }

    /// Inserts the entry; replaces the one that the same origin claims by that name.
    pub(crate) fn put(&self, origin: O, entry: Arc<Entry>) {
        self.update(std::iter::once((origin, entry.name.clone(), Some(entry))));
    }

    /// Inserts the entry unless an entry of another incarnation holds the name; that one is then
    /// returned as the error.
    pub(crate) fn claim(&self, origin: O, entry: Arc<Entry>) -> Result<(), Arc<Entry>> {
        let mut index = self.index.write();
        match index.holder(&entry.name) {
            Some(holder) if holder.incarnation != entry.incarnation => Err(Arc::clone(holder)),
            _ => {
                self.apply(&mut index, origin, entry.name.clone(), Some(entry));
                Ok(())
            }
        }
    }

    /// Removes the origin's claim on that name if it has this incarnation. Returns whether it did.
    pub(crate) fn release(&self, origin: O, name: &str, incarnation: Incarnation) -> bool {
        let mut index = self.index.write();
        let claims = index.claims.get(name);
        let claim = claims.and_then(|claims| {
            claims
                .iter()
                .find(|(of, entry)| *of == origin && entry.incarnation == incarnation)
        });
        let Some(name) = claim.map(|(_, entry)| entry.name.clone()) else {
            return false;
        };
        self.apply(&mut index, origin, name, None);
        true
    }

    /// Replaces the entries of origins that have a single entry each, as one update.
    #[cfg(feature = "mdns")]
    pub(crate) fn replace(&self, updates: impl IntoIterator<Item = (O, Option<Arc<Entry>>)>) {
        let mut index = self.index.write();
        let mut changes = Vec::new();
        for (origin, entry) in updates {
            let before = index.origins.remove(&origin);
            if let Some(name) = before
                && entry.as_ref().is_none_or(|entry| entry.name != name)
            {
                changes.extend(index.change(origin.clone(), name, None));
            }
            if let Some(entry) = entry {
                let name = entry.name.clone();
                index.origins.insert(origin.clone(), name.clone());
                changes.extend(index.change(origin, name, Some(entry)));
            }
        }
        self.changed(&index, changes);
    }

    /// Number of origins that have an entry by [`replace`](Self::replace).
    #[cfg(feature = "mdns")]
    pub(crate) fn len(&self) -> usize {
        self.index.read().origins.len()
    }

    /// Inserts and removes several entries as one update.
    pub(crate) fn update(
        &self,
        updates: impl IntoIterator<Item = (O, Arc<str>, Option<Arc<Entry>>)>,
    ) {
        let mut index = self.index.write();
        let mut changes = Vec::new();
        for (origin, name, entry) in updates {
            changes.extend(index.change(origin, name, entry));
        }
        self.changed(&index, changes);
    }

    fn apply(&self, index: &mut Index<O>, origin: O, name: Arc<str>, entry: Option<Arc<Entry>>) {
        let change = index.change(origin, name, entry);
        self.changed(index, change);
    }

    /// Publishes the entries, and notifies watchers under the lock, so that they receive changes in order. Changes
    /// of coalitions are reported as one, so that a merger has no intermediate state.
    fn changed(&self, index: &Index<O>, changes: impl IntoIterator<Item = Change>) {
        self.publish(index);
        let mut coalitions = Vec::new();
        for change in changes {
            match change.of_coalition() {
                true => coalitions.push(change),
                false => self.notify(change),
            }
        }
        if let Some(change) = Change::together(coalitions) {
            self.notify(change);
        }
    }

    fn notify(&self, change: Change) {
        self.touch();
        self.subscribers.tell(&change);
    }
}

impl<O: Eq> Index<O> {
    fn holder(&self, name: &str) -> Option<&Arc<Entry>> {
        let claims = self.claims.get(name)?;
        claims.first().map(|(_, entry)| entry)
    }

    /// Inserts or removes the origin's claim on that name.
    fn change(&mut self, origin: O, name: Arc<str>, entry: Option<Arc<Entry>>) -> Option<Change> {
        let before = self.holder(&name).cloned();
        self.set(origin, &name, entry);
        let after = self.holder(&name).cloned();
        let visible = match (&before, &after) {
            (Some(_), Some(_)) => None,
            _ => self.beneath.as_ref().and_then(|it| it.named(&name)),
        };
        let or_visible = |entry: &Option<Arc<Entry>>| entry.clone().or_else(|| visible.clone());
        let change = Change::between(or_visible(&before), or_visible(&after));
        if before != after {
            let is_proved = self.claims.get(&name).and_then(|claims| claims.first());
            let is_proved = is_proved.is_some_and(|(origin, _)| (self.is_proved)(origin));
            let after = after.map(|after| (after, is_proved));
            Arc::make_mut(&mut self.holders).set(before.as_ref(), after);
        }
        change
    }

    fn set(&mut self, origin: O, name: &Arc<str>, entry: Option<Arc<Entry>>) {
        let is_proved = self.is_proved;
        let mut claims = self.claims.remove(name).unwrap_or_default();
        let before = claims.iter().position(|(of, _)| *of == origin);
        let before = before.map(|index| (index, claims.remove(index).1));
        let proved = |claims: &[(O, Arc<Entry>)]| {
            let mut origins = claims.iter().map(|(of, _)| of);
            origins
                .position(|of| !is_proved(of))
                .unwrap_or(claims.len())
        };
        let first_unproved = proved(&claims);
        if let Some(entry) = entry {
            let index = match is_proved(&origin) {
                true => before.map_or(first_unproved, |(index, _)| index),
                false => {
                    let mut unproved = claims.iter().skip(first_unproved);
                    let index = unproved.position(|(_, other)| {
                        entry.precedes(other) || is_same_registration(&entry, other)
                    });
                    let index = index.map(|index| first_unproved + index);
                    // An update keeps its place.
                    let place = before.filter(|(_, before)| before.rank() == entry.rank());
                    let place = place.map(|(index, _)| index);
                    let index = index.into_iter().chain(place).min();
                    index.unwrap_or(claims.len())
                }
            };
            claims.insert(index, (origin, entry));
        }
        let first_unproved = proved(&claims);
        if first_unproved > 1 || (first_unproved == 0 && claims.len() > 1) {
            self.contested.insert(name.clone());
        } else if !self.contested.is_empty() {
            self.contested.remove(name);
        }
        if !claims.is_empty() {
            self.claims.insert(name.clone(), claims);
        }
    }
}

/// The entries that hold names, and those that hold the other names.
#[derive(Default)]
struct Layers {
    holders: Arc<Snapshot>,
    beneath: Option<Arc<dyn View>>,
    /// The list of all entries while a caller has it. It may be large, so nothing else keeps it.
    all: Mutex<Option<Weak<[Arc<Entry>]>>>,
}

impl View for Layers {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        let holder = self.holders.named(name);
        holder.or_else(|| self.beneath.as_ref()?.named(name))
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let holder = self.holders.registered(incarnation);
        holder.or_else(|| {
            let entry = self.beneath.as_ref()?.registered(incarnation)?;
            self.holders.named(&entry.name).is_none().then_some(entry)
        })
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        let holders = self.holders.all();
        let Some(beneath) = &self.beneath else {
            return holders;
        };
        let mut cached = self.all.lock();
        if let Some(all) = cached.as_ref().and_then(Weak::upgrade) {
            return all;
        }
        let beneath = beneath.all();
        let others = beneath
            .iter()
            .filter(|entry| self.holders.named(&entry.name).is_none());
        let mut all: Vec<Arc<Entry>> = holders.iter().chain(others).cloned().collect();
        // Both parts are sorted, of which this takes advantage.
        all.sort_by(|a, b| a.name.cmp(&b.name));
        let all = all.into();
        *cached = Some(Arc::downgrade(&all));
        all
    }

    fn lost_agents(&self) -> Vec<Arc<Entry>> {
        self.holders.lost_agents()
    }

    fn lost_agent(&self, name: &str) -> Option<Arc<Entry>> {
        self.holders.lost_agent(name)
    }
}

impl<O> std::fmt::Debug for Table<O> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let index = self.index.read();
        f.debug_struct("Table")
            .field("names", &index.claims.len())
            .finish_non_exhaustive()
    }
}

/// Whether one gateway announces one registration by both entries, for example because it changed
/// the label of its record. The later entry has the current locations.
fn is_same_registration(a: &Entry, b: &Entry) -> bool {
    let of = |entry: &Entry| (entry.incarnation, entry.mts.incarnation);
    of(a) == of(b) && a.incarnation.is_known() && a.mts.incarnation.is_known()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{MtsId, Registration, Source};

    fn entry(incarnation: u64, gateway: u64, address: &str) -> Arc<Entry> {
        let at = format!("tcp://{address}:7788#00000000000000aa");
        let incarnation = Incarnation::from_u64(incarnation);
        let mut arm = Registration::new("arm", incarnation, vec![at.parse().unwrap()]);
        arm.registered = std::time::UNIX_EPOCH;
        let gateway = MtsId::new("theirs", Incarnation::from_u64(gateway));
        Arc::new(arm.into_entry(&gateway, Source::Mdns).unwrap())
    }

    #[test]
    fn a_view_does_not_wait_for_an_update_and_is_as_new_as_its_generation() {
        let table = Table::new();
        let (first, second) = (entry(1, 7, "10.99.0.51"), entry(2, 8, "10.99.0.52"));
        table.put("first", Arc::clone(&first));
        let generation = table.generation();
        let updates = std::iter::once(()).map(|()| {
            // The update has begun.
            let seen = table.view().named("arm");
            assert_eq!(seen.as_ref(), Some(&first));
            assert_eq!(table.generation(), generation);
            ("first", second.name.clone(), Some(Arc::clone(&second)))
        });
        table.update(updates);
        assert_ne!(table.generation(), generation);
        assert_eq!(table.view().named("arm"), Some(second));
    }

    #[test]
    fn the_first_claim_of_other_hosts_holds_the_name_whatever_their_times_are() {
        let table = Table::new();
        let of = |incarnation: u64, millis: u64| {
            let mut entry = entry(incarnation, incarnation, "10.99.0.51");
            let own = Arc::make_mut(&mut entry);
            own.registered += std::time::Duration::from_millis(millis);
            own.reach = crate::Reach::Remote {
                gateway: own.mts.incarnation,
            };
            entry
        };
        let holder = || table.known("arm").map(|it| it.incarnation.as_u64());
        table.put("first", of(9, 5000));
        table.put("second", of(8, 1));
        assert_eq!(holder(), Some(9));
        // Updates keep their places, also one with another registration.
        table.put("first", of(9, 6000));
        table.put("first", of(10, 7000));
        table.put("second", of(8, 0));
        assert_eq!(holder(), Some(10));
        let contested = table.contested(8);
        assert_eq!(contested.len(), 1);
        assert_eq!(contested[0].1.incarnation.as_u64(), 8);
        table.update([("first", "arm".into(), None)]);
        assert_eq!((holder(), table.contested(8).len()), (Some(8), 0));
        // An entry of this host takes the name at once.
        table.put("here", entry(11, 11, "10.99.0.51"));
        assert_eq!(holder(), Some(11));
    }

    #[test]
    fn the_latest_record_of_a_registration_has_its_locations() {
        let table = Table::new();
        let (first, second) = (entry(1, 7, "10.99.0.51"), entry(1, 7, "10.99.0.52"));
        table.put("label", Arc::clone(&first));
        // The gateway announces the agent by another label before the goodbye of the first.
        table.put("other label", Arc::clone(&second));
        assert_eq!(table.known("arm").unwrap().locations, second.locations);
        // An entry of another gateway for the registration does not take it over.
        table.put("of another", entry(1, 8, "10.99.0.99"));
        assert_eq!(table.known("arm").unwrap().locations, second.locations);
        table.update([("other label", "arm".into(), None)]);
        assert_eq!(table.known("arm").unwrap().locations, first.locations);
    }
}
