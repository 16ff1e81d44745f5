//! One scenario between two processes, for each pair of languages: the leader runs the steps against the server, and
//! prints what it observes. Every leader must print `scenario.txt`.

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::fs;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use fipa::blocking::Wait as _;
use fipa::config::Sources;
use fipa::{Config, Domain};
use fipa_testbed::languages::{compile, install_package, link_library, python};
use fipa_testbed::{ChildGuard, can_run};

/// Number of pairs that run at the same time.
const AT_ONCE: usize = 4;
/// Time in seconds after which a leader that hangs is killed. No run takes a tenth of it.
const WATCHDOG: &str = "200";
/// The step at which the server is killed.
const LAST_REQUEST: &str = "request without an end: ";

/// The programs of a language.
struct Language {
    name: &'static str,
    serve: Vec<PathBuf>,
    lead: Vec<PathBuf>,
}

/// A directory with the programs, and the libraries that they load.
struct Workshop(tempfile::TempDir);

impl Workshop {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a directory");
        link_library(dir.path());
        install_package(dir.path());
        Self(dir)
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    fn rust() -> Language {
        Language {
            name: "Rust",
            serve: vec![env!("CARGO_BIN_EXE_languages_serve").into()],
            lead: vec![env!("CARGO_BIN_EXE_languages_lead").into()],
        }
    }

    /// Compiles the programs of a language with warnings as errors.
    fn compiled(
        &self,
        name: &'static str,
        compiler: &str,
        extension: &str,
        flags: &[&str],
    ) -> Option<Language> {
        if !can_run(&format!("the matrix with {name}"), &[compiler], true) {
            return None;
        }
        let program = |role: &str| {
            let source = here("programs").join(role).with_extension(extension);
            let program = self.path().join(format!("{role}_{extension}"));
            let warnings = ["-O1", "-Wall", "-Wextra", "-Werror", "-pedantic"];
            let flags = [flags, &warnings].concat();
            compile(compiler, &source, &program, &flags, &["-lfipa_c"]);
            vec![program]
        };
        Some(Language {
            name,
            serve: program("serve"),
            lead: program("lead"),
        })
    }

    fn python() -> Option<Language> {
        let tool = python();
        let program = |file: &str| vec![tool.into(), here("programs").join(file)];
        can_run("the matrix with Python", &[tool], true).then(|| Language {
            name: "Python",
            serve: program("serve.py"),
            lead: program("lead.py"),
        })
    }
}

/// A domain of a pair.
struct PairDomain {
    dir: tempfile::TempDir,
    name: String,
}

impl PairDomain {
    fn new() -> Self {
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
    fn command(&self, workshop: &Workshop, program: &[PathBuf]) -> Command {
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
    fn files(&self) -> Vec<PathBuf> {
        let shared = fs::read_dir("/dev/shm").expect("the directory of shared memory");
        let run = fs::read_dir(self.dir.path().join("run"));
        let all = shared.chain(run.into_iter().flatten());
        let paths = all.map(|entry| entry.expect("an entry").path());
        let is_of_domain = |path: &PathBuf| path.to_string_lossy().contains(&self.name);
        paths.filter(is_of_domain).collect()
    }
}

impl Drop for PairDomain {
    /// A process that joins removes the files of processes that a failed run has left.
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

/// Returns a path of this package.
fn here(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// Returns a line without the random digits of conversation identifiers.
fn without_digits(line: &str) -> String {
    let mut parts = line.split("rover--");
    let mut result = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let rest = part.trim_start_matches(|digit: char| digit.is_ascii_hexdigit());
        result.push_str("rover--ID");
        result.push_str(rest);
    }
    result
}

/// Runs the scenario, and returns the output of the leader. Kills the server while the leader waits for it.
fn run(workshop: &Workshop, domain: &PairDomain, leader: &Language, server: &Language) -> String {
    let mut command = domain.command(workshop, &server.serve);
    let (mut serving, ready) = ChildGuard::until_ready(command.arg("arm"));
    assert_eq!(ready, "ready\n");
    let watched = [&["timeout".into(), WATCHDOG.into()], &leader.lead[..]].concat();
    let mut command = domain.command(workshop, &watched);
    command.args(["rover", "arm"]);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut leading = ChildGuard::start(&mut command);
    let output = leading.child().stdout.take().expect("its output");
    let mut observed = String::new();
    for line in BufReader::new(output).lines() {
        let line = line.expect("a text");
        if line.starts_with(LAST_REQUEST) {
            serving.kill();
        }
        observed.push_str(&without_digits(&line));
        observed.push('\n');
    }
    let mut errors = String::new();
    let mut from = leading.child().stderr.take().expect("its errors");
    from.read_to_string(&mut errors).expect("a text");
    let status = leading.wait();
    let pair = format!("{} leads {}", leader.name, server.name);
    assert!(status.success(), "{pair}: {status}\n{observed}{errors}");
    observed
}

#[test]
fn each_language_observes_the_same_from_each() {
    let workshop = Workshop::new();
    let c = ["-std=c99", "-D_POSIX_C_SOURCE=200809L"];
    let cpp = ["-std=c++17", "-Wshadow", "-Wconversion"];
    let languages: Vec<Language> = [
        Some(Workshop::rust()),
        workshop.compiled("C", "cc", "c", &c),
        workshop.compiled("C++", "c++", "cpp", &cpp),
        Workshop::python(),
    ]
    .into_iter()
    .flatten()
    .collect();
    let expected = fs::read_to_string(here("scenario.txt")).expect("the expected output");
    let count = languages.len().pow(2);
    let next = AtomicUsize::new(0);
    let work = || {
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= count {
                return;
            }
            let leader = &languages[number / languages.len()];
            let server = &languages[number % languages.len()];
            let domain = PairDomain::new();
            let observed = run(&workshop, &domain, leader, server);
            let pair = format!("{} leads {}", leader.name, server.name);
            assert_eq!(observed, expected, "{pair}");
            assert_eq!(domain.files(), Vec::<PathBuf>::new(), "{pair}");
        }
    };
    thread::scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(work);
        }
    });
}
