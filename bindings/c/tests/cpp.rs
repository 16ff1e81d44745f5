//! Programs in C++, compiled with all warnings as errors, and the examples of `bindings/cpp`.

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

use fipa_testbed::languages::bindings;
use support::{SANITIZERS, SHARED, Workshop, passes};

mod support;

const WARNINGS: &[&str] = &[
    "-Wall",
    "-Wextra",
    "-Werror",
    "-pedantic",
    "-Wshadow",
    "-Wconversion",
    "-g",
];

/// Compiles a source in C++ with warnings as errors.
fn compile(workshop: &Workshop, source: &Path, name: &str, flags: &[&str]) -> std::path::PathBuf {
    let flags = [WARNINGS, flags].concat();
    workshop.compile("c++", source, name, &flags, SHARED)
}

#[test]
fn each_class_works_and_sanitizers_find_no_wrong_access_and_no_leak() {
    let workshop = Workshop::new();
    let flags = [&["-std=c++17"], SANITIZERS].concat();
    let tour = compile(&workshop, &bindings("cpp/tests/tour.cpp"), "tour", &flags);
    passes(
        workshop
            .command(&tour, &[])
            .env("ASAN_OPTIONS", "detect_leaks=1"),
    );
}

/// The memory of the library comes from the allocator that the sanitizer watches.
#[test]
fn the_sanitizer_finds_a_content_that_is_read_after_its_letter() {
    let workshop = Workshop::new();
    let flags = [&["-std=c++17"], SANITIZERS].concat();
    let source = bindings("cpp/tests/dangling.cpp");
    let program = compile(&workshop, &source, "dangling", &flags);
    let output = workshop
        .command(&program, &[])
        .env("ASAN_OPTIONS", "detect_leaks=0")
        .output()
        .expect("the program runs");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{output:?}");
    assert!(errors.contains("heap-use-after-free"), "{errors}");
}

#[test]
fn each_class_works_in_cpp20_without_exceptions() {
    let workshop = Workshop::new();
    let flags = ["-std=c++20", "-fno-exceptions", "-fno-rtti"];
    let tour = compile(&workshop, &bindings("cpp/tests/tour.cpp"), "tour", &flags);
    passes(&mut workshop.command(&tour, &[]));
}

#[test]
fn the_header_compiles_with_each_compiler_and_standard() {
    let has_clang = Command::new("clang++")
        .arg("--version")
        .output()
        .is_ok_and(|output| output.status.success());
    if !has_clang {
        eprintln!("SKIPPED, not a success: clang++ is not installed");
    }
    let workshop = Workshop::new();
    let tour = bindings("cpp/tests/tour.cpp");
    // The header compiles alone, too.
    let header = bindings("cpp/include/fipa.hpp");
    let compilers = ["c++", "clang++"];
    for compiler in &compilers[..if has_clang { 2 } else { 1 }] {
        for (source, standard, exceptions) in [
            (&header, "-std=c++17", "-fexceptions"),
            (&tour, "-std=c++17", "-fno-exceptions"),
            (&tour, "-std=c++23", "-fexceptions"),
        ] {
            let flags = [standard, exceptions, "-xc++", "-fsyntax-only"];
            let flags = [WARNINGS, &flags].concat();
            workshop.compile(compiler, source, "none", &flags, &[]);
        }
    }
}

#[test]
fn units_with_and_without_exceptions_can_be_linked() {
    let workshop = Workshop::new();
    let source = bindings("cpp/tests/units.cpp");
    let flags = ["-std=c++17", "-fno-exceptions", "-DFIPA_UNIT", "-c"];
    let unit = compile(&workshop, &source, "unit.o", &flags);
    let unit = unit.to_str().expect("the path is UTF-8");
    // The unit without exceptions comes first, and its functions are not those of the other.
    let flags = ["-std=c++17", "-xnone", unit, "-xc++"];
    let program = compile(&workshop, &source, "units", &flags);
    passes(&mut workshop.command(&program, &[]));
}

#[test]
fn the_program_of_the_readme_runs() {
    let workshop = Workshop::new();
    let readme = fs::read_to_string(bindings("cpp/README.md")).expect("the README is readable");
    let (_, rest) = readme.split_once("```cpp\n").expect("an example");
    let (example, _) = rest.split_once("```").expect("its end");
    assert!(example.lines().count() <= 15, "the example is longer");
    let source = workshop.path().join("example.cpp");
    fs::write(&source, example).expect("the example can be written");
    let program = compile(&workshop, &source, "example", &["-std=c++17"]);
    let output = workshop
        .command(&program, &[])
        .output()
        .expect("the example runs");
    assert!(output.status.success(), "{output:?}");
    assert_eq!(String::from_utf8_lossy(&output.stdout), "rover: hello\n");
}

/// The driver polls the descriptor in its loop, and the operator resumes coroutines from it.
#[test]
fn an_operator_with_coroutines_moves_the_arm_of_a_driver() {
    let workshop = Workshop::new();
    let source = |name: &str| bindings("cpp/examples").join(name).with_extension("cpp");
    let driver = compile(&workshop, &source("driver"), "driver", &["-std=c++17"]);
    let operator = compile(&workshop, &source("operator"), "operator", &["-std=c++20"]);

    let mut driver = workshop
        .command(&driver, &[])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("the driver runs");
    let mut line = String::new();
    let output = driver.stdout.take().expect("its output");
    BufReader::new(output)
        .read_line(&mut line)
        .expect("a line of the driver");
    assert_eq!(line, "ready\n");

    let ended = workshop
        .command(&operator, &["timeout", "120"])
        .output()
        .expect("the operator runs");
    // The driver ends with its standard input.
    drop(driver.stdin.take());
    let status = driver.wait().expect("the driver ends");
    let text = String::from_utf8_lossy(&ended.stdout);
    let errors = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.success(), "{text}{errors}");
    assert!(status.success(), "{status}");
    let (positions, others): (Vec<&str>, Vec<&str>) =
        text.lines().partition(|line| line.starts_with("at "));
    assert!(positions.len() >= 2, "{text}");
    let [moved, refused, stopped] = others[..] else {
        panic!("{text}");
    };
    assert_eq!(moved, "moved to 0.50");
    assert!(refused.starts_with("refused: ") && refused.contains("not in 0 to 1"));
    assert_eq!(stopped, "stopped");
}
