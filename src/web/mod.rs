//! The HTTP listener of the gateway: metrics for Prometheus, checks of its health, and pages of the program.
//!
//! | path | answer |
//! |---|---|
//! | `/metrics` | the counters of all processes of the domain on this host, in the text format of Prometheus |
//! | `/healthz` | `ok` as long as the gateway runs |
//! | `/readyz` | `ok` if letters can pass, otherwise the reason with status 503 |
//! | `/api/session` | `POST` of the token begins the session of a browser, `DELETE` ends it |
//! | all others | the [`Pages`] of the program |
//!
//! Each request for values needs the token or a session: any user of the host can connect to a loopback address, and so
//! can any web page that a browser on the host shows. `Host` must be an address, `localhost` or a name of the
//! configuration, so that no page reaches the listener under a name of its own (DNS rebinding). Beyond loopback, the
//! listener encrypts with the key of the gateway.
//!
//! The gateway has the values; this room knows only `Source`.

mod encryption;
pub(crate) mod error;
mod pages;
mod prometheus;
mod requests;
mod sessions;
mod shares;
pub(crate) mod token;

use std::future::Future;
use std::net::SocketAddr;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use fipa_transport::log_limit;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use rustix::net::sockopt::{set_socket_send_buffer_size, set_tcp_user_timeout};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

pub(crate) use self::encryption::Encryption;
use self::error::WebError;
pub use self::pages::{KeepOpen, Pages};
pub(crate) use self::prometheus::Families;
use self::requests::Scheme;
use self::shares::Shares;
pub(crate) use self::token::Token;

/// Maximum number of connections at the same time. Others wait.
const MAX_CONNECTIONS: usize = 32;

/// Time after which a connection ends whose client takes nothing that it is sent.
const TAKE_TIMEOUT: Duration = Duration::from_secs(30);

/// Size of the buffer of the system for sent data of a connection, in bytes. The system uses up to twice as much. Without a
/// bound, each client that takes nothing costs 4 MB.
const SEND_BUFFER: usize = 128 << 10;

/// Time for a connection: one request and its answer, unless the answer has no end.
const CONNECTION_TIMEOUT: Duration = Duration::from_secs(10);

/// Time for the head of a request.
const HEAD_TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum size of the head of a request, in bytes. The library permits no less.
const MAX_HEAD: usize = 8192;

/// Pause after a connection could not be accepted, for example for lack of descriptors.
const PAUSE: Duration = Duration::from_millis(100);

/// The values that the listener shows.
pub(crate) trait Source: Send + Sync + 'static {
    /// Returns the metrics. May read files.
    ///
    /// # Errors
    /// The reason why they cannot be read.
    fn metrics(&self) -> Result<Families, String>;

    /// Whether letters can pass.
    ///
    /// # Errors
    /// The reason why they cannot.
    fn readiness(&self) -> Pin<Box<dyn Future<Output = Result<(), String>> + Send + '_>>;
}

/// A listener that does not answer yet.
#[derive(Debug)]
pub(crate) struct Listener {
    socket: TcpListener,
    address: SocketAddr,
    token: Token,
    names: Vec<String>,
    encryption: Option<Encryption>,
}

impl Listener {
    /// Opens the listener. Must be called within a tokio runtime.
    pub(crate) fn open(
        address: &str,
        names: &[String],
        token: Token,
        encryption: Option<Encryption>,
    ) -> Result<Self, WebError> {
        let failed = |source| WebError::Listen {
            address: address.to_owned(),
            source,
        };
        let socket = std::net::TcpListener::bind(address).map_err(failed)?;
        socket.set_nonblocking(true).map_err(failed)?;
        let socket = TcpListener::from_std(socket).map_err(failed)?;
        Ok(Self {
            address: socket.local_addr().map_err(failed)?,
            socket,
            token,
            names: names.to_vec(),
            encryption,
        })
    }

    /// The address, with the port that the system has chosen if the configuration leaves it open.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers requests until it is aborted.
    pub(crate) async fn serve(self, source: Arc<dyn Source>, pages: Pages) {
        let scheme = match self.encryption {
            Some(_) => Scheme::Https,
            None => Scheme::Http,
        };
        let routes = requests::routes(source, self.token, self.names, scheme, pages);
        let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        // Dropped with this future: the connections end with the gateway.
        let mut connections = JoinSet::new();
        let shares = Arc::new(Shares::default());
        loop {
            while connections.try_join_next().is_some() {}
            let Ok(place) = Arc::clone(&places).acquire_owned().await else {
                return;
            };
            let (stream, share) = match self.socket.accept().await {
                Ok((stream, client)) => match shares.take(client.ip()) {
                    Some(share) => (stream, share),
                    None => continue,
                },
                Err(error) => {
                    log_limit::warn!(%error, "cannot accept a connection at http.listen; retrying");
                    tokio::time::sleep(PAUSE).await;
                    continue;
                }
            };
            let (routes, encryption) = (routes.clone(), self.encryption.clone());
            connections.spawn(async move {
                match answer(stream, encryption, routes).await {
                    Ok(Some(())) => {}
                    Ok(None) => tracing::debug!("a connection at http.listen took too long"),
                    Err(error) => tracing::debug!(%error, "a connection at http.listen failed"),
                }
                drop((place, share));
            });
        }
    }
}

/// The error of a connection.
#[derive(Debug, thiserror::Error)]
enum ConnectionError {
    #[error("the handshake failed")]
    Handshake(#[source] std::io::Error),
    #[error(transparent)]
    Http(#[from] hyper::Error),
}

/// Answers one request. Returns `None` if its time is over.
async fn answer(
    stream: TcpStream,
    encryption: Option<Encryption>,
    routes: axum::Router,
) -> Result<Option<()>, ConnectionError> {
    let timeout = u32::try_from(TAKE_TIMEOUT.as_millis()).unwrap_or(u32::MAX);
    if let Err(error) = set_tcp_user_timeout(&stream, timeout) {
        tracing::debug!(%error, "a connection at http.listen has no timeout for sent data");
    }
    if let Err(error) = set_socket_send_buffer_size(&stream, SEND_BUFFER) {
        tracing::debug!(%error, "a connection at http.listen has a buffer of the system's size");
    }
    let Some(encryption) = encryption else {
        return converse(stream, routes).await;
    };
    match tokio::time::timeout(HEAD_TIMEOUT, encryption.accept(stream)).await {
        Ok(accepted) => converse(accepted.map_err(ConnectionError::Handshake)?, routes).await,
        Err(_) => Ok(None),
    }
}

async fn converse(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    routes: axum::Router,
) -> Result<Option<()>, ConnectionError> {
    let keep_open = KeepOpen::default();
    let routes = routes.layer(Extension(keep_open.clone()));
    let mut connection = pin!(
        hyper::server::conn::http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEAD_TIMEOUT)
            .max_buf_size(MAX_HEAD)
            .keep_alive(false)
            // A client may close its side after the request, as `nc -N` does.
            .half_close(true)
            .serve_connection(TokioIo::new(stream), TowerToHyperService::new(routes))
    );
    match tokio::time::timeout(CONNECTION_TIMEOUT, &mut connection).await {
        Ok(answered) => Ok(Some(answered?)),
        Err(_) if keep_open.is_kept() => Ok(Some(connection.await?)),
        Err(_) => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::io::AsyncWriteExt as _;

    use super::*;

    /// A source that is never ready, and counts the questions that wait.
    #[derive(Default)]
    struct Stuck(AtomicUsize);

    struct Waiting<'a>(&'a AtomicUsize);

    impl Drop for Waiting<'_> {
        fn drop(&mut self) {
            self.0.fetch_sub(1, Ordering::Relaxed);
        }
    }

    impl Source for Stuck {
        fn metrics(&self) -> Result<Families, String> {
            Ok(Families::default())
        }

        fn readiness(&self) -> Pin<Box<dyn Future<Output = Result<(), String>> + Send + '_>> {
            self.0.fetch_add(1, Ordering::Relaxed);
            let waiting = Waiting(&self.0);
            Box::pin(async move {
                let _waiting = waiting;
                std::future::pending().await
            })
        }
    }

    #[tokio::test]
    async fn connections_end_with_the_listener() {
        let listener = Listener::open("127.0.0.1:0", &[], Token::for_tests(), None).unwrap();
        let address = listener.address();
        let source = Arc::new(Stuck::default());
        let serving =
            tokio::spawn(listener.serve(Arc::clone(&source) as Arc<dyn Source>, Pages::default()));
        let mut client = TcpStream::connect(address).await.unwrap();
        let request = "GET /readyz HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer 0123456789abcdef\r\n\r\n";
        client.write_all(request.as_bytes()).await.unwrap();
        while source.0.load(Ordering::Relaxed) == 0 {
            tokio::task::yield_now().await;
        }
        serving.abort();
        assert!(serving.await.unwrap_err().is_cancelled());
        // The runtime has one thread, which drops the task of the connection as soon as this one yields.
        for _ in 0..10 {
            tokio::task::yield_now().await;
        }
        assert_eq!(source.0.load(Ordering::Relaxed), 0);
    }
}
