//! The delivery core alone among 10, 100 and 1,000 peers with ten agents each: the route of a letter, a letter
//! from its submission to its outcome, and one from its arrival to its receiver; compared to a
//! lookup in a `HashMap` of the same size.

#![allow(clippy::unwrap_used, reason = "a bench that cannot go on may panic")]

mod crowd;

use std::collections::HashMap;
use std::hint::black_box;
use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};

use self::crowd::Crowd;

fn core(criterion: &mut Criterion) {
    for peers in [10, 100, 1_000] {
        let names = Crowd::names(peers);
        let mut crowd = Crowd::new(&names);
        let mut group = criterion.benchmark_group(format!("core/{peers} hosts"));

        let plain: HashMap<Arc<str>, usize> = names.iter().cloned().zip(0..).collect();
        let mut receivers = names.iter().cycle();
        group.bench_function("raw look-up", |bench| {
            bench.iter(|| plain.get(black_box(receivers.next().unwrap())));
        });
        group.bench_function("route", |bench| {
            bench.iter(|| crowd.route(black_box(receivers.next().unwrap())).unwrap());
        });
        group.bench_function("letter", |bench| {
            bench.iter(|| crowd.send(black_box(receivers.next().unwrap())));
        });
        let mut senders = (0..names.len()).cycle();
        group.bench_function("arrival", |bench| {
            bench.iter(|| crowd.receive(black_box(senders.next().unwrap())));
        });
        group.finish();
    }
}

criterion_group!(benches, core);
criterion_main!(benches);
