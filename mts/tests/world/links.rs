//! Links between processes, which lose, delay and refuse parcels, and never reorder them.
//!
//! This module simulates the interface between core and transports: dispatch, abandon, answer and
//! arrival.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Hop, Incarnation, Kind, Location, Parcel,
    Principal, Reaction, Ticket, TransportError, TransportErrorKind,
};

#[cfg(debug_assertions)]
use fipa_mts::core::work;

use super::gates::number_of;
use super::liar::certificate;
use super::view::{address_of, way};
use super::{Breach, Event, World};

/// Bytes per second between two hosts, by transport. A full window of the largest letters takes
/// less time than the timeout of an attempt.
pub(super) const BYTES_PER_SECOND: u64 = 4_000_000;
/// Bytes that a connection accepts before parcels wait in the sender's outbox.
const SOCKET: usize = 16 << 10;
/// Largest letter in a datagram.
pub(super) const MAX_DATAGRAM: usize = 8 << 10;

/// Number of unanswered parcels from one process to another at which shared memory refuses a letter, and another
/// parcel.
const PLACES: (usize, usize) = (8, 10);

/// Number of parcels of one sender that shared memory answers later.
const LATE_ANSWERS: usize = 3;

/// Minimum number of bytes that a parcel's header counts as.
const HEADER: usize = 64;

/// One direction between two processes.
pub(super) struct Link {
    /// Arrival of the last parcel: links keep their order.
    arrives: Instant,
    /// Parcels that have not been transmitted, by the end of their transmission.
    queue: VecDeque<(Instant, usize)>,
}

/// An attempt without a conclusion.
pub(super) struct Flight {
    /// Its target; `usize::MAX` for none.
    to: usize,
    kind: Kind,
    /// Time at which its first byte leaves; `None` if none ever does.
    leaves: Option<Instant>,
    /// Its arrival event.
    event: Option<u64>,
    /// The link that it waits for, and the end of its transmission.
    queued: Option<((usize, usize, Kind), Instant)>,
}

/// A parcel that is about to arrive.
pub(super) struct Flown {
    from: usize,
    to: usize,
    kind: Kind,
    attempt: AttemptId,
    parcel: Parcel,
    /// Whether its answer is lost.
    mute: bool,
    /// Whether it is a duplicate.
    copy: bool,
    /// The service that its link claims, if that is not its sender.
    named: Option<Incarnation>,
}

/// The indices of two processes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ends {
    pub(super) from: usize,
    pub(super) to: usize,
}

impl Flown {
    /// A parcel of a hostile member, on a link that claims this service.
    pub(super) fn lie(
        ends: Ends,
        kind: Kind,
        (attempt, parcel): (AttemptId, Parcel),
        named: Incarnation,
    ) -> Self {
        Self {
            from: ends.from,
            to: ends.to,
            kind,
            attempt,
            parcel,
            mute: false,
            copy: false,
            named: Some(named),
        }
    }
}

fn error(fault: TransportErrorKind) -> TransportError {
    TransportError::new(fault, "simulated")
}

impl World {
    pub(super) fn dispatch(
        &mut self,
        at: usize,
        attempt: AttemptId,
        location: &Location,
        parcel: Parcel,
    ) {
        let kind = location.kind();
        let host = self.processes[at].host;
        self.trace(|| {
            format!(
                "{at} dispatches {} to {location}",
                text_of(attempt, &parcel)
            )
        });
        self.overhear(&parcel);
        self.note_dispatch(at, attempt, &parcel);
        let target = self.by_incarnation.get(&location.incarnation()).copied();
        let target = target.filter(|target| self.processes[*target].alive);
        let flight = Flight {
            to: target.unwrap_or(usize::MAX),
            kind,
            leaves: None,
            event: None,
            queued: None,
        };
        let has_room = kind != Kind::Shm || self.has_places(at, flight.to, &parcel);
        self.processes[at].open.insert(attempt, flight);
        if !has_room {
            let conclusion = Conclusion::NotSent(error(TransportErrorKind::Congested));
            return self.conclude_within(0, at, attempt, conclusion);
        }
        let remote = target.is_some_and(|p| self.processes[p].host != host);
        let size = size_of(&parcel);
        if kind == Kind::Udp && size > MAX_DATAGRAM {
            let conclusion = Conclusion::NotSent(error(TransportErrorKind::TooLarge));
            self.conclude_within(0, at, attempt, conclusion);
            return;
        }
        let down = self.down.contains(&(host, kind))
            || target.is_some_and(|p| self.down.contains(&(self.processes[p].host, kind)));
        let unreachable = || Conclusion::NotSent(error(TransportErrorKind::Unreachable));
        let Some(to) = target.filter(|_| !down) else {
            return self.conclude_within(3, at, attempt, unreachable());
        };
        if remote && !self.is_present(to, location) {
            // Some networks report an address without a host, others drop the packets.
            if self.random.bool() {
                self.conclude_within(3, at, attempt, unreachable());
            }
            return;
        }
        let mut luck = self.random.f64();
        let mut happens = |rate: f64| {
            luck -= rate;
            luck < 0.0
        };
        let w = self.weather;
        if happens(w.refusal) {
            return self.conclude_within(3, at, attempt, unreachable());
        }
        let (lost, silent) = (happens(w.loss), happens(w.silence));
        if lost || silent || self.is_cut(at, to) {
            self.fly(at, attempt, Some(self.now), None);
            if lost {
                let conclusion = Conclusion::Unconfirmed(error(TransportErrorKind::Broken));
                self.conclude_within(50, at, attempt, conclusion);
            }
            return;
        }
        let mute = happens(w.answer_loss);
        let mut strays = |rate: f64| remote && rate > 0.0 && self.random.f64() < rate;
        let (copied, late) = (strays(w.copies), strays(w.overtaken));
        let arrive = |parcel, copy| {
            Event::Arrive(Box::new(Flown {
                from: at,
                to,
                kind,
                attempt,
                parcel,
                mute,
                copy,
                named: None,
            }))
        };
        if copied {
            let arrives = self.after_ms(w.late_ms, arrive(parcel.clone(), true));
            self.fault_until(arrives);
        }
        if late {
            let delay = Duration::from_micros(self.random.u64(..=w.late_ms * 1000));
            let arrives = self.now + delay;
            let event = self.at(arrives, arrive(parcel, false));
            self.fly(at, attempt, Some(self.now), Some(event));
            return self.fault_until(arrives);
        }
        let (leaves, done, arrives) = self.transmit(Ends { from: at, to }, kind, remote, size);
        let event = self.at(arrives, arrive(parcel, false));
        self.fly(at, attempt, Some(leaves), Some(event));
        if let Some(flight) = self.processes[at].open.get_mut(&attempt) {
            flight.queued = Some(((at, to, kind), done));
        }
    }

    /// Whether shared memory has a place for this parcel.
    fn has_places(&self, at: usize, to: usize, parcel: &Parcel) -> bool {
        let open = self.processes[at].open.values();
        let open = open.filter(|flight| flight.kind == Kind::Shm && flight.to == to);
        open.count()
            < match parcel.body {
                Body::Letter(_) => PLACES.0,
                _ => PLACES.1,
            }
    }

    /// The times at which a parcel leaves its process, is transmitted, and arrives.
    fn transmit(
        &mut self,
        Ends { from: at, to }: Ends,
        kind: Kind,
        remote: bool,
        size: usize,
    ) -> (Instant, Instant, Instant) {
        let now = self.now;
        let mut delay = Duration::from_micros(self.random.u64(20..5000));
        if !remote {
            let more = self.random.u64(..=self.weather.local_ms * 1000);
            delay += Duration::from_micros(more);
        }
        let hosts = [self.processes[at].host, self.processes[to].host];
        let stalled = hosts.iter().filter_map(|host| self.stalled.get(host));
        let stalled = stalled
            .max()
            .copied()
            .filter(|_| remote && kind == Kind::Tcp);
        let link = self.links.entry((at, to, kind)).or_insert_with(|| Link {
            arrives: now,
            queue: VecDeque::new(),
        });
        while link.queue.front().is_some_and(|(done, _)| *done <= now) {
            link.queue.pop_front();
        }
        let mut leaves = now;
        let mut ahead: usize = link.queue.iter().map(|(_, size)| size).sum();
        for (done, size) in &link.queue {
            if kind != Kind::Tcp || ahead < SOCKET {
                break;
            }
            (leaves, ahead) = (*done, ahead - size);
        }
        let free = link.queue.back().map_or(now, |(done, _)| *done);
        let begins = free.max(stalled.unwrap_or(now)).max(now);
        let done = match remote {
            true => begins + transfer_time(size),
            false => now,
        };
        if done > now {
            link.queue.push_back((done, size));
        }
        link.arrives = link.arrives.max(done + delay);
        (leaves, done, link.arrives)
    }

    fn fly(&mut self, at: usize, attempt: AttemptId, leaves: Option<Instant>, event: Option<u64>) {
        if let Some(flight) = self.processes[at].open.get_mut(&attempt) {
            (flight.leaves, flight.event) = (leaves, event);
        }
    }

    pub(super) fn conclude_within(
        &mut self,
        ms: u64,
        at: usize,
        attempt: AttemptId,
        conclusion: Conclusion,
    ) {
        let conclude = Event::Conclude {
            at,
            attempt,
            conclusion,
        };
        self.after_ms(ms, conclude);
    }

    /// The core abandons an attempt, and gets its conclusion at once.
    pub(super) fn abandon(&mut self, at: usize, attempt: AttemptId, error: TransportError) {
        let conclusion = match self.take_back(at, attempt) {
            true => Conclusion::NotSent(error),
            false => Conclusion::Unconfirmed(error),
        };
        self.trace(|| format!("{at} abandons {attempt:?}: {conclusion:?}"));
        self.note_end(at, attempt, &conclusion);
        let now = self.clocks();
        let core = &mut self.processes[at].core;
        core.handle_conclusion(now, attempt, conclusion);
    }

    /// Concludes an attempt.
    pub(super) fn note_end(&mut self, at: usize, attempt: AttemptId, conclusion: &Conclusion) {
        if let Conclusion::Answered(Answer::Accepted | Answer::Delivered { .. })
        | Conclusion::Unconfirmed(_) = conclusion
        {
            self.may_repeat.insert((at, attempt));
        }
        self.check_repetitions(at, attempt, conclusion);
    }

    /// Ends an attempt. Returns whether no byte of its parcel has left and none ever will.
    fn take_back(&mut self, at: usize, attempt: AttemptId) -> bool {
        let Some(flight) = self.processes[at].open.remove(&attempt) else {
            return false;
        };
        let never = flight.leaves.is_none_or(|leaves| leaves > self.now);
        if never {
            flight.event.and_then(|event| self.due.remove(&event));
            if let Some((link, done)) = flight.queued
                && let Some(link) = self.links.get_mut(&link)
            {
                link.queue.retain(|(other, _)| *other != done);
            }
        }
        never
    }

    /// Handles the end of this process: parcels that had not left are lost with it, and attempts to
    /// it break off.
    pub(super) fn break_off(&mut self, dead: usize) {
        let own: Vec<AttemptId> = self.processes[dead].open.keys().copied().collect();
        for attempt in own {
            self.take_back(dead, attempt);
        }
        for at in 0..self.processes.len() {
            let flights = self.processes[at].open.iter();
            let broken_off: Vec<AttemptId> = flights
                .filter(|(_, flight)| flight.to == dead)
                .map(|(attempt, _)| *attempt)
                .collect();
            for attempt in broken_off {
                let error = TransportError::new(TransportErrorKind::Broken, "the process died");
                self.conclude_within(20, at, attempt, Conclusion::Unconfirmed(error));
            }
        }
    }

    /// Whether this location is a current location of its service.
    fn is_present(&self, to: usize, location: &Location) -> bool {
        let registry = self.registry.lock();
        let present = registry.present_address(self.processes[to].host, location.kind());
        address_of(location) == Some(present)
    }

    /// Whether these two processes are disconnected from each other.
    fn is_cut(&self, one: usize, other: usize) -> bool {
        let (one, other) = (self.processes[one].host, self.processes[other].host);
        one != other && (self.cut_off.contains(&one) || self.cut_off.contains(&other))
    }

    /// The answer to a deferred arrival.
    pub(super) fn answer(&mut self, at: usize, ticket: Ticket, answer: Answer) {
        if let Some((sender, attempt)) = self.processes[at].tickets.remove(&ticket)
            && !self.is_cut(at, sender)
        {
            self.conclude_within(2, sender, attempt, Conclusion::Answered(answer));
        }
    }

    pub(super) fn arrive(&mut self, flown: Flown) -> Result<(), Breach> {
        let Flown {
            from,
            to,
            kind,
            attempt,
            parcel,
            mute,
            copy,
            named,
        } = flown;
        let broken = || Conclusion::Unconfirmed(error(TransportErrorKind::Broken));
        let is_letter = matches!(parcel.body, Body::Letter(_));
        if is_letter {
            self.check_no_relay(from, to, &parcel);
        }
        // An attempt that ended with a certain *not taken* must not deliver its letter later.
        if copy && is_letter && !self.may_repeat.contains(&(from, attempt)) {
            return Ok(());
        }
        if !self.processes[to].alive {
            if !copy {
                self.conclude_within(5, from, attempt, broken());
            }
            return Ok(());
        }
        if self.processes[to].hostile {
            if !copy {
                self.answer_falsely(Ends { from, to }, kind, attempt, parcel);
            }
            return Ok(());
        }
        let now = self.clocks();
        let (host, remote) = {
            let (one, other) = (&self.processes[from], &self.processes[to]);
            (one.host, one.host != other.host)
        };
        let address = match remote {
            true => self.registry.lock().present_address(host, kind),
            false => 0,
        };
        let service = named.unwrap_or(self.processes[from].incarnation);
        let location = way(kind, service, address);
        let letter = match &parcel.body {
            Body::Letter(letter) => number_of(letter),
            _ => None,
        };
        let stream = parcel.stream;
        let text = self.traced.then(|| text_of(attempt, &parcel));
        let cut = self.is_cut(to, from);
        if remote && named.is_none() {
            self.meet(to, from);
        }
        let process = &mut self.processes[to];
        process.next_ticket += 1;
        let ticket = Ticket(process.next_ticket);
        let held = process.tickets.values();
        let held = held.filter(|(sender, _)| *sender == from).count();
        let at_once = kind == Kind::Shm && held >= LATE_ANSWERS;
        let arrival = Arrival {
            parcel,
            from: Hop {
                location,
                principal: match remote {
                    true if self.weather.liars => certificate(host),
                    true => Principal::Unproved,
                    false => Principal::Host,
                },
            },
            ticket: (!at_once).then_some(ticket),
        };
        let waiting = process.core.waiting(stream.receiver);
        let bytes = HEADER + size_of(&arrival.parcel);
        #[cfg(debug_assertions)]
        let _before = work::taken();
        let verdict = process.core.handle_arrival(now, kind, arrival);
        #[cfg(debug_assertions)]
        self.work.count(bytes, work::taken());
        #[cfg(not(debug_assertions))]
        let _ = bytes;
        let is_taken = process.core.waiting(stream.receiver) > waiting;
        if let Some(text) = text {
            let copy = if copy { " (a copy)" } else { "" };
            self.trace(|| format!("{to} says {verdict:?} to {text} from {from}{copy}"));
        }
        let process = &mut self.processes[to];
        match verdict {
            // The verdict on a duplicate does not answer the attempt (rule 3 of transports).
            _ if copy => {}
            // The return path is disconnected.
            Reaction::Now(_) if cut => {}
            Reaction::Now(answer) => {
                let conclusion = match mute {
                    true => broken(),
                    false => Conclusion::Answered(answer),
                };
                self.conclude_within(self.weather.answering_ms, from, attempt, conclusion);
            }
            Reaction::Later if at_once => return Err("a late answer without a ticket".into()),
            Reaction::Later if mute => self.conclude_within(60, from, attempt, broken()),
            Reaction::Later => {
                process.tickets.insert(ticket, (from, attempt));
            }
        }
        if let Some(number) = letter
            && is_taken
            && !self.is_hostile(stream.sender)
        {
            self.accepted(stream.receiver, number);
        }
        self.carry_out(to)
    }
}

fn text_of(attempt: AttemptId, parcel: &Parcel) -> String {
    let what = match &parcel.body {
        Body::Letter(letter) => format!("letter {:?}", number_of(letter)),
        other => format!("{other:?}"),
    };
    let (stream, after) = (parcel.stream, parcel.after);
    format!(
        "{what} ({attempt:?}, {} of {} for {}, after {after})",
        parcel.sequence, stream.sender, stream.receiver
    )
}

fn size_of(parcel: &Parcel) -> usize {
    match &parcel.body {
        Body::Letter(letter) => letter.len(),
        _ => 0,
    }
}

pub(super) fn transfer_time(bytes: usize) -> Duration {
    Duration::from_micros(bytes as u64 * 1_000_000 / BYTES_PER_SECOND)
}
