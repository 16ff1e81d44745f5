//! The real Avahi, on one host.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::{Host, Running};

/// How long `avahi-browse` has, in seconds: it takes one, or never ends.
const PATIENCE: &str = "10";
/// How often it is asked.
const TRIES: usize = 6;

const BUS: &str = "/run/fipa-testbed-bus";

const BUS_CONFIG: &str = r#"<!DOCTYPE busconfig PUBLIC
 "-//freedesktop//DTD D-Bus Bus Configuration 1.0//EN"
 "http://www.freedesktop.org/standards/dbus/1.0/busconfig.dtd">
<busconfig><type>system</type><listen>unix:path=/run/fipa-testbed-bus</listen>
<auth>EXTERNAL</auth><policy context="default"><allow user="*"/><allow own="*"/>
<allow send_destination="*"/><allow receive_sender="*"/></policy></busconfig>"#;

/// A running avahi-daemon with a bus of its own. One process can have one.
#[derive(Debug)]
pub struct Avahi<'a> {
    host: &'a Host,
    _daemon: Running,
    _bus: Running,
}

impl<'a> Avahi<'a> {
    /// What has to be there: to be named to [`isolated`](crate::isolated).
    pub const TOOLS: [&'static str; 4] = [
        "avahi-daemon",
        "avahi-browse",
        "avahi-publish",
        "dbus-daemon",
    ];

    /// Starts it on this host, for its interface `eth0`, and waits until it answers.
    ///
    /// # Panics
    /// When it does not.
    #[must_use]
    pub fn start(host: &'a Host) -> Self {
        std::fs::write("/run/bus.conf", BUS_CONFIG).unwrap();
        let settings = "[server]\nhost-name=peer\nallow-interfaces=eth0\nuse-ipv6=no\n\
                        [publish]\npublish-workstation=no\n";
        std::fs::write("/run/avahi.conf", settings).unwrap();
        let mut command = host.command("dbus-daemon");
        command.args(["--config-file=/run/bus.conf", "--nofork"]);
        let mut bus = Running::start(&mut command);
        until("the bus", &mut bus, || Path::new(BUS).exists());
        let mut command = with_bus(host.command("avahi-daemon"));
        command.args(["--no-drop-root", "--no-chroot", "--no-rlimits"]);
        command.arg("--file=/run/avahi.conf");
        let mut daemon = Running::start(&mut command);
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

    /// Announces a service with these TXT strings, until the result is dropped.
    ///
    /// # Panics
    /// When `avahi-publish` cannot be run.
    #[must_use]
    pub fn publish(&self, label: &str, service_type: &str, port: u16, txt: &[&str]) -> Running {
        let mut command = with_bus(self.host.command("avahi-publish"));
        command.args(["-s", label, service_type, &port.to_string()]);
        Running::start(command.args(txt).stdout(Stdio::null()))
    }

    /// What `avahi-browse` has to say about a type of services, one line each. `=` begins the line
    /// of one that was resolved; labels come in decimal escapes.
    ///
    /// When a record leaves while `avahi-browse` resolves it, that goes on waiting for it, for ever.
    /// So it is ended after a while, and asked again.
    ///
    /// # Panics
    /// When it fails.
    #[must_use]
    pub fn browse(&self, service_type: &str) -> Vec<String> {
        /// What `timeout` says of what it has ended.
        const ENDED: i32 = 124;
        for _ in 0..TRIES {
            let mut command = with_bus(self.host.command("timeout"));
            command.args([PATIENCE, "avahi-browse", "-rpt", service_type]);
            let output = command.output().unwrap();
            if output.status.code() == Some(ENDED) {
                continue;
            }
            assert!(output.status.success(), "avahi-browse: {output:?}");
            let text = String::from_utf8_lossy(&output.stdout);
            return text.lines().map(str::to_owned).collect();
        }
        panic!("avahi-browse does not end");
    }
}

fn with_bus(mut command: Command) -> Command {
    command.env("DBUS_SYSTEM_BUS_ADDRESS", format!("unix:path={BUS}"));
    command
}

fn until(what: &str, of: &mut Running, condition: impl Fn() -> bool) {
    let give_up = Instant::now() + Duration::from_secs(60);
    while !condition() {
        if let Some(status) = of.ended() {
            panic!("{what} ended ({status}); its error is above");
        }
        assert!(Instant::now() < give_up, "never came: {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
