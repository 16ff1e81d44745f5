//! Rust values as SL terms, by serde.

mod de;
mod error;
mod names;
mod ser;
mod term;
mod wrappers;

pub use de::{from_slice, from_slice_in};
pub use error::{DeserializeError, DeserializeErrorKind, SerializeError};
pub use ser::{to_vec, to_vec_in};
pub use wrappers::{Agent, DateTime, Set};
