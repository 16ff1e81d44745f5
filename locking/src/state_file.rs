//! The content of an owner's state file.

use std::fmt;
use std::str::FromStr;

use crate::Millis;

/// Time in which an owner without memory grants nothing, if its lease is not longer.
const MIN_SILENCE: Millis = 15_000;

/// State of an owner that has to survive its restarts.
///
/// A start reads the file, computes [`next_life`](Self::next_life) with
/// [`with_run`](Self::with_run) and [`with_clock`](Self::with_clock), and writes and syncs that before it
/// calls [`Locks::own`](crate::Locks::own). Without a file it begins with
/// [`without_memory`](Self::without_memory), and writes the file when
/// [`needs_report`](Self::needs_report) is false. After an [`Event::Raised`](crate::Event::Raised) it writes
/// [`raised`](Self::raised), and after [`Locks::disown`](crate::Locks::disown) it writes
/// [`closed`](Self::closed) if no grant was live.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct OwnerState {
    epoch: u64,
    lease: Millis,
    silence: Millis,
    /// Epoch of the last life of which this state knows.
    previous_epoch: u64,
    run: u64,
    /// Time after the start in which grants of a life elsewhere may be live.
    absence: Millis,
    needs_report: bool,
}

impl OwnerState {
    const HEAD: &str = "fipa-locking owner 1";

    /// State of an owner that has had no life before, and whose fences no device has seen.
    #[must_use]
    pub fn first() -> Self {
        Self {
            epoch: 0,
            lease: 0,
            silence: 0,
            previous_epoch: 0,
            run: 0,
            absence: 0,
            needs_report: false,
        }
    }

    /// State of a life without a file, whose leases are at most `lease`. Those of earlier lives should not
    /// have been longer: the owner is silent for `lease`, and for at least 15 s.
    ///
    /// The life has an epoch from the clock ([`with_clock`](Self::with_clock)), or from the reports of the
    /// agents and devices that have seen fences of earlier lives.
    #[must_use]
    pub fn without_memory(lease: Millis) -> Self {
        Self {
            // A crash during the silence leaves grants of lives before that may still be live.
            lease: lease.max(MIN_SILENCE),
            silence: lease.max(MIN_SILENCE),
            absence: lease.max(MIN_SILENCE),
            needs_report: true,
            ..Self::first()
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
            previous_epoch: self.epoch,
            run: 0,
            absence: lease.max(MIN_SILENCE),
            needs_report: false,
        }
    }

    /// Sets the random bits of this life. Each life needs others.
    #[must_use]
    pub fn with_run(self, run: u64) -> Self {
        Self { run, ..self }
    }

    /// Raises the epoch to the time of day in seconds since 1970. `None` if the clock was not set.
    #[must_use]
    pub fn with_clock(self, seconds: Option<u64>) -> Self {
        match seconds {
            Some(seconds) => Self {
                epoch: self.epoch.max(seconds),
                needs_report: false,
                ..self
            },
            None => self,
        }
    }

    /// State of this life after an [`Event::Raised`](crate::Event::Raised).
    #[must_use]
    pub fn raised(self, epoch: u64) -> Self {
        Self {
            epoch: self.epoch.max(epoch),
            needs_report: false,
            ..self
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

    /// Random bits of this life.
    #[must_use]
    pub fn run(&self) -> u64 {
        self.run
    }

    /// Time after the start in which grants of earlier lives may be live: the longest lease of these
    /// lives, or 0.
    #[must_use]
    pub fn silence(&self) -> Millis {
        self.silence
    }

    /// Whether neither a file nor a clock says which epoch is higher than those of earlier lives. The owner
    /// then grants only after an agent or a device has told it of a fence.
    #[must_use]
    pub fn needs_report(&self) -> bool {
        self.needs_report
    }

    /// Epoch of the last life of which this state knows.
    pub(crate) fn previous_epoch(&self) -> u64 {
        self.previous_epoch
    }

    /// Time after the start in which grants of a life elsewhere may be live.
    pub(crate) fn absence(&self) -> Millis {
        self.absence
    }

    /// Replaces the minimum of the silence, for tests with short leases.
    #[cfg(test)]
    pub(crate) fn with_absence(self, absence: Millis) -> Self {
        match self.needs_report {
            true => Self {
                silence: absence,
                lease: absence,
                absence,
                ..self
            },
            false => Self { absence, ..self },
        }
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
        "line {0} of the owner's state file is not valid; restore the file or remove it, and the owner \
         starts without memory"
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
            ..Self::first()
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
    fn an_epoch_is_above_the_file_and_the_clock() {
        let file = stored(OwnerState::first().next_life(100));
        let life = |clock| stored(file).next_life(100).with_clock(clock);
        assert_eq!(life(None).epoch(), 2);
        assert_eq!(life(Some(1)).epoch(), 2);
        assert_eq!(life(Some(1_800_000_000)).epoch(), 1_800_000_000);
        let raised = stored(life(None).raised(7));
        assert_eq!(raised.next_life(100).epoch(), 8);
    }

    #[test]
    fn a_life_without_memory_is_silent_and_needs_a_clock_or_a_report() {
        let life = OwnerState::without_memory(100);
        assert_eq!((life.silence(), life.needs_report()), (15_000, true));
        assert_eq!(OwnerState::without_memory(20_000).silence(), 20_000);
        assert!(!life.raised(7).needs_report());
        let life = life.with_clock(Some(1_800_000_000));
        assert!(!life.needs_report());
        // A crash during the silence.
        let next = stored(life).next_life(100).with_clock(None);
        assert_eq!((next.epoch(), next.silence()), (1_800_000_001, 15_000));
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
