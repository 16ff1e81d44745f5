//! The errors of operations on keys.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use fipa_acl::escape;
use fipa_transport_net::secure::{CertificateError, CredentialsError, Fingerprint};

/// The error of an operation on [`Keys`](super::Keys).
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeysError {
    /// A file or directory cannot be used.
    #[error("cannot use {}", shown(path))]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The directory has keys already. Holds the existing file.
    #[error("{} exists already; nothing was changed", shown(.0))]
    Exists(PathBuf),
    /// The directory has no keys. Holds the directory.
    #[error("there are no keys in {}; make them with `fipa keys init`", shown(.0))]
    Missing(PathBuf),
    /// The directory has no next keys. Holds the directory.
    #[error("there are no next keys in {}; make them with `fipa keys renew`", shown(.0))]
    NoNext(PathBuf),
    /// The validity of the certificate would be zero, or end after the year 9999.
    #[error("a certificate cannot be valid for {}", humantime::format_duration(*.0))]
    Validity(Duration),
    /// Other users could read the private key. Holds its file.
    #[error(
        "{} belongs to another user, or other users can read it; run `chmod 600` on it, and make new \
         keys if another user may have read it",
        shown(.0)
    )]
    Readable(PathBuf),
    /// Other users could add or remove trusted certificates. Holds the file or directory.
    #[error(
        "{} belongs to another user, or other users can write to it and so add trusted certificates; \
         run `chmod go-w` on it, and check the trusted certificates (`fipa keys list`)",
        shown(.0)
    )]
    Writable(PathBuf),
    /// A file has unexpected contents.
    #[error("{}: {}", shown(path), escape(what))]
    Contents {
        /// The file.
        path: PathBuf,
        /// The problem.
        what: String,
    },
    /// The given text has no certificate.
    #[error("no certificate in the file (expected PEM, -----BEGIN CERTIFICATE-----)")]
    NoCertificate,
    /// The given text is a private key.
    #[error(
        "the file is a private key, which must stay on its host; if it is of another host, make new keys \
         there"
    )]
    PrivateKey,
    /// The given certificate is this host's own.
    #[error("the file is this host's own certificate; other hosts must trust it, not this one")]
    Own,
    /// A certificate cannot be used.
    #[error(transparent)]
    Certificate(#[from] CertificateError),
    /// The certificate is for another service than `mts.name`.
    #[error(
        "the certificate in {} is for {certified:?}, but mts.name is {name:?}, so peers would refuse \
         this gateway",
        shown(dir)
    )]
    Name {
        /// The directory with the certificate.
        dir: PathBuf,
        /// The name of the service in the certificate.
        certified: String,
        /// The name of the gateway (`mts.name`).
        name: String,
    },
    /// The certificate was revoked.
    #[error("the certificate {0} was revoked; its host needs a new one (`fipa keys renew` there)")]
    Revoked(Fingerprint),
    /// No trusted certificate matches, or several do.
    #[error(
        "{which:?} matches {found} trusted certificates instead of one; `fipa keys list` shows them"
    )]
    Which {
        /// The given name or prefix of a fingerprint.
        which: String,
        /// The number of matching certificates.
        found: usize,
    },
    /// A key or certificate cannot be made.
    #[error("cannot make a key")]
    Make(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The private key and the certificate cannot be used together.
    #[error(transparent)]
    Credentials(#[from] CredentialsError),
}

/// Escapes a path for terminals and logs.
fn shown(path: &Path) -> String {
    escape(&path.to_string_lossy()).into_owned()
}
