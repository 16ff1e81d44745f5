//! Reading of protocols from SCXML files.
//!
//! The format is that of fipa_acl. Its files are read unchanged:
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
//! names. The namespace [`NAMESPACE`] adds these attributes:
//!
//! | element | attribute | meaning |
//! |---|---|---|
//! | `scxml` | `name` | name of the protocol; without it, the name of the file |
//! | `scxml` | `aliases` | other names, separated by blanks |
//! | `scxml` | `title` | description in one line |
//! | `scxml` | `scope` | `participant`: each participant has a state of its own; `conversation` (default): the conversation has one state |
//! | `scxml` | `cancel` | agents that may cancel: `initiator` (default in a file with this namespace), `anyone` (default in a file without it), `nobody` |
//! | `transition` | `optional` | `yes`: the transition may be skipped |
//! | `transition` | `after` | makes the transition a timeout, without a performative and roles: it is taken when no message has come by the `reply-by` of the last one (`reply-by`), or within a span (`500ms`, `30s`, `10min`, `1h`) |
//! | `transition` | `at-most` | maximum number of participants in the target state at the same time, for `scope="participant"` |
//! | `transition` | `when` | `all`: each participant must be in a state with the same transition or in its target, for `scope="participant"`; a participant whose conversation was canceled or failed does not count |
//!
//! [`crate::Monitor`] runs the machines.

mod build;
mod document;

use std::fmt;

use crate::Machine;

/// The namespace of the attributes that fipa_acl does not have.
pub const NAMESPACE: &str = "urn:fipa-rs:protocol";

/// Maximum size of a file, in bytes.
pub const MAX_FILE: usize = 1 << 20;

/// Maximum number of mistakes in an error.
const MAX_MISTAKES: usize = 50;

impl Machine {
    /// Reads a protocol from the text of an SCXML file.
    ///
    /// `file` is the name or path of the file. Errors contain it. Unless the file has a name for the
    /// protocol, the name is the last part of `file` without `.scxml` or `.xml`.
    ///
    /// # Errors
    /// The file has mistakes. The error has all of them, each with its line.
    pub fn read(file: &str, text: &str) -> Result<Self, ScxmlError> {
        Self::read_with_warnings(file, text).map(|(machine, _)| machine)
    }

    /// Reads a protocol like [`read`](Self::read), and returns also what is probably not meant: a
    /// performative that differs from a standard one by a typing error, and attributes that have no
    /// effect. The warnings are in the order of their lines, at most 50.
    ///
    /// # Errors
    /// See [`read`](Self::read).
    pub fn read_with_warnings(file: &str, text: &str) -> Result<(Self, Vec<Warning>), ScxmlError> {
        let (result, warnings) = match document::read(text) {
            Ok((document, mut warnings)) => {
                let (result, near) = build::machine(&document, protocol_name(file));
                warnings.extend(near);
                warnings.sort_by_key(|warning| warning.line);
                warnings.truncate(MAX_MISTAKES);
                (result, warnings)
            }
            Err(mistake) => (Err(vec![mistake]), Vec::new()),
        };
        match result {
            Ok(machine) => Ok((machine, warnings)),
            Err(mut mistakes) => {
                mistakes.truncate(MAX_MISTAKES);
                mistakes.sort_by_key(|mistake| mistake.line);
                Err(ScxmlError {
                    file: file.to_owned(),
                    mistakes,
                    warnings,
                })
            }
        }
    }
}

fn protocol_name(file: &str) -> &str {
    let last = file.rsplit(['/', '\\']).next().unwrap_or(file);
    let stem = last
        .strip_suffix(".scxml")
        .or_else(|| last.strip_suffix(".xml"));
    stem.unwrap_or(last)
}

/// Error of reading a protocol: the mistakes of its file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct ScxmlError {
    /// Name or path of the file.
    pub file: String,
    /// Mistakes in the order of their lines.
    pub mistakes: Vec<Mistake>,
    /// Parts that are probably not meant, as of [`Machine::read_with_warnings`]. A mistake may be a
    /// consequence of one.
    pub warnings: Vec<Warning>,
}

/// A mistake in a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mistake {
    /// Line of the mistake, counted from 1.
    pub line: usize,
    /// The problem.
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

/// A part of a file that is valid and probably not meant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Warning {
    /// Line, counted from 1.
    pub line: usize,
    /// The doubt.
    pub doubt: Doubt,
}

/// The reason of a [`Warning`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Doubt {
    /// A user-defined performative is similar to a standard one.
    #[error("{performative:?} is no performative of FIPA00037; did you mean {standard:?}?")]
    NearPerformative {
        /// The performative.
        performative: String,
        /// The standard one.
        standard: &'static str,
    },
    /// An attribute without a namespace has no effect.
    #[error(
        "the attribute {attribute:?} of <{element}> has no effect; effective attributes: {known}"
    )]
    Ignored {
        /// The element.
        element: &'static str,
        /// Name of the attribute.
        attribute: String,
        /// Attributes of the element that have an effect.
        known: &'static str,
    },
}

/// A problem of a protocol.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The file is too large.
    #[error("the file has {0} bytes (maximum {MAX_FILE})")]
    TooLarge(usize),
    /// The file has too many items of one kind.
    #[error("more than {limit} {what}")]
    TooMany {
        /// Kind of the items.
        what: &'static str,
        /// Maximum number.
        limit: usize,
    },
    /// The file is not XML.
    #[error("not well-formed XML: {0}")]
    Xml(String),
    /// The file has a document type definition, which could expand a small file to a large one.
    #[error("document types are not supported; remove the <!DOCTYPE …>")]
    DocumentType,
    /// The file has no element.
    #[error("the file has no element; a protocol is an <scxml> element")]
    Empty,
    /// The outermost element is not `scxml`.
    #[error("the outermost element is <{0}>; a protocol is an <scxml> element")]
    NotScxml(String),
    /// An element is at a position where it is not allowed.
    #[error("<{element}> is not allowed inside <{inside}>")]
    Misplaced {
        /// The element.
        element: String,
        /// The enclosing element.
        inside: String,
    },
    /// A mandatory attribute is missing.
    #[error("<{element}> lacks the attribute {attribute:?}")]
    Missing {
        /// The element.
        element: &'static str,
        /// The attribute.
        attribute: &'static str,
    },
    /// An attribute of [`NAMESPACE`] is unknown.
    #[error("unknown attribute {attribute:?} of <{element}>; known attributes: {known}")]
    UnknownAttribute {
        /// The element.
        element: &'static str,
        /// Name of the attribute, without prefix.
        attribute: String,
        /// Known attributes of the element.
        known: &'static str,
    },
    /// An attribute has an invalid value.
    #[error("invalid value {attribute}={value:?}; expected {expected}")]
    Value {
        /// The attribute.
        attribute: &'static str,
        /// Its value.
        value: String,
        /// Valid values.
        expected: &'static str,
    },
    /// A value is not a regular expression.
    #[error("{attribute}={value:?} is not a regular expression: {reason}")]
    Pattern {
        /// The attribute.
        attribute: &'static str,
        /// Its value.
        value: String,
        /// Reason of the parser.
        reason: String,
    },
    /// The protocol has no state.
    #[error("the protocol has no state")]
    NoState,
    /// Two states have the same identifier.
    #[error("line {first} already has a state {id:?}")]
    DuplicateState {
        /// The identifier.
        id: String,
        /// Line of the first state.
        first: usize,
    },
    /// A target does not exist.
    #[error("there is no state {id:?}{}", near(.nearest))]
    UnknownState {
        /// The identifier.
        id: String,
        /// A state with a similar identifier.
        nearest: Option<String>,
    },
    /// No sequence of messages leads to a state.
    #[error("no transition leads to state {0:?}; remove it, or add a transition to it")]
    UnreachableState(String),
    /// A state has no transition and is not final.
    #[error("state {0:?} has no transition and is not final; add one, or final=\"yes\"")]
    DeadEnd(String),
    /// A message would lead to two states.
    #[error("{0}")]
    Ambiguous(Box<Ambiguity>),
    /// No message determines the agent that has a role.
    #[error(
        "role {0:?} is never bound: no message is sent to it, and it does not begin; send it a \
         message, or correct its name"
    )]
    UnboundRole(String),
    /// A role sends a message to itself.
    #[error("role {0:?} sends the message to itself; give another role in from or to")]
    ToItself(String),
    /// A protocol with a state for each participant does not have two roles.
    #[error("scope=\"participant\" needs two roles, but there are {0}: {1}")]
    RolesOfScope(usize, String),
    /// A transition has a guard, but there is one state for all participants.
    #[error("the attributes at-most and when require scope=\"participant\"")]
    GuardOfScope,
    /// Several roles can send the first message.
    #[error("the first message has several senders: {0}; only one role may begin")]
    Beginners(String),
    /// A state has several timeouts.
    #[error("state {0:?} has more than one timeout")]
    TwoTimeouts(String),
    /// Optional transitions form a cycle.
    #[error("optional transitions lead from state {0:?} back to it")]
    OptionalCircle(String),
}

/// A message that leads to two states.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Ambiguity {
    /// State with both transitions.
    pub state: String,
    /// Performative of both transitions.
    pub performative: String,
    /// Sending role.
    pub from: String,
    /// Receiving role.
    pub to: String,
    /// Target of this transition.
    pub target: String,
    /// Target of the other transition.
    pub other_target: String,
    /// Line of the other transition.
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
