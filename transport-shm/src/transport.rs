//! The endpoint as a [`Transport`].

use std::fmt;
use std::sync::{Arc, Weak};

use bytes::Bytes;
use fipa_transport::{
    Answer, AttemptId, Body, Kind, ListenError, LoanedContent, Location, Parcel, Sink, Ticket,
    Transport, WayError, WayFault,
};
use parking_lot::Mutex;
use tokio::io::unix::AsyncFd;
use tokio::runtime::Handle;
use tokio::task::AbortHandle;

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
    endpoint: Arc<Endpoint>,
    listener: Mutex<Option<AbortHandle>>,
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
            endpoint: Endpoint::open(config, runtime)?,
            listener: Mutex::new(None),
        })
    }

    /// Where this endpoint can be reached.
    #[must_use]
    pub fn location(&self) -> Location {
        location_of(self.endpoint.config().incarnation)
    }

    /// What happened so far.
    #[must_use]
    pub fn counters(&self) -> ShmCounters {
        self.endpoint.tally().read()
    }

    /// Processes of this domain may have ended: removes what dead ones have left, if there is
    /// anything, in the background. Need not be called for processes that this one talks to,
    /// whose end the kernel tells.
    pub fn tidy(&self) {
        self.endpoint.clean_soon();
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
        self.close();
    }
}

impl Transport for ShmTransport {
    fn kind(&self) -> Kind {
        Kind::Shm
    }

    fn max_letter(&self) -> usize {
        self.endpoint.config().max_letter
    }

    fn answers_at_once(&self) -> bool {
        true
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let endpoint = &self.endpoint;
        let bell = {
            let _runtime = endpoint.runtime().enter();
            Watched::readable(endpoint.bell().clone())
        };
        let bell = bell.map_err(|source| ListenError::Bind {
            address: self.location().to_string(),
            source,
        })?;
        if !endpoint.tell_to(sink) {
            return Err(ListenError::OpenedBefore);
        }
        let task = answer_the_bell(bell, Arc::downgrade(endpoint));
        *self.listener.lock() = Some(endpoint.runtime().spawn(task).abort_handle());
        // What came before.
        endpoint.bell().ring();
        Ok(vec![self.location()])
    }

    fn dispatch(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError> {
        if let Body::Letter(letter) = &parcel.body {
            self.check_len(letter.len())?;
        }
        self.endpoint.post(attempt, to, &parcel)
    }

    fn abandon(&self, attempt: AttemptId) {
        self.endpoint.abandon(attempt);
    }

    fn answer(&self, _ticket: Ticket, _answer: Answer) {
        // Every arrival has been answered at once, so every ticket is unknown.
    }

    fn drive(&self) -> bool {
        self.endpoint.drive()
    }

    fn loan(
        &self,
        to: &Location,
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Result<Option<Box<dyn LoanedContent>>, WayError> {
        self.check_len(len)?;
        let loan = self.endpoint.loan(to, head_room, len, tail_room)?;
        Ok(Some(Box::new(loan)))
    }

    fn loan_for_many(&self, len: usize) -> Result<Option<Box<dyn LoanedContent>>, WayError> {
        self.check_len(len)?;
        let loan = self.endpoint.pool().loan(len)?;
        Ok(loan.map(|loan| Box::new(loan) as Box<dyn LoanedContent>))
    }

    fn copies_for_each(&self, content: &Bytes) -> bool {
        self.endpoint.pool().copies(content)
    }

    /// Must not be called by the sink while it is told something.
    fn close(&self) {
        if let Some(listener) = self.listener.lock().take() {
            listener.abort();
        }
        self.endpoint.close();
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
