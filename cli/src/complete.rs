//! Completion of command lines: the texts that depend on the configuration and the running agents.
//!
//! The shell runs this program with `$FIPA_COMPLETE`, and clap's engine completes commands and options
//! by itself. Nothing here joins a domain, so that a completion takes milliseconds.

use std::ffi::{OsStr, OsString};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use clap_complete::CompleteEnv;
use clap_complete::engine::{
    ArgValueCompleter, CompletionCandidate, PathCompleter, ValueCompleter as _,
};
use clap_complete::env::{Bash, EnvCompleter, Fish, Shells, Zsh};
use fipa::Domain;
use fipa::config::{Effective, Sources, Value};
use fipa::locks::ENTRY_PREFIX;
use fipa::monitor::Library;
use fipa_acl::is_unprintable;

use crate::options;

/// The variable with which a shell asks for completions.
pub(crate) const VARIABLE: &str = "FIPA_COMPLETE";

/// Tables whose keys the user chooses.
const TABLES: [&str; 4] = [
    "routes.",
    "discovery.static.",
    "access.allow.",
    "access.deny.",
];

/// Answers a shell that asks for completions, and ends the process. Returns if none does.
pub(crate) fn answer() {
    CompleteEnv::with_factory(options::command)
        .var(VARIABLE)
        .shells(Shells(&[&PlainBash, &Zsh, &Fish]))
        .complete();
}

/// The completions of bash that need no quotes. Bash inserts a completion into the command line as it is,
/// where a file or an agent named `a;reboot` would become two commands. Zsh and fish add quotes.
///
/// Where no completion is left, bash completes names of files by itself, with quotes.
struct PlainBash;

impl EnvCompleter for PlainBash {
    fn name(&self) -> &'static str {
        Bash.name()
    }

    fn is(&self, name: &str) -> bool {
        Bash.is(name)
    }

    fn write_registration(
        &self,
        variable: &str,
        name: &str,
        command: &str,
        completer: &str,
        out: &mut dyn Write,
    ) -> io::Result<()> {
        Bash.write_registration(variable, name, command, completer, out)
    }

    fn write_complete(
        &self,
        command: &mut clap::Command,
        words: Vec<OsString>,
        directory: Option<&Path>,
        out: &mut dyn Write,
    ) -> io::Result<()> {
        let mut all = Vec::new();
        Bash.write_complete(command, words, directory, &mut all)?;
        // The script of clap sets this variable.
        let separator = std::env::var("_CLAP_IFS").unwrap_or_else(|_| "\n".to_owned());
        let all = String::from_utf8_lossy(&all);
        let plain: Vec<&str> = all.split(&*separator).filter(|it| is_plain(it)).collect();
        out.write_all(plain.join(&separator).as_bytes())
    }
}

/// Whether the word means itself in bash, zsh and fish: a letter, a digit or one of these characters has no
/// other meaning there. A `=` has one at the beginning only, in zsh.
fn is_plain(word: &str) -> bool {
    // U+3164 is a letter, and invisible.
    let is_plain = |c: char| c.is_alphanumeric() && !is_unprintable(c) || "_-./@:,=".contains(c);
    word.chars().all(is_plain) && !word.starts_with('=')
}

/// Completes the name of an agent of the domain.
pub(crate) fn agents() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        let names = names().into_iter();
        beginning(
            current,
            names.filter(|name| !name.starts_with(ENTRY_PREFIX)),
        )
    })
}

/// Completes the name of a resource that an agent of the domain owns.
pub(crate) fn resources() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        let names = names().into_iter();
        let resources = names.filter_map(|name| name.strip_prefix(ENTRY_PREFIX).map(str::to_owned));
        beginning(current, resources)
    })
}

/// Completes the name of a built-in protocol, and with `files` also the path of a file.
pub(crate) fn protocols(files: bool) -> ArgValueCompleter {
    ArgValueCompleter::new(move |current: &OsStr| {
        let library = Library::standard();
        let names = library.iter().map(|machine| machine.name().to_owned());
        let mut found = beginning(current, names);
        if files {
            found.extend(PathCompleter::any().complete(current));
        }
        found
    })
}

/// The names in the directory of the domain.
fn names() -> Vec<String> {
    let effective = Effective::load(&sources(words())).ok();
    let names = effective.and_then(|effective| Domain::names(effective.config()).ok());
    names.unwrap_or_default()
}

/// Of these names, those that begin with the incomplete word. Names come from other hosts, too: one that
/// needs quotes in a shell or begins like an option is left out.
fn beginning(current: &OsStr, names: impl Iterator<Item = String>) -> Vec<CompletionCandidate> {
    let current = current.to_string_lossy();
    names
        .filter(|name| name.starts_with(&*current) && is_plain(name) && !name.starts_with('-'))
        .map(CompletionCandidate::new)
        .collect()
}

/// Completes a key of the configuration, for `--set`.
pub(crate) fn keys() -> ArgValueCompleter {
    ArgValueCompleter::new(|current: &OsStr| {
        let current = current.to_string_lossy();
        let defaults = Effective::load(&Sources::default());
        let settings = defaults.map(|all| all.settings()).unwrap_or_default();
        let keys = settings.into_iter().map(|setting| {
            let help = match setting.value {
                Value::Text(text) => text,
                Value::List(items) => items.join(", "),
                Value::Truth(truth) => truth.to_string(),
                Value::Number(number) => number.to_string(),
                _ => String::new(),
            };
            (format!("{}=", setting.path.join(".")), help)
        });
        let tables = TABLES.map(|table| (table.to_owned(), String::new()));
        keys.chain(tables)
            .filter(|(key, _)| key.starts_with(&*current))
            .map(|(key, help)| {
                let help = Some(help).filter(|help| !help.is_empty());
                CompletionCandidate::new(key)
                    .help(help.map(|help| format!("default: {help}").into()))
            })
            .collect()
    })
}

/// The words of the command line that is completed, which follow the first `--`.
fn words() -> impl Iterator<Item = OsString> {
    std::env::args_os().skip_while(|word| word != "--").skip(1)
}

/// The sources of the configuration that this command line names.
pub(crate) fn sources(words: impl Iterator<Item = OsString>) -> Sources {
    let mut sources = Sources::from_environment();
    let mut words = words.map(|word| word.to_string_lossy().into_owned());
    while let Some(word) = words.next() {
        let (option, value) = match word.split_once('=') {
            Some((option, value)) if option.starts_with("--") => (option, Some(value.to_owned())),
            _ => (word.as_str(), None),
        };
        match option {
            "--set" => sources.set.extend(value.or_else(|| words.next())),
            "--config" => sources.file = value.or_else(|| words.next()).map(PathBuf::from),
            _ => {}
        }
    }
    // An assignment that is not complete yet.
    sources.set.retain(|set| set.contains('='));
    sources
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_need_no_quotes_are_completed() {
        let plain = ["zrover", "zrover_2", "z.b-c/d@host:1099", "zéla", "z机器人"];
        let hostile = [
            "zrover;reboot",
            "z`reboot`",
            "z$HOME",
            "z&",
            "z|",
            "z>f",
            "z<f",
            "z\"",
            "z'",
            "z\\",
            "z f",
            "z!",
            "z#",
            "z*",
            "z~",
            "z%self",
            "z\n",
            "z\u{a0}",
            "z\u{3164}",
            "z)",
            "z}",
            "z]",
        ];
        let names = plain.iter().chain(&hostile).map(|name| (*name).to_owned());
        let found = beginning(OsStr::new("z"), names);
        let found: Vec<_> = found.iter().map(CompletionCandidate::get_value).collect();
        assert_eq!(found, plain);
        for name in ["-x", "--set=a", "~root", "=reboot", "#x"] {
            assert_eq!(beginning(OsStr::new(""), [name.to_owned()].into_iter()), []);
        }
    }

    #[test]
    fn the_options_of_the_command_line_select_the_configuration() {
        let words = [
            "fipa",
            "--set",
            "domain=a",
            "send",
            "--config",
            "x.toml",
            "--set=mts.queue=7",
            "--to",
            "arm",
            "--set",
            "mts.dead",
        ];
        let sources = sources(words.into_iter().map(OsString::from));
        assert_eq!(sources.set, ["domain=a", "mts.queue=7"]);
        assert_eq!(sources.file, Some(PathBuf::from("x.toml")));
    }
}
