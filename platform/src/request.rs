//! The parts of requests and answers that both agents share: the order of the checks, and the forms of
//! the answers (FIPA00023 clause 6.3, FIPA00026).

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_content::{
    ActionExpression, Content, ContentExpression, Expression, Printer, Profile, SlDialect, Term,
    Wff,
};

use crate::exception::{Exception, repeated};
use crate::{Asker, ONTOLOGY, PlatformAnswer, limits};

/// Language of answers to messages that name none.
const LANGUAGE: &str = "fipa-sl0";

/// A request whose act, language and content are understood.
pub(crate) struct Request<'m> {
    pub(crate) action: ActionExpression<'m>,
    pub(crate) function: String,
    /// The content of the answer that the action is done.
    pub(crate) done: Vec<u8>,
}

impl<'m> Request<'m> {
    /// Reads a request to the agent `own`.
    pub(crate) fn read(
        message: &'m Message,
        asker: &Asker,
        own: &AgentId,
    ) -> Result<Self, Rejection<'m>> {
        let content = content(message, asker, limits::CONTENT)?;
        let action = match <[_; 1]>::try_from(content.expressions) {
            Ok([ContentExpression::Action(action)]) => action,
            _ => return Err(unrecognised_content().into()),
        };
        let ActionExpression::Action { agent, act } = &action else {
            return Err(unrecognised_content().into());
        };
        let Ok(agent) = AgentId::try_from(agent) else {
            return Err(unrecognised_content().into());
        };
        let function = match act {
            Term::Functional(term) => &term.symbol,
            Term::String(symbol) => symbol,
            _ => return Err(unrecognised_content().into()),
        };
        let function = repeated(&function.to_ascii_lowercase());
        // The action is part of each further answer, so it has to be printable before it is executed.
        let done = Content::from(Wff::done(action.clone()));
        let done = print(asker.dialect, &done).map_err(|_| unrecognised_content())?;
        if !agent.name().eq_ignore_ascii_case(asker.asked(own).name()) {
            // This agent performs no actions of other agents.
            return Err(Rejection::of(action, Exception::Unauthorised));
        }
        Ok(Self {
            action,
            function,
            done,
        })
    }

    /// Returns the arguments of the function, exactly as many as it has.
    pub(crate) fn arguments<const N: usize>(
        &self,
        names: [&str; N],
    ) -> Result<&[Term<'m>; N], Exception> {
        let terms: &[Term<'m>] = match &self.action {
            ActionExpression::Action {
                act: Term::Functional(act),
                ..
            } => match act.parameters().first() {
                Some(parameter) => {
                    return Err(Exception::UnexpectedArgument(repeated(&parameter.name)));
                }
                None => act.terms(),
            },
            _ => &[],
        };
        match names.get(terms.len()) {
            Some(missing) => Err(Exception::MissingArgument((*missing).to_owned())),
            None => terms
                .try_into()
                .map_err(|_| Exception::UnexpectedArgumentCount),
        }
    }

    /// Returns the first argument, if there is one.
    pub(crate) fn first_argument(&self) -> Option<&Term<'m>> {
        match &self.action {
            ActionExpression::Action {
                act: Term::Functional(act),
                ..
            } => act.terms().first(),
            _ => None,
        }
    }

    /// Returns the action with another argument.
    pub(crate) fn with_argument(&self, argument: Term<'static>) -> ActionExpression<'m> {
        match &self.action {
            ActionExpression::Action { agent, .. } => ActionExpression::Action {
                agent: agent.clone(),
                act: Term::functional(self.function.clone(), [argument]),
            },
            other => other.clone(),
        }
    }
}

/// A message that an agent does not act on.
pub(crate) struct Rejection<'m> {
    /// The requested action, if the content was understood.
    pub(crate) action: Option<Box<ActionExpression<'m>>>,
    pub(crate) reason: Exception,
}

impl<'m> Rejection<'m> {
    pub(crate) fn of(action: ActionExpression<'m>, reason: Exception) -> Self {
        Self {
            action: Some(Box::new(action)),
            reason,
        }
    }
}

impl From<Exception> for Rejection<'_> {
    fn from(reason: Exception) -> Self {
        Self {
            action: None,
            reason,
        }
    }
}

/// Parses the content of a message in a supported language and ontology.
pub(crate) fn content<'m>(
    message: &'m Message,
    asker: &Asker,
    limit: usize,
) -> Result<Content<'m>, Exception> {
    let unsupported = |parameter: &str| Exception::UnsupportedValue(parameter.to_owned());
    let language = message.language().and_then(Profile::of_language);
    if language.is_none() {
        return Err(unsupported("language"));
    }
    let ontology = message.ontology();
    if !ontology.is_some_and(|it| it.eq_ignore_ascii_case(ONTOLOGY)) {
        return Err(unsupported("ontology"));
    }
    let content = message.content().filter(|content| content.len() <= limit);
    let content = content.ok_or_else(unrecognised_content)?;
    Content::parse_in(asker.dialect, content).map_err(|_| unrecognised_content())
}

pub(crate) fn unrecognised_content() -> Exception {
    Exception::UnrecognisedValue("content".to_owned())
}

/// Whether an agent that does not support this act answers it. Other acts expect no answer, and an
/// answer to an answer could be the start of an endless exchange.
pub(crate) fn expects_answer(act: &Performative) -> bool {
    !matches!(
        act,
        Performative::AcceptProposal
            | Performative::Agree
            | Performative::Confirm
            | Performative::Disconfirm
            | Performative::Failure
            | Performative::Inform
            | Performative::NotUnderstood
            | Performative::Propose
            | Performative::Refuse
            | Performative::RejectProposal
    )
}

pub(crate) fn print(
    dialect: SlDialect,
    expression: &impl Expression,
) -> Result<Vec<u8>, fipa_content::PrintError> {
    Printer::new().dialect(dialect).print(expression)
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
pub(crate) fn answer(asker: &Asker, message: MessageBuilder) -> Option<PlatformAnswer> {
    Some(PlatformAnswer {
        to: asker.id.name().into(),
        registration: asker.registration,
        message: message.build().ok()?,
        notification: None,
    })
}
