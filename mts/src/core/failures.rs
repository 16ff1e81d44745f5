//! Failure messages: their receivers and their rate.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::Dialect;
use fipa_sds::{Entry, Mts, Reach, Role, Source};
use fipa_transport::{FailureReason, Incarnation, LegacySource, Location, Signature, Stream};

use super::attempts::{Action, FailureTarget, Origin, Undelivered, registration_of};
use super::inbox::Received;
use super::lane::Delivery;
use super::{Core, News, Now, own_lane, work};
use crate::failure::Failure;
use crate::stamp;

/// Deadline of a failure message to a legacy peer's agent.
const FAILURE_DEADLINE: Duration = Duration::from_secs(5);

impl Core {
    /// Handles a letter that an agent of this process took and whose message cannot be decoded. The
    /// sender gets a failure message if it is an agent of this process, or one that the directory
    /// has under the name in the envelope. Nothing else proves a name in an envelope.
    pub fn handle_undecodable(
        &mut self,
        now: Now,
        receiver: &Arc<str>,
        received: &Received,
        why: String,
    ) {
        let registration = received.sender;
        if received.via.is_none() || !registration.is_known() {
            return;
        }
        let sender = if self.agents.contains_key(&registration) {
            FailureTarget::Ours(registration)
        } else {
            let named = stamp::sender(&received.letter);
            let known = self.table.view.registered(registration);
            match known {
                Some(entry) if named.as_deref() == Some(&*entry.name) => {
                    FailureTarget::Remote { from: None }
                }
                _ => return,
            }
        };
        self.table.undelivered.push_back(Undelivered {
            sender,
            receiver: Arc::clone(receiver),
            letter: received.letter.clone(),
            reason: FailureReason::Refused,
            detail: cannot_be_decoded(&why),
        });
        self.send_failures(now);
    }

    /// Sends the pending FIPA `failure` messages.
    pub(super) fn send_failures(&mut self, now: Now) {
        while let Some(undelivered) = self.table.undelivered.pop_front() {
            let Undelivered {
                sender,
                receiver,
                letter,
                reason,
                detail,
            } = undelivered;
            let name = Arc::clone(&self.table.config.name);
            let name = &*name;
            let from = match sender {
                FailureTarget::Ours(_) => None,
                FailureTarget::Remote { from } => {
                    // Before the message is decoded, by the name in the envelope.
                    let named = stamp::sender(&letter).unwrap_or_default();
                    let address = from.map(|from| from.address);
                    if !self.failure_limit.allows(now.instant, address, &named) {
                        continue;
                    }
                    // Messages are decoded only in proportion to the received bytes.
                    if !self
                        .failure_limit
                        .covers(now.instant, address, letter.len())
                    {
                        continue;
                    }
                    from
                }
            };
            // The message is decoded, and a new one encoded.
            work::steps(letter.len() / 512);
            let Some(report) = Failure::of(&letter, &receiver, reason, &detail) else {
                continue;
            };
            let own = self.table.config.incarnation;
            let sequence = self.sequence_of(own);
            if let FailureTarget::Ours(agent) = sender {
                let Some(inbox) = self.agents.get_mut(&agent) else {
                    continue;
                };
                let letter = match report.written_for(name, Dialect::Standard, now.utc) {
                    Ok(letter) => letter,
                    Err(error) => {
                        tracing::warn!(%error, %receiver, "cannot encode a failure message");
                        continue;
                    }
                };
                if inbox.push_failure(letter.clone()) {
                    let stream = Stream {
                        sender: own,
                        receiver: agent,
                    };
                    let name = Arc::clone(&inbox.name);
                    self.table.notice(stream, sequence, &name, || News::Taken {
                        via: None,
                        letter,
                    });
                    self.table.actions.push_back(Action::Deliverable { agent });
                } else {
                    self.failure_limit.leave_out(now.instant);
                }
                continue;
            }
            // The directory has the sender, or a legacy peer's letter states its address.
            let known = self.table.view.named(report.sender.name());
            let stated = match known {
                Some(_) => None,
                None => from.and_then(|from| stated_entry(&report, from)),
            };
            let Some(entry) = known.or_else(|| stated.clone()) else {
                tracing::info!(to = %report.sender, %reason, "cannot send a failure message: its receiver is not known");
                continue;
            };
            if entry.role == Role::Gateway {
                continue;
            }
            let letter = match report.written_for(name, dialect_of(&entry), now.utc) {
                Ok(letter) => letter,
                Err(error) => {
                    tracing::warn!(%error, receiver = %report.receiver, "cannot encode a failure message");
                    continue;
                }
            };
            if !self
                .failure_limit
                .debit(now.instant, from.map(|from| from.address), letter.len())
            {
                continue;
            }
            let stream = Stream {
                sender: self.table.config.incarnation,
                receiver: registration_of(&entry),
            };
            let id = self.lane(now, own_lane(stream.sender, &entry), &entry.name);
            if !self.has_room_for_stranger(id, letter.len()) {
                self.failure_limit.leave_out(now.instant);
                continue;
            }
            let deadline = now.instant + FAILURE_DEADLINE;
            let letter_of = (stream.receiver, sequence);
            let origin = Origin::FailureMessage;
            let delivery = Delivery::new(now.instant, origin, letter, letter_of, deadline);
            self.table
                .notice(stream, sequence, &entry.name, || News::Sent {
                    send: None,
                    letter: delivery.letter.clone(),
                });
            if stated.is_some()
                && let Some(lane) = self.lanes.get_mut(&id)
            {
                lane.set_stated(Arc::clone(&entry));
            }
            self.put(now, id, delivery);
        }
    }
}

/// The detail of a failure.
pub(super) fn cannot_be_decoded(why: &dyn std::fmt::Display) -> String {
    format!("the message cannot be decoded: {why}")
}

/// The locations that an agent of a legacy peer states as its own: of its addresses, the numeric
/// ones of the host that its letter came from. Others could be claimed to make this service send to
/// a third party.
pub(super) fn locations_given<'a>(
    addresses: impl IntoIterator<Item = &'a str>,
    from: LegacySource,
) -> Vec<Location> {
    let locations = addresses.into_iter().filter_map(|address| {
        let location: Location = address.parse().ok()?;
        let claimed: SocketAddr = location.address().parse().ok()?;
        if claimed.ip().to_canonical() != from.address || !location.kind().is_supported() {
            return None;
        }
        location.with_signature(from.signature).ok()
    });
    locations.take(Entry::MAX_LOCATIONS).collect()
}

/// An agent that is not in the directory, with the locations that it states as its own.
fn stated_entry(report: &Failure<'_>, from: LegacySource) -> Option<Arc<Entry>> {
    let agent = &report.sender;
    let addresses = agent.addresses().iter().map(|address| &**address);
    let locations = locations_given(addresses, from);
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

/// The dialect of an agent, by the signature of its first location.
fn dialect_of(entry: &Entry) -> Dialect {
    match entry.locations.first().map(Location::signature) {
        Some(Signature::FipaServices) => Dialect::FipaServices,
        Some(Signature::JadeProxy) => Dialect::Jade,
        _ => Dialect::Standard,
    }
}
