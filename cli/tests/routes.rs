//! `fipa routes`, in processes of their own.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod common;

use common::Host;
use serde_json::{Value, json};

#[test]
fn which_way_letters_would_go() {
    let host = Host::new();
    let nobody = host.run(&["routes"]).done();
    assert!(nobody.starts_with("nobody in the domain "), "{nobody}");
    let _arm = host.echo("arm_1");
    let _camera = host.echo("camera");
    let alone = host.run(&["routes", "--json"]).done_json();
    assert_eq!(alone["gateway"], Value::Null);
    let routes = alone["process"]["routes"].as_array().unwrap();
    let names: Vec<&Value> = routes.iter().map(|route| &route["receiver"]).collect();
    assert_eq!(names, [&json!("arm_1"), &json!("camera")]);
    for way in routes[0]["ways"].as_array().unwrap() {
        assert_eq!(way["standing"], json!({ "standing": "ready" }));
    }
    let first = routes[0]["ways"][0]["location"].as_str().unwrap();
    assert!(first.starts_with("shm://"), "{first}");

    // An exception, as a process that starts now has it, and as the gateway has it.
    let exception = "routes={ \"arm_.*\" = [\"unix\"] }";
    let peer = "discovery.static={ crex = [\"tcp://127.0.0.1:9\"] }";
    let _gateway = host.start(&["up", "--set", "mts.name=sherpa", "--set", peer]);
    let told = host.run(&["routes", "arm_1", "--json", "--set", exception]);
    let told = told.done_json();
    let route = &told["process"]["routes"][0];
    assert_eq!(route["exception"], "arm_.*");
    let ways = route["ways"].as_array().unwrap();
    let location = |way: &Value| way["location"].as_str().unwrap().to_owned();
    assert!(location(&ways[0]).starts_with("unix://"), "{ways:?}");
    let standing = |way: &Value| way["standing"]["standing"].clone();
    assert_eq!(standing(ways.last().unwrap()), "not_in_order");
    let gateway = &told["gateway"];
    assert_eq!(gateway["mts"], "sherpa");
    assert_eq!(gateway["routes"].as_array().unwrap().len(), 1);
    assert_eq!(gateway["routes"][0]["exception"], Value::Null);
    assert_eq!(gateway["peers"][0]["name"], "crex");

    let table = host.run(&["routes"]).done();
    assert!(table.starts_with("TO "), "{table}");
    assert!(!table.contains("fipa-routes-"), "{table}");
    assert!(table.contains("The gateway sherpa:"), "{table}");
    assert!(table.contains("takes letters at "), "{table}");
    assert!(table.contains("static peer crex: "), "{table}");
}

#[test]
fn what_is_no_pattern_is_refused() {
    let host = Host::new();
    let told = host.run(&["routes", "arm_("]).failed(2);
    assert!(told.contains("regular expression"), "{told}");
}
