//! Bare iceoryx2 with the settings of this transport, for comparison in benches: request-response and
//! publish-subscribe.
//!
//! A request goes to another process in shared memory and an answer comes back. A sample goes to all
//! subscribers, which do not answer. There is no directory and no envelope. The end of a peer is not
//! detected, files of killed processes are not cleaned up, and memory is bounded only by the size of
//! `/dev/shm`, which is checked before a larger segment is created. Feature `raw`.

use std::fmt;
use std::hint::spin_loop;
use std::sync::atomic::{AtomicUsize, Ordering};

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::server::Server;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, ServiceName, SignalHandlingMode, ipc_threadsafe,
};
use iceoryx2::request_mut::RequestMut;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;

use crate::layout::{self, Ack};
use crate::memory::Budget;
use crate::{ShmConfig, ShmError};

type Svc = ipc_threadsafe::Service;

/// A user header of the same length as the transport's.
type Header = [u64; size_of::<layout::Header>() / 8];
type Answer = [u8; size_of::<Ack>()];

/// Number of requests of one client that may be unanswered.
pub const WINDOW: usize = 16;

/// Number of loans that a client can have in addition, and of a publisher.
const LOANS: usize = 2;

/// Number of samples that wait for a subscriber before [`RawPublisher::send`] fails.
const WAITING: usize = 64;

/// Length in bytes of requests and samples in the first segment.
const FIRST: usize = 4096;

/// The method of waiting.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wait {
    /// Polls in a loop.
    Spin,
    /// Sleeps until an iceoryx2 event. Both sides must use it.
    Block,
}

/// An iceoryx2 operation failed.
#[derive(Debug, thiserror::Error)]
#[error("bare iceoryx2: cannot {what}: {reason}")]
pub struct RawError {
    what: &'static str,
    reason: String,
}

fn cannot<E: fmt::Debug>(what: &'static str) -> impl FnOnce(E) -> RawError {
    move |error| RawError {
        what,
        reason: crate::errors::words(&error),
    }
}

/// An iceoryx2 node.
pub struct RawNode {
    node: Node<Svc>,
    budget: Budget,
}

impl RawNode {
    /// Creates a node. Uses only the directory, the prefix and the capacity of the configuration,
    /// and creates the directory if it is missing.
    ///
    /// # Errors
    /// Returns an error if the configuration is invalid or iceoryx2 cannot create the node.
    pub fn open(config: &ShmConfig) -> Result<Self, ShmError> {
        let node = NodeBuilder::new()
            .config(&config.iceoryx(&config.prefix)?)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Svc>()
            .map_err(|error| ShmError::Iceoryx {
                what: "cannot create a node",
                reason: crate::errors::words(&error),
                prefix: config.prefix.clone(),
            })?;
        Ok(Self {
            node,
            budget: Budget::new(config),
        })
    }

    /// Creates the answering side. A name can have one.
    ///
    /// # Errors
    /// Returns an error if an iceoryx2 operation fails.
    pub fn serve(&self, name: &str) -> Result<RawServer, RawError> {
        let service = self
            .node
            .service_builder(&service_name(name, "mail")?)
            .request_response::<[u8], Answer>()
            .request_user_header::<Header>()
            .max_servers(1)
            .max_clients(2)
            // A request counts until both sides have dropped it, which is shortly after its answer.
            .max_active_requests_per_client(2 * WINDOW)
            .max_loaned_requests(LOANS)
            .max_response_buffer_size(1)
            .enable_safe_overflow_for_requests(false)
            .create()
            .map_err(cannot("create the service"))?;
        let server = service
            .server_builder()
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(cannot("create the server"))?;
        let (listener, notifier) = self.events(name, ["requests", "answers"])?;
        Ok(RawServer {
            server,
            listener,
            notifier,
        })
    }

    /// Creates the requesting side.
    ///
    /// # Errors
    /// Returns an error if an iceoryx2 operation fails or this name has no server.
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
            .map_err(cannot("create the client"))?;
        let (listener, notifier) = self.events(name, ["answers", "requests"])?;
        Ok(RawClient {
            client,
            listener,
            notifier,
            room: AtomicUsize::new(FIRST),
            budget: &self.budget,
        })
    }

    /// Creates the publishing side, for at most this number of subscribers. A name can have one.
    ///
    /// # Errors
    /// Returns an error if an iceoryx2 operation fails.
    pub fn publish(&self, name: &str, subscribers: usize) -> Result<RawPublisher<'_>, RawError> {
        let service = self
            .node
            .service_builder(&service_name(name, "samples")?)
            .publish_subscribe::<[u8]>()
            .max_publishers(1)
            .max_subscribers(subscribers)
            .max_nodes(subscribers + 1)
            .subscriber_max_buffer_size(WAITING)
            .subscriber_max_borrowed_samples(1)
            .enable_safe_overflow(false)
            .create()
            .map_err(cannot("create the service"))?;
        // All subscribers share the samples that wait, so fewer chunks are in use than iceoryx2 prepares for.
        let chunks = WAITING + subscribers + LOANS;
        let publisher = service
            .publisher_builder()
            .initial_max_slice_len(FIRST)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .max_loaned_samples(LOANS)
            .override_sample_preallocation(move |_| chunks)
            .create()
            .map_err(cannot("create the publisher"))?;
        let event = self
            .node
            .service_builder(&service_name(name, "samples")?)
            .event()
            .max_listeners(subscribers)
            .max_nodes(subscribers + 1)
            .create()
            .map_err(cannot("create the event"))?;
        let notifier = event.notifier_builder().create();
        Ok(RawPublisher {
            publisher,
            notifier: notifier.map_err(cannot("create the notifier"))?,
            subscribers,
            chunks,
            room: AtomicUsize::new(FIRST),
            budget: &self.budget,
        })
    }

    /// Creates a subscribing side.
    ///
    /// # Errors
    /// Returns an error if an iceoryx2 operation fails or this name has no publisher.
    pub fn subscribe(&self, name: &str) -> Result<RawSubscriber, RawError> {
        let service = self
            .node
            .service_builder(&service_name(name, "samples")?)
            .publish_subscribe::<[u8]>()
            .open()
            .map_err(cannot("open the service"))?;
        let subscriber = service.subscriber_builder().create();
        let event = self
            .node
            .service_builder(&service_name(name, "samples")?)
            .event()
            .open()
            .map_err(cannot("open the event"))?;
        let listener = event.listener_builder().create();
        Ok(RawSubscriber {
            subscriber: subscriber.map_err(cannot("create the subscriber"))?,
            listener: listener.map_err(cannot("create the listener"))?,
        })
    }

    /// The events of one side: the one it waits for, and the one that it notifies.
    fn events(
        &self,
        name: &str,
        [received, sent]: [&str; 2],
    ) -> Result<(Listener<Svc>, Notifier<Svc>), RawError> {
        let event = |which| {
            let builder = self.node.service_builder(&service_name(name, which)?);
            let event = builder.event().open_or_create();
            event.map_err(cannot("create the event"))
        };
        let listener = event(received)?.listener_builder().create();
        let notifier = event(sent)?.notifier_builder().create();
        Ok((
            listener.map_err(cannot("create the listener"))?,
            notifier.map_err(cannot("create the notifier"))?,
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

/// The side that receives requests and answers them.
#[derive(Debug)]
pub struct RawServer {
    server: Server<Svc, [u8], Header, Answer, ()>,
    listener: Listener<Svc>,
    notifier: Notifier<Svc>,
}

impl RawServer {
    /// Waits for the next request.
    ///
    /// # Errors
    /// Returns an error if an iceoryx2 operation fails.
    pub fn receive(&self, wait: Wait) -> Result<RawRequest, RawError> {
        loop {
            let request = self.server.receive().map_err(cannot("receive a request"))?;
            if let Some(request) = request {
                return Ok(RawRequest(request));
            }
            pause(&self.listener, wait)?;
        }
    }

    /// Answers a request.
    ///
    /// # Errors
    /// Returns an error if an iceoryx2 operation fails.
    pub fn answer(&self, request: RawRequest, wait: Wait) -> Result<(), RawError> {
        let sent = request.0.send_copy([1; size_of::<Ack>()]);
        sent.map_err(cannot("answer"))?;
        notify(&self.notifier, wait)
    }
}

/// A received request.
#[derive(Debug)]
pub struct RawRequest(ActiveRequest<Svc, [u8], Header, Answer, ()>);

impl RawRequest {
    /// The payload, in the sender's memory.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        self.0.payload()
    }
}

/// The side that sends requests.
#[derive(Debug)]
pub struct RawClient<'a> {
    client: Client<Svc, [u8], Header, Answer, ()>,
    listener: Listener<Svc>,
    notifier: Notifier<Svc>,
    /// Length in bytes of the longest payload that fits the current segment.
    room: AtomicUsize,
    budget: &'a Budget,
}

impl RawClient<'_> {
    /// Loans memory for a request. Its content is arbitrary.
    ///
    /// # Errors
    /// Returns an error if too many requests are out, or memory is short.
    pub fn loan(&self, len: usize) -> Result<RawLoan, RawError> {
        check_room(&self.room, self.budget, len, 4 * WINDOW + LOANS)?;
        let loan = self.client.loan_slice_uninit(len);
        let loan = loan.map_err(cannot("loan memory"))?;
        // SAFETY: every byte of the payload is initialized by the kernel or by an earlier request,
        // because it is memory of a shared mapping, and every value is a valid `u8`.
        Ok(RawLoan(unsafe { loan.assume_init() }))
    }

    /// Sends a request.
    ///
    /// # Errors
    /// Returns an error if too many requests are unanswered.
    pub fn send(&self, loan: RawLoan, wait: Wait) -> Result<RawPending, RawError> {
        let pending = loan.0.send().map_err(cannot("send"))?;
        if pending.number_of_server_connections() == 0 {
            return Err(cannot("send")("the server's mailbox is full or closed"));
        }
        notify(&self.notifier, wait)?;
        Ok(RawPending(pending))
    }

    /// Waits until a request is answered.
    ///
    /// # Errors
    /// Returns an error if an iceoryx2 operation fails.
    pub fn answered(&self, pending: &RawPending, wait: Wait) -> Result<(), RawError> {
        while pending
            .0
            .receive()
            .map_err(cannot("receive an answer"))?
            .is_none()
        {
            pause(&self.listener, wait)?;
        }
        Ok(())
    }
}

/// Memory for a request.
#[derive(Debug)]
pub struct RawLoan(RequestMut<Svc, [u8], Header, Answer, ()>);

impl RawLoan {
    /// The writable payload.
    pub fn content_mut(&mut self) -> &mut [u8] {
        self.0.payload_mut()
    }
}

/// A sent request.
#[derive(Debug)]
pub struct RawPending(PendingResponse<Svc, [u8], Header, Answer, ()>);

/// The side that sends samples to all subscribers.
#[derive(Debug)]
pub struct RawPublisher<'a> {
    publisher: Publisher<Svc, [u8], ()>,
    notifier: Notifier<Svc>,
    /// Number of subscribers that each sample must reach.
    subscribers: usize,
    /// Number of samples that a segment has room for.
    chunks: usize,
    /// Length in bytes of the longest payload that fits the current segment.
    room: AtomicUsize,
    budget: &'a Budget,
}

impl RawPublisher<'_> {
    /// Loans memory for a sample. Its content is arbitrary.
    ///
    /// # Errors
    /// Returns an error if memory is short.
    pub fn loan(&self, len: usize) -> Result<RawSampleLoan, RawError> {
        check_room(&self.room, self.budget, len, self.chunks)?;
        let loan = self.publisher.loan_slice_uninit(len);
        let loan = loan.map_err(cannot("loan memory"))?;
        // SAFETY: every byte of the payload is initialized by the kernel or by an earlier sample,
        // because it is memory of a shared mapping, and every value is a valid `u8`.
        Ok(RawSampleLoan(unsafe { loan.assume_init() }))
    }

    /// Sends a sample to all subscribers, and wakes them if they block.
    ///
    /// # Errors
    /// Returns an error if a subscriber does not get the sample.
    pub fn send(&self, loan: RawSampleLoan, wait: Wait) -> Result<(), RawError> {
        let receivers = loan.0.send().map_err(cannot("publish"))?;
        if receivers != self.subscribers {
            return Err(cannot("publish")(
                "a subscriber is absent or has a full queue",
            ));
        }
        notify(&self.notifier, wait)
    }
}

/// Memory for a sample.
#[derive(Debug)]
pub struct RawSampleLoan(SampleMut<Svc, [u8], ()>);

impl RawSampleLoan {
    /// The writable payload.
    pub fn content_mut(&mut self) -> &mut [u8] {
        self.0.payload_mut()
    }
}

/// A side that receives samples.
#[derive(Debug)]
pub struct RawSubscriber {
    subscriber: Subscriber<Svc, [u8], ()>,
    listener: Listener<Svc>,
}

impl RawSubscriber {
    /// Waits for the next sample.
    ///
    /// # Errors
    /// Returns an error if an iceoryx2 operation fails.
    pub fn receive(&self, wait: Wait) -> Result<RawSample, RawError> {
        loop {
            let sample = self.subscriber.receive();
            if let Some(sample) = sample.map_err(cannot("receive a sample"))? {
                return Ok(RawSample(sample));
            }
            pause(&self.listener, wait)?;
        }
    }
}

/// A received sample.
#[derive(Debug)]
pub struct RawSample(Sample<Svc, [u8], ()>);

impl RawSample {
    /// The payload, in the publisher's memory.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        self.0.payload()
    }
}

/// Checks that the file system has memory for a segment with this number of chunks, if `len` needs a larger one.
fn check_room(
    room: &AtomicUsize,
    budget: &Budget,
    len: usize,
    chunks: usize,
) -> Result<(), RawError> {
    if len > room.load(Ordering::Relaxed) {
        let larger = len.next_power_of_two();
        // Every chunk may be written later, and a full file system would then end the process.
        let need = u64::try_from(larger.saturating_mul(chunks)).unwrap_or(u64::MAX);
        budget.check(need).map_err(cannot("allocate memory"))?;
        room.store(larger, Ordering::Relaxed);
    }
    Ok(())
}

fn pause(listener: &Listener<Svc>, wait: Wait) -> Result<(), RawError> {
    match wait {
        Wait::Spin => spin_loop(),
        Wait::Block => {
            let woken = listener.blocking_wait(|_| {});
            woken.map_err(cannot("wait for the event"))?;
        }
    }
    Ok(())
}

fn notify(notifier: &Notifier<Svc>, wait: Wait) -> Result<(), RawError> {
    if wait == Wait::Block {
        notifier.notify().map_err(cannot("notify"))?;
    }
    Ok(())
}
