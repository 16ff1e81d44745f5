//! The handshake of the dialing side: hello, cookie, hello with the cookie.
//!
//! A hello is sent to all addresses of the peer, one after the other and without waiting for the
//! first to fail (RFC 8305). The first address that answers is used. The protocol writes the hello
//! ([`Greeting`]) and reads its answer.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use fipa_transport::{TransportError, TransportErrorKind};

use super::Path;
use crate::end::ConnectionEnd;

/// Delay between the hellos to two addresses (RFC 8305 section 5).
const STAGGER: Duration = Duration::from_millis(250);

/// First and longest pause before a hello is repeated.
const TIMEOUT: (Duration, Duration) = (Duration::from_millis(100), Duration::from_millis(500));

/// The hello of a protocol.
pub(crate) trait Greeting {
    /// The cookie of the protocol.
    type Cookie: Copy + PartialEq;

    /// Writes the hello to the peer at an address, with the last cookie from there.
    fn datagram(&self, to: SocketAddr, cookie: Option<Self::Cookie>) -> Vec<u8>;
}

#[derive(Debug)]
pub(crate) struct Dialing<G: Greeting> {
    greeting: G,
    deadline: Instant,
    candidates: Vec<Candidate<G::Cookie>>,
}

#[derive(Debug)]
struct Candidate<C> {
    path: Path,
    cookie: Option<C>,
    /// Time of the next hello; `None` when this path has failed.
    next: Option<Instant>,
    tries: u32,
    /// Time of the first hello with this cookie.
    greeted: Option<Instant>,
}

impl<G: Greeting> Dialing<G> {
    pub(crate) fn new(greeting: G, deadline: Instant) -> Self {
        Self {
            greeting,
            deadline,
            candidates: Vec::new(),
        }
    }

    /// Sets the paths to the peer.
    pub(crate) fn begin(&mut self, paths: impl IntoIterator<Item = Path>, now: Instant) {
        self.candidates = paths
            .into_iter()
            .zip(0_u32..)
            .map(|(path, number)| Candidate {
                path,
                cookie: None,
                next: Some(now + STAGGER * number),
                tries: 0,
                greeted: None,
            })
            .collect();
    }

    pub(crate) fn uses(&self, path: Path) -> bool {
        self.candidates.iter().any(|c| is_same(c.path, path))
    }

    pub(crate) fn handle_cookie(&mut self, path: Path, cookie: G::Cookie, now: Instant) {
        if let Some(candidate) = self.candidate(path)
            && candidate.cookie != Some(cookie)
        {
            candidate.cookie = Some(cookie);
            candidate.tries = 0;
            candidate.greeted = None;
            candidate.next = Some(now);
        }
    }

    /// Handles an error of the operating system on a path.
    ///
    /// # Errors
    /// When no other path is left.
    pub(crate) fn failed(
        &mut self,
        path: Path,
        what: &str,
        now: Instant,
    ) -> Result<(), ConnectionEnd> {
        if let Some(candidate) = self.candidate(path) {
            candidate.next = None;
        }
        let mut pending = self.candidates.iter_mut().filter_map(|c| c.next.as_mut());
        match pending.next() {
            // The next path need not wait any longer.
            Some(next) => *next = now.min(*next),
            None => {
                let detail = format!("{}: {what}", path.remote);
                let error = TransportError::new(TransportErrorKind::Unreachable, detail);
                return Err(ConnectionEnd::NotOpened(error));
            }
        }
        Ok(())
    }

    pub(crate) fn due(&self) -> Instant {
        let hello = self.candidates.iter().filter_map(|c| c.next).min();
        hello.map_or(self.deadline, |hello| hello.min(self.deadline))
    }

    pub(crate) fn handle_timeout(
        &mut self,
        now: Instant,
        timeout: Duration,
    ) -> Result<(), ConnectionEnd> {
        if now < self.deadline {
            return Ok(());
        }
        let detail = format!("no answer within {timeout:?} (connect_timeout)");
        Err(ConnectionEnd::NotOpened(TransportError::new(
            TransportErrorKind::Unreachable,
            detail,
        )))
    }

    pub(crate) fn poll_transmit(&mut self, now: Instant) -> Option<(Path, Vec<u8>)> {
        let candidate = self
            .candidates
            .iter_mut()
            .find(|c| c.next.is_some_and(|next| next <= now))?;
        let wait = TIMEOUT.0.saturating_mul(1 << candidate.tries.min(8));
        candidate.next = Some(now + wait.min(TIMEOUT.1));
        candidate.tries += 1;
        // A round trip is only measured when a single hello was sent, because an answer does not
        // name its hello.
        candidate.greeted = (candidate.tries == 1).then_some(now);
        let datagram = self
            .greeting
            .datagram(candidate.path.remote, candidate.cookie);
        Some((candidate.path, datagram))
    }

    pub(crate) fn round_trip(&self, path: Path, now: Instant) -> Option<Duration> {
        let candidate = self.candidates.iter().find(|c| is_same(c.path, path))?;
        Some(now.saturating_duration_since(candidate.greeted?))
    }

    fn candidate(&mut self, path: Path) -> Option<&mut Candidate<G::Cookie>> {
        self.candidates.iter_mut().find(|c| is_same(c.path, path))
    }
}

/// The local address is unknown before the first answer, so it is not compared.
fn is_same(one: Path, other: Path) -> bool {
    one.socket == other.socket && one.remote == other.remote
}
