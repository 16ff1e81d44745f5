//! Questions to several agents at the same time.

use std::collections::BTreeMap;
use std::fmt::Display;

use fipa::{Agent, AgentId, Entry, Reach, Role};
use fipa_acl::escape_name;
use tokio::task::JoinSet;

/// Returns the agents of this host without those of the platform and without the agent that asks.
pub(super) fn agents_of_this_host(agent: &Agent) -> Vec<AgentId> {
    let directory = agent.domain().directory();
    directory.refresh();
    let entries = directory.entries();
    let here = entries
        .iter()
        .filter(|entry| is_agent_of_this_host(entry, agent));
    here.filter_map(|entry| AgentId::new(&*entry.name).ok())
        .collect()
}

/// Whether this is an agent of this host, but none of the platform and not the one that asks.
pub(super) fn is_agent_of_this_host(entry: &Entry, asker: &Agent) -> bool {
    entry.role == Role::Agent
        && entry.reach == Reach::Local
        && !entry.is_platform_agent()
        && *entry.name != *asker.name()
}

/// Asks all agents at the same time. Returns the answers by name; `None` of an agent that gave none.
pub(super) async fn ask_all<T, E, F>(
    agents: impl IntoIterator<Item = AgentId>,
    ask: impl Fn(AgentId) -> F,
) -> BTreeMap<String, Option<T>>
where
    F: Future<Output = Result<T, E>> + Send + 'static,
    T: Send + 'static,
    E: Display + Send + 'static,
{
    let mut asked = JoinSet::new();
    for agent in agents {
        let name = agent.name().to_owned();
        let answer = ask(agent);
        asked.spawn(async move { (name, answer.await) });
    }
    let mut answers = BTreeMap::new();
    while let Some(answered) = asked.join_next().await {
        match answered {
            Ok((name, Ok(answer))) => {
                answers.insert(name, Some(answer));
            }
            Ok((name, Err(error))) => {
                tracing::debug!(agent = %escape_name(&name), %error, "the agent does not answer the question");
                answers.insert(name, None);
            }
            Err(error) => tracing::debug!(%error, "a question has ended"),
        }
    }
    answers
}
