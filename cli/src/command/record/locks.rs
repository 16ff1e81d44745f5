//! Finds lost, refused and abandoned locks in the observed letters.
//!
//! An agent that waits in the owner's queue, or for the owner's grant, withdraws its request with a letter. With the
//! algorithms of `distributed_locking`, an agent that waits for other agents withdraws its request without one.

use std::collections::HashMap;
use std::time::{Duration, SystemTime};

use fipa::admin::watch::Passage;
use fipa::locks::Fence;
use fipa::{Message, Performative};
use fipa_acl::{escape, escape_name};
use fipa_locking::codec::{is_lock_protocol, read};
use fipa_locking::{Act, Content, Conversation, MAX_NAME};

use crate::command::watch::json;
use crate::output;

/// Maximum number of resources whose holders are remembered.
const MAX_RESOURCES: usize = 10_000;

/// Maximum number of requests that are remembered.
const MAX_REQUESTS: usize = 10_000;

/// Maximum length of the identifier of a conversation of a request: a name, and a number of 64 bits.
const MAX_CONVERSATION: usize = MAX_NAME + 21;

/// The requests and grants that were observed.
#[derive(Debug, Default)]
pub(super) struct Grants {
    holders: HashMap<String, Grant>,
    /// The last request of each agent for a resource. An agent has one at a time.
    requests: HashMap<(String, String), Request>,
}

#[derive(Debug)]
struct Grant {
    holder: String,
    conversation: String,
    fence: Fence,
    /// Time of the grant, if the request before it was observed.
    since: Option<SystemTime>,
}

#[derive(Debug)]
struct Request {
    conversation: String,
    since: SystemTime,
    state: RequestState,
    /// Whether the agent has left the directory. Its last letters may be observed after that.
    has_left: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RequestState {
    Waiting,
    /// The agent has the token, which is the lock of an owner without fences.
    Token,
    Granted,
    /// Released, withdrawn or refused. A grant that was under way changes nothing.
    Ended,
}

/// An event of a lock.
#[derive(Debug)]
pub(super) struct LockEvent {
    pub(super) event: &'static str,
    pub(super) resource: String,
    /// The agent that has lost the lock or did not get it.
    pub(super) agent: String,
    pub(super) text: String,
    pub(super) abandoned: Option<Abandoned>,
}

/// An abandoned request.
#[derive(Debug)]
pub(super) struct Abandoned {
    pub(super) waited: Duration,
    /// The holder of the lock, if its grant was observed.
    pub(super) holder: Option<String>,
    pub(super) held_since: Option<SystemTime>,
    pub(super) fence: Option<String>,
}

/// A letter about one resource.
struct Lock<'a> {
    at: SystemTime,
    sender: &'a str,
    receiver: &'a str,
    conversation: &'a str,
    resource: &'a str,
}

impl Grants {
    /// Forgets all requests and grants, because letters are missing.
    pub(super) fn forget(&mut self) {
        self.holders.clear();
        self.requests.clear();
    }

    /// Handles an agent that has left the directory.
    pub(super) fn leave(&mut self, agent: &str) {
        let all = self.requests.iter_mut();
        for (_, request) in all.filter(|((of, _), _)| of == agent) {
            request.has_left = true;
        }
    }

    /// Handles a letter. Returns the event that it reports, if there is one.
    pub(super) fn handle(&mut self, passage: &Passage) -> Option<LockEvent> {
        let protocol = passage.message.as_ref().and_then(Message::protocol)?;
        if !is_lock_protocol(protocol) {
            return None;
        }
        let message = json::message(passage)?;
        self.handle_message(passage.at, &passage.receiver, &message)
    }

    fn handle_message(
        &mut self,
        at: SystemTime,
        receiver: &str,
        message: &Message,
    ) -> Option<LockEvent> {
        let mut lock = Lock {
            at,
            sender: message.sender()?.name(),
            receiver,
            conversation: message.conversation_id()?,
            resource: "",
        };
        match read(message).map(|it| it.content) {
            Ok(Content::Lock { resource, act }) => {
                lock.resource = resource.as_str();
                self.act(&lock, act)
            }
            Ok(Content::Probe | Content::Alive) => None,
            // A message of another implementation, or one whose content was not observed.
            Err(_) => self.act_without_content(&lock, message.performative()),
        }
    }

    /// Handles a letter whose resource is known from its conversation only.
    fn act_without_content(
        &mut self,
        lock: &Lock<'_>,
        performative: &Performative,
    ) -> Option<LockEvent> {
        let agent = match performative {
            Performative::Disconfirm | Performative::Propagate => lock.sender,
            Performative::Inform | Performative::Refuse => lock.receiver,
            _ => return None,
        };
        let mut all = self.requests.iter_mut();
        let of_agent = |((of, _), request): &(&(String, String), &mut Request)| {
            of == agent && request.conversation == lock.conversation
        };
        let ((_, resource), request) = all.find(of_agent)?;
        let resource = resource.clone();
        let lock = Lock {
            resource: &resource,
            ..*lock
        };
        match performative {
            Performative::Disconfirm | Performative::Propagate => return self.release(&lock),
            Performative::Refuse => request.state = RequestState::Ended,
            _ if request.state == RequestState::Waiting => {
                request.state = RequestState::Granted;
                self.holders.remove(&resource);
            }
            _ => {}
        }
        None
    }

    fn act(&mut self, lock: &Lock<'_>, act: Act) -> Option<LockEvent> {
        match act {
            Act::Ask { .. } | Act::Request { .. } | Act::RequestToken { .. } => {
                self.request(lock, lock.sender);
            }
            // The request itself may not have been observed.
            Act::Place { .. } if self.request_of(lock.receiver, lock.resource).is_none() => {
                self.request(lock, lock.receiver);
            }
            // An agent that leaves returns the token in the conversation of its request. A token can have the
            // conversation of its sender, too.
            Act::Token(_) => {
                let event = self.release(lock);
                if let Some(request) = self.request_of(lock.receiver, lock.resource)
                    && request.state == RequestState::Waiting
                {
                    request.state = RequestState::Token;
                }
                return event;
            }
            Act::Confirm { asked: Some(_) } => match self.request_of(lock.sender, lock.resource) {
                Some(request) if request.state == RequestState::Token => {
                    request.state = RequestState::Waiting;
                }
                Some(_) => {}
                None => self.request(lock, lock.sender),
            },
            // An owner without fences gives no grants.
            Act::Confirm { asked: None } | Act::Renew { .. } => {
                self.set(lock, lock.sender, RequestState::Granted);
            }
            Act::Granted { fence, .. } => return self.grant(lock, fence),
            Act::Release => return self.release(lock),
            Act::Refused { reason, .. } => {
                self.set(lock, lock.receiver, RequestState::Ended);
                return Some(LockEvent {
                    event: "lock_refused",
                    resource: lock.resource.to_owned(),
                    agent: lock.receiver.to_owned(),
                    text: format!(
                        "{} does not grant {} to {}: {reason}",
                        escape_name(lock.sender),
                        escape(lock.resource),
                        escape_name(lock.receiver)
                    ),
                    abandoned: None,
                });
            }
            _ => {}
        }
        None
    }

    fn request_of(&mut self, agent: &str, resource: &str) -> Option<&mut Request> {
        self.requests
            .get_mut(&(agent.to_owned(), resource.to_owned()))
    }

    /// Remembers the request of an agent, unless it is a repeated one.
    fn request(&mut self, lock: &Lock<'_>, agent: &str) {
        let known = self.request_of(agent, lock.resource);
        if known.is_some_and(|it| it.conversation == lock.conversation)
            || lock.conversation.len() > MAX_CONVERSATION
            || agent.len() > MAX_NAME
        {
            return;
        }
        if self.requests.len() >= MAX_REQUESTS {
            self.requests
                .retain(|_, it| it.state != RequestState::Ended && !it.has_left);
        }
        let key = (agent.to_owned(), lock.resource.to_owned());
        if self.requests.len() < MAX_REQUESTS || self.requests.contains_key(&key) {
            let request = Request {
                conversation: lock.conversation.to_owned(),
                since: lock.at,
                state: RequestState::Waiting,
                has_left: false,
            };
            self.requests.insert(key, request);
        }
    }

    /// Sets the state of the request of this conversation, unless it has ended.
    fn set(&mut self, lock: &Lock<'_>, agent: &str, state: RequestState) {
        if let Some(request) = self.request_of(agent, lock.resource)
            && request.conversation == lock.conversation
            && request.state != RequestState::Ended
        {
            request.state = state;
        }
    }

    /// Handles the end of a request: the release of the lock, or the withdrawal.
    fn release(&mut self, lock: &Lock<'_>) -> Option<LockEvent> {
        let request = self.request_of(lock.sender, lock.resource);
        let request = request.filter(|it| it.conversation == lock.conversation);
        let waiting = request.and_then(|request| {
            let before = std::mem::replace(&mut request.state, RequestState::Ended);
            (before == RequestState::Waiting).then_some(request.since)
        });
        let Some(since) = waiting else {
            let is_of = |grant: &Grant| {
                grant.holder == lock.sender && grant.conversation == lock.conversation
            };
            if self.holders.get(lock.resource).is_some_and(is_of) {
                self.holders.remove(lock.resource);
            }
            return None;
        };
        let waited = lock.at.duration_since(since).unwrap_or_default();
        let grant = self.holders.get(lock.resource);
        let grant = grant.filter(|grant| grant.holder != lock.sender);
        let holder = match grant {
            Some(grant) => {
                let holder = escape_name(&grant.holder);
                let fence = escape(grant.fence.to_string().as_str()).into_owned();
                match grant.since {
                    Some(since) => {
                        let since = output::rfc3339(since).unwrap_or_default();
                        format!("{holder} has held it since {since} with fence {fence}")
                    }
                    None => format!("{holder} holds it with fence {fence}"),
                }
            }
            None => "no holder was observed".to_owned(),
        };
        Some(LockEvent {
            event: "lock_abandoned",
            resource: lock.resource.to_owned(),
            agent: lock.sender.to_owned(),
            text: format!(
                "{} gave up waiting for {} after {:.1} s; {holder}",
                escape_name(lock.sender),
                escape(lock.resource),
                waited.as_secs_f64()
            ),
            abandoned: Some(Abandoned {
                waited,
                holder: grant.map(|grant| grant.holder.clone()),
                held_since: grant.and_then(|grant| grant.since),
                fence: grant.map(|grant| grant.fence.to_string()),
            }),
        })
    }

    fn grant(&mut self, lock: &Lock<'_>, fence: Fence) -> Option<LockEvent> {
        let mut since = None;
        match self.request_of(lock.receiver, lock.resource) {
            Some(request) if request.conversation == lock.conversation => {
                match request.state {
                    RequestState::Ended => return None,
                    RequestState::Waiting | RequestState::Token => since = Some(lock.at),
                    RequestState::Granted => {}
                }
                request.state = RequestState::Granted;
            }
            Some(request) if is_before(lock.conversation, &request.conversation) => return None,
            // The request was not observed.
            _ => {
                self.request(lock, lock.receiver);
                self.set(lock, lock.receiver, RequestState::Granted);
            }
        }
        let before = self.holders.get_mut(lock.resource);
        // An extension has the fence of the grant.
        if before.is_some_and(|it| it.fence.position() == fence.position())
            || !self.holders.contains_key(lock.resource) && self.holders.len() >= MAX_RESOURCES
            || lock.conversation.len() > MAX_CONVERSATION
        {
            return None;
        }
        let grant = Grant {
            holder: lock.receiver.to_owned(),
            conversation: lock.conversation.to_owned(),
            fence,
            since,
        };
        let before = self.holders.insert(lock.resource.to_owned(), grant)?;
        Some(LockEvent {
            event: "lock_lost",
            resource: lock.resource.to_owned(),
            text: format!(
                "{} lost {} without releasing it; {} has it now",
                escape_name(&before.holder),
                escape(lock.resource),
                escape_name(lock.receiver)
            ),
            agent: before.holder,
            abandoned: None,
        })
    }
}

/// Whether an agent began a conversation before another one of its conversations.
fn is_before(conversation: &str, other: &str) -> bool {
    Conversation::parse(conversation).is_not_after(&Conversation::parse(other))
}

#[cfg(test)]
mod tests;
