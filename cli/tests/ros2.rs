//! The bridge `fipa-ros2` between unmodified programs of ROS 2 and agents, with the rclpy of each release that
//! `$FIPA_ROS2` names: Python interpreters, separated by colons. `.ci/ros2` installs them.

use std::env;
use std::path::Path;
use std::process::Command;

use fipa_testbed::languages::{bindings, install_package, libraries};

/// Runs the tests of a file with each release.
fn run(tests: &str) {
    let in_ci = env::var("CI").as_deref() == Ok("true");
    let releases = env::var("FIPA_ROS2").unwrap_or_default();
    let is_built = libraries().join("libfipa_python.so").exists();
    if releases.is_empty() || !is_built {
        let remedy = "run `.ci/ros2` and `cargo build -p fipa-python` first";
        assert!(!in_ci, "{tests}: {remedy}");
        eprintln!("SKIPPED, not a success: {tests} needs rclpy; {remedy}");
        return;
    }
    let package = tempfile::tempdir().unwrap();
    install_package(package.path());
    let command = Path::new(env!("CARGO_BIN_EXE_fipa")).parent().unwrap();
    let path = env::join_paths(
        [command.to_owned()]
            .into_iter()
            .chain(env::split_paths(&env::var_os("PATH").unwrap_or_default())),
    );
    for python in releases.split(':') {
        let output = Command::new(python)
            .args(["-X", "faulthandler", "-m", "unittest", "-v", tests])
            .current_dir(bindings("python/tests/ros2"))
            .env("PYTHONPATH", package.path())
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .env("PATH", path.as_ref().unwrap())
            .env("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
            .output()
            .unwrap();
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
