//! `fipa keys`: two hosts are secured as the README says, and let nobody else in.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod common;

use std::process::Command;
use std::time::{Duration, Instant};

use common::{Host, Running};
use serde_json::{Value, json};

/// A host with keys of its own.
struct Keyed {
    host: Host,
    name: String,
}

impl Keyed {
    fn new(name: &str, init: &[&str]) -> Self {
        let host = Host::new();
        let name = format!("{name}-{}", host.domain);
        let keyed = Self { host, name };
        keyed.keys(&[&["init"], init].concat());
        keyed
    }

    fn dir(&self) -> String {
        self.host.path("keys").display().to_string()
    }

    fn certificate(&self) -> String {
        self.host.path("keys/own.pem").display().to_string()
    }

    fn keys(&self, arguments: &[&str]) -> String {
        let name = format!("mts.name={}", self.name);
        let (dir, mut all) = (self.dir(), vec!["keys"]);
        all.extend_from_slice(arguments);
        all.extend(["--dir", &dir, "--set", &name]);
        self.host.run(&all).done()
    }

    fn list(&self) -> Value {
        serde_json::from_str(&self.keys(&["list", "--json"])).unwrap()
    }

    /// Starts the gateway, which knows these others.
    fn gateway(&self, peers: &[(&str, &str)]) -> (Running, String) {
        let peers: Vec<String> = peers
            .iter()
            .map(|(name, address)| format!("{name:?} = [{address:?}]"))
            .collect();
        let gateway = self.host.start(&[
            "up",
            "--json",
            "-v",
            "--set",
            &format!("mts.name={}", self.name),
            "--set",
            &format!("security.keys={}", self.dir()),
            // Two hosts on one machine.
            "--set",
            "security.loopback=true",
            "--set",
            &format!("discovery.static={{ {} }}", peers.join(", ")),
        ]);
        let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
        let locations = ready["locations"].as_array().unwrap();
        let mut tcp = locations.iter().map(|one| one.as_str().unwrap());
        let tcp = tcp.find(|one| one.starts_with("tcp://")).unwrap();
        let address = tcp.split('#').next().unwrap().to_owned();
        (gateway, address)
    }

    /// Whether a letter from this host comes to an agent on the other.
    fn reaches(&self, agent: &str) -> bool {
        let sent = self
            .host
            .run(&["send", "--to", agent, "--content", "hello"]);
        sent.code == Some(0)
    }
}

fn until(what: &str, condition: impl Fn() -> bool) {
    let begun = Instant::now();
    while !condition() {
        assert!(begun.elapsed() < Duration::from_secs(60), "{what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn two_hosts_that_trust_each_other_and_nobody_else() {
    let rover = Keyed::new("rover", &[]);
    let crex = Keyed::new("crex", &[]);
    let stranger = Keyed::new("stranger", &[]);
    rover.keys(&["trust", &crex.certificate()]);
    crex.keys(&["trust", &rover.certificate()]);
    stranger.keys(&["trust", &crex.certificate()]);

    let arm = format!("arm-{}", crex.host.domain);
    let (mut theirs, address) = crex.gateway(&[]);
    let _arm = crex.host.echo(&arm);
    let peers = [(crex.name.as_str(), address.as_str())];
    let (_ours, _) = rover.gateway(&peers);
    let (_strange, _) = stranger.gateway(&peers);
    until("a letter passes", || rover.reaches(&arm));
    assert!(!stranger.reaches(&arm), "a stranger got in");
    theirs.tells(&["connection refused"]);

    // Trust that is withdrawn ends what it was given for, without a new start.
    crex.keys(&["revoke", &rover.name]);
    theirs.tells(&["the keys were read again", "trusted=0"]);
    until("the connection has ended", || !rover.reaches(&arm));
    let told = rover
        .host
        .run(&["keys", "list", "--dir", &crex.dir()])
        .done();
    assert!(
        told.contains("revoked") && told.contains(&rover.name),
        "{told}"
    );

    // A new key, which the other host was given in time, lets in again.
    rover.keys(&["renew"]);
    let next = rover.host.path("keys/next.pem").display().to_string();
    crex.keys(&["trust", &next]);
    rover.keys(&["renew", "--use"]);
    until("a letter passes again", || rover.reaches(&arm));
}

#[test]
fn what_there_is_is_listed_and_not_overwritten() {
    let host = Keyed::new(
        "rover",
        &["--agent", "rover", "--agent", "arm_*", "--valid", "90days"],
    );
    let listed = host.list();
    assert_eq!(listed["own"]["mts"], json!(host.name));
    assert_eq!(listed["own"]["agents"], json!(["rover", "arm_*"]));
    assert_eq!(
        (&listed["trusted"], &listed["revoked"]),
        (&json!([]), &json!([]))
    );
    let days = (listed["own"]["until"].as_i64().unwrap() - listed["own"]["from"].as_i64().unwrap())
        / 86_400;
    assert_eq!(days, 91, "a day before now, and 90 from now");
    let dir = host.dir();
    let (own, own_key) = (host.certificate(), format!("{dir}/own.key"));
    for (wrong, told) in [
        (vec!["keys", "init", "--dir", &dir], "nothing was changed"),
        (
            vec!["keys", "trust", "/dev/null", "--dir", &dir],
            "no certificate",
        ),
        (
            vec!["keys", "trust", &own_key, "--dir", &dir],
            "a private key",
        ),
        (
            vec!["keys", "trust", &own, "--dir", &dir],
            "this host's own certificate",
        ),
        (
            vec!["keys", "trust", "/nowhere", "--dir", &dir],
            "cannot read",
        ),
        (
            vec!["keys", "revoke", "nobody", "--dir", &dir],
            "matches 0 trusted certificates",
        ),
        (
            vec!["keys", "renew", "--use", "--dir", &dir],
            "no next keys",
        ),
        (
            vec!["keys", "renew", "--valid", "9000years", "--dir", &dir],
            "the year 9999",
        ),
    ] {
        let said = host.host.run(&wrong).failed(1);
        assert!(said.contains(told), "{wrong:?}: {said}");
    }
    assert_eq!(host.list(), listed);

    // The next ones are seen too, and made once.
    assert_eq!(listed["next"], Value::Null);
    host.keys(&["renew"]);
    assert_eq!(host.list()["next"]["mts"], json!(host.name));
    let said = host.host.run(&["keys", "renew", "--dir", &dir]).failed(1);
    assert!(said.contains("`fipa keys renew --use`"), "{said}");
}

#[test]
fn who_has_no_keys_is_told_how_to_make_them() {
    let host = Host::new();
    let told = host.run(&["keys", "list"]).done();
    assert!(told.contains("make them with `fipa keys init`"), "{told}");
    let told = host.run(&["keys", "init", "--dir", "some"]).done();
    // Wherever the gateway is started from.
    let dir = host.path("some").canonicalize().unwrap();
    assert!(told.contains(&format!("keys = {dir:?}")), "{told}");
}

#[test]
fn a_gateway_does_not_start_with_keys_that_cannot_be_used() {
    let host = Keyed::new("rover", &[]);
    let keys = format!("security.keys={}", host.dir());
    let told = host
        .host
        .run(&["up", "--set", &keys, "--set", "mts.name=another"]);
    let told = told.failed(1);
    assert!(
        told.contains("another") && told.contains(&host.name) && told.contains("mts.name=NAME"),
        "{told}"
    );
    let told = host
        .host
        .run(&["up", "--set", "security.keys=/nowhere"])
        .failed(1);
    assert!(told.contains("fipa keys init"), "{told}");
    let told = host
        .host
        .run(&["up", "--set", "transport.tcp.listen=0.0.0.0:0"]);
    let told = told.failed(2);
    assert!(
        told.contains("fipa keys init") && told.contains("security.insecure"),
        "{told}"
    );
}

#[test]
fn a_certificate_that_has_ended_is_told_wherever_it_is_seen() {
    let (rover, crex) = (
        Keyed::new("rover", &["--valid", "1ms"]),
        Keyed::new("crex", &[]),
    );
    // A second is what its times are told in.
    until("it has ended", || {
        rover.keys(&["list"]).contains("(has expired)")
    });
    let told = crex.keys(&["trust", &rover.certificate()]);
    assert!(told.contains("(has expired)"), "{told}");
    let (mut theirs, address) = crex.gateway(&[]);
    theirs.tells(&["the certificate of rover", "has expired"]);
    rover.keys(&["trust", &crex.certificate()]);
    let (mut ours, _) = rover.gateway(&[(&crex.name, &address)]);
    ours.tells(&["the certificate of this host has expired"]);
    theirs.tells(&["connection refused", "Expired", "`fipa keys renew` there"]);
}

#[test]
fn a_pipe_among_the_certificates_is_waited_for_by_nobody() {
    let rover = Keyed::new("rover", &[]);
    let trusted = rover.host.path("keys/trusted");
    std::fs::create_dir_all(&trusted).unwrap();
    let pipe = trusted.join("other.pem").display().to_string();
    let made = Command::new("mkfifo").args(["-m", "600", &pipe]).status();
    assert!(made.unwrap().success());
    let listed = rover.host.run(&["keys", "list", "--dir", &rover.dir()]);
    let told = format!(
        "{}{}",
        String::from_utf8_lossy(&listed.stdout),
        listed.stderr
    );
    assert!(told.contains("not a regular file"), "{told}");
}
