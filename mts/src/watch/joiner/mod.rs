//! Joins the records of all processes to one event per letter.
//!
//! The sender's process, the gateways of this host and the receiver's process report a letter, in
//! any order and with any report missing: a sender on another host reports nothing, and records may
//! be lost. The first record creates the letter. It is held back for a short time, so that other
//! records of this and earlier letters arrive, and then becomes an event, in the order of sending.
//! A later outcome is an event of its own.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use fipa_acl::Message;
use fipa_transport::{Incarnation, Kind, Outcome, Stream};

use super::envelope::SeenEnvelope;
use super::record::{LetterId, Origin, Record, RecordBody, RecordError, Seen, SeenLetter};

/// Minimum time for which a letter is held back: records of earlier letters may still arrive.
const HOLD: Duration = Duration::from_millis(40);
/// Time for which a letter is held back for its outcome.
const TIMEOUT: Duration = Duration::from_millis(250);
/// Maximum number of letters that are held back; beyond it the earliest is reported as it is.
const MAX_WAITING: usize = 65_536;
/// Maximum number of reported letters that are remembered, because their outcomes may still arrive.
const MAX_OPEN: usize = 65_536;
/// Maximum number of other reported letters whose keys are remembered, so that none is reported twice.
const MAX_SETTLED: usize = 16_384;
/// Maximum number of outcomes of unknown letters that are remembered.
const MAX_EARLY: usize = 4096;
/// Maximum number of processes that are remembered.
const MAX_PROCESSES: usize = 4096;

/// A process that sends records, by a number that the watcher chooses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct RecordSource(pub u64);

/// The known data of one letter to one receiver.
#[derive(Debug, Clone)]
pub struct Passage {
    /// Number of the letter in the order of reporting, from 1.
    pub number: u64,
    /// Time of sending or, if unknown, of the first record; by the clock of this host.
    pub at: SystemTime,
    /// The incarnations of its sender and its receiver.
    pub stream: Stream,
    /// Sequence number of the letter among all letters of the sender.
    pub sequence: u64,
    /// Letters of one sender with the same number carry one message to several receivers.
    pub submission: Option<u64>,
    /// Name of the receiver.
    pub receiver: Arc<str>,
    /// Its envelope.
    pub envelope: SeenEnvelope,
    /// Its message without content, unless it is too long or malformed.
    pub message: Option<Message>,
    /// Length of the content in bytes, if the message has content.
    pub content_len: Option<u64>,
    /// The content or its beginning, up to the requested length.
    pub content: Bytes,
    /// Length of envelope and message in bytes, content included.
    pub size: u64,
    /// The transport of its route; the one between hosts, if it crossed hosts.
    pub via: Option<Kind>,
    /// The gateway of this host that forwarded it.
    pub gateway: Option<Arc<str>>,
    /// Whether it comes from another host, which sends no records.
    pub from_elsewhere: bool,
    /// Whether a message transport service, not an agent, wrote it to report a failure.
    pub from_service: bool,
    /// State of the delivery.
    pub fate: Fate,
    /// Time of the outcome that was reported to the sender, by the clock of this host.
    pub settled_at: Option<SystemTime>,
}

impl Passage {
    /// Time from sending to the outcome that was reported to the sender; `None` if one of them is not known.
    #[must_use]
    pub fn delivery_time(&self) -> Option<Duration> {
        // Only the record of the sender has the time of sending.
        let sent = self.submission.map(|_| self.at)?;
        self.settled_at?.duration_since(sent).ok()
    }

    /// Name of the sender in the message. If the message has none, its name in the envelope.
    #[must_use]
    pub fn sender(&self) -> Option<&str> {
        let said = self.message.as_ref().and_then(Message::sender);
        let written = || {
            let envelope = self.envelope.get()?;
            let newest_first = envelope.extensions.iter().rev().chain([&envelope.base]);
            newest_first.filter_map(|part| part.from.as_ref()).next()
        };
        said.or_else(written).map(fipa_acl::AgentId::name)
    }
}

/// State of a letter's delivery.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fate {
    /// No outcome is known.
    UnderWay,
    /// The receiver has it; the outcome reported to the sender is not known.
    Taken,
    /// Outcome at a gateway; the outcome reported to the sender is not known.
    Passed(Outcome),
    /// Outcome that was reported to the sender.
    Settled(Outcome),
}

/// An event for a watcher.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum Event {
    /// A letter passes.
    Letter(Arc<Passage>),
    /// The state of an already reported letter has changed.
    Later(Arc<Passage>),
    /// The outcome of an already reported letter was reported to the sender. It equals the report of the receiver
    /// that the letter had before, so only `settled_at` is new.
    Confirmed(Arc<Passage>),
    /// A process could not send this many records.
    Lost {
        /// Name of its message transport service.
        process: Arc<str>,
        /// Number of records that were lost since the previous event.
        records: u64,
    },
    /// A process sent invalid data; its further records are ignored.
    Refused {
        /// Name of its message transport service, or a placeholder.
        process: Arc<str>,
        /// The error.
        why: RecordError,
    },
}

/// Identifies a letter. The sequence number is unique among all letters of a sender, and stays when
/// the letter follows its receiver to another incarnation.
type Key = (Incarnation, u64);
/// Time of sending, and order of arrival among letters of the same time.
type SendPosition = (SystemTime, u64);

/// Joins records to events; see the module documentation.
#[derive(Debug, Default)]
pub struct Joiner {
    letters: HashMap<Key, KnownLetter>,
    /// Letters that are held back, in order.
    waiting: BTreeMap<SendPosition, Key>,
    /// Letters that were reported without an outcome, in order.
    open: VecDeque<Key>,
    /// The other letters that were reported: no further record changes them.
    settled: HashSet<Key>,
    /// The same letters, in order.
    settled_in_order: VecDeque<Key>,
    outcomes_before_letters: HashMap<Key, (SystemTime, Outcome, bool)>,
    processes: HashMap<RecordSource, Process>,
    events: VecDeque<Event>,
    arrived: u64,
    number: u64,
}

#[derive(Debug)]
struct KnownLetter {
    place: SendPosition,
    since: Instant,
    passage: Passage,
    reported: bool,
    /// Whether the sender's record has arrived, which sets the time.
    sent: bool,
}

#[derive(Debug)]
struct Process {
    name: Arc<str>,
    /// Known once its greeting has arrived.
    mts: Option<Incarnation>,
    lost: u64,
}

impl Joiner {
    /// Creates a joiner without processes.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a process, with this name until its greeting arrives.
    pub fn handle_begin(&mut self, from: RecordSource, name: impl Into<Arc<str>>) {
        if self.processes.len() < MAX_PROCESSES {
            let name = name.into();
            let mts = None;
            self.processes.insert(from, Process { name, mts, lost: 0 });
        }
    }

    /// Handles invalid data of a process, whose further records are then ignored.
    pub fn handle_malformed(&mut self, from: RecordSource, why: RecordError) {
        let process = self.name(from);
        self.events.push_back(Event::Refused { process, why });
        self.handle_end(from);
    }

    /// Handles a record of a process.
    pub fn handle(&mut self, now: Instant, from: RecordSource, record: Record) {
        let Record { at, lost, body } = record;
        if let RecordBody::Hello {
            name, incarnation, ..
        } = &body
            && let Some(process) = self.processes.get_mut(&from)
        {
            process.name = Arc::clone(name);
            process.mts = Some(*incarnation);
        }
        if let Some(process) = self.processes.get_mut(&from)
            && lost > process.lost
        {
            self.events.push_back(Event::Lost {
                process: Arc::clone(&process.name),
                records: lost - process.lost,
            });
            process.lost = lost;
        }
        match body {
            RecordBody::Letter { id, place, letter } => {
                let gateway = matches!(place, Seen::Passed(..)).then(|| self.name(from));
                self.seen(now, at, id, place, letter, gateway);
            }
            RecordBody::Settled {
                id,
                outcome,
                sender,
            } => self.settled(at, id, outcome, sender),
            RecordBody::Hello { .. } | RecordBody::Lost => {}
        }
    }

    /// Removes a process.
    pub fn handle_end(&mut self, from: RecordSource) {
        self.processes.remove(&from);
    }

    /// The message transport services that send records.
    pub fn services(&self) -> impl Iterator<Item = Incarnation> {
        self.processes.values().filter_map(|process| process.mts)
    }

    fn name(&self, of: RecordSource) -> Arc<str> {
        let process = self.processes.get(&of);
        process.map_or_else(|| "a process".into(), |process| Arc::clone(&process.name))
    }

    fn seen(
        &mut self,
        now: Instant,
        at: SystemTime,
        id: LetterId,
        seen: Seen,
        letter: SeenLetter,
        gateway: Option<Arc<str>>,
    ) {
        let key = (id.stream.sender, id.sequence);
        if self.settled.contains(&key) {
            return;
        }
        if !self.letters.contains_key(&key) {
            self.begin(now, at, key, id, &letter);
        }
        let Some(known) = self.letters.get_mut(&key) else {
            return;
        };
        let before = known.passage.fate.clone();
        // A process that has just started may not have the request for content yet.
        if known.passage.content.is_empty() && !known.reported {
            known.passage.content = letter.content();
        }
        known.see(seen, gateway);
        if matches!(seen, Seen::Sent(_))
            && !std::mem::replace(&mut known.sent, true)
            && !known.reported
        {
            let place = (at, known.place.1);
            self.waiting
                .remove(&std::mem::replace(&mut known.place, place));
            known.passage.at = at;
            self.waiting.insert(place, key);
        }
        if known.reported && known.passage.fate != before {
            let later = Event::Later(Arc::new(known.passage.clone()));
            self.events.push_back(later);
        }
    }

    fn begin(&mut self, now: Instant, at: SystemTime, key: Key, id: LetterId, letter: &SeenLetter) {
        self.arrived += 1;
        let place = (at, self.arrived);
        let mut passage = Passage {
            number: 0,
            at,
            stream: id.stream,
            sequence: id.sequence,
            submission: None,
            receiver: letter.receiver().into(),
            envelope: letter.envelope(),
            message: letter.decode_message(),
            content_len: letter.content_len,
            content: letter.content(),
            size: letter.size,
            via: None,
            gateway: None,
            from_elsewhere: false,
            from_service: false,
            fate: Fate::UnderWay,
            settled_at: None,
        };
        if let Some((at, outcome, sender)) = self.outcomes_before_letters.remove(&key) {
            passage.settle(at, outcome, sender);
        }
        let known = KnownLetter {
            place,
            since: now,
            passage,
            reported: false,
            sent: false,
        };
        self.letters.insert(key, known);
        self.waiting.insert(place, key);
    }

    fn settled(&mut self, at: SystemTime, id: LetterId, outcome: Outcome, sender: bool) {
        let key = (id.stream.sender, id.sequence);
        if self.settled.contains(&key) {
            return;
        }
        let Some(known) = self.letters.get_mut(&key) else {
            if self.outcomes_before_letters.len() >= MAX_EARLY {
                // Of letters whose first record was lost or precedes the watch.
                self.outcomes_before_letters.clear();
            }
            self.outcomes_before_letters
                .insert(key, (at, outcome, sender));
            return;
        };
        let (fate, seen_via) = (known.passage.fate.clone(), known.passage.via);
        known.passage.settle(at, outcome, sender);
        let news = match (&fate, &known.passage.fate) {
            // The sender's outcome that equals the receiver's record is not a change.
            (Fate::Taken, Fate::Settled(Outcome::Delivered { via, attempts })) => {
                !attempts.is_empty() || seen_via != Some(*via)
            }
            (before, after) => before != after,
        };
        if !known.reported {
            return;
        }
        if news {
            let later = Event::Later(Arc::new(known.passage.clone()));
            self.events.push_back(later);
        } else if fate == Fate::Taken && known.passage.fate != fate {
            let confirmed = Event::Confirmed(Arc::new(known.passage.clone()));
            self.events.push_back(confirmed);
        }
    }

    /// Time of the next call of [`poll_event`](Self::poll_event), if no record arrives before.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let (_, key) = self.waiting.first_key_value()?;
        self.letters.get(key).map(KnownLetter::due)
    }

    /// Returns the next event. Pass all available records before calling it.
    pub fn poll_event(&mut self, now: Instant) -> Option<Event> {
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        let (place, key) = self.waiting.first_key_value()?;
        let (place, key) = (*place, *key);
        let due = self
            .letters
            .get(&key)
            .is_some_and(|known| known.due() <= now);
        if !due && self.waiting.len() <= MAX_WAITING {
            return None;
        }
        self.waiting.remove(&place);
        self.report(key)
    }

    /// Returns the next event without holding back letters, at the end of the watch.
    pub fn finish(&mut self) -> Option<Event> {
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        let (_, key) = self.waiting.pop_first()?;
        self.report(key)
    }

    fn report(&mut self, key: Key) -> Option<Event> {
        let mut known = self.letters.remove(&key)?;
        self.number += 1;
        known.passage.number = self.number;
        let is_settled = match known.passage.fate {
            Fate::Settled(_) => true,
            // Its sender sends no records.
            Fate::Taken => known.passage.from_elsewhere,
            Fate::UnderWay | Fate::Passed(_) => false,
        };
        if is_settled {
            if self.settled_in_order.len() >= MAX_SETTLED
                && let Some(oldest) = self.settled_in_order.pop_front()
            {
                self.settled.remove(&oldest);
            }
            self.settled.insert(key);
            self.settled_in_order.push_back(key);
            return Some(Event::Letter(Arc::new(known.passage)));
        }
        if self.open.len() >= MAX_OPEN
            && let Some(oldest) = self.open.pop_front()
        {
            self.letters.remove(&oldest);
        }
        self.open.push_back(key);
        let passage = Arc::new(known.passage.clone());
        // The content has been reported and is not kept.
        known.passage.content = Bytes::new();
        known.passage.envelope = passage.envelope.alone();
        known.reported = true;
        self.letters.insert(key, known);
        Some(Event::Letter(passage))
    }
}

impl KnownLetter {
    fn see(&mut self, seen: Seen, gateway: Option<Arc<str>>) {
        let passage = &mut self.passage;
        match seen {
            Seen::Sent(submission) => {
                passage.submission = submission;
                passage.from_service = submission.is_none();
            }
            Seen::Taken(via) => {
                passage.from_service |= via.is_none();
                if passage.via.is_none() {
                    passage.via = via;
                }
                if passage.fate == Fate::UnderWay {
                    passage.fate = Fate::Taken;
                }
            }
            Seen::Passed(via, origin) => {
                passage.gateway = gateway;
                if origin == Origin::OtherHost {
                    passage.from_elsewhere = true;
                    passage.via = Some(via);
                }
            }
        }
    }

    fn due(&self) -> Instant {
        let passage = &self.passage;
        let complete = match &passage.fate {
            Fate::UnderWay => false,
            // No process of this host will report more.
            Fate::Taken | Fate::Passed(_) => passage.from_elsewhere || passage.from_service,
            Fate::Settled(_) => true,
        };
        self.since + if complete { HOLD } else { TIMEOUT }
    }
}

impl Passage {
    fn settle(&mut self, at: SystemTime, outcome: Outcome, sender: bool) {
        if matches!(self.fate, Fate::Settled(_)) {
            return;
        }
        if sender {
            // The route between hosts, which the receiver's record does not have.
            if let Some(via) = outcome.via()
                && !self.from_elsewhere
            {
                self.via = Some(via);
            }
            self.fate = Fate::Settled(outcome);
            self.settled_at = Some(at);
        } else if matches!(self.fate, Fate::UnderWay) || !outcome.is_success() {
            // The receiver's record takes precedence over an unknown outcome at a gateway.
            if self.fate != Fate::Taken {
                self.fate = Fate::Passed(outcome);
            }
        }
    }
}

#[cfg(test)]
mod tests;
