//! Reads the objects of the ontology: functional terms with named slots.

use fipa_acl::{AgentId, Time};
use fipa_content::{Arguments, FunctionalTerm, Parameter, Term};

use crate::exception::{Exception, repeated};

/// A functional term whose symbol and slots are those of one type of object.
pub(crate) struct Slots<'t, 'a> {
    object: &'static str,
    parameters: &'t [Parameter<'a>],
}

impl<'t, 'a> Slots<'t, 'a> {
    /// Reads an argument of a function, which must be an object of this type with no other slots than
    /// the known ones, each at most once. User-defined slots (`X-…`) are ignored.
    pub(crate) fn of(
        term: &'t Term<'a>,
        object: &'static str,
        known: &[&str],
    ) -> Result<Self, Exception> {
        let symbol = match term {
            Term::Functional(term) => &*term.symbol,
            Term::String(text) => &**text,
            _ => "",
        };
        if !symbol.eq_ignore_ascii_case(object) {
            return Err(Exception::UnexpectedArgument(repeated(symbol)));
        }
        let parameters = match term {
            Term::Functional(FunctionalTerm { arguments, .. }) => match arguments {
                Arguments::Parameters(parameters) => &parameters[..],
                Arguments::Terms(terms) if terms.is_empty() => &[],
                Arguments::Terms(_) => return Err(Exception::unexpected(object, "1")),
            },
            _ => &[],
        };
        // Each slot is read by a scan, so their number is bounded first.
        let mut seen: Vec<&str> = Vec::with_capacity(known.len());
        for Parameter { name, .. } in parameters {
            if is_user_defined(name) {
                continue;
            }
            let known = known.iter().find(|known| known.eq_ignore_ascii_case(name));
            match known {
                Some(known) if !seen.contains(known) => seen.push(known),
                _ => return Err(Exception::unexpected(object, name)),
            }
        }
        Ok(Self { object, parameters })
    }

    /// Returns the value of a slot.
    pub(crate) fn get(&self, slot: &str) -> Option<&'t Term<'a>> {
        let mut parameters = self.parameters.iter();
        let found = parameters.find(|parameter| parameter.name.eq_ignore_ascii_case(slot))?;
        Some(&found.value)
    }

    fn unrecognised(&self, slot: &str) -> Exception {
        Exception::unrecognised(self.object, slot)
    }

    /// Returns the text of a slot.
    pub(crate) fn text(&self, slot: &str) -> Result<Option<String>, Exception> {
        let value = self.get(slot);
        value.map(|value| self.text_of(slot, value)).transpose()
    }

    fn text_of(&self, slot: &str, value: &Term<'_>) -> Result<String, Exception> {
        let text = text(value).filter(|text| !text.contains('\0'));
        text.map(str::to_owned)
            .ok_or_else(|| self.unrecognised(slot))
    }

    /// Returns the elements of a slot, a set or a sequence.
    pub(crate) fn elements(&self, slot: &str) -> Result<&'t [Term<'a>], Exception> {
        match self.get(slot) {
            None => Ok(&[]),
            Some(value) => value.elements().ok_or_else(|| self.unrecognised(slot)),
        }
    }

    /// Returns the texts of a slot, a set or a sequence.
    pub(crate) fn texts(&self, slot: &str) -> Result<Vec<String>, Exception> {
        let elements = self.elements(slot)?.iter();
        elements.map(|value| self.text_of(slot, value)).collect()
    }

    /// Returns the agent identifier in a slot.
    pub(crate) fn agent(&self, slot: &str) -> Result<Option<AgentId>, Exception> {
        let value = self.get(slot);
        value
            .map(|value| AgentId::try_from(value).map_err(|_| self.unrecognised(slot)))
            .transpose()
    }

    /// Returns the time in a slot.
    pub(crate) fn time(&self, slot: &str) -> Result<Option<Time>, Exception> {
        match self.get(slot) {
            None => Ok(None),
            Some(Term::DateTime(time)) => Ok(Some(*time)),
            Some(_) => Err(self.unrecognised(slot)),
        }
    }

    /// Returns the integer in a slot.
    pub(crate) fn integer(&self, slot: &str) -> Result<Option<i64>, Exception> {
        match self.get(slot) {
            None => Ok(None),
            Some(Term::Number(number)) => match number.as_i64() {
                Some(value) => Ok(Some(value)),
                None => Err(self.unrecognised(slot)),
            },
            Some(_) => Err(self.unrecognised(slot)),
        }
    }
}

fn is_user_defined(slot: &str) -> bool {
    slot.get(..2)
        .is_some_and(|start| start.eq_ignore_ascii_case("x-"))
}

/// Returns the text of a string, or of a number: JADE writes strings that are numbers without
/// quotation marks.
pub(crate) fn text<'t>(term: &'t Term<'_>) -> Option<&'t str> {
    match term {
        Term::Number(number) => Some(number.as_str()),
        term => term.as_str(),
    }
}

/// Builds a functional term of the slots that have a value.
#[derive(Default)]
pub(crate) struct Builder(Vec<Parameter<'static>>);

impl Builder {
    pub(crate) fn slot(mut self, name: &'static str, value: Option<Term<'static>>) -> Self {
        self.0.extend(value.map(|value| Parameter {
            name: name.into(),
            value,
        }));
        self
    }

    pub(crate) fn text(self, name: &'static str, value: Option<&str>) -> Self {
        self.slot(name, value.map(|value| value.to_owned().into()))
    }

    /// Adds a set, unless it is empty.
    pub(crate) fn set(self, name: &'static str, values: Vec<Term<'static>>) -> Self {
        let set = (!values.is_empty()).then_some(Term::Set(values));
        self.slot(name, set)
    }

    pub(crate) fn texts(self, name: &'static str, values: &[String]) -> Self {
        self.set(name, values.iter().cloned().map(Term::from).collect())
    }

    pub(crate) fn build(self, object: &'static str) -> Term<'static> {
        let arguments = match self.0.is_empty() {
            true => Arguments::Terms(Vec::new()),
            false => Arguments::Parameters(self.0),
        };
        let symbol = object.into();
        FunctionalTerm { symbol, arguments }.into()
    }
}
