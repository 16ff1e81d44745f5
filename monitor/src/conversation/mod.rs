//! The state of one conversation, and the state transitions of its parties.
//!
//! With [`Scope::Participant`], each participant has a [`Party`] with a state of its own. With
//! [`Scope::Conversation`], there is one party without a participant, and a list of role bindings.

pub(crate) mod deadlines;
pub(crate) mod fingerprints;
mod index;
pub(crate) mod memory;
pub(crate) mod names;
mod parties;
pub(crate) mod table;

use std::ops::{Deref, Range};

use fipa_acl::Performative;
use hashbrown::HashTable;
use smallvec::SmallVec;

use crate::conversation::names::{Name, Names};
use crate::conversation::parties::Parties;
use crate::conversation::table::spread;
use crate::limits::MAX_DESIGNATED;
use crate::protocol::act::{Act, CANCEL, FAILURE, INFORM, NOT_UNDERSTOOD};
use crate::protocol::machine::{Cancel, Guard, Machine, Roles, Scope, State, Transition, step};
use crate::protocol::projection::LocalRun;
use crate::verdict::ViolationKind as Kind;

/// The absence of a name or an index.
pub(crate) const NONE: u32 = u32::MAX;

/// State of every protocol after `not-understood`.
pub(crate) const AFTER_NOT_UNDERSTOOD: u16 = u16::MAX;
/// State of every protocol after `cancel`, before the answer to it.
pub(crate) const CANCELLING: u16 = u16::MAX - 1;
/// State of every protocol after the answer `inform` to a `cancel`.
pub(crate) const CANCELLED: u16 = u16::MAX - 2;
/// State of every protocol after the message transport service reported a failure.
pub(crate) const FAILED: u16 = u16::MAX - 3;
/// State that the monitor does not know: see [`crate::check::delegated`].
pub(crate) const ELSEWHERE: u16 = u16::MAX - 4;

/// Returns the name of a state.
pub(crate) fn state_name(machine: &Machine, state: u16) -> &str {
    match state {
        AFTER_NOT_UNDERSTOOD => "not-understood",
        CANCELLING => "cancelling",
        CANCELLED => "cancelled",
        FAILED => "undelivered",
        ELSEWHERE => "elsewhere",
        own => machine.state(own).map_or("", |state| state.id()),
    }
}

pub(crate) fn is_final(machine: &Machine, state: u16) -> bool {
    match state {
        AFTER_NOT_UNDERSTOOD | CANCELLED | FAILED => true,
        CANCELLING => false,
        own => machine.state(own).is_some_and(|state| state.is_final()),
    }
}

/// Whether no further message can follow.
pub(crate) fn is_over(machine: &Machine, state: u16) -> bool {
    match state {
        AFTER_NOT_UNDERSTOOD | CANCELLED | FAILED => true,
        CANCELLING => false,
        own => machine.state(own).is_some_and(|state| state.is_over()),
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

/// The state of a conversation with one participant or with all of them. It fits into one cache line: see
/// [`Slot`](crate::conversation::table::Slot).
#[derive(Debug, Clone)]
#[repr(C)]
pub(crate) struct Party {
    /// The participant, or [`NONE`].
    pub(crate) peer: Name,
    pub(crate) state: u16,
    /// During a cancel, or after a failure or a not-understood: the state before it.
    pub(crate) resume: u16,
    /// The state before the last message.
    pub(crate) before: u16,
    /// The side that sent the last message.
    pub(crate) last: Side,
    /// The side that canceled.
    pub(crate) canceling_side: Side,
    /// Whether the answer to the cancel may still come, because the message that was taken for it may
    /// have been sent before the cancel arrived. After an `inform`, `resume` is the state after that
    /// message.
    pub(crate) echo: bool,
    /// [`act_number`] of the last message of each side; 0 for none.
    pub(crate) acts: [u8; 2],
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
    /// [`act_number`] of the message.
    act: u8,
    state: u16,
    resume: u16,
    before: u16,
    last: Side,
    canceling_side: Side,
    echo: bool,
    /// Performative of the side that sent the message.
    own_act: u8,
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
    missing: Party,
    arrived: Party,
}

/// One of two [`Worlds`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum World {
    Missing,
    Arrived,
}

impl Party {
    pub(crate) fn new(peer: Name, state: u16) -> Self {
        Self {
            peer,
            state,
            resume: state,
            before: state,
            last: Side::Other,
            canceling_side: Side::Initiator,
            echo: false,
            acts: [0; 2],
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
    pub(crate) fn begin_step(&mut self, side: Side, act: u8, reply_with: u64, cancels: bool) {
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
    pub(crate) fn take_back(&mut self, side: Side, act: u8, reply_with: u64) -> bool {
        let values = self.step_values();
        let is_it = |step: &LastStep| {
            step.side == side && step.act == act && values.reply_with == reply_with
        };
        let cancels = act == act_number(CANCEL);
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
    fn is_fresh(&self) -> bool {
        self.acts == [0; 2]
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
fn short(fingerprint: u64) -> u32 {
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
        let kept = text.as_bytes().get(from..).unwrap_or_default();
        for (to, byte) in tail.bytes.iter_mut().zip(kept) {
            *to = *byte;
        }
        tail.len = u8::try_from(kept.len()).unwrap_or(0);
        tail
    }

    pub(crate) fn text(&self) -> &str {
        let kept = self.bytes.get(..usize::from(self.len));
        std::str::from_utf8(kept.unwrap_or_default()).unwrap_or_default()
    }
}

/// A role and the agent that has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RoleBinding {
    pub(crate) role: u8,
    pub(crate) agent: Name,
}

/// The roles of agents. Most conversations have one state for each participant, and no roles.
#[derive(Debug, Default)]
pub(crate) struct Bound {
    bindings: Option<Box<SmallVec<[RoleBinding; 2]>>>,
}

impl Bound {
    pub(crate) fn push(&mut self, binding: RoleBinding) {
        self.bindings.get_or_insert_default().push(binding);
    }

    /// Removes these bindings and returns them.
    pub(crate) fn remove(&mut self, range: Range<usize>) -> SmallVec<[RoleBinding; 2]> {
        let bindings = self.bindings.as_deref_mut();
        let removed = bindings.map(|bindings| bindings.drain(range).collect());
        removed.unwrap_or_default()
    }

    /// Returns an upper bound of the bytes that so many more bindings allocate.
    fn growth(&self, added: usize) -> usize {
        match added {
            0 => 0,
            _ => {
                let buffer = (self.len() + added).next_power_of_two();
                buffer * size_of::<RoleBinding>() + size_of::<SmallVec<[RoleBinding; 2]>>()
            }
        }
    }

    /// Bytes that the bindings have allocated.
    #[inline]
    fn allocated(&self) -> usize {
        self.bindings.as_deref().map_or(0, |bindings| {
            let spilled = match bindings.spilled() {
                true => bindings.capacity() * size_of::<RoleBinding>(),
                false => 0,
            };
            size_of::<SmallVec<[RoleBinding; 2]>>() + spilled
        })
    }
}

impl Deref for Bound {
    type Target = [RoleBinding];

    fn deref(&self) -> &[RoleBinding] {
        self.bindings.as_deref().map_or(&[], |bindings| bindings)
    }
}

/// The order of the fields is that of the memory: see [`Slot`](crate::conversation::table::Slot).
#[derive(Debug)]
#[repr(C)]
pub(crate) struct Conversation {
    /// Index into the library.
    pub(crate) machine: u16,
    /// Whether the conversation began between other agents, and the monitored agent joined it because
    /// a `reply-to` names it. It then has the place of the initiator.
    pub(crate) joined: bool,
    pub(crate) initiator: Name,
    /// Bytes that the texts of the conversation are charged with: its identifier and its names.
    charged_texts: u32,
    /// Bytes with which the peer is charged.
    pub(crate) cost: u32,
    pub(crate) rare: Option<Box<Rare>>,
    pub(crate) bound: Bound,
    pub(crate) parties: Parties,
}

/// The parts of a conversation that most conversations do not have.
#[derive(Debug, Default)]
pub(crate) struct Rare {
    /// Agents that receive replies instead of the initiator, and may continue in its place.
    pub(crate) reply_to: Vec<Name>,
    /// State of the members of a multicast. Their names are unknown until they answer.
    pub(crate) unnamed: Option<Box<Party>>,
    /// Agents that receive messages instead of a participant, and may continue in its place: the index
    /// of the party and the agent.
    pub(crate) delegates: Vec<(u32, Name)>,
    /// Whether the conversation may have begun before the monitor.
    pub(crate) may_continue: bool,
    /// If it may, other states to which the first message to a party may have led: the index of the
    /// party, or [`NONE`] for the members of a multicast, and the state. [`FAILED`] stands for any
    /// state: a message to the party was not delivered.
    pub(crate) alternatives: Vec<(u32, u16)>,
    /// The conversation as the role of the monitored agent sees it.
    pub(crate) local: Option<LocalRun>,
    /// Whether an agent has a role in it that the monitored agent knows only from a message of that agent.
    pub(crate) claimed: bool,
    /// Whether the state is uncertain, because an agent that may have claimed its role wrongly has ended the
    /// conversation, or because another agent may have that role.
    pub(crate) contested: bool,
    /// Roles that the monitored agent may have, because the message that excludes them may be of an outsider.
    pub(crate) uncertain_roles: u32,
    /// Whether the last message of the monitored agent was reported as undelivered.
    pub(crate) undelivered: bool,
    /// Whether only a message of an agent that claimed a role has shown that such a message arrived.
    pub(crate) uncertain: bool,
    /// The last message of the monitored agent in it, until it is known to have arrived.
    pub(crate) last_sent: Option<LastSent>,
    /// The roles that the receivers of that message got with it, after it was reported as undelivered. It
    /// may have arrived, so only these agents can answer it.
    pub(crate) asked: SmallVec<[RoleBinding; 2]>,
    /// The last messages of which an observer gets each copy by itself.
    pub(crate) copied: Vec<Copied>,
    /// The parties by their peers, if there are more than [`FEW`].
    index: HashTable<(Name, u32)>,
}

impl Rare {
    /// Bytes of these parts, and those that they have allocated.
    fn allocated(&self) -> usize {
        let unnamed = self.unnamed.as_deref();
        let copies = self.copied.iter();
        size_of::<Self>()
            + self.reply_to.capacity() * size_of::<Name>()
            + unnamed.map_or(0, |party| size_of::<Party>() + party.allocated())
            + self.delegates.capacity() * size_of::<(u32, Name)>()
            + self.alternatives.capacity() * size_of::<(u32, u16)>()
            + self.copied.capacity() * size_of::<Copied>()
            + copies
                .map(|copied| 8 * copied.seen.capacity())
                .sum::<usize>()
            + match self.asked.spilled() {
                true => self.asked.capacity() * size_of::<RoleBinding>(),
                false => 0,
            }
            + self.index.allocation_size()
            + self.local.as_ref().map_or(0, LocalRun::allocated)
    }
}

/// The last message of the monitored agent in a conversation that its role sees.
#[derive(Debug)]
pub(crate) struct LastSent {
    /// [`act_number`] of the message.
    pub(crate) act: u8,
    pub(crate) reply_with: u64,
    /// The state before it.
    pub(crate) state: u16,
    /// Whether it is a `not-understood`, which the role does not see.
    pub(crate) ends: bool,
    /// Number of the role bindings before it.
    pub(crate) bound: usize,
    /// Number of the role bindings after it.
    pub(crate) bound_after: usize,
}

/// A message of which an observer gets each copy by itself.
#[derive(Debug)]
pub(crate) struct Copied {
    pub(crate) fingerprint: u64,
    /// Fingerprints of the receivers of the copies.
    pub(crate) seen: Vec<u64>,
    /// Roles of the sender and the receivers.
    pub(crate) roles: (u32, u32),
}

impl Copied {
    /// Maximum number of messages whose copies may mix.
    pub(crate) const MAX: usize = 4;
}

/// Number of parties that are searched one by one.
const FEW: usize = 8;

impl Conversation {
    /// A conversation without agents, as an unused slot has it.
    pub(crate) fn unused() -> Self {
        Self {
            machine: 0,
            joined: false,
            initiator: NONE,
            charged_texts: 0,
            cost: 0,
            rare: None,
            bound: Bound::default(),
            parties: Parties::default(),
        }
    }

    /// Removes all but a buffer for the next conversation.
    pub(crate) fn clear(&mut self) {
        let mut parties = std::mem::take(&mut self.parties);
        parties.clear();
        *self = Self {
            parties,
            ..Self::unused()
        };
    }

    /// Adds to the bytes of the texts.
    pub(crate) fn charge(&mut self, bytes: usize) {
        let bytes = u32::try_from(bytes).unwrap_or(u32::MAX);
        self.charged_texts = self.charged_texts.saturating_add(bytes);
    }

    /// Subtracts from the bytes of the texts.
    pub(crate) fn discharge(&mut self, bytes: usize) {
        let bytes = u32::try_from(bytes).unwrap_or(u32::MAX);
        self.charged_texts = self.charged_texts.saturating_sub(bytes);
    }

    /// Bytes that the conversation has allocated.
    #[inline]
    pub(crate) fn allocated(&self) -> usize {
        let rare = self.rare.as_deref().map_or(0, Rare::allocated);
        let texts = usize::try_from(self.charged_texts).unwrap_or(usize::MAX);
        self.parties.allocated() + self.bound.allocated() + rare + texts
    }

    /// Returns an upper bound of the bytes that so many more parties, role bindings and agents in `reply-to`
    /// allocate, without their names.
    pub(crate) fn growth(&self, parties: usize, bindings: usize, designated: usize) -> usize {
        if [parties, bindings, designated] == [0; 3] {
            return 0;
        }
        let rare = match &self.rare {
            Some(_) => 0,
            None => size_of::<Rare>(),
        };
        let count = self.parties.len() + parties;
        let index = match parties {
            0 => 0,
            _ if count <= FEW => 0,
            // A table has a byte more for each place, is at most seven eighths full, and ends with a group.
            _ => (count * 8 / 7).next_power_of_two() * (size_of::<(Name, u32)>() + 1) + 16,
        };
        let designated = match designated {
            0 => 0,
            _ => MAX_DESIGNATED * size_of::<(u32, Name)>(),
        };
        self.parties.growth(parties) + self.bound.growth(bindings) + rare + index + designated
    }

    /// Takes a reference to a name for this conversation.
    pub(crate) fn acquire(&mut self, names: &mut Names, text: &str) -> Name {
        self.charge(Names::cost(text.len()));
        names.acquire(text)
    }

    /// Releases the names of [`Rare::asked`], of the roles for which `is_known` holds.
    pub(crate) fn release_asked(&mut self, names: &mut Names, is_known: impl Fn(u8) -> bool) {
        let Some(rare) = self.rare.as_deref_mut() else {
            return;
        };
        let (known, others) = rare.asked.drain(..).partition(|asked| is_known(asked.role));
        rare.asked = others;
        let known: SmallVec<[RoleBinding; 2]> = known;
        for RoleBinding { agent, .. } in known {
            self.discharge(Names::cost(names.text(agent).len()));
            names.release(agent);
        }
    }

    /// Whether it is checked as the role of the monitored agent sees it.
    pub(crate) fn is_local(&self) -> bool {
        self.rare
            .as_deref()
            .is_some_and(|rare| rare.local.is_some())
    }

    pub(crate) fn rare(&mut self) -> &mut Rare {
        self.rare.get_or_insert_default()
    }

    /// Adds a party. Returns its index.
    pub(crate) fn add(&mut self, party: Party) -> usize {
        self.parties.push(party);
        let count = self.parties.len();
        // The index is made when there are many parties, and kept from then on.
        if count == FEW + 1 {
            for at in 0..count {
                self.index(at);
            }
        } else if count > FEW {
            self.index(count - 1);
        }
        count - 1
    }

    fn index(&mut self, at: usize) {
        let Some(peer) = self.parties.get(at).map(|party| party.peer) else {
            return;
        };
        let entry = (peer, u32::try_from(at).unwrap_or(NONE));
        let index = &mut self.rare().index;
        index.insert_unique(spread(peer), entry, |(peer, _)| spread(*peer));
    }

    /// Finds the party of an agent: a participant, or an agent that continues in its place.
    #[inline]
    pub(crate) fn party(&self, names: &Names, agent: &str) -> Option<(usize, &Party)> {
        match &self.parties {
            Parties::One(only) if names.is(only.peer, agent) => Some((0, only)),
            _ => self.other_party(names, agent),
        }
    }

    fn other_party(&self, names: &Names, agent: &str) -> Option<(usize, &Party)> {
        let found = match &self.parties {
            Parties::None(_) | Parties::One(_) => None,
            Parties::Many(parties) if parties.len() <= FEW => {
                let mut parties = parties.iter();
                parties.position(|party| names.is(party.peer, agent))
            }
            Parties::Many(_) => self.indexed(names, agent),
        };
        let found = found.or_else(|| self.delegating(names, agent))?;
        self.parties.get(found).map(|party| (found, party))
    }

    /// Finds a participant among many.
    fn indexed(&self, names: &Names, agent: &str) -> Option<usize> {
        let index = &self.rare.as_deref()?.index;
        let peer = names.known(agent)?;
        let (_, at) = index.find(spread(peer), |(known, _)| *known == peer)?;
        usize::try_from(*at).ok()
    }

    /// Finds the participant in whose place an agent continues.
    fn delegating(&self, names: &Names, agent: &str) -> Option<usize> {
        let mut delegates = self.delegates().iter();
        let (at, _) = delegates.find(|(_, delegate)| names.is(*delegate, agent))?;
        usize::try_from(*at).ok()
    }

    pub(crate) fn delegates(&self) -> &[(u32, Name)] {
        let rare = self.rare.as_deref();
        rare.map_or(&[], |rare| &rare.delegates)
    }

    pub(crate) fn reply_to(&self) -> &[Name] {
        let rare = self.rare.as_deref();
        rare.map_or(&[], |rare| &rare.reply_to)
    }

    pub(crate) fn unnamed(&self) -> Option<&Party> {
        self.rare.as_deref()?.unnamed.as_deref()
    }

    /// Whether the agent has sent or received a message of this conversation, or may.
    pub(crate) fn takes_part(&self, names: &Names, agent: &str) -> bool {
        let bound = self.bound.iter().map(|bound| bound.agent);
        let mut known = bound.chain([self.initiator]);
        self.party(names, agent).is_some() || known.any(|name| names.is(name, agent))
    }

    /// Whether a `reply-to` names the agent instead of the initiator.
    pub(crate) fn is_designated(&self, names: &Names, agent: &str) -> bool {
        self.reply_to().iter().any(|name| names.is(*name, agent))
    }

    /// With one state for all participants: whether the agent is the initiator, or continues in its
    /// place without a role of its own.
    pub(crate) fn speaks_for_initiator(&self, names: &Names, agent: &str) -> bool {
        let has_part = || self.bound.iter().any(|bound| names.is(bound.agent, agent));
        names.is(self.initiator, agent) || self.is_designated(names, agent) && !has_part()
    }
}

/// The roles of agents in a conversation, with respect to one party.
pub(crate) struct Holders<'a> {
    pub(crate) conversation: &'a Conversation,
    pub(crate) machine: &'a Machine,
    pub(crate) party: &'a Party,
    pub(crate) names: &'a Names,
}

impl Holders<'_> {
    pub(crate) fn of(&self, agent: &str) -> u32 {
        let initiator = 1_u32 << self.machine.initiator;
        match self.machine.scope {
            Scope::Participant if self.names.is(self.conversation.initiator, agent) => initiator,
            Scope::Participant if self.names.is(self.party.peer, agent) => !initiator,
            Scope::Participant => 0,
            Scope::Conversation => {
                let bound = self.conversation.bound.iter();
                let held = bound.filter(|bound| self.names.is(bound.agent, agent));
                held.fold(0, |mask, bound| mask | (1 << bound.role))
            }
        }
    }
}

/// A message with respect to one party of its conversation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PartyMessage<'a> {
    pub(crate) act: Act<'a>,
    pub(crate) side: Side,
    /// Roles that the sender may have.
    pub(crate) from: u32,
    /// Roles that every receiver may have.
    pub(crate) to: u32,
    pub(crate) reply_with: u64,
    pub(crate) in_reply_to: u64,
    /// Whether `in-reply-to` can be compared: the conversation has two participants.
    pub(crate) answers: bool,
    /// Whether the sender is the monitored agent, which has received all earlier messages.
    pub(crate) own: bool,
    /// Whether sender and receivers already take part.
    pub(crate) known: bool,
}

/// The state after a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct NextState {
    pub(crate) state: u16,
    pub(crate) resume: u16,
    pub(crate) echo: bool,
    /// Whether the message was sent before its sender had received the last one.
    pub(crate) crossed: bool,
    /// Whether the message answers one that another message has replaced. It is too late and changes
    /// nothing.
    pub(crate) void: bool,
    /// Roles of the sender and the receivers in the transition; 0 for none.
    pub(crate) roles: (u32, u32),
    pub(crate) guard: Guard,
    /// The state in which the message fits, if it is not the present one.
    pub(crate) before: Option<u16>,
    /// Whether the message shows that one reported as failed has arrived, or that it has not.
    pub(crate) world: Option<World>,
    /// Whether the message answers a cancel, and is no step of the protocol itself.
    pub(crate) answers_cancel: bool,
}

impl NextState {
    pub(crate) fn to(state: u16) -> Self {
        Self {
            state,
            resume: state,
            echo: false,
            crossed: false,
            void: false,
            roles: (0, 0),
            guard: Guard::default(),
            before: None,
            world: None,
            answers_cancel: false,
        }
    }

    /// A void message after one that was reported as failed: it does not show whether that one has arrived.
    fn void_in_failed(party: &Party) -> Self {
        Self {
            resume: party.resume,
            void: true,
            ..Self::to(FAILED)
        }
    }

    fn not_understood_in(state: u16) -> Self {
        Self {
            resume: state,
            ..Self::to(AFTER_NOT_UNDERSTOOD)
        }
    }

    fn taking(step: &Transition) -> Self {
        let single = |roles: &Roles| if roles.anyone { 0 } else { roles.mask };
        Self {
            roles: (single(&step.from), single(&step.to)),
            guard: step.guard,
            ..Self::to(step.target)
        }
    }
}

/// Returns the state after a message, or the kind of violation.
#[inline]
pub(crate) fn next_state(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    match party.state {
        AFTER_NOT_UNDERSTOOD | CANCELLING | CANCELLED | FAILED => {
            after_common_step(machine, party, message)
        }
        _ if party.echo => after_common_step(machine, party, message),
        own => in_state(machine, party, own, message),
    }
}

/// Returns the state after a message that follows a cancel, a not-understood or a failure.
fn after_common_step(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    match party.state {
        CANCELLING => while_cancelling(machine, party, message),
        CANCELLED if party.echo && message.side != party.canceling_side => {
            after_crossing(machine, party, message)
        }
        // A message that was sent before the not-understood arrived changes nothing.
        AFTER_NOT_UNDERSTOOD if !message.own && message.side != party.last => {
            match in_state(machine, party, party.resume, message) {
                Ok(NextState { state, .. }) => Ok(NextState {
                    resume: machine.state(state).map_or(party.resume, |_| state),
                    void: true,
                    ..NextState::to(AFTER_NOT_UNDERSTOOD)
                }),
                Err(_) => Err(ended(party, message)),
            }
        }
        AFTER_NOT_UNDERSTOOD | CANCELLED => Err(ended(party, message)),
        // A message that was reported as failed may have arrived, or is sent again.
        FAILED if let Some(worlds) = party.worlds() => in_worlds(machine, party, worlds, message),
        FAILED => {
            let in_state = |state| {
                let taken = in_state(machine, party, state, message)?;
                Ok(NextState {
                    before: Some(state),
                    ..taken
                })
            };
            // If the last message did not arrive, the protocol has not ended, and can be canceled.
            let over = machine.state(party.resume).is_some_and(State::is_over);
            let (first, second) = match message.act == CANCEL && over {
                true => (party.before, party.resume),
                false => (party.resume, party.before),
            };
            let taken = in_state(first);
            // A message that is void after the undelivered one did not cross it, if that one did not
            // arrive. It then counts in the state before.
            match (&taken, in_state(second)) {
                (Ok(void), Ok(other)) if void.void && !other.void => Ok(other),
                (Ok(void), Ok(_)) if void.void => Ok(NextState::void_in_failed(party)),
                (Err(_), Ok(other)) => Ok(other),
                _ => taken,
            }
        }
        // What was taken for the failure of a cancel was a failure of the protocol.
        own if party.echo
            && message.side != party.canceling_side
            && is_told_apart(party, message)
            && message.in_reply_to == party.cancel()
            && is_cancel_answer(message) =>
        {
            Ok(NextState {
                answers_cancel: true,
                ..match message.act {
                    INFORM => NextState::to(CANCELLED),
                    FAILURE => NextState::to(own),
                    _ => NextState::not_understood_in(own),
                }
            })
        }
        own => in_state(machine, party, own, message),
    }
}

/// Returns the state after a message that follows one which was not delivered, or of which that is
/// uncertain.
fn in_worlds(
    machine: &Machine,
    party: &Party,
    worlds: &Worlds,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let in_world = |world| {
        let party = match world {
            World::Missing => &worlds.missing,
            World::Arrived => &worlds.arrived,
        };
        let taken = next_state(machine, party, message)?;
        Ok(NextState {
            world: Some(world),
            ..taken
        })
    };
    let taken = in_world(World::Missing);
    let arrived = in_world(World::Arrived);
    match (&taken, arrived) {
        (Ok(void), Ok(other)) if void.void && !other.void => Ok(other),
        (Ok(void), Ok(_)) if void.void => Ok(NextState::void_in_failed(party)),
        (Err(_), Ok(other)) => Ok(other),
        _ => taken,
    }
}

fn is_cancel_answer(message: &PartyMessage<'_>) -> bool {
    [INFORM, FAILURE, NOT_UNDERSTOOD].contains(&message.act)
}

/// Whether `in-reply-to` distinguishes the answer to a cancel from other messages.
fn is_told_apart(party: &Party, message: &PartyMessage<'_>) -> bool {
    message.in_reply_to != 0 && party.cancel() != 0
}

/// Returns the state after a message of the canceled side. The message that was taken for the answer to
/// the cancel may have crossed it, and so may this one.
fn after_crossing(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let told_apart = is_told_apart(party, message);
    let answers =
        is_cancel_answer(message) && (!told_apart || message.in_reply_to == party.cancel());
    let crossing = in_state(machine, party, party.resume, message);
    match (message.act, crossing) {
        // The cancel failed, so the conversation continues. If this is a failure of the protocol
        // itself, the answer to the cancel fits too.
        (FAILURE, crossing) if answers => Ok(NextState {
            echo: !told_apart && crossing.is_ok(),
            answers_cancel: true,
            ..NextState::to(party.resume)
        }),
        (_, Ok(next_state)) if !(told_apart && answers) => Ok(match next_state.state {
            AFTER_NOT_UNDERSTOOD => next_state,
            state => NextState {
                resume: match state {
                    // Two cancels crossed, or a failure crossed one.
                    CANCELLING | FAILED => party.resume,
                    own => own,
                },
                echo: true,
                ..NextState::to(CANCELLED)
            },
        }),
        _ if answers => Ok(NextState {
            answers_cancel: true,
            ..NextState::to(CANCELLED)
        }),
        _ => Err(ended(party, message)),
    }
}

fn ended(party: &Party, message: &PartyMessage<'_>) -> Kind {
    if is_repeated(party, message) {
        Kind::Repeated
    } else {
        Kind::Ended
    }
}

fn while_cancelling(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let group = machine.scope == Scope::Conversation;
    if message.side == party.canceling_side && !group {
        return match message.act {
            NOT_UNDERSTOOD => Ok(NextState::not_understood_in(party.resume)),
            _ if is_repeated(party, message) => Err(Kind::Repeated),
            _ => Err(Kind::Unexpected),
        };
    }
    let told_apart = is_told_apart(party, message);
    let answers = !told_apart || message.in_reply_to == party.cancel();
    let crossing = in_state(machine, party, party.resume, message);
    if answers && is_cancel_answer(message) {
        let next_state = match message.act {
            INFORM => match crossing {
                Ok(crossing) if !told_apart => NextState {
                    resume: crossing.state,
                    echo: true,
                    ..NextState::to(CANCELLED)
                },
                _ => NextState::to(CANCELLED),
            },
            // The cancel failed, and the conversation continues.
            FAILURE => NextState {
                echo: !told_apart && crossing.is_ok(),
                ..NextState::to(party.resume)
            },
            _ => NextState::not_understood_in(party.resume),
        };
        return Ok(NextState {
            answers_cancel: true,
            ..next_state
        });
    }
    // If the cancel fails, the conversation continues in the state after the crossing message.
    crossing.map(|next_state| match next_state.state {
        AFTER_NOT_UNDERSTOOD => next_state,
        _ => NextState {
            state: CANCELLING,
            crossed: true,
            guard: Guard::default(),
            ..next_state
        },
    })
}

/// Returns the state after a message in one of the protocol's own states.
fn in_state(
    machine: &Machine,
    party: &Party,
    state: u16,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let Some(here) = machine.state(state) else {
        return Err(Kind::Unexpected);
    };
    let Some(step) = step(&here.steps, message.act, message.from, message.to) else {
        return without_step(machine, party, state, message);
    };
    Ok(match in_reply(party, message)? {
        Reply::ToLast => NextState::taking(step),
        Reply::ToEarlier => NextState {
            void: true,
            ..NextState::to(state)
        },
    })
}

/// Returns the state after a message for which one of the protocol's own states has no transition.
fn without_step(
    machine: &Machine,
    party: &Party,
    state: u16,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let embedded = machine.state(state).map(|here| here.embedded.iter());
    let proxied = embedded.into_iter().flatten().any(|sub| {
        let to = sub.proxied_to.as_ref();
        sub.from.includes(message.from) && to.is_some_and(|to| to.includes(message.to))
    });
    if proxied {
        return Ok(NextState::to(state));
    }
    if let Some(next_state) = by_default(machine, party, state, message) {
        return Ok(next_state);
    }
    if has_crossed(machine, party, state, message) {
        return Ok(NextState {
            void: true,
            ..NextState::to(state)
        });
    }
    Err(wrong(machine, party, state, message))
}

/// Whether a message that does not fit the state was sent before its sender had received the last
/// messages of the other side, as a bid that arrives after the end of an auction. It changes nothing.
fn has_crossed(machine: &Machine, party: &Party, state: u16, message: &PartyMessage<'_>) -> bool {
    if message.own || !message.answers {
        return false;
    }
    let fits = |state: &State| step(&state.steps, message.act, message.from, message.to).is_some();
    let other = side_index(message.side.opposite());
    match message.in_reply_to {
        // Without `in-reply-to`, only one message of the other side may have crossed it. A timeout
        // does not cross messages.
        0 => {
            let before = machine.state(party.before).filter(|before| fits(before));
            let mut led = before.into_iter().flat_map(|before| &before.steps);
            party.last != message.side
                && led.any(|step| step.target == state && step.from.includes(message.to))
        }
        answered => {
            answered != party.asked[other]
                && may_have_asked(party.earlier(other), answered)
                && machine.states.iter().any(fits)
        }
    }
}

/// Returns the state after a message that every protocol allows, as in figure 6 of the paper about
/// fipa_acl.
fn by_default(
    machine: &Machine,
    party: &Party,
    state: u16,
    message: &PartyMessage<'_>,
) -> Option<NextState> {
    if party.is_fresh() || !message.known {
        return None;
    }
    let here = machine.state(state)?;
    let has_ended = here.is_final;
    // The receiver of the last message may not have understood it. Its sender cannot send
    // `not-understood`.
    let answers_last = party.last != message.side;
    match message.act {
        NOT_UNDERSTOOD => {
            // It may have crossed the message that ended the protocol, if others can still follow.
            let ended_by = standard_act(party.acts[side_index(message.side.opposite())]);
            let ends = |step: &Transition| {
                step.target == state
                    && step.from.includes(message.to)
                    && ended_by.is_some_and(|act| step.acts.contains(act))
            };
            let has_crossed = !message.own
                && !here.is_over()
                && machine.states.iter().flat_map(|it| &it.steps).any(ends);
            let may = !has_ended || answers_last || has_crossed;
            may.then(|| NextState::not_understood_in(state))
        }
        CANCEL => {
            let may = match machine.cancel {
                Cancel::Initiator => message.side == Side::Initiator,
                Cancel::Anyone => true,
                Cancel::Nobody => false,
            };
            // After the end, a cancel is allowed only if its sender may not have received the last
            // message.
            let too_late = here.is_over() && (message.own || !answers_last);
            (may && !too_late).then_some(NextState {
                resume: state,
                ..NextState::to(CANCELLING)
            })
        }
        FAILURE if machine.failure_by_parties => (!has_ended).then_some(NextState {
            resume: state,
            ..NextState::to(FAILED)
        }),
        _ => None,
    }
}

/// Whether a side may have sent this `reply-with` before its last one. Beyond the bound, the monitor does
/// not know.
fn may_have_asked(earlier: &[u32; EARLIER], reply_with: u64) -> bool {
    earlier.contains(&short(reply_with)) || earlier[EARLIER - 1] != 0
}

/// The message that a message answers.
enum Reply {
    /// The last message of the other side, or unspecified.
    ToLast,
    /// A message before the last one. The answer and the later messages have crossed, as a bid and
    /// the next calls of an auction may.
    ToEarlier,
}

fn in_reply(party: &Party, message: &PartyMessage<'_>) -> Result<Reply, Kind> {
    let other = side_index(message.side.opposite());
    let asked = party.asked[other];
    let earlier = || party.earlier(other);
    // A message that crossed the `not-understood` answers the message before it.
    let is_crossing = || {
        let [before, ..] = earlier();
        party.state == AFTER_NOT_UNDERSTOOD && short(message.in_reply_to) == *before
    };
    if !message.answers || [0, asked].contains(&message.in_reply_to) || asked == 0 || is_crossing()
    {
        Ok(Reply::ToLast)
    } else if may_have_asked(earlier(), message.in_reply_to) && !message.own {
        Ok(Reply::ToEarlier)
    } else {
        Err(Kind::WrongReply)
    }
}

pub(crate) fn side_index(side: Side) -> usize {
    match side {
        Side::Initiator => 0,
        Side::Other => 1,
    }
}

fn is_repeated(party: &Party, message: &PartyMessage<'_>) -> bool {
    let index = side_index(message.side);
    let same_act = act_number(message.act) != 0 && party.acts[index] == act_number(message.act);
    same_act && message.reply_with != 0 && party.asked[index] == message.reply_with
}

/// Returns the number of a standard performative, plus 1, and 255 for other performatives.
pub(crate) fn act_number(act: Act<'_>) -> u8 {
    match act {
        Act::Standard(number) => number + 1,
        Act::Other(_) => u8::MAX,
    }
}

/// Returns the standard performative with this [`act_number`].
fn standard_act(number: u8) -> Option<Act<'static>> {
    let index = number.checked_sub(1)?;
    (usize::from(index) < Performative::STANDARD.len()).then_some(Act::Standard(index))
}

fn wrong(machine: &Machine, party: &Party, state: u16, message: &PartyMessage<'_>) -> Kind {
    if is_repeated(party, message) {
        return Kind::Repeated;
    }
    let Some(here) = machine.state(state) else {
        return Kind::Unexpected;
    };
    if here.is_over() {
        return Kind::Ended;
    }
    if step(&here.steps, message.act, message.to, message.from).is_some() {
        return Kind::WrongSender;
    }
    // Checks whether a later state allows the message.
    let mut reached = vec![false; machine.states.len()];
    let mut next = vec![state];
    while let Some(id) = next.pop() {
        let fresh = reached.get_mut(usize::from(id)).filter(|seen| !**seen);
        let Some((seen, later)) = fresh.zip(machine.state(id)) else {
            continue;
        };
        *seen = true;
        if step(&later.steps, message.act, message.from, message.to).is_some() {
            return Kind::OutOfOrder;
        }
        next.extend(later.transitions.iter().map(|step| step.target));
    }
    Kind::Unexpected
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
            let mut party = Party::new(NONE, 0);
            for asked in 1..=count {
                party.ask(Side::Initiator, asked, "");
            }
            let before = (party.asked, *party.earlier(0));
            party.begin_step(Side::Initiator, 1, 99, false);
            party.ask(Side::Initiator, 99, "");
            assert_ne!((party.asked, *party.earlier(0)), before, "{count}");
            assert!(party.take_back(Side::Initiator, 1, 99));
            party.settle(World::Missing);
            assert_eq!((party.asked, *party.earlier(0)), before, "{count}");
        }
    }

    #[test]
    fn what_parties_allocate_is_counted_and_one_buffer_is_kept() {
        let mut names = Names::new(std::hash::RandomState::new());
        let mut conversation = Conversation::unused();
        let party = Party::new(NONE, 0);
        conversation.add(party.clone());
        assert_eq!(conversation.allocated(), 0);
        let [first] = &mut conversation.parties[..] else {
            panic!()
        };
        first.ask(Side::Initiator, 0, "");
        assert_eq!(first.allocated(), 0);
        first.begin_step(Side::Initiator, 1, 7, false);
        first.ask(Side::Initiator, 7, "r7");
        assert_eq!(first.asked_text(0), "r7");
        assert_eq!(first.allocated(), size_of::<Details>());
        assert!(!first.take_back(Side::Initiator, 1, 8));
        assert!(first.take_back(Side::Initiator, 1, 7));
        assert_eq!(first.state, FAILED);
        // Two worlds with details each.
        let uncertain = 3 * size_of::<Details>() + size_of::<Worlds>();
        assert_eq!(first.allocated(), uncertain);
        conversation.add(party);
        let both = conversation.parties.allocated();
        assert_eq!(both, uncertain + 2 * size_of::<Party>());
        let agent = conversation.acquire(&mut names, "ann");
        conversation.bound.push(RoleBinding { role: 0, agent });
        let bound = size_of::<SmallVec<[RoleBinding; 2]>>();
        assert_eq!(conversation.allocated(), both + bound + Names::cost(3));
        conversation.clear();
        assert_eq!(conversation.allocated(), 0);
        // The buffer of a single party serves the next one.
        let mut single = Party::new(NONE, 0);
        single.ask(Side::Other, 9, "r9");
        conversation.add(single);
        conversation.clear();
        assert_eq!(conversation.allocated(), size_of::<Details>());
        conversation.add(Party::new(NONE, 0));
        assert_eq!(conversation.allocated(), size_of::<Details>());
        let party = conversation.parties.first().unwrap();
        assert_eq!((party.asked_text(1), party.earlier(1)), ("", &[0; EARLIER]));
    }

    #[test]
    fn what_a_conversation_counts_is_what_it_allocates() {
        let mut conversation = Conversation::unused();
        let fill = |conversation: &mut Conversation| {
            for agent in 0..20 {
                conversation.add(Party::new(agent, 0));
                conversation.bound.push(RoleBinding { role: 0, agent });
            }
            for party in conversation.parties.iter_mut().take(7) {
                party.begin_step(Side::Initiator, 1, 7, false);
                party.ask(Side::Initiator, 7, "r7");
            }
            // An uncertain one has two worlds.
            assert!(conversation.parties[0].take_back(Side::Initiator, 1, 7));
            let mut unnamed = Party::new(NONE, 0);
            unnamed.ask(Side::Initiator, 7, "r7");
            let rare = conversation.rare();
            rare.unnamed = Some(Box::new(unnamed));
            rare.reply_to.extend(0..3);
            rare.delegates.extend((0..5).map(|agent| (0, agent)));
            rare.alternatives.extend((0..7).map(|state| (0, state)));
            let asked = |agent| RoleBinding { role: 0, agent };
            rare.asked.extend((0..3).map(asked));
            for receivers in [2, 9] {
                rare.copied.push(Copied {
                    fingerprint: 0,
                    seen: (0..receivers).collect(),
                    roles: (0, 0),
                });
            }
        };
        let measured = allocation_counter::measure(|| fill(&mut conversation));
        let allocated = i64::try_from(conversation.allocated()).unwrap();
        assert_eq!(allocated, measured.bytes_current);
        let measured = allocation_counter::measure(|| conversation.clear());
        assert_eq!(measured.bytes_current, -allocated);
    }

    #[test]
    fn what_the_rare_parts_allocate_is_counted() {
        let mut conversation = Conversation::unused();
        let mut before = 0;
        let mut added = |change: &dyn Fn(&mut Rare)| {
            change(conversation.rare());
            let now = conversation.allocated();
            now - std::mem::replace(&mut before, now)
        };
        assert_eq!(added(&|_| ()), size_of::<Rare>());
        let bytes = added(&|rare| rare.reply_to.reserve_exact(3));
        assert_eq!(bytes, 3 * size_of::<Name>());
        let bytes = added(&|rare| rare.delegates.reserve_exact(3));
        assert_eq!(bytes, 3 * size_of::<(u32, Name)>());
        let bytes = added(&|rare| rare.alternatives.reserve_exact(3));
        assert_eq!(bytes, 3 * size_of::<(u32, u16)>());
        let bytes = added(&|rare| rare.copied.reserve_exact(3));
        assert_eq!(bytes, 3 * size_of::<Copied>());
        for receivers in [3, 5] {
            let bytes = added(&|rare| {
                rare.copied.push(Copied {
                    fingerprint: 0,
                    seen: Vec::with_capacity(receivers),
                    roles: (0, 0),
                });
            });
            assert_eq!(bytes, receivers * size_of::<u64>());
        }
        let asked = RoleBinding { role: 0, agent: 0 };
        assert_eq!(added(&|rare| rare.asked.push(asked)), 0);
        let bytes = added(&|rare| rare.asked.grow(5));
        assert_eq!(bytes, 5 * size_of::<RoleBinding>());
        let bytes = added(&|rare| {
            let mut party = Party::new(NONE, 0);
            party.ask(Side::Initiator, 7, "r7");
            rare.unnamed = Some(Box::new(party));
        });
        assert_eq!(bytes, size_of::<Party>() + size_of::<Details>());
        let bytes = added(&|rare| {
            rare.index.insert_unique(spread(1), (1, 0), |_| 0);
        });
        assert!(bytes >= size_of::<(Name, u32)>());
    }

    #[test]
    fn the_growth_of_a_conversation_is_bounded() {
        // At 14 and 448, the index is full.
        for before in [0, 1, 2, 3, 8, 9, 14, 100, 500] {
            for added in [0, 1, 2, 5, 7, 8, 90, 348, 600] {
                let mut names = Names::new(std::hash::RandomState::new());
                let mut conversation = Conversation::unused();
                let mut grow = |conversation: &mut Conversation, numbers: Range<usize>| {
                    for number in numbers {
                        let agent = names.acquire(&number.to_string());
                        conversation.add(Party::new(agent, 0));
                        conversation.bound.push(RoleBinding { role: 0, agent });
                    }
                };
                grow(&mut conversation, 0..before);
                let bound = conversation.allocated() + conversation.growth(added, added, 64);
                grow(&mut conversation, before..before + added);
                for party in conversation.parties.iter_mut() {
                    party.details();
                }
                for _ in 0..MAX_DESIGNATED {
                    conversation.rare().delegates.push((0, 0));
                }
                let allocated = conversation.allocated();
                assert!(
                    allocated <= bound,
                    "{before} and {added}: {allocated} > {bound}"
                );
                if before == 0 {
                    // Two bindings are in the place of a pointer.
                    let inline = 2 * size_of::<RoleBinding>();
                    assert!(bound <= allocated + inline, "{added}: {bound}");
                }
                // A further role binding needs no more than itself.
                let further = conversation.bound.growth(1);
                assert_eq!(conversation.growth(0, 1, 0), further);
            }
        }
    }

    #[test]
    fn a_party_is_found_among_few_and_many() {
        let mut names = Names::new(std::hash::RandomState::new());
        let mut table = super::table::Table::new(&std::hash::RandomState::new());
        let at = table.insert("c", NONE, NONE, 0, 1);
        let conversation = &mut table.slot_mut(at).unwrap().conversation;
        for number in 0..40 {
            let peer = conversation.acquire(&mut names, &number.to_string());
            conversation.add(Party::new(peer, 0));
            for known in 0..=number {
                let found = conversation.party(&names, &known.to_string());
                assert_eq!(found.map(|(at, _)| at), Some(known));
            }
            assert!(conversation.party(&names, "other").is_none());
        }
        let delegate = conversation.acquire(&mut names, "other");
        conversation.rare().delegates.push((17, delegate));
        assert_eq!(
            conversation.party(&names, "other").map(|(at, _)| at),
            Some(17)
        );
        assert!(conversation.allocated() > 40 * size_of::<Party>());
    }
}
