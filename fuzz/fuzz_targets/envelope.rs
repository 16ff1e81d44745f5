//! Any bytes start with a bit-efficient envelope or are refused. A decoded envelope is the same
//! after a round trip. The view and the explanation agree with the decoder.

#![no_main]

use bytes::Bytes;
use fipa_acl::{Envelope, EnvelopeView, Letter, explain};
use fipa_fuzz::{envelope_survives, envelope_view_agrees};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if !matches!(bytes.first(), Some(0xfd | 0xfe)) {
        return;
    }
    let view = EnvelopeView::parse(bytes);
    let explained = explain(bytes);
    let (envelope, len) = match Envelope::decode(bytes) {
        Ok(read) => read,
        Err(error) => {
            assert_eq!(view.as_ref().err(), Some(&error));
            assert_eq!(explained.error, Some(error));
            return;
        }
    };
    envelope_view_agrees(bytes, &envelope, len);
    let letter =
        Letter::split(Bytes::copy_from_slice(bytes)).expect("the bytes start with an envelope");
    assert_eq!(letter.envelope_len(), len);
    envelope_survives(&envelope);
});
