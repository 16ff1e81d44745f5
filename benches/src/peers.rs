//! Conversations with an agent of a JADE platform, beside those between two JADE platforms.
//!
//! An echo agent of JADE answers requests with the same content. This side asks it through the gateway
//! of the host. An agent of a second JADE platform asks the same echo agent in turn, so other load
//! of the machine affects both alike. `benches/comparison/jade` has the two agents.

use std::collections::HashSet;
use std::time::{Duration, Instant};

use fipa::admin::contact::{self, IntroduceError};
use fipa::{Agent, AgentId, Entry, Incarnation, Message, Performative};
use serde::Serialize;

use crate::error::{BenchError, chain_text};

/// Number of turns of each side.
const TURNS: usize = 10;

/// Maximum time for a reply of the echo agent; a later one counts as lost.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum time for the replies to a turn of the other platform.
const TURN_TIMEOUT: Duration = Duration::from_secs(600);

/// Time after the last conversation in which further replies are counted.
const SURPLUS_TIMEOUT: Duration = Duration::from_secs(1);

/// Conversations with an agent of a JADE platform.
#[derive(Debug)]
#[non_exhaustive]
pub struct Peers {
    /// The echo agent, with its address.
    pub echo: AgentId,
    /// The agent of a second platform that asks the echo agent, with its address.
    pub asker: Option<AgentId>,
    /// Number of conversations of each side.
    pub conversations: usize,
    /// Bytes of content of a request.
    pub size: usize,
}

/// The result of [`Peers::measure`].
///
/// Serialized as a JSON object with the names of the fields.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct PeersReport {
    /// Number of conversations of each side.
    pub conversations: usize,
    /// Bytes of content of a request.
    pub size: usize,
    /// Conversations of an agent behind the gateway of this host.
    pub fipa: Conversations,
    /// Conversations of an agent of the second JADE platform.
    pub jade: Option<Conversations>,
    /// The median of `fipa` divided by that of `jade`.
    pub ratio: Option<f64>,
}

/// Conversations of one side.
#[derive(Debug, Clone, Default, Serialize)]
#[non_exhaustive]
pub struct Conversations {
    /// Requests without a reply.
    pub lost: usize,
    /// Replies beyond one for each request.
    pub doubled: usize,
    /// Median of the round trips in microseconds.
    pub median_us: f64,
    /// Mean of the round trips in microseconds.
    pub mean_us: f64,
    /// Standard deviation of the round trips in microseconds.
    pub deviation_us: f64,
    #[serde(skip)]
    trips: Vec<f64>,
}

impl Peers {
    /// Default number of conversations, that of the paper about the C++ libraries.
    pub const CONVERSATIONS: usize = 10_000;
    /// Default bytes of content.
    pub const SIZE: usize = 100;
    /// Number of steps that [`measure`](Self::measure) reports.
    pub const STEPS: usize = TURNS;

    /// Prepares the conversations of the paper with this echo agent.
    #[must_use]
    pub fn new(echo: AgentId) -> Self {
        Self {
            echo,
            asker: None,
            conversations: Self::CONVERSATIONS,
            size: Self::SIZE,
        }
    }

    /// Runs the conversations of an agent that serves no other purpose. `gateway` is the gateway of its
    /// host. Calls `step` with a description after each turn.
    ///
    /// # Errors
    /// If the gateway does not reach the platforms, or no reply arrives.
    pub async fn measure(
        &self,
        agent: &Agent,
        gateway: &Entry,
        mut step: impl FnMut(&str),
    ) -> Result<PeersReport, BenchError> {
        let mut ours = Side::new(agent);
        let mut theirs = Conversations::default();
        for turn in 0..TURNS {
            let count = self.conversations / TURNS + usize::from(turn < self.conversations % TURNS);
            introduce(agent, gateway, &self.echo).await?;
            for _ in 0..count {
                ours.ask(&self.echo, self.size).await?;
            }
            if let Some(asker) = self.asker.as_ref().filter(|_| count > 0) {
                introduce(agent, gateway, asker).await?;
                ours.order(asker, &self.echo, count, self.size, &mut theirs)
                    .await?;
            }
            step(&format!("turn {} of {TURNS}", turn + 1));
        }
        ours.drain().await?;
        let mut fipa = ours.found;
        fipa.summarize(&self.echo)?;
        let jade = match &self.asker {
            Some(asker) => {
                theirs.summarize(asker)?;
                Some(theirs)
            }
            None => None,
        };
        Ok(PeersReport {
            conversations: self.conversations,
            size: self.size,
            ratio: jade.as_ref().map(|jade| fipa.median_us / jade.median_us),
            fipa,
            jade,
        })
    }
}

async fn introduce(agent: &Agent, gateway: &Entry, id: &AgentId) -> Result<(), BenchError> {
    let introduced = contact::introduce(agent, gateway, id, TIMEOUT).await;
    introduced.map_err(|source: IntroduceError| BenchError::Peer {
        agent: id.name().to_owned(),
        what: chain_text(source),
    })
}

/// The conversations of the agent of this side.
struct Side<'a> {
    agent: &'a Agent,
    /// The beginning of all references.
    run: String,
    next: usize,
    answered: HashSet<String>,
    found: Conversations,
}

impl<'a> Side<'a> {
    fn new(agent: &'a Agent) -> Self {
        Self {
            agent,
            run: Incarnation::random().to_string(),
            next: 0,
            answered: HashSet::new(),
            found: Conversations::default(),
        }
    }

    fn request(&mut self, to: &AgentId, content: String) -> Result<(Message, String), BenchError> {
        self.next += 1;
        // A text that begins with a digit would have to be quoted for JADE.
        let reference = format!("r{}-{}", self.run, self.next);
        let message = self
            .agent
            .message(Performative::Request)
            .receiver(to.clone())
            .conversation_id(format!("c{}-{}", self.run, self.next))
            .reply_with(reference.as_str())
            .content(content)
            .build();
        let message = message.map_err(|error| failed(to, error))?;
        Ok((message, reference))
    }

    /// Has one conversation with the echo agent.
    async fn ask(&mut self, echo: &AgentId, size: usize) -> Result<(), BenchError> {
        let (request, reference) = self.request(echo, "x".repeat(size))?;
        let began = Instant::now();
        let sent = self.agent.send(request);
        let (sent, reply) = tokio::join!(sent, self.reply(echo, &reference, TIMEOUT));
        let deliveries = sent.map_err(|error| failed(echo, error))?;
        match reply? {
            Some((reply, at)) if reply.content().is_some_and(|it| it.len() == size) => {
                let micros = at.duration_since(began).as_secs_f64() * 1e6;
                self.found.trips.push(micros);
            }
            _ => {
                fipa_transport::log_limit::warn!(%deliveries, "a request had no reply");
                self.found.lost += 1;
            }
        }
        Ok(())
    }

    /// Orders conversations of an agent of the other platform with the echo agent.
    async fn order(
        &mut self,
        asker: &AgentId,
        echo: &AgentId,
        count: usize,
        size: usize,
        found: &mut Conversations,
    ) -> Result<(), BenchError> {
        let address = echo.addresses().first().map_or("", |address| address);
        let content = format!("{} {address} {count} {size}", echo.name());
        let (request, reference) = self.request(asker, content)?;
        let sent = self.agent.send(request).await;
        let deliveries = sent.map_err(|error| failed(asker, error))?;
        let broken = |what: String| BenchError::Peer {
            agent: asker.name().to_owned(),
            what,
        };
        if !deliveries.all_succeeded() {
            return Err(broken(deliveries.to_string()));
        }
        let Some((reply, _)) = self.reply(asker, &reference, TURN_TIMEOUT).await? else {
            return Err(broken(format!("no reply within {TURN_TIMEOUT:?}")));
        };
        let content = reply.content().map(|bytes| &bytes[..]).unwrap_or_default();
        let text = String::from_utf8_lossy(content);
        let numbers: Result<Vec<f64>, _> = text.split_whitespace().map(str::parse).collect();
        match numbers.as_deref() {
            Ok([lost, doubled, trips @ ..]) => {
                found.lost += *lost as usize;
                found.doubled += *doubled as usize;
                found.trips.extend_from_slice(trips);
                Ok(())
            }
            _ => Err(broken("its reply has no round trips".to_owned())),
        }
    }

    /// Waits for the reply with this reference. Counts others as doubled.
    async fn reply(
        &mut self,
        from: &AgentId,
        reference: &str,
        timeout: Duration,
    ) -> Result<Option<(Message, Instant)>, BenchError> {
        let until = tokio::time::Instant::now() + timeout;
        loop {
            let received = tokio::time::timeout_at(until, self.agent.receive()).await;
            let Ok(received) = received else {
                return Ok(None);
            };
            let at = Instant::now();
            let message = received
                .map_err(|error| failed(from, error))?
                .into_message();
            let answers = message.in_reply_to().unwrap_or_default();
            if answers == reference {
                self.answered.insert(reference.to_owned());
                let is_failure = *message.performative() == Performative::Failure;
                return Ok((!is_failure).then_some((message, at)));
            }
            if self.answered.contains(answers) {
                self.found.doubled += 1;
            }
        }
    }

    /// Counts the replies that are still arriving.
    async fn drain(&mut self) -> Result<(), BenchError> {
        let this_agent = self.agent.id().clone();
        self.reply(&this_agent, "", SURPLUS_TIMEOUT).await.map(drop)
    }
}

fn failed(agent: &AgentId, error: impl std::error::Error + 'static) -> BenchError {
    BenchError::Peer {
        agent: agent.name().to_owned(),
        what: chain_text(error),
    }
}

impl Conversations {
    /// Calculates the statistics of the round trips.
    fn summarize(&mut self, with: &AgentId) -> Result<(), BenchError> {
        let trips = &mut self.trips;
        if trips.is_empty() {
            return Err(BenchError::Peer {
                agent: with.name().to_owned(),
                what: "no request had a reply".to_owned(),
            });
        }
        trips.sort_by(f64::total_cmp);
        let count = trips.len() as f64;
        let mean = trips.iter().sum::<f64>() / count;
        let variance = trips.iter().map(|it| (it - mean).powi(2)).sum::<f64>() / count;
        self.median_us = trips.get(trips.len() / 2).copied().unwrap_or_default();
        self.mean_us = mean;
        self.deviation_us = variance.sqrt();
        Ok(())
    }

    fn to_text(&self) -> String {
        format!(
            "median {:.0} µs, mean {:.0} ± {:.0} µs, lost {}, doubled {}",
            self.median_us, self.mean_us, self.deviation_us, self.lost, self.doubled
        )
    }
}

impl PeersReport {
    /// Whether each request had one reply.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        let sides = [Some(&self.fipa), self.jade.as_ref()];
        let mut sides = sides.into_iter().flatten();
        sides.all(|side| side.lost == 0 && side.doubled == 0)
    }

    /// Returns the report as text.
    #[must_use]
    pub fn to_text(&self) -> String {
        let mut text = format!(
            "{} conversations of {} bytes with an echo agent of JADE\n  this side: {}\n",
            self.conversations,
            self.size,
            self.fipa.to_text()
        );
        if let Some(jade) = &self.jade {
            text.push_str(&format!("  JADE:      {}\n", jade.to_text()));
        }
        if let Some(ratio) = self.ratio {
            text.push_str(&format!("  ratio of the medians: {ratio:.2}\n"));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a panic fails the test")]

    use super::*;

    #[test]
    fn the_statistics_are_those_of_the_round_trips() {
        let echo = AgentId::new("echo@jade").unwrap();
        let mut found = Conversations {
            trips: vec![5.0, 1.0, 3.0],
            ..Conversations::default()
        };
        found.summarize(&echo).unwrap();
        assert_eq!((found.median_us, found.mean_us), (3.0, 3.0));
        assert!((found.deviation_us - (8.0_f64 / 3.0).sqrt()).abs() < 1e-9);
        let mut none = Conversations::default();
        assert!(none.summarize(&echo).is_err());
    }
}
