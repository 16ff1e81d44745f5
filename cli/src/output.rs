//! Prints to standard output what was asked for.

use std::io::{self, Write};

use fipa::{Deliveries, Outcome};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use serde::Serialize;
use serde_json::{Value, json};
use tokio::sync::oneshot;

use crate::report::Failure;

/// Prints a text that ends its last line itself.
pub(crate) fn text(text: &str) -> Result<(), Failure> {
    bytes(text.as_bytes())
}

/// Prints bytes as they are.
pub(crate) fn bytes(bytes: &[u8]) -> Result<(), Failure> {
    bytes_if_read(bytes).map(drop)
}

/// Prints a text that ends its last line itself, and says whether anybody still reads: who prints
/// for as long as somebody does ends with the reader.
pub(crate) fn text_if_read(text: &str) -> Result<bool, Failure> {
    bytes_if_read(text.as_bytes())
}

/// Says when nobody will read what is printed any more, as after `| head`; never where that cannot
/// be known.
pub(crate) struct Reader(oneshot::Receiver<()>);

impl Reader {
    /// From now on.
    pub(crate) fn of_output() -> Self {
        let (gone, reader) = oneshot::channel();
        // It ends with the process: nothing but the reader's end ends the wait.
        std::thread::spawn(move || {
            let stdout = io::stdout();
            let mut watched = [PollFd::new(&stdout, PollFlags::empty())];
            while let Err(Errno::INTR) = poll(&mut watched, None) {}
            if watched[0].revents().contains(PollFlags::ERR) {
                // Who waited may have ended.
                let _ = gone.send(());
            }
        });
        Self(reader)
    }

    /// Returns then. Cancelling the future loses nothing.
    pub(crate) async fn gone(&mut self) {
        if (&mut self.0).await.is_err() {
            std::future::pending().await
        }
    }
}

fn bytes_if_read(bytes: &[u8]) -> Result<bool, Failure> {
    let mut stdout = io::stdout().lock();
    let written = stdout.write_all(bytes).and_then(|()| stdout.flush());
    match written {
        // Whoever reads has seen enough, as `head` does.
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(Failure::failed(
            format!("cannot write the output: {error}"),
            "standard output",
            "see whether the disk is full, or print to somewhere else",
        )),
        Ok(()) => Ok(true),
    }
}

/// Prints one JSON document.
pub(crate) fn json(value: &impl Serialize) -> Result<(), Failure> {
    document(serde_json::to_string_pretty(value))
}

/// Prints one JSON document on a line of its own.
pub(crate) fn json_line(value: &impl Serialize) -> Result<(), Failure> {
    document(serde_json::to_string(value))
}

fn document(document: serde_json::Result<String>) -> Result<(), Failure> {
    let document = document.map_err(|error| {
        Failure::failed(
            format!("the output cannot be written as JSON: {error}"),
            "standard output",
            "leave out --json",
        )
    })?;
    text(&format!("{document}\n"))
}

/// What became of a message, one object per receiver: `receiver`, `outcome`, `via` or `reason`,
/// and the `attempts` that did not work.
pub(crate) fn deliveries(deliveries: &Deliveries) -> Value {
    let one = |delivery: &fipa::Delivery| {
        let attempts = delivery.outcome.attempts().iter().map(|attempt| {
            json!({
                "via": attempt.via.name(),
                "location": attempt.location.to_string(),
                "error": attempt.error.to_string(),
            })
        });
        let attempts: Vec<Value> = attempts.collect();
        let receiver = &delivery.receiver;
        match &delivery.outcome {
            Outcome::Delivered { via, .. } => json!({
                "receiver": receiver, "outcome": "delivered", "via": via.name(), "attempts": attempts,
            }),
            Outcome::Sent { via, .. } => json!({
                "receiver": receiver, "outcome": "sent", "via": via.name(), "attempts": attempts,
            }),
            other => {
                let reason = match other {
                    Outcome::Failed { reason, .. } => reason.to_string(),
                    unknown => unknown.to_string(),
                };
                json!({
                    "receiver": receiver, "outcome": "failed", "reason": reason, "attempts": attempts,
                })
            }
        }
    };
    deliveries.0.iter().map(one).collect()
}
