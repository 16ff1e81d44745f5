//! Runs the commands that the README gives to a new user.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::fs;
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
        let path = format!(
            "{}:{}:{}",
            fipa_testbed::directory().join("bin").display(),
            programs.display(),
            std::env::var("PATH").unwrap()
        );
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
}

#[test]
fn two_hosts_are_secured_in_under_ten_commands() {
    isolated("inside_two_hosts_are_secured", &["unshare"]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_two_hosts_are_secured() {
    enter();
    // `scp` copies to the home of the other user.
    let homes = fipa_testbed::directory();
    let bin = homes.join("bin");
    fs::create_dir(&bin).unwrap();
    let copy = format!(
        "exec cp \"$1\" \"{}/${{2%%:*}}/${{2#*:}}\"",
        homes.display()
    );
    fs::write(bin.join("scp"), format!("#!/bin/sh\n{copy}\n")).unwrap();
    fipa_testbed::run(&format!("chmod +x {}", bin.join("scp").display()));

    let network = Network::new(2);
    let users = ["rover", "crex"].map(|name| {
        let number = usize::from(name == "crex");
        let host = network.host(number);
        User { name, host }
    });
    let [rover, crex] = &users;
    let lines = commands("Two hosts trust each other");
    // The same lines for the other host.
    let swapped: Vec<String> = lines
        .iter()
        .map(|line| {
            line.replace("crex", "X")
                .replace("rover", "crex")
                .replace('X', "rover")
        })
        .collect();
    assert!(lines.len() + swapped.len() < 10, "{lines:?}");
    let configuration = configuration("Two hosts trust each other");
    for user in &users {
        let directory = user.home().join(".config/fipa");
        fs::create_dir_all(&directory).unwrap();
        let home = user.home().display().to_string();
        let text = configuration.replace("/home/robot", &home);
        assert_ne!(text, configuration);
        fs::write(directory.join("fipa.toml"), text).unwrap();
    }
    let (last, before) = lines.split_last().unwrap();
    for (ours, theirs) in before.iter().zip(&swapped) {
        rover.run(ours);
        crex.run(theirs);
    }
    let gateways = [(rover, *last), (crex, swapped[before.len()].as_str())];
    let _gateways = gateways
        .map(|(user, line)| ChildGuard::until_ready(&mut user.shell(&format!("exec {line}"))));
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
