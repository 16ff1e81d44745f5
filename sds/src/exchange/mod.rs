//! Exchange of directory entries between gateways that have a connection.
//!
//! Where multicast is filtered, mDNS finds nothing; but connected gateways, of which one has the
//! other's address, can send each other the agents of their hosts. Each sends its **neighbors** its
//! own agents only, in letters: all of them first, then changes. Received entries are stored in an
//! [`ExchangeDirectory`], and are removed when the neighbor disconnects.
//!
//! [`Exchange`] has no I/O and no clock: neighbors, own agents, letters and `now` go in, letters to
//! send come out. It requires only that each letter arrives once and in order, or is reported as
//! lost. Every letter states the state of the sender to which it applies and the state to which it
//! leads; a receiver in another state requests all entries again. At most one letter is in flight
//! to each neighbor, and changes in the meantime go into the next, so that hundreds of agents that
//! start at once make a few letters.
//!
//! An agent's entry in the directory facilitator (DF) of its gateway travels with its directory entry,
//! so that a search there needs no letter to other gateways.
//!
//! A neighbor may be hostile. It can send only agents of its own that are reached through itself
//! and, if its link has a certificate, that this certificate names. Malformed letters are rejected. Each peer
//! has a share of the entries: of a longer list the last agents are left out, and no list affects that of a
//! peer within its share. DF entries are bounded, too; those beyond the bounds are
//! ignored.

mod df;
mod directory;
mod wire;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::ops::Bound;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{ErrorChain, escape_name};
use fipa_transport::{Incarnation, Location, Mandate, PeerId, Principal, log_limit};

use df::DfEntries;
pub use df::{DfEntry, OwnDfEntry};
pub use directory::ExchangeDirectory;
use directory::{AgentList, Sender};
use wire::{Changes, ExchangeMessage, Full};

use crate::entry::{millis_of_time, time_of_millis};
use crate::shares;
use crate::{Entry, MtsId, Reach, Role, Source};

/// Ontology of the letters of the exchange.
pub const EXCHANGE_ONTOLOGY: &str = "fipa-sds-exchange";

/// Agents by name.
type Agents = BTreeMap<Arc<str>, Arc<Entry>>;

/// State of the exchange with all neighbors.
#[derive(Debug)]
pub struct Exchange {
    own: LocalAgents,
    neighbors: HashMap<Incarnation, Neighbor>,
    /// Gateways that sent a letter before they were reported as neighbors, the latest last; they are asked
    /// for all entries later.
    early_senders: VecDeque<Incarnation>,
    directory: Arc<ExchangeDirectory>,
    /// Gateways whose certificate is no longer trusted.
    withdrawn: HashMap<Incarnation, Principal>,
    /// Time until which the changes of locations have used up the rate of a peer, if it is not over.
    relocated_until: HashMap<PeerId, Instant>,
    /// The agents of neighbors that are gone, the latest last.
    lost: VecDeque<LostGateway>,
    random: u64,
}

/// The agents of a gateway that fell silent, or said goodbye.
#[derive(Debug)]
struct LostGateway {
    mts: MtsId,
    peer: PeerId,
    agents: Vec<Arc<Entry>>,
    /// Time at which they are forgotten.
    until: Instant,
}

/// A gateway with an open connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Present {
    /// The gateway.
    pub mts: MtsId,
    /// Locations at which it accepts letters.
    pub locations: Vec<Location>,
    /// The agents for which its links prove that it may speak. Entries of other agents are
    /// rejected.
    pub mandate: Mandate,
    /// The identity that its links prove.
    pub principal: Principal,
}

impl Present {
    /// Creates a gateway whose links prove nothing.
    #[must_use]
    pub const fn unproved(mts: MtsId, locations: Vec<Location>) -> Self {
        Self {
            mts,
            locations,
            mandate: Mandate::Unproved,
            principal: Principal::Unproved,
        }
    }
}

/// The kind of a letter of the exchange, for a queue of unread letters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum LetterKind {
    /// The beginning of a new list: earlier letters about lists may be left out.
    NewList,
    /// A further part of a list, or changes of one.
    List,
    /// Anything else, or a letter of another library.
    Other,
}

/// The agents that this gateway sends to its neighbors.
#[derive(Debug, Default)]
struct LocalAgents {
    agents: Agents,
    /// DF entries of some of the agents.
    df: BTreeMap<Arc<str>, OwnDfEntry>,
    /// The time at which all DF entries are sent again, if there are any.
    renew: Option<Instant>,
    /// Number of changes of `agents` and `df` so far.
    version: u64,
    /// Names that changed, the latest last; the last one belongs to `version`. Coalitions that
    /// changed together are adjacent.
    log: VecDeque<Logged>,
}

#[derive(Debug, Clone)]
struct Logged {
    name: Arc<str>,
    /// Whether it changed together with the previous one; both are then sent in one letter.
    with_previous: bool,
}

/// Returns the time at which the agents of this peer may get other locations, if they may not now.
fn relocation_due(
    relocated_until: &HashMap<PeerId, Instant>,
    peer: &PeerId,
    now: Instant,
) -> Option<Instant> {
    let until = relocated_until.get(peer)?;
    let due = until.checked_sub(Exchange::RELOCATIONS_AHEAD)?;
    (due > now).then_some(due)
}

/// A gateway that is connected, or was until recently.
#[derive(Debug)]
struct Neighbor {
    mts: MtsId,
    locations: Vec<Location>,
    mandate: Mandate,
    principal: Principal,
    /// Time of the disconnect.
    gone: Option<Instant>,
    state: SyncState,
    /// State of the neighbor once the letter in flight has arrived, if there is one.
    under_way: Option<SyncState>,
    /// Earliest time of the next letter.
    due: Instant,
    /// Number of consecutive letters that did not arrive.
    failures: u32,
    /// The neighbor's version that is in the directory.
    stored: Option<u64>,
    /// Entries received so far of a state that takes several letters.
    staged: Option<Staged>,
    /// Time at which to request all entries, if necessary, and time of the last request.
    ask: Option<Instant>,
    asked: Option<Instant>,
    /// Time at which its agents get its present locations, if that waits.
    relocation_due: Option<Instant>,
    /// Time at which this gateway last started to send all entries.
    last_full_send: Option<Instant>,
    /// Whether a list that exceeds the share was logged.
    is_cut_reported: bool,
}

/// State of a neighbor's copy of this gateway's agents.
#[derive(Debug, Clone, PartialEq, Eq)]
enum SyncState {
    /// It has the agents up to this name, of a state at least as new as this version; initially
    /// none.
    Some {
        upto: Option<Arc<str>>,
        version: u64,
    },
    /// It has all agents of this version.
    All { version: u64 },
}

#[derive(Debug)]
struct Staged {
    version: u64,
    /// Time of the last letter that added an agent.
    grew: Instant,
    list: AgentList,
    df: DfEntries,
}

impl Exchange {
    /// Maximum number of agents of one peer: of all neighbors with one certificate, or without keys at
    /// one address. Fewer with texts: each agent is charged 400 bytes and its texts, and a peer has a
    /// share of 2,000,000 bytes. Further agents are left out.
    pub const MAX_AGENTS: usize = shares::MAX_OF_PEER / shares::PER_ENTRY;
    /// Maximum number of agents of all neighbors together, in the same measure. Beyond it, the lists of
    /// the peers with most are cut. Each of `n` peers has room for at least `MAX_TOTAL / n`.
    pub const MAX_TOTAL: usize = shares::MAX_TOTAL / shares::PER_ENTRY;
    /// Maximum number of neighbors.
    pub const MAX_NEIGHBORS: usize = 256;
    /// Maximum length of a letter's content, in bytes.
    pub const MAX_CONTENT: usize = 1024 * 1024;
    /// Maximum length of a DF entry, in bytes. A longer one is not sent.
    pub const MAX_DF_ENTRY: usize = 4096;
    /// Maximum number of DF entries of one neighbor, or of all neighbors with one certificate. This
    /// gateway sends no more either.
    pub const MAX_DF_ENTRIES: usize = 256;
    /// Maximum length of these entries together, in bytes.
    pub const MAX_DF_BYTES: usize = 128 * 1024;
    /// Maximum number of addresses of one DF entry.
    pub const MAX_DF_ADDRESSES: usize = 4;
    /// Maximum length of an address of a DF entry, in bytes.
    pub const MAX_DF_ADDRESS: usize = 128;
    /// Maximum number of DF entries of all neighbors. Neighbors without certificates have at most half
    /// of them.
    pub const MAX_TOTAL_DF_ENTRIES: usize = 2048;
    /// Maximum length of these entries together, in bytes.
    pub const MAX_TOTAL_DF_BYTES: usize = 1024 * 1024;
    /// Time after which a received DF entry ends unless the neighbor sends it again.
    pub const MAX_DF_LEASE: Duration = Duration::from_secs(3600);
    /// Time for which the agents of a disconnected neighbor are kept: a broken connection is
    /// usually restored.
    pub const MEMORY: Duration = Duration::from_secs(5);
    /// Time for which agents are [lost](crate::View::lost_agents) after that.
    pub const LOST: Duration = Duration::from_secs(3600);
    /// Maximum number of lost agents. Beyond it, the lists of the peers with most are cut.
    pub const MAX_LOST: usize = 1024;

    /// Time that a peer uses up for each agent that gets other locations. Its connections decide how often they
    /// change, and the change of thousands of agents takes long.
    const RELOCATION: Duration = Duration::from_millis(1);
    /// Time that a peer may use up in advance.
    const RELOCATIONS_AHEAD: Duration = Duration::from_secs(1);
    /// Time for which changes are collected before they are sent.
    const GATHERING: Duration = Duration::from_millis(50);
    /// Maximum jitter of that time.
    const JITTER: Duration = Duration::from_millis(50);
    /// Interval at which a letter is sent without changes.
    const ALIVE: Duration = Duration::from_secs(15);
    /// Interval at which all DF entries are sent again, because they end at the neighbors otherwise.
    const DF_RENEWAL: Duration = Duration::from_secs(1200);
    /// Backoff after a letter that did not arrive, and minimum time between two requests.
    const FIRST_PAUSE: Duration = Duration::from_secs(1);
    const LONGEST_PAUSE: Duration = Duration::from_secs(30);
    /// Time for which an incomplete list is kept after the last letter that added an agent to it.
    const INCOMPLETE: Duration = Duration::from_secs(60);
    /// Maximum number of agents in one letter, and maximum bytes of their texts.
    const BATCH: usize = 256;
    const BATCH_BYTES: usize = 192 * 1024;
    /// Maximum length of the change log; a neighbor that is further behind gets all entries.
    const LOG: usize = 4096;

    /// Creates an exchange without neighbors. The seed determines the jitter and should differ
    /// between gateways.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self {
            own: LocalAgents::default(),
            neighbors: HashMap::new(),
            early_senders: VecDeque::new(),
            directory: Arc::default(),
            withdrawn: HashMap::new(),
            relocated_until: HashMap::new(),
            lost: VecDeque::new(),
            random: seed,
        }
    }

    /// Returns the directory with the entries of the neighbors.
    #[must_use]
    pub fn directory(&self) -> Arc<ExchangeDirectory> {
        Arc::clone(&self.directory)
    }

    /// Sets the agents and coalitions to send: those of this host. Gateways are left out.
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
        if self.own.replace(agents) {
            self.schedule_changes(now);
        }
    }

    /// Sets the DF entries to send: those of agents of this host, which travel with the agents. Returns
    /// the names of the agents whose entries are not sent, because they exceed the bounds for one
    /// entry or for this gateway. Earlier entries of the list precede later ones.
    pub fn handle_own_df(&mut self, now: Instant, entries: Vec<OwnDfEntry>) -> Vec<Arc<str>> {
        let (entries, others) = df::bounded(entries);
        let renew = match entries.is_empty() {
            true => None,
            false => self.own.renew.or(Some(now + Self::DF_RENEWAL)),
        };
        self.own.renew = renew;
        if self.own.replace_df(entries) {
            self.schedule_changes(now);
        }
        others
    }

    /// Whether this gateway has DF entries to send.
    #[must_use]
    pub fn has_own_df(&self) -> bool {
        !self.own.df.is_empty()
    }

    /// Schedules letters to the neighbors that have all earlier entries.
    fn schedule_changes(&mut self, now: Instant) {
        let soon = now + Self::GATHERING + self.jitter();
        for neighbor in self.neighbors.values_mut() {
            if matches!(neighbor.state, SyncState::All { .. }) && neighbor.failures == 0 {
                neighbor.due = neighbor.due.min(soon);
            }
        }
    }

    /// Sets the gateways whose certificate is no longer trusted. Their entries end at once, also those that
    /// other directories have. They are no neighbors before they prove another certificate.
    pub fn handle_withdrawn(
        &mut self,
        gateways: impl IntoIterator<Item = (Incarnation, Principal)>,
    ) {
        let neighbors = &self.neighbors;
        let gateways = gateways.into_iter().filter(|(gateway, principal)| {
            let neighbor = neighbors.get(gateway);
            neighbor.is_none_or(|neighbor| neighbor.principal == *principal)
        });
        let withdrawn = gateways.collect();
        if self.withdrawn == withdrawn {
            return;
        }
        self.withdrawn = withdrawn;
        let withdrawn = self.withdrawn.clone();
        self.neighbors
            .retain(|gateway, _| !withdrawn.contains_key(gateway));
        self.early_senders
            .retain(|gateway| !withdrawn.contains_key(gateway));
        self.directory.withdraw(&withdrawn);
        self.forget_lost(|lost| withdrawn.contains_key(&lost.mts.incarnation));
    }

    /// Sets the gateways that are connected now.
    pub fn handle_neighbors(&mut self, now: Instant, present: &[Present]) {
        // The connection is about to end.
        let is_withdrawn =
            |it: &Present| self.withdrawn.get(&it.mts.incarnation) == Some(&it.principal);
        let present: Vec<&Present> = present.iter().filter(|it| !is_withdrawn(it)).collect();
        self.withdrawn.retain(|gateway, _| {
            let proves_another = present.iter().any(|it| it.mts.incarnation == *gateway);
            !proves_another
        });
        for neighbor in self.neighbors.values_mut() {
            let mts = neighbor.mts.incarnation;
            let is_present = present.iter().any(|it| it.mts.incarnation == mts);
            if is_present {
                if neighbor.gone.take().is_some() {
                    // It may have dropped its copy in the meantime, and then requests all entries.
                    neighbor.failures = 0;
                    neighbor.due = now;
                    if neighbor.stored.is_none() {
                        neighbor.request_all(now);
                    }
                }
            } else if neighbor.gone.is_none() {
                neighbor.gone = Some(now);
                neighbor.relocation_due = None;
            }
        }
        for Present {
            mts,
            locations,
            mandate,
            principal,
        } in present
        {
            if let Some(known) = self.neighbors.get_mut(&mts.incarnation) {
                known.principal = *principal;
                if known.mandate != *mandate {
                    known.mandate = mandate.clone();
                    self.directory.prove(mts.incarnation, mandate);
                    (known.stored, known.staged) = (None, None);
                    known.request_all(now);
                }
                known.relocation_due = None;
                if known.locations != *locations {
                    let peer = known.sender().peer;
                    match relocation_due(&self.relocated_until, &peer, now) {
                        Some(due) => known.relocation_due = Some(due),
                        None => {
                            known.locations.clone_from(locations);
                            let agents = self.directory.relocate(&known.sender(), locations);
                            self.relocated_until.retain(|_, until| *until > now);
                            let until = self.relocated_until.entry(peer).or_insert(now);
                            *until += Self::RELOCATION * u32::try_from(agents).unwrap_or(u32::MAX);
                        }
                    }
                }
                continue;
            }
            let peer = PeerId::of(*principal, locations.first());
            if !mts.incarnation.is_known() || !self.make_room(&peer) {
                continue;
            }
            let due = now + self.jitter();
            let mut neighbor = Neighbor::new(mts.clone(), locations.clone(), due);
            neighbor.mandate = mandate.clone();
            neighbor.principal = *principal;
            self.directory.prove(mts.incarnation, mandate);
            if let Some(place) = self
                .early_senders
                .iter()
                .position(|it| *it == mts.incarnation)
            {
                self.early_senders.remove(place);
                neighbor.request_all(now);
            }
            self.neighbors.insert(mts.incarnation, neighbor);
        }
        self.end_replaced();
    }

    /// Makes room for another neighbor of this peer: ends one of the peer with most neighbors if there are
    /// too many. Returns whether there is room.
    fn make_room(&mut self, peer: &PeerId) -> bool {
        if self.neighbors.len() < Self::MAX_NEIGHBORS {
            return true;
        }
        let mut neighbors: HashMap<PeerId, Vec<Incarnation>> = HashMap::new();
        for neighbor in self.neighbors.values() {
            let of_peer = neighbors.entry(neighbor.sender().peer).or_default();
            of_peer.push(neighbor.mts.incarnation);
        }
        let own = neighbors.get(peer).map_or(0, Vec::len);
        let most = neighbors.into_values().max_by_key(Vec::len);
        // Without the margin, two peers with equally many would take turns.
        let most = most.filter(|most| most.len() > own + 1);
        match most.and_then(|most| most.into_iter().max()) {
            Some(gateway) => {
                self.end(gateway);
                true
            }
            None => false,
        }
    }

    /// Drops agents of disconnected gateways that another directory knows, because that one may
    /// already have them at another gateway.
    pub fn leave_to_others(&mut self, knows: impl Fn(&Entry) -> bool) {
        for (incarnation, neighbor) in &mut self.neighbors {
            if neighbor.gone.is_some() && self.directory.leave_to_others(*incarnation, &knows) {
                // The gateway sends all entries again when it reconnects.
                neighbor.stored = None;
            }
        }
    }

    /// Handles a gateway that does not answer at this location. If another gateway accepts letters
    /// there and has sent its agents, the silent one has ended, even if a connection with it
    /// appears open: a datagram connection outlives a gateway that was killed. Returns whether it
    /// has ended. If a connection with it is still open, it is asked for its agents.
    pub fn handle_silence(&mut self, now: Instant, location: &Location) -> bool {
        let gateway = location.incarnation();
        if !self.is_replaced(gateway, std::slice::from_ref(location)) {
            return false;
        }
        match self.neighbors.get_mut(&gateway) {
            Some(silent) if silent.gone.is_none() => {
                self.directory.forget(gateway);
                (silent.stored, silent.staged) = (None, None);
                silent.request_all(now);
            }
            _ => self.end(gateway),
        }
        true
    }

    /// Ends disconnected gateways that another incarnation has replaced: a gateway that was killed
    /// and restarted listens at the same address, or has the same certificate and name. Its agents
    /// are those that the new incarnation sends, and letters in the custody of the old one are lost.
    /// Entries of a gateway that is connected and answers stay: two gateways behind one address
    /// translator have the same location.
    fn end_replaced(&mut self) {
        let gone = self.neighbors.iter().filter(|(_, old)| old.gone.is_some());
        let replaced = gone.filter(|(gateway, old)| {
            self.is_replaced(**gateway, &old.locations) || self.is_succeeded(old)
        });
        let replaced: Vec<Incarnation> = replaced.map(|(incarnation, _)| *incarnation).collect();
        for incarnation in replaced {
            self.end(incarnation);
        }
    }

    /// Whether another connected gateway accepts letters at one of these locations and has sent its
    /// agents. Any gateway may list any address, so only the same certificate replaces a gateway
    /// with a certificate.
    fn is_replaced(&self, gateway: Incarnation, locations: &[Location]) -> bool {
        let principal = self.neighbors.get(&gateway).map(|old| old.principal);
        let certificate = principal.filter(|it| matches!(it, Principal::Certificate(_)));
        let mut others = self.neighbors.iter();
        others.any(|(other, new)| {
            let tells = new.gone.is_none() && new.stored.is_some();
            let may = certificate.is_none_or(|certificate| new.principal == certificate);
            *other != gateway && tells && may && new.is_at_one_of(locations)
        })
    }

    /// Whether another connected gateway with the same certificate and name has sent its agents.
    fn is_succeeded(&self, old: &Neighbor) -> bool {
        let is_certified = matches!(old.principal, Principal::Certificate(_));
        let mut others = self.neighbors.values();
        is_certified
            && others.any(|new| {
                let tells = new.gone.is_none() && new.stored.is_some();
                tells && new.principal == old.principal && new.mts.name == old.mts.name
            })
    }

    fn end(&mut self, gateway: Incarnation) {
        self.neighbors.remove(&gateway);
        self.directory.forget(gateway);
        self.directory.prove(gateway, &Mandate::Unproved);
    }

    /// Handles the content of a letter from this gateway with [`EXCHANGE_ONTOLOGY`].
    ///
    /// # Errors
    /// Returns the reason when the letter was rejected; nothing has changed then.
    pub fn handle_letter(
        &mut self,
        now: Instant,
        from: Incarnation,
        content: &[u8],
    ) -> Result<(), ExchangeError> {
        if content.len() > Self::MAX_CONTENT {
            return Err(ExchangeError::TooLarge(content.len()));
        }
        if !self.neighbors.contains_key(&from) {
            if !self.early_senders.contains(&from) {
                // A peer can connect under many incarnations, which never become neighbors.
                if self.early_senders.len() >= Self::MAX_NEIGHBORS {
                    self.early_senders.pop_front();
                }
                self.early_senders.push_back(from);
            }
            return Err(ExchangeError::NotConnected);
        }
        let message = wire::decode(content)?;
        let Some(neighbor) = self.neighbors.get_mut(&from) else {
            return Err(ExchangeError::NotConnected);
        };
        match message {
            ExchangeMessage::Again => {
                neighbor.tell_all(now);
                Ok(())
            }
            ExchangeMessage::Goodbye => {
                neighbor.stored = None;
                neighbor.staged = None;
                self.lose(now, from);
                self.directory.forget(from);
                Ok(())
            }
            ExchangeMessage::Full(full) => {
                neighbor.handle_full(now, full, &self.directory);
                if neighbor.stored.is_some() {
                    let returned = neighbor.mts.name.clone();
                    self.forget_lost(|lost| lost.mts.name == returned);
                }
                self.bound_staged(now);
                self.end_replaced();
                Ok(())
            }
            ExchangeMessage::Changes(changes) => {
                neighbor.handle_changes(now, changes, &self.directory);
                Ok(())
            }
        }
    }

    /// Returns the kind of a letter with this content, without reading it.
    #[must_use]
    pub fn letter_kind(content: &[u8]) -> LetterKind {
        wire::kind(content)
    }

    /// Handles the loss of letters from this gateway that had arrived and were not read. The gateway is asked for
    /// all entries again, and gets all entries, in case it has asked for them.
    pub fn handle_unread(&mut self, now: Instant, from: Incarnation) {
        if let Some(neighbor) = self.neighbors.get_mut(&from) {
            // The rest of an incomplete list would be taken for the lost part.
            neighbor.staged = None;
            neighbor.request_all(now);
            neighbor.tell_all(now);
        }
    }

    /// Drops the incomplete lists that exceed the shares of their peers. Their neighbors are asked for all
    /// entries again.
    fn bound_staged(&mut self, now: Instant) {
        let staged = self.neighbors.iter().filter_map(|(gateway, neighbor)| {
            let charged = neighbor.staged.as_ref()?.list.charged();
            Some((*gateway, (neighbor.sender().peer, charged)))
        });
        let (gateways, lists): (Vec<Incarnation>, Vec<_>) = staged.unzip();
        let allowed = shares::allowances(&lists, shares::MAX_OF_PEER, shares::MAX_TOTAL);
        for ((gateway, (_, charged)), allowed) in gateways.iter().zip(&lists).zip(allowed) {
            if *charged > allowed
                && let Some(neighbor) = self.neighbors.get_mut(gateway)
            {
                neighbor.staged = None;
                neighbor.request_all(now);
            }
        }
    }

    /// Handles the result of the letter in flight to this neighbor.
    pub fn handle_sent(&mut self, now: Instant, to: Incarnation, arrived: bool) {
        let Some(neighbor) = self.neighbors.get_mut(&to) else {
            return;
        };
        match neighbor.under_way.take() {
            Some(state) if arrived => {
                neighbor.failures = 0;
                neighbor.state = state;
                neighbor.due = match neighbor.state {
                    SyncState::Some { .. } => now,
                    SyncState::All { version } if version < self.own.version => {
                        now + Self::GATHERING
                    }
                    SyncState::All { .. } => now + Self::ALIVE,
                };
            }
            _ if arrived => {}
            _ => {
                // It may have arrived nevertheless, so the state of the neighbor is unknown.
                neighbor.state = SyncState::nothing();
                let doubled = Self::FIRST_PAUSE * 2_u32.saturating_pow(neighbor.failures.min(8));
                neighbor.failures += 1;
                neighbor.due = now + doubled.min(Self::LONGEST_PAUSE);
            }
        }
    }

    /// Removes neighbors that have been disconnected for too long, with all their entries. Their
    /// agents are lost. Renews the DF entries of this gateway. Requests lists again that were cut when
    /// there is room for them, and those that stayed incomplete.
    pub fn handle_timeout(&mut self, now: Instant) {
        for (gateway, neighbor) in &mut self.neighbors {
            let rested = |asked: Instant| now >= asked + Self::LONGEST_PAUSE;
            let may_ask = neighbor.gone.is_none()
                && neighbor.ask.is_none()
                && neighbor.asked.is_none_or(rested);
            if may_ask && self.directory.has_room(*gateway) {
                neighbor.request_all(now);
            }
            if neighbor.incomplete_until().is_some_and(|end| end <= now) {
                neighbor.staged = None;
                neighbor.request_all(now);
            }
        }
        if self.own.renew.is_some_and(|renew| renew <= now) {
            self.own.renew = Some(now + Self::DF_RENEWAL);
            self.own.renew_df();
            self.schedule_changes(now);
        }
        self.forget_lost(|lost| now >= lost.until);
        let silent = |neighbor: &Neighbor| neighbor.gone.is_some_and(|it| now >= it + Self::MEMORY);
        let neighbors = self.neighbors.iter();
        let silent = neighbors.filter(|(_, neighbor)| silent(neighbor));
        let silent: Vec<Incarnation> = silent.map(|(gateway, _)| *gateway).collect();
        for gateway in silent {
            self.lose(now, gateway);
            self.end(gateway);
        }
    }

    /// Remembers the agents of a gateway that is gone, with the time when it was last seen. If there are too
    /// many, the lists with most are cut.
    fn lose(&mut self, now: Instant, gateway: Incarnation) {
        let Some(neighbor) = self.neighbors.get(&gateway) else {
            return;
        };
        let agents = self.directory.agents_of(gateway, Self::MAX_LOST);
        if agents.is_empty() {
            return;
        }
        let silence = neighbor
            .gone
            .map(|gone| now.saturating_duration_since(gone));
        let seen = SystemTime::now().checked_sub(silence.unwrap_or_default());
        let seen = time_of_millis(seen.map_or(0, millis_of_time));
        let lost_since_then = |agent: Arc<Entry>| {
            Arc::new(Entry {
                registered: seen,
                ..Entry::clone(&agent)
            })
        };
        let agents: Vec<Arc<Entry>> = agents.into_iter().map(lost_since_then).collect();
        self.lost.push_back(LostGateway {
            mts: neighbor.mts.clone(),
            peer: neighbor.sender().peer,
            agents,
            until: now + Self::LOST,
        });
        let lost = self.lost.iter();
        let sizes: Vec<_> = lost.map(|lost| (&lost.peer, lost.agents.len())).collect();
        let allowed = shares::allowances(&sizes, Self::MAX_LOST, Self::MAX_LOST);
        for (lost, most) in self.lost.iter_mut().zip(allowed) {
            lost.agents.truncate(most);
        }
        self.lost.retain(|lost| !lost.agents.is_empty());
        self.show_lost();
    }

    fn forget_lost(&mut self, which: impl Fn(&LostGateway) -> bool) {
        let before = self.lost.len();
        self.lost.retain(|lost| !which(lost));
        if self.lost.len() != before {
            self.show_lost();
        }
    }

    fn show_lost(&self) {
        let lost = self.lost.iter().flat_map(|lost| &lost.agents);
        self.directory.set_lost(lost.cloned());
    }

    /// Time of the next action.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let times = self.neighbors.values().map(|neighbor| match neighbor.gone {
            Some(since) => Some(since + Self::MEMORY),
            None if neighbor.under_way.is_some() => None,
            None => Some(neighbor.next_letter()),
        });
        let incomplete = self
            .neighbors
            .values()
            .filter_map(Neighbor::incomplete_until);
        let forgotten = self.lost.front().map(|lost| lost.until);
        let own = self.own.renew.into_iter().chain(forgotten);
        let relocations = self.neighbors.values();
        let relocations = relocations.filter_map(|neighbor| neighbor.relocation_due);
        let times = times.flatten().chain(incomplete).chain(relocations);
        times.chain(own).min()
    }

    /// Returns the next letter to send: the neighbor and the content. The caller reports its result
    /// with [`handle_sent`](Self::handle_sent).
    pub fn poll_letter(&mut self, now: Instant) -> Option<(Incarnation, Vec<u8>)> {
        let mut ready = self
            .neighbors
            .iter_mut()
            .filter(|(_, neighbor)| neighbor.gone.is_none() && neighbor.under_way.is_none());
        let (incarnation, neighbor) = ready.find(|(_, neighbor)| neighbor.next_letter() <= now)?;
        if neighbor.ask.is_some_and(|at| at <= now) {
            neighbor.ask = None;
            neighbor.asked = Some(now);
            neighbor.under_way = Some(neighbor.state.clone());
            return Some((*incarnation, wire::encode(&ExchangeMessage::Again)));
        }
        let (message, state) = self.own.next(&neighbor.state, now);
        if matches!(&message, ExchangeMessage::Full(full) if full.first) {
            neighbor.last_full_send = Some(now);
        }
        neighbor.under_way = Some(state);
        Some((*incarnation, wire::encode(&message)))
    }

    /// Returns the final letters of this gateway: their receivers and their common content.
    #[must_use]
    pub fn goodbye(&self) -> (Vec<Incarnation>, Vec<u8>) {
        let present = self.neighbors.iter();
        let present = present.filter(|(_, neighbor)| neighbor.gone.is_none());
        let present = present.map(|(incarnation, _)| *incarnation).collect();
        (present, wire::encode(&ExchangeMessage::Goodbye))
    }

    fn jitter(&mut self) -> Duration {
        // SplitMix64: the values must differ, but need not be unpredictable.
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.random;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        let share = (mixed ^ (mixed >> 31)) >> 32;
        Duration::from_nanos(share % (Self::JITTER.as_nanos() as u64 + 1))
    }
}

impl LocalAgents {
    /// Replaces the agents; returns whether anything changed.
    fn replace(&mut self, agents: Agents) -> bool {
        let before = std::mem::replace(&mut self.agents, agents);
        let removed = before
            .keys()
            .filter(|name| !self.agents.contains_key(*name));
        let differs = |(name, entry): &(&Arc<str>, &Arc<Entry>)| before.get(*name) != Some(*entry);
        let other = self.agents.iter().filter(differs).map(|(name, _)| name);
        let is_coalition = |name: &&Arc<str>| {
            let entry = self.agents.get(*name).or_else(|| before.get(*name));
            entry.is_some_and(|entry| matches!(entry.role, Role::Coalition(_)))
        };
        let (coalitions, agents): (Vec<_>, Vec<_>) = removed.chain(other).partition(is_coalition);
        let any = !coalitions.is_empty() || !agents.is_empty();
        self.version += (coalitions.len() + agents.len()) as u64;
        let logged = |name: &Arc<str>, with_previous| Logged {
            name: Arc::clone(name),
            with_previous,
        };
        let agents = agents.into_iter().map(|name| logged(name, false));
        let coalitions = coalitions.into_iter().enumerate();
        let coalitions = coalitions.map(|(number, name)| logged(name, number > 0));
        self.log.extend(agents.chain(coalitions));
        let surplus = self.log.len().saturating_sub(Exchange::LOG);
        self.log.drain(..surplus);
        any
    }

    /// Replaces the DF entries; returns whether an entry of a present agent changed.
    fn replace_df(&mut self, entries: BTreeMap<Arc<str>, OwnDfEntry>) -> bool {
        let before = std::mem::replace(&mut self.df, entries);
        let removed = before.keys().filter(|name| !self.df.contains_key(*name));
        let differs = |(name, entry): &(&Arc<str>, &OwnDfEntry)| before.get(*name) != Some(*entry);
        let other = self.df.iter().filter(differs).map(|(name, _)| name);
        let changed: Vec<Arc<str>> = removed.chain(other).cloned().collect();
        self.log_df(changed)
    }

    /// Sends all DF entries again.
    fn renew_df(&mut self) {
        let names = self.df.keys().cloned().collect();
        self.log_df(names);
    }

    /// Logs changes of the DF entries of these agents. An agent that is not present has its entry in
    /// the letter with which it appears.
    fn log_df(&mut self, mut names: Vec<Arc<str>>) -> bool {
        names.retain(|name| self.agents.contains_key(name));
        self.version += names.len() as u64;
        self.log.extend(names.iter().map(|name| Logged {
            name: Arc::clone(name),
            with_previous: false,
        }));
        let surplus = self.log.len().saturating_sub(Exchange::LOG);
        self.log.drain(..surplus);
        !names.is_empty()
    }

    /// Returns the DF entry of this registration.
    fn df_of(&self, entry: &Entry) -> Option<&OwnDfEntry> {
        let own = self.df.get(&entry.name);
        own.filter(|own| own.incarnation == entry.incarnation && entry.role == Role::Agent)
    }

    /// Returns an agent as part of a letter.
    fn to_wire(&self, entry: &Arc<Entry>, now: Instant) -> wire::Agent {
        let df = self.df_of(entry).and_then(|own| own.to_wire(now));
        wire::Agent::of(entry, df)
    }

    /// Returns the length of an agent in a letter, approximately.
    fn weight(&self, entry: &Entry) -> usize {
        weight(entry) + self.df_of(entry).map_or(0, OwnDfEntry::weight)
    }

    /// Returns as many entries as fit one letter, at least one.
    fn batch<'a>(&self, entries: impl Iterator<Item = &'a Arc<Entry>>) -> Vec<&'a Arc<Entry>> {
        let mut bytes = 0;
        let fits = |entry: &&Arc<Entry>| {
            let had_room = bytes <= Exchange::BATCH_BYTES;
            bytes += self.weight(entry);
            had_room
        };
        entries.take(Exchange::BATCH).take_while(fits).collect()
    }

    /// Returns the next message for a neighbor in this state, and its state after receipt.
    fn next(&self, knows: &SyncState, now: Instant) -> (ExchangeMessage, SyncState) {
        match knows {
            SyncState::All { version } => {
                let behind = self.version - version;
                match usize::try_from(behind) {
                    Ok(behind) if behind <= self.log.len() => self.changes(*version, behind, now),
                    _ => self.part(None, self.version, now),
                }
            }
            SyncState::Some { upto, version } => {
                // Start again if more has changed since the first part than the log holds.
                let behind = usize::try_from(self.version - version).unwrap_or(usize::MAX);
                match upto {
                    Some(_) if behind <= self.log.len() => self.part(upto.as_ref(), *version, now),
                    _ => self.part(None, self.version, now),
                }
            }
        }
    }

    /// Builds the part of all entries after that name. Changes since the first part are sent after
    /// the last part.
    fn part(
        &self,
        upto: Option<&Arc<str>>,
        version: u64,
        now: Instant,
    ) -> (ExchangeMessage, SyncState) {
        let from = upto.map_or(Bound::Unbounded, |name| Bound::Excluded(Arc::clone(name)));
        let rest = self
            .agents
            .range((from, Bound::Unbounded))
            .map(|(_, entry)| entry);
        let batch = self.batch(rest);
        let last = batch.last().is_none_or(|entry| {
            let behind = (Bound::Excluded(Arc::clone(&entry.name)), Bound::Unbounded);
            self.agents.range(behind).next().is_none()
        });
        let state = match batch.last() {
            Some(entry) if !last => SyncState::Some {
                upto: Some(Arc::clone(&entry.name)),
                version,
            },
            _ => SyncState::All { version },
        };
        let full = Full {
            version,
            first: upto.is_none(),
            last,
            agents: batch
                .into_iter()
                .map(|entry| self.to_wire(entry, now))
                .collect(),
        };
        (ExchangeMessage::Full(full), state)
    }

    fn changes(&self, version: u64, behind: usize, now: Instant) -> (ExchangeMessage, SyncState) {
        let start = self.log.len().saturating_sub(behind);
        let mut names = BTreeSet::new();
        let (mut bytes, mut taken) = (0, 0);
        for Logged {
            name,
            with_previous,
        } in self.log.range(start..)
        {
            let full = names.len() >= Exchange::BATCH || bytes > Exchange::BATCH_BYTES;
            // Coalitions that changed together stay in one letter, as long as they fit.
            if full && !(*with_previous && bytes <= Exchange::MAX_CONTENT / 2) {
                break;
            }
            if names.insert(Arc::clone(name)) {
                bytes += self
                    .agents
                    .get(name)
                    .map_or(name.len(), |entry| self.weight(entry));
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
                .map(|entry| self.to_wire(entry, now))
                .collect(),
            removed: names
                .iter()
                .filter(|name| !self.agents.contains_key(*name))
                .map(ToString::to_string)
                .collect(),
        };
        (
            ExchangeMessage::Changes(changes),
            SyncState::All { version: to },
        )
    }
}

fn weight(entry: &Entry) -> usize {
    let members = match &entry.role {
        Role::Coalition(members) => members.names().iter().map(|name| name.len() + 10).sum(),
        _ => 0,
    };
    entry.name.len() + entry.agent_type.len() + entry.description.len() + members + 100
}

impl SyncState {
    fn nothing() -> Self {
        Self::Some {
            upto: None,
            version: 0,
        }
    }
}

impl Neighbor {
    fn new(mts: MtsId, locations: Vec<Location>, due: Instant) -> Self {
        Self {
            mts,
            locations,
            mandate: Mandate::Unproved,
            principal: Principal::Unproved,
            gone: None,
            state: SyncState::nothing(),
            under_way: None,
            due,
            failures: 0,
            stored: None,
            staged: None,
            ask: None,
            asked: None,
            relocation_due: None,
            last_full_send: None,
            is_cut_reported: false,
        }
    }

    /// Whether it accepts letters at one of these locations, of any incarnation.
    fn is_at_one_of(&self, locations: &[Location]) -> bool {
        let same = |one: &Location, two: &Location| {
            one.kind() == two.kind() && one.address() == two.address()
        };
        let mut own = self.locations.iter();
        own.any(|one| locations.iter().any(|two| same(one, two)))
    }

    /// Earliest time of the next letter to it.
    fn next_letter(&self) -> Instant {
        self.ask.map_or(self.due, |ask| ask.min(self.due))
    }

    /// Time at which an incomplete list is dropped, if there is one.
    fn incomplete_until(&self) -> Option<Instant> {
        let staged = self.staged.as_ref();
        staged.map(|staged| staged.grew + Exchange::INCOMPLETE)
    }

    /// Schedules a request for all entries, because a received letter does not fit the stored
    /// state.
    fn request_all(&mut self, now: Instant) {
        let earliest = self
            .asked
            .map_or(now, |asked| asked + Exchange::FIRST_PAUSE);
        self.ask = Some(earliest.max(now));
    }

    /// Schedules a letter with all entries of this gateway.
    fn tell_all(&mut self, now: Instant) {
        self.state = SyncState::nothing();
        if let Some(under_way) = &mut self.under_way {
            *under_way = SyncState::nothing();
        }
        // Limits the rate of answers to a neighbor that keeps asking.
        let earliest = self
            .last_full_send
            .map_or(now, |at| at + Exchange::FIRST_PAUSE);
        self.due = earliest.max(now);
    }

    fn sender(&self) -> Sender {
        Sender {
            gateway: self.mts.incarnation,
            principal: self.principal,
            peer: PeerId::of(self.principal, self.locations.first()),
        }
    }

    fn handle_full(&mut self, now: Instant, full: Full, directory: &ExchangeDirectory) {
        let mut staged = match self.staged.take() {
            _ if full.first => Staged {
                version: full.version,
                grew: now,
                list: AgentList::new(self.sender()),
                df: BTreeMap::new(),
            },
            Some(staged) if staged.version == full.version => staged,
            _ => {
                self.request_all(now);
                return;
            }
        };
        let before = staged.list.charged();
        for agent in full.agents {
            let Some((entry, df)) = self.read(now, agent) else {
                continue;
            };
            // The directory applies the other bounds.
            match df {
                Some(df) if staged.df.len() < Exchange::MAX_DF_ENTRIES => {
                    staged.df.insert(Arc::clone(&entry.name), df);
                }
                _ => drop(staged.df.remove(&entry.name)),
            }
            staged.list.insert(entry);
        }
        let cut = staged.list.cut(shares::MAX_OF_PEER);
        if staged.list.charged() > before {
            staged.grew = now;
        }
        if let Some(first) = cut.last()
            && !std::mem::replace(&mut self.is_cut_reported, true)
        {
            let (gateway, first) = (escape_name(self.mts.shown()), escape_name(first));
            log_limit::warn!(
                %gateway,
                %first,
                "the agents of a gateway exceed its share; the last ones by name are not listed"
            );
        }
        if full.last {
            directory.replace(staged.list, staged.df);
            self.stored = Some(full.version);
            self.ask = None;
        } else {
            self.staged = Some(staged);
        }
    }

    fn handle_changes(&mut self, now: Instant, changes: Changes, directory: &ExchangeDirectory) {
        if self.stored != Some(changes.from) {
            self.request_all(now);
            return;
        }
        let agents = changes.agents.into_iter();
        let joined = agents.filter_map(|agent| self.read(now, agent)).collect();
        directory.change(&self.sender(), joined, changes.removed);
        self.stored = Some(changes.to);
    }

    /// Reads an agent of this neighbor, and its DF entry.
    fn read(
        &self,
        now: Instant,
        mut agent: wire::Agent,
    ) -> Option<(Arc<Entry>, Option<Arc<DfEntry>>)> {
        let df = agent.df.take();
        let entry = self.entry(agent)?;
        let df = df.filter(|_| entry.role == Role::Agent);
        let df = df.and_then(|df| {
            let of = (self.mts.incarnation, self.principal);
            DfEntry::read(now, of, (&entry.name, entry.incarnation), df)
        });
        Some((entry, df))
    }

    /// Builds the entry of an agent of this neighbor; its locations are always those of the
    /// neighbor. Returns `None` if the agent is not valid or the neighbor may not speak for it; the
    /// other agents of the letter are still used.
    fn entry(&self, agent: wire::Agent) -> Option<Arc<Entry>> {
        if !self.mandate.speaks_for(&agent.name) {
            let (gateway, agent) = (escape_name(self.mts.shown()), escape_name(&agent.name));
            tracing::debug!(%gateway, %agent, "agent ignored: the certificate of its gateway does not name it");
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
            peer: PeerId::of(self.principal, self.locations.first()),
            role: agent.coalition.map_or(Role::Agent, Role::Coalition),
        };
        if let Err(error) = entry.check() {
            tracing::debug!(gateway = self.mts.shown(), error = %ErrorChain(&error), "agent ignored");
            return None;
        }
        entry.incarnation.is_known().then(|| Arc::new(entry))
    }
}

/// Error of [`Exchange::handle_letter`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExchangeError {
    /// The sender is not a neighbor.
    #[error("the sender of the letter is not a connected gateway")]
    NotConnected,
    /// The letter is too large.
    #[error("the letter has {0} bytes; at most {max} are allowed", max = Exchange::MAX_CONTENT)]
    TooLarge(usize),
    /// The content is not a valid letter of the exchange.
    #[error("the letter is not a valid exchange letter")]
    Malformed(#[from] serde_json::Error),
}
