//! The directory as the users of a domain see it: read-only.

use std::fmt;
use std::sync::Arc;

use fipa_sds::{Directory, Entry, Query, Source, Watch};
use fipa_transport::Incarnation;
#[cfg(feature = "protocols")]
use fipa_transport::PeerId;

/// A read-only view of the known agents and coalitions.
///
/// All methods are synchronous and cheap. A view cannot change registrations: an agent is
/// registered by [`Domain::register`](crate::Domain::register) and deregistered by its
/// [`Agent`](crate::Agent).
///
/// ```compile_fail,E0599
/// # async fn example(domain: fipa::Domain) {
/// let view = domain.directory();
/// if let Some(arm) = view.lookup("arm") {
///     view.deregister("arm", arm.incarnation);
/// }
/// # }
/// ```
#[derive(Clone, Copy)]
pub struct DirectoryView<'a>(&'a dyn Directory);

impl<'a> DirectoryView<'a> {
    pub(crate) fn of(directory: &'a dyn Directory) -> Self {
        Self(directory)
    }

    /// Returns the entry of exactly this name; patterns are not considered. On a miss, the files of
    /// the domain are read first.
    #[must_use]
    pub fn lookup(self, name: &str) -> Option<Arc<Entry>> {
        self.0.lookup(name)
    }

    /// Returns the entry of exactly this name from memory. A registration of the last moments may
    /// be missing.
    #[must_use]
    pub fn known(self, name: &str) -> Option<Arc<Entry>> {
        self.0.known(name)
    }

    /// Returns the entry of exactly this incarnation from memory.
    #[must_use]
    pub fn known_incarnation(self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.0.known_incarnation(incarnation)
    }

    /// Returns the entry of exactly this incarnation. On a miss, the files of the domain are read
    /// first.
    #[must_use]
    pub fn by_incarnation(self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.0.by_incarnation(incarnation)
    }

    /// Returns the entry of the agent of this name and registration whose letter `peer` handed to this host.
    #[cfg(feature = "protocols")]
    pub(crate) fn sender(
        self,
        incarnation: Incarnation,
        name: &str,
        peer: &PeerId,
    ) -> Option<Arc<Entry>> {
        self.0.sender(incarnation, name, peer)
    }

    /// Returns all known entries, sorted by name. Returns the same allocation until something
    /// changes.
    #[must_use]
    pub fn entries(self) -> Arc<[Arc<Entry>]> {
        self.0.entries()
    }

    /// Returns the known entries that match, sorted by name. Call [`refresh`](Self::refresh) first
    /// to include the latest changes of other processes.
    #[must_use]
    pub fn search(self, query: &Query) -> Vec<Arc<Entry>> {
        self.0.search(query)
    }

    /// Returns the last entry of the agent of this name whose host was connected within the last hour and is gone.
    /// The time of registration of the entry is the time when the host was last seen.
    #[must_use]
    pub fn lost_agent(self, name: &str) -> Option<Arc<Entry>> {
        let mut lost = self.0.view().lost_agents().into_iter();
        lost.find(|entry| *entry.name == *name && entry.source != Source::Contact)
    }

    /// Reads the latest changes of other processes.
    pub fn refresh(self) {
        self.0.refresh();
    }

    /// Returns a watch of later changes. For a complete picture, start the watch first and then
    /// read [`entries`](Self::entries); an entry that joined in between appears in both.
    #[must_use]
    pub fn watch(self) -> Watch {
        self.0.watch()
    }
}

impl fmt::Debug for DirectoryView<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.0.entries().iter()).finish()
    }
}
