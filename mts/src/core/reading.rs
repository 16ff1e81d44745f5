//! The parts of an arriving letter that the core decides about. Reading them takes time in proportion
//! to the bytes of the letter, so the runtime does it before it locks the core.

use std::fmt;
use std::sync::Arc;

use fipa_acl::{DecodeError, EnvelopeView, Letter, Message, MessageView, Payload, Representation};
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

/// Returns the reason why a letter is refused for a name in it, if it is: no agent has a name with control
/// characters or invisible ones, and rules, logs and programs need not expect one. Decoders accept such
/// names, because recordings have them.
fn refused_name(letter: &Letter, envelope: Option<&EnvelopeView>) -> Option<String> {
    let envelope = envelope.iter().flat_map(|envelope| {
        let receivers = envelope.receivers();
        envelope.from_name().into_iter().chain(receivers)
    });
    // A text is read as a whole, as its receiver does. Only bit-efficient messages are read in pieces.
    let payload = letter.payload();
    let is_text = matches!(
        Representation::detect(&payload.head),
        Some(Representation::String | Representation::Xml)
    );
    let whole = (is_text && payload.is_split()).then(|| Payload::from(payload.to_bytes()));
    let message = MessageView::parse_payload(whole.as_ref().unwrap_or(payload)).ok();
    let message = message.iter().flat_map(|message| {
        let sender = message.sender().into_iter();
        let agents = sender.chain(message.receivers()).chain(message.reply_to());
        agents.map(|agent| agent.name())
    });
    let mut names = envelope.chain(message);
    names.find_map(|name| name_fault(&name.as_str()))
}

/// Returns the reason why the letter of a legacy peer is refused for a name in it, if it is. `names` are
/// those of its envelope.
pub(super) fn refused_name_of_legacy_peer<'a>(
    message: &'a Message,
    names: impl IntoIterator<Item = &'a str>,
) -> Option<String> {
    let agents = message.sender().into_iter();
    let agents = agents.chain(message.receivers()).chain(message.reply_to());
    let mut names = names.into_iter().chain(agents.map(|agent| agent.name()));
    names.find_map(name_fault)
}

fn name_fault(name: &str) -> Option<String> {
    let error = fipa_sds::check_characters(name).err()?;
    Some(format!("the letter is refused for a name in it: {error}"))
}

/// Reads arriving letters for one core.
#[derive(Clone)]
pub struct LetterReader {
    name: Arc<str>,
    incarnation: Incarnation,
    forwards: bool,
    /// The gate, which may be inactive; see [`gate`](Self::gate).
    pub(super) set_gate: Option<Arc<dyn AccessGate>>,
}

/// A letter that was read.
#[derive(Debug)]
pub struct ReadLetter {
    /// The reason why the letter is refused, if it is.
    pub(super) fault: Option<String>,
    /// The parts for the gate; `None` without a gate.
    pub(super) parts: Option<LetterParts>,
    /// The parts for forwarding; `None` in a service that does not forward.
    pub(super) envelope: Option<Result<EnvelopeParts, DecodeError>>,
}

impl ReadLetter {
    /// Returns the name of the sender in the envelope.
    pub(super) fn sender_name(&self) -> Option<&str> {
        self.envelope.as_ref()?.as_ref().ok()?.sender.as_deref()
    }
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
            set_gate: None,
        }
    }

    /// Reads the letter of this arrival, if it has one. Returns `None` where no part is needed, which is
    /// in a process without a gate for a letter of this host, and for a letter that the core refuses for
    /// its length.
    #[must_use]
    pub fn read_arrival(&self, arrival: &Arrival) -> Option<Box<ReadLetter>> {
        match &arrival.parcel.body {
            Body::Letter(letter) => self.read(letter, arrival.from.is_remote()),
            _ => None,
        }
    }

    fn read(&self, letter: &Letter, is_remote: bool) -> Option<Box<ReadLetter>> {
        let is_needed = self.gate().is_some() || self.forwards || is_remote;
        if !is_needed || too_long(letter).is_some() {
            return None;
        }
        work::steps(letter.len() / 512);
        let envelope = letter.envelope();
        let envelope = EnvelopeView::parse(&envelope);
        Some(Box::new(ReadLetter {
            fault: refused_name(letter, envelope.as_ref().ok()),
            parts: self.parts(letter),
            envelope: self
                .forwards
                .then(|| envelope.map(|it| stamp::read(&it, &self.name, self.incarnation))),
        }))
    }

    /// Has the gate read a letter, if there is one.
    pub(super) fn parts(&self, letter: &Letter) -> Option<LetterParts> {
        self.gate().map(|gate| gate.read(letter))
    }

    /// Reads a letter that was read while the gate was inactive again if the gate is active now.
    #[inline]
    pub(super) fn completed(
        &self,
        read: Option<Box<ReadLetter>>,
        letter: &Letter,
        is_remote: bool,
    ) -> Option<Box<ReadLetter>> {
        let is_complete = read.as_ref().is_some_and(|read| read.parts.is_some());
        if is_complete || self.gate().is_none() {
            return read;
        }
        self.read(letter, is_remote)
    }

    /// Returns the gate while it is active.
    #[inline]
    pub(super) fn gate(&self) -> Option<&dyn AccessGate> {
        self.set_gate.as_deref().filter(|gate| gate.is_active())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::{Instant, SystemTime};

    use fipa_acl::{AgentId, Performative};

    use super::*;
    use crate::Link;

    struct Switched(AtomicBool);

    impl AccessGate for Switched {
        fn is_active(&self) -> bool {
            self.0.load(Ordering::Relaxed)
        }

        fn read(&self, _letter: &Letter) -> LetterParts {
            LetterParts::default()
        }

        fn admits(
            &self,
            _now: Instant,
            _receiver: &str,
            _letter: &LetterParts,
            _link: Link,
        ) -> Result<(), String> {
            Ok(())
        }
    }

    #[test]
    fn a_letter_that_was_read_without_an_active_gate_is_read_again() {
        let gate = Arc::new(Switched(AtomicBool::new(false)));
        let config = CoreConfig::new("mts", Incarnation::from_u64(1), Vec::new());
        let mut reader = LetterReader::new(&config);
        reader.set_gate = Some(Arc::clone(&gate) as Arc<dyn AccessGate>);
        let agent = |name| AgentId::new(name).unwrap();
        let message = Message::builder(Performative::Inform)
            .sender(agent("rover"))
            .receiver(agent("arm"));
        let letter = crate::letter_for(&message.build().unwrap(), SystemTime::UNIX_EPOCH).unwrap();
        assert!(reader.read(&letter, false).is_none());
        assert!(reader.completed(None, &letter, false).is_none());
        gate.0.store(true, Ordering::Relaxed);
        let read = reader.completed(None, &letter, false).unwrap();
        assert!(read.parts.is_some());
    }
}
