//! Back end for agents of other hosts that are known only from a letter of theirs.
//!
//! A letter may arrive before the announcement of its sender, and agents of other platforms are never
//! announced. This back end makes it possible to answer such a sender. A conversation may pause for days, so a
//! contact has no end by time: it stays until its place is needed.

use std::collections::{BTreeSet, HashMap, HashSet, VecDeque};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_transport::{Incarnation, Location, PeerId, Principal};
use parking_lot::Mutex;

use crate::entry::{millis_of_time, time_of_millis};
use crate::table::Table;
use crate::{Directory, Entry, EntryError, MtsId, Reach, Role, Source, Subscriber};

/// The error of [`ContactDirectory::record_sender`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ContactError {
    /// The entry of the sender is not valid.
    #[error(transparent)]
    Entry(#[from] EntryError),
    /// An agent of another host has the name, and exchanged a letter with this host within
    /// [`ContactDirectory::SILENCE`].
    #[error("an agent at {0} has the name")]
    Taken(Location),
    /// The agent has no location.
    #[error("the agent has no address")]
    NoLocation,
    /// All contacts that could make room are [pinned](ContactDirectory::pin).
    #[error("the contacts of this host and its source are all in use")]
    Full,
}

/// Agents of other hosts that sent a letter.
///
/// Bounded: a host has [`MAX_OF_HOST`](Self::MAX_OF_HOST) contacts at most, all hosts
/// [`MAX_CONTACTS`](Self::MAX_CONTACTS). Beyond that, a new contact replaces another one: the first without a
/// letter from this side, of the host with the most; otherwise the one without a letter in either direction for
/// the longest time. The latest that were replaced are the [lost agents](crate::View::lost_agents).
///
/// A contact must not replace the entries of other back ends: merge this directory last, and drop a contact as
/// soon as another back end has the agent ([`forget`](Self::forget)).
#[derive(Debug)]
pub struct ContactDirectory {
    table: Table<()>,
    contacts: Mutex<Contacts>,
}

#[derive(Debug, Default)]
struct Contacts {
    all: HashMap<Arc<str>, Contact>,
    /// The contacts of each host; the first is the next to be replaced.
    of_host: HashMap<PeerId, BTreeSet<Rank>>,
    pinned: HashSet<Arc<str>>,
    /// The contacts that were replaced last.
    replaced: VecDeque<Arc<Entry>>,
    /// Number of uses so far.
    uses: u64,
}

#[derive(Debug)]
struct Contact {
    entry: Arc<Entry>,
    host: PeerId,
    rank: Rank,
    /// The host name in the address that it states, which was replaced by the address of its connection.
    host_name: Option<Box<str>>,
    /// The time of the last letter in either direction.
    used: Instant,
    /// The time of its last letter.
    last_letter: Instant,
}

/// The place of a contact in the order in which contacts are replaced.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Rank {
    is_pinned: bool,
    /// Whether an agent of this side has sent it a letter.
    is_answered: bool,
    /// The number of its last use.
    last_use: u64,
    name: Arc<str>,
}

impl Contacts {
    /// Gives a contact another rank.
    fn change(&mut self, name: &str, change: impl FnOnce(&mut Contact)) {
        let Some(contact) = self.all.get_mut(name) else {
            return;
        };
        let order = self.of_host.entry(contact.host.clone()).or_default();
        order.remove(&contact.rank);
        change(contact);
        order.insert(contact.rank.clone());
    }

    fn use_now(&mut self, now: Instant, name: &str, change: impl FnOnce(&mut Contact)) {
        self.uses += 1;
        let uses = self.uses;
        self.change(name, |contact| {
            contact.rank.last_use = uses;
            contact.used = now;
            change(contact);
        });
    }

    fn insert(&mut self, contact: Contact) {
        let order = self.of_host.entry(contact.host.clone()).or_default();
        order.insert(contact.rank.clone());
        self.all.insert(Arc::clone(&contact.entry.name), contact);
    }

    fn remove(&mut self, name: &str) -> Option<Contact> {
        let contact = self.all.remove(name)?;
        if let Some(order) = self.of_host.get_mut(&contact.host) {
            order.remove(&contact.rank);
            if order.is_empty() {
                self.of_host.remove(&contact.host);
            }
        }
        Some(contact)
    }

    /// Removes and returns the contact that a new one of this host replaces, if there is no room for both.
    fn make_room(&mut self, host: &PeerId) -> Result<Option<Contact>, ContactError> {
        let own = self.of_host.get(host);
        let rank = if own.is_some_and(|own| own.len() >= ContactDirectory::MAX_OF_HOST) {
            own.and_then(BTreeSet::first)
        } else if self.all.len() >= ContactDirectory::MAX_CONTACTS {
            let firsts = || {
                let hosts = self.of_host.values();
                hosts.filter_map(|of_host| Some((of_host.len(), of_host.first()?)))
            };
            let unanswered = firsts().filter(|(_, first)| !first.is_pinned && !first.is_answered);
            let most = unanswered.max_by_key(|(most, _)| *most);
            most.or_else(|| firsts().min_by_key(|(_, first)| *first))
                .map(|(_, first)| first)
        } else {
            return Ok(None);
        };
        let rank = rank.filter(|rank| !rank.is_pinned);
        let name = Arc::clone(&rank.ok_or(ContactError::Full)?.name);
        Ok(self.remove(&name))
    }
}

impl ContactDirectory {
    /// Maximum number of contacts.
    pub const MAX_CONTACTS: usize = 8_192;
    /// Maximum number of contacts of one host.
    pub const MAX_OF_HOST: usize = 2_048;
    /// Time without a letter in either direction after which an agent of another host may take over the name.
    pub const SILENCE: Duration = Duration::from_secs(60);
    /// Time for which a contact is kept if its gateway sends the agents of its host and this agent is
    /// not among them: it has left.
    pub const UNLISTED: Duration = Duration::from_secs(5);
    /// Number of replaced contacts that are known as [lost](crate::View::lost_agents).
    const MAX_REPLACED: usize = 256;

    /// Creates an empty directory.
    #[must_use]
    pub fn new() -> Self {
        Self {
            table: Table::new(),
            contacts: Mutex::default(),
        }
    }

    /// Records that an agent of another host sent a letter at `now`; letters to it go to
    /// `location`, which has the incarnation of the message transport service there. Returns the contact
    /// that made room; its time of registration is that of this change.
    ///
    /// # Errors
    /// Fails when the name is not valid, another host has it, or there is no room.
    pub fn record_sender(
        &self,
        now: Instant,
        name: &str,
        incarnation: Incarnation,
        location: Location,
    ) -> Result<Option<Arc<Entry>>, ContactError> {
        self.record(now, (name, incarnation), vec![location], None, false)
    }

    /// Records an agent like [`record_sender`](Self::record_sender), whose address states this host name instead of the address of its
    /// connection.
    ///
    /// # Errors
    /// As for [`record_sender`](Self::record_sender).
    pub fn record_sender_of_host(
        &self,
        now: Instant,
        name: &str,
        location: Location,
        host_name: &str,
    ) -> Result<Option<Arc<Entry>>, ContactError> {
        let agent = (name, Incarnation::UNKNOWN);
        self.record(now, agent, vec![location], Some(host_name), false)
    }

    /// Records an agent of another platform at these locations, the preferred one first, because an agent of this
    /// host wants to write to it. With `is_given`, the operator or a program of this host gave the locations, which
    /// replace those of an agent without a registration that has the name.
    ///
    /// # Errors
    /// As for [`record_sender`](Self::record_sender), and if `locations` is empty.
    pub fn introduce(
        &self,
        now: Instant,
        name: &str,
        locations: Vec<Location>,
        is_given: bool,
    ) -> Result<Option<Arc<Entry>>, ContactError> {
        if locations.is_empty() {
            return Err(ContactError::NoLocation);
        }
        let agent = (name, Incarnation::UNKNOWN);
        self.record(now, agent, locations, None, is_given)
    }

    fn record(
        &self,
        now: Instant,
        (name, incarnation): (&str, Incarnation),
        locations: Vec<Location>,
        host_name: Option<&str>,
        is_given: bool,
    ) -> Result<Option<Arc<Entry>>, ContactError> {
        let first = locations.first();
        let gateway = first.map_or(Incarnation::UNKNOWN, Location::incarnation);
        let host = PeerId::of(Principal::Unproved, first);
        let entry = Entry {
            name: name.into(),
            agent_type: String::new(),
            incarnation,
            mts: MtsId::unnamed(gateway),
            locations,
            description: String::new(),
            registered: time_of_millis(millis_of_time(SystemTime::now())),
            source: Source::Contact,
            reach: Reach::Remote { gateway },
            peer: host.clone(),
            role: Role::Agent,
        };
        entry.check()?;
        let mut contacts = self.contacts.lock();
        let known = contacts.all.get(name);
        if let Some(known) = known {
            if known.entry.incarnation == incarnation && known.entry.locations == entry.locations {
                contacts.use_now(now, name, |contact| {
                    contact.last_letter = now;
                    if let Some(host_name) = host_name {
                        contact.host_name = Some(host_name.into());
                    }
                });
                return Ok(None);
            }
            let is_in_use = now.saturating_duration_since(known.used) < Self::SILENCE;
            let is_same = known.host == host
                && (!gateway.is_known() || known.entry.mts.incarnation == gateway);
            let is_replaced = is_given && !known.entry.incarnation.is_known();
            if !is_same && is_in_use && !is_replaced {
                let taken = known.entry.locations.first();
                return Err(taken.map_or(ContactError::Full, |it| ContactError::Taken(it.clone())));
            }
        }
        let before = contacts.remove(name);
        let replaced = match contacts.make_room(&host) {
            Ok(replaced) => replaced.map(|it| self.replace(&mut contacts, it)),
            Err(error) => {
                if let Some(before) = before {
                    contacts.insert(before);
                }
                return Err(error);
            }
        };
        let entry = Arc::new(entry);
        self.table.put((), Arc::clone(&entry));
        if contacts.replaced.iter().any(|it| *it.name == *name) {
            contacts.replaced.retain(|it| *it.name != *name);
            self.table.set_lost(contacts.replaced.iter().cloned());
        }
        contacts.uses += 1;
        let rank = Rank {
            is_pinned: contacts.pinned.contains(name),
            is_answered: before.is_some_and(|before| before.rank.is_answered),
            last_use: contacts.uses,
            name: Arc::clone(&entry.name),
        };
        contacts.insert(Contact {
            entry,
            host,
            rank,
            host_name: host_name.map(Into::into),
            used: now,
            last_letter: now,
        });
        Ok(replaced)
    }

    /// Takes a contact that made room out of the directory. Its entry tells senders when.
    fn replace(&self, contacts: &mut Contacts, contact: Contact) -> Arc<Entry> {
        let entry = contact.entry;
        let lost = Arc::new(Entry {
            registered: time_of_millis(millis_of_time(SystemTime::now())),
            ..Entry::clone(&entry)
        });
        if contacts.replaced.len() >= Self::MAX_REPLACED {
            contacts.replaced.pop_front();
        }
        contacts.replaced.push_back(Arc::clone(&lost));
        self.table.set_lost(contacts.replaced.iter().cloned());
        self.table.release((), &entry.name, entry.incarnation);
        lost
    }

    /// Records another letter of a contact at `now`.
    pub fn record_further_letter(&self, now: Instant, name: &str) {
        let mut contacts = self.contacts.lock();
        contacts.use_now(now, name, |contact| contact.last_letter = now);
    }

    /// Records that a contact took a letter from an agent of this side at `now`.
    pub fn took(&self, now: Instant, name: &str) {
        let mut contacts = self.contacts.lock();
        contacts.use_now(now, name, |contact| contact.rank.is_answered = true);
    }

    /// Returns the addresses of the hosts that state this host name in the addresses of their agents, at most two.
    #[must_use]
    pub fn hosts_named(&self, host_name: &str) -> Vec<IpAddr> {
        let contacts = self.contacts.lock();
        let mut found: Vec<IpAddr> = Vec::new();
        for contact in contacts.all.values() {
            let states_it = contact.host_name.as_deref() == Some(host_name);
            let location = contact.entry.locations.first().filter(|_| states_it);
            let at = location.and_then(|it| it.authority().parse::<SocketAddr>().ok());
            if let Some(at) = at
                && !found.contains(&at.ip())
            {
                found.push(at.ip());
                if found.len() >= 2 {
                    break;
                }
            }
        }
        found
    }

    /// Sets the names of contacts that stay, because they have left something here that refers to them, such as a
    /// subscription. Replaces the earlier names.
    pub fn pin(&self, names: HashSet<Arc<str>>) {
        let mut contacts = self.contacts.lock();
        let before = std::mem::replace(&mut contacts.pinned, names);
        let changed = before.symmetric_difference(&contacts.pinned);
        let changed: Vec<Arc<str>> = changed.cloned().collect();
        for name in changed {
            let is_pinned = contacts.pinned.contains(&name);
            contacts.change(&name, |contact| contact.rank.is_pinned = is_pinned);
        }
    }

    /// Drops the contacts at these gateways.
    pub fn withdraw(&self, gateways: &HashSet<Incarnation>) {
        self.drop_those(|contact| gateways.contains(&contact.entry.mts.incarnation));
    }

    fn drop_those(&self, mut which: impl FnMut(&Contact) -> bool) {
        let mut contacts = self.contacts.lock();
        let removed = contacts.all.values().filter(|contact| which(contact));
        let removed: Vec<Arc<Entry>> = removed.map(|contact| Arc::clone(&contact.entry)).collect();
        for entry in removed {
            contacts.remove(&entry.name);
            self.table.release((), &entry.name, entry.incarnation);
        }
    }

    /// Drops contacts that `others`, the other back ends, know, and those without a letter for
    /// [`UNLISTED`](Self::UNLISTED) if `others` [speak for](Directory::speaks_for) their gateway. Returns the time
    /// at which to call this again.
    pub fn forget(&self, now: Instant, others: &dyn Directory) -> Option<Instant> {
        let mut next: Option<Instant> = None;
        self.drop_those(|contact| {
            let gateway = contact.entry.mts.incarnation;
            let until = contact.last_letter + Self::UNLISTED;
            let is_unlisted = now >= until && others.speaks_for(gateway);
            if is_unlisted || others.known(&contact.entry.name).is_some() {
                return true;
            }
            if gateway.is_known() {
                // `others` may begin to speak for the gateway without a notification.
                let check = match until > now {
                    true => until,
                    false => now + Self::UNLISTED,
                };
                next = Some(next.map_or(check, |next| next.min(check)));
            }
            false
        });
        next
    }
}

impl Default for ContactDirectory {
    fn default() -> Self {
        Self::new()
    }
}

impl Directory for ContactDirectory {
    reads_its_table!(viewed table);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Exchange, MergedDirectory, Present, StaticDirectory};

    fn location() -> Location {
        "tcp://192.0.2.1:7788#00000000000000aa".parse().unwrap()
    }

    fn incarnation(number: u64) -> Incarnation {
        Incarnation::from_u64(number)
    }

    #[test]
    fn a_sender_is_a_contact_without_an_end_by_time() {
        let contacts = ContactDirectory::new();
        let start = Instant::now();
        let record =
            |at, number| contacts.record_sender(at, "arm", incarnation(number), location());
        assert_eq!(record(start, 1), Ok(None));
        assert_eq!(record(start, 1), Ok(None));
        let entry = contacts.lookup("arm").unwrap();
        assert_eq!(entry.locations, [location()]);
        assert_eq!(contacts.by_incarnation(incarnation(1)).unwrap(), entry);
        // Another incarnation at the same gateway replaces it.
        assert_eq!(record(start, 2), Ok(None));
        assert!(contacts.by_incarnation(incarnation(1)).is_none());
        let month = start + Duration::from_secs(30 * 24 * 60 * 60);
        let next = contacts.forget(month, &nothing());
        assert_eq!(next, Some(month + ContactDirectory::UNLISTED));
        assert!(contacts.lookup("arm").is_some());
    }

    #[test]
    fn an_introduced_agent_has_all_its_locations_in_their_order() {
        let contacts = ContactDirectory::new();
        let now = Instant::now();
        let at = |hosts: &[u8]| -> Vec<Location> {
            let texts = hosts
                .iter()
                .map(|it| format!("http://192.0.2.{it}:7778/acc"));
            texts.map(|it| it.parse().unwrap()).collect()
        };
        contacts
            .introduce(now, "echo@jade", at(&[2, 1]), false)
            .unwrap();
        assert_eq!(contacts.lookup("echo@jade").unwrap().locations, at(&[2, 1]));
        // A received identifier does not move the agent; the operator does.
        let moved = contacts.introduce(now, "echo@jade", at(&[3]), false);
        assert!(matches!(moved, Err(ContactError::Taken(_))), "{moved:?}");
        contacts
            .introduce(now, "echo@jade", at(&[3]), true)
            .unwrap();
        assert_eq!(contacts.lookup("echo@jade").unwrap().locations, at(&[3]));
        // A registered agent of another gateway keeps its name.
        contacts
            .record_sender(now, "arm", incarnation(1), location())
            .unwrap();
        let moved = contacts.introduce(now, "arm", at(&[3]), true);
        assert!(matches!(moved, Err(ContactError::Taken(_))), "{moved:?}");
        assert!(contacts.introduce(now, "none", Vec::new(), true).is_err());
    }

    #[test]
    fn a_host_name_leads_to_the_hosts_that_state_it() {
        let contacts = ContactDirectory::new();
        let state = |name: &str, host: u8| {
            let at = format!("http://192.0.2.{host}:7778/acc").parse().unwrap();
            let now = Instant::now();
            contacts
                .record_sender_of_host(now, name, at, "crex")
                .unwrap();
        };
        assert!(contacts.hosts_named("crex").is_empty());
        state("a@crex", 1);
        state("b@crex", 1);
        let first: IpAddr = "192.0.2.1".parse().unwrap();
        assert_eq!(contacts.hosts_named("crex"), [first]);
        state("c@crex", 2);
        assert_eq!(contacts.hosts_named("crex").len(), 2);
        assert!(contacts.hosts_named("other").is_empty());
    }

    /// A platform keeps its names while it is silent for less than a minute, whoever else states them.
    #[test]
    fn another_host_takes_over_the_name_of_a_silent_contact_only() {
        let contacts = ContactDirectory::new();
        let jade = |host: &str| -> Location { format!("http://{host}:7778/acc").parse().unwrap() };
        let record =
            |at, host| contacts.record_sender(at, "echo@jade", Incarnation::UNKNOWN, jade(host));
        let start = Instant::now();
        let just_before = |at: Instant| at.checked_sub(Duration::from_millis(1)).unwrap();
        record(start, "192.0.2.1").unwrap();
        let silent = start + ContactDirectory::SILENCE;
        let taken = Err(ContactError::Taken(jade("192.0.2.1")));
        assert_eq!(record(just_before(silent), "192.0.2.2"), taken);
        // A letter in either direction shows that it is there.
        contacts.took(just_before(silent), "echo@jade");
        assert_eq!(record(silent, "192.0.2.2"), taken);
        contacts.record_further_letter(silent, "echo@jade");
        let later = silent + ContactDirectory::SILENCE;
        assert_eq!(record(just_before(later), "192.0.2.2"), taken);
        assert_eq!(record(later, "192.0.2.2"), Ok(None));
        let entry = contacts.lookup("echo@jade").unwrap();
        assert_eq!(entry.locations, [jade("192.0.2.2")]);
        // On its own host, its port may change at any time.
        let moved: Location = "http://192.0.2.2:7779/acc".parse().unwrap();
        let record =
            contacts.record_sender(later, "echo@jade", Incarnation::UNKNOWN, moved.clone());
        assert_eq!(record, Ok(None));
        let entry = contacts.lookup("echo@jade").unwrap();
        assert_eq!(entry.locations, [moved]);
    }

    #[test]
    fn the_address_of_a_sender_is_no_name_of_its_service() {
        let contacts = ContactDirectory::new();
        for (number, at) in (1..).zip([
            "tcp://192.0.2.1:7788#00000000000000aa",
            "tcp://[fd99::1]:7788#00000000000000aa",
            "tcp://[fe80::1%2]:7788#00000000000000aa",
            "http://[::1]:7778/acc",
        ]) {
            let (name, location) = (format!("arm {number}"), at.parse().unwrap());
            let record =
                contacts.record_sender(Instant::now(), &name, incarnation(number), location);
            assert_eq!(record, Ok(None), "{at}");
            assert_eq!(contacts.lookup(&name).unwrap().mts.name, None);
        }
    }

    fn nothing() -> MergedDirectory {
        MergedDirectory::new(Vec::new())
    }

    #[test]
    fn a_contact_that_its_gateway_does_not_list_is_dropped_early() {
        let contacts = ContactDirectory::new();
        let start = Instant::now();
        let gateway = location().incarnation();
        let mut exchange = Exchange::new(0);
        let mts = MtsId::new("arm-mts", gateway);
        exchange.handle_neighbors(start, &[Present::unproved(mts, vec![location()])]);
        let known = exchange.directory();
        contacts
            .record_sender(start, "arm", incarnation(1), location())
            .unwrap();
        let soon = start + ContactDirectory::UNLISTED;
        assert!(contacts.forget(soon, &*known) > Some(soon));
        assert!(contacts.lookup("arm").is_some());
        let listed =
            br#"{"version":1,"tell":{"full":{"version":0,"first":true,"last":true,"agents":[]}}}"#;
        exchange.handle_letter(start, gateway, listed).unwrap();
        assert_eq!(contacts.forget(start, &*known), Some(soon));
        assert!(contacts.lookup("arm").is_some());
        // Another letter shows that the agent is there.
        contacts
            .record_sender(soon, "arm", incarnation(1), location())
            .unwrap();
        let later = soon + ContactDirectory::UNLISTED;
        assert_eq!(contacts.forget(soon, &*known), Some(later));
        assert_eq!(contacts.forget(later, &*known), None);
        assert!(contacts.lookup("arm").is_none());
    }

    #[test]
    fn a_contact_that_another_back_end_knows_is_dropped() {
        let contacts = ContactDirectory::new();
        let now = Instant::now();
        contacts
            .record_sender(now, "arm", incarnation(1), location())
            .unwrap();
        contacts
            .record_sender(now, "leg", incarnation(2), location())
            .unwrap();
        let known = StaticDirectory::new([("arm", vec![location()])]).unwrap();
        contacts.forget(now, &known);
        assert!(contacts.lookup("arm").is_none());
        assert!(contacts.lookup("leg").is_some());
    }

    /// Contacts of the host with this number, named by their numbers.
    fn fill(
        contacts: &ContactDirectory,
        host: u8,
        numbers: std::ops::Range<usize>,
    ) -> Vec<Option<Arc<Entry>>> {
        let record = numbers.map(|number| {
            let (name, location) = (format!("{host} {number}"), at_host(host));
            let record =
                contacts.record_sender(Instant::now(), &name, Incarnation::UNKNOWN, location);
            record.unwrap()
        });
        record.collect()
    }

    fn at_host(host: u8) -> Location {
        format!("http://192.0.2.{host}:7778/acc").parse().unwrap()
    }

    #[test]
    fn a_host_replaces_its_own_contacts_beyond_its_share() {
        let contacts = ContactDirectory::new();
        fill(&contacts, 2, 0..1);
        let most = ContactDirectory::MAX_OF_HOST;
        let record = fill(&contacts, 1, 0..most);
        assert!(record.iter().all(Option::is_none));
        // The first was answered, the second is the subject of a subscription here, the third was heard again.
        contacts.took(Instant::now(), "1 0");
        contacts.pin(HashSet::from(["1 1".into()]));
        contacts.record_further_letter(Instant::now(), "1 2");
        for (number, name) in (most..).zip(["1 3", "1 4"]) {
            let record = fill(&contacts, 1, number..number + 1).remove(0);
            assert_eq!(&*record.unwrap().name, name);
            assert!(contacts.lookup(name).is_none());
            assert_eq!(&*contacts.view().lost_agent(name).unwrap().name, name);
        }
        let others = most + 2..2 * most - 1;
        fill(&contacts, 1, others.clone());
        for name in ["1 0", "1 1"] {
            assert!(contacts.lookup(name).is_some(), "{name}");
        }
        assert!(contacts.lookup("1 2").is_none());
        // Now all others are answered, too.
        others.for_each(|number| contacts.took(Instant::now(), &format!("1 {number}")));
        let all = contacts.entries();
        let of_host = all.iter().filter(|it| it.name.starts_with("1 "));
        of_host.for_each(|it| contacts.took(Instant::now(), &it.name));
        fill(&contacts, 1, 2 * most..2 * most + 1);
        assert!(contacts.lookup("1 1").is_some());
        assert!(
            contacts.lookup("2 0").is_some(),
            "another host lost a contact"
        );
        assert_eq!(contacts.entries().len(), most + 1);
        assert!(contacts.view().lost_agents().len() <= ContactDirectory::MAX_REPLACED);
        // A letter makes a replaced one a contact again.
        fill(&contacts, 1, 3..4);
        assert!(contacts.lookup("1 3").is_some());
        assert!(contacts.view().lost_agent("1 3").is_none());
    }

    #[test]
    fn the_host_with_most_makes_room_for_all_others() {
        let contacts = ContactDirectory::new();
        let (most, share) = (
            ContactDirectory::MAX_CONTACTS,
            ContactDirectory::MAX_OF_HOST,
        );
        for host in 0..=(most / share) as u8 {
            fill(&contacts, host, 0..share - 1);
        }
        let all = contacts.entries();
        assert_eq!(all.len(), most);
        let of = |host: &str| {
            let all = contacts.entries();
            all.iter().filter(|it| it.name.starts_with(host)).count()
        };
        let last = format!("{} ", most / share);
        assert!(of(&last) >= share / 2, "{}", of(&last));
        // Without one that is not answered, the longest unused makes room.
        all.iter()
            .for_each(|it| contacts.took(Instant::now(), &it.name));
        let record = fill(&contacts, 99, 0..1).remove(0);
        assert_eq!(record.unwrap().name, all[0].name);
        assert_eq!(contacts.entries().len(), most);
    }

    #[test]
    fn contacts_in_use_are_not_replaced_and_names_are_checked() {
        let contacts = ContactDirectory::new();
        let most = ContactDirectory::MAX_OF_HOST;
        fill(&contacts, 1, 0..most);
        let all = contacts.entries();
        contacts.pin(all.iter().map(|it| Arc::clone(&it.name)).collect());
        let record = |name: &str| {
            contacts.record_sender(Instant::now(), name, Incarnation::UNKNOWN, at_host(1))
        };
        assert_eq!(record("another"), Err(ContactError::Full));
        assert_eq!(record("1 7"), Ok(None));
        assert_eq!(contacts.entries().len(), most);
        contacts.pin(HashSet::new());
        assert!(record("another").unwrap().is_some());
        assert!(matches!(record(""), Err(ContactError::Entry(_))));
        assert!(matches!(record("a\nb"), Err(ContactError::Entry(_))));
    }
}
