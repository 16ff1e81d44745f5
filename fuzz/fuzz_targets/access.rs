//! Any access rules are accepted or refused, and decide about letters; see [`fipa_fuzz::access`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("access"), |bytes: &[u8]| fipa_fuzz::access::play(bytes));
