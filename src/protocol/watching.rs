//! The shell around [`Partners`]: the directory of the host, the gateway and the clock.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, ErrorChain, Message, Performative, escape_name};
use fipa_mts::core::Submission;
use fipa_mts::letter_for;
use fipa_sds::{Change, Directory, Entry, Watch};
use fipa_transport::{Incarnation, log_limit};

use super::partners::{PartnerEvent, Partners};
use crate::agent::demultiplexer::{Admitted, Party};
use crate::agent::incoming::Incoming;
use crate::agent::reader_key::ReaderKey;
use crate::agent::{Agent, AgentCore};
use crate::domain::presence::{self, Asked};

impl Agent {
    /// Watches whether other agents are gone or unreachable. For conversations that the application
    /// leads by itself; the calls of [`protocol`](crate::protocol) do this for their partners.
    ///
    /// Call it before the first message is sent, and [`add`](PartnerWatch::add) the receivers when the
    /// message is delivered. The departure of a receiver in between is reported.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use fipa::protocol::PartnerEvent;
    /// use fipa::{AgentId, Performative};
    ///
    /// let mut partners = agent.watch_partners();
    /// let request = agent.message(Performative::Request).receiver(AgentId::new("arm_1")?);
    /// agent.send(request.build()?).await?;
    /// partners.add("arm_1");
    /// tokio::select! {
    ///     answer = agent.receive() => println!("{}", answer?.message()),
    ///     event = partners.next() => println!("{event:?}"),
    /// }
    /// # Ok(())
    /// # }
    /// ```
    #[must_use]
    pub fn watch_partners(&self) -> PartnerWatch {
        PartnerWatch::new(Arc::clone(&self.core))
    }
}

/// Watches whether agents are gone or unreachable; see [`Agent::watch_partners`].
///
/// While [`next`](Self::next) waits for an agent of another host, the gateway of this host asks the
/// gateway there for signs of life.
pub struct PartnerWatch {
    core: Arc<AgentCore>,
    partners: Partners,
    /// The changes of the directory, until the domain is closed.
    changes: Option<Watch>,
    /// The conversation with the gateway, once it was asked.
    questions: Option<Questions>,
    /// Whether the agent receives no further messages.
    is_closed: bool,
}

/// The conversation with the gateway of this host.
struct Questions {
    id: String,
    key: ReaderKey,
    gateway: Incarnation,
}

impl PartnerWatch {
    pub(crate) fn new(core: Arc<AgentCore>) -> Self {
        let domain = &core.endpoint.domain;
        Self {
            partners: Partners::new(domain.inner.rules.heartbeat()),
            changes: Some(domain.directory().watch()),
            core,
            questions: None,
            is_closed: false,
        }
    }

    /// Adds an agent. Its registration is the present one, or the last one since the watch began.
    pub fn add(&mut self, agent: &str) {
        let entry = self.directory().lookup(agent);
        self.partners.add(Instant::now(), agent, entry);
    }

    /// Removes an agent.
    pub fn remove(&mut self, agent: &str) {
        self.partners.remove(agent);
    }

    /// Waits for the next event, without end if there is none. Dropping the future loses no event.
    ///
    /// Read the messages that have arrived before an event is handled: the agent may have sent them
    /// before it ended.
    pub async fn next(&mut self) -> PartnerEvent {
        loop {
            while let Some(change) = self.changes.as_mut().and_then(Watch::try_next) {
                self.handle_change(&change);
            }
            self.read_answers();
            let now = Instant::now();
            if let Some(event) = self.partners.poll_event(now) {
                if let PartnerEvent::Gone { agent } = &event {
                    log_limit::info!(of: agent, agent = %escape_name(agent), "a partner of a conversation is gone");
                }
                return event;
            }
            let asked = self.partners.poll_question(now);
            if !asked.is_empty() {
                self.ask(&asked);
            }
            let due = self.partners.poll_timeout();
            let until = tokio::time::Instant::from_std(due.unwrap_or(now));
            let key = self.questions.as_ref().map(|questions| &questions.key);
            let (changes, core) = (self.changes.as_mut(), &self.core);
            tokio::select! {
                change = next_change(changes) => match change {
                    Some(change) => self.handle_change(&change),
                    None => self.changes = None,
                },
                answer = next_answer(core, key), if !self.is_closed => match answer {
                    Some(answer) => self.handle_answer(&answer),
                    None => self.is_closed = true,
                },
                () = tokio::time::sleep_until(until), if due.is_some() => {}
            }
        }
    }

    /// Notes a message of an agent, a sign of life.
    pub(super) fn handle_message(&mut self, from: &str) {
        self.partners.handle_message(Instant::now(), from);
    }

    /// Returns an agent that is gone, if no agent is left.
    pub(super) fn all_gone(&self) -> Option<&str> {
        self.partners.all_gone()
    }

    /// Whether an agent of another host may have left the directory for a while only.
    pub(super) fn may_return(&self) -> bool {
        self.partners.may_return()
    }

    /// Returns the agents that are unreachable now, with the time of their last sign of life.
    pub(super) fn unreachable(&self) -> impl Iterator<Item = (&str, Instant)> {
        self.partners.unreachable()
    }

    fn directory(&self) -> &dyn Directory {
        &*self.core.endpoint.domain.inner.service.host
    }

    fn handle_change(&mut self, change: &Change) {
        let now = Instant::now();
        match change {
            Change::Lagged => {
                let directory = self.core.endpoint.domain.directory();
                self.partners
                    .handle_entries(now, |name| directory.known(name));
            }
            change => self.partners.handle_change(now, change),
        }
    }

    /// Asks the gateway of this host about registrations on other hosts. Without a gateway, the question
    /// stays without an answer.
    fn ask(&mut self, asked: &[Asked]) {
        let entries = self.directory().entries();
        let Some(gateway) = entries.iter().find(|entry| entry.is_own_gateway()) else {
            return;
        };
        self.admit(gateway);
        let Some(questions) = &self.questions else {
            return;
        };
        let endpoint = &self.core.endpoint;
        let letter = AgentId::new(&*gateway.name)
            .map_err(|error| error.to_string())
            .and_then(|receiver| {
                let question = Message::builder(Performative::QueryRef)
                    .sender(endpoint.id.clone())
                    .receiver(receiver)
                    .ontology(presence::ONTOLOGY)
                    .language("json")
                    .conversation_id(questions.id.as_str())
                    .content(presence::question(asked))
                    .build();
                let question = question.map_err(|error| error.to_string())?;
                letter_for(&question, SystemTime::now()).map_err(|error| error.to_string())
            });
        match letter {
            // The outcome is not awaited: a lost question has no answer.
            Ok(letter) => drop(endpoint.mts().submit_to(
                Submission {
                    sender: endpoint.incarnation,
                    letter,
                    receivers: Vec::new(),
                    deadline: QUESTION_DEADLINE,
                },
                gateway,
            )),
            Err(error) => {
                log_limit::warn!(%error, "cannot ask the gateway about other agents")
            }
        }
    }

    /// Admits the answers of this gateway.
    fn admit(&mut self, gateway: &Arc<Entry>) {
        let party = Party::new(&gateway.name, Some(gateway));
        let demultiplexer = &self.core.demultiplexer;
        match &mut self.questions {
            Some(questions) if questions.gateway == gateway.incarnation => {}
            Some(questions) => {
                questions.gateway = gateway.incarnation;
                demultiplexer.admit(&questions.key, party);
            }
            None => {
                let id = format!(
                    "{}{}",
                    presence::CONVERSATION,
                    self.core.endpoint.unique_id()
                );
                let key = demultiplexer.begin_internal(&id, Admitted::Parties(vec![party]));
                self.questions = Some(Questions {
                    id,
                    key,
                    gateway: gateway.incarnation,
                });
            }
        }
    }

    /// Handles the answers that have arrived.
    fn read_answers(&mut self) {
        while let Some(questions) = &self.questions
            && let Some(answer) = {
                let AgentCore {
                    endpoint,
                    demultiplexer,
                    ..
                } = &*self.core;
                demultiplexer.now_of(endpoint, &questions.key)
            }
        {
            self.handle_answer(answer.message());
        }
    }

    fn handle_answer(&mut self, message: &Message) {
        let content = message.content().map(|content| &content[..]);
        match message.performative() {
            Performative::Inform => match presence::read_answer(content.unwrap_or_default()) {
                Ok(answer) => self.partners.handle_answer(Instant::now(), &answer),
                Err(error) => {
                    log_limit::info!(error = %ErrorChain(&error), "ignored an answer of the gateway")
                }
            },
            // A gateway that does not support the question, or an undelivered question.
            act => tracing::debug!(performative = %act, "no answer about other agents"),
        }
    }
}

/// Deadline for the delivery of a question to the gateway of this host.
const QUESTION_DEADLINE: Duration = Duration::from_secs(1);

/// Waits for the next change, without end if there is no watch. Returns `None` when the directory is
/// closed.
async fn next_change(watch: Option<&mut Watch>) -> Option<Change> {
    match watch {
        Some(watch) => watch.next().await,
        None => std::future::pending().await,
    }
}

/// Waits for the next answer of the gateway, without end if it was not asked. Returns `None` when the
/// agent receives no further messages.
async fn next_answer(core: &AgentCore, key: Option<&ReaderKey>) -> Option<Message> {
    match key {
        Some(key) => {
            let answer = core.demultiplexer.next_of(&core.endpoint, key).await;
            answer.ok().map(Incoming::into_message)
        }
        None => std::future::pending().await,
    }
}

impl fmt::Debug for PartnerWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PartnerWatch")
            .field("agent", &escape_name(&self.core.endpoint.name))
            .field("partners", &self.partners)
            .finish_non_exhaustive()
    }
}

impl Drop for PartnerWatch {
    fn drop(&mut self) {
        if let Some(questions) = &self.questions {
            self.core.demultiplexer.end(&questions.key);
        }
    }
}
