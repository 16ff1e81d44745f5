//! The rules of `[access]`: the letters that a gateway and the process of an agent reject, and the
//! reports about them.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::time::{Duration, Instant};

use common::Host;

/// Starts a gateway with these settings. Returns it with its TCP location.
fn gateway(host: &Host, settings: &[String]) -> (common::Running, String) {
    let mut arguments = vec!["up", "--json", "-v"];
    for setting in settings {
        arguments.extend(["--set", setting]);
    }
    let gateway = host.start(&arguments);
    let location = format!("tcp://{}", gateway.tcp_address());
    (gateway, location)
}

#[test]
fn a_letter_that_a_rule_denies_is_refused_and_audited() {
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
            "no letter is delivered"
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
        let output = format!("{}{}", String::from_utf8_lossy(&sent.stdout), sent.stderr);
        assert!(
            output.contains("refused") && output.contains(why),
            "{output}"
        );
        theirs.wait_for_log(&["fipa::audit", "letter refused", why]);
    }
    assert_eq!(send(&arm, "inform").code, Some(0));
}

#[test]
fn the_receiving_process_enforces_its_rules_within_a_host() {
    let host = Host::new();
    let deny = "access.deny={ \".*\" = [\"arm performative=request\"] }";
    let mut arm = host.start(&["echo", "arm", "-v", "--set", deny]);
    // The sender has no rules. The gateway, which does not forward these letters, answers requests for
    // its routes in spite of its rules.
    let deny_all = "access.allow={ unknown = [\"nothing\"] }";
    let _gateway = host.start(&["up", "--set", deny_all]);
    let send = |performative: &str| {
        let content = ["--content", "hello", "--performative", performative];
        host.run(&[&["send", "--to", "arm"], &content[..]].concat())
    };
    assert_eq!(send("inform").code, Some(0));
    let sent = send("request");
    assert_eq!(sent.code, Some(1), "{sent:?}");
    let output = format!("{}{}", String::from_utf8_lossy(&sent.stdout), sent.stderr);
    assert!(output.contains("a rule denies it"), "{output}");
    arm.wait_for_log(&["fipa::audit", "letter refused", "a rule denies it"]);
    // A process that denies all other senders still accepts the answer of the gateway.
    let routes = host.run(&["routes", "--json", "--set", deny_all]);
    assert_eq!(routes.code, Some(0), "{routes:?}");
}
