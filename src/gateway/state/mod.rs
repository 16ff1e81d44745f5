//! The state of a gateway that a successor takes over after a crash: `<domain>/gateway.state`.
//!
//! The file has one JSON object in each line. The first one is the [`Head`], each other one an [`Item`].
//! It holds what agents told the gateway and do not tell again: their descriptions, the subscriptions of
//! agents of platforms such as JADE, and the agents that are known by a letter only. Custody, connections
//! and trust are not in it.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File};
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::ErrorChain;
use fipa_platform::{Platform, StoredDescription, StoredSubscription};
use fipa_sds::{ContactDirectory, Directory, Entry, Watch};
use fipa_transport::{DomainUsers, Incarnation, Location, Principal, Signature, log_limit};
use parking_lot::Mutex;
use rustix::fs::OFlags;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};
use tokio::runtime::Handle;
use tokio::sync::Notify;

use super::neighbors::Neighbors;
use crate::domain::background;
use crate::domain::files::DomainDir;

const VERSION: u32 = 1;

/// Maximum length of the file. What does not fit is left out; see [`encode`].
const MAX_BYTES: usize = 4 << 20;

/// Minimum time between two versions of the file.
const PAUSE: Duration = Duration::from_millis(100);

/// Writing takes at most one part in this many of the time, so that changes that a peer causes all the
/// time do not keep the host busy.
const SHARE: u32 = 10;

/// The first line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Head {
    version: u32,
    /// The boot identifier of the kernel.
    boot: String,
    /// The time since the host started, in milliseconds, including the time in which it slept.
    written: u64,
    /// Whether peers prove their identity.
    has_keys: bool,
    /// The number of further lines.
    items: usize,
}

/// A further line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Item {
    /// A description in the agent management system.
    Agent(StoredDescription),
    /// A description in the directory facilitator.
    Description(StoredDescription),
    Subscription(StoredSubscription),
    Contact(KeptContact),
}

/// An agent of another host that is known by a letter, by an introduction, or as a subscriber.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct KeptContact {
    name: Arc<str>,
    agent: u64,
    location: String,
    /// Its further locations.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    further: Vec<String>,
    /// The certificate of the gateway of the agent.
    certificate: Option<[u8; 32]>,
}

impl Item {
    /// The platforms take turns when not all items have room. Agents of this host come first, and
    /// contacts come last because letters make them again.
    fn owner(&self) -> Owner {
        match self {
            Self::Agent(description) | Self::Description(description) => {
                description.platform.into()
            }
            Self::Subscription(subscription) => subscription.platform.into(),
            Self::Contact(_) => Owner::Contacts,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Owner {
    ThisHost,
    Platform(Platform),
    Contacts,
}

impl From<Platform> for Owner {
    fn from(platform: Platform) -> Self {
        match platform {
            Platform::Host => Self::ThisHost,
            other => Self::Platform(other),
        }
    }
}

/// The error of a file that a successor cannot use.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
enum StateError {
    #[error("the file is longer than {MAX_BYTES} bytes")]
    TooLong,
    #[error("the file has no first line")]
    Empty,
    #[error("version {0} is not supported")]
    Version(u32),
    #[error("the file has {found} items instead of {expected}")]
    Incomplete { expected: usize, found: usize },
    #[error("line {line} cannot be read")]
    Line {
        line: usize,
        source: serde_json::Error,
    },
}

/// Returns the lines of these items, as many as there is room for after the head. Agents of this host come
/// first, then those of the platforms in turn, then contacts.
fn lines(items: &[Item], room: usize) -> Vec<String> {
    let mut waiting: BTreeMap<Owner, VecDeque<String>> = BTreeMap::new();
    for item in items {
        if let Ok(line) = serde_json::to_string(item) {
            waiting.entry(item.owner()).or_default().push_back(line);
        }
    }
    let (mut lines, mut bytes_left) = (Vec::new(), room);
    let mut take = |line: String| {
        let fits = line.len() < bytes_left;
        if fits {
            bytes_left -= line.len() + 1;
            lines.push(line);
        }
        fits
    };
    let of_this_host = waiting.remove(&Owner::ThisHost);
    let contacts = waiting.remove(&Owner::Contacts);
    for line in of_this_host.into_iter().flatten() {
        take(line);
    }
    while !waiting.is_empty() {
        waiting.retain(|_, lines| lines.pop_front().is_some_and(&mut take));
    }
    for line in contacts.into_iter().flatten() {
        take(line);
    }
    lines
}

/// Returns the bytes of a file.
fn encode(head: &Head, lines: &[String]) -> Vec<u8> {
    let mut bytes = serde_json::to_vec(head).unwrap_or_default();
    bytes.push(b'\n');
    for line in lines {
        bytes.extend_from_slice(line.as_bytes());
        bytes.push(b'\n');
    }
    bytes
}

/// Reads the bytes of a file.
fn decode(bytes: &[u8]) -> Result<(Head, Vec<Item>), StateError> {
    if bytes.len() > MAX_BYTES {
        return Err(StateError::TooLong);
    }
    let mut lines = bytes.split(|byte| *byte == b'\n');
    let head = lines.next().filter(|line| !line.is_empty());
    let head = head.ok_or(StateError::Empty)?;
    let failed = |line| move |source| StateError::Line { line, source };
    // Another version may have another head.
    #[derive(Deserialize)]
    struct Versioned {
        version: u32,
    }
    let Versioned { version } = serde_json::from_slice(head).map_err(failed(1))?;
    if version != VERSION {
        return Err(StateError::Version(version));
    }
    let head: Head = serde_json::from_slice(head).map_err(failed(1))?;
    let items = lines.zip(2..).filter(|(line, _)| !line.is_empty());
    let items = items.map(|(line, number)| serde_json::from_slice(line).map_err(failed(number)));
    let items = items.collect::<Result<Vec<Item>, _>>()?;
    match items.len() == head.items {
        true => Ok((head, items)),
        false => Err(StateError::Incomplete {
            expected: head.items,
            found: items.len(),
        }),
    }
}

/// The items of a predecessor, sorted by what they are for.
#[derive(Debug, Default)]
pub(super) struct Predecessor {
    pub(super) agents: Vec<StoredDescription>,
    pub(super) descriptions: Vec<StoredDescription>,
    pub(super) subscriptions: Vec<StoredSubscription>,
    contacts: Vec<KeptContact>,
    /// Time since the file was written.
    pub(super) elapsed: Duration,
    had_keys: bool,
}

impl Predecessor {
    fn new(head: &Head, items: Vec<Item>, now: u64) -> Self {
        let mut all = Self {
            elapsed: Duration::from_millis(now.saturating_sub(head.written)),
            had_keys: head.has_keys,
            ..Self::default()
        };
        for item in items {
            match item {
                Item::Agent(agent) => all.agents.push(agent),
                Item::Description(description) => all.descriptions.push(description),
                Item::Subscription(subscription) => all.subscriptions.push(subscription),
                Item::Contact(contact) => all.contacts.push(contact),
            }
        }
        all
    }

    /// Whether what a platform left here may be taken over.
    pub(super) fn stays(&self, platform: Platform, trust: &Trust) -> bool {
        match platform {
            Platform::Host => true,
            Platform::Proved(certificate) => trust.trusts(certificate),
            // Without keys, such a platform may have been any.
            Platform::Unproved => self.had_keys == trust.has_keys(),
        }
    }

    /// Returns the contacts that may be taken over.
    fn contacts(&self, trust: &Trust) -> impl Iterator<Item = (&KeptContact, Location)> {
        let contacts = self.contacts.iter().filter_map(|contact| {
            let location: Location = contact.location.parse().ok()?;
            let is_legacy = location.signature() != Signature::Frames;
            let stays = match contact.certificate {
                Some(certificate) => trust.trusts(certificate),
                None => is_legacy || !trust.has_keys(),
            };
            stays.then_some((contact, location))
        });
        contacts.take(ContactDirectory::MAX_CONTACTS)
    }
}

/// The certificates that this gateway trusts now.
#[derive(Clone, Default)]
pub(super) struct Trust {
    #[cfg(feature = "secure")]
    security: Option<fipa_transport_net::secure::Security>,
}

impl Trust {
    #[cfg(feature = "secure")]
    pub(super) fn new(security: Option<fipa_transport_net::secure::Security>) -> Self {
        Self { security }
    }

    #[cfg(feature = "secure")]
    fn trusts(&self, certificate: [u8; 32]) -> bool {
        let security = self.security.as_ref();
        security.is_some_and(|security| security.trusts(certificate.into()))
    }

    #[cfg(not(feature = "secure"))]
    fn trusts(&self, _: [u8; 32]) -> bool {
        false
    }

    fn has_keys(&self) -> bool {
        #[cfg(feature = "secure")]
        return self.security.is_some();
        #[cfg(not(feature = "secure"))]
        return false;
    }
}

/// The state that the agents of this gateway keep at present.
#[derive(Debug, Clone, Default)]
struct CurrentState {
    agents: Arc<[StoredDescription]>,
    descriptions: Arc<[StoredDescription]>,
    subscriptions: Arc<[StoredSubscription]>,
    /// The time of each of the two parts: their leases are relative to it.
    agents_at: Option<Instant>,
    facilitator_at: Option<Instant>,
}

/// The writer of the file.
pub(super) struct StateFile {
    path: PathBuf,
    boot: String,
    trust: Trust,
    view: Arc<dyn Directory>,
    contacts: Arc<ContactDirectory>,
    neighbors: Arc<Neighbors>,
    current: Mutex<CurrentState>,
    changed: Notify,
    /// The lines in the file; `None` after the end of the gateway.
    written: Mutex<Option<Vec<String>>>,
}

impl StateFile {
    pub(super) fn new(
        dir: &DomainDir,
        trust: Trust,
        view: Arc<dyn Directory>,
        contacts: Arc<ContactDirectory>,
        neighbors: Arc<Neighbors>,
    ) -> Self {
        let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id");
        Self {
            path: dir.part(DomainDir::STATE),
            boot: boot.unwrap_or_default().trim().to_owned(),
            trust,
            view,
            contacts,
            neighbors,
            current: Mutex::default(),
            changed: Notify::new(),
            written: Mutex::new(Some(Vec::new())),
        }
    }

    /// Reads the file of a predecessor, and takes over its contacts. A file from before the host
    /// started is ignored.
    pub(super) fn take_over(&self) -> Predecessor {
        let read = match read(&self.path) {
            Ok(None) => return Predecessor::default(),
            Ok(Some(bytes)) => decode(&bytes).map_err(|error| ErrorChain(&error).to_string()),
            Err(error) => Err(error.to_string()),
        };
        let (head, items) = match read {
            Ok(read) => read,
            Err(error) => {
                log_limit::warn!(
                    error, path = %self.path.display(),
                    "cannot read what the last gateway of this domain kept: agents whose services are \
                     missing in the directory facilitator have to register them again"
                );
                return Predecessor::default();
            }
        };
        let now = boot_time();
        if head.boot != self.boot || head.written > now {
            return Predecessor::default();
        }
        let predecessor = Predecessor::new(&head, items, now);
        // The first version of this gateway must not have less.
        let at = Instant::now().checked_sub(predecessor.elapsed);
        *self.current.lock() = CurrentState {
            agents: predecessor.agents.clone().into(),
            descriptions: predecessor.descriptions.clone().into(),
            subscriptions: predecessor.subscriptions.clone().into(),
            agents_at: at,
            facilitator_at: at,
        };
        for (contact, location) in predecessor.contacts(&self.trust) {
            let agent = Incarnation::from_u64(contact.agent);
            let now = Instant::now();
            let further = contact.further.iter().filter_map(|it| it.parse().ok());
            let further: Vec<Location> = further.take(Entry::MAX_LOCATIONS - 1).collect();
            let recorded = match further.is_empty() {
                true => self
                    .contacts
                    .record_sender(now, &contact.name, agent, location),
                false => {
                    let all = std::iter::once(location).chain(further).collect();
                    self.contacts.introduce(now, &contact.name, all, false)
                }
            };
            if let Err(error) = recorded {
                tracing::debug!(error = %ErrorChain(&error), "ignored a contact of the last gateway");
            }
        }
        predecessor
    }

    /// Whether what a platform left at the predecessor may be taken over.
    pub(super) fn stays(&self, predecessor: &Predecessor, platform: Platform) -> bool {
        predecessor.stays(platform, &self.trust)
    }

    /// Sets what the agent management system keeps.
    pub(super) fn set_agents(&self, now: Instant, agents: Vec<StoredDescription>) {
        let mut current = self.current.lock();
        (current.agents, current.agents_at) = (agents.into(), Some(now));
        self.pin(&current);
        self.changed.notify_one();
    }

    /// Sets what the directory facilitator keeps.
    pub(super) fn set_services(
        &self,
        now: Instant,
        (descriptions, subscriptions): (Vec<StoredDescription>, Vec<StoredSubscription>),
    ) {
        let mut current = self.current.lock();
        (current.descriptions, current.subscriptions) = (descriptions.into(), subscriptions.into());
        current.facilitator_at = Some(now);
        self.pin(&current);
        self.changed.notify_one();
    }

    /// Keeps the contacts that have left a description or a subscription here.
    fn pin(&self, current: &CurrentState) {
        let descriptions = current.agents.iter().chain(&*current.descriptions);
        let names = descriptions.map(|it| &it.name);
        let names = names.chain(current.subscriptions.iter().map(|it| &it.name));
        self.contacts.pin(names.cloned().collect());
    }

    /// Writes the file after changes, until the directory ends.
    pub(super) async fn run(self: Arc<Self>) {
        let mut contacts: Watch = self.contacts.watch();
        loop {
            let began = Instant::now();
            let writer = Arc::clone(&self);
            let runtime = Handle::current();
            let written = background::try_run(&runtime, move |_| writer.write());
            if let Err(error) = written.await {
                log_limit::warn!(%error, "cannot write the state of the gateway; trying again");
                self.changed.notify_one();
            }
            tokio::time::sleep(PAUSE.max(began.elapsed() * (SHARE - 1))).await;
            tokio::select! {
                () = self.changed.notified() => {}
                change = contacts.next() => if change.is_none() {
                    return;
                },
            }
            while contacts.try_next().is_some() {}
        }
    }

    /// Writes the file if something has changed. Blocks.
    pub(super) fn write(&self) {
        // Before the items are read, so that a writer that is late does not replace later ones.
        let mut written = self.written.lock();
        let items = self.items(Instant::now());
        let mut head = Head {
            version: VERSION,
            boot: self.boot.clone(),
            written: boot_time(),
            has_keys: self.trust.has_keys(),
            items: usize::MAX,
        };
        let room = MAX_BYTES - encode(&head, &[]).len();
        let lines = lines(&items, room);
        match &*written {
            None => return,
            Some(written) if *written == lines && self.path.exists() => return,
            Some(_) => {}
        }
        if lines.len() < items.len() {
            log_limit::warn!(
                "{} of {} descriptions, subscriptions and contacts of this gateway have no room in {}, and \
                 would be lost with the gateway",
                items.len() - lines.len(),
                items.len(),
                self.path.display()
            );
        }
        head.items = lines.len();
        let new = self.path.with_file_name(DomainDir::NEXT_STATE);
        match replace(&self.path, &new, &encode(&head, &lines)) {
            Ok(()) => *written = Some(lines),
            Err(error) => log_limit::warn!(
                %error, path = %self.path.display(),
                "cannot keep the descriptions of services for the next gateway of this domain"
            ),
        }
    }

    /// Ends the use of the file, which a process that leaves the domain may remove from then on. Blocks for a
    /// write that has begun.
    pub(super) fn close(&self) {
        *self.written.lock() = None;
    }

    /// Returns the items, with the leases from `now` on.
    fn items(&self, now: Instant) -> Vec<Item> {
        let current = self.current.lock().clone();
        let aged = |stored: &StoredDescription, at: Option<Instant>| {
            let passed = at.map(|at| now.saturating_duration_since(at).as_millis());
            let passed = u64::try_from(passed.unwrap_or(0)).unwrap_or(u64::MAX);
            let mut stored = stored.clone();
            stored.lease_left = stored
                .lease_left
                .map(|lease_left| lease_left.saturating_sub(passed));
            stored
        };
        let agents = current.agents.iter();
        let agents = agents.map(|it| Item::Agent(aged(it, current.agents_at)));
        let services = current.descriptions.iter();
        let services = services.map(|it| Item::Description(aged(it, current.facilitator_at)));
        let subscriptions = current
            .subscriptions
            .iter()
            .cloned()
            .map(Item::Subscription);
        let mut items: Vec<Item> = agents.chain(subscriptions).chain(services).collect();
        // A subscriber that a directory shows is unknown to a successor until that directory arrives.
        let mut known: BTreeMap<Arc<str>, Arc<Entry>> = BTreeMap::new();
        for it in &*current.subscriptions {
            let entry = self
                .view
                .lookup(&it.name)
                .filter(|entry| !entry.incarnation.is_known());
            known.extend(entry.map(|entry| (Arc::clone(&entry.name), entry)));
        }
        let contacts = self.contacts.entries();
        known.extend(
            contacts
                .iter()
                .map(|it| (Arc::clone(&it.name), Arc::clone(it))),
        );
        items.extend(known.values().filter_map(|entry| self.contact(entry)));
        items
    }

    fn contact(&self, entry: &Entry) -> Option<Item> {
        let certificate = match self.neighbors.principal(entry.mts.incarnation) {
            Some(Principal::Certificate(certificate)) => Some(certificate),
            _ => None,
        };
        Some(Item::Contact(KeptContact {
            name: Arc::clone(&entry.name),
            agent: entry.incarnation.as_u64(),
            location: entry.locations.first()?.to_string(),
            further: entry
                .locations
                .iter()
                .skip(1)
                .map(ToString::to_string)
                .collect(),
            certificate,
        }))
    }
}

/// Returns the time since the host started, in milliseconds.
fn boot_time() -> u64 {
    let elapsed = Duration::try_from(clock_gettime(ClockId::Boottime)).unwrap_or_default();
    u64::try_from(elapsed.as_millis()).unwrap_or(u64::MAX)
}

/// Reads a file of this user, at most one byte more than it may have. In a domain of a group, another user may have put
/// something else in its place.
fn read(path: &Path) -> io::Result<Option<Vec<u8>>> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits();
    let opened = File::options()
        .read(true)
        .custom_flags(flags as i32)
        .open(path);
    let file = match opened {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    if !DomainUsers::This.own(&rustix::fs::fstat(&file)?) {
        let what = "the file belongs to another user";
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, what));
    }
    let mut bytes = Vec::new();
    file.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes)?;
    Ok(Some(bytes))
}

/// Replaces a file by another one, which only this user can read.
fn replace(path: &Path, new: &Path, bytes: &[u8]) -> io::Result<()> {
    // A gateway that was killed may have left one.
    match fs::remove_file(new) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut options = File::options();
    options.write(true).create_new(true).mode(0o600);
    options.open(new)?.write_all(bytes)?;
    fs::rename(new, path)
}

/// Reads the bytes as a file, takes over what it has, and checks that a successor keeps the same. Panics if
/// a rule is broken.
#[cfg(feature = "fuzzing")]
pub(crate) fn play(bytes: &[u8]) {
    use fipa_platform::{Ams, ApDescription, Df, PlatformTime};

    let Ok((head, items)) = decode(bytes) else {
        return;
    };
    let all = Predecessor::new(&head, items, head.written.saturating_add(1000));
    for (contact, location) in all.contacts(&Trust::default()) {
        let contacts = ContactDirectory::new();
        let agent = Incarnation::from_u64(contact.agent);
        drop(contacts.record_sender(Instant::now(), &contact.name, agent, location));
    }
    let id = fipa_acl::AgentId::new("df@mts").expect("a name");
    let now = PlatformTime {
        at: Instant::now(),
        wall: std::time::SystemTime::now(),
    };
    let take_over = |stored: (&[StoredDescription], &[StoredSubscription])| {
        let mut df = Df::new(id.clone());
        df.take_over(now, all.elapsed, stored, |platform| {
            all.stays(platform, &Trust::default())
        });
        df.keep(now.at)
    };
    let taken_over = take_over((&all.descriptions, &all.subscriptions));
    let items = taken_over.0.iter().cloned().map(Item::Description);
    let subscriptions = taken_over.1.iter().cloned().map(Item::Subscription);
    let lines = lines(
        &items.chain(subscriptions).collect::<Vec<_>>(),
        MAX_BYTES / 2,
    );
    let head = Head {
        items: lines.len(),
        ..head
    };
    let (_, again) = decode(&encode(&head, &lines)).expect("a written file is read");
    let again = Predecessor::new(&head, again, head.written);
    assert_eq!((again.descriptions, again.subscriptions), taken_over);
    let platform = ApDescription {
        name: "mts".to_owned(),
        services: Vec::new(),
    };
    let mut ams = Ams::new(id.clone(), platform);
    ams.take_over(now.at, all.elapsed, &all.agents, &[], |_| true);
    assert!(ams.keep(now.at).len() <= all.agents.len());
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = include_str!("../state/example.txt");

    fn head(items: usize) -> Head {
        Head {
            version: VERSION,
            boot: "boot".to_owned(),
            written: 1000,
            has_keys: false,
            items,
        }
    }

    fn read(text: &str) -> Result<Predecessor, StateError> {
        let (head, items) = decode(text.as_bytes())?;
        Ok(Predecessor::new(&head, items, head.written + 500))
    }

    /// Returns a description of an agent, whose text has about this length.
    fn description(name: &str, platform: &str, len: usize) -> Item {
        let text = format!("(df-agent-description {})", "x".repeat(len));
        let json = format!(
            r#"{{"description":{{"name":"{name}","registration":1,"platform":{platform},"left":null,"text":"{text}"}}}}"#
        );
        serde_json::from_str(&json).unwrap()
    }

    #[test]
    fn a_file_has_each_kind_of_item() {
        let all = read(FILE).unwrap();
        let counts = (all.agents.len(), all.descriptions.len());
        assert_eq!(counts, (1, 2));
        assert_eq!((all.subscriptions.len(), all.contacts.len()), (1, 2));
        assert_eq!(all.elapsed, Duration::from_millis(500));
        let (head, items) = decode(FILE.as_bytes()).unwrap();
        let lines = lines(&items, MAX_BYTES);
        assert_eq!(decode(&encode(&head, &lines)).unwrap().1.len(), items.len());
        assert!(lines.iter().all(|line| FILE.contains(line)));
    }

    #[test]
    fn a_file_that_does_not_parse_is_refused_as_a_whole() {
        for (from, to) in [
            ("\"version\":1", "\"version\":2"),
            ("\"items\":6", "\"items\":7"),
            ("\"host\"", "\"guest\""),
            ("{\"agent\"", "{\"agents\""),
            ("\n{", "{"),
            (FILE, ""),
            (FILE, "\n"),
            (FILE, "{}"),
        ] {
            assert!(FILE.contains(from), "{from}");
            assert!(read(&FILE.replacen(from, to, 1)).is_err(), "{from} -> {to}");
        }
        let half = FILE.get(..FILE.len() / 2).unwrap();
        assert!(read(half).is_err());
        let long = " ".repeat(MAX_BYTES + 1);
        assert!(matches!(read(&long), Err(StateError::TooLong)));
    }

    #[test]
    fn agents_of_this_host_come_first_and_platforms_take_turns() {
        let certificate = |byte: u8| serde_json::to_string(&Platform::Proved([byte; 32])).unwrap();
        let mut items: Vec<Item> = (0..2000)
            .map(|number| description(&format!("many{number}"), &certificate(1), 1000))
            .collect();
        items.push(description("few", &certificate(2), 1000));
        items.push(description("unproved", "\"unproved\"", 1000));
        items.push(description("own", "\"host\"", 1000));
        let room = 100_000;
        let some = lines(&items, room);
        let len: usize = some.iter().map(|line| line.len() + 1).sum();
        assert!(len <= room && len > room - 3000, "{len}");
        assert!(some[0].contains("\"own\""));
        for name in ["few", "unproved", "many0", "many10"] {
            assert!(
                some.iter().any(|line| line.contains(&format!("{name:?}"))),
                "{name}"
            );
        }
        let bytes = encode(&head(some.len()), &some);
        assert_eq!(decode(&bytes).unwrap().1.len(), some.len());
    }

    #[test]
    fn what_a_platform_left_stays_as_long_as_its_trust() {
        let all = read(FILE).unwrap();
        let none = Trust::default();
        assert!(all.stays(Platform::Host, &none));
        assert!(all.stays(Platform::Unproved, &none));
        assert!(!all.stays(Platform::Proved([7; 32]), &none));
        let had = read(&FILE.replace("\"has_keys\":false", "\"has_keys\":true")).unwrap();
        assert!(!had.stays(Platform::Unproved, &none));
        // A contact whose gateway proved a certificate.
        let contacts: Vec<&str> = all.contacts(&none).map(|(it, _)| &*it.name).collect();
        assert_eq!(contacts, ["painter@jade"]);
    }

    #[test]
    fn the_file_is_private_and_replaced_at_once() {
        use std::os::unix::fs::PermissionsExt as _;

        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(DomainDir::STATE);
        let new = directory.path().join(DomainDir::NEXT_STATE);
        assert_eq!(super::read(&path).unwrap(), None);
        for text in ["first", "second, longer", "third"] {
            replace(&path, &new, text.as_bytes()).unwrap();
            assert_eq!(super::read(&path).unwrap().unwrap(), text.as_bytes());
            assert_eq!(
                fs::metadata(&path).unwrap().permissions().mode() & 0o777,
                0o600
            );
            assert!(!new.exists());
        }
        // In a domain of a group, another user can put a link to a file of this user in the place of one.
        let own = directory.path().join("own");
        fs::write(&own, "own").unwrap();
        std::os::unix::fs::symlink(&own, &new).unwrap();
        replace(&path, &new, b"fourth").unwrap();
        assert_eq!(fs::read(&own).unwrap(), b"own");
        fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink(&own, &path).unwrap();
        super::read(&path).unwrap_err();
        fs::remove_file(&path).unwrap();
        fs::write(&path, " ".repeat(MAX_BYTES + 10)).unwrap();
        assert_eq!(super::read(&path).unwrap().unwrap().len(), MAX_BYTES + 1);
    }
}
