//! The Python interface of `fipa`: the module `fipa._native`, on which the package `fipa` is built.
//!
//! No thread of the library runs Python. What a program waits for is a `Pending`, which its own
//! threads and event loops poll.

mod actions;
mod agent;
mod buffer;
mod coalitions;
mod contract_net;
mod conversation;
mod domain;
mod events;
mod failure;
mod interpreter;
mod kept;
mod letter;
mod lock;
mod locks;
mod log;
mod membership;
mod message;
mod pending;
mod services;
mod topics;
mod value;
mod wakeups;

use pyo3::pymodule;

/// Agents of robots: the native part of the package `fipa`.
#[pymodule(gil_used = false)]
mod _native {
    #[pymodule_export]
    use crate::actions::{Goal, RemoteGoal};
    #[pymodule_export]
    use crate::agent::{Agent, Deliveries, Loan};
    #[pymodule_export]
    use crate::coalitions::Coalition;
    #[pymodule_export]
    use crate::contract_net::Bids;
    #[pymodule_export]
    use crate::conversation::{Request, Task};
    #[pymodule_export]
    use crate::domain::Domain;
    #[pymodule_export]
    use crate::events::Events;
    #[pymodule_export]
    use crate::interpreter::ending;
    #[pymodule_export]
    use crate::kept::forked;
    #[pymodule_export]
    use crate::letter::Letter;
    #[pymodule_export]
    use crate::lock::Lock;
    #[pymodule_export]
    use crate::locks::Owned;
    #[pymodule_export]
    use crate::log::follow;
    #[pymodule_export]
    use crate::membership::Membership;
    #[pymodule_export]
    use crate::pending::Pending;
    #[pymodule_export]
    use crate::topics::{Publisher, TopicLoan};
    #[pymodule_export]
    use crate::value::{sl_dumps, sl_loads};
    #[pymodule_export]
    use crate::wakeups::Wakeups;
}
