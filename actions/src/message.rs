//! The contents of messages about actions, independent of their notation.

use std::borrow::Cow;

use fipa_acl::escape;
use fipa_content::{Arguments, FunctionalTerm, Parameter, Printer, SerializeError, Term};
use serde::{Deserialize, Serialize};

use crate::MAX_PROGRESS;
use crate::description::ActionDescription;

/// The content of a message to a robot.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Ask {
    /// Perform an action (`request`).
    Goal(Goal),
    /// List the offered actions (`query-ref`).
    Actions,
    /// Report the status of all goals (`query-ref`, `subscribe`).
    Status,
    /// Report the status of a goal (`query-ref`, `subscribe`); in the answer to `query-ref` with its result.
    StatusOf(GoalRef),
    /// Cancel a goal (`request`).
    Cancel(GoalRef),
    /// Cancel all goals of the action with this name (`request`).
    CancelAll(String),
}

/// Names a goal that the robot has accepted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GoalRef {
    /// The id of the goal.
    pub id: String,
    /// The name of its client. Without it, the goal is that of the asking client, or else that of another client.
    pub client: Option<String>,
}

impl GoalRef {
    /// Names the goal of the client with this name.
    #[must_use]
    pub fn of(self, client: impl Into<String>) -> Self {
        Self {
            client: Some(client.into()),
            ..self
        }
    }
}

impl<T: Into<String>> From<T> for GoalRef {
    fn from(id: T) -> Self {
        Self {
            id: id.into(),
            client: None,
        }
    }
}

/// A goal: the action with its arguments.
#[derive(Debug, Clone, PartialEq)]
pub struct Goal {
    /// The action.
    pub action: String,
    /// The arguments.
    pub arguments: Vec<Parameter<'static>>,
    /// The id, unique among the goals of a client. Without it, the id is the conversation id.
    pub id: Option<String>,
    /// The time for the goal in milliseconds, from its arrival.
    pub deadline: Option<u64>,
    /// The fence of a lock.
    pub fence: Option<String>,
}

/// The error of a value that cannot be the arguments of an action.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GoalError {
    /// SL has no notation for the value.
    #[error(transparent)]
    Serialize(#[from] SerializeError),
    /// The value has no named parts.
    #[error("the arguments of an action must be a struct with named fields, or `()`")]
    NotNamed,
}

impl Goal {
    /// Creates a goal. `arguments` is a struct whose fields are the parameters, a map, or `()`.
    ///
    /// # Errors
    /// If the value has no named fields, or SL has no notation for a part of it.
    pub fn new(
        action: impl Into<String>,
        arguments: &(impl Serialize + ?Sized),
    ) -> Result<Self, GoalError> {
        let arguments = match Term::from_value(arguments)? {
            Term::Sequence(elements) if elements.is_empty() => Vec::new(),
            Term::Set(properties) => properties
                .into_iter()
                .map(property)
                .collect::<Option<_>>()
                .ok_or(GoalError::NotNamed)?,
            Term::Functional(FunctionalTerm { arguments, .. }) => match arguments {
                Arguments::Parameters(parameters) => parameters,
                Arguments::Terms(terms) if terms.is_empty() => Vec::new(),
                Arguments::Terms(_) => return Err(GoalError::NotNamed),
            },
            _ => return Err(GoalError::NotNamed),
        };
        Ok(Self::of(action, arguments))
    }

    /// Creates a goal with these arguments.
    #[must_use]
    pub fn of(action: impl Into<String>, arguments: Vec<Parameter<'static>>) -> Self {
        Self {
            action: action.into(),
            arguments,
            id: None,
            deadline: None,
            fence: None,
        }
    }
}

/// Reads `(property :name n :value v)`.
fn property(term: Term<'static>) -> Option<Parameter<'static>> {
    let Term::Functional(FunctionalTerm {
        arguments: Arguments::Parameters(slots),
        ..
    }) = term
    else {
        return None;
    };
    let (mut name, mut value) = (None, None);
    for slot in slots {
        match (&*slot.name, slot.value) {
            ("name", Term::String(text)) => name = Some(text),
            ("value", term) => value = Some(term),
            _ => {}
        }
    }
    let (name, value) = (name?, value?);
    Some(Parameter { name, value })
}

/// The content of a message from a robot.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum ActionAnswer {
    /// The goal is accepted (`agree`). Whether it waits for others.
    Agreed {
        /// Whether the goal waits in the queue.
        queued: bool,
    },
    /// The action is done (`inform`), with its result if it has one.
    Done(Option<Term<'static>>),
    /// The goal is refused (`refuse`).
    Refused(Refusal),
    /// The action failed (`failure`).
    Failed(Failure),
    /// The offered actions (`inform`).
    Actions(Vec<ActionDescription>),
    /// The status of goals (`inform`).
    Status(Vec<GoalStatus>),
}

/// The reason for which a goal or a query is refused. Texts are paths of parameters, types, units and
/// names, as they are in the description of the action.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Refusal {
    /// The content cannot be read. Holds the error.
    #[error("the content cannot be read: {}", escape(.0))]
    Malformed(String),
    /// The content is longer than this number of bytes.
    #[error("the content is longer than {0} bytes")]
    TooLarge(u64),
    /// The goal is addressed to another agent. Holds its name.
    #[error("the goal is for the agent {}", escape(.0))]
    NotThisAgent(String),
    /// The agent does not offer the action.
    #[error("unknown action {}", escape(.0))]
    UnknownAction(String),
    /// No goal with this id is stored.
    #[error("unknown goal {}", escape(.0))]
    UnknownGoal(String),
    /// Several clients have a goal with this id.
    #[error("several clients have a goal {}; name the client", escape(.0))]
    AmbiguousGoal(String),
    /// The agent with this name is not an operator of the robot, and named goals that are not its own.
    #[error(
        "{} may name its own goals only, because it is not an operator of the robot (access.operators)",
        escape(.0)
    )]
    NotOperator(String),
    /// A parameter without a default is missing.
    #[error("the parameter {} is missing", escape(.0))]
    MissingParameter(String),
    /// The action does not have the parameter.
    #[error("unknown parameter {}", escape(.0))]
    UnknownParameter(String),
    /// A parameter is given twice.
    #[error("the parameter {} is given twice", escape(.0))]
    RepeatedParameter(String),
    /// A value has another type: the parameter, the type it should have, and the type it has.
    #[error("parameter {}: expected {}, found {}", escape(.0), escape(.1), escape(.2))]
    WrongType(String, String, String),
    /// A value has another unit: the parameter, the unit it should have, and the unit it has.
    #[error("parameter {}: expected the unit {:?}, found {:?}", escape(.0), escape(.1), escape(.2))]
    WrongUnit(String, String, String),
    /// A value is out of range: the parameter, the range and the value.
    #[error("parameter {}: {} is not within {}", escape(.0), escape(.2), escape(.1))]
    OutOfRange(String, String, String),
    /// The action needs the fence of a lock.
    #[error("the action needs the fence of a lock")]
    MissingFence,
    /// The action has no lock, so that it cannot check the fence.
    #[error("the action checks no fences")]
    UncheckedFence,
    /// The fence is not admitted.
    #[error("the fence {} is not admitted", escape(.0))]
    StaleFence(String),
    /// The action is already running.
    #[error("the action {} is already running", escape(.0))]
    Busy(String),
    /// The queue of the action is full.
    #[error("the queue of the action {} is full", escape(.0))]
    QueueFull(String),
    /// The robot, or the client, has too many goals.
    #[error("too many goals")]
    TooManyGoals,
    /// The client used the id for another goal.
    #[error("the goal id {} belongs to another goal", escape(.0))]
    UsedId(String),
    /// The robot has looked at the goal and does not accept it. Holds the reason.
    #[error("the robot rejects the goal: {}", escape(.0))]
    Rejected(String),
}

/// The reason for which an action failed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Failure {
    /// The action reports this error.
    #[error("{}", escape(.0))]
    Failed(String),
    /// The client cancelled.
    #[error("cancelled by the client")]
    Cancelled,
    /// The operator with this name cancelled.
    #[error("cancelled by the operator {}", escape(.0))]
    CancelledBy(String),
    /// The client left or died.
    #[error("cancelled, because the client is gone")]
    ClientGone,
    /// The deadline of the goal passed.
    #[error("the deadline passed")]
    DeadlinePassed,
    /// A later goal took its place.
    #[error("a later goal took its place")]
    Preempted,
    /// The robot does not offer the action any more.
    #[error("the action was withdrawn")]
    Withdrawn,
    /// The fence of the goal was not admitted when the goal was to start: the fence, and the one that the
    /// action admitted last, which is the same if the action knows no later one.
    #[error(
        "the fence {} was not admitted when the goal was to start; the last admitted fence is {}",
        escape(.0),
        escape(.1)
    )]
    StaleFence(String, String),
    /// The handler ended without a result.
    #[error("the handler of the action ended unexpectedly")]
    Ended,
    /// The goal ran once, and its result is not stored any more.
    #[error("the goal has run, but its result is not stored any more")]
    Forgotten,
}

/// The progress of an action.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename = "progress")]
pub struct Progress {
    /// The done part, from 0 to 1.
    pub fraction: Option<f64>,
    /// The present step in words.
    pub note: Option<String>,
    /// A value of the action, for example the present pose. The status of all goals, and that of an ended
    /// goal, has none.
    pub value: Option<Term<'static>>,
}

/// The error of a value that cannot be reported as progress.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ProgressError {
    /// SL has no notation for the value.
    #[error(transparent)]
    Serialize(#[from] SerializeError),
    /// The value is too large. Holds its length in SL.
    #[error("the value of the progress has {0} bytes; the maximum is {MAX_PROGRESS}")]
    TooLarge(usize),
}

impl Progress {
    /// Creates a progress of this part, from 0 to 1.
    #[must_use]
    pub fn fraction(part: f64) -> Self {
        Self {
            fraction: Some(part),
            ..Self::default()
        }
    }

    /// Sets the present step in words.
    #[must_use]
    pub fn note(self, note: impl Into<String>) -> Self {
        Self {
            note: Some(note.into()),
            ..self
        }
    }

    /// Sets a value of the action, for example the present pose.
    ///
    /// # Errors
    /// If SL has no notation for a part of the value, or it is longer than 64 KiB there.
    pub fn value(self, value: &(impl Serialize + ?Sized)) -> Result<Self, ProgressError> {
        let value = Term::from_value(value)?;
        match length(&value) {
            length if length > MAX_PROGRESS => Err(ProgressError::TooLarge(length)),
            _ => Ok(Self {
                value: Some(value),
                ..self
            }),
        }
    }
}

/// The state of a goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum GoalState {
    /// It waits for other goals of the action.
    Queued,
    /// It runs.
    Executing,
    /// It is being stopped.
    Stopping,
    /// It is done.
    Done,
    /// It failed.
    Failed,
}

impl GoalState {
    /// Whether the goal has ended.
    #[must_use]
    pub fn is_over(self) -> bool {
        matches!(self, Self::Done | Self::Failed)
    }

    /// Returns the word of the ontology.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Executing => "executing",
            Self::Stopping => "stopping",
            Self::Done => "done",
            Self::Failed => "failed",
        }
    }
}

/// The status of a goal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename = "goal-status")]
#[non_exhaustive]
pub struct GoalStatus {
    /// The id of the goal.
    pub goal: String,
    /// The action.
    pub action: String,
    /// The name of the client.
    pub client: String,
    /// The state.
    pub state: GoalState,
    /// The time since the goal was accepted, in milliseconds.
    pub age: u64,
    /// The last progress.
    pub progress: Option<Progress>,
    /// The reason, if the goal failed.
    pub failure: Option<Failure>,
    /// The result of the goal that was asked for, if it is done and has one.
    pub result: Option<Term<'static>>,
}

/// Returns the length of a value in SL; 0 if it has no notation.
pub(crate) fn length(value: &Term<'_>) -> usize {
    Printer::new().print(value).map_or(0, |text| text.len())
}

/// Returns a parameter.
pub(crate) fn parameter(
    name: impl Into<Cow<'static, str>>,
    value: impl Into<Term<'static>>,
) -> Parameter<'static> {
    Parameter {
        name: name.into(),
        value: value.into(),
    }
}
