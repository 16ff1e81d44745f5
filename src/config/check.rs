//! Checks of values, alone and in combination.

use std::collections::HashSet;
use std::fmt::Display;
use std::hash::Hash;
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::time::Duration;

use fipa_sds::{Pattern, check_name, reserved_for};
use fipa_transport::wire::MAX_REMAINING;
use fipa_transport::{Kind, Location};

use super::keys::dotted;
use super::keys::{is_interface_name, is_numeric_address};
use super::{
    Access, Config, Http, Interface, Mistake, Origin, PeerConfig, Platform, PlatformAgent,
    RouteConfig, Shm,
};

/// Maximum length of the name of a domain, in bytes.
const MAX_DOMAIN: usize = 32;
/// Maximum length of the name of a message transport service, in bytes.
const MAX_MTS_NAME: usize = 255;
/// Upper bound of `mts.deadline`.
const MAX_DEADLINE: Duration = MAX_REMAINING;
/// Upper bound of `mts.queue`, in letters.
const MAX_QUEUE: usize = 65_536;
/// Bounds of `monitor.conversations`.
const MONITORED: RangeInclusive<usize> = 8..=10_000_000;
/// Bounds of `mts.queue_bytes` and of `monitor.bytes`.
const QUEUE_BYTES: RangeInclusive<u64> = 64 << 10..=1 << 40;
/// Maximum number of lines of each of `[routes]`, `access.allow`, `access.deny`, `access.operators` and
/// `access.recorders`.
const MAX_ROUTES: usize = 256;
/// Bounds of `record.bytes`.
const RECORDED: RangeInclusive<u64> = 1 << 20..=1 << 40;
/// Upper bound of `access.rate`, in letters per second.
const MAX_RATE: usize = 1_000_000;
/// Bounds of `transport.shm.capacity`, in bytes.
const CAPACITY: RangeInclusive<u64> = 1 << 20..=1 << 40;
/// Lower bound of `transport.shm.max_letter`, in bytes.
const MIN_LETTER: u64 = 4 << 10;
/// Upper bound of `transport.shm.spin`.
const MAX_SPIN: Duration = Duration::from_secs(1);
/// Maximum number of addresses that a transport listens on, and of locations of a static peer.
const MAX_ADDRESSES: usize = 16;
/// Maximum number of entries of `discovery.interfaces`.
const MAX_INTERFACES: usize = 64;
/// Maximum number of static peers.
const MAX_PEERS: usize = 1024;

/// Maximum number of addresses in `security.legacy_peers`.
const MAX_LEGACY_PEERS: usize = 64;

/// Maximum number of names in `http.names`.
const MAX_HTTP_NAMES: usize = 16;

/// Maximum number of networks in `contacts.networks`.
const MAX_NETWORKS: usize = 64;

/// Lower bound of `security.peer_bytes`, in bytes per second: idle connections need some to stay open.
const MIN_PEER_BYTES: u64 = 64 << 10;

/// Lower bound of `monitor.heartbeat`: a fifth of it is the time between two letters.
const MIN_HEARTBEAT: Duration = Duration::from_millis(100);

/// Upper bound of `monitor.heartbeat`.
const MAX_HEARTBEAT: Duration = Duration::from_secs(3600);

/// Maximum number of entries of `monitor.protocols` and of `monitor.exempt`.
const MAX_PROTOCOLS: usize = 128;

/// A value that is not allowed.
#[derive(Debug)]
pub(super) struct Finding {
    /// The path of the key.
    pub(super) path: Vec<String>,
    /// Whether the values of other keys are part of the condition.
    pub(super) on_several_values: bool,
    what: String,
    help: String,
}

impl Finding {
    /// A finding about one key. `what` continues a sentence that begins with the key.
    pub(super) fn new(path: &[&str], what: impl Display, help: impl Into<String>) -> Self {
        Self {
            path: path.iter().map(|&part| part.to_owned()).collect(),
            on_several_values: false,
            what: format!("`{}` {what}", dotted(path)),
            help: help.into(),
        }
    }

    pub(super) fn at(self, place: Option<Origin>) -> Mistake {
        Mistake {
            place,
            what: self.what,
            help: self.help,
        }
    }
}

/// Returns the values that are not allowed in a configuration whose values have the right types.
pub(super) fn findings(config: &Config) -> Vec<Finding> {
    let mut found = Findings(Vec::new());
    found.domain(&config.domain);
    found.runtime_dir(&config.runtime_dir);
    found.mts(config);
    found.routes(config);
    found.shm(&config.transport.shm);
    found.listen(
        &["transport", "tcp", "listen"],
        &config.transport.tcp.listen,
    );
    found.listen(
        &["transport", "udp", "listen"],
        &config.transport.udp.listen,
    );
    found.listen(
        &["transport", "quic", "listen"],
        &config.transport.quic.listen,
    );
    found.listen(
        &["transport", "http", "listen"],
        &config.transport.http.listen,
    );
    found.listen(
        &["transport", "https", "listen"],
        &config.transport.https.listen,
    );
    found.listen(
        &["transport", "udt", "listen"],
        &config.transport.udt.listen,
    );
    found.interfaces(&config.discovery.interfaces);
    found.peers(&config.discovery.peers);
    found.security(config);
    found.http(&config.http, !config.security.keys.is_empty());
    if config.contacts.networks.len() > MAX_NETWORKS {
        let path = ["contacts", "networks"];
        found.too_many(&path, config.contacts.networks.len(), MAX_NETWORKS);
    }
    found.access(&config.access);
    found.heartbeat(config.monitor.heartbeat);
    found.protocols(&config.monitor.protocols);
    found.platform(&config.platform, &config.mts.name);
    found.monitor(&config.monitor);
    found.record(&config.record);
    found.0
}

struct Findings(Vec<Finding>);

impl Findings {
    /// Adds a finding. `what` continues a sentence that begins with the key.
    fn add(&mut self, path: &[&str], what: impl Display, help: impl Into<String>) {
        self.0.push(Finding::new(path, what, help));
    }

    /// Adds a finding about a combination of values.
    fn combined(&mut self, path: &[&str], what: impl Display, help: impl Into<String>) {
        self.0.push(Finding {
            on_several_values: true,
            ..Finding::new(path, what, help)
        });
    }

    fn domain(&mut self, domain: &str) {
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
        let fits = (1..=MAX_DOMAIN).contains(&domain.len());
        if !fits || !domain.chars().all(allowed) {
            self.add(
                &["domain"],
                format_args!("cannot be {domain:?}"),
                format!(
                    "it becomes part of file names: use 1 to {} of A-Z a-z 0-9 _ -",
                    MAX_DOMAIN
                ),
            );
        }
    }

    fn runtime_dir(&mut self, directory: &str) {
        if !directory.is_empty() && !directory.starts_with('/') {
            self.add(
                &["runtime_dir"],
                format_args!("cannot be {directory:?}, which differs between working directories"),
                "write the full path, for example /run/fipa",
            );
        }
    }

    fn http(&mut self, http: &Http, has_keys: bool) {
        if !http.listen.is_empty() && http.listen.parse::<SocketAddr>().is_err() {
            self.add(
                &["http", "listen"],
                format_args!("is {:?}, which is no address with a port", http.listen),
                "write for example 127.0.0.1:9790, or 0.0.0.0:9790 for other hosts",
            );
        } else if !http.listen.is_empty() && !has_keys && !is_on_loopback(&http.listen) {
            self.add(
                &["http", "listen"],
                format_args!(
                    "is {:?}, which other hosts reach, but there is no key to encrypt with",
                    http.listen
                ),
                "set security.keys, or use 127.0.0.1 or [::1], for example 127.0.0.1:9790",
            );
        }
        if http.token_file.starts_with('~') {
            self.add(
                &["http", "token_file"],
                "begins with ~, which only shells expand",
                "write the full path, for example /etc/fipa/http.token",
            );
        }
        if http.names.len() > MAX_HTTP_NAMES {
            self.too_many(&["http", "names"], http.names.len(), MAX_HTTP_NAMES);
        }
    }

    fn security(&mut self, config: &Config) {
        let security = &config.security;
        let has_keys = !security.keys.is_empty();
        if security.keys == "~" || security.keys.starts_with("~/") {
            self.add(
                &["security", "keys"],
                "begins with ~, which only shells expand",
                "write the full path, for example /home/robot/.config/fipa/keys",
            );
        }
        if security.legacy_peers.len() > MAX_LEGACY_PEERS {
            let path = ["security", "legacy_peers"];
            self.too_many(&path, security.legacy_peers.len(), MAX_LEGACY_PEERS);
        }
        if security.peer_connections == 0 {
            self.add(
                &["security", "peer_connections"],
                "cannot be 0, which would refuse every connection",
                "use 1 or more",
            );
        }
        if (1..MIN_PEER_BYTES).contains(&security.peer_bytes) {
            self.add(
                &["security", "peer_bytes"],
                format_args!("cannot be {} bytes", security.peer_bytes),
                "use at least 64KiB per second, or 0 for no limit",
            );
        }
        if has_keys && security.insecure {
            self.combined(
                &["security", "insecure"],
                "is true, but security.keys is set, and with keys every connection is encrypted",
                "remove one of the two",
            );
        }
        if security.loopback && config.transport.tcp.processes {
            self.combined(
                &["transport", "tcp", "processes"],
                "is true, but security.loopback is true, too, and the ports of processes take letters from \
                 loopback without keys",
                "remove one of the two",
            );
        }
        if has_keys && config.mts.transports.contains(&Kind::Udp) {
            self.combined(
                &["mts", "transports"],
                "lists udp, which is not encrypted, but security.keys is set",
                "remove udp; tcp and quic are encrypted if security.keys is set",
            );
        }
        if !has_keys && security.key_log {
            self.combined(
                &["security", "key_log"],
                "is true, but without keys no connection is encrypted",
                "make keys (`fipa keys init`) and set security.keys, or remove key_log",
            );
        }
        if !has_keys && config.mts.transports.contains(&Kind::Quic) {
            self.combined(
                &["mts", "transports"],
                "lists quic, which needs keys",
                "make keys (`fipa keys init`) and set security.keys, or remove quic",
            );
        }
        if !has_keys && config.mts.transports.contains(&Kind::Https) {
            self.combined(
                &["mts", "transports"],
                "lists https, which needs keys",
                "make keys (`fipa keys init`) and set security.keys, or remove https",
            );
        }
        if has_keys || security.insecure {
            return;
        }
        for (kind, listen) in [
            (Kind::Tcp, &config.transport.tcp.listen),
            (Kind::Udp, &config.transport.udp.listen),
            (Kind::Http, &config.transport.http.listen),
            (Kind::Udt, &config.transport.udt.listen),
        ] {
            // `listen` reports entries that are not addresses.
            let mut addresses = listen.iter().filter(|text| is_numeric_address(text));
            let open = addresses.find(|text| !is_on_loopback(text));
            if let Some(open) = open.filter(|_| config.mts.transports.contains(&kind)) {
                self.combined(
                    &["transport", kind.name(), "listen"],
                    format_args!("lists {open}, where the gateway would accept every host"),
                    "make keys (`fipa keys init`) and set security.keys, or accept the risk with \
                     `security.insecure = true`",
                );
            }
        }
    }

    fn access(&mut self, access: &Access) {
        if access.rate > MAX_RATE {
            let what = format_args!("cannot be {}", access.rate);
            let help = format!("use 0 to {MAX_RATE} letters per second");
            self.add(&["access", "rate"], what, help);
        }
        for (name, agents) in [
            ("operators", &access.operators),
            ("recorders", &access.recorders),
        ] {
            let path = ["access", name];
            if agents.len() > MAX_ROUTES {
                self.too_many(&path, agents.len(), MAX_ROUTES);
                continue;
            }
            let mut agents = agents.iter();
            if let Some(fault) = agents.find_map(|it| crate::access::rules::fault_of_agents(it)) {
                let help = "list names or patterns of agents such as \"boss\"";
                self.add(&path, fault, help);
            }
        }
        for (name, lines) in [("allow", &access.allow), ("deny", &access.deny)] {
            if lines.len() > MAX_ROUTES {
                self.too_many(&["access", name], lines.len(), MAX_ROUTES);
                continue;
            }
            for line in lines {
                if let Some(fault) = crate::access::rules::fault(line.parts()) {
                    self.add(
                        &["access", name, &line.sender],
                        fault,
                        "write receivers such as \"arm_.* performative=request protocol=fipa-request\"",
                    );
                }
            }
        }
    }

    fn protocols(&mut self, files: &[String]) {
        let path = ["monitor", "protocols"];
        if files.len() > MAX_PROTOCOLS {
            self.add(
                &path,
                format_args!("lists {} files", files.len()),
                format!("use at most {MAX_PROTOCOLS}"),
            );
        }
        if files.iter().any(String::is_empty) {
            self.add(&path, "lists an empty path", "list paths of SCXML files");
        }
    }

    fn platform(&mut self, platform: &Platform, gateway: &str) {
        for (key, agent) in [("ams", &platform.ams), ("df", &platform.df)] {
            let PlatformAgent::Named(name) = agent else {
                continue;
            };
            if check_name(name).is_err() {
                self.add(
                    &["platform", key],
                    format_args!("cannot be {name:?}, which is no name of an agent"),
                    "use true, false, or a name without any of * + ? [ ( { | ^ $ \\",
                );
            } else if reserved_for(name).is_some_and(|other| other != gateway) {
                self.add(
                    &["platform", key],
                    format_args!("cannot be {name:?}, which is reserved for another gateway"),
                    "use true, or a name that does not begin with ams@ or df@",
                );
            }
        }
        if let (PlatformAgent::Named(ams), PlatformAgent::Named(df)) = (&platform.ams, &platform.df)
            && ams == df
        {
            let what = format_args!("is {df:?}, which is the name of platform.ams, too");
            self.add(&["platform", "df"], what, "use another name");
        }
    }

    fn heartbeat(&mut self, heartbeat: Duration) {
        if !(MIN_HEARTBEAT..=MAX_HEARTBEAT).contains(&heartbeat) {
            let show = humantime::format_duration;
            self.add(
                &["monitor", "heartbeat"],
                format_args!("cannot be {}", show(heartbeat)),
                format!("use {} to {}", show(MIN_HEARTBEAT), show(MAX_HEARTBEAT)),
            );
        }
    }

    fn mts(&mut self, config: &Config) {
        let mts = &config.mts;
        self.name(&["mts", "name"], &mts.name);
        self.kinds(&["mts", "transports"], &mts.transports);
        if mts.deadline.is_zero() || mts.deadline > MAX_DEADLINE {
            self.add(
                &["mts", "deadline"],
                format_args!("cannot be {}", humantime::format_duration(mts.deadline)),
                format!(
                    "use more than 0, at most {}",
                    humantime::format_duration(MAX_DEADLINE)
                ),
            );
        }
        if !(1..=MAX_QUEUE).contains(&mts.queue) {
            self.add(
                &["mts", "queue"],
                format_args!("cannot be {}", mts.queue),
                format!("use 1 to {} letters", MAX_QUEUE),
            );
        }
        if !QUEUE_BYTES.contains(&mts.queue_bytes) {
            self.add(
                &["mts", "queue_bytes"],
                format_args!("cannot be {} bytes", mts.queue_bytes),
                "use 64KiB to 1TiB",
            );
        }
    }

    fn record(&mut self, record: &super::Record) {
        if record.directory.starts_with('~') {
            self.add(
                &["record", "directory"],
                "begins with ~, which only shells expand",
                "write the full path, for example /var/lib/fipa/recordings",
            );
        }
        if !RECORDED.contains(&record.bytes) {
            self.add(
                &["record", "bytes"],
                format_args!("cannot be {} bytes", record.bytes),
                "use 1MiB to 1TiB",
            );
        }
    }

    fn monitor(&mut self, monitor: &super::Monitor) {
        if !MONITORED.contains(&monitor.conversations) {
            self.add(
                &["monitor", "conversations"],
                format_args!("cannot be {}", monitor.conversations),
                "use 8 to 10000000 conversations",
            );
        }
        if !QUEUE_BYTES.contains(&monitor.bytes) {
            self.add(
                &["monitor", "bytes"],
                format_args!("cannot be {} bytes", monitor.bytes),
                "use 64KiB to 1TiB",
            );
        }
        if monitor.idle.is_zero() {
            let what = format_args!("cannot be 0");
            self.add(&["monitor", "idle"], what, "use a duration such as 24h");
        }
        let path = ["monitor", "exempt"];
        if monitor.exempt.len() > MAX_PROTOCOLS {
            let what = format_args!("lists {} protocols", monitor.exempt.len());
            self.add(&path, what, format!("use at most {MAX_PROTOCOLS}"));
        }
        if monitor.exempt.iter().any(String::is_empty) {
            self.add(&path, "lists an empty name", "list names of protocols");
        }
    }

    fn name(&mut self, path: &[&str], name: &str) {
        let help = format!(
            "use 1 to {} bytes of UTF-8 without control, format or invisible characters, without \
             blanks at the ends, and none of * + ? [ ( {{ | ^ $ \\",
            MAX_MTS_NAME
        );
        if name.len() > MAX_MTS_NAME {
            let what = format_args!("is a name of {} bytes", name.len());
            self.add(path, what, help);
        } else if check_name(name).is_err() {
            self.add(path, format_args!("cannot be the name {name:?}"), help);
        }
    }

    /// Checks a list of transports. Returns whether it is valid.
    fn kinds(&mut self, path: &[&str], kinds: &[Kind]) -> bool {
        let before = self.0.len();
        if kinds.is_empty() {
            let names = Kind::ALL.map(Kind::name);
            let help = format!("list at least one of {}", names.join(", "));
            self.add(path, "is empty", help);
        }
        if let Some(kind) = repeated(kinds) {
            self.add(
                path,
                format_args!("lists {kind} twice"),
                "list each transport once",
            );
        }
        self.0.len() == before
    }

    fn routes(&mut self, config: &Config) {
        let on = &config.mts.transports;
        if config.routes.len() > MAX_ROUTES {
            // Checking a line compiles a pattern, so the lines beyond the maximum are not checked.
            self.too_many(&["routes"], config.routes.len(), MAX_ROUTES);
            return;
        }
        for RouteConfig {
            receiver,
            transports,
        } in &config.routes
        {
            let path = ["routes", receiver.as_str()];
            if receiver.is_empty() {
                self.add(
                    &path,
                    "has no receiver",
                    "write the name of an agent, or a pattern",
                );
            } else if let Err(error) = Pattern::new(receiver) {
                self.add(
                    &path,
                    format_args!("is not a valid pattern: {}", one_line(&error.to_string())),
                    "write the name of an agent, or a regular expression that matches whole names",
                );
            }
            if self.kinds(&path, transports) && !transports.iter().any(|kind| on.contains(kind)) {
                self.combined(
                    &path,
                    "lists only transports that are off",
                    "list one that is in `mts.transports`, or add one of these to `mts.transports`",
                );
            }
        }
    }

    fn shm(&mut self, shm: &Shm) {
        if !CAPACITY.contains(&shm.capacity) {
            self.add(
                &["transport", "shm", "capacity"],
                format_args!("cannot be {} bytes", shm.capacity),
                "use 1MiB to 1TiB, and at most the size of /dev/shm",
            );
        } else if shm.max_letter > shm.capacity {
            self.combined(
                &["transport", "shm", "max_letter"],
                format_args!(
                    "is {} bytes, more than the {} of `transport.shm.capacity`",
                    shm.max_letter, shm.capacity
                ),
                "lower it, or raise the capacity",
            );
        }
        if shm.max_letter < MIN_LETTER {
            self.add(
                &["transport", "shm", "max_letter"],
                format_args!("cannot be {} bytes", shm.max_letter),
                "use at least 4KiB: an envelope and a message must fit",
            );
        }
        if shm.spin > MAX_SPIN {
            self.add(
                &["transport", "shm", "spin"],
                format_args!("cannot be {}", humantime::format_duration(shm.spin)),
                "use 0 to 1s: spinning keeps a core busy",
            );
        }
    }

    fn listen(&mut self, path: &[&str], addresses: &[String]) {
        if addresses.len() > MAX_ADDRESSES {
            self.too_many(path, addresses.len(), MAX_ADDRESSES);
        }
        if let Some(wrong) = addresses.iter().find(|text| !is_numeric_address(text)) {
            self.add(
                path,
                format_args!("lists {wrong:?}, not a numeric address with port"),
                "write for example 127.0.0.1:0 or [fe80::1%eth0]:7788, or *:7788 for all addresses of this host",
            );
        }
        if let Some(address) = repeated(addresses.iter().filter(|text| !text.ends_with(":0"))) {
            self.add(
                path,
                format_args!("lists {address} twice"),
                "list each address once",
            );
        }
    }

    fn interfaces(&mut self, interfaces: &[Interface]) {
        let path = ["discovery", "interfaces"];
        if interfaces.len() > MAX_INTERFACES {
            self.too_many(&path, interfaces.len(), MAX_INTERFACES);
        }
        for interface in interfaces {
            if let Interface::Name(name) = interface
                && !is_interface_name(name)
            {
                self.add(
                    &path,
                    format_args!("lists {name:?}, which is not a possible name of an interface"),
                    "`ip link` lists the names",
                );
            }
        }
        if let Some(twice) = repeated(interfaces.iter().map(Interface::to_string)) {
            self.add(
                &path,
                format_args!("lists {twice} twice"),
                "list each interface once",
            );
        }
    }

    fn peers(&mut self, peers: &[PeerConfig]) {
        if peers.len() > MAX_PEERS {
            self.too_many(&["discovery", "static"], peers.len(), MAX_PEERS);
            return;
        }
        for PeerConfig { name, locations } in peers {
            let path = ["discovery", "static", name.as_str()];
            self.name(&path, name);
            if locations.is_empty() {
                self.add(&path, "is empty", "list at least one location of this peer");
            }
            if locations.len() > MAX_ADDRESSES {
                self.too_many(&path, locations.len(), MAX_ADDRESSES);
            }
            if let Some(location) = repeated(locations) {
                self.add(
                    &path,
                    format_args!("lists {location} twice"),
                    "list each location once",
                );
            }
            for location in locations {
                self.location(&path, location);
            }
        }
    }

    fn location(&mut self, path: &[&str], location: &Location) {
        let kind = location.kind();
        if kind.is_host_local() {
            self.add(
                path,
                format_args!("lists {location}, which works only within one host"),
                "write for example tcp://10.0.0.2:7788",
            );
        } else if kind.is_http() {
            // The port is optional.
            let authority = location.authority();
            if !has_port(authority) && !has_port(&format!("{authority}:7778")) {
                self.add(
                    path,
                    format_args!("lists {location}, which has no host or a wrong port"),
                    format!("write for example {kind}://10.0.0.7:7778/acc"),
                );
            }
        } else if !has_port(location.address()) {
            self.add(
                path,
                format_args!("lists {location}, which has no port"),
                "write for example tcp://10.0.0.2:7788 or tcp://[fe80::1%eth0]:7788",
            );
        }
    }

    fn too_many(&mut self, path: &[&str], count: usize, most: usize) {
        self.add(
            path,
            format_args!("has {count} entries"),
            format!("use at most {most}"),
        );
    }
}

/// Whether the text is a loopback address with port.
pub(crate) fn is_on_loopback(text: &str) -> bool {
    let address = text.parse::<SocketAddr>();
    address.is_ok_and(|address| address.ip().to_canonical().is_loopback())
}

/// Whether the text is `host:port` with a port other than 0.
fn has_port(address: &str) -> bool {
    if is_numeric_address(address) {
        return !address.ends_with(":0");
    }
    address.rsplit_once(':').is_some_and(|(host, port)| {
        !host.is_empty()
            && !host.contains([':', '[', ']', '/'])
            && port.bytes().all(|byte| byte.is_ascii_digit())
            && port.parse::<u16>().is_ok_and(|port| port != 0)
    })
}

fn repeated<T: Eq + Hash + Clone>(all: impl IntoIterator<Item = T>) -> Option<T> {
    let mut seen = HashSet::new();
    all.into_iter().find(|one| !seen.insert(one.clone()))
}

/// Returns the last line of an error of `regex`, which holds the reason; the lines before show the
/// position.
fn one_line(text: &str) -> String {
    let last = text.lines().last().unwrap_or_default().trim();
    last.trim_start_matches("error: ").to_owned()
}
