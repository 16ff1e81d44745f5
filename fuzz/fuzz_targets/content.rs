//! Any bytes are SL or an error, in every way of reading them; what was read survives being written.

#![no_main]

#[path = "../../content/tests/bytes/mod.rs"]
mod bytes;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| bytes::are_read_or_refused(bytes));
