//! The check of a message: the conversation to which it belongs, the verdict, and the changes that it makes.

pub(crate) mod apply;
mod delegated;
pub(crate) mod judge;
pub(crate) mod report;
pub(crate) mod roles;
