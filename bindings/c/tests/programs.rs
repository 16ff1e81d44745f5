//! Programs in C, compiled with all warnings as errors, run against the shared and the static library.

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::time::Duration;

use fipa::Performative;
use fipa::blocking::Wait;
use fipa_testbed::{ChildGuard, can_run, until};

use fipa_testbed::languages::bindings;
use support::{C, SHARED, STATIC, Workshop, run, run_sanitized};

mod support;

/// A deadline that a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

#[test]
fn each_call_works_with_the_shared_library() {
    run("tour", SHARED, &[]);
}

#[test]
fn each_call_works_with_the_static_library() {
    run("tour", STATIC, &[]);
}

#[test]
fn wrong_input_is_an_error_and_no_crash() {
    run("misuse", SHARED, &[]);
}

#[test]
fn threads_share_a_domain() {
    run("threads", SHARED, &[]);
}

#[test]
fn valgrind_finds_no_wrong_access_and_no_leak() {
    if !can_run(
        "valgrind_finds_no_wrong_access_and_no_leak",
        &["valgrind"],
        true,
    ) {
        return;
    }
    let known = format!(
        "--suppressions={}/tests/c/valgrind.supp",
        env!("CARGO_MANIFEST_DIR")
    );
    let memcheck = ["valgrind", "-q", "--error-exitcode=9", &known];
    let leaks = [
        "--leak-check=full",
        "--show-leak-kinds=definite",
        "--errors-for-leak-kinds=definite",
    ];
    run("tour", SHARED, &[&memcheck[..], &leaks].concat());
    // Its forked child cannot free what belonged to threads of the parent.
    run("misuse", SHARED, &memcheck);
}

#[test]
fn sanitizers_find_no_wrong_access() {
    run_sanitized("tour", "detect_leaks=1");
    // Its forked child has no copy of the threads of the parent. What belonged to them counts as leaked.
    run_sanitized("misuse", "detect_leaks=0");
}

/// The example of the book, with an agent in Rust.
#[test]
fn an_agent_in_rust_requests_from_one_in_c() {
    let workshop = Workshop::new();
    let arm = workshop.compile("cc", &bindings("c/examples/arm.c"), "arm", C, SHARED);
    let (mut process, ready) = ChildGuard::until_ready(&mut workshop.command(&arm, &[]));
    assert_eq!(ready.trim(), "arm_1 is ready");
    let domain = workshop.domain();
    let rover = domain.register("rover").wait().expect("a name");
    let ask = |content: &'static str| {
        let message = rover.message(Performative::Request).receiver("arm_1");
        let request = rover.request(message.content(content), TIMEOUT).wait();
        request.and_then(|mut request| request.result().wait())
    };
    let answer = ask("crate").expect("an answer");
    assert_eq!(answer.text(), "lifted");
    let refused = ask("").expect_err("nothing to lift");
    assert!(refused.to_string().contains("lift what?"), "{refused}");
    let subscribe = rover.message(Performative::Subscribe).receiver("arm_1");
    let temperature = rover.subscribe(subscribe.content("temperature"), TIMEOUT);
    let mut temperature = temperature.wait().expect("a subscription");
    let first = temperature.next().wait().expect("a notification");
    assert!(first.message().parse::<u32>().expect("a number") >= 20);

    process.signal("-TERM");
    let status = process.wait();
    assert!(status.success(), "{status}");
    until("the arm is deregistered", || {
        domain.directory().lookup("arm_1").is_none()
    });

    // A killed process leaves no entry.
    let (mut process, _) = ChildGuard::until_ready(&mut workshop.command(&arm, &[]));
    assert!(domain.directory().lookup("arm_1").is_some());
    process.kill();
    until("the entry of the killed arm is removed", || {
        domain.directory().lookup("arm_1").is_none()
    });
    domain.close().wait();
}
