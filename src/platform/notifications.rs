//! The notifications of a directory facilitator, which go on after its gateway has been started again.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::pin::Pin;
use std::time::Duration;

use fipa_acl::{AgentId, ErrorChain, escape_name};
use fipa_platform::{AgentDescription, Constraints, Function, found, notified};
use fipa_transport::log_limit;
use tokio::time::Instant;

use super::{PlatformError, Server};
use crate::protocol::{DialogueError, Subscription};

/// Time after which a description that a restarted directory facilitator does not have counts as gone.
/// Before, those of other hosts may still be on their way.
const GRACE: Duration = Duration::from_secs(5);

/// Pause between two attempts to subscribe again, doubling.
const PAUSE: Duration = Duration::from_millis(100);
const MAX_PAUSE: Duration = Duration::from_secs(5);

/// A subscription to a directory facilitator. Dropping it cancels it.
///
/// If the directory facilitator ends, for example with its gateway, the subscription waits for its
/// return and then goes on: the descriptions that have changed meanwhile are notified.
#[must_use = "next() returns the notifications"]
pub struct Notifications {
    server: Server,
    template: AgentDescription,
    subscription: Subscription,
    /// The descriptions that were notified, by the name of their agent.
    known: BTreeMap<String, AgentDescription>,
    /// Agents whose descriptions the restarted directory facilitator has not notified yet.
    unconfirmed: BTreeSet<String>,
    /// The time at which they are searched for.
    check: Option<Instant>,
    /// The work that a dropped call of [`next`](Self::next) leaves to the next one.
    pending: Pending,
}

type Boxed<T> = Pin<Box<dyn Future<Output = T> + Send>>;

enum Pending {
    None,
    Again(Boxed<Result<Subscription, PlatformError>>),
    Check(Boxed<BTreeSet<String>>),
}

impl fmt::Debug for Notifications {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Notifications")
            .field("subscription", &self.subscription)
            .finish_non_exhaustive()
    }
}

impl Notifications {
    pub(super) async fn begin(
        server: Server,
        template: &AgentDescription,
    ) -> Result<Self, PlatformError> {
        Ok(Self {
            subscription: server.subscribe(template).await?,
            server,
            template: template.clone(),
            known: BTreeMap::new(),
            unconfirmed: BTreeSet::new(),
            check: None,
            pending: Pending::None,
        })
    }

    /// Waits for the next notification, without a time limit, and returns the descriptions that have
    /// changed. A description with a name only is that of an agent that has deregistered. Dropping the
    /// future loses no notification.
    ///
    /// # Errors
    /// If the directory facilitator ends the subscription, or refuses to go on after a restart.
    pub async fn next(&mut self) -> Result<Vec<AgentDescription>, PlatformError> {
        loop {
            match &mut self.pending {
                Pending::Again(again) => {
                    let subscribed = again.await;
                    self.pending = Pending::None;
                    self.subscription = subscribed?;
                    self.check = Some(Instant::now() + GRACE);
                    continue;
                }
                Pending::Check(check) => {
                    let gone = check.await;
                    self.pending = Pending::None;
                    if let Some(gone) = self.forget(gone) {
                        return Ok(gone);
                    }
                    continue;
                }
                Pending::None => {}
            }
            let due = self.check.unwrap_or_else(Instant::now);
            let message = tokio::select! {
                biased;
                message = self.subscription.next() => message,
                () = tokio::time::sleep_until(due), if self.check.is_some() => {
                    self.check = None;
                    let (server, template) = (self.server.clone(), self.template.clone());
                    let unconfirmed = std::mem::take(&mut self.unconfirmed);
                    self.pending = Pending::Check(Box::pin(missing(server, template, unconfirmed)));
                    continue;
                }
            };
            match message {
                Ok(message) => {
                    if let Some(changed) = self.learn(notified(&message)?) {
                        return Ok(changed);
                    }
                }
                Err(DialogueError::Gone { .. }) => self.lose(),
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// Subscribes again as soon as there is a directory facilitator.
    fn lose(&mut self) {
        let name = escape_name(self.server.id.name());
        log_limit::info!("{name} has ended; the subscription to it waits for its return");
        self.unconfirmed = self.known.keys().cloned().collect();
        self.check = None;
        let again = subscribe_again(self.server.clone(), self.template.clone());
        self.pending = Pending::Again(Box::pin(again));
    }

    /// Returns what is new in a notification, which may repeat descriptions after a restart.
    fn learn(&mut self, mut changed: Vec<AgentDescription>) -> Option<Vec<AgentDescription>> {
        let is_repeated = !self.unconfirmed.is_empty();
        changed.retain(|description| {
            let Some(name) = description.name.as_ref().map(AgentId::name) else {
                return true;
            };
            let before = match is_gone(description) {
                true => self.known.remove(name),
                false => self.known.insert(name.to_owned(), description.clone()),
            };
            let is_repeated = self.unconfirmed.remove(name);
            !is_repeated || before.as_ref() != Some(description)
        });
        // A notification without descriptions is passed on as before.
        (!changed.is_empty() || !is_repeated).then_some(changed)
    }

    /// Returns the ends of descriptions that are no longer there.
    fn forget(&mut self, gone: BTreeSet<String>) -> Option<Vec<AgentDescription>> {
        let gone = gone.into_iter().filter_map(|name| {
            self.known.remove(&name)?;
            Some(AgentDescription {
                name: Some(AgentId::new(name).ok()?),
                ..AgentDescription::default()
            })
        });
        let gone: Vec<AgentDescription> = gone.collect();
        (!gone.is_empty()).then_some(gone)
    }

    /// Cancels the subscription.
    ///
    /// # Errors
    /// If the directory facilitator does not confirm within `timeout`.
    pub async fn cancel(self, timeout: Duration) -> Result<(), PlatformError> {
        Ok(self.subscription.cancel(timeout).await?)
    }
}

/// Whether a notification of this description reports that the agent has deregistered.
fn is_gone(description: &AgentDescription) -> bool {
    let bare = AgentDescription {
        name: description.name.clone(),
        ..AgentDescription::default()
    };
    *description == bare
}

async fn subscribe_again(
    server: Server,
    template: AgentDescription,
) -> Result<Subscription, PlatformError> {
    // The watch comes first, so that no return is missed.
    let mut changes = server.directory().watch();
    let mut pause = PAUSE;
    loop {
        while server.directory().lookup(server.id.name()).is_none() {
            if changes.next().await.is_none() {
                return Err(DialogueError::Gone {
                    agent: server.id.name().to_owned(),
                }
                .into());
            }
        }
        match server.subscribe(&template).await {
            Err(PlatformError::Dialogue(
                error @ (DialogueError::Gone { .. }
                | DialogueError::NotDelivered { .. }
                | DialogueError::Undelivered(_)
                | DialogueError::TimedOut
                | DialogueError::Unreachable { .. }),
            )) => {
                tracing::debug!(error = %ErrorChain(&error), "cannot subscribe again yet");
                tokio::time::sleep(pause).await;
                pause = (pause * 2).min(MAX_PAUSE);
            }
            result => return result,
        }
    }
}

/// Returns those of the agents that have no description that matches.
async fn missing(
    server: Server,
    template: AgentDescription,
    agents: BTreeSet<String>,
) -> BTreeSet<String> {
    let mut missing = BTreeSet::new();
    for name in agents {
        let Ok(id) = AgentId::new(&*name) else {
            continue;
        };
        let one = AgentDescription {
            name: Some(id),
            ..template.clone()
        };
        let search = Function::search(&one, &Constraints::all());
        let answer = server.request(&search).await;
        // Without an answer the agent counts as there: its end is notified if it is known.
        if answer.is_ok_and(|answer| found(&answer).is_ok_and(|found| found.is_empty())) {
            missing.insert(name);
        }
    }
    missing
}
