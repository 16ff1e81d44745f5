//! A parser of XML elements in untrusted input: no allocation, bounded depth, linear time, an offset
//! in every error.
//!
//! It reads tags, text, CDATA sections and references to characters of XML 1.0. It skips comments,
//! processing instructions and the name of a document type. The only entities are the five of XML.
//! Text and CDATA sections need not be UTF-8, because fipa_services writes any bytes there.

use memchr::memmem;

use crate::error::{DecodeError, Problem};
use crate::scan;
use crate::xml::tag::Tag;
use crate::xml::value::{Piece, Value};

/// Maximum nesting depth of elements. Resolvers of the maximum depth need less.
const MAX_DEPTH: usize = 64;

const CDATA: &[u8] = b"<![CDATA[";

/// A pull parser of the elements of a document.
#[derive(Debug, Clone)]
pub(super) struct Elements<'a> {
    bytes: &'a [u8],
    /// The bytes that were not read yet.
    rest: &'a [u8],
    pub(super) clause: &'static str,
    /// The names of the open elements. Only the first `depth` are valid.
    open: [&'a [u8]; MAX_DEPTH],
    depth: usize,
    /// Offset of the item that was read last.
    begin: usize,
    /// Whether the current element is an empty one, with a pending end event.
    ends: bool,
    /// Whether the bytes may end elements that began in front of them.
    inside: bool,
}

/// An item of a document.
pub(super) enum Event<'a> {
    Start(Element<'a>),
    End,
    Text(Piece<'a>),
}

impl<'a> Elements<'a> {
    /// Parses bytes that begin with a document. Errors have the clause.
    pub(super) fn new(bytes: &'a [u8], clause: &'static str) -> Self {
        Self {
            bytes,
            rest: bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes),
            clause,
            open: [&[]; MAX_DEPTH],
            depth: 0,
            begin: 0,
            ends: false,
            inside: false,
        }
    }

    /// Parses checked bytes from inside a document.
    pub(super) fn inside(bytes: &'a [u8]) -> Self {
        Self {
            rest: bytes,
            inside: true,
            ..Self::new(bytes, "")
        }
    }

    /// Reads the start of the outermost element, which must have this tag.
    pub(super) fn root(
        &mut self,
        tag: Tag,
        problem: &'static str,
    ) -> Result<Element<'a>, DecodeError> {
        loop {
            let offset = self.position();
            match self.next()? {
                Some(Event::Start(element)) if element.tag == tag => return Ok(element),
                Some(Event::Text(text)) if text.is_blank() => {}
                None => return Err(self.truncated()),
                _ => return Err(self.error(offset, Problem::Xml(problem))),
            }
        }
    }

    /// Reads the start of the next element in the current element. Returns `None` at the end of the
    /// current element. The caller must read the returned element to its end with this function,
    /// with [`value`](Self::value) or with [`skip`](Self::skip).
    pub(super) fn child(&mut self) -> Result<Option<Element<'a>>, DecodeError> {
        loop {
            match self.next()? {
                Some(Event::Start(element)) => return Ok(Some(element)),
                Some(Event::End) => return Ok(None),
                Some(Event::Text(_)) => {}
                None => return Err(self.truncated()),
            }
        }
    }

    /// Reads the current element, including its end. Its value is the first of `attributes` that is
    /// not empty, or its text, or the value of a `url` inside, in this order.
    pub(super) fn value(
        &mut self,
        element: &Element<'a>,
        attributes: &[&str],
    ) -> Result<Value<'a>, DecodeError> {
        let mut attribute = None;
        for name in attributes {
            let value = self.attribute(element, name)?;
            attribute = attribute.or(value.filter(|value| !value.is_empty()));
        }
        let start = self.position();
        let mut text = Value::new(start, self.clause);
        if let Some(raw) = self.whole_text() {
            text.all = raw;
            text.add(Piece::text(raw, start));
            return Ok(attribute.unwrap_or(text));
        }
        let mut inner = None;
        loop {
            match self.next()? {
                Some(Event::Text(piece)) => text.add(piece),
                Some(Event::Start(child)) if child.tag == Tag::Url => {
                    inner = Some(self.value(&child, &["href"])?);
                }
                Some(Event::Start(_)) => self.skip()?,
                Some(Event::End) => break,
                None => return Err(self.truncated()),
            }
        }
        text.all = self.bytes.get(start..self.begin).unwrap_or_default();
        Ok(match (attribute, inner) {
            (Some(attribute), _) => attribute,
            (None, Some(inner)) if text.is_blank() => inner,
            (None, _) => text,
        })
    }

    /// Reads the current element, including its end, in the common case: it has only a text.
    #[inline]
    fn whole_text(&mut self) -> Option<&'a [u8]> {
        if self.ends {
            return None;
        }
        let depth = self.depth.checked_sub(1)?;
        let len = scan::find_byte(self.rest, b'<')?;
        let (text, tag) = self.rest.split_at_checked(len)?;
        let behind = tag
            .strip_prefix(b"</")?
            .strip_prefix(*self.open.get(depth)?)?;
        let rest = behind.strip_prefix(b">")?;
        self.begin = self.position() + len;
        self.rest = rest;
        self.depth = depth;
        Some(text)
    }

    /// Reads the current element, including its end, as text without markup. It ends with the last
    /// end tag of its name before the next start tag that `follows`, or before the end of the parent.
    ///
    /// # Errors
    /// There is no such end tag, or it is followed by more than white space.
    pub(super) fn raw(
        &mut self,
        follows: impl Fn(&Element<'a>) -> bool,
    ) -> Result<&'a [u8], DecodeError> {
        let malformed = Problem::Xml("an element with unescaped text has no clear end");
        let error = self.error(self.position(), malformed);
        let depth = self.depth.checked_sub(1).filter(|_| !self.ends);
        let depth = depth.ok_or_else(|| error.clone())?;
        let own = self.open.get(depth).copied().unwrap_or_default();
        let parent = depth.checked_sub(1).and_then(|depth| self.open.get(depth));
        let parent = parent.copied().unwrap_or_default();
        let (text, mut at, mut end) = (self.rest, 0, None);
        loop {
            let found = text.get(at..).and_then(|rest| scan::find_byte(rest, b'<'));
            at += found.ok_or_else(|| error.clone())?;
            let behind = text.get(at + 1..).unwrap_or_default();
            let (is_end, behind) = match behind.strip_prefix(b"/") {
                Some(behind) => (true, behind),
                None => (false, behind),
            };
            let ends = |byte: &u8| byte.is_ascii_whitespace() || matches!(byte, b'>' | b'<' | b'/');
            let len = behind.iter().position(ends).unwrap_or(behind.len());
            let (name, behind) = behind.split_at(len);
            if is_end && name == own {
                if let Some(rest) = behind.trim_ascii_start().strip_prefix(b">") {
                    end = Some((at, rest));
                }
            } else if is_end && name == parent {
                break;
            } else if !is_end {
                let element = Element {
                    tag: Tag::of(local(name)),
                    name,
                    attributes: &[],
                    offset: self.position() + at,
                };
                if follows(&element) {
                    break;
                }
            }
            at += 1;
        }
        let (len, rest) = end.ok_or_else(|| error.clone())?;
        let between = text.len() - rest.len();
        let between = text.get(between..at).unwrap_or_default();
        if !between.trim_ascii().is_empty() {
            return Err(error);
        }
        self.begin = self.position() + len;
        self.rest = rest;
        self.depth = depth;
        Ok(text.get(..len).unwrap_or_default())
    }

    /// Skips the current element, including its end.
    pub(super) fn skip(&mut self) -> Result<(), DecodeError> {
        let outside = self.depth.saturating_sub(1);
        while self.depth > outside {
            if self.next()?.is_none() {
                return Err(self.truncated());
            }
        }
        Ok(())
    }

    /// Returns the value of an attribute. The case and the prefix of its name are ignored.
    pub(super) fn attribute(
        &self,
        element: &Element<'a>,
        name: &str,
    ) -> Result<Option<Value<'a>>, DecodeError> {
        let malformed = || self.error(element.offset, Problem::Xml("malformed attribute"));
        let mut rest = element.attributes;
        loop {
            rest = rest.trim_ascii_start();
            if rest.is_empty() {
                return Ok(None);
            }
            let ends = |byte: &u8| *byte == b'=' || byte.is_ascii_whitespace();
            let len = rest.iter().position(ends).ok_or_else(malformed)?;
            let (key, behind) = rest.split_at(len);
            let behind = behind.trim_ascii_start().strip_prefix(b"=");
            let (quote, inside) = match behind.ok_or_else(malformed)?.trim_ascii_start() {
                [quote @ (b'"' | b'\''), inside @ ..] => (*quote, inside),
                _ => return Err(malformed()),
            };
            let len = scan::find_byte(inside, quote).ok_or_else(malformed)?;
            let (value, behind) = inside.split_at(len);
            rest = behind.get(1..).unwrap_or_default();
            if local(key).eq_ignore_ascii_case(name.as_bytes()) {
                return Ok(Some(Value::attribute(value, element.offset, self.clause)));
            }
        }
    }

    /// Number of bytes read.
    pub(super) fn position(&self) -> usize {
        self.bytes.len() - self.rest.len()
    }

    /// The bytes that were not read yet.
    pub(super) fn rest(&self) -> &'a [u8] {
        self.rest
    }

    /// Offset of the item that was read last.
    pub(super) fn begin(&self) -> usize {
        self.begin
    }

    /// All the bytes.
    pub(super) fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Checks that only white space, comments and processing instructions follow.
    pub(super) fn finish(mut self) -> Result<(), DecodeError> {
        loop {
            self.rest = self.rest.trim_ascii_start();
            if self.rest.is_empty() {
                return Ok(());
            }
            if !self.rest.starts_with(b"<!--") && !self.rest.starts_with(b"<?") {
                let problem = Problem::Trailing(self.rest.len());
                return Err(self.error(self.position(), problem));
            }
            self.skip_markup()?;
        }
    }

    pub(super) fn error(&self, offset: usize, problem: Problem) -> DecodeError {
        DecodeError::new(offset, self.clause, problem)
    }

    #[cold]
    pub(super) fn truncated(&self) -> DecodeError {
        self.error(self.position(), Problem::Truncated("an element"))
    }

    /// Reads the next event. Returns `None` at the end of the bytes.
    pub(super) fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError> {
        self.begin = self.position();
        if self.ends {
            self.ends = false;
            self.depth = self.depth.saturating_sub(1);
            return Ok(Some(Event::End));
        }
        loop {
            self.begin = self.position();
            match self.rest {
                [] => return Ok(None),
                [b'<', b'/', behind @ ..] => return self.end_tag(behind).map(Some),
                [b'<', b'!', ..] if self.rest.starts_with(CDATA) => {
                    return self.cdata().map(Some);
                }
                [b'<', b'!' | b'?', ..] => self.skip_markup()?,
                [b'<', behind @ ..] => return self.start_tag(behind).map(Some),
                _ => {
                    let len = scan::find_byte(self.rest, b'<').unwrap_or(self.rest.len());
                    let (raw, rest) = self.rest.split_at(len);
                    self.rest = rest;
                    let offset = self.begin;
                    return Ok(Some(Event::Text(Piece::text(raw, offset))));
                }
            }
        }
    }

    fn start_tag(&mut self, behind: &'a [u8]) -> Result<Event<'a>, DecodeError> {
        let truncated = || self.error(self.begin, Problem::Truncated("markup"));
        let ends = |word| scan::is(word, b'>') | scan::below(word, 0x21);
        let len = scan::find(behind, ends, |byte| byte == b'>' || byte <= b' ');
        let len = len.ok_or_else(truncated)?;
        let (name, behind) = behind.split_at(len);
        let (attributes, rest) = markup(behind).ok_or_else(truncated)?;
        let (name, attributes, is_empty) = match (name, attributes) {
            ([name @ .., b'/'], []) => (name, attributes, true),
            (name, [attributes @ .., b'/']) => (name, attributes, true),
            _ => (name, attributes, false),
        };
        let tag = match Tag::of(name) {
            Tag::Other => Tag::of(local(name)),
            tag => tag,
        };
        self.rest = rest;
        self.ends = is_empty;
        match self.open.get_mut(self.depth) {
            Some(open) => *open = name,
            None => return Err(self.error(self.begin, Problem::TooDeep("elements"))),
        }
        self.depth += 1;
        Ok(Event::Start(Element {
            tag,
            name,
            attributes,
            offset: self.begin,
        }))
    }

    fn end_tag(&mut self, behind: &'a [u8]) -> Result<Event<'a>, DecodeError> {
        let wrong = Problem::Xml("an end tag does not match its start tag");
        let open = match self.depth.checked_sub(1) {
            Some(depth) => {
                self.depth = depth;
                self.open.get(depth).copied().unwrap_or_default()
            }
            None if self.inside => {
                // The name was compared when the bytes were checked.
                let end = scan::find_byte(behind, b'>').and_then(|end| behind.get(end + 1..));
                self.rest = end.unwrap_or_default();
                return Ok(Event::End);
            }
            None => return Err(self.error(self.begin, wrong)),
        };
        match behind.strip_prefix(open) {
            Some([b'>', rest @ ..]) => self.rest = rest,
            Some([b' ' | b'\t' | b'\n' | b'\r', rest @ ..]) => match rest.trim_ascii_start() {
                [b'>', rest @ ..] => self.rest = rest,
                [] => return Err(self.error(self.begin, Problem::Truncated("markup"))),
                _ => return Err(self.error(self.begin, wrong)),
            },
            _ if scan::find_byte(behind, b'>').is_none() => {
                return Err(self.error(self.begin, Problem::Truncated("markup")));
            }
            _ => return Err(self.error(self.begin, wrong)),
        }
        Ok(Event::End)
    }

    fn cdata(&mut self) -> Result<Event<'a>, DecodeError> {
        let inside = self.rest.get(CDATA.len()..).unwrap_or_default();
        let Some(len) = memmem::find(inside, b"]]>") else {
            let problem = Problem::Truncated("a CDATA section");
            return Err(self.error(self.begin, problem));
        };
        self.rest = inside.get(len + 3..).unwrap_or_default();
        let raw = inside.get(..len).unwrap_or_default();
        Ok(Event::Text(Piece::literal(raw, self.begin + CDATA.len())))
    }

    /// Skips a comment, a processing instruction or a document type, which must be next.
    fn skip_markup(&mut self) -> Result<(), DecodeError> {
        let offset = self.position();
        let (opening, end): (usize, &[u8]) = match self.rest {
            [b'<', b'!', b'-', b'-', ..] => (4, b"-->"),
            [b'<', b'?', ..] => (2, b"?>"),
            [b'<', b'!', name @ ..]
                if name
                    .get(..7)
                    .is_some_and(|name| name.eq_ignore_ascii_case(b"DOCTYPE")) =>
            {
                let Some((inside, rest)) = markup(name) else {
                    return Err(self.error(offset, Problem::Truncated("markup")));
                };
                if inside.contains(&b'[') {
                    let problem = Problem::Xml("an internal document type is not supported");
                    return Err(self.error(offset, problem));
                }
                self.rest = rest;
                return Ok(());
            }
            _ => return Err(self.error(offset, Problem::Xml("malformed markup"))),
        };
        let inside = self.rest.get(opening..).unwrap_or_default();
        let mut rest = inside;
        loop {
            let Some(found) = scan::find_byte(rest, b'>') else {
                return Err(self.error(offset, Problem::Truncated("markup")));
            };
            rest = rest.get(found + 1..).unwrap_or_default();
            let read = inside.len() - rest.len();
            if inside.get(..read).is_some_and(|read| read.ends_with(end)) {
                self.rest = rest;
                return Ok(());
            }
        }
    }
}

/// Splits bytes at the `>` that ends a tag. The values of its attributes may contain others.
#[inline]
fn markup(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    if let [b'>', behind @ ..] = bytes {
        return Some((&[], behind));
    }
    markup_slow(bytes)
}

fn markup_slow(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let mut len = 0;
    loop {
        let rest = bytes.get(len..)?;
        let marks = |word| scan::is(word, b'>') | scan::is(word, b'"') | scan::is(word, b'\'');
        len += scan::find(rest, marks, |byte| matches!(byte, b'>' | b'"' | b'\''))?;
        let (inside, behind) = bytes.split_at_checked(len)?;
        let (mark, behind) = behind.split_first()?;
        if *mark == b'>' {
            return Some((inside, behind));
        }
        len += 1 + scan::find_byte(behind, *mark)? + 1;
    }
}

/// The start of an element.
pub(super) struct Element<'a> {
    pub(super) tag: Tag,
    /// The name with its prefix.
    name: &'a [u8],
    attributes: &'a [u8],
    /// Offset of the element.
    pub(super) offset: usize,
}

impl<'a> Element<'a> {
    /// Returns the name of the user-defined parameter that an element `X-name` stands for.
    pub(super) fn user_defined(&self) -> Option<&'a [u8]> {
        match self.name {
            [b'X' | b'x', b'-', name @ ..] if !name.is_empty() => Some(name),
            _ => None,
        }
    }
}

fn local(name: &[u8]) -> &[u8] {
    // Names are a few bytes long. A vectorized search takes longer.
    let colon = name.iter().rposition(|byte| *byte == b':');
    colon.map_or(name, |colon| name.get(colon + 1..).unwrap_or_default())
}
