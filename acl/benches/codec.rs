//! Speed of encoding and decoding, compared with a copy of the same bytes in the same run.

use std::hint::black_box;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use fipa_acl::{
    AgentId, Dialect, Envelope, EnvelopeView, Message, MessageView, Payload, Performative,
    Representation, bitefficient,
};

const LETTER: &[u8] = include_bytes!("../tests/vectors/failure_letter.bin");

/// The message with all 13 parameters.
fn message(content_len: usize) -> Message {
    let agent = |name: &str| AgentId::new(name).expect("a name");
    Message::builder(Performative::Request)
        .sender(agent("proxy"))
        .receiver(agent("crex_0"))
        .reply_to(agent("proxy"))
        .content(vec![0x5a; content_len])
        .language("test language")
        .encoding("test encoding")
        .ontology("test ontology")
        .protocol("RIMRES")
        .conversation_id("test conversationID")
        .reply_with("test reply_with")
        .in_reply_to("test in_reply_to")
        .reply_by("20101223T120037980".parse().expect("a time"))
        .build()
        .expect("a message")
}

fn codec(criterion: &mut Criterion) {
    for (name, content_len) in [("1B", 1), ("1KB", 1 << 10), ("1MB", 1 << 20)] {
        let message = message(content_len);
        let bytes: Bytes = message.to_payload().to_bytes();
        let whole = Payload::from(bytes.clone());
        let mut buffer = BytesMut::with_capacity(bytes.len());
        let mut group = criterion.benchmark_group("message");
        let id = |what: &str| BenchmarkId::new(what, name);
        group.bench_function(id("memcpy"), |bench| {
            bench.iter(|| {
                buffer.clear();
                buffer.extend_from_slice(black_box(&bytes));
                black_box(&buffer);
            });
        });
        group.bench_function(id("encode"), |bench| {
            bench.iter(|| {
                buffer.clear();
                bitefficient::encode(black_box(&message), &mut buffer);
                black_box(&buffer);
            });
        });
        group.bench_function(id("encoded_len"), |bench| {
            bench.iter(|| bitefficient::encoded_len(black_box(&message)));
        });
        group.bench_function(id("to_payload"), |bench| {
            bench.iter(|| black_box(&message).to_payload());
        });
        group.bench_function(id("view"), |bench| {
            bench.iter(|| black_box(MessageView::parse(black_box(&bytes))).is_ok());
        });
        group.bench_function(id("decode"), |bench| {
            bench.iter(|| Message::decode(black_box(&whole)));
        });
    }
    for representation in [Representation::String, Representation::Xml] {
        for (name, content_len) in [("1B", 1), ("1KB", 1 << 10), ("1MB", 1 << 20)] {
            let message = message(content_len);
            let mut group = criterion.benchmark_group(representation.to_string());
            // The lower bound of encoding XML: a copy and a scan of every byte.
            let content = message.content().cloned().unwrap_or_default();
            group.bench_function(BenchmarkId::new("copy and memchr3", name), |bench| {
                bench.iter(|| {
                    let copy = black_box(&content).to_vec();
                    black_box(memchr::memchr3_iter(b'<', b'&', b'>', &copy).count());
                    copy
                });
            });
            for dialect in [Dialect::Standard, Dialect::FipaServices] {
                let encode = || black_box(&message).encode(representation, dialect);
                let payload = Payload::from(encode().expect("a message"));
                let id = |what: &str| BenchmarkId::new(format!("{what} {dialect}"), name);
                group.bench_function(id("encode"), |bench| bench.iter(encode));
                group.bench_function(id("view"), |bench| {
                    bench.iter(|| MessageView::parse(black_box(&payload.head)).is_ok());
                });
                group.bench_function(id("decode"), |bench| {
                    bench.iter(|| Message::decode(black_box(&payload)));
                });
            }
        }
    }
    let (envelope, _) = Envelope::decode(LETTER).expect("an envelope");
    for representation in [Representation::BitEfficient, Representation::Xml] {
        let encode = || black_box(&envelope).encode(representation, Dialect::FipaServices);
        let bytes = encode().expect("an envelope");
        let mut group = criterion.benchmark_group("envelope");
        let id = |what: &str| BenchmarkId::new(what, representation);
        group.bench_function(id("encode"), |bench| bench.iter(encode));
        group.bench_function(id("view"), |bench| {
            bench.iter(|| EnvelopeView::parse(black_box(&bytes)).is_ok());
        });
        group.bench_function(id("decode"), |bench| {
            bench.iter(|| Envelope::decode(black_box(&bytes)));
        });
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(1));
    targets = codec
}
criterion_main!(benches);
