//! Any bytes are an entries file of the host's directory or an error; see [`fipa_fuzz::host`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("host"), |bytes: &[u8]| fipa_fuzz::host::play(bytes));
