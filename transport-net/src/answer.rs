//! Limits on answers that all network transports share. [`fipa_transport::wire`] defines the bytes of an answer.

use fipa_transport::Answer;

use crate::end::ConnectionEnd;

/// Counts the answers of a peer that contradict their parcels.
#[derive(Debug, Default)]
pub(crate) struct Contradictions(u32);

impl Contradictions {
    /// Checks the answer to a parcel with this predecessor.
    ///
    /// # Errors
    /// When the peer has given too many answers that contradict their parcels.
    pub(crate) fn check(&mut self, answer: &Answer, after: u64) -> Result<(), ConnectionEnd> {
        self.0 += u32::from(answer.contradicts(after));
        if self.0 < Answer::MAX_CONTRADICTIONS {
            return Ok(());
        }
        Err(ConnectionEnd::ProtocolViolation(
            "answers that contradict their parcels".into(),
        ))
    }
}

/// Returns the number of unanswered parcels at which another one is not queued. The last quarter is for parcels
/// other than letters: their receivers need them to have letters answered.
pub(crate) fn places(max_in_flight: usize, is_letter: bool) -> usize {
    match is_letter {
        true => (max_in_flight - max_in_flight / 4).max(1),
        false => max_in_flight.max(1),
    }
}
