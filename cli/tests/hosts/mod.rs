//! Gateway processes, keys and packet filters on the hosts of a test network.

#![allow(dead_code, reason = "no test uses all items")]

use std::process::{Command, Stdio};

use fipa::admin::keys::{Keys, VALID};
use fipa_testbed::Host;

/// The port of every gateway.
pub(crate) const PORT: u16 = 7788;

/// Returns the keys of a host, in the directory of the running test.
pub(crate) fn keys(at: usize) -> Keys {
    Keys::at(fipa_testbed::directory().join(format!("keys{at}")))
}

/// Creates keys for this number of hosts. Every host trusts all others.
pub(crate) fn make_keys(hosts: usize) {
    for at in 0..hosts {
        keys(at).init(&format!("gateway{at}"), &[], VALID).unwrap();
    }
    for at in 0..hosts {
        for other in (0..hosts).filter(|other| *other != at) {
            let pem = std::fs::read(keys(other).own_file()).unwrap();
            keys(at).trust(&pem).unwrap();
        }
    }
}

/// Returns the command that starts a gateway on this host. The gateway is ready when it prints its
/// first line, which is JSON.
pub(crate) fn gateway(host: &Host, settings: &[String]) -> Command {
    let mut command = host.command(env!("CARGO_BIN_EXE_fipa"));
    command.args(["up", "--json"]);
    for setting in settings {
        command.args(["--set", setting]);
    }
    if std::env::var_os("FIPA_TEST_LOG").is_some() {
        command.arg("-v");
    }
    command.stdin(Stdio::null());
    command
}

/// Adds a packet filter rule for incoming packets.
pub(crate) fn filter(host: &Host, rule: &str) {
    nft(host, "add table inet weather");
    let hook = "{ type filter hook input priority 0; }";
    nft(host, &format!("add chain inet weather in {hook}"));
    nft(host, &format!("add rule inet weather in {rule}"));
}

pub(crate) fn nft(host: &Host, command: &str) {
    let done = host.command("nft").arg(command).status().unwrap();
    assert!(done.success(), "nft {command}");
}
