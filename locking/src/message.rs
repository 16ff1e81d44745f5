//! The messages of the core. [`codec`](crate::codec) has their form as ACL messages.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::Arc;

use crate::{Algorithm, Conversation, Fence, Millis, Resource};

/// A message between the cores of two agents.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LockMessage {
    /// The conversation. An answer has that of the message it answers.
    pub conversation: Conversation,
    /// LockDialect of the sender.
    pub dialect: LockDialect,
    /// MutualExclusion of an act that belongs to one, or the one that an owner names with [`Act::Owned`]. `None` for
    /// other acts, and for that of the resource.
    pub algorithm: Option<Algorithm>,
    /// Content of the message.
    pub content: Content,
}

/// Implementation of an agent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[allow(
    clippy::exhaustive_enums,
    reason = "an agent requests grants, or it does not"
)]
pub enum LockDialect {
    /// This library: the agent requests a grant with a fence.
    Own,
    /// `distributed_locking`, or an unknown implementation: the agent requests no fence.
    Legacy,
}

/// Content of a message.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[allow(clippy::exhaustive_enums, reason = "a wire format")]
pub enum Content {
    /// Request for a sign of life (protocol `dlm_probe`).
    Probe,
    /// Answer to [`Probe`](Self::Probe).
    Alive,
    /// A message about one resource.
    Lock {
        /// The resource.
        resource: Resource,
        /// The act.
        act: Act,
    },
}

/// Act of a message about a resource.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[allow(clippy::exhaustive_enums, reason = "a wire format")]
pub enum Act {
    /// Asks for the owner of the resource (protocol `dlm_discover`).
    Query {
        /// Whether the sender begins to own the resource unless it gets an answer.
        claim: bool,
    },
    /// The sender owns the resource.
    Owned,
    /// The receiver must not own the resource, because the sender does.
    Contested,
    /// The sender, or a device of it, has seen this fence of the receiver.
    Seen {
        /// The highest fence that was seen.
        fence: Fence,
    },
    /// Owner's queue: asks the owner for a grant.
    Ask {
        /// Time of sending, by the clock of the sender. The answer repeats it.
        asked: Millis,
        /// Place in the queue of the owner's life before.
        place: Option<u32>,
    },
    /// Owner's queue: place of the request of this conversation. The next one has place 1.
    Place {
        /// The place: 1 to [`MAX_PLACE`](crate::MAX_PLACE).
        place: u32,
    },
    /// Ricart-Agrawala: asks for permission to enter.
    Request {
        /// Lamport clock of the request. Lower clocks, then lower agents, enter first.
        clock: u64,
    },
    /// Ricart-Agrawala: permission to enter, for the request of this conversation.
    Agree {
        /// Lamport clock of the sender.
        clock: u64,
    },
    /// Suzuki-Kasami: asks for the token.
    RequestToken {
        /// Number of the request among those of its sender.
        number: u64,
    },
    /// Suzuki-Kasami: the token.
    Token(Token),
    /// Reports to the owner that the sender has entered. `Own` agents ask for a grant with it.
    Confirm {
        /// Time of sending, by the clock of the sender. The answer repeats it.
        asked: Option<Millis>,
    },
    /// Asks the owner to extend a grant.
    Renew {
        /// Fence of the grant.
        fence: Fence,
        /// Time of sending, by the clock of the sender. The answer repeats it.
        asked: Millis,
    },
    /// The owner's grant, or its extension.
    Granted {
        /// The fence.
        fence: Fence,
        /// Lease.
        lease: Millis,
        /// Time of sending of the request that this message answers.
        asked: Millis,
    },
    /// The owner refuses a grant or an extension.
    Refused {
        /// The reason.
        reason: Refusal,
        /// Time of sending of the request that this message answers.
        asked: Millis,
    },
    /// Reports to the owner that the sender has left, or has withdrawn its request.
    Release,
}

/// Reason of a refusal by an owner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Refusal {
    /// The grant has expired, was released, or never existed.
    NotLive,
    /// The request was released or withdrawn before.
    Closed,
    /// The receiver does not own the resource.
    NotOwner,
    /// The agents that use the resource use this algorithm.
    Algorithm(Algorithm),
}

impl Refusal {
    pub(crate) const ALL: [Self; 8] = [
        Self::NotLive,
        Self::Closed,
        Self::NotOwner,
        Self::Algorithm(Algorithm::OwnerQueue),
        Self::Algorithm(Algorithm::RicartAgrawala),
        Self::Algorithm(Algorithm::RicartAgrawalaExtended),
        Self::Algorithm(Algorithm::SuzukiKasami),
        Self::Algorithm(Algorithm::SuzukiKasamiExtended),
    ];

    /// Words in a message.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::NotLive => "not-live",
            Self::Closed => "closed",
            Self::NotOwner => "not-owner",
            Self::Algorithm(Algorithm::OwnerQueue) => "algorithm owner_queue",
            Self::Algorithm(Algorithm::RicartAgrawala) => "algorithm ricart_agrawala",
            Self::Algorithm(Algorithm::RicartAgrawalaExtended) => {
                "algorithm ricart_agrawala_extended"
            }
            Self::Algorithm(Algorithm::SuzukiKasami) => "algorithm suzuki_kasami",
            Self::Algorithm(Algorithm::SuzukiKasamiExtended) => "algorithm suzuki_kasami_extended",
        }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Algorithm(kind) => return write!(f, "the resource uses the algorithm {kind}"),
            Self::NotLive => "the grant is not live",
            Self::Closed => "the request was released or withdrawn before",
            Self::NotOwner => "the agent does not own the resource",
        })
    }
}

/// The token of Suzuki-Kasami.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct Token {
    /// Generation: the owner raises it when it replaces a lost token. `None` in a token that a legacy
    /// agent wrote.
    pub generation: Option<u64>,
    /// Number of the last request of each agent that was served.
    pub last: BTreeMap<Arc<str>, u64>,
    /// Agents that get the token next.
    pub queue: VecDeque<Arc<str>>,
    /// Version of the Boost archive, when a legacy agent takes part.
    pub archive: Option<u16>,
}
