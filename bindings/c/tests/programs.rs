//! Programs in C, compiled with all warnings as errors, run against the shared and the static library.

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use fipa::blocking::Wait;
use fipa::config::Sources;
use fipa::{Config, Domain, Performative};
use fipa_testbed::{ChildGuard, can_run, until};
use tempfile::TempDir;

/// A deadline that a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Returns the directory with the libraries that cargo has built for this test.
fn library() -> PathBuf {
    let test = env::current_exe().expect("the test has a path");
    let parent = test.parent().expect("the test is in target/debug/deps");
    parent.to_owned()
}

/// A compiled program with a domain of its own.
struct Program {
    dir: TempDir,
    binary: PathBuf,
    config: PathBuf,
}

/// Compiles a program with all warnings as errors.
fn compile(source: &str, link: &[&str]) -> Program {
    let library = library();
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let dir = tempfile::tempdir().expect("a directory");
    let binary = dir.path().join("program");
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
        .args(cfg!(feature = "gateway").then_some("-DFIPA_GATEWAY"))
        .arg("-I")
        .arg(here.join("include"))
        .arg(here.join(source))
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
    Program {
        dir,
        binary,
        config,
    }
}

impl Program {
    /// Returns a command that runs the program under a tool, if there is one.
    fn command(&self, under: &[&str]) -> Command {
        let mut command = match under.split_first() {
            Some((tool, arguments)) => {
                let mut command = Command::new(tool);
                command.args(arguments).arg(&self.binary);
                command
            }
            None => Command::new(&self.binary),
        };
        command.env("LD_LIBRARY_PATH", self.dir.path());
        command.env("FIPA_CONFIG", &self.config);
        command
    }
}

/// Compiles and runs a program of the tests.
fn run(program: &str, link: &[&str], under: &[&str]) {
    let compiled = compile(&format!("tests/c/{program}.c"), link);
    let mut command = compiled.command(under);
    let output = command
        .arg(&compiled.config)
        .arg(compiled.dir.path())
        .output();
    let output = output.expect("the program runs");
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
fn threads_share_a_domain() {
    run("threads", SHARED, &[]);
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

/// The example of the book, with an agent in Rust.
#[test]
fn an_agent_in_rust_requests_from_one_in_c() {
    let arm = compile("examples/arm.c", SHARED);
    let (mut process, ready) = ChildGuard::until_ready(&mut arm.command(&[]));
    assert_eq!(ready.trim(), "arm_1 is ready");
    let mut sources = Sources::from_environment();
    sources.file = Some(arm.config.clone());
    let config = Config::load(&sources).expect("the configuration is right");
    let domain = Domain::open(&config).wait().expect("a domain");
    let rover = domain.register("rover").wait().expect("a name");
    let ask = |content: &'static str| {
        let message = rover.message(Performative::Request).receiver("arm_1");
        let request = rover.request(message.content(content), TIMEOUT).wait();
        request.and_then(|mut request| request.result().wait())
    };
    let answer = ask("crate").expect("an answer");
    assert_eq!(answer.text(), "lifted");
    let refused = ask("").expect_err("nothing to lift");
    assert!(refused.to_string().contains("lift what?"), "{refused}");
    let subscribe = rover.message(Performative::Subscribe).receiver("arm_1");
    let temperature = rover.subscribe(subscribe.content("temperature"), TIMEOUT);
    let mut temperature = temperature.wait().expect("a subscription");
    let first = temperature.next().wait().expect("a notification");
    assert!(first.message().parse::<u32>().expect("a number") >= 20);

    process.signal("-TERM");
    let status = process.wait();
    assert!(status.success(), "{status}");
    until("the arm is deregistered", || {
        domain.directory().lookup("arm_1").is_none()
    });

    // A killed process leaves no entry.
    let (mut process, _) = ChildGuard::until_ready(&mut arm.command(&[]));
    assert!(domain.directory().lookup("arm_1").is_some());
    process.kill();
    until("the entry of the killed arm is removed", || {
        domain.directory().lookup("arm_1").is_none()
    });
    domain.close().wait();
}
