//! The installation: CMake installs the library into a prefix, and programs find it there.

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::ffi::OsStr;
use std::path::Path;
use std::process::Command;

use fipa_testbed::can_run;

use fipa_testbed::languages::{bindings, libraries};
use support::{Workshop, passes};

mod support;

/// Runs a tool that must succeed, and returns its output.
fn tool(command: &mut Command) -> String {
    let output = command.output().expect("the tool runs");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}\n{text}{errors}");
    text
}

/// Installs the library that the tests have built.
fn install(build: &Path, prefix: &Path) {
    tool(
        Command::new("cmake")
            .arg("-S")
            .arg(bindings("c"))
            .arg("-B")
            .arg(build)
            .arg(define("CMAKE_INSTALL_PREFIX", prefix))
            .arg("-DCMAKE_INSTALL_LIBDIR=lib")
            .args(cfg!(feature = "gateway").then_some("-DFIPA_GATEWAY=ON"))
            .arg(define("FIPA_LIBRARY_DIR", &libraries())),
    );
    tool(Command::new("cmake").arg("--install").arg(build));
}

fn define(name: &str, path: &Path) -> String {
    format!("-D{name}={}", path.display())
}

#[test]
fn programs_find_the_installed_library() {
    let name = "programs_find_the_installed_library";
    if !can_run(name, &["cmake", "pkg-config"], true) {
        return;
    }
    let workshop = Workshop::new();
    let prefix = workshop.path().join("prefix");
    install(&workshop.path().join("installation"), &prefix);
    let libraries = prefix.join("lib");
    let link = std::fs::read_link(libraries.join("libfipa.so")).expect("a link");
    assert_eq!(link, Path::new("libfipa.so.0"));

    with_find_package(&workshop, &prefix);
    with_pkg_config(&workshop, &libraries);
}

fn with_find_package(workshop: &Workshop, prefix: &Path) {
    let build = workshop.path().join("project");
    tool(
        Command::new("cmake")
            .arg("-S")
            .arg(bindings("cpp/tests/installed"))
            .arg("-B")
            .arg(&build)
            .arg(define("CMAKE_PREFIX_PATH", prefix)),
    );
    tool(Command::new("cmake").arg("--build").arg(&build));
    for program in ["in_c", "in_c_static", "in_cpp"] {
        // CMake has written the path of the library into the program.
        passes(
            workshop
                .command(&build.join(program), &[])
                .env_remove("LD_LIBRARY_PATH"),
        );
    }
}

fn with_pkg_config(workshop: &Workshop, libraries: &Path) {
    let flags = tool(
        Command::new("pkg-config")
            .args(["--cflags", "--libs", "fipa"])
            .env("PKG_CONFIG_PATH", libraries.join("pkgconfig")),
    );
    assert_eq!(flags.contains("FIPA_GATEWAY"), cfg!(feature = "gateway"));
    let program = workshop.path().join("with_pkg_config");
    // No other path to the headers and the library than that of pkg-config.
    tool(
        Command::new("c++")
            .arg("-std=c++17")
            .arg(bindings("cpp/tests/installed/main.cpp"))
            .arg("-o")
            .arg(&program)
            .args(flags.split_whitespace().map(OsStr::new)),
    );
    passes(
        workshop
            .command(&program, &[])
            .env("LD_LIBRARY_PATH", libraries),
    );
}
