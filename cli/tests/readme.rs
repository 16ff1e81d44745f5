//! What the README tells a new user to type, typed.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use fipa_testbed::{Host, Network, Running, enter, isolated};

const README: &str = include_str!("../../README.md");

/// The commands that the README shows under the paragraph that begins so, without its comments.
fn commands(below: &str) -> Vec<&'static str> {
    let (_, text) = README.split_once(below).unwrap();
    let (_, block) = text.split_once("```console\n").unwrap();
    let (block, _) = block.split_once("```").unwrap();
    let lines = block.lines().filter_map(|line| line.strip_prefix("$ "));
    lines
        .map(|line| line.split(" #").next().unwrap_or(line).trim())
        .collect()
}

/// A user on a host of that name.
struct User<'a> {
    name: &'a str,
    host: &'a Host,
}

impl User<'_> {
    fn home(&self) -> PathBuf {
        fipa_testbed::directory().join(self.name)
    }

    /// A shell on that host, in the user's home, about to run this line.
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

    fn types(&self, line: &str) {
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
    fipa_testbed::run("mount -t tmpfs tmpfs /dev/shm");
    // What would copy to another host copies to the other user's home.
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
    let typed = commands("Two hosts trust each other");
    // The other way round.
    let also: Vec<String> = typed
        .iter()
        .map(|line| {
            line.replace("crex", "X")
                .replace("rover", "crex")
                .replace('X', "rover")
        })
        .collect();
    assert!(typed.len() + also.len() < 10, "{typed:?}");
    for user in &users {
        fs::create_dir(user.home()).unwrap();
    }
    let (last, before) = typed.split_last().unwrap();
    for (ours, theirs) in before.iter().zip(&also) {
        rover.types(ours);
        crex.types(theirs);
    }
    let gateways = [(rover, *last), (crex, also[before.len()].as_str())];
    let _gateways =
        gateways.map(|(user, line)| Running::until_ready(&mut user.shell(&format!("exec {line}"))));
    let _arm = Running::until_ready(&mut crex.shell("exec fipa echo arm_1"));
    let begun = Instant::now();
    loop {
        let sent = rover
            .shell("fipa send --to arm_1 --content hello")
            .output()
            .unwrap();
        let told = String::from_utf8_lossy(&sent.stdout).into_owned();
        if sent.status.success() {
            assert!(told.contains("delivered via tcp"), "{told}");
            return;
        }
        assert!(begun.elapsed() < Duration::from_secs(60), "never: {sent:?}");
        std::thread::sleep(Duration::from_millis(50));
    }
}
