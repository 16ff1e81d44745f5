//! Writing string messages, strictly, in the hand of one of three readers.

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
use crate::word::{Piece, is_quotable, is_token, is_word, quoted, string_literal};
use crate::{AgentId, Dialect, Message, Performative, Text};

/// Writes the string message: parameters in the order of the standard, but content last.
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
                why: "readers would take the content for Base64",
            });
        }
        self.push("(");
        self.performative(&message.performative)?;
        if let Some(sender) = &message.sender {
            self.key("sender");
            self.agent(sender, 0)?;
        }
        self.agent_set("receiver", &message.receivers)?;
        // fipa_services writes it here; nobody minds where it stands.
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
            // The spelling that JADE itself uses.
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
        if self.dialect == Dialect::Jade && !is_word(agent.name()) {
            // JADE takes strings for names.
            self.literal(agent.name(), "name of an agent")?;
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
        if !is_token(address) || address.starts_with(['"', '#']) {
            let why = "it is not one word";
            return Err(EncodeError::Unrepresentable { what, why });
        }
        if self.dialect == Dialect::FipaServices {
            check_word(what, address)?;
        }
        self.push(address);
        if self.dialect == Dialect::FipaServices {
            // The only white space there is: a URL has no other end.
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
                    why: "without white space, as fipa_services writes, a colon would end it",
                });
            }
            self.colon("X-");
            self.push(name);
            self.space();
            if self.dialect == Dialect::FipaServices {
                // Its own reader demands the parentheses.
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

    /// A word where the text is one, else a string; for fipa_services always a counted string.
    fn expression(&mut self, text: &str, what: &'static str) -> Result<(), EncodeError> {
        if self.dialect == Dialect::FipaServices {
            self.counted(text.as_bytes());
        } else if is_word(text) {
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
        if self.dialect == Dialect::FipaServices {
            check_word(what, word)?;
            refuse_keyword(word, what, keywords)?;
        } else if !is_word(word) {
            return Err(not_a_word(what));
        }
        self.push(word);
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
            // Its length in front: any bytes will do, and no reader has to look at them.
            self.key("content");
            self.counted(content);
        }
    }

    /// In quotation marks if it is text that can stand there, else in Base64.
    fn content_for_jade(&mut self, content: &Bytes) {
        // A copy, because nobody vouches that shared memory stays as it is.
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

    /// `:key`, and blanks around it where the dialect has them.
    fn key(&mut self, key: &str) {
        self.colon(key);
        self.space();
    }

    /// `:key` without the blank behind it.
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

/// A reader that expects no white space would see the end of the word there.
fn refuse_keyword<T>(
    word: &str,
    what: &'static str,
    keywords: &Keywords<T>,
) -> Result<(), EncodeError> {
    if holds_keyword(word, keywords) {
        let why = "it has a colon and the name of a parameter in it";
        return Err(EncodeError::Unrepresentable { what, why });
    }
    Ok(())
}
