//! Resolution of a receiver's name to entries.

use std::sync::Arc;

use crate::{Entry, Matcher, Pattern, PatternError, Query, Role, View, coalition, is_pattern};

/// Entries that the name of a receiver stands for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Resolution {
    /// The entry with that name.
    Exact(Arc<Entry>),
    /// The entries that match a pattern, sorted by name; at least one.
    Multicast(Vec<Arc<Entry>>),
    /// The agents of a coalition, with nested coalitions resolved, or its leader.
    Coalition {
        /// The agents that have an entry.
        agents: Vec<Arc<Entry>>,
        /// Members without an entry, or beyond the bounds of one coalition.
        missing: Vec<Arc<str>>,
        /// The coalitions, this one or nested ones, that are led and whose leader has no entry at present.
        leaderless: Vec<Arc<str>>,
    },
    /// No entry: the name is unknown, or the pattern or coalition has no agent except the sender.
    None,
}

impl Resolution {
    /// Whether a [refresh](crate::Directory::refresh) of the directory adds nothing: every name has an
    /// entry, and no pattern was matched.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        match self {
            Self::Exact(_) => true,
            Self::Coalition {
                missing,
                leaderless,
                ..
            } => missing.is_empty() && leaderless.is_empty(),
            Self::Multicast(_) | Self::None => false,
        }
    }
}

/// Resolves `receiver` in a letter from `sender`, without a refresh.
///
/// The name of a coalition resolves to its members without the sender, or to its leader. A name
/// that [is a pattern](is_pattern) resolves to every agent whose whole name matches, except the
/// sender; gateways and their [platform agents](Entry::is_platform_agent) are left out, because `.*`
/// addresses the agents of robots. No agent can have a pattern as its
/// name.
///
/// # Errors
/// Fails when the name is a pattern that is not valid.
pub fn resolve<V: View + ?Sized>(
    view: &V,
    receiver: &str,
    sender: &str,
) -> Result<Resolution, PatternError> {
    if let Some(entry) = view.named(receiver) {
        return Ok(match &entry.role {
            Role::Coalition(_) => {
                let resolved = coalition::agents_of(view, &entry, sender);
                match resolved.is_empty() {
                    true => Resolution::None,
                    false => Resolution::Coalition {
                        agents: resolved.agents,
                        missing: resolved.missing,
                        leaderless: resolved.leaderless,
                    },
                }
            }
            _ => Resolution::Exact(entry),
        });
    }
    if !is_pattern(receiver) {
        return Ok(Resolution::None);
    }
    let pattern = Pattern::new(receiver)?;
    let query = Query::by_name(Matcher::Pattern(pattern));
    let is_meant = |entry: &&Arc<Entry>| {
        query.matches(entry)
            && *entry.name != *sender
            && entry.role == Role::Agent
            && !entry.is_platform_agent()
    };
    let found: Vec<_> = view.all().iter().filter(is_meant).cloned().collect();
    Ok(if found.is_empty() {
        Resolution::None
    } else {
        Resolution::Multicast(found)
    })
}

/// Whether this is a coalition that is led and whose leader has no entry at present.
#[must_use]
pub fn is_leaderless<V: View + ?Sized>(view: &V, name: &str) -> bool {
    let entry = view.named(name);
    entry.is_some_and(|entry| match &entry.role {
        Role::Coalition(members) => coalition::is_leaderless(view, members),
        _ => false,
    })
}

/// Resolves the receiver of a legacy peer's letter like [`resolve`], except for a name in which `?`
/// is the only special character. fipa_services writes `?` for each dot of an agent's name; such a
/// name is not a pattern and costs one lookup.
///
/// # Errors
/// Fails when the name is a pattern that is not valid.
pub fn resolve_legacy<V: View + ?Sized>(
    view: &V,
    receiver: &str,
    sender: &str,
) -> Result<Resolution, PatternError> {
    if !receiver.contains('?') {
        return resolve(view, receiver, sender);
    }
    match is_legacy_pattern(receiver) {
        true => resolve(view, receiver, sender),
        false => resolve(view, &receiver.replace('?', "."), sender),
    }
}

/// Whether [`resolve_legacy`] compiles this name: it has a special character of patterns other than
/// `?`.
#[must_use]
pub fn is_legacy_pattern(receiver: &str) -> bool {
    is_pattern(&receiver.replace('?', "."))
}

#[cfg(test)]
mod tests {
    use fipa_transport::Incarnation;

    use super::*;
    use crate::{Directory, MemoryDirectory, MtsId, Registration};

    fn directory(names: &[&str]) -> MemoryDirectory {
        let directory = MemoryDirectory::new(MtsId::new("mts", Incarnation::random()));
        for name in names {
            let agent = Registration::new(*name, Incarnation::random(), Vec::new());
            directory.register(agent).unwrap();
        }
        let mut gateway = Registration::new("arm_gateway", Incarnation::random(), Vec::new());
        gateway.role = Role::Gateway;
        directory.register(gateway).unwrap();
        directory
    }

    fn names(resolution: &Resolution) -> Vec<&str> {
        match resolution {
            Resolution::Exact(entry) => vec![&*entry.name],
            Resolution::Multicast(entries) => entries.iter().map(|entry| &*entry.name).collect(),
            Resolution::Coalition { .. } | Resolution::None => Vec::new(),
        }
    }

    #[test]
    fn a_dot_in_a_name_matches_only_a_dot() {
        let directory = directory(&["arm_left", "arm.left"]);
        let dot = resolve(&directory, "arm.left", "me").unwrap();
        assert_eq!(names(&dot), ["arm.left"]);
        let none = resolve(&directory, "arm.right", "me").unwrap();
        assert_eq!(none, Resolution::None);
    }

    #[test]
    fn a_pattern_cannot_be_registered_as_a_name() {
        let directory = directory(&["arm_left", "arm_right"]);
        let thief = Registration::new("arm_.*", Incarnation::random(), Vec::new());
        assert!(directory.register(thief).is_err());
        let both = resolve(&directory, "arm_.*", "me").unwrap();
        assert_eq!(names(&both), ["arm_left", "arm_right"]);
    }

    #[test]
    fn the_sender_and_gateways_are_left_out_of_a_multicast() {
        let directory = directory(&["arm_left", "arm_right", "camera"]);
        let both = resolve(&directory, "arm_.+", "camera").unwrap();
        assert_eq!(names(&both), ["arm_left", "arm_right"]);
        let one = resolve(&directory, "arm_.+", "arm_left").unwrap();
        assert_eq!(names(&one), ["arm_right"]);
        assert!(matches!(one, Resolution::Multicast(_)));
        let none = resolve(&directory, "came.*", "camera").unwrap();
        assert_eq!(none, Resolution::None);
        let gateway = resolve(&directory, "arm_gateway", "camera").unwrap();
        assert_eq!(names(&gateway), ["arm_gateway"]);
    }

    #[test]
    fn platform_agents_are_left_out_of_a_multicast() {
        let directory = directory(&["arm"]);
        for (name, agent_type) in [
            ("ams@mts", Entry::AMS_TYPE),
            ("df@mts", Entry::DF_TYPE),
            ("recorder@mts", Entry::RECORDER_TYPE),
        ] {
            let mut agent = Registration::new(name, Incarnation::random(), Vec::new());
            agent.agent_type = agent_type.to_owned();
            directory.register(agent).unwrap();
        }
        let all = resolve(&directory, ".*", "me").unwrap();
        assert_eq!(names(&all), ["arm"]);
        let one = resolve(&directory, "df@mts", "me").unwrap();
        assert_eq!(names(&one), ["df@mts"]);
    }

    #[test]
    fn a_question_mark_of_a_legacy_peer_means_a_dot() {
        let directory = directory(&["arm.left", "armright", "who.is.it", "leg_1"]);
        let legacy = |name: &str| names(&resolve_legacy(&directory, name, "me").unwrap()).join(" ");
        assert_eq!(legacy("arm?left"), "arm.left");
        assert_eq!(legacy("who?is?it"), "who.is.it");
        assert_eq!(legacy("arm?down"), "");
        // It is not a valid pattern, and is not read as one.
        assert_eq!(legacy("?down"), "");
        assert_eq!(legacy("arm?right"), "", "not a pattern");
        assert_eq!(legacy("le?g_[0-9]"), "leg_1", "a pattern");
        assert_eq!(legacy("armright"), "armright");
        let resolved = resolve(&directory, "arm?left", "me").unwrap();
        assert_eq!(resolved, Resolution::None, "only for legacy peers");
    }

    #[test]
    fn a_bad_pattern_is_an_error() {
        assert!(resolve(&directory(&[]), "arm_(", "me").is_err());
    }
}
