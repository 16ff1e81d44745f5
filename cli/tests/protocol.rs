//! `fipa protocol`: what is known, what is in a file, what is wrong with one, and how it looks.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod common;

use std::fs;

use common::Host;
use serde_json::Value;

/// In the form of fipa_acl.
const LIFT: &str = r#"<scxml version="1.0" initial="1">
<state id="1">
  <transition performative="request" from="initiator" to="B" target="2"/>
</state>
<state id="2">
  <transition performative="inform|failure" from="B" to="initiator" target="3"/>
  <subprotocol name="fipa-.*" from="B" proxied_to="initiator"/>
</state>
<state id="3" final="yes"/>
</scxml>
"#;

#[test]
fn protocols_are_listed_and_shown() {
    let host = Host::new();
    let list = host.run(&["protocol", "list"]).done();
    for name in [
        "fipa-request",
        "fipa-auction-english",
        "contractNet",
        "PROTOCOL",
    ] {
        assert!(list.contains(name), "{list}");
    }
    let json = host.run(&["protocol", "list", "--json"]).done_json();
    assert_eq!(json.as_array().unwrap().len(), 13);
    let shown = host.run(&["protocol", "show", "contractNet"]).done();
    for line in [
        "fipa-contract-net: Calling for proposals and accepting some",
        "each participant has a state of its own",
        "start (initial)",
        "  cfp from initiator to participant -> called",
        "  after reply-by -> expired",
        "done (final)",
    ] {
        assert!(shown.lines().any(|shown| shown == line), "{line}: {shown}");
    }
    let json = host
        .run(&["protocol", "show", "fipa-request", "--json"])
        .done_json();
    assert_eq!(json["scope"], "participant");
    assert_eq!(json["states"][1]["transitions"][1]["optional"], true);
    let unknown = host.run(&["protocol", "show", "fipa-dance"]).failed(1);
    assert!(
        unknown.contains("no protocol is called \"fipa-dance\""),
        "{unknown}"
    );
}

#[test]
fn files_are_checked() {
    let host = Host::new();
    let (good, bad) = (host.path("lift"), host.path("bad.scxml"));
    fs::write(&good, LIFT).unwrap();
    fs::write(&bad, LIFT.replace("target=\"3\"", "target=\"4\"")).unwrap();
    let (good, bad) = (good.to_str().unwrap(), bad.to_str().unwrap());
    let fine = host.run(&["protocol", "check", good]).done();
    assert!(
        fine.ends_with("lift: lift, states: 3, no mistakes\n"),
        "{fine}"
    );
    let wrong = host.run(&["protocol", "check", bad]).failed(1);
    assert!(wrong.contains("error: there is no state \"4\""), "{wrong}");
    assert!(wrong.contains("bad.scxml:6"), "{wrong}");
    let (json, told) = host
        .run(&["protocol", "check", "--json", good, bad])
        .failed_json();
    assert_eq!(
        (&json[0]["name"], told.as_str()),
        (&Value::from("lift"), "")
    );
    assert_eq!(json[1]["mistakes"][0]["line"], 6);
    host.run(&["protocol", "check"]).failed(2);
}

#[test]
fn protocols_are_drawn() {
    let host = Host::new();
    let good = host.path("lift.scxml");
    fs::write(&good, LIFT).unwrap();
    let good = good.to_str().unwrap();
    for name in ["fipa-iterated-contract-net", "fipa-recruiting", good] {
        let svg = host.run(&["protocol", "draw", name]).done();
        assert!(
            svg.starts_with("<svg ") && svg.ends_with("</svg>\n"),
            "{svg}"
        );
    }
    let svg = host.run(&["protocol", "draw", good]).done();
    for text in [
        "inform|failure",
        "begins protocol fipa-.*, answers to initiator",
    ] {
        assert!(svg.contains(text), "{text}: {svg}");
    }
    let file = host.path("out.mmd");
    let path = file.to_str().unwrap();
    host.run(&[
        "protocol",
        "draw",
        "fipa-request",
        "--format",
        "mermaid",
        "-o",
        path,
    ])
    .done();
    let mermaid = fs::read_to_string(file).unwrap();
    assert!(mermaid.starts_with("stateDiagram-v2\n"), "{mermaid}");
    assert!(
        mermaid.contains("    s0 --> s1 : request from initiator\n"),
        "{mermaid}"
    );
    assert!(
        mermaid.contains("agree from participant (optional)"),
        "{mermaid}"
    );
}

#[test]
fn the_configuration_brings_protocols_of_its_own() {
    let host = Host::new();
    let file = host.path("lift.scxml");
    fs::write(&file, LIFT).unwrap();
    let set = format!("monitor.protocols={}", file.display());
    let json = host
        .run(&["--set", &set, "protocol", "list", "--json"])
        .done_json();
    assert_eq!(json[0]["name"], "lift");
    assert_eq!(json.as_array().unwrap().len(), 14);
}
