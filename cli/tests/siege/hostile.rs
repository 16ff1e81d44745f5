//! Peers who mean no good, each at an address of its own on the loopback network, and somebody who
//! takes whatever comes.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpSocket, TcpStream, UdpSocket};
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};

/// What they do. Each rate is that of one peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Vice {
    /// Opens connections and says nothing.
    Silence,
    /// Begins a handshake and goes on with a byte every 50 ms.
    Slowness,
    /// Opens connections and writes what means nothing, 20 times a second.
    Garbage,
    /// Opens connections and closes them, 100 times a second.
    Reconnecting,
    /// Has the other side begin a TLS handshake, and leaves, 50 times a second.
    Handshakes,
    /// Writes 2,000 letters a second.
    Letters,
    /// Announces letters of 60 MiB and sends them drop by drop.
    Announcing,
    /// Writes 500 letters a second and never reads what is said about them.
    Deafness,
    /// Begins UDP connections, 500 times a second.
    Hellos,
    /// Begins QUIC connections, 200 times a second.
    Initials,
}

use Vice::*;

/// How many there are.
pub(crate) const PEERS: u8 = 50;

/// What those do who come to a gateway with keys; whom it does not trust never gets to letters.
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

/// What those do who come to a gateway in the clear.
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

/// What they know and have.
#[derive(Debug, Default)]
pub(crate) struct Means {
    pub(crate) tcp: Option<SocketAddr>,
    pub(crate) datagrams: Option<SocketAddr>,
    /// The beginning of a TLS handshake.
    pub(crate) client_hello: Vec<u8>,
    /// First datagrams of QUIC connections.
    pub(crate) initials: Vec<Vec<u8>>,
    /// A hello of the UDP transport.
    pub(crate) hello: Vec<u8>,
    /// A hello, as it stands on connections.
    pub(crate) greeting: Vec<u8>,
    /// A small letter, as it stands on connections.
    pub(crate) letter: Vec<u8>,
    /// The beginning of a large one.
    pub(crate) announcement: Vec<u8>,
}

fn address(peer: u8) -> IpAddr {
    IpAddr::V4(Ipv4Addr::new(127, 0, 1, peer + 1))
}

/// Does what they do, until the runtime ends.
pub(crate) fn set_off(vices: &[Vice], means: &Arc<Means>) {
    for peer in 0..PEERS {
        let vice = vices[usize::from(peer) % vices.len()];
        tokio::spawn(indulge(vice, address(peer), Arc::clone(means)));
    }
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
    // A timer goes off every millisecond at most; what was missed is made up for.
    pace.set_missed_tick_behavior(MissedTickBehavior::Burst);
    pace
}

async fn connect(from: IpAddr, means: &Means) -> Option<TcpStream> {
    let socket = TcpSocket::new_v4().unwrap();
    // Closed with a reset, so that ports do not run out.
    socket.set_zero_linger().ok()?;
    socket.bind((from, 0).into()).ok()?;
    let connecting = socket.connect(means.tcp?);
    timeout(Duration::from_secs(2), connecting).await.ok()?.ok()
}

/// What is done on one connection, until the other side has had enough. Whatever is written may not
/// arrive any more, which ends it.
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
                // Until it has been answered.
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

/// Takes whatever comes and does nothing about it; says where.
pub(crate) async fn sink() -> (SocketAddr, SocketAddr) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let at = (listener.local_addr().unwrap(), socket.local_addr().unwrap());
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            tokio::spawn(async move {
                let mut bytes = [0; 4096];
                let taking = async { while matches!(stream.read(&mut bytes).await, Ok(1..)) {} };
                // As long as a gateway waits for those who say nothing.
                let _ = timeout(Duration::from_secs(5), taking).await;
            });
        }
    });
    tokio::spawn(async move {
        let mut bytes = vec![0; 65_536];
        loop {
            // What cannot be received is not missed.
            let _ = socket.recv_from(&mut bytes).await;
        }
    });
    at
}
