//! Failure messages: their receivers and their rate.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Dialect, ErrorChain, Letter};
use fipa_sds::{Entry, Mts, Reach, Role, Source};
use fipa_transport::{
    FailureReason, Incarnation, Kind, LegacySource, Location, PeerId, Signature, Stream, log_limit,
    quota_address,
};

use super::attempts::{Action, FailureTarget, Origin, Undelivered, registration_of};
use super::inbox::Received;
use super::lane::Delivery;
use super::limits::log_omitted;
use super::{Core, News, Now, own_lane, work};
use crate::failure::{Failed, Failure};

/// Deadline of a failure message to a legacy peer's agent.
const FAILURE_DEADLINE: Duration = Duration::from_secs(5);

/// A letter whose message cannot be decoded, as far as its sender is told about it. Reading it takes time in
/// proportion to the bytes of the letter, so it happens before the core is locked.
#[derive(Debug)]
pub struct Undecodable {
    letter: Letter,
    sender: Incarnation,
    failed: Arc<Failed>,
    why: String,
}

impl Undecodable {
    /// Reads the envelope of a letter that an agent of this process took and whose message cannot be decoded
    /// for this reason. `None` if its sender is not told.
    #[must_use]
    pub fn read(received: &Received, why: &dyn std::fmt::Display) -> Option<Self> {
        if received.via.is_none() || !received.sender.is_known() {
            return None;
        }
        Some(Self {
            failed: Arc::new(Failed::of_envelope(&received.letter)?),
            letter: received.letter.clone(),
            sender: received.sender,
            why: cannot_be_decoded(why),
        })
    }
}

impl Core {
    /// Handles a letter that an agent of this process took and whose message cannot be decoded. The
    /// sender gets a failure message if it is an agent of this process, or one that the directory
    /// has under the name in the envelope. Nothing else proves a name in an envelope.
    pub fn handle_undecodable(&mut self, now: Now, receiver: &Arc<str>, undecodable: Undecodable) {
        let Undecodable {
            letter,
            sender: registration,
            failed,
            why,
        } = undecodable;
        let sender = if self.agents.contains_key(&registration) {
            FailureTarget::Ours(registration)
        } else {
            match self.table.receiver(registration, failed.sender.name()) {
                Some(_) => FailureTarget::Remote(failed),
                None => return,
            }
        };
        self.table.undelivered.push_back(Undelivered {
            sender,
            receiver: Arc::clone(receiver),
            letter,
            reason: FailureReason::Refused,
            detail: why,
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
            let from = match &sender {
                FailureTarget::LegacyPeer { from, .. } => Some(*from),
                FailureTarget::Ours(_) | FailureTarget::Remote(_) => None,
            };
            let address = from.map(|from| from.address);
            let failed = match &sender {
                FailureTarget::LegacyPeer { failed, .. } | FailureTarget::Remote(failed) => {
                    let named = failed.sender.name();
                    if !self.failure_limit.allows(now.instant, address, named) {
                        continue;
                    }
                    // Failure messages are encoded only in proportion to the received bytes.
                    if !self.failure_limit.covers(address, letter.len()) {
                        continue;
                    }
                    Some(Arc::clone(failed))
                }
                FailureTarget::Ours(_) => Failed::of(&letter).map(Arc::new),
            };
            let Some(failed) = failed else {
                continue;
            };
            let report = Failure {
                letter: &failed,
                receiver: &receiver,
                reason,
                detail: &detail,
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
                        log_limit::warn!(error = %ErrorChain(&*error), %receiver, "cannot encode a failure message");
                        continue;
                    }
                };
                if inbox.push_failure(letter.clone()) {
                    let stream = Stream::between(own, agent);
                    let name = Arc::clone(&inbox.name);
                    self.table.notice(stream, sequence, &name, || News::Taken {
                        via: None,
                        letter,
                    });
                    self.table.actions.push_back(Action::Deliverable { agent });
                } else {
                    log_omitted(address);
                }
                continue;
            }
            // The directory has the sender, or a legacy peer's letter states its address.
            let known = self.table.view.named(failed.sender.name());
            let stated = match known {
                Some(_) => None,
                None => from.and_then(|from| stated_entry(&failed.sender, from)),
            };
            let Some(entry) = known.or_else(|| stated.clone()) else {
                log_limit::info!(of: address.map(quota_address), to = %failed.sender, %reason, "cannot send a failure message: its receiver is not known");
                continue;
            };
            if entry.role == Role::Gateway {
                continue;
            }
            let letter = match report.written_for(name, dialect_of(&entry), now.utc) {
                Ok(letter) => letter,
                Err(error) => {
                    log_limit::warn!(error = %ErrorChain(&*error), receiver = %report.receiver, "cannot encode a failure message");
                    continue;
                }
            };
            work::steps(letter.len() / 512);
            if !self.failure_limit.debit(address, letter.len()) {
                continue;
            }
            let stream = Stream::between(self.table.config.incarnation, registration_of(&entry));
            let id = self.lane(now, own_lane(stream.sender, &entry), &entry.name);
            if !self.has_room_for_stranger(id, letter.len()) {
                log_omitted(address);
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

/// The port of an address of HTTP without one.
const HTTP_PORT: u16 = 7778;

/// The locations that an agent of a legacy peer states as its own: of its addresses, the numeric
/// ones of the host that its letter came from. Others could be claimed to make this service send to
/// a third party. JADE states its host by name; the name is replaced by the address that the letter
/// came from. Locations of
/// transports that a gateway may lack come last.
pub(super) fn locations_given<'a>(
    addresses: impl IntoIterator<Item = &'a str>,
    from: LegacySource,
) -> Vec<Location> {
    let locations = addresses.into_iter().filter_map(|address| {
        let location: Location = address.parse().ok()?;
        let location = match location.kind() {
            Kind::Http | Kind::Https => at_host(&location, from.address)?,
            _ => location,
        };
        let claimed: SocketAddr = location.authority().parse().ok()?;
        if claimed.ip().to_canonical() != from.address {
            return None;
        }
        location.with_signature(from.signature).ok()
    });
    let mut locations: Vec<Location> = locations.take(Entry::MAX_LOCATIONS).collect();
    locations.sort_by_key(|location| !location.kind().is_supported());
    locations
}

/// A location of HTTP with a name replaced by the address of the host that states it, and with a
/// port.
fn at_host(location: &Location, host: IpAddr) -> Option<Location> {
    let authority = location.authority();
    let path = location.address().get(authority.len()..)?;
    let at = match (authority.parse::<SocketAddr>(), authority.parse::<IpAddr>()) {
        (Ok(at), _) => at,
        (_, Ok(ip)) => SocketAddr::new(ip, HTTP_PORT),
        _ => match authority.rsplit_once(':') {
            Some((_, port)) => SocketAddr::new(host, port.parse().ok()?),
            None => SocketAddr::new(host, HTTP_PORT),
        },
    };
    let location = Location::new(location.kind(), &format!("{at}{path}")).ok();
    location.filter(|_| at.port() != 0)
}

/// An agent that is not in the directory, with the locations that it states as its own.
fn stated_entry(agent: &AgentId, from: LegacySource) -> Option<Arc<Entry>> {
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
        peer: PeerId::of_ip(from.address),
        role: Role::Agent,
    };
    entry.check().is_ok().then(|| Arc::new(entry))
}

/// The dialect of an agent, by the signature of its first location.
fn dialect_of(entry: &Entry) -> Dialect {
    match entry.locations.first().map(Location::signature) {
        Some(Signature::FipaServices) => Dialect::FipaServices,
        Some(signature) if signature.is_jade() => Dialect::Jade,
        _ => Dialect::Standard,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_platform_is_answered_only_at_the_host_that_its_letter_came_from() {
        let from = LegacySource {
            address: IpAddr::from([10, 0, 0, 7]),
            signature: Signature::JadeProxy,
        };
        let given = |address: &str| {
            let locations = locations_given([address], from);
            locations.first().map(ToString::to_string)
        };
        for (stated, expected) in [
            ("http://10.0.0.7:7778/acc", Some("http://10.0.0.7:7778/acc")),
            ("http://10.0.0.7/acc", Some("http://10.0.0.7:7778/acc")),
            ("http://crex:7778/acc", Some("http://10.0.0.7:7778/acc")),
            ("http://crex.local/x", Some("http://10.0.0.7:7778/x")),
            ("tcp://10.0.0.7:6789", Some("tcp://10.0.0.7:6789;jade")),
            // A third party.
            ("http://10.0.0.8:7778/acc", None),
            ("http://10.0.0.8/acc", None),
            ("http://[::1]:7778/acc", None),
            ("http://crex:0/acc", None),
            ("http://crex:x/acc", None),
            ("tcp://crex:6789", None),
            ("udp://10.0.0.7:7778", None),
        ] {
            assert_eq!(given(stated).as_deref(), expected, "{stated}");
        }
    }
}
