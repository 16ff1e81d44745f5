//! The search for the configuration file.

use std::env;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::ConfigError;

/// Maximum size of a configuration file, in bytes: far more than a configuration needs, and little
/// enough to read if `--config` names a wrong file.
const MAX_FILE: u64 = 1 << 20;

/// The directory with the configuration of all programs of the host.
const HOST_DIR: &str = "/etc/fipa";

/// The sources of a configuration: the paths to search, and the `--set` arguments that override the
/// file.
///
/// The search depends on these fields only. The default value has no paths and yields the default
/// configuration.
#[derive(Debug, Clone, Default)]
pub struct Sources {
    /// `--config`: the file to read instead of all others.
    pub file: Option<PathBuf>,
    /// `--set`: texts of the form `key=value`. The last one for a key counts.
    pub set: Vec<String>,
    /// `$FIPA_CONFIG`: the file to read unless `file` is given. An empty path counts as not set.
    pub variable: Option<PathBuf>,
    /// `$FIPA_DOMAIN`: the domain, unless `set` has one. An empty text counts as not set.
    pub domain: Option<String>,
    /// The current directory: may contain `fipa.toml`, and relative paths start there.
    pub current_dir: Option<PathBuf>,
    /// The home directory: may contain `.config/fipa/fipa.toml`.
    pub home: Option<PathBuf>,
    /// The directory with the configuration of all programs of the host: may contain `fipa.toml`, which is read if no
    /// other place has a file.
    pub host_dir: Option<PathBuf>,
    /// The name of this host, for the default of `mts.name`.
    pub host_name: String,
}

impl Sources {
    /// Returns the sources of this process's environment, without `--config` and `--set`.
    #[must_use]
    pub fn from_environment() -> Self {
        Self {
            file: None,
            set: Vec::new(),
            variable: env::var_os("FIPA_CONFIG").map(PathBuf::from),
            domain: env::var_os("FIPA_DOMAIN").map(|name| name.to_string_lossy().into_owned()),
            current_dir: env::current_dir().ok(),
            home: env::home_dir(),
            host_dir: Some(PathBuf::from(HOST_DIR)),
            host_name: gethostname::gethostname().to_string_lossy().into_owned(),
        }
    }

    /// Reads the first file that exists, if any.
    pub(super) fn read(&self) -> Result<Option<Found>, ConfigError> {
        let variable = self
            .variable
            .clone()
            .filter(|path| !path.as_os_str().is_empty());
        let named = match (&self.file, variable) {
            (Some(path), _) => Some((path.clone(), "named by --config")),
            (None, Some(path)) => Some((path, "named by $FIPA_CONFIG")),
            (None, None) => None,
        };
        if let Some((path, named_by)) = named {
            return match read(&self.absolute(&path)) {
                Ok(text) => Ok(Some(Found { path, text })),
                Err(source) => Err(ConfigError::Read {
                    path,
                    named_by,
                    source,
                }),
            };
        }
        let local = self
            .current_dir
            .as_ref()
            .map(|_| PathBuf::from("fipa.toml"));
        let of_user = self
            .home
            .as_ref()
            .map(|home| home.join(".config/fipa/fipa.toml"));
        let of_host = self.host_dir.as_ref().map(|it| it.join("fipa.toml"));
        let usual = [
            (local, "found in the current directory"),
            (of_user, "found in the home directory"),
            (of_host, "for all programs of this host"),
        ];
        for (path, named_by) in usual {
            let Some(path) = path else { continue };
            let is_of_host = self.host_dir.as_deref() == path.parent();
            let absolute = self.absolute(&path);
            match read(&absolute) {
                Ok(text) => return Ok(Some(Found { path, text })),
                Err(error) if is_absent(&error) => {}
                Err(error) if !is_of_host && is_hidden(&absolute, &error) => {}
                Err(source) => {
                    return Err(ConfigError::Read {
                        path,
                        named_by,
                        source,
                    });
                }
            }
        }
        Ok(None)
    }

    fn absolute(&self, path: &Path) -> PathBuf {
        match &self.current_dir {
            Some(directory) => directory.join(path),
            None => path.to_owned(),
        }
    }
}

/// A file that was read.
#[derive(Debug)]
pub(super) struct Found {
    /// Its path as it is displayed, before it is made absolute.
    pub(super) path: PathBuf,
    pub(super) text: String,
}

fn is_absent(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
    )
}

/// Whether this user cannot search the directory, as after `sudo -u` in the home directory of another user. Nothing in it
/// is for this user.
fn is_hidden(path: &Path, error: &io::Error) -> bool {
    let is_denied = |error: &io::Error| error.kind() == io::ErrorKind::PermissionDenied;
    is_denied(error) && fs::symlink_metadata(path).is_err_and(|error| is_denied(&error))
}

fn read(path: &Path) -> io::Result<String> {
    let mut bytes = Vec::new();
    File::open(path)?
        .take(MAX_FILE + 1)
        .read_to_end(&mut bytes)?;
    if bytes.len() as u64 > MAX_FILE {
        let message = format!("larger than {MAX_FILE} bytes, the maximum for a configuration");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, message));
    }
    String::from_utf8(bytes).map_err(|error| {
        let good = error.utf8_error().valid_up_to();
        let line = error
            .as_bytes()
            .iter()
            .take(good)
            .filter(|byte| **byte == b'\n')
            .count()
            + 1;
        let message = format!("line {line} is not UTF-8, as TOML must be");
        io::Error::new(io::ErrorKind::InvalidData, message)
    })
}
