//! One conversation that a call leads.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{
    AgentId, BuildError, ErrorChain, Message, MessageBuilder, Performative, Time, escape,
    escape_name,
};
use fipa_monitor::{
    Header, Library, Monitor, MonitorPolicy, Unchecked, Verdict, Violation, ViolationKind,
};
use fipa_mts::{DeliveryFailure, letter_for};
use fipa_transport::{FailureReason, Incarnation, Outcome, log_limit};

use super::partners::PartnerEvent;
use super::reachability::{Reachability, ReachabilitySender};
use super::watching::PartnerWatch;
use crate::agent::AgentCore;
use crate::agent::checks::{header_of_outcomes, now};
use crate::agent::delivery::{Deliveries, Delivery, Sent, deliveries};
use crate::agent::demultiplexer::{Admitted, Party};
use crate::agent::incoming::Incoming;
use crate::agent::reader_key::ReaderKey;
use crate::error::{ReceiveError, SendError};

/// Maximum number of `reply-to` names of a participant that are followed.
const MAX_DELEGATES: usize = 16;

/// Maximum number of characters of the reason of another agent in the text of an error.
const MAX_REASON: usize = 500;

/// The error of a conversation.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DialogueError {
    /// The other side refused. Holds its `refuse`.
    #[error("the other side refused: {}", Reason(.0))]
    Refused(Box<Message>),
    /// The other side failed. Holds its `failure`.
    #[error("the other side failed: {}", Reason(.0))]
    Failed(Box<Message>),
    /// The other side did not understand a message. Holds its `not-understood`.
    #[error("the other side did not understand a message: {}", Reason(.0))]
    NotUnderstood(Box<Message>),
    /// The initiator cancelled the conversation. Holds its `cancel`, and on the initiator's side the
    /// confirmation.
    #[error("the initiator cancelled: {0}")]
    Cancelled(Box<Message>),
    /// A message was not delivered.
    #[error("not delivered to {}: {reason}", escape_name(receiver))]
    NotDelivered {
        /// The name of the receiver.
        receiver: String,
        /// The reason.
        reason: FailureReason,
    },
    /// A message transport service reported a message as not delivered. Holds the report.
    #[error("a message transport service reports an undelivered message: {0}")]
    Undelivered(Box<Message>),
    /// No message arrived within the given time.
    #[error("no answer arrived in time")]
    TimedOut,
    /// The other agent is gone: it left, died, or has registered again without having moved. Its own
    /// host reports this.
    #[error(
        "the agent {} is gone: it has left, or its process has ended; start it again, or choose \
         another agent",
        escape_name(agent)
    )]
    Gone {
        /// The name of the agent.
        agent: String,
    },
    /// The host of the other agent gives no sign of life. The agent may still run.
    #[error(
        "the host of the agent {} has been silent for {} s; check the network and the gateway there",
        escape_name(agent),
        since.elapsed().as_secs()
    )]
    Unreachable {
        /// The name of the agent.
        agent: String,
        /// The time of the last sign of life.
        since: Instant,
    },
    /// The receivers of the message stand for several agents, and the call needs one. Holds their
    /// names.
    #[error("the receivers stand for {} agents, and this call needs one: {}", agents.len(), listed(agents))]
    Several {
        /// The names of the agents.
        agents: Vec<String>,
    },
    /// The message does not begin a conversation of a known protocol with this agent.
    #[error("the message does not begin a protocol: {0}")]
    NotOpening(Box<Message>),
    /// The other side sent a message that the protocol allows but the call does not expect.
    #[error("received a message that this call does not expect: {0}")]
    Unexpected(Box<Message>),
    /// The other side violated the protocol.
    #[error("{violation}")]
    Violation {
        /// The violation.
        violation: Box<Violation>,
        /// The message.
        message: Box<Message>,
    },
    /// The message to be sent violates the protocol, and was not sent.
    #[error("not sent: {0}")]
    WouldViolate(Box<Violation>),
    /// The message cannot be checked against a protocol, for example because it names none.
    #[error("cannot follow the protocol: {0}")]
    Unchecked(Unchecked),
    /// The auction has no winner.
    #[error("the auction has no winner: no bid was accepted")]
    NoWinner,
    /// The message cannot be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// The message cannot be sent.
    #[error(transparent)]
    Send(#[from] SendError),
    /// No message can be received.
    #[error(transparent)]
    Receive(ReceiveError),
}

/// The reason in the last message of the other side: its content if that is a text, else the message.
struct Reason<'a>(&'a Message);

impl fmt::Display for Reason<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let content = self.0.content().map_or(&[][..], |content| content);
        // A copy, because another process may change shared memory after the check for UTF-8. One more character than
        // is shown tells whether there are more.
        let start = content.get(..4 * (MAX_REASON + 1)).unwrap_or(content);
        let start = start.to_vec();
        let text = match std::str::from_utf8(&start) {
            Ok(text) => text,
            // The cut is within a character.
            Err(error) if error.error_len().is_none() && start.len() < content.len() => {
                let valid = start.get(..error.valid_up_to()).unwrap_or_default();
                std::str::from_utf8(valid).unwrap_or_default()
            }
            Err(_) => return self.0.fmt(f),
        };
        if text.trim().is_empty() {
            return self.0.fmt(f);
        }
        match text.char_indices().nth(MAX_REASON) {
            None => f.write_str(&escape(text)),
            Some((end, _)) => {
                let shown = text.get(..end).unwrap_or_default();
                write!(f, "{}… ({} bytes)", escape(shown), content.len())
            }
        }
    }
}

/// A received message and its meaning for the conversation.
pub(crate) struct Interpreted {
    pub(super) message: Message,
    pub(super) meaning: Meaning,
}

/// The meaning of a message for its conversation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Meaning {
    pub(super) state: DialogueState,
    /// Whether it is the last message that its sender may send in the conversation.
    pub(super) over: bool,
    /// Whether it answers a message that a later one has replaced, and so has no effect.
    pub(super) void: bool,
    /// Whether it begins the conversation.
    opened: bool,
}

/// The state of a conversation after a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DialogueState {
    /// A state of its own protocol.
    Own,
    /// A state of a subprotocol, which other agents lead within the conversation.
    Delegated,
    NotUnderstood,
    Cancelling,
    Cancelled,
    Undelivered,
}

/// A conversation. After dropping it, its further messages go to [`Agent::receive`](crate::Agent::receive).
pub(crate) struct Dialogue {
    speaker: Speaker,
    key: ReaderKey,
    partners: PartnerWatch,
    reachability: ReachabilitySender,
    /// An agent that is gone, until this is returned.
    gone: Option<String>,
    /// Number of followed `reply-to` names.
    delegates: usize,
}

/// The sending side of a conversation, and its state.
pub(crate) struct Speaker {
    core: Arc<AgentCore>,
    protocol: String,
    id: String,
    monitor: Monitor,
    /// The state of its own protocol, with the agent of the last message.
    state: String,
    /// Whether only an answer to the last message can follow.
    over: bool,
    /// Number of sent messages.
    replies: u32,
    /// The last sent message, without its content.
    last: Option<Header<'static>>,
}

impl Dialogue {
    /// Begins a conversation of this protocol. The first answer must arrive by `due`. The receivers of
    /// the message are single agents.
    pub(super) async fn open(
        core: &Arc<AgentCore>,
        protocol: &str,
        first: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<(Self, Deliveries), DialogueError> {
        let id = format!("{}--{}", core.endpoint.name, Incarnation::random());
        let built = first.clone().build()?;
        let with = built.receivers().iter().map(AgentId::name);
        let mut dialogue = Self::led(core, protocol, id, with);
        if dialogue.follows("fipa-recruiting") {
            // The recruiter chooses the agents that answer.
            dialogue.agent().demultiplexer.admit_all(&dialogue.key);
        }
        let deliveries = dialogue.send(first, due).await?;
        for delivery in deliveries.0.iter().filter(|it| it.outcome.is_success()) {
            // The delivery may have found a later registration of the name.
            dialogue.readmit(&delivery.receiver);
            dialogue.partners.add(&delivery.receiver);
        }
        Ok((dialogue, deliveries))
    }

    /// Takes part in the conversation that a message has begun.
    pub(crate) fn join(core: &Arc<AgentCore>, incoming: &Incoming) -> Result<Self, DialogueError> {
        let speaker = Self::check_first(core, incoming);
        let speaker = speaker.inspect_err(|_| core.demultiplexer.abandon(incoming))?;
        let first = incoming.message();
        let initiator = name_of(first);
        let mut dialogue = Self::of(speaker, std::iter::once(initiator.as_str()), Some(incoming));
        dialogue.partners.add(&initiator);
        dialogue.follow_delegates(first);
        Ok(dialogue)
    }

    /// Checks the message that begins a conversation.
    fn check_first(core: &Arc<AgentCore>, incoming: &Incoming) -> Result<Speaker, DialogueError> {
        let first = incoming.message();
        let id = first.conversation_id();
        let id = id.ok_or(DialogueError::Unchecked(Unchecked::NoConversation))?;
        if name_of(first) == *core.endpoint.name {
            return Err(DialogueError::NotOpening(Box::new(first.clone())));
        }
        let mut speaker = Speaker::new(core, first.protocol().unwrap_or_default(), id.to_owned());
        match speaker.check(&incoming.header()) {
            Ok(meaning) if meaning.opened => {}
            Ok(_) => return Err(DialogueError::NotOpening(Box::new(first.clone()))),
            Err(CheckFailure::Violation(violation))
                if violation.kind == ViolationKind::NotOpened
                    || violation.kind.depends_on_policy() =>
            {
                return Err(DialogueError::NotOpening(Box::new(first.clone())));
            }
            Err(failure) => return Err(failure.on_received(first)),
        }
        Ok(speaker)
    }

    fn led<'n>(
        core: &Arc<AgentCore>,
        protocol: &str,
        id: String,
        with: impl Iterator<Item = &'n str>,
    ) -> Self {
        Self::of(Speaker::new(core, protocol, id), with, None)
    }

    /// `first` is the message of a partner that has begun the conversation.
    fn of<'n>(
        speaker: Speaker,
        with: impl Iterator<Item = &'n str>,
        first: Option<&Incoming>,
    ) -> Self {
        let core = &speaker.core;
        // Before the first message is sent, so that no departure is missed.
        let partners = PartnerWatch::new(Arc::clone(core));
        let directory = core.endpoint.domain.directory();
        // A known entry may be that of an earlier registration. The answers of an agent that leaves after
        // its last message are recognized by its registration.
        directory.refresh();
        let parties = with.map(|name| Party::new(name, directory.lookup(name).as_deref()));
        let parties = Admitted::Parties(parties.collect());
        Self {
            key: match first {
                Some(first) => core.demultiplexer.join(&speaker.id, first, parties),
                None => core.demultiplexer.begin(&speaker.id, parties),
            },
            speaker,
            partners,
            reachability: ReachabilitySender::default(),
            gone: None,
            delegates: 0,
        }
    }

    /// Adds an agent to the conversation.
    pub(super) fn admit(&mut self, name: &str) {
        let core = &self.speaker.core;
        let entry = core.endpoint.domain.directory().lookup(name);
        let party = Party::new(name, entry.as_deref());
        core.demultiplexer.admit(&self.key, party);
    }

    /// Updates the registration of a party, if the directory has it.
    fn readmit(&mut self, name: &str) {
        let core = &self.speaker.core;
        if let Some(entry) = core.endpoint.domain.directory().lookup(name) {
            let party = Party::new(name, Some(&entry));
            core.demultiplexer.admit(&self.key, party);
        }
    }

    /// Watches whether an agent is gone.
    pub(super) fn watch(&mut self, name: &str) {
        self.partners.add(name);
    }

    /// Stops watching an agent, because no message of it is expected.
    pub(super) fn unwatch(&mut self, name: &str) {
        self.partners.remove(name);
    }

    /// Adds the agents that are to get the further messages to the sender (FIPA00061, `reply-to`).
    fn follow_delegates(&mut self, message: &Message) {
        for delegate in message.reply_to() {
            if self.delegates >= MAX_DELEGATES {
                return;
            }
            if delegate.name() != &*self.agent().endpoint.name {
                self.delegates += 1;
                self.admit(delegate.name());
            }
        }
    }

    /// Whether every partner is gone.
    pub(super) fn all_gone(&self) -> bool {
        self.partners.all_gone().is_some()
    }

    /// Whether a partner that the directory does not have may be there again later: while no gateway runs on this host,
    /// no agent of another host is known. The event that it is gone follows otherwise.
    pub(crate) fn may_return(&self) -> bool {
        self.partners.may_return()
    }

    /// Returns a receiver of changes of the reachability of the partners.
    pub(super) fn reachability(&self) -> Reachability {
        self.reachability.subscribe()
    }

    /// Takes over the receivers of the reachability of another conversation.
    pub(super) fn take_reachability(&mut self, other: &mut Self) {
        std::mem::swap(&mut self.reachability, &mut other.reachability);
        self.reachability.set(self.partners.unreachable());
    }

    /// Ends the conversation, except for one last message.
    pub(crate) fn take_speaker(&mut self) -> Speaker {
        let core = Arc::clone(self.agent());
        let ended = Speaker::new(&core, "", String::new());
        std::mem::replace(&mut self.speaker, ended)
    }

    /// Sends a message in this conversation, with `due` as its `reply-by`, and waits for the outcomes.
    pub(super) async fn send(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Deliveries, DialogueError> {
        let sent = self.post(message, due)?;
        Ok(self.outcomes(sent).await)
    }

    /// Waits for the outcomes of the last message.
    pub(super) async fn outcomes(&mut self, sent: Sent) -> Deliveries {
        self.speaker.outcomes(sent).await
    }

    /// Sends a message like [`send`](Self::send), without waiting for the outcomes.
    pub(crate) fn post(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Sent, DialogueError> {
        self.speaker.post(message, due)
    }

    /// Sends a message like [`post`](Self::post), in the protocol that the message names, which runs
    /// within this one.
    pub(super) fn post_within(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Sent, DialogueError> {
        self.speaker.post_within(message, due)
    }

    /// Sends a message like [`post`](Self::post), and waits for the outcome.
    pub(crate) async fn say(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        let sent = self.post(message, due)?;
        only_delivered(&self.outcomes(sent).await)
    }

    /// Sends a message like [`post`](Self::post), with this deadline instead of that of the configuration.
    pub(crate) fn post_until(
        &mut self,
        message: MessageBuilder,
        deadline: Duration,
    ) -> Result<Sent, DialogueError> {
        self.speaker.post_until(message, deadline)
    }

    /// Applies the outcomes of the last message.
    pub(crate) fn settle(&mut self, deliveries: &Deliveries) {
        self.speaker.settle(deliveries);
    }

    /// Answers a message of this conversation, and waits for the outcome.
    pub(crate) async fn answer(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        let answer = self.agent().endpoint.reply(to, act).content(content);
        self.say(answer, due).await
    }

    /// Answers a message without waiting for the outcome, so that an unreachable agent does not delay
    /// answers to others.
    pub(super) fn post_answer(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        due: Option<Instant>,
    ) -> Result<Sent, DialogueError> {
        self.speaker.post_answer(to, act, content, due)
    }

    /// Answers a message of a protocol that runs within this one, in that protocol.
    pub(super) async fn answer_within(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        let answer = self.agent().endpoint.reply(to, act).content(content);
        let sent = self.post_within(answer, due)?;
        only_delivered(&self.outcomes(sent).await)
    }

    /// Waits for the next message until `due`. A message that violates the protocol is an error, and so
    /// are not-understood, cancel and the report of an undelivered message. An agent that is gone is an
    /// error once, and on every call if no agent is left.
    pub(crate) async fn receive(
        &mut self,
        due: Option<Instant>,
    ) -> Result<Interpreted, DialogueError> {
        let incoming = self.next_incoming(due, Silence::Waits).await?;
        self.interpret(incoming)
    }

    /// Waits for the next message without a time limit. An agent that becomes unreachable is an error
    /// once.
    pub(super) async fn receive_or_silence(&mut self) -> Result<Interpreted, DialogueError> {
        let incoming = self.next_incoming(None, Silence::Ends).await?;
        self.interpret(incoming)
    }

    async fn next_incoming(
        &mut self,
        due: Option<Instant>,
        silence: Silence,
    ) -> Result<Incoming, DialogueError> {
        loop {
            let core = &self.speaker.core;
            let all_gone = || self.partners.all_gone().map(str::to_owned);
            if let Some(agent) = self.gone.clone().or_else(all_gone) {
                // A message that has arrived precedes the end of its sender, also one that another task has in hand.
                let left = core.demultiplexer.now_of(&core.endpoint, &self.key);
                if left.is_none() {
                    self.gone = None;
                }
                return left.ok_or(DialogueError::Gone { agent });
            }
            let until = due.unwrap_or_else(Instant::now);
            tokio::select! {
                biased;
                received = core.demultiplexer.next_of(&core.endpoint, &self.key) => {
                    return received.map_err(DialogueError::Receive);
                }
                event = self.partners.next() => {
                    self.reachability.set(self.partners.unreachable());
                    match event {
                        PartnerEvent::Gone { agent } => self.gone = Some(agent),
                        PartnerEvent::Unreachable { agent, since } => {
                            log_limit::warn!(of: &*agent, agent = %escape_name(&agent), "the host of an agent is silent");
                            if silence == Silence::Ends {
                                return Err(DialogueError::Unreachable { agent, since });
                            }
                        }
                        PartnerEvent::Returned { agent } => {
                            log_limit::info!(of: &*agent, agent = %escape_name(&agent), "the host of an agent answers again");
                        }
                    }
                }
                () = tokio::time::sleep_until(until.into()), if due.is_some() => {
                    return Err(self.timed_out(None));
                }
            }
        }
    }

    /// Returns the error for an agent that has not answered in time, or for any of the agents.
    pub(super) fn timed_out(&self, agent: Option<&str>) -> DialogueError {
        let mut unreachable = self.partners.unreachable();
        let silent = unreachable.find(|(name, _)| agent.is_none_or(|agent| agent == *name));
        match silent {
            Some((agent, since)) => DialogueError::Unreachable {
                agent: agent.to_owned(),
                since,
            },
            None => DialogueError::TimedOut,
        }
    }

    fn interpret(&mut self, mut incoming: Incoming) -> Result<Interpreted, DialogueError> {
        if let Some(sender) = incoming.message().sender() {
            self.partners.handle_message(sender.name());
        }
        let checked = match incoming.take_violation() {
            Some(violation) => Err(CheckFailure::Violation(violation)),
            None => self.speaker.check(&incoming.header()),
        };
        let is_report = incoming.undelivered_to.is_some();
        let message = incoming.into_message();
        let meaning = match checked {
            // Of a message to a party that the monitor does not have any more.
            Err(CheckFailure::Unchecked(_)) if is_report => {
                return Err(DialogueError::Undelivered(Box::new(message)));
            }
            checked => checked.map_err(|failure| failure.on_received(&message))?,
        };
        self.follow_delegates(&message);
        match meaning.state {
            DialogueState::NotUnderstood => Err(DialogueError::NotUnderstood(Box::new(message))),
            DialogueState::Cancelling => Err(DialogueError::Cancelled(Box::new(message))),
            DialogueState::Undelivered => Err(DialogueError::Undelivered(Box::new(message))),
            _ => Ok(Interpreted { message, meaning }),
        }
    }

    /// Cancels the conversation with these agents (FIPA's cancel meta-protocol), and waits until all
    /// have answered. The error is that of the first agent that did not cancel.
    pub(super) async fn cancel(
        &mut self,
        mut with: Vec<AgentId>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        if with.is_empty() {
            return Ok(());
        }
        let cancel = self.agent().message(Performative::Cancel);
        let sent = self.send(cancel.receivers(with.clone()), due).await?;
        let mut result = only_delivered(&sent);
        with.retain(|agent| !unreached(&sent).any(|name| name == agent.name()));
        while !with.is_empty() {
            let (from, answer) = match self.receive(due).await {
                Ok(Interpreted { message, meaning }) => {
                    let from = name_of(&message);
                    match meaning.state {
                        DialogueState::Cancelled => (from, Ok(())),
                        _ => (from, Err(DialogueError::Failed(Box::new(message)))),
                    }
                }
                Err(DialogueError::NotUnderstood(message)) => {
                    let from = name_of(&message);
                    (from, Err(DialogueError::NotUnderstood(message)))
                }
                Err(DialogueError::Gone { agent }) => {
                    let gone = DialogueError::Gone {
                        agent: agent.clone(),
                    };
                    (agent, Err(gone))
                }
                // A cancel that crossed this one, or an outcome that is known already.
                Err(DialogueError::Cancelled(_) | DialogueError::Undelivered(_)) => continue,
                Err(other) => return Err(other),
            };
            if let Some(at) = with.iter().position(|agent| agent.name() == from) {
                with.swap_remove(at);
                result = result.and(answer);
            }
        }
        result
    }

    pub(super) fn id(&self) -> &str {
        &self.speaker.id
    }

    /// Returns the agent whose side of the conversation this is.
    pub(crate) fn agent(&self) -> &Arc<AgentCore> {
        &self.speaker.core
    }

    pub(super) fn state(&self) -> &str {
        &self.speaker.state
    }

    /// Whether only an answer to the last message can follow.
    pub(super) fn is_over(&self) -> bool {
        self.speaker.over
    }

    /// Whether the conversation follows the protocol of this name, including its aliases.
    pub(super) fn follows(&self, protocol: &str) -> bool {
        let machine = self.speaker.monitor.library().find(&self.speaker.protocol);
        machine.is_some_and(|machine| machine.is_called(protocol))
    }
}

/// The effect of an agent that becomes unreachable on a call that waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Silence {
    Waits,
    Ends,
}

impl Speaker {
    fn new(core: &Arc<AgentCore>, protocol: &str, id: String) -> Self {
        let library = Arc::clone(core.endpoint.domain.inner.rules.library());
        // The conversation begins here, so that no message continues an earlier one.
        let mut policy = MonitorPolicy::default();
        policy.unsolicited = true;
        Self {
            monitor: Monitor::agent(library, &core.endpoint.name)
                .with_policy(policy)
                .with_one_conversation(),
            core: Arc::clone(core),
            protocol: protocol.to_owned(),
            id,
            state: String::new(),
            over: false,
            replies: 0,
            last: None,
        }
    }

    /// Waits for the outcomes of the last message. If it was not delivered, it may be sent again.
    pub(super) async fn outcomes(&mut self, sent: Sent) -> Deliveries {
        let deliveries = deliveries(sent).await;
        self.settle(&deliveries);
        deliveries
    }

    fn settle(&mut self, deliveries: &Deliveries) {
        if let Some(last) = &self.last {
            for receiver in unreached(deliveries) {
                self.monitor.undelivered(last, receiver, now());
            }
        }
    }

    /// Sends a message in the protocol of the conversation, without waiting for the outcomes.
    fn post(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Sent, DialogueError> {
        let message = message.protocol(self.protocol.as_str());
        self.post_within(message, due)
    }

    fn post_within(
        &mut self,
        mut message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Sent, DialogueError> {
        let mut deadline = self.core.endpoint.domain.inner.deadline();
        if let Some(due) = due {
            let left = due.saturating_duration_since(Instant::now());
            deadline = deadline.min(left);
            let by = SystemTime::now().checked_add(left);
            if let Some(by) = by.and_then(|by| Time::from_system_time(by).ok()) {
                message = message.reply_by(by);
            }
        }
        self.post_by(message, deadline)
    }

    fn post_until(
        &mut self,
        message: MessageBuilder,
        deadline: Duration,
    ) -> Result<Sent, DialogueError> {
        let message = message.protocol(self.protocol.as_str());
        self.post_by(message, deadline)
    }

    fn post_by(
        &mut self,
        message: MessageBuilder,
        deadline: Duration,
    ) -> Result<Sent, DialogueError> {
        let message = message
            .conversation_id(self.id.as_str())
            .reply_with(format!("{}--{}", self.id, self.replies + 1));
        let message = message.build()?;
        self.check(&Header::from(&message))
            .map_err(CheckFailure::on_sent)?;
        self.replies += 1;
        self.last = header_of_outcomes(&message);
        let letter = letter_for(&message, SystemTime::now());
        Ok(self.core.endpoint.send(&message, letter, deadline)?)
    }

    /// Answers a message without waiting for the outcome.
    pub(super) fn post_answer(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        due: Option<Instant>,
    ) -> Result<Sent, DialogueError> {
        self.post(self.core.endpoint.reply(to, act).content(content), due)
    }

    /// Ends the conversation for this participant, unless it is over: with `failure`, or with
    /// `not-understood` if no message was sent or the protocol does not allow `failure`.
    pub(crate) fn abandon(&mut self, last: &Message, reason: &str) {
        if self.over || !self.core.endpoint.domain.inner.owner.is_this() {
            return;
        }
        let acts = match self.replies {
            0 => [Performative::NotUnderstood, Performative::Failure],
            _ => [Performative::Failure, Performative::NotUnderstood],
        };
        for act in acts {
            match self.post_answer(last, act, reason.to_owned(), None) {
                // The letter is sent although its outcome is not awaited.
                Ok(sending) => return drop(sending),
                Err(DialogueError::WouldViolate(_)) => {}
                Err(error) => {
                    let id = escape(&self.id);
                    return tracing::debug!(error = %ErrorChain(&error), conversation = %id, "cannot end a conversation");
                }
            }
        }
    }

    /// Checks a message that was received or is about to be sent.
    fn check(&mut self, message: &Header<'_>) -> Result<Meaning, CheckFailure> {
        let own = Meaning {
            state: DialogueState::Own,
            over: false,
            void: false,
            opened: false,
        };
        match self.monitor.check(message, now()) {
            Verdict::Accepted(accepted) => {
                if message
                    .protocol_name()
                    .is_none_or(|name| name == self.protocol)
                {
                    accepted.state.clone_into(&mut self.state);
                    self.over = accepted.over;
                }
                Ok(Meaning {
                    state: match accepted.state {
                        _ if accepted.elsewhere => DialogueState::Delegated,
                        _ if accepted.own => DialogueState::Own,
                        "not-understood" => DialogueState::NotUnderstood,
                        "cancelling" => DialogueState::Cancelling,
                        "cancelled" => DialogueState::Cancelled,
                        "undelivered" => DialogueState::Undelivered,
                        _ => DialogueState::Own,
                    },
                    over: accepted.over,
                    void: accepted.void,
                    opened: accepted.opened && accepted.own && !accepted.elsewhere,
                })
            }
            Verdict::Violation(violation) => Err(CheckFailure::Violation(violation)),
            Verdict::Unchecked(Unchecked::BegunElsewhere) => Ok(Meaning {
                state: DialogueState::Delegated,
                ..own
            }),
            Verdict::Unchecked(why) => Err(CheckFailure::Unchecked(why)),
            _ => Ok(own),
        }
    }
}

impl fmt::Debug for Dialogue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Dialogue")
            .field("protocol", &self.speaker.protocol)
            .field("id", &self.speaker.id)
            .field("state", &self.speaker.state)
            .finish_non_exhaustive()
    }
}

impl Drop for Dialogue {
    fn drop(&mut self) {
        self.agent().demultiplexer.end(&self.key);
    }
}

/// Whether a message begins a conversation of a known protocol with the agent of this name.
pub(super) fn opens(library: &Arc<Library>, agent: &str, message: &Message) -> bool {
    let mut monitor = Monitor::agent(Arc::clone(library), agent);
    let verdict = monitor.check(&Header::from(message), now());
    name_of(message) != agent
        && matches!(verdict, Verdict::Accepted(accepted) if accepted.opened && accepted.own)
}

/// The failure of the check of a message.
enum CheckFailure {
    Violation(Box<Violation>),
    Unchecked(Unchecked),
}

impl CheckFailure {
    fn on_sent(self) -> DialogueError {
        match self {
            Self::Violation(violation) => DialogueError::WouldViolate(violation),
            Self::Unchecked(why) => DialogueError::Unchecked(why),
        }
    }

    fn on_received(self, message: &Message) -> DialogueError {
        match self {
            Self::Violation(violation) => DialogueError::Violation {
                violation,
                message: Box::new(message.clone()),
            },
            Self::Unchecked(why) => DialogueError::Unchecked(why),
        }
    }
}

/// Waits for the outcomes of these messages, at most until `due`. The outcomes are ignored: an agent
/// that has ended needs no rejection.
pub(crate) async fn settle(sent: impl IntoIterator<Item = Sent>, due: Option<Instant>) {
    for sending in sent {
        let settled = deliveries(sending);
        match due {
            None => drop(settled.await),
            Some(due) => {
                if tokio::time::timeout_at(due.into(), settled).await.is_err() {
                    return;
                }
            }
        }
    }
}

/// Returns an error unless the message was delivered to all receivers.
pub(super) fn only_delivered(deliveries: &Deliveries) -> Result<(), DialogueError> {
    for delivery in &deliveries.0 {
        if let Outcome::Failed { reason, .. } = &delivery.outcome {
            return Err(DialogueError::NotDelivered {
                receiver: delivery.receiver.to_string(),
                reason: *reason,
            });
        }
    }
    Ok(())
}

/// Returns the names of the receivers to which the message was not delivered.
pub(super) fn unreached(deliveries: &Deliveries) -> impl Iterator<Item = &str> {
    let failed = |delivery: &&Delivery| !delivery.outcome.is_success();
    let failed = deliveries.0.iter().filter(failed);
    failed.map(|delivery| &*delivery.receiver)
}

/// Returns the name of the agent that a report says did not get its letter.
pub(super) fn lost_by(report: &Message) -> String {
    let lost = DeliveryFailure::read(report).and_then(|failure| failure.receiver);
    lost.unwrap_or_else(|| name_of(report))
}

/// Returns the name of the sender.
pub(crate) fn name_of(message: &Message) -> String {
    let sender = message.sender();
    sender.map_or_else(String::new, |sender| sender.name().to_owned())
}

/// Returns the time after this span from now, or `None` if it cannot be represented.
pub(super) fn after(span: Duration) -> Option<Instant> {
    Instant::now().checked_add(span)
}

/// Lists the first of these names.
fn listed(names: &[String]) -> String {
    const SHOWN: usize = 8;
    let more = if names.len() > SHOWN { ", …" } else { "" };
    let shown: Vec<_> = names
        .iter()
        .take(SHOWN)
        .map(|name| escape_name(name))
        .collect();
    format!("{}{more}", shown.join(", "))
}

#[cfg(test)]
mod tests {
    use fipa_acl::Message;

    use super::*;

    fn refusal(content: &[u8]) -> String {
        let refuse = Message::builder(Performative::Refuse);
        let refuse = refuse.content(content.to_vec()).build().unwrap();
        DialogueError::Refused(Box::new(refuse)).to_string()
    }

    #[test]
    fn the_text_of_an_error_is_the_reason_of_the_other_side() {
        let text = |reason: &str| format!("the other side refused: {reason}");
        assert_eq!(refusal(b"too heavy"), text("too heavy"));
        assert_eq!(refusal(b"a\x1b[2Jb"), text("a\\u{1b}[2Jb"));
        let long = text(&format!("{}… (3000 bytes)", "谢".repeat(500)));
        assert_eq!(refusal("谢".repeat(1_000).as_bytes()), long);
        assert_eq!(
            refusal("🤖".repeat(500).as_bytes()),
            text(&"🤖".repeat(500))
        );
        for no_text in [&b""[..], b" \n", b"\xff\xfe"] {
            let shown = refusal(no_text);
            assert!(shown.starts_with(&text("(refuse")), "{shown}");
        }
    }
}
