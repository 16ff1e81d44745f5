//! The connections of each client: one host does not keep all others out.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;

use fipa_transport::quota_address;
use parking_lot::Mutex;

/// Maximum number of connections of another host at the same time. A further one is closed.
const MAX_OF_HOST: usize = 12;

/// The open connections by the address of the client. All IPv6 addresses of a network of 64 bits count as
/// one host.
#[derive(Debug, Default)]
pub(super) struct Shares {
    open: Mutex<HashMap<IpAddr, usize>>,
}

/// One connection of a client. Ends its count when it is dropped.
#[derive(Debug)]
pub(super) struct Share {
    shares: Arc<Shares>,
    client: IpAddr,
}

impl Shares {
    /// Counts a connection of this client; `None` if it has too many. All users of this host have one address, and no
    /// bound of their own.
    pub(super) fn take(self: &Arc<Self>, client: IpAddr) -> Option<Share> {
        let client = quota_address(client);
        let mut open = self.open.lock();
        let count = open.entry(client).or_default();
        if *count >= MAX_OF_HOST && !client.is_loopback() {
            return None;
        }
        *count += 1;
        Some(Share {
            shares: Arc::clone(self),
            client,
        })
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        let mut open = self.shares.open.lock();
        if let Some(count) = open.get_mut(&self.client) {
            *count = count.saturating_sub(1);
            if *count == 0 {
                open.remove(&self.client);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    #[test]
    fn addresses_of_one_ipv6_network_have_one_share() {
        let shares = Arc::new(Shares::default());
        let address =
            |network: u16, host: u16| IpAddr::from([0x2001, 0xdb8, 0, network, 0, 0, 0, host]);
        let all: Vec<Share> = (1..100)
            .map_while(|host| shares.take(address(1, host)))
            .collect();
        assert_eq!(all.len(), MAX_OF_HOST);
        assert!(shares.take(address(2, 1)).is_some());
    }

    #[test]
    fn a_host_has_its_share_and_this_host_all() {
        let shares = Arc::new(Shares::default());
        let (one, other) = ([10, 0, 0, 1].into(), [10, 0, 0, 2].into());
        let mut all: Vec<Share> = (0..MAX_OF_HOST).map_while(|_| shares.take(one)).collect();
        assert_eq!(all.len(), MAX_OF_HOST);
        assert!(shares.take(one).is_none());
        let mapped = IpAddr::from(Ipv4Addr::new(10, 0, 0, 1).to_ipv6_mapped());
        assert!(shares.take(mapped).is_none());
        assert!(shares.take(other).is_some());
        all.pop();
        assert!(shares.take(one).is_some());
        let local: Vec<Share> = (0..100)
            .map_while(|_| shares.take(Ipv4Addr::LOCALHOST.into()))
            .collect();
        assert_eq!(local.len(), 100);
        drop((all, local));
        assert!(shares.open.lock().is_empty());
    }
}
