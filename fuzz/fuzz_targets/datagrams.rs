//! Datagrams of any peers do no harm to a UDP endpoint. An unverified address receives at most as
//! many bytes as it sent; see [`fipa_fuzz::datagrams`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("datagrams"), |bytes: &[u8]| fipa_fuzz::datagrams::play(bytes));
