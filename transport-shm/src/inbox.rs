//! The receiving side: this process's mailbox.

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use fipa_transport::wire::ParcelHeader;
use fipa_transport::{
    Answer, Arrival, FailureReason, Hop, Incarnation, Kind, Location, Parcel, Principal, Sink,
    Ticket, Verdict,
};
use iceoryx2::port::{DegradationAction, ReceiveError};
use iceoryx2::prelude::{BackpressureStrategy, Node, PortFactory, ServiceName};
use parking_lot::Mutex;

use crate::ShmConfig;
use crate::counters::{Tally, count};
use crate::layout::{Ack, Active, BlankAck, Header, MailServer, Places, Svc};
use crate::library::{Borrowed, Library, NotRead};
use crate::memory::Address;
use crate::presence::{Bell, Looks};
use crate::segment::Reference;
use crate::storage;

/// How many parcels are taken before anything else is looked at.
const BATCH: usize = 64;

/// How many answers may be on their way to all senders together.
const ANSWERS: usize = 1024;

const _: () = assert!(ANSWERS <= storage::MAX_CHUNKS);

/// The name of the mailbox of a process.
pub(crate) fn mailbox_name(of: Incarnation) -> String {
    format!("fipa/mail/{of}")
}

/// The location of the mailbox of a process.
pub(crate) fn location_of(of: Incarnation) -> Location {
    let address = of.to_string();
    match Location::new(Kind::Shm, &address) {
        Ok(location) => location.with_incarnation(of),
        Err(_) => unreachable!("16 hexadecimal digits are an address"),
    }
}

/// The server of this process's mailbox. Used by one thread at a time.
pub(crate) struct Inbox {
    server: MailServer,
    service_hash: String,
    lending: Arc<Lending>,
    looks: Looks,
    tally: Arc<Tally>,
    max_letter: usize,
    copy_below: usize,
    tickets: u64,
    answers_ready: bool,
    last_sender: Option<Location>,
}

impl Inbox {
    /// The name of its service among the files of the domain.
    pub(crate) fn service_hash(&self) -> &str {
        &self.service_hash
    }

    /// Makes the mailbox.
    pub(crate) fn create(
        config: &ShmConfig,
        node: &Node<Svc>,
        (bell, looks): (Arc<Bell>, Looks),
        tally: Arc<Tally>,
        library: Arc<Library>,
    ) -> Result<Self, String> {
        let name = ServiceName::new(&mailbox_name(config.incarnation)).map_err(debug)?;
        let service = node
            .service_builder(&name)
            .request_response::<[u8], Ack>()
            .request_user_header::<Header>()
            .max_servers(1)
            .max_clients(config.max_clients)
            .max_nodes(config.max_clients + 1)
            .max_active_requests_per_client(config.window)
            .max_loaned_requests(config.max_loans + 1)
            .max_response_buffer_size(1)
            .max_borrowed_responses_per_pending_response(1)
            // A full mailbox refuses; nothing that was put in is pushed out.
            .enable_safe_overflow_for_requests(false)
            // An answer that nobody waits for any more gives way.
            .enable_safe_overflow_for_responses(true)
            // What the sender has abandoned is not delivered.
            .enable_fire_and_forget_requests(false)
            .create()
            .map_err(debug)?;
        let server = service
            .server_builder()
            .max_loaned_responses_per_request(1)
            .override_response_preallocation(|most| most.min(ANSWERS))
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .set_request_degradation_handler(|_, _| DegradationAction::Ignore)
            .set_response_degradation_handler(|_, _| DegradationAction::Ignore)
            .create()
            .map_err(debug)?;
        Ok(Self {
            server,
            service_hash: service.service_hash().as_str().to_owned(),
            lending: Arc::new(Lending {
                per_sender: config.window - 1,
                total: config.max_borrowed,
                held: Mutex::default(),
                waiting: AtomicBool::new(false),
                bell,
                tally: tally.clone(),
                library,
            }),
            looks,
            tally,
            max_letter: config.max_letter,
            copy_below: config.copy_below,
            tickets: 0,
            answers_ready: false,
            last_sender: None,
        })
    }

    /// Takes what is in the mailbox and answers it. Says whether there was anything, and adds
    /// who should look for an answer.
    pub(crate) fn drain(&mut self, sink: &dyn Sink, answered: &Mutex<Vec<Incarnation>>) -> bool {
        for done in 0..BATCH {
            match self.server.receive() {
                Ok(Some(active)) => {
                    if let Some(sender) = self.take(active, sink) {
                        let mut answered = answered.lock();
                        if !answered.contains(&sender) {
                            answered.push(sender);
                        }
                    }
                }
                Ok(None) => {
                    self.looks.one_more();
                    return done > 0;
                }
                Err(ReceiveError::ExceedsMaxBorrows) => {
                    // Cannot happen as long as iceoryx2 counts as `Lending` does. Nothing is
                    // lost: the next content given back rings the bell.
                    self.lending.waiting.store(true, Ordering::SeqCst);
                    return done > 0;
                }
                Err(ReceiveError::ConnectionFailure(_)) => {
                    count(&self.tally.refused);
                    return done > 0;
                }
            }
        }
        // There may be more; others get their turn first.
        self.lending.bell.ring();
        true
    }

    /// Whether something is in the mailbox, as far as it can be told.
    pub(crate) fn has_parcels(&self) -> bool {
        self.server.has_requests().unwrap_or(false)
    }

    fn take(&mut self, active: Active, sink: &dyn Sink) -> Option<Incarnation> {
        count(&self.tally.arrived);
        // A copy in private memory: the sender could still change the original.
        let header: Header = *active.user_header();
        let sender = header.sender();
        // Before the parcel is handed over: without an answer it must not be accepted. The sender
        // of what is dropped here is told that it was.
        let Ok(answer) = active.loan_uninit() else {
            count(&self.tally.refused);
            return Some(sender);
        };
        if !self.prepare_answers(&answer) {
            count(&self.tally.refused);
            return Some(sender);
        }
        let (parcel, owner) = self.read(&header, active);
        let parcel = match parcel {
            Ok(parcel) => parcel,
            Err(refusal) => {
                count(&self.tally.refused);
                self.reply(answer, &refusal, &header);
                drop(owner);
                return sender.is_known().then_some(sender);
            }
        };
        self.tickets += 1;
        let arrival = Arrival {
            parcel,
            from: Hop {
                location: self.location_of_sender(sender),
                principal: Principal::Host,
            },
            ticket: Ticket(self.tickets),
        };
        let verdict = match sink.arrived(arrival) {
            Verdict::Now(answer) => answer,
            Verdict::Later => Answer::failed(
                FailureReason::Refused,
                "answered later, which this transport does not allow",
            ),
        };
        self.reply(answer, &verdict, &header);
        // Only now: dropping the request closes the way back.
        drop(owner);
        Some(sender)
    }

    /// The location of a sender, who is mostly the one before.
    fn location_of_sender(&mut self, sender: Incarnation) -> Location {
        match &self.last_sender {
            Some(location) if location.incarnation() == sender => location.clone(),
            _ => self.last_sender.insert(location_of(sender)).clone(),
        }
    }

    fn reply(&self, blank: BlankAck, answer: &Answer, header: &Header) {
        // It fails when the sender is gone, who then has no use for it.
        let _ = blank.write_payload(Ack::new(answer, header.token())).send();
    }

    /// Takes the pages of all answers, at the first one, whose own page is there from the start.
    fn prepare_answers(&mut self, first: &BlankAck) -> bool {
        if !self.answers_ready {
            let chunk = std::ptr::from_ref(first.header()) as usize;
            self.answers_ready = storage::allocate_all(chunk).is_ok();
        }
        self.answers_ready
    }

    /// The parcel or the refusal, and what owns the memory that its content may lie in.
    fn read(&self, header: &Header, active: Active) -> (Result<Parcel, Answer>, Owner) {
        let refused = |active, reason, detail: &str| {
            let refusal = Answer::failed(reason, detail);
            (Err(refusal), Owner::Unshared(active))
        };
        let Some(parcel) = header.parcel() else {
            return refused(active, FailureReason::Refused, "malformed header");
        };
        let payload = active.payload();
        let Some(places) = Places::announced(header, &parcel, payload.len()) else {
            let detail = "the lengths do not add up";
            return refused(active, FailureReason::Refused, detail);
        };
        let most = self.max_letter.saturating_add(Parcel::MAX_NAME) as u64;
        if parcel.body_len() > most {
            let detail = format!("{} bytes are the most here", self.max_letter);
            return refused(active, FailureReason::TooLarge, &detail);
        }
        if let Some(reference) = header.reference() {
            let around = &payload[places.start..places.end];
            let mut front = Bytes::copy_from_slice(around);
            let tail = front.split_off(places.content - places.start);
            let content = match self.content_for_many(header.sender(), reference, &parcel) {
                Ok(content) => content,
                Err(answer) => return (Err(answer), Owner::Unshared(active)),
            };
            let parcel = parcel.parcel_of_pieces(front, content, tail);
            let parcel = parcel.map_err(|e| Answer::failed(FailureReason::Refused, e.to_string()));
            return (parcel, Owner::Unshared(active));
        }
        let content = &payload[places.content..places.tail];
        let (parcel, owner) = if self.may_lend(content.len(), &active) {
            // What is copied, in one piece of memory.
            let around = [
                &payload[places.start..places.content],
                &payload[places.tail..places.end],
            ];
            let mut front = Bytes::from(around.concat());
            let tail = front.split_off(places.content - places.start);
            let (content, held) = self.lend(NonNull::from(content), active);
            let parcel = parcel.parcel_of_pieces(front, content, tail);
            (parcel, Owner::Shared(held))
        } else {
            let body = Bytes::copy_from_slice(&payload[places.start..places.end]);
            (parcel.parcel(body), Owner::Unshared(active))
        };
        let parcel = parcel.map_err(|e| Answer::failed(FailureReason::Refused, e.to_string()));
        (parcel, owner)
    }

    /// Content that lies in a segment of its sender, read there unless too much is.
    fn content_for_many(
        &self,
        sender: Incarnation,
        reference: Reference,
        parcel: &ParcelHeader,
    ) -> Result<Bytes, Answer> {
        let len = usize::try_from(parcel.content_len()).unwrap_or(usize::MAX);
        let library = &self.lending.library;
        let content = library.read(sender, reference, len).map_err(|e| match e {
            NotRead::Gone => {
                let detail = "its content is not there any more";
                Answer::failed(FailureReason::Refused, detail)
            }
            NotRead::NoRoom => Answer::Busy,
        })?;
        if !self.lending.begin_one() {
            count(&self.tally.copied_full);
            return Ok(Bytes::copy_from_slice(content.as_ref()));
        }
        count(&self.tally.in_place);
        Ok(Bytes::from_owner(ForMany {
            content,
            lending: self.lending.clone(),
        }))
    }

    /// Whether content is handed out in place. If so, it is counted as handed out.
    fn may_lend(&self, len: usize, active: &Active) -> bool {
        let small = len < self.copy_below;
        if !small && self.lending.begin(active.origin().value()) {
            return true;
        }
        if len > 0 {
            count(if small {
                &self.tally.copied_small
            } else {
                &self.tally.copied_full
            });
        }
        false
    }

    /// Content, in place. It must lie in the payload of `active`, and [`Self::may_lend`] must
    /// have said so.
    fn lend(&self, content: NonNull<[u8]>, active: Active) -> (Bytes, Arc<Held>) {
        count(&self.tally.in_place);
        let held = Arc::new(Held {
            sender: active.origin().value(),
            active: Mutex::new(Some(active)),
            lending: self.lending.clone(),
        });
        let bytes = Bytes::from_owner(Content {
            bytes: Address(content),
            _held: held.clone(),
        });
        (bytes, held)
    }
}

fn debug(error: impl std::fmt::Debug) -> String {
    format!("{error:?}")
}

/// Who keeps a request: this side alone, or together with whoever has the content.
#[expect(dead_code, reason = "owned until it is dropped")]
enum Owner {
    Unshared(Active),
    Shared(Arc<Held>),
}

/// A request whose content is read in place.
struct Held {
    active: Mutex<Option<Active>>,
    sender: u128,
    lending: Arc<Lending>,
}

impl Drop for Held {
    fn drop(&mut self) {
        if !self.lending.library.owner().is_this() {
            // In a forked child: giving it back would take it from the parent.
            std::mem::forget(self.active.get_mut().take());
            return;
        }
        // First the memory, then the count: what is counted as free must be free.
        drop(self.active.get_mut().take());
        self.lending.end(self.sender);
    }
}

/// Content in a sender's memory.
struct Content {
    bytes: Address<[u8]>,
    _held: Arc<Held>,
}

impl AsRef<[u8]> for Content {
    fn as_ref(&self) -> &[u8] {
        // SAFETY: the range lies in the payload of the request in `_held`, which stays mapped as
        // long as that lives: the server keeps connections of senders that are gone while content
        // is held there, and never more of them than it can (`Lending::begin`). An honest sender
        // does not write there after sending; see the crate's documentation on trust.
        unsafe { self.bytes.0.as_ref() }
    }
}

/// Content in a sender's segment.
struct ForMany {
    content: Borrowed,
    lending: Arc<Lending>,
}

impl AsRef<[u8]> for ForMany {
    fn as_ref(&self) -> &[u8] {
        self.content.as_ref()
    }
}

impl Drop for ForMany {
    fn drop(&mut self) {
        let _held = self.lending.held.lock();
        self.lending.tally.borrowed.fetch_sub(1, Ordering::Relaxed);
    }
}

/// How much content is read in place.
struct Lending {
    per_sender: usize,
    total: usize,
    /// Of which senders, and how much of each. Few enough to be looked through.
    held: Mutex<Vec<(u128, usize)>>,
    /// The mailbox could not be drained until something is given back.
    waiting: AtomicBool,
    bell: Arc<Bell>,
    tally: Arc<Tally>,
    // Last: whoever held content longest removes the domain's traces, which the library does.
    library: Arc<Library>,
}

impl Lending {
    /// One more content in a segment, which takes no slot of its sender.
    fn begin_one(&self) -> bool {
        let _held = self.held.lock();
        let few = self.tally.borrowed.load(Ordering::Relaxed) < self.total as u64;
        if few {
            self.tally.borrowed.fetch_add(1, Ordering::Relaxed);
        }
        few
    }

    /// One more content of this sender, if that leaves a slot free for its next letter.
    fn begin(&self, sender: u128) -> bool {
        let mut held = self.held.lock();
        // Changed under the lock only.
        if self.tally.borrowed.load(Ordering::Relaxed) >= self.total as u64 {
            return false;
        }
        match held.iter().position(|(one, _)| *one == sender) {
            Some(place) if held[place].1 < self.per_sender => held[place].1 += 1,
            None if held.len() < ShmConfig::MAX_LENDERS => held.push((sender, 1)),
            _ => return false,
        }
        self.tally.borrowed.fetch_add(1, Ordering::Relaxed);
        true
    }

    fn end(&self, sender: u128) {
        let mut held = self.held.lock();
        if let Some(place) = held.iter().position(|(one, _)| *one == sender) {
            held[place].1 -= 1;
            if held[place].1 == 0 {
                held.swap_remove(place);
            }
            self.tally.borrowed.fetch_sub(1, Ordering::Relaxed);
        }
        drop(held);
        if self.waiting.swap(false, Ordering::SeqCst) {
            self.bell.ring();
        }
    }
}
