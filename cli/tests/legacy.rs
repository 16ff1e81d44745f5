//! The commands with agents of legacy peers.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::thread;

use common::Host;
use fipa::{AgentId, Envelope, EnvelopeParams, Message, Performative};
use serde_json::{Value, json};

/// A letter that a fipa_services agent, `cpp-sender`, sent to an agent `echo`.
const LETTER: &[u8] = include_bytes!("../../acl/tests/vectors/tcp_letter.bin");
/// The failure message that the message transport service of fipa_services sent to `cpp-sender`.
const FAILURE: &[u8] = include_bytes!("../../acl/tests/vectors/failure_letter.bin");

/// A legacy peer that receives one letter and then sends this one on a new connection.
fn answers_with(listener: &TcpListener, letter: Vec<u8>, to: String) {
    let listener = listener.try_clone().unwrap();
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut received = Vec::new();
        stream.read_to_end(&mut received).unwrap();
        drop(stream);
        TcpStream::connect(to).unwrap().write_all(&letter).unwrap();
    });
}

/// Waits until the processes of the host know the agent, and returns its entry in `fipa agents`.
#[track_caller]
fn known(host: &Host, name: &str) -> Value {
    let until = std::time::Instant::now() + std::time::Duration::from_secs(60);
    loop {
        let all = host.run(&["agents", name, "--json"]).done_json();
        match &all["agents"][0] {
            Value::Null => assert!(std::time::Instant::now() < until, "{all}"),
            agent => return agent.clone(),
        }
    }
}

#[test]
fn letters_to_an_agent_with_only_udt_locations_fail_at_once() {
    let host = Host::new();
    let peer = "discovery.static={ cpp = [\"udt://127.0.0.1:9\"] }";
    let _gateway = host.start(&["up", "--set", peer]);
    let agent = known(&host, "cpp");
    assert_eq!(
        agent["locations"],
        json!(["udt://127.0.0.1:9;fipa-services"])
    );
    assert_eq!(agent["unsupported_transports"], json!(["udt"]));
    let table = host.run(&["agents", "cpp", "--long"]).done();
    let shown = "udt://127.0.0.1:9;fipa-services (unsupported transport udt)";
    assert!(table.contains(shown), "{table}");
    let routes = host.run(&["routes", "cpp"]).done();
    let shown = "not used: unsupported transport";
    assert!(routes.contains(shown), "{routes}");

    // The watchdog ends the command long before this deadline.
    let send = ["send", "--to", "cpp", "--deadline", "30m", "--json"];
    let (json, output) = host.run(&send).failed_json();
    let delivery = &json["deliveries"][0];
    assert_eq!(delivery["reason"], "unsupported transport");
    assert_eq!(delivery["attempts"][0]["via"], "udt");
    assert!(
        output.starts_with("error: not delivered: unsupported transport\nwhere: \"cpp\"\n"),
        "{output}"
    );
}

#[test]
fn a_letter_reaches_an_agent_with_only_a_udt_location_if_both_gateways_use_udt() {
    let (here, there) = (Host::new(), Host::new());
    let order = "mts.transports=[\"shm\", \"unix\", \"udt\"]";
    let gateway = there.start(&["up", "--json", "--set", order]);
    let location = gateway.location("udt");
    let mut echo = there.start(&["echo", "cpp", "--count", "1"]);
    let peer = format!("discovery.static={{ cpp = [\"{location}\"] }}");
    let _gateway = here.start(&["up", "--set", order, "--set", &peer]);
    let agent = known(&here, "cpp");
    assert_eq!(agent["unsupported_transports"], Value::Null);
    let sent = here.run(&["send", "--to", "cpp", "--json"]).done_json();
    let delivery = &sent["deliveries"][0];
    assert_eq!(delivery["outcome"], "sent", "{sent}");
    assert_eq!(echo.end().0, Some(0));
}

#[test]
fn an_agent_of_a_legacy_peer_is_listed_with_its_own_address() {
    let host = Host::new();
    let peers = "discovery.static={ cpp = [\"tcp://127.0.0.1:9;fipa-services\"], \
                 \"cp.\" = [\"tcp://127.0.0.1:10;fipa-services\"] }";
    let _gateway = host.start(&["up", "--set", peers]);
    for (name, port) in [("cpp", 9), ("cp.", 10)] {
        let pattern = name.replace('.', "\\.");
        let agent = known(&host, &pattern);
        assert_eq!(agent["name"], name);
        let at = format!("tcp://127.0.0.1:{port};fipa-services");
        assert_eq!(agent["locations"], json!([at]));
        let table = host.run(&["agents", &pattern, "--long"]).done();
        assert!(table.contains(&at), "{table}");
    }
}

#[test]
fn a_failure_message_about_the_letter_is_not_a_reply() {
    let host = Host::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap();
    let peer = format!("discovery.static={{ cpp = [\"tcp://{at};fipa-services\"] }}");
    let gateway = host.start(&["up", "--json", "--set", &peer]);
    known(&host, "cpp");
    let send = [
        "send",
        "--to",
        "cpp",
        "--from",
        "cpp-sender",
        "--conversation-id",
        "conv-1",
        "--reply-with",
        "rw-1",
        "--wait",
        "--timeout",
        "30s",
        "--json",
    ];
    answers_with(&listener, FAILURE.to_vec(), gateway.tcp_address());
    let (json, output) = host.run(&send).failed_json();
    assert_eq!(json["deliveries"][0]["outcome"], "sent");
    assert_eq!(json.get("reply"), None, "{json}");
    let failure = json!({ "from": "echo-mts", "receiver": "nobo",
                          "reason": "message delivery failed" });
    assert_eq!(json["failures"], json!([failure]));
    let expected = "error: not delivered: message delivery failed\nwhere: \"nobo\", in a failure message from \"echo-mts\"\n";
    assert!(output.starts_with(expected), "{output}");

    // A failure message of the receiver about something else is a reply.
    let to = AgentId::new("cpp-sender").unwrap();
    let reply = Message::builder(Performative::Failure)
        .sender(AgentId::new("cpp").unwrap())
        .receiver(to.clone())
        .conversation_id("conv-1")
        .in_reply_to("rw-1")
        .content("(lift sample-3) (too-heavy)")
        .build()
        .unwrap();
    let envelope = Envelope {
        base: EnvelopeParams {
            to: vec![to],
            from: reply.sender().cloned(),
            acl_representation: Some(fipa_acl::AclRepresentation::BitEfficient),
            date: Some("20261120T112644481Z".parse().unwrap()),
            ..EnvelopeParams::default()
        },
        extensions: Vec::new(),
    };
    let mut letter = envelope.encode_standard().unwrap().to_vec();
    letter.extend_from_slice(&reply.to_payload().to_bytes());
    answers_with(&listener, letter, gateway.tcp_address());
    let json = host.run(&send).done_json();
    assert_eq!(json["reply"]["performative"], "failure");
    assert_eq!(json.get("failures"), None, "{json}");
}

#[test]
fn failure_messages_beyond_a_limit_are_counted_in_the_log() {
    let host = Host::new();
    let mut gateway = host.start(&["up", "--json"]);
    let to = gateway.tcp_address();
    // The limit is a number per second, so several arrive at once.
    for _ in 0..10 {
        let streams: [_; 20] = std::array::from_fn(|_| TcpStream::connect(&to).unwrap());
        for mut stream in &streams {
            stream.write_all(LETTER).unwrap();
            stream.shutdown(Shutdown::Write).unwrap();
        }
        // The gateway closes a connection after it has read the letter.
        for mut stream in &streams {
            let _ = stream.read_to_end(&mut Vec::new());
        }
    }
    gateway.wait_for_log(&[
        "failure messages beyond a limit are counted in one message to their sender",
    ]);
    // The gateway logs the number at its end at the latest.
    let (_, log) = gateway.signal("-INT");
    assert!(log.contains("omitted="), "{log}");
}

#[test]
fn a_name_that_legacy_peers_cannot_read_causes_one_warning() {
    let host = Host::new();
    let (code, output) = host.echo("arm.left").signal("-INT");
    assert_eq!((code, output.as_str()), (Some(0), ""));
    let both = &["fipa_services", "JADE"][..];
    for (arguments, peers) in [
        (&["echo", "a b"][..], &["fipa_services"][..]),
        (&["coalition", "a b", "arm"], &["fipa_services"]),
        (&["echo", "béla@home:1099/JADE"], both),
    ] {
        let (code, output) = host.start(arguments).signal("-INT");
        assert_eq!(code, Some(0));
        let name = arguments[1];
        for peer in ["fipa_services", "JADE"] {
            let warned = format!(
                "agents of {peer} can neither receive letters from \"{name}\" nor address it"
            );
            let expected = usize::from(peers.contains(&peer));
            assert_eq!(output.matches(&warned).count(), expected, "{output}");
        }
    }
}

#[test]
fn an_agent_cannot_have_a_pattern_as_its_name() {
    let host = Host::new();
    let mut arms = [host.echo("arm_1"), host.echo("arm_2")];
    for arguments in [&["echo", "arm_.*"][..], &["coalition", "arm_.*", "arm_1"]] {
        let output = host.run(arguments).failed(2);
        assert!(output.contains("is a pattern"), "{output}");
    }
    host.run(&["send", "--to", "arm_.*", "--content", "stop"])
        .done();
    for arm in &mut arms {
        assert!(arm.line().contains("stop"));
    }
}
