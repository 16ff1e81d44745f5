//! Contents of messages (FIPA00008 clause 3.1).

use crate::term::{ActionExpression, IdentifyingExpression};
use crate::wff::Wff;

/// The content of a message: content expressions in one pair of parentheses.
///
/// `Content<'a>` borrows its text from the parsed bytes, `Content<'static>` owns it: see
/// [`into_owned`](Self::into_owned).
#[derive(Debug, Clone, PartialEq)]
pub struct Content<'a> {
    /// The expressions. The standard asks for at least one.
    pub expressions: Vec<ContentExpression<'a>>,
}

/// An expression that can be the content of a message.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum ContentExpression<'a> {
    /// An action, as in a `request`.
    Action(ActionExpression<'a>),
    /// A reference to objects, as in a `query-ref`.
    Identifying(IdentifyingExpression<'a>),
    /// A formula, as in an `inform`.
    Wff(Wff<'a>),
}

impl<'a> Content<'a> {
    /// Returns a content of these expressions.
    #[must_use]
    pub fn new(expressions: impl IntoIterator<Item = impl Into<ContentExpression<'a>>>) -> Self {
        Self {
            expressions: expressions.into_iter().map(Into::into).collect(),
        }
    }

    /// Returns the same content with owned text.
    #[must_use]
    pub fn into_owned(self) -> Content<'static> {
        let expressions = self.expressions.into_iter();
        Content {
            expressions: expressions.map(ContentExpression::into_owned).collect(),
        }
    }
}

impl ContentExpression<'_> {
    /// Returns the same expression with owned text.
    #[must_use]
    pub fn into_owned(self) -> ContentExpression<'static> {
        match self {
            Self::Action(action) => ContentExpression::Action(action.into_owned()),
            Self::Identifying(expression) => {
                ContentExpression::Identifying(expression.into_owned())
            }
            Self::Wff(wff) => ContentExpression::Wff(wff.into_owned()),
        }
    }
}

/// Converts the expression. A lone meta-symbol becomes [`Wff::Meta`], as in the parser.
impl<'a> From<ActionExpression<'a>> for ContentExpression<'a> {
    fn from(action: ActionExpression<'a>) -> Self {
        match action {
            ActionExpression::Meta(name) => Self::Wff(Wff::Meta(name)),
            action => Self::Action(action),
        }
    }
}

impl<'a> From<IdentifyingExpression<'a>> for ContentExpression<'a> {
    fn from(expression: IdentifyingExpression<'a>) -> Self {
        Self::Identifying(expression)
    }
}

impl<'a> From<Wff<'a>> for ContentExpression<'a> {
    fn from(wff: Wff<'a>) -> Self {
        Self::Wff(wff)
    }
}

/// A content of one expression.
impl<'a, T: Into<ContentExpression<'a>>> From<T> for Content<'a> {
    fn from(expression: T) -> Self {
        Self::new([expression])
    }
}
