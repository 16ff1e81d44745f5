//! Merges states that differ only in details without any further effect.

use crate::protocol::Protocol;
use crate::state::{CUSTODIANS, Key, MAX_LETTERS, Place, SENDER, Service, State, What};

impl Protocol {
    /// Visits each transfer in the state, with the service that handed the letter over
    /// and the letter's sequence.
    pub(crate) fn each_transfer(state: &mut State, visit: &mut impl FnMut(Service, u8, &mut u8)) {
        for message in &mut state.network {
            let by = match message.what {
                What::Copy { .. } | What::Predecessor { .. } => message.from,
                _ => message.to,
            };
            visit(by, message.key.sequence, &mut message.transfer);
        }
        for (sequence, letter) in (1..).zip(&mut state.letters) {
            if let Place::Out { transfer, .. } = &mut letter.place {
                visit(SENDER, sequence, transfer);
            }
        }
        for (node, custodian) in CUSTODIANS.into_iter().zip(&mut state.custodians) {
            let life = custodian.life;
            for held in &mut custodian.held {
                let sequence = held.key.sequence;
                if let Place::Out { transfer, .. } = &mut held.place {
                    visit(Service { node, life }, sequence, transfer);
                }
                for (slot, transfer) in held.upstream.iter_mut().enumerate() {
                    if *transfer > 0 {
                        visit(Service::of_slot(slot), sequence, transfer);
                    }
                }
            }
        }
    }

    /// Removes details without any further effect: answers to attempts that were concluded,
    /// reports of letters that have an outcome, and entries for services that can no longer
    /// report.
    pub(crate) fn forget(state: &mut State) {
        let mut network = std::mem::take(&mut state.network);
        network.retain(|message| {
            let place = Self::place_of(state, message.to, message.key);
            match message.what {
                What::Copy { .. } | What::Predecessor { .. } => true,
                What::Delivered | What::Failed { .. } | What::Returned { .. } => {
                    message.to != SENDER || place.is_some()
                }
                _ => matches!(place, Some(Place::Out { to, transfer, .. })
                    if to == message.from && transfer == message.transfer),
            }
        });
        let life = state.custodians[0].life;
        for custodian in 0..state.custodians.len() {
            for index in 0..state.custodians[custodian].held.len() {
                let key = state.custodians[custodian].held[index].key;
                let open = Self::place_of(state, SENDER, key).is_some();
                let held = &mut state.custodians[custodian].held[index];
                if !open {
                    held.upstream[0] = 0;
                }
                if life > 0 {
                    held.upstream[1] = 0;
                }
            }
        }
        for by in [SENDER, Self::at(state, 0)] {
            for registration in 0..2 {
                for sequence in 1..=MAX_LETTERS as u8 {
                    let key = Key {
                        registration,
                        sequence,
                    };
                    if Self::place_of(state, by, key).is_none() {
                        continue;
                    }
                    let mut known = 0;
                    for message in network.iter().filter(|message| message.key == key) {
                        if message.from == by {
                            known |= message.to.bit();
                        } else if message.to == by {
                            known |= message.from.bit();
                        }
                    }
                    for (node, custodian) in CUSTODIANS.into_iter().zip(&state.custodians) {
                        let at = Service {
                            node,
                            life: custodian.life,
                        };
                        let mut lane = custodian.held.iter();
                        if node != by.node
                            && lane.any(|held| held.key == key && held.upstream[by.slot()] > 0)
                        {
                            known |= at.bit();
                        }
                    }
                    match by.custodian() {
                        None => state.letters[usize::from(sequence) - 1].handed &= known,
                        Some(custodian) => {
                            if let Some(held) = Self::held(state, custodian, key) {
                                held.handed &= known;
                            }
                        }
                    }
                }
            }
        }
        state.network = network;
    }

    /// Renumbers transfers from 1 without gaps, which changes no comparison of two of them: the
    /// number of states stays finite.
    pub(crate) fn renumber(state: &mut State) {
        let mut used = [[0_u16; MAX_LETTERS + 1]; Service::COUNT];
        Self::each_transfer(state, &mut |by, sequence, transfer| {
            used[by.index()][usize::from(sequence)] |= 1 << *transfer;
        });
        // Numbers without gaps: bit 0 and the used bits form a block of ones at the low end.
        let mut all = used.iter().flatten();
        if all.all(|used| (used | 1) & ((used | 1) + 1) == 0) {
            return;
        }
        Self::each_transfer(state, &mut |by, sequence, transfer| {
            let below = (2 << *transfer) - 1;
            let used = used[by.index()][usize::from(sequence)];
            *transfer = (used & below).count_ones() as u8;
        });
    }

    pub(crate) fn next_transfer(state: &mut State, by: Service, sequence: u8) -> u8 {
        let mut highest = 0;
        Self::each_transfer(state, &mut |of, other, transfer| {
            if (of, other) == (by, sequence) {
                highest = highest.max(*transfer);
            }
        });
        highest + 1
    }
}
