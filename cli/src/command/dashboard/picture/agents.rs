//! The agents in the directory, and those that were in it.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::admin::routes::ASKER_TYPE;
use fipa::{Entry, Reach, Role};
use serde::Serialize;

use super::{clipped, moment};
use crate::command::top::{AgentCounts, AgentRow};

/// Maximum number of agents; further ones are not shown.
const MAX_AGENTS: usize = 2000;

/// Time for which an agent is shown that has ended.
const KEPT: Duration = Duration::from_secs(3600);

/// The agents by name.
#[derive(Debug, Default)]
pub(super) struct Agents {
    known: BTreeMap<String, Agent>,
    /// The directory at the last look.
    entries: Arc<[Arc<Entry>]>,
}

#[derive(Debug)]
struct Agent {
    host: Option<String>,
    is_here: bool,
    kind: String,
    description: String,
    registered: String,
    members: Option<Vec<String>>,
    leader: Option<String>,
    /// Time at which it was not in the directory any more.
    ended: Option<SystemTime>,
}

/// The row of an agent.
#[derive(Debug, Serialize)]
pub(super) struct Row<'a> {
    name: &'a str,
    host: Option<&'a str>,
    here: bool,
    #[serde(rename = "type")]
    kind: &'a str,
    description: &'a str,
    registered: &'a str,
    ended: Option<String>,
    members: Option<&'a [String]>,
    leader: Option<&'a str>,
    #[serde(flatten)]
    counts: Option<AgentCounts>,
}

impl Agents {
    /// Takes the entries of the directory.
    pub(super) fn look(&mut self, now: SystemTime, entries: &Arc<[Arc<Entry>]>) {
        self.known.retain(|_, agent| {
            let age = agent.ended.and_then(|ended| now.duration_since(ended).ok());
            age.is_none_or(|age| age < KEPT)
        });
        if Arc::ptr_eq(entries, &self.entries) {
            return;
        }
        self.entries = Arc::clone(entries);
        let shown = entries
            .iter()
            .filter(|entry| entry.role != Role::Gateway && entry.agent_type != ASKER_TYPE);
        let mut present: BTreeMap<String, Agent> = BTreeMap::new();
        for entry in shown {
            if present.len() >= MAX_AGENTS {
                break;
            }
            present.insert(clipped(&entry.name), Agent::of(entry));
        }
        for (name, agent) in std::mem::take(&mut self.known) {
            if present.len() < MAX_AGENTS && !present.contains_key(&name) {
                let ended = Some(agent.ended.unwrap_or(now));
                present.insert(name, Agent { ended, ..agent });
            }
        }
        self.known = present;
    }

    /// The rows by name, with the counted letters.
    pub(super) fn rows<'a>(
        &'a self,
        counted: &'a [AgentRow],
    ) -> impl Iterator<Item = (&'a str, Row<'a>)> {
        let counted: HashMap<&str, &AgentRow> =
            counted.iter().map(|row| (&*row.name, row)).collect();
        self.known.iter().map(move |(name, agent)| {
            let counts = counted.get(name.as_str()).map(|row| AgentCounts::of(row));
            (name.as_str(), agent.row(name, counts))
        })
    }

    /// The row of an agent.
    pub(super) fn row(&self, name: &str) -> Option<Row<'_>> {
        let (name, agent) = self.known.get_key_value(name)?;
        Some(agent.row(name, None))
    }
}

impl Agent {
    fn of(entry: &Entry) -> Self {
        let (members, leader) = match &entry.role {
            Role::Coalition(members) => {
                let names = members.names().iter().map(|name| clipped(name)).collect();
                (Some(names), members.leader().map(|name| clipped(name)))
            }
            _ => (None, None),
        };
        Self {
            host: entry.mts.name.as_deref().map(clipped),
            is_here: entry.reach == Reach::Local,
            kind: clipped(&entry.agent_type),
            description: clipped(&entry.description),
            registered: moment(entry.registered),
            members,
            leader,
            ended: None,
        }
    }

    fn row<'a>(&'a self, name: &'a str, counts: Option<AgentCounts>) -> Row<'a> {
        Row {
            name,
            host: self.host.as_deref(),
            here: self.is_here,
            kind: &self.kind,
            description: &self.description,
            registered: &self.registered,
            ended: self.ended.map(moment),
            members: self.members.as_deref(),
            leader: self.leader.as_deref(),
            counts,
        }
    }
}
