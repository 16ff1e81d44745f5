//! From the records of all processes to one event per letter.
//!
//! A letter is told of by its sender's process, by the gateways of this host and by its receiver's
//! process, in any order and with any of them missing: a sender on another host tells nothing, and
//! records may be lost. The first record makes the letter known; it is held back for a moment, so
//! that what others tell of it and of earlier letters arrives, and then becomes an event, in the
//! order in which letters were sent. An outcome that comes later than that is an event of its own.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use fipa_acl::{Envelope, Message};
use fipa_transport::{Incarnation, Kind, Outcome, Stream};

use super::record::{LetterId, Origin, Record, RecordBody, RecordError, Seen, SeenLetter};

/// How long a letter is held back at least: what others tell of letters before it may still be on
/// its way.
const HOLD: Duration = Duration::from_millis(40);
/// How long it is held back for its outcome.
const PATIENCE: Duration = Duration::from_millis(250);
/// Letters held back at most; then the earliest is told as it is.
const MAX_WAITING: usize = 65_536;
/// Letters remembered after they were told, so that none is told twice.
const MAX_TOLD: usize = 65_536;
/// Outcomes remembered of letters that nobody has told of yet.
const MAX_EARLY: usize = 4096;
/// Processes whose names and losses are remembered.
const MAX_PROCESSES: usize = 4096;

/// Which process tells, by a number of the watcher's choice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Source(pub u64);

/// A letter on its way to one receiver, as far as it is known.
#[derive(Debug, Clone)]
pub struct Passage {
    /// Counts the letters in the order in which they are told, from 1.
    pub number: u64,
    /// When it was sent or, if nobody has told that, first seen; by the clock of this host.
    pub at: SystemTime,
    /// One life of its sender, and one life of its receiver.
    pub stream: Stream,
    /// Its position among all that the sender sends.
    pub sequence: u64,
    /// Letters of one sender with the same number are one message to several receivers.
    pub send: Option<u64>,
    /// The name of the receiver.
    pub receiver: Arc<str>,
    /// Its envelope, unless that is very long or malformed.
    pub envelope: Option<Envelope>,
    /// Its message without content, unless that is very long or malformed.
    pub message: Option<Message>,
    /// Length of the content in bytes, if the message has any.
    pub content_len: Option<u64>,
    /// The content or its beginning: as much as was asked for.
    pub content: Bytes,
    /// Length of envelope and message in bytes, content included.
    pub size: u64,
    /// The way it went: between the hosts, if it comes from or goes to another.
    pub via: Option<Kind>,
    /// The gateway that it passed on this host.
    pub gateway: Option<Arc<str>>,
    /// Whether it comes from another host, where nobody is watched.
    pub from_elsewhere: bool,
    /// Whether a message transport service wrote it, to tell of a failure: no agent.
    pub from_service: bool,
    /// What has become of it.
    pub fate: Fate,
}

impl Passage {
    /// The name of the sender, as message or envelope has it.
    #[must_use]
    pub fn sender(&self) -> Option<&str> {
        let said = self.message.as_ref().and_then(Message::sender);
        let envelope = self.envelope.as_ref();
        let written = || {
            envelope.and_then(|it| {
                let newest_first = it.extensions.iter().rev().chain([&it.base]);
                newest_first.filter_map(|part| part.from.as_ref()).next()
            })
        };
        said.or_else(written).map(fipa_acl::AgentId::name)
    }
}

/// What has become of a letter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fate {
    /// Nothing that anybody has told.
    UnderWay,
    /// Its receiver has it; what the sender was told is not known here.
    Taken,
    /// What a gateway knows of it; what the sender was told is not known here.
    Passed(Outcome),
    /// What its sender was told.
    Settled(Outcome),
}

/// What a watcher sees.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum Event {
    /// A letter passes.
    Letter(Arc<Passage>),
    /// There is news of a letter that was told before.
    Later(Arc<Passage>),
    /// A process could not tell everything: so many records more were lost.
    Lost {
        /// The name of its message transport service.
        process: Arc<str>,
        /// How many.
        records: u64,
    },
    /// A process has told something that is no record, and is not listened to any more.
    Refused {
        /// The name of its message transport service, or its number.
        process: Arc<str>,
        /// What is wrong.
        why: RecordError,
    },
}

/// Which letter: a sender's sequence is the same for all its receivers, and goes with the letter
/// when it follows its receiver to another life.
type Key = (Incarnation, u64);
/// When it was sent, and which one it is among those of the same moment.
type Place = (SystemTime, u64);

/// Makes events of records. See the module's documentation.
#[derive(Debug, Default)]
pub struct Joiner {
    letters: HashMap<Key, Known>,
    /// Those held back, in order.
    waiting: BTreeMap<Place, Key>,
    /// Those told, in order.
    told: VecDeque<Key>,
    early: HashMap<Key, (Outcome, bool)>,
    processes: HashMap<Source, Process>,
    events: VecDeque<Event>,
    arrived: u64,
    number: u64,
}

#[derive(Debug)]
struct Known {
    place: Place,
    since: Instant,
    passage: Passage,
    told: bool,
    /// Whether its beginning was told, whose time counts.
    sent: bool,
}

#[derive(Debug)]
struct Process {
    name: Arc<str>,
    /// Known once it has greeted.
    mts: Option<Incarnation>,
    lost: u64,
}

impl Joiner {
    /// One who has not heard anything yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A process can be heard; by this name, until it says its own.
    pub fn handle_begin(&mut self, from: Source, name: impl Into<Arc<str>>) {
        if self.processes.len() < MAX_PROCESSES {
            let name = name.into();
            let mts = None;
            self.processes.insert(from, Process { name, mts, lost: 0 });
        }
    }

    /// A process has told something that is no record, and is not listened to any more.
    pub fn handle_malformed(&mut self, from: Source, why: RecordError) {
        let process = self.name(from);
        self.events.push_back(Event::Refused { process, why });
        self.handle_end(from);
    }

    /// A process has told something.
    pub fn handle(&mut self, now: Instant, from: Source, record: Record) {
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
                self.seen(now, at, id, place, *letter, gateway);
            }
            RecordBody::Settled {
                id,
                outcome,
                sender,
            } => self.settled(id, outcome, sender),
            RecordBody::Hello { .. } | RecordBody::Lost => {}
        }
    }

    /// A process tells nothing any more.
    pub fn handle_end(&mut self, from: Source) {
        self.processes.remove(&from);
    }

    /// The message transport services that tell of their letters.
    pub fn services(&self) -> impl Iterator<Item = Incarnation> {
        self.processes.values().filter_map(|process| process.mts)
    }

    fn name(&self, of: Source) -> Arc<str> {
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
        let content = letter.content.clone();
        if !self.letters.contains_key(&key) {
            self.begin(now, at, key, id, letter);
        }
        let Some(known) = self.letters.get_mut(&key) else {
            return;
        };
        let before = known.passage.fate.clone();
        // A process that has just begun does not know yet that content was asked for.
        if known.passage.content.is_empty() && !known.told {
            known.passage.content = content;
        }
        known.see(seen, gateway);
        if matches!(seen, Seen::Sent(_)) && !std::mem::replace(&mut known.sent, true) && !known.told
        {
            let place = (at, known.place.1);
            self.waiting
                .remove(&std::mem::replace(&mut known.place, place));
            known.passage.at = at;
            self.waiting.insert(place, key);
        }
        if known.told && known.passage.fate != before {
            let later = Event::Later(Arc::new(known.passage.clone()));
            self.events.push_back(later);
        }
    }

    fn begin(&mut self, now: Instant, at: SystemTime, key: Key, id: LetterId, letter: SeenLetter) {
        let SeenLetter {
            envelope,
            message,
            content_len,
            content,
            size,
        } = letter;
        self.arrived += 1;
        let place = (at, self.arrived);
        let mut passage = Passage {
            number: 0,
            at,
            stream: id.stream,
            sequence: id.sequence,
            send: None,
            receiver: id.receiver,
            envelope,
            message,
            content_len,
            content,
            size,
            via: None,
            gateway: None,
            from_elsewhere: false,
            from_service: false,
            fate: Fate::UnderWay,
        };
        if let Some((outcome, sender)) = self.early.remove(&key) {
            passage.settle(outcome, sender);
        }
        let known = Known {
            place,
            since: now,
            passage,
            told: false,
            sent: false,
        };
        self.letters.insert(key, known);
        self.waiting.insert(place, key);
    }

    fn settled(&mut self, id: LetterId, outcome: Outcome, sender: bool) {
        let key = (id.stream.sender, id.sequence);
        let Some(known) = self.letters.get_mut(&key) else {
            if self.early.len() >= MAX_EARLY {
                // Of letters whose beginning was lost, or was before the watching.
                self.early.clear();
            }
            self.early.insert(key, (outcome, sender));
            return;
        };
        let (fate, seen_via) = (known.passage.fate.clone(), known.passage.via);
        known.passage.settle(outcome, sender);
        let news = match (&fate, &known.passage.fate) {
            // That the sender was told just what was seen is none.
            (Fate::Taken, Fate::Settled(Outcome::Delivered { via, attempts })) => {
                !attempts.is_empty() || seen_via != Some(*via)
            }
            (before, after) => before != after,
        };
        if known.told && news {
            let later = Event::Later(Arc::new(known.passage.clone()));
            self.events.push_back(later);
        }
    }

    /// When [`poll_event`](Self::poll_event) is to be asked again, if nothing else happens.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let (_, key) = self.waiting.first_key_value()?;
        self.letters.get(key).map(Known::due)
    }

    /// The next event. Hand over all records that are there before asking.
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
        self.tell(key)
    }

    /// The next event, without waiting for anything: the watching ends.
    pub fn finish(&mut self) -> Option<Event> {
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        let (_, key) = self.waiting.pop_first()?;
        self.tell(key)
    }

    fn tell(&mut self, key: Key) -> Option<Event> {
        if self.told.len() >= MAX_TOLD
            && let Some(oldest) = self.told.pop_front()
        {
            self.letters.remove(&oldest);
        }
        self.told.push_back(key);
        let known = self.letters.get_mut(&key)?;
        self.number += 1;
        known.passage.number = self.number;
        known.told = true;
        let passage = Arc::new(known.passage.clone());
        // What is remembered of it is whose it is; what was in it has been told.
        known.passage.content = Bytes::new();
        Some(Event::Letter(passage))
    }
}

impl Known {
    fn see(&mut self, seen: Seen, gateway: Option<Arc<str>>) {
        let passage = &mut self.passage;
        match seen {
            Seen::Sent(send) => {
                passage.send = send;
                passage.from_service = send.is_none();
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
                if origin == Origin::Elsewhere {
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
            // Nobody of this host will tell more.
            Fate::Taken | Fate::Passed(_) => passage.from_elsewhere || passage.from_service,
            Fate::Settled(_) => true,
        };
        self.since + if complete { HOLD } else { PATIENCE }
    }
}

impl Passage {
    fn settle(&mut self, outcome: Outcome, sender: bool) {
        if matches!(self.fate, Fate::Settled(_)) {
            return;
        }
        if sender {
            // The way between the hosts, which the receiver does not see.
            if let Some(via) = outcome.via()
                && !self.from_elsewhere
            {
                self.via = Some(via);
            }
            self.fate = Fate::Settled(outcome);
        } else if matches!(self.fate, Fate::UnderWay) || !outcome.is_success() {
            // A receiver that has the letter is believed more than a gateway that does not know.
            if self.fate != Fate::Taken {
                self.fate = Fate::Passed(outcome);
            }
        }
    }
}

#[cfg(test)]
mod tests;
