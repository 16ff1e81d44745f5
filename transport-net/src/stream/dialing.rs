//! The addresses of a location, and the order in which they are tried.

use std::collections::HashSet;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use fipa_transport::{Kind, Location, Sink, log_limit};
use parking_lot::Mutex;
use tokio::task::JoinSet;
use tokio::time::sleep;

use super::endpoint::Endpoint;
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

/// The addresses of other hosts from which no packet came back. The first failure is logged as a
/// warning, because in most cases a firewall is the cause, and a letter alone does not show it.
#[derive(Debug, Default)]
pub(crate) struct SilentPeers(Mutex<HashSet<String>>);

impl SilentPeers {
    /// Maximum number of addresses, because other hosts announce them.
    const MAX: usize = 64;

    /// Logs that nothing answered at this location.
    fn failed(&self, to: &Location, what: &str) {
        if self.insert(to.address()) {
            log_limit::warn!(of: to.address(), "{to} is unreachable: {what}");
        } else {
            tracing::debug!("{to} is still unreachable: {what}");
        }
    }

    /// Returns whether this is the first failure of this address.
    fn insert(&self, address: &str) -> bool {
        let mut silent = self.0.lock();
        silent.len() < Self::MAX && silent.insert(address.to_owned())
    }

    /// Forgets a location that answers: its next failure is logged again.
    fn answered(&self, to: &Location) {
        if self.0.lock().remove(to.address()) {
            log_limit::info!(of: to.address(), "{to} answers");
        }
    }
}

/// Tries these addresses of a location with `connect`, until one succeeds or the link ends.
pub(crate) async fn reach<T, F>(
    endpoint: &Endpoint,
    link: &Link,
    to: &Location,
    addresses: Vec<String>,
    connect: impl Fn(SocketAddr) -> F + Clone + Send + Sync + 'static,
) -> Result<T, ConnectionEnd>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    let protocol = match to.kind() {
        Kind::Tcp => "tcp",
        _ => "udp",
    };
    tokio::select! {
        connected = first(endpoint, protocol, addresses, connect) => match connected {
            Ok(connected) => {
                endpoint.silent_peers().answered(to);
                Ok(connected)
            }
            Err(Unreachable { what, is_silent }) => {
                if is_silent {
                    endpoint.silent_peers().failed(to, &what);
                }
                Err(ConnectionEnd::unreachable(to, &what))
            }
        },
        end = link.end_requested() => Err(end),
    }
}

/// The error of opening a connection.
pub(crate) struct Unreachable {
    /// The cause, as text.
    pub(crate) what: String,
    /// Whether no packet came back.
    is_silent: bool,
}

/// Tries these addresses with `connect` until one succeeds, except those of the endpoint itself.
/// `protocol` is that of the ports: `tcp` or `udp`.
pub(crate) async fn first<T, F>(
    endpoint: &Endpoint,
    protocol: &str,
    addresses: Vec<String>,
    connect: impl Fn(SocketAddr) -> F + Clone + Send + Sync + 'static,
) -> Result<T, Unreachable>
where
    T: Send + 'static,
    F: Future<Output = io::Result<T>> + Send + 'static,
{
    let own = Arc::new(endpoint.own());
    let connect = move |address| {
        let connecting = match own.is_own(address) {
            true => Err(io::Error::new(
                io::ErrorKind::AddrInUse,
                address::itself(address),
            )),
            false => Ok(connect(address)),
        };
        async move { connecting?.await }
    };
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
    let timeout = endpoint.limits().connect_timeout;
    match tokio::time::timeout(timeout, race(attempts)).await {
        Ok(connected) => connected.map_err(|error| Unreachable {
            what: error.to_string(),
            is_silent: error.kind() == io::ErrorKind::TimedOut,
        }),
        Err(_) => Err(Unreachable {
            what: nothing_answered(&all, protocol, timeout),
            is_silent: true,
        }),
    }
}

/// The error when no packet came back, which in most cases means that a firewall drops them.
fn nothing_answered(addresses: &str, protocol: &str, timeout: Duration) -> String {
    let seconds = timeout.as_secs_f32();
    let port = addresses.rsplit(':').next().unwrap_or_default();
    format!(
        "nothing answered on {addresses} for {seconds} s; check that a firewall there lets it in (for \
         example: sudo ufw allow {port}/{protocol})"
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
            let found = address::look_up(name, port).await?;
            let addresses = alternating(found.into_iter().take(MAX_ADDRESSES).collect());
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

    #[test]
    fn a_silent_peer_is_reported_once_until_it_answers() {
        let silent = SilentPeers::default();
        let to: Location = "tcp://10.0.0.2:7788".parse().unwrap();
        assert!(silent.insert(to.address()));
        assert!(!silent.insert(to.address()));
        silent.answered(&to);
        assert!(silent.insert(to.address()));
        // Announcements of others do not fill the log.
        let reported = (0..1000).filter(|port| silent.insert(&format!("10.0.0.3:{port}")));
        assert_eq!(reported.count(), SilentPeers::MAX - 1);
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
