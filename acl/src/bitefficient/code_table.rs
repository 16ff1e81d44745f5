//! Messages with dynamic code tables (FIPA00069 2.3): read with a table that the caller owns, never
//! written.
//!
//! [`Expander`] rewrites a message with a table as the same message without one, which the usual
//! reader then reads. So no other module handles tables.

use std::collections::{BTreeSet, HashMap};

use bytes::Bytes;

use crate::bitefficient::code::{self, TokenKind, closes_level, opens_level};
use crate::bitefficient::expression::MAX_EXPRESSION_DEPTH;
use crate::bitefficient::reader::Reader;
use crate::bitefficient::write::{Output, write_len};
use crate::error::{DecodeError, Problem};
use crate::{AgentId, Message, Payload};

const CLAUSE: &str = "FIPA00069 2.3 code tables";
const MESSAGE: &str = "FIPA00069 2.2 Message";

/// The words and strings that messages of one peer refer to by index (FIPA00069 2.3).
///
/// Both sides must agree beforehand to use tables, and on their size. A table serves one direction
/// of one connection. Each message may add entries, so all messages must be read with the table,
/// in order ([`Message::decode_with_table`]).
#[derive(Debug, Clone)]
pub struct CodeTable {
    size: usize,
    entries: Vec<Option<Entry>>,
    codes: HashMap<Bytes, u16>,
    free: BTreeSet<u16>,
    /// Number of uses of entries so far.
    clock: u64,
}

#[derive(Debug, Clone)]
struct Entry {
    text: Bytes,
    /// Value of the clock at the last use.
    used: u64,
}

impl CodeTable {
    /// Maximum length of the text of an entry, in bytes.
    pub const MAX_TEXT: usize = AgentId::MAX_NAME;

    /// Maximum length of a message without its content, in bytes, after every index is replaced by
    /// its text.
    pub const MAX_MESSAGE: usize = 1 << 20;

    /// Creates an empty table for 2 to the power of `bits` entries. Returns `None` unless `bits` is
    /// from 8 to 16.
    ///
    /// FIPA00069 2.3: "The size of the code table, if used, is between 256 (2^8) and 65536 (2^16)
    /// entries."
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

    /// Number of entries.
    #[must_use]
    pub fn len(&self) -> usize {
        self.codes.len()
    }

    /// Whether the table has no entries.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.codes.is_empty()
    }

    /// Removes all entries. Both sides must do so when their tables differ.
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

    /// Adds a text.
    ///
    /// FIPA00069 2.3: "whenever a new entry is added to the code table, the smallest available code
    /// number is allocated to it."
    fn insert(&mut self, text: &[u8]) {
        let used = self.tick();
        if let Some(known) = self.codes.get(text) {
            if let Some(Some(entry)) = self.entries.get_mut(usize::from(*known)) {
                entry.used = used;
            }
            return;
        }
        if self.codes.len() >= self.size {
            self.evict();
        }
        let text = Bytes::copy_from_slice(text);
        let entry = Some(Entry {
            text: text.clone(),
            used,
        });
        let code = match self.free.pop_first() {
            Some(code) => {
                if let Some(slot) = self.entries.get_mut(usize::from(code)) {
                    *slot = entry;
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

    /// Removes an eighth of the entries, the least recently used ones.
    ///
    /// FIPA00069 2.3: "the sender first removes size>>3 entries from the code table using a Least
    /// Recently Used (LRU) algorithm and then adds a new entry to code table."
    fn evict(&mut self) {
        let mut by_use: Vec<(u64, u16)> = Vec::with_capacity(self.codes.len());
        for code in self.codes.values() {
            if let Some(Some(entry)) = self.entries.get(usize::from(*code)) {
                by_use.push((entry.used, *code));
            }
        }
        by_use.sort_unstable();
        for (_, code) in by_use.into_iter().take(self.size >> 3) {
            if let Some(slot) = self.entries.get_mut(usize::from(code))
                && let Some(entry) = slot.take()
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
    /// Decodes a message like [`decode`](Self::decode). Bit-efficient messages with code tables are
    /// accepted too.
    ///
    /// # Errors
    /// The payload is not one whole message, or refers to an entry that the table does not have.
    /// For a message with code tables, offsets refer to the same message without them. An error in
    /// such a message [clears](CodeTable::clear) the table, because it may differ from the table of
    /// the peer.
    pub fn decode_with_table(payload: &Payload, table: &mut CodeTable) -> Result<Self> {
        let updated = match payload.head.first() {
            Some(&code::message_id::TABLE_UPDATED) => true,
            Some(&code::message_id::TABLE_UNCHANGED) => false,
            _ => return Self::decode(payload),
        };
        let whole = payload.to_bytes();
        let expander = Expander {
            reader: Reader::new(&whole),
            whole: &whole,
            out: Vec::with_capacity(whole.len().min(CodeTable::MAX_MESSAGE)),
            table,
            inserts: updated,
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

/// Rewrites a message with a code table as the same message without one.
struct Expander<'a> {
    reader: Reader<'a>,
    whole: &'a Bytes,
    out: Vec<u8>,
    table: &'a mut CodeTable,
    /// Whether new texts enter the table.
    inserts: bool,
    /// The content and its offset in `out`, once it was read.
    split: Option<(Bytes, usize)>,
    /// Maximum length of `out`.
    limit: usize,
}

/// The parenthesis that a token is fused with.
#[derive(Clone, Copy)]
enum Level {
    /// No parenthesis.
    Same,
    /// An opening parenthesis.
    Opened,
    /// A closing parenthesis.
    Closed,
}

type Result<T> = std::result::Result<T, DecodeError>;

impl Expander<'_> {
    fn message(mut self) -> Result<Payload> {
        self.reader.byte(MESSAGE, "a message")?;
        let version = self.reader.byte(MESSAGE, "the version")?;
        self.out.slice(&[code::message_id::PLAIN, version]);
        if self.copy(MESSAGE, "the performative")? == code::USER_DEFINED_PERFORMATIVE {
            self.word()?;
        }
        loop {
            match self.copy(MESSAGE, "a message")? {
                code::message::USER_DEFINED => self.user_defined()?,
                code::END => break,
                code::message::SENDER => self.agent(AgentId::MAX_DEPTH)?,
                code::message::RECEIVER | code::message::REPLY_TO => {
                    self.agents(AgentId::MAX_DEPTH)?;
                }
                code::message::CONTENT => self.content()?,
                code::message::REPLY_WITH
                | code::message::IN_REPLY_TO
                | code::message::LANGUAGE
                | code::message::ENCODING
                | code::message::ONTOLOGY
                | code::message::CONVERSATION_ID => self.expression()?,
                code::message::REPLY_BY => {
                    let start = self.reader.position();
                    self.reader.date_time("FIPA00069 2.2 BinDateTimeToken")?;
                    self.out.slice(self.reader.since(start));
                }
                code::message::PROTOCOL => self.word()?,
                other => {
                    let expected = "a parameter of a message";
                    return Err(self.reader.unexpected(MESSAGE, other, expected));
                }
            }
        }
        // The reader refuses bytes behind the end.
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
        while !self.reader.take_if(code::END) {
            self.agent(depth)?;
        }
        self.out.byte(code::END);
        Ok(())
    }

    fn agent(&mut self, depth: usize) -> Result<()> {
        const AID: &str = "FIPA00069 2.2 AgentIdentifier";
        if self.copy(CLAUSE, "an agent identifier")? != code::agent::BEGIN {
            let problem = Problem::NotAWord("agent identifier");
            return Err(self.reader.error(MESSAGE, problem));
        }
        self.word()?;
        loop {
            match self.copy(AID, "an agent identifier")? {
                code::END => return Ok(()),
                code::agent::ADDRESSES => {
                    while !self.reader.take_if(code::END) {
                        self.word()?;
                    }
                    self.out.byte(code::END);
                }
                code::agent::RESOLVERS => {
                    let Some(depth) = depth.checked_sub(1) else {
                        return Err(self.reader.error(AID, Problem::TooDeep("resolvers")));
                    };
                    self.agents(depth)?;
                }
                code::agent::USER_DEFINED => self.user_defined()?,
                other => {
                    let expected = "a part of an agent identifier";
                    return Err(self.reader.unexpected(AID, other, expected));
                }
            }
        }
    }

    fn user_defined(&mut self) -> Result<()> {
        self.word()?;
        // JADE writes an empty value as a single 00.
        if self.reader.take_if(0x00) {
            self.out.byte(0x00);
            return Ok(());
        }
        self.expression()
    }

    /// Copies the content, which never enters the table. A reference to an entry is accepted.
    ///
    /// FIPA00069 2.4, note 9: "None of the actual content of the message (the information contained
    /// in the content parameter of the ACL message) is coded nor are any of its components are
    /// added to a code table."
    fn content(&mut self) -> Result<()> {
        const CONTENT: &str = "FIPA00069 2.2 BinString";
        let len = match self.reader.byte(CONTENT, "content")? {
            code::token::LEN8 => self.reader.u8_len(CONTENT)?,
            code::token::LEN16 => self.reader.u16_len(CONTENT)?,
            code::token::LEN32 => self.reader.u32_len(CONTENT)?,
            code::token::STRING => {
                let text = self.reader.until_nul(CONTENT, "content")?;
                self.out.framed([code::token::STRING], text, [0x00]);
                self.limit += text.len();
                return Ok(());
            }
            first => return self.expression_of(first, false),
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
        let first = self.reader.byte(CLAUSE, "a word")?;
        if !matches!(first, code::token::WORD | code::token::WORD_INDEX) {
            return Err(self.reader.unexpected(CLAUSE, first, "a word"));
        }
        self.token(Level::Same, first, self.inserts)
    }

    fn expression(&mut self) -> Result<()> {
        let mut first = self.reader.byte(CLAUSE, "an expression")?;
        // An opaque expression: the string is its text.
        if first == code::token::OPAQUE {
            self.out.byte(first);
            first = self.reader.byte(CLAUSE, "an expression")?;
        }
        self.expression_of(first, self.inserts)
    }

    fn expression_of(&mut self, first: u8, inserts: bool) -> Result<()> {
        let mut depth = 0_usize;
        let mut code = first;
        loop {
            let level = match code {
                code::token::WORD..=code::token::LEN32 => Level::Same,
                code if opens_level(code) => {
                    depth += 1;
                    Level::Opened
                }
                code if closes_level(code) => {
                    depth = depth.saturating_sub(1);
                    Level::Closed
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

    /// Copies one word, string or number, alone or fused with a parenthesis.
    fn token(&mut self, level: Level, code: u8, inserts: bool) -> Result<()> {
        if self.out.len() > self.limit {
            return Err(self.reader.error(CLAUSE, Problem::TooLong("message")));
        }
        let Some(kind) = TokenKind::of(code) else {
            return Err(self.reader.unexpected(CLAUSE, code, "an expression"));
        };
        match kind {
            TokenKind::None => self.out.byte(code),
            TokenKind::Word | TokenKind::String => {
                let text = self.reader.until_nul(CLAUSE, "a text")?;
                self.enter(text, inserts)?;
                self.out.framed([code], text, [0x00]);
            }
            TokenKind::TextIndex => {
                let text = self.entry()?;
                // The code of a text precedes the code of its index.
                self.out.framed([code - 1], &text, [0x00]);
            }
            TokenKind::Number => {
                let digits = self.reader.digits(CLAUSE)?;
                self.out.framed([code], digits, []);
            }
            TokenKind::Len8 => {
                let len = self.reader.u8_len(CLAUSE)?;
                self.with_len(level, len, inserts)?;
            }
            TokenKind::Len16 => {
                let len = self.reader.u16_len(CLAUSE)?;
                self.with_len(level, len, inserts)?;
            }
            TokenKind::Len32 => {
                let len = self.reader.u32_len(CLAUSE)?;
                self.with_len(level, len, inserts)?;
            }
            TokenKind::LenIndex => {
                let text = self.entry()?;
                self.write_with_len(level, &text);
            }
        }
        Ok(())
    }

    fn with_len(&mut self, level: Level, len: usize, inserts: bool) -> Result<()> {
        let text = self.reader.bytes(len, CLAUSE, "a text")?;
        self.enter(text, inserts)?;
        self.write_with_len(level, text);
        Ok(())
    }

    fn write_with_len(&mut self, level: Level, text: &[u8]) {
        let at = self.out.len();
        write_len(text.len(), &mut self.out);
        if let Some(code) = self.out.get_mut(at) {
            *code = match (level, *code) {
                (Level::Same, code) => code,
                (Level::Opened, code::token::LEN8) => code::start::LEN8,
                (Level::Opened, code::token::LEN16) => code::start::LEN16,
                (Level::Opened, _) => code::start::LEN32,
                (Level::Closed, code::token::LEN8) => code::end::LEN8,
                (Level::Closed, code::token::LEN16) => code::end::LEN16,
                (Level::Closed, _) => code::end::LEN32,
            };
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
