//! An agent that publishes a topic, and agents that subscribe to it, each in a process of its own.

use std::time::Duration;

use fipa::protocol::Keep;
use fipa::topics::{Publisher, Topic};
use fipa::{AgentId, Config, Domain, Performative, protocol::Subscription};
use tokio::io::{BufReader, Lines, Stdin};

use super::agent::{Running, Steps, orders, runtime};
use super::orders::{Letters, Sent, byte_of, check, execute_orders, now_ns};
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

/// Executes orders with one agent.
fn play<A: Steps>(
    config: &Config,
    name: &str,
    make: impl FnOnce(fipa::Agent, Lines<BufReader<Stdin>>) -> Result<A, String>,
) -> Result<(), String> {
    let runtime = runtime()?;
    let domain = runtime.block_on(Domain::open(config)).map_err(chain_text)?;
    let agent = runtime.block_on(async {
        let agent = domain.register(name).await.map_err(chain_text)?;
        make(agent, orders())
    })?;
    let mut running = Running {
        agent: Some(agent),
        runtime,
    };
    execute_orders(&mut running, name.to_owned());
    let Running { agent, runtime } = running;
    drop(agent);
    runtime.block_on(domain.close());
    // The thread that reads standard input may block.
    runtime.shutdown_background();
    Ok(())
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
        let directory = self.agent.domain().directory();
        let mut changes = directory.watch();
        while directory.lookup(to).is_none() {
            changes.next().await.ok_or("the directory was closed")?;
        }
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
