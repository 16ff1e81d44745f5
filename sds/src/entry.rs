//! Entries of the directory, and the data that an owner supplies on registration.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use fipa_acl::Time;
use fipa_transport::{Incarnation, Location, PeerId};
use serde::ser::SerializeMap as _;
use serde::{Deserialize, Serialize, Serializer};

use crate::{Members, NameError, check_name, reserved_for};

/// The known data of one registration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// The agent's name, unique in the directory (see [`check_name`]).
    pub name: Arc<str>,
    /// Kind of agent, as free text of its owner; may be empty.
    pub agent_type: String,
    /// Incarnation of this registration; unknown when it was learned from a peer without
    /// incarnations.
    pub incarnation: Incarnation,
    /// Locations of the agent in order of preference, each with the incarnation of the message
    /// transport service that listens there.
    pub locations: Vec<Location>,
    /// The message transport service that delivers to the agent.
    pub mts: MtsId,
    /// Free text of its owner; may be empty.
    pub description: String,
    /// Time of registration, by the clock of the host on which the agent was registered, in whole
    /// milliseconds.
    pub registered: SystemTime,
    /// Origin of this entry.
    pub source: Source,
    /// Whether the agent is on this host.
    pub reach: Reach,
    /// The party that announced it, which has one share of each bound.
    pub peer: PeerId,
    /// Role: agent, gateway or coalition.
    pub role: Role,
}

/// As a JSON object: `name`, `type`, `description`, `role` (`agent`, `gateway` or `coalition`), `reach` (`local` or
/// `remote`), `locations` as URLs, `mts`, `incarnation`, `registered` (RFC 3339), `source`; for a coalition also
/// `members`, `leader` and `vacant`.
impl Serialize for Entry {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let coalition = match &self.role {
            Role::Coalition(members) => Some(members),
            Role::Agent | Role::Gateway => None,
        };
        let role = match &self.role {
            Role::Agent => "agent",
            Role::Gateway => "gateway",
            Role::Coalition(_) => "coalition",
        };
        let reach = match self.reach {
            Reach::Local => "local",
            Reach::Remote { .. } => "remote",
        };
        let locations: Vec<String> = self.locations.iter().map(ToString::to_string).collect();
        let registered = Time::from_system_time(self.registered).ok();
        let mut object = serializer.serialize_map(None)?;
        object.serialize_entry("name", &self.name)?;
        object.serialize_entry("type", &self.agent_type)?;
        object.serialize_entry("description", &self.description)?;
        object.serialize_entry("role", role)?;
        object.serialize_entry("reach", reach)?;
        object.serialize_entry("locations", &locations)?;
        object.serialize_entry("mts", &self.mts)?;
        object.serialize_entry("incarnation", &self.incarnation)?;
        object.serialize_entry("registered", &registered.and_then(Time::to_rfc3339))?;
        object.serialize_entry("source", &self.source)?;
        if let Some(members) = coalition {
            object.serialize_entry("members", members.names())?;
            object.serialize_entry("leader", &members.leader())?;
            object.serialize_entry("vacant", &members.is_vacant())?;
        }
        object.end()
    }
}

impl Entry {
    /// Maximum number of locations of one entry.
    pub const MAX_LOCATIONS: usize = 8;
    /// Maximum length of the type, in bytes.
    pub const MAX_TYPE: usize = 255;
    /// Maximum length of the description, in bytes.
    pub const MAX_DESCRIPTION: usize = 1024;

    /// Whether this entry takes the name from `other`, which was known before.
    ///
    /// Entries of this host precede entries from the network: a record on the network must not be able
    /// to cut a host's own traffic. A [contact](Source::Contact) precedes no entry of a directory. Of
    /// two entries of this host the earlier registration precedes. Of equal entries of other hosts, the
    /// first known one keeps the name: their times are those of other clocks.
    #[must_use]
    pub fn precedes(&self, other: &Self) -> bool {
        self.rank() < other.rank()
    }

    pub(crate) fn rank(&self) -> impl Ord + use<> {
        let remote = self.reach != Reach::Local;
        let contact = self.source == Source::Contact;
        let age = (!remote).then_some((self.registered, self.incarnation));
        (remote, contact, age)
    }

    /// Type of the agent management system of a gateway (FIPA00023).
    pub const AMS_TYPE: &str = "fipa-ams";
    /// Type of the directory facilitator of a gateway (FIPA00023).
    pub const DF_TYPE: &str = "fipa-df";

    /// Type of the agent of a gateway that records letters.
    pub const RECORDER_TYPE: &str = "fipa-recorder";

    /// Whether the entry is that of an agent of a gateway, by its type: an agent management system, a directory
    /// facilitator or a recorder.
    /// Patterns do not match it: `.*` addresses the agents of robots.
    #[must_use]
    pub fn is_platform_agent(&self) -> bool {
        let agent_type = self.agent_type.as_str();
        let types = [Self::AMS_TYPE, Self::DF_TYPE, Self::RECORDER_TYPE];
        self.role == Role::Agent && types.contains(&agent_type)
    }

    /// Whether the entry has locations, and all of them use transports that this project does not
    /// support.
    #[must_use]
    pub fn is_unsupported(&self) -> bool {
        let supported = |location: &Location| location.kind().is_supported();
        !self.locations.is_empty() && !self.locations.iter().any(supported)
    }

    /// Whether it is the entry of the gateway of this host.
    #[must_use]
    pub fn is_own_gateway(&self) -> bool {
        self.role == Role::Gateway && self.reach == Reach::Local
    }

    /// Whether the agent is known by a letter or an introduction only, and has no registration: an agent of a
    /// platform such as JADE.
    #[must_use]
    pub fn is_unregistered_contact(&self) -> bool {
        self.source == Source::Contact && !self.incarnation.is_known()
    }

    /// Whether the entry is that of an agent of a platform without a gateway of this project, such as
    /// JADE, by the configuration or a letter. It precedes no entry of the gateway that its name may
    /// be [reserved](reserved_for) for, except by the configuration.
    fn is_of_legacy_platform(&self) -> bool {
        matches!(self.source, Source::Static | Source::Contact) && !self.mts.incarnation.is_known()
    }

    /// Checks what every back end relies on: the limits, and that a name that is [reserved for a
    /// gateway](reserved_for) is claimed by a gateway of that name.
    ///
    /// # Errors
    /// Returns the first rule that the entry violates.
    pub fn check(&self) -> Result<(), EntryError> {
        check_name(&self.name)?;
        if let Some(mts) = &self.mts.name {
            check_name(mts).map_err(EntryError::MtsName)?;
        }
        check_text("type", &self.agent_type, Self::MAX_TYPE)?;
        check_text("description", &self.description, Self::MAX_DESCRIPTION)?;
        if self.locations.len() > Self::MAX_LOCATIONS {
            return Err(EntryError::TooManyLocations(self.locations.len()));
        }
        match reserved_for(&self.name) {
            Some(gateway)
                if self.mts.name.as_deref() != Some(gateway) && !self.is_of_legacy_platform() =>
            {
                Err(EntryError::Reserved(gateway.to_owned()))
            }
            _ => Ok(()),
        }
    }
}

fn check_text(field: &'static str, text: &str, max: usize) -> Result<(), EntryError> {
    if text.len() > max {
        return Err(EntryError::TooLong {
            field,
            len: text.len(),
            max,
        });
    }
    if text.chars().any(char::is_control) {
        return Err(EntryError::Control { field });
    }
    Ok(())
}

/// A message transport service: the process that accepts letters for an agent, or a gateway.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct MtsId {
    /// Name that the service states; several services may have the same name. Absent for a service that
    /// is only known from its address, which is not a name.
    pub name: Option<Arc<str>>,
    /// Incarnation of the service; unknown for a peer without incarnations.
    pub incarnation: Incarnation,
}

impl MtsId {
    /// Creates a service with this name and incarnation.
    #[must_use]
    pub fn new(name: impl Into<Arc<str>>, incarnation: Incarnation) -> Self {
        Self {
            name: Some(name.into()),
            incarnation,
        }
    }

    /// Creates a service with this incarnation that has not stated its name.
    #[must_use]
    pub fn unnamed(incarnation: Incarnation) -> Self {
        Self {
            name: None,
            incarnation,
        }
    }

    /// Returns the name for texts that people read.
    #[must_use]
    pub fn shown(&self) -> &str {
        self.name.as_deref().unwrap_or("(unknown)")
    }
}

/// Origin of an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Source {
    /// Registered in this process.
    Memory,
    /// Written in the configuration.
    Static,
    /// Reported by a process of this host.
    Host,
    /// Announced on the network.
    Mdns,
    /// Received from the gateway of another host, in a letter.
    Exchange,
    /// Learned from a letter that the agent sent.
    Contact,
}

/// Reach of an agent: on this host or behind a gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Reach {
    /// On this host; letters go to it directly.
    Local,
    /// Behind a gateway.
    Remote {
        /// The gateway that accepts letters for the agent: this host's own gateway if it published
        /// the entry, else the peer itself. Unknown for a peer without incarnations.
        gateway: Incarnation,
    },
}

/// Role of an entry.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Role {
    /// An agent that sends and receives letters.
    #[default]
    Agent,
    /// A message transport service that forwards letters for agents. Patterns do not match it.
    Gateway,
    /// A name that stands for these agents, or for their leader. Patterns match its members, not
    /// the coalition.
    Coalition(Members),
}

/// Data that the owner of an agent supplies on registration.
///
/// Registering again with the same name and incarnation updates the entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Registration {
    /// See [`Entry::name`].
    pub name: Arc<str>,
    /// See [`Entry::agent_type`].
    pub agent_type: String,
    /// See [`Entry::incarnation`].
    pub incarnation: Incarnation,
    /// See [`Entry::locations`].
    pub locations: Vec<Location>,
    /// See [`Entry::description`].
    pub description: String,
    /// See [`Entry::registered`]; truncated to whole milliseconds.
    pub registered: SystemTime,
    /// See [`Entry::role`].
    pub role: Role,
}

impl Registration {
    /// Creates a registration, with the current time, of an agent without type and description.
    #[must_use]
    pub fn new(
        name: impl Into<Arc<str>>,
        incarnation: Incarnation,
        locations: Vec<Location>,
    ) -> Self {
        Self {
            name: name.into(),
            agent_type: String::new(),
            incarnation,
            locations,
            description: String::new(),
            registered: SystemTime::now(),
            role: Role::Agent,
        }
    }

    /// Converts this registration to an entry of a local service.
    pub(crate) fn into_entry(self, mts: &MtsId, source: Source) -> Result<Entry, EntryError> {
        if !self.incarnation.is_known() {
            return Err(EntryError::NoIncarnation);
        }
        let entry = Entry {
            name: self.name,
            agent_type: self.agent_type,
            incarnation: self.incarnation,
            locations: self.locations,
            mts: mts.clone(),
            description: self.description,
            registered: time_of_millis(millis_of_time(self.registered)),
            source,
            reach: Reach::Local,
            peer: PeerId::THIS_HOST,
            role: self.role,
        };
        entry.check()?;
        Ok(entry)
    }
}

/// Error of [`Entry::check`] and of a registration.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EntryError {
    /// The name of the agent is not valid.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The name of the message transport service is not valid.
    #[error("the name of the message transport service is not valid")]
    MtsName(#[source] NameError),
    /// A text is too long.
    #[error("the {field} has {len} bytes; at most {max} are allowed")]
    TooLong {
        /// Name of the field.
        field: &'static str,
        /// Its length in bytes.
        len: usize,
        /// The limit.
        max: usize,
    },
    /// A text has control characters.
    #[error("the {field} has control characters; remove them")]
    Control {
        /// Name of the field.
        field: &'static str,
    },
    /// The entry has more than [`Entry::MAX_LOCATIONS`] locations.
    #[error("{0} locations; at most {max} are allowed", max = Entry::MAX_LOCATIONS)]
    TooManyLocations(usize),
    /// The name is [reserved](reserved_for) for another gateway.
    #[error(
        "the name is reserved for an agent of the gateway {0:?}; choose a name that does not begin with \
         ams@ or df@"
    )]
    Reserved(String),
    /// A registration has no incarnation.
    #[error("a registration needs an incarnation (draw one with Incarnation::random)")]
    NoIncarnation,
}

/// Milliseconds since 1970, UTC; 0 for earlier times, at most [`MAX_MILLIS`].
pub(crate) fn millis_of_time(time: SystemTime) -> u64 {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis())
        .unwrap_or(MAX_MILLIS)
        .min(MAX_MILLIS)
}

/// Milliseconds from 1970 to the year 9999, the last year that RFC 3339 can represent.
const MAX_MILLIS: u64 = 253_370_764_800_000;

/// The time `millis` milliseconds after 1970, UTC; at most [`MAX_MILLIS`].
pub(crate) fn time_of_millis(millis: u64) -> SystemTime {
    UNIX_EPOCH + Duration::from_millis(millis.min(MAX_MILLIS))
}
