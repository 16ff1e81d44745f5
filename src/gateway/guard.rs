//! The gateway's keys: read when it opens, and again whenever their directory changes.

use std::time::Duration;

use fipa_transport_net::secure::{Credentials, Rules, Security};

use crate::config;
use crate::error::OpenError;
use crate::keys::{Holding, Keys, Stamp};

/// How often the directory is looked at. Looking is three calls to the system.
const LOOK: Duration = Duration::from_secs(1);

/// Says which certificates do not hold, or not for long any more.
fn tell_of_ends(credentials: &Credentials) {
    if let Some(what) = Holding::of(&credentials.own).told() {
        tracing::warn!(
            "the certificate of this host {what}; without one that holds peers refuse it (`fipa keys \
             renew`)"
        );
    }
    for trusted in &credentials.trusted {
        if let Some(what) = Holding::of(trusted).told() {
            let peer = trusted.certified().mts();
            tracing::warn!(
                "the certificate of {peer} {what}; its owner has to make a new one (`fipa keys renew` \
                 there)"
            );
        }
    }
}

/// Keeps the keys of a gateway as they are in their directory.
pub(super) struct Guard {
    keys: Keys,
    name: String,
    security: Security,
    seen: Stamp,
    /// Whether what was seen then may have changed since without looking different.
    fresh: bool,
    /// Why what is there cannot be used, when it cannot.
    fault: Option<String>,
}

impl Guard {
    /// Reads the keys that the configuration names, if it does.
    pub(super) fn open(config: &config::Security, name: &str) -> Result<Option<Self>, OpenError> {
        if config.keys.is_empty() {
            return Ok(None);
        }
        let keys = Keys::at(&config.keys);
        let seen = keys.stamp();
        let credentials = keys.credentials_of(name);
        let credentials = credentials.map_err(|error| OpenError::Keys(error.to_string()))?;
        tell_of_ends(&credentials);
        let rules = Rules {
            loopback: config.loopback,
            legacy_peers: config.legacy_peers.clone(),
        };
        let security = Security::new(credentials, rules);
        let security = security.map_err(|error| OpenError::Keys(error.to_string()))?;
        Ok(Some(Self {
            keys,
            name: name.to_owned(),
            security,
            fresh: seen.is_fresh(),
            seen,
            fault: None,
        }))
    }

    /// For the transports.
    pub(super) fn security(&self) -> Security {
        self.security.clone()
    }

    /// Looks after the directory for as long as it is polled.
    pub(super) async fn run(mut self) {
        let mut look = tokio::time::interval(LOOK);
        loop {
            look.tick().await;
            self = match tokio::task::spawn_blocking(move || self.looked()).await {
                Ok(guard) => guard,
                Err(error) => {
                    tracing::error!(%error, "the keys are not looked after any more");
                    return;
                }
            };
        }
    }

    /// Uses what has changed. What cannot be read is looked at again every time: it may be mended by
    /// a change that its directory does not show.
    fn looked(mut self) -> Self {
        let now = self.keys.stamp();
        let changed = now != self.seen;
        if !changed && !self.fresh && self.fault.is_none() {
            return self;
        }
        self.fresh = now.is_fresh();
        let used = self.keys.credentials_of(&self.name);
        let used = used
            .map_err(|error| error.to_string())
            .and_then(|credentials| {
                let count = credentials.trusted.len();
                if changed {
                    tell_of_ends(&credentials);
                }
                let replaced = self.security.replace(credentials);
                replaced.map(|()| count).map_err(|error| error.to_string())
            });
        self.seen = now;
        match used {
            Ok(count) => {
                let mended = self.fault.take().is_some();
                if changed || mended {
                    tracing::info!(trusted = count, "the keys were read again");
                }
            }
            Err(error) => {
                self.keep_confirmed(&error);
                self.fault = Some(error);
            }
        }
        self
    }

    /// Somebody has changed the keys, and it cannot be told all that was meant. It may have been to
    /// revoke one, so only those stay trusted that can still be read there. The gateway's own key
    /// stays, as without one nobody could be spoken with at all.
    fn keep_confirmed(&self, error: &str) {
        let (confirmed, _) = self.keys.confirmed();
        let count = confirmed.len();
        let kept = self.security.trust_only(confirmed);
        if self.fault.as_deref() == Some(error) {
            return;
        }
        match kept {
            Ok(()) => tracing::error!(
                trusted = count,
                "the keys have changed and cannot be read: {error}; only peers whose certificates can \
                 still be read are trusted until that is mended (`fipa keys list`)"
            ),
            Err(kept) => tracing::error!("{error}; and those before cannot be used: {kept}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::keys::{Certificate, VALID};

    /// Keys that trust two peers, and a guard of them.
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
            let guard = self.guard.take().unwrap().looked();
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
        // Written in place: the directory does not change.
        fs::write(scene.file(0), pem).unwrap();
        assert_eq!(scene.trusts(), [true, true]);
    }

    #[test]
    fn a_revocation_counts_whatever_else_cannot_be_read() {
        let mut scene = Scene::new();
        scene.keys.revoke("crex-mts").unwrap();
        fs::write(scene.keys.dir().join("trusted/other.pem"), "nothing").unwrap();
        assert_eq!(scene.trusts(), [false, true]);
        // Nor does a copy of what was revoked count.
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
