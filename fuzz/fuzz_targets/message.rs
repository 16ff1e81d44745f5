//! Any bytes are a bit-efficient message or an error; a message that was read survives being
//! written, and the view and the explanation agree with it.

#![no_main]

use fipa_acl::{Message, MessageView, Representation, explain};
use fipa_fuzz::{message_survives, payload};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if !matches!(bytes.first(), Some(0xfa..=0xfc)) {
        return;
    }
    assert_eq!(
        Representation::detect(bytes),
        Some(Representation::BitEfficient)
    );
    let decoded = Message::decode(&payload(bytes));
    let view = MessageView::parse(bytes);
    assert_eq!(decoded.as_ref().err(), view.as_ref().err());
    assert_eq!(decoded.as_ref().err(), explain(bytes).error.as_ref());
    let (Ok(message), Ok(view)) = (decoded, view) else {
        return;
    };
    assert_eq!(
        view.content().as_deref(),
        message.content().map(|all| &**all)
    );
    assert_eq!(view.receivers().count(), message.receivers().len());
    assert_eq!(view.user_defined().count(), message.user_defined().len());
    message_survives(&message);
});
