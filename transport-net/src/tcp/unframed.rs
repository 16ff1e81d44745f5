//! Letters from legacy peers (fipa_services, and JADE with its raw TCP extension): one per
//! connection, without a header, until end of stream. Their envelopes are bit-efficient or XML.

use bytes::{Bytes, BytesMut};
use fipa_acl::{DecodeError, EncodeError, Envelope, EnvelopeParams, Letter};
use fipa_transport::{Kind, LegacySource, Signature};
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::time::{Instant, timeout_at};

use super::accept_queue::{QueueTurn, TURN};
use super::endpoint::TcpEndpoint;
use crate::stream::budget::ReservedBytes;
use crate::stream::config::Limits;
use crate::stream::counters::count;
use crate::stream::source::QuotaKey;

/// Initial buffer size in bytes.
const FIRST_READ: usize = 4096;

/// Minimum length of a letter whose memory is reserved in the budget of the endpoint.
const COUNTED_FROM: usize = 64 * 1024;

/// The reason for which a legacy peer's letter is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum UnframedError {
    #[error("the letter exceeds {0} bytes (max_letter)")]
    TooLarge(usize),
    #[error("the letter arrived too slowly (stall_timeout)")]
    TooSlow,
    #[error("timed out waiting for memory for the letter (max_incoming)")]
    NoRoom,
    #[error("the connection broke in the middle of the letter: {0}")]
    Broken(#[from] std::io::Error),
    #[error("its envelope cannot be decoded: {0}")]
    Envelope(#[from] DecodeError),
    #[error("its envelope cannot be encoded in the standard dialect: {0}")]
    Standard(#[from] EncodeError),
}

/// A letter with the dialect of its writer and the reservation of its memory.
pub(crate) struct Read {
    pub(crate) letter: Letter,
    pub(crate) signature: Signature,
    pub(crate) _room: Option<ReservedBytes>,
}

/// Reads a letter to its end. Converts its envelope to the standard dialect; the message is
/// unchanged. The connection loses its turn when no byte arrives for [`TURN`], and needs its turn
/// to reserve much memory.
pub(crate) async fn read(
    endpoint: &TcpEndpoint,
    turn: &QueueTurn,
    quota_key: &QuotaKey,
    source: &mut (impl AsyncRead + Unpin),
) -> Result<Read, UnframedError> {
    let (whole, room) = read_to_end(endpoint, turn, quota_key, source).await?;
    let (envelope, length) = Envelope::decode(&whole)?;
    let length = length.min(whole.len());
    let signature = signature_of(&whole[..length]);
    let message = whole.slice(length..);
    let envelope = with_stamped_extensions(envelope).encode_standard()?;
    Ok(Read {
        letter: Letter::new(envelope, message),
        signature,
        _room: room,
    })
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

/// Passes a letter to the sink, unless the endpoint is closed.
pub(crate) fn hand_on(endpoint: &TcpEndpoint, letter: Letter, from: LegacySource) {
    if let Some(sink) = endpoint.sink() {
        count(&endpoint.tally().unframed_in);
        sink.arrived_unframed(letter, Kind::Tcp, from);
    }
}

async fn read_to_end(
    endpoint: &TcpEndpoint,
    turn: &QueueTurn,
    quota_key: &QuotaKey,
    source: &mut (impl AsyncRead + Unpin),
) -> Result<(Bytes, Option<ReservedBytes>), UnframedError> {
    let limits = endpoint.limits();
    let mut bytes = BytesMut::with_capacity(FIRST_READ);
    let mut room = None;
    let mut window = (Instant::now() + limits.stall_timeout, bytes.len());
    loop {
        if bytes.len() > limits.max_letter {
            return Err(UnframedError::TooLarge(limits.max_letter));
        }
        if bytes.len() == bytes.capacity() {
            let more = bytes.len().max(FIRST_READ);
            if bytes.len() >= COUNTED_FROM {
                // A letter with a reservation never waits for a later one, so letters do not wait
                // for each other in a cycle.
                turn.is_first().await;
                let patience = limits.stall_timeout.saturating_mul(2);
                let taken = take_room(endpoint, quota_key, &mut room, bytes.len(), more);
                let in_time = timeout_at(Instant::now() + patience, taken).await;
                in_time.map_err(|_| UnframedError::NoRoom)?;
                window = (Instant::now() + limits.stall_timeout, bytes.len());
            }
            bytes.reserve(more);
        }
        let turn_ends = Instant::now() + TURN;
        match timeout_at(window.0.min(turn_ends), source.read_buf(&mut bytes)).await {
            Ok(Ok(0)) => return Ok((bytes.freeze(), room)),
            Ok(Ok(_)) => {}
            Ok(Err(error)) => return Err(error.into()),
            Err(_) if turn_ends < window.0 => turn.stalled(),
            Err(_) => {
                let progress = (bytes.len() - window.1) as u64;
                let least = room.as_ref().map_or(0, ReservedBytes::least_progress);
                if progress < least.max(Limits::MIN_PROGRESS) {
                    return Err(UnframedError::TooSlow);
                }
                window = (Instant::now() + limits.stall_timeout, bytes.len());
            }
        }
    }
}

/// Waits until `more` bytes are reserved for a letter of which `there` bytes have arrived.
async fn take_room(
    endpoint: &TcpEndpoint,
    quota_key: &QuotaKey,
    room: &mut Option<ReservedBytes>,
    there: usize,
    more: usize,
) {
    let mut meter = endpoint.meter(quota_key);
    loop {
        let freed = endpoint.byte_budget.freed();
        tokio::pin!(freed);
        freed.as_mut().enable();
        match room {
            Some(room) => {
                if meter.grow(room, more) {
                    return;
                }
            }
            None => {
                *room = meter.take(there.saturating_add(more));
                if room.is_some() {
                    return;
                }
            }
        }
        freed.await;
    }
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
