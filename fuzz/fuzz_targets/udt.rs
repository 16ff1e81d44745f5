//! Packets of any peers do no harm to a UDT endpoint. An unverified address receives at most as many
//! bytes as it sent; see [`fipa_fuzz::udt`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("udt"), |bytes: &[u8]| fipa_fuzz::udt::play(bytes));
