//! Writer of XML 1.0. It escapes all text that a reader would otherwise change.

use crate::Dialect;
use crate::error::EncodeError;
use crate::scan::{self, TOPS};
use crate::word::is_token;
use crate::xml::plain::{TextContext, is_plain};

/// Writes a document.
pub(super) struct XmlWriter<'a> {
    out: &'a mut dyn crate::bitefficient::write::Output,
    /// Whether to escape white space that a condensing reader would change. fipa_services writes
    /// content in CDATA sections, and its reader may condense white space outside of them.
    guards_space: bool,
    /// Whether to write characters outside ASCII as references.
    ascii: bool,
}

impl<'a> XmlWriter<'a> {
    pub(super) fn new(
        out: &'a mut dyn crate::bitefficient::write::Output,
        dialect: Dialect,
    ) -> Self {
        Self {
            out,
            guards_space: dialect == Dialect::FipaServices,
            ascii: false,
        }
    }

    /// Writes characters outside ASCII as references, for a reader of another encoding than UTF-8.
    pub(super) fn in_ascii(self, ascii: bool) -> Self {
        Self { ascii, ..self }
    }

    /// Writes text that needs no escaping.
    pub(super) fn raw(&mut self, text: &str) {
        self.out.slice(text.as_bytes());
    }

    pub(super) fn open(&mut self, element: &str) {
        self.raw("<");
        self.raw(element);
        self.raw(">");
    }

    pub(super) fn close(&mut self, element: &str) {
        self.raw("</");
        self.raw(element);
        self.raw(">");
    }

    /// Writes an empty element with one attribute.
    pub(super) fn empty(
        &mut self,
        element: &str,
        attribute: &str,
        what: &'static str,
        value: &str,
    ) -> Result<(), EncodeError> {
        self.raw("<");
        self.raw(element);
        self.attribute(attribute, what, value)?;
        self.raw(" />");
        Ok(())
    }

    pub(super) fn attribute(
        &mut self,
        attribute: &str,
        what: &'static str,
        value: &str,
    ) -> Result<(), EncodeError> {
        self.raw(" ");
        self.raw(attribute);
        self.raw("=\"");
        self.text_trimmed(what, value)?;
        self.raw("\"");
        Ok(())
    }

    pub(super) fn element(
        &mut self,
        element: &str,
        what: &'static str,
        text: &str,
    ) -> Result<(), EncodeError> {
        self.open(element);
        self.text(what, text)?;
        self.close(element);
        Ok(())
    }

    /// Writes content. Line breaks and tabs are escaped only if the reader would change them. The
    /// content is copied before it is checked, because another process may change shared memory at
    /// any time.
    pub(super) fn content(&mut self, content: &[u8]) -> Result<(), EncodeError> {
        let guards_space = self.guards_space;
        let mut context = TextContext::WHOLE;
        let mut rest = content;
        while !rest.is_empty() {
            let (step, later) = rest.split_at(rest.len().min(STEP));
            context.is_last = later.is_empty();
            let plain = |bytes: &[u8]| is_plain(bytes, guards_space, context);
            if self.out.slice_if(step, &plain) {
                context.before = step.last().copied();
                rest = later;
                continue;
            }
            while rest.len() > later.len() {
                let whole = self.piece(rest, context.before)?;
                let (written, unwritten) = rest.split_at(whole);
                context.before = written.last().copied();
                rest = unwritten;
            }
        }
        Ok(())
    }

    /// Writes the first characters of content. Returns how many bytes they have.
    fn piece(&mut self, content: &[u8], before: Option<u8>) -> Result<usize, EncodeError> {
        let mut copy = [0; PIECE];
        let len = content.len().min(PIECE);
        let (copy, _) = copy.split_at_mut(len);
        copy.copy_from_slice(content.split_at(len).0);
        let is_last = len == content.len();
        let context = TextContext { before, is_last };
        if is_plain(copy, self.guards_space, context) {
            self.out.slice(copy);
            return Ok(len);
        }
        let text = match std::str::from_utf8(copy) {
            Ok(text) => text,
            // The last character continues in the next piece.
            Err(error) if error.error_len().is_none() && !is_last => {
                let (whole, _) = copy.split_at(error.valid_up_to());
                std::str::from_utf8(whole).unwrap_or_default()
            }
            Err(_) => {
                return Err(EncodeError::Unrepresentable {
                    what: "content",
                    why: "it is not UTF-8 text",
                });
            }
        };
        let context = TextContext {
            is_last: text.len() == content.len(),
            ..context
        };
        self.escaped("content", text, self.guards_space, context)?;
        Ok(text.len())
    }

    pub(super) fn text(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        self.escaped(what, text, true, TextContext::WHOLE)
    }

    /// Writes text for a reader that removes the white space around it. That white space is escaped.
    pub(super) fn text_trimmed(
        &mut self,
        what: &'static str,
        text: &str,
    ) -> Result<(), EncodeError> {
        let inner = text.trim_start_matches(' ');
        let before = text.len() - inner.len();
        let core = inner.trim_end_matches(' ');
        self.spaces(before);
        self.escaped(what, core, true, TextContext::WHOLE)?;
        self.spaces(inner.len() - core.len());
        Ok(())
    }

    fn spaces(&mut self, count: usize) {
        for _ in 0..count {
            self.raw("&#x20;");
        }
    }

    /// Writes a user-defined parameter in the form of the standards. Peers write a type too.
    pub(super) fn user_defined(
        &mut self,
        name: &str,
        value: &str,
        typed: bool,
    ) -> Result<(), EncodeError> {
        if !is_token(name) {
            let shown = name.chars().take(60).collect();
            return Err(EncodeError::UserDefinedName(shown));
        }
        self.check_guarded(value)?;
        self.raw("<user-defined");
        self.attribute("href", USER_DEFINED, &format!("X-{name}"))?;
        self.raw(if typed { " type=\"string\">" } else { ">" });
        self.text(USER_DEFINED, value)?;
        self.close("user-defined");
        Ok(())
    }

    /// Writes a user-defined parameter as an element with its name.
    pub(super) fn user_element(&mut self, name: &str, value: &str) -> Result<(), EncodeError> {
        check_element_name(name)?;
        self.element(&format!("X-{name}"), USER_DEFINED, value)
    }

    /// Writes a user-defined parameter as an element with its name, which `href` repeats:
    /// `<X-role href="X-role" type="string">lifts</X-role>`.
    pub(super) fn user_element_with_name(
        &mut self,
        name: &str,
        value: &str,
    ) -> Result<(), EncodeError> {
        check_element_name(name)?;
        self.check_guarded(value)?;
        let element = format!("X-{name}");
        self.raw("<");
        self.raw(&element);
        self.attribute("href", USER_DEFINED, &element)?;
        self.raw(" type=\"string\">");
        self.text(USER_DEFINED, value)?;
        self.close(&element);
        Ok(())
    }

    /// Refuses an empty user-defined parameter if the reader would lose it.
    fn check_guarded(&self, value: &str) -> Result<(), EncodeError> {
        if self.guards_space && value.is_empty() {
            return Err(EncodeError::Unrepresentable {
                what: USER_DEFINED,
                why: "fipa_services does not read an empty one in XML",
            });
        }
        Ok(())
    }

    fn escaped(
        &mut self,
        what: &'static str,
        text: &str,
        layout: bool,
        context: TextContext,
    ) -> Result<(), EncodeError> {
        let looked_for = if self.guards_space {
            MARK | SPACE
        } else {
            MARK
        };
        let bytes = text.as_bytes();
        let mut plain = 0;
        let mut from = 0;
        while let Some(found) = bytes.get(from..).and_then(|rest| marked(rest, looked_for)) {
            let at = from + found;
            from = at + 1;
            // A space may be in front of the text.
            let condensed = || {
                let before = match at.checked_sub(1) {
                    Some(before) => bytes.get(before).copied(),
                    None => context.before,
                };
                before.is_none_or(|byte| byte == b' ') || context.is_last && from == bytes.len()
            };
            let escape = match bytes.get(at..).unwrap_or_default() {
                [b' ', ..] if condensed() => "&#x20;",
                [b'<', ..] => "&lt;",
                [b'>', ..] => "&gt;",
                [b'&', ..] => "&amp;",
                [b'"', ..] if layout => "&quot;",
                [b'\r', ..] => "&#x0D;",
                [b'\n', ..] if layout => "&#x0A;",
                [b'\t', ..] if layout => "&#x09;",
                [b' ' | b'"' | b'\n' | b'\t', ..] => continue,
                // U+FFFE and U+FFFF.
                [0..=0x1f, ..] | [0xef, 0xbf, 0xbe | 0xbf, ..] => {
                    return Err(EncodeError::Unrepresentable {
                        what,
                        why: "XML cannot represent its control characters",
                    });
                }
                _ => continue,
            };
            self.unescaped(text.get(plain..at).unwrap_or_default());
            self.raw(escape);
            plain = from;
        }
        self.unescaped(text.get(plain..).unwrap_or_default());
        Ok(())
    }

    /// Writes text without characters that XML escapes.
    fn unescaped(&mut self, text: &str) {
        if !self.ascii || text.is_ascii() {
            self.raw(text);
            return;
        }
        for character in text.chars() {
            if character.is_ascii() {
                self.raw(character.encode_utf8(&mut [0; 4]));
            } else {
                self.raw(&format!("&#x{:X};", u32::from(character)));
            }
        }
    }
}

/// The name of a user-defined parameter in errors.
const USER_DEFINED: &str = "user-defined parameter";

/// Refuses a name of a user-defined parameter that readers do not accept as an element name.
fn check_element_name(name: &str) -> Result<(), EncodeError> {
    let allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    if name.is_empty() || !name.bytes().all(allowed) {
        return Err(EncodeError::Unrepresentable {
            what: USER_DEFINED,
            why: "its name must consist of letters, digits, '-', '_' and '.'",
        });
    }
    Ok(())
}

/// Number of bytes of content that are copied and checked at a time. They fit into the processor's
/// cache.
const STEP: usize = 16 << 10;

/// Number of bytes of content that are escaped at a time.
const PIECE: usize = 4096;

/// Returns the position of the first byte of the classes `looked_for`.
fn marked(bytes: &[u8], looked_for: u8) -> Option<usize> {
    let mut before = 0;
    // Content may be long, so eight bytes are checked at a time. '"' and '&' differ in one bit, and
    // so do '<' and '>'.
    let eights = |byte: u8| u64::from_le_bytes([byte; 8]);
    for eight in bytes.as_chunks::<8>().0 {
        let word = u64::from_le_bytes(*eight);
        let mut marks = scan::below(word, 0x20)
            | scan::is(word & eights(!0x04), b'"')
            | scan::is(word & eights(!0x02), b'<')
            | scan::is(word, 0xef);
        if looked_for & SPACE != 0 {
            marks |= scan::is(word, b' ');
        }
        if marks & TOPS != 0 {
            break;
        }
        before += eight.len();
    }
    let class = |byte: u8| CLASS.get(usize::from(byte)).copied().unwrap_or_default();
    let rest = bytes.get(before..)?.iter();
    let found = rest
        .copied()
        .position(|byte| class(byte) & looked_for != 0)?;
    Some(before + found)
}

/// Class of bytes that may need an escape or be refused.
const MARK: u8 = 1;
/// Class of the space.
const SPACE: u8 = 2;

/// The class of each byte. A lookup is fast for long content.
static CLASS: [u8; 256] = {
    let mut class = [0; 256];
    let mut byte = 0;
    while byte < class.len() {
        class[byte] = match byte {
            0..=0x1f | 0x22 | 0x26 | 0x3c | 0x3e | 0xef => MARK,
            0x20 => SPACE,
            _ => 0,
        };
        byte += 1;
    }
    class
};
