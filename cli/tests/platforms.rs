//! The commands with agents of other platforms over HTTP. A platform is a thread that reads and writes
//! the recorded bytes of JADE.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::io::{Read as _, Write as _};
use std::net::TcpListener;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use common::{Host, Running};
use fipa::{Message, Performative};
use fipa_testbed::jade::{self, post, readdressed as at};
use serde_json::{Value, json};

macro_rules! recorded {
    ($file:literal) => {
        include_bytes!(concat!(
            "../../transport-net/tests/data/jade_http/",
            $file,
            ".bin"
        ))
        .as_slice()
    };
}

const ANSWER: &[u8] = recorded!("keepalive-http-response-from-jade");

/// Requests that JADE has accepted, from `rusty@rustap` to `echo@jadetest`.
const REQUESTS: [&[u8]; 3] = [
    recorded!("string.1-request-to-jade"),
    recorded!("xml.1-request-to-jade"),
    recorded!("bitefficient.1-request-to-jade"),
];

/// Requests of JADE, from `echo@jadetest` to `rusty@rustap`.
const REPLIES: [&[u8]; 3] = [
    recorded!("string.3-echo-reply-from-jade"),
    recorded!("xml.3-echo-reply-from-jade"),
    recorded!("bitefficient.3-echo-reply-from-jade"),
];

/// JADE's report that it has no agent `nobody@jadetest`.
const FAILURE: &[u8] = recorded!("failure-unknown-agent.3-ams-failure-from-jade");

/// Address of JADE when its answers were recorded.
const RECORDED_AT: &str = "127.0.0.1:27778";

const TIMEOUT: Duration = Duration::from_secs(60);

/// Reads a request, answers it as JADE does, and returns its message.
fn accept(listener: &TcpListener) -> Message {
    listener.set_nonblocking(true).unwrap();
    let until = Instant::now() + TIMEOUT;
    let mut stream = loop {
        match listener.accept() {
            Ok((stream, _)) => break stream,
            Err(error) => assert!(Instant::now() < until, "no request came: {error}"),
        }
        thread::sleep(Duration::from_millis(1));
    };
    stream.set_nonblocking(false).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    let mut bytes = Vec::new();
    let mut more = [0; 65536];
    loop {
        let len = stream.read(&mut more).unwrap();
        assert!(len > 0, "the request is not complete");
        bytes.extend(&more[..len]);
        let Some(head) = bytes.windows(4).position(|it| it == b"\r\n\r\n") else {
            continue;
        };
        if bytes.len() == head + 4 + jade::content_length(&bytes[..head]) {
            break;
        }
    }
    stream.write_all(ANSWER).unwrap();
    let payload = fipa_acl::Payload {
        head: jade::message(&bytes).to_vec().into(),
        ..fipa_acl::Payload::default()
    };
    Message::decode(&payload).unwrap()
}

/// Receives a request, and then sends this one.
fn answers_with(listener: &TcpListener, request: Vec<u8>, to: String) -> JoinHandle<Message> {
    let listener = listener.try_clone().unwrap();
    thread::spawn(move || {
        let message = accept(&listener);
        post(&request, &to);
        message
    })
}

/// Starts a gateway with HTTP. Returns the address of HTTP, too.
fn gateway(host: &Host, settings: &[&str]) -> (Running, String) {
    let mut arguments = vec![
        "up",
        "--json",
        "--set",
        "mts.transports=[\"shm\", \"unix\", \"tcp\", \"http\"]",
        "--set",
        "transport.http.listen=127.0.0.1:0",
    ];
    for setting in settings {
        arguments.extend(["--set", setting]);
    }
    let gateway = host.start(&arguments);
    let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
    let locations = ready["locations"].as_array().unwrap();
    let mut http = locations.iter().filter_map(|it| {
        let address = it.as_str()?.strip_prefix("http://")?;
        address.strip_suffix("/acc").map(str::to_owned)
    });
    (gateway, http.next().unwrap())
}

#[test]
fn an_agent_answers_a_platform_at_the_address_in_the_letter() {
    let host = Host::new();
    let (_gateway, http) = gateway(&host, &[]);
    let _echo = host.echo("echo@jadetest");
    // The entries of agents have no locations that only legacy peers may use.
    let agents = host.run(&["agents", "--json"]).done_json();
    for agent in agents["agents"].as_array().unwrap() {
        let locations = agent["locations"].to_string();
        assert!(!locations.contains("http://"), "{agents}");
        let is_gateway = agent["role"] == "gateway";
        let address = format!("http://{http}/acc");
        assert_eq!(
            agent["addresses"].to_string().contains(&address),
            is_gateway
        );
    }
    let routes = host.run(&["routes"]).done();
    assert!(routes.contains(&format!("http://{http}/acc")), "{routes}");
    let platform = TcpListener::bind("127.0.0.1:0").unwrap();
    let here = platform.local_addr().unwrap().to_string();
    for request in REQUESTS {
        post(
            &at(
                request,
                &[("127.0.0.1:9901", &here), ("127.0.0.1:7778", &http)],
            ),
            &http,
        );
        let reply = accept(&platform);
        assert_eq!(reply.receivers()[0].name(), "rusty@rustap");
        assert_eq!(reply.content().unwrap(), "hello jade");
        assert_eq!(reply.in_reply_to(), Some("rw-1"));
        assert_eq!(reply.conversation_id(), Some("conv-1"));
        let sender = reply.sender().unwrap();
        assert_eq!(sender.name(), "echo@jadetest");
        assert_eq!(sender.addresses(), [&*format!("http://{http}/acc")]);
    }
}

#[test]
fn a_platform_that_states_its_name_is_answered_at_the_address_of_its_connection() {
    let host = Host::new();
    let (_gateway, http) = gateway(&host, &[]);
    let _echo = host.echo("echo@jadetest");
    let platform = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = platform.local_addr().unwrap().port();
    let named = format!("jade.example:{port}");
    let [request, ..] = REQUESTS;
    post(&at(request, &[("127.0.0.1:9901", &named)]), &http);
    assert_eq!(accept(&platform).content().unwrap(), "hello jade");
}

#[test]
fn a_platform_gets_a_failure_for_an_agent_that_does_not_exist() {
    let host = Host::new();
    let (_gateway, http) = gateway(&host, &[]);
    let platform = TcpListener::bind("127.0.0.1:0").unwrap();
    let here = platform.local_addr().unwrap().to_string();
    let [request, ..] = REQUESTS;
    post(&at(request, &[("127.0.0.1:9901", &here)]), &http);
    let failure = accept(&platform);
    assert_eq!(*failure.performative(), Performative::Failure);
    assert_eq!(failure.in_reply_to(), Some("rw-1"));
    let text = String::from_utf8(failure.content().unwrap().to_vec()).unwrap();
    assert!(
        text.contains("(MTS-error (agent-identifier :name \"echo@jadetest\")"),
        "{text}"
    );
}

#[test]
fn a_letter_is_sent_to_a_platform_and_its_reply_or_failure_is_received() {
    let host = Host::new();
    let platform = TcpListener::bind("127.0.0.1:0").unwrap();
    let here = platform.local_addr().unwrap().to_string();
    let peers = format!(
        "discovery.static={{ \"echo@jadetest\" = [\"http://{here}/acc\"], \
         \"nobody@jadetest\" = [\"http://{here}/acc\"] }}"
    );
    let (_gateway, http) = gateway(&host, &[&peers]);
    let known = |name: &str| loop {
        let all = host.run(&["agents", name, "--json"]).done_json();
        if let agent @ Value::Object(_) = &all["agents"][0] {
            return agent.clone();
        }
    };
    known("echo@jadetest");
    let send = |to: &'static str, conversation: &'static str| {
        [
            "send",
            "--to",
            to,
            "--from",
            "rusty@rustap",
            "--conversation-id",
            conversation,
            "--reply-with",
            "rw-1",
            "--content",
            "hello jade",
            "--wait",
            "--timeout",
            "30s",
            "--json",
        ]
    };
    for reply in REPLIES {
        let reply = at(
            reply,
            &[("127.0.0.1:7778", &here), ("127.0.0.1:9901", &http)],
        );
        let sent = answers_with(&platform, reply, http.clone());
        let json = host.run(&send("echo@jadetest", "conv-1")).done_json();
        assert_eq!(json["deliveries"][0]["outcome"], "sent");
        assert_eq!(json["deliveries"][0]["via"], "http");
        assert_eq!(json["reply"]["performative"], "inform");
        assert_eq!(json["reply"]["content"], "hello jade");
        let sent = sent.join().unwrap();
        assert_eq!(sent.receivers()[0].name(), "echo@jadetest");
        let sender = sent.sender().unwrap();
        assert_eq!(sender.addresses(), [&*format!("http://{http}/acc")]);
    }
    known("nobody@jadetest");
    let failure = at(
        FAILURE,
        &[("127.0.0.1:7778", &here), ("127.0.0.1:9904", &http)],
    );
    let sent = answers_with(&platform, failure, http.clone());
    let (json, output) = host.run(&send("nobody@jadetest", "fail-1")).failed_json();
    sent.join().unwrap();
    let reason = "Agent not found: getContainerID() failed to find agent nobody@jadetest";
    let failure =
        json!({ "from": "ams@jadetest", "receiver": "nobody@jadetest", "reason": reason });
    assert_eq!(json["failures"], json!([failure]));
    assert!(
        output.starts_with(&format!("error: not delivered: {reason}\n")),
        "{output}"
    );
    // The platform ends.
    drop(platform);
    let (json, _) = host
        .run(&[
            "send",
            "--to",
            "echo@jadetest",
            "--deadline",
            "2s",
            "--json",
        ])
        .failed_json();
    assert_eq!(json["deliveries"][0]["outcome"], "failed");
}

#[test]
fn an_agent_that_no_directory_lists_is_reached_at_a_stated_address() {
    let host = Host::new();
    let platform = TcpListener::bind("127.0.0.1:0").unwrap();
    let here = platform.local_addr().unwrap().to_string();
    let (_gateway, http) = gateway(&host, &[]);
    let address = format!("http://{here}/acc");
    let send = |to: &'static str, address: &str, more: &[&'static str]| {
        let mut arguments = vec!["send", "--to", to, "--content", "hello jade", "--json"];
        arguments.extend(["--from", "rusty@rustap", "--address", address]);
        arguments.extend(more);
        arguments.into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let run = |arguments: Vec<String>| {
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        host.run(&arguments)
    };
    let reply = at(
        REPLIES[0],
        &[("127.0.0.1:7778", &here), ("127.0.0.1:9901", &http)],
    );
    let sent = answers_with(&platform, reply, http.clone());
    let waiting = ["--wait", "--timeout", "60s", "--deadline", "60s"];
    let conversation = ["--conversation-id", "conv-1", "--reply-with", "rw-1"];
    let json = run(send(
        "echo@jadetest",
        &address,
        &[waiting.as_slice(), &conversation].concat(),
    ));
    let json = json.done_json();
    assert_eq!(json["deliveries"][0]["via"], "http");
    assert_eq!(json["reply"]["content"], "hello jade");
    let sent = sent.join().unwrap();
    assert_eq!(sent.receivers()[0].name(), "echo@jadetest");
    assert_eq!(sent.receivers()[0].addresses(), [address.as_str()]);

    // Another address is tried after the one before did not take the letter, also with --count and --rate.
    let first = "http://127.0.0.1:9/acc".to_owned();
    let two = [
        "--address",
        &address,
        "--count",
        "1",
        "--rate",
        "100",
        "--deadline",
        "60s",
    ];
    let reading = {
        let platform = platform.try_clone().unwrap();
        thread::spawn(move || {
            let message = accept(&platform);
            assert_eq!(message.receivers()[0].addresses().len(), 2);
        })
    };
    let mut arguments = send("two@jadetest", &first, &[]);
    arguments.extend(two.map(str::to_owned));
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let sent = host.run(&arguments).done();
    assert!(sent.contains("\"sent\":1"), "{sent}");
    reading.join().unwrap();
    for command in ["request", "subscribe", "ping", "do"] {
        let help = host.run(&[command, "--help"]).done();
        assert!(help.contains("--address"), "{command}");
    }

    // The name of an agent that the directory lists cannot be taken by an address.
    let _arm = host.echo("arm_1");
    let error = run(send("arm_1", &address, &[])).failed(1);
    let why = "the directory lists another agent of this name";
    assert!(error.contains(why), "{error}");
    let udt = "udt://127.0.0.1:9;fipa-services";
    let error = run(send("echo@else", udt, &[])).failed(1);
    assert!(error.contains("the gateway does not use udt"), "{error}");
    // An address of this project's own protocol.
    let error = run(send("echo@else", "tcp://127.0.0.1:9", &[])).failed(2);
    assert!(error.contains("is no address of a legacy peer"), "{error}");
}

/// Returns a request of JADE with this message.
fn posted(message: &str, to: &str, http: &str, from: &str) -> Vec<u8> {
    let id = |name: &str, at: &str| {
        format!(
            "<agent-identifier><name>{name}</name><addresses><url>http://{at}/acc</url></addresses>\
             </agent-identifier>"
        )
    };
    let (to, from) = (id(to, http), id("ams@jadetest", from));
    let body = format!(
        "--b\r\nContent-Type: application/xml\r\n\r\n<?xml version=\"1.0\"?><envelope><params index=\"1\">\
         <to>{to}</to><from>{from}</from><acl-representation>fipa.acl.rep.string.std</acl-representation>\
         <date>20260101Z000000000</date><intended-receiver>{to}</intended-receiver></params></envelope>\
         \r\n--b\r\nContent-Type: application/text\r\n\r\n{message}\r\n--b--\r\n"
    );
    let head = format!(
        "POST http://{http}/acc HTTP/1.1\r\nContent-Type: multipart/mixed ; boundary=\"b\"\r\n\
         Content-Length: {}\r\n\r\n",
        body.len()
    );
    [head, body].concat().into_bytes()
}

/// Returns the recorded answer of JADE to a request, as the answer to this message.
fn recorded_answer(name: &str, request: &Message) -> String {
    let all = include_str!("../../platform/tests/vectors/jade_ams_df.txt");
    let (_, exchange) = all.split_once(&format!("=== {name}\n")).unwrap();
    let (_, answer) = exchange.split_once("\n---\n").unwrap();
    let answer = answer.split("\n=== ").next().unwrap();
    // The name of a slot is followed by its value, and both by blanks.
    let mut words = answer.split_whitespace();
    let mut value = |slot: &str| {
        words
            .find(|it| *it == slot)
            .and_then(|_| words.next())
            .unwrap()
    };
    let (reference, conversation) = (value(":in-reply-to"), value(":conversation-id"));
    let slot = |slot: &str, value: Option<&str>| {
        value.map_or_else(String::new, |value| format!("{slot} {value}"))
    };
    let replaced = answer
        .replace("rusty@rustap", request.sender().unwrap().name())
        .replace(
            &format!(":in-reply-to  {reference}"),
            &slot(":in-reply-to", request.reply_with()),
        );
    let (head, _) = replaced
        .rsplit_once(&format!(":conversation-id  {conversation}"))
        .unwrap();
    format!(
        "{head}{})",
        slot(":conversation-id", request.conversation_id())
    )
}

#[test]
fn the_agents_of_a_platform_are_listed_by_its_address_alone() {
    let host = Host::new();
    let platform = TcpListener::bind("127.0.0.1:0").unwrap();
    let here = platform.local_addr().unwrap().to_string();
    let (_gateway, http) = gateway(&host, &[]);
    let answers = {
        let (platform, here) = (platform.try_clone().unwrap(), here.clone());
        thread::spawn(move || {
            let post = |request: &Message, message: &str| {
                let to = request.sender().unwrap().name().to_owned();
                post(&posted(message, &to, &http, &here), &http);
            };
            // An agent that the platform does not have.
            let unknown = accept(&platform);
            let conversation = unknown.conversation_id().unwrap();
            let failure = format!(
                "(FAILURE :sender (agent-identifier :name ams@jadetest :addresses (sequence http://{here}/acc)) \
                 :receiver (set (agent-identifier :name {})) :content \"( (action (agent-identifier :name x) \
                 (ACLMessage)) (MTS-error (agent-identifier :name {}) (internal-error \\\"Agent not found\\\")))\" \
                 :language fipa-sl :ontology fipa-agent-management :conversation-id {conversation})",
                unknown.sender().unwrap().name(),
                unknown.receivers()[0].name(),
            );
            post(&unknown, &failure);
            for name in ["ams_get_description", "ams_search_all"] {
                let request = accept(&platform);
                assert_eq!(request.receivers()[0].name(), "ams@jadetest");
                // The platform of the recording had another address.
                let answer = recorded_answer(name, &request);
                post(&request, &answer.replace(RECORDED_AT, &here));
            }
        })
    };
    let address = format!("http://{here}/acc");
    let listed = host.run(&["agents", "--platform", &address, "--json", ".*@jadetest"]);
    let listed = listed.done_json();
    answers.join().unwrap();
    assert_eq!(listed["ams"], "ams@jadetest");
    // JADE states its name with quotation marks.
    assert_eq!(listed["platform"]["name"], "\"jadetest\"");
    let names = listed["agents"].as_array().unwrap().iter();
    let mut names: Vec<&str> = names.map(|it| it["name"].as_str().unwrap()).collect();
    names.sort_unstable();
    assert_eq!(names, ["ams@jadetest", "df@jadetest", "echo@jadetest"]);
    // The agent that the platform does not have is none.
    let known = host.run(&["agents", "--json"]).done();
    assert!(!known.contains("fipa-unknown"), "{known}");
}

#[test]
fn agents_that_a_foreign_directory_facilitator_lists_are_reached_by_their_names() {
    let host = Host::new();
    let platform = TcpListener::bind("127.0.0.1:0").unwrap();
    let here = platform.local_addr().unwrap().to_string();
    let (_gateway, http) = gateway(&host, &[]);
    let answers = {
        let (platform, here) = (platform.try_clone().unwrap(), here.clone());
        thread::spawn(move || {
            let request = accept(&platform);
            let conversation = request.conversation_id().unwrap_or_default();
            // Also an agent at a third host.
            let answer = format!(
                "(INFORM :sender (agent-identifier :name df@jade :addresses (sequence http://{here}/acc)) \
                 :receiver (set (agent-identifier :name {})) :content \"((result (action \
                 (agent-identifier :name df@jade) (search)) (sequence (df-agent-description :name \
                 (agent-identifier :name df1@jade :addresses (sequence http://{here}/acc))) \
                 (df-agent-description :name (agent-identifier :name x@evil :addresses \
                 (sequence http://192.0.2.7:7778/acc))))))\" :language fipa-sl0 :ontology \
                 fipa-agent-management :protocol fipa-request :conversation-id {conversation} :in-reply-to {})",
                request.sender().unwrap().name(),
                request.reply_with().unwrap_or("none"),
            );
            let to = request.sender().unwrap().name().to_owned();
            post(&posted(&answer, &to, &http, &here), &http);
            accept(&platform)
        })
    };
    let address = format!("http://{here}/acc");
    let search = [
        "df",
        "search",
        "--df",
        "df@jade",
        "--address",
        &address,
        "--json",
    ];
    let ran = host.run(&search);
    assert_eq!(ran.code, Some(0), "{ran:?}");
    assert!(
        ran.stderr.contains("letters to x@evil cannot be sent"),
        "{ran:?}"
    );
    assert!(ran.stderr.contains("contacts.networks"), "{ran:?}");
    let found: Value = serde_json::from_slice(&ran.stdout).unwrap();
    assert_eq!(found["agents"].as_array().unwrap().len(), 2, "{found}");
    let send = ["send", "--to", "df1@jade", "--content", "hello", "--json"];
    let sent = host.run(&send).done_json();
    assert_eq!(sent["deliveries"][0]["outcome"], "sent", "{sent}");
    let message = answers.join().unwrap();
    assert_eq!(message.receivers()[0].name(), "df1@jade");
    let send = ["send", "--to", "x@evil", "--content", "hello", "--json"];
    let (failed, _) = host.run(&send).failed_json();
    assert_eq!(failed["deliveries"][0]["outcome"], "failed", "{failed}");
}

#[test]
fn a_platform_finds_the_addresses_of_agents_in_the_answers_of_the_platform_agents() {
    let host = Host::new();
    let platform = TcpListener::bind("127.0.0.1:0").unwrap();
    let here = platform.local_addr().unwrap().to_string();
    let (gateway, http) = gateway(&host, &[]);
    let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
    let mts = ready["name"].as_str().unwrap_or("mts").to_owned();
    let crane = host.start(&["df", "register", "crane", "lifting"]);
    let ask = |agent: &str, act: &str| {
        let request = format!(
            "(REQUEST :sender (agent-identifier :name seeker@jade :addresses (sequence http://{here}/acc)) \
             :receiver (set (agent-identifier :name {agent})) :content \"((action (agent-identifier :name \
             {agent}) {act}))\" :language fipa-sl0 :ontology fipa-agent-management :protocol fipa-request \
             :conversation-id c1 :reply-with r1)"
        );
        post(&posted(&request, agent, &http, &here), &http);
        let answer = accept(&platform);
        let content = answer.content().unwrap().to_vec();
        String::from_utf8(content).unwrap()
    };
    let crane_at = format!("crane :addresses (sequence http://{http}/acc)");
    let plain = |text: &str| text.replace('"', "");
    let any = "(search (df-agent-description) (search-constraints :max-results 10))";
    let found = plain(&ask(&format!("df@{mts}"), any));
    assert!(found.contains(&crane_at), "{found}");
    let any = "(search (ams-agent-description) (search-constraints :max-results 10))";
    let found = plain(&ask(&format!("ams@{mts}"), any));
    assert!(found.contains(&crane_at), "{found}");
    let described = plain(&ask(&format!("ams@{mts}"), "(get-description)"));
    assert!(
        described.contains(&format!("http://{http}/acc")),
        "{described}"
    );
    // An agent of this host needs no addresses.
    let own = host
        .run(&["df", "search", "--json"])
        .done_json()
        .to_string();
    assert!(!own.contains("http://"), "{own}");
    drop(crane);
}
