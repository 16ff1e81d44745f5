//! Choices drawn from the bytes of an input, in order. Where the bytes end, every choice is the first.

use std::time::Duration;

/// The bytes of an input that are not used yet.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a>(pub &'a [u8]);

impl<'a> Input<'a> {
    /// Whether all bytes are used.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The next byte.
    pub fn byte(&mut self) -> u8 {
        let Some((first, rest)) = self.0.split_first() else {
            return 0;
        };
        self.0 = rest;
        *first
    }

    /// A number below `count`, which is at most 256.
    pub fn below(&mut self, count: usize) -> usize {
        usize::from(self.byte()) % count
    }

    /// One of these.
    pub fn one_of<T: Clone>(&mut self, all: &[T]) -> T {
        all[self.below(all.len())].clone()
    }

    /// A number of eight bytes.
    pub fn u64(&mut self) -> u64 {
        u64::from_le_bytes([(); 8].map(|()| self.byte()))
    }

    /// A number as protocols count: mostly small, sometimes at an edge, sometimes any.
    pub fn number(&mut self) -> u64 {
        match self.byte() {
            small @ 0..=239 => u64::from(small % 80),
            240..=243 => u64::MAX,
            244..=246 => u64::MAX - 1,
            247..=249 => 1 << 48,
            _ => self.u64(),
        }
    }

    /// A time as protocols use them: mostly short, sometimes the longest there is.
    pub fn time(&mut self) -> Duration {
        match self.byte() {
            0 => Duration::ZERO,
            1 => Duration::MAX,
            2 => Duration::from_secs(7200),
            3 => Duration::from_nanos(1),
            ms => Duration::from_millis(u64::from(ms) * 10),
        }
    }

    /// Bytes with their length in front, at most this many.
    pub fn bytes(&mut self, most: usize) -> &'a [u8] {
        let len = usize::from(self.byte()).min(most).min(self.0.len());
        let (taken, rest) = self.0.split_at(len);
        self.0 = rest;
        taken
    }

    /// Bytes with their length, of two bytes, in front.
    pub fn long_bytes(&mut self) -> &'a [u8] {
        let len = usize::from(u16::from_le_bytes([self.byte(), self.byte()]));
        let (taken, rest) = self.0.split_at(len.min(self.0.len()));
        self.0 = rest;
        taken
    }
}
