//! Writing bit-efficient messages in the hand of a peer, content last as both have it.

use bytes::Bytes;

use crate::bitefficient::reader::{Form, string_form};
use crate::bitefficient::view::UNDEFINED_AGENT;
use crate::bitefficient::without_x;
use crate::bitefficient::write::{
    Hand, Out, write_agent_id_by, write_agent_set_by, write_date_time, write_len,
    write_local_date_time,
};
use crate::dialect::{check_word, local_time};
use crate::error::EncodeError;
use crate::word::is_token;
use crate::{Message, Performative, Time};

/// Whose hand to write in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Peer {
    FipaServices,
    Jade,
}

/// Writes the encoded message.
///
/// # Errors
/// When the peer could not read what the message says.
pub(crate) fn encode(message: &Message, peer: Peer, out: &mut dyn Out) -> Result<(), EncodeError> {
    Writer { out, peer }.message(message)
}

struct Writer<'a> {
    out: &'a mut dyn Out,
    peer: Peer,
}

impl Writer<'_> {
    fn message(&mut self, message: &Message) -> Result<(), EncodeError> {
        self.out.slice(&[0xfa, 0x10]);
        self.performative(&message.performative)?;
        // Each in its own order, though both read any.
        match self.peer {
            Peer::FipaServices => self.as_fipa_services(message)?,
            Peer::Jade => self.as_jade(message)?,
        }
        for (name, value) in &message.user_defined {
            self.user_defined(0x00, (name, value))?;
        }
        if let Some(content) = &message.content {
            self.out.byte(0x04);
            self.content(content);
        }
        self.out.byte(0x01);
        Ok(())
    }

    fn as_fipa_services(&mut self, message: &Message) -> Result<(), EncodeError> {
        if message.sender.is_none() {
            // What it writes itself.
            self.out.slice(b"\x02\x02\x10");
            self.out.slice(UNDEFINED_AGENT.as_bytes());
            self.out.slice(b"\0\x01");
        }
        self.sender(message)?;
        write_agent_set_by(self, 0x03, &message.receivers)?;
        self.text(0x05, "reply-with", message.reply_with())?;
        self.reply_by(message)?;
        self.text(0x07, "in-reply-to", message.in_reply_to())?;
        write_agent_set_by(self, 0x08, &message.reply_to)?;
        self.text(0x09, "language", message.language())?;
        self.text(0x0a, "encoding", message.encoding())?;
        self.text(0x0b, "ontology", message.ontology())?;
        self.protocol(message)?;
        self.text(0x0d, "conversation-id", message.conversation_id())
    }

    /// As far as its order is known from what it wrote.
    fn as_jade(&mut self, message: &Message) -> Result<(), EncodeError> {
        self.text(0x0b, "ontology", message.ontology())?;
        self.sender(message)?;
        write_agent_set_by(self, 0x03, &message.receivers)?;
        write_agent_set_by(self, 0x08, &message.reply_to)?;
        self.text(0x0d, "conversation-id", message.conversation_id())?;
        self.text(0x07, "in-reply-to", message.in_reply_to())?;
        self.text(0x05, "reply-with", message.reply_with())?;
        self.reply_by(message)?;
        self.text(0x09, "language", message.language())?;
        self.text(0x0a, "encoding", message.encoding())?;
        self.protocol(message)
    }

    fn sender(&mut self, message: &Message) -> Result<(), EncodeError> {
        let Some(sender) = &message.sender else {
            return Ok(());
        };
        self.out.byte(0x02);
        write_agent_id_by(self, sender)
    }

    fn reply_by(&mut self, message: &Message) -> Result<(), EncodeError> {
        let Some(time) = message.reply_by else {
            return Ok(());
        };
        self.out.byte(0x06);
        self.time(time)
    }

    fn protocol(&mut self, message: &Message) -> Result<(), EncodeError> {
        let Some(protocol) = &message.protocol else {
            return Ok(());
        };
        self.out.byte(0x0c);
        self.word("protocol", protocol)
    }

    fn performative(&mut self, performative: &Performative) -> Result<(), EncodeError> {
        let what = "user-defined performative";
        match performative.code() {
            Some(code) => self.out.byte(code),
            None if self.peer == Peer::Jade => {
                let why = "JADE reads none in a bit-efficient message";
                return Err(EncodeError::Unrepresentable { what, why });
            }
            None => {
                self.out.byte(0x00);
                self.word(what, performative.as_str())?;
            }
        }
        Ok(())
    }

    fn user_defined(&mut self, code: u8, (name, value): (&str, &str)) -> Result<(), EncodeError> {
        self.out.byte(code);
        let what = "name of a user-defined parameter";
        // fipa_services keeps names without X- in its memory, and does not add it here.
        if self.peer == Peer::FipaServices && without_x(name.as_bytes()) == name.as_bytes() {
            self.word(what, name)?;
        } else {
            self.word(what, &format!("X-{name}"))?;
        }
        self.expression("user-defined parameter", value)
    }

    fn text(
        &mut self,
        code: u8,
        what: &'static str,
        text: Option<&str>,
    ) -> Result<(), EncodeError> {
        let Some(text) = text else { return Ok(()) };
        self.out.byte(code);
        self.expression(what, text)
    }

    /// JADE takes for a word whatever stands up to the NUL.
    fn word(&mut self, what: &'static str, word: &str) -> Result<(), EncodeError> {
        if self.peer == Peer::FipaServices {
            check_word(what, word)?;
        }
        self.out.byte(0x10);
        self.out.slice(word.as_bytes());
        self.out.byte(0x00);
        Ok(())
    }

    fn expression(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        if self.peer == Peer::FipaServices {
            self.out.byte(0x14);
            // Its own writer escapes nothing, and cannot read then what it wrote.
            if text.contains('"') || text.ends_with('\\') {
                self.counted(text.as_bytes());
            } else {
                self.out.byte(b'"');
                self.out.slice(text.as_bytes());
                self.out.byte(b'"');
            }
            self.out.byte(0x00);
            return Ok(());
        }
        // JADE keeps quotation marks and byte counts as part of the text.
        if is_token(text) {
            return self.word(what, text);
        }
        if string_form(text.as_bytes()).0 == Form::Bare {
            self.out.byte(0x14);
            self.out.slice(text.as_bytes());
            self.out.byte(0x00);
            return Ok(());
        }
        // Longer ones it takes for negative ones.
        if text.len() >= 128 {
            let why = "JADE would misread a text in quotation marks of this length";
            return Err(EncodeError::Unrepresentable { what, why });
        }
        write_len(text.len(), self.out);
        self.out.slice(text.as_bytes());
        Ok(())
    }

    /// As a string where it can stand there as one, else with its length in front.
    fn content(&mut self, content: &Bytes) {
        // A copy, because nobody vouches that shared memory stays as it is.
        let content = content.to_vec();
        let is_string = memchr::memchr(0, &content).is_none()
            && match self.peer {
                Peer::FipaServices => true,
                Peer::Jade => {
                    string_form(&content).0 == Form::Bare && std::str::from_utf8(&content).is_ok()
                }
            };
        if !is_string {
            write_len(content.len(), self.out);
            self.out.slice(&content);
            return;
        }
        self.out.byte(0x14);
        match self.peer {
            Peer::FipaServices => self.counted(&content),
            Peer::Jade => self.out.slice(&content),
        }
        self.out.byte(0x00);
    }

    fn counted(&mut self, bytes: &[u8]) {
        self.out.slice(format!("#{}\"", bytes.len()).as_bytes());
        self.out.slice(bytes);
    }

    fn time(&mut self, time: Time) -> Result<(), EncodeError> {
        match self.peer {
            Peer::Jade => write_date_time(time, self.out),
            Peer::FipaServices => {
                write_local_date_time(local_time("reply-by", time)?, self.out);
            }
        }
        Ok(())
    }
}

impl Hand for Writer<'_> {
    fn byte(&mut self, byte: u8) {
        self.out.byte(byte);
    }

    fn name(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        self.word(what, text)
    }

    fn user_defined_of_agent(&mut self, name: &str, value: &str) -> Result<(), EncodeError> {
        self.user_defined(0x04, (name, value))
    }
}
