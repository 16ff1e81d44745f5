//! Acknowledged letters through shared memory, compared with iceoryx2's own request-response.
//!
//! Two threads spin. In a round, the sender writes the payload and sends it, the receiver takes it
//! and answers, and the sender receives the answer. `letter` is a parcel through the transport,
//! from dispatch to conclusion. `loaned` is the same with content in loaned memory that is not
//! written. `raw` is a bare iceoryx2 request of the same size and its response. `window` keeps
//! eight rounds under way.
//!
//! A round with 32 receivers ends when all have answered. `32 letters` are short ones. `32, one
//! content` fills content that is stored once and to which each letter refers. `32 copies` sends
//! the same content in separate letters. `fill` only fills that content and releases it.
//!
//! Blocks of rounds of all kinds alternate, so that other load on the machine affects all kinds
//! alike. Compare the percentiles of one run with each other, and not those of different runs.

#![expect(clippy::print_stdout, reason = "prints the measurements")]

use std::collections::VecDeque;
use std::hint::{black_box, spin_loop};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, Kind, LegacySource, Location,
    Parcel, Reaction, Sink, Stream, Transport,
};
use fipa_transport_shm::{ShmConfig, ShmTransport};
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, Config, FileName, NodeBuilder, Path, SemanticString,
    ServiceName, SignalHandlingMode, ipc_threadsafe,
};

/// Number of rounds of one kind that are measured before the next kind.
const BLOCK: usize = 500;

/// Number of rounds under way in `window`.
const WINDOW: usize = 8;

/// Length of name, envelope and head of a message, and of the part after the content.
const FRONT: usize = 8 + 80 + 120;
const TAIL: usize = 1;

/// An iceoryx2 answer of the same length as the transport's.
type RawAck = [u8; 184];
type RawHeader = [u64; 15];
type RawClient = Client<ipc_threadsafe::Service, [u8], RawHeader, RawAck, ()>;
type RawPending = PendingResponse<ipc_threadsafe::Service, [u8], RawHeader, RawAck, ()>;
type RawServer = Server<ipc_threadsafe::Service, [u8], RawHeader, RawAck, ()>;

fn main() {
    // `cargo bench` passes `--bench` and the arguments after `--`: the number of blocks of each
    // kind.
    let mut blocks = std::env::args().filter_map(|argument| argument.parse().ok());
    let blocks: usize = blocks.next_back().unwrap_or(40);
    let directory = tempfile::tempdir().expect("a directory");
    let (raw, pair) = (
        Raw::new(directory.path()),
        TransportPair::new(directory.path()),
    );
    let many = OneToMany::new(directory.path());
    let (raw, pair, many) = (&raw, &pair, &many);
    let large = Bytes::from(vec![7; 1 << 20]);
    let mut kinds = Vec::new();
    for size in [100, 1 << 10, 64 << 10, 1 << 20] {
        let payload = vec![7; FRONT + size + TAIL];
        let letter = parcel(Bytes::from(vec![7; size]));
        let round = move || raw.end(raw.begin(&payload));
        kinds.push(Measurement::new("raw", size, RAW, 1, round));
        let round = move || pair.round(letter.clone());
        kinds.push(Measurement::new("letter", size, PAIR, 1, round));
    }
    for size in [1 << 10, 1 << 20, 4 << 20] {
        let round = move || pair.round(pair.loaned(size));
        kinds.push(Measurement::new("loaned", size, PAIR, 1, round));
    }
    let size = 1 << 10;
    let payload = vec![7; FRONT + size + TAIL];
    let round = move || raw.many(&payload, BLOCK);
    kinds.push(Measurement::new("raw window", size, RAW, BLOCK, round));
    let letter = parcel(Bytes::from(vec![7; size]));
    let round = move || pair.many(&letter, BLOCK);
    kinds.push(Measurement::new("window", size, PAIR, BLOCK, round));

    let size = large.len();
    let fill = || drop(many.filled(&large));
    kinds.push(Measurement::new("fill", size, MANY, 1, fill));
    let short = parcel(Bytes::from(vec![7; 100]));
    let letters = move || many.round(&short);
    kinds.push(Measurement::new("32 letters", 100, MANY, 1, letters));
    let once = || many.round(&parcel(many.filled(&large)));
    kinds.push(Measurement::new("32, one content", size, MANY, 1, once));
    let copies = || many.round(&parcel(large.clone()));
    kinds.push(Measurement::new("32 copies", size, MANY, 1, copies));

    let turn = AtomicUsize::new(RAW);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            loop {
                match turn.load(Ordering::Acquire) {
                    RAW => raw.serve(),
                    PAIR => pair.serve(),
                    MANY => many.serve(),
                    _ => return,
                }
            }
        });
        for block in 0..=blocks {
            for kind in &mut kinds {
                turn.store(kind.turn, Ordering::Release);
                // The first block warms up.
                kind.measure(block > 0);
            }
        }
        turn.store(END, Ordering::Release);
    });
    report(&mut kinds);
}

/// The endpoints that the receiving thread serves.
const RAW: usize = 0;
const PAIR: usize = 1;
const MANY: usize = 2;
const END: usize = 3;

/// A kind of round and its measured times.
struct Measurement<'a> {
    name: &'static str,
    size: usize,
    turn: usize,
    /// Number of letters that a call of `round` sends.
    letters: usize,
    round: Box<dyn FnMut() + 'a>,
    times: Vec<Duration>,
}

impl<'a> Measurement<'a> {
    fn new(
        name: &'static str,
        size: usize,
        turn: usize,
        letters: usize,
        round: impl FnMut() + 'a,
    ) -> Self {
        Self {
            name,
            size,
            turn,
            letters,
            round: Box::new(round),
            times: Vec::new(),
        }
    }

    fn measure(&mut self, counts: bool) {
        // Long rounds are repeated less often.
        let rounds = (BLOCK / self.letters).min((256 << 20) / self.size).max(1);
        for _ in 0..rounds {
            let began = Instant::now();
            (self.round)();
            let took = began.elapsed() / self.letters as u32;
            if counts {
                self.times.push(took);
            }
        }
    }
}

fn report(kinds: &mut [Measurement<'_>]) {
    println!("microseconds per letter   size      p50      p90      p99    p99.9   p50 to raw");
    let mut raw = Vec::new();
    for kind in kinds {
        kind.times.sort_unstable();
        let last = kind.times.len() - 1;
        let at = |share: f64| kind.times[(last as f64 * share) as usize].as_nanos() as f64 / 1e3;
        let (name, size) = (kind.name, kind.size);
        let [p50, p90, p99, p999] = [0.5, 0.9, 0.99, 0.999].map(at);
        print!("{name:<20} {size:>9} {p50:>8.2} {p90:>8.2} {p99:>8.2} {p999:>8.2}");
        let many = kind.letters > 1;
        match raw.iter().find(|(m, s, _)| (*m, *s) == (many, size)) {
            Some((_, _, raw)) => println!(" {:>12.2}", p50 / raw),
            None => println!(),
        }
        if kind.turn == RAW {
            raw.push((many, size, p50));
        }
    }
}

/// Counts the accepted letters.
#[derive(Default)]
struct Count(AtomicU64);

impl Sink for Count {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        drop(black_box(arrival));
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _letter: Letter, _via: Kind, _from: LegacySource) {}

    fn concluded(&self, _attempt: AttemptId, conclusion: Conclusion) {
        assert_eq!(conclusion, Conclusion::Answered(Answer::Accepted));
        self.0.fetch_add(1, Ordering::Release);
    }
}

fn parcel(content: Bytes) -> Parcel {
    let payload = Payload {
        head: Bytes::from_static(&[1; 120]),
        content,
        tail: Bytes::from_static(&[1; TAIL]),
    };
    Parcel {
        receiver: "arm_left".into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence: 1,
        after: 0,
        remaining: Duration::from_secs(5),
        transfer: 0,
        body: Body::Letter(Letter::new(Bytes::from_static(&[2; 80]), payload)),
    }
}

/// Two endpoints of the transport.
struct TransportPair {
    sender: ShmTransport,
    sent: Arc<Count>,
    receiver: ShmTransport,
    to: Location,
    // After the endpoints, whose tasks run here.
    _domain: BenchDomain,
}

/// A domain with a unique name.
struct BenchDomain {
    root: std::path::PathBuf,
    prefix: String,
    runtime: tokio::runtime::Runtime,
}

impl BenchDomain {
    fn new(directory: &std::path::Path) -> Self {
        let prefix = format!("fipabench-{}", Incarnation::random());
        Self {
            root: directory.join(&prefix),
            prefix,
            runtime: tokio::runtime::Builder::new_multi_thread()
                .worker_threads(1)
                .enable_all()
                .build()
                .expect("a runtime"),
        }
    }

    fn endpoint(&self) -> (ShmTransport, Arc<Count>) {
        let config = ShmConfig::new(&self.root, &self.prefix, Incarnation::random());
        let handle = self.runtime.handle().clone();
        let endpoint = ShmTransport::new(config, handle).expect("an endpoint");
        let sink = Arc::new(Count::default());
        endpoint.listen(sink.clone()).expect("listening");
        (endpoint, sink)
    }
}

/// A sender, and receivers of the same content.
struct OneToMany {
    sender: ShmTransport,
    sent: Arc<Count>,
    receivers: Vec<ShmTransport>,
    locations: Vec<Location>,
    // After the endpoints, whose tasks run here.
    _domain: BenchDomain,
}

impl OneToMany {
    fn new(directory: &std::path::Path) -> Self {
        let domain = BenchDomain::new(directory);
        let (sender, sent) = domain.endpoint();
        let receivers: Vec<_> = (0..32).map(|_| domain.endpoint().0).collect();
        Self {
            sender,
            sent,
            locations: receivers.iter().map(ShmTransport::location).collect(),
            receivers,
            _domain: domain,
        }
    }

    fn serve(&self) {
        for receiver in &self.receivers {
            receiver.drive();
        }
    }

    /// Content for several receivers, written as an application writes it.
    fn filled(&self, content: &[u8]) -> Bytes {
        let loan = self.sender.loan_for_many(content.len()).expect("room");
        let mut loan = loan.expect("long enough");
        loan.content_mut().copy_from_slice(content);
        loan.freeze()
    }

    fn round(&self, parcel: &Parcel) {
        let before = self.sent.0.load(Ordering::Acquire);
        for to in &self.locations {
            let dispatched = self.sender.post(AttemptId(1), to, parcel.clone());
            dispatched.expect("room");
        }
        while self.sent.0.load(Ordering::Acquire) - before < self.locations.len() as u64 {
            self.sender.drive();
        }
    }
}

impl TransportPair {
    fn new(directory: &std::path::Path) -> Self {
        let domain = BenchDomain::new(directory);
        let (sender, sent) = domain.endpoint();
        let (receiver, _) = domain.endpoint();
        let to = receiver.location();
        Self {
            sender,
            sent,
            receiver,
            to,
            _domain: domain,
        }
    }

    fn serve(&self) {
        self.receiver.drive();
    }

    fn loaned(&self, size: usize) -> Parcel {
        let loan = self.sender.loan(&self.to, FRONT, size, TAIL).expect("room");
        parcel(loan.expect("shared memory supports loans").freeze())
    }

    fn round(&self, parcel: Parcel) {
        let before = self.sent.0.load(Ordering::Acquire);
        self.post(parcel);
        while self.sent.0.load(Ordering::Acquire) == before {
            self.sender.drive();
        }
    }

    fn many(&self, parcel: &Parcel, total: usize) {
        let before = self.sent.0.load(Ordering::Acquire);
        let done = || (self.sent.0.load(Ordering::Acquire) - before) as usize;
        let mut begun = 0;
        while done() < total {
            if begun < total && begun < done() + WINDOW {
                self.post(parcel.clone());
                begun += 1;
            } else {
                self.sender.drive();
            }
        }
    }

    fn post(&self, parcel: Parcel) {
        let dispatched = self.sender.post(AttemptId(1), &self.to, parcel);
        dispatched.expect("room");
    }
}

/// A bare iceoryx2 service.
struct Raw {
    client: RawClient,
    server: RawServer,
    _leftovers: Leftovers,
}

impl Raw {
    fn new(directory: &std::path::Path) -> Self {
        let mut config = Config::default();
        let root = directory.to_str().expect("an ASCII path");
        config
            .global
            .set_root_path(&Path::new(root.as_bytes()).expect("a path"));
        let prefix = format!("fipabench-{}_", Incarnation::random());
        let leftovers = Leftovers(prefix.clone());
        config.global.prefix = FileName::new(prefix.as_bytes()).expect("a prefix");
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<ipc_threadsafe::Service>()
            .expect("a node");
        let service = node
            .service_builder(&ServiceName::new("raw").expect("a name"))
            .request_response::<[u8], RawAck>()
            .request_user_header::<RawHeader>()
            .max_servers(1)
            .max_clients(64)
            .max_active_requests_per_client(16)
            .max_response_buffer_size(1)
            .enable_safe_overflow_for_requests(false)
            .create();
        let service = service.expect("a service");
        Self {
            server: service.server_builder().create().expect("a server"),
            client: service
                .client_builder()
                .initial_max_slice_len(4096)
                .allocation_strategy(AllocationStrategy::PowerOfTwo)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .create()
                .expect("a client"),
            _leftovers: leftovers,
        }
    }

    fn serve(&self) {
        // Several times, as the transport does between two checks of `turn`.
        for _ in 0..8 {
            match self.server.receive().expect("requests") {
                Some(request) => request.send_copy([1; 184]).expect("a response"),
                None => spin_loop(),
            }
        }
    }

    fn begin(&self, payload: &[u8]) -> RawPending {
        let request = self.client.loan_slice_uninit(payload.len()).expect("room");
        request.write_from_slice(payload).send().expect("room")
    }

    fn end(&self, pending: RawPending) {
        while pending.receive().expect("responses").is_none() {
            spin_loop();
        }
    }

    fn many(&self, payload: &[u8], total: usize) {
        let mut pending = VecDeque::new();
        for _ in 0..total {
            if pending.len() == WINDOW {
                self.end(pending.pop_front().expect("a window"));
            }
            pending.push_back(self.begin(payload));
        }
        pending.into_iter().for_each(|pending| self.end(pending));
    }
}

/// Removes the files that a bare iceoryx2 leaves in shared memory.
struct Leftovers(String);

impl Drop for Leftovers {
    fn drop(&mut self) {
        let files = std::fs::read_dir("/dev/shm");
        for file in files.into_iter().flatten().flatten() {
            if file.file_name().to_string_lossy().starts_with(&self.0) {
                let _ = std::fs::remove_file(file.path());
            }
        }
    }
}
