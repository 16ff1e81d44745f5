//! Keeps a process in its domain when another program removes the runtime directory, as cleaners of
//! `/tmp` do.

use std::sync::{Arc, Weak};
use std::time::Duration;

use fipa_sds::{HostDirectory, HostError};
use fipa_transport_net::{UnixError, UnixTransport};
#[cfg(feature = "shm")]
use fipa_transport_shm::{ShmError, ShmTransport};
use tokio::time::{Instant, sleep, sleep_until};

use crate::place::{Place, PlaceError};

/// Time between two looks for files that were removed. Mostly the kernel reports a removal at once.
const CHECK_EVERY: Duration = Duration::from_secs(5);

/// Time before joining is tried again.
const RETRY_AFTER: Duration = Duration::from_millis(500);

/// Time between two renewals of timestamps: far less than any cleaner's age.
const RENEW_EVERY: Duration = Duration::from_secs(24 * 60 * 60);

/// What a process has in the runtime directory of its domain.
#[derive(Clone)]
pub(crate) struct Keeper {
    pub(crate) place: Place,
    pub(crate) host: Arc<HostDirectory>,
    #[cfg(feature = "shm")]
    pub(crate) shm: Option<Weak<ShmTransport>>,
    pub(crate) unix: Option<Weak<UnixTransport>>,
}

/// Why a domain could not be joined again.
#[derive(Debug, thiserror::Error)]
enum RejoinError {
    #[error(transparent)]
    Place(#[from] PlaceError),
    #[error(transparent)]
    Directory(#[from] HostError),
    #[cfg(feature = "shm")]
    #[error(transparent)]
    Shm(#[from] ShmError),
    #[error(transparent)]
    Unix(#[from] UnixError),
}

impl Keeper {
    pub(crate) fn new(place: Place, host: Arc<HostDirectory>) -> Self {
        Self {
            place,
            host,
            #[cfg(feature = "shm")]
            shm: None,
            unix: None,
        }
    }

    /// Works until it is aborted.
    pub(crate) async fn run(mut self) {
        let mut renewal = Instant::now() + RENEW_EVERY;
        // What was logged last, so that a trouble is logged once.
        let mut trouble: Option<String> = None;
        loop {
            let pause = match trouble {
                Some(_) => RETRY_AFTER,
                None => CHECK_EVERY,
            };
            tokio::select! {
                () = self.host.disturbed(), if trouble.is_none() => {}
                () = sleep(pause) => {}
                () = sleep_until(renewal) => {
                    renewal = Instant::now() + RENEW_EVERY;
                    let place = self.place.clone();
                    // Many files, perhaps on a slow card.
                    let _ = tokio::task::spawn_blocking(move || place.renew()).await;
                    continue;
                }
            }
            if self.is_there() {
                trouble = None;
                continue;
            }
            if trouble.is_none() {
                tracing::warn!(
                    "files in {} were removed by another program; joining the domain again (exempt \
                     the directory from cleaning, or name another one in FIPA_RUNTIME_DIR)",
                    self.place.path().display()
                );
                trouble = Some(String::new());
            }
            let mut keeper = self.clone();
            let joining = tokio::task::spawn_blocking(move || keeper.rejoin().map(|()| keeper));
            match joining.await {
                Ok(Ok(keeper)) => {
                    self = keeper;
                    trouble = None;
                    tracing::info!("joined the domain in {} again", self.place.path().display());
                }
                Ok(Err(error)) => {
                    let text = error.to_string();
                    if trouble.as_ref() != Some(&text) {
                        tracing::error!(%error, "cannot join the domain again; retrying");
                    }
                    trouble = Some(text);
                }
                // The runtime ends.
                Err(_) => return,
            }
        }
    }

    /// Whether other processes find what this one has there. What cannot be examined counts as
    /// there.
    fn is_there(&self) -> bool {
        let host = self.host.is_there().unwrap_or(true);
        #[cfg(feature = "shm")]
        let shm = self.shm().is_none_or(|shm| shm.is_there());
        #[cfg(not(feature = "shm"))]
        let shm = true;
        let unix = self.unix().is_none_or(|unix| unix.is_there());
        self.place.is_there() && host && shm && unix
    }

    fn rejoin(&mut self) -> Result<(), RejoinError> {
        self.place.rejoin()?;
        self.host.rejoin()?;
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
