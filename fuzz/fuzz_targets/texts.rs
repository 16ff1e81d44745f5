//! Names in certificates, locations, names of agents and patterns are read or refused; see
//! [`fipa_fuzz::texts`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("texts"), |bytes: &[u8]| fipa_fuzz::texts::play(bytes));
