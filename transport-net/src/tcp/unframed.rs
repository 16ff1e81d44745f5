//! Letters from legacy peers (fipa_services, and JADE with its raw TCP extension): one per
//! connection, without a header, until end of stream. Their envelopes are bit-efficient or XML.

use bytes::{Bytes, BytesMut};
use fipa_acl::Letter;
use fipa_transport::{Kind, LegacySource, Signature};
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::time::{Instant, timeout_at};

use super::accept_queue::{QueueTurn, TURN};
use super::endpoint::TcpEndpoint;
use crate::legacy::letter::{self, LetterError};
use crate::stream::budget::ReservedBytes;
use crate::stream::config::NetLimits;
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
    #[error(transparent)]
    Letter(#[from] LetterError),
}

/// A letter with the dialect of its writer and the reservation of its memory.
pub(crate) struct Read {
    pub(crate) letter: Letter,
    pub(crate) signature: Signature,
    pub(crate) _room: Option<ReservedBytes>,
}

/// Reads a letter to its end. Converts its envelope to the standard dialect; the message is
/// unchanged. A connection needs its turn to reserve much memory, and loses it when no byte arrives
/// for [`TURN`].
pub(crate) async fn read(
    endpoint: &TcpEndpoint,
    turn: &QueueTurn,
    quota_key: &QuotaKey,
    source: &mut (impl AsyncRead + Unpin),
) -> Result<Read, UnframedError> {
    let (whole, room) = read_to_end(endpoint, turn, quota_key, source).await?;
    let (letter, signature) = letter::standard(&whole)?;
    Ok(Read {
        letter,
        signature,
        _room: room,
    })
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
                let timeout = limits.stall_timeout.saturating_mul(2);
                let taken = take_room(endpoint, quota_key, &mut room, bytes.len(), more);
                let in_time = timeout_at(Instant::now() + timeout, taken).await;
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
                if progress < least.max(NetLimits::MIN_PROGRESS) {
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
