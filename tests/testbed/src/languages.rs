//! Programs in C, C++ and Python, against the libraries that cargo has built for a test.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::{can_run, is_complete};

/// Returns the directory with the libraries that cargo has built for this test.
#[must_use]
pub fn libraries() -> PathBuf {
    let test = std::env::current_exe().expect("the test has a path");
    let parent = test.parent().expect("the test is in target/debug/deps");
    parent.to_owned()
}

/// Returns the path of a file or a folder in `bindings`.
#[must_use]
pub fn bindings(path: &str) -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2);
    root.expect("the repository").join("bindings").join(path)
}

/// Links the library for C into a directory, under the name that the loader looks for.
pub fn link_library(into: &Path) {
    symlink(libraries().join("libfipa_c.so"), into.join("libfipa.so.0")).expect("a link");
}

/// Compiles a source with all headers and libraries in reach, and makes a program or what `flags` say.
pub fn compile(compiler: &str, source: &Path, made: &Path, flags: &[&str], link: &[&str]) {
    let compiled = Command::new(compiler)
        .args(flags)
        .arg("-I")
        .arg(bindings("c/include"))
        .arg("-I")
        .arg(bindings("cpp/include"))
        .arg(source)
        .arg("-o")
        .arg(made)
        .arg("-L")
        .arg(libraries())
        .args(link)
        .status();
    assert!(
        compiled.expect("the compiler runs").success(),
        "{compiler} {flags:?} {}",
        source.display()
    );
}

/// Returns the command of a Python that can load the module, which is for CPython 3.11 and later versions. The
/// environment variable `FIPA_PYTHON` selects another one.
#[must_use]
pub fn python() -> String {
    if let Ok(chosen) = std::env::var("FIPA_PYTHON") {
        return chosen;
    }
    let recent = "import sys; sys.exit(sys.version_info < (3, 11))";
    let version = Command::new("python3").args(["-c", recent]).status();
    match version.is_ok_and(|version| version.success()) {
        true => "python3".to_owned(),
        false => "python3.11".to_owned(),
    }
}

/// Whether the test `name` can run: there is a Python, with these modules. If not, prints a note, or panics if
/// `CI=true`.
///
/// # Panics
/// If the test cannot run and `CI=true`.
#[must_use]
pub fn can_import(name: &str, modules: &[&str]) -> bool {
    let python = python();
    if !can_run(name, &[&python], true) {
        return false;
    }
    let find = "import sys, importlib.util as it; sys.exit(it.find_spec(sys.argv[1]) is None)";
    let is_missing = |module: &&str| {
        let found = Command::new(&python).args(["-c", find, module]).status();
        !found.is_ok_and(|found| found.success())
    };
    let missing: Vec<&str> = modules.iter().copied().filter(is_missing).collect();
    is_complete(name, &missing)
}

fn copy_sources(from: &Path, to: &Path) {
    fs::create_dir(to).expect("a directory");
    for source in fs::read_dir(from).expect("the sources are there") {
        let source = source.expect("an entry").path();
        if source.is_file() {
            let name = source.file_name().expect("a name");
            fs::copy(&source, to.join(name)).expect("the source can be copied");
        }
    }
}

/// Returns the Pythons with a rclpy of ROS 2, one for each release, that the environment variable `FIPA_ROS2` names with
/// colons between them. If the test `name` cannot run, prints a note, or panics if `CI=true`.
///
/// # Panics
/// If the test cannot run and `CI=true`.
#[must_use]
pub fn ros2_pythons(name: &str) -> Vec<String> {
    let named = std::env::var("FIPA_ROS2").unwrap_or_default();
    let pythons: Vec<String> = named.split_terminator(':').map(str::to_owned).collect();
    let mut missing = Vec::new();
    if pythons.is_empty() {
        missing.push("rclpy: `export FIPA_ROS2=$(.ci/ros2)`");
    }
    if !libraries().join("libfipa_python.so").exists() {
        missing.push("the module for Python: `cargo build -p fipa-python`");
    }
    match is_complete(name, &missing) {
        true => pythons,
        false => Vec::new(),
    }
}

/// Returns a Python with the package `mcap` of PyPI: the one that the environment variable `FIPA_MCAP` names, or that of
/// `target/mcap`. If the test `name` cannot run, prints a note, or panics if `CI=true`.
///
/// # Panics
/// If the test cannot run and `CI=true`.
#[must_use]
pub fn mcap_python(name: &str) -> Option<String> {
    let built = libraries();
    let built = built
        .ancestors()
        .nth(2)
        .map(|target| target.join("mcap/bin/python"));
    let built = built.filter(|python| python.exists());
    let named = std::env::var("FIPA_MCAP").ok();
    let python = named.or_else(|| built.map(|python| python.to_string_lossy().into_owned()));
    let missing = match &python {
        Some(_) => Vec::new(),
        None => vec!["the package mcap for Python: `export FIPA_MCAP=$(.ci/mcap)`"],
    };
    match is_complete(name, &missing) {
        true => python,
        false => None,
    }
}

/// Puts the package `fipa` for Python into a directory, with the module that cargo has built.
pub fn install_package(into: &Path) {
    let to = into.join("fipa");
    copy_sources(&bindings("python/fipa"), &to);
    copy_sources(&bindings("python/fipa/ros2"), &to.join("ros2"));
    let module = libraries().join("libfipa_python.so");
    symlink(module, to.join("_native.abi3.so")).expect("a link");
}
