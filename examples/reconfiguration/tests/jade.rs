//! The operator is an agent of JADE, `StackOperator.java`. A recorded run is repeated: the requests of JADE go to the
//! robots again, and each answer in the recording has to come again.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::Command;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use fipa::{Message, Performative};
use fipa_reconfiguration::launch::{self, Options};
use fipa_reconfiguration::part::Part;
use fipa_reconfiguration::report::{Claim, Report};
use fipa_testbed::jade;

/// The requests in both directions, in the order of their times: those of JADE, and those with answers to it.
const RECORDING: &[u8] = include_bytes!("data/jade_operator.bin");
/// The answer of JADE to a request.
const ANSWER: &[u8] = include_bytes!(
    "../../../transport-net/tests/data/jade_http/keepalive-http-response-from-jade.bin"
);
/// The address of JADE in the recording, and that of the gateway of `crex`.
const JADE: &str = "127.0.0.1:39191";
const GATEWAY: &str = "127.0.0.1:44839";

/// The program that the launcher starts as the operator: it stores its part, and prints the claims of the test.
const OPERATOR: &str = r#"printf %s "$1" > "$0/new"; mv "$0/new" "$0/part"; exec cat "$0/claims""#;

/// Pause between two searches.
const PAUSE: Duration = Duration::from_millis(100);
const TIMEOUT: Duration = Duration::from_secs(60);

#[tokio::test]
async fn the_operator_may_be_an_agent_of_jade() {
    let dir = tempfile::tempdir().unwrap();
    let mut made = Command::new("mkfifo");
    made.arg(dir.path().join("claims"));
    assert!(made.status().unwrap().success());
    let path = dir.path().to_owned();
    let replay = thread::spawn(move || Replay::new(&path).run());
    let operator = ["sh", "-c", OPERATOR].map(Into::into).to_vec();
    let options = Options {
        seed: 1,
        program: vec![env!("CARGO_BIN_EXE_reconfiguration").into(), "part".into()],
        operator: Some([operator, vec![dir.path().into()]].concat()),
        ..Options::default()
    };
    let outcome = launch::run(&options, &mut |_| {}).await;
    // Its panic says why a run has failed.
    let answers = replay.join().unwrap();
    let outcome = outcome.unwrap();
    assert!(outcome.failed.is_empty(), "{:?}", outcome.failed);
    assert_eq!(answers, 14);
    let docked = |report: &&Report| matches!(report.claim, Claim::Docked { .. });
    assert_eq!(outcome.reports.iter().filter(docked).count(), 2);
}

/// A recorded run of the agent of JADE, which is repeated.
struct Replay {
    /// Its end ends the operator, also when the test fails.
    claims: File,
    /// Pairs of an address in the recording, and the one in its place.
    addresses: Vec<(String, String)>,
    letters: Receiver<Message>,
    /// Letters that came before their turn in the recording.
    early: Vec<Message>,
    /// The items of the calls for proposals and of the dockings, by conversation.
    items: HashMap<String, String>,
    /// The bids, by conversation and robot.
    bids: HashMap<String, BTreeMap<String, f64>>,
    stack: Vec<String>,
}

impl Replay {
    /// Waits until the launcher has started the operator.
    fn new(dir: &Path) -> Self {
        let part = fipa_testbed::until_some("the part", || std::fs::read(dir.join("part")).ok());
        let claims = File::options().write(true).open(dir.join("claims"));
        let part: Part = serde_json::from_slice(&part).unwrap();
        let platform = part.platform.unwrap();
        assert_eq!(platform.name, "crex-mts");
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let here = listener.local_addr().unwrap().to_string();
        let gateway = addresses(&platform.address).remove(0);
        let (sender, letters) = channel();
        thread::spawn(move || {
            for stream in listener.incoming() {
                let sender = sender.clone();
                thread::spawn(move || receive(stream.unwrap(), &sender));
            }
        });
        Self {
            claims: claims.unwrap(),
            addresses: vec![(JADE.to_owned(), here), (GATEWAY.to_owned(), gateway)],
            letters,
            early: Vec::new(),
            items: HashMap::new(),
            bids: HashMap::new(),
            stack: Vec::new(),
        }
    }

    /// Returns the number of answers.
    fn run(mut self) -> usize {
        let (mut answers, mut last) = (0, (Vec::new(), String::new()));
        for request in jade::requests(RECORDING) {
            let message = read(request);
            let to = &addresses(str::from_utf8(&request[..60]).unwrap())[0];
            if to == JADE {
                answers += 1;
                // As in `StackOperator.java`, a search is repeated until it finds the agents.
                while !self.answer(&message) {
                    thread::sleep(PAUSE);
                    jade::post(&last.0, &last.1);
                }
                continue;
            }
            let (_, to) = self.addresses.iter().find(|(from, _)| from == to).unwrap();
            let pairs = self.addresses.iter();
            let pairs: Vec<(&str, &str)> = pairs.map(|(from, to)| (&**from, &**to)).collect();
            last = (jade::readdressed(request, &pairs), to.clone());
            jade::post(&last.0, &last.1);
            if let Some(award) = self.sent(&message) {
                claim(&self.claims, award);
            }
        }
        assert_eq!(self.early, []);
        assert!(self.letters.try_recv().is_err());
        let (stack, reason) = (self.stack, None);
        claim(&self.claims, Claim::Finished { stack, reason });
        answers
    }

    /// Keeps what the operator knows after it has sent a message. Returns its claim.
    fn sent(&mut self, message: &Message) -> Option<Claim> {
        let conversation = message.conversation_id().unwrap().to_owned();
        let content = message.text();
        match message.performative() {
            Performative::Cfp => {
                let call: serde_json::Value = serde_json::from_str(&content).unwrap();
                let item = call["item"].as_str().unwrap().to_owned();
                self.items.insert(conversation, item);
            }
            Performative::Request => {
                if let Some((_, item)) = content.split_once("(dock :item ") {
                    let item = item.split(' ').next().unwrap().to_owned();
                    self.items.insert(conversation, item);
                }
            }
            Performative::AcceptProposal => {
                return Some(Claim::Award {
                    item: self.items[&conversation].clone(),
                    bids: self.bids[&conversation].clone(),
                    robot: message.receivers()[0].name().to_owned(),
                });
            }
            _ => {}
        }
        None
    }

    /// Waits for this answer of the recording. Returns whether it has as many agents, if it is that of a search.
    fn answer(&mut self, recorded: &Message) -> bool {
        let key = |it: &Message| {
            let sender = it.sender().unwrap().name().to_owned();
            let conversation = it.conversation_id().unwrap().to_owned();
            (conversation, sender, it.performative().clone())
        };
        let is_it = |it: &Message| key(it) == key(recorded);
        while !self.early.iter().any(is_it) {
            let next = self.letters.recv_timeout(TIMEOUT);
            let next = next.unwrap_or_else(|_| panic!("this answer does not come: {recorded:?}"));
            self.early.push(next);
        }
        let at = self.early.iter().position(is_it).unwrap();
        let answer = self.early.remove(at);
        assert_eq!(answer.in_reply_to(), recorded.in_reply_to());
        // Later requests of the recording have it as their in-reply-to.
        assert_eq!(answer.reply_with(), recorded.reply_with());
        assert_eq!(answer.protocol(), recorded.protocol());
        assert_eq!(answer.language(), recorded.language());
        assert_eq!(answer.ontology(), recorded.ontology());
        assert_eq!(answer.receivers().len(), 1);
        assert_eq!(answer.receivers()[0].name(), "operator@jade");
        // The directory facilitator tells where the gateways of the found agents take letters.
        let (then, now) = (addresses(&recorded.text()), addresses(&answer.text()));
        if answer.sender().unwrap().name() == "df@crex-mts" && then.len() != now.len() {
            return false;
        }
        assert_eq!(then.len(), now.len(), "{answer:?}");
        self.addresses.extend(then.into_iter().zip(now));
        let (conversation, robot, act) = key(&answer);
        match act {
            Performative::Propose => {
                let cost = answer.text().parse().unwrap();
                self.bids
                    .entry(conversation)
                    .or_default()
                    .insert(robot, cost);
            }
            // Calls for proposals have bids.
            Performative::Inform if !self.bids.contains_key(&conversation) => {
                self.stack.extend(self.items.remove(&conversation));
            }
            _ => {}
        }
        true
    }
}

/// Returns the addresses behind `http://` in a text.
fn addresses(text: &str) -> Vec<String> {
    let all = text.split("http://").skip(1);
    all.map(|it| it.split('/').next().unwrap().to_owned())
        .collect()
}

/// Reads the message of a request.
fn read(request: &[u8]) -> Message {
    let payload = fipa_acl::Payload {
        head: jade::message(request).to_vec().into(),
        ..fipa_acl::Payload::default()
    };
    Message::decode(&payload).unwrap()
}

/// Reads the requests of a connection, and answers each as JADE does.
fn receive(mut stream: TcpStream, sender: &Sender<Message>) {
    let (mut bytes, mut more) = (Vec::new(), [0; 65536]);
    // A gateway that ends closes its connections.
    while let Ok(len @ 1..) = stream.read(&mut more) {
        bytes.extend(&more[..len]);
        let head = bytes.windows(4).position(|it| it == b"\r\n\r\n");
        let Some(head) =
            head.filter(|it| bytes.len() >= it + 4 + jade::content_length(&bytes[..*it]))
        else {
            continue;
        };
        assert_eq!(bytes.len(), head + 4 + jade::content_length(&bytes[..head]));
        sender.send(read(&bytes)).unwrap();
        bytes.clear();
        stream.write_all(ANSWER).unwrap();
    }
}

/// Reports to the launcher.
fn claim(mut claims: &File, claim: Claim) {
    let at = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    let report = Report {
        at: u64::try_from(at.as_micros()).unwrap(),
        by: "operator".to_owned(),
        claim,
    };
    let line = serde_json::to_string(&report).unwrap();
    writeln!(claims, "{line}").unwrap();
}
