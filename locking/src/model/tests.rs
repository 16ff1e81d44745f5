#![expect(clippy::print_stdout, reason = "a long run prints its progress")]

use std::time::Instant;

use stateright::{Checker, Model};

use super::graph::Graph;
use super::system::{Faults, State, Step, System, Time};
use crate::Kind;
use crate::faults::Fault;

/// More states than any configuration that runs by default.
const SMALL: usize = 300_000;

fn system(kind: Kind, claims: &[u8], time: Time, faults: Faults) -> System {
    System {
        kind,
        claims: claims.to_vec(),
        time,
        faults,
        probes: false,
        lease: 4,
        fault: Fault::None,
    }
}

fn describe(system: &System, problem: &str, path: &[Step], state: &State) -> String {
    let mut text = format!("{system:?}\n{problem}\n");
    for step in path {
        text += &format!("  {step:?}\n");
    }
    text + &format!("{state:#?}")
}

/// Explores a configuration.
///
/// # Errors
///
/// Returns the number of the broken invariant (10: a claim that cannot end), and a counterexample.
fn explore(system: &System, limit: usize) -> Result<usize, (u8, String)> {
    let begin = Instant::now();
    let graph = Graph::explore(system, limit);
    println!("{} states, {:.1?}: {system:?}", graph.states(), begin.elapsed());
    if let Some(id) = graph.broken {
        let (path, state) = graph.path(system, id);
        let violation = state.broken().expect("a broken state");
        let text = describe(system, &violation.to_string(), &path, &state);
        return Err((violation.number, text));
    }
    if system.time == Time::Prompt
        && let Some(id) = graph.stuck()
    {
        let (path, state) = graph.path(system, id);
        return Err((10, describe(system, "a claim cannot end", &path, &state)));
    }
    Ok(graph.states())
}

fn holds(system: &System) -> usize {
    explore(system, SMALL).unwrap_or_else(|(_, text)| panic!("{text}"))
}

#[test]
fn two_requesters_and_delayed_messages() {
    for kind in Kind::ALL {
        holds(&system(kind, &[0, 1, 1], Time::Free(1), Faults::default()));
    }
}

/// Explores the configuration in `FIPA_LOCKS_MODEL`, for example
/// `ricart_agrawala_extended,claims=0.1.1,ticks=4,losses=1`.
#[test]
fn chosen() {
    let text = std::env::var("FIPA_LOCKS_MODEL")
        .unwrap_or_else(|_| "ricart_agrawala_extended,claims=0.1".into());
    let mut words = text.split(',');
    let name = words.next().unwrap_or_default();
    let kind = Kind::ALL.into_iter().find(|kind| kind.protocol() == name);
    let kind = kind.expect("FIPA_LOCKS_MODEL begins with a protocol");
    let mut model = system(kind, &[0, 1], Time::Prompt, Faults::default());
    let mut stateright = false;
    for word in words {
        let (key, value) = word.split_once('=').unwrap_or((word, "1"));
        let number = || value.parse::<u8>().expect("a number");
        match key {
            "claims" => {
                let claims = value.split('.');
                model.claims = claims.map(|claims| claims.parse().expect("a number")).collect();
            }
            "ticks" => model.time = Time::Free(number()),
            "lease" => model.lease = number().into(),
            "probes" => model.probes = true,
            "losses" => model.faults.losses = number(),
            "duplicates" => model.faults.duplicates = number(),
            "crashes" => model.faults.crashes = number(),
            "pauses" => model.faults.pauses = number(),
            "restarts" => model.faults.restarts = number(),
            "withdrawals" => model.faults.withdrawals = number(),
            "stateright" => stateright = true,
            _ => panic!("FIPA_LOCKS_MODEL: unknown word {word}"),
        }
    }
    if stateright {
        let begin = Instant::now();
        let checker = model.clone().checker().threads(2).spawn_bfs().join();
        println!("{} states, {:.1?}: {model:?}", checker.unique_state_count(), begin.elapsed());
        checker.assert_properties();
    } else {
        explore(&model, usize::MAX).unwrap_or_else(|(_, text)| panic!("{text}"));
    }
}
