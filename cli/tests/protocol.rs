//! `fipa protocol`: lists, shows, checks and draws protocols.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;

use common::Host;
use serde_json::Value;

/// A protocol in the format of fipa_acl.
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
    assert_eq!(json.as_array().unwrap().len(), 20);
    let shown = host.run(&["protocol", "show", "contractNet"]).done();
    for line in [
        "fipa-contract-net: Calling for proposals and accepting some",
        "scope: one state per participant",
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
        unknown.contains("no protocol and no file has the name \"fipa-dance\""),
        "{unknown}"
    );
}

#[test]
fn errors_in_files_are_reported_with_their_lines() {
    let host = Host::new();
    let (good, bad) = (host.path("lift"), host.path("bad.scxml"));
    fs::write(&good, LIFT).unwrap();
    fs::write(&bad, LIFT.replace("target=\"3\"", "target=\"4\"")).unwrap();
    let (good, bad) = (good.to_str().unwrap(), bad.to_str().unwrap());
    let fine = host.run(&["protocol", "check", good]).done();
    assert!(
        fine.ends_with("lift: lift, states: 3, no errors\n"),
        "{fine}"
    );
    let wrong = host.run(&["protocol", "check", bad]).failed(1);
    assert!(wrong.contains("error: there is no state \"4\""), "{wrong}");
    assert!(wrong.contains("bad.scxml:6"), "{wrong}");
    let (json, output) = host
        .run(&["protocol", "check", "--json", good, bad])
        .failed_json();
    assert_eq!(
        (&json[0]["name"], output.as_str()),
        (&Value::from("lift"), "")
    );
    assert_eq!(json[1]["mistakes"][0]["line"], 6);
    host.run(&["protocol", "check"]).failed(2);
}

#[test]
fn protocols_are_drawn_as_svg_and_mermaid() {
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
        "starts protocol fipa-.*, answers to initiator",
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
fn protocols_of_the_configuration_are_listed_first() {
    let host = Host::new();
    let file = host.path("lift.scxml");
    fs::write(&file, LIFT).unwrap();
    let set = format!("monitor.protocols={}", file.display());
    let json = host
        .run(&["--set", &set, "protocol", "list", "--json"])
        .done_json();
    assert_eq!(json[0]["name"], "lift");
    assert_eq!(json.as_array().unwrap().len(), 21);
}

#[test]
fn a_protocol_is_exported_as_a_file_that_is_read_again() {
    let host = Host::new();
    let exported = host.path("mine.scxml");
    let path = exported.to_str().unwrap();
    let args = ["protocol", "export", "contractNet", "--output", path];
    host.run(&args).done();
    let checked = host.run(&["protocol", "check", path]).done();
    assert!(checked.contains("fipa-contract-net"), "{checked}");
    assert!(!checked.contains("warning"), "{checked}");
    let printed = host
        .run(&["protocol", "export", "fipa-contract-net"])
        .done();
    assert_eq!(printed, fs::read_to_string(&exported).unwrap());
    // A file of the configuration replaces the built-in one.
    let own = printed.replace("Calling for proposals", "Our calls for proposals");
    fs::write(&exported, &own).unwrap();
    let set = format!("monitor.protocols={path}");
    let args = ["--set", &set, "protocol", "export", "fipa-contract-net"];
    assert_eq!(host.run(&args).done(), own);
    let unknown = host.run(&["protocol", "export", "fipa-dance"]).failed(1);
    assert!(unknown.contains("no protocol"), "{unknown}");
}

#[test]
fn a_check_warns_of_near_performatives_and_ignored_attributes() {
    let host = Host::new();
    let file = host.path("lift.scxml");
    let text = LIFT.replace(
        "performative=\"request\"",
        "performative=\"reqest\" optional=\"yes\"",
    );
    fs::write(&file, text).unwrap();
    let file = file.to_str().unwrap();
    let checked = host.run(&["protocol", "check", file]).done();
    for warning in [
        "warning, line 3: \"reqest\" is no performative of FIPA00037; did you mean \"request\"?",
        "warning, line 3: the attribute \"optional\" of <transition> has no effect",
    ] {
        assert!(checked.contains(warning), "{warning}: {checked}");
    }
    let json = host.run(&["protocol", "check", "--json", file]).done_json();
    assert_eq!(json[0]["warnings"].as_array().unwrap().len(), 2);
}

#[test]
fn a_check_shows_warnings_beside_errors_and_refuses_messages_of_a_role_to_itself() {
    let host = Host::new();
    let file = host.path("lift.scxml");
    let text = LIFT
        .replace("performative=\"request\"", "performative=\"reqest\"")
        .replace(
            "from=\"B\" to=\"initiator\" target",
            "from=\"B\" to=\"B\" target",
        );
    fs::write(&file, text).unwrap();
    let file = file.to_str().unwrap();
    let (printed, error) = host.run(&["protocol", "check", file]).failed_text();
    let warning = "\"reqest\" is no performative of FIPA00037; did you mean \"request\"?";
    assert!(printed.contains("lift.scxml: errors: 1\n"), "{printed}");
    assert!(
        printed.contains(&format!("warning, line 3: {warning}")),
        "{printed}"
    );
    assert!(
        error.contains("role \"B\" sends the message to itself"),
        "{error}"
    );
    let (json, _) = host
        .run(&["protocol", "check", "--json", file])
        .failed_json();
    assert_eq!(json[0]["mistakes"][0]["line"], 6);
    assert_eq!(json[0]["warnings"][0]["what"], warning);
}

#[test]
fn drawings_have_conditions_and_a_legend() {
    let host = Host::new();
    let file = host.path("bids.scxml");
    let text = "<scxml initial=\"1\" f:scope=\"participant\" xmlns:f=\"urn:fipa-rs:protocol\">\
                <state id=\"1\"><transition performative=\"cfp\" from=\"a\" to=\"b\" target=\"2\"/></state>\
                <state id=\"2\"><transition performative=\"accept-proposal\" from=\"a\" to=\"b\" \
                target=\"3\" f:when=\"all\" f:at-most=\"2\"/></state><state id=\"3\" final=\"yes\"/></scxml>";
    fs::write(&file, text).unwrap();
    let file = file.to_str().unwrap();
    let svg = host.run(&["protocol", "draw", file]).done();
    let mermaid = host.run(&["protocol", "draw", file, "--format", "mermaid"]);
    let mermaid = mermaid.done();
    let shown = host.run(&["protocol", "show", file]).done();
    for text in [&svg, &mermaid, &shown] {
        assert!(text.contains("(when all, at most 2)"), "{text}");
    }
    for legend in [
        "the first state",
        "may end here",
        "an optional step, or a timeout",
    ] {
        assert!(svg.contains(legend), "{legend}: {svg}");
    }
    assert!(mermaid.contains("    note right of s0\n"), "{mermaid}");
    for text in [&svg, &mermaid] {
        for legend in [
            "the step may be skipped",
            "no more participants",
            "all participants",
        ] {
            assert!(text.contains(legend), "{legend}: {text}");
        }
    }
    let json = host.run(&["protocol", "show", file, "--json"]).done_json();
    let step = &json["states"][1]["transitions"][0];
    assert_eq!(
        (&step["when_all"], &step["at_most"]),
        (&true.into(), &2.into())
    );
}

#[test]
fn the_transitions_of_every_protocol_are_drawn_on_request() {
    let host = Host::new();
    for format in ["svg", "mermaid"] {
        let draw = |name, defaults: &[&str]| {
            let args = ["protocol", "draw", name, "--format", format];
            host.run(&[&args, defaults].concat()).done()
        };
        let plain = draw("fipa-request", &[]);
        assert!(!plain.contains("cancelling"), "{plain}");
        let drawn = draw("fipa-request", &["--defaults"]);
        for text in [
            "not-understood from any role",
            "cancel from initiator",
            "failure from a message transport service",
            "cancelled",
            "undelivered",
        ] {
            assert!(drawn.contains(text), "{text}: {drawn}");
        }
        // An English auction cannot be canceled.
        let auction = draw("fipa-auction-english", &["--defaults"]);
        assert!(!auction.contains("cancelling"), "{auction}");
        assert!(auction.contains("undelivered"), "{auction}");
    }
}

#[test]
fn a_check_says_why_a_protocol_with_three_roles_is_only_watched() {
    let host = Host::new();
    let step = |act: &str, from: &str, to: &str, target: u8| {
        format!(
            "<transition performative=\"{act}\" from=\"{from}\" to=\"{to}\" target=\"{target}\"/>"
        )
    };
    let state = |id: u8, steps: &[String]| format!("<state id=\"{id}\">{}</state>", steps.concat());
    let end = |id: u8| format!("<state id=\"{id}\" final=\"yes\"/>");
    // The role c is told the same in two cases, and its answer may be the wrong one.
    let asked = [
        state(
            1,
            &[step("request", "a", "b", 2), step("propose", "a", "b", 3)],
        ),
        state(2, &[step("request", "b", "c", 4)]),
        state(3, &[step("request", "b", "c", 5)]),
        state(4, &[step("agree", "c", "b", 6)]),
        state(5, &[step("refuse", "c", "b", 6)]),
        end(6),
    ];
    let file = host.path("three.scxml");
    let text = format!("<scxml initial=\"1\">{}</scxml>", asked.concat());
    fs::write(&file, text).unwrap();
    let check = ["protocol", "check", file.to_str().unwrap()];
    let shown = host.run(&check).done();
    for defect in [
        "only watched: c cannot know when to send",
        "b does not expect",
    ] {
        assert!(shown.contains(defect), "{defect}: {shown}");
    }
    // No transition leads to the state.
    let apart = [
        state(1, &[step("request", "a", "b", 2)]),
        end(2),
        state(3, &[step("inform", "b", "a", 2)]),
    ];
    let file = host.path("apart.scxml");
    let text = format!("<scxml initial=\"1\">{}</scxml>", apart.concat());
    fs::write(&file, text).unwrap();
    let wrong = host.run(&["protocol", "check", file.to_str().unwrap()]);
    let wrong = wrong.failed(1);
    assert!(wrong.contains("\"3\""), "{wrong}");
}
