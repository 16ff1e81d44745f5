//! Other agents and hosts that send much, or take nothing, neither fill the log nor stop the answers to others.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::io::Write;
use std::net::TcpStream;
use std::time::Duration;

use common::{Host, Running};
use fipa::blocking::Wait;
use fipa::config::Sources;
use fipa::{
    Agent, AgentId, Config, Domain, Envelope, EnvelopeParams, Letter, Message, Performative,
};
use fipa_acl::AclRepresentation;

/// Time limit of all waits, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Returns an unframed letter to an agent that does not exist.
fn letter(number: usize) -> Vec<u8> {
    let [sender, receiver] = ["stranger", "nowhere"].map(|name| format!("{name}{number}"));
    let [sender, receiver] = [sender, receiver].map(|name| AgentId::new(&*name).unwrap());
    let message = Message::builder(Performative::Inform)
        .sender(sender.clone())
        .receiver(receiver.clone());
    let envelope = Envelope {
        base: EnvelopeParams {
            to: vec![receiver],
            from: Some(sender),
            acl_representation: Some(AclRepresentation::BitEfficient),
            date: Some("20261121T120000000Z".parse().unwrap()),
            ..EnvelopeParams::default()
        },
        extensions: Vec::new(),
    };
    let payload = message.build().unwrap().to_payload();
    Letter::new(envelope.encode_standard().unwrap(), payload)
        .to_bytes()
        .to_vec()
}

#[test]
fn letters_to_unknown_names_and_connections_fill_no_log() {
    const LETTERS: usize = 300;
    let host = Host::new();
    let mut gateway = host.start(&["up", "--json", "-v"]);
    let address = gateway.tcp_address();
    for number in 0..LETTERS {
        let mut stream = TcpStream::connect(&address).unwrap();
        stream.write_all(&letter(number)).unwrap();
    }
    for _ in 0..LETTERS {
        let mut stream = TcpStream::connect(&address).unwrap();
        // No protocol begins so.
        stream.write_all(&[0xff; 16]).unwrap();
    }
    // The last line of the flood may be omitted: this one is of another kind.
    gateway.wait_for_log(&["connection closed"]);
    let (code, log) = gateway.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
    let lines = log.lines().count();
    assert!(lines < LETTERS / 2, "{lines} lines: {log}");
    assert!(log.contains("no agent of this host has the name"), "{log}");
    assert!(log.contains("omitted="), "{log}");
}

#[test]
fn a_sender_that_takes_no_answers_does_not_delay_the_answers_to_others() {
    const QUESTIONS: usize = 20;
    let host = Host::new();
    let mut echo = host.command(&["echo", "echo", "--set", "mts.deadline=50s"]);
    // The agents of this process are in the same domain.
    match std::env::var_os("FIPA_RUNTIME_DIR") {
        Some(dir) => echo.env("FIPA_RUNTIME_DIR", dir),
        None => echo.env_remove("FIPA_RUNTIME_DIR"),
    };
    let echo = Running::new(echo);
    let domain = format!("domain={}", host.domain);
    let config = Config::load(&Sources {
        // One answer fills the queue of an agent.
        set: [&*domain, "discovery.mdns=false", "mts.queue=1"]
            .map(str::to_owned)
            .to_vec(),
        ..Sources::default()
    });
    let domain = Domain::open(&config.unwrap()).wait().unwrap();
    let [silent, honest] = ["silent", "honest"].map(|name| domain.register(name).wait().unwrap());
    let question = |agent: &Agent, number: usize| {
        let question = agent
            .message(Performative::QueryRef)
            .receiver("echo")
            .content(number.to_string());
        let deliveries = agent.send(question).wait().unwrap();
        assert!(deliveries.all_succeeded(), "{deliveries}");
    };
    for number in 0..QUESTIONS {
        question(&silent, number);
    }
    question(&honest, 7);
    let answer = honest.receive_within(TIMEOUT).wait().unwrap();
    assert_eq!(answer.unwrap().message().text(), "7");
    for number in 0..QUESTIONS {
        let answer = silent.receive_within(TIMEOUT).wait().unwrap();
        assert_eq!(answer.unwrap().message().text(), number.to_string());
    }
    // A killed process would leave its files in the directory of this user.
    let (code, log) = echo.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
    drop((silent, honest));
    domain.close().wait();
}
