//! The token of `distributed_locking`: a text archive of Boost.Serialization.
//!
//! The archive is a sequence of words, separated by blanks: the signature and the version of the
//! archive; the resource; then the token, which is a map from agents to numbers and a queue of agents.
//! A text is its length and its bytes. The first object of each class is preceded by the tracking level
//! and the version of the class, a collection by its size. Archives of version 4 and later have the
//! version of the items after the size.

use super::DecodeError;
use crate::{Resource, Token};

const SIGNATURE: &str = "serialization::archive";

/// First version with a version of the items of a collection.
const ITEM_VERSION: u16 = 4;

pub(super) fn write(version: u16, resource: &Resource, token: &Token) -> String {
    let mut text = format!("{} {SIGNATURE} {version}", SIGNATURE.len());
    let item_version = if version < ITEM_VERSION { "" } else { " 0" };
    let put = |text: &mut String, word: &str| *text += &format!(" {} {word}", word.len());
    put(&mut text, resource.as_str());
    // The classes of the token and of its map.
    text += " 0 0 0 0";
    text += &format!(" {}{item_version}", token.last.len());
    let mut agent_known = false;
    let mut put_agent = |text: &mut String, name: &str| {
        if !std::mem::replace(&mut agent_known, true) {
            *text += " 0 0";
        }
        put(text, name);
    };
    for (index, (name, last)) in token.last.iter().enumerate() {
        if index == 0 {
            // The class of the pairs.
            text += " 0 0";
        }
        put_agent(&mut text, name);
        text += &format!(" {last}");
    }
    // The class of the queue.
    text += &format!(" 0 0 {}{item_version}", token.queue.len());
    for name in &token.queue {
        put_agent(&mut text, name);
    }
    text
}

pub(super) fn read(text: &str) -> Result<(Resource, Token), DecodeError> {
    let mut reader = Reader { text, at: 0 };
    if reader.string()? != SIGNATURE {
        return Err(reader.wrong("not a text archive of Boost"));
    }
    let version = reader.number()?;
    let version = u16::try_from(version).map_err(|_| reader.wrong("no version"))?;
    let resource = Resource::new(reader.string()?)?;
    let mut token = Token {
        archive: Some(version),
        ..Token::default()
    };
    reader.class()?;
    reader.class()?;
    let size = reader.size(version)?;
    let mut agent_known = false;
    for index in 0..size {
        if index == 0 {
            reader.class()?;
        }
        let name = reader.agent(&mut agent_known)?;
        let last = reader.number()?;
        token.add_last(name, last, reader.at)?;
    }
    reader.class()?;
    for _ in 0..reader.size(version)? {
        let name = reader.agent(&mut agent_known)?;
        token.add_next(name, reader.at)?;
    }
    if reader.rest().trim_ascii().is_empty() {
        Ok((resource, token))
    } else {
        Err(reader.wrong("text after the end"))
    }
}

struct Reader<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Reader<'a> {
    fn rest(&self) -> &'a str {
        self.text.get(self.at..).unwrap_or("")
    }

    fn wrong(&self, problem: &'static str) -> DecodeError {
        DecodeError::Token {
            at: self.at,
            problem,
        }
    }

    fn number(&mut self) -> Result<u64, DecodeError> {
        let rest = self.rest();
        let word = rest.trim_ascii_start();
        let digits = word.bytes().take_while(u8::is_ascii_digit).count();
        let number = word.get(..digits).and_then(|digits| digits.parse().ok());
        let number = number.ok_or_else(|| self.wrong("no number"))?;
        self.at += rest.len() - word.len() + digits;
        Ok(number)
    }

    /// A length, one blank and so many bytes.
    fn string(&mut self) -> Result<&'a str, DecodeError> {
        let length = self.number()?;
        let found = usize::try_from(length).ok().and_then(|length| {
            let end = length.checked_add(1)?;
            self.rest().get(1..end)
        });
        let found = found.ok_or_else(|| self.wrong("a text beyond the end"))?;
        self.at += 1 + found.len();
        Ok(found)
    }

    /// Tracking level and version of a class.
    fn class(&mut self) -> Result<(), DecodeError> {
        for _ in 0..2 {
            if self.number()? != 0 {
                return Err(self.wrong("an unknown version of a class"));
            }
        }
        Ok(())
    }

    fn size(&mut self, version: u16) -> Result<u64, DecodeError> {
        let size = self.number()?;
        if version >= ITEM_VERSION {
            self.number()?;
        }
        Ok(size)
    }

    fn agent(&mut self, known: &mut bool) -> Result<&'a str, DecodeError> {
        if !std::mem::replace(known, true) {
            self.class()?;
        }
        self.string()
    }
}
