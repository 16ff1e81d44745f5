//! The calls of [`crate::actions`] under the same names, blocking.

use std::fmt::Display;
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;
use serde::de::DeserializeOwned;

use tokio::runtime::Handle;

use super::{Agent, Background, Waiter};
use crate::AgentId;
use crate::actions::{
    self, Action, ActionDescription, ActionError, Execution, Goal, GoalError, GoalStatus,
    OfferError, Term,
};
use crate::domain::background;

/// An offered action; see [`crate::actions::Offer`].
#[derive(Debug)]
#[must_use = "dropping the offer withdraws the action"]
pub struct Offer {
    // Declared first, because it must be dropped before the runtime that it uses.
    offer: actions::Offer,
    _background: Background,
}

/// A robot whose actions an agent uses; see [`crate::actions::Robot`].
#[derive(Debug, Clone)]
pub struct Robot<'a> {
    robot: actions::Robot<'a>,
    runtime: &'a Waiter,
}

/// A goal that the robot has accepted; see [`crate::actions::GoalHandle`].
#[derive(Debug)]
#[must_use = "result() returns the result"]
pub struct GoalHandle<'a> {
    handle: actions::GoalHandle<'a>,
    runtime: &'a Waiter,
}

/// The progress of a goal; see [`crate::actions::ProgressUpdates`].
#[derive(Debug)]
#[must_use = "next() returns the progress"]
pub struct ProgressUpdates<'a> {
    updates: actions::ProgressUpdates,
    runtime: &'a Waiter,
}

/// The status of all goals of a robot; see [`crate::actions::StatusUpdates`].
#[derive(Debug)]
#[must_use = "next() returns the status"]
pub struct StatusUpdates<'a> {
    updates: actions::StatusUpdates,
    runtime: &'a Waiter,
}

impl Agent {
    /// Offers an action like [`crate::Agent::offer`]. The handler runs each goal in a thread of its own.
    /// Between two steps, it looks at [`Execution::stop_cause`].
    ///
    /// ```no_run
    /// # fn example(crex: fipa::blocking::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use fipa::actions::{Action, Execution, Progress};
    ///
    /// let blink = Action::new("blink");
    /// let offer = crex.offer(blink, |(): (), run: Execution| {
    ///     for step in 0..10 {
    ///         if let Some(cause) = run.stop_cause() {
    ///             return Err(format!("{cause:?}"));
    ///         }
    ///         run.progress(Progress::fraction(f64::from(step) / 10.0));
    ///         std::thread::sleep(std::time::Duration::from_millis(100));
    ///     }
    ///     Ok(())
    /// })?;
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// As for the async call.
    pub fn offer<G, R, H, E>(&self, action: Action, handler: H) -> Result<Offer, OfferError>
    where
        G: DeserializeOwned + Send + 'static,
        R: Serialize + Send + 'static,
        H: Fn(G, Execution) -> Result<R, E> + Send + Sync + 'static,
        E: Display + Send + 'static,
    {
        let handler = Arc::new(handler);
        let _context = self.runtime.enter();
        let offer = self.agent.offer(action, move |goal: G, execution| {
            let handler = Arc::clone(&handler);
            async move {
                let runtime = Handle::current();
                let handled = background::try_run(&runtime, move |_| handler(goal, execution));
                match handled.await {
                    Ok(handled) => handled.map_err(|error| error.to_string()),
                    Err(error) => Err(error.to_string()),
                }
            }
        })?;
        Ok(Offer {
            offer,
            _background: self.runtime.clone(),
        })
    }

    /// See [`crate::Agent::robot`].
    #[must_use]
    pub fn robot(&self, robot: AgentId) -> Robot<'_> {
        Robot {
            robot: self.agent.robot(robot),
            runtime: &self.runtime.waiter,
        }
    }
}

impl Offer {
    /// Returns the name of the action.
    #[must_use]
    pub fn name(&self) -> &str {
        self.offer.name()
    }
}

impl<'a> Robot<'a> {
    /// Returns the identifier of the robot.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        self.robot.id()
    }

    /// See [`crate::actions::Robot::in_json`].
    #[must_use]
    pub fn in_json(self) -> Self {
        Self {
            robot: self.robot.in_json(),
            ..self
        }
    }

    /// See [`crate::actions::Robot::actions`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn actions(&self) -> Result<Vec<ActionDescription>, ActionError> {
        self.runtime.block_on(self.robot.actions())
    }

    /// See [`crate::actions::Robot::status`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn status(&self) -> Result<Vec<GoalStatus>, ActionError> {
        self.runtime.block_on(self.robot.status())
    }

    /// See [`crate::actions::Robot::watch_status`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn watch_status(&self) -> Result<StatusUpdates<'a>, ActionError> {
        let updates = self.runtime.block_on(self.robot.watch_status())?;
        let runtime = self.runtime;
        Ok(StatusUpdates { updates, runtime })
    }

    /// See [`crate::actions::Robot::goal`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn goal(
        &self,
        action: impl Into<String>,
        arguments: &(impl Serialize + ?Sized),
    ) -> Result<Goal, GoalError> {
        self.robot.goal(action, arguments)
    }

    /// See [`crate::actions::Robot::invoke`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn invoke(
        &self,
        action: impl Into<String>,
        arguments: &(impl Serialize + ?Sized),
    ) -> Result<GoalHandle<'a>, ActionError> {
        let handle = self
            .runtime
            .block_on(self.robot.invoke(action, arguments))?;
        let runtime = self.runtime;
        Ok(GoalHandle { handle, runtime })
    }

    /// See [`crate::actions::Robot::send`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn send(&self, goal: Goal) -> Result<GoalHandle<'a>, ActionError> {
        let handle = self.runtime.block_on(self.robot.send(goal))?;
        let runtime = self.runtime;
        Ok(GoalHandle { handle, runtime })
    }
}

impl<'a> GoalHandle<'a> {
    /// Returns the goal with its id.
    #[must_use]
    pub fn goal(&self) -> &Goal {
        self.handle.goal()
    }

    /// Returns the id of the goal.
    #[must_use]
    pub fn id(&self) -> &str {
        self.handle.id()
    }

    /// See [`crate::actions::GoalHandle::progress`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn progress(&self) -> Result<ProgressUpdates<'a>, ActionError> {
        let updates = self.runtime.block_on(self.handle.progress())?;
        let runtime = self.runtime;
        Ok(ProgressUpdates { updates, runtime })
    }

    /// See [`crate::actions::GoalHandle::result`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn result<R: DeserializeOwned>(self) -> Result<R, ActionError> {
        self.runtime.block_on(self.handle.result())
    }

    /// See [`crate::actions::GoalHandle::outcome`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn outcome(&mut self) -> Result<Option<Term<'static>>, ActionError> {
        self.runtime.block_on(self.handle.outcome())
    }

    /// See [`crate::actions::GoalHandle::cancel`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn cancel(&mut self, timeout: Duration) -> Result<bool, ActionError> {
        self.runtime.block_on(self.handle.cancel(timeout))
    }
}

impl ProgressUpdates<'_> {
    /// See [`crate::actions::ProgressUpdates::next`].
    ///
    /// # Errors
    /// As for the async call.
    #[allow(
        clippy::should_implement_trait,
        reason = "unlike an iterator, it goes on after an error"
    )]
    pub fn next(&mut self) -> Result<Option<GoalStatus>, ActionError> {
        self.runtime.block_on(self.updates.next())
    }
}

impl StatusUpdates<'_> {
    /// See [`crate::actions::StatusUpdates::next`].
    ///
    /// # Errors
    /// As for the async call.
    #[allow(
        clippy::should_implement_trait,
        reason = "unlike an iterator, it goes on after an error"
    )]
    pub fn next(&mut self) -> Result<Vec<GoalStatus>, ActionError> {
        self.runtime.block_on(self.updates.next())
    }

    /// See [`crate::actions::StatusUpdates::cancel`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn cancel(self, timeout: Duration) -> Result<(), ActionError> {
        self.runtime.block_on(self.updates.cancel(timeout))
    }
}
