//! The calling side: opening a connection to a location.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fipa_transport::{Location, Sink, WayError, WayFault};
use tokio::net::{TcpStream, lookup_host};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::accept::prepare;
use super::config::Limits;
use super::endpoint::Endpoint;
use super::frame::FrameReader;
use super::link::{Link, Running};
use super::proof::Proof;
#[cfg(feature = "secure")]
use super::tls;
use super::wire::{self, Reading, Writing};
use crate::address::{self, Target};
use crate::end::End;

/// How long one address is waited for before the next is tried as well.
const STAGGER: Duration = Duration::from_millis(250);

/// Most addresses of one name that are tried.
const MAX_ADDRESSES: usize = 8;

/// Opens the connection of a link that has been made up, and serves it.
pub(crate) async fn dial(
    endpoint: Arc<Endpoint>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    to: Location,
) {
    let limits = endpoint.limits().clone();
    let running = Running::new(endpoint, link.clone(), sink, Some(to.clone()));
    let unreachable = |what: &dyn std::fmt::Display| {
        let detail = format!("{}: {what}", to.address());
        End::NotOpened(WayError::new(WayFault::Unreachable, detail))
    };
    let connected = tokio::select! {
        connected = open(&limits, to.address()) => connected,
        end = link.leaving() => return running.fail(end),
    };
    let (stream, peer) = match connected {
        Ok(connected) => connected,
        Err(Unreachable(what)) => return running.fail(unreachable(&what)),
    };
    if let Err(error) = prepare(&stream, &limits) {
        return running.fail(unreachable(&error));
    }
    let (ends, proof) = tokio::select! {
        proved = prove(&running, stream, peer) => match proved {
            Ok(proved) => proved,
            Err(why) => return running.fail(unreachable(&why)),
        },
        end = link.leaving() => return running.fail(end),
    };
    link.connected(Instant::now());
    let reader = FrameReader::new(limits.max_letter, BytesMut::new());
    running.serve(ends, proof, reader, peer, || {}).await;
}

/// Has the peer prove who it is, where it has to.
#[cfg(feature = "secure")]
async fn prove(
    running: &Running,
    stream: TcpStream,
    peer: SocketAddr,
) -> Result<((Reading, Writing), Proof), String> {
    let config = &running.endpoint().config;
    match &config.security {
        Some(security) if security.covers(peer.ip()) => {
            let patience = config.limits.handshake_timeout;
            let secured = tls::connect(security, stream, peer, patience).await?;
            Ok((secured.ends, Proof::of(security, secured.certificate)))
        }
        _ => Ok((wire::plain(stream), Proof::default())),
    }
}

/// Nobody has to prove anything.
#[cfg(not(feature = "secure"))]
async fn prove(
    _running: &Running,
    stream: TcpStream,
    _peer: SocketAddr,
) -> Result<((Reading, Writing), Proof), String> {
    Ok((wire::plain(stream), Proof::default()))
}

/// Why no connection could be opened.
pub(crate) struct Unreachable(pub(crate) String);

/// Opens a connection to an address.
pub(crate) async fn open(
    limits: &Limits,
    address: &str,
) -> Result<(TcpStream, SocketAddr), Unreachable> {
    first(limits, address, connect).await
}

/// Has `connect` try the addresses that are meant, until one answers.
pub(crate) async fn first<T, F>(
    limits: &Limits,
    address: &str,
    connect: impl Fn(SocketAddr) -> F,
) -> Result<T, Unreachable>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    let target = address::target(address).map_err(|error| Unreachable(error.to_string()))?;
    let connecting = async {
        match target {
            Target::Numeric(address) => race(vec![address], connect).await,
            Target::Named(name, port) => {
                let found = lookup_host((name.as_str(), port)).await?;
                race(alternating(found.take(MAX_ADDRESSES).collect()), connect).await
            }
        }
    };
    let patience = limits.connect_timeout;
    match timeout(patience, connecting).await {
        Ok(connected) => connected.map_err(|error| Unreachable(error.to_string())),
        Err(_) => Err(Unreachable(format!(
            "no connection within {patience:?} (connect_timeout)"
        ))),
    }
}

/// Connects to whichever address answers first. The next is tried when the one before has failed or
/// has not answered for a while (RFC 8305 section 5).
async fn race<T, F>(addresses: Vec<SocketAddr>, connect: impl Fn(SocketAddr) -> F) -> io::Result<T>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    let mut waiting = addresses.into_iter();
    let mut racing = JoinSet::new();
    loop {
        if let Some(address) = waiting.next() {
            racing.spawn(connect(address));
        } else if racing.is_empty() {
            return Err(last);
        }
        let is_last = waiting.len() == 0;
        tokio::select! {
            Some(ended) = racing.join_next() => match ended {
                Ok(Ok(connected)) => return Ok(connected),
                Ok(Err(error)) => last = error,
                Err(error) => last = io::Error::other(error),
            },
            () = sleep(STAGGER), if !is_last => {}
        }
    }
}

async fn connect(address: SocketAddr) -> io::Result<(TcpStream, SocketAddr)> {
    let stream = TcpStream::connect(address).await?;
    // Where nobody listens on a port of its own range, a host can connect to itself.
    if stream.local_addr()? == stream.peer_addr()? {
        return Err(io::ErrorKind::ConnectionRefused.into());
    }
    Ok((stream, address))
}

/// The families take turns, beginning with that of the first address (RFC 8305 section 4).
fn alternating(addresses: Vec<SocketAddr>) -> Vec<SocketAddr> {
    let Some(first) = addresses.first().copied() else {
        return addresses;
    };
    let (same, other): (Vec<_>, Vec<_>) = addresses
        .into_iter()
        .partition(|address| address.is_ipv4() == first.is_ipv4());
    let (mut same, mut other) = (same.into_iter(), other.into_iter());
    let mut all = Vec::new();
    loop {
        let turn = [same.next(), other.next()];
        if turn == [None, None] {
            return all;
        }
        all.extend(turn.into_iter().flatten());
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    #[test]
    fn families_take_turns() {
        let parse = |texts: &[&str]| -> Vec<SocketAddr> {
            texts.iter().map(|text| text.parse().unwrap()).collect()
        };
        let mixed = parse(&["[::1]:1", "[::2]:1", "[::3]:1", "127.0.0.1:1"]);
        let turns = parse(&["[::1]:1", "127.0.0.1:1", "[::2]:1", "[::3]:1"]);
        assert_eq!(alternating(mixed), turns);
        assert_eq!(alternating(Vec::new()), Vec::new());
    }

    #[tokio::test]
    async fn an_address_that_is_silent_or_refuses_holds_up_nobody() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let there = listener.local_addr().unwrap();
        // A queue of one, and it is taken: the system answers no more.
        let full =
            socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).unwrap();
        full.bind(&SocketAddr::from((Ipv4Addr::LOCALHOST, 0)).into())
            .unwrap();
        full.listen(0).unwrap();
        let silent = full.local_addr().unwrap().as_socket().unwrap();
        let _first = TcpStream::connect(silent).await.unwrap();
        let refusing = tokio::net::TcpSocket::new_v4().unwrap();
        refusing.bind("127.0.0.1:0".parse().unwrap()).unwrap();
        let refusing_at = refusing.local_addr().unwrap();
        let (_, reached) = race(vec![silent, refusing_at, there], connect)
            .await
            .unwrap();
        assert_eq!(reached, there);
        assert!(race(vec![refusing_at], connect).await.is_err());
        assert!(race(Vec::new(), connect).await.is_err());
    }
}
