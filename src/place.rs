//! Where the processes of a domain meet on one host: a private directory.
//!
//! `$FIPA_RUNTIME_DIR/<domain>`, or `/tmp/fipa-<uid>/<domain>`: the same for a login shell and a
//! service of the same user. Both levels belong to the user, are closed to everybody else and are
//! removed by whoever leaves last.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};

/// The environment variable that says where domains meet, instead of `/tmp/fipa-<uid>`.
pub(crate) const VARIABLE: &str = "FIPA_RUNTIME_DIR";

/// How often a place that somebody else is just leaving is made again.
pub(crate) const RETRIES: u32 = 20;

/// The directory of a domain, made private.
#[derive(Debug, Clone)]
pub(crate) struct Place {
    base: PathBuf,
    domain: String,
}

/// Why the domain's directory cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlaceError {
    /// The directory cannot be made or looked at.
    #[error("cannot use the directory {}: {source}", path.display())]
    Io {
        /// Which one.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// Somebody else could read or change what lies there.
    #[error(
        "{} must be a directory of this user that nobody else may enter, and {problem}; \
         remove it, or name another place in FIPA_RUNTIME_DIR",
        path.display()
    )]
    NotPrivate {
        /// Which one.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
}

impl Place {
    /// The place of this domain; the directories of all domains are in `base`, or where the
    /// environment says.
    pub(crate) fn prepare(domain: &str) -> Result<Self, PlaceError> {
        let place = Self::of(domain);
        let made = || make_private(&place.base).and_then(|()| make_private(&place.path()));
        let mut result = made();
        for _ in 0..RETRIES {
            match &result {
                // Whoever left last has removed the one between the two.
                Err(PlaceError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                    result = made();
                }
                _ => break,
            }
        }
        result.map(|()| place)
    }

    /// The place of this domain, whether it is there or not.
    pub(crate) fn of(domain: &str) -> Self {
        let base = match std::env::var_os(VARIABLE).filter(|value| !value.is_empty()) {
            Some(base) => PathBuf::from(base),
            None => PathBuf::from(format!("/tmp/fipa-{}", rustix::process::geteuid().as_raw())),
        };
        Self {
            base,
            domain: domain.to_owned(),
        }
    }

    /// Whether it is there; as private as it has to be, as far as it is.
    #[cfg_attr(not(feature = "shm"), expect(dead_code, reason = "nobody asks"))]
    pub(crate) fn look(&self) -> Result<bool, PlaceError> {
        for path in [&self.base, &self.path()] {
            match check_private(path) {
                Ok(()) => {}
                Err(PlaceError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                    return Ok(false);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(true)
    }

    /// The domain's directory.
    pub(crate) fn path(&self) -> PathBuf {
        self.base.join(&self.domain)
    }

    /// The directory of one of the parts that keep files here.
    pub(crate) fn part(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    /// What the names of this domain's shared memory begin with: other users' domains, and those
    /// in other places, have other names.
    #[cfg_attr(
        not(feature = "shm"),
        expect(dead_code, reason = "there is no shared memory")
    )]
    pub(crate) fn prefix(&self) -> String {
        format!(
            "fipa_{}_{:08x}_",
            self.domain,
            fnv(self.path().as_os_str().as_encoded_bytes())
        )
    }

    /// What tells this host from others: the running kernel and the directory itself, so that
    /// containers and network namespaces with places of their own count as hosts.
    #[cfg_attr(
        not(feature = "net"),
        expect(dead_code, reason = "there are no other hosts")
    )]
    pub(crate) fn host_id(&self) -> io::Result<String> {
        let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id")?;
        let directory = fs::metadata(self.path())?;
        Ok(format!(
            "{}:{:x}:{:x}",
            boot.trim(),
            directory.dev(),
            directory.ino()
        ))
    }

    /// Removes what is empty. Not an error when somebody is still there.
    pub(crate) fn leave(&self) {
        for path in [
            self.part("directory"),
            self.part("shm"),
            self.path(),
            self.base.clone(),
        ] {
            // Fails when it is not empty or gone: then there is nothing to do here.
            let _ = fs::remove_dir(path);
        }
    }
}

/// The 32-bit FNV-1a hash: short, and the same in every version of every program.
fn fnv(bytes: &[u8]) -> u32 {
    let step = |hash: u32, byte: &u8| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193);
    bytes.iter().fold(0x811c_9dc5, step)
}

fn make_private(path: &Path) -> Result<(), PlaceError> {
    let io_error = |source| PlaceError::Io {
        path: path.to_owned(),
        source,
    };
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(io_error(error)),
        _ => check_private(path),
    }
}

fn check_private(path: &Path) -> Result<(), PlaceError> {
    let io_error = |source| PlaceError::Io {
        path: path.to_owned(),
        source,
    };
    let metadata = fs::symlink_metadata(path).map_err(io_error)?;
    let problem = if metadata.is_symlink() {
        "it is a symbolic link".to_owned()
    } else if !metadata.is_dir() {
        "it is a file".to_owned()
    } else if metadata.uid() != rustix::process::geteuid().as_raw() {
        format!("it belongs to user {}", metadata.uid())
    } else if metadata.mode() & 0o077 != 0 {
        format!("its mode is {:03o}", metadata.mode() & 0o777)
    } else {
        return Ok(());
    };
    Err(PlaceError::NotPrivate {
        path: path.to_owned(),
        problem,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};

    #[test]
    fn what_others_could_enter_is_refused() {
        let home = tempfile::tempdir().unwrap();
        let open = home.path().join("open");
        fs::create_dir(&open).unwrap();
        fs::set_permissions(&open, fs::Permissions::from_mode(0o755)).unwrap();
        let link = home.path().join("link");
        symlink(home.path(), &link).unwrap();
        let file = home.path().join("file");
        fs::write(&file, "").unwrap();
        for (path, problem) in [
            (&open, "its mode is 755"),
            (&link, "a symbolic link"),
            (&file, "a file"),
        ] {
            let error = make_private(path).unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
        let fresh = home.path().join("fresh");
        make_private(&fresh).unwrap();
        make_private(&fresh).unwrap();
        assert_eq!(fs::metadata(&fresh).unwrap().mode() & 0o777, 0o700);
    }

    #[test]
    fn prefixes_differ_by_domain_and_place() {
        let place = |base: &str, domain: &str| Place {
            base: base.into(),
            domain: domain.into(),
        };
        let all = [place("/a", "x"), place("/a", "y"), place("/b", "x")].map(|p| p.prefix());
        assert!(all[0] != all[1] && all[0] != all[2] && all[1] != all[2]);
        assert!(place("/a", &"d".repeat(32)).prefix().len() <= 64);
    }
}
