//! Observes the domain and hands the observations to the thread that writes.

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::os::fd::AsFd as _;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use fipa::admin::watch::{WatchOptions, Watcher};
use fipa::{Config, Entry, Incarnation};
use fipa_acl::escape_name;
use indicatif::{HumanBytes, ProgressBar, ProgressStyle};
use serde_json::json;
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::net::unix::pipe;
use tokio::sync::mpsc::{self, Sender};
use tokio::time::MissedTickBehavior;

use super::Arguments;
use super::file::writer::Split;
use super::hosts::HOST_GONE;
use super::note::Note;
use super::recorder::{Counts, Directory, Observation, Recorder, Settings};
use super::topics::Topics;
use crate::command::watch::TICK;
use crate::command::watch::checker::{self, Checker};
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::report::{self, Failure};
use crate::{input, output};

/// Maximum number of observations that wait for the thread that writes. Beyond it the watcher waits.
const MAX_WAITING: usize = 8192;

pub(super) fn run(arguments: &Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    report::warn_of_performatives(&arguments.filter.performative);
    let split = split(arguments)?;
    let library = checker::protocols(&config.monitor.protocols, arguments.protocols.as_deref())?;
    let settings = Settings {
        about: about(&config),
        split,
        sync: arguments.sync,
        checker: Checker::new(library),
        filter: arguments.filter.clone(),
    };
    options::block_on(record(arguments, settings, &config))?
}

fn split(arguments: &Arguments) -> Result<Split, Failure> {
    let wrong = |problem: &str, help: &str| Failure::wrong_usage(problem, "the command line", help);
    let path = arguments.output.clone();
    let path = path.ok_or_else(|| wrong("no file is given", "give one with --output"))?;
    let is_split = arguments.split_size.is_some() || arguments.split_duration.is_some();
    if arguments.keep.is_some() && !is_split {
        let help = "add --split-size or --split-duration";
        return Err(wrong("--keep needs a recording of several files", help));
    }
    Ok(Split {
        path,
        size: arguments.split_size,
        duration: arguments.split_duration,
        keep: arguments.keep.and_then(|keep| usize::try_from(keep).ok()),
    })
}

/// The metadata of each file.
fn about(config: &Config) -> BTreeMap<String, String> {
    [
        ("host", output::host_name()),
        ("domain", config.domain.clone()),
        ("gateway", config.mts.name.clone()),
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
        ("clock", "CLOCK_REALTIME of the host".to_owned()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}

async fn record(arguments: &Arguments, settings: Settings, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let notes = arguments.supervised.then(notes).transpose()?;
    let content = arguments.content;
    let mut watcher = stop
        .during(membership::watch(config, WatchOptions { content }))
        .await?;
    let mut recording = Recording {
        counts: Arc::default(),
        began: Instant::now(),
        known: Known::default(),
        progress: progress(),
    };
    let path = input::name(&settings.split.path);
    let first = recording.known.changes(&watcher).unwrap_or_default();
    let recorder = Recorder::create(settings, first, Arc::clone(&recording.counts))?;
    let topics = stop.during(Topics::join(&arguments.topics, config)).await?;
    // The values of topics are recorded once, and not as letters, too.
    let own = topics.as_ref().map(Topics::name);
    let recorder = recorder.without(own);
    let (sender, observations) = mpsc::channel(MAX_WAITING);
    let writing = tokio::task::spawn_blocking(move || recorder.run(observations));
    recording.begin(arguments, &path, &config.domain, watcher.processes())?;
    {
        let mut stopped = pin!(stop.requested());
        let mut over = pin!(options::after(arguments.time));
        tokio::select! {
            () = recording.observe(&mut watcher, &sender) => {}
            () = follow(topics.as_ref(), &sender) => {}
            () = forward(notes, &sender) => {}
            () = &mut stopped => {}
            () = &mut over => {}
        }
    }
    Stop::ending();
    while let Some(event) = watcher.finish() {
        // Fails if the thread has ended; it returns the reason.
        let _ = sender.send(Observation::Event(event)).await;
    }
    drop((sender, watcher));
    if let Some(topics) = topics {
        topics.leave().await;
    }
    let written = writing.await;
    recording.progress.finish_and_clear();
    written.map_err(|error| {
        let help = "report this error, with the log of the command";
        Failure::failed(error.to_string(), path, help)
    })??;
    recording.end(arguments)
}

/// Standard input, which is a pipe from the process that started this one.
fn notes() -> Result<pipe::Receiver, Failure> {
    let input = io::stdin().as_fd().try_clone_to_owned();
    let input = input.and_then(pipe::Receiver::from_owned_fd);
    input.map_err(|error| {
        let problem = format!("standard input is no pipe: {error}");
        Failure::wrong_usage(
            problem,
            "standard input",
            "run the command without --supervised",
        )
    })
}

/// Forwards metadata from standard input until its end. Does not return without it.
async fn forward(notes: Option<pipe::Receiver>, sender: &Sender<Observation>) {
    let Some(notes) = notes else {
        return std::future::pending().await;
    };
    let mut lines = BufReader::new(notes).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        match Note::read(&line) {
            // Fails if the thread has ended, and so the recording.
            Ok(note) => {
                let _ = sender.send(Observation::Note(note)).await;
            }
            Err(error) => report::warn(&format!("a metadata record is left out: {error}")),
        }
    }
}

/// Forwards the values of topics. Does not return without topics.
async fn follow(topics: Option<&Topics>, sender: &Sender<Observation>) {
    match topics {
        Some(topics) => topics.run(sender).await,
        None => std::future::pending().await,
    }
}

/// The course of a recording.
struct Recording {
    counts: Arc<Counts>,
    began: Instant,
    known: Known,
    progress: ProgressBar,
}

impl Recording {
    fn begin(
        &self,
        arguments: &Arguments,
        path: &str,
        domain: &str,
        processes: usize,
    ) -> Result<(), Failure> {
        if arguments.json {
            return output::json_line(&json!({
                "event": "recording", "domain": domain, "file": path, "processes": processes,
            }));
        }
        let domain = escape_name(domain);
        output::text(&format!(
            "recording {processes} processes of domain {domain} to {path}; press Ctrl-C to stop\n"
        ))
    }

    /// Forwards all observations, until the thread that writes ends because of an error.
    async fn observe(&mut self, watcher: &mut Watcher, sender: &Sender<Observation>) {
        let mut ticks = tokio::time::interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // Places are taken before observations, so that the end of this future loses none.
        while let (Ok(first), Ok(second)) = (sender.reserve().await, sender.reserve().await) {
            tokio::select! {
                event = watcher.next() => first.send(Observation::Event(event)),
                _ = ticks.tick() => {
                    self.progress.set_message(self.line());
                    if let Some(directory) = self.known.changes(watcher) {
                        first.send(Observation::Directory(directory));
                    }
                    second.send(Observation::Tick);
                }
            }
        }
    }

    fn line(&self) -> String {
        let [letters, violations, lost, values, bytes] = [
            &self.counts.letters,
            &self.counts.violations,
            &self.counts.lost,
            &self.counts.values,
            &self.counts.bytes,
        ]
        .map(|it| it.load(Ordering::Relaxed));
        let values = match values {
            0 => String::new(),
            values => format!(", {values} values of topics"),
        };
        let bytes = HumanBytes(bytes);
        format!("{letters} letters{values}, {violations} violations, {lost} lost records, {bytes}")
    }

    fn end(&self, arguments: &Arguments) -> Result<(), Failure> {
        let seconds = self.began.elapsed().as_secs_f64();
        let number = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let counts = &self.counts;
        if arguments.json {
            return output::json_line(&json!({
                "event": "summary", "seconds": (seconds * 1e3).round() / 1e3,
                "letters": number(&counts.letters), "violations": number(&counts.violations),
                "lost": number(&counts.lost), "topic_values": number(&counts.values),
                "missed_topic_values": number(&counts.missed), "bytes": number(&counts.bytes),
                "files": number(&counts.files),
            }));
        }
        let files = match number(&counts.files) {
            1 => String::new(),
            files => format!(", {files} files"),
        };
        output::text(&format!("{}{files} in {seconds:.1} s\n", self.line()))
    }
}

/// A line on a terminal that shows the progress.
fn progress() -> ProgressBar {
    let progress = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}") {
        progress.set_style(style);
    }
    progress
}

/// The agents of the directory as they were reported last.
#[derive(Default)]
struct Known {
    entries: Arc<[Arc<Entry>]>,
}

impl Known {
    /// Returns the changes of the directory since the last call; `None` without changes.
    fn changes(&mut self, watcher: &Watcher) -> Option<Directory> {
        let directory = watcher.directory();
        directory.refresh();
        let entries = directory.entries();
        if Arc::ptr_eq(&entries, &self.entries) {
            return None;
        }
        let now = registrations(&entries);
        let before = registrations(&self.entries);
        let is_new = |entry: &&Arc<Entry>| before.get(&*entry.name) != Some(&entry.incarnation);
        let is_gone = |entry: &&Arc<Entry>| now.get(&*entry.name) != Some(&entry.incarnation);
        let reason = |entry: &Arc<Entry>| match directory.lost_agent(&entry.name) {
            Some(_) => HOST_GONE,
            None => "it ended or was deregistered",
        };
        let left = self.entries.iter().filter(is_gone);
        let changes = Directory {
            appeared: entries.iter().filter(is_new).cloned().collect(),
            left: left
                .map(|entry| (Arc::clone(entry), reason(entry)))
                .collect(),
            entries: Arc::clone(&entries),
        };
        drop((now, before));
        self.entries = entries;
        Some(changes)
    }
}

fn registrations(entries: &[Arc<Entry>]) -> HashMap<&str, Incarnation> {
    let pairs = entries.iter().map(|it| (&*it.name, it.incarnation));
    pairs.collect()
}
