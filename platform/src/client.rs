//! The side of clients: the contents of requests, and the reading of answers.

use fipa_acl::{AgentId, Message};
use fipa_content::{
    ActionExpression, Content, IdentifyingExpression, ParseError, PrintError, Printer,
    ReferentialOperator, Term, Wff,
};

use crate::{AgentDescription, AmsDescription, Constraints, Exception};

/// A function of an AMS or DF with its arguments.
#[derive(Debug, Clone, PartialEq)]
pub struct Function(Term<'static>);

impl Function {
    /// Registers the description of an agent with a DF.
    #[must_use]
    pub fn register(description: &AgentDescription) -> Self {
        Self::of("register", [description.to_term()])
    }

    /// Replaces the description of an agent in a DF, and renews its lease.
    #[must_use]
    pub fn modify(description: &AgentDescription) -> Self {
        Self::of("modify", [description.to_term()])
    }

    /// Removes the description of an agent from a DF.
    #[must_use]
    pub fn deregister(agent: &AgentId) -> Self {
        let description = AgentDescription {
            name: Some(agent.clone()),
            ..AgentDescription::default()
        };
        Self::of("deregister", [description.to_term()])
    }

    /// Searches a DF for the descriptions that match a template.
    #[must_use]
    pub fn search(template: &AgentDescription, constraints: &Constraints) -> Self {
        Self::of("search", [template.to_term(), constraints.to_term()])
    }

    /// Registers an agent with an AMS.
    #[must_use]
    pub fn register_agent(description: &AmsDescription) -> Self {
        Self::of("register", [description.to_term()])
    }

    /// Replaces the description of an agent in an AMS.
    #[must_use]
    pub fn modify_agent(description: &AmsDescription) -> Self {
        Self::of("modify", [description.to_term()])
    }

    /// Removes an agent from an AMS.
    #[must_use]
    pub fn deregister_agent(description: &AmsDescription) -> Self {
        Self::of("deregister", [description.to_term()])
    }

    /// Searches an AMS for the agents that match a template.
    #[must_use]
    pub fn search_agents(template: &AmsDescription, constraints: &Constraints) -> Self {
        Self::of("search", [template.to_term(), constraints.to_term()])
    }

    /// Asks an AMS for the description of its platform.
    #[must_use]
    pub fn get_description() -> Self {
        Self::of("get-description", [])
    }

    fn of<const N: usize>(symbol: &'static str, arguments: [Term<'static>; N]) -> Self {
        Self(Term::functional(symbol, arguments))
    }

    /// Returns the content of the request to the AMS or DF with this identifier.
    ///
    /// # Errors
    /// When a part of a description has no notation, for example because it is nested too deeply.
    pub fn content(&self, agent: &AgentId) -> Result<Vec<u8>, PrintError> {
        Printer::new().print(&Content::from(self.action(agent)))
    }

    fn action(&self, agent: &AgentId) -> ActionExpression<'static> {
        ActionExpression::Action {
            agent: Term::from(agent),
            act: self.0.clone(),
        }
    }
}

/// Returns the content of a `subscribe` to the descriptions in a DF that match a template. Its language
/// is `fipa-sl2`, because the smaller profiles have no queries.
///
/// # Errors
/// When a part of the template has no notation.
pub fn subscription(df: &AgentId, template: &AgentDescription) -> Result<Vec<u8>, PrintError> {
    let search = Function::search(template, &Constraints::all()).action(df);
    let variable = || Term::Variable("x".into());
    let query = IdentifyingExpression {
        operator: ReferentialOperator::Iota,
        term: variable(),
        wff: Wff::Result(Box::new(search.into()), Box::new(variable())),
    };
    Printer::new().print(&Content::from(query))
}

/// An answer of an AMS or DF that is not the result of the request.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AnswerError {
    /// The message has no content.
    #[error("the answer has no content")]
    Empty,
    /// The content is not SL.
    #[error("the content of the answer is not valid SL")]
    Parse(#[from] ParseError),
    /// The content has another form.
    #[error("the content of the answer is not {0}")]
    Form(&'static str),
    /// A description in the answer is malformed.
    #[error("a description in the answer is not valid")]
    Description(#[source] Exception),
}

/// Returns the descriptions in the answer to a [search](Function::search).
///
/// # Errors
/// When the content is not the result of a search, or a description is malformed.
pub fn found(answer: &Message) -> Result<Vec<AgentDescription>, AnswerError> {
    let value = value(answer)?;
    let elements = value.elements();
    descriptions(elements.ok_or(AnswerError::Form("the result of a search"))?)
}

/// Returns the changed descriptions in a notification of a [`subscription`]. A description without
/// services, protocols, ontologies and languages is that of an agent that has deregistered.
///
/// # Errors
/// When the content is not a notification, or a description is malformed.
pub fn notified(notification: &Message) -> Result<Vec<AgentDescription>, AnswerError> {
    let form = || AnswerError::Form("a notification");
    let content = content(notification)?;
    let Ok(Wff::Equal(_, value)) = content.wff() else {
        return Err(form());
    };
    descriptions(value.elements().ok_or_else(form)?)
}

/// Returns the description in the answer to a [`Function::register`] or [`Function::modify`], which has
/// the granted lease.
///
/// # Errors
/// When the content does not state that an action with a description is done.
pub fn registered(answer: &Message) -> Result<AgentDescription, AnswerError> {
    let form = || AnswerError::Form("((done (action …)))");
    let content = content(answer)?;
    let action = content.done().map_err(|_| form())?;
    let ActionExpression::Action { act, .. } = action else {
        return Err(form());
    };
    let arguments = act.as_functional().map(|act| act.terms());
    match arguments {
        Some([description]) => {
            AgentDescription::from_term(description).map_err(AnswerError::Description)
        }
        _ => Err(form()),
    }
}

impl AmsDescription {
    /// Returns the descriptions in the answer to a [search](Function::search_agents) of an AMS.
    ///
    /// # Errors
    /// When the content is not the result of a search, or a description is malformed.
    pub fn found(answer: &Message) -> Result<Vec<Self>, AnswerError> {
        let value = value(answer)?;
        let elements = value.elements();
        let elements = elements.ok_or(AnswerError::Form("the result of a search"))?;
        let descriptions = elements.iter().map(Self::from_term);
        descriptions
            .collect::<Result<_, _>>()
            .map_err(AnswerError::Description)
    }
}

impl crate::ApDescription {
    /// Returns the description in the answer to [`Function::get_description`]. JADE writes a sequence
    /// of one description.
    ///
    /// # Errors
    /// When the content is not the description of a platform.
    pub fn found(answer: &Message) -> Result<Self, AnswerError> {
        let value = value(answer)?;
        let only = match value.elements() {
            Some([only]) => only,
            Some(_) => return Err(AnswerError::Form("the description of one platform")),
            None => &value,
        };
        Self::from_term(only).map_err(AnswerError::Description)
    }
}

fn content(answer: &Message) -> Result<Content<'_>, AnswerError> {
    let content = answer.content().ok_or(AnswerError::Empty)?;
    Ok(Content::parse(content)?)
}

/// Returns the value of `((result (action …) value))`.
fn value(answer: &Message) -> Result<Term<'_>, AnswerError> {
    let form = || AnswerError::Form("((result (action …) …))");
    let mut content = content(answer)?;
    match content.expressions.pop() {
        Some(fipa_content::ContentExpression::Wff(Wff::Result(_, value)))
            if content.expressions.is_empty() =>
        {
            Ok(*value)
        }
        _ => Err(form()),
    }
}

fn descriptions(elements: &[Term<'_>]) -> Result<Vec<AgentDescription>, AnswerError> {
    let descriptions = elements.iter().map(AgentDescription::from_term);
    descriptions
        .collect::<Result<_, _>>()
        .map_err(AnswerError::Description)
}
