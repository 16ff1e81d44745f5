//! The parcel: one letter for one receiver, or a short note between delivery cores about letters.

use std::sync::Arc;
use std::time::Duration;

use fipa_acl::Letter;

use crate::{Incarnation, Outcome, Principal};

/// The senders whose registrations one holder of a certificate vouches for.
///
/// Other hosts choose the registrations that they announce, and registrations are public. So a registration names
/// an agent only together with the proof of the link on which its letters came to this host: agents of two holders
/// of certificates never share a stream, whatever they announce.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Realm(u64);

impl Realm {
    /// This host, and all hosts that prove nothing.
    pub const UNPROVED: Self = Self(0);

    /// Returns the realm of the senders on a link that proves this identity.
    #[must_use]
    pub fn of(principal: &Principal) -> Self {
        match principal {
            Principal::Certificate([a, b, c, d, e, f, g, h, ..]) => {
                Self(u64::from_le_bytes([*a, *b, *c, *d, *e, *f, *g, *h]).max(1))
            }
            Principal::Host | Principal::User(_) | Principal::Unproved => Self::UNPROVED,
        }
    }

    /// Returns the realm with this number.
    #[must_use]
    pub const fn from_u64(number: u64) -> Self {
        Self(number)
    }

    /// Returns its number: 0, or the first eight bytes of the fingerprint of a certificate, little-endian.
    #[must_use]
    pub const fn as_u64(self) -> u64 {
        self.0
    }
}

/// The pair of registrations, of a sender and of a receiver, within which letters are ordered and
/// deduplicated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Stream {
    /// The realm of the sender. The gateway that receives a letter from another host sets it.
    pub realm: Realm,
    /// The sending agent. [`Incarnation::UNKNOWN`] for letters of legacy peers, which are neither
    /// ordered nor deduplicated.
    pub sender: Incarnation,
    /// The receiving agent.
    pub receiver: Incarnation,
}

impl Stream {
    /// Returns the stream between an agent of this host, or of a host that proves nothing, and a receiver.
    #[must_use]
    pub const fn between(sender: Incarnation, receiver: Incarnation) -> Self {
        Self {
            realm: Realm::UNPROVED,
            sender,
            receiver,
        }
    }
}

/// The unit that a transport carries: the header that delivery requires, and a body.
///
/// A parcel has exactly one receiver. A letter to several receivers is several parcels that share
/// the letter's memory.
#[derive(Debug, Clone, PartialEq)]
pub struct Parcel {
    /// The name of the receiving agent, 1 to [`Parcel::MAX_NAME`] bytes of UTF-8. For a note
    /// ([`Body::Report`], [`Body::Credit`], [`Body::Predecessor`]): the receiver of the letters it
    /// is about.
    pub receiver: Arc<str>,
    /// The stream that the letter belongs to.
    pub stream: Stream,
    /// Position among everything that this registration of the sender sends, from 1. Later letters
    /// of a stream have higher numbers, not necessarily the next one.
    pub sequence: u64,
    /// The letter of the stream that the receiver must have taken before this one, or 0: the
    /// highest lower sequence that was open (without an outcome) in the sender's process when it
    /// dispatched this copy.
    pub after: u64,
    /// Number of the hand-over, chosen by the service that hands the letter over and higher for
    /// each of its hand-overs. A report repeats the number of the latest hand-over of its letter by
    /// the service that the report goes to. 0 in credits.
    pub transfer: u64,
    /// Remaining time until the letter's deadline. Time in transit is not subtracted, because hosts
    /// need not have synchronized clocks.
    pub remaining: Duration,
    /// The letter, or the note about letters.
    pub body: Body,
}

impl Parcel {
    /// Longest name of a receiver, in bytes.
    pub const MAX_NAME: usize = 4096;
}

/// The kinds of parcels.
#[derive(Debug, Clone, PartialEq)]
pub enum Body {
    /// A letter to be delivered.
    Letter(Letter),
    /// The end of a custody, sent to the service that handed the letter over. Stream, sequence and
    /// transfer identify the letter and the hand-over.
    Report(Report),
    /// There is room again for letters of this stream, after [`crate::Answer::Busy`].
    Credit,
    /// The predecessor of the letter with this stream and sequence has changed to a lower one: the
    /// `after` of this parcel. Sent to the service that the letter was handed to, which answers
    /// [`crate::Answer::Accepted`] if it has the letter, [`crate::Answer::Busy`] if it has the letter and the
    /// receiver's queue is full, and [`crate::Answer::Returned`] if it does not have the letter.
    Predecessor,
}

/// The end of the custody of a letter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Report {
    /// The letter has an outcome, which its sender must get, with the attempts made during the
    /// custody.
    Settled(Outcome),
    /// The letter is handed back, because its predecessor is not here. The service forgets it, and
    /// its sender dispatches it again.
    Returned {
        /// Whether an attempt by this service, or by a later one, may have delivered the letter.
        uncertain: bool,
    },
    /// The letter is handed back, because its receiver's registration has left this host. Neither
    /// this service nor a later one has delivered it.
    Moved,
}
