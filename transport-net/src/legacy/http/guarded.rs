//! A byte stream that ends with the trust in its peer.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use crate::end::ConnectionEnd;
use crate::stream::proof::Proof;

/// A byte stream with a peer that has proved its identity. Each read and each write asks whether the
/// proof still counts. Once it does not, both fail, and a pending one is woken to fail.
pub(crate) struct Guarded<S> {
    stream: S,
    proof: Proof,
    withdrawn: Pin<Box<dyn Future<Output = ConnectionEnd> + Send + Sync>>,
}

impl<S> Guarded<S> {
    pub(crate) fn new(stream: S, proof: Proof) -> Self {
        let watched = proof.clone();
        Self {
            stream,
            proof,
            withdrawn: Box::pin(async move { watched.withdrawn().await }),
        }
    }

    /// Returns what the peer has proved.
    pub(crate) fn proof(&self) -> &Proof {
        &self.proof
    }

    /// Returns the stream below.
    pub(crate) fn get_ref(&self) -> &S {
        &self.stream
    }

    /// Stops asking, for the answer that tells the peer of the end.
    pub(crate) fn release(&mut self) {
        self.proof = Proof::default();
        self.withdrawn = Box::pin(std::future::pending());
    }

    fn check(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        let check = self.proof.check().and_then(|()| {
            // Registers the waker. Every check fails after the end, so it is not polled again.
            match self.withdrawn.as_mut().poll(cx) {
                Poll::Ready(end) => Err(end),
                Poll::Pending => Ok(()),
            }
        });
        check.map_err(|end| io::Error::new(io::ErrorKind::PermissionDenied, end.after()))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Guarded<S> {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        this.check(cx)?;
        Pin::new(&mut this.stream).poll_read(cx, buffer)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Guarded<S> {
    fn poll_write(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        this.check(cx)?;
        Pin::new(&mut this.stream).poll_write(cx, bytes)
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(cx)
    }
}
