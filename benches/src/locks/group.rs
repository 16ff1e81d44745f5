//! A group of processes whose agents share a resource.

use std::collections::BTreeMap;
use std::fmt;
use std::time::{Duration, Instant};

use super::{HandOver, Row, name};
use crate::comparison::Program;
use crate::measure::{WARMING, count_for, median, spread, times};
use crate::part::{BY_HAND, By, Event, LockAgents, LockStep, Order, Part, Variant};
use crate::stage::{ProcessIndex, Stage};

/// The end of the name of the resource that is measured.
const RESOURCE: &str = "bay";

/// Acquisitions whose letters are counted.
const COUNTED: usize = 5;

/// Maximum time until all agents take part.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Index of the agent that takes turns with that of index 0. It is on the second host, if there are two.
const OTHER: usize = 3;

/// A kind of group.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Shape {
    pub(super) variant: Variant,
    pub(super) agents: usize,
    pub(super) hosts: usize,
}

impl fmt::Display for Shape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let algorithm = self.variant.algorithm().protocol();
        f.write_str(&name(algorithm, self.agents, self.hosts))
    }
}

/// The running processes of a group: one per agent, and a gateway per host if there are two.
pub(super) struct Group {
    shape: Shape,
    /// Ends the processes when it is dropped.
    stage: Stage,
    agents: Vec<ProcessIndex>,
    gateways: Vec<ProcessIndex>,
    /// The domain of each host.
    domains: Vec<String>,
    /// The beginning of all names. Other measurements on this machine may announce their agents, and a
    /// resource has one owner in a network.
    prefix: String,
}

/// Times of one turn, in nanoseconds.
struct Turn {
    typical: f64,
    cpu: f64,
}

impl Group {
    /// Starts the processes, and waits until all agents take part.
    pub(super) async fn open(program: &Program, shape: Shape) -> Result<Self, String> {
        let mut stage = Stage::new(program.clone(), None)?;
        let short = match shape.variant {
            Variant::OwnerQueue => "oq",
            Variant::RicartAgrawala => "ra",
            Variant::TokenAway => "sk",
            Variant::TokenHere => "skb",
        };
        let which = format!("{short}{}x{}", shape.agents, shape.hosts);
        let domain = |host| format!("{which}-{host}");
        let domains: Vec<String> = (0..shape.hosts).map(domain).collect();
        let transports = match shape.hosts {
            1 => "shm",
            _ => "shm,tcp",
        };
        let settings = [
            // More processes than processors cannot poll.
            "transport.shm.spin=0s".to_owned(),
            format!("mts.transports={transports}"),
            // No rate limit, as between processes of one host.
            "security.peer_letters=0".to_owned(),
            "security.peer_bytes=0".to_owned(),
        ];
        let gateways = match shape.hosts {
            1 => Vec::new(),
            _ => {
                stage
                    .start_gateways(&domains, |_| settings.to_vec())
                    .await?
            }
        };
        let mut agents = Vec::new();
        let hosts = domains.iter().cycle().take(shape.agents);
        for (index, domain) in hosts.enumerate() {
            let part = Part::Locks(LockAgents {
                variant: shape.variant,
                count: shape.agents,
                index,
                prefix: Stage::domain(&which),
            });
            agents.push(stage.start(&part, domain, &settings).await?.0);
        }
        let mut group = Self {
            shape,
            stage,
            agents,
            gateways,
            domains,
            prefix: Stage::domain(&which),
        };
        group.all(|_| LockStep::Find).await?;
        // The first call starts the locks of an agent, which then takes part.
        let prefix = group.prefix.clone();
        let own = |index| match index {
            LockAgents::OWNER => format!("{prefix}-{RESOURCE}"),
            other => format!("{prefix}-{RESOURCE}-{other}"),
        };
        let owning = |index| LockStep::Own {
            resources: vec![own(index)],
        };
        group.all(owning).await?;
        Ok(group)
    }

    /// Measures an acquisition and release without contention.
    pub(super) async fn cycles(&mut self, rounds: usize, turn: Duration) -> Result<Row, String> {
        let [letters, letters_by_hand] = self.count_letters().await?;
        let mut counts = [0; 2];
        let mut all: [Vec<Turn>; 2] = Default::default();
        for round in 0..=rounds {
            for ((by, count), turns) in [By::Locks, By::Hand]
                .into_iter()
                .zip(&mut counts)
                .zip(&mut all)
            {
                let took = self.cycle(by, WARMING + (*count).max(4)).await?;
                match round {
                    // The first turn finds the number of acquisitions that fill a turn.
                    0 => *count = count_for(took.typical, turn),
                    _ => turns.push(took),
                }
            }
        }
        let [locks, by_hand] = &all;
        let of = |turns: &[Turn], value: fn(&Turn) -> f64| -> Vec<f64> {
            turns.iter().map(value).collect()
        };
        let ratios = |value: fn(&Turn) -> f64| ratios(&of(locks, value), &of(by_hand, value));
        let typical = |turn: &Turn| turn.typical;
        let cpu = |turn: &Turn| turn.cpu;
        Ok(Row {
            algorithm: self.shape.variant.algorithm().protocol(),
            agents: self.shape.agents,
            hosts: self.shape.hosts,
            letters_needed: self.shape.variant.letters(self.shape.agents),
            letters,
            letters_by_hand,
            locks_us: median(&of(locks, typical)) / 1e3,
            by_hand_us: median(&of(by_hand, typical)) / 1e3,
            ratio: median(&ratios(typical)),
            ratio_spread: spread(&ratios(typical)),
            cpu_us: median(&of(locks, cpu)) / 1e3,
            by_hand_cpu_us: median(&of(by_hand, cpu)) / 1e3,
            cpu_ratio: median(&ratios(cpu)),
        })
    }

    /// Measures the time from a release until the next waiter has the lock.
    pub(super) async fn hand_overs(
        &mut self,
        rounds: usize,
        count: usize,
    ) -> Result<HandOver, String> {
        let mut all: [Vec<f64>; 3] = Default::default();
        for round in 0..=rounds {
            for (by, medians) in [By::Locks, By::Hand, By::Letter].into_iter().zip(&mut all) {
                let took = self.take_turns(by, count).await?;
                if round > 0 {
                    medians.push(median(&took));
                }
            }
        }
        let [locks, by_hand, letter] = &all;
        let (to_hand, to_letter) = (ratios(locks, by_hand), ratios(locks, letter));
        Ok(HandOver {
            algorithm: self.shape.variant.algorithm().protocol(),
            agents: self.shape.agents,
            hosts: self.shape.hosts,
            letters_in_sequence: self.shape.variant.letters_in_sequence(),
            locks_us: median(locks) / 1e3,
            by_hand_us: median(by_hand) / 1e3,
            letter_us: median(letter) / 1e3,
            ratio: median(&to_hand),
            ratio_spread: spread(&to_hand),
            letter_ratio: median(&to_letter),
            letter_ratio_spread: spread(&to_letter),
        })
    }

    /// Has all agents begin a step at the same time, and waits until it is complete.
    pub(super) async fn all(&mut self, step: impl Fn(usize) -> LockStep) -> Result<(), String> {
        for (index, agent) in self.agents.iter().enumerate() {
            self.stage.tell(*agent, &Order::Lock(step(index))).await?;
        }
        for agent in self.agents.clone() {
            match self.stage.event(agent).await? {
                Event::Done => {}
                other => return Err(unexpected(&other)),
            }
        }
        Ok(())
    }

    /// Starts a watcher on each host.
    pub(super) async fn watch(&mut self) -> Result<Vec<ProcessIndex>, String> {
        let mut watchers = Vec::new();
        for domain in &self.domains {
            watchers.push(self.stage.start(&Part::Watcher, domain, &[]).await?.0);
        }
        Ok(watchers)
    }

    /// Letters since the last call by protocol, as the watchers report them, and the number of records that
    /// the watchers missed. Waits before until no more letters of the protocol `quiet` pass.
    pub(super) async fn letters(
        &mut self,
        watchers: &[ProcessIndex],
        quiet: Option<&str>,
    ) -> Result<(BTreeMap<String, u64>, u64), String> {
        let (mut letters, mut missed) = (BTreeMap::new(), 0);
        for watcher in watchers {
            let quiet = quiet.map(str::to_owned);
            self.stage
                .tell(*watcher, &Order::CountLetters { quiet })
                .await?;
            match self.stage.event(*watcher).await? {
                Event::Letters { lost, by_protocol } => {
                    missed += lost;
                    for (protocol, count) in by_protocol {
                        *letters.entry(protocol).or_default() += count;
                    }
                }
                other => return Err(unexpected(&other)),
            }
        }
        Ok((letters, missed))
    }

    /// Identifiers of the agents' processes.
    pub(super) fn pids(&mut self) -> Result<Vec<u32>, String> {
        let agents = self.agents.clone().into_iter();
        agents.map(|agent| self.stage.pid(agent)).collect()
    }

    /// Letters of one acquisition and release: of locks, and by hand.
    async fn count_letters(&mut self) -> Result<[f64; 2], String> {
        let watchers = self.watch().await?;
        let needed = self.shape.variant.letters(self.shape.agents) as u64;
        let until = Instant::now() + TIMEOUT;
        // Agents that have just appeared take part after their first answer, and the watcher counts all
        // letters as soon as all processes have connected.
        for by in [By::Locks, By::Hand] {
            loop {
                let found = self.count_letters_of(by, &watchers, 1).await?;
                if found == needed {
                    break;
                }
                if Instant::now() > until {
                    return Err(format!("counted {found} letters, expected {needed}"));
                }
            }
        }
        let mut counted = [0.0; 2];
        for (by, counted) in [By::Locks, By::Hand].into_iter().zip(&mut counted) {
            let letters = self.count_letters_of(by, &watchers, COUNTED).await?;
            *counted = letters as f64 / COUNTED as f64;
        }
        for watcher in watchers {
            self.stage.end(watcher).await?;
        }
        Ok(counted)
    }

    async fn count_letters_of(
        &mut self,
        by: By,
        watchers: &[ProcessIndex],
        count: usize,
    ) -> Result<u64, String> {
        let protocol = match by {
            By::Locks => self.shape.variant.algorithm().protocol(),
            By::Hand | By::Letter => BY_HAND,
        };
        self.letters(watchers, Some(protocol)).await?;
        self.cycle(by, count).await?;
        let (letters, missed) = self.letters(watchers, Some(protocol)).await?;
        match missed {
            0 => Ok(letters.get(protocol).copied().unwrap_or(0)),
            _ => Err(format!("the watchers missed {missed} records of letters")),
        }
    }

    async fn cycle(&mut self, by: By, count: usize) -> Result<Turn, String> {
        let before = self.cpu().await?;
        let step = LockStep::Cycle {
            by,
            resource: format!("{}-{RESOURCE}", self.prefix),
            count,
        };
        let requester = *self.agents.first().ok_or("a group without agents")?;
        self.stage.tell(requester, &Order::Lock(step)).await?;
        let (began, ended) = match self.stage.event(requester).await? {
            Event::Sent { began, ended, .. } => (began, ended),
            other => return Err(unexpected(&other)),
        };
        let cpu = self.cpu().await?.saturating_sub(before) as f64;
        Ok(Turn {
            typical: median(&times(&began, &ended)),
            cpu: cpu / count.max(1) as f64,
        })
    }

    async fn take_turns(&mut self, by: By, count: usize) -> Result<Vec<f64>, String> {
        let pair = [0, OTHER];
        let mut both = Vec::new();
        for (index, other) in [(0, OTHER), (OTHER, 0)] {
            let step = LockStep::TakeTurns {
                by,
                resource: format!("{}-{RESOURCE}", self.prefix),
                other,
                begins: index == 0,
                count,
            };
            let agent = *self.agents.get(index).ok_or("too few agents")?;
            self.stage.tell(agent, &Order::Lock(step)).await?;
        }
        for index in pair {
            let agent = *self.agents.get(index).ok_or("too few agents")?;
            match self.stage.event(agent).await? {
                Event::TookTurns { acquired, released } => both.push((acquired, released)),
                other => return Err(unexpected(&other)),
            }
        }
        Ok(between(&both))
    }

    /// Processor time of all processes, in nanoseconds.
    async fn cpu(&mut self) -> Result<u64, String> {
        let mut all = 0;
        let processes: Vec<_> = self.agents.iter().chain(&self.gateways).copied().collect();
        for process in processes {
            self.stage.tell(process, &Order::Cpu).await?;
            match self.stage.event(process).await? {
                Event::Cpu { ns } => all += ns,
                other => return Err(unexpected(&other)),
            }
        }
        Ok(all)
    }
}

fn unexpected(event: &Event) -> String {
    format!("did not expect {event:?}")
}

/// Ratios, one per round.
fn ratios(own: &[f64], other: &[f64]) -> Vec<f64> {
    let pairs = own.iter().zip(other);
    pairs.map(|(own, other)| own / other).collect()
}

/// Times from a release until the next acquisition, if that is one of another agent. Each agent has its
/// acquisitions and its releases.
fn between(agents: &[(Vec<u64>, Vec<u64>)]) -> Vec<f64> {
    let mut events = Vec::new();
    for (agent, (acquired, released)) in agents.iter().enumerate() {
        events.extend(acquired.iter().map(|at| (*at, agent, true)));
        events.extend(released.iter().map(|at| (*at, agent, false)));
    }
    events.sort_unstable();
    let pairs = events.windows(2).filter_map(|pair| match pair {
        [(from, releasing, false), (until, acquiring, true)] if releasing != acquiring => {
            Some((until - from) as f64)
        }
        _ => None,
    });
    pairs.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hand_over_is_from_a_release_to_the_acquisition_of_another_agent() {
        let first = (vec![10, 50], vec![20, 60]);
        let second = (vec![25, 90], vec![45, 95]);
        assert_eq!(between(&[first, second]), [5.0, 5.0, 30.0]);
        // The same agent twice.
        assert_eq!(
            between(&[(vec![10, 30], vec![20, 40]), (vec![], vec![])]),
            [0.0; 0]
        );
    }

    #[test]
    fn the_letters_needed_are_those_of_the_algorithms() {
        let needed = |agents| Variant::ALL.map(|variant| variant.letters(agents));
        assert_eq!(needed(2), [3, 5, 5, 3]);
        assert_eq!(needed(8), [3, 17, 11, 3]);
        assert_eq!(needed(32), [3, 65, 35, 3]);
    }
}
