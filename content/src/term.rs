//! Terms, action expressions and identifying expressions (FIPA00008 clauses 3.4 to 3.11).

use std::borrow::Cow;

use fipa_acl::Time;

use crate::into_owned;
use crate::number::Number;
use crate::wff::Wff;

/// A term (FIPA00008 `TermOrIE`).
///
/// `Term<'a>` borrows its text from the parsed bytes, `Term<'static>` owns it: see
/// [`into_owned`](Self::into_owned).
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Term<'a> {
    /// A variable, without its question mark.
    Variable(Cow<'a, str>),
    /// A meta-symbol of JADE, `??x`, without the question marks. The standard has none.
    Meta(Cow<'a, str>),
    /// A numerical constant.
    Number(Number<'a>),
    /// A string constant in any notation.
    String(Cow<'a, str>),
    /// A byte-length encoded string that is not text; from JADE, any byte-length encoded string.
    Bytes(Cow<'a, [u8]>),
    /// The unquoted word `true` or `false`. In the standard, these words are formulas, and strings
    /// as terms. JADE and this crate read them as truth values, and write the strings in quotation
    /// marks.
    Boolean(bool),
    /// A date-time constant.
    DateTime(Time),
    /// A function symbol and its arguments.
    Functional(FunctionalTerm<'a>),
    /// A sequence.
    Sequence(Vec<Term<'a>>),
    /// A set. Order and repeated elements are kept as written.
    Set(Vec<Term<'a>>),
    /// An action expression.
    Action(Box<ActionExpression<'a>>),
    /// An identifying expression.
    Identifying(Box<IdentifyingExpression<'a>>),
}

/// A function symbol and its arguments: `(pose :x 1.5 :y 0.2)`, `(plus 1 2)`.
#[derive(Debug, Clone, PartialEq)]
pub struct FunctionalTerm<'a> {
    /// The function symbol.
    pub symbol: Cow<'a, str>,
    /// The arguments.
    pub arguments: Arguments<'a>,
}

/// The arguments of a functional term. A term without arguments has empty [`Terms`](Self::Terms).
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum Arguments<'a> {
    /// By position.
    Terms(Vec<Term<'a>>),
    /// By name.
    Parameters(Vec<Parameter<'a>>),
}

/// A named argument: `:x 1.5`.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter<'a> {
    /// The name, without its colon.
    pub name: Cow<'a, str>,
    /// The value.
    pub value: Term<'a>,
}

/// An action expression (FIPA00008 clause 3.8).
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum ActionExpression<'a> {
    /// `(action agent act)`
    Action {
        /// The agent that acts.
        agent: Term<'a>,
        /// The act, usually a functional term.
        act: Term<'a>,
    },
    /// `(| first second)`: one of both.
    Alternative(Box<ActionExpression<'a>>, Box<ActionExpression<'a>>),
    /// `(; first second)`: one after the other.
    Sequential(Box<ActionExpression<'a>>, Box<ActionExpression<'a>>),
    /// A meta-symbol of JADE, `??x`, without the question marks.
    Meta(Cow<'a, str>),
}

/// A referential operator (FIPA00008 clause 3.5).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum ReferentialOperator {
    /// The only object for which the formula holds.
    Iota,
    /// Any one of the objects.
    Any,
    /// All objects.
    All,
}

impl ReferentialOperator {
    /// Returns the keyword.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Iota => "iota",
            Self::Any => "any",
            Self::All => "all",
        }
    }
}

/// An identifying expression, `(iota ?x (p ?x))`: the objects of the term for which the formula
/// holds.
#[derive(Debug, Clone, PartialEq)]
pub struct IdentifyingExpression<'a> {
    /// The operator.
    pub operator: ReferentialOperator,
    /// The term, usually a variable or a sequence of variables.
    pub term: Term<'a>,
    /// The formula.
    pub wff: Wff<'a>,
}

impl<'a> Term<'a> {
    /// Returns the same term with owned text.
    #[must_use]
    pub fn into_owned(self) -> Term<'static> {
        match self {
            Self::Variable(name) => Term::Variable(into_owned(name)),
            Self::Meta(name) => Term::Meta(into_owned(name)),
            Self::Number(number) => Term::Number(number.into_owned()),
            Self::String(text) => Term::String(into_owned(text)),
            Self::Bytes(bytes) => Term::Bytes(Cow::Owned(bytes.into_owned())),
            Self::Boolean(truth) => Term::Boolean(truth),
            Self::DateTime(time) => Term::DateTime(time),
            Self::Functional(term) => Term::Functional(term.into_owned()),
            Self::Sequence(terms) => Term::Sequence(owned_terms(terms)),
            Self::Set(terms) => Term::Set(owned_terms(terms)),
            Self::Action(action) => Term::Action(Box::new(action.into_owned())),
            Self::Identifying(expression) => Term::Identifying(Box::new(expression.into_owned())),
        }
    }

    /// Returns a functional term with arguments by position.
    #[must_use]
    pub fn functional(
        symbol: impl Into<Cow<'a, str>>,
        arguments: impl IntoIterator<Item = Term<'a>>,
    ) -> Self {
        Self::Functional(FunctionalTerm {
            symbol: symbol.into(),
            arguments: Arguments::Terms(arguments.into_iter().collect()),
        })
    }

    /// Returns the functional term, if the term is one.
    #[must_use]
    pub fn as_functional(&self) -> Option<&FunctionalTerm<'a>> {
        match self {
            Self::Functional(term) => Some(term),
            _ => None,
        }
    }

    /// Returns the string, if the term is one.
    #[must_use]
    pub fn as_str(&self) -> Option<&str> {
        match self {
            Self::String(text) => Some(text),
            _ => None,
        }
    }

    /// Returns the elements, if the term is a sequence or set.
    #[must_use]
    pub fn elements(&self) -> Option<&[Term<'a>]> {
        match self {
            Self::Sequence(terms) | Self::Set(terms) => Some(terms),
            _ => None,
        }
    }
}

impl<'a> FunctionalTerm<'a> {
    /// Returns the value of the first parameter of this name.
    #[must_use]
    pub fn parameter(&self, name: &str) -> Option<&Term<'a>> {
        let found = self.parameters().iter().find(|found| found.name == name);
        found.map(|found| &found.value)
    }

    /// Returns the arguments by name. The slice is empty if there are arguments by position.
    #[must_use]
    pub fn parameters(&self) -> &[Parameter<'a>] {
        match &self.arguments {
            Arguments::Parameters(parameters) => parameters,
            Arguments::Terms(_) => &[],
        }
    }

    /// Returns the arguments by position. The slice is empty if there are arguments by name.
    #[must_use]
    pub fn terms(&self) -> &[Term<'a>] {
        match &self.arguments {
            Arguments::Terms(terms) => terms,
            Arguments::Parameters(_) => &[],
        }
    }

    /// Returns the same term with owned text.
    #[must_use]
    pub fn into_owned(self) -> FunctionalTerm<'static> {
        FunctionalTerm {
            symbol: into_owned(self.symbol),
            arguments: match self.arguments {
                Arguments::Terms(terms) => Arguments::Terms(owned_terms(terms)),
                Arguments::Parameters(parameters) => {
                    let owned = parameters.into_iter().map(|parameter| Parameter {
                        name: into_owned(parameter.name),
                        value: parameter.value.into_owned(),
                    });
                    Arguments::Parameters(owned.collect())
                }
            },
        }
    }
}

impl ActionExpression<'_> {
    /// Returns the same expression with owned text.
    #[must_use]
    pub fn into_owned(self) -> ActionExpression<'static> {
        match self {
            Self::Action { agent, act } => ActionExpression::Action {
                agent: agent.into_owned(),
                act: act.into_owned(),
            },
            Self::Alternative(first, second) => ActionExpression::Alternative(
                Box::new(first.into_owned()),
                Box::new(second.into_owned()),
            ),
            Self::Sequential(first, second) => ActionExpression::Sequential(
                Box::new(first.into_owned()),
                Box::new(second.into_owned()),
            ),
            Self::Meta(name) => ActionExpression::Meta(into_owned(name)),
        }
    }
}

impl IdentifyingExpression<'_> {
    /// Returns the same expression with owned text.
    #[must_use]
    pub fn into_owned(self) -> IdentifyingExpression<'static> {
        IdentifyingExpression {
            operator: self.operator,
            term: self.term.into_owned(),
            wff: self.wff.into_owned(),
        }
    }
}

pub(crate) fn owned_terms(terms: Vec<Term<'_>>) -> Vec<Term<'static>> {
    terms.into_iter().map(Term::into_owned).collect()
}

impl<'a> From<FunctionalTerm<'a>> for Term<'a> {
    fn from(term: FunctionalTerm<'a>) -> Self {
        Self::Functional(term)
    }
}

/// Converts the expression. A lone meta-symbol becomes [`Term::Meta`], as in the parser.
impl<'a> From<ActionExpression<'a>> for Term<'a> {
    fn from(action: ActionExpression<'a>) -> Self {
        match action {
            ActionExpression::Meta(name) => Self::Meta(name),
            action => Self::Action(Box::new(action)),
        }
    }
}

impl<'a> From<IdentifyingExpression<'a>> for Term<'a> {
    fn from(expression: IdentifyingExpression<'a>) -> Self {
        Self::Identifying(Box::new(expression))
    }
}

impl<'a> From<&'a str> for Term<'a> {
    fn from(text: &'a str) -> Self {
        Self::String(Cow::Borrowed(text))
    }
}

impl From<String> for Term<'_> {
    fn from(text: String) -> Self {
        Self::String(Cow::Owned(text))
    }
}

impl From<Time> for Term<'_> {
    fn from(time: Time) -> Self {
        Self::DateTime(time)
    }
}
