//! Protocols: performatives, state machines, their files, and their projections onto roles.
//!
//! Conversations and messages do not belong here.

pub(crate) mod act;
pub(crate) mod index;
pub(crate) mod library;
pub(crate) mod machine;
pub mod projection;
pub(crate) mod role;
pub mod scxml;
pub(crate) mod spelling;
