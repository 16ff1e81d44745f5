//! The log lines of the library, for the module `logging` of Python.
//!
//! No thread of the library calls Python. A thread of Python, which [`follow`] keeps, waits for lines and logs them; a
//! call of the program logs those that wait, too.

use std::collections::VecDeque;
use std::fmt::{self, Write as _};
use std::mem::take;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::time::{Duration, Instant};

use fipa_acl::{escape, is_unprintable};
use parking_lot::Mutex;
use pyo3::types::PyAnyMethods as _;
use pyo3::{PyResult, Python, pyfunction};
use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

use crate::interpreter::{LOG_OR_END, away, call, is_ending};

/// Maximum number of lines that wait. The oldest are dropped.
const MAX_LINES: usize = 256;

/// Maximum time for which the end of a domain waits for lines that another thread logs.
const MAX_WAIT: Duration = Duration::from_secs(1);

static WAITING: Mutex<Lines> = Mutex::new(Lines {
    lines: VecDeque::new(),
    missed: 0,
    is_given: false,
});

/// Whether lines wait, for a check without the lock.
static HAS_LINES: AtomicBool = AtomicBool::new(false);

/// The level of Python's logger in tens: 1 for `DEBUG`, 4 for `ERROR`.
static LEVEL: AtomicU8 = AtomicU8::new(3);

struct Lines {
    lines: VecDeque<Line>,
    /// Number of the lines that were dropped.
    missed: u64,
    /// Whether a thread logs lines. Others leave theirs to it, so that the order stays, and so does a handler of
    /// `logging` that calls the library.
    is_given: bool,
}

/// Level of Python, name of the logger, text.
type Line = (u8, String, String);

/// Takes the level of Python's logger, and collects lines from then on.
pub(crate) fn collect(py: Python<'_>) -> PyResult<()> {
    let level: i64 = call(py, "fipa._log", "start", ())?.extract()?;
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
        if waiting.is_given {
            return Ok(());
        }
        HAS_LINES.store(false, Ordering::Relaxed);
        waiting.is_given = true;
        (take(&mut waiting.lines), take(&mut waiting.missed))
    };
    let logged = call(py, "fipa._log", "emit", (Vec::from(lines), missed));
    WAITING.lock().is_given = false;
    LOG_OR_END.notify_all();
    logged.map(drop)
}

/// Gives the lines that wait to Python, and waits for those that another thread logs.
pub(crate) fn deliver_all(py: Python<'_>) -> PyResult<()> {
    away(py, || {
        let due = Instant::now() + MAX_WAIT;
        let mut waiting = WAITING.lock();
        while waiting.is_given && !LOG_OR_END.wait_until(&mut waiting, due).timed_out() {}
    });
    deliver(py)
}

/// Logs the lines at once, until the interpreter ends: the work of a thread of Python.
#[pyfunction]
#[pyo3(name = "_follow_log")]
pub(crate) fn follow(py: Python<'_>) {
    loop {
        away(py, || {
            let mut waiting = WAITING.lock();
            while (waiting.lines.is_empty() || waiting.is_given) && !is_ending() {
                LOG_OR_END.wait(&mut waiting);
            }
        });
        if is_ending() {
            return;
        }
        if let Err(error) = deliver(py) {
            error.write_unraisable(py, None);
        }
    }
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
        drop(waiting);
        LOG_OR_END.notify_all();
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
