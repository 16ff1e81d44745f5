//! The sink of the transports: passes their events to the core.

use std::sync::Weak;
use std::sync::atomic::Ordering;

use fipa_acl::{DecodeError, Letter};
use fipa_sds::{Reach, Role};
use fipa_transport::{
    Answer, Arrival, Arriving, AttemptId, Conclusion, FailureReason, Introduction, Kind,
    LegacySource, LoanedContent, Location, Parcel, Reaction, Sink, log_limit, quota_address,
};
use parking_lot::MutexGuard;

use super::Shared;
use crate::core::Unframed;
use crate::core::letter_log::{LetterId, letter_debug};

/// The sink of one transport.
pub(super) struct TransportSink {
    pub(super) shared: Weak<Shared>,
    pub(super) kind: Kind,
}

impl Sink for TransportSink {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        let Some(shared) = self.shared.upgrade() else {
            return closing();
        };
        let read = shared.reader.read_arrival(&arrival);
        let mut state = shared.lock();
        if shared.closed.load(Ordering::Acquire) {
            return closing();
        }
        let Parcel {
            stream,
            receiver,
            sequence,
            ..
        } = &arrival.parcel;
        let letter = LetterId::new(*stream, *sequence);
        if state.core.misses(stream.receiver, receiver) {
            drop(state);
            shared.directory.refresh();
            state = shared.lock();
        }
        let now = state.clocks.now();
        let reaction = state
            .core
            .handle_read_arrival(now, self.kind, arrival, read);
        letter_debug!(letter, via = %self.kind, ?reaction, "arrived");
        shared.carry_out(state);
        reaction
    }

    fn arrived_unframed(&self, letter: Letter, via: Kind, from: LegacySource) {
        let Some(shared) = self.shared.upgrade() else {
            return;
        };
        shared.directory.refresh();
        let unframed = match Unframed::read(letter, via, from, &*shared.directory) {
            Ok(unframed) => {
                let unframed = unframed.read_by(&shared.reader);
                match shared.shared_content(unframed.content()) {
                    Some(content) => unframed.with_content(content),
                    None => unframed,
                }
            }
            Err(error) => return malformed(from, &error),
        };
        handle_unframed(&shared, unframed);
    }

    fn refused_unframed(&self, letter: Letter, via: Kind, from: LegacySource, reason: &str) {
        let Some(shared) = self.shared.upgrade() else {
            return;
        };
        match Unframed::refused(letter, via, from, reason) {
            Ok(unframed) => handle_unframed(&shared, unframed),
            Err(error) => malformed(from, &error),
        }
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        let Some(shared) = self.shared.upgrade() else {
            return;
        };
        let mut state = shared.lock();
        let now = state.clocks.now();
        state.core.handle_conclusion(now, attempt, conclusion);
        shared.carry_out(state);
    }

    fn memory_for(&self, arriving: &Arriving<'_>) -> Option<Box<dyn LoanedContent>> {
        self.shared.upgrade()?.memory_for(arriving)
    }

    fn also_at(&self, location: &Location) -> Vec<Location> {
        let Some(shared) = self.shared.upgrade() else {
            return Vec::new();
        };
        // All agents of a service have the same locations.
        let entries = shared.directory.entries();
        let mut entries = entries.iter();
        let Some(entry) = entries.find(|entry| entry.locations.contains(location)) else {
            return Vec::new();
        };
        let others = entry.locations.iter().filter(|other| {
            *other != location
                && other.kind() == location.kind()
                && other.incarnation() == location.incarnation()
        });
        others.cloned().collect()
    }

    fn is_here(&self, name: &str) -> bool {
        let Some(shared) = self.shared.upgrade() else {
            return false;
        };
        let entry = shared.directory.lookup(name);
        entry.is_some_and(|entry| entry.reach == Reach::Local && entry.role == Role::Agent)
    }

    fn relocated(&self, locations: Vec<Location>) {
        let Some(shared) = self.shared.upgrade() else {
            return;
        };
        shared.locate(self.kind, locations, true);
        let mut state = shared.lock();
        let now = state.clocks.now();
        state.core.handle_reachable(now, None);
        shared.carry_out(state);
    }

    fn accepts(&self, peer: &Introduction) -> bool {
        let Some(shared) = self.shared.upgrade() else {
            return false;
        };
        let state = shared.lock();
        state.core.accepts(peer)
    }

    fn introduced(&self, peer: &Introduction) {
        let Some(shared) = self.shared.upgrade() else {
            return;
        };
        if let Some(contacts) = &shared.config.contacts {
            contacts.introduced(peer);
        }
        let mut state = shared.lock();
        let now = state.clocks.now();
        state.core.handle_introduced(now, peer);
        shared.carry_out(state);
    }

    fn disconnected(&self, peer: &Introduction) {
        let Some(shared) = self.shared.upgrade() else {
            return;
        };
        if let Some(contacts) = &shared.config.contacts {
            contacts.disconnected(peer);
        }
        let mut state = shared.lock();
        let now = state.clocks.now();
        state.core.handle_disconnected(now, peer);
        shared.carry_out(state);
    }
}

fn handle_unframed(shared: &Shared, mut unframed: Unframed) {
    loop {
        let mut state = shared.lock();
        if shared.closed.load(Ordering::Acquire) {
            return;
        }
        let deadline = state.unframed_deadline;
        let now = state.clocks.now();
        state.core.handle_unframed(now, deadline, &mut unframed);
        if unframed.is_handled() {
            shared.carry_out(state);
            return;
        }
        // A thread that waits for the lock precedes the next portion.
        shared.carry_out_then(state, MutexGuard::unlock_fair);
    }
}

fn malformed(from: LegacySource, error: &DecodeError) {
    log_limit::warn!(of: quota_address(from.address), %error, "dropping an unframed letter: its envelope is malformed");
}

fn closing() -> Reaction {
    let reason = FailureReason::NoSuchAgent;
    Reaction::Now(Answer::failed(reason, "the process is closing"))
}
