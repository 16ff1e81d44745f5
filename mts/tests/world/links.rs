//! What lies between processes: links that lose, delay and refuse, and never reorder.

use std::time::Duration;

use fipa_transport::{
    Arrival, AttemptId, Body, Conclusion, Hop, Kind, Location, Parcel, Ticket, Verdict, WayError,
    WayFault,
};

use super::view::way;
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
        if happens(w.silence) {
            return;
        }
        let mute = happens(w.answer_loss);
        let delay = Duration::from_micros(self.random.u64(20..5000));
        let link = self.links.entry((at, receiver, kind)).or_insert(self.now);
        *link = (*link).max(self.now + delay);
        let arrives = *link;
        self.at(
            arrives,
            Event::Arrive {
                from: at,
                to: receiver,
                kind,
                attempt,
                parcel,
                mute,
            },
        );
    }

    pub(super) fn arrive(
        &mut self,
        from: usize,
        to: usize,
        kind: Kind,
        attempt: AttemptId,
        parcel: Parcel,
        mute: bool,
    ) -> Result<(), Breach> {
        let broken = || Conclusion::Unconfirmed(WayError::new(WayFault::Broken, "simulated"));
        if !self.processes[to].alive {
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
