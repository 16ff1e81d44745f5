//! Choices from the bytes of an input, in order. After the last byte, every choice is the first
//! one.

use std::time::Duration;

/// The unused bytes of an input.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a>(pub &'a [u8]);

impl<'a> Input<'a> {
    /// Whether all bytes are used.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the next byte, or zero after the last one.
    pub fn byte(&mut self) -> u8 {
        let Some((first, rest)) = self.0.split_first() else {
            return 0;
        };
        self.0 = rest;
        *first
    }

    /// Returns a number below `count`, which is at most 256.
    pub fn below(&mut self, count: usize) -> usize {
        usize::from(self.byte()) % count
    }

    /// Returns one of these values.
    pub fn one_of<T: Clone>(&mut self, all: &[T]) -> T {
        all[self.below(all.len())].clone()
    }

    /// Returns a number from eight bytes.
    pub fn u64(&mut self) -> u64 {
        u64::from_le_bytes([(); 8].map(|()| self.byte()))
    }

    /// Returns a number for a protocol field: mostly a small one, sometimes an edge value or any
    /// value.
    pub fn number(&mut self) -> u64 {
        match self.byte() {
            small @ 0..=239 => u64::from(small % 80),
            240..=243 => u64::MAX,
            244..=246 => u64::MAX - 1,
            247..=249 => 1 << 48,
            _ => self.u64(),
        }
    }

    /// Returns a duration: mostly a short one, sometimes zero, very long or the maximum.
    pub fn time(&mut self) -> Duration {
        match self.byte() {
            0 => Duration::ZERO,
            1 => Duration::MAX,
            2 => Duration::from_secs(7200),
            3 => Duration::from_nanos(1),
            ms => Duration::from_millis(u64::from(ms) * 10),
        }
    }

    /// Returns at most `most` bytes. Their length is in one byte in front.
    pub fn bytes(&mut self, most: usize) -> &'a [u8] {
        let len = usize::from(self.byte()).min(most).min(self.0.len());
        let (taken, rest) = self.0.split_at(len);
        self.0 = rest;
        taken
    }

    /// Returns bytes. Their length is in two bytes in front.
    pub fn long_bytes(&mut self) -> &'a [u8] {
        let len = usize::from(u16::from_le_bytes([self.byte(), self.byte()]));
        let (taken, rest) = self.0.split_at(len.min(self.0.len()));
        self.0 = rest;
        taken
    }
}
