//! `fipa doctor` on networks that carry multicast, filter it, or have nobody on them: hosts in
//! namespaces of the test's own.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

use std::process::Command;
use std::time::{Duration, Instant};

use fipa_testbed::{Host, Network, Running, enter, isolated};
use serde_json::Value;

#[test]
fn the_doctor_says_what_the_network_does() {
    isolated("inside_the_doctor_says_what_the_network_does", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_the_doctor_says_what_the_network_does() {
    enter();
    fipa_testbed::run("mount -t tmpfs tmpfs /dev/shm");
    let network = Network::new(2);
    let (here, there) = (network.host(0), network.host(1));

    let (verdict, found) = multicast(here);
    assert_eq!(verdict, "doubtful", "{found}");
    assert!(found.contains("no other host answered"), "{found}");

    let mut up = fipa(there, "there");
    let _gateway = Running::until_ready(up.arg("up"));
    // Who has nothing to announce has nothing to answer.
    let mut echo = fipa(there, "there");
    let _agent = Running::until_ready(echo.args(["echo", "parrot"]));
    let deadline = Instant::now() + Duration::from_secs(60);
    let found = loop {
        let (verdict, found) = multicast(here);
        if verdict == "fine" {
            break found;
        }
        assert!(Instant::now() < deadline, "{found}");
    };
    assert!(
        found.contains("works in both directions, with 10.99.0.2"),
        "{found}"
    );

    // The switch keeps multicast from this host, which others hear.
    here.hears_multicast(false);
    let (verdict, found) = multicast(here);
    assert_eq!(verdict, "doubtful", "{found}");
    assert!(found.contains("incoming does not: 10.99.0.2"), "{found}");
    here.hears_multicast(true);

    // The other way round.
    there.hears_multicast(false);
    let (verdict, found) = multicast(here);
    assert_eq!(verdict, "doubtful", "{found}");
    assert!(
        found.contains("outgoing may not: packets of 10.99.0.2"),
        "{found}"
    );
    there.hears_multicast(true);

    here.ip("link set eth0 down");
    let (verdict, found) = multicast(here);
    assert_eq!(verdict, "doubtful", "{found}");
    assert!(found.contains("no interface is up"), "{found}");
}

fn fipa(host: &Host, domain: &str) -> Command {
    let mut command = host.command(env!("CARGO_BIN_EXE_fipa"));
    command.args(["--set", &format!("domain={domain}")]);
    // A gateway that listens on loopback announces nothing.
    let open = ["security.insecure=true", "transport.tcp.listen=0.0.0.0:0"];
    command.args(open.iter().flat_map(|setting| ["--set", setting]));
    command
}

/// What the doctor says about multicast over IPv4.
fn multicast(host: &Host) -> (String, String) {
    let output = fipa(host, "here").args(["doctor", "--json"]).output();
    let output = output.unwrap();
    let report: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error}: {output:?}"));
    let checks = report["checks"].as_array().unwrap();
    let mut checks = checks.iter().filter(|check| check["check"] == "multicast");
    let check = checks
        .find(|check| !check["found"].as_str().unwrap().contains("::"))
        .unwrap();
    let text = |key: &str| check[key].as_str().unwrap().to_owned();
    (text("verdict"), text("found"))
}
