//! The counters of this process, in a file that all processes of the domain on this host read.

use std::sync::Arc;

#[cfg(feature = "shm")]
use fipa_acl::ErrorChain;
#[cfg(feature = "web")]
use fipa_sds::HostCounts;
use fipa_sds::{HostDirectory, HostError};
#[cfg(feature = "shm")]
use fipa_transport::counts::Totals;
use fipa_transport::counts::{Counts, SharedCounts};
#[cfg(feature = "shm")]
use fipa_transport::log_limit;
#[cfg(feature = "shm")]
use fipa_transport_shm::CountsPage;

/// The place in which this process counts.
#[derive(Clone)]
pub(crate) enum Counting {
    /// A file that other processes read.
    #[cfg(feature = "shm")]
    Shown(Arc<CountsPage>),
    /// Memory of this process.
    Own(Arc<Counts>),
}

/// The error if a process cannot show its counters.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CountingError {
    #[error(transparent)]
    Directory(#[from] HostError),
    #[cfg(feature = "shm")]
    #[error("cannot map the file of the counters")]
    Map(#[source] std::io::Error),
}

impl Counting {
    /// Starts to count. If the file cannot be used, the process counts only for itself.
    pub(crate) fn start(host: &HostDirectory) -> Self {
        #[cfg(feature = "shm")]
        match Self::shown(host) {
            Ok(shown) => return shown,
            Err(error) => {
                log_limit::warn!(error = %ErrorChain(&error), "the letters of this process are not counted for metrics");
            }
        }
        #[cfg(not(feature = "shm"))]
        let _ = host;
        Self::Own(Arc::default())
    }

    #[cfg(feature = "shm")]
    fn shown(host: &HostDirectory) -> Result<Self, CountingError> {
        let file = host.create_counts(&Totals::default())?;
        let page = CountsPage::map(&file).map_err(CountingError::Map)?;
        Ok(Self::Shown(Arc::new(page)))
    }

    /// Shows the counters again after the directory was joined again.
    pub(crate) fn rejoin(&self, host: &HostDirectory) -> Result<(), CountingError> {
        match self {
            #[cfg(feature = "shm")]
            Self::Shown(page) => {
                let file = host.create_counts(&(**page).as_ref().totals())?;
                page.move_to(&file).map_err(CountingError::Map)
            }
            Self::Own(_) => {
                let _ = host;
                Ok(())
            }
        }
    }

    /// The counters, for those who count.
    pub(crate) fn shared(&self) -> SharedCounts {
        match self {
            #[cfg(feature = "shm")]
            Self::Shown(page) => Arc::clone(page) as SharedCounts,
            Self::Own(counts) => Arc::clone(counts) as SharedCounts,
        }
    }

    /// The counters of the processes of the domain on this host that show them, and of this one.
    #[cfg(feature = "web")]
    pub(crate) fn totals(&self, host: &HostDirectory) -> Result<HostCounts, HostError> {
        let mut sums = host.sum_counts()?;
        match self {
            #[cfg(feature = "shm")]
            Self::Shown(_) => {}
            Self::Own(counts) => sums.running.add(&counts.totals()),
        }
        Ok(sums)
    }
}

/// The protocols whose violations are counted apart: those of [`Library::standard`](fipa_monitor::Library::standard), in
/// its order.
#[cfg(feature = "protocols")]
static PROTOCOLS: std::sync::LazyLock<Vec<String>> = std::sync::LazyLock::new(|| {
    let standard = fipa_monitor::Library::standard();
    let names = standard.iter().map(|machine| machine.name().to_owned());
    names.take(OTHER).collect()
});

/// The number of all other protocols.
#[cfg(feature = "protocols")]
const OTHER: usize = fipa_transport::counts::PROTOCOLS - 1;

/// The number under which violations of this protocol count.
#[cfg(feature = "protocols")]
pub(crate) fn protocol_number(name: &str) -> usize {
    let found = PROTOCOLS.iter().position(|protocol| protocol == name);
    found.unwrap_or(OTHER)
}

/// The names of the protocols whose violations are counted, with their numbers.
#[cfg(all(feature = "protocols", feature = "web"))]
pub(crate) fn protocols() -> impl Iterator<Item = (usize, &'static str)> {
    let named = PROTOCOLS.iter().map(String::as_str).enumerate();
    named.chain([(OTHER, "other")])
}
