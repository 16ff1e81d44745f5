//! The camera in C++ (`bindings/cpp/examples`) and the detector in Python (`bindings/python/examples`).

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::collections::HashSet;
use std::path::PathBuf;

use common::{Process, RunDomain, Workshop};
use fipa_testbed::can_run;
use fipa_testbed::languages::{bindings, can_import, python};

mod common;

/// Number of images that the detector takes.
const IMAGES: usize = 30;

#[test]
fn a_detector_in_python_finds_the_light_where_the_camera_in_cpp_has_put_it() {
    let test = "the detector";
    if !can_import(test, &["numpy"]) || !can_run(test, &["c++"], true) {
        return;
    }
    let (workshop, domain) = (Workshop::new(), RunDomain::new());
    let program = workshop.compiled(&bindings("cpp/examples/camera.cpp"));
    let camera = Process::start("camera", &mut domain.command(&workshop, &[program]));
    // The agent is registered before the first image.
    let first = camera.line().expect("a position");

    let program = [
        PathBuf::from(python()),
        bindings("python/examples/detector.py"),
    ];
    let mut command = domain.command(&workshop, &program);
    let detector = Process::start("detector", command.arg(IMAGES.to_string()));
    let mut found = detector.ends();
    let summary = found.pop().expect("a summary");
    assert!(summary.starts_with("30 images in "), "{summary}");

    camera.guard.signal("-INT");
    let exposed: HashSet<String> = camera.ends().into_iter().chain([first]).collect();
    let found: HashSet<String> = found.into_iter().collect();
    assert_eq!(found.len(), IMAGES);
    assert_eq!(found.difference(&exposed).collect::<Vec<_>>(), [""; 0]);
    assert_eq!(domain.files(), [""; 0].map(PathBuf::from));
}
