//! The part of an agent's locks that the agent itself needs: their end, and which messages are theirs.
//! The locks are in `locks`.

use std::any::Any;
use std::sync::{Arc, Weak};

use fipa_acl::Message;
use fipa_locking::{Algorithm, Options, codec};
use parking_lot::Mutex;

use crate::agent::AgentCore;
use crate::agent::incoming::Incoming;

/// Protocol of questions to owners about their resources.
pub(crate) const STATUS_PROTOCOL: &str = "fipa-locks";

/// Whether a message is one of locks, which the application never reads.
pub(crate) fn is_of_locks(message: &Message) -> bool {
    message.protocol().is_some_and(is_lock_protocol)
}

/// Whether a received message is one of locks; does not decode it.
pub(crate) fn is_for_locks(incoming: &Incoming) -> bool {
    let protocol = incoming.protocol();
    protocol.is_some_and(|name| is_lock_protocol(&name.as_str()))
}

fn is_lock_protocol(name: &str) -> bool {
    name == STATUS_PROTOCOL || codec::is_lock_protocol(name)
}

/// The agents of this membership whose locks run. They know each other without letters.
#[derive(Default)]
pub(crate) struct Neighbors(Mutex<Vec<Weak<AgentCore>>>);

impl Neighbors {
    /// Adds an agent, and returns those that were added before it and have not ended.
    pub(crate) fn add(&self, agent: Weak<AgentCore>) -> Vec<Arc<AgentCore>> {
        let mut agents = self.0.lock();
        agents.retain(|agent| agent.strong_count() > 0);
        let before = agents.iter().filter_map(Weak::upgrade).collect();
        agents.push(agent);
        before
    }
}

/// The locks of an agent, from its first call that needs them.
#[derive(Default)]
pub(crate) struct LockSlot(pub(crate) Mutex<Slot>);

#[derive(Default)]
pub(crate) struct Slot {
    /// The options, unless they are the defaults.
    pub(crate) options: Option<(Algorithm, Options)>,
    /// Whether legacy peers are asked whether they use locks.
    pub(crate) legacy_peers: bool,
    pub(crate) running: Option<Arc<dyn RunningLocks>>,
    pub(crate) is_closed: bool,
}

/// The running locks of an agent. The module `locks` has the only implementation, and reads its own type back.
pub(crate) trait RunningLocks: Any + Send + Sync {
    /// Releases all locks and ends all ownership of the agent.
    fn close(&self, agent: &AgentCore);
}

impl LockSlot {
    /// Ends the locks, before the agent is deregistered.
    pub(crate) fn close(&self, agent: &AgentCore) {
        let running = {
            let mut slot = self.0.lock();
            slot.is_closed = true;
            slot.running.take()
        };
        if let Some(running) = running {
            running.close(agent);
        }
    }
}
