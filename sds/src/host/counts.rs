//! The pages in which processes count, and the sum of those that have ended.

use std::fs::File;
use std::io::Read as _;

use fipa_acl::ErrorChain;
use fipa_transport::counts::{Counts, Totals};
use fipa_transport::log_limit;

use super::HostError;
use super::host_dir::{Guard, HostDir, Id, Name, Writers};

/// The counters of the processes of a domain on this host.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct HostCounts {
    /// The sum of those of running processes.
    pub running: Totals,
    /// The sum of those of processes that have ended.
    pub ended: Totals,
}

impl Guard<'_> {
    /// Creates the page of this process, with these values. Replaces an earlier one.
    pub(super) fn create_counts(&self, values: &Totals) -> Result<File, HostError> {
        // Another member of a group may not shorten the file: this process would get a signal as it counts.
        let (name, page) = (Name::Counts(self.id()), values.to_page());
        let file = self.replace(name, &page, Writers::This, |_| Ok(()))?;
        self.host_dir.has_counts();
        Ok(file)
    }

    /// Removes the page of a process that has ended, and keeps its values. If they cannot be stored, for example on a
    /// full disk, the page stays and the next sweep tries it again: counters keep no process from joining or leaving.
    pub(super) fn keep_counts(&self, id: Id) {
        if let Err(error) = self.try_to_keep_counts(id) {
            log_limit::warn!(error = %ErrorChain(&error), "the counters of an ended process are not kept yet");
        }
    }

    /// A process that is killed in between loses the values. In the other order they would count twice.
    fn try_to_keep_counts(&self, id: Id) -> Result<(), HostError> {
        let host_dir = self.host_dir;
        let Some(values) = host_dir.read_counts(Name::Counts(id))? else {
            return host_dir.remove(Name::Counts(id));
        };
        let mut sum = host_dir.read_counts(Name::Ended)?.unwrap_or_default();
        sum.add(&values);
        let page = sum.to_page();
        self.replace(Name::Ended, &page, Writers::This, |_| {
            host_dir.remove(Name::Counts(id))
        })?;
        Ok(())
    }
}

impl HostDir {
    /// Reads the pages of all processes.
    pub(super) fn sum_counts(&self) -> Result<HostCounts, HostError> {
        // Under the lock, no page moves to the sum of those that have ended.
        let _guard = self.lock()?;
        let mut sums = HostCounts::default();
        for name in self.names()? {
            let sum = match name {
                Name::Counts(_) => &mut sums.running,
                Name::Ended => &mut sums.ended,
                _ => continue,
            };
            if let Some(values) = self.read_counts(name)? {
                sum.add(&values);
            }
        }
        Ok(sums)
    }

    /// `None` if there is no such page, a process of another version wrote it, or it is no file of the domain.
    pub(super) fn read_counts(&self, name: Name) -> Result<Option<Totals>, HostError> {
        let file = match self.open(name) {
            Ok(Some(file)) => file,
            Ok(None) => return Ok(None),
            Err(error @ HostError::NotPrivate { .. }) => {
                log_limit::warn!(error = %ErrorChain(&error), "counters are ignored");
                return Ok(None);
            }
            Err(error) => return Err(error),
        };
        let mut page = Vec::with_capacity(Counts::LEN);
        file.take(Counts::LEN as u64 + 1)
            .read_to_end(&mut page)
            .map_err(self.io("read", name))?;
        Ok(Totals::from_page(&page))
    }
}
