//! Checks letters against the protocols of their conversations.

use std::collections::HashSet;
use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::admin::watch::{Fate, Passage};
use fipa::{DeliveryFailure, DirectoryView, Entry, Message, Outcome};
use fipa_acl::Time;
use fipa_monitor::{
    Event, Header, History, Library, LibraryError, Monitor, Unchecked, Verdict, Violation,
};

use crate::report::Failure;

/// Checks every observed letter.
pub(in crate::command) struct Checker {
    library: Arc<Library>,
    monitor: Monitor,
}

/// The result of checking a letter.
#[derive(Debug, Clone)]
pub(in crate::command) enum CheckResult {
    /// The letter follows the protocol.
    Accepted {
        protocol: String,
        state: String,
        opened: bool,
        ended: bool,
        complete: bool,
        late: bool,
    },
    /// The letter violates the protocol.
    Violation(Box<Violation>),
    /// The letter cannot be checked.
    Unchecked(Unchecked),
    /// The letter is not part of a conversation between agents, for this reason.
    Excluded(&'static str),
    /// The letter was checked when it was first seen.
    Checked,
}

impl CheckResult {
    pub(in crate::command) fn is_violation(&self) -> bool {
        matches!(self, Self::Violation(_))
    }

    pub(in crate::command) fn protocol(&self) -> Option<&str> {
        match self {
            Self::Accepted { protocol, .. } => Some(protocol),
            Self::Violation(violation) => Some(&violation.protocol),
            _ => None,
        }
    }
}

/// A message that the protocol requires and that did not arrive in time.
pub(in crate::command) struct Overdue {
    pub(in crate::command) protocol: String,
    pub(in crate::command) conversation_id: String,
    pub(in crate::command) participant: Option<String>,
    pub(in crate::command) state: String,
}

/// Maximum size of a protocol file, in bytes.
const MAX_FILE: u64 = 1 << 20;

/// The data of a letter that its check needs.
pub(in crate::command) struct Letter<'a> {
    pub(in crate::command) message: Option<&'a Message>,
    pub(in crate::command) receiver: &'a str,
    pub(in crate::command) at: SystemTime,
    /// The time from `at` by which its sender expects an answer, if the letter has it.
    pub(in crate::command) answer_within: Option<Duration>,
    /// Whether a message transport service wrote it.
    pub(in crate::command) from_service: bool,
    pub(in crate::command) undelivered: bool,
    /// Whether its conversation may have begun before the observation.
    pub(in crate::command) may_continue: bool,
}

impl<'a> Letter<'a> {
    /// Returns the data of an observed letter.
    pub(in crate::command) fn of(passage: &'a Passage, earlier: &Earlier) -> Self {
        Self {
            message: passage.message.as_ref(),
            receiver: &passage.receiver,
            at: passage.at,
            answer_within: answer_within(passage),
            from_service: passage.from_service || is_report_of_elsewhere(passage),
            undelivered: matches!(passage.fate, Fate::Settled(Outcome::Failed { .. })),
            may_continue: earlier.may_have_begun(passage),
        }
    }
}

/// Returns the time by which an answer is due, from the sending of a letter. The clock of its sender may
/// differ from that of this host.
fn answer_within(passage: &Passage) -> Option<Duration> {
    let by = passage.message.as_ref()?.reply_by()?;
    by.span_since(passage.envelope.get()?.effective().date?)
}

/// Whether a service of another host, which sends no records, probably wrote the letter.
fn is_report_of_elsewhere(passage: &Passage) -> bool {
    let message = passage.message.as_ref().filter(|_| passage.from_elsewhere);
    message.and_then(DeliveryFailure::read).is_some()
}

/// The agents that were registered before the observation began: conversations among them may have begun
/// before it. An agent that registers later cannot continue a conversation, unless it has a name of
/// before.
#[derive(Debug, Default)]
pub(in crate::command) struct Earlier {
    names: HashSet<Arc<str>>,
}

impl Earlier {
    /// Adds the agents that are registered now.
    pub(in crate::command) fn add(&mut self, directory: DirectoryView<'_>) {
        directory.refresh();
        self.add_entries(&directory.entries());
    }

    /// Adds the agents of these entries.
    pub(in crate::command) fn add_entries(&mut self, entries: &[Arc<Entry>]) {
        self.names
            .extend(entries.iter().map(|entry| Arc::clone(&entry.name)));
    }

    fn may_have_begun(&self, passage: &Passage) -> bool {
        // The directory may not have had all agents of other hosts.
        let crosses_hosts = passage.from_elsewhere || passage.gateway.is_some();
        let was_there = |name: &str| self.names.contains(name);
        crosses_hosts || passage.sender().is_none_or(was_there) && was_there(&passage.receiver)
    }
}

/// Returns the protocols of the standards, of the configuration, and in this directory. Later ones
/// replace earlier ones of the same name.
pub(in crate::command) fn protocols(
    configured: &[String],
    directory: Option<&Path>,
) -> Result<Library, Failure> {
    let mut library = Library::standard();
    for file in configured {
        let remedy = "fix the file, or remove it from monitor.protocols";
        read(&mut library, Path::new(file), remedy)?;
    }
    if let Some(directory) = directory {
        let mut files = protocol_files(directory)?;
        files.sort();
        for file in files {
            read(
                &mut library,
                &file,
                "fix the file, or remove it from the directory",
            )?;
        }
    }
    Ok(library)
}

impl Checker {
    /// Creates a checker with these protocols.
    pub(in crate::command) fn new(library: impl Into<Arc<Library>>) -> Self {
        let library = library.into();
        Self {
            monitor: Monitor::observer(Arc::clone(&library)),
            library,
        }
    }

    /// Forgets all conversations, because letters are missing.
    pub(in crate::command) fn forget(&mut self) {
        self.monitor = Monitor::observer(Arc::clone(&self.library));
    }

    pub(in crate::command) fn check(&mut self, letter: Letter<'_>) -> CheckResult {
        let Some(message) = letter.message else {
            return CheckResult::Excluded("the message cannot be decoded");
        };
        if letter.from_service {
            return CheckResult::Excluded("sent by a message transport service");
        }
        if letter.undelivered {
            return CheckResult::Excluded("not delivered");
        }
        self.monitor.set_history(match letter.may_continue {
            true => History::Unknown,
            false => History::Complete,
        });
        // A letter has exactly one receiver, a message can have several.
        let mut header = Header::from(message).copy_for(letter.receiver);
        if let Some(by) = letter.answer_within.and_then(|it| Time::after(it).ok()) {
            header = header.reply_by(by);
        }
        match self.monitor.check(&header, letter.at) {
            Verdict::Accepted(accepted) => CheckResult::Accepted {
                protocol: accepted.protocol.to_owned(),
                state: accepted.state.to_owned(),
                opened: accepted.opened,
                ended: accepted.ended,
                complete: accepted.complete,
                late: accepted.late,
            },
            Verdict::Violation(violation) => CheckResult::Violation(violation),
            Verdict::Unchecked(why) => CheckResult::Unchecked(why),
            _ => CheckResult::Excluded("the verdict is unknown"),
        }
    }

    /// Handles timeouts up to a time, without reporting overdue messages.
    pub(in crate::command) fn pass(&mut self, now: SystemTime) {
        drop(self.handle_timeout(now));
    }

    /// Returns the messages that have become overdue by `now`.
    pub(in crate::command) fn handle_timeout(&mut self, now: SystemTime) -> Vec<Overdue> {
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
            format!("cannot read the protocol directory: {error}"),
            directory.display().to_string(),
            "give a directory with SCXML files (*.scxml, *.xml, or without an extension)",
        )
    };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let is_protocol = match path.extension() {
            Some(extension) => extension == "scxml" || extension == "xml",
            // The files of fipa_acl have no extension.
            None => is_xml(&path),
        };
        if is_protocol {
            files.push(path);
        }
    }
    Ok(files)
}

/// Whether a file begins like XML.
fn is_xml(file: &Path) -> bool {
    let mut beginning = [0; 64];
    let read = File::open(file).and_then(|mut file| match file.metadata()?.is_file() {
        true => file.read(&mut beginning),
        false => Ok(0),
    });
    let beginning = beginning.get(..read.unwrap_or(0)).unwrap_or_default();
    let text = beginning.strip_prefix(b"\xef\xbb\xbf").unwrap_or(beginning);
    text.trim_ascii_start().starts_with(b"<")
}

fn read(library: &mut Library, file: &Path, remedy: &str) -> Result<(), Failure> {
    let name = file.display().to_string();
    let failed = |problem: String| Failure::wrong_usage(problem, name.clone(), remedy);
    let length = std::fs::metadata(file)
        .map_err(|error| failed(error.to_string()))?
        .len();
    if length > MAX_FILE {
        return Err(failed(format!(
            "the file has {length} bytes, more than the limit of {MAX_FILE}"
        )));
    }
    let text = std::fs::read_to_string(file).map_err(|error| failed(error.to_string()))?;
    library.read(&name, &text).map_err(|error| match error {
        LibraryError::Full(full) => failed(full.to_string()),
        other => failed(other.to_string()),
    })
}
