//! Bytes in pieces of any size in, frames out.
//!
//! Small bodies are read together with what follows them, into a chunk, and moved into memory of
//! their own. A large body is read straight into one buffer of its own, which grows as the bytes
//! arrive: announcing much takes no memory.
//!
//! The content of a large letter can be read straight into memory that the sink offers, from which
//! the letter is passed on: nobody but the kernel touches it then. So that no part of it is fetched
//! together with what stands in front, the reader is *careful* after a large letter: it reads
//! headers alone, until a small letter comes. What it had fetched of the first large letter after
//! small ones, less than a chunk, is moved.

use bytes::buf::Limit;
use bytes::{Buf, BufMut, BytesMut};
use fipa_transport::Arriving;
use fipa_transport::wire::{HEADER_LEN as PARCEL_HEADER_LEN, ParcelHeader};
use zerocopy::FromBytes;

use super::super::place::{Meter, Place, Room};
use super::{Frame, FrameError, FrameHeader, HEADER_LEN, MAGIC, PARCEL, PARCEL_ALLOWANCE};

/// Bytes of the buffer that headers and small bodies are read into.
pub(super) const CHUNK: usize = 16 * 1024;

/// A body's own buffer begins with at most this much, and grows to at most four times what has
/// arrived. Memory that nothing was put into is not really taken from the system.
pub(super) const FIRST_STEP: usize = 4 << 20;

/// From this length on, content is read into memory that the sink offers.
pub(super) const APART_FROM: u64 = 32 * 1024;

/// Both headers of a parcel: what can be read of the next frame without any of its content.
const HEADERS: usize = HEADER_LEN + PARCEL_HEADER_LEN;

/// Where the next bytes are to be put.
#[derive(Debug)]
pub(crate) enum Space<'a> {
    /// Behind what is there.
    Buffer(Limit<&'a mut BytesMut>),
    /// Into content, from its first byte on that is still missing. How many were put there is for
    /// [`FrameReader::put`].
    Content(&'a mut [u8]),
}

#[cfg(feature = "secure")]
impl Space<'_> {
    /// How many bytes there is room for.
    #[cfg(feature = "quic")]
    pub(crate) fn room(&self) -> usize {
        match self {
            Self::Buffer(buffer) => buffer.remaining_mut(),
            Self::Content(content) => content.len(),
        }
    }

    /// Puts there what there is room for, and says how much that was.
    pub(crate) fn fill(&mut self, bytes: &[u8]) -> usize {
        match self {
            Self::Buffer(buffer) => {
                let taken = bytes.len().min(buffer.remaining_mut());
                buffer.put_slice(bytes.get(..taken).unwrap_or_default());
                taken
            }
            Self::Content(content) => {
                let taken = bytes.len().min(content.len());
                if let (Some(to), Some(from)) = (content.get_mut(..taken), bytes.get(..taken)) {
                    to.copy_from_slice(from);
                }
                taken
            }
        }
    }
}

/// What has been read into memory of the sink's.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Placed {
    /// Contents.
    pub(crate) contents: u64,
    /// Bytes of them that had been fetched with what stands in front, and were moved.
    pub(crate) moved: u64,
}

/// Bytes in, frames out.
#[derive(Debug)]
pub(crate) struct FrameReader {
    /// Longest body of a parcel frame.
    max_parcel: u64,
    /// Headers, small bodies and the beginnings of large ones.
    pub(super) chunk: BytesMut,
    /// The frame whose body is arriving.
    pub(super) body: Option<PartialBody>,
    /// Whether the letter before was a large one.
    careful: bool,
    placed: Placed,
    /// Takes the memory for large bodies, if that is counted.
    meter: Option<Meter>,
    /// The header of a frame for whose body there is no room yet.
    blocked: Option<FrameHeader>,
}

#[derive(Debug)]
pub(super) struct PartialBody {
    header: FrameHeader,
    /// What has arrived of it, without a content that lies apart.
    pub(super) bytes: BytesMut,
    /// Length of the whole body.
    len: usize,
    content: Content,
    /// Until the body is complete.
    room: Option<Room>,
}

/// Where the content of a body lies.
#[derive(Debug)]
enum Content {
    /// To be decided when everything in front of it is there.
    Undecided,
    /// With the rest.
    Along,
    /// In memory of its own.
    Apart(Apart),
}

#[derive(Debug)]
struct Apart {
    /// So many bytes of the body stand in front.
    at: usize,
    place: Place,
    filled: usize,
}

impl FrameReader {
    /// A reader for a connection on which `begun` has arrived already, with room for letters of
    /// `max_letter` bytes.
    pub(crate) fn new(max_letter: usize, begun: BytesMut) -> Self {
        Self {
            max_parcel: (max_letter as u64).saturating_add(PARCEL_ALLOWANCE),
            chunk: begun,
            body: None,
            careful: false,
            placed: Placed::default(),
            meter: None,
            blocked: None,
        }
    }

    /// Large bodies get memory from this meter from now on.
    pub(crate) fn count_with(&mut self, meter: Meter) {
        self.meter = Some(meter);
    }

    /// Whether a body waits for memory: nothing is to be read until [`next`](Self::next) has got it.
    pub(crate) fn is_blocked(&self) -> bool {
        self.blocked.is_some()
    }

    /// How many bytes of the body that is arriving have to arrive in each period in which progress
    /// is measured; see [`Room::least_progress`].
    pub(crate) fn least_progress(&self) -> u64 {
        let room = self.body.as_ref().and_then(|body| body.room.as_ref());
        room.map_or(0, Room::least_progress)
    }

    /// Where the next bytes are to be put. Each time bytes were put there, [`put`](Self::put) is to
    /// be told, and [`next`](Self::next) called until it has no more.
    pub(crate) fn space(&mut self) -> Space<'_> {
        let Self {
            body,
            chunk,
            careful,
            ..
        } = self;
        let mut most = HEADERS.saturating_sub(chunk.len());
        if let Some(body) = body {
            // What is missing of a large body goes where it stays. Its rest, once smaller than
            // the chunk, is fetched together with what follows it.
            let in_place = match &body.content {
                Content::Apart(apart) => apart.filled < apart.place.len(),
                Content::Along => body.missing() >= CHUNK,
                Content::Undecided => false,
            };
            if in_place {
                return body.space();
            }
            most = match &body.content {
                Content::Undecided => body.wanted(),
                _ => body.wanted().saturating_add(HEADERS),
            };
        }
        if !*careful {
            most = CHUNK;
        }
        chunk.reserve(CHUNK.saturating_sub(chunk.len()).max(1));
        let limit = (chunk.capacity() - chunk.len()).min(most.max(1));
        Space::Buffer(chunk.limit(limit))
    }

    /// So many bytes were put where they were to be put.
    pub(crate) fn put(&mut self, bytes: usize) {
        if let Some(body) = &mut self.body
            && let Content::Apart(apart) = &mut body.content
            && apart.filled < apart.place.len()
        {
            apart.filled = apart.filled.saturating_add(bytes).min(apart.place.len());
        }
    }

    /// The next whole frame, if it has arrived. `memory` is asked for a place for large content.
    ///
    /// # Errors
    /// When what arrived is no frame. The connection is of no use then.
    pub(crate) fn next(
        &mut self,
        mut memory: impl FnMut(&Arriving<'_>) -> Option<Place>,
    ) -> Result<Option<Frame>, FrameError> {
        let mut body = match self.body.take() {
            Some(body) => body,
            None => match self.begin()? {
                Some(body) => body,
                None => return Ok(None),
            },
        };
        while body.take_from(&mut self.chunk, &mut self.placed) {
            body.decide(&mut memory);
        }
        if body.header.kind == PARCEL {
            self.careful = body.len as u64 >= APART_FROM;
        }
        if body.missing() > 0 {
            self.body = Some(body);
            return Ok(None);
        }
        if matches!(body.content, Content::Apart(_)) {
            self.placed.contents += 1;
        }
        body.finish().map(Some)
    }

    /// Whether a frame has begun to arrive, is not complete, and is read.
    pub(crate) fn is_partial(&self) -> bool {
        self.body.is_some() || !self.chunk.is_empty() && !self.is_blocked()
    }

    /// What has been read into memory of the sink's since this was last asked.
    pub(crate) fn take_placed(&mut self) -> Placed {
        std::mem::take(&mut self.placed)
    }

    fn begin(&mut self) -> Result<Option<PartialBody>, FrameError> {
        let header = match self.blocked.take() {
            Some(header) => header,
            None => match self.take_header()? {
                Some(header) => header,
                None => return Ok(None),
            },
        };
        let len = header.checked_body_len(self.max_parcel)?;
        let large = header.kind == PARCEL && len as u64 >= APART_FROM;
        let mut room = None;
        if let Some(meter) = self.meter.as_mut().filter(|_| large) {
            room = meter.take(len);
            if room.is_none() {
                self.blocked = Some(header);
                return Ok(None);
            }
        }
        let (content, capacity) = if large {
            (Content::Undecided, HEADERS)
        } else {
            (Content::Along, len.min(FIRST_STEP))
        };
        Ok(Some(PartialBody {
            header,
            bytes: BytesMut::with_capacity(capacity),
            len,
            content,
            room,
        }))
    }

    /// Takes the header of the next frame, if it has arrived.
    fn take_header(&mut self) -> Result<Option<FrameHeader>, FrameError> {
        // Nonsense is recognised by its first bytes, not only once there is enough of it.
        let begun = self.chunk.len().min(MAGIC.len());
        if self.chunk[..begun] != MAGIC[..begun] {
            let mut found = [0; 4];
            found[..begun].copy_from_slice(&self.chunk[..begun]);
            return Err(FrameError::Magic(found));
        }
        let Ok((header, _)) = FrameHeader::read_from_prefix(&self.chunk) else {
            return Ok(None);
        };
        header.checked_body_len(self.max_parcel)?;
        self.chunk.advance(HEADER_LEN);
        Ok(Some(header))
    }
}

impl PartialBody {
    /// Moves what there is of this body from the chunk, and says whether it is to be decided where
    /// the content goes.
    fn take_from(&mut self, chunk: &mut BytesMut, placed: &mut Placed) -> bool {
        if let Content::Apart(apart) = &mut self.content
            && let Some(missing) = apart.place.missing(apart.filled)
        {
            let there = missing.len().min(chunk.len());
            if let Some(place) = missing.get_mut(..there) {
                chunk.copy_to_slice(place);
                apart.filled += there;
                placed.moved += there as u64;
            }
            if apart.filled < apart.place.len() {
                return false;
            }
        }
        loop {
            // With the parcel's header it is known how much stands in front.
            let there = self.wanted().min(chunk.len());
            if there == 0 {
                return matches!(self.content, Content::Undecided) && self.wanted() == 0;
            }
            self.bytes.put_slice(&chunk[..there]);
            chunk.advance(there);
        }
    }

    /// How many bytes are missing until the next thing is to be done; of content that lies apart,
    /// all are there.
    fn wanted(&self) -> usize {
        match &self.content {
            Content::Undecided => self.front().saturating_sub(self.bytes.len()),
            Content::Along | Content::Apart(_) => self.missing(),
        }
    }

    /// How many bytes of the body stand in front of the content, as far as is known.
    fn front(&self) -> usize {
        match ParcelHeader::read_from_prefix(&self.bytes) {
            Ok((header, _)) => {
                let front = (PARCEL_HEADER_LEN as u64).saturating_add(header.front_len());
                usize::try_from(front).map_or(self.len, |front| front.min(self.len))
            }
            Err(_) => PARCEL_HEADER_LEN,
        }
    }

    /// Decides where the content goes, when there is enough to see it by.
    fn decide(&mut self, memory: &mut impl FnMut(&Arriving<'_>) -> Option<Place>) {
        let Ok((header, front)) = ParcelHeader::read_from_prefix(&self.bytes) else {
            return self.keep_along();
        };
        let announced = (PARCEL_HEADER_LEN as u64).saturating_add(header.body_len());
        if announced != self.len as u64 || header.content_len() < APART_FROM || self.front() > CHUNK
        {
            return self.keep_along();
        }
        if self.front() > self.bytes.len() {
            return;
        }
        let place = header.arriving(front).and_then(|arriving| {
            let place = memory(&arriving)?;
            (place.len() == arriving.len).then_some(place)
        });
        match place {
            Some(place) => {
                self.content = Content::Apart(Apart {
                    at: self.bytes.len(),
                    place,
                    filled: 0,
                });
            }
            None => self.keep_along(),
        }
    }

    fn keep_along(&mut self) {
        self.content = Content::Along;
        self.bytes.reserve(self.missing().min(FIRST_STEP));
    }

    fn missing(&self) -> usize {
        let apart = match &self.content {
            Content::Apart(apart) => apart.filled,
            Content::Undecided | Content::Along => 0,
        };
        self.len - self.bytes.len() - apart
    }

    /// Memory that what is missing goes to.
    fn space(&mut self) -> Space<'_> {
        let all_missing = self.missing();
        if let Content::Apart(apart) = &mut self.content {
            let missing = apart.place.missing(apart.filled);
            return Space::Content(missing.unwrap_or_default());
        }
        if self.bytes.len() == self.bytes.capacity() {
            let step = self.bytes.len().saturating_mul(3).min(all_missing);
            self.bytes.reserve(step);
        }
        let room = self.bytes.capacity() - self.bytes.len();
        let limit = all_missing.min(room);
        Space::Buffer((&mut self.bytes).limit(limit))
    }

    fn finish(self) -> Result<Frame, FrameError> {
        let mut front = self.bytes.freeze();
        match self.content {
            Content::Apart(apart) => {
                let tail = front.split_off(apart.at);
                super::finish_apart(self.header, front, apart.place.freeze(), tail)
            }
            Content::Undecided | Content::Along => super::finish(self.header, front),
        }
    }
}
