//! Maintains a process's files in the directory of its domain: renews their timestamps, and joins
//! the domain again if another program removes the directory, as cleaners of `/tmp` do. Also logs the
//! numbers of log lines that were omitted meanwhile.

use std::sync::{Arc, Weak};
use std::time::Duration;

use fipa_acl::ErrorChain;
use fipa_sds::{HostDirectory, HostError};
use fipa_transport::log_limit;
use fipa_transport_net::{UnixError, UnixTransport};
#[cfg(feature = "shm")]
use fipa_transport_shm::{ShmError, ShmTransport};
use tokio::runtime::Handle;
use tokio::time::{Instant, sleep, sleep_until};

use crate::domain::background::{self, BackgroundError};
use crate::domain::counting::{Counting, CountingError};
use crate::domain::files::{DomainDir, DomainDirError};

/// Time between two checks for removed files while the kernel reports no removals.
const CHECK_EVERY: Duration = Duration::from_secs(5);

/// Time between two checks for removed files while the kernel reports removals. It does not report the
/// removal of a level above the domains.
const WATCHED_CHECK_EVERY: Duration = Duration::from_secs(60);

/// Time in which removals are collected.
const GATHERING: Duration = Duration::from_millis(20);

/// Time between two attempts to join again.
const RETRY_AFTER: Duration = Duration::from_millis(500);

/// Time between two attempts to renew timestamps, which do nothing while the timestamps are young. If a program sets the
/// clock of a host that has started in 1970, all files are old at once, and a cleaner can run minutes later.
const RENEW_EVERY: Duration = Duration::from_secs(10 * 60);

/// The parts of a process that have files in the directory of its domain.
#[derive(Clone)]
pub(crate) struct DirMaintenance {
    pub(crate) dir: DomainDir,
    pub(crate) host: Arc<HostDirectory>,
    /// The place in which the process counts, unless it is only a tool.
    counting: Option<Counting>,
    #[cfg(feature = "shm")]
    pub(crate) shm: Option<Weak<ShmTransport>>,
    pub(crate) unix: Option<Weak<UnixTransport>>,
}

/// The error if a domain cannot be joined again.
#[derive(Debug, thiserror::Error)]
enum RejoinError {
    #[error(transparent)]
    DomainDir(#[from] DomainDirError),
    #[error(transparent)]
    Directory(#[from] HostError),
    #[error(transparent)]
    Counting(#[from] CountingError),
    #[cfg(feature = "shm")]
    #[error(transparent)]
    Shm(#[from] ShmError),
    #[error(transparent)]
    Unix(#[from] UnixError),
    #[error(transparent)]
    Background(#[from] BackgroundError),
}

impl DirMaintenance {
    pub(crate) fn new(
        dir: DomainDir,
        host: Arc<HostDirectory>,
        counting: Option<Counting>,
    ) -> Self {
        Self {
            dir,
            host,
            counting,
            #[cfg(feature = "shm")]
            shm: None,
            unix: None,
        }
    }

    /// Runs until it is aborted.
    pub(crate) async fn run(mut self) {
        let mut renewal = Instant::now() + RENEW_EVERY;
        // The last logged problem, so that each problem is logged once.
        let mut problem: Option<String> = None;
        loop {
            log_limit::report_omitted();
            // Watched before the check, so that no removal is missed.
            let watched = self.watch();
            let Some(missing) = self.missing() else {
                problem = None;
                let pause = match watched {
                    true => WATCHED_CHECK_EVERY,
                    false => CHECK_EVERY,
                };
                tokio::select! {
                    // A program that removes one file will often remove others.
                    () = self.host.disturbed() => sleep(GATHERING).await,
                    () = sleep(pause) => {}
                    () = sleep_until(renewal) => {
                        renewal = Instant::now() + RENEW_EVERY;
                        let dir = self.dir.clone();
                        // There may be many files on a slow SD card.
                        let runtime = Handle::current();
                        let renewed = background::run(&runtime, move |_| dir.renew());
                        if let Err(error) = renewed.await {
                            log_limit::warn!(%error, "cannot renew the timestamps of {}", self.dir.path().display());
                        }
                    }
                }
                continue;
            };
            // A service that closes aborts this task before it removes the files itself. The abort takes
            // effect here.
            tokio::task::yield_now().await;
            if problem.is_some() {
                sleep(RETRY_AFTER).await;
            } else {
                log_limit::warn!(
                    missing,
                    "another program removed files in {}; joining the domain again (exempt the \
                     directory from cleaning, or set FIPA_RUNTIME_DIR to another one)",
                    self.dir.path().display()
                );
                problem = Some(String::new());
            }
            let mut joining = self.clone();
            let runtime = Handle::current();
            let joined = background::run(&runtime, move |_| joining.rejoin().map(|()| joining));
            match joined.await.unwrap_or_else(|error| Err(error.into())) {
                Ok(joined) => {
                    self = joined;
                    log_limit::info!("joined the domain in {} again", self.dir.path().display());
                }
                // The runtime is shutting down.
                Err(RejoinError::Background(BackgroundError::Ended)) => return,
                Err(error) => {
                    let text = ErrorChain(&error).to_string();
                    if problem.as_ref() != Some(&text) {
                        log_limit::error!(error = text, "cannot join the domain again; retrying");
                    }
                    problem = Some(text);
                }
            }
        }
    }

    /// Makes the kernel report the removal of the files. Returns whether it does.
    fn watch(&self) -> bool {
        let mut files = Vec::from(self.dir.levels());
        #[cfg(feature = "shm")]
        files.extend(self.shm().iter().flat_map(|shm| shm.files()));
        files.extend(self.unix().and_then(|unix| unix.socket_path()));
        self.host.watch_files(&files).is_ok()
    }

    /// Returns which files of this process are missing, if any are. A file that cannot be examined
    /// counts as existing.
    fn missing(&self) -> Option<&'static str> {
        if !self.dir.is_there() {
            return Some("the directory of the domain");
        }
        if !self.host.is_there().unwrap_or(true) {
            return Some("entries of agents");
        }
        #[cfg(feature = "shm")]
        if self.shm().is_some_and(|shm| !shm.is_there()) {
            return Some("shared memory");
        }
        if self.unix().is_some_and(|unix| !unix.is_there()) {
            return Some("the Unix socket");
        }
        None
    }

    fn rejoin(&mut self) -> Result<(), RejoinError> {
        self.dir.rejoin()?;
        if self.host.rejoin()?
            && let Some(counting) = &self.counting
        {
            counting.rejoin(&self.host)?;
        }
        #[cfg(feature = "shm")]
        if let Some(shm) = self.shm() {
            shm.rejoin()?;
        }
        if let Some(unix) = self.unix() {
            unix.rejoin()?;
        }
        Ok(())
    }

    fn unix(&self) -> Option<Arc<UnixTransport>> {
        self.unix.as_ref()?.upgrade()
    }

    #[cfg(feature = "shm")]
    fn shm(&self) -> Option<Arc<ShmTransport>> {
        self.shm.as_ref()?.upgrade()
    }
}
