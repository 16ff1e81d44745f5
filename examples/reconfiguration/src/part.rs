//! The part of one process in the application, and its end.

use std::path::PathBuf;

use fipa::Config;
use fipa::config::Sources;
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncBufReadExt as _, BufReader, Lines, Stdin};

/// The error of a program, which ends it.
pub type Failed = Box<dyn std::error::Error + Send + Sync>;

/// The program that a process runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Role {
    /// The simulated world.
    World,
    /// A payload item with two interfaces and a camera.
    Item,
    /// The mobile robot.
    Crex,
    /// The robot with the gripper, which guides the others.
    Sherpa,
    /// The agent that asks for the stack.
    Operator,
    /// An agent that breaks the rules.
    Rogue,
    /// The message transport service of a host.
    Gateway,
    /// It reports the letters of a host.
    Watcher,
    /// It checks the end.
    Checker,
}

/// A defect that is built in on purpose, so that a test can see that the checker finds it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Mutant {
    /// Items and robots do not check fences.
    FencesUnchecked,
    /// Agents do not check letters against the protocols.
    EnforcementOff,
    /// The master does not lock the interface of the item.
    LockSkipped,
    /// Members obey each agent that claims to lead.
    LeaderNotFenced,
    /// The master keeps its locks when an item is gone.
    ReservationKept,
    /// The item reports a contact that does not exist.
    ReportInvented,
}

/// The part of one process: its program, its name and its environment.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[expect(clippy::exhaustive_structs, reason = "the launcher writes each field")]
pub struct Part {
    /// The program.
    pub role: Role,
    /// The name of its agent or gateway.
    pub name: String,
    /// The settings of its configuration: `KEY=VALUE`.
    pub set: Vec<String>,
    /// The socket of the world.
    pub world: PathBuf,
    /// The recording, which the checker reads.
    pub recording: PathBuf,
    /// The seed of the world.
    pub seed: u64,
    /// The fault in which this process takes part.
    pub fault: Option<crate::Fault>,
    /// The defect of this process.
    pub mutant: Option<Mutant>,
    /// The gateway of its host, for an operator that is an agent of another platform.
    pub platform: Option<Platform>,
}

/// A gateway as another platform uses it: with letters over HTTP.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[expect(clippy::exhaustive_structs, reason = "the launcher writes each field")]
pub struct Platform {
    /// The name of the platform. Its directory facilitator is `df@NAME`.
    pub name: String,
    /// The address at which it takes letters.
    pub address: String,
}

impl Part {
    /// Returns the configuration.
    ///
    /// # Errors
    /// If a setting is not valid.
    pub fn config(&self) -> Result<Config, Failed> {
        let set = self.set.clone();
        Ok(Config::load(&Sources {
            set,
            ..Sources::default()
        })?)
    }

    /// Whether this process has the defect.
    #[must_use]
    pub fn has(&self, mutant: Mutant) -> bool {
        self.mutant == Some(mutant)
    }
}

/// The standard input of a process: the launcher closes it when the process is to end.
#[derive(Debug)]
pub struct Stop(Lines<BufReader<Stdin>>);

impl Default for Stop {
    fn default() -> Self {
        Self(BufReader::new(tokio::io::stdin()).lines())
    }
}

impl Stop {
    /// Waits until the process is to end.
    pub async fn requested(&mut self) {
        while self.line().await {}
    }

    /// Waits for a line of the launcher. Returns whether there is one.
    pub async fn line(&mut self) -> bool {
        matches!(self.0.next_line().await, Ok(Some(_)))
    }
}
