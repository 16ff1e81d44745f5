//! The link between the hosts: a relay of TCP connections that can delay, thin and hold the bytes.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

/// Length of a read, in bytes.
const CHUNK: usize = 16 << 10;
/// Number of chunks under way in one direction.
const UNDER_WAY: usize = 256;

/// The properties of a link.
#[derive(Debug, Clone, Copy, Default)]
#[expect(clippy::exhaustive_structs, reason = "the launcher writes each field")]
pub struct Link {
    /// The delay in one direction.
    pub delay: Duration,
    /// The rate in one direction, in bytes per second. `None` is no limit.
    pub rate: Option<f64>,
}

/// A running relay.
#[derive(Debug)]
pub(crate) struct Relay {
    /// The address at which it listens.
    pub(crate) address: SocketAddr,
    passes: watch::Sender<bool>,
}

impl Relay {
    /// Starts a relay to this address.
    pub(crate) async fn start(to: SocketAddr, link: Link) -> std::io::Result<Self> {
        // Another address of this machine than that of the gateway behind it, which announces its own port: at this
        // address, no gateway listens there.
        let listener = TcpListener::bind((Ipv4Addr::new(127, 0, 0, 2), 0)).await?;
        let address = listener.local_addr()?;
        let (passes, seen) = watch::channel(true);
        tokio::spawn(async move {
            while let Ok((from, _)) = listener.accept().await {
                let seen = seen.clone();
                tokio::spawn(async move {
                    let Ok(to) = TcpStream::connect(to).await else {
                        return;
                    };
                    let ((from_in, from_out), (to_in, to_out)) =
                        (from.into_split(), to.into_split());
                    tokio::join!(
                        forward(from_in, to_out, link, seen.clone()),
                        forward(to_in, from_out, link, seen)
                    );
                });
            }
        });
        Ok(Self { address, passes })
    }

    /// Lets the link pass nothing, or everything again. The connections stay open.
    pub(crate) fn pass(&self, passes: bool) {
        self.passes.send_replace(passes);
    }
}

/// Forwards one direction of a connection.
async fn forward(
    mut from: OwnedReadHalf,
    to: OwnedWriteHalf,
    link: Link,
    passes: watch::Receiver<bool>,
) {
    let (chunks, received) = mpsc::channel(UNDER_WAY);
    let writing = tokio::spawn(write(to, link, received, passes));
    let mut chunk = vec![0; CHUNK];
    while let Ok(len @ 1..) = from.read(&mut chunk).await {
        let arrived = chunk.get(..len).unwrap_or_default().to_vec();
        if chunks
            .send((Instant::now() + link.delay, arrived))
            .await
            .is_err()
        {
            break;
        }
    }
    drop(chunks);
    let _ = writing.await;
}

async fn write(
    mut to: OwnedWriteHalf,
    link: Link,
    mut chunks: mpsc::Receiver<(Instant, Vec<u8>)>,
    mut passes: watch::Receiver<bool>,
) {
    let mut free = Instant::now();
    while let Some((due, chunk)) = chunks.recv().await {
        tokio::time::sleep_until(due.max(free)).await;
        if let Some(rate) = link.rate {
            free = Instant::now() + Duration::from_secs_f64(chunk.len() as f64 / rate);
        }
        if passes.wait_for(|passes| *passes).await.is_err() || to.write_all(&chunk).await.is_err() {
            return;
        }
    }
}
