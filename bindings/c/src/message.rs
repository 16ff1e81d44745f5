//! Messages of the caller, and calls that read letters.

use std::time::{Duration, UNIX_EPOCH};

use bytes::Bytes;
use fipa::{MessageBuilder, Performative, Time};

use crate::failure::{FipaResult, call};
use crate::letter::{FipaLetterInfo, FipaMessage, FipaParameter};
use crate::raw::{self, FipaBytes, FipaText, Place, elements, fill, texts};
use crate::table::{self, FipaHandle};
use fipa_bindings::{Failure, OrFail};

/// The message of a caller, before its sender is known.
pub(crate) struct Draft<'a> {
    message: FipaMessage,
    content: Option<&'a [u8]>,
}

impl<'a> Draft<'a> {
    /// Reads a message.
    ///
    /// # Safety
    /// The structure must be as its documentation says, and what it points to must not change for the lifetime `'a`
    /// that the caller of this function chooses.
    pub(crate) unsafe fn read(message: *const FipaMessage) -> Result<Self, Failure> {
        // SAFETY: The caller promises it.
        let message = unsafe { raw::structure(message, "the message") }?;
        // SAFETY: The caller promises it.
        let content = unsafe { message.content.read("the content") }?;
        Ok(Self { message, content })
    }

    pub(crate) fn content(&self) -> Option<&'a [u8]> {
        self.content
    }

    /// Returns the act; `default` if the caller has set none.
    pub(crate) fn performative(
        &self,
        default: Option<Performative>,
    ) -> Result<Performative, Failure> {
        // SAFETY: The caller of `read` has promised it.
        let text = unsafe { self.message.performative.read("the performative") }?;
        match (text.filter(|text| !text.is_empty()), default) {
            (Some(text), _) => text.parse().or_fail(),
            (None, Some(default)) => Ok(default),
            (None, None) => Err(Failure::invalid("the performative is missing")),
        }
    }

    /// Returns the names of the receivers.
    pub(crate) fn receivers(&self) -> Result<Vec<&'a str>, Failure> {
        let it = &self.message;
        // SAFETY: The caller of `read` has promised it.
        unsafe { texts(it.receivers, it.receiver_count, "a receiver") }
    }

    /// Writes all parameters but the performative, the sender and the content into a message.
    pub(crate) fn complete(&self, mut builder: MessageBuilder) -> Result<MessageBuilder, Failure> {
        let it = &self.message;
        let receivers = self.receivers()?;
        if !receivers.is_empty() {
            builder = builder.replace_receivers(receivers);
        }
        // SAFETY: The caller of `read` has promised it.
        for agent in unsafe { texts(it.reply_to, it.reply_to_count, "an agent in reply_to") }? {
            builder = builder.reply_to(agent);
        }
        type Set = fn(MessageBuilder, String) -> MessageBuilder;
        let parameters: [(FipaText, &str, Set); 7] = [
            (it.language, "the language", MessageBuilder::language),
            (it.encoding, "the encoding", MessageBuilder::encoding),
            (it.ontology, "the ontology", MessageBuilder::ontology),
            (it.protocol, "the protocol", MessageBuilder::protocol),
            (
                it.conversation_id,
                "the conversation_id",
                MessageBuilder::conversation_id,
            ),
            (it.reply_with, "the reply_with", MessageBuilder::reply_with),
            (
                it.in_reply_to,
                "the in_reply_to",
                MessageBuilder::in_reply_to,
            ),
        ];
        for (text, what, set) in parameters {
            // SAFETY: The caller of `read` has promised it.
            if let Some(text) = unsafe { text.read(what) }?.filter(|text| !text.is_empty()) {
                builder = set(builder, text.to_owned());
            }
        }
        if it.reply_by != 0 {
            builder = builder.reply_by(time(it.reply_by)?);
        }
        // SAFETY: The caller of `read` has promised it.
        let parameters = unsafe { elements(it.parameters, it.parameter_count, "parameters") }?;
        for FipaParameter { name, value } in parameters {
            // SAFETY: The caller of `read` has promised it.
            let name = unsafe { name.required("the name of a parameter") }?;
            // SAFETY: The caller of `read` has promised it.
            let value = unsafe { value.read("the value of a parameter") }?;
            builder = builder.user_defined(name, value.unwrap_or_default());
        }
        if it.lock != 0 {
            let lock = table::any(it.lock)?;
            let guarded = lock.guard(builder);
            builder = guarded.ok_or_else(|| table::other_kind(it.lock, "HeldLock"))??;
        }
        Ok(builder)
    }

    /// As [`complete`](Self::complete), with a copy of the content.
    pub(crate) fn with_content(&self, builder: MessageBuilder) -> Result<MessageBuilder, Failure> {
        let builder = self.complete(builder)?;
        Ok(match self.content {
            Some(content) => builder.content(Bytes::copy_from_slice(content)),
            None => builder,
        })
    }
}

fn time(nanoseconds: i64) -> Result<Time, Failure> {
    let span = Duration::from_nanos(nanoseconds.unsigned_abs());
    let time = match nanoseconds {
        0.. => UNIX_EPOCH.checked_add(span),
        _ => UNIX_EPOCH.checked_sub(span),
    };
    let time = time.ok_or_else(|| Failure::invalid("the reply_by is out of bounds"))?;
    Time::from_system_time(time).or_fail()
}

/// Reads the message of a letter, an answer, a notification or a task.
///
/// # Safety
/// `message` is NULL, or its first field is the number of bytes that can be written there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_read_message(
    letter: FipaHandle,
    message: *mut FipaMessage,
) -> FipaResult {
    call(|| {
        table::with_letter(letter, |letter| {
            // SAFETY: The caller promises it.
            unsafe { fill(message, letter.parameters(), "the message") }?;
            Ok(FipaResult::Ok)
        })
    })
}

/// Returns the content of a letter, an answer, a notification or a task, without decoding the rest of the message.
/// The bytes are valid until the handle is closed. They may be in shared memory of the sender, which can change them.
///
/// # Safety
/// `content` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_read_content(
    letter: FipaHandle,
    content: *mut FipaBytes,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let content = unsafe { Place::of(content, "the content") }?;
        table::with_letter(letter, |letter| {
            content.put(letter.content());
            Ok(FipaResult::Ok)
        })
    })
}

/// Returns facts about a letter. The texts are valid until the handle of the letter is closed.
///
/// # Safety
/// `info` is NULL, or its first field is the number of bytes that can be written there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_read_info(
    letter: FipaHandle,
    info: *mut FipaLetterInfo,
) -> FipaResult {
    call(|| {
        table::with_letter(letter, |letter| {
            // SAFETY: The caller promises it.
            unsafe { fill(info, letter.info(), "the info") }?;
            Ok(FipaResult::Ok)
        })
    })
}
