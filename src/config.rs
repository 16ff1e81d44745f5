//! The configuration: what one TOML file, `--set key=value` and the defaults say together.
//!
//! * [`Sources`] is where it is looked for; [`Config::load`] reads it, checks it and returns the
//!   values. [`Effective`] is the same with the origin of every value, for `fipa config show`.
//! * [`ConfigError`] says what is wrong: all mistakes at once, each with file, line and key, what
//!   is allowed there and, for an unknown key, the nearest known one.
//!
//! The first of these files counts, and no other is read: the one given with `--config`, the one
//! named by `$FIPA_CONFIG`, `./fipa.toml`, `~/.config/fipa/fipa.toml`. What no file says has its
//! default:
//!
//! ```toml
//! domain = "default"                  # processes of one domain on one host see each other
//! [mts]
//! name = "sherpa-mts"                 # default: <host name>-mts
//! transports = ["shm", "unix", "tcp"] # order of preference; what is not listed is off
//! deadline = "5s"                     # per letter, unless the letter says otherwise
//! queue = 256                         # letters waiting per agent before senders are held back
//! queue_bytes = "64MiB"               # the same in bytes; also per sender and receiver at gateways
//! [routes]                            # exceptions by receiver name or pattern, first match counts
//! "camera_.*" = ["shm"]               # (none by default)
//! [transport.shm]
//! capacity = "256MiB"                 # of this domain on this host
//! max_letter = "64MiB"
//! spin = "50us"                       # before blocking; 0 on battery
//! [transport.tcp]
//! listen = ["127.0.0.1:0"]            # of the gateway; loopback unless the owner opens it
//! processes = false                   # true: other processes of the host use TCP, too
//! [transport.udp]
//! listen = ["127.0.0.1:0"]            # as for tcp; letters that fit one datagram
//! [transport.quic]
//! listen = ["127.0.0.1:0"]            # as for tcp; always encrypted, needs security.keys
//! [discovery]
//! mdns = true
//! interfaces = []                     # empty: all that listen; names or addresses otherwise
//! static = { crex-mts = ["tcp://10.0.0.2:7788"] }   # (none by default)
//! [security]
//! keys = ""                           # directory of `fipa keys init`; empty: nothing is encrypted
//! insecure = false                    # open to the network without keys
//! loopback = false                    # with keys: peers on this host prove who they are, too
//! old_peers = []                      # with keys: addresses of old peers, which cannot
//! [access]
//! rate = 0                            # letters a second of one sender; 0: any number
//! allow = { "rover_.*" = ["arm performative=request"] }   # nothing else passes (none by default)
//! deny = { ".*" = ["brake"] }         # comes before what is allowed (none by default)
//! [monitor]
//! check = "off"                       # or warn, enforce: whether agents keep to their protocols
//! answer = false                      # whether what breaks one is answered with not-understood
//! protocols = []                      # SCXML files, beyond the protocols of FIPA
//! ```
//!
//! What must not live here: opening anything that the configuration names. A transport that this
//! process was built without (`tcp` without the feature `net`) is no mistake here, because one
//! file serves all processes of a robot.

mod changes;
mod check;
mod effective;
mod error;
mod keys;
mod reader;
mod sources;
#[cfg(test)]
mod tests;

use std::fmt;
use std::net::IpAddr;
use std::time::Duration;

use fipa_transport::{Kind, Location};

#[cfg(feature = "net")]
pub(crate) use check::is_on_loopback;
pub use effective::{Effective, Setting, Value};
pub use error::{ConfigError, Mistake, Origin};
pub use sources::Sources;

use crate::access;

/// What the owner of a robot chooses, complete and checked.
///
/// A program that changes a value after loading calls [`Config::check`] before it uses it.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Config {
    /// `domain`: processes of one domain on one host see each other. Part of paths and of the
    /// names of shared memory: 1 to 32 of `A-Z a-z 0-9 _ -`.
    pub domain: String,
    /// `[mts]`: the message transport service of this process.
    pub mts: Mts,
    /// `[routes]`: other orders of transports for some receivers. The first that matches counts;
    /// those given with `--set` stand before those of the file.
    pub routes: Vec<Route>,
    /// `[transport.*]`: the transports themselves.
    pub transport: Transports,
    /// `[discovery]`: how other hosts are found.
    pub discovery: Discovery,
    /// `[security]`: who is let in from other hosts.
    pub security: Security,
    /// `[access]`: who may send what to whom.
    pub access: Access,
    /// `[monitor]`: whether agents keep to their protocols.
    pub monitor: Monitor,
}

/// `[mts]`: the message transport service of a process.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Mts {
    /// `name`: the name of the gateway, 1 to 255 bytes without control characters.
    pub name: String,
    /// `transports`: in order of preference, none twice; what is not listed is off.
    pub transports: Vec<Kind>,
    /// `deadline`: of a letter that does not say its own; more than 0, at most 1 hour.
    pub deadline: Duration,
    /// `queue`: letters that wait in the queue of one agent before its senders are held back, 1 to
    /// 65,536.
    pub queue: usize,
    /// `queue_bytes`: bytes of letters that wait in the queue of one agent, and of letters from one
    /// sender to one receiver that wait in a process or gateway, before their senders are held
    /// back. One letter is always taken. 64 KiB to 1 TiB.
    pub queue_bytes: u64,
}

/// One line of `[routes]`.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Route {
    /// A name, or a pattern matched against the whole of a name: a [`fipa_sds::Pattern`] that
    /// compiles.
    pub receiver: String,
    /// The order for these receivers. What [`Mts::transports`] leaves out is off here too; at
    /// least one of them is on.
    pub transports: Vec<Kind>,
}

/// `[transport.*]`: the transports.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Transports {
    /// `[transport.shm]`.
    pub shm: Shm,
    /// `[transport.tcp]`.
    pub tcp: Tcp,
    /// `[transport.udp]`.
    pub udp: Listen,
    /// `[transport.quic]`; needs [`Security::keys`].
    pub quic: Listen,
}

/// `[transport.shm]`: shared memory.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Shm {
    /// `capacity`: bytes of shared memory that this domain may take on this host, 1 MiB to 1 TiB.
    pub capacity: u64,
    /// `max_letter`: bytes of the largest letter, 4 KiB to the capacity.
    pub max_letter: u64,
    /// `spin`: how long a receiver spins before it blocks, at most 1 s. Zero: not at
    /// all.
    pub spin: Duration,
}

/// `[transport.tcp]`: letters over TCP.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Tcp {
    /// `listen`: where the gateway listens; see [`Listen::listen`].
    pub listen: Vec<String>,
    /// `processes`: whether processes that are not the gateway use TCP among each other, too. They
    /// listen on a port of 127.0.0.1 that the system chooses, where every user of the host can
    /// connect.
    pub processes: bool,
}

/// `[transport.udp]` and `[transport.quic]`: where a network transport of the gateway listens.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Listen {
    /// `listen`: numeric addresses with port, for example `127.0.0.1:0`, `[::1]:7788` or
    /// `[fe80::1%eth0]:7788`. Port 0 lets the system choose. Empty: nothing listens, and peers
    /// answer over the connections made from here.
    ///
    /// Text, because the scope of an interface that is not there yet has no number.
    pub listen: Vec<String>,
}

/// `[discovery]`: how other hosts are found.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Discovery {
    /// `mdns`: whether agents are announced and looked for by multicast DNS.
    pub mdns: bool,
    /// `interfaces`: where; empty: on all.
    pub interfaces: Vec<Interface>,
    /// `static`: gateways, and agents of old peers, known without being found.
    pub peers: Vec<Peer>,
}

/// One line of `discovery.static`: who is known without being found. A gateway, or an agent of an
/// old peer when what is understood at its locations says so.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Peer {
    /// The name of the gateway, or of the agent.
    pub name: String,
    /// Where it listens, in order of preference; at least one.
    pub locations: Vec<Location>,
}

/// `[security]`: who is let in from other hosts. Without keys everybody who can connect is, so
/// gateways listen on loopback only, unless the owner wants it otherwise.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Security {
    /// `keys`: the directory with this host's keys and the certificates that it trusts; empty: none.
    pub keys: String,
    /// `insecure`: whether the gateway may be open to the network without keys.
    pub insecure: bool,
    /// `loopback`: whether peers on loopback addresses have to prove who they are, too.
    pub loopback: bool,
    /// `old_peers`: addresses of old peers, which cannot prove who they are; letters in their
    /// dialects are exchanged with them nevertheless. At most 64.
    pub old_peers: Vec<IpAddr>,
    /// `peer_connections`: how many connections of each transport the peers with one certificate, or the
    /// peers at one address without keys, may open. This and the next two go for other hosts, and for loopback addresses where those have to prove
    /// who they are, too.
    pub peer_connections: usize,
    /// `peer_letters`: letters a second that each transport takes from one address, as many of which may
    /// come at once; what is more waits at its sender. 0: any number.
    pub peer_letters: usize,
    /// `peer_bytes`: the same of bytes.
    pub peer_bytes: u64,
}

/// `[access]`: who may send what to whom. The gateway keeps to it for what it takes, and every process
/// for what its own agents get. A rule that denies comes before those that allow; when there are any that
/// allow, nothing else passes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Access {
    /// `rate`: letters a second that one sender may send, as many of which may come at once; 0: any
    /// number. At most 1,000,000.
    pub rate: usize,
    /// `allow`: what may be sent, by sender. At most 256 lines.
    pub allow: Vec<AccessRule>,
    /// `deny`: what may not be sent. At most 256 lines.
    pub deny: Vec<AccessRule>,
}

/// One line of `access.allow` or `access.deny`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AccessRule {
    /// The sender's name, or a pattern matched against the whole of it.
    pub sender: String,
    /// Receivers: a name or pattern each, and behind it perhaps `performative=NAME,…` and
    /// `protocol=NAME,…`, when the rule is about those only.
    pub receivers: Vec<String>,
}

impl AccessRule {
    /// The sender and the receivers.
    pub(crate) fn parts(&self) -> (&str, &[String]) {
        (&self.sender, &self.receivers)
    }
}

impl Access {
    /// The rules that this section configures; `None` if it has none.
    pub(crate) fn rules(&self) -> Result<Option<access::Access>, access::RuleError> {
        let deny = self.deny.iter().map(AccessRule::parts);
        let allow = self.allow.iter().map(AccessRule::parts);
        access::Access::new(deny, allow, self.rate)
    }
}

/// `[monitor]`: whether agents keep to their protocols. Without the feature `monitor` nothing is
/// checked.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Monitor {
    /// `check`: what is done about messages that violate their protocol.
    pub check: Check,
    /// `answer`: whether a message that came and violates its protocol is answered with
    /// `not-understood`.
    pub answer: bool,
    /// `protocols`: paths of SCXML files with protocols beyond FIPA's, or in their place; at most
    /// 128.
    pub protocols: Vec<String>,
}

/// What is done about messages that violate their protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Check {
    /// Nothing is checked.
    Off,
    /// They are logged; those that came say so.
    Warn,
    /// They are not sent; those that came are handed over as errors.
    Enforce,
}

impl Check {
    pub(crate) const ALL: [Self; 3] = [Self::Off, Self::Warn, Self::Enforce];

    /// As it stands in the file.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Warn => "warn",
            Self::Enforce => "enforce",
        }
    }
}

/// A network interface, as the configuration names it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Interface {
    /// By its name, for example `wlan0`.
    Name(String),
    /// By an address it has.
    Address(IpAddr),
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Name(name) => f.pad(name),
            Self::Address(address) => fmt::Display::fmt(address, f),
        }
    }
}

impl Config {
    /// Finds, reads and checks the configuration.
    ///
    /// # Errors
    /// When a file cannot be read, or with all mistakes that were found.
    pub fn load(sources: &Sources) -> Result<Self, ConfigError> {
        Effective::load(sources).map(Effective::into_config)
    }

    /// The defaults on the host of this name.
    #[must_use]
    pub fn for_host(host_name: &str) -> Self {
        let loopback = Listen {
            listen: vec!["127.0.0.1:0".to_owned()],
        };
        Self {
            domain: "default".to_owned(),
            mts: Mts {
                name: keys::default_mts_name(host_name),
                transports: vec![Kind::Shm, Kind::Unix, Kind::Tcp],
                deadline: Duration::from_secs(5),
                queue: 256,
                queue_bytes: 64 << 20,
            },
            routes: Vec::new(),
            transport: Transports {
                shm: Shm {
                    capacity: 256 << 20,
                    max_letter: 64 << 20,
                    spin: Duration::from_micros(50),
                },
                tcp: Tcp {
                    listen: loopback.listen.clone(),
                    processes: false,
                },
                udp: loopback.clone(),
                quic: loopback,
            },
            discovery: Discovery {
                mdns: true,
                interfaces: Vec::new(),
                peers: Vec::new(),
            },
            security: Security {
                keys: String::new(),
                insecure: false,
                loopback: false,
                old_peers: Vec::new(),
                peer_connections: 64,
                peer_letters: 20_000,
                peer_bytes: 256 << 20,
            },
            access: Access::default(),
            monitor: Monitor {
                check: Check::Off,
                answer: false,
                protocols: Vec::new(),
            },
        }
    }

    /// Checks what [`Config::load`] has checked already, for a program that changed something
    /// since.
    ///
    /// # Errors
    /// With all mistakes, by key.
    pub fn check(&self) -> Result<(), ConfigError> {
        let found = check::findings(self);
        if found.is_empty() {
            return Ok(());
        }
        let mistakes = found.into_iter().map(|finding| finding.at(None));
        Err(ConfigError::Mistakes(mistakes.collect()))
    }
}
