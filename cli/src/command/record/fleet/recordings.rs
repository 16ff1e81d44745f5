//! The recordings in the directory of a recorder.
//!
//! Each recording is written by a process of its own, so that it costs the process of the gateway nothing. That process
//! ends with its standard input, also if the gateway is killed.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::{DirBuilderExt as _, FileExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::log_limit;
use fipa_acl::escape;
use parking_lot::Mutex;
use ring::digest::{Context, SHA256};
use rustix::fs::OFlags;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::process::{Child, ChildStderr, ChildStdin, Command};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::timeout;

use super::clock::{CLOCK_AT_START, CLOCK_AT_STOP, Clock};
use super::order::{Listing, MAX_LISTED, Options, Recording, RecordingName, State};
use crate::command::record::note::Note;

/// Maximum number of recordings at the same time.
const MAX_RUNNING: usize = 4;
/// Maximum wait for the beginning of a recording.
const BEGIN_WITHIN: Duration = Duration::from_secs(20);
/// Maximum wait for the end of a recording; after it the process is killed.
const END_WITHIN: Duration = Duration::from_secs(20);
/// Maximum length of the errors of a process that are kept, in bytes.
const MAX_ERRORS: usize = 4096;
/// Extension of the files.
const EXTENSION: &str = "mcap";

/// Error of an order about recordings.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(super) enum RecordingsError {
    /// The name is used.
    #[error("there is a recording {0} on this host; use another name")]
    Exists(RecordingName),
    /// There is no recording with this name.
    #[error("there is no recording {0} on this host")]
    Unknown(RecordingName),
    /// The recording is not finished.
    #[error("the recording {0} is not finished; stop it first")]
    Unfinished(RecordingName),
    /// Too many recordings run.
    #[error("this host already writes {MAX_RUNNING} recordings; stop one of them first")]
    TooMany,
    /// The process that records ended.
    #[error("the recording did not begin: {0}")]
    NotBegun(String),
    /// The process that records did not end in time.
    #[error("the recording {0} did not end within {seconds} s", seconds = END_WITHIN.as_secs())]
    NotEnded(RecordingName),
    /// A file cannot be used.
    #[error("the directory of the recordings cannot be used: {0}")]
    Io(#[from] io::Error),
}

/// The recordings of this host.
pub(super) struct Recordings {
    /// Name of the gateway.
    host: String,
    directory: PathBuf,
    /// Maximum size of all recordings.
    bytes: u64,
    /// The arguments that select the configuration of this process.
    arguments: Vec<OsString>,
    running: Mutex<BTreeMap<RecordingName, Running>>,
}

/// A recording that is being written.
struct Running {
    /// Metadata for the file. Dropping it ends the recording.
    notes: Option<mpsc::Sender<Note>>,
    /// Whether the process has ended.
    ended: watch::Receiver<bool>,
}

/// A file of the directory.
struct Stored {
    name: RecordingName,
    path: PathBuf,
    bytes: u64,
    modified: SystemTime,
}

impl Recordings {
    /// Opens the directory, and creates it if it is missing.
    pub(super) fn open(
        host: &str,
        directory: &Path,
        bytes: u64,
        arguments: Vec<OsString>,
    ) -> io::Result<Arc<Self>> {
        DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(directory)?;
        let this = Self {
            host: host.to_owned(),
            directory: directory.to_owned(),
            bytes,
            arguments,
            running: Mutex::default(),
        };
        this.stored()?;
        Ok(Arc::new(this))
    }

    fn path(&self, name: &RecordingName) -> PathBuf {
        self.directory.join(format!("{name}.{EXTENSION}"))
    }

    /// Begins a recording, and waits until it records.
    pub(super) async fn start(
        self: &Arc<Self>,
        name: RecordingName,
        options: &Options,
        clock: Option<Clock>,
    ) -> Result<Recording, RecordingsError> {
        let command = self.command(&name, options);
        let (this, named) = (Arc::clone(self), name.clone());
        let begun = blocking(move || this.spawn(command, named)).await?;
        let (mut begun, errors) = begun;
        if let Some(clock) = clock {
            self.note(&name, CLOCK_AT_START, &clock).await;
        }
        let first = timeout(BEGIN_WITHIN, begun.output.next_line()).await;
        if !matches!(first, Ok(Ok(Some(_)))) {
            self.end(&name);
            let _ = timeout(END_WITHIN, begun.ended.wait_for(|ended| *ended)).await;
            let errors = timeout(END_WITHIN, errors).await;
            let errors = errors.ok().and_then(Result::ok).unwrap_or_default();
            return Err(RecordingsError::NotBegun(errors.trim().replace('\n', "; ")));
        }
        Ok(Recording {
            name,
            state: State::Recording,
            bytes: 0,
        })
    }

    /// The process of a recording. It has no argument of the order except numbers and patterns.
    fn command(&self, name: &RecordingName, options: &Options) -> Command {
        // The program of this process, also if its file has been replaced since.
        let mut command = Command::new("/proc/self/exe");
        command.arg0("fipa");
        command.args(["record", "--supervised", "--json", "--output"]);
        command.arg(self.path(name));
        command.arg(format!("--for={}s", options.seconds));
        if let Some(content) = options.content {
            command.arg(format!("--content={content}"));
        }
        command.args(options.agents.iter().map(|it| format!("--agent={it}")));
        command.args(
            options
                .protocols
                .iter()
                .map(|it| format!("--protocol={it}")),
        );
        command.args(&self.arguments);
        command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            // Ctrl-C in the terminal of the gateway ends the gateway, which ends its recordings.
            .process_group(0);
        command
    }

    fn spawn(
        self: &Arc<Self>,
        mut command: Command,
        name: RecordingName,
    ) -> Result<(Begun, JoinHandle<String>), RecordingsError> {
        self.make_room()?;
        let mut running = self.running.lock();
        if running.contains_key(&name) || self.path(&name).symlink_metadata().is_ok() {
            return Err(RecordingsError::Exists(name));
        }
        if running.len() >= MAX_RUNNING {
            return Err(RecordingsError::TooMany);
        }
        let mut child = command.spawn()?;
        let pipes = (child.stdin.take(), child.stdout.take(), child.stderr.take());
        let (Some(input), Some(output), Some(errors)) = pipes else {
            return Err(io::Error::other("the process of the recording has no pipes").into());
        };
        let (notes, noted) = mpsc::channel(2);
        let (ending, ended) = watch::channel(false);
        let place = Running {
            notes: Some(notes),
            ended: ended.clone(),
        };
        running.insert(name.clone(), place);
        let (this, attended) = (Arc::clone(self), name.clone());
        tokio::spawn(async move {
            let status = attend(child, input, noted).await;
            this.running.lock().remove(&attended);
            report(&attended, &status);
            ending.send_replace(true);
        });
        let begun = Begun {
            output: BufReader::new(output).lines(),
            ended,
        };
        Ok((begun, tokio::spawn(last_errors(errors))))
    }

    /// Writes a measurement of the clock into the file of a running recording.
    async fn note(&self, name: &RecordingName, record: &str, clock: &Clock) {
        let notes = self
            .running
            .lock()
            .get(name)
            .and_then(|it| it.notes.clone());
        let note = Note {
            name: record.to_owned(),
            pairs: clock.to_metadata(&self.host),
        };
        if let Some(notes) = notes {
            // Fails if the recording has just ended.
            let _ = notes.send(note).await;
        }
    }

    /// Lets a recording end.
    fn end(&self, name: &RecordingName) -> Option<watch::Receiver<bool>> {
        let mut running = self.running.lock();
        let recording = running.get_mut(name)?;
        recording.notes = None;
        Some(recording.ended.clone())
    }

    /// Ends a recording, and waits for its end.
    pub(super) async fn stop(
        self: &Arc<Self>,
        name: RecordingName,
        clock: Option<Clock>,
    ) -> Result<Recording, RecordingsError> {
        if let Some(clock) = clock {
            self.note(&name, CLOCK_AT_STOP, &clock).await;
        }
        if let Some(mut ended) = self.end(&name) {
            // An error means that the process has ended.
            let waited = timeout(END_WITHIN * 2, ended.wait_for(|ended| *ended)).await;
            if waited.is_err() {
                return Err(RecordingsError::NotEnded(name));
            }
        }
        let this = Arc::clone(self);
        blocking(move || {
            Ok(Recording {
                bytes: this.open_file(&name)?.metadata()?.len(),
                state: State::Finished,
                name,
            })
        })
        .await
    }

    /// Lists the recordings.
    pub(super) async fn list(self: &Arc<Self>) -> Result<Listing, RecordingsError> {
        let this = Arc::clone(self);
        blocking(move || {
            // The length of a recording that ends meanwhile is not final.
            let earlier: BTreeSet<_> = this.running.lock().keys().cloned().collect();
            let mut stored = this.stored()?;
            // The newest ones.
            stored.sort_by_key(|it| std::cmp::Reverse(it.modified));
            stored.truncate(MAX_LISTED);
            let running = this.running.lock();
            let recordings = stored.into_iter().map(|it| Recording {
                state: match earlier.contains(&it.name) || running.contains_key(&it.name) {
                    true => State::Recording,
                    false => State::Finished,
                },
                name: it.name,
                bytes: it.bytes,
            });
            Ok(Listing {
                recordings: recordings.collect(),
            })
        })
        .await
    }

    /// Reads a part of a finished recording. Returns less at its end.
    pub(super) async fn read(
        self: &Arc<Self>,
        name: RecordingName,
        offset: u64,
        length: usize,
    ) -> Result<Vec<u8>, RecordingsError> {
        let this = Arc::clone(self);
        blocking(move || {
            let file = this.finished(&name)?;
            let mut piece = vec![0; length];
            let mut filled = 0;
            while let Some(rest @ [_, ..]) = piece.get_mut(filled..) {
                match file.read_at(rest, offset.saturating_add(filled as u64)) {
                    Ok(0) => break,
                    Ok(read) => filled += read,
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(error) => return Err(error.into()),
                }
            }
            piece.truncate(filled);
            Ok(piece)
        })
        .await
    }

    /// Returns the SHA-256 of a finished recording.
    pub(super) async fn digest(
        self: &Arc<Self>,
        name: RecordingName,
    ) -> Result<String, RecordingsError> {
        let this = Arc::clone(self);
        blocking(move || Ok(sha256(this.finished(&name)?)?)).await
    }

    fn finished(&self, name: &RecordingName) -> Result<File, RecordingsError> {
        match self.running.lock().contains_key(name) {
            true => Err(RecordingsError::Unfinished(name.clone())),
            false => self.open_file(name),
        }
    }

    fn open_file(&self, name: &RecordingName) -> Result<File, RecordingsError> {
        let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
        let flags = i32::try_from(flags.bits()).unwrap_or_default();
        let opened = OpenOptions::new()
            .read(true)
            .custom_flags(flags)
            .open(self.path(name));
        match opened {
            Ok(file) if file.metadata()?.is_file() => Ok(file),
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error.into()),
            _ => Err(RecordingsError::Unknown(name.clone())),
        }
    }

    /// The files of the directory that are recordings.
    fn stored(&self) -> io::Result<Vec<Stored>> {
        let mut all = Vec::new();
        for entry in fs::read_dir(&self.directory)? {
            let path = entry?.path();
            let is_recording = path.extension().is_some_and(|it| it == EXTENSION);
            let name = path.file_stem().and_then(|it| it.to_str());
            let name = name.and_then(|it| it.parse().ok());
            let Some(name) = name.filter(|_| is_recording) else {
                continue;
            };
            // A file that was deleted since is none.
            if let Ok(about) = path.symlink_metadata()
                && about.is_file()
            {
                all.push(Stored {
                    name,
                    bytes: about.len(),
                    modified: about.modified().unwrap_or(SystemTime::UNIX_EPOCH),
                    path,
                });
            }
        }
        Ok(all)
    }

    /// Deletes the oldest recordings until all of them have at most their maximum size. If only running ones are left,
    /// the largest ends.
    fn make_room(&self) -> io::Result<()> {
        let mut stored = self.stored()?;
        stored.sort_by_key(|it| it.modified);
        let mut bytes: u64 = stored.iter().map(|it| it.bytes).sum();
        let mut running = self.running.lock();
        for old in &stored {
            if bytes <= self.bytes {
                return Ok(());
            }
            if !running.contains_key(&old.name) {
                fs::remove_file(&old.path)?;
                bytes -= old.bytes;
                log_limit::warn!(
                    recording = %old.name,
                    "the oldest recording was deleted, because all of them have more than record.bytes"
                );
            }
        }
        let ending = stored.iter().filter(|it| running.contains_key(&it.name));
        if bytes > self.bytes
            && let Some(largest) = ending.max_by_key(|it| it.bytes)
            && let Some(recording) = running.get_mut(&largest.name)
            && recording.notes.take().is_some()
        {
            log_limit::warn!(
                recording = %largest.name,
                "the recording ends, because the running ones have more than record.bytes"
            );
        }
        Ok(())
    }

    /// Makes room while recordings run. Does not return.
    pub(super) async fn keep_room(self: Arc<Self>) {
        let mut seconds = tokio::time::interval(Duration::from_secs(1));
        seconds.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            seconds.tick().await;
            if self.running.lock().is_empty() {
                continue;
            }
            let this = Arc::clone(&self);
            if let Err(error) = blocking(move || Ok(this.make_room()?)).await {
                log_limit::warn!(error = %escape(&error.to_string()), "cannot limit the recordings");
            }
        }
    }

    /// Ends all recordings, and waits for their end.
    pub(super) async fn close(&self) {
        let all: Vec<RecordingName> = self.running.lock().keys().cloned().collect();
        let ended: Vec<_> = all.iter().filter_map(|name| self.end(name)).collect();
        for mut ended in ended {
            // `attend` kills a process that does not end.
            let _ = ended.wait_for(|ended| *ended).await;
        }
    }
}

/// A recording whose process was started.
struct Begun {
    output: tokio::io::Lines<BufReader<tokio::process::ChildStdout>>,
    ended: watch::Receiver<bool>,
}

/// Passes metadata on to the process of a recording, until the process ends or is to end. Returns its status.
async fn attend(
    mut child: Child,
    mut input: ChildStdin,
    mut notes: mpsc::Receiver<Note>,
) -> io::Result<ExitStatus> {
    loop {
        let note = tokio::select! {
            ended = child.wait() => return ended,
            note = notes.recv() => note,
        };
        let Some(note) = note else {
            break;
        };
        let line = note.to_line()?;
        // Fails if the process has ended.
        let _ = input.write_all(&line).await;
    }
    drop(input);
    match timeout(END_WITHIN, child.wait()).await {
        Ok(ended) => ended,
        Err(_) => {
            child.start_kill()?;
            child.wait().await
        }
    }
}

fn report(name: &RecordingName, ended: &io::Result<ExitStatus>) {
    match ended {
        Ok(status) if status.success() => {
            log_limit::info!(recording = %name, "the recording has ended");
        }
        Ok(status) => log_limit::warn!(recording = %name, "the recording has failed: {status}"),
        Err(error) => log_limit::warn!(recording = %name, %error, "the recording is lost"),
    }
}

/// Reads the errors of a process to their end. Keeps the last of them.
async fn last_errors(mut errors: ChildStderr) -> String {
    let mut last = Vec::new();
    let mut part = [0; 1024];
    while let Ok(read @ 1..) = errors.read(&mut part).await {
        last.extend(part.iter().take(read));
        last.drain(..last.len().saturating_sub(MAX_ERRORS));
    }
    String::from_utf8_lossy(&last).into_owned()
}

/// Returns the SHA-256 of a file from its current position to its end, in hexadecimal digits.
pub(super) fn sha256(mut file: impl Read) -> io::Result<String> {
    let mut digest = Context::new(&SHA256);
    let mut part = vec![0; 256 << 10];
    loop {
        match file.read(&mut part) {
            Ok(0) => break,
            Ok(read) => digest.update(part.get(..read).unwrap_or_default()),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    let digest = digest.finish();
    Ok(digest
        .as_ref()
        .iter()
        .map(|it| format!("{it:02x}"))
        .collect())
}

/// Runs work on files on a thread for blocking calls.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, RecordingsError> + Send + 'static,
) -> Result<T, RecordingsError> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|error| RecordingsError::Io(io::Error::other(error)))?
}
