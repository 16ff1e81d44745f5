//! Agents of other platforms at addresses that agents of this host state: which of them the gateway dials, and the
//! hosts that have taken letters.
//!
//! The rules are in [`fipa_mts::dial`]. Here are the facts that they need, and the resolution of host names.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use fipa_acl::escape;
use fipa_mts::dial::{Claim, Endpoint, Network, NotDialed, judge, located_at};
use fipa_sds::{ContactDirectory, Entry};
use fipa_transport::{Location, log_limit};
use fipa_transport_net::look_up;
use parking_lot::Mutex;

/// Maximum time for the resolution of the host names of one identifier.
const RESOLUTION: Duration = Duration::from_secs(3);

/// The platforms that have taken letters of agents of this host within a day.
#[derive(Debug, Default)]
pub(super) struct Takers(Mutex<HashMap<Endpoint, Instant>>);

impl Takers {
    /// Time for which a platform counts after it has taken a letter.
    const MEMORY: Duration = Duration::from_secs(24 * 60 * 60);
    /// Maximum number of platforms. Beyond it, the one that took a letter the longest time ago is forgotten.
    const MAX: usize = 1024;
    /// Maximum number of host names among them that are resolved for one identifier.
    const MAX_NAMES: usize = 8;

    /// Records that the platform at this location took a letter.
    pub(super) fn took(&self, now: Instant, location: &Location) {
        let Some(endpoint) = Endpoint::of(location) else {
            return;
        };
        let mut all = self.0.lock();
        if !all.contains_key(&endpoint) && all.len() >= Self::MAX {
            let oldest = all.iter().min_by_key(|(_, at)| **at);
            if let Some(oldest) = oldest.map(|(oldest, _)| oldest.clone()) {
                all.remove(&oldest);
            }
        }
        all.insert(endpoint, now);
    }

    /// Returns the platforms that took a letter within a day.
    fn latest(&self, now: Instant) -> Vec<Endpoint> {
        let mut all = self.0.lock();
        all.retain(|_, at| now.saturating_duration_since(*at) < Self::MEMORY);
        all.keys().cloned().collect()
    }
}

/// The facts by which the addresses of an identifier are judged.
pub(super) struct Grounds<'a> {
    pub(super) takers: &'a Takers,
    pub(super) contacts: &'a ContactDirectory,
    pub(super) networks: &'a [Network],
    /// The addresses at which this gateway listens.
    pub(super) own: Vec<SocketAddr>,
}

/// The locations of a received identifier that may be dialed, and the reasons for the others.
#[derive(Debug, Default)]
pub(super) struct Judged {
    pub(super) permitted: Vec<Location>,
    pub(super) refused: Vec<(Location, String)>,
}

impl Judged {
    /// Returns the reasons as text.
    pub(super) fn reasons(&self) -> String {
        let refused = self.refused.iter();
        let reasons: Vec<String> = refused
            .map(|(location, why)| {
                format!("{} is not dialed: {why}", escape(&location.to_string()))
            })
            .collect();
        reasons.join("; ")
    }
}

impl Grounds<'_> {
    /// Judges the locations of a received identifier. Host names are resolved once, and replaced by the addresses
    /// that were judged.
    pub(super) async fn judge(&self, locations: &[Location]) -> Judged {
        let mut judged = Judged::default();
        let until = tokio::time::Instant::now() + RESOLUTION;
        let mut takers: Option<Vec<Endpoint>> = None;
        for location in locations {
            let found = tokio::time::timeout_at(until, self.resolve(location));
            let found = found.await;
            let found =
                found.unwrap_or_else(|_| Err("its host name was not resolved in time".to_owned()));
            let found = match found {
                Ok(found) => found,
                Err(why) => {
                    judged.refused.push((location.clone(), why));
                    continue;
                }
            };
            let takers = match &mut takers {
                Some(takers) => takers,
                none => none.insert(self.takers(until).await),
            };
            let mut refusal: Option<NotDialed> = None;
            for at in found {
                let same_host = |it: &Endpoint| matches!(it, Endpoint::Numeric(taker) if ip_of(taker) == ip_of(&at));
                let same_endpoint = |it: &Endpoint| same_host(it) && it.port() == at.port();
                let claim = Claim::Received {
                    is_host: takers.iter().any(same_host),
                    is_endpoint: takers.iter().any(same_endpoint),
                };
                match judge(at, claim, self.networks, &self.own) {
                    Ok(()) => {
                        let there = located_at(location, at);
                        let has_room = judged.permitted.len() < Entry::MAX_LOCATIONS;
                        judged
                            .permitted
                            .extend(there.filter(|it| has_room && !judged.permitted.contains(it)));
                        // One attempt at a time, and one address for each that is stated.
                        refusal = None;
                        break;
                    }
                    Err(why) => refusal = Some(why),
                }
            }
            if let Some(why) = refusal {
                log_limit::info!(of: location, to = %escape(&location.to_string()), %why, "an address in a received identifier is not dialed");
                judged.refused.push((location.clone(), why.to_string()));
            }
        }
        judged
    }

    /// Returns the addresses to which a location leads.
    async fn resolve(&self, location: &Location) -> Result<Vec<SocketAddr>, String> {
        let none = || "it has no host and port".to_owned();
        match Endpoint::of(location).ok_or_else(none)? {
            Endpoint::Numeric(at) => Ok(vec![at]),
            Endpoint::Named(host, port) => {
                let found = look_up(host.clone(), port).await;
                let found = found.unwrap_or_default();
                if !found.is_empty() {
                    return Ok(found);
                }
                // JADE states the name of its host, which few resolvers have. Platforms that state it in their own
                // letters are reached at the addresses of their connections.
                match self.contacts.hosts_named(&host)[..] {
                    [ip] => Ok(vec![SocketAddr::new(ip, port)]),
                    [] => Err("its host name cannot be resolved".to_owned()),
                    _ => Err("several hosts state its host name".to_owned()),
                }
            }
        }
    }

    /// Returns the platforms that took letters, with their host names resolved.
    async fn takers(&self, until: tokio::time::Instant) -> Vec<Endpoint> {
        let latest = self.takers.latest(Instant::now());
        let (mut all, mut names) = (Vec::new(), 0);
        for endpoint in latest {
            match endpoint {
                Endpoint::Numeric(_) => all.push(endpoint),
                Endpoint::Named(host, port) if names < Takers::MAX_NAMES => {
                    names += 1;
                    let found = tokio::time::timeout_at(until, look_up(host, port)).await;
                    let found = found.ok().and_then(Result::ok).unwrap_or_default();
                    all.extend(found.into_iter().map(Endpoint::Numeric));
                }
                Endpoint::Named(..) => {}
            }
        }
        all
    }
}

fn ip_of(at: &SocketAddr) -> IpAddr {
    at.ip().to_canonical()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(text: &str) -> Location {
        text.parse().unwrap()
    }

    async fn judged(grounds: &Grounds<'_>, text: &str) -> Judged {
        grounds.judge(&[at(text)]).await
    }

    /// The addresses with which the HTTP transport is attacked: of third hosts, loopback, link-local, and the
    /// gateway itself.
    #[tokio::test]
    async fn a_received_identifier_makes_the_gateway_dial_no_third_host_and_not_itself() {
        let (takers, contacts) = (Takers::default(), ContactDirectory::new());
        takers.took(Instant::now(), &at("http://10.200.0.7:7778/acc"));
        let grounds = Grounds {
            takers: &takers,
            contacts: &contacts,
            networks: &[],
            own: vec!["10.0.0.1:7778".parse().unwrap()],
        };
        let third = (0..500).map(|it| format!("http://10.{}.{}.9:7778/acc", it / 250, it % 250));
        let special = [
            "http://127.0.0.1:8080/acc",
            "http://localhost:8080/acc",
            "http://[::1]:8080/acc",
            "http://[::ffff:127.0.0.1]:8080/acc",
            "http://169.254.169.254/latest",
            "http://[fe80::1]:7778/acc",
            "http://224.0.0.1:7778/acc",
            "http://0.0.0.0:7778/acc",
            "http://10.0.0.1:7778/acc",
            "http://10.200.0.7:22/acc",
            "tcp://10.0.0.1:7778;jade",
        ];
        for text in third.chain(special.map(str::to_owned)) {
            let judged = judged(&grounds, &text).await;
            assert_eq!(judged.permitted, [], "{text}");
            assert!(judged.reasons().contains("contacts.networks"), "{text}");
        }
        for text in [
            "http://10.200.0.7:7778/acc",
            "http://10.200.0.7:8080/x",
            "http://10.200.0.7:80/acc",
        ] {
            assert_eq!(judged(&grounds, text).await.permitted, [at(text)]);
        }
        let networks = ["10.0.0.0/16".parse().unwrap()];
        let listed = Grounds {
            networks: &networks,
            ..grounds
        };
        let mixed = [
            at("http://10.9.0.9:7778/acc"),
            at("http://10.0.0.9:22/acc"),
            at("http://10.200.0.7:1024/acc"),
        ];
        let judged = listed.judge(&mixed).await;
        assert_eq!(judged.permitted, mixed[1..]);
        assert_eq!(judged.refused.len(), 1);
    }

    #[tokio::test]
    async fn a_host_name_is_resolved_and_its_address_is_judged_and_dialed() {
        let (takers, contacts) = (Takers::default(), ContactDirectory::new());
        let grounds = Grounds {
            takers: &takers,
            contacts: &contacts,
            networks: &[],
            own: Vec::new(),
        };
        let stated = "http://localhost:7778/acc";
        assert_eq!(judged(&grounds, stated).await.permitted, []);
        // The platform took a letter at this port of this host.
        takers.took(Instant::now(), &at("http://127.0.0.1:7778/acc"));
        takers.took(Instant::now(), &at("http://[::1]:7778/acc"));
        let permitted = judged(&grounds, stated).await.permitted;
        let numeric = ["http://127.0.0.1:7778/acc", "http://[::1]:7778/acc"].map(at);
        assert!(numeric.contains(&permitted[0]) && permitted.len() == 1);
        // A name that no resolver has.
        let stated = "http://crex.invalid:7778/acc";
        let unknown = judged(&grounds, stated).await;
        assert!(unknown.reasons().contains("cannot be resolved"));
        takers.took(Instant::now(), &at("http://10.0.0.7:7778/acc"));
        let sender = at("http://10.0.0.7:7778/acc");
        let first = contacts.record_sender_of_host(
            Instant::now(),
            "df@crex",
            sender.clone(),
            "crex.invalid",
        );
        first.unwrap();
        assert_eq!(judged(&grounds, stated).await.permitted, [sender]);
        // Another host claims the name.
        let other = at("http://10.0.0.66:7778/acc");
        let second =
            contacts.record_sender_of_host(Instant::now(), "x@crex", other, "crex.invalid");
        second.unwrap();
        let contested = judged(&grounds, stated).await;
        assert!(contested.reasons().contains("several hosts"));
    }

    #[test]
    fn a_platform_counts_for_a_day_and_the_memory_is_bounded() {
        let takers = Takers::default();
        let now = Instant::now();
        for port in 1024..1024 + Takers::MAX as u64 + 5 {
            let age = Duration::from_millis(port);
            takers.took(now + age, &at(&format!("http://10.0.0.7:{port}/acc")));
        }
        assert_eq!(takers.latest(now).len(), Takers::MAX);
        let later = now + Takers::MEMORY + Duration::from_millis(1024 + 10);
        assert_eq!(takers.latest(later).len(), Takers::MAX - 6);
        assert_eq!(takers.latest(later + Takers::MEMORY), []);
    }
}
