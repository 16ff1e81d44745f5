//! The signals that a command handles.

use std::io::{self, IsTerminal as _, Write as _};

use rustix::process::Signal;
use tokio::signal::unix::{self, SignalKind};

use crate::report::Failure;

/// SIGINT (Ctrl-C), SIGTERM (`kill`) and SIGHUP (a closed terminal, or a request to read the configuration again).
pub(crate) struct Signals {
    interrupt: unix::Signal,
    terminate: unix::Signal,
    hang_up: unix::Signal,
}

impl Signals {
    /// Starts listening. From now on the signals do not end the process by themselves.
    ///
    /// Must be called within a tokio runtime.
    pub(crate) fn listen() -> Result<Self, Failure> {
        let listen = |kind| {
            unix::signal(kind).map_err(|error: io::Error| {
                Failure::failed(
                    format!("cannot listen for signals: {error}"),
                    "this process",
                    "check the limit on open files: `ulimit -n`",
                )
            })
        };
        Ok(Self {
            interrupt: listen(SignalKind::interrupt())?,
            terminate: listen(SignalKind::terminate())?,
            hang_up: listen(SignalKind::hangup())?,
        })
    }

    /// Waits for the next signal.
    pub(crate) async fn next(&mut self) -> Signal {
        tokio::select! {
            _ = self.interrupt.recv() => {
                end_echoed_line();
                Signal::INT
            }
            _ = self.terminate.recv() => Signal::TERM,
            _ = self.hang_up.recv() => Signal::HUP,
        }
    }
}

/// Ends the line in which the terminal echoes `^C`, so that the next output begins on a line of its own.
fn end_echoed_line() {
    let mut stderr = io::stderr();
    if stderr.is_terminal() && io::stdin().is_terminal() {
        // There is no other place to report an error.
        let _ = stderr.write_all(b"\n");
    }
}
