//! The line from a process to one watcher.
//!
//! Agents write their records here and never wait: what the socket does not take is kept, up to a
//! bound, and what does not find room there is lost and counted.

use std::collections::VecDeque;
use std::io::{self, ErrorKind};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, SystemTime};

use fipa_mts::watch::record::{self, Wish};
use parking_lot::Mutex;
use rustix::io::Errno;
use rustix::net::{SendFlags, send};
use tokio::io::Interest;
use tokio::net::UnixDatagram;
use tokio::sync::Notify;

/// Bytes of records that are kept for a watcher that is slow.
const KEPT: usize = 1 << 20;
/// What a kept record costs besides its bytes.
const OVERHEAD: usize = 64;
/// How long a watcher that took nothing more is left alone.
const PAUSE: Duration = Duration::from_millis(1);

/// One watcher, as the agents of this process see it.
pub(super) struct Line {
    socket: UnixDatagram,
    /// How much content it wishes to be told; none before it has said so.
    content: AtomicU32,
    outgoing: Mutex<Outgoing>,
    /// Something is kept, or the watcher has gone.
    wake: Notify,
}

#[derive(Default)]
struct Outgoing {
    kept: VecDeque<Vec<u8>>,
    bytes: usize,
    /// How many records were lost.
    lost: u64,
    /// How many the watcher knows of.
    told: u64,
    gone: bool,
}

impl Line {
    pub(super) fn new(socket: UnixDatagram) -> Self {
        Self {
            socket,
            content: AtomicU32::new(0),
            outgoing: Mutex::default(),
            wake: Notify::new(),
        }
    }

    pub(super) fn wish(&self) -> Wish {
        Wish {
            content: self.content.load(Ordering::Relaxed),
        }
    }

    /// Tells the watcher something, now or later or never; without waiting.
    pub(super) fn tell(&self, mut bytes: Vec<u8>) {
        let mut outgoing = self.outgoing.lock();
        if outgoing.gone {
            return;
        }
        record::set_lost(&mut bytes, outgoing.lost);
        if outgoing.kept.is_empty() && self.sent(&mut outgoing, &bytes) {
            outgoing.told = outgoing.lost;
            return;
        }
        let size = bytes.len() + OVERHEAD;
        if outgoing.bytes + size > KEPT {
            outgoing.lost += 1;
            return;
        }
        if outgoing.kept.is_empty() {
            self.wake.notify_one();
        }
        outgoing.bytes += size;
        outgoing.kept.push_back(bytes);
    }

    /// Whether nothing more is to be done about this record.
    fn sent(&self, outgoing: &mut Outgoing, bytes: &[u8]) -> bool {
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        let sent = || Ok(send(&self.socket, bytes, flags)?);
        match self.socket.try_io(Interest::WRITABLE, sent) {
            Ok(_) => true,
            Err(error) if later(&error) => false,
            Err(error) => {
                if !matches!(
                    error.kind(),
                    ErrorKind::BrokenPipe | ErrorKind::ConnectionReset
                ) {
                    tracing::warn!(%error, "a watcher cannot be told anything any more");
                }
                outgoing.gone = true;
                outgoing.kept.clear();
                self.wake.notify_one();
                true
            }
        }
    }

    /// Sends what was kept. Whether all of it has been sent.
    fn flush(&self) -> bool {
        let mut outgoing = self.outgoing.lock();
        while let Some(bytes) = outgoing.kept.pop_front() {
            if !self.sent(&mut outgoing, &bytes) {
                outgoing.kept.push_front(bytes);
                return false;
            }
            // Nothing is kept any more when the watcher has gone.
            outgoing.bytes = outgoing.bytes.saturating_sub(bytes.len() + OVERHEAD);
        }
        if outgoing.lost > outgoing.told {
            let mut bytes = record::lost(SystemTime::now());
            record::set_lost(&mut bytes, outgoing.lost);
            if !self.sent(&mut outgoing, &bytes) {
                return false;
            }
            outgoing.told = outgoing.lost;
        }
        true
    }

    fn has_something_to_tell(&self) -> bool {
        let outgoing = self.outgoing.lock();
        !outgoing.gone && (!outgoing.kept.is_empty() || outgoing.lost > outgoing.told)
    }

    fn is_gone(&self) -> bool {
        self.outgoing.lock().gone
    }

    /// Sends what was kept whenever there is room, until the watcher has gone.
    pub(super) async fn serve(&self) {
        while !self.is_gone() {
            let waiting = self.has_something_to_tell();
            tokio::select! {
                () = self.wake.notified() => {}
                () = self.heard() => return,
                ready = self.socket.writable(), if waiting => match ready {
                    Ok(()) if !self.flush() => tokio::time::sleep(PAUSE).await,
                    Ok(()) => {}
                    Err(_) => return,
                },
            }
        }
    }

    /// Hears what the watcher wishes, until it has gone or says what is not understood.
    async fn heard(&self) {
        let mut buffer = [0; Wish::LEN + 1];
        while let Ok(len) = self.socket.recv(&mut buffer).await {
            match buffer.get(..len).and_then(Wish::parse) {
                Some(wish) => self.content.store(wish.content, Ordering::Relaxed),
                None => return,
            }
        }
    }
}

/// Whether the system may take later what it did not take now.
fn later(error: &io::Error) -> bool {
    use ErrorKind::{Interrupted, WouldBlock};
    matches!(error.kind(), WouldBlock | Interrupted)
        || Errno::from_io_error(error) == Some(Errno::NOBUFS)
}
