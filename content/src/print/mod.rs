//! The printer: contents, formulas and terms as SL text.

mod indent;

use std::fmt;

use fipa_acl::escape;

use crate::content::{Content, ContentExpression};
use crate::error::PrintError;
use crate::term::{
    ActionExpression, Arguments, FunctionalTerm, IdentifyingExpression, Parameter, Term,
};
use crate::wff::Wff;
use crate::{MAX_DEPTH, SlDialect, write};

/// Writes contents, formulas and terms.
///
/// Printed text reads as the same value in the same dialect, with two exceptions: in the standard
/// dialect a byte string that is UTF-8 reads as a string, and a predicate without arguments reads as
/// a proposition.
///
/// ```
/// use fipa_content::{Content, SlDialect, Printer};
///
/// let content = Content::parse("( (done(action crex (dock))) )")?;
/// let text = Printer::new().dialect(SlDialect::Jade).print(&content)?;
/// assert_eq!(text, b"((done (action crex (dock))))");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Copy, Default)]
pub struct Printer {
    dialect: SlDialect,
    layout: Layout,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Layout {
    #[default]
    Line,
    Indented,
    JadeFailure,
}

impl Printer {
    /// Returns a printer for the standard dialect, on one line.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Writes in this dialect.
    #[must_use]
    pub fn dialect(self, dialect: SlDialect) -> Self {
        Self { dialect, ..self }
    }

    /// Writes lists of more than 80 bytes on several lines for readability. Strings keep their line
    /// breaks.
    #[must_use]
    pub fn indented(self) -> Self {
        let layout = Layout::Indented;
        Self { layout, ..self }
    }

    /// Writes in the format in which the AMS of JADE reports failures of its message transport: in
    /// JADE's dialect, with the insignificant blanks of its string encoding in agent identifiers
    /// and actions.
    #[must_use]
    pub fn jade_failure(self) -> Self {
        Self {
            dialect: SlDialect::Jade,
            layout: Layout::JadeFailure,
        }
    }

    /// Writes the expression: a [`Content`], [`ContentExpression`], [`Wff`], [`Term`],
    /// [`ActionExpression`] or [`IdentifyingExpression`]. The result is UTF-8, unless a byte string
    /// of the standard dialect is in it.
    ///
    /// # Errors
    /// When the dialect has no notation for a part of it.
    pub fn print(&self, expression: &impl Expression) -> Result<Vec<u8>, PrintError> {
        let mut writer = Writer {
            printer: *self,
            out: Vec::new(),
            depth: 0,
        };
        expression.print(&mut writer)?;
        Ok(match self.layout {
            Layout::Indented => indent::indented(&writer.out),
            Layout::Line | Layout::JadeFailure => writer.out,
        })
    }
}

/// Values that a [`Printer`] prints. Other crates cannot implement this trait.
pub trait Expression: sealed::Print {}

mod sealed {
    use crate::error::PrintError;

    /// Seals [`super::Expression`].
    pub trait Print {
        /// Appends the expression.
        #[doc(hidden)]
        fn print(&self, writer: &mut super::Writer) -> Result<(), PrintError>;
    }
}

/// The output buffer.
#[derive(Debug)]
pub struct Writer {
    printer: Printer,
    out: Vec<u8>,
    depth: usize,
}

impl Writer {
    fn put(&mut self, text: &str) {
        self.out.extend_from_slice(text.as_bytes());
    }

    fn open(&mut self) -> Result<(), PrintError> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(PrintError::TooDeep);
        }
        self.out.push(b'(');
        Ok(())
    }

    fn close(&mut self) {
        self.depth -= 1;
        self.out.push(b')');
    }

    /// Appends a list that starts with a keyword.
    fn list<const N: usize>(
        &mut self,
        keyword: &str,
        parts: [&dyn sealed::Print; N],
    ) -> Result<(), PrintError> {
        self.open()?;
        self.put(keyword);
        self.each(parts)?;
        self.close();
        Ok(())
    }

    /// Appends each part after a blank.
    fn each<'p>(
        &mut self,
        parts: impl IntoIterator<Item = &'p dyn sealed::Print>,
    ) -> Result<(), PrintError> {
        for part in parts {
            self.out.push(b' ');
            part.print(self)?;
        }
        Ok(())
    }

    fn terms(&mut self, terms: &[Term<'_>]) -> Result<(), PrintError> {
        self.each(terms.iter().map(|term| term as &dyn sealed::Print))
    }

    fn name(&mut self, prefix: &str, name: &str) -> Result<(), PrintError> {
        self.put(prefix);
        write::name(&mut self.out, self.printer.dialect, name)
    }

    fn meta(&mut self, name: &str) -> Result<(), PrintError> {
        self.name("??", name)
    }

    fn is_jade_failure(&self) -> bool {
        self.printer.layout == Layout::JadeFailure
    }

    fn functional(&mut self, term: &FunctionalTerm<'_>) -> Result<(), PrintError> {
        if self.is_jade_failure()
            && term.symbol == "agent-identifier"
            && let Arguments::Parameters(parameters) = &term.arguments
        {
            return self.jade_agent(parameters);
        }
        self.open()?;
        let is_binary = term.terms().len() == 2;
        let dialect = self.printer.dialect;
        write::function_symbol(&mut self.out, dialect, &term.symbol, is_binary)?;
        match &term.arguments {
            Arguments::Terms(terms) => self.terms(terms)?,
            Arguments::Parameters(parameters) => {
                for Parameter { name, value } in parameters {
                    self.name(" :", name)?;
                    self.each([value as &dyn sealed::Print])?;
                }
            }
        }
        self.close();
        Ok(())
    }

    /// Appends an agent identifier in the form of JADE's string encoding of messages.
    fn jade_agent(&mut self, parameters: &[Parameter<'_>]) -> Result<(), PrintError> {
        self.open()?;
        self.put(" agent-identifier");
        for Parameter { name, value } in parameters {
            self.name(" :", name)?;
            if let Term::Sequence(elements) = value {
                self.put(" (sequence");
                self.terms(elements)?;
                self.put(" )");
            } else {
                self.each([value as &dyn sealed::Print])?;
                self.put(" ");
            }
        }
        self.close();
        Ok(())
    }
}

impl sealed::Print for Content<'_> {
    fn print(&self, writer: &mut Writer) -> Result<(), PrintError> {
        let [first, others @ ..] = &self.expressions[..] else {
            return Err(PrintError::Empty);
        };
        writer.open()?;
        if writer.is_jade_failure() {
            writer.put(" ");
        }
        first.print(writer)?;
        writer.each(others.iter().map(|one| one as &dyn sealed::Print))?;
        let several = writer.printer.dialect == SlDialect::Jade && !others.is_empty();
        if several || writer.is_jade_failure() {
            // JADE writes a blank after each of several expressions.
            writer.put(" ");
        }
        writer.close();
        Ok(())
    }
}

impl sealed::Print for ContentExpression<'_> {
    fn print(&self, writer: &mut Writer) -> Result<(), PrintError> {
        match self {
            Self::Action(action) => action.print(writer),
            Self::Identifying(expression) => expression.print(writer),
            Self::Wff(wff) => wff.print(writer),
        }
    }
}

impl sealed::Print for ActionExpression<'_> {
    fn print(&self, writer: &mut Writer) -> Result<(), PrintError> {
        match self {
            Self::Action { agent, act } => {
                writer.open()?;
                writer.put("action");
                writer.each([agent as &dyn sealed::Print, act])?;
                if writer.is_jade_failure() {
                    writer.put(" ");
                }
                writer.close();
                Ok(())
            }
            Self::Alternative(first, second) => writer.list("|", [&**first, &**second]),
            Self::Sequential(first, second) => writer.list(";", [&**first, &**second]),
            Self::Meta(name) => writer.meta(name),
        }
    }
}

impl sealed::Print for IdentifyingExpression<'_> {
    fn print(&self, writer: &mut Writer) -> Result<(), PrintError> {
        writer.list(self.operator.as_str(), [&self.term, &self.wff])
    }
}

impl sealed::Print for Term<'_> {
    fn print(&self, writer: &mut Writer) -> Result<(), PrintError> {
        let dialect = writer.printer.dialect;
        match self {
            Self::Variable(name) => writer.name("?", name),
            Self::Meta(name) => writer.meta(name),
            Self::Number(number) => {
                writer.put(number.as_str());
                Ok(())
            }
            Self::String(text) => write::string(&mut writer.out, dialect, text),
            Self::Bytes(bytes) => write::bytes(&mut writer.out, dialect, bytes),
            Self::Boolean(truth) => {
                writer.put(if *truth { "true" } else { "false" });
                Ok(())
            }
            Self::DateTime(time) => write::time(&mut writer.out, dialect, *time),
            Self::Functional(term) => writer.functional(term),
            Self::Sequence(terms) | Self::Set(terms) => {
                writer.open()?;
                writer.put(if matches!(self, Self::Set(_)) {
                    "set"
                } else {
                    "sequence"
                });
                writer.terms(terms)?;
                writer.close();
                Ok(())
            }
            Self::Action(action) => action.print(writer),
            Self::Identifying(expression) => expression.print(writer),
        }
    }
}

impl sealed::Print for Wff<'_> {
    fn print(&self, writer: &mut Writer) -> Result<(), PrintError> {
        let dialect = writer.printer.dialect;
        match self {
            Self::Truth(truth) => {
                writer.put(if *truth { "true" } else { "false" });
                Ok(())
            }
            Self::Proposition(symbol) => write::proposition(&mut writer.out, dialect, symbol),
            Self::Predicate { symbol, arguments } if arguments.is_empty() => {
                write::proposition(&mut writer.out, dialect, symbol)
            }
            Self::Predicate { symbol, arguments } => {
                writer.open()?;
                write::predicate_symbol(&mut writer.out, dialect, symbol)?;
                writer.terms(arguments)?;
                writer.close();
                Ok(())
            }
            Self::Equal(left, right) => writer.list("=", [&**left, &**right]),
            Self::Result(action, value) => writer.list("result", [&**action, &**value]),
            Self::Not(wff) => writer.list("not", [&**wff]),
            Self::Binary {
                operator,
                left,
                right,
            } => writer.list(operator.as_str(), [&**left, &**right]),
            Self::Quantified {
                quantifier,
                variable,
                wff,
            } => {
                writer.open()?;
                writer.put(quantifier.as_str());
                writer.name(" ?", variable)?;
                writer.each([&**wff as &dyn sealed::Print])?;
                writer.close();
                Ok(())
            }
            Self::Modal {
                operator,
                agent,
                wff,
            } => writer.list(operator.as_str(), [&**agent, &**wff]),
            Self::Feasible(action, None) => writer.list("feasible", [&**action]),
            Self::Feasible(action, Some(wff)) => writer.list("feasible", [&**action, &**wff]),
            Self::Done(action, None) => writer.list("done", [&**action]),
            Self::Done(action, Some(wff)) => writer.list("done", [&**action, &**wff]),
            Self::Meta(name) => writer.meta(name),
        }
    }
}

macro_rules! expressions {
    ($($name:ident),*) => {$(
        impl Expression for $name<'_> {}

        /// Writes one line in the standard dialect, [escaped](escape). An expression that cannot be
        /// printed gives the text of the error in angle brackets.
        impl fmt::Display for $name<'_> {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match Printer::new().print(self) {
                    Ok(text) => f.write_str(&escape(&String::from_utf8_lossy(&text))),
                    Err(error) => write!(f, "<{error}>"),
                }
            }
        }
    )*};
}

expressions!(
    Content,
    ContentExpression,
    Wff,
    Term,
    ActionExpression,
    IdentifyingExpression
);
