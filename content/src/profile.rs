//! Profiles: the subsets of SL that `:language` can name (FIPA00008 clause 4).

use std::fmt;

use crate::content::{Content, ContentExpression};
use crate::term::{ActionExpression, Arguments, IdentifyingExpression, Term};
use crate::wff::{LogicalOperator, Quantifier, Wff};

/// A subset of SL. Each profile contains the previous one.
///
/// `(= a b)` is in all of them, because the smaller ones read `=` as a predicate symbol.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum Profile {
    /// `fipa-sl0`: predicates, `done` and `result`, actions, functional terms, sequences and sets.
    Sl0,
    /// `fipa-sl1`: `not`, `and` and `or` besides.
    Sl1,
    /// `fipa-sl2`: all operators, variables and identifying expressions besides, with quantifiers
    /// only in front of formulas without quantifiers, `forall` before `exists`, so that formulas
    /// stay decidable.
    Sl2,
    /// `fipa-sl`: everything.
    Sl,
}

/// An error: a content has an expression that is not in the profile.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{profile} has no {construct}{}", Remedy(.needs))]
pub struct ProfileError {
    profile: Profile,
    construct: &'static str,
    needs: Option<Profile>,
}

impl ProfileError {
    /// Returns the kind of expression.
    #[must_use]
    pub fn construct(&self) -> &'static str {
        self.construct
    }

    /// Returns the smallest profile that has the expression. No profile has meta-symbols.
    #[must_use]
    pub fn needs(&self) -> Option<Profile> {
        self.needs
    }
}

struct Remedy<'a>(&'a Option<Profile>);

impl fmt::Display for Remedy<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(profile) => write!(f, " ({profile} has)"),
            None => Ok(()),
        }
    }
}

impl Profile {
    /// All profiles, the smallest one first.
    pub const ALL: [Self; 4] = [Self::Sl0, Self::Sl1, Self::Sl2, Self::Sl];

    /// Returns the value of `:language`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Sl0 => "fipa-sl0",
            Self::Sl1 => "fipa-sl1",
            Self::Sl2 => "fipa-sl2",
            Self::Sl => "fipa-sl",
        }
    }

    /// Returns the profile that a value of `:language` names. Case is ignored.
    #[must_use]
    pub fn of_language(language: &str) -> Option<Self> {
        let mut all = Self::ALL.into_iter();
        all.find(|profile| profile.as_str().eq_ignore_ascii_case(language))
    }

    /// Returns the smallest profile that has the content. A content with meta-symbols has none.
    #[must_use]
    pub fn of(content: &Content<'_>) -> Option<Self> {
        let mut all = Self::ALL.into_iter();
        all.find(|profile| profile.check(content).is_ok())
    }

    /// Checks that the profile has every expression of the content.
    ///
    /// # Errors
    /// The first expression that the profile does not have.
    pub fn check(self, content: &Content<'_>) -> Result<(), ProfileError> {
        content
            .expressions
            .iter()
            .try_for_each(|expression| match expression {
                ContentExpression::Action(action) => self.action(action),
                ContentExpression::Identifying(expression) => self.identifying(expression),
                ContentExpression::Wff(wff) => self.prenex(wff),
            })
    }

    fn needs(self, least: Self, construct: &'static str) -> Result<(), ProfileError> {
        if self < least {
            return Err(ProfileError {
                profile: self,
                construct,
                needs: Some(least),
            });
        }
        Ok(())
    }

    fn meta(self) -> Result<(), ProfileError> {
        Err(ProfileError {
            profile: self,
            construct: "meta-symbol",
            needs: None,
        })
    }

    /// Checks a formula with quantifiers in front (`PrenexExpression`).
    fn prenex(self, wff: &Wff<'_>) -> Result<(), ProfileError> {
        match wff {
            Wff::Quantified {
                quantifier: Quantifier::Forall,
                wff,
                ..
            } => {
                self.needs(Self::Sl2, "quantifier")?;
                self.prenex(wff)
            }
            other => self.existential(other),
        }
    }

    /// Checks a formula with existential quantifiers in front (`ExistQuantExpression`).
    fn existential(self, wff: &Wff<'_>) -> Result<(), ProfileError> {
        match wff {
            Wff::Quantified {
                quantifier: Quantifier::Exists,
                wff,
                ..
            } => {
                self.needs(Self::Sl2, "quantifier")?;
                self.existential(wff)
            }
            other => self.wff(other),
        }
    }

    fn wff(self, wff: &Wff<'_>) -> Result<(), ProfileError> {
        match wff {
            Wff::Truth(_) | Wff::Proposition(_) => Ok(()),
            Wff::Predicate { arguments, .. } => self.terms(arguments),
            Wff::Equal(left, right) | Wff::Result(left, right) => {
                self.term(left)?;
                self.term(right)
            }
            Wff::Not(wff) => {
                self.needs(Self::Sl1, "logical operator 'not'")?;
                self.wff(wff)
            }
            Wff::Binary {
                operator,
                left,
                right,
            } => {
                match operator {
                    LogicalOperator::And => self.needs(Self::Sl1, "logical operator 'and'")?,
                    LogicalOperator::Or => self.needs(Self::Sl1, "logical operator 'or'")?,
                    LogicalOperator::Implies => {
                        self.needs(Self::Sl2, "logical operator 'implies'")?;
                    }
                    LogicalOperator::Equiv => self.needs(Self::Sl2, "logical operator 'equiv'")?,
                }
                self.wff(left)?;
                self.wff(right)
            }
            Wff::Quantified { wff, .. } => {
                self.needs(Self::Sl2, "quantifier")?;
                self.needs(Self::Sl, "quantifier inside of a formula")?;
                self.wff(wff)
            }
            Wff::Modal { agent, wff, .. } => {
                self.needs(Self::Sl2, "modal operator")?;
                self.term(agent)?;
                self.prenex(wff)
            }
            Wff::Feasible(action, wff) => {
                self.needs(Self::Sl2, "operator 'feasible'")?;
                self.after(action, wff.as_deref())
            }
            Wff::Done(action, wff) => {
                if wff.is_some() {
                    self.needs(Self::Sl2, "formula in 'done'")?;
                }
                self.after(action, wff.as_deref())
            }
            Wff::Meta(_) => self.meta(),
        }
    }

    fn after(
        self,
        action: &ActionExpression<'_>,
        wff: Option<&Wff<'_>>,
    ) -> Result<(), ProfileError> {
        self.action(action)?;
        wff.map_or(Ok(()), |wff| self.prenex(wff))
    }

    fn action(self, action: &ActionExpression<'_>) -> Result<(), ProfileError> {
        match action {
            ActionExpression::Action { agent, act } => {
                self.term(agent)?;
                self.term(act)
            }
            ActionExpression::Alternative(first, second)
            | ActionExpression::Sequential(first, second) => {
                self.needs(Self::Sl2, "action operator")?;
                self.action(first)?;
                self.action(second)
            }
            ActionExpression::Meta(_) => self.meta(),
        }
    }

    fn identifying(self, expression: &IdentifyingExpression<'_>) -> Result<(), ProfileError> {
        self.needs(Self::Sl2, "identifying expression")?;
        self.term(&expression.term)?;
        self.wff(&expression.wff)
    }

    fn term(self, term: &Term<'_>) -> Result<(), ProfileError> {
        match term {
            Term::Number(_)
            | Term::String(_)
            | Term::Bytes(_)
            | Term::Boolean(_)
            | Term::DateTime(_) => Ok(()),
            Term::Variable(_) => self.needs(Self::Sl2, "variable"),
            Term::Meta(_) => self.meta(),
            Term::Functional(term) => match &term.arguments {
                Arguments::Terms(terms) => self.terms(terms),
                Arguments::Parameters(parameters) => parameters
                    .iter()
                    .try_for_each(|parameter| self.term(&parameter.value)),
            },
            Term::Sequence(terms) | Term::Set(terms) => self.terms(terms),
            Term::Action(action) => self.action(action),
            Term::Identifying(expression) => self.identifying(expression),
        }
    }

    fn terms(self, terms: &[Term<'_>]) -> Result<(), ProfileError> {
        terms.iter().try_for_each(|term| self.term(term))
    }
}

impl fmt::Display for Profile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}
