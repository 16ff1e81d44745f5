//! Writes log lines, warnings and errors to standard error. A command that draws on the whole terminal holds them
//! back: they would appear within its screen.

use std::io::{self, IsTerminal as _, Write};

use std::sync::{Mutex, PoisonError};

/// Maximum number of bytes that are held back; later ones are dropped.
const MAX_HELD: usize = 64 << 10;

static HELD: Mutex<Option<Vec<u8>>> = Mutex::new(None);

/// Standard error, or the texts that are held back.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LogOutput;

impl Write for LogOutput {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut held = HELD.lock().unwrap_or_else(PoisonError::into_inner);
        match &mut *held {
            Some(held) => {
                hold(held, bytes);
                Ok(bytes.len())
            }
            None => io::stderr().write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

/// Keeps whole writes only, which are whole lines.
fn hold(held: &mut Vec<u8>, bytes: &[u8]) {
    if held.len().saturating_add(bytes.len()) <= MAX_HELD {
        held.extend_from_slice(bytes);
    }
}

/// Holds texts for standard error back, if that is a terminal. Dropping it prints them.
#[derive(Debug)]
pub(crate) struct HeldLog(());

impl HeldLog {
    /// Begins to hold texts back.
    pub(crate) fn begin() -> Self {
        if io::stderr().is_terminal() {
            *HELD.lock().unwrap_or_else(PoisonError::into_inner) = Some(Vec::new());
        }
        Self(())
    }
}

impl Drop for HeldLog {
    fn drop(&mut self) {
        let held = HELD.lock().unwrap_or_else(PoisonError::into_inner).take();
        // There is no other place to report an error.
        let _ = io::stderr().write_all(&held.unwrap_or_default());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_texts_are_bounded() {
        let mut held = Vec::new();
        hold(&mut held, b"first\n");
        for _ in 0..10 {
            hold(&mut held, &[b'x'; MAX_HELD / 4]);
        }
        hold(&mut held, b"last\n");
        assert!(held.len() <= MAX_HELD, "{}", held.len());
        assert!(held.starts_with(b"first\n") && held.ends_with(b"last\n"));
    }
}
