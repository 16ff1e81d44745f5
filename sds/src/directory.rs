//! The trait that every back end of the directory implements.

use std::sync::Arc;

use fipa_transport::{Forked, Incarnation, Mandate, PeerId};

use crate::{Entry, EntryError, Query, Registration, Snapshot, Subscriber, View, Watch};

/// A view of the known agents.
///
/// Every method is synchronous and cheap, and waits for no other process. Reading a known entry takes no
/// system call, except for an agent of another host in the [directory of the host](crate::HostDirectory), which
/// is read from an open file. On a miss, a back end with external storage reads that storage first.
pub trait Directory: Send + Sync {
    /// Returns the entry of this name from memory, without [`refresh`](Self::refresh).
    fn known(&self, name: &str) -> Option<Arc<Entry>>;

    /// Returns the entry of this incarnation from memory, without [`refresh`](Self::refresh).
    /// Always `None` for an unknown incarnation.
    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>>;

    /// Reads the changes of other processes, in back ends that are not notified of each change.
    fn refresh(&self) {}

    /// Returns the entry of exactly this name; patterns are not considered.
    fn lookup(&self, name: &str) -> Option<Arc<Entry>> {
        self.known(name).or_else(|| {
            self.refresh();
            self.known(name)
        })
    }

    /// Returns the entry of exactly this incarnation.
    fn by_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.known_incarnation(incarnation).or_else(|| {
            self.refresh();
            self.known_incarnation(incarnation)
        })
    }

    /// Returns the entry of this name and incarnation, also if another name holds the incarnation.
    fn registered_as(&self, incarnation: Incarnation, name: &str) -> Option<Arc<Entry>> {
        let holder = self.by_incarnation(incarnation);
        let holder = holder.filter(|holder| *holder.name == *name);
        let entry = holder.or_else(|| self.known(name))?;
        (entry.incarnation == incarnation).then_some(entry)
    }

    /// Returns the entry of the agent of this name and registration whose letter `peer` handed to this host.
    ///
    /// Other hosts choose the registrations that they announce. So the entry that holds the registration counts
    /// only if the peer may have announced it; otherwise the one that holds the name.
    fn sender(&self, incarnation: Incarnation, name: &str, peer: &PeerId) -> Option<Arc<Entry>> {
        let holder = self.by_incarnation(incarnation)?;
        if !holder.peer.is_proved_other_than(peer) {
            return Some(holder);
        }
        let named = self.known(name)?;
        let is_own = named.incarnation == incarnation && !named.peer.is_proved_other_than(peer);
        is_own.then_some(named)
    }

    /// Returns all known entries, sorted by name. Returns the same allocation until something
    /// changes.
    fn entries(&self) -> Arc<[Arc<Entry>]>;

    /// Returns the known entries that match, sorted by name. Call [`refresh`](Self::refresh) first
    /// to include the latest changes of other processes.
    fn search(&self, query: &Query) -> Vec<Arc<Entry>> {
        let entries = self.entries();
        let matching = entries.iter().filter(|entry| query.matches(entry));
        matching.cloned().collect()
    }

    /// Returns a number that changes whenever the directory or its [view](Self::view) changes. A
    /// change is complete when the number has changed.
    fn generation(&self) -> u64;

    /// Returns a view of the present entries that does not change. Takes no time in proportion to
    /// the number of entries in the back ends of this crate.
    fn view(&self) -> Arc<dyn View> {
        Arc::new(Snapshot::of(self.entries().iter()))
    }

    /// Sends every later change to this subscriber.
    fn subscribe(&self, subscriber: &Subscriber);

    /// Returns a watch of later changes. For a complete picture, start the watch first and then
    /// read [`entries`](Self::entries); an entry that joined in between appears in both.
    fn watch(&self) -> Watch {
        let (subscriber, watch) = Watch::new();
        self.subscribe(&subscriber);
        watch
    }

    /// Registers an agent, or updates its entry if it has the same name and incarnation.
    ///
    /// # Errors
    /// Fails when another agent has the name, the registration is not valid, or the back end cannot
    /// be written.
    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        let _ = registration;
        Err(RegisterError::ReadOnly)
    }

    /// Removes the registration of this name and incarnation that was made here.
    ///
    /// # Errors
    /// Fails when there is no such registration, or the back end cannot be written.
    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        let _ = (name, incarnation);
        Err(DeregisterError::ReadOnly)
    }

    /// Removes the registrations in `leaving`, then registers or updates those in `joining`. A
    /// failure of one does not affect the others.
    fn update(&self, leaving: &[(Arc<str>, Incarnation)], joining: Vec<Registration>) -> Updated {
        let removals = leaving
            .iter()
            .map(|(name, incarnation)| self.deregister(name, *incarnation));
        Updated {
            removed: removals.collect(),
            joined: joining.into_iter().map(|one| self.register(one)).collect(),
        }
    }

    /// Whether this back end is authoritative for the coalitions of the message transport service
    /// of this incarnation. A [merged view](crate::MergedDirectory) then takes them from here only:
    /// two back ends each report a merger atomically, but at different times, and a mix of both
    /// would show an intermediate state.
    fn speaks_for(&self, mts: Incarnation) -> bool {
        let _ = mts;
        false
    }

    /// Returns the agents for which the message transport service of this incarnation may speak, if
    /// this back end has a link that proves the service. Entries of that service in this back end
    /// are then proved. A [merged view](crate::MergedDirectory) prefers them to unproved entries,
    /// and hides entries of other back ends with this service that the mandate does not cover.
    fn mandate(&self, mts: Incarnation) -> Mandate {
        let _ = mts;
        Mandate::Unproved
    }
}

/// Results of an [update](Directory::update), in the order of its arguments.
#[derive(Debug)]
pub struct Updated {
    /// Results of the removals.
    pub removed: Vec<Result<(), DeregisterError>>,
    /// Results of the registrations.
    pub joined: Vec<Result<Arc<Entry>, RegisterError>>,
}

/// Error of [`Directory::register`].
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum RegisterError {
    /// Another agent has the name.
    #[error(
        "the name {:?} is taken by a registration of {}, at the message transport service {:?}; \
         choose another name or end that agent",
        holder.name,
        since(holder),
        holder.mts.shown()
    )]
    AlreadyRegistered {
        /// The entry that holds the name.
        holder: Arc<Entry>,
    },
    /// The registration is not valid.
    #[error("cannot register")]
    Invalid(#[from] EntryError),
    /// The registration to be removed in the same update was not made here.
    #[error("no agent {0:?} of this incarnation is registered here")]
    NotOurs(Arc<str>),
    /// There are too many registrations, or they are too large.
    #[error("the directory is full: {0}")]
    Full(String),
    /// The back end is read-only.
    #[error("this directory is read-only; agents cannot be registered in it")]
    ReadOnly,
    /// The back end has been closed.
    #[error("the directory has been closed")]
    Closed,
    /// This process is a forked child of the one that opened the directory.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// The back end could not be written.
    #[error("cannot register in the directory")]
    Failed(#[source] Arc<dyn std::error::Error + Send + Sync>),
}

/// Error of [`Directory::deregister`].
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum DeregisterError {
    /// This process has no such registration.
    #[error("no agent {0:?} of this incarnation is registered here")]
    NotRegistered(Arc<str>),
    /// The back end is read-only.
    #[error("this directory is read-only; agents cannot be deregistered from it")]
    ReadOnly,
    /// The back end has been closed, which removed its registrations.
    #[error("the directory has been closed")]
    Closed,
    /// This process is a forked child of the one that opened the directory.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// The back end could not be written.
    #[error("cannot deregister from the directory")]
    Failed(#[source] Arc<dyn std::error::Error + Send + Sync>),
}

fn since(holder: &Entry) -> String {
    match holder.registered.elapsed() {
        Ok(age) => format!("{} s ago", age.as_secs()),
        Err(_) => "a moment ahead of this clock".to_owned(),
    }
}
