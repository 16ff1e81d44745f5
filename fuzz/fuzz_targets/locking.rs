//! Messages of locks from malicious agents are read or refused, and one grant is live at most; see
//! [`fipa_fuzz::locking`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("locking"), |bytes: &[u8]| fipa_fuzz::locking::play(bytes));
