//! Which letters a service accepts: the rules of the configuration, and the gate that asks them.

pub(crate) mod gate;
pub(crate) mod rules;
