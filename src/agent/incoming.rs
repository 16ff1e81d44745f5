//! A received message.

#[cfg(feature = "protocols")]
use std::sync::Arc;
use std::sync::OnceLock;

use bytes::Bytes;
use fipa_acl::{DecodeError, Letter, Message, MessageIndex, MessageView, Representation};
#[cfg(feature = "protocols")]
use fipa_acl::{Envelope, Performative, Text, Time};
#[cfg(feature = "protocols")]
use fipa_monitor::{Header, Violation};
use fipa_mts::core::Received;
use fipa_mts::stamped_peer;
#[cfg(feature = "protocols")]
use fipa_sds::Entry;
use fipa_transport::{Incarnation, Kind, PeerId};

#[cfg(feature = "protocols")]
use crate::agent::reader_key::ReaderKey;
#[cfg(feature = "opentelemetry")]
use crate::agent::trace_context;
#[cfg(feature = "protocols")]
use crate::domain::directory_view::DirectoryView;

/// A received message.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Incoming {
    /// In a box, because a message moves several times on its way to its reader.
    parts: Box<Parts>,
    /// The transport that handed the letter to this process; `None` for a letter from this
    /// process itself.
    pub via: Option<Kind>,
    #[cfg(feature = "protocols")]
    violation: Option<Box<Violation>>,
    /// The registration of the sending agent, as far as the service that handed the letter over proves
    /// it; unknown for an agent of a legacy peer, and for letters of this process itself.
    pub(crate) sender: Incarnation,
    /// The service that handed the letter over.
    service: Incarnation,
    /// The peer that handed the letter over.
    handed_over_by: PeerId,
    /// The agent that did not get a letter, if this is the proved report of a service about it: see
    /// [`crate::agent::delivery_report`].
    #[cfg(feature = "protocols")]
    pub(crate) undelivered_to: Option<Box<str>>,
    /// The conversation that the message has begun, if it is from the queue of a server.
    #[cfg(feature = "protocols")]
    pub(crate) begun: Option<ReaderKey>,
}

#[derive(Debug, Clone)]
struct Parts {
    letter: Letter,
    /// Of the letter's payload, whose head and tail are private memory of this process.
    index: MessageIndex,
    /// Decoded when the application first reads it.
    message: OnceLock<Box<Message>>,
}

impl Incoming {
    /// Checks the message of a received letter; returns the letter if the message is malformed. The content of a bit-efficient message is not accessed.
    pub(crate) fn new(received: Received) -> Result<Self, Box<(DecodeError, Received)>> {
        let mut received = received;
        let payload = received.letter.payload();
        let is_text = matches!(
            Representation::detect(&payload.head),
            Some(Representation::String | Representation::Xml)
        );
        if is_text && payload.is_split() {
            // Only bit-efficient messages are read in pieces.
            let whole = payload.to_bytes();
            received.letter = Letter::new(received.letter.envelope(), whole);
        }
        let index = match MessageIndex::of(received.letter.payload()) {
            Ok(index) => index,
            Err(error) => return Err(Box::new((error, received))),
        };
        Ok(Self {
            parts: Box::new(Parts {
                letter: received.letter,
                index,
                message: OnceLock::new(),
            }),
            sender: received.sender,
            service: received.service,
            handed_over_by: received.peer,
            via: received.via,
            #[cfg(feature = "protocols")]
            violation: None,
            #[cfg(feature = "protocols")]
            undelivered_to: None,
            #[cfg(feature = "protocols")]
            begun: None,
        })
    }

    /// Returns the message, and decodes it on the first call. [`view`](Self::view) and
    /// [`content`](Self::content) read parts of it without decoding all.
    ///
    /// Its content may be in shared memory of the sender: it stays readable as long as this value or a
    /// clone of the content exists, but another process of the same user can change it.
    #[must_use]
    pub fn message(&self) -> &Message {
        let Parts {
            letter,
            index,
            message,
        } = &*self.parts;
        message.get_or_init(|| Box::new(index.to_message(letter.payload())))
    }

    /// Returns the message by value.
    #[must_use]
    pub fn into_message(self) -> Message {
        let Parts {
            letter,
            index,
            message,
        } = *self.parts;
        match message.into_inner() {
            Some(message) => *message,
            None => index.to_message(letter.payload()),
        }
    }

    /// Returns the parameters of the message without decoding it. The message was checked when it
    /// arrived, and is not checked again.
    #[must_use]
    pub fn view(&self) -> MessageView<'_> {
        self.parts.index.view(self.parts.letter.payload())
    }

    /// Returns the content of the message without decoding the other parameters. As of
    /// [`message`](Self::message), it may be in shared memory of the sender.
    #[must_use]
    pub fn content(&self) -> Option<Bytes> {
        self.parts.index.content(self.parts.letter.payload())
    }

    /// Returns the peer that sent the letter to this host, as far as the service that received it proves it. The agents
    /// of legacy peers count as one, if the gateway of this host has handed the letter over.
    pub(crate) fn peer(&self) -> PeerId {
        if self.via.is_none() || !self.handed_over_by.is_this_host() {
            return self.handed_over_by.clone();
        }
        if self.sender == self.service {
            return PeerId::unknown();
        }
        // A letter of an agent of this host has no stamp of the process that hands it over.
        stamped_peer(&self.parts.letter, self.service).unwrap_or_default()
    }

    /// Returns the entry of the agent that sent the message, as far as its connection proves the agent. On a miss,
    /// the files of the domain are read.
    #[cfg(feature = "protocols")]
    pub(crate) fn registered(&self, directory: DirectoryView<'_>) -> Option<Arc<Entry>> {
        let view = self.view();
        let name = view.sender().map(|sender| sender.name());
        let name = name.as_ref().map(|name| name.as_str());
        directory.sender(self.sender, &name.unwrap_or_default(), &self.peer())
    }

    /// Returns the number of bytes of the letter.
    pub(crate) fn bytes(&self) -> usize {
        self.parts.letter.len()
    }

    /// Returns the parameters that a check of the protocol reads.
    ///
    /// A `reply-by` is relative to the date of the envelope, if the letter has one: both come from the clock of
    /// the sender, which may differ from that of this host (FIPA00061 2.11 and FIPA00067 3.2 require no
    /// common clock). The time to answer begins when the message is checked.
    #[cfg(feature = "protocols")]
    pub(crate) fn header(&self) -> Header<'_> {
        let mut header = Header::from(&self.view());
        if let Some(agent) = self.undelivered_to.as_deref() {
            header = header.undelivered_to(agent);
        }
        match self.time_to_answer() {
            Some(by) => header.reply_by(by),
            None => header,
        }
    }

    /// Returns the time by which an answer is due, relative to the sending of the message.
    #[cfg(feature = "protocols")]
    fn time_to_answer(&self) -> Option<Time> {
        let by = self.view().reply_by()?;
        let (envelope, _) = Envelope::decode(&self.parts.letter.envelope()).ok()?;
        Time::after(by.span_since(envelope.effective().date?)?).ok()
    }

    /// Whether the message has this communicative act of the standard.
    #[cfg(feature = "protocols")]
    pub(crate) fn is(&self, performative: &Performative) -> bool {
        self.parts.index.is(performative)
    }

    /// Returns the conversation identifier without a view of the other parameters.
    #[cfg(feature = "protocols")]
    pub(crate) fn conversation_id(&self) -> Option<Text<'_>> {
        self.parts
            .index
            .conversation_id(self.parts.letter.payload())
    }

    /// Returns the protocol without a view of the other parameters.
    #[cfg(feature = "protocols")]
    pub(crate) fn protocol(&self) -> Option<Text<'_>> {
        self.parts.index.protocol(self.parts.letter.payload())
    }

    /// Returns the ontology without a view of the other parameters.
    #[cfg(feature = "protocols")]
    pub(crate) fn ontology(&self) -> Option<Text<'_>> {
        self.parts.index.ontology(self.parts.letter.payload())
    }

    /// Returns the letter that carried the message.
    #[must_use]
    pub fn letter(&self) -> &Letter {
        &self.parts.letter
    }

    /// Returns an OpenTelemetry context whose span is the remote one in which the message was sent (feature
    /// `opentelemetry`). Without such a span, the context has none. A span that is started with this context, or whose
    /// parent it becomes, is a child of the sender's span:
    ///
    /// ```no_run
    /// # async fn example(arm: fipa::Agent) -> Result<(), fipa::error::ReceiveError> {
    /// use opentelemetry::{global, trace::Tracer};
    ///
    /// let incoming = arm.receive().await?;
    /// let tracer = global::tracer("arm");
    /// let span = tracer.start_with_context("handle", &incoming.trace_context());
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// The sender states the span, and its host is all that keys prove. See [traces](crate#traces).
    #[cfg(feature = "opentelemetry")]
    #[must_use]
    pub fn trace_context(&self) -> opentelemetry::Context {
        trace_context::of(&self.parts.letter)
    }

    /// Returns the violation of the message's protocol, if there is one and `monitor.check` is `warn`
    /// or `enforce`.
    ///
    /// The agent that sent the message has made the mistake, and the receiving agent goes on. An
    /// application that acts on messages must not act on such a message.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), fipa::error::ReceiveError> {
    /// loop {
    ///     let incoming = agent.receive().await?;
    ///     if let Some(violation) = incoming.violation() {
    ///         eprintln!("ignored: {violation}");
    ///         continue;
    ///     }
    ///     println!("{}", incoming.message());
    /// }
    /// # }
    /// ```
    #[cfg(feature = "protocols")]
    #[must_use]
    pub fn violation(&self) -> Option<&Violation> {
        self.violation.as_deref()
    }

    #[cfg(feature = "protocols")]
    pub(crate) fn violates(&mut self, violation: Box<Violation>) {
        self.violation = Some(violation);
    }

    #[cfg(feature = "protocols")]
    pub(crate) fn take_violation(&mut self) -> Option<Box<Violation>> {
        self.violation.take()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::time::SystemTime;

    use allocation_counter::measure;
    use fipa_acl::{AgentId, Dialect, Payload, Performative};
    use fipa_mts::letter_for;
    use fipa_transport::Incarnation;

    use super::*;

    fn message() -> Message {
        Message::builder(Performative::Request)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .protocol("fipa-request")
            .conversation_id("c")
            .reply_with("w")
            .content(vec![7; 100])
            .build()
            .unwrap()
    }

    fn received(letter: Letter) -> Received {
        Received {
            letter,
            sender: Incarnation::from_u64(1),
            via: Some(Kind::Shm),
            service: Incarnation::from_u64(2),
            peer: PeerId::THIS_HOST,
            remote: false,
        }
    }

    #[test]
    fn a_message_is_decoded_once_on_first_use() {
        let message = message();
        let letter = letter_for(&message, SystemTime::UNIX_EPOCH).unwrap();
        let received = received(letter);
        let mut incoming = None;
        let taken = measure(|| incoming = Some(Incoming::new(received).unwrap()));
        let incoming = incoming.unwrap();
        let viewed = measure(|| {
            assert_eq!(incoming.content().unwrap(), vec![7; 100][..]);
        });
        let read = measure(|| {
            let view = incoming.view();
            assert_eq!(view.conversation_id().unwrap(), "c");
            assert_eq!(view.sender().unwrap().name(), "rover");
            assert_eq!(view.performative(), Performative::Request);
        });
        // The box of the message.
        assert_eq!((taken.count_total, read.count_total), (1, 0));
        // The vector of the comparison.
        assert_eq!(viewed.count_total, 1);
        let decoded = measure(|| assert_eq!(incoming.message().protocol(), Some("fipa-request")));
        assert!(decoded.count_total > 1);
        let again = measure(|| assert_eq!(incoming.message().sender().unwrap().name(), "rover"));
        assert_eq!(again.count_total, 0);
        assert_eq!(*incoming.message(), message);
        assert_eq!(incoming.into_message(), message);
    }

    #[test]
    fn a_message_in_the_string_encoding_is_read_also_if_its_letter_is_split() {
        let message = message();
        let text = message
            .encode(Representation::String, Dialect::Standard)
            .unwrap();
        let payload = Payload {
            head: text.slice(..20),
            content: text.slice(20..40),
            tail: text.slice(40..),
        };
        let incoming = Incoming::new(received(Letter::new(Bytes::new(), payload))).unwrap();
        assert_eq!(*incoming.message(), message);
        assert_eq!(incoming.content().as_ref(), message.content());
    }

    #[test]
    fn a_letter_without_a_message_is_returned() {
        let letter = Letter::new(Bytes::new(), Bytes::from_static(b"\xfa\x10\x0c"));
        let (_, returned) = *Incoming::new(received(letter.clone())).unwrap_err();
        assert_eq!(returned.letter, letter);
    }
}
