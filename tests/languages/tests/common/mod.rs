//! The programs of all languages, and domains for them.

#![allow(dead_code, reason = "each file of tests uses a part")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use fipa::blocking::Wait as _;
use fipa::config::Sources;
use fipa::{Config, Domain};
use fipa_testbed::can_run;
use fipa_testbed::languages::{compile, install_package, link_library, python};

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
        let c = ["-std=c99", "-D_POSIX_C_SOURCE=200809L"];
        let cpp = ["-std=c++17", "-Wshadow", "-Wconversion"];
        let rust = Path::new(env!("CARGO_BIN_EXE_languages_serve"));
        let rust = |role: &&str| vec![rust.with_file_name(format!("languages_{role}"))];
        let rust = Language {
            name: "Rust",
            extension: "rs",
            programs: roles.iter().map(rust).collect(),
        };
        let compiled = |name, tool: &str, extension, flags: &[&str]| {
            can_run(&format!("{test} with {name}"), &[tool], true).then(|| {
                let program = |role: &&str| vec![self.compiled(tool, role, extension, flags)];
                Language {
                    name,
                    extension,
                    programs: roles.iter().map(program).collect(),
                }
            })
        };
        let tool = python();
        let python = can_run(&format!("{test} with Python"), &[tool], true).then(|| Language {
            name: "Python",
            extension: "py",
            programs: roles
                .iter()
                .map(|role| vec![tool.into(), source(role, "py")])
                .collect(),
        });
        [
            Some(rust),
            compiled("C", "cc", "c", &c),
            compiled("C++", "c++", "cpp", &cpp),
            python,
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    /// Compiles a program with warnings as errors.
    fn compiled(&self, tool: &str, role: &str, extension: &str, flags: &[&str]) -> PathBuf {
        let program = self.path().join(format!("{role}_{extension}"));
        let warnings = ["-O1", "-Wall", "-Wextra", "-Werror", "-pedantic"];
        let flags = [flags, &warnings].concat();
        let link = ["-lfipa_c", "-lm"];
        compile(tool, &source(role, extension), &program, &flags, &link);
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

/// Returns a path of this package.
pub(crate) fn here(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn source(role: &str, extension: &str) -> PathBuf {
    here("programs").join(role).with_extension(extension)
}
