//! The commands with agents of legacy peers, in processes of their own.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod common;

use common::Host;
use serde_json::{Value, json};

/// Waits until the processes of the host are told of the agent, and returns what `fipa agents` says.
#[track_caller]
fn known(host: &Host, name: &str) -> Value {
    let until = std::time::Instant::now() + std::time::Duration::from_secs(60);
    loop {
        let all = host.run(&["agents", name, "--json"]).done_json();
        match &all["agents"][0] {
            Value::Null => assert!(std::time::Instant::now() < until, "{all}"),
            agent => return agent.clone(),
        }
    }
}

#[test]
fn an_agent_that_has_udt_only_is_shown_as_unsupported_and_letters_to_it_fail_at_once() {
    let host = Host::new();
    let peer = "discovery.static={ cpp = [\"udt://127.0.0.1:9\"] }";
    let _gateway = host.start(&["up", "--set", peer]);
    let agent = known(&host, "cpp");
    assert_eq!(
        agent["locations"],
        json!(["udt://127.0.0.1:9;fipa-services"])
    );
    assert_eq!(agent["unsupported_transports"], json!(["udt"]));
    let table = host.run(&["agents", "cpp"]).done();
    let shown = "udt://127.0.0.1:9;fipa-services (unsupported transport udt)";
    assert!(table.contains(shown), "{table}");
    let routes = host.run(&["routes", "cpp"]).done();
    let shown = "not used: unsupported transport";
    assert!(routes.contains(shown), "{routes}");

    // The watchdog ends the command long before this deadline.
    let send = ["send", "--to", "cpp", "--deadline", "30m", "--json"];
    let (json, told) = host.run(&send).failed_json();
    let delivery = &json["deliveries"][0];
    assert_eq!(delivery["reason"], "unsupported transport");
    assert_eq!(delivery["attempts"][0]["via"], "udt");
    assert!(
        told.starts_with("error: not delivered: unsupported transport\nwhere: \"cpp\"\n"),
        "{told}"
    );
}
