//! Walking over XML elements without trust: bounded depth, offsets in every error, linear time.
//!
//! quick-xml reads the tags. Text and CDATA sections are cut out here, because fipa_services puts
//! any bytes there, which quick-xml would have to be UTF-8.

use std::borrow::Cow;
use std::io::BufRead as _;

use memchr::{memchr, memmem};
use quick_xml::errors::{Error, IllFormedError, SyntaxError};
use quick_xml::events::Event as Markup;
use quick_xml::events::attributes::Attributes;

use crate::Time;
use crate::error::{DecodeError, Problem};

/// Deepest nesting of elements: more than resolvers nested as deep as they may be need.
const MAX_DEPTH: usize = 64;

/// Longest reference to a character, from `&` to `;`.
const MAX_REFERENCE: usize = 12;

const CDATA: &[u8] = b"<![CDATA[";

/// The elements of a document, in their order.
pub(super) struct Elements<'a> {
    reader: quick_xml::Reader<&'a [u8]>,
    len: usize,
    clause: &'static str,
    /// Elements that are open.
    depth: usize,
    /// The element that began last was an empty one, and its end is still to be told.
    ends: bool,
}

enum Event<'a> {
    Start(Element<'a>),
    End,
    Text(Piece<'a>),
}

impl<'a> Elements<'a> {
    /// The elements in bytes that begin with a document; errors will name the clause.
    pub(super) fn new(bytes: &'a [u8], clause: &'static str) -> Self {
        let document = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        Self {
            reader: quick_xml::Reader::from_reader(document),
            len: bytes.len(),
            clause,
            depth: 0,
            ends: false,
        }
    }

    /// The outermost element, which must have this name.
    pub(super) fn root(
        &mut self,
        name: &str,
        problem: &'static str,
    ) -> Result<Element<'a>, DecodeError> {
        loop {
            let offset = self.position();
            match self.next()? {
                Event::Start(element) if element.is(name) => return Ok(element),
                Event::Text(text) if text.is_blank() => {}
                _ => return Err(self.error(offset, Problem::Xml(problem))),
            }
        }
    }

    /// The next element inside the one that was begun last, or `None` at its end. What was given
    /// must be read to its end: with this, with [`value`](Self::value) or [`skip`](Self::skip).
    pub(super) fn child(&mut self) -> Result<Option<Element<'a>>, DecodeError> {
        loop {
            match self.next()? {
                Event::Start(element) => return Ok(Some(element)),
                Event::End => return Ok(None),
                Event::Text(_) => {}
            }
        }
    }

    /// Reads the element, which was begun last, to its end. Its value is the first of these
    /// attributes that is there and not empty, else its text, else the value of a `url` inside.
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
        let mut text = Value::new(self.position(), self.clause);
        let mut inner = None;
        loop {
            match self.next()? {
                Event::Text(piece) => text.pieces.push(piece),
                Event::Start(child) if child.is("url") => {
                    inner = Some(self.value(&child, &["href"])?);
                }
                Event::Start(_) => self.skip()?,
                Event::End => break,
            }
        }
        Ok(match (attribute, inner) {
            (Some(attribute), _) => attribute,
            (None, Some(inner)) if text.is_blank() => inner,
            (None, _) => text,
        })
    }

    /// Reads the element that was begun last to its end.
    pub(super) fn skip(&mut self) -> Result<(), DecodeError> {
        let outside = self.depth.saturating_sub(1);
        while self.depth > outside {
            self.next()?;
        }
        Ok(())
    }

    /// The value of an attribute.
    pub(super) fn attribute(
        &self,
        element: &Element<'a>,
        name: &str,
    ) -> Result<Option<Value<'a>>, DecodeError> {
        let mut attributes = Attributes::new(element.markup, element.name.len());
        // Looking for duplicates takes quadratic time.
        for attribute in attributes.with_checks(false) {
            let problem = Problem::Xml("malformed attribute");
            let attribute = attribute.map_err(|_| self.error(element.offset, problem))?;
            if local(attribute.key.into_inner()).eq_ignore_ascii_case(name)
                && let Cow::Borrowed(raw) = attribute.value
            {
                let mut value = Value::new(element.offset, self.clause);
                value.pieces.push(Piece {
                    raw: raw.as_bytes(),
                    offset: element.offset,
                    literal: false,
                });
                return Ok(Some(value));
            }
        }
        Ok(None)
    }

    /// How many bytes were read.
    pub(super) fn position(&self) -> usize {
        self.len - self.reader.get_ref().len()
    }

    /// Checks that nothing but white space, comments and instructions follows.
    pub(super) fn finish(mut self) -> Result<(), DecodeError> {
        loop {
            let rest = self.reader.get_ref().trim_ascii_start();
            let blank = self.reader.get_ref().len() - rest.len();
            self.reader.stream().consume(blank);
            if rest.is_empty() {
                return Ok(());
            }
            if !rest.starts_with(b"<!--") && !rest.starts_with(b"<?") {
                return Err(self.error(self.position(), Problem::Trailing(rest.len())));
            }
            self.markup()?;
        }
    }

    pub(super) fn error(&self, offset: usize, problem: Problem) -> DecodeError {
        DecodeError::new(offset, self.clause, problem)
    }

    fn next(&mut self) -> Result<Event<'a>, DecodeError> {
        if self.ends {
            self.ends = false;
            return Ok(self.end());
        }
        loop {
            let rest: &'a [u8] = self.reader.get_ref();
            let offset = self.position();
            if rest.starts_with(CDATA) {
                let Some(end) = memmem::find(rest, b"]]>") else {
                    return Err(self.error(offset, Problem::Truncated("a CDATA section")));
                };
                self.reader.stream().consume(end + 3);
                return Ok(Event::Text(Piece {
                    raw: rest.get(CDATA.len()..end).unwrap_or_default(),
                    offset: offset + CDATA.len(),
                    literal: true,
                }));
            }
            let until_markup = memchr(b'<', rest).unwrap_or(rest.len());
            if let Some(raw @ [_, ..]) = rest.get(..until_markup) {
                self.reader.stream().consume(until_markup);
                return Ok(Event::Text(Piece {
                    raw,
                    offset,
                    literal: false,
                }));
            }
            let (begins, name_len) = match self.markup()? {
                Markup::Start(tag) => (true, tag.name().into_inner().len()),
                Markup::Empty(tag) => {
                    self.ends = true;
                    (true, tag.name().into_inner().len())
                }
                Markup::End(_) => return Ok(self.end()),
                Markup::Eof => {
                    return Err(self.error(offset, Problem::Truncated("an element")));
                }
                Markup::DocType(text) if text.contains('[') => {
                    let problem = Problem::Xml("an internal document type is not accepted");
                    return Err(self.error(offset, problem));
                }
                _ => (false, 0),
            };
            if begins {
                self.depth += 1;
                if self.depth > MAX_DEPTH {
                    return Err(self.error(offset, Problem::TooDeep("elements")));
                }
                let tag = rest.get(1..self.position() - offset - 1);
                return self.element(tag.unwrap_or_default(), name_len, offset);
            }
        }
    }

    fn end(&mut self) -> Event<'a> {
        self.depth = self.depth.saturating_sub(1);
        Event::End
    }

    /// `tag`: what is between the angle brackets.
    fn element(
        &self,
        tag: &'a [u8],
        name_len: usize,
        offset: usize,
    ) -> Result<Event<'a>, DecodeError> {
        let not_utf8 = |_| self.error(offset, Problem::NotUtf8("tag"));
        let tag = std::str::from_utf8(tag).map_err(not_utf8)?;
        let markup = tag.strip_suffix('/').unwrap_or(tag);
        let name = markup.get(..name_len).unwrap_or(markup);
        Ok(Event::Start(Element {
            markup,
            name,
            local: local(name),
            offset,
        }))
    }

    /// Lets quick-xml read one piece of markup.
    fn markup(&mut self) -> Result<Markup<'a>, DecodeError> {
        let offset = self.position();
        self.reader.read_event().map_err(|error| {
            let problem = match error {
                Error::Syntax(SyntaxError::InvalidBangMarkup) => Problem::Xml("malformed markup"),
                Error::Syntax(_) => Problem::Truncated("markup"),
                Error::IllFormed(
                    IllFormedError::MismatchedEndTag { .. } | IllFormedError::UnmatchedEndTag(_),
                ) => Problem::Xml("an end tag does not match its start tag"),
                Error::Encoding(_) => Problem::NotUtf8("tag"),
                _ => Problem::Xml("malformed markup"),
            };
            DecodeError::new(offset, self.clause, problem)
        })
    }
}

/// The beginning of an element.
pub(super) struct Element<'a> {
    /// Name and attributes.
    markup: &'a str,
    name: &'a str,
    /// The name without its prefix.
    local: &'a str,
    /// Where it begins.
    pub(super) offset: usize,
}

impl<'a> Element<'a> {
    /// Whether it has this name, in any case and with any prefix.
    pub(super) fn is(&self, name: &str) -> bool {
        self.local.eq_ignore_ascii_case(name)
    }

    /// The name of the user-defined parameter that it stands for: what follows `X-`.
    pub(super) fn user_defined(&self) -> Option<&'a str> {
        let prefix = self.name.get(..2)?.eq_ignore_ascii_case("x-");
        self.name.get(2..).filter(|name| prefix && !name.is_empty())
    }
}

fn local(name: &str) -> &str {
    // Names are a few bytes long: a vectorised search takes longer.
    let colon = name.bytes().rposition(|byte| byte == b':');
    colon.map_or(name, |colon| name.get(colon + 1..).unwrap_or_default())
}

/// Text, or the value of an attribute, still escaped.
pub(super) struct Value<'a> {
    pieces: Vec<Piece<'a>>,
    pub(super) offset: usize,
    clause: &'static str,
}

#[derive(Clone, Copy)]
struct Piece<'a> {
    raw: &'a [u8],
    offset: usize,
    /// From a CDATA section, where nothing is escaped.
    literal: bool,
}

impl Piece<'_> {
    fn is_blank(&self) -> bool {
        !self.literal && self.raw.trim_ascii().is_empty()
    }
}

impl<'a> Value<'a> {
    fn new(offset: usize, clause: &'static str) -> Self {
        Self {
            pieces: Vec::new(),
            offset,
            clause,
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.pieces.iter().all(|piece| piece.raw.is_empty())
    }

    fn is_blank(&self) -> bool {
        self.pieces.iter().all(Piece::is_blank)
    }

    /// The bytes as they are meant: copied only when they are in pieces or escaped.
    pub(super) fn bytes(&self) -> Result<Cow<'a, [u8]>, DecodeError> {
        match &self.pieces[..] {
            [] => return Ok(Cow::Borrowed(&[])),
            [one] if one.literal || memchr(b'&', one.raw).is_none() => {
                return Ok(Cow::Borrowed(one.raw));
            }
            _ => {}
        }
        let mut out = Vec::with_capacity(self.pieces.iter().map(|piece| piece.raw.len()).sum());
        for piece in &self.pieces {
            if piece.literal {
                out.extend_from_slice(piece.raw);
            } else {
                self.unescape(*piece, &mut out)?;
            }
        }
        Ok(Cow::Owned(out))
    }

    /// The text, with its white space.
    pub(super) fn text(&self, what: &'static str) -> Result<String, DecodeError> {
        let wrong = |problem| DecodeError::new(self.offset, self.clause, problem);
        let text = String::from_utf8(self.bytes()?.into_owned())
            .map_err(|_| wrong(Problem::NotUtf8(what)))?;
        if text.contains('\0') {
            return Err(wrong(Problem::Nul(what)));
        }
        Ok(text)
    }

    /// The text without the white space around it, unless that is escaped.
    pub(super) fn trimmed(mut self, what: &'static str) -> Result<String, DecodeError> {
        if let Some(first) = self.pieces.first_mut().filter(|piece| !piece.literal) {
            let trimmed = first.raw.trim_ascii_start();
            first.offset += first.raw.len() - trimmed.len();
            first.raw = trimmed;
        }
        if let Some(last) = self.pieces.last_mut().filter(|piece| !piece.literal) {
            last.raw = last.raw.trim_ascii_end();
        }
        self.text(what)
    }

    /// The date and time that it says.
    pub(super) fn time(self) -> Result<Time, DecodeError> {
        let error = DecodeError::new(self.offset, self.clause, Problem::DateTime);
        self.trimmed("date")?.parse().map_err(|_| error)
    }

    fn unescape(&self, piece: Piece<'_>, out: &mut Vec<u8>) -> Result<(), DecodeError> {
        let mut rest = piece.raw;
        while let Some(start) = memchr(b'&', rest) {
            let (before, reference) = rest.split_at(start);
            out.extend_from_slice(before);
            let shown = reference.get(..MAX_REFERENCE).unwrap_or(reference);
            let end = memchr(b';', shown).unwrap_or(0);
            let Some(character) = reference.get(1..end).and_then(character) else {
                let offset = piece.offset + (piece.raw.len() - reference.len());
                let problem = Problem::Xml("no such entity or character");
                return Err(DecodeError::new(offset, self.clause, problem));
            };
            out.extend_from_slice(character.encode_utf8(&mut [0; 4]).as_bytes());
            rest = reference.get(end + 1..).unwrap_or_default();
        }
        out.extend_from_slice(rest);
        Ok(())
    }
}

/// The character that is meant by what stands between `&` and `;`.
fn character(reference: &[u8]) -> Option<char> {
    let number = match reference {
        b"lt" => return Some('<'),
        b"gt" => return Some('>'),
        b"amp" => return Some('&'),
        b"quot" => return Some('"'),
        b"apos" => return Some('\''),
        [b'#', b'x' | b'X', digits @ ..] => (digits, 16),
        [b'#', digits @ ..] => (digits, 10),
        _ => return None,
    };
    let (digits, radix) = number;
    let digits = std::str::from_utf8(digits).ok()?;
    if digits.starts_with('+') {
        return None;
    }
    let code = u32::from_str_radix(digits, radix).ok()?;
    char::from_u32(code).filter(|character| *character != '\0')
}
