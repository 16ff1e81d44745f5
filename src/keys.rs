//! The keys of a host and the certificates of the peers it trusts, as files in one directory.
//!
//! | file | what it is |
//! |---|---|
//! | `own.pem` | this host's certificate, for the owners of its peers |
//! | `own.key` | the private key that belongs to it; nobody else may read it |
//! | `next.pem`, `next.key` | those that will take their place |
//! | `trusted/<fingerprint>.pem` | a certificate of a trusted peer |
//! | `revoked/<fingerprint>.pem` | one that is never to be trusted again |
//!
//! All are PEM (RFC 7468). A gateway looks after the directory while it runs: what is changed here
//! counts within seconds, without a new start.
//!
//! What must not live here: what is done with keys on connections (`fipa_transport_net::secure`).

use std::fs::{self, DirBuilder, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

pub use fipa_transport_net::secure::{Certificate, CertificateError, Certified, Fingerprint};
use fipa_transport_net::secure::{Credentials, alternative_names};
use rcgen::{CertificateParams, DnType, KeyPair, SanType};
use rustls_pki_types::pem::PemObject as _;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};

/// Longest file that is read, in bytes.
const MAX_FILE: u64 = 1 << 20;

/// Most certificates that are trusted, or revoked.
const MAX_PEERS: usize = 4096;

/// How long a certificate holds unless something else is wished: ten years of 365 days.
pub const VALID: Duration = Duration::from_secs(10 * 365 * 86_400);

/// How far clocks of two robots may differ.
const SKEW: Duration = Duration::from_secs(86_400);

/// A directory with keys.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    dir: PathBuf,
}

/// Why something cannot be done with keys.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeysError {
    /// A file or directory cannot be used.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which one.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// There are keys already.
    #[error("{} is there already; nothing was changed", .0.display())]
    Exists(PathBuf),
    /// There are none.
    #[error("there are no keys in {}; make them with `fipa keys init`", .0.display())]
    Missing(PathBuf),
    /// Others could read the private key.
    #[error(
        "{} can be read by others than its owner, or is not this user's; `chmod 600` it, and make new \
         keys if somebody may have read it",
        .0.display()
    )]
    Readable(PathBuf),
    /// A file is not what its name says.
    #[error("{}: {what}", path.display())]
    Contents {
        /// Which one.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// What was given has no certificate in it.
    #[error("no certificate in it (PEM, -----BEGIN CERTIFICATE-----)")]
    NoCertificate,
    /// What was given is a private key.
    #[error(
        "a private key, which nobody but its owner may have; if it came from another host, that has to \
         make new ones"
    )]
    PrivateKey,
    /// What was given is this host's own.
    #[error("this host's own certificate, which the owners of other hosts are to trust")]
    Own,
    /// A certificate that cannot be used.
    #[error(transparent)]
    Certificate(#[from] CertificateError),
    /// The certificate is of another service.
    #[error(
        "the certificate in {} is of {certified:?}, and mts.name is {name:?}: peers would refuse this \
         gateway",
        dir.display()
    )]
    Name {
        /// Where the certificate is.
        dir: PathBuf,
        /// Whose it is.
        certified: String,
        /// Who wants to use it.
        name: String,
    },
    /// It was revoked once.
    #[error("the certificate {0} was revoked; its owner has to make a new one")]
    Revoked(Fingerprint),
    /// None of the trusted certificates is meant, or several are.
    #[error("{found} trusted certificates are meant by {which:?}; `fipa keys list` shows them")]
    Which {
        /// What was asked for.
        which: String,
        /// How many there are.
        found: usize,
    },
    /// A key or certificate could not be made.
    #[error("could not make a key: {0}")]
    Make(String),
}

/// What is in the directory at one time, as far as that is seen without reading it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Stamp([Option<(i64, i64, u64)>; 3]);

impl Stamp {
    /// Whether something was changed so recently that another change may bear the same time.
    pub(crate) fn is_fresh(&self) -> bool {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let now = now.map_or(i64::MAX, |now| {
            i64::try_from(now.as_secs()).unwrap_or(i64::MAX)
        });
        let seconds = self.0.iter().flatten().map(|(seconds, ..)| *seconds);
        seconds.max().is_some_and(|newest| newest >= now - 1)
    }
}

/// How long before a certificate ends that is told: 30 days.
const SOON: i64 = 30 * 86_400;

/// Whether a certificate holds at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Holding {
    /// It does, for more than a month.
    Well,
    /// It ends within 30 days.
    EndsSoon,
    /// It has ended, and is refused.
    Ended,
    /// It has not begun, and is refused.
    NotYet,
}

impl Holding {
    /// Of this certificate now.
    #[must_use]
    pub fn of(certificate: &Certificate) -> Self {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
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

    /// What is to be told of it, where something is.
    #[must_use]
    pub fn told(self) -> Option<&'static str> {
        match self {
            Self::Well => None,
            Self::EndsSoon => Some("ends within 30 days"),
            Self::Ended => Some("has ended"),
            Self::NotYet => Some("does not hold yet; is the clock right?"),
        }
    }
}

impl Keys {
    /// The keys in this directory, which need not be there.
    #[must_use]
    pub fn at(dir: impl Into<PathBuf>) -> Self {
        Self { dir: dir.into() }
    }

    /// The directory.
    #[must_use]
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// The file with this host's certificate, for the owners of its peers.
    #[must_use]
    pub fn own_file(&self) -> PathBuf {
        self.dir.join("own.pem")
    }

    /// The file with the certificate that will be this host's next.
    #[must_use]
    pub fn next_file(&self) -> PathBuf {
        self.dir.join("next.pem")
    }

    /// Makes a key, and a certificate that says for which service it stands and for which agents
    /// that may speak (all when there are none; one that ends with `*` stands for all that begin
    /// so).
    ///
    /// # Errors
    /// When there are keys already, or the directory cannot be written.
    pub fn init(
        &self,
        mts: &str,
        agents: &[String],
        valid: Duration,
    ) -> Result<Certificate, KeysError> {
        self.make("own", mts, agents, valid)
    }

    /// Makes the key and the certificate that will be this host's next, for the same service and
    /// agents. They are used from [`switch`](Self::switch) on, when all peers trust them.
    ///
    /// # Errors
    /// As for [`init`](Self::init), and when there are no keys yet.
    pub fn renew(&self, valid: Duration) -> Result<Certificate, KeysError> {
        let own = self.own()?;
        let certified = own.certified();
        self.make("next", certified.mts(), certified.agents(), valid)
    }

    /// Uses the next key and certificate from now on. Those before are gone.
    ///
    /// # Errors
    /// When there are none, or the directory cannot be written.
    pub fn switch(&self) -> Result<Certificate, KeysError> {
        let (key, certificate) = (self.dir.join("next.key"), self.next_file());
        if !key.exists() || !certificate.exists() {
            return Err(KeysError::Missing(certificate));
        }
        // Who reads in between finds a key and a certificate that do not belong together, and
        // looks again.
        rename(&key, &self.dir.join("own.key"))?;
        rename(&certificate, &self.own_file())?;
        self.own()
    }

    fn make(
        &self,
        what: &str,
        mts: &str,
        agents: &[String],
        valid: Duration,
    ) -> Result<Certificate, KeysError> {
        let failed = |error: rcgen::Error| KeysError::Make(error.to_string());
        make_private(&self.dir)?;
        let (key_file, file) = (
            self.dir.join(format!("{what}.key")),
            self.dir.join(format!("{what}.pem")),
        );
        if let Some(there) = [&key_file, &file].into_iter().find(|file| file.exists()) {
            return Err(KeysError::Exists(there.clone()));
        }
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, mts);
        for uri in alternative_names(mts, agents) {
            let uri = uri.try_into().map_err(failed)?;
            params.subject_alt_names.push(SanType::URI(uri));
        }
        let now = SystemTime::now();
        params.not_before = (now - SKEW).into();
        params.not_after = (now + valid).into();
        let key = KeyPair::generate().map_err(failed)?;
        let made = params.self_signed(&key).map_err(failed)?;
        let certificate = Certificate::from_der(made.der().to_vec())?;
        write_new(&key_file, key.serialize_pem().as_bytes(), 0o600)?;
        write_new(&file, made.pem().as_bytes(), 0o644)?;
        Ok(certificate)
    }

    /// This host's certificate.
    ///
    /// # Errors
    /// When there is none, or it cannot be read.
    pub fn own(&self) -> Result<Certificate, KeysError> {
        let file = self.own_file();
        match read(&file) {
            Ok(pem) => only(&file, &pem),
            Err(KeysError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                Err(KeysError::Missing(self.dir.clone()))
            }
            Err(error) => Err(error),
        }
    }

    /// Trusts the certificates in this PEM text, and returns them.
    ///
    /// # Errors
    /// When there is none in it, one of them cannot be used, was revoked or is this host's own: then
    /// none is trusted.
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
        let own = self.own().ok();
        if certificates.iter().any(|it| Some(it) == own.as_ref()) {
            return Err(KeysError::Own);
        }
        for certificate in &certificates {
            if self.file("revoked", certificate.fingerprint()).exists() {
                return Err(KeysError::Revoked(certificate.fingerprint()));
            }
        }
        make_private(&self.dir)?;
        make_private(&self.dir.join("trusted"))?;
        for certificate in &certificates {
            let file = self.file("trusted", certificate.fingerprint());
            if file.exists() {
                continue;
            }
            write_new(&file, to_pem(certificate).as_bytes(), 0o644)?;
        }
        Ok(certificates)
    }

    /// The certificates of trusted peers, ordered by the names of their services.
    ///
    /// # Errors
    /// When one cannot be read, or is revoked as well.
    pub fn trusted(&self) -> Result<Vec<Certificate>, KeysError> {
        let (confirmed, mut doubtful) = self.confirmed();
        match doubtful.pop() {
            None => Ok(confirmed),
            Some(error) => Err(error),
        }
    }

    /// The certificates of trusted peers that can be read, in that order, and why others cannot:
    /// those are not to be trusted, as their owner may have meant to revoke them.
    pub(crate) fn confirmed(&self) -> (Vec<Certificate>, Vec<KeysError>) {
        let (all, mut doubtful) = self.all("trusted");
        let (revoked, confirmed) = all
            .into_iter()
            .partition::<Vec<_>, _>(|it| self.file("revoked", it.fingerprint()).exists());
        let revoked = revoked.iter().map(Certificate::fingerprint);
        doubtful.extend(revoked.map(KeysError::Revoked));
        (confirmed, doubtful)
    }

    /// The certificates that are not to be trusted again.
    ///
    /// # Errors
    /// When one cannot be read.
    pub fn revoked(&self) -> Result<Vec<Certificate>, KeysError> {
        let (revoked, mut doubtful) = self.all("revoked");
        match doubtful.pop() {
            None => Ok(revoked),
            Some(error) => Err(error),
        }
    }

    /// Withdraws trust for good: from the certificate whose fingerprint begins so, or from all of the
    /// service with this name.
    ///
    /// # Errors
    /// When nothing is meant, or two by a fingerprint.
    pub fn revoke(&self, which: &str) -> Result<Vec<Certificate>, KeysError> {
        let trusted = self.trusted()?;
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
                return Err(KeysError::Which { which, found });
            }
        }
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

    /// What the gateway with this name needs of all this.
    ///
    /// # Errors
    /// When there are no keys, they are of another service, or something cannot be read.
    pub fn credentials_of(&self, mts: &str) -> Result<Credentials, KeysError> {
        let credentials = self.credentials()?;
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

    /// This host's certificate and key, and whom it trusts, whatever the service is called.
    ///
    /// # Errors
    /// When there are no keys, or something cannot be read.
    fn credentials(&self) -> Result<Credentials, KeysError> {
        let own = self.own()?;
        let file = self.dir.join("own.key");
        let meta = fs::metadata(&file).map_err(|source| io_error(&file, source))?;
        if meta.mode() & 0o077 != 0 || meta.uid() != rustix::process::geteuid().as_raw() {
            return Err(KeysError::Readable(file));
        }
        let key = PrivateKeyDer::from_pem_slice(&read(&file)?);
        let key = key.map_err(|error| contents(&file, &error))?;
        let trusted = self.trusted()?;
        Ok(Credentials { own, key, trusted })
    }

    /// To see whether anything has changed.
    pub(crate) fn stamp(&self) -> Stamp {
        let parts = [
            self.own_file(),
            self.dir.join("trusted"),
            self.dir.join("own.key"),
        ];
        Stamp(parts.map(|path| {
            let meta = fs::metadata(path).ok()?;
            // Also counts up when rights change.
            Some((meta.ctime(), meta.ctime_nsec(), meta.ino()))
        }))
    }

    fn file(&self, folder: &str, fingerprint: Fingerprint) -> PathBuf {
        self.dir.join(folder).join(format!("{fingerprint}.pem"))
    }

    /// The certificates in this folder that can be read, ordered by the names of their services,
    /// and why others cannot.
    fn all(&self, folder: &str) -> (Vec<Certificate>, Vec<KeysError>) {
        let dir = self.dir.join(folder);
        let listed = match fs::read_dir(&dir) {
            Ok(listed) => listed,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Default::default(),
            Err(error) => return (Vec::new(), vec![io_error(&dir, error)]),
        };
        let (mut all, mut unread) = (Vec::new(), Vec::new());
        for (number, entry) in listed.take(MAX_PEERS + 1).enumerate() {
            if number == MAX_PEERS {
                let what = format!("more than {MAX_PEERS} certificates; the others are left out");
                unread.push(contents(&dir, &what));
                break;
            }
            match entry.map(|entry| entry.path()) {
                Ok(path) if path.extension().is_some_and(|it| it == "pem") => {
                    match read(&path).and_then(|pem| only(&path, &pem)) {
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
    let mut private = DirBuilder::new();
    let made = private.recursive(true).mode(0o700).create(dir);
    made.map_err(|source| io_error(dir, source))
}

fn write_new(file: &Path, bytes: &[u8], mode: u32) -> Result<(), KeysError> {
    let mut options = OpenOptions::new();
    let opened = options.write(true).create_new(true).mode(mode).open(file);
    let written =
        opened.and_then(|mut opened| opened.write_all(bytes).and_then(|()| opened.sync_all()));
    written.map_err(|source| match source.kind() {
        io::ErrorKind::AlreadyExists => KeysError::Exists(file.to_owned()),
        _ => io_error(file, source),
    })
}

fn rename(from: &Path, to: &Path) -> Result<(), KeysError> {
    fs::rename(from, to).map_err(|source| io_error(from, source))
}

fn read(file: &Path) -> Result<Vec<u8>, KeysError> {
    let len = fs::metadata(file)
        .map_err(|source| io_error(file, source))?
        .len();
    if len > MAX_FILE {
        return Err(contents(
            file,
            &format_args!("{len} bytes; at most {MAX_FILE} are read"),
        ));
    }
    fs::read(file).map_err(|source| io_error(file, source))
}

/// The certificates in PEM text.
fn certificates(pem: &[u8]) -> Result<Vec<Certificate>, KeysError> {
    let mut all = Vec::new();
    for der in CertificateDer::pem_slice_iter(pem) {
        let der = der.map_err(|_| KeysError::NoCertificate)?;
        all.push(Certificate::from_der(der.to_vec())?);
    }
    Ok(all)
}

/// The one certificate in a file of ours.
fn only(file: &Path, pem: &[u8]) -> Result<Certificate, KeysError> {
    let found = certificates(pem).map_err(|error| contents(file, &error))?;
    <[Certificate; 1]>::try_from(found)
        .map(|[only]| only)
        .map_err(|found| contents(file, &format_args!("{} certificates, not one", found.len())))
}

fn to_pem(certificate: &Certificate) -> String {
    pem::encode(&pem::Pem::new("CERTIFICATE", certificate.der().to_vec()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys() -> (tempfile::TempDir, Keys) {
        let dir = tempfile::tempdir().unwrap();
        let keys = Keys::at(dir.path().join("keys"));
        (dir, keys)
    }

    #[test]
    fn what_a_certificate_says_is_what_was_asked_for() {
        let (_dir, keys) = keys();
        let agents = ["arm_1".to_owned(), "Käptn *".to_owned()];
        let made = keys.init("crex mts/1", &agents, VALID).unwrap();
        assert_eq!(keys.own().unwrap(), made);
        assert_eq!(made.certified().mts(), "crex mts/1");
        assert_eq!(made.certified().agents(), agents);
        let (from, until) = made.validity();
        assert!(until - from >= i64::try_from(VALID.as_secs()).unwrap());
        assert!(matches!(
            keys.init("crex", &[], VALID),
            Err(KeysError::Exists(_))
        ));
        assert_eq!(keys.own().unwrap(), made);
    }

    #[test]
    fn trust_is_given_and_withdrawn_for_good() {
        let ((_a, crex), (_b, rover)) = (keys(), keys());
        let made = crex.init("crex-mts", &[], VALID).unwrap();
        rover.init("rover-mts", &[], VALID).unwrap();
        let before = rover.stamp();
        let pem = fs::read(crex.own_file()).unwrap();
        assert_eq!(rover.trust(&pem).unwrap(), std::slice::from_ref(&made));
        assert_eq!(rover.trust(&pem).unwrap().len(), 1, "twice is once");
        assert_ne!(rover.stamp(), before);
        assert_eq!(rover.credentials().unwrap().trusted.len(), 1);
        assert!(matches!(
            rover.revoke("nobody"),
            Err(KeysError::Which { found: 0, .. })
        ));
        let fingerprint = made.fingerprint().to_string();
        assert_eq!(rover.revoke(&fingerprint[..12]).unwrap().len(), 1);
        assert_eq!(rover.trusted().unwrap(), []);
        assert_eq!(rover.revoked().unwrap(), [made]);
        assert!(matches!(rover.trust(&pem), Err(KeysError::Revoked(_))));
    }

    #[test]
    fn a_renewed_key_is_used_when_it_is_switched_to() {
        let (_dir, keys) = keys();
        assert!(matches!(keys.renew(VALID), Err(KeysError::Missing(_))));
        let first = keys.init("crex", &["crex".to_owned()], VALID).unwrap();
        assert!(matches!(keys.switch(), Err(KeysError::Missing(_))));
        let next = keys.renew(VALID).unwrap();
        assert_eq!(keys.own().unwrap(), first);
        assert_eq!(keys.switch().unwrap(), next);
        assert_eq!(next.certified(), first.certified());
        assert_ne!(next.fingerprint(), first.fingerprint());
        assert_eq!(keys.credentials().unwrap().own, next);
    }

    #[test]
    fn a_key_that_others_can_read_is_refused() {
        use std::os::unix::fs::PermissionsExt as _;
        let (_dir, keys) = keys();
        keys.init("crex", &[], VALID).unwrap();
        let file = keys.dir().join("own.key");
        assert_eq!(fs::metadata(&file).unwrap().mode() & 0o777, 0o600);
        fs::set_permissions(&file, fs::Permissions::from_mode(0o640)).unwrap();
        assert!(matches!(keys.credentials(), Err(KeysError::Readable(_))));
    }

    #[test]
    fn what_is_no_certificate_is_told() {
        let (_dir, keys) = keys();
        for wrong in [
            &b""[..],
            b"hello",
            b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
        ] {
            assert!(keys.trust(wrong).is_err());
        }
        assert!(matches!(keys.own(), Err(KeysError::Missing(_))));
        keys.init("crex", &[], VALID).unwrap();
        fs::write(keys.own_file(), b"hello").unwrap();
        assert!(matches!(keys.own(), Err(KeysError::Contents { .. })));
    }
}
