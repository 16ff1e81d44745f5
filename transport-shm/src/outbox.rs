//! The sending side of one other process's mailbox.

use std::collections::{HashMap, VecDeque};
use std::ops::Range;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Weak};

use bytes::Bytes;
use fipa_transport::wire::{ParcelHeader, Pieces};
use fipa_transport::{AttemptId, Body, Conclusion, Incarnation, Parcel, WayError, WayFault};
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::DegradationAction;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy, Node, PortFactory, ServiceName};
use parking_lot::Mutex;

use crate::counters::{Tally, count};
use crate::domain::Domain;
use crate::fault::{
    create_error, loan_error, open_error, retired, send_error, too_large, window_full, wire_error,
};
use crate::fork::Owner;
use crate::layout::{ALIGNMENT, Ack, Blank, Filled, Header, MailClient, Pending, Places, Svc};
use crate::loan::{Loan, ShmLoan};
use crate::memory::{Budget, lacking, populate};
use crate::pool::Pool;
use crate::storage;

/// Bytes of the first, small memory segment's chunks, headers included.
const FIRST_CHUNK: usize = 4096;

/// What creating a client and its connection takes at most, with a window of 128.
const OPENING: u64 = 1 << 20;

static NO_CONTENT: Bytes = Bytes::new();

/// A client of another process's mailbox, and what was sent there and not answered yet.
///
/// # Memory
/// A request's memory comes from segments that iceoryx2 makes larger ones of when needed, each
/// with room for as many chunks as can be in use. Only pages that were asked for are written
/// ([`populate`]): of a new segment those with the chunks' headers, which iceoryx2 writes, and of
/// each chunk as far as it was ever used.
///
/// # Sending never takes memory back
/// `RequestMut::send` drops the request when it fails, and the memory with it. That must not
/// happen to loaned memory, which others read. With the settings chosen here it cannot fail:
/// back-pressure is `DiscardData` without a handler and without overflow, so a full or closed
/// mailbox is `Ok` with nobody reached; degradation is ignored; and the number of active requests
/// is checked before. Should it ever fail all the same, [`Outbox::send_loan`] retires the outbox.
#[derive(Debug)]
pub(crate) struct Outbox {
    client: MailClient,
    own: Incarnation,
    window: usize,
    max_loans: usize,
    chunks: usize,
    state: Mutex<State>,
    waiting: Waiting,
    loans: AtomicUsize,
    retired: AtomicBool,
    token: AtomicU64,
    budget: Arc<Budget>,
    pool: Arc<Pool>,
    tally: Arc<Tally>,
    // After the client: the last of the process to go removes the domain's traces.
    domain: Arc<Domain>,
}

#[derive(Debug, Default)]
struct State {
    queue: VecDeque<Sent>,
    loans: HashMap<usize, Weak<Loan>>,
    segment: Segment,
}

/// What is known of the current memory segment.
#[derive(Debug, Default)]
struct Segment {
    /// Counts the segments.
    number: u64,
    /// Address of the first chunk.
    base: usize,
    /// Distance of chunks.
    stride: usize,
    /// Longest payload that fits a chunk.
    room: usize,
    /// Whether the headers of all chunks have their pages. Until then no chunk but the first is
    /// ever loaned: iceoryx2 loans the chunk that was returned last.
    headers_ready: bool,
    /// By number of a chunk, how many bytes of its payload have their pages.
    ready: Vec<usize>,
}

#[derive(Debug)]
struct Sent {
    attempt: AttemptId,
    token: u64,
    memory: Memory,
}

#[derive(Debug)]
enum Memory {
    Own(Pending),
    Loaned(Arc<Loan>),
    Referring {
        pending: Pending,
        /// The content for many that it refers to.
        _content: Bytes,
    },
}

/// What became of a dispatch.
pub(crate) enum Posted {
    /// It is in the mailbox.
    Yes,
    /// This outbox takes nothing any more.
    Retired,
}

/// The shared parts that an outbox is opened with.
pub(crate) struct Opening<'a> {
    pub(crate) node: &'a Node<Svc>,
    pub(crate) service: &'a ServiceName,
    pub(crate) own: Incarnation,
    /// How many parcels of all outboxes have no answer yet.
    pub(crate) waiting: Arc<AtomicUsize>,
    pub(crate) max_loans: usize,
    pub(crate) budget: Arc<Budget>,
    pub(crate) pool: Arc<Pool>,
    pub(crate) tally: Arc<Tally>,
    pub(crate) domain: Arc<Domain>,
}

impl Outbox {
    pub(crate) fn open(opening: Opening<'_>) -> Result<Self, WayError> {
        opening.budget.check(OPENING)?;
        let _lock = opening
            .domain
            .lock_shared()
            .map_err(|e| WayError::new(WayFault::Congested, e))?;
        let service = opening
            .node
            .service_builder(opening.service)
            .request_response::<[u8], Ack>()
            .request_user_header::<Header>()
            .open()
            .map_err(open_error)?;
        let settings = service.static_config();
        let window = settings.max_active_requests_per_client();
        let most_loans = settings.max_loaned_requests();
        let builder = service
            .client_builder()
            .initial_max_slice_len(FIRST_CHUNK - header_len())
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .set_request_degradation_handler(|_, _| DegradationAction::Ignore)
            .set_response_degradation_handler(|_, _| DegradationAction::Ignore);
        let (client, shortage) = storage::watch(|| builder.create());
        // iceoryx2 makes a client that reaches nobody when its connections have no room.
        if let Some(shortage) = shortage {
            return Err(lacking(shortage));
        }
        let client = client.map_err(create_error)?;
        let start = getrandom::u64()
            .map_err(|e| WayError::new(WayFault::Closed, format_args!("no random numbers: {e}")))?;
        let outbox = Self {
            client,
            own: opening.own,
            window,
            // One is left for letters that were not loaned.
            max_loans: opening
                .max_loans
                .min(most_loans.saturating_sub(1))
                .min(window - 1),
            chunks: 2 * window + most_loans,
            state: Mutex::default(),
            waiting: Waiting {
                here: AtomicUsize::new(0),
                of_all: opening.waiting,
            },
            loans: AtomicUsize::new(0),
            retired: AtomicBool::new(false),
            token: AtomicU64::new(start),
            budget: opening.budget,
            pool: opening.pool,
            tally: opening.tally,
            domain: opening.domain,
        };
        // Takes the pages of the first segment.
        drop(outbox.take(&mut outbox.state.lock(), 1)?);
        Ok(outbox)
    }

    /// How many parcels have no answer yet.
    pub(crate) fn waiting(&self) -> usize {
        self.waiting.here.load(Ordering::Acquire)
    }

    /// Whether nothing would be lost by closing it.
    pub(crate) fn is_idle(&self) -> bool {
        self.waiting() == 0 && self.loans.load(Ordering::Acquire) == 0
    }

    /// From now on it takes no letters. What waits still waits.
    pub(crate) fn retire(&self) {
        // Under the lock that letters are put in under: when this returns, none is on its way.
        let _state = self.state.lock();
        self.retired.store(true, Ordering::Release);
    }

    pub(crate) fn is_retired(&self) -> bool {
        self.retired.load(Ordering::Acquire)
    }

    /// Puts a parcel into the mailbox.
    pub(crate) fn post(&self, attempt: AttemptId, parcel: &Parcel) -> Result<Posted, WayError> {
        let (header, pieces) = ParcelHeader::borrowing(parcel).map_err(wire_error)?;
        let (content, tail) = match &parcel.body {
            Body::Letter(letter) => (&letter.payload().content, letter.payload().tail.len()),
            _ => (&NO_CONTENT, 0),
        };
        let reference = self.pool.find(content);
        let content_here = match reference {
            Some(_) => 0,
            None => content.len(),
        };
        let front = usize::try_from(header.front_len()).unwrap_or(usize::MAX);
        let places = Places::for_lengths(front, content_here, tail).ok_or_else(too_large)?;
        let token = self.token.fetch_add(1, Ordering::Relaxed);

        let mut state = self.state.lock();
        if self.is_retired() {
            return Ok(Posted::Retired);
        }
        // Before it is sent: the answer may be there before this returns, and whoever hears the
        // bell looks for it only where one is waited for; then behind the lock that is held here.
        let expected = self.waiting.one_more();
        if let Some(loan) = self.loan_of(&mut state, content) {
            let fits = loan.has_room(front, tail) && loan.segment == state.segment.number;
            match fits
                .then(|| self.ready_loan(&state, &loan))
                .transpose()?
                .flatten()
            {
                Some(blank) => {
                    let start = loan.front() - front;
                    let header = Header::new(&header, offset(start)?, self.own, token);
                    if !self.send_loan(&loan, blank, header, start, &pieces, content)? {
                        return Ok(Posted::Retired);
                    }
                    count(&self.tally.loans_sent);
                    self.queue(&mut state, attempt, token, Memory::Loaned(loan), expected);
                    return Ok(Posted::Yes);
                }
                None => count(&self.tally.loans_copied),
            }
        }
        let mut blank = self.take(&mut state, places.end)?;
        let header = Header::new(&header, offset(places.start)?, self.own, token);
        *blank.user_header_mut() = header.referring(reference);
        let payload = blank.payload_mut();
        let room = places.start..payload.len();
        let payload = NonNull::from(payload).cast();
        let written = match reference {
            Some(_) => Content::Elsewhere(content),
            None => Content::Here,
        };
        // SAFETY: `room` ends where the payload does. Nothing refers to the payload of a request
        // just taken.
        unsafe { write(payload, room, &pieces, written) };
        // SAFETY: what was not just written is memory of a shared mapping, filled by the kernel or
        // by earlier requests; every value is a byte.
        let filled = unsafe { blank.assume_init() };
        let pending = filled.send().map_err(send_error)?;
        if pending.number_of_server_connections() == 0 {
            return Err(self.nobody_reached(&pending));
        }
        let memory = match reference {
            Some(_) => {
                count(&self.tally.referring);
                Memory::Referring {
                    pending,
                    _content: content.clone(),
                }
            }
            None => Memory::Own(pending),
        };
        self.queue(&mut state, attempt, token, memory, expected);
        Ok(Posted::Yes)
    }

    fn queue(
        &self,
        state: &mut State,
        attempt: AttemptId,
        token: u64,
        memory: Memory,
        expected: Expected<'_>,
    ) {
        state.queue.push_back(Sent {
            attempt,
            token,
            memory,
        });
        expected.will_come();
    }

    fn nobody_reached(&self, pending: &Pending) -> WayError {
        if pending.is_connected() {
            WayError::new(
                WayFault::Congested,
                "the mailbox of the other process is full",
            )
        } else {
            WayError::new(
                WayFault::Unreachable,
                "the other process has closed its mailbox",
            )
        }
    }

    /// The loan that this is the content of.
    fn loan_of(&self, state: &mut State, content: &Bytes) -> Option<Arc<Loan>> {
        if content.is_empty() || state.loans.is_empty() {
            return None;
        }
        let loan = state.loans.get(&(content.as_ptr() as usize))?.upgrade()?;
        loan.is(content).then_some(loan)
    }

    /// Takes the request out of a loan if it can be sent now for certain.
    fn ready_loan(&self, state: &State, loan: &Loan) -> Result<Option<Blank>, WayError> {
        let kept = |loan: &Weak<Loan>| {
            loan.upgrade()
                .is_some_and(|loan| loan.is_kept_after_sending())
        };
        let active = state.queue.len() + state.loans.values().filter(|loan| kept(loan)).count();
        if active >= self.window {
            return Err(window_full(self.window));
        }
        Ok(loan.take())
    }

    /// Sends loaned memory. `false` when iceoryx2 refuses against all expectation, and has taken
    /// the memory back. Others may still read it, so this outbox then loans nothing any more:
    /// nobody overwrites the memory, no larger segment replaces the one it lies in (which is the
    /// current one: the caller has made sure), and the loan keeps the outbox with the segment.
    fn send_loan(
        &self,
        loan: &Arc<Loan>,
        mut blank: Blank,
        header: Header,
        start: usize,
        pieces: &Pieces<'_>,
        content: &Bytes,
    ) -> Result<bool, WayError> {
        *blank.user_header_mut() = header;
        let room = start..loan.payload_len();
        // SAFETY: `room` ends where the payload does, which the request just taken owns. The
        // content, which is all that anybody else refers to, is not written: the front, which
        // begins at `start`, ends where it begins, as the caller has checked, and what is in place
        // is left out. Whoever has taken the request is the only one to write to the rest.
        unsafe { write(loan.payload(), room, pieces, Content::InPlace(content)) };
        // SAFETY: front, content and tail are written; the rest is memory of a shared mapping.
        let filled: Filled = unsafe { blank.assume_init() };
        match filled.send() {
            Ok(pending) if pending.number_of_server_connections() > 0 => {
                loan.sent(pending);
                loan.queued.store(true, Ordering::Relaxed);
                Ok(true)
            }
            Ok(pending) => {
                let error = self.nobody_reached(&pending);
                loan.sent(pending);
                Err(error)
            }
            Err(_) => {
                self.retired.store(true, Ordering::Release);
                Ok(false)
            }
        }
    }

    /// Loans memory for content of this length.
    pub(crate) fn loan(
        self: &Arc<Self>,
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Result<ShmLoan, WayError> {
        let places = Places::for_lengths(head_room, len, tail_room).ok_or_else(too_large)?;
        let mut state = self.state.lock();
        if self.is_retired() {
            return Err(retired());
        }
        if self.loans.load(Ordering::Acquire) >= self.max_loans {
            return Err(WayError::new(
                WayFault::Congested,
                format_args!(
                    "{} loans to this process are out already: send or drop one, or raise max_loans",
                    self.max_loans
                ),
            ));
        }
        let blank = self.take(&mut state, places.end)?;
        self.loans.fetch_add(1, Ordering::AcqRel);
        let loan = Loan::new(
            blank,
            places.content,
            len,
            state.segment.number,
            self.clone(),
        );
        Ok(ShmLoan(Arc::new(loan)))
    }

    /// From now on the content of this loan is recognised.
    pub(crate) fn register(&self, loan: &Arc<Loan>) {
        let mut state = self.state.lock();
        state.loans.retain(|_, loan| loan.strong_count() > 0);
        state.loans.insert(loan.address(), Arc::downgrade(loan));
    }

    pub(crate) fn owner(&self) -> Owner {
        self.domain.owner()
    }

    pub(crate) fn loan_ended(&self) {
        self.loans.fetch_sub(1, Ordering::AcqRel);
    }

    /// A request with a payload of this length, all of whose pages are there.
    fn take(&self, state: &mut State, len: usize) -> Result<Blank, WayError> {
        let segment = &mut state.segment;
        let grows = len > segment.room;
        // Until the pages are there, nobody else takes any.
        let mut _turn = None;
        if grows {
            let headers = self.chunks.saturating_mul(FIRST_CHUNK) as u64;
            let need = (len as u64).saturating_add(headers);
            _turn = Some(self.budget.reserve(need)?);
        }
        let (blank, shortage) = storage::watch(|| self.client.loan_slice_uninit(len));
        let mut blank = blank.map_err(|error| match shortage {
            Some(shortage) => lacking(shortage),
            None => loan_error(error),
        })?;
        let chunk = std::ptr::from_ref(blank.header()) as usize;
        let payload = blank.payload_mut().as_ptr().cast::<u8>();
        let head = payload as usize - chunk;
        let known = !grows
            && chunk >= segment.base
            && (chunk - segment.base).is_multiple_of(segment.stride)
            && (chunk - segment.base) / segment.stride < self.chunks;
        if !known {
            segment.number += 1;
            segment.base = chunk;
            segment.stride = (head + len).max(FIRST_CHUNK).next_power_of_two();
            segment.room = segment.stride - head;
            segment.ready.clear();
            segment.ready.resize(self.chunks, 0);
            segment.headers_ready = false;
        }
        if !segment.headers_ready {
            for number in 0..self.chunks {
                let header = segment.base + number * segment.stride;
                populate(header as *const u8, head)?;
            }
            segment.headers_ready = true;
        }
        let number = (chunk - segment.base) / segment.stride;
        let ready = segment.ready.get_mut(number).ok_or_else(retired)?;
        if *ready < len {
            let missing = len - *ready;
            if missing > 2 * FIRST_CHUNK && !grows {
                _turn = Some(self.budget.reserve(missing as u64)?);
            }
            populate(payload.wrapping_add(*ready), missing)?;
            *ready = len;
        }
        Ok(blank)
    }

    /// Takes the answers that are there. `ended` says that the other process is gone, so that no
    /// further answer comes.
    pub(crate) fn collect(&self, ended: bool, concluded: &mut Vec<(AttemptId, Conclusion)>) {
        if self.waiting() == 0 {
            return;
        }
        // The receiver answers in order, or drops what it does not answer.
        while let Some((sent, conclusion)) = self.concluded(ended) {
            sent.forget();
            concluded.push((sent.attempt, conclusion));
            // Dropped outside of the lock: the last owner of a letter.
        }
    }

    fn concluded(&self, ended: bool) -> Option<(Sent, Conclusion)> {
        let mut state = self.state.lock();
        let conclusion = state.queue.front()?.conclusion(ended)?;
        let sent = state.queue.pop_front()?;
        self.waiting.one_less();
        Some((sent, conclusion))
    }

    /// Whether there is an answer, probably.
    pub(crate) fn has_answer(&self) -> bool {
        self.waiting() > 0
            && self
                .state
                .lock()
                .queue
                .front()
                .is_some_and(Sent::has_answer)
    }

    /// Forgets an attempt, and says whether it was here.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> bool {
        if self.waiting() == 0 {
            return false;
        }
        let mut state = self.state.lock();
        let place = state.queue.iter().position(|sent| sent.attempt == attempt);
        let sent = place.and_then(|place| state.queue.remove(place));
        if sent.is_some() {
            self.waiting.one_less();
        }
        drop(state);
        sent.inspect(Sent::forget).is_some()
    }
}

/// How many parcels have no answer yet.
#[derive(Debug)]
struct Waiting {
    here: AtomicUsize,
    of_all: Arc<AtomicUsize>,
}

/// An answer is waited for from now on; not any more when this is dropped.
struct Expected<'a>(&'a Waiting);

impl Expected<'_> {
    /// The parcel is on its way: it is waited for until it is collected.
    fn will_come(self) {
        std::mem::forget(self);
    }
}

impl Drop for Expected<'_> {
    fn drop(&mut self) {
        self.0.one_less();
    }
}

impl Waiting {
    fn one_more(&self) -> Expected<'_> {
        self.here.fetch_add(1, Ordering::AcqRel);
        self.of_all.fetch_add(1, Ordering::AcqRel);
        Expected(self)
    }

    fn one_less(&self) {
        self.here.fetch_sub(1, Ordering::AcqRel);
        self.of_all.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Sent {
    fn has_answer(&self) -> bool {
        let look = PendingResponse::has_response;
        match &self.memory {
            Memory::Own(pending) | Memory::Referring { pending, .. } => look(pending),
            Memory::Loaned(loan) => loan.with_pending(look).unwrap_or(false),
        }
    }

    fn conclusion(&self, ended: bool) -> Option<Conclusion> {
        let look = |pending: &Pending| self.conclusion_of(pending, ended);
        match &self.memory {
            Memory::Own(pending) | Memory::Referring { pending, .. } => look(pending),
            Memory::Loaned(loan) => loan.with_pending(look).flatten(),
        }
    }

    fn conclusion_of(&self, pending: &Pending, ended: bool) -> Option<Conclusion> {
        let broken = |detail: String| {
            Some(Conclusion::Unconfirmed(WayError::new(
                WayFault::Broken,
                detail,
            )))
        };
        let mut answer = pending.receive();
        let dropped = matches!(answer, Ok(None)) && !pending.is_connected();
        if dropped {
            // It may have been answered in between.
            answer = pending.receive();
        }
        match answer {
            Ok(Some(ack)) => Some(match ack.answer(self.token) {
                Some(answer) => Conclusion::Answered(answer),
                None => Conclusion::Unconfirmed(WayError::new(
                    WayFault::Incompatible,
                    "the answer makes no sense",
                )),
            }),
            Ok(None) if ended => broken("the other process ended before it answered".into()),
            Ok(None) if dropped => broken("the other process dropped it unanswered".into()),
            Ok(None) => None,
            Err(e) => broken(format!("the answer cannot be received: {e:?}")),
        }
    }

    fn forget(&self) {
        if let Memory::Loaned(loan) = &self.memory {
            loan.queued.store(false, Ordering::Relaxed);
        }
    }
}

/// What of the content is written.
enum Content<'a> {
    /// It is written like the rest.
    Here,
    /// It is in its place already.
    InPlace(&'a Bytes),
    /// It lies somewhere else.
    Elsewhere(&'a Bytes),
}

/// Writes pieces behind each other into this room, counted in bytes behind `start`.
///
/// # Panics
/// When they are longer than that. Lengths come from other crates, and nothing but this looks at
/// whether they are those of what is written.
///
/// # Safety
/// The room must be within memory that may be written, and nothing else may refer to what of it is
/// written.
unsafe fn write(start: NonNull<u8>, room: Range<usize>, pieces: &Pieces<'_>, content: Content<'_>) {
    let Range { start: mut at, end } = room;
    for piece in pieces.iter() {
        let place = start.as_ptr().wrapping_add(at);
        let is = |content: &Bytes| std::ptr::eq(&content[..], piece);
        let is_written = match content {
            Content::Elsewhere(content) if is(content) => continue,
            Content::InPlace(content) => !is(content),
            Content::Here | Content::Elsewhere(_) => true,
        };
        let most = end.saturating_sub(at);
        assert!(piece.len() <= most, "pieces as long as the header says");
        if is_written {
            // SAFETY: `place` has room for it, as was just seen, in the memory that the caller
            // vouches for; a piece is not in that memory, because nothing else refers to it.
            unsafe { place.copy_from_nonoverlapping(piece.as_ptr(), piece.len()) };
        }
        at += piece.len();
    }
}

/// iceoryx2's header, ours, and the payload's alignment.
fn header_len() -> usize {
    use iceoryx2::service::header::request_response::RequestHeader;
    (size_of::<RequestHeader>() + size_of::<Header>()).next_multiple_of(ALIGNMENT)
}

fn offset(start: usize) -> Result<u32, WayError> {
    u32::try_from(start).map_err(|_| too_large())
}
