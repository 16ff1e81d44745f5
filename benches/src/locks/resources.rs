//! Memory and idle load of many resources.

use std::time::{Duration, Instant};

use serde::Serialize;

use super::group::{Group, Shape};
use crate::comparison::Program;
use crate::machine::{private_memory, wakeups};
use crate::part::{LockStep, Variant};
use crate::stage::ProcessIndex;

/// Memory and idle load of many resources, all known to all agents of one host.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Resources {
    /// Number of processes, with one agent that uses locks each.
    pub(super) agents: usize,
    /// Number of resources. Each agent owns the same number.
    pub(super) resources: usize,
    /// Before the agents own them.
    pub(super) none: Load,
    /// When agents own them and no agent holds one.
    pub(super) owned: Load,
    /// When each is held by an agent that does not own it.
    pub(super) held: Load,
}

/// Load of idle processes.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Load {
    /// Memory of a process that it shares with no other, on average.
    pub(super) private_bytes: u64,
    /// Letters of all agents together.
    pub(super) letters_per_s: f64,
    /// Wake-ups of a process, on average.
    pub(super) wakeups_per_s: f64,
}

pub(super) async fn measure(
    program: &Program,
    agents: usize,
    resources: usize,
    window: Duration,
) -> Result<Resources, String> {
    let shape = Shape {
        variant: Variant::OwnerQueue,
        agents,
        hosts: 1,
    };
    let mut group = Group::open(program, shape).await?;
    let watchers = group.watch().await?;
    // Each agent owns every `agents`-th resource, and holds those that the agent before it owns.
    let of = |index: usize| -> Vec<String> {
        let numbers = (index % agents..resources).step_by(agents);
        numbers.map(|number| format!("resource-{number}")).collect()
    };
    let none = load(&mut group, &watchers, window).await?;
    let own = |index| LockStep::Own {
        resources: of(index),
    };
    group.all(own).await?;
    let owned = load(&mut group, &watchers, window).await?;
    let hold = |index| LockStep::Hold {
        resources: of(index + agents - 1),
    };
    group.all(hold).await?;
    let held = load(&mut group, &watchers, window).await?;
    Ok(Resources {
        agents,
        resources,
        none,
        owned,
        held,
    })
}

/// Observes idle processes for a time.
async fn load(
    group: &mut Group,
    watchers: &[ProcessIndex],
    window: Duration,
) -> Result<Load, String> {
    let pids = group.pids()?;
    // Letters of the step before are still under way.
    tokio::time::sleep(window / 2).await;
    group.letters(watchers, None).await?;
    let before = sum(&pids, wakeups)?;
    let start = Instant::now();
    tokio::time::sleep(window).await;
    let seconds = start.elapsed().as_secs_f64();
    let woken = sum(&pids, wakeups)?.saturating_sub(before);
    let (letters, missed) = group.letters(watchers, None).await?;
    if missed > 0 {
        return Err(format!("the watcher missed {missed} records of letters"));
    }
    let letters: u64 = letters.values().sum();
    let count = pids.len().max(1) as u64;
    Ok(Load {
        private_bytes: sum(&pids, private_memory)? / count,
        letters_per_s: letters as f64 / seconds,
        wakeups_per_s: woken as f64 / seconds / count as f64,
    })
}

fn sum(pids: &[u32], of: fn(u32) -> Result<u64, String>) -> Result<u64, String> {
    let mut sum = 0;
    for pid in pids {
        sum += of(*pid)?;
    }
    Ok(sum)
}

impl Resources {
    pub(super) fn to_text(&self) -> String {
        let mut text = format!(
            "\n{} agents on one host with {} resources, idle:\n",
            self.agents, self.resources
        );
        for (name, load) in [
            ("before", &self.none),
            ("owned", &self.owned),
            ("held", &self.held),
        ] {
            text.push_str(&format!(
                "  {name:<7} {:.2} MB private memory of a process, {:.1} letters/s of all agents, {:.1} \
                 wake-ups/s of a process\n",
                load.private_bytes as f64 / f64::from(1 << 20),
                load.letters_per_s,
                load.wakeups_per_s,
            ));
        }
        text
    }
}
