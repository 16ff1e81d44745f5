//! Runs the bodies of the fuzz targets with random inputs, for machines without libFuzzer.
//!
//! `FIPA_FUZZ_SECONDS` is the time per target. By default, each target runs a fixed number of
//! inputs. `FIPA_FUZZ_SEED` repeats the inputs of an earlier run. An input that fails, or does not end,
//! is printed.

#![allow(
    dead_code,
    missing_docs,
    unreachable_pub,
    reason = "modules of the fuzz targets"
)]
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test that cannot go on ends"
)]

#[path = "../fuzz/src/access.rs"]
mod access;
#[path = "../fuzz/src/actions.rs"]
mod actions;
#[path = "../fuzz/src/config.rs"]
mod config;
#[path = "../fuzz/src/datagrams.rs"]
mod datagrams;
#[path = "../fuzz/src/delivery.rs"]
mod delivery;
#[path = "../fuzz/src/exchange.rs"]
mod exchange;
#[path = "../fuzz/src/framed.rs"]
mod framed;
#[path = "../fuzz/src/host.rs"]
mod host;
#[path = "../fuzz/src/http.rs"]
mod http;
#[path = "../fuzz/src/input.rs"]
mod input;
#[path = "../fuzz/src/locking.rs"]
mod locking;
#[path = "../fuzz/src/mdns.rs"]
mod mdns;
#[path = "../fuzz/src/platform.rs"]
mod platform;
#[path = "../fuzz/src/quic.rs"]
mod quic;
#[path = "../fuzz/src/seeds.rs"]
mod seeds;
#[path = "../fuzz/src/shm.rs"]
mod shm;
#[path = "../fuzz/src/texts.rs"]
mod texts;
#[path = "../fuzz/src/udt.rs"]
mod udt;

use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use fastrand::Rng;
use fipa::fuzzing;

/// Number of inputs per target, unless a time is set.
const INPUTS: usize = 150;
/// Time after which an input counts as endless.
const WATCHDOG: Duration = Duration::from_secs(120);

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok()?.parse().ok()
}

/// Runs a target with its seeds, and with random mutations of them.
fn plays(target: &'static str, play: fn(&[u8])) {
    let seed = number("FIPA_FUZZ_SEED").unwrap_or_else(|| fastrand::u64(..));
    println!("{target}: FIPA_FUZZ_SEED={seed}");
    let seconds = number("FIPA_FUZZ_SECONDS").map(Duration::from_secs);
    let seeds = seeds::of(target);
    let play = watched(target, play);
    seeds.iter().for_each(|seed| play(seed));
    let (mut random, began) = (Rng::with_seed(seed), Instant::now());
    let mut count = 0;
    while seconds.map_or(count < INPUTS, |seconds| began.elapsed() < seconds) {
        let mut input = seeds[random.usize(..seeds.len())].clone();
        for _ in 0..random.usize(..8) {
            change(&mut random, &mut input, &seeds);
        }
        play(&input);
        count += 1;
    }
    println!("{target}: {count} inputs");
}

/// Runs inputs on a thread of their own, and prints an input that fails or does not end.
fn watched(target: &'static str, play: fn(&[u8])) -> impl Fn(&[u8]) {
    let (inputs, coming) = channel::<Vec<u8>>();
    let (ended, ends) = channel();
    thread::spawn(move || {
        for input in coming {
            let played = std::panic::catch_unwind(|| play(&input));
            if ended.send(played).is_err() {
                return;
            }
        }
    });
    move |input| {
        inputs.send(input.to_vec()).unwrap();
        match ends.recv_timeout(WATCHDOG) {
            Ok(Ok(())) => {}
            Ok(Err(panic)) => {
                println!("{target}, input: {input:?}");
                std::panic::resume_unwind(panic);
            }
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                panic!("{target}: no end within {WATCHDOG:?} of the input {input:?}")
            }
        }
    }
}

fn change(random: &mut Rng, input: &mut Vec<u8>, seeds: &[Vec<u8>]) {
    let at = random.usize(..=input.len());
    match random.u8(..6) {
        0 | 1 if at < input.len() => input[at] = random.u8(..),
        2 => drop(input.drain(at..(at + random.usize(..20)).min(input.len()))),
        3 => {
            let new: Vec<u8> = (0..random.usize(..40)).map(|_| random.u8(..)).collect();
            drop(input.splice(at..at, new));
        }
        4 => {
            let other = &seeds[random.usize(..seeds.len())];
            input.truncate(at);
            input.extend_from_slice(&other[random.usize(..=other.len())..]);
        }
        _ if at < input.len() => input[at] ^= 1 << random.u8(..8),
        _ => {}
    }
}

macro_rules! bodies {
    ($($target:ident),*) => {
        $(#[test]
        fn $target() {
            plays(stringify!($target), $target::play);
        })*
    };
}

/// One test per target.
mod bodies {
    use super::*;

    bodies!(
        access, actions, config, datagrams, delivery, exchange, framed, host, http, locking, mdns,
        platform, quic, shm, texts, udt
    );

    #[test]
    fn presence() {
        plays("presence", fuzzing::presence);
    }

    #[test]
    fn gateway_state() {
        plays("gateway_state", fuzzing::gateway_state);
    }
}
