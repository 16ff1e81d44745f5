//! The example of docs/protocols.md does what the page says.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::SystemTime;

use fipa_monitor::projection::Projection;
use fipa_monitor::{Header, Library, Machine, Monitor, ViolationKind as Kind};

fn example() -> String {
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/protocols.md");
    let page = std::fs::read_to_string(page).unwrap();
    let (_, rest) = page.split_once("```xml\n").unwrap();
    rest.split_once("```").unwrap().0.to_owned()
}

/// Passes messages such as `request rover>dock` to the monitor of an agent, or to that of an observer.
/// Those after `!` are violations.
fn play(agent: Option<&str>, words: &[&str]) {
    let mut library = Library::standard();
    library.read("docking.scxml", &example()).unwrap();
    let library = Arc::new(library);
    let mut monitor = match agent {
        Some(agent) => Monitor::agent(library, agent),
        None => Monitor::observer(library),
    };
    for message in words {
        let legal = message.strip_prefix('!').unwrap_or(message);
        let (act, agents) = legal.split_once(' ').unwrap();
        let (from, to) = agents.split_once('>').unwrap();
        let header = Header::new(act.parse().unwrap()).sender(from);
        let header = header.receivers([to]).protocol("docking");
        let header = header.conversation_id("c");
        let verdict = monitor.check(&header, SystemTime::UNIX_EPOCH);
        if legal == *message {
            assert!(verdict.is_accepted(), "{agent:?}: {message}: {verdict:?}");
        } else {
            let kind = verdict.violation().map(|violation| violation.kind);
            assert!(
                kind.is_some_and(|kind| kind != Kind::TooLarge),
                "{agent:?}: {message}"
            );
        }
    }
}

#[test]
fn the_example_is_a_valid_protocol_that_every_role_can_check() {
    let (machine, warnings) = Machine::read_with_warnings("docking.scxml", &example()).unwrap();
    assert_eq!(warnings, []);
    assert_eq!(machine.name(), "docking");
    assert_eq!(machine.roles().len(), 3);
    assert_eq!(Projection::defects(&machine), []);
    assert!(machine.projection().is_some());
}

#[test]
fn every_role_of_the_example_checks_what_it_sees() {
    play(
        None,
        &[
            "request rover>dock",
            "propagate dock>arm",
            "agree arm>dock",
            "!inform rover>arm",
            "agree dock>rover",
            "!confirm arm>dock",
            "inform rover>arm",
            "confirm arm>dock",
        ],
    );
    play(
        Some("rover"),
        &[
            "request rover>dock",
            "!inform rover>arm",
            "agree dock>rover",
            "!refuse dock>rover",
            "inform rover>arm",
        ],
    );
    play(
        Some("arm"),
        &[
            "propagate dock>arm",
            "agree arm>dock",
            "!confirm arm>dock",
            "inform rover>arm",
            "confirm arm>dock",
        ],
    );
    play(
        Some("dock"),
        &[
            "request rover>dock",
            "propagate dock>arm",
            "!agree dock>rover",
            "failure arm>dock",
            "!agree dock>rover",
            "failure dock>rover",
        ],
    );
}

#[test]
fn a_role_that_is_not_told_when_to_speak_is_reported() {
    let early = example().replace(
        "<transition performative=\"inform\" from=\"rover\" to=\"arm\" target=\"arrived\"/>",
        "<transition performative=\"confirm\" from=\"arm\" to=\"dock\" target=\"docked\"/>",
    );
    let without = "<state id=\"arrived\">\n    <transition performative=\"confirm\" from=\"arm\" \
                   to=\"dock\" target=\"docked\"/>\n  </state>\n";
    let early = early.replace(without, "");
    let machine = Machine::read("docking.scxml", &early).unwrap();
    assert_ne!(Projection::defects(&machine), []);
    assert!(machine.projection().is_none());
}
