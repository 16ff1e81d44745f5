//! Names that agents of this host and of other hosts have.
//!
//! No agent is renamed, and no claim of another host takes a name from this one: an agent of this host
//! keeps its name on this host, and is announced to the others. Each of them reaches the agent that was
//! announced to it first. The agents of the gateway get a second name, by which all others reach them.

use std::sync::Arc;

use fipa_sds::{Directory, Entry, HostDirectory, Reach, Role};

use crate::admin::routes::{ASKER_TYPE, ContestedName};

/// Returns the agents and coalitions of this host that are announced to other hosts. Agents that query
/// this gateway are not announced.
pub(super) fn own_agents(host: &HostDirectory) -> Vec<Arc<Entry>> {
    let entries = host.entries();
    let agents = entries
        .iter()
        .filter(|entry| entry.reach == Reach::Local && entry.role != Role::Gateway)
        .filter(|entry| *entry.agent_type != *ASKER_TYPE);
    agents.cloned().collect()
}

/// Returns the agent of another host that has the name of this agent of this host. With keys, a claim
/// that no link proves is ignored.
pub(super) fn other_claim(
    own: &Entry,
    known: &dyn Directory,
    has_keys: bool,
) -> Option<Arc<Entry>> {
    let claim = known.known(&own.name)?;
    let is_proved = || known.mandate(claim.mts.incarnation).is_proved();
    (claim.incarnation != own.incarnation && (!has_keys || is_proved())).then_some(claim)
}

/// An agent of this host whose name an agent of another host also has.
pub(super) struct Contested {
    pub(super) entry: Arc<Entry>,
    pub(super) claim: Arc<Entry>,
}

impl From<&Contested> for ContestedName {
    fn from(contested: &Contested) -> Self {
        Self {
            name: contested.entry.name.to_string(),
            gateway: contested.claim.mts.shown().to_owned(),
        }
    }
}

/// Returns those of the agents of this host whose name an agent of another host also has.
pub(super) fn contested(
    own: &[Arc<Entry>],
    known: &dyn Directory,
    has_keys: bool,
) -> Vec<Contested> {
    let all = own.iter().filter_map(|entry| {
        let claim = other_claim(entry, known, has_keys)?;
        let entry = Arc::clone(entry);
        Some(Contested { entry, claim })
    });
    all.collect()
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use fipa_sds::{Exchange, HostConfig, MergedDirectory, MtsId, Present, Registration};
    use fipa_transport::{Incarnation, Mandate, Principal};

    use super::*;

    /// Returns the number of announced and of contested agents of a host with the agent `rover`,
    /// while a neighbor with this mandate has an agent `rover` that was registered long before.
    fn announced(mandate: Mandate, has_keys: bool) -> (usize, usize) {
        let place = tempfile::tempdir().unwrap();
        let host = HostDirectory::open(HostConfig {
            brief: false,
            users: fipa_transport::DomainUsers::This,
            dir: place.path().join("domain"),
            mts: MtsId::new("mts", Incarnation::from_u64(1)),
            gateway: true,
        });
        let host = host.unwrap();
        let at = "shm://0000000000000001#0000000000000001".parse().unwrap();
        let rover = Registration::new("rover", Incarnation::from_u64(2), vec![at]);
        host.register(rover).unwrap();
        let gateway = Incarnation::from_u64(7);
        let mut exchange = Exchange::new(0);
        let present = Present {
            mts: MtsId::new("crex-mts", gateway),
            locations: vec!["tcp://192.0.2.1:7788#0000000000000007".parse().unwrap()],
            mandate,
            principal: Principal::Certificate([7; 32]),
        };
        exchange.handle_neighbors(Instant::now(), &[present]);
        let announcement = br#"{"version":1,"tell":{"full":{"version":1,"first":true,"last":true,
            "agents":[{"name":"rover","id":"0000000000000008","registered":1}]}}}"#;
        let taken = exchange.handle_letter(Instant::now(), gateway, announcement);
        taken.unwrap();
        let known = MergedDirectory::new(vec![exchange.directory()]);
        let own = own_agents(&host);
        (own.len(), contested(&own, &known, has_keys).len())
    }

    #[tokio::test]
    async fn no_claim_keeps_agents_of_this_host_from_others() {
        let certified = |agents: &[&str]| {
            Mandate::Certified(agents.iter().map(|agent| (*agent).to_owned()).collect())
        };
        assert_eq!(announced(Mandate::Unproved, false), (1, 1));
        assert_eq!(announced(Mandate::Unproved, true), (1, 0));
        assert_eq!(announced(certified(&[]), true), (1, 1));
        assert_eq!(announced(certified(&["crex"]), true), (1, 0));
    }
}
