//! Where the configuration is looked for.

use std::env;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::ConfigError;

/// The largest configuration file, in bytes. Far above what anybody writes; below what hurts when
/// `--config` names a wrong file.
const MAX_FILE: u64 = 1 << 20;

/// Where the configuration is looked for, and what overrides it.
///
/// Everything the search depends on is a field, so that it can be repeated; the default looks
/// nowhere and yields the defaults.
#[derive(Debug, Clone, Default)]
pub struct Sources {
    /// `--config`: the file to read, and no other.
    pub file: Option<PathBuf>,
    /// `--set`: `key=value`, of which the last for a key counts.
    pub set: Vec<String>,
    /// `$FIPA_CONFIG`: the file to read unless `file` is given. Empty is as good as not set.
    pub variable: Option<PathBuf>,
    /// The current directory, which may have a `fipa.toml` and in which relative paths start.
    pub current_dir: Option<PathBuf>,
    /// The home directory, which may have a `.config/fipa/fipa.toml`.
    pub home: Option<PathBuf>,
    /// The name of this host, for the default of `mts.name`.
    pub host_name: String,
}

impl Sources {
    /// The environment of this process, without `--config` and `--set`.
    #[must_use]
    pub fn from_environment() -> Self {
        Self {
            file: None,
            set: Vec::new(),
            variable: env::var_os("FIPA_CONFIG").map(PathBuf::from),
            current_dir: env::current_dir().ok(),
            home: env::home_dir(),
            host_name: gethostname::gethostname().to_string_lossy().into_owned(),
        }
    }

    /// The file that counts, with its name as shown to people, if there is any.
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
        let usual = [
            (local, "found in the current directory"),
            (of_user, "found in the home directory"),
        ];
        for (path, named_by) in usual {
            let Some(path) = path else { continue };
            match read(&self.absolute(&path)) {
                Ok(text) => return Ok(Some(Found { path, text })),
                Err(error) if is_absent(&error) => {}
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
    /// Its name, as shown to people.
    pub(super) path: PathBuf,
    pub(super) text: String,
}

fn is_absent(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
    )
}

fn read(path: &Path) -> io::Result<String> {
    let mut bytes = Vec::new();
    File::open(path)?
        .take(MAX_FILE + 1)
        .read_to_end(&mut bytes)?;
    if bytes.len() as u64 > MAX_FILE {
        let message = format!("larger than {MAX_FILE} bytes, so it is no configuration");
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
