use std::time::Instant;

use stateright::{Checker, Model};

use super::graph::Graph;
use super::system::{Faults, Memory, State, Step, System, Time};
use crate::Algorithm;
use crate::faults::Fault;

/// More states than any configuration that runs by default.
pub(super) const SMALL: usize = 300_000;

pub(super) fn system(kind: Algorithm, claims: &[u8], time: Time, faults: Faults) -> System {
    System {
        kind,
        claims: claims.to_vec(),
        time,
        faults,
        probes: false,
        lease: 4,
        memory: Memory::NoClock,
        fault: Fault::None,
        foreign_owner: false,
        foreigner: None,
        turns: false,
    }
}

/// An owner of `distributed_locking`, and agents that start one after the other.
fn strangers(kind: Algorithm, claims: &[u8], foreigner: Option<u8>) -> System {
    System {
        foreign_owner: true,
        foreigner,
        ..system(kind, claims, Time::Prompt, NONE)
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
pub(super) fn explore(system: &System, limit: usize) -> Result<usize, (u8, String)> {
    let begin = Instant::now();
    let graph = Graph::explore(system, limit);
    println!(
        "{} states, {:.1?}: {system:?}",
        graph.states(),
        begin.elapsed()
    );
    if let Some(id) = graph.broken {
        let (path, state) = graph.path(system, id);
        let violation = state.broken().expect("a broken state");
        let text = describe(system, &violation.to_string(), &path, &state);
        return Err((violation.number, text));
    }
    // Where grants are counted, the scenario waits for its crash, which is a fault.
    if system.time == Time::Prompt
        && !system.turns
        && let Some(id) = graph.stuck()
    {
        let (path, state) = graph.path(system, id);
        return Err((10, describe(system, "a claim cannot end", &path, &state)));
    }
    Ok(graph.states())
}

pub(super) fn holds(system: &System) -> usize {
    explore(system, SMALL).unwrap_or_else(|(_, text)| panic!("{text}"))
}

pub(super) const NONE: Faults = Faults {
    losses: 0,
    duplicates: 0,
    crashes: 0,
    pauses: 0,
    restarts: 0,
    withdrawals: 0,
    moves: 0,
    commands: 0,
};

#[test]
fn two_requesters_and_delayed_messages() {
    for kind in Algorithm::ALL {
        holds(&system(kind, &[0, 1, 1], Time::Free(1), NONE));
    }
}

#[test]
fn the_owner_and_a_requester() {
    for kind in Algorithm::ALL {
        holds(&system(kind, &[1, 1], Time::Prompt, NONE));
    }
}

const EXTENDED: [Algorithm; 3] = [
    Algorithm::OwnerQueue,
    Algorithm::RicartAgrawalaExtended,
    Algorithm::SuzukiKasamiExtended,
];

#[test]
fn a_message_is_lost_and_the_owner_restarts() {
    for kind in EXTENDED {
        let faults = Faults {
            losses: 1,
            restarts: 1,
            ..NONE
        };
        holds(&system(kind, &[0, 1], Time::Prompt, faults));
    }
}

#[test]
fn a_requester_crashes_and_returns() {
    for kind in EXTENDED {
        let faults = Faults {
            losses: 1,
            crashes: 1,
            ..NONE
        };
        holds(&system(kind, &[0, 1], Time::Prompt, faults));
    }
}

#[test]
fn a_request_is_withdrawn() {
    for kind in Algorithm::ALL {
        let faults = Faults {
            withdrawals: 1,
            ..NONE
        };
        holds(&system(kind, &[0, 2], Time::Prompt, faults));
    }
}

#[test]
fn a_holder_pauses() {
    for kind in EXTENDED {
        let faults = Faults { pauses: 1, ..NONE };
        let probed = System {
            probes: true,
            ..system(kind, &[0, 1], Time::Prompt, faults)
        };
        holds(&probed);
    }
}

/// The hosts have state files of their own. Without a clock, the agent that has held a fence reports it.
#[test]
fn an_owner_starts_on_another_host_and_comes_back() {
    for kind in EXTENDED {
        for memory in [Memory::Clocks, Memory::SecondClock] {
            let faults = Faults { moves: 2, ..NONE };
            holds(&System {
                memory,
                lease: 2,
                ..system(kind, &[0, 2], Time::Prompt, faults)
            });
        }
        holds(&without_clock(kind));
    }
}

fn without_clock(kind: Algorithm) -> System {
    let faults = Faults {
        moves: 1,
        losses: 1,
        ..NONE
    };
    System {
        lease: 2,
        ..system(kind, &[0, 2], Time::Prompt, faults)
    }
}

/// An owner without a state file was told to forget fences that are in use.
fn forgetful(kind: Algorithm) -> System {
    let faults = Faults {
        moves: 1,
        commands: 2,
        ..NONE
    };
    System {
        memory: Memory::Forgets,
        lease: 2,
        ..system(kind, &[0, 2], Time::Prompt, faults)
    }
}

#[test]
fn a_device_admits_one_of_two_runs_with_the_same_epoch() {
    for kind in EXTENDED {
        holds(&forgetful(kind));
    }
}

/// The checker of `stateright` explores the same states and finds no counterexample either.
#[test]
fn stateright_agrees() {
    let model = system(
        Algorithm::SuzukiKasamiExtended,
        &[1, 1],
        Time::Free(2),
        NONE,
    );
    let checker = model.clone().checker().threads(2).spawn_bfs().join();
    checker.assert_properties();
    assert_eq!(checker.unique_state_count(), holds(&model));
}

/// Each mistake breaks an invariant, in a configuration in which the core without it breaks none.
#[test]
fn mistakes_are_found() {
    let basic = Algorithm::RicartAgrawala;
    let token = Algorithm::SuzukiKasamiExtended;
    let prompt = |kind, claims: &[u8], faults| system(kind, claims, Time::Prompt, faults);
    let free = |ticks, lease, faults| System {
        lease,
        ..system(token, &[1, 1], Time::Free(ticks), faults)
    };
    let duplicates = Faults {
        duplicates: 1,
        ..NONE
    };
    let restarts = Faults {
        restarts: 1,
        ..NONE
    };
    let probed = System {
        probes: true,
        ..free(3, 3, NONE)
    };
    let ricart = Algorithm::RicartAgrawalaExtended;
    let moves = |moves, memory| System {
        memory,
        lease: 2,
        ..prompt(ricart, &[0, 2], Faults { moves, ..NONE })
    };
    for (fault, model, broken) in [
        (Fault::RenewByProbe, probed, 4),
        (Fault::CountFromArrival, free(2, 2, NONE), 4),
        (Fault::GrantAfterRestart, free(1, 4, restarts), 4),
        (
            Fault::KeepEpoch,
            prompt(Algorithm::RicartAgrawalaExtended, &[0, 2], restarts),
            1,
        ),
        (Fault::FileOnly, moves(1, Memory::Clocks), 1),
        (Fault::AskNobody, moves(2, Memory::SecondClock), 1),
        (Fault::BeginAnyway, without_clock(ricart), 5),
        (Fault::SameRun, forgetful(ricart), 1),
        (Fault::ReleaseByName, prompt(basic, &[0, 2], duplicates), 6),
        (Fault::DropDeferred, prompt(basic, &[0, 1, 1], NONE), 10),
        (Fault::ReuseFence, prompt(basic, &[0, 2], NONE), 1),
        (Fault::IgnoreGate, prompt(basic, &[0, 1, 1], NONE), 9),
        (Fault::GrantWithdrawn, prompt(basic, &[0, 1], duplicates), 7),
    ] {
        holds(&model);
        let mutant = System { fault, ..model };
        let found = explore(&mutant, SMALL).err().map(|(number, _)| number);
        assert_eq!(found, Some(broken), "{fault:?}");
    }
}

/// Agents that start while others request a resource without fences, or hold it, never hold it together with them.
#[test]
fn agents_join_during_requests() {
    let basic = Algorithm::RicartAgrawala;
    holds(&strangers(basic, &[0, 1, 1], None));
    holds(&strangers(basic, &[0, 1, 1], Some(1)));
    holds(&strangers(basic, &[0, 1, 1], Some(2)));
    for (fault, model) in [
        (Fault::AskNoNewcomer, strangers(basic, &[0, 1, 1], None)),
        (Fault::AwaitNoAnswer, strangers(basic, &[0, 1, 1], None)),
        (Fault::ForgetClock, strangers(basic, &[0, 1, 1], None)),
        (Fault::TrustStranger, strangers(basic, &[0, 1, 1], Some(2))),
    ] {
        let mutant = System { fault, ..model };
        let found = explore(&mutant, SMALL).err().map(|(number, text)| {
            println!("{text}");
            number
        });
        assert_eq!(found, Some(4), "{fault:?}");
    }
}

/// An agent that is killed while it holds, and returns, waits for one more grant of another agent at most. The
/// other agent waits for the kill before its first request.
#[test]
fn an_agent_that_was_killed_and_returns_has_its_turn() {
    let faults = Faults { crashes: 1, ..NONE };
    let model = System {
        turns: true,
        lease: 2,
        ..system(
            Algorithm::SuzukiKasamiExtended,
            &[0, 2, 3],
            Time::Prompt,
            faults,
        )
    };
    holds(&model);
    let fault = Fault::TakeWhole;
    let mutant = System { fault, ..model };
    let found = explore(&mutant, SMALL).err().map(|(number, text)| {
        println!("{text}");
        number
    });
    assert_eq!(found, Some(11), "{fault:?}");
}

/// Explores the configuration in `FIPA_LOCKS_MODEL`, for example
/// `ricart_agrawala_extended,claims=0.1.1,ticks=4,losses=1`.
#[test]
fn chosen() {
    let text = std::env::var("FIPA_LOCKS_MODEL")
        .unwrap_or_else(|_| "ricart_agrawala_extended,claims=0.1".into());
    let mut words = text.split(',');
    let name = words.next().unwrap_or_default();
    let kind = Algorithm::ALL
        .into_iter()
        .find(|kind| kind.protocol() == name);
    let kind = kind.expect("FIPA_LOCKS_MODEL begins with a protocol");
    let mut model = system(kind, &[0, 1], Time::Prompt, Faults::default());
    let mut stateright = false;
    for word in words {
        let (key, value) = word.split_once('=').unwrap_or((word, "1"));
        let number = || value.parse::<u8>().expect("a number");
        match key {
            "claims" => {
                let claims = value.split('.');
                model.claims = claims
                    .map(|claims| claims.parse().expect("a number"))
                    .collect();
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
            "moves" => model.faults.moves = number(),
            "commands" => model.faults.commands = number(),
            "clocks" => model.memory = Memory::Clocks,
            "clock2" => model.memory = Memory::SecondClock,
            "forgets" => model.memory = Memory::Forgets,
            "file-only" => model.fault = Fault::FileOnly,
            "ask-nobody" => model.fault = Fault::AskNobody,
            "begin-anyway" => model.fault = Fault::BeginAnyway,
            "same-run" => model.fault = Fault::SameRun,
            "stateright" => stateright = true,
            _ => panic!("FIPA_LOCKS_MODEL: unknown word {word}"),
        }
    }
    if stateright {
        let begin = Instant::now();
        let checker = model.clone().checker().threads(2).spawn_bfs().join();
        println!(
            "{} states, {:.1?}: {model:?}",
            checker.unique_state_count(),
            begin.elapsed()
        );
        checker.assert_properties();
    } else {
        explore(&model, usize::MAX).unwrap_or_else(|(_, text)| panic!("{text}"));
    }
}
