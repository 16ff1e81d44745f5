//! Any bytes begin with a bit-efficient envelope or give an error; what was read survives being
//! written, and the view and the explanation agree with it.

#![no_main]

use bytes::Bytes;
use fipa_acl::{Envelope, EnvelopeView, Letter, explain};
use fipa_fuzz::envelope_survives;
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
    let view = view.expect("the view is not stricter");
    assert_eq!(view.len(), len);
    let effective = envelope.effective();
    let from = effective.from.as_ref().map(|agent| agent.name().to_owned());
    assert_eq!(view.from_name().map(|name| name.to_string()), from);
    let receivers: Vec<_> = view.receivers().map(|name| name.to_string()).collect();
    let named = if effective.intended_receivers.is_empty() {
        &effective.to
    } else {
        &effective.intended_receivers
    };
    let named: Vec<_> = named.iter().map(|agent| agent.name().to_owned()).collect();
    assert_eq!(receivers, named);
    let _ = view.stamps().count();

    let letter = Letter::split(Bytes::copy_from_slice(bytes)).expect("an envelope is there");
    assert_eq!(letter.envelope_len(), len);
    envelope_survives(&envelope);
});
