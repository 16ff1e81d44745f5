//! The listening side: accepts connections and detects their protocol by their first byte.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fipa_transport::{LegacySource, log_limit, quota_address};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;
use tokio::task::AbortHandle;
use tokio::time::{sleep, sleep_until};

use super::accept_queue::{self, Full, QueueTurn, TURN};
use super::endpoint::TcpEndpoint;
use super::unframed::{self, UnframedError};
use crate::sockets::prepare;
use crate::stream::counters::count;
use crate::stream::endpoint::UnprovedSlot;
use crate::stream::frame::{FrameReader, MAGIC};
use crate::stream::link::LinkTask;
use crate::stream::proof::Proof;
use crate::stream::source::{Home, QuotaKey, Source};
#[cfg(feature = "secure")]
use crate::stream::tls;
use crate::stream::wire;

/// Accepts connections until it is aborted.
pub(crate) async fn accept(endpoint: Arc<TcpEndpoint>, listener: TcpListener) {
    let mut pace = Pace::default();
    loop {
        match listener.accept().await {
            Ok((stream, from)) => {
                let stream = Arc::new(stream);
                let queue = &endpoint.legacy.accept_queue;
                let turn = queue.admit(&endpoint, from.ip(), &stream);
                if matches!(turn, Err(Full::Closed)) {
                    return;
                }
                serve(&endpoint, turn, stream, from);
                let (waiting, departures) = endpoint.legacy.accept_queue.progress();
                if pace.pauses(waiting, departures) {
                    sleep(Pace::PAUSE).await;
                }
            }
            Err(error) => endpoint.accept_failed(&error).await,
        }
    }
}

/// The pace of accepting. Accepting a connection is faster than reading a letter, and the letters
/// that are not accepted yet are safe in the system's queue. Therefore accepting pauses while many
/// connections wait and are served. A peer that keeps its connections from being served does not
/// slow down accepting for longer than [`Pace::MAX_PAUSES`] pauses.
#[derive(Debug, Default)]
struct Pace {
    /// Number of connections that had left the queues at the last pause.
    departures: u64,
    /// Number of pauses since a connection left the queues.
    fruitless: u32,
}

impl Pace {
    const PAUSE: Duration = Duration::from_millis(1);

    /// Minimum number of waiting connections for a pause.
    const BUSY: usize = 64;

    /// Maximum number of consecutive pauses in which no connection leaves the queues.
    const MAX_PAUSES: u32 = 50;

    fn pauses(&mut self, waiting: usize, departures: u64) -> bool {
        if departures != self.departures {
            *self = Self {
                departures,
                fruitless: 0,
            };
        }
        let pauses = waiting >= Self::BUSY && self.fruitless < Self::MAX_PAUSES;
        if pauses {
            self.fruitless += 1;
        }
        pauses
    }
}

/// Starts the task of an accepted connection.
fn serve(
    endpoint: &Arc<TcpEndpoint>,
    turn: Result<QueueTurn, Full>,
    stream: Arc<TcpStream>,
    from: SocketAddr,
) {
    // Other connections can evict this one, so the task starts when its own handle is known.
    let (handle, own) = oneshot::channel();
    let receiving = receive(endpoint.clone(), turn, stream, from, own);
    let _ended = handle.send(tokio::spawn(receiving).abort_handle());
}

fn reset(endpoint: &Arc<TcpEndpoint>, stream: Arc<TcpStream>, from: SocketAddr, full: Full) {
    if let Some(stream) = Arc::into_inner(stream) {
        super::legacy::reset(endpoint, stream, from, full);
    }
}

/// The slot of a connection whose first byte is awaited.
enum Waiting {
    /// In the accept queue, with its turn.
    InTurn(QueueTurn),
    /// Among the connections before their hello.
    Late(UnprovedSlot),
    /// Among the connections before their hello, because the accept queue was full: letters of
    /// legacy peers must not keep out a peer that will introduce itself.
    QueueFull(UnprovedSlot, Full),
}

/// The first byte of a TLS handshake (RFC 8446 section 5.1), also for builds without TLS.
const TLS_RECORD: u8 = 22;

/// The first byte of a connection.
enum First {
    Byte(u8),
    /// The peer only checked whether the port is open.
    End,
    Broken(io::Error),
    /// No byte came in time.
    Silence,
}

async fn receive(
    endpoint: Arc<TcpEndpoint>,
    turn: Result<QueueTurn, Full>,
    stream: Arc<TcpStream>,
    from: SocketAddr,
    own: oneshot::Receiver<AbortHandle>,
) {
    let Ok(task) = own.await else {
        return;
    };
    let waiting = match turn {
        Ok(turn) if !turn.started(task.clone()) => return,
        Ok(turn) => Waiting::InTurn(turn),
        Err(full) => match unproved_slot(&endpoint, from, task.clone()) {
            Some(slot) => Waiting::QueueFull(slot, full),
            None => return,
        },
    };
    if let Err(error) = prepare(&stream, endpoint.limits()) {
        tracing::debug!(%from, "connection failed before the first byte: {error}");
        return;
    }
    let Some((waiting, first)) = first_byte(&endpoint, waiting, &stream, from, &task).await else {
        return;
    };
    #[cfg(feature = "secure")]
    let (waiting, stream) = match prove(&endpoint, waiting, stream, from, &first, &task).await {
        Some(unproved) => unproved,
        None => return,
    };
    let refused = match first {
        First::Byte(byte) if byte == MAGIC[0] && endpoint.config.takes_frames_of(from.ip()) => {
            let Some(slot) = waiting.introduces_itself(&endpoint, from, task) else {
                return;
            };
            let (Some(stream), Some((link, sink))) = (Arc::into_inner(stream), endpoint.accepted())
            else {
                return;
            };
            let reader = FrameReader::new(endpoint.limits().max_letter, BytesMut::new());
            LinkTask::new(endpoint.stream.clone(), link, sink, None)
                .serve(
                    wire::plain(stream),
                    Proof::default(),
                    reader,
                    Source::Address(from),
                    || drop(slot),
                )
                .await;
            return;
        }
        // A bit-efficient or an XML envelope.
        First::Byte(0xfe | 0xfd | b'<') => {
            let turn = match waiting.takes_turn(&endpoint, from, &stream, task) {
                Ok(turn) => turn,
                Err(full) => return reset(&endpoint, stream, from, full),
            };
            match receive_letter(&endpoint, turn, stream, from).await {
                Ok(()) => return,
                Err(refused) => refused.to_string(),
            }
        }
        First::Byte(TLS_RECORD) => {
            let why = "the peer has keys and began TLS, but this gateway has no keys: set \
                       security.keys here (`fipa keys init`) and trust each other's certificates, \
                       or remove security.keys there";
            endpoint.config.refusals.add(from.ip(), why);
            why.to_owned()
        }
        First::Byte(byte) => format!("unknown protocol: the first byte is {byte:#04x}"),
        First::End => return,
        First::Broken(error) => {
            tracing::debug!(%from, "connection failed before the first byte: {error}");
            return;
        }
        First::Silence => "no byte arrived in time (handshake_timeout)".to_owned(),
    };
    count(&endpoint.tally().refused_nonsense);
    log_limit::warn!(of: quota_address(from.ip()), "{from}: connection closed: {refused}");
}

/// Waits for the first byte, which stays in the kernel's buffer. A connection without one loses its
/// turn. Returns `None` when the endpoint has been closed.
async fn first_byte(
    endpoint: &Arc<TcpEndpoint>,
    mut waiting: Waiting,
    stream: &TcpStream,
    from: SocketAddr,
    task: &AbortHandle,
) -> Option<(Waiting, First)> {
    let timeout = endpoint.limits().handshake_timeout;
    let turn = TURN.min(timeout);
    let mut byte = [0];
    let mut peeked = tokio::time::timeout(turn, stream.peek(&mut byte)).await;
    if peeked.is_err() && accept_queue::is_silent(stream) {
        if let Waiting::InTurn(turn) = waiting {
            drop(turn);
            waiting = Waiting::Late(unproved_slot(endpoint, from, task.clone())?);
        }
        peeked = tokio::time::timeout(timeout - turn, stream.peek(&mut byte)).await;
    } else if peeked.is_err() {
        peeked = Ok(stream.peek(&mut byte).await);
    }
    let first = match peeked {
        Ok(Ok(0)) => First::End,
        Ok(Ok(_)) => {
            let [byte] = byte;
            First::Byte(byte)
        }
        Ok(Err(error)) => First::Broken(error),
        Err(_) => First::Silence,
    };
    if let Waiting::InTurn(turn) = &waiting {
        turn.has_bytes();
    }
    Some((waiting, first))
}

/// Returns a slot among the connections before their hello.
fn unproved_slot(
    endpoint: &Arc<TcpEndpoint>,
    from: SocketAddr,
    task: AbortHandle,
) -> Option<UnprovedSlot> {
    let slot = endpoint.admit_unproved(Source::Address(from))?;
    endpoint.unproved_started(slot.number, task);
    Some(slot)
}

impl Waiting {
    /// Leaves the accept queue, because the peer will introduce itself.
    fn introduces_itself(
        self,
        endpoint: &Arc<TcpEndpoint>,
        from: SocketAddr,
        task: AbortHandle,
    ) -> Option<UnprovedSlot> {
        match self {
            Self::InTurn(turn) => {
                drop(turn);
                unproved_slot(endpoint, from, task)
            }
            Self::Late(slot) | Self::QueueFull(slot, _) => Some(slot),
        }
    }

    /// Returns to the end of the accept queue after the turn was lost. A connection that found the
    /// queue full does not return, because later ones of its address may be in the queue.
    fn takes_turn(
        self,
        endpoint: &Arc<TcpEndpoint>,
        from: SocketAddr,
        stream: &Arc<TcpStream>,
        task: AbortHandle,
    ) -> Result<QueueTurn, Full> {
        match self {
            Self::InTurn(turn) => Ok(turn),
            Self::QueueFull(_, full) => Err(full),
            Self::Late(slot) => {
                drop(slot);
                let turn = endpoint
                    .legacy
                    .accept_queue
                    .admit(endpoint, from.ip(), stream)?;
                turn.has_bytes();
                if turn.started(task) {
                    Ok(turn)
                } else {
                    Err(Full::Closed)
                }
            }
        }
    }
}

/// Reads a legacy peer's letter when its turn has come, and passes it on after the letters of its
/// address that were accepted before.
async fn receive_letter(
    endpoint: &Arc<TcpEndpoint>,
    turn: QueueTurn,
    stream: Arc<TcpStream>,
    from: SocketAddr,
) -> Result<(), UnframedError> {
    turn.may_read().await;
    let Some(mut stream) = Arc::into_inner(stream) else {
        return Ok(());
    };
    let quota_key = QuotaKey::of(Source::Address(from), None);
    let read = unframed::read(endpoint, &turn, &quota_key, &mut stream).await?;
    drop(stream);
    turn.is_first().await;
    if let Some(rate_limit) = endpoint.rate_limit(Home::Address(from.ip()))
        && let Some(until) = rate_limit.spend(1, read.letter.len(), Instant::now())
    {
        count(&endpoint.tally().held_back);
        sleep_until(until.into()).await;
    }
    let source = LegacySource {
        address: from.ip().to_canonical(),
        signature: read.signature,
    };
    unframed::hand_on(endpoint, read.letter, source);
    Ok(())
}

/// Performs the TLS handshake with a peer that must prove its identity, and serves it to its end.
/// Returns the connection of a peer that need not.
#[cfg(feature = "secure")]
async fn prove(
    endpoint: &Arc<TcpEndpoint>,
    waiting: Waiting,
    stream: Arc<TcpStream>,
    from: SocketAddr,
    first: &First,
    task: &AbortHandle,
) -> Option<(Waiting, Arc<TcpStream>)> {
    let Some(security) = &endpoint.config.security else {
        return Some((waiting, stream));
    };
    let timeout = endpoint.limits().handshake_timeout;
    let refused = match first {
        First::Byte(tls::FIRST_BYTE) => {
            let slot = waiting.introduces_itself(endpoint, from, task.clone())?;
            match tls::accept(security, Arc::into_inner(stream)?, timeout).await {
                Ok(secured) => {
                    let (link, sink) = endpoint.accepted()?;
                    let reader = FrameReader::new(endpoint.limits().max_letter, BytesMut::new());
                    LinkTask::new(endpoint.stream.clone(), link, sink, None)
                        .serve(
                            secured.ends,
                            secured.proof,
                            reader,
                            Source::Address(from),
                            || {
                                drop(slot);
                            },
                        )
                        .await;
                    return None;
                }
                Err(why) => why,
            }
        }
        First::Byte(_) if !security.covers(from.ip()) || security.excepts(from.ip()) => {
            return Some((waiting, stream));
        }
        First::Byte(_) => {
            "the peer did not begin TLS: it has no keys, but this gateway has and requires them of its \
             peers; set security.keys there (`fipa keys init`) and trust each other's certificates, or \
             remove security.keys here"
                .to_owned()
        }
        First::End => return None,
        First::Broken(error) => error.to_string(),
        First::Silence => "no byte arrived in time (handshake_timeout)".to_owned(),
    };
    if matches!(first, First::Byte(_)) {
        endpoint.config.refusals.add(from.ip(), &refused);
    }
    count(&endpoint.tally().refused_unproved);
    log_limit::warn!(of: quota_address(from.ip()), "{from}: connection refused: {refused}");
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accepting_pauses_while_many_connections_wait_and_are_served() {
        let mut pace = Pace::default();
        assert!(!pace.pauses(Pace::BUSY - 1, 0));
        for departures in 0..1000 {
            assert!(pace.pauses(Pace::BUSY, departures));
        }
        // No connection is served any longer.
        let pauses = (0..1000).filter(|_| pace.pauses(500, 999)).count();
        assert_eq!(pauses as u32, Pace::MAX_PAUSES - 1);
        assert!(pace.pauses(500, 1000));
    }
}
