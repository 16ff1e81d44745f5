//! `fipa top` with real processes.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

mod common;

use std::fs;
use std::io::Write as _;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::{Far, Host, Running};
use fipa_testbed::{ChildGuard, until};
use serde_json::Value;

/// Exchanges letters until it is dropped: `rover` sends to `arm_1`.
fn rover(host: &Host) -> ChildGuard {
    let rover = [
        "send",
        "--from",
        "rover",
        "--to",
        "arm_1",
        "--content",
        "x",
        "--rate",
        "50",
    ];
    let rover = ChildGuard::start(host.command(&rover).stdout(Stdio::null()));
    until("the rover is registered", || {
        host.run(&["agents"]).done().contains("rover")
    });
    rover
}

/// Sends one letter to an agent that does not exist.
fn fail(host: &Host) {
    let sent = host.run(&[
        "send",
        "--from",
        "lander",
        "--to",
        "nowhere",
        "--content",
        "x",
    ]);
    assert_eq!(sent.code, Some(1), "{sent:?}");
}

/// The first object with this property.
fn find(top: &mut Running, what: &str, is: impl Fn(&Value) -> bool) -> Value {
    let mut seen = serde_json::from_str(&top.ready).unwrap();
    let watchdog = Instant::now() + Duration::from_secs(60);
    while !is(&seen) {
        assert!(Instant::now() < watchdog, "{what}: {seen:#}");
        seen = serde_json::from_str(&top.line()).unwrap();
    }
    seen
}

fn agent<'a>(seen: &'a Value, name: &str) -> &'a Value {
    let agents = seen["agents"].as_array().unwrap();
    let found = agents.iter().find(|agent| agent["name"] == name);
    found.unwrap_or(&Value::Null)
}

#[test]
fn letters_and_failures_of_agents_are_counted_in_json() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut top = host.start(&["top", "--json", "--every", "500ms"]);
    let rover = rover(&host);
    fail(&host);
    let seen = find(&mut top, "letters and a failure", |seen| {
        let (rover, lander) = (agent(seen, "rover"), agent(seen, "lander"));
        let arm = agent(seen, "arm_1");
        rover["sent"].as_u64() > Some(20)
            && rover["sent_per_second"].as_f64() > Some(1.0)
            && arm["received"].as_u64() > Some(20)
            && arm["received_per_second"].as_f64() > Some(1.0)
            && lander["failures"] == 1
    });
    let (of_rover, arm) = (agent(&seen, "rover"), agent(&seen, "arm_1"));
    for (agent, via) in [(of_rover, "shm"), (arm, "shm")] {
        assert_eq!(agent["via"], via, "{seen:#}");
    }
    let (median, p99) = (of_rover["median_us"].as_u64(), of_rover["p99_us"].as_u64());
    assert!(median > Some(0) && p99 >= median, "{seen:#}");
    assert_eq!((&seen["failures"], &seen["lost"]), (&1.into(), &0.into()));
    assert_eq!(
        (&seen["gateway"], &seen["others"]),
        (&Value::Null, &Value::Null)
    );
    assert_eq!(
        (&seen["agents_elsewhere"], &seen["hosts"]),
        (&0.into(), &Value::Array(Vec::new()))
    );
    // The agent of the command itself is not shown.
    let names = seen["agents"].as_array().unwrap().iter();
    let own = names.filter(|it| it["name"].as_str().unwrap().starts_with("fipa-routes-"));
    assert_eq!(own.count(), 0, "{seen:#}");
    drop(rover);
    let (code, errors) = top.signal("-INT");
    assert_eq!((code, errors.as_str()), (Some(0), ""));
}

#[test]
fn a_message_that_violates_its_protocol_is_counted() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut top = host.start(&["top", "--json", "--every", "500ms"]);
    // The echo agent answers no failure.
    let failure = [
        "send",
        "--from",
        "rover",
        "--to",
        "arm_1",
        "--performative",
        "failure",
        "--protocol",
        "fipa-request",
        "--conversation-id",
        "c1",
        "--content",
        "x",
    ];
    assert_eq!(host.run(&failure).code, Some(0));
    let seen = find(&mut top, "a violation", |seen| {
        agent(seen, "rover")["violations"] == 1
    });
    assert_eq!(seen["violations"], 1, "{seen:#}");
}

#[test]
fn tables_are_printed_without_a_terminal() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let _camera = host.echo("camera");
    let peer = "discovery.static={ crex = [\"tcp://127.0.0.1:9\"] }";
    let _gateway = host.start(&["up", "--set", "mts.name=sherpa", "--set", peer]);
    let _rover = rover(&host);
    let printed = host.run(&[
        "top",
        "rover|arm_.*",
        "--sort",
        "received",
        "--every",
        "3s",
        "--count",
        "1",
    ]);
    let printed = printed.done();
    let head = format!("domain {} on ", host.domain);
    assert!(
        printed.contains(&head) && printed.contains("; gateway sherpa\n"),
        "{printed}"
    );
    let mut lines = printed
        .lines()
        .skip_while(|line| !line.starts_with("AGENT "));
    lines.next().unwrap();
    let names: Vec<&str> = lines
        .by_ref()
        .take_while(|line| !line.is_empty())
        .filter_map(|line| line.split(' ').next())
        .collect();
    assert_eq!(names, ["arm_1", "rover"], "{printed}");
    assert!(lines.next().unwrap().starts_with("HOST "), "{printed}");
    assert!(
        lines.next().unwrap().starts_with("crex  no answer "),
        "{printed}"
    );
}

#[test]
fn hosts_are_connected_with_their_letters_and_then_lost() {
    let (host, other) = (Host::new(), Host::new());
    let (
        _gateway,
        Far {
            crex,
            echo: _far,
            name: far,
        },
    ) = Far::connected(&host, &other);
    let mut top = host.start(&["top", "--json", "--every", "500ms"]);
    // The echo agent answers each request.
    let ask = [
        "send",
        "--from",
        "rover",
        "--to",
        &far,
        "-p",
        "request",
        "--content",
        "x",
        "--rate",
        "20",
    ];
    let _asking = ChildGuard::start(
        host.command(&ask)
            .stdout(Stdio::null())
            .stderr(Stdio::null()),
    );
    let seen = find(&mut top, "letters to and from the host", |seen| {
        let crex = &seen["hosts"][0];
        crex["to_per_second"].as_f64() > Some(0.5) && crex["from_per_second"].as_f64() > Some(0.0)
    });
    let row = &seen["hosts"][0];
    assert_eq!(
        (&row["name"], &row["state"]),
        (&"crex".into(), &"connected".into()),
        "{seen:#}"
    );
    assert_eq!(
        (&row["encrypted"], &row["transports"]),
        (&false.into(), &serde_json::json!(["tcp"]))
    );
    assert!(row["median_us"].as_u64() > Some(0), "{seen:#}");
    assert_eq!(agent(&seen, "rover")["via"], "tcp", "{seen:#}");
    assert_eq!(
        (&seen["gateway"], &seen["problem"]),
        (&"sherpa".into(), &Value::Null)
    );
    crex.signal("-KILL");
    let seen = find(&mut top, "the host is lost", |seen| {
        seen["hosts"][0]["state"] == "lost"
    });
    assert_eq!(seen["hosts"][0]["encrypted"], Value::Null, "{seen:#}");
}

#[test]
fn a_reader_that_ends_ends_the_command() {
    let host = Host::new();
    let mut command = host.command(&["top", "--json", "--every", "100ms"]);
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    until("the command has ended", || {
        child.try_wait().unwrap().is_some()
    });
    assert!(host.left_behind().is_empty(), "{:?}", host.left_behind());
}

#[test]
fn invalid_arguments_are_rejected() {
    let host = Host::new();
    let output = host.run(&["top", "arm_("]).failed(2);
    assert!(output.contains("regular expression"), "{output}");
    let output = host.run(&["top", "--every", "1ms"]).failed(2);
    assert!(output.contains("at least 100ms"), "{output}");
}

/// `fipa top` on a terminal of its own, which `script` of util-linux opens.
struct OnTerminal {
    script: std::process::Child,
    /// The output so far, in this file.
    output: std::path::PathBuf,
    /// The files with the name of the terminal and the process identifier.
    terminal: std::path::PathBuf,
    pid: std::path::PathBuf,
}

impl OnTerminal {
    /// Returns `None` without `script`; panics in that case if `CI=true`.
    fn start(host: &Host, size: &str) -> Option<Self> {
        let [output, terminal, pid] = ["output", "terminal", "pid"].map(|name| host.path(name));
        let top = host.command(&["top", "--every", "200ms"]);
        let line = format!(
            "stty {size}; tty >{}; echo $$ >{}; exec \"$0\" \"$@\"",
            terminal.display(),
            pid.display()
        );
        let quoted = |text: &str| format!("'{}'", text.replace('\'', "'\\''"));
        let words = std::iter::once(top.get_program()).chain(top.get_args());
        let words: Vec<String> = words.map(|word| quoted(word.to_str().unwrap())).collect();
        let line = format!("exec sh -c {} {}", quoted(&line), words.join(" "));
        let mut script = fipa_testbed::on_terminal("a test of the screen", &line)?;
        script.env_clear().current_dir(host.path("."));
        for (name, value) in top.get_envs() {
            script.env(name, value.unwrap());
        }
        script.env("PATH", std::env::var_os("PATH").unwrap());
        script.env("SHELL", "/bin/sh").env("TERM", "xterm");
        script
            .stdin(Stdio::piped())
            .stdout(fs::File::create(&output).unwrap());
        Some(Self {
            script: script.spawn().unwrap(),
            output,
            terminal,
            pid,
        })
    }

    fn output(&self) -> String {
        String::from_utf8_lossy(&fs::read(&self.output).unwrap()).into_owned()
    }

    fn wait_for(&self, text: &str) {
        until(text, || self.output().contains(text));
    }

    fn press(&mut self, keys: &str) {
        let input = self.script.stdin.as_mut().unwrap();
        input.write_all(keys.as_bytes()).unwrap();
        input.flush().unwrap();
    }

    fn pid(&self) -> String {
        let pid = fs::read_to_string(&self.pid).unwrap();
        pid.trim().to_owned()
    }

    /// Waits for the end. Returns its exit code. The terminal must be as before.
    fn end(&mut self) -> Option<i32> {
        let script = &mut self.script;
        until("the command has ended", || {
            script.try_wait().unwrap().is_some()
        });
        let output = self.output();
        let (_, last) = output.rsplit_once("\u{1b}[?1049h").unwrap();
        assert!(
            last.contains("\u{1b}[?1049l"),
            "the first screen is back: {last:?}"
        );
        assert!(
            last.contains("\u{1b}[?25h"),
            "the cursor is visible: {last:?}"
        );
        self.script.wait().unwrap().code()
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        let _ = self.script.kill();
        let _ = self.script.wait();
    }
}

#[test]
fn keys_and_signals_end_the_command_and_restore_the_terminal() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    for key in ["q", "\u{3}"] {
        let Some(mut top) = OnTerminal::start(&host, "rows 24 cols 80") else {
            return;
        };
        top.wait_for("arm_1");
        top.press(key);
        assert_eq!(top.end(), Some(0), "{key:?}");
    }
    for signal in ["-TERM", "-INT"] {
        let Some(mut top) = OnTerminal::start(&host, "rows 24 cols 80") else {
            return;
        };
        top.wait_for("arm_1");
        let sent = Command::new("kill").args([signal, &top.pid()]).status();
        assert!(sent.unwrap().success());
        assert_eq!(top.end(), Some(0), "{signal}");
    }
}

#[test]
fn keys_change_the_screen_and_a_resized_terminal_is_drawn_again() {
    let host = Host::new();
    let _agents = [host.echo("arm_1"), host.echo("camera")];
    let Some(mut top) = OnTerminal::start(&host, "rows 24 cols 40") else {
        return;
    };
    top.wait_for("camera");
    top.press("?");
    top.wait_for("quit");
    top.press("x/arm_.*\r");
    top.wait_for("matching");
    // At 40 columns there is no transport.
    assert!(!top.output().contains("P99 VIA"), "{:?}", top.output());
    let terminal = fs::read_to_string(&top.terminal).unwrap();
    let resized = Command::new("stty")
        .args(["-F", terminal.trim(), "rows", "30", "cols", "100"])
        .status();
    assert!(resized.unwrap().success());
    top.wait_for("P99 VIA");
    top.press("q");
    assert_eq!(top.end(), Some(0));
}

#[test]
fn a_closed_terminal_ends_the_command() {
    let host = Host::new();
    let Some(mut top) = OnTerminal::start(&host, "rows 24 cols 80") else {
        return;
    };
    top.wait_for("no agents");
    let process = format!("/proc/{}", top.pid());
    top.script.kill().unwrap();
    until("the command has ended", || {
        !std::path::Path::new(&process).exists()
    });
    assert!(host.left_behind().is_empty(), "{:?}", host.left_behind());
}
