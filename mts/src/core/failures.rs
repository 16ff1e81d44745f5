//! Failure messages: their receivers and their rate.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Dialect, ErrorChain, Letter};
use fipa_sds::{Entry, MtsId, Reach, Role, Source};
use fipa_transport::counts::{Direction, Event, LetterOutcome};
use fipa_transport::{
    FailureReason, Incarnation, Kind, LegacySource, Location, PeerId, Signature, Stream, log_limit,
    quota_address,
};

use super::action::Action;
use super::ids::registration_of;
use super::inbox::Received;
use super::lane::OpenLetter;
use super::lanes::own_lane;
use super::limits::log_omitted;
use super::origin::Origin;
use super::undelivered::{FailureTarget, Undelivered};
use super::{Core, News, Now, work};
use crate::dial::{Claim, Endpoint, judge, located_at};
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
            count: 1,
        });
        self.send_failures(now);
    }

    /// Sends the pending FIPA `failure` messages.
    pub(super) fn send_failures(&mut self, now: Now) {
        while let Some(undelivered) = self.table.undelivered.pop_front() {
            let name = Arc::clone(&self.table.config.name);
            let name = &*name;
            let from = match &undelivered.sender {
                FailureTarget::LegacyPeer { from, .. } => Some(*from),
                FailureTarget::Ours(_) | FailureTarget::Remote(_) => None,
            };
            let address = from.map(|from| from.address);
            let failed = match &undelivered.sender {
                FailureTarget::LegacyPeer { failed, .. } | FailureTarget::Remote(failed) => {
                    let failed = Arc::clone(failed);
                    let named = failed.sender.name();
                    if !self.failure_limit.allows(now.instant, address, named) {
                        let is_added = from.is_some_and(|from| {
                            self.summaries
                                .add(now.instant, (from, &failed), undelivered)
                        });
                        if is_added {
                            log_limit::warn!(
                                of: address.map(quota_address),
                                "failure messages beyond a limit are counted in one message to their sender"
                            );
                        } else {
                            log_omitted(address);
                        }
                        continue;
                    }
                    // Failure messages are encoded only in proportion to the received bytes.
                    let len = undelivered.letter.len();
                    if !self.failure_limit.covers(address, len) {
                        continue;
                    }
                    Some(failed)
                }
                FailureTarget::Ours(_) => Failed::of(&undelivered.letter).map(Arc::new),
            };
            let Some(failed) = failed else {
                continue;
            };
            let Undelivered {
                sender,
                receiver,
                reason,
                detail,
                count,
                ..
            } = undelivered;
            let report = Failure {
                letter: &failed,
                receiver: &receiver,
                reason,
                detail: &detail,
                count,
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
                    let counts = self.table.counts();
                    counts.event(Event::FailureMessage, 1);
                    counts.letter(Direction::Received, None, LetterOutcome::Delivered);
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
                None => from.and_then(|from| stated_entry(self, &failed.sender, from)),
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
            let open_letter = OpenLetter::new(now.instant, origin, letter, letter_of, deadline);
            self.table
                .notice(stream, sequence, &entry.name, || News::Sent {
                    submission: None,
                    letter: open_letter.letter.clone(),
                });
            if stated.is_some()
                && let Some(lane) = self.lanes.get_mut(&id)
            {
                lane.set_stated(Arc::clone(&entry));
            }
            self.put(now, id, open_letter);
        }
    }
}

/// The detail of a failure.
pub(super) fn cannot_be_decoded(why: &dyn std::fmt::Display) -> String {
    format!("the message cannot be decoded: {why}")
}

/// An address that an agent of a legacy peer states as its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Stated {
    pub(super) location: Location,
    pub(super) at: SocketAddr,
    /// The host name of the address, which was replaced by the address of the connection.
    pub(super) host: Option<String>,
}

/// Returns the addresses that an agent of a legacy peer states as its own, at most
/// [`Entry::MAX_LOCATIONS`]. JADE states its host by name; the name is replaced by the address that the letter
/// came from. Locations of transports that a gateway may lack come last.
pub(super) fn stated<'a>(
    addresses: impl IntoIterator<Item = &'a str>,
    from: LegacySource,
) -> Vec<Stated> {
    let addresses = addresses.into_iter().take(Entry::MAX_LOCATIONS);
    let stated = addresses.filter_map(|address| {
        let location: Location = address.parse().ok()?;
        let is_http = matches!(location.kind(), Kind::Http | Kind::Https);
        let (at, host) = match Endpoint::of(&location)? {
            Endpoint::Numeric(at) => (at, None),
            Endpoint::Named(host, port) if is_http => {
                (SocketAddr::new(from.address, port), Some(host))
            }
            Endpoint::Named(..) => return None,
        };
        let location = match is_http {
            true => located_at(&location, at)?,
            false => location,
        };
        let location = location.with_signature(from.signature).ok()?;
        Some(Stated { location, at, host })
    });
    let mut stated: Vec<Stated> = stated.collect();
    stated.sort_by_key(|it| !it.location.kind().is_supported());
    stated
}

impl Core {
    /// Sets the addresses at which this service listens on the network.
    pub fn listens_at(&mut self, own: Vec<SocketAddr>) {
        self.own_addresses = own;
    }

    /// Whether letters may go to this address, which came with this claim.
    pub(super) fn permits(&self, at: SocketAddr, claim: Claim) -> bool {
        let networks = &self.table.config.contact_networks;
        let judged = judge(at, claim, networks, &self.own_addresses);
        judged
            .inspect_err(|why| tracing::debug!(%at, %why, "an address in a letter is not used"))
            .is_ok()
    }
}

/// An agent that is not in the directory, with the locations that it states as its own.
fn stated_entry(core: &Core, agent: &AgentId, from: LegacySource) -> Option<Arc<Entry>> {
    let addresses = agent.addresses().iter().map(|address| &**address);
    let stated = stated(addresses, from).into_iter();
    let claim = Claim::Return(from.address);
    let permitted = stated.filter(|it| core.permits(it.at, claim));
    let locations: Vec<Location> = permitted.map(|it| it.location).collect();
    if locations.is_empty() {
        return None;
    }
    let entry = Entry {
        name: agent.name().into(),
        agent_type: String::new(),
        incarnation: Incarnation::UNKNOWN,
        locations,
        mts: MtsId::new(agent.name(), Incarnation::UNKNOWN),
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

    /// A core that listens at 10.0.0.1:7778, with these networks.
    fn core(networks: &[&str]) -> Core {
        let config = crate::core::CoreConfig {
            contact_networks: networks.iter().map(|it| it.parse().unwrap()).collect(),
            ..crate::core::CoreConfig::new("mts", Incarnation::from_u64(1), Vec::new())
        };
        let directory = fipa_sds::MemoryDirectory::new(MtsId::new("mts", Incarnation::from_u64(1)));
        let mut core = Core::new(config, fipa_sds::Directory::view(&directory));
        core.listens_at(vec!["10.0.0.1:7778".parse().unwrap()]);
        core
    }

    /// The location at which the agent of a letter from this host is answered.
    fn answered(core: &Core, from: &str, address: &str) -> Option<String> {
        let from = LegacySource {
            address: from.parse().unwrap(),
            signature: Signature::JadeProxy,
        };
        let agent = AgentId::new("echo").unwrap().with_address(address).unwrap();
        let entry = stated_entry(core, &agent, from)?;
        entry.locations.first().map(ToString::to_string)
    }

    #[test]
    fn a_platform_is_answered_only_at_the_host_that_its_letter_came_from() {
        let core = core(&["10.9.0.0/16"]);
        for (stated, expected) in [
            ("http://10.0.0.7:7778/acc", Some("http://10.0.0.7:7778/acc")),
            ("http://10.0.0.7/acc", Some("http://10.0.0.7:7778/acc")),
            ("http://crex:7778/acc", Some("http://10.0.0.7:7778/acc")),
            ("http://crex.local/x", Some("http://10.0.0.7:7778/x")),
            ("tcp://10.0.0.7:6789", Some("tcp://10.0.0.7:6789;jade")),
            ("http://crex:80/acc", Some("http://10.0.0.7:80/acc")),
            // A network that the operator listed.
            ("http://10.9.1.2:22/acc", Some("http://10.9.1.2:22/acc")),
            // A third party.
            ("http://10.0.0.8:7778/acc", None),
            ("http://10.0.0.8/acc", None),
            ("http://[::1]:7778/acc", None),
            ("http://crex:0/acc", None),
            ("http://crex:x/acc", None),
            ("http://crex:22/acc", None),
            ("tcp://crex:6789", None),
            ("udp://10.0.0.7:7778", None),
        ] {
            let answered = answered(&core, "10.0.0.7", stated);
            assert_eq!(answered.as_deref(), expected, "{stated}");
        }
    }

    #[test]
    fn a_letter_with_many_addresses_reaches_no_third_host_and_not_this_gateway() {
        let core = core(&[]);
        for number in 0..500 {
            let third = format!("http://10.{}.{}.9:7778/acc", number / 250, number % 250);
            assert_eq!(answered(&core, "10.200.0.7", &third), None, "{third}");
        }
        for (from, stated) in [
            ("10.0.0.7", "http://127.0.0.1:8080/acc"),
            ("10.0.0.7", "http://169.254.169.254/latest"),
            ("10.0.0.7", "http://[fe80::1]:7778/acc"),
            ("10.0.0.7", "http://224.0.0.1:7778/acc"),
            ("10.0.0.7", "http://0.0.0.0:7778/acc"),
            ("10.0.0.7", "http://10.0.0.1:7778/acc"),
            ("10.0.0.1", "http://10.0.0.1:7778/acc"),
            ("127.0.0.1", "http://127.0.0.1:7778/acc"),
            ("127.0.0.1", "http://127.0.0.1:22/acc"),
        ] {
            assert_eq!(answered(&core, from, stated), None, "{stated} from {from}");
        }
    }
}
