//! Packets of multicast DNS do no harm to what is kept of other hosts; see
//! [`fipa_fuzz::mdns`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("mdns"), |bytes: &[u8]| fipa_fuzz::mdns::play(bytes));
