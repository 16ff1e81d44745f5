//! The strict writer of string messages in one of the three dialects.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64_ENGINE;
use bytes::Bytes;

use super::agent_id::SLOTS;
use super::lex::{Keywords, holds_keyword};
use super::read::PARAMETERS;
use crate::bitefficient::write::Output;
use crate::dialect::{BASE64, JADE_ENCODING, announces_base64, check_word, local_time, not_a_word};
use crate::error::EncodeError;
use crate::time::Time;
use crate::word::{
    Piece, is_quotable, is_quoted_word_of_jade, is_token, is_word, is_word_of_jade, quoted,
    string_literal,
};
use crate::{AgentId, Dialect, Message, Performative, Text};

/// Writes the string message with the parameters in the order of the standard, except for the
/// content.
pub(crate) fn encode(
    message: &Message,
    dialect: Dialect,
    out: &mut dyn Output,
) -> Result<(), EncodeError> {
    Writer { out, dialect }.message(message)
}

struct Writer<'a> {
    out: &'a mut dyn Output,
    dialect: Dialect,
}

impl Writer<'_> {
    fn message(&mut self, message: &Message) -> Result<(), EncodeError> {
        let announced = |(name, value): &(String, String)| {
            let (name, value) = (name.as_bytes(), value.as_bytes());
            announces_base64(&Text::plain(name), &Text::plain(value))
        };
        if message.content.is_some() && message.user_defined.iter().any(announced) {
            return Err(EncodeError::Unrepresentable {
                what: "user-defined parameter JADE-Encoding",
                why: "readers would decode the content as Base64",
            });
        }
        self.push("(");
        self.performative(&message.performative)?;
        if let Some(sender) = &message.sender {
            self.key("sender");
            self.agent(sender, 0)?;
        }
        self.agent_set("receiver", &message.receivers)?;
        // fipa_services writes the content here. No reader depends on its position.
        if self.dialect == Dialect::FipaServices {
            self.content(message.content.as_ref());
        }
        self.text("reply-with", message.reply_with.as_deref())?;
        if let Some(time) = message.reply_by {
            self.key("reply-by");
            self.time(time)?;
        }
        self.text("in-reply-to", message.in_reply_to.as_deref())?;
        self.agent_set("reply-to", &message.reply_to)?;
        self.text("language", message.language.as_deref())?;
        self.text("encoding", message.encoding.as_deref())?;
        self.text("ontology", message.ontology.as_deref())?;
        if let Some(protocol) = &message.protocol {
            self.key("protocol");
            self.word(protocol, "protocol", PARAMETERS)?;
        }
        self.text("conversation-id", message.conversation_id.as_deref())?;
        self.user_defined(&message.user_defined)?;
        if self.dialect != Dialect::FipaServices {
            self.content(message.content.as_ref());
        }
        self.push(")");
        Ok(())
    }

    fn performative(&mut self, performative: &Performative) -> Result<(), EncodeError> {
        let name = performative.as_str();
        match (performative, self.dialect) {
            (Performative::Other(_), Dialect::Standard) => {
                refuse_keyword(name, "user-defined performative", PARAMETERS)?;
                self.push(name);
            }
            (Performative::Other(_), _) => {
                return Err(EncodeError::Unrepresentable {
                    what: "user-defined performative",
                    why: "neither fipa_services nor JADE reads one in a string message",
                });
            }
            // JADE writes upper case.
            (_, Dialect::Jade) => self.push(&name.to_ascii_uppercase()),
            _ => self.push(name),
        }
        Ok(())
    }

    fn agent_set(&mut self, key: &str, agents: &[AgentId]) -> Result<(), EncodeError> {
        if agents.is_empty() {
            return Ok(());
        }
        self.key(key);
        self.push("(set");
        for agent in agents {
            self.space();
            self.agent(agent, 0)?;
        }
        self.push(")");
        Ok(())
    }

    fn agent(&mut self, agent: &AgentId, depth: usize) -> Result<(), EncodeError> {
        self.push("(agent-identifier");
        self.key("name");
        if self.dialect == Dialect::Jade {
            // JADE accepts strings as names, and removes the white space around them.
            let what = "name of an agent";
            if agent.name().trim_matches(|it| it <= ' ') != agent.name() {
                let why = "JADE removes the white space around it";
                return Err(EncodeError::Unrepresentable { what, why });
            }
            self.expression(agent.name(), what)?;
        } else {
            self.word(agent.name(), "name of an agent", SLOTS)?;
        }
        if !agent.addresses().is_empty() {
            self.key("addresses");
            self.push("(sequence");
            for address in agent.addresses() {
                self.space();
                self.address(address)?;
            }
            self.push(")");
        }
        if !agent.resolvers().is_empty() {
            if self.dialect == Dialect::FipaServices && depth > 0 {
                return Err(EncodeError::Unrepresentable {
                    what: "resolver of a resolver",
                    why: "fipa_services does not read one",
                });
            }
            self.key("resolvers");
            self.push("(sequence");
            for resolver in agent.resolvers() {
                self.space();
                self.agent(resolver, depth + 1)?;
            }
            self.push(")");
        }
        if self.dialect == Dialect::FipaServices && !agent.user_defined().is_empty() {
            return Err(EncodeError::Unrepresentable {
                what: "user-defined parameter of an agent",
                why: "fipa_services does not read one in a string message",
            });
        }
        self.user_defined(agent.user_defined())?;
        self.push(")");
        Ok(())
    }

    fn address(&mut self, address: &str) -> Result<(), EncodeError> {
        let what = "address of an agent";
        if self.dialect == Dialect::Jade {
            return self.word_for_jade(address, what);
        }
        if !is_token(address) || address.starts_with(['"', '#']) {
            let why = "it is not one word";
            return Err(EncodeError::Unrepresentable { what, why });
        }
        if self.dialect == Dialect::FipaServices {
            check_word(what, address)?;
        }
        self.push(address);
        if self.dialect == Dialect::FipaServices {
            // The blank ends the URL. fipa_services writes no other white space.
            self.push(" ");
        }
        Ok(())
    }

    fn user_defined(&mut self, pairs: &[(String, String)]) -> Result<(), EncodeError> {
        let what = "user-defined parameter";
        for (name, value) in pairs {
            if self.dialect == Dialect::FipaServices && name.contains(':') {
                return Err(EncodeError::Unrepresentable {
                    what: "name of a user-defined parameter",
                    why: "it has a colon, which ends it for a reader without white space",
                });
            }
            self.colon("X-");
            self.push(name);
            self.space();
            if self.dialect == Dialect::FipaServices {
                // The reader of fipa_services requires the parentheses.
                self.push("(");
                self.counted(value.as_bytes());
                self.push(")");
            } else {
                self.expression(value, what)?;
            }
        }
        Ok(())
    }

    fn text(&mut self, key: &'static str, text: Option<&str>) -> Result<(), EncodeError> {
        let Some(text) = text else { return Ok(()) };
        self.key(key);
        self.expression(text, key)
    }

    /// Writes a text as a word if the reader takes it for one, and as a string otherwise. For
    /// fipa_services, it is always a string with its length.
    fn expression(&mut self, text: &str, what: &'static str) -> Result<(), EncodeError> {
        let is_word = match self.dialect {
            Dialect::FipaServices => {
                self.counted(text.as_bytes());
                return Ok(());
            }
            Dialect::Jade => is_word_of_jade(text),
            Dialect::Standard => is_word(text),
        };
        if is_word {
            self.push(text);
        } else {
            self.literal(text, what)?;
        }
        Ok(())
    }

    fn word<T>(
        &mut self,
        word: &str,
        what: &'static str,
        keywords: &Keywords<T>,
    ) -> Result<(), EncodeError> {
        match self.dialect {
            Dialect::FipaServices => {
                check_word(what, word)?;
                refuse_keyword(word, what, keywords)?;
            }
            Dialect::Jade => return self.word_for_jade(word, what),
            Dialect::Standard if !is_word(word) => return Err(not_a_word(what)),
            Dialect::Standard => {}
        }
        self.push(word);
        Ok(())
    }

    /// Writes a text where JADE reads a word only. Its lexer takes printable ASCII characters in
    /// quotation marks for a word too.
    fn word_for_jade(&mut self, text: &str, what: &'static str) -> Result<(), EncodeError> {
        if is_word_of_jade(text) {
            self.push(text);
        } else if is_quoted_word_of_jade(text) {
            quoted(text, |piece| self.push(piece));
        } else {
            return Err(EncodeError::Unrepresentable {
                what,
                why: "JADE reads printable ASCII characters there, without blanks, parentheses and \
                      a backslash before a quotation mark",
            });
        }
        Ok(())
    }

    fn literal(&mut self, text: &str, what: &'static str) -> Result<(), EncodeError> {
        let mut counted = false;
        string_literal(text, |piece| match piece {
            Piece::Text(text) => self.push(text),
            Piece::LengthPrefix(len) => {
                counted = true;
                self.push("#");
                self.push(&len.to_string());
                self.push("\"");
            }
        });
        // JADE counts characters where the standard counts bytes.
        if self.dialect == Dialect::Jade && counted && !text.is_ascii() {
            return Err(EncodeError::Unrepresentable {
                what,
                why: "JADE misreads text that is not ASCII and has a backslash before a quotation \
                      mark or at the end",
            });
        }
        Ok(())
    }

    fn content(&mut self, content: Option<&Bytes>) {
        let Some(content) = content else { return };
        if self.dialect == Dialect::Jade {
            self.content_for_jade(content);
        } else {
            // With its length, the content may be any bytes, and no reader scans them.
            self.key("content");
            self.counted(content);
        }
    }

    /// Writes content in quotation marks if it is text that allows them, and in Base64 otherwise.
    fn content_for_jade(&mut self, content: &Bytes) {
        // A copy, because another process may change shared memory at any time.
        let content = content.to_vec();
        let text = std::str::from_utf8(&content)
            .ok()
            .filter(|text| memchr::memchr(0, text.as_bytes()).is_none() && is_quotable(text));
        let Some(text) = text else {
            self.colon("X-");
            self.push(JADE_ENCODING);
            self.space();
            self.push(BASE64);
            self.key("content");
            self.push("\"");
            self.push(&BASE64_ENGINE.encode(&content));
            self.push("\"");
            return;
        };
        self.key("content");
        quoted(text, |piece| self.push(piece));
    }

    fn time(&mut self, time: Time) -> Result<(), EncodeError> {
        let time = match self.dialect {
            Dialect::FipaServices => local_time("reply-by", time)?,
            _ => time,
        };
        self.push(&time.to_string());
        Ok(())
    }

    /// Writes `:key` and, if the dialect has white space, a blank on both sides.
    fn key(&mut self, key: &str) {
        self.colon(key);
        self.space();
    }

    /// Writes `:key` and, if the dialect has white space, a blank in front.
    fn colon(&mut self, key: &str) {
        self.space();
        self.push(":");
        self.push(key);
    }

    fn counted(&mut self, bytes: &[u8]) {
        self.push("#");
        self.push(&bytes.len().to_string());
        self.push("\"");
        self.out.slice(bytes);
    }

    fn space(&mut self) {
        if self.dialect != Dialect::FipaServices {
            self.push(" ");
        }
    }

    fn push(&mut self, text: &str) {
        self.out.slice(text.as_bytes());
    }
}

/// Refuses a word with a keyword, which ends the word for a reader that expects no white space.
fn refuse_keyword<T>(
    word: &str,
    what: &'static str,
    keywords: &Keywords<T>,
) -> Result<(), EncodeError> {
    if holds_keyword(word, keywords) {
        let why = "it contains a colon followed by the name of a parameter";
        return Err(EncodeError::Unrepresentable { what, why });
    }
    Ok(())
}
