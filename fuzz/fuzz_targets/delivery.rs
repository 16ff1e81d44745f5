//! Parcels, reports, answers and hellos of malicious services do not prevent delivery between
//! honest agents; see [`fipa_fuzz::delivery`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("delivery"), |bytes: &[u8]| fipa_fuzz::delivery::play(bytes));
