//! Queries for objects, and their answers by position (FIPA00008 clause 3.5).

use std::borrow::Cow;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::act::ReadError;
use crate::content::{Content, ContentExpression};
use crate::serde::SerializeError;
use crate::term::{IdentifyingExpression, ReferentialOperator, Term};
use crate::wff::Wff;

/// A query for the objects that a formula holds for: the content of a `query-ref` or `subscribe`.
///
/// The answer gives a value for each variable, in the order of the variables: `T` for one variable,
/// a tuple or struct of several.
///
/// ```
/// use fipa_content::{Content, Query, Wff};
///
/// let offers = Wff::parse("(offers crex ?name ?duration)")?;
/// let query = Query::all(["name", "duration"], offers.clone());
/// assert_eq!(
///     query.content().to_string(),
///     "((all (sequence ?name ?duration) (offers crex ?name ?duration)))"
/// );
/// let answer = query.answer_all(&[("dock", 20.5), ("lift", 3.0)])?;
/// assert_eq!(
///     answer.to_string(),
///     "((= (all (sequence ?name ?duration) (offers crex ?name ?duration)) \
///      (set (sequence dock 20.5) (sequence lift 3.0))))"
/// );
/// let actions: Vec<(String, f64)> = query.read_all(&answer)?;
/// assert_eq!(actions[1], ("lift".to_owned(), 3.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Query(IdentifyingExpression<'static>);

impl Query {
    /// Returns a query for the only object, or combination of objects, that the formula holds for.
    #[must_use]
    pub fn iota<'v>(variables: impl IntoIterator<Item = &'v str>, wff: Wff<'_>) -> Self {
        Self::new(ReferentialOperator::Iota, variables, wff)
    }

    /// Returns a query for any one of the objects.
    #[must_use]
    pub fn any<'v>(variables: impl IntoIterator<Item = &'v str>, wff: Wff<'_>) -> Self {
        Self::new(ReferentialOperator::Any, variables, wff)
    }

    /// Returns a query for all of the objects.
    #[must_use]
    pub fn all<'v>(variables: impl IntoIterator<Item = &'v str>, wff: Wff<'_>) -> Self {
        Self::new(ReferentialOperator::All, variables, wff)
    }

    fn new<'v>(
        operator: ReferentialOperator,
        variables: impl IntoIterator<Item = &'v str>,
        wff: Wff<'_>,
    ) -> Self {
        let variable = |name: &str| Term::Variable(Cow::Owned(name.to_owned()));
        let mut variables: Vec<_> = variables.into_iter().map(variable).collect();
        let term = match variables.pop() {
            Some(only) if variables.is_empty() => only,
            last => {
                variables.extend(last);
                Term::Sequence(variables)
            }
        };
        Self(IdentifyingExpression {
            operator,
            term,
            wff: wff.into_owned(),
        })
    }

    /// Returns the query that is the whole content.
    ///
    /// # Errors
    /// When the content is anything else.
    pub fn read(content: &Content<'_>) -> Result<Self, ReadError> {
        match &content.expressions[..] {
            [ContentExpression::Identifying(expression)] => {
                Ok(Self(expression.clone().into_owned()))
            }
            _ => Err(ReadError::Expression("one identifying expression")),
        }
    }

    /// Returns the content of the message with the query.
    #[must_use]
    pub fn content(&self) -> Content<'static> {
        self.0.clone().into()
    }

    /// Returns the identifying expression.
    #[must_use]
    pub fn expression(&self) -> &IdentifyingExpression<'static> {
        &self.0
    }

    /// Returns the names of the variables, in the order of the values of an answer. Terms that are
    /// not variables are left out.
    pub fn variables(&self) -> impl Iterator<Item = &str> {
        let terms = match &self.0.term {
            Term::Sequence(terms) => &terms[..],
            term => std::slice::from_ref(term),
        };
        terms.iter().filter_map(|term| match term {
            Term::Variable(name) => Some(&**name),
            _ => None,
        })
    }

    /// Returns the content of an answer to a query for one object: `((= (iota …) value))`.
    ///
    /// # Errors
    /// When SL has no notation for a part of the value, or its `Serialize` fails.
    pub fn answer_one(
        &self,
        value: &(impl Serialize + ?Sized),
    ) -> Result<Content<'static>, SerializeError> {
        Term::from_value(value).map(|value| self.answer(value))
    }

    /// Returns the content of an answer to a query for all objects: `((= (all …) (set value…)))`.
    ///
    /// # Errors
    /// When SL has no notation for a part of a value, or its `Serialize` fails.
    pub fn answer_all<T: Serialize>(
        &self,
        values: impl IntoIterator<Item = T>,
    ) -> Result<Content<'static>, SerializeError> {
        let values = values.into_iter().map(|value| Term::from_value(&value));
        Ok(self.answer(Term::Set(values.collect::<Result<_, _>>()?)))
    }

    /// Reads the answer to a query for one object.
    ///
    /// # Errors
    /// When the content is not an answer, is the answer to another query, or its value is not of
    /// the type.
    pub fn read_one<T: DeserializeOwned>(&self, answer: &Content<'_>) -> Result<T, ReadError> {
        Ok(self.value(answer)?.read()?)
    }

    /// Reads the answer to a query for all objects.
    ///
    /// # Errors
    /// When the content is not an answer, is the answer to another query, or its value is not a set
    /// or sequence of values of the type.
    pub fn read_all<T: DeserializeOwned>(&self, answer: &Content<'_>) -> Result<Vec<T>, ReadError> {
        self.read_one(answer)
    }

    fn answer(&self, value: Term<'static>) -> Content<'static> {
        Wff::Equal(Box::new(self.0.clone().into()), Box::new(value)).into()
    }

    /// Returns the value that the answer equates with the expression of the query.
    fn value<'t, 'a>(&self, answer: &'t Content<'a>) -> Result<&'t Term<'a>, ReadError> {
        let Wff::Equal(left, right) = answer.wff()? else {
            return Err(ReadError::Expression("((= (iota …) value))"));
        };
        let is_query = |term: &Term<'_>| matches!(term, Term::Identifying(it) if **it == self.0);
        if is_query(left) {
            Ok(right)
        } else if is_query(right) {
            Ok(left)
        } else {
            Err(ReadError::OtherQuery)
        }
    }
}
