//! `fipa bench`, complete and interrupted. The tests assert no times.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]

use std::process::{Command, Stdio};
use std::time::Duration;

use fipa_testbed::languages::{can_import, install_package, libraries, python};
use serde_json::Value;

fn bench(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fipa"));
    command
        .args(["--set", "monitor.check=enforce", "bench"])
        .args(arguments)
        .stdin(Stdio::null())
        .env_remove("FIPA_CONFIG")
        .current_dir("/");
    command
}

/// The files of the measurement with this process identifier.
fn files(pid: u32) -> Vec<String> {
    let directories = ["/dev/shm".into(), std::env::temp_dir()];
    let names = directories.iter().flat_map(|directory| {
        let entries = std::fs::read_dir(directory).unwrap();
        entries.map(|file| file.unwrap().file_name().to_string_lossy().into_owned())
    });
    names
        .filter(|name| name.contains(&format!("bench-{pid}")))
        .collect()
}

/// The number of processes that the measurement has started.
fn processes(pid: u32) -> usize {
    let mark = format!("domain=bench-{pid}-");
    let entries = std::fs::read_dir("/proc").unwrap().flatten();
    let lines = entries.map(|process| std::fs::read(process.path().join("cmdline")));
    let lines = lines.flatten();
    lines
        .filter(|line| String::from_utf8_lossy(line).contains(&mark))
        .count()
}

fn number(value: &Value) -> f64 {
    value
        .as_f64()
        .unwrap_or_else(|| panic!("{value} is not a number"))
}

/// Runs a quick measurement. Returns its process and its report.
fn measured(arguments: &[&str]) -> (u32, Value) {
    measured_by(&mut bench(arguments))
}

fn measured_by(command: &mut Command) -> (u32, Value) {
    let child = command
        .args(["--quick", "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let pid = child.id();
    let output = child.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    (pid, serde_json::from_slice(&output.stdout).unwrap())
}

/// Runs a quick measurement. Returns its process, its report and its drawing.
fn measured_and_drawn(arguments: &[&str]) -> (u32, Value, String) {
    let directory = tempfile::tempdir().unwrap();
    let picture = directory.path().join("measured.svg");
    let svg = ["--svg", picture.to_str().unwrap()];
    let (pid, report) = measured(&[arguments, &svg].concat());
    (pid, report, std::fs::read_to_string(&picture).unwrap())
}

#[test]
fn every_route_is_measured_with_its_limit() {
    let (pid, report, drawn) = measured_and_drawn(&["--sizes", "100B,20KiB"]);
    assert!(number(&report["machine"]["cores"]) >= 1.0);
    let rows = report["rows"].as_array().unwrap();
    for row in rows {
        let time = |key: &str, at: &str| number(&row[key][at]);
        for key in ["one_way_us", "round_trip_us"] {
            let [p50, p99, p999] = ["p50", "p99", "p999"].map(|at| time(key, at));
            assert!(0.0 < p50 && p50 <= p99 && p99 <= p999, "{row:#}");
        }
        assert!(number(&row["samples"]) >= 8.0, "{row:#}");
        assert!(number(&row["cpu_us_per_letter"]) > 0.0, "{row:#}");
        let is_limit = row["path"].as_str().unwrap().starts_with("raw ");
        assert_eq!(is_limit, row["limit"].is_null(), "{row:#}");
        let encrypted = ["gateways tcp, tls", "gateways quic"];
        let is_encrypted = encrypted.iter().any(|path| row["path"] == *path);
        assert_eq!(is_encrypted, !row["plain"].is_null(), "{row:#}");
        if is_encrypted {
            assert_eq!(row["plain"]["name"], "gateways tcp");
            assert!(number(&row["plain"]["round_trip_ratio"]) > 0.0, "{row:#}");
        }
        if !is_limit {
            assert!(number(&row["ratio"]) > 0.0, "{row:#}");
            assert!(number(&row["limit"]["p50_us"]) > 0.0, "{row:#}");
            assert!(number(&row["rate_per_s"]) > 0.0, "{row:#}");
        }
    }
    let measured = |path: &str, wait: &str, size: u64, fill: &str| {
        rows.iter().any(|row| {
            row["path"] == path && row["wait"] == wait && row["size"] == size && row["fill"] == fill
        })
    };
    for size in [100, 20 << 10] {
        for fill in ["loaned", "filled", "copied"] {
            assert!(measured("shm", "spin", size, fill), "{report:#}");
            assert!(measured("shm", "block", size, fill), "{report:#}");
            assert!(measured("shm, encoded", "spin", size, fill), "{report:#}");
        }
        assert!(measured("unix", "block", size, "copied"), "{report:#}");
        for gateways in ["gateways tcp", "gateways tcp, tls", "gateways quic"] {
            assert!(measured(gateways, "block", size, "copied"), "{report:#}");
        }
        assert!(
            measured("raw unix socket", "block", size, "copied"),
            "{report:#}"
        );
    }
    assert!(drawn.starts_with("<svg") && drawn.contains("raw iceoryx2"));
    assert_eq!(files(pid), Vec::<String>::new());
    assert_eq!(processes(pid), 0);
}

/// Interrupts a measurement when it has started this number of processes.
fn interrupt(part: &str, started: usize) {
    let mut child = bench(&[part])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let pid = child.id();
    while processes(pid) < started {
        assert!(
            child.try_wait().unwrap().is_none(),
            "the command ended early"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    let interrupted = Command::new("kill")
        .args(["-INT", &pid.to_string()])
        .status()
        .unwrap();
    assert!(interrupted.success());
    assert_eq!(child.wait().unwrap().code(), Some(1));
    assert_eq!(files(pid), Vec::<String>::new());
    assert_eq!(processes(pid), 0);
}

#[test]
fn an_interrupted_measurement_leaves_no_files_and_processes() {
    // The processes of raw iceoryx2 start late.
    interrupt("shm", 6);
    interrupt("locks", 2);
}

#[test]
fn locks_need_the_letters_of_their_algorithm() {
    let (pid, report, drawn) = measured_and_drawn(&["locks", "--agents", "8"]);
    assert_eq!(report["notes"], serde_json::json!([]), "{report:#}");
    let rows = report["rows"].as_array().unwrap();
    for hosts in [1, 2] {
        for (algorithm, letters) in [
            ("owner_queue", 3.0),
            ("ricart_agrawala_extended", 2.0 * 7.0 + 3.0),
            ("suzuki_kasami_extended", 8.0 + 3.0),
            ("suzuki_kasami", 3.0),
        ] {
            let mut rows = rows.iter();
            let row = rows.find(|row| row["algorithm"] == algorithm && row["hosts"] == hosts);
            let row = row.unwrap();
            for counted in ["letters_needed", "letters", "letters_by_hand"] {
                assert_eq!(number(&row[counted]), letters, "{row:#}");
            }
            for measured in ["locks_us", "by_hand_us", "ratio", "cpu_us", "cpu_ratio"] {
                assert!(number(&row[measured]) > 0.0, "{row:#}");
            }
        }
    }
    let hand_overs = report["hand_overs"].as_array().unwrap();
    assert_eq!(hand_overs.len(), 6);
    for hand_over in hand_overs {
        for measured in [
            "locks_us",
            "by_hand_us",
            "letter_us",
            "ratio",
            "letter_ratio",
        ] {
            assert!(number(&hand_over[measured]) > 0.0, "{hand_over:#}");
        }
    }
    let resources = &report["resources"];
    assert_eq!(number(&resources["agents"]), 8.0);
    assert!(number(&resources["held"]["private_bytes"]) > 0.0);
    assert!(drawn.starts_with("<svg") && drawn.contains("suzuki_kasami_extended, 8 agents"));
    assert_eq!(files(pid), Vec::<String>::new());
    assert_eq!(processes(pid), 0);
}

#[test]
fn publications_for_1_4_and_16_subscribers_are_measured() {
    let (pid, report) = measured(&["topics"]);
    assert_eq!(report["notes"], serde_json::json!([]), "{report:#}");
    let rows = report["rows"].as_array().unwrap();
    let subscribers: Vec<f64> = rows.iter().map(|row| number(&row["subscribers"])).collect();
    assert_eq!(subscribers, [1.0, 4.0, 16.0]);
    for row in rows {
        for measured in ["fipa_us", "iceoryx2_us", "ratio", "cpu_us"] {
            assert!(number(&row[measured]) > 0.0, "{row:#}");
        }
        assert!(row["zenoh_us"].is_null(), "{row:#}");
    }
    assert_eq!(files(pid), Vec::<String>::new());
    assert_eq!(processes(pid), 0);
}

#[test]
fn answered_messages_are_measured_between_rust_and_python() {
    if !can_import("answered messages in Python", &[]) {
        return;
    }
    // A dependency on the module would make maturin pack the command for one version of Python. The tests of the
    // workspace build it.
    if !libraries().join("libfipa_python.so").exists() {
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "the module for Python is missing");
        eprintln!("SKIPPED, not a success: run `cargo build -p fipa-python` first");
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    install_package(directory.path());
    let mut command = bench(&["languages", "--python", &python()]);
    let (pid, report) = measured_by(command.env("PYTHONPATH", directory.path()));
    let rows = report["rows"].as_array().unwrap();
    for size in [1 << 10, 1 << 20] {
        for mechanism in [
            "rust to rust",
            "python to rust",
            "python to rust, asyncio",
            "python to python",
            "python to python, asyncio",
            "multiprocessing pipe",
            "multiprocessing shared memory",
        ] {
            let mut rows = rows.iter();
            let row = rows.find(|row| row["mechanism"] == mechanism && row["size"] == size);
            let row = row.unwrap_or_else(|| panic!("{mechanism}, {size}: {report:#}"));
            for measured in ["round_trip_us", "ratio", "cpu_us"] {
                assert!(number(&row[measured]) > 0.0, "{row:#}");
            }
            let is_other = mechanism.starts_with("multiprocessing");
            assert_eq!(is_other, row["python_ratio"].is_number(), "{row:#}");
            let has_target = mechanism == "python to rust" || is_other && size == 1 << 20;
            assert_eq!(has_target, row["target"].is_string(), "{row:#}");
        }
    }
    assert_eq!(files(pid), Vec::<String>::new());
    assert_eq!(processes(pid), 0);
}

#[test]
fn a_python_without_the_package_is_refused_with_a_remedy() {
    if !can_import("a Python without the package", &[]) {
        return;
    }
    // Without the packages of the user and of the system.
    let directory = tempfile::tempdir().unwrap();
    let isolated = directory.path().join("python");
    let script = format!("#!/bin/sh\nexec {} -I -S \"$@\"\n", python());
    std::fs::write(&isolated, script).unwrap();
    let executable = std::os::unix::fs::PermissionsExt::from_mode(0o700);
    std::fs::set_permissions(&isolated, executable).unwrap();
    let nowhere = directory.path().join("nowhere");
    for (interpreter, expected) in [(&isolated, "pip install fipa"), (&nowhere, "cannot start")] {
        let mut command = bench(&["languages", "--quick", "--python"]);
        let output = command.arg(interpreter).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(errors.contains(expected), "{errors}");
    }
}

#[test]
fn locks_of_a_wrong_number_of_agents_are_refused() {
    for (arguments, expected) in [
        (["locks", "--agents", "1"], "locks of 1 agents"),
        (["shm", "--agents", "2"], "only for `fipa bench locks`"),
    ] {
        let output = bench(&arguments).output().unwrap();
        assert!(!output.status.success());
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(errors.contains(expected), "{errors}");
    }
}

/// A baseline with this ratio in all rows of a path, and no spread.
fn baseline(file: &std::path::Path, ratio: f64) {
    let rows: Vec<Value> = ["loaned", "filled", "copied"]
        .iter()
        .map(|fill| {
            serde_json::json!({
                "path": "shm", "wait": "spin", "size": 100, "fill": fill,
                "ratio": ratio, "ratio_spread": [ratio, ratio],
                "round_trip_ratio": ratio, "round_trip_ratio_spread": [ratio, ratio],
            })
        })
        .collect();
    let text = serde_json::json!({ "rows": rows }).to_string();
    std::fs::write(file, text).unwrap();
}

#[test]
fn a_run_is_compared_with_an_earlier_one() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("before.json");
    let compare = |ratio| {
        baseline(&file, ratio);
        let mut command = bench(&["shm", "--quick", "--sizes", "100B", "--baseline"]);
        let output = command.arg(&file).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        (output.status.code(), text)
    };
    let (code, text) = compare(0.001);
    assert!(text.contains("slower: shm, spin, 100 B loaned"), "{text}");
    assert_eq!(code, Some(1));
    let (code, text) = compare(1000.0);
    assert!(text.contains("faster: shm, spin, 100 B copied"), "{text}");
    assert_eq!(code, Some(0));
    assert!(text.contains("In short, 100 B copied"), "{text}");
    std::fs::write(&file, "{}").unwrap();
    let mut command = bench(&["shm", "--baseline"]);
    let output = command.arg(&file).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(errors.contains("not the JSON output"), "{errors}");
}

#[test]
fn the_next_measurement_removes_what_a_killed_one_left() {
    let mut child = bench(&["shm"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let pid = child.id();
    while processes(pid) < 6 {
        assert!(
            child.try_wait().unwrap().is_none(),
            "the command ended early"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    while processes(pid) > 0 {
        std::thread::sleep(Duration::from_millis(5));
    }
    // The measurement of another test leaves the files of a process whose end is not known yet.
    assert_ne!(files(pid), Vec::<String>::new());
    child.wait().unwrap();
    let next = bench(&["shm", "--quick", "--sizes", "100B"])
        .stdout(Stdio::null())
        .status()
        .unwrap();
    assert!(next.success());
    assert_eq!(files(pid), Vec::<String>::new());
}

#[test]
fn the_evaluation_of_the_paper_is_repeated() {
    let directory = tempfile::tempdir().unwrap();
    let output = bench(&["paper", "--quick", "--json", "--dir"])
        .arg(directory.path())
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(number(&report["machine"]["cores"]) >= 1.0);
    assert!(number(&report["cycles"]) >= 1.0);

    let messages = ["bit-efficient", "string", "XML"];
    let letters = |message: &'static str| {
        let envelopes = [Value::Null, "bit-efficient".into(), "XML".into()];
        envelopes.map(|envelope| (Value::from(message), envelope))
    };
    let pairs: Vec<_> = messages.into_iter().flat_map(letters).collect();
    let is_of =
        |row: &Value, pair: &(Value, Value)| row["message"] == pair.0 && row["envelope"] == pair.1;
    let sizes = report["sizes"].as_array().unwrap();
    let times = report["times"].as_array().unwrap();
    assert_eq!((sizes.len(), times.len()), (pairs.len(), 3 * pairs.len()));
    for pair in &pairs {
        let size = sizes.iter().find(|row| is_of(row, pair)).unwrap();
        assert!(number(&size["bytes"]) > 100.0, "{size:#}");
        for content in [1, 1 << 10, 1 << 20] {
            let mut rows = times.iter().filter(|row| is_of(row, pair));
            let row = rows.find(|row| row["content"] == content).unwrap();
            for key in ["encode_us", "decode_us"] {
                assert!(number(&row[key]["mean"]) > 0.0, "{row:#}");
                assert!(number(&row[key]["deviation"]) >= 0.0, "{row:#}");
            }
        }
    }
    let bytes = |message: &str, envelope: Value| {
        let pair = (message.into(), envelope);
        number(&sizes.iter().find(|row| is_of(row, &pair)).unwrap()["bytes"])
    };
    assert!(bytes("bit-efficient", Value::Null) < bytes("string", Value::Null));
    assert!(bytes("string", Value::Null) < bytes("XML", Value::Null));

    let written = |name: &str| std::fs::read_to_string(directory.path().join(name)).unwrap();
    let tables = written("paper.md");
    assert!(tables.contains("measured elsewhere"), "{tables}");
    assert!(
        tables.contains("| bit-efficient | XML | 1 MiB |"),
        "{tables}"
    );
    for picture in ["paper-sizes.svg", "paper-times.svg"] {
        assert!(tables.contains(picture), "{tables}");
        let drawn = written(picture);
        assert!(drawn.starts_with("<svg"), "{picture}");
        assert!(drawn.contains("string in XML envelope"), "{picture}");
        assert!(drawn.contains("C++, measured elsewhere"), "{picture}");
    }
}

#[test]
fn invalid_options_have_exit_code_2() {
    let cases: [(&[&str], &str); 9] = [
        (&["shm", "--sizes", "1GiB"], "--sizes"),
        (&["shm", "--dir", "/tmp"], "--dir"),
        (&["paper", "--svg", "/dev/null"], "--svg"),
        (&["paper", "--baseline", "/dev/null"], "--baseline"),
        (&["paper", "--dir", "/nowhere"], "--dir"),
        (&["topics", "--svg", "/dev/null"], "--svg"),
        (&["topics", "--baseline", "/dev/null"], "--baseline"),
        (&["topics", "--python", "python3"], "--python"),
        (&["languages", "--svg", "/dev/null"], "--svg"),
    ];
    for (arguments, wrong) in cases {
        let output = bench(arguments).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(errors.contains(wrong), "{errors}");
    }
}
