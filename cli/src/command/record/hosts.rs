//! Finds the hosts that are gone.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::SystemTime;

use fipa::admin::watch::Passage;
use fipa::{Entry, Reach};

/// Reason for which an agent has left the directory.
pub(super) const HOST_GONE: &str = "its host is gone";

/// The other hosts with agents in the directory.
#[derive(Debug, Default)]
pub(super) struct Hosts {
    /// The host of each agent.
    agents: HashMap<Arc<str>, Arc<str>>,
    hosts: HashMap<Arc<str>, Host>,
}

#[derive(Debug, Default)]
struct Host {
    agents: usize,
    last_letter: Option<SystemTime>,
}

/// A host that is gone.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct HostGone {
    /// Name of its gateway.
    pub(super) host: Arc<str>,
    /// Number of its agents that left with it.
    pub(super) agents: usize,
    /// Time of the last letter of its agents.
    pub(super) last_letter: Option<SystemTime>,
}

impl Hosts {
    pub(super) fn new(entries: &[Arc<Entry>]) -> Self {
        let mut hosts = Self::default();
        for entry in entries {
            hosts.appear(entry);
        }
        hosts
    }

    /// Handles a letter.
    pub(super) fn letter(&mut self, passage: &Passage) {
        if let Some(sender) = passage.sender() {
            self.letter_of(sender, passage.at);
        }
    }

    fn letter_of(&mut self, sender: &str, at: SystemTime) {
        let host = self.agents.get(sender);
        if let Some(host) = host.and_then(|host| self.hosts.get_mut(host)) {
            host.last_letter = host.last_letter.max(Some(at));
        }
    }

    /// Handles the changes of the directory. Returns the hosts that are gone.
    pub(super) fn handle(
        &mut self,
        left: &[(Arc<Entry>, &'static str)],
        appeared: &[Arc<Entry>],
    ) -> Vec<HostGone> {
        let mut gone: Vec<HostGone> = Vec::new();
        for (entry, reason) in left {
            let Some(host) = self.agents.remove(&*entry.name) else {
                continue;
            };
            let mut last_letter = None;
            if let Some(state) = self.hosts.get_mut(&host) {
                last_letter = state.last_letter;
                state.agents = state.agents.saturating_sub(1);
                if state.agents == 0 {
                    self.hosts.remove(&host);
                }
            }
            if *reason != HOST_GONE {
                continue;
            }
            match gone.iter_mut().find(|it| it.host == host) {
                Some(known) => known.agents += 1,
                None => gone.push(HostGone {
                    host,
                    agents: 1,
                    last_letter,
                }),
            }
        }
        for entry in appeared {
            self.appear(entry);
        }
        gone
    }

    fn appear(&mut self, entry: &Entry) {
        if !matches!(entry.reach, Reach::Remote { .. }) {
            return;
        }
        let host = entry.mts.name.clone();
        let host = host.unwrap_or_else(|| entry.mts.incarnation.to_string().into());
        let before = self
            .agents
            .insert(Arc::clone(&entry.name), Arc::clone(&host));
        if before.is_none() {
            self.hosts.entry(host).or_default().agents += 1;
        }
    }
}
