//! From a checked view to an owned message.

use std::borrow::Cow;

use bytes::Bytes;

use crate::bitefficient::agent_id::AgentIdView;
use crate::bitefficient::text::{Text, string_content};
use crate::bitefficient::view::{ContentView, MessageView};
use crate::error::{DecodeError, Problem};
use crate::{AgentId, Message, Payload};

/// Reads a bit-efficient message. The content of the result shares the memory it was given in and
/// is not looked at, unless it was written with escapes.
///
/// # Errors
/// When the payload is not one whole message in the bit-efficient encoding (see
/// [`MessageView::parse_payload`]).
pub(crate) fn decode(payload: &Payload) -> Result<Message, DecodeError> {
    let view = MessageView::parse_payload(payload)?;
    let text = |text: Option<Text<'_>>| text.map(|text| text.as_str().into_owned());
    Ok(Message {
        performative: view.performative(),
        sender: view.sender().map(owned).transpose()?,
        receivers: view.receivers().map(owned).collect::<Result<_, _>>()?,
        reply_to: view.reply_to().map(owned).collect::<Result<_, _>>()?,
        content: view.content_view().map(|content| shared(payload, content)),
        language: text(view.language()),
        encoding: text(view.encoding()),
        ontology: text(view.ontology()),
        protocol: view.protocol().map(str::to_owned),
        conversation_id: text(view.conversation_id()),
        reply_with: text(view.reply_with()),
        in_reply_to: text(view.in_reply_to()),
        reply_by: view.reply_by(),
        user_defined: view
            .user_defined()
            .map(|(name, value)| (name.to_owned(), value.as_str().into_owned()))
            .collect(),
    })
}

/// The view has checked all that an identifier can be refused for; the error is passed on rather
/// than relied upon not to occur.
fn owned(view: AgentIdView<'_>) -> Result<AgentId, DecodeError> {
    view.to_owned().map_err(|_| {
        DecodeError::new(
            0,
            "FIPA00069 2.1 AID",
            Problem::NotAWord("agent identifier"),
        )
    })
}

fn shared(payload: &Payload, content: ContentView<'_>) -> Bytes {
    match content {
        ContentView::Beside(_) => payload.content.clone(),
        ContentView::Bytes(bytes) => payload.head.slice_ref(bytes),
        ContentView::String(bytes) => match string_content(bytes) {
            Cow::Borrowed(inner) => payload.head.slice_ref(inner),
            Cow::Owned(text) => text.into(),
        },
        ContentView::Expression(text) => text.as_str().into_owned().into_bytes().into(),
    }
}
