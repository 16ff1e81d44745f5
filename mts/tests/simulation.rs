//! The delivery core on virtual time: hosts with processes and gateways, links that lose, delay
//! and break, processes that die and come back. The promises of delivery are checked as
//! invariants in every run; when one breaks, the seed is printed.
//!
//! The core is the very one that the runtime drives. What is simulated is everything around it:
//! transports, clocks, the directory.

#![expect(clippy::print_stdout, reason = "a long run tells how far it went")]

mod world;

use world::{Weather, World};

/// `FIPA_SIM_SEEDS=100000 cargo test -p fipa-mts --test simulation` runs more of them, and
/// `FIPA_SIM_SEED=17` one.
fn seeds() -> Vec<u64> {
    let number = |name: &str| {
        std::env::var(name)
            .ok()
            .and_then(|text| text.parse::<u64>().ok())
    };
    if let Some(seed) = number("FIPA_SIM_SEED") {
        return vec![seed];
    }
    (0..number("FIPA_SIM_SEEDS").unwrap_or(100)).collect()
}

fn run(weather: Weather) -> u64 {
    let (mut letters, mut followed) = (0, 0);
    let seeds = seeds();
    for &seed in &seeds {
        let mut world = World::new(seed, weather);
        if let Err(breach) = world.run() {
            panic!("seed {seed}, {weather:?}: {breach}");
        }
        letters += world.letters();
        followed += world.followed();
    }
    assert!(letters > 0, "nothing was sent");
    println!("{letters} letters over {} seeds: {weather:?}", seeds.len());
    followed
}

#[test]
fn in_calm_weather_everything_is_delivered() {
    run(Weather::calm());
}

#[test]
fn losses_and_delays_break_no_promise() {
    run(Weather {
        loss: 0.05,
        answer_loss: 0.05,
        refusal: 0.05,
        silence: 0.02,
        ..Weather::calm()
    });
}

#[test]
fn heavy_losses_break_no_promise() {
    run(Weather {
        loss: 0.3,
        answer_loss: 0.2,
        refusal: 0.1,
        silence: 0.1,
        ..Weather::calm()
    });
}

#[test]
fn slow_receivers_hold_senders_back() {
    run(Weather {
        reading_pause_ms: 300,
        queue: 4,
        ..Weather::calm()
    });
}

#[test]
fn deaths_and_rebirths_break_no_promise() {
    run(Weather {
        deaths: 12,
        answering_ms: 80,
        loss: 0.02,
        answer_loss: 0.02,
        ..Weather::calm()
    });
}

#[test]
fn letters_to_agents_that_move_follow_or_fail() {
    let followed = run(Weather {
        moves: 60,
        news_ms: 60,
        hosts: 3,
        ..Weather::calm()
    });
    assert!(
        followed > 0,
        "no letter came to a host that its receiver had left"
    );
}

#[test]
fn moves_in_foul_weather_break_no_promise() {
    run(Weather {
        moves: 60,
        news_ms: 60,
        hosts: 3,
        loss: 0.1,
        answer_loss: 0.1,
        refusal: 0.1,
        silence: 0.05,
        deaths: 4,
        ..Weather::calm()
    });
}

#[test]
fn copies_and_overtaking_break_no_promise() {
    run(Weather {
        overtaken: 0.2,
        copies: 0.2,
        loss: 0.05,
        silence: 0.05,
        ..Weather::calm()
    });
}

#[test]
fn hosts_that_are_cut_off_break_no_promise() {
    run(Weather {
        partitions: 4,
        overtaken: 0.05,
        copies: 0.05,
        answer_loss: 0.05,
        hosts: 3,
        ..Weather::calm()
    });
}

#[test]
fn everything_at_once_breaks_no_promise() {
    run(Weather {
        loss: 0.1,
        answer_loss: 0.1,
        refusal: 0.1,
        silence: 0.05,
        deaths: 10,
        reading_pause_ms: 50,
        answering_ms: 30,
        queue: 8,
        outages: 6,
        partitions: 2,
        overtaken: 0.1,
        copies: 0.1,
        ..Weather::calm()
    });
}
