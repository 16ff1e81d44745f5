//! Distributed mutual exclusion between agents that join, leave and crash.
//!
//! Agents reserve a *resource* before they use it. **Safety rests on the owner's grant alone**: the
//! owner of a resource is the agent whose hardware it is, and it grants one [`Fence`] at a time, with
//! a lease. The algorithms decide which agent is next. Their mistakes under loss and partition affect
//! fairness and liveness only.
//!
//! * [`Locks`] is the core of one agent: requester, member, owner and holder of any number of
//!   resources. It has no I/O and no clock: messages and `now` go in, [`Action`]s come out.
//! * [`MutualExclusion`] is the interface of the algorithms. With [`OwnerQueue`], the default, agents ask the owner
//!   only, which serves them in the order of arrival. [`RicartAgrawala`] is permission based
//!   (Ricart and Agrawala, *An optimal algorithm for mutual exclusion in computer networks*, CACM
//!   24(1), 1981). [`SuzukiKasami`] is token based (Suzuki and Kasami, *A distributed mutual
//!   exclusion algorithm*, ACM TOCS 3(4), 1985). These two have a basic form, for members and messages that
//!   are never lost, and an extended form, which probes members, repeats requests and replaces a lost
//!   token.
//! * [`Owner`] is the core of an owner, [`Holder`] that of a holder. Leases are those of Gray and
//!   Cheriton (*Leases: an efficient fault-tolerant mechanism for distributed file cache
//!   consistency*, SOSP 1989).
//! * [`codec`] has the ACL messages. They are those of the C++ library `distributed_locking`, with
//!   additions that this library ignores.
//! * [`OwnerState`] is the content of an owner's state file.
//! * [`invariants`] checks recorded histories.
//!
//! All times are [`Millis`] of one clock per process. The clock has to count suspend
//! (`CLOCK_BOOTTIME`). Rates of two clocks may differ by up to 2 %.
//!
//! ```
//! use fipa_locking::{Action, AnyAlgorithm, Algorithm, Event, Locks, Options, LockPeer, OwnerState, Resource};
//!
//! let bay = Resource::new("bay")?;
//! let options = Options::default();
//! let mut crane: Locks<AnyAlgorithm> =
//!     Locks::new(LockPeer::new("crane", 1)?, Algorithm::OwnerQueue, options);
//! let mut actions = Vec::new();
//! // The state has to be written and synced before `own` is called.
//! let state = OwnerState::first().next_life(options.lease);
//! crane.own(0, &bay, &state, &mut actions);
//! // No other agent claims the resource.
//! let begin = crane.poll_timeout().expect("the claim ends");
//! crane.handle_timeout(begin, &mut actions);
//! let claim = crane.lock(begin, &bay, None, &mut actions);
//! assert!(actions.iter().any(|action| matches!(
//!     action,
//!     Action::Event(Event::Acquired { claim: acquired, .. }) if *acquired == claim
//! )));
//! let fence = crane.fence(begin, claim, &bay).expect("the owner is an agent of this library");
//! assert!(crane.admit(begin, &bay, &fence));
//! crane.release(begin, claim, &mut actions);
//! assert!(!crane.admit(begin, &bay, &fence));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod algorithm;
pub mod codec;
mod faults;
mod fence;
mod greeted;
mod holder;
pub mod invariants;
mod locks;
mod message;
#[cfg(test)]
mod model;
mod names;
mod options;
mod owner;
mod probes;
mod queue;
mod state_file;

pub use algorithm::{
    Algorithm, AnyAlgorithm, Context, Member, MutualExclusion, OwnerGate, OwnerQueue,
    RicartAgrawala, Step, SuzukiKasami,
};
pub use fence::{Admission, Fence, FenceError, NotAdmitted};
pub use holder::{Holder, HolderStep};
pub use locks::{Action, ClaimId, Event, Failure, LockStatus, Locks};
pub use message::{Act, Content, LockDialect, LockMessage, Refusal, Token};
pub use names::{Conversation, LockPeer, MAX_NAME, Millis, NameError, Resource};
pub use options::{Options, OptionsError};
pub use owner::{Ending, Grant, Owner, OwnerStep};
pub use queue::MAX_PLACE;
pub use state_file::{OwnerState, OwnerStateError};
