//! Decodes frames from bytes in pieces of any size.
//!
//! Small bodies are read together with the following bytes into a chunk, and copied into memory of
//! their own. A large body is read directly into a buffer of its own, which grows as the bytes
//! arrive: an announced length alone allocates no memory.
//!
//! The content of a large letter can be read directly into memory of the sink, from which the
//! letter is passed on without another copy. To avoid reading a part of the content into the chunk,
//! the reader is *careful* after a large letter: it reads headers alone until a small letter comes.
//! The bytes of the first large letter after small ones that are already in the chunk, less than a
//! chunk, are copied.

use bytes::buf::Limit;
use bytes::{Buf, BufMut, BytesMut};
use fipa_acl::Letter;
use fipa_transport::Arriving;
use fipa_transport::wire::{HEADER_LEN as PARCEL_HEADER_LEN, ParcelHeader};
use zerocopy::FromBytes;

use super::super::budget::{ContentBuffer, Meter, ReservedBytes};
use super::{
    COMMON_LEN, Frame, FrameError, FrameHeader, HEADER_LEN, MAGIC, PARCEL, PARCEL_ALLOWANCE,
    VERSION,
};

/// Size of the buffer for headers and small bodies, in bytes.
pub(super) const CHUNK: usize = 16 * 1024;

/// Maximum initial size of the buffer of a body; it grows to at most four times the received bytes.
/// The system does not back untouched pages with memory.
pub(super) const FIRST_STEP: usize = 4 << 20;

/// Minimum length of content that is read into memory of the sink.
pub(super) const APART_FROM: u64 = 32 * 1024;

/// Maximum length of the bytes in front of content that is read into memory of the sink. Longer ones
/// belong to no letter that a service sends; see [`Letter::MAX_AROUND`].
const MAX_FRONT: usize = Letter::MAX_AROUND + (128 << 10);

/// Length of both headers of a parcel: these bytes can be read without any content.
const HEADERS: usize = HEADER_LEN + PARCEL_HEADER_LEN;

/// Destination of the next bytes that are read.
#[derive(Debug)]
pub(crate) enum Space<'a> {
    /// The end of a buffer.
    Buffer(Limit<&'a mut BytesMut>),
    /// The missing part of content. The number of bytes put there is passed to
    /// [`FrameReader::put`].
    Content(&'a mut [u8]),
}

#[cfg(feature = "secure")]
impl Space<'_> {
    /// Returns the number of bytes that fit.
    #[cfg(feature = "quic")]
    pub(crate) fn room(&self) -> usize {
        match self {
            Self::Buffer(buffer) => buffer.remaining_mut(),
            Self::Content(content) => content.len(),
        }
    }

    /// Copies as many bytes as fit. Returns their number.
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

/// Counts of content that was read into memory of the sink.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Placed {
    /// Number of contents.
    pub(crate) contents: u64,
    /// Bytes of them that were read into the chunk first and copied.
    pub(crate) moved: u64,
}

/// Decodes frames from bytes.
#[derive(Debug)]
pub(crate) struct FrameReader {
    /// Maximum length of the body of a parcel frame.
    max_parcel: u64,
    /// Headers, small bodies and the beginnings of large ones.
    pub(super) chunk: BytesMut,
    /// The frame whose body is arriving.
    pub(super) body: Option<PartialBody>,
    /// Whether the previous letter was large.
    careful: bool,
    placed: Placed,
    /// Reserves the memory of large bodies, if it is counted.
    meter: Option<Meter>,
    /// The header of a frame whose body waits for memory.
    blocked: Option<FrameHeader>,
}

#[derive(Debug)]
pub(super) struct PartialBody {
    header: FrameHeader,
    /// The received bytes without content in separate memory.
    pub(super) bytes: BytesMut,
    /// Length of the whole body.
    len: usize,
    content: Content,
    /// The reservation, held until the body is complete.
    room: Option<ReservedBytes>,
}

/// The location of the content of a body.
#[derive(Debug)]
enum Content {
    /// Undecided until all bytes in front of the content have arrived.
    Undecided,
    /// Together with the other bytes.
    Along,
    /// In memory of the sink.
    Apart(Apart),
}

#[derive(Debug)]
struct Apart {
    /// Number of bytes of the body in front of the content.
    at: usize,
    buffer: ContentBuffer,
    filled: usize,
}

impl FrameReader {
    /// Creates a reader for a connection on which `begun` has arrived already, for letters of up to
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

    /// Sets the meter that reserves the memory of large bodies.
    pub(crate) fn count_with(&mut self, meter: Meter) {
        self.meter = Some(meter);
    }

    /// Whether a body waits for memory. Nothing must be read until [`next`](Self::next) has
    /// reserved it.
    pub(crate) fn is_blocked(&self) -> bool {
        self.blocked.is_some()
    }

    /// Returns the number of bytes of the arriving body that must arrive in each measuring period;
    /// see [`ReservedBytes::least_progress`].
    pub(crate) fn least_progress(&self) -> u64 {
        let room = self.body.as_ref().and_then(|body| body.room.as_ref());
        room.map_or(0, ReservedBytes::least_progress)
    }

    /// Returns the destination of the next bytes. After putting bytes there, the caller calls
    /// [`put`](Self::put), and [`next`](Self::next) until it returns no frame.
    pub(crate) fn space(&mut self) -> Space<'_> {
        let Self {
            body,
            chunk,
            careful,
            ..
        } = self;
        let mut most = HEADERS.saturating_sub(chunk.len());
        if let Some(body) = body {
            // The missing bytes of a large body are read into their final memory. The last part,
            // once smaller than the chunk, is read together with the following bytes.
            let in_place = match &body.content {
                Content::Apart(apart) => apart.filled < apart.buffer.len(),
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

    /// Notes that `bytes` were put into the last [`space`](Self::space).
    pub(crate) fn put(&mut self, bytes: usize) {
        if let Some(body) = &mut self.body
            && let Content::Apart(apart) = &mut body.content
            && apart.filled < apart.buffer.len()
        {
            apart.filled = apart.filled.saturating_add(bytes).min(apart.buffer.len());
        }
    }

    /// Returns the next complete frame, if it has arrived. `memory` offers memory for large
    /// content.
    ///
    /// # Errors
    /// When the bytes are not a frame. The connection is unusable then.
    pub(crate) fn next(
        &mut self,
        mut memory: impl FnMut(&Arriving<'_>) -> Option<ContentBuffer>,
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

    /// Whether a frame has partly arrived and does not wait for memory.
    pub(crate) fn is_partial(&self) -> bool {
        self.body.is_some() || !self.chunk.is_empty() && !self.is_blocked()
    }

    /// Returns the counts of content in memory of the sink since the last call.
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

    /// Removes the header of the next frame from the chunk, if it has arrived.
    fn take_header(&mut self) -> Result<Option<FrameHeader>, FrameError> {
        // A wrong start is reported at its first byte, before a whole header has arrived.
        let begun = self.chunk.len().min(MAGIC.len());
        if self.chunk[..begun] != MAGIC[..begun] {
            let mut found = [0; 4];
            found[..begun].copy_from_slice(&self.chunk[..begun]);
            return Err(FrameError::Magic(found));
        }
        // The rest of a header of another version may have another length.
        if let Some([.., version, _, _, _]) = self.chunk.get(..COMMON_LEN)
            && *version != VERSION
        {
            return Err(FrameError::Version(*version));
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
    /// Moves the bytes of this body out of the chunk. Returns whether the location of the content
    /// is to be decided now.
    fn take_from(&mut self, chunk: &mut BytesMut, placed: &mut Placed) -> bool {
        if let Content::Apart(apart) = &mut self.content
            && let Some(missing) = apart.buffer.missing(apart.filled)
        {
            let there = missing.len().min(chunk.len());
            if let Some(buffer) = missing.get_mut(..there) {
                chunk.copy_to_slice(buffer);
                apart.filled += there;
                placed.moved += there as u64;
            }
            if apart.filled < apart.buffer.len() {
                return false;
            }
        }
        loop {
            // The parcel header determines the number of bytes in front of the content.
            let there = self.wanted().min(chunk.len());
            if there == 0 {
                return matches!(self.content, Content::Undecided) && self.wanted() == 0;
            }
            self.bytes.put_slice(&chunk[..there]);
            chunk.advance(there);
        }
    }

    /// Returns the number of bytes missing until the next step. Content in separate memory is
    /// complete here.
    fn wanted(&self) -> usize {
        match &self.content {
            Content::Undecided => self.front().saturating_sub(self.bytes.len()),
            Content::Along | Content::Apart(_) => self.missing(),
        }
    }

    /// Returns the number of bytes of the body in front of the content, as far as known.
    fn front(&self) -> usize {
        match ParcelHeader::read_from_prefix(&self.bytes) {
            Ok((header, _)) => {
                let front = (PARCEL_HEADER_LEN as u64).saturating_add(header.front_len());
                usize::try_from(front).map_or(self.len, |front| front.min(self.len))
            }
            Err(_) => PARCEL_HEADER_LEN,
        }
    }

    /// Decides the location of the content when enough bytes have arrived.
    fn decide(&mut self, memory: &mut impl FnMut(&Arriving<'_>) -> Option<ContentBuffer>) {
        let Ok((header, front)) = ParcelHeader::read_from_prefix(&self.bytes) else {
            return self.keep_along();
        };
        let announced = (PARCEL_HEADER_LEN as u64).saturating_add(header.body_len());
        if announced != self.len as u64
            || header.content_len() < APART_FROM
            || self.front() > MAX_FRONT
        {
            return self.keep_along();
        }
        if self.front() > self.bytes.len() {
            return;
        }
        let buffer = header.arriving(front).and_then(|arriving| {
            let buffer = memory(&arriving)?;
            (buffer.len() == arriving.len).then_some(buffer)
        });
        match buffer {
            Some(buffer) => {
                self.content = Content::Apart(Apart {
                    at: self.bytes.len(),
                    buffer,
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

    /// Returns the destination of the missing bytes.
    fn space(&mut self) -> Space<'_> {
        let all_missing = self.missing();
        if let Content::Apart(apart) = &mut self.content {
            let missing = apart.buffer.missing(apart.filled);
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
                super::finish_apart(self.header, front, apart.buffer.freeze(), tail)
            }
            Content::Undecided | Content::Along => super::finish(self.header, front),
        }
    }
}
