//! Links between services that can be cut: relays on loopback that stop forwarding.

use std::net::SocketAddr;

use fipa::Kind;
use fipa_transport::Location;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// The state of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LinkState {
    /// The link forwards all data.
    Up,
    /// The link silently delays or loses all data.
    Stalled,
    /// The link forwards the data of the connecting side, and delays or loses the answers.
    OneWay,
    /// Connections are closed, and new ones are refused.
    Closed,
}

/// A relay in front of a location.
pub(crate) struct Link {
    pub(crate) location: Location,
    state: watch::Sender<LinkState>,
    task: JoinHandle<()>,
}

impl Link {
    pub(crate) async fn before(behind: &Location) -> Self {
        let to: SocketAddr = behind.address().parse().unwrap();
        let (state, seen) = watch::channel(LinkState::Up);
        let (at, task) = match behind.kind() {
            Kind::Tcp => {
                let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
                let at = listener.local_addr().unwrap();
                (at, tokio::spawn(connections(listener, to, seen)))
            }
            _ => {
                let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
                let at = socket.local_addr().unwrap();
                (at, tokio::spawn(datagrams(socket, to, seen)))
            }
        };
        let location = Location::new(behind.kind(), &at.to_string()).unwrap();
        Self {
            location: location.with_incarnation(behind.incarnation()),
            state,
            task,
        }
    }

    pub(crate) fn set(&self, state: LinkState) {
        self.state.send_replace(state);
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn connections(listener: TcpListener, to: SocketAddr, state: watch::Receiver<LinkState>) {
    while let Ok((caller, _)) = listener.accept().await {
        if *state.borrow() == LinkState::Closed {
            continue;
        }
        let mut seen = state.clone();
        tokio::spawn(async move {
            let Ok(other) = TcpStream::connect(to).await else {
                return;
            };
            let (there, back) = (caller.into_split(), other.into_split());
            tokio::select! {
                () = pass(there.0, back.1, seen.clone(), &[LinkState::Up, LinkState::OneWay]) => {}
                () = pass(back.0, there.1, seen.clone(), &[LinkState::Up]) => {}
                // An error means that the test has ended.
                _ = seen.wait_for(|state| *state == LinkState::Closed) => {}
            }
        });
    }
}

async fn pass(
    mut from: tokio::net::tcp::OwnedReadHalf,
    mut to: tokio::net::tcp::OwnedWriteHalf,
    mut state: watch::Receiver<LinkState>,
    under: &[LinkState],
) {
    let mut bytes = vec![0; 65_536];
    while let Ok(len @ 1..) = from.read(&mut bytes).await {
        if state.wait_for(|state| under.contains(state)).await.is_err() {
            return;
        }
        let Some(read) = bytes.get(..len) else { return };
        if to.write_all(read).await.is_err() {
            return;
        }
    }
}

async fn datagrams(front: UdpSocket, to: SocketAddr, state: watch::Receiver<LinkState>) {
    let back = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    back.connect(to).await.unwrap();
    let (mut there, mut here) = (vec![0; 65_536], vec![0; 65_536]);
    let mut caller = None;
    loop {
        tokio::select! {
            read = front.recv_from(&mut there) => {
                let Ok((len, from)) = read else { continue };
                caller = Some(from);
                if [LinkState::Up, LinkState::OneWay].contains(&*state.borrow()) {
                    // A datagram that the socket does not accept is lost, as on any network.
                    let _ = back.send(&there[..len]).await;
                }
            }
            read = back.recv(&mut here) => {
                // The other side may have ended.
                let Ok(len) = read else { continue };
                if let (Some(caller), LinkState::Up) = (caller, *state.borrow()) {
                    let _ = front.try_send_to(&here[..len], caller);
                }
            }
        }
    }
}
