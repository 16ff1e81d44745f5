//! Letters over UDT beside libudt to libudt in the same run: throughput and processor time of letters
//! of 1 MB to libudt and from libudt, and round trips of letters of 1 KB. Needs `libudt-dev` and
//! `g++`.
//!
//! Each figure of this side is divided by that of libudt in the same round. The last lines are the
//! medians over the rounds; `FIPA_UDT_ROUNDS` is their number.
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
    Parcel, Reaction, Sink, Stream, Transport as _, TransportErrorKind,
};
use fipa_transport_net::{Identity, UdtConfig, UdtLimits, UdtTransport};
use parking_lot::{Condvar, Mutex};

const LEN: usize = 1_000_000;
const COUNT: u64 = 200;

/// Content of a letter whose round trip is measured, and their number.
const SHORT: usize = 1024;
const TRIPS: usize = 2000;

const ROUNDS: u64 = 5;

/// Counts letters and conclusions.
#[derive(Default)]
struct Counter {
    counts: Mutex<Counts>,
    changed: Condvar,
}

#[derive(Default)]
struct Counts {
    /// Letters and conclusions.
    all: u64,
    /// Letters that [`Counter::wait_for_arrival`] has not taken.
    arrived: u64,
}

impl Counter {
    fn add(&self, arrived: u64) {
        let mut counts = self.counts.lock();
        counts.all += 1;
        counts.arrived += arrived;
        drop(counts);
        self.changed.notify_all();
    }

    /// Waits for this number of letters and conclusions, and starts at zero again.
    fn wait_for(&self, count: u64) {
        let mut counts = self.counts.lock();
        while counts.all < count {
            self.changed.wait(&mut counts);
        }
        *counts = Counts::default();
    }

    fn wait_for_arrival(&self) {
        let mut counts = self.counts.lock();
        while counts.arrived == 0 {
            self.changed.wait(&mut counts);
        }
        counts.arrived -= 1;
    }
}

impl Sink for Counter {
    fn arrived(&self, _: Arrival) -> Reaction {
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {
        self.add(1);
    }

    fn concluded(&self, _: AttemptId, conclusion: Conclusion) {
        assert_eq!(conclusion, Conclusion::Handed);
        self.add(0);
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

    /// Returns the median of the round trips in microseconds, to the echo at this port.
    fn pings(mut self, port: u16, letter: &[u8]) -> f64 {
        let stdin = self.child.stdin.as_mut().unwrap();
        let len = u32::try_from(letter.len()).unwrap();
        stdin.write_all(&u32::from(port).to_le_bytes()).unwrap();
        stdin.write_all(&len.to_le_bytes()).unwrap();
        stdin.write_all(letter).unwrap();
        let mut line = String::new();
        self.stdout.read_line(&mut line).unwrap();
        line.trim().parse().unwrap()
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

fn message(len: usize) -> Message {
    let built = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content("x".repeat(len))
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

fn legacy_letter(len: usize) -> Vec<u8> {
    let (representation, dialect) = (Representation::BitEfficient, Dialect::FipaServices);
    let mut envelope = envelope();
    envelope.base.date = Some("20261120T112644481".parse().unwrap());
    let envelope = envelope.encode(representation, dialect).unwrap();
    let message = message(len).encode(representation, dialect).unwrap();
    [&envelope[..], &message].concat()
}

fn parcel(len: usize) -> Parcel {
    let letter = Letter::new(
        envelope().encode_standard().unwrap(),
        message(len).to_payload(),
    );
    Parcel {
        receiver: "arm".into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence: 1,
        after: 0,
        remaining: Duration::from_secs(60),
        transfer: 0,
        body: Body::Letter(letter),
    }
}

/// The result of a flood.
#[derive(Clone, Copy)]
struct Flood {
    seconds: f64,
    /// Processor time of the sender and of the receiver, in seconds.
    sender: f64,
    receiver: f64,
}

impl Flood {
    fn show(&self, what: &str) {
        let rate = COUNT as f64 * LEN as f64 / self.seconds / 1e6;
        println!(
            "  {what}: {rate:.0} MB/s, processor {:.2} s + {:.2} s",
            self.sender, self.receiver
        );
    }
}

/// The endpoint of this side, and what is sent.
struct Side {
    transport: UdtTransport,
    sink: Arc<Counter>,
    port: String,
    program: PathBuf,
}

impl Side {
    fn peer(&self, arguments: &[&str]) -> Peer {
        Peer::start(&self.program, arguments)
    }

    fn libudt_to_libudt(&self) -> Flood {
        let receiver = self.peer(&["discard", "127.0.0.1", "0"]);
        let count = COUNT.to_string();
        let sender = self.peer(&["flood", "127.0.0.1", receiver.port(), &count]);
        let (seconds, sender) = sender.floods(&legacy_letter(LEN));
        Flood {
            seconds,
            sender,
            receiver: receiver.processor(),
        }
    }

    fn this_to_libudt(&self) -> Flood {
        let receiver = self.peer(&["discard", "127.0.0.1", "0"]);
        let to = location(receiver.port());
        let parcel = parcel(LEN);
        let (begun, before) = (Instant::now(), processor("self"));
        for attempt in 0..COUNT {
            self.post(attempt, &to, &parcel);
        }
        self.sink.wait_for(COUNT);
        Flood {
            seconds: begun.elapsed().as_secs_f64(),
            sender: processor("self") - before,
            receiver: receiver.processor(),
        }
    }

    fn libudt_to_this(&self) -> Flood {
        let before = processor("self");
        let sender = self.peer(&["flood", "127.0.0.1", &self.port, &COUNT.to_string()]);
        let (seconds, sender) = sender.floods(&legacy_letter(LEN));
        self.sink.wait_for(COUNT);
        Flood {
            seconds,
            sender,
            receiver: processor("self") - before,
        }
    }

    /// Returns the median round trip between two processes of libudt, in microseconds.
    fn trips_of_libudt(&self) -> f64 {
        let ping = self.peer(&["ping", "127.0.0.1", "0", &TRIPS.to_string()]);
        let echo = self.peer(&["echo", "127.0.0.1", "0", ping.port()]);
        let port = echo.port().parse().unwrap();
        ping.pings(port, &legacy_letter(SHORT))
    }

    /// Returns the median round trip from this side to libudt, in microseconds: until the letter of
    /// the echo has arrived over its own connection.
    fn trips_of_this(&self) -> f64 {
        let echo = self.peer(&["echo", "127.0.0.1", "0", &self.port]);
        let (to, parcel) = (location(echo.port()), parcel(SHORT));
        let trips = (0..=TRIPS as u64).map(|attempt| {
            let begun = Instant::now();
            self.post(attempt, &to, &parcel);
            self.sink.wait_for_arrival();
            begun.elapsed().as_secs_f64() * 1e6
        });
        let mut trips: Vec<f64> = trips.skip(1).collect();
        self.sink.wait_for(2 * (TRIPS as u64 + 1));
        median(&mut trips)
    }

    fn post(&self, attempt: u64, to: &Location, parcel: &Parcel) {
        while let Err(error) = self.transport.post(AttemptId(attempt), to, parcel.clone()) {
            assert_eq!(error.fault, TransportErrorKind::Congested, "{error}");
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

fn location(port: &str) -> Location {
    Location::new(Kind::Udt, &format!("127.0.0.1:{port}")).unwrap()
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
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
    let locations = transport.listen(sink.clone()).unwrap();
    let port = locations[0]
        .address()
        .rsplit_once(':')
        .unwrap()
        .1
        .to_owned();
    let side = Side {
        transport,
        sink,
        port,
        program,
    };
    let rounds = std::env::var("FIPA_UDT_ROUNDS").ok();
    let rounds = rounds.map_or(ROUNDS, |text| text.parse().unwrap());
    let names = [
        "throughput to libudt",
        "throughput from libudt",
        "processor of the sender",
        "processor of the receiver",
        "round trip",
    ];
    let mut ratios: [Vec<f64>; 5] = Default::default();
    for round in 1..=rounds {
        println!("round {round}: {COUNT} letters of {LEN} bytes, {TRIPS} round trips of {SHORT}");
        let limit = side.libudt_to_libudt();
        limit.show("libudt to libudt");
        let out = side.this_to_libudt();
        out.show("this to libudt");
        let back = side.libudt_to_this();
        back.show("libudt to this");
        let (theirs, ours) = (side.trips_of_libudt(), side.trips_of_this());
        println!("  round trip: libudt {theirs:.0} µs, this {ours:.0} µs");
        let now = [
            limit.seconds / out.seconds,
            limit.seconds / back.seconds,
            out.sender / limit.sender,
            back.receiver / limit.receiver,
            ours / theirs,
        ];
        for (all, now) in ratios.iter_mut().zip(now) {
            all.push(now);
        }
    }
    println!("median of {rounds} rounds, as a ratio to libudt (smallest to largest)");
    for (name, ratios) in names.iter().zip(&mut ratios) {
        let median = median(ratios);
        let (least, most) = (ratios[0], ratios[ratios.len() - 1]);
        println!("  {name}: {median:.2} ({least:.2} to {most:.2})");
    }
}
