//! The directory facilitator: the services of agents (FIPA00023 clause 4.1).

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, Performative, Time};
use fipa_content::{Content, SlDialect, Term, Wff};

use crate::answer;
use crate::description::{CONSTRAINTS, Constraints};
use crate::exception::Exception;
use crate::matching::{Comparisons, max_results};
use crate::remote::{self, LocalEntry, RemoteEntry};
use crate::request::{self, Rejection, Request};
use crate::stored::{StoredDescription, StoredSubscription, Text, lease_left, read_object};
use crate::subscription::{Subscription, checked_template};
use crate::{
    AddressBook, AgentDescription, Asker, Platform, PlatformAnswer, PlatformTime, SubscriptionId,
    addresses_for, limits, located,
};

/// The directory facilitator of a platform.
///
/// The caller passes each message for the agent to [`handle_message`](Self::handle_message), calls
/// [`handle_timeout`](Self::handle_timeout) at the time of [`poll_timeout`](Self::poll_timeout), and
/// sends the messages of [`poll_answer`](Self::poll_answer) after each call.
pub struct Df {
    id: AgentId,
    /// The descriptions, by the name of their agent.
    entries: BTreeMap<Arc<str>, Entry>,
    /// The ends of the leases, the earliest first.
    leases: BTreeSet<(Instant, Arc<str>)>,
    /// Number of descriptions of each platform.
    platforms: BTreeMap<Platform, usize>,
    /// Whether a description of an agent of this host has changed since the last
    /// [`poll_local`](Self::poll_local).
    is_local_changed: bool,
    /// Number of registrations so far.
    registered: u64,
    /// The descriptions from the directory facilitators of other hosts. An entry of this directory
    /// facilitator hides that of the same agent.
    remote: BTreeMap<Arc<str>, Remote>,
    /// The ends of the remote descriptions, the earliest first.
    remote_ends: BTreeSet<(Instant, Arc<str>)>,
    subscriptions: BTreeMap<SubscriptionId, Subscription>,
    next_subscription: u64,
    /// The identifiers of the latest searches, the oldest first.
    search_ids: VecDeque<Arc<str>>,
    known_search_ids: HashSet<Arc<str>>,
    answers: VecDeque<PlatformAnswer>,
    revision: u64,
    addresses: Option<AddressBook>,
}

impl fmt::Debug for Df {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Df")
            .field("id", &self.id)
            .finish_non_exhaustive()
    }
}

struct Entry {
    platform: Platform,
    registration: u64,
    description: AgentDescription,
    /// The end of the lease; `None` for an agent of this host without a lease.
    ends: Option<Instant>,
    /// The position in the order of registration.
    position: u64,
    /// The text for other hosts, of an agent of this host.
    text: Option<Arc<str>>,
    /// The text for a successor.
    stored_text: Option<Text>,
}

impl Entry {
    fn new(
        platform: Platform,
        registration: u64,
        description: AgentDescription,
        ends: Option<Instant>,
        position: u64,
    ) -> Self {
        let text = match platform {
            Platform::Host => remote::text(&description),
            _ => None,
        };
        Self {
            platform,
            registration,
            ends,
            position,
            text,
            stored_text: Text::of_term(&description.to_term()),
            description,
        }
    }

    /// Returns the description for an asker whose platform reaches the agents of this host at these addresses.
    fn located(&self, addresses: &[String]) -> Cow<'_, AgentDescription> {
        match self.platform {
            Platform::Host => with_addresses(&self.description, addresses),
            _ => Cow::Borrowed(&self.description),
        }
    }
}

/// Adds addresses to the agent of a description.
fn with_addresses<'a>(
    description: &'a AgentDescription,
    addresses: &[String],
) -> Cow<'a, AgentDescription> {
    match &description.name {
        Some(name) if !addresses.is_empty() => Cow::Owned(AgentDescription {
            name: Some(located(name.clone(), addresses)),
            ..description.clone()
        }),
        _ => Cow::Borrowed(description),
    }
}

struct Remote {
    source: u64,
    text: Arc<str>,
    addresses: Vec<String>,
    /// `None` if the text is not valid.
    description: Option<AgentDescription>,
    ends: Instant,
}

impl Remote {
    /// Returns the description, if it is valid, for an asker whose platform reaches the agents of this host at these
    /// addresses: with those of the agent that have the same transports.
    fn located(&self, addresses: &[String]) -> Option<Cow<'_, AgentDescription>> {
        fn transport(address: &str) -> Option<&str> {
            address.split_once("://").map(|(name, _)| name)
        }
        let own: Vec<&str> = addresses.iter().filter_map(|it| transport(it)).collect();
        let is_same = |it: &&String| transport(it).is_some_and(|it| own.contains(&it));
        let same: Vec<String> = self.addresses.iter().filter(is_same).cloned().collect();
        Some(with_addresses(self.description.as_ref()?, &same))
    }
}

const DESCRIPTION: &str = "df-agent-description";

impl Df {
    /// Creates a directory facilitator without descriptions. The identifier is its own.
    #[must_use]
    pub fn new(id: AgentId) -> Self {
        Self {
            id,
            entries: BTreeMap::new(),
            leases: BTreeSet::new(),
            platforms: BTreeMap::new(),
            is_local_changed: false,
            registered: 0,
            remote: BTreeMap::new(),
            remote_ends: BTreeSet::new(),
            subscriptions: BTreeMap::new(),
            next_subscription: 0,
            search_ids: VecDeque::new(),
            known_search_ids: HashSet::new(),
            answers: VecDeque::new(),
            revision: 0,
            addresses: None,
        }
    }

    /// Adds addresses to the agents of this host in answers, and those of agents of other hosts.
    #[must_use]
    pub fn with_addresses(self, addresses: AddressBook) -> Self {
        Self {
            addresses: Some(addresses),
            ..self
        }
    }

    /// Handles a message to the agent.
    pub fn handle_message(&mut self, now: PlatformTime, asker: &Asker, message: &Message) {
        self.expire(now.at);
        match message.performative() {
            Performative::Request => {
                let (act, content) = match self.request(now, asker, message) {
                    Ok(content) => (Performative::Inform, content),
                    Err(rejection) => answer::rejected(message, asker, rejection),
                };
                self.answer(asker, message, act, content);
            }
            Performative::Subscribe => self.subscribe(now, asker, message),
            Performative::Cancel => self.cancel(asker, message),
            act if request::expects_answer(act) => {
                let reason = Exception::UnsupportedAct(act.as_str().to_owned());
                let (act, content) = answer::rejected(message, asker, reason.into());
                self.answer(asker, message, act, content);
            }
            _ => {}
        }
        self.notify(now.at);
    }

    /// Ends leases, and makes the notifications that are due.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.expire(now);
        self.notify(now);
    }

    /// Handles the end of agents of this host: their descriptions and subscriptions end. `is_registered`
    /// returns whether an agent of this host has this name and this registration.
    pub fn handle_departures(&mut self, now: Instant, is_registered: impl Fn(&str, u64) -> bool) {
        let gone = self.entries.iter().filter(|(name, entry)| {
            entry.platform == Platform::Host && !is_registered(name, entry.registration)
        });
        let gone: Vec<Arc<str>> = gone.map(|(name, _)| Arc::clone(name)).collect();
        self.subscriptions.retain(|_, subscription| {
            let asker = &subscription.asker;
            asker.platform != Platform::Host || is_registered(asker.id.name(), asker.registration)
        });
        for name in gone {
            self.remove(&name);
        }
        self.notify(now);
    }

    /// Returns the descriptions that agents of this host have registered for agents of all hosts, the
    /// earliest registration first. Returns `None` if they have not changed since the last call.
    ///
    /// A description whose scope does not include `global` is not among them.
    pub fn poll_local(&mut self) -> Option<Vec<LocalEntry>> {
        if !std::mem::take(&mut self.is_local_changed) {
            return None;
        }
        let local = self.entries.iter().filter(|(_, entry)| {
            entry.platform == Platform::Host && remote::is_global(&entry.description)
        });
        let mut local: Vec<_> = local.collect();
        local.sort_unstable_by_key(|(_, entry)| entry.position);
        let entries = local.into_iter().map(|(name, entry)| LocalEntry {
            name: Arc::clone(name),
            registration: entry.registration,
            text: entry.text.clone(),
            lease: entry.ends,
        });
        Some(entries.collect())
    }

    /// Makes [`poll_local`](Self::poll_local) return the descriptions, because the addresses of the agents have changed.
    pub fn handle_relocation(&mut self) {
        self.is_local_changed = true;
    }

    /// Sets the descriptions from the directory facilitators of other hosts. Those that are missing end
    /// at once. Returns whether a host has sent more than [`limits::REMOTE_CHANGES`] new descriptions:
    /// the caller then calls again after [`limits::REMOTE_PAUSE`], and never earlier.
    pub fn handle_remote(&mut self, now: PlatformTime, entries: &[RemoteEntry]) -> bool {
        let named: BTreeMap<&str, &RemoteEntry> = entries
            .iter()
            .filter(|entry| entry.ends > now.at)
            .map(|entry| (&*entry.name, entry))
            .collect();
        let gone = self.remote.iter().filter(|(name, known)| {
            let entry = named.get(&***name);
            entry.is_none_or(|entry| entry.source != known.source)
        });
        let gone: Vec<Arc<str>> = gone.map(|(name, _)| Arc::clone(name)).collect();
        for name in gone {
            self.set_remote(&name, None);
        }
        let mut changes: HashMap<u64, usize> = HashMap::new();
        let mut has_more = false;
        for entry in named.into_values() {
            if let Some(known) = self.remote.get_mut(&entry.name)
                && known.text == entry.text
            {
                known.addresses.clone_from(&entry.addresses);
                if known.ends != entry.ends {
                    let name = &entry.name;
                    self.remote_ends.remove(&(known.ends, Arc::clone(name)));
                    self.remote_ends.insert((entry.ends, Arc::clone(name)));
                    known.ends = entry.ends;
                    if let Some(description) = &mut known.description {
                        description.lease_time = remote::lease_time(now, entry);
                    }
                }
                continue;
            }
            let of_source = changes.entry(entry.source).or_default();
            if *of_source >= limits::REMOTE_CHANGES {
                has_more = true;
                continue;
            }
            *of_source += 1;
            let is_known = self.remote.contains_key(&entry.name);
            if is_known || self.remote.len() < limits::REMOTE_DESCRIPTIONS {
                let remote = Remote {
                    source: entry.source,
                    text: Arc::clone(&entry.text),
                    addresses: entry.addresses.clone(),
                    description: remote::read(now, entry),
                    ends: entry.ends,
                };
                self.set_remote(&entry.name, Some(remote));
            }
        }
        self.expire(now.at);
        self.notify(now.at);
        has_more
    }

    /// Adds, replaces or removes a remote description.
    fn set_remote(&mut self, name: &Arc<str>, remote: Option<Remote>) {
        let before = self.remote.remove(name);
        if let Some(before) = &before {
            self.remote_ends.remove(&(before.ends, Arc::clone(name)));
        }
        if !self.entries.contains_key(name) {
            let of = |remote: Option<&Remote>| remote.and_then(|it| it.description.clone());
            let (before, after) = (of(before.as_ref()), of(remote.as_ref()));
            self.changed(name, before.as_ref(), after.as_ref());
        }
        if let Some(remote) = remote {
            self.remote_ends.insert((remote.ends, Arc::clone(name)));
            self.remote.insert(Arc::clone(name), remote);
        }
    }

    /// Returns what a successor takes over: the descriptions, the earliest registration first, and the
    /// subscriptions of agents without a registration.
    #[must_use]
    pub fn keep(&self, now: Instant) -> (Vec<StoredDescription>, Vec<StoredSubscription>) {
        let mut entries: Vec<_> = self.entries.iter().collect();
        entries.sort_unstable_by_key(|(_, entry)| entry.position);
        let entries = entries.into_iter().filter_map(|(name, entry)| {
            Some(StoredDescription {
                name: Arc::clone(name),
                registration: entry.registration,
                platform: entry.platform,
                lease_left: lease_left(now, entry.ends),
                text: entry.stored_text.clone()?,
            })
        });
        let subscriptions = self.subscriptions.values();
        let subscriptions = subscriptions.filter_map(Subscription::keep);
        (entries.collect(), subscriptions.collect())
    }

    /// Returns a number that differs from an earlier one if [`keep`](Self::keep) may return something
    /// else than it did then.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// Takes over what a predecessor kept, `elapsed` before now. Descriptions and subscriptions that are
    /// not valid are left out. Those of platforms that do not `stay` end, which subscribers are told.
    pub fn take_over(
        &mut self,
        now: PlatformTime,
        elapsed: Duration,
        (entries, subscriptions): (&[StoredDescription], &[StoredSubscription]),
        stays: impl Fn(Platform) -> bool,
    ) {
        for stored in entries {
            let entry = self.kept_entry(now, elapsed, stored);
            if let Some(entry) = entry {
                self.registered += 1;
                self.insert(Arc::clone(&stored.name), entry);
            }
        }
        for stored in subscriptions.iter().filter(|stored| stays(stored.platform)) {
            self.take_over_subscription(now, stored);
        }
        let gone = self.entries.iter().filter(|(_, it)| !stays(it.platform));
        let gone: Vec<Arc<str>> = gone.map(|(name, _)| Arc::clone(name)).collect();
        for name in gone {
            self.remove(&name);
        }
        self.expire(now.at);
    }

    fn kept_entry(
        &self,
        now: PlatformTime,
        elapsed: Duration,
        stored: &StoredDescription,
    ) -> Option<Entry> {
        if self.entries.contains_key(&stored.name) || self.is_full(stored.platform) {
            return None;
        }
        let read = |term: &Term<'_>| AgentDescription::from_term(term).ok();
        let description = read_object(stored.text.as_bytes(), read)?;
        description.check().ok()?;
        let name = description.name.as_ref()?;
        if *name.name() != *stored.name || is_too_large(&description) {
            return None;
        }
        let ends = stored.ends(now.at, elapsed);
        let (platform, registration) = (stored.platform, stored.registration);
        let position = self.registered;
        Some(Entry::new(
            platform,
            registration,
            description,
            ends,
            position,
        ))
    }

    fn take_over_subscription(&mut self, now: PlatformTime, stored: &StoredSubscription) {
        let Some((asker, message)) = stored.read() else {
            return;
        };
        let Ok((mut subscription, _)) = Subscription::read(&message, &asker, &self.id, now.at)
        else {
            return;
        };
        if self.make_room(&asker).is_err() {
            return;
        }
        match &stored.changed {
            Some(changed) => {
                let changed = changed.iter().take(limits::CHANGES);
                changed.for_each(|name| subscription.changed.insert(name));
            }
            None => self.all_changed(&mut subscription),
        }
        self.add(subscription);
    }

    /// Handles the outcome of a notification. A subscription whose notification was not delivered ends.
    pub fn handle_sent(&mut self, now: Instant, id: SubscriptionId, is_delivered: bool) {
        if !is_delivered {
            self.subscriptions.remove(&id);
        } else if let Some(subscription) = self.subscriptions.get_mut(&id) {
            subscription.arrived();
        }
        self.revision += 1;
        self.notify(now);
    }

    /// Returns the time of the next call of [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let leases = self.leases.first().into_iter();
        let leases = leases
            .chain(self.remote_ends.first())
            .map(|(ends, _)| *ends);
        let waiting = self.subscriptions.values();
        let waiting = waiting
            .filter(|it| !it.is_under_way && !it.changed.is_empty())
            .map(|it| it.not_before);
        leases.chain(waiting).min()
    }

    /// Returns the next message to be sent.
    pub fn poll_answer(&mut self) -> Option<PlatformAnswer> {
        self.answers.pop_front()
    }

    /// Returns the descriptions that agents registered here, sorted by name.
    pub fn descriptions(&self) -> impl Iterator<Item = &AgentDescription> {
        self.entries.values().map(|entry| &entry.description)
    }

    /// Returns the valid descriptions from the directory facilitators of other hosts, sorted by name.
    pub fn remote_descriptions(&self) -> impl Iterator<Item = &AgentDescription> {
        let remote = self.remote.values();
        remote.filter_map(|remote| remote.description.as_ref())
    }

    /// Returns the number of subscriptions.
    #[must_use]
    pub fn subscriptions(&self) -> usize {
        self.subscriptions.len()
    }

    fn answer(&mut self, asker: &Asker, message: &Message, act: Performative, content: Vec<u8>) {
        let answer = answer::reply(message, asker, &self.id, act).content(content);
        self.answers.extend(answer::to_asker(asker, answer));
    }

    /// Executes a request and returns the content of the answer.
    fn request<'m>(
        &mut self,
        now: PlatformTime,
        asker: &Asker,
        message: &'m Message,
    ) -> Result<Vec<u8>, Rejection<'m>> {
        let request = Request::read(message, asker, &self.id)?;
        let answer = self.execute(now, asker, &request);
        answer.map_err(|reason| Rejection::of(request.action, reason))
    }

    fn execute(
        &mut self,
        now: PlatformTime,
        asker: &Asker,
        request: &Request<'_>,
    ) -> Result<Vec<u8>, Exception> {
        match &*request.function {
            "register" | "modify" => {
                request::authorize(asker, request)?;
                let [description] = request.arguments([DESCRIPTION])?;
                let asked = AgentDescription::from_term(description)?;
                let (description, ends) = granted(now, asker, asked.clone())?;
                // The asker learns a lease that differs from the one it asked for.
                let done = match description == asked {
                    true => request.done.clone(),
                    false => {
                        let action = request.with_argument(description.to_term());
                        let done = Content::from(Wff::done(action));
                        answer::printed(asker.dialect, &done)?
                    }
                };
                let position = self.registered;
                let entry = Entry::new(
                    asker.platform,
                    asker.registration,
                    description,
                    ends,
                    position,
                );
                match &*request.function {
                    "register" => self.register(asker, entry)?,
                    _ => self.modify(asker, entry)?,
                }
                Ok(done)
            }
            "deregister" => {
                request::authorize(asker, request)?;
                let [description] = request.arguments([DESCRIPTION])?;
                let description = AgentDescription::from_term(description)?;
                if description.name.is_none() {
                    return Err(Exception::missing(DESCRIPTION, "name"));
                }
                self.own_entry(asker)?;
                self.remove(asker.id.name());
                Ok(request.done.clone())
            }
            "search" => {
                let [template, constraints] = request.arguments([DESCRIPTION, CONSTRAINTS])?;
                let template = checked_template(AgentDescription::from_term(template)?)?;
                let constraints = Constraints::from_term(constraints)?;
                let found = self.search(&template, &constraints, asker)?;
                answer::search_result(request, found, asker.dialect)
            }
            other => Err(Exception::UnsupportedFunction(other.to_owned())),
        }
    }

    fn register(&mut self, asker: &Asker, entry: Entry) -> Result<(), Exception> {
        if self.entries.contains_key(asker.id.name()) {
            return Err(Exception::AlreadyRegistered);
        }
        if self.is_full(entry.platform) {
            let words = "the directory has no room for a further description of this platform";
            return Err(Exception::InternalError(words.to_owned()));
        }
        let name: Arc<str> = asker.id.name().into();
        let hidden = self.remote_of(&name).cloned();
        self.changed(&name, hidden.as_ref(), Some(&entry.description));
        self.registered += 1;
        self.insert(name, entry);
        Ok(())
    }

    /// Whether there is no room for a further description of this platform.
    fn is_full(&self, platform: Platform) -> bool {
        let count = |platform| self.platforms.get(&platform).copied().unwrap_or(0);
        let foreign = self.entries.len() - count(Platform::Host);
        self.entries.len() >= limits::DESCRIPTIONS
            || platform != Platform::Host
                && (foreign >= limits::FOREIGN_DESCRIPTIONS
                    || count(platform) >= limits::DESCRIPTIONS_OF_PLATFORM)
    }

    fn modify(&mut self, asker: &Asker, mut entry: Entry) -> Result<(), Exception> {
        self.own_entry(asker)?;
        let name: Arc<str> = asker.id.name().into();
        let new = entry.description.clone();
        let old = self.take(&name).map(|(_, old)| old);
        if let Some(old) = &old {
            entry.position = old.position;
        }
        self.insert(Arc::clone(&name), entry);
        self.changed(&name, old.as_ref().map(|old| &old.description), Some(&new));
        Ok(())
    }

    /// Checks that the asker has an entry that it may change.
    fn own_entry(&self, asker: &Asker) -> Result<(), Exception> {
        match self.entries.get(asker.id.name()) {
            None => Err(Exception::NotRegistered),
            Some(entry) if entry.platform != asker.platform => Err(Exception::Unauthorised),
            Some(_) => Ok(()),
        }
    }

    fn remove(&mut self, name: &str) {
        if let Some((name, entry)) = self.take(name) {
            let shown = self.remote_of(&name).cloned();
            self.changed(&name, Some(&entry.description), shown.as_ref());
        }
    }

    /// Returns the description of an agent from the directory facilitator of another host.
    fn remote_of(&self, name: &str) -> Option<&AgentDescription> {
        self.remote.get(name)?.description.as_ref()
    }

    /// Adds an entry under a free name.
    fn insert(&mut self, name: Arc<str>, entry: Entry) {
        self.revision += 1;
        let lease = entry.ends.map(|ends| (ends, Arc::clone(&name)));
        self.leases.extend(lease);
        *self.platforms.entry(entry.platform).or_default() += 1;
        self.is_local_changed |= entry.platform == Platform::Host;
        self.entries.insert(name, entry);
    }

    /// Removes an entry, without a notification.
    fn take(&mut self, name: &str) -> Option<(Arc<str>, Entry)> {
        let (name, entry) = self.entries.remove_entry(name)?;
        self.revision += 1;
        self.is_local_changed |= entry.platform == Platform::Host;
        if let Some(ends) = entry.ends {
            self.leases.remove(&(ends, Arc::clone(&name)));
        }
        if let Some(count) = self.platforms.get_mut(&entry.platform) {
            *count -= 1;
            if *count == 0 {
                self.platforms.remove(&entry.platform);
            }
        }
        Some((name, entry))
    }

    /// Removes the descriptions whose leases have ended.
    fn expire(&mut self, now: Instant) {
        while self.leases.first().is_some_and(|(ends, _)| *ends <= now)
            && let Some((_, name)) = self.leases.pop_first()
        {
            self.remove(&name);
        }
        while self
            .remote_ends
            .first()
            .is_some_and(|(ends, _)| *ends <= now)
            && let Some((_, name)) = self.remote_ends.pop_first()
        {
            self.set_remote(&name, None);
        }
    }

    /// Returns the descriptions from other hosts that match. Those of the hosts take turns, so that no
    /// host fills an answer that is cut.
    fn remote_matches(&self, template: &AgentDescription) -> Vec<&Remote> {
        let mut of_source: HashMap<u64, usize> = HashMap::new();
        let mut matches: Vec<(usize, &Remote)> = Vec::new();
        for (name, remote) in &self.remote {
            let Some(description) = &remote.description else {
                continue;
            };
            // The sizes of templates and descriptions bound the comparisons of one pair.
            let found = Comparisons::default().agent(template, description);
            if found.unwrap_or(false) && !self.entries.contains_key(name) {
                let turn = of_source.entry(remote.source).or_default();
                matches.push((*turn, remote));
                *turn += 1;
            }
        }
        matches.sort_by_key(|(turn, _)| *turn);
        matches.into_iter().map(|(_, it)| it).collect()
    }

    /// Returns the texts of the matching descriptions.
    fn search(
        &mut self,
        template: &AgentDescription,
        constraints: &Constraints,
        asker: &Asker,
    ) -> Result<Vec<Vec<u8>>, Exception> {
        let dialect = asker.dialect;
        if let Some(id) = &constraints.search_id {
            let (most, longest) = limits::SEARCH_IDS;
            if id.len() > longest {
                return Err(Exception::unrecognised(CONSTRAINTS, "search-id"));
            }
            if self.known_search_ids.contains(&**id) {
                let words = "search-id already served";
                return Err(Exception::InternalError(words.to_owned()));
            }
            if self.search_ids.len() >= most
                && let Some(oldest) = self.search_ids.pop_front()
            {
                self.known_search_ids.remove(&oldest);
            }
            let id: Arc<str> = id.as_str().into();
            self.search_ids.push_back(Arc::clone(&id));
            self.known_search_ids.insert(id);
        }
        let most = max_results(constraints.max_results);
        let mut comparisons = Comparisons::default();
        let mut found = Found::new(limits::RESULT_BYTES);
        let addresses = addresses_for(self.addresses.as_ref(), asker);
        for entry in self.entries.values() {
            if found.texts.len() >= most {
                break;
            }
            if comparisons.agent(template, &entry.description)?
                && !found.add(&entry.located(&addresses), dialect)
            {
                return Ok(found.texts);
            }
        }
        if found.texts.len() < most {
            let remote = self.remote_matches(template).into_iter();
            for description in remote.filter_map(|it| it.located(&addresses)) {
                if found.texts.len() >= most || !found.add(&description, dialect) {
                    break;
                }
            }
        }
        Ok(found.texts)
    }

    fn subscribe(&mut self, now: PlatformTime, asker: &Asker, message: &Message) {
        let read = match asker.is_proved {
            true => Subscription::read(message, asker, &self.id, now.at),
            // Notifications must not go to an agent that did not subscribe.
            false => Err(Exception::Unauthorised),
        };
        let admitted = read.and_then(|read| {
            // A subscription with the same conversation replaces the earlier one.
            let conversation = message.conversation_id();
            self.subscriptions
                .retain(|_, other| !other.is_of(asker, conversation));
            self.make_room(asker).map(|()| read)
        });
        self.revision += 1;
        let (mut subscription, agreed) = match admitted {
            Ok(read) => read,
            Err(reason) => {
                let (act, content) = answer::rejected(message, asker, reason.into());
                return self.answer(asker, message, act, content);
            }
        };
        self.answer(asker, message, Performative::Agree, agreed);
        self.all_changed(&mut subscription);
        self.add(subscription);
    }

    fn add(&mut self, subscription: Subscription) {
        let id = SubscriptionId(self.next_subscription);
        self.next_subscription += 1;
        self.subscriptions.insert(id, subscription);
    }

    /// Marks all descriptions that match as changed.
    fn all_changed(&self, subscription: &mut Subscription) {
        let mut comparisons = Comparisons::default();
        for (name, entry) in &self.entries {
            match comparisons.agent(&subscription.template, &entry.description) {
                Ok(true) => subscription.changed.insert(name),
                Ok(false) => {}
                Err(_) => break,
            }
        }
        for (name, remote) in &self.remote {
            let matches = remote.description.as_ref().is_some_and(|description| {
                let found = Comparisons::default().agent(&subscription.template, description);
                found.unwrap_or(false)
            });
            if matches && !self.entries.contains_key(name) {
                subscription.changed.insert(name);
            }
        }
    }

    /// Checks that the asker may have a further subscription. The oldest one of a platform of another
    /// host ends for a new one, because the end of a subscriber there is detected late.
    fn make_room(&mut self, asker: &Asker) -> Result<(), Exception> {
        let full = || {
            let words = "no further subscription is possible; cancel one";
            Exception::InternalError(words.to_owned())
        };
        let all = self.subscriptions.iter();
        let of_agent = all.clone().filter(|(_, it)| {
            it.asker.platform == asker.platform && it.asker.id.same_agent(&asker.id)
        });
        if of_agent.count() >= limits::SUBSCRIPTIONS_OF_AGENT {
            return Err(full());
        }
        let foreign = |it: &Subscription| it.asker.platform != Platform::Host;
        if asker.platform != Platform::Host {
            let same = all
                .clone()
                .filter(|(_, it)| it.asker.platform == asker.platform);
            if same.clone().count() >= limits::SUBSCRIPTIONS_OF_PLATFORM {
                let oldest = same.map(|(id, _)| *id).min();
                if let Some(oldest) = oldest {
                    self.end(
                        oldest,
                        "the platform of the subscriber has too many subscriptions",
                    );
                }
            } else if all.filter(|(_, it)| foreign(it)).count() >= limits::FOREIGN_SUBSCRIPTIONS {
                return Err(full());
            }
        }
        match self.subscriptions.len() {
            0..limits::SUBSCRIPTIONS => Ok(()),
            _ => Err(full()),
        }
    }

    /// Ends a subscription with a `failure`.
    fn end(&mut self, id: SubscriptionId, words: &str) {
        if let Some(subscription) = self.subscriptions.remove(&id) {
            self.revision += 1;
            let reason = Exception::InternalError(words.to_owned());
            let (asker, message) = (&subscription.asker, &subscription.message);
            let (act, content) = answer::rejected(message, asker, reason.into());
            self.answer(asker, message, act, content);
        }
    }

    /// Ends the subscription of this conversation (FIPA00035, the cancel meta-protocol).
    fn cancel(&mut self, asker: &Asker, message: &Message) {
        let conversation = message.conversation_id();
        let mut all = self.subscriptions.iter();
        let found = all.find(|(_, it)| it.is_of(asker, conversation));
        let cancel = fipa_content::ActionExpression::Action {
            agent: Term::from(&asker.id),
            act: Term::functional("cancel", []),
        };
        let (act, content) = match found.map(|(id, _)| *id) {
            Some(id) => {
                self.subscriptions.remove(&id);
                self.revision += 1;
                let done = Content::from(Wff::done(cancel));
                let done = request::print(asker.dialect, &done);
                (Performative::Inform, done.unwrap_or_default())
            }
            None => {
                let words = "there is no subscription with this conversation";
                let reason = Exception::InternalError(words.to_owned());
                answer::rejected(message, asker, Rejection::of(cancel, reason))
            }
        };
        self.answer(asker, message, act, content);
    }

    /// Records a change for the subscriptions whose template matches the description before or after.
    fn changed(
        &mut self,
        name: &Arc<str>,
        before: Option<&AgentDescription>,
        after: Option<&AgentDescription>,
    ) {
        let mut overrun = BTreeSet::new();
        for (id, subscription) in &mut self.subscriptions {
            // The sizes of templates and descriptions bound the comparisons of one pair.
            let matches = |description: Option<&AgentDescription>| {
                description.is_some_and(|description| {
                    let mut comparisons = Comparisons::default();
                    let found = comparisons.agent(&subscription.template, description);
                    found.unwrap_or(false)
                })
            };
            if matches(before) || matches(after) {
                subscription.changed.insert(name);
                self.revision += u64::from(subscription.is_stored());
                if subscription.changed.len() > limits::CHANGES {
                    overrun.insert(*id);
                }
            }
        }
        for id in overrun {
            self.end(id, "more changes than can wait for the subscriber");
        }
    }

    /// Makes the notifications that are due.
    fn notify(&mut self, now: Instant) {
        for (id, subscription) in &mut self.subscriptions {
            if subscription.is_under_way
                || subscription.changed.is_empty()
                || subscription.not_before > now
            {
                continue;
            }
            let mut found = Found::new(limits::NOTIFICATION_BYTES);
            let addresses = addresses_for(self.addresses.as_ref(), &subscription.asker);
            while found.texts.len() < limits::RESULTS
                && let Some(name) = subscription.changed.pop_first()
            {
                subscription.leaves(&name);
                let dialect = subscription.dialect();
                let own = self.entries.get(&name);
                let own = own.map(|entry| entry.located(&addresses));
                let remote = || self.remote.get(&name)?.located(&addresses);
                let has_room = match own.or_else(remote) {
                    Some(description) => found.add(&description, dialect),
                    // A description without services reports the end of the registration, as in JADE.
                    None => match AgentId::new(&*name) {
                        Ok(agent) => {
                            let gone = AgentDescription {
                                name: Some(agent),
                                ..AgentDescription::default()
                            };
                            found.add(&gone, dialect)
                        }
                        Err(_) => true,
                    },
                };
                if !has_room {
                    subscription.stays(name);
                    break;
                }
            }
            subscription.is_under_way = true;
            subscription.not_before = now + limits::NOTIFICATION_PAUSE;
            let (asker, message) = (&subscription.asker, &subscription.message);
            let content = subscription.notification(&found.texts);
            let notification = answer::reply(message, asker, &self.id, Performative::Inform);
            let answer = answer::to_asker(asker, notification.content(content));
            self.answers.extend(answer.map(|answer| PlatformAnswer {
                notification: Some(*id),
                ..answer
            }));
        }
    }
}

/// Descriptions for an answer, as text.
struct Found {
    texts: Vec<Vec<u8>>,
    bytes: usize,
    most_bytes: usize,
}

impl Found {
    fn new(most_bytes: usize) -> Self {
        Self {
            texts: Vec::new(),
            bytes: 0,
            most_bytes,
        }
    }

    /// Adds a description, unless the answer is long enough already. A description that the dialect has
    /// no notation for is left out.
    fn add(&mut self, description: &AgentDescription, dialect: SlDialect) -> bool {
        let Ok(text) = request::print(dialect, &description.to_term()) else {
            return true;
        };
        if !self.texts.is_empty() && self.bytes + text.len() > self.most_bytes {
            return false;
        }
        self.bytes += text.len();
        self.texts.push(text);
        true
    }
}

fn is_too_large(description: &AgentDescription) -> bool {
    let size = description.size();
    size.parts > limits::DESCRIPTION_PARTS || size.bytes > limits::DESCRIPTION_BYTES
}

/// Checks a description that is to be stored. Returns it with the granted lease, and the end of the
/// lease.
fn granted(
    now: PlatformTime,
    asker: &Asker,
    mut description: AgentDescription,
) -> Result<(AgentDescription, Option<Instant>), Exception> {
    description.check()?;
    if is_too_large(&description) {
        return Err(Exception::InternalError(format!(
            "the description is too large: at most {} parts and {} bytes of text",
            limits::DESCRIPTION_PARTS,
            limits::DESCRIPTION_BYTES
        )));
    }
    let invalid = || Exception::unrecognised(DESCRIPTION, "lease-time");
    let asked = match description.lease_time {
        None => None,
        Some(time) => {
            let lease_left = time.to_system_time(now.wall).duration_since(now.wall);
            let lease_left = lease_left.ok().filter(|time| !time.is_zero());
            Some(lease_left.ok_or_else(invalid)?)
        }
    };
    let lease = match asker.platform {
        Platform::Host => asked,
        _ => Some(asked.unwrap_or(limits::LEASE).min(limits::LEASE)),
    };
    let Some(lease) = lease else {
        return Ok((description, None));
    };
    let is_relative = description.lease_time.is_some_and(Time::is_relative);
    if asked != Some(lease) || is_relative {
        let until = now.wall.checked_add(lease).ok_or_else(invalid)?;
        description.lease_time = Some(Time::from_system_time(until).map_err(|_| invalid())?);
    }
    // A lease beyond the range of the clock does not end.
    Ok((description, now.at.checked_add(lease)))
}
