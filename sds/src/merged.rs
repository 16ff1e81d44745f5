//! One view of several directories.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};

use arc_swap::ArcSwapOption;
use fipa_transport::{Incarnation, Mandate};

use crate::view::KeptEntries;
use crate::{
    Change, DeregisterError, Directory, Entry, Reach, RegisterError, Registration, Role, Source,
    Subscriber, View, Watch,
};

/// Several directories merged into one view.
///
/// When several directories know a name, the view shows the entry that [precedes](Entry::precedes)
/// the others. Of equal entries it shows that of a directory that [speaks](Directory::speaks_for) for
/// the message transport service of its entry, else that of the first directory in the list: an agent
/// of a connected gateway precedes one that is only announced. Of one registration at one service that
/// was learned twice, it shows the entry of the first directory in the list. Registrations go to the
/// first writable directory.
///
/// A directory whose link proves a service has a [mandate](Directory::mandate) for it. A proved
/// entry precedes all unproved entries of other hosts except those of the configuration. Entries of
/// a service that its mandate does not cover are hidden in all directories.
pub struct MergedDirectory {
    back_ends: BackEnds,
    sorted: ArcSwapOption<Sorted>,
}

type BackEnds = Arc<[Arc<dyn Directory>]>;

struct Sorted {
    generations: Vec<u64>,
    entries: Arc<[Arc<Entry>]>,
}

impl MergedDirectory {
    /// Creates the view of these directories, closest first.
    #[must_use]
    pub fn new(back_ends: Vec<Arc<dyn Directory>>) -> Self {
        Self {
            back_ends: back_ends.into(),
            sorted: ArcSwapOption::empty(),
        }
    }

    fn generations(&self) -> impl Iterator<Item = u64> {
        self.back_ends.iter().map(|one| one.generation())
    }
}

impl std::fmt::Debug for MergedDirectory {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("MergedDirectory")
            .field("back_ends", &self.back_ends.len())
            .finish_non_exhaustive()
    }
}

impl Directory for MergedDirectory {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        holder(&self.back_ends, name)
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        registered(&self.back_ends, incarnation)
    }

    fn view(&self) -> Arc<dyn View> {
        Arc::new(Merged {
            views: self.back_ends.iter().map(|one| one.view()).collect(),
            sorted: OnceLock::new(),
            by_name: KeptEntries::default(),
            by_incarnation: KeptEntries::default(),
        })
    }

    fn refresh(&self) {
        for one in self.back_ends.iter() {
            one.refresh();
        }
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        if let Some(sorted) = &*self.sorted.load()
            && self.generations().eq(sorted.generations.iter().copied())
        {
            return Arc::clone(&sorted.entries);
        }
        // Taken before reading: a change during the read causes another read next time.
        let generations = self.generations().collect();
        let entries = merged_entries(&self.back_ends);
        self.sorted.store(Some(Arc::new(Sorted {
            generations,
            entries: Arc::clone(&entries),
        })));
        entries
    }

    fn generation(&self) -> u64 {
        // Each generation only grows, so the sum changes whenever one of them does.
        self.generations().fold(0, u64::wrapping_add)
    }

    /// The subscriber receives the unmerged changes of each directory; [`watch`](Self::watch)
    /// reports the changes of the merged view.
    fn subscribe(&self, subscriber: &Subscriber) {
        for one in self.back_ends.iter() {
            one.subscribe(subscriber);
        }
    }

    fn watch(&self) -> Watch {
        let (subscriber, watch) = Watch::new();
        self.subscribe(&subscriber);
        watch.merging(MergedView::new(&self.back_ends))
    }

    fn speaks_for(&self, mts: Incarnation) -> bool {
        self.back_ends.iter().any(|one| one.speaks_for(mts))
    }

    fn mandate(&self, mts: Incarnation) -> Mandate {
        mandate(&self.back_ends, mts)
    }

    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        if let Some(holder) = self.lookup(&registration.name)
            && holder.incarnation != registration.incarnation
            && holder.source != Source::Contact
        {
            return Err(RegisterError::AlreadyRegistered { holder });
        }
        for one in self.back_ends.iter() {
            match one.register(registration.clone()) {
                Err(RegisterError::ReadOnly) => {}
                done => return done,
            }
        }
        Err(RegisterError::ReadOnly)
    }

    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        for one in self.back_ends.iter() {
            match one.deregister(name, incarnation) {
                Err(DeregisterError::ReadOnly) => {}
                done => return done,
            }
        }
        Err(DeregisterError::ReadOnly)
    }
}

/// Number of entries that a merged view keeps. Most letters have the sender and the receiver of one of the
/// letters before, and a lookup asks all views, which may be merged themselves.
const KEPT: usize = 8;

/// Several views that do not change, merged into one.
struct Merged {
    views: Vec<Arc<dyn View>>,
    sorted: OnceLock<Arc<[Arc<Entry>]>>,
    by_name: KeptEntries<KEPT>,
    by_incarnation: KeptEntries<KEPT>,
}

impl View for Merged {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        let hash = name.bytes().rev().take(2).map(usize::from).sum::<usize>() + name.len();
        let is_it = |entry: &Entry| *entry.name == *name;
        self.by_name
            .get_or(hash, is_it, || holder(&self.views, name))
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let hash = incarnation.as_u64() as usize;
        let is_it = |entry: &Entry| entry.incarnation == incarnation;
        self.by_incarnation
            .get_or(hash, is_it, || registered(&self.views, incarnation))
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        Arc::clone(self.sorted.get_or_init(|| merged_entries(&self.views)))
    }

    fn lost_agents(&self) -> Vec<Arc<Entry>> {
        let views = self.views.iter();
        views.flat_map(|one| one.lost_agents()).collect()
    }

    fn lost_agent(&self, name: &str) -> Option<Arc<Entry>> {
        self.views.iter().find_map(|one| one.lost_agent(name))
    }

    fn is_authority(&self, mts: Incarnation) -> bool {
        self.views.iter().any(|one| one.is_authority(mts))
    }

    fn mandate_of(&self, mts: Incarnation) -> Mandate {
        mandate(&self.views, mts)
    }
}

fn registered<V: View + ?Sized>(
    back_ends: &[Arc<V>],
    incarnation: Incarnation,
) -> Option<Arc<Entry>> {
    let mut best: Option<NameClaim> = None;
    for one in back_ends {
        let Some(entry) = one.registered(incarnation) else {
            continue;
        };
        let is_named = |best: &NameClaim| best.entry.name == entry.name;
        if best.as_ref().is_some_and(is_named) {
            continue;
        }
        // An agent that lost its name in the merged view is not part of the view.
        let claim = held(back_ends, &entry.name);
        let Some(claim) = claim.filter(|claim| claim.entry.incarnation == incarnation) else {
            continue;
        };
        if claim.entry.reach == Reach::Local {
            return Some(claim.entry);
        }
        // A registration that several names claim belongs to a proved one, or to that of the first
        // directory.
        if best
            .as_ref()
            .is_none_or(|best| claim.outranks(best, back_ends))
        {
            best = Some(claim);
        }
    }
    best.map(|claim| claim.entry)
}

fn merged_entries<V: View + ?Sized>(back_ends: &[Arc<V>]) -> Arc<[Arc<Entry>]> {
    let mut merged: HashMap<Arc<str>, NameClaim> = HashMap::new();
    for (at, one) in back_ends.iter().enumerate() {
        for entry in one.all().iter() {
            if !counts(back_ends, at, entry) {
                continue;
            }
            let claim = NameClaim {
                at,
                entry: Arc::clone(entry),
            };
            let holder = merged.get(&entry.name);
            if holder.is_none_or(|holder| claim.is_better(holder, back_ends)) {
                merged.insert(entry.name.clone(), claim);
            }
        }
    }
    let mut entries: Vec<_> = merged.into_values().map(|claim| claim.entry).collect();
    entries.sort_unstable_by(|a, b| a.name.cmp(&b.name));
    entries.into()
}

fn holder<V: View + ?Sized>(back_ends: &[Arc<V>], name: &str) -> Option<Arc<Entry>> {
    held(back_ends, name).map(|claim| claim.entry)
}

fn held<V: View + ?Sized>(back_ends: &[Arc<V>], name: &str) -> Option<NameClaim> {
    let claims = back_ends.iter().enumerate().filter_map(|(at, one)| {
        let entry = one.named(name)?;
        counts(back_ends, at, &entry).then_some(NameClaim { at, entry })
    });
    let better = |best: NameClaim, next: NameClaim| match next.is_better(&best, back_ends) {
        true => next,
        false => best,
    };
    claims.reduce(better)
}

/// The entry of one directory for a name.
struct NameClaim {
    /// Index of the directory.
    at: usize,
    entry: Arc<Entry>,
}

impl NameClaim {
    /// Whether this claim replaces the claim of an earlier directory.
    fn is_better<V: View + ?Sized>(&self, before: &Self, back_ends: &[Arc<V>]) -> bool {
        let (new, old) = (&self.entry, &before.entry);
        let is_moved = new.incarnation == old.incarnation
            && new.incarnation.is_known()
            && new.mts.incarnation != old.mts.incarnation;
        let speaks = |claim: &Self| {
            let back_end = back_ends.get(claim.at);
            back_end.is_some_and(|it| it.is_authority(claim.entry.mts.incarnation))
        };
        match is_moved {
            true => speaks(self) && !speaks(before),
            false if self.outranks(before, back_ends) => true,
            false if before.outranks(self, back_ends) => false,
            false if new.precedes(old) => true,
            false if old.precedes(new) => false,
            // One registration, learned twice.
            false if new.incarnation == old.incarnation && new.incarnation.is_known() => false,
            false => speaks(self) && !speaks(before),
        }
    }

    /// Whether this claim precedes `other` although both are of other hosts: this one is from the
    /// configuration, or else proved.
    fn outranks<V: View + ?Sized>(&self, other: &Self, back_ends: &[Arc<V>]) -> bool {
        if self.entry.reach == Reach::Local || other.entry.reach == Reach::Local {
            return false;
        }
        let is_static = |claim: &Self| claim.entry.source == Source::Static;
        let is_proved = |claim: &Self| claim.is_proved(back_ends);
        match is_proved(self) {
            true => !is_proved(other) && !is_static(other),
            false => is_static(self) && !is_static(other),
        }
    }

    fn is_proved<V: View + ?Sized>(&self, back_ends: &[Arc<V>]) -> bool {
        let back_end = back_ends.get(self.at);
        back_end.is_some_and(|it| it.mandate_of(self.entry.mts.incarnation).is_proved())
    }
}

/// Returns the mandate of the service from the first directory that has one.
fn mandate<V: View + ?Sized>(back_ends: &[Arc<V>], mts: Incarnation) -> Mandate {
    let mut mandates = back_ends.iter().map(|one| one.mandate_of(mts));
    mandates.find(Mandate::is_proved).unwrap_or_default()
}

/// Whether an entry of a back end is visible. If the service has a mandate, the mandate must cover
/// the agent. A coalition is visible only from the back end that [speaks](Directory::speaks_for)
/// for its message transport service, if there is one.
fn counts<V: View + ?Sized>(back_ends: &[Arc<V>], at: usize, entry: &Entry) -> bool {
    let is_agent = entry.reach != Reach::Local && entry.role != Role::Gateway;
    if is_agent && !mandate(back_ends, entry.mts.incarnation).speaks_for(&entry.name) {
        return false;
    }
    if !matches!(entry.role, Role::Coalition(_)) {
        return true;
    }
    let mts = entry.mts.incarnation;
    let speaker = back_ends.iter().position(|one| one.is_authority(mts));
    speaker.is_none_or(|speaker| speaker == at)
}

/// The entries of a merged view that a watcher has been told of.
pub(crate) struct MergedView {
    back_ends: BackEnds,
    reported: HashMap<Arc<str>, Arc<Entry>>,
}

impl MergedView {
    fn new(back_ends: &BackEnds) -> Self {
        let mut view = Self {
            back_ends: Arc::clone(back_ends),
            reported: HashMap::new(),
        };
        view.reread();
        view
    }

    /// Converts a change in one of the directories to the change of the merged view, if there is
    /// one.
    pub(crate) fn translate(&mut self, raw: Change) -> Option<Change> {
        match &raw {
            Change::Together(raws) => {
                let names = raws.iter().filter_map(Change::name);
                let changes = names.filter_map(|name| self.now(name)).collect();
                Change::together(changes)
            }
            one => match one.name() {
                Some(name) => self.now(name),
                None => {
                    self.reread();
                    Some(Change::Lagged)
                }
            },
        }
    }

    /// Returns the change of that name since it was last reported.
    fn now(&mut self, name: &Arc<str>) -> Option<Change> {
        let after = holder(&self.back_ends, name);
        let before = match &after {
            Some(entry) => self.reported.insert(name.clone(), Arc::clone(entry)),
            None => self.reported.remove(name),
        };
        Change::between(before, after)
    }

    fn reread(&mut self) {
        self.reported.clear();
        for one in self.back_ends.iter() {
            for entry in one.entries().iter() {
                if let Some(entry) = holder(&self.back_ends, &entry.name) {
                    self.reported.insert(entry.name.clone(), entry);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Members, MemoryDirectory, MtsId, Query};

    /// A back end that speaks for every service.
    struct Speaker(MemoryDirectory);

    impl Directory for Speaker {
        fn known(&self, name: &str) -> Option<Arc<Entry>> {
            self.0.known(name)
        }

        fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
            self.0.known_incarnation(incarnation)
        }

        fn entries(&self) -> Arc<[Arc<Entry>]> {
            self.0.entries()
        }

        fn generation(&self) -> u64 {
            self.0.generation()
        }

        fn subscribe(&self, subscriber: &Subscriber) {
            self.0.subscribe(subscriber);
        }

        fn speaks_for(&self, _: Incarnation) -> bool {
            true
        }
    }

    fn team(members: &[&str]) -> Registration {
        let members = Members::new(members.iter().copied(), None).unwrap();
        Registration {
            role: Role::Coalition(members),
            registered: std::time::UNIX_EPOCH,
            ..Registration::new("team", Incarnation::from_u64(7), Vec::new())
        }
    }

    #[test]
    fn a_view_answers_repeated_lookups_as_its_directory_does() {
        let of = Incarnation::from_u64;
        let mts = MtsId::new("mts", of(1));
        let [first, second] = [(); 2].map(|()| Arc::new(MemoryDirectory::new(mts.clone())));
        let inner = MergedDirectory::new(vec![first.clone()]);
        let merged = MergedDirectory::new(vec![Arc::new(inner), second.clone()]);
        // More than are kept; some names and some registrations are in both directories.
        for number in 0..40 {
            let register = |directory: &MemoryDirectory, incarnation| {
                let name = format!("arm_{}", number % 30);
                let registration = Registration::new(&*name, of(incarnation), Vec::new());
                let _ = directory.register(registration);
            };
            register(&first, 100 + number);
            register(&second, 110 + number);
        }
        let view = merged.view();
        let mut seed = fastrand::Rng::with_seed(1);
        for _ in 0..2000 {
            let name = format!("arm_{}", seed.u8(0..35));
            assert_eq!(view.named(&name), merged.known(&name), "{name}");
            let incarnation = of(seed.u64(95..155));
            let registered = merged.known_incarnation(incarnation);
            assert_eq!(view.registered(incarnation), registered, "{incarnation}");
        }
        // The view does not change, and a later one does not show what the earlier one kept.
        let before = view.named("arm_3").unwrap();
        first.deregister("arm_3", before.incarnation).unwrap();
        assert_eq!(view.named("arm_3"), Some(Arc::clone(&before)));
        assert_eq!(
            view.registered(before.incarnation),
            Some(Arc::clone(&before))
        );
        let later = merged.view();
        assert_eq!(later.named("arm_3"), merged.known("arm_3"));
        assert_ne!(later.named("arm_3"), Some(before));
    }

    #[test]
    fn coalitions_come_from_the_back_end_that_speaks_for_their_service() {
        let mts = MtsId::new("mts", Incarnation::from_u64(1));
        let first = Arc::new(MemoryDirectory::new(mts.clone()));
        let speaker = Arc::new(Speaker(MemoryDirectory::new(mts)));
        let merged = MergedDirectory::new(vec![first.clone(), speaker.clone()]);
        let mut watch = merged.watch();
        // The other back end is first ahead, then behind.
        let before = speaker.0.register(team(&["a"])).unwrap();
        assert_eq!(watch.try_next(), Some(Change::Joined(Arc::clone(&before))));
        first.register(team(&["a", "b"])).unwrap();
        assert_eq!(watch.try_next(), None);
        assert_eq!(merged.known("team"), Some(Arc::clone(&before)));
        assert_eq!(merged.search(&Query::all()), [Arc::clone(&before)]);
        let after = speaker.0.register(team(&["a", "b", "c"])).unwrap();
        let changed = Change::Changed {
            before,
            after: Arc::clone(&after),
        };
        assert_eq!(watch.try_next(), Some(changed));
        let id = after.incarnation;
        speaker.0.deregister("team", id).unwrap();
        assert_eq!(watch.try_next(), Some(Change::Left(after)));
        assert_eq!(merged.known("team"), None);
        first.deregister("team", id).unwrap();
        assert_eq!(watch.try_next(), None);
        // After a restart of an agent's service, the entry of the new service is visible.
        let restarted = Arc::new(Speaker(MemoryDirectory::new(MtsId::new(
            "mts",
            Incarnation::from_u64(2),
        ))));
        let merged = MergedDirectory::new(vec![first.clone(), restarted.clone()]);
        let leg = Registration {
            registered: std::time::UNIX_EPOCH,
            ..Registration::new("leg", Incarnation::from_u64(9), Vec::new())
        };
        first.register(leg.clone()).unwrap();
        let moved = restarted.0.register(leg).unwrap();
        assert_eq!(merged.known("leg"), Some(Arc::clone(&moved)));
        assert!(merged.entries().contains(&moved));
        // An agent is visible as long as any back end has it.
        let agent = Registration::new("arm", Incarnation::from_u64(8), Vec::new());
        first.register(agent).unwrap();
        assert!(merged.known("arm").is_some());
    }
}
