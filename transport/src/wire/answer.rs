//! The bytes of an [`Answer`], the same over every transport.
//!
//! The first byte is the code:
//!
//! | code | answer | after the code |
//! |---|---|---|
//! | 0 | accepted | nothing |
//! | 1 | in custody | nothing |
//! | 2 | busy | nothing |
//! | 3 | out of order | the last accepted sequence: 8 bytes, little-endian |
//! | 4 | failed | the [code of the reason](super::reason_code), then the detail: UTF-8 to the end |
//! | 5 | returned | whether the letter may have been delivered: 0 or 1 |
//! | 6 | moved | nothing |
//! | 7 | delivered | the [code of the kind of transport](super::kind_code) |

use bytes::BufMut;

use super::{kind_code, kind_of_code, reason_code, reason_of_code, truncated};
use crate::Answer;

/// Longest answer, in bytes.
pub const MAX_ANSWER_LEN: usize = 2 + Answer::MAX_DETAIL;

const ACCEPTED: u8 = 0;
const CUSTODY: u8 = 1;
const BUSY: u8 = 2;
const OUT_OF_ORDER: u8 = 3;
const FAILED: u8 = 4;
const RETURNED: u8 = 5;
const MOVED: u8 = 6;
const DELIVERED: u8 = 7;

/// Returns the length of an answer in bytes. An answer of one byte is its code alone.
#[must_use]
pub fn answer_len(answer: &Answer) -> usize {
    match answer {
        Answer::Accepted | Answer::Custody | Answer::Busy | Answer::Moved => 1,
        Answer::Returned { .. } | Answer::Delivered { .. } => 2,
        Answer::OutOfOrder { .. } => 9,
        Answer::Failed { detail, .. } => 2 + truncated(detail, Answer::MAX_DETAIL).len(),
    }
}

/// Writes an answer: [`answer_len`] bytes. The detail of a failure is cut at [`Answer::MAX_DETAIL`] bytes.
///
/// # Panics
/// When `out` has less room.
pub fn write_answer(answer: &Answer, out: &mut impl BufMut) {
    match answer {
        Answer::Accepted => out.put_u8(ACCEPTED),
        Answer::Custody => out.put_u8(CUSTODY),
        Answer::Busy => out.put_u8(BUSY),
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
    }
}

/// Reads an answer. `None` if the bytes are not exactly one answer.
#[must_use]
pub fn read_answer(bytes: &[u8]) -> Option<Answer> {
    match bytes {
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
        [OUT_OF_ORDER, last @ ..] => {
            let last = u64::from_le_bytes(last.try_into().ok()?);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{FailureReason, Kind};

    fn written(answer: &Answer) -> Vec<u8> {
        let mut bytes = Vec::new();
        write_answer(answer, &mut bytes);
        assert_eq!(bytes.len(), answer_len(answer));
        assert!(bytes.len() <= MAX_ANSWER_LEN);
        bytes
    }

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
            assert_eq!(read_answer(&written(&answer)), Some(answer));
        }
    }

    #[test]
    fn a_long_detail_is_cut_at_a_character() {
        let detail = "é".repeat(Answer::MAX_DETAIL);
        let answer = Answer::failed(FailureReason::Refused, detail);
        match read_answer(&written(&answer)) {
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
            assert_eq!(read_answer(wrong), None, "{wrong:?}");
        }
    }
}
