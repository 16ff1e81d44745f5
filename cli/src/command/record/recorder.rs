//! Writes the observed events to the files of a recording, in a thread of its own.

use std::collections::{BTreeMap, HashMap};
use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use fipa::Entry;
use fipa::admin::watch::{Event, Passage};
use fipa_acl::escape;
use mcap::McapError;
use serde_json::{Value, json};
use tokio::sync::mpsc;

use super::file::writer::{RecordingFile, Split, Stamp, Syncer, Target};
use super::file::{self, RecordingError, letter};
use super::hosts::Hosts;
use super::locks::{Grants, LockEvent};
use super::note::Note;
use crate::command::watch::checker::{CheckResult, Checker, Earlier, Letter};
use crate::command::watch::filter::Filter;
use crate::command::watch::{OBSERVATION_DELAY, json};
use crate::input;
use crate::output::moment;
use crate::report::{self, Failure};

/// An observation for the thread that writes.
pub(super) enum Observation {
    /// An event of the watcher.
    Event(Event),
    /// The directory has changed.
    Directory(Directory),
    /// A value of a topic.
    Value(TopicValue),
    /// Metadata for the file.
    Note(Note),
    /// Time has passed.
    Tick,
}

/// The directory and its changes.
#[derive(Default)]
pub(super) struct Directory {
    pub(super) entries: Arc<[Arc<Entry>]>,
    pub(super) appeared: Vec<Arc<Entry>>,
    /// Agents that left, with the reason.
    pub(super) left: Vec<(Arc<Entry>, &'static str)>,
}

/// A value of a topic.
pub(super) struct TopicValue {
    pub(super) agent: Arc<str>,
    pub(super) topic: Arc<str>,
    pub(super) media_type: Arc<str>,
    pub(super) at: SystemTime,
    pub(super) content: bytes::Bytes,
    /// Values before it that this command did not get.
    pub(super) missed: u64,
}

/// Numbers for the display of the progress and the end.
#[derive(Debug, Default)]
pub(super) struct Counts {
    pub(super) letters: AtomicU64,
    pub(super) violations: AtomicU64,
    /// Lost records of the watched processes.
    pub(super) lost: AtomicU64,
    pub(super) values: AtomicU64,
    /// Values of topics that this command did not get.
    pub(super) missed: AtomicU64,
    pub(super) bytes: AtomicU64,
    pub(super) files: AtomicU64,
}

fn add(counter: &AtomicU64, number: u64) {
    counter.fetch_add(number, Ordering::Relaxed);
}

/// The settings of a recording.
pub(super) struct Settings {
    pub(super) split: Split,
    pub(super) sync: Duration,
    /// Metadata of each file.
    pub(super) about: BTreeMap<String, String>,
    pub(super) checker: Checker,
    pub(super) filter: Filter,
}

/// Writes a recording.
pub(super) struct Recorder {
    filter: Filter,
    split: Split,
    sync: Duration,
    about: BTreeMap<String, String>,
    checker: Checker,
    earlier: Earlier,
    grants: Grants,
    hosts: Hosts,
    directory: Arc<[Arc<Entry>]>,
    counts: Arc<Counts>,
    syncer: Syncer,
    open: Option<Open>,
    /// Bytes of the files before the open one.
    finished: u64,
    /// Whether letters before the next one are missing.
    after_loss: bool,
    /// The agent of this command, whose letters are not recorded.
    own: Option<String>,
}

/// The file that is being written.
struct Open {
    path: PathBuf,
    file: RecordingFile,
    since: Instant,
    flushed: Instant,
    channels: HashMap<Arc<str>, Channels>,
    totals: Totals,
}

/// The numbers of one file.
#[derive(Default)]
struct Totals {
    letters: u64,
    violations: u64,
    lost: u64,
    values: u64,
    missed: u64,
}

/// The channels of the letters to a receiver.
#[derive(Clone)]
struct Channels {
    letters: Arc<str>,
    raw: Arc<str>,
}

impl Channels {
    fn of(receiver: Option<&str>) -> Self {
        let letters = match receiver {
            Some(receiver) => format!("{}/{}", file::LETTERS, escape(receiver)),
            None => file::LETTERS.to_owned(),
        };
        let raw = format!("{letters}{}", file::RAW).into();
        Self {
            letters: letters.into(),
            raw,
        }
    }
}

impl Recorder {
    /// Creates the first file.
    pub(super) fn create(
        settings: Settings,
        directory: Directory,
        counts: Arc<Counts>,
    ) -> Result<Self, Failure> {
        let path = input::name(&settings.split.path);
        let syncer = Syncer::start().map_err(|error| failed(&error.into(), path))?;
        let mut recorder = Self {
            filter: settings.filter,
            split: settings.split,
            sync: settings.sync,
            about: settings.about,
            checker: settings.checker,
            earlier: Earlier::default(),
            grants: Grants::default(),
            hosts: Hosts::new(&directory.entries),
            directory: directory.entries,
            counts,
            syncer,
            open: None,
            finished: 0,
            after_loss: false,
            own: None,
        };
        recorder.earlier.add_entries(&recorder.directory);
        recorder.open()?;
        Ok(recorder)
    }

    /// Leaves out the letters of the agent of this command.
    pub(super) fn without(mut self, own: Option<String>) -> Self {
        self.own = own;
        self
    }

    /// Whether the agent of this command has sent or received a letter.
    fn is_own(&self, passage: &Passage) -> bool {
        let own = self.own.as_deref();
        own.is_some_and(|own| passage.sender() == Some(own) || *passage.receiver == *own)
    }

    /// Writes all observations until the senders are dropped, and closes the file.
    pub(super) fn run(mut self, mut all: mpsc::Receiver<Observation>) -> Result<(), Failure> {
        while let Some(observation) = all.blocking_recv() {
            self.handle(observation)?;
            self.handle_time()?;
        }
        self.close()?;
        let path = input::name(&self.split.path);
        self.syncer
            .end()
            .map_err(|error| failed(&error.into(), path))
    }

    fn open(&mut self) -> Result<&mut Open, Failure> {
        if self.open.is_none() {
            let place = input::name(&self.split.path);
            let path = self.split.next();
            let path = path.map_err(|error| failed(&error.into(), place))?;
            let created = begin(&path, &self.about, self.filter.is_empty());
            let file = created.map_err(|error| failed(&error, input::name(&path)))?;
            add(&self.counts.files, 1);
            self.open = Some(Open {
                path,
                file,
                since: Instant::now(),
                flushed: Instant::now(),
                channels: HashMap::new(),
                totals: Totals::default(),
            });
            for entry in Arc::clone(&self.directory).iter() {
                let event =
                    json!({ "event": "agent_appeared", "agent": **entry, "at_start": true });
                self.event(SystemTime::now(), &event)?;
            }
        }
        let place = input::name(&self.split.path);
        let open = self.open.as_mut();
        open.ok_or_else(|| failed(&std::io::Error::other("the file is closed").into(), place))
    }

    fn close(&mut self) -> Result<(), Failure> {
        let Some(open) = self.open.take() else {
            return Ok(());
        };
        let Open {
            path, file, totals, ..
        } = open;
        let written = finish(file, &totals);
        let written = written.map_err(|error| failed(&error, input::name(&path)))?;
        self.finished += written;
        self.counts.bytes.store(self.finished, Ordering::Relaxed);
        Ok(())
    }

    fn write(&mut self, target: Target<'_>, stamp: Stamp, data: &[u8]) -> Result<(), Failure> {
        let open = self.open()?;
        let written = open.file.write(target, stamp, data);
        written.map_err(|error| failed(&error, input::name(&open.path)))
    }

    fn handle(&mut self, observation: Observation) -> Result<(), Failure> {
        match observation {
            Observation::Event(Event::Letter(passage)) => self.letter(&passage),
            Observation::Event(Event::Later(passage)) => self.later(&passage),
            Observation::Event(Event::Lost { process, records }) => self.lost(&process, records),
            Observation::Event(Event::Refused { process, why }) => {
                let now = SystemTime::now();
                let why = why.to_string();
                self.event(now, &json::refused_object(&process, &why))?;
                self.log(now, Level::Error, &process, &why)
            }
            Observation::Directory(directory) => self.directory(directory),
            Observation::Value(value) => self.value(&value),
            Observation::Note(note) => self.note(note),
            Observation::Tick => self.overdue(),
            // Events of later versions.
            Observation::Event(_) => Ok(()),
        }
    }

    fn letter(&mut self, passage: &Passage) -> Result<(), Failure> {
        // Every letter is checked, whether recorded or not: the state of a conversation depends on all its letters.
        let observed = Letter::of(passage, &self.earlier);
        let checked = self.checker.check(Letter::of(passage, &self.earlier));
        let lock = self.grants.handle(passage);
        self.hosts.letter(passage);
        if !self.filter.takes(passage, &checked) || self.is_own(passage) {
            return Ok(());
        }
        let json = letter::to_json(passage, &checked, &observed, self.after_loss);
        let json = json.map_err(|error| {
            failed(
                &std::io::Error::other(error).into(),
                input::name(&self.split.path),
            )
        })?;
        let open = self.open()?;
        open.totals.letters += 1;
        let channels = channels(&mut open.channels, &passage.receiver);
        let stamp = Stamp {
            nanos: nanos(passage.at),
            // The number wraps around, as sequence numbers do.
            sequence: (passage.number & u64::from(u32::MAX)) as u32,
        };
        let target = Target {
            topic: &channels.letters,
            encoding: file::JSON,
            schema: Some(file::LETTER_SCHEMA),
        };
        self.write(target, stamp, &json)?;
        self.after_loss = false;
        add(&self.counts.letters, 1);
        if let Some(bytes) = letter::to_bytes(passage) {
            let target = Target {
                topic: &channels.raw,
                encoding: file::LETTER,
                schema: None,
            };
            self.write(target, stamp, &bytes)?;
        }
        self.report(passage, &checked)?;
        lock.map_or(Ok(()), |lock| self.lock(passage, &lock))
    }

    /// Writes the events and the log of a letter.
    fn report(&mut self, passage: &Passage, checked: &CheckResult) -> Result<(), Failure> {
        let sender = passage.sender().unwrap_or("?");
        if let CheckResult::Violation(violation) = checked {
            add(&self.counts.violations, 1);
            self.open()?.totals.violations += 1;
            let text = violation.to_string();
            let conversation = passage.message.as_ref().and_then(|it| it.conversation_id());
            let event = json!({
                "event": "violation", "number": passage.number, "sender": sender,
                "receiver": *passage.receiver, "protocol": violation.protocol,
                "conversation_id": conversation, "kind": violation.kind.as_str(), "text": text,
            });
            self.event(passage.at, &event)?;
            self.log(passage.at, Level::Error, sender, &text)?;
        }
        Ok(())
    }

    /// Writes the event and the log of a lock.
    fn lock(&mut self, passage: &Passage, lock: &LockEvent) -> Result<(), Failure> {
        let mut event = json!({
            "event": lock.event, "number": passage.number, "resource": lock.resource,
            "name": lock.agent, "text": lock.text,
        });
        if let (Some(event), Some(abandoned)) = (event.as_object_mut(), &lock.abandoned) {
            let seconds = (abandoned.waited.as_secs_f64() * 1e3).round() / 1e3;
            event.insert("seconds".to_owned(), seconds.into());
            event.insert("holder".to_owned(), abandoned.holder.as_deref().into());
            let since = abandoned.held_since.map(moment);
            event.insert("held_since".to_owned(), since.into());
            event.insert("fence".to_owned(), abandoned.fence.as_deref().into());
        }
        self.event(passage.at, &event)?;
        self.log(passage.at, Level::Warning, &lock.agent, &lock.text)
    }

    fn later(&mut self, passage: &Passage) -> Result<(), Failure> {
        // A violation was recorded with its letter.
        if self.filter.violations
            || !self.filter.takes(passage, &CheckResult::Checked)
            || self.is_own(passage)
        {
            return Ok(());
        }
        let object = json::later_object(passage);
        self.event(SystemTime::now(), &Value::Object(object))
    }

    fn lost(&mut self, process: &str, records: u64) -> Result<(), Failure> {
        self.earlier.add_entries(&self.directory);
        self.checker.forget();
        self.grants.forget();
        self.after_loss = true;
        add(&self.counts.lost, records);
        self.open()?.totals.lost += records;
        let now = SystemTime::now();
        self.event(now, &json::lost_object(process, records))?;
        let text = format!("{records} records of letters were lost");
        self.log(now, Level::Warning, process, &text)
    }

    fn directory(&mut self, directory: Directory) -> Result<(), Failure> {
        let now = SystemTime::now();
        for gone in self.hosts.handle(&directory.left, &directory.appeared) {
            let last = gone.last_letter.map(moment);
            let event = json!({
                "event": "host_gone", "host": *gone.host, "agents": gone.agents, "last_letter": last,
            });
            self.event(now, &event)?;
            let agents = match gone.agents {
                1 => "1 agent".to_owned(),
                agents => format!("{agents} agents"),
            };
            let last = match last {
                Some(last) => format!("the last letter from it is of {last}"),
                None => "no letter from it was observed".to_owned(),
            };
            let text = format!("the host is gone, with {agents}; {last}");
            self.log(now, Level::Warning, &gone.host, &text)?;
        }
        self.directory = directory.entries;
        for (entry, reason) in directory.left {
            let name = &*entry.name;
            let event =
                json!({ "event": "agent_left", "name": name, "reason": reason, "agent": *entry });
            self.event(now, &event)?;
            self.grants.leave(name);
        }
        for entry in directory.appeared {
            let event = json!({ "event": "agent_appeared", "agent": *entry });
            self.event(now, &event)?;
        }
        Ok(())
    }

    fn value(&mut self, value: &TopicValue) -> Result<(), Failure> {
        let topic = format!("/topics/{}/{}", escape(&value.agent), escape(&value.topic));
        let encoding = match &*value.media_type {
            "application/json" => file::JSON,
            // Messages with this encoding are the bytes of letters.
            file::LETTER => "",
            other => other,
        };
        let open = self.open()?;
        if !open.file.has_room(&topic, encoding) {
            // Topics that come and go may have any number of names.
            let missed = value.missed.saturating_add(1);
            open.totals.missed += missed;
            add(&self.counts.missed, missed);
            return Ok(());
        }
        open.totals.values += 1;
        open.totals.missed += value.missed;
        let sequence = (open.totals.values & u64::from(u32::MAX)) as u32;
        add(&self.counts.values, 1);
        add(&self.counts.missed, value.missed);
        let target = Target {
            topic: &topic,
            encoding,
            schema: None,
        };
        let stamp = Stamp {
            nanos: nanos(value.at),
            sequence,
        };
        self.write(target, stamp, &value.content)?;
        if value.missed > 0 {
            let event = json!({
                "event": "lost", "process": *value.agent, "topic": *value.topic, "records": value.missed
            });
            self.event(SystemTime::now(), &event)?;
        }
        Ok(())
    }

    fn note(&mut self, note: Note) -> Result<(), Failure> {
        let open = self.open()?;
        let written = open.file.write_metadata(&note.name, note.pairs);
        written.map_err(|error| failed(&error, input::name(&open.path)))
    }

    fn overdue(&mut self) -> Result<(), Failure> {
        let now = SystemTime::now();
        for overdue in self.checker.handle_timeout(now - OBSERVATION_DELAY) {
            let (protocol, conversation) = (&*overdue.protocol, &*overdue.conversation_id);
            if self
                .filter
                .takes_conversation(Some(protocol), Some(conversation))
            {
                self.event(now, &json::overdue_object(&overdue))?;
            }
        }
        Ok(())
    }

    fn event(&mut self, at: SystemTime, event: &Value) -> Result<(), Failure> {
        self.write_json(file::EVENTS, file::EVENT_SCHEMA, at, event)
    }

    fn log(&mut self, at: SystemTime, level: Level, name: &str, text: &str) -> Result<(), Failure> {
        let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
        let log = json!({
            "timestamp": { "sec": since.as_secs(), "nsec": since.subsec_nanos() },
            "level": level as u8, "message": text, "name": name, "file": "", "line": 0,
        });
        self.write_json(file::LOG, file::LOG_SCHEMA, at, &log)
    }

    fn write_json(
        &mut self,
        topic: &str,
        schema: file::Schema,
        at: SystemTime,
        value: &Value,
    ) -> Result<(), Failure> {
        let target = Target {
            topic,
            encoding: file::JSON,
            schema: Some(schema),
        };
        let stamp = Stamp {
            nanos: nanos(at),
            sequence: 0,
        };
        self.write(target, stamp, value.to_string().as_bytes())
    }

    /// Ends chunks and files at their times.
    fn handle_time(&mut self) -> Result<(), Failure> {
        let sync = self.sync;
        let open = self.open()?;
        let mut is_removed = false;
        if open.flushed.elapsed() >= sync {
            let removed = open.file.is_removed();
            is_removed = removed.map_err(|error| failed(&error, input::name(&open.path)))?;
            if is_removed {
                let path = input::name(&open.path);
                report::warn(&format!(
                    "{path} was removed; the recording goes on in a new file"
                ));
            }
            self.flush()?;
        }
        let open = self.open()?;
        let (written, since) = (open.file.written(), open.since);
        if !is_removed && !self.split.is_full(written, since) {
            return Ok(());
        }
        self.close()?;
        // The conversations of the next file may have begun in this one.
        self.earlier.add_entries(&self.directory);
        self.after_loss = true;
        self.open()?;
        let place = input::name(&self.split.path);
        let deleted = self.split.delete_oldest();
        deleted.map_err(|error| failed(&error.into(), place))
    }

    fn flush(&mut self) -> Result<(), Failure> {
        let finished = self.finished;
        let open = self.open()?;
        open.flushed = Instant::now();
        let flushed = open.file.flush();
        let file = flushed.map_err(|error| failed(&error, input::name(&open.path)))?;
        let (written, path) = (open.file.written(), input::name(&open.path));
        let bytes = finished.saturating_add(written);
        self.counts.bytes.store(bytes, Ordering::Relaxed);
        match self.syncer.request(file) {
            true => Ok(()),
            false => Err(failed(
                &std::io::Error::other("the disk does not store the file").into(),
                path,
            )),
        }
    }
}

/// Levels of `foxglove.Log`.
#[derive(Debug, Clone, Copy)]
#[repr(u8)]
enum Level {
    Warning = 3,
    Error = 4,
}

fn channels(all: &mut HashMap<Arc<str>, Channels>, receiver: &Arc<str>) -> Channels {
    if let Some(known) = all.get(receiver) {
        return known.clone();
    }
    if all.len() >= file::MAX_RECEIVERS {
        return Channels::of(None);
    }
    let channels = Channels::of(Some(receiver));
    all.insert(Arc::clone(receiver), channels.clone());
    channels
}

/// Creates a file with its metadata.
fn begin(
    path: &std::path::Path,
    about: &BTreeMap<String, String>,
    is_whole: bool,
) -> Result<RecordingFile, RecordingError> {
    let mut file = RecordingFile::create(path)?;
    let mut about = about.clone();
    about.insert("began".to_owned(), moment(SystemTime::now()));
    file.write_metadata(file::ABOUT, about)?;
    if !is_whole {
        file.write_metadata(file::FILTERED, BTreeMap::new())?;
    }
    file.flush()?;
    Ok(file)
}

/// Writes the totals and closes a file. Returns its length.
fn finish(mut file: RecordingFile, totals: &Totals) -> Result<u64, RecordingError> {
    let numbers = [
        ("letters", totals.letters),
        ("violations", totals.violations),
        ("lost_records", totals.lost),
        ("topic_values", totals.values),
        ("missed_topic_values", totals.missed),
    ];
    let mut metadata: BTreeMap<String, String> = numbers
        .into_iter()
        .map(|(key, number)| (key.to_owned(), number.to_string()))
        .collect();
    metadata.insert("ended".to_owned(), moment(SystemTime::now()));
    file.write_metadata(file::TOTALS, metadata)?;
    file.finish()
}

fn nanos(time: SystemTime) -> u64 {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

/// The error report of a file that cannot be written.
pub(super) fn failed(error: &RecordingError, path: String) -> Failure {
    let cause = match error {
        RecordingError::Io(error) | RecordingError::Mcap(McapError::Io(error)) => {
            Some(error.kind())
        }
        _ => None,
    };
    let help = match cause {
        Some(ErrorKind::AlreadyExists) => "give another name; an existing file is not overwritten",
        Some(ErrorKind::StorageFull | ErrorKind::QuotaExceeded) => {
            "free space on the disk, or limit the recording with --split-size and --keep"
        }
        _ => "give a file that this user can write, on a disk with free space",
    };
    let problem = format!(
        "cannot write the recording: {}",
        fipa::error::ErrorChain(error)
    );
    Failure::failed(problem, path, help)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_explained_also_by_the_format() {
        let full = || std::io::Error::from(ErrorKind::StorageFull);
        for error in [
            RecordingError::Io(full()),
            RecordingError::Mcap(McapError::Io(full())),
        ] {
            let failure = failed(&error, "run.mcap".to_owned());
            assert!(format!("{failure:?}").contains("--keep"), "{failure:?}");
        }
    }
}
