//! Seeded simulations of up to eight agents: lost, delayed and repeated messages, clocks that differ by
//! up to 2 %, agents that crash, return and pause, and owners that restart.
//!
//! The invariants are checked after each event. After the last fault, every claim has to end.
//! `FIPA_LOCKS_SEEDS` sets the number of seeds, `FIPA_LOCKS_SEED` repeats one.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
#![expect(clippy::print_stderr, reason = "the log of a seed that is repeated")]

mod protocols;
mod world;

use fipa_locking::Algorithm;
use world::{Setup, World};

fn seeds(default: u64) -> std::ops::Range<u64> {
    let number = |name: &str| {
        let text = std::env::var(name).ok();
        text.map(|text| text.parse::<u64>().expect("a number"))
    };
    match number("FIPA_LOCKS_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FIPA_LOCKS_SEEDS").unwrap_or(default),
    }
}

/// Runs a world to its end, without a broken invariant.
fn ran(setup: Setup, seed: u64) -> World {
    let kind = setup.kind;
    let mut world = World::new(setup, seed);
    if let Err(error) = world.run() {
        panic!("{kind}, seed {seed}: {error}");
    }
    world
}

fn simulate(kind: Algorithm, faults: bool, seeds: std::ops::Range<u64>) -> u64 {
    let mut acquired = 0;
    for seed in seeds {
        let setup = Setup {
            kind,
            agents: 2 + (seed % 7) as usize,
            resources: 1 + (seed % 2) as usize,
            faults,
            kills_only: false,
            checked: false,
            claims: 6,
        };
        let world = ran(setup, seed);
        acquired += world.acquired;
    }
    acquired
}

#[test]
fn faults_break_no_invariant_of_the_owner_s_queue_and_every_claim_ends() {
    assert!(simulate(Algorithm::OwnerQueue, true, seeds(60)) > 0);
}

#[test]
fn faults_break_no_invariant_of_ricart_agrawala_and_every_claim_ends() {
    assert!(simulate(Algorithm::RicartAgrawalaExtended, true, seeds(60)) > 0);
}

#[test]
fn faults_break_no_invariant_of_suzuki_kasami_and_every_claim_ends() {
    assert!(simulate(Algorithm::SuzukiKasamiExtended, true, seeds(60)) > 0);
}

/// Basic algorithms need reliable members and messages. Then each claim is acquired.
#[test]
fn without_faults_every_claim_is_acquired() {
    for kind in Algorithm::ALL {
        let seeds = seeds(20);
        let mut expected = 0;
        for seed in seeds.clone() {
            expected += 6 * (2 + seed % 7);
        }
        assert_eq!(simulate(kind, false, seeds), expected, "{kind}");
    }
}

/// All messages fit the protocols, at their senders and at their receivers, while agents crash, return and
/// pause.
#[test]
fn the_messages_fit_the_protocols_that_agents_enforce() {
    for kind in Algorithm::ALL {
        for seed in seeds(15) {
            let setup = Setup {
                kind,
                agents: 2 + (seed % 7) as usize,
                resources: 1 + (seed % 2) as usize,
                // Basic algorithms are for members that never crash.
                faults: kind.is_extended(),
                kills_only: false,
                checked: true,
                claims: 6,
            };
            ran(setup, seed);
        }
    }
}

/// After a request has reached all members, or the owner (owner's queue), each other agent enters at most once before
/// it. With a token, the agent that has entered or is about to receive the token can enter once more.
#[test]
fn each_agent_overtakes_a_request_a_bounded_number_of_times() {
    for kind in Algorithm::ALL {
        let bound = if kind.has_token() { 2 } else { 1 };
        let mut highest = 0;
        for seed in seeds(40) {
            let setup = Setup {
                kind,
                agents: 3 + (seed % 6) as usize,
                resources: 1,
                faults: false,
                kills_only: false,
                checked: false,
                claims: 10,
            };
            let world = ran(setup, seed);
            highest = highest.max(world.turns.highest());
        }
        assert!(highest <= bound, "{kind}: overtaken {highest} times");
        assert!(highest > 0, "{kind}: the agents do not compete");
    }
}

/// The same while agents are killed, also those that hold the resource, and return. The grants are counted from the
/// last kill on.
#[test]
fn each_agent_overtakes_a_request_of_an_agent_that_was_killed_a_bounded_number_of_times() {
    for kind in [
        Algorithm::RicartAgrawalaExtended,
        Algorithm::SuzukiKasamiExtended,
    ] {
        let mut highest = 0;
        for seed in seeds(60) {
            let setup = Setup {
                kind,
                agents: 3 + (seed % 3) as usize,
                resources: 1,
                faults: true,
                kills_only: true,
                checked: false,
                claims: 60,
            };
            let world = ran(setup, seed);
            let overtaken = world.turns.highest();
            assert!(overtaken <= 2, "{kind}, seed {seed}: {overtaken} times");
            highest = highest.max(overtaken);
        }
        assert!(highest > 0, "{kind}: the agents do not compete");
    }
}

/// Messages per uncontended acquire and release, for a requester that is not the owner.
#[test]
fn the_number_of_messages_is_the_minimum() {
    for agents in [2_usize, 3, 5, 8] {
        for kind in Algorithm::ALL {
            let setup = Setup {
                kind,
                agents,
                resources: 1,
                faults: false,
                kills_only: false,
                checked: true,
                claims: 0,
            };
            let mut world = World::new(setup, 1);
            let first = world.messages_of_one_acquisition(1);
            let again = world.messages_of_one_acquisition(1);
            let n = agents as u64;
            match kind {
                Algorithm::OwnerQueue => {
                    assert_eq!((first, again), (3, 3), "{kind}, {n}");
                    assert_eq!(world.messages_of_one_acquisition(0), 0, "{kind}, {n}");
                }
                Algorithm::RicartAgrawala | Algorithm::RicartAgrawalaExtended => {
                    assert_eq!(
                        (first, again),
                        (2 * (n - 1) + 3, 2 * (n - 1) + 3),
                        "{kind}, {n}"
                    );
                }
                // The token stays with its last holder.
                Algorithm::SuzukiKasami => assert_eq!((first, again), (n + 3, 3), "{kind}, {n}"),
                // The token's return is the report to the owner.
                Algorithm::SuzukiKasamiExtended => {
                    assert_eq!((first, again), (n + 3, n + 3), "{kind}, {n}");
                    // Agent 0 is the owner and has the token.
                    assert_eq!(world.messages_of_one_acquisition(0), 0, "{kind}, {n}");
                }
            }
        }
    }
}
