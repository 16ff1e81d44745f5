//! Bytes from the peers of HTTP do no harm to the readers; see [`fipa_fuzz::http`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("http"), |bytes: &[u8]| fipa_fuzz::http::play(bytes));
