//! Any file is a recording of letters, or is refused; see [`fipa_fuzz::recording`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("recording"), |bytes: &[u8]| fipa_fuzz::recording::play(bytes));
