//! An agent of the C++ library `distributed_locking` behind a real socket, with the messages of its recorded
//! conversations.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fipa::locks::{Algorithm, LockOptions};
use fipa::{
    Agent, AgentId, Config, Domain, Envelope, EnvelopeParams, Gateway, Kind, Letter, Message,
    Performative,
};
use fipa_acl::{Dialect, Representation};
use fipa_testbed::until_async;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};

use super::support::config;
use super::{FOREVER, TURNS, kept, options, watched};

/// The host of our agents, and the C++ agent `agent2`.
struct Stage {
    domain: Domain,
    _gateway: Gateway,
    address: String,
    agent2: TcpListener,
}

impl Stage {
    async fn new() -> Self {
        let agent2 = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let at = agent2.local_addr().unwrap();
        let peers = format!("discovery.static={{ agent2 = [\"tcp://{at};fipa-services\"] }}");
        let config: Config = config(&[&peers, "monitor.check=enforce"]);
        let gateway = Gateway::open(&config).await.unwrap();
        let mut locations = gateway.locations().into_iter();
        let tcp = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
        let address = tcp.address().to_owned();
        let domain = Domain::open(&config).await.unwrap();
        until_async("agent2 is known", || {
            domain.directory().lookup("agent2").is_some()
        })
        .await;
        Self {
            domain,
            _gateway: gateway,
            address,
            agent2,
        }
    }

    async fn agent(&self, name: &str, algorithm: Algorithm) -> Agent {
        let agent = self.domain.register(name).await.unwrap();
        let options = LockOptions {
            legacy_peers: true,
            ..options(algorithm)
        };
        agent.use_locks(options).unwrap();
        agent
    }

    async fn say(&self, to: &[&str], words: [&str; 4]) {
        self.say_as("agent2", to, words).await;
    }

    /// Sends a message of an agent, as fipa_services does: one letter in one connection.
    async fn say_as(&self, agent: &str, to: &[&str], words: [&str; 4]) {
        let [act, protocol, conversation, content] = words.map(str::to_owned);
        let sender = AgentId::new(agent).unwrap();
        let receivers: Vec<_> = to.iter().map(|to| AgentId::new(*to).unwrap()).collect();
        let mut message = Message::builder(act.parse::<Performative>().unwrap())
            .sender(sender.clone())
            .protocol(protocol)
            .conversation_id(conversation)
            .content(content);
        if act == "propagate" {
            message = message.language("suzuki_kasami::Token");
        }
        for receiver in &receivers {
            message = message.receiver(receiver.clone());
        }
        let base = EnvelopeParams {
            to: receivers.clone(),
            from: Some(sender),
            acl_representation: Some(Representation::BitEfficient.into()),
            date: Some("20261120T112644481".parse().unwrap()),
            intended_receivers: receivers,
            ..EnvelopeParams::default()
        };
        let envelope = Envelope {
            base,
            extensions: Vec::new(),
        };
        let (encoding, dialect) = (Representation::BitEfficient, Dialect::FipaServices);
        let mut letter = envelope.encode(encoding, dialect).unwrap().to_vec();
        let message = message.build().unwrap().encode(encoding, dialect).unwrap();
        letter.extend_from_slice(&message);
        let mut stream = TcpStream::connect(&self.address).await.unwrap();
        stream.write_all(&letter).await.unwrap();
        stream.shutdown().await.unwrap();
    }

    /// Receives letters at agent2 until the next one that is no probe, and answers probes. Returns sender,
    /// performative, conversation and content.
    async fn heard(&self) -> [String; 4] {
        loop {
            let (mut stream, _) = self.agent2.accept().await.unwrap();
            let mut letter = Vec::new();
            stream.read_to_end(&mut letter).await.unwrap();
            let (_, letter) = Letter::decode(letter.into()).unwrap();
            let message = Message::decode(letter.payload()).unwrap();
            let sender = message.sender().unwrap().name().to_owned();
            let conversation = message.conversation_id().unwrap().to_owned();
            if message.protocol() == Some("dlm_probe") {
                if *message.performative() == Performative::Request {
                    let answer = ["confirm", "dlm_probe", &conversation, ""];
                    self.say(&[&sender], answer).await;
                }
                continue;
            }
            let content = message.content().map(|content| content.to_vec());
            let content = String::from_utf8(content.unwrap_or_default()).unwrap();
            let act = message.performative().as_str().to_owned();
            return [sender, act, conversation, content];
        }
    }

    async fn hears(&self, expected: [&str; 4]) {
        assert_eq!(self.heard().await, expected);
    }
}

/// Our agent owns the resource: agent2 waits for us, and we wait for agent2.
#[tokio::test(flavor = "multi_thread")]
async fn an_agent_of_the_cpp_library_locks_a_resource_of_ours() {
    watched(async {
        let stage = Stage::new().await;
        // With `legacy_peers`, the default is an algorithm in which it can take part.
        let protocol = Algorithm::RicartAgrawalaExtended.protocol();
        let files = tempfile::tempdir().unwrap();
        let crane = stage.agent("crane", Algorithm::default()).await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        stage
            .say(&["crane"], ["query-if", "dlm_discover", "agent2_0", "bay"])
            .await;
        stage.hears(["crane", "inform", "agent2_0", "bay"]).await;
        stage
            .say(&["crane"], ["request", protocol, "agent2_1", "1\nbay"])
            .await;
        stage.hears(["crane", "agree", "agent2_1", "1\nbay"]).await;
        stage
            .say(&["crane"], ["confirm", protocol, "agent2_1", "bay"])
            .await;
        until_async("agent2 holds the bay", || {
            let status = bay.status();
            status.holder.as_deref() == Some("agent2") && status.fence.is_none()
        })
        .await;
        let late = crane.try_lock("bay");
        assert!(late.await.is_err(), "the bay is in use");
        // The next request waits for the owner's permission until agent2 has left.
        stage
            .say(&["crane"], ["request", protocol, "agent2_2", "5\nbay"])
            .await;
        stage
            .say(&["crane"], ["disconfirm", protocol, "agent2_1", "bay"])
            .await;
        stage.hears(["crane", "agree", "agent2_2", "5\nbay"]).await;
        // It withdraws by not entering. We are next, and our grant has a fence.
        let lock = crane.lock("bay");
        let agrees = async {
            let [sender, act, conversation, content] = stage.heard().await;
            assert_eq!((sender.as_str(), act.as_str()), ("crane", "request"));
            assert!(content.ends_with("\nbay"), "{content}");
            let agree = ["agree", protocol, &conversation, "9\nbay"];
            stage.say(&["crane"], agree).await;
        };
        let (lock, ()) = tokio::join!(lock, agrees);
        let lock = lock.unwrap();
        assert!(bay.admit(lock.fence().unwrap()));
        // An agent without a fence waits for the end of the grant.
        stage
            .say(&["crane"], ["request", protocol, "agent2_3", "10\nbay"])
            .await;
        lock.release();
        let [_, act, conversation, _] = stage.heard().await;
        assert_eq!((act.as_str(), conversation.as_str()), ("agree", "agent2_3"));
    })
    .await;
}

/// In the owner's queue an agent of the C++ library cannot take part. It gets a refusal with the name of the algorithm,
/// which that library ignores.
#[tokio::test(flavor = "multi_thread")]
async fn an_agent_of_the_cpp_library_is_refused_at_a_queue() {
    watched(async {
        let stage = Stage::new().await;
        let files = tempfile::tempdir().unwrap();
        let crane = super::agent(&stage.domain, "crane").await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let protocol = Algorithm::RicartAgrawala.protocol();
        stage
            .say(&["crane"], ["request", protocol, "agent2_1", "1\nbay"])
            .await;
        let refusal = "bay\nalgorithm owner_queue";
        stage.hears(["crane", "refuse", "agent2_1", refusal]).await;
        assert!(bay.status().holder.is_none());
    })
    .await;
}

/// agent2 owns the resource, with both algorithms. An agent that was told none uses the extended Ricart-Agrawala.
#[tokio::test(flavor = "multi_thread")]
async fn we_lock_a_resource_of_an_agent_of_the_cpp_library() {
    watched(async {
        for (told, algorithm) in [
            (Algorithm::default(), Algorithm::RicartAgrawalaExtended),
            (
                Algorithm::RicartAgrawalaExtended,
                Algorithm::RicartAgrawalaExtended,
            ),
            (
                Algorithm::SuzukiKasamiExtended,
                Algorithm::SuzukiKasamiExtended,
            ),
        ] {
            let stage = Stage::new().await;
            let protocol = algorithm.protocol();
            let rover = stage.agent("rover", told).await;
            let owner = async {
                let [_, act, conversation, content] = stage.heard().await;
                assert_eq!((act.as_str(), content.as_str()), ("query-if", "rsc"));
                let inform = ["inform", "dlm_discover", &conversation, "rsc"];
                stage.say(&["rover"], inform).await;
                let [_, act, conversation, content] = stage.heard().await;
                assert_eq!(act, "request");
                match algorithm.has_token() {
                    true => {
                        assert_eq!(content, "rsc\n1");
                        let token = "22 serialization::archive 18 3 rsc 0 0 0 0 1 0 0 0 0 0 5 rover 0 0 0 0 0";
                        let passed = ["propagate", protocol, &conversation, token];
                        stage.say(&["rover"], passed).await;
                    }
                    false => {
                        assert_eq!(content, "1\nrsc");
                        let agree = ["agree", protocol, &conversation, "3\nrsc"];
                        stage.say(&["rover"], agree).await;
                        stage.hears(["rover", "confirm", &conversation, "rsc"]).await;
                    }
                }
                conversation
            };
            let (lock, conversation) = tokio::join!(rover.lock("rsc"), owner);
            let lock = lock.unwrap();
            assert!(lock.is_held() && lock.fence().is_none());
            assert_eq!(lock.remaining(), None);
            lock.release();
            let left = match algorithm.has_token() {
                true => {
                    let token = "22 serialization::archive 18 3 rsc 0 0 0 0 1 0 0 0 0 0 5 rover 1 0 0 0 0";
                    ["rover", "propagate", &conversation, token]
                }
                false => ["rover", "disconfirm", &conversation, "rsc"],
            };
            stage.hears(left).await;
        }
    })
    .await;
}

/// An agent that uses locks answers before its first request.
#[tokio::test(flavor = "multi_thread")]
async fn an_agent_that_uses_locks_answers_before_its_first_request() {
    watched(async {
        let stage = Stage::new().await;
        let algorithm = Algorithm::RicartAgrawala;
        let protocol = algorithm.protocol();
        let _rover = stage.agent("rover", algorithm).await;
        let request = ["request", protocol, "agent2_0", "7\nrsc"];
        stage.say(&["rover"], request).await;
        stage.hears(["rover", "agree", "agent2_0", "7\nrsc"]).await;
    })
    .await;
}

/// agent2 owns the resource, and agrees to each request at once.
#[tokio::test(flavor = "multi_thread")]
async fn agents_of_one_process_exclude_each_other_at_a_foreign_owner() {
    watched(async {
        let stage = Stage::new().await;
        let algorithm = Algorithm::RicartAgrawala;
        let protocol = algorithm.protocol();
        let (rover, arm) = tokio::join!(
            stage.agent("rover", algorithm),
            stage.agent("arm", algorithm)
        );
        let is_used = AtomicBool::new(false);
        let uses = async |agent: &Agent| {
            for _ in 0..TURNS {
                let lock = agent.lock("rsc").await.unwrap();
                assert!(!is_used.swap(true, Ordering::SeqCst));
                tokio::time::sleep(Duration::from_millis(20)).await;
                is_used.store(false, Ordering::SeqCst);
                lock.release();
            }
        };
        let owns = async {
            loop {
                let [sender, act, conversation, content] = stage.heard().await;
                let answer = match act.as_str() {
                    "query-if" => ["inform", "dlm_discover", &conversation, "rsc"],
                    "request" => {
                        let (clock, _) = content.split_once('\n').unwrap();
                        let clock = clock.parse::<u64>().unwrap() + 2;
                        let agree = format!("{clock}\nrsc");
                        let agree = ["agree", protocol, &conversation, &agree];
                        stage.say(&[&sender], agree).await;
                        continue;
                    }
                    _ => continue,
                };
                stage.say(&[&sender], answer).await;
            }
        };
        tokio::select! {
            _ = async { tokio::join!(uses(&rover), uses(&arm)) } => {}
            () = owns => {}
        }
    })
    .await;
}

/// The name of an agent with a registration counts in letters of its own process only.
#[tokio::test(flavor = "multi_thread")]
async fn a_legacy_peer_cannot_speak_for_a_registered_agent() {
    watched(async {
        let stage = Stage::new().await;
        let algorithm = Algorithm::RicartAgrawala;
        let protocol = algorithm.protocol();
        let files = tempfile::tempdir().unwrap();
        // Without `legacy_peers`: agent2 takes part from its first message.
        let crane = super::agent_with(&stage.domain, "crane", algorithm).await;
        let rover = super::agent_with(&stage.domain, "rover", algorithm).await;
        let bay = crane.own("bay", kept(&files, FOREVER)).await.unwrap();
        let lock = rover.lock("bay").await.unwrap();
        let fence = lock.fence().unwrap().clone();
        assert_eq!(bay.status().holder.as_deref(), Some("rover"));
        // A report of the holder in a later conversation ends its grant. Numbers begin with the time.
        let confirm = ["confirm", protocol, "rover_9000000000000", "bay"];
        stage.say_as("rover", &["crane"], confirm).await;
        let query = ["query-if", "dlm_discover", "agent2_0", "bay"];
        stage.say(&["crane"], query).await;
        stage.hears(["crane", "inform", "agent2_0", "bay"]).await;
        assert!(bay.admit(&fence), "{:?}", bay.status());
        assert_eq!(bay.status().holder.as_deref(), Some("rover"));
        drop(lock);
        until_async("the bay is free", || bay.status().holder.is_none()).await;
    })
    .await;
}
