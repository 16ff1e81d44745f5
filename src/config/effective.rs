//! The configuration with the origin of every value.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::keys::{KEYS, MAPS, Value, bare_or_quoted, dotted};
use super::reader::Reader;
use super::sources::Found;
use super::{Config, ConfigError, Origin, Sources, machine};

/// The configuration with the origin of every value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Effective {
    config: Config,
    origins: BTreeMap<Vec<String>, Origin>,
    file: Option<PathBuf>,
}

/// One value of the configuration.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Setting {
    /// The path to it, for example `["mts", "deadline"]` or `["routes", "camera_.*"]`.
    pub path: Vec<String>,
    /// The value.
    pub value: Value,
    /// The origin of the value.
    pub origin: Origin,
}

impl Effective {
    /// Finds, reads and checks the configuration, and records the origin of every value.
    ///
    /// # Errors
    /// If a file cannot be read, or if the configuration has mistakes; the error lists all of them.
    pub fn load(sources: &Sources) -> Result<Self, ConfigError> {
        Self::of(sources, sources.read()?, false)
    }

    /// Loads the configuration like [`load`](Self::load), and also checks what its values name on this
    /// machine: the key directory, the protocol files, the network interfaces, and whether the
    /// transports of static peers are on.
    ///
    /// [`load`](Self::load) does not check these, because one file serves all processes of a robot, and
    /// an interface can appear later.
    ///
    /// # Errors
    /// If a file cannot be read, or if there are mistakes; the error lists all of them.
    pub fn check(sources: &Sources) -> Result<Self, ConfigError> {
        Self::of(sources, sources.read()?, true)
    }

    /// Reads and checks the file that was found, `$FIPA_DOMAIN` and the `--set` arguments.
    fn of(
        sources: &Sources,
        found: Option<Found>,
        with_machine: bool,
    ) -> Result<Self, ConfigError> {
        let mut reader = Reader::new(&sources.host_name);
        for assignment in sources.set.iter().rev() {
            reader.set(assignment);
        }
        // The arguments were read in reverse, because the last one for a key counts.
        reader.mistakes.reverse();
        if let Some(domain) = sources.domain.as_deref().filter(|name| !name.is_empty()) {
            reader.domain(domain);
        }
        if let Some(found) = &found {
            reader.file(&found.path, &found.text);
        }
        reader.check();
        if with_machine {
            let findings = machine::findings(&reader.config);
            findings.into_iter().for_each(|finding| reader.add(finding));
        }
        if !reader.mistakes.is_empty() {
            return Err(ConfigError::Mistakes(reader.mistakes));
        }
        Ok(Self::new(reader, found.map(|found| found.path)))
    }

    /// Reads and checks a text as if it stood in `fipa.toml`.
    #[cfg(feature = "fuzzing")]
    pub(crate) fn of_text(sources: &Sources, text: String) -> Result<Self, ConfigError> {
        let path = PathBuf::from("fipa.toml");
        Self::of(sources, Some(Found { path, text }), false)
    }

    pub(super) fn new(reader: Reader, file: Option<PathBuf>) -> Self {
        Self {
            config: reader.config,
            origins: reader.origins,
            file,
        }
    }

    /// Returns the configuration.
    #[must_use]
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Returns the configuration without the origins.
    #[must_use]
    pub fn into_config(self) -> Config {
        self.config
    }

    /// Returns the path of the file that was read, as it was given; `None` if no file was found.
    #[must_use]
    pub fn file(&self) -> Option<&Path> {
        self.file.as_deref()
    }

    /// Returns every value, in the order of [`Effective::render`].
    #[must_use]
    pub fn settings(&self) -> Vec<Setting> {
        let setting = |path: Vec<String>, value| {
            let origin = self.origins.get(&path).cloned().unwrap_or(Origin::Default);
            Setting {
                path,
                value,
                origin,
            }
        };
        let keys = KEYS.iter().map(|key| {
            let path = key.path.iter().map(|&part| part.to_owned()).collect();
            setting(path, (key.read)(&self.config))
        });
        let mut settings: Vec<Setting> = keys.collect();
        for map in MAPS {
            for (name, value) in (map.read)(&self.config) {
                let names = map.path.iter().copied().chain([name]);
                settings.push(setting(names.map(str::to_owned).collect(), value));
            }
        }
        settings
    }

    /// Renders the configuration as one complete TOML file. A comment after every value states its
    /// origin: `# default`, `# fipa.toml:12`, `# $FIPA_DOMAIN` or `# --set`.
    #[must_use]
    pub fn render(&self) -> String {
        // Writing to a string cannot fail.
        let mut text = String::new();
        let mut section: Vec<String> = Vec::new();
        for Setting {
            path,
            value,
            origin,
        } in self.settings()
        {
            let Some((name, parents)) = path.split_last() else {
                continue;
            };
            if section != parents {
                section = parents.to_vec();
                let names: Vec<&str> = parents.iter().map(String::as_str).collect();
                let _ = writeln!(text, "\n[{}]", dotted(&names));
            }
            let line = format!("{} = {}", bare_or_quoted(name), value.to_toml());
            let origin = match origin {
                Origin::Set { .. } => "--set".to_owned(),
                other => other.to_string(),
            };
            let _ = writeln!(text, "{line:<36} # {origin}");
        }
        for map in MAPS {
            if (map.read)(&self.config).is_empty() {
                let table = format!("[{}]", dotted(map.path));
                let _ = writeln!(text, "\n{table:<36} # default");
            }
        }
        text
    }
}
