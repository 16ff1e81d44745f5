//! Scanning of short texts, eight bytes at a time.
//!
//! Words and names are a few bytes long. Scanning them in one register is faster than starting a
//! vectorized search, and one pass finds all their properties.

pub(crate) const ONES: u64 = 0x0101_0101_0101_0101;
pub(crate) const TOPS: u64 = ONES << 7;

/// Maximum length that [`near_text`] scans, in units of eight bytes.
const NEAR: usize = 6;

/// Returns the text in front of the first NUL, the bytes behind the NUL, and the kind of text.
///
/// Returns `None` if the NUL is not among the first [`NEAR`] × 8 bytes, or is among the last bytes
/// that do not fill a word.
#[inline(always)]
pub(crate) fn near_text(bytes: &[u8]) -> Option<(&[u8], &[u8], Kind)> {
    let (mut before, mut seen) = (0, Kind::default());
    let mut rest = bytes;
    for _ in 0..NEAR {
        let (eight, behind) = rest.split_first_chunk()?;
        let word = u64::from_le_bytes(*eight);
        // The top bit of the first zero byte is set, and perhaps those of later bytes.
        let zeros = word.wrapping_sub(ONES) & !word & TOPS;
        if zeros != 0 {
            seen.add(word, (zeros & zeros.wrapping_neg()).wrapping_sub(1));
            let len = before + zeros.trailing_zeros() as usize / 8;
            let (text, behind) = bytes.split_at_checked(len)?;
            return Some((text, behind.split_first()?.1, seen));
        }
        seen.add(word, u64::MAX);
        before += 8;
        rest = behind;
    }
    None
}

/// Properties of the bytes of a text.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Kind {
    tops: u64,
    no_token: u64,
}

impl Kind {
    #[inline(always)]
    fn add(&mut self, word: u64, which: u64) {
        self.tops |= word & which;
        self.no_token |= no_token(word) & which;
    }

    /// Whether all bytes are ASCII.
    #[inline(always)]
    pub(crate) fn is_ascii(self) -> bool {
        self.tops & TOPS == 0
    }

    /// Whether the text has no blanks, parentheses or control characters.
    #[inline(always)]
    pub(crate) fn is_token(self) -> bool {
        self.no_token & TOPS == 0
    }
}

/// Marks bytes that a token cannot have: blanks, parentheses and control characters.
///
/// The top bit of the first such byte is set. The top bits of later bytes, and all other bits, are
/// unspecified. If there is no such byte, no top bit is set.
#[inline(always)]
pub(crate) fn no_token(word: u64) -> u64 {
    let parentheses = (word & (ONES * 0xfe)) ^ (ONES * 0x28);
    below(word, 0x21) | zero(parentheses)
}

/// Marks bytes below a bound of at most 128, like [`no_token`].
#[inline(always)]
pub(crate) fn below(word: u64, bound: u64) -> u64 {
    word.wrapping_sub(ONES * bound) & !word
}

/// Marks zero bytes, like [`no_token`].
#[inline(always)]
pub(crate) fn zero(word: u64) -> u64 {
    below(word, 1)
}

/// Marks bytes equal to `byte`, like [`no_token`].
#[inline(always)]
pub(crate) fn is(word: u64, byte: u8) -> u64 {
    zero(word ^ (ONES * byte as u64))
}

/// Returns the position of the first byte that `found` marks. `found` is one of the functions above.
/// `exact` decides for the last bytes, which do not fill a word.
#[inline(always)]
pub(crate) fn find(
    bytes: &[u8],
    found: impl Fn(u64) -> u64,
    exact: impl Fn(u8) -> bool,
) -> Option<usize> {
    let mut before = 0;
    let mut rest = bytes;
    while let Some((eight, behind)) = rest.split_first_chunk() {
        let marks = found(u64::from_le_bytes(*eight)) & TOPS;
        if marks != 0 {
            return Some(before + marks.trailing_zeros() as usize / 8);
        }
        before += 8;
        rest = behind;
    }
    let last = rest.iter().position(|byte| exact(*byte))?;
    Some(before + last)
}

/// Returns the position of the first byte equal to `byte`. For short texts this is faster than a
/// vectorized search, and for long ones not slower.
#[inline]
pub(crate) fn find_byte(bytes: &[u8], byte: u8) -> Option<usize> {
    let mut before = 0;
    let mut rest = bytes;
    while before < 8 * NEAR
        && let Some((eight, behind)) = rest.split_first_chunk()
    {
        let marks = is(u64::from_le_bytes(*eight), byte) & TOPS;
        if marks != 0 {
            return Some(before + marks.trailing_zeros() as usize / 8);
        }
        before += 8;
        rest = behind;
    }
    Some(before + memchr::memchr(byte, rest)?)
}

/// Whether `found` marks any byte. `found` combines one or more of the functions above.
#[inline]
pub(crate) fn any(bytes: &[u8], found: impl Fn(u64) -> u64) -> bool {
    let mut marks = 0;
    each(bytes, |word| marks |= found(word));
    marks & TOPS != 0
}

/// Passes all bytes to `visit` in words. Some bytes are passed twice. A short text is padded with
/// letters.
#[inline(always)]
pub(crate) fn each(bytes: &[u8], mut visit: impl FnMut(u64)) {
    match (bytes.as_chunks::<8>(), bytes.last_chunk()) {
        // The last eight bytes overlap the bytes in front of them.
        ((eights, _), Some(last)) => {
            for eight in eights {
                visit(u64::from_le_bytes(*eight));
            }
            visit(u64::from_le_bytes(*last));
        }
        ((_, rest), None) => {
            let mut eight = [b'a'; 8];
            for (filled, byte) in eight.iter_mut().zip(rest) {
                *filled = *byte;
            }
            visit(u64::from_le_bytes(eight));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_texts_are_found_with_their_kind() {
        for len in 0..60_usize {
            for (at, byte) in (0..len).flat_map(|at| [(at, b' '), (at, 0xc3)]) {
                let mut bytes = vec![b'a'; len];
                bytes[at] = byte;
                bytes.extend_from_slice(b"\0(\xff behind..");
                let Some((text, behind, kind)) = near_text(&bytes) else {
                    assert!(len >= 8 * NEAR, "{len}");
                    continue;
                };
                assert_eq!((text, behind), (&bytes[..len], &bytes[len + 1..]));
                assert_eq!(kind.is_ascii(), byte < 0x80);
                assert_eq!(kind.is_token(), byte != b' ');
            }
        }
        assert!(near_text(b"short\0").is_none());
    }

    #[test]
    fn bytes_are_found_at_every_position() {
        for len in 1..40 {
            for at in 0..len {
                for byte in 0..=u8::MAX {
                    let mut bytes = vec![b'a'; len];
                    bytes[at] = byte;
                    let ends = |byte: u8| byte <= b' ' || byte == b'(' || byte == b')';
                    let expected = ends(byte).then_some(at);
                    assert_eq!(find(&bytes, no_token, ends), expected, "{bytes:?}");
                    let expected = (byte == b'<').then_some(at);
                    let found = find(&bytes, |word| is(word, b'<'), |byte| byte == b'<');
                    assert_eq!(found, expected, "{bytes:?}");
                }
            }
        }
    }
}
