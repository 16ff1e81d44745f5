//! Offered actions.

use std::borrow::Cow;
use std::fmt::{self, Display};
use std::sync::Arc;

use fipa_actions::{
    ActionDescription, Failure, Gate, OfferOptions, OfferRefused, Orphans, ParameterDescription,
    Policy, Refusal, Type,
};
use fipa_content::{Arguments, FunctionalTerm, Parameter, Term};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::server;
use crate::actions::table::{ActionTable, Execution, Handler, Outcome};
use crate::agent::Agent;
use crate::protocol::DialogueError;

/// An action to be offered with [`Agent::offer`].
///
/// ```
/// use fipa::actions::{Action, ParameterDescription, Policy};
///
/// # fn example() -> Result<(), Box<dyn std::error::Error>> {
/// let drive = Action::new("drive")
///     .described("Drives straight on")
///     .parameter::<f64>("distance", "m")
///     .with(
///         ParameterDescription::of::<f64>("speed")
///             .unit("m/s")
///             .range(0.0..=0.5)
///             .default(&0.2)?,
///     )
///     .policy(Policy::Preempt);
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
#[must_use = "Agent::offer offers the action"]
pub struct Action {
    description: ActionDescription,
    options: OfferOptions,
}

impl Action {
    /// Creates an action without parameters and result. A goal is refused while another one runs.
    pub fn new(name: impl Into<String>) -> Self {
        ActionDescription::new(name).into()
    }

    /// Sets the description in words.
    pub fn described(mut self, text: impl Into<String>) -> Self {
        self.description.description = Some(text.into());
        self
    }

    /// Adds a parameter of the type `T` with its unit, and with the frame of reference where there is
    /// one: `m, rad; frame crex/base`. An empty unit is none. `Option<T>` is a parameter that may be left
    /// out.
    pub fn parameter<T: DeserializeOwned>(
        self,
        name: impl Into<String>,
        unit: impl Into<String>,
    ) -> Self {
        self.with(ParameterDescription::of::<T>(name).unit(unit))
    }

    /// Adds a parameter with a range, a default or a description.
    pub fn with(mut self, parameter: ParameterDescription) -> Self {
        self.description.parameters.push(parameter);
        self
    }

    /// Sets the type of the result.
    pub fn result<R: DeserializeOwned>(mut self) -> Self {
        self.description.result = Type::of::<R>();
        self
    }

    /// Sets the treatment of a goal while another one runs.
    pub fn policy(mut self, policy: Policy) -> Self {
        self.description.policy = policy;
        self
    }

    /// Sets the maximum number of goals that run at the same time; the default is 1.
    pub fn concurrency(mut self, goals: usize) -> Self {
        self.options.concurrency = goals;
        self
    }

    /// Sets the treatment of a goal whose client is gone; the default is to cancel it.
    pub fn orphans(mut self, orphans: Orphans) -> Self {
        self.options.orphans = orphans;
        self
    }

    /// Lets the handler decide about each goal. The client gets the `agree` when the handler calls
    /// [`Execution::accept`](super::Execution::accept), or returns a result. If the handler returns an error before, the
    /// goal is refused with that reason ([`Refusal::Rejected`](super::Refusal::Rejected)). The policy applies before the
    /// decision: a goal waits in the queue, or stops an earlier one, without an `agree`.
    ///
    /// ```no_run
    /// use fipa::actions::{Action, Execution};
    ///
    /// # fn example(arm: &fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// let reach = Action::new("reach").parameter::<f64>("distance", "m").decided_by_handler();
    /// let offer = arm.offer(reach, |goal: std::collections::BTreeMap<String, f64>, run: Execution| async move {
    ///     if goal.values().any(|distance| *distance > 0.8) {
    ///         return Err("out of reach");
    ///     }
    ///     run.accept();
    ///     // The movement.
    ///     Ok(())
    /// })?;
    /// # Ok(())
    /// # }
    /// ```
    pub fn decided_by_handler(mut self) -> Self {
        self.options.decides = true;
        self
    }

    /// Requires the fence of a lock, and checks it: when the goal arrives, and again when it starts after
    /// a wait. The check must not wait. It gets the text of the fence.
    pub fn fenced(mut self, admits: impl FnMut(&str) -> bool + Send + 'static) -> Self {
        self.description.fenced = true;
        self.options.gate = Some(Box::new(admits) as Gate);
        self
    }

    /// Requires the fence of a lock, and admits the fences of one owner for one resource, from the
    /// highest that was admitted on. A holder that was stopped or cut off, and whose lock went to another
    /// one that has sent a goal since, is refused. If this agent owns the resource, call
    /// [`Owned::admit`](crate::locks::Owned::admit) in the check of [`fenced`](Self::fenced) instead, which
    /// refuses a fence as soon as its lock ends.
    ///
    /// ```
    /// use fipa::actions::Action;
    /// use fipa::locks::Admission;
    ///
    /// # fn example() -> Result<(), Box<dyn std::error::Error>> {
    /// let dock = Action::new("dock").fenced_by(Admission::new("crane", "bay")?);
    /// # Ok(())
    /// # }
    /// ```
    #[cfg(feature = "protocols")]
    pub fn fenced_by(self, mut admission: crate::locks::Admission) -> Self {
        self.fenced(move |text| {
            let fence = text.parse::<crate::locks::Fence>();
            fence.is_ok_and(|fence| admission.admit(&fence))
        })
    }
}

/// An action of this description, with the default options.
impl From<ActionDescription> for Action {
    fn from(description: ActionDescription) -> Self {
        let options = OfferOptions::default();
        Self {
            description,
            options,
        }
    }
}

/// The error of [`Agent::offer`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OfferError {
    /// The description cannot be used.
    #[error(transparent)]
    Refused(#[from] OfferRefused),
    /// The handler needs a parameter that the description does not have.
    #[error("the handler needs a parameter {0:?}, which the action does not describe")]
    Undescribed(String),
    /// The handler takes neither a struct with named fields, nor a map, nor `()`.
    #[error("the goal of the handler is not a struct with named fields, a map, or `()`")]
    NotNamed,
    /// The agent cannot serve the conversations.
    #[error(transparent)]
    Dialogue(#[from] DialogueError),
}

/// An offered action. Dropping it withdraws the action and cancels its goals.
#[must_use = "dropping the offer withdraws the action"]
pub struct Offer {
    table: ActionTable,
    name: String,
}

impl Offer {
    /// Returns the name of the action.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }
}

impl fmt::Debug for Offer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Offer")
            .field("name", &self.name)
            .finish_non_exhaustive()
    }
}

impl Drop for Offer {
    fn drop(&mut self) {
        self.table.withdraw(&self.name);
    }
}

impl Agent {
    /// Offers an action. The handler runs each admitted goal in a task of its own on the tokio
    /// runtime of the domain, and returns the result. `G` is a struct whose fields are the parameters, a map, or `()`;
    /// a goal that is not a `G` is refused and does not reach the handler. See
    /// [`actions`](crate::actions).
    ///
    /// Call it before [`serve`](Self::serve) of `fipa-request`, `fipa-query` or `fipa-subscribe`: of two
    /// servers, the earlier gets a message that fits both.
    ///
    /// # Errors
    /// If the description cannot be used or does not fit `G`.
    pub fn offer<G, R, H, F, E>(&self, action: Action, handler: H) -> Result<Offer, OfferError>
    where
        G: DeserializeOwned + Send + 'static,
        R: Serialize,
        H: Fn(G, Execution) -> F + Send + Sync + 'static,
        F: Future<Output = Result<R, E>> + Send + 'static,
        E: Display,
    {
        let Action {
            description,
            mut options,
        } = action;
        let shape = Type::of::<G>();
        fits(&shape, &description)?;
        let symbol: Arc<str> = match &shape {
            Type::Structure { name, .. } => (&**name).into(),
            _ => "goal".into(),
        };
        let reads = Arc::clone(&symbol);
        options.check = Some(Box::new(move |arguments| {
            read::<G>(&reads, arguments).map(drop).map_err(|error| {
                let found = error.kind().to_string();
                let found = found.chars().take(200).collect();
                Refusal::WrongType(error.slot(), "the type of the robot".to_owned(), found)
            })
        }));
        let handler = Arc::new(handler);
        let run: Handler = Arc::new(move |running, execution| {
            let (handler, symbol) = (Arc::clone(&handler), Arc::clone(&symbol));
            Box::pin(async move {
                let goal = read::<G>(&symbol, &running.arguments);
                let goal = goal.map_err(|error| Failure::Failed(error.to_string()))?;
                outcome(handler(goal, execution).await)
            })
        });
        let name = description.name.clone();
        let table = self.core.actions.clone();
        table.offer(description, options, run)?;
        let offer = Offer { table, name };
        server::start(&self.core)?;
        Ok(offer)
    }
}

/// Checks that the description has each parameter that the handler needs.
fn fits(shape: &Type, description: &ActionDescription) -> Result<(), OfferError> {
    match shape {
        Type::Structure { fields, .. } => {
            let missing = fields.iter().find(|field| {
                let mut described = description.parameters.iter();
                !field.optional && !described.any(|it| it.name == field.name)
            });
            missing.map_or(Ok(()), |field| {
                Err(OfferError::Undescribed(field.name.clone()))
            })
        }
        Type::Any | Type::Nothing => Ok(()),
        _ => Err(OfferError::NotNamed),
    }
}

/// Reads arguments as a value of the handler's type, whose function symbol is `symbol`.
fn read<G: DeserializeOwned>(
    symbol: &str,
    arguments: &[Parameter<'static>],
) -> Result<G, fipa_content::DeserializeError> {
    if arguments.is_empty()
        && let Ok(nothing) = Term::Sequence(Vec::new()).read()
    {
        return Ok(nothing);
    }
    let arguments = match arguments.is_empty() {
        true => Arguments::Terms(Vec::new()),
        false => Arguments::Parameters(arguments.to_vec()),
    };
    Term::Functional(FunctionalTerm {
        symbol: Cow::Owned(symbol.to_owned()),
        arguments,
    })
    .read()
}

/// Returns the outcome of a handler. The result `()` is none.
fn outcome<R: Serialize, E: Display>(handled: Result<R, E>) -> Outcome {
    let value = handled.map_err(|error| Failure::Failed(error.to_string()))?;
    match Term::from_value(&value) {
        Ok(Term::Sequence(elements)) if elements.is_empty() => Ok(None),
        Ok(value) => Ok(Some(value)),
        Err(error) => Err(Failure::Failed(format!(
            "the result has no notation: {error}"
        ))),
    }
}
