//! Another user of the host creates files with the names that the processes of a user need. Needs root, which
//! is the other user here.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::Command;

use common::{Host, Ran, Running};

/// The command of a user that no other process has.
struct User<'a> {
    host: &'a Host,
    id: u32,
    program: PathBuf,
}

impl User<'_> {
    fn command(&self, arguments: &[&str]) -> Command {
        let host = self.host.command(arguments);
        let mut command = Command::new(&self.program);
        command
            .args(["--set", "mts.transports=[\"shm\"]"])
            .args(host.get_args())
            .current_dir(self.host.path("."))
            .env_clear()
            .env("HOME", self.host.path("."))
            .uid(self.id)
            .gid(self.id);
        command
    }

    fn run(&self, arguments: &[&str]) -> Ran {
        Ran::from(self.command(arguments).output().unwrap())
    }

    /// The directories in `/tmp` with the user in their names.
    fn directories(&self) -> Vec<PathBuf> {
        let entries = fs::read_dir("/tmp").unwrap().flatten();
        let prefix = format!("fipa-{}", self.id);
        entries
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
            .map(|entry| entry.path())
            .collect()
    }
}

impl Drop for User<'_> {
    fn drop(&mut self) {
        for directory in self.directories() {
            let _ = fs::remove_dir_all(directory);
        }
    }
}

#[test]
fn names_that_another_user_has_created_stop_no_process() {
    if !rustix::process::geteuid().is_root() {
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "this test needs root");
        eprintln!("SKIPPED, not a success: this test needs root, which is the other user");
        return;
    }
    let host = Host::new();
    let program = host.path("fipa");
    fs::copy(env!("CARGO_BIN_EXE_fipa"), &program).unwrap();
    fs::set_permissions(host.path("."), Permissions::from_mode(0o755)).unwrap();
    let user = User {
        host: &host,
        id: 3_000_000_000 + std::process::id(),
        program,
    };
    let held = PathBuf::from(format!("/tmp/fipa-{}", user.id));
    fs::create_dir(&held).unwrap();

    let arm = Running::new(user.command(&["echo", "arm"]));
    assert!(arm.ready.starts_with("agent arm "), "{}", arm.ready);
    let hello = ["send", "--to", "arm", "--content", "hello", "--wait"];
    let sent = user.run(&hello);
    assert_eq!(sent.code, Some(0), "{}", sent.stderr);
    assert!(sent.stderr.contains("holds the name"), "{}", sent.stderr);
    assert_eq!(user.directories().len(), 2);

    // With the prefix of a running domain, which every user can read.
    let files = fs::read_dir("/dev/shm").unwrap().flatten();
    let mut names = files.map(|file| file.file_name().into_string().unwrap());
    let page = names.find(|name| name.contains(&host.domain) && name.ends_with(".page"));
    let page = page.unwrap();
    let prefix = page.rsplit_once('_').unwrap().0;
    let created =
        ["x.global_mgmt", "0123456789abcdef.page"].map(|end| format!("/dev/shm/{prefix}_{end}"));
    for file in &created {
        fs::write(file, "").unwrap();
        fs::set_permissions(file, Permissions::from_mode(0o600)).unwrap();
    }
    let sent = user.run(&hello);
    assert_eq!(sent.code, Some(0), "{}", sent.stderr);

    let doctor = user.run(&["doctor"]);
    let report = String::from_utf8(doctor.stdout).unwrap();
    assert!(report.contains("user root (0) holds that name"), "{report}");

    drop(arm);
    for file in &created {
        fs::remove_file(file).unwrap();
    }
}
