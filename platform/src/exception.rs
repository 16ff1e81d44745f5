//! The reasons of refusals, failures and messages that are not understood (FIPA00023 clause 6.3).

use fipa_acl::{Message, Performative, escape};
use fipa_content::{Content, ContentExpression, SlDialect, Term, Wff};

use crate::limits;

/// A reason why an agent does not do what a message asks for. The error texts are for people; the
/// predicate is [`to_wff`](Self::to_wff).
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Exception {
    /// The agent does not support the communicative act.
    #[error("the act {} is not supported", escape(.0))]
    UnsupportedAct(String),
    /// The agent supports the act, but not at this point.
    #[error("the act {} is not expected", escape(.0))]
    UnexpectedAct(String),
    /// The agent does not support the value of this parameter of the message.
    #[error("the value of the message's {} is not supported", escape(.0))]
    UnsupportedValue(String),
    /// The agent does not recognize the value of this parameter of the message.
    #[error("the message's {} is not recognized", escape(.0))]
    UnrecognisedValue(String),
    /// The asker may not do this.
    #[error("the asking agent is not authorized")]
    Unauthorised,
    /// The agent does not have this function.
    #[error("the function {} is not supported", escape(.0))]
    UnsupportedFunction(String),
    /// The function lacks this argument.
    #[error("the argument {} is missing", escape(.0))]
    MissingArgument(String),
    /// The function has another argument than this.
    #[error("the argument {} is not expected", escape(.0))]
    UnexpectedArgument(String),
    /// The function has another number of arguments.
    #[error("the number of arguments is not expected")]
    UnexpectedArgumentCount,
    /// A mandatory parameter of an object is missing.
    #[error("the parameter {} of {} is missing", escape(.parameter), escape(.object))]
    MissingParameter {
        /// The object, for example `df-agent-description`.
        object: String,
        /// The parameter.
        parameter: String,
    },
    /// An object has a parameter that its type does not have, or has it twice.
    #[error("the parameter {} of {} is not expected", escape(.parameter), escape(.object))]
    UnexpectedParameter {
        /// The object.
        object: String,
        /// The parameter.
        parameter: String,
    },
    /// A parameter of an object has a value that it cannot have.
    #[error("the value of the parameter {} of {} is not recognized", escape(.parameter), escape(.object))]
    UnrecognisedParameterValue {
        /// The object; empty if a JADE agent has sent the reason.
        object: String,
        /// The parameter.
        parameter: String,
    },
    /// The agent is registered already.
    #[error("the agent is registered already")]
    AlreadyRegistered,
    /// The agent is not registered.
    #[error("the agent is not registered")]
    NotRegistered,
    /// Any other reason, in words.
    #[error("{}", escape(.0))]
    InternalError(String),
}

impl Exception {
    pub(crate) fn missing(object: &str, parameter: &str) -> Self {
        let (object, parameter) = (object.to_owned(), repeated(parameter));
        Self::MissingParameter { object, parameter }
    }

    pub(crate) fn unexpected(object: &str, parameter: &str) -> Self {
        let (object, parameter) = (object.to_owned(), repeated(parameter));
        Self::UnexpectedParameter { object, parameter }
    }

    pub(crate) fn unrecognised(object: &str, parameter: &str) -> Self {
        let (object, parameter) = (object.to_owned(), repeated(parameter));
        Self::UnrecognisedParameterValue { object, parameter }
    }

    /// Returns the performative of the message that carries this reason.
    #[must_use]
    pub fn performative(&self) -> Performative {
        match self {
            Self::UnsupportedAct(_)
            | Self::UnexpectedAct(_)
            | Self::UnsupportedValue(_)
            | Self::UnrecognisedValue(_) => Performative::NotUnderstood,
            Self::AlreadyRegistered | Self::NotRegistered | Self::InternalError(_) => {
                Performative::Failure
            }
            _ => Performative::Refuse,
        }
    }

    /// Returns the predicate. JADE begins the names of two predicates with a capital letter.
    #[must_use]
    pub fn to_wff(&self, dialect: SlDialect) -> Wff<'static> {
        let is_jade = dialect == SlDialect::Jade;
        let text = |text: &String| Term::from(text.clone());
        let (symbol, arguments) = match self {
            Self::UnsupportedAct(act) => ("unsupported-act", vec![text(act)]),
            Self::UnexpectedAct(act) if is_jade => ("Unexpected-act", vec![text(act)]),
            Self::UnexpectedAct(act) => ("unexpected-act", vec![text(act)]),
            Self::UnsupportedValue(value) if is_jade => ("Unsupported-value", vec![text(value)]),
            Self::UnsupportedValue(value) => ("unsupported-value", vec![text(value)]),
            Self::UnrecognisedValue(value) => ("unrecognised-value", vec![text(value)]),
            Self::Unauthorised => ("unauthorised", vec![]),
            Self::UnsupportedFunction(name) => ("unsupported-function", vec![text(name)]),
            Self::MissingArgument(name) => ("missing-argument", vec![text(name)]),
            Self::UnexpectedArgument(name) => ("unexpected-argument", vec![text(name)]),
            Self::UnexpectedArgumentCount => ("unexpected-argument-count", vec![]),
            Self::MissingParameter { object, parameter } => {
                ("missing-parameter", vec![text(object), text(parameter)])
            }
            Self::UnexpectedParameter { object, parameter } => {
                ("unexpected-parameter", vec![text(object), text(parameter)])
            }
            Self::UnrecognisedParameterValue { object, parameter } => (
                "unrecognised-parameter-value",
                vec![text(object), text(parameter)],
            ),
            Self::AlreadyRegistered => ("already-registered", vec![]),
            Self::NotRegistered => ("not-registered", vec![]),
            Self::InternalError(words) => ("internal-error", vec![text(words)]),
        };
        Wff::predicate(symbol, arguments)
    }

    /// Returns the reason in a `refuse`, `failure` or `not-understood` of an AMS or DF. Returns `None`
    /// for other messages, and for reasons that FIPA00023 does not define. Case is ignored.
    #[must_use]
    pub fn of(message: &Message) -> Option<Self> {
        let content = Content::parse(message.content()?).ok()?;
        match content.expressions.last()? {
            ContentExpression::Wff(wff) => Self::of_wff(wff),
            _ => None,
        }
    }

    fn of_wff(wff: &Wff<'_>) -> Option<Self> {
        let (symbol, arguments) = match wff {
            Wff::Proposition(symbol) => (symbol, &[][..]),
            Wff::Predicate { symbol, arguments } => (symbol, &arguments[..]),
            _ => return None,
        };
        let text = |at: usize| -> String {
            let term = arguments.get(at);
            let text = term.and_then(|term| crate::slots::text(term));
            text.map_or_else(String::new, repeated)
        };
        Some(match &*symbol.to_ascii_lowercase() {
            "unsupported-act" => Self::UnsupportedAct(text(0)),
            "unexpected-act" => Self::UnexpectedAct(text(0)),
            "unsupported-value" => Self::UnsupportedValue(text(0)),
            "unrecognised-value" => Self::UnrecognisedValue(text(0)),
            "unauthorised" => Self::Unauthorised,
            "unsupported-function" => Self::UnsupportedFunction(text(0)),
            "missing-argument" => Self::MissingArgument(text(0)),
            "unexpected-argument" => Self::UnexpectedArgument(text(0)),
            "unexpected-argument-count" => Self::UnexpectedArgumentCount,
            "missing-parameter" => Self::MissingParameter {
                object: text(0),
                parameter: text(1),
            },
            "unexpected-parameter" => Self::UnexpectedParameter {
                object: text(0),
                parameter: text(1),
            },
            "unrecognised-parameter-value" => Self::UnrecognisedParameterValue {
                object: text(0),
                parameter: text(1),
            },
            "already-registered" => Self::AlreadyRegistered,
            "not-registered" => Self::NotRegistered,
            "internal-error" => Self::InternalError(text(0)),
            _ => return None,
        })
    }
}

/// Returns the start of a text from a request, without NUL characters: the messages of this crate are
/// short, and every encoding has a form for them.
pub(crate) fn repeated(text: &str) -> String {
    let text = text.chars().filter(|c| *c != '\0');
    text.take(limits::REPEATED).collect()
}
