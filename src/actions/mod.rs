//! Actions of robots: a robot offers them, other agents list and invoke them.
//!
//! [`Agent::offer`] offers an action; a handler runs each goal. [`Agent::robot`] is another agent whose
//! actions this agent uses: [`Robot::actions`] lists them, and [`Robot::invoke`] sends a goal and returns
//! its handle, with the progress, the result and the cancel.
//!
//! ```no_run
//! use fipa::actions::{Action, Execution, Progress};
//! use fipa::AgentId;
//! use serde::{Deserialize, Serialize};
//!
//! #[derive(Serialize, Deserialize)]
//! #[serde(rename = "pose")]
//! struct Pose {
//!     x: f64,
//!     y: f64,
//!     yaw: f64,
//! }
//!
//! #[derive(Serialize, Deserialize)]
//! struct Dock {
//!     target: Pose,
//! }
//!
//! #[derive(Serialize, Deserialize)]
//! #[serde(rename = "docked")]
//! struct Docked {
//!     charge: f64,
//! }
//!
//! # async fn robot(crex: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
//! // The robot.
//! let dock = Action::new("dock")
//!     .parameter::<Pose>("target", "m, rad; frame crex/base")
//!     .result::<Docked>();
//! let offer = crex.offer(dock, |goal: Dock, run: Execution| async move {
//!     run.progress(Progress::fraction(0.5));
//!     tokio::select! {
//!         cause = run.stopped() => Err(format!("{cause:?}")),
//!         () = drive_to(goal.target) => Ok(Docked { charge: 0.8 }),
//!     }
//! })?;
//! # Ok(())
//! # }
//! # async fn drive_to(_: Pose) {}
//!
//! # async fn client(rover: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
//! // The client.
//! let crex = rover.robot(AgentId::new("crex")?);
//! for action in crex.actions().await? {
//!     println!("{}", action.name);
//! }
//! let target = Pose { x: 1.5, y: 0.2, yaw: 3.1 };
//! let mut goal = crex.invoke("dock", &Dock { target }).await?;
//! let mut progress = goal.progress().await?;
//! while let Some(status) = progress.next().await? {
//!     println!("{:?}", status.progress);
//! }
//! let docked: Docked = goal.result().await?;
//! # Ok(())
//! # }
//! ```
//!
//! # Messages
//!
//! Each call is a standard conversation with the ontology [`ONTOLOGY`]. A goal is a `fipa-request` with
//! the cancel meta-protocol; the lists of actions and of goals are answers to `query-ref`; progress is a
//! `fipa-subscribe`. The book (docs/book/src/actions.md) has the grammar.
//!
//! # Partners that end
//!
//! A robot that leaves or dies ends the handle with [`DialogueError::Gone`]; see
//! [`protocol`](crate::protocol). A goal whose client leaves or dies is cancelled, unless
//! [`Action::orphans`] says otherwise. After an unconfirmed outcome, the client sends the same
//! [`Goal`](GoalHandle::goal) again: the robot runs it once, and stores the outcomes of ended goals for
//! ten minutes, at most 128 of one client and 1,024 in all.
//!
//! # Operators
//!
//! An agent whose name matches `access.operators` of the robot may cancel the goals of other clients and read their
//! results: [`Robot::cancel`], [`Robot::cancel_all`], [`Robot::status_of`].
//!
//! Not in this module: the ontology and the decisions about goals (`fipa-actions`).

mod client;
mod offer;
mod server;
pub(crate) mod table;

pub use client::{ActionError, GoalHandle, ProgressUpdates, Robot, StatusUpdates};
pub use fipa_actions::{
    ActionDescription, Cause, Failure, Field, Goal, GoalError, GoalRef, GoalState, GoalStatus,
    LanguageError, ONTOLOGY, OfferRefused, Orphans, ParameterDescription, Policy, Progress,
    ProgressError, Range, Refusal, Type, arguments_from_json, term_from_json, term_to_json,
};
pub use fipa_content::Term;
pub use offer::{Action, Offer, OfferError};

pub use self::table::Execution;
#[cfg(doc)]
use crate::Agent;
#[cfg(doc)]
use crate::protocol::DialogueError;
