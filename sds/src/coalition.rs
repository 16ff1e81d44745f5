//! Coalitions: names that stand for several agents, such as the agents of modules that are
//! physically joined.
//!
//! A coalition is an entry with the role [`Role::Coalition`], which lists its [`Members`] by name:
//! an agent that moves to another host stays a member. A coalition has no queue; a letter to it is
//! sent as one letter to each member, or to its leader. Members may be coalitions. A coalition that is led
//! and has no leader at present is vacant: letters to it wait for the next leader.
//!
//! Entries from the network may be hostile, so the number of members, the nesting depth of
//! coalitions and the number of agents that one name stands for are bounded.

use std::collections::HashSet;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::{Entry, NameError, Role, View, check_name};

/// Members of a coalition, and its leader if it is led.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "CoalitionRecord", into = "CoalitionRecord")]
pub struct Members {
    names: Arc<[Arc<str>]>,
    leadership: Leadership,
}

/// The receivers of letters to a coalition.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Leadership {
    /// All members.
    Shared,
    /// The next leader, for which letters wait.
    Vacant,
    /// This member.
    Led(Arc<str>),
}

/// Serialized form: `{"members": [name], "leader": name}`, without `leader` if the coalition is not led, and with an
/// empty one if it is vacant.
#[derive(Serialize, Deserialize)]
struct CoalitionRecord {
    members: Vec<Arc<str>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    leader: Option<Arc<str>>,
}

impl Members {
    /// Maximum number of members of one coalition.
    pub const MAX_MEMBERS: usize = 64;
    /// Maximum length of the names of all members together, in bytes: they must fit an mDNS record.
    pub const MAX_BYTES: usize = 2048;

    /// Creates a member list in this order; duplicate names are dropped. Letters to the coalition
    /// go to all members, or to the leader only when there is one.
    ///
    /// # Errors
    /// Fails when there are no members or too many, when a member's name is not valid, or when the
    /// leader is not a member.
    pub fn new<N: Into<Arc<str>>>(
        names: impl IntoIterator<Item = N>,
        leader: Option<Arc<str>>,
    ) -> Result<Self, MembersError> {
        Self::with(names, leader.map_or(Leadership::Shared, Leadership::Led))
    }

    /// Creates a member list of a coalition that is led and has no leader at present: letters to it wait.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn vacant<N: Into<Arc<str>>>(
        names: impl IntoIterator<Item = N>,
    ) -> Result<Self, MembersError> {
        Self::with(names, Leadership::Vacant)
    }

    fn with<N: Into<Arc<str>>>(
        names: impl IntoIterator<Item = N>,
        leadership: Leadership,
    ) -> Result<Self, MembersError> {
        let (mut members, mut bytes) = (Vec::<Arc<str>>::new(), 0);
        for name in names.into_iter().map(Into::into) {
            check_name(&name)?;
            if members.contains(&name) {
                continue;
            }
            bytes += name.len();
            members.push(name);
            if members.len() > Self::MAX_MEMBERS || bytes > Self::MAX_BYTES {
                return Err(MembersError::TooMany);
            }
        }
        if members.is_empty() {
            return Err(MembersError::None);
        }
        if let Leadership::Led(leader) = &leadership
            && !members.contains(leader)
        {
            return Err(MembersError::Leader(leader.to_string()));
        }
        Ok(Self {
            names: members.into(),
            leadership,
        })
    }

    /// Names of the members; at least one.
    #[must_use]
    pub fn names(&self) -> &[Arc<str>] {
        &self.names
    }

    /// The leader, which receives all letters to the coalition, if there is one.
    #[must_use]
    pub fn leader(&self) -> Option<&Arc<str>> {
        match &self.leadership {
            Leadership::Led(leader) => Some(leader),
            Leadership::Shared | Leadership::Vacant => None,
        }
    }

    /// Whether the coalition is led and has no leader at present.
    #[must_use]
    pub fn is_vacant(&self) -> bool {
        self.leadership == Leadership::Vacant
    }

    /// Receivers of letters to the coalition.
    fn addressed(&self) -> &[Arc<str>] {
        match &self.leadership {
            Leadership::Led(leader) => std::slice::from_ref(leader),
            Leadership::Shared => &self.names,
            Leadership::Vacant => &[],
        }
    }
}

impl TryFrom<CoalitionRecord> for Members {
    type Error = MembersError;

    fn try_from(record: CoalitionRecord) -> Result<Self, MembersError> {
        let leadership = match record.leader {
            None => Leadership::Shared,
            Some(leader) if leader.is_empty() => Leadership::Vacant,
            Some(leader) => Leadership::Led(leader),
        };
        Self::with(record.members, leadership)
    }
}

impl From<Members> for CoalitionRecord {
    fn from(members: Members) -> Self {
        Self {
            members: members.names.to_vec(),
            leader: match members.leadership {
                Leadership::Shared => None,
                Leadership::Vacant => Some("".into()),
                Leadership::Led(leader) => Some(leader),
            },
        }
    }
}

/// Error of [`Members::new`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MembersError {
    /// The list is empty.
    #[error("a coalition needs a member")]
    None,
    /// The list has too many members, or their names are too long.
    #[error(
        "too many members: at most {max} with names of {bytes} bytes together; split it into several \
         coalitions and form a coalition of them",
        max = Members::MAX_MEMBERS,
        bytes = Members::MAX_BYTES
    )]
    TooMany,
    /// The name of a member is not valid.
    #[error("the name of a member is not valid")]
    Name(#[from] NameError),
    /// The leader is not a member.
    #[error("the leader {0:?} is not a member; add it to the members")]
    Leader(String),
}

/// Maximum nesting depth of coalitions.
const MAX_DEPTH: usize = 4;
/// Maximum number of agents that one coalition stands for, including nested coalitions.
const MAX_AGENTS: usize = 256;

/// Returns the agents to which a letter from `sender` to this coalition goes.
pub(crate) fn agents_of<V: View + ?Sized>(
    view: &V,
    coalition: &Entry,
    sender: &str,
) -> ResolvedMembers {
    let mut resolved = ResolvedMembers {
        seen: HashSet::from([Arc::clone(&coalition.name)]),
        ..ResolvedMembers::default()
    };
    resolved.add(view, coalition, sender, 1);
    resolved
}

/// Whether a coalition with these members is led and its leader has no entry.
pub(crate) fn is_leaderless<V: View + ?Sized>(view: &V, members: &Members) -> bool {
    let absent = |leader: &Arc<str>| view.named(leader).is_none();
    members.is_vacant() || members.leader().is_some_and(absent)
}

/// The agents that a coalition stands for.
#[derive(Default)]
pub(crate) struct ResolvedMembers {
    seen: HashSet<Arc<str>>,
    /// The agents that have an entry.
    pub(crate) agents: Vec<Arc<Entry>>,
    /// The members that have no entry or exceed the bounds.
    pub(crate) missing: Vec<Arc<str>>,
    /// The coalitions that are led and whose leader has no entry.
    pub(crate) leaderless: Vec<Arc<str>>,
}

impl ResolvedMembers {
    /// Whether the letter goes to no agent and has no outcome.
    pub(crate) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    fn len(&self) -> usize {
        self.agents.len() + self.missing.len() + self.leaderless.len()
    }

    fn add<V: View + ?Sized>(&mut self, view: &V, coalition: &Entry, sender: &str, depth: usize) {
        let Role::Coalition(members) = &coalition.role else {
            return;
        };
        let led = members.leader().is_some();
        if is_leaderless(view, members) {
            self.leaderless.push(Arc::clone(&coalition.name));
            return;
        }
        for name in members.addressed() {
            // A member's letter to its coalition does not go back to that member; a leader receives
            // every letter, including its own. An agent that is a member twice gets one letter.
            if (!led && **name == *sender) || !self.seen.insert(Arc::clone(name)) {
                continue;
            }
            let full = self.len() >= MAX_AGENTS;
            match view.named(name).filter(|_| !full) {
                Some(entry) => match &entry.role {
                    Role::Agent => self.agents.push(entry),
                    Role::Coalition(_) if depth < MAX_DEPTH => {
                        self.add(view, &entry, sender, depth + 1);
                    }
                    _ => self.missing.push(Arc::clone(name)),
                },
                None => self.missing.push(Arc::clone(name)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use fipa_transport::Incarnation;

    use super::*;
    use crate::{Directory, MemoryDirectory, MtsId, Registration, Resolution, resolve};

    fn directory(agents: &[&str]) -> MemoryDirectory {
        let directory = MemoryDirectory::new(MtsId::new("mts", Incarnation::random()));
        for name in agents {
            let agent = Registration::new(*name, Incarnation::random(), Vec::new());
            directory.register(agent).unwrap();
        }
        directory
    }

    fn form(directory: &MemoryDirectory, name: &str, members: &[&str], leader: Option<&str>) {
        let members = Members::new(members.iter().copied(), leader.map(Into::into)).unwrap();
        let mut coalition = Registration::new(name, Incarnation::random(), Vec::new());
        coalition.role = Role::Coalition(members);
        directory.register(coalition).unwrap();
    }

    fn meant(directory: &MemoryDirectory, name: &str, sender: &str) -> (Vec<String>, Vec<String>) {
        match resolve(directory, name, sender).unwrap() {
            Resolution::Coalition {
                agents,
                missing,
                leaderless,
            } => (
                agents.iter().map(|entry| entry.name.to_string()).collect(),
                missing
                    .iter()
                    .chain(&leaderless)
                    .map(ToString::to_string)
                    .collect(),
            ),
            Resolution::None => (Vec::new(), Vec::new()),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn members_are_checked() {
        let none: [&str; 0] = [];
        assert_eq!(Members::new(none, None), Err(MembersError::None));
        let stranger = Members::new(["a"], Some("b".into()));
        assert_eq!(stranger, Err(MembersError::Leader("b".to_owned())));
        assert!(matches!(
            Members::new([""], None),
            Err(MembersError::Name(_))
        ));
        let many: Vec<String> = (0..65).map(|number| number.to_string()).collect();
        assert_eq!(Members::new(many, None), Err(MembersError::TooMany));
        let long: Vec<String> = ["a", "b", "c"].map(|name| name.repeat(700)).into();
        assert_eq!(Members::new(long, None), Err(MembersError::TooMany));
        let twice = Members::new(["a", "b", "a"], None).unwrap();
        assert_eq!(twice.names().len(), 2);
        let json = serde_json::to_string(&twice).unwrap();
        assert_eq!(json, r#"{"members":["a","b"]}"#);
        assert_eq!(serde_json::from_str::<Members>(&json).unwrap(), twice);
        let vacant = Members::vacant(["a"]).unwrap();
        assert_eq!(vacant.leader(), None);
        let json = serde_json::to_string(&vacant).unwrap();
        assert_eq!(json, r#"{"members":["a"],"leader":""}"#);
        assert_eq!(serde_json::from_str::<Members>(&json).unwrap(), vacant);
        let stranger = r#"{"members":["a"],"leader":"b"}"#;
        assert!(serde_json::from_str::<Members>(stranger).is_err());
    }

    #[test]
    fn a_coalition_resolves_to_its_members_without_the_sender_or_to_its_leader() {
        let directory = directory(&["a", "b", "c"]);
        form(&directory, "all", &["a", "b", "gone", "c"], None);
        form(&directory, "led", &["a", "b"], Some("b"));
        let (agents, missing) = meant(&directory, "all", "b");
        assert_eq!(
            (agents, missing),
            (vec!["a".into(), "c".into()], vec!["gone".into()])
        );
        assert_eq!(meant(&directory, "led", "c").0, ["b"]);
        assert_eq!(meant(&directory, "led", "b").0, ["b"]);
        form(&directory, "lost", &["gone", "a"], Some("gone"));
        let nested = Members::vacant(["a", "b"]).unwrap();
        let mut vacant = Registration::new("vacant", Incarnation::random(), Vec::new());
        vacant.role = Role::Coalition(nested);
        directory.register(vacant).unwrap();
        assert_eq!(
            meant(&directory, "lost", "c"),
            (vec![], vec!["lost".into()])
        );
        form(&directory, "outer", &["a", "vacant", "lost"], None);
        let leaderless = vec!["vacant".to_owned(), "lost".to_owned()];
        assert_eq!(
            meant(&directory, "outer", "c"),
            (vec!["a".into()], leaderless)
        );
        for (name, is_leaderless) in [
            ("lost", true),
            ("vacant", true),
            ("outer", false),
            ("a", false),
        ] {
            assert_eq!(
                crate::is_leaderless(&directory, name),
                is_leaderless,
                "{name}"
            );
        }
        form(&directory, "alone", &["a"], None);
        assert_eq!(resolve(&directory, "alone", "a").unwrap(), Resolution::None);
        // Patterns match agents only.
        let Resolution::Multicast(entries) = resolve(&directory, ".*", "a").unwrap() else {
            panic!("a pattern");
        };
        assert!(entries.iter().all(|entry| entry.role == Role::Agent));
    }

    #[test]
    fn nested_coalitions_are_resolved_within_bounds() {
        let directory = directory(&["a", "b", "z"]);
        form(&directory, "one", &["a", "two"], None);
        form(&directory, "two", &["one", "b", "two", "a"], None);
        assert_eq!(meant(&directory, "one", "z").0, ["a", "b"]);
        for depth in 0..10 {
            form(
                &directory,
                &format!("d{depth}"),
                &[&format!("d{}", depth + 1), "a"],
                None,
            );
        }
        let (agents, missing) = meant(&directory, "d0", "z");
        assert_eq!((agents, missing), (vec!["a".into()], vec!["d4".into()]));
        for outer in 0..60 {
            let names: Vec<String> = (0..60).map(|inner| format!("n{outer}.{inner}")).collect();
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            form(&directory, &format!("n{outer}"), &names, None);
        }
        let outer: Vec<String> = (0..60).map(|outer| format!("n{outer}")).collect();
        let outer: Vec<&str> = outer.iter().map(String::as_str).collect();
        form(&directory, "crowd", &outer, None);
        let (agents, missing) = meant(&directory, "crowd", "z");
        assert!(agents.is_empty());
        assert!(missing.len() < MAX_AGENTS + 200, "{}", missing.len());
    }
}
