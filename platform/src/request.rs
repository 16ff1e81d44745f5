//! The parts of requests that both agents share: their reading, and the order of the checks (FIPA00023 clause 6.3,
//! FIPA00026).

use fipa_acl::{AgentId, Message, Performative};
use fipa_content::{
    ActionExpression, Content, ContentExpression, Expression, Printer, Profile, SlDialect, Term,
    Wff,
};

use crate::description::described;
use crate::exception::{Exception, repeated};
use crate::{Asker, ONTOLOGY, limits};

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

/// Checks that the asker may change the description in the request: its connection proves its name, and
/// the description is its own. A description without a readable name is refused later, for that.
pub(crate) fn authorize(asker: &Asker, request: &Request<'_>) -> Result<(), Exception> {
    let other = described(request.first_argument());
    let other = other.is_some_and(|agent| !agent.same_agent(&asker.id));
    match asker.is_proved && !other {
        true => Ok(()),
        false => Err(Exception::Unauthorised),
    }
}
