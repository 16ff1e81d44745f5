//! Why something cannot be done with keys.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use fipa_acl::escape;
use fipa_transport_net::secure::{CertificateError, Fingerprint};

/// Why something cannot be done with keys.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeysError {
    /// A file or directory cannot be used.
    #[error("{}: {source}", shown(path))]
    Io {
        /// Which one.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// There are keys already.
    #[error("{} is there already; nothing was changed", shown(.0))]
    Exists(PathBuf),
    /// There are none.
    #[error("there are no keys in {}; make them with `fipa keys init`", shown(.0))]
    Missing(PathBuf),
    /// No keys have been made that could take the place of these.
    #[error("there are no next keys in {}; make them with `fipa keys renew`", shown(.0))]
    NoNext(PathBuf),
    /// A certificate would hold for no time, or beyond the year 9999.
    #[error("a certificate cannot hold for {}", humantime::format_duration(*.0))]
    Validity(Duration),
    /// Others could read the private key.
    #[error(
        "{} can be read by others than its owner, or is not this user's; `chmod 600` it, and make new \
         keys if somebody may have read it",
        shown(.0)
    )]
    Readable(PathBuf),
    /// Others could give trust, or withdraw it.
    #[error(
        "{} can be written by others than its owner, or is not this user's: they could trust whom they \
         like; `chmod go-w` it, and look whom it trusts (`fipa keys list`)",
        shown(.0)
    )]
    Writable(PathBuf),
    /// A file is not what its name says.
    #[error("{}: {}", shown(path), escape(what))]
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
        "a private key, which nobody but its owner may have; if it came from another host, that one has \
         to make new ones"
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
        shown(dir)
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
    #[error(
        "{found} of the trusted certificates are meant by {which:?}; `fipa keys list` shows them"
    )]
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

/// A path as it is shown to people: a file name may contain anything.
fn shown(path: &Path) -> String {
    escape(&path.to_string_lossy()).into_owned()
}
