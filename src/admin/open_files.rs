//! The limit of open files of this process.
//!
//! A process needs some descriptors for each process that it exchanges letters with. The soft limit is 1,024 on most
//! systems, because `select` cannot handle more, and the hard limit is higher. The command `fipa` raises the soft limit.
//! Other programs may use `select`, so the library raises it only with `mts.raise_open_files`.

use std::io;
use std::sync::OnceLock;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// The highest limit that is set. Programs that close all possible descriptors take long with a higher one.
const HIGHEST: u64 = 65_536;

/// The soft limit before this process raised it.
static INHERITED: OnceLock<Option<u64>> = OnceLock::new();

/// Raises the soft limit of open files to the hard limit, at most to 65,536. A limit that is higher stays.
///
/// # Errors
/// Fails when the system refuses the limit.
pub fn raise() -> io::Result<()> {
    let limits = getrlimit(Resource::Nofile);
    let raised = raised(&limits);
    INHERITED.get_or_init(|| limits.current);
    if raised == limits.current {
        return Ok(());
    }
    set(raised)
}

/// Calls a function that starts another program, with the soft limit that this process had before it [raised](raise)
/// that. The program inherits the limit.
///
/// # Errors
/// Fails when the system refuses the limit.
pub fn with_inherited<T>(start: impl FnOnce() -> T) -> io::Result<T> {
    let raised = getrlimit(Resource::Nofile).current;
    let inherited = inherited();
    if raised == inherited {
        return Ok(start());
    }
    set(inherited)?;
    let started = start();
    // Without this, the process has the limit that it had before.
    let _ = set(raised);
    Ok(started)
}

/// Returns the soft limit before this process raised it. `None` if there is no limit.
pub(crate) fn inherited() -> Option<u64> {
    let known = INHERITED.get().copied();
    known.unwrap_or_else(|| getrlimit(Resource::Nofile).current)
}

/// Returns the soft limit to set; `None` stands for no limit.
fn raised(limits: &Rlimit) -> Option<u64> {
    let most = limits.maximum.unwrap_or(HIGHEST).min(HIGHEST);
    limits.current.map(|current| current.max(most))
}

fn set(current: Option<u64>) -> io::Result<()> {
    let maximum = getrlimit(Resource::Nofile).maximum;
    setrlimit(Resource::Nofile, Rlimit { current, maximum }).map_err(Into::into)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_raised_to_the_hard_one_within_a_bound_and_never_lowered() {
        for (current, maximum, expected) in [
            (Some(1024), Some(4096), Some(4096)),
            (Some(1024), Some(1 << 30), Some(HIGHEST)),
            (Some(1024), None, Some(HIGHEST)),
            (Some(1 << 20), Some(1 << 30), Some(1 << 20)),
            (Some(64), Some(64), Some(64)),
            (None, None, None),
        ] {
            let raised = raised(&Rlimit { current, maximum });
            assert_eq!(raised, expected, "{current:?} {maximum:?}");
        }
    }
}
