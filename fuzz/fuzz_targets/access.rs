//! Any rules of access say what they say of a letter; see
//! [`fipa_fuzz::access`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("access"), |bytes: &[u8]| fipa_fuzz::access::play(bytes));
