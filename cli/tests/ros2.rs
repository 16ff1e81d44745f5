//! The bridge `fipa-ros2` between unmodified programs of ROS 2 and agents, with the rclpy of each release that
//! `$FIPA_ROS2` names: Python interpreters, separated by colons. `.ci/ros2` installs them.

use std::env;
use std::path::Path;
use std::process::Command;

use fipa_testbed::languages::{bindings, install_package, ros2_pythons};

/// Runs the tests of a file with each release.
fn run(tests: &str) {
    let command = Path::new(env!("CARGO_BIN_EXE_fipa"))
        .parent()
        .expect("a folder");
    let path = env::join_paths(
        [command.to_owned()]
            .into_iter()
            .chain(env::split_paths(&env::var_os("PATH").unwrap_or_default())),
    )
    .expect("a path");
    for python in ros2_pythons(tests) {
        let package = tempfile::tempdir().expect("a directory");
        install_package(package.path());
        let output = Command::new(&python)
            .args(["-X", "faulthandler", "-m", "unittest", "-v", tests])
            .current_dir(bindings("python/tests/ros2"))
            .env("PYTHONPATH", package.path())
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .env("PATH", &path)
            .env("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
            .output()
            .expect("python runs");
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(
            output.status.success(),
            "{python}: {}\n{text}",
            output.status
        );
    }
}

#[test]
fn robots_of_ros_are_agents() {
    run("test_robots");
}

#[test]
fn agents_are_reached_from_ros() {
    run("test_agents");
}

#[test]
fn messages_of_ros_are_values() {
    run("test_values");
}
