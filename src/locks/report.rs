//! The state of resources, and the messages in which owners report it.
//!
//! A question is a `query-ref` with the protocol [`STATUS_PROTOCOL`], an answer an `inform` in the same
//! conversation. The content of the answer is JSON:
//!
//! ```json
//! { "version": 1, "locks": [ { "resource": text, "holder": name, "fence": text, "expires_ms": number,
//!                              "waiters": [ name ], "waiting": number, "contested_by": name } ] }
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, ErrorChain, Message, Performative};
use fipa_locking::{Fence, LockPeer, LockStatus, Millis, Resource};
use fipa_mts::letter_for;
use fipa_transport::log_limit;
use serde::{Deserialize, Serialize};

use super::shell::Shared;
use super::{LockError, owned};
use crate::agent::AgentCore;
use crate::agent::demultiplexer::{Admitted, Party};
use crate::agent::lock_slot::STATUS_PROTOCOL;
use crate::agent::reader_key::ReaderKey;

/// Maximum length of the content of an answer, in bytes.
const MAX_CONTENT: usize = 1 << 20;
/// Maximum number of waiting agents in an answer, for each resource.
const MAX_WAITERS: usize = 16;
/// Maximum number of resources in an answer.
const MAX_RESOURCES: usize = 1_000;

const VERSION: u32 = 1;

/// The state of a resource.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct ResourceStatus {
    /// The name of the resource.
    pub resource: String,
    /// The name of its owner, if known.
    pub owner: Option<String>,
    /// Whether the details are those of the owner. Other agents have none.
    pub is_reported: bool,
    /// The name of the agent that holds the resource.
    pub holder: Option<String>,
    /// The fence of the live grant.
    pub fence: Option<Fence>,
    /// The remaining lease of the live grant.
    pub expires: Option<Duration>,
    /// The names of agents that have reported to the owner and wait, the next one first; at most 16 in
    /// the answer of an owner.
    pub waiters: Vec<String>,
    /// The number of these agents.
    pub waiting: usize,
    /// The name of another agent that claims the resource. Each admits its own fences only.
    pub contested_by: Option<String>,
    /// Whether the agent that was asked holds the resource.
    pub is_held: bool,
}

impl ResourceStatus {
    pub(super) fn unknown(resource: &str, owner: Option<String>) -> Self {
        Self {
            resource: resource.to_owned(),
            owner,
            is_reported: false,
            holder: None,
            fence: None,
            expires: None,
            waiters: Vec::new(),
            waiting: 0,
            contested_by: None,
            is_held: false,
        }
    }

    pub(super) fn of(status: &LockStatus, me: &LockPeer, now: Millis) -> Self {
        let name = |peer: &LockPeer| peer.name().to_owned();
        let grant = status.grant.as_ref();
        let expires = grant.and_then(|grant| grant.expires);
        Self {
            resource: status.resource.as_str().to_owned(),
            owner: status.owner.as_ref().map(name),
            is_reported: status.owner.as_ref() == Some(me),
            holder: grant.map(|grant| name(&grant.holder)),
            fence: grant.and_then(|grant| grant.fence.clone()),
            expires: expires.map(|at| Duration::from_millis(at.saturating_sub(now))),
            waiters: status.waiters.iter().map(name).collect(),
            waiting: status.waiters.len(),
            contested_by: status.rival.as_ref().map(name),
            is_held: status.is_held,
        }
    }
}

#[derive(Debug, Serialize, Deserialize)]
struct Answer {
    version: u32,
    locks: Vec<Row>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Row {
    resource: String,
    holder: Option<String>,
    fence: Option<String>,
    expires_ms: Option<Millis>,
    #[serde(default)]
    waiters: Vec<String>,
    #[serde(default)]
    waiting: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    contested_by: Option<String>,
}

/// The error of an answer.
#[derive(Debug, thiserror::Error)]
enum ReportError {
    #[error("the content has {0} bytes; at most {MAX_CONTENT} are allowed")]
    TooLong(usize),
    #[error("the content is not valid: {0}")]
    Json(#[from] serde_json::Error),
    #[error("version {0} is not supported")]
    Version(u32),
}

/// Answers a question about the resources that this agent owns.
pub(super) fn answer(core: &AgentCore, shared: &Shared, question: &Message) {
    if *question.performative() != Performative::QueryRef {
        return;
    }
    let locks: Vec<Row> = shared.read(|locks, now| {
        let own = locks
            .status(now)
            .filter(|status| locks.owner(&status.resource).is_some());
        own.take(MAX_RESOURCES)
            .map(|status| row(ResourceStatus::of(&status, locks.me(), now)))
            .collect()
    });
    let answer = Answer {
        version: VERSION,
        locks,
    };
    // Serialization of texts and numbers cannot fail.
    let content = serde_json::to_vec(&answer).unwrap_or_default();
    let endpoint = &core.endpoint;
    let answer = question
        .reply(Performative::Inform)
        .sender(endpoint.id.clone())
        .language("json")
        .content(content);
    let sent = answer
        .build()
        .map_err(|error| error.to_string())
        .and_then(|answer| {
            let letter = letter_for(&answer, SystemTime::now());
            let sending = endpoint.send(&answer, letter, endpoint.domain.inner.deadline());
            sending
                .map(drop)
                .map_err(|error| ErrorChain(&error).to_string())
        });
    if let Err(error) = sent {
        tracing::debug!(%error, "cannot answer a question about locks");
    }
}

fn row(status: ResourceStatus) -> Row {
    let mut waiters = status.waiters;
    waiters.truncate(MAX_WAITERS);
    Row {
        resource: status.resource,
        holder: status.holder,
        fence: status.fence.map(|fence| fence.to_string()),
        expires_ms: status
            .expires
            .map(|expires| Millis::try_from(expires.as_millis()).unwrap_or(Millis::MAX)),
        waiting: status.waiting,
        waiters,
        contested_by: status.contested_by,
    }
}

/// Reads the answer of an owner.
fn read(content: &[u8], owner: &str) -> Result<Vec<ResourceStatus>, ReportError> {
    if content.len() > MAX_CONTENT {
        return Err(ReportError::TooLong(content.len()));
    }
    let answer: Answer = serde_json::from_slice(content)?;
    if answer.version != VERSION {
        return Err(ReportError::Version(answer.version));
    }
    let read = |row: Row| {
        // An owner grants its own fences only.
        let fence = row.fence.and_then(|text| text.parse::<Fence>().ok());
        Some(ResourceStatus {
            resource: Resource::new(&row.resource).ok()?.as_str().to_owned(),
            owner: Some(owner.to_owned()),
            is_reported: true,
            holder: row.holder,
            fence: fence.filter(|fence| fence.owner() == owner && fence.resource() == row.resource),
            expires: row.expires_ms.map(Duration::from_millis),
            waiters: row.waiters,
            waiting: row.waiting,
            contested_by: row.contested_by,
            is_held: false,
        })
    };
    let locks = answer.locks.into_iter().take(MAX_RESOURCES);
    Ok(locks.filter_map(read).collect())
}

/// A conversation with owners, which ends when it is dropped.
struct Questions<'a> {
    core: &'a AgentCore,
    key: ReaderKey,
}

impl Drop for Questions<'_> {
    fn drop(&mut self) {
        self.core.demultiplexer.end(&self.key);
    }
}

/// Asks all owners that the directory lists.
pub(super) async fn query(
    core: &Arc<AgentCore>,
    timeout: Duration,
) -> Result<Vec<ResourceStatus>, LockError> {
    let endpoint = &core.endpoint;
    endpoint.domain.inner.owner.check()?;
    let directory = endpoint.domain.directory();
    directory.refresh();
    let mut owners = BTreeMap::new();
    let mut found = BTreeMap::new();
    for entry in directory.entries().iter() {
        if let Some((resource, owner)) = owned::listed(directory, entry) {
            let name = owner.name.to_string();
            let resource = resource.as_str().to_owned();
            let status = ResourceStatus::unknown(&resource, Some(name.clone()));
            found.insert((resource, name.clone()), status);
            owners.insert(name, owner);
        }
    }
    let receivers: Vec<AgentId> = owners
        .keys()
        .filter_map(|name| AgentId::new(name.clone()).ok())
        .collect();
    if receivers.is_empty() {
        return Ok(Vec::new());
    }
    let id = endpoint.unique_id();
    let parties = owners
        .iter()
        .map(|(name, owner)| Party::new(name, Some(owner)));
    let admitted = Admitted::Parties(parties.collect());
    let questions = Questions {
        key: core.demultiplexer.begin_internal(&id, admitted),
        core,
    };
    let mut question = Message::builder(Performative::QueryRef)
        .sender(endpoint.id.clone())
        .protocol(STATUS_PROTOCOL)
        .conversation_id(id);
    let mut waits_for = receivers.len();
    for receiver in receivers {
        question = question.receiver(receiver);
    }
    let question = question.build()?;
    let letter = letter_for(&question, SystemTime::now());
    drop(endpoint.send(&question, letter, timeout)?);
    let until = tokio::time::Instant::now() + timeout;
    while waits_for > 0 {
        let next = core.demultiplexer.next_of(endpoint, &questions.key);
        let Ok(incoming) = tokio::time::timeout_at(until, next).await else {
            break;
        };
        let message = incoming.map_err(|_| LockError::Closed)?.into_message();
        let sender = message.sender().map(|sender| sender.name().to_owned());
        let Some(owner) = sender.filter(|name| owners.contains_key(name)) else {
            // The report of an undelivered question.
            waits_for -= 1;
            continue;
        };
        owners.remove(&owner);
        waits_for -= 1;
        match read(
            message.content().map_or(&[], |content| &content[..]),
            &owner,
        ) {
            Ok(all) => {
                for status in all {
                    found.insert((status.resource.clone(), owner.clone()), status);
                }
            }
            Err(error) => log_limit::info!(%error, "ignored an answer of an owner"),
        }
    }
    Ok(found.into_values().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_read_as_it_was_written() {
        let status = ResourceStatus {
            holder: Some("rover".to_owned()),
            fence: "1.2.5a31c0e4d2b19f07@crane#bay".parse().ok(),
            expires: Some(Duration::from_millis(1_500)),
            waiters: vec!["arm".to_owned()],
            waiting: 1,
            contested_by: Some("barge".to_owned()),
            is_reported: true,
            ..ResourceStatus::unknown("bay", Some("crane".to_owned()))
        };
        let written = |version| {
            let locks = vec![row(status.clone())];
            serde_json::to_vec(&Answer { version, locks }).unwrap()
        };
        assert_eq!(
            read(&written(1), "crane").unwrap(),
            std::slice::from_ref(&status)
        );
        // An owner cannot report the fence of another one.
        let foreign = read(&written(1), "mallory").unwrap();
        assert_eq!(foreign[0].owner.as_deref(), Some("mallory"));
        assert_eq!(foreign[0].fence, None);
        assert!(matches!(
            read(&written(2), "crane"),
            Err(ReportError::Version(2))
        ));
        assert!(matches!(read(b"[", "crane"), Err(ReportError::Json(_))));
        let long = vec![b' '; MAX_CONTENT + 1];
        assert!(matches!(read(&long, "crane"), Err(ReportError::TooLong(_))));
    }
}
