//! Letters to legacy peers over TCP: one connection per letter, closed after it, without an answer.
//!
//! The end of the stream ends a letter. This side cannot know whether the peer accepted it, but a
//! peer that closes the connection without an error has read it to its end.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use fipa_transport::{Conclusion, Location, Signature, TransportError, TransportErrorKind};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time;

use super::endpoint::TcpEndpoint;
use crate::legacy::dialect::{ReplyAddress, translate};
use crate::legacy::queues::{LegacyDelivery, LegacySender, Progress};
use crate::sockets::{self, prepare};
use crate::stream::counters::count;
use crate::stream::dialing::{Unreachable, first};

/// Time that a peer has to close the connection after its letter, before the next letter is sent.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(50);

/// Sends letters to one location.
pub(super) struct TcpSender {
    pub(super) endpoint: Arc<TcpEndpoint>,
    pub(super) to: Location,
}

impl LegacySender for TcpSender {
    async fn deliver(&mut self, delivery: &LegacyDelivery, progress: &Progress<'_>) -> Conclusion {
        let sent = self.send(delivery, progress).await;
        sent.unwrap_or_else(|conclusion| conclusion)
    }

    async fn idle(&mut self) {}
}

impl TcpSender {
    async fn send(
        &self,
        delivery: &LegacyDelivery,
        progress: &Progress<'_>,
    ) -> Result<Conclusion, Conclusion> {
        let (endpoint, to) = (&self.endpoint, &self.to);
        let sink = endpoint.stream.sink();
        let has = |name: &str| sink.as_ref().is_some_and(|sink| sink.is_here(name));
        let in_dialect = |url: Option<&str>| {
            let reply_address = url.map(|url| ReplyAddress { url, has: &has });
            translate(&delivery.letter, &delivery.receiver, to, reply_address)
                .map_err(|error| Conclusion::NotSent(TransportError::new(error.fault(), error)))
        };
        // Translated before a connection is opened: a connection without a letter leaks a
        // descriptor in fipa_services.
        let mut letter = in_dialect(None)?;
        let addresses = vec![to.address().to_owned()];
        let opened = first(endpoint, "tcp", addresses, sockets::connect).await;
        let (mut stream, peer) = opened.map_err(|Unreachable { what, .. }| {
            count(&endpoint.tally().dial_failures);
            let detail = format!("{}: {what}", to.address());
            Conclusion::NotSent(TransportError::new(TransportErrorKind::Unreachable, detail))
        })?;
        endpoint
            .config
            .check_legacy_peer(peer)
            .map_err(Conclusion::NotSent)?;
        if to.signature() == Signature::JadeProxy
            && let Some(local) = stream.local_addr().ok()
            && let Some(url) = listening_at(&endpoint.listening(), local)
        {
            letter = in_dialect(Some(&url))?;
        }
        let broken = |error| TransportError::new(TransportErrorKind::Broken, error);
        prepare(&stream, endpoint.limits()).map_err(|error| Conclusion::NotSent(broken(error)))?;
        progress.begin()?;
        for piece in letter {
            let timeout = endpoint.limits().stall_timeout;
            let written = progress.write(&mut stream, piece, timeout).await;
            written.map_err(|error| progress.broken(error))?;
        }
        let finished = finish(&mut stream).await;
        finished.map_err(|error| Conclusion::Unconfirmed(broken(error)))?;
        count(&endpoint.tally().unframed_out);
        Ok(Conclusion::Handed)
    }
}

/// Ends the letter, and waits a moment for the peer to close the connection.
async fn finish(stream: &mut TcpStream) -> std::io::Result<()> {
    stream.shutdown().await?;
    let mut ignored = [0; 256];
    let hangup = async {
        while stream.read(&mut ignored).await? > 0 {}
        Ok(())
    };
    time::timeout(CLOSE_TIMEOUT, hangup).await.unwrap_or(Ok(()))
}

/// Returns the listening address with the IP address `local` as a URL, if the endpoint listens
/// there.
fn listening_at(listening: &[String], local: SocketAddr) -> Option<String> {
    sockets::listening_at(listening, local).map(|address| format!("tcp://{address}"))
}
