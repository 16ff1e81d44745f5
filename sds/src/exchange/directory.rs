//! The back end with what neighbours have told.

use std::collections::HashMap;
use std::sync::Arc;

use fipa_transport::{Incarnation, Location};
use parking_lot::Mutex;

use super::{Agents, Exchange, ExchangeError};
use crate::table::Table;
use crate::{Directory, Entry, Role, Subscriber};

/// The agents that neighbours have told of.
#[derive(Debug)]
pub struct ExchangeDirectory {
    table: Table<Incarnation>,
    /// What each gateway has told. The lock is held while the table is changed, too.
    told: Mutex<HashMap<Incarnation, Agents>>,
}

impl Default for ExchangeDirectory {
    fn default() -> Self {
        Self {
            table: Table::new(),
            told: Mutex::default(),
        }
    }
}

type Update = (Incarnation, Arc<str>, Option<Arc<Entry>>);

impl ExchangeDirectory {
    /// These are all agents of the gateway now.
    pub(super) fn replace(
        &self,
        gateway: Incarnation,
        entries: Agents,
    ) -> Result<(), ExchangeError> {
        let mut told = self.told.lock();
        let others = told.iter().filter(|(other, _)| **other != gateway);
        let total: usize = others.map(|(_, entries)| entries.len()).sum();
        if total + entries.len() > Exchange::MAX_TOTAL {
            return Err(ExchangeError::TooMany);
        }
        let before = told.insert(gateway, entries).unwrap_or_default();
        let now = told.get(&gateway);
        let left = before
            .into_keys()
            .filter(|name| now.is_none_or(|now| !now.contains_key(name)))
            .map(|name| (gateway, name, None));
        let here = now.into_iter().flatten();
        let here = here.map(|(name, entry)| (gateway, Arc::clone(name), Some(Arc::clone(entry))));
        let updates: Vec<Update> = left.chain(here).collect();
        self.table.update(updates);
        Ok(())
    }

    /// These agents of the gateway have joined or are different now, and those have left.
    pub(super) fn change(
        &self,
        gateway: Incarnation,
        joined: Vec<Arc<Entry>>,
        left: Vec<String>,
    ) -> Result<(), ExchangeError> {
        let mut told = self.told.lock();
        let total: usize = told.values().map(Agents::len).sum();
        let of_gateway = told.entry(gateway).or_default();
        let mut after = of_gateway.clone();
        let mut updates: Vec<Update> = Vec::new();
        for name in left {
            if let Some((name, _)) = after.remove_entry(name.as_str()) {
                updates.push((gateway, name, None));
            }
        }
        for entry in joined {
            after.insert(Arc::clone(&entry.name), Arc::clone(&entry));
            updates.push((gateway, Arc::clone(&entry.name), Some(entry)));
        }
        let total = total - of_gateway.len() + after.len();
        if after.len() > Exchange::MAX_AGENTS || total > Exchange::MAX_TOTAL {
            return Err(ExchangeError::TooMany);
        }
        *of_gateway = after;
        self.table.update(updates);
        Ok(())
    }

    /// The gateway is elsewhere now, and all its agents with it.
    pub(super) fn relocate(&self, gateway: Incarnation, locations: &[Location]) {
        let mut told = self.told.lock();
        let mut updates: Vec<Update> = Vec::new();
        for (name, entry) in told.get_mut(&gateway).into_iter().flatten() {
            *entry = Arc::new(Entry {
                locations: locations.to_vec(),
                ..Entry::clone(entry)
            });
            updates.push((gateway, Arc::clone(name), Some(Arc::clone(entry))));
        }
        self.table.update(updates);
    }

    /// Lets go of agents of the gateway that another directory knows. Says whether there were any.
    /// Coalitions stay: this directory [speaks for](Directory::speaks_for) them.
    pub(super) fn leave_to_others(
        &self,
        gateway: Incarnation,
        knows: impl Fn(&Entry) -> bool,
    ) -> bool {
        let mut told = self.told.lock();
        let Some(agents) = told.get_mut(&gateway) else {
            return false;
        };
        let agent = |entry: &&Arc<Entry>| entry.role == Role::Agent && knows(entry);
        let known = agents.values().filter(agent);
        let known: Vec<Arc<str>> = known.map(|entry| Arc::clone(&entry.name)).collect();
        for name in &known {
            agents.remove(name);
        }
        let any = !known.is_empty();
        let updates: Vec<Update> = known
            .into_iter()
            .map(|name| (gateway, name, None))
            .collect();
        self.table.update(updates);
        any
    }

    /// The gateway is gone, and all its agents with it.
    pub(super) fn forget(&self, gateway: Incarnation) {
        let mut told = self.told.lock();
        let names = told.remove(&gateway).unwrap_or_default().into_keys();
        self.table.update(names.map(|name| (gateway, name, None)));
    }
}

impl Directory for ExchangeDirectory {
    reads_its_table!(table);

    /// What a gateway tells in letters comes at once and is all there is.
    fn speaks_for(&self, mts: Incarnation) -> bool {
        self.told.lock().contains_key(&mts)
    }
}
