//! Letters for somebody else: the gateway's role, old peers' letters, and failure messages.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{Dialect, Letter, Representation};
use fipa_sds::{Entry, Mts, Reach, Resolution, Role, Source};
use fipa_transport::{
    Allowance, Answer, FailureReason, Hop, Incarnation, Kind, Location, Outcome, Parcel, Signature,
    Stream, Ticket, Verdict,
};

use super::desk::{Action, Author, Origin, Undelivered, Upstream, life_of};
use super::inbox::link_of;
use super::lane::{Delivery, LaneId, LaneKey};
use super::{Core, MAX_DEADLINE, News, Now, own_lane};
use crate::gate::Link;
use smallvec::smallvec;

use crate::failure::Failure;
use crate::stamp;

/// When the sender of a letter is told that it is in custody, if its outcome takes longer.
const CUSTODY_AFTER: Duration = Duration::from_millis(200);
/// Letters of old peers a second that they are told were refused. What they may send is not limited
/// by how fast answers go out, and nobody is to be made to write to them without end.
const REFUSALS_TOLD: f64 = 20.0;
/// How long a failure message to an old peer's agent may take.
const FAILURE_DEADLINE: Duration = Duration::from_secs(5);

impl Core {
    /// Takes a letter for somebody else into custody, or says why not. `unanswered` is the arrival
    /// that may be answered later.
    pub(super) fn forward(
        &mut self,
        now: Now,
        via: Kind,
        parcel: &Parcel,
        letter: Letter,
        from: Hop,
        unanswered: Option<(Kind, Ticket)>,
    ) -> Verdict {
        let (entry, stamped) = match self.admit(now, parcel, letter, &from) {
            Ok(admitted) => admitted,
            Err(refusal) => return Verdict::Now(refusal),
        };
        let stream = parcel.stream;
        let key = LaneKey::Custody(stream);
        let taken = match unanswered {
            Some(_) => Verdict::Later,
            None => Verdict::Now(Answer::Custody),
        };
        let mut upstream = Upstream {
            back: from.location.clone(),
            transfer: parcel.transfer,
            unanswered,
        };
        if let Some(id) = self.lane_ids.get(&key).copied() {
            let mut kept = Some(upstream);
            self.with_lane(now, id, |lane, desk| {
                let letter = (parcel.sequence, parcel.after);
                kept = kept
                    .take()
                    .and_then(|it| lane.adopt(now.instant, letter, it, desk).err());
            });
            upstream = match kept {
                Some(upstream) => upstream,
                None => return taken,
            };
        }
        if self.ending {
            return Verdict::Now(Answer::Busy);
        }
        let id = self.lane(now, key, &entry.name);
        if let Some(lane) = self.lanes.get_mut(&id)
            && !lane.admits(parcel.sequence, stamped.len(), &self.desk)
        {
            lane.wait_for_credit(from.location);
            return Verdict::Now(Answer::Busy);
        }
        if let Err(why) = self.admits(now, &entry.name, &stamped, link_of(via, &from.location)) {
            return Verdict::Now(Answer::failed(FailureReason::Refused, why));
        }
        if from.remote {
            self.hear(stream.sender, &stamped, &from);
        }
        self.desk
            .notice(stream, parcel.sequence, &entry.name, || News::Passed {
                via,
                remote: from.remote,
                letter: stamped.clone(),
            });
        let deadline = now.instant + parcel.remaining.min(MAX_DEADLINE);
        let origin = Origin::Forwarded {
            upstreams: smallvec![upstream],
        };
        let letter_of = (stream.receiver, parcel.sequence);
        let mut delivery = Delivery::new(now.instant, origin, stamped, letter_of, deadline);
        delivery.after = parcel.after;
        delivery.custody_due = unanswered.map(|_| now.instant + CUSTODY_AFTER);
        self.put(now, id, delivery);
        taken
    }

    /// What the gate says, if there is one.
    fn admits(&self, now: Now, receiver: &str, letter: &Letter, link: Link) -> Result<(), String> {
        match &self.gate {
            Some(gate) => gate.admits(now.instant, receiver, letter, link),
            None => Ok(()),
        }
    }

    /// Whether this service passes the letter on: to whom, and the letter with its stamp.
    fn admit(
        &self,
        now: Now,
        parcel: &Parcel,
        letter: Letter,
        from: &Hop,
    ) -> Result<(Arc<Entry>, Letter), Answer> {
        let config = &self.desk.config;
        let unknown = |why: &str| Answer::failed(FailureReason::NoSuchAgent, why);
        let refused = |why: String| Answer::failed(FailureReason::Refused, why);
        if !config.forwards {
            return Err(unknown("the agent is not in this process any more"));
        }
        let registration = parcel.stream.receiver;
        let Some(entry) = self.desk.receiver(registration, &parcel.receiver) else {
            return Err(
                match self.desk.departed.contains(now.instant, registration) {
                    true => Answer::Moved,
                    false => unknown("the agent is not known to the gateway"),
                },
            );
        };
        if entry.role != Role::Agent {
            return Err(refused(
                "letters for another gateway are not passed on".to_owned(),
            ));
        }
        // Letters from the network are for this host: a gateway never relays between others.
        if from.remote && entry.reach != Reach::Local {
            return Err(unknown("the agent is not on the gateway's host"));
        }
        match stamp::carries(&letter, &config.name, config.incarnation) {
            Ok(true) => return Err(Answer::failed(FailureReason::Loop, &*config.name)),
            Ok(false) => {}
            Err(error) => return Err(refused(error.to_string())),
        }
        let stamped = stamp::put(letter, &config.name, config.incarnation, now.utc)
            .map_err(|error| refused(error.to_string()))?;
        Ok((entry, stamped))
    }

    /// Makes known who has written this stamped letter, if nobody has told of that agent yet: it can be answered.
    fn hear(&mut self, agent: Incarnation, letter: &Letter, from: &Hop) {
        let directory = &self.desk.directory;
        if !agent.is_known() || directory.known_incarnation(agent).is_some() {
            return;
        }
        // Passed on by the gateway that its receiver has left, it does not come from where its
        // sender is.
        let direct = stamp::count(letter).is_ok_and(|stamps| stamps <= 2);
        if let Some(name) = stamp::sender(letter)
            && direct
            && directory.known(&name).is_none()
        {
            let location = from.location.clone();
            self.desk.actions.push_back(Action::Heard {
                name,
                agent,
                location,
            });
        }
    }

    /// Whether there is room for another letter in this lane.
    pub(super) fn has_room(&self, lane: LaneId, len: usize) -> bool {
        let lane = self.lanes.get(&lane);
        lane.is_some_and(|lane| lane.has_room(len, &self.desk))
    }

    /// Whether there is room for a letter whose sender cannot be held back.
    fn has_room_for_stranger(&self, lane: LaneId, len: usize) -> bool {
        let bytes = self.desk.held.saturating_add(len);
        bytes <= self.desk.config.custody_bytes && self.has_room(lane, len)
    }

    /// An old peer's letter arrived from this address, for the agents of this host that its
    /// envelope names.
    pub fn handle_unframed(
        &mut self,
        now: Now,
        deadline: Duration,
        letter: Letter,
        via: Kind,
        from: IpAddr,
    ) {
        let receivers = match stamp::receivers(&letter) {
            Ok(receivers) => receivers,
            Err(error) => {
                tracing::warn!(%error, "an unframed letter with a malformed envelope was dropped");
                return;
            }
        };
        let directory = Arc::clone(&self.desk.directory);
        let sender = stamp::sender(&letter).unwrap_or_default();
        let stream_sender = self.desk.config.incarnation;
        let unproved = Link {
            via,
            service: Incarnation::UNKNOWN,
        };
        for receiver in receivers {
            let (entries, missing) = match fipa_sds::resolve_legacy(&*directory, &receiver, &sender)
            {
                Ok(Resolution::Exact(entry)) => (vec![entry], Vec::new()),
                Ok(Resolution::Multicast(entries)) => (entries, Vec::new()),
                Ok(Resolution::Coalition {
                    agents,
                    mut missing,
                }) => {
                    // Its members elsewhere are not reached from here, and the sender is told.
                    let away = agents.iter().filter(|entry| entry.reach != Reach::Local);
                    missing.extend(away.map(|entry| Arc::clone(&entry.name)));
                    (agents, missing)
                }
                Ok(Resolution::None) | Err(_) => (Vec::new(), Vec::new()),
            };
            let here = entries.iter().filter(|entry| entry.reach == Reach::Local);
            let nobody = here.clone().next().is_none() && missing.is_empty();
            let receiver: Arc<str> = receiver.as_str().into();
            for name in missing.into_iter().chain(nobody.then_some(receiver)) {
                tracing::info!(receiver = %name, %from, "an unframed letter names nobody of this host");
                let why = (FailureReason::NoSuchAgent, String::new());
                self.unframed_failed(&name, &letter, (via, from), why);
            }
            for entry in here {
                if let Err(why) = self.admits(now, &entry.name, &letter, unproved) {
                    if self.tells_of_refusal(now) {
                        let why = (FailureReason::Refused, why);
                        self.unframed_failed(&entry.name, &letter, (via, from), why);
                    }
                    continue;
                }
                let stream = Stream {
                    sender: stream_sender,
                    receiver: entry.incarnation,
                };
                let sequence = self.sequence_of(stream_sender);
                if let Some(inbox) = self.agents.get_mut(&entry.incarnation)
                    && inbox.push_unframed(letter.clone(), via)
                {
                    self.desk
                        .notice(stream, sequence, &entry.name, || News::Taken {
                            via: Some(via),
                            letter: letter.clone(),
                        });
                    let agent = entry.incarnation;
                    self.desk.actions.push_back(Action::Deliverable { agent });
                    continue;
                }
                self.desk
                    .notice(stream, sequence, &entry.name, || News::Passed {
                        via,
                        remote: true,
                        letter: letter.clone(),
                    });
                let lane = self.lane(now, own_lane(stream_sender, entry), &entry.name);
                if !self.has_room_for_stranger(lane, letter.len()) {
                    self.desk.undelivered.push_back(Undelivered {
                        sender: Author::OldPeer { from },
                        receiver: Arc::clone(&entry.name),
                        letter: letter.clone(),
                        reason: FailureReason::QueueFull,
                        detail: String::new(),
                    });
                    self.desk
                        .notice(stream, sequence, &entry.name, || News::Settled {
                            outcome: failed(FailureReason::QueueFull),
                            sender: true,
                        });
                    continue;
                }
                let until = now.instant + deadline.min(MAX_DEADLINE);
                let origin = Origin::OldPeer { from };
                let letter_of = (stream.receiver, sequence);
                let letter = letter.clone();
                let delivery = Delivery::new(now.instant, origin, letter, letter_of, until);
                self.put(now, lane, delivery);
            }
        }
        self.tell_failures(now);
    }

    /// Whether an old peer is told of one more letter that was refused.
    fn tells_of_refusal(&mut self, now: Now) -> bool {
        let full = || Allowance::new(REFUSALS_TOLD, now.instant);
        let refusals = self.refusals.get_or_insert_with(full);
        refusals.take(1.0, REFUSALS_TOLD, now.instant)
    }

    /// An old peer's letter does not get to this receiver.
    fn unframed_failed(
        &mut self,
        receiver: &Arc<str>,
        letter: &Letter,
        (via, from): (Kind, IpAddr),
        (reason, detail): (FailureReason, String),
    ) {
        let own = self.desk.config.incarnation;
        let stream = Stream {
            sender: own,
            receiver: Incarnation::UNKNOWN,
        };
        let sequence = self.sequence_of(own);
        self.desk
            .notice(stream, sequence, receiver, || News::Passed {
                via,
                remote: true,
                letter: letter.clone(),
            });
        self.desk
            .notice(stream, sequence, receiver, || News::Settled {
                outcome: failed(reason),
                sender: true,
            });
        self.desk.undelivered.push_back(Undelivered {
            sender: Author::OldPeer { from },
            receiver: Arc::clone(receiver),
            letter: letter.clone(),
            reason,
            detail,
        });
    }

    /// Tells senders of what failed, in the form of FIPA `failure` messages.
    pub(super) fn tell_failures(&mut self, now: Now) {
        while let Some(undelivered) = self.desk.undelivered.pop_front() {
            let Undelivered {
                sender,
                receiver,
                letter,
                reason,
                detail,
            } = undelivered;
            let name = Arc::clone(&self.desk.config.name);
            let name = &*name;
            let Some(report) = Failure::of(&letter, &receiver, reason, &detail) else {
                continue;
            };
            let own = self.desk.config.incarnation;
            let sequence = self.sequence_of(own);
            let from = match sender {
                Author::OldPeer { from } => Some(from),
                Author::Ours(_) => None,
            };
            if let Author::Ours(agent) = sender {
                let Some(inbox) = self.agents.get_mut(&agent) else {
                    continue;
                };
                let letter = match report.written_for(name, Dialect::Standard, now.utc) {
                    Ok(letter) => letter,
                    Err(error) => {
                        tracing::warn!(%error, %receiver, "a failure message could not be written");
                        continue;
                    }
                };
                if inbox.push_failure(letter.clone()) {
                    let stream = Stream {
                        sender: own,
                        receiver: agent,
                    };
                    let name = Arc::clone(&inbox.name);
                    self.desk.notice(stream, sequence, &name, || News::Taken {
                        via: None,
                        letter,
                    });
                    self.desk.actions.push_back(Action::Deliverable { agent });
                }
                continue;
            }
            // An old peer's letter: its sender is known by name, or has said where it is.
            let known = self.desk.directory.lookup(report.sender.name());
            let said = match known {
                Some(_) => None,
                None => from.and_then(|from| said_of_itself(&report, from)),
            };
            let Some(entry) = known.or_else(|| said.clone()) else {
                tracing::info!(to = %report.sender, %reason, "nobody to send a failure message to");
                continue;
            };
            if entry.role == Role::Gateway {
                continue;
            }
            let letter = match report.written_for(name, dialect_of(&entry), now.utc) {
                Ok(letter) => letter,
                Err(error) => {
                    tracing::warn!(%error, receiver = %report.receiver, "a failure message could not be written");
                    continue;
                }
            };
            let stream = Stream {
                sender: self.desk.config.incarnation,
                receiver: life_of(&entry),
            };
            let id = self.lane(now, own_lane(stream.sender, &entry), &entry.name);
            if !self.has_room_for_stranger(id, letter.len()) {
                tracing::info!(to = %report.sender, %reason, "no room for a failure message");
                continue;
            }
            let deadline = now.instant + FAILURE_DEADLINE;
            let letter_of = (stream.receiver, sequence);
            let origin = Origin::Nobody;
            let delivery = Delivery::new(now.instant, origin, letter, letter_of, deadline);
            self.desk
                .notice(stream, sequence, &entry.name, || News::Sent {
                    send: None,
                    letter: delivery.letter.clone(),
                });
            if said.is_some()
                && let Some(lane) = self.lanes.get_mut(&id)
            {
                lane.said(Arc::clone(&entry));
            }
            self.put(now, id, delivery);
        }
    }
}

/// An agent that the directory does not know, as it said itself where it can be reached: the
/// numeric addresses of an old peer's agent, of the host that its letter came from. Others anybody
/// could claim, and have this service send to them what they never asked for.
fn said_of_itself(report: &Failure<'_>, from: IpAddr) -> Option<Arc<Entry>> {
    let agent = &report.sender;
    let signature = match report.representation {
        Some(Representation::String) => Signature::JadeProxy,
        _ => Signature::FipaServices,
    };
    let locations = agent.addresses().iter().filter_map(|address| {
        let location: Location = address.parse().ok()?;
        let claimed: SocketAddr = location.address().parse().ok()?;
        if claimed.ip().to_canonical() != from {
            return None;
        }
        location.with_signature(signature).ok()
    });
    let locations: Vec<Location> = locations.take(Entry::MAX_LOCATIONS).collect();
    if locations.is_empty() {
        return None;
    }
    let entry = Entry {
        name: agent.name().into(),
        agent_type: String::new(),
        incarnation: Incarnation::UNKNOWN,
        locations,
        mts: Mts::new(agent.name(), Incarnation::UNKNOWN),
        description: String::new(),
        registered: SystemTime::UNIX_EPOCH,
        source: Source::Contact,
        reach: Reach::Remote {
            gateway: Incarnation::UNKNOWN,
        },
        role: Role::Agent,
    };
    entry.check().is_ok().then(|| Arc::new(entry))
}

/// What an agent understands, by what is understood where it can be reached.
fn dialect_of(entry: &Entry) -> Dialect {
    match entry.locations.first().map(Location::signature) {
        Some(Signature::FipaServices) => Dialect::FipaServices,
        Some(Signature::JadeProxy) => Dialect::Jade,
        _ => Dialect::Standard,
    }
}

fn failed(reason: FailureReason) -> Outcome {
    Outcome::Failed {
        reason,
        attempts: Vec::new(),
    }
}
