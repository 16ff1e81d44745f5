//! The trait that every back end of the directory implements.

use std::sync::Arc;

use fipa_transport::{Forked, Incarnation, Mandate};

use crate::{Entry, EntryError, Query, Registration, Subscriber, Watch};

/// A view of who is there.
///
/// Every method is synchronous and cheap. Reading takes no system call as long as what is asked
/// for is known; a miss makes a back end whose truth lies elsewhere look there first.
pub trait Directory: Send + Sync {
    /// The entry of this name, as far as is known without looking any further.
    fn known(&self, name: &str) -> Option<Arc<Entry>>;

    /// The entry of this incarnation, as far as is known without looking any further. Always
    /// none for an unknown incarnation.
    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>>;

    /// Takes in what others have changed until now, where that is not told at once.
    fn refresh(&self) {}

    /// The entry of exactly this name, patterns not considered.
    fn lookup(&self, name: &str) -> Option<Arc<Entry>> {
        self.known(name).or_else(|| {
            self.refresh();
            self.known(name)
        })
    }

    /// The entry of exactly this incarnation.
    fn by_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.known_incarnation(incarnation).or_else(|| {
            self.refresh();
            self.known_incarnation(incarnation)
        })
    }

    /// All entries known, by name. The same memory as long as nothing changes.
    fn entries(&self) -> Arc<[Arc<Entry>]>;

    /// The known entries that match, by name. Who needs what others changed a moment ago calls
    /// [`refresh`](Self::refresh) first.
    fn search(&self, query: &Query) -> Vec<Arc<Entry>> {
        let entries = self.entries();
        let matching = entries.iter().filter(|entry| query.matches(entry));
        matching.cloned().collect()
    }

    /// A number that differs from an earlier one when something has changed in between.
    fn generation(&self) -> u64;

    /// Tells this subscriber of every change from now on.
    fn subscribe(&self, subscriber: &Subscriber);

    /// What changes from now on. Who wants the whole picture starts to watch first and reads
    /// [`entries`](Self::entries) then; what joined in between is told by both.
    fn watch(&self) -> Watch {
        let (subscriber, watch) = Watch::new();
        self.subscribe(&subscriber);
        watch
    }

    /// Registers an agent, or changes the entry when it has the same name and incarnation.
    ///
    /// # Errors
    /// When somebody else has the name, the registration is not valid, or the back end cannot be
    /// written.
    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        let _ = registration;
        Err(RegisterError::ReadOnly)
    }

    /// Removes the registration of this name and incarnation, made here.
    ///
    /// # Errors
    /// When there is none, or the back end cannot be written.
    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        let _ = (name, incarnation);
        Err(DeregisterError::ReadOnly)
    }

    /// Removes these, by name and incarnation, then registers or changes those. One that fails
    /// does not keep the others from it.
    fn update(&self, leaving: &[(Arc<str>, Incarnation)], joining: Vec<Registration>) -> Updated {
        let left = leaving
            .iter()
            .map(|(name, incarnation)| self.deregister(name, *incarnation));
        Updated {
            left: left.collect(),
            joined: joining.into_iter().map(|one| self.register(one)).collect(),
        }
    }

    /// Whether this back end knows better than others which coalitions there are at the message
    /// transport service of this incarnation. A [merged view](crate::MergedDirectory) then takes
    /// them from here only: of two that each tell a merger in one go, but not at the same moment,
    /// it would make one with a state in between.
    fn speaks_for(&self, mts: Incarnation) -> bool {
        let _ = mts;
        false
    }

    /// The agents that the message transport service of this incarnation may speak for, as far as
    /// this back end knows a link that proves it. What this back end tells of that service is proved.
    /// A [merged view](crate::MergedDirectory) prefers it to what is not, and leaves out entries of
    /// other back ends with this service that the mandate does not cover.
    fn mandate(&self, mts: Incarnation) -> Mandate {
        let _ = mts;
        Mandate::Unproved
    }
}

/// What became of the parts of an [update](Directory::update), in their order.
#[derive(Debug)]
pub struct Updated {
    /// Of those that were to be removed.
    pub left: Vec<Result<(), DeregisterError>>,
    /// Of those that were to be registered.
    pub joined: Vec<Result<Arc<Entry>, RegisterError>>,
}

/// Why an agent was not registered.
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum RegisterError {
    /// Somebody else has the name.
    #[error(
        "the name {:?} is taken by a registration of {}, at the message transport service {:?}; \
         choose another name or end that agent",
        holder.name,
        since(holder),
        holder.mts.name
    )]
    AlreadyRegistered {
        /// Who has it.
        holder: Arc<Entry>,
    },
    /// The registration is not valid.
    #[error("cannot register: {0}")]
    Invalid(#[from] EntryError),
    /// What was to be removed in the same go was not registered here.
    #[error("nothing named {0:?} of this incarnation is registered here")]
    NotOurs(Arc<str>),
    /// There are too many registrations, or they are too large.
    #[error("the directory is full: {0}")]
    Full(String),
    /// The back end only reads.
    #[error("agents cannot be registered in this directory")]
    ReadOnly,
    /// The back end has been closed.
    #[error("the directory has been closed")]
    Closed,
    /// This process is a forked child of the one that opened the directory.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// The back end could not be written.
    #[error("cannot register in the directory: {0}")]
    Failed(Arc<dyn std::error::Error + Send + Sync>),
}

/// Why a registration was not removed.
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum DeregisterError {
    /// This process has no such registration.
    #[error("no agent {0:?} of this incarnation is registered here")]
    NotRegistered(Arc<str>),
    /// The back end only reads.
    #[error("agents cannot be deregistered in this directory")]
    ReadOnly,
    /// The back end has been closed, and its registrations with it.
    #[error("the directory has been closed")]
    Closed,
    /// This process is a forked child of the one that opened the directory.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// The back end could not be written.
    #[error("cannot deregister from the directory: {0}")]
    Failed(Arc<dyn std::error::Error + Send + Sync>),
}

fn since(holder: &Entry) -> String {
    match holder.registered.elapsed() {
        Ok(age) => format!("{} s ago", age.as_secs()),
        Err(_) => "a moment ahead of this clock".to_owned(),
    }
}
