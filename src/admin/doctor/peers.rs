//! Tests whether the TCP ports of static peers, and of other gateways, let this host in.

use std::io;
use std::net::TcpStream;
use std::sync::mpsc;
use std::time::Duration;

use fipa_transport::threads;

use super::{Area, Check, Severity};
use crate::{Config, Kind};

const AREA: Area = Area("network");
const PORTS: &str = "ports of static peers";

/// Maximum number of locations that are checked, each in a thread of its own.
const MAX_CHECKED: usize = 32;

/// Time for an answer.
const TIMEOUT: Duration = Duration::from_secs(2);

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    if !config.mts.transports.contains(&Kind::Tcp) {
        return;
    }
    let peers = config.discovery.peers.iter();
    let locations = peers.flat_map(|peer| {
        let tcp = peer.locations.iter();
        let tcp = tcp.filter(|location| location.kind() == Kind::Tcp);
        tcp.map(|location| (peer.name.clone(), location.address().to_owned()))
    });
    connect_all(PORTS, locations, checks);
}

/// Connects to these addresses, at most [`MAX_CHECKED`], each with the name of its host.
pub(super) fn connect_all(
    title: &'static str,
    addresses: impl Iterator<Item = (String, String)>,
    checks: &mut Vec<Check>,
) {
    let (sender, done) = mpsc::channel();
    for (place, (name, address)) in addresses.take(MAX_CHECKED).enumerate() {
        let (done, there, at) = (sender.clone(), name.clone(), address.clone());
        let started = threads::spawn(move || drop(done.send((place, check(title, &there, &at)))));
        if started.is_err() {
            // Without another thread, one after the other.
            let _ = sender.send((place, check(title, &name, &address)));
        }
    }
    drop(sender);
    let mut checked: Vec<(usize, Check)> = done.iter().collect();
    checked.sort_by_key(|(place, _)| *place);
    checks.extend(checked.into_iter().map(|(_, check)| check));
}

fn check(title: &'static str, name: &str, address: &str) -> Check {
    let found = |what: &str| format!("{name}, tcp://{address}: {what}");
    let warning =
        |what: &str, advice: String| AREA.problem(title, Severity::Warning, found(what), advice);
    match connect(address) {
        Ok(()) => AREA.fine(title, found("accepts connections")),
        Err(error) if error.kind() == io::ErrorKind::TimedOut => {
            let port = address.rsplit(':').next().unwrap_or_default();
            warning(
                &format!("nothing answered for {} s", TIMEOUT.as_secs()),
                format!(
                    "check that a firewall there lets it in (for example: sudo ufw allow {port}/tcp), and \
                     that the host is on"
                ),
            )
        }
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => warning(
            "the host answers, but no process listens on this port",
            "start `fipa up` there, with this port and an address of that host in transport.tcp.listen"
                .to_owned(),
        ),
        Err(error) => warning(
            &format!("cannot be reached: {error}"),
            "check the address in discovery.static, and the network (`ip route`)".to_owned(),
        ),
    }
}

/// Opens a connection and closes it. The peer ignores a connection without a byte.
fn connect(address: &str) -> io::Result<()> {
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for address in fipa_transport_net::resolve(address)?.into_iter().take(4) {
        match TcpStream::connect_timeout(&address, TIMEOUT) {
            Ok(_) => return Ok(()),
            Err(error) => last = error,
        }
    }
    Err(last)
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn an_open_and_a_closed_port_are_told_apart() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let open = check(PORTS, "crex", &address);
        assert_eq!(open.severity, Severity::Fine, "{}", open.found);
        let wrong = check(PORTS, "crex", "name without port");
        assert_eq!(wrong.severity, Severity::Warning);
        drop(listener);
        let closed = check(PORTS, "crex", &address);
        assert_eq!(closed.severity, Severity::Warning, "{}", closed.found);
        assert!(
            closed.found.contains("no process listens"),
            "{}",
            closed.found
        );
    }
}
