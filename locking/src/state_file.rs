//! The content of an owner's state file.

use std::fmt;
use std::str::FromStr;

use crate::Millis;

/// State of an owner that has to survive its restarts.
///
/// A start reads the file (or takes [`first`](Self::first) if there is none), computes
/// [`next_life`](Self::next_life), and writes and syncs that before it calls
/// [`Locks::own`](crate::Locks::own). After [`Locks::disown`](crate::Locks::disown) it writes
/// [`closed`](Self::closed) if no grant was live.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct OwnerState {
    epoch: u64,
    lease: Millis,
    silence: Millis,
}

impl OwnerState {
    const HEAD: &str = "fipa-locking owner 1";

    /// State of an owner without a file: no life before.
    #[must_use]
    pub fn first() -> Self {
        Self {
            epoch: 0,
            lease: 0,
            silence: 0,
        }
    }

    /// State of a life without a file. `epoch` has to rise from life to life, as the time of day does.
    /// The owner is silent for `lease`, which has to be that of its earlier lives, too.
    #[must_use]
    pub fn volatile(epoch: u64, lease: Millis) -> Self {
        Self {
            epoch,
            lease,
            silence: lease,
        }
    }

    /// State of the owner's next life, whose leases are at most `lease`.
    #[must_use]
    pub fn next_life(self, lease: Millis) -> Self {
        Self {
            epoch: self.epoch.saturating_add(1),
            // A crash during the silence leaves grants of the life before that may still be live.
            lease: lease.max(self.lease),
            silence: self.lease,
        }
    }

    /// State after the end of a life, when no grant is live.
    #[must_use]
    pub fn closed(self) -> Self {
        Self {
            lease: 0,
            silence: 0,
            ..self
        }
    }

    /// Number of this life.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Time after the start in which grants of earlier lives may be live: the longest lease of these
    /// lives, or 0.
    #[must_use]
    pub fn silence(&self) -> Millis {
        self.silence
    }
}

impl fmt::Display for OwnerState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{}\nepoch {}\nlease {}",
            Self::HEAD,
            self.epoch,
            self.lease
        )
    }
}

/// Error of reading a state file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum OwnerStateError {
    /// The file is not a state file of this version, or it is incomplete.
    #[error(
        "line {0} of the owner's state file is not valid; restore the file, since fences have to rise"
    )]
    Line(usize),
}

impl FromStr for OwnerState {
    type Err = OwnerStateError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let mut lines = text.split_terminator('\n');
        if lines.next() != Some(Self::HEAD) {
            return Err(OwnerStateError::Line(1));
        }
        let mut number = |line, key: &str| {
            lines
                .next()
                .and_then(|text| text.strip_prefix(key)?.strip_prefix(' ')?.parse().ok())
                .ok_or(OwnerStateError::Line(line))
        };
        let state = Self {
            epoch: number(2, "epoch")?,
            lease: number(3, "lease")?,
            silence: 0,
        };
        match (lines.next(), text.ends_with('\n')) {
            (None, true) => Ok(state),
            _ => Err(OwnerStateError::Line(4)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stored(state: OwnerState) -> OwnerState {
        state.to_string().parse().unwrap()
    }

    #[test]
    fn a_life_is_silent_for_the_longest_lease_before_it() {
        let first = OwnerState::first().next_life(100);
        assert_eq!((first.epoch(), first.silence()), (1, 0));
        let second = stored(first).next_life(10);
        assert_eq!((second.epoch(), second.silence()), (2, 100));
        // The second life may have crashed while a grant of the first was live.
        let third = stored(second).next_life(10);
        assert_eq!((third.epoch(), third.silence()), (3, 100));
        let fourth = stored(third.closed()).next_life(10);
        assert_eq!((fourth.epoch(), fourth.silence()), (4, 0));
    }

    #[test]
    fn a_damaged_file_is_an_error() {
        let text = OwnerState::first().next_life(100).to_string();
        for end in 0..text.len() {
            assert!(text[..end].parse::<OwnerState>().is_err(), "{end}");
        }
        assert!(format!("{text}x\n").parse::<OwnerState>().is_err());
    }
}
