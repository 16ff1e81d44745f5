//! `fipa record fleet fetch`: copies the recordings of other hosts to this one.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use fipa::error::ErrorChain;
use fipa_acl::escape;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};

use super::order::{Digest, MAX_PIECE, Order, Recording, RecordingName, State};
use super::recordings::sha256;
use super::{AskError, Done, Recorder};

/// Length of the first piece, and the minimum length, in bytes.
const MIN_PIECE: u32 = 16 << 10;
/// Time of a piece below which the next one is longer.
const FAST: Duration = Duration::from_millis(250);
/// Time of a piece above which the next one is shorter.
const SLOW: Duration = Duration::from_secs(1);
/// Maximum wait for a piece.
const PIECE_WITHIN: Duration = Duration::from_secs(20);
/// Maximum wait for the SHA-256 of a file.
const DIGEST_WITHIN: Duration = Duration::from_secs(600);

/// Characters of a host that the name of a file has as they are.
const PLAIN: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'_');

/// The directory of the copies, and the display of the progress.
#[derive(Debug, Clone)]
pub(super) struct Destination {
    directory: PathBuf,
    progress: MultiProgress,
}

impl Destination {
    pub(super) fn new(directory: &Path) -> Self {
        Self {
            directory: directory.to_owned(),
            progress: MultiProgress::new(),
        }
    }

    fn bar(&self, host: &str, bytes: u64) -> ProgressBar {
        let bar = ProgressBar::new(bytes);
        if let Ok(style) = ProgressStyle::with_template("{msg} {bytes}/{total_bytes} {eta}") {
            bar.set_style(style);
        }
        bar.set_message(escape(host).into_owned());
        self.progress.add(bar)
    }
}

/// Error of [`fetch`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(super) enum FetchError {
    /// The recorder does not answer as expected.
    #[error(transparent)]
    Ask(#[from] AskError),
    /// The host has no such recording.
    #[error("there is no recording {0} on this host")]
    Unknown(RecordingName),
    /// The recording is not finished.
    #[error("the recording {0} is not finished; stop it first")]
    Unfinished(RecordingName),
    /// The recording became shorter.
    #[error("the recording ended before its length; fetch it again")]
    Short,
    /// The copy differs from the recording.
    #[error("the copy differed from the recording, and was deleted; fetch it again")]
    Differs,
    /// Another file has the name of the copy.
    #[error("{} exists and differs from the recording; remove it, or give another directory", escape(.0))]
    Exists(String),
    /// Another process writes the copy.
    #[error("another process fetches the recording to {}", escape(.0))]
    Locked(String),
    /// The copy cannot be written.
    #[error("cannot write {}: {error}", escape(path))]
    Io {
        /// The file.
        path: String,
        /// The reason.
        #[source]
        error: io::Error,
    },
}

impl FetchError {
    /// The reason, without the message around it if a recorder gave it.
    pub(super) fn reason(&self) -> String {
        match self {
            Self::Ask(error) => error.reason(),
            other => ErrorChain(other).to_string(),
        }
    }
}

/// Copies a recording of a host, and continues an incomplete copy.
pub(super) async fn fetch(
    recorder: &Recorder,
    name: &RecordingName,
    to: &Destination,
) -> Result<Done, FetchError> {
    let recordings = recorder.list().await?;
    let recording = recordings.into_iter().find(|it| it.name == *name);
    let recording = recording.ok_or_else(|| FetchError::Unknown(name.clone()))?;
    if recording.state == State::Recording {
        return Err(FetchError::Unfinished(name.clone()));
    }
    let host = utf8_percent_encode(&recorder.host, PLAIN);
    let path = to.directory.join(format!("{name}.{host}.mcap"));
    let digest = async || -> Result<String, FetchError> {
        let order = Order::Digest { name: name.clone() };
        let digest: Digest = recorder.ask_json(&order, DIGEST_WITHIN).await?;
        Ok(digest.sha256)
    };
    if path.exists() {
        let known = digest_of(&path).await?;
        return match known == digest().await? {
            true => Ok(done(recording, path)),
            false => Err(FetchError::Exists(shown(&path))),
        };
    }
    let part = part_of(&path);
    let unwritable = |error| unwritable(&part, error);
    fs::create_dir_all(&to.directory).map_err(|error| self::unwritable(&to.directory, error))?;
    let mut file = open(&part)?;
    let mut offset = file.metadata().map_err(unwritable)?.len();
    if offset > recording.bytes {
        file.set_len(0).map_err(unwritable)?;
        offset = 0;
    }
    file.seek(SeekFrom::Start(offset)).map_err(unwritable)?;
    let bar = to.bar(&recorder.host, recording.bytes);
    let mut length = MIN_PIECE;
    while offset < recording.bytes {
        bar.set_position(offset);
        let order = Order::Read {
            name: name.clone(),
            offset,
            length,
        };
        let began = Instant::now();
        let piece = recorder.ask(&order, PIECE_WITHIN).await?;
        let room = usize::try_from(recording.bytes - offset).unwrap_or(usize::MAX);
        if piece.is_empty() || piece.len() > room {
            return Err(FetchError::Short);
        }
        file.write_all(&piece).map_err(unwritable)?;
        offset += piece.len() as u64;
        length = match began.elapsed() {
            time if time < FAST => (length * 2).min(MAX_PIECE),
            time if time > SLOW => (length / 2).max(MIN_PIECE),
            _ => length,
        };
    }
    bar.finish_and_clear();
    file.sync_all().map_err(unwritable)?;
    if digest_of(&part).await? != digest().await? {
        fs::remove_file(&part).map_err(unwritable)?;
        return Err(FetchError::Differs);
    }
    fs::rename(&part, &path).map_err(unwritable)?;
    Ok(done(recording, path))
}

fn done(recording: Recording, path: PathBuf) -> Done {
    Done {
        recording,
        file: Some(path),
    }
}

/// The name of a copy that is not complete.
fn part_of(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".part");
    name.into()
}

/// Opens a copy, which no other process writes at the same time.
fn open(part: &Path) -> Result<File, FetchError> {
    let opened = OpenOptions::new()
        .create(true)
        .truncate(false)
        .write(true)
        .open(part);
    let file = opened.map_err(|error| unwritable(part, error))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(FetchError::Locked(shown(part))),
        Err(TryLockError::Error(error)) => Err(unwritable(part, error)),
    }
}

async fn digest_of(path: &Path) -> Result<String, FetchError> {
    let of = path.to_owned();
    let digest = tokio::task::spawn_blocking(move || sha256(File::open(of)?)).await;
    let digest = digest.map_err(io::Error::other).flatten();
    digest.map_err(|error| unwritable(path, error))
}

fn unwritable(path: &Path, error: io::Error) -> FetchError {
    FetchError::Io {
        path: shown(path),
        error,
    }
}

fn shown(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}
