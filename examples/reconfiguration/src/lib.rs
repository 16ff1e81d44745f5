//! The application of the paper: robots that negotiate, reserve, dock and become one.
//!
//! Two hosts stand for two robots. `sherpa` has a gripper, and guides others to an interface; `crex` walks;
//! `payload_1` and `payload_2` are items with two interfaces and a camera each. The `operator` asks for a stack of both
//! items on `crex`. Each agent is a process. The truth about poses is in the process of the [`world`], which the others
//! reach as their [`hardware`]; what a robot knows of another one, it has from a letter.
//!
//! [`launch`] starts the processes, causes a fault, and collects the [reports](report). It decides nothing. The checker is
//! a program of its own, which reads the recording and the directory, and judges the end.

#[cfg(feature = "robots")]
mod check;
#[cfg(feature = "robots")]
mod crex;
pub mod face;
mod fault;
#[cfg(feature = "robots")]
mod fetching;
pub mod geometry;
#[cfg(feature = "robots")]
mod guidance;
pub mod hardware;
#[cfg(feature = "robots")]
mod host;
pub mod item;
#[cfg(feature = "robots")]
pub mod launch;
mod leading;
#[cfg(feature = "robots")]
mod looking;
#[cfg(feature = "robots")]
mod operator;
mod owning;
pub mod part;
#[cfg(feature = "robots")]
pub mod picture;
#[cfg(feature = "robots")]
mod relay;
pub mod report;
#[cfg(feature = "robots")]
mod rogue;
#[cfg(feature = "robots")]
mod sherpa;
mod taking_part;
#[cfg(feature = "robots")]
pub mod telling;
mod words;
#[cfg(feature = "robots")]
pub mod world;

use std::time::Duration;

pub use self::fault::Fault;
#[cfg(feature = "robots")]
pub use self::host::serve as serve_gateway;

/// The name of the merged robot.
pub const COALITION: &str = "crex_stack";

/// The lease of all locks.
pub const LEASE: Duration = Duration::from_secs(4);

/// The protocol of a docking, as an SCXML document.
pub const PROTOCOL: &str = include_str!("../dock.scxml");

/// Runs the program of a part until its standard input ends.
///
/// # Errors
/// If the program cannot go on.
#[cfg(feature = "robots")]
pub async fn run(part: &part::Part) -> Result<(), part::Failed> {
    use part::Role;
    match part.role {
        Role::World => world::run(part).await,
        Role::Item => item::run(part).await,
        Role::Crex => crex::run(part).await,
        Role::Sherpa => sherpa::run(part).await,
        Role::Operator => operator::run(part).await,
        Role::Rogue => rogue::run(part).await,
        Role::Gateway => host::gateway(part).await,
        Role::Watcher => host::watcher(part).await,
        Role::Checker => check::run(part).await,
    }
}
