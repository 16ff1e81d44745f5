//! The address by which quotas count a peer.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};

/// Returns the address that represents a source: the network of 64 bits for IPv6, where every host
/// has many addresses; 127.0.0.1 for loopback, where every user of this host has all addresses. A link-local
/// address represents itself, because all neighbors have the same network.
#[must_use]
pub fn quota_address(ip: IpAddr) -> IpAddr {
    scoped_quota_address(ip, 0)
}

/// Returns the address that represents a source on this interface. Equal link-local addresses on two links are
/// different sources, so the number of the interface is in their bits that are always zero. Do not connect to it.
#[must_use]
pub fn scoped_quota_address(ip: IpAddr, interface: u32) -> IpAddr {
    match ip.to_canonical() {
        ip if ip.is_loopback() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(v6) if v6.is_unicast_link_local() => {
            IpAddr::V6(Ipv6Addr::from(u128::from(v6) | u128::from(interface) << 64))
        }
        IpAddr::V6(v6) => {
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
        assert_eq!(of("::ffff:192.0.2.1"), of("192.0.2.1"));
        assert_ne!(of("192.0.2.2"), of("192.0.2.1"));
    }

    #[test]
    fn a_link_local_address_is_one_source_on_each_link() {
        assert_ne!(of("fe80::1"), of("fe80::2"));
        let on = |interface| scoped_quota_address("fe80::1".parse().unwrap(), interface);
        assert_eq!(on(0), of("fe80::1"));
        assert_ne!(on(1), on(2));
        assert_ne!(on(u32::MAX), on(2));
        let elsewhere = |interface| scoped_quota_address("fd00::1".parse().unwrap(), interface);
        assert_eq!(elsewhere(1), elsewhere(2));
    }

    #[test]
    fn all_loopback_addresses_are_one_source() {
        for other in ["127.0.0.2", "127.255.255.254", "::1", "::ffff:127.0.0.3"] {
            assert_eq!(of(other), of("127.0.0.1"), "{other}");
        }
        assert_ne!(of("127.0.0.1"), of("10.0.0.1"));
    }
}
