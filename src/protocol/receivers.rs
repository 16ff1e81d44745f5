//! The agents that the receivers of an opening message stand for.

use std::collections::HashSet;

use fipa_acl::{AgentId, AgentIdError, BuildError, MessageBuilder};
use fipa_sds::{Directory, Entry, Resolution, resolve};

use super::dialogue::DialogueError;
use crate::agent::AgentCore;

/// The agents that receivers stand for.
#[derive(Debug, Default)]
pub(super) struct Expanded {
    /// The agents, each once.
    pub(super) agents: Vec<AgentId>,
    /// The members of coalitions that are not registered, and coalitions without a present leader.
    pub(super) missing: Vec<String>,
}

/// Replaces patterns and coalitions by the agents that they stand for now, and removes repeated names.
/// An unknown name stays, and the message to it fails.
pub(super) fn expand(core: &AgentCore, receivers: &[AgentId]) -> Expanded {
    let directory = &*core.endpoint.domain.inner.service.host;
    expand_in(directory, &core.endpoint.name, receivers)
}

fn expand_in(directory: &dyn Directory, own: &str, receivers: &[AgentId]) -> Expanded {
    let mut expanded = Expanded::default();
    let mut known = HashSet::new();
    for receiver in receivers {
        let agents: Vec<AgentId> = match resolve(directory, receiver.name(), own) {
            Ok(Resolution::Multicast(entries)) => ids(&entries),
            Ok(Resolution::Coalition {
                agents,
                missing,
                leaderless,
            }) => {
                for member in missing.into_iter().chain(leaderless) {
                    if known.insert(member.to_string()) {
                        expanded.missing.push(member.to_string());
                    }
                }
                ids(&agents)
            }
            // The delivery reports an invalid pattern.
            Ok(Resolution::Exact(_) | Resolution::None) | Err(_) => vec![receiver.clone()],
        };
        for agent in agents {
            if known.insert(agent.name().to_owned()) {
                expanded.agents.push(agent);
            }
        }
    }
    expanded
}

fn ids<'e>(entries: impl IntoIterator<Item = &'e std::sync::Arc<Entry>>) -> Vec<AgentId> {
    let entries = entries.into_iter();
    // A registered name is a valid name of an agent.
    entries
        .filter_map(|entry| AgentId::new(&*entry.name).ok())
        .collect()
}

/// Converts receivers that are given as identifiers or names.
pub(super) fn identified<A>(receivers: &[A]) -> Result<Vec<AgentId>, DialogueError>
where
    A: Clone + TryInto<AgentId, Error: Into<AgentIdError>>,
{
    let ids = receivers.iter().map(|receiver| receiver.clone().try_into());
    let ids: Result<Vec<AgentId>, _> = ids.collect();
    ids.map_err(|error| BuildError::from(error.into()).into())
}

/// Replaces the receivers of an opening message for one agent by that agent.
pub(super) fn single(
    core: &AgentCore,
    opening: MessageBuilder,
) -> Result<(MessageBuilder, Vec<AgentId>), DialogueError> {
    let given = opening.clone().build()?.receivers().to_vec();
    let Expanded {
        agents,
        mut missing,
    } = expand(core, &given);
    match &agents[..] {
        // The message has no receiver, or a coalition no registered member.
        [] if missing.len() < 2 => Ok((opening, given)),
        [_] if missing.is_empty() => Ok((opening.replace_receivers(agents.clone()), agents)),
        _ => {
            missing.extend(agents.iter().map(|agent| agent.name().to_owned()));
            Err(DialogueError::Several { agents: missing })
        }
    }
}

#[cfg(test)]
mod tests {
    use fipa_sds::{Members, MemoryDirectory, MtsId, Registration, Role};
    use fipa_transport::Incarnation;

    use super::*;

    fn directory() -> MemoryDirectory {
        let directory = MemoryDirectory::new(MtsId::new("mts", Incarnation::random()));
        let register = |name: &str, role: Role| {
            let agent = Registration {
                role,
                ..Registration::new(name, Incarnation::random(), Vec::new())
            };
            directory.register(agent).unwrap();
        };
        for name in ["rover", "arm_1", "arm_2", "arm_3"] {
            register(name, Role::Agent);
        }
        let members = ["rover", "arm_1", "arm_3", "lost"];
        let members = |leader: Option<&str>| {
            Role::Coalition(Members::new(members, leader.map(Into::into)).unwrap())
        };
        register("platoon", members(None));
        register("led", members(Some("arm_3")));
        directory
    }

    fn expanded(receivers: &[&str]) -> (Vec<String>, Vec<String>) {
        let receivers: Vec<AgentId> = receivers
            .iter()
            .map(|name| AgentId::new(*name).unwrap())
            .collect();
        let Expanded { agents, missing } = expand_in(&directory(), "rover", &receivers);
        let agents = agents.iter().map(|agent| agent.name().to_owned());
        (agents.collect(), missing)
    }

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn patterns_and_coalitions_stand_for_their_agents() {
        let all = names(&["arm_1", "arm_2", "arm_3"]);
        assert_eq!(expanded(&["arm_.*"]), (all, vec![]));
        let members = names(&["arm_1", "arm_3"]);
        assert_eq!(expanded(&["platoon"]), (members, names(&["lost"])));
        assert_eq!(expanded(&["led"]), (names(&["arm_3"]), vec![]));
    }

    #[test]
    fn a_name_that_is_given_twice_counts_once() {
        let given = ["arm_2", "platoon", "arm_2", "arm_.*", "platoon"];
        let all = names(&["arm_2", "arm_1", "arm_3"]);
        assert_eq!(expanded(&given), (all, names(&["lost"])));
    }

    #[test]
    fn unknown_names_and_invalid_patterns_stay() {
        let given = ["unknown", "leg_.*", "arm_("];
        assert_eq!(expanded(&given), (names(&given), vec![]));
    }
}
