//! An agent that uses locks, and beside it an agent whose application sends the same letters itself.
//!
//! The two agents are separate registrations of one process, so neither receives letters of the other.
//! The letters by hand have the performatives and about the contents of those of locks, in the same
//! order, and as many of them are under way at the same time. They have a protocol of their own,
//! because the letters of locks never reach an application.

use std::time::Duration;

use fipa::locks::{Algorithm, Lock, LockOptions, OwnOptions, Owned};
use fipa::{AgentId, Config, Domain, Incoming, Performative};
use serde::{Deserialize, Serialize};
use tokio::io::{BufReader, Lines, Stdin};
use tokio::task::JoinSet;

use super::LockAgents;
use super::agent::{Running, orders, runtime};
use super::orders::{By, Event, LockStep, Peer, Sent, execute_orders, now_ns};
use crate::error::chain_text;

/// Protocol of the letters by hand.
pub(crate) const BY_HAND: &str = "by-hand";

/// Time for which an agent holds a resource in turn with another. The request of the other agent waits
/// at the owner before it ends.
const HELD: Duration = Duration::from_millis(4);

/// Time from a release to the next request of the same agent, so that its letters do not meet those of
/// the hand-over.
const PAUSE: Duration = Duration::from_millis(1);

/// The first number of a conversation, as long as those of locks.
const FIRST_CONVERSATION: u64 = 1_700_000_000_000;

/// An algorithm, with the place of its token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Variant {
    /// The owner's queue, the default.
    OwnerQueue,
    /// The extended Ricart-Agrawala.
    RicartAgrawala,
    /// The extended Suzuki-Kasami. Its token is at the owner when no agent holds the resource.
    TokenAway,
    /// The basic Suzuki-Kasami. Its token stays with the last holder, which requests again.
    TokenHere,
}

impl Variant {
    pub(crate) const ALL: [Self; 4] = [
        Self::OwnerQueue,
        Self::RicartAgrawala,
        Self::TokenAway,
        Self::TokenHere,
    ];

    pub(crate) fn algorithm(self) -> Algorithm {
        match self {
            Self::OwnerQueue => Algorithm::OwnerQueue,
            Self::RicartAgrawala => Algorithm::RicartAgrawalaExtended,
            Self::TokenAway => Algorithm::SuzukiKasamiExtended,
            Self::TokenHere => Algorithm::SuzukiKasami,
        }
    }

    /// Necessary letters for one acquisition and release without contention, of `agents` agents.
    pub(crate) fn letters(self, agents: usize) -> usize {
        match self {
            Self::RicartAgrawala => 2 * (agents - 1) + 3,
            Self::TokenAway => agents + 3,
            Self::OwnerQueue | Self::TokenHere => 3,
        }
    }

    /// Letters of a hand-over that wait for each other.
    pub(crate) fn letters_in_sequence(self) -> usize {
        match self {
            // The release and the grant.
            Self::OwnerQueue => 2,
            // The report or the token to the owner, its permission, the waiter's report, and the grant.
            Self::RicartAgrawala | Self::TokenAway | Self::TokenHere => 4,
        }
    }

    /// Letters that let an agent enter, when `others` were asked.
    fn permissions(self, others: usize) -> usize {
        match self {
            Self::RicartAgrawala => others,
            Self::TokenAway => others.min(1),
            Self::OwnerQueue | Self::TokenHere => 0,
        }
    }
}

pub(super) fn play(config: &Config, agents: LockAgents) -> Result<(), String> {
    let runtime = runtime()?;
    let domain = runtime.block_on(Domain::open(config)).map_err(chain_text)?;
    let address = agents.locks(agents.index);
    let register = |name: String| {
        let registered = runtime.block_on(domain.register(&name));
        registered.map_err(chain_text)
    };
    let agent = register(address.clone())?;
    let by_hand = register(agents.by_hand(agents.index))?;
    let options = LockOptions {
        algorithm: agents.variant.algorithm(),
        ..LockOptions::default()
    };
    agent.use_locks(options).map_err(chain_text)?;
    let ids = |index| AgentId::new(agents.by_hand(index)).map_err(chain_text);
    let ids = (0..agents.count).map(ids).collect::<Result<_, _>>()?;
    let locking = Locking {
        agent,
        by_hand: ByHand {
            agent: by_hand,
            ids,
            variant: agents.variant,
            index: agents.index,
            conversation: FIRST_CONVERSATION,
        },
        agents,
        owned: Vec::new(),
        held: Vec::new(),
        orders: runtime.block_on(async { orders() }),
    };
    let mut running = Running {
        agent: Some(locking),
        runtime,
    };
    execute_orders(&mut running, address);
    let Running { agent, runtime } = running;
    {
        // Locks and ownership end in tasks of the runtime.
        let _context = runtime.enter();
        drop(agent);
    }
    runtime.block_on(domain.close());
    runtime.shutdown_background();
    Ok(())
}

/// The agents of this process.
struct Locking {
    agents: LockAgents,
    agent: fipa::Agent,
    by_hand: ByHand,
    owned: Vec<Owned>,
    held: Vec<Lock>,
    orders: Lines<BufReader<Stdin>>,
}

impl Peer for Running<Locking> {
    /// The application of the agent by hand answers meanwhile.
    fn next_order(&mut self) -> Option<String> {
        self.run(|mut locking| async move {
            let line = locking.next_order().await;
            (locking, line)
        })
        .ok()?
    }

    fn lock(&mut self, step: LockStep) -> Result<Event, String> {
        self.run(|mut locking| async move {
            let done = locking.execute(step).await;
            (locking, done)
        })?
    }
}

impl Locking {
    async fn next_order(&mut self) -> Option<String> {
        loop {
            tokio::select! {
                received = self.by_hand.agent.receive() => self.by_hand.answer(&received.ok()?).ok()?,
                line = self.orders.next_line() => return line.ok()?,
            }
        }
    }

    async fn execute(&mut self, step: LockStep) -> Result<Event, String> {
        match step {
            LockStep::Find => {
                self.find().await?;
                Ok(Event::Done)
            }
            LockStep::Own { resources } => {
                self.own(resources).await?;
                Ok(Event::Done)
            }
            LockStep::Hold { resources } => {
                self.hold(resources).await?;
                Ok(Event::Done)
            }
            LockStep::Cycle {
                by,
                resource,
                count,
            } => {
                let Sent { began, ended } = match by {
                    By::Locks => self.cycle(&resource, count).await?,
                    _ => self.by_hand.cycle(&resource, count).await?,
                };
                Ok(Event::Sent {
                    began,
                    ended,
                    cpu_ns: 0,
                })
            }
            LockStep::TakeTurns {
                by: By::Locks,
                resource,
                count,
                ..
            } => self.take_turns(&resource, count).await,
            LockStep::TakeTurns {
                by,
                resource,
                other,
                begins,
                count,
            } => {
                let with = Partner {
                    by,
                    resource,
                    other,
                    begins,
                };
                self.by_hand.take_turns(&with, count).await
            }
        }
    }

    async fn find(&self) -> Result<(), String> {
        let directory = self.agent.domain().directory();
        let mut changes = directory.watch();
        let of = |index| [self.agents.locks(index), self.agents.by_hand(index)];
        for name in (0..self.agents.count).flat_map(of) {
            while directory.lookup(&name).is_none() {
                changes.next().await.ok_or("the directory was closed")?;
            }
        }
        Ok(())
    }

    async fn own(&mut self, resources: Vec<String>) -> Result<(), String> {
        let mut owning = JoinSet::new();
        for resource in resources {
            let agent = self.agent.clone();
            owning.spawn(async move {
                let options = OwnOptions {
                    forget: true,
                    ..OwnOptions::default()
                };
                agent.own(&resource, options).await
            });
        }
        while let Some(owned) = owning.join_next().await {
            let owned = owned.map_err(chain_text)?;
            self.owned.push(owned.map_err(chain_text)?);
        }
        Ok(())
    }

    async fn hold(&mut self, resources: Vec<String>) -> Result<(), String> {
        for resource in resources {
            let lock = self.agent.lock(&resource).await.map_err(chain_text)?;
            self.held.push(lock);
        }
        Ok(())
    }

    async fn cycle(&self, resource: &str, count: usize) -> Result<Sent, String> {
        let mut sent = Sent::default();
        for _ in 0..count {
            sent.began.push(now_ns());
            let lock = self.agent.lock(resource).await.map_err(chain_text)?;
            lock.release();
            sent.ended.push(now_ns());
        }
        Ok(sent)
    }

    async fn take_turns(&self, resource: &str, count: usize) -> Result<Event, String> {
        let (mut acquired, mut released) = (Vec::new(), Vec::new());
        for _ in 0..count {
            let lock = self.agent.lock(resource).await.map_err(chain_text)?;
            acquired.push(now_ns());
            tokio::time::sleep(HELD).await;
            released.push(now_ns());
            lock.release();
            tokio::time::sleep(PAUSE).await;
        }
        Ok(Event::TookTurns { acquired, released })
    }
}

/// The agent that holds a resource in turn with this one, by hand.
struct Partner {
    by: By,
    resource: String,
    other: usize,
    begins: bool,
}

/// The agent whose application sends letters itself.
struct ByHand {
    agent: fipa::Agent,
    /// The agents of all processes.
    ids: Vec<AgentId>,
    variant: Variant,
    index: usize,
    /// Number of the next conversation.
    conversation: u64,
}

impl ByHand {
    /// Acquires and releases a resource.
    async fn cycle(&mut self, resource: &str, count: usize) -> Result<Sent, String> {
        let mut sent = Sent::default();
        for _ in 0..count {
            sent.began.push(now_ns());
            let conversation = self.next_conversation();
            self.enter(&conversation, resource).await?;
            self.get_grant(&conversation, resource).await?;
            self.release(&conversation, resource.to_owned())?;
            sent.ended.push(now_ns());
        }
        Ok(sent)
    }

    fn next_conversation(&mut self) -> String {
        self.conversation += 1;
        format!("{}_{}", self.agent.id().name(), self.conversation)
    }

    /// Asks the other agents, and waits for the letters that permit to enter.
    async fn enter(&self, conversation: &str, resource: &str) -> Result<(), String> {
        if matches!(self.variant, Variant::OwnerQueue | Variant::TokenHere) {
            return Ok(());
        }
        let others = self.ids.iter().enumerate();
        for (_, to) in others.filter(|(index, _)| *index != self.index) {
            let content = format!("1\n{resource}");
            self.post(to, Performative::Request, conversation, content)?;
        }
        self.permissions(self.ids.len() - 1).await
    }

    async fn permissions(&self, others: usize) -> Result<(), String> {
        let performative = match self.variant {
            Variant::RicartAgrawala => Performative::Agree,
            Variant::OwnerQueue | Variant::TokenAway | Variant::TokenHere => {
                Performative::Propagate
            }
        };
        for _ in 0..self.variant.permissions(others) {
            self.expect(&performative).await?;
        }
        Ok(())
    }

    /// Reports to the owner that this agent has entered, and waits for the grant.
    async fn get_grant(&self, conversation: &str, resource: &str) -> Result<(), String> {
        let owner = self.id(LockAgents::OWNER)?;
        let content = resource.to_owned();
        let performative = match self.variant {
            Variant::OwnerQueue => Performative::Request,
            _ => Performative::Confirm,
        };
        self.post(owner, performative, conversation, content)?;
        self.expect(&Performative::Inform).await
    }

    /// Reports to the owner that this agent has left.
    fn release(&self, conversation: &str, content: String) -> Result<(), String> {
        let performative = match self.variant {
            Variant::OwnerQueue | Variant::RicartAgrawala | Variant::TokenHere => {
                Performative::Disconfirm
            }
            Variant::TokenAway => Performative::Propagate,
        };
        let owner = self.id(LockAgents::OWNER)?;
        self.post(owner, performative, conversation, content)
    }

    /// Holds a resource in turn with another agent, whose request all agents have deferred.
    async fn take_turns(&mut self, with: &Partner, count: usize) -> Result<Event, String> {
        let (mut acquired, mut released) = (Vec::new(), Vec::new());
        let mut holds = with.begins;
        for _ in 0..2 * count {
            if holds {
                tokio::time::sleep(HELD).await;
                released.push(now_ns());
                self.pass(with)?;
            } else {
                self.wait(with).await?;
                acquired.push(now_ns());
            }
            holds = !holds;
        }
        Ok(Event::TookTurns { acquired, released })
    }

    /// Releases a resource, so that the other agent gets it.
    fn pass(&mut self, with: &Partner) -> Result<(), String> {
        let (conversation, other) = (self.next_conversation(), self.id(with.other)?);
        let resource = &with.resource;
        if with.by == By::Letter {
            return self.post(other, Performative::Inform, &conversation, resource.clone());
        }
        // The owner sends the permission that it has deferred to the agent in the second line.
        let content = format!("{resource}\n{}", other.name());
        self.release(&conversation, content)?;
        if self.variant == Variant::RicartAgrawala {
            let content = format!("1\n{resource}");
            self.post(other, Performative::Agree, &conversation, content)?;
        }
        Ok(())
    }

    /// Waits until this agent gets the resource.
    async fn wait(&mut self, with: &Partner) -> Result<(), String> {
        if with.by == By::Letter {
            return self.expect(&Performative::Inform).await;
        }
        if self.variant == Variant::OwnerQueue {
            return self.expect(&Performative::Inform).await;
        }
        // From the agent that holds the resource, and from the owner.
        self.permissions(2).await?;
        let conversation = self.next_conversation();
        self.get_grant(&conversation, &with.resource).await
    }

    /// Answers as the locks of a member or an owner do.
    fn answer(&self, incoming: &Incoming) -> Result<(), String> {
        let message = incoming.message();
        let (Some(sender), Some(conversation)) = (message.sender(), message.conversation_id())
        else {
            return Ok(());
        };
        let content = message.content().map(|content| &content[..]);
        let content = String::from_utf8_lossy(content.unwrap_or_default());
        let is_owner = self.index == LockAgents::OWNER;
        let permits = self.variant == Variant::RicartAgrawala || is_owner;
        let permission = match self.variant {
            Variant::RicartAgrawala => Performative::Agree,
            Variant::OwnerQueue | Variant::TokenAway | Variant::TokenHere => {
                Performative::Propagate
            }
        };
        let to = |name: &str| AgentId::new(name).map_err(chain_text);
        match message.performative() {
            Performative::Request if self.variant == Variant::OwnerQueue => {
                self.grant(&to(sender.name())?, conversation, &content)
            }
            Performative::Request if permits => {
                let content = content.into_owned();
                self.post(&to(sender.name())?, permission, conversation, content)
            }
            Performative::Confirm => self.grant(&to(sender.name())?, conversation, &content),
            Performative::Disconfirm | Performative::Propagate => match content.split_once('\n') {
                Some((resource, next)) if self.variant == Variant::OwnerQueue => {
                    self.grant(&to(next)?, conversation, resource)
                }
                Some((resource, next)) => {
                    let content = format!("1\n{resource}");
                    self.post(&to(next)?, permission, conversation, content)
                }
                None => Ok(()),
            },
            _ => Ok(()),
        }
    }

    fn grant(&self, to: &AgentId, conversation: &str, resource: &str) -> Result<(), String> {
        let grant = format!(
            "{resource}\n1.1@{}#{resource}\n15000",
            self.agent.id().name()
        );
        self.post(to, Performative::Inform, conversation, grant)
    }

    fn id(&self, index: usize) -> Result<&AgentId, String> {
        let id = self.ids.get(index);
        id.ok_or_else(|| format!("no agent has the index {index}"))
    }

    /// Sends a letter whose outcome is not awaited, as locks do.
    fn post(
        &self,
        to: &AgentId,
        performative: Performative,
        conversation: &str,
        content: String,
    ) -> Result<(), String> {
        let message = self
            .agent
            .message(performative)
            .receiver(to.clone())
            .protocol(BY_HAND)
            .ontology("fipa-locking")
            .conversation_id(conversation)
            .content(content)
            .build()
            .map_err(chain_text)?;
        drop(self.agent.send(message));
        Ok(())
    }

    async fn expect(&self, performative: &Performative) -> Result<(), String> {
        let incoming = self.agent.receive().await.map_err(chain_text)?;
        let message = incoming.message();
        match message.performative() {
            found if found == performative => Ok(()),
            _ => Err(format!("expected {performative}, received {message}")),
        }
    }
}
