//! Writing bit-efficient messages strictly as FIPA00069 defines them, with the content last.

use bytes::{BufMut, Bytes, BytesMut};

use crate::bitefficient::code;
use crate::error::EncodeError;
use crate::time::{Base, Time, Zone};
use crate::word::{self, Piece, Shape, is_word};
use crate::{AgentId, Message, Payload};

/// Length of the encoded message in the standard's dialect, in bytes.
#[must_use]
pub fn encoded_len(message: &Message) -> usize {
    let content_len = message.content.as_ref().map(Bytes::len);
    head_len(message, content_len) + content_len.unwrap_or(0) + TAIL.len()
}

/// Writes the encoded message, [`encoded_len`] bytes, in the standard's dialect.
///
/// # Panics
/// If the buffer has a fixed capacity and less space than that.
pub fn encode(message: &Message, out: &mut impl BufMut) {
    let content_len = message.content.as_ref().map(Bytes::len);
    let mut sink = Sink::new(out);
    write_head(message, content_len, &mut sink);
    sink.slice(message.content.as_deref().unwrap_or_default());
    sink.slice(TAIL);
    sink.flush();
}

impl Message {
    /// Encodes the message (FIPA00069) in the standard's dialect. The result shares the memory of
    /// the content.
    #[must_use]
    pub fn to_payload(&self) -> Payload {
        match &self.content {
            None => {
                let mut out = BytesMut::with_capacity(encoded_len(self));
                encode(self, &mut out);
                out.freeze().into()
            }
            Some(content) => Payload {
                head: {
                    let content_len = Some(content.len());
                    let mut out = BytesMut::with_capacity(head_len(self, content_len));
                    append_head(self, content_len, &mut out);
                    out.freeze()
                },
                content: content.clone(),
                tail: Bytes::from_static(TAIL),
            },
        }
    }
}

/// The bytes behind the content: the end of the message.
pub(crate) const TAIL: &[u8] = &[code::END];

/// Length of the bytes in front of the content, including its length field.
pub(crate) fn head_len(message: &Message, content_len: Option<usize>) -> usize {
    let mut counter = Counter(0);
    write_head(message, content_len, &mut counter);
    counter.0
}

/// Appends the bytes in front of the content, including its length field.
pub(crate) fn append_head(message: &Message, content_len: Option<usize>, out: &mut impl BufMut) {
    let mut sink = Sink::new(out);
    write_head(message, content_len, &mut sink);
    sink.flush();
}

/// Receives encoded bytes: a buffer, or a counter of their number. One code path serves both, so
/// they always agree.
pub(crate) trait Output {
    fn byte(&mut self, byte: u8);
    fn slice(&mut self, bytes: &[u8]);

    /// Appends bytes if their copy satisfies a condition. Returns whether they were appended. An
    /// output that cannot check its own copy appends none.
    fn slice_if(&mut self, _bytes: &[u8], _is_wanted: &dyn Fn(&[u8]) -> bool) -> bool {
        false
    }

    /// Appends three slices.
    #[inline]
    fn framed<const N: usize, const M: usize>(
        &mut self,
        before: [u8; N],
        bytes: &[u8],
        behind: [u8; M],
    ) where
        Self: Sized,
    {
        self.slice(&before);
        self.slice(bytes);
        self.slice(&behind);
    }
}

pub(crate) struct Counter(pub(crate) usize);

impl Output for Counter {
    #[inline]
    fn byte(&mut self, _: u8) {
        self.0 += 1;
    }

    #[inline]
    fn slice(&mut self, bytes: &[u8]) {
        self.0 += bytes.len();
    }
}

/// Collects the many small pieces of a head, because a growing buffer checks its capacity for each
/// of them.
pub(crate) struct Sink<'a, B: BufMut> {
    out: &'a mut B,
    collected: [u8; 256],
    len: usize,
}

impl<'a, B: BufMut> Sink<'a, B> {
    pub(crate) fn new(out: &'a mut B) -> Self {
        Self {
            out,
            collected: [0; 256],
            len: 0,
        }
    }

    #[inline(never)]
    fn slices(&mut self, slices: [&[u8]; 3]) {
        slices.into_iter().for_each(|slice| self.slice(slice));
    }

    /// Writes the collected bytes to the buffer. The caller must call this at the end.
    pub(crate) fn flush(&mut self) {
        let collected = self.collected.get(..self.len).unwrap_or_default();
        self.out.put_slice(collected);
        self.len = 0;
    }
}

impl<B: BufMut> Output for Sink<'_, B> {
    #[inline]
    fn byte(&mut self, byte: u8) {
        self.slice(&[byte]);
    }

    #[inline]
    fn slice(&mut self, bytes: &[u8]) {
        if self.len + bytes.len() > self.collected.len() {
            self.flush();
        }
        match self.collected.get_mut(self.len..self.len + bytes.len()) {
            Some(free) => {
                free.copy_from_slice(bytes);
                self.len += bytes.len();
            }
            // The slice is longer than the whole array, which is empty now.
            None => self.out.put_slice(bytes),
        }
    }

    /// Copies all three slices at once if there is space.
    #[inline(always)]
    fn framed<const N: usize, const M: usize>(
        &mut self,
        before: [u8; N],
        bytes: &[u8],
        behind: [u8; M],
    ) {
        let free = self.collected.get_mut(self.len..).unwrap_or_default();
        if let Some((first, free)) = free.split_first_chunk_mut::<N>()
            && let Some((middle, free)) = free.split_at_mut_checked(bytes.len())
            && let Some((last, _)) = free.split_first_chunk_mut::<M>()
        {
            *first = before;
            copy_short(middle, bytes);
            *last = behind;
            self.len += N + bytes.len() + M;
        } else {
            self.slices([&before, bytes, &behind]);
        }
    }
}

/// Copies a few bytes as two overlapping chunks, which is faster than a call of `memcpy`.
#[inline(always)]
fn copy_short(to: &mut [u8], from: &[u8]) {
    if from.len() <= 16
        && let (Some(first), Some(last)) = (from.first_chunk::<8>(), from.last_chunk::<8>())
    {
        to.first_chunk_mut().into_iter().for_each(|to| *to = *first);
        to.last_chunk_mut().into_iter().for_each(|to| *to = *last);
    } else if from.len() <= 32
        && let (Some(first), Some(last)) = (from.first_chunk::<16>(), from.last_chunk::<16>())
    {
        to.first_chunk_mut().into_iter().for_each(|to| *to = *first);
        to.last_chunk_mut().into_iter().for_each(|to| *to = *last);
    } else {
        to.copy_from_slice(from);
    }
}

impl Output for Vec<u8> {
    fn byte(&mut self, byte: u8) {
        self.push(byte);
    }

    fn slice(&mut self, bytes: &[u8]) {
        self.extend_from_slice(bytes);
    }

    fn slice_if(&mut self, bytes: &[u8], is_wanted: &dyn Fn(&[u8]) -> bool) -> bool {
        let before = self.len();
        self.extend_from_slice(bytes);
        let wanted = self.get(before..).is_some_and(is_wanted);
        if !wanted {
            self.truncate(before);
        }
        wanted
    }
}

/// Writes the bytes in front of the content, including its length.
fn write_head(message: &Message, content_len: Option<usize>, out: &mut impl Output) {
    out.slice(&[code::message_id::PLAIN, code::VERSION_1_0]);
    match message.performative.code() {
        Some(act) => out.byte(act),
        None => {
            out.byte(code::USER_DEFINED_PERFORMATIVE);
            write_word(message.performative.as_str(), out);
        }
    }
    match &message.sender {
        Some(sender) if sender.is_plain() => out.framed(
            [code::message::SENDER, code::agent::BEGIN, code::token::WORD],
            sender.name().as_bytes(),
            [0x00, code::END],
        ),
        Some(sender) => {
            out.byte(code::message::SENDER);
            write_agent_id(sender, out);
        }
        None => {}
    }
    write_set(code::message::RECEIVER, &message.receivers, out);
    write_text(
        code::message::REPLY_WITH,
        message.reply_with.as_deref(),
        out,
    );
    if let Some(reply_by) = message.reply_by {
        out.byte(code::message::REPLY_BY);
        write_date_time(reply_by, out);
    }
    write_text(
        code::message::IN_REPLY_TO,
        message.in_reply_to.as_deref(),
        out,
    );
    write_set(code::message::REPLY_TO, &message.reply_to, out);
    write_text(code::message::LANGUAGE, message.language.as_deref(), out);
    write_text(code::message::ENCODING, message.encoding.as_deref(), out);
    write_text(code::message::ONTOLOGY, message.ontology.as_deref(), out);
    if let Some(protocol) = &message.protocol {
        out.byte(code::message::PROTOCOL);
        write_word(protocol, out);
    }
    let conversation_id = message.conversation_id.as_deref();
    write_text(code::message::CONVERSATION_ID, conversation_id, out);
    for (name, value) in &message.user_defined {
        out.byte(code::message::USER_DEFINED);
        write_user_defined(name, value, out);
    }
    if let Some(len) = content_len {
        out.byte(code::message::CONTENT);
        write_len(len, out);
    }
}

fn write_text(parameter: u8, text: Option<&str>, out: &mut impl Output) {
    let Some(text) = text else { return };
    let bytes = text.as_bytes();
    match Shape::of(text) {
        Shape::Word => out.framed([parameter, code::token::WORD], bytes, [0x00]),
        Shape::Quotable => {
            out.framed([parameter, code::token::STRING, b'"'], bytes, [b'"', 0x00]);
        }
        Shape::Other => {
            out.byte(parameter);
            write_expression(text, out);
        }
    }
}

fn write_set(parameter: u8, agents: &[AgentId], out: &mut impl Output) {
    match agents {
        [] => {}
        [agent] if agent.is_plain() => {
            out.framed(
                [parameter, code::agent::BEGIN, code::token::WORD],
                agent.name().as_bytes(),
                [0x00, code::END, code::END],
            );
        }
        _ => {
            out.byte(parameter);
            write_agent_ids(agents, out);
        }
    }
}

fn write_agent_ids(agents: &[AgentId], out: &mut impl Output) {
    for agent in agents {
        write_agent_id(agent, out);
    }
    out.byte(code::END);
}

fn write_agent_id(agent: &AgentId, out: &mut impl Output) {
    out.framed(
        [code::agent::BEGIN, code::token::WORD],
        agent.name().as_bytes(),
        [0x00],
    );
    if !agent.addresses().is_empty() {
        out.byte(code::agent::ADDRESSES);
        for address in agent.addresses() {
            write_word(address, out);
        }
        out.byte(code::END);
    }
    if !agent.resolvers().is_empty() {
        out.byte(code::agent::RESOLVERS);
        write_agent_ids(agent.resolvers(), out);
    }
    for (name, value) in agent.user_defined() {
        out.byte(code::agent::USER_DEFINED);
        write_user_defined(name, value, out);
    }
    out.byte(code::END);
}

/// Writes texts in one of the bit-efficient encodings and one of the dialects.
pub(crate) trait TextWriter {
    fn byte(&mut self, byte: u8);

    /// Writes a name or an address.
    fn name(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError>;

    /// Writes a user-defined parameter of an agent identifier, including its code.
    fn user_defined_of_agent(&mut self, name: &str, value: &str) -> Result<(), EncodeError>;
}

/// Writes an agent identifier, with its parts in the only order that fipa_services reads.
pub(crate) fn write_agent_id_by(
    writer: &mut impl TextWriter,
    agent: &AgentId,
) -> Result<(), EncodeError> {
    writer.byte(code::agent::BEGIN);
    writer.name("name of an agent", agent.name())?;
    if !agent.addresses().is_empty() {
        writer.byte(code::agent::ADDRESSES);
        for address in agent.addresses() {
            writer.name("address of an agent", address)?;
        }
        writer.byte(code::END);
    }
    write_agent_set_by(writer, code::agent::RESOLVERS, agent.resolvers())?;
    for (name, value) in agent.user_defined() {
        writer.user_defined_of_agent(name, value)?;
    }
    writer.byte(code::END);
    Ok(())
}

/// Writes a set of agent identifiers and the code in front of it, unless the set is empty.
pub(crate) fn write_agent_set_by(
    writer: &mut impl TextWriter,
    parameter: u8,
    agents: &[AgentId],
) -> Result<(), EncodeError> {
    if agents.is_empty() {
        return Ok(());
    }
    writer.byte(parameter);
    for agent in agents {
        write_agent_id_by(writer, agent)?;
    }
    writer.byte(code::END);
    Ok(())
}

fn write_user_defined(name: &str, value: &str, out: &mut impl Output) {
    out.framed([code::token::WORD, b'X', b'-'], name.as_bytes(), [0x00]);
    write_expression(value, out);
}

fn write_word(word: &str, out: &mut impl Output) {
    out.framed([code::token::WORD], word.as_bytes(), [0x00]);
}

/// Writes a text as a word if it is one, and as a string literal otherwise. It is never split into
/// coded numbers and sub-expressions, because no peer reads those without errors.
fn write_expression(text: &str, out: &mut impl Output) {
    if is_word(text) {
        write_word(text, out);
        return;
    }
    out.byte(code::token::STRING);
    word::string_literal(text, |piece| match piece {
        Piece::Text(text) => out.slice(text.as_bytes()),
        Piece::LengthPrefix(len) => {
            out.byte(b'#');
            out.slice(len.to_string().as_bytes());
            out.byte(b'"');
        }
    });
    out.byte(0x00);
}

/// Writes the code and the length of a `BinString` with a length.
pub(crate) fn write_len(len: usize, out: &mut (impl Output + ?Sized)) {
    if let Ok(len) = u8::try_from(len) {
        out.slice(&[code::token::LEN8, len]);
    } else if let Ok(len) = u16::try_from(len) {
        out.byte(code::token::LEN16);
        out.slice(&len.to_be_bytes());
    } else {
        // `Message::MAX_CONTENT` bounds the length.
        let len = u32::try_from(len).unwrap_or(u32::MAX);
        out.byte(code::token::LEN32);
        out.slice(&len.to_be_bytes());
    }
}

/// Writes a `BinDateTimeToken` (FIPA00069 2.2) with three digits of milliseconds and padding.
pub(crate) fn write_date_time(time: Time, out: &mut (impl Output + ?Sized)) {
    let base = match time.base {
        Base::Absolute => code::date_time::ABSOLUTE,
        Base::After => code::date_time::AFTER,
        Base::Before => code::date_time::BEFORE,
    };
    let letter = match time.zone {
        Zone::Unspecified => None,
        Zone::Utc => Some(b'Z'),
        Zone::Letter(letter) => u8::try_from(letter).ok(),
    };
    out.byte(match letter {
        Some(_) => base + code::date_time::WITH_DESIGNATOR,
        None => base,
    });
    write_seconds(time, out);
    let millisecond = time.fields.millisecond;
    out.slice(&[
        two_digits(millisecond / 10),
        ((millisecond % 10 + 1) << 4) as u8,
    ]);
    if let Some(letter) = letter {
        out.byte(letter);
    }
}

/// Writes an absolute time as fipa_services does: without its zone, with four digits of
/// milliseconds.
pub(crate) fn write_local_date_time(time: Time, out: &mut (impl Output + ?Sized)) {
    out.byte(code::date_time::ABSOLUTE);
    write_seconds(time, out);
    let millisecond = time.fields.millisecond;
    out.slice(&[two_digits(millisecond / 100), two_digits(millisecond % 100)]);
}

/// Writes the fields from year to second.
fn write_seconds(time: Time, out: &mut (impl Output + ?Sized)) {
    let of = time.fields;
    let year = of.year;
    let [month, day, hour, minute, second] =
        [of.month, of.day, of.hour, of.minute, of.second].map(u16::from);
    let fields = [year / 100, year % 100, month, day, hour, minute, second];
    out.slice(&fields.map(two_digits));
}

/// Encodes a number below 100.
#[inline]
fn two_digits(number: u16) -> u8 {
    const DIGITS: [u8; 100] = {
        let mut digits = [0; 100];
        let mut number = 0;
        while number < digits.len() {
            digits[number] = ((number / 10 + 1) << 4 | (number % 10 + 1)) as u8;
            number += 1;
        }
        digits
    };
    // No field of a time exceeds 99.
    DIGITS.get(usize::from(number)).copied().unwrap_or(0x11)
}

/// Writes a number as `Digits` (FIPA00069 2.4, note 5).
pub(crate) fn write_digits(number: u64, out: &mut impl Output) {
    // The codes of at most 20 digits, the last digit first.
    let mut nibbles = [0; 20];
    let mut len = 0;
    let mut rest = number;
    for nibble in &mut nibbles {
        *nibble = (rest % 10) as u8 + 1;
        len += 1;
        rest /= 10;
        if rest == 0 {
            break;
        }
    }
    let digits = nibbles.get(..len).unwrap_or_default();
    for pair in digits.rchunks(2) {
        out.byte(match *pair {
            [second, first] => first << 4 | second,
            [last] => last << 4,
            _ => 0,
        });
    }
    if len.is_multiple_of(2) {
        out.byte(0x00);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_are_written_as_the_standard_codes_them() {
        for (number, bytes) in [
            (0, &[0x10][..]),
            (7, &[0x80]),
            (42, &[0x53, 0x00]),
            (100, &[0x21, 0x10]),
            (65536, &[0x76, 0x64, 0x70]),
            (
                u64::MAX,
                &[
                    0x29, 0x55, 0x78, 0x55, 0x18, 0x48, 0x1a, 0x66, 0x27, 0x26, 0x00,
                ],
            ),
        ] {
            let mut out = Vec::new();
            write_digits(number, &mut out);
            assert_eq!(out, bytes, "{number}");
        }
    }

    #[test]
    fn dates_are_written_as_the_standard_codes_them() {
        let mut out = Vec::new();
        write_date_time("20000508T042651481".parse().unwrap(), &mut out);
        let expected = [0x20, 0x31, 0x11, 0x16, 0x19, 0x15, 0x37, 0x62, 0x59, 0x20];
        assert_eq!(out, expected);
        out.clear();
        write_date_time("+00000000T000030000".parse().unwrap(), &mut out);
        let expected = [0x21, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x41, 0x11, 0x10];
        assert_eq!(out, expected);
    }

    #[test]
    fn texts_longer_than_the_sink_are_written_in_order() {
        for len in [200, 255, 256, 257, 600] {
            let message = Message::builder(crate::Performative::Inform)
                .language("l".repeat(len))
                .ontology("o")
                .conversation_id("c c".repeat(len))
                .build()
                .unwrap();
            let payload = message.to_payload();
            assert_eq!(payload.len(), encoded_len(&message));
            assert_eq!(Message::decode(&payload), Ok(message), "{len}");
        }
    }

    #[test]
    fn lengths_have_the_shortest_form() {
        for (len, bytes) in [
            (0, &[0x16, 0][..]),
            (255, &[0x16, 255]),
            (256, &[0x17, 1, 0]),
            (65_536, &[0x19, 0, 1, 0, 0]),
        ] {
            let mut out = Vec::new();
            write_len(len, &mut out);
            assert_eq!(out, bytes);
        }
    }
}
