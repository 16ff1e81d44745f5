//! Acknowledged letters through shared memory, beside iceoryx2's own request-response.
//!
//! Two threads, both spinning; a round is: the sender writes the payload and sends, the receiver
//! takes it and answers, the sender has the answer. `letter` is a parcel through the transport,
//! from dispatch to conclusion; `loaned` is the same with content that is written by nobody, in
//! memory that was loaned; `raw` is a bare iceoryx2 request of the same size and its response.

use std::hint::{black_box, spin_loop};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use fipa_acl::{Letter, Payload};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, Kind, Parcel, Sink, Stream,
    Transport, Verdict,
};
use fipa_transport_shm::{ShmConfig, ShmTransport};
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, Config, FileName, NodeBuilder, Path, SemanticString,
    ServiceName, SignalHandlingMode, ipc_threadsafe,
};

const SIZES: [usize; 4] = [100, 1 << 10, 64 << 10, 1 << 20];

/// Counts what was accepted.
#[derive(Default)]
struct Count(AtomicU64);

impl Sink for Count {
    fn arrived(&self, arrival: Arrival) -> Verdict {
        drop(black_box(arrival));
        Verdict::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _letter: Letter, _via: Kind) {}

    fn concluded(&self, _attempt: AttemptId, conclusion: Conclusion) {
        assert_eq!(conclusion, Conclusion::Answered(Answer::Accepted));
        self.0.fetch_add(1, Ordering::Release);
    }
}

fn parcel(content: Bytes) -> Parcel {
    let payload = Payload {
        head: Bytes::from_static(&[1; 120]),
        content,
        tail: Bytes::from_static(&[1]),
    };
    Parcel {
        receiver: "arm_left".into(),
        stream: Stream {
            sender: Incarnation::from_u64(1),
            receiver: Incarnation::from_u64(2),
        },
        sequence: 1,
        after: 0,
        remaining: Duration::from_secs(5),
        hops: 0,
        body: Body::Letter(Letter::new(Bytes::from_static(&[2; 80]), payload)),
    }
}

const FRONT: usize = 8 + 80 + 120;

fn transport(criterion: &mut Criterion) {
    let directory = tempfile::tempdir().expect("a directory");
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .expect("a runtime");
    let prefix = format!("fipabench-{}", Incarnation::random());
    let endpoint = || {
        let config = ShmConfig::new(
            directory.path().join("domain"),
            &prefix,
            Incarnation::random(),
        );
        let endpoint = ShmTransport::new(config, runtime.handle().clone()).expect("an endpoint");
        let sink = Arc::new(Count::default());
        endpoint.listen(sink.clone()).expect("listening");
        (endpoint, sink)
    };
    let (sender, sent) = endpoint();
    let (receiver, _) = endpoint();
    let to = receiver.location();
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(Ordering::Relaxed) {
                receiver.drive();
            }
        });
        let round = |parcel: Parcel| {
            let before = sent.0.load(Ordering::Acquire);
            sender
                .dispatch(AttemptId(before), &to, parcel)
                .expect("room");
            while sent.0.load(Ordering::Acquire) == before {
                sender.drive();
            }
        };
        let mut group = criterion.benchmark_group("shm");
        for size in SIZES {
            let letter = parcel(Bytes::from(vec![7; size]));
            group.throughput(Throughput::Bytes(size as u64));
            group.bench_function(BenchmarkId::new("letter", size), |bencher| {
                bencher.iter(|| round(letter.clone()));
            });
        }
        for size in [1 << 10, 1 << 20, 4 << 20] {
            group.throughput(Throughput::Bytes(size as u64));
            group.bench_function(BenchmarkId::new("loaned", size), |bencher| {
                bencher.iter(|| {
                    let loan = sender.loan(&to, FRONT, size, 1).expect("room");
                    round(parcel(loan.expect("shared memory loans").freeze()));
                });
            });
        }
        group.finish();
        done.store(true, Ordering::Relaxed);
    });
}

/// Removes what a bare iceoryx2 leaves in shared memory.
struct Leftovers(String);

impl Drop for Leftovers {
    fn drop(&mut self) {
        for file in std::fs::read_dir("/dev/shm")
            .into_iter()
            .flatten()
            .flatten()
        {
            if file.file_name().to_string_lossy().starts_with(&self.0) {
                let _ = std::fs::remove_file(file.path());
            }
        }
    }
}

fn raw(criterion: &mut Criterion) {
    let directory = tempfile::tempdir().expect("a directory");
    let mut config = Config::default();
    let root = directory.path().to_str().expect("an ASCII path");
    config
        .global
        .set_root_path(&Path::new(root.as_bytes()).expect("a path"));
    let prefix = format!("fipabench-{}_", Incarnation::random());
    let _leftovers = Leftovers(prefix.clone());
    config.global.prefix = FileName::new(prefix.as_bytes()).expect("a prefix");
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc_threadsafe::Service>()
        .expect("a node");
    let service = node
        .service_builder(&ServiceName::new("raw").expect("a name"))
        .request_response::<[u8], [u8; 184]>()
        .request_user_header::<[u64; 11]>()
        .max_servers(1)
        .max_clients(64)
        .max_active_requests_per_client(16)
        .max_response_buffer_size(1)
        .enable_safe_overflow_for_requests(false)
        .create();
    let service = service.expect("a service");
    let server = service.server_builder().create().expect("a server");
    let client = service
        .client_builder()
        .initial_max_slice_len(4096)
        .allocation_strategy(AllocationStrategy::PowerOfTwo)
        .backpressure_strategy(BackpressureStrategy::DiscardData)
        .create()
        .expect("a client");
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(Ordering::Relaxed) {
                match server.receive().expect("requests") {
                    Some(request) => request.send_copy([1; 184]).expect("a response"),
                    None => spin_loop(),
                }
            }
        });
        let mut group = criterion.benchmark_group("shm");
        for size in SIZES {
            let payload = vec![7; FRONT + size + 1];
            group.throughput(Throughput::Bytes(size as u64));
            group.bench_function(BenchmarkId::new("raw", size), |bencher| {
                bencher.iter(|| {
                    let request = client.loan_slice_uninit(payload.len()).expect("room");
                    let pending = request.write_from_slice(&payload).send().expect("room");
                    while pending.receive().expect("responses").is_none() {
                        spin_loop();
                    }
                });
            });
        }
        group.finish();
        done.store(true, Ordering::Relaxed);
    });
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .warm_up_time(Duration::from_secs(1))
        .measurement_time(Duration::from_secs(2));
    targets = raw, transport
}
criterion_main!(benches);
