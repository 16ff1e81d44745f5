//! The receiving side: the mailbox of this process.

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use bytes::Bytes;
use fipa_transport::wire::ParcelHeader;
use fipa_transport::{
    Answer, Arrival, Body, FailureReason, Hop, Incarnation, Kind, Location, Parcel, Principal,
    Reaction, Sink, Ticket,
};
use iceoryx2::port::{DegradationAction, ReceiveError};
use iceoryx2::prelude::{BackpressureStrategy, Node, PortFactory, ServiceName};
use parking_lot::Mutex;

use crate::ShmConfig;
use crate::answer_words::WordPlace;
use crate::answered::Answered;
use crate::borrowed::{
    BorrowLimits, BorrowedContent, BorrowedSegmentContent, HeldRequest, RequestOwner,
};
use crate::counters::{Tally, count, count_alone};
use crate::deferred::{AnswerWay, LateAnswers, UnansweredParcel};
use crate::layout::{ANSWERS, Ack, Active, Header, MailServer, PieceOffsets, Svc, UninitAck};
use crate::memory::MappedPtr;
use crate::peer_segments::{PeerSegments, ReadError};
use crate::presence::{Presence, StatusPage};
use crate::segment::ContentReference;
use crate::storage;
use crate::wakeup::Account;

/// Maximum number of parcels that are taken before other work gets a turn.
const BATCH: usize = 64;

const _: () = assert!(ANSWERS <= storage::MAX_CHUNKS);

/// Name of a mailbox of a process. Each mailbox has a name of its own: with the last reference to a
/// mailbox, iceoryx2 removes the files of its name, and peers and content may hold a reference
/// after the process has made the next mailbox.
pub(crate) fn mailbox_name(of: Incarnation, generation: u64) -> String {
    match generation {
        0 => format!("fipa/mail/{of}"),
        _ => format!("fipa/mail/{of}/{generation}"),
    }
}

/// Location of the mailbox of a process.
pub(crate) fn location_of(of: Incarnation) -> Location {
    let address = of.to_string();
    match Location::new(Kind::Shm, &address) {
        Ok(location) => location.with_incarnation(of),
        Err(_) => unreachable!("16 hexadecimal digits are an address"),
    }
}

/// Finds the status page of a process that is open.
type PageOf<'a> = &'a dyn Fn(Incarnation) -> Option<Arc<StatusPage>>;

/// The server of this process's mailbox. Used by one thread at a time.
pub(crate) struct Inbox {
    server: MailServer,
    service_hash: String,
    borrows: Arc<BorrowLimits>,
    /// Parcels that are answered later; `None` if all are answered at once.
    deferred: Option<Arc<LateAnswers>>,
    page: Arc<StatusPage>,
    account: Account,
    tally: Arc<Tally>,
    max_letter: usize,
    copy_below: usize,
    tickets: u64,
    answers_ready: bool,
    last_sender: Option<Location>,
}

impl Inbox {
    /// Name of the mailbox's service in the files of the domain.
    pub(crate) fn service_hash(&self) -> &str {
        &self.service_hash
    }

    /// Creates the mailbox. The caller holds the lock of the domain, so no peer reads the status
    /// page before the mailbox exists.
    pub(crate) fn create(
        config: &ShmConfig,
        generation: u64,
        node: &Node<Svc>,
        presence: &Presence,
        tally: Arc<Tally>,
        (peer_segments, deferred): (Arc<PeerSegments>, Arc<LateAnswers>),
    ) -> Result<Self, String> {
        let name =
            ServiceName::new(&mailbox_name(config.incarnation, generation)).map_err(debug)?;
        let service = node
            .service_builder(&name)
            .request_response::<[u8], Ack>()
            .request_user_header::<Header>()
            .max_servers(1)
            .max_clients(config.max_clients)
            .max_nodes(config.max_clients + 1)
            .max_active_requests_per_client(config.places())
            .max_loaned_requests(config.max_loans + 1)
            .max_response_buffer_size(1)
            .max_borrowed_responses_per_pending_response(1)
            // A full mailbox refuses a parcel and does not overwrite another one.
            .enable_safe_overflow_for_requests(false)
            // A new answer may overwrite one that its sender has not received.
            .enable_safe_overflow_for_responses(true)
            // An abandoned parcel is not delivered.
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
        presence.page().words().set_generation(generation);
        if config.answers_late {
            presence.page().words().answer_late();
        }
        Ok(Self {
            server,
            deferred: config.answers_late.then_some(deferred),
            service_hash: service.service_hash().as_str().to_owned(),
            borrows: BorrowLimits::create(config, presence, tally.clone(), peer_segments),
            page: Arc::clone(presence.page()),
            account: Account::default(),
            tally,
            max_letter: config.max_letter,
            copy_below: config.copy_below,
            tickets: 0,
            answers_ready: false,
            last_sender: None,
        })
    }

    /// Takes the parcels in the mailbox and answers them. Returns whether there was any, and adds
    /// their senders to `answered`. Looks for parcels that were announced, and with `unannounced`
    /// at least once.
    pub(crate) fn drain(
        &mut self,
        sink: &dyn Sink,
        answered: &Answered,
        page_of: PageOf<'_>,
        unannounced: bool,
    ) -> bool {
        for done in 0..BATCH {
            let is_forced = unannounced && done == 0;
            if !is_forced && !self.account.is_open(self.page.words()) {
                self.page.words().count_poll();
                return done > 0;
            }
            match self.receive() {
                Ok(Some(active)) => {
                    if let Some(sender) = self.take(active, sink, page_of) {
                        answered.add(sender);
                    }
                }
                Ok(None) => {
                    self.page.words().count_poll();
                    return done > 0;
                }
                Err(ReceiveError::ExceedsMaxBorrows) => {
                    // Cannot happen while iceoryx2 counts as `BorrowLimits` does. No parcel is
                    // lost: the next release of content rings the doorbell.
                    self.borrows.waiting.store(true, Ordering::SeqCst);
                    return done > 0;
                }
                Err(ReceiveError::ConnectionFailure(_)) => {
                    count(&self.tally.refused);
                    return done > 0;
                }
            }
        }
        // There may be more; other work gets a turn first.
        self.borrows.doorbell.ring();
        true
    }

    /// Receives a request, or finds that the mailbox is empty.
    fn receive(&mut self) -> Result<Option<Active>, ReceiveError> {
        let Self {
            account,
            page,
            server,
            ..
        } = self;
        account.take(page.words(), || server.receive())
    }

    /// Whether the mailbox probably contains a parcel: one that was announced, or with
    /// `unannounced` any.
    pub(crate) fn has_parcels(&self, unannounced: bool) -> bool {
        (unannounced || self.account.must_look(self.page.words()))
            && self.server.has_requests().unwrap_or(false)
    }

    // Apart from the poll, which mostly finds nothing.
    #[inline(never)]
    fn take(
        &mut self,
        active: Active,
        sink: &dyn Sink,
        page_of: PageOf<'_>,
    ) -> Option<Incarnation> {
        count_alone(&self.tally.arrived);
        // A copy in private memory: the sender could still change the original.
        let header: Header = *active.user_header();
        let sender = header.sender();
        // Found before the parcel is handed over: a parcel that cannot be answered must not be
        // accepted. If it is dropped here, iceoryx2 reports that to the sender.
        let Some(way) = self.answer_way(&header, &active, page_of) else {
            count(&self.tally.refused);
            return Some(sender);
        };
        let (parcel, owner) = self.read(&header, active);
        let parcel = match parcel {
            Ok(parcel) => parcel,
            Err(refusal) => {
                count(&self.tally.refused);
                let unanswered = UnansweredParcel::new(way, header.token(), sender, owner);
                self.answer(unanswered, &refusal);
                return sender.is_known().then_some(sender);
            }
        };
        let mut unanswered = Some(UnansweredParcel::new(way, header.token(), sender, owner));
        let ticket = self.defer(&parcel, &mut unanswered);
        let arrival = Arrival {
            parcel,
            from: Hop {
                location: self.location_of_sender(sender),
                principal: Principal::Host,
            },
            ticket,
        };
        let reaction = sink.arrived(arrival);
        if let Some(deferred) = &self.deferred
            && let Some(ticket) = ticket
        {
            match reaction {
                Reaction::Now(_) => unanswered = deferred.take(ticket),
                Reaction::Later => {
                    count(&self.tally.deferred);
                    return None;
                }
            }
        }
        let answer = match reaction {
            Reaction::Now(answer) => answer,
            Reaction::Later => Answer::failed(
                FailureReason::Refused,
                "the receiver deferred the answer to a parcel that must be answered at once",
            ),
        };
        if let Some(unanswered) = unanswered {
            self.answer(unanswered, &answer);
        }
        Some(sender)
    }

    /// Finds a way to answer a parcel: a word, if the status page of the sender is open and the
    /// answer is not deferred. `None` if there is no memory for a response.
    fn answer_way(
        &mut self,
        header: &Header,
        active: &Active,
        page_of: PageOf<'_>,
    ) -> Option<AnswerWay> {
        let place = header.word();
        if self.deferred.is_none()
            && place != WordPlace::NONE
            && let Some(page) = page_of(header.sender())
            && page.answers().has(place)
        {
            return Some(AnswerWay::Word(page, place));
        }
        let response = active.loan_uninit().ok()?;
        self.prepare_answers(&response)
            .then_some(AnswerWay::Response(response))
    }

    fn answer(&mut self, mut parcel: UnansweredParcel, answer: &Answer) {
        if parcel.lacks_response(answer) {
            let response = parcel.owner().loan_response();
            let Some(response) = response.filter(|it| self.prepare_answers(it)) else {
                // The parcel was not accepted. iceoryx2 reports to its sender that it is dropped.
                count(&self.tally.refused);
                return;
            };
            parcel.set_response(response);
        }
        parcel.send(answer);
    }

    /// Takes a letter that may be answered later to the deferred ones, before the sink has it: the
    /// answer may be given while the sink is called. Returns its ticket.
    fn defer(
        &mut self,
        parcel: &Parcel,
        unanswered: &mut Option<UnansweredParcel>,
    ) -> Option<Ticket> {
        let deferred = self.deferred.as_ref()?;
        let is_letter = matches!(parcel.body, Body::Letter(_));
        if !is_letter || !unanswered.as_mut()?.hold(&self.borrows) {
            return None;
        }
        self.tickets += 1;
        let ticket = Ticket(self.tickets);
        deferred.insert(ticket, unanswered.take()?);
        Some(ticket)
    }

    /// Location of a sender. Cached, because consecutive parcels mostly have the same sender.
    fn location_of_sender(&mut self, sender: Incarnation) -> Location {
        match &self.last_sender {
            Some(location) if location.incarnation() == sender => location.clone(),
            _ => self.last_sender.insert(location_of(sender)).clone(),
        }
    }

    /// Allocates the pages of all answers at the first one, whose own page is allocated already.
    fn prepare_answers(&mut self, first: &UninitAck) -> bool {
        if !self.answers_ready {
            let chunk = std::ptr::from_ref(first.header()) as usize;
            self.answers_ready = storage::allocate_all(chunk).is_ok();
        }
        self.answers_ready
    }

    /// Reads the parcel or refuses it. Also returns the owner of the memory that holds its content.
    fn read(&self, header: &Header, active: Active) -> (Result<Parcel, Answer>, RequestOwner) {
        let refused = |active, reason, detail: &str| {
            let refusal = Answer::failed(reason, detail);
            (Err(refusal), RequestOwner::Unshared(active))
        };
        let Some(parcel) = header.parcel() else {
            return refused(active, FailureReason::Refused, "malformed header");
        };
        let payload = active.payload();
        let Some(offsets) = PieceOffsets::announced(header, &parcel, payload.len()) else {
            let detail = "the lengths in the header contradict each other";
            return refused(active, FailureReason::Refused, detail);
        };
        let most = self.max_letter.saturating_add(Parcel::MAX_NAME) as u64;
        if parcel.body_len() > most {
            let detail = format!("max_letter of the receiver is {} bytes", self.max_letter);
            return refused(active, FailureReason::TooLarge, &detail);
        }
        if let Some(reference) = header.reference() {
            let around = &payload[offsets.start..offsets.end];
            let mut front = Bytes::copy_from_slice(around);
            let tail = front.split_off(offsets.content - offsets.start);
            let content = match self.segment_content(header.sender(), reference, &parcel) {
                Ok(content) => content,
                Err(answer) => return (Err(answer), RequestOwner::Unshared(active)),
            };
            let parcel = parcel.parcel_of_pieces(front, content, tail);
            let parcel = parcel.map_err(|e| Answer::failed(FailureReason::Refused, e.to_string()));
            return (parcel, RequestOwner::Unshared(active));
        }
        let content = &payload[offsets.content..offsets.tail];
        let (parcel, owner) = if self.try_begin_borrow(content, &active) {
            // Front and tail, copied into one allocation.
            let around = [
                &payload[offsets.start..offsets.content],
                &payload[offsets.tail..offsets.end],
            ];
            let mut front = Bytes::from(around.concat());
            let tail = front.split_off(offsets.content - offsets.start);
            let bytes = MappedPtr(NonNull::from(content));
            let address = content.as_ptr().addr();
            let request = self.hold(active, address);
            let content = Bytes::from_owner(BorrowedContent {
                bytes,
                _request: Arc::clone(&request),
            });
            let parcel = parcel.parcel_of_pieces(front, content, tail);
            (parcel, RequestOwner::Content(request))
        } else {
            let body = Bytes::copy_from_slice(&payload[offsets.start..offsets.end]);
            (parcel.parcel(body), RequestOwner::Unshared(active))
        };
        let parcel = parcel.map_err(|e| Answer::failed(FailureReason::Refused, e.to_string()));
        (parcel, owner)
    }

    /// Content in a segment of its sender: in place, or copied if too much is held in place.
    fn segment_content(
        &self,
        sender: Incarnation,
        reference: ContentReference,
        parcel: &ParcelHeader,
    ) -> Result<Bytes, Answer> {
        let len = usize::try_from(parcel.content_len()).unwrap_or(usize::MAX);
        let peer_segments = &self.borrows.peer_segments;
        let content = peer_segments
            .read(sender, reference, len)
            .map_err(|e| match e {
                ReadError::Gone => {
                    let detail = "the content of the letter no longer exists";
                    Answer::failed(FailureReason::Refused, detail)
                }
                ReadError::NoRoom => Answer::Busy,
            })?;
        if !self.borrows.begin_segment(content.as_ref()) {
            return Ok(Bytes::copy_from_slice(content.as_ref()));
        }
        count_alone(&self.tally.in_place);
        Ok(Bytes::from_owner(BorrowedSegmentContent {
            content,
            borrows: self.borrows.clone(),
        }))
    }

    /// Whether content is handed out in place. If so, it is counted as held.
    fn try_begin_borrow(&self, content: &[u8], active: &Active) -> bool {
        if content.len() >= self.copy_below && !content.is_empty() {
            return self.borrows.begin(active.origin().value(), content);
        }
        if !content.is_empty() {
            count_alone(&self.tally.copied_small);
        }
        false
    }

    /// Holds a request whose content is handed out in place. [`Self::try_begin_borrow`] must have
    /// returned true for it.
    fn hold(&self, active: Active, content: usize) -> Arc<HeldRequest> {
        count_alone(&self.tally.in_place);
        Arc::new(HeldRequest {
            sender: active.origin().value(),
            content,
            active: Mutex::new(Some(active)),
            borrows: self.borrows.clone(),
        })
    }
}

fn debug(error: impl std::fmt::Debug) -> String {
    crate::errors::words(&error)
}
