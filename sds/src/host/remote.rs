//! The file in which a gateway publishes the agents of other hosts, and the index of it that other
//! processes keep.
//!
//! A process keeps 16 bytes for each agent, however long the agent's texts are, and reads an entry from the
//! open file when the entry is used. The file never changes; the gateway replaces it as a whole, and views that
//! have the earlier one can still read that.
//!
//! The first line is a header in JSON, with the gateway and the locations that most agents have:
//!
//! ```json
//! {"format":"fipa-remote","version":2,"gateway":{"name":"arm-mts","incarnation":"00ab…"},
//!  "locations":["shm://…#00ab…"]}
//! ```
//!
//! One record for each agent follows, sorted by name, and then one for each lost agent. Numbers are in little
//! endian:
//!
//! | bytes | content |
//! |---|---|
//! | 4 | length of the rest of the record |
//! | 8 | incarnation of the registration |
//! | 1 | 1 if lookups of the incarnation find this entry, 2 if the agent is lost |
//! | 2 | length of the name |
//! | … | the name, then the other fields in JSON |
//!
//! A process of the same user writes the file, which does not make it trustworthy: everything is
//! checked. A file whose records cannot be told apart is rejected as a whole, and a record with any other error
//! is left out.

use std::cmp::Ordering;
use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::hash::{BuildHasher as _, RandomState};
use std::io::{self, BufRead as _, BufReader, Read};
use std::os::unix::fs::FileExt;
use std::sync::Arc;

use fipa_acl::{ErrorChain, escape_name};
use fipa_transport::{Incarnation, Location, PeerId, log_limit};
use serde::{Deserialize, Serialize};

use crate::entry::{millis_of_time, time_of_millis};
use crate::view::KeptEntries;
use crate::{Entry, EntryError, MAX_NAME, MtsId, Reach, Role, Source, View, shares};

const FORMAT: &str = "fipa-remote";
const VERSION: u32 = 2;

/// Largest file, in bytes. The exchange, mDNS and contacts bound their agents to less.
pub(super) const MAX_SIZE: usize = 64 * 1024 * 1024;
/// Maximum number of records.
const MAX_RECORDS: usize = 65_536;
/// Maximum length of the header. It has at most [`Entry::MAX_LOCATIONS`] locations.
const MAX_HEADER: usize = 16 * 1024;
/// Bytes of a record before the name, without the length.
const FIXED: usize = 8 + 1 + 2;
/// Maximum length of a record, without the length itself: texts of the maximum length, of which each byte is
/// escaped, and a coalition.
const MAX_RECORD: usize = 64 * 1024;
/// Bytes that a record is charged at least, so that the size bounds the number of records.
const MIN_CHARGE: usize = MAX_SIZE / MAX_RECORDS;

/// Flag of the entry that lookups of its incarnation find.
const HOLDS_REGISTRATION: u8 = 1;
/// Flag of a lost agent.
const LOST: u8 = 2;

/// Number of entries that are kept after they were read.
const KEPT: usize = 256;

#[derive(Serialize, Deserialize)]
struct Header {
    format: String,
    version: u32,
    gateway: MtsId,
    locations: Vec<Location>,
}

/// The fields of an entry that are not before it in its record.
#[derive(Serialize, Deserialize)]
struct Fields {
    #[serde(rename = "type", default, skip_serializing_if = "String::is_empty")]
    agent_type: String,
    mts: MtsId,
    /// `None` if they are those in the header.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    locations: Option<Vec<Location>>,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    description: String,
    registered: u64,
    source: Source,
    peer: PeerId,
    role: Role,
}

/// Writes a file with these agents. Of several with one name or one incarnation, the last one holds that. If
/// they do not fit, each gateway that has sent its agents to this one has a share, and so have the agents from
/// each other source.
pub(super) fn write(gateway: &MtsId, agents: &[Arc<Entry>], lost: &[Arc<Entry>]) -> Vec<u8> {
    let locations = common_locations(agents);
    let mut holders = HashSet::new();
    let mut names: HashMap<&str, (&Entry, u8)> = HashMap::new();
    for entry in agents.iter().rev() {
        if !names.contains_key(&*entry.name) {
            let holds = entry.incarnation.is_known() && holders.insert(entry.incarnation);
            let flags = if holds { HOLDS_REGISTRATION } else { 0 };
            names.insert(&entry.name, (entry, flags));
        }
    }
    let mut present: Vec<(&Entry, u8)> = names.into_values().collect();
    present.sort_unstable_by(|(a, _), (b, _)| a.name.cmp(&b.name));
    let lost = lost.iter().map(|entry| (&**entry, LOST));
    let records: Vec<(List, Vec<u8>)> = present
        .into_iter()
        .chain(lost)
        .filter_map(|(entry, flags)| Some((List::of(entry), record(entry, flags, locations)?)))
        .collect();
    let header = Header {
        format: FORMAT.into(),
        version: VERSION,
        gateway: gateway.clone(),
        locations: locations.to_vec(),
    };
    // Serialization of text, numbers and lists cannot fail.
    let mut bytes = serde_json::to_vec(&header).unwrap_or_default();
    bytes.push(b'\n');
    for record in fitting(records, MAX_SIZE - bytes.len().min(MAX_SIZE)) {
        bytes.extend(record);
    }
    bytes
}

/// Returns the locations that most of these agents have.
fn common_locations(agents: &[Arc<Entry>]) -> &[Location] {
    let mut counts: HashMap<&[Location], usize> = HashMap::new();
    for entry in agents {
        *counts.entry(&entry.locations).or_default() += 1;
    }
    let most = counts.into_iter().max_by_key(|(_, count)| *count);
    most.map_or(&[], |(locations, _)| locations)
}

/// Entries that have one share of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum List {
    /// The agents that this gateway has sent.
    Exchanged(Incarnation),
    /// The agents from another source, which bounds what each peer adds to it.
    Other(Source),
}

impl List {
    fn of(entry: &Entry) -> Self {
        match entry.source {
            Source::Exchange => Self::Exchanged(entry.mts.incarnation),
            source => Self::Other(source),
        }
    }
}

/// Returns the records that fit this number of bytes.
fn fitting(records: Vec<(List, Vec<u8>)>, room: usize) -> impl Iterator<Item = Vec<u8>> {
    let charge = |record: &[u8]| record.len().max(MIN_CHARGE);
    let mut sizes: HashMap<List, usize> = HashMap::new();
    for (list, record) in &records {
        *sizes.entry(*list).or_default() += charge(record);
    }
    let most = shares::level(sizes.values().copied(), room);
    let mut taken: HashMap<List, usize> = HashMap::new();
    records.into_iter().filter_map(move |(list, record)| {
        let taken = taken.entry(list).or_default();
        *taken += charge(&record);
        (*taken <= most).then_some(record)
    })
}

/// Writes a record; `None` if the entry is not within the limits.
fn record(entry: &Entry, flags: u8, locations: &[Location]) -> Option<Vec<u8>> {
    let fields = Fields {
        agent_type: entry.agent_type.clone(),
        mts: entry.mts.clone(),
        locations: (*entry.locations != *locations).then(|| entry.locations.clone()),
        description: entry.description.clone(),
        registered: millis_of_time(entry.registered),
        source: entry.source,
        peer: entry.peer.clone(),
        role: entry.role.clone(),
    };
    let fields = serde_json::to_vec(&fields).ok()?;
    let len = FIXED + entry.name.len() + fields.len();
    let checked = entry.check();
    if checked.is_err() || len > MAX_RECORD {
        let (name, error) = (
            escape_name(&entry.name),
            checked.err().map(|e| e.to_string()),
        );
        tracing::debug!(%name, len, error, "an agent of another host is not published");
        return None;
    }
    let mut record = Vec::with_capacity(4 + len);
    record.extend(u32::try_from(len).ok()?.to_le_bytes());
    record.extend(entry.incarnation.as_u64().to_le_bytes());
    record.push(flags);
    record.extend(u16::try_from(entry.name.len()).ok()?.to_le_bytes());
    record.extend(entry.name.as_bytes());
    record.extend(fields);
    Some(record)
}

/// A source of bytes that does not change.
pub(super) trait ReadAt: Send + Sync {
    fn read_at(&self, buffer: &mut [u8], at: u64) -> io::Result<usize>;
}

impl ReadAt for File {
    fn read_at(&self, buffer: &mut [u8], at: u64) -> io::Result<usize> {
        FileExt::read_at(self, buffer, at)
    }
}

impl ReadAt for Vec<u8> {
    fn read_at(&self, mut buffer: &mut [u8], at: u64) -> io::Result<usize> {
        let at = usize::try_from(at).unwrap_or(usize::MAX);
        io::Write::write(&mut buffer, self.get(at..).unwrap_or_default())
    }
}

/// The agents of other hosts in one file.
pub(super) struct RemoteAgents<F = File> {
    file: F,
    gateway: Incarnation,
    locations: Vec<Location>,
    /// Offset of the first record.
    start: u32,
    /// A peer chooses the names and incarnations of its agents, but not where this hasher puts them.
    hasher: RandomState,
    /// The present agents by the hash of their name, and by that of their incarnation.
    names: Box<[Slot]>,
    registrations: Box<[Slot]>,
    cached: KeptEntries<KEPT>,
    lost: Vec<Arc<Entry>>,
}

/// The position of a record.
#[derive(Debug, Clone, Copy)]
struct Slot {
    hash: u32,
    at: u32,
}

/// One record, as far as its structure is known.
struct Record<'a> {
    at: u32,
    incarnation: Incarnation,
    flags: u8,
    name: &'a str,
    fields: &'a [u8],
}

impl<F: ReadAt> RemoteAgents<F> {
    /// Reads the index of a file.
    pub(super) fn open(file: F) -> Result<Self, RemoteError> {
        let mut start = Vec::new();
        let mut reader = BufReader::new(At { file: &file, at: 0 });
        let header = Read::by_ref(&mut reader).take(MAX_HEADER as u64);
        BufReader::new(header).read_until(b'\n', &mut start)?;
        let header: Header = serde_json::from_slice(&start).map_err(RemoteError::Header)?;
        if header.format != FORMAT || header.version != VERSION {
            return Err(RemoteError::Format(header.format, header.version));
        }
        if header.locations.len() > Entry::MAX_LOCATIONS {
            return Err(RemoteError::Locations(header.locations.len()));
        }
        let mut agents = Self {
            file,
            gateway: header.gateway.incarnation,
            locations: header.locations,
            start: u32::try_from(start.len()).map_err(|_| RemoteError::Structure)?,
            hasher: RandomState::new(),
            names: Box::default(),
            registrations: Box::default(),
            cached: KeptEntries::default(),
            lost: Vec::new(),
        };
        let (mut names, mut registrations, mut lost) = (Vec::new(), Vec::new(), Vec::new());
        let mut records = agents.records();
        let mut last: Option<String> = None;
        while let Some(record) = records.next()? {
            if names.len() + lost.len() >= MAX_RECORDS {
                return Err(RemoteError::TooMany);
            }
            if record.flags & LOST != 0 {
                lost.extend(agents.entry(&record));
                continue;
            }
            if last.as_deref().is_some_and(|last| last >= record.name) {
                return Err(RemoteError::Order(record.name.to_owned()));
            }
            let last = last.get_or_insert_default();
            last.clear();
            last.push_str(record.name);
            names.push(agents.slot(record.name, record.at));
            if record.flags & HOLDS_REGISTRATION != 0 {
                registrations.push(agents.slot(&record.incarnation, record.at));
            }
        }
        names.sort_unstable_by_key(|slot| slot.hash);
        registrations.sort_unstable_by_key(|slot| slot.hash);
        agents.names = names.into();
        agents.registrations = registrations.into();
        agents.lost = lost;
        Ok(agents)
    }

    /// Returns the lost agents.
    pub(super) fn lost_agents(&self) -> &[Arc<Entry>] {
        &self.lost
    }

    fn slot<K: std::hash::Hash + ?Sized>(&self, key: &K, at: u32) -> Slot {
        Slot {
            // The upper half is as good as the lower one.
            hash: (self.hasher.hash_one(key) >> 32) as u32,
            at,
        }
    }

    /// Returns the entry that `is_it` selects among those at these slots with the hash of the key.
    fn find<K: std::hash::Hash + ?Sized>(
        &self,
        slots: &[Slot],
        key: &K,
        is_it: impl Fn(&Record<'_>) -> bool,
    ) -> Option<Arc<Entry>> {
        let hash = self.slot(key, 0).hash;
        let first = slots.partition_point(|slot| slot.hash < hash);
        let same = slots
            .get(first..)?
            .iter()
            .take_while(|slot| slot.hash == hash);
        same.copied().find_map(|slot| {
            let mut buffer = Vec::new();
            let record = self.record_at(slot.at, &mut buffer);
            let record = record.unwrap_or_else(|error| {
                log_limit::error!(error = %ErrorChain(&error), "cannot read an agent of another host");
                None
            })?;
            is_it(&record).then(|| self.entry(&record)).flatten()
        })
    }

    /// Reads the record at this offset; `None` at the end of the file.
    fn record_at<'a>(
        &self,
        at: u32,
        buffer: &'a mut Vec<u8>,
    ) -> Result<Option<Record<'a>>, RemoteError> {
        // Most records are shorter, so one system call reads them.
        const MOST: usize = 1024;
        let mut reader = At {
            file: &self.file,
            at: at.into(),
        };
        buffer.resize(MOST, 0);
        let read = reader.read(buffer)?;
        buffer.truncate(read);
        if let Some(len) = len_of(buffer)?
            && let Some(rest) = (4 + len).checked_sub(read)
        {
            reader.take(rest as u64).read_to_end(buffer)?;
        }
        parse(at, buffer)
    }

    fn records(&self) -> Records<'_, F> {
        Records {
            reader: BufReader::with_capacity(
                64 * 1024,
                At {
                    file: &self.file,
                    at: self.start.into(),
                },
            ),
            at: self.start,
            buffer: Vec::new(),
        }
    }

    /// Returns the entry of a record, if it is valid.
    fn entry(&self, record: &Record<'_>) -> Option<Arc<Entry>> {
        let read = || -> Result<Entry, RecordError> {
            let fields: Fields = serde_json::from_slice(record.fields)?;
            let entry = Entry {
                name: record.name.into(),
                agent_type: fields.agent_type,
                incarnation: record.incarnation,
                locations: fields.locations.unwrap_or_else(|| self.locations.clone()),
                mts: fields.mts,
                description: fields.description,
                registered: time_of_millis(fields.registered),
                source: fields.source,
                reach: Reach::Remote {
                    gateway: self.gateway,
                },
                peer: fields.peer,
                role: fields.role,
            };
            entry.check()?;
            Ok(entry)
        };
        match read() {
            Ok(entry) => Some(Arc::new(entry)),
            Err(error) => {
                let name = escape_name(record.name);
                log_limit::error!(%name, error = %ErrorChain(&error), "an agent of another host is ignored");
                None
            }
        }
    }
}

impl<F: ReadAt> View for RemoteAgents<F> {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        let place = self.slot(name, 0).hash as usize;
        let is_kept = |entry: &Entry| *entry.name == *name;
        self.cached.get_or(place, is_kept, || {
            self.find(&self.names, name, |record| record.name == name)
        })
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.find(&self.registrations, &incarnation, |record| {
            record.incarnation == incarnation
        })
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        let mut all = Vec::with_capacity(self.names.len());
        let mut records = self.records();
        let mut read = || -> Result<(), RemoteError> {
            while let Some(record) = records.next()? {
                if record.flags & LOST == 0 {
                    all.extend(self.entry(&record));
                }
            }
            Ok(())
        };
        if let Err(error) = read() {
            log_limit::error!(error = %ErrorChain(&error), "cannot read the agents of other hosts");
        }
        all.into()
    }
}

impl<F> std::fmt::Debug for RemoteAgents<F> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RemoteAgents")
            .field("gateway", &self.gateway)
            .field("agents", &self.names.len())
            .finish_non_exhaustive()
    }
}

/// Returns the names whose entries differ in two files, at most `most`; `None` if there are more.
pub(super) fn changed<F: ReadAt>(
    before: Option<&RemoteAgents<F>>,
    after: Option<&RemoteAgents<F>>,
    most: usize,
) -> Result<Option<Vec<Arc<str>>>, RemoteError> {
    // Records with default locations differ when those do.
    let same_header = match (before, after) {
        (Some(one), Some(two)) => (&one.locations, one.gateway) == (&two.locations, two.gateway),
        _ => true,
    };
    let mut olds = before.map(RemoteAgents::records);
    let mut news = after.map(RemoteAgents::records);
    let mut names: Vec<Arc<str>> = Vec::new();
    let (mut step_old, mut step_new) = (true, true);
    loop {
        let old = step(olds.as_mut(), step_old)?;
        let new = step(news.as_mut(), step_new)?;
        let order = match (&old, &new) {
            (None, None) => return Ok(Some(names)),
            (Some(_), None) => Ordering::Less,
            (None, Some(_)) => Ordering::Greater,
            (Some(old), Some(new)) => old.name.cmp(new.name),
        };
        (step_old, step_new) = (order.is_le(), order.is_ge());
        let (Some(one), other) = (match order {
            Ordering::Less => (old, None),
            _ => (new, old.filter(|_| order.is_eq())),
        }) else {
            return Ok(Some(names));
        };
        let is_same = other.is_some_and(|other| {
            same_header && (one.incarnation, one.fields) == (other.incarnation, other.fields)
        });
        if !is_same {
            if names.len() >= most {
                return Ok(None);
            }
            names.push(one.name.into());
        }
    }
}

/// Returns the next present agent, or the latest again.
fn step<'a, F: ReadAt>(
    records: Option<&'a mut Records<'_, F>>,
    forward: bool,
) -> Result<Option<Record<'a>>, RemoteError> {
    let Some(records) = records else {
        return Ok(None);
    };
    let record = match forward {
        true => records.next()?,
        false => records.latest()?,
    };
    Ok(record.filter(|record| record.flags & LOST == 0))
}

/// Reads the records of a file in order.
struct Records<'a, F> {
    reader: BufReader<At<'a, F>>,
    /// Offset of the next record.
    at: u32,
    /// The latest record.
    buffer: Vec<u8>,
}

impl<F: ReadAt> Records<'_, F> {
    fn next(&mut self) -> Result<Option<Record<'_>>, RemoteError> {
        let read = u32::try_from(self.buffer.len()).map_err(|_| RemoteError::Structure)?;
        self.at = self.at.checked_add(read).ok_or(RemoteError::Structure)?;
        self.buffer.clear();
        let reader = &mut self.reader;
        reader.by_ref().take(4).read_to_end(&mut self.buffer)?;
        if let Some(len) = len_of(&self.buffer)? {
            reader
                .by_ref()
                .take(len as u64)
                .read_to_end(&mut self.buffer)?;
        }
        self.latest()
    }

    fn latest(&self) -> Result<Option<Record<'_>>, RemoteError> {
        parse(self.at, &self.buffer)
    }
}

/// Returns the length in the first bytes of a record; `None` at the end of the file.
fn len_of(bytes: &[u8]) -> Result<Option<usize>, RemoteError> {
    match bytes.first_chunk() {
        Some(len) => match usize::try_from(u32::from_le_bytes(*len)) {
            Ok(len @ FIXED..=MAX_RECORD) => Ok(Some(len)),
            _ => Err(RemoteError::Structure),
        },
        None if bytes.is_empty() => Ok(None),
        None => Err(RemoteError::Structure),
    }
}

/// Parses the record at the start of the bytes; `None` if there are none.
fn parse(at: u32, bytes: &[u8]) -> Result<Option<Record<'_>>, RemoteError> {
    let Some(len) = len_of(bytes)? else {
        return Ok(None);
    };
    let parts = || {
        let record = bytes.get(4..4 + len)?;
        let (incarnation, rest) = record.split_first_chunk()?;
        let (flags, rest) = rest.split_first()?;
        let (name_len, rest) = rest.split_first_chunk()?;
        let name_len = usize::from(u16::from_le_bytes(*name_len));
        let (name, fields) = rest.split_at_checked(name_len)?;
        Some(Record {
            at,
            incarnation: Incarnation::from_u64(u64::from_le_bytes(*incarnation)),
            flags: *flags,
            name: std::str::from_utf8(name)
                .ok()
                .filter(|name| name.len() <= MAX_NAME)?,
            fields,
        })
    };
    parts().map(Some).ok_or(RemoteError::Structure)
}

/// Reads from an offset on. The position of the file itself is not used, because several readers share it.
struct At<'a, F> {
    file: &'a F,
    at: u64,
}

impl<F: ReadAt> Read for At<'_, F> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let room = (MAX_SIZE as u64).saturating_sub(self.at);
        let most = buffer
            .len()
            .min(usize::try_from(room).unwrap_or(usize::MAX));
        let read = self
            .file
            .read_at(buffer.get_mut(..most).unwrap_or_default(), self.at)?;
        self.at += read as u64;
        Ok(read)
    }
}

/// Error of a file with agents of other hosts.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(super) enum RemoteError {
    #[error("cannot read")]
    Io(#[from] io::Error),
    #[error("malformed header")]
    Header(#[source] serde_json::Error),
    #[error(
        "the format is {0:?} in version {1}, expected {FORMAT:?} in version {VERSION}; use the same \
         release in all processes"
    )]
    Format(String, u32),
    #[error("{0} locations; at most {max} are allowed", max = Entry::MAX_LOCATIONS)]
    Locations(usize),
    #[error("the records cannot be told apart")]
    Structure,
    #[error("the name {0:?} is not in order")]
    Order(String),
    #[error("more than {MAX_RECORDS} records")]
    TooMany,
}

/// Error of one record.
#[derive(Debug, thiserror::Error)]
enum RecordError {
    #[error("malformed")]
    Json(#[from] serde_json::Error),
    #[error("not valid")]
    Entry(#[from] EntryError),
}

/// The agents in the files of several gateways. Two run only while one takes over.
#[derive(Debug)]
pub(super) struct RemoteLists(pub(super) Vec<Arc<RemoteAgents>>);

impl View for RemoteLists {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        let claims = self.0.iter().filter_map(|agents| agents.named(name));
        claims.reduce(first)
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let mut found = self
            .0
            .iter()
            .filter_map(|agents| agents.registered(incarnation));
        found.find(|entry| self.named(&entry.name).as_ref() == Some(entry))
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        if let [agents] = &*self.0 {
            return agents.all();
        }
        let mut holders: std::collections::BTreeMap<Arc<str>, Arc<Entry>> = Default::default();
        for entry in self.0.iter().flat_map(|agents| agents.all().to_vec()) {
            let holder = match holders.remove(&entry.name) {
                Some(other) => first(other, entry),
                None => entry,
            };
            holders.insert(Arc::clone(&holder.name), holder);
        }
        holders.into_values().collect()
    }
}

/// Returns the entry that holds the name that both claim.
fn first(one: Arc<Entry>, other: Arc<Entry>) -> Arc<Entry> {
    match other.precedes(&one) {
        true => other,
        false => one,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn entry(gateway: u64, name: &str, text: &str) -> Arc<Entry> {
        Arc::new(Entry {
            name: name.into(),
            agent_type: text.to_owned(),
            incarnation: Incarnation::from_u64(7),
            locations: vec!["shm://1#0000000000000001".parse().unwrap()],
            mts: MtsId::new("mts", Incarnation::from_u64(gateway)),
            description: text.to_owned(),
            registered: std::time::UNIX_EPOCH,
            source: Source::Exchange,
            reach: Reach::Remote {
                gateway: Incarnation::from_u64(1),
            },
            peer: PeerId::of_ip(std::net::Ipv4Addr::from(gateway as u32).into()),
            role: Role::Agent,
        })
    }

    fn written(agents: &[Arc<Entry>], lost: &[Arc<Entry>]) -> Vec<u8> {
        let mts = MtsId::new("gateway", Incarnation::from_u64(1));
        write(&mts, agents, lost)
    }

    fn open(bytes: Vec<u8>) -> RemoteAgents<Vec<u8>> {
        RemoteAgents::open(bytes).unwrap()
    }

    fn agents() -> impl Strategy<Value = Vec<Arc<Entry>>> {
        let one = (1..4_u64, 0..30_u8, "[a\"ü]{0,5}|x{900,1000}", 0..3_u8);
        let one = one.prop_map(|(gateway, name, text, kind)| {
            let mut one = Entry::clone(&entry(gateway, &format!("agent-{name}"), ""));
            one.description.clone_from(&text);
            one.incarnation = Incarnation::from_u64(u64::from(name) / 2);
            match kind {
                0 => one.locations = Vec::new(),
                1 => one.source = Source::Contact,
                _ => {}
            }
            Arc::new(one)
        });
        prop::collection::vec(one, 0..40)
    }

    proptest! {
        #[test]
        fn lookups_find_what_was_written(all in agents(), lost in agents()) {
            let read = open(written(&all, &lost));
            prop_assert_eq!(read.lost_agents(), lost);
            let mut names = std::collections::BTreeMap::new();
            for entry in &all {
                names.insert(entry.name.clone(), entry.clone());
            }
            let expected: Vec<Arc<Entry>> = names.values().cloned().collect();
            prop_assert_eq!(&*read.all(), &*expected);
            for number in 0..31 {
                let name = format!("agent-{number}");
                let expected = names.get(&*name).cloned();
                // Twice: the second time it may be kept.
                prop_assert_eq!(read.named(&name), expected.clone());
                prop_assert_eq!(read.named(&name), expected);
                let incarnation = Incarnation::from_u64(number);
                let of = |it: &&Arc<Entry>| it.incarnation == incarnation && number > 0;
                let mut holders = all.iter().rev();
                let holder = holders.find(of).and_then(|it| names.get(&it.name).cloned());
                prop_assert_eq!(read.registered(incarnation), holder);
            }
        }

        #[test]
        fn changes_are_those_of_the_lists(before in agents(), after in agents()) {
            let (old, new) = (open(written(&before, &[])), open(written(&after, &before)));
            let mut expected: Vec<Arc<str>> = Vec::new();
            for number in 0..30 {
                let name = format!("agent-{number}");
                if old.named(&name) != new.named(&name) {
                    expected.push(name.into());
                }
            }
            expected.sort();
            let count = expected.len();
            let found = changed(Some(&old), Some(&new), 100).unwrap().unwrap();
            // Locations that moved to or from the header may be reported without a change.
            prop_assert!(expected.iter().all(|name| found.contains(name)));
            if old.locations == new.locations {
                prop_assert_eq!(found, expected);
                if count > 0 {
                    prop_assert!(changed(Some(&old), Some(&new), count - 1).unwrap().is_none());
                }
            }
            let all = changed(None, Some(&new), 100).unwrap().unwrap();
            prop_assert_eq!(all.len(), new.all().len());
            let all = changed(Some(&old), None, 100).unwrap().unwrap();
            prop_assert_eq!(all.len(), old.all().len());
        }

        #[test]
        fn damaged_files_are_errors_or_lack_agents(
            all in agents(), at in any::<prop::sample::Index>(), byte in any::<u8>(), cut in any::<bool>(),
        ) {
            let mut bytes = written(&all, &all);
            let at = at.index(bytes.len());
            bytes[at] = byte;
            if cut {
                bytes.truncate(at);
            }
            if let Ok(read) = RemoteAgents::open(bytes) {
                for entry in read.all().iter() {
                    prop_assert!(entry.check().is_ok());
                }
                prop_assert!(read.named("agent-1").is_none_or(|it| *it.name == *"agent-1"));
            }
        }
    }

    #[test]
    fn a_long_list_leaves_the_others_complete() {
        let list = |gateway: u64, count: usize| {
            let record = vec![0; MIN_CHARGE];
            let list = List::Exchanged(Incarnation::from_u64(gateway));
            vec![(list, record); count]
        };
        let all = [list(1, 500), list(2, 10), list(3, 300), list(4, 10)].concat();
        let fitted: Vec<_> = fitting(all.clone(), 110 * MIN_CHARGE).collect();
        assert_eq!(fitted.len(), 45 + 10 + 45 + 10);
        assert_eq!(fitting(all, 820 * MIN_CHARGE).count(), 820);
    }

    #[test]
    fn an_entry_that_is_not_valid_is_left_out_alone() {
        let bad = entry(2, "bad", "two\nlines");
        let read = open(written(&[entry(2, "a", ""), bad, entry(2, "b", "")], &[]));
        assert_eq!(read.all().len(), 2);
        let long = "\"".repeat(Entry::MAX_DESCRIPTION);
        let longest = Entry {
            name: "n".repeat(MAX_NAME).into(),
            agent_type: long[..Entry::MAX_TYPE].to_owned(),
            description: long,
            locations: vec!["shm://ffffffffffffffff#ffffffffffffffff".parse().unwrap(); 8],
            ..Entry::clone(&entry(2, "", ""))
        };
        let longest = Arc::new(longest);
        let read = open(written(&[entry(2, "a", ""), Arc::clone(&longest)], &[]));
        assert_eq!(read.named(&longest.name), Some(longest));
    }
}
