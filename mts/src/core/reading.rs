//! The parts of an arriving letter that the core decides about. Reading them takes time in proportion
//! to the bytes of the letter, so the runtime does it before it locks the core.

use std::fmt;
use std::sync::Arc;

use fipa_acl::{DecodeError, Letter};
use fipa_transport::{Arrival, Body, Incarnation};

use super::{CoreConfig, work};
use crate::stamp::{self, EnvelopeParts};
use crate::{AccessGate, LetterParts};

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
    /// process without a gate.
    #[must_use]
    pub fn read_arrival(&self, arrival: &Arrival) -> Option<Box<ReadLetter>> {
        match &arrival.parcel.body {
            Body::Letter(letter) => self.read(letter),
            _ => None,
        }
    }

    pub(super) fn read(&self, letter: &Letter) -> Option<Box<ReadLetter>> {
        if self.gate.is_none() && !self.forwards {
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
