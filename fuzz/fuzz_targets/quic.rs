//! Bytes from the peer of a QUIC connection, on any streams, do no harm to the link that reads them; see
//! [`fipa_fuzz::quic`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("quic"), |bytes: &[u8]| fipa_fuzz::quic::play(bytes));
