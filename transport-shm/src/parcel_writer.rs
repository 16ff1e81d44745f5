//! Writes a parcel into shared memory. Its content is copied there, is there already as a [loan](crate::loan), or
//! stays in a [segment](crate::segment).

use std::ops::Range;
use std::ptr::NonNull;

use bytes::Bytes;
use fipa_transport::wire::Pieces;

/// The treatment of the content when a parcel is written.
pub(crate) enum ContentWrite<'a> {
    /// Written like the other pieces.
    Here,
    /// Already in its place: skipped, but its room is counted.
    InPlace(&'a Bytes),
    /// In a segment: skipped.
    Elsewhere(&'a Bytes),
}

/// Writes pieces one after the other into `room`, a range of offsets from `start` in bytes.
///
/// # Panics
/// Panics if the pieces are longer than the room. The lengths come from other crates, and only this
/// check compares them with what is written.
///
/// # Safety
/// The room must be in memory that may be written, and nothing else may refer to the parts of it
/// that are written.
pub(crate) unsafe fn write(
    start: NonNull<u8>,
    room: Range<usize>,
    pieces: &Pieces<'_>,
    content: ContentWrite<'_>,
) {
    let Range { start: mut at, end } = room;
    for piece in pieces.iter() {
        let place = start.as_ptr().wrapping_add(at);
        let is = |content: &Bytes| std::ptr::eq(&content[..], piece);
        let is_written = match content {
            ContentWrite::Elsewhere(content) if is(content) => continue,
            ContentWrite::InPlace(content) => !is(content),
            ContentWrite::Here | ContentWrite::Elsewhere(_) => true,
        };
        let most = end.saturating_sub(at);
        assert!(piece.len() <= most, "pieces have the lengths of the header");
        if is_written {
            // SAFETY: the assertion above shows that the piece fits behind `place`, in memory that
            // may be written according to the caller. The piece does not overlap it, because
            // nothing else refers to that memory.
            unsafe { place.copy_from_nonoverlapping(piece.as_ptr(), piece.len()) };
        }
        at += piece.len();
    }
}
