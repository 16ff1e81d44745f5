//! Hosts in network namespaces, connected by a virtual switch.

use std::fs::File;
use std::net::{Ipv4Addr, Ipv6Addr};
use std::os::fd::AsFd;
use std::process::Command;

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use crate::run;

/// The addresses that the hosts of a [`Network`] have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Family {
    /// IPv4 only: 10.99.0.1/24 for the first host, and so on.
    V4,
    /// IPv6 with unique local addresses only: fd99::1/64 for the first host, and so on.
    UniqueLocal,
    /// IPv6 with link-local addresses only: fe80::1/64 for the first host, and so on.
    LinkLocal,
    /// All of these.
    Both,
}

impl Family {
    /// All families.
    pub const ALL: [Self; 4] = [Self::V4, Self::UniqueLocal, Self::LinkLocal, Self::Both];
}

/// A network of hosts. Each host has one interface `eth0` on the same switch. Its number differs from
/// host to host.
#[derive(Debug)]
pub struct Network {
    hosts: Vec<Host>,
}

impl Network {
    /// Creates a network of this number of hosts with addresses of both families, all connected. A
    /// process can have only one network.
    ///
    /// # Panics
    /// If the network cannot be created, or for more than 200 hosts.
    #[must_use]
    pub fn new(hosts: u8) -> Self {
        Self::of(Family::Both, hosts)
    }

    /// Creates a network of hosts with addresses of this family.
    ///
    /// # Panics
    /// If the network cannot be created, or for more than 200 hosts.
    #[must_use]
    pub fn of(family: Family, hosts: u8) -> Self {
        assert!(hosts <= 200, "at most 200 hosts");
        // Without snooping, the bridge forwards multicast to all ports, as a simple switch does.
        run("ip link add switch type bridge mcast_snooping 0 stp_state 0");
        run("ip link set switch up");
        let hosts = (1..=hosts)
            .map(|number| Host::new(family, number))
            .collect();
        Self { hosts }
    }

    /// All hosts.
    #[must_use]
    pub fn hosts(&self) -> &[Host] {
        &self.hosts
    }

    /// The host with this index, from 0.
    ///
    /// # Panics
    /// If there is no such host.
    #[must_use]
    pub fn host(&self, index: usize) -> &Host {
        &self.hosts[index]
    }
}

/// A host: a network namespace.
#[derive(Debug)]
pub struct Host {
    family: Family,
    number: u8,
    name: String,
}

impl Host {
    fn new(family: Family, number: u8) -> Self {
        let host = Self {
            family,
            number,
            name: format!("host{number}"),
        };
        let (name, port) = (&host.name, host.port());
        run(&format!("ip netns add {name}"));
        let index = 100 + u32::from(number);
        run(&format!(
            "ip link add eth0 index {index} type veth peer name {port}"
        ));
        // The interface keeps its number, which differs from those of the other hosts.
        run(&format!("ip link set eth0 netns {name}"));
        run(&format!("ip link set {port} master switch up"));
        host.ip("link set lo up");
        // The kernel adds no link-local address of its own.
        host.ip("link set eth0 addrgenmode none");
        host.come_up(number);
        host
    }

    /// The name of its namespace.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its addresses on the network, as other hosts write them with a port: `10.99.0.1`, `[fd99::1]`,
    /// `[fe80::1%eth0]`.
    #[must_use]
    pub fn addresses(&self) -> Vec<String> {
        self.addresses_with(self.number)
    }

    /// The addresses of a host with another number, which [`move_to`](Self::move_to) gives it.
    #[must_use]
    pub fn addresses_with(&self, number: u8) -> Vec<String> {
        let v4 = || ipv4(number).to_string();
        let unique_local = || format!("[{}]", ipv6(0xfd99, number));
        let link_local = || format!("[{}%eth0]", ipv6(0xfe80, number));
        match self.family {
            Family::V4 => vec![v4()],
            Family::UniqueLocal => vec![unique_local()],
            Family::LinkLocal => vec![link_local()],
            Family::Both => vec![v4(), unique_local(), link_local()],
        }
    }

    /// The addresses of a number, as `ip addr` takes them.
    fn assigned(&self, number: u8) -> Vec<String> {
        // `nodad` skips duplicate address detection, which delays the use of the address.
        let v4 = || format!("{}/24", ipv4(number));
        let v6 = |prefix| format!("{}/64 nodad", ipv6(prefix, number));
        match self.family {
            Family::V4 => vec![v4()],
            Family::UniqueLocal => vec![v6(0xfd99)],
            Family::LinkLocal => vec![v6(0xfe80)],
            Family::Both => vec![v4(), v6(0xfd99), v6(0xfe80)],
        }
    }

    /// Sets the interface up, with the addresses of this number beside those that it has. An interface that
    /// goes down loses its IPv6 addresses.
    ///
    /// # Panics
    /// If a command fails.
    pub fn come_up(&self, number: u8) {
        let addresses = self.assigned(number);
        for address in &addresses {
            self.ip(&format!("addr replace dev eth0 {address}"));
        }
        self.ip("link set eth0 up");
        if self.family != Family::V4 {
            // Multicast over IPv6 needs its route also where no address is link-local.
            self.ip("-6 route replace multicast ff00::/8 dev eth0 table local");
        }
    }

    /// Removes all addresses of the host.
    ///
    /// # Panics
    /// If the command fails.
    pub fn flush(&self) {
        self.ip("addr flush dev eth0");
    }

    /// Replaces the addresses of the host by those of this number at once.
    ///
    /// # Panics
    /// If a command fails.
    pub fn move_to(&self, number: u8) {
        self.flush();
        self.come_up(number);
    }

    /// Its IPv4 address, if the network has such addresses.
    #[must_use]
    pub fn ipv4(&self) -> Ipv4Addr {
        ipv4(self.number)
    }

    /// Its unique local IPv6 address, if the network has such addresses.
    #[must_use]
    pub fn ipv6(&self) -> Ipv6Addr {
        ipv6(0xfd99, self.number)
    }

    /// Its link-local IPv6 address, if the network has such addresses.
    #[must_use]
    pub fn link_local(&self) -> Ipv6Addr {
        ipv6(0xfe80, self.number)
    }

    /// The name of its port at the switch.
    fn port(&self) -> String {
        format!("port{}", self.number)
    }

    /// A command that runs on this host.
    #[must_use]
    pub fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.name]).arg(program);
        command
    }

    /// Runs `ip` with these arguments for this host: `host.ip("link set eth0 down")`.
    ///
    /// # Panics
    /// If the command fails.
    pub fn ip(&self, words: &str) {
        run(&format!("ip -n {} {words}", self.name));
    }

    /// Runs `work` on this host, in a new thread. Threads, runtimes, sockets and processes that it creates
    /// are on this host as well, and may outlive the call.
    ///
    /// # Panics
    /// If `work` panics, or the namespace does not exist.
    pub fn enter<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        let namespace = File::open(format!("/run/netns/{}", self.name)).unwrap();
        std::thread::scope(|scope| {
            let entered = scope.spawn(move || {
                move_into_link_name_space(namespace.as_fd(), Some(LinkNameSpaceType::Network))
                    .unwrap();
                work()
            });
            match entered.join() {
                Ok(result) => result,
                Err(panic) => std::panic::resume_unwind(panic),
            }
        })
    }

    /// Disconnects the host at the switch. The host cannot detect this, as with a radio out of range.
    pub fn unplug(&self) {
        run(&format!("ip link set {} nomaster", self.port()));
    }

    /// Connects the host again.
    pub fn plug(&self) {
        run(&format!("ip link set {} master switch", self.port()));
    }

    /// Sets whether the switch forwards multicast to this host (initially yes; many Wi-Fi access points do
    /// not).
    pub fn forward_multicast(&self, enabled: bool) {
        let flood = if enabled { "on" } else { "off" };
        let port = self.port();
        run(&format!(
            "ip link set {port} type bridge_slave mcast_flood {flood}"
        ));
    }
}

fn ipv4(number: u8) -> Ipv4Addr {
    Ipv4Addr::new(10, 99, 0, number)
}

fn ipv6(prefix: u16, number: u8) -> Ipv6Addr {
    Ipv6Addr::new(prefix, 0, 0, 0, 0, 0, 0, number.into())
}
