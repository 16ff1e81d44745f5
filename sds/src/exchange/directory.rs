//! The back end with the entries that neighbors sent.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use arc_swap::ArcSwap;
use fipa_transport::{Incarnation, Location, Mandate, PeerId, Principal};
use parking_lot::Mutex;
use tokio::sync::Notify;

use super::Agents;
use super::df::{DfEntries, DfEntry, ReceivedDf};
use crate::shares;
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
    lists: Mutex<HashMap<Incarnation, AgentList>>,
    /// The gateways among `lists`, for views, which do not wait for an update. A gateway is one of them
    /// only while the table has its entries.
    gateways: ArcSwap<HashSet<Incarnation>>,
    /// DF entries of these agents. Locked after `lists`.
    df: Mutex<ReceivedDf>,
    df_changed: Notify,
}

impl Default for ExchangeDirectory {
    fn default() -> Self {
        Self {
            table: Table::proved_by(|origin| origin.is_proved),
            mandates: ArcSwap::default(),
            lists: Mutex::default(),
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

/// The gateway that sends a letter.
#[derive(Debug, Clone)]
pub(super) struct Sender {
    pub(super) gateway: Incarnation,
    pub(super) principal: Principal,
    pub(super) peer: PeerId,
}

/// The agents of one gateway. Its [share](shares) bounds them.
#[derive(Debug)]
pub(super) struct AgentList {
    sender: Sender,
    agents: Agents,
    /// The charged bytes of the agents.
    charged: usize,
    /// Whether agents are missing for lack of room.
    is_cut: bool,
}

impl AgentList {
    pub(super) fn new(sender: Sender) -> Self {
        Self {
            sender,
            agents: Agents::new(),
            charged: 0,
            is_cut: false,
        }
    }

    pub(super) fn charged(&self) -> usize {
        self.charged
    }

    pub(super) fn insert(&mut self, entry: Arc<Entry>) {
        self.charged += shares::charge(&entry);
        if let Some(before) = self.agents.insert(Arc::clone(&entry.name), entry) {
            self.charged -= shares::charge(&before);
        }
    }

    fn remove(&mut self, name: &str) -> Option<Arc<str>> {
        let (name, before) = self.agents.remove_entry(name)?;
        self.charged -= shares::charge(&before);
        Some(name)
    }

    /// Removes the last agents by name until the others fit. Returns the names of the removed ones.
    pub(super) fn cut(&mut self, most: usize) -> Vec<Arc<str>> {
        let mut removed = Vec::new();
        while self.charged > most
            && let Some((name, before)) = self.agents.pop_last()
        {
            self.charged -= shares::charge(&before);
            self.is_cut = true;
            removed.push(name);
        }
        removed
    }
}

fn is_listed(lists: &HashMap<Incarnation, AgentList>, gateway: Incarnation, name: &str) -> bool {
    let list = lists.get(&gateway);
    list.is_some_and(|list| list.agents.contains_key(name))
}

/// Returns the bytes that each list may take.
fn allowances<'a>(
    lists: impl IntoIterator<Item = (&'a Incarnation, (&'a PeerId, usize))>,
) -> HashMap<Incarnation, usize> {
    let (gateways, sizes): (Vec<Incarnation>, Vec<_>) = lists.into_iter().unzip();
    let allowed = shares::allowances(&sizes, shares::MAX_OF_PEER, shares::MAX_TOTAL);
    gateways.into_iter().zip(allowed).collect()
}

impl ExchangeDirectory {
    /// Maximum number of pairs that [`contested`](Self::contested) returns.
    pub const MAX_CONTESTED: usize = 1024;

    /// Returns the names that several neighbors claim, with certified links or else without: the entry
    /// that holds the name, and each other entry. At most [`MAX_CONTESTED`](Self::MAX_CONTESTED) pairs, in which the
    /// claiming peers take turns. Two gateways with one certificate do not contest names.
    #[must_use]
    pub fn contested(&self) -> Vec<(Arc<Entry>, Arc<Entry>)> {
        self.table.contested(Self::MAX_CONTESTED)
    }

    /// Returns the entries of agents in the directory facilitators of the neighbors, in no particular
    /// order. At most [`Exchange::MAX_TOTAL_DF_ENTRIES`](super::Exchange::MAX_TOTAL_DF_ENTRIES).
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

    /// Withdraws these gateways, and restores those that were withdrawn and are not among them. The entries of
    /// withdrawn gateways end, and those in other directories are hidden.
    pub(super) fn withdraw(&self, gateways: &HashMap<Incarnation, Principal>) {
        gateways.keys().for_each(|gateway| self.forget(*gateway));
        self.mandates.rcu(|mandates| {
            let mut mandates = HashMap::clone(mandates);
            mandates.retain(|_, mandate| *mandate != Mandate::Withdrawn);
            mandates.extend(gateways.keys().map(|it| (*it, Mandate::Withdrawn)));
            mandates
        });
        self.table.notify_reread();
    }

    fn origin(&self, gateway: Incarnation) -> Origin {
        Origin {
            gateway,
            is_proved: self.mandates.load().contains_key(&gateway),
        }
    }

    /// Replaces all agents of the gateway, and their DF entries. Agents beyond the shares of their peers
    /// are left out.
    pub(super) fn replace(&self, list: AgentList, mut df: DfEntries) {
        let Sender {
            gateway, principal, ..
        } = list.sender;
        let origin = self.origin(gateway);
        let mut lists = self.lists.lock();
        let new: Vec<Arc<Entry>> = list.agents.values().cloned().collect();
        let before = lists.insert(gateway, list);
        let now = lists.get(&gateway);
        let before = before.map(|list| list.agents).unwrap_or_default();
        let removed = before
            .into_keys()
            .filter(|name| now.is_none_or(|now| !now.agents.contains_key(name)))
            .map(|name| (origin, name, None));
        let added = new.into_iter();
        let added = added.map(|entry| (origin, Arc::clone(&entry.name), Some(entry)));
        let updates: Vec<Update> = removed.chain(added).collect();
        self.update(&mut lists, updates);
        self.show(gateway);
        df.retain(|name, _| is_listed(&lists, gateway, name));
        self.update_df(|all| all.replace(gateway, principal, df));
    }

    /// Adds or updates some agents of the gateway with their DF entries, and removes others. Agents
    /// beyond the shares of their peers are left out.
    pub(super) fn change(
        &self,
        sender: &Sender,
        joined: Vec<(Arc<Entry>, Option<Arc<DfEntry>>)>,
        removed: Vec<String>,
    ) {
        let gateway = sender.gateway;
        let origin = self.origin(gateway);
        let mut lists = self.lists.lock();
        let list = lists
            .entry(gateway)
            .or_insert_with(|| AgentList::new(sender.clone()));
        let mut updates: Vec<Update> = Vec::new();
        let mut df = Vec::new();
        for name in removed.iter().filter_map(|name| list.remove(name)) {
            df.push((Arc::clone(&name), None));
            updates.push((origin, name, None));
        }
        for (entry, of_entry) in joined {
            df.push((Arc::clone(&entry.name), of_entry));
            list.insert(Arc::clone(&entry));
            updates.push((origin, Arc::clone(&entry.name), Some(entry)));
        }
        self.update(&mut lists, updates);
        self.show(gateway);
        df.retain(|(name, of_entry)| of_entry.is_none() || is_listed(&lists, gateway, name));
        self.update_df(|all| all.change(gateway, sender.principal, df));
    }

    /// Cuts the lists to the shares of their peers, and applies the updates to the table without the agents that
    /// are cut. The only way by which agents enter the table.
    fn update(&self, lists: &mut HashMap<Incarnation, AgentList>, mut updates: Vec<Update>) {
        let sizes = lists
            .iter()
            .map(|(gateway, list)| (gateway, (&list.sender.peer, list.charged)));
        let allowed = allowances(sizes);
        for (gateway, list) in lists.iter_mut() {
            let most = allowed.get(gateway).copied().unwrap_or_default();
            if list.charged > most {
                let origin = self.origin(*gateway);
                let cut = list.cut(most);
                let ended = cut.iter().map(|name| (Arc::clone(name), None));
                let df: Vec<(Arc<str>, Option<Arc<DfEntry>>)> = ended.collect();
                self.update_df(|all| all.change(*gateway, list.sender.principal, df));
                updates.extend(cut.into_iter().map(|name| (origin, name, None)));
            }
        }
        self.table.update(updates);
    }

    /// Whether the list of this gateway lacks agents, and has room for more than a few.
    pub(super) fn has_room(&self, gateway: Incarnation) -> bool {
        /// Room that is worth another transfer of the whole list.
        const WORTHWHILE: usize = shares::MAX_OF_PEER / 20;
        let lists = self.lists.lock();
        let Some(cut) = lists.get(&gateway).filter(|list| list.is_cut) else {
            return false;
        };
        let wanted = cut.charged + WORTHWHILE;
        let sizes = lists.iter().map(|(other, list)| {
            let size = if *other == gateway {
                wanted
            } else {
                list.charged
            };
            (other, (&list.sender.peer, size))
        });
        allowances(sizes).get(&gateway) == Some(&wanted)
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

    /// Sets new locations of the gateway and all its agents. Returns the number of these agents.
    pub(super) fn relocate(&self, sender: &Sender, locations: &[Location]) -> usize {
        let origin = self.origin(sender.gateway);
        let mut lists = self.lists.lock();
        let Some(list) = lists.get_mut(&sender.gateway) else {
            return 0;
        };
        list.sender = sender.clone();
        let mut updates: Vec<Update> = Vec::new();
        for (name, entry) in &mut list.agents {
            *entry = Arc::new(Entry {
                locations: locations.to_vec(),
                peer: sender.peer.clone(),
                ..Entry::clone(entry)
            });
            updates.push((origin, Arc::clone(name), Some(Arc::clone(entry))));
        }
        let agents = updates.len();
        self.update(&mut lists, updates);
        agents
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
        let mut lists = self.lists.lock();
        let Some(list) = lists.get_mut(&gateway).filter(|_| !origin.is_proved) else {
            return false;
        };
        let agent = |entry: &&Arc<Entry>| entry.role == Role::Agent && knows(entry);
        let known = list.agents.values().filter(agent);
        let known: Vec<Arc<str>> = known.map(|entry| Arc::clone(&entry.name)).collect();
        for name in &known {
            list.remove(name);
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

    /// Replaces the [lost agents](View::lost_agents).
    pub(super) fn set_lost(&self, lost: impl IntoIterator<Item = Arc<Entry>>) {
        self.table.set_lost(lost);
    }

    /// Returns at most `most` agents of the gateway.
    pub(super) fn agents_of(&self, gateway: Incarnation, most: usize) -> Vec<Arc<Entry>> {
        let lists = self.lists.lock();
        let entries = lists.get(&gateway).into_iter();
        let entries = entries.flat_map(|list| list.agents.values());
        let agents = entries.filter(|entry| entry.role == Role::Agent);
        agents.take(most).cloned().collect()
    }

    /// Removes the gateway's agents.
    pub(super) fn forget(&self, gateway: Incarnation) {
        let origin = self.origin(gateway);
        let mut lists = self.lists.lock();
        let removed = lists.remove(&gateway);
        self.update_df(|all| all.forget(gateway));
        if self.gateways.load().contains(&gateway) {
            self.gateways.rcu(|gateways| {
                let mut gateways = HashSet::clone(gateways);
                gateways.remove(&gateway);
                gateways
            });
            self.table.touch();
        }
        let removed = removed.map(|list| list.agents).unwrap_or_default();
        let names = removed.into_keys();
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

    fn lost_agents(&self) -> Vec<Arc<Entry>> {
        self.entries.lost_agents()
    }

    fn lost_agent(&self, name: &str) -> Option<Arc<Entry>> {
        self.entries.lost_agent(name)
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
        self.lists.lock().contains_key(&mts)
    }

    fn mandate(&self, mts: Incarnation) -> Mandate {
        let mandates = self.mandates.load();
        mandates.get(&mts).cloned().unwrap_or_default()
    }
}
