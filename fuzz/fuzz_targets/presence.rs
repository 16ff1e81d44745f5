//! Letters about registrations of other hosts, from agents and gateways; see [`fipa::fuzzing::presence`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("presence"), |bytes: &[u8]| fipa::fuzzing::presence(bytes));
