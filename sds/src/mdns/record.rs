//! Conversion between a directory entry and a DNS-SD record.
//!
//! The record has the keys of the legacy peers (fipa_services, JADE's proxy), followed by keys of
//! this project. In this order:
//!
//! | key | value |
//! |---|---|
//! | `TYPE` | the agent's type |
//! | `LOCATOR` | `tcp://a.b.c.d:port fipa::services::transports::MessageTransport;`, repeated; also `udt` |
//! | `DESCRIPTION` | the description |
//! | `TIMESTAMP` | time of registration, `%Y%m%d-%H:%M:%S:usec` |
//! | `fipa-version` | `1` |
//! | `fipa-name` | the exact name |
//! | `fipa-id` | the incarnation |
//! | `fipa-mts`, `fipa-mts-id` | name and incarnation of the gateway that announces it |
//! | `fipa-role` | `gateway` or `coalition`, absent for an agent |
//! | `fipa-members` | names of the members of a coalition, with a line feed between two |
//! | `fipa-leader` | the name of its leader if it is led; empty if it has none at present |
//! | `fipa-time` | time of registration, in milliseconds since 1970, UTC |
//! | `fipa-locations` | all locations that lead to this host, in order, with a space between two; link-local IPv6 addresses without a scope |
//! | `fipa-type`, `fipa-description` | full text, when the legacy key has only its beginning |
//!
//! Values for legacy peers stay within the limits of those: at most 200 bytes per value, only the
//! schemes `tcp` and `udt`, and numeric IPv4 addresses; other locations are left out. A longer value of this
//! project continues in `key.1`, `key.2` and so on. No key occurs twice in a record of this
//! project. The legacy peers split a long value over several strings with one key, which are joined
//! when read.
//!
//! `TIMESTAMP` has no time zone. The legacy peers write local time; this project writes UTC, and
//! reads theirs as UTC too. Between gateways of this project `fipa-time` counts, which is always
//! UTC.
//!
//! The instance label is the name with `?` for every `.`, as the legacy peers write it, whenever
//! that is reversible; see [`label`].

use std::collections::HashSet;
use std::time::SystemTime;

use fipa_transport::{
    Incarnation, Kind, Location, LocationError, PeerId, Principal, Signature, fnv1a,
};

use crate::entry::{millis_of_time, time_of_millis};
use crate::{Entry, EntryError, Members, MtsId, Reach, Role, Source};

/// Maximum length in bytes of a value that the legacy peers write, and of one string in a record of
/// this project.
const MAX_VALUE: usize = 200;

/// Maximum number of strings for one value of this project: enough for the longest valid one.
const MAX_PARTS: usize = 32;

/// Maximum length of a DNS label, in bytes.
const MAX_LABEL: usize = 63;

/// The strings of a TXT record, in order: keys and values.
pub(super) type Properties = Vec<(String, Vec<u8>)>;

/// Converts an entry to a TXT record.
pub(super) fn encode(entry: &Entry) -> Properties {
    let mut properties = Properties::new();
    let time = millis_of_time(entry.registered);
    for (key, value) in [
        ("TYPE", cut(&entry.agent_type).to_owned()),
        ("LOCATOR", locator(&entry.locations)),
        ("DESCRIPTION", cut(&entry.description).to_owned()),
        ("TIMESTAMP", timestamp(time)),
    ] {
        properties.push((key.to_owned(), value.into_bytes()));
    }
    let mut own = |key: &str, value: &str| {
        let value = value.as_bytes();
        // An empty value also has one part.
        let parts = value
            .chunks(MAX_VALUE)
            .chain(value.is_empty().then_some(value));
        for (number, part) in parts.enumerate() {
            properties.push((part_key(key, number), part.to_vec()));
        }
    };
    own("fipa-version", "1");
    own("fipa-name", &entry.name);
    own("fipa-id", &entry.incarnation.to_string());
    if let Some(mts) = &entry.mts.name {
        own("fipa-mts", mts);
    }
    own("fipa-mts-id", &entry.mts.incarnation.to_string());
    match &entry.role {
        Role::Agent => {}
        Role::Gateway => own("fipa-role", "gateway"),
        Role::Coalition(members) => {
            own("fipa-role", "coalition");
            // Names have no control characters, so a line feed separates them.
            own("fipa-members", &members.names().join("\n"));
            match members.leader() {
                Some(leader) => own("fipa-leader", leader),
                None if members.is_vacant() => own("fipa-leader", ""),
                None => {}
            }
        }
    }
    own("fipa-time", &time.to_string());
    let locations = entry.locations.iter();
    // Services that confirm deliveries must not use a location for legacy peers only.
    let locations = locations.filter(|location| {
        !location.kind().is_host_local() && location.signature() == Signature::Frames
    });
    let mut locations: Vec<String> = locations
        .map(|location| location.clone().without_scope().to_string())
        .collect();
    // An address that was received on two interfaces is one address of the other host.
    let mut known = HashSet::new();
    locations.retain(|location| known.insert(location.clone()));
    own("fipa-locations", &locations.join(" "));
    for (key, whole) in [
        ("fipa-type", &entry.agent_type),
        ("fipa-description", &entry.description),
    ] {
        if whole.len() > MAX_VALUE {
            own(key, whole);
        }
    }
    properties
}

/// Converts a record from the network to an entry.
///
/// A record with `fipa-version` is one of this project and must be valid. Any other is a legacy
/// peer's, of which the valid parts are used; `now` replaces a missing time.
pub(super) fn decode(
    label: &str,
    properties: &Properties,
    now: SystemTime,
) -> Result<Entry, RecordError> {
    let record = Record(properties);
    let entry = match record.text("fipa-version")? {
        Some(version) if version == "1" => own_entry(&record)?,
        Some(version) => return Err(RecordError::Version(version.chars().take(40).collect())),
        None => legacy_entry(label, &record, now),
    };
    entry.check()?;
    Ok(entry)
}

/// Completes link-local IPv6 addresses with the interfaces on which the record was received: they are valid
/// there. One without an interface cannot be dialed.
pub(super) fn on_interfaces(locations: Vec<Location>, interfaces: &[u32]) -> Vec<Location> {
    let completed = locations.into_iter().flat_map(|location| {
        let number = match location.is_link_local() {
            true => interfaces,
            false => &[],
        };
        let scoped = number.iter().map(|it| location.clone().on_interface(*it));
        let scoped: Vec<Location> = scoped.collect();
        match scoped.is_empty() {
            true => vec![location],
            false => scoped,
        }
    });
    completed.collect()
}

/// The instance label of a name: at most 63 bytes, without dots and backslashes.
///
/// The label is the name with `?` for `.` if a legacy peer can convert it back, otherwise a prefix
/// of the name and a hash of it. `attempt` changes the hash: labels that differ only in case are
/// equal on the network, so another name may already use the first label, or another gateway the same
/// name. Further labels are those of the gateway alone.
pub(super) fn label(name: &str, attempt: u32, gateway: Incarnation) -> String {
    let plain = name.replace('.', "?");
    let faithful = plain.len() <= MAX_LABEL && !name.contains(['?', '\\']);
    if faithful && attempt == 0 {
        return plain;
    }
    let of = match attempt {
        0 => 0,
        _ => gateway.as_u64(),
    };
    let hash = format!("~{:016x}", name_hash(name, attempt, of));
    let beginning = plain.replace('\\', "_");
    let beginning = &beginning[..beginning.floor_char_boundary(MAX_LABEL - hash.len())];
    format!("{beginning}{hash}")
}

/// Error of [`decode`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(super) enum RecordError {
    #[error("version {0:?} of the record is not supported")]
    Version(String),
    #[error("the key {0} is missing")]
    Missing(&'static str),
    #[error("the value of {0} is not valid")]
    Value(&'static str),
    #[error("the value of {0} is too long")]
    TooLong(&'static str),
    #[error(transparent)]
    Entry(#[from] EntryError),
}

/// Looks up the strings of a record by key.
struct Record<'a>(&'a Properties);

impl Record<'_> {
    /// The first value of that key, ignoring case (RFC 6763 clause 6.4).
    fn value(&self, key: &str) -> Option<&[u8]> {
        let found = self.0.iter().find(|(k, _)| k.eq_ignore_ascii_case(key));
        found.map(|(_, value)| value.as_slice())
    }

    /// The value of a key of this project, with all its parts.
    fn text(&self, key: &'static str) -> Result<Option<String>, RecordError> {
        let mut parts = (0..MAX_PARTS + 1).map_while(|number| self.value(&part_key(key, number)));
        let Some(first) = parts.next() else {
            return Ok(None);
        };
        let mut whole = first.to_vec();
        for (number, part) in parts.enumerate() {
            if number + 1 == MAX_PARTS {
                return Err(RecordError::TooLong(key));
            }
            whole.extend_from_slice(part);
        }
        let text = String::from_utf8(whole).map_err(|_| RecordError::Value(key))?;
        Ok(Some(text))
    }

    fn parsed<T: std::str::FromStr>(&self, key: &'static str) -> Result<T, RecordError> {
        let text = self.text(key)?.ok_or(RecordError::Missing(key))?;
        text.parse().map_err(|_| RecordError::Value(key))
    }

    /// All values of a legacy peer's key, joined in order.
    fn joined(&self, key: &str) -> Vec<u8> {
        let parts = self.0.iter().filter(|(k, _)| k.eq_ignore_ascii_case(key));
        parts.flat_map(|(_, value)| value.iter().copied()).collect()
    }

    /// A text of a legacy peer, without control characters and truncated to `max` bytes.
    fn legacy_text(&self, key: &str, max: usize) -> String {
        let value = self.joined(key);
        let text = String::from_utf8_lossy(&value);
        let mut text: String = text.chars().filter(|c| !c.is_control()).collect();
        text.truncate(text.floor_char_boundary(max));
        text
    }
}

/// Its peer is not in the record.
fn own_entry(record: &Record<'_>) -> Result<Entry, RecordError> {
    let key = "fipa-locations";
    let locations = record.text(key)?.ok_or(RecordError::Missing(key))?;
    let mut known = Vec::new();
    for location in locations.split(' ').filter(|location| !location.is_empty()) {
        match location.parse() {
            // Shared memory and sockets of another host are unreachable from here, and other hosts
            // must not announce those of this host.
            Ok(location) if Location::kind(&location).is_host_local() => {}
            Ok(location) => known.push(location.without_scope()),
            // An unknown transport of a later version does not invalidate the other locations.
            Err(LocationError::UnknownKind(_) | LocationError::UnknownSignature(_)) => {}
            Err(_) => return Err(RecordError::Value(key)),
        }
    }
    let role = match record.text("fipa-role")?.as_deref() {
        None => Role::Agent,
        Some("gateway") => Role::Gateway,
        Some("coalition") => Role::Coalition(members(record)?),
        Some(_) => return Err(RecordError::Value("fipa-role")),
    };
    let whole = |ours: &'static str, theirs: &'static str| {
        let text = match record.text(ours)? {
            Some(whole) => whole,
            None => record.text(theirs)?.unwrap_or_default(),
        };
        Ok::<_, RecordError>(text)
    };
    let mts: Incarnation = record.parsed("fipa-mts-id")?;
    Ok(Entry {
        name: record.parsed::<String>("fipa-name")?.into(),
        agent_type: whole("fipa-type", "TYPE")?,
        incarnation: record.parsed("fipa-id")?,
        peer: PeerId::of(Principal::Unproved, known.first()),
        locations: known,
        mts: MtsId::new(record.parsed::<String>("fipa-mts")?, mts),
        description: whole("fipa-description", "DESCRIPTION")?,
        registered: time_of_millis(record.parsed("fipa-time")?),
        source: Source::Mdns,
        reach: Reach::Remote { gateway: mts },
        role,
    })
}

fn members(record: &Record<'_>) -> Result<Members, RecordError> {
    let key = "fipa-members";
    let names = record.text(key)?.ok_or(RecordError::Missing(key))?;
    let names = names.split('\n');
    let members = match record.text("fipa-leader")? {
        Some(leader) if leader.is_empty() => Members::vacant(names),
        leader => Members::new(names, leader.map(Into::into)),
    };
    members.map_err(|_| RecordError::Value(key))
}

fn legacy_entry(label: &str, record: &Record<'_>, now: SystemTime) -> Entry {
    let name = label.replace('?', ".");
    let registered = record
        .value("TIMESTAMP")
        .and_then(|value| std::str::from_utf8(value).ok())
        .and_then(millis_of_timestamp)
        .unwrap_or_else(|| millis_of_time(now));
    let locator = record.joined("LOCATOR");
    let locations = locations_of_locator(&String::from_utf8_lossy(&locator));
    Entry {
        agent_type: record.legacy_text("TYPE", Entry::MAX_TYPE),
        incarnation: Incarnation::UNKNOWN,
        peer: PeerId::of(Principal::Unproved, locations.first()),
        locations,
        // Legacy records do not name the service; each agent may have its own.
        mts: MtsId::new(name.as_str(), Incarnation::UNKNOWN),
        name: name.into(),
        description: record.legacy_text("DESCRIPTION", Entry::MAX_DESCRIPTION),
        registered: time_of_millis(registered),
        source: Source::Mdns,
        reach: Reach::Remote {
            gateway: Incarnation::UNKNOWN,
        },
        role: Role::Agent,
    }
}

/// The locations that legacy peers can parse (an unknown scheme makes them throw), as many as fit.
fn locator(locations: &[Location]) -> String {
    let mut locator = String::new();
    for location in locations {
        let numeric: Result<std::net::SocketAddrV4, _> = location.address().parse();
        if !matches!(location.kind(), Kind::Tcp | Kind::Udt) || numeric.is_err() {
            continue;
        }
        let signature = location.signature().signature_type();
        let one = format!("{}://{} {signature};", location.kind(), location.address());
        if locator.len() + one.len() <= MAX_VALUE {
            locator += &one;
        }
    }
    locator
}

/// Parses `address signature[ service-signature];`, repeated. Unknown schemes and signatures are
/// skipped. Locations of transports that a gateway may lack come last.
fn locations_of_locator(locator: &str) -> Vec<Location> {
    let location = |one: &str| {
        let mut words = one.split_ascii_whitespace();
        let address: Location = words.next()?.parse().ok()?;
        let signature = match words.next() {
            Some(text) => Signature::of_signature_type(text)?,
            None => Signature::FipaServices,
        };
        address.with_signature(signature).ok()
    };
    let locations = locator.split(';').filter_map(location);
    let mut locations: Vec<Location> = locations.map(Location::without_scope).collect();
    locations.sort_by_key(|location| !location.kind().is_supported());
    locations.truncate(Entry::MAX_LOCATIONS);
    locations
}

const TIMESTAMP: &str = "%Y%m%d-%H:%M:%S";

fn timestamp(millis: u64) -> String {
    let time = i64::try_from(millis).ok();
    let time = time.and_then(|millis| jiff::Timestamp::from_millisecond(millis).ok());
    let time = time.unwrap_or(jiff::Timestamp::UNIX_EPOCH);
    format!("{}:{:06}", time.strftime(TIMESTAMP), millis % 1000 * 1000)
}

fn millis_of_timestamp(text: &str) -> Option<u64> {
    let (seconds, micros) = match text.match_indices(':').nth(2) {
        Some((at, _)) => (text.get(..at)?, text.get(at + 1..)?),
        None => (text, "0"),
    };
    let micros: u64 = micros.parse().ok().filter(|micros| *micros < 1_000_000)?;
    let time = jiff::civil::DateTime::strptime(TIMESTAMP, seconds).ok()?;
    let time = time.to_zoned(jiff::tz::TimeZone::UTC).ok()?;
    let millis = u64::try_from(time.timestamp().as_millisecond()).ok()?;
    Some(millis + micros / 1000)
}

fn part_key(key: &str, number: usize) -> String {
    match number {
        0 => key.to_owned(),
        _ => format!("{key}.{number}"),
    }
}

/// Length of the strings in a TXT record, in bytes.
pub(super) fn len_of(properties: &Properties) -> usize {
    properties
        .iter()
        .map(|(key, value)| key.len() + value.len() + 2)
        .sum()
}

fn cut(text: &str) -> &str {
    &text[..text.floor_char_boundary(MAX_VALUE)]
}

/// All hosts compute the same value; it need not be unpredictable.
fn name_hash(name: &str, attempt: u32, gateway: u64) -> u64 {
    let numbers = attempt
        .to_be_bytes()
        .into_iter()
        .chain(gateway.to_be_bytes());
    fnv1a(name.bytes().chain(numbers))
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, UNIX_EPOCH};

    use proptest::prelude::*;

    use super::*;
    use fipa_acl::is_unprintable;

    use crate::{MAX_NAME, NameError, check_name, is_pattern};

    const SIGNATURE: &str = Signature::FipaServices.signature_type();

    fn read(label: &str, properties: &Properties) -> Result<Entry, RecordError> {
        decode(label, properties, UNIX_EPOCH)
    }

    fn strings(pairs: &[(&str, &[u8])]) -> Properties {
        let pairs = pairs.iter();
        pairs
            .map(|(key, value)| ((*key).to_owned(), value.to_vec()))
            .collect()
    }

    const GATEWAY: Incarnation = Incarnation::from_u64(0xab);

    fn example() -> Entry {
        let gateway = Incarnation::from_u64(0xab);
        Entry {
            name: "arm.left@crex".into(),
            agent_type: "gripper".to_owned(),
            incarnation: Incarnation::from_u64(7),
            locations: vec![
                "quic://10.0.0.2:1#00000000000000ab".parse().unwrap(),
                "tcp://[fe80::1]:7788".parse().unwrap(),
                "tcp://10.0.0.2:7788#00000000000000ab".parse().unwrap(),
            ],
            mts: MtsId::new("crex-mts", gateway),
            description: "left".to_owned(),
            registered: UNIX_EPOCH + Duration::from_millis(1_795_172_400_123),
            source: Source::Mdns,
            reach: Reach::Remote { gateway },
            peer: PeerId::of_ip([10, 0, 0, 2].into()),
            role: Role::Agent,
        }
    }

    #[test]
    fn a_link_local_address_gets_the_interfaces_of_the_receiver() {
        let mut entry = example();
        entry.locations = [
            "tcp://10.0.0.2:1",
            "tcp://[fe80::1%7]:1",
            "tcp://[fd00::1]:1",
        ]
        .map(|text| text.parse().unwrap())
        .to_vec();
        let read = read("arm", &encode(&entry)).unwrap();
        let on = |interfaces: &[u32]| {
            let locations = on_interfaces(read.locations.clone(), interfaces);
            locations
                .iter()
                .map(Location::to_string)
                .collect::<Vec<_>>()
        };
        let [first, last] = ["tcp://10.0.0.2:1", "tcp://[fd00::1]:1"];
        assert_eq!(on(&[]), [first, "tcp://[fe80::1]:1", last]);
        let both = [first, "tcp://[fe80::1%3]:1", "tcp://[fe80::1%2]:1", last];
        assert_eq!(on(&[3, 2]), both);
        // The digest of the stored record is that of the announced one.
        let stored = Entry {
            locations: on_interfaces(read.locations.clone(), &[3, 2]),
            ..read.clone()
        };
        assert_eq!(encode(&stored), encode(&entry));
    }

    #[test]
    fn a_record_has_the_keys_that_legacy_peers_read() {
        let properties = encode(&example());
        let texts: Vec<String> = properties
            .iter()
            .map(|(key, value)| format!("{key}={}", String::from_utf8_lossy(value)))
            .collect();
        assert_eq!(
            texts[..4],
            [
                "TYPE=gripper",
                "LOCATOR=tcp://10.0.0.2:7788 fipa::services::transports::MessageTransport;",
                "DESCRIPTION=left",
                "TIMESTAMP=20261120-11:00:00:123000",
            ]
        );
        assert_eq!(label(&example().name, 0, GATEWAY), "arm?left@crex");
    }

    #[test]
    fn host_local_locations_are_neither_announced_nor_accepted() {
        let mut entry = example();
        let locations = entry.locations.clone();
        for local in ["shm://00000000000000ab", "unix://00000000000000ab"] {
            entry.locations.insert(1, local.parse().unwrap());
        }
        let mut properties = encode(&entry);
        let locations_key = |(key, _): &&mut (String, Vec<u8>)| key.starts_with("fipa-locations");
        let (_, announced) = properties.iter_mut().find(locations_key).unwrap();
        let text = String::from_utf8(announced.clone()).unwrap();
        assert!(!text.contains("shm") && !text.contains("unix"), "{text}");
        announced.extend(b" unix://00000000000000ab shm://00000000000000ab");
        let read = read("arm?left@crex", &properties).unwrap();
        assert_eq!(read.locations, locations);
    }

    #[test]
    fn records_of_legacy_peers_are_decoded() {
        let properties = strings(&[
            ("timestamp", b"20261120-11:00:00:123456"),
            (
                "LOCATOR",
                b"udt://10.0.0.2:1 fipa::services::transports::MessageTransport;\
                  tcp://10.0.0.2:7788 fipa::services::transports::MessageTransport x;\
                  tcp://10.0.0.3:6789 JadeProxyAgent;;;tcp://",
            ),
            ("TYPE", b"\xff\x00sensor"),
        ]);
        let entry = read("echo@192?0?2?2:1099/JADE", &properties).unwrap();
        assert_eq!(&*entry.name, "echo@192.0.2.2:1099/JADE");
        assert_eq!(entry.agent_type, "\u{fffd}sensor");
        assert_eq!(
            entry.locations,
            [
                "tcp://10.0.0.2:7788;fipa-services".parse().unwrap(),
                "tcp://10.0.0.3:6789;jade".parse::<Location>().unwrap(),
                "udt://10.0.0.2:1;fipa-services".parse().unwrap(),
            ]
        );
        assert_eq!(entry.description, "");
        assert_eq!(entry.registered, example().registered);
        assert!(!entry.incarnation.is_known());

        let now = UNIX_EPOCH + Duration::from_secs(5);
        let bare = decode("bare", &strings(&[]), now).unwrap();
        assert_eq!(bare.registered, now);
        assert!(decode("", &strings(&[]), now).is_err());
    }

    #[test]
    fn a_udt_location_is_announced_to_legacy_peers() {
        let location = "udt://10.0.0.2:6790#00000000000000ab".parse::<Location>();
        let entry = Entry {
            locations: vec![location.unwrap()],
            ..example()
        };
        let properties = encode(&entry);
        let (_, locator) = &properties[1];
        assert_eq!(
            locator,
            format!("udt://10.0.0.2:6790 {SIGNATURE};").as_bytes()
        );
        // Services of this project do not use it.
        let (_, own) = properties
            .iter()
            .find(|(key, _)| key == "fipa-locations")
            .unwrap();
        assert_eq!(own, b"");
    }

    #[test]
    fn an_agent_with_udt_only_keeps_its_location() {
        let locator = format!("udt://10.0.0.2:1 {SIGNATURE};http://10.0.0.2:2 {SIGNATURE};");
        let entry = read("cpp", &strings(&[("LOCATOR", locator.as_bytes())])).unwrap();
        assert_eq!(
            entry.locations,
            ["udt://10.0.0.2:1;fipa-services".parse().unwrap()]
        );
        assert!(entry.is_unsupported());
    }

    /// fipa_services splits at 200 bytes, at any position.
    #[test]
    fn values_split_by_legacy_peers_are_joined() {
        let location = |number: u16| {
            format!("udt://10.0.0.{number}:1 {SIGNATURE};tcp://10.0.0.{number}:7788 {SIGNATURE};")
        };
        let locator: String = (1..=4).map(location).collect();
        assert!(locator.len() > 400);
        let parts = locator.as_bytes().chunks(200 - "LOCATOR=".len());
        let mut properties: Vec<(&str, &[u8])> = parts.map(|part| ("LOCATOR", part)).collect();
        properties.insert(1, ("TYPE", b"arm"));
        let entry = read("arm", &strings(&properties)).unwrap();
        assert_eq!(entry.agent_type, "arm");
        let addresses = entry.locations.iter().map(|one| one.address().to_owned());
        let addresses: Vec<String> = addresses.collect();
        assert_eq!(
            addresses.join(" "),
            "10.0.0.1:7788 10.0.0.2:7788 10.0.0.3:7788 10.0.0.4:7788 \
             10.0.0.1:1 10.0.0.2:1 10.0.0.3:1 10.0.0.4:1"
        );
    }

    #[test]
    fn invalid_timestamps_are_rejected() {
        let time = millis_of_timestamp;
        assert_eq!(time("19700101-00:00:01"), Some(1000));
        assert_eq!(time("19700101-00:00:01:002999"), Some(1002));
        for bad in [
            "",
            ":::",
            "19700101-00:00:01:",
            "19690101-00:00:00:0",
            "19701301-00:00:00:0",
        ] {
            assert_eq!(time(bad), None, "{bad:?}");
        }
    }

    #[test]
    fn a_record_of_another_gateway_claims_no_name_of_a_platform_agent() {
        let entry = example();
        let own = Entry {
            name: format!("df@{}", entry.mts.shown()).into(),
            ..entry.clone()
        };
        assert_eq!(read("label", &encode(&own)), Ok(own));
        for name in ["df@crex", "ams@crex", "ams-000000ff@crex"] {
            let claim = Entry {
                name: name.into(),
                ..entry.clone()
            };
            let refused = RecordError::Entry(EntryError::Reserved("crex".to_owned()));
            assert_eq!(read("label", &encode(&claim)), Err(refused.clone()));
            // Records of legacy peers name no gateway.
            let bare = read(name, &Vec::new());
            assert_eq!(bare, Err(refused), "{name}");
        }
    }

    #[test]
    fn labels_of_different_names_differ() {
        let long = "x".repeat(100);
        for (one, other) in [
            ("a.b", "a?b"),
            ("a\\b", "a_b"),
            (&*long, &*"x".repeat(101)),
            (&*long, &*"x".repeat(46)),
        ] {
            assert_ne!(label(one, 0, GATEWAY), label(other, 0, GATEWAY));
        }
        assert_ne!(label("arm", 1, GATEWAY), label("arm", 2, GATEWAY));
        assert!(label("arm", 1, GATEWAY).starts_with("arm~"));
        let other = Incarnation::from_u64(8);
        assert_eq!(label("arm", 0, GATEWAY), label("arm", 0, other));
        assert_ne!(label("arm", 1, GATEWAY), label("arm", 1, other));
    }

    #[test]
    fn an_invalid_record_of_this_project_is_rejected() {
        let good = encode(&example());
        for (key, wrong) in [
            ("fipa-version", "2"),
            ("fipa-id", "7"),
            ("fipa-time", "-1"),
            ("fipa-role", "king"),
            ("fipa-locations", "tcp://a b"),
            ("fipa-name", ""),
            ("fipa-name", "a\nb"),
        ] {
            let mut record = good.clone();
            record.retain(|(k, _)| k != key);
            record.push((key.to_owned(), wrong.as_bytes().to_vec()));
            assert!(read("x", &record).is_err(), "{key}={wrong}");
        }
        for missing in ["fipa-id", "fipa-name", "fipa-mts-id", "fipa-time"] {
            let mut record = good.clone();
            record.retain(|(key, _)| key != missing);
            assert_eq!(read("x", &record), Err(RecordError::Missing(missing)));
        }
        let mut endless = good.clone();
        endless.extend((1..100).map(|number| (format!("fipa-mts.{number}"), vec![b'x'; 200])));
        assert_eq!(read("x", &endless), Err(RecordError::TooLong("fipa-mts")));
    }

    #[test]
    fn a_record_of_an_agent_whose_name_is_a_pattern_is_rejected() {
        for pattern in ["arm_.*", "arm_+", "(arm)", "arm|rover"] {
            let mut own = encode(&example());
            own.retain(|(key, _)| key != "fipa-name");
            own.push(("fipa-name".to_owned(), pattern.as_bytes().to_vec()));
            let legacy = strings(&[("LOCATOR", b"tcp://10.0.0.3:6789 JadeProxyAgent")]);
            for (label, record) in [("x", &own), (pattern, &legacy)] {
                let expected = EntryError::Name(NameError::Pattern(pattern.to_owned()));
                assert_eq!(read(label, record), Err(RecordError::Entry(expected)));
            }
        }
    }

    fn any_text(max: usize) -> impl Strategy<Value = String> {
        let chars = prop_oneof![
            4 => any::<char>(),
            1 => prop::sample::select(vec!['.', '?', '\\', ';', ' ', '=', 'é', '\u{1F980}']),
        ];
        prop::collection::vec(chars, 0..max).prop_map(move |chars| {
            let mut text: String = chars.into_iter().filter(|c| !c.is_control()).collect();
            text.truncate(text.floor_char_boundary(max));
            text
        })
    }

    fn any_name() -> impl Strategy<Value = String> {
        any_text(MAX_NAME).prop_filter_map("no name", |mut name| {
            name.retain(|c| !is_unprintable(c) && !is_pattern(c.encode_utf8(&mut [0; 4])));
            check_name(&name).is_ok().then_some(name)
        })
    }

    fn any_location() -> impl Strategy<Value = Location> {
        let kinds = Kind::ALL.into_iter().filter(|kind| !kind.is_host_local());
        let kind = prop::sample::select(kinds.collect::<Vec<_>>());
        let address = "[!-\"$-:<-~é]{1,200}";
        // A record names no encoding of messages to JADE.
        let is_named =
            |it: &Signature| Signature::of_signature_type(it.signature_type()) == Some(*it);
        let signatures = Signature::ALL.into_iter();
        let signatures = signatures.filter(|it| *it == Signature::Frames || is_named(it));
        let signature = prop::sample::select(signatures.collect::<Vec<_>>());
        let parts = (kind, address, signature, any::<u64>());
        parts.prop_map(|(kind, address, signature, incarnation)| {
            let plain = Location::new(kind, &address)
                .unwrap()
                .with_incarnation(Incarnation::from_u64(incarnation));
            plain.clone().with_signature(signature).unwrap_or(plain)
        })
    }

    prop_compose! {
        fn any_entry()(
            name in any_name(),
            agent_type in any_text(Entry::MAX_TYPE),
            incarnation: u64,
            locations in prop::collection::vec(any_location(), 0..=Entry::MAX_LOCATIONS),
            mts_name in any_name(),
            mts: u64,
            description in any_text(Entry::MAX_DESCRIPTION),
            millis: u64,
            gateway: bool,
            members in prop::collection::vec(any_text(200), 0..5),
            led: bool,
            vacant: bool,
        ) -> Entry {
            let mts = MtsId::new(mts_name, Incarnation::from_u64(mts));
            Entry {
                name: name.into(),
                agent_type,
                incarnation: Incarnation::from_u64(incarnation),
                peer: PeerId::of(Principal::Unproved, locations.first()),
                locations,
                reach: Reach::Remote { gateway: mts.incarnation },
                mts,
                description,
                registered: time_of_millis(millis),
                source: Source::Mdns,
                role: match match vacant {
                    true => Members::vacant(members.iter().map(String::as_str)),
                    false => Members::new(
                        members.iter().map(String::as_str),
                        members.first().filter(|_| led).map(|name| name.as_str().into()),
                    ),
                } {
                    Ok(members) => Role::Coalition(members),
                    Err(_) if gateway => Role::Gateway,
                    Err(_) => Role::Agent,
                },
            }
        }
    }

    proptest! {
        #[test]
        fn every_valid_entry_survives_a_round_trip(mut entry in any_entry(), label in any_text(63)) {
            prop_assert_eq!(entry.check(), Ok(()));
            let properties = encode(&entry);
            let mut keys = HashSet::new();
            for (key, value) in &properties {
                prop_assert!(keys.insert(key.to_lowercase()), "{} occurs twice", key);
                prop_assert!(key.len() + 1 + value.len() <= 255);
            }
            // Services of this project learn no location for legacy peers only.
            entry.locations.retain(|location| location.signature() == Signature::Frames);
            entry.peer = PeerId::of(Principal::Unproved, entry.locations.first());
            prop_assert_eq!(read(&label, &properties), Ok(entry));
        }

        #[test]
        fn labels_are_valid_and_reversible(name in any_name(), attempt in 0..3_u32) {
            let label = label(&name, attempt, GATEWAY);
            prop_assert!(!label.is_empty() && label.len() <= MAX_LABEL);
            prop_assert!(!label.contains(['.', '\\']));
            let turned_back = label.replace('?', ".") == name;
            prop_assert!(turned_back || label.contains('~'));
        }

        #[test]
        fn arbitrary_records_decode_to_valid_entries_or_fail(
            label in any_text(63),
            mut properties in prop::collection::vec(
                (
                    prop_oneof![
                        "[ -<>-~]{0,20}",
                        "fipa-(name|id|mts|mts-id|time|locations|role|type)(\\.[0-9]{1,2})?",
                        "TYPE|LOCATOR|DESCRIPTION|TIMESTAMP",
                    ],
                    prop::collection::vec(any::<u8>(), 0..255),
                ),
                0..40,
            ),
            ours: bool,
        ) {
            if ours {
                properties.push(("fipa-version".to_owned(), b"1".to_vec()));
            }
            if let Ok(entry) = read(&label, &properties) {
                prop_assert_eq!(entry.check(), Ok(()));
            }
        }

        #[test]
        fn arbitrary_locators_and_timestamps_do_not_panic(text in any_text(300)) {
            let _ = locations_of_locator(&text);
            let _ = millis_of_timestamp(&text);
        }
    }
}
