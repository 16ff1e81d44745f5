//! Datagrams of any peers do no harm to a UDP endpoint, which tells strangers no more than they wrote; see
//! [`fipa_fuzz::datagrams`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("datagrams"), |bytes: &[u8]| fipa_fuzz::datagrams::play(bytes));
