//! Reads the logs of all processes and finds letters that break a promise of delivery.
//!
//! A process may be killed after it accepted a letter and before it received or logged the letter.
//! Such a letter is *delivered*, and no log contains it as taken. It is later than every letter of
//! its sender that the killed registration logged, because a queue is received in order. An outcome
//! that a killed sender did not log is missing.

use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;

use super::journal::{self, Event, Id};

/// Maximum time between the end of a letter in its process and the line in the log, in
/// microseconds. The test stops processes for a shorter time.
const LATE: u64 = 6_000_000;
/// Maximum time until the outcome of a letter on a working stream, in microseconds.
const PROMPT: u64 = 1_000_000;
/// Deadline that a letter on a network without faults always meets, in milliseconds.
const AMPLE: u64 = 10_000;

/// A process, and how it ended.
#[derive(Debug, Clone)]
pub(crate) struct Life {
    pub(crate) log: PathBuf,
    /// Time after which the process was no longer running, if it was killed.
    pub(crate) killed: Option<u64>,
}

/// A time without faults.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Quiet {
    /// End of the last fault.
    pub(crate) healed: u64,
    /// Time at which every stream had delivered a letter that was sent after `healed`.
    pub(crate) proved: u64,
    /// Start of the next fault.
    pub(crate) end: u64,
    /// Percentage of the time from `healed` to `proved` in which a process of the machine waited
    /// for a processor. Zero if the kernel does not report it. A busy machine recovers slowly.
    pub(crate) busy_percent: u64,
}

#[derive(Debug)]
struct Registration {
    name: String,
    agent: Option<u64>,
    begun: u64,
    killed: Option<u64>,
}

#[derive(Debug, Default)]
struct Copy {
    sent: u64,
    deadline_ms: u64,
    forbidden: bool,
    /// Whether the letter has no other receiver. A process logs the outcomes of a letter after the
    /// last one of them.
    alone: bool,
    sender_killed: bool,
    /// Time, reason of a failure, and text of each outcome.
    outcomes: Vec<(u64, Option<String>, String)>,
    /// Time and registration of each event of taking.
    taken: Vec<(u64, u64)>,
}

impl Copy {
    fn ended(&self) -> Option<u64> {
        self.outcomes.first().map(|outcome| outcome.0)
    }

    fn delivered(&self) -> bool {
        matches!(self.outcomes.first(), Some((_, None, _)))
    }

    fn failed_because(&self, reason: &str) -> bool {
        let mut outcomes = self.outcomes.iter();
        outcomes.any(|(_, failure, _)| failure.as_deref() == Some(reason))
    }

    fn failed_for_certain(&self) -> bool {
        let reason = self
            .outcomes
            .first()
            .and_then(|outcome| outcome.1.as_deref());
        reason.is_some_and(|reason| reason != "Unconfirmed")
    }
}

/// Result of a check.
#[derive(Default)]
pub(crate) struct Report {
    pub(crate) breaches: Vec<String>,
    pub(crate) letters: usize,
    pub(crate) taken: usize,
    pub(crate) lost_with_receiver: usize,
    /// Outcomes by reason.
    pub(crate) outcomes: BTreeMap<String, usize>,
    /// Time from the end of the last fault until the directories of all senders had all receivers.
    pub(crate) directory: Recovery,
    /// Time from the end of the last fault until every stream promptly delivered every letter whose
    /// receiver was in the directory.
    pub(crate) delivery: Recovery,
}

/// Recovery times of streams after faults.
#[derive(Debug, Default)]
pub(crate) struct Recovery {
    /// Recovery time of each affected stream in each time without faults, in microseconds.
    pub(crate) took: Vec<u64>,
    /// The last late or failed letter of the slowest stream.
    pub(crate) slowest: String,
}

impl Recovery {
    fn add(&mut self, took: u64, letter: String) {
        if self.took.iter().all(|other| took > *other) {
            self.slowest = letter;
        }
        self.took.push(took);
    }

    /// Returns the number of streams that took more than the promised two seconds.
    pub(crate) fn slow(&self) -> usize {
        self.took.iter().filter(|took| **took > 2_000_000).count()
    }

    pub(crate) fn worst_ms(&self) -> u64 {
        self.took.iter().max().map_or(0, |took| took / 1000)
    }
}

#[derive(Default)]
struct Logs {
    registrations: Vec<Registration>,
    /// Every letter, with one entry per receiver.
    copies: BTreeMap<(Id, String), Copy>,
    /// Letters that each registration took, in order.
    takes: BTreeMap<u64, Vec<(u64, Id)>>,
    breaches: Vec<String>,
}

/// Checks every letter in these logs.
pub(crate) fn check(lives: &[Life], quiet: &[Quiet]) -> Report {
    let mut logs = Logs::default();
    logs.read(lives);
    logs.attribute_takes();
    logs.check_order();
    let mut report = Report::default();
    logs.check_outcomes(&mut report);
    logs.check_passed_over();
    logs.check_quiet(quiet, &mut report);
    report.letters = logs.copies.len();
    report.taken = logs.takes.values().map(Vec::len).sum();
    report.breaches = logs.breaches;
    report
}

impl Logs {
    fn read(&mut self, lives: &[Life]) {
        for life in lives {
            for (time, event) in journal::read(&life.log) {
                self.note(life, time, event);
            }
        }
        // An outcome can follow the departure of its sender, so the first pass collects all
        // letters.
        for life in lives {
            for (time, event) in journal::read(&life.log) {
                if let Event::Outcome {
                    id,
                    receiver,
                    failure,
                    how,
                } = event
                {
                    match self.copies.get_mut(&(id, receiver.clone())) {
                        Some(copy) => copy.outcomes.push((time, failure, how)),
                        None => self
                            .breaches
                            .push(format!("outcome of unknown {id:?} to {receiver}")),
                    }
                }
            }
        }
    }

    fn note(&mut self, life: &Life, time: u64, event: Event) {
        match event {
            Event::Begins { name } => self.registrations.push(Registration {
                name,
                agent: None,
                begun: time,
                killed: life.killed,
            }),
            Event::Registered { name, agent } => {
                let mut latest = self.registrations.iter_mut().rev();
                let begun = latest.find(|it| it.name == name && it.agent.is_none());
                begun.unwrap().agent = Some(agent);
            }
            Event::Left { agent } => {
                let mut all = self.registrations.iter_mut();
                all.find(|it| it.agent == Some(agent)).unwrap().killed = None;
            }
            Event::Sends {
                id,
                deadline_ms,
                forbidden,
                receivers,
            } => {
                let alone = receivers.len() == 1;
                for receiver in receivers {
                    let copy = Copy {
                        alone,
                        sent: time,
                        deadline_ms,
                        forbidden,
                        sender_killed: life.killed.is_some(),
                        ..Copy::default()
                    };
                    if self.copies.insert((id, receiver), copy).is_some() {
                        self.breaches.push(format!("the test sent {id:?} twice"));
                    }
                }
            }
            Event::Takes { agent, id } => self.takes.entry(agent).or_default().push((time, id)),
            Event::Torn { agent } => {
                let name = self.name_of(agent);
                self.breaches
                    .push(format!("{name} took a torn letter at {time}"));
            }
            Event::Outcome { .. } => {}
        }
    }

    fn name_of(&self, agent: u64) -> String {
        let mut all = self.registrations.iter();
        let found = all.find(|it| it.agent == Some(agent));
        found.map_or_else(|| format!("{agent:x}"), |it| it.name.clone())
    }

    fn attribute_takes(&mut self) {
        for (agent, takes) in &self.takes {
            let name = self.name_of(*agent);
            for (time, id) in takes {
                match self.copies.get_mut(&(*id, name.clone())) {
                    Some(copy) => copy.taken.push((*time, *agent)),
                    None => self.breaches.push(format!("{name} took unknown {id:?}")),
                }
            }
        }
    }

    /// Checks that each registration takes the letters of a sender's registration in order, and
    /// none twice.
    fn check_order(&mut self) {
        for (agent, takes) in &self.takes {
            let mut last: HashMap<u64, u64> = HashMap::new();
            for (time, Id { sender, number }) in takes {
                let before = last.insert(*sender, *number);
                if before.is_some_and(|before| before >= *number) {
                    let name = self.name_of(*agent);
                    self.breaches.push(format!(
                        "order: {name} ({agent:x}) took {number} of {sender:x} after {before:?}, at {time}"
                    ));
                }
            }
        }
    }

    /// Whether a killed registration may have accepted this letter and not logged it.
    fn may_have_died_with(&self, (id, name): &(Id, String), copy: &Copy) -> bool {
        let ended = copy.ended().unwrap_or(u64::MAX);
        self.registrations.iter().any(|registration| {
            let overlaps = |killed| copy.sent <= killed && registration.begun <= ended;
            let later_than_all = || {
                let takes = registration.agent.and_then(|agent| self.takes.get(&agent));
                let mut takes = takes.into_iter().flatten();
                takes.all(|(_, taken)| taken.sender != id.sender || taken.number < id.number)
            };
            registration.name == *name
                && registration.killed.is_some_and(overlaps)
                && later_than_all()
        })
    }

    fn check_outcomes(&mut self, report: &mut Report) {
        let mut breaches = Vec::new();
        for (key, copy) in &self.copies {
            let mut breach = |what: &str| {
                breaches.push(format!("{what}: {key:?} {copy:?}"));
            };
            match copy.outcomes.len() {
                0 if copy.sender_killed => {}
                1 => {}
                0 => breach("no outcome"),
                _ => breach("several outcomes"),
            }
            if copy.taken.len() > 1 {
                breach("taken twice");
            }
            if copy.failed_for_certain() && !copy.taken.is_empty() {
                breach("failed, and was taken");
            }
            if copy.delivered() && copy.taken.is_empty() {
                report.lost_with_receiver += 1;
                if !self.may_have_died_with(key, copy) {
                    breach("delivered, and not taken");
                }
            }
            let Some((_, failure, how)) = copy.outcomes.first() else {
                *report
                    .outcomes
                    .entry("killed with its sender".to_owned())
                    .or_default() += 1;
                continue;
            };
            let outcome = failure.clone().unwrap_or_else(|| {
                let words: Vec<&str> = how.split([' ', ',', ';']).take(3).collect();
                words.join(" ")
            });
            *report.outcomes.entry(outcome).or_default() += 1;
        }
        self.breaches.append(&mut breaches);
    }

    /// Checks that no open letter was passed over: a letter must not fail after a later letter of
    /// its stream was taken.
    fn check_passed_over(&mut self) {
        let mut breaches = Vec::new();
        for (agent, takes) in &self.takes {
            let name = self.name_of(*agent);
            let mut taken_before: HashMap<u64, u64> = HashMap::new();
            for (time, id) in takes {
                let before = taken_before.insert(id.sender, id.number).unwrap_or(0);
                for number in before + 1..id.number {
                    let earlier = (Id { number, ..*id }, name.clone());
                    let Some(copy) = self.copies.get(&earlier) else {
                        continue;
                    };
                    let open_then =
                        copy.alone && copy.ended().is_some_and(|ended| ended > time + LATE);
                    if open_then && copy.taken.is_empty() {
                        breaches.push(format!(
                            "passed over by {id:?} at {time}: {earlier:?} {copy:?}"
                        ));
                    }
                }
            }
        }
        self.breaches.append(&mut breaches);
    }

    /// Checks that every stream delivers every letter after the last fault.
    fn check_quiet(&mut self, quiet: &[Quiet], report: &mut Report) {
        let mut breaches = Vec::new();
        for window in quiet {
            let mut recovered: BTreeMap<(bool, u64, &str), (u64, String)> = BTreeMap::new();
            for ((id, name), copy) in &self.copies {
                let (Some(ended), false) = (copy.ended(), copy.forbidden) else {
                    continue;
                };
                if ended < window.healed || copy.sent > window.end {
                    continue;
                }
                let letter = || format!("{id:?} to {name} {copy:?}");
                let since = copy.sent.max(window.healed);
                // A letter that was sent during the faults may fail because of them.
                let fails = !copy.delivered() && copy.sent > window.healed;
                let unknown = fails && copy.alone && copy.failed_because("NoSuchAgent");
                let ample = copy.deadline_ms >= AMPLE;
                if fails && ample && copy.sent >= window.proved && ended <= window.end {
                    let after = (copy.sent - window.healed) / 1000;
                    breaches.push(format!(
                        "failed {after} ms after the last fault: {}",
                        letter()
                    ));
                }
                let late = copy.delivered() && copy.alone && ended > since + PROMPT;
                if unknown || late || fails && ample && copy.alone {
                    let slowest = recovered.entry((unknown, id.sender, name)).or_default();
                    if ended - window.healed > slowest.0 {
                        *slowest = (ended - window.healed, letter());
                    }
                }
            }
            for ((unknown, ..), (took, letter)) in recovered {
                match unknown {
                    true => report.directory.add(took, letter),
                    false => report.delivery.add(took, letter),
                }
            }
        }
        self.breaches.append(&mut breaches);
    }
}
