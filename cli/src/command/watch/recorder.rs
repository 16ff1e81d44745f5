//! Writes the observed letters to a file: see [`fipa::monitor::recording`] for its format.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use fipa_monitor::recording::{self, Recorded};

use super::checker::Letter;
use crate::input;
use crate::report::{self, Failure};

/// Bytes that are collected before they are written.
const BUFFERED: usize = 64 * 1024;

/// A recording that is being written.
pub(super) struct Recorder {
    path: PathBuf,
    file: File,
    buffer: Vec<u8>,
    /// Whether letters before the next one are missing.
    after_loss: bool,
}

impl Recorder {
    /// Creates a file, or replaces it.
    pub(super) fn create(path: &Path) -> Result<Self, Failure> {
        let file = File::create(path).map_err(|error| failed(path, &error))?;
        let mut buffer = Vec::with_capacity(BUFFERED);
        recording::begin(&mut buffer);
        let mut recorder = Self {
            path: path.to_owned(),
            file,
            buffer,
            after_loss: false,
        };
        recorder.flush()?;
        Ok(recorder)
    }

    /// Notes that letters are missing.
    pub(super) fn lose(&mut self) {
        self.after_loss = true;
    }

    /// Adds a letter.
    pub(super) fn add(&mut self, letter: &Letter<'_>) -> Result<(), Failure> {
        let recorded = Recorded {
            at: letter.at,
            answer_within: letter.answer_within,
            receiver: letter.receiver.to_owned(),
            undelivered: letter.undelivered,
            from_service: letter.from_service,
            may_continue: letter.may_continue,
            after_loss: std::mem::take(&mut self.after_loss),
            message: letter.message.cloned(),
        };
        if let Err(error) = recording::append(&recorded, &mut self.buffer) {
            report::warn(&format!("a letter is not recorded: {error}"));
            self.after_loss = true;
        }
        match self.buffer.len() >= BUFFERED {
            true => self.flush(),
            false => Ok(()),
        }
    }

    /// Writes the letters so far.
    pub(super) fn flush(&mut self) -> Result<(), Failure> {
        let written = self.file.write_all(&self.buffer);
        self.buffer.clear();
        written.map_err(|error| failed(&self.path, &error))
    }
}

fn failed(path: &Path, error: &std::io::Error) -> Failure {
    Failure::failed(
        format!("cannot write the recording: {error}"),
        input::name(path),
        "give a file that this user can write",
    )
}
