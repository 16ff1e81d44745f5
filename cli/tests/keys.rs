//! `fipa keys`: two hosts trust each other as in the README, and reject other hosts.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::io::Write as _;
use std::net::{TcpListener, TcpStream};
use std::process::Command;

use common::{Host, Ran, Running};
use fipa_testbed::{until, until_some};
use serde_json::{Value, json};

/// A host with keys.
struct KeyedHost {
    host: Host,
    name: String,
}

impl KeyedHost {
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

    /// Starts `fipa keys pair`. Returns it with its port and its code.
    fn pair(&self) -> (Running, String, String) {
        let mut pairing = self.host.start(&["keys", "pair", "--dir", &self.dir()]);
        let mut lines = vec![pairing.ready.clone()];
        while !lines.iter().any(|line| line.starts_with("waiting ")) {
            lines.push(pairing.line());
        }
        let after = |start: &str| {
            let mut found = lines.iter().filter_map(|line| line.strip_prefix(start));
            found.next().unwrap().to_owned()
        };
        let address = after("  fipa keys pair ");
        let (_, port) = address.rsplit_once(':').unwrap();
        let code = after("and type this code there: ");
        (pairing, port.to_owned(), code)
    }

    /// Runs `fipa keys pair` with this address and this code.
    fn pair_with(&self, address: &str, code: &str) -> Ran {
        let pair = ["keys", "pair", address, "--dir", &self.dir()];
        self.host
            .run_with_input(&pair, format!("{code}\n").as_bytes())
    }

    /// The names of the gateways whose certificates are trusted.
    fn trusted(&self) -> Vec<String> {
        let list = self.list();
        let names = list["trusted"].as_array().unwrap().iter();
        names
            .map(|it| it["mts"].as_str().unwrap().to_owned())
            .collect()
    }

    fn list(&self) -> Value {
        serde_json::from_str(&self.keys(&["list", "--json"])).unwrap()
    }

    /// Starts the gateway with these static peers. Returns it with its TCP location.
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
            // The hosts are on one machine, so peers on loopback need keys too.
            "--set",
            "security.loopback=true",
            "--set",
            &format!("discovery.static={{ {} }}", peers.join(", ")),
        ]);
        let location = format!("tcp://{}", gateway.tcp_address());
        (gateway, location)
    }

    /// Whether a letter from this host to an agent is delivered.
    fn reaches(&self, agent: &str) -> bool {
        let sent = self
            .host
            .run(&["send", "--to", agent, "--content", "hello"]);
        sent.code == Some(0)
    }
}

#[test]
fn only_hosts_that_trust_each_other_exchange_letters() {
    let rover = KeyedHost::new("rover", &[]);
    let crex = KeyedHost::new("crex", &[]);
    let stranger = KeyedHost::new("stranger", &[]);
    rover.keys(&["trust", &crex.certificate()]);
    crex.keys(&["trust", &rover.certificate()]);
    stranger.keys(&["trust", &crex.certificate()]);

    let arm = format!("arm-{}", crex.host.domain);
    let (mut theirs, address) = crex.gateway(&[]);
    let _arm = crex.host.echo(&arm);
    let peers = [(crex.name.as_str(), address.as_str())];
    let (_ours, _) = rover.gateway(&peers);
    let (_strange, _) = stranger.gateway(&peers);
    until("a letter is delivered", || rover.reaches(&arm));
    assert!(
        !stranger.reaches(&arm),
        "a letter of an untrusted host was delivered"
    );
    theirs.wait_for_log(&["connection refused"]);

    // Revoking the trust closes the connection without a restart.
    crex.keys(&["revoke", "--yes", &rover.name]);
    theirs.wait_for_log(&["the keys were read again", "trusted=0"]);
    until("the connection has ended", || !rover.reaches(&arm));
    let output = rover
        .host
        .run(&["keys", "list", "--dir", &crex.dir()])
        .done();
    assert!(
        output.contains("revoked") && output.contains(&rover.name),
        "{output}"
    );

    // A renewed key that the other host trusts is accepted, until the trust ends, and again.
    rover.keys(&["renew"]);
    let next = rover.host.path("keys/next.pem").display().to_string();
    crex.keys(&["trust", &next]);
    rover.keys(&["renew", "--use"]);
    until("a letter is delivered again", || rover.reaches(&arm));
    crex.keys(&["distrust", &rover.name]);
    until("the connection has ended again", || !rover.reaches(&arm));
    crex.keys(&["trust", &rover.certificate()]);
    until("the letter after that is delivered", || rover.reaches(&arm));
}

#[test]
fn paired_hosts_exchange_letters() {
    let rover = KeyedHost::new("rover", &[]);
    let crex = KeyedHost::new("crex", &[]);
    let (mut listening, port, code) = rover.pair();
    // Another host that connects and is silent does not disturb the pairing.
    let _silent = TcpStream::connect(format!("127.0.0.1:{port}")).unwrap();
    let dialed = crex.pair_with(&format!("127.0.0.1:{port}"), &code).done();
    assert_eq!(listening.end(), (Some(0), String::new()));
    let listened: Vec<String> = std::iter::from_fn(|| listening.next_line()).collect();
    let listened = listened.join("\n");
    for (printed, trusted) in [(&dialed, &rover), (&listened, &crex)] {
        let fingerprint = trusted.list()["own"]["fingerprint"].clone();
        for part in [
            "trusted ",
            &trusted.name,
            fingerprint.as_str().unwrap(),
            "both hosts",
        ] {
            assert!(printed.contains(part), "{part}: {printed}");
        }
    }

    let arm = format!("arm-{}", crex.host.domain);
    let (_theirs, address) = crex.gateway(&[]);
    let _arm = crex.host.echo(&arm);
    let (_ours, _) = rover.gateway(&[(crex.name.as_str(), address.as_str())]);
    until("a letter is delivered", || rover.reaches(&arm));
}

#[test]
fn hosts_pair_over_ipv6_and_by_name() {
    for address in ["[::1]", "localhost"] {
        let (rover, crex) = (KeyedHost::new("rover", &[]), KeyedHost::new("crex", &[]));
        let (mut listening, port, code) = rover.pair();
        // Hyphens need not be typed.
        let code = code.replace('-', "");
        crex.pair_with(&format!("{address}:{port}"), &code).done();
        assert_eq!(listening.end(), (Some(0), String::new()));
        assert_eq!(rover.trusted(), std::slice::from_ref(&crex.name));
        assert_eq!(crex.trusted(), [rover.name]);
    }
}

#[test]
fn a_wrong_code_ends_the_pairing_and_the_next_one_has_another() {
    let (rover, crex) = (KeyedHost::new("rover", &[]), KeyedHost::new("crex", &[]));
    let (mut listening, port, code) = rover.pair();
    let address = format!("127.0.0.1:{port}");
    // A text that is no code does not use up the attempt.
    let errors = crex.pair_with(&address, "12345").failed(2);
    assert!(errors.contains("a code has 9 digits"), "{errors}");

    let (start, last) = code.split_at(code.len() - 1);
    let wrong = format!("{start}{}", if last == "0" { "1" } else { "0" });
    let dialed = crex.pair_with(&address, &wrong).failed(1);
    let (ended, listened) = listening.end();
    assert_eq!(ended, Some(1));
    for errors in [dialed, listened] {
        assert!(errors.contains("the code does not match"), "{errors}");
        assert!(errors.contains("for a new code"), "{errors}");
    }
    let errors = crex.pair_with(&address, &code).failed(1);
    assert!(errors.contains("cannot connect"), "{errors}");
    assert!(rover.trusted().is_empty() && crex.trusted().is_empty());

    let (_next, _, next) = rover.pair();
    assert_ne!(next, code);
}

#[test]
fn a_partner_that_ends_is_reported() {
    let (rover, crex) = (KeyedHost::new("rover", &[]), KeyedHost::new("crex", &[]));
    let closing = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = closing.local_addr().unwrap().to_string();
    let ended = std::thread::spawn(move || drop(closing.accept().unwrap()));
    let errors = crex.pair_with(&address, "123456789").failed(1);
    ended.join().unwrap();
    assert!(
        errors.contains("the other host ended the pairing"),
        "{errors}"
    );

    // The listening host waits for another one, and ends at Ctrl-C without an error.
    let (listening, port, _) = rover.pair();
    let mut stranger = TcpStream::connect(format!("127.0.0.1:{port}")).unwrap();
    stranger.write_all(b"GET / HTTP/1.1\r\n").unwrap();
    drop(stranger);
    assert_eq!(listening.signal("-INT"), (None, String::new()));
    let errors = crex
        .pair_with(&format!("127.0.0.1:{port}"), "123456789")
        .failed(1);
    assert!(errors.contains("cannot connect"), "{errors}");
}

#[test]
fn hosts_without_keys_are_told_to_make_them() {
    let host = Host::new();
    for pair in [&["keys", "pair"][..], &["keys", "pair", "127.0.0.1:1"]] {
        let errors = host.run(pair).failed(1);
        assert!(errors.contains("fipa keys init"), "{errors}");
    }
}

#[test]
fn a_command_run_with_sudo_names_the_next_one_with_sudo() {
    let host = Host::new();
    let mut init = host.command(&["keys", "init", "--dir", "keys"]);
    let made = init.env("SUDO_USER", "robot").output().unwrap();
    let said = String::from_utf8(made.stdout).unwrap();
    assert!(said.contains("run `sudo fipa keys pair`,"), "{said}");
}

#[test]
fn a_pattern_that_stands_for_no_agent_is_refused() {
    let host = Host::new();
    let dir = host.path("keys").display().to_string();
    for (agent, advice) in [("a*b", "as in a*,"), ("arm_[12]", "as in arm_*,")] {
        let init = ["keys", "init", "--agent", agent, "--dir", &dir];
        let errors = host.run(&init).failed(1);
        assert!(
            errors.contains(agent) && errors.contains(advice),
            "{errors}"
        );
    }
    let star = ["keys", "init", "--set", "mts.name=*", "--dir", &dir];
    let errors = host.run(&star).failed(2);
    assert!(errors.contains("mts.name"), "{errors}");
    assert!(!host.path("keys/own.pem").exists());
}

#[test]
fn a_certificate_is_not_revoked_without_confirmation() {
    let (rover, crex) = (KeyedHost::new("rover", &[]), KeyedHost::new("crex", &[]));
    let own = crex.certificate();
    rover.keys(&["trust", &own]);
    let dir = rover.dir();
    let revoke = ["keys", "revoke", &crex.name, "--dir", &dir];
    let errors = rover.host.run(&revoke).failed(2);
    assert!(
        errors.contains("--yes") && errors.contains("distrust"),
        "{errors}"
    );
    let count = |list: &str| rover.list()[list].as_array().unwrap().len();
    assert_eq!((count("trusted"), count("revoked")), (1, 0));
    rover.keys(&["distrust", &crex.name]);
    assert_eq!((count("trusted"), count("revoked")), (0, 0));
    rover.keys(&["trust", &own]);
    rover.keys(&["revoke", &crex.name, "--yes"]);
    assert_eq!((count("trusted"), count("revoked")), (0, 1));
}

/// The check of `fipa doctor` with this name, as severity and finding.
fn finding(report: &Value, name: &str) -> (String, String) {
    let checks = report["checks"].as_array().unwrap();
    let check = checks.iter().find(|check| check["check"] == name);
    let check = check.unwrap_or_else(|| panic!("no check {name}: {report}"));
    let text = |key: &str| check[key].as_str().unwrap().to_owned();
    (text("severity"), text("found"))
}

#[test]
fn a_refusal_by_the_peer_is_shown_on_the_host_of_the_sender_until_the_peer_accepts() {
    let (rover, crex) = (KeyedHost::new("rover", &[]), KeyedHost::new("crex", &[]));
    rover.keys(&["trust", &crex.certificate()]);
    let (_theirs, address) = crex.gateway(&[]);
    let (_ours, _) = rover.gateway(&[(&crex.name, &address)]);
    let refused = || {
        let report = rover.host.run(&["doctor", "--json"]).done_json();
        let checks = report["checks"].as_array().unwrap().iter();
        let mut refused = checks.filter(|it| it["check"] == "connections that peers refused");
        refused.next().cloned()
    };
    let check = until_some("the doctor shows the refusal", refused);
    assert_eq!(check["severity"], "warning", "{check}");
    let found = check["found"].as_str().unwrap();
    assert!(found.starts_with(&address), "{found}");
    assert!(found.contains("trust"), "{found}");
    crex.keys(&["trust", &rover.certificate()]);
    until("the refusal is gone", || refused().is_none());
    let report = rover.host.run(&["doctor", "--json"]).done_json();
    let (severity, found) = finding(&report, "connections with other gateways");
    assert_eq!(severity, "fine", "{found}");
}

#[test]
fn the_certificate_of_each_connection_is_shown() {
    let (rover, crex) = (KeyedHost::new("rover", &[]), KeyedHost::new("crex", &[]));
    rover.keys(&["trust", &crex.certificate()]);
    crex.keys(&["trust", &rover.certificate()]);
    let arm = format!("arm-{}", crex.host.domain);
    let (_theirs, address) = crex.gateway(&[]);
    let _arm = crex.host.echo(&arm);
    let (ours, _) = rover.gateway(&[(&crex.name, &address)]);
    let fingerprint = crex.list()["own"]["fingerprint"].clone();
    let ready: Value = serde_json::from_str(&ours.ready).unwrap();
    let trusted = json!([{ "mts": crex.name, "fingerprint": fingerprint }]);
    let expected = json!({ "encrypted": true, "insecure": false, "trusted": trusted });
    assert_eq!(ready["security"], expected);

    let link = json!({ "encrypted": true, "certificate": fingerprint });
    until("the agent is listed with its link", || {
        let listed = rover.host.run(&["agents", "--json"]).done_json();
        let agents = listed["agents"].as_array().unwrap();
        assert!(agents.iter().all(|it| it["type"] != "fipa-asker"));
        agents
            .iter()
            .any(|it| it["name"] == *arm && it["link"] == link)
    });
    let table = rover.host.run(&["agents", &arm]).done();
    assert!(table.contains("  encrypted"), "{table}");
    let routes = rover.host.run(&["routes", "--json"]).done_json();
    assert_eq!(routes["gateway"]["neighbors"][0]["security"], link);
    let routes = rover.host.run(&["routes"]).done();
    assert!(
        routes.contains("CONNECTED TO") && routes.contains("encrypted"),
        "{routes}"
    );
    assert!(
        routes.contains(&fingerprint.as_str().unwrap()[..16]),
        "{routes}"
    );
    // The commands that ask the gateway are not announced to other hosts.
    let there = crex.host.run(&["agents", "--json"]).done();
    assert!(!there.contains("fipa-routes-"), "{there}");

    // The gateway was started with other values than those that the doctor reads.
    let report = rover.host.run(&["doctor", "--json"]).done_json();
    let (severity, found) = finding(&report, "configuration of the running gateway");
    assert_eq!(severity, "warning", "{found}");
    assert!(
        found.contains("security.keys = ")
            && found.contains("security.loopback = true (here: false)"),
        "{found}"
    );
    let (_, found) = finding(&report, "connections with other gateways");
    assert!(found.contains(fingerprint.as_str().unwrap()), "{found}");

    rover.keys(&["distrust", &crex.name]);
    until("the host is listed as not trusted", || {
        let keys = format!("security.keys={}", rover.dir());
        let table = rover.host.run(&["agents", "--set", &keys]).done();
        table.contains("  not trusted")
    });
}

#[test]
fn the_doctor_of_both_hosts_says_which_one_has_keys() {
    let keyed = KeyedHost::new("rover", &[]);
    let finds = |host: &Host, check: &str, parts: &[&str]| {
        until("the doctor says which host has keys", || {
            let report = host.run(&["doctor", "--json"]).done_json();
            let checks = report["checks"].as_array().unwrap().iter();
            let mut found = checks.filter(|it| it["check"] == check);
            found.any(|it| {
                let text = it["found"].as_str().unwrap();
                it["severity"] == "warning" && parts.iter().all(|part| text.contains(part))
            })
        });
    };
    // The host without keys dials the other one.
    let (ours, address) = keyed.gateway(&[]);
    let plain = Host::new();
    let peer = format!("discovery.static={{ rover = [{address:?}] }}");
    let theirs = plain.start(&["up", "--set", &peer]);
    let none = "set security.keys here";
    finds(&plain, "static peers", &["rover", none]);
    let none = "it has no keys, but this gateway has";
    finds(&keyed.host, "refused connections", &["127.0.0.1", none]);
    drop((ours, theirs));

    // The host with keys dials the other one.
    let theirs = plain.start(&["up", "--json"]);
    let address = format!("tcp://{}", theirs.tcp_address());
    let (_ours, _) = keyed.gateway(&[("plain", &address)]);
    let none = "this host has keys and the peer has none";
    finds(&keyed.host, "static peers", &["plain", none]);
    let none = "the peer has keys and began TLS, but this gateway has no keys";
    finds(&plain, "refused connections", &["127.0.0.1", none]);
}

#[test]
fn a_certificate_with_a_known_name_is_trusted_with_a_warning() {
    let (rover, crex) = (KeyedHost::new("rover", &[]), KeyedHost::new("crex", &[]));
    rover.keys(&["trust", &crex.certificate()]);
    assert!(
        !rover
            .keys(&["trust", &crex.certificate()])
            .contains("note:")
    );
    crex.keys(&["renew"]);
    let next = crex.host.path("keys/next.pem").display().to_string();
    let trusted = rover.keys(&["trust", &next]);
    let fingerprint = crex.list()["own"]["fingerprint"].clone();
    let earlier = &fingerprint.as_str().unwrap()[..16];
    let advice = format!("`fipa keys distrust {earlier}`");
    assert!(trusted.contains(&advice), "{trusted}");

    // Another host whose gateway has the name of this one.
    let twin = Host::new();
    let name = format!("mts.name={}", rover.name);
    let dir = twin.path("keys").display().to_string();
    twin.run(&["keys", "init", "--dir", &dir, "--set", &name])
        .done();
    let file = format!("{dir}/own.pem");
    let trusted = rover.host.run(&[
        "keys",
        "trust",
        &file,
        "--dir",
        &rover.dir(),
        "--set",
        &name,
    ]);
    assert_eq!(trusted.code, Some(0), "{trusted:?}");
    for part in [
        "warning:",
        &rover.name,
        "set mts.name",
        "fipa keys distrust",
    ] {
        assert!(trusted.stderr.contains(part), "{}", trusted.stderr);
    }
}

#[test]
fn keys_are_listed_and_never_overwritten() {
    let host = KeyedHost::new(
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
    for (arguments, expected) in [
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
            vec!["keys", "revoke", "unknown", "--dir", &dir],
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
        let errors = host.host.run(&arguments).failed(1);
        assert!(errors.contains(expected), "{arguments:?}: {errors}");
    }
    assert_eq!(host.list(), listed);

    // The next keys are listed too, and are created only once.
    assert_eq!(listed["next"], Value::Null);
    host.keys(&["renew"]);
    assert_eq!(host.list()["next"]["mts"], json!(host.name));
    let errors = host.host.run(&["keys", "renew", "--dir", &dir]).failed(1);
    assert!(errors.contains("`fipa keys renew --use`"), "{errors}");
}

#[test]
fn without_keys_the_output_names_the_command_that_creates_them() {
    let host = Host::new();
    let output = host.run(&["keys", "list"]).done();
    assert!(
        output.contains("create them with `fipa keys init`"),
        "{output}"
    );
    let output = host.run(&["keys", "init", "--dir", "some"]).done();
    // The path is absolute, so it does not depend on the working directory of the gateway.
    let dir = host.path("some").canonicalize().unwrap();
    assert!(output.contains(&format!("keys = {dir:?}")), "{output}");
}

#[test]
fn a_gateway_does_not_start_with_keys_that_cannot_be_used() {
    let host = KeyedHost::new("rover", &[]);
    let keys = format!("security.keys={}", host.dir());
    let output = host
        .host
        .run(&["up", "--set", &keys, "--set", "mts.name=another"]);
    let output = output.failed(1);
    assert!(
        output.contains("another")
            && output.contains(&host.name)
            && output.contains("mts.name=NAME"),
        "{output}"
    );
    let output = host
        .host
        .run(&["up", "--set", "security.keys=/nowhere"])
        .failed(1);
    assert!(output.contains("fipa keys init"), "{output}");
    let output = host
        .host
        .run(&["up", "--set", "transport.tcp.listen=0.0.0.0:0"]);
    let output = output.failed(2);
    assert!(
        output.contains("fipa keys init") && output.contains("security.insecure"),
        "{output}"
    );
}

#[test]
fn an_expired_certificate_is_reported_in_every_output() {
    let (rover, crex) = (
        KeyedHost::new("rover", &["--valid", "1ms"]),
        KeyedHost::new("crex", &[]),
    );
    // The times of a certificate have a resolution of one second.
    until("the certificate has expired", || {
        rover.keys(&["list"]).contains("(has expired)")
    });
    let clock = "has expired; the clock of this host shows ";
    let listed = rover.keys(&["list"]);
    assert!(listed.contains(clock), "{listed}");
    let output = crex.keys(&["trust", &rover.certificate()]);
    assert!(output.contains("(has expired)"), "{output}");
    assert!(output.contains(clock), "{output}");
    let (mut theirs, address) = crex.gateway(&[]);
    theirs.wait_for_log(&["the certificate of rover", "has expired"]);
    rover.keys(&["trust", &crex.certificate()]);
    let (mut ours, _) = rover.gateway(&[(&crex.name, &address)]);
    ours.wait_for_log(&[
        "the certificate of this host has expired",
        "the clock of this host shows",
    ]);
    let clock = "by the clock of this host, which shows 20";
    theirs.wait_for_log(&[
        "connection refused",
        "Expired",
        clock,
        "`fipa keys renew` there",
    ]);
}

#[test]
fn a_named_pipe_among_the_certificates_does_not_block() {
    let rover = KeyedHost::new("rover", &[]);
    let trusted = rover.host.path("keys/trusted");
    std::fs::create_dir_all(&trusted).unwrap();
    let pipe = trusted.join("other.pem").display().to_string();
    let status = Command::new("mkfifo").args(["-m", "600", &pipe]).status();
    assert!(status.unwrap().success());
    let listed = rover.host.run(&["keys", "list", "--dir", &rover.dir()]);
    let output = format!(
        "{}{}",
        String::from_utf8_lossy(&listed.stdout),
        listed.stderr
    );
    assert!(output.contains("not a regular file"), "{output}");
}
