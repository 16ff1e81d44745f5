//! Any configuration is accepted or refused with its mistakes; see [`fipa_fuzz::config`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("config"), |bytes: &[u8]| fipa_fuzz::config::play(bytes));
