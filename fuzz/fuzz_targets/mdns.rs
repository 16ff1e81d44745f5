//! Multicast DNS packets do no harm to the stored records of other hosts; see [`fipa_fuzz::mdns`].

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(init: fipa_fuzz::seeds::write("mdns"), |bytes: &[u8]| fipa_fuzz::mdns::play(bytes));
