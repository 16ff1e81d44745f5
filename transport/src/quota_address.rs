//! The address by which quotas count a peer.

use std::net::{IpAddr, Ipv4Addr};

/// Returns the address that represents a source: the network of 64 bits for IPv6, where every host
/// has many addresses; 127.0.0.1 for loopback, where every user of this host has all addresses.
#[must_use]
pub fn quota_address(ip: IpAddr) -> IpAddr {
    match ip.to_canonical() {
        ip if ip.is_loopback() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(v6) if !v6.is_unicast_link_local() => {
            let network = u128::from(v6) & !u128::from(u64::MAX);
            IpAddr::V6(network.into())
        }
        ip => ip,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(ip: &str) -> IpAddr {
        quota_address(ip.parse().unwrap())
    }

    #[test]
    fn all_addresses_of_an_ipv6_network_are_one_peer() {
        assert_eq!(of("2001:db8::1"), of("2001:db8::ffff:2"));
        assert_ne!(of("2001:db8::1"), of("2001:db8:0:1::1"));
        assert_ne!(of("fe80::1"), of("fe80::2"));
    }

    #[test]
    fn all_loopback_addresses_are_one_source() {
        for other in ["127.0.0.2", "127.255.255.254", "::1", "::ffff:127.0.0.3"] {
            assert_eq!(of(other), of("127.0.0.1"), "{other}");
        }
        assert_ne!(of("127.0.0.1"), of("10.0.0.1"));
    }
}
