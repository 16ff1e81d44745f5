//! Protocols as SCXML files.
//!
//! The form is the one of fipa_acl, whose files are read unchanged:
//!
//! ```xml
//! <scxml version="1.0" initial="1">
//!   <state id="1">
//!     <transition performative="query-ref" from="initiator" to="B" target="2"/>
//!   </state>
//!   <state id="2">
//!     <transition performative="inform" from="B" to="initiator" target="3"/>
//!     <subprotocol name=".*" from="B" proxied_to="initiator"/>
//!   </state>
//!   <state id="3" final="yes"/>
//! </scxml>
//! ```
//!
//! `performative`, the `name` of a subprotocol and roles are regular expressions that match whole
//! names. What this form cannot say is said with attributes of the namespace [`NAMESPACE`]:
//!
//! | element | attribute | meaning |
//! |---|---|---|
//! | `scxml` | `name` | the standard name; without it, the name of the file |
//! | `scxml` | `aliases` | other names, separated by blanks |
//! | `scxml` | `title` | what it is, in a line |
//! | `scxml` | `scope` | `participant`: each participant has a state of its own; `conversation` (default): there is one |
//! | `scxml` | `cancel` | who may cancel: `initiator` (default in a file with this namespace), `anyone` (default in one without), `nobody` |
//! | `transition` | `optional` | `yes`: the step may be left out |
//! | `transition` | `after` | instead of a performative and roles: taken when no message has come by the `reply-by` of the last one (`reply-by`), or for so long (`500ms`, `30s`, `10min`, `1h`) |
//!
//! What must not live here: running a machine (see [`crate::Monitor`]).

mod build;
mod document;

use std::fmt;

use crate::Machine;

/// The namespace of the attributes that go beyond fipa_acl.
pub const NAMESPACE: &str = "urn:fipa-rs:protocol";

/// Largest file, in bytes.
pub const MAX_FILE: usize = 1 << 20;

/// Most mistakes that are told of one file.
const MAX_MISTAKES: usize = 50;

impl Machine {
    /// Reads a protocol from the text of an SCXML file. `file` is its name or path: it stands in
    /// errors, and its last part without `.scxml` or `.xml` is the protocol's name unless the file
    /// says another.
    ///
    /// # Errors
    /// With all mistakes that were found, each with its line.
    pub fn read(file: &str, text: &str) -> Result<Self, ScxmlError> {
        let made = document::read(text)
            .map_err(|mistake| vec![mistake])
            .and_then(|document| build::machine(&document, protocol_name(file)));
        made.map_err(|mut mistakes| {
            mistakes.truncate(MAX_MISTAKES);
            mistakes.sort_by_key(|mistake| mistake.line);
            ScxmlError {
                file: file.to_owned(),
                mistakes,
            }
        })
    }
}

fn protocol_name(file: &str) -> &str {
    let last = file.rsplit(['/', '\\']).next().unwrap_or(file);
    let stem = last
        .strip_suffix(".scxml")
        .or_else(|| last.strip_suffix(".xml"));
    stem.unwrap_or(last)
}

/// Why a file is no protocol.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct ScxmlError {
    /// The file, as it was given.
    pub file: String,
    /// What is wrong with it, in the order of lines.
    pub mistakes: Vec<Mistake>,
}

/// One mistake in a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mistake {
    /// The line, counted from 1.
    pub line: usize,
    /// What is wrong there.
    pub problem: Problem,
}

impl fmt::Display for ScxmlError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, Mistake { line, problem }) in self.mistakes.iter().enumerate() {
            let newline = if index > 0 { "\n" } else { "" };
            write!(f, "{newline}{}:{line}: {problem}", self.file)?;
        }
        Ok(())
    }
}

/// What can be wrong with a protocol.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The file is too large.
    #[error("a file of {0} bytes; a protocol has at most {MAX_FILE}")]
    TooLarge(usize),
    /// There is more of something than can be.
    #[error("more than {limit} {what}")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// How many there may be.
        limit: usize,
    },
    /// It is no XML.
    #[error("not well-formed XML: {0}")]
    Xml(String),
    /// A document type definition could make a small file large.
    #[error("a document type is not accepted; remove the <!DOCTYPE …>")]
    DocumentType,
    /// It has no element.
    #[error("no element is there, but a protocol is an <scxml>")]
    Empty,
    /// The outermost element is another one.
    #[error("the outermost element is <{0}>, but a protocol is an <scxml>")]
    NotScxml(String),
    /// An element is not where it may be.
    #[error("<{element}> does not belong inside <{inside}>")]
    Misplaced {
        /// The element.
        element: String,
        /// Where it stands.
        inside: String,
    },
    /// A necessary attribute is not there.
    #[error("<{element}> lacks the attribute {attribute:?}")]
    Missing {
        /// The element.
        element: &'static str,
        /// The attribute.
        attribute: &'static str,
    },
    /// An attribute of our namespace is not known.
    #[error("unknown attribute {attribute:?} on <{element}>; known there: {known}")]
    UnknownAttribute {
        /// The element.
        element: &'static str,
        /// The attribute, without prefix.
        attribute: String,
        /// Those that are known there.
        known: &'static str,
    },
    /// A value is not one of those it can be.
    #[error("{attribute}={value:?} is not understood; expected {expected}")]
    Value {
        /// The attribute.
        attribute: &'static str,
        /// What it says.
        value: String,
        /// What it can say.
        expected: &'static str,
    },
    /// A regular expression is none.
    #[error("{attribute}={value:?} is no regular expression: {reason}")]
    Pattern {
        /// The attribute.
        attribute: &'static str,
        /// What it says.
        value: String,
        /// Why not.
        reason: String,
    },
    /// There is no state at all.
    #[error("the protocol has no state")]
    NoState,
    /// Two states have the same name.
    #[error("there is a state {id:?} already, in line {first}")]
    DuplicateState {
        /// Its name.
        id: String,
        /// Where it is first.
        first: usize,
    },
    /// A state that is named does not exist.
    #[error("there is no state {id:?}{}", near(.nearest))]
    UnknownState {
        /// Its name.
        id: String,
        /// A state with a name much like it.
        nearest: Option<String>,
    },
    /// No sequence of messages leads to a state.
    #[error("no transition leads to state {0:?}; remove it, or lead to it")]
    UnreachableState(String),
    /// A state has no way out and is not final.
    #[error("state {0:?} has no transition and is not final; add one, or final=\"yes\"")]
    DeadEnd(String),
    /// A message would have two meanings.
    #[error("{0}")]
    Ambiguous(Box<Ambiguity>),
    /// A role of which nobody could know who has it.
    #[error(
        "role {0:?} is never bound: no message is sent to it, and it does not begin; send it one, \
         or correct its name"
    )]
    UnboundRole(String),
    /// A state for each participant needs just two roles.
    #[error("scope=\"participant\" needs two roles, and there are {0}: {1}")]
    RolesOfScope(usize, String),
    /// The first message can be sent by several roles.
    #[error("the first message has several senders: {0}; one role must begin")]
    Beginners(String),
    /// A state has several time-outs.
    #[error("state {0:?} has more than one time-out")]
    TwoTimeouts(String),
    /// Leaving out optional steps would lead in a circle.
    #[error("optional steps lead from state {0:?} back to it")]
    OptionalCircle(String),
}

/// A message that leads to two states.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Ambiguity {
    /// The state in which it comes.
    pub state: String,
    /// A performative that both transitions take.
    pub performative: String,
    /// The sending role.
    pub from: String,
    /// The receiving role.
    pub to: String,
    /// Where this transition leads.
    pub target: String,
    /// Where the other leads.
    pub other_target: String,
    /// The line of the other.
    pub other_line: usize,
}

impl fmt::Display for Ambiguity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            state,
            performative,
            from,
            to,
            target,
            other_target,
            other_line,
        } = self;
        write!(
            f,
            "in state {state:?}, {performative:?} from {from:?} to {to:?} leads to {target:?} and \
             also to {other_target:?} (line {other_line}); keep one of them"
        )
    }
}

fn near(nearest: &Option<String>) -> String {
    match nearest {
        Some(id) => format!("; did you mean {id:?}?"),
        None => String::new(),
    }
}
