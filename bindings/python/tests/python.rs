//! Runs the tests in Python against the module that cargo has built for this test.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use fipa::blocking::Wait as _;
use fipa::config::Sources;
use fipa::{Config, Domain};
use fipa_testbed::can_run;

/// The package, and the configuration of a domain of its own.
struct Package(tempfile::TempDir);

impl Package {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a directory");
        let to = dir.path().join("fipa");
        fs::create_dir(&to).expect("a directory");
        let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("fipa");
        for source in fs::read_dir(sources).expect("the sources are there") {
            let source = source.expect("an entry").path();
            if source.is_file() {
                let name = source.file_name().expect("a name");
                fs::copy(&source, to.join(name)).expect("the source can be copied");
            }
        }
        let test = std::env::current_exe().expect("the test has a path");
        let module = test.with_file_name("libfipa_python.so");
        symlink(module, to.join("_native.abi3.so")).expect("a link");
        let package = Self(dir);
        let runtime = package.0.path().join("run");
        let text = format!(
            "domain = \"test\"\nruntime_dir = \"{}\"\n",
            runtime.display()
        );
        fs::write(package.config(), text).expect("the configuration can be written");
        package
    }

    fn config(&self) -> PathBuf {
        self.0.path().join("fipa.toml")
    }

    /// Returns a Python that finds the package.
    fn python(&self) -> Command {
        let mut python = Command::new("python3");
        python
            .env("PYTHONPATH", self.0.path())
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .env("FIPA_CONFIG", self.config());
        python
    }
}

impl Drop for Package {
    /// A process that joins removes what programs that were killed have left in shared memory.
    fn drop(&mut self) {
        if self.0.path().join("run").exists() {
            let mut sources = Sources::from_environment();
            sources.file = Some(self.config());
            let config = Config::load(&sources).expect("the configuration is right");
            Domain::open(&config)
                .wait()
                .expect("a domain")
                .close()
                .wait();
        }
    }
}

/// Runs the tests of a file.
fn run(tests: &str) {
    // The module is for CPython 3.11 and later versions.
    let recent = "import sys; sys.exit(sys.version_info < (3, 11))";
    let version = Command::new("python3").args(["-c", recent]).status();
    let tool = match version.is_ok_and(|version| version.success()) {
        true => "python3",
        false => "python3.11",
    };
    if !can_run(tests, &[tool], true) {
        return;
    }
    let package = Package::new();
    let output = package
        .python()
        .args([
            "-X",
            "faulthandler",
            "-W",
            "error",
            "-m",
            "unittest",
            "-v",
            tests,
        ])
        .current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests"))
        .output()
        .expect("python3 runs");
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}\n{text}", output.status);
}

#[test]
fn examples() {
    run("test_examples");
}

#[test]
fn messages() {
    run("test_messages");
}

#[test]
fn protocols() {
    run("test_protocols");
}

#[test]
fn waiting() {
    run("test_waiting");
}
