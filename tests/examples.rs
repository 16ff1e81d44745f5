//! Runs the examples, each as a process of its own, and compares what they print.
//!
//! `cargo test` builds the examples; with `--test examples` alone, `cargo build --examples` must run before
//! with the same features.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;

use fipa_testbed::{ChildGuard, until};

const README: &str = include_str!("../README.md");

/// The directory of the sources.
fn sources() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples")
}

/// Runs an example in a domain of its own, and returns the lines that it prints.
fn run(name: &str) -> Vec<String> {
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str| directory.path().join(name);
    let domain = format!("example-{}", support::mark());
    let config =
        format!("domain = \"{domain}\"\ndiscovery.mdns = false\nmts.deadline = \"1min\"\n");
    fs::write(file("fipa.toml"), config).unwrap();
    let programs = std::env::current_exe().unwrap();
    let programs = programs.ancestors().nth(2).unwrap().join("examples");
    let program = programs.join(name);
    assert!(
        program.exists(),
        "{} is missing; run `cargo build --examples` with the features of this test",
        program.display()
    );
    let mut child = ChildGuard::start(
        Command::new(&program)
            .current_dir(directory.path())
            .env_remove("FIPA_CONFIG")
            .env("HOME", directory.path())
            .env("FIPA_RUNTIME_DIR", file("run"))
            .stdout(File::create(file("out")).unwrap())
            .stderr(File::create(file("err")).unwrap()),
    );
    let read = |name| String::from_utf8(fs::read(file(name)).unwrap()).unwrap();
    let mut status = None;
    until(&format!("the example {name} has ended"), || {
        status = child.ended();
        status.is_some()
    });
    assert!(status.unwrap().success(), "{name}: {}", read("err"));
    assert_eq!(read("err"), "", "{name}");
    read("out").lines().map(str::to_owned).collect()
}

/// Asserts that the example prints these lines in this order. A line ends with `…` if only its beginning
/// counts.
#[track_caller]
fn prints(name: &str, lines: &[&str]) {
    let printed = run(name);
    assert_eq!(printed.len(), lines.len(), "{name}: {printed:#?}");
    for (printed, expected) in printed.iter().zip(lines) {
        match expected.strip_suffix('…') {
            Some(beginning) => assert!(printed.starts_with(beginning), "{name}: {printed}"),
            None => assert_eq!(printed, expected, "{name}"),
        }
    }
}

#[test]
fn hello() {
    prints(
        "hello",
        &["arm: delivered…", "arm received (inform :sender rover…"],
    );
}

#[test]
fn echo() {
    let lines = ["one: \"one\"", "two: \"two\"", "three: \"three\""];
    prints(
        "echo",
        &[&lines[..], &["echo answered 3 messages"]].concat(),
    );
}

#[test]
fn coalition() {
    prints(
        "coalition",
        &[
            "the arm obeys: (unfold)",
            "arm: delivered…",
            "the arm refuses (fold): the fence …",
        ],
    );
}

#[test]
fn multicast() {
    prints(
        "multicast",
        &[
            "arm_1: delivered…",
            "arm_2: delivered…",
            "arm_3: delivered…",
            "arm_1 received \"stop\"",
            "arm_2 received \"stop\"",
            "arm_3 received \"stop\"",
            "arm_1: delivered…",
            "arm_3: delivered…",
            "arm_1 is an arm",
            "arm_2 is an arm",
            "arm_3 is an arm",
        ],
    );
}

#[test]
fn large_content() {
    prints(
        "large_content",
        &[
            "viewer: delivered…",
            "frame 1: 4194304 of 4194304 bytes",
            "viewer: delivered…",
            "frame 2: 4194304 of 4194304 bytes",
            "viewer: delivered…",
            "frame 3: 4194304 of 4194304 bytes",
            "the letter would have 1073741824 bytes, and at most 67108864 are allowed; …",
        ],
    );
}

#[test]
fn publish_subscribe() {
    prints(
        "publish_subscribe",
        &[
            "80.5 % was delivered to 2",
            "rover knows 80.5 %",
            "operator knows 80.5 %",
            "80 % was delivered to 2",
            "rover knows 80 %",
            "operator knows 80 %",
            "79.5 % was delivered to 2",
            "rover knows 79.5 %",
            "operator knows 79.5 %",
        ],
    );
}

#[test]
fn contract_net() {
    prints("contract_net", &["3 proposals", "arm_2: \"carried\""]);
}

#[test]
fn lock() {
    prints(
        "lock",
        &[
            "(agree :sender crane :receiver (set rover_1)…",
            "(refuse :sender crane :receiver (set rover_1)…",
            "(agree :sender crane :receiver (set rover_2)…",
            "(refuse :sender crane :receiver (set rover_2)…",
        ],
    );
}

#[test]
fn actions() {
    let mut printed = run("actions");
    // The number of progress reports depends on the load of the machine.
    printed.retain(|line| !line.starts_with("dock: "));
    let expected = [
        "crex offers blink, result nothing",
        "crex offers dock, result docked(charge: number)",
        "crex offers drive, result nothing",
        "docked, charge 0.8",
        "drive: cancelled",
        "drive: refused: parameter speed: 3.0 is not within 0.1 to 0.5",
    ];
    assert_eq!(printed, expected);
}

#[test]
fn serve() {
    prints(
        "serve",
        &[
            "lift 2.5: agreed true",
            "lift 2.5: \"lifted 2.5 kg\"",
            "lift 400: the other side refused: too heavy",
            "lift a crate: the other side refused: the content is no weight",
        ],
    );
}

#[test]
fn blocking() {
    prints("blocking", &["80.0 %", "79.5 %", "79.0 %"]);
}

#[test]
fn two_hosts() {
    let printed = run("two_hosts");
    let [joined @ .., sent, received] = &printed[..] else {
        panic!("{printed:?}");
    };
    assert!(
        joined.iter().all(|line| line.contains(" is at ")),
        "{joined:?}"
    );
    assert!(sent.starts_with("arm_1: delivered via "), "{sent}");
    assert_eq!(received, "arm_1 received \"hello\"");
}

#[test]
fn own_protocol() {
    prints(
        "own_protocol",
        &["not sent: …", "rover: delivered…", "rover received confirm"],
    );
}

#[test]
fn four_programs() {
    let printed = run("four_programs");
    for expected in ["operator: charge 79 %", "operator: carried by arm_2"] {
        assert!(printed.iter().any(|line| line == expected), "{printed:#?}");
    }
}

/// The sources of the examples, with their names.
fn examples() -> Vec<(String, String)> {
    let files = fs::read_dir(sources())
        .unwrap()
        .map(|file| file.unwrap().path());
    let files = files.filter(|path| path.extension().is_some_and(|it| it == "rs"));
    let read = |path: PathBuf| {
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        (name, fs::read_to_string(path).unwrap())
    };
    files.map(read).collect()
}

#[test]
fn each_example_is_short_listed_in_the_readme_and_run_here() {
    let tests = include_str!("examples.rs");
    let examples = examples();
    assert!(examples.len() >= 10);
    for (name, source) in examples {
        // Whole applications.
        let most = match &*name {
            "four_programs" => 140,
            "actions" => 165,
            "lock" => 95,
            _ => 80,
        };
        assert!(source.lines().count() < most, "{name}");
        assert!(README.contains(&format!("examples/{name}.rs")), "{name}");
        assert!(tests.contains(&format!("fn {name}() {{")), "{name}");
    }
}

#[test]
fn the_program_of_the_readme_is_the_example_hello() {
    let (_, text) = README.split_once("## In a program").unwrap();
    let (_, program) = text.split_once("```rust,no_run\n").unwrap();
    let (program, _) = program.split_once("```").unwrap();
    let hello = fs::read_to_string(sources().join("hello.rs")).unwrap();
    let (_, code) = hello.split_once("prints\")]\n\n").unwrap();
    assert_eq!(program, code);
    // Its dependencies.
    for line in [
        "$ cargo add --path ",
        "$ cargo add tokio --features macros,rt-multi-thread\n",
    ] {
        assert!(text.contains(line), "{line}");
    }
}
