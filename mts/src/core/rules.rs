//! The rules of a stream, as pure functions: the delivery core decides by them, and the model in
//! `tests/model` explores every order in which they can be applied.
//!
//! A *stream* is one registration of a sender and one registration of a receiver. A letter has one
//! sequence for all its copies. Three roles take part:
//!
//! * The **sender's process** assigns sequences, computes predecessors, moves letters to a new
//!   registration of their receiver, and gives outcomes. No other role does any of these. A letter
//!   is *open* while it has no outcome there.
//! * A **custodian** (a gateway) holds letters on their way, passes their predecessor on as it was
//!   told, and hands a letter back when the predecessor does not come.
//! * The **receiver's process** takes letters.
//!
//! What follows from them: letters are taken in order, and at most once by each registration,
//! whatever routes and custodians do ([`offer`]); no letter that is still open is passed over
//! ([`predecessor`]); a stream never waits for a letter that has an outcome ([`hold`]).

use std::time::Duration;

/// What the receiver's process says of a copy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Offer {
    /// It is taken.
    Take,
    /// This sequence, or a later one, was taken before.
    Earlier,
    /// The predecessor was not taken yet. Certainly not taken by this attempt.
    OutOfOrder,
}

/// Decides about a copy, by the last letter of the stream that was taken (0 when there is none).
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

/// Whether the sender's process may dispatch a letter for this registration of its receiver:
/// not while an earlier letter to the same name is open for another registration.
#[must_use]
pub fn may_dispatch<R: PartialEq>(
    mut earlier_open: impl Iterator<Item = R>,
    registration: R,
) -> bool {
    earlier_open.all(|other| other == registration)
}

/// Whether the sender's process may move a letter to a new registration of its receiver: only
/// when every attempt ended with a certain *not taken*.
#[must_use]
pub fn may_move(uncertain: bool) -> bool {
    !uncertain
}

/// The end of a custody, as far as belief in it goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Told {
    /// The receiver has it.
    Delivered,
    /// It failed, or was returned; it may have been taken nevertheless if `uncertain`.
    NotDelivered {
        /// Whether any attempt behind the custodian may have delivered it.
        uncertain: bool,
    },
}

/// What the previous hop makes of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Belief {
    /// It ends the custody, or the attempt.
    Believed,
    /// It is about an earlier hand-over: only the uncertainty is kept.
    OnlyUncertain,
    /// It changes nothing.
    Ignored,
}

/// Decides about a report of the hand-over `transfer`, when `current` is the latest hand-over of
/// the letter, if one is under way or in custody. `handed` is whether the letter was ever handed
/// to the service that reports.
#[must_use]
pub fn believe(handed: bool, told: Told, transfer: u64, current: Option<u64>) -> Belief {
    match told {
        _ if !handed => Belief::Ignored,
        Told::Delivered => Belief::Believed,
        Told::NotDelivered { .. } if current == Some(transfer) => Belief::Believed,
        Told::NotDelivered { uncertain: true } => Belief::OnlyUncertain,
        Told::NotDelivered { uncertain: false } => Belief::Ignored,
    }
}

/// Returns the predecessor of a held letter of which another copy arrived: the smaller one, since
/// only the sender's process lowers it.
#[must_use]
pub fn lower(held: u64, told: u64) -> u64 {
    held.min(told)
}

/// Whether a custodian whose lane is full takes this letter: only when it holds a higher one,
/// because that one waits for it.
#[must_use]
pub fn admits_when_full(highest_held: Option<u64>, sequence: u64) -> bool {
    highest_held.is_some_and(|highest| sequence < highest)
}

/// What a custodian does with a letter that came back as out of order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Hold {
    /// The predecessor is here: the letter waits for it.
    ForPredecessor,
    /// The predecessor may still arrive: the letter waits for this long.
    For(Duration),
    /// The letter is handed back.
    Return,
}

/// Decides about a letter that came back as out of order. `missing_for` is the time since its
/// predecessor left the lane or, when it was never here, since the letter arrived; `patience` is
/// how long a predecessor may take to arrive.
#[must_use]
pub fn hold(predecessor_is_here: bool, missing_for: Duration, patience: Duration) -> Hold {
    if predecessor_is_here {
        Hold::ForPredecessor
    } else if missing_for < patience {
        Hold::For(patience - missing_for)
    } else {
        Hold::Return
    }
}

/// The end of an attempt, or of a custody, of a letter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum End {
    /// It certainly did not deliver the letter: not sent, busy, out of order, no such agent, moved,
    /// refused, or handed back as certain.
    NotTaken,
    /// It may have delivered the letter.
    Unknown,
    /// The custodian was lost with the letter.
    CustodianLost,
}

/// Whether a letter may have been delivered, after one more attempt or custody of it ended. Once
/// uncertain, it stays so.
#[must_use]
pub fn stays_uncertain(uncertain: bool, end: End) -> bool {
    uncertain || end != End::NotTaken
}

/// Whether a custodian dispatches a letter again that came back as out of order: its predecessor
/// was lowered meanwhile, to one that the receiver has taken. `last` is the last letter that the
/// receiver had taken, or 0 when the answer does not say.
#[must_use]
pub fn goes_again(after: u64, last: u64) -> bool {
    after <= last
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
    fn reports_are_believed_as_far_as_the_hand_over_reaches() {
        let failed = |uncertain| Told::NotDelivered { uncertain };
        // A service that the letter was never handed to.
        for told in [Told::Delivered, failed(true), failed(false)] {
            assert_eq!(believe(false, told, 3, Some(3)), Belief::Ignored);
        }
        // Delivered, whatever hand-over it names.
        assert_eq!(believe(true, Told::Delivered, 1, Some(3)), Belief::Believed);
        assert_eq!(believe(true, Told::Delivered, 1, None), Belief::Believed);
        // Anything else for the latest hand-over only.
        assert_eq!(believe(true, failed(false), 3, Some(3)), Belief::Believed);
        assert_eq!(believe(true, failed(false), 1, Some(3)), Belief::Ignored);
        assert_eq!(
            believe(true, failed(true), 1, Some(3)),
            Belief::OnlyUncertain
        );
        assert_eq!(believe(true, failed(true), 1, None), Belief::OnlyUncertain);
    }

    #[test]
    fn a_full_lane_takes_what_a_held_letter_waits_for() {
        assert!(admits_when_full(Some(9), 8));
        assert!(!admits_when_full(Some(9), 9));
        assert!(!admits_when_full(None, 1));
    }
}
