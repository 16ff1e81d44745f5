//! Changes around this service: of the directory, of connections, of trust and of the network.

use std::sync::Arc;

use fipa_sds::{Entry, Source};
use fipa_transport::{Body, Incarnation, Introduction, Location, Principal, Stream};

use super::lanes::is_at;
use super::notes::{Note, note_parcel};
use super::passes::Concern;
use super::{Core, Now, Peer, PeerState};

impl Core {
    /// Handles a change of the directory, after [`set_view`](Self::set_view). Of many lanes, this call
    /// visits a portion, and calls of [`handle_timeout`](Self::handle_timeout) visit the others.
    pub fn handle_directory_change(&mut self, now: Now) {
        self.send_to_leaders(now);
        self.passes.begin(now.instant, Concern::Directory);
        self.visit_lanes(now);
        self.send_failures(now);
    }

    /// Handles an entry that left the directory or was replaced by another of the same name. Must
    /// be called before [`handle_directory_change`](Self::handle_directory_change). For 30 s a
    /// gateway answers letters for an agent that left its host with [`Answer::Moved`](fipa_transport::Answer::Moved).
    pub fn handle_departure(&mut self, now: Now, entry: &Entry) {
        if self.table.config.forwards {
            self.table.departed.record_departure(now.instant, entry);
            self.principals.record_departure(entry);
        }
    }

    /// Handles another entry of the same registration. Must be called before
    /// [`handle_directory_change`](Self::handle_directory_change), which then ends the attempts at the locations
    /// that its service has left. Returns these locations, for [`location_vacated`](fipa_transport::Transport::location_vacated). The
    /// announcement of a service with a certificate counts only if it comes from the service itself.
    pub fn handle_relocation(&mut self, before: &Entry, after: &Entry) -> Vec<Location> {
        let is_there = |service: Incarnation| {
            let mut locations = after.locations.iter();
            service.is_known() && locations.any(|it| it.incarnation() == service)
        };
        let is_proved = |service: Incarnation| {
            let principal = self.principals.of_service(service);
            matches!(principal, Some(Principal::Certificate(_)))
        };
        let vacated: Vec<Location> = before
            .locations
            .iter()
            .filter(|it| !it.kind().is_host_local() && !after.locations.contains(it))
            .filter(|it| is_there(it.incarnation()))
            .filter(|it| after.source == Source::Exchange || !is_proved(it.incarnation()))
            .cloned()
            .collect();
        for location in &vacated {
            self.table.routes.service_left(location);
        }
        vacated
    }

    /// Sets the services to keep in touch with.
    pub fn keep_in_touch(&mut self, now: Now, peers: Vec<Peer>) {
        self.static_peers.set(now.instant, peers, &mut self.table);
    }

    /// Returns the state of contact with each of these services.
    #[must_use]
    pub fn peers(&self, now: Now) -> Vec<PeerState> {
        self.static_peers.states(now.instant)
    }

    /// Handles the end of a connection that was opened for this location.
    pub fn handle_disconnected(&mut self, now: Now, peer: &Introduction) {
        self.principals.disconnected(peer);
        if let Some(dialed) = &peer.dialed {
            self.static_peers.disconnected(now.instant, dialed);
        }
    }

    /// Whether a peer may be the service that it claims to be: `false` if another principal has proved
    /// to be it and is connected, or if its incarnation is that of another principal's agent.
    #[must_use]
    pub fn accepts(&self, peer: &Introduction) -> bool {
        self.principals.accepts(peer, &*self.table.view)
    }

    /// Handles the introduction of a service on a connection. Its incarnation now belongs to the
    /// principal that the link proves, and failed routes to it may work again.
    pub fn handle_introduced(&mut self, now: Now, peer: &Introduction) {
        self.principals.introduced(peer, &*self.table.view);
        let service = peer.hop.location.incarnation();
        // It has proved another certificate.
        let withdrawn = self.table.withdrawn.get(&service).copied();
        if withdrawn.is_some() && withdrawn != self.principals.of_service(service) {
            self.table.withdrawn.remove(&service);
        }
        self.table.repeat_reports(now.instant, &peer.hop.location);
        self.await_answers(now);
        if service.is_known() {
            self.handle_reachable(now, Some(service));
        }
    }

    /// Handles a change of the trusted certificates, which `is_trusted` knows by their fingerprints. Letters
    /// for the agents of services whose certificate is no longer trusted end. Returns these services.
    /// Letters of their agents that were taken before stay.
    pub fn handle_trust(
        &mut self,
        now: Now,
        is_trusted: impl Fn(&[u8; 32]) -> bool,
    ) -> Vec<(Incarnation, Principal)> {
        self.table.withdrawn = self.principals.untrusted(is_trusted);
        if !self.table.withdrawn.is_empty() {
            // Only the owner of this host withdraws trust.
            for id in self.lanes_in_order() {
                self.with_lane(now, id, |lane, table| {
                    if !lane.is_empty() {
                        lane.trust_changed(now.instant, table);
                    }
                });
            }
        }
        self.send_failures(now);
        let withdrawn = self.table.withdrawn.iter();
        withdrawn.map(|(it, principal)| (*it, *principal)).collect()
    }

    /// Handles a change of this host's network, or a connection that this service has opened. Drops
    /// the recorded failures of routes to the service, or of all routes if `service` is `None`, and
    /// dispatches the letters that wait because of them.
    pub fn handle_reachable(&mut self, now: Now, service: Option<Incarnation>) {
        let had_failed = self
            .table
            .routes
            .forget_failures(|location| is_at(service, location));
        if service.is_none() {
            self.static_peers.ask_again(now.instant, &mut self.table);
        } else if !had_failed {
            // No letter waits for this service. A peer decides how often it connects.
            return;
        }
        self.passes.begin(now.instant, Concern::Reachable(service));
        self.visit_lanes(now);
        self.send_failures(now);
    }

    /// Opens connections to these locations, to announce the current locations of this service to
    /// them: dispatches one credit to each, which no lane waits for. It is not repeated.
    pub fn announce_locations(&mut self, services: Vec<(Arc<str>, Location)>) {
        for (name, location) in services {
            let no_stream = Stream::between(Incarnation::UNKNOWN, Incarnation::UNKNOWN);
            let parcel = note_parcel(no_stream, name, 0, Body::Credit);
            self.table.note(Note::once(location, parcel));
        }
    }
}
