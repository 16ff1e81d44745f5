//! Keeps the directories of a gateway in step: what lives on this host is announced to the
//! network, and what is known of other hosts is told to the processes here.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use fipa_sds::{
    ContactDirectory, Directory, Entry, HostDirectory, MergedDirectory, Reach, Registration, Role,
};
use fipa_transport::{Incarnation, Location};

use super::Network;
use crate::config::is_on_loopback;
use crate::service::Service;

/// Tells the processes of this host who is on others, as reachable through this gateway.
pub(super) struct Publisher {
    pub(super) host: Arc<HostDirectory>,
    /// Where the agents of this host are announced, if anywhere.
    pub(super) network: Option<Arc<dyn Directory>>,
    /// Who is known of other hosts without having written.
    pub(super) known: Arc<MergedDirectory>,
    pub(super) contacts: Arc<ContactDirectory>,
    /// Takes letters for all that this gateway stands for.
    pub(super) service: Arc<Service>,
    /// Whether `security.keys` is set.
    pub(super) has_keys: bool,
    /// Whether what is announced stays on this host.
    pub(super) only_loopback: bool,
}

impl Publisher {
    /// The locations that mean something on other hosts. Loopback addresses do not: there they lead
    /// to the other host itself.
    fn announced_locations(&self) -> Vec<Location> {
        let mut locations = self.service.locations();
        locations.retain(|location| {
            let stays_here = location.kind().is_host_local();
            !stays_here && (self.only_loopback || !is_on_loopback(location.address()))
        });
        locations
    }

    pub(super) fn publish(&self) {
        let locations = self.service.locations();
        let (heard, known) = (self.contacts.entries(), self.known.entries());
        // The later of one name counts: what is known, before what was heard.
        let all = heard.iter().chain(known.iter());
        let through_here = all
            .filter(|entry| entry.role != Role::Gateway)
            .map(|entry| match entry.is_unsupported() {
                // Its own locations say why no letter reaches it, by this gateway neither.
                true => Entry::clone(entry),
                false => Entry {
                    locations: locations.clone(),
                    ..Entry::clone(entry)
                },
            });
        if let Err(error) = self.host.publish_remote(through_here.collect()) {
            tracing::warn!(%error, "the processes of this host are not told of all other hosts");
        }
    }
}

/// The agents and coalitions of this host, as far as others are to know of them: first those that are, then those
/// whose name belongs to an agent of another host, too, each with that holder.
///
/// Without keys the earlier registration has the name on all hosts. With keys the times that other
/// hosts state do not count: the agents of this host are announced, and claims that no link proves
/// change nothing.
pub(super) fn own_agents(
    host: &HostDirectory,
    known: &dyn Directory,
    has_keys: bool,
) -> (Vec<Arc<Entry>>, Vec<Contested>) {
    let (mut own, mut contested) = (Vec::new(), Vec::new());
    let entries = host.entries();
    let agents = entries
        .iter()
        .filter(|entry| entry.reach == Reach::Local && entry.role != Role::Gateway);
    let age = |entry: &Entry| (entry.registered, entry.incarnation);
    for entry in agents {
        let holder = known.known(&entry.name);
        let holder = holder.filter(|holder| holder.incarnation != entry.incarnation);
        let holder = holder.filter(|holder| match has_keys {
            true => known.mandate(holder.mts.incarnation).is_proved(),
            false => age(holder) < age(entry),
        });
        if holder.is_none() || has_keys {
            own.push(Arc::clone(entry));
        }
        if let Some(holder) = holder {
            contested.push(Contested {
                entry: Arc::clone(entry),
                holder,
                is_announced: has_keys,
            });
        }
    }
    (own, contested)
}

/// An agent of this host whose name an agent of another host has as well.
pub(super) struct Contested {
    pub(super) entry: Arc<Entry>,
    pub(super) holder: Arc<Entry>,
    /// Whether other hosts are told of the agent nevertheless.
    pub(super) is_announced: bool,
}

/// The task that does it.
pub(super) struct Keeper {
    publisher: Arc<Publisher>,
    network: Option<Arc<dyn Network>>,
    announced: HashMap<Arc<str>, Arc<Entry>>,
    /// The locations with which they are announced.
    locations: Vec<Location>,
    /// Those that could not be announced, which was said once.
    refused: HashMap<Arc<str>, Incarnation>,
}

impl Keeper {
    pub(super) fn new(publisher: Arc<Publisher>, network: Option<Arc<dyn Network>>) -> Self {
        Self {
            publisher,
            network,
            announced: HashMap::new(),
            locations: Vec::new(),
            refused: HashMap::new(),
        }
    }

    pub(super) async fn run(mut self) {
        let publisher = Arc::clone(&self.publisher);
        let known = Arc::clone(&publisher.known);
        let (mut here, mut there) = (publisher.host.watch(), known.watch());
        let mut located = publisher.service.follow_locations();
        if publisher.network.is_some() && publisher.announced_locations().is_empty() {
            tracing::info!(
                "this gateway has no location that other hosts can use, so it announces nothing by \
                 mDNS until it has one; see transport.tcp.listen and `ip address`"
            );
        }
        let mut forgetting = tokio::time::interval(ContactDirectory::MEMORY / 4);
        loop {
            if let Some(network) = &publisher.network {
                self.announce(&**network);
            }
            publisher
                .contacts
                .forget(Instant::now(), |entry| known.known(&entry.name).is_some());
            publisher.publish();
            let goes_on = tokio::select! {
                change = here.next() => change.is_some(),
                change = there.next() => change.is_some(),
                moved = located.changed() => {
                    if let Some(network) = &self.network {
                        network.interfaces_changed();
                    }
                    moved.is_ok()
                }
                _ = forgetting.tick() => true,
            };
            if !goes_on {
                return;
            }
            // Many changes that came together are one.
            while here.try_next().is_some() || there.try_next().is_some() {}
        }
    }

    /// Announces what has joined on this host, and takes back what has left.
    fn announce(&mut self, network: &dyn Directory) {
        let (agents, _) = own_agents(
            &self.publisher.host,
            &*self.publisher.known,
            self.publisher.has_keys,
        );
        let mine: HashMap<&Arc<str>, &Arc<Entry>> =
            agents.iter().map(|entry| (&entry.name, entry)).collect();
        // Who is the same agent changes in place, without having been away.
        let mut leaving = Vec::new();
        self.announced.retain(|name, entry| {
            let now = mine.get(name);
            let stays = now.is_some_and(|now| now.incarnation == entry.incarnation);
            if !stays {
                leaving.push((Arc::clone(name), entry.incarnation));
            }
            stays
        });
        self.refused.retain(|name, _| mine.contains_key(name));
        let locations = self.publisher.announced_locations();
        let mut joining: Vec<(&Arc<str>, &Arc<Entry>)> = mine.into_iter().collect();
        // Without any, what is announced stays as it is, because the host may be about to get an
        // address; what is not has to wait for that.
        let relocated = self.locations != locations && !locations.is_empty();
        joining.retain(|(name, entry)| {
            let changed = relocated || self.announced.get(*name) != Some(*entry);
            changed && !locations.is_empty()
        });
        if relocated {
            self.locations.clone_from(&locations);
        }
        if leaving.is_empty() && joining.is_empty() {
            return;
        }
        let registrations = joining.iter().map(|(name, entry)| Registration {
            agent_type: entry.agent_type.clone(),
            description: entry.description.clone(),
            registered: entry.registered,
            role: entry.role.clone(),
            ..Registration::new(Arc::clone(name), entry.incarnation, locations.clone())
        });
        // In one go, so that coalitions among them are seen to change together.
        let updated = network.update(&leaving, registrations.collect());
        for ((name, _), left) in leaving.iter().zip(updated.left) {
            if let Err(error) = left {
                tracing::debug!(%name, %error, "was not announced any more");
            }
        }
        for ((name, entry), joined) in joining.into_iter().zip(updated.joined) {
            match joined {
                Ok(_) => {
                    self.announced.insert(Arc::clone(name), Arc::clone(entry));
                    self.refused.remove(name);
                }
                Err(error) => {
                    // What was announced of it before is not true any more.
                    let was = self.announced.remove(name);
                    if let Some(was) = was
                        && let Err(error) = network.deregister(name, was.incarnation)
                    {
                        tracing::debug!(%name, %error, "was not announced any more");
                    }
                    let before = self.refused.insert(Arc::clone(name), entry.incarnation);
                    if before != Some(entry.incarnation) {
                        tracing::warn!(%name, %error, "an agent is not announced to other hosts");
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use fipa_sds::{Exchange, HostConfig, Mts, Present};
    use fipa_transport::Mandate;

    use super::*;

    /// The agents that are announced, and those that are contested, of a host with a rover while a
    /// neighbour with this mandate tells of a rover that was registered long before.
    fn announced(mandate: Mandate, has_keys: bool) -> (usize, usize) {
        let place = tempfile::tempdir().unwrap();
        let host = HostDirectory::open(HostConfig {
            dir: place.path().join("domain"),
            mts: Mts::new("mts", Incarnation::from_u64(1)),
            gateway: true,
        });
        let host = host.unwrap();
        let at = "shm://0000000000000001#0000000000000001".parse().unwrap();
        let rover = Registration::new("rover", Incarnation::from_u64(2), vec![at]);
        host.register(rover).unwrap();
        let gateway = Incarnation::from_u64(7);
        let mut exchange = Exchange::new(0);
        let present = Present {
            mts: Mts::new("crex-mts", gateway),
            locations: vec!["tcp://192.0.2.1:7788#0000000000000007".parse().unwrap()],
            mandate,
        };
        exchange.handle_neighbours(Instant::now(), &[present]);
        let told = br#"{"version":1,"tell":{"full":{"version":1,"first":true,"last":true,
            "agents":[{"name":"rover","id":"0000000000000008","registered":1}]}}}"#;
        let taken = exchange.handle_letter(Instant::now(), gateway, told);
        taken.unwrap();
        let known = MergedDirectory::new(vec![exchange.directory()]);
        let (own, contested) = own_agents(&host, &known, has_keys);
        assert!(contested.iter().all(|it| it.is_announced == has_keys));
        (own.len(), contested.len())
    }

    #[tokio::test]
    async fn with_keys_no_claimed_time_keeps_agents_of_this_host_from_others() {
        let certified = |agents: &[&str]| {
            Mandate::Certified(agents.iter().map(|agent| (*agent).to_owned()).collect())
        };
        assert_eq!(announced(Mandate::Unproved, false), (0, 1));
        assert_eq!(announced(Mandate::Unproved, true), (1, 0));
        assert_eq!(announced(certified(&[]), true), (1, 1), "told");
        assert_eq!(announced(certified(&["crex"]), true), (1, 0));
    }
}
