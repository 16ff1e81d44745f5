//! Actions of robots as content of FIPA messages: the ontology `fipa-robot-actions`, and the execution
//! of goals.
//!
//! A robot offers actions. A client lists them, sends a goal for one of them, follows its progress, gets
//! the result, or cancels it. This crate has neither I/O nor a clock: times are milliseconds of the
//! caller's monotonic clock.
//!
//! * [`ActionDescription`] describes an action: its parameters with types, units, ranges and defaults,
//!   and its result. [`Type::of`] derives the type from a Rust type with serde.
//! * [`Ask`] and [`ActionAnswer`] are the contents of messages. A [`Language`] writes and reads them: FIPA-SL
//!   ([`Sl`]) or JSON ([`Json`]); [`language`] finds one by its name.
//! * [`ActionDescription::admit`] checks the arguments of a [`Goal`]; a [`Refusal`] names the parameter
//!   and the reason.
//! * [`Executor`] decides which goal runs when: policies, deadlines, cancels, the memory of goal ids,
//!   and the rate of progress.
//!
//! ```
//! use fipa_acl::AgentId;
//! use fipa_actions::{Ask, Goal, Language, Sl};
//! use serde::Serialize;
//!
//! #[derive(Serialize)]
//! #[serde(rename = "pose")]
//! struct Pose {
//!     x: f64,
//!     y: f64,
//! }
//!
//! #[derive(Serialize)]
//! struct Dock {
//!     target: Pose,
//! }
//!
//! let goal = Goal::new("dock", &Dock { target: Pose { x: 1.5, y: 0.2 } })?;
//! let content = Sl.write_ask(&AgentId::new("crex")?, &Ask::Goal(goal))?;
//! assert_eq!(
//!     content,
//!     b"((action (agent-identifier :name crex) (dock :target (pose :x 1.5 :y 0.2))))"
//! );
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Not in this crate: messages, tasks and handlers (`fipa::actions`).

mod description;
mod executor;
mod json;
mod language;
mod message;
mod probe;
mod sl;
mod types;

pub use description::{ActionDescription, ParameterDescription, Policy, Range};
pub use executor::{
    ActionLimits, Cause, Check, Executor, Gate, OfferOptions, OfferRefused, Orphans, Output,
    Running,
};
pub use json::{Json, arguments_from_json, term_from_json, term_to_json};
pub use language::{Language, LanguageError, language};
pub use message::{
    ActionAnswer, Ask, Failure, Goal, GoalError, GoalRef, GoalState, GoalStatus, Progress,
    ProgressError, Refusal,
};
pub use sl::Sl;
pub use types::{Field, Mismatch, Type};

/// The ontology of all messages about actions.
pub const ONTOLOGY: &str = "fipa-robot-actions";

/// Names that no parameter can have, because they belong to the goal itself.
pub const RESERVED: [&str; 3] = ["goal", "deadline", "fence"];

/// Maximum length of a goal's content in bytes.
pub const MAX_CONTENT: usize = 1 << 20;

/// Name that no action can have, because it cancels goals.
pub const CANCEL: &str = "cancel-goals";

/// Maximum length of the value of a progress in SL, in bytes.
pub const MAX_PROGRESS: usize = 64 << 10;

/// Maximum length of names, goal ids and fences in bytes.
pub const MAX_NAME: usize = 256;
