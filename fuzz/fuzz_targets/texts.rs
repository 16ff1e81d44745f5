//! Certificates and their names, locations, agent names and patterns are accepted or refused; see
//! [`fipa_fuzz::texts`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("texts"), |bytes: &[u8]| fipa_fuzz::texts::play(bytes));
