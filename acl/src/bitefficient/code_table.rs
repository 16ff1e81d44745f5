//! Messages with dynamic code tables (FIPA00069 2.4): read with a table that the caller owns, never
//! written.
//!
//! A message with tables is first written out as the same message without them; the one reader that
//! there is then reads that. So nothing else has to know of tables.

use std::collections::{BTreeSet, HashMap};

use bytes::Bytes;

use crate::bitefficient::expression::MAX_EXPRESSION_DEPTH;
use crate::bitefficient::reader::Reader;
use crate::bitefficient::write::{Out, write_len};
use crate::error::{DecodeError, Problem};
use crate::{AgentId, Message, Payload};

const CLAUSE: &str = "FIPA00069 2.4 code tables";
const MESSAGE: &str = "FIPA00069 2.1 Message";

/// The words and strings that messages of one peer refer to by number (FIPA00069 2.4).
///
/// Both sides have to agree beforehand that they use tables, and how large they are. A table serves
/// one direction of one connection: it fills with what the messages say, so all of them have to be
/// read with it, in order ([`Message::decode_with_table`]).
#[derive(Debug, Clone)]
pub struct CodeTable {
    size: usize,
    entries: Vec<Option<Entry>>,
    codes: HashMap<Bytes, u16>,
    free: BTreeSet<u16>,
    /// Counts the uses of entries.
    clock: u64,
}

#[derive(Debug, Clone)]
struct Entry {
    text: Bytes,
    used: u64,
}

impl CodeTable {
    /// Longest text of an entry, in bytes.
    pub const MAX_TEXT: usize = AgentId::MAX_NAME;

    /// Most bytes that a message may have without its content once all numbers are replaced.
    pub const MAX_MESSAGE: usize = 1 << 20;

    /// An empty table for 2 to the power of `bits` entries. Only 8 to 16 bits are possible.
    #[must_use]
    pub fn new(bits: u8) -> Option<Self> {
        (8..=16).contains(&bits).then(|| Self {
            size: 1 << bits,
            entries: Vec::new(),
            codes: HashMap::new(),
            free: BTreeSet::new(),
            clock: 0,
        })
    }

    /// How many entries there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.codes.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.codes.is_empty()
    }

    /// Forgets all entries: what both sides have to do when they are out of step.
    pub fn clear(&mut self) {
        self.entries.clear();
        self.codes.clear();
        self.free.clear();
    }

    fn get(&mut self, code: u16) -> Option<Bytes> {
        let used = self.tick();
        let entry = self.entries.get_mut(usize::from(code))?.as_mut()?;
        entry.used = used;
        Some(entry.text.clone())
    }

    /// Enters a text under the lowest number that is free.
    fn insert(&mut self, text: &[u8]) {
        let used = self.tick();
        if let Some(known) = self.codes.get(text) {
            if let Some(Some(entry)) = self.entries.get_mut(usize::from(*known)) {
                entry.used = used;
            }
            return;
        }
        if self.codes.len() >= self.size {
            self.make_room();
        }
        let text = Bytes::copy_from_slice(text);
        let entry = Some(Entry {
            text: text.clone(),
            used,
        });
        let code = match self.free.pop_first() {
            Some(code) => {
                if let Some(place) = self.entries.get_mut(usize::from(code)) {
                    *place = entry;
                }
                code
            }
            None => {
                // There are fewer entries than codes.
                let code = u16::try_from(self.entries.len()).unwrap_or(u16::MAX);
                self.entries.push(entry);
                code
            }
        };
        self.codes.insert(text, code);
    }

    /// Drops an eighth of the entries, those that were not used for longest.
    fn make_room(&mut self) {
        let mut by_use: Vec<(u64, u16)> = Vec::with_capacity(self.codes.len());
        for code in self.codes.values() {
            if let Some(Some(entry)) = self.entries.get(usize::from(*code)) {
                by_use.push((entry.used, *code));
            }
        }
        by_use.sort_unstable();
        for (_, code) in by_use.into_iter().take(self.size >> 3) {
            if let Some(place) = self.entries.get_mut(usize::from(code))
                && let Some(entry) = place.take()
            {
                self.codes.remove(&entry.text);
                self.free.insert(code);
            }
        }
    }

    fn tick(&mut self) -> u64 {
        self.clock += 1;
        self.clock
    }
}

impl Message {
    /// Like [`decode`](Self::decode), and reads bit-efficient messages with code tables too.
    ///
    /// # Errors
    /// When the payload is not one whole message, or does not fit the table; offsets are then those
    /// of the message as it would be without tables. An error in a message with tables
    /// [clears](CodeTable::clear) the table, because nobody knows what the peer has in its own.
    pub fn decode_with_table(payload: &Payload, table: &mut CodeTable) -> Result<Self> {
        let Some(id @ (0xfb | 0xfc)) = payload.head.first().copied() else {
            return Self::decode(payload);
        };
        let whole = payload.to_bytes();
        let expander = Expander {
            reader: Reader::new(&whole),
            whole: &whole,
            out: Vec::with_capacity(whole.len().min(CodeTable::MAX_MESSAGE)),
            table,
            inserts: id == 0xfb,
            split: None,
            limit: CodeTable::MAX_MESSAGE,
        };
        let read = expander.message().and_then(|plain| Self::decode(&plain));
        if read.is_err() {
            table.clear();
        }
        read
    }
}

struct Expander<'a> {
    reader: Reader<'a>,
    whole: &'a Bytes,
    out: Vec<u8>,
    table: &'a mut CodeTable,
    /// What is new enters the table.
    inserts: bool,
    /// The content, once it was met, and where it stands in `out`.
    split: Option<(Bytes, usize)>,
    /// How long `out` may become.
    limit: usize,
}

type Result<T> = std::result::Result<T, DecodeError>;

impl Expander<'_> {
    fn message(mut self) -> Result<Payload> {
        self.reader.byte(MESSAGE, "a message")?;
        let version = self.reader.byte(MESSAGE, "the version")?;
        self.out.slice(&[0xfa, version]);
        if self.copy(MESSAGE, "the performative")? == 0x00 {
            self.word()?;
        }
        loop {
            match self.copy(MESSAGE, "a message")? {
                0x00 => {
                    self.word()?;
                    // An empty value, as JADE writes it.
                    if self.reader.take_if(0x00) {
                        self.out.byte(0x00);
                    } else {
                        self.expression()?;
                    }
                }
                0x01 => break,
                0x02 => self.agent(AgentId::MAX_DEPTH)?,
                0x03 | 0x08 => self.agents(AgentId::MAX_DEPTH)?,
                0x04 => self.content()?,
                0x05 | 0x07 | 0x09 | 0x0a | 0x0b | 0x0d => self.expression()?,
                0x06 => {
                    let start = self.reader.position();
                    self.reader.date_time("FIPA00069 2.3 BinDateTime")?;
                    self.out.slice(self.reader.since(start));
                }
                0x0c => self.word()?,
                other => {
                    let expected = "a parameter of a message";
                    return Err(self.reader.unexpected(MESSAGE, other, expected));
                }
            }
        }
        // What is behind the end is for the reader to refuse.
        self.out.slice(self.reader.rest());
        let out = Bytes::from(self.out);
        Ok(match self.split {
            Some((content, at)) => Payload {
                head: out.slice(..at),
                content,
                tail: out.slice(at..),
            },
            None => out.into(),
        })
    }

    /// Copies one byte.
    fn copy(&mut self, clause: &'static str, what: &'static str) -> Result<u8> {
        let byte = self.reader.byte(clause, what)?;
        self.out.byte(byte);
        Ok(byte)
    }

    fn agents(&mut self, depth: usize) -> Result<()> {
        while !self.reader.take_if(0x01) {
            if self.copy(CLAUSE, "an agent identifier")? != 0x02 {
                let problem = Problem::NotAWord("agent identifier");
                return Err(self.reader.error(MESSAGE, problem));
            }
            self.parts_of_agent(depth)?;
        }
        self.out.byte(0x01);
        Ok(())
    }

    fn agent(&mut self, depth: usize) -> Result<()> {
        if self.copy(CLAUSE, "an agent identifier")? != 0x02 {
            let problem = Problem::NotAWord("agent identifier");
            return Err(self.reader.error(MESSAGE, problem));
        }
        self.parts_of_agent(depth)
    }

    fn parts_of_agent(&mut self, depth: usize) -> Result<()> {
        const AID: &str = "FIPA00069 2.1 AID";
        self.word()?;
        loop {
            match self.copy(AID, "an agent identifier")? {
                0x01 => return Ok(()),
                0x02 => {
                    while !self.reader.take_if(0x01) {
                        self.word()?;
                    }
                    self.out.byte(0x01);
                }
                0x03 => {
                    let Some(depth) = depth.checked_sub(1) else {
                        return Err(self.reader.error(AID, Problem::TooDeep("resolvers")));
                    };
                    self.agents(depth)?;
                }
                0x04 => {
                    self.word()?;
                    if self.reader.take_if(0x00) {
                        self.out.byte(0x00);
                    } else {
                        self.expression()?;
                    }
                }
                other => {
                    let expected = "a part of an agent identifier";
                    return Err(self.reader.unexpected(AID, other, expected));
                }
            }
        }
    }

    /// Content never enters the table (FIPA00069 2.1, note 9), but may be found in it.
    fn content(&mut self) -> Result<()> {
        const CONTENT: &str = "FIPA00069 2.1 BinString";
        let code = self.reader.byte(CONTENT, "content")?;
        let len = match code {
            0x16 => self.reader.u8_len(CONTENT)?,
            0x17 => self.reader.u16_len(CONTENT)?,
            0x19 => self.reader.u32_len(CONTENT)?,
            0x14 => {
                let text = self.reader.until_nul(CONTENT, "content")?;
                self.out.framed([0x14], text, [0x00]);
                self.limit += text.len();
                return Ok(());
            }
            code => return self.expression_of(code, false),
        };
        let content = self.reader.bytes(len, CONTENT, "content")?;
        write_len(len, &mut self.out);
        if self.split.is_none() && !content.is_empty() {
            self.split = Some((self.whole.slice_ref(content), self.out.len()));
        } else {
            self.out.slice(content);
            self.limit += content.len();
        }
        Ok(())
    }

    fn word(&mut self) -> Result<()> {
        let code = self.reader.byte(CLAUSE, "a word")?;
        if !matches!(code, 0x10 | 0x11) {
            return Err(self.reader.unexpected(CLAUSE, code, "a word"));
        }
        self.token(0x10, code, self.inserts)
    }

    fn expression(&mut self) -> Result<()> {
        let mut code = self.reader.byte(CLAUSE, "an expression")?;
        // An opaque expression: the string that follows is it.
        if code == 0xff {
            self.out.byte(0xff);
            code = self.reader.byte(CLAUSE, "an expression")?;
        }
        self.expression_of(code, self.inserts)
    }

    fn expression_of(&mut self, first: u8, inserts: bool) -> Result<()> {
        let mut depth = 0_usize;
        let mut code = first;
        loop {
            let level = match code {
                0x10..=0x19 => 0x10,
                0x60 | 0x70..=0x79 => {
                    depth += 1;
                    0x70
                }
                0x40 | 0x50..=0x59 => {
                    depth = depth.saturating_sub(1);
                    0x50
                }
                other => return Err(self.reader.unexpected(CLAUSE, other, "an expression")),
            };
            if depth > MAX_EXPRESSION_DEPTH {
                return Err(self.reader.error(CLAUSE, Problem::TooDeep("expressions")));
            }
            self.token(level, code, inserts)?;
            if depth == 0 {
                return Ok(());
            }
            code = self.reader.byte(CLAUSE, "an expression")?;
        }
    }

    /// One word, string or number, on its own (`level` 10) or fused with a parenthesis (50, 70).
    fn token(&mut self, level: u8, code: u8, inserts: bool) -> Result<()> {
        if self.out.len() > self.limit {
            return Err(self.reader.error(CLAUSE, Problem::TooLong("message")));
        }
        // FIPA00069 2.1: Len32 and the last index have changed places among the levels.
        let (len32, index) = if level == 0x10 { (9, 8) } else { (8, 9) };
        let kind = code & 0x0f;
        match kind {
            // Nothing but the parenthesis.
            0 if code != level => self.out.byte(code),
            0 | 4 => {
                let text = self.reader.until_nul(CLAUSE, "a text")?;
                self.enter(text, inserts)?;
                self.out.framed([code], text, [0x00]);
            }
            1 | 5 => {
                let text = self.entry()?;
                self.out.framed([code - 1], &text, [0x00]);
            }
            2 | 3 => {
                let digits = self.reader.digits(CLAUSE)?;
                self.out.framed([code], digits, []);
            }
            6 | 7 => {
                let len = if kind == 6 {
                    self.reader.u8_len(CLAUSE)?
                } else {
                    self.reader.u16_len(CLAUSE)?
                };
                self.with_len(level, len, inserts)?;
            }
            kind if kind == len32 => {
                let len = self.reader.u32_len(CLAUSE)?;
                self.with_len(level, len, inserts)?;
            }
            kind if kind == index => {
                let text = self.entry()?;
                self.write_with_len(level, &text);
            }
            _ => return Err(self.reader.unexpected(CLAUSE, code, "an expression")),
        }
        Ok(())
    }

    fn with_len(&mut self, level: u8, len: usize, inserts: bool) -> Result<()> {
        let text = self.reader.bytes(len, CLAUSE, "a text")?;
        self.enter(text, inserts)?;
        self.write_with_len(level, text);
        Ok(())
    }

    fn write_with_len(&mut self, level: u8, text: &[u8]) {
        let at = self.out.len();
        write_len(text.len(), &mut self.out);
        if level != 0x10
            && let Some(code) = self.out.get_mut(at)
        {
            let kind = match *code {
                0x19 => 8,
                other => other & 0x0f,
            };
            *code = level | kind;
        }
        self.out.slice(text);
    }

    fn enter(&mut self, text: &[u8], inserts: bool) -> Result<()> {
        if inserts {
            if text.len() > CodeTable::MAX_TEXT {
                let problem = Problem::TooLong("text for the code table");
                return Err(self.reader.error(CLAUSE, problem));
            }
            self.table.insert(text);
        }
        Ok(())
    }

    fn entry(&mut self) -> Result<Bytes> {
        let code = if self.table.size == 256 {
            self.reader.u8_len(CLAUSE)?
        } else {
            self.reader.u16_len(CLAUSE)?
        };
        let found = u16::try_from(code)
            .ok()
            .and_then(|code| self.table.get(code));
        found.ok_or_else(|| self.reader.error(CLAUSE, Problem::NoSuchCode(code)))
    }
}
