//! Writing bit-efficient messages: FIPA00069 to the letter, content last.

use bytes::{BufMut, Bytes, BytesMut};

use crate::error::EncodeError;
use crate::time::{Base, Fields, Time, Zone};
use crate::word::{self, Piece, Shape, is_word};
use crate::{AgentId, Message, Payload};

/// Length of the encoded message in bytes.
#[must_use]
pub fn encoded_len(message: &Message) -> usize {
    let mut counter = Counter(0);
    let content_len = message.content.as_ref().map(Bytes::len);
    write_head(message, content_len, &mut counter);
    counter.0 + content_len.unwrap_or(0) + TAIL.len()
}

/// Writes the encoded message: [`encoded_len`] bytes.
///
/// # Panics
/// When the buffer has a limit and less room than that.
pub fn encode(message: &Message, out: &mut impl BufMut) {
    let content_len = message.content.as_ref().map(Bytes::len);
    let mut sink = Sink::new(out);
    write_head(message, content_len, &mut sink);
    sink.slice(message.content.as_deref().unwrap_or_default());
    sink.slice(TAIL);
    sink.flush();
}

impl Message {
    /// The encoded message (FIPA00069), in pieces that share the memory of the content.
    #[must_use]
    pub fn to_payload(&self) -> Payload {
        match &self.content {
            None => {
                let mut out = BytesMut::with_capacity(encoded_len(self));
                encode(self, &mut out);
                out.freeze().into()
            }
            Some(content) => Payload {
                head: head(self, content.len()),
                content: content.clone(),
                tail: Bytes::from_static(TAIL),
            },
        }
    }

    /// What stands in front of content of `content_len` bytes, its length included, and what
    /// stands behind it. The content that the message has is left out: this is for writing around
    /// memory that the application fills itself.
    ///
    /// # Errors
    /// When the content is longer than [`Message::MAX_CONTENT`].
    pub fn around_content(&self, content_len: usize) -> Result<(Bytes, Bytes), EncodeError> {
        if content_len as u64 > Self::MAX_CONTENT {
            return Err(EncodeError::ContentTooLong(content_len));
        }
        Ok((head(self, content_len), Bytes::from_static(TAIL)))
    }
}

/// What follows the content: the end of the message.
const TAIL: &[u8] = &[0x01];

fn head(message: &Message, content_len: usize) -> Bytes {
    let mut counter = Counter(0);
    write_head(message, Some(content_len), &mut counter);
    let mut out = BytesMut::with_capacity(counter.0);
    let mut sink = Sink::new(&mut out);
    write_head(message, Some(content_len), &mut sink);
    sink.flush();
    out.freeze()
}

/// Where bytes go: into a buffer, or only counted, so that both always agree.
pub(crate) trait Out {
    fn byte(&mut self, byte: u8);
    fn slice(&mut self, bytes: &[u8]);

    /// Appends bytes whose copy satisfies a condition. Returns whether they were appended; what cannot
    /// check its own copy appends none.
    fn slice_if(&mut self, _bytes: &[u8], _is_wanted: &dyn Fn(&[u8]) -> bool) -> bool {
        false
    }

    /// The same as three slices.
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

impl Out for Counter {
    #[inline]
    fn byte(&mut self, _: u8) {
        self.0 += 1;
    }

    #[inline]
    fn slice(&mut self, bytes: &[u8]) {
        self.0 += bytes.len();
    }
}

/// Collects the many small pieces of a head, because every one of them costs a growing buffer a
/// check of its room.
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

    /// Hands on what was collected; to be called in the end.
    pub(crate) fn flush(&mut self) {
        let collected = self.collected.get(..self.len).unwrap_or_default();
        self.out.put_slice(collected);
        self.len = 0;
    }
}

impl<B: BufMut> Out for Sink<'_, B> {
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
            Some(room) => {
                room.copy_from_slice(bytes);
                self.len += bytes.len();
            }
            // Longer than all the room there is, which is empty now.
            None => self.out.put_slice(bytes),
        }
    }

    /// All at once, where there is room.
    #[inline(always)]
    fn framed<const N: usize, const M: usize>(
        &mut self,
        before: [u8; N],
        bytes: &[u8],
        behind: [u8; M],
    ) {
        let room = self.collected.get_mut(self.len..).unwrap_or_default();
        if let Some((first, room)) = room.split_first_chunk_mut::<N>()
            && let Some((middle, room)) = room.split_at_mut_checked(bytes.len())
            && let Some((last, _)) = room.split_first_chunk_mut::<M>()
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

/// Copies a few bytes: in two that overlap, which is quicker than to call the function for many.
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

impl Out for Vec<u8> {
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

/// Everything in front of the content, its length included.
fn write_head(message: &Message, content_len: Option<usize>, out: &mut impl Out) {
    out.slice(&[0xfa, 0x10]);
    match message.performative.code() {
        Some(code) => out.byte(code),
        None => {
            out.byte(0x00);
            write_word(message.performative.as_str(), out);
        }
    }
    match &message.sender {
        Some(sender) if sender.is_plain() => {
            out.framed(*b"\x02\x02\x10", sender.name().as_bytes(), *b"\x00\x01");
        }
        Some(sender) => {
            out.byte(0x02);
            write_agent_id(sender, out);
        }
        None => {}
    }
    write_set(0x03, &message.receivers, out);
    write_text(0x05, message.reply_with.as_deref(), out);
    if let Some(reply_by) = message.reply_by {
        out.byte(0x06);
        write_date_time(reply_by, out);
    }
    write_text(0x07, message.in_reply_to.as_deref(), out);
    write_set(0x08, &message.reply_to, out);
    write_text(0x09, message.language.as_deref(), out);
    write_text(0x0a, message.encoding.as_deref(), out);
    write_text(0x0b, message.ontology.as_deref(), out);
    if let Some(protocol) = &message.protocol {
        out.byte(0x0c);
        write_word(protocol, out);
    }
    write_text(0x0d, message.conversation_id.as_deref(), out);
    for (name, value) in &message.user_defined {
        out.byte(0x00);
        write_user_defined(name, value, out);
    }
    if let Some(len) = content_len {
        out.byte(0x04);
        write_len(len, out);
    }
}

fn write_text(code: u8, text: Option<&str>, out: &mut impl Out) {
    let Some(text) = text else { return };
    let bytes = text.as_bytes();
    match Shape::of(text) {
        Shape::Word => out.framed([code, 0x10], bytes, [0x00]),
        Shape::Quotable => out.framed([code, 0x14, b'"'], bytes, [b'"', 0x00]),
        Shape::Other => {
            out.byte(code);
            write_expression(text, out);
        }
    }
}

fn write_set(code: u8, agents: &[AgentId], out: &mut impl Out) {
    match agents {
        [] => {}
        [agent] if agent.is_plain() => {
            out.framed(
                [code, 0x02, 0x10],
                agent.name().as_bytes(),
                *b"\x00\x01\x01",
            );
        }
        _ => {
            out.byte(code);
            write_agent_ids(agents, out);
        }
    }
}

fn write_agent_ids(agents: &[AgentId], out: &mut impl Out) {
    for agent in agents {
        write_agent_id(agent, out);
    }
    out.byte(0x01);
}

fn write_agent_id(agent: &AgentId, out: &mut impl Out) {
    out.framed([0x02, 0x10], agent.name().as_bytes(), [0x00]);
    if !agent.addresses().is_empty() {
        out.byte(0x02);
        for address in agent.addresses() {
            write_word(address, out);
        }
        out.byte(0x01);
    }
    if !agent.resolvers().is_empty() {
        out.byte(0x03);
        write_agent_ids(agent.resolvers(), out);
    }
    for (name, value) in agent.user_defined() {
        out.byte(0x04);
        write_user_defined(name, value, out);
    }
    out.byte(0x01);
}

/// How texts are written in one of the bit-efficient formats for one of the readers.
pub(crate) trait Hand {
    fn byte(&mut self, byte: u8);

    /// A name or an address.
    fn name(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError>;

    /// A user-defined parameter of an agent identifier, with its code.
    fn user_defined_of_agent(&mut self, name: &str, value: &str) -> Result<(), EncodeError>;
}

/// An agent identifier, the parts in the only order that fipa_services reads.
pub(crate) fn write_agent_id_by(hand: &mut impl Hand, agent: &AgentId) -> Result<(), EncodeError> {
    hand.byte(0x02);
    hand.name("name of an agent", agent.name())?;
    if !agent.addresses().is_empty() {
        hand.byte(0x02);
        for address in agent.addresses() {
            hand.name("address of an agent", address)?;
        }
        hand.byte(0x01);
    }
    write_agent_set_by(hand, 0x03, agent.resolvers())?;
    for (name, value) in agent.user_defined() {
        hand.user_defined_of_agent(name, value)?;
    }
    hand.byte(0x01);
    Ok(())
}

/// A set of agent identifiers with its code, unless it is empty.
pub(crate) fn write_agent_set_by(
    hand: &mut impl Hand,
    code: u8,
    agents: &[AgentId],
) -> Result<(), EncodeError> {
    if agents.is_empty() {
        return Ok(());
    }
    hand.byte(code);
    for agent in agents {
        write_agent_id_by(hand, agent)?;
    }
    hand.byte(0x01);
    Ok(())
}

fn write_user_defined(name: &str, value: &str, out: &mut impl Out) {
    out.framed(*b"\x10X-", name.as_bytes(), [0x00]);
    write_expression(value, out);
}

fn write_word(word: &str, out: &mut impl Out) {
    out.framed([0x10], word.as_bytes(), [0x00]);
}

/// A word where it is one, else a string literal. Text is never taken apart into coded numbers and
/// sub-expressions: no peer reads those without errors.
fn write_expression(text: &str, out: &mut impl Out) {
    if is_word(text) {
        write_word(text, out);
        return;
    }
    out.byte(0x14);
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

/// Code and length of a `BinString` that is given with its length.
pub(crate) fn write_len(len: usize, out: &mut (impl Out + ?Sized)) {
    if let Ok(len) = u8::try_from(len) {
        out.slice(&[0x16, len]);
    } else if let Ok(len) = u16::try_from(len) {
        out.byte(0x17);
        out.slice(&len.to_be_bytes());
    } else {
        // A message has no more content than this can say (`Message::MAX_CONTENT`).
        let len = u32::try_from(len).unwrap_or(u32::MAX);
        out.byte(0x19);
        out.slice(&len.to_be_bytes());
    }
}

/// A `BinDateTime` (FIPA00069 2.3), three digits of milliseconds and padding.
pub(crate) fn write_date_time(time: Time, out: &mut (impl Out + ?Sized)) {
    let base = match time.base {
        Base::Absolute => 0x20,
        Base::After => 0x21,
        Base::Before => 0x22,
    };
    let letter = match time.zone {
        Zone::Unspecified => None,
        Zone::Utc => Some(b'Z'),
        Zone::Letter(letter) => u8::try_from(letter).ok(),
    };
    out.byte(base + if letter.is_some() { 4 } else { 0 });
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

/// The same as fipa_services writes it, whatever the zone: four digits of milliseconds.
pub(crate) fn write_local_date_time(time: Time, out: &mut (impl Out + ?Sized)) {
    out.byte(0x20);
    write_seconds(time, out);
    let millisecond = time.fields.millisecond;
    out.slice(&[two_digits(millisecond / 100), two_digits(millisecond % 100)]);
}

/// Year to seconds.
fn write_seconds(time: Time, out: &mut (impl Out + ?Sized)) {
    let Fields {
        year,
        month,
        day,
        hour,
        minute,
        second,
        millisecond: _,
    } = time.fields;
    let [month, day, hour, minute, second] = [month, day, hour, minute, second].map(u16::from);
    let fields = [year / 100, year % 100, month, day, hour, minute, second];
    out.slice(&fields.map(two_digits));
}

/// A number below 100.
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
    // No field of a time is above that.
    DIGITS.get(usize::from(number)).copied().unwrap_or(0x11)
}

/// Digits (FIPA00069 2.2) of a number.
pub(crate) fn write_digits(number: u64, out: &mut impl Out) {
    let text = number.to_string();
    for pair in text.as_bytes().chunks(2) {
        let nibble = |place: usize| pair.get(place).map_or(0, |digit| digit - b'0' + 1);
        out.byte(nibble(0) << 4 | nibble(1));
    }
    if text.len().is_multiple_of(2) {
        out.byte(0x00);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_of_the_clause() {
        for (number, bytes) in [
            (0, &[0x10][..]),
            (7, &[0x80]),
            (42, &[0x53, 0x00]),
            (100, &[0x21, 0x10]),
            (65536, &[0x76, 0x64, 0x70]),
        ] {
            let mut out = Vec::new();
            write_digits(number, &mut out);
            assert_eq!(out, bytes, "{number}");
        }
    }

    #[test]
    fn date_of_the_clause() {
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
    fn texts_of_any_length_are_written_in_order() {
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
    fn lengths_take_as_few_bytes_as_they_can() {
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
