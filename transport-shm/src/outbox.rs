//! The sending side of another process's mailbox.

use std::collections::VecDeque;
use std::os::fd::OwnedFd;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering, fence};
use std::sync::{Arc, Weak};

use bytes::Bytes;
use fipa_transport::wire::{ParcelHeader, Pieces};
use fipa_transport::{
    Answer, AttemptId, Body, Conclusion, Incarnation, Parcel, TransportError, TransportErrorKind,
};
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::DegradationAction;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy, Node, PortFactory, ServiceName};
use parking_lot::{Mutex, MutexGuard};
use smallvec::SmallVec;

use crate::counters::{Tally, count, count_alone};
use crate::domain_files::DomainFiles;
use crate::errors::{
    allocating, create_error, loan_error, open_error, retired, send_error, too_large, window_full,
    wire_error,
};
use crate::fork::OwnerMark;
use crate::layout::{
    ALIGNMENT, Ack, Header, InitRequest, MailClient, Pending, PieceOffsets, Response, Svc,
    UninitRequest, answer_of,
};
use crate::loan::{Loan, ShmLoan};
use crate::memory::{Budget, populate, shortage_error};
use crate::parcel_writer::{ContentWrite, write};
use crate::pool::Pool;
use crate::presence::{AnswerPlace, StatusPage, WordLender};
use crate::storage;

/// Length in bytes of the chunks of the first memory segment, headers included.
const FIRST_CHUNK: usize = 4096;

/// Length of the payload of a short parcel, in bytes. It fits a chunk of the first segment.
const SHORT: usize = FIRST_CHUNK - header_len();

/// Upper bound of the memory for a client and its connection, with a window of 128.
const OPENING: u64 = 1 << 20;

static NO_CONTENT: Bytes = Bytes::new();

/// Attempts that have ended. Most polls end few.
pub(crate) type Concluded = SmallVec<[(AttemptId, Conclusion); 4]>;

/// A client of another process's mailbox, and the parcels sent there that are unanswered.
///
/// # Memory
/// The memory of requests comes from segments. iceoryx2 creates a larger segment when needed, each
/// with room for as many chunks as can be in use. Only pages that were populated before are written
/// ([`populate`]): in a new segment the pages of all chunk headers, which iceoryx2 writes, and in
/// each chunk the pages of the longest payload so far.
///
/// # Sending never takes memory back
/// `RequestMut::send` drops the request, and its memory, when it fails. That must not happen to
/// loaned memory, which other processes and the application read. With the settings here, it cannot
/// fail: the backpressure strategy is `DiscardData` without a handler and without overflow, so a
/// full or closed mailbox is `Ok` with no receiver reached; degradation is ignored; and the number
/// of active requests is checked before. If it fails all the same, [`Outbox::send_loan`] retires
/// the outbox.
#[derive(Debug)]
pub(crate) struct Outbox {
    client: MailClient,
    own: Incarnation,
    /// Maximum number of unanswered parcels.
    places: usize,
    /// Number of unanswered parcels at which no letter is sent.
    letters: usize,
    max_loans: usize,
    chunks: usize,
    state: Mutex<State>,
    waiting: UnansweredCount,
    loans: AtomicUsize,
    retired: AtomicBool,
    /// The words in which parcels of this process are answered.
    lender: Arc<WordLender>,
    /// The status page of the mailbox's process, on which parcels are announced.
    page: Arc<StatusPage>,
    /// Whether the process answers parcels late. Such a process does not answer in words.
    answers_late: bool,
    budget: Arc<Budget>,
    pool: Arc<Pool>,
    tally: Arc<Tally>,
    // After the client: the last owner in the process removes the domain's files.
    domain: Arc<DomainFiles>,
}

#[derive(Debug, Default)]
struct State {
    queue: VecDeque<Sent>,
    /// A copied parcel that was answered. It is released behind the next parcel, so that both processes
    /// work at the same time.
    answered: Option<AnsweredParcel>,
    /// Memory for the next short parcel, in the current segment. It is taken while the receiver has the
    /// parcel before.
    next: Option<UninitRequest>,
    /// The registered loans by the addresses of their contents; at most `max_loans` exist.
    loans: Vec<(usize, Weak<Loan>)>,
    segment: Segment,
}

/// The state of the current memory segment.
#[derive(Debug, Default)]
struct Segment {
    /// Sequence number of the segment.
    number: u64,
    /// Address of the first chunk.
    base: usize,
    /// Distance between chunks in bytes.
    stride: usize,
    /// Length of the longest payload that fits a chunk.
    room: usize,
    /// Whether the pages of all chunk headers are allocated. Until then only the first chunk is
    /// loaned, because iceoryx2 loans the chunk that was returned last.
    headers_ready: bool,
    /// For each chunk, the number of bytes of its payload whose pages are allocated.
    ready: Vec<usize>,
}

#[derive(Debug)]
struct Sent {
    attempt: AttemptId,
    answer: AnswerPlace,
    memory: SentMemory,
}

#[derive(Debug)]
enum SentMemory {
    Own(Pending),
    Loaned(Arc<Loan>),
    Referring {
        pending: Pending,
        /// Keeps the content in a segment that the letter refers to.
        _content: Bytes,
    },
}

/// The memory of an answered parcel.
#[derive(Debug)]
struct AnsweredParcel {
    _answer: Option<Response>,
    // After the answer, which came over the channel of this parcel.
    memory: SentMemory,
}

/// The result of a dispatch.
pub(crate) enum Posted {
    /// The parcel is in the mailbox.
    Sent,
    /// The outbox is retired and has not taken the parcel.
    Retired,
    /// The parcel needs more memory, and another process is allocating some.
    Contended,
}

/// The way of looking for answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum AnswerLook {
    /// For answers in words, and on the open connections for answers to parcels without a word.
    Quick,
    /// For all answers, also on new connections, and for parcels that were dropped without an answer.
    Thorough,
    /// As `Thorough`, after the end of the process: no further answer will come.
    Ended,
}

/// The lock under which memory is allocated.
pub(crate) enum MemoryLock {
    /// Taken if it is free.
    Try,
    /// Waited for.
    Wait,
    /// Taken by the caller.
    Held(OwnedFd),
}

/// The arguments of [`Outbox::open`].
pub(crate) struct Opening<'a> {
    pub(crate) node: &'a Node<Svc>,
    pub(crate) service: &'a ServiceName,
    pub(crate) own: Incarnation,
    pub(crate) lender: Arc<WordLender>,
    pub(crate) page: Arc<StatusPage>,
    /// Number of unanswered parcels of all outboxes.
    pub(crate) waiting: Arc<AtomicUsize>,
    pub(crate) max_loans: usize,
    pub(crate) budget: Arc<Budget>,
    pub(crate) pool: Arc<Pool>,
    pub(crate) tally: Arc<Tally>,
    pub(crate) domain: Arc<DomainFiles>,
    /// The shared lock of the domain.
    pub(crate) lock: OwnedFd,
    /// Whether to wait for another process that allocates memory.
    pub(crate) memory: MemoryLock,
}

impl Outbox {
    pub(crate) fn open(opening: Opening<'_>) -> Result<Self, TransportError> {
        opening.budget.check(OPENING)?;
        let _lock = opening.lock;
        let service = opening
            .node
            .service_builder(opening.service)
            .request_response::<[u8], Ack>()
            .request_user_header::<Header>()
            .open()
            .map_err(open_error)?;
        let settings = service.static_config();
        let places = settings.max_active_requests_per_client();
        let letters = places - places / 5;
        let most_loans = settings.max_loaned_requests();
        let builder = service
            .client_builder()
            .initial_max_slice_len(SHORT)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .set_request_degradation_handler(|_, _| DegradationAction::Ignore)
            .set_response_degradation_handler(|_, _| DegradationAction::Ignore);
        let (client, shortage) = storage::with_shortage(|| builder.create());
        // If there is no room for its connections, iceoryx2 creates a client that reaches no
        // receiver.
        if let Some(shortage) = shortage {
            return Err(shortage_error(shortage));
        }
        let client = client.map_err(create_error)?;
        let outbox = Self {
            client,
            own: opening.own,
            places,
            letters,
            // One slot stays free for letters that were not loaned.
            max_loans: opening
                .max_loans
                .min(most_loans.saturating_sub(1))
                .min(letters - 1),
            chunks: 2 * places + most_loans,
            state: Mutex::default(),
            waiting: UnansweredCount {
                of_peer: AtomicUsize::new(0),
                of_all: opening.waiting,
            },
            loans: AtomicUsize::new(0),
            retired: AtomicBool::new(false),
            lender: opening.lender,
            // Set before the mailbox can be opened.
            answers_late: opening.page.words().answers_late(),
            page: opening.page,
            budget: opening.budget,
            pool: opening.pool,
            tally: opening.tally,
            domain: opening.domain,
        };
        // Allocates the pages of the first segment.
        let request = outbox.take(&mut outbox.state.lock(), 1, opening.memory)?;
        drop(request.ok_or_else(allocating)?);
        Ok(outbox)
    }

    /// Number of unanswered parcels.
    pub(crate) fn waiting(&self) -> usize {
        self.waiting.of_peer.load(Ordering::Acquire)
    }

    /// Whether the outbox can be closed without losing anything.
    pub(crate) fn is_idle(&self) -> bool {
        self.waiting() == 0 && self.loans.load(Ordering::Acquire) == 0
    }

    /// Stops accepting letters. Unanswered ones still get their answers.
    pub(crate) fn retire(&self) {
        // Under the lock of `post`: when this returns, no parcel is being sent.
        let _state = self.state.lock();
        self.retired.store(true, Ordering::Release);
    }

    pub(crate) fn is_retired(&self) -> bool {
        self.retired.load(Ordering::Acquire)
    }

    /// Puts a parcel into the mailbox.
    pub(crate) fn post(
        &self,
        attempt: AttemptId,
        parcel: &Parcel,
        lock: MemoryLock,
    ) -> Result<Posted, TransportError> {
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
        let offsets = PieceOffsets::for_lengths(front, content_here, tail).ok_or_else(too_large)?;
        let answer = self.lender.lend(!self.answers_late);

        let mut state = self.state.lock();
        if self.is_retired() {
            return Ok(Posted::Retired);
        }
        // iceoryx2 counts it as unanswered, and this parcel too.
        let is_letter = matches!(parcel.body, Body::Letter(_));
        if is_letter && state.queue.len() >= self.letters {
            return Err(window_full(state.queue.len()));
        }
        if state.queue.len() + state.loans.len() + 2 > self.places {
            state.answered = None;
        }
        // Counted before it is sent: the answer may arrive before this returns, and the thread that
        // gets the wake-up looks for answers only if the count is not 0. It then waits for the lock
        // held here.
        let unanswered = self.waiting.increment();
        if let Some(loan) = self.loan_of(&state, content) {
            let fits = loan.has_room(front, tail) && loan.segment == state.segment.number;
            match fits
                .then(|| self.ready_loan(&state, &loan))
                .transpose()?
                .flatten()
            {
                Some(request) => {
                    let start = loan.front() - front;
                    let header = Header::new(
                        &header,
                        offset(start)?,
                        self.own,
                        answer.token(),
                        answer.word(),
                    );
                    if !self.send_loan(&loan, request, header, start, &pieces, content)? {
                        return Ok(Posted::Retired);
                    }
                    count(&self.tally.loans_sent);
                    let sent = Sent {
                        attempt,
                        answer,
                        memory: SentMemory::Loaned(loan),
                    };
                    self.queue(state, sent, unanswered);
                    return Ok(Posted::Sent);
                }
                None => count(&self.tally.loans_copied),
            }
        }
        let next = state.next.take();
        let mut request = match next.filter(|next| offsets.end <= next.payload().len()) {
            Some(next) => next,
            None => match self.take(&mut state, offsets.end, lock)? {
                Some(request) => request,
                None => return Ok(Posted::Contended),
            },
        };
        let header = Header::new(
            &header,
            offset(offsets.start)?,
            self.own,
            answer.token(),
            answer.word(),
        );
        *request.user_header_mut() = header.referring(reference);
        let payload = request.payload_mut();
        let room = offsets.start..payload.len();
        let payload = NonNull::from(payload).cast();
        let written = match reference {
            Some(_) => ContentWrite::Elsewhere(content),
            None => ContentWrite::Here,
        };
        // SAFETY: `room` ends where the payload does. The request was just taken, so nothing else
        // refers to its payload.
        unsafe { write(payload, room, &pieces, written) };
        // SAFETY: every byte of the payload is initialized: by `write`, or by the kernel or an
        // earlier request, because it is memory of a shared mapping.
        let filled = unsafe { request.assume_init() };
        let pending = {
            let _announced = self.page.words().announce();
            filled.send()
        };
        let pending = pending.map_err(send_error)?;
        if pending.number_of_server_connections() == 0 {
            return Err(self.not_delivered(&pending));
        }
        let memory = match reference {
            Some(_) => {
                count(&self.tally.referring);
                SentMemory::Referring {
                    pending,
                    _content: content.clone(),
                }
            }
            None => SentMemory::Own(pending),
        };
        let sent = Sent {
            attempt,
            answer,
            memory,
        };
        self.queue(state, sent, unanswered);
        Ok(Posted::Sent)
    }

    fn queue(&self, mut state: MutexGuard<'_, State>, sent: Sent, unanswered: UnansweredGuard<'_>) {
        state.queue.push_back(sent);
        unanswered.keep();
        let answered = state.answered.take();
        if let Some(Sent {
            memory: SentMemory::Own(pending),
            ..
        }) = state.queue.back()
            && pending.payload().len() <= SHORT
        {
            // Without memory, the next parcel reports the error.
            state.next = self.take(&mut state, SHORT, MemoryLock::Try).ok().flatten();
        }
        drop(state);
        drop(answered);
    }

    fn not_delivered(&self, pending: &Pending) -> TransportError {
        if pending.is_connected() {
            TransportError::new(
                TransportErrorKind::Congested,
                "the mailbox of the other process is full",
            )
        } else {
            TransportError::new(
                TransportErrorKind::Unreachable,
                "the other process has closed its mailbox",
            )
        }
    }

    /// The loan whose content this is.
    fn loan_of(&self, state: &State, content: &Bytes) -> Option<Arc<Loan>> {
        if content.is_empty() {
            return None;
        }
        let address = content.as_ptr() as usize;
        let mut loans = state.loans.iter().filter(|(one, _)| *one == address);
        loans.find_map(|(_, loan)| loan.upgrade().filter(|loan| loan.is(content)))
    }

    /// Takes the request out of a loan if iceoryx2 will accept it now.
    fn ready_loan(
        &self,
        state: &State,
        loan: &Loan,
    ) -> Result<Option<UninitRequest>, TransportError> {
        let is_in_use = |loan: &Weak<Loan>| {
            loan.upgrade()
                .is_some_and(|loan| loan.is_kept_after_sending())
        };
        let active = state.queue.len()
            + state
                .loans
                .iter()
                .filter(|(_, loan)| is_in_use(loan))
                .count();
        if active >= self.letters {
            return Err(window_full(active));
        }
        Ok(loan.take())
    }

    /// Sends loaned memory. Returns `false` if iceoryx2 unexpectedly refuses, which takes the
    /// memory back. The application and other processes may still read it, so the outbox is then
    /// retired and loans nothing. Hence the memory is not overwritten, no larger segment
    /// replaces its segment (which is the current one, as the caller has checked), and the loan
    /// keeps the outbox and so the segment.
    fn send_loan(
        &self,
        loan: &Arc<Loan>,
        mut request: UninitRequest,
        header: Header,
        start: usize,
        pieces: &Pieces<'_>,
        content: &Bytes,
    ) -> Result<bool, TransportError> {
        *request.user_header_mut() = header;
        let room = start..loan.payload_len();
        // SAFETY: `room` ends where the payload does, which the request just taken owns. Other
        // references exist only to the content, which is not written: `ContentWrite::InPlace`
        // leaves it out, and the front, which begins at `start`, ends where the content begins, as
        // the caller has checked. The request is taken once, so no other thread writes to the rest.
        unsafe { write(loan.payload(), room, pieces, ContentWrite::InPlace(content)) };
        // SAFETY: front, content and tail are written. The rest was initialized by the kernel or an
        // earlier request, because it is memory of a shared mapping.
        let filled: InitRequest = unsafe { request.assume_init() };
        let sent = {
            let _announced = self.page.words().announce();
            filled.send()
        };
        match sent {
            Ok(pending) if pending.number_of_server_connections() > 0 => {
                loan.sent(pending);
                loan.queued.store(true, Ordering::Relaxed);
                Ok(true)
            }
            Ok(pending) => {
                let error = self.not_delivered(&pending);
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
    ) -> Result<ShmLoan, TransportError> {
        let offsets = PieceOffsets::for_lengths(head_room, len, tail_room).ok_or_else(too_large)?;
        let mut state = self.state.lock();
        if self.is_retired() {
            return Err(retired());
        }
        if self.loans.load(Ordering::Acquire) >= self.max_loans {
            return Err(TransportError::new(
                TransportErrorKind::Congested,
                format_args!(
                    "{} loans to this process are already out; send or drop one, or raise max_loans",
                    self.max_loans
                ),
            ));
        }
        let request = self.take(&mut state, offsets.end, MemoryLock::Try)?;
        let request = request.ok_or_else(allocating)?;
        self.loans.fetch_add(1, Ordering::AcqRel);
        let loan = Loan::new(
            request,
            offsets.content,
            len,
            state.segment.number,
            self.clone(),
        );
        Ok(ShmLoan(Arc::new(loan)))
    }

    /// Makes the content of this loan recognizable.
    pub(crate) fn register(&self, loan: &Arc<Loan>) {
        let mut state = self.state.lock();
        state.loans.retain(|(_, loan)| loan.strong_count() > 0);
        state.loans.push((loan.address(), Arc::downgrade(loan)));
    }

    pub(crate) fn owner(&self) -> OwnerMark {
        self.domain.owner()
    }

    pub(crate) fn loan_ended(&self) {
        self.loans.fetch_sub(1, Ordering::AcqRel);
    }

    /// Takes a request with a payload of this length, all of whose pages are allocated. `None` if
    /// memory must be allocated and the lock for that is not available.
    fn take(
        &self,
        state: &mut State,
        len: usize,
        memory: MemoryLock,
    ) -> Result<Option<UninitRequest>, TransportError> {
        let reserve = |need: u64| {
            let lock = match memory {
                MemoryLock::Try => self.budget.try_lock()?,
                MemoryLock::Wait => Some(self.budget.lock()?),
                MemoryLock::Held(lock) => Some(lock),
            };
            self.budget.check(need)?;
            Ok::<_, TransportError>(lock)
        };
        let mut reserve = Some(reserve);
        let segment = &mut state.segment;
        let grows = len > segment.room;
        // Keeps other processes from allocating until the pages are allocated here.
        let mut _lock = None;
        if grows {
            let headers = self.chunks.saturating_mul(FIRST_CHUNK) as u64;
            let need = (len as u64).saturating_add(headers);
            if let Some(reserve) = reserve.take() {
                _lock = reserve(need)?;
            }
            if _lock.is_none() {
                return Ok(None);
            }
        }
        let (request, shortage) = storage::with_shortage(|| self.client.loan_slice_uninit(len));
        let mut request = request.map_err(|error| match shortage {
            Some(shortage) => shortage_error(shortage),
            None => loan_error(error),
        })?;
        let chunk = std::ptr::from_ref(request.header()) as usize;
        let payload = request.payload_mut().as_ptr().cast::<u8>();
        let head = payload as usize - chunk;
        let known = !grows
            && chunk >= segment.base
            && (chunk - segment.base).is_multiple_of(segment.stride)
            && (chunk - segment.base) / segment.stride < self.chunks;
        if !known {
            // Of the segment before.
            state.next = None;
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
                if let Some(reserve) = reserve.take() {
                    _lock = reserve(missing as u64)?;
                }
                if _lock.is_none() {
                    return Ok(None);
                }
            }
            populate(payload.wrapping_add(*ready), missing)?;
            *ready = len;
        }
        Ok(Some(request))
    }

    /// Collects the available answers.
    pub(crate) fn collect(&self, look: AnswerLook, concluded: &mut Concluded) {
        if self.waiting() == 0 {
            return;
        }
        while let Some((attempt, conclusion, released)) = self.concluded(look) {
            concluded.push((attempt, conclusion));
            // Dropped outside of the lock: this may be the last owner of a letter.
            drop(released);
        }
    }

    /// Takes a parcel that is concluded out of the queue. Also returns memory to be released without the
    /// lock.
    fn concluded(
        &self,
        look: AnswerLook,
    ) -> Option<(AttemptId, Conclusion, Option<AnsweredParcel>)> {
        let mut state = self.state.lock();
        let (sent, end) = match state.queue.front()?.end(look) {
            Some(end) => (state.queue.pop_front()?, end),
            // Otherwise the process answers in the order of the queue, or drops parcels unanswered.
            None if self.answers_late => ended_behind_front(&mut state, look)?,
            None => return None,
        };
        self.waiting.decrement();
        if end.in_word {
            count_alone(&self.tally.answered_in_words);
        }
        sent.forget();
        let answered = AnsweredParcel {
            _answer: end.answer,
            memory: sent.memory,
        };
        let released = match &answered.memory {
            SentMemory::Own(pending) if pending.payload().len() <= SHORT => {
                state.answered.replace(answered)
            }
            _ => Some(answered),
        };
        Some((sent.attempt, end.conclusion, released))
    }

    /// Whether an answer is probably available.
    pub(crate) fn has_answer(&self) -> bool {
        if self.waiting() == 0 {
            return false;
        }
        let state = self.state.lock();
        state.queue.front().is_some_and(Sent::has_answer)
            || self.answers_late && state.queue.iter().skip(1).any(Sent::has_answer)
    }

    /// Abandons an attempt. Returns whether the attempt was here.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> bool {
        if self.waiting() == 0 {
            return false;
        }
        let mut state = self.state.lock();
        let place = state.queue.iter().position(|sent| sent.attempt == attempt);
        let sent = place.and_then(|place| state.queue.remove(place));
        if sent.is_some() {
            self.waiting.decrement();
        }
        drop(state);
        sent.inspect(Sent::forget).is_some()
    }
}

/// Removes the first parcel behind the front that is concluded.
#[cold]
fn ended_behind_front(state: &mut State, look: AnswerLook) -> Option<(Sent, End)> {
    let mut queue = state.queue.iter().enumerate().skip(1);
    let (place, end) = queue.find_map(|(place, sent)| Some((place, sent.end(look)?)))?;
    Some((state.queue.remove(place)?, end))
}

/// The conclusion of a parcel with this answer, or with a malformed one.
fn concluded_by(answer: Option<Answer>) -> Conclusion {
    match answer {
        Some(answer) => Conclusion::Answered(answer),
        None => Conclusion::Unconfirmed(TransportError::new(
            TransportErrorKind::Incompatible,
            "the answer is malformed",
        )),
    }
}

/// The end of a parcel.
struct End {
    conclusion: Conclusion,
    /// The memory of the answer.
    answer: Option<Response>,
    /// Whether the answer is in the word of the parcel.
    in_word: bool,
}

impl From<Conclusion> for End {
    fn from(conclusion: Conclusion) -> Self {
        Self {
            conclusion,
            answer: None,
            in_word: false,
        }
    }
}

/// Number of unanswered parcels.
#[derive(Debug)]
struct UnansweredCount {
    of_peer: AtomicUsize,
    of_all: Arc<AtomicUsize>,
}

/// Counts a parcel as unanswered until it is dropped.
struct UnansweredGuard<'a>(&'a UnansweredCount);

impl UnansweredGuard<'_> {
    /// The parcel has been sent: it stays counted until its answer is collected.
    fn keep(self) {
        std::mem::forget(self);
    }
}

impl Drop for UnansweredGuard<'_> {
    fn drop(&mut self) {
        self.0.decrement();
    }
}

impl UnansweredCount {
    fn increment(&self) -> UnansweredGuard<'_> {
        self.of_peer.fetch_add(1, Ordering::AcqRel);
        self.of_all.fetch_add(1, Ordering::AcqRel);
        UnansweredGuard(self)
    }

    fn decrement(&self) {
        self.of_peer.fetch_sub(1, Ordering::AcqRel);
        self.of_all.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Sent {
    fn has_answer(&self) -> bool {
        if self.answer.code().is_some() {
            return true;
        }
        let look = PendingResponse::has_response;
        match &self.memory {
            SentMemory::Own(pending) | SentMemory::Referring { pending, .. } => look(pending),
            SentMemory::Loaned(loan) => loan.with_pending(look).unwrap_or(false),
        }
    }

    /// The end that the word of the parcel states.
    fn end_in_word(&self) -> Option<End> {
        Some(End {
            conclusion: concluded_by(answer_of(self.answer.code()?)),
            answer: None,
            in_word: true,
        })
    }

    fn end(&self, look: AnswerLook) -> Option<End> {
        if let Some(end) = self.end_in_word() {
            return Some(end);
        }
        let look = |pending: &Pending| self.end_of(pending, look);
        match &self.memory {
            SentMemory::Own(pending) | SentMemory::Referring { pending, .. } => look(pending),
            SentMemory::Loaned(loan) => loan.with_pending(look).flatten(),
        }
    }

    fn end_of(&self, pending: &Pending, look: AnswerLook) -> Option<End> {
        // Most parcels with a word are answered there, so responses are looked for less often.
        if look == AnswerLook::Quick && (self.answer.has_word() || !pending.has_response()) {
            return None;
        }
        let ended = look == AnswerLook::Ended;
        let broken = |detail: String| {
            let error = TransportError::new(TransportErrorKind::Broken, detail);
            Some(Conclusion::Unconfirmed(error).into())
        };
        let mut answer = pending.receive();
        let dropped = matches!(answer, Ok(None)) && !pending.is_connected();
        if dropped {
            // The answer may have come in between.
            fence(Ordering::Acquire);
            if let Some(end) = self.end_in_word() {
                return Some(end);
            }
            answer = pending.receive();
        }
        match answer {
            Ok(Some(ack)) => Some(End {
                conclusion: concluded_by(ack.answer(self.answer.token())),
                answer: Some(ack),
                in_word: false,
            }),
            Ok(None) if ended => broken("the other process ended before it answered".into()),
            Ok(None) if dropped => broken("the other process dropped it without an answer".into()),
            Ok(None) => None,
            Err(e) => broken(format!(
                "cannot receive the answer: {}",
                crate::errors::words(&e)
            )),
        }
    }

    fn forget(&self) {
        if let SentMemory::Loaned(loan) = &self.memory {
            loan.queued.store(false, Ordering::Relaxed);
        }
    }
}

/// Length of iceoryx2's header and `Header`, rounded up to the alignment of the payload.
const fn header_len() -> usize {
    use iceoryx2::service::header::request_response::RequestHeader;
    (size_of::<RequestHeader>() + size_of::<Header>()).next_multiple_of(ALIGNMENT)
}

fn offset(start: usize) -> Result<u32, TransportError> {
    u32::try_from(start).map_err(|_| too_large())
}
