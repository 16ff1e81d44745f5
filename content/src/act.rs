//! The forms of requests and their answers: an action, the statement that it is done or has a
//! result, and a refusal with a reason.

use fipa_acl::AgentId;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::agent::AgentTermError;
use crate::content::{Content, ContentExpression};
use crate::serde::{DeserializeError, SerializeError};
use crate::term::{ActionExpression, Term};
use crate::wff::Wff;

/// A content that does not have the expected form.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// Another expression.
    #[error("the content is not {0}")]
    Expression(&'static str),
    /// The term for the agent is not an agent identifier.
    #[error("the agent of the action is malformed")]
    Agent(#[from] AgentTermError),
    /// A term is not a value of the requested type.
    #[error(transparent)]
    Value(#[from] DeserializeError),
    /// The answer belongs to another query.
    #[error("the answer is to another query")]
    OtherQuery,
}

impl ActionExpression<'static> {
    /// Returns `(action agent act)`. Serde writes the act, which is a struct or a variant of an
    /// enum.
    ///
    /// # Errors
    /// When SL has no notation for a part of the act, or its `Serialize` fails.
    pub fn new(agent: &AgentId, act: &(impl Serialize + ?Sized)) -> Result<Self, SerializeError> {
        Ok(Self::Action {
            agent: agent.into(),
            act: Term::from_value(act)?,
        })
    }
}

impl ActionExpression<'_> {
    /// Returns the agent and the act of `(action agent act)`.
    ///
    /// # Errors
    /// When it is another action expression, the agent is not an agent identifier, or the act is
    /// not a value of the type.
    pub fn read<T: DeserializeOwned>(&self) -> Result<(AgentId, T), ReadError> {
        match self {
            Self::Action { agent, act } => Ok((AgentId::try_from(agent)?, act.read()?)),
            _ => Err(ReadError::Expression("(action …)")),
        }
    }
}

impl<'a> Wff<'a> {
    /// Returns `(done action)`.
    #[must_use]
    pub fn done(action: ActionExpression<'a>) -> Self {
        Self::Done(Box::new(action), None)
    }
}

impl Wff<'static> {
    /// Returns `(result action value)`. Serde writes the value.
    ///
    /// # Errors
    /// When SL has no notation for a part of the value, or its `Serialize` fails.
    pub fn result(
        action: ActionExpression<'static>,
        value: &(impl Serialize + ?Sized),
    ) -> Result<Self, SerializeError> {
        let value = Term::from_value(value)?;
        Ok(Self::Result(Box::new(action.into()), Box::new(value)))
    }
}

impl<'a> Content<'a> {
    /// Returns the action that is the whole content, as in a `request`.
    ///
    /// # Errors
    /// When the content is anything else.
    pub fn action(&self) -> Result<&ActionExpression<'a>, ReadError> {
        match &self.expressions[..] {
            [ContentExpression::Action(action)] => Ok(action),
            _ => Err(ReadError::Expression("((action …))")),
        }
    }

    /// Returns the formula that is the whole content, as in an `inform`.
    ///
    /// # Errors
    /// When the content is anything else.
    pub fn wff(&self) -> Result<&Wff<'a>, ReadError> {
        match &self.expressions[..] {
            [ContentExpression::Wff(wff)] => Ok(wff),
            _ => Err(ReadError::Expression("one formula")),
        }
    }

    /// Returns the action that the content states to be done.
    ///
    /// # Errors
    /// When the content is not `((done action))`.
    pub fn done(&self) -> Result<&ActionExpression<'a>, ReadError> {
        match self.wff()? {
            Wff::Done(action, None) => Ok(action),
            _ => Err(ReadError::Expression("((done …))")),
        }
    }

    /// Returns the action and its result.
    ///
    /// # Errors
    /// When the content is not `((result action value))`, or the value is not of the type.
    pub fn result<T: DeserializeOwned>(&self) -> Result<(&ActionExpression<'a>, T), ReadError> {
        match self.wff()? {
            Wff::Result(action, value) => match &**action {
                Term::Action(action) => Ok((action, value.read()?)),
                _ => Err(ReadError::Expression("((result (action …) …))")),
            },
            _ => Err(ReadError::Expression("((result …))")),
        }
    }

    /// Returns the action that is refused or has failed, and the reason, as in a `refuse`, a
    /// `failure` or a `not-understood` (FIPA00037). [`Wff::read`] reads the reason as a value.
    ///
    /// # Errors
    /// When the content is not `((action …) reason)`.
    pub fn refusal(&self) -> Result<(&ActionExpression<'a>, &Wff<'a>), ReadError> {
        match &self.expressions[..] {
            [
                ContentExpression::Action(action),
                ContentExpression::Wff(reason),
            ] => Ok((action, reason)),
            _ => Err(ReadError::Expression("((action …) reason)")),
        }
    }

    /// Returns `((action …) reason)`: see [`refusal`](Self::refusal).
    #[must_use]
    pub fn of_refusal(action: ActionExpression<'a>, reason: Wff<'a>) -> Self {
        let action = ContentExpression::from(action);
        Self::new([action, reason.into()])
    }
}
