//! Looking through short texts, eight bytes at a time.
//!
//! Words and names are a few bytes long: looking at those in one register is quicker than starting
//! a vectorised search, and one look tells all that is to be known of them.

pub(crate) const ONES: u64 = 0x0101_0101_0101_0101;
pub(crate) const TOPS: u64 = ONES << 7;

/// How many times eight bytes count as near.
const NEAR: usize = 6;

/// The text in front of the first NUL, what is behind that, and what kind of text it is, if the NUL
/// is near and not among the last bytes.
#[inline(always)]
pub(crate) fn near_text(bytes: &[u8]) -> Option<(&[u8], &[u8], Kind)> {
    let (mut before, mut seen) = (0, Kind::default());
    let mut rest = bytes;
    for _ in 0..NEAR {
        let (eight, behind) = rest.split_first_chunk()?;
        let word = u64::from_le_bytes(*eight);
        // Of the first byte that is zero, and perhaps of later ones, the top bit is set.
        let zeros = word.wrapping_sub(ONES) & !word & TOPS;
        if zeros != 0 {
            seen.see(word, (zeros & zeros.wrapping_neg()).wrapping_sub(1));
            let len = before + zeros.trailing_zeros() as usize / 8;
            let (text, behind) = bytes.split_at_checked(len)?;
            return Some((text, behind.split_first()?.1, seen));
        }
        seen.see(word, u64::MAX);
        before += 8;
        rest = behind;
    }
    None
}

/// What there is among the bytes of a text.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Kind {
    tops: u64,
    no_token: u64,
}

impl Kind {
    #[inline(always)]
    fn see(&mut self, word: u64, which: u64) {
        self.tops |= word & which;
        self.no_token |= no_token(word) & which;
    }

    /// Whether all bytes are ASCII.
    #[inline(always)]
    pub(crate) fn is_ascii(self) -> bool {
        self.tops & TOPS == 0
    }

    /// Whether there are no blanks, parentheses and control characters.
    #[inline(always)]
    pub(crate) fn is_token(self) -> bool {
        self.no_token & TOPS == 0
    }
}

/// The top bit of the first byte is set that no token has (blanks, parentheses and control
/// characters), and perhaps those of later ones; no other bits count.
#[inline(always)]
pub(crate) fn no_token(word: u64) -> u64 {
    let parentheses = (word & (ONES * 0xfe)) ^ (ONES * 0x28);
    below(word, 0x21) | zero(parentheses)
}

/// The same of the bytes below a bound of at most 128.
#[inline(always)]
pub(crate) fn below(word: u64, bound: u64) -> u64 {
    word.wrapping_sub(ONES * bound) & !word
}

/// The same of the bytes that are zero.
#[inline(always)]
pub(crate) fn zero(word: u64) -> u64 {
    below(word, 1)
}

/// The same of the bytes that are this one.
#[inline(always)]
pub(crate) fn is(word: u64, byte: u8) -> u64 {
    zero(word ^ (ONES * byte as u64))
}

/// Where the first byte is that `found` marks, one of the functions above, if there is one; the
/// last bytes are asked of `exact`.
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

/// Where the first of these bytes is, quicker for a few than a vectorised search and not slower for
/// many.
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

/// Whether there is a byte that `found` marks, one of the functions above or several.
#[inline]
pub(crate) fn any(bytes: &[u8], found: impl Fn(u64) -> u64) -> bool {
    let mut marks = 0;
    each(bytes, |word| marks |= found(word));
    marks & TOPS != 0
}

/// Looks at all bytes, at some twice, and at letters besides.
#[inline(always)]
pub(crate) fn each(bytes: &[u8], mut look: impl FnMut(u64)) {
    match (bytes.as_chunks::<8>(), bytes.last_chunk()) {
        // The last eight overlap those in front of them.
        ((eights, _), Some(last)) => {
            for eight in eights {
                look(u64::from_le_bytes(*eight));
            }
            look(u64::from_le_bytes(*last));
        }
        ((_, rest), None) => {
            let mut eight = [b'a'; 8];
            for (filled, byte) in eight.iter_mut().zip(rest) {
                *filled = *byte;
            }
            look(u64::from_le_bytes(eight));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_near_is_found_and_known() {
        for len in 0..60_usize {
            for (place, byte) in (0..len).flat_map(|place| [(place, b' '), (place, 0xc3)]) {
                let mut bytes = vec![b'a'; len];
                bytes[place] = byte;
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
    fn bytes_are_found_wherever_they_stand() {
        for len in 1..40 {
            for place in 0..len {
                for byte in 0..=u8::MAX {
                    let mut bytes = vec![b'a'; len];
                    bytes[place] = byte;
                    let ends = |byte: u8| byte <= b' ' || byte == b'(' || byte == b')';
                    let expected = ends(byte).then_some(place);
                    assert_eq!(find(&bytes, no_token, ends), expected, "{bytes:?}");
                    let expected = (byte == b'<').then_some(place);
                    let found = find(&bytes, |word| is(word, b'<'), |byte| byte == b'<');
                    assert_eq!(found, expected, "{bytes:?}");
                }
            }
        }
    }
}
