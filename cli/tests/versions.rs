//! Gateways and peers of other releases, whose frames have another version.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::time::Duration;

use common::Host;
use fipa_testbed::{frame, until};

/// The beginning of a goodbye of this release.
const ANSWER: &[u8] = b"fipa\x03\x06";

const TOLD: [&str; 3] = [
    "the peer has version 9 of the protocol and this host has version 3",
    "install the same release of fipa on both hosts",
    "127.0.0.1",
];

fn hello() -> Vec<u8> {
    let mut hello = frame(1, 0, b"the hello of another release");
    hello[4] = 9;
    hello
}

/// Whether `fipa doctor` has a finding of this check with these parts and without a word about keys.
fn finds(host: &Host, check: &str) -> bool {
    let report = host.run(&["doctor", "--json"]).done_json();
    let checks = report["checks"].as_array().unwrap().iter();
    let mut found = checks.filter(|it| it["check"] == check);
    found.any(|it| {
        let text = it["found"].as_str().unwrap();
        it["severity"] == "warning"
            && TOLD.iter().all(|part| text.contains(part))
            && !text.contains("keys")
    })
}

#[test]
fn a_gateway_that_dials_another_release_says_which_version_each_has() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        while let Ok((mut stream, _)) = listener.accept() {
            let _ = stream.read(&mut [0; 4096]);
            let _ = stream.write_all(&hello());
        }
    });
    let host = Host::new();
    let peer = format!("discovery.static={{ later = [\"tcp://{address}\"] }}");
    let mut gateway = host.start(&["up", "--json", "--set", &peer]);
    gateway.wait_for_log(&[&["connection closed"], &TOLD[..]].concat());
    until("the doctor finds the versions", || {
        finds(&host, "static peers")
    });
}

#[test]
fn a_gateway_refuses_another_release_and_tells_it_its_version() {
    let host = Host::new();
    let mut gateway = host.start(&["up", "--json"]);
    let mut stream = TcpStream::connect(gateway.tcp_address()).unwrap();
    stream
        .set_read_timeout(Some(Duration::from_secs(60)))
        .unwrap();
    stream.write_all(&hello()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    assert!(answer.starts_with(ANSWER), "{answer:?}");
    gateway.wait_for_log(&[&["connection refused"], &TOLD[..]].concat());
    assert!(finds(&host, "refused connections"));
}
