//! `fipa agents --watch`: prints each agent that joins, changes or leaves.

use std::collections::BTreeMap;
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::{Change, Config, DirectoryView, Entry};
use serde_json::json;

use super::{Filter, Reported, Row};
use crate::membership::{self, Stop};
use crate::options;
use crate::output;
use crate::report::Failure;

/// Prints changes until a signal, until the output has no reader, or until one of the limits: a number of
/// lines, and a time.
pub(super) fn run(
    filter: &Filter,
    (count, time): (Option<u64>, Option<Duration>),
    config: &Config,
    json: bool,
) -> Result<(), Failure> {
    options::block_on(async {
        let mut stop = Stop::listen()?;
        let mut reader = output::Reader::of_output();
        let domain = stop.during(membership::join(config)).await?;
        let directory = domain.directory();
        // Watching starts before reading, so that an agent that joins in between is not missed.
        let mut changes = directory.watch();
        directory.refresh();
        if !json {
            let domain = &config.domain;
            output::text(&format!("watching domain {domain}; press Ctrl-C to stop\n"))?;
        }
        let mut shown = Shown {
            lines_left: count,
            ..Shown::default()
        };
        let mut over = pin!(options::after(time));
        let mut printed = shown.all(directory, filter, ChangeKind::Present, json);
        loop {
            if printed.is_err() || shown.lines_left == Some(0) {
                break;
            }
            tokio::select! {
                () = stop.requested() => break,
                () = reader.gone() => break,
                () = &mut over => break,
                change = changes.next() => match change {
                    None => break,
                    Some(change) => {
                        let mut changes = change.single().iter();
                        printed = changes.try_for_each(|change| {
                            shown.change(change, directory, filter, json)
                        });
                    }
                },
            }
        }
        Stop::ending();
        domain.close().await;
        printed
    })?
}

#[derive(Clone, Copy)]
enum ChangeKind {
    Present,
    Joined,
    Changed,
    Left,
}

impl ChangeKind {
    fn word(self) -> &'static str {
        match self {
            Self::Present => "present",
            Self::Joined => "joined",
            Self::Changed => "changed",
            Self::Left => "left",
        }
    }
}

/// The agents that were shown and have not left.
#[derive(Default)]
struct Shown {
    entries: BTreeMap<Arc<str>, Arc<Entry>>,
    /// Number of lines that are left to print; `None` without a limit.
    lines_left: Option<u64>,
}

impl Shown {
    /// Prints all differences from the shown agents; an agent that was not shown is printed as `new`.
    fn all(
        &mut self,
        directory: DirectoryView<'_>,
        filter: &Filter,
        new: ChangeKind,
        json: bool,
    ) -> Result<(), Failure> {
        let entries = directory.entries();
        let gone: Vec<Arc<str>> = self
            .entries
            .keys()
            .filter(|name| entries.iter().all(|entry| entry.name != **name))
            .cloned()
            .collect();
        for name in gone {
            self.update(&name, None, directory, filter, json)?;
        }
        for entry in entries.iter() {
            if filter.matches(entry) && !self.entries.contains_key(&entry.name) {
                self.entries
                    .insert(Arc::clone(&entry.name), Arc::clone(entry));
                self.print(new, entry, directory, json)?;
            } else {
                self.update(&entry.name, Some(entry), directory, filter, json)?;
            }
        }
        Ok(())
    }

    fn change(
        &mut self,
        change: &Change,
        directory: DirectoryView<'_>,
        filter: &Filter,
        json: bool,
    ) -> Result<(), Failure> {
        match change {
            Change::Joined(entry) | Change::Changed { after: entry, .. } => {
                self.update(&entry.name, Some(entry), directory, filter, json)
            }
            Change::Left(entry) => self.update(&entry.name, None, directory, filter, json),
            // Single changes may have been missed, so the whole directory is compared.
            Change::Together(_) | Change::Lagged => {
                self.all(directory, filter, ChangeKind::Joined, json)
            }
        }
    }

    /// Prints the current entry of a name if it differs from the shown one.
    fn update(
        &mut self,
        name: &Arc<str>,
        entry: Option<&Arc<Entry>>,
        directory: DirectoryView<'_>,
        filter: &Filter,
        json: bool,
    ) -> Result<(), Failure> {
        // An agent that no longer matches the filter is printed as left.
        let entry = entry.filter(|entry| filter.matches(entry));
        let before = match entry {
            Some(entry) => self.entries.insert(Arc::clone(name), Arc::clone(entry)),
            None => self.entries.remove(name),
        };
        match (before, entry) {
            (None, Some(entry)) => self.print(ChangeKind::Joined, entry, directory, json),
            (Some(before), Some(entry)) if before != *entry => {
                self.print(ChangeKind::Changed, entry, directory, json)
            }
            (Some(before), None) => self.print(ChangeKind::Left, &before, directory, json),
            _ => Ok(()),
        }
    }

    /// Prints a line, unless the limit is reached.
    fn print(
        &mut self,
        change: ChangeKind,
        entry: &Entry,
        directory: DirectoryView<'_>,
        json: bool,
    ) -> Result<(), Failure> {
        match &mut self.lines_left {
            Some(0) => return Ok(()),
            Some(lines_left) => *lines_left -= 1,
            None => {}
        }
        print(change, entry, directory, json)
    }
}

fn print(
    change: ChangeKind,
    entry: &Entry,
    directory: DirectoryView<'_>,
    json: bool,
) -> Result<(), Failure> {
    // The connections change without a change of the entry.
    let row = Row::of(entry, directory, &Reported::default());
    let time = output::rfc3339(SystemTime::now()).unwrap_or_default();
    if json {
        let line = json!({ "time": time, "change": change.word(), "agent": row.json });
        return output::json_line(&line);
    }
    let ([name, host, agent_type, ..], [locations, ..]) = (&row.cells, &row.long_cells);
    let agent_type = match agent_type.as_str() {
        "" => String::new(),
        agent_type => format!(" ({agent_type})"),
    };
    let locations = locations.replace('\n', " ");
    let change = change.word();
    output::text(&format!(
        "{time}  {change:<7}  {name}{agent_type}  {host}  {locations}\n"
    ))
}
