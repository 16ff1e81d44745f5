//! Formulas (FIPA00008 clauses 3.2 and 3.3).

use std::borrow::Cow;

use crate::into_owned;
use crate::term::{ActionExpression, Term, owned_terms};

/// A well-formed formula (FIPA00008 `Wff`).
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Wff<'a> {
    /// `true` or `false`.
    Truth(bool),
    /// A proposition symbol.
    Proposition(Cow<'a, str>),
    /// `(= left right)`
    Equal(Box<Term<'a>>, Box<Term<'a>>),
    /// `(result action value)`
    Result(Box<Term<'a>>, Box<Term<'a>>),
    /// A predicate symbol and its arguments, at least one.
    Predicate {
        /// The symbol.
        symbol: Cow<'a, str>,
        /// The arguments.
        arguments: Vec<Term<'a>>,
    },
    /// `(not wff)`
    Not(Box<Wff<'a>>),
    /// A logical operator between two formulas: `(and left right)`.
    Binary {
        /// The operator.
        operator: LogicalOperator,
        /// The first formula.
        left: Box<Wff<'a>>,
        /// The second formula.
        right: Box<Wff<'a>>,
    },
    /// `(forall ?x wff)` or `(exists ?x wff)`
    Quantified {
        /// The quantifier.
        quantifier: Quantifier,
        /// The variable, without its question mark.
        variable: Cow<'a, str>,
        /// The formula.
        wff: Box<Wff<'a>>,
    },
    /// An attitude of an agent to a formula: `(B agent wff)`.
    Modal {
        /// The operator.
        operator: ModalOperator,
        /// The agent.
        agent: Box<Term<'a>>,
        /// The formula.
        wff: Box<Wff<'a>>,
    },
    /// `(feasible action)` or `(feasible action wff)`
    Feasible(Box<ActionExpression<'a>>, Option<Box<Wff<'a>>>),
    /// `(done action)` or `(done action wff)`
    Done(Box<ActionExpression<'a>>, Option<Box<Wff<'a>>>),
    /// A meta-symbol of JADE, `??phi`, without the question marks. The standard has none.
    Meta(Cow<'a, str>),
}

macro_rules! keywords {
    ($(#[$meta:meta])* $name:ident { $($(#[$doc:meta])* $variant:ident = $keyword:literal,)* }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[allow(clippy::exhaustive_enums, reason = "the standard is final")]
        pub enum $name {
            $($(#[$doc])* $variant,)*
        }

        impl $name {
            /// Returns the keyword.
            #[must_use]
            pub fn as_str(self) -> &'static str {
                match self {
                    $(Self::$variant => $keyword,)*
                }
            }

            pub(crate) fn of(keyword: &str) -> Option<Self> {
                match keyword {
                    $($keyword => Some(Self::$variant),)*
                    _ => None,
                }
            }
        }
    };
}

keywords! {
    /// A logical operator between two formulas.
    LogicalOperator {
        /// Both hold.
        And = "and",
        /// One of both holds, or both do.
        Or = "or",
        /// The second holds if the first does.
        Implies = "implies",
        /// Both hold, or neither does.
        Equiv = "equiv",
    }
}

keywords! {
    /// A quantifier.
    Quantifier {
        /// For every object.
        Forall = "forall",
        /// For at least one object.
        Exists = "exists",
    }
}

keywords! {
    /// An attitude of an agent to a formula.
    ModalOperator {
        /// The agent believes it.
        Belief = "B",
        /// The agent is uncertain of it, and considers it more likely than its opposite.
        Uncertainty = "U",
        /// The formula is a persistent goal of the agent.
        PersistentGoal = "PG",
        /// The agent intends it.
        Intention = "I",
    }
}

impl<'a> Wff<'a> {
    /// Returns a predicate, or a proposition if there are no arguments.
    #[must_use]
    pub fn predicate(
        symbol: impl Into<Cow<'a, str>>,
        arguments: impl IntoIterator<Item = Term<'a>>,
    ) -> Self {
        let (symbol, arguments) = (symbol.into(), Vec::from_iter(arguments));
        if arguments.is_empty() {
            return Self::Proposition(symbol);
        }
        Self::Predicate { symbol, arguments }
    }

    /// Returns the same formula with owned text.
    #[must_use]
    pub fn into_owned(self) -> Wff<'static> {
        fn boxed(wff: Wff<'_>) -> Box<Wff<'static>> {
            Box::new(wff.into_owned())
        }
        match self {
            Self::Truth(truth) => Wff::Truth(truth),
            Self::Proposition(symbol) => Wff::Proposition(into_owned(symbol)),
            Self::Equal(left, right) => {
                Wff::Equal(Box::new(left.into_owned()), Box::new(right.into_owned()))
            }
            Self::Result(action, value) => {
                Wff::Result(Box::new(action.into_owned()), Box::new(value.into_owned()))
            }
            Self::Predicate { symbol, arguments } => Wff::Predicate {
                symbol: into_owned(symbol),
                arguments: owned_terms(arguments),
            },
            Self::Not(wff) => Wff::Not(boxed(*wff)),
            Self::Binary {
                operator,
                left,
                right,
            } => Wff::Binary {
                operator,
                left: boxed(*left),
                right: boxed(*right),
            },
            Self::Quantified {
                quantifier,
                variable,
                wff,
            } => Wff::Quantified {
                quantifier,
                variable: into_owned(variable),
                wff: boxed(*wff),
            },
            Self::Modal {
                operator,
                agent,
                wff,
            } => Wff::Modal {
                operator,
                agent: Box::new(agent.into_owned()),
                wff: boxed(*wff),
            },
            Self::Feasible(action, wff) => {
                Wff::Feasible(Box::new(action.into_owned()), wff.map(|wff| boxed(*wff)))
            }
            Self::Done(action, wff) => {
                Wff::Done(Box::new(action.into_owned()), wff.map(|wff| boxed(*wff)))
            }
            Self::Meta(name) => Wff::Meta(into_owned(name)),
        }
    }
}
