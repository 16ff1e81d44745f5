//! `fipa config show` and `fipa config check`, as a shell runs them.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on ends")]

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::{Value, json};
use tempfile::TempDir;

/// A place with a home and a working directory of its own, and nothing from the outside.
struct Place(TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        fs::create_dir_all(place.path("home/.config/fipa")).unwrap();
        fs::create_dir(place.path("work")).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, text: &str) -> &Self {
        fs::write(self.path(name), text).unwrap();
        self
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fipa"));
        command
            .args(arguments)
            .current_dir(self.path("work"))
            .env_clear()
            .env("HOME", self.path("home"));
        command
    }

    fn run(&self, arguments: &[&str]) -> Ran {
        Ran::from(self.command(arguments).output().unwrap())
    }
}

#[derive(Debug, PartialEq)]
struct Ran {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

impl From<Output> for Ran {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code(),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }
}

impl Ran {
    fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap()
    }
}

fn ran(code: i32, stdout: &str, stderr: &str) -> Ran {
    Ran {
        code: Some(code),
        stdout: stdout.to_owned(),
        stderr: stderr.to_owned(),
    }
}

#[test]
fn show_prints_a_file_that_says_the_same() {
    let place = Place::new();
    place.write(
        "work/fipa.toml",
        "domain = \"lab\"\n[mts]\nname = \"sherpa\"\n[routes]\n\"arm_.*\" = [\"tcp\"]\n",
    );
    let shown = place.run(&["config", "show", "--set", "mts.deadline=9s"]);
    let expected = "\
domain = \"lab\"                       # fipa.toml:1

[mts]
name = \"sherpa\"                      # fipa.toml:3
transports = [\"shm\", \"unix\", \"tcp\"]  # default
deadline = \"9s\"                      # --set
queue = 256                          # default
queue_bytes = \"64MiB\"                # default

[transport.shm]
capacity = \"256MiB\"                  # default
max_letter = \"64MiB\"                 # default
spin = \"50us\"                        # default

[transport.tcp]
listen = [\"127.0.0.1:0\"]             # default
processes = false                    # default

[transport.udp]
listen = [\"127.0.0.1:0\"]             # default

[transport.quic]
listen = [\"127.0.0.1:0\"]             # default

[discovery]
mdns = true                          # default
interfaces = []                      # default

[security]
keys = \"\"                            # default
insecure = false                     # default
loopback = false                     # default
old_peers = []                       # default
peer_connections = 64                # default
peer_letters = 20000                 # default
peer_bytes = \"256MiB\"                # default

[access]
rate = 0                             # default

[monitor]
check = \"off\"                        # default
answer = false                       # default
protocols = []                       # default

[routes]
\"arm_.*\" = [\"tcp\"]                   # fipa.toml:5
";
    assert_eq!(shown, ran(0, expected, ""));

    place.write("work/shown.toml", expected);
    let again = place.run(&["--config", "shown.toml", "config", "show"]);
    let without_origins = |text: &str| -> Vec<String> {
        let lines = text
            .lines()
            .map(|line| line.split(" #").next().unwrap_or_default());
        lines.map(|line| line.trim().to_owned()).collect()
    };
    assert_eq!(without_origins(&again.stdout), without_origins(expected));
}

#[test]
fn show_as_json_tells_the_origin_of_every_value() {
    let place = Place::new();
    place.write("work/fipa.toml", "mts.name = \"sherpa\"\nmts.queue = 8\n");
    let shown = place.run(&["config", "show", "--json", "--set", "discovery.mdns=false"]);
    assert_eq!((shown.code, shown.stderr.as_str()), (Some(0), ""));
    let shown = shown.json();
    assert_eq!(shown["file"], "fipa.toml");
    let settings = shown["settings"].as_array().unwrap();
    for expected in [
        json!({ "path": ["domain"], "value": "default", "origin": { "from": "default" } }),
        json!({ "path": ["mts", "queue"], "value": 8,
                "origin": { "from": "file", "path": "fipa.toml", "line": 2 } }),
        json!({ "path": ["discovery", "mdns"], "value": false,
                "origin": { "from": "set", "assignment": "discovery.mdns=false" } }),
        json!({ "path": ["mts", "transports"], "value": ["shm", "unix", "tcp"],
                "origin": { "from": "default" } }),
    ] {
        assert!(settings.contains(&expected), "{expected} in {settings:#?}");
    }
    assert_eq!(
        Place::new().run(&["config", "show", "--json"]).json()["file"],
        Value::Null
    );
}

#[test]
fn options_before_and_behind_the_command_add_up() {
    let place = Place::new();
    let before = ["--set", "mts.queue=7", "--set", "domain=a"];
    let behind = [
        "config",
        "--set",
        "mts.name=m",
        "show",
        "--json",
        "--set",
        "domain=b",
    ];
    let shown = place.run(&[&before[..], &behind].concat()).json();
    for (path, value) in [
        (json!(["mts", "queue"]), json!(7)),
        (json!(["mts", "name"]), json!("m")),
        (json!(["domain"]), json!("b")),
    ] {
        let mut settings = shown["settings"].as_array().unwrap().iter();
        let setting = settings.find(|setting| setting["path"] == path).unwrap();
        assert_eq!(setting["value"], value, "{path}");
    }
}

#[test]
fn check_has_nothing_to_say_about_a_good_file() {
    let place = Place::new();
    let nothing = place.run(&["config", "check"]);
    assert_eq!(nothing, ran(0, "no mistakes: no file, only defaults\n", ""));
    place.write("work/fipa.toml", "domain = \"lab\"\n");
    assert_eq!(
        place.run(&["config", "check"]),
        ran(0, "no mistakes: fipa.toml\n", "")
    );
    let as_json = place.run(&["config", "check", "--json"]);
    assert_eq!(
        (as_json.code, as_json.json()),
        (Some(0), json!({ "ok": true, "mistakes": [] }))
    );
}

#[test]
fn mistakes_are_told_with_place_and_advice() {
    let place = Place::new();
    place.write("work/fipa.toml", "[mts]\ndeadlin = \"5s\"\nqueue = \"x\"\n");
    let told = "\
error: unknown key `mts.deadlin`
where: fipa.toml:2
   do: did you mean `mts.deadline`? (known in [mts]: name, transports, deadline, queue, queue_bytes)
error: `mts.queue` is invalid: \"x\": a string is not allowed here
where: fipa.toml:3
   do: expected a number of letters such as 256
";
    for action in ["show", "check"] {
        assert_eq!(place.run(&["config", action]), ran(2, "", told));
    }
    let as_json = place.run(&["config", "check", "--json"]);
    assert_eq!((as_json.code, as_json.stderr.as_str()), (Some(2), ""));
    assert_eq!(
        as_json.json(),
        json!({ "ok": false, "mistakes": [
            { "what": "unknown key `mts.deadlin`",
              "help": "did you mean `mts.deadline`? \
                       (known in [mts]: name, transports, deadline, queue, queue_bytes)",
              "place": { "from": "file", "path": "fipa.toml", "line": 2 } },
            { "what": "`mts.queue` is invalid: \"x\": a string is not allowed here",
              "help": "expected a number of letters such as 256",
              "place": { "from": "file", "path": "fipa.toml", "line": 3 } },
        ] })
    );
    let set = place.run(&[
        "config",
        "check",
        "--config",
        "/dev/null",
        "--set",
        "mts.queue=0",
    ]);
    let told = "\
error: `mts.queue` cannot be 0
where: --set mts.queue=0
   do: use 1 to 65536 letters
";
    assert_eq!(set, ran(2, "", told));
}

#[test]
fn a_missing_file_is_told() {
    let place = Place::new();
    let told = "\
error: cannot read the configuration none.toml (named by --config): \
No such file or directory (os error 2)
   do: name another file with --config or $FIPA_CONFIG, or leave both out
";
    assert_eq!(
        place.run(&["config", "show", "--config", "none.toml"]),
        ran(2, "", told)
    );
    let json = place.run(&["config", "check", "--json", "--config", "none.toml"]);
    assert_eq!(json, ran(2, "", told));
    let mut by_variable = place.command(&["config", "check"]);
    let by_variable = Ran::from(
        by_variable
            .env("FIPA_CONFIG", "none.toml")
            .output()
            .unwrap(),
    );
    assert_eq!(
        by_variable,
        ran(2, "", &told.replace("--config):", "$FIPA_CONFIG):"))
    );
}

#[test]
fn the_first_file_counts() {
    let place = Place::new();
    let checked = |arguments: &[&str], variable: Option<&Path>| {
        let mut command = place.command(&["config", "check"]);
        command
            .args(arguments)
            .envs(variable.map(|file| ("FIPA_CONFIG", file)));
        let checked = Ran::from(command.output().unwrap());
        assert_eq!((checked.code, checked.stderr.as_str()), (Some(0), ""));
        checked
            .stdout
            .trim_start_matches("no mistakes: ")
            .trim_end()
            .to_owned()
    };
    let of_user = place.path("home/.config/fipa/fipa.toml");
    place.write("home/.config/fipa/fipa.toml", "");
    assert_eq!(checked(&[], None), of_user.display().to_string());
    place.write("work/fipa.toml", "");
    assert_eq!(checked(&[], None), "fipa.toml");
    place.write("variable.toml", "").write("asked.toml", "");
    let variable = place.path("variable.toml");
    assert_eq!(
        checked(&[], Some(&variable)),
        variable.display().to_string()
    );
    assert_eq!(
        checked(&["--config", "../asked.toml"], Some(&variable)),
        "../asked.toml"
    );
}

#[test]
fn wrong_usage_is_told_apart() {
    let place = Place::new();
    for arguments in [
        &[][..],
        &["config"],
        &["nonsense"],
        &["config", "show", "--nonsense"],
        &["config", "show", "-v", "-q"],
    ] {
        let ran = place.run(arguments);
        assert_eq!(
            (ran.code, ran.stdout.as_str()),
            (Some(2), ""),
            "{arguments:?}"
        );
        assert!(
            ran.stderr.contains("Usage: fipa"),
            "{arguments:?}: {}",
            ran.stderr
        );
    }
}

#[test]
fn every_command_has_help_with_examples() {
    let place = Place::new();
    let help = place.run(&["--help"]);
    assert_eq!((help.code, help.stderr.as_str()), (Some(0), ""));
    assert!(help.stdout.contains("Exit codes:"), "{}", help.stdout);
    for (command, first_line) in [
        (
            &["config"][..],
            "Show the configuration that counts, or check it for mistakes",
        ),
        (
            &["config", "show"],
            "Print the configuration that counts, with the origin of every value",
        ),
        (
            &["config", "check"],
            "Say whether the configuration has mistakes, and where",
        ),
        (
            &["up"],
            "Run the gateway, which connects the agents of this host with those of other hosts",
        ),
        (&["agents"], "Show who is there, and where"),
        (&["send"], "Send one message, and say what became of it"),
        (
            &["echo"],
            "Run an agent that answers every message with an inform of the same content",
        ),
        (&["decode"], "Print a recorded message or letter as JSON"),
        (&["demo"], "Show what this is about"),
    ] {
        let help = place.run(&[command, &["--help"]].concat());
        assert_eq!((help.code, help.stderr.as_str()), (Some(0), ""));
        assert!(help.stdout.starts_with(first_line), "{}", help.stdout);
        let example = format!("Examples:\n  fipa {}", command[0]);
        assert!(help.stdout.contains(&example), "{}", help.stdout);
    }
}

#[test]
fn a_log_filter_that_is_not_understood_stops_nothing() {
    let place = Place::new();
    let mut command = place.command(&["config", "check"]);
    let ran = Ran::from(command.env("RUST_LOG", "fipa=loudly").output().unwrap());
    assert_eq!(ran.code, Some(0));
    assert!(
        ran.stderr
            .starts_with("warning: $RUST_LOG is not understood ("),
        "{}",
        ran.stderr
    );
}

#[test]
fn output_that_cannot_be_written_is_a_failure() {
    let place = Place::new();
    let mut command = place.command(&["config", "show"]);
    command.stdout(File::options().write(true).open("/dev/full").unwrap());
    let told = "\
error: cannot write the output: No space left on device (os error 28)
where: standard output
   do: see whether the disk is full, or print to somewhere else
";
    assert_eq!(Ran::from(command.output().unwrap()), ran(1, "", told));
}

#[test]
fn a_reader_that_has_seen_enough_is_no_failure() {
    let place = Place::new();
    let (reader, writer) = io::pipe().unwrap();
    drop(reader);
    let mut command = place.command(&["config", "show"]);
    command.stdout(writer);
    assert_eq!(Ran::from(command.output().unwrap()), ran(0, "", ""));
}
