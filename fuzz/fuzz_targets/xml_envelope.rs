//! Any bytes start with an XML envelope or are refused. A decoded envelope is the same after a
//! round trip.

#![no_main]

use bytes::Bytes;
use fipa_acl::{Envelope, Letter, Representation};
use fipa_fuzz::{envelope_survives, envelope_view_agrees};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if Representation::detect(bytes) != Some(Representation::Xml) {
        return;
    }
    let (envelope, len) = match Envelope::decode(bytes) {
        Ok(read) => read,
        Err(error) => return assert!(error.offset() <= bytes.len()),
    };
    envelope_view_agrees(bytes, &envelope, len);
    let letter =
        Letter::split(Bytes::copy_from_slice(bytes)).expect("the bytes start with an envelope");
    assert_eq!(letter.envelope_len(), len);
    envelope_survives(&envelope);
});
