//! `fipa listen`, `request`, `subscribe` and `ping`, and `fipa send` that repeats and that collects
//! proposals. The agents are those of a process of its own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::env;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::thread;
use std::time::Duration;

use common::Host;
use fipa::blocking::{Wait, on_thread};
use fipa::config::Sources;
use fipa::protocol::{DialogueError, Reply, Task};
use fipa::{Config, Domain};
use fipa_acl::is_unprintable;
use fipa_testbed::{ChildGuard, ignored_test, until};
use serde_json::{Value, json};

/// Longer than any step takes, also on a busy machine.
const TIMEOUT: Duration = Duration::from_secs(60);

/// A text that controls a terminal and forges a line.
const HOSTILE: &str = "x\u{1b}]0;t\u{7}\u{9b}31m\u{202e}\r\nerror: forged";

#[test]
#[ignore = "is run by the other tests as a process of its own"]
fn inside_agents() {
    let domain = env::var("FIPA_TEST_DOMAIN").unwrap();
    let config = Config::load(&Sources {
        set: vec![
            format!("domain={domain}"),
            "discovery.mdns=false".to_owned(),
        ],
        ..Sources::default()
    });
    let domain = Domain::open(&config.unwrap()).wait().unwrap();
    let mut servers = Vec::new();
    let mut arms = Vec::new();
    for (name, price) in [("arm_1", "30"), ("arm_2", "10"), ("arm_3", "20")] {
        let arm = domain.register(name).wait().unwrap();
        servers.push(
            arm.serve("fipa-request", |task| on_thread(|| act(task)))
                .unwrap(),
        );
        let bid = move |mut task: Task| async move {
            match task.propose(price, TIMEOUT).await? {
                true => Ok::<_, DialogueError>(Reply::Inform("carried".into())),
                false => {
                    mark(&format!("rejected-{name}"));
                    Ok(Reply::Nothing)
                }
            }
        };
        servers.push(arm.serve("fipa-contract-net", bid).unwrap());
        arms.push(arm);
    }
    let battery = domain.register("battery").wait().unwrap();
    let charge = battery.publisher("charge").unwrap();
    mark("ready");
    loop {
        charge.publish("80.5").wait();
        thread::sleep(Duration::from_millis(20));
    }
}

/// Handles a request, depending on its content.
fn act(mut task: Task) -> Result<Reply, DialogueError> {
    let action = task.message().text();
    match action.as_str() {
        "refuse" => return Ok(Reply::Refuse("too heavy".into())),
        "hostile" => return Ok(Reply::Refuse(HOSTILE.into())),
        "explain" => return Ok(Reply::Refuse(long_reason().into())),
        _ => task.agree("").wait()?,
    }
    match action.as_str() {
        "fail" => Ok(Reply::Failure("it fell".into())),
        "fail at length" => Ok(Reply::Failure(long_reason().into())),
        "wait" => {
            match task.cancelled().wait_within(TIMEOUT) {
                Some(canceled) => canceled?,
                None => return Ok(Reply::Failure("no cancel".into())),
            }
            mark("canceled");
            task.confirm_cancel().wait()
        }
        _ => Ok(Reply::Inform("lifted".into())),
    }
}

/// A reason as a platform writes it. Its end is the part that helps.
fn long_reason() -> String {
    let start = "((action (agent-identifier :name rover@robot) (ACLMessage)) (MTS-error ".repeat(3);
    format!("{start}(internal-error {HOSTILE}\"Agent not found: nobody@jade\")))")
}

/// Creates an empty file for the test.
fn mark(name: &str) {
    let directory = env::var_os("FIPA_TEST_DIR").unwrap();
    fs::write(Path::new(&directory).join(name), "").unwrap();
}

/// Starts the process of the agents.
fn agents(host: &Host) -> ChildGuard {
    let process = ChildGuard::start(
        ignored_test("inside_agents")
            .env("FIPA_TEST_DOMAIN", &host.domain)
            .env("FIPA_TEST_DIR", host.path(""))
            .env("FIPA_RUNTIME_DIR", host.path("run"))
            .stdin(Stdio::null())
            .stdout(Stdio::null()),
    );
    until("the agents are ready", || host.path("ready").exists());
    process
}

#[track_caller]
fn harmless(text: &str) {
    let found = text.chars().find(|&c| c != '\n' && is_unprintable(c));
    assert_eq!(found, None, "{text:?}");
    assert!(
        !text.lines().any(|line| line.starts_with("error: forged")),
        "{text}"
    );
}

#[test]
fn listen_prints_messages_and_answers_none() {
    let host = Host::new();
    let mut listen = host.start(&["listen", "monitor", "--count", "2"]);
    let ready = format!("agent monitor of domain {} is listening", host.domain);
    assert!(listen.ready.starts_with(&ready), "{}", listen.ready);
    let send = [
        "send",
        "--to",
        "monitor",
        "--from",
        "rover",
        "-p",
        "query-ref",
    ];
    host.run(&[&send[..], &["--content", HOSTILE]].concat())
        .done();
    let line = listen.line();
    assert!(
        line.starts_with("via shm: (query-ref :sender rover"),
        "{line}"
    );
    harmless(&line);
    let unanswered = ["--content", "x", "--wait", "--timeout", "50ms", "--json"];
    let (json, _) = host.run(&[&send[..], &unanswered].concat()).failed_json();
    assert_eq!(json.get("reply"), None);
    assert!(listen.line().contains("\"x\""));
    assert_eq!(listen.end(), (Some(0), String::new()));

    let mut listen = host.start(&["listen", "monitor", "--json"]);
    let ready: Value = serde_json::from_str(&listen.ready).unwrap();
    assert_eq!(ready, json!({ "agent": "monitor", "domain": host.domain }));
    host.run(&[&send[..], &["--content", HOSTILE]].concat())
        .done();
    let line = listen.line();
    harmless(&line);
    let line: Value = serde_json::from_str(&line).unwrap();
    assert_eq!(
        (&line["via"], &line["message"]["content"]),
        (&json!("shm"), &json!(HOSTILE))
    );
    assert_eq!(listen.signal("-INT"), (Some(0), String::new()));
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
}

#[test]
fn request_prints_the_agreement_and_the_result() {
    let host = Host::new();
    let _agents = agents(&host);
    let printed = host.run(&["request", "arm_1", "lift"]).done();
    let (agreed, result) = printed.split_once('\n').unwrap();
    assert_eq!(agreed, "arm_1 agreed");
    assert!(
        result.starts_with("result: (inform :sender arm_1"),
        "{result}"
    );
    let json = host
        .run(&["request", "arm_1", "lift", "--json"])
        .done_json();
    assert_eq!(
        (&json["agreed"], &json["result"]["content"]),
        (&json!(true), &json!("lifted"))
    );

    let error = host.run(&["request", "arm_1", "refuse"]).failed(1);
    assert!(
        error.starts_with("error: the other side refused: too heavy (refuse "),
        "{error}"
    );
    assert!(error.contains("too heavy"), "{error}");
    harmless(&host.run(&["request", "arm_1", "hostile"]).failed(1));
    let send = ["send", "--to", "arm_1", "--performative", "request"];
    let more = [
        "--protocol",
        "fipa-request",
        "--wait",
        "--content",
        "explain",
    ];
    let answered = host.run(&[&send[..], &more].concat()).done();
    for text in [
        host.run(&["request", "arm_1", "explain"]).failed(1),
        host.run(&["request", "arm_1", "fail at length"])
            .failed_text()
            .1,
        answered,
    ] {
        harmless(&text);
        assert!(text.contains("Agent not found: nobody@jade"), "{text}");
    }
    let (json, _) = host
        .run(&["request", "arm_1", "fail", "--json"])
        .failed_json();
    assert_eq!(
        (&json["agreed"], &json["failed"]["content"]),
        (&json!(true), &json!("it fell"))
    );
    let error = host.run(&["request", "unknown", "lift"]).failed(1);
    assert!(error.contains("no such agent"), "{error}");
}

#[test]
fn a_signal_cancels_a_request() {
    let host = Host::new();
    let _agents = agents(&host);
    let request = host.start(&["request", "arm_1", "wait"]);
    assert_eq!(request.ready, "arm_1 agreed");
    let (code, error) = request.signal("-INT");
    assert_eq!(code, Some(1));
    assert!(error.contains("error: canceled by a signal"), "{error}");
    until("the arm knows it", || host.path("canceled").exists());
}

#[test]
fn subscribe_prints_notifications_until_its_end() {
    let host = Host::new();
    let _agents = agents(&host);
    let two = host.run(&["subscribe", "battery", "charge", "--count", "2"]);
    assert_eq!((two.code, &two.stdout[..]), (Some(0), &b"80.5\n80.5\n"[..]));
    for part in ["2 values: ", " Hz, ", " ms on average (min ", " 4 B, "] {
        assert!(two.stderr.contains(part), "{}", two.stderr);
    }
    assert!(two.stderr.ends_with(" missed\n"), "{}", two.stderr);
    let once = ["subscribe", "battery", "charge", "--once"];
    assert_eq!(host.run(&once).done(), "80.5\n");
    host.run(&[&once[..], &["--count", "2"]].concat()).failed(2);
    let full = ["subscribe", "battery", "charge", "--count", "1", "--full"];
    let printed = host.run(&full).done();
    assert!(printed.contains(":content \"80.5\""), "{printed}");

    let mut subscription = host.start(&["subscribe", "battery", "charge", "--json"]);
    assert_eq!(subscription.ready, "{\"subscribed\":\"battery\"}");
    let line: Value = serde_json::from_str(&subscription.line()).unwrap();
    assert_eq!(line["notification"]["content"], "80.5");
    assert_eq!(subscription.signal("-INT"), (Some(0), String::new()));

    let rate = ["subscribe", "battery", "charge", "--rate"];
    let mut rates = host.start(&rate);
    for line in [rates.ready.clone(), rates.line()] {
        assert!(line.contains(" Hz, ") && line.contains(" 4 B, "), "{line}");
    }
    let (code, summary) = rates.signal("-INT");
    assert_eq!(code, Some(0));
    assert!(summary.contains(" values: "), "{summary}");
    let mut rates = host.start(&[&rate[..], &["--json"]].concat());
    let line: Value = serde_json::from_str(&rates.line()).unwrap();
    assert!(line["values"].as_u64() > Some(1), "{line}");
    assert!(
        line["rate"].is_number() && line["avg"].is_number(),
        "{line}"
    );
    assert_eq!(rates.signal("-INT"), (Some(0), String::new()));

    let unknown = host.run(&["subscribe", "battery", "voltage"]).failed(1);
    assert!(unknown.contains("topics: charge"), "{unknown}");
}

#[test]
fn publish_gives_each_subscriber_the_newest_value() {
    let host = Host::new();
    let publish = ["publish", "battery", "charge", "80.5"];
    let publishing = host.start(&publish);
    let ready = "publishing charge as battery; press Ctrl-C to stop";
    assert_eq!(publishing.ready, ready);
    for _ in 0..2 {
        let subscribe = ["subscribe", "battery", "charge", "--count", "1"];
        assert_eq!(host.run(&subscribe).done(), "80.5\n");
    }
    assert_eq!(publishing.signal("-INT"), (Some(0), String::new()));

    // Bytes of a file arrive unchanged.
    let image: Vec<u8> = (0..=255).cycle().take(100_000).collect();
    let file = host.path("image");
    fs::write(&file, &image).unwrap();
    let file = file.to_str().unwrap();
    let publish = ["publish", "camera", "image", "--content-file", file];
    let publishing = host.start(&[&publish[..], &["--rate", "100", "--json"]].concat());
    let mut subscribe = host.command(&["subscribe", "camera", "image", "--raw", "--count", "2"]);
    let received = subscribe.output().unwrap();
    assert!(received.status.success(), "{received:?}");
    assert!(received.stdout == [&image[..], &image].concat());
    let summary = String::from_utf8(received.stderr).unwrap();
    assert!(summary.starts_with("2 values: "), "{summary}");
    let (code, _) = publishing.signal("-INT");
    assert_eq!(code, Some(0));
}

#[test]
fn topics_lists_topics_with_their_rates_and_subscribers() {
    let host = Host::new();
    let publish = ["publish", "camera", "image", "xyz", "--rate", "100"];
    let _camera = host.start(&[&publish[..], &["--type", "text/plain"]].concat());
    let mut viewer = host.start(&["subscribe", "camera", "image", "--json"]);
    viewer.line();
    // Without a gateway, all agents are asked.
    let alone = host.run(&["topics"]).done();
    assert!(alone.contains("camera"), "{alone}");
    let gateway = host.start(&["up", "--set", "discovery.mdns=false"]);
    until("the gateway lists the topic", || {
        let listed: Value = serde_json::from_str(&host.run(&["topics", "--json"]).done()).unwrap();
        let topic = &listed[0]["topics"][0];
        listed[0]["agent"] == "camera"
            && topic["media_type"] == "text/plain"
            && topic["rate"] == 100.0
            && topic["subscribers"] == 1
    });
    let one = host.run(&["topics", "camera"]).done();
    for part in ["text/plain", "(100)", "fipa-subscribe-", "latest(1)"] {
        assert!(one.contains(part), "{one}");
    }
    viewer.send_signal("-STOP");
    let stopped = host.run(&["topics", "camera"]).done();
    for part in ["is stopped, by SIGSTOP", "`kill -CONT"] {
        assert!(stopped.contains(part), "{stopped}");
    }
    let stopped: Value =
        serde_json::from_str(&host.run(&["topics", "camera", "--json"]).done()).unwrap();
    assert!(stopped[0]["topics"][0]["first_subscribers"][0]["stopped"].is_u64());
    viewer.send_signal("-CONT");
    let mut watched = host.start(&["topics", "--watch"]);
    while !watched.line().starts_with("AGENT") {}
    assert_eq!(watched.signal("-INT").0, Some(0));
    let tip = "fipa subscribe camera image";
    for (arguments, code) in [
        (&["subscribe", "camera/image"][..], 2),
        (&["subscribe", "/camera/image"], 2),
        (&["subscribe", "camera/image", "image"], 1),
        (&["topics", "camera/image"], 1),
    ] {
        let split = host.run(arguments).failed(code);
        assert!(split.contains(tip), "{arguments:?}: {split}");
    }
    let refused = host.run(&["subscribe", "camera", "imag"]).failed(1);
    for part in ["topics: image", "`fipa topics camera`"] {
        assert!(refused.contains(part), "{refused}");
    }
    assert!(!refused.contains(":conversation-id"), "{refused}");
    let unknown = host.run(&["topics", "unknown"]).failed(1);
    assert!(unknown.contains("no such agent"), "{unknown}");
    drop(gateway);
}

#[test]
fn a_topic_in_place_of_an_agent_leads_to_its_publisher() {
    let host = Host::new();
    let alone = host.run(&["subscribe", "odom"]).failed(2);
    assert!(!alone.contains("tip:"), "{alone}");
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
    let base = host.start(&["publish", "base", "odom", "1.5", "--rate", "100"]);
    for word in ["odom", "/odom"] {
        let error = host.run(&["topics", word]).failed(1);
        let expected = format!(
            "error: there is no agent \"{word}\"\nwhere: domain {}\n \
             help: \"odom\" is a topic of base: fipa topics base\n",
            host.domain
        );
        assert_eq!(error, expected);
        let error = host.run(&["subscribe", word]).failed(2);
        let tip = "tip: \"odom\" is a topic of base: fipa subscribe base odom";
        assert!(error.contains(tip), "{error}");
    }
    let error = host.run(&["subscribe", "base"]).failed(2);
    let tip = "tip: fipa topics base lists the topics of base";
    assert!(error.contains(tip), "{error}");
    let _second = host.start(&["publish", "base_2", "odom", "1.5"]);
    let error = host.run(&["topics", "odom"]).failed(1);
    let several = "\"odom\" is a topic of base, base_2: fipa topics base\n";
    assert!(error.contains(several), "{error}");
    base.send_signal("-STOP");
    let error = host.run(&["topics", "base"]).failed(1);
    let stopped = format!("the process {} of base is stopped", base.pid());
    assert!(error.contains(&stopped), "{error}");
    base.send_signal("-CONT");
}

#[test]
fn publish_sends_the_lines_of_its_input_and_ends_with_it() {
    let host = Host::new();
    let mut publish = host.command(&["publish", "door", "events", "-", "--json"]);
    let mut publish = publish
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(publish.stdout.take().unwrap()).lines();
    assert!(
        lines
            .next()
            .unwrap()
            .unwrap()
            .contains("\"publishing\":\"events\"")
    );
    let mut subscription = host.start(&["subscribe", "door", "events", "--json"]);
    let mut input = publish.stdin.take().unwrap();
    input.write_all(b"opened\nclosed\nlast").unwrap();
    drop(input);
    for (content, number) in [("opened", 1), ("closed", 2), ("last", 3)] {
        let line: Value = serde_json::from_str(&subscription.line()).unwrap();
        let notification = &line["notification"];
        assert_eq!(notification["content"], content, "{number}");
        assert_eq!(line["missed"], 0);
        assert!(line["age_ms"].is_u64(), "{line}");
    }
    assert!(publish.wait().unwrap().success());
    let last = lines.last().unwrap().unwrap();
    let last: Value = serde_json::from_str(&last).unwrap();
    assert_eq!(
        (&last["published"], &last["delivered"]),
        (&json!(3), &json!(3))
    );
}

#[test]
fn the_receiver_and_the_content_of_send_need_no_options() {
    let host = Host::new();
    let mut listen = host.start(&["listen", "arm_1"]);
    host.run(&["send", "arm_1", "hello"]).done();
    assert!(listen.line().contains(":content \"hello\""));
    host.run(&["send", "arm_1", "--", "-1"]).done();
    assert!(listen.line().contains(":content \"-1\""));
    let twice = host.run(&["send", "--to", "arm_1", "hello"]).failed(2);
    assert!(twice.contains("fipa send NAME TEXT"), "{twice}");
    host.run(&["send"]).failed(2);
}

#[test]
fn content_that_is_no_text_is_not_printed() {
    let host = Host::new();
    let file = host.path("image");
    fs::write(&file, [255; 300]).unwrap();
    let publish = ["publish", "camera", "image", "--content-file"];
    let _camera = host.start(&[&publish[..], &[file.to_str().unwrap()]].concat());
    let seen = host.run(&["subscribe", "camera", "image", "--count", "1"]);
    assert_eq!(
        seen.done(),
        "300 bytes that are no text; --raw prints them\n"
    );
}

#[test]
fn words_of_other_tools_lead_to_the_command() {
    let host = Host::new();
    for (word, command) in [
        ("topic", "'topics', 'publish', 'subscribe'"),
        ("list", "'agents'"),
        ("ps", "'agents'"),
        ("node", "'agents'"),
        ("hz", "tip: fipa subscribe NAME TOPIC --rate"),
        ("hz", "'subscribe', 'topics'"),
        ("bag", "tip: fipa record -o FILE"),
        ("service", "tip: fipa request NAME CONTENT"),
        ("service", "'request', 'actions', 'df'"),
        ("run", "'up'"),
        ("launch", "'up'"),
        ("param", "'config'"),
    ] {
        let error = host.run(&[word]).failed(2);
        assert!(error.contains(command), "{word}: {error}");
    }
}

#[test]
fn the_help_has_the_words_of_ros() {
    let host = Host::new();
    let help = |arguments: &[&str]| {
        let help = host.run(arguments).done();
        help.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let all = help(&["--help"]);
    for words in [
        "node list -> fipa agents",
        "topic hz -> fipa subscribe --rate",
    ] {
        assert!(all.contains(words), "{all}");
    }
    let topics = help(&["topics", "--help"]);
    let rate = "RATE is the publisher's own rate over its last 32 values";
    assert!(topics.contains(rate), "{topics}");
    let subscribe = help(&["subscribe", "--help"]);
    let summary = "Print the values of a topic Leads the protocol fipa-subscribe (FIPA00035)";
    assert!(subscribe.starts_with(summary), "{subscribe}");
    let stream = "A topic is a stream if its publisher declares a rate or loans the contents";
    assert!(subscribe.contains(stream), "{subscribe}");
}

#[test]
fn ping_names_a_stopped_process_first() {
    let host = Host::new();
    let arm = host.echo("arm");
    arm.send_signal("-STOP");
    let pid = arm.pid();
    let ping = ["ping", "arm", "--count", "1", "--set", "mts.deadline=300ms"];
    let (_, error) = host.run(&ping).failed_text();
    let stopped = format!(
        "the process {pid} of arm is stopped, by SIGSTOP, Ctrl-Z or a debugger; continue it: `kill -CONT {pid}`"
    );
    assert!(
        error.starts_with(&format!("warning: {stopped}\nerror: 1 of 1 pings")),
        "{error}"
    );
    assert!(error.contains(&format!(" help: {stopped}\n")), "{error}");
    arm.send_signal("-CONT");
}

/// Whether a process handles SIGINT by itself.
fn handles_interrupts(pid: u32) -> bool {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let caught = status.lines().find_map(|it| it.strip_prefix("SigCgt:"));
    u64::from_str_radix(caught.unwrap().trim(), 16).unwrap() & 0b10 != 0
}

#[test]
fn a_signal_ends_a_command_that_waits_for_the_directory() {
    let host = Host::new();
    let _arm = host.echo("arm");
    let directory = host.path("run").join(&host.domain).join("directory");
    // As a process that is stopped in the middle of a change.
    let lock = fs::File::open(directory.join("lock")).unwrap();
    lock.lock().unwrap();
    let commands = [
        vec!["agents", "--watch"],
        vec!["coalition", "pair", "arm"],
        vec!["echo", "crane"],
        vec!["listen", "crane"],
        vec!["lock", "bay", "--", "true"],
        vec!["locks", "--watch"],
        vec!["own", "bay", "--volatile"],
        vec!["ping", "arm"],
        vec!["record", "--output", "run.mcap"],
        vec!["send", "arm", "hello", "--rate", "1"],
        vec!["top"],
        vec!["up"],
        vec!["watch"],
    ];
    let waiting = commands.map(|arguments| {
        let mut command = host.command(&arguments);
        command.stdout(Stdio::null()).stderr(Stdio::piped());
        (arguments, ChildGuard::start(&mut command))
    });
    for (arguments, mut child) in waiting {
        let pid = child.id();
        until("the command handles signals", || {
            handles_interrupts(pid) || child.ended().is_some()
        });
        child.signal("-INT");
        let mut said = String::new();
        let mut errors = child.child().stderr.take().unwrap();
        errors.read_to_string(&mut said).unwrap();
        // A signal is the normal end of these.
        let is_ended = said.is_empty() && ["locks", "up"].contains(&arguments[0]);
        let is_canceled = said.contains("canceled by a signal");
        assert!(is_ended || is_canceled, "{arguments:?}: {said}");
    }
}

#[test]
fn ping_measures_round_trips() {
    let host = Host::new();
    let _echo = host.start(&["listen", "arm_1"]);
    let ping = ["ping", "arm_1", "--interval", "1ms"];
    let printed = host.run(&[&ping[..], &["--count", "3"]].concat()).done();
    let lines: Vec<&str> = printed.lines().collect();
    assert_eq!(lines.len(), 4, "{printed}");
    assert!(
        lines[0].starts_with("arm_1: ping 1, delivered via shm, "),
        "{printed}"
    );
    let summary = "arm_1: 3 pings, 3 delivered; round trip min/avg/max/mdev = ";
    let times = lines[3]
        .strip_prefix(summary)
        .unwrap()
        .strip_suffix(" ms")
        .unwrap();
    let times: Vec<f64> = times.split('/').map(|time| time.parse().unwrap()).collect();
    assert!(
        times[0] <= times[1] && times[1] <= times[2] && times[3] >= 0.0,
        "{printed}"
    );

    let mut running = host.start(&[&ping[..], &["--json"]].concat());
    let line: Value = serde_json::from_str(&running.ready).unwrap();
    assert_eq!((&line["ping"], &line["via"]), (&json!(1), &json!("shm")));
    running.send_signal("-INT");
    let last = std::iter::from_fn(|| running.next_line()).last().unwrap();
    let last: Value = serde_json::from_str(&last).unwrap();
    assert!(
        last["pings"].as_u64() >= Some(1) && last["mdev"].is_number(),
        "{last}"
    );
    assert_eq!(running.end(), (Some(0), String::new()));

    let (_, error) = host.run(&["ping", "unknown", "--count", "1"]).failed_text();
    assert!(
        error.starts_with("error: 1 of 1 pings were not delivered\n"),
        "{error}"
    );
}

/// The commands that continue until Ctrl-C end after a time and after a number of lines.
#[test]
fn commands_that_continue_have_limits() {
    let host = Host::new();
    let _listen = host.start(&["listen", "arm_1"]);
    for command in [
        &["listen", "monitor"][..],
        &["echo", "monitor"],
        &["watch"],
        &["agents", "--watch"],
        &["locks", "--watch"],
        &["topics", "--watch"],
        &["ping", "arm_1", "--interval", "1ms"],
        &["send", "--to", "arm_1", "--rate", "1000"],
    ] {
        host.run(&[command, &["--for", "1ms"]].concat()).done();
    }
    let one = ["-c", "1"];
    let pings = host.run(&[&["ping", "arm_1"][..], &one].concat()).done();
    assert!(pings.contains("1 pings, 1 delivered"), "{pings}");
    let agents = ["agents", "--watch", "--json"];
    let agents = host.run(&[&agents[..], &one].concat()).done();
    assert_eq!(agents.lines().count(), 1, "{agents}");
    let locks = ["locks", "--watch", "--json"];
    let locks = host.run(&[&locks[..], &one].concat()).done();
    assert_eq!(locks.lines().count(), 1, "{locks}");
    for command in ["agents", "locks"] {
        let alone = host.run(&[command, "--for", "1s"]);
        assert_eq!(alone.code, Some(2), "{alone:?}");
    }
}

#[test]
fn the_help_for_an_unknown_receiver_names_a_similar_one() {
    let host = Host::new();
    let _listen = host.start(&["listen", "arm_1"]);
    for (to, help) in [
        ("arm1", "did you mean \"arm_1\"?"),
        ("Arm_2", "did you mean \"arm_1\"?"),
        ("arm_*", "regular expressions: \"arm_.*\""),
        ("lifter", "no gateway is running"),
    ] {
        let (_, error) = host.run(&["send", "--to", to]).failed_text();
        assert!(error.contains(help), "{to}: {error}");
    }
}

#[test]
fn a_misspelled_performative_or_protocol_is_sent_with_a_warning() {
    let host = Host::new();
    let _listen = host.start(&["listen", "arm_1"]);
    let send = |options: &[&str]| {
        let sent = host.run(&[&["send", "--to", "arm_1"], options].concat());
        assert_eq!(sent.code, Some(0), "{sent:?}");
        sent.stderr
    };
    let warned = send(&["-p", "infrm"]);
    assert!(warned.contains("warning: \"infrm\""), "{warned}");
    assert!(warned.contains("did you mean \"inform\"?"), "{warned}");
    let warned = send(&["-p", "request", "--protocol", "fipa-requst"]);
    assert!(
        warned.contains("did you mean \"fipa-request\"?"),
        "{warned}"
    );
    for legal in [
        ["-p", "lift"],
        ["-p", "INFORM"],
        ["--protocol", "FIPA-Request"],
        ["--protocol", "lift-protocol"],
    ] {
        assert_eq!(send(&legal), "");
    }
}

#[test]
fn a_message_is_sent_at_a_rate() {
    let host = Host::new();
    let mut listen = host.start(&["listen", "monitor", "--count", "20"]);
    let send = ["send", "--to", "monitor", "--content", "x"];
    let repeated = ["--rate", "500", "--count", "20", "--json"];
    let printed = host.run(&[&send[..], &repeated].concat()).done();
    let lines: Vec<Value> = printed
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(lines.len(), 21);
    let mut numbers: Vec<u64> = lines
        .iter()
        .filter_map(|it| it["number"].as_u64())
        .collect();
    numbers.sort_unstable();
    assert_eq!(numbers, (1..=20).collect::<Vec<_>>());
    let summary = lines.last().unwrap();
    assert_eq!(
        (
            &summary["messages"],
            &summary["delivered"],
            &summary["failed"]
        ),
        (&json!(20), &json!(20), &json!(0))
    );
    assert_eq!(listen.end(), (Some(0), String::new()));

    let unknown = ["send", "--to", "unknown", "--count", "2"];
    let (printed, error) = host.run(&unknown).failed_text();
    assert!(
        printed.starts_with("message 1: unknown: failed: no such agent\n"),
        "{printed}"
    );
    assert!(
        printed.contains(": 0 outcomes delivered, 0 sent without a confirmation, 2 failed\n"),
        "{printed}"
    );
    assert!(
        error.starts_with("error: 2 outcomes are failures\n"),
        "{error}"
    );

    let mut listen = host.start(&["listen", "monitor", "--count", "3", "--json"]);
    let numbered = ["--count", "3", "--numbered"];
    host.run(&[&send[..], &numbered].concat()).done();
    for number in 1..=3 {
        let received: Value = serde_json::from_str(&listen.line()).unwrap();
        assert_eq!(received["message"]["content"], format!("x {number}"));
    }
    assert_eq!(listen.end(), (Some(0), String::new()));
    host.run(&[&send[..], &["--numbered"]].concat()).failed(2);

    // Without a count, until a signal.
    let _listen = host.start(&["listen", "monitor"]);
    let mut endless = host.start(&[&send[..], &["--rate", "100", "--json"]].concat());
    assert!(
        endless.ready.starts_with("{\"deliveries\""),
        "{}",
        endless.ready
    );
    endless.send_signal("-INT");
    let last = std::iter::from_fn(|| endless.next_line()).last().unwrap();
    assert!(last.contains("\"seconds\""), "{last}");
    assert_eq!(endless.end(), (Some(0), String::new()));
    for wrong in [
        &["--rate", "0"][..],
        &["--count", "0"],
        &["--rate", "1", "--wait"],
        &["--numbered", "--wait"],
    ] {
        host.run(&[&send[..], wrong].concat()).failed(2);
    }
}

#[test]
fn a_call_for_proposals_shows_all_bids_and_answers_each() {
    let host = Host::new();
    let _agents = agents(&host);
    let call = [
        "send",
        "--to",
        "arm_.*",
        "-p",
        "cfp",
        "--protocol",
        "fipa-contract-net",
    ];
    let wait = ["--wait", "--answers", "3", "--timeout", "60s"];
    let printed = host
        .run(&[&call[..], &wait, &["--accept", "arm_2"]].concat())
        .done();
    let begin = |text: &str| {
        printed
            .lines()
            .filter(|line| line.starts_with(text))
            .count()
    };
    assert_eq!(begin("reply: (propose :sender arm_"), 3, "{printed}");
    for line in ["accepted: arm_2", "rejected: arm_1", "rejected: arm_3"] {
        assert_eq!(begin(line), 1, "{printed}");
    }
    assert_eq!(begin("result: (inform :sender arm_2"), 1, "{printed}");
    for name in ["arm_1", "arm_3"] {
        let rejected = host.path(&format!("rejected-{name}"));
        until("the arm knows it", || rejected.exists());
    }
    assert!(!host.path("rejected-arm_2").exists());

    let json = host
        .run(&[&call[..], &wait, &["--json"]].concat())
        .done_json();
    assert_eq!(json["replies"].as_array().unwrap().len(), 3);
    assert_eq!(json["accepted"], json!([]));
    assert_eq!(json["rejected"].as_array().unwrap().len(), 3);
    until("the arm knows it", || host.path("rejected-arm_2").exists());

    let absent = [&call[..], &wait, &["--accept", "arm_9"]].concat();
    let (_, error) = host.run(&absent).failed_text();
    assert!(
        error.contains("no proposal to accept\nwhere: \"arm_9\""),
        "{error}"
    );
}
