//! Back end for agents of other hosts that are known only from a letter of theirs.
//!
//! A letter may arrive before the announcement of its sender, and on some networks the announcement
//! never arrives. This back end makes it possible to answer such a sender for a limited time.

use std::cmp::Reverse;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_transport::{Incarnation, Location, PeerId, Principal};
use parking_lot::Mutex;

use crate::entry::{millis_of_time, time_of_millis};
use crate::table::Table;
use crate::{Directory, Entry, EntryError, Mts, Reach, Role, Source, Subscriber};

/// Agents of other hosts that sent a letter, each until its entry expires.
///
/// Bounded: beyond [`ContactDirectory::MAX_CONTACTS`] the contact with the oldest last letter is
/// evicted, among those of the host with most contacts. A contact must not replace the entries of other back ends: merge this directory last,
/// and drop a contact as soon as another back end has the agent ([`forget`](Self::forget)).
#[derive(Debug)]
pub struct ContactDirectory {
    table: Table<()>,
    heard: Mutex<Vec<(Arc<Entry>, Instant)>>,
}

impl ContactDirectory {
    /// Maximum number of contacts.
    pub const MAX_CONTACTS: usize = 1024;
    /// Time for which a contact is kept after its last letter.
    pub const MEMORY: Duration = Duration::from_secs(60);
    /// Time for which a contact is kept if its gateway sends the agents of its host and this agent is
    /// not among them: it has left.
    pub const UNLISTED: Duration = Duration::from_secs(5);

    /// Creates an empty directory.
    #[must_use]
    pub fn new() -> Self {
        Self {
            table: Table::new(),
            heard: Mutex::default(),
        }
    }

    /// Records that an agent of another host sent a letter at `now`; letters to it go to
    /// `location`, which has the incarnation of the message transport service there. Returns true
    /// if this incarnation of the agent was not a contact before.
    ///
    /// # Errors
    /// Fails when the name is not valid.
    pub fn heard(
        &self,
        now: Instant,
        name: &str,
        incarnation: Incarnation,
        location: Location,
    ) -> Result<bool, EntryError> {
        let gateway = location.incarnation();
        let peer = PeerId::of(Principal::Unproved, Some(&location));
        let entry = Entry {
            name: name.into(),
            agent_type: String::new(),
            incarnation,
            mts: Mts::unnamed(gateway),
            locations: vec![location],
            description: String::new(),
            registered: time_of_millis(millis_of_time(SystemTime::now())),
            source: Source::Contact,
            reach: Reach::Remote { gateway },
            peer,
            role: Role::Agent,
        };
        entry.check()?;
        let mut heard = self.heard.lock();
        let before = heard.iter().position(|(other, _)| *other.name == *name);
        let known = before.map(|index| heard.remove(index));
        if heard.len() >= Self::MAX_CONTACTS
            && let Some(index) = to_evict(&heard)
        {
            let (oldest, _) = heard.remove(index);
            self.table.release((), &oldest.name, oldest.incarnation);
        }
        let entry = Arc::new(entry);
        self.table.put((), Arc::clone(&entry));
        heard.push((entry, now));
        Ok(known.is_none_or(|(known, _)| known.incarnation != incarnation))
    }

    /// Drops the contacts at these gateways.
    pub fn withdraw(&self, gateways: &HashSet<Incarnation>) {
        self.heard.lock().retain(|(entry, _)| {
            let stays = !gateways.contains(&entry.mts.incarnation);
            if !stays {
                self.table.release((), &entry.name, entry.incarnation);
            }
            stays
        });
    }

    /// Drops contacts that `others`, the other back ends, know, and those that are older than
    /// [`MEMORY`](Self::MEMORY), or than [`UNLISTED`](Self::UNLISTED) if `others` [speak
    /// for](Directory::speaks_for) their gateway. Returns the time at which to call this again.
    pub fn forget(&self, now: Instant, others: &dyn Directory) -> Option<Instant> {
        let mut next: Option<Instant> = None;
        self.heard.lock().retain(|(entry, heard)| {
            let memory = match others.speaks_for(entry.mts.incarnation) {
                true => Self::UNLISTED,
                false => Self::MEMORY,
            };
            let until = *heard + memory;
            let stays = now < until && others.known(&entry.name).is_none();
            // `others` may begin to speak for the gateway without a notification.
            let check = until.min(now + Self::UNLISTED);
            match stays {
                true => next = Some(next.map_or(check, |next| next.min(check))),
                false => {
                    self.table.release((), &entry.name, entry.incarnation);
                }
            }
            stays
        });
        next
    }
}

/// Returns the index of the first contact of the host with most contacts.
fn to_evict(contacts: &[(Arc<Entry>, Instant)]) -> Option<usize> {
    let hosts = contacts
        .iter()
        .map(|(entry, _)| PeerId::of(Principal::Unproved, entry.locations.first()));
    let mut of_host: HashMap<PeerId, (usize, usize)> = HashMap::new();
    for (index, host) in hosts.enumerate() {
        let (count, _) = of_host.entry(host).or_insert((0, index));
        *count += 1;
    }
    let most = of_host
        .into_values()
        .max_by_key(|(count, first)| (*count, Reverse(*first)));
    most.map(|(_, first)| first)
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
    fn a_sender_is_a_contact_until_it_expires() {
        let contacts = ContactDirectory::new();
        let start = Instant::now();
        assert_eq!(
            contacts.heard(start, "arm", incarnation(1), location()),
            Ok(true)
        );
        assert_eq!(
            contacts.heard(start, "arm", incarnation(1), location()),
            Ok(false)
        );
        let entry = contacts.lookup("arm").unwrap();
        assert_eq!(entry.locations, [location()]);
        assert_eq!(contacts.by_incarnation(incarnation(1)).unwrap(), entry);
        // Another incarnation of the same name replaces it.
        assert_eq!(
            contacts.heard(start, "arm", incarnation(2), location()),
            Ok(true)
        );
        assert!(contacts.by_incarnation(incarnation(1)).is_none());
        let end = start + ContactDirectory::MEMORY;
        let soon = start + ContactDirectory::UNLISTED;
        assert_eq!(contacts.forget(start, &nothing()), Some(soon));
        let late = end.checked_sub(Duration::from_millis(1)).unwrap();
        assert_eq!(contacts.forget(late, &nothing()), Some(end));
        assert!(contacts.lookup("arm").is_some());
        assert_eq!(contacts.forget(end, &nothing()), None);
        assert!(contacts.lookup("arm").is_none());
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
            let heard = contacts.heard(Instant::now(), &name, incarnation(number), location);
            assert_eq!(heard, Ok(true), "{at}");
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
        let mts = Mts::new("arm-mts", gateway);
        exchange.handle_neighbours(start, &[Present::unproved(mts, vec![location()])]);
        let known = exchange.directory();
        contacts
            .heard(start, "arm", incarnation(1), location())
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
            .heard(soon, "arm", incarnation(1), location())
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
            .heard(now, "arm", incarnation(1), location())
            .unwrap();
        contacts
            .heard(now, "leg", incarnation(2), location())
            .unwrap();
        let known = StaticDirectory::new([("arm", vec![location()])]).unwrap();
        contacts.forget(now, &known);
        assert!(contacts.lookup("arm").is_none());
        assert!(contacts.lookup("leg").is_some());
    }

    #[test]
    fn the_number_of_contacts_is_bounded_and_names_are_checked() {
        let contacts = ContactDirectory::new();
        let now = Instant::now();
        for number in 0..ContactDirectory::MAX_CONTACTS as u64 + 10 {
            let name = format!("agent {number}");
            contacts
                .heard(now, &name, incarnation(number + 1), location())
                .unwrap();
        }
        assert_eq!(contacts.entries().len(), ContactDirectory::MAX_CONTACTS);
        assert!(contacts.lookup("agent 0").is_none());
        // The contacts of another host stay.
        let other = "tcp://192.0.2.2:7788#00000000000000ab".parse().unwrap();
        contacts.heard(now, "other", incarnation(1), other).unwrap();
        for number in 0..ContactDirectory::MAX_CONTACTS as u64 {
            let name = format!("later {number}");
            contacts
                .heard(now, &name, incarnation(number + 9999), location())
                .unwrap();
        }
        assert_eq!(contacts.entries().len(), ContactDirectory::MAX_CONTACTS);
        assert!(contacts.lookup("other").is_some());
        assert!(contacts.heard(now, "", incarnation(1), location()).is_err());
        assert!(
            contacts
                .heard(now, "a\nb", incarnation(1), location())
                .is_err()
        );
    }
}
