//! TLS with the key of the gateway.

use tokio::net::TcpStream;

/// The key of the gateway.
#[cfg(feature = "secure")]
#[derive(Debug, Clone)]
pub(crate) struct Encryption(pub(crate) fipa_transport_net::secure::Security);

/// Without the feature `secure`, there is none.
#[cfg(not(feature = "secure"))]
#[derive(Debug, Clone)]
pub(crate) enum Encryption {}

impl Encryption {
    /// Performs the handshake with a client.
    #[cfg(feature = "secure")]
    pub(super) async fn accept(
        self,
        stream: TcpStream,
    ) -> std::io::Result<impl tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin + Send + 'static>
    {
        self.0.accept_client(stream).await
    }

    /// There is no value to call it with.
    #[cfg(not(feature = "secure"))]
    pub(super) async fn accept(self, _: TcpStream) -> std::io::Result<TcpStream> {
        match self {}
    }
}
