//! Memory for contents, allocated by the transport that will carry them.

use bytes::Bytes;
use fipa_transport::{
    Arriving, Incarnation, Kind, LoanedContent, Location, Transport, TransportError,
};

use super::{Mts, Shared};
use crate::core::Submission;

type Loaned = Option<Box<dyn LoanedContent>>;

/// Minimum length in bytes of content that is loaned to an application from a transport. A loan of
/// shared memory takes longer than a copy of shorter content.
const LOAN_FROM: usize = 4096;

impl Mts {
    /// Allocates memory for the content of a letter from this agent to these receivers (names or
    /// patterns), to be filled in place: shared memory if the letter's first route is shared
    /// memory and the content has at least 4 KiB, otherwise heap memory. `head_room` and `tail_room`
    /// are the lengths of the encoded data before and after the content.
    pub fn loan(
        &self,
        sender: Incarnation,
        receivers: &[&str],
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Box<dyn LoanedContent> {
        let on_the_heap = || Box::new(OnTheHeap(vec![0; len]));
        if len < LOAN_FROM {
            return on_the_heap();
        }
        let loaned = match self.route_to_one(receivers) {
            Some(route) => self.shared.loan_from(route.kind(), |transport| {
                transport.loan(&route, head_room, len, tail_room)
            }),
            None => self.loan_for_many(sender, receivers.iter().copied(), len),
        };
        loaned.unwrap_or_else(|| on_the_heap())
    }

    /// Allocates memory for content that several letters will have, to be filled in place: shared memory that all
    /// processes of this host can read if there is some, otherwise heap memory.
    pub fn loan_shared(&self, len: usize) -> Box<dyn LoanedContent> {
        let mut kinds = self.shared.transports.iter().map(|it| it.kind());
        let loaned = kinds.find_map(|kind| {
            self.shared
                .loan_from(kind, |transport| transport.loan_for_many(len))
        });
        loaned.unwrap_or_else(|| Box::new(OnTheHeap(vec![0; len])))
    }

    /// Copies content that several letters will have to memory that all processes of this host can read, if a
    /// transport would otherwise copy it for each letter and there is such memory.
    pub fn shared_content(&self, content: &Bytes) -> Option<Bytes> {
        self.shared.shared_content(content)
    }

    /// Returns the first route of a letter to the only receiver.
    fn route_to_one(&self, receivers: &[&str]) -> Option<Location> {
        let [receiver] = receivers else {
            return None;
        };
        let mut state = self.shared.lock();
        if !state.core.knows(receiver) {
            drop(state);
            self.shared.directory.refresh();
            state = self.shared.lock();
        }
        let now = state.clocks.now();
        state.core.first_way(now, receiver)
    }

    fn loan_for_many<'a>(
        &self,
        sender: Incarnation,
        receivers: impl IntoIterator<Item = &'a str>,
        len: usize,
    ) -> Loaned {
        // Receivers may have been registered just now.
        self.shared.directory.refresh();
        let kind = {
            let mut state = self.shared.lock();
            let now = state.clocks.now();
            state.core.kind_for_many(now, sender, receivers)?
        };
        self.shared
            .loan_from(kind, |transport| transport.loan_for_many(len))
    }

    /// Copies the content of a letter to memory that all its receivers can read, if that saves
    /// copies.
    pub(super) fn content_for_many(&self, submission: &Submission) -> Option<Bytes> {
        let receivers = &submission.receivers;
        let content = &submission.letter.payload().content;
        let many = match &receivers[..] {
            [receiver] => fipa_sds::is_pattern(receiver),
            _ => true,
        };
        let mut transports = self.shared.transports.iter();
        if !many || !transports.any(|transport| transport.copies_for_each(content)) {
            return None;
        }
        let names = receivers.iter().map(|receiver| &**receiver);
        let mut loan = self.loan_for_many(submission.sender, names, content.len())?;
        loan.content_mut().copy_from_slice(content);
        Some(loan.freeze())
    }
}

impl Shared {
    /// Allocates memory for the content of a letter that arrives for another agent of this host,
    /// from the transport that will forward it.
    pub(super) fn memory_for(&self, arriving: &Arriving<'_>) -> Loaned {
        let Arriving {
            receiver,
            stream,
            front,
            len,
            tail,
        } = *arriving;
        let (route, stamp) = {
            let mut state = self.lock();
            let registration = stream.receiver;
            if state.core.misses(registration, receiver) {
                drop(state);
                self.directory.refresh();
                state = self.lock();
            }
            let now = state.clocks.now();
            state.core.first_way_onwards(now, registration, receiver)?
        };
        self.loan_from(route.kind(), |transport| {
            transport.loan(&route, front.saturating_add(stamp), len, tail)
        })
    }

    /// Copies the content of a letter that arrived in other memory to memory of the transport that would
    /// copy it while the core is locked.
    pub(super) fn shared_content(&self, content: &Bytes) -> Option<Bytes> {
        let mut transports = self.transports.iter();
        let transport = transports.find(|transport| transport.copies_for_each(content))?;
        let mut loan = self.loan_from(transport.kind(), |it| it.loan_for_many(content.len()))?;
        loan.content_mut().copy_from_slice(content);
        Some(loan.freeze())
    }

    /// Returns a loan if this transport offers one.
    fn loan_from(
        &self,
        kind: Kind,
        loan: impl FnOnce(&dyn Transport) -> Result<Option<Box<dyn LoanedContent>>, TransportError>,
    ) -> Option<Box<dyn LoanedContent>> {
        match loan(&**self.transport(kind)?) {
            Ok(loaned) => loaned,
            Err(error) => {
                tracing::debug!(%error, %kind, "cannot loan memory of the transport; using the heap");
                None
            }
        }
    }
}

struct OnTheHeap(Vec<u8>);

impl LoanedContent for OnTheHeap {
    fn content_mut(&mut self) -> &mut [u8] {
        &mut self.0
    }

    fn freeze(self: Box<Self>) -> Bytes {
        self.0.into()
    }
}
