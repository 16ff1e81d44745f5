//! Checks of what the configuration names on this machine: directories, files and interfaces.
//!
//! `fipa config check` runs them, and loading does not: another process, or the same one later, may
//! find what is missing here.

use std::net::{IpAddr, UdpSocket};

use fipa_transport::{Kind, Location};

use super::check::Finding;
use super::{Config, Interface, PeerConfig};

/// Returns the values that name something that this machine does not have.
pub(super) fn findings(config: &Config) -> Vec<Finding> {
    let mut found = Vec::new();
    static_peers(config, &mut found);
    interfaces(config, &mut found);
    keys(config, &mut found);
    protocols(config, &mut found);
    local_transports(config, &mut found);
    found
}

/// A gateway runs without a transport within the host. Other processes do not.
fn local_transports(config: &Config, found: &mut Vec<Finding>) {
    let transports = &config.mts.transports;
    let is_usable = |kind: &Kind| {
        kind.is_host_local() || (*kind == Kind::Tcp && config.transport.tcp.processes)
    };
    if !transports.iter().any(is_usable) {
        found.push(Finding::new(
            &["mts", "transports"],
            "has none for processes of one host, so only a gateway can use this configuration",
            "list shm or unix, or list tcp and set transport.tcp.processes = true",
        ));
    }
}

fn static_peers(config: &Config, found: &mut Vec<Finding>) {
    let on = &config.mts.transports;
    for PeerConfig { name, locations } in &config.discovery.peers {
        let kinds: Vec<_> = locations.iter().map(|location| location.kind()).collect();
        let Some(first) = kinds.first() else { continue };
        let has_no_scope =
            |it: &&Location| it.is_link_local() && (*it).clone().without_scope() == **it;
        if let Some(location) = locations.iter().find(has_no_scope) {
            found.push(Finding::new(
                &["discovery", "static", name.as_str()],
                format_args!("lists {location}, a link-local address without an interface"),
                "append the interface that leads to it, for example [fe80::1%eth0]:7788",
            ));
        }
        if !kinds.iter().any(|kind| on.contains(kind)) {
            found.push(Finding::new(
                &["discovery", "static", name.as_str()],
                "lists only transports that are off, so no letter reaches this peer",
                format!("add {first} to `mts.transports`, or list another location of the peer"),
            ));
        }
    }
}

fn interfaces(config: &Config, found: &mut Vec<Finding>) {
    let Some(names) = interface_names() else {
        return;
    };
    let exists = |name: &str| names.iter().any(|found| found == name);
    let help = || match names.is_empty() {
        true => "this machine has no network interface now".to_owned(),
        false => format!("this machine has {} now", names.join(", ")),
    };
    for interface in &config.discovery.interfaces {
        let is_there = match interface {
            Interface::Name(name) => exists(name),
            Interface::Address(address) => is_own(*address),
        };
        if !is_there {
            found.push(Finding::new(
                &["discovery", "interfaces"],
                format_args!("lists {interface}, which no network interface of this machine has"),
                help(),
            ));
        }
    }
    let transport = &config.transport;
    for (kind, listen) in [
        ("tcp", &transport.tcp.listen),
        ("udp", &transport.udp.listen),
        ("quic", &transport.quic.listen),
        ("http", &transport.http.listen),
        ("https", &transport.https.listen),
        ("udt", &transport.udt.listen),
    ] {
        for address in listen {
            let scope = address
                .split_once('%')
                .and_then(|(_, rest)| rest.split_once(']'))
                .map(|(scope, _)| scope);
            // A numeric scope is the index of an interface.
            let missing = scope.filter(|scope| scope.parse::<u32>().is_err() && !exists(scope));
            if let Some(scope) = missing {
                found.push(Finding::new(
                    &["transport", kind, "listen"],
                    format_args!("lists {address}, but there is no network interface {scope}"),
                    help(),
                ));
            }
        }
    }
}

/// Returns the names of the interfaces in the network of this process; `None` if the kernel does not
/// list them.
fn interface_names() -> Option<Vec<String>> {
    let table = std::fs::read_to_string("/proc/self/net/dev").ok()?;
    // Two lines of headings, then one line per interface: `  eth0: 1234 …`.
    let lines = table.lines().skip(2);
    let names = lines.filter_map(|line| line.split_once(':').map(|(name, _)| name.trim()));
    Some(names.map(str::to_owned).collect())
}

/// Whether an interface has this address.
fn is_own(address: IpAddr) -> bool {
    UdpSocket::bind((address, 0)).is_ok()
}

#[cfg(not(feature = "secure"))]
fn keys(_config: &Config, _found: &mut Vec<Finding>) {}

#[cfg(feature = "secure")]
fn keys(config: &Config, found: &mut Vec<Finding>) {
    use fipa_acl::ErrorChain;

    use crate::admin::keys::{Keys, KeysError};

    let dir = &config.security.keys;
    // `~` is reported with the values.
    if dir.is_empty() || dir.starts_with('~') {
        return;
    }
    if let Err(error) = Keys::at(dir).examined_credentials_of(&config.mts.name) {
        let help = match &error {
            KeysError::Missing(_) => {
                "make keys (`fipa keys init`), or name the directory that has them"
            }
            KeysError::Name { .. } => {
                "set mts.name to the name in the certificate, or make new keys in an empty directory"
            }
            _ => "the gateway needs this directory to start; `fipa keys list` shows its contents",
        };
        let what = format!("cannot be used: {}", ErrorChain(&error));
        found.push(Finding::new(&["security", "keys"], what, help));
    }
}

#[cfg(not(feature = "protocols"))]
fn protocols(_config: &Config, _found: &mut Vec<Finding>) {}

#[cfg(feature = "protocols")]
fn protocols(config: &Config, found: &mut Vec<Finding>) {
    use fipa_acl::escape;
    use fipa_monitor::Machine;

    for file in config
        .monitor
        .protocols
        .iter()
        .filter(|file| !file.is_empty())
    {
        let mut add = |what: String, help: &str| {
            found.push(Finding::new(&["monitor", "protocols"], what, help));
        };
        let shown = escape(file);
        match std::fs::read_to_string(file) {
            Err(error) => add(
                format!("lists {shown}, which cannot be read: {error}"),
                "relative paths start at the working directory of the process; prefer absolute paths",
            ),
            Ok(text) => {
                if let Err(error) = Machine::read(file, &text) {
                    add(
                        format!(
                            "lists a protocol with mistakes:\n{}",
                            escape_lines(&error.to_string())
                        ),
                        "correct the file; `fipa protocol check FILE` checks it alone",
                    );
                }
            }
        }
    }
}

/// Escapes each line of a text.
#[cfg(feature = "protocols")]
fn escape_lines(text: &str) -> String {
    let lines: Vec<_> = text.lines().map(fipa_acl::escape).collect();
    lines.join("\n")
}
