//! The connection from a process to one watcher.
//!
//! Sending a record never waits. A record that the socket does not accept is queued, up to a limit of
//! bytes. A record beyond the limit is lost and counted.

use std::collections::VecDeque;
use std::io::{self, ErrorKind};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, SystemTime};

use fipa_mts::watch::record::{self, Wish};
use fipa_transport::log_limit;
use parking_lot::Mutex;
use rustix::io::Errno;
use rustix::net::{SendFlags, send};
use tokio::io::Interest;
use tokio::net::UnixDatagram;
use tokio::sync::Notify;

/// A request to read the configuration again. Answers begin with it.
pub(crate) const RELOAD: [u8; 5] = *b"fipr\x01";

/// Maximum number of bytes of queued records for one slow watcher: those of 10,000 letters a second with 1 KiB of content
/// in a tenth of a second, in which a busy system may not run it.
const MAX_QUEUED: usize = 4 << 20;
/// Bytes that a queued record counts in addition to its own.
const OVERHEAD: usize = 64;
/// Time between two attempts to send to a watcher whose socket is full.
const PAUSE: Duration = Duration::from_millis(1);

/// The connection to one watcher.
#[derive(Debug)]
pub(super) struct Connection {
    socket: UnixDatagram,
    /// Number of bytes of content per message that the watcher requests; 0 until its request arrives.
    content: AtomicU32,
    outgoing: Mutex<Outgoing>,
    /// Notified when a record is queued or the watcher has disconnected.
    wake: Notify,
}

#[derive(Debug, Default)]
struct Outgoing {
    queued: VecDeque<Vec<u8>>,
    bytes: usize,
    /// Number of lost records.
    lost: u64,
    /// Number of lost records that were reported to the watcher.
    reported: u64,
    disconnected: bool,
}

impl Connection {
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

    /// Sends a record, queues it, or counts it as lost. Never waits.
    pub(super) fn send(&self, mut bytes: Vec<u8>) {
        let mut outgoing = self.outgoing.lock();
        if outgoing.disconnected {
            return;
        }
        record::set_lost(&mut bytes, outgoing.lost);
        let lost = outgoing.lost;
        if self.send_or_queue(&mut outgoing, bytes) {
            outgoing.reported = lost;
        }
    }

    /// Sends or queues an answer to a request, which is no record.
    pub(super) fn send_answer(&self, bytes: Vec<u8>) {
        let mut outgoing = self.outgoing.lock();
        if !outgoing.disconnected {
            self.send_or_queue(&mut outgoing, bytes);
        }
    }

    /// Returns whether the bytes were sent at once.
    fn send_or_queue(&self, outgoing: &mut Outgoing, bytes: Vec<u8>) -> bool {
        if outgoing.queued.is_empty() && self.try_send(outgoing, &bytes) {
            return true;
        }
        let size = bytes.len() + OVERHEAD;
        if outgoing.bytes + size > MAX_QUEUED {
            outgoing.lost += 1;
            return false;
        }
        if outgoing.queued.is_empty() {
            self.wake.notify_one();
        }
        outgoing.bytes += size;
        outgoing.queued.push_back(bytes);
        false
    }

    /// Tries to send a record. Returns whether it is done: sent, or dropped because the watcher has
    /// disconnected.
    fn try_send(&self, outgoing: &mut Outgoing, bytes: &[u8]) -> bool {
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        let sent = || Ok(send(&self.socket, bytes, flags)?);
        match self.socket.try_io(Interest::WRITABLE, sent) {
            Ok(_) => true,
            Err(error) if is_temporary(&error) => false,
            Err(error) => {
                if !matches!(
                    error.kind(),
                    ErrorKind::BrokenPipe | ErrorKind::ConnectionReset
                ) {
                    log_limit::warn!(%error, "cannot send to a watcher; closing the connection");
                }
                outgoing.disconnected = true;
                outgoing.queued.clear();
                self.wake.notify_one();
                true
            }
        }
    }

    /// Sends the queued records. Returns whether the queue is empty.
    fn flush(&self) -> bool {
        let mut outgoing = self.outgoing.lock();
        while let Some(bytes) = outgoing.queued.pop_front() {
            if !self.try_send(&mut outgoing, &bytes) {
                outgoing.queued.push_front(bytes);
                return false;
            }
            // The queue was cleared if the watcher has disconnected.
            outgoing.bytes = outgoing.bytes.saturating_sub(bytes.len() + OVERHEAD);
        }
        if outgoing.lost > outgoing.reported {
            let mut bytes = record::lost(SystemTime::now());
            record::set_lost(&mut bytes, outgoing.lost);
            if !self.try_send(&mut outgoing, &bytes) {
                return false;
            }
            outgoing.reported = outgoing.lost;
        }
        true
    }

    fn has_records(&self) -> bool {
        let outgoing = self.outgoing.lock();
        !outgoing.disconnected && (!outgoing.queued.is_empty() || outgoing.lost > outgoing.reported)
    }

    fn is_disconnected(&self) -> bool {
        self.outgoing.lock().disconnected
    }

    /// Sends queued records whenever the socket accepts them, until the watcher disconnects. Calls `reload` when the
    /// watcher requests that the process read its configuration again.
    pub(super) async fn serve(&self, reload: impl Fn()) {
        while !self.is_disconnected() {
            let waiting = self.has_records();
            tokio::select! {
                () = self.wake.notified() => {}
                () = self.read_requests(&reload) => return,
                ready = self.socket.writable(), if waiting => match ready {
                    Ok(()) if !self.flush() => tokio::time::sleep(PAUSE).await,
                    Ok(()) => {}
                    Err(_) => return,
                },
            }
        }
    }

    /// Receives the requests of the watcher, until it disconnects or sends an invalid one.
    async fn read_requests(&self, reload: &impl Fn()) {
        let mut buffer = [0; Wish::LEN + 1];
        while let Ok(len) = self.socket.recv(&mut buffer).await {
            let request = buffer.get(..len).unwrap_or_default();
            match Wish::parse(request) {
                Some(wish) => self.content.store(wish.content, Ordering::Relaxed),
                None if request == RELOAD => reload(),
                None => return,
            }
        }
    }
}

/// Whether a later attempt to send can succeed.
fn is_temporary(error: &io::Error) -> bool {
    use ErrorKind::{Interrupted, WouldBlock};
    matches!(error.kind(), WouldBlock | Interrupted)
        || Errno::from_io_error(error) == Some(Errno::NOBUFS)
}
