//! Accepted descriptors in shared memory announce no range outside of their payload; see
//! [`fipa_fuzz::shm`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("shm"), |bytes: &[u8]| fipa_fuzz::shm::play(bytes));
