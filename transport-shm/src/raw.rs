//! Bare iceoryx2 request-response, as this transport uses it: what its speed is compared with.
//!
//! Bytes go from one process to another in shared memory and an answer comes back. There is no
//! directory, no envelope and no promise: nobody is told when the other side is gone, nothing is
//! cleaned up after a process that was killed, and there is no bound on memory but the size of
//! `/dev/shm`, which is checked before a larger segment is made. For benches; feature `raw`.

use std::fmt;
use std::hint::spin_loop;
use std::sync::atomic::{AtomicUsize, Ordering};

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, ServiceName, SignalHandlingMode, ipc_threadsafe,
};
use iceoryx2::request_mut::RequestMut;

use crate::layout::{self, Ack};
use crate::memory::Budget;
use crate::{ShmConfig, ShmError};

type Svc = ipc_threadsafe::Service;

/// As large as the transport's header.
type Header = [u64; size_of::<layout::Header>() / 8];
type Answer = [u8; size_of::<Ack>()];

/// How many requests of one client may always be without an answer.
pub const WINDOW: usize = 16;

/// Loans that a client can have besides.
const LOANS: usize = 2;

/// Length of the first segment's requests.
const FIRST: usize = 4096;

/// What whoever waits does meanwhile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wait {
    /// Looks again and again.
    Spin,
    /// Sleeps until iceoryx2's event says that there is something. Both sides must.
    Block,
}

/// Something that iceoryx2 refused.
#[derive(Debug, thiserror::Error)]
#[error("bare iceoryx2: cannot {what}: {reason}")]
pub struct RawError {
    what: &'static str,
    reason: String,
}

fn cannot<E: fmt::Debug>(what: &'static str) -> impl FnOnce(E) -> RawError {
    move |error| RawError {
        what,
        reason: format!("{error:?}"),
    }
}

/// A process's membership.
pub struct RawNode {
    node: Node<Svc>,
    budget: Budget,
}

impl RawNode {
    /// Makes a node. Of the configuration only the directory, the prefix and the capacity are
    /// used, and the directory is made when it is not there.
    ///
    /// # Errors
    /// When the configuration makes no sense, or iceoryx2 makes no node there.
    pub fn open(config: &ShmConfig) -> Result<Self, ShmError> {
        let node = NodeBuilder::new()
            .config(&config.iceoryx()?)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Svc>()
            .map_err(|error| ShmError::Iceoryx {
                what: "cannot make a node",
                reason: format!("{error:?}"),
                prefix: config.prefix.clone(),
            })?;
        Ok(Self {
            node,
            budget: Budget::new(config),
        })
    }

    /// The side that answers. There can be one of a name.
    ///
    /// # Errors
    /// When iceoryx2 refuses.
    pub fn serve(&self, name: &str) -> Result<RawServer, RawError> {
        let service = self
            .node
            .service_builder(&service_name(name, "mail")?)
            .request_response::<[u8], Answer>()
            .request_user_header::<Header>()
            .max_servers(1)
            .max_clients(2)
            // A request counts until both sides have dropped it, a moment after it was answered.
            .max_active_requests_per_client(2 * WINDOW)
            .max_loaned_requests(LOANS)
            .max_response_buffer_size(1)
            .enable_safe_overflow_for_requests(false)
            .create()
            .map_err(cannot("make the service"))?;
        let server = service
            .server_builder()
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(cannot("make the server"))?;
        let (heard, tell) = self.events(name, ["requests", "answers"])?;
        Ok(RawServer {
            server,
            heard,
            tell,
        })
    }

    /// The side that asks.
    ///
    /// # Errors
    /// When iceoryx2 refuses, or nobody serves this name.
    pub fn connect(&self, name: &str) -> Result<RawClient<'_>, RawError> {
        let service = self
            .node
            .service_builder(&service_name(name, "mail")?)
            .request_response::<[u8], Answer>()
            .request_user_header::<Header>()
            .open()
            .map_err(cannot("open the service"))?;
        let client = service
            .client_builder()
            .initial_max_slice_len(FIRST)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(cannot("make the client"))?;
        let (heard, tell) = self.events(name, ["answers", "requests"])?;
        Ok(RawClient {
            client,
            heard,
            tell,
            room: AtomicUsize::new(FIRST),
            budget: &self.budget,
        })
    }

    /// What one side listens to, and what the other is told by.
    fn events(
        &self,
        name: &str,
        [heard, told]: [&str; 2],
    ) -> Result<(Listener<Svc>, Notifier<Svc>), RawError> {
        let event = |which| {
            let builder = self.node.service_builder(&service_name(name, which)?);
            let event = builder.event().open_or_create();
            event.map_err(cannot("make the event"))
        };
        let listener = event(heard)?.listener_builder().create();
        let notifier = event(told)?.notifier_builder().create();
        Ok((
            listener.map_err(cannot("make the listener"))?,
            notifier.map_err(cannot("make the notifier"))?,
        ))
    }
}

impl fmt::Debug for RawNode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RawNode").finish_non_exhaustive()
    }
}

fn service_name(name: &str, part: &str) -> Result<ServiceName, RawError> {
    ServiceName::new(&format!("{name}/{part}")).map_err(cannot("use the name"))
}

/// The side that takes requests and answers them.
#[derive(Debug)]
pub struct RawServer {
    server: Server<Svc, [u8], Header, Answer, ()>,
    heard: Listener<Svc>,
    tell: Notifier<Svc>,
}

impl RawServer {
    /// Waits for the next request.
    ///
    /// # Errors
    /// When iceoryx2 refuses.
    pub fn receive(&self, wait: Wait) -> Result<RawRequest, RawError> {
        loop {
            let request = self.server.receive().map_err(cannot("look for requests"))?;
            if let Some(request) = request {
                return Ok(RawRequest(request));
            }
            pause(&self.heard, wait)?;
        }
    }

    /// Answers a request.
    ///
    /// # Errors
    /// When iceoryx2 refuses.
    pub fn answer(&self, request: RawRequest, wait: Wait) -> Result<(), RawError> {
        let sent = request.0.send_copy([1; size_of::<Ack>()]);
        sent.map_err(cannot("answer"))?;
        tell(&self.tell, wait)
    }
}

/// A request that came.
#[derive(Debug)]
pub struct RawRequest(ActiveRequest<Svc, [u8], Header, Answer, ()>);

impl RawRequest {
    /// What was sent, in the sender's memory.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        self.0.payload()
    }
}

/// The side that sends requests.
#[derive(Debug)]
pub struct RawClient<'a> {
    client: Client<Svc, [u8], Header, Answer, ()>,
    heard: Listener<Svc>,
    tell: Notifier<Svc>,
    /// The longest payload that the present segment has room for.
    room: AtomicUsize,
    budget: &'a Budget,
}

impl RawClient<'_> {
    /// Memory for a request, which contains anything.
    ///
    /// # Errors
    /// When too many requests are out, or there is no room for more.
    pub fn loan(&self, len: usize) -> Result<RawLoan, RawError> {
        if len > self.room.load(Ordering::Relaxed) {
            let room = len.next_power_of_two();
            // All of them may come to be written, and a full file system would end the process.
            let most = room.saturating_mul(4 * WINDOW + LOANS);
            let need = u64::try_from(most).unwrap_or(u64::MAX);
            self.budget.check(need).map_err(cannot("take memory"))?;
            self.room.store(room, Ordering::Relaxed);
        }
        let loan = self.client.loan_slice_uninit(len);
        let loan = loan.map_err(cannot("loan memory"))?;
        // SAFETY: the payload is memory of a shared mapping that the kernel has filled with
        // zeros, or earlier requests with something; every byte is an `u8`.
        Ok(RawLoan(unsafe { loan.assume_init() }))
    }

    /// Sends a request.
    ///
    /// # Errors
    /// When too many are without an answer.
    pub fn send(&self, loan: RawLoan, wait: Wait) -> Result<RawPending, RawError> {
        let pending = loan.0.send().map_err(cannot("send"))?;
        if pending.number_of_server_connections() == 0 {
            return Err(cannot("send")("nobody takes it"));
        }
        tell(&self.tell, wait)?;
        Ok(RawPending(pending))
    }

    /// Waits until a request is answered.
    ///
    /// # Errors
    /// When iceoryx2 refuses.
    pub fn answered(&self, pending: &RawPending, wait: Wait) -> Result<(), RawError> {
        while pending
            .0
            .receive()
            .map_err(cannot("look for answers"))?
            .is_none()
        {
            pause(&self.heard, wait)?;
        }
        Ok(())
    }
}

/// Memory for a request.
#[derive(Debug)]
pub struct RawLoan(RequestMut<Svc, [u8], Header, Answer, ()>);

impl RawLoan {
    /// To be written.
    pub fn content_mut(&mut self) -> &mut [u8] {
        self.0.payload_mut()
    }
}

/// A request that was sent.
#[derive(Debug)]
pub struct RawPending(PendingResponse<Svc, [u8], Header, Answer, ()>);

fn pause(heard: &Listener<Svc>, wait: Wait) -> Result<(), RawError> {
    match wait {
        Wait::Spin => spin_loop(),
        Wait::Block => {
            let woken = heard.blocking_wait(|_| {});
            woken.map_err(cannot("wait for the event"))?;
        }
    }
    Ok(())
}

fn tell(notifier: &Notifier<Svc>, wait: Wait) -> Result<(), RawError> {
    if wait == Wait::Block {
        notifier.notify().map_err(cannot("notify"))?;
    }
    Ok(())
}
