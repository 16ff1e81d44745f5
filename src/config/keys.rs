//! The keys: the TOML form of each and the field that holds its value.
//!
//! A new key needs a field of [`Config`], its default, and one entry here. [`super::check`] checks
//! bounds and conditions on several keys.

use std::fmt::Display;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::ops::Range;
use std::str::FromStr;
use std::time::Duration;

use bytesize::ByteSize;
use fipa_transport::{Kind, LocationError};
use serde::Serialize;
use toml_edit::Value as Toml;

use super::{AccessRule, Check, Config, Interface, PeerConfig, PlatformAgent, RouteConfig};

/// A value as it is written in the file. Sizes, durations and addresses are text.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(untagged)]
#[non_exhaustive]
pub enum Value {
    /// `true` or `false`.
    Truth(bool),
    /// A number without unit.
    Number(usize),
    /// Text.
    Text(String),
    /// A list of texts.
    List(Vec<String>),
}

impl Value {
    /// Creates a list of items that are written as text.
    pub(super) fn list(items: &[impl Display]) -> Self {
        Self::List(items.iter().map(ToString::to_string).collect())
    }

    pub(super) fn to_toml(&self) -> String {
        match self {
            Self::Truth(truth) => truth.to_string(),
            Self::Number(number) => number.to_string(),
            Self::Text(text) => Toml::from(text).to_string(),
            Self::List(items) => {
                let items: Vec<String> = items.iter().map(|i| Toml::from(i).to_string()).collect();
                format!("[{}]", items.join(", "))
            }
        }
    }
}

/// A key with a fixed path.
pub(super) struct Key {
    pub(super) path: &'static [&'static str],
    /// The kind of value, which decides how `--set` arguments are parsed.
    pub(super) shape: Shape,
    /// The allowed values; the end of a sentence that begins with "expected".
    pub(super) expected: &'static str,
    pub(super) write: fn(&mut Config, &Toml) -> Result<(), InvalidValue>,
    pub(super) read: fn(&Config) -> Value,
}

/// A table whose keys are names that the user chooses, and whose values are lists.
pub(super) struct Map {
    pub(super) path: &'static [&'static str],
    pub(super) expected: &'static str,
    /// Adds an entry; the reader calls it once per name.
    pub(super) write: fn(&mut Config, &str, &Toml) -> Result<(), InvalidValue>,
    pub(super) read: fn(&Config) -> Vec<(&str, Value)>,
}

/// The kind of value of a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    /// Text, including sizes and durations.
    Text,
    /// A boolean or a number.
    Plain,
    List,
}

/// The error if a value does not fit its key.
#[derive(Debug)]
pub(super) struct InvalidValue {
    /// The position in the document, if known more precisely than the position of the key.
    pub(super) span: Option<Range<usize>>,
    pub(super) reason: String,
}

const KINDS: &str = r#"a list of transports such as ["shm", "unix", "tcp"]"#;
const SIZE: &str = r#"a size such as "64MiB""#;
const ACCESS: &str = r#"a list of receivers such as ["arm_.* performative=request,cancel"]"#;
const PLATFORM_AGENT: &str = r#"true, false or a name such as "directory""#;
const ADDRESSES: &str = r#"a list of numeric addresses with port such as ["127.0.0.1:0"]"#;

/// Every key, in the order in which `fipa config show` prints them, before the [`MAPS`].
pub(super) const KEYS: &[Key] = &[
    Key {
        path: &["domain"],
        shape: Shape::Text,
        expected: "a name of 1 to 32 letters, digits, '_' or '-'",
        write: |config, value| text(value).map(|domain| config.domain = domain),
        read: |config| Value::Text(config.domain.clone()),
    },
    Key {
        path: &["runtime_dir"],
        shape: Shape::Text,
        expected: r#"a directory such as "/run/fipa", or "" for the one in /tmp"#,
        write: |config, value| text(value).map(|dir| config.runtime_dir = dir),
        read: |config| Value::Text(config.runtime_dir.clone()),
    },
    Key {
        path: &["group"],
        shape: Shape::Text,
        expected: r#"a group of this host such as "robot", or its number in quotes"#,
        write: |config, value| text(value).map(|group| config.group = group),
        read: |config| Value::Text(config.group.clone()),
    },
    Key {
        path: &["mts", "name"],
        shape: Shape::Text,
        expected: "a name of 1 to 255 bytes",
        write: |config, value| text(value).map(|name| config.mts.name = name),
        read: |config| Value::Text(config.mts.name.clone()),
    },
    Key {
        path: &["mts", "transports"],
        shape: Shape::List,
        expected: KINDS,
        write: |config, value| kinds(value).map(|kinds| config.mts.transports = kinds),
        read: |config| Value::list(&config.mts.transports),
    },
    Key {
        path: &["mts", "deadline"],
        shape: Shape::Text,
        expected: r#"a duration such as "5s" or "500ms""#,
        write: |config, value| duration(value).map(|deadline| config.mts.deadline = deadline),
        read: |config| duration_text(config.mts.deadline),
    },
    Key {
        path: &["mts", "queue"],
        shape: Shape::Plain,
        expected: "a number of letters such as 256",
        write: |config, value| number(value).map(|queue| config.mts.queue = queue),
        read: |config| Value::Number(config.mts.queue),
    },
    Key {
        path: &["mts", "queue_bytes"],
        shape: Shape::Text,
        expected: SIZE,
        write: |config, value| size(value).map(|size| config.mts.queue_bytes = size),
        read: |config| size_text(config.mts.queue_bytes),
    },
    Key {
        path: &["mts", "raise_open_files"],
        shape: Shape::Plain,
        expected: "true or false",
        write: |config, value| truth(value).map(|raise| config.mts.raise_open_files = raise),
        read: |config| Value::Truth(config.mts.raise_open_files),
    },
    Key {
        path: &["transport", "shm", "capacity"],
        shape: Shape::Text,
        expected: SIZE,
        write: |config, value| size(value).map(|size| config.transport.shm.capacity = size),
        read: |config| size_text(config.transport.shm.capacity),
    },
    Key {
        path: &["transport", "shm", "max_letter"],
        shape: Shape::Text,
        expected: SIZE,
        write: |config, value| size(value).map(|size| config.transport.shm.max_letter = size),
        read: |config| size_text(config.transport.shm.max_letter),
    },
    Key {
        path: &["transport", "shm", "spin"],
        shape: Shape::Text,
        expected: r#"a duration such as "50us", or 0"#,
        write: |config, value| duration(value).map(|spin| config.transport.shm.spin = spin),
        read: |config| duration_text(config.transport.shm.spin),
    },
    Key {
        path: &["transport", "tcp", "listen"],
        shape: Shape::List,
        expected: ADDRESSES,
        write: |config, value| addresses(value).map(|all| config.transport.tcp.listen = all),
        read: |config| Value::list(&config.transport.tcp.listen),
    },
    Key {
        path: &["transport", "tcp", "processes"],
        shape: Shape::Plain,
        expected: "true or false",
        write: |config, value| truth(value).map(|on| config.transport.tcp.processes = on),
        read: |config| Value::Truth(config.transport.tcp.processes),
    },
    Key {
        path: &["transport", "udp", "listen"],
        shape: Shape::List,
        expected: ADDRESSES,
        write: |config, value| addresses(value).map(|all| config.transport.udp.listen = all),
        read: |config| Value::list(&config.transport.udp.listen),
    },
    Key {
        path: &["transport", "quic", "listen"],
        shape: Shape::List,
        expected: ADDRESSES,
        write: |config, value| addresses(value).map(|all| config.transport.quic.listen = all),
        read: |config| Value::list(&config.transport.quic.listen),
    },
    Key {
        path: &["transport", "http", "listen"],
        shape: Shape::List,
        expected: ADDRESSES,
        write: |config, value| addresses(value).map(|all| config.transport.http.listen = all),
        read: |config| Value::list(&config.transport.http.listen),
    },
    Key {
        path: &["transport", "https", "listen"],
        shape: Shape::List,
        expected: ADDRESSES,
        write: |config, value| addresses(value).map(|all| config.transport.https.listen = all),
        read: |config| Value::list(&config.transport.https.listen),
    },
    Key {
        path: &["transport", "https", "authorities"],
        shape: Shape::Text,
        expected: r#"a file such as "/etc/ssl/certs/ca-certificates.crt", or "" for none"#,
        write: |config, value| text(value).map(|file| config.transport.https.authorities = file),
        read: |config| Value::Text(config.transport.https.authorities.clone()),
    },
    Key {
        path: &["transport", "udt", "listen"],
        shape: Shape::List,
        expected: ADDRESSES,
        write: |config, value| addresses(value).map(|all| config.transport.udt.listen = all),
        read: |config| Value::list(&config.transport.udt.listen),
    },
    Key {
        path: &["discovery", "mdns"],
        shape: Shape::Plain,
        expected: "true or false",
        write: |config, value| truth(value).map(|mdns| config.discovery.mdns = mdns),
        read: |config| Value::Truth(config.discovery.mdns),
    },
    Key {
        path: &["discovery", "interfaces"],
        shape: Shape::List,
        expected: r#"a list of interface names or addresses such as ["wlan0", "10.0.0.7"]"#,
        write: |config, value| items(value, interface).map(|all| config.discovery.interfaces = all),
        read: |config| Value::list(&config.discovery.interfaces),
    },
    Key {
        path: &["security", "keys"],
        shape: Shape::Text,
        expected: r#"a directory such as "/etc/fipa/keys", or "" for none"#,
        write: |config, value| text(value).map(|keys| config.security.keys = keys),
        read: |config| Value::Text(config.security.keys.clone()),
    },
    Key {
        path: &["security", "insecure"],
        shape: Shape::Plain,
        expected: "true or false",
        write: |config, value| truth(value).map(|open| config.security.insecure = open),
        read: |config| Value::Truth(config.security.insecure),
    },
    Key {
        path: &["security", "loopback"],
        shape: Shape::Plain,
        expected: "true or false",
        write: |config, value| truth(value).map(|too| config.security.loopback = too),
        read: |config| Value::Truth(config.security.loopback),
    },
    Key {
        path: &["security", "legacy_peers"],
        shape: Shape::List,
        expected: r#"a list of addresses such as ["10.0.0.9"]"#,
        write: |config, value| items(value, parsed).map(|all| config.security.legacy_peers = all),
        read: |config| Value::list(&config.security.legacy_peers),
    },
    Key {
        path: &["security", "key_log"],
        shape: Shape::Plain,
        expected: "true or false",
        write: |config, value| truth(value).map(|log| config.security.key_log = log),
        read: |config| Value::Truth(config.security.key_log),
    },
    Key {
        path: &["security", "peer_connections"],
        shape: Shape::Plain,
        expected: "a number of connections such as 64",
        write: |config, value| number(value).map(|most| config.security.peer_connections = most),
        read: |config| Value::Number(config.security.peer_connections),
    },
    Key {
        path: &["security", "peer_letters"],
        shape: Shape::Plain,
        expected: "a number of letters per second such as 20000, or 0 for no limit",
        write: |config, value| number(value).map(|most| config.security.peer_letters = most),
        read: |config| Value::Number(config.security.peer_letters),
    },
    Key {
        path: &["security", "peer_bytes"],
        shape: Shape::Text,
        expected: r#"a size per second such as "256MiB", or 0 for no limit"#,
        write: |config, value| size(value).map(|most| config.security.peer_bytes = most),
        read: |config| size_text(config.security.peer_bytes),
    },
    Key {
        path: &["http", "listen"],
        shape: Shape::Text,
        expected: r#"an address such as "127.0.0.1:9790", or "" for none"#,
        write: |config, value| text(value).map(|address| config.http.listen = address),
        read: |config| Value::Text(config.http.listen.clone()),
    },
    Key {
        path: &["http", "names"],
        shape: Shape::List,
        expected: r#"a list of host names such as ["robot.example"]"#,
        write: |config, value| items(value, text).map(|all| config.http.names = all),
        read: |config| Value::list(&config.http.names),
    },
    Key {
        path: &["http", "token_file"],
        shape: Shape::Text,
        expected: r#"a file such as "/etc/fipa/http.token", or "" for one in the directory of the domain"#,
        write: |config, value| text(value).map(|file| config.http.token_file = file),
        read: |config| Value::Text(config.http.token_file.clone()),
    },
    Key {
        path: &["http", "control"],
        shape: Shape::Plain,
        expected: "true or false",
        write: |config, value| truth(value).map(|open| config.http.control = open),
        read: |config| Value::Truth(config.http.control),
    },
    Key {
        path: &["contacts", "networks"],
        shape: Shape::List,
        expected: r#"a list of networks such as ["10.0.0.0/8"]"#,
        write: |config, value| items(value, parsed).map(|all| config.contacts.networks = all),
        read: |config| Value::list(&config.contacts.networks),
    },
    Key {
        path: &["access", "rate"],
        shape: Shape::Plain,
        expected: "a number of letters per second such as 100, or 0 for no limit",
        write: |config, value| number(value).map(|rate| config.access.rate = rate),
        read: |config| Value::Number(config.access.rate),
    },
    Key {
        path: &["access", "operators"],
        shape: Shape::List,
        expected: r#"a list of names or patterns of agents such as ["boss"]"#,
        write: |config, value| items(value, text).map(|all| config.access.operators = all),
        read: |config| Value::list(&config.access.operators),
    },
    Key {
        path: &["access", "recorders"],
        shape: Shape::List,
        expected: r#"a list of names or patterns of agents such as ["station"]"#,
        write: |config, value| items(value, text).map(|all| config.access.recorders = all),
        read: |config| Value::list(&config.access.recorders),
    },
    Key {
        path: &["monitor", "check"],
        shape: Shape::Text,
        expected: r#""off", "warn" or "enforce""#,
        write: |config, value| choice(value).map(|check| config.monitor.check = check),
        read: |config| Value::Text(config.monitor.check.as_str().to_owned()),
    },
    Key {
        path: &["monitor", "answer"],
        shape: Shape::Plain,
        expected: "true or false",
        write: |config, value| truth(value).map(|answer| config.monitor.answer = answer),
        read: |config| Value::Truth(config.monitor.answer),
    },
    Key {
        path: &["monitor", "heartbeat"],
        shape: Shape::Text,
        expected: r#"a duration such as "5s""#,
        write: |config, value| duration(value).map(|time| config.monitor.heartbeat = time),
        read: |config| duration_text(config.monitor.heartbeat),
    },
    Key {
        path: &["monitor", "protocols"],
        shape: Shape::List,
        expected: r#"a list of SCXML files such as ["protocols/lift.scxml"]"#,
        write: |config, value| items(value, text).map(|all| config.monitor.protocols = all),
        read: |config| Value::list(&config.monitor.protocols),
    },
    Key {
        path: &["monitor", "idle"],
        shape: Shape::Text,
        expected: r#"a duration such as "24h""#,
        write: |config, value| duration(value).map(|idle| config.monitor.idle = idle),
        read: |config| duration_text(config.monitor.idle),
    },
    Key {
        path: &["monitor", "conversations"],
        shape: Shape::Plain,
        expected: "a number of conversations such as 100000",
        write: |config, value| number(value).map(|most| config.monitor.conversations = most),
        read: |config| Value::Number(config.monitor.conversations),
    },
    Key {
        path: &["monitor", "bytes"],
        shape: Shape::Text,
        expected: r#"a size such as "64MiB""#,
        write: |config, value| size(value).map(|bytes| config.monitor.bytes = bytes),
        read: |config| size_text(config.monitor.bytes),
    },
    Key {
        path: &["monitor", "exempt"],
        shape: Shape::List,
        expected: r#"a list of protocols such as ["fipa-query"]"#,
        write: |config, value| items(value, text).map(|all| config.monitor.exempt = all),
        read: |config| Value::list(&config.monitor.exempt),
    },
    Key {
        path: &["platform", "ams"],
        shape: Shape::Text,
        expected: PLATFORM_AGENT,
        write: |config, value| platform_agent(value).map(|ams| config.platform.ams = ams),
        read: |config| platform_agent_value(&config.platform.ams),
    },
    Key {
        path: &["platform", "df"],
        shape: Shape::Text,
        expected: PLATFORM_AGENT,
        write: |config, value| platform_agent(value).map(|df| config.platform.df = df),
        read: |config| platform_agent_value(&config.platform.df),
    },
    Key {
        path: &["record", "directory"],
        shape: Shape::Text,
        expected: r#"a directory such as "/var/lib/fipa/recordings", or "" for none"#,
        write: |config, value| text(value).map(|directory| config.record.directory = directory),
        read: |config| Value::Text(config.record.directory.clone()),
    },
    Key {
        path: &["record", "bytes"],
        shape: Shape::Text,
        expected: r#"a size such as "1GiB""#,
        write: |config, value| size(value).map(|bytes| config.record.bytes = bytes),
        read: |config| size_text(config.record.bytes),
    },
];

/// Every table of names.
pub(super) const MAPS: &[Map] = &[
    Map {
        path: &["routes"],
        expected: KINDS,
        write: |config, receiver, value| {
            let transports = kinds(value)?;
            let receiver = receiver.to_owned();
            config.routes.push(RouteConfig {
                receiver,
                transports,
            });
            Ok(())
        },
        read: |config| {
            let routes = config.routes.iter();
            routes
                .map(|route| (route.receiver.as_str(), Value::list(&route.transports)))
                .collect()
        },
    },
    Map {
        path: &["discovery", "static"],
        expected: r#"a list of locations such as ["tcp://10.0.0.2:7788"]"#,
        write: |config, name, value| {
            let locations = items(value, parsed)?;
            let name = name.to_owned();
            config.discovery.peers.push(PeerConfig { name, locations });
            Ok(())
        },
        read: |config| {
            let peers = config.discovery.peers.iter();
            peers
                .map(|peer| (peer.name.as_str(), Value::list(&peer.locations)))
                .collect()
        },
    },
    Map {
        path: &["access", "allow"],
        expected: ACCESS,
        write: |config, sender, value| {
            access(sender, value).map(|rule| config.access.allow.push(rule))
        },
        read: |config| shown(&config.access.allow),
    },
    Map {
        path: &["access", "deny"],
        expected: ACCESS,
        write: |config, sender, value| {
            access(sender, value).map(|rule| config.access.deny.push(rule))
        },
        read: |config| shown(&config.access.deny),
    },
];

fn access(sender: &str, value: &Toml) -> Result<AccessRule, InvalidValue> {
    let receivers = items(value, text)?;
    let sender = sender.to_owned();
    Ok(AccessRule { sender, receivers })
}

fn shown(rules: &[AccessRule]) -> Vec<(&str, Value)> {
    let rules = rules.iter();
    rules
        .map(|rule| (rule.sender.as_str(), Value::list(&rule.receivers)))
        .collect()
}

/// Returns the default of `mts.name`: the name of the host, as far as it is valid, and `-mts`.
pub(super) fn default_mts_name(host_name: &str) -> String {
    format!("{}-mts", fipa_sds::to_name(host_name))
}

/// Formats a value for a message: as written in TOML, at most 80 characters.
pub(super) fn quoted(value: &Toml) -> String {
    let text = value.to_string();
    let text = text.trim();
    match text.char_indices().nth(80) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}

impl InvalidValue {
    fn new(value: &Toml, reason: impl Display) -> Self {
        Self {
            span: value.span(),
            reason: format!("{}: {reason}", quoted(value)),
        }
    }

    fn kind_of_value(value: &Toml) -> Self {
        let article = match value.type_name() {
            name @ ("array" | "integer" | "inline table") => format!("an {name}"),
            name => format!("a {name}"),
        };
        Self::new(value, format_args!("{article} is not allowed here"))
    }
}

fn text(value: &Toml) -> Result<String, InvalidValue> {
    let text = value
        .as_str()
        .ok_or_else(|| InvalidValue::kind_of_value(value))?;
    Ok(text.to_owned())
}

fn choice(value: &Toml) -> Result<Check, InvalidValue> {
    let text = value
        .as_str()
        .ok_or_else(|| InvalidValue::kind_of_value(value))?;
    let mut all = Check::ALL.into_iter();
    all.find(|check| check.as_str() == text)
        .ok_or_else(|| InvalidValue::new(value, "unknown choice"))
}

fn truth(value: &Toml) -> Result<bool, InvalidValue> {
    value
        .as_bool()
        .ok_or_else(|| InvalidValue::kind_of_value(value))
}

/// Reads `true`, `false` or a name. An argument of `--set` is text in all three cases.
fn platform_agent(value: &Toml) -> Result<PlatformAgent, InvalidValue> {
    if let Some(on) = value.as_bool() {
        return Ok(if on {
            PlatformAgent::On
        } else {
            PlatformAgent::Off
        });
    }
    Ok(match text(value)?.as_str() {
        "true" => PlatformAgent::On,
        "false" => PlatformAgent::Off,
        name => PlatformAgent::Named(name.to_owned()),
    })
}

fn platform_agent_value(agent: &PlatformAgent) -> Value {
    match agent {
        PlatformAgent::Off => Value::Truth(false),
        PlatformAgent::On => Value::Truth(true),
        PlatformAgent::Named(name) => Value::Text(name.clone()),
    }
}

fn number(value: &Toml) -> Result<usize, InvalidValue> {
    let number = value
        .as_integer()
        .ok_or_else(|| InvalidValue::kind_of_value(value))?;
    usize::try_from(number)
        .map_err(|_| InvalidValue::new(value, "a negative number is not allowed"))
}

/// Reads a size: text with a unit, or a plain number of bytes.
fn size(value: &Toml) -> Result<u64, InvalidValue> {
    if let Some(bytes) = value.as_integer() {
        let negative = |_| InvalidValue::new(value, "a negative number is not allowed");
        return u64::try_from(bytes).map_err(negative);
    }
    let text = value
        .as_str()
        .ok_or_else(|| InvalidValue::kind_of_value(value))?;
    let size: Result<ByteSize, _> = text.parse();
    size.map(|size| size.as_u64())
        .map_err(|_| InvalidValue::new(value, "not a size"))
}

/// Reads a duration: text with units, or zero without a unit.
fn duration(value: &Toml) -> Result<Duration, InvalidValue> {
    match value.as_integer() {
        Some(0) => return Ok(Duration::ZERO),
        Some(_) => return Err(InvalidValue::new(value, "the unit is missing")),
        None => {}
    }
    let text = value
        .as_str()
        .ok_or_else(|| InvalidValue::kind_of_value(value))?;
    humantime::parse_duration(text).map_err(|error| InvalidValue::new(value, error))
}

fn items<T>(
    value: &Toml,
    one: fn(&Toml) -> Result<T, InvalidValue>,
) -> Result<Vec<T>, InvalidValue> {
    let list = value
        .as_array()
        .ok_or_else(|| InvalidValue::kind_of_value(value))?;
    list.iter().map(one).collect()
}

fn kinds(value: &Toml) -> Result<Vec<Kind>, InvalidValue> {
    items(value, |value| {
        let text = value
            .as_str()
            .ok_or_else(|| InvalidValue::kind_of_value(value))?;
        text.parse()
            .map_err(|error: LocationError| InvalidValue::new(value, error))
    })
}

/// Parses a text.
fn parsed<T>(value: &Toml) -> Result<T, InvalidValue>
where
    T: FromStr<Err: Display>,
{
    let text = value
        .as_str()
        .ok_or_else(|| InvalidValue::kind_of_value(value))?;
    text.parse()
        .map_err(|error| InvalidValue::new(value, error))
}

fn addresses(value: &Toml) -> Result<Vec<String>, InvalidValue> {
    items(value, |value| {
        let text = value
            .as_str()
            .ok_or_else(|| InvalidValue::kind_of_value(value))?;
        if is_numeric_address(text) {
            Ok(text.to_owned())
        } else {
            Err(InvalidValue::new(value, "not a numeric address with port"))
        }
    })
}

/// Whether the text is `address:port`, or `*:port` for all addresses of this host. The scope of an IPv6 address may be the name of an interface
/// (RFC 4007 section 11.2), which `std` does not parse.
pub(super) fn is_numeric_address(text: &str) -> bool {
    let is_any = text.strip_prefix("*:").is_some_and(|port| {
        port.bytes().all(|byte| byte.is_ascii_digit()) && port.parse::<u16>().is_ok()
    });
    if is_any || text.parse::<SocketAddr>().is_ok() {
        return true;
    }
    let scoped = text
        .strip_prefix('[')
        .and_then(|rest| rest.split_once("]:"));
    scoped.is_some_and(|(inner, port)| {
        inner.split_once('%').is_some_and(|(address, scope)| {
            address.parse::<Ipv6Addr>().is_ok() && is_interface_name(scope)
        }) && port.bytes().all(|byte| byte.is_ascii_digit())
            && port.parse::<u16>().is_ok()
    })
}

/// Whether the kernel allows this name for an interface: 1 to 15 bytes, no white space, no `/` and no
/// `:` (`dev_valid_name` of Linux). The interface need not exist yet.
pub(super) fn is_interface_name(text: &str) -> bool {
    (1..=15).contains(&text.len())
        && !matches!(text, "." | "..")
        && !text
            .chars()
            .any(|c| c.is_whitespace() || c.is_control() || matches!(c, '/' | ':'))
}

fn interface(value: &Toml) -> Result<Interface, InvalidValue> {
    let text = value
        .as_str()
        .ok_or_else(|| InvalidValue::kind_of_value(value))?;
    if let Ok(address) = text.parse::<IpAddr>() {
        return Ok(Interface::Address(address));
    }
    if is_interface_name(text) {
        return Ok(Interface::Name(text.to_owned()));
    }
    Err(InvalidValue::new(
        value,
        "neither an interface name nor an address",
    ))
}

fn duration_text(duration: Duration) -> Value {
    Value::Text(humantime::format_duration(duration).to_string())
}

/// Formats a size in the largest unit that represents it exactly (`bytesize` rounds).
fn size_text(bytes: u64) -> Value {
    let units = [(30, "GiB"), (20, "MiB"), (10, "KiB")];
    let exact = units
        .iter()
        .find(|(bits, _)| bytes != 0 && bytes.trailing_zeros() >= *bits);
    Value::Text(match exact {
        Some((bits, unit)) => format!("{}{unit}", bytes >> bits),
        None => format!("{bytes}B"),
    })
}

/// Writes a path as a dotted key of TOML.
pub(super) fn dotted(path: &[&str]) -> String {
    let keys: Vec<String> = path.iter().map(|&part| bare_or_quoted(part)).collect();
    keys.join(".")
}

/// Writes a key of TOML, quoted if necessary.
pub(super) fn bare_or_quoted(key: &str) -> String {
    toml_edit::Key::new(key).display_repr().into_owned()
}
