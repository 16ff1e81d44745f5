//! The key log: a file with the secrets of TLS connections, in the format that Wireshark and other programs read
//! (`SSLKEYLOGFILE`, draft-ietf-tls-keylogfile). A reader of the file can decrypt captured connections.
//!
//! `rustls::KeyLogFile` creates the file with the permissions of the umask and ignores an existing file's mode, so
//! this module writes the file itself.

use std::fmt::{self, Write as _};
use std::fs::{File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use fipa_transport::log_limit;

/// A key log. Lines are appended, so several processes of a user may share a file.
pub struct KeyLog {
    path: PathBuf,
    file: File,
}

/// The reason for which a key log cannot be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeyLogError {
    /// The file cannot be opened or created.
    #[error("cannot open the key log {}", .path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// The file is not a regular file.
    #[error("the key log {} is not a regular file", .0.display())]
    NotAFile(PathBuf),
    /// Other users may read the file, or it belongs to one.
    #[error(
        "other users can read the key log {}: its owner is {owner} and its mode {mode:03o}; remove the file",
        .path.display()
    )]
    Exposed {
        /// The file.
        path: PathBuf,
        /// The user that owns it.
        owner: u32,
        /// Its permissions.
        mode: u32,
    },
}

impl KeyLog {
    /// Opens a key log to append to it. Creates the file with mode 0600.
    ///
    /// # Errors
    /// When the file cannot be opened, is not a regular file, or exists and other users can read it.
    pub fn append_to(path: &Path) -> Result<Self, KeyLogError> {
        let failed = |source| KeyLogError::Open {
            path: path.to_owned(),
            source,
        };
        let mut options = OpenOptions::new();
        options.append(true).create(true).mode(0o600);
        // Neither a link that another user has prepared, nor a FIFO without a reader.
        let flags = rustix::fs::OFlags::NOFOLLOW | rustix::fs::OFlags::NONBLOCK;
        options.custom_flags(flags.bits().cast_signed());
        let file = options.open(path).map_err(failed)?;
        let metadata = file.metadata().map_err(failed)?;
        if !metadata.is_file() {
            return Err(KeyLogError::NotAFile(path.to_owned()));
        }
        let (owner, mode) = (metadata.uid(), metadata.mode() & 0o777);
        if owner != rustix::process::geteuid().as_raw() || mode & 0o077 != 0 {
            let path = path.to_owned();
            return Err(KeyLogError::Exposed { path, owner, mode });
        }
        let path = path.to_owned();
        Ok(Self { path, file })
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl fmt::Debug for KeyLog {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("KeyLog").field(&self.path).finish()
    }
}

fn line(label: &str, client_random: &[u8], secret: &[u8]) -> String {
    let mut line = format!("{label} ");
    let hex = |bytes: &[u8], line: &mut String| {
        for byte in bytes {
            // Writing to a string cannot fail.
            let _ = write!(line, "{byte:02x}");
        }
    };
    hex(client_random, &mut line);
    line.push(' ');
    hex(secret, &mut line);
    line.push('\n');
    line
}

impl rustls::KeyLog for KeyLog {
    fn log(&self, label: &str, client_random: &[u8], secret: &[u8]) {
        // One call for each line: lines of several threads and processes do not mix.
        let line = line(label, client_random, secret);
        if let Err(error) = (&self.file).write_all(line.as_bytes()) {
            log_limit::error!(path = %self.path.display(), %error, "cannot write a secret to the key log");
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::{PermissionsExt as _, symlink};

    use rustls::KeyLog as _;

    use super::*;

    #[test]
    fn the_file_is_created_for_its_owner_only_and_appended_to() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("keys.log");
        for secret in [[0x0a, 0xff], [0x01, 0x02]] {
            let log = KeyLog::append_to(&path).unwrap();
            log.log("CLIENT_TRAFFIC_SECRET_0", &[0x12, 0x34], &secret);
        }
        let mode = fs::metadata(&path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode, 0o600);
        assert_eq!(
            fs::read_to_string(&path).unwrap(),
            "CLIENT_TRAFFIC_SECRET_0 1234 0aff\nCLIENT_TRAFFIC_SECRET_0 1234 0102\n"
        );
    }

    #[test]
    fn a_file_that_others_can_read_and_what_is_no_file_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let open = dir.path().join("open.log");
        fs::write(&open, "").unwrap();
        fs::set_permissions(&open, fs::Permissions::from_mode(0o640)).unwrap();
        let refused = KeyLog::append_to(&open).unwrap_err();
        assert!(
            matches!(refused, KeyLogError::Exposed { mode: 0o640, .. }),
            "{refused:?}"
        );
        let link = dir.path().join("link.log");
        symlink(dir.path().join("elsewhere"), &link).unwrap();
        let refused = KeyLog::append_to(&link).unwrap_err();
        assert!(matches!(refused, KeyLogError::Open { .. }), "{refused:?}");
        let refused = KeyLog::append_to(Path::new("/dev/null")).unwrap_err();
        assert!(matches!(refused, KeyLogError::NotAFile(_)), "{refused:?}");
    }
}
