//! Parts that the fuzz targets reach; `fuzz/` has the targets.

#![allow(
    clippy::expect_used,
    clippy::missing_panics_doc,
    reason = "it panics at what must not be"
)]

#[cfg(feature = "secure")]
pub use crate::secure::certified;
pub use crate::stream::fuzzing::{Framed, answer_body, frame, hello_body, parcel_body};
#[cfg(feature = "ip")]
pub use crate::udp::fuzzing::{Datagrams, Written};
