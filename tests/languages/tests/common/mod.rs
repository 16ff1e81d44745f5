//! The programs of all languages, and domains for them.

#![allow(dead_code, reason = "each file of tests uses a part")]

use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

use fipa::blocking::Wait as _;
use fipa::config::Sources;
use fipa::{Config, Domain};
use fipa_testbed::languages::{compile, install_package, link_library, python};
use fipa_testbed::{ChildGuard, can_run};

/// Time after which a process hangs. No run takes a tenth of it.
const WATCHDOG: Duration = Duration::from_secs(200);

/// A language, and the commands of its programs.
pub(crate) struct Language {
    pub(crate) name: &'static str,
    /// The extension of its sources.
    pub(crate) extension: &'static str,
    /// The commands in the order of the roles.
    pub(crate) programs: Vec<Vec<PathBuf>>,
}

/// A directory with the programs, and the libraries that they load.
pub(crate) struct Workshop(tempfile::TempDir);

impl Workshop {
    pub(crate) fn new() -> Self {
        let dir = tempfile::tempdir().expect("a directory");
        link_library(dir.path());
        install_package(dir.path());
        Self(dir)
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    /// Returns the languages that this machine has, with the programs of these roles.
    pub(crate) fn languages(&self, test: &str, roles: &[&str]) -> Vec<Language> {
        let rust = Path::new(env!("CARGO_BIN_EXE_languages_serve"));
        let rust = |role: &&str| vec![rust.with_file_name(format!("languages_{role}"))];
        let rust = Language {
            name: "Rust",
            extension: "rs",
            programs: roles.iter().map(rust).collect(),
        };
        let compiled = |name, tool: &str, extension| {
            can_run(&format!("{test} with {name}"), &[tool], true).then(|| {
                let program = |role: &&str| vec![self.compiled(&source(role, extension))];
                Language {
                    name,
                    extension,
                    programs: roles.iter().map(program).collect(),
                }
            })
        };
        let tool = python();
        let python = can_run(&format!("{test} with Python"), &[&tool], true).then(|| Language {
            name: "Python",
            extension: "py",
            programs: roles
                .iter()
                .map(|role| vec![PathBuf::from(&tool), source(role, "py")])
                .collect(),
        });
        [
            Some(rust),
            compiled("C", "cc", "c"),
            compiled("C++", "c++", "cpp"),
            python,
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    /// Compiles a program in C or C++ with warnings as errors.
    pub(crate) fn compiled(&self, source: &Path) -> PathBuf {
        let is_c = source.extension().is_some_and(|extension| extension == "c");
        let (tool, flags) = match is_c {
            true => ("cc", ["-std=c99", "-D_POSIX_C_SOURCE=200809L"]),
            false => ("c++", ["-std=c++17", "-Wconversion"]),
        };
        let name = source.file_name().expect("a name").to_string_lossy();
        let program = self.path().join(name.replace('.', "_"));
        let warnings = [
            "-O1",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-pedantic",
            "-Wshadow",
        ];
        let flags = [&flags[..], &warnings].concat();
        compile(tool, source, &program, &flags, &["-lfipa_c", "-lm"]);
        program
    }
}

/// A domain of one run.
pub(crate) struct RunDomain {
    dir: tempfile::TempDir,
    name: String,
}

impl RunDomain {
    pub(crate) fn new() -> Self {
        let dir = tempfile::Builder::new()
            .prefix("languages-")
            .tempdir()
            .expect("a directory");
        // Its random characters also tell the files in shared memory apart.
        let name = dir.path().file_name().expect("a name");
        let name = name.to_string_lossy().into_owned();
        let runtime = dir.path().join("run");
        let text = format!(
            "domain = \"{name}\"\nruntime_dir = \"{}\"\n[monitor]\ncheck = \"warn\"\n[mts]\ndeadline = \"2min\"\n",
            runtime.display()
        );
        fs::write(dir.path().join("fipa.toml"), text).expect("the configuration can be written");
        Self { dir, name }
    }

    /// Returns the command of a program.
    pub(crate) fn command(&self, workshop: &Workshop, program: &[PathBuf]) -> Command {
        let (tool, arguments) = program.split_first().expect("a program");
        let mut command = Command::new(tool);
        command
            .args(arguments)
            .env("FIPA_CONFIG", self.config())
            .env("LD_LIBRARY_PATH", workshop.path())
            .env("PYTHONPATH", workshop.path())
            .env("PYTHONDONTWRITEBYTECODE", "1");
        command
    }

    fn config(&self) -> PathBuf {
        self.dir.path().join("fipa.toml")
    }

    /// Returns the files of the domain.
    pub(crate) fn files(&self) -> Vec<PathBuf> {
        let shared = fs::read_dir("/dev/shm").expect("the directory of shared memory");
        let run = fs::read_dir(self.dir.path().join("run"));
        let all = shared.chain(run.into_iter().flatten());
        let paths = all.map(|entry| entry.expect("an entry").path());
        let is_of_domain = |path: &PathBuf| path.to_string_lossy().contains(&self.name);
        paths.filter(is_of_domain).collect()
    }
}

impl Drop for RunDomain {
    /// A process that joins removes the files of processes that were killed.
    fn drop(&mut self) {
        if !self.files().is_empty() {
            let mut sources = Sources::from_environment();
            sources.file = Some(self.config());
            let config = Config::load(&sources).expect("the configuration is right");
            let domain = Domain::open(&config).wait().expect("a domain");
            domain.close().wait();
        }
    }
}

/// A process that reads and writes lines.
pub(crate) struct Process {
    pub(crate) name: String,
    pub(crate) guard: ChildGuard,
    lines: Receiver<String>,
}

impl Process {
    pub(crate) fn start(name: &str, command: &mut Command) -> Self {
        let mut guard = ChildGuard::start(command.stdin(Stdio::piped()).stdout(Stdio::piped()));
        let output = guard.child().stdout.take().expect("its output");
        let (found, lines) = channel();
        thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                // The test may have ended.
                let _ = found.send(line);
            }
        });
        Self {
            name: name.to_owned(),
            guard,
            lines,
        }
    }

    /// Writes a line to its standard input.
    pub(crate) fn reads(&mut self, line: &str) {
        let input = self.guard.child().stdin.as_mut().expect("its input");
        writeln!(input, "{line}").unwrap_or_else(|error| panic!("{}: {error}", self.name));
    }

    /// Returns the next line of its standard output; none at the end.
    pub(crate) fn line(&self) -> Option<String> {
        match self.lines.recv_timeout(WATCHDOG) {
            Ok(line) => Some(line),
            Err(RecvTimeoutError::Disconnected) => None,
            Err(RecvTimeoutError::Timeout) => panic!("{} hangs", self.name),
        }
    }

    /// Waits for the next line.
    #[track_caller]
    pub(crate) fn prints(&self, expected: &str) {
        assert_eq!(self.line().as_deref(), Some(expected), "{}", self.name);
    }

    /// Closes its standard input, and waits for its end without an error. Returns the other lines.
    #[track_caller]
    pub(crate) fn ends(mut self) -> Vec<String> {
        drop(self.guard.child().stdin.take());
        let lines = std::iter::from_fn(|| self.line()).collect();
        let status = self.guard.wait();
        assert!(status.success(), "{}: {status}", self.name);
        lines
    }
}

/// Returns a path of this package.
pub(crate) fn here(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn source(role: &str, extension: &str) -> PathBuf {
    here("programs").join(role).with_extension(extension)
}
