//! The delivery guarantees, as invariants.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use fipa_transport::counts::{Direction, Event, LetterOutcome};
use fipa_transport::{Attempt, FailureReason, Incarnation, Outcome, Parcel};

use super::links::transfer_time;
use super::{ATTEMPT_TIMEOUT, World};

/// Maximum backoff of a failed route.
const LONGEST_PENALTY: Duration = Duration::from_secs(5);
/// Pause for a busy receiver without a credit.
const BUSY_PAUSE: Duration = Duration::from_millis(100);

/// Maximum number of steps of a core per received byte.
const STEPS_PER_BYTE: f64 = 1.0;
/// Maximum number of steps of a core for one arrival, per letter that a lane may hold.
const MOST_STEPS: u64 = 8;

/// The invariants that must hold in every run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Invariant {
    /// The simulation itself is consistent, and watchers see what happens.
    World,
    /// One outcome for each receiver of a letter, within its deadline.
    OneOutcome,
    /// A registration takes the letters of one sender in the order of sending.
    Order,
    /// Of all registrations of a name, one takes a letter, once.
    AtMostOnce,
    /// A letter that is *delivered* was taken.
    NoFalseDelivered,
    /// A letter that was taken does not fail for certain.
    NoFalseFailure,
    /// A letter is not taken while an earlier one of the same sender to the same name, not taken
    /// yet, is open at its sender; so no letter fails because later ones were taken.
    NotPassedOver,
    /// A letter sent after all faults is delivered within a bound.
    Liveness,
    /// A receiver remembers every letter that can be open.
    Remembered,
    /// A letter to an agent that was registered on the sender's host before it was sent does not
    /// fail as unknown.
    Known,
    /// The reason of a failure is correct.
    Reason,
    /// A letter in the name of an honest agent was sent by it.
    NoForgery,
    /// No gateway relays letters between other hosts.
    NoRelay,
    /// The steps of cores are bounded by the received bytes.
    Work,
    /// A letter leaves a service a limited number of times, whatever other services answer.
    Repetitions,
    /// Without any fault no letter fails, and each failure is reported.
    Calm,
    /// The counters of a process agree with its queues and with the letters that it sent.
    Counted,
}

impl fmt::Display for Invariant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self, f)
    }
}

/// The first violation of each invariant.
pub(crate) type Breaches = BTreeMap<Invariant, String>;

impl World {
    pub(super) fn breach(&mut self, invariant: Invariant, text: impl FnOnce() -> String) {
        self.breaches.entry(invariant).or_insert_with(text);
    }

    /// Maximum time for the delivery of a letter of this size that is sent now, without further
    /// faults: two round trips, one backoff of the route, one attempt without an answer, and the
    /// transfer of the queued letters.
    pub(super) fn bound(&self, size: usize) -> Duration {
        let w = self.weather;
        let hops = Duration::from_millis(3 * 5 + 2 * w.local_ms);
        let answers = Duration::from_millis(3 * (w.answering_ms + 5));
        let transfer = transfer_time(self.open_bytes + size);
        // Letters ahead in a slow agent's queue count as queued.
        let open: usize = self.open.values().map(|open| open.len()).sum();
        let reading = match w.reading_pause_ms > 1 {
            true => (Duration::from_millis(w.reading_pause_ms + 2) + BUSY_PAUSE) * open as u32,
            false => Duration::ZERO,
        };
        (hops + answers) * 2 + LONGEST_PENALTY + ATTEMPT_TIMEOUT + transfer + reading
    }

    fn is_still_registered(&self, name: &str, registration: Incarnation) -> bool {
        let mut hosts = 0..self.weather.hosts;
        hosts.any(|host| self.agent_on(host, name) == Some(registration))
    }

    /// The agent of this name that a running process of this host has now.
    pub(super) fn agent_on(&self, host: usize, name: &str) -> Option<Incarnation> {
        let is_here = |at: &usize| self.processes[*at].host == host;
        let mut agents = self
            .robots()
            .filter(is_here)
            .flat_map(|at| &self.processes[at].agents);
        agents.find(|(other, _)| **other == *name).map(|it| it.1)
    }

    pub(super) fn check_deadline(&mut self, number: u64) {
        let sent = &self.sent[&number];
        let (known, expected) = (sent.outcomes.len(), sent.expected);
        if known < expected && self.processes[sent.process].alive {
            self.breach(Invariant::OneOutcome, || {
                format!("letter {number} has {known} of {expected} outcomes after its deadline")
            });
        }
    }

    /// Checks an outcome of a letter.
    pub(super) fn check_outcome(&mut self, number: u64, receiver: &str, outcome: &Outcome) {
        let Outcome::Failed { reason, attempts } = outcome else {
            return;
        };
        let missed = self.sent.get(&number).and_then(|sent| sent.missed);
        if let Some(missed) = missed
            && *reason == FailureReason::NoSuchAgent
            && self.is_still_registered(receiver, missed)
        {
            self.breach(Invariant::Known, || {
                format!("letter {number} to {receiver}: {outcome}")
            });
        }
        let forgotten = |attempt: &Attempt| attempt.error.detail == "too long ago to tell";
        if attempts.iter().any(forgotten) && !self.is_liars_name(receiver) {
            self.breach(Invariant::Remembered, || {
                format!("letter {number}: {outcome}")
            });
        }
        let by_full_queue = [
            FailureReason::QueueFull,
            FailureReason::NoSuchAgent,
            FailureReason::Unconfirmed,
        ];
        // With less time than a letter may take, the deadline is the reason.
        let sent = self.sent.get(&number);
        let is_patient = sent.is_some_and(|sent| sent.deadline >= Duration::from_secs(2));
        let slow = self.forecast.is_slow_only() && !self.forecast.liars;
        if slow && is_patient && !by_full_queue.contains(reason) {
            self.breach(Invariant::Reason, || {
                format!("letter {number} to {receiver} met a full queue at most: {outcome}")
            });
        }
    }

    /// Checks a letter that was sent by a closed service: it has already failed as such.
    pub(super) fn check_closed(&mut self, number: u64) {
        let sent = &self.sent[&number];
        let closed = |outcome: &Outcome| {
            matches!(outcome, Outcome::Failed { reason, attempts }
                if *reason == FailureReason::Closed && attempts.is_empty())
        };
        if sent.outcomes.len() != sent.expected || !sent.outcomes.values().all(closed) {
            let text = format!("letter {number} of a closed service: {:?}", sent.outcomes);
            self.breach(Invariant::Reason, || text);
        }
    }

    pub(super) fn check_liveness(&mut self, number: u64) {
        let sent = &self.sent[&number];
        let (Some(bound), [receiver]) = (sent.bound, &*sent.receivers) else {
            return;
        };
        let (w, outcome) = (self.weather, sent.outcomes.get(receiver));
        let was_refused = || {
            let key = (number, Arc::clone(receiver));
            self.refused.lock().contains(&key)
        };
        let why = match outcome {
            Some(Outcome::Delivered { .. }) => return,
            // Unconfirmed, if another attempt had no answer before.
            Some(Outcome::Failed {
                reason: FailureReason::Refused | FailureReason::Unconfirmed,
                ..
            }) if was_refused() => return,
            // The sender may try again, and will succeed.
            Some(Outcome::Failed {
                reason: FailureReason::QueueFull,
                attempts,
            }) if attempts.is_empty() && (w.lane < 1024 || w.lane_bytes < 64 << 20) => return,
            Some(outcome) => outcome.to_string(),
            None => "no outcome".to_owned(),
        };
        let quiet = sent.at - self.quiet;
        let text = format!(
            "letter {number} to {receiver}, sent {quiet:?} after the last fault with a deadline \
             of {:?}, was not delivered within {bound:?}: {why}",
            sent.deadline
        );
        self.breach(Invariant::Liveness, || text);
    }

    /// Checks a letter that a registration has accepted into its queue.
    pub(super) fn accepted(&mut self, agent: Incarnation, number: u64) {
        self.accepted.insert((agent, number));
        let sent = &self.sent[&number];
        let name = Arc::clone(&self.names[&agent]);
        let sender = &self.processes[sent.process];
        let registered = |(_, agent): &(Arc<str>, Incarnation)| *agent == sent.sender;
        if !sender.alive || !sender.agents.iter().any(registered) {
            return;
        }
        let Some(open) = self.open.get(&(sent.sender, Arc::clone(&name))) else {
            return;
        };
        let mut earlier = open.range(..number);
        if let Some(earlier) = earlier.find(|earlier| !self.accepted.contains(&(agent, **earlier)))
        {
            let text = format!("letter {number} was taken by {name} before {earlier}, still open");
            self.breach(Invariant::NotPassedOver, || text);
        }
    }

    /// Checks a letter that an agent has taken from its queue.
    pub(super) fn check_take(&mut self, agent: Incarnation, number: u64) {
        let sent = &self.sent[&number];
        let name = Arc::clone(&self.names[&agent]);
        if sent.known.is_some_and(|known| known != agent) {
            self.followed += 1;
        }
        let last = self.last_taken.insert((agent, sent.sender), number);
        if let Some(last) = last.filter(|last| *last >= number) {
            self.breach(Invariant::Order, || {
                format!("letter {number} was taken by {name} after {last} of the same sender")
            });
        }
        let before = self.taken.insert((Arc::clone(&name), number), agent);
        if let Some(before) = before {
            let which = match before == agent {
                true => "twice by the same registration",
                false => "by two registrations",
            };
            let outcome = self.sent[&number].outcomes.get(&name);
            let outcome = outcome.map_or("no outcome yet".into(), ToString::to_string);
            self.breach(Invariant::AtMostOnce, || {
                format!("letter {number} was taken {which} of {name}; {outcome}")
            });
        }
    }

    /// Checks a letter of a hostile member that was forwarded from one honest host to another.
    pub(super) fn check_no_relay(&mut self, from: usize, to: usize, parcel: &Parcel) {
        let [one, other] = [from, to].map(|at| &self.processes[at]);
        let honest = !one.hostile && !other.hostile;
        let Some(liars) = self
            .liars
            .as_ref()
            .filter(|_| honest && one.host != other.host)
        else {
            return;
        };
        let sender = parcel.stream.sender;
        if liars.is_of_gateway(sender) {
            let text = format!("a letter of {sender} is passed on from {from} to {to}");
            self.breach(Invariant::NoRelay, || text);
        }
    }

    /// Checks the counters at the end, when each letter has its outcome.
    fn check_counters(&mut self) {
        let mut breaches = Vec::new();
        for process in self.processes.iter().filter(|it| it.alive && !it.hostile) {
            let totals = process.counts.totals();
            let outcomes = LetterOutcome::ALL.into_iter();
            let settled: u64 = outcomes
                .map(|outcome| totals.all_letters(Direction::Sent, outcome))
                .sum();
            let submitted = totals.events(Event::Submitted);
            let taken = totals.all_letters(Direction::Received, LetterOutcome::Delivered);
            let read = totals.events(Event::Read);
            let agents = process.agents.iter();
            let queued: usize = agents.map(|(_, agent)| process.core.waiting(*agent)).sum();
            if submitted != settled || taken.checked_sub(read) != Some(queued as u64) {
                breaches.push(format!(
                    "{submitted} submitted and {settled} settled; {taken} taken, {read} read and {queued} queued"
                ));
            }
        }
        for text in breaches {
            self.breach(Invariant::Counted, || text);
        }
    }

    pub(super) fn check_end(&mut self) {
        self.check_counters();
        let mut failed = 0;
        let mut breaches = Vec::new();
        for (number, sent) in &self.sent {
            for (receiver, outcome) in &sent.outcomes {
                if self.is_liars_name(receiver) {
                    // Hostile members determine the outcomes of these.
                    continue;
                }
                let key = (Arc::clone(receiver), *number);
                let was_taken = self.taken.contains_key(&key);
                let was_refused = || {
                    let key = (*number, Arc::clone(receiver));
                    self.refused.lock().contains(&key)
                };
                match outcome {
                    Outcome::Delivered { .. } if !was_taken => breaches.push((
                        Invariant::NoFalseDelivered,
                        format!("letter {number} to {receiver} is lost: {outcome}"),
                    )),
                    Outcome::Failed { reason, .. }
                        if was_taken && *reason != FailureReason::Unconfirmed =>
                    {
                        breaches.push((
                            Invariant::NoFalseFailure,
                            format!("letter {number} was taken by {receiver}, but {outcome}"),
                        ));
                    }
                    Outcome::Failed {
                        reason: FailureReason::Refused,
                        ..
                    } if !was_refused() => breaches.push((
                        Invariant::NotPassedOver,
                        format!("letter {number} to {receiver}, which no gate refused: {outcome}"),
                    )),
                    Outcome::Failed { reason, .. } => {
                        failed += 1;
                        if self.forecast.is_calm() && *reason != FailureReason::NoSuchAgent {
                            let text = format!("letter {number} in calm weather: {outcome}");
                            breaches.push((Invariant::Calm, text));
                        }
                    }
                    _ => {}
                }
            }
        }
        for (invariant, text) in breaches {
            self.breach(invariant, || text);
        }
        let (per_byte, most) = self.work();
        let one = MOST_STEPS * self.forecast.lane as u64;
        if per_byte > STEPS_PER_BYTE || most > one {
            self.breach(Invariant::Work, || {
                format!("{per_byte} steps for each byte, {most} for one arrival")
            });
        }
        let reported = self.failures_told;
        if self.forecast.is_calm() && !self.forecast.liars && failed != reported {
            self.breach(Invariant::Calm, || {
                format!("{failed} failures, {reported} reported")
            });
        }
        let mut living = self.processes.iter().filter(|process| process.alive);
        if living.any(|process| !process.hostile && process.core.has_open_letters()) {
            self.breach(Invariant::OneOutcome, || {
                "letters are still open at the end".into()
            });
        }
    }
}
