//! Any bytes begin with an envelope or give an error; what was read survives being written, and the
//! borrowed view agrees with the owned value.

#![no_main]

use bytes::Bytes;
use fipa_acl::json::envelope_to_json;
use fipa_acl::{Envelope, EnvelopeView, Letter, Representation};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    // Those in XML have a target of their own.
    if Representation::detect(bytes) == Some(Representation::Xml) {
        return;
    }
    let view = EnvelopeView::parse(bytes);
    let Ok((envelope, len)) = Envelope::decode(bytes) else {
        return;
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
    let _ = envelope_to_json(&envelope);

    let letter = Letter::split(Bytes::copy_from_slice(bytes)).expect("an envelope is there");
    assert_eq!(letter.envelope_len(), len);
    // A peer may leave out a stamp, which the standard has no way to write.
    if let Ok(encoded) = envelope.encode_standard() {
        assert_eq!(Envelope::decode(&encoded), Ok((envelope, encoded.len())));
    }
});
