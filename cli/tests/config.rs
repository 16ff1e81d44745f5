//! `fipa config show` and `fipa config check` in processes of their own.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::{Value, json};
use tempfile::TempDir;

/// A home directory, a working directory and a clean environment.
struct Environment(TempDir);

impl Environment {
    fn new() -> Self {
        let env = Self(tempfile::tempdir().unwrap());
        fs::create_dir_all(env.path("home/.config/fipa")).unwrap();
        fs::create_dir(env.path("work")).unwrap();
        env
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
fn show_prints_an_equivalent_configuration_file() {
    let env = Environment::new();
    env.write(
        "work/fipa.toml",
        "domain = \"lab\"\n[mts]\nname = \"sherpa\"\n[routes]\n\"arm_.*\" = [\"tcp\"]\n",
    );
    let shown = env.run(&["config", "show", "--set", "mts.deadline=9s"]);
    let expected = "\
domain = \"lab\"                       # fipa.toml:1
runtime_dir = \"\"                     # default
group = \"\"                           # default

[mts]
name = \"sherpa\"                      # fipa.toml:3
transports = [\"shm\", \"unix\", \"tcp\"]  # default
deadline = \"9s\"                      # --set
queue = 256                          # default
queue_bytes = \"64MiB\"                # default
raise_open_files = false             # default

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

[transport.http]
listen = [\"127.0.0.1:7778\"]          # default

[transport.https]
listen = [\"127.0.0.1:0\"]             # default
authorities = \"\"                     # default

[transport.udt]
listen = [\"127.0.0.1:0\"]             # default

[discovery]
mdns = true                          # default
interfaces = []                      # default

[security]
keys = \"\"                            # default
insecure = false                     # default
loopback = false                     # default
legacy_peers = []                    # default
key_log = false                      # default
peer_connections = 64                # default
peer_letters = 20000                 # default
peer_bytes = \"256MiB\"                # default

[http]
listen = \"\"                          # default
names = []                           # default
token_file = \"\"                      # default
control = false                      # default

[contacts]
networks = []                        # default

[access]
rate = 0                             # default
operators = []                       # default
recorders = []                       # default

[monitor]
check = \"off\"                        # default
answer = false                       # default
heartbeat = \"5s\"                     # default
protocols = []                       # default
idle = \"1day\"                        # default
conversations = 100000               # default
bytes = \"64MiB\"                      # default
exempt = []                          # default

[platform]
ams = true                           # default
df = true                            # default

[record]
directory = \"\"                       # default
bytes = \"1GiB\"                       # default

[routes]
\"arm_.*\" = [\"tcp\"]                   # fipa.toml:5

[discovery.static]                   # default

[access.allow]                       # default

[access.deny]                        # default
";
    assert_eq!(shown, ran(0, expected, ""));

    env.write("work/shown.toml", expected);
    let again = env.run(&["--config", "shown.toml", "config", "show"]);
    let without_origins = |text: &str| -> Vec<String> {
        let lines = text
            .lines()
            .map(|line| line.split(" #").next().unwrap_or_default());
        lines.map(|line| line.trim().to_owned()).collect()
    };
    assert_eq!(without_origins(&again.stdout), without_origins(expected));
}

#[test]
fn show_as_json_has_the_origin_of_every_value() {
    let env = Environment::new();
    env.write("work/fipa.toml", "mts.name = \"sherpa\"\nmts.queue = 8\n");
    let shown = env.run(&["config", "show", "--json", "--set", "discovery.mdns=false"]);
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
        Environment::new().run(&["config", "show", "--json"]).json()["file"],
        Value::Null
    );
}

#[test]
fn global_options_before_and_after_the_command_are_merged() {
    let env = Environment::new();
    let before = ["--set", "mts.queue=7", "--set", "domain=a"];
    let after = [
        "config",
        "--set",
        "mts.name=m",
        "show",
        "--json",
        "--set",
        "domain=b",
    ];
    let shown = env.run(&[&before[..], &after].concat()).json();
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
fn check_reports_no_errors_for_a_valid_file() {
    let env = Environment::new();
    let nothing = env.run(&["config", "check"]);
    assert_eq!(
        nothing,
        ran(
            0,
            "no errors: no configuration file, all keys have their defaults\n",
            ""
        )
    );
    env.write("work/fipa.toml", "domain = \"lab\"\n");
    assert_eq!(
        env.run(&["config", "check"]),
        ran(0, "no errors: fipa.toml\n", "")
    );
    let tcp = ["config", "check", "--set", "mts.transports=tcp"];
    let unusable = env.run(&tcp);
    assert_eq!(unusable.code, Some(2));
    let help = "list tcp and set transport.tcp.processes = true\n";
    assert!(unusable.stderr.ends_with(help), "{unusable:?}");
    let usable = [&tcp[..], &["--set", "transport.tcp.processes=true"]].concat();
    assert_eq!(env.run(&usable).code, Some(0));
    let as_json = env.run(&["config", "check", "--json"]);
    assert_eq!(
        (as_json.code, as_json.json()),
        (Some(0), json!({ "ok": true, "mistakes": [] }))
    );
}

#[test]
fn errors_are_reported_with_place_and_help() {
    let env = Environment::new();
    env.write("work/fipa.toml", "[mts]\ndeadlin = \"5s\"\nqueue = \"x\"\n");
    let errors = "\
error: unknown key `mts.deadlin`
where: fipa.toml:2
 help: did you mean `mts.deadline`? (known in [mts]: name, transports, deadline, queue, queue_bytes, raise_open_files)
error: `mts.queue` is invalid: \"x\": a string is not allowed here
where: fipa.toml:3
 help: expected a number of letters such as 256
";
    for action in ["show", "check"] {
        assert_eq!(env.run(&["config", action]), ran(2, "", errors));
    }
    let as_json = env.run(&["config", "check", "--json"]);
    assert_eq!((as_json.code, as_json.stderr.as_str()), (Some(2), ""));
    assert_eq!(
        as_json.json(),
        json!({ "ok": false, "mistakes": [
            { "what": "unknown key `mts.deadlin`",
              "help": "did you mean `mts.deadline`? \
                       (known in [mts]: name, transports, deadline, queue, queue_bytes, raise_open_files)",
              "place": { "from": "file", "path": "fipa.toml", "line": 2 } },
            { "what": "`mts.queue` is invalid: \"x\": a string is not allowed here",
              "help": "expected a number of letters such as 256",
              "place": { "from": "file", "path": "fipa.toml", "line": 3 } },
        ] })
    );
    let set = env.run(&[
        "config",
        "check",
        "--config",
        "/dev/null",
        "--set",
        "mts.queue=0",
    ]);
    let errors = "\
error: `mts.queue` cannot be 0
where: --set mts.queue=0
 help: use 1 to 65536 letters
";
    assert_eq!(set, ran(2, "", errors));
}

#[test]
fn a_missing_file_is_reported() {
    let env = Environment::new();
    let errors = "\
error: cannot read the configuration none.toml (named by --config): \
No such file or directory (os error 2)
 help: check the permissions of the file (`ls -l`), or give another one with --config or $FIPA_CONFIG
";
    assert_eq!(
        env.run(&["config", "show", "--config", "none.toml"]),
        ran(2, "", errors)
    );
    let json = env.run(&["config", "check", "--json", "--config", "none.toml"]);
    assert_eq!(json, ran(2, "", errors));
    let mut by_variable = env.command(&["config", "check"]);
    let by_variable = Ran::from(
        by_variable
            .env("FIPA_CONFIG", "none.toml")
            .output()
            .unwrap(),
    );
    assert_eq!(
        by_variable,
        ran(2, "", &errors.replace("--config):", "$FIPA_CONFIG):"))
    );
}

#[test]
fn the_first_existing_file_is_used() {
    let env = Environment::new();
    let checked = |arguments: &[&str], variable: Option<&Path>| {
        let mut command = env.command(&["config", "check"]);
        command
            .args(arguments)
            .envs(variable.map(|file| ("FIPA_CONFIG", file)));
        let checked = Ran::from(command.output().unwrap());
        assert_eq!((checked.code, checked.stderr.as_str()), (Some(0), ""));
        checked
            .stdout
            .trim_start_matches("no errors: ")
            .trim_end()
            .to_owned()
    };
    let of_user = env.path("home/.config/fipa/fipa.toml");
    env.write("home/.config/fipa/fipa.toml", "");
    assert_eq!(checked(&[], None), of_user.display().to_string());
    env.write("work/fipa.toml", "");
    assert_eq!(checked(&[], None), "fipa.toml");
    env.write("variable.toml", "").write("option.toml", "");
    let variable = env.path("variable.toml");
    assert_eq!(
        checked(&[], Some(&variable)),
        variable.display().to_string()
    );
    assert_eq!(
        checked(&["--config", "../option.toml"], Some(&variable)),
        "../option.toml"
    );
}

#[test]
fn the_configuration_of_the_debian_package_opens_no_port() {
    let env = Environment::new();
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/debian/fipa.toml");
    let checked = env.run(&["config", "check", "--config", file]);
    assert_eq!((checked.code, checked.stderr.as_str()), (Some(0), ""));
    let shown = env
        .run(&["config", "show", "--json", "--config", file])
        .json();
    let settings = shown["settings"].as_array().unwrap();
    for (path, value) in [
        (json!(["transport", "tcp", "listen"]), json!([])),
        (json!(["discovery", "mdns"]), json!(false)),
        (json!(["runtime_dir"]), json!("/run/fipa")),
    ] {
        let setting = settings.iter().find(|it| it["path"] == path).unwrap();
        assert_eq!(setting["value"], value);
    }
    // Its proposals for other hosts are valid, too.
    let text = fs::read_to_string(file).unwrap();
    let enabled = text
        .replace("\nlisten = []\n", "\n")
        .replace("\nmdns = false\n", "\n")
        .replace("\n#[", "\n[")
        .replace("\n#listen", "\nlisten")
        .replace("\n#keys", "\nkeys");
    env.write("enabled.toml", &enabled);
    let shown = env.run(&["config", "show", "--config", "../enabled.toml"]);
    assert_eq!((shown.code, shown.stderr.as_str()), (Some(0), ""));
    assert!(
        shown.stdout.contains("listen = [\"*:7788\"]"),
        "{}",
        shown.stdout
    );
    assert!(
        shown.stdout.contains("keys = \"/var/lib/fipa/keys\""),
        "{}",
        shown.stdout
    );
}

#[test]
fn an_invalid_command_line_has_exit_code_2() {
    let env = Environment::new();
    for arguments in [
        &[][..],
        &["config"],
        &["nonsense"],
        &["config", "show", "--nonsense"],
        &["config", "show", "-v", "-q"],
    ] {
        let ran = env.run(arguments);
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
    let env = Environment::new();
    let help = env.run(&["--help"]);
    assert_eq!((help.code, help.stderr.as_str()), (Some(0), ""));
    assert!(help.stdout.contains("Exit codes:"), "{}", help.stdout);
    for (command, first_line) in [
        (
            &["config"][..],
            "Show the effective configuration, or check it for errors",
        ),
        (
            &["config", "show"],
            "Print the effective configuration with the origin of every value",
        ),
        (&["config", "check"], "Check the configuration for errors"),
        (
            &["up"],
            "Run the gateway, which connects the agents of this host with agents on other hosts",
        ),
        (&["agents"], "List the agents of the domain"),
        (&["send"], "Send one message and print its outcome"),
        (
            &["echo"],
            "Run an agent that answers each message with an inform of the same content",
        ),
        (&["decode"], "Print a recorded message or letter as JSON"),
        (
            &["demo"],
            "Demonstrate the main functions with two simulated hosts and several agents",
        ),
    ] {
        let help = env.run(&[command, &["--help"]].concat());
        assert_eq!((help.code, help.stderr.as_str()), (Some(0), ""));
        assert!(help.stdout.starts_with(first_line), "{}", help.stdout);
        let example = format!("Examples:\n  fipa {}", command[0]);
        assert!(help.stdout.contains(&example), "{}", help.stdout);
    }
}

#[test]
fn an_invalid_log_filter_is_only_a_warning() {
    let env = Environment::new();
    let mut command = env.command(&["config", "check"]);
    let ran = Ran::from(command.env("RUST_LOG", "fipa=loudly").output().unwrap());
    assert_eq!(ran.code, Some(0));
    assert!(
        ran.stderr
            .starts_with("warning: ignoring $RUST_LOG, which is not a valid log filter: "),
        "{}",
        ran.stderr
    );
}

#[test]
fn output_that_cannot_be_written_is_a_failure() {
    let env = Environment::new();
    let mut command = env.command(&["config", "show"]);
    command.stdout(File::options().write(true).open("/dev/full").unwrap());
    let errors = "\
error: cannot write the output: No space left on device (os error 28)
where: standard output
 help: check whether the disk is full, or redirect the output to another file
";
    assert_eq!(Ran::from(command.output().unwrap()), ran(1, "", errors));
}

#[test]
fn a_closed_pipe_is_not_a_failure() {
    let env = Environment::new();
    let (reader, writer) = io::pipe().unwrap();
    drop(reader);
    let mut command = env.command(&["config", "show"]);
    command.stdout(writer);
    assert_eq!(Ran::from(command.output().unwrap()), ran(0, "", ""));
}

#[test]
fn the_variable_sets_the_domain_unless_set_does() {
    let env = Environment::new();
    env.write("work/fipa.toml", "domain = \"of-file\"\n");
    let domain = |arguments: &[&str]| {
        let mut command = env.command(arguments);
        let ran = Ran::from(command.env("FIPA_DOMAIN", "of-variable").output().unwrap());
        ran.stdout.lines().next().unwrap_or_default().to_owned()
    };
    let shown = domain(&["config", "show"]);
    assert!(
        shown.starts_with("domain = \"of-variable\"") && shown.ends_with("# $FIPA_DOMAIN"),
        "{shown}"
    );
    let shown = domain(&["config", "show", "--set", "domain=of-set"]);
    assert!(shown.starts_with("domain = \"of-set\""), "{shown}");
    let plain = env.run(&["config", "show"]).stdout;
    assert!(plain.starts_with("domain = \"of-file\""), "{plain}");
    let mut command = env.command(&["config", "check"]);
    let wrong = Ran::from(command.env("FIPA_DOMAIN", "a b").output().unwrap());
    assert_eq!(wrong.code, Some(2));
    assert!(
        wrong.stderr.contains("where: $FIPA_DOMAIN"),
        "{}",
        wrong.stderr
    );
}

#[test]
fn check_finds_all_mistakes_at_once_and_what_the_machine_lacks() {
    let env = Environment::new();
    env.write(
        "work/broken.scxml",
        "<scxml initial=\"1\"><state id=\"1\"/>\n",
    );
    env.write(
        "work/fipa.toml",
        "\
[mts]
queue = \"many\"
[routes]
\"arm_(\" = [\"shm\"]
[transport.tcp]
listen = [\"[fe80::1%fipa-none]:7788\"]
[discovery]
interfaces = [\"fipa-none\"]
static = { crex = [\"udp://10.0.0.2:7788\"] }
[security]
keys = \"/nonexistent/keys\"
[access]
deny = { \"rover_[\" = [\"brake\"] }
[monitor]
protocols = [\"missing.scxml\", \"broken.scxml\"]
",
    );
    let checked = env.run(&["config", "check", "--json"]);
    assert_eq!(checked.code, Some(2), "{checked:?}");
    let report: Value = serde_json::from_str(&checked.stdout).unwrap();
    let mistakes = report["mistakes"].as_array().unwrap();
    let mut found: Vec<(u64, &str)> = mistakes
        .iter()
        .map(|mistake| {
            let what = mistake["what"].as_str().unwrap();
            let key = what.split('`').nth(1).unwrap();
            (mistake["place"]["line"].as_u64().unwrap(), key)
        })
        .collect();
    found.sort_unstable();
    assert_eq!(
        found,
        [
            (2, "mts.queue"),
            (4, "routes.\"arm_(\""),
            (6, "transport.tcp.listen"),
            (8, "discovery.interfaces"),
            (9, "discovery.static.crex"),
            (11, "security.keys"),
            (13, "access.deny.\"rover_[\""),
            (15, "monitor.protocols"),
            (15, "monitor.protocols"),
        ],
        "{}",
        checked.stdout
    );
    // Loading does not depend on the machine.
    env.write(
        "work/fipa.toml",
        "[discovery]\ninterfaces = [\"fipa-none\"]\n",
    );
    assert_eq!(env.run(&["config", "show"]).code, Some(0));
    assert_eq!(env.run(&["config", "check"]).code, Some(2));
}
