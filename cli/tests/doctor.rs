//! `fipa doctor` in processes of its own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stderr, reason = "a skipped test prints a note")]

mod common;

use std::fs::{Permissions, set_permissions};
use std::os::unix::fs::PermissionsExt;
use std::process::Output;

use common::{Host, Running, unshared};
use fipa_testbed::{until, until_some};
use serde_json::Value;

/// The severity and the finding of a check.
fn check<'a>(report: &'a Value, name: &str) -> (&'a str, &'a str) {
    let checks = report["checks"].as_array().unwrap();
    let check = checks.iter().find(|check| check["check"] == name).unwrap();
    (
        check["severity"].as_str().unwrap(),
        check["found"].as_str().unwrap(),
    )
}

/// Starts a gateway of this name with these static peers. Returns it with its TCP address.
fn up(host: &Host, name: &str, peers: &[(&str, &str)]) -> (Running, String) {
    let peers = peers
        .iter()
        .map(|(name, at)| format!("{name} = [\"tcp://{at}\"]"));
    let peers: Vec<String> = peers.collect();
    let peers = format!("discovery.static={{ {} }}", peers.join(", "));
    let name = format!("mts.name={name}");
    let gateway = host.start(&["--set", &name, "--set", &peers, "up", "--json"]);
    let address = gateway.tcp_address();
    (gateway, address)
}

/// The gateways of the agents `arm` of two hosts, which both show the conflict. A third host keeps the
/// agent that it knew first, although the other one was registered before.
#[test]
fn a_name_of_two_hosts_stays_with_the_agent_that_is_known_and_both_doctors_show_it() {
    let [far, near, third] = [Host::new(), Host::new(), Host::new()];
    let _arms = (far.echo("arm"), near.echo("arm"));
    let (_near_gateway, near_at) = up(&near, "near", &[]);
    let (_third_gateway, third_at) = up(&third, "third", &[("near", &near_at)]);
    let known = |name: &str| {
        let known = third.run(&["agents", "--json"]).done_json();
        let mut agents = known["agents"].as_array().unwrap().iter();
        let agent = agents.find(|agent| agent["name"] == name)?;
        Some(agent["mts"]["name"].as_str().unwrap().to_owned())
    };
    until("the arm of the near host", || known("arm").is_some());
    let _crane = far.echo("crane");
    let peers = [("near", &*near_at), ("third", &*third_at)];
    let (_far_gateway, _) = up(&far, "far", &peers);
    until("the agents of the far host", || known("crane").is_some());
    assert_eq!(known("arm").as_deref(), Some("near"));
    for (host, other) in [(&near, "far"), (&far, "near")] {
        until("the doctor shows the conflict", || {
            let report = host.run(&["doctor", "--json"]).done_json();
            let expected = format!("the agent arm is also registered at the gateway {other}:");
            let checks = report["checks"].as_array().unwrap();
            checks.iter().any(|check| {
                let found = check["found"].as_str().unwrap();
                check["severity"] == "warning" && found.starts_with(&expected)
            })
        });
        let own = host.run(&["agents", "arm", "--json"]).done_json();
        assert_eq!(own["agents"][0]["reach"], "local", "{own}");
    }
}

#[test]
fn a_machine_without_problems_is_fine_and_is_not_changed() {
    let host = Host::new();
    let small = [
        "doctor",
        "--json",
        "--set",
        "transport.shm.capacity=2MiB",
        "--set",
        "transport.shm.max_letter=1MiB",
    ];
    let report = host.run(&small).done_json();
    for name in [
        "directory of the domain",
        "size of /dev/shm",
        "leftovers of ended processes",
        "permissions in /dev/shm",
        "memory of waiting letters",
        "stopped processes",
    ] {
        assert_eq!(check(&report, name).0, "fine", "{report}");
    }
    assert!(host.left_behind().is_empty());
    let table = host.run(&["doctor"]).done();
    assert!(table.starts_with("VERDICT"), "{table}");
    assert!(table.contains("limit of open files"), "{table}");
    let none = host
        .run(&["doctor", "--set", "mts.transports=unix,tcp"])
        .done();
    assert!(!none.contains("/dev/shm"), "{none}");
}

#[test]
fn files_of_a_killed_process_are_reported_until_the_next_process_removes_them() {
    let host = Host::new();
    let parrot = host.echo("parrot");
    let running = host.run(&["doctor", "--json"]).done_json();
    assert!(
        check(&running, "leftovers of ended processes")
            .1
            .starts_with("processes that run: 1; ended processes that left files behind: 0;")
    );
    assert_eq!(
        check(&running, "permissions in /dev/shm").0,
        "fine",
        "{running}"
    );
    parrot.signal("-KILL");
    let dead = host.run(&["doctor", "--json"]).done_json();
    let (severity, found) = check(&dead, "leftovers of ended processes");
    assert_eq!(severity, "warning", "{found}");
    assert!(
        found.starts_with("processes that run: 0; ended processes that left files behind: 1;"),
        "{found}"
    );
    host.run(&["agents"]).done();
    let after = host.run(&["doctor", "--json"]).done_json();
    assert_eq!(check(&after, "leftovers of ended processes").0, "fine");
}

#[test]
fn a_stopped_process_is_a_warning_until_it_continues() {
    let host = Host::new();
    let arm = host.echo("arm");
    arm.send_signal("-STOP");
    let pid = arm.pid();
    let report = host.run(&["doctor", "--json"]).done_json();
    let found = format!("the process {pid} of arm is stopped, by SIGSTOP, Ctrl-Z or a debugger");
    assert_eq!(check(&report, "stopped processes"), ("warning", &*found));
    let checks = report["checks"].as_array().unwrap();
    let advice = format!("continue it: `kill -CONT {pid}`");
    assert!(checks.iter().any(|it| it["advice"] == *advice), "{report}");
    arm.send_signal("-CONT");
    let report = host.run(&["doctor", "--json"]).done_json();
    assert_eq!(check(&report, "stopped processes").0, "fine");
}

#[test]
fn the_runtime_directory_that_the_owner_made_stays() {
    let host = Host::new();
    std::fs::create_dir(host.path("run")).unwrap();
    set_permissions(host.path("run"), Permissions::from_mode(0o700)).unwrap();
    host.run(&["agents"]).done();
    assert!(host.path("run").exists());
    assert!(host.left_behind().is_empty());
}

#[test]
fn a_directory_that_others_may_enter_is_bad() {
    let host = Host::new();
    let _parrot = host.echo("parrot");
    let domain = host.path("run").join(&host.domain);
    set_permissions(&domain, Permissions::from_mode(0o755)).unwrap();
    let (report, complaint) = host.run(&["doctor", "--json"]).failed_json();
    assert_eq!(report["severity"], "bad");
    let (severity, found) = check(&report, "directory of the domain");
    assert_eq!(severity, "bad");
    assert!(
        found.contains(&format!("chmod 700 {}", domain.display())),
        "{found}"
    );
    let refused = host.run(&["agents"]).failed(1);
    assert!(refused.contains("RuntimeDirectoryMode=0700"), "{refused}");
    assert!(complaint.contains("directory of the domain"), "{complaint}");
    set_permissions(&domain, Permissions::from_mode(0o700)).unwrap();
}

#[test]
fn without_inotify_letters_are_delivered_and_the_doctor_names_the_sysctl() {
    let host = Host::new();
    let without_inotify = |arguments: &[&str]| {
        let limit = "echo 0 >/proc/sys/user/max_inotify_instances";
        unshared(&host.command(arguments), &[], limit)
    };
    let Some(echo) = without_inotify(&["echo", "parrot"]) else {
        return;
    };
    let parrot = Running::new(echo);
    let letter = ["send", "--to", "parrot", "--content", "hello"];
    let sent = host.run(&letter).done();
    assert!(sent.contains("delivered"), "{sent}");
    let doctor = without_inotify(&["doctor", "--json"]);
    let report = doctor.unwrap().output().unwrap().stdout;
    let report: Value = serde_json::from_slice(&report).unwrap();
    let (severity, found) = check(&report, "inotify instances");
    assert_eq!(severity, "warning", "{found}");
    assert!(found.contains("polls the directory"), "{found}");
    assert!(report.to_string().contains("fs.inotify.max_user_instances"));
    let (code, log) = parrot.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
    let times = log.matches("fs.inotify.max_user_instances").count();
    assert_eq!(times, 1, "{log}");
}

/// Runs a command of a host whose runtime directory is a file system of its own, with these options of mount.
/// `filled` is a line of shell that runs in the directory first.
fn with_file_system(
    host: &Host,
    options: &str,
    filled: &str,
    arguments: &[&str],
) -> Option<Output> {
    let run = host.path("run");
    let _ = std::fs::create_dir(&run);
    let run = run.display();
    let mount = format!(
        "mount -t tmpfs -o mode=700,{options} tmpfs {run} && cd {run} && {{ {filled}; }} 2>/dev/null; cd /"
    );
    let mut command = unshared(&host.command(arguments), &["--mount"], &mount)?;
    Some(command.output().unwrap())
}

#[test]
fn a_runtime_directory_without_room_is_bad_and_agents_name_it_as_the_cause() {
    let host = Host::new();
    let run = host.path("run").display().to_string();
    let fill = "head -c 1M /dev/zero >junk";
    let domain = format!("mkdir -m 700 {}; {fill}", host.domain);
    for (options, filled, cause, remedy) in [
        (
            "size=128k",
            fill,
            "its file system is full: 0 B free of 128.0 KiB",
            "df -h",
        ),
        (
            "size=128k",
            &*domain,
            "its file system is full: 0 B free of 128.0 KiB",
            "df -h",
        ),
        (
            "size=1M,nr_inodes=3",
            "touch a b c",
            "no inodes left: 0 of 3 are free",
            "df -i",
        ),
        (
            "size=128k",
            "mount -o remount,ro .",
            "its file system is read-only",
            "mount it writable",
        ),
    ] {
        let ran = |arguments: &[&str]| {
            let output = with_file_system(&host, options, filled, arguments)?;
            let errors = String::from_utf8(output.stderr).unwrap();
            assert_eq!(output.status.code(), Some(1), "{filled}: {errors}");
            Some((output.stdout, errors))
        };
        let Some((report, _)) = ran(&["doctor", "--json"]) else {
            return;
        };
        let report: Value = serde_json::from_slice(&report).unwrap();
        let (severity, found) = check(&report, "room in the directory of the domain");
        assert_eq!(severity, "bad", "{found}");
        assert!(found.contains(&run) && found.contains(cause), "{found}");
        assert!(report.to_string().contains(remedy), "{report}");
        for command in [&["echo", "parrot"][..], &["up"]] {
            let (_, errors) = ran(command).unwrap();
            for part in [&*run, cause, remedy, "FIPA_RUNTIME_DIR"] {
                assert!(errors.contains(part), "{filled}: {errors}");
            }
            for blamed in ["limit of open files", "fipa agents"] {
                assert!(!errors.contains(blamed), "{filled}: {errors}");
            }
        }
    }
}

#[test]
fn a_runtime_directory_with_room_is_fine_and_stays_as_it_is() {
    let host = Host::new();
    let _parrot = host.echo("parrot");
    let files = || {
        let domain = host.path("run").join(&host.domain);
        let levels = [host.path("run"), domain];
        let mut found = Vec::new();
        for level in levels {
            let entries = std::fs::read_dir(level).unwrap();
            found.extend(entries.map(|entry| entry.unwrap().path()));
        }
        found.sort();
        found
    };
    let before = files();
    let report = host.run(&["doctor", "--json"]).done_json();
    let (severity, found) = check(&report, "room in the directory of the domain");
    assert_eq!(severity, "fine", "{found}");
    assert_eq!(files(), before);
}

/// A gateway that restarts has another incarnation for a moment beside the former one, and no namesake.
#[test]
fn two_gateways_of_one_name_are_shown_on_both_hosts_and_a_restarted_one_is_not() {
    let [near, far, other] = [Host::new(), Host::new(), Host::new()];
    let checks = |host: &Host, name: &str| {
        let report = host.run(&["doctor", "--json"]).done_json();
        let checks = report["checks"].as_array().unwrap().iter();
        let found = checks.filter(|check| check["check"] == name);
        let found: Vec<Value> = found.cloned().collect();
        found
    };
    let (_near_gateway, near_at) = up(&near, "twin", &[]);
    let (_other_gateway, other_at) = up(&other, "other", &[]);
    let (far_gateway, far_at) = up(&far, "twin", &[("near", &near_at), ("other", &other_at)]);
    for (host, own, others) in [(&near, &near_at, &far_at), (&far, &far_at, &near_at)] {
        let found = until_some("the doctor shows the name", || {
            checks(host, "names of gateways").pop()
        });
        assert_eq!(found["severity"], "warning", "{found}");
        let text = found["found"].as_str().unwrap();
        // The far gateway opened the connection, so the near one shows the port of that connection, too.
        let there = others.rsplit_once(':').unwrap().0;
        for part in ["the name of this one, twin", own, there] {
            assert!(text.contains(part), "{text}");
        }
        assert!(
            found["advice"].as_str().unwrap().contains("mts.name"),
            "{found}"
        );
    }
    far_gateway.signal("-KILL");
    let (_far_gateway, _) = up(&far, "twin", &[("other", &other_at)]);
    until("the restarted gateway is connected", || {
        let connections = checks(&other, "connections with other gateways");
        connections
            .iter()
            .any(|it| it["found"].as_str().unwrap().starts_with("twin:"))
    });
    assert_eq!(checks(&other, "names of gateways"), [] as [Value; 0]);
}
