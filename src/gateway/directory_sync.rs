//! The publisher synchronizes the directories of a gateway. It announces the agents of this host to
//! the network, and publishes the agents of other hosts to the processes of this host.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{ErrorChain, escape_name};
use fipa_sds::{
    ContactDirectory, Directory, Entry, HostDirectory, HostError, MergedDirectory, Registration,
    Role,
};
use fipa_transport::{Incarnation, Location, log_limit};
use parking_lot::Mutex;

use super::Network;
use super::names::own_agents;
use super::publish_pace::PublishPace;
use crate::config::is_on_loopback;
use crate::domain::service::Service;

/// Time between looks for lost agents that have ended, which causes no notification.
const LOST_CHECK: Duration = Duration::from_secs(15);

/// Publishes the agents of other hosts to the processes of this host, as reachable through this
/// gateway.
pub(super) struct DirectorySync {
    pub(super) host: Arc<HostDirectory>,
    /// The directory that announces the agents of this host, if there is one.
    pub(super) network: Option<Arc<dyn Directory>>,
    /// The agents of other hosts, except those that are only known as senders of letters.
    pub(super) known: Arc<MergedDirectory>,
    /// The agents of other hosts that have sent letters.
    pub(super) contacts: Arc<ContactDirectory>,
    /// The service that accepts letters for the published and announced agents.
    pub(super) service: Arc<Service>,
    /// Whether announcements stay on this host.
    pub(super) only_loopback: bool,
    pub(super) pace: Mutex<PublishPace>,
    /// The generations of `known` and `contacts` that are published. Locked while agents are.
    pub(super) published: Mutex<Option<[u64; 2]>>,
}

impl DirectorySync {
    /// Returns the locations that other hosts can use. A loopback address is none of them, because
    /// on another host it leads to that host.
    fn announced_locations(&self) -> Vec<Location> {
        let mut locations = self.service.announced_locations();
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

    /// Publishes the agents of other hosts because a letter is about to be handed to an agent that may reply. In a
    /// flood of such letters, the task does it after its pause. Returns whether they are published.
    pub(super) fn publish_for_letter(&self) -> bool {
        let mut published = self.published.lock();
        let wanted = self.generations();
        let is_published = |published: Option<[u64; 2]>| published == Some(wanted);
        if !is_published(*published) && self.pace.lock().may_hurry(Instant::now()) {
            self.publish_now(&mut published);
        }
        is_published(*published)
    }

    /// The generations of the directories with the agents of other hosts.
    fn generations(&self) -> [u64; 2] {
        [self.known.generation(), self.contacts.generation()]
    }

    /// Publishes all agents of other hosts on this host.
    fn publish(&self) {
        self.publish_now(&mut self.published.lock());
    }

    fn publish_now(&self, published: &mut Option<[u64; 2]>) {
        // Read before the agents, so that a change in between causes another publication.
        let generations = self.generations();
        let locations = self.service.locations();
        // An agent that leaves or returns meanwhile is in each view either lost or listed.
        let (contacts, known) = (self.contacts.view(), self.known.view());
        let (senders, listed) = (contacts.all(), known.all());
        let is_proved = |entry: &&Arc<Entry>| {
            let mandate = known.mandate_of(entry.mts.incarnation);
            mandate.is_proved()
        };
        let (proved, unproved): (Vec<_>, Vec<_>) = listed.iter().partition(is_proved);
        // The last entry holds a name and a registration: that of a directory, not of a contact, and a
        // proved one.
        let all = senders.iter().chain(unproved).chain(proved);
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
        let mut lost = known.lost_agents();
        lost.extend(contacts.lost_agents());
        let written = self.host.publish_remote(&through_here, &lost);
        let size = *written.as_ref().unwrap_or(&0);
        self.pace.lock().wrote(Instant::now(), size);
        match written {
            Ok(_) => *published = Some(generations),
            // A gateway that closes publishes nothing.
            Err(HostError::Closed) => {}
            Err(error) => {
                log_limit::warn!(error = %ErrorChain(&error), "cannot publish the agents of other hosts on this host");
            }
        }
    }
}

/// The task that keeps announcements and published entries up to date.
pub(super) struct DirectorySyncTask {
    publisher: Arc<DirectorySync>,
    network: Option<Arc<dyn Network>>,
    /// The announced agents, by name.
    announced: HashMap<Arc<str>, Arc<Entry>>,
    /// The locations with which the agents are announced.
    locations: Vec<Location>,
    /// The agents that could not be announced; this was logged once for each.
    refused: HashMap<Arc<str>, Incarnation>,
}

impl DirectorySyncTask {
    pub(super) fn new(publisher: Arc<DirectorySync>, network: Option<Arc<dyn Network>>) -> Self {
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
        let (mut local_changes, mut remote_changes) = (publisher.host.watch(), known.watch());
        let mut contact_changes = publisher.contacts.watch();
        let mut located = publisher.service.follow_locations();
        if publisher.network.is_some() && publisher.announced_locations().is_empty() {
            log_limit::info!(
                "this gateway has no location that other hosts can use, so it announces nothing by \
                 mDNS until it has one; see transport.tcp.listen and `ip address`"
            );
        }
        let mut forget = Some(Instant::now());
        loop {
            if let Some(network) = &publisher.network {
                self.announce(&**network);
            }
            let now = Instant::now();
            if forget.is_some_and(|forget| forget <= now) {
                forget = publisher.contacts.forget(now, &*known);
            }
            // Announcements do not wait for the pause after a publication.
            let publish = publisher.pace.lock().next(now);
            // Lost agents end without a notification.
            let mut next = now + LOST_CHECK;
            if publish <= now {
                publisher.publish();
            } else {
                next = next.min(publish);
            }
            let next = forget.map_or(next, |forget| forget.min(next));
            // Whether contacts are to be compared with the other agents of other hosts.
            let mut compare = None;
            let goes_on = tokio::select! {
                change = local_changes.next() => change.is_some(),
                change = remote_changes.next() => {
                    compare = Some(Instant::now());
                    change.is_some()
                }
                change = contact_changes.next() => {
                    compare = Some(Instant::now() + ContactDirectory::UNLISTED);
                    change.is_some()
                }
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
            while contact_changes
                .try_next()
                .or_else(|| local_changes.try_next())
                .is_some()
            {}
            while remote_changes.try_next().is_some() {
                compare = Some(Instant::now());
            }
            forget = match (forget, compare) {
                (Some(forget), Some(compare)) => Some(forget.min(compare)),
                (forget, compare) => forget.or(compare),
            };
        }
    }

    /// Announces the agents that joined on this host, and withdraws those that left.
    fn announce(&mut self, network: &dyn Directory) {
        let agents = own_agents(&self.publisher.host);
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
        for ((name, _), result) in leaving.iter().zip(updated.removed) {
            if let Err(error) = result {
                tracing::debug!(name = %escape_name(name), error = %ErrorChain(&error), "cannot withdraw an announcement");
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
                        tracing::debug!(name = %escape_name(name), error = %ErrorChain(&error), "cannot withdraw an announcement");
                    }
                    let before = self.refused.insert(Arc::clone(name), entry.incarnation);
                    if before != Some(entry.incarnation) {
                        log_limit::warn!(name = %escape_name(name), error = %ErrorChain(&error), "cannot announce an agent to other hosts");
                    }
                }
            }
        }
    }
}
