//! Interaction protocols as calls, so that applications need no state machines of their own.
//!
//! An initiator calls [`Agent::request`], [`Agent::query`], [`Agent::subscribe`] or [`Agent::contract_net`],
//! or one of the [`Protocols`] that few programs lead, and gets the result of the protocol. A participant
//! passes a received opening message to [`Agent::take_part`], agrees, works and replies;
//! [`Agent::serve`] runs a handler for each opening message. [`topics`](crate::topics) has the participant of
//! subscriptions. Messages of other conversations still go to [`Agent::receive`].
//!
//! # Partners that are gone or unreachable
//!
//! Every call that waits for an agent ends with [`DialogueError::Gone`] when the agent's own host proves
//! that the agent has left, has died, or has registered again without having moved. Between the proof
//! and the error are at most 100 ms, during which letters that the agent sent before still arrive. An
//! agent that leaves one host and has not registered on another within 50 ms counts as gone.
//!
//! The silence of a host proves nothing. While a call waits for an agent of another host, the gateways
//! exchange signs of life. After a silence of `monitor.heartbeat` (default 5 s), the agent is
//! *unreachable*: `reachability()` of the conversation reports this, the call goes on within its
//! timeout, and ends with [`DialogueError::Unreachable`] instead of [`DialogueError::TimedOut`] if no
//! answer arrives. A subscription, which has no timeout, returns this error once and goes on. A process
//! that is stopped but not ended is not detected. Agents of legacy peers have no signs of life.
//!
//! Applications that lead a conversation without these calls use [`Agent::watch_partners`].
//!
//! # Conversation ids
//!
//! A message belongs to a conversation if it has the conversation's id and comes from one of its
//! parties. A message of another agent with this id goes to [`Agent::receive`].
//!
//! # Modules
//!
//! * `dialogue.rs` is one conversation: it assigns the conversation id, sets `reply-with`,
//!   `in-reply-to` and `reply-by`, and checks every message with the state machine of the protocol,
//!   independently of `monitor.check`.
//! * `partners.rs` decides, without I/O, whether a partner is gone or unreachable; `watching.rs` is the
//!   shell around it; `reachability.rs` reports it. `receivers.rs` expands patterns and coalitions.
//! * `protocols.rs` is the view of the rarer calls. `initiator.rs`, `subscription.rs`, `contract_net.rs`, `auction.rs` and `proxied.rs` are the sides
//!   of initiators; `bids.rs` collects the answers to a call for proposals. `participant.rs` is the
//!   side of participants; `serving.rs` leads many of them. `keep.rs` has the words of subscribers and publishers.
//!
//! Not in this module: the rules of the protocols (`fipa-monitor`).

mod auction;
mod bids;
mod contract_net;
pub(crate) mod dialogue;
mod history;
mod initiator;
pub(crate) mod keep;
mod participant;
mod partners;
pub(crate) mod peer_shares;
mod protocols;
mod proxied;
mod reachability;
mod receivers;
pub(crate) mod serving;
mod subscription;
mod watching;

pub use auction::Auction;
pub use bids::Bids;
pub use contract_net::{Awarded, ContractNet};
pub use dialogue::DialogueError;
pub use history::Departure;
pub use initiator::{Decision, Request};
pub use keep::{Keep, KeepError};
pub use participant::{Reply, Task};
pub use partners::PartnerEvent;
pub use protocols::Protocols;
pub use proxied::Proxied;
pub use reachability::{Reachability, Unreachable};
pub use serving::Server;
#[cfg(feature = "actions")]
pub(crate) use serving::serve_those;
pub use subscription::{Notification, Subscription};
pub use watching::PartnerWatch;

#[cfg(doc)]
use crate::Agent;
