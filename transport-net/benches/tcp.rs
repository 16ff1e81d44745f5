//! Acknowledged round trip of a letter on loopback, compared with raw TCP that moves the same
//! number of bytes one way and one byte back: measures the overhead of this transport, of TLS and
//! of QUIC.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

use std::hint::black_box;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use bytes::Bytes;
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use fipa_acl::{Letter, Payload};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, Kind, LegacySource, Location,
    Parcel, Reaction, Sink, Stream, Transport,
};
use fipa_transport_net::{Identity, TcpConfig, TcpTransport};
use parking_lot::Mutex;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;

#[cfg(feature = "secure")]
#[path = "../tests/common/certificates.rs"]
#[allow(dead_code, reason = "the tests use all of it")]
mod certificates;

const SIZES: [usize; 4] = [100, 1 << 10, 64 << 10, 1 << 20];

/// Accepts every parcel, and reports conclusions to the bench.
struct Accepting(Mutex<Sender<Conclusion>>);

impl Sink for Accepting {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        black_box(arrival);
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, letter: Letter, _: Kind, _: LegacySource) {
        black_box(letter);
    }

    fn concluded(&self, _: AttemptId, conclusion: Conclusion) {
        // The bench may have ended.
        let _ = self.0.lock().send(conclusion);
    }
}

fn runtime() -> Runtime {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap()
}

type Party = (Arc<dyn Transport>, Location, Receiver<Conclusion>);

fn endpoint(runtime: &Runtime) -> Party {
    let transport = TcpTransport::new(config(), runtime.handle().clone());
    listening(Arc::new(transport))
}

fn config() -> TcpConfig {
    let identity = Identity {
        name: "bench".into(),
        incarnation: Incarnation::random(),
        domain: "bench".into(),
        host: "here".into(),
    };
    let mut config = TcpConfig::new(vec!["127.0.0.1:0".into()], identity);
    config.processes = true;
    config
}

/// Two endpoints that trust each other.
#[cfg(feature = "secure")]
fn secured(client: &Runtime, server: &Runtime) -> (Party, Party) {
    let host = certificates::Host::new("bench", &[]);
    let [near, far] = [client, server].map(|runtime| {
        let mut config = config();
        config.security = Some(host.security(&[&host]));
        listening(Arc::new(TcpTransport::new(
            config,
            runtime.handle().clone(),
        )))
    });
    (near, far)
}

/// Two endpoints over QUIC that trust each other.
#[cfg(feature = "quic")]
fn quic(client: &Runtime, server: &Runtime) -> (Party, Party) {
    use fipa_transport_net::{QuicConfig, QuicTransport};
    let host = certificates::Host::new("bench", &[]);
    let [near, far] = [client, server].map(|runtime| {
        let TcpConfig {
            listen,
            identity,
            limits,
            ..
        } = config();
        let config = QuicConfig {
            listen,
            identity,
            limits,
            refused_dials: fipa_transport_net::RefusedDials::default(),
            security: host.security(&[&host]),
            refusals: fipa_transport_net::Refusals::default(),
        };
        listening(Arc::new(QuicTransport::new(
            config,
            runtime.handle().clone(),
        )))
    });
    (near, far)
}

fn listening(transport: Arc<dyn Transport>) -> Party {
    let (sender, receiver) = channel();
    let sink = Arc::new(Accepting(Mutex::new(sender)));
    let location = transport.listen(sink).unwrap().remove(0);
    (transport, location, receiver)
}

fn parcel(content: Bytes) -> Parcel {
    let payload = Payload {
        head: Bytes::from_static(&[1; 150]),
        content,
        tail: Bytes::from_static(b"\x01"),
    };
    Parcel {
        receiver: "arm_1".into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence: 1,
        after: 0,
        remaining: Duration::from_secs(5),
        transfer: 0,
        body: Body::Letter(Letter::new(Bytes::from_static(&[2; 80]), payload)),
    }
}

/// Reads `size` bytes and writes one, over and over, until the other side closes.
async fn raw_server(listener: TcpListener, size: usize) -> io::Result<()> {
    let (mut stream, _) = listener.accept().await?;
    stream.set_nodelay(true)?;
    let mut buffer = vec![0; size];
    loop {
        stream.read_exact(&mut buffer).await?;
        stream.write_all(&[1]).await?;
    }
}

fn round_trip(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("acknowledged_round_trip");
    for size in SIZES {
        group.throughput(Throughput::Bytes(size as u64));
        let content = Bytes::from(vec![7; size]);

        let (server, client) = (runtime(), runtime());
        let listener = server.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
        let address = listener.local_addr().unwrap();
        server.spawn(raw_server(listener, size));
        let mut stream = client.block_on(TcpStream::connect(address)).unwrap();
        stream.set_nodelay(true).unwrap();
        group.bench_function(BenchmarkId::new("raw_tcp", size), |bencher| {
            bencher.iter(|| {
                client.block_on(async {
                    stream.write_all(&content).await.unwrap();
                    stream.read_u8().await.unwrap()
                })
            });
        });
        drop(stream);

        // As for letters: the sending thread is not a thread of the runtime, and wakes it.
        let (to_task, mut from_bench) = tokio::sync::mpsc::unbounded_channel::<Bytes>();
        let (done, is_done) = channel();
        let listener = server.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
        let address = listener.local_addr().unwrap();
        server.spawn(raw_server(listener, size));
        client.spawn(async move {
            let mut stream = TcpStream::connect(address).await.unwrap();
            stream.set_nodelay(true).unwrap();
            while let Some(bytes) = from_bench.recv().await {
                stream.write_all(&bytes).await.unwrap();
                stream.read_u8().await.unwrap();
                done.send(()).unwrap();
            }
        });
        group.bench_function(BenchmarkId::new("raw_tcp_task", size), |bencher| {
            bencher.iter(|| {
                to_task.send(content.clone()).unwrap();
                is_done.recv().unwrap();
            });
        });
        drop(to_task);

        let kinds = [
            ("letter", (endpoint(&client), endpoint(&server))),
            #[cfg(feature = "secure")]
            ("letter_tls", secured(&client, &server)),
            #[cfg(feature = "quic")]
            ("letter_quic", quic(&client, &server)),
        ];
        let parcel = parcel(content.clone());
        for (name, ((sender, _, conclusions), (_receiver, there, _))) in kinds {
            group.bench_function(BenchmarkId::new(name, size), |bencher| {
                bencher.iter(|| {
                    let attempt = AttemptId(1);
                    sender.post(attempt, &there, parcel.clone()).unwrap();
                    let conclusion = conclusions.recv().unwrap();
                    assert_eq!(conclusion, Conclusion::Answered(Answer::Accepted));
                });
            });
        }
    }
    group.finish();
}

criterion_group!(benches, round_trip);
criterion_main!(benches);
