//! Agents that send letters and read them.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Submission, SubmissionId, Undecodable};
use fipa_mts::letter_for;
use fipa_sds::Directory;
use fipa_transport::{Incarnation, Outcome};

use super::checks::Invariant;
use super::gates::{content_of, number_in};
use super::liar::TO_LIARS;
use super::links::MAX_DATAGRAM;
use super::{AGENTS, Breach, Event, PROCESSES, World};

/// Maximum delay of an outcome after the deadline: one turn of the core's timer.
const SLACK: Duration = Duration::from_millis(5);
/// Time for which letters are still sent after all faults.
pub(super) const AFTER: Duration = Duration::from_millis(1500);

/// State of a sent letter, by its number.
pub(super) struct Sent {
    pub(super) process: usize,
    pub(super) sender: Incarnation,
    /// Names of the receivers that are known.
    pub(super) receivers: Vec<Arc<str>>,
    /// The registration of the only receiver that its sender knew of.
    pub(super) known: Option<Incarnation>,
    pub(super) expected: usize,
    /// The receiver's registration on this host, if it was not in the sender's view.
    pub(super) missed: Option<Incarnation>,
    pub(super) outcomes: BTreeMap<Arc<str>, Outcome>,
    pub(super) at: Instant,
    pub(super) deadline: Duration,
    pub(super) size: usize,
    /// Maximum delivery time, if every fault was over before the letter was sent.
    pub(super) bound: Option<Duration>,
}

impl World {
    pub(super) fn plan_traffic(&mut self) {
        let active = (self.heals - self.start) + AFTER;
        for _ in 0..self.weather.bursts {
            let at =
                self.start + Duration::from_micros(self.random.u64(..active.as_micros() as u64));
            self.at(at, Event::Send);
        }
        let hosts = self.weather.hosts;
        for pair in 0..self.weather.streams {
            let from = self.random.usize(..hosts);
            let to = (from + self.random.usize(1..hosts)) % hosts;
            let mut process = || self.random.usize(..PROCESSES);
            let sender = format!("h{from}_p{}_{}", process(), AGENTS - 1);
            let receiver = format!("h{to}_p{}_0", process());
            self.pairs.push((sender.into(), receiver.into()));
            self.at(self.start, Event::Stream { pair });
        }
    }

    /// An agent sends a few letters.
    pub(super) fn send_burst(&mut self) -> Result<(), Breach> {
        let living: Vec<usize> = self.robots().collect();
        let Some(&at) = self.random.choice(&living) else {
            return Ok(());
        };
        let agents = self.processes[at].agents.iter();
        let Some((name, sender)) = self.random.choice(agents).cloned() else {
            return Ok(());
        };
        let host = self.random.usize(..self.weather.hosts);
        // Few pairs and bursts, so that many letters share a stream. Few patterns, because
        // compiling them takes longer than everything else.
        let receiver = match self.random.u32(..100) {
            0 => format!("h{host}_.*"),
            1..=10 => "nobody".to_owned(),
            _ => format!("h{host}_p{}_{}", self.random.usize(..PROCESSES), 0),
        };
        let mut receiver: Arc<str> = receiver.as_str().into();
        if self.liars.is_some()
            && self.random.f64() < TO_LIARS
            && let Some(liar) = self.name_of_liar()
        {
            receiver = liar;
        }
        for _ in 0..self.random.u32(1..self.weather.burst) {
            self.send(at, (&name, sender), &receiver)?;
        }
        Ok(())
    }

    /// The next letters of a pair that sends without a pause.
    pub(super) fn send_on(&mut self, pair: usize) -> Result<(), Breach> {
        if self.now > self.quiet + AFTER {
            return Ok(());
        }
        let pause = Duration::from_millis(self.random.u64(10..150));
        self.at(self.now + pause, Event::Stream { pair });
        let (from, to) = self.pairs[pair].clone();
        let robots: Vec<usize> = self.robots().collect();
        for at in robots {
            let mut agents = self.processes[at].agents.iter();
            if let Some((_, sender)) = agents.find(|(name, _)| *name == from).cloned() {
                for _ in 0..self.random.u32(1..4) {
                    self.send(at, (&from, sender), &to)?;
                }
                break;
            }
        }
        Ok(())
    }

    fn send(
        &mut self,
        at: usize,
        (name, sender): (&Arc<str>, Incarnation),
        receiver: &Arc<str>,
    ) -> Result<(), Breach> {
        let number = self.sent.len() as u64 + 1;
        let size = match self.random.f64() < self.weather.large {
            true => self.random.usize(MAX_DATAGRAM + 1..MAX_DATAGRAM * 5),
            false => 0,
        };
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new(&**name).expect("a name"))
            .receiver(AgentId::new(&**receiver).expect("a name"))
            .content(content_of(number, size))
            .build()
            .expect("a message");
        let letter = letter_for(&message, self.clocks().utc).expect("a letter");
        let size = letter.len();
        let healed = self.now >= self.quiet;
        let deadline = self.weather.deadlines.draw(&mut self.random, healed);
        let submission = Submission {
            sender,
            letter,
            receivers: vec![Arc::clone(receiver)],
            deadline,
        };
        let known = self.view(at).known(receiver).map(|it| it.incarnation);
        let receivers = match known {
            Some(_) => vec![Arc::clone(receiver)],
            None => self.meant_by(at, name, receiver),
        };
        let now = self.clocks();
        let missed = known.is_none();
        let on_host = self.agent_on(self.processes[at].host, receiver);
        let (submission, expected) = self.processes[at].core.submit(now, submission);
        self.sends.insert((at, submission), number);
        let bound = Some(self.bound(size))
            .filter(|bound| self.now >= self.quiet && known.is_some() && deadline > *bound)
            .filter(|_| !self.is_liars_name(receiver));
        if let Some(bound) = bound {
            self.bounded += 1;
            self.at(self.now + bound, Event::Liveness { number });
        }
        for receiver in &receivers {
            let stream = (sender, Arc::clone(receiver));
            self.open.entry(stream).or_default().insert(number);
            self.open_bytes += size;
        }
        self.sent.insert(
            number,
            Sent {
                process: at,
                sender,
                receivers,
                known,
                expected: expected.unwrap_or(usize::MAX),
                missed: on_host.filter(|_| missed),
                outcomes: BTreeMap::new(),
                at: self.now,
                deadline,
                size,
                bound,
            },
        );
        self.at(self.now + deadline + SLACK, Event::Deadline { number });
        self.carry_out(at)?;
        if self.processes[at].closed.is_some() {
            self.check_closed(number);
        }
        Ok(())
    }

    /// The names of the receivers of a letter to a pattern.
    fn meant_by(&self, at: usize, sender: &str, pattern: &str) -> Vec<Arc<str>> {
        let Some(start) = pattern.strip_suffix(".*") else {
            return Vec::new();
        };
        let entries = self.view(at).entries();
        let others = entries.iter().filter(|entry| *entry.name != *sender);
        others
            .filter(|entry| entry.name.starts_with(start))
            .map(|entry| Arc::clone(&entry.name))
            .collect()
    }

    /// The receivers of a letter are known after a refresh.
    pub(super) fn resolved(&mut self, (at, submission): (usize, SubmissionId), outcomes: usize) {
        let Some(&number) = self.sends.get(&(at, submission)) else {
            return;
        };
        self.trace(|| format!("letter {number} has {outcomes} receivers"));
        // A pattern may stand for other agents now than when the letter was sent. Only those that it
        // was dispatched to or failed for count.
        let view = self.view(at);
        let Some(sent) = self.sent.get_mut(&number) else {
            return;
        };
        sent.expected = outcomes;
        let is_gone = |name: &Arc<str>| view.known(name).is_none();
        if sent.receivers.len() > 1 {
            for receiver in sent.receivers.extract_if(.., |it| is_gone(it)) {
                let stream = (sent.sender, receiver);
                let open = self.open.get_mut(&stream);
                if open.is_some_and(|open| open.remove(&number)) {
                    self.open_bytes -= sent.size;
                }
            }
        }
    }

    pub(super) fn outcome(
        &mut self,
        sent: (usize, SubmissionId),
        receiver: Arc<str>,
        outcome: Outcome,
    ) -> Result<(), Breach> {
        let Some(&number) = self.sends.get(&sent) else {
            return Err(format!(
                "an outcome of a letter that was not sent: {outcome}"
            ));
        };
        self.trace(|| format!("letter {number} to {receiver}: {outcome}"));
        self.check_outcome(number, &receiver, &outcome);
        if self
            .sent
            .get(&number)
            .is_some_and(|sent| sent.missed.is_some())
            && matches!(outcome, Outcome::Delivered { .. })
        {
            self.found += 1;
        }
        let sent = self.sent.get_mut(&number).expect("it was sent");
        let stream = (sent.sender, Arc::clone(&receiver));
        if let Some(open) = self.open.get_mut(&stream)
            && open.remove(&number)
        {
            self.open_bytes -= sent.size;
        }
        if sent.bound.is_some() && matches!(outcome, Outcome::Delivered { .. }) {
            self.slowest = self.slowest.max(self.now - sent.at);
        }
        if let Some(first) = sent.outcomes.insert(receiver, outcome.clone()) {
            self.breach(Invariant::OneOutcome, || {
                format!("letter {number}: {first}, then {outcome}")
            });
        }
        Ok(())
    }

    pub(super) fn read(&mut self, at: usize, agent: Incarnation) -> Result<(), Breach> {
        if !self.processes[at].alive {
            return Ok(());
        }
        // All at once without a pause, so that queues do not fill in calm weather.
        let most = match self.weather.reading_pause_ms > 1 {
            true => 1,
            false => usize::MAX,
        };
        let mut read = 0;
        while read < most && self.take(at, agent) {
            read += 1;
        }
        self.reading.remove(&agent);
        if self.processes[at].core.waiting(agent) > 0 {
            self.reading.insert(agent);
            self.after_ms(1 + self.weather.reading_pause_ms, Event::Read { at, agent });
        }
        self.carry_out(at)
    }

    /// An agent takes the next letter from its queue. Returns whether there was one.
    pub(super) fn take(&mut self, at: usize, agent: Incarnation) -> bool {
        let Some(received) = self.processes[at].core.take(agent) else {
            return false;
        };
        if received.via.is_none() {
            self.failures_told += 1;
            return true;
        }
        let number = match Message::decode(received.letter.payload()) {
            Ok(message) => message.content().and_then(|content| number_in(content)),
            Err(error) => {
                let (now, receiver) = (self.clocks(), Arc::clone(&self.names[&agent]));
                let core = &mut self.processes[at].core;
                if let Some(undecodable) = Undecodable::read(&received, &error) {
                    core.handle_undecodable(now, &receiver, undecodable);
                }
                None
            }
        };
        if self.is_hostile(received.sender) {
            return true;
        }
        let sent = number.and_then(|number| Some((number, self.sent.get(&number)?)));
        let own = sent.filter(|(_, sent)| sent.sender == received.sender);
        match own.map(|(number, _)| number) {
            Some(number) => self.check_take(agent, number),
            // A letter in the name of an ended registration harms no agent.
            None if !self.is_registered(received.sender) => {}
            None => self.breach(Invariant::NoForgery, || {
                let sender = received.sender;
                format!("{agent} took a letter in the name of {sender}, which has not sent it")
            }),
        }
        true
    }
}
