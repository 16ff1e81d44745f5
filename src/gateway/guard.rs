//! The guard reads the gateway's keys when the gateway opens, and again when their directory
//! changes.

use std::ffi::OsStr;
use std::path::Path;
use std::time::{Duration, SystemTime};

use fipa_acl::ErrorChain;
use fipa_transport::log_limit;
use fipa_transport_net::secure::{Credentials, KeyLog, Rules, Security};
use tokio::runtime::Handle;

use crate::admin::keys::{Holding, Keys, Stamp, Whose};
use crate::config;
use crate::domain::background::{self, BackgroundError};
use crate::error::OpenError;

/// Interval between checks for changed keys. A check makes three system calls.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// Environment variable with the path of the key log, the same as of other programs with TLS.
const KEY_LOG_VARIABLE: &str = "SSLKEYLOGFILE";

/// Makes the transports write their secrets to this file.
fn log_keys(security: &Security, path: Option<&OsStr>) -> Result<(), OpenError> {
    let Some(path) = path.filter(|path| !path.is_empty()) else {
        log_limit::warn!(
            "security.key_log is true, but the environment variable {KEY_LOG_VARIABLE} is not set; no secrets are \
             written; set it to the path of a file"
        );
        return Ok(());
    };
    let path = Path::new(path);
    let key_log = KeyLog::append_to(path).map_err(OpenError::KeyLog)?;
    let logging = security.log_keys(key_log);
    logging.map_err(|error| OpenError::Keys(error.into()))?;
    log_limit::warn!(
        path = %path.display(),
        "the secrets of TLS connections are written to the key log: everyone who reads this file can decrypt captured \
         letters; remove security.key_log and the file after the capture"
    );
    Ok(())
}

/// Logs the certificates that are not valid or expire soon.
fn warn_about_expiry(credentials: &Credentials) {
    let now = SystemTime::now();
    let warning = |certificate, whose| {
        let holding = Holding::at(now, certificate);
        Some((holding.problem()?, holding.advice(now, whose)?))
    };
    if let Some((what, advice)) = warning(&credentials.own, Whose::Own) {
        log_limit::warn!(
            "the certificate of this host {what}; peers refuse a host without a valid certificate; {advice}"
        );
    }
    for trusted in &credentials.trusted {
        if let Some((what, advice)) = warning(trusted, Whose::Peer) {
            let peer = trusted.certified().mts();
            log_limit::warn!("the certificate of {peer} {what}; {advice}");
        }
    }
}

/// Applies the changes in the directory of the keys to a running gateway.
#[derive(Clone)]
pub(super) struct Guard {
    keys: Keys,
    name: String,
    security: Security,
    seen: Stamp,
    /// Whether the keys may have changed after `seen` was read without changing it.
    fresh: bool,
    /// The error of the last attempt to use the keys, if it failed.
    fault: Option<String>,
}

impl Guard {
    /// Reads the keys that the configuration names. Returns `None` if it names none.
    pub(super) fn open(config: &config::Security, name: &str) -> Result<Option<Self>, OpenError> {
        if config.keys.is_empty() {
            return Ok(None);
        }
        let keys = Keys::at(&config.keys);
        let seen = keys.stamp();
        let credentials = keys.credentials_of(name);
        let credentials = credentials.map_err(OpenError::Keys)?;
        warn_about_expiry(&credentials);
        let rules = Rules {
            loopback: config.loopback,
            legacy_peers: config.legacy_peers.clone(),
        };
        let security = Security::new(credentials, rules);
        let security = security.map_err(|error| OpenError::Keys(error.into()))?;
        if config.key_log {
            log_keys(&security, std::env::var_os(KEY_LOG_VARIABLE).as_deref())?;
        }
        Ok(Some(Self {
            keys,
            name: name.to_owned(),
            security,
            fresh: seen.is_fresh(),
            seen,
            fault: None,
        }))
    }

    /// Returns the security of the transports, which follows changes of the keys.
    pub(super) fn security(&self) -> Security {
        self.security.clone()
    }

    /// Checks the keys at regular intervals, for as long as the future is polled. Calls `changed` after each
    /// change of the trusted certificates.
    pub(super) async fn run(mut self, changed: Box<dyn Fn(&Security) + Send>) {
        let mut interval = tokio::time::interval(CHECK_INTERVAL);
        loop {
            interval.tick().await;
            let revision = self.security.revision();
            let guard = self.clone();
            let runtime = Handle::current();
            let checked = background::try_run(&runtime, move |_| guard.checked());
            self = match checked.await {
                Ok(guard) => guard,
                Err(BackgroundError::Ended) => return,
                Err(error) => {
                    log_limit::error!(%error, "cannot check the keys for changes; trying again");
                    continue;
                }
            };
            if self.security.revision() != revision {
                changed(&self.security);
            }
        }
    }

    /// Applies changes of the keys. After an error the keys are read again at every check, because
    /// a repair may leave the change times of the directory as they are.
    fn checked(mut self) -> Self {
        let now = self.keys.stamp();
        let changed = now != self.seen;
        if !changed && !self.fresh && self.fault.is_none() {
            return self;
        }
        self.fresh = now.is_fresh();
        let used = self.keys.credentials_of(&self.name);
        let used = used
            .and_then(|credentials| {
                let count = credentials.trusted.len();
                if changed {
                    warn_about_expiry(&credentials);
                }
                let replaced = self.security.replace(credentials);
                Ok(replaced.map(|()| count)?)
            })
            .map_err(|error| ErrorChain(&error).to_string());
        self.seen = now;
        match used {
            Ok(count) => {
                let repaired = self.fault.take().is_some();
                if changed || repaired {
                    log_limit::info!(trusted = count, "the keys were read again");
                }
            }
            Err(error) => {
                self.keep_confirmed(&error);
                self.fault = Some(error);
            }
        }
        self
    }

    /// Restricts trust to the certificates that can still be read. The keys have changed but cannot
    /// be used as a whole, and the change may revoke a certificate. The gateway's own key stays in
    /// use, because without a key the gateway cannot reach any peer.
    fn keep_confirmed(&self, error: &str) {
        let (confirmed, _) = self.keys.confirmed();
        let count = confirmed.len();
        let revoked = self.keys.readable_revoked();
        let restricted = self.security.trust_only(confirmed, revoked);
        if self.fault.as_deref() == Some(error) {
            return;
        }
        match restricted {
            Ok(()) => log_limit::error!(
                trusted = count,
                "cannot use the changed keys: {error}; until this is repaired, only peers whose \
                 certificates can be read are trusted (see `fipa keys list`)"
            ),
            Err(cause) => log_limit::error!(
                "cannot use the changed keys: {error}; cannot restrict trust to the readable \
                 certificates: {}",
                ErrorChain(&cause)
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::admin::keys::{Certificate, VALID};

    /// Keys that trust two peers, and their guard.
    struct Scene {
        keys: Keys,
        guard: Option<Guard>,
        peers: [Certificate; 2],
        _dir: tempfile::TempDir,
    }

    impl Scene {
        fn new() -> Self {
            let dir = tempfile::tempdir().unwrap();
            let keys = Keys::at(dir.path().join("own"));
            keys.init("rover-mts", &[], VALID).unwrap();
            let peers = ["crex-mts", "sherpa-mts"].map(|name| {
                let peer = Keys::at(dir.path().join(name));
                peer.init(name, &[], VALID).unwrap();
                let trusted = keys.trust(&fs::read(peer.own_file()).unwrap()).unwrap();
                trusted[0].clone()
            });
            let config = config::Security {
                keys: keys.dir().display().to_string(),
                ..crate::Config::for_host("rover").security
            };
            let guard = Guard::open(&config, "rover-mts").unwrap();
            Self {
                keys,
                guard,
                peers,
                _dir: dir,
            }
        }

        fn trusts(&mut self) -> [bool; 2] {
            let guard = self.guard.take().unwrap().checked();
            let security = guard.security();
            self.guard = Some(guard);
            [0, 1].map(|peer: usize| security.trusts(self.peers[peer].fingerprint()))
        }

        fn file(&self, peer: usize) -> std::path::PathBuf {
            let fingerprint = self.peers[peer].fingerprint();
            let folder = self.keys.dir().join("trusted");
            folder.join(format!("{fingerprint}.pem"))
        }
    }

    #[test]
    fn a_certificate_that_cannot_be_read_any_more_is_not_trusted_until_it_can() {
        let mut scene = Scene::new();
        assert_eq!(scene.trusts(), [true, true]);
        let pem = fs::read(scene.file(0)).unwrap();
        fs::remove_file(scene.file(0)).unwrap();
        fs::write(scene.file(0), "nothing").unwrap();
        assert_eq!(scene.trusts(), [false, true]);
        assert_eq!(scene.trusts(), [false, true], "and it stays so");
        // The file is written in place, so the directory does not change.
        fs::write(scene.file(0), pem).unwrap();
        assert_eq!(scene.trusts(), [true, true]);
    }

    #[test]
    fn a_revocation_counts_whatever_else_cannot_be_read() {
        let mut scene = Scene::new();
        scene.keys.revoke("crex-mts").unwrap();
        fs::write(scene.keys.dir().join("trusted/other.pem"), "nothing").unwrap();
        assert_eq!(scene.trusts(), [false, true]);
        // A copy of a revoked certificate is not trusted.
        let name = scene.file(0).file_name().unwrap().to_owned();
        fs::copy(scene.keys.dir().join("revoked").join(name), scene.file(0)).unwrap();
        assert_eq!(scene.trusts(), [false, true]);
    }

    #[test]
    fn without_the_own_certificate_trust_can_still_be_withdrawn() {
        let mut scene = Scene::new();
        fs::remove_file(scene.keys.own_file()).unwrap();
        assert_eq!(scene.trusts(), [true, true]);
        scene.keys.revoke("sherpa-mts").unwrap();
        assert_eq!(scene.trusts(), [true, false]);
        fs::remove_dir_all(scene.keys.dir()).unwrap();
        assert_eq!(scene.trusts(), [false, false]);
    }
}
