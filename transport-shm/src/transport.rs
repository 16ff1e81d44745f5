//! The [`Transport`] of this crate.

use std::fmt;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};

use arc_swap::ArcSwap;
use bytes::Bytes;
use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Kind, ListenError, LoanedContent, Location, Parcel, Sink,
    Ticket, Transport, TransportError, TransportErrorKind,
};
use parking_lot::Mutex;
use tokio::io::unix::AsyncFd;
use tokio::runtime::Handle;
use tokio::task::AbortHandle;

use crate::domain_files::file_error;
use crate::endpoint::Endpoint;
use crate::inbox::location_of;
use crate::presence::{Doorbell, SharedFd};
use crate::{ShmConfig, ShmCounters, ShmError};

/// Letters through the shared memory of this host.
///
/// Tasks on the given runtime receive letters; they sleep until a peer rings. A caller that needs
/// lower latency calls [`Transport::drive`] in a loop; peers do not ring meanwhile.
///
/// Content that arrives is read in place, in the sender's memory, and stays there until the last
/// `Bytes` of it is dropped. The number of contents held that way is bounded. Further content, and
/// short content, is copied ([`ShmTransport::counters`]).
///
/// Content may be held for longer than the transport is open. The last files of the process are
/// then removed when it is dropped.
pub struct ShmTransport {
    /// Replaced when the domain is [joined again](Self::rejoin).
    endpoint: ArcSwap<Endpoint>,
    listening: Mutex<Listening>,
    closed: AtomicBool,
}

/// The sink and its task. Locked while the endpoint is replaced.
#[derive(Default)]
struct Listening {
    sink: Option<Arc<dyn Sink>>,
    task: Option<AbortHandle>,
    /// Number of attempts to join the domain again.
    rejoins: u64,
}

impl ShmTransport {
    /// Opens the endpoint of this process. Other processes can then find it.
    ///
    /// The runtime must have its I/O driver enabled.
    ///
    /// # Errors
    /// Returns an error if the configuration is invalid, the directory is not private, or shared
    /// memory cannot be allocated. Nothing is left open then.
    pub fn new(config: ShmConfig, runtime: Handle) -> Result<Self, ShmError> {
        Ok(Self {
            endpoint: ArcSwap::new(Endpoint::open(config, 0, runtime)?),
            listening: Mutex::default(),
            closed: AtomicBool::new(false),
        })
    }

    /// Location of this endpoint's mailbox.
    #[must_use]
    pub fn location(&self) -> Location {
        location_of(self.endpoint.load().config().incarnation)
    }

    /// Counters since the endpoint was opened or last [joined again](Self::rejoin).
    #[must_use]
    pub fn counters(&self) -> ShmCounters {
        self.endpoint.load().tally().read()
    }

    /// Starts a cleanup in the background if the domain contains files of dead processes. Not
    /// needed for connected processes: the kernel notifies this process of their end.
    pub fn tidy(&self) {
        self.endpoint.load().start_cleanup();
    }

    /// Whether other processes can find the mailbox. False if another program has removed the
    /// directory of the domain, or files in it or in `/dev/shm`. True after the transport was closed,
    /// which removes these files.
    #[must_use]
    pub fn is_there(&self) -> bool {
        // The files are examined first, because closing sets the flag before it removes them.
        self.endpoint.load().is_there() || self.closed.load(Ordering::SeqCst)
    }

    /// The files by which other processes find the mailbox; see [`is_there`](Self::is_there).
    #[must_use]
    pub fn files(&self) -> Vec<PathBuf> {
        self.endpoint.load().files().to_vec()
    }

    /// Joins the domain again if its files were removed. Returns whether that was necessary.
    /// Letters under way are concluded as when the transport closes; content stays readable. Blocks
    /// for up to some seconds. The sink must not call this from one of its methods.
    ///
    /// # Errors
    /// Returns the errors of [`new`](Self::new). The transport then neither sends nor receives
    /// until a retry succeeds.
    pub fn rejoin(&self) -> Result<bool, ShmError> {
        let mut listening = self.listening.lock();
        let before = self.endpoint.load_full();
        let is_joined = !before.is_closed() && before.is_there();
        if is_joined || self.closed.load(Ordering::SeqCst) || !before.owner().is_this() {
            return Ok(false);
        }
        if let Some(task) = listening.task.take() {
            task.abort();
        }
        // Closed first, because both endpoints use the same names for all files but those of the
        // mailbox.
        before.close();
        listening.rejoins += 1;
        let endpoint = Endpoint::open(
            before.config().clone(),
            listening.rejoins,
            before.runtime().clone(),
        )?;
        if let Some(sink) = listening.sink.clone() {
            let started = start_listening(&endpoint, sink);
            listening.task = Some(started.map_err(|source| {
                endpoint.close();
                file_error("cannot listen in", &before.config().root, source)
            })?);
        }
        self.endpoint.store(endpoint);
        Ok(true)
    }

    /// Replaces the error of a closed endpoint by a retriable one while the domain is joined again.
    fn retriable_while_rejoining(&self, error: TransportError) -> TransportError {
        match error.fault {
            TransportErrorKind::Closed if !self.closed.load(Ordering::SeqCst) => {
                TransportError::new(
                    TransportErrorKind::Congested,
                    "joining the domain again after its files were removed",
                )
            }
            _ => error,
        }
    }
}

impl fmt::Debug for ShmTransport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ShmTransport")
            .field("location", &self.location())
            .finish_non_exhaustive()
    }
}

impl Drop for ShmTransport {
    fn drop(&mut self) {
        let endpoint = self.endpoint.load_full();
        if !endpoint.owner().is_this() {
            // In a forked child, a drop would remove files that the parent uses.
            std::mem::forget(endpoint);
            return;
        }
        self.close();
    }
}

impl Transport for ShmTransport {
    fn kind(&self) -> Kind {
        Kind::Shm
    }

    fn max_letter(&self) -> usize {
        self.endpoint.load().config().max_letter
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let mut listening = self.listening.lock();
        let endpoint = self.endpoint.load();
        if listening.sink.is_some() || endpoint.is_closed() {
            return Err(ListenError::OpenedBefore);
        }
        let started = start_listening(&endpoint, Arc::clone(&sink));
        let task = started.map_err(|source| ListenError::Bind {
            address: self.location().to_string(),
            source,
        })?;
        listening.task = Some(task);
        listening.sink = Some(sink);
        Ok(vec![self.location()])
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        if let Body::Letter(letter) = &parcel.body {
            self.check_len(letter.len())?;
        }
        let posted = self.endpoint.load().post(attempt, to, parcel);
        posted.map_err(|error| self.retriable_while_rejoining(error))
    }

    fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        self.endpoint.load().abandon(attempt, to.incarnation())
    }

    fn answer(&self, ticket: Ticket, answer: Answer) {
        self.endpoint.load().answer(ticket, &answer);
    }

    fn drive(&self) -> bool {
        self.endpoint.load().drive()
    }

    fn loan(
        &self,
        to: &Location,
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Result<Option<Box<dyn LoanedContent>>, TransportError> {
        self.check_len(len)?;
        let loan = self.endpoint.load().loan(to, head_room, len, tail_room);
        let loan = loan.map_err(|error| self.retriable_while_rejoining(error))?;
        Ok(Some(Box::new(loan)))
    }

    fn loan_for_many(&self, len: usize) -> Result<Option<Box<dyn LoanedContent>>, TransportError> {
        self.check_len(len)?;
        let loan = self.endpoint.load().pool().loan(len)?;
        Ok(loan.map(|loan| Box::new(loan) as Box<dyn LoanedContent>))
    }

    fn copies_for_each(&self, content: &Bytes) -> bool {
        self.endpoint.load().pool().copies(content)
    }

    /// Closes the transport. The sink must not call this from one of its methods.
    fn close(&self) {
        self.closed.store(true, Ordering::SeqCst);
        let mut listening = self.listening.lock();
        if let Some(task) = listening.task.take() {
            task.abort();
        }
        // The sink may own the value that owns this transport.
        listening.sink = None;
        self.endpoint.load().close();
    }
}

impl ShmTransport {
    fn check_len(&self, len: usize) -> Result<(), TransportError> {
        let most = self.max_letter();
        if len <= most {
            return Ok(());
        }
        Err(TransportError::new(
            TransportErrorKind::TooLarge,
            format_args!("the letter has {len} bytes, and transport.shm.max_letter is {most}"),
        ))
    }
}

/// Sets the sink and starts the task that receives.
fn start_listening(endpoint: &Arc<Endpoint>, sink: Arc<dyn Sink>) -> std::io::Result<AbortHandle> {
    let doorbell = {
        let _runtime = endpoint.runtime().enter();
        SharedFd::readable(endpoint.doorbell().clone())
    }?;
    endpoint.set_sink(sink);
    let task = serve_doorbell(doorbell, Arc::downgrade(endpoint));
    let task = endpoint.runtime().spawn(task).abort_handle();
    // Letters may have arrived already.
    endpoint.doorbell().ring();
    Ok(task)
}

/// Works after each ring. Ends with the transport.
async fn serve_doorbell(doorbell: AsyncFd<SharedFd<Doorbell>>, endpoint: Weak<Endpoint>) {
    while let Ok(mut ready) = doorbell.readable().await {
        // Cleared before the work: a ring during the work wakes the task again.
        if doorbell.get_ref().get().clear() {
            ready.clear_ready();
        }
        let Some(endpoint) = endpoint.upgrade() else {
            return;
        };
        endpoint.work_after_wakeup();
    }
}
