//! A member of a coalition: it asks for the lock of the leader when it is its turn.

use std::fmt;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{Message, MessageBuilder};
use fipa_locking::{Fence, Resource};
use fipa_sds::{Members, Role, Watch};
use parking_lot::Mutex;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};

use super::lock_of;
use super::turn::{TURN, turn_of};
use crate::agent::AgentCore;
use crate::locks::{AdmitError, Device, Lock, LockError, acquire, fences_of, listed_owner};

/// The part of an agent in a coalition. Dropping it releases the lock of the leader.
pub struct Membership {
    core: Arc<AgentCore>,
    name: Arc<str>,
    lock: Resource,
    state: watch::Receiver<State>,
    resigned: watch::Sender<u64>,
    admitted: Arc<Mutex<Option<Admitted>>>,
    task: JoinHandle<()>,
}

/// The state of a coalition, as one of its members sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CoalitionState {
    /// The members, and the leader if there is one at present. `None` if the coalition is not in the directory: it is
    /// not founded yet, or it is dissolved.
    pub members: Option<Members>,
    /// Whether this agent holds the lock of the leader.
    pub leads: bool,
}

/// The changes of the state of a coalition; see [`Membership::changes`].
#[derive(Debug)]
pub struct CoalitionChanges {
    state: watch::Receiver<State>,
}

impl CoalitionChanges {
    /// Waits for the next change, and returns the state after it. Changes that follow each other while the caller does
    /// not wait are one. Returns `None` after the membership has ended.
    pub async fn next(&mut self) -> Option<CoalitionState> {
        self.state.changed().await.ok()?;
        Some(self.state.borrow_and_update().shown())
    }
}

#[derive(Debug, Clone, Default)]
struct State {
    members: Option<Members>,
    lock: Option<Arc<Lock>>,
}

impl State {
    fn shown(&self) -> CoalitionState {
        let lock = self.lock.as_ref();
        CoalitionState {
            members: self.members.clone(),
            leads: lock.is_some_and(|lock| lock.is_held()),
        }
    }
}

/// The commands of leaders that this agent has admitted.
struct Admitted {
    /// The name of the owner of the lock.
    owner: Arc<str>,
    device: Device,
    /// The sender of the last command.
    leader: Option<String>,
    /// Whether the directory has listed that sender as the leader, and no longer does.
    has_ended: bool,
}

/// The error if an agent that does not lead a coalition commands its members.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("this agent does not lead the coalition {coalition:?}")]
pub struct NotLeaderError {
    /// The name of the coalition.
    pub coalition: String,
}

impl Membership {
    pub(super) fn begin(core: &Arc<AgentCore>, name: &str) -> Result<Self, LockError> {
        let lock = lock_of(name)?;
        let (sender, state) = watch::channel(State::default());
        let (resigned, resignations) = watch::channel(0);
        let admitted = Arc::<Mutex<Option<Admitted>>>::default();
        let member = Member {
            core: Arc::clone(core),
            name: name.into(),
            lock: lock.clone(),
            changes: core.endpoint.domain.directory().watch(),
            state: sender,
            resignations,
            admitted: Arc::clone(&admitted),
            last_leader: None,
            vacant_since: None,
            not_before: None,
        };
        let runtime = &core.endpoint.domain.inner.service.runtime;
        Ok(Self {
            core: Arc::clone(core),
            name: name.into(),
            lock,
            state,
            resigned,
            admitted,
            task: runtime.spawn(member.run()),
        })
    }

    /// Returns the name of the coalition.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the present state.
    #[must_use]
    pub fn state(&self) -> CoalitionState {
        self.state.borrow().shown()
    }

    /// Returns the changes of the state from now on.
    #[must_use]
    pub fn changes(&self) -> CoalitionChanges {
        let mut state = self.state.clone();
        state.mark_unchanged();
        CoalitionChanges { state }
    }

    /// Waits until this agent leads.
    ///
    /// # Errors
    /// If the agent was deregistered.
    pub async fn leads(&self) -> Result<(), LockError> {
        let mut state = self.state.clone();
        let leads = state.wait_for(|state| state.shown().leads).await;
        leads.map(drop).map_err(|_| LockError::Closed)
    }

    /// Releases the lock of the leader, if this agent leads. The other members are asked first to lead again.
    pub fn resign(&self) {
        self.resigned.send_modify(|number| *number += 1);
    }

    /// Adds the fence of the leader to a command for the members.
    ///
    /// # Errors
    /// If this agent does not lead.
    pub fn guard(&self, command: MessageBuilder) -> Result<MessageBuilder, NotLeaderError> {
        let state = self.state.borrow();
        let lock = state.lock.as_ref().filter(|lock| lock.is_held());
        let lock = lock.ok_or_else(|| NotLeaderError {
            coalition: self.name.to_string(),
        })?;
        Ok(lock.guard(command))
    }

    /// Checks that a message is a command of the leader, and returns its fence. A fence is refused after a higher one,
    /// and after the directory has listed the end of the sender as the leader.
    ///
    /// # Errors
    /// If the message must not be acted on.
    pub fn check(&self, message: &Message) -> Result<Fence, AdmitError> {
        let directory = self.core.endpoint.domain.directory();
        let owner = listed_owner(directory, &self.lock).map(|(owner, _)| Arc::clone(&owner.name));
        let mut slot = self.admitted.lock();
        // The fences of a founder that is lost stay valid until the end of the coalition is listed.
        let fits = |known: &Admitted| owner.as_ref().is_none_or(|owner| *owner == known.owner);
        let admitted = match slot.take().filter(fits) {
            Some(admitted) => admitted,
            None => {
                let missing = AdmitError::Missing {
                    owner: owner.as_deref().unwrap_or("its founder").to_owned(),
                    resource: self.lock.as_str().to_owned(),
                };
                let admitted = owner.and_then(|it| Admitted::of(&self.core, it, &self.lock).ok());
                admitted.ok_or(missing)?
            }
        };
        slot.insert(admitted).check(message)
    }
}

impl Admitted {
    /// Begins to check the fences of this owner.
    fn of(core: &Arc<AgentCore>, owner: Arc<str>, lock: &Resource) -> Result<Self, LockError> {
        Ok(Self {
            device: Device::begin(core, &owner, lock.as_str())?,
            owner,
            leader: None,
            has_ended: false,
        })
    }

    /// Admits the fence of this agent, which leads now, so that those of earlier leaders are refused.
    fn lead(&mut self, fence: &Fence, own: &str) {
        // The owner has just granted it, and it is higher than all others.
        if self.device.admit(fence).is_ok() {
            self.leader = Some(own.to_owned());
            self.has_ended = false;
        }
    }

    fn check(&mut self, message: &Message) -> Result<Fence, AdmitError> {
        let highest = self.device.highest();
        if self.has_ended
            && let Some(highest) = &highest
            && fences_of(message)?.contains(highest)
        {
            return Err(AdmitError::Stale {
                resource: highest.resource().to_owned(),
                fence: highest.clone(),
            });
        }
        let fence = self.device.check(message)?;
        if highest.as_ref() != Some(&fence) {
            self.leader = message.sender().map(|sender| sender.name().to_owned());
            self.has_ended = false;
        }
        Ok(fence)
    }

    /// Takes note of a change of the leader that the directory lists.
    fn leader_changed(&mut self, before: Option<&str>, after: Option<&str>) {
        let last = self.leader.as_deref();
        if last.is_some() && before == last && after != last {
            self.has_ended = true;
        }
    }
}

impl Drop for Membership {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl fmt::Debug for Membership {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Membership")
            .field("name", &self.name)
            .field("state", &self.state())
            .finish_non_exhaustive()
    }
}

/// The task of a membership.
struct Member {
    core: Arc<AgentCore>,
    name: Arc<str>,
    lock: Resource,
    changes: Watch,
    state: watch::Sender<State>,
    resignations: watch::Receiver<u64>,
    admitted: Arc<Mutex<Option<Admitted>>>,
    last_leader: Option<Arc<str>>,
    vacant_since: Option<Instant>,
    /// Earliest time of the next request, after one that failed.
    not_before: Option<Instant>,
}

type Request = Pin<Box<dyn Future<Output = Result<Lock, LockError>> + Send>>;

impl Member {
    async fn run(mut self) {
        let mut request: Option<Request> = None;
        loop {
            let turn = self.look(request.is_some());
            let now = Instant::now();
            match turn {
                None => request = None,
                Some(turn) if turn <= now && request.is_none() => {
                    let (core, lock) = (Arc::clone(&self.core), self.lock.clone());
                    request = Some(Box::pin(async move { acquire(&core, lock).await }));
                }
                Some(_) => {}
            }
            let next = turn.filter(|_| request.is_none());
            let held = self.state.borrow().lock.clone();
            tokio::select! {
                result = or_never(request.as_mut()) => {
                    request = None;
                    match result {
                        Ok(lock) => self.lead(lock),
                        Err(LockError::Closed) => return,
                        Err(_) => self.not_before = Some(Instant::now() + TURN),
                    }
                }
                _ = or_never(held.as_ref().map(|lock| lock.lost())) => self.release(),
                resigned = self.resignations.changed() => match resigned {
                    Ok(()) => self.release(),
                    Err(_) => return,
                },
                () = or_never(next.map(sleep_until)) => {}
                change = self.changes.next() => if change.is_none() {
                    return;
                },
            }
        }
    }

    /// Reads the directory. Returns the time at which this agent asks for the lock, if it is to. `requests` tells
    /// whether it has asked already.
    fn look(&mut self, requests: bool) -> Option<Instant> {
        let directory = self.core.endpoint.domain.directory();
        let members = directory
            .lookup(&self.name)
            .and_then(|entry| match &entry.role {
                Role::Coalition(members) => Some(members.clone()),
                _ => None,
            });
        let before = self.state.borrow().members.clone();
        if before != members {
            let leader = |members: &Option<Members>| members.as_ref()?.leader().cloned();
            let (before, after) = (leader(&before), leader(&members));
            if let Some(admitted) = &mut *self.admitted.lock() {
                admitted.leader_changed(before.as_deref(), after.as_deref());
            }
            self.last_leader = after.or(self.last_leader.take());
            let shown = members.clone();
            self.state.send_modify(|state| state.members = shown);
        }
        let own = &*self.core.endpoint.name;
        let is_registered = |name: &str| directory.known(name).is_some();
        let turn = members.as_ref().and_then(|members| {
            turn_of(
                own,
                members.names(),
                self.last_leader.as_deref(),
                is_registered,
            )
        });
        let Some(turn) = turn else {
            // This agent is no member.
            self.release();
            return None;
        };
        if self.state.borrow().lock.is_some() {
            return None;
        }
        let leader = members.as_ref().and_then(Members::leader);
        let turn = match leader.filter(|leader| is_registered(leader)) {
            Some(leader) if **leader != *own => {
                self.vacant_since = None;
                return None;
            }
            // The founder has granted the request and listed this agent, or has not listed the end of its lock.
            Some(_) if requests => Duration::ZERO,
            Some(_) => return None,
            None => turn,
        };
        let turn = *self.vacant_since.get_or_insert_with(Instant::now) + turn;
        Some(self.not_before.map_or(turn, |earliest| turn.max(earliest)))
    }

    /// Leads with this lock. If the lock is released before the founder has listed this agent, the others are asked
    /// first nevertheless.
    fn lead(&mut self, lock: Lock) {
        self.last_leader = Some(Arc::clone(&self.core.endpoint.name));
        self.vacant_since = None;
        if let Some(fence) = lock.fence() {
            let mut slot = self.admitted.lock();
            let known = slot.take().filter(|it| *it.owner == *fence.owner());
            let begin = || Admitted::of(&self.core, fence.owner().into(), &self.lock).ok();
            *slot = known.or_else(begin);
            if let Some(admitted) = &mut *slot {
                admitted.lead(fence, &self.core.endpoint.name);
            }
        }
        self.state
            .send_modify(|state| state.lock = Some(Arc::new(lock)));
    }

    fn release(&self) {
        self.state
            .send_if_modified(|state| state.lock.take().is_some());
    }
}

/// Waits for a future, if there is one.
async fn or_never<F: Future>(future: Option<F>) -> F::Output {
    match future {
        Some(future) => future.await,
        None => std::future::pending().await,
    }
}
