//! The exchange of directories between gateways that can write to each other.
//!
//! Where multicast is filtered, nobody is found by it; but gateways that a connection is open
//! between, whoever knows whose address, can tell each other who is on their hosts. Each tells
//! its **neighbours** of its own agents only, in letters: everything first, then what changes.
//! What it is told goes into an [`ExchangeDirectory`], and leaves it with the neighbour.
//!
//! [`Exchange`] has no input, output or clock: neighbours, own agents, letters and `now` go in,
//! letters to be sent come out. It relies on nothing but letters arriving once and in order, or
//! being known not to have: every letter says from which state of the teller to which it leads,
//! and who cannot follow asks for everything again. At most one letter is under way to each
//! neighbour, and what changes meanwhile goes into the next, so that hundreds of agents that
//! start at once make a few letters.
//!
//! A neighbour may be hostile: it can tell of agents of its own only, that are reached through
//! itself, and that the certificate of its link names, if it has one; how many it may tell of is bounded; and what makes no sense is not used.

mod directory;
mod wire;

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::ops::Bound;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::escape;
use fipa_transport::{Incarnation, Location, Mandate};

pub use directory::ExchangeDirectory;
use wire::{Changes, Full, Told};

use crate::entry::time_of_millis;
use crate::{Entry, Mts, Reach, Role, Source};

/// The ontology of the letters, by which they are told from others.
pub const EXCHANGE_ONTOLOGY: &str = "fipa-sds-exchange";

/// Agents by name.
type Agents = BTreeMap<Arc<str>, Arc<Entry>>;

/// The agents of one's neighbours, and what they are told of one's own.
#[derive(Debug)]
pub struct Exchange {
    own: Own,
    neighbours: HashMap<Incarnation, Neighbour>,
    /// Who has told something before it was known to be a neighbour, and is to be asked for it.
    early: HashSet<Incarnation>,
    directory: Arc<ExchangeDirectory>,
    random: u64,
}

/// A gateway that can be written to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Present {
    /// The gateway.
    pub mts: Mts,
    /// Where it takes letters.
    pub locations: Vec<Location>,
    /// The agents that its links prove it to speak for. It can tell of no others.
    pub mandate: Mandate,
}

impl Present {
    /// A gateway on whose links nothing is proved.
    #[must_use]
    pub const fn unproved(mts: Mts, locations: Vec<Location>) -> Self {
        Self {
            mts,
            locations,
            mandate: Mandate::Unproved,
        }
    }
}

/// What this gateway tells.
#[derive(Debug, Default)]
struct Own {
    agents: Agents,
    /// Counts the changes of `agents`.
    version: u64,
    /// The names that changed, the latest last; that of `version` is the last one. Coalitions that
    /// changed together stand together.
    log: VecDeque<Logged>,
}

#[derive(Debug, Clone)]
struct Logged {
    name: Arc<str>,
    /// It changed together with the one before it: they are told in one letter.
    together: bool,
}

/// A gateway that can be written to, or could a moment ago.
#[derive(Debug)]
struct Neighbour {
    mts: Mts,
    locations: Vec<Location>,
    mandate: Mandate,
    /// Since when it cannot be written to.
    gone: Option<Instant>,
    telling: Telling,
    /// What was sent and has not arrived yet, if anything is under way.
    under_way: Option<Telling>,
    /// When the next letter may go.
    due: Instant,
    /// Letters in a row that did not arrive.
    failures: u32,
    /// Which of its states is in the directory.
    held: Option<u64>,
    /// What it has told so far, of a state that takes several letters.
    staged: Option<Staged>,
    /// When to ask it for everything, if that is wanted, and when that was done last.
    ask: Option<Instant>,
    asked: Option<Instant>,
    /// When it was last told everything from the start.
    told: Option<Instant>,
}

/// What a neighbour knows of one's own agents.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Telling {
    /// Everything up to this name, of a state that is not older than this one; nothing at first.
    Some {
        upto: Option<Arc<str>>,
        version: u64,
    },
    /// All of this state.
    All { version: u64 },
}

#[derive(Debug)]
struct Staged {
    version: u64,
    entries: Agents,
}

impl Exchange {
    /// Most agents that one neighbour can tell of.
    pub const MAX_AGENTS: usize = 10_000;
    /// Most agents that all neighbours together can tell of.
    pub const MAX_TOTAL: usize = 40_000;
    /// Most neighbours that are told anything.
    pub const MAX_NEIGHBOURS: usize = 256;
    /// Largest letter content that is read, in bytes.
    pub const MAX_CONTENT: usize = 1024 * 1024;
    /// How long the agents of a neighbour are kept when it cannot be written to any more: a
    /// connection that breaks is usually made again.
    pub const MEMORY: Duration = Duration::from_secs(5);

    /// How long changes are gathered before they are told.
    const GATHERING: Duration = Duration::from_millis(50);
    /// Up to how much is added to that.
    const JITTER: Duration = Duration::from_millis(50);
    /// How often a neighbour is told that nothing has changed.
    const ALIVE: Duration = Duration::from_secs(15);
    /// Pauses after a letter that did not arrive, and between two questions.
    const FIRST_PAUSE: Duration = Duration::from_secs(1);
    const LONGEST_PAUSE: Duration = Duration::from_secs(30);
    /// Most agents in one letter, and most bytes of what they say about themselves.
    const BATCH: usize = 256;
    const BATCH_BYTES: usize = 192 * 1024;
    /// Most changes that are remembered; who is further behind is told everything.
    const LOG: usize = 4096;

    /// Nobody is there yet. The seed decides the jitter; that of two gateways should differ.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self {
            own: Own::default(),
            neighbours: HashMap::new(),
            early: HashSet::new(),
            directory: Arc::default(),
            random: seed,
        }
    }

    /// What the neighbours have told.
    #[must_use]
    pub fn directory(&self) -> Arc<ExchangeDirectory> {
        Arc::clone(&self.directory)
    }

    /// These are the agents and coalitions to be told of now: those of this host, gateways left
    /// out.
    pub fn handle_own<'a>(
        &mut self,
        now: Instant,
        agents: impl IntoIterator<Item = &'a Arc<Entry>>,
    ) {
        let agents = agents.into_iter();
        let agents: Agents = agents
            .filter(|entry| entry.role != Role::Gateway)
            .take(Self::MAX_AGENTS)
            .map(|entry| (Arc::clone(&entry.name), Arc::clone(entry)))
            .collect();
        let changed = self.own.replace(agents);
        if !changed {
            return;
        }
        let soon = now + Self::GATHERING + self.jitter();
        for neighbour in self.neighbours.values_mut() {
            if matches!(neighbour.telling, Telling::All { .. }) && neighbour.failures == 0 {
                neighbour.due = neighbour.due.min(soon);
            }
        }
    }

    /// These gateways can be written to now.
    pub fn handle_neighbours(&mut self, now: Instant, present: &[Present]) {
        for neighbour in self.neighbours.values_mut() {
            let mts = neighbour.mts.incarnation;
            let here = present.iter().any(|it| it.mts.incarnation == mts);
            if here {
                if neighbour.gone.take().is_some() {
                    // It may have forgotten meanwhile what it was told, and then says so.
                    neighbour.failures = 0;
                    neighbour.due = now;
                    if neighbour.held.is_none() {
                        neighbour.ask_again(now);
                    }
                }
            } else if neighbour.gone.is_none() {
                neighbour.gone = Some(now);
            }
        }
        for Present {
            mts,
            locations,
            mandate,
        } in present
        {
            if let Some(known) = self.neighbours.get_mut(&mts.incarnation) {
                if known.mandate != *mandate {
                    known.mandate = mandate.clone();
                    self.directory.prove(mts.incarnation, mandate);
                    (known.held, known.staged) = (None, None);
                    known.ask_again(now);
                }
                if known.locations != *locations {
                    known.locations.clone_from(locations);
                    self.directory.relocate(mts.incarnation, locations);
                }
                continue;
            }
            if self.neighbours.len() >= Self::MAX_NEIGHBOURS || !mts.incarnation.is_known() {
                continue;
            }
            let due = now + self.jitter();
            let mut neighbour = Neighbour::new(mts.clone(), locations.clone(), due);
            neighbour.mandate = mandate.clone();
            self.directory.prove(mts.incarnation, mandate);
            if self.early.remove(&mts.incarnation) {
                neighbour.ask_again(now);
            }
            self.neighbours.insert(mts.incarnation, neighbour);
        }
        self.end_replaced();
    }

    /// Lets go of the agents of gateways that cannot be written to at present, if another directory
    /// knows them: it may know them at another gateway already.
    pub fn leave_to_others(&mut self, knows: impl Fn(&Entry) -> bool) {
        for (incarnation, neighbour) in &mut self.neighbours {
            if neighbour.gone.is_some() && self.directory.leave_to_others(*incarnation, &knows) {
                // Everything is told again when the gateway is back.
                neighbour.held = None;
            }
        }
    }

    /// The gateway of this location did not answer there. If another gateway takes letters there and has
    /// told its agents, the silent one has ended, even if a connection with it seems to be open: over
    /// datagrams a connection outlives a gateway that was killed. Returns whether it has ended. One that
    /// is there nevertheless is asked for its agents.
    pub fn handle_silence(&mut self, now: Instant, location: &Location) -> bool {
        let gateway = location.incarnation();
        if !self.is_replaced(gateway, std::slice::from_ref(location)) {
            return false;
        }
        match self.neighbours.get_mut(&gateway) {
            Some(silent) if silent.gone.is_none() => {
                self.directory.forget(gateway);
                (silent.held, silent.staged) = (None, None);
                silent.ask_again(now);
            }
            _ => self.end(gateway),
        }
        true
    }

    /// Ends gateways that another incarnation has replaced: a gateway that was killed and started again
    /// listens where it listened before. Its agents are those that the new incarnation tells of, and
    /// letters in the custody of the old one are lost. While a connection with the old one is open and
    /// it answers, its entries stay: two gateways behind one address translator show the same location.
    fn end_replaced(&mut self) {
        let gone = self.neighbours.iter().filter(|(_, old)| old.gone.is_some());
        let replaced = gone.filter(|(gateway, old)| self.is_replaced(**gateway, &old.locations));
        let replaced: Vec<Incarnation> = replaced.map(|(incarnation, _)| *incarnation).collect();
        for incarnation in replaced {
            self.end(incarnation);
        }
    }

    /// Whether another gateway takes letters at one of these locations of this one, and has told its
    /// agents.
    fn is_replaced(&self, gateway: Incarnation, locations: &[Location]) -> bool {
        let mut others = self.neighbours.iter();
        others.any(|(other, new)| {
            let tells = new.gone.is_none() && new.held.is_some();
            *other != gateway && tells && new.is_at_one_of(locations)
        })
    }

    fn end(&mut self, gateway: Incarnation) {
        self.neighbours.remove(&gateway);
        self.directory.forget(gateway);
        self.directory.prove(gateway, &Mandate::Unproved);
    }

    /// What a letter of this gateway, with [`EXCHANGE_ONTOLOGY`], has as its content.
    ///
    /// # Errors
    /// Says why it was not used. Nothing was changed then.
    pub fn handle_letter(
        &mut self,
        now: Instant,
        from: Incarnation,
        content: &[u8],
    ) -> Result<(), ExchangeError> {
        if content.len() > Self::MAX_CONTENT {
            return Err(ExchangeError::TooLarge(content.len()));
        }
        let Some(neighbour) = self.neighbours.get_mut(&from) else {
            if self.early.len() < Self::MAX_NEIGHBOURS {
                self.early.insert(from);
            }
            return Err(ExchangeError::Stranger);
        };
        match wire::decode(content)? {
            Told::Again => {
                neighbour.telling = Telling::nothing();
                if let Some(under_way) = &mut neighbour.under_way {
                    *under_way = Telling::nothing();
                }
                // Who asks all the time is answered now and then.
                let told = neighbour.told.map_or(now, |told| told + Self::FIRST_PAUSE);
                neighbour.due = told.max(now);
                Ok(())
            }
            Told::Goodbye => {
                neighbour.held = None;
                neighbour.staged = None;
                self.directory.forget(from);
                Ok(())
            }
            Told::Full(full) => {
                neighbour.told_all(now, full, &self.directory)?;
                self.end_replaced();
                Ok(())
            }
            Told::Changes(changes) => neighbour.told_changes(now, changes, &self.directory),
        }
    }

    /// The letter that went to this neighbour has arrived, or will not.
    pub fn handle_sent(&mut self, now: Instant, to: Incarnation, arrived: bool) {
        let Some(neighbour) = self.neighbours.get_mut(&to) else {
            return;
        };
        match neighbour.under_way.take() {
            Some(telling) if arrived => {
                neighbour.failures = 0;
                neighbour.telling = telling;
                neighbour.due = match neighbour.telling {
                    Telling::Some { .. } => now,
                    Telling::All { version } if version < self.own.version => now + Self::GATHERING,
                    Telling::All { .. } => now + Self::ALIVE,
                };
            }
            _ if arrived => {}
            _ => {
                // It may have arrived after all: what it knows is not known any more.
                neighbour.telling = Telling::nothing();
                let doubled = Self::FIRST_PAUSE * 2_u32.saturating_pow(neighbour.failures.min(8));
                neighbour.failures += 1;
                neighbour.due = now + doubled.min(Self::LONGEST_PAUSE);
            }
        }
    }

    /// Lets go of neighbours that have been away for too long, with all they have told.
    pub fn handle_timeout(&mut self, now: Instant) {
        let directory = &self.directory;
        self.neighbours.retain(|incarnation, neighbour| {
            let gone = neighbour
                .gone
                .is_some_and(|since| now >= since + Self::MEMORY);
            if gone {
                directory.forget(*incarnation);
                directory.prove(*incarnation, &Mandate::Unproved);
            }
            !gone
        });
    }

    /// When there is something to be done next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let times = self
            .neighbours
            .values()
            .map(|neighbour| match neighbour.gone {
                Some(since) => Some(since + Self::MEMORY),
                None if neighbour.under_way.is_some() => None,
                None => Some(neighbour.next_letter()),
            });
        times.flatten().min()
    }

    /// The next letter to be sent: to which neighbour, and its content. Each is followed by
    /// [`handle_sent`](Self::handle_sent).
    pub fn poll_letter(&mut self, now: Instant) -> Option<(Incarnation, Vec<u8>)> {
        let mut ready = self
            .neighbours
            .iter_mut()
            .filter(|(_, neighbour)| neighbour.gone.is_none() && neighbour.under_way.is_none());
        let (incarnation, neighbour) =
            ready.find(|(_, neighbour)| neighbour.next_letter() <= now)?;
        if neighbour.ask.is_some_and(|at| at <= now) {
            neighbour.ask = None;
            neighbour.asked = Some(now);
            neighbour.under_way = Some(neighbour.telling.clone());
            return Some((*incarnation, wire::encode(&Told::Again)));
        }
        let (told, telling) = self.own.next(&neighbour.telling);
        if matches!(&told, Told::Full(full) if full.first) {
            neighbour.told = Some(now);
        }
        neighbour.under_way = Some(telling);
        Some((*incarnation, wire::encode(&told)))
    }

    /// The letters with which this gateway takes leave: to whom, and their content, which is the
    /// same for all.
    #[must_use]
    pub fn goodbye(&self) -> (Vec<Incarnation>, Vec<u8>) {
        let present = self.neighbours.iter();
        let present = present.filter(|(_, neighbour)| neighbour.gone.is_none());
        let present = present.map(|(incarnation, _)| *incarnation).collect();
        (present, wire::encode(&Told::Goodbye))
    }

    fn jitter(&mut self) -> Duration {
        // SplitMix64: not to be guessed is not the point, differing is.
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.random;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        let share = (mixed ^ (mixed >> 31)) >> 32;
        Duration::from_nanos(share % (Self::JITTER.as_nanos() as u64 + 1))
    }
}

impl Own {
    /// Whether anything is different now.
    fn replace(&mut self, agents: Agents) -> bool {
        let before = std::mem::replace(&mut self.agents, agents);
        let left = before
            .keys()
            .filter(|name| !self.agents.contains_key(*name));
        let differs = |(name, entry): &(&Arc<str>, &Arc<Entry>)| before.get(*name) != Some(*entry);
        let other = self.agents.iter().filter(differs).map(|(name, _)| name);
        let is_coalition = |name: &&Arc<str>| {
            let entry = self.agents.get(*name).or_else(|| before.get(*name));
            entry.is_some_and(|entry| matches!(entry.role, Role::Coalition(_)))
        };
        let (coalitions, agents): (Vec<_>, Vec<_>) = left.chain(other).partition(is_coalition);
        let any = !coalitions.is_empty() || !agents.is_empty();
        self.version += (coalitions.len() + agents.len()) as u64;
        let logged = |name: &Arc<str>, together| Logged {
            name: Arc::clone(name),
            together,
        };
        let agents = agents.into_iter().map(|name| logged(name, false));
        let coalitions = coalitions.into_iter().enumerate();
        let coalitions = coalitions.map(|(number, name)| logged(name, number > 0));
        self.log.extend(agents.chain(coalitions));
        let surplus = self.log.len().saturating_sub(Exchange::LOG);
        self.log.drain(..surplus);
        any
    }

    /// What to tell who knows that, and what it knows then.
    fn next(&self, knows: &Telling) -> (Told, Telling) {
        match knows {
            Telling::All { version } => {
                let behind = self.version - version;
                match usize::try_from(behind) {
                    Ok(behind) if behind <= self.log.len() => self.changes(*version, behind),
                    _ => self.part(None, self.version),
                }
            }
            Telling::Some { upto, version } => {
                // Too much has changed since the first part of it was told.
                let behind = usize::try_from(self.version - version).unwrap_or(usize::MAX);
                match upto {
                    Some(_) if behind <= self.log.len() => self.part(upto.as_ref(), *version),
                    _ => self.part(None, self.version),
                }
            }
        }
    }

    /// The part behind that name of everything. What has changed since the first part was told is
    /// told again by what follows the last.
    fn part(&self, upto: Option<&Arc<str>>, version: u64) -> (Told, Telling) {
        let from = upto.map_or(Bound::Unbounded, |name| Bound::Excluded(Arc::clone(name)));
        let rest = self
            .agents
            .range((from, Bound::Unbounded))
            .map(|(_, entry)| entry);
        let batch = batch(rest);
        let last = batch.last().is_none_or(|entry| {
            let behind = (Bound::Excluded(Arc::clone(&entry.name)), Bound::Unbounded);
            self.agents.range(behind).next().is_none()
        });
        let telling = match batch.last() {
            Some(entry) if !last => Telling::Some {
                upto: Some(Arc::clone(&entry.name)),
                version,
            },
            _ => Telling::All { version },
        };
        let full = Full {
            version,
            first: upto.is_none(),
            last,
            agents: batch.into_iter().map(wire::Agent::of).collect(),
        };
        (Told::Full(full), telling)
    }

    fn changes(&self, version: u64, behind: usize) -> (Told, Telling) {
        let start = self.log.len().saturating_sub(behind);
        let mut names = BTreeSet::new();
        let (mut bytes, mut taken) = (0, 0);
        for Logged { name, together } in self.log.range(start..) {
            let full = names.len() >= Exchange::BATCH || bytes > Exchange::BATCH_BYTES;
            // Coalitions that changed together are not torn apart, as long as they fit a letter.
            if full && !(*together && bytes <= Exchange::MAX_CONTENT / 2) {
                break;
            }
            if names.insert(Arc::clone(name)) {
                bytes += self
                    .agents
                    .get(name)
                    .map_or(name.len(), |entry| weight(entry));
            }
            taken += 1;
        }
        let to = version + taken;
        let changes = Changes {
            from: version,
            to,
            agents: names
                .iter()
                .filter_map(|name| self.agents.get(name))
                .map(wire::Agent::of)
                .collect(),
            left: names
                .iter()
                .filter(|name| !self.agents.contains_key(*name))
                .map(ToString::to_string)
                .collect(),
        };
        (Told::Changes(changes), Telling::All { version: to })
    }
}

/// As many as go into one letter, at least one.
fn batch<'a>(entries: impl Iterator<Item = &'a Arc<Entry>>) -> Vec<&'a Arc<Entry>> {
    let mut bytes = 0;
    let fits = |entry: &&Arc<Entry>| {
        let had_room = bytes <= Exchange::BATCH_BYTES;
        bytes += weight(entry);
        had_room
    };
    entries.take(Exchange::BATCH).take_while(fits).collect()
}

fn weight(entry: &Entry) -> usize {
    let members = match &entry.role {
        Role::Coalition(members) => members.names().iter().map(|name| name.len() + 10).sum(),
        _ => 0,
    };
    entry.name.len() + entry.agent_type.len() + entry.description.len() + members + 100
}

impl Telling {
    fn nothing() -> Self {
        Self::Some {
            upto: None,
            version: 0,
        }
    }
}

impl Neighbour {
    fn new(mts: Mts, locations: Vec<Location>, due: Instant) -> Self {
        Self {
            mts,
            locations,
            mandate: Mandate::Unproved,
            gone: None,
            telling: Telling::nothing(),
            under_way: None,
            due,
            failures: 0,
            held: None,
            staged: None,
            ask: None,
            asked: None,
            told: None,
        }
    }

    /// Whether it takes letters at one of these locations, of whichever incarnation.
    fn is_at_one_of(&self, locations: &[Location]) -> bool {
        let same = |one: &Location, two: &Location| {
            one.kind() == two.kind() && one.address() == two.address()
        };
        let mut own = self.locations.iter();
        own.any(|one| locations.iter().any(|two| same(one, two)))
    }

    /// When the next letter to it may go.
    fn next_letter(&self) -> Instant {
        self.ask.map_or(self.due, |ask| ask.min(self.due))
    }

    /// Asks it for everything: what it tells does not follow from what is known.
    fn ask_again(&mut self, now: Instant) {
        let earliest = self
            .asked
            .map_or(now, |asked| asked + Exchange::FIRST_PAUSE);
        self.ask = Some(earliest.max(now));
    }

    fn told_all(
        &mut self,
        now: Instant,
        full: Full,
        directory: &ExchangeDirectory,
    ) -> Result<(), ExchangeError> {
        let mut staged = match self.staged.take() {
            _ if full.first => Staged {
                version: full.version,
                entries: BTreeMap::new(),
            },
            Some(staged) if staged.version == full.version => staged,
            _ => {
                self.ask_again(now);
                return Ok(());
            }
        };
        for entry in full
            .agents
            .into_iter()
            .filter_map(|agent| self.entry(agent))
        {
            staged.entries.insert(Arc::clone(&entry.name), entry);
        }
        if staged.entries.len() > Exchange::MAX_AGENTS {
            return Err(ExchangeError::TooMany);
        }
        if full.last {
            directory.replace(self.mts.incarnation, staged.entries)?;
            self.held = Some(full.version);
            self.ask = None;
        } else {
            self.staged = Some(staged);
        }
        Ok(())
    }

    fn told_changes(
        &mut self,
        now: Instant,
        changes: Changes,
        directory: &ExchangeDirectory,
    ) -> Result<(), ExchangeError> {
        if self.held != Some(changes.from) {
            self.ask_again(now);
            return Ok(());
        }
        let agents = changes.agents.into_iter();
        let joined = agents.filter_map(|agent| self.entry(agent)).collect();
        directory.change(self.mts.incarnation, joined, changes.left)?;
        self.held = Some(changes.to);
        Ok(())
    }

    /// The entry of an agent of this neighbour. It is where the neighbour is, whatever it says.
    /// None if there cannot be such an agent, or its link does not speak for it. The others are used
    /// nevertheless.
    fn entry(&self, agent: wire::Agent) -> Option<Arc<Entry>> {
        if !self.mandate.speaks_for(&agent.name) {
            let (gateway, agent) = (escape(&self.mts.name), escape(&agent.name));
            tracing::debug!(%gateway, %agent, "the certificate of the gateway does not name this agent");
            return None;
        }
        let entry = Entry {
            name: agent.name.into(),
            agent_type: agent.agent_type,
            incarnation: agent.incarnation,
            locations: self.locations.clone(),
            mts: self.mts.clone(),
            description: agent.description,
            registered: time_of_millis(agent.registered),
            source: Source::Exchange,
            reach: Reach::Remote {
                gateway: self.mts.incarnation,
            },
            role: agent.coalition.map_or(Role::Agent, Role::Coalition),
        };
        if let Err(error) = entry.check() {
            tracing::debug!(gateway = %self.mts.name, %error, "agent not used");
            return None;
        }
        entry.incarnation.is_known().then(|| Arc::new(entry))
    }
}

/// Why what a neighbour has told was not used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExchangeError {
    /// It came from somebody who is no neighbour.
    #[error("the letter comes from somebody who is no neighbour")]
    Stranger,
    /// The letter is too large.
    #[error("the letter has {0} bytes; at most {max} are read", max = Exchange::MAX_CONTENT)]
    TooLarge(usize),
    /// It is none that is understood.
    #[error("the letter makes no sense: {}", escape(&.0.to_string()))]
    Malformed(#[from] serde_json::Error),
    /// There are more agents than are kept.
    #[error(
        "the neighbour tells of too many agents; {one} of one neighbour and {all} of all are kept",
        one = Exchange::MAX_AGENTS,
        all = Exchange::MAX_TOTAL
    )]
    TooMany,
}
