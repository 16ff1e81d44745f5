//! The state of the model: one sender's process, two custodians, two registrations of one
//! receiver, and the messages between them.

use std::fmt;

/// Highest number of letters in a configuration.
pub(crate) const MAX_LETTERS: usize = 4;

/// A service with one incarnation: a custodian that dies and restarts is another service.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Service {
    pub(crate) node: u8,
    pub(crate) life: u8,
}

pub(crate) const SENDER: Service = Service { node: 0, life: 0 };
pub(crate) const RECEIVER: Service = Service { node: 3, life: 0 };
/// Nodes of the two custodians.
pub(crate) const CUSTODIANS: [u8; 2] = [1, 2];
/// Incarnations of one custodian: it dies at most once.
pub(crate) const LIVES: u8 = 2;

impl Service {
    /// Index among the custodians.
    pub(crate) fn custodian(self) -> Option<usize> {
        CUSTODIANS.iter().position(|node| *node == self.node)
    }

    /// Services in all their incarnations.
    pub(crate) const COUNT: usize = 4 * LIVES as usize;

    /// A number below [`Service::COUNT`].
    pub(crate) fn index(self) -> usize {
        usize::from(self.node * LIVES + self.life)
    }

    /// Bit of this service in [`Held::handed`] and [`Letter::handed`].
    pub(crate) fn bit(self) -> u8 {
        1 << self.index()
    }

    /// Index in [`Held::upstream`]: the sender, or the first custodian in one of its incarnations.
    pub(crate) fn slot(self) -> usize {
        match self.node {
            0 => 0,
            _ => 1 + usize::from(self.life),
        }
    }

    /// Inverse of [`Service::slot`].
    pub(crate) fn of_slot(slot: usize) -> Self {
        match slot {
            0 => SENDER,
            _ => Self {
                node: 1,
                life: slot as u8 - 1,
            },
        }
    }
}

impl fmt::Debug for Service {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.node {
            0 => f.write_str("S"),
            3 => f.write_str("R"),
            node => write!(f, "C{node}.{}", self.life),
        }
    }
}

/// A letter within its stream. The sender is one registration, so the receiver's registration (0
/// or 1) names the stream.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Key {
    pub(crate) registration: u8,
    pub(crate) sequence: u8,
}

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "#{}/R{}", self.sequence, self.registration)
    }
}

/// Place of a letter in a service that holds it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Place {
    /// It may be dispatched.
    Ready,
    /// It was handed over: the attempt is in progress, or the letter is in custody there. The model
    /// does not tell the two apart, so that each attempt may also be answered late.
    Out {
        to: Service,
        transfer: u8,
        /// The predecessor that the copy carried.
        sent: u8,
        /// The predecessor that the service was told, by the copy or a note.
        after: u8,
    },
    /// It came back as out of order and waits (custodians only).
    Blocked,
    /// The registration has left; the letter waits for the new entry (sender only).
    Moved,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Outcome {
    Delivered,
    /// A certain failure.
    Failed,
    Unconfirmed,
}

/// A letter in the sender's process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Letter {
    pub(crate) outcome: Option<Outcome>,
    pub(crate) registration: u8,
    pub(crate) uncertain: bool,
    pub(crate) place: Place,
    /// Custodians that the letter was ever handed to.
    pub(crate) handed: u8,
    /// Number of hand-overs since its lane last paused; only with a hostile custodian.
    pub(crate) at_once: u8,
}

/// A letter in the lane of a custodian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Held {
    pub(crate) key: Key,
    pub(crate) after: u8,
    pub(crate) uncertain: bool,
    pub(crate) place: Place,
    pub(crate) handed: u8,
    /// Number of hand-overs since its lane last paused; only with a hostile custodian.
    pub(crate) at_once: u8,
    /// The highest transfer of each service that handed the letter over; 0 for none.
    pub(crate) upstream: [u8; 1 + LIVES as usize],
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub(crate) struct Custodian {
    pub(crate) life: u8,
    /// In rising order of keys.
    pub(crate) held: Vec<Held>,
}

/// The event that ends the pause of a lane early; see [`Lane`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum PauseEnd {
    Credit,
    LowerPredecessor(Key),
}

/// The lane of a service. It pauses only with a hostile custodian: without one, a pause is one of the
/// delays that any step may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Lane {
    pub(crate) pause: Option<PauseEnd>,
    /// Whether a letter was settled since a credit last ended a pause.
    pub(crate) has_settled: bool,
}

/// One registration of the receiver.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub(crate) struct Registration {
    pub(crate) last: u8,
    /// A bit for each letter that was taken.
    pub(crate) taken: u8,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum What {
    /// A copy of the letter.
    Copy {
        after: u8,
    },
    // Answers, which conclude the attempt that they name and no other.
    Accepted,
    OutOfOrder {
        last: u8,
    },
    Busy,
    Refused,
    Gone,
    // Late answers and reports of a custodian.
    Delivered,
    Failed {
        uncertain: bool,
    },
    Returned {
        uncertain: bool,
    },
    /// A note that the predecessor is lower now.
    Predecessor {
        after: u8,
    },
}

#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Message {
    pub(crate) from: Service,
    pub(crate) to: Service,
    pub(crate) key: Key,
    pub(crate) transfer: u8,
    pub(crate) what: What,
}

impl fmt::Debug for Message {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            from,
            to,
            key,
            transfer,
            what,
        } = self;
        write!(f, "{from:?}->{to:?} {key:?} t{transfer} {what:?}")
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct State {
    pub(crate) letters: [Letter; MAX_LETTERS],
    pub(crate) custodians: [Custodian; 2],
    /// The lanes of the sender's process and of the first custodian.
    pub(crate) lanes: [Lane; 2],
    pub(crate) registrations: [Registration; 2],
    /// Whether the receiver was registered again.
    pub(crate) registered_anew: bool,
    /// Whether the old registration has ended. Until then both take letters.
    pub(crate) old_gone: bool,
    /// Whether the sender's directory shows the new registration.
    pub(crate) new_known: bool,
    /// Messages in transit, sorted. Any of them may arrive next.
    pub(crate) network: Vec<Message>,
    pub(crate) faults_left: u8,
    /// Whether a registration took a letter after a later one, or twice.
    pub(crate) out_of_order: bool,
    /// Whether a letter was taken while an earlier one was open and had not been taken.
    pub(crate) passed_over: bool,
}

impl State {
    pub(crate) fn new(letters: usize, faults: u8) -> Self {
        let mut state = Self {
            letters: [Letter {
                outcome: None,
                registration: 0,
                uncertain: false,
                place: Place::Ready,
                handed: 0,
                at_once: 0,
            }; MAX_LETTERS],
            custodians: Default::default(),
            lanes: [Lane {
                pause: None,
                has_settled: true,
            }; 2],
            registrations: Default::default(),
            registered_anew: false,
            old_gone: false,
            new_known: false,
            network: Vec::new(),
            faults_left: faults,
            out_of_order: false,
            passed_over: false,
        };
        for letter in &mut state.letters[letters..] {
            letter.outcome = Some(Outcome::Delivered);
        }
        state
    }

    /// A bit for each letter that any registration has taken.
    pub(crate) fn taken(&self) -> u8 {
        self.registrations[0].taken | self.registrations[1].taken
    }

    /// The sequences from 1 up, with their letters, that have no outcome.
    pub(crate) fn open(&self) -> impl DoubleEndedIterator<Item = (u8, &Letter)> {
        (1..=MAX_LETTERS as u8)
            .zip(&self.letters)
            .filter(|(_, letter)| letter.outcome.is_none())
    }
}
