//! The docking demo, followed on the page of one of its gateways.

use super::*;
use crate::common::Running;

#[test]
fn the_docking_demo_is_followed_live() {
    let name = "the_docking_demo_is_followed_live";
    let Some(browser) = Browser::open(name, 1280, 800) else {
        return;
    };
    let host = Host::new();
    let mut command = host.command(&["demo", "dock", "--dashboard"]);
    command.env_remove("FIPA_RUNTIME_DIR");
    let mut demo = Running::new(command_with_input(command));
    let link = loop {
        let line = demo.line();
        if let Some((_, link)) = line.split_once("shows the robots at ") {
            break link.to_owned();
        }
    };
    browser.go_to(&link);
    browser.wait_for("this host");
    // The robots start when the operator of this page is ready.
    assert!(!browser.text().contains("payload_1"));
    demo.write_line("");
    for name in ["sherpa", "payload_1", "payload_2", "crex", "operator"] {
        until(name, || {
            rows(&browser).iter().any(|row| row.starts_with(name))
        });
    }
    browser.value("location.hash = '#/locks'");
    until("the master holds an interface of an item", || {
        let is_held = |row: &String| row.starts_with("payload_") && row.contains(" sherpa ");
        rows(&browser).iter().any(is_held)
    });
    // The owner of this one is on the other host.
    until("the master holds an interface of crex", || {
        let is_held = |row: &String| row.starts_with("crex/") && row.contains(" sherpa ");
        rows(&browser).iter().any(is_held)
    });
    browser.wait_for("for operator");
    browser.value("location.hash = '#/conversations'");
    until("a docking", || {
        let all = rows(&browser);
        all.iter()
            .any(|row| row.contains("dock") && row.contains("sherpa"))
    });
    browser.value("location.hash = '#/fleet'");
    browser.wait_for("crex_stack");
    // The run and its checks end, and the robots stay until the operator has seen them.
    while !demo.line().contains("press Enter to end") {}
    until("the coalition of all three", || {
        let members = browser.value(
            "document.querySelector('[aria-label=\"Coalition crex_stack\"] tbody')?.textContent ?? ''",
        );
        let members = members.as_str().unwrap();
        let all = ["crex", "payload_1", "payload_2"];
        all.iter().all(|member| members.contains(member))
    });
    browser.assert_no_messages();
    demo.write_line("");
    let (code, log) = demo.end();
    assert_eq!(code, Some(0), "{log}");
}

fn command_with_input(mut command: std::process::Command) -> std::process::Command {
    command.stdin(Stdio::piped());
    command
}
