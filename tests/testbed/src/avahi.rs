//! The real Avahi on a host.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::{ChildGuard, Host};

/// Timeout of `avahi-browse`, in seconds: it takes one second, or never ends.
const BROWSE_TIMEOUT: &str = "10";
/// Maximum number of attempts.
const MAX_ATTEMPTS: usize = 6;

const BUS: &str = "/run/fipa-testbed-bus";

const BUS_CONFIG: &str = r#"<!DOCTYPE busconfig PUBLIC
 "-//freedesktop//DTD D-Bus Bus Configuration 1.0//EN"
 "http://www.freedesktop.org/standards/dbus/1.0/busconfig.dtd">
<busconfig><type>system</type><listen>unix:path=/run/fipa-testbed-bus</listen>
<auth>EXTERNAL</auth><policy context="default"><allow user="*"/><allow own="*"/>
<allow send_destination="*"/><allow receive_sender="*"/></policy></busconfig>"#;

/// A running avahi-daemon with its own bus. A process can have only one.
#[derive(Debug)]
pub struct Avahi<'a> {
    host: &'a Host,
    _daemon: ChildGuard,
    _bus: ChildGuard,
}

impl<'a> Avahi<'a> {
    /// The required tools, for [`isolated`](crate::isolated).
    pub const TOOLS: [&'static str; 4] = [
        "avahi-daemon",
        "avahi-browse",
        "avahi-publish",
        "dbus-daemon",
    ];

    /// Starts Avahi on this host for its interface `eth0`, and waits until it is ready.
    ///
    /// # Panics
    /// If it does not start.
    #[must_use]
    pub fn start(host: &'a Host) -> Self {
        std::fs::write("/run/bus.conf", BUS_CONFIG).unwrap();
        let settings = "[server]\nhost-name=peer\nallow-interfaces=eth0\nuse-ipv6=no\n\
                        [publish]\npublish-workstation=no\n";
        std::fs::write("/run/avahi.conf", settings).unwrap();
        let mut command = host.command("dbus-daemon");
        command.args(["--config-file=/run/bus.conf", "--nofork"]);
        let mut bus = ChildGuard::start(&mut command);
        until("the bus", &mut bus, || Path::new(BUS).exists());
        let mut command = with_bus(host.command("avahi-daemon"));
        command.args(["--no-drop-root", "--no-chroot", "--no-rlimits"]);
        command.arg("--file=/run/avahi.conf");
        let mut daemon = ChildGuard::start(&mut command);
        until("Avahi", &mut daemon, || {
            let check = host.command("avahi-daemon").arg("--check").status();
            check.unwrap().success()
        });
        Self {
            host,
            _daemon: daemon,
            _bus: bus,
        }
    }

    /// Announces a service with these TXT strings until the returned process is dropped.
    ///
    /// # Panics
    /// If `avahi-publish` cannot be run.
    #[must_use]
    pub fn publish(&self, label: &str, service_type: &str, port: u16, txt: &[&str]) -> ChildGuard {
        let mut command = with_bus(self.host.command("avahi-publish"));
        command.args(["-s", label, service_type, &port.to_string()]);
        ChildGuard::start(command.args(txt).stdout(Stdio::null()))
    }

    /// Returns the output lines of `avahi-browse` for a service type. The line of a resolved service begins
    /// with `=`; labels have decimal escapes.
    ///
    /// `avahi-browse` hangs if a record disappears while it resolves it, so it is ended after a timeout and
    /// started again.
    ///
    /// # Panics
    /// If `avahi-browse` fails.
    #[must_use]
    pub fn browse(&self, service_type: &str) -> Vec<String> {
        /// Exit code of `timeout` after it has ended its command.
        const TIMED_OUT: i32 = 124;
        for _ in 0..MAX_ATTEMPTS {
            let mut command = with_bus(self.host.command("timeout"));
            command.args([BROWSE_TIMEOUT, "avahi-browse", "-rpt", service_type]);
            let output = command.output().unwrap();
            if output.status.code() == Some(TIMED_OUT) {
                continue;
            }
            assert!(output.status.success(), "avahi-browse: {output:?}");
            let text = String::from_utf8_lossy(&output.stdout);
            return text.lines().map(str::to_owned).collect();
        }
        panic!("avahi-browse timed out {MAX_ATTEMPTS} times");
    }
}

fn with_bus(mut command: Command) -> Command {
    command.env("DBUS_SYSTEM_BUS_ADDRESS", format!("unix:path={BUS}"));
    command
}

fn until(what: &str, process: &mut ChildGuard, condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !condition() {
        if let Some(status) = process.ended() {
            panic!("{what} ended ({status}); its error is above");
        }
        assert!(Instant::now() < deadline, "timed out: {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
