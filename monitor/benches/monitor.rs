//! Time of a verdict, and memory of a conversation.
//!
//! `raw` is the lower bound for any monitor of 100,000 conversations: hash the identifier of the
//! conversation and find it in a table.

#![expect(clippy::unwrap_used, reason = "a bench that cannot go on has failed")]
#![expect(clippy::print_stdout, reason = "figures")]

mod conversations;

use std::collections::HashMap;
use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use fipa_acl::{Message, Performative};
use fipa_monitor::{Header, Library, Monitor, MonitorLimits};

use self::conversations::{answer, id, message, now, with_open};

const OPEN: usize = 100_000;

/// Measures the time for `count` messages that have just been received, of conversations far apart in
/// memory.
fn on_letters(all: &[Message], count: u64, mut check: impl FnMut(&Message) -> bool) -> Duration {
    const AT_ONCE: u64 = 64;
    let mut spent = Duration::ZERO;
    let mut next = 0;
    let mut left = count;
    while left > 0 {
        let now = left.min(AT_ONCE);
        let received: Vec<Message> = (0..now)
            .map(|_| {
                next = (next + 7_919) % OPEN;
                all[next].clone()
            })
            .collect();
        let began = Instant::now();
        for message in &received {
            assert!(check(black_box(message)));
        }
        spent += began.elapsed();
        left -= now;
    }
    spent
}

fn verdicts(c: &mut Criterion) {
    let mut group = c.benchmark_group("monitor");
    let (mut monitor, informs) = with_open(OPEN);
    let table: HashMap<String, usize> = (0..OPEN).map(|number| (id(number), number)).collect();
    group.bench_function("raw", |b| {
        b.iter_custom(|count| {
            on_letters(&informs, count, |message| {
                table.contains_key(message.conversation_id().unwrap())
            })
        });
    });
    group.bench_function("verdict", |b| {
        b.iter_custom(|count| {
            on_letters(&informs, count, |message| {
                monitor.check(&Header::from(message), now()).is_accepted()
            })
        });
    });
    let propose = |number| answer(Performative::Propose, "fipa-subscribe", number);
    let wrong: Vec<Message> = (0..OPEN).map(propose).collect();
    group.bench_function("violation", |b| {
        b.iter_custom(|count| {
            on_letters(&wrong, count, |message| {
                let header = Header::from(message);
                monitor.check(&header, now()).violation().is_some()
            })
        });
    });
    let mut number = OPEN;
    group.bench_function("request, agree, inform", |b| {
        b.iter_batched(
            || {
                number += 1;
                let said = |act, from, to| message(act, from, to, "fipa-request", id(number));
                [
                    said(Performative::Request, "ann", "ben"),
                    said(Performative::Agree, "ben", "ann"),
                    said(Performative::Inform, "ben", "ann"),
                ]
            },
            |messages| {
                for message in &messages {
                    assert!(monitor.check(&Header::from(message), now()).is_accepted());
                }
                messages
            },
            BatchSize::SmallInput,
        );
    });
    group.finish();
}

fn memory(_: &mut Criterion) {
    const MANY: usize = 1_000_000;
    let mut limits = MonitorLimits::default();
    limits.conversations = MANY;
    limits.bytes = usize::MAX;
    let library = Arc::new(Library::standard());
    let mut monitor = Monitor::observer(library).with_limits(limits);
    let info = allocation_counter::measure(|| {
        for number in 0..MANY {
            let ann = format!("rover_{}", number % 1_000);
            let header = Header::new(Performative::Request)
                .sender(ann)
                .receivers(["arm_1"])
                .protocol("fipa-request")
                .conversation_id(id(number));
            assert!(monitor.check(&header, now()).is_accepted());
        }
    });
    assert_eq!(monitor.len(), MANY);
    println!(
        "{MANY} conversations: {} MB held, {} MB at most",
        info.bytes_current / 1_000_000,
        info.bytes_max / 1_000_000
    );
}

criterion_group!(benches, verdicts, memory);
criterion_main!(benches);
