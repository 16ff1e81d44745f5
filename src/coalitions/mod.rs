//! Coalitions whose leader holds a lock: at most one member leads, and another one takes over when the leader is lost.
//!
//! The agent of the interface that joins the members founds the coalition. It owns the lock `coalition/NAME`, and the
//! process of this agent has the entry of the coalition. The holder of the lock is the leader. Its commands carry the
//! fence of the lock, and a member refuses a fence that is lower than one that it has admitted.
//!
//! If the leader ends, leaves or is suspended beyond the lease, the entry is vacant: letters to the coalition wait for
//! the next leader until their deadlines. The member that follows the last leader in the list asks for the lock, the
//! next one after [`TURN`], and so on. If the founder is lost, the entry disappears in one change of the directory: the
//! coalition is dissolved into its members.
//!
//! [`Domain::form`](crate::Domain::form) forms a coalition without such a lock.
//!
//! ```no_run
//! # async fn example(item: fipa::Agent, crex: fipa::Agent, arm: fipa::Agent)
//! #     -> Result<(), Box<dyn std::error::Error>> {
//! use fipa::coalitions::CoalitionOptions;
//! use fipa::{AgentId, Performative};
//!
//! // The agent of the interface.
//! let options = CoalitionOptions::default();
//! let robot = item.found_coalition("robot_1", ["crex", "arm", "item"], options).await?;
//!
//! // Each member, in any process of any host.
//! let membership = crex.join_coalition("robot_1")?;
//! membership.leads().await?;
//! let command = crex.message(Performative::Request).receiver(AgentId::new("arm")?);
//! crex.send(membership.guard(command)?.content("(fold)").build()?).await?;
//!
//! let in_arm = arm.join_coalition("robot_1")?;
//! let command = arm.receive().await?;
//! in_arm.check(command.message())?;
//! # Ok(())
//! # }
//! ```

mod founder;
mod membership;
mod turn;

use std::sync::Arc;

use fipa_locking::{NameError, Resource};

use crate::agent::Agent;
use crate::locks::LockError;

pub use self::founder::{CoalitionOptions, FoundError, LedCoalition};
pub use self::membership::{CoalitionChanges, CoalitionState, Membership, NotLeaderError};
pub use self::turn::TURN;

impl Agent {
    /// Founds a coalition of these agents, whose leader is the holder of the lock `coalition/NAME`. This agent owns the
    /// lock. The first member that [joins](Self::join_coalition) leads, in the order of the list.
    ///
    /// Waits like [`own`](Self::own).
    ///
    /// # Errors
    /// If the name is invalid or taken, if the members are invalid, or if the lock cannot be owned.
    pub async fn found_coalition<N: Into<Arc<str>>>(
        &self,
        name: &str,
        members: impl IntoIterator<Item = N>,
        options: CoalitionOptions,
    ) -> Result<LedCoalition, FoundError> {
        let members = members.into_iter().map(Into::into).collect();
        LedCoalition::found(&self.core, name, members, options).await
    }

    /// Takes part in a coalition, which may be founded later: this agent asks for the lock of the leader when it is its
    /// turn, and knows the fences of the leaders. Dropping the membership releases the lock.
    ///
    /// # Errors
    /// If the name is not valid, or if the agent was deregistered.
    pub fn join_coalition(&self, name: &str) -> Result<Membership, LockError> {
        Membership::begin(&self.core, name)
    }
}

/// The lock of the leader of a coalition.
fn lock_of(coalition: &str) -> Result<Resource, NameError> {
    Resource::new(&format!("coalition/{coalition}"))
}
