//! The back end of those who have written: agents of other hosts that are known by nothing but a
//! letter of theirs.
//!
//! A letter may be faster than the news of its sender, and on some networks the news never comes.
//! Whoever has just written can be answered all the same, for a while.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_transport::{Incarnation, Location};
use parking_lot::Mutex;

use crate::entry::{millis_of_time, time_of_millis};
use crate::table::Table;
use crate::{Directory, Entry, EntryError, Mts, Reach, Role, Source, Subscriber};

/// Agents of other hosts that have written, each until it is forgotten.
///
/// Bounded: of more than [`ContactDirectory::MAX_CONTACTS`] the one that was heard longest ago is
/// forgotten. Hearsay never replaces what other back ends know: merge this one last, and let go
/// of an agent as soon as another back end knows it.
#[derive(Debug)]
pub struct ContactDirectory {
    table: Table<()>,
    heard: Mutex<Vec<(Arc<Entry>, Instant)>>,
}

impl ContactDirectory {
    /// Most agents kept.
    pub const MAX_CONTACTS: usize = 1024;
    /// How long an agent that is not heard of again is kept.
    pub const MEMORY: Duration = Duration::from_secs(60);

    /// Nobody has written yet.
    #[must_use]
    pub fn new() -> Self {
        Self {
            table: Table::new(),
            heard: Mutex::default(),
        }
    }

    /// An agent of another host has written, `now`; letters for it go to `location`, which has the
    /// incarnation of the message transport service there. Says whether it was unknown here.
    ///
    /// # Errors
    /// When the name is none.
    pub fn heard(
        &self,
        now: Instant,
        name: &str,
        incarnation: Incarnation,
        location: Location,
    ) -> Result<bool, EntryError> {
        let gateway = location.incarnation();
        let entry = Entry {
            name: name.into(),
            agent_type: String::new(),
            incarnation,
            mts: Mts::new(location.address(), gateway),
            locations: vec![location],
            description: String::new(),
            registered: time_of_millis(millis_of_time(SystemTime::now())),
            source: Source::Contact,
            reach: Reach::Remote { gateway },
            role: Role::Agent,
        };
        entry.check()?;
        let mut heard = self.heard.lock();
        let before = heard.iter().position(|(other, _)| *other.name == *name);
        let known = before.map(|index| heard.remove(index));
        if heard.len() >= Self::MAX_CONTACTS {
            let (oldest, _) = heard.remove(0);
            self.table.release((), &oldest.name, oldest.incarnation);
        }
        let entry = Arc::new(entry);
        self.table.put((), Arc::clone(&entry));
        heard.push((entry, now));
        Ok(known.is_none_or(|(known, _)| known.incarnation != incarnation))
    }

    /// Forgets those that were heard too long ago, and those that somebody else `knows` by now.
    pub fn forget(&self, now: Instant, knows: impl Fn(&Entry) -> bool) {
        self.heard.lock().retain(|(entry, heard)| {
            let old = now.saturating_duration_since(*heard) >= Self::MEMORY;
            let stays = !old && !knows(entry);
            if !stays {
                self.table.release((), &entry.name, entry.incarnation);
            }
            stays
        });
    }
}

impl Default for ContactDirectory {
    fn default() -> Self {
        Self::new()
    }
}

impl Directory for ContactDirectory {
    reads_its_table!(table);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn location() -> Location {
        "tcp://192.0.2.1:7788#00000000000000aa".parse().unwrap()
    }

    fn life(number: u64) -> Incarnation {
        Incarnation::from_u64(number)
    }

    #[test]
    fn who_has_written_is_known_until_forgotten() {
        let contacts = ContactDirectory::new();
        let start = Instant::now();
        assert_eq!(contacts.heard(start, "arm", life(1), location()), Ok(true));
        assert_eq!(contacts.heard(start, "arm", life(1), location()), Ok(false));
        let entry = contacts.lookup("arm").unwrap();
        assert_eq!(entry.locations, [location()]);
        assert_eq!(contacts.by_incarnation(life(1)).unwrap(), entry);
        // Another life of the same name takes its place.
        assert_eq!(contacts.heard(start, "arm", life(2), location()), Ok(true));
        assert!(contacts.by_incarnation(life(1)).is_none());
        contacts.forget(start, |_| false);
        assert!(contacts.lookup("arm").is_some());
        contacts.forget(start + ContactDirectory::MEMORY, |_| false);
        assert!(contacts.lookup("arm").is_none());
    }

    #[test]
    fn who_is_known_elsewhere_is_let_go() {
        let contacts = ContactDirectory::new();
        let now = Instant::now();
        contacts.heard(now, "arm", life(1), location()).unwrap();
        contacts.heard(now, "leg", life(2), location()).unwrap();
        contacts.forget(now, |entry| &*entry.name == "arm");
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
                .heard(now, &name, life(number + 1), location())
                .unwrap();
        }
        assert_eq!(contacts.entries().len(), ContactDirectory::MAX_CONTACTS);
        assert!(contacts.lookup("agent 0").is_none());
        assert!(contacts.heard(now, "", life(1), location()).is_err());
        assert!(contacts.heard(now, "a\nb", life(1), location()).is_err());
    }
}
