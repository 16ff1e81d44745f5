//! The delivery core on virtual time: hosts with processes and gateways, links that lose, delay and
//! break, processes that die and restart. The delivery guarantees are checked as invariants in
//! every run; a violation prints the seed.
//!
//! The core is the one that the runtime drives. Transports, clocks and the directory are simulated.

#![expect(clippy::print_stdout, reason = "a long run prints its progress")]

mod world;

use std::collections::BTreeMap;
use std::time::Duration;

use fipa_transport::Kind;
use world::{Deadlines, Weather, World};

/// `FIPA_SIM_SEEDS=100000 cargo test -p fipa-mts --test simulation` runs more of them, and
/// `FIPA_SIM_SEED=17` one. With `FIPA_SIM_TRACE=1` it prints the events.
fn seeds(usually: u64, hard: &[u64]) -> Vec<u64> {
    let number = |name: &str| {
        std::env::var(name)
            .ok()
            .and_then(|text| text.parse::<u64>().ok())
    };
    if let Some(seed) = number("FIPA_SIM_SEED") {
        return vec![seed];
    }
    let count = number("FIPA_SIM_SEEDS").unwrap_or(usually);
    let hard = hard.iter().copied().filter(|seed| *seed >= count);
    (0..count).chain(hard).collect()
}

/// Each profile of faults is a test, and each profile with hostile members is another.
macro_rules! profiles {
    ($($(#[$doc:meta])* $name:ident = $weather:expr;)*) => {
        $(
            $(#[$doc])*
            #[test]
            fn $name() {
                run_with($weather, SEEDS, hard(stringify!($name)));
            }
        )*

        /// A gateway of another host and a process of this one send false data, at any time and in
        /// every field.
        mod among_liars {
            use super::*;

            $(
                $(#[$doc])*
                #[test]
                fn $name() {
                    let hard = hard_among_liars(stringify!($name));
                    run_with($weather.with_liars(), FEW_SEEDS, hard);
                }
            )*
        }
    };
}

/// Number of seeds of each profile, unless the environment sets another.
const SEEDS: u64 = 20;
/// Number of seeds of each profile with hostile members.
const FEW_SEEDS: u64 = 2;

/// Seeds of a profile that run always, because the faults that they show are rare.
fn hard(profile: &str) -> &'static [u64] {
    match profile {
        // A copy of a letter comes to a gateway that has just delivered it after many repetitions.
        "heavy_losses_break_no_promise" => &[144],
        _ => &[],
    }
}

/// Seeds of a profile with hostile members that run always, because the faults that they show are
/// rare.
fn hard_among_liars(profile: &str) -> &'static [u64] {
    match profile {
        // A liar reports on letters in the name of a process that is reached over TCP.
        "everything_at_once_holds_up_no_stream" => &[507],
        "heavy_losses_break_no_promise" => &[499, 848, 866],
        "hosts_that_are_cut_off_break_no_promise" => &[384, 880],
        // An agent comes to a host whose gateway has just died, and a liar writes in its name.
        "moves_in_foul_weather_break_no_promise" => &[85],
        // Letters to liars fill the custody of gateways.
        "bytes_of_queues_and_lanes_are_bounded" => &[162],
        // Letters with the sequence 0 come to lanes in which letters fail.
        "losses_and_delays_break_no_promise" => &[11],
        // A report is late, and the receiver takes more letters in the meantime than it remembers.
        "copies_and_overtaking_break_no_promise" => &[60, 823],
        _ => &[],
    }
}

fn run(weather: Weather, usually: u64) -> u64 {
    run_with(weather, usually, &[])
}

/// Runs every seed, and fails with the first violation of each invariant and the number of seeds
/// that violated it. Returns the number of letters that a later registration of their receiver
/// took.
fn run_with(weather: Weather, usually: u64, hard: &[u64]) -> u64 {
    let (mut letters, mut followed, mut bounded) = (0, 0, 0);
    let mut slowest = Duration::ZERO;
    let mut most = (0.0, 0);
    let mut breaches = BTreeMap::new();
    let seeds = seeds(usually, hard);
    for &seed in &seeds {
        let mut world = World::new(seed, weather);
        for (invariant, breach) in world.run().err().unwrap_or_default() {
            let (count, _) = breaches
                .entry(invariant)
                .or_insert((0, format!("seed {seed}: {breach}")));
            *count += 1;
        }
        letters += world.letters();
        followed += world.followed();
        let (per_byte, steps) = world.work();
        most = (f64::max(most.0, per_byte), most.1.max(steps));
        bounded += world.liveness().0;
        slowest = slowest.max(world.liveness().1);
    }
    let summary: Vec<String> = breaches
        .iter()
        .map(|(invariant, (count, first))| format!("{invariant} ({count} seeds): {first}"))
        .collect();
    let seeds = seeds.len();
    assert!(
        breaches.is_empty(),
        "{seeds} seeds, {weather:?}:\n{}",
        summary.join("\n")
    );
    assert!(letters > 0, "nothing was sent");
    println!(
        "{letters} letters over {seeds} seeds, {bounded} of them after the last fault, delivered \
         within {slowest:?}, {:.3} steps for each byte and {} for one arrival at most: {weather:?}",
        most.0, most.1,
    );
    followed
}

#[test]
fn letters_to_agents_that_move_follow_or_fail() {
    let weather = Weather {
        moves: 60,
        news_ms: 60,
        hosts: 3,
        ..Weather::calm()
    };
    let followed = run(weather, SEEDS);
    run(weather.with_liars(), FEW_SEEDS);
    assert!(
        followed > 0,
        "no letter came to a host that its receiver had left"
    );
}

/// Agents come to a host whose other processes learn of them late, and letters to them wait for a
/// refresh, which takes time.
#[test]
fn letters_to_agents_that_the_sender_does_not_know_yet_wait_for_a_refresh() {
    let weather = Weather {
        moves: 80,
        lag_ms: 300,
        refresh_ms: 40,
        news_ms: 60,
        ..Weather::calm()
    };
    run(weather.with_liars(), FEW_SEEDS);
    let rough = Weather {
        loss: 0.05,
        silence: 0.02,
        answer_loss: 0.05,
        deaths: 4,
        restarts: 4,
        ..weather
    };
    run(rough, SEEDS);
    let found: u64 = seeds(SEEDS, &[])
        .into_iter()
        .map(|seed| {
            let mut world = World::new(seed, weather);
            assert_eq!(world.run().err(), None, "seed {seed}");
            world.found()
        })
        .sum();
    assert!(found > 0, "no receiver was found by a refresh");
}

profiles! {
    in_calm_weather_everything_is_delivered = Weather::calm();

    losses_and_delays_break_no_promise = Weather {
            loss: 0.05,
            answer_loss: 0.05,
            refusal: 0.05,
            silence: 0.02,
            ..Weather::calm()
        };

    heavy_losses_break_no_promise = Weather {
            loss: 0.3,
            answer_loss: 0.2,
            refusal: 0.1,
            silence: 0.1,
            ..Weather::calm()
        };

    slow_receivers_hold_senders_back = Weather {
            reading_pause_ms: 300,
            queue: 4,
            ..Weather::calm()
        };

    deaths_and_rebirths_break_no_promise = Weather {
            deaths: 12,
            answering_ms: 80,
            loss: 0.02,
            answer_loss: 0.02,
            ..Weather::calm()
        };


    moves_in_foul_weather_break_no_promise = Weather {
            moves: 60,
            news_ms: 60,
            hosts: 3,
            loss: 0.1,
            answer_loss: 0.1,
            refusal: 0.1,
            silence: 0.05,
            deaths: 4,
            ..Weather::calm()
        };

    copies_and_overtaking_break_no_promise = Weather {
            overtaken: 0.2,
            copies: 0.2,
            loss: 0.05,
            silence: 0.05,
            ..Weather::calm()
        };

    hosts_that_are_cut_off_break_no_promise = Weather {
            partitions: 4,
            overtaken: 0.05,
            copies: 0.05,
            answer_loss: 0.05,
            hosts: 3,
            ..Weather::calm()
        };

    everything_at_once_breaks_no_promise = Weather {
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
        };

    // Letters that fail in streams that continue: the letters behind each of these are delivered as
    // if it had never been sent.

    letters_that_gateways_refuse_hold_up_no_stream = Weather {
            refused_by_gateways: 0.02,
            ..Weather::busy()
        };

    letters_that_receivers_refuse_hold_up_no_stream = Weather {
            refused_by_receivers: 0.02,
            ..Weather::busy()
        };

    receivers_that_are_denied_for_a_while_get_later_letters = Weather {
            denials: 10,
            refusal: 0.05,
            answer_loss: 0.05,
            ..Weather::busy()
        };

    a_rate_limit_holds_up_no_stream = Weather {
            rate: 40.0,
            ..Weather::busy()
        };

    deadlines_that_pass_behind_large_letters_hold_up_no_stream = Weather {
            order: &[Kind::Shm, Kind::Tcp],
            large: 0.1,
            stalls: 6,
            ..Weather::busy()
        };

    letters_too_large_for_a_datagram_hold_up_no_stream = Weather {
            large: 0.1,
            ..Weather::busy()
        };

    streams_go_on_when_links_heal = Weather {
            loss: 0.05,
            silence: 0.05,
            answer_loss: 0.05,
            refusal: 0.05,
            outages: 4,
            partitions: 2,
            ..Weather::busy()
        };

    /// Two gateways hold letters of a stream at once, because the last hop is slow.
    two_slow_gateways_hold_up_no_stream = Weather {
            local_ms: 80,
            answering_ms: 50,
            partitions: 2,
            silence: 0.05,
            refused_by_gateways: 0.01,
            ..Weather::busy()
        };

    slow_receivers_and_small_lanes_hold_up_no_stream = Weather {
            reading_pause_ms: 20,
            queue: 8,
            lane: 16,
            refused_by_gateways: 0.01,
            silence: 0.02,
            ..Weather::busy()
        };

    letters_reach_hosts_whose_address_changes = Weather {
            addresses: 8,
            news_ms: 200,
            loss: 0.02,
            answer_loss: 0.02,
            ..Weather::busy()
        };

    // Receivers that are registered again while copies of their letters are still in transit.

    late_copies_reach_no_agent_that_has_moved = Weather {
            overtaken: 0.2,
            late_ms: 3000,
            moves: 30,
            news_ms: 60,
            hosts: 3,
            ..Weather::busy()
        };

    late_copies_reach_no_agent_that_was_started_again = Weather {
            overtaken: 0.2,
            late_ms: 3000,
            restarts: 12,
            news_ms: 60,
            ..Weather::busy()
        };

    parcels_that_wait_in_a_socket_reach_no_agent_that_has_moved = Weather {
            order: &[Kind::Shm, Kind::Tcp, Kind::Udp],
            stalls: 6,
            moves: 30,
            news_ms: 60,
            hosts: 3,
            ..Weather::busy()
        };

    parcels_that_wait_in_a_socket_reach_no_agent_that_was_started_again = Weather {
            order: &[Kind::Shm, Kind::Tcp, Kind::Udp],
            stalls: 6,
            restarts: 12,
            ..Weather::busy()
        };

    everything_at_once_holds_up_no_stream = Weather {
            loss: 0.05,
            silence: 0.05,
            answer_loss: 0.05,
            refusal: 0.05,
            overtaken: 0.05,
            late_ms: 2000,
            large: 0.05,
            deaths: 6,
            restarts: 4,
            moves: 10,
            news_ms: 60,
            addresses: 2,
            stalls: 3,
            outages: 3,
            partitions: 1,
            refused_by_gateways: 0.01,
            refused_by_receivers: 0.01,
            denials: 3,
            rate: 60.0,
            hosts: 3,
            ..Weather::busy()
        };

    // Limits.

    bytes_of_queues_and_lanes_are_bounded = Weather {
        order: &[Kind::Shm, Kind::Tcp],
        large: 0.3,
        queue_bytes: 60_000,
        lane_bytes: 120_000,
        custody_bytes: 200_000,
        reading_pause_ms: 20,
        silence: 0.02,
        refused_by_gateways: 0.01,
        ..Weather::busy()
    };

    full_queues_are_told_as_such = Weather {
        reading_pause_ms: 400,
        queue: 2,
        ..Weather::busy()
    };

    services_that_close_say_so = Weather {
        closings: 8,
        loss: 0.05,
        silence: 0.05,
        answering_ms: 40,
        ..Weather::busy()
    };

    gateways_that_close_return_letters = Weather {
        gateway_closings: 8,
        loss: 0.05,
        silence: 0.05,
        answering_ms: 40,
        ..Weather::busy()
    };

    /// Many letters are open when a gateway dies, and their receivers remember all of them.
    letters_of_a_lost_custodian_are_remembered = Weather {
        gateway_deaths: 8,
        burst: 400,
        bursts: 6,
        local_ms: 30,
        answering_ms: 60,
        answer_loss: 0.02,
        queue: 1024,
        deadlines: Deadlines::Same,
        ..Weather::busy()
    };
}
