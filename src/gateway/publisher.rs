//! The publisher synchronizes the directories of a gateway. It announces the agents of this host to
//! the network, and publishes the agents of other hosts to the processes of this host.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use fipa_acl::ErrorChain;
use fipa_sds::{
    ContactDirectory, Directory, Entry, HostDirectory, HostError, MergedDirectory, Reach,
    Registration, Role,
};
use fipa_transport::{Incarnation, Location};

use super::Network;
use crate::config::is_on_loopback;
use crate::routes::ASKER_TYPE;
use crate::service::Service;

/// Publishes the agents of other hosts to the processes of this host, as reachable through this
/// gateway.
pub(super) struct Publisher {
    pub(super) host: Arc<HostDirectory>,
    /// The directory that announces the agents of this host, if there is one.
    pub(super) network: Option<Arc<dyn Directory>>,
    /// The agents of other hosts, except those that are only known as senders of letters.
    pub(super) known: Arc<MergedDirectory>,
    /// The agents of other hosts that have sent letters.
    pub(super) contacts: Arc<ContactDirectory>,
    /// The service that accepts letters for the published and announced agents.
    pub(super) service: Arc<Service>,
    /// Whether `security.keys` is set.
    pub(super) has_keys: bool,
    /// Whether announcements stay on this host.
    pub(super) only_loopback: bool,
}

impl Publisher {
    /// Returns the locations that other hosts can use. A loopback address is none of them, because
    /// on another host it leads to that host.
    fn announced_locations(&self) -> Vec<Location> {
        let mut locations = self.service.locations();
        locations.retain(|location| {
            let stays_here = location.kind().is_host_local();
            !stays_here && (self.only_loopback || !is_on_loopback(location.address()))
        });
        locations
    }

    /// Whether this gateway lacks the transports of an agent.
    fn is_unsupported(&self, entry: &Entry) -> bool {
        let used = |location: &Location| self.service.uses(location.kind());
        entry.is_unsupported() && !entry.locations.iter().any(used)
    }

    /// Publishes all agents of other hosts on this host.
    pub(super) fn publish(&self) {
        let locations = self.service.locations();
        let (heard, known) = (self.contacts.entries(), self.known.entries());
        let is_proved = |entry: &&Arc<Entry>| {
            let mandate = self.known.mandate(entry.mts.incarnation);
            mandate.is_proved()
        };
        let (proved, unproved): (Vec<_>, Vec<_>) = known.iter().partition(is_proved);
        // The last entry holds a name and a registration: that of a directory, not of a contact, and a
        // proved one.
        let all = heard.iter().chain(unproved).chain(proved);
        let through_here = all
            .filter(|entry| entry.role != Role::Gateway)
            .map(|entry| match self.is_unsupported(entry) {
                // Its own locations show the reason why letters cannot reach it.
                true => Arc::clone(entry),
                false => Arc::new(Entry {
                    locations: locations.clone(),
                    ..Entry::clone(entry)
                }),
            });
        let through_here: Vec<Arc<Entry>> = through_here.collect();
        let lost = self.known.lost_agents();
        let published = self.host.publish_remote(&through_here, &lost);
        match published {
            // A gateway that closes publishes nothing.
            Ok(()) | Err(HostError::Closed) => {}
            Err(error) => {
                tracing::warn!(error = %ErrorChain(&error), "cannot publish the agents of other hosts on this host");
            }
        }
    }
}

/// Returns the agents and coalitions of this host that are announced to other hosts, and those
/// whose name an agent of another host also has, each with that agent.
///
/// Without keys, the earlier registration holds the name on all hosts. With keys, the registration
/// times of other hosts have no effect: all agents of this host are announced, and a claim that no
/// link proves is ignored. Agents that query this gateway are not announced.
pub(super) fn own_agents(
    host: &HostDirectory,
    known: &dyn Directory,
    has_keys: bool,
) -> (Vec<Arc<Entry>>, Vec<Contested>) {
    let (mut own, mut contested) = (Vec::new(), Vec::new());
    let entries = host.entries();
    let agents = entries
        .iter()
        .filter(|entry| entry.reach == Reach::Local && entry.role != Role::Gateway)
        .filter(|entry| *entry.agent_type != *ASKER_TYPE);
    for entry in agents {
        let holder = other_holder(entry, known, has_keys);
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

/// Returns the agent of another host that has the name of this agent of this host, with a better or a
/// proved claim: see [`own_agents`].
pub(super) fn other_holder(
    entry: &Entry,
    known: &dyn Directory,
    has_keys: bool,
) -> Option<Arc<Entry>> {
    let age = |entry: &Entry| (entry.registered, entry.incarnation);
    let holder = known.known(&entry.name)?;
    let has_name = holder.incarnation != entry.incarnation
        && match has_keys {
            true => known.mandate(holder.mts.incarnation).is_proved(),
            false => age(&holder) < age(entry),
        };
    has_name.then_some(holder)
}

/// An agent of this host whose name an agent of another host also has.
pub(super) struct Contested {
    pub(super) entry: Arc<Entry>,
    pub(super) holder: Arc<Entry>,
    /// Whether the agent of this host is announced to other hosts nevertheless.
    pub(super) is_announced: bool,
}

/// The task that keeps announcements and published entries up to date.
pub(super) struct PublishTask {
    publisher: Arc<Publisher>,
    network: Option<Arc<dyn Network>>,
    /// The announced agents, by name.
    announced: HashMap<Arc<str>, Arc<Entry>>,
    /// The locations with which the agents are announced.
    locations: Vec<Location>,
    /// The agents that could not be announced; this was logged once for each.
    refused: HashMap<Arc<str>, Incarnation>,
}

impl PublishTask {
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
        let mut heard = publisher.contacts.watch();
        let mut located = publisher.service.follow_locations();
        if publisher.network.is_some() && publisher.announced_locations().is_empty() {
            tracing::info!(
                "this gateway has no location that other hosts can use, so it announces nothing by \
                 mDNS until it has one; see transport.tcp.listen and `ip address`"
            );
        }
        loop {
            if let Some(network) = &publisher.network {
                self.announce(&**network);
            }
            let now = Instant::now();
            let next = publisher.contacts.forget(now, &*known);
            publisher.publish();
            // Lost agents end without a notification.
            let longest = now + ContactDirectory::MEMORY / 4;
            let next = next.map_or(longest, |next| next.min(longest));
            let goes_on = tokio::select! {
                change = here.next() => change.is_some(),
                change = there.next() => change.is_some(),
                change = heard.next() => change.is_some(),
                moved = located.changed() => {
                    if let Some(network) = &self.network {
                        network.interfaces_changed();
                    }
                    moved.is_ok()
                }
                () = tokio::time::sleep_until(next.into()) => true,
            };
            if !goes_on {
                return;
            }
            // Several pending changes are handled together.
            let mut more = || here.try_next().or_else(|| there.try_next());
            while more().or_else(|| heard.try_next()).is_some() {}
        }
    }

    /// Announces the agents that joined on this host, and withdraws those that left.
    fn announce(&mut self, network: &dyn Directory) {
        let (agents, _) = own_agents(
            &self.publisher.host,
            &*self.publisher.known,
            self.publisher.has_keys,
        );
        let mine: HashMap<&Arc<str>, &Arc<Entry>> =
            agents.iter().map(|entry| (&entry.name, entry)).collect();
        // An entry with an unchanged incarnation is updated in place, without being withdrawn.
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
        // Without locations, announced agents stay announced, because the host may be about to get
        // an address. Agents that are not announced yet wait for it.
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
        // One update for all, so that other hosts see the changes of a coalition together.
        let updated = network.update(&leaving, registrations.collect());
        for ((name, _), left) in leaving.iter().zip(updated.left) {
            if let Err(error) = left {
                tracing::debug!(%name, error = %ErrorChain(&error), "cannot withdraw an announcement");
            }
        }
        for ((name, entry), joined) in joining.into_iter().zip(updated.joined) {
            match joined {
                Ok(_) => {
                    self.announced.insert(Arc::clone(name), Arc::clone(entry));
                    self.refused.remove(name);
                }
                Err(error) => {
                    // The previous announcement is outdated.
                    let was = self.announced.remove(name);
                    if let Some(was) = was
                        && let Err(error) = network.deregister(name, was.incarnation)
                    {
                        tracing::debug!(%name, error = %ErrorChain(&error), "cannot withdraw an announcement");
                    }
                    let before = self.refused.insert(Arc::clone(name), entry.incarnation);
                    if before != Some(entry.incarnation) {
                        tracing::warn!(%name, error = %ErrorChain(&error), "cannot announce an agent to other hosts");
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use fipa_sds::{Exchange, HostConfig, Mts, Present};
    use fipa_transport::{Mandate, Principal};

    use super::*;

    /// Returns the number of announced and of contested agents of a host with the agent `rover`,
    /// while a neighbor with this mandate has an agent `rover` that was registered long before.
    fn announced(mandate: Mandate, has_keys: bool) -> (usize, usize) {
        let place = tempfile::tempdir().unwrap();
        let host = HostDirectory::open(HostConfig {
            brief: false,
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
            principal: Principal::Certificate([7; 32]),
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
