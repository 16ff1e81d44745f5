//! The log lines of the library, for the module `logging` of Python.
//!
//! No thread of the library calls Python: the lines wait until the program makes its next call.

use std::collections::VecDeque;
use std::fmt::{self, Write as _};
use std::mem::take;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

use fipa_acl::{escape, is_unprintable};
use parking_lot::Mutex;
use pyo3::types::PyAnyMethods as _;
use pyo3::{PyResult, Python};
use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

use crate::interpreter::call;

/// Maximum number of lines that wait. The oldest are dropped.
const MAX_LINES: usize = 256;

static WAITING: Mutex<Lines> = Mutex::new(Lines {
    lines: VecDeque::new(),
    missed: 0,
});

/// Whether lines wait, for a check without the lock.
static HAS_LINES: AtomicBool = AtomicBool::new(false);

/// The level of Python's logger in tens: 1 for `DEBUG`, 4 for `ERROR`.
static LEVEL: AtomicU8 = AtomicU8::new(3);

struct Lines {
    lines: VecDeque<Line>,
    /// Number of the lines that were dropped.
    missed: u64,
}

/// Level of Python, name of the logger, text.
type Line = (u8, String, String);

/// Takes the level of Python's logger, and collects lines from then on.
pub(crate) fn collect(py: Python<'_>) -> PyResult<()> {
    let level: i64 = call(py, "fipa._log", "level", ())?.extract()?;
    LEVEL.store((level / 10).clamp(0, 6) as u8, Ordering::Relaxed);
    // A program in Rust that embeds Python may have a collector already.
    let _ = tracing::subscriber::set_global_default(Collector);
    tracing::callsite::rebuild_interest_cache();
    Ok(())
}

/// Gives the lines that wait to Python.
pub(crate) fn deliver(py: Python<'_>) -> PyResult<()> {
    if !HAS_LINES.load(Ordering::Relaxed) {
        return Ok(());
    }
    let (lines, missed) = {
        let mut waiting = WAITING.lock();
        HAS_LINES.store(false, Ordering::Relaxed);
        (take(&mut waiting.lines), take(&mut waiting.missed))
    };
    call(py, "fipa._log", "emit", (Vec::from(lines), missed))?;
    Ok(())
}

/// Collects the events of all threads.
struct Collector;

impl Collector {
    fn filter() -> LevelFilter {
        match LEVEL.load(Ordering::Relaxed) {
            0 => LevelFilter::TRACE,
            1 => LevelFilter::DEBUG,
            2 => LevelFilter::INFO,
            3 => LevelFilter::WARN,
            4 | 5 => LevelFilter::ERROR,
            _ => LevelFilter::OFF,
        }
    }
}

impl Subscriber for Collector {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        *metadata.level() <= Self::filter()
    }

    fn max_level_hint(&self) -> Option<LevelFilter> {
        Some(Self::filter())
    }

    fn event(&self, event: &Event<'_>) {
        let metadata = event.metadata();
        let level = match *metadata.level() {
            Level::ERROR => 40,
            Level::WARN => 30,
            Level::INFO => 20,
            _ => 10,
        };
        let mut text = Text::default();
        event.record(&mut text);
        let line = (level, logger(metadata.target()), text.0);
        let mut waiting = WAITING.lock();
        if waiting.lines.len() == MAX_LINES {
            waiting.lines.pop_front();
            waiting.missed += 1;
        }
        waiting.lines.push_back(line);
        HAS_LINES.store(true, Ordering::Relaxed);
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// Returns the name of the logger for a module: `fipa.mts.core` for `fipa_mts::core`.
fn logger(target: &str) -> String {
    let own = target
        .strip_prefix("fipa_")
        .or(target.strip_prefix("fipa::"));
    format!("fipa.{}", own.unwrap_or(target).replace("::", "."))
}

/// The text of an event: its message, then its fields. A value can contain names and texts of peers.
#[derive(Default)]
struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        let mut text = format!("{value:?}");
        if text.contains(is_unprintable) {
            text = escape(&text).into_owned();
        }
        // Writing to a string cannot fail.
        let _ = match field.name() {
            "message" => {
                self.0.insert_str(0, &text);
                Ok(())
            }
            name => write!(self.0, " {name}={text}"),
        };
    }
}
