//! Hostile members: the gateway of one more host, which has keys and is trusted, and a process of
//! the first host. They send false data in every field, at any time, with the incarnations of
//! honest agents and services, and with sequence numbers and hand-overs of honest letters. They
//! cannot forge what a link proves: the certificate of the gateway, the mailbox of the process.
//!
//! The process uses its own name or an agent of the hostile gateway as the sender of its letters:
//! processes of one user are not isolated from each other.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{AgentId, Envelope, EnvelopeParams, Letter, Message, Performative, Received, Time};
use fipa_mts::core::{Core, CoreConfig, MAX_DEADLINE};
use fipa_mts::letter_for;
use fipa_sds::{Directory, Role};
use fipa_transport::{
    Answer, Attempt, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Introduction,
    Kind, Mandate, Outcome, Parcel, Principal, Report, Stream, TransportError, TransportErrorKind,
};

use super::links::{Ends, Flown};
use super::view::{Registered, View, way};
use super::{AGENTS, Breach, Event, PROCESSES, Process, Set, World};

/// Maximum number of observed parcel headers.
const OVERHEARD: usize = 64;
/// Maximum number of letters that the hostile members were handed.
const HANDED: usize = 32;
/// Maximum pause between two false messages.
const PAUSE_MS: u64 = 12;
/// Fraction of letters that honest agents send to agents of hostile members.
pub(super) const TO_LIARS: f64 = 0.1;

/// Maximum time for which the hostile members answer every letter alike.
const HABIT_MS: u64 = 1500;

/// A way to answer every letter, with which a hostile member tries to have it sent again and again.
#[derive(Debug, Clone, Copy)]
enum Habit {
    Returned,
    /// As out of order. The last letter is the predecessor, or a letter near it.
    OutOfOrder,
    /// *Busy*, followed by a credit.
    BusyAndCredit,
    /// Custody, followed by a report *returned*.
    CustodyAndReturn,
    /// The connection breaks.
    Broken,
    /// Each letter in another of these ways.
    Mixed,
}

/// State of the hostile members.
pub(super) struct Liars {
    /// The hostile gateway, and the hostile process on the first host.
    pub(super) at: [usize; 2],
    agents: Vec<(Arc<str>, Incarnation)>,
    overheard: Vec<Parcel>,
    handed: Vec<Letter>,
    /// Answers to deferred arrivals: the process that waits, and its attempt.
    owed: Vec<(usize, AttemptId)>,
    /// Introductions with open connections, and their targets.
    introduced: Vec<(usize, Introduction)>,
    attempts: u64,
    /// The present habit, and the time of the next one. Drawn apart from everything else.
    habit: Option<Habit>,
    next_habit: Instant,
    habits: fastrand::Rng,
    /// Agents that are or were in a process's directory.
    learnt: Set<(usize, Incarnation)>,
}

impl Liars {
    /// Whether this is an agent of the hostile gateway.
    pub(super) fn is_of_gateway(&self, agent: Incarnation) -> bool {
        let mut agents = self.agents.iter();
        agents.any(|(name, incarnation)| *incarnation == agent && !name.starts_with("liar_p"))
    }
}

/// The proof of a link with a gateway of this host.
pub(super) fn certificate(host: usize) -> Principal {
    Principal::Certificate([u8::try_from(host).unwrap_or(u8::MAX); 32])
}

impl World {
    /// Adds the hostile gateway and the hostile process.
    pub(super) fn admit_liars(&mut self) {
        let known = vec![self.start; self.weather.hosts];
        let mut at = [0; 2];
        for (place, host, gateway) in [(0, self.weather.hosts, true), (1, 0, false)] {
            let incarnation = self.incarnation();
            let view = View {
                registry: Arc::clone(&self.registry),
                host,
                gateway,
                mts: incarnation,
            };
            let config = CoreConfig::new("liar", incarnation, vec![Kind::Tcp]);
            at[place] = self.processes.len();
            self.by_incarnation.insert(incarnation, at[place]);
            self.processes.push(Process {
                host,
                gateway,
                hostile: true,
                incarnation,
                core: Core::new(config, Arc::new(view)),
                counts: Arc::default(),
                agents: Vec::new(),
                open: std::collections::BTreeMap::new(),
                tickets: super::Map::default(),
                next_ticket: 0,
                alive: true,
                closed: None,
                wake: None,
            });
        }
        let mut agents = Vec::new();
        let gateway = self.processes[at[0]].incarnation;
        let own = (String::from("liar"), gateway, Role::Gateway, 0);
        let mut all = vec![own];
        for agent in 0..AGENTS {
            let (one, other) = (self.incarnation(), self.incarnation());
            all.push((format!("liar_{agent}"), one, Role::Agent, 0));
            all.push((format!("liar_p_{agent}"), other, Role::Agent, 1));
        }
        for (name, incarnation, role, place) in all {
            let name: Arc<str> = name.as_str().into();
            self.names.insert(incarnation, Arc::clone(&name));
            if role == Role::Agent {
                agents.push((Arc::clone(&name), incarnation));
            }
            self.registry.lock().register(Registered {
                name,
                incarnation,
                host: self.processes[at[place]].host,
                mts: self.processes[at[place]].incarnation,
                role,
                since: self.now,
                ended: None,
                known: known.clone(),
                left_at: Vec::new(),
            });
        }
        self.liars = Some(Liars {
            at,
            agents,
            overheard: Vec::new(),
            handed: Vec::new(),
            owed: Vec::new(),
            introduced: Vec::new(),
            attempts: 0,
            habit: None,
            next_habit: self.start,
            habits: fastrand::Rng::with_seed(self.seed.wrapping_mul(31)),
            learnt: Set::default(),
        });
        self.at(self.start, Event::Lie);
    }

    /// Two gateways open a connection with each other.
    pub(super) fn meet(&mut self, one: usize, other: usize) {
        let are_gateways = [one, other]
            .iter()
            .all(|at| self.processes[*at].gateway && self.processes[*at].alive);
        if !self.weather.liars || !are_gateways || !self.met.insert((one, other)) {
            return;
        }
        self.met.insert((other, one));
        let now = self.clocks();
        self.trace(|| format!("{one} and {other} meet"));
        for (at, peer) in [(one, other), (other, one)] {
            let introduction = self.introduction_of(peer);
            self.processes[at]
                .core
                .handle_introduced(now, &introduction);
        }
    }

    /// Closes the connections of this gateway.
    pub(super) fn part(&mut self, gone: usize) {
        if !self.weather.liars || !self.processes[gone].gateway {
            return;
        }
        let now = self.clocks();
        let introduction = self.introduction_of(gone);
        for (at, process) in self.processes.iter_mut().enumerate() {
            if process.alive && self.met.contains(&(at, gone)) {
                process.core.handle_disconnected(now, &introduction);
            }
        }
    }

    fn introduction_of(&self, gateway: usize) -> Introduction {
        let Process {
            host, incarnation, ..
        } = self.processes[gateway];
        let address = self.registry.lock().present_address(host, Kind::Tcp);
        Introduction {
            name: format!("gateway{host}").into(),
            hop: Hop {
                location: way(Kind::Tcp, incarnation, address),
                principal: certificate(host),
            },
            dialed: None,
            mandate: Mandate::Certified([].into()),
        }
    }

    /// Whether this registration belongs to an agent of a hostile member, or to none.
    pub(super) fn is_hostile(&self, sender: Incarnation) -> bool {
        self.liars.is_some() && !self.honest.contains(&sender)
    }

    /// Whether an agent of a running process has this registration.
    pub(super) fn is_registered(&self, agent: Incarnation) -> bool {
        let mut living = self.processes.iter().filter(|process| process.alive);
        living.any(|process| process.agents.iter().any(|(_, it)| *it == agent))
    }

    pub(super) fn is_liars_name(&self, name: &str) -> bool {
        self.liars.is_some() && name.starts_with("liar")
    }

    /// The name of an agent of a hostile member.
    pub(super) fn name_of_liar(&mut self) -> Option<Arc<str>> {
        let liars = self.liars.as_ref()?;
        let (name, _) = &liars.agents[self.random.usize(..liars.agents.len())];
        Some(Arc::clone(name))
    }

    /// Records the headers of parcels that honest members send.
    pub(super) fn overhear(&mut self, parcel: &Parcel) {
        if let Some(liars) = &mut self.liars {
            if liars.overheard.len() >= OVERHEARD {
                let place = self.random.usize(..liars.overheard.len());
                liars.overheard.swap_remove(place);
            }
            liars.overheard.push(Parcel {
                // They do not have the letters of others.
                body: Body::Credit,
                ..parcel.clone()
            });
        }
    }

    /// A parcel arrives at a hostile member, which answers arbitrarily, or out of habit.
    pub(super) fn answer_falsely(
        &mut self,
        ends: Ends,
        kind: Kind,
        attempt: AttemptId,
        parcel: Parcel,
    ) {
        if let Body::Letter(_) = &parcel.body
            && let Some(habit) = self.habit()
        {
            return self.answer_out_of_habit(ends, kind, attempt, (parcel, habit));
        }
        let from = ends.from;
        let answers = self.random.u32(..8);
        let answer = self.false_answer(parcel.sequence);
        let Some(liars) = &mut self.liars else { return };
        if let Body::Letter(letter) = parcel.body {
            if liars.handed.len() >= HANDED {
                liars.handed.remove(0);
            }
            liars.handed.push(letter);
        }
        match answers {
            0 => {}
            1 | 2 => liars.owed.push((from, attempt)),
            3 => {
                let custody = Conclusion::Answered(Answer::Custody);
                self.conclude_within(20, from, attempt, custody);
            }
            _ => self.conclude_within(20, from, attempt, Conclusion::Answered(answer)),
        }
    }

    /// The present habit of the hostile members, if they have one.
    fn habit(&mut self) -> Option<Habit> {
        let (now, ends) = (self.now, self.quiet + super::traffic::AFTER);
        let Liars {
            habit,
            next_habit,
            habits,
            ..
        } = self.liars.as_mut()?;
        if now > ends {
            return None;
        }
        if *next_habit <= now {
            let all = [
                Habit::Returned,
                Habit::OutOfOrder,
                Habit::BusyAndCredit,
                Habit::CustodyAndReturn,
                Habit::Broken,
                Habit::Mixed,
            ];
            // Half of the time there is none.
            *habit = all.get(habits.usize(..2 * all.len())).copied();
            *next_habit = now + Duration::from_millis(habits.u64(50..HABIT_MS));
        }
        match habit {
            Some(Habit::Mixed) => habits.choice([
                Habit::Returned,
                Habit::OutOfOrder,
                Habit::BusyAndCredit,
                Habit::CustodyAndReturn,
            ]),
            habit => *habit,
        }
    }

    fn answer_out_of_habit(
        &mut self,
        ends: Ends,
        kind: Kind,
        attempt: AttemptId,
        (parcel, habit): (Parcel, Habit),
    ) {
        let Ends { from, to } = ends;
        let uncertain = false;
        let (conclusion, note) = match habit {
            Habit::Returned | Habit::Mixed => (Answer::Returned { uncertain }, None),
            Habit::OutOfOrder => {
                let liars = self.liars.as_mut();
                let more = liars.map_or(0, |liars| liars.habits.u64(..3));
                let last = parcel.after.saturating_add(more).saturating_sub(1);
                (Answer::OutOfOrder { last }, None)
            }
            Habit::BusyAndCredit => (Answer::Busy, Some(Body::Credit)),
            Habit::CustodyAndReturn => {
                let report = Report::Returned { uncertain };
                (Answer::Custody, Some(Body::Report(report)))
            }
            Habit::Broken => {
                let error = TransportError::new(TransportErrorKind::Broken, "a lie");
                return self.conclude_within(1, from, attempt, Conclusion::Unconfirmed(error));
            }
        };
        self.conclude_within(1, from, attempt, Conclusion::Answered(conclusion));
        let Some(body) = note else { return };
        let note = Parcel {
            remaining: Duration::ZERO,
            body,
            ..parcel
        };
        let attempts = self.liars.as_mut().map_or(0, |liars| {
            liars.attempts += 1;
            liars.attempts
        });
        let named = self.processes[to].incarnation;
        let flown = Flown::lie(
            Ends { from: to, to: from },
            kind,
            (AttemptId(attempts), note),
            named,
        );
        let arrives = self.now + Duration::from_millis(2);
        self.at(arrives, Event::Arrive(Box::new(flown)));
    }

    fn false_answer(&mut self, sequence: u64) -> Answer {
        match self.random.u32(..8) {
            0 => Answer::Accepted,
            1 => Answer::Custody,
            2 => Answer::Busy,
            3 => Answer::OutOfOrder {
                last: self.false_number(sequence),
            },
            4 | 5 => Answer::Returned {
                uncertain: self.random.bool(),
            },
            6 => Answer::Moved,
            _ => Answer::failed(self.false_reason(), "a lie"),
        }
    }

    fn false_reason(&mut self) -> FailureReason {
        let reasons = [
            FailureReason::NoSuchAgent,
            FailureReason::QueueFull,
            FailureReason::Refused,
            FailureReason::TooLarge,
            FailureReason::TimedOut,
            FailureReason::Unreachable,
            FailureReason::Unconfirmed,
            FailureReason::Loop,
            FailureReason::Closed,
        ];
        reasons[self.random.usize(..reasons.len())]
    }

    /// A number near this one, at an end of the range, or arbitrary.
    fn false_number(&mut self, near: u64) -> u64 {
        match self.random.u32(..12) {
            0 => 0,
            1 => 1 << 48,
            2 => u64::MAX,
            3 => self.random.u64(..),
            4 => near.wrapping_add(self.random.u64(1..4)),
            5 => near.wrapping_sub(self.random.u64(1..4)),
            _ => near,
        }
    }

    fn false_duration(&mut self) -> Duration {
        match self.random.u32(..5) {
            0 => Duration::ZERO,
            1 => Duration::MAX,
            2 => MAX_DEADLINE,
            _ => Duration::from_millis(self.random.u64(1..5000)),
        }
    }

    fn false_outcome(&mut self, target: usize) -> Outcome {
        let via = match self.random.bool() {
            true => Kind::Tcp,
            false => Kind::Shm,
        };
        let attempts = (0..self.random.usize(..3))
            .map(|_| Attempt {
                via,
                location: way(via, self.processes[target].incarnation, 0),
                error: TransportError::new(TransportErrorKind::TimedOut, "a lie"),
            })
            .collect();
        match self.random.u32(..4) {
            0 => Outcome::Delivered { via, attempts },
            1 => Outcome::Sent { via, attempts },
            _ => Outcome::Failed {
                reason: self.false_reason(),
                attempts,
            },
        }
    }

    /// A letter with a false or corrupted message and false stamps.
    fn false_letter(&mut self, target: usize) -> Option<Letter> {
        let handed = self.liars.as_ref().map_or(0, |liars| liars.handed.len());
        let mut letter = match self.random.u32(..4) {
            // Large ones would fill the queues of slow readers.
            0 if handed > 0 && self.weather.reading_pause_ms == 1 => {
                let place = self.random.usize(..handed);
                self.liars.as_ref()?.handed[place].clone()
            }
            _ => {
                let process = self.random.usize(..PROCESSES);
                let host = self.random.usize(..self.weather.hosts);
                let sender = format!("h{host}_p{process}_0");
                let message = Message::builder(Performative::Inform)
                    .sender(AgentId::new(&sender).ok()?)
                    .receiver(AgentId::new("h0_p0_0").ok()?)
                    .content("a lie")
                    .build()
                    .ok()?;
                letter_for(&message, self.clocks().utc).ok()?
            }
        };
        if self.random.u32(..8) == 0 {
            let (name, id) = self.stamp_of(target);
            let received = Received {
                by: name,
                date: Time::from_system_time(self.clocks().utc).ok()?,
                from: None,
                id: Some(id.to_string()),
                via: None,
                user_defined: Vec::new(),
            };
            let stamp = Envelope::encode_extension(&EnvelopeParams {
                received: Some(received),
                ..EnvelopeParams::default()
            });
            letter = letter.stamped(stamp.ok()?);
        } else if self.random.u32(..8) == 0 {
            letter = letter.stamped(Bytes::from_static(b"no stamp"));
        }
        Some(letter)
    }

    fn stamp_of(&self, target: usize) -> (String, Incarnation) {
        let process = &self.processes[target];
        (format!("gateway{}", process.host), process.incarnation)
    }

    /// Any incarnation: of an agent, of a gateway or process, of a liar, or of none.
    fn any_incarnation(&mut self, target: usize) -> Incarnation {
        match self.random.u32(..10) {
            0 => Incarnation::UNKNOWN,
            1 => self.incarnation(),
            2 => self.processes[target].incarnation,
            3 => {
                let at = self.random.usize(..self.processes.len());
                self.processes[at].incarnation
            }
            4 | 5 => {
                let remote = self.random.bool();
                self.own_incarnation(remote)
            }
            _ => {
                let at = self.random.usize(..self.processes.len());
                let agents = &self.processes[at].agents;
                let agent = match agents.len() {
                    0 => return self.own_incarnation(true),
                    some => agents[self.random.usize(..some)].1,
                };
                match self.is_known(agent, target) {
                    true => agent,
                    false => self.own_incarnation(true),
                }
            }
        }
    }

    /// Whether this registration is or was in the directory of the target. Before that it belongs
    /// to the first link that uses it, whichever that is.
    fn is_known(&mut self, agent: Incarnation, target: usize) -> bool {
        let known = self.view(target).known_incarnation(agent).is_some();
        self.liars.as_mut().is_some_and(|liars| match known {
            true => {
                liars.learnt.insert((target, agent));
                true
            }
            false => liars.learnt.contains(&(target, agent)),
        })
    }

    /// An agent of this hostile member.
    fn own_incarnation(&mut self, remote: bool) -> Incarnation {
        let Some(liars) = &self.liars else {
            return Incarnation::UNKNOWN;
        };
        let agents = liars.agents.iter().map(|(_, agent)| *agent);
        let own: Vec<Incarnation> = agents
            .filter(|agent| liars.is_of_gateway(*agent) == remote)
            .collect();
        own[self.random.usize(..own.len())]
    }

    /// Sends one more false message.
    pub(super) fn lie(&mut self) -> Result<(), Breach> {
        if self.now <= self.quiet + super::traffic::AFTER {
            let pause = Duration::from_micros(self.random.u64(100..PAUSE_MS * 1000));
            self.at(self.now + pause, Event::Lie);
        }
        let Some(at) = self.liars.as_ref().map(|liars| liars.at) else {
            return Ok(());
        };
        let liar = at[usize::from(self.random.u32(..4) == 0)];
        let remote = self.processes[liar].gateway;
        let targets: Vec<usize> = (0..self.processes.len())
            .filter(|other| {
                let process = &self.processes[*other];
                let within_reach = match remote {
                    true => process.gateway,
                    false => process.host == self.processes[liar].host,
                };
                process.alive && !process.hostile && within_reach
            })
            .collect();
        let Some(&target) = self.random.choice(&targets) else {
            return Ok(());
        };
        match self.random.u32(..12) {
            0 if remote => self.introduce_falsely(liar, target),
            1 => {
                let owed = self.liars.as_mut().and_then(|liars| liars.owed.pop());
                if let Some((to, attempt)) = owed {
                    let answer = self.false_answer(1);
                    self.conclude_within(2, to, attempt, Conclusion::Answered(answer));
                }
                Ok(())
            }
            _ => self.send_falsely(liar, target),
        }
    }

    /// A greeting in the name of any service, or the end of a connection with one.
    fn introduce_falsely(&mut self, liar: usize, target: usize) -> Result<(), Breach> {
        let now = self.clocks();
        let ended = self.random.u32(..3) == 0;
        let known = self.liars.as_mut().and_then(|liars| {
            let place = liars.introduced.iter().position(|(at, _)| *at == target);
            place
                .filter(|_| ended)
                .map(|it| liars.introduced.swap_remove(it).1)
        });
        if let Some(introduction) = known {
            self.processes[target]
                .core
                .handle_disconnected(now, &introduction);
            return self.carry_out(target);
        }
        let mut service = match self.random.bool() {
            true => self.processes[liar].incarnation,
            false => self.any_incarnation(target),
        };
        let gateway = self.by_incarnation.get(&service).copied();
        if gateway.is_some_and(|gateway| !self.met.contains(&(target, gateway))) {
            // A service belongs to the first certificate that it is introduced with.
            service = self.processes[liar].incarnation;
        }
        // Its certificate proves its name.
        let host = self.processes[liar].host;
        let introduction = Introduction {
            name: format!("gateway{host}").into(),
            hop: Hop {
                location: way(Kind::Tcp, service, 0),
                principal: certificate(self.processes[liar].host),
            },
            dialed: None,
            mandate: Mandate::Certified([].into()),
        };
        self.trace(|| format!("{liar} introduces itself to {target} as {service}"));
        let core = &mut self.processes[target].core;
        core.handle_introduced(now, &introduction);
        if let Some(liars) = &mut self.liars {
            liars.introduced.push((target, introduction));
        }
        self.carry_out(target)
    }

    fn send_falsely(&mut self, liar: usize, target: usize) -> Result<(), Breach> {
        let remote = self.processes[liar].gateway;
        let overheard = self.liars.as_ref().map_or(0, |liars| liars.overheard.len());
        let known = match overheard > 0 && self.random.u32(..8) > 0 {
            true => {
                let place = self.random.usize(..overheard);
                self.liars
                    .as_ref()
                    .map(|liars| liars.overheard[place].clone())
            }
            false => None,
        };
        let mut parcel = known.unwrap_or_else(|| Parcel {
            receiver: "h0_p0_0".into(),
            stream: Stream::between(Incarnation::UNKNOWN, Incarnation::UNKNOWN),
            sequence: 1,
            after: 0,
            transfer: 1,
            remaining: Duration::from_secs(1),
            body: Body::Credit,
        });
        let mut changes = |share: u32| self.random.u32(..share) == 0;
        let [sender, receiver, name, sequence, after, transfer, remaining] =
            [4, 6, 8, 3, 3, 3, 3].map(&mut changes);
        if sender || !parcel.stream.sender.is_known() {
            parcel.stream.sender = self.any_incarnation(target);
        }
        if receiver || !parcel.stream.receiver.is_known() {
            parcel.stream.receiver = self.any_incarnation(target);
        }
        if let Some(known) = self.names.get(&parcel.stream.receiver)
            && !name
        {
            parcel.receiver = Arc::clone(known);
        }
        if sequence {
            parcel.sequence = self.false_number(parcel.sequence);
        }
        if after {
            parcel.after = match self.random.bool() {
                true => parcel.sequence.saturating_sub(self.random.u64(1..4)),
                false => self.false_number(parcel.sequence),
            };
        }
        if transfer {
            parcel.transfer = self.false_number(parcel.transfer);
        }
        if remaining {
            parcel.remaining = self.false_duration();
        }
        parcel.body = match self.random.u32(..10) {
            0..=3 => match self.false_letter(target) {
                Some(letter) => Body::Letter(letter),
                None => return Ok(()),
            },
            4 | 5 => Body::Report(Report::Settled(self.false_outcome(target))),
            6 => Body::Report(Report::Returned {
                uncertain: self.random.bool(),
            }),
            7 => Body::Report(Report::Moved),
            8 => Body::Credit,
            _ => Body::Predecessor,
        };
        let is_letter = matches!(parcel.body, Body::Letter(_));
        let sender = parcel.stream.sender;
        let is_unheard = !self.is_hostile(sender) && !self.is_known(sender, target);
        if is_letter && (!remote || is_unheard) {
            parcel.stream.sender = self.own_incarnation(remote);
        }
        let kind = match (self.random.bool(), remote) {
            (true, true) => Kind::Udp,
            (true, false) => Kind::Shm,
            (false, _) => Kind::Tcp,
        };
        // Its greeting may name any service, its mailbox only itself.
        let named = match remote && self.random.u32(..3) == 0 {
            true => self.any_incarnation(target),
            false => self.processes[liar].incarnation,
        };
        let attempts = self.liars.as_mut().map_or(0, |liars| {
            liars.attempts += 1;
            liars.attempts
        });
        let attempt = AttemptId(attempts);
        let flown = Flown::lie(
            Ends {
                from: liar,
                to: target,
            },
            kind,
            (attempt, parcel),
            named,
        );
        self.after_ms(5, Event::Arrive(Box::new(flown)));
        Ok(())
    }
}
