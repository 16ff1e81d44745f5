//! Gateways with the same name.
//!
//! Letters reach the right gateway nevertheless, by its incarnation. But the agents `ams@NAME` and `df@NAME`,
//! lists and logs do not tell the hosts apart, so the operator must give one of them another name.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::escape;
use fipa_sds::{Directory, MergedDirectory, MtsId, Reach};
use fipa_transport::{Incarnation, Location, log_limit};

use super::neighbors::{Neighbor, Neighbors};
use crate::admin::routes;

/// Time for which two gateways of one name must have been connected together. A gateway that was restarted has a
/// new incarnation, while the connection of the former one may be open until it has been silent for 20 s.
const TOGETHER: Duration = Duration::from_secs(30);

/// Time between two searches.
const SEARCH_EVERY: Duration = Duration::from_secs(10);

/// Maximum number of reported names.
const MAX_NAMES: usize = 16;

/// Maximum number of reported gateways of one name.
const MAX_GATEWAYS: usize = 8;

/// Finds the names that several gateways have.
pub(super) struct Namesakes {
    /// The service of this gateway.
    pub(super) own: MtsId,
    pub(super) neighbors: Arc<Neighbors>,
    /// The directories of other hosts.
    pub(super) known: Arc<MergedDirectory>,
    /// Whether `security.keys` is set. Then a claim that no connection proves is ignored.
    pub(super) has_keys: bool,
}

/// Another gateway.
struct Other {
    name: String,
    incarnation: Incarnation,
    at: Location,
    /// Time of its first connection; `None` without a connection.
    since: Option<Instant>,
    is_proved: bool,
}

impl Other {
    fn connected(neighbor: &Neighbor) -> Option<Self> {
        Some(Self {
            name: neighbor.entry.name.to_string(),
            incarnation: neighbor.entry.incarnation,
            at: neighbor.entry.locations.first()?.clone(),
            since: Some(neighbor.since),
            is_proved: neighbor.mandate.is_proved(),
        })
    }
}

impl Namesakes {
    /// Returns the names that several gateways have.
    pub(super) fn found(&self, now: Instant) -> Vec<routes::Namesakes> {
        let neighbors = self.neighbors.all();
        let others = neighbors.iter().filter_map(Other::connected);
        let own = self.own.name.as_deref().unwrap_or_default();
        found(now, own, others.chain(self.announced(own)))
    }

    /// Returns the gateways that announce agents with the name of this gateway as that of theirs.
    fn announced(&self, own: &str) -> Vec<Other> {
        let mut others: BTreeMap<Incarnation, Other> = BTreeMap::new();
        for entry in &*self.known.entries() {
            let incarnation = entry.mts.incarnation;
            if entry.mts.name.as_deref() != Some(own)
                || incarnation == self.own.incarnation
                || !incarnation.is_known()
                || !matches!(entry.reach, Reach::Remote { .. })
                || others.len() >= MAX_GATEWAYS
            {
                continue;
            }
            let is_proved = self.known.mandate(incarnation).is_proved();
            if let Some(at) = entry.locations.first()
                && (is_proved || !self.has_keys)
            {
                others.entry(incarnation).or_insert_with(|| Other {
                    name: own.to_owned(),
                    incarnation,
                    at: at.clone(),
                    since: None,
                    is_proved,
                });
            }
        }
        others.into_values().collect()
    }

    /// Logs each name once.
    pub(super) async fn run(self: Arc<Self>) {
        let mut logged = BTreeSet::new();
        let mut interval = tokio::time::interval(SEARCH_EVERY);
        loop {
            interval.tick().await;
            for found in self.found(Instant::now()) {
                let routes::Namesakes { name, is_own, .. } = &found;
                // A connected gateway with the name of this one is logged when it connects.
                let is_logged = *is_own && self.neighbors.has_namesake();
                if is_logged || logged.len() >= MAX_NAMES || !logged.insert(name.clone()) {
                    continue;
                }
                let at: Vec<String> = found.at.iter().map(ToString::to_string).collect();
                log_limit::warn!(
                    at = at.join(" "),
                    "several gateways have the name {}: logs and lists do not tell the hosts apart; set mts.name on \
                     all but one of them",
                    escape(name)
                );
            }
        }
    }
}

fn found(now: Instant, own: &str, others: impl Iterator<Item = Other>) -> Vec<routes::Namesakes> {
    let mut by_name: BTreeMap<String, BTreeMap<Incarnation, Other>> = BTreeMap::new();
    for other in others {
        // This gateway itself runs, so its name needs no time. Its predecessor has no connection with it.
        let counts = other.name == own
            || other
                .since
                .is_some_and(|since| now.saturating_duration_since(since) >= TOGETHER);
        if counts {
            let of_name = by_name.entry(other.name.clone()).or_default();
            of_name.entry(other.incarnation).or_insert(other);
        }
    }
    let several = by_name.into_iter().filter_map(|(name, others)| {
        let is_own = name == own;
        (is_own || others.len() > 1).then(|| routes::Namesakes {
            name,
            is_own,
            is_proved: others.values().all(|other| other.is_proved),
            at: others
                .into_values()
                .map(|other| other.at)
                .take(MAX_GATEWAYS)
                .collect(),
        })
    });
    several.take(MAX_NAMES).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gateway(name: &str, number: u64, since: Option<Instant>) -> Other {
        let incarnation = Incarnation::from_u64(number);
        let at: Location = format!("tcp://10.0.0.{number}:7788").parse().unwrap();
        Other {
            name: name.to_owned(),
            incarnation,
            at: at.with_incarnation(incarnation),
            since,
            is_proved: number < 100,
        }
    }

    fn at(found: &routes::Namesakes) -> Vec<&str> {
        found.at.iter().map(Location::address).collect()
    }

    #[test]
    fn a_gateway_with_the_name_of_this_one_is_found_at_once() {
        let now = Instant::now();
        let others = [
            gateway("sherpa", 2, Some(now)),
            gateway("sherpa", 2, None),
            gateway("crex", 3, Some(now)),
            gateway("sherpa", 104, None),
        ];
        let found = found(now, "sherpa", others.into_iter());
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].is_own && !found[0].is_proved, "{found:?}");
        assert_eq!(at(&found[0]), ["10.0.0.2:7788", "10.0.0.104:7788"]);
    }

    #[test]
    fn a_gateway_that_was_restarted_is_no_other_one_of_its_name() {
        let now = Instant::now();
        let both = |now| {
            let others = [
                gateway("crex", 2, Some(now)),
                gateway("crex", 3, Some(now + TOGETHER)),
            ];
            others.into_iter()
        };
        // The connection of the former one ends within this time.
        let later = now + TOGETHER * 2;
        assert_eq!(
            found(later - Duration::from_millis(1), "sherpa", both(now)),
            []
        );
        let found = found(later, "sherpa", both(now));
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(!found[0].is_own && found[0].is_proved, "{found:?}");
        assert_eq!(at(&found[0]), ["10.0.0.2:7788", "10.0.0.3:7788"]);
    }

    #[test]
    fn the_number_of_names_and_gateways_is_bounded() {
        let now = Instant::now();
        let others = (0..1000).map(|number| {
            let name = format!("gateway-{}", number % 20);
            let mut other = gateway(&name, number % 250 + 1, Some(now));
            other.incarnation = Incarnation::from_u64(number + 1);
            other
        });
        let found = found(now + TOGETHER, "sherpa", others);
        assert_eq!(found.len(), MAX_NAMES);
        assert!(found.iter().all(|one| one.at.len() == MAX_GATEWAYS));
    }
}
