//! What lies between processes: links that lose, delay and refuse, and never reorder.

use std::time::Duration;

use fipa_transport::{
    Arrival, AttemptId, Body, Conclusion, Hop, Kind, Location, Parcel, Ticket, Verdict, WayError,
    WayFault,
};

use super::view::way;
use super::weather::LATE_MS;
use super::{Breach, Event, World};

impl World {
    pub(super) fn dispatch(
        &mut self,
        at: usize,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) {
        let kind = to.kind();
        let host = self.processes[at].host;
        let living = (0..self.processes.len()).find(|&p| {
            self.processes[p].incarnation == to.incarnation() && self.processes[p].alive
        });
        let error = |fault| WayError::new(fault, "simulated");
        let down = self.down.contains(&(host, kind))
            || living.is_some_and(|p| self.down.contains(&(self.processes[p].host, kind)));
        self.processes[at]
            .open
            .insert(attempt, living.unwrap_or(usize::MAX));
        let Some(receiver) = living.filter(|_| !down) else {
            let conclusion = Conclusion::NotSent(error(WayFault::Unreachable));
            return self.after_ms(
                3,
                Event::Conclude {
                    at,
                    attempt,
                    conclusion,
                },
            );
        };
        let mut luck = self.random.f64();
        let mut happens = |rate: f64| {
            luck -= rate;
            luck < 0.0
        };
        let w = self.weather;
        if happens(w.refusal) {
            let conclusion = Conclusion::NotSent(error(WayFault::Unreachable));
            return self.after_ms(
                3,
                Event::Conclude {
                    at,
                    attempt,
                    conclusion,
                },
            );
        }
        if happens(w.loss) {
            let conclusion = Conclusion::Unconfirmed(error(WayFault::Broken));
            return self.after_ms(
                50,
                Event::Conclude {
                    at,
                    attempt,
                    conclusion,
                },
            );
        }
        if happens(w.silence) || self.is_cut(at, receiver) {
            return;
        }
        let mute = happens(w.answer_loss);
        let between_hosts = self.processes[at].host != self.processes[receiver].host;
        let mut strays = |rate: f64| between_hosts && rate > 0.0 && self.random.f64() < rate;
        let (copied, late) = (strays(w.copies), strays(w.overtaken));
        let arrive = |parcel, copy| Event::Arrive {
            from: at,
            to: receiver,
            kind,
            attempt,
            parcel,
            mute,
            copy,
        };
        if copied {
            self.after_ms(LATE_MS, arrive(parcel.clone(), true));
        }
        if late {
            return self.after_ms(LATE_MS, arrive(parcel, false));
        }
        let delay = Duration::from_micros(self.random.u64(20..5000));
        let link = self.links.entry((at, receiver, kind)).or_insert(self.now);
        *link = (*link).max(self.now + delay);
        let arrives = *link;
        self.at(arrives, arrive(parcel, false));
    }

    /// Whether nothing passes from one of these processes to the other.
    pub(super) fn is_cut(&self, one: usize, other: usize) -> bool {
        let (one, other) = (self.processes[one].host, self.processes[other].host);
        one != other && (self.cut_off.contains(&one) || self.cut_off.contains(&other))
    }

    /// A host is cut off from all others, for long enough that attempts are given up.
    pub(super) fn cut_off(&mut self) {
        let host = self.random.usize(..self.weather.hosts);
        self.cut_off.insert(host);
        self.after_ms(1500, Event::JoinedAgain { host });
    }

    pub(super) fn arrive(
        &mut self,
        (from, to): (usize, usize),
        kind: Kind,
        attempt: AttemptId,
        parcel: Parcel,
        mute: bool,
        copy: bool,
    ) -> Result<(), Breach> {
        let broken = || Conclusion::Unconfirmed(WayError::new(WayFault::Broken, "simulated"));
        if !self.processes[to].alive {
            if copy {
                return Ok(());
            }
            self.after_ms(
                5,
                Event::Conclude {
                    at: from,
                    attempt,
                    conclusion: broken(),
                },
            );
            return Ok(());
        }
        let now = self.clocks();
        let location = way(kind, self.processes[from].incarnation);
        let remote = self.processes[from].host != self.processes[to].host;
        let is_letter = matches!(parcel.body, Body::Letter(_));
        if is_letter && remote && parcel.hops >= Parcel::LAST_HOPS {
            self.followed += 1;
        }
        let cut = self.is_cut(to, from);
        let process = &mut self.processes[to];
        process.next_ticket += 1;
        let ticket = Ticket(process.next_ticket);
        let arrival = Arrival {
            parcel,
            from: Hop { location, remote },
            ticket,
        };
        let at_once = kind == Kind::Shm;
        let verdict = process.core.handle_arrival(now, kind, at_once, arrival);
        match verdict {
            // What is said of a copy is no answer to the attempt (rule 3 of transports).
            _ if copy => {}
            // The way back is cut.
            Verdict::Now(_) if cut => {}
            Verdict::Now(answer) => {
                let conclusion = if mute {
                    broken()
                } else {
                    Conclusion::Answered(answer)
                };
                self.after_ms(
                    self.weather.answering_ms,
                    Event::Conclude {
                        at: from,
                        attempt,
                        conclusion,
                    },
                );
            }
            Verdict::Later if at_once => return Err("a late answer over shared memory".into()),
            Verdict::Later if mute => {
                self.after_ms(
                    60,
                    Event::Conclude {
                        at: from,
                        attempt,
                        conclusion: broken(),
                    },
                );
            }
            Verdict::Later => {
                process.tickets.insert(ticket, (from, attempt));
            }
        }
        self.carry_out(to)
    }
}
