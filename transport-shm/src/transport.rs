//! The endpoint as a [`Transport`].

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};

use arc_swap::ArcSwap;
use bytes::Bytes;
use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Kind, ListenError, LoanedContent, Location, Parcel, Sink,
    Ticket, Transport, WayError, WayFault,
};
use parking_lot::Mutex;
use tokio::io::unix::AsyncFd;
use tokio::runtime::Handle;
use tokio::task::AbortHandle;

use crate::domain::file_error;
use crate::endpoint::Endpoint;
use crate::inbox::location_of;
use crate::presence::{Bell, Watched};
use crate::{ShmConfig, ShmCounters, ShmError};

/// Letters through the shared memory of this host.
///
/// Works by itself, on tasks of the runtime it was given, which sleep until somebody rings. A
/// caller that wants to be faster calls [`Transport::drive`] in a loop: while it does, others need
/// not ring.
///
/// Content that arrives is read in place, in the sender's memory, and stays there until the last
/// `Bytes` of it is dropped. Only a bounded number of contents is held so; beyond it, and when it
/// is small, content is copied ([`ShmTransport::counters`]).
///
/// Content may be held for longer than the transport is open. The last traces of the process then
/// vanish when it is dropped.
pub struct ShmTransport {
    /// Another one after the domain was [joined again](Self::rejoin).
    endpoint: ArcSwap<Endpoint>,
    listening: Mutex<Listening>,
    closed: AtomicBool,
}

/// Is locked while endpoints change.
#[derive(Default)]
struct Listening {
    sink: Option<Arc<dyn Sink>>,
    task: Option<AbortHandle>,
}

impl ShmTransport {
    /// Opens the endpoint of this process: from now on others can find it.
    ///
    /// The runtime must have its I/O driver enabled.
    ///
    /// # Errors
    /// When the configuration makes no sense, the directory is not private, or shared memory
    /// cannot be had. Nothing is left open then.
    pub fn new(config: ShmConfig, runtime: Handle) -> Result<Self, ShmError> {
        Ok(Self {
            endpoint: ArcSwap::new(Endpoint::open(config, runtime)?),
            listening: Mutex::default(),
            closed: AtomicBool::new(false),
        })
    }

    /// Where this endpoint can be reached.
    #[must_use]
    pub fn location(&self) -> Location {
        location_of(self.endpoint.load().config().incarnation)
    }

    /// What happened so far, since the domain was last [joined again](Self::rejoin).
    #[must_use]
    pub fn counters(&self) -> ShmCounters {
        self.endpoint.load().tally().read()
    }

    /// Processes of this domain may have ended: removes what dead ones have left, if there is
    /// anything, in the background. Need not be called for processes that this one talks to,
    /// whose end the kernel tells.
    pub fn tidy(&self) {
        self.endpoint.load().clean_soon();
    }

    /// Whether other processes can find the mailbox. False when another program has removed the
    /// directory of the domain, or files in it or in `/dev/shm`.
    #[must_use]
    pub fn is_there(&self) -> bool {
        self.endpoint.load().is_there()
    }

    /// Joins the domain again if its files were removed, and says whether that was necessary.
    /// Letters under way are concluded as when the transport closes; content stays readable. Blocks
    /// for up to some seconds. Must not be called by the sink while it is told something.
    ///
    /// # Errors
    /// As [`new`](Self::new); nothing can be sent or received then, until it was tried again.
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
        // First, because both have files of the same names.
        before.close();
        before.remove_files();
        let endpoint = Endpoint::open(before.config().clone(), before.runtime().clone())?;
        if let Some(sink) = listening.sink.clone() {
            let begun = begin(&endpoint, sink);
            listening.task = Some(begun.map_err(|source| {
                endpoint.close();
                file_error("cannot listen in", &before.config().root, source)
            })?);
        }
        self.endpoint.store(endpoint);
        Ok(true)
    }

    /// While the domain is being joined again, an attempt fails as one that is worth repeating.
    fn joining(&self, error: WayError) -> WayError {
        match error.fault {
            WayFault::Closed if !self.closed.load(Ordering::SeqCst) => WayError::new(
                WayFault::Congested,
                "the domain is being joined again after its files were removed",
            ),
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
            // In a forked child: dropping it would remove what the parent uses.
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

    fn answers_at_once(&self) -> bool {
        true
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let mut listening = self.listening.lock();
        let endpoint = self.endpoint.load();
        if listening.sink.is_some() || endpoint.is_closed() {
            return Err(ListenError::OpenedBefore);
        }
        let begun = begin(&endpoint, Arc::clone(&sink));
        let task = begun.map_err(|source| ListenError::Bind {
            address: self.location().to_string(),
            source,
        })?;
        listening.task = Some(task);
        listening.sink = Some(sink);
        Ok(vec![self.location()])
    }

    fn dispatch(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError> {
        if let Body::Letter(letter) = &parcel.body {
            self.check_len(letter.len())?;
        }
        let posted = self.endpoint.load().post(attempt, to, &parcel);
        posted.map_err(|error| self.joining(error))
    }

    fn abandon(&self, attempt: AttemptId) -> Abandoned {
        self.endpoint.load().abandon(attempt)
    }

    fn answer(&self, _ticket: Ticket, _answer: Answer) {
        // Every arrival has been answered at once, so every ticket is unknown.
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
    ) -> Result<Option<Box<dyn LoanedContent>>, WayError> {
        self.check_len(len)?;
        let loan = self.endpoint.load().loan(to, head_room, len, tail_room);
        let loan = loan.map_err(|error| self.joining(error))?;
        Ok(Some(Box::new(loan)))
    }

    fn loan_for_many(&self, len: usize) -> Result<Option<Box<dyn LoanedContent>>, WayError> {
        self.check_len(len)?;
        let loan = self.endpoint.load().pool().loan(len)?;
        Ok(loan.map(|loan| Box::new(loan) as Box<dyn LoanedContent>))
    }

    fn copies_for_each(&self, content: &Bytes) -> bool {
        self.endpoint.load().pool().copies(content)
    }

    /// Must not be called by the sink while it is told something.
    fn close(&self) {
        self.closed.store(true, Ordering::SeqCst);
        let mut listening = self.listening.lock();
        if let Some(task) = listening.task.take() {
            task.abort();
        }
        // The sink may own what owns this.
        listening.sink = None;
        self.endpoint.load().close();
    }
}

impl ShmTransport {
    fn check_len(&self, len: usize) -> Result<(), WayError> {
        let most = self.max_letter();
        if len <= most {
            return Ok(());
        }
        Err(WayError::new(
            WayFault::TooLarge,
            format_args!("{len} bytes, and max_letter of transport.shm is {most}"),
        ))
    }
}

/// Tells the sink from now on.
fn begin(endpoint: &Arc<Endpoint>, sink: Arc<dyn Sink>) -> std::io::Result<AbortHandle> {
    let bell = {
        let _runtime = endpoint.runtime().enter();
        Watched::readable(endpoint.bell().clone())
    }?;
    endpoint.tell_to(sink);
    let task = answer_the_bell(bell, Arc::downgrade(endpoint));
    let task = endpoint.runtime().spawn(task).abort_handle();
    // What came before.
    endpoint.bell().ring();
    Ok(task)
}

/// Works whenever somebody rings. Ends with the transport.
async fn answer_the_bell(bell: AsyncFd<Watched<Bell>>, endpoint: Weak<Endpoint>) {
    while let Ok(mut ready) = bell.readable().await {
        // First silenced, then looked: who rings during the look is heard afterwards.
        if bell.get_ref().get().silence() {
            ready.clear_ready();
        }
        let Some(endpoint) = endpoint.upgrade() else {
            return;
        };
        endpoint.work_after_bell();
    }
}
