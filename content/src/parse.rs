//! The parser: one pass over the tokens, without backtracking.

use std::borrow::Cow;

use crate::chars::truth;
use crate::content::{Content, ContentExpression};
use crate::error::{ParseError, Problem};
use crate::lex::{Lexer, Token};
use crate::term::{
    ActionExpression, Arguments, FunctionalTerm, IdentifyingExpression, Parameter,
    ReferentialOperator, Term,
};
use crate::wff::{LogicalOperator, ModalOperator, Quantifier, Wff};
use crate::{MAX_DEPTH, MAX_NODES, SlDialect};

/// Defines the functions of a type that parse a whole text.
macro_rules! parse_functions {
    ($type:ident, $what:literal, $read:path) => {
        impl<'a> $type<'a> {
            #[doc = concat!("Parses one ", $what, " in the standard notation.")]
            ///
            /// # Errors
            #[doc = concat!("When the bytes are not one ", $what, ", are nested deeper than")]
            /// [`MAX_DEPTH`](crate::MAX_DEPTH), or have more than [`MAX_NODES`](crate::MAX_NODES)
            /// terms and formulas.
            pub fn parse(bytes: &'a (impl AsRef<[u8]> + ?Sized)) -> Result<Self, ParseError> {
                Self::parse_in(SlDialect::Standard, bytes)
            }

            #[doc = concat!("Parses one ", $what, " that comes from a writer of this dialect.")]
            ///
            /// # Errors
            /// See [`parse`](Self::parse).
            pub fn parse_in(
                dialect: SlDialect,
                bytes: &'a (impl AsRef<[u8]> + ?Sized),
            ) -> Result<Self, ParseError> {
                Parser::whole(dialect, bytes.as_ref(), $read)
            }
        }
    };
}

parse_functions!(Content, "content", Parser::content);
parse_functions!(Term, "term", Parser::term);
parse_functions!(Wff, "formula", Parser::wff);

const CONTENT: &str = "FIPA00008 Content";
const EXPRESSION: &str = "FIPA00008 ContentExpression";
const WFF: &str = "FIPA00008 Wff";
const TERM: &str = "FIPA00008 Term";
const ACTION: &str = "FIPA00008 ActionExpression";
const FUNCTIONAL: &str = "FIPA00008 FunctionalTerm";
const VARIABLE: &str = "FIPA00008 Variable";

/// Reads tokens and builds the tree.
pub(crate) struct Parser<'a> {
    lexer: Lexer<'a>,
    /// Offset of the last token that was read.
    start: usize,
    depth: usize,
    nodes: usize,
}

/// The first token of a list, which decides what the list is.
enum Head<'a> {
    /// An unquoted word, which can be a keyword.
    Word(&'a str),
    /// A quoted symbol, which is never a keyword.
    Symbol(Cow<'a, str>),
}

impl<'a> Head<'a> {
    fn keyword(&self) -> &str {
        match self {
            Self::Word(word) => word,
            Self::Symbol(_) => "",
        }
    }

    fn into_symbol(self) -> Cow<'a, str> {
        match self {
            Self::Word(word) => Cow::Borrowed(word),
            Self::Symbol(symbol) => symbol,
        }
    }
}

impl<'a> Parser<'a> {
    /// Parses with `read` and checks that no bytes are left.
    pub(crate) fn whole<T>(
        dialect: SlDialect,
        bytes: &'a [u8],
        read: impl FnOnce(&mut Self) -> Result<T, ParseError>,
    ) -> Result<T, ParseError> {
        Self::whole_at(0, dialect, bytes, read)
    }

    /// Parses with `read` at this depth of parentheses and checks that no bytes are left.
    pub(crate) fn whole_at<T>(
        depth: usize,
        dialect: SlDialect,
        bytes: &'a [u8],
        read: impl FnOnce(&mut Self) -> Result<T, ParseError>,
    ) -> Result<T, ParseError> {
        let mut parser = Self {
            lexer: Lexer::new(bytes, dialect),
            start: 0,
            depth,
            nodes: 0,
        };
        let read = read(&mut parser)?;
        if parser.lexer.peek().is_some() {
            let left = Problem::Trailing(parser.lexer.remaining());
            return Err(ParseError::new(parser.lexer.offset(), CONTENT, left));
        }
        Ok(read)
    }

    pub(crate) fn content(&mut self) -> Result<Content<'a>, ParseError> {
        self.expect_open(CONTENT)?;
        let mut expressions = vec![self.content_expression()?];
        while !self.closes(CONTENT)? {
            expressions.push(self.content_expression()?);
        }
        Ok(Content { expressions })
    }

    fn content_expression(&mut self) -> Result<ContentExpression<'a>, ParseError> {
        let token = self.token()?;
        if token != Token::Open {
            return self.atom(token, EXPRESSION).map(ContentExpression::Wff);
        }
        self.descend()?;
        let head = self.head(EXPRESSION)?;
        Ok(if let Some(operator) = referential(head.keyword()) {
            ContentExpression::Identifying(self.identifying(operator)?)
        } else if is_action(head.keyword()) {
            ContentExpression::Action(self.action_of(&head)?)
        } else {
            ContentExpression::Wff(self.wff_of(head)?)
        })
    }

    pub(crate) fn wff(&mut self) -> Result<Wff<'a>, ParseError> {
        let token = self.token()?;
        if token != Token::Open {
            return self.atom(token, WFF);
        }
        self.descend()?;
        let head = self.head(WFF)?;
        if referential(head.keyword()).is_some() || is_action(head.keyword()) {
            return Err(self.unexpected("term", "formula", WFF));
        }
        self.wff_of(head)
    }

    /// Parses a formula without parentheses.
    fn atom(&mut self, token: Token<'a>, clause: &'static str) -> Result<Wff<'a>, ParseError> {
        self.count()?;
        Ok(match token {
            Token::Word("true") => Wff::Truth(true),
            Token::Word("false") => Wff::Truth(false),
            Token::Word(word) => Wff::Proposition(Cow::Borrowed(word)),
            Token::Literal(symbol) => Wff::Proposition(symbol),
            Token::Meta(name) => Wff::Meta(name),
            other => return Err(self.mistaken(&other, "formula", clause)),
        })
    }

    /// Parses the rest of a formula in parentheses.
    fn wff_of(&mut self, head: Head<'a>) -> Result<Wff<'a>, ParseError> {
        self.count()?;
        let keyword = head.keyword();
        let wff = if let Some(operator) = LogicalOperator::of(keyword) {
            Wff::Binary {
                operator,
                left: Box::new(self.wff()?),
                right: Box::new(self.wff()?),
            }
        } else if let Some(quantifier) = Quantifier::of(keyword) {
            Wff::Quantified {
                quantifier,
                variable: match self.token()? {
                    Token::Variable(name) => name,
                    other => return Err(self.mistaken(&other, "variable", VARIABLE)),
                },
                wff: Box::new(self.wff()?),
            }
        } else if let Some(operator) = ModalOperator::of(keyword) {
            Wff::Modal {
                operator,
                agent: Box::new(self.term()?),
                wff: Box::new(self.wff()?),
            }
        } else {
            match keyword {
                "not" => Wff::Not(Box::new(self.wff()?)),
                "=" => Wff::Equal(Box::new(self.term()?), Box::new(self.term()?)),
                "result" => Wff::Result(Box::new(self.term()?), Box::new(self.term()?)),
                "feasible" | "done" => {
                    let is_done = keyword == "done";
                    let action = Box::new(self.action()?);
                    let wff = match self.lexer.peek() {
                        Some(b')') | None => None,
                        Some(_) => Some(Box::new(self.wff()?)),
                    };
                    if is_done {
                        Wff::Done(action, wff)
                    } else {
                        Wff::Feasible(action, wff)
                    }
                }
                _ => {
                    let mut arguments = vec![self.term()?];
                    while !self.closes(WFF)? {
                        arguments.push(self.term()?);
                    }
                    let symbol = head.into_symbol();
                    return Ok(Wff::Predicate { symbol, arguments });
                }
            }
        };
        self.expect_close(WFF)?;
        Ok(wff)
    }

    pub(crate) fn term(&mut self) -> Result<Term<'a>, ParseError> {
        let token = self.token()?;
        self.term_of(token)
    }

    fn term_of(&mut self, token: Token<'a>) -> Result<Term<'a>, ParseError> {
        self.count()?;
        Ok(match token {
            Token::Word(word) => match truth(word) {
                Some(truth) => Term::Boolean(truth),
                None => Term::String(Cow::Borrowed(word)),
            },
            Token::Literal(text) => Term::String(text),
            Token::Bytes(bytes) => Term::Bytes(bytes),
            Token::Number(number) => Term::Number(number),
            Token::DateTime(time) => Term::DateTime(time),
            Token::Variable(name) => Term::Variable(name),
            Token::Meta(name) => Term::Meta(name),
            Token::Open => {
                self.descend()?;
                return self.compound();
            }
            other => return Err(self.mistaken(&other, "term", TERM)),
        })
    }

    /// Parses the rest of a term in parentheses.
    fn compound(&mut self) -> Result<Term<'a>, ParseError> {
        let head = self.head(TERM)?;
        let keyword = head.keyword();
        if let Some(operator) = referential(keyword) {
            return self.identifying(operator).map(Term::from);
        }
        if is_action(keyword) {
            return self.action_of(&head).map(Term::from);
        }
        match keyword {
            "sequence" => self.terms().map(Term::Sequence),
            "set" => self.terms().map(Term::Set),
            _ => {
                let arguments = if self.lexer.peek() == Some(b':') {
                    Arguments::Parameters(self.parameters()?)
                } else {
                    Arguments::Terms(self.terms()?)
                };
                let symbol = head.into_symbol();
                Ok(Term::Functional(FunctionalTerm { symbol, arguments }))
            }
        }
    }

    /// Parses terms up to the closing parenthesis.
    fn terms(&mut self) -> Result<Vec<Term<'a>>, ParseError> {
        let mut terms = Vec::new();
        while !self.closes(TERM)? {
            terms.push(self.term()?);
        }
        Ok(terms)
    }

    /// Parses parameters up to the closing parenthesis.
    fn parameters(&mut self) -> Result<Vec<Parameter<'a>>, ParseError> {
        let mut parameters = Vec::new();
        loop {
            match self.token()? {
                Token::Parameter(name) => {
                    let value = self.term()?;
                    parameters.push(Parameter { name, value });
                }
                Token::Close => {
                    self.depth -= 1;
                    return Ok(parameters);
                }
                other => return Err(self.mistaken(&other, "parameter name or ')'", FUNCTIONAL)),
            }
        }
    }

    fn identifying(
        &mut self,
        operator: ReferentialOperator,
    ) -> Result<IdentifyingExpression<'a>, ParseError> {
        let (term, wff) = (self.term()?, self.wff()?);
        self.expect_close("FIPA00008 IdentifyingExpression")?;
        Ok(IdentifyingExpression {
            operator,
            term,
            wff,
        })
    }

    fn action(&mut self) -> Result<ActionExpression<'a>, ParseError> {
        match self.token()? {
            Token::Open => {
                self.descend()?;
                let head = self.head(ACTION)?;
                self.action_of(&head)
            }
            Token::Meta(name) => {
                self.count()?;
                Ok(ActionExpression::Meta(name))
            }
            other => Err(self.mistaken(&other, "action expression", ACTION)),
        }
    }

    /// Parses the rest of an action expression.
    fn action_of(&mut self, head: &Head<'a>) -> Result<ActionExpression<'a>, ParseError> {
        self.count()?;
        let action = match head.keyword() {
            "action" => ActionExpression::Action {
                agent: self.term()?,
                act: self.term()?,
            },
            "|" => {
                ActionExpression::Alternative(Box::new(self.action()?), Box::new(self.action()?))
            }
            ";" => ActionExpression::Sequential(Box::new(self.action()?), Box::new(self.action()?)),
            _ => return Err(self.unexpected("symbol", "'action', '|' or ';'", ACTION)),
        };
        self.expect_close(ACTION)?;
        Ok(action)
    }

    fn head(&mut self, clause: &'static str) -> Result<Head<'a>, ParseError> {
        match self.token()? {
            Token::Word(word) => Ok(Head::Word(word)),
            Token::Literal(symbol) => Ok(Head::Symbol(symbol)),
            other => Err(self.mistaken(&other, "symbol", clause)),
        }
    }

    #[inline]
    fn token(&mut self) -> Result<Token<'a>, ParseError> {
        self.lexer.peek();
        self.start = self.lexer.offset();
        self.lexer.next()
    }

    /// Whether the list ends here. If so, its closing parenthesis is read.
    #[inline]
    fn closes(&mut self, clause: &'static str) -> Result<bool, ParseError> {
        match self.lexer.peek() {
            Some(b')') => {
                self.lexer.bump();
                self.depth -= 1;
                Ok(true)
            }
            Some(_) => Ok(false),
            None => {
                self.start = self.lexer.offset();
                Err(self.mistaken(&Token::End, "')'", clause))
            }
        }
    }

    fn expect_open(&mut self, clause: &'static str) -> Result<(), ParseError> {
        match self.token()? {
            Token::Open => self.descend(),
            other => Err(self.mistaken(&other, "'('", clause)),
        }
    }

    fn expect_close(&mut self, clause: &'static str) -> Result<(), ParseError> {
        match self.token()? {
            Token::Close => {
                self.depth -= 1;
                Ok(())
            }
            other => Err(self.mistaken(&other, "')'", clause)),
        }
    }

    /// Counts an opening parenthesis that was read.
    fn descend(&mut self) -> Result<(), ParseError> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(ParseError::new(self.start, TERM, Problem::TooDeep));
        }
        Ok(())
    }

    /// Counts a term or formula.
    #[inline]
    fn count(&mut self) -> Result<(), ParseError> {
        self.nodes += 1;
        if self.nodes > MAX_NODES {
            return Err(ParseError::new(self.start, TERM, Problem::TooMany));
        }
        Ok(())
    }

    #[cold]
    fn mistaken(
        &self,
        token: &Token<'_>,
        expected: &'static str,
        clause: &'static str,
    ) -> ParseError {
        if *token == Token::End {
            return ParseError::new(self.start, clause, Problem::Truncated(within(clause)));
        }
        self.unexpected(token.kind(), expected, clause)
    }

    #[cold]
    fn unexpected(
        &self,
        found: &'static str,
        expected: &'static str,
        clause: &'static str,
    ) -> ParseError {
        ParseError::new(self.start, clause, Problem::Unexpected { found, expected })
    }
}

/// Returns the name of a production without the name of the standard.
fn within(clause: &'static str) -> &'static str {
    clause.rsplit(' ').next().unwrap_or(clause)
}

pub(crate) fn referential(keyword: &str) -> Option<ReferentialOperator> {
    match keyword {
        "iota" => Some(ReferentialOperator::Iota),
        "any" => Some(ReferentialOperator::Any),
        "all" => Some(ReferentialOperator::All),
        _ => None,
    }
}

fn is_action(keyword: &str) -> bool {
    matches!(keyword, "action" | "|" | ";")
}
