//! Hosts on one switch.

use std::fs::File;
use std::net::{Ipv4Addr, Ipv6Addr};
use std::os::fd::AsFd;
use std::process::Command;

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

use crate::run;

/// Hosts, each with one interface `eth0` on the same switch: 10.99.0.1/24 and fd99::1/64 for the
/// first, and so on.
#[derive(Debug)]
pub struct Network {
    hosts: Vec<Host>,
}

impl Network {
    /// A network of so many hosts, all of them plugged in. One process can have one.
    ///
    /// # Panics
    /// When it cannot be made, or there would be more than 200 hosts.
    #[must_use]
    pub fn new(hosts: u8) -> Self {
        assert!(hosts <= 200, "no more than 200 hosts");
        // Without snooping, multicast goes to everybody, as on a plain switch.
        run("ip link add switch type bridge mcast_snooping 0 stp_state 0");
        run("ip link set switch up");
        let hosts = (1..=hosts).map(Host::new).collect();
        Self { hosts }
    }

    /// All hosts.
    #[must_use]
    pub fn hosts(&self) -> &[Host] {
        &self.hosts
    }

    /// One of the hosts, from 0.
    ///
    /// # Panics
    /// When there is none.
    #[must_use]
    pub fn host(&self, index: usize) -> &Host {
        &self.hosts[index]
    }
}

/// A host: a network namespace.
#[derive(Debug)]
pub struct Host {
    number: u8,
    name: String,
}

impl Host {
    fn new(number: u8) -> Self {
        let host = Self {
            number,
            name: format!("host{number}"),
        };
        let (name, port) = (&host.name, host.port());
        run(&format!("ip netns add {name}"));
        run(&format!(
            "ip link add {port} type veth peer name eth0 netns {name}"
        ));
        run(&format!("ip link set {port} master switch up"));
        host.ip("link set lo up");
        host.ip(&format!("addr add {}/24 dev eth0", host.ipv4()));
        // Without the wait for somebody who has the address already.
        host.ip(&format!("addr add {}/64 dev eth0 nodad", host.ipv6()));
        host.ip("link set eth0 up");
        host
    }

    /// The name of its namespace.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its address.
    #[must_use]
    pub fn ipv4(&self) -> Ipv4Addr {
        Ipv4Addr::new(10, 99, 0, self.number)
    }

    /// Its address of the other family.
    #[must_use]
    pub fn ipv6(&self) -> Ipv6Addr {
        Ipv6Addr::new(0xfd99, 0, 0, 0, 0, 0, 0, self.number.into())
    }

    /// The end of its cable at the switch.
    fn port(&self) -> String {
        format!("port{}", self.number)
    }

    /// A command to be run on this host.
    #[must_use]
    pub fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.name]).arg(program);
        command
    }

    /// `ip` with these words, for this host: `host.ip("link set eth0 down")`.
    ///
    /// # Panics
    /// When it fails.
    pub fn ip(&self, words: &str) {
        run(&format!("ip -n {} {words}", self.name));
    }

    /// Does something on this host, in a thread of its own. What that starts (threads, runtimes,
    /// sockets, processes) is on this host as well, and may outlive the call.
    ///
    /// # Panics
    /// When `work` does, or the namespace is gone.
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

    /// Cuts it off at the switch: nothing comes through any more, and it cannot tell, as when a
    /// radio is out of range.
    pub fn unplug(&self) {
        run(&format!("ip link set {} nomaster", self.port()));
    }

    /// Connects it again.
    pub fn plug(&self) {
        run(&format!("ip link set {} master switch", self.port()));
    }

    /// Whether the switch passes multicast on to this host, as it does from the start; much Wi-Fi
    /// does not.
    pub fn hears_multicast(&self, yes: bool) {
        let flood = if yes { "on" } else { "off" };
        let port = self.port();
        run(&format!(
            "ip link set {port} type bridge_slave mcast_flood {flood}"
        ));
    }
}
