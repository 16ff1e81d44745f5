//! Back ends that keep their entries in this process only.

use std::sync::Arc;
use std::time::SystemTime;

use fipa_transport::{Incarnation, Location, PeerId, Principal, Signature};

use crate::entry::{millis_of_time, time_of_millis};
use crate::table::Table;
use crate::{
    DeregisterError, Directory, Entry, EntryError, MtsId, Reach, RegisterError, Registration, Role,
    Source, Subscriber,
};

/// A directory of the agents of one process.
#[derive(Debug)]
pub struct MemoryDirectory {
    mts: MtsId,
    table: Table<()>,
}

impl MemoryDirectory {
    /// Creates an empty directory; this message transport service serves all its registrations.
    #[must_use]
    pub fn new(mts: MtsId) -> Self {
        Self {
            mts,
            table: Table::new(),
        }
    }
}

impl Directory for MemoryDirectory {
    reads_its_table!(viewed table);

    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        let entry = Arc::new(registration.into_entry(&self.mts, Source::Memory)?);
        match self.table.claim((), Arc::clone(&entry)) {
            Ok(()) => Ok(entry),
            Err(holder) => Err(RegisterError::AlreadyRegistered { holder }),
        }
    }

    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        if self.table.release((), name, incarnation) {
            Ok(())
        } else {
            Err(DeregisterError::NotRegistered(name.into()))
        }
    }
}

/// The peers in the configuration, for networks without discovery: gateways, and agents of legacy
/// peers; the signature of their locations distinguishes them.
///
/// The incarnation of a gateway stays unknown in this directory; other back ends learn it, and the
/// agents behind the gateway, after the first contact.
#[derive(Debug)]
pub struct StaticDirectory {
    table: Table<()>,
}

impl StaticDirectory {
    /// Creates a directory of these names, each with its locations in order of preference.
    ///
    /// # Errors
    /// Fails when a name is not valid or has too many locations.
    pub fn new<N: Into<Arc<str>>>(
        gateways: impl IntoIterator<Item = (N, Vec<Location>)>,
    ) -> Result<Self, EntryError> {
        let table = Table::new();
        let registered = time_of_millis(millis_of_time(SystemTime::now()));
        for (name, locations) in gateways {
            let name = name.into();
            let ours = |location: &Location| location.signature() == Signature::Frames;
            let role = if locations.iter().any(ours) {
                Role::Gateway
            } else {
                Role::Agent
            };
            let peer = PeerId::of(Principal::Unproved, locations.first());
            let entry = Entry {
                name: name.clone(),
                agent_type: String::new(),
                incarnation: Incarnation::UNKNOWN,
                locations,
                mts: MtsId::new(name, Incarnation::UNKNOWN),
                description: String::new(),
                registered,
                source: Source::Static,
                reach: Reach::Remote {
                    gateway: Incarnation::UNKNOWN,
                },
                peer,
                role,
            };
            entry.check()?;
            table.put((), Arc::new(entry));
        }
        Ok(Self { table })
    }
}

impl Directory for StaticDirectory {
    reads_its_table!(viewed table);
}
