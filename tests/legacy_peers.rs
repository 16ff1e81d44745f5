//! Conversations with legacy peers over real sockets. Recorded letters of fipa_services and of JADE's
//! proxy reach an agent, and its answers reach the peers in their own dialects. A peer is a listening
//! port on which each connection carries one letter.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::time::Duration;

use fipa::{
    Agent, AgentId, Domain, Envelope, EnvelopeParams, FailureReason, Gateway, Kind, Letter,
    Message, Outcome, Performative,
};
use fipa_acl::{Dialect, Representation};
use support::config;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::timeout;

/// Ends a test that hangs.
const TIMEOUT: Duration = Duration::from_secs(60);

macro_rules! recorded {
    ($($file:literal),* $(,)?) => {
        [$(($file, include_bytes!(concat!("../acl/tests/vectors/", $file)).as_slice())),*]
    };
}

/// Agents on a host with a gateway that knows one legacy peer.
struct Host {
    gateway: Gateway,
    domain: Domain,
    peer: TcpListener,
}

impl Host {
    /// Starts a host. `understands` is the dialect of the peer in the configuration, and `name` is the
    /// name of its agent.
    async fn new(name: &str, understands: &str) -> Self {
        Self::with(name, understands, &[]).await
    }

    /// Starts a host with further settings.
    async fn with(name: &str, understands: &str, settings: &[&str]) -> Self {
        let peer = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let at = peer.local_addr().unwrap();
        let peers = format!("discovery.static={{ \"{name}\" = [\"tcp://{at};{understands}\"] }}");
        let config = config(&[&[peers.as_str()], settings].concat());
        let gateway = Gateway::open(&config).await.unwrap();
        let domain = Domain::open(&config).await.unwrap();
        let known = async {
            let mut changes = domain.directory().watch();
            while domain.directory().lookup(name).is_none() {
                changes.next().await.unwrap();
            }
        };
        timeout(TIMEOUT, known).await.unwrap();
        Self {
            gateway,
            domain,
            peer,
        }
    }

    fn address(&self) -> String {
        let mut locations = self.gateway.locations().into_iter();
        let tcp = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
        tcp.address().to_owned()
    }

    /// Reads the next letter to the peer, until the end of the connection.
    async fn read_by_peer(&self) -> Vec<u8> {
        let read = async {
            let (mut stream, _) = self.peer.accept().await.unwrap();
            let mut letter = Vec::new();
            stream.read_to_end(&mut letter).await.unwrap();
            letter
        };
        timeout(TIMEOUT, read).await.unwrap()
    }
}

/// Sends a letter as a legacy peer does: on a connection of its own that ends with the letter.
async fn send_as_peer(letter: &[u8], at: &str) {
    let mut stream = TcpStream::connect(at).await.unwrap();
    stream.write_all(letter).await.unwrap();
    stream.shutdown().await.unwrap();
}

async fn receive(agent: &Agent) -> Message {
    let received = timeout(TIMEOUT, agent.receive()).await;
    received.unwrap().unwrap().into_message()
}

fn read(letter: &[u8]) -> (Envelope, Letter, Message) {
    let (envelope, letter) = Letter::decode(letter.to_vec().into()).unwrap();
    let message = Message::decode(letter.payload()).unwrap();
    (envelope, letter, message)
}

#[tokio::test(flavor = "multi_thread")]
async fn letters_of_fipa_services_are_received_and_answered_in_its_dialect() {
    let host = Host::new("alice", "fipa-services").await;
    let [bob, carol, dave] = [
        host.domain.register("bob").await.unwrap(),
        host.domain.register("carol").await.unwrap(),
        host.domain.register("dave").await.unwrap(),
    ];
    let letters = recorded![
        "e01_simple.be",
        "e01_simple.xml",
        "e02_payload_string.be",
        "e02_payload_string.xml",
        "e04_one_stamp.be",
        "e04_one_stamp.xml",
        "e06_received_full.be",
        "e06_received_full.xml",
        "e07_intended.be",
        "e09_comments_encoding.be",
        "e10_transport_behaviour.be",
        "e12_extra_override.be",
        "e12_extra_override.xml",
        "e14_payload_70k_bin.be",
        "e19_base_over_64k.be",
    ];
    for (file, bytes) in letters {
        send_as_peer(bytes, &host.address()).await;
        let (envelope, _, sent) = read(bytes);
        for to in envelope.effective().intended_receivers {
            let agent = [&bob, &carol, &dave].into_iter();
            let agent = agent.clone().find(|it| it.name() == to.name()).unwrap();
            let message = receive(agent).await;
            assert_eq!(message, sent, "{file} as {} got it", agent.name());
            let answer = agent.reply(&message, Performative::Agree).content(file);
            let (delivered, answer) = tokio::join!(
                agent.send(answer.build().unwrap()),
                timeout(TIMEOUT, host.read_by_peer())
            );
            let delivered = delivered.unwrap();
            let outcome = &delivered.0[0].outcome;
            let handed = matches!(outcome, Outcome::Sent { via: Kind::Tcp, .. });
            assert!(handed, "{file}: {delivered}");
            let (envelope, letter, message) = read(&answer.unwrap());
            assert_eq!(envelope.effective().intended_receivers[0].name(), "alice");
            assert_eq!(message.content().unwrap(), file);
            let theirs = message.encode(Representation::BitEfficient, Dialect::FipaServices);
            assert_eq!(letter.payload().to_bytes(), theirs.unwrap(), "{file}");
            let theirs = envelope.encode(Representation::BitEfficient, Dialect::FipaServices);
            assert_eq!(letter.envelope(), theirs.unwrap(), "{file}");
        }
    }
    host.gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_that_fipa_services_cannot_decode_fails_at_once_with_the_reason() {
    let host = Host::new("alice", "fipa-services").await;
    let [rover, my_arm] = [
        host.domain.register("rover").await.unwrap(),
        host.domain.register("my arm").await.unwrap(),
    ];
    let letter = |from: &Agent| {
        from.message(Performative::Request)
            .receiver(AgentId::new("alice").unwrap())
    };
    let elsewhere = AgentId::new("a b").unwrap();
    let letters = [
        (&rover, letter(&rover).reply_to(elsewhere).build().unwrap()),
        (&my_arm, letter(&my_arm).build().unwrap()),
    ];
    for (from, message) in letters {
        // The test ends long before this deadline, or fails.
        let sent = from.send_within(message, 10 * TIMEOUT);
        let deliveries = timeout(TIMEOUT, sent).await.unwrap().unwrap();
        match &deliveries.0[0].outcome {
            Outcome::Failed { reason, attempts } => {
                assert_eq!(*reason, FailureReason::Inexpressible, "{deliveries}");
                assert_eq!(attempts.len(), 1, "{deliveries}");
                let detail = &attempts[0].error.detail;
                assert!(detail.contains("is not a FIPA00070 word"), "{detail}");
            }
            other => panic!("{other}"),
        }
    }
    // No connection was opened for them: the next connection carries the next letter.
    let plain = letter(&rover).content("plain").build().unwrap();
    let (delivered, read_by_peer) = tokio::join!(rover.send(plain), host.read_by_peer());
    assert!(delivered.unwrap().all_succeeded());
    assert_eq!(read(&read_by_peer).2.content().unwrap(), "plain");
    host.gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn fipa_services_gets_a_failure_for_a_letter_that_cannot_be_decoded() {
    let host = Host::new("alice", "fipa-services").await;
    let bob = host.domain.register("bob").await.unwrap();
    let [(_, recorded)] = recorded!["e01_simple.be"];
    send_as_peer(&recorded[..recorded.len() - 3], &host.address()).await;
    let (_, letter, failure) = read(&host.read_by_peer().await);
    assert_eq!(*failure.performative(), Performative::Failure);
    assert_eq!(failure.receivers()[0].name(), "alice");
    let theirs = failure.encode(Representation::BitEfficient, Dialect::FipaServices);
    assert_eq!(letter.payload().to_bytes(), theirs.unwrap());
    let text = String::from_utf8_lossy(failure.content().unwrap()).into_owned();
    assert!(
        text.contains("cannot be decoded") && text.contains("bob"),
        "{text}"
    );
    // A complete letter follows, and is the first that the agent receives.
    send_as_peer(recorded, &host.address()).await;
    assert_eq!(receive(&bob).await, read(recorded).2);
    host.gateway.close().await;
}

/// Makes a letter to bob from an agent of fipa_services with this address, in these encodings of
/// envelope and message.
fn letter_from(name: &str, address: &str, encoded: [Representation; 2]) -> Vec<u8> {
    letter_to("bob", name, address, encoded)
}

/// Makes a letter like [`letter_from`] to this receiver.
fn letter_to(
    receiver: &str,
    name: &str,
    address: &str,
    [envelope_as, message_as]: [Representation; 2],
) -> Vec<u8> {
    let sender = AgentId::new(name).unwrap().with_address(address).unwrap();
    let bob = AgentId::new(receiver).unwrap();
    let dialect = Dialect::FipaServices;
    let message = Message::builder(Performative::Request)
        .sender(sender.clone())
        .receiver(bob.clone())
        .conversation_id("c-1")
        .content("lift")
        .build()
        .unwrap();
    let base = EnvelopeParams {
        to: vec![bob.clone()],
        from: Some(sender),
        acl_representation: Some(message_as.into()),
        date: Some("20261120T112644481".parse().unwrap()),
        intended_receivers: vec![bob],
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    let mut letter = envelope.encode(envelope_as, dialect).unwrap().to_vec();
    letter.extend_from_slice(&message.encode(message_as, dialect).unwrap());
    letter
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unannounced_agent_is_answered_in_its_dialect_for_all_encodings() {
    use Representation::{BitEfficient, String, Xml};
    let host = Host::new("alice", "fipa-services").await;
    let bob = host.domain.register("bob").await.unwrap();
    let at = format!("tcp://{}", host.peer.local_addr().unwrap());
    let encodings = [
        [BitEfficient, String],
        [BitEfficient, Xml],
        [Xml, String],
        [Xml, Xml],
    ];
    for (number, encoded) in encodings.into_iter().enumerate() {
        let name = format!("carol-{number}");
        send_as_peer(&letter_from(&name, &at, encoded), &host.address()).await;
        let asked = receive(&bob).await;
        let answer = bob.reply(&asked, Performative::Agree).build().unwrap();
        let (delivered, answer) =
            tokio::join!(bob.send(answer), timeout(TIMEOUT, host.read_by_peer()));
        assert!(delivered.unwrap().all_succeeded());
        let (_, letter, message) = read(&answer.unwrap());
        let theirs = message.encode(BitEfficient, Dialect::FipaServices);
        assert_eq!(letter.payload().to_bytes(), theirs.unwrap(), "{encoded:?}");
        // The failure message for a letter to an unknown agent is in its dialect, too.
        let stranger = format!("dave-{number}");
        let lost = letter_to("unknown", &stranger, &at, encoded);
        send_as_peer(&lost, &host.address()).await;
        let (_, letter, failure) = read(&timeout(TIMEOUT, host.read_by_peer()).await.unwrap());
        assert_eq!(*failure.performative(), Performative::Failure);
        assert_eq!(failure.receivers()[0].name(), stranger);
        let theirs = failure.encode(BitEfficient, Dialect::FipaServices);
        assert_eq!(letter.payload().to_bytes(), theirs.unwrap(), "{encoded:?}");
    }
    host.gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unannounced_agent_is_answered_at_the_address_in_its_letter() {
    let plain = [Representation::BitEfficient; 2];
    // The directory knows another agent at the peer only.
    let host = Host::new("alice", "fipa-services").await;
    let bob = host.domain.register("bob").await.unwrap();
    let at = format!("tcp://{}", host.peer.local_addr().unwrap());
    send_as_peer(&letter_from("carol", &at, plain), &host.address()).await;
    let asked = receive(&bob).await;
    assert_eq!(asked.content().unwrap(), "lift");
    let answer = bob.reply(&asked, Performative::Agree).content("done");
    let (delivered, answer) = tokio::join!(
        bob.send(answer.build().unwrap()),
        timeout(TIMEOUT, host.read_by_peer())
    );
    let delivered = delivered.unwrap();
    let handed = matches!(delivered.0[0].outcome, Outcome::Sent { via: Kind::Tcp, .. });
    assert!(handed, "{delivered}");
    let (envelope, letter, message) = read(&answer.unwrap());
    assert_eq!(envelope.effective().intended_receivers[0].name(), "carol");
    assert_eq!(message.content().unwrap(), "done");
    assert_eq!(message.conversation_id(), Some("c-1"));
    let theirs = message.encode(Representation::BitEfficient, Dialect::FipaServices);
    assert_eq!(letter.payload().to_bytes(), theirs.unwrap());

    // The gateway does not connect to an address of another host.
    send_as_peer(
        &letter_from("mallory", "tcp://192.0.2.66:6789", plain),
        &host.address(),
    )
    .await;
    let asked = receive(&bob).await;
    let answer = bob.reply(&asked, Performative::Agree).build().unwrap();
    let delivered = bob.send(answer).await.unwrap();
    match &delivered.0[0].outcome {
        Outcome::Failed { reason, .. } => assert_eq!(*reason, FailureReason::NoSuchAgent),
        other => panic!("{other}"),
    }
    host.gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn jades_proxy_gets_a_request_and_answers_at_the_address_in_the_letter() {
    let host = Host::new("echo@jadetest", "jade").await;
    let rusty = host.domain.register("rusty@rustap").await.unwrap();
    let question = rusty
        .message(Performative::Request)
        .receiver(AgentId::new("echo@jadetest").unwrap())
        .content("(hello)")
        .build()
        .unwrap();
    let (delivered, asked) = tokio::join!(rusty.send(question), host.read_by_peer());
    let delivered = delivered.unwrap();
    let outcome = &delivered.0[0].outcome;
    let handed = matches!(outcome, Outcome::Sent { via: Kind::Tcp, .. });
    assert!(handed, "{delivered}");
    assert!(asked.starts_with(b"<?xml"), "{asked:?}");
    let (_, letter, message) = read(&asked);
    let representation = Representation::detect(&letter.payload().head);
    assert_eq!(representation, Some(Representation::String));
    assert_eq!(message.content().unwrap(), "(hello)");
    // It answers with the recorded letter, at the address in the request.
    let back = message.sender().unwrap().addresses()[0].clone();
    let [(_, recorded)] = recorded!["jade_tcp_reply.xml"];
    send_as_peer(recorded, back.strip_prefix("tcp://").unwrap()).await;
    let answer = receive(&rusty).await;
    assert_eq!(answer, read(recorded).2);
    assert_eq!(answer.sender().unwrap().name(), "echo@jadetest");
    host.gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn fipa_services_gets_a_failure_in_its_dialect_for_a_letter_that_a_rule_refuses() {
    let deny = "access.deny={ alice = [\"bob\"] }";
    let host = Host::with("alice", "fipa-services", &[deny]).await;
    let [bob, carol] = [
        host.domain.register("bob").await.unwrap(),
        host.domain.register("carol").await.unwrap(),
    ];
    let [(_, recorded)] = recorded!["e01_simple.be"];
    send_as_peer(recorded, &host.address()).await;
    let (_, letter, failure) = read(&host.read_by_peer().await);
    assert_eq!(*failure.performative(), Performative::Failure);
    assert_eq!(failure.receivers()[0].name(), "alice");
    let theirs = failure.encode(Representation::BitEfficient, Dialect::FipaServices);
    assert_eq!(letter.payload().to_bytes(), theirs.unwrap());
    let text = String::from_utf8_lossy(failure.content().unwrap()).into_owned();
    assert!(text.contains("refused") && text.contains("bob"), "{text}");
    assert!(bob.try_receive().unwrap().is_none());
    drop(carol);
    host.gateway.close().await;
}

/// Makes a letter to the directory facilitator as JADE's proxy writes it.
fn letter_of_jade(sender: &str, message: &[u8]) -> Vec<u8> {
    letter_of_jade_to(AgentId::new("df@jadetest").unwrap(), sender, message)
}

/// Makes a letter like [`letter_of_jade`] to this receiver.
fn letter_of_jade_to(receiver: AgentId, sender: &str, message: &[u8]) -> Vec<u8> {
    let base = EnvelopeParams {
        to: vec![receiver.clone()],
        from: Some(AgentId::new(sender).unwrap()),
        acl_representation: Some(Representation::String.into()),
        payload_length: Some(message.len() as u64),
        date: Some("20261120T111213456Z".parse().unwrap()),
        intended_receivers: vec![receiver],
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    let mut letter = envelope
        .encode(Representation::Xml, Dialect::Jade)
        .unwrap()
        .to_vec();
    letter.extend_from_slice(message);
    letter
}

/// Makes a request to the directory facilitator.
fn request_of_jade(sender: &str, act: &str) -> Vec<u8> {
    let content = format!("((action (agent-identifier :name df@jadetest) {act}))");
    let message = Message::builder(Performative::Request)
        .sender(AgentId::new(sender).unwrap())
        .receiver(AgentId::new("df@jadetest").unwrap())
        .ontology("FIPA-Agent-Management")
        .language("FIPA-SL0")
        .reply_with("rw-2")
        .content(content)
        .build()
        .unwrap();
    let message = message.encode(Representation::String, Dialect::Jade);
    letter_of_jade(sender, &message.unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_of_jade_uses_the_directory_facilitator() {
    // The recorded messages are addressed to the agents of this platform.
    let name = "mts.name=jadetest";
    let host = Host::with("rusty@rustap", "jade", &[name]).await;
    let rover = host.domain.register("rover").await.unwrap();
    let ask = async |letter: Vec<u8>| {
        send_as_peer(&letter, &host.address()).await;
        read(&host.read_by_peer().await)
    };
    let text = |message: &Message| String::from_utf8(message.content().unwrap().to_vec()).unwrap();
    // The recorded search is answered as JADE answered it.
    let vectors = "platform/tests/vectors";
    let [search, expected] = ["df_search_request.str", "df_search_reply.str"].map(|file| {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        std::fs::read(root.join(vectors).join(file)).unwrap()
    });
    let expected = Message::decode(&fipa::Payload::from(bytes::Bytes::from(expected))).unwrap();
    let (_, letter, answer) = ask(letter_of_jade("rusty@rustap", &search)).await;
    let representation = Representation::detect(&letter.payload().head);
    assert_eq!(representation, Some(Representation::String));
    assert_eq!(answer.content(), expected.content());
    assert_eq!(answer.in_reply_to(), expected.in_reply_to());
    assert_eq!(answer.conversation_id(), expected.conversation_id());
    assert_eq!(answer.receivers()[0].name(), "rusty@rustap");
    // It registers itself, for a time, and no other agent.
    let register = |name: &str| {
        let description = format!(
            "(df-agent-description :name (agent-identifier :name {name}) :services (set \
             (service-description :name s-1 :type echo)))"
        );
        request_of_jade("rusty@rustap", &format!("(register {description})"))
    };
    let (_, _, answer) = ask(register("rusty@rustap")).await;
    assert_eq!(*answer.performative(), Performative::Inform, "{answer}");
    assert!(text(&answer).contains(":lease-time 2"), "{answer}");
    let (_, _, answer) = ask(register("rover")).await;
    assert_eq!(*answer.performative(), Performative::Refuse, "{answer}");
    assert!(text(&answer).ends_with(" unauthorised )"), "{answer}");
    #[cfg(feature = "protocols")]
    {
        let all = fipa::platform::AgentDescription::default();
        let found = rover.df().unwrap().search(&all).await.unwrap();
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].name.as_ref().unwrap().name(), "rusty@rustap");
    }
    // A letter in the name of an agent of this host is not answered: no connection proves the name.
    let forged = "(search (df-agent-description) (search-constraints))";
    send_as_peer(&request_of_jade("rover", forged), &host.address()).await;
    let (_, _, answer) = ask(register("rusty@rustap")).await;
    assert_eq!(text(&answer).matches("already-registered").count(), 1);
    assert!(rover.try_receive().unwrap().is_none());
    host.gateway.close().await;
}

/// Makes the failure message of JADE's agent management system for a letter to an agent that does not
/// exist.
#[cfg(feature = "protocols")]
fn failure_of_jade(lost: &Message) -> Vec<u8> {
    let content = "((action (agent-identifier :name ams@jadetest) (ACLMessage)) \
                   (MTS-error (agent-identifier :name echo@jadetest) \
                   (internal-error \"Agent not found\")))";
    let to = lost.sender().unwrap().clone();
    let message = Message::builder(Performative::Failure)
        .sender(AgentId::new("ams@jadetest").unwrap())
        .receiver(to.clone())
        .ontology("FIPA-Agent-Management")
        .language("fipa-sl")
        .protocol(lost.protocol().unwrap())
        .conversation_id(lost.conversation_id().unwrap())
        .in_reply_to(lost.reply_with().unwrap())
        .content(content)
        .build()
        .unwrap();
    let message = message.encode(Representation::String, Dialect::Jade);
    letter_of_jade_to(to, "ams@jadetest", &message.unwrap())
}

#[cfg(feature = "protocols")]
#[tokio::test(flavor = "multi_thread")]
async fn a_call_for_proposals_does_not_wait_for_an_agent_that_a_legacy_peer_does_not_have() {
    let host = Host::new("echo@jadetest", "jade").await;
    let rover = host.domain.register("rover").await.unwrap();
    let peer = async |act: Performative| {
        let (_, _, lost) = read(&host.read_by_peer().await);
        assert_eq!(*lost.performative(), act);
        send_as_peer(&failure_of_jade(&lost), &host.address()).await;
    };
    // Without the report, each call would wait until the test fails.
    let forever = Duration::from_secs(3600);
    let cfp = rover.message(Performative::Cfp).content("carry");
    let call = rover.contract_net(cfp, &["echo@jadetest"], forever);
    let (net, ()) = tokio::join!(timeout(TIMEOUT, call), peer(Performative::Cfp));
    let net = net.unwrap().unwrap();
    assert_eq!(net.bids().silent, ["echo@jadetest"]);
    assert_eq!(net.bids().unreached, ["echo@jadetest"]);

    // The agent ends between its proposal and the award.
    let cfp = rover.message(Performative::Cfp).content("carry");
    let call = rover.contract_net(cfp, &["echo@jadetest"], forever);
    let proposes = async {
        let (_, _, call) = read(&host.read_by_peer().await);
        let echo = AgentId::new("echo@jadetest").unwrap();
        let to = call.sender().unwrap().clone();
        let bid = Message::builder(Performative::Propose)
            .sender(echo)
            .receiver(to.clone())
            .protocol(call.protocol().unwrap())
            .conversation_id(call.conversation_id().unwrap())
            .in_reply_to(call.reply_with().unwrap())
            .build()
            .unwrap();
        let bid = bid.encode(Representation::String, Dialect::Jade).unwrap();
        let letter = letter_of_jade_to(to, "echo@jadetest", &bid);
        send_as_peer(&letter, &host.address()).await;
    };
    let (net, ()) = tokio::join!(timeout(TIMEOUT, call), proposes);
    let mut net = net.unwrap().unwrap();
    let bids = net.bids().proposals.clone();
    assert_eq!(bids.len(), 1);
    let award = timeout(TIMEOUT, net.award(&bids, "", forever));
    let (awarded, ()) = tokio::join!(award, peer(Performative::AcceptProposal));
    let awarded = awarded.unwrap().unwrap();
    let lost = matches!(
        awarded[0].result,
        Err(fipa::protocol::DialogueError::Undelivered(_))
    );
    assert!(lost, "{awarded:?}");
    host.gateway.close().await;
}
