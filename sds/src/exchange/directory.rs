//! The back end with the entries that neighbors sent.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use arc_swap::ArcSwap;
use fipa_transport::{Incarnation, Location, Mandate, Principal};
use parking_lot::Mutex;
use tokio::sync::Notify;

use super::df::{DfEntries, DfEntry, ReceivedDf};
use super::{Agents, Exchange, ExchangeError};
use crate::table::Table;
use crate::{Directory, Entry, Role, Subscriber, View};

/// The agents that neighbors sent.
///
/// If two neighbors claim one name, the first claim received holds it until its entry leaves: a neighbor
/// cannot claim an earlier registration. Claims of neighbors with a [certified](Mandate::Certified) link
/// precede the others.
#[derive(Debug)]
pub struct ExchangeDirectory {
    table: Table<Origin>,
    /// Mandates of the neighbors with certified links.
    mandates: ArcSwap<HashMap<Incarnation, Mandate>>,
    /// Agents of each gateway. The lock is held while the table is updated.
    agents_of: Mutex<HashMap<Incarnation, Agents>>,
    /// The gateways among `agents_of`, for views, which do not wait for an update. A gateway is one of them
    /// only while the table has its entries.
    gateways: ArcSwap<HashSet<Incarnation>>,
    /// DF entries of these agents. Locked after `agents_of`.
    df: Mutex<ReceivedDf>,
    df_changed: Notify,
}

impl Default for ExchangeDirectory {
    fn default() -> Self {
        Self {
            table: Table::proved_by(|origin| origin.is_proved),
            mandates: ArcSwap::default(),
            agents_of: Mutex::default(),
            gateways: ArcSwap::default(),
            df: Mutex::default(),
            df_changed: Notify::new(),
        }
    }
}

/// The gateway that sent an agent's entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Origin {
    gateway: Incarnation,
    /// Whether its link is certified.
    is_proved: bool,
}

type Update = (Origin, Arc<str>, Option<Arc<Entry>>);

impl ExchangeDirectory {
    /// Maximum number of pairs that [`contested`](Self::contested) returns.
    pub const MAX_CONTESTED: usize = 1024;

    /// Returns the names that several neighbors claim, with certified links or else without: the entry
    /// that holds the name, and each other entry. At most [`MAX_CONTESTED`](Self::MAX_CONTESTED) pairs.
    #[must_use]
    pub fn contested(&self) -> Vec<(Arc<Entry>, Arc<Entry>)> {
        self.table.contested(Self::MAX_CONTESTED)
    }

    /// Returns the entries of agents in the directory facilitators of the neighbors, in no particular
    /// order. At most [`Exchange::MAX_TOTAL_DF_ENTRIES`].
    ///
    /// Another agent may hold the name of an entry: it counts only while the directory shows the
    /// registration of the entry under this name.
    #[must_use]
    pub fn df_entries(&self) -> Vec<Arc<DfEntry>> {
        self.df.lock().all()
    }

    /// Waits for a change of [`df_entries`](Self::df_entries). Only one task may wait.
    pub async fn df_changed(&self) {
        self.df_changed.notified().await;
    }

    /// Changes the DF entries, and notifies the waiting task.
    fn update_df(&self, update: impl FnOnce(&mut ReceivedDf) -> bool) {
        if update(&mut self.df.lock()) {
            self.df_changed.notify_one();
        }
    }

    /// Whether any link with a neighbor is certified.
    #[must_use]
    pub fn is_proved(&self) -> bool {
        !self.mandates.load().is_empty()
    }

    /// Sets the mandate that the link with the gateway proves. If it changed, the gateway's entries
    /// are dropped.
    pub(super) fn prove(&self, gateway: Incarnation, mandate: &Mandate) {
        if self.mandate(gateway) == *mandate {
            return;
        }
        self.forget(gateway);
        self.mandates.rcu(|mandates| {
            let mut mandates = HashMap::clone(mandates);
            match mandate.is_proved() {
                true => mandates.insert(gateway, mandate.clone()),
                false => mandates.remove(&gateway),
            };
            mandates
        });
        // The mandate decides which entries of this gateway in other directories are visible.
        self.table.notify_reread();
    }

    fn origin(&self, gateway: Incarnation) -> Origin {
        Origin {
            gateway,
            is_proved: self.mandates.load().contains_key(&gateway),
        }
    }

    /// Replaces all agents of the gateway, and their DF entries.
    pub(super) fn replace(
        &self,
        (gateway, principal): (Incarnation, Principal),
        entries: Agents,
        df: DfEntries,
    ) -> Result<(), ExchangeError> {
        let origin = self.origin(gateway);
        let mut agents_of = self.agents_of.lock();
        let others = agents_of.iter().filter(|(other, _)| **other != gateway);
        let total: usize = others.map(|(_, entries)| entries.len()).sum();
        if total + entries.len() > Exchange::MAX_TOTAL {
            return Err(ExchangeError::TooMany);
        }
        let before = agents_of.insert(gateway, entries).unwrap_or_default();
        let now = agents_of.get(&gateway);
        let left = before
            .into_keys()
            .filter(|name| now.is_none_or(|now| !now.contains_key(name)))
            .map(|name| (origin, name, None));
        let here = now.into_iter().flatten();
        let here = here.map(|(name, entry)| (origin, Arc::clone(name), Some(Arc::clone(entry))));
        let updates: Vec<Update> = left.chain(here).collect();
        self.table.update(updates);
        self.show(gateway);
        self.update_df(|all| all.replace(gateway, principal, df));
        Ok(())
    }

    /// Adds or updates some agents of the gateway with their DF entries, and removes others.
    pub(super) fn change(
        &self,
        (gateway, principal): (Incarnation, Principal),
        joined: Vec<(Arc<Entry>, Option<Arc<DfEntry>>)>,
        left: Vec<String>,
    ) -> Result<(), ExchangeError> {
        let origin = self.origin(gateway);
        let mut agents_of = self.agents_of.lock();
        let total: usize = agents_of.values().map(Agents::len).sum();
        let of_gateway = agents_of.entry(gateway).or_default();
        // A small letter does not cost a copy of all agents.
        let left: BTreeSet<Arc<str>> = left
            .iter()
            .filter_map(|name| Some(Arc::clone(of_gateway.get_key_value(name.as_str())?.0)))
            .collect();
        let is_new = |name: &Arc<str>| left.contains(name) || !of_gateway.contains_key(name);
        let names = joined.iter().map(|(entry, _)| &entry.name);
        let new: BTreeSet<&Arc<str>> = names.filter(|name| is_new(name)).collect();
        let stay = of_gateway.len() - left.len();
        let after = stay + new.len();
        let total = total - of_gateway.len() + after;
        if after > Exchange::MAX_AGENTS || total > Exchange::MAX_TOTAL {
            return Err(ExchangeError::TooMany);
        }
        let mut updates: Vec<Update> = Vec::new();
        let mut df = Vec::new();
        for name in left {
            of_gateway.remove(&name);
            df.push((Arc::clone(&name), None));
            updates.push((origin, name, None));
        }
        for (entry, of_entry) in joined {
            df.push((Arc::clone(&entry.name), of_entry));
            of_gateway.insert(Arc::clone(&entry.name), Arc::clone(&entry));
            updates.push((origin, Arc::clone(&entry.name), Some(entry)));
        }
        self.table.update(updates);
        self.show(gateway);
        self.update_df(|all| all.change(gateway, principal, df));
        Ok(())
    }

    /// Adds a gateway whose entries the table has.
    fn show(&self, gateway: Incarnation) {
        if self.gateways.load().contains(&gateway) {
            return;
        }
        self.gateways.rcu(|gateways| {
            let mut gateways = HashSet::clone(gateways);
            gateways.insert(gateway);
            gateways
        });
        self.table.touch();
    }

    /// Sets new locations of the gateway and all its agents.
    pub(super) fn relocate(&self, gateway: Incarnation, locations: &[Location]) {
        let origin = self.origin(gateway);
        let mut agents_of = self.agents_of.lock();
        let mut updates: Vec<Update> = Vec::new();
        for (name, entry) in agents_of.get_mut(&gateway).into_iter().flatten() {
            *entry = Arc::new(Entry {
                locations: locations.to_vec(),
                ..Entry::clone(entry)
            });
            updates.push((origin, Arc::clone(name), Some(Arc::clone(entry))));
        }
        self.table.update(updates);
    }

    /// Drops agents of the gateway that another directory knows, unless they are proved. Returns
    /// whether there were any. Coalitions stay, because this directory [speaks
    /// for](Directory::speaks_for) them.
    pub(super) fn leave_to_others(
        &self,
        gateway: Incarnation,
        knows: impl Fn(&Entry) -> bool,
    ) -> bool {
        let origin = self.origin(gateway);
        let mut agents_of = self.agents_of.lock();
        let Some(agents) = agents_of.get_mut(&gateway).filter(|_| !origin.is_proved) else {
            return false;
        };
        let agent = |entry: &&Arc<Entry>| entry.role == Role::Agent && knows(entry);
        let known = agents.values().filter(agent);
        let known: Vec<Arc<str>> = known.map(|entry| Arc::clone(&entry.name)).collect();
        for name in &known {
            agents.remove(name);
        }
        let any = !known.is_empty();
        if any {
            // The connection that proved them has ended.
            self.update_df(|all| all.forget(gateway));
        }
        let updates: Vec<Update> = known.into_iter().map(|name| (origin, name, None)).collect();
        self.table.update(updates);
        any
    }

    /// Replaces the [lost agents](Directory::lost_agents).
    pub(super) fn set_lost(&self, lost: impl IntoIterator<Item = Arc<Entry>>) {
        self.table.set_lost(lost);
    }

    /// Returns at most `most` agents of the gateway.
    pub(super) fn agents_of(&self, gateway: Incarnation, most: usize) -> Vec<Arc<Entry>> {
        let agents_of = self.agents_of.lock();
        let entries = agents_of.get(&gateway).into_iter().flat_map(Agents::values);
        let agents = entries.filter(|entry| entry.role == Role::Agent);
        agents.take(most).cloned().collect()
    }

    /// Removes the gateway's agents.
    pub(super) fn forget(&self, gateway: Incarnation) {
        let origin = self.origin(gateway);
        let mut agents_of = self.agents_of.lock();
        let removed = agents_of.remove(&gateway);
        self.update_df(|all| all.forget(gateway));
        if self.gateways.load().contains(&gateway) {
            self.gateways.rcu(|gateways| {
                let mut gateways = HashSet::clone(gateways);
                gateways.remove(&gateway);
                gateways
            });
            self.table.touch();
        }
        let names = removed.unwrap_or_default().into_keys();
        self.table.update(names.map(|name| (origin, name, None)));
    }
}

/// The agents that neighbors had sent at one time.
struct ExchangeView {
    entries: Arc<dyn View>,
    gateways: Arc<HashSet<Incarnation>>,
    mandates: Arc<HashMap<Incarnation, Mandate>>,
}

impl View for ExchangeView {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        self.entries.named(name)
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.entries.registered(incarnation)
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        self.entries.all()
    }

    fn lost(&self, name: &str) -> Option<Arc<Entry>> {
        self.entries.lost(name)
    }

    fn is_authority(&self, mts: Incarnation) -> bool {
        self.gateways.contains(&mts)
    }

    fn mandate_of(&self, mts: Incarnation) -> Mandate {
        self.mandates.get(&mts).cloned().unwrap_or_default()
    }
}

impl Directory for ExchangeDirectory {
    reads_its_table!(table);

    fn view(&self) -> Arc<dyn View> {
        // The gateways first: each of them has its entries in the table.
        let gateways = self.gateways.load_full();
        Arc::new(ExchangeView {
            entries: self.table.view(),
            gateways,
            mandates: self.mandates.load_full(),
        })
    }

    /// The letters of a gateway apply atomically and contain all its coalitions.
    fn speaks_for(&self, mts: Incarnation) -> bool {
        self.agents_of.lock().contains_key(&mts)
    }

    fn mandate(&self, mts: Incarnation) -> Mandate {
        let mandates = self.mandates.load();
        mandates.get(&mts).cloned().unwrap_or_default()
    }
}
