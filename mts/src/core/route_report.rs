//! Reports of routes: the locations to which a letter would go now, and counters of each location
//! since the start. The allocation of memory for a letter in advance also uses them.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use fipa_sds::{Entry, Reach, Resolution, Role};
use fipa_transport::{Incarnation, Kind, Location};
use serde::{Deserialize, Serialize};

use super::ids::registration_of;
use super::lane_table::LaneTable;
use super::routes::leads_to_letters;
use super::{Core, Now};
use crate::{Map, stamp};

/// The route that letters to one agent would take now.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Route {
    /// The agent's name.
    pub receiver: String,
    /// Its incarnation.
    pub incarnation: Incarnation,
    /// The gateway to which letters go, when the agent is on another host.
    pub gateway: Option<Incarnation>,
    /// The pattern of `[routes]` that applies, or `None` for the order of `mts.transports`.
    pub exception: Option<String>,
    /// Its locations, in the order in which they would be tried. Unused ones come last.
    pub ways: Vec<RouteCandidate>,
}

/// A location of an agent, as seen from one service.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RouteCandidate {
    /// The location.
    pub location: Location,
    /// State of the location.
    pub standing: Standing,
}

/// State of a location for letters.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "standing", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Standing {
    /// Not known to fail.
    Ready,
    /// It failed, and is tried after all working ones until this time has passed.
    Failing {
        /// Remaining time of its backoff.
        milliseconds: u64,
        /// Number of consecutive failures.
        failures: u32,
        /// The latest error.
        error: String,
    },
    /// Its transport is not in the order for this receiver.
    NotInOrder,
    /// This project has no transport of its kind.
    Unsupported,
}

/// Counters of one location since the service started, or since the location was last dropped.
/// Beyond 4096 locations, those without letters in flight are dropped.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RouteState {
    /// The location.
    pub location: Location,
    /// Its current state.
    #[serde(flatten)]
    pub standing: Standing,
    /// Number of letters that were sent there and have no answer yet.
    pub in_flight: u64,
    /// Number of attempts to send a letter there.
    pub tried: u64,
    /// Number of letters that the other side took, into a queue or into custody, or that were
    /// handed to a peer that cannot confirm.
    pub taken: u64,
    /// Number of letters that the other side did not take, because its queue was full or for
    /// another reason.
    pub turned_back: u64,
    /// Number of failed attempts: no connection, or no answer.
    pub failed: u64,
    /// Smoothed time from an attempt to its answer, in microseconds. `None` before the first, and for this host.
    #[serde(default)]
    pub answer_micros: Option<u64>,
    /// Error of the last of these.
    pub last_error: Option<String>,
    /// Seconds since that error.
    pub last_error_seconds: Option<u64>,
}

impl LaneTable {
    /// The route that letters to this agent would take now.
    pub(super) fn route(&self, now: Instant, entry: &Entry) -> Route {
        let (exception, order) = self.config.route_for(&entry.name, entry.reach);
        let mut ways = Vec::new();
        let mut tried: Vec<Location> = Vec::new();
        while let Some(location) = self.choose(now, entry, &tried) {
            let standing = self.standing(now, &location);
            tried.push(location.clone());
            ways.push(RouteCandidate { location, standing });
        }
        let rest = entry.locations.iter().filter(|it| !tried.contains(it));
        debug_assert!(
            rest.clone()
                .all(|it| !order.contains(&it.kind()) || !leads_to_letters(it))
        );
        ways.extend(rest.map(|location| RouteCandidate {
            location: location.clone(),
            standing: match location.kind().is_supported() {
                true => Standing::NotInOrder,
                false => Standing::Unsupported,
            },
        }));
        Route {
            receiver: entry.name.to_string(),
            incarnation: entry.incarnation,
            gateway: match entry.reach {
                Reach::Local => None,
                Reach::Remote { gateway } => Some(gateway),
            },
            exception: exception.map(ToString::to_string),
            ways,
        }
    }

    fn standing(&self, now: Instant, location: &Location) -> Standing {
        match self.routes.failing(now, location) {
            None => Standing::Ready,
            Some((failures, retry_at)) => {
                let time_left = retry_at.saturating_duration_since(now);
                let tally = self.tallies.0.get(location);
                let error = tally.and_then(|tally| tally.last_error.lock().clone());
                Standing::Failing {
                    milliseconds: u64::try_from(time_left.as_millis()).unwrap_or(u64::MAX),
                    failures,
                    error: error.map(|(text, _)| text).unwrap_or_default(),
                }
            }
        }
    }

    /// The counters of each location, sorted by location.
    fn way_states(&self, now: Instant) -> Vec<RouteState> {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let tallies = self.tallies.0.iter();
        let mut states: Vec<RouteState> = tallies
            .map(|(location, tally)| {
                let last_error = tally.last_error.lock().clone();
                let ago = |at: Instant| now.saturating_duration_since(at);
                RouteState {
                    location: location.clone(),
                    standing: self.standing(now, location),
                    in_flight: tally.in_flight(),
                    tried: read(&tally.tried),
                    taken: read(&tally.taken),
                    turned_back: read(&tally.turned_back),
                    failed: read(&tally.failed),
                    answer_micros: Some(read(&tally.answer_micros)).filter(|it| *it > 0),
                    last_error_seconds: last_error.as_ref().map(|(_, at)| ago(*at).as_secs()),
                    last_error: last_error.map(|(text, _)| text),
                }
            })
            .collect();
        states.sort_unstable_by(|a, b| a.location.cmp(&b.location));
        states
    }
}

impl Core {
    /// Returns the route that letters from here to the agent of this entry would take now.
    #[must_use]
    pub fn route(&self, now: Now, entry: &Entry) -> Route {
        self.table.route(now.instant, entry)
    }

    /// Returns the bytes of the letters that have no outcome yet: at a gateway, those in custody.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        self.table.custody.held() + self.backlog.bytes()
    }

    /// Returns the counters of each location, sorted by location.
    #[must_use]
    pub fn ways(&self, now: Now) -> Vec<RouteState> {
        self.table.way_states(now.instant)
    }

    /// Returns the first location to which a letter from here to this receiver would go now; `None`
    /// for several receivers.
    #[must_use]
    pub fn first_way(&self, now: Now, receiver: &str) -> Option<Location> {
        let entry = self.table.view.named(receiver)?;
        if matches!(entry.role, Role::Coalition(_)) {
            return None;
        }
        self.table.choose(now.instant, &entry, &[])
    }

    /// Returns the first location to which this service would forward a letter for this
    /// registration and name now, and the length of its stamp in bytes. `None` unless the receiver
    /// is another process of this host.
    #[must_use]
    pub fn first_way_onwards(
        &self,
        now: Now,
        registration: Incarnation,
        receiver: &str,
    ) -> Option<(Location, usize)> {
        let config = &self.table.config;
        if !config.forwards || self.agents.contains_key(&registration) {
            return None;
        }
        let entry = self.table.receiver(registration, receiver)?;
        let is_local = entry.role == Role::Agent && entry.reach == Reach::Local;
        let way = is_local.then(|| self.table.choose(now.instant, &entry, &[]))?;
        Some((way?, stamp::max_len(&config.name)))
    }

    /// Returns the kind of transport that would come first for most of these receivers now, if that
    /// applies to at least two of them.
    #[must_use]
    pub fn kind_for_many<'a>(
        &self,
        now: Now,
        sender: Incarnation,
        receivers: impl IntoIterator<Item = &'a str>,
    ) -> Option<Kind> {
        let view = &*self.table.view;
        let own = self.agents.get(&sender).map(|inbox| &*inbox.name);
        let mut reached = Map::default();
        for receiver in receivers {
            let entries = match fipa_sds::resolve(view, receiver, own.unwrap_or_default()) {
                Ok(Resolution::Exact(entry)) => vec![entry],
                Ok(Resolution::Multicast(entries)) => entries,
                Ok(Resolution::Coalition { agents, .. }) => agents,
                Ok(Resolution::None) | Err(_) => Vec::new(),
            };
            for entry in entries {
                if let Some(way) = self.table.choose(now.instant, &entry, &[]) {
                    reached.insert(registration_of(&entry), way.kind());
                }
            }
        }
        let by = |kind: Kind| reached.values().filter(|other| **other == kind).count();
        let most = Kind::ALL.into_iter().max_by_key(|kind| by(*kind))?;
        (by(most) > 1).then_some(most)
    }
}
