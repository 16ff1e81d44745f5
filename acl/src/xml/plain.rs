//! Detection of content that needs no escaping. The compiler turns the loops into vector
//! instructions.

/// The position of a piece in its text.
#[derive(Clone, Copy)]
pub(super) struct TextContext {
    /// The byte in front of the piece.
    pub(super) before: Option<u8>,
    /// Whether the piece ends the text.
    pub(super) is_last: bool,
}

impl TextContext {
    /// The context of a whole text.
    pub(super) const WHOLE: Self = Self {
        before: None,
        is_last: true,
    };
}

/// Whether all bytes are ASCII characters of content that need no escaping. With `guards_space`, this
/// is for a reader that condenses white space.
pub(super) fn is_plain(bytes: &[u8], guards_space: bool, context: TextContext) -> bool {
    (is_printable(bytes) || !guards_space && is_text(bytes))
        && memchr::memchr3(b'<', b'&', b'>', bytes).is_none()
        && (!guards_space || keeps_space(bytes, context))
}

/// Whether all bytes are ASCII characters without control characters. DEL is accepted.
fn is_printable(bytes: &[u8]) -> bool {
    // Other bytes wrap around or exceed the bound.
    let over = |byte: &u8| byte.wrapping_sub(b' ');
    // Two halves in parallel, so that neither waits for the other.
    let (one, other) = bytes.split_at(bytes.len() / 2);
    let both = one.iter().zip(other);
    let most = both.fold(0, |most: u8, (one, other)| {
        most.max(over(one).max(over(other)))
    });
    let last = bytes.last().map_or(0, over);
    most.max(last) < 0x60
}

/// Like [`is_printable`], but line feeds and tabs are accepted too.
fn is_text(bytes: &[u8]) -> bool {
    bytes.iter().fold(0, |others, byte| {
        let printable = byte.wrapping_sub(b' ') < 0x60;
        others | u8::from(!printable & (*byte != b'\n') & (*byte != b'\t'))
    }) == 0
}

/// Whether a reader that condenses white space reads bytes without control characters unchanged.
fn keeps_space(bytes: &[u8], context: TextContext) -> bool {
    let begins = bytes.first() == Some(&b' ') && context.before.is_none_or(|byte| byte == b' ');
    let ends = bytes.last() == Some(&b' ') && context.is_last;
    let behind = bytes.get(1..).unwrap_or_default();
    let doubled = bytes.iter().zip(behind).fold(false, |found, (one, next)| {
        found | ((*one == b' ') & (*next == b' '))
    });
    !begins && !ends && !doubled && memchr::memchr(b'"', bytes).is_none()
}
