//! The decision how much of a bounded memory each peer may take. No I/O, no clock.
//!
//! Every peer within the equal share is listed completely, whatever the others announce. What the small
//! ones leave is divided among the others, so only the greediest are cut.

use std::collections::HashMap;
use std::hash::Hash;

use crate::{Entry, Role};

/// Bytes that one entry is charged beside its texts. They bound the number of entries, too.
pub(crate) const PER_ENTRY: usize = 400;

/// Maximum size of the lists of one peer, in charged bytes: 5,000 agents without texts.
pub(crate) const MAX_OF_PEER: usize = 5_000 * PER_ENTRY;

/// Maximum size of the lists of all peers together, in charged bytes.
pub(crate) const MAX_TOTAL: usize = 8 * MAX_OF_PEER;

/// Returns the bytes that an entry is charged.
pub(crate) fn charge(entry: &Entry) -> usize {
    let members = match &entry.role {
        Role::Coalition(members) => members.names().iter().map(|name| name.len() + 16).sum(),
        _ => 0,
    };
    let texts = entry.name.len() + entry.agent_type.len() + entry.description.len();
    PER_ENTRY + texts + members
}

/// Returns the level at which to cut these sizes so that they fit `total` together: a size up to the level
/// stays, a larger one is cut to it. The level is at least `total` divided by the number of sizes.
pub(crate) fn level(sizes: impl IntoIterator<Item = usize>, total: usize) -> usize {
    let mut sizes: Vec<usize> = sizes.into_iter().collect();
    sizes.sort_unstable();
    let mut rest = total;
    for (smaller, size) in sizes.iter().enumerate() {
        let equal = rest / (sizes.len() - smaller);
        if *size > equal {
            return equal;
        }
        rest -= size;
    }
    usize::MAX
}

/// Returns how much of `total` each list may take, in the order of the lists, which have a peer and a
/// size. A peer takes at most `of_peer`. Its share is divided among its lists in the same way.
pub(crate) fn allowances<P: Eq + Hash>(
    lists: &[(P, usize)],
    of_peer: usize,
    total: usize,
) -> Vec<usize> {
    let mut sizes: HashMap<&P, Vec<usize>> = HashMap::new();
    for (peer, size) in lists {
        sizes.entry(peer).or_default().push(*size);
    }
    let of_peers = sizes.values().map(|sizes| sum(sizes).min(of_peer));
    let share = level(of_peers, total).min(of_peer);
    let levels: HashMap<&P, usize> = sizes
        .into_iter()
        .map(|(peer, sizes)| (peer, level(sizes, share)))
        .collect();
    let allowance =
        |(peer, size): &(P, usize)| levels.get(peer).map_or(0, |level| *size.min(level));
    lists.iter().map(allowance).collect()
}

fn sum(sizes: &[usize]) -> usize {
    sizes.iter().fold(0, |sum, size| sum.saturating_add(*size))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn lists() -> impl Strategy<Value = Vec<(u8, usize)>> {
        let size = prop_oneof![0..100_usize, 0..10_000_usize, Just(usize::MAX)];
        prop::collection::vec((0..12_u8, size), 0..40)
    }

    proptest! {
        #[test]
        fn a_peer_within_its_share_is_listed_completely(
            lists in lists(), of_peer in 1..8_000_usize, total in 1..20_000_usize,
        ) {
            let allowed = allowances(&lists, of_peer, total);
            prop_assert_eq!(allowed.len(), lists.len());
            let mut peers: HashMap<u8, (usize, usize)> = HashMap::new();
            for ((peer, size), allowed) in lists.iter().zip(&allowed) {
                prop_assert!(allowed <= size);
                let (wanted, gets) = peers.entry(*peer).or_default();
                *wanted = wanted.saturating_add(*size);
                *gets += allowed;
            }
            let equal = total / peers.len().max(1);
            for (wanted, gets) in peers.values() {
                prop_assert!(*gets <= of_peer);
                if *wanted <= equal.min(of_peer) {
                    prop_assert_eq!(gets, wanted);
                }
            }
            prop_assert!(peers.values().map(|(_, gets)| gets).sum::<usize>() <= total);
            // The greediest lose: a peer that is cut has no less than each that wanted less, except for
            // the rest of the division.
            for (wanted, gets) in peers.values() {
                for (other_wanted, other_gets) in peers.values() {
                    if wanted > gets && other_wanted <= wanted {
                        prop_assert!(other_gets <= &(gets + lists.len()));
                    }
                }
            }
        }
    }

    #[test]
    fn all_of_the_memory_is_used() {
        assert_eq!(allowances(&[(1, 70), (2, 30)], 100, 100), [70, 30]);
        assert_eq!(
            allowances(&[(1, 90), (2, 30), (3, 50)], 100, 100),
            [35, 30, 35]
        );
        // Two lists of one peer have one share.
        assert_eq!(
            allowances(&[(1, 90), (1, 10), (2, 90)], 100, 100),
            [40, 10, 50]
        );
        assert_eq!(allowances(&[(1, 500)], 100, 1000), [100]);
    }
}
