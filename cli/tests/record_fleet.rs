//! `fipa record fleet` and `fipa record merge` with the gateways of two hosts.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{Host, Ran, Running};
use fipa_testbed::languages::mcap_python;
use fipa_testbed::until;
use serde_json::{Value, json};

/// A host with a gateway that records.
struct Robot {
    host: Host,
    gateway: Running,
    name: String,
}

impl Robot {
    /// Starts a gateway that listens on this address, with these further settings.
    fn new(listen: &str, settings: &[String]) -> Self {
        let host = Host::new();
        let name = format!("mts-{}", host.domain);
        let directory = host.path("recordings");
        let mut arguments = vec!["up".to_owned(), "--json".to_owned()];
        let own = [
            format!("mts.name={name}"),
            format!("transport.tcp.listen={listen}"),
            format!("record.directory={}", text(&directory)),
            "access.recorders=[\"station\", \"station_.*\"]".to_owned(),
        ];
        for setting in own.iter().chain(settings) {
            arguments.extend(["--set".to_owned(), setting.clone()]);
        }
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        Self {
            gateway: host.start(&arguments),
            name,
            host,
        }
    }

    /// The setting by which another gateway connects to this one.
    fn as_peer(&self) -> String {
        let address = self.gateway.tcp_address();
        format!(
            "discovery.static={{ {} = [\"tcp://{address}\"] }}",
            self.name
        )
    }

    fn recording(&self, name: &str) -> PathBuf {
        self.host.path("recordings").join(format!("{name}.mcap"))
    }

    /// Runs `fipa record fleet` as the agent that may record.
    fn fleet(&self, words: &[&str]) -> Ran {
        let fleet = ["record", "fleet"];
        self.host
            .run(&[&fleet, words, &["--from", "station"]].concat())
    }

    fn fleet_json(&self, words: &[&str]) -> Value {
        self.fleet(&[words, &["--json"]].concat()).done_json()
    }
}

/// Starts two hosts that know each other.
fn two(listen: &str) -> (Robot, Robot) {
    let here = Robot::new(listen, &[]);
    let there = Robot::new(listen, &[here.as_peer()]);
    until("both hosts have a recorder", || {
        let listed = here.fleet(&["list", "--host", &here.name, "--host", &there.name]);
        listed.code == Some(0)
    });
    (here, there)
}

/// Asks as other agents until there is an answer: the answer to an agent that has just registered can be lost.
fn answered<T>(ask: impl Fn(&str) -> Option<T>) -> T {
    let mut number = 0;
    fipa_testbed::until_some("there is an answer", || {
        number += 1;
        ask(&format!("station_{number}"))
    })
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn letters(host: &Host, file: &Path, options: &[&str]) -> Vec<Value> {
    let ran = host.run(&[&["record", "to-json", text(file)], options].concat());
    let lines = ran.done();
    let all = lines
        .lines()
        .map(|line| serde_json::from_str(line).unwrap());
    all.filter(|it: &Value| it["message"]["event"] == "letter")
        .collect()
}

/// A recording that nothing has written: the fetch does not read it.
fn plant(robot: &Robot, name: &str, bytes: &[u8]) {
    fs::write(robot.recording(name), bytes).unwrap();
}

fn random(len: usize) -> Vec<u8> {
    let mut random = fastrand::Rng::with_seed(175);
    std::iter::repeat_with(|| random.u8(..)).take(len).collect()
}

/// Records letters between two hosts, fetches both files and merges them.
fn recorded_and_merged(test: &str, listen: &str) {
    let (here, there) = two(listen);
    let _echo = there.host.echo("arm");
    until("the agent is known", || {
        let sent = here
            .host
            .run(&["send", "--to", "arm", "--content", "hello"]);
        sent.code == Some(0)
    });
    let started = here.fleet_json(&["start", "run1"]);
    for row in started.as_array().unwrap() {
        assert_eq!(row["state"], "recording", "{started}");
    }
    let rover = answered(|asker| {
        let words = ["request", "arm", "lift", "--timeout", "5s", "--from", asker];
        let answer = here.host.run(&words);
        (answer.code == Some(0)).then(|| asker.to_owned())
    });
    let unfinished = here.fleet(&["fetch", "run1", "-o", text(&here.host.path("got"))]);
    assert!(
        unfinished.stderr.contains("stop it first"),
        "{unfinished:?}"
    );
    let stopped = here.fleet_json(&["stop", "run1"]);
    for row in stopped.as_array().unwrap() {
        assert_eq!(row["state"], "finished", "{stopped}");
    }
    let got = here.host.path("got");
    let fetched = here.fleet_json(&["fetch", "run1", "-o", text(&got)]);
    // The next fetch compares the files only.
    assert_eq!(
        here.fleet_json(&["fetch", "run1", "-o", text(&got)]),
        fetched
    );
    let files = [&here, &there].map(|it| got.join(format!("run1.{}.mcap", it.name)));
    for (robot, file) in [&here, &there].into_iter().zip(&files) {
        assert_eq!(
            fs::read(file).unwrap(),
            fs::read(robot.recording("run1")).unwrap()
        );
    }
    // The clock is the same one.
    let info = ["record", "info", text(&files[1]), "--json"];
    let info = here.host.run(&info).done_json();
    for record in ["fipa.clock.start", "fipa.clock.stop"] {
        let clock = &info[0]["metadata"][record];
        assert_eq!(
            (&clock["host"], &clock["reference"]),
            (&json!(there.name), &json!(here.name))
        );
        let number = |key: &str| clock[key].as_str().unwrap().parse::<i64>().unwrap();
        assert!(
            number("offset_ns").abs() <= number("uncertainty_ns"),
            "{clock}"
        );
    }
    let merged = here.host.path("all.mcap");
    let both = [text(&files[0]), text(&files[1])];
    let merge = [&["record", "merge"], &both[..], &["-o", text(&merged)]].concat();
    let said = here.host.run(&merge).done();
    assert!(said.contains("of 2 files"), "{said}");
    // Each letter between the hosts is in both files and once in the merged one.
    let of_request = |file: &Path| {
        let all = letters(
            &here.host,
            file,
            &["--protocol", "fipa-request", "--agent", &rover],
        );
        let key = |it: &Value| it["message"]["letter_id"].as_str().unwrap().to_owned();
        all.iter().map(key).collect::<Vec<_>>()
    };
    let [first, second, once] = [&files[0], &files[1], &merged].map(|it| of_request(it));
    assert_eq!(first.len(), 2, "{first:?}");
    assert_eq!((&second, &once), (&first, &first));
    let checked = here
        .host
        .run(&["replay", text(&merged), "--check", "--json"]);
    let summary: Value = serde_json::from_str(&checked.done()).unwrap();
    assert_eq!(
        (&summary["violations"], &summary["complete"]),
        (&json!(0), &json!(true))
    );
    assert!(summary["accepted"].as_u64().unwrap() >= 2, "{summary}");
    if let Some(python) = mcap_python(test) {
        let program = "
import sys
from mcap.reader import make_reader
with open(sys.argv[1], 'rb') as file:
    hosts = set()
    for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
        hosts.add(channel.metadata['host'])
print(' '.join(sorted(hosts)))
";
        let ran = Command::new(python)
            .args(["-c", program])
            .arg(&merged)
            .output();
        let ran = ran.unwrap();
        assert!(
            ran.status.success(),
            "{}",
            String::from_utf8_lossy(&ran.stderr)
        );
        let mut hosts = [here.name.as_str(), &there.name];
        hosts.sort_unstable();
        assert_eq!(String::from_utf8_lossy(&ran.stdout).trim(), hosts.join(" "));
    }
}

#[test]
fn two_hosts_are_recorded_and_merged() {
    recorded_and_merged("two_hosts_are_recorded_and_merged", "127.0.0.1:0");
}

#[test]
fn two_hosts_are_recorded_and_merged_over_ipv6() {
    recorded_and_merged("two_hosts_are_recorded_and_merged_over_ipv6", "[::1]:0");
}

#[test]
fn agents_without_the_right_and_hostile_names_are_refused() {
    let (here, there) = two("127.0.0.1:0");
    for command in ["start run1", "stop run1", "list", "fetch run1"] {
        let words: Vec<&str> = command.split(' ').collect();
        let fleet = ["record", "fleet"];
        let host = ["--host", &there.name, "--from", "stranger", "--json"];
        let ran = here.host.run(&[&fleet, &words[..], &host].concat());
        let (rows, errors) = ran.failed_json();
        let why = "stranger may not record on this host: access.recorders does not name it";
        assert_eq!(rows[0]["error"], why, "{command}");
        assert!(errors.contains(why), "{errors}");
    }
    let wrong = here.fleet(&["start", "../x"]).failed(2);
    assert!(wrong.contains("letters, digits"), "{wrong}");
    plant(&there, "secret", b"x");
    let outside = there.host.path("outside");
    fs::write(&outside, "x").unwrap();
    std::os::unix::fs::symlink(&outside, there.recording("link")).unwrap();
    let options = json!({ "seconds": 5, "content": null, "agents": [], "protocols": [] });
    let start =
        |name: &str| json!({ "order": "start", "name": name, "options": options, "clock": null });
    let mut with_argument = start("x");
    with_argument["options"]["agents"] = json!(["a("]);
    for (order, why) in [
        (start("../x"), "the name of a recording"),
        (start("/tmp/x"), "the name of a recording"),
        (start("secret"), "use another name"),
        (start("link"), "use another name"),
        (with_argument, "did not begin"),
        (
            json!({ "order": "digest", "name": "../outside" }),
            "the name of a recording",
        ),
        (
            json!({ "order": "read", "name": "link", "offset": 0, "length": 9 }),
            "cannot be used",
        ),
        (
            json!({ "order": "read", "name": "none", "offset": 0, "length": 9 }),
            "no recording none",
        ),
        (json!({ "order": "delete", "name": "secret" }), "malformed"),
        (json!("x".repeat(20_000)), "too many"),
    ] {
        let recorder = format!("recorder@{}", there.name);
        let order = order.to_string();
        let ran = answered(|asker| {
            let words = [
                "request",
                &recorder,
                &order,
                "--timeout",
                "5s",
                "--from",
                asker,
            ];
            let ran = here.host.run(&words);
            (!ran.stderr.contains("no answer arrived in time")).then_some(ran)
        });
        assert_eq!(ran.code, Some(1), "{order}: {ran:?}");
        assert!(ran.stderr.contains(why), "{order}: {ran:?}");
    }
    let listed = here.fleet_json(&["list", "--host", &there.name]);
    let names: Vec<&Value> = listed
        .as_array()
        .unwrap()
        .iter()
        .map(|it| &it["recording"])
        .collect();
    assert_eq!(names, ["secret"]);
    assert!(!there.host.path("x.mcap").exists());
}

#[test]
fn a_fetch_continues_after_its_process_was_killed() {
    let (here, there) = two("127.0.0.1:0");
    let bytes = random(24 << 20);
    plant(&there, "big", &bytes);
    let words = [
        "record",
        "fleet",
        "fetch",
        "big",
        "--from",
        "station",
        "--host",
        &there.name,
    ];
    let file = here.host.path(&format!("big.{}.mcap", there.name));
    let part = here.host.path(&format!("big.{}.mcap.part", there.name));
    let fetched = || fs::metadata(&part).map_or(0, |it| it.len());
    let mut command = here.host.command(&words);
    command.stdout(std::process::Stdio::null());
    until("a fetch is killed before its end", || {
        let _ = fs::remove_file(&file);
        let mut killed = fipa_testbed::ChildGuard::start(&mut command);
        until("a part is fetched", || fetched() > 1 << 20 || file.exists());
        killed.kill();
        !file.exists()
    });
    assert!(fetched() < bytes.len() as u64);
    // A part that differs is found, and is fetched no second time: the fetch continues behind it.
    let first = File::options().write(true).open(&part).unwrap();
    std::os::unix::fs::FileExt::write_all_at(&first, &[!bytes[0]], 0).unwrap();
    let differs = here.host.run(&words);
    assert_eq!(differs.code, Some(1), "{differs:?}");
    assert!(differs.stderr.contains("the copy differed"), "{differs:?}");
    assert!(!part.exists() && !file.exists());
    fs::write(&part, &bytes[..5 << 20]).unwrap();
    assert_eq!(here.host.run(&words).code, Some(0));
    assert!(fs::read(&file).unwrap() == bytes && !part.exists());
    // Another file with the name is kept.
    fs::write(&file, "mine").unwrap();
    let exists = here.host.run(&words);
    assert!(exists.stderr.contains("exists and differs"), "{exists:?}");
    assert_eq!(fs::read(&file).unwrap(), b"mine");
}

#[test]
fn a_host_that_disappears_is_reported_and_the_others_complete() {
    let (here, there) = two("127.0.0.1:0");
    let bytes = random(1 << 20);
    plant(&here, "run1", &bytes);
    File::create(there.recording("run1"))
        .unwrap()
        .set_len(1 << 30)
        .unwrap();
    let words = [
        "record", "fleet", "fetch", "run1", "--from", "station", "--json",
    ];
    let part = here.host.path(&format!("run1.{}.mcap.part", there.name));
    let name = there.name.clone();
    let fetching = std::thread::scope(|scope| {
        let fetching = scope.spawn(|| here.host.run(&words));
        until("a part is fetched", || {
            fs::metadata(&part).is_ok_and(|it| it.len() > 1 << 19)
        });
        let mut gateway = there.gateway;
        gateway.send_signal("-KILL");
        gateway.end();
        fetching.join().unwrap()
    });
    let (rows, errors) = fetching.failed_json();
    let row = |host: &str| {
        let mut rows = rows.as_array().unwrap().iter();
        rows.find(|it| it["host"] == host).unwrap().clone()
    };
    assert!(row(&name)["error"].is_string(), "{rows}");
    assert!(errors.contains(&name), "{errors}");
    let file = row(&here.name)["file"].as_str().unwrap().to_owned();
    assert!(fs::read(here.host.path(&file)).unwrap() == bytes);
    assert!(part.exists());
}

#[test]
fn a_recording_is_closed_when_its_gateway_ends_or_is_killed() {
    for signal in ["-INT", "-KILL"] {
        let mut robot = Robot::new("127.0.0.1:0", &[]);
        robot
            .fleet(&["start", "run1", "--content", "none", "--for", "10m"])
            .done();
        let exists = robot.fleet(&["start", "run1"]);
        assert!(exists.stderr.contains("use another name"), "{exists:?}");
        robot.gateway.send_signal(signal);
        let _ = robot.gateway.end();
        let file = robot.recording("run1");
        until("the recording is closed", || {
            let info = robot.host.run(&["record", "info", text(&file), "--json"]);
            let info: Value = serde_json::from_slice(&info.stdout).unwrap();
            info[0]["closed"] == true
        });
    }
}

#[test]
fn the_oldest_recordings_make_room() {
    let robot = Robot::new("127.0.0.1:0", &["record.bytes=1MiB".to_owned()]);
    for name in ["old", "new"] {
        plant(&robot, name, &random(700 << 10));
        // The times of the files differ.
        let hour = std::time::Duration::from_secs(3600);
        if name == "old" {
            let file = File::options()
                .write(true)
                .open(robot.recording(name))
                .unwrap();
            file.set_modified(std::time::SystemTime::now() - hour)
                .unwrap();
        }
    }
    robot.fleet(&["start", "run1", "--for", "1s"]).done();
    assert!(!robot.recording("old").exists() && robot.recording("new").exists());
    // A recording ends by itself after its time.
    until("the recording has ended", || {
        let listed = robot.fleet_json(&["list"]);
        let rows = listed.as_array().unwrap();
        rows.iter()
            .any(|it| it["recording"] == "run1" && it["state"] == "finished")
    });
}
