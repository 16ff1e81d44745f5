//! Letters of the directory exchange do not change the entries of other gateways; see
//! [`fipa_fuzz::exchange`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("exchange"), |bytes: &[u8]| fipa_fuzz::exchange::play(bytes));
