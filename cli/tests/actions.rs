//! `fipa actions` and `fipa do` in processes of their own. The robot is this test program in a process of
//! its own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::io::{BufRead as _, BufReader};
use std::process::Stdio;
use std::sync::atomic::{AtomicU32, Ordering};

use common::{Host, Ran};
use fipa::actions::{Action, Execution, ParameterDescription, Progress};
use fipa::config::Sources;
use fipa::{Config, Domain};
use fipa_testbed::{ChildGuard, ignored_test};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Environment variable with the domain of a robot process.
const DOMAIN: &str = "FIPA_TEST_ROBOT_DOMAIN";

/// Time for each message.
const DEADLINE: &str = "mts.deadline=30s";

#[derive(Serialize, Deserialize)]
#[serde(rename = "pose")]
struct Pose {
    x: f64,
    y: f64,
}

#[derive(Serialize, Deserialize)]
struct Dock {
    target: Pose,
    speed: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(rename = "docked")]
struct Docked {
    x: f64,
    speed: f64,
}

/// A robot with an action that ends, one that runs until it is to stop, and one that fails.
#[test]
#[ignore = "started by the other tests"]
fn robot_process() {
    let Ok(domain) = std::env::var(DOMAIN) else {
        return;
    };
    let config = Config::load(&Sources {
        set: vec![
            format!("domain={domain}"),
            "discovery.mdns=false".to_owned(),
            "access.operators=boss".to_owned(),
            DEADLINE.to_owned(),
        ],
        ..Sources::default()
    });
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let domain = Domain::open(&config.unwrap()).await.unwrap();
        let crex = domain.register("crex").await.unwrap();
        let speed = ParameterDescription::of::<f64>("speed").unit("m/s");
        let dock = Action::new("dock")
            .described("Docks")
            .parameter::<Pose>("target", "m; frame crex/base")
            .with(speed.range(0.0..=0.5).default(&0.25).unwrap())
            .result::<Docked>();
        let dock = crex.offer(dock, |goal: Dock, _: Execution| async move {
            Ok::<_, String>(Docked {
                x: goal.target.x,
                speed: goal.speed,
            })
        });
        let drive = crex.offer(Action::new("drive"), |(): (), run: Execution| async move {
            let at = Pose { x: 0.5, y: 2.0 };
            run.progress(Progress::fraction(0.5).note("half-way").value(&at).unwrap());
            let cause = run.stopped().await;
            Err::<(), _>(format!("{cause:?}"))
        });
        let fail = crex.offer(Action::new("fail"), |(): (), _: Execution| async {
            Err::<(), _>("no power")
        });
        let runs = AtomicU32::new(0);
        let count = crex.offer(Action::new("count"), move |(): (), _: Execution| {
            let run = runs.fetch_add(1, Ordering::Relaxed) + 1;
            async move { Ok::<_, String>(run) }
        });
        let _offers = (dock.unwrap(), drive.unwrap(), fail.unwrap(), count.unwrap());
        println!("ready");
        std::future::pending::<()>().await;
    });
}

fn robot(host: &Host) -> ChildGuard {
    let mut command = ignored_test("robot_process");
    command
        .env(DOMAIN, &host.domain)
        .env("HOME", host.path(""))
        .env("FIPA_RUNTIME_DIR", host.path("run"));
    let mut child = ChildGuard::start(command.stdout(Stdio::piped()));
    let mut lines = BufReader::new(child.child().stdout.take().unwrap()).lines();
    // The test harness prints lines of its own.
    let ready = lines.find(|line| line.as_ref().is_ok_and(|line| line.ends_with("ready")));
    assert!(ready.is_some(), "the process has ended before it was ready");
    // A closed pipe would end it.
    std::thread::spawn(move || lines.for_each(drop));
    child
}

/// Runs a command that is patient with a loaded machine.
fn run(host: &Host, arguments: &[&str]) -> Ran {
    host.run(&[&["--set", DEADLINE], arguments].concat())
}

#[test]
fn actions_are_listed_and_performed() {
    let host = Host::new();
    let none = run(&host, &["actions"]).done();
    assert_eq!(none, "no agent of this host offers actions\n");
    let unknown = run(&host, &["actions", "crex"]).failed(1);
    assert!(unknown.contains("crex"), "{unknown}");
    let _robot = robot(&host);
    let listed = run(&host, &["actions", "crex"]).done();
    for part in [
        "crex dock: Docks\n",
        "target=",
        "pose(x: number, y: number)",
        "m/s; 0 to 0.5; default 0.25",
    ] {
        assert!(listed.contains(part), "{part}: {listed}");
    }
    let all = run(&host, &["actions", "--json"]).done_json();
    assert_eq!(all[0]["robot"], "crex");
    let actions = all[0]["actions"].as_array().unwrap();
    let dock = actions.iter().find(|it| it["name"] == "dock").unwrap();
    let speed = &dock["parameters"][1];
    assert_eq!(
        (&speed["unit"], &speed["max"]),
        (&json!("m/s"), &json!(0.5))
    );

    let target = "target=(pose :x 1.5 :y 2)";
    let done = host
        .run(&["do", "crex", "dock", target, "speed=0.1 m/s", "--json"])
        .done();
    let lines: Vec<Value> = done
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(lines[0]["event"], "accepted");
    let last = json!({ "event": "done", "result": "(docked :x 1.5 :speed 0.1)" });
    assert_eq!(lines.last(), Some(&last));
    let fields = host
        .run(&["do", "crex", "dock", "target.x=3", "target.y=2"])
        .done();
    assert!(
        fields.ends_with("(docked :x 3.0 :speed 0.25)\n"),
        "{fields}"
    );

    for (arguments, code, expected) in [
        (
            &["do", "crex", "dock", "target.x=far", "target.y=1"][..],
            1,
            "parameter target.x: expected number",
        ),
        (
            &["do", "crex", "dock", target, "speed=7"],
            1,
            "parameter speed: 7 is not within 0 to 0.5",
        ),
        (
            &["do", "crex", "dock", target, "speed=1 km/h"],
            1,
            "found \"km/h\"",
        ),
        (
            &["do", "crex", "dock"],
            1,
            "the parameter target is missing",
        ),
        (&["do", "crex", "fly"], 1, "unknown action fly"),
        (&["do", "crex", "fail"], 1, "no power"),
        (
            &["do", "crex", "dock", "speed.x=1"],
            2,
            "no field of a structure",
        ),
        (&["do", "crex", "dock", "speed"], 2, "KEY=VALUE"),
        (
            &["do", "crex", "drive", "--deadline", "50ms"],
            1,
            "the deadline passed",
        ),
    ] {
        let failed = run(&host, arguments).failed(code);
        assert!(failed.contains(expected), "{arguments:?}: {failed}");
    }
}

#[test]
fn a_goal_that_the_same_agent_sends_again_does_not_run_again() {
    let host = Host::new();
    let _robot = robot(&host);
    for (agent, id, expected) in [
        ("boss", "g-1", "1\n"),
        ("boss", "g-1", "1\n"),
        ("boss", "g-2", "2\n"),
        ("other", "g-1", "3\n"),
        ("boss", "g-1", "1\n"),
    ] {
        let goal = ["do", "crex", "count", "--agent", agent, "--id", id];
        assert_eq!(run(&host, &goal).done(), expected, "{agent} {id}");
    }
    let alone = run(&host, &["do", "crex", "count", "--id", "g-1"]).failed(2);
    assert!(alone.contains("--agent"), "{alone}");
}

#[test]
fn an_operator_cancels_goals_of_other_clients() {
    let host = Host::new();
    let _robot = robot(&host);
    let drive = ["--set", DEADLINE, "do", "crex", "drive", "--json"];
    let started = || {
        let running = host.start(&drive);
        let accepted: Value = serde_json::from_str(&running.ready).unwrap();
        (running, accepted["goal"].as_str().unwrap().to_owned())
    };
    let asked = |option: &str, name: &str, agent: &str| {
        run(&host, &["actions", "crex", option, name, "--agent", agent])
    };
    let (mut running, id) = started();
    for (option, name) in [
        ("--goal", &*id),
        ("--cancel", &id),
        ("--cancel-all", "drive"),
    ] {
        let refused = asked(option, name, "arm").failed(1);
        for part in ["arm may name its own goals only", "operators = [\"arm\"]"] {
            assert!(refused.contains(part), "{part}: {refused}");
        }
    }
    let shown = asked("--goal", &id, "boss").done();
    for part in [&*id, "executing", "50 % half-way", "(pose :x 0.5 :y 2.0)"] {
        assert!(shown.contains(part), "{part}: {shown}");
    }
    let by_boss = "cancelled by the operator boss";
    let cancelled = [
        "actions", "crex", "--cancel", &id, "--agent", "boss", "--json",
    ];
    let cancelled = run(&host, &cancelled).done_json();
    assert_eq!(cancelled[0]["goals"][0]["goal"], id);
    assert_eq!(cancelled[0]["goals"][0]["failure"], by_boss);
    let (code, errors) = running.end();
    assert_eq!(code, Some(1));
    assert!(errors.contains(by_boss), "{errors}");

    let (mut running, id) = started();
    let cancelled = asked("--cancel-all", "drive", "boss").done();
    assert!(
        cancelled.contains(&id) && cancelled.contains(by_boss),
        "{cancelled}"
    );
    assert_eq!(running.end().0, Some(1));
    let none = asked("--cancel-all", "drive", "boss").done();
    assert_eq!(none, "crex runs no goals of this action\n");
    let unknown = asked("--cancel-all", "fly", "boss").failed(1);
    assert!(unknown.contains("unknown action fly"), "{unknown}");
    let unknown = asked("--cancel", "none", "boss").failed(1);
    assert!(unknown.contains("--goals"), "{unknown}");

    let goal = ["do", "crex", "count", "--agent", "rover", "--id", "g-1"];
    run(&host, &goal).done();
    for agent in ["boss", "rover"] {
        let shown = [
            "actions", "crex", "--goal", "g-1", "--agent", agent, "--json",
        ];
        let shown = run(&host, &shown).done_json();
        let goal = &shown[0]["goals"][0];
        assert_eq!(
            (&goal["state"], &goal["result"]),
            (&json!("done"), &json!("1"))
        );
    }
    let alone = run(&host, &["actions", "--cancel", "g-1"]).failed(2);
    assert!(alone.contains("ROBOT"), "{alone}");
}

#[test]
fn a_signal_cancels_the_goal() {
    let host = Host::new();
    let mut robot = robot(&host);
    let mut running = host.start(&["--set", DEADLINE, "do", "crex", "drive", "--json"]);
    let accepted: Value = serde_json::from_str(&running.ready).unwrap();
    loop {
        let progress: Value = serde_json::from_str(&running.line()).unwrap();
        assert_eq!(progress["event"], "progress");
        if progress["fraction"] == 0.5 {
            assert_eq!(progress["note"], "half-way");
            assert_eq!(progress["value"], "(pose :x 0.5 :y 2.0)");
            break;
        }
    }
    let goals = host
        .run(&["actions", "crex", "--goals", "--json"])
        .done_json();
    assert_eq!(goals[0]["goals"][0]["goal"], accepted["goal"]);
    assert_eq!(goals[0]["goals"][0]["state"], "executing");
    let (code, errors) = running.signal("-INT");
    assert_eq!(code, Some(1));
    assert!(errors.contains("cancelled while it ran"), "{errors}");
    let goals = run(&host, &["actions", "crex", "--goals"]).done();
    assert_eq!(goals, "crex runs no goals\n");

    let mut running = host.start(&["--set", DEADLINE, "do", "crex", "drive", "--json"]);
    let _ = running.line();
    robot.kill();
    let (code, errors) = running.end();
    assert_eq!(code, Some(1));
    assert!(errors.contains("the agent crex is gone"), "{errors}");
}
