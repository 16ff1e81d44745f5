//! `fipa agents --watch`: who joins, changes and leaves.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::SystemTime;

use fipa::{Change, Config, Directory, Entry, Time};
use serde_json::json;

use super::{Filter, Row};
use crate::membership::{self, Stop};
use crate::options;
use crate::output;
use crate::report::Failure;

/// Tells until a signal ends it.
pub(super) fn run(filter: &Filter, config: &Config, json: bool) -> Result<(), Failure> {
    options::block_on(async {
        let mut stop = Stop::listen()?;
        let mut reader = output::Reader::of_output();
        let domain = membership::join(config).await?;
        let directory = domain.directory();
        // Watching begins before reading: what joins in between is told by one of them.
        let mut changes = directory.watch();
        directory.refresh();
        if !json {
            let domain = &config.domain;
            output::text(&format!("watching the domain {domain}; Ctrl-C ends it\n"))?;
        }
        let mut shown = Shown::default();
        let mut told = shown.all(directory, filter, What::Present, json);
        loop {
            if told.is_err() {
                break;
            }
            tokio::select! {
                () = stop.requested() => break,
                () = reader.gone() => break,
                change = changes.next() => match change {
                    None => break,
                    Some(change) => {
                        let mut changes = change.single().iter();
                        told = changes.try_for_each(|change| {
                            shown.change(change, directory, filter, json)
                        });
                    }
                },
            }
        }
        Stop::ending();
        domain.close().await;
        told
    })?
}

#[derive(Clone, Copy)]
enum What {
    Present,
    Joined,
    Changed,
    Left,
}

impl What {
    fn word(self) -> &'static str {
        match self {
            Self::Present => "present",
            Self::Joined => "joined",
            Self::Changed => "changed",
            Self::Left => "left",
        }
    }
}

/// Those that have been shown and have not left.
#[derive(Default)]
struct Shown(BTreeMap<Arc<str>, Arc<Entry>>);

impl Shown {
    /// Tells what is different from what was shown; who is new is told as `new`.
    fn all(
        &mut self,
        directory: &dyn Directory,
        filter: &Filter,
        new: What,
        json: bool,
    ) -> Result<(), Failure> {
        let entries = directory.entries();
        let gone: Vec<Arc<str>> = self
            .0
            .keys()
            .filter(|name| entries.iter().all(|entry| entry.name != **name))
            .cloned()
            .collect();
        for name in gone {
            self.now(&name, None, directory, filter, json)?;
        }
        for entry in entries.iter() {
            if filter.matches(entry) && !self.0.contains_key(&entry.name) {
                self.0.insert(Arc::clone(&entry.name), Arc::clone(entry));
                tell(new, entry, directory, json)?;
            } else {
                self.now(&entry.name, Some(entry), directory, filter, json)?;
            }
        }
        Ok(())
    }

    fn change(
        &mut self,
        change: &Change,
        directory: &dyn Directory,
        filter: &Filter,
        json: bool,
    ) -> Result<(), Failure> {
        match change {
            Change::Joined(entry) | Change::Changed { after: entry, .. } => {
                self.now(&entry.name, Some(entry), directory, filter, json)
            }
            Change::Left(entry) => self.now(&entry.name, None, directory, filter, json),
            // So many at once that some were missed: what is there is compared.
            Change::Together(_) | Change::Lagged => self.all(directory, filter, What::Joined, json),
        }
    }

    /// Tells what that name means now, if it is different from what was shown.
    fn now(
        &mut self,
        name: &Arc<str>,
        entry: Option<&Arc<Entry>>,
        directory: &dyn Directory,
        filter: &Filter,
        json: bool,
    ) -> Result<(), Failure> {
        // Who does not match any more has left, for who watches.
        let entry = entry.filter(|entry| filter.matches(entry));
        let before = match entry {
            Some(entry) => self.0.insert(Arc::clone(name), Arc::clone(entry)),
            None => self.0.remove(name),
        };
        match (before, entry) {
            (None, Some(entry)) => tell(What::Joined, entry, directory, json),
            (Some(before), Some(entry)) if before != *entry => {
                tell(What::Changed, entry, directory, json)
            }
            (Some(before), None) => tell(What::Left, &before, directory, json),
            _ => Ok(()),
        }
    }
}

fn tell(what: What, entry: &Entry, directory: &dyn Directory, json: bool) -> Result<(), Failure> {
    let row = Row::of(entry, directory);
    let time = Time::from_system_time(SystemTime::now()).ok();
    let time = time.and_then(Time::to_rfc3339).unwrap_or_default();
    if json {
        let line = json!({ "time": time, "change": what.word(), "agent": row.json });
        return output::json_line(&line);
    }
    let [name, agent_type, reach, locations, ..] = &row.cells;
    let agent_type = match agent_type.as_str() {
        "" => String::new(),
        agent_type => format!(" ({agent_type})"),
    };
    let locations = locations.replace('\n', " ");
    let what = what.word();
    output::text(&format!(
        "{time}  {what:<7}  {name}{agent_type}  {reach}  {locations}\n"
    ))
}
