//! Letters of legacy peers as they arrive: an envelope, bit-efficient or XML, with the message behind
//! it.

use bytes::Bytes;
use fipa_acl::{DecodeError, EncodeError, Envelope, EnvelopeParams, Letter};
use fipa_transport::Signature;

/// The reason for which the bytes are no letter.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum LetterError {
    #[error("its envelope cannot be decoded: {0}")]
    Envelope(#[from] DecodeError),
    #[error("its envelope cannot be encoded in the standard dialect: {0}")]
    Standard(#[from] EncodeError),
}

/// Divides a letter, and converts its envelope to the standard dialect; the message is unchanged.
/// Returns the letter with the dialect of its writer.
pub(crate) fn standard(whole: &Bytes) -> Result<(Letter, Signature), LetterError> {
    let (envelope, length) = Envelope::decode(whole)?;
    let length = length.min(whole.len());
    let signature = signature_of(whole.get(..length).unwrap_or_default());
    let message = whole.slice(length..);
    let envelope = with_stamped_extensions(envelope).encode_standard()?;
    Ok((Letter::new(envelope, message), signature))
}

/// Returns the dialect of the writer of this envelope. JADE writes XML, and `Z` between date and
/// time. The encoding of the message is no indication: fipa_services also sends string messages,
/// but does not read such dates.
fn signature_of(envelope: &[u8]) -> Signature {
    const BEFORE: &[u8] = b"<date>";
    const DAY: usize = "20261120".len();
    let found = match envelope.first() {
        Some(b'<') => envelope.windows(BEFORE.len()).position(|it| it == BEFORE),
        _ => None,
    };
    let between = found.and_then(|at| envelope.get(at + BEFORE.len() + DAY));
    match between {
        Some(b'Z') => Signature::JadeProxy,
        _ => Signature::FipaServices,
    }
}

/// Returns the envelope with stamped extensions only, as FIPA00088 requires: fipa_services narrows
/// a letter to one receiver with an extension that has no stamp. Such overriding parameters, and
/// dates, for which extensions have no field, move to the next older part. The effective parameters
/// stay the same.
fn with_stamped_extensions(envelope: Envelope) -> Envelope {
    let Envelope {
        mut base,
        extensions,
    } = envelope;
    let mut stamped: Vec<EnvelopeParams> = Vec::new();
    for mut extension in extensions {
        if let Some(date) = extension.date.take() {
            base.date = Some(date);
        }
        if extension.received.is_some() {
            stamped.push(extension);
        } else {
            override_with(stamped.last_mut().unwrap_or(&mut base), extension);
        }
    }
    Envelope {
        base,
        extensions: stamped,
    }
}

fn override_with(older: &mut EnvelopeParams, newer: EnvelopeParams) {
    fn one<T>(older: &mut Option<T>, newer: Option<T>) {
        if newer.is_some() {
            *older = newer;
        }
    }
    fn list<T>(older: &mut Vec<T>, newer: Vec<T>) {
        if !newer.is_empty() {
            *older = newer;
        }
    }
    one(&mut older.from, newer.from);
    one(&mut older.comments, newer.comments);
    one(&mut older.acl_representation, newer.acl_representation);
    one(&mut older.payload_length, newer.payload_length);
    one(&mut older.payload_encoding, newer.payload_encoding);
    one(&mut older.transport_behaviour, newer.transport_behaviour);
    list(&mut older.to, newer.to);
    list(&mut older.intended_receivers, newer.intended_receivers);
    older.user_defined.extend(newer.user_defined);
}

#[cfg(test)]
mod tests {
    use fipa_acl::AgentId;

    use super::*;

    /// A recorded letter of a fipa_services peer.
    const TCP_LETTER: &[u8] = include_bytes!("../../tests/data/tcp_letter.bin");

    #[test]
    fn the_envelope_identifies_the_dialect_of_its_writer() {
        let for_jade = include_bytes!("../../tests/data/tcp_letter_jade.bin");
        let of_jade = include_bytes!("../../../acl/tests/vectors/jade_tcp_reply.xml");
        let cases: [(&[u8], _); 3] = [
            (TCP_LETTER, Signature::FipaServices),
            (for_jade, Signature::FipaServices),
            (of_jade, Signature::JadeProxy),
        ];
        for (letter, signature) in cases {
            let whole = Bytes::copy_from_slice(letter);
            let (_, length) = Envelope::decode(&whole).unwrap();
            assert_eq!(signature_of(&letter[..length]), signature);
        }
    }

    #[test]
    fn extensions_without_a_stamp_are_folded_with_the_same_effect() {
        let (recorded, _) = Envelope::decode(TCP_LETTER).unwrap();
        let override_only = EnvelopeParams {
            intended_receivers: vec![AgentId::new("arm").unwrap()],
            comments: Some("newest".into()),
            date: recorded.base.date,
            ..EnvelopeParams::default()
        };
        let mut oldest_first = recorded.clone();
        oldest_first.extensions.insert(0, override_only.clone());
        let mut newest_last = recorded.clone();
        newest_last.extensions.push(override_only);
        for envelope in [recorded, oldest_first, newest_last] {
            let folded = with_stamped_extensions(envelope.clone());
            assert_eq!(folded.effective(), envelope.effective());
            assert!(folded.extensions.iter().all(|e| e.received.is_some()));
            let stamps =
                |e: &Envelope| e.extensions.iter().filter(|e| e.received.is_some()).count();
            assert_eq!(stamps(&folded), stamps(&envelope));
            folded.encode_standard().unwrap();
        }
    }
}
