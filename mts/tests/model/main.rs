//! A model of the stream protocol: every order in which letters, answers, reports and faults can
//! meet is explored, up to a number of letters and faults.
//!
//! The model has one sender's process, two custodians and two registrations of one receiver. Each
//! decision is a call of [`fipa_mts::core::rules`], as in the delivery core. There is no clock: a
//! timeout may end at any time, and any message in transit may be the next one to arrive.
//!
//! * [`protocol`] has the steps, the faults, the invariants and the mutants; [`sender`],
//!   [`custodian`] and [`hop`] have what the services do.
//! * [`quotient`] keeps the number of states finite and small.
//! * [`graph`] explores all states and checks liveness: from every state, without further faults,
//!   every letter gets an outcome.
//! * [`walk`] takes random steps where there are too many states.
//!
//! Larger configurations:
//!
//! ```text
//! FIPA_MODEL=routes,letters=3,faults=1,moves cargo test --release -p fipa-mts --test model chosen -- --nocapture
//! FIPA_MODEL_WALKS=1000000 cargo test --release -p fipa-mts --test model walks -- --nocapture
//! ```

#![expect(clippy::print_stdout, reason = "a long run prints its progress")]

mod custodian;
mod graph;
mod hop;
mod protocol;
mod quotient;
mod sender;
mod state;
mod walk;

use std::fmt::Write;
use std::time::Instant;

use graph::Graph;
use protocol::{ALL_FAULTS, Action, Mutant, Protocol, Topology};
use state::State;
use stateright::{Checker, HasDiscoveries, Model};

const TOPOLOGIES: [Topology; 4] = [
    Topology::Chain,
    Topology::Routes,
    Topology::Shortcut,
    Topology::Direct,
];

/// Room for every letter of both streams.
const ROOMY: usize = 2 * state::MAX_LETTERS;

fn protocol(topology: Topology, letters: usize, faults: u8) -> Protocol {
    Protocol {
        topology,
        letters,
        faults,
        kinds: &ALL_FAULTS,
        moves: false,
        capacity: ROOMY,
        window: letters,
        notes: true,
        in_order: true,
        hostile: false,
        mutant: None,
    }
}

/// The second custodian is hostile. No letter is certain to get an outcome then.
fn hostile(topology: Topology, letters: usize) -> Protocol {
    Protocol {
        hostile: true,
        ..protocol(topology, letters, 0)
    }
}

fn moving(protocol: Protocol) -> Protocol {
    Protocol {
        moves: true,
        ..protocol
    }
}

fn with_capacity(capacity: usize, protocol: Protocol) -> Protocol {
    Protocol {
        capacity,
        ..protocol
    }
}

fn counterexample(model: &Protocol, broken: &str, path: &[(Action, State)]) -> String {
    let mut text = format!("{model:?}\nbroken: {broken}\n");
    for (action, _) in path {
        let _ = writeln!(text, "  {action:?}");
    }
    if let Some((_, state)) = path.last() {
        let _ = writeln!(text, "  {state:#?}");
    }
    text
}

/// Explores a configuration.
///
/// # Errors
///
/// Returns the first broken property, and a counterexample.
fn explore(model: &Protocol, limit: usize) -> Result<Graph, (&'static str, String)> {
    let begin = Instant::now();
    let graph = Graph::explore(model, limit);
    let broken = graph
        .violations
        .first()
        .copied()
        .or_else(|| Some(("an outcome can be reached", graph.stuck()?)))
        .or_else(|| Some(("a fair run ends", graph.livelock()?)))
        .filter(|(name, _)| !model.hostile || graph.violations.iter().any(|it| it.0 == *name));
    println!(
        "{} states, {} steps, {:.1?}: {model:?}",
        graph.states(),
        graph.steps,
        begin.elapsed()
    );
    match broken {
        None => Ok(graph),
        Some((name, id)) => Err((name, counterexample(model, name, &graph.path(model, id)))),
    }
}

fn holds(model: &Protocol, limit: usize) -> Graph {
    explore(model, limit).unwrap_or_else(|(_, text)| panic!("{text}"))
}

/// More states than any configuration that runs by default.
const SMALL: usize = 200_000;

#[test]
fn one_fault_at_any_time() {
    for topology in [Topology::Chain, Topology::Routes, Topology::Direct] {
        holds(&protocol(topology, 2, 1), SMALL);
    }
}

#[test]
fn four_letters() {
    for topology in [Topology::Chain, Topology::Routes, Topology::Direct] {
        holds(&protocol(topology, 4, 0), SMALL);
    }
}

#[test]
fn the_receiver_is_registered_anew() {
    for topology in TOPOLOGIES {
        holds(&moving(protocol(topology, 2, 0)), SMALL);
    }
}

/// Four letters, two custodians as two routes, two registrations of the receiver.
#[test]
#[ignore = "explores 311,353 states, which takes minutes"]
fn four_letters_and_a_new_registration() {
    let routes = moving(protocol(Topology::Routes, state::MAX_LETTERS, 0));
    holds(
        &Protocol {
            window: 2,
            ..routes
        },
        usize::MAX,
    );
}

#[test]
fn lanes_are_full() {
    for topology in TOPOLOGIES {
        for capacity in [1, 2] {
            holds(&with_capacity(capacity, protocol(topology, 3, 0)), SMALL);
        }
        holds(&with_capacity(1, moving(protocol(topology, 2, 0))), SMALL);
    }
}

/// The properties of the protocol need no notes of a lower predecessor, which only save time. They
/// hold for each order in which letters are dispatched.
#[test]
fn notes_and_the_order_of_dispatch_only_save_time() {
    let direct = protocol(Topology::Direct, 2, 1);
    let lax = Protocol {
        notes: false,
        in_order: false,
        ..direct
    };
    holds(&lax, SMALL);
    holds(&moving(Protocol { faults: 0, ..lax }), SMALL);
}

/// The checker of `stateright` explores the same states and finds no counterexample either.
#[test]
fn stateright_agrees() {
    let model = moving(protocol(Topology::Chain, 2, 0));
    let checker = model.clone().checker().threads(2).spawn_bfs().join();
    checker.assert_properties();
    assert_eq!(checker.unique_state_count(), holds(&model, SMALL).states());
}

/// Returns the properties that a mutant breaks, by the first counterexamples of `stateright`.
fn broken_invariants(mutant: Mutant, model: Protocol) -> Vec<&'static str> {
    let model = Protocol {
        mutant: Some(mutant),
        ..model
    };
    let checker = model
        .checker()
        .finish_when(HasDiscoveries::AnyFailures)
        .spawn_bfs()
        .join();
    checker.discoveries().into_keys().collect()
}

#[test]
fn broken_rules_break_an_invariant() {
    let direct = |letters, faults| protocol(Topology::Direct, letters, faults);
    let passed_over = "no open letter is passed over";
    let certain = "no certain failure of a taken letter";
    let twice = "at most once";
    for (mutant, model, broken) in [
        (Mutant::NoPredecessor, direct(2, 0), passed_over),
        (Mutant::CertainReturn, direct(1, 1), certain),
        (
            Mutant::CertainBehind,
            protocol(Topology::Chain, 1, 1),
            certain,
        ),
        (Mutant::ForgetUncertain, moving(direct(1, 1)), twice),
        (Mutant::MoveUncertain, moving(direct(1, 1)), twice),
        (Mutant::NoWaitForOld, moving(direct(2, 0)), passed_over),
        (Mutant::BelieveAny, moving(direct(2, 1)), twice),
        (Mutant::CertainLoss, moving(direct(1, 1)), twice),
        (Mutant::LowerPastReturned, direct(3, 0), passed_over),
        (Mutant::NoteByStream, moving(direct(3, 0)), passed_over),
    ] {
        holds(&model, SMALL);
        let found = broken_invariants(mutant, model);
        assert!(found.contains(&broken), "{mutant:?} breaks {found:?}");
    }
}

/// Whatever the next service answers, a letter leaves a limited number of times between two pauses.
#[test]
fn a_service_that_answers_anything_causes_no_storm() {
    for topology in [Topology::Routes, Topology::Chain] {
        holds(&hostile(topology, 2), SMALL);
    }
}

#[test]
fn without_pauses_answers_cause_a_storm() {
    for mutant in [Mutant::AgainAtOnce, Mutant::CreditAlways] {
        for topology in [Topology::Routes, Topology::Chain] {
            let found = broken_invariants(mutant, hostile(topology, 2));
            assert_eq!(
                found,
                ["no repetitions without a pause"],
                "{mutant:?}, {topology:?}"
            );
        }
    }
}

#[test]
fn broken_rules_block_a_stream() {
    let direct = protocol(Topology::Direct, 2, 0);
    for (mutant, model, expected) in [
        (
            Mutant::NeverReturn,
            direct.clone(),
            "an outcome can be reached",
        ),
        (
            Mutant::FullForAll,
            with_capacity(1, direct),
            "a fair run ends",
        ),
    ] {
        holds(&model, SMALL);
        let model = Protocol {
            mutant: Some(mutant),
            ..model
        };
        let broken = explore(&model, SMALL).err().map(|(broken, _)| broken);
        assert_eq!(broken, Some(expected), "{mutant:?}");
    }
}

/// `FIPA_MODEL_WALKS` sets the number of seeds, `FIPA_MODEL_SEED` repeats one.
#[test]
fn walks() {
    let number = |name: &str| {
        std::env::var(name)
            .ok()
            .map(|text| text.parse::<u64>().expect("a number"))
    };
    let seeds = match number("FIPA_MODEL_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FIPA_MODEL_WALKS").unwrap_or(200),
    };
    let begin = Instant::now();
    let mut steps = 0;
    for seed in seeds {
        for topology in TOPOLOGIES {
            for capacity in [ROOMY, 1 + seed as usize % 3] {
                let faults = 1 + (seed % 8) as u8;
                let model = with_capacity(capacity, moving(protocol(topology, 4, faults)));
                steps += walk::walk(&model, seed).unwrap_or_else(|(broken, path)| {
                    panic!("seed {seed}, {model:?}, broken: {broken}\n{path:#?}")
                });
            }
        }
    }
    println!("{steps} steps, {:.1?}", begin.elapsed());
}

/// Explores the configuration in `FIPA_MODEL`: a topology, then any of `letters=`, `faults=`,
/// `capacity=`, `window=`, `moves`, `no-notes`, `any-order` and `stateright`. The last one checks
/// the invariants alone, on two threads, and needs less memory.
#[test]
fn chosen() {
    let text = std::env::var("FIPA_MODEL").unwrap_or_else(|_| "direct,letters=2,faults=1".into());
    let mut words = text.split(',');
    let topology = match words.next() {
        Some("chain") => Topology::Chain,
        Some("routes") => Topology::Routes,
        Some("shortcut") => Topology::Shortcut,
        Some("direct") => Topology::Direct,
        other => {
            panic!("FIPA_MODEL: unknown topology {other:?}; use chain, routes, shortcut or direct")
        }
    };
    let mut model = protocol(topology, 2, 1);
    model.window = state::MAX_LETTERS;
    let mut stateright = false;
    for word in words {
        match word.split_once('=') {
            Some(("letters", number)) => model.letters = number.parse().expect("a number"),
            Some(("faults", number)) => model.faults = number.parse().expect("a number"),
            Some(("capacity", number)) => model.capacity = number.parse().expect("a number"),
            Some(("window", number)) => model.window = number.parse().expect("a number"),
            None if word == "moves" => model.moves = true,
            None if word == "no-notes" => model.notes = false,
            None if word == "any-order" => model.in_order = false,
            None if word == "stateright" => stateright = true,
            _ => panic!("FIPA_MODEL: unknown word {word}"),
        }
    }
    assert!(model.letters <= state::MAX_LETTERS);
    if !stateright {
        holds(&model, usize::MAX);
        return;
    }
    let begin = Instant::now();
    let checker = model.clone().checker().threads(2).spawn_bfs().join();
    println!(
        "{} states, {} steps, {:.1?}: {model:?}",
        checker.unique_state_count(),
        checker.state_count(),
        begin.elapsed()
    );
    checker.assert_properties();
}
