//! Compiles and runs programs in C and C++ against the library.

#![allow(dead_code, reason = "each file of tests uses a part")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use fipa::blocking::Wait as _;
use fipa::config::Sources;
use fipa::{Config, Domain};
use fipa_testbed::languages::{self, bindings, link_library};

pub(crate) const SHARED: &[&str] = &["-lfipa_c"];
pub(crate) const STATIC: &[&str] = &["-l:libfipa_c.a", "-lpthread", "-ldl", "-lm"];

/// The warnings of C.
pub(crate) const C: &[&str] = &[
    "-std=c99",
    "-D_POSIX_C_SOURCE=200809L",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-pedantic",
    "-g",
];

/// A directory for programs, with the configuration of a domain of their own.
pub(crate) struct Workshop {
    dir: tempfile::TempDir,
}

impl Workshop {
    pub(crate) fn new() -> Self {
        let dir = tempfile::tempdir().expect("a directory");
        let text = format!(
            "domain = \"test\"\nruntime_dir = \"{}\"\n",
            dir.path().join("run").display()
        );
        fs::write(dir.path().join("fipa.toml"), text).expect("the configuration can be written");
        link_library(dir.path());
        Self { dir }
    }

    pub(crate) fn path(&self) -> &Path {
        self.dir.path()
    }

    pub(crate) fn config(&self) -> PathBuf {
        self.dir.path().join("fipa.toml")
    }

    /// Joins the domain of the programs.
    pub(crate) fn domain(&self) -> Domain {
        let mut sources = Sources::from_environment();
        sources.file = Some(self.config());
        let config = Config::load(&sources).expect("the configuration is right");
        Domain::open(&config).wait().expect("a domain")
    }

    /// Compiles a source with all headers in reach, and returns the program or what `flags` say to make.
    pub(crate) fn compile(
        &self,
        compiler: &str,
        source: &Path,
        name: &str,
        flags: &[&str],
        link: &[&str],
    ) -> PathBuf {
        let made = self.dir.path().join(name);
        let version = format!("-DVERSION=\"{}\"", env!("CARGO_PKG_VERSION"));
        let mut flags = [flags, &[&*version]].concat();
        flags.extend(cfg!(feature = "gateway").then_some("-DFIPA_GATEWAY"));
        languages::compile(compiler, source, &made, &flags, link);
        made
    }

    /// Returns the command of a program, under a tool with arguments if there is one.
    pub(crate) fn command(&self, program: &Path, under: &[&str]) -> Command {
        let mut command = match under.split_first() {
            Some((tool, arguments)) => {
                let mut command = Command::new(tool);
                command.args(arguments).arg(program);
                command
            }
            None => Command::new(program),
        };
        command
            .arg(self.config())
            .arg(self.path())
            .env("FIPA_CONFIG", self.config())
            .env("LD_LIBRARY_PATH", self.path());
        command
    }
}

impl Drop for Workshop {
    /// A process that joins removes what programs that have crashed left in shared memory.
    fn drop(&mut self) {
        if self.path().join("run").exists() {
            self.domain().close().wait();
        }
    }
}

/// Runs a program to its end, and checks that it has passed all its steps.
pub(crate) fn passes(command: &mut Command) {
    let output = command.output().expect("the program runs");
    let text = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success() && text.ends_with("all steps passed\n"),
        "{command:?}: {}\n{text}{errors}",
        output.status
    );
}

/// Compiles and runs a program of `tests/c`, with a domain of its own.
pub(crate) fn run(program: &str, link: &[&str], under: &[&str]) {
    let workshop = Workshop::new();
    let source = bindings("c/tests/c").join(program).with_extension("c");
    let binary = workshop.compile("cc", &source, program, C, link);
    passes(&mut workshop.command(&binary, under));
}

/// Compiles and runs a program of `tests/c` with the sanitizers of the compiler. The library itself has none.
pub(crate) fn run_sanitized(program: &str, options: &str) {
    let workshop = Workshop::new();
    let source = bindings("c/tests/c").join(program).with_extension("c");
    let flags = [C, SANITIZERS].concat();
    let binary = workshop.compile("cc", &source, program, &flags, SHARED);
    passes(workshop.command(&binary, &[]).env("ASAN_OPTIONS", options));
}

/// A finding ends the program with an error.
pub(crate) const SANITIZERS: &[&str] =
    &["-fsanitize=address,undefined", "-fno-sanitize-recover=all"];
