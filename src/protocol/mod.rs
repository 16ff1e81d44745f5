//! Interaction protocols as calls, so that applications need no state machines of their own.
//!
//! An initiator calls [`Agent::request`], [`Agent::query`], [`Agent::request_when`],
//! [`Agent::propose`], [`Agent::subscribe`], [`Agent::contract_net`],
//! [`Agent::iterated_contract_net`], [`Agent::english_auction`], [`Agent::dutch_auction`],
//! [`Agent::brokering`] or [`Agent::recruiting`], and gets the result of the protocol. A participant
//! passes a received opening message to [`Agent::take_part`], agrees, works and replies. Messages of
//! other conversations still go to [`Agent::receive`]. [`blocking`](crate::blocking) has the same calls
//! for processes without an async runtime.
//!
//! * `dialogue.rs` is one conversation: it assigns the conversation id, sets `reply-with`,
//!   `in-reply-to` and `reply-by`, and checks every message with the state machine of the protocol,
//!   independently of `monitor.check`.
//! * `initiator.rs`, `subscription.rs`, `contract_net.rs`, `auction.rs` and `proxied.rs` are the sides
//!   of initiators; `bids.rs` collects the answers to a call for proposals. `participant.rs` is the
//!   side of participants.
//!
//! Not in this module: the rules of the protocols (`fipa-monitor`).

mod auction;
mod bids;
mod contract_net;
mod dialogue;
mod initiator;
mod participant;
mod proxied;
mod subscription;

pub use auction::Auction;
pub use bids::Bids;
pub use contract_net::{Awarded, ContractNet};
pub use dialogue::DialogueError;
pub use initiator::{Decision, Request};
pub use participant::{Reply, Task};
pub use proxied::Proxied;
pub use subscription::Subscription;

#[cfg(doc)]
use crate::Agent;
