//! The configuration: the values of one TOML file, `--set key=value` arguments and the defaults.
//!
//! * [`Sources`] are the places to search. [`Config::load`] reads and checks the configuration and
//!   returns the values. [`Effective`] also has the origin of every value, for `fipa config show`.
//! * [`ConfigError`] lists all mistakes at once, each with file, line, key and the allowed values. For
//!   an unknown key it suggests the nearest known one.
//!
//! Only the first of these files that exists is read: the one given with `--config`, the one named by
//! `$FIPA_CONFIG`, `./fipa.toml`, `~/.config/fipa/fipa.toml`, `/etc/fipa/fipa.toml`. A named file that does not exist
//! is an error, and so is an existing one that this user may not read. A directory that this user may not search counts
//! as empty, unless it is that of the host. A key that is not set has its default:
//!
//! ```toml
//! domain = "default"                  # processes of one domain on one host find each other
//! runtime_dir = ""                    # directory in which the processes meet; empty: /tmp/fipa-<user id>
//! group = ""                          # group whose members share the domain; empty: it belongs to one user
//! [mts]
//! name = "sherpa-mts"                 # default: <host name>-mts
//! transports = ["shm", "unix", "tcp"] # in order of preference; others are off
//! deadline = "5s"                     # per letter, unless the call sets another one
//! queue = 256                         # waiting letters per agent before senders have to wait
//! queue_bytes = "64MiB"               # the same in bytes; also per sender and receiver at gateways
//! raise_open_files = false            # true: raise the soft limit of open files to the hard one
//! [routes]                            # transports by receiver name or pattern; first match counts
//! "camera_.*" = ["shm"]               # (none by default)
//! [transport.shm]
//! capacity = "256MiB"                 # of this domain on this host
//! max_letter = "64MiB"
//! spin = "50us"                       # time of polling before blocking; 0 saves battery
//! [transport.tcp]
//! listen = ["127.0.0.1:0"]            # of the gateway; "*:7788": all addresses of this host; other than
//!                                     # loopback needs keys or insecure
//! processes = false                   # true: processes of one host use TCP among each other, too
//! [transport.udp]
//! listen = ["127.0.0.1:0"]            # as for tcp; letters that fit one datagram
//! [transport.quic]
//! listen = ["127.0.0.1:0"]            # as for tcp; always encrypted; needs security.keys
//! [transport.http]
//! listen = ["127.0.0.1:7778"]         # as for tcp; for JADE and other platforms; never encrypted
//! [transport.udt]
//! listen = ["127.0.0.1:0"]            # as for tcp; for legacy peers; with keys, only security.legacy_peers
//! [discovery]
//! mdns = true
//! interfaces = []                     # names or addresses; empty: all
//! static = { crex-mts = ["tcp://10.0.0.2:7788"] }   # (none by default)
//! [security]
//! keys = ""                           # directory of `fipa keys init`; empty: no encryption
//! insecure = false                    # true: listen on the network without keys
//! loopback = false                    # with keys: legacy peers on loopback prove their identity, too
//! legacy_peers = []                   # with keys: addresses of legacy peers, which have no keys
//! key_log = false                     # with SSLKEYLOGFILE: write the secrets of TLS there, for Wireshark
//! [http]
//! listen = ""                         # of the gateway, for Prometheus: "127.0.0.1:9790"; empty: off
//! names = []                          # further names under which clients reach that address
//! token_file = ""                     # file with the token of clients; empty: in the directory of the domain
//! control = false                     # true: clients send messages and cancel actions as dashboard@<mts.name>
//! [contacts]
//! networks = []                       # networks whose addresses in received identifiers are dialed
//! [access]
//! rate = 0                            # letters per second of one sender; 0: no limit
//! allow = { "rover_.*" = ["arm performative=request"] }   # all others are refused (none by default)
//! deny = { ".*" = ["brake"] }         # takes precedence over `allow` (none by default)
//! operators = []                      # agents that may cancel all goals of the robots of this process
//! recorders = []                      # agents that may record on this host and fetch its recordings
//! [monitor]
//! check = "off"                       # or "warn", "enforce": reaction to protocol violations
//! answer = false                      # true: violations are answered with not-understood
//! heartbeat = "5s"                    # silence after which agents of another host are unreachable
//! protocols = []                      # SCXML files with further protocols
//! idle = "24h"                        # a conversation without a message is kept for this time
//! conversations = 100000              # maximum number of conversations of an agent
//! bytes = "64MiB"                     # of them; a peer has at most an eighth
//! exempt = []                         # protocols without the rules about unknown conversations
//! [platform]
//! ams = true                          # false: no agent management system; or its name
//! df = true                           # false: no directory facilitator; or its name
//! [record]
//! directory = ""                      # of the recordings that access.recorders order; empty: none
//! bytes = "1GiB"                      # of all of them; the oldest is deleted
//! ```
//!
//! Not in this module: opening anything that the configuration names. A transport that this process
//! was built without (`tcp` without the feature `net`) is not a mistake, because one file serves all
//! processes of a robot.

mod changes;
mod check;
mod effective;
mod error;
mod keys;
mod machine;
mod reader;
mod sources;
#[cfg(test)]
mod tests;

use std::fmt;
use std::net::IpAddr;
use std::time::Duration;

use fipa_mts::dial::Network;
use fipa_transport::{Kind, Location};

pub use changes::Reloaded;
pub(crate) use changes::is_of_gateway;
#[cfg(feature = "net")]
pub(crate) use check::is_on_loopback;
pub use effective::{Effective, Setting};
pub use error::{ConfigError, Mistake, Origin};
pub use keys::Value;
pub use sources::Sources;

use crate::access::rules;
pub use crate::access::rules::RuleError;

/// A complete and checked configuration.
///
/// A program that changes a value after loading must call [`Config::check`] before it uses the
/// configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Config {
    /// `domain`: the domain. Processes of one domain on one host find each other. Part of paths and of
    /// the names of shared memory: 1 to 32 of `A-Z a-z 0-9 _ -`.
    pub domain: String,
    /// `runtime_dir`: the directory with a directory for each domain, in which its processes meet;
    /// `/tmp/fipa-<user id>` if it is empty. `$FIPA_RUNTIME_DIR` precedes it.
    pub runtime_dir: String,
    /// `group`: the group of this host whose members share the domain, by its name in `/etc/group` or by its number.
    /// If it is empty, the domain belongs to one user. Needs a directory that the members can enter (`runtime_dir`).
    pub group: String,
    /// `[mts]`: the message transport service of this process.
    pub mts: MtsConfig,
    /// `[routes]`: the orders of transports for particular receivers. The first match counts; entries
    /// of `--set` precede those of the file.
    pub routes: Vec<RouteConfig>,
    /// `[transport.*]`: the settings of the transports.
    pub transport: Transports,
    /// `[discovery]`: the discovery of other hosts.
    pub discovery: Discovery,
    /// `[security]`: the keys, and the limits for peers on other hosts.
    pub security: Security,
    /// `[http]`: the address at which the gateway answers Prometheus.
    pub http: Http,
    /// `[contacts]`: the addresses in agent identifiers that the gateway dials.
    pub contacts: Contacts,
    /// `[access]`: the rules for senders and receivers of letters.
    pub access: Access,
    /// `[monitor]`: the checks of messages against their protocols.
    pub monitor: Monitor,
    /// `[platform]`: the agents of the gateway that list agents and services (FIPA00023).
    pub platform: Platform,
    /// `[record]`: the recordings that agents of other hosts order from the gateway.
    pub record: Record,
}

/// `[mts]`: the message transport service of a process.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct MtsConfig {
    /// `name`: the name of the gateway, 1 to 255 bytes without control characters.
    pub name: String,
    /// `transports`: the transports in order of preference, none twice; others are off.
    pub transports: Vec<Kind>,
    /// `deadline`: the deadline of letters that are sent without one; more than 0, at most 1 hour.
    pub deadline: Duration,
    /// `queue`: maximum number of letters that wait in the queue of one agent, 1 to 65,536. Beyond it
    /// their senders wait.
    pub queue: usize,
    /// `queue_bytes`: maximum number of bytes of letters that wait in the queue of one agent, and of
    /// letters from one sender to one receiver that wait in a process or gateway, 64 KiB to 1 TiB.
    /// Beyond it their senders wait. An empty queue accepts a letter of any size.
    pub queue_bytes: u64,
    /// `raise_open_files`: whether a process that joins a domain raises its soft limit of open files to the hard one;
    /// see [`open_files`](crate::admin::open_files). Programs that use `select` do not work with more than 1,024 open files.
    pub raise_open_files: bool,
}

/// One line of `[routes]`.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct RouteConfig {
    /// The name of a receiver, or a [`fipa_sds::Pattern`] that is matched against the whole name.
    pub receiver: String,
    /// The order of transports for these receivers. Transports that are not in [`MtsConfig::transports`] are
    /// ignored; at least one must be in it.
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
    /// `[transport.http]`: letters of platforms such as JADE, and to them. With
    /// [`Security::keys`], only of [`Security::legacy_peers`].
    pub http: Listen,
    /// `[transport.https]`: the same over TLS; needs [`Security::keys`].
    pub https: Https,
    /// `[transport.udt]`; for legacy peers only. With [`Security::keys`], letters are exchanged only
    /// with the addresses in [`Security::legacy_peers`].
    pub udt: Listen,
}

/// `[transport.https]`: letters of platforms such as JADE, and to them, over TLS.
///
/// A platform proves its identity with a certificate that `fipa keys trust` trusts, or, when the gateway
/// sends to it, with a certificate for the host name in its address from one of the authorities. Letters of a
/// platform without a trusted certificate are accepted only from [`Security::legacy_peers`].
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Https {
    /// `listen`: the addresses on which the gateway listens; see [`Listen::listen`].
    pub listen: Vec<String>,
    /// `authorities`: the file with the certificates of the authorities, as PEM; empty for none.
    pub authorities: String,
}

/// `[transport.shm]`: shared memory.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Shm {
    /// `capacity`: maximum number of bytes of shared memory of this domain on this host, 1 MiB to
    /// 1 TiB.
    pub capacity: u64,
    /// `max_letter`: maximum size of a letter in bytes, 4 KiB to the capacity.
    pub max_letter: u64,
    /// `spin`: time that a receiver polls before it blocks, at most 1 s. Zero turns polling off.
    pub spin: Duration,
}

/// `[transport.tcp]`: letters over TCP.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Tcp {
    /// `listen`: the addresses on which the gateway listens; see [`Listen::listen`].
    pub listen: Vec<String>,
    /// `processes`: whether processes other than the gateway use TCP among each other, too. They
    /// listen on a port of 127.0.0.1 that the system chooses, to which every user of the host can
    /// connect.
    pub processes: bool,
}

/// `[transport.udp]`, `[transport.quic]`, `[transport.udt]` and `[transport.http]`: a network transport of
/// the gateway.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Listen {
    /// `listen`: numeric addresses with port, for example `127.0.0.1:0`, `[::1]:7788` or
    /// `[fe80::1%eth0]:7788`. `*:7788` means all addresses of this host, of both families. Port 0 lets the system choose. If the list is empty, the gateway does
    /// not listen, and peers send over the connections that the gateway has opened.
    ///
    /// The addresses are text, because an interface that does not exist yet has no numeric scope.
    pub listen: Vec<String>,
}

/// `[discovery]`: the discovery of other hosts.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Discovery {
    /// `mdns`: whether the gateway announces and discovers agents by multicast DNS.
    pub mdns: bool,
    /// `interfaces`: the network interfaces for multicast DNS; empty: all.
    pub interfaces: Vec<Interface>,
    /// `static`: gateways, and agents of legacy peers, that are known without discovery.
    pub peers: Vec<PeerConfig>,
}

/// One line of `discovery.static`: a peer that is known without discovery. It is a gateway, or an
/// agent of a legacy peer if its locations state the dialect of a legacy peer.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct PeerConfig {
    /// The name of the gateway, or of the agent.
    pub name: String,
    /// The locations at which it listens, in order of preference; at least one.
    pub locations: Vec<Location>,
}

/// `[security]`: the keys, and the limits for peers on other hosts. Without keys the gateway accepts
/// every peer that can connect. It then listens only on loopback addresses, unless `insecure` is true.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Security {
    /// `keys`: the directory with the keys of this host and the certificates that it trusts; empty:
    /// no keys.
    pub keys: String,
    /// `insecure`: whether the gateway may listen on the network without keys.
    pub insecure: bool,
    /// `loopback`: whether legacy peers on loopback addresses must prove their identity, too. Others always must,
    /// except over the ports of `transport.tcp.processes`.
    pub loopback: bool,
    /// `legacy_peers`: addresses of legacy peers, which cannot prove their identity. The gateway exchanges
    /// letters in their dialects with them despite its keys. At most 64.
    pub legacy_peers: Vec<IpAddr>,
    /// `key_log`: whether the gateway writes the secrets of its TLS connections to the file that the environment
    /// variable `SSLKEYLOGFILE` names. A reader of the file can decrypt captured letters.
    pub key_log: bool,
    /// `peer_connections`: maximum number of connections of each transport from the peers with one
    /// certificate, or from one address if the peer has no keys. This and the next two limits apply
    /// to other hosts, and to loopback addresses if those must prove their identity.
    pub peer_connections: usize,
    /// `peer_letters`: maximum number of letters per second that each transport accepts from one
    /// address; also the maximum burst. Further letters wait at the sender. 0: no limit.
    pub peer_letters: usize,
    /// `peer_bytes`: maximum number of bytes per second that each transport accepts from one address;
    /// also the maximum burst. 0: no limit.
    pub peer_bytes: u64,
}

/// `[http]`: the address at which the gateway answers Prometheus and health checks.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Http {
    /// `listen`: the address, for example `127.0.0.1:9790`. Beyond loopback, the gateway encrypts with its key
    /// (`security.keys`). Empty: the gateway does not listen.
    pub listen: String,
    /// `names`: host names, beside addresses and `localhost`, under which clients reach the address, for example behind
    /// a proxy. At most 16.
    pub names: Vec<String>,
    /// `token_file`: the file with the token that clients send. The gateway creates it if it is missing. Empty: the file
    /// `http.token` in the directory of the domain, which ends with the domain.
    pub token_file: String,
    /// `control`: whether clients send messages and cancel actions, too, as the agent `dashboard@<mts.name>`. Otherwise they
    /// only see.
    pub control: bool,
}

/// `[contacts]`: the addresses in agent identifiers that the gateway dials for an agent that no directory lists.
///
/// It dials an address that the operator or a program of its host gave, and one on the host from which the identifier
/// came or that took a letter within a day. Of the latter, loopback, link-local and multicast addresses, those of
/// the gateway itself, and ports below 1024 except 80 and 443 are left out.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Contacts {
    /// `networks`: networks whose addresses in received identifiers are dialed, for example `10.0.0.0/8`. At most 64.
    pub networks: Vec<Network>,
}

/// `[access]`: the rules for senders and receivers of letters. The gateway applies them to the letters
/// that it accepts, and every process to the letters for its own agents. `deny` takes precedence over
/// `allow`. If there are `allow` rules, letters that match none of them are refused.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Access {
    /// `rate`: maximum number of letters per second of one sender, at most 1,000,000; also the maximum
    /// burst. 0: no limit.
    pub rate: usize,
    /// `allow`: the allowed letters, by sender. At most 256 lines.
    pub allow: Vec<AccessRule>,
    /// `deny`: the refused letters, by sender. At most 256 lines.
    pub deny: Vec<AccessRule>,
    /// `operators`: names or patterns of the agents that may cancel the goals of other clients, and read their
    /// results, where this process offers actions (feature `actions`). At most 256.
    pub operators: Vec<String>,
    /// `recorders`: names or patterns of the agents that may record the letters of this host and fetch the recordings,
    /// where the gateway records ([`Record`]). At most 256.
    pub recorders: Vec<String>,
}

/// One line of `access.allow` or `access.deny`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AccessRule {
    /// The name of the sender, or a pattern that is matched against the whole name.
    pub sender: String,
    /// The receivers. Each is a name or pattern, optionally followed by `performative=NAME,…` and
    /// `protocol=NAME,…`, which restrict the rule to these.
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
    pub(crate) fn rules(&self) -> Result<Option<rules::Access>, RuleError> {
        let deny = self.deny.iter().map(AccessRule::parts);
        let allow = self.allow.iter().map(AccessRule::parts);
        rules::Access::new(deny, allow, &self.operators, &self.recorders, self.rate)
    }
}

/// `[monitor]`: the checks of messages against their protocols. They need the feature `protocols`.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Monitor {
    /// `check`: the reaction to messages that violate their protocol.
    pub check: Check,
    /// `answer`: whether a received message that violates its protocol is answered with
    /// `not-understood`.
    pub answer: bool,
    /// `heartbeat`: the silence of another host after which a call that waits for an agent there reports
    /// it as unreachable, 100 milliseconds to 1 hour. The gateways exchange signs of life five times in
    /// this period, only while a call waits.
    pub heartbeat: Duration,
    /// `protocols`: paths of SCXML files with further protocols, or with replacements for protocols of
    /// FIPA; at most 128.
    pub protocols: Vec<String>,
    /// `idle`: the time for which the conversation of an agent is kept without a message.
    pub idle: Duration,
    /// `conversations`: the maximum number of conversations of an agent.
    pub conversations: usize,
    /// `bytes`: the maximum size of the conversations of an agent. Those of one peer have at most an
    /// eighth of it.
    pub bytes: u64,
    /// `exempt`: names of protocols to which the rules about messages of unknown conversations do not
    /// apply; at most 128. Without it, a message with a known protocol needs a `conversation-id`, the
    /// name of a protocol may not differ from a known one by a typing error, and a message may not
    /// continue a conversation that did not begin. Letters of legacy peers that break these rules are
    /// only logged.
    pub exempt: Vec<String>,
}

/// The reaction to messages that violate their protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Check {
    /// Messages are not checked.
    Off,
    /// Violations are logged, and received messages carry them (`Incoming::violation`).
    Warn,
    /// A message with a violation is not sent. Received messages carry their violations, as for
    /// [`Warn`](Self::Warn), and the application must not act on them.
    Enforce,
}

impl Check {
    pub(crate) const ALL: [Self; 3] = [Self::Off, Self::Warn, Self::Enforce];

    /// Returns the value as written in the file.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Warn => "warn",
            Self::Enforce => "enforce",
        }
    }
}

/// `[platform]`: the agents of the gateway that list agents and services (FIPA00023).
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Platform {
    /// `ams`: the agent management system, `ams@` and the name of the gateway by default.
    pub ams: PlatformAgent,
    /// `df`: the directory facilitator, `df@` and the name of the gateway by default.
    pub df: PlatformAgent,
}

/// `[record]`: the recordings that agents, also those of other hosts, order from the gateway (`fipa record fleet`).
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Record {
    /// `directory`: the directory of the recordings. Empty: no agent records on this host.
    pub directory: String,
    /// `bytes`: the maximum size of all recordings in the directory, 1 MiB to 1 TiB. Beyond it the oldest is deleted.
    pub bytes: u64,
}

/// An agent of the gateway: `true`, `false` or a name.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum PlatformAgent {
    /// The agent does not run.
    Off,
    /// The agent runs under its default name.
    #[default]
    On,
    /// The agent runs under this name.
    Named(String),
}

/// A network interface, as the configuration names it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Interface {
    /// The name of the interface, for example `wlan0`.
    Name(String),
    /// An address of the interface.
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

/// The defaults for this host. No file is read.
impl Default for Config {
    fn default() -> Self {
        Self::for_host(&gethostname::gethostname().to_string_lossy())
    }
}

impl Config {
    /// Finds, reads and checks the configuration.
    ///
    /// # Errors
    /// If a file cannot be read, or if the configuration has mistakes; the error lists all of them.
    pub fn load(sources: &Sources) -> Result<Self, ConfigError> {
        Effective::load(sources).map(Effective::into_config)
    }

    /// Returns the defaults for a host with this name.
    #[must_use]
    pub fn for_host(host_name: &str) -> Self {
        let loopback = Listen {
            listen: vec!["127.0.0.1:0".to_owned()],
        };
        Self {
            domain: "default".to_owned(),
            runtime_dir: String::new(),
            group: String::new(),
            mts: MtsConfig {
                name: keys::default_mts_name(host_name),
                transports: vec![Kind::Shm, Kind::Unix, Kind::Tcp],
                deadline: Duration::from_secs(5),
                queue: 256,
                queue_bytes: 64 << 20,
                raise_open_files: false,
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
                quic: loopback.clone(),
                udt: loopback.clone(),
                http: Listen {
                    listen: vec!["127.0.0.1:7778".to_owned()],
                },
                https: Https {
                    listen: loopback.listen.clone(),
                    authorities: String::new(),
                },
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
                legacy_peers: Vec::new(),
                key_log: false,
                peer_connections: 64,
                peer_letters: 20_000,
                peer_bytes: 256 << 20,
            },
            http: Http::default(),
            contacts: Contacts::default(),
            access: Access::default(),
            monitor: Monitor {
                check: Check::Off,
                answer: false,
                heartbeat: Duration::from_secs(5),
                protocols: Vec::new(),
                idle: Duration::from_secs(24 * 60 * 60),
                conversations: 100_000,
                bytes: 64 << 20,
                exempt: Vec::new(),
            },
            platform: Platform::default(),
            record: Record {
                directory: String::new(),
                bytes: 1 << 30,
            },
        }
    }

    /// Checks the configuration again, for a program that has changed it since [`Config::load`].
    ///
    /// # Errors
    /// If the configuration has mistakes; the error lists all of them.
    pub fn check(&self) -> Result<(), ConfigError> {
        let found = check::findings(self);
        if found.is_empty() {
            return Ok(());
        }
        let mistakes = found.into_iter().map(|finding| finding.at(None));
        Err(ConfigError::Mistakes(mistakes.collect()))
    }
}
