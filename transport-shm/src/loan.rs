//! Memory for content that is handed out before its letter is sent.

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use fipa_transport::LoanedContent;
use parking_lot::Mutex;

use crate::layout::{Blank, Pending};
use crate::memory::Address;
use crate::outbox::Outbox;

/// One loan: a request of which the content's place has been handed out.
///
/// Lives as long as anybody can read the content, whether it has been sent or not: the request,
/// or after sending the pending response, owns the memory.
#[derive(Debug)]
pub(crate) struct Loan {
    /// The payload: `front` bytes for what stands in front, then the content, then the rest.
    ///
    /// Through it, the content is written only by `ShmLoan`, of which there is one, before it is
    /// shared, and only read afterwards; front and tail are written only by whoever takes the
    /// blank request out of the state, of whom there is one.
    payload: Address<u8>,
    front: usize,
    content: usize,
    payload_len: usize,
    /// Which memory segment of the outbox this lies in.
    pub(crate) segment: u64,
    /// Whether the pending response waits in the outbox.
    pub(crate) queued: AtomicBool,
    state: Mutex<State>,
    // After the state: gives the place among the loans back when the memory is back.
    outbox: Place,
}

#[derive(Debug)]
enum State {
    Blank(Blank),
    Sent(Pending),
    /// The request could not be sent and iceoryx2 took the memory back; see [`Outbox`].
    Lost,
}

impl Loan {
    /// The payload of `blank` must be at least `front + content` bytes long.
    pub(crate) fn new(
        mut blank: Blank,
        front: usize,
        content: usize,
        segment: u64,
        outbox: Arc<Outbox>,
    ) -> Self {
        let payload = blank.payload_mut();
        let payload_len = payload.len();
        assert!(
            front + content <= payload_len,
            "a loan as long as it was asked for"
        );
        Self {
            payload: Address(NonNull::from(payload).cast()),
            front,
            content,
            payload_len,
            segment,
            queued: AtomicBool::new(false),
            state: Mutex::new(State::Blank(blank)),
            outbox: Place(outbox),
        }
    }

    /// Where the content begins: what it is recognised by.
    pub(crate) fn address(&self) -> usize {
        self.content_start() as usize
    }

    fn content_start(&self) -> *mut u8 {
        self.payload.0.as_ptr().wrapping_add(self.front)
    }

    /// Whether `content` is all of this loan's content.
    pub(crate) fn is(&self, content: &Bytes) -> bool {
        content.as_ptr() as usize == self.address() && content.len() == self.content
    }

    /// Whether pieces of these lengths have room around the content.
    pub(crate) fn has_room(&self, front: usize, tail: usize) -> bool {
        front <= self.front && tail <= self.payload_len - self.front - self.content
    }

    /// How much may be written from where the payload begins.
    pub(crate) fn payload_len(&self) -> usize {
        self.payload_len
    }

    pub(crate) fn front(&self) -> usize {
        self.front
    }

    pub(crate) fn payload(&self) -> NonNull<u8> {
        self.payload.0
    }

    /// Takes the request to be sent, once.
    pub(crate) fn take(&self) -> Option<Blank> {
        let mut state = self.state.lock();
        match std::mem::replace(&mut *state, State::Lost) {
            State::Blank(blank) => Some(blank),
            other => {
                *state = other;
                None
            }
        }
    }

    /// Keeps the memory alive after sending.
    pub(crate) fn sent(&self, pending: Pending) {
        *self.state.lock() = State::Sent(pending);
    }

    /// Looks at the pending response.
    pub(crate) fn with_pending<T>(&self, look: impl FnOnce(&Pending) -> T) -> Option<T> {
        match &*self.state.lock() {
            State::Sent(pending) => Some(look(pending)),
            _ => None,
        }
    }

    /// Whether it counts among the outbox's active requests without waiting there.
    pub(crate) fn is_kept_after_sending(&self) -> bool {
        !self.queued.load(Ordering::Relaxed) && matches!(&*self.state.lock(), State::Sent(_))
    }

    pub(crate) fn outbox(&self) -> &Arc<Outbox> {
        &self.outbox.0
    }
}

#[derive(Debug)]
struct Place(Arc<Outbox>);

impl Drop for Loan {
    fn drop(&mut self) {
        if !self.outbox.0.owner().is_this() {
            // In a forked child: the request stays the parent's, and so does the outbox.
            std::mem::forget(std::mem::replace(self.state.get_mut(), State::Lost));
            std::mem::forget(Arc::clone(&self.outbox.0));
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.loan_ended();
    }
}

/// What the application fills in.
pub(crate) struct ShmLoan(pub(crate) Arc<Loan>);

impl LoanedContent for ShmLoan {
    fn content_mut(&mut self) -> &mut [u8] {
        let loan = &*self.0;
        // SAFETY: the range lies within the payload (checked by `Loan::new`), which the blank
        // request owns until it is sent, and it cannot be sent before `freeze`: only then can
        // anybody present the content. Nothing else refers to the range: this is the only
        // `ShmLoan` of the loan, borrowed mutably. The bytes are initialised as far as Rust is
        // concerned: pages of a shared mapping that the kernel has filled.
        unsafe { std::slice::from_raw_parts_mut(loan.content_start(), loan.content) }
    }

    fn freeze(self: Box<Self>) -> Bytes {
        self.0.outbox().register(&self.0);
        Bytes::from_owner(Frozen(self.0))
    }
}

/// The content, readable.
struct Frozen(Arc<Loan>);

impl AsRef<[u8]> for Frozen {
    fn as_ref(&self) -> &[u8] {
        let loan = &*self.0;
        // SAFETY: within the payload, as above. The memory is owned by the request or the pending
        // response in the loan, which this keeps alive; when sending fails so that iceoryx2 takes
        // it back, the outbox makes sure that it stays mapped and unchanged as long as the loan
        // lives (see `Outbox::send_loan`). No process writes there: `ShmLoan` is consumed, and
        // receivers map it for reading.
        unsafe { std::slice::from_raw_parts(loan.content_start(), loan.content) }
    }
}
