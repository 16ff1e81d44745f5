//! The agents in the directory, and those that were in it.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::admin::routes::ASKER_TYPE;
use fipa::{Entry, Reach, Role};
use serde_json::{Value, json};

use super::{clipped, moment};
use crate::command::top::{AgentRow, agent_object};

/// Maximum number of agents; further ones are not shown.
const MAX_AGENTS: usize = 2000;

/// Time for which an agent is shown that has ended.
const KEPT: Duration = Duration::from_secs(3600);

/// The agents by name.
#[derive(Debug, Default)]
pub(super) struct Agents {
    known: BTreeMap<String, Agent>,
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

impl Agents {
    /// Takes the entries of the directory.
    pub(super) fn look(&mut self, now: SystemTime, entries: &[Arc<Entry>]) {
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
            let age = agent.ended.and_then(|ended| now.duration_since(ended).ok());
            let is_kept = age.is_none_or(|age| age < KEPT) && present.len() < MAX_AGENTS;
            if is_kept && !present.contains_key(&name) {
                let ended = Some(agent.ended.unwrap_or(now));
                present.insert(name, Agent { ended, ..agent });
            }
        }
        self.known = present;
    }

    /// The rows by name, with the counted letters.
    pub(super) fn rows<'a>(
        &'a self,
        counted: &[AgentRow],
    ) -> impl Iterator<Item = (&'a str, Value)> {
        let mut counted: BTreeMap<String, Value> = counted
            .iter()
            .map(|row| (row.name.clone(), agent_object(row)))
            .collect();
        self.known.iter().map(move |(name, agent)| {
            let mut row = agent.row(name);
            if let (Some(row), Some(Value::Object(counted))) =
                (row.as_object_mut(), counted.remove(name))
            {
                row.extend(counted);
            }
            (name.as_str(), row)
        })
    }

    /// The row of an agent.
    pub(super) fn row(&self, name: &str) -> Option<Value> {
        self.known.get(name).map(|agent| agent.row(name))
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

    fn row(&self, name: &str) -> Value {
        json!({
            "name": name, "host": self.host, "here": self.is_here, "type": self.kind,
            "description": self.description, "registered": self.registered, "ended": self.ended.map(moment),
            "members": self.members, "leader": self.leader,
        })
    }
}
