//! Goals of malicious clients stay within their bounds and their types; see [`fipa_fuzz::actions`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("actions"), |bytes: &[u8]| fipa_fuzz::actions::play(bytes));
