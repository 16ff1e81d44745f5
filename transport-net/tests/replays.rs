//! Recorded bytes that an attacker replays have no effect.
#![cfg(feature = "quic")]
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use common::certificates::Host;
use common::intruder::{ONLY_13, PROTOCOL, ROGUE, client, hello_and_letter, quic};
use common::{NAME, Party, Recorder, accepted, config, parcel, quic_config};
use fipa_testbed::until_some;
use fipa_transport::{Conclusion, Kind, Location};
use fipa_transport_net::secure::Security;
use fipa_transport_net::{QuicTransport, TcpTransport};
use parking_lot::Mutex;
use rustls::pki_types::ServerName;
use rustls::{ClientConnection, HandshakeKind, StreamOwned};

/// Timeout of a hung operation.
const WATCHDOG: Duration = Duration::from_secs(30);

/// Letters of the recorded conversations.
const LETTERS: u64 = 5;

fn tcp(security: Security) -> Party<TcpTransport> {
    let mut config = config(&["127.0.0.1:0"]);
    config.security = Some(security);
    Party::with(config)
}

fn over_quic(security: Security) -> Party<QuicTransport> {
    let config = quic_config(&["127.0.0.1:0"], security);
    Party::over(Recorder::default(), |runtime| {
        QuicTransport::new(config, runtime)
    })
}

fn securities() -> (Security, Security) {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    (rover.security(&[&crex]), crex.security(&[&rover]))
}

/// The recorded bytes of both sides of one TCP connection: the dialing side, and the accepting
/// side.
type Recording = JoinHandle<[Vec<u8>; 2]>;

/// Forwards one connection, and records its bytes.
fn record(behind: SocketAddr) -> (Location, Recording) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let front = listener.local_addr().unwrap().to_string();
    let recording = std::thread::spawn(move || {
        let (dialler, _) = listener.accept().unwrap();
        let other = TcpStream::connect(behind).unwrap();
        let pass = |mut from: TcpStream, mut to: TcpStream| {
            std::thread::spawn(move || {
                let (mut all, mut bytes) = (Vec::new(), [0; 4096]);
                while let Ok(len @ 1..) = from.read(&mut bytes) {
                    all.extend(&bytes[..len]);
                    if to.write_all(&bytes[..len]).is_err() {
                        break;
                    }
                }
                // The connection may be closed already.
                let _ = to.shutdown(Shutdown::Write);
                all
            })
        };
        let there = pass(dialler.try_clone().unwrap(), other.try_clone().unwrap());
        let back = pass(other, dialler);
        [there, back].map(|passing| passing.join().unwrap())
    });
    (Location::new(Kind::Tcp, &front).unwrap(), recording)
}

#[test]
fn a_replayed_tls_connection_delivers_nothing() {
    let (rover, crex) = securities();
    let to = tcp(crex);
    let (front, recording) = record(to.location().address().parse().unwrap());
    let from = tcp(rover.clone());
    for attempt in 1..=LETTERS {
        from.send(attempt, &front, parcel(attempt, "secret"))
            .unwrap();
        assert_eq!(from.conclusion(attempt), accepted());
    }
    fipa_transport::Transport::close(&from.transport);
    let [said, answered] = recording.join().unwrap();
    assert!(
        !said.windows(6).any(|part| part == b"secret"),
        "in the clear"
    );
    for _ in 0..3 {
        let mut again = TcpStream::connect(to.location().address()).unwrap();
        again.set_read_timeout(Some(WATCHDOG)).unwrap();
        // It may close the connection in the middle.
        let _ = again.write_all(&said);
        let _ = again.shutdown(Shutdown::Write);
        let _ = again.read_to_end(&mut Vec::new());
    }
    until_some("each was refused", || {
        (to.transport.counters().refused_unproved == 3).then_some(())
    });
    assert_eq!(to.arrivals() as u64, LETTERS);
    // Nor is a replay of the accepting side accepted.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap().to_string();
    let player = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        // As above.
        let _ = stream.write_all(&answered);
        let _ = stream.read_to_end(&mut Vec::new());
    });
    let from = tcp(rover);
    let at = Location::new(Kind::Tcp, &at).unwrap();
    from.send(1, &at, parcel(1, "secret")).unwrap();
    assert!(matches!(from.conclusion(1), Conclusion::NotSent(_)));
    player.join().unwrap();
}

/// A relay between two QUIC endpoints that forwards every datagram of the dialing one twice, and
/// records them.
struct Repeater {
    front: Location,
    recorded: Arc<Mutex<Vec<Vec<u8>>>>,
    /// The socket that the accepting endpoint sees.
    back: UdpSocket,
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Repeater {
    fn before(behind: &str) -> Self {
        let front = UdpSocket::bind("127.0.0.1:0").unwrap();
        let at = front.local_addr().unwrap().to_string();
        let back = UdpSocket::bind("127.0.0.1:0").unwrap();
        back.connect(behind).unwrap();
        back.set_nonblocking(true).unwrap();
        front
            .set_read_timeout(Some(Duration::from_millis(1)))
            .unwrap();
        let recorded: Arc<Mutex<Vec<Vec<u8>>>> = Arc::default();
        let ended = Arc::new(AtomicBool::new(false));
        let (keep, end, out) = (recorded.clone(), ended.clone(), back.try_clone().unwrap());
        let thread = std::thread::spawn(move || {
            let (mut packet, mut dialler) = (vec![0; 65_536], None);
            while !end.load(Ordering::SeqCst) {
                if let Ok((len, from)) = front.recv_from(&mut packet) {
                    dialler = Some(from);
                    for _ in 0..2 {
                        out.send(&packet[..len]).unwrap();
                    }
                    keep.lock().push(packet[..len].to_vec());
                }
                while let (Ok(len), Some(dialler)) = (out.recv(&mut packet), dialler) {
                    front.send_to(&packet[..len], dialler).unwrap();
                }
            }
        });
        Self {
            front: Location::new(Kind::Quic, &at).unwrap(),
            recorded,
            back,
            ended,
            thread: Some(thread),
        }
    }

    /// Replays all datagrams, from the original and from another address.
    fn repeat(&self, behind: &str) {
        let elsewhere = UdpSocket::bind("127.0.0.1:0").unwrap();
        elsewhere.connect(behind).unwrap();
        for socket in [&self.back, &elsewhere] {
            for packet in self.recorded.lock().clone() {
                // A full socket drops it; further datagrams follow.
                let _ = socket.send(&packet);
            }
        }
    }
}

impl Drop for Repeater {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::SeqCst);
        self.thread.take().unwrap().join().unwrap();
    }
}

#[test]
fn replayed_quic_datagrams_deliver_nothing() {
    let (rover, crex) = securities();
    let to = over_quic(crex.clone());
    let behind = to.location().address().to_owned();
    let repeater = Repeater::before(&behind);
    let from = over_quic(rover.clone());
    let sends = |attempts: std::ops::RangeInclusive<u64>| {
        for attempt in attempts {
            from.send(attempt, &repeater.front, parcel(attempt, "secret"))
                .unwrap();
            assert_eq!(from.conclusion(attempt), accepted());
        }
    };
    sends(1..=LETTERS);
    // While the connection lives,
    repeater.repeat(&behind);
    sends(LETTERS + 1..=2 * LETTERS);
    assert_eq!(to.arrivals() as u64, 2 * LETTERS);
    assert_eq!(from.transport.counters().dialed, 1);
    // when it is over,
    fipa_transport::Transport::close(&from.transport);
    until_some("the connection is over", || {
        (to.transport.counters().connections == 0).then_some(())
    });
    repeater.repeat(&behind);
    // and to the same service with another incarnation.
    let next = over_quic(crex);
    repeater.repeat(next.location().address());
    // The replayed datagrams have been handled when a later honest letter arrives.
    let again = over_quic(rover);
    for (attempt, party) in [(1, &to), (2, &next)] {
        again
            .send(attempt, party.location(), parcel(attempt, "hello"))
            .unwrap();
        assert_eq!(again.conclusion(attempt), accepted());
    }
    assert_eq!(to.arrivals() as u64, 2 * LETTERS + 1);
    assert_eq!(next.arrivals(), 1);
}

#[test]
fn sessions_are_not_resumed() {
    let (rogue, crex) = (Host::new(ROGUE, &[]), Host::new(NAME, &[]));
    let security = crex.security(&[&rogue]);
    let (tcp, over_quic) = (tcp(security.clone()), over_quic(security));
    // The rogue tries to resume, and to send its letter as early data.
    let mut wish = client(Some(&rogue), ONLY_13);
    wish.enable_early_data = true;
    let tls = Arc::new(wish.clone());
    for _ in 0..2 {
        let name = ServerName::try_from("127.0.0.1").unwrap();
        let session = ClientConnection::new(tls.clone(), name).unwrap();
        let stream = TcpStream::connect(tcp.location().address()).unwrap();
        stream.set_read_timeout(Some(WATCHDOG)).unwrap();
        let mut stream = StreamOwned::new(session, stream);
        stream.write_all(&hello_and_letter()).unwrap();
        stream.read_exact(&mut [0; 24]).unwrap();
        assert_eq!(stream.conn.handshake_kind(), Some(HandshakeKind::Full));
        assert!(!stream.conn.is_early_data_accepted());
    }
    let config = quic(wish, PROTOCOL, 1);
    let runtime = common::runtime();
    runtime.block_on(async {
        let endpoint = quinn::Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
        for _ in 0..2 {
            let at = over_quic.location().address().parse().unwrap();
            let connecting = endpoint.connect_with(config.clone(), at, "x").unwrap();
            let Err(connecting) = connecting.into_0rtt() else {
                panic!("the server offered a session to resume");
            };
            let connection = connecting.await.unwrap();
            let (mut send, mut receive) = connection.open_bi().await.unwrap();
            send.write_all(&hello_and_letter()).await.unwrap();
            // A session ticket would arrive before this.
            receive.read_exact(&mut [0; 24]).await.unwrap();
        }
    });
}
