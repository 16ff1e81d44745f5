//! Connections over TCP, without and with TLS.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::sleep;
use tokio_rustls::TlsConnector;

use super::{Ending, Script};

/// Runs the script without TLS. Returns the number of bytes written.
pub(crate) async fn plain(to: SocketAddr, script: Script) -> u64 {
    match TcpStream::connect(to).await {
        Ok(stream) => perform(stream, script).await,
        Err(_) => 0,
    }
}

/// Runs the script over TLS as a trusted peer. Returns the number of bytes written, or `None` if
/// the connection or the TLS handshake failed.
pub(crate) async fn secured(
    to: SocketAddr,
    config: Arc<rustls::ClientConfig>,
    script: Script,
) -> Option<u64> {
    let stream = TcpStream::connect(to).await.ok()?;
    let connector = TlsConnector::from(config);
    let stream = connector.connect(ServerName::from(to.ip()), stream).await;
    Some(perform(stream.ok()?, script).await)
}

/// Returns the first bytes of a TLS client with this configuration.
pub(crate) fn client_hello(config: &Arc<rustls::ClientConfig>) -> Vec<u8> {
    let name = ServerName::try_from("127.0.0.1").unwrap();
    let mut client = rustls::ClientConnection::new(config.clone(), name).unwrap();
    let mut hello = Vec::new();
    client.write_tls(&mut hello).unwrap();
    hello
}

/// Runs the script. Returns the number of bytes written.
async fn perform(stream: impl AsyncRead + AsyncWrite + Unpin, script: Script) -> u64 {
    let (mut read, mut write) = tokio::io::split(stream);
    let mut written = 0;
    for (piece, pause) in script.pieces {
        // The gateway may close the connection or stop reading.
        match tokio::time::timeout(Duration::from_secs(1), write.write_all(&piece)).await {
            Ok(Ok(())) => written += piece.len() as u64,
            _ => return written,
        }
        if !pause.is_zero() {
            sleep(pause).await;
        }
    }
    // The gateway may have closed the connection, which is allowed.
    let _ = write.flush().await;
    match script.ending {
        Ending::Drop => {}
        Ending::Deaf => sleep(script.timeout).await,
        Ending::Finish | Ending::Linger => {
            if script.ending == Ending::Finish {
                let _ = write.shutdown().await;
            }
            let mut sink = [0; 4096];
            let reading = async { while matches!(read.read(&mut sink).await, Ok(1..)) {} };
            let _ = tokio::time::timeout(script.timeout, reading).await;
        }
    }
    written
}
