//! Letters for agents of a service whose certificate is no longer trusted. They end as refused, and as
//! unconfirmed if the service may have taken them.

use std::time::Instant;

use fipa_sds::{Entry, Reach};
use fipa_transport::{FailureReason, TransportError, TransportErrorKind};

use super::super::lane_table::LaneTable;
use super::super::rules::AttemptEnd;
use super::super::work;
use super::Lane;
use super::open_letter::State;

impl Lane {
    /// Handles a change of the services whose certificate is no longer trusted.
    pub(crate) fn trust_changed(&mut self, now: Instant, table: &mut LaneTable) {
        work::steps(self.letters.len());
        let mut index = 0;
        while let Some(open_letter) = self.letters.get(index) {
            let entry = self.entry(open_letter.registration, table);
            let entry = entry.filter(|entry| is_withdrawn(entry, table));
            let (Some(entry), Some(open_letter)) = (entry, self.letters.get_mut(index)) else {
                index += 1;
                continue;
            };
            match &mut open_letter.progress.state {
                // Its conclusion follows at once, and then it is refused like one that waits.
                State::UnderWay { .. } => {
                    open_letter.abandon(table, || error(&entry));
                    index += 1;
                }
                State::Custody { .. } => {
                    open_letter.ended(AttemptEnd::Unknown);
                    self.refuse(now, index, &entry, table);
                }
                State::Waiting(_) | State::Ended => self.refuse(now, index, &entry, table),
            }
        }
        self.dispatch_all(now, table);
    }

    /// Ends a letter for an agent of a service whose certificate is no longer trusted.
    pub(super) fn refuse(
        &mut self,
        now: Instant,
        index: usize,
        entry: &Entry,
        table: &mut LaneTable,
    ) {
        if let Some(location) = entry.locations.first() {
            self.letters[index].failed_at(location, error(entry));
        }
        self.fail(now, index, FailureReason::Refused, table);
    }
}

/// Whether the service of this agent has a certificate that is no longer trusted.
pub(super) fn is_withdrawn(entry: &Entry, table: &LaneTable) -> bool {
    match entry.reach {
        Reach::Remote { gateway } => table.withdrawn.contains_key(&gateway),
        Reach::Local => false,
    }
}

fn error(entry: &Entry) -> TransportError {
    let service = entry.mts.shown();
    let detail = format!("the trust in the certificate of {service} was withdrawn");
    TransportError::new(TransportErrorKind::Refused, detail)
}
