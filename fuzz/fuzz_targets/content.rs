//! Any bytes are SL or an error, for every reader. A parsed content is the same after a round trip.

#![no_main]

#[path = "../../content/tests/bytes/mod.rs"]
mod bytes;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| bytes::are_read_or_refused(bytes));
