//! The peers and the random numbers of an endpoint for fuzz targets.

use std::net::SocketAddr;

use super::{Path, Random};

/// Returns the address of a peer: one of four.
pub(crate) fn address(peer: u8, port: u16) -> SocketAddr {
    SocketAddr::from(([192, 0, 2, 10 + peer % 4], port))
}

/// Returns the path to an address.
pub(crate) fn path(remote: SocketAddr) -> Path {
    Path {
        socket: 1,
        remote,
        local: None,
    }
}

/// Returns random numbers that follow from the seed (SplitMix64).
pub(crate) fn random(seed: u64) -> Random {
    let mut random = seed;
    Box::new(move || {
        random = random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (random ^ (random >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (mixed ^ (mixed >> 27)).max(1)
    })
}
