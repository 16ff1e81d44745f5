//! An agent that publishes a topic, and agents that subscribe to it, each in a process of its own.

use std::time::Duration;

use fipa::protocol::Keep;
use fipa::topics::{Publisher, Topic};
use fipa::{AgentId, Config, Performative, protocol::Subscription};
use tokio::io::{BufReader, Lines, Stdin};

use super::agent::{Steps, listed, play};
use super::orders::{Letters, Sent, byte_of, check, now_ns};
use crate::error::chain_text;

/// Name of the agent that publishes.
const PUBLISHER: &str = "publisher";
/// Name of the topic.
const TOPIC: &str = "camera";
/// Timeout of the subscription, which usually takes a few milliseconds.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Publishes the topic. Its address is the name of the agent.
pub(super) fn publish(config: &Config) -> Result<(), String> {
    play(config, PUBLISHER, |agent, orders| {
        Ok(Publishing {
            publisher: agent.publisher(Topic::new(TOPIC)).map_err(chain_text)?,
            _agent: agent,
            orders,
        })
    })
}

/// Subscribes to the topic with the agent of this index.
pub(super) fn subscribe(config: &Config, index: usize) -> Result<(), String> {
    play(config, &format!("subscriber-{index}"), |agent, orders| {
        Ok(Subscribing {
            subscription: None,
            agent,
            orders,
        })
    })
}

struct Publishing {
    publisher: Publisher,
    _agent: fipa::Agent,
    orders: Lines<BufReader<Stdin>>,
}

impl Steps for Publishing {
    fn orders(&mut self) -> &mut Lines<BufReader<Stdin>> {
        &mut self.orders
    }

    async fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let mut sent = Sent::with_room(letters);
        for number in 0..letters.count {
            tokio::time::sleep(letters.pause()).await;
            sent.began.push(now_ns());
            let mut loan = self.publisher.loan(letters.size).map_err(chain_text)?;
            loan.content_mut().fill(byte_of(number));
            let publication = self.publisher.publish_loan(loan).await;
            let results = publication.results().await;
            sent.ended.push(now_ns());
            if let Some(failed) = results.iter().find(|it| !it.result.is_success()) {
                return Err(format!("{}: {:?}", failed.subscriber, failed.result));
            }
        }
        Ok(sent)
    }
}

struct Subscribing {
    subscription: Option<Subscription>,
    agent: fipa::Agent,
    orders: Lines<BufReader<Stdin>>,
}

impl Steps for Subscribing {
    fn orders(&mut self) -> &mut Lines<BufReader<Stdin>> {
        &mut self.orders
    }

    /// Subscribes to the topic of this agent, as soon as the directory has it.
    async fn find(&mut self, to: &str) -> Result<(), String> {
        listed(&self.agent, to).await?;
        let publisher = AgentId::new(to).map_err(chain_text)?;
        let subscribe = self.agent.message(Performative::Subscribe);
        let subscribe = subscribe.receiver(publisher).content(TOPIC);
        let begun = self
            .agent
            .subscribe_keeping(Keep::All, subscribe, TIMEOUT)
            .await;
        self.subscription = Some(begun.map_err(chain_text)?);
        Ok(())
    }

    async fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let subscription = self.subscription.as_mut().ok_or("not subscribed")?;
        let mut at = Vec::with_capacity(letters.count);
        for number in 0..letters.count {
            let notification = subscription.next().await.map_err(chain_text)?;
            at.push(now_ns());
            check(notification.content().ok_or("no content")?, letters, number)?;
        }
        Ok(at)
    }
}
