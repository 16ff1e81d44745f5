//! The owner's queue in the model: its owner restarts in each state, grants and releases are lost, and messages of
//! earlier lives of members arrive.

use super::system::{Faults, System, Time};
use super::tests::{NONE, SMALL, explore, holds, system};
use crate::Algorithm;
use crate::faults::Fault;

fn prompt(claims: &[u8], faults: Faults) -> System {
    system(Algorithm::OwnerQueue, claims, Time::Prompt, faults)
}

fn free(claims: &[u8], ticks: u8, faults: Faults) -> System {
    system(Algorithm::OwnerQueue, claims, Time::Free(ticks), faults)
}

const RESTARTS: Faults = Faults {
    restarts: 1,
    ..NONE
};

/// Requests with and without a place, and a holder, in each order of arrival at the restarted owner.
#[test]
fn the_owner_restarts_in_each_state() {
    holds(&prompt(&[0, 2], RESTARTS));
    holds(&free(&[1, 1], 1, RESTARTS));
    holds(&free(&[0, 1, 1], 0, RESTARTS));
}

/// Any message: a request, a grant, a release, a place, or the announcement of the owner.
#[test]
fn a_message_is_lost() {
    let faults = Faults { losses: 1, ..NONE };
    holds(&prompt(&[0, 2], faults));
}

/// A release or a request of an earlier life arrives at any time.
#[test]
fn messages_of_an_earlier_life_of_a_member_change_no_grant() {
    let faults = Faults {
        crashes: 1,
        duplicates: 1,
        ..NONE
    };
    holds(&free(&[0, 1], 1, faults));
    let faults = Faults { crashes: 1, ..NONE };
    holds(&free(&[0, 1, 1], 0, faults));
}

#[test]
fn mistakes_in_the_owner_s_queue_are_found() {
    let duplicates = Faults {
        duplicates: 1,
        ..NONE
    };
    for (fault, model, broken) in [
        (
            Fault::CountFromArrival,
            System {
                lease: 2,
                ..free(&[1, 1], 2, NONE)
            },
            4,
        ),
        (Fault::GrantAfterRestart, free(&[1, 1], 1, RESTARTS), 4),
        (Fault::KeepEpoch, prompt(&[0, 2], RESTARTS), 1),
        (Fault::ReleaseByName, prompt(&[0, 2], duplicates), 6),
        (Fault::ReuseFence, prompt(&[0, 2], NONE), 1),
        (Fault::GrantWithdrawn, prompt(&[0, 1], duplicates), 7),
    ] {
        holds(&model);
        let mutant = System { fault, ..model };
        let found = explore(&mutant, SMALL).err().map(|(number, _)| number);
        assert_eq!(found, Some(broken), "{fault:?}");
    }
}
