//! The calling side: opening a connection to a location.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fipa_transport::{Location, Sink};
use tokio::net::{TcpStream, lookup_host};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::accept::prepare;
#[cfg(feature = "secure")]
use super::tls;
use crate::address::{self, Target};
use crate::end::End;
use crate::stream::config::Limits;
use crate::stream::endpoint::Endpoint;
use crate::stream::frame::FrameReader;
use crate::stream::link::{Link, Running};
use crate::stream::proof::Proof;
use crate::stream::source::Source;
use crate::stream::wire::{self, Reading, Writing};

/// How long one address is waited for before the next is tried as well.
const STAGGER: Duration = Duration::from_millis(250);

/// How long an address is waited for before it is asked again, and how often it is asked.
const ASKED_AGAIN: Duration = Duration::from_millis(400);
const MAX_ASKED: usize = 4;

/// Most addresses of one name, or of one service, that are tried.
const MAX_ADDRESSES: usize = 8;

/// Opens the connection of a link that has been made up, and serves it.
pub(crate) async fn dial(
    endpoint: Arc<Endpoint>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    to: Location,
) {
    let limits = endpoint.limits().clone();
    let addresses = addresses(&*sink, &to);
    let running = Running::new(endpoint, link.clone(), sink, Some(to.clone()));
    let (stream, peer) = match reach(&limits, &link, &to, addresses, insist).await {
        Ok(connected) => connected,
        Err(end) => return running.fail(end),
    };
    if let Err(error) = prepare(&stream, &limits) {
        return running.fail(End::unreachable(&to, &error));
    }
    let (ends, proof) = tokio::select! {
        proved = prove(&running, stream, peer) => match proved {
            Ok(proved) => proved,
            Err(why) => return running.fail(End::unreachable(&to, &why)),
        },
        end = link.leaving() => return running.fail(end),
    };
    link.connected(Instant::now());
    let reader = FrameReader::new(limits.max_letter, BytesMut::new());
    running
        .serve(ends, proof, reader, Source::Address(peer), || {})
        .await;
}

/// The address of a location, and those at which the same service is as well. Only where the peer
/// says that it is this service: at another's address there may be somebody else by now.
pub(crate) fn addresses(sink: &dyn Sink, to: &Location) -> Vec<String> {
    let mut addresses = vec![to.address().to_owned()];
    if to.incarnation().is_known() {
        let same = |other: &Location| {
            other.kind() == to.kind()
                && other.signature() == to.signature()
                && other.incarnation() == to.incarnation()
        };
        let others = sink.also_at(to).into_iter().filter(same);
        addresses.extend(others.map(|other| other.address().to_owned()));
        addresses.truncate(MAX_ADDRESSES);
    }
    addresses
}

/// Has `connect` try these addresses of a location, until one answers or the link is left.
pub(crate) async fn reach<T, F>(
    limits: &Limits,
    link: &Link,
    to: &Location,
    addresses: Vec<String>,
    connect: impl Fn(SocketAddr) -> F + Clone + Send + Sync + 'static,
) -> Result<T, End>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    tokio::select! {
        connected = first(limits, addresses, connect) => {
            connected.map_err(|Unreachable(what)| End::unreachable(to, &what))
        }
        end = link.leaving() => Err(end),
    }
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
        Some(security) if !config.takes_frames_of(peer.ip()) => {
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

/// Opens a connection to whichever of these addresses answers first.
pub(crate) async fn open(
    limits: &Limits,
    addresses: Vec<String>,
) -> Result<(TcpStream, SocketAddr), Unreachable> {
    first(limits, addresses, connect).await
}

/// Has `connect` try these addresses, until one answers.
async fn first<T, F>(
    limits: &Limits,
    addresses: Vec<String>,
    connect: impl Fn(SocketAddr) -> F + Clone + Send + Sync + 'static,
) -> Result<T, Unreachable>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    let several = addresses.len() > 1;
    let attempts = addresses.into_iter().map(|address| {
        let connect = connect.clone();
        async move {
            let connected = target(&address, connect).await;
            connected.map_err(|error| match several {
                true => io::Error::new(error.kind(), format!("{address}: {error}")),
                false => error,
            })
        }
    });
    let patience = limits.connect_timeout;
    match timeout(patience, race(attempts)).await {
        Ok(connected) => connected.map_err(|error| Unreachable(error.to_string())),
        Err(_) => Err(Unreachable(format!(
            "no connection within {patience:?} (connect_timeout)"
        ))),
    }
}

/// Has `connect` try what an address means.
async fn target<T, F>(address: &str, connect: impl Fn(SocketAddr) -> F) -> io::Result<T>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    let target = address::target(address);
    match target.map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, error))? {
        Target::Numeric(address) => connect(address).await,
        Target::Named(name, port) => {
            let found = lookup_host((name.as_str(), port)).await?;
            let addresses = alternating(found.take(MAX_ADDRESSES).collect());
            race(addresses.into_iter().map(connect)).await
        }
    }
}

/// What the first of these attempts to succeed yields. The next is begun when the one before has
/// failed or has not answered for a while (RFC 8305 section 5).
async fn race<T, F>(attempts: impl IntoIterator<Item = F>) -> io::Result<T>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    let mut waiting = attempts.into_iter().peekable();
    let mut racing = JoinSet::new();
    loop {
        if let Some(attempt) = waiting.next() {
            racing.spawn(attempt);
        } else if racing.is_empty() {
            return Err(last);
        }
        let is_last = waiting.peek().is_none();
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

/// Opens a connection, and another one after a while when there is no answer: the system repeats a lost
/// SYN after one second, and then after two. The first one to be open is used.
async fn insist(address: SocketAddr) -> io::Result<(TcpStream, SocketAddr)> {
    let mut asked = JoinSet::new();
    loop {
        asked.spawn(connect(address));
        tokio::select! {
            Some(ended) = asked.join_next() => return ended.unwrap_or_else(|e| Err(io::Error::other(e))),
            () = sleep(ASKED_AGAIN), if asked.len() < MAX_ASKED => {}
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
        let all = [silent, refusing_at, there].map(connect);
        let (_, reached) = race(all).await.unwrap();
        assert_eq!(reached, there);
        assert!(race([connect(refusing_at)]).await.is_err());
        assert!(race(Vec::new().into_iter().map(connect)).await.is_err());
    }
}
