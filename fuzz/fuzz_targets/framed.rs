//! Bytes from the peer of a framed stream do no harm to the reader and the connection; see
//! [`fipa_fuzz::framed`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("framed"), |bytes: &[u8]| fipa_fuzz::framed::play(bytes));
