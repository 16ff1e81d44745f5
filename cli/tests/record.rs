//! `fipa record` and `fipa replay` with real processes.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;
#[path = "common/mcap_file.rs"]
#[allow(dead_code, reason = "not all items are used here")]
mod mcap_file;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{Far, Host, Ran, Running};
use fastrand::Rng;
use fipa_testbed::languages::mcap_python;
use mcap_file::{Compression, rechunked};
use serde_json::{Value, json};

/// Starts `fipa record --json` and waits until it records all running processes.
fn record(host: &Host, arguments: &[&str]) -> Running {
    let running = host.start(&[&["record", "--json"], arguments].concat());
    let ready: Value = serde_json::from_str(&running.ready).unwrap();
    assert_eq!(ready["event"], "recording");
    running
}

/// Ends a recording and returns its summary.
fn end(mut recording: Running) -> Value {
    recording.send_signal("-TERM");
    let summary: Value = serde_json::from_str(&recording.line()).unwrap();
    assert_eq!(summary["event"], "summary", "{summary}");
    let (code, errors) = recording.end();
    assert_eq!((code, errors.as_str()), (Some(0), ""));
    summary
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn send(host: &Host, words: &str) {
    let ran = host.run(&words.split(' ').collect::<Vec<_>>());
    assert_eq!(ran.code, Some(0), "{ran:?}");
}

/// Sends a letter of a conversation to `arm_1`.
fn say(host: &Host, act: &str, protocol: &str, id: &str, content: &str) {
    send(
        host,
        &format!(
            "send --from rover --to arm_1 --performative {act} --protocol {protocol} --conversation-id {id} \
             --in-reply-to x --content {content}"
        ),
    );
}

/// The messages that `fipa record to-json` prints.
fn messages(host: &Host, file: &Path, options: &[&str]) -> Vec<Value> {
    let ran = host.run(&[&["record", "to-json", text(file)], options].concat());
    lines(&ran)
}

fn lines(ran: &Ran) -> Vec<Value> {
    let lines = std::str::from_utf8(&ran.stdout).unwrap().lines();
    lines
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

/// The messages of letters among these.
fn letters(all: &[Value]) -> Vec<&Value> {
    let of_letter = |it: &&Value| it["message"]["event"] == "letter";
    all.iter()
        .filter(of_letter)
        .map(|it| &it["message"])
        .collect()
}

/// Reads a file with the Python package `mcap`. Returns the number of messages by topic; `None` without the package.
fn read_with_python(test: &str, file: &Path) -> Option<Value> {
    let program = "
import collections, json, sys
from mcap.reader import make_reader
with open(sys.argv[1], 'rb') as file:
    counts = collections.Counter()
    for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
        counts[channel.topic] += 1
        if channel.message_encoding == 'json':
            json.loads(message.data)
            assert schema.encoding == 'jsonschema' and json.loads(schema.data), channel
print(json.dumps(counts))
";
    let python = mcap_python(test)?;
    let ran = Command::new(python)
        .args(["-c", program])
        .arg(file)
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&ran.stderr);
    assert!(ran.status.success(), "{}: {errors}", file.display());
    Some(serde_json::from_slice(&ran.stdout).unwrap())
}

/// Records a conversation with a violation, and letters with content of different lengths.
fn violation(host: &Host) -> PathBuf {
    let file = host.path("run.mcap");
    let _arm = host.echo("arm_1");
    let recording = record(host, &["-o", text(&file)]);
    say(host, "cfp", "fipa-contract-net", "c1", "dig");
    say(host, "inform", "fipa-contract-net", "c1", "dug");
    let long = host.path("long");
    fs::write(&long, vec![b'x'; 50_000]).unwrap();
    send(
        host,
        &format!(
            "send --from rover --to arm_1 --content-file {}",
            text(&long)
        ),
    );
    let summary = end(recording);
    assert_eq!(
        [
            &summary["letters"],
            &summary["violations"],
            &summary["lost"]
        ],
        [&json!(3), &json!(1), &json!(0)],
        "{summary}"
    );
    assert_eq!(summary["bytes"], fs::metadata(&file).unwrap().len());
    file
}

#[test]
fn letters_and_a_violation_are_recorded() {
    let host = Host::new();
    let file = violation(&host);
    let all = messages(&host, &file, &["--raw"]);
    let found = letters(&all);
    let acts: Vec<&Value> = found.iter().map(|it| &it["performative"]).collect();
    assert_eq!(acts, ["cfp", "inform", "inform"]);
    assert_eq!(found[0]["letter"]["message"]["content"], "dig");
    assert_eq!(found[1]["verdict"]["verdict"], "violation");
    assert_eq!(
        (&found[2]["content_length"], &found[2]["content_cut"]),
        (&json!(50_000), &json!(true))
    );
    let of = |topic: &'static str| all.iter().filter(move |it| it["topic"] == topic);
    // Only the bytes of letters with all their content. They are those of the letters.
    let raw: Vec<&Value> = of("/letters/arm_1/raw").collect();
    assert_eq!(raw.len(), 2, "{raw:?}");
    let bytes = base64::Engine::decode(
        &base64::engine::general_purpose::STANDARD,
        raw[0]["base64"].as_str().unwrap(),
    );
    let decoded = host.run_with_input(&["decode", "--compact"], &bytes.unwrap());
    let decoded: Value = serde_json::from_str(&decoded.done()).unwrap();
    assert_eq!(decoded, found[0]["letter"]);
    let events: Vec<&Value> = of("/events").map(|it| &it["message"]["event"]).collect();
    assert!(events.contains(&&json!("violation")), "{events:?}");
    let here =
        |it: &Value| it["message"]["agent"]["name"] == "arm_1" && it["message"]["at_start"] == true;
    assert!(of("/events").any(here), "{all:#?}");
    // Agents that leave are not in the log.
    let mut log = of("/log").map(|it| &it["message"]);
    let violation = log.next().unwrap();
    assert_eq!(
        (&violation["level"], &violation["name"]),
        (&json!(4), &json!("rover"))
    );
    assert!(log.next().is_none());
    let info = host
        .run(&["record", "info", text(&file), "--json"])
        .done_json();
    let about = &info[0]["metadata"];
    assert_eq!(about["fipa.recording"]["domain"], host.domain);
    assert_eq!(about["fipa.totals"]["letters"], "3");
    let found = info[0]["found"].as_array().unwrap();
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(
        (&found[0]["kind"], &found[0]["count"]),
        (&json!("violation"), &json!(1))
    );
    let shown = host.run(&["record", "info", text(&file)]).done();
    assert!(
        shown.ends_with(&format!("fipa replay {} --check\n", text(&file))),
        "{shown}"
    );
    if let Some(read) = read_with_python("letters_and_a_violation_are_recorded", &file) {
        assert_eq!(read["/letters/arm_1"], 3, "{read}");
        assert!(read["/log"].as_u64() >= Some(1), "{read}");
    }
}

#[test]
fn a_recording_is_filtered() {
    let host = Host::new();
    let file = violation(&host);
    let filtered = host.path("bad.mcap");
    let ran = host.run(&[
        "record",
        "filter",
        text(&file),
        "-o",
        text(&filtered),
        "--violations",
    ]);
    // The letter and its bytes.
    assert!(ran.done().starts_with("2 messages"));
    let all = messages(&host, &filtered, &[]);
    assert_eq!(letters(&all).len(), 1);
    assert_eq!(letters(&all)[0]["number"], 2);
    let checked = host.run(&["replay", text(&filtered), "--check"]);
    assert!(checked.stderr.contains("left out"), "{}", checked.stderr);
    let from = all[0]["time"].as_str().unwrap();
    assert_eq!(messages(&host, &filtered, &["--from", from]).len(), 1);
    assert_eq!(messages(&host, &filtered, &["--until", from]).len(), 0);
    let log = messages(&host, &file, &["--topic", "/log"]);
    assert!(
        !log.is_empty() && log.iter().all(|it| it["topic"] == "/log"),
        "{log:#?}"
    );
    if let Some(read) = read_with_python("a_recording_is_filtered", &filtered) {
        assert_eq!(
            read,
            json!({ "/letters/arm_1": 1, "/letters/arm_1/raw": 1 })
        );
    }
    // An existing file is kept.
    let before = fs::read(&filtered).unwrap();
    let again = host.run(&["record", "-o", text(&filtered)]).failed(1);
    assert!(again.contains("give another name"), "{again}");
    // Standard output takes no recording, and no file gets the name `-`.
    for command in [&["record"][..], &["record", "repair", text(&file)]] {
        let refused = host.run(&[command, &["-o", "-"]].concat()).failed(2);
        assert!(refused.contains("standard output"), "{refused}");
    }
    assert_eq!(fs::read(&filtered).unwrap(), before);
}

/// The channel of one agent can have the name of the channel with the bytes of another one.
#[test]
fn the_name_of_a_receiver_hides_no_letters() {
    let host = Host::new();
    let file = host.path("run.mcap");
    let _agents = ["arm_1", "arm_1/raw", "raw"].map(|name| host.echo(name));
    let recording = record(&host, &["-o", text(&file)]);
    send(&host, "send arm_1 first");
    send(&host, "send arm_1/raw second");
    send(&host, "send raw third");
    // Empty content, whose bytes are recorded, too.
    host.run(&["send", "raw", ""]).done();
    end(recording);
    let all = messages(&host, &file, &["--raw"]);
    let contents: Vec<&Value> = letters(&all)
        .iter()
        .map(|it| &it["letter"]["message"]["content"])
        .collect();
    assert_eq!(contents, ["first", "second", "third", ""]);
    let bytes = all.iter().filter(|it| it["base64"].is_string());
    assert_eq!(bytes.count(), 4);
    let checked = host
        .run(&["replay", text(&file), "--check", "--json"])
        .done_json();
    assert_eq!(checked["letters"], 4, "{checked}");
}

#[test]
fn a_killed_recording_is_repaired() {
    let host = Host::new();
    let file = host.path("run.mcap");
    let _arm = host.echo("arm_1");
    let mut recording = record(&host, &["-o", text(&file), "--sync", "10ms"]);
    for number in 0..20 {
        say(&host, "inform", "none", &format!("c{number}"), "x");
    }
    // Until the letters are on the disk.
    fipa_testbed::until("the letters are in the file", || {
        letters(&messages(&host, &file, &[])).len() >= 20
    });
    recording.send_signal("-KILL");
    let _ = recording.end();
    let repaired = host.path("repaired.mcap");
    let ran = host.run(&["record", "repair", text(&file), "-o", text(&repaired)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(ran.stderr.contains("was not closed"), "{}", ran.stderr);
    let all = messages(&host, &repaired, &[]);
    let ids: Vec<&str> = letters(&all)
        .into_iter()
        .map(|it| it["conversation_id"].as_str().unwrap())
        .collect();
    let expected: Vec<String> = (0..20).map(|number| format!("c{number}")).collect();
    assert_eq!(ids, expected);
    if let Some(read) = read_with_python("a_killed_recording_is_repaired", &repaired) {
        assert_eq!(read["/letters/arm_1"], 20, "{read}");
    }
}

/// The end of each complete chunk of a file with the number of messages up to it.
fn chunks(file: &[u8], count: impl Fn(&[u8]) -> usize) -> Vec<(usize, usize)> {
    let mut ends = Vec::new();
    let mut at = 8;
    while let Some(record) = file.get(at..at + 9) {
        let len = u64::from_le_bytes(record[1..9].try_into().unwrap());
        at += 9 + usize::try_from(len).unwrap();
        // The opcode of a chunk.
        if record[0] == 6 {
            ends.push((at, count(&file[..at])));
        }
    }
    ends
}

#[test]
fn a_cut_file_is_read_to_its_last_complete_chunk() {
    let host = Host::new();
    let path = host.path("run.mcap");
    let _arm = host.echo("arm_1");
    // Many small chunks.
    let recording = record(&host, &["-o", text(&path), "--sync", "1ms"]);
    send(
        &host,
        "send --from rover --to arm_1 --content hello --rate 200 --count 200 --numbered",
    );
    end(recording);
    let file = fs::read(&path).unwrap();
    let count = |part: &[u8]| {
        let ran = host.run_with_input(&["record", "to-json", "-", "--raw"], part);
        assert_eq!(ran.code, Some(0), "{}", ran.stderr);
        lines(&ran).len()
    };
    let ends = chunks(&file, count);
    assert!(ends.len() > 5, "{}", ends.len());
    let mut random = Rng::with_seed(7);
    let mut cut = |file: &[u8]| {
        let length = random.usize(..file.len());
        let expected = ends.iter().rev().find(|(end, _)| *end <= length);
        (length, expected.map_or(0, |(_, messages)| *messages))
    };
    let program = host.path("cuts");
    fs::create_dir(&program).unwrap();
    // One process reads many files.
    for round in 0..10 {
        let cuts: Vec<(usize, usize)> = (0..100).map(|_| cut(&file)).collect();
        let mut arguments = vec!["record".to_owned(), "info".to_owned(), "--json".to_owned()];
        let mut expected = Vec::new();
        for (number, (length, messages)) in cuts.into_iter().enumerate() {
            // A shorter file has not even the magic number and one record.
            if length < 200 {
                continue;
            }
            let path = program.join(format!("{round}-{number}"));
            fs::write(&path, &file[..length]).unwrap();
            arguments.push(text(&path).to_owned());
            expected.push((length, messages));
        }
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let ran = host.run(&arguments);
        assert_eq!(ran.code, Some(0), "{}", ran.stderr);
        let infos: Value = serde_json::from_slice(&ran.stdout).unwrap();
        let infos = infos.as_array().unwrap();
        assert_eq!(infos.len(), expected.len());
        for (info, (length, messages)) in infos.iter().zip(expected) {
            assert_eq!(info["messages"], messages, "{length}: {info}");
        }
    }
}

#[test]
fn hostile_files_are_refused_within_a_limit_of_memory() {
    let host = Host::new();
    let path = host.path("run.mcap");
    let _arm = host.echo("arm_1");
    let recording = record(&host, &["-o", text(&path)]);
    say(&host, "inform", "none", "c1", "x");
    end(recording);
    let file = fs::read(&path).unwrap();
    let mut hostile = Vec::new();
    // A record of an enormous length behind the magic number, and one behind the header.
    let header =
        8 + 9 + usize::try_from(u64::from_le_bytes(file[9..17].try_into().unwrap())).unwrap();
    for opcode in [1, 3, 4, 5, 6, 9, 12] {
        let mut record = vec![opcode];
        record.extend(u64::MAX.to_le_bytes());
        hostile.push([&file[..8], &record].concat());
        hostile.push([&file[..header], &record, &file[header..]].concat());
    }
    // A chunk that announces a few bytes and unpacks to a gigabyte.
    hostile.push([&file[..header], &bomb(100, false)].concat());
    hostile.push([&file[..header], &bomb(1 << 30, true)].concat());
    // An attachment that is too short.
    hostile.push([&file[..header], &[9, 1, 0, 0, 0, 0, 0, 0, 0, 0]].concat());
    let mut random = Rng::with_seed(11);
    for _ in 0..60 {
        let mut changed = file.clone();
        for _ in 0..random.usize(1..8) {
            let at = random.usize(8..changed.len());
            changed[at] = random.u8(..);
        }
        hostile.push(changed);
    }
    for (number, bytes) in hostile.iter().enumerate() {
        let path = host.path("hostile.mcap");
        fs::write(&path, bytes).unwrap();
        for command in [&["record", "to-json", "--raw"][..], &["replay", "--check"]] {
            let mut limited = Command::new("sh");
            let fipa = host.command(&[command, &[text(&path)]].concat());
            // 2 GiB of addresses, of which the threads of the runtime take a part.
            limited.args(["-c", "ulimit -v 2097152; exec \"$0\" \"$@\""]);
            limited.arg(fipa.get_program()).args(fipa.get_args());
            limited
                .env_clear()
                .env("HOME", host.path("home"))
                .current_dir(host.path(""));
            limited.env("TOKIO_WORKER_THREADS", "2");
            let ran = limited.output().unwrap();
            let errors = String::from_utf8_lossy(&ran.stderr);
            assert!(
                matches!(ran.status.code(), Some(0 | 1)),
                "{number}: {:?} {errors}",
                ran.status
            );
            assert!(!errors.contains("panicked"), "{number}: {errors}");
        }
    }
}

#[test]
fn files_with_changed_records_and_valid_checksums_end_no_command() {
    let host = Host::new();
    let path = host.path("run.mcap");
    let _arm = host.echo("arm_1");
    let recording = record(&host, &["-o", text(&path)]);
    say(&host, "inform", "fipa-request", "c1", "x");
    say(&host, "request", "none", "c2", "x");
    end(recording);
    let file = fs::read(&path).unwrap();
    let mut random = Rng::with_seed(5);
    let (changed, copy) = (host.path("changed.mcap"), host.path("copy.mcap"));
    let (changed, to) = (text(&changed), text(&copy));
    let commands: [&[&str]; 5] = [
        &["record", "info", changed],
        &["record", "to-json", changed, "--agent", "arm_1"],
        &["record", "repair", changed, "-o", to],
        &["record", "filter", changed, "-o", to, "--violations"],
        &["replay", changed, "--check"],
    ];
    for number in 0..60 {
        let bytes = rechunked(&file, Compression::None, |records| {
            for _ in 0..random.usize(1..6) {
                let at = random.usize(..records.len());
                // Digits and quotes are in the lengths, the times and the JSON.
                let byte = [random.u8(..), b'9', b'"', b'-', 0, 0xff];
                records[at] = random.choice(byte).unwrap();
            }
        });
        fs::write(changed, &bytes).unwrap();
        let command = commands[number % commands.len()];
        let ran = host.run(command);
        assert!(
            matches!(ran.code, Some(0 | 1)),
            "{number} {command:?}: {ran:?}"
        );
        assert!(
            !ran.stderr.contains("panicked"),
            "{number} {command:?}: {ran:?}"
        );
        // A command that reads no record makes no copy.
        let _ = fs::remove_file(&copy);
    }
}

/// A chunk of zeros in blocks of zstd, each of which is one byte that is repeated (RFC 8878 3.1.1.2).
fn bomb(announced: u64, has_checksum: bool) -> Vec<u8> {
    let mut zstd = vec![0x28, 0xb5, 0x2f, 0xfd, 0x00, 0x58];
    let blocks = 8 * 1024;
    for block in 0..blocks {
        let is_last = u32::from(block + 1 == blocks);
        let block_header = (128 * 1024) << 3 | 1 << 1 | is_last;
        zstd.extend(&block_header.to_le_bytes()[..3]);
        zstd.push(0);
    }
    let mut chunk = Vec::new();
    chunk.extend([0; 16]);
    chunk.extend(announced.to_le_bytes());
    chunk.extend(u32::from(has_checksum).to_le_bytes());
    chunk.extend(4_u32.to_le_bytes());
    chunk.extend(b"zstd");
    chunk.extend((zstd.len() as u64).to_le_bytes());
    chunk.extend(zstd);
    let mut record = vec![6];
    record.extend((chunk.len() as u64).to_le_bytes());
    record.extend(chunk);
    record
}

#[test]
fn a_recording_is_split_and_the_oldest_files_are_deleted() {
    let host = Host::new();
    let path = host.path("run.mcap");
    let _arm = host.echo("arm_1");
    let options = [
        "-o",
        text(&path),
        "--sync",
        "1ms",
        "--split-size",
        "4KiB",
        "--keep",
        "3",
    ];
    // Other files with similar names.
    let others = ["run_20260301.mcap", "run_001.mcap", "run_00001.mcap"];
    for other in others {
        fs::write(host.path(other), "").unwrap();
    }
    let recording = record(&host, &options);
    send(
        &host,
        "send --from rover --to arm_1 --content hello --rate 200 --count 200 --numbered",
    );
    let summary = end(recording);
    let made = summary["files"].as_u64().unwrap();
    assert!(made > 3, "{summary}");
    let files = || {
        let entries = fs::read_dir(path.parent().unwrap()).unwrap();
        let names = entries.map(|it| it.unwrap().file_name().into_string().unwrap());
        let is_part = |it: &String| it.starts_with("run_") && !others.contains(&&**it);
        let mut names: Vec<String> = names.filter(is_part).collect();
        names.sort_unstable();
        names
    };
    let kept: Vec<String> = (made - 3..made)
        .map(|it| format!("run_{it:04}.mcap"))
        .collect();
    assert_eq!(files(), kept);
    // Each file is complete, and tells the agents that are there.
    let mut numbers = Vec::new();
    for file in &kept {
        let all = messages(&host, &host.path(file), &[]);
        assert!(
            all.iter()
                .any(|it| it["message"]["agent"]["name"] == "arm_1"),
            "{all:#?}"
        );
        numbers.extend(
            letters(&all)
                .into_iter()
                .map(|it| it["number"].as_u64().unwrap()),
        );
        read_with_python(
            "a_recording_is_split_and_the_oldest_files_are_deleted",
            &host.path(file),
        );
    }
    let first = numbers[0];
    assert!(numbers.iter().copied().eq(first..=200), "{numbers:?}");
    // Another recording continues.
    end(record(&host, &options));
    assert_eq!(files().last(), Some(&format!("run_{made:04}.mcap")));
    for other in others {
        assert!(host.path(other).exists(), "{other} was deleted");
    }
}

#[test]
fn a_recording_goes_on_after_its_file_is_removed() {
    let host = Host::new();
    let file = host.path("run.mcap");
    let _arm = host.echo("arm_1");
    let mut recording = record(&host, &["-o", text(&file), "--sync", "10ms"]);
    send(&host, "send arm_1 before");
    fs::remove_file(&file).unwrap();
    fipa_testbed::until("there is another file", || file.exists());
    send(&host, "send arm_1 after");
    recording.send_signal("-TERM");
    let summary: Value = serde_json::from_str(&recording.line()).unwrap();
    assert_eq!(summary["files"], 2, "{summary}");
    let (code, errors) = recording.end();
    assert_eq!(code, Some(0));
    assert!(errors.contains("was removed"), "{errors}");
    let all = messages(&host, &file, &[]);
    let contents: Vec<&Value> = letters(&all)
        .iter()
        .map(|it| &it["letter"]["message"]["content"])
        .collect();
    assert_eq!(contents.last().copied(), Some(&json!("after")), "{all:#?}");
}

#[test]
fn a_recording_is_replayed_into_another_domain() {
    let host = Host::new();
    let file = host.path("run.mcap");
    {
        let _arm = host.start(&["listen", "arm_1"]);
        let recording = record(&host, &["-o", text(&file)]);
        say(&host, "request", "fipa-request", "c1", "lift");
        say(&host, "inform", "none", "c2", "a");
        say(&host, "inform", "none", "c2", "b");
        end(recording);
    }
    // It cannot reach the recorded domain by accident.
    let refused = host
        .run(&["replay", text(&file), "--into", &host.domain])
        .failed(2);
    assert!(refused.contains("--live"), "{refused}");
    let lab = Host::new();
    let mut arm = lab.start(&["listen", "arm_1", "--json", "--count", "2"]);
    let replay = [
        "replay",
        text(&file),
        "--into",
        &lab.domain,
        "--only",
        "arm_1",
        "--json",
    ];
    let replayed = lab
        .run(&[&replay[..], &["--speed", "4"]].concat())
        .done_json();
    assert_eq!(
        replayed,
        json!({ "letters": 3, "sent": 2, "failed": 0, "left_out": { "it is a request": 1 } })
    );
    let mut conversations = Vec::new();
    for content in ["a", "b"] {
        let received: Value = serde_json::from_str(&arm.line()).unwrap();
        let message = &received["message"];
        assert_eq!(message["content"], content, "{received:#}");
        assert_eq!(message["sender"]["name"], "replay/rover");
        conversations.push(message["conversation_id"].clone());
    }
    assert_eq!(conversations[0], conversations[1]);
    assert_ne!(conversations[0], "c2");
}

#[test]
fn recorded_letters_are_judged_later() {
    let host = Host::new();
    let (good, bad) = (host.path("good.mcap"), host.path("bad.mcap"));
    let _arm = host.echo("arm_1");
    for (file, acts) in [
        (&good, &["cfp"][..]),
        (&bad, &["cfp", "inform", "accept-proposal"]),
    ] {
        let recording = record(&host, &["-o", text(file)]);
        for act in acts {
            say(&host, act, "fipa-contract-net", text(file), "x");
        }
        end(recording);
    }
    let (good, bad) = (text(&good), text(&bad));
    let shown = host.run(&["replay", good, "--check"]).done();
    assert!(
        shown.starts_with("letters: 1, accepted: 1, violations: 0, unchecked: 0,"),
        "{shown}"
    );
    let judged = host.run(&["replay", bad, "--check", "--json"]);
    assert_eq!(judged.code, Some(1));
    let lines = lines(&judged);
    let events: Vec<&Value> = lines.iter().map(|line| &line["event"]).collect();
    assert_eq!(events, ["violation", "violation", "summary"], "{lines:#?}");
    assert_eq!(
        (&lines[0]["number"], &lines[1]["number"]),
        (&json!(2), &json!(3))
    );
    assert_eq!(lines[1]["kind"], "out-of-order");
    assert_eq!(
        (&lines[2]["letters"], &lines[2]["violations"]),
        (&json!(3), &json!(2))
    );
    assert_eq!(lines[2]["complete"], true);
    assert_eq!(lines[2]["unchecked_reasons"], json!({}));
    // Only another protocol is judged.
    let other = ["replay", bad, "--check", "--protocol", "fipa-request"];
    let other = host.run(&other).done();
    assert!(other.contains("violations: 0"), "{other}");
    assert!(
        other.ends_with("\n  not judged: 3, of another protocol\n"),
        "{other}"
    );
    let named = ["replay", bad, "--check", "--protocol", "contractNet"];
    assert_eq!(host.run(&named).code, Some(1));
    // A file that is no recording.
    let no = host.path("no.mcap");
    fs::write(&no, "<scxml/>").unwrap();
    let failed = host.run(&["replay", text(&no), "--check"]).failed(1);
    assert!(failed.contains("no.mcap"), "{failed}");
}

/// A stopped recorder loses records. The letters after them are not judged by the conversations before.
#[test]
fn lost_records_are_in_the_file() {
    let host = Host::new();
    let file = host.path("run.mcap");
    let mut rover = host.ordered_agent("rover", &[]);
    let _arm = host.ordered_agent("arm_1", &[]);
    let recording = record(&host, &["-o", text(&file)]);
    let mut order = |order: Value, answer: &str| {
        rover.write_line(&order.to_string());
        while !rover.line().contains(answer) {}
    };
    let converse = |act: &str| json!({ "do": "converse", "performative": act, "to": "arm_1", "conversation": "c1" });
    order(converse("cfp"), "outcomes");
    let recorded = || messages(&host, &file, &[]);
    fipa_testbed::until("the first letter is in the file", || {
        letters(&recorded()).len() == 1
    });
    recording.send_signal("-STOP");
    // More than the queues of the processes hold.
    order(
        json!({ "do": "measure", "to": "arm_1", "len": 2000, "rounds": 4000 }),
        "measured",
    );
    recording.send_signal("-CONT");
    let is_lost = |it: &Value| it["message"]["event"] == "lost";
    fipa_testbed::until("the loss is in the file", || recorded().iter().any(is_lost));
    // Its answer would be a violation if the conversation were known.
    order(converse("inform"), "outcomes");
    fipa_testbed::until("the last letter is in the file", || {
        let all = recorded();
        let last = |it: &Value| it["conversation_id"] == "c1" && it["performative"] == "inform";
        letters(&all).into_iter().any(last)
    });
    let summary = end(recording);
    let lost = summary["lost"].as_u64().unwrap();
    assert!(lost > 0, "{summary}");
    let all = messages(&host, &file, &[]);
    let events = all.iter().filter(|it| it["message"]["event"] == "lost");
    let in_file: u64 = events
        .map(|it| it["message"]["records"].as_u64().unwrap())
        .sum();
    assert_eq!(in_file, lost);
    let checked = host.run(&["replay", text(&file), "--check"]).done();
    assert!(checked.contains("violations: 0"), "{checked}");
    let info = host
        .run(&["record", "info", text(&file), "--json"])
        .done_json();
    assert_eq!(
        info[0]["metadata"]["fipa.totals"]["lost_records"],
        lost.to_string()
    );
    let log = all.iter().filter(|it| it["topic"] == "/log");
    let mut log = log.filter_map(|it| it["message"]["message"].as_str());
    assert!(log.any(|it| it.ends_with("records of letters were lost")));
}

/// One agent holds the lock, one gives up, and one gets it.
#[test]
fn an_abandoned_lock_is_in_the_log() {
    let host = Host::new();
    let file = host.path("run.mcap");
    let _crane = host.start(&["own", "bay", "--agent", "crane", "--forget"]);
    let recording = record(&host, &["-o", text(&file)]);
    let mut holder = host.start(&[
        "lock",
        "bay",
        "--agent",
        "rover",
        "--",
        "sh",
        "-c",
        "echo $FIPA_FENCE; exec sleep 600",
    ]);
    let fence = holder.ready.trim().to_owned();
    let late = [
        "lock", "bay", "--agent", "loader", "--within", "10s", "--", "true",
    ];
    assert_eq!(host.run(&late).code, Some(124));
    holder.send_signal("-TERM");
    let _ = holder.end();
    send(&host, "lock bay --agent arm -- true");
    end(recording);
    let events = messages(&host, &file, &["--topic", "/events"]);
    let of_locks = |it: &&Value| it["message"].get("resource").is_some();
    let events: Vec<&Value> = events.iter().filter(of_locks).collect();
    let [event] = events[..] else {
        panic!("{events:#?}");
    };
    let event = &event["message"];
    assert_eq!(event["event"], "lock_abandoned", "{event:#}");
    assert_eq!(
        [
            &event["resource"],
            &event["name"],
            &event["holder"],
            &event["fence"]
        ],
        ["bay", "loader", "rover", &fence]
    );
    assert!(event["seconds"].as_f64().unwrap() > 0.0, "{event:#}");
    let log = messages(&host, &file, &["--topic", "/log"]);
    let text = log[0]["message"]["message"].as_str().unwrap();
    assert!(
        text.starts_with("loader gave up waiting for bay after "),
        "{text}"
    );
    let since = event["held_since"].as_str().unwrap();
    let held = format!("; rover has held it since {since} with fence {fence}");
    assert!(text.ends_with(&held), "{text}");
}

/// The gateway of another host is killed. Its agents leave together, and letters to them fail.
#[test]
fn a_host_that_is_gone_is_one_event() {
    let (host, other) = (Host::new(), Host::new());
    let file = host.path("run.mcap");
    let (
        _gateway,
        Far {
            crex,
            echo: _far,
            name: far,
        },
    ) = Far::connected(&host, &other);
    let recording = record(&host, &["-o", text(&file)]);
    let ask = [
        "send",
        "--from",
        "rover",
        "--to",
        &far,
        "-p",
        "request",
        "--content",
        "x",
    ];
    assert_eq!(host.run(&[&ask[..], &["--wait"]].concat()).code, Some(0));
    crex.send_signal("-KILL");
    let events = || messages(&host, &file, &["--topic", "/events"]);
    let is_gone = |it: &&Value| it["message"]["event"] == "host_gone";
    fipa_testbed::until("the host is gone", || {
        events().iter().any(|it| is_gone(&it))
    });
    assert_ne!(host.run(&ask).code, Some(0));
    end(recording);
    let events = events();
    let gone: Vec<&Value> = events.iter().filter(is_gone).collect();
    assert_eq!(gone.len(), 1, "{gone:#?}");
    let event = &gone[0]["message"];
    assert_eq!(event["host"], "crex");
    let left = events
        .iter()
        .filter(|it| it["message"]["reason"] == "its host is gone");
    assert_eq!(event["agents"], left.count(), "{event:#}");
    let answer = messages(&host, &file, &["--agent", &far]);
    let answer = letters(&answer)
        .into_iter()
        .rfind(|it| it["sender"] == far.as_str());
    assert_eq!(event["last_letter"], answer.unwrap()["time"]);
    let log = messages(&host, &file, &["--topic", "/log"]);
    let of_host = log.iter().filter(|it| it["message"]["name"] == "crex");
    assert_eq!(of_host.count(), 1, "{log:#?}");
    // The letter that was not delivered. Those between the gateways may fail, too.
    let failed = messages(&host, &file, &["--failed", "--agent", "rover"]);
    let letters = letters(&failed);
    assert_eq!((failed.len(), letters.len()), (1, 1), "{failed:#?}");
    assert_eq!(
        [&letters[0]["receiver"], &letters[0]["outcome"]],
        [far.as_str(), "failed"]
    );
    let info = host
        .run(&["record", "info", text(&file), "--json"])
        .done_json();
    let found = info[0]["found"].as_array().unwrap();
    let kinds: Vec<&Value> = found.iter().map(|it| &it["kind"]).collect();
    assert_eq!(kinds, ["letter not delivered", "gone host"]);
}

#[test]
fn topics_are_recorded() {
    let host = Host::new();
    let file = host.path("run.mcap");
    let mut command = host.command(&[
        "publish",
        "battery",
        "charge",
        "-",
        "--type",
        "application/json",
    ]);
    command.stdin(std::process::Stdio::piped());
    let mut battery = Running::new(command);
    let mut recording = host.start(&[
        "record",
        "--json",
        "-o",
        text(&file),
        "--topics",
        "battery/.*",
    ]);
    fipa_testbed::until("the recorder has subscribed", || {
        let topics = host.run(&["topics", "--json"]).done_json();
        topics[0]["topics"][0]["subscribers"] == 1
    });
    for value in 0..50 {
        battery.write_line(&format!("{{\"percent\": {value}}}"));
    }
    fipa_testbed::until("the values are in the file", || {
        messages(&host, &file, &["--topic", "/topics/battery/charge"]).len() >= 50
    });
    recording.send_signal("-INT");
    let summary: Value = serde_json::from_str(&recording.line()).unwrap();
    assert_eq!(
        (&summary["topic_values"], &summary["missed_topic_values"]),
        (&json!(50), &json!(0)),
        "{summary}"
    );
    assert_eq!(recording.end(), (Some(0), String::new()));
    let values = messages(&host, &file, &["--topic", "/topics/battery/charge"]);
    let values: Vec<&Value> = values.iter().map(|it| &it["message"]["percent"]).collect();
    let expected: Vec<Value> = (0..50).map(Value::from).collect();
    assert_eq!(values, expected.iter().collect::<Vec<_>>());
    // They are not recorded as letters, too.
    assert_eq!(
        letters(&messages(&host, &file, &["--agent", "fipa-record-.*"])).len(),
        0
    );
}
