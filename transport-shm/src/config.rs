//! Configuration and its checks, and the error of opening an endpoint.

use std::path::PathBuf;
use std::time::Duration;

use fipa_transport::{Incarnation, Intrusion};
use iceoryx2::prelude::{Config, FileName, Path, SemanticString};

/// Maximum of [`ShmConfig::max_letter`]: 2^40, or what 32-bit processes can address.
const MAX_LETTER: usize = if usize::BITS < 64 {
    usize::MAX
} else {
    1 << 40
};

/// Configuration of one endpoint.
///
/// All processes of a domain use the same `root` and `prefix`; processes of different domains
/// differ in both.
#[derive(Debug, Clone)]
pub struct ShmConfig {
    /// Private directory of the domain. Created with mode 0700 if it is missing, in a directory that exists; must
    /// belong to this user and be closed to other users.
    pub root: PathBuf,
    /// Prefix of the names of all shared memory files of this domain: 1 to
    /// [`ShmConfig::MAX_PREFIX`] ASCII letters, digits, `-` and `_`. Random digits follow it, which
    /// the first process of the domain draws, so that no other user can create a file with such a name
    /// beforehand.
    pub prefix: String,
    /// Incarnation of this process's message transport service. Must be known.
    pub incarnation: Incarnation,
    /// Maximum length of a letter in bytes, sent or received. 1 to 2^40.
    pub max_letter: usize,
    /// Maximum shared memory, in bytes, that all processes of this domain use together.
    pub capacity: u64,
    /// Maximum number of processes that have this mailbox open at the same time. 1 to 4096.
    pub max_clients: usize,
    /// Maximum number of other processes whose mailbox and doorbell are kept open. 1 to 4096.
    pub max_peers: usize,
    /// Maximum number of unanswered letters to one process, and of parcels of one sender that a
    /// receiver holds. There are a quarter more places for other parcels, whose receivers need them to
    /// have letters answered. 2 to 128.
    pub window: usize,
    /// Maximum number of loans for one process, each counted until the last [`bytes::Bytes`] of
    /// its content is dropped. At least 1 and less than `window`.
    pub max_loans: usize,
    /// Maximum number of contents held in the memory of other processes; further ones are copied.
    pub max_borrowed: usize,
    /// Content shorter than this, in bytes, is always copied: a copy costs less than a held slot.
    pub copy_below: usize,
    /// Minimum length, in bytes, of content that is stored once for several receivers. Shorter
    /// content is copied for each receiver, which costs less. At least 1.
    pub share_from: usize,
    /// Whether letters may be answered later, as long as fewer than half of their sender's slots are
    /// held. For a process that forwards letters.
    pub answers_late: bool,
}

impl ShmConfig {
    /// Maximum length of the prefix in bytes.
    pub const MAX_PREFIX: usize = 47;

    /// Returns the defaults: letters of 64 MiB, 256 MiB for the domain, 64 processes.
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
            max_loans: 15,
            max_borrowed: 256,
            copy_below: 1024,
            share_from: 64 << 10,
            answers_late: false,
        }
    }

    /// Number of connections that the receiver keeps after their senders have ended, because
    /// content in them is still read.
    pub(crate) const EXPIRED_CONNECTIONS: usize = 64;

    /// Maximum number of senders from which content is held in place at the same time. iceoryx2
    /// ends the process when more connections with held content expire than it keeps. The margin
    /// to [`Self::EXPIRED_CONNECTIONS`] covers connections that iceoryx2 fails to release.
    pub(crate) const MAX_LENDERS: usize = 32;

    /// Checks the configuration and returns the directory as a path of iceoryx2.
    pub(crate) fn check(&self) -> Result<Path, ShmError> {
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
            return Err(wrong("the incarnation of this process is not set".into()));
        }
        for (name, value, least, most) in [
            ("max_letter", self.max_letter, 1, MAX_LETTER),
            ("max_clients", self.max_clients, 1, 4096),
            ("max_peers", self.max_peers, 1, 4096),
            ("window", self.window, 2, 128),
            ("max_loans", self.max_loans, 1, self.window - 1),
            ("share_from", self.share_from, 1, usize::MAX),
        ] {
            if !(least..=most).contains(&value) {
                return Err(wrong(format!(
                    "{name} is {value}; it must be {least} to {most}"
                )));
            }
        }
        let text = self.root.to_str().filter(|_| self.root.is_absolute());
        text.and_then(|text| Path::new(text.as_bytes()).ok())
            .filter(|path| path.len() <= 160)
            .ok_or_else(|| {
                wrong(format!(
                    "the directory {:?} is not an absolute path of at most 160 ASCII characters",
                    self.root
                ))
            })
    }

    /// Maximum number of unanswered parcels to one process.
    pub(crate) fn places(&self) -> usize {
        self.window + self.window.div_ceil(4)
    }

    /// Checks the configuration and returns the one for iceoryx2, whose files have this prefix.
    pub(crate) fn iceoryx(&self, prefix: &str) -> Result<Config, ShmError> {
        let mut config = Config::default();
        config.global.set_root_path(&self.check()?);
        config.global.prefix = FileName::new(format!("{prefix}_").as_bytes()).map_err(|_| {
            ShmError::Configuration(format!("the prefix {prefix:?} is not a file name"))
        })?;
        // Dead processes are cleaned up after their letters have been taken: see `domain_files`.
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        config.global.service.cleanup_dead_nodes_on_open = false;
        // iceoryx2 waits this long for a structure that a killed process left unfinished.
        config.global.creation_timeout = Duration::from_millis(200);
        let mail = &mut config.defaults.request_response;
        mail.server_expired_connection_buffer = Self::EXPIRED_CONNECTIONS;
        // A client has one server, whose expired connection holds only answers.
        mail.client_expired_connection_buffer = 2;
        Ok(config)
    }
}

/// The error of opening or cleaning up an endpoint's domain.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ShmError {
    /// The configuration is invalid.
    #[error("invalid configuration of shared memory: {0}")]
    Configuration(String),
    /// The shared memory file system has too little free space.
    #[error(
        "{path} has {free} free bytes, and shared memory needs at least {needed}; enlarge it \
         (mount -o remount,size=512M {path}; for containers --shm-size=512m) or remove the transport \"shm\""
    )]
    NoRoom {
        /// Mount point of shared memory.
        path: &'static str,
        /// Free bytes that an endpoint needs to start.
        needed: u64,
        /// Bytes that are free.
        free: u64,
    },
    /// The shared memory file system became full while the endpoint was opened.
    #[error(
        "{path} is full: cannot allocate {needed} more bytes; enlarge it \
         (mount -o remount,size=512M {path}; for containers --shm-size=512m) or remove the transport \"shm\""
    )]
    Full {
        /// Mount point of shared memory.
        path: &'static str,
        /// Bytes that could not be allocated.
        needed: u64,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// An operation on a file or directory failed.
    #[error("{what} {path}")]
    File {
        /// The failed operation, such as `cannot lock`.
        what: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// Another process holds the lock of the domain.
    #[error(
        "timed out waiting for the lock on {path}, which another process holds; retry, or check for \
         a stopped process (state T in ps)"
    )]
    Busy {
        /// The locked directory.
        path: PathBuf,
    },
    /// The directory of the domain is not private.
    #[error(
        "the directory {path} cannot be used: {intrusion}; it must be a directory of this user with mode 0700, because \
         any user with write access to it can read every letter"
    )]
    NotPrivate {
        /// The directory.
        path: PathBuf,
        /// The reason, such as `its mode is 755`.
        intrusion: Intrusion,
    },
    /// Processes of another layout have the shared memory of the domain.
    #[error(
        "the {others} processes of the domain in {path} have its shared memory, and this process is {this}; run \
         programs of one width, or remove the transport \"shm\": Unix sockets connect both"
    )]
    OtherLayout {
        /// The directory of the domain.
        path: PathBuf,
        /// The others, such as `64-bit`.
        others: &'static str,
        /// This process, such as `32-bit`.
        this: &'static str,
    },
    /// An iceoryx2 operation failed.
    #[error(
        "{what}: {reason} (shared memory prefix {prefix:?}); the limit of open files may be too low: \
         an endpoint needs about 20, and about 10 more for each connected process"
    )]
    Iceoryx {
        /// The failed operation, such as `cannot create a node`.
        what: &'static str,
        /// The error of iceoryx2.
        reason: String,
        /// The prefix of the domain.
        prefix: String,
    },
}

impl ShmError {
    /// Whether a file or directory was missing.
    pub(crate) fn is_missing_file(&self) -> bool {
        matches!(self, Self::File { source, .. } if source.kind() == std::io::ErrorKind::NotFound)
    }
}
