//! The keys by which two configurations differ, and the values of all keys.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::Config;
use super::keys::dotted;
use super::keys::{KEYS, MAPS};

/// The result of applying another configuration to a running process, as keys that are written with `--set`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Reloaded {
    /// The keys whose new values apply now.
    pub applied: Vec<String>,
    /// The keys whose new values apply after a restart.
    pub later: Vec<String>,
}

/// The keys that only gateways use, as they begin.
const OF_GATEWAY: [&str; 17] = [
    "mts.name",
    "transport.tcp.listen",
    "transport.udp.",
    "transport.quic.",
    "transport.http.",
    "transport.https.",
    "transport.udt.",
    "discovery.",
    "security.keys",
    "security.insecure",
    "security.loopback",
    "security.legacy_peers",
    "security.key_log",
    "http.",
    "contacts.",
    "platform.",
    "record.",
];

/// Whether only gateways use this key.
pub(crate) fn is_of_gateway(key: &str) -> bool {
    OF_GATEWAY
        .iter()
        .any(|beginning| key.starts_with(beginning))
}

impl Config {
    /// Returns the keys whose values differ, as they are written with `--set`.
    #[must_use]
    pub fn differences(&self, other: &Self) -> Vec<String> {
        let keys = KEYS
            .iter()
            .filter(|key| (key.read)(self) != (key.read)(other));
        let maps = MAPS
            .iter()
            .filter(|map| (map.read)(self) != (map.read)(other));
        let keys = keys.map(|key| key.path).chain(maps.map(|map| map.path));
        keys.map(|path| path.join(".")).collect()
    }

    /// Returns the value of each key as TOML text, for example `mts.deadline` with `"5s"`. Names in tables
    /// that the user fills, such as those of `[routes]`, follow the key after a dot.
    #[must_use]
    pub fn values(&self) -> BTreeMap<String, String> {
        let keys = KEYS
            .iter()
            .map(|key| (key.path.join("."), (key.read)(self).to_toml()));
        let maps = MAPS.iter().flat_map(|map| {
            let values = (map.read)(self).into_iter();
            values.map(move |(name, value)| {
                let path: Vec<&str> = map.path.iter().copied().chain([name]).collect();
                (dotted(&path), value.to_toml())
            })
        });
        keys.chain(maps).collect()
    }
}
