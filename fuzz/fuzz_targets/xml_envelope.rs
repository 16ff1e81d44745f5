//! Any bytes begin with an XML envelope or give an error; an envelope that was read survives being
//! written, if it can be written.

#![no_main]

use bytes::Bytes;
use fipa_acl::{Dialect, Envelope, Letter, Representation};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if Representation::detect(bytes) != Some(Representation::Xml) {
        return;
    }
    let (envelope, len) = match Envelope::decode(bytes) {
        Ok(read) => read,
        Err(error) => return assert!(error.offset() <= bytes.len()),
    };
    let letter = Letter::split(Bytes::copy_from_slice(bytes)).expect("an envelope is there");
    assert_eq!(letter.envelope_len(), len);
    if let Ok(encoded) = envelope.encode(Representation::Xml, Dialect::Standard) {
        assert_eq!(
            Envelope::decode(&encoded),
            Ok((envelope.clone(), encoded.len()))
        );
    }
    if let Ok(encoded) = envelope.encode(Representation::Xml, Dialect::Jade) {
        let (read, _) = Envelope::decode(&encoded).expect("what we write can be read");
        assert_eq!(read.base, envelope.effective());
    }
    let _ = envelope.encode(Representation::Xml, Dialect::FipaServices);
});
