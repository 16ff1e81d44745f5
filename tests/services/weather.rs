//! Links between services that can be cut: relays on loopback that stop passing on what is said.

use std::net::SocketAddr;

use fipa::Kind;
use fipa_transport::Location;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// What becomes of what is said over a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sky {
    /// It is passed on.
    Clear,
    /// It is kept, or lost, and nobody is told.
    Silent,
    /// What the side that dialled says is passed on, and the answers are kept or lost.
    Unanswered,
    /// Connections break, and there are no new ones.
    Broken,
}

/// A link to a location, which it takes the place of.
pub(crate) struct Link {
    pub(crate) location: Location,
    sky: watch::Sender<Sky>,
    task: JoinHandle<()>,
}

impl Link {
    pub(crate) async fn before(behind: &Location) -> Self {
        let to: SocketAddr = behind.address().parse().unwrap();
        let (sky, seen) = watch::channel(Sky::Clear);
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
            sky,
            task,
        }
    }

    pub(crate) fn turn(&self, sky: Sky) {
        self.sky.send_replace(sky);
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn connections(listener: TcpListener, to: SocketAddr, sky: watch::Receiver<Sky>) {
    while let Ok((dialler, _)) = listener.accept().await {
        if *sky.borrow() == Sky::Broken {
            continue;
        }
        let mut seen = sky.clone();
        tokio::spawn(async move {
            let Ok(other) = TcpStream::connect(to).await else {
                return;
            };
            let (there, back) = (dialler.into_split(), other.into_split());
            tokio::select! {
                () = pass(there.0, back.1, seen.clone(), &[Sky::Clear, Sky::Unanswered]) => {}
                () = pass(back.0, there.1, seen.clone(), &[Sky::Clear]) => {}
                // An error means that the test is over.
                _ = seen.wait_for(|sky| *sky == Sky::Broken) => {}
            }
        });
    }
}

async fn pass(
    mut from: tokio::net::tcp::OwnedReadHalf,
    mut to: tokio::net::tcp::OwnedWriteHalf,
    mut sky: watch::Receiver<Sky>,
    under: &[Sky],
) {
    let mut bytes = vec![0; 65_536];
    while let Ok(len @ 1..) = from.read(&mut bytes).await {
        if sky.wait_for(|sky| under.contains(sky)).await.is_err() {
            return;
        }
        let Some(read) = bytes.get(..len) else { return };
        if to.write_all(read).await.is_err() {
            return;
        }
    }
}

async fn datagrams(front: UdpSocket, to: SocketAddr, sky: watch::Receiver<Sky>) {
    let back = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    back.connect(to).await.unwrap();
    let (mut there, mut here) = (vec![0; 65_536], vec![0; 65_536]);
    let mut dialler = None;
    loop {
        tokio::select! {
            read = front.recv_from(&mut there) => {
                let Ok((len, from)) = read else { continue };
                dialler = Some(from);
                if [Sky::Clear, Sky::Unanswered].contains(&*sky.borrow()) {
                    // What a socket does not take is lost, as on any network.
                    let _ = back.send(&there[..len]).await;
                }
            }
            read = back.recv(&mut here) => {
                // Nobody is there any more, perhaps.
                let Ok(len) = read else { continue };
                if let (Some(dialler), Sky::Clear) = (dialler, *sky.borrow()) {
                    let _ = front.try_send_to(&here[..len], dialler);
                }
            }
        }
    }
}
