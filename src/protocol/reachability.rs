//! Reports of a conversation about partners whose hosts are silent.

use std::time::Instant;

use tokio::sync::watch;

/// An agent whose host gives no sign of life.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Unreachable {
    /// The name of the agent.
    pub agent: String,
    /// The time of the last sign of life.
    pub since: Instant,
}

/// Reports which partners of a conversation are unreachable, while a call of the conversation waits.
///
/// ```no_run
/// # async fn example(agent: fipa::Agent, lift: fipa::MessageBuilder)
/// #     -> Result<(), Box<dyn std::error::Error>> {
/// use std::time::Duration;
///
/// let mut request = agent.request(lift, Duration::from_secs(60)).await?;
/// let mut reachability = request.reachability();
/// tokio::spawn(async move {
///     while reachability.changed().await {
///         for silent in reachability.unreachable() {
///             println!("{} is silent for {:?}", silent.agent, silent.since.elapsed());
///         }
///     }
/// });
/// println!("{}", request.result().await?);
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone)]
pub struct Reachability(watch::Receiver<Vec<Unreachable>>);

impl Reachability {
    /// Returns the agents that are unreachable now.
    #[must_use]
    pub fn unreachable(&self) -> Vec<Unreachable> {
        self.0.borrow().clone()
    }

    /// Waits for the next change. Returns `false` when the conversation has ended.
    pub async fn changed(&mut self) -> bool {
        self.0.changed().await.is_ok()
    }
}

/// The sending end of [`Reachability`].
#[derive(Debug)]
pub(super) struct ReachabilitySender(watch::Sender<Vec<Unreachable>>);

impl Default for ReachabilitySender {
    fn default() -> Self {
        Self(watch::Sender::new(Vec::new()))
    }
}

impl ReachabilitySender {
    pub(super) fn subscribe(&self) -> Reachability {
        Reachability(self.0.subscribe())
    }

    /// Sets the agents that are unreachable now.
    pub(super) fn set<'n>(&self, now: impl Iterator<Item = (&'n str, Instant)>) {
        let now: Vec<Unreachable> = now
            .map(|(agent, since)| Unreachable {
                agent: agent.to_owned(),
                since,
            })
            .collect();
        self.0.send_if_modified(|before| {
            let changed = *before != now;
            *before = now;
            changed
        });
    }
}
