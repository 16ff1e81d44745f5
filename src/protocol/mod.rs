//! Interaction protocols as calls: nobody writes state machines by hand.
//!
//! An initiator calls [`Agent::request`], [`Agent::query`], [`Agent::request_when`],
//! [`Agent::propose`], [`Agent::subscribe`], [`Agent::contract_net`],
//! [`Agent::iterated_contract_net`], [`Agent::english_auction`], [`Agent::dutch_auction`],
//! [`Agent::brokering`] or [`Agent::recruiting`] and gets what the protocol yields. A participant
//! gives an opening message that it has received to [`Agent::take_part`], agrees, works and replies.
//! Other messages go to [`Agent::receive`] as ever, meanwhile. The same calls without an async runtime
//! are in [`blocking`](crate::blocking).
//!
//! * `dialogue.rs` is one conversation: it gives it an id, sets `reply-with`, `in-reply-to` and
//!   `reply-by`, and checks every message with the machine of the protocol, whether the
//!   configuration has agents checked or not.
//! * `initiator.rs`, `subscription.rs`, `contract_net.rs`, `auction.rs` and `proxied.rs` are what
//!   initiators hold, `bids.rs` what comes of a call; `participant.rs` is what participants do.
//!
//! What must not live here: what a protocol allows (that is `fipa-monitor`).

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
