//! The state of one party of a conversation, its last messages, and the messages that it takes back.

use crate::conversation::ids::Name;
use crate::conversation::state::{AFTER_NOT_UNDERSTOOD, CANCELLED, CANCELLING, FAILED};
use crate::protocol::act::{ActNumber, CANCEL};
use crate::protocol::index::StateId;

/// The state of a conversation with one participant or with all of them. It fits into one cache line: see
/// [`Slot`](crate::conversation::table::Slot).
#[derive(Debug, Clone)]
#[repr(C)]
pub(crate) struct Party {
    /// The participant, if each has a state of its own.
    pub(crate) peer: Option<Name>,
    pub(crate) state: StateId,
    /// During a cancel, or after a failure or a not-understood: the state before it.
    pub(crate) resume: StateId,
    /// The state before the last message.
    pub(crate) before: StateId,
    /// The side that sent the last message.
    pub(crate) last: Side,
    /// The side that canceled.
    pub(crate) canceling_side: Side,
    /// Whether the answer to the cancel may still come, because the message that was taken for it may
    /// have been sent before the cancel arrived. After an `inform`, `resume` is the state after that
    /// message. After a `not-understood`, whether a cancel that crossed it has no answer yet.
    pub(crate) echo: bool,
    /// Performative of the last message of each side.
    pub(crate) acts: [Option<ActNumber>; 2],
    /// Fingerprint of the last `reply-with` of each side; 0 for none.
    pub(crate) asked: [u64; 2],
    /// Deadline of the next message in milliseconds of the monotonic clock; 0 for none.
    pub(crate) deadline: u64,
    /// The last message that has changed the party, and the values before it.
    pub(crate) last_step: Option<LastStep>,
    pub(crate) details: Option<Box<Details>>,
}

/// The last message that has changed a party, and the values before it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LastStep {
    side: Side,
    act: ActNumber,
    state: StateId,
    resume: StateId,
    before: StateId,
    last: Side,
    canceling_side: Side,
    echo: bool,
    /// Performative of the side that sent the message.
    own_act: Option<ActNumber>,
    /// Whether the message is a cancel, which has changed [`Details::cancel`].
    cancels: bool,
    /// Whether it has [`StepValues`].
    has_values: bool,
}

/// The parts of a party that need no memory before the first `reply-with`, deadline or cancel.
#[derive(Debug, Clone, Default)]
pub(crate) struct Details {
    /// [`short`] fingerprints of the `reply-with` values of each side before the last one, the latest
    /// first; 0 for none.
    pub(crate) earlier: [[u32; EARLIER]; 2],
    /// Text of the last `reply-with` of each side.
    pub(crate) asked_text: [Tail; 2],
    /// Fingerprint of the `reply-with` of the cancel.
    cancel: u64,
    step: StepValues,
    /// After a message that was not delivered, or of which that is uncertain.
    worlds: Option<Box<Worlds>>,
}

/// Values of the last message of a party, and those before it.
#[derive(Debug, Clone, Copy, Default)]
struct StepValues {
    reply_with: u64,
    /// The `reply-with` of the same side before it.
    own_asked: u64,
    /// The `reply-with` that the message has displaced from [`Details::earlier`], if it has.
    displaced: u32,
    deadline: u64,
    cancel: u64,
}

impl Details {
    /// Bytes of the details and of what they have allocated.
    fn allocated(&self) -> usize {
        let worlds = self.worlds.as_deref();
        size_of::<Self>()
            + worlds.map_or(0, |Worlds { missing, arrived }| {
                size_of::<Worlds>() + missing.allocated() + arrived.allocated()
            })
    }
}

/// The party if a message that was reported as failed has not arrived, and if it has arrived. The next
/// message shows which is true.
#[derive(Debug, Clone)]
pub(crate) struct Worlds {
    pub(crate) missing: Party,
    pub(crate) arrived: Party,
}

/// One of two [`Worlds`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum World {
    Missing,
    Arrived,
}

impl Party {
    pub(crate) fn new(peer: Option<Name>, state: StateId) -> Self {
        Self {
            peer,
            state,
            resume: state,
            before: state,
            last: Side::Other,
            canceling_side: Side::Initiator,
            echo: false,
            acts: [None; 2],
            asked: [0; 2],
            deadline: 0,
            last_step: None,
            details: None,
        }
    }

    pub(crate) fn details(&mut self) -> &mut Details {
        self.details.get_or_insert_default()
    }

    /// Fingerprint of the `reply-with` of the cancel; 0 for none.
    pub(crate) fn cancel(&self) -> u64 {
        self.details.as_deref().map_or(0, |details| details.cancel)
    }

    pub(crate) fn set_cancel(&mut self, reply_with: u64) {
        if self.cancel() != reply_with {
            self.details().cancel = reply_with;
        }
    }

    /// Values of [`Details::earlier`] of a side.
    pub(crate) fn earlier(&self, side: usize) -> &[u32; EARLIER] {
        let details = self.details.as_deref();
        details.map_or(&[0; EARLIER], |details| &details.earlier[side])
    }

    /// Text of the last `reply-with` of a side.
    pub(crate) fn asked_text(&self, side: usize) -> &str {
        let details = self.details.as_deref();
        details.map_or("", |details| details.asked_text[side].text())
    }

    pub(crate) fn worlds(&self) -> Option<&Worlds> {
        self.details.as_deref()?.worlds.as_deref()
    }

    /// Bytes that the party has allocated.
    #[inline]
    pub(crate) fn allocated(&self) -> usize {
        self.details.as_deref().map_or(0, Details::allocated)
    }

    /// Records the message that is about to change the party, and whether it is a cancel.
    pub(crate) fn begin_step(
        &mut self,
        side: Side,
        act: ActNumber,
        reply_with: u64,
        cancels: bool,
    ) {
        let index = side_index(side);
        let (own_asked, deadline) = (self.asked[index], self.deadline);
        let has_values = cancels || [reply_with, own_asked, deadline] != [0; 3];
        if has_values {
            self.keep_values(index, reply_with);
        }
        self.last_step = Some(LastStep {
            side,
            act,
            state: self.state,
            resume: self.resume,
            before: self.before,
            last: self.last,
            canceling_side: self.canceling_side,
            echo: self.echo,
            own_act: self.acts[index],
            cancels,
            has_values,
        });
    }

    fn keep_values(&mut self, index: usize, reply_with: u64) {
        let (own_asked, deadline) = (self.asked[index], self.deadline);
        let details = self.details();
        details.step = StepValues {
            reply_with,
            own_asked,
            displaced: details.earlier[index][EARLIER - 1],
            deadline,
            cancel: details.cancel,
        };
    }

    /// Values of the last message.
    fn step_values(&self) -> StepValues {
        let has_values = self.last_step.is_some_and(|step| step.has_values);
        let details = self.details.as_deref().filter(|_| has_values);
        details.map_or_else(StepValues::default, |details| details.step)
    }

    /// Decides that a message which was reported as failed has arrived, or has not.
    pub(crate) fn settle(&mut self, world: World) {
        let details = self.details.as_deref_mut();
        if let Some(worlds) = details.and_then(|details| details.worlds.take()) {
            let Worlds { missing, arrived } = *worlds;
            let peer = self.peer;
            *self = match world {
                World::Missing => missing,
                World::Arrived => arrived,
            };
            self.peer = peer;
        }
    }

    /// Takes a message back, because it was not delivered, or because that is uncertain. Returns whether
    /// the message is the last one.
    pub(crate) fn take_back(&mut self, side: Side, act: ActNumber, reply_with: u64) -> bool {
        let values = self.step_values();
        let is_it = |step: &LastStep| {
            step.side == side && step.act == act && values.reply_with == reply_with
        };
        let cancels = act == ActNumber::of(CANCEL);
        let Some(step) = self.last_step.filter(is_it) else {
            // A message of the other side may have crossed the cancel, or was taken for its answer.
            if cancels
                && (self.state == CANCELLING || self.state == CANCELLED && self.echo)
                && self.canceling_side == side
                && self.cancel() == reply_with
            {
                (self.state, self.echo) = (self.resume, false);
                return true;
            }
            return false;
        };
        self.revert(step);
        true
    }

    /// Whether the last message may be of this side: it sent the last one, or the last one that crossed no
    /// cancel.
    pub(crate) fn may_have_last(&self, side: Side) -> bool {
        self.last == side || self.last_step.is_some_and(|step| step.side == side)
    }

    /// An upper bound of the bytes that [`take_back_last`](Self::take_back_last) allocates.
    pub(crate) const GROWTH_BY_REPORT: usize = size_of::<Worlds>() + 3 * size_of::<Details>();

    /// Takes the last message of a side back, because a message transport service has reported that it was
    /// not delivered. Returns whether it is the last one of the party.
    pub(crate) fn take_back_last(&mut self, side: Side) -> bool {
        let step = self.last_step.filter(|step| step.side == side);
        if let Some(step) = step {
            self.revert(step);
        }
        step.is_some()
    }

    /// Restores the values before the last message. If it may have arrived, the next message shows whether
    /// it has.
    fn revert(&mut self, step: LastStep) {
        let values = self.step_values();
        self.last_step = None;
        let arrived = self.clone();
        let index = side_index(step.side);
        (self.state, self.resume, self.before) = (step.state, step.resume, step.before);
        (self.last, self.canceling_side, self.echo) = (step.last, step.canceling_side, step.echo);
        self.deadline = values.deadline;
        if step.cancels {
            self.set_cancel(values.cancel);
        }
        self.acts[index] = step.own_act;
        if self.asked[index] != values.own_asked {
            self.asked[index] = values.own_asked;
            let details = self.details();
            // The text is for descriptions only.
            details.asked_text[index] = Tail::default();
            if values.own_asked != 0 {
                details.earlier[index].rotate_left(1);
                details.earlier[index][EARLIER - 1] = values.displaced;
            }
        }
        // Nothing follows the other messages, if they have arrived.
        if ![AFTER_NOT_UNDERSTOOD, CANCELLED].contains(&arrived.state) {
            let missing = self.clone();
            (self.state, self.resume, self.before) = (FAILED, arrived.state, missing.state);
            self.details().worlds = Some(Box::new(Worlds { missing, arrived }));
        }
    }

    /// Whether no message was sent yet.
    pub(crate) fn is_fresh(&self) -> bool {
        self.acts == [None; 2]
    }

    /// Records the `reply-with` of a message, of which `text` is the text.
    #[inline]
    pub(crate) fn ask(&mut self, side: Side, reply_with: u64, text: &str) {
        let before = std::mem::replace(&mut self.asked[side_index(side)], reply_with);
        if before != 0 || reply_with != 0 {
            self.keep_asked(side, before, text);
        }
    }

    fn keep_asked(&mut self, side: Side, before: u64, text: &str) {
        let index = side_index(side);
        let details = self.details();
        if before != 0 {
            details.earlier[index].rotate_right(1);
            details.earlier[index][0] = short(before);
        }
        details.asked_text[index] = Tail::of(text);
    }
}

/// Number of messages before the last one that an answer may belong to. Messages that cross on slow
/// routes answer an earlier one.
pub(crate) const EARLIER: usize = 6;

/// Shortens a fingerprint other than 0 to another one that is not 0.
pub(crate) fn short(fingerprint: u64) -> u32 {
    let folded = fingerprint ^ (fingerprint >> 32);
    u32::try_from(folded & u64::from(u32::MAX))
        .unwrap_or(1)
        .max(1)
}

/// The last bytes of a text, for descriptions.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Tail {
    len: u8,
    bytes: [u8; Self::MAX],
}

impl Tail {
    const MAX: usize = 32;

    pub(crate) fn of(text: &str) -> Self {
        let mut from = text.len().saturating_sub(Self::MAX);
        while !text.is_char_boundary(from) {
            from += 1;
        }
        let mut tail = Self::default();
        let last_bytes = text.as_bytes().get(from..).unwrap_or_default();
        for (to, byte) in tail.bytes.iter_mut().zip(last_bytes) {
            *to = *byte;
        }
        tail.len = u8::try_from(last_bytes.len()).unwrap_or(0);
        tail
    }

    pub(crate) fn text(&self) -> &str {
        let last_bytes = self.bytes.get(..usize::from(self.len));
        std::str::from_utf8(last_bytes.unwrap_or_default()).unwrap_or_default()
    }
}

/// The side that sends a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    Initiator,
    Other,
}

impl Side {
    pub(crate) fn opposite(self) -> Self {
        match self {
            Self::Initiator => Self::Other,
            Self::Other => Self::Initiator,
        }
    }
}

pub(crate) fn side_index(side: Side) -> usize {
    match side {
        Side::Initiator => 0,
        Side::Other => 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tail_of_a_text_has_whole_characters() {
        assert_eq!(Tail::of("").text(), "");
        assert_eq!(Tail::of("rover--1").text(), "rover--1");
        let long = "x".repeat(40);
        assert_eq!(Tail::of(&long).text(), &long[8..]);
        let wide = "ä".repeat(17);
        assert_eq!(
            Tail::of(&format!("{wide}b")).text(),
            format!("{}b", "ä".repeat(15))
        );
    }

    #[test]
    fn a_shortened_fingerprint_depends_on_all_bits() {
        let fingerprint = 0x0123_4567_89ab_cdef;
        for bit in 0..64 {
            assert_ne!(short(fingerprint ^ (1 << bit)), short(fingerprint), "{bit}");
        }
        // 0 stands for none.
        assert_ne!(short(0x0000_0001_0000_0001), 0);
    }

    #[test]
    fn a_message_that_is_taken_back_leaves_those_before_it() {
        // Up to more than there are earlier ones.
        for count in 0..=8 {
            let mut party = Party::new(None, StateId::FIRST);
            for asked in 1..=count {
                party.ask(Side::Initiator, asked, "");
            }
            let before = (party.asked, *party.earlier(0));
            party.begin_step(Side::Initiator, ActNumber::of(CANCEL), 99, false);
            party.ask(Side::Initiator, 99, "");
            assert_ne!((party.asked, *party.earlier(0)), before, "{count}");
            assert!(party.take_back(Side::Initiator, ActNumber::of(CANCEL), 99));
            party.settle(World::Missing);
            assert_eq!((party.asked, *party.earlier(0)), before, "{count}");
        }
    }
}
