//! The parts of an arriving letter that the core decides about. Reading them takes time in proportion
//! to the bytes of the letter, so the runtime does it before it locks the core.

use std::fmt;
use std::sync::Arc;

use fipa_acl::{DecodeError, Letter};
use fipa_transport::{Arrival, Body, Incarnation};

use super::{CoreConfig, work};
use crate::stamp::{self, EnvelopeParts};
use crate::{AccessGate, LetterParts};

/// Maximum length of an arriving letter without its content, in bytes: that of a letter that is sent,
/// and room for the stamps of the gateways on its path. A gateway copies these bytes while its core is
/// locked.
const MAX_AROUND: usize = Letter::MAX_AROUND + (64 << 10);

/// Returns the reason why an arriving letter is refused unread, if it is.
pub(super) fn too_long(letter: &Letter) -> Option<String> {
    let len = letter.around_len();
    (len > MAX_AROUND).then(|| {
        format!(
            "the letter has {len} bytes besides its content, and at most {MAX_AROUND} are allowed"
        )
    })
}

/// Reads arriving letters for one core.
#[derive(Clone)]
pub struct LetterReader {
    name: Arc<str>,
    incarnation: Incarnation,
    forwards: bool,
    pub(super) gate: Option<Arc<dyn AccessGate>>,
}

/// A letter that was read.
#[derive(Debug)]
pub struct ReadLetter {
    /// The parts for the gate; `None` without a gate.
    pub(super) parts: Option<LetterParts>,
    /// The parts for forwarding; `None` in a service that does not forward.
    pub(super) envelope: Option<Result<EnvelopeParts, DecodeError>>,
}

impl fmt::Debug for LetterReader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("LetterReader").finish_non_exhaustive()
    }
}

impl LetterReader {
    pub(super) fn new(config: &CoreConfig) -> Self {
        Self {
            name: Arc::clone(&config.name),
            incarnation: config.incarnation,
            forwards: config.forwards,
            gate: None,
        }
    }

    /// Reads the letter of this arrival, if it has one. Returns `None` where no part is needed, in a
    /// process without a gate, and for a letter that the core refuses for its length.
    #[must_use]
    pub fn read_arrival(&self, arrival: &Arrival) -> Option<Box<ReadLetter>> {
        match &arrival.parcel.body {
            Body::Letter(letter) => self.read(letter),
            _ => None,
        }
    }

    pub(super) fn read(&self, letter: &Letter) -> Option<Box<ReadLetter>> {
        if (self.gate.is_none() && !self.forwards) || too_long(letter).is_some() {
            return None;
        }
        work::steps(letter.len() / 512);
        Some(Box::new(ReadLetter {
            parts: self.parts(letter),
            envelope: self
                .forwards
                .then(|| stamp::read(letter, &self.name, self.incarnation)),
        }))
    }

    /// Has the gate read a letter, if there is one.
    pub(super) fn parts(&self, letter: &Letter) -> Option<LetterParts> {
        self.gate.as_ref().map(|gate| gate.read(letter))
    }
}
