#![doc = include_str!("../README.md")]

mod actions;
mod agent;
mod coalitions;
mod contract_net;
mod conversation;
mod domain;
mod failure;
mod fork;
#[cfg(feature = "gateway")]
mod gateway;
mod handles;
mod item;
mod letter;
mod loaned;
mod locks;
mod message;
mod raw;
mod services;
mod table;
mod topics;

pub use crate::actions::*;
pub use crate::agent::*;
pub use crate::coalitions::*;
pub use crate::contract_net::*;
pub use crate::conversation::*;
pub use crate::domain::*;
pub use crate::failure::FipaResult;
#[cfg(feature = "gateway")]
pub use crate::gateway::*;
pub use crate::handles::*;
pub use crate::item::{FipaEvent, FipaItem};
pub use crate::letter::{FipaLetterInfo, FipaMessage, FipaParameter};
pub use crate::locks::*;
pub use crate::message::*;
pub use crate::raw::FipaText;
pub use crate::services::*;
pub use crate::table::FipaHandle;
pub use crate::topics::*;

/// Returns the version of the library, such as `0.1.0`.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_version() -> FipaText {
    FipaText::of(env!("CARGO_PKG_VERSION"))
}

/// Returns the text of the last failure of this thread: what went wrong, where, and what to do. It is valid until the
/// next failure of this thread, and empty if none has failed.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_error() -> FipaText {
    failure::last(FipaText::of)
}
