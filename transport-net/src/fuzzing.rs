//! Entry points of the fuzz targets in `fuzz/`.

#![allow(
    clippy::expect_used,
    clippy::missing_panics_doc,
    reason = "a violated invariant must panic"
)]

#[cfg(feature = "http")]
pub use crate::legacy::http::fuzzing as http;
#[cfg(feature = "udt")]
pub use crate::legacy::udt::fuzzing::{UdtPacket, UdtPackets};
#[cfg(feature = "quic")]
pub use crate::quic::fuzzing::QuicStreams;
#[cfg(feature = "secure")]
pub use crate::secure::certified;
pub use crate::stream::fuzzing::{Framed, answer_body, frame, hello_body, parcel_body};
#[cfg(feature = "ip")]
pub use crate::udp::fuzzing::{Datagrams, Written};
