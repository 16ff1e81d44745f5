//! `fipa coalition` and `fipa agents --watch` in processes of their own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::io::{BufRead, BufReader};
use std::process::Stdio;

use common::Host;

#[test]
fn a_coalition_is_listed_and_receives_letters() {
    let host = Host::new();
    let (parrot, owl) = (host.echo("parrot"), host.echo("owl"));
    let members = ["coalition", "birds", "parrot", "owl", "--leader", "owl"];
    let birds = host.start(&members);
    assert!(
        birds.ready.starts_with("coalition birds of domain "),
        "{}",
        birds.ready
    );
    let listed = host.run(&["agents", "birds", "--json"]).done_json();
    let listed = &listed["agents"][0];
    assert_eq!(listed["role"], "coalition");
    assert_eq!(listed["members"], serde_json::json!(["parrot", "owl"]));
    assert_eq!(listed["leader"], "owl");
    let table = host.run(&["agents", "birds", "--long"]).done();
    assert!(table.contains("owl (leader)"), "{table}");
    let sent = host.run(&["send", "--to", "birds", "--content", "hello", "--json"]);
    let sent = sent.done_json().to_string();
    assert!(sent.contains("\"receiver\":\"owl\""), "{sent}");
    assert!(!sent.contains("parrot"), "{sent}");
    let taken = host.run(&["coalition", "birds", "parrot"]).failed(1);
    assert!(taken.contains("birds"), "{taken}");
    let stranger = host.run(&["coalition", "x", "parrot", "--leader", "owl"]);
    let stranger = stranger.failed(2);
    assert!(stranger.contains("owl"), "{stranger}");
    assert_eq!(birds.signal("-INT"), (Some(0), String::new()));
    let gone = host.run(&["agents", "birds"]).done();
    assert!(
        gone.contains("no agent") && gone.contains("that matches the filters"),
        "{gone}"
    );
    drop((parrot, owl));
}

#[test]
fn agents_watch_ends_when_its_output_has_no_reader() {
    let host = Host::new();
    let _parrot = host.echo("parrot");
    let mut watching = host
        .command(&["agents", "--watch"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let mut output = BufReader::new(watching.stdout.take().unwrap());
    output.read_line(&mut line).unwrap();
    output.read_line(&mut line).unwrap();
    let (first, second) = line.split_once('\n').unwrap();
    assert!(first.starts_with("watching domain "), "{line}");
    assert!(second.contains("present  parrot"), "{line}");
    // Closes the pipe, as `head` does. No further change would make the command print.
    drop(output);
    assert!(watching.wait().unwrap().success());
}
