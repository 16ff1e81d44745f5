//! The [`Transport`] trait, and the [`Sink`] that it reports to.

use std::net::IpAddr;
use std::sync::Arc;

use bytes::Bytes;
use fipa_acl::Letter;

use crate::conclusion::{Abandoned, Answer, Conclusion};
use crate::error::{ListenError, TransportError};
use crate::principal::Principal;
use crate::{Kind, Location, Parcel, Signature, Stream};

/// A transport of letters.
///
/// A transport tries once and reports. It keeps these rules, which the module `conformance` (feature
/// of that name) checks:
///
/// 1. **One conclusion.** Every [`post`](Self::post) that returned `Ok` has exactly one
///    conclusion: by [`Sink::concluded`], or at once by [`abandon`](Self::abandon).
/// 2. **Honest conclusions.** [`Conclusion::NotSent`] and [`Abandoned::NotSent`] mean that no byte
///    of the parcel has reached the other side, and that none will. In doubt, the conclusion is
///    [`Conclusion::Unconfirmed`] or [`Abandoned::Unconfirmed`]. The parcel of an attempt uses at
///    most one connection, and is not sent after the attempt was concluded as not sent.
/// 3. **Answers come from the receiving sink.** `Accepted` is reported only after the receiving
///    sink has returned it; the transport acknowledges nothing on its behalf. The sink gets the
///    parcel of an attempt once. If a copy reaches it all the same, its reaction does not answer the
///    attempt.
/// 4. **Order.** Letters of one stream that are posted to one location arrive in the order of the calls, or do
///    not arrive.
/// 5. **No callback from a call.** The transport does not call a sink from within `post`,
///    `abandon` or `answer`, because the caller may hold its own lock. It may call the sink from
///    within [`drive`](Self::drive) and `listen`.
/// 6. **Bounded.** A parcel without room is returned as an error, and not queued without limit. Letters
///    leave room for other parcels. No memory is allocated according to an unchecked length from outside.
/// 7. **Lazy.** A connection to a location is opened only when a parcel needs it.
/// 8. **Contradictions.** A transport with connections ends one whose peer gives
///    [`Answer::MAX_CONTRADICTIONS`] answers that [contradict](Answer::contradicts) their parcels. The
///    last attempt of them is unconfirmed, the others are answered.
///
/// No method blocks. Methods may be called from any thread.
pub trait Transport: Send + Sync + 'static {
    /// The kind of this transport. Locations of this kind are posted to it.
    fn kind(&self) -> Kind;

    /// Maximum length of a letter in bytes. A longer one fails with [`TransportErrorKind::TooLarge`](crate::TransportErrorKind::TooLarge).
    fn max_letter(&self) -> usize;

    /// Starts to listen and passes all arrivals to `sink`. Called once, before all other methods.
    /// Returns the locations of this endpoint, best first. [`Sink::relocated`] reports changes.
    ///
    /// # Errors
    /// Returns an error if the endpoint cannot be opened. Nothing is left open then.
    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError>;

    /// Sends a parcel to a location, according to the rules above.
    ///
    /// # Errors
    /// Returns an error if the parcel cannot be sent. No conclusion follows then.
    fn post(&self, attempt: AttemptId, to: &Location, parcel: Parcel)
    -> Result<(), TransportError>;

    /// Ends an attempt and concludes it at once: its resources are released, and
    /// [`Sink::concluded`] is not called for it. `to` is the location to which it was posted.
    /// Returns [`Abandoned::Unconfirmed`] for an unknown attempt.
    fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned;

    /// Answers an arrival for which the sink returned [`Reaction::Later`]. Unknown tickets are
    /// ignored, because the peer may have disconnected.
    fn answer(&self, ticket: Ticket, answer: Answer);

    /// The service at this location has announced other locations and no longer this one. A transport with
    /// connections takes another one for later parcels to this service, unless the peer gives a sign of life on
    /// the connection with this location.
    fn location_vacated(&self, location: &Location) {
        let _ = location;
    }

    /// Performs pending work on the calling thread without blocking. Returns whether there was any.
    /// A caller that waits for a letter or an outcome may call this in a short loop before it
    /// sleeps, but need not.
    fn drive(&self) -> bool {
        false
    }

    /// Loans `len` bytes for the content of a letter to `to`. `None` if this transport cannot send
    /// such memory without a copy. `head_room` is the length of everything before the content and
    /// `tail_room` of everything after it, in bytes.
    ///
    /// # Errors
    /// Returns an error if there is no room or the letter is too large.
    fn loan(
        &self,
        to: &Location,
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Result<Option<Box<dyn LoanedContent>>, TransportError> {
        let _ = (to, head_room, len, tail_room);
        Ok(None)
    }

    /// Loans `len` bytes for the content of a letter to several locations. `None` if this transport
    /// would copy it for each location. The content is stored once, as long as any process reads
    /// it. A letter with it to a location of another transport is copied as usual.
    ///
    /// # Errors
    /// Returns an error if there is no room or the content is too large.
    fn loan_for_many(&self, len: usize) -> Result<Option<Box<dyn LoanedContent>>, TransportError> {
        let _ = len;
        Ok(None)
    }

    /// Whether posting this content to several locations makes a copy for each of them that
    /// [`loan_for_many`](Self::loan_for_many) would avoid.
    fn copies_for_each(&self, content: &Bytes) -> bool {
        let _ = content;
        false
    }

    /// Stops listening, concludes every open attempt and releases all resources. Later calls of `post`
    /// fail. May be called repeatedly.
    fn close(&self);
}

/// Loaned memory for the content of a letter.
pub trait LoanedContent: Send {
    /// The writable bytes. Their initial values are arbitrary.
    fn content_mut(&mut self) -> &mut [u8];

    /// Returns the bytes as content of a letter. The transport that loaned them recognizes them in
    /// posting to a location they were loaned for, and copies nothing.
    fn freeze(self: Box<Self>) -> Bytes;
}

/// The origin of a legacy peer's letter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LegacySource {
    /// Remote address of the connection.
    pub address: IpAddr,
    /// The protocol that the sender of the envelope supports. Never [`Signature::Frames`].
    pub signature: Signature,
}

/// The receiver of arrivals and conclusions: the delivery core.
pub trait Sink: Send + Sync {
    /// Handles a parcel that arrived. The reaction determines the answer to the sender.
    fn arrived(&self, arrival: Arrival) -> Reaction;

    /// Handles a letter of a legacy peer, which has no parcel header and gets no answer. The
    /// transport has converted its envelope to the standard dialect; the envelope names the
    /// receiver.
    fn arrived_unframed(&self, letter: Letter, via: Kind, from: LegacySource);

    /// Handles a letter of a legacy peer that the transport has refused for this reason, of which only
    /// the beginning has arrived: its envelope is complete, its message is not.
    fn refused_unframed(&self, letter: Letter, via: Kind, from: LegacySource, reason: &str) {
        let _ = (letter, via, from, reason);
    }

    /// Handles the end of an attempt.
    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion);

    /// Returns memory for the content of a letter of which only the beginning has arrived, if the
    /// letter can be forwarded from there without a copy. The transport then writes the content
    /// directly into it and freezes it. Called only for large content.
    fn memory_for(&self, arriving: &Arriving<'_>) -> Option<Box<dyn LoanedContent>> {
        let _ = arriving;
        None
    }

    /// Returns other known locations of the service at this location. A transport that opens a
    /// connection may race them. Called only when a connection is opened, because it may take
    /// longer than other calls.
    fn also_at(&self, location: &Location) -> Vec<Location> {
        let _ = location;
        Vec::new()
    }

    /// Whether an agent of this host has the name. Other platforms reach such an agent at the addresses of this
    /// service. May read files, so it is not called while a parcel is posted.
    fn is_here(&self, name: &str) -> bool {
        let _ = name;
        false
    }

    /// Replaces the locations of the endpoint that [`listen`](Transport::listen) or an earlier call
    /// gave, best first, after the addresses of this host have changed. May be empty.
    fn relocated(&self, locations: Vec<Location>) {
        let _ = locations;
    }

    /// Whether the peer of a new connection may be the service that it claims to be. `false` if another
    /// principal has proved to be that service: the transport then ends the connection before a parcel
    /// passes in either direction. Called before [`introduced`](Self::introduced).
    fn accepts(&self, peer: &Introduction) -> bool {
        let _ = peer;
        true
    }

    /// A service has introduced itself on a new connection, so parcels can be sent both ways.
    /// Transports without connections do not call this.
    fn introduced(&self, peer: &Introduction) {
        let _ = peer;
    }

    /// The connection on which this service had [introduced](Self::introduced) itself has ended.
    /// Other connections with it may remain: there is one introduction for each connection.
    fn disconnected(&self, peer: &Introduction) {
        let _ = peer;
    }
}

/// A service's description of itself on a new connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Introduction {
    /// Name of the service; not unique.
    pub name: Arc<str>,
    /// Location of the service, with its incarnation.
    pub hop: Hop,
    /// The location that this side connected to. `None` if the other side opened the connection.
    pub dialed: Option<Location>,
    /// The agents that the service may speak for on this connection.
    pub mandate: Mandate,
}

/// The agents that a service may speak for, as far as its link proves it.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Mandate {
    /// The link proves nothing, and restricts nothing.
    #[default]
    Unproved,
    /// The service has the key of a certificate that names these agents. A name that ends with `*`
    /// stands for all names that begin so. An empty list stands for every agent.
    Certified(Arc<[String]>),
    /// The trust in the certificate of the service was withdrawn. The service speaks for no agent.
    Withdrawn,
}

impl Mandate {
    /// Whether the link proves or has proved the agents of the service.
    #[must_use]
    pub fn is_proved(&self) -> bool {
        *self != Self::Unproved
    }

    /// Whether the service may speak for the agent with this name.
    #[must_use]
    pub fn speaks_for(&self, name: &str) -> bool {
        match self {
            Self::Unproved => true,
            Self::Certified(agents) => {
                let mut agents = agents.iter();
                agents.len() == 0 || agents.any(|agent| is_meant(agent, name))
            }
            Self::Withdrawn => false,
        }
    }
}

/// Whether an agent of a certificate is the one with this name, or the beginning of its name.
fn is_meant(agent: &str, name: &str) -> bool {
    match agent.strip_suffix('*') {
        Some(beginning) => name.starts_with(beginning),
        None => agent == name,
    }
}

/// A parcel that arrived.
#[derive(Debug)]
pub struct Arrival {
    /// The parcel.
    pub parcel: Parcel,
    /// The service that handed it over.
    pub from: Hop,
    /// Identifies the arrival in [`Transport::answer`] after [`Reaction::Later`]. `None` if the sink
    /// must answer at once, because the arrival occupies a slot that the transport needs. A delivery
    /// core that does not have the outcome yet then answers [`Answer::Custody`] and sends a report
    /// later.
    pub ticket: Option<Ticket>,
}

/// A letter whose content is about to arrive. Only its lengths have been checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arriving<'a> {
    /// Name of the receiving agent.
    pub receiver: &'a str,
    /// The stream of the letter.
    pub stream: Stream,
    /// Bytes before the content: name, envelope and head of the message.
    pub front: usize,
    /// Bytes of the content.
    pub len: usize,
    /// Bytes after the content.
    pub tail: usize,
}

/// The message transport service that handed a parcel over.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Hop {
    /// Location for reports and credits about the parcel, with the incarnation of the service
    /// there.
    pub location: Location,
    /// The proof of that service's identity.
    pub principal: Principal,
}

impl Hop {
    /// Whether the service may be on another host. False only if the link proves that it is not.
    #[must_use]
    pub fn is_remote(&self) -> bool {
        !matches!(self.principal, Principal::Host | Principal::User(_))
    }
}

/// A sink's reaction to an arrival.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reaction {
    /// Answers at once.
    Now(Answer),
    /// Answers later through [`Transport::answer`]. Not allowed for an arrival without a
    /// [ticket](Arrival::ticket).
    Later,
}

/// Identifies an attempt to post a parcel. Chosen by the caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct AttemptId(pub u64);

/// Identifies an arrival. Chosen by the transport.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Ticket(pub u64);
