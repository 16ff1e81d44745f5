//! Letters from and to libudt 4.11, the library of fipa_services: of every length, many in a row, with
//! packet loss, and when one side restarts or stops reading.
//!
//! The peer is a program of ours, `peer.cpp`, with Debian's `libudt-dev`. Without it, or without a C++
//! compiler, the tests are skipped; with `CI=true` they fail.
#![cfg(feature = "udt")]
#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    reason = "a test that cannot go on may panic, and a skipped test prints a note"
)]

#[path = "../common/mod.rs"]
mod common;

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use bytes::Bytes;
use common::{Party, Recorder, letter_parcel, udt_config};
use fipa_acl::{
    AclRepresentation, AgentId, Dialect, Envelope, EnvelopeParams, Letter, Message, Performative,
    Representation,
};
use fipa_testbed::until_some;
use fipa_transport::{Conclusion, Kind, Location, Transport as _, TransportErrorKind};
use fipa_transport_net::{UdtConfig, UdtTransport};

/// A recorded letter of a fipa_services peer to an agent `echo`.
const RECORDED: &[u8] = include_bytes!("../data/tcp_letter.bin");

/// Lengths of contents: around those of one packet and of two, and up to nearly the largest.
const LENGTHS: [usize; 12] = [
    1, 100, 1000, 1300, 1456, 2500, 10_000, 65_000, 100_000, 1_000_000, 4_000_000, 9_000_000,
];

/// A test that waits this long has failed.
const TIMEOUT: Duration = Duration::from_secs(120);

const LOOPBACK: &str = "127.0.0.1";

/// Builds the peer. Returns `None` if the test is skipped.
fn peer() -> Option<&'static Path> {
    static BUILT: OnceLock<Option<PathBuf>> = OnceLock::new();
    let built = BUILT.get_or_init(|| {
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/libudt/peer.cpp");
        let directory = Path::new(env!("CARGO_TARGET_TMPDIR"));
        let program = directory.join("libudt-peer");
        // Other processes may build it at the same time, with the same number in a namespace of their own.
        let building = tempfile::tempdir_in(directory).unwrap();
        let built = building.path().join("libudt-peer");
        let mut compiler = Command::new("g++");
        compiler.args(["-std=c++17", "-O2", "-o"]).arg(&built);
        let output = compiler.arg(&source).args(["-ludt", "-pthread"]).output();
        let missing = match output {
            Ok(output) if output.status.success() => {
                std::fs::rename(built, &program).unwrap();
                return Some(program);
            }
            Ok(output) => {
                let errors = String::from_utf8_lossy(&output.stderr).into_owned();
                let is_missing = errors.contains("udt/udt.h: No such file");
                assert!(is_missing, "the peer cannot be built: {errors}");
                "libudt-dev"
            }
            Err(error) => {
                assert_eq!(error.kind(), std::io::ErrorKind::NotFound, "g++: {error}");
                "g++"
            }
        };
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "missing: {missing}");
        eprintln!("SKIPPED, not a success: the tests with libudt need {missing}");
        None
    });
    built.as_deref()
}

/// A process of the peer. It is killed on drop.
struct Process {
    child: Child,
    stdin: Option<ChildStdin>,
    stdout: Option<BufReader<ChildStdout>>,
    /// Its first line.
    ready: String,
}

impl Process {
    fn start(program: &Path, arguments: &[&str]) -> Self {
        let mut child = Command::new(program)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut ready = String::new();
        stdout.read_line(&mut ready).unwrap();
        assert!(ready.starts_with("ready"), "{arguments:?}: {ready:?}");
        Self {
            stdin: child.stdin.take(),
            stdout: Some(stdout),
            child,
            ready,
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A peer that receives letters.
struct Listener {
    process: Process,
    location: Location,
    letters: Receiver<Vec<u8>>,
}

impl Listener {
    fn new(program: &Path) -> Self {
        Self::with(program, "0", &[])
    }

    fn with(program: &Path, port: &str, more: &[&str]) -> Self {
        let arguments = [&["receive", LOOPBACK, port], more].concat();
        let mut process = Process::start(program, &arguments);
        let port = process.ready.trim_start_matches("ready ").trim();
        let location = Location::new(Kind::Udt, &format!("{LOOPBACK}:{port}")).unwrap();
        let mut stdout = process.stdout.take().unwrap();
        let (sender, letters) = channel();
        std::thread::spawn(move || {
            loop {
                let mut len = [0; 4];
                if stdout.read_exact(&mut len).is_err() {
                    return;
                }
                let mut letter = vec![0; u32::from_le_bytes(len) as usize];
                if stdout.read_exact(&mut letter).is_err() || sender.send(letter).is_err() {
                    return;
                }
            }
        });
        Self {
            process,
            location,
            letters,
        }
    }

    /// Returns the content of the next letter.
    fn content(&self) -> Vec<u8> {
        let bytes = Bytes::from(self.letters.recv_timeout(TIMEOUT).unwrap());
        let (envelope, len) = Envelope::decode(&bytes).unwrap();
        let to = envelope.effective().intended_receivers;
        assert_eq!(to[0].name(), "arm");
        content(&bytes.slice(len..).into())
    }

    fn port(&self) -> String {
        self.location
            .address()
            .rsplit_once(':')
            .unwrap()
            .1
            .to_owned()
    }
}

fn content(payload: &fipa_acl::Payload) -> Vec<u8> {
    let message = Message::decode(payload).unwrap();
    message.content().unwrap().to_vec()
}

/// A peer that sends letters.
struct Sender(Process);

impl Sender {
    fn new(program: &Path, to: &Location) -> Self {
        let (address, port) = to.address().rsplit_once(':').unwrap();
        Self(Process::start(program, &["send", address, port]))
    }

    fn send(&mut self, letter: &[u8]) {
        let stdin = self.0.stdin.as_mut().unwrap();
        let len = u32::try_from(letter.len()).unwrap();
        stdin.write_all(&len.to_le_bytes()).unwrap();
        stdin.write_all(letter).unwrap();
    }

    /// Waits until all letters are acknowledged.
    fn finish(mut self) {
        drop(self.0.stdin.take());
        let mut rest = String::new();
        let stdout = self.0.stdout.as_mut().unwrap();
        stdout.read_to_string(&mut rest).unwrap();
        assert_eq!(rest, "sent\n");
        assert!(self.0.child.wait().unwrap().success());
    }
}

fn party() -> Party<UdtTransport> {
    with(udt_config(&["127.0.0.1:0"]))
}

fn with(config: UdtConfig) -> Party<UdtTransport> {
    Party::over(Recorder::default(), |runtime| {
        UdtTransport::new(config, runtime)
    })
}

/// A content of this length with this number.
fn text(number: u64, len: usize) -> Vec<u8> {
    let mut text = format!("{number} ").into_bytes();
    let mut random = fastrand::Rng::with_seed(number);
    text.resize_with(len.max(text.len()), || random.u8(b'!'..=b'~'));
    text.truncate(len);
    text
}

fn message(content: Vec<u8>) -> Message {
    let built = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content(content)
        .build();
    built.unwrap()
}

/// A letter as fipa_services writes it.
fn letter(content: Vec<u8>) -> Vec<u8> {
    let (_, length) = Envelope::decode(RECORDED).unwrap();
    let message = message(content)
        .encode(Representation::BitEfficient, Dialect::FipaServices)
        .unwrap();
    [&RECORDED[..length], &message].concat()
}

/// A letter of this project.
fn parcel(sequence: u64, content: Vec<u8>) -> fipa_transport::Parcel {
    let arm = AgentId::new("arm").unwrap();
    let envelope = Envelope {
        base: EnvelopeParams {
            to: vec![arm.clone()],
            from: Some(AgentId::new("rover").unwrap()),
            acl_representation: Some(AclRepresentation::BitEfficient),
            date: Some("20261120T112644481Z".parse().unwrap()),
            intended_receivers: vec![arm],
            ..EnvelopeParams::default()
        },
        extensions: Vec::new(),
    };
    let payload = message(content).to_payload();
    let letter = Letter::new(envelope.encode_standard().unwrap(), payload);
    let mut parcel = letter_parcel(sequence, letter);
    parcel.receiver = "arm".into();
    parcel
}

/// Waits for letters, and returns their contents in the order of arrival.
fn arrived(party: &Party<UdtTransport>, count: usize) -> Vec<Vec<u8>> {
    until_some("the letters", || {
        let record = party.sink.record.lock();
        (record.unframed.len() >= count).then_some(())
    });
    let record = party.sink.record.lock();
    let letters = record.unframed.iter().map(|(letter, via)| {
        assert_eq!(*via, Kind::Udt);
        content(letter.payload())
    });
    letters.collect()
}

/// Sends contents to a peer and from a peer, and asserts that they arrive unchanged and in order.
fn assert_exchanged(program: &Path, contents: &[Vec<u8>]) {
    let (party, listener) = (party(), Listener::new(program));
    for (number, content) in (0..).zip(contents) {
        let parcel = parcel(number, content.clone());
        // Not more than may wait.
        until_some("room for the letter", || {
            let sent = party.send(number, &listener.location, parcel.clone());
            match sent {
                Ok(()) => Some(()),
                Err(error) if error.fault == TransportErrorKind::Congested => None,
                Err(error) => panic!("{error}"),
            }
        });
    }
    for (number, content) in (0..).zip(contents) {
        assert_eq!(party.conclusion(number), Conclusion::Handed);
        assert!(
            listener.content() == *content,
            "letter {number} has changed"
        );
    }
    let mut sender = Sender::new(program, party.location());
    for content in contents {
        sender.send(&letter(content.clone()));
    }
    sender.finish();
    let arrived = arrived(&party, contents.len());
    for (number, (arrived, sent)) in arrived.iter().zip(contents).enumerate() {
        assert!(arrived == sent, "letter {number} has changed");
    }
    let counters = party.transport.counters();
    let count = contents.len() as u64;
    assert_eq!((counters.letters_out, counters.letters_in), (count, count));
    assert_eq!((counters.dialed, counters.accepted), (1, 1));
    assert_eq!(counters.refused_nonsense, 0);
}

#[test]
fn letters_of_every_length_arrive_unchanged() {
    let Some(program) = peer() else { return };
    let contents = (0..).zip(LENGTHS).map(|(number, len)| text(number, len));
    assert_exchanged(program, &contents.collect::<Vec<_>>());
}

#[test]
fn a_thousand_letters_arrive_in_order() {
    let Some(program) = peer() else { return };
    let contents = (0..1000).map(|number| text(number, 50 + number as usize % 2000));
    assert_exchanged(program, &contents.collect::<Vec<_>>());
}

#[test]
fn letters_arrive_although_one_packet_in_a_hundred_is_lost() {
    fipa_testbed::isolated(
        "inside_letters_arrive_although_one_packet_in_a_hundred_is_lost",
        &["ip", "nft"],
    );
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_letters_arrive_although_one_packet_in_a_hundred_is_lost() {
    exchange_with_losses(1);
}

#[test]
fn letters_arrive_although_one_packet_in_twenty_is_lost() {
    fipa_testbed::isolated(
        "inside_letters_arrive_although_one_packet_in_twenty_is_lost",
        &["ip", "nft"],
    );
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_letters_arrive_although_one_packet_in_twenty_is_lost() {
    exchange_with_losses(5);
}

fn exchange_with_losses(percent: u32) {
    fipa_testbed::enter();
    let Some(program) = peer() else { return };
    let rules = format!(
        "add table inet loss; add chain inet loss input {{ type filter hook input priority 0; }}; \
         add rule inet loss input meta l4proto udp numgen random mod 100 < {percent} drop"
    );
    let nft = Command::new("nft").arg(rules).status().unwrap();
    assert!(nft.success());
    let short = (0..200).map(|number| text(number, 100 + number as usize * 20));
    let long = [100_000, 1_000_000, 9_000_000].into_iter().zip(200..);
    let long = long.map(|(len, number)| text(number, len));
    assert_exchanged(program, &short.chain(long).collect::<Vec<_>>());
}

#[test]
fn a_killed_receiver_is_noticed_and_reached_again() {
    let Some(program) = peer() else { return };
    let (party, listener) = (party(), Listener::new(program));
    party
        .send(1, &listener.location, parcel(1, text(1, 10)))
        .unwrap();
    assert_eq!(party.conclusion(1), Conclusion::Handed);
    assert_eq!(listener.content(), text(1, 10));
    let (location, port) = (listener.location.clone(), listener.port());
    drop(listener);
    // A letter to a process that has ended, and has not restarted.
    party.send(2, &location, parcel(2, text(2, 10))).unwrap();
    assert!(
        matches!(
            party.conclusion(2),
            Conclusion::Unconfirmed(_) | Conclusion::NotSent(_)
        ),
        "{:?}",
        party.conclusion(2)
    );
    let listener = Listener::with(program, &port, &[]);
    party.send(3, &location, parcel(3, text(3, 10))).unwrap();
    assert_eq!(party.conclusion(3), Conclusion::Handed);
    assert_eq!(listener.content(), text(3, 10));
}

/// The new process does not know the connection, and nothing tells this side so.
#[test]
fn a_receiver_that_restarts_unnoticed_is_reached_again() {
    let Some(program) = peer() else { return };
    let (party, listener) = (party(), Listener::new(program));
    party
        .send(1, &listener.location, parcel(1, text(1, 10)))
        .unwrap();
    assert_eq!(party.conclusion(1), Conclusion::Handed);
    let (location, port) = (listener.location.clone(), listener.port());
    drop(listener);
    let listener = Listener::with(program, &port, &[]);
    let mut attempt = 2;
    until_some("a letter to the new process", || {
        party
            .send(attempt, &location, parcel(attempt, text(attempt, 10)))
            .unwrap();
        attempt += 1;
        (party.conclusion(attempt - 1) == Conclusion::Handed).then_some(())
    });
    assert_eq!(listener.content(), text(attempt - 1, 10));
}

#[test]
fn the_sender_of_a_letter_that_is_too_large_is_known() {
    let Some(program) = peer() else { return };
    let party = party();
    let mut sender = Sender::new(program, party.location());
    sender.send(&letter(text(1, 10_000_000)));
    sender.send(&letter(text(2, 10)));
    sender.finish();
    assert_eq!(arrived(&party, 1), [text(2, 10)]);
    let record = party.sink.record.lock();
    let [refused] = &record.refused[..] else {
        panic!("{} letters were refused", record.refused.len());
    };
    let envelope = refused.parse_envelope().unwrap().effective();
    assert!(envelope.from.is_some(), "{envelope:?}");
    assert_eq!(envelope.intended_receivers.len(), 1);
}

#[test]
fn a_killed_sender_leaves_nothing_and_can_return() {
    let Some(program) = peer() else { return };
    let party = party();
    let mut sender = Sender::new(program, party.location());
    sender.send(&letter(text(1, 10)));
    arrived(&party, 1);
    drop(sender);
    let mut sender = Sender::new(program, party.location());
    sender.send(&letter(text(2, 3_000_000)));
    sender.finish();
    assert_eq!(arrived(&party, 2), [text(1, 10), text(2, 3_000_000)]);
    assert_eq!(party.transport.counters().accepted, 2);
}

#[test]
fn this_side_closes_and_returns_at_the_same_port() {
    let Some(program) = peer() else { return };
    let first = party();
    let mut sender = Sender::new(program, first.location());
    sender.send(&letter(text(1, 10)));
    arrived(&first, 1);
    let address = first.location().address().to_owned();
    first.transport.close();
    // libudt closes the connection, so that the application gets an error.
    let code = until_some("the end of the sender", || {
        let next = letter(text(2, 10));
        let len = u32::try_from(next.len()).unwrap();
        let stdin = sender.0.stdin.as_mut().unwrap();
        let _ = stdin.write_all(&[&len.to_le_bytes()[..], &next].concat());
        sender.0.child.try_wait().unwrap()
    });
    assert_eq!(code.code(), Some(1));
    drop(first);
    let second = with(udt_config(&[&address]));
    let mut sender = Sender::new(program, second.location());
    sender.send(&letter(text(3, 10)));
    sender.finish();
    assert_eq!(arrived(&second, 1), [text(3, 10)]);
}

#[test]
fn a_peer_that_stops_reading_gets_the_rest_when_it_reads_again() {
    let Some(program) = peer() else { return };
    let party = party();
    let mut listener = Listener::with(program, "0", &["3"]);
    let contents: Vec<Vec<u8>> = (0..30).map(|number| text(number, 1_000_000)).collect();
    for (number, content) in (0..).zip(&contents) {
        party
            .send(number, &listener.location, parcel(number, content.clone()))
            .unwrap();
    }
    // The receive buffer of libudt holds 12 MB.
    for number in 0..3 {
        assert_eq!(party.conclusion(number), Conclusion::Handed);
    }
    let handed = || {
        let record = party.sink.record.lock();
        record.concluded.len()
    };
    let mut before = 0;
    until_some("the buffer of the peer is full", || {
        std::thread::sleep(Duration::from_millis(500));
        let now = handed();
        (std::mem::replace(&mut before, now) == now).then_some(())
    });
    assert!((3..20).contains(&handed()), "{}", handed());
    listener
        .process
        .stdin
        .as_mut()
        .unwrap()
        .write_all(b"\n")
        .unwrap();
    for (number, content) in (0..).zip(&contents) {
        assert_eq!(party.conclusion(number), Conclusion::Handed);
        assert!(listener.content() == *content);
    }
}

#[test]
fn a_peer_that_does_not_read_again_is_given_up() {
    let Some(program) = peer() else { return };
    let mut config = udt_config(&["127.0.0.1:0"]);
    config.limits.stall_timeout = Duration::from_secs(2);
    let party = with(config);
    let listener = Listener::with(program, "0", &["1"]);
    for number in 0..20 {
        let content = text(number, 1_000_000);
        party
            .send(number, &listener.location, parcel(number, content))
            .unwrap();
    }
    let conclusions: Vec<Conclusion> = (0..20).map(|number| party.conclusion(number)).collect();
    assert_eq!(conclusions[0], Conclusion::Handed);
    let stalled = conclusions.iter().filter(
        |it| matches!(it, Conclusion::Unconfirmed(error) if error.fault == TransportErrorKind::TimedOut),
    );
    assert!(stalled.count() >= 1, "{conclusions:?}");
}

#[test]
fn nothing_listens_and_every_letter_fails() {
    let party = party();
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = socket.local_addr().unwrap().to_string();
    drop(socket);
    let location = Location::new(Kind::Udt, &address).unwrap();
    for number in 0..5 {
        party
            .send(number, &location, parcel(number, text(number, 10)))
            .unwrap();
    }
    for number in 0..5 {
        let concluded = party.conclusion(number);
        assert!(
            matches!(&concluded, Conclusion::NotSent(error) if error.fault == TransportErrorKind::Unreachable),
            "{concluded:?}"
        );
    }
}
