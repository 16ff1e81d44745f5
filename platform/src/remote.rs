//! Descriptions that travel between the directory facilitators of gateways.
//!
//! The text is the description in FIPA-SL without its lease, which travels as the remaining time. The
//! caller decides which texts it takes from which gateway; this module reads and checks them.

use std::sync::Arc;
use std::time::Instant;

use fipa_acl::Time;
use fipa_content::{SlDialect, Term};

use crate::stored::read_object;
use crate::{AgentDescription, PlatformTime, limits, request};

/// The description of an agent of this host, for the directory facilitators of other hosts.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct LocalEntry {
    /// The name of the agent.
    pub name: Arc<str>,
    /// The registration of the agent: see [`Asker::registration`](crate::Asker::registration).
    pub registration: u64,
    /// The description; `None` if it cannot travel, because it has more than
    /// [`limits::REMOTE_BYTES`] or [`limits::REMOTE_PARTS`], or bytes that are no text.
    pub text: Option<Arc<str>>,
    /// The end of the lease, if there is one.
    pub lease: Option<Instant>,
}

/// The description of an agent of another host, from the directory facilitator there.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(
    clippy::exhaustive_structs,
    reason = "the shells of the cores create it"
)]
pub struct RemoteEntry {
    /// The name of the agent, which the description must have.
    pub name: Arc<str>,
    /// A number of the caller that identifies the other host, which owns the bounds that the entry uses
    /// up.
    pub source: u64,
    /// The description; see [`LocalEntry::text`].
    pub text: Arc<str>,
    /// The addresses at which agents of other platforms reach the agent.
    pub addresses: Vec<String>,
    /// The time at which the description ends.
    pub ends: Instant,
    /// Whether it ends because of a lease, which searches show.
    pub has_lease: bool,
}

impl AgentDescription {
    /// Whether the directory facilitators of other hosts list the description: its scope includes them, and it has at
    /// most [`limits::REMOTE_BYTES`] and [`limits::REMOTE_PARTS`].
    #[must_use]
    pub fn travels(&self) -> bool {
        is_global(self) && text(self).is_some()
    }
}

/// Whether the scope of a description includes other hosts. The value `global` of FIPA00023 is the
/// default.
pub(crate) fn is_global(description: &AgentDescription) -> bool {
    let mut scope = description.scope.iter();
    description.scope.is_empty() || scope.any(|word| word.eq_ignore_ascii_case("global"))
}

/// Returns the text of a description, if it can travel.
pub(crate) fn text(description: &AgentDescription) -> Option<Arc<str>> {
    if description.size().parts > limits::REMOTE_PARTS {
        return None;
    }
    let description = AgentDescription {
        lease_time: None,
        ..description.clone()
    };
    let text = request::print(SlDialect::Standard, &description.to_term()).ok()?;
    let text = String::from_utf8(text).ok()?;
    (text.len() <= limits::REMOTE_BYTES).then(|| text.into())
}

/// Reads the description of a remote entry. Returns `None` if it is not valid, too large or that of
/// another agent.
pub(crate) fn read(now: PlatformTime, entry: &RemoteEntry) -> Option<AgentDescription> {
    if entry.text.len() > limits::REMOTE_BYTES {
        return None;
    }
    let read = |term: &Term<'_>| AgentDescription::from_term(term).ok();
    let mut description = read_object(entry.text.as_bytes(), read)?;
    description.check().ok()?;
    let is_agents = description
        .name
        .as_ref()
        .is_some_and(|name| *name.name() == *entry.name);
    if !is_agents || description.size().parts > limits::REMOTE_PARTS {
        return None;
    }
    description.lease_time = lease_time(now, entry);
    Some(description)
}

/// Returns the lease of a remote entry as a time of the clock of this host.
pub(crate) fn lease_time(now: PlatformTime, entry: &RemoteEntry) -> Option<Time> {
    let lease_left = entry.ends.saturating_duration_since(now.at);
    let ends = now
        .wall
        .checked_add(lease_left)
        .filter(|_| entry.has_lease)?;
    Time::from_system_time(ends).ok()
}
