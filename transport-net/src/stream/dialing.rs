//! The addresses of a location, and the order in which they are tried.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use fipa_transport::{Location, Sink};
use tokio::net::lookup_host;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::config::Limits;
use super::link::Link;
use crate::address::{self, Target};
use crate::end::ConnectionEnd;

/// Time after which the next address is tried as well.
const STAGGER: Duration = Duration::from_millis(250);

/// Maximum number of addresses that are tried, of one name or one service.
const MAX_ADDRESSES: usize = 8;

/// Returns the address of a location and the other addresses of the same service. The others are
/// only used with a known incarnation, because another service may have the address by now.
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

/// Tries these addresses of a location with `connect`, until one succeeds or the link ends.
pub(crate) async fn reach<T, F>(
    limits: &Limits,
    link: &Link,
    to: &Location,
    addresses: Vec<String>,
    connect: impl Fn(SocketAddr) -> F + Clone + Send + Sync + 'static,
) -> Result<T, ConnectionEnd>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    tokio::select! {
        connected = first(limits, addresses, connect) => {
            connected.map_err(|Unreachable(what)| ConnectionEnd::unreachable(to, &what))
        }
        end = link.leaving() => Err(end),
    }
}

/// The error of opening a connection.
pub(crate) struct Unreachable(pub(crate) String);

/// Tries these addresses with `connect` until one succeeds.
pub(crate) async fn first<T, F>(
    limits: &Limits,
    addresses: Vec<String>,
    connect: impl Fn(SocketAddr) -> F + Clone + Send + Sync + 'static,
) -> Result<T, Unreachable>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    let several = addresses.len() > 1;
    let all = addresses.join(", ");
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
        Err(_) => Err(Unreachable(nothing_answered(&all, patience))),
    }
}

/// The error when no packet came back, which in most cases means that a firewall drops them.
fn nothing_answered(addresses: &str, patience: Duration) -> String {
    let seconds = patience.as_secs_f32();
    let port = addresses.rsplit(':').next().unwrap_or_default();
    format!(
        "nothing answered on {addresses} for {seconds} s; check that a firewall there lets it in (for \
         example: sudo ufw allow {port})"
    )
}

/// Resolves an address and tries the results with `connect`.
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

/// Returns the result of the first successful attempt. The next attempt begins when the previous
/// one has failed or has not completed within [`STAGGER`] (RFC 8305 section 5).
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

/// Alternates the address families, beginning with that of the first address (RFC 8305 section 4).
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

    use tokio::net::TcpStream;

    use super::*;

    async fn connect(address: SocketAddr) -> io::Result<SocketAddr> {
        TcpStream::connect(address).await?.peer_addr()
    }

    #[test]
    fn address_families_alternate() {
        let parse = |texts: &[&str]| -> Vec<SocketAddr> {
            texts.iter().map(|text| text.parse().unwrap()).collect()
        };
        let mixed = parse(&["[::1]:1", "[::2]:1", "[::3]:1", "127.0.0.1:1"]);
        let turns = parse(&["[::1]:1", "127.0.0.1:1", "[::2]:1", "[::3]:1"]);
        assert_eq!(alternating(mixed), turns);
        assert_eq!(alternating(Vec::new()), Vec::new());
    }

    #[tokio::test]
    async fn a_silent_or_refusing_address_does_not_delay_the_others() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let there = listener.local_addr().unwrap();
        // The accept queue has one slot, which is taken: the system ignores further connections.
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
        let reached = race(all).await.unwrap();
        assert_eq!(reached, there);
        assert!(race([connect(refusing_at)]).await.is_err());
        assert!(race(Vec::new().into_iter().map(connect)).await.is_err());
    }
}
