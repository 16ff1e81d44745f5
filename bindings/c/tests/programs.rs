//! Programs in C, compiled with all warnings as errors, run against the shared and the static library.

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use fipa_testbed::can_run;

/// Builds the library, and returns the directory with it.
fn library() -> PathBuf {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let built = Command::new(env!("CARGO"))
        .args(["build", "--locked", "--quiet", "-p", "fipa-c"])
        .current_dir(here)
        .status();
    assert!(built.expect("cargo runs").success());
    let test = env::current_exe().expect("the test has a path");
    let profile = test
        .ancestors()
        .nth(2)
        .expect("the test is in target/debug/deps");
    profile.to_owned()
}

/// Compiles and runs a program, with a domain of its own.
fn run(program: &str, link: &[&str], under: &[&str]) {
    let library = library();
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let dir = tempfile::tempdir().expect("a directory");
    let binary = dir.path().join(program);
    let compiled = Command::new("cc")
        .args([
            "-std=c99",
            "-D_POSIX_C_SOURCE=200809L",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-pedantic",
            "-g",
        ])
        .arg(format!("-DVERSION=\"{}\"", env!("CARGO_PKG_VERSION")))
        .arg("-I")
        .arg(here.join("include"))
        .arg(here.join("tests/c").join(program).with_extension("c"))
        .arg("-o")
        .arg(&binary)
        .arg("-L")
        .arg(&library)
        .args(link)
        .args(["-lpthread", "-ldl", "-lm"])
        .status();
    assert!(compiled.expect("cc runs").success());

    let config = dir.path().join("fipa.toml");
    let text = format!(
        "domain = \"test\"\nruntime_dir = \"{}\"\n",
        dir.path().join("run").display()
    );
    fs::write(&config, text).expect("the configuration can be written");
    // The name under which the loader looks for it.
    let shared = dir.path().join("libfipa.so.0");
    std::os::unix::fs::symlink(library.join("libfipa_c.so"), shared).expect("a link");
    let mut command = match under.split_first() {
        Some((tool, arguments)) => {
            let mut command = Command::new(tool);
            command.args(arguments).arg(&binary);
            command
        }
        None => Command::new(&binary),
    };
    let output = command
        .arg(&config)
        .arg(dir.path())
        .env("LD_LIBRARY_PATH", dir.path())
        .output()
        .expect("the program runs");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success(),
        "{program}: {}\n{text}{errors}",
        output.status
    );
    assert!(
        text.ends_with("all steps passed\n"),
        "{program}: {text}{errors}"
    );
}

const SHARED: &[&str] = &["-lfipa_c"];
const STATIC: &[&str] = &["-l:libfipa_c.a"];

#[test]
fn each_call_works_with_the_shared_library() {
    run("tour", SHARED, &[]);
}

#[test]
fn each_call_works_with_the_static_library() {
    run("tour", STATIC, &[]);
}

#[test]
fn wrong_input_is_an_error_and_no_crash() {
    run("misuse", SHARED, &[]);
}

#[test]
fn valgrind_finds_no_wrong_access_and_no_leak() {
    if !can_run(
        "valgrind_finds_no_wrong_access_and_no_leak",
        &["valgrind"],
        true,
    ) {
        return;
    }
    let known = format!(
        "--suppressions={}/tests/c/valgrind.supp",
        env!("CARGO_MANIFEST_DIR")
    );
    let memcheck = ["valgrind", "-q", "--error-exitcode=9", &known];
    let leaks = [
        "--leak-check=full",
        "--show-leak-kinds=definite",
        "--errors-for-leak-kinds=definite",
    ];
    run("tour", SHARED, &[&memcheck[..], &leaks].concat());
    // Its forked child cannot free what belonged to threads of the parent.
    run("misuse", SHARED, &memcheck);
}
