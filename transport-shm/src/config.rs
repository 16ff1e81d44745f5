//! What the transport needs to know, and how it is checked.

use std::path::PathBuf;
use std::time::Duration;

use fipa_transport::Incarnation;
use iceoryx2::prelude::{Config, FileName, Path, SemanticString};

/// Configuration of one endpoint.
///
/// All processes of a domain use the same `root` and `prefix`; processes of different domains
/// differ in both.
#[derive(Debug, Clone)]
pub struct ShmConfig {
    /// The domain's private directory. Created with mode 0700 when it is not there; must belong
    /// to this user and be closed to everybody else.
    pub root: PathBuf,
    /// What the names of all shared memory of this domain begin with: 1 to
    /// [`ShmConfig::MAX_PREFIX`] ASCII letters, digits, `-` and `_`.
    pub prefix: String,
    /// The incarnation of this process's message transport service.
    pub incarnation: Incarnation,
    /// Largest letter in bytes, sent or taken.
    pub max_letter: usize,
    /// How much shared memory, in bytes, the processes of this domain may use together.
    pub capacity: u64,
    /// How many processes may have this mailbox open at the same time.
    pub max_clients: usize,
    /// How many other processes are kept in mind at the same time: opened mailboxes, bells.
    pub max_peers: usize,
    /// How many parcels to one process may be without an answer, and how many of its parcels a
    /// receiver can hold.
    pub window: usize,
    /// How many loans for one process may be out, from loaning until the last [`bytes::Bytes`] of
    /// the content is dropped. Less than `window`.
    pub max_loans: usize,
    /// How many contents in all may be held in other processes' memory; further ones are copied.
    pub max_borrowed: usize,
    /// Content shorter than this, in bytes, is always copied: cheaper than holding a slot.
    pub copy_below: usize,
    /// Content of a letter to several receivers lies in memory once for all of them from this
    /// length on, in bytes: shorter content is copied for each, which is cheaper.
    pub share_from: usize,
}

impl ShmConfig {
    /// Longest prefix, in bytes.
    pub const MAX_PREFIX: usize = 64;

    /// The defaults: letters of 64 MiB, 256 MiB for the domain, 64 processes.
    #[must_use]
    pub fn new(
        root: impl Into<PathBuf>,
        prefix: impl Into<String>,
        incarnation: Incarnation,
    ) -> Self {
        Self {
            root: root.into(),
            prefix: prefix.into(),
            incarnation,
            max_letter: 64 << 20,
            capacity: 256 << 20,
            max_clients: 64,
            max_peers: 64,
            window: 16,
            max_loans: 8,
            max_borrowed: 256,
            copy_below: 1024,
            share_from: 64 << 10,
        }
    }

    /// How many senders' connections the receiver keeps after the sender is gone, because content
    /// is still read there.
    pub(crate) const EXPIRED_CONNECTIONS: usize = 64;

    /// From how many senders content is held in place at the same time. iceoryx2 ends the process
    /// when more connections with held content expire than it keeps; the distance to
    /// [`Self::EXPIRED_CONNECTIONS`] is for connections that it fails to let go.
    pub(crate) const MAX_LENDERS: usize = 32;

    /// The configuration for iceoryx2.
    pub(crate) fn iceoryx(&self) -> Result<Config, ShmError> {
        let wrong = |what: String| ShmError::Configuration(what);
        let prefix_is_fine = (1..=Self::MAX_PREFIX).contains(&self.prefix.len())
            && self
                .prefix
                .bytes()
                .all(|b| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_'));
        if !prefix_is_fine {
            return Err(wrong(format!(
                "the prefix {:?} is not 1 to {} ASCII letters, digits, '-' and '_'",
                self.prefix,
                Self::MAX_PREFIX
            )));
        }
        if !self.incarnation.is_known() {
            return Err(wrong("the incarnation of this process is missing".into()));
        }
        for (name, value, least, most) in [
            ("max_letter", self.max_letter, 1, 1 << 40),
            ("max_clients", self.max_clients, 1, 4096),
            ("max_peers", self.max_peers, 1, 4096),
            ("window", self.window, 2, 128),
            ("max_loans", self.max_loans, 1, self.window - 1),
            ("share_from", self.share_from, 1, usize::MAX),
        ] {
            if !(least..=most).contains(&value) {
                return Err(wrong(format!(
                    "{name} is {value}, and must be {least} to {most}"
                )));
            }
        }
        let text = self.root.to_str().filter(|_| self.root.is_absolute());
        let root = text
            .and_then(|text| Path::new(text.as_bytes()).ok())
            .filter(|path| path.len() <= 160)
            .ok_or_else(|| {
                wrong(format!(
                    "the directory {:?} cannot be used: an absolute path of at most 160 ASCII characters is needed",
                    self.root
                ))
            })?;
        let mut config = Config::default();
        config.global.set_root_path(&root);
        config.global.prefix = FileName::new(format!("{}_", self.prefix).as_bytes())
            .map_err(|_| wrong(format!("the prefix {:?} makes no file name", self.prefix)))?;
        // Dead processes are cleaned up after their letters have been taken: see `domain`.
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        config.global.service.cleanup_dead_nodes_on_open = false;
        // For what a process was making when it was killed, others wait in vain this long.
        config.global.creation_timeout = Duration::from_millis(200);
        let mail = &mut config.defaults.request_response;
        mail.server_expired_connection_buffer = Self::EXPIRED_CONNECTIONS;
        // A client has one server, whose expired connection holds answers at most.
        mail.client_expired_connection_buffer = 2;
        Ok(config)
    }
}

/// Why the transport cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ShmError {
    /// The configuration makes no sense.
    #[error("shared memory is configured wrongly: {0}")]
    Configuration(String),
    /// There is no shared memory file system, or it is too small.
    #[error(
        "shared memory needs at least {needed} free bytes in {path}, and there are {free}: enlarge it \
         (mount -o remount,size=512M {path}; for containers --shm-size=512m) or remove the transport \"shm\""
    )]
    NoRoom {
        /// Where shared memory lies.
        path: &'static str,
        /// How many bytes are needed to begin with.
        needed: u64,
        /// How many are free.
        free: u64,
    },
    /// The shared memory file system became full while the endpoint was opened.
    #[error(
        "{path} is full: {needed} more bytes are needed there ({source}): enlarge it \
         (mount -o remount,size=512M {path}; for containers --shm-size=512m) or remove the transport \"shm\""
    )]
    Full {
        /// Where shared memory lies.
        path: &'static str,
        /// How many bytes could not be had.
        needed: u64,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Something about a file or directory.
    #[error("{what} {path}: {source}")]
    File {
        /// What could not be done.
        what: &'static str,
        /// To which file or directory.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Another process keeps the domain locked.
    #[error(
        "the lock on {path} was not to be had: another process holds it and does not let go (is one \
         stopped, state T in ps?)"
    )]
    Busy {
        /// The directory.
        path: PathBuf,
    },
    /// The domain's directory is not private.
    #[error(
        "the directory {path} {problem}; it must be a directory of this user with mode 0700, because whoever \
         can write there can read every letter"
    )]
    NotPrivate {
        /// The directory.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// iceoryx2 refused.
    #[error(
        "{what}: {reason} (shared memory of prefix {prefix:?}; often the limit of open files is too low: \
         an endpoint needs about 20, and about 10 more for each process it talks to)"
    )]
    Iceoryx {
        /// What could not be done.
        what: &'static str,
        /// What iceoryx2 said.
        reason: String,
        /// The domain's prefix.
        prefix: String,
    },
}

impl ShmError {
    /// Whether a file or directory was not there.
    pub(crate) fn is_missing_file(&self) -> bool {
        matches!(self, Self::File { source, .. } if source.kind() == std::io::ErrorKind::NotFound)
    }
}
