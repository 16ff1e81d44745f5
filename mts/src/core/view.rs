//! The view of the directory, and the entries that it returned last.

use std::cell::RefCell;
use std::ops::Deref;
use std::sync::Arc;

use fipa_sds::{Entry, View};
use fipa_transport::Incarnation;

use super::attempts::registration_by_name;

/// The present view of the directory. Most letters have the receiver of the letter before, so the latest
/// results are kept.
pub(crate) struct PresentView {
    view: Arc<dyn View>,
    named: RefCell<Option<Arc<Entry>>>,
    receiver: RefCell<Option<(Incarnation, Arc<Entry>)>>,
}

impl PresentView {
    pub(crate) fn new(view: Arc<dyn View>) -> Self {
        Self {
            view,
            named: RefCell::default(),
            receiver: RefCell::default(),
        }
    }

    /// Replaces the view. Returns the previous one.
    pub(crate) fn replace(&mut self, view: Arc<dyn View>) -> Arc<dyn View> {
        std::mem::replace(self, Self::new(view)).view
    }

    pub(crate) fn shared(&self) -> &Arc<dyn View> {
        &self.view
    }

    /// Returns the entry of this name.
    pub(crate) fn named(&self, name: &str) -> Option<Arc<Entry>> {
        let mut latest = self.named.borrow_mut();
        let known = latest.take().filter(|entry| *entry.name == *name);
        *latest = known.or_else(|| self.view.named(name));
        latest.clone()
    }

    /// Resolves the receiver of a stream. Another host may announce an agent with this registration under
    /// another name, which is not the receiver.
    pub(crate) fn receiver(&self, registration: Incarnation, name: &str) -> Option<Arc<Entry>> {
        let mut latest = self.receiver.borrow_mut();
        let known = latest
            .take()
            .filter(|(of, entry)| *of == registration && *entry.name == *name);
        *latest = known.or_else(|| Some((registration, self.find_receiver(registration, name)?)));
        let (_, entry) = latest.as_ref()?;
        Some(Arc::clone(entry))
    }

    fn find_receiver(&self, registration: Incarnation, name: &str) -> Option<Arc<Entry>> {
        let registered = self.view.registered(registration);
        let registered = registered.filter(|entry| *entry.name == *name);
        registered.or_else(|| {
            let entry = self.view.named(name)?;
            let is_meant = match entry.incarnation.is_known() {
                true => entry.incarnation == registration,
                false => registration == registration_by_name(name),
            };
            is_meant.then_some(entry)
        })
    }
}

impl Deref for PresentView {
    type Target = dyn View;

    fn deref(&self) -> &Self::Target {
        &*self.view
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::time::SystemTime;

    use fipa_sds::{Mts, Reach, Role, Snapshot, Source};

    use super::*;

    fn entry(name: &str, registration: u64) -> Arc<Entry> {
        Arc::new(Entry {
            name: name.into(),
            agent_type: String::new(),
            incarnation: Incarnation::from_u64(registration),
            locations: Vec::new(),
            mts: Mts::new("mts", Incarnation::from_u64(9)),
            description: String::new(),
            registered: SystemTime::UNIX_EPOCH,
            source: Source::Host,
            reach: Reach::Local,
            role: Role::Agent,
        })
    }

    fn view(entries: &[Arc<Entry>]) -> Arc<dyn View> {
        Arc::new(Snapshot::of(entries))
    }

    #[test]
    fn a_kept_entry_answers_only_for_its_name_its_registration_and_its_view() {
        let of = Incarnation::from_u64;
        let found = |view: &PresentView, name| view.named(name).map(|entry| entry.incarnation);
        let mut present = PresentView::new(view(&[entry("arm", 1), entry("leg", 2)]));
        for _ in 0..2 {
            assert_eq!(found(&present, "arm"), Some(of(1)));
            assert_eq!(found(&present, "leg"), Some(of(2)));
            assert_eq!(found(&present, "tail"), None);
            assert_eq!(present.receiver(of(1), "arm").unwrap().incarnation, of(1));
            assert!(present.receiver(of(2), "arm").is_none());
            assert!(present.receiver(of(1), "leg").is_none());
            assert_eq!(present.receiver(of(2), "leg").unwrap().incarnation, of(2));
        }
        present.replace(view(&[entry("leg", 3)]));
        assert_eq!(found(&present, "leg"), Some(of(3)));
        assert!(present.receiver(of(2), "leg").is_none());
        assert_eq!(present.receiver(of(3), "leg").unwrap().incarnation, of(3));
        present.replace(view(&[]));
        assert_eq!(found(&present, "leg"), None);
        assert!(present.receiver(of(3), "leg").is_none());
    }
}
