//! Whether letters keep to the protocols of their conversations.

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use fipa::Outcome;
use fipa::watch::{Fate, Passage};
use fipa_monitor::{Event, Header, Library, LibraryError, Monitor, Unchecked, Verdict, Violation};

use crate::report::Failure;

/// Checks every letter that is seen.
pub(in crate::command) struct Judge {
    monitor: Monitor,
}

/// What is said of a letter.
#[derive(Debug, Clone)]
pub(in crate::command) enum Judged {
    /// It fits.
    Accepted {
        protocol: String,
        state: String,
        opened: bool,
        ended: bool,
        complete: bool,
        late: bool,
    },
    /// It does not.
    Violation(Box<Violation>),
    /// Nothing can be said.
    Unchecked(Unchecked),
    /// It is no part of a conversation between agents, for this reason.
    Left(&'static str),
    /// It was judged when it was first seen.
    Later,
}

impl Judged {
    pub(super) fn is_violation(&self) -> bool {
        matches!(self, Self::Violation(_))
    }

    pub(super) fn protocol(&self) -> Option<&str> {
        match self {
            Self::Accepted { protocol, .. } => Some(protocol),
            Self::Violation(violation) => Some(&violation.protocol),
            _ => None,
        }
    }
}

/// What is noticed without a letter: that none came.
pub(super) struct Overdue {
    pub(super) protocol: String,
    pub(super) conversation_id: String,
    pub(super) participant: Option<String>,
    pub(super) state: String,
}

impl Overdue {
    pub(super) fn protocol(&self) -> Option<&str> {
        Some(&self.protocol)
    }

    pub(super) fn conversation(&self) -> Option<&str> {
        Some(&self.conversation_id)
    }
}

/// Largest protocol file, in bytes.
const MAX_FILE: u64 = 1 << 20;

impl Judge {
    /// One who knows the protocols of the standards, and those in this directory.
    pub(in crate::command) fn new(directory: Option<&Path>) -> Result<Self, Failure> {
        let mut library = Library::standard();
        if let Some(directory) = directory {
            let mut files = protocol_files(directory)?;
            files.sort();
            for file in files {
                read(&mut library, &file)?;
            }
        }
        Ok(Self {
            monitor: Monitor::observer(Arc::new(library)),
        })
    }

    pub(in crate::command) fn judge(&mut self, passage: &Passage) -> Judged {
        let Some(message) = &passage.message else {
            return Judged::Left("the message cannot be read");
        };
        if passage.from_service {
            return Judged::Left("told by a message transport service");
        }
        if let Fate::Settled(Outcome::Failed { .. }) = passage.fate {
            return Judged::Left("not delivered");
        }
        // Each letter goes to one of the receivers of its message.
        let header = Header::from(message).receivers([&*passage.receiver]);
        match self.monitor.check(&header, passage.at) {
            Verdict::Accepted(accepted) => Judged::Accepted {
                protocol: accepted.protocol.to_owned(),
                state: accepted.state.to_owned(),
                opened: accepted.opened,
                ended: accepted.ended,
                complete: accepted.complete,
                late: accepted.late,
            },
            Verdict::Violation(violation) => Judged::Violation(violation),
            Verdict::Unchecked(why) => Judged::Unchecked(why),
            _ => Judged::Left("the verdict is not understood"),
        }
    }

    /// What has been waited for too long by now.
    pub(super) fn time_passes(&mut self, now: SystemTime) -> Vec<Overdue> {
        if self.monitor.poll_timeout().is_none_or(|due| due > now) {
            return Vec::new();
        }
        let events = self.monitor.handle_timeout(now).into_iter();
        let overdue = events.filter_map(|event| match event {
            Event::Overdue {
                protocol,
                conversation_id,
                participant,
                state,
                ..
            } => Some(Overdue {
                protocol,
                conversation_id,
                participant,
                state,
            }),
            _ => None,
        });
        overdue.collect()
    }
}

fn protocol_files(directory: &Path) -> Result<Vec<std::path::PathBuf>, Failure> {
    let failed = |error: std::io::Error| {
        Failure::wrong_usage(
            format!("cannot read the directory of protocols: {error}"),
            directory.display().to_string(),
            "name a directory with SCXML files (*.scxml or *.xml)",
        )
    };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let is_protocol = path
            .extension()
            .is_some_and(|extension| extension == "scxml" || extension == "xml");
        if is_protocol {
            files.push(path);
        }
    }
    Ok(files)
}

fn read(library: &mut Library, file: &Path) -> Result<(), Failure> {
    let name = file.display().to_string();
    let failed = |what: String| {
        Failure::wrong_usage(
            what,
            name.clone(),
            "correct the file, or take it out of the directory",
        )
    };
    let length = std::fs::metadata(file)
        .map_err(|error| failed(error.to_string()))?
        .len();
    if length > MAX_FILE {
        return Err(failed(format!(
            "{length} bytes are too many for a protocol"
        )));
    }
    let text = std::fs::read_to_string(file).map_err(|error| failed(error.to_string()))?;
    library.read(&name, &text).map_err(|error| match error {
        LibraryError::Full(full) => failed(full.to_string()),
        other => failed(other.to_string()),
    })
}
