//! The forms of the answers of both agents (FIPA00023 clause 6.3, FIPA00026).

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_content::{ActionExpression, Content, SlDialect, Term, Wff};

use crate::exception::{Exception, repeated};
use crate::request::{Rejection, Request, print};
use crate::{Asker, ONTOLOGY, PlatformAnswer};

/// Language of answers to messages that name none.
const LANGUAGE: &str = "fipa-sl0";

/// Prints the content of an answer to a request that was carried out.
pub(crate) fn printed(dialect: SlDialect, content: &Content<'_>) -> Result<Vec<u8>, Exception> {
    print(dialect, content).map_err(|_| Exception::InternalError("cannot answer".to_owned()))
}

/// Returns the content of the answer with the results of a search.
pub(crate) fn search_result(
    request: &Request<'_>,
    found: Vec<Vec<u8>>,
    dialect: SlDialect,
) -> Result<Vec<u8>, Exception> {
    let empty = Wff::Result(
        Box::new(request.action.clone().into()),
        Box::new(Term::Sequence(Vec::new())),
    );
    let mut text = printed(dialect, &Content::from(empty))?;
    // The text ends with the parentheses of the sequence, the formula and the content.
    let end = text.split_off(text.len().saturating_sub(3));
    for description in found {
        text.push(b' ');
        text.extend(description);
    }
    text.extend(end);
    Ok(text)
}

/// Returns the content of an answer with the reason for which a message was rejected.
pub(crate) fn rejected(
    message: &Message,
    asker: &Asker,
    rejection: Rejection<'_>,
) -> (Performative, Vec<u8>) {
    let Rejection { action, reason } = rejection;
    let wff = reason.to_wff(asker.dialect);
    let content = match action {
        Some(action) => Content::of_refusal(*action, wff),
        // The messages of JADE's own agents have this form.
        None if asker.dialect == SlDialect::Jade => Content::from(wff),
        None => {
            // The act of sending the message: FIPA00037 clause 3.13.
            let act = ActionExpression::Action {
                agent: Term::from(&asker.id),
                act: Term::functional(repeated(message.performative().as_str()), []),
            };
            Content::of_refusal(act, wff)
        }
    };
    let printed = print(asker.dialect, &content);
    // The action of a request was printed before, and all else is short.
    let printed = printed.or_else(|_| print(asker.dialect, &Content::from(Wff::Truth(false))));
    (reason.performative(), printed.unwrap_or_default())
}

/// Starts an answer to the agent that asked. Its conversation, language and ontology are those of the
/// message. FIPA00061's `reply-to` is not followed: it would direct answers to agents that did not ask.
pub(crate) fn reply(
    message: &Message,
    asker: &Asker,
    own: &AgentId,
    performative: Performative,
) -> MessageBuilder {
    let mut answer = Message::builder(performative)
        .sender(asker.asked(own).clone())
        .receiver(asker.id.clone())
        .language(message.language().unwrap_or(LANGUAGE))
        .ontology(message.ontology().unwrap_or(ONTOLOGY));
    for (text, set) in [
        (
            message.protocol(),
            MessageBuilder::protocol as fn(MessageBuilder, _) -> _,
        ),
        (message.conversation_id(), MessageBuilder::conversation_id),
        (message.reply_with(), MessageBuilder::in_reply_to),
    ] {
        if let Some(text) = text {
            answer = set(answer, text);
        }
    }
    answer
}

/// Returns an answer to the agent that asked. A message that cannot be built, because the request has a
/// parameter that no encoding has, is not answered.
pub(crate) fn to_asker(asker: &Asker, message: MessageBuilder) -> Option<PlatformAnswer> {
    Some(PlatformAnswer {
        to: asker.id.name().into(),
        registration: asker.registration,
        message: message.build().ok()?,
        notification: None,
    })
}
