//! The rules of a stream, as pure functions: the delivery core applies them, and the model in
//! `tests/model` explores every order in which they can be applied.
//!
//! A *stream* is one registration of a sender and one registration of a receiver. A letter has one
//! sequence for all its copies. Three roles take part:
//!
//! * The **sender's process** assigns sequences, computes predecessors, moves letters to a new
//!   registration of their receiver, and gives outcomes. No other role does any of these. A letter
//!   is *open* while it has no outcome there.
//! * A **custodian** (a gateway) holds letters in transit, forwards their predecessor as it was
//!   received, and returns a letter when the predecessor does not arrive.
//! * The **receiver's process** takes letters.
//!
//! Consequences: letters are taken in order, and at most once by each registration, on all routes and
//! from all custodians ([`offer`]); no open letter is passed over ([`predecessor`]); a stream never
//! waits for a letter that has an outcome ([`hold`]).

use std::time::Duration;

use fipa_transport::Answer;

/// Decision of the receiver's process about a copy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Offer {
    /// The copy is taken.
    Take,
    /// This sequence number, or a later one, was taken before.
    Earlier,
    /// The predecessor was not taken yet. This attempt certainly did not deliver the letter.
    OutOfOrder,
}

/// Decides about a copy, given the last letter of the stream that was taken (0 if none).
#[must_use]
pub fn offer(last: u64, sequence: u64, after: u64) -> Offer {
    if sequence <= last {
        Offer::Earlier
    } else if after > last {
        Offer::OutOfOrder
    } else {
        Offer::Take
    }
}

/// Returns the predecessor of a letter: the highest lower sequence that is open in its stream, or
/// 0. `open` is in rising order.
#[must_use]
pub fn predecessor(open: impl DoubleEndedIterator<Item = u64>, sequence: u64) -> u64 {
    open.rev().find(|other| *other < sequence).unwrap_or(0)
}

/// Whether the sender's process may dispatch a letter for this registration of its receiver: not
/// while an earlier letter to the same name is open for another registration.
#[must_use]
pub fn may_dispatch<R: PartialEq>(
    mut earlier_open: impl Iterator<Item = R>,
    registration: R,
) -> bool {
    earlier_open.all(|other| other == registration)
}

/// Whether the sender's process may dispatch a letter, given its position among the letters of its lane
/// and that of the first open letter. A receiver remembers this many letters that it has taken. The
/// outcome of a letter that it has forgotten could not be learned.
#[must_use]
pub fn is_remembered(first_open: u64, position: u64, memory: usize) -> bool {
    position.saturating_sub(first_open) < memory as u64
}

/// Whether the sender's process may move a letter to a new registration of its receiver: only
/// when every attempt ended with a certain *not taken*.
#[must_use]
pub fn may_move(uncertain: bool) -> bool {
    !uncertain
}

/// The end of a custody according to a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CustodyReport {
    /// The receiver has it.
    Delivered,
    /// It failed, or was returned; it may have been taken nevertheless if `uncertain`.
    NotDelivered {
        /// Whether any attempt behind the custodian may have delivered it.
        uncertain: bool,
    },
}

/// Effect of a report at the previous hop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Belief {
    /// It ends the custody, or the attempt.
    Believed,
    /// It concerns an earlier hand-over: only the uncertainty is recorded.
    OnlyUncertain,
    /// It changes nothing.
    Ignored,
}

/// Decides about a report of the hand-over `transfer`, when `current` is the latest hand-over of
/// the letter, if one is in progress or in custody. `handed` is whether the letter was ever handed
/// to the reporting service.
#[must_use]
pub fn believe(handed: bool, report: CustodyReport, transfer: u64, current: Option<u64>) -> Belief {
    match report {
        _ if !handed => Belief::Ignored,
        CustodyReport::Delivered => Belief::Believed,
        CustodyReport::NotDelivered { .. } if current == Some(transfer) => Belief::Believed,
        CustodyReport::NotDelivered { uncertain: true } => Belief::OnlyUncertain,
        CustodyReport::NotDelivered { uncertain: false } => Belief::Ignored,
    }
}

/// Returns the predecessor of a held letter of which another copy arrived: the smaller one, because
/// only the sender's process lowers it.
#[must_use]
pub fn lower(held: u64, received: u64) -> u64 {
    held.min(received)
}

/// Whether a custodian whose lane is full takes this letter: only when it holds a higher one, which
/// waits for it.
#[must_use]
pub fn admits_when_full(highest_held: Option<u64>, sequence: u64) -> bool {
    highest_held.is_some_and(|highest| sequence < highest)
}

/// Decision of a custodian about a letter that came back as out of order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum HoldDecision {
    /// The letter waits for its predecessor, which is in the lane.
    ForPredecessor,
    /// The letter waits this long for its predecessor to arrive.
    For(Duration),
    /// The letter is returned.
    Return,
}

/// Decides about a letter that came back as out of order. `missing_for` is the time since its
/// predecessor left the lane or, if it was never in it, since the letter arrived; `timeout` is the
/// maximum time for a predecessor to arrive.
#[must_use]
pub fn hold(predecessor_is_here: bool, missing_for: Duration, timeout: Duration) -> HoldDecision {
    if predecessor_is_here {
        HoldDecision::ForPredecessor
    } else if missing_for < timeout {
        HoldDecision::For(timeout - missing_for)
    } else {
        HoldDecision::Return
    }
}

/// The end of an attempt, or of a custody, of a letter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AttemptEnd {
    /// The letter was certainly not delivered: not sent, busy, out of order, no such agent, moved,
    /// refused, or returned as certain.
    NotTaken,
    /// The letter may have been delivered.
    Unknown,
    /// The custodian was lost with the letter.
    CustodianLost,
}

/// Whether a letter may have been delivered, after another attempt or custody ended. An uncertain
/// letter stays uncertain.
#[must_use]
pub fn stays_uncertain(uncertain: bool, end: AttemptEnd) -> bool {
    uncertain || end != AttemptEnd::NotTaken
}

/// The end of the latest hand-over of a letter that has no outcome yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Cause {
    /// The next service returned it: its predecessor is not there, or that service ends.
    Returned,
    /// The receiver has not taken its predecessor; `last` is the last letter that it took.
    OutOfOrder {
        /// Sequence of that letter.
        last: u64,
    },
    /// The next service has no room.
    Busy,
    /// The receiver's registration has left the host of the next service.
    Moved,
    /// The next service does not know the receiver, which the directory shows.
    NoSuchAgent,
    /// The transport had no room. Nothing has left.
    NoRoom,
    /// Nothing has left, for another reason.
    NotSent,
    /// The connection broke, or no answer came in time.
    Unconfirmed,
    /// The custodian is gone, or denied that it has the letter.
    CustodianLost,
}

impl Cause {
    /// Whether the letter may have left this service.
    #[must_use]
    pub fn has_left(self) -> bool {
        !matches!(self, Self::NoRoom | Self::NotSent)
    }
}

/// The condition under which a letter goes again that came back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Again {
    /// It goes at once, by the next route.
    AtOnce,
    /// Its lane pauses before.
    AfterPause,
    /// Its predecessor has to go first, or to arrive.
    AfterPredecessor,
}

/// Decides when a letter goes again that came back. `sent_after` is the predecessor that the latest
/// copy carried, and `after` the present one, which is never higher.
///
/// A letter that came back because of its predecessor goes at once only if the predecessor was
/// lowered in the meantime. Only the sender's process lowers it, so the next service cannot cause
/// repetitions without a pause.
#[must_use]
pub fn again(cause: Cause, sent_after: u64, after: u64) -> Again {
    match cause {
        Cause::OutOfOrder { last } if (Answer::OutOfOrder { last }).contradicts(sent_after) => {
            Again::AfterPause
        }
        Cause::Returned | Cause::OutOfOrder { .. } if after < sent_after => Again::AtOnce,
        // No letter comes before it, so none can be missing.
        Cause::Returned if sent_after == 0 => Again::AfterPause,
        Cause::Returned | Cause::OutOfOrder { .. } => Again::AfterPredecessor,
        Cause::Busy | Cause::NoSuchAgent | Cause::NoRoom => Again::AfterPause,
        // The directory shows the next registration, or the letter ends.
        Cause::Moved => Again::AtOnce,
        // The lane pauses after the last route.
        Cause::NotSent | Cause::Unconfirmed | Cause::CustodianLost => Again::AtOnce,
    }
}

/// Whether a credit ends the pause of a lane after *busy*: only if a letter of the lane was settled since
/// a credit last did. Otherwise a peer could have a letter repeated by a credit for each *busy*.
#[must_use]
pub fn credit_counts(has_settled: bool) -> bool {
    has_settled
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_letter_is_taken_once_and_after_its_predecessor() {
        assert_eq!(offer(0, 1, 0), Offer::Take);
        assert_eq!(offer(5, 7, 5), Offer::Take);
        assert_eq!(offer(5, 7, 6), Offer::OutOfOrder);
        assert_eq!(offer(7, 7, 0), Offer::Earlier);
        assert_eq!(offer(7, 3, 0), Offer::Earlier);
    }

    #[test]
    fn the_predecessor_is_the_nearest_open_letter_below() {
        let open = [2, 4, 9];
        assert_eq!(predecessor(open.into_iter(), 9), 4);
        assert_eq!(predecessor(open.into_iter(), 5), 4);
        assert_eq!(predecessor(open.into_iter(), 2), 0);
        assert_eq!(predecessor(std::iter::empty(), 2), 0);
    }

    #[test]
    fn reports_count_for_the_hand_over_that_they_name() {
        let failed = |uncertain| CustodyReport::NotDelivered { uncertain };
        // The letter was never handed to this service.
        for report in [CustodyReport::Delivered, failed(true), failed(false)] {
            assert_eq!(believe(false, report, 3, Some(3)), Belief::Ignored);
        }
        // "Delivered" counts for any hand-over.
        assert_eq!(
            believe(true, CustodyReport::Delivered, 1, Some(3)),
            Belief::Believed
        );
        assert_eq!(
            believe(true, CustodyReport::Delivered, 1, None),
            Belief::Believed
        );
        // Other reports count for the latest hand-over only.
        assert_eq!(believe(true, failed(false), 3, Some(3)), Belief::Believed);
        assert_eq!(believe(true, failed(false), 1, Some(3)), Belief::Ignored);
        assert_eq!(
            believe(true, failed(true), 1, Some(3)),
            Belief::OnlyUncertain
        );
        assert_eq!(believe(true, failed(true), 1, None), Belief::OnlyUncertain);
    }

    #[test]
    fn a_full_lane_takes_a_letter_that_a_held_one_waits_for() {
        assert!(admits_when_full(Some(9), 8));
        assert!(!admits_when_full(Some(9), 9));
        assert!(!admits_when_full(None, 1));
    }

    #[test]
    fn only_a_lower_predecessor_sends_a_letter_again_at_once() {
        for cause in [Cause::Returned, Cause::OutOfOrder { last: 2 }] {
            assert_eq!(again(cause, 5, 3), Again::AtOnce, "{cause:?}");
            assert_eq!(again(cause, 5, 5), Again::AfterPredecessor, "{cause:?}");
        }
        assert_eq!(again(Cause::Returned, 0, 0), Again::AfterPause);
    }

    /// [`offer`] never gives such an answer.
    #[test]
    fn an_answer_that_contradicts_the_copy_pauses_the_lane() {
        for (after, last) in [(0, 0), (0, 7), (5, 5), (5, 9)] {
            assert_ne!(offer(last, 10, after), Offer::OutOfOrder);
            assert!(Answer::OutOfOrder { last }.contradicts(after));
            let cause = Cause::OutOfOrder { last };
            assert_eq!(again(cause, after, 0), Again::AfterPause);
        }
        assert_eq!(offer(4, 10, 5), Offer::OutOfOrder);
        assert!(!Answer::OutOfOrder { last: 4 }.contradicts(5));
    }
}
