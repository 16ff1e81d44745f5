//! The HTTP listener of the gateway: metrics for Prometheus, and checks of its health.
//!
//! | path | answer |
//! |---|---|
//! | `/metrics` | the counters of all processes of the domain on this host, in the text format of Prometheus |
//! | `/healthz` | `ok` as long as the gateway runs |
//! | `/readyz` | `ok` if letters can pass, otherwise the reason with status 503 |
//!
//! Each request needs the token (`token`): any user of the host can connect to a loopback address, and so can any web
//! page that a browser on the host shows. `Host` must be an address, `localhost` or a name of the configuration, so that
//! no page reaches the listener under a name of its own (DNS rebinding).
//!
//! The gateway has the values; this room knows only [`Source`].

mod prometheus;
mod requests;
mod token;

use std::future::Future;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use fipa_transport::log_limit;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

pub(crate) use self::prometheus::Families;
pub(crate) use self::token::Token;
pub use self::token::TokenError;

/// Maximum number of connections at the same time. Others wait.
const MAX_CONNECTIONS: usize = 32;

/// Time for a connection: one request and its answer.
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

/// The error if the listener cannot be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WebError {
    /// The address cannot be used.
    #[error("cannot listen at {address} (key http.listen)")]
    Listen {
        /// The address.
        address: String,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// The token cannot be used.
    #[error(transparent)]
    Token(#[from] TokenError),
}

/// A listener that does not answer yet.
#[derive(Debug)]
pub(crate) struct Listener {
    socket: TcpListener,
    address: SocketAddr,
    token: Token,
    names: Vec<String>,
}

impl Listener {
    /// Opens the listener. Must be called within a tokio runtime.
    pub(crate) fn open(address: &str, names: &[String], token: Token) -> Result<Self, WebError> {
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
        })
    }

    /// The address, with the port that the system has chosen if the configuration leaves it open.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers requests until it is aborted.
    pub(crate) async fn serve(self, source: Arc<dyn Source>) {
        let routes = requests::routes(source, self.token, self.names);
        let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        // Dropped with this future: the connections end with the gateway.
        let mut connections = JoinSet::new();
        loop {
            while connections.try_join_next().is_some() {}
            let Ok(place) = Arc::clone(&places).acquire_owned().await else {
                return;
            };
            let stream = match self.socket.accept().await {
                Ok((stream, _)) => stream,
                Err(error) => {
                    log_limit::warn!(%error, "cannot accept a connection at http.listen; retrying");
                    tokio::time::sleep(PAUSE).await;
                    continue;
                }
            };
            let routes = routes.clone();
            connections.spawn(async move {
                let answered = tokio::time::timeout(CONNECTION_TIMEOUT, answer(stream, routes));
                match answered.await {
                    Ok(Ok(())) => {}
                    Ok(Err(error)) => tracing::debug!(%error, "a connection at http.listen failed"),
                    Err(_) => tracing::debug!("a connection at http.listen took too long"),
                }
                drop(place);
            });
        }
    }
}

/// Answers one request.
async fn answer(stream: TcpStream, routes: axum::Router) -> Result<(), hyper::Error> {
    hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .max_buf_size(MAX_HEAD)
        .keep_alive(false)
        // A client may close its side after the request, as `nc -N` does.
        .half_close(true)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(routes))
        .await
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
        let listener = Listener::open("127.0.0.1:0", &[], Token::for_tests()).unwrap();
        let address = listener.address();
        let source = Arc::new(Stuck::default());
        let serving = tokio::spawn(listener.serve(Arc::clone(&source) as Arc<dyn Source>));
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
