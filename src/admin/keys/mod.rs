//! The keys of a host and the certificates of the peers it trusts, as files in one directory.
//!
//! | file | contents |
//! |---|---|
//! | `own.pem` | the certificate of this host, for its peers |
//! | `own.key` | the private key of that certificate; only its owner may read it |
//! | `next.pem`, `next.key` | the certificate and private key that will replace them |
//! | `trusted/<fingerprint>.pem` | a certificate of a trusted peer |
//! | `revoked/<fingerprint>.pem` | a certificate that must never be trusted again |
//!
//! All are PEM (RFC 7468). Only their owner and root may write to the directories and to the
//! certificates of peers. What root creates in a directory of another user belongs to that user. A running gateway applies changes within seconds, without a restart. If the power fails while
//! the next key replaces the own one, `next.pem` counts as the own certificate until the switch is repeated.
//!
//! Not in this module: the use of keys on connections (`fipa_transport_net::secure`).

mod error;
#[cfg(test)]
mod tests;

use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

#[cfg(feature = "http")]
use fipa_transport_net::secure::Authorities;
pub use fipa_transport_net::secure::{
    Certificate, CertificateError, Certified, CredentialsError, Fingerprint,
};
use fipa_transport_net::secure::{Credentials, alternative_names};
use rcgen::{CertificateParams, DnType, KeyPair, PublicKeyData as _, SanType};
use rustix::process::geteuid;
use rustls_pki_types::pem::PemObject as _;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};

pub use self::error::KeysError;
use crate::{durable, wall_clock};

/// Maximum size of a file, in bytes.
const MAX_FILE: u64 = 1 << 20;

/// Maximum number of trusted certificates, and of revoked ones.
const MAX_PEERS: usize = 4096;

/// The default validity of a certificate: ten years of 365 days.
pub const VALID: Duration = Duration::from_secs(10 * 365 * 86_400);

/// The tolerated difference between the clocks of two robots: certificates begin this much earlier.
const SKEW: Duration = Duration::from_secs(86_400);

/// The latest end of a certificate, at the end of the year 9999 (RFC 5280 clause 4.1.2.5), since 1970.
const LAST: Duration = Duration::from_secs(253_402_300_799);

/// A directory with keys.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    dir: PathBuf,
}

/// The change times of the files at one time, which show a change without reading the files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Stamp([Option<(i64, i64, u64)>; 4]);

impl Stamp {
    /// Whether a file was changed so recently that another change may get the same time.
    pub(crate) fn is_fresh(&self) -> bool {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let now = now.map_or(i64::MAX, |now| {
            i64::try_from(now.as_secs()).unwrap_or(i64::MAX)
        });
        let seconds = self.0.iter().flatten().map(|(seconds, ..)| *seconds);
        seconds.max().is_some_and(|newest| newest >= now - 1)
    }
}

/// Time before the end of a certificate from which a warning is shown: 30 days, in seconds.
const SOON: i64 = 30 * 86_400;

/// The validity of a certificate at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Holding {
    /// The certificate is valid for at least 30 more days.
    Well,
    /// The certificate expires within 30 days.
    EndsSoon,
    /// The certificate has expired and is refused.
    Ended,
    /// The certificate is not valid yet and is refused.
    NotYet,
}

impl Holding {
    /// Returns the validity of a certificate at this time.
    #[must_use]
    pub fn at(now: SystemTime, certificate: &Certificate) -> Self {
        let now = now.duration_since(SystemTime::UNIX_EPOCH);
        let now = now.map_or(0, |since| {
            i64::try_from(since.as_secs()).unwrap_or(i64::MAX)
        });
        match certificate.validity() {
            (_, until) if now > until => Self::Ended,
            (from, _) if now < from => Self::NotYet,
            (_, until) if now > until - SOON => Self::EndsSoon,
            _ => Self::Well,
        }
    }

    /// Returns the end of a sentence about the certificate, for example `has expired`; `None` for
    /// [`Holding::Well`].
    #[must_use]
    pub fn problem(self) -> Option<&'static str> {
        match self {
            Self::Well => None,
            Self::EndsSoon => Some("expires within 30 days"),
            Self::Ended => Some("has expired"),
            Self::NotYet => Some("is not valid yet by the clock of this host"),
        }
    }

    /// Returns what to do about the certificate of `whose` at this time; `None` for [`Holding::Well`]. A
    /// wrong clock is more likely than a certificate of the wrong time, in particular on hosts without a
    /// battery for their clock. Therefore the clock comes first.
    #[must_use]
    pub fn advice(self, now: SystemTime, whose: Whose) -> Option<String> {
        let renew = match whose {
            Whose::Own => "`fipa keys renew`",
            Whose::Peer => {
                "ask the owner of that host for a new certificate (`fipa keys renew` there)"
            }
        };
        let clock = || {
            let shown = fipa_acl::Time::from_system_time(now);
            let shown = shown.ok().and_then(fipa_acl::Time::to_rfc3339);
            let shown = shown.unwrap_or_else(|| "no time that a calendar has".to_owned());
            format!("the clock of this host shows {shown}: set it if it is wrong")
        };
        Some(match (self, whose) {
            (Self::Well, _) => return None,
            (Self::EndsSoon, _) => renew.to_owned(),
            (Self::Ended, _) => format!("{}; if it is right, {renew}", clock()),
            (Self::NotYet, Whose::Own) => format!(
                "{}; if it is right, it was ahead when the certificate was made: {renew} makes another one",
                clock()
            ),
            (Self::NotYet, Whose::Peer) => format!(
                "{}; if it is right, the clock of that host is or was ahead: set that clock, then {renew}",
                clock()
            ),
        })
    }
}

/// The host of a certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Whose {
    /// This host.
    Own,
    /// Another host.
    Peer,
}

impl Keys {
    /// Returns the keys in this directory, which need not exist.
    #[must_use]
    pub fn at(dir: impl Into<PathBuf>) -> Self {
        Self { dir: dir.into() }
    }

    /// Returns the directory.
    #[must_use]
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Returns the path of this host's certificate, which peers must trust.
    #[must_use]
    pub fn own_file(&self) -> PathBuf {
        self.dir.join("own.pem")
    }

    /// Returns the path of this host's next certificate.
    #[must_use]
    pub fn next_file(&self) -> PathBuf {
        self.dir.join("next.pem")
    }

    /// Makes a private key and a self-signed certificate for the service `mts`. `agents` are the names
    /// of the agents that the service may represent: empty means all, and a name that ends with `*`
    /// means all names with that prefix.
    ///
    /// If the clock was not set, the validity begins at its time and ends as if the certificate was made at the release
    /// of this program: so the certificate is also valid after the clock was set.
    ///
    /// # Errors
    /// If keys exist already, if the directory cannot be written, or if `valid` is zero or reaches
    /// beyond the year 9999.
    pub fn init(
        &self,
        mts: &str,
        agents: &[String],
        valid: Duration,
    ) -> Result<Certificate, KeysError> {
        self.make("own", mts, agents, valid)
    }

    /// Makes the next key and certificate for the same service and agents. Call
    /// [`switch`](Self::switch) to use them, once all peers trust the certificate.
    ///
    /// # Errors
    /// As for [`init`](Self::init), and if there are no keys yet.
    pub fn renew(&self, valid: Duration) -> Result<Certificate, KeysError> {
        let own = self.own()?;
        let certified = own.certified();
        self.make("next", certified.mts(), certified.agents(), valid)
    }

    /// Replaces this host's key and certificate by the next ones. The former ones are deleted.
    ///
    /// # Errors
    /// If there are no next ones, or the directory cannot be written.
    pub fn switch(&self) -> Result<Certificate, KeysError> {
        let key = self.dir.join("next.key");
        if !self.is_half_switched() {
            if !key.exists() || !self.next_file().exists() {
                return Err(KeysError::NoNext(self.dir.clone()));
            }
            rename(&key, &self.own_key())?;
        }
        rename(&self.next_file(), &self.own_file())?;
        self.own()
    }

    /// Whether the key was switched and the certificate was not: the power failed in between, or another process is
    /// switching.
    fn is_half_switched(&self) -> bool {
        // Mostly there is no next certificate, and the key need not be read.
        let Ok(Some(next)) = self.next() else {
            return false;
        };
        let Ok(key) = key_pair(&self.own_key()) else {
            return false;
        };
        let key = key.subject_public_key_info();
        let mut parts = next.der().windows(key.len());
        parts.any(|part| part == key)
    }

    fn own_key(&self) -> PathBuf {
        self.dir.join("own.key")
    }

    fn make(
        &self,
        what: &str,
        mts: &str,
        agents: &[String],
        valid: Duration,
    ) -> Result<Certificate, KeysError> {
        let failed = |error: rcgen::Error| KeysError::Make(Box::new(error));
        let now = SystemTime::now();
        let until = wall_clock::earliest(now).checked_add(valid);
        let until =
            until.filter(|until| !valid.is_zero() && *until <= SystemTime::UNIX_EPOCH + LAST);
        let until = until.ok_or(KeysError::Validity(valid))?;
        make_private(&self.dir)?;
        let (key_file, file) = (
            self.dir.join(format!("{what}.key")),
            self.dir.join(format!("{what}.pem")),
        );
        if file.exists() {
            return Err(KeysError::Exists(file));
        }
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, mts);
        for uri in alternative_names(mts, agents) {
            let uri = uri.try_into().map_err(failed)?;
            params.subject_alt_names.push(SanType::URI(uri));
        }
        params.not_before = (now - SKEW).into();
        params.not_after = until.into();
        // A key without a certificate is what a loss of power leaves.
        let former = key_file.exists();
        let key = match former {
            true => key_pair(&key_file)?,
            false => KeyPair::generate().map_err(failed)?,
        };
        let signed = params.self_signed(&key).map_err(failed)?;
        let certificate = Certificate::from_der(signed.der().to_vec())?;
        if !former {
            write_new(&key_file, key.serialize_pem().as_bytes(), 0o600)?;
        }
        write_new(&file, signed.pem().as_bytes(), 0o644)?;
        Ok(certificate)
    }

    /// Reads this host's certificate.
    ///
    /// # Errors
    /// If there is none, or it cannot be read.
    pub fn own(&self) -> Result<Certificate, KeysError> {
        let file = match self.is_half_switched() {
            true => self.next_file(),
            false => self.own_file(),
        };
        let own = certificate_in(&file)?;
        own.ok_or_else(|| KeysError::Missing(self.dir.clone()))
    }

    /// Reads this host's next certificate, if one exists.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn next(&self) -> Result<Option<Certificate>, KeysError> {
        certificate_in(&self.next_file())
    }

    /// Adds the certificates in this PEM text to the trusted ones, and returns them.
    ///
    /// # Errors
    /// If the text has no certificate, or if one of them is invalid, was revoked or is this host's
    /// own. None is added then.
    pub fn trust(&self, pem: &[u8]) -> Result<Vec<Certificate>, KeysError> {
        let certificates = certificates(pem)?;
        if certificates.is_empty() {
            let is_key = PrivateKeyDer::from_pem_slice(pem).is_ok();
            return Err(if is_key {
                KeysError::PrivateKey
            } else {
                KeysError::NoCertificate
            });
        }
        self.add(&certificates)?;
        Ok(certificates)
    }

    /// Adds a certificate in DER to the trusted ones, and returns it.
    ///
    /// # Errors
    /// If the certificate is invalid, was revoked or is this host's own.
    pub(crate) fn trust_der(&self, der: &[u8]) -> Result<Certificate, KeysError> {
        let certificate = Certificate::from_der(der.to_vec())?;
        self.add(std::slice::from_ref(&certificate))?;
        Ok(certificate)
    }

    /// Adds all of these certificates to the trusted ones, or none.
    fn add(&self, certificates: &[Certificate]) -> Result<(), KeysError> {
        let own = self.own().ok();
        if certificates.iter().any(|it| Some(it) == own.as_ref()) {
            return Err(KeysError::Own);
        }
        for certificate in certificates {
            if self.file("revoked", certificate.fingerprint()).exists() {
                return Err(KeysError::Revoked(certificate.fingerprint()));
            }
        }
        make_private(&self.dir)?;
        make_private(&self.dir.join("trusted"))?;
        for certificate in certificates {
            let file = self.file("trusted", certificate.fingerprint());
            if file.exists() {
                continue;
            }
            write_new(&file, to_pem(certificate).as_bytes(), 0o644)?;
        }
        Ok(())
    }

    /// Reads the certificates of trusted peers, ordered by the names of their services.
    ///
    /// # Errors
    /// If one cannot be read, or is also revoked.
    pub fn trusted(&self) -> Result<Vec<Certificate>, KeysError> {
        let (confirmed, mut unconfirmed) = self.confirmed();
        match unconfirmed.pop() {
            None => Ok(confirmed),
            Some(error) => Err(error),
        }
    }

    /// Reads the certificates of trusted peers, in that order, and collects the errors of those that
    /// cannot be read. Those must not be trusted, because they may be revoked ones.
    pub(crate) fn confirmed(&self) -> (Vec<Certificate>, Vec<KeysError>) {
        let (all, mut unconfirmed) = self.all("trusted");
        let (revoked, confirmed) = all
            .into_iter()
            .partition::<Vec<_>, _>(|it| self.file("revoked", it.fingerprint()).exists());
        let revoked = revoked.iter().map(Certificate::fingerprint);
        unconfirmed.extend(revoked.map(KeysError::Revoked));
        (confirmed, unconfirmed)
    }

    /// Reads the revoked certificates.
    ///
    /// # Errors
    /// If one cannot be read.
    pub fn revoked(&self) -> Result<Vec<Certificate>, KeysError> {
        let (revoked, mut unconfirmed) = self.all("revoked");
        match unconfirmed.pop() {
            None => Ok(revoked),
            Some(error) => Err(error),
        }
    }

    /// Returns the revoked certificates that can be read.
    pub(crate) fn readable_revoked(&self) -> Vec<Fingerprint> {
        let (revoked, _) = self.all("revoked");
        revoked.iter().map(Certificate::fingerprint).collect()
    }

    /// Revokes trusted certificates permanently: all certificates of the service with this name or, if
    /// there are none, the one whose fingerprint starts with this text of at least 8 characters.
    /// Other certificates that cannot be read do not prevent it.
    ///
    /// # Errors
    /// If no certificate matches, or if several match a fingerprint.
    pub fn revoke(&self, which: &str) -> Result<Vec<Certificate>, KeysError> {
        let meant = self.trusted_as(which)?;
        make_private(&self.dir.join("revoked"))?;
        for certificate in &meant {
            let fingerprint = certificate.fingerprint();
            let (from, to) = (
                self.file("trusted", fingerprint),
                self.file("revoked", fingerprint),
            );
            rename(&from, &to)?;
        }
        Ok(meant)
    }

    /// Ends the trust in certificates, which [`trust`](Self::trust) can restore: those that
    /// [`revoke`](Self::revoke) would revoke.
    ///
    /// # Errors
    /// As for [`revoke`](Self::revoke).
    pub fn distrust(&self, which: &str) -> Result<Vec<Certificate>, KeysError> {
        let meant = self.trusted_as(which)?;
        for certificate in &meant {
            let path = self.file("trusted", certificate.fingerprint());
            durable::remove(&path).map_err(|source| KeysError::Io { path, source })?;
        }
        Ok(meant)
    }

    /// Returns the trusted certificates that a name or the beginning of a fingerprint means; see
    /// [`revoke`](Self::revoke).
    ///
    /// # Errors
    /// If no certificate matches, or if several match a fingerprint.
    pub fn trusted_as(&self, which: &str) -> Result<Vec<Certificate>, KeysError> {
        let (trusted, mut unconfirmed) = self.confirmed();
        let begins = |certificate: &Certificate| {
            let fingerprint = certificate.fingerprint().to_string();
            which.len() >= 8 && fingerprint.starts_with(which)
        };
        let mut meant: Vec<_> = trusted
            .iter()
            .filter(|certificate| certificate.certified().mts() == which)
            .cloned()
            .collect();
        if meant.is_empty() {
            meant.extend(trusted.into_iter().filter(begins));
            if meant.len() != 1 {
                let (which, found) = (which.to_owned(), meant.len());
                // The certificate that cannot be read may be the one to revoke.
                let unread = unconfirmed.pop().filter(|_| found == 0);
                return Err(unread.unwrap_or(KeysError::Which { which, found }));
            }
        }
        Ok(meant)
    }

    /// Reads the credentials of the gateway with this name: its certificate and private key, and the
    /// trusted certificates.
    ///
    /// # Errors
    /// If there are no keys, if they belong to another service, or if a file cannot be read or has
    /// unsafe permissions.
    pub fn credentials_of(&self, mts: &str) -> Result<Credentials, KeysError> {
        self.named_credentials(mts, geteuid().as_raw())
    }

    /// Reads the credentials as a gateway of the [user](Self::user) of the keys does.
    ///
    /// # Errors
    /// As for [`credentials_of`](Self::credentials_of).
    pub(crate) fn examined_credentials_of(&self, mts: &str) -> Result<Credentials, KeysError> {
        self.named_credentials(mts, self.user())
    }

    fn named_credentials(&self, mts: &str, user: u32) -> Result<Credentials, KeysError> {
        let credentials = self.credentials(user)?;
        let certified = credentials.own.certified().mts();
        if certified != mts {
            return Err(KeysError::Name {
                dir: self.dir.clone(),
                certified: certified.to_owned(),
                name: mts.to_owned(),
            });
        }
        Ok(credentials)
    }

    /// The user whose gateway uses the keys: this one or, for root, the owner of the directory, whose keys root manages.
    fn user(&self) -> u32 {
        let this = geteuid();
        match fs::metadata(&self.dir) {
            Ok(meta) if this.is_root() => meta.uid(),
            _ => this.as_raw(),
        }
    }

    /// Reads the credentials of this user without checking the name of the service.
    ///
    /// # Errors
    /// If there are no keys, or if a file cannot be read or has unsafe permissions.
    fn credentials(&self, user: u32) -> Result<Credentials, KeysError> {
        let own = self.own()?;
        let file = self.own_key();
        let meta = fs::metadata(&file).map_err(|source| io_error(&file, source))?;
        if meta.mode() & 0o077 != 0 || meta.uid() != user {
            return Err(KeysError::Readable(file));
        }
        let folders = ["trusted", "revoked"].map(|folder| self.dir.join(folder));
        for dir in std::iter::once(self.dir.clone()).chain(folders) {
            // A missing directory needs no check; reading reports other errors.
            let Ok(meta) = fs::metadata(&dir) else {
                continue;
            };
            if can_be_written_by_others(&meta, user) {
                return Err(KeysError::Writable(dir));
            }
        }
        let key = PrivateKeyDer::from_pem_slice(&read(&file)?);
        let key = key.map_err(|error| contents(&file, &error))?;
        let trusted = self.trusted()?;
        let revoked = self.revoked()?;
        Ok(Credentials {
            own,
            key,
            trusted,
            revoked: revoked.iter().map(Certificate::fingerprint).collect(),
        })
    }

    /// Returns the change times of the files, to detect changes.
    pub(crate) fn stamp(&self) -> Stamp {
        let parts = [
            self.own_file(),
            self.dir.join("trusted"),
            self.dir.join("revoked"),
            self.dir.join("own.key"),
        ];
        Stamp(parts.map(|path| {
            let meta = fs::metadata(path).ok()?;
            // The change time also changes with the permissions.
            Some((meta.ctime(), meta.ctime_nsec(), meta.ino()))
        }))
    }

    fn file(&self, folder: &str, fingerprint: Fingerprint) -> PathBuf {
        self.dir.join(folder).join(format!("{fingerprint}.pem"))
    }

    /// Reads the certificates in a folder, ordered by the names of their services, and collects the
    /// errors of those that cannot be read.
    fn all(&self, folder: &str) -> (Vec<Certificate>, Vec<KeysError>) {
        let dir = self.dir.join(folder);
        let listed = match fs::read_dir(&dir) {
            Ok(listed) => listed,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Default::default(),
            Err(error) => return (Vec::new(), vec![io_error(&dir, error)]),
        };
        // A gateway refuses the directory of another user. So it gets no certificate of that user.
        let user = self.user();
        let (mut all, mut unread) = (Vec::new(), Vec::new());
        for (number, entry) in listed.take(MAX_PEERS + 1).enumerate() {
            if number == MAX_PEERS {
                let what = format!("more than {MAX_PEERS} files; the others are ignored");
                unread.push(contents(&dir, &what));
                break;
            }
            match entry.map(|entry| entry.path()) {
                Ok(path) if path.extension().is_some_and(|it| it == "pem") => {
                    let read = owned(&path, user).and_then(|()| read(&path));
                    match read.and_then(|pem| only(&path, &pem)) {
                        Ok(certificate) => all.push(certificate),
                        Err(error) => unread.push(error),
                    }
                }
                Ok(_) => {}
                Err(error) => unread.push(io_error(&dir, error)),
            }
        }
        all.sort_by(|a, b| {
            let name = |it: &Certificate| it.certified().mts().to_owned();
            name(a)
                .cmp(&name(b))
                .then(a.fingerprint().cmp(&b.fingerprint()))
        });
        (all, unread)
    }
}

/// Whether users other than this one and root can change the file or directory.
fn can_be_written_by_others(meta: &Metadata, user: u32) -> bool {
    meta.mode() & 0o022 != 0 || ![0, user].contains(&meta.uid())
}

/// Checks that only this user and root can change the certificate in this file.
fn owned(file: &Path, user: u32) -> Result<(), KeysError> {
    let meta = fs::metadata(file).map_err(|source| io_error(file, source))?;
    match can_be_written_by_others(&meta, user) {
        true => Err(KeysError::Writable(file.to_owned())),
        false => Ok(()),
    }
}

fn io_error(path: &Path, source: io::Error) -> KeysError {
    KeysError::Io {
        path: path.to_owned(),
        source,
    }
}

fn contents(path: &Path, what: &dyn std::fmt::Display) -> KeysError {
    KeysError::Contents {
        path: path.to_owned(),
        what: what.to_string(),
    }
}

fn make_private(dir: &Path) -> Result<(), KeysError> {
    durable::create_directories(dir, 0o700).map_err(|source| io_error(dir, source))
}

fn write_new(file: &Path, bytes: &[u8], mode: u32) -> Result<(), KeysError> {
    durable::create(file, bytes, mode).map_err(|source| match source.kind() {
        io::ErrorKind::AlreadyExists => KeysError::Exists(file.to_owned()),
        _ => io_error(file, source),
    })
}

fn rename(from: &Path, to: &Path) -> Result<(), KeysError> {
    durable::rename(from, to).map_err(|source| io_error(from, source))
}

fn key_pair(file: &Path) -> Result<KeyPair, KeysError> {
    let pem = read(file)?;
    KeyPair::from_pem(&String::from_utf8_lossy(&pem)).map_err(|error| contents(file, &error))
}

fn read(file: &Path) -> Result<Vec<u8>, KeysError> {
    let metadata = fs::metadata(file).map_err(|source| io_error(file, source))?;
    if !metadata.is_file() {
        // Reading a pipe would block.
        return Err(contents(file, &"not a regular file"));
    }
    let len = metadata.len();
    if len > MAX_FILE {
        return Err(contents(
            file,
            &format_args!("larger than the maximum of {MAX_FILE} bytes: {len} bytes"),
        ));
    }
    fs::read(file).map_err(|source| io_error(file, source))
}

/// Parses the certificates in PEM text.
fn certificates(pem: &[u8]) -> Result<Vec<Certificate>, KeysError> {
    let mut all = Vec::new();
    for der in CertificateDer::pem_slice_iter(pem) {
        let der = der.map_err(|_| KeysError::NoCertificate)?;
        all.push(Certificate::from_der(der.to_vec())?);
    }
    Ok(all)
}

/// Reads a file with one certificate; returns `None` if it does not exist.
fn certificate_in(file: &Path) -> Result<Option<Certificate>, KeysError> {
    match read(file) {
        Ok(pem) => only(file, &pem).map(Some),
        Err(KeysError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

/// Parses PEM text that must hold exactly one certificate.
fn only(file: &Path, pem: &[u8]) -> Result<Certificate, KeysError> {
    let found = certificates(pem).map_err(|error| contents(file, &error))?;
    <[Certificate; 1]>::try_from(found)
        .map(|[only]| only)
        .map_err(|found| {
            let count = found.len();
            contents(
                file,
                &format_args!("holds {count} certificates instead of one"),
            )
        })
}

fn to_pem(certificate: &Certificate) -> String {
    pem::encode(&pem::Pem::new("CERTIFICATE", certificate.der().to_vec()))
}

/// Reads the certificates of authorities from a file in PEM. An empty path is none.
///
/// # Errors
/// If the file cannot be read, or contains something else.
#[cfg(feature = "http")]
pub(crate) fn authorities(file: &Path) -> Result<Authorities, KeysError> {
    if file.as_os_str().is_empty() {
        return Ok(Authorities::default());
    }
    let text = read(file)?;
    let certificates: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&text).collect();
    let certificates = certificates.map_err(|error| contents(file, &error))?;
    let authorities = Authorities::new(certificates);
    authorities.map_err(|error| contents(file, &error))
}
