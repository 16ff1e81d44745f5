//! Hostile peers, each with its own address on the loopback network, and a sink that reads and
//! discards all input.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpSocket, TcpStream, UdpSocket};
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};

/// Behavior of a hostile peer. Each rate is per peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Vice {
    /// Opens connections and sends nothing.
    Silence,
    /// Sends a TLS handshake at one byte per 50 ms.
    Slowness,
    /// Opens connections and writes bytes of no protocol, 20 times per second.
    Garbage,
    /// Opens connections and closes them, 100 times per second.
    Reconnecting,
    /// Starts TLS handshakes and closes the connection after the first answer, 50 times per second.
    Handshakes,
    /// Writes 2,000 letters per second.
    Letters,
    /// Announces letters of 60 MiB and sends 64 bytes of them every 100 ms.
    Announcing,
    /// Writes 500 letters per second and never reads the answers.
    Deafness,
    /// Starts UDP connections, 500 times per second.
    Hellos,
    /// Starts QUIC connections, 200 times per second.
    Initials,
}

use Vice::*;

/// Number of hostile peers when no kinds are named.
const PEERS: usize = 50;

/// Environment variable with the kinds of hostile peers, separated by commas. There is one peer of each.
const KINDS: &str = "FIPA_LOAD_KINDS";

/// Behaviors against a gateway with keys. The gateway never reads letters of untrusted peers.
pub(crate) const AT_KEYS: [Vice; 10] = [
    Silence,
    Slowness,
    Garbage,
    Reconnecting,
    Handshakes,
    Initials,
    Letters,
    Announcing,
    Deafness,
    Initials,
];

/// Behaviors against a gateway without keys.
pub(crate) const IN_THE_CLEAR: [Vice; 10] = [
    Silence,
    Slowness,
    Garbage,
    Reconnecting,
    Letters,
    Announcing,
    Deafness,
    Hellos,
    Hellos,
    Reconnecting,
];

/// Target addresses and prepared bytes of the hostile peers.
#[derive(Debug, Default)]
pub(crate) struct Means {
    pub(crate) tcp: Option<SocketAddr>,
    pub(crate) datagrams: Option<SocketAddr>,
    /// The start of a TLS handshake.
    pub(crate) client_hello: Vec<u8>,
    /// First datagrams of QUIC connections.
    pub(crate) initials: Vec<Vec<u8>>,
    /// A hello of the UDP transport.
    pub(crate) hello: Vec<u8>,
    /// A hello, as a frame of a connection.
    pub(crate) greeting: Vec<u8>,
    /// A small letter, as a frame of a connection.
    pub(crate) letter: Vec<u8>,
    /// The start of a frame with a large letter.
    pub(crate) announcement: Vec<u8>,
}

fn address(peer: u8) -> IpAddr {
    IpAddr::V4(Ipv4Addr::new(127, 0, 1, peer + 1))
}

/// Starts the hostile peers: one of each kind that the environment variable names, or the same number of
/// each of these. They run until the runtime ends.
pub(crate) fn set_off(vices: &[Vice], means: &Arc<Means>) {
    let peers = match std::env::var(KINDS) {
        Ok(kinds) => kinds.split(',').map(|kind| named(kind, vices)).collect(),
        Err(_) => vices
            .iter()
            .copied()
            .cycle()
            .take(PEERS)
            .collect::<Vec<_>>(),
    };
    for (peer, vice) in (0..).zip(peers) {
        tokio::spawn(indulge(vice, address(peer), Arc::clone(means)));
    }
}

/// The behavior with this name, in lower case.
fn named(name: &str, vices: &[Vice]) -> Vice {
    let is_named = |vice: &&Vice| format!("{vice:?}").to_lowercase() == name;
    let found = vices.iter().find(is_named).copied();
    found.unwrap_or_else(|| panic!("{KINDS}: {name:?} is none of {vices:?}"))
}

async fn indulge(vice: Vice, from: IpAddr, means: Arc<Means>) {
    let (per_second, at_once) = match vice {
        Silence | Slowness | Announcing => (10, 4),
        Letters => (2000, 1),
        Deafness => (500, 1),
        Garbage => (20, 1),
        Reconnecting => (100, 1),
        Handshakes => (50, 1),
        Hellos => (500, 1),
        Initials => (200, 1),
    };
    match vice {
        Hellos | Initials => datagrams(vice, from, &means, per_second).await,
        _ => {
            for _ in 0..at_once {
                let means = Arc::clone(&means);
                tokio::spawn(async move {
                    let mut pace = pace(per_second);
                    loop {
                        pace.tick().await;
                        if let Some(stream) = connect(from, &means).await {
                            connection(vice, stream, &means, &mut pace).await;
                        }
                    }
                });
            }
        }
    }
}

fn pace(per_second: u64) -> tokio::time::Interval {
    let mut pace = interval(Duration::from_secs(1) / u32::try_from(per_second).unwrap());
    // A timer fires at most once per millisecond. Missed ticks follow in a burst.
    pace.set_missed_tick_behavior(MissedTickBehavior::Burst);
    pace
}

async fn connect(from: IpAddr, means: &Means) -> Option<TcpStream> {
    let socket = TcpSocket::new_v4().unwrap();
    // Closing with a reset avoids TIME_WAIT, so that the ports suffice.
    socket.set_zero_linger().ok()?;
    socket.bind((from, 0).into()).ok()?;
    let connecting = socket.connect(means.tcp?);
    timeout(Duration::from_secs(2), connecting).await.ok()?.ok()
}

/// Runs the behavior on one connection until the gateway closes it. A failed write ends the
/// connection.
async fn connection(
    vice: Vice,
    mut stream: TcpStream,
    means: &Means,
    pace: &mut tokio::time::Interval,
) {
    let mut sink = [0; 4096];
    match vice {
        Silence => {
            let _ = stream.read(&mut sink).await;
        }
        Slowness => {
            for byte in &means.client_hello {
                if stream.write_all(&[*byte]).await.is_err() {
                    return;
                }
                sleep(Duration::from_millis(50)).await;
            }
        }
        Garbage => {
            let _ = stream.write_all(&[0x5a; 4096]).await;
        }
        Handshakes => {
            if stream.write_all(&means.client_hello).await.is_ok() {
                // Waits for the first answer.
                let _ = timeout(Duration::from_secs(2), stream.read(&mut sink)).await;
            }
        }
        Announcing => {
            if stream.write_all(&means.greeting).await.is_err()
                || stream.write_all(&means.announcement).await.is_err()
            {
                return;
            }
            while stream.write_all(&[0; 64]).await.is_ok() {
                sleep(Duration::from_millis(100)).await;
            }
        }
        Letters | Deafness => {
            if stream.write_all(&means.greeting).await.is_err() {
                return;
            }
            let (mut read, mut write) = stream.into_split();
            let write = async {
                for id in 1_u64.. {
                    pace.tick().await;
                    let mut letter = means.letter.clone();
                    letter[8..16].copy_from_slice(&id.to_le_bytes());
                    if write.write_all(&letter).await.is_err() {
                        return;
                    }
                }
            };
            let read = async {
                if vice == Letters {
                    while matches!(read.read(&mut sink).await, Ok(1..)) {}
                } else {
                    std::future::pending().await
                }
            };
            tokio::select! { () = write => {}, () = read => {} }
        }
        Reconnecting | Hellos | Initials => {}
    }
}

async fn datagrams(vice: Vice, from: IpAddr, means: &Means, per_second: u64) {
    let Some(to) = means.datagrams else { return };
    let socket = UdpSocket::bind((from, 0)).await.unwrap();
    let mut pace = pace(per_second);
    for number in 1_u64.. {
        pace.tick().await;
        if vice == Initials {
            let packet = &means.initials[number as usize % means.initials.len()];
            let _ = socket.send_to(packet, to).await;
        } else {
            let mut hello = means.hello.clone();
            hello[16..24].copy_from_slice(&number.to_le_bytes());
            let _ = socket.send_to(&hello, to).await;
        }
    }
}

/// Starts a sink that reads and discards all input. Returns its TCP and UDP addresses.
pub(crate) async fn sink() -> (SocketAddr, SocketAddr) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let at = (listener.local_addr().unwrap(), socket.local_addr().unwrap());
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            tokio::spawn(async move {
                let mut bytes = [0; 4096];
                let taking = async { while matches!(stream.read(&mut bytes).await, Ok(1..)) {} };
                // The timeout of a gateway for silent peers.
                let _ = timeout(Duration::from_secs(5), taking).await;
            });
        }
    });
    tokio::spawn(async move {
        let mut bytes = vec![0; 65_536];
        loop {
            // Receive errors are irrelevant for the sink.
            let _ = socket.recv_from(&mut bytes).await;
        }
    });
    at
}
