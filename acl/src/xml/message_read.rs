//! Reader of messages (FIPA00071).

use memchr::memmem;

use crate::MessageView;
use crate::Text;
use crate::error::{DecodeError, Problem};
use crate::view::{Content, PerformativeView, UserDefined};
use crate::xml::agent_id;
use crate::xml::reader::{Element, Elements};
use crate::xml::tag::Tag;
use crate::xml::value::Whitespace;

const CLAUSE: &str = "FIPA00071";

/// The form of the content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ContentForm {
    /// As XML requires.
    Escaped,
    /// As JADE writes it: `<content>a < b & c</content>`.
    Unescaped,
}

/// The beginning of a message of JADE, which writes acts in upper case.
const OF_JADE: &[u8] = b"<fipa-message act=\"";

/// Reads a message.
///
/// A message of JADE that is not well-formed is read a second time, as JADE writes it: the content is
/// text without escapes and markup.
///
/// # Errors
/// The bytes are not one whole message in this encoding.
pub(crate) fn view(bytes: &[u8]) -> Result<MessageView<'_>, DecodeError> {
    read(bytes, ContentForm::Escaped).or_else(|error| {
        let act = bytes.trim_ascii_start().strip_prefix(OF_JADE);
        match act.and_then(|act| act.first()) {
            Some(b'A'..=b'Z') => read(bytes, ContentForm::Unescaped).map_err(|_| error),
            _ => Err(error),
        }
    })
}

fn read(bytes: &[u8], form: ContentForm) -> Result<MessageView<'_>, DecodeError> {
    let mut elements = Elements::new(bytes, CLAUSE);
    let problem = "the outermost element is not fipa-message";
    let root = elements.root(Tag::FipaMessage, problem)?;
    let wrong = |problem| DecodeError::new(root.offset, CLAUSE, problem);
    let act = elements.attribute(&root, "act")?;
    let act = act.ok_or_else(|| wrong(Problem::Missing("act")))?;
    let act = PerformativeView::of_name(act.trimmed("act")?);
    let act = act.ok_or_else(|| wrong(Problem::NotAWord("act")))?;
    let mut view = MessageView::empty(act);
    // fipa_services writes the identifier here too, empty if it is absent. The element overrides it.
    let conversation = elements.attribute(&root, "conversation-id")?;
    let mut inside = elements.rest();
    let mut content_offset = 0;
    while let Some(child) = elements.child()? {
        if child.tag == Tag::Content {
            content_offset = elements.position();
            if form == ContentForm::Unescaped {
                // Other parameters are read again without it; see `next_user_defined`.
                if view.content.is_some() || !matches!(view.user_defined, UserDefined::None) {
                    let problem = Problem::Xml("parameters in front of unescaped content");
                    return Err(elements.error(child.offset, problem));
                }
                view.content = Some(Content::Bytes(unescaped_content(&mut elements, &child)?));
                inside = elements.rest();
                continue;
            }
        }
        if view.element(&mut elements, &child)?.is_some() {
            view.user_defined = UserDefined::Xml(inside);
        }
    }
    if let (None, Some(value)) = (view.conversation_id, conversation)
        && !value.is_empty()
    {
        view.conversation_id = Some(value.text(Whitespace::Preserve, "conversation-id")?);
    }
    view.check_for_base64(content_offset, CLAUSE)?;
    elements.finish()?;
    Ok(view)
}

/// Reads the next user-defined parameter of a checked message.
pub(crate) fn next_user_defined<'a>(rest: &mut &'a [u8]) -> Option<(Text<'a>, Text<'a>)> {
    // Receives the other parameters, which are skipped.
    let mut skipped = MessageView::empty(PerformativeView::Standard(0));
    let mut elements = Elements::inside(rest);
    // An error cannot occur in checked bytes. It would end the iteration.
    while let Some(child) = elements.child().ok()? {
        let pair = skipped.element(&mut elements, &child).ok()?;
        *rest = elements.rest();
        if pair.is_some() {
            return pair;
        }
    }
    None
}

impl<'a> MessageView<'a> {
    /// Reads an element inside the outermost one, including its end. A user-defined parameter is
    /// returned and not stored.
    fn element(
        &mut self,
        elements: &mut Elements<'a>,
        child: &Element<'a>,
    ) -> Result<Option<(Text<'a>, Text<'a>)>, DecodeError> {
        let (text, what) = match child.tag {
            Tag::Language => (&mut self.language, "language"),
            Tag::Encoding => (&mut self.encoding, "encoding"),
            Tag::Ontology => (&mut self.ontology, "ontology"),
            Tag::ConversationId => (&mut self.conversation_id, "conversation-id"),
            Tag::ReplyWith => (&mut self.reply_with, "reply-with"),
            Tag::InReplyTo => (&mut self.in_reply_to, "in-reply-to"),
            Tag::Receiver => {
                agent_id::read_all(elements, child, &mut self.receivers)?;
                return Ok(None);
            }
            Tag::ReplyTo => {
                agent_id::read_all(elements, child, &mut self.reply_to)?;
                return Ok(None);
            }
            Tag::Sender => {
                self.sender = agent_id::read_one(elements)?;
                return Ok(None);
            }
            Tag::ReplyBy => {
                self.reply_by = Some(elements.value(child, &["time"])?.time()?);
                return Ok(None);
            }
            Tag::Protocol => {
                self.protocol = protocol(elements, child)?;
                return Ok(None);
            }
            Tag::Content => {
                self.content = Some(content(elements, child)?);
                return Ok(None);
            }
            _ => return agent_id::user_defined(elements, child),
        };
        *text = Some(
            elements
                .value(child, &[])?
                .text(Whitespace::Preserve, what)?,
        );
        Ok(None)
    }
}

fn protocol<'a>(
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<Option<Text<'a>>, DecodeError> {
    let protocol = elements.value(child, &[])?.trimmed("protocol")?;
    if protocol.is_empty() {
        return Ok(None);
    }
    if !protocol.is_token() {
        return Err(elements.error(child.offset, Problem::NotAWord("protocol")));
    }
    Ok(Some(protocol))
}

/// Reads unescaped content.
fn unescaped_content<'a>(
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<&'a [u8], DecodeError> {
    refuse_reference(elements, child)?;
    let content = elements.raw(|next| {
        let known = matches!(
            next.tag,
            Tag::Sender
                | Tag::Receiver
                | Tag::Content
                | Tag::Language
                | Tag::Encoding
                | Tag::Ontology
                | Tag::Protocol
                | Tag::ConversationId
                | Tag::ReplyWith
                | Tag::InReplyTo
                | Tag::ReplyBy
                | Tag::ReplyTo
                | Tag::UserDefined
        );
        known || next.user_defined().is_some()
    })?;
    // fipa_services writes content with `]]>` into a section, which changes the text.
    if memmem::find(content, b"<![CDATA[").is_some() {
        let problem = Problem::Xml("a CDATA section in unescaped content");
        return Err(elements.error(child.offset, problem));
    }
    Ok(content)
}

/// Refuses external content.
fn refuse_reference(elements: &Elements<'_>, child: &Element<'_>) -> Result<(), DecodeError> {
    let reference = elements.attribute(child, "href")?;
    if reference.is_some_and(|reference| !reference.is_empty()) {
        let problem = Problem::Xml("external content (href) is not supported");
        return Err(elements.error(child.offset, problem));
    }
    Ok(())
}

fn content<'a>(
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<Content<'a>, DecodeError> {
    refuse_reference(elements, child)?;
    let value = elements.value(child, &[])?;
    Ok(match value.bytes()? {
        Some(bytes) => Content::Bytes(bytes),
        None => Content::Xml(value.all),
    })
}
