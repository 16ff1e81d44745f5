//! The listening side: accepting connections and telling by their first byte who is there.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fipa_transport::ListenError;
use socket2::{Domain, Protocol, SockRef, Socket, Type};
use tokio::io::AsyncReadExt;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{sleep, sleep_until, timeout};

use super::config::Limits;
use super::counters::count;
use super::endpoint::{Endpoint, Stranger};
use super::frame::{FrameReader, MAGIC};
use super::link::Running;
use super::proof::Proof;
#[cfg(feature = "secure")]
use super::tls;
use super::unframed;
use super::wire::{Reading, Writing};
use crate::address::{self, AddressError};
use crate::seldom::warn_seldom;

/// Connections that the system holds until they are accepted.
const BACKLOG: i32 = 256;

/// Bytes read at first.
const FIRST_READ: usize = 4096;

/// How long accepting rests when the system has no descriptors left.
const REST: Duration = Duration::from_millis(100);

/// Opens a listening socket, and says where it is reached. To be called within a runtime.
pub(crate) fn listen(text: &str) -> Result<(TcpListener, Vec<SocketAddr>), ListenError> {
    let unavailable = |error: AddressError| ListenError::Unavailable(error.to_string());
    let failed = |source| ListenError::Bind {
        address: text.to_owned(),
        source,
    };
    let address = address::numeric(text).map_err(unavailable)?;
    let socket = open(address).map_err(|error| address::cannot_bind(text, &error))?;
    let bound = socket.local_addr().map_err(failed)?;
    let reachable = address::reachable(bound).map_err(unavailable)?;
    let socket = TcpListener::from_std(socket).map_err(failed)?;
    Ok((socket, reachable))
}

fn open(address: SocketAddr) -> io::Result<std::net::TcpListener> {
    let socket = Socket::new(
        Domain::for_address(address),
        Type::STREAM.nonblocking(),
        Some(Protocol::TCP),
    )?;
    // A restarted process gets its port back although old connections linger. Two listeners on
    // one port stay impossible.
    socket.set_reuse_address(true)?;
    if address.is_ipv6() {
        socket.set_only_v6(true)?;
    }
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    Ok(socket.into())
}

/// What every socket of ours is set to.
pub(crate) fn prepare(stream: &TcpStream, limits: &Limits) -> io::Result<()> {
    stream.set_nodelay(true)?;
    // Bytes that the peer's host does not confirm: a cable was pulled.
    SockRef::from(stream).set_tcp_user_timeout(Some(limits.keep_alive.saturating_mul(2)))
}

/// Accepts connections until it is aborted.
pub(crate) async fn accept(endpoint: Arc<Endpoint>, listener: TcpListener) {
    loop {
        match listener.accept().await {
            Ok((stream, from)) => {
                let Some(place) = endpoint.receive_stranger(from.ip()) else {
                    return;
                };
                let number = place.number;
                let task = receive(endpoint.clone(), place, stream, from);
                let task = tokio::spawn(task).abort_handle();
                endpoint.stranger_started(number, task);
            }
            Err(error) => {
                let before = endpoint
                    .tally()
                    .accept_failures
                    .fetch_add(1, Ordering::Relaxed);
                warn_seldom(
                    before,
                    format_args!("cannot accept a connection: {error} (`ulimit -n`?)"),
                );
                sleep(REST).await;
            }
        }
    }
}

async fn receive(endpoint: Arc<Endpoint>, place: Stranger, stream: TcpStream, from: SocketAddr) {
    if let Err(error) = prepare(&stream, endpoint.limits()) {
        tracing::debug!(%from, "connection broke at once: {error}");
        return;
    }
    let patience = endpoint.limits().handshake_timeout;
    let max_letter = endpoint.limits().max_letter;
    #[cfg(feature = "secure")]
    let (stream, place) = match prove(&endpoint, place, stream, from, patience).await {
        Some(unproved) => unproved,
        None => return,
    };
    let may_frame = endpoint.config.takes_frames_of(from.ip());
    let (mut read, write) = stream.into_split();
    let mut begun = BytesMut::with_capacity(FIRST_READ);
    let refused = match timeout(patience, read.read_buf(&mut begun)).await {
        Ok(Ok(1..)) => match begun.first() {
            Some(first) if *first == MAGIC[0] && may_frame => {
                let Some((link, sink)) = endpoint.accepted() else {
                    return;
                };
                let reader = FrameReader::new(max_letter, begun);
                let ends = (Reading::Plain(read), Writing::Plain(write));
                Running::new(endpoint, link, sink, None)
                    .serve(ends, Proof::default(), reader, from, || drop(place))
                    .await;
                return;
            }
            // A bit-efficient or an XML envelope.
            Some(0xfe | 0xfd | b'<') => match unframed::read(&endpoint, &mut read, begun).await {
                Ok(letter) => {
                    if let Some(ration) = endpoint.ration(from.ip())
                        && let Some(until) = ration.spend(1, letter.len(), Instant::now())
                    {
                        count(&endpoint.tally().held_back);
                        sleep_until(until.into()).await;
                    }
                    unframed::hand_on(&endpoint, letter, from.ip());
                    return;
                }
                Err(refused) => refused.to_string(),
            },
            first => format!("nothing begins with {first:02x?}"),
        },
        // Somebody only looked whether the port is open.
        Ok(Ok(0)) => return,
        Ok(Err(error)) => {
            tracing::debug!(%from, "connection broke at once: {error}");
            return;
        }
        Err(_) => "no byte came in time".to_owned(),
    };
    let counter = &endpoint.tally().refused_nonsense;
    let before = counter.fetch_add(1, Ordering::Relaxed);
    warn_seldom(before, format_args!("{from}: connection closed: {refused}"));
}

/// Has a peer prove who it is, and serves it to its end; or gives back the connection of one that
/// need not.
#[cfg(feature = "secure")]
async fn prove(
    endpoint: &Arc<Endpoint>,
    place: Stranger,
    stream: TcpStream,
    from: SocketAddr,
    patience: Duration,
) -> Option<(TcpStream, Stranger)> {
    let Some(security) = &endpoint.config.security else {
        return Some((stream, place));
    };
    let mut first = [0];
    let refused = match timeout(patience, stream.peek(&mut first)).await {
        Ok(Ok(1..)) if first == [tls::FIRST_BYTE] => {
            match tls::accept(security, stream, patience).await {
                Ok(secured) => {
                    let (link, sink) = endpoint.accepted()?;
                    let proof = Proof::of(security, secured.certificate);
                    let reader = FrameReader::new(endpoint.limits().max_letter, BytesMut::new());
                    Running::new(endpoint.clone(), link, sink, None)
                        .serve(secured.ends, proof, reader, from, || drop(place))
                        .await;
                    return None;
                }
                Err(why) => why,
            }
        }
        Ok(Ok(1..)) if !security.covers(from.ip()) || security.excepts(from.ip()) => {
            return Some((stream, place));
        }
        Ok(Ok(1..)) => "it did not prove who is there".to_owned(),
        // Somebody only looked whether the port is open.
        Ok(Ok(0)) => return None,
        Ok(Err(error)) => error.to_string(),
        Err(_) => "no byte came in time".to_owned(),
    };
    let counter = &endpoint.tally().refused_unproved;
    let before = counter.fetch_add(1, Ordering::Relaxed);
    warn_seldom(
        before,
        format_args!("{from}: connection refused: {refused}"),
    );
    None
}
