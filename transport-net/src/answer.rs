//! The body of an answer frame.
//!
//! The first byte is the kind of answer: 0 accepted, 1 in custody, 2 busy, 3 out of order, 4
//! failed, 5 returned, 6 moved, 7 delivered. Kind 3 is followed by the last accepted position (8 bytes,
//! little-endian); kind 4 by the code of the reason (one byte) and the detail (UTF-8 to the end);
//! kind 5 by whether the letter may have been delivered (one byte, 0 or 1); kind 7 by the code of the
//! kind of transport (one byte).

use bytes::{BufMut, BytesMut};
use fipa_transport::Answer;
use fipa_transport::wire::{kind_code, kind_of_code, reason_code, reason_of_code, truncated};

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

/// Longest body of an answer, in bytes.
pub(crate) const MAX_ANSWER: usize = 2 + Answer::MAX_DETAIL;

const ACCEPTED: u8 = 0;
const CUSTODY: u8 = 1;
const BUSY: u8 = 2;
const OUT_OF_ORDER: u8 = 3;
const FAILED: u8 = 4;
const RETURNED: u8 = 5;
const MOVED: u8 = 6;
const DELIVERED: u8 = 7;

pub(crate) fn len(answer: &Answer) -> usize {
    match answer {
        Answer::OutOfOrder { .. } => 9,
        Answer::Returned { .. } | Answer::Delivered { .. } => 2,
        Answer::Failed { detail, .. } => 2 + truncated(detail, Answer::MAX_DETAIL).len(),
        _ => 1,
    }
}

pub(crate) fn encode(answer: &Answer, out: &mut BytesMut) {
    match answer {
        Answer::Accepted => out.put_u8(ACCEPTED),
        Answer::Custody => out.put_u8(CUSTODY),
        Answer::OutOfOrder { last } => {
            out.put_u8(OUT_OF_ORDER);
            out.put_u64_le(*last);
        }
        Answer::Failed { reason, detail } => {
            out.put_slice(&[FAILED, reason_code(*reason)]);
            out.put_slice(truncated(detail, Answer::MAX_DETAIL).as_bytes());
        }
        Answer::Returned { uncertain } => out.put_slice(&[RETURNED, u8::from(*uncertain)]),
        Answer::Moved => out.put_u8(MOVED),
        Answer::Delivered { via } => out.put_slice(&[DELIVERED, kind_code(*via)]),
        // Busy, and answers of later versions: "not now" is the safest reading for an older peer.
        _ => out.put_u8(BUSY),
    }
}

pub(crate) fn decode(body: &[u8]) -> Option<Answer> {
    match body {
        [ACCEPTED] => Some(Answer::Accepted),
        [CUSTODY] => Some(Answer::Custody),
        [BUSY] => Some(Answer::Busy),
        [MOVED] => Some(Answer::Moved),
        [DELIVERED, code] => Some(Answer::Delivered {
            via: kind_of_code(*code)?,
        }),
        [RETURNED, uncertain @ (0 | 1)] => Some(Answer::Returned {
            uncertain: *uncertain == 1,
        }),
        [OUT_OF_ORDER, position @ ..] => {
            let last = u64::from_le_bytes(position.try_into().ok()?);
            Some(Answer::OutOfOrder { last })
        }
        [FAILED, code, detail @ ..] => {
            let reason = reason_of_code(*code)?;
            let detail = std::str::from_utf8(detail).ok()?;
            Some(Answer::failed(reason, detail))
        }
        _ => None,
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

#[cfg(test)]
mod tests {
    use fipa_transport::{FailureReason, Kind};

    use super::*;

    #[test]
    fn every_answer_round_trips() {
        for answer in [
            Answer::Accepted,
            Answer::Custody,
            Answer::Busy,
            Answer::OutOfOrder { last: u64::MAX },
            Answer::Returned { uncertain: false },
            Answer::Returned { uncertain: true },
            Answer::Moved,
            Answer::Delivered { via: Kind::Quic },
            Answer::failed(FailureReason::NoSuchAgent, "no agent has the name béla"),
        ] {
            let mut body = BytesMut::new();
            encode(&answer, &mut body);
            assert_eq!(body.len(), len(&answer));
            assert!(body.len() <= MAX_ANSWER);
            assert_eq!(decode(&body), Some(answer));
        }
    }

    #[test]
    fn a_long_detail_is_cut_at_a_character() {
        let mut body = BytesMut::new();
        let detail = "é".repeat(Answer::MAX_DETAIL);
        let answer = Answer::failed(FailureReason::Refused, detail);
        encode(&answer, &mut body);
        assert_eq!(body.len(), len(&answer));
        match decode(&body) {
            Some(Answer::Failed { detail, .. }) => assert_eq!(detail.len(), Answer::MAX_DETAIL),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn malformed_answers_are_refused() {
        for wrong in [
            &[][..],
            &[0, 0],
            &[3, 1],
            &[4],
            &[4, 200],
            &[4, 0, 0xff],
            &[5],
            &[5, 2],
            &[6, 0],
            &[7],
            &[7, 200],
            &[7, 0, 0],
            &[9],
        ] {
            assert_eq!(decode(wrong), None, "{wrong:?}");
        }
    }
}
