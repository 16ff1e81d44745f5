//! Runs the commands that the README gives to a new user.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use fipa_testbed::{ChildGuard, Host, Network, enter, isolated};

const README: &str = include_str!("../../README.md");

/// The commands below the README paragraph that begins with this text, without their comments.
fn commands(below: &str) -> Vec<&'static str> {
    let (_, text) = README.split_once(below).unwrap();
    let (_, block) = text.split_once("```console\n").unwrap();
    let (block, _) = block.split_once("```").unwrap();
    let lines = block.lines().filter_map(|line| line.strip_prefix("$ "));
    lines
        .map(|line| line.split(" #").next().unwrap_or(line).trim())
        .collect()
}

/// The configuration below the README paragraph that begins with this text.
fn configuration(below: &str) -> &'static str {
    let (_, text) = README.split_once(below).unwrap();
    let (_, block) = text.split_once("```toml\n").unwrap();
    block.split_once("```").unwrap().0
}

/// A user on the host of the same name.
struct User<'a> {
    name: &'a str,
    host: &'a Host,
}

impl User<'_> {
    fn home(&self) -> PathBuf {
        fipa_testbed::directory().join(self.name)
    }

    /// The command that runs this line in a shell on the host, in the home of the user.
    fn shell(&self, line: &str) -> Command {
        let programs = Path::new(env!("CARGO_BIN_EXE_fipa")).parent().unwrap();
        let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
        let mut command = self.host.command("unshare");
        let named = format!("echo {} >/proc/sys/kernel/hostname; {line}", self.name);
        command
            .args(["--uts", "sh", "-c", &named])
            .current_dir(self.home())
            .env("HOME", self.home())
            .env("FIPA_RUNTIME_DIR", self.home().join("run"))
            .env_remove("FIPA_CONFIG")
            .env("PATH", path)
            .stdin(Stdio::null());
        command
    }

    fn run(&self, line: &str) {
        let done = self.shell(line).stdout(Stdio::null()).status().unwrap();
        assert!(done.success(), "{}: {line}", self.name);
    }

    /// Runs this line, and on the other host the command that it prints with the code that it prints.
    fn pair(&self, line: &str, other: &User) {
        let mut listening = self.shell(&format!("exec {line}"));
        let mut listening = ChildGuard::start(listening.stdout(Stdio::piped()));
        let output = BufReader::new(listening.child().stdout.take().unwrap());
        let mut printed = output.lines().map(Result::unwrap);
        let mut after = |start: &str| {
            let found = printed.find_map(|line| line.strip_prefix(start).map(str::to_owned));
            found.unwrap()
        };
        let (command, code) = (after("  "), after("and type this code there: "));
        other.run(&format!("echo {code} | {command}"));
        assert!(listening.wait().success());
    }
}

#[test]
fn two_hosts_are_secured_by_the_commands_of_the_readme() {
    isolated("inside_two_hosts_are_secured", &["unshare"]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_two_hosts_are_secured() {
    enter();
    let network = Network::new(2);
    let users = ["rover", "crex"].map(|name| {
        let number = usize::from(name == "crex");
        let host = network.host(number);
        User { name, host }
    });
    let [rover, crex] = &users;
    let lines = commands("Two hosts trust each other");
    let [init, pair, up] = lines[..] else {
        panic!("{lines:?}");
    };
    let configuration = configuration("Two hosts trust each other");
    for user in &users {
        let directory = user.home().join(".config/fipa");
        fs::create_dir_all(&directory).unwrap();
        let home = user.home().display().to_string();
        let text = configuration.replace("/home/robot", &home);
        assert_ne!(text, configuration);
        fs::write(directory.join("fipa.toml"), text).unwrap();
    }
    users.iter().for_each(|user| user.run(init));
    rover.pair(pair, crex);
    let _gateways =
        [rover, crex].map(|user| ChildGuard::until_ready(&mut user.shell(&format!("exec {up}"))));
    let _arm = ChildGuard::until_ready(&mut crex.shell("exec fipa echo arm_1"));
    let begun = Instant::now();
    loop {
        let sent = rover
            .shell("fipa send --to arm_1 --content hello")
            .output()
            .unwrap();
        let stdout = String::from_utf8_lossy(&sent.stdout).into_owned();
        if sent.status.success() {
            assert!(stdout.contains("delivered via tcp"), "{stdout}");
            return;
        }
        assert!(
            begun.elapsed() < Duration::from_secs(60),
            "not delivered: {sent:?}"
        );
        std::thread::sleep(Duration::from_millis(50));
    }
}
