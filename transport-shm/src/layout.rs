//! Layout of shared memory: the header of a request, the answer, and the types of the ports.

use std::mem::MaybeUninit;

use fipa_transport::wire::{self, HEADER_LEN, MAX_ANSWER_LEN, ParcelHeader};
use fipa_transport::{Answer, Incarnation};
use iceoryx2::active_request::ActiveRequest;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::request_mut::RequestMut;
use iceoryx2::request_mut_uninit::RequestMutUninit;
use iceoryx2::response::Response as IceoryxResponse;
use iceoryx2::response_mut_uninit::ResponseMutUninit;
use zerocopy::{FromBytes, IntoBytes};

use crate::answer_words::WordPlace;
use crate::segment::ContentReference;
pub(crate) use crate::variant::Svc;

pub(crate) type MailClient = Client<Svc, [u8], Header, Ack, ()>;
pub(crate) type MailServer = Server<Svc, [u8], Header, Ack, ()>;
pub(crate) type UninitRequest = RequestMutUninit<Svc, [MaybeUninit<u8>], Header, Ack, ()>;
pub(crate) type InitRequest = RequestMut<Svc, [u8], Header, Ack, ()>;
pub(crate) type Pending = PendingResponse<Svc, [u8], Header, Ack, ()>;
pub(crate) type Active = ActiveRequest<Svc, [u8], Header, Ack, ()>;
pub(crate) type Response = IceoryxResponse<Svc, Ack, ()>;
pub(crate) type UninitAck = ResponseMutUninit<Svc, MaybeUninit<Ack>, ()>;

/// Alignment of contents in bytes.
pub(crate) const ALIGNMENT: usize = 8;

/// Maximum number of answers under way to all senders together.
pub(crate) const ANSWERS: usize = 1024;

/// Version of this layout and of the status page, in each parcel. A change of a type also changes its name, by which
/// iceoryx2 refuses it.
const VERSION: u32 = 6;

/// The user header of every request.
///
/// The payload that follows has `start` unused bytes, so that the content is aligned, then the
/// parcel's body. The body omits the content if that is in a segment.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("fipa-mail-header-5")]
pub(crate) struct Header {
    version: u32,
    start: u32,
    sender: u64,
    token: u64,
    /// Number of the sender's status page; 0 if the parcel has no word there.
    page: u64,
    /// Index of the word for the answer.
    word: u32,
    reserved: u32,
    /// Number of the segment that holds the content; 0 if the content is in the payload.
    segment: u64,
    generation: u64,
    parcel: [u8; HEADER_LEN],
}

impl Default for Header {
    fn default() -> Self {
        Self {
            version: 0,
            start: 0,
            sender: 0,
            token: 0,
            page: 0,
            word: 0,
            reserved: 0,
            segment: 0,
            generation: 0,
            parcel: [0; HEADER_LEN],
        }
    }
}

impl Header {
    /// Creates a header for content in the payload. The answer repeats the token, and may go into the word.
    pub(crate) fn new(
        parcel: &ParcelHeader,
        start: u32,
        sender: Incarnation,
        token: u64,
        WordPlace { page, word }: WordPlace,
    ) -> Self {
        let mut bytes = [0; HEADER_LEN];
        bytes.copy_from_slice(parcel.as_bytes());
        Self {
            version: VERSION,
            start,
            sender: sender.as_u64(),
            token,
            page,
            word,
            reserved: 0,
            segment: 0,
            generation: 0,
            parcel: bytes,
        }
    }

    /// Adds a reference to content in a segment, if there is one.
    pub(crate) fn referring(self, to: Option<ContentReference>) -> Self {
        match to {
            Some(to) => Self {
                segment: to.segment,
                generation: to.generation,
                ..self
            },
            None => self,
        }
    }

    /// The reference to the content, if it is in a segment.
    pub(crate) fn reference(&self) -> Option<ContentReference> {
        (self.segment != 0).then_some(ContentReference {
            segment: self.segment,
            generation: self.generation,
        })
    }

    pub(crate) fn sender(&self) -> Incarnation {
        Incarnation::from_u64(self.sender)
    }

    pub(crate) fn token(&self) -> u64 {
        self.token
    }

    /// The word for the answer.
    pub(crate) fn word(&self) -> WordPlace {
        WordPlace {
            page: self.page,
            word: self.word,
        }
    }

    fn start(&self) -> usize {
        self.start as usize
    }

    /// The parcel's header. `None` if the version or the sender is invalid.
    pub(crate) fn parcel(&self) -> Option<ParcelHeader> {
        if self.version != VERSION || !self.sender().is_known() {
            return None;
        }
        ParcelHeader::read_from_bytes(&self.parcel).ok()
    }
}

/// The answer to a parcel.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("fipa-mail-ack-4")]
pub(crate) struct Ack {
    token: u64,
    len: u8,
    bytes: [u8; MAX_ANSWER_LEN],
    reserved: [u8; 5],
}

impl Ack {
    /// Encodes the answer to the parcel with this token.
    pub(crate) fn new(answer: &Answer, token: u64) -> Self {
        let mut ack = Self {
            token,
            len: wire::answer_len(answer) as u8,
            bytes: [0; MAX_ANSWER_LEN],
            reserved: [0; 5],
        };
        wire::write_answer(answer, &mut ack.bytes.as_mut_slice());
        ack
    }

    /// Decodes the answer. `None` if it is malformed or for another token.
    pub(crate) fn answer(&self, token: u64) -> Option<Answer> {
        if self.token != token {
            return None;
        }
        wire::read_answer(self.bytes.get(..usize::from(self.len))?)
    }
}

/// The code in a word for an answer without data: one more than its only byte, since 0 is no answer.
pub(crate) fn code_of(answer: &Answer) -> Option<u8> {
    let mut code = [0];
    if wire::answer_len(answer) > code.len() {
        return None;
    }
    wire::write_answer(answer, &mut code.as_mut_slice());
    code[0].checked_add(1)
}

/// The answer without data that has this code in a word.
pub(crate) fn answer_of(code: u8) -> Option<Answer> {
    wire::read_answer(&[code.checked_sub(1)?])
}

/// Offsets of the pieces of a body in a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PieceOffsets {
    pub(crate) start: usize,
    pub(crate) content: usize,
    pub(crate) tail: usize,
    pub(crate) end: usize,
}

impl PieceOffsets {
    /// Offsets for pieces of these lengths, with the content aligned. `None` if their sum
    /// overflows.
    pub(crate) fn for_lengths(front: usize, content: usize, tail: usize) -> Option<Self> {
        let at = front.checked_next_multiple_of(ALIGNMENT)?;
        let tail_at = at.checked_add(content)?;
        Some(Self {
            start: at - front,
            content: at,
            tail: tail_at,
            end: tail_at.checked_add(tail)?,
        })
    }

    /// Offsets according to a received header. `None` if they exceed a payload of this length.
    pub(crate) fn announced(
        header: &Header,
        parcel: &ParcelHeader,
        payload: usize,
    ) -> Option<Self> {
        let start = header.start();
        let front = usize::try_from(parcel.front_len()).ok()?;
        let content_len = usize::try_from(parcel.content_len()).ok()?;
        let body = usize::try_from(parcel.body_len()).ok()?;
        let elsewhere = match header.reference() {
            Some(_) => content_len,
            None => 0,
        };
        let content = start.checked_add(front)?;
        let tail = content.checked_add(content_len - elsewhere)?;
        let end = start.checked_add(body.checked_sub(elsewhere)?)?;
        (tail <= end && end <= payload).then_some(Self {
            start,
            content,
            tail,
            end,
        })
    }
}

/// Readers of data that another process writes into shared memory, for fuzz targets.
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing {
    use bytes::Bytes;

    use super::*;

    /// Bytes of a request's header before the parcel's.
    const OWN: usize = 56;
    /// Bytes of a request's header, as [`header`] takes them.
    pub const HEADER_LEN: usize = OWN + super::HEADER_LEN;
    /// The version of the layout that [`header`] reads.
    pub const VERSION: u32 = super::VERSION;

    /// Reads the header of a request with this payload, whose content lies in `elsewhere` if the header
    /// says so. Returns whether it is a parcel.
    ///
    /// # Panics
    /// If the announced offsets are outside of the payload.
    pub fn header(bytes: &[u8; HEADER_LEN], payload: &[u8], elsewhere: &[u8]) -> bool {
        let number = |at: usize| {
            let mut number = [0; 8];
            number.copy_from_slice(&bytes[at..at + 8]);
            u64::from_le_bytes(number)
        };
        let mut parcel = [0; super::HEADER_LEN];
        parcel.copy_from_slice(&bytes[OWN..]);
        let header = Header {
            version: number(0) as u32,
            start: (number(0) >> 32) as u32,
            sender: number(8),
            token: number(16),
            page: number(24),
            word: number(32) as u32,
            reserved: 0,
            segment: number(40),
            generation: number(48),
            parcel,
        };
        let Some(parcel) = header.parcel() else {
            return false;
        };
        let Some(offsets) = PieceOffsets::announced(&header, &parcel, payload.len()) else {
            return false;
        };
        // As the mailbox takes them apart.
        let around = &payload[offsets.start..offsets.end];
        let read = if header.reference().is_some() {
            let mut front = Bytes::copy_from_slice(around);
            let tail = front.split_off(offsets.content - offsets.start);
            let len = usize::try_from(parcel.content_len()).unwrap_or(usize::MAX);
            let Some(content) = elsewhere.get(..len) else {
                return false;
            };
            parcel.parcel_of_pieces(front, Bytes::copy_from_slice(content), tail)
        } else {
            let pieces = [
                &payload[offsets.start..offsets.content],
                &payload[offsets.tail..offsets.end],
            ];
            let content = Bytes::copy_from_slice(&payload[offsets.content..offsets.tail]);
            let mut front = Bytes::from(pieces.concat());
            let tail = front.split_off(offsets.content - offsets.start);
            let apart = parcel.parcel_of_pieces(front, content, tail);
            let whole = parcel.parcel(Bytes::copy_from_slice(around));
            assert_eq!(apart.is_ok(), whole.is_ok(), "{apart:?} or {whole:?}");
            apart
        };
        read.is_ok()
    }

    /// Reads an answer to the request with this token. What is read survives being written.
    ///
    /// # Panics
    /// When it does not.
    #[must_use]
    pub fn ack(bytes: &[u8], token: u64) -> Option<Answer> {
        let mut ack = Ack::new(&Answer::Accepted, token);
        ack.len = bytes.first().copied().unwrap_or(0);
        for (place, byte) in ack.bytes.iter_mut().zip(bytes.iter().skip(1)) {
            *place = *byte;
        }
        assert_eq!(ack.answer(token.wrapping_add(1)), None);
        let answer = ack.answer(token)?;
        assert_eq!(
            Ack::new(&answer, token).answer(token).as_ref(),
            Some(&answer)
        );
        Some(answer)
    }
}

#[cfg(test)]
mod tests {
    use fipa_transport::{FailureReason, Kind};

    use super::*;

    #[test]
    fn answers_round_trip_and_malformed_ones_are_refused() {
        for answer in [
            Answer::Accepted,
            Answer::OutOfOrder { last: u64::MAX },
            Answer::Delivered { via: Kind::Tcp },
            Answer::failed(FailureReason::Loop, "é".repeat(80)),
        ] {
            assert_eq!(Ack::new(&answer, 7).answer(7), Some(answer.clone()));
            assert_eq!(Ack::new(&answer, 7).answer(8), None);
        }
        for len in [0, 2, 255] {
            let mut ack = Ack::new(&Answer::Accepted, 1);
            ack.len = len;
            assert_eq!(ack.answer(1), None);
        }
    }

    #[test]
    fn a_word_has_a_code_for_each_answer_without_data_and_none_for_others() {
        for answer in [
            Answer::Accepted,
            Answer::Custody,
            Answer::Busy,
            Answer::Moved,
        ] {
            let code = code_of(&answer).expect("no data");
            assert_ne!(code, 0);
            assert_eq!(answer_of(code), Some(answer));
        }
        assert_eq!(code_of(&Answer::Returned { uncertain: false }), None);
        for code in [0, 4, 9, u8::MAX] {
            assert_eq!(answer_of(code), None);
        }
    }

    #[test]
    fn offsets_are_aligned_and_bounded() {
        let offsets = PieceOffsets::for_lengths(13, 100, 1).expect("fits");
        assert_eq!(
            offsets,
            PieceOffsets {
                start: 3,
                content: 16,
                tail: 116,
                end: 117
            }
        );
        assert_eq!(PieceOffsets::for_lengths(usize::MAX, 1, 1), None);
        assert_eq!(PieceOffsets::for_lengths(8, usize::MAX, 1), None);
    }
}
