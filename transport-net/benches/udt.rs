//! Throughput of letters over UDT, beside libudt to libudt in the same run: letters to libudt, and
//! from libudt. Needs `libudt-dev` and `g++`.
//!
//! `cargo bench -p fipa-transport-net --features udt --bench udt`
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench that cannot go on may panic"
)]

use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{
    AclRepresentation, AgentId, Dialect, Envelope, EnvelopeParams, Letter, Message, Performative,
    Representation,
};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, Kind, LegacySource, Location,
    Parcel, Sink, Stream, Transport as _, TransportErrorKind, Verdict,
};
use fipa_transport_net::{Identity, UdtConfig, UdtLimits, UdtTransport};
use parking_lot::{Condvar, Mutex};

const LEN: usize = 1_000_000;
const COUNT: u64 = 200;
const ROUNDS: usize = 3;

/// Counts letters and conclusions.
#[derive(Default)]
struct Counter {
    count: Mutex<u64>,
    changed: Condvar,
}

impl Counter {
    fn add(&self) {
        *self.count.lock() += 1;
        self.changed.notify_all();
    }

    fn wait_for(&self, count: u64) {
        let mut now = self.count.lock();
        while *now < count {
            self.changed.wait(&mut now);
        }
        *now = 0;
    }
}

impl Sink for Counter {
    fn arrived(&self, _: Arrival) -> Verdict {
        Verdict::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {
        self.add();
    }

    fn concluded(&self, _: AttemptId, conclusion: Conclusion) {
        assert_eq!(conclusion, Conclusion::Handed);
        self.add();
    }
}

struct Peer {
    child: Child,
    stdout: BufReader<ChildStdout>,
    ready: String,
}

impl Peer {
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
        Self {
            child,
            stdout,
            ready,
        }
    }

    fn port(&self) -> &str {
        self.ready.trim_start_matches("ready ").trim()
    }

    /// Returns the seconds that a flood took, and the seconds of the processor.
    fn floods(mut self, letter: &[u8]) -> (f64, f64) {
        let stdin = self.child.stdin.as_mut().unwrap();
        let len = u32::try_from(letter.len()).unwrap();
        stdin.write_all(&len.to_le_bytes()).unwrap();
        stdin.write_all(letter).unwrap();
        let mut line = String::new();
        self.stdout.read_line(&mut line).unwrap();
        let mut words = line.split_whitespace().map(|word| word.parse().unwrap());
        (words.next().unwrap(), words.next().unwrap())
    }

    /// Returns the processor time of the process so far, in seconds.
    fn processor(&self) -> f64 {
        processor(&self.child.id().to_string())
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns the processor time of a process in seconds.
fn processor(process: &str) -> f64 {
    const TICKS: f64 = 100.0;
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    let (_, after) = stat.rsplit_once(')').unwrap();
    let fields: Vec<&str> = after.split_whitespace().collect();
    let ticks = |index: usize| fields[index].parse::<f64>().unwrap();
    (ticks(11) + ticks(12)) / TICKS
}

fn build() -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/libudt/peer.cpp");
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("libudt-peer-bench");
    let mut compiler = Command::new("g++");
    compiler.args(["-std=c++17", "-O2", "-o"]).arg(&program);
    let status = compiler.arg(&source).args(["-ludt", "-pthread"]).status();
    assert!(status.unwrap().success(), "needs g++ and libudt-dev");
    program
}

fn message() -> Message {
    let built = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content("x".repeat(LEN))
        .build();
    built.unwrap()
}

fn envelope() -> Envelope {
    let arm = AgentId::new("arm").unwrap();
    Envelope {
        base: EnvelopeParams {
            to: vec![arm.clone()],
            from: Some(AgentId::new("rover").unwrap()),
            acl_representation: Some(AclRepresentation::BitEfficient),
            date: Some("20261120T112644481Z".parse().unwrap()),
            intended_receivers: vec![arm],
            ..EnvelopeParams::default()
        },
        extensions: Vec::new(),
    }
}

fn legacy_letter() -> Vec<u8> {
    let (representation, dialect) = (Representation::BitEfficient, Dialect::FipaServices);
    let mut envelope = envelope();
    envelope.base.date = Some("20261120T112644481".parse().unwrap());
    let envelope = envelope.encode(representation, dialect).unwrap();
    let message = message().encode(representation, dialect).unwrap();
    [&envelope[..], &message].concat()
}

fn parcel() -> Parcel {
    let letter = Letter::new(
        envelope().encode_standard().unwrap(),
        message().to_payload(),
    );
    Parcel {
        receiver: "arm".into(),
        stream: Stream {
            sender: Incarnation::from_u64(1),
            receiver: Incarnation::from_u64(2),
        },
        sequence: 1,
        after: 0,
        remaining: Duration::from_secs(60),
        transfer: 0,
        body: Body::Letter(letter),
    }
}

fn show(what: &str, seconds: f64, sender: f64, receiver: f64) {
    let rate = COUNT as f64 * LEN as f64 / seconds / 1e6;
    println!("{what}: {rate:.0} MB/s, processor {sender:.2} s + {receiver:.2} s");
}

fn main() {
    let program = build();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    let config = UdtConfig {
        listen: vec!["127.0.0.1:0".to_owned()],
        identity: Identity {
            name: "bench".into(),
            incarnation: Incarnation::random(),
            domain: "bench".into(),
            host: "here".into(),
        },
        limits: UdtLimits::default(),
        #[cfg(feature = "secure")]
        security: None,
    };
    let transport = UdtTransport::new(config, runtime.handle().clone());
    let sink = Arc::new(Counter::default());
    let here = transport.listen(sink.clone()).unwrap();
    let (_, here) = here[0].address().rsplit_once(':').unwrap();
    let (letter, parcel) = (legacy_letter(), parcel());
    let count = COUNT.to_string();
    for round in 1..=ROUNDS {
        println!("round {round}: {COUNT} letters of {LEN} bytes");
        let receiver = Peer::start(&program, &["discard", "127.0.0.1", "0"]);
        let sender = Peer::start(&program, &["flood", "127.0.0.1", receiver.port(), &count]);
        let (seconds, processor_time) = sender.floods(&letter);
        show(
            "libudt to libudt",
            seconds,
            processor_time,
            receiver.processor(),
        );

        let receiver = Peer::start(&program, &["discard", "127.0.0.1", "0"]);
        let address = format!("127.0.0.1:{}", receiver.port());
        let to = Location::new(Kind::Udt, &address).unwrap();
        let (begun, before) = (Instant::now(), processor("self"));
        for attempt in 0..COUNT {
            while let Err(error) = transport.dispatch(AttemptId(attempt), &to, parcel.clone()) {
                assert_eq!(error.fault, TransportErrorKind::Congested, "{error}");
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        sink.wait_for(COUNT);
        let seconds = begun.elapsed().as_secs_f64();
        show(
            "this to libudt",
            seconds,
            processor("self") - before,
            receiver.processor(),
        );

        let before = processor("self");
        let sender = Peer::start(&program, &["flood", "127.0.0.1", here, &count]);
        let (seconds, processor_time) = sender.floods(&letter);
        sink.wait_for(COUNT);
        show(
            "libudt to this",
            seconds,
            processor_time,
            processor("self") - before,
        );
    }
}
