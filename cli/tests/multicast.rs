//! `fipa doctor` on networks that forward multicast, filter it, or have no other host. The hosts are
//! network namespaces.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::process::Command;
use std::time::{Duration, Instant};

use fipa_testbed::{ChildGuard, Host, Network, enter, isolated};
use serde_json::Value;

#[test]
fn the_doctor_reports_multicast_faults_of_the_network() {
    isolated(
        "inside_the_doctor_reports_multicast_faults_of_the_network",
        &[],
    );
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_the_doctor_reports_multicast_faults_of_the_network() {
    enter();
    let network = Network::new(2);
    let (here, there) = (network.host(0), network.host(1));

    let (severity, found) = multicast(here);
    assert_eq!(severity, "warning", "{found}");
    assert!(found.contains("no other host answered"), "{found}");

    let mut up = fipa(there, "there");
    let _gateway = ChildGuard::until_ready(up.arg("up"));
    // A gateway without agents has no records with which it could answer.
    let mut echo = fipa(there, "there");
    let _agent = ChildGuard::until_ready(echo.args(["echo", "parrot"]));
    let deadline = Instant::now() + Duration::from_secs(60);
    let found = loop {
        let (severity, found) = multicast(here);
        if severity == "fine" {
            break found;
        }
        assert!(Instant::now() < deadline, "{found}");
    };
    assert!(
        found.contains("works in both directions, with 10.99.0.2"),
        "{found}"
    );

    // The switch does not forward multicast to this host; the other host receives it.
    here.forward_multicast(false);
    let (severity, found) = multicast(here);
    assert_eq!(severity, "warning", "{found}");
    assert!(found.contains("incoming does not: 10.99.0.2"), "{found}");
    here.forward_multicast(true);

    // The switch does not forward multicast to the other host.
    there.forward_multicast(false);
    let (severity, found) = multicast(here);
    assert_eq!(severity, "warning", "{found}");
    assert!(
        found.contains("outgoing may not: packets of 10.99.0.2"),
        "{found}"
    );
    there.forward_multicast(true);

    here.ip("link set eth0 down");
    let (severity, found) = multicast(here);
    assert_eq!(severity, "warning", "{found}");
    assert!(found.contains("no interface is up"), "{found}");
}

fn fipa(host: &Host, domain: &str) -> Command {
    let mut command = host.command(env!("CARGO_BIN_EXE_fipa"));
    command.args(["--set", &format!("domain={domain}")]);
    // A gateway that listens only on loopback announces no agents.
    let open = ["security.insecure=true", "transport.tcp.listen=0.0.0.0:0"];
    command.args(open.iter().flat_map(|setting| ["--set", setting]));
    command
}

/// The severity and the finding of the doctor about multicast over IPv4.
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
    (text("severity"), text("found"))
}
