//! The keys by which two configurations differ.

use super::Config;
use super::keys::{KEYS, MAPS};

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
}
