//! The rules of `[access]`: what a gateway and an agent's own process do not let through, and what
//! is told of it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod common;

use std::time::{Duration, Instant};

use common::Host;
use serde_json::Value;

/// Starts a gateway with these settings; says where it is.
fn gateway(host: &Host, settings: &[String]) -> (common::Running, String) {
    let mut arguments = vec!["up", "--json", "-v"];
    for setting in settings {
        arguments.extend(["--set", setting]);
    }
    let gateway = host.start(&arguments);
    let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
    let location = ready["locations"].as_array().unwrap().iter();
    let mut tcp = location.map(|one| one.as_str().unwrap());
    let tcp = tcp.find(|one| one.starts_with("tcp://")).unwrap();
    (gateway, tcp.split('#').next().unwrap().to_owned())
}

#[test]
fn what_a_rule_denies_is_refused_and_audited() {
    let (rover, crex) = (Host::new(), Host::new());
    let (arm, brake) = (
        format!("arm-{}", crex.domain),
        format!("brake-{}", crex.domain),
    );
    let (mut theirs, address) = gateway(
        &crex,
        &[
            format!("mts.name=crex-{}", crex.domain),
            format!("access.allow={{ \".*\" = [\"{arm} performative=inform,query-ref\"] }}"),
            format!("access.deny={{ \".*\" = [\"{arm} performative=query-ref\"] }}"),
        ],
    );
    let _arm = crex.echo(&arm);
    let _brake = crex.echo(&brake);
    let _ours = gateway(
        &rover,
        &[
            format!("mts.name=rover-{}", rover.domain),
            format!(
                "discovery.static={{ crex-{} = [{address:?}] }}",
                crex.domain
            ),
        ],
    );
    let send = |to: &str, performative: &str| {
        let content = ["--content", "hello", "--performative", performative];
        rover.run(&[&["send", "--to", to], &content[..]].concat())
    };
    let begun = Instant::now();
    while send(&arm, "inform").code != Some(0) {
        assert!(
            begun.elapsed() < Duration::from_secs(60),
            "no letter passes"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
    for (to, performative, why) in [
        (&arm, "request", "no rule allows it"),
        (&arm, "query-ref", "a rule denies it"),
        (&brake, "inform", "no rule allows it"),
    ] {
        let sent = send(to, performative);
        assert_eq!(sent.code, Some(1), "{to} {performative}");
        let told = format!("{}{}", String::from_utf8_lossy(&sent.stdout), sent.stderr);
        assert!(told.contains("refused") && told.contains(why), "{told}");
        theirs.tells(&["fipa::audit", "letter refused", why]);
    }
    assert_eq!(send(&arm, "inform").code, Some(0));
}

#[test]
fn agents_of_one_host_are_held_to_the_rules_by_who_gets_their_letters() {
    let host = Host::new();
    let deny = "access.deny={ \".*\" = [\"arm performative=request\"] }";
    let mut arm = host.start(&["echo", "arm", "-v", "--set", deny]);
    // Who sends has no rules. The gateway, which is not on the way, answers what it is asked.
    let everything = "access.allow={ nobody = [\"nothing\"] }";
    let _gateway = host.start(&["up", "--set", everything]);
    let send = |performative: &str| {
        let content = ["--content", "hello", "--performative", performative];
        host.run(&[&["send", "--to", "arm"], &content[..]].concat())
    };
    assert_eq!(send("inform").code, Some(0));
    let sent = send("request");
    assert_eq!(sent.code, Some(1), "{sent:?}");
    let told = format!("{}{}", String::from_utf8_lossy(&sent.stdout), sent.stderr);
    assert!(told.contains("a rule denies it"), "{told}");
    arm.tells(&["fipa::audit", "letter refused", "a rule denies it"]);
    // Whoever lets in nobody else still hears the gateway.
    let routes = host.run(&["routes", "--json", "--set", everything]);
    assert_eq!(routes.code, Some(0), "{routes:?}");
}
