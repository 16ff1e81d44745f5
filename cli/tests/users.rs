//! Processes of several users in one domain, which belongs to a group. Needs root, which starts them.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs::{self, Permissions};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _, chown};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{Host, Ran, Running};
use fipa_testbed::{enter, isolated, until};

/// The group of the domain, and users that no other program has.
const CREW: u32 = 3_000_000_001;
const GATEWAY: u32 = 3_000_000_002;
const DRIVER: u32 = 3_000_000_003;
const PLANNER: u32 = 3_000_000_004;

/// The upper level of the domain's directory.
const RUN: &str = "/run/fipa";

/// A host whose domain belongs to the group.
struct Robot {
    host: Host,
    program: PathBuf,
    settings: Vec<String>,
}

impl Robot {
    fn new(settings: &[&str]) -> Self {
        enter();
        let host = Host::new();
        let program = host.path("fipa");
        fs::copy(env!("CARGO_BIN_EXE_fipa"), &program).unwrap();
        for directory in [".", ".."] {
            let open = Permissions::from_mode(0o755);
            fs::set_permissions(host.path(directory), open).unwrap();
        }
        fs::create_dir(RUN).unwrap();
        chown(RUN, None, Some(CREW)).unwrap();
        fs::set_permissions(RUN, Permissions::from_mode(0o770)).unwrap();
        let settings = settings.iter().map(|it| (*it).to_owned());
        Self {
            settings: settings.chain([format!("group={CREW}")]).collect(),
            host,
            program,
        }
    }

    /// A command of a user with a group, under an umask that takes everything from others.
    fn command(&self, user: u32, group: u32, arguments: &[&str]) -> Command {
        let host = self.host.command(arguments);
        let mut command = Command::new("sh");
        command
            .args(["-c", "umask 077 && exec \"$@\"", "sh"])
            .arg(&self.program)
            .args(self.settings.iter().flat_map(|it| ["--set", it]))
            .args(host.get_args())
            .current_dir(self.host.path("."))
            .env_clear()
            .env("HOME", self.host.path("."))
            .env("FIPA_RUNTIME_DIR", RUN)
            .uid(user)
            .gid(group);
        command
    }

    fn start(&self, user: u32, arguments: &[&str]) -> Running {
        Running::new(self.command(user, CREW, arguments))
    }

    fn run(&self, user: u32, group: u32, arguments: &[&str]) -> Ran {
        Ran::from(self.command(user, group, arguments).output().unwrap())
    }

    /// Runs a command as a member of the group, and returns its output.
    fn output(&self, user: u32, arguments: &[&str]) -> String {
        self.run(user, CREW, arguments).done()
    }
}

/// All files and directories below a directory, with it.
fn files(directory: &Path) -> Vec<PathBuf> {
    let mut found = vec![directory.to_owned()];
    for entry in fs::read_dir(directory).unwrap() {
        let entry = entry.unwrap();
        match entry.file_type().unwrap().is_dir() {
            true => found.extend(files(&entry.path())),
            false => found.push(entry.path()),
        }
    }
    found
}

fn is_of_counters(path: &Path) -> bool {
    path.extension().is_some_and(|end| end == "counts")
}

#[test]
fn the_users_of_a_group_exchange_letters() {
    isolated("the_users_of_a_group_exchange_letters_inside", &[]);
}

#[test]
#[ignore = "runs in namespaces"]
fn the_users_of_a_group_exchange_letters_inside() {
    let robot = Robot::new(&[]);
    // Any user can create this name.
    fs::create_dir(format!("/dev/shm/fipa-{DRIVER}")).unwrap();
    let gateway = robot.start(GATEWAY, &["up"]);
    let echo = robot.start(DRIVER, &["echo", "arm"]);
    let ping = ["ping", "arm", "--count", "1"];
    // Sockets prove the user. Shared memory belongs to one user.
    let by_planner = robot.output(PLANNER, &ping);
    assert!(by_planner.contains("delivered via unix"), "{by_planner}");
    let by_driver = robot.output(DRIVER, &ping);
    assert!(by_driver.contains("delivered via shm"), "{by_driver}");

    for path in files(Path::new(RUN)) {
        let found = fs::symlink_metadata(&path).unwrap();
        // The state that a gateway keeps for its successor belongs to its user.
        if path.file_name().is_some_and(|name| name == "gateway.state") {
            assert_eq!(found.mode() & 0o777, 0o600);
            continue;
        }
        // Others read the counters of a process, and may not shorten the file, which it maps.
        if is_of_counters(&path) {
            assert_eq!(
                (found.gid(), found.mode() & 0o777),
                (CREW, 0o640),
                "{path:?}"
            );
            continue;
        }
        assert_eq!((found.gid(), found.mode() & 0o007), (CREW, 0), "{path:?}");
        assert_eq!(
            found.mode() & 0o600,
            (found.mode() & 0o060) << 3,
            "{path:?}"
        );
    }

    let outsider = robot.run(PLANNER, PLANNER, &["agents"]).failed(1);
    assert!(outsider.contains("add the user to the group"), "{outsider}");
    let other = robot
        .run(PLANNER, CREW, &["agents", "--set", "group="])
        .failed(1);
    assert!(other.contains("it belongs to user root (0)"), "{other}");
    let doctor = robot.run(PLANNER, CREW, &["doctor"]);
    let report = String::from_utf8(doctor.stdout).unwrap();
    assert!(
        report.contains(&format!("shared by the members of group {CREW}")),
        "{report}"
    );

    // Processes of other users remove what a killed one leaves, and its name is free.
    drop(echo);
    until("its agent is gone", || {
        !robot.output(PLANNER, &["agents"]).contains("arm ")
    });
    let of_driver = |path: &PathBuf| {
        // Any user may have written the sum of the counters.
        let is_sum = path.ends_with("ended.counts");
        !is_sum && fs::symlink_metadata(path).is_ok_and(|it| it.uid() == DRIVER)
    };
    until("its files are gone", || {
        !files(Path::new(RUN)).iter().any(of_driver)
    });
    let _echo = robot.start(PLANNER, &["echo", "arm"]);
    let by_driver = robot.output(DRIVER, &ping);
    assert!(by_driver.contains("delivered via unix"), "{by_driver}");
    drop(gateway);
}

#[test]
fn rules_name_users() {
    isolated("rules_name_users_inside", &[]);
}

#[test]
#[ignore = "runs in namespaces"]
fn rules_name_users_inside() {
    let rule = format!("access.allow.\".*\"=[\"arm user={PLANNER}\", \"fipa-ping-.*\"]");
    let robot = Robot::new(&[&rule]);
    let _echo = robot.start(DRIVER, &["echo", "arm"]);
    let ping = ["ping", "arm", "--count", "1"];
    robot.output(PLANNER, &ping);
    let refused = robot.run(GATEWAY, CREW, &ping);
    assert_ne!(refused.code, Some(0));
    let text = String::from_utf8(refused.stdout).unwrap();
    assert!(text.contains("no rule allows it"), "{text}");
}

/// `sudo -u fipa` leaves the directory as it is, and home directories are closed to other users.
#[test]
fn a_directory_that_the_user_cannot_search_has_no_configuration() {
    let name = "a_directory_that_the_user_cannot_search_has_no_configuration_inside";
    isolated(name, &["setpriv"]);
}

#[test]
#[ignore = "runs in namespaces"]
fn a_directory_that_the_user_cannot_search_has_no_configuration_inside() {
    let robot = Robot::new(&[]);
    let home = robot.host.path("home");
    fs::create_dir_all(home.join(".config/fipa")).unwrap();
    for file in ["fipa.toml", ".config/fipa/fipa.toml"] {
        fs::write(home.join(file), "domain = \"of-root\"\n").unwrap();
    }
    let show = |mode| {
        fs::set_permissions(&home, Permissions::from_mode(mode)).unwrap();
        let mut command = Command::new("setpriv");
        command.args([format!("--reuid={DRIVER}"), format!("--regid={CREW}")]);
        command.args(["--clear-groups", "--"]).arg(&robot.program);
        command.args(["config", "show"]).current_dir(&home);
        Ran::from(command.env("HOME", &home).output().unwrap())
    };
    let shown = show(0o700).done();
    assert!(!shown.contains("of-root"), "{shown}");
    let shown = show(0o755).done();
    assert!(shown.contains("of-root"), "{shown}");
    let file = home.join("fipa.toml");
    fs::set_permissions(&file, Permissions::from_mode(0o600)).unwrap();
    let refused = show(0o755).failed(2);
    assert!(
        refused.contains("found in the current directory"),
        "{refused}"
    );
}
