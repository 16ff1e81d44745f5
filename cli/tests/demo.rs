//! `fipa demo`, complete and interrupted.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs::DirEntry;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::MetadataExt as _;
use std::process::{Command, Stdio};

use common::Host;
use fipa_testbed::ChildGuard;
use serde_json::Value;

fn demo(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fipa"));
    command.arg("demo").args(arguments).stdin(Stdio::null());
    command
}

/// The files of the demo with this process identifier.
fn files(pid: u32) -> Vec<String> {
    let names = |directory| {
        let entries = std::fs::read_dir(directory).unwrap();
        entries.map(|file| file.unwrap().file_name().to_string_lossy().into_owned())
    };
    let all = names("/dev/shm").chain(names("/tmp"));
    all.filter(|name| name.contains(&format!("demo-{pid}")))
        .collect()
}

/// The number of processes that the demo has started.
fn processes(pid: u32) -> usize {
    let mark = format!("domain=demo-{pid}-");
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    let lines = entries.map(|process| std::fs::read(process.path().join("cmdline")));
    let lines = lines
        .flatten()
        .map(|line| String::from_utf8_lossy(&line).into_owned());
    lines.filter(|line| line.contains(&mark)).count()
}

#[test]
fn every_step_passes() {
    // Another host of this network has agents of the same names.
    let host = Host::new();
    let _gateway = host.start(&[
        "up",
        "--set",
        "discovery.mdns=true",
        "--set",
        "discovery.interfaces=lo",
        "--set",
        "mts.name=rover-mts",
    ]);
    let _rover = host.echo("rover");
    let _camera = host.echo("crex_camera");
    let mut command = demo(&["--json"]);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let child = command.spawn().unwrap();
    let pid = child.id();
    let output = child.wait_with_output().unwrap();
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let steps = report["steps"].as_array().unwrap();
    for step in steps {
        assert_eq!(step["ok"], true, "{step:#}");
    }
    assert!(output.status.success());
    // On a busy machine, a process may read the letters of the measurement later than they arrive.
    let is_late = |line: &&str| line.contains("the program keeps the content of letters");
    let errors = String::from_utf8_lossy(&output.stderr);
    let others: Vec<_> = errors.lines().filter(|line| !is_late(line)).collect();
    assert_eq!(others, Vec::<&str>::new());
    assert_eq!(steps.len(), 12);
    let via: Vec<&Value> = steps.iter().map(|step| &step["via"]).collect();
    assert_eq!((via[1], via[2]), (&"shm".into(), &"tcp".into()));
    assert_eq!(
        (via[6], &steps[6]["attempts"][0]["via"]),
        (&"unix".into(), &"shm".into())
    );
    assert_eq!(steps[8]["sender"], "arm_3");
    assert_ne!(steps[9]["live"], steps[9]["stale"]);
    let itself = steps[8]["caught_itself"].as_str().unwrap();
    assert!(itself.contains("from arm_6"), "{itself}");
    assert_eq!(files(pid), Vec::<String>::new());
    assert_eq!(processes(pid), 0);
}

#[test]
fn an_interrupted_demo_leaves_no_files_and_processes() {
    let mut command = demo(&[]);
    let mut child = ChildGuard::start(command.stdout(Stdio::piped()).stderr(Stdio::piped()));
    let pid = child.id();
    let mut output = BufReader::new(child.child().stdout.take().unwrap());
    let mut line = String::new();
    while !line.contains("arm_2") {
        line.clear();
        assert!(
            output.read_line(&mut line).unwrap() > 0,
            "the output ended early"
        );
    }
    assert!(processes(pid) > 2);
    // Other users cannot create the directory first, because they cannot know its name.
    let directory = format!("fipa-demo-{pid}-");
    let entries = std::fs::read_dir("/tmp").unwrap().flatten();
    let is_own = |it: &DirEntry| it.file_name().to_string_lossy().starts_with(&directory);
    let own: Vec<_> = entries.filter(is_own).collect();
    assert_eq!(own.len(), 1);
    assert!(own[0].file_name().len() > directory.len());
    assert_eq!(own[0].metadata().unwrap().mode() & 0o777, 0o700);
    child.signal("-INT");
    let status = child.wait();
    assert_eq!(status.code(), Some(1));
    let mut errors = String::new();
    child
        .child()
        .stderr
        .take()
        .unwrap()
        .read_to_string(&mut errors)
        .unwrap();
    assert!(errors.contains("interrupted"), "{errors}");
    assert_eq!(files(pid), Vec::<String>::new());
    assert_eq!(processes(pid), 0);
}
