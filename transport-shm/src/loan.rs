//! Memory for content that is handed out before its letter is sent.

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use fipa_transport::LoanedContent;
use parking_lot::Mutex;

use crate::layout::{Pending, UninitRequest};
use crate::memory::MappedPtr;
use crate::outbox::Outbox;

/// A request whose content range has been handed out.
///
/// Exists as long as the content can be read, before and after sending: first the request, then the
/// pending response owns the memory.
#[derive(Debug)]
pub(crate) struct Loan {
    /// The payload: `front` bytes for the pieces before the content, the content, then the rest.
    ///
    /// The content is written through this pointer only by the single `ShmLoan`, before it is
    /// shared, and only read afterwards. Front and tail are written only by the caller that takes
    /// the request out of the state, which succeeds once.
    payload: MappedPtr<u8>,
    front: usize,
    content: usize,
    payload_len: usize,
    /// Number of the outbox's memory segment that contains the payload.
    pub(crate) segment: u64,
    /// Whether the pending response is queued in the outbox.
    pub(crate) queued: AtomicBool,
    state: Mutex<State>,
    // After the state: the loan is counted as ended when its memory has been returned.
    outbox: LoanSlot,
}

#[derive(Debug)]
enum State {
    Unsent(UninitRequest),
    Sent(Pending),
    /// Sending failed and iceoryx2 took the memory back; see [`Outbox`].
    Lost,
}

impl Loan {
    /// Creates a loan. The payload of `request` must have at least `front + content` bytes.
    pub(crate) fn new(
        mut request: UninitRequest,
        front: usize,
        content: usize,
        segment: u64,
        outbox: Arc<Outbox>,
    ) -> Self {
        let payload = request.payload_mut();
        let payload_len = payload.len();
        assert!(
            front + content <= payload_len,
            "a loan has the requested length"
        );
        Self {
            payload: MappedPtr(NonNull::from(payload).cast()),
            front,
            content,
            payload_len,
            segment,
            queued: AtomicBool::new(false),
            state: Mutex::new(State::Unsent(request)),
            outbox: LoanSlot(outbox),
        }
    }

    /// Address of the content, by which the content is recognized.
    pub(crate) fn address(&self) -> usize {
        self.content_start() as usize
    }

    fn content_start(&self) -> *mut u8 {
        self.payload.0.as_ptr().wrapping_add(self.front)
    }

    /// Whether `content` is the whole content of this loan.
    pub(crate) fn is(&self, content: &Bytes) -> bool {
        content.as_ptr() as usize == self.address() && content.len() == self.content
    }

    /// Whether pieces of these lengths fit around the content.
    pub(crate) fn has_room(&self, front: usize, tail: usize) -> bool {
        front <= self.front && tail <= self.payload_len - self.front - self.content
    }

    /// Length of the payload in bytes.
    pub(crate) fn payload_len(&self) -> usize {
        self.payload_len
    }

    pub(crate) fn front(&self) -> usize {
        self.front
    }

    pub(crate) fn payload(&self) -> NonNull<u8> {
        self.payload.0
    }

    /// Takes the request for sending. `None` after the first call.
    pub(crate) fn take(&self) -> Option<UninitRequest> {
        let mut state = self.state.lock();
        match std::mem::replace(&mut *state, State::Lost) {
            State::Unsent(request) => Some(request),
            other => {
                *state = other;
                None
            }
        }
    }

    /// Stores the pending response, which owns the memory after sending.
    pub(crate) fn sent(&self, pending: Pending) {
        *self.state.lock() = State::Sent(pending);
    }

    /// Calls `look` with the pending response, if the request has been sent.
    pub(crate) fn with_pending<T>(&self, look: impl FnOnce(&Pending) -> T) -> Option<T> {
        match &*self.state.lock() {
            State::Sent(pending) => Some(look(pending)),
            _ => None,
        }
    }

    /// Whether the request counts as active in the outbox without being queued there.
    pub(crate) fn is_kept_after_sending(&self) -> bool {
        !self.queued.load(Ordering::Relaxed) && matches!(&*self.state.lock(), State::Sent(_))
    }

    pub(crate) fn outbox(&self) -> &Arc<Outbox> {
        &self.outbox.0
    }
}

#[derive(Debug)]
struct LoanSlot(Arc<Outbox>);

impl Drop for Loan {
    fn drop(&mut self) {
        if !self.outbox.0.owner().is_this() {
            // In a forked child, the request and the outbox belong to the parent.
            std::mem::forget(std::mem::replace(self.state.get_mut(), State::Lost));
            std::mem::forget(Arc::clone(&self.outbox.0));
        }
    }
}

impl Drop for LoanSlot {
    fn drop(&mut self) {
        self.0.loan_ended();
    }
}

/// The writable content.
pub(crate) struct ShmLoan(pub(crate) Arc<Loan>);

impl LoanedContent for ShmLoan {
    fn content_mut(&mut self) -> &mut [u8] {
        let loan = &*self.0;
        // SAFETY: the range is within the payload (checked by `Loan::new`). The unsent request owns
        // the payload, and it is not sent before `freeze`, which registers the content with the
        // outbox. Nothing else refers to the range: this is the only `ShmLoan` of the loan,
        // borrowed mutably. The bytes are initialized: pages of a shared mapping that the kernel or
        // an earlier request has filled.
        unsafe { std::slice::from_raw_parts_mut(loan.content_start(), loan.content) }
    }

    fn freeze(self: Box<Self>) -> Bytes {
        self.0.outbox().register(&self.0);
        Bytes::from_owner(Frozen(self.0))
    }
}

/// The readable content.
struct Frozen(Arc<Loan>);

impl AsRef<[u8]> for Frozen {
    fn as_ref(&self) -> &[u8] {
        let loan = &*self.0;
        // SAFETY: the range is within the payload (checked by `Loan::new`). The request or the
        // pending response in the loan owns the memory, and `self.0` keeps the loan. If sending
        // fails and iceoryx2 takes the memory back, the outbox keeps it mapped and unchanged as
        // long as the loan exists (see `Outbox::send_loan`). No process writes there: `ShmLoan` is
        // consumed, `Outbox::send_loan` leaves the content out, and receivers only read it.
        unsafe { std::slice::from_raw_parts(loan.content_start(), loan.content) }
    }
}
