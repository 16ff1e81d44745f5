//! The trait that every way of moving a letter implements, and the one it reports to.

use std::fmt;
use std::net::IpAddr;
use std::sync::Arc;

use bytes::Bytes;
use fipa_acl::{Letter, escape};
use serde::Serialize;

use crate::{FailureReason, Kind, Location, Parcel, Signature, Stream};

/// One way of moving letters.
///
/// A transport tries once and reports. It keeps these rules, which [`crate::conformance`] checks:
///
/// 1. **One conclusion.** Every [`dispatch`](Self::dispatch) that returned `Ok` has exactly one
///    conclusion: by [`Sink::concluded`], or at once by [`abandon`](Self::abandon).
/// 2. **Honest conclusions.** [`Conclusion::NotSent`] and [`Abandoned::NotSent`] only when no byte
///    of the parcel has reached the other side, and none ever will. If in doubt,
///    [`Conclusion::Unconfirmed`] and [`Abandoned::Unconfirmed`]. The parcel of one attempt goes
///    over at most one connection, and never after the attempt was concluded as not sent.
/// 3. **An answer is the other sink's answer.** `Accepted` is reported only after the receiving
///    sink said so; nothing is acknowledged on its behalf. It gets the parcel of an attempt once; of
///    a copy that reached it nevertheless, what it says is no answer to the attempt.
/// 4. **Order.** Parcels dispatched to one location arrive in the order of the calls, or do not
///    arrive.
/// 5. **No call-back from a call.** A sink is never called from within `dispatch`, `abandon` or
///    `answer`: the caller may hold its own lock. It may be called from within
///    [`drive`](Self::drive) and `listen`.
/// 6. **Bounded.** A parcel that there is no room for is returned as an error, not queued without
///    limit. No length that came from outside makes memory be taken unchecked.
/// 7. **Lazy.** Nothing is opened to a location before a parcel needs it.
///
/// No method blocks. Methods may be called from any thread.
pub trait Transport: Send + Sync + 'static {
    /// What kind of transport this is: locations of this kind are dispatched here.
    fn kind(&self) -> Kind;

    /// Largest letter, in bytes, that can be carried. A larger one fails with
    /// [`WayFault::TooLarge`].
    fn max_letter(&self) -> usize;

    /// Whether arrivals must be answered at once. A delivery core that cannot tell the outcome
    /// yet then answers [`Answer::Custody`] and sends a report later, so that a slow way behind
    /// it holds no slots of this transport.
    fn answers_at_once(&self) -> bool;

    /// Begins to listen and hands everything that arrives to `sink`. Called once, before anything
    /// else. Returns the locations at which this endpoint can be reached, best first; a change of
    /// them is reported by [`Sink::relocated`].
    ///
    /// # Errors
    /// When the endpoint cannot be opened; nothing is left open then.
    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError>;

    /// Sends a parcel to a location. See the rules above for what follows.
    ///
    /// # Errors
    /// When it is known at once that the parcel does not go; no conclusion follows then.
    fn dispatch(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError>;

    /// Ends an attempt and concludes it at once: its resources are freed, and
    /// [`Sink::concluded`] is not called for it. An unknown attempt is [`Abandoned::Unconfirmed`].
    fn abandon(&self, attempt: AttemptId) -> Abandoned;

    /// Answers an arrival for which the sink had said [`Verdict::Later`]. Unknown tickets are
    /// ignored: the peer may be gone.
    fn answer(&self, ticket: Ticket, answer: Answer);

    /// Does what can be done now without blocking, on the calling thread, and says whether there
    /// was anything. Whoever waits for a letter or an outcome may call this in a short loop
    /// before going to sleep; nobody has to.
    fn drive(&self) -> bool {
        false
    }

    /// Loans `len` bytes in which the content of a letter to `to` can be written in place, when
    /// this transport can later carry those very bytes without a copy. `head_room` is the length
    /// of everything that will stand in front of the content and `tail_room` what will follow it.
    ///
    /// # Errors
    /// When there is no room or the letter is too large.
    fn loan(
        &self,
        to: &Location,
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Result<Option<Box<dyn LoanedContent>>, WayError> {
        let _ = (to, head_room, len, tail_room);
        Ok(None)
    }

    /// Loans `len` bytes for the content of a letter to several locations, when this transport can
    /// carry them to any number of locations without a copy for each. The content is in memory
    /// once, as long as anybody reads it; what is dispatched elsewhere is copied as usual.
    ///
    /// # Errors
    /// When there is no room or the content is too large.
    fn loan_for_many(&self, len: usize) -> Result<Option<Box<dyn LoanedContent>>, WayError> {
        let _ = len;
        Ok(None)
    }

    /// Whether dispatching letters with this content to several locations makes a copy for each
    /// that is worth avoiding by [`loan_for_many`](Self::loan_for_many).
    fn copies_for_each(&self, content: &Bytes) -> bool {
        let _ = content;
        false
    }

    /// Stops listening, gives every outstanding attempt its conclusion and frees everything.
    /// Later dispatches fail. Calling it twice is allowed.
    fn close(&self);
}

/// Memory for the content of a letter, to be filled in place.
pub trait LoanedContent: Send {
    /// The bytes, to be written. They start out as zeros or as anything else.
    fn content_mut(&mut self) -> &mut [u8];

    /// The bytes as content of a letter. The transport that loaned them recognises them when the
    /// letter is dispatched to a location they were loaned for, and copies nothing.
    fn freeze(self: Box<Self>) -> Bytes;
}

/// Where an old peer's letter came from, and what can be sent there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LegacySource {
    /// The address of the connection.
    pub address: IpAddr,
    /// What the writer of the envelope understands. Never [`Signature::Frames`].
    pub signature: Signature,
}

/// Who is told what arrives and what became of attempts: the delivery core.
pub trait Sink: Send + Sync {
    /// A parcel arrived. The verdict is what the sender is told.
    fn arrived(&self, arrival: Arrival) -> Verdict;

    /// An old peer's letter arrived from this source, without a header; it gets no answer. Its
    /// envelope has been brought into the standard dialect; whom it is for stands in there.
    fn arrived_unframed(&self, letter: Letter, via: Kind, from: LegacySource);

    /// An attempt came to its end.
    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion);

    /// Memory for the content of a letter of which only the beginning has arrived, when the letter
    /// can be passed on from there without a copy. The transport then writes what arrives right
    /// into it, and the letter's content is what it freezes to. Asked for large content only.
    fn memory_for(&self, arriving: &Arriving<'_>) -> Option<Box<dyn LoanedContent>> {
        let _ = arriving;
        None
    }

    /// Other locations at which the service of this location is to be found as well, if any are
    /// known: a transport that opens a connection may race them. May take longer than other calls;
    /// asked when a connection is opened only.
    fn also_at(&self, location: &Location) -> Vec<Location> {
        let _ = location;
        Vec::new()
    }

    /// The endpoint is reached at these locations from now on, best first, instead of those that
    /// [`listen`](Transport::listen) or an earlier call gave: the addresses of this host have
    /// changed. There may be none.
    fn relocated(&self, locations: Vec<Location>) {
        let _ = locations;
    }

    /// A service has introduced itself on a connection that was opened: parcels can go both ways
    /// from now on. Transports without connections say nothing; nor need a sink listen.
    fn introduced(&self, peer: &Introduction) {
        let _ = peer;
    }

    /// The connection on which this service had [introduced](Self::introduced) itself is at its
    /// end. There may be another one with it: there were as many introductions as connections.
    fn parted(&self, peer: &Introduction) {
        let _ = peer;
    }
}

/// What a service says of itself when a connection with it has been opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Introduction {
    /// Its name; several may have the same one.
    pub name: Arc<str>,
    /// Where it is, with its incarnation.
    pub hop: Hop,
    /// The location for which this side opened the connection, if this side did.
    pub dialled: Option<Location>,
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
}

impl Mandate {
    /// Whether the link proves the agents of the service.
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
    /// What arrived.
    pub parcel: Parcel,
    /// Who handed it over.
    pub from: Hop,
    /// For [`Transport::answer`], when the verdict is [`Verdict::Later`].
    pub ticket: Ticket,
}

/// A letter whose content is about to arrive. Nothing of it has been checked but the lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arriving<'a> {
    /// The name of the receiving agent.
    pub receiver: &'a str,
    /// Whose order it belongs to.
    pub stream: Stream,
    /// Bytes in front of the content: name, envelope and head of the message.
    pub front: usize,
    /// Bytes of the content.
    pub len: usize,
    /// Bytes behind the content.
    pub tail: usize,
}

/// The message transport service that handed a parcel over.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Hop {
    /// Where to send reports and credits about the parcel, with the incarnation of the service
    /// that is there.
    pub location: Location,
    /// What the link proves about that service.
    pub principal: Principal,
}

impl Hop {
    /// Whether the service is on another host, as far as is proved.
    #[must_use]
    pub fn is_remote(&self) -> bool {
        self.principal != Principal::Host
    }
}

/// What a link proves about the service at its other end. Only this separates two services: what one
/// says of itself does not.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Principal {
    /// It is a process of this user on this host: the link is shared memory or a Unix domain socket, or
    /// loopback where the owner of the host has allowed that.
    Host,
    /// It has the key of the certificate with this SHA-256 fingerprint (of its DER form).
    Certificate([u8; 32]),
    /// Nothing. All services without proof are one.
    Unproved,
}

/// What a sink says about an arrival.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// This is the answer.
    Now(Answer),
    /// The answer follows through [`Transport::answer`]. Not allowed towards a transport that
    /// [answers at once](Transport::answers_at_once).
    Later,
}

/// What the other side says about a parcel.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Answer {
    /// Accepted into the named agent's queue, now or when an earlier copy arrived. Reports and
    /// credits are accepted too.
    Accepted,
    /// Taken for forwarding; a report follows.
    Custody,
    /// There is no room; a credit follows when there is.
    Busy,
    /// The letter that this one comes after has not been taken yet.
    OutOfOrder {
        /// The last letter of the stream that was taken.
        last: u64,
    },
    /// Handed back: the letter's predecessor is not here, so that its sender has to dispatch the
    /// letter again. Not a failure of the way.
    Returned {
        /// Whether an attempt by this service, or by one behind it, may have delivered the letter.
        uncertain: bool,
    },
    /// The receiver's registration that this letter is for was here until a moment ago. Not taken.
    Moved,
    /// Not accepted, finally.
    Failed {
        /// Why.
        reason: FailureReason,
        /// More about it, for people; at most [`Answer::MAX_DETAIL`] bytes are carried.
        detail: String,
    },
}

impl Answer {
    /// How much of a failure's detail is carried, in bytes.
    pub const MAX_DETAIL: usize = 160;

    /// A final refusal.
    pub fn failed(reason: FailureReason, detail: impl Into<String>) -> Self {
        Self::Failed {
            reason,
            detail: detail.into(),
        }
    }
}

/// How an attempt ended that its caller [abandoned](Transport::abandon).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Abandoned {
    /// No byte of the parcel has reached the other side, and none ever will.
    NotSent,
    /// The other side may have the parcel.
    Unconfirmed,
}

impl Abandoned {
    /// The conclusion of the attempt, with this error.
    #[must_use]
    pub fn conclusion(self, error: WayError) -> Conclusion {
        match self {
            Self::NotSent => Conclusion::NotSent(error),
            Self::Unconfirmed => Conclusion::Unconfirmed(error),
        }
    }
}

/// How an attempt ended.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Conclusion {
    /// The other side answered.
    Answered(Answer),
    /// Handed to a peer that cannot answer.
    Handed,
    /// The other side did not get it and never will.
    NotSent(WayError),
    /// The other side may have got it.
    Unconfirmed(WayError),
}

/// Why a way did not work.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error, Serialize)]
#[error("{}{}{}", fault.description(), if detail.is_empty() { "" } else { ": " }, escape(detail))]
pub struct WayError {
    /// What kind of fault it was.
    pub fault: WayFault,
    /// More about it, for people: what the operating system said, and what to do. It may be the text
    /// of a peer; `Display` [escapes](fipa_acl::escape) it.
    pub detail: String,
}

impl WayError {
    /// An error with a detail for people.
    pub fn new(fault: WayFault, detail: impl fmt::Display) -> Self {
        Self {
            fault,
            detail: detail.to_string(),
        }
    }
}

/// The kinds of faults of a way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum WayFault {
    /// Nobody is there, or nothing leads there.
    Unreachable,
    /// Somebody is there, but of another incarnation than expected.
    WrongIncarnation,
    /// The letter is larger than this way takes.
    TooLarge,
    /// The window towards that location is full; what is under way makes room.
    Congested,
    /// The connection broke, or the other process ended, before an answer came.
    Broken,
    /// No answer came in time.
    TimedOut,
    /// The other side speaks another version, or nonsense.
    Incompatible,
    /// The other side does not take it.
    Refused,
    /// This transport has been closed or cannot be used on this machine.
    Closed,
    /// This end has run out of memory, descriptors or disk for this way.
    Exhausted,
    /// The dialect of the peer has no form for something in the letter. No byte was sent.
    Inexpressible,
    /// There is no transport of this kind.
    Unsupported,
}

impl WayFault {
    /// Every fault, for encoding: the position is the code on the wire, so new ones go last.
    pub(crate) const CODES: [Self; 12] = [
        Self::Unreachable,
        Self::WrongIncarnation,
        Self::TooLarge,
        Self::Congested,
        Self::Broken,
        Self::TimedOut,
        Self::Incompatible,
        Self::Refused,
        Self::Closed,
        Self::Exhausted,
        Self::Inexpressible,
        Self::Unsupported,
    ];

    fn description(self) -> &'static str {
        match self {
            Self::Unreachable => "unreachable",
            Self::WrongIncarnation => "another process is there now",
            Self::TooLarge => "too large for this way",
            Self::Congested => "too much under way",
            Self::Broken => "broken off",
            Self::TimedOut => "no answer in time",
            Self::Incompatible => "incompatible",
            Self::Refused => "refused",
            Self::Closed => "closed",
            Self::Exhausted => "no room at this end",
            Self::Inexpressible => "the peer's dialect cannot express it",
            Self::Unsupported => "unsupported transport",
        }
    }
}

/// Why an endpoint could not be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ListenError {
    /// An address could not be listened on.
    #[error("cannot listen on {address}: {source}")]
    Bind {
        /// The address as configured.
        address: String,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// Something the transport needs is missing; the text says what to do.
    #[error("{0}")]
    Unavailable(String),
    /// `listen` was called twice, or after `close`.
    #[error("this endpoint was opened before")]
    OpenedBefore,
}

/// The caller's number for one dispatch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct AttemptId(pub u64);

/// The transport's number for one arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Ticket(pub u64);
