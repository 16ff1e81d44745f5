//! The algorithms that decide which agent the owner serves next.

mod owner_queue;
mod ricart_agrawala;
mod suzuki_kasami;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::hash::Hash;

pub use owner_queue::OwnerQueue;
pub use ricart_agrawala::RicartAgrawala;
pub use suzuki_kasami::SuzukiKasami;

use crate::faults::Fault;
use crate::{Act, Conversation, LockDialect, LockPeer, Millis};

/// The algorithms. All agents that use a resource use the one that its owner names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
#[allow(
    clippy::exhaustive_enums,
    reason = "the owner's queue, and the protocols of distributed_locking"
)]
pub enum Algorithm {
    /// The owner serves requests in the order of their arrival. Agents of `distributed_locking` cannot take
    /// part.
    #[default]
    OwnerQueue,
    /// Ricart-Agrawala for members and messages that are never lost.
    RicartAgrawala,
    /// Ricart-Agrawala with probes and repeated requests.
    RicartAgrawalaExtended,
    /// Suzuki-Kasami for members and messages that are never lost. An agent that is deregistered takes
    /// the token with it.
    SuzukiKasami,
    /// Suzuki-Kasami with probes and repeated requests. The token returns to the owner, which replaces
    /// it when it is lost.
    SuzukiKasamiExtended,
}

impl Algorithm {
    /// All algorithms.
    pub const ALL: [Self; 5] = [
        Self::OwnerQueue,
        Self::RicartAgrawala,
        Self::RicartAgrawalaExtended,
        Self::SuzukiKasami,
        Self::SuzukiKasamiExtended,
    ];

    /// Name of the protocol in messages.
    #[must_use]
    pub fn protocol(self) -> &'static str {
        match self {
            Self::OwnerQueue => "owner_queue",
            Self::RicartAgrawala => "ricart_agrawala",
            Self::RicartAgrawalaExtended => "ricart_agrawala_extended",
            Self::SuzukiKasami => "suzuki_kasami",
            Self::SuzukiKasamiExtended => "suzuki_kasami_extended",
        }
    }

    /// Returns the algorithm whose protocol has this name.
    #[must_use]
    pub fn named(protocol: &str) -> Option<Self> {
        let mut all = Self::ALL.into_iter();
        all.find(|kind| kind.protocol() == protocol)
    }

    /// Whether the algorithm uses a token.
    #[must_use]
    pub fn has_token(self) -> bool {
        matches!(self, Self::SuzukiKasami | Self::SuzukiKasamiExtended)
    }

    /// Whether each member asks all others for permission.
    #[must_use]
    pub fn needs_permission(self) -> bool {
        matches!(self, Self::RicartAgrawala | Self::RicartAgrawalaExtended)
    }

    /// Whether the algorithm tolerates the loss of members and of messages.
    #[must_use]
    pub fn is_extended(self) -> bool {
        matches!(
            self,
            Self::OwnerQueue | Self::RicartAgrawalaExtended | Self::SuzukiKasamiExtended
        )
    }
}

impl fmt::Display for Algorithm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.protocol())
    }
}

/// Agents that the owner of a resource lets pass: the owner of a live grant takes part in the
/// algorithm as if it had entered itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[allow(clippy::exhaustive_enums, reason = "all combinations that occur")]
pub enum OwnerGate {
    /// All agents. It is always open at an agent that does not own the resource.
    #[default]
    Open,
    /// `Own` agents only: an expired holder may still use the resource, and a legacy agent has no fence
    /// that tells the resource so.
    Own,
    /// No agent: a grant is live.
    Closed,
}

impl OwnerGate {
    /// Whether an agent may pass.
    #[must_use]
    pub fn lets_pass(self, dialect: LockDialect) -> bool {
        match self {
            Self::Open => true,
            Self::Own => dialect == LockDialect::Own,
            Self::Closed => false,
        }
    }
}

/// Member of a group.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Member {
    /// Implementation of the member.
    pub dialect: LockDialect,
    /// Whether it has not answered the last probes. Requests do not wait for it.
    pub suspected: bool,
}

/// State around an algorithm.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a> {
    /// The current time.
    pub now: Millis,
    /// The other members.
    pub members: &'a BTreeMap<LockPeer, Member>,
    /// Owner of the resource, if it is known.
    pub owner: Option<&'a LockPeer>,
    /// Agents that this agent lets pass.
    pub gate: OwnerGate,
    /// Lease of a grant.
    pub lease: Millis,
    /// Time after which a request without an answer is repeated.
    pub retry: Millis,
    /// Highest clock of the requests that were answered while there was no state for their resource.
    pub clock: u64,
    pub(crate) fault: Fault,
}

impl Context<'_> {
    fn dialect(&self, peer: &LockPeer) -> LockDialect {
        self.members
            .get(peer)
            .map_or(LockDialect::Legacy, |member| member.dialect)
    }

    /// Whether a request to an agent is repeated. Agents of `distributed_locking` treat a second request
    /// in a conversation as an error; their letters are not lost while they run.
    fn accepts_repetition(&self, peer: &LockPeer) -> bool {
        self.dialect(peer) == LockDialect::Own
    }
}

/// Result of a call of an algorithm.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(
    clippy::exhaustive_enums,
    reason = "the caller has to perform each step"
)]
pub enum Step {
    /// Send a message.
    Send {
        /// The receiver.
        to: LockPeer,
        /// The conversation.
        conversation: Conversation,
        /// The act.
        act: Act,
    },
    /// The request of this agent has entered.
    Entered,
    /// End the request of this agent, and begin it again in another conversation.
    Again,
}

/// A distributed algorithm at one agent, for one resource.
///
/// An agent has at most one open request: from [`request`](Self::request) to [`leave`](Self::leave).
pub trait MutualExclusion: Clone + Eq + Hash + fmt::Debug {
    /// Creates the state of an agent that has neither sent nor received a message.
    ///
    /// `owns` is whether the agent owns the resource: it then has the token.
    fn new(kind: Algorithm, me: LockPeer, owns: bool) -> Self;

    /// Begins a request.
    fn request(&mut self, context: &Context<'_>, conversation: &Conversation, out: &mut Vec<Step>);

    /// Ends the request of this agent, entered or not, and lets the next agent enter.
    fn leave(&mut self, context: &Context<'_>, out: &mut Vec<Step>);

    /// Handles a message of another agent. Acts of other algorithms are ignored.
    fn handle(
        &mut self,
        context: &Context<'_>,
        from: &LockPeer,
        conversation: &Conversation,
        act: &Act,
        out: &mut Vec<Step>,
    );

    /// Lets waiting agents enter after the gate has changed.
    fn gate_changed(&mut self, context: &Context<'_>, out: &mut Vec<Step>);

    /// At the owner: the grant to `holder` has ended. [`gate_changed`](Self::gate_changed) follows.
    fn grant_ended(&mut self, holder: &LockPeer);

    /// This agent begins to own the resource.
    fn own(&mut self, context: &Context<'_>, out: &mut Vec<Step>);

    /// Another agent owns the resource, or the owner has another registration.
    fn owner_changed(&mut self);

    /// An agent joins the group. It is a member already.
    fn joined(&mut self, context: &Context<'_>, peer: &LockPeer, out: &mut Vec<Step>);

    /// An agent is left out: it left or crashed (`gone`), or it does not answer.
    fn lost(&mut self, context: &Context<'_>, peer: &LockPeer, gone: bool, out: &mut Vec<Step>);

    /// Repeats the open request. Basic algorithms repeat nothing.
    fn repeat(&mut self, context: &Context<'_>, out: &mut Vec<Step>);

    /// Handles the end of a timeout.
    fn handle_timeout(&mut self, context: &Context<'_>, out: &mut Vec<Step>);

    /// Time of the next timeout.
    fn poll_timeout(&self) -> Option<Millis>;

    /// Whether the request of this agent has entered.
    fn has_entered(&self) -> bool;

    /// Members that this agent waits for. The extended algorithms need them probed.
    fn awaited(&self) -> BTreeSet<LockPeer>;

    /// Estimate of the number of agents that enter before this one, if it is known.
    fn ahead(&self) -> Option<usize>;

    /// Place of the open request in the owner's queue, if the owner has told it.
    fn place(&self) -> Option<u32> {
        None
    }

    /// Moves all times back.
    #[cfg(test)]
    fn rebase(&mut self, by: Millis);
}

/// An algorithm that is chosen at run time.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[allow(clippy::exhaustive_enums, reason = "one variant per algorithm")]
#[expect(
    clippy::large_enum_variant,
    reason = "one value per resource, all of one variant"
)]
pub enum AnyAlgorithm {
    /// The owner's queue.
    OwnerQueue(OwnerQueue),
    /// Ricart-Agrawala.
    RicartAgrawala(RicartAgrawala),
    /// Suzuki-Kasami.
    SuzukiKasami(SuzukiKasami),
}

macro_rules! either {
    ($any:expr, $algorithm:ident => $call:expr) => {
        match $any {
            AnyAlgorithm::OwnerQueue($algorithm) => $call,
            AnyAlgorithm::RicartAgrawala($algorithm) => $call,
            AnyAlgorithm::SuzukiKasami($algorithm) => $call,
        }
    };
}

impl MutualExclusion for AnyAlgorithm {
    fn new(kind: Algorithm, me: LockPeer, owns: bool) -> Self {
        match kind {
            Algorithm::OwnerQueue => Self::OwnerQueue(OwnerQueue::new(kind, me, owns)),
            Algorithm::SuzukiKasami | Algorithm::SuzukiKasamiExtended => {
                Self::SuzukiKasami(SuzukiKasami::new(kind, me, owns))
            }
            Algorithm::RicartAgrawala | Algorithm::RicartAgrawalaExtended => {
                Self::RicartAgrawala(RicartAgrawala::new(kind, me, owns))
            }
        }
    }

    fn request(&mut self, context: &Context<'_>, conversation: &Conversation, out: &mut Vec<Step>) {
        either!(self, algorithm => algorithm.request(context, conversation, out));
    }

    fn leave(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        either!(self, algorithm => algorithm.leave(context, out));
    }

    fn handle(
        &mut self,
        context: &Context<'_>,
        from: &LockPeer,
        conversation: &Conversation,
        act: &Act,
        out: &mut Vec<Step>,
    ) {
        either!(self, algorithm => algorithm.handle(context, from, conversation, act, out));
    }

    fn gate_changed(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        either!(self, algorithm => algorithm.gate_changed(context, out));
    }

    fn grant_ended(&mut self, holder: &LockPeer) {
        either!(self, algorithm => algorithm.grant_ended(holder));
    }

    fn own(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        either!(self, algorithm => algorithm.own(context, out));
    }

    fn owner_changed(&mut self) {
        either!(self, algorithm => algorithm.owner_changed());
    }

    fn joined(&mut self, context: &Context<'_>, peer: &LockPeer, out: &mut Vec<Step>) {
        either!(self, algorithm => algorithm.joined(context, peer, out));
    }

    fn lost(&mut self, context: &Context<'_>, peer: &LockPeer, gone: bool, out: &mut Vec<Step>) {
        either!(self, algorithm => algorithm.lost(context, peer, gone, out));
    }

    fn repeat(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        either!(self, algorithm => algorithm.repeat(context, out));
    }

    fn handle_timeout(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        either!(self, algorithm => algorithm.handle_timeout(context, out));
    }

    fn poll_timeout(&self) -> Option<Millis> {
        either!(self, algorithm => algorithm.poll_timeout())
    }

    fn has_entered(&self) -> bool {
        either!(self, algorithm => algorithm.has_entered())
    }

    fn awaited(&self) -> BTreeSet<LockPeer> {
        either!(self, algorithm => algorithm.awaited())
    }

    fn ahead(&self) -> Option<usize> {
        either!(self, algorithm => algorithm.ahead())
    }

    fn place(&self) -> Option<u32> {
        either!(self, algorithm => algorithm.place())
    }

    #[cfg(test)]
    fn rebase(&mut self, by: Millis) {
        either!(self, algorithm => algorithm.rebase(by));
    }
}
