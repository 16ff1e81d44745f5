//! The token that clients of the listener send.

use std::fmt::{self, Write as _};
use std::fs::File;
use std::io::{self, Read as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;
use rustix::io::Errno;
use rustix::process::geteuid;
use subtle::ConstantTimeEq as _;

use crate::durable;

/// Number of random bytes of a new token.
const RANDOM: usize = 16;

/// Permitted lengths of a token of the user's own, in bytes.
const LENGTHS: std::ops::RangeInclusive<usize> = 16..=256;

/// A secret that clients send.
#[derive(Clone)]
pub(crate) struct Token(String);

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token")
    }
}

/// The error if the token of the listener cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TokenError {
    /// The file cannot be read or created.
    #[error("cannot {what} {}, the file with the token of http.listen", path.display())]
    Io {
        /// The operation, as a verb.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The path is a link, a directory or a device.
    #[error("{} must be a regular file, and no link", path.display())]
    NotAFile {
        /// The path.
        path: PathBuf,
    },
    /// Other users can read or change the file.
    #[error(
        "{} must belong to the user of the gateway and have mode 600: run chmod 600 {0}, or delete the file; \
         the gateway then creates another one",
        path.display()
    )]
    Open {
        /// The file.
        path: PathBuf,
    },
    /// The file has no valid token.
    #[error(
        "{} must have one line of 16 to 256 visible ASCII characters without spaces; delete the file, and the gateway \
         creates another one",
        path.display()
    )]
    Invalid {
        /// The file.
        path: PathBuf,
    },
}

/// Returns a new secret of 128 bits, as hexadecimal digits.
pub(super) fn random_text() -> io::Result<String> {
    let mut bytes = [0; RANDOM];
    getrandom::fill(&mut bytes).map_err(io::Error::other)?;
    Ok(bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    }))
}

impl Token {
    /// Reads the token in a file, or creates the file with a new one, which only its owner may read.
    pub(crate) fn load(path: &Path) -> Result<Self, TokenError> {
        let io = |what| {
            move |source| TokenError::Io {
                what,
                path: path.to_owned(),
                source,
            }
        };
        match Self::create(path) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(io("create")(error)),
        }
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
        let opened = File::options().read(true).custom_flags(flags).open(path);
        let not_a_file = || TokenError::NotAFile {
            path: path.to_owned(),
        };
        let file = match opened {
            Err(error) if error.raw_os_error() == Some(Errno::LOOP.raw_os_error()) => {
                return Err(not_a_file());
            }
            opened => opened.map_err(io("open"))?,
        };
        let found = file.metadata().map_err(io("examine"))?;
        if !found.is_file() {
            return Err(not_a_file());
        }
        let owner = durable::owner_of_new(path).map_err(io("examine"))?;
        let is_own = [owner, geteuid().as_raw()].contains(&found.uid());
        if !is_own || found.mode() & 0o077 != 0 {
            let path = path.to_owned();
            return Err(TokenError::Open { path });
        }
        let mut text = String::new();
        // With its end of line.
        let most = *LENGTHS.end() as u64 + 2;
        let read = file.take(most).read_to_string(&mut text);
        let token = text.trim_ascii_end();
        let is_plain = token.bytes().all(|byte| byte.is_ascii_graphic());
        match read {
            Ok(_) if is_plain && LENGTHS.contains(&token.len()) => Ok(Self(token.to_owned())),
            Err(error) if error.kind() != io::ErrorKind::InvalidData => Err(io("read")(error)),
            _ => {
                let path = path.to_owned();
                Err(TokenError::Invalid { path })
            }
        }
    }

    /// Creates the file with all of its content at once. An empty file would keep the gateway from starting.
    fn create(path: &Path) -> io::Result<()> {
        match path.symlink_metadata() {
            Ok(_) => return Err(io::ErrorKind::AlreadyExists.into()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(error),
        }
        let token = random_text()? + "\n";
        durable::create(path, token.as_bytes(), 0o600)
    }

    /// Whether a client has sent this token. The time does not depend on the position of a wrong byte.
    pub(crate) fn is(&self, given: &[u8]) -> bool {
        self.0.as_bytes().ct_eq(given).into()
    }

    #[cfg(test)]
    pub(crate) fn for_tests() -> Self {
        Self("0123456789abcdef".to_owned())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::fs::{self, Permissions};
    use std::os::unix::fs::{PermissionsExt as _, symlink};

    use super::*;

    #[test]
    fn a_token_is_created_once_and_read_again() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("http.token");
        let token = Token::load(&path).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(text.trim_end().len(), 2 * RANDOM);
        assert!(Token::load(&path).unwrap().is(text.trim_end().as_bytes()));
        assert!(token.is(text.trim_end().as_bytes()));
        assert!(!token.is(text.as_bytes()));
        assert!(!token.is(b""));
        assert!(!format!("{token:?}").contains(text.trim_end()));
    }

    #[test]
    fn a_file_that_others_can_read_or_without_a_token_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("http.token");
        let write = |text: &[u8], mode| {
            fs::write(&path, text).unwrap();
            fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
        };
        write(b"0123456789abcdef\n", 0o640);
        assert!(matches!(Token::load(&path), Err(TokenError::Open { .. })));
        for invalid in [
            &b""[..],
            b"short\n",
            b"0123456789 abcdef\n",
            b"0123456789abcdef\n0123456789abcdef\n",
            b"0123456789abcde\xff",
            &[b'a'; 300],
        ] {
            write(invalid, 0o600);
            assert!(matches!(
                Token::load(&path),
                Err(TokenError::Invalid { .. })
            ));
        }
        write(b"0123456789abcdef\r\n", 0o600);
        assert!(Token::load(&path).is_ok());
    }

    #[test]
    fn a_token_survives_a_loss_of_power_as_it_is_created() {
        let load = |root: &Path| Token::load(&root.join("http.token")).map(|token| token.0);
        let cuts = durable::cuts::of(
            |_| {},
            |root| load(root).unwrap(),
            |root, created| {
                let found = load(root).unwrap();
                assert!(created.is_none_or(|created| *created == found));
            },
        );
        assert!(cuts > 0);
    }

    #[test]
    fn processes_that_start_at_the_same_time_have_one_token() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("http.token");
        let tokens: Vec<String> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..8)
                .map(|_| scope.spawn(|| Token::load(&path).unwrap().0))
                .collect();
            threads.into_iter().map(|it| it.join().unwrap()).collect()
        });
        assert!(tokens.iter().all(|token| *token == tokens[0]), "{tokens:?}");
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_link_or_a_directory_is_no_token() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("http.token");
        let other = directory.path().join("other");
        symlink(&other, &path).unwrap();
        assert!(matches!(
            Token::load(&path),
            Err(TokenError::NotAFile { .. })
        ));
        assert!(!other.exists(), "a link was followed");
        Token::load(&other).unwrap();
        assert!(matches!(
            Token::load(&path),
            Err(TokenError::NotAFile { .. })
        ));
        fs::remove_file(&path).unwrap();
        fs::create_dir(&path).unwrap();
        assert!(matches!(
            Token::load(&path),
            Err(TokenError::NotAFile { .. })
        ));
    }
}
