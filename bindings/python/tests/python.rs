//! Runs the tests in Python against the module that cargo has built for this test.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use fipa::blocking::Wait as _;
use fipa::config::Sources;
use fipa::{Config, Domain, Gateway};
use fipa_testbed::languages::{can_import, install_package, python};

/// The package, and the configuration of a domain of its own.
struct Package(tempfile::TempDir);

impl Package {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a directory");
        install_package(dir.path());
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
    fn command(&self) -> Command {
        let mut command = Command::new(python());
        command
            .env("PYTHONPATH", self.0.path())
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .env("FIPA_CONFIG", self.config());
        command
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

/// Runs the tests of a file, which need these modules, in a domain of their own.
fn run(tests: &str, modules: &[&str]) {
    if can_import(tests, modules) {
        run_in(&Package::new(), tests);
    }
}

fn run_in(package: &Package, tests: &str) {
    let output = package
        .command()
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
        .expect("python runs");
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}\n{text}", output.status);
}

#[test]
fn the_package_requires_the_command_of_its_version() {
    let project = Path::new(env!("CARGO_MANIFEST_DIR")).join("pyproject.toml");
    let text = fs::read_to_string(project).expect("the file is there");
    let required = format!("\"fipa-cli == {}\"", env!("CARGO_PKG_VERSION"));
    assert!(text.contains(&required), "{required} is not in {text}");
}

#[test]
fn examples() {
    run("test_examples", &[]);
}

#[test]
fn messages() {
    run("test_messages", &[]);
}

#[test]
fn plot() {
    run("test_plot", &["matplotlib"]);
}

#[test]
fn protocols() {
    run("test_protocols", &[]);
}

/// The directory facilitator is an agent of the gateway.
#[test]
fn services() {
    if !can_import("test_services", &[]) {
        return;
    }
    let package = Package::new();
    let mut sources = Sources::from_environment();
    sources.file = Some(package.config());
    let here = ["discovery.mdns=false", "mts.transports=shm,unix"];
    sources.set.extend(here.map(str::to_owned));
    let config = Config::load(&sources).expect("the configuration is right");
    let gateway = Gateway::open(&config).wait().expect("a gateway");
    run_in(&package, "test_services");
    gateway.close().wait();
}

#[test]
fn waiting() {
    run("test_waiting", &[]);
}
