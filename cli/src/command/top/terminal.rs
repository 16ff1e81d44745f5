//! The terminal: its screen, its keys, and its state before the command.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use ratatui::crossterm::event::{self, Event};
use ratatui::{DefaultTerminal, Frame};
use tokio::sync::mpsc;

use crate::log_output::HeldLog;

/// Interval in which the thread that reads keys checks whether the screen is closed.
const CHECK: Duration = Duration::from_millis(100);
/// Maximum number of keys that wait.
const MAX_KEYS: usize = 64;

/// The alternate screen of the terminal, in raw mode. Dropping it restores the terminal; so does a panic.
pub(super) struct Screen {
    /// Always there until the screen is dropped.
    terminal: Option<DefaultTerminal>,
    closed: Arc<AtomicBool>,
    // Dropped after the terminal is restored.
    _held: HeldLog,
}

impl Screen {
    /// Takes the terminal. Also returns its keys and changes of its size.
    pub(super) fn open() -> io::Result<(Self, mpsc::Receiver<Event>)> {
        let held = HeldLog::begin();
        let terminal = ratatui::try_init().inspect_err(|_| drop(ratatui::try_restore()))?;
        let closed = Arc::new(AtomicBool::new(false));
        let screen = Self {
            terminal: Some(terminal),
            closed: Arc::clone(&closed),
            _held: held,
        };
        let (sender, keys) = mpsc::channel(MAX_KEYS);
        std::thread::Builder::new()
            .name("fipa-keys".to_owned())
            .spawn(move || read(&sender, &closed))?;
        Ok((screen, keys))
    }

    /// Draws the whole screen.
    pub(super) fn draw(&mut self, draw: impl FnOnce(&mut Frame<'_>)) -> io::Result<()> {
        match &mut self.terminal {
            Some(terminal) => terminal.draw(draw).map(drop),
            None => Ok(()),
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.closed.store(true, Ordering::Relaxed);
        // A closed terminal cannot be restored.
        drop(ratatui::try_restore());
        if let Some(mut terminal) = self.terminal.take()
            && terminal.show_cursor().is_err()
        {
            // It would print the error when it is dropped, which panics if standard error is this terminal.
            std::mem::forget(terminal);
        }
    }
}

/// Reads until the screen or the terminal is closed.
fn read(sender: &mpsc::Sender<Event>, closed: &AtomicBool) {
    while !closed.load(Ordering::Relaxed) {
        let event = match event::poll(CHECK) {
            Ok(false) => continue,
            Ok(true) => event::read(),
            Err(error) => Err(error),
        };
        // An error means that the terminal is closed.
        if !event.is_ok_and(|event| sender.blocking_send(event).is_ok()) {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::process::Stdio;

    use super::*;

    const NAME: &str = "command::top::terminal::tests::panics_on_a_screen";

    #[test]
    fn a_panic_restores_the_terminal() {
        let program = std::env::current_exe().unwrap();
        let line = format!(
            "exec {} --exact {NAME} --ignored --nocapture",
            program.display()
        );
        let name = "a_panic_restores_the_terminal";
        let Some(mut script) = fipa_testbed::on_terminal(name, &line) else {
            return;
        };
        let output = script.stdin(Stdio::null()).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(!output.status.success(), "{text}");
        let [entered, left, message] = ["\x1b[?1049h", "\x1b[?1049l", "a fault of the command"]
            .map(|part| {
                text.find(part)
                    .unwrap_or_else(|| panic!("{part:?} in {text:?}"))
            });
        assert!(entered < left && left < message, "{text:?}");
    }

    #[test]
    #[ignore = "a part of a_panic_restores_the_terminal"]
    fn panics_on_a_screen() {
        let _screen = Screen::open().unwrap();
        panic!("a fault of the command");
    }
}
