//! Writing bit-efficient messages in the dialect of a peer. The content is last, as both peers write
//! it.

use bytes::Bytes;

use crate::bitefficient::code;
use crate::bitefficient::reader::{Form, string_form};
use crate::bitefficient::view::UNDEFINED_AGENT;
use crate::bitefficient::without_x;
use crate::bitefficient::write::{
    Output, TextWriter, write_agent_id_by, write_agent_set_by, write_date_time, write_len,
    write_local_date_time,
};
use crate::dialect::{check_word, local_time};
use crate::error::EncodeError;
use crate::word::is_token;
use crate::{Message, Performative, Time};

/// The peer that reads the message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Peer {
    FipaServices,
    Jade,
}

/// Writes the encoded message.
///
/// # Errors
/// The peer cannot read a value of the message.
pub(crate) fn encode(
    message: &Message,
    peer: Peer,
    out: &mut dyn Output,
) -> Result<(), EncodeError> {
    Writer { out, peer }.message(message)
}

struct Writer<'a> {
    out: &'a mut dyn Output,
    peer: Peer,
}

impl Writer<'_> {
    fn message(&mut self, message: &Message) -> Result<(), EncodeError> {
        self.out
            .slice(&[code::message_id::PLAIN, code::VERSION_1_0]);
        self.performative(&message.performative)?;
        // Both peers read the parameters in any order. The order here is the one each peer writes.
        match self.peer {
            Peer::FipaServices => self.as_fipa_services(message)?,
            Peer::Jade => self.as_jade(message)?,
        }
        for (name, value) in &message.user_defined {
            self.user_defined(code::message::USER_DEFINED, name, value)?;
        }
        if let Some(content) = &message.content {
            self.out.byte(code::message::CONTENT);
            self.content(content);
        }
        self.out.byte(code::END);
        Ok(())
    }

    fn as_fipa_services(&mut self, message: &Message) -> Result<(), EncodeError> {
        if message.sender.is_none() {
            // fipa_services writes this identifier itself.
            self.out.slice(&[code::message::SENDER, code::agent::BEGIN]);
            self.terminated(code::token::WORD, UNDEFINED_AGENT);
            self.out.byte(code::END);
        }
        self.sender(message)?;
        self.receivers(message)?;
        self.reply_with(message)?;
        self.reply_by(message)?;
        self.in_reply_to(message)?;
        self.reply_to(message)?;
        self.language(message)?;
        self.encoding(message)?;
        self.ontology(message)?;
        self.protocol(message)?;
        self.conversation_id(message)
    }

    /// Writes the parameters in the order of the recorded messages of JADE.
    fn as_jade(&mut self, message: &Message) -> Result<(), EncodeError> {
        self.ontology(message)?;
        self.sender(message)?;
        self.receivers(message)?;
        self.reply_to(message)?;
        self.conversation_id(message)?;
        self.in_reply_to(message)?;
        self.reply_with(message)?;
        self.reply_by(message)?;
        self.language(message)?;
        self.encoding(message)?;
        self.protocol(message)
    }

    fn receivers(&mut self, message: &Message) -> Result<(), EncodeError> {
        write_agent_set_by(self, code::message::RECEIVER, &message.receivers)
    }

    fn reply_to(&mut self, message: &Message) -> Result<(), EncodeError> {
        write_agent_set_by(self, code::message::REPLY_TO, &message.reply_to)
    }

    fn reply_with(&mut self, message: &Message) -> Result<(), EncodeError> {
        self.text(
            code::message::REPLY_WITH,
            "reply-with",
            message.reply_with(),
        )
    }

    fn in_reply_to(&mut self, message: &Message) -> Result<(), EncodeError> {
        let text = message.in_reply_to();
        self.text(code::message::IN_REPLY_TO, "in-reply-to", text)
    }

    fn language(&mut self, message: &Message) -> Result<(), EncodeError> {
        self.text(code::message::LANGUAGE, "language", message.language())
    }

    fn encoding(&mut self, message: &Message) -> Result<(), EncodeError> {
        self.text(code::message::ENCODING, "encoding", message.encoding())
    }

    fn ontology(&mut self, message: &Message) -> Result<(), EncodeError> {
        self.text(code::message::ONTOLOGY, "ontology", message.ontology())
    }

    fn conversation_id(&mut self, message: &Message) -> Result<(), EncodeError> {
        let text = message.conversation_id();
        self.text(code::message::CONVERSATION_ID, "conversation-id", text)
    }

    fn sender(&mut self, message: &Message) -> Result<(), EncodeError> {
        let Some(sender) = &message.sender else {
            return Ok(());
        };
        self.out.byte(code::message::SENDER);
        write_agent_id_by(self, sender)
    }

    fn reply_by(&mut self, message: &Message) -> Result<(), EncodeError> {
        let Some(time) = message.reply_by else {
            return Ok(());
        };
        self.out.byte(code::message::REPLY_BY);
        self.time(time)
    }

    fn protocol(&mut self, message: &Message) -> Result<(), EncodeError> {
        let Some(protocol) = &message.protocol else {
            return Ok(());
        };
        self.out.byte(code::message::PROTOCOL);
        self.word("protocol", protocol)
    }

    fn performative(&mut self, performative: &Performative) -> Result<(), EncodeError> {
        let what = "user-defined performative";
        match performative.code() {
            Some(act) => self.out.byte(act),
            None if self.peer == Peer::Jade => {
                let why = "JADE reads only standard performatives in a bit-efficient message";
                return Err(EncodeError::Unrepresentable { what, why });
            }
            None => {
                self.out.byte(code::USER_DEFINED_PERFORMATIVE);
                self.word(what, performative.as_str())?;
            }
        }
        Ok(())
    }

    fn user_defined(&mut self, code: u8, name: &str, value: &str) -> Result<(), EncodeError> {
        self.out.byte(code);
        let what = "name of a user-defined parameter";
        // fipa_services stores names without X- and does not add it here.
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

    /// Writes a word. JADE reads any text up to the NUL as one.
    fn word(&mut self, what: &'static str, word: &str) -> Result<(), EncodeError> {
        if self.peer == Peer::FipaServices {
            check_word(what, word)?;
        }
        self.terminated(code::token::WORD, word);
        Ok(())
    }

    /// Writes a code, a text and a NUL.
    fn terminated(&mut self, code: u8, text: &str) {
        self.out.byte(code);
        self.out.slice(text.as_bytes());
        self.out.byte(0x00);
    }

    fn expression(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        if self.peer == Peer::FipaServices {
            self.out.byte(code::token::STRING);
            // fipa_services itself writes these texts without escapes, and then cannot read them.
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
            self.terminated(code::token::STRING, text);
            return Ok(());
        }
        // JADE reads the length as a signed byte.
        if text.len() >= 128 {
            let why = "JADE misreads a text of 128 bytes or more that is in quotation marks";
            return Err(EncodeError::Unrepresentable { what, why });
        }
        write_len(text.len(), self.out);
        self.out.slice(text.as_bytes());
        Ok(())
    }

    /// Writes content as a string if the peer reads it as one, and with its length otherwise.
    fn content(&mut self, content: &Bytes) {
        // A copy, because another process may change shared memory at any time.
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
        self.out.byte(code::token::STRING);
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

impl TextWriter for Writer<'_> {
    fn byte(&mut self, byte: u8) {
        self.out.byte(byte);
    }

    fn name(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        self.word(what, text)
    }

    fn user_defined_of_agent(&mut self, name: &str, value: &str) -> Result<(), EncodeError> {
        self.user_defined(code::agent::USER_DEFINED, name, value)
    }
}
