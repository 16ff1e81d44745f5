//! Messages to the agent management system and the directory facilitator change only the descriptions
//! of their senders; see [`fipa_fuzz::platform`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("platform"), |bytes: &[u8]| fipa_fuzz::platform::play(bytes));
