//! The file that a gateway leaves to its successor; see [`fipa::fuzzing::gateway_state`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("gateway_state"), |bytes: &[u8]| fipa::fuzzing::gateway_state(bytes));
