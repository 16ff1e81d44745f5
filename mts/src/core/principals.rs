//! Principals of services and of agents' registrations.
//!
//! A parcel names the service that handed it over, and the registration of the agent that sent it.
//! Both names are public, so they count only as far as the link proves them: a service belongs to
//! the [principal](Principal) that introduced itself with its incarnation, and an agent to the
//! principal of its gateway. Without keys, all services of other hosts are one principal.

use std::collections::VecDeque;
use std::sync::Arc;

use fipa_sds::{Entry, Reach, Role, View};
use fipa_transport::{Hop, Incarnation, Introduction, Principal, Realm};

use crate::Map;

/// Maximum number of services. Of those without a connection, the earliest connected one of the principal that has
/// most of them is evicted first: a principal that invents services evicts only its own.
const MAX_SERVICES: usize = 4096;
/// Maximum number of registrations of one principal: a principal that invents senders evicts only
/// its own.
const MAX_SENDERS: usize = 4096;

/// The services and senders of other hosts.
#[derive(Debug, Default)]
pub(super) struct Principals {
    services: Map<Incarnation, Service>,
    /// The services in the order in which they were first connected.
    order: VecDeque<Incarnation>,
    /// Senders that were not in the directory when their first letter came, and those that left it;
    /// `None` for one whose gateway was never connected.
    senders: Map<Incarnation, Option<Principal>>,
    senders_by_owner: Map<Option<Principal>, VecDeque<Incarnation>>,
}

#[derive(Debug)]
struct Service {
    principal: Principal,
    /// The realm of the senders that it vouches for. A renewed certificate keeps it.
    realm: Realm,
    name: Arc<str>,
    /// Number of open connections with it.
    connections: usize,
}

/// Reason for refusing a parcel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum PrincipalError {
    /// The service of the link belongs to another principal.
    #[error("another service has already proved the incarnation that this link claims")]
    Service,
    /// The gateway of the sender has not introduced itself yet, so it is not known to be this one.
    /// The answer is not final.
    #[error("the gateway of the sender has not introduced itself yet")]
    NotIntroduced,
    /// The sender belongs to another principal.
    #[error("the link does not prove to speak for the sender of this letter")]
    Sender,
}

impl Principals {
    /// Handles the introduction of a service on a connection. The service keeps its principal while
    /// it is connected; afterwards, a service of the same name may have renewed its certificate.
    pub(super) fn introduced(&mut self, peer: &Introduction, view: &dyn View) {
        let incarnation = peer.hop.location.incarnation();
        if !peer.hop.is_remote() || !incarnation.is_known() || !self.accepts(peer, view) {
            return;
        }
        let realm = match (self.services.get(&incarnation), peer.hop.principal) {
            (Some(known), Principal::Certificate(_))
                if known.name == peer.name && known.realm != Realm::UNPROVED =>
            {
                known.realm
            }
            (_, principal) => Realm::of(&principal),
        };
        let service = Service {
            principal: peer.hop.principal,
            realm,
            name: Arc::clone(&peer.name),
            connections: 1,
        };
        match self.services.get_mut(&incarnation) {
            Some(known) if known.principal == service.principal => known.connections += 1,
            // Name and connections of the former principal do not count for this one.
            Some(known) => *known = service,
            None => {
                self.make_room();
                self.services.insert(incarnation, service);
                self.order.push_back(incarnation);
            }
        }
    }

    /// Whether the peer may be the service that it claims to be.
    pub(super) fn accepts(&self, peer: &Introduction, view: &dyn View) -> bool {
        let incarnation = peer.hop.location.incarnation();
        if !peer.hop.is_remote() || !incarnation.is_known() {
            return true;
        }
        let principal = peer.hop.principal;
        if let Some(known) = self.services.get(&incarnation) {
            let renewed = known.connections == 0 && known.name == peer.name;
            // A claim without proof gives way to a certificate.
            let is_claim = known.principal == Principal::Unproved;
            return renewed || is_claim || known.principal == principal;
        }
        let listed = view.registered(incarnation);
        let reach = listed.as_ref().map(|it| it.reach);
        // An agent or a service of this host.
        if reach == Some(Reach::Local) {
            return false;
        }
        // What others state about the incarnation keeps no certificate out. The letters of an agent with this
        // registration are of another realm.
        if matches!(principal, Principal::Certificate(_)) {
            return true;
        }
        if listed.is_some_and(|it| it.role != Role::Agent) {
            // A letter in its name, before it connected, does not keep it out.
            return true;
        }
        // The registration of an agent of another principal, which has written before.
        let of_others = |owner: &Option<Principal>| *owner != Some(principal);
        if self.senders.get(&incarnation).is_some_and(of_others) {
            return false;
        }
        // The registration of an agent that the directory lists at a gateway of another principal.
        let Some(Reach::Remote { gateway }) = reach else {
            return true;
        };
        let owner = self.services.get(&gateway).map(|it| it.principal);
        // A claim without proof refuses no certificate.
        let owner = owner.filter(|owner| *owner != Principal::Unproved);
        owner.is_none_or(|owner| owner == principal)
    }

    /// Handles the end of a connection with this service.
    pub(super) fn disconnected(&mut self, peer: &Introduction) {
        let service = self.services.get_mut(&peer.hop.location.incarnation());
        if let Some(service) = service.filter(|it| it.principal == peer.hop.principal) {
            service.connections = service.connections.saturating_sub(1);
        }
    }

    /// Returns the services that have proved a certificate which is not trusted.
    pub(super) fn untrusted(
        &self,
        is_trusted: impl Fn(&[u8; 32]) -> bool,
    ) -> Map<Incarnation, Principal> {
        let services = self.services.iter().map(|(it, service)| (*it, service));
        let untrusted = services.filter(|(_, service)| match &service.principal {
            Principal::Certificate(certificate) => !is_trusted(certificate),
            Principal::Host | Principal::User(_) | Principal::Unproved => false,
        });
        untrusted
            .map(|(it, service)| (it, service.principal))
            .collect()
    }

    /// Returns the principal of this service.
    pub(super) fn of_service(&self, service: Incarnation) -> Option<Principal> {
        self.services.get(&service).map(|it| it.principal)
    }

    /// Returns the realm of the senders whose letters come on this link.
    pub(super) fn realm(&self, from: &Hop) -> Realm {
        let service = self.services.get(&from.location.incarnation());
        let service = service.filter(|it| it.principal == from.principal);
        service.map_or_else(|| Realm::of(&from.principal), |it| it.realm)
    }

    fn make_room(&mut self) {
        if self.services.len() < MAX_SERVICES {
            return;
        }
        let mut idle: Map<Principal, usize> = Map::default();
        for known in self.services.values().filter(|it| it.connections == 0) {
            *idle.entry(known.principal).or_default() += 1;
        }
        let Some((most, _)) = idle.into_iter().max_by_key(|(_, services)| *services) else {
            return;
        };
        let services = &mut self.services;
        let is_evicted = |known: &Incarnation| {
            let known = services.get(known);
            known.is_none_or(|it| it.connections == 0 && it.principal == most)
        };
        if let Some(place) = self.order.iter().position(is_evicted)
            && let Some(oldest) = self.order.remove(place)
        {
            services.remove(&oldest);
        }
    }

    /// Checks whether the link proves the service that it names; called for every parcel. A link
    /// with another host never proves a service that the directory lists on this one. A certificate
    /// proves only a service that introduced itself with it; letters have their own check.
    pub(super) fn check_service(
        &self,
        from: &Hop,
        is_letter: bool,
        view: &dyn View,
    ) -> Result<(), PrincipalError> {
        // Processes of this user are trusted.
        if !from.is_remote() {
            return Ok(());
        }
        let incarnation = from.location.incarnation();
        let is_proved = match self.services.get(&incarnation) {
            Some(known) => known.principal == from.principal,
            None => {
                let listed = view.registered(incarnation);
                (is_letter || from.principal == Principal::Unproved)
                    && listed.is_none_or(|it| it.reach != Reach::Local)
            }
        };
        match is_proved {
            true => Ok(()),
            false => Err(PrincipalError::Service),
        }
    }

    /// Checks whether the link may carry letters of this sender. If the directory has the sender,
    /// its gateway's principal decides; otherwise the link of the sender's first letter.
    ///
    /// Gateways of several principals may list one registration, each with an agent of its own. Then each may send
    /// letters of its agent, which has the name in the envelope: they are of different [realms](fipa_transport::Realm).
    pub(super) fn check_sender(
        &mut self,
        (sender, name): (Incarnation, Option<&str>),
        from: &Hop,
        view: &dyn View,
    ) -> Result<(), PrincipalError> {
        if !from.is_remote() || !sender.is_known() {
            return Ok(());
        }
        let refused = match self.check_holder(sender, from, view) {
            Err(refused) => refused,
            Ok(()) => return Ok(()),
        };
        let service = match sender == from.location.incarnation() {
            true => Some(sender),
            false => {
                let own = name.and_then(|name| view.named(name));
                let own = own.filter(|own| own.incarnation == sender && own.role == Role::Agent);
                own.map(|own| own.mts.incarnation)
            }
        };
        let owner = service.and_then(|service| self.of_service(service));
        let is_certified = matches!(from.principal, Principal::Certificate(_));
        match owner == Some(from.principal) && is_certified {
            true => Ok(()),
            false => Err(refused),
        }
    }

    /// Checks whether the link may carry letters of the agent that holds the registration.
    fn check_holder(
        &mut self,
        sender: Incarnation,
        from: &Hop,
        view: &dyn View,
    ) -> Result<(), PrincipalError> {
        let known = view.registered(sender);
        // Letters of a service itself come only on its own links. A service that introduces itself
        // with the registration of an agent takes nothing from that agent.
        let is_agent = known.as_ref().is_some_and(|it| it.role == Role::Agent);
        let is_bound = self.senders.get(&sender) == Some(&Some(from.principal));
        if !is_agent
            && !is_bound
            && self.services.contains_key(&sender)
            && sender != from.location.incarnation()
        {
            return Err(PrincipalError::Sender);
        }
        let owner = match known.map(|it| it.reach) {
            Some(Reach::Local) => Some(Principal::Host),
            Some(Reach::Remote { gateway }) => match self.services.get(&gateway) {
                Some(gateway) => Some(gateway.principal),
                // The gateway introduces itself before it hands letters over. It may also have a
                // new incarnation that the directory does not show yet.
                None if from.principal != Principal::Unproved => {
                    return Err(PrincipalError::NotIntroduced);
                }
                None => None,
            },
            None => None,
        };
        let owner = match owner {
            Some(owner) => owner,
            None => self.bind_new_sender(sender, from.principal)?,
        };
        match owner == from.principal {
            true => Ok(()),
            false => Err(PrincipalError::Sender),
        }
    }

    /// Records the principal of an entry that left the directory. The gateway may only have lost
    /// its connection, and other principals must not send letters in the agent's name in the
    /// meantime.
    pub(super) fn record_departure(&mut self, entry: &Entry) {
        let owner = match entry.reach {
            Reach::Local => Some(Principal::Host),
            Reach::Remote { gateway } => self.services.get(&gateway).map(|it| it.principal),
        };
        if entry.incarnation.is_known() {
            self.remember(entry.incarnation, owner);
        }
    }

    fn bind_new_sender(
        &mut self,
        sender: Incarnation,
        principal: Principal,
    ) -> Result<Principal, PrincipalError> {
        match self.senders.get(&sender) {
            Some(Some(owner)) => Ok(*owner),
            // Its gateway left before it introduced itself.
            Some(None) if principal != Principal::Unproved => Err(PrincipalError::NotIntroduced),
            _ => {
                self.remember(sender, Some(principal));
                Ok(principal)
            }
        }
    }

    fn remember(&mut self, sender: Incarnation, owner: Option<Principal>) {
        if self.senders.insert(sender, owner) == Some(owner) {
            return;
        }
        let of_owner = self.senders_by_owner.entry(owner).or_default();
        if of_owner.len() >= MAX_SENDERS
            && let Some(oldest) = of_owner.pop_front()
            && self.senders.get(&oldest) == Some(&owner)
        {
            self.senders.remove(&oldest);
        }
        of_owner.push_back(sender);
    }
}

#[cfg(test)]
mod tests {
    use fipa_sds::{MemoryDirectory, MtsId};
    use fipa_transport::Mandate;

    use super::*;

    const ROVER: Principal = Principal::Certificate([1; 32]);
    const CREX: Principal = Principal::Certificate([2; 32]);
    const SERVICE: u64 = 7;

    fn hop(service: u64, principal: Principal) -> Hop {
        let location: fipa_transport::Location = "tcp://192.0.2.1:1".parse().unwrap();
        Hop {
            location: location.with_incarnation(Incarnation::from_u64(service)),
            principal,
        }
    }

    fn peer(name: &str, principal: Principal) -> Introduction {
        Introduction {
            name: name.into(),
            hop: hop(SERVICE, principal),
            dialed: None,
            mandate: Mandate::Unproved,
        }
    }

    fn no_agents() -> MemoryDirectory {
        MemoryDirectory::new(MtsId::new("mts", Incarnation::from_u64(1)))
    }

    #[test]
    fn a_connected_service_keeps_its_principal() {
        let mut principals = Principals::default();
        principals.introduced(&peer("rover", ROVER), &no_agents());
        principals.introduced(&peer("crex", CREX), &no_agents());
        principals.introduced(&peer("rover", CREX), &no_agents());
        assert_eq!(
            principals.check_service(&hop(SERVICE, ROVER), true, &no_agents()),
            Ok(())
        );
        let other = principals.check_service(&hop(SERVICE, CREX), true, &no_agents());
        assert_eq!(other, Err(PrincipalError::Service));
        // The end of the impostor's connection changes nothing.
        principals.disconnected(&peer("rover", CREX));
        principals.introduced(&peer("rover", CREX), &no_agents());
        assert_eq!(
            principals.check_service(&hop(SERVICE, ROVER), true, &no_agents()),
            Ok(())
        );
    }

    #[test]
    fn a_certificate_can_be_renewed_under_the_same_name_only() {
        let mut principals = Principals::default();
        principals.introduced(&peer("rover", ROVER), &no_agents());
        principals.disconnected(&peer("rover", ROVER));
        principals.introduced(&peer("crex", CREX), &no_agents());
        let other = principals.check_service(&hop(SERVICE, CREX), true, &no_agents());
        assert_eq!(other, Err(PrincipalError::Service));
        principals.introduced(&peer("rover", CREX), &no_agents());
        assert_eq!(
            principals.check_service(&hop(SERVICE, CREX), true, &no_agents()),
            Ok(())
        );
        // Copies of letters that came with the former certificate are recognized.
        assert_eq!(principals.realm(&hop(SERVICE, CREX)), Realm::of(&ROVER));
        assert_eq!(principals.realm(&hop(SERVICE + 1, CREX)), Realm::of(&CREX));
    }

    #[test]
    fn invented_senders_displace_those_of_the_same_principal_only() {
        let mut principals = Principals::default();
        let directory = no_agents();
        let mut hear = |sender: u64, principal| {
            let sender = Incarnation::from_u64(sender);
            principals.check_sender((sender, None), &hop(SERVICE, principal), &directory)
        };
        assert_eq!(hear(100, ROVER), Ok(()));
        for sender in 0..2 * MAX_SENDERS as u64 {
            assert_eq!(hear(1000 + sender, CREX), Ok(()));
        }
        assert_eq!(hear(100, CREX), Err(PrincipalError::Sender));
        assert!(principals.senders.len() <= MAX_SENDERS + 1);
    }

    #[test]
    fn invented_services_displace_those_of_the_same_principal_only() {
        let mut principals = Principals::default();
        let directory = no_agents();
        let rover = peer("rover", ROVER);
        principals.introduced(&rover, &directory);
        principals.disconnected(&rover);
        for service in 0..MAX_SERVICES as u64 {
            let invented = Introduction {
                hop: hop(1000 + service, CREX),
                ..peer("crex", CREX)
            };
            principals.introduced(&invented, &directory);
            principals.disconnected(&invented);
        }
        assert!(!principals.accepts(&peer("crex", CREX), &directory));
        principals.introduced(&peer("crex", CREX), &directory);
        assert!(principals.accepts(&rover, &directory));
    }

    #[test]
    fn the_number_of_services_is_bounded() {
        let mut principals = Principals::default();
        let directory = no_agents();
        for service in 0..2 * MAX_SERVICES as u64 {
            let peer = Introduction {
                hop: hop(1000 + service, ROVER),
                ..peer("rover", ROVER)
            };
            principals.introduced(&peer, &directory);
            principals.disconnected(&peer);
        }
        assert_eq!(principals.services.len(), MAX_SERVICES);
        assert_eq!(principals.order.len(), MAX_SERVICES);
    }
}
