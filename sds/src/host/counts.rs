//! The pages in which processes count, and the sum of those that have ended.

use std::fs::File;
use std::io::Read as _;

use fipa_transport::DomainUsers;
use fipa_transport::counts::{Counts, Totals};
use rustix::fs::Mode;

use super::HostError;
use super::host_dir::{Guard, HostDir, Id, Name};

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
        let file = self.write_counts(Name::Counts(self.id()), values)?;
        self.host_dir.has_counts();
        Ok(file)
    }

    /// Removes the page of a process that has ended, and keeps its values.
    ///
    /// A process that is killed in between loses the values. In the other order they would count twice.
    pub(super) fn keep_counts(&self, id: Id) -> Result<(), HostError> {
        let Some(values) = self.host_dir.read_counts(Name::Counts(id))? else {
            return self.host_dir.remove(Name::Counts(id));
        };
        let mut sum = self.host_dir.read_counts(Name::Ended)?.unwrap_or_default();
        sum.add(&values);
        self.host_dir.remove(Name::Counts(id))?;
        self.write_counts(Name::Ended, &sum).map(drop)
    }

    fn write_counts(&self, name: Name, values: &Totals) -> Result<File, HostError> {
        let group_reads = match self.host_dir.users() {
            DomainUsers::This => Mode::empty(),
            DomainUsers::Group(_) => Mode::RGRP,
        };
        // Another member of a group may not shorten the file: its process would get a signal as it counts.
        let mode = Mode::RUSR | Mode::WUSR | group_reads;
        self.replace(name, &values.to_page(), |file| {
            Ok(rustix::fs::fchmod(file, mode)?)
        })
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

    /// `None` if there is no such page, or a process of another version wrote it.
    pub(super) fn read_counts(&self, name: Name) -> Result<Option<Totals>, HostError> {
        let Some(file) = self.open(name)? else {
            return Ok(None);
        };
        let mut page = Vec::with_capacity(Counts::LEN);
        file.take(Counts::LEN as u64 + 1)
            .read_to_end(&mut page)
            .map_err(self.io("read", name))?;
        Ok(Totals::from_page(&page))
    }
}
