//! Administration of a domain: what its processes and gateways do, and what is wrong with them.

pub mod contact;
pub mod doctor;
#[cfg(feature = "secure")]
pub mod keys;
mod member;
pub mod open_files;
#[cfg(feature = "secure")]
pub mod pairing;
pub mod reload;
pub mod routes;
pub mod stopped;
pub mod watch;
