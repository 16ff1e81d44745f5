//! The shares of the peers at one address in the connections and in the memory of an endpoint over UDP.

use std::net::IpAddr;

use crate::rate_limit::is_one_peer;
use crate::stream::budget::BudgetLimits;

/// Returns the maximum number of connections that the peers at this address may open: at most
/// half of all, for one address as for all loopback addresses together.
pub(crate) fn connections_of(home: IpAddr, all: usize, per_address: usize) -> usize {
    let half = (all / 2).max(1);
    match is_one_peer(home) {
        true => per_address.min(half),
        false => half,
    }
}

/// Returns the memory limits of arriving letters, for the peers at this address and for all.
pub(crate) fn budget_of(home: IpAddr, total: usize, per_source: usize) -> BudgetLimits {
    BudgetLimits {
        total,
        each: match is_one_peer(home) {
            true => per_source,
            false => per_source.saturating_mul(2),
        },
    }
}
