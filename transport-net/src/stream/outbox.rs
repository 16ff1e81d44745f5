//! The queue of frames to write, with the frame that the kernel has begun to take.

use std::collections::VecDeque;
use std::io::IoSlice;

use bytes::{Buf, Bytes};

/// The content of a queued frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum About {
    /// The parcel with this number.
    Parcel(u64),
    /// An answer to a parcel of the other side.
    Answer,
    /// Hello, ping, pong, goodbye.
    Control,
}

/// Frames that wait to be written.
///
/// Answers and control frames go before parcels that have not begun, so that a large letter delays
/// as few answers as possible.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    /// The frame that has begun, if its first byte has been taken.
    begun: Option<Waiting>,
    urgent: VecDeque<Waiting>,
    parcels: VecDeque<Waiting>,
    parcel_bytes: usize,
}

#[derive(Debug)]
struct Waiting {
    about: About,
    pieces: VecDeque<Bytes>,
    len: usize,
}

/// The effect of a write on a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Progress {
    /// Its first byte has been taken.
    Begun(About),
    /// Its last byte has been taken.
    Written(About),
}

impl Outbox {
    /// Appends an answer or a control frame.
    pub(crate) fn push_urgent(&mut self, about: About, frame: Bytes) {
        let len = frame.len();
        let pieces = VecDeque::from([frame]);
        self.urgent.push_back(Waiting { about, pieces, len });
    }

    /// Appends a parcel as a list of nonempty pieces.
    pub(crate) fn push_parcel(&mut self, id: u64, pieces: Vec<Bytes>) {
        let len = pieces.iter().map(Bytes::len).sum();
        self.parcel_bytes += len;
        self.parcels.push_back(Waiting {
            about: About::Parcel(id),
            pieces: pieces.into(),
            len,
        });
    }

    /// Returns the number of bytes of parcels that the kernel has not begun to take.
    pub(crate) fn parcel_bytes(&self) -> usize {
        self.parcel_bytes
    }

    /// Removes a parcel that the kernel has not begun to take. Returns whether there was one.
    pub(crate) fn remove_parcel(&mut self, id: u64) -> bool {
        // Numbers rise from front to back.
        let place = self
            .parcels
            .binary_search_by_key(&id, |waiting| match waiting.about {
                About::Parcel(id) => id,
                About::Answer | About::Control => 0,
            });
        let removed = place.ok().and_then(|place| self.parcels.remove(place));
        self.parcel_bytes -= removed.as_ref().map_or(0, |waiting| waiting.len);
        removed.is_some()
    }

    /// Returns the number of parcels that the kernel has not begun to take, before the one with this number.
    pub(crate) fn parcels_before(&self, id: u64) -> usize {
        let is_before = |waiting: &Waiting| matches!(waiting.about, About::Parcel(it) if it < id);
        self.parcels.partition_point(is_before)
    }

    /// Drops every parcel that the kernel has not begun to take.
    pub(crate) fn drop_parcels(&mut self) {
        self.parcels.clear();
        self.parcel_bytes = 0;
    }

    /// Fills `slices` with the next bytes to write. Returns the number of filled slices. `parcels`
    /// is the number of parcels that may begin now.
    pub(crate) fn gather<'a>(&'a self, slices: &mut [IoSlice<'a>], parcels: usize) -> usize {
        let frames = self
            .begun
            .iter()
            .chain(&self.urgent)
            .chain(self.parcels.iter().take(parcels));
        let pieces = frames.flat_map(|waiting| &waiting.pieces);
        slices
            .iter_mut()
            .zip(pieces)
            .map(|(slice, piece)| *slice = IoSlice::new(piece))
            .count()
    }

    /// Notes that the kernel took the next `taken` bytes of those that [`gather`](Self::gather)
    /// returned.
    pub(crate) fn written(&mut self, mut taken: usize, mut tell: impl FnMut(Progress)) {
        while taken > 0 {
            if self.begun.is_none() {
                let next = self.urgent.pop_front().or_else(|| {
                    let parcel = self.parcels.pop_front()?;
                    self.parcel_bytes -= parcel.len;
                    Some(parcel)
                });
                let Some(next) = next else { return };
                tell(Progress::Begun(next.about));
                self.begun = Some(next);
            }
            let Some(frame) = &mut self.begun else { return };
            taken = frame.advance(taken);
            if frame.pieces.is_empty() {
                tell(Progress::Written(frame.about));
                self.begun = None;
            }
        }
    }

    /// Returns the number of frames that the kernel has not taken completely.
    pub(crate) fn frames(&self) -> usize {
        usize::from(self.begun.is_some()) + self.urgent.len() + self.parcels.len()
    }

    /// Whether no frame waits except parcels that may not begin now (see [`gather`](Self::gather)).
    pub(crate) fn is_idle(&self, parcels: usize) -> bool {
        self.begun.is_none() && self.urgent.is_empty() && (parcels == 0 || self.parcels.is_empty())
    }
}

impl Waiting {
    /// Drops the bytes that were taken. Returns the number of bytes beyond this frame.
    fn advance(&mut self, mut taken: usize) -> usize {
        while taken > 0
            && let Some(piece) = self.pieces.front_mut()
        {
            let step = taken.min(piece.len());
            piece.advance(step);
            taken -= step;
            if piece.is_empty() {
                self.pieces.pop_front();
            }
        }
        taken
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn write(outbox: &mut Outbox, max: usize, parcels: usize, wire: &mut Vec<u8>) -> Vec<Progress> {
        let mut slices = [IoSlice::new(&[]); 4];
        let count = outbox.gather(&mut slices, parcels);
        let shown: Vec<u8> = slices[..count].iter().flat_map(|s| s.to_vec()).collect();
        let taken = max.min(shown.len());
        wire.extend_from_slice(&shown[..taken]);
        let mut progress = Vec::new();
        outbox.written(taken, |step| progress.push(step));
        progress
    }

    #[test]
    fn urgent_frames_wait_only_for_the_frame_that_has_begun() {
        let mut outbox = Outbox::default();
        outbox.push_parcel(1, vec![Bytes::from_static(b"first")]);
        outbox.push_parcel(2, vec![Bytes::from_static(b"second")]);
        let mut wire = Vec::new();
        let progress = write(&mut outbox, 2, 9, &mut wire);
        assert_eq!(progress, [Progress::Begun(About::Parcel(1))]);
        outbox.push_urgent(About::Answer, Bytes::from_static(b"!"));
        assert!(!outbox.remove_parcel(1));
        while !outbox.is_idle(9) {
            write(&mut outbox, 3, 9, &mut wire);
        }
        assert_eq!(wire, b"first!second");
        assert_eq!(outbox.parcel_bytes(), 0);
    }

    #[test]
    fn parcels_that_may_not_begin_wait_and_can_be_removed() {
        let mut outbox = Outbox::default();
        for id in 1..=3 {
            outbox.push_parcel(id, vec![Bytes::from(vec![id as u8; 2])]);
        }
        let mut wire = Vec::new();
        write(&mut outbox, 100, 1, &mut wire);
        assert!(outbox.is_idle(0));
        assert!(outbox.remove_parcel(2));
        assert_eq!(outbox.parcel_bytes(), 2);
        write(&mut outbox, 100, 9, &mut wire);
        assert_eq!(wire, [1, 1, 3, 3]);
    }

    proptest! {
        #[test]
        fn partial_writes_lose_and_double_nothing(
            frames in prop::collection::vec(prop::collection::vec(1_usize..50, 1..9), 1..20),
            steps in prop::collection::vec(1_usize..70, 1..9),
        ) {
            let mut outbox = Outbox::default();
            let (mut expected, mut wire, mut written) = (Vec::new(), Vec::new(), Vec::new());
            for (id, lens) in frames.iter().enumerate() {
                let pieces: Vec<Bytes> =
                    lens.iter().map(|len| vec![id as u8; *len].into()).collect();
                expected.extend(pieces.concat());
                outbox.push_parcel(id as u64, pieces);
            }
            for step in steps.iter().cycle() {
                if outbox.is_idle(usize::MAX) {
                    break;
                }
                for progress in write(&mut outbox, *step, usize::MAX, &mut wire) {
                    if let Progress::Written(about) = progress {
                        written.push(about);
                    }
                }
            }
            let all: Vec<About> = (0..frames.len() as u64).map(About::Parcel).collect();
            prop_assert_eq!(wire, expected);
            prop_assert_eq!(written, all);
        }
    }
}
