//! The limits of the log lines of this project. Other hosts cause many of the lines, so without a limit they
//! could fill the disk of a robot.
//!
//! [`error!`], [`warn!`] and [`info!`] take what the macros of `tracing` take. Before the fields, `of: KEY` names
//! the cause of the line, for example the address of a peer: each cause has a limit of its own, so one loud peer
//! does not hide the lines about another. A key that a peer can choose freely, such as a name, does no harm, because
//! the limit of the line holds for all keys together. A line that is left out is counted. The next line of the same
//! kind has the number in its field `omitted`; [`report_omitted`] logs the numbers without a next line.
//!
//! `clippy.toml` forbids the macros of `tracing` for these levels. Lines for debugging have no limit.
//!
//! A message, and a value that is written with `%` or `?`, is [cut](Cut) after 2,048 bytes. Other values are numbers
//! and names.
//!
//! [`LogLimit`] does no I/O. The macros read the clock of the system, also in code that takes `now` as an argument,
//! because a log grows in real time.

use std::collections::HashMap;
use std::fmt::{self, Display, Formatter, Write};
use std::hash::{BuildHasher, Hash, RandomState};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use tracing::Level;

use crate::token_bucket::TokenBucket;

pub use crate::{__log_error as error, __log_info as info, __log_warn as warn};
#[doc(hidden)]
pub use tracing;

/// Maximum number of lines of one kind that follow each other at once.
const LINES: f64 = 20.0;
/// Maximum number of lines of one kind per second afterwards.
const LINES_PER_SECOND: f64 = 1.0;
/// Maximum number of lines of one kind and one key that follow each other at once.
const LINES_OF_KEY: f64 = 5.0;
/// Maximum number of lines of one kind and one key per second afterwards.
const LINES_OF_KEY_PER_SECOND: f64 = 0.1;
/// Time after which the token bucket of a key is full again, so that the key can be removed.
const MEMORY: Duration = Duration::from_secs(50);
/// Maximum number of keys of one kind. Only admitted lines add keys, which are fewer within [`MEMORY`].
const MAX_KEYS: usize = 128;

/// Maximum length of a value in a log line, in bytes. Peers can cause values of any length.
const MAX_VALUE: usize = 2_048;

/// A value of a log line, of which at most 2,048 bytes are displayed, with the length of the whole value.
#[derive(Debug, Clone, Copy)]
pub struct Cut<T>(pub T);

impl<T: Display> Display for Cut<T> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let mut writer = CutWriter { to: f, len: 0 };
        write!(writer, "{}", self.0)?;
        match writer.len {
            0..=MAX_VALUE => Ok(()),
            len => write!(f, "... ({len} bytes)"),
        }
    }
}

/// Passes on the first bytes and counts all.
struct CutWriter<'a, 'b> {
    to: &'a mut Formatter<'b>,
    len: usize,
}

impl Write for CutWriter<'_, '_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let room = MAX_VALUE.saturating_sub(self.len);
        self.len = self.len.saturating_add(text.len());
        if text.len() <= room {
            return self.to.write_str(text);
        }
        // Nothing follows a part that was cut.
        self.to.write_str(
            text.get(..text.floor_char_boundary(room))
                .unwrap_or_default(),
        )
    }
}

/// The rate limit of the lines of one kind.
///
/// Sans-I/O: keys and `now` go in, decisions come out.
#[derive(Debug, Default)]
pub struct LogLimit {
    all: Option<TokenBucket>,
    keys: HashMap<u64, TokenBucket>,
    /// Number of lines that were left out since the last line.
    omitted: u64,
}

impl LogLimit {
    /// Decides about a line with this key. Returns `None` if the line is to be left out, which counts it, and
    /// otherwise the number of lines that were left out since the last one.
    pub fn admit(&mut self, key: u64, now: Instant) -> Option<u64> {
        if self.has_room(key, now) {
            Some(std::mem::take(&mut self.omitted))
        } else {
            self.omitted = self.omitted.saturating_add(1);
            None
        }
    }

    fn has_room(&mut self, key: u64, now: Instant) -> bool {
        // The narrower limit first: a line that it leaves out does not use up the wider one.
        let take_of_key = |bucket: &mut TokenBucket| {
            bucket.take_of(1.0, LINES_OF_KEY_PER_SECOND, LINES_OF_KEY, now)
        };
        if let Some(bucket) = self.keys.get_mut(&key)
            && !take_of_key(bucket)
        {
            return false;
        }
        let all = self.all.get_or_insert_with(|| TokenBucket::new(LINES, now));
        if !all.take_of(1.0, LINES_PER_SECOND, LINES, now) {
            return false;
        }
        if self.keys.len() >= MAX_KEYS {
            self.keys
                .retain(|_, bucket| now.saturating_duration_since(bucket.asked()) < MEMORY);
        }
        if self.keys.len() < MAX_KEYS {
            self.keys.entry(key).or_insert_with(|| {
                let mut bucket = TokenBucket::new(LINES_OF_KEY, now);
                take_of_key(&mut bucket);
                bucket
            });
        }
        true
    }

    /// Returns the number of lines that were left out since the last line, and sets it to zero.
    pub fn take_omitted(&mut self) -> u64 {
        std::mem::take(&mut self.omitted)
    }
}

/// Logs, for each kind of lines that were left out, their number since the last line of the kind. Processes call this
/// from time to time, and before they end.
pub fn report_omitted() {
    // A copy, because a subscriber may log in turn.
    let sites = SITES.lock().clone();
    for site in sites {
        let omitted = site.limit.lock().as_mut().map_or(0, LogLimit::take_omitted);
        if omitted == 0 {
            continue;
        }
        let (lines, module) = (site.text, site.module);
        match site.level {
            Level::ERROR => tracing::event!(
                Level::ERROR,
                omitted,
                module,
                lines,
                "log lines were omitted"
            ),
            Level::WARN => tracing::event!(
                Level::WARN,
                omitted,
                module,
                lines,
                "log lines were omitted"
            ),
            _ => tracing::event!(
                Level::INFO,
                omitted,
                module,
                lines,
                "log lines were omitted"
            ),
        }
    }
}

/// The place of a line in the code, which is one kind of lines.
#[doc(hidden)]
#[derive(Debug)]
pub struct Site {
    level: Level,
    module: &'static str,
    text: &'static str,
    limit: Mutex<Option<LogLimit>>,
    is_listed: AtomicBool,
}

/// The places whose lines have been left out.
static SITES: Mutex<Vec<&'static Site>> = Mutex::new(Vec::new());

/// Random keys, so that no peer can choose names with equal hashes.
static HASHES: LazyLock<RandomState> = LazyLock::new(RandomState::new);

impl Site {
    #[must_use]
    pub const fn new(level: Level, module: &'static str, text: &'static str) -> Self {
        Self {
            level,
            module,
            text,
            limit: Mutex::new(None),
            is_listed: AtomicBool::new(false),
        }
    }

    /// Decides about a line: see [`LogLimit::admit`]. The inner `None` stands for no omitted lines, which adds no
    /// field.
    pub fn admit(&'static self, key: &(impl Hash + ?Sized)) -> Option<Option<u64>> {
        let key = HASHES.hash_one(key);
        let now = Instant::now();
        let admitted = self
            .limit
            .lock()
            .get_or_insert_default()
            .admit(key, now)
            .map(|omitted| (omitted > 0).then_some(omitted));
        if admitted.is_none() && !self.is_listed.swap(true, Ordering::Relaxed) {
            SITES.lock().push(self);
        }
        admitted
    }
}

/// Logs an error within the [rate limit](crate::log_limit).
#[doc(hidden)]
#[macro_export]
macro_rules! __log_error {
    ($($line:tt)+) => { $crate::__log_limited!(ERROR, $($line)+) };
}

/// Logs a warning within the [rate limit](crate::log_limit).
#[doc(hidden)]
#[macro_export]
macro_rules! __log_warn {
    ($($line:tt)+) => { $crate::__log_limited!(WARN, $($line)+) };
}

/// Logs an event within the [rate limit](crate::log_limit).
#[doc(hidden)]
#[macro_export]
macro_rules! __log_info {
    ($($line:tt)+) => { $crate::__log_limited!(INFO, $($line)+) };
}

#[doc(hidden)]
#[macro_export]
macro_rules! __log_limited {
    ($level:ident, target: $target:expr, of: $key:expr, $($line:tt)+) => {{
        use $crate::log_limit::{Site, tracing};
        if tracing::enabled!(target: $target, tracing::Level::$level) {
            static SITE: Site = Site::new(
                tracing::Level::$level,
                module_path!(),
                $crate::__log_text!($($line)+),
            );
            if let Some(omitted) = SITE.admit(&$key) {
                $crate::__log_cut!(($target, $level, omitted) () $($line)+);
            }
        }
    }};
    ($level:ident, of: $key:expr, $($line:tt)+) => {
        $crate::__log_limited!($level, target: module_path!(), of: $key, $($line)+)
    };
    ($level:ident, $($line:tt)+) => {
        $crate::__log_limited!($level, target: module_path!(), of: (), $($line)+)
    };
}

/// Writes a line with its values cut. The fields move from the third part to the second one.
#[doc(hidden)]
#[macro_export]
macro_rules! __log_cut {
    (($target:expr, $level:ident, $omitted:ident) ($($done:tt)*) $text:literal $($arguments:tt)*) => {
        $crate::log_limit::tracing::event!(
            target: $target,
            $crate::log_limit::tracing::Level::$level,
            message = %$crate::log_limit::Cut(format_args!($text $($arguments)*)),
            $omitted,
            $($done)*
        )
    };
    ($place:tt ($($done:tt)*) $($name:ident).+ = %$value:expr, $($rest:tt)+) => {
        $crate::__log_cut!($place (
            $($done)* $($name).+ = %$crate::log_limit::Cut(format_args!("{}", $value)),
        ) $($rest)+)
    };
    ($place:tt ($($done:tt)*) $($name:ident).+ = ?$value:expr, $($rest:tt)+) => {
        $crate::__log_cut!($place (
            $($done)* $($name).+ = %$crate::log_limit::Cut(format_args!("{:?}", $value)),
        ) $($rest)+)
    };
    ($place:tt ($($done:tt)*) $($name:ident).+ = $value:expr, $($rest:tt)+) => {
        $crate::__log_cut!($place ($($done)* $($name).+ = $value,) $($rest)+)
    };
    ($place:tt $done:tt %$($name:ident).+, $($rest:tt)+) => {
        $crate::__log_cut!($place $done $($name).+ = %$($name).+, $($rest)+)
    };
    ($place:tt $done:tt ?$($name:ident).+, $($rest:tt)+) => {
        $crate::__log_cut!($place $done $($name).+ = ?$($name).+, $($rest)+)
    };
    ($place:tt ($($done:tt)*) $($name:ident).+, $($rest:tt)+) => {
        $crate::__log_cut!($place ($($done)* $($name).+,) $($rest)+)
    };
}

/// The text of a line, which follows its fields.
#[doc(hidden)]
#[macro_export]
macro_rules! __log_text {
    ($text:literal $(, $($arguments:tt)*)?) => { $text };
    ($field:tt $($line:tt)+) => { $crate::__log_text!($($line)+) };
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::AtomicUsize;

    use tracing::field::{Field, Visit};
    use tracing::span;
    use tracing::subscriber::{Interest, with_default};

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn one_key_has_a_burst_and_then_a_line_every_ten_seconds_with_the_number_of_omitted_lines() {
        let (mut limit, start) = (LogLimit::default(), Instant::now());
        let burst: Vec<_> = (0..100).filter_map(|_| limit.admit(1, start)).collect();
        assert_eq!(burst, [0; 5]);
        assert_eq!(limit.admit(1, start + 9 * SECOND), None);
        assert_eq!(limit.admit(1, start + 11 * SECOND), Some(96));
        assert_eq!(limit.admit(1, start + 12 * SECOND), None);
        assert_eq!(limit.take_omitted(), 1);
        assert_eq!(limit.take_omitted(), 0);
    }

    #[test]
    fn a_loud_key_does_not_use_up_the_lines_of_another() {
        let (mut limit, now) = (LogLimit::default(), Instant::now());
        for _ in 0..10_000 {
            limit.admit(1, now);
        }
        assert_eq!(limit.admit(2, now), Some(9995));
    }

    #[test]
    fn invented_keys_cause_few_lines_and_take_bounded_memory() {
        let (mut limit, start) = (LogLimit::default(), Instant::now());
        let (mut lines, mut omitted) = (0_u64, 0);
        // A hundred seconds.
        for number in 0..100_000_u64 {
            let now = start + Duration::from_millis(number);
            if let Some(before) = limit.admit(number, now) {
                lines += 1;
                omitted += before;
            }
            assert!(limit.keys.len() <= MAX_KEYS);
        }
        assert!((100..=120).contains(&lines), "{lines}");
        // None is missing from the numbers.
        assert_eq!(lines + omitted + limit.take_omitted(), 100_000);
    }

    /// Counts the lines, adds up their fields `omitted`, and keeps the values of the others.
    #[derive(Debug, Clone, Default)]
    struct Log {
        lines: Arc<AtomicUsize>,
        omitted: Arc<AtomicUsize>,
        values: Arc<Mutex<Vec<(&'static str, String)>>>,
    }

    impl Visit for Log {
        fn record_u64(&mut self, field: &Field, value: u64) {
            if field.name() == "omitted" {
                let value = usize::try_from(value).unwrap();
                self.omitted.fetch_add(value, Ordering::Relaxed);
            }
        }

        fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
            let value = format!("{value:?}");
            self.values.lock().push((field.name(), value));
        }
    }

    impl tracing::Subscriber for Log {
        fn register_callsite(&self, _: &'static tracing::Metadata<'static>) -> Interest {
            Interest::always()
        }

        fn enabled(&self, _: &tracing::Metadata<'_>) -> bool {
            true
        }

        fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
            span::Id::from_u64(1)
        }

        fn record(&self, _: &span::Id, _: &span::Record<'_>) {}

        fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}

        fn event(&self, event: &tracing::Event<'_>) {
            self.lines.fetch_add(1, Ordering::Relaxed);
            event.record(&mut self.clone());
        }

        fn enter(&self, _: &span::Id) {}

        fn exit(&self, _: &span::Id) {}
    }

    #[test]
    fn a_value_is_cut_between_characters() {
        let of = |text: &str| Cut(text).to_string();
        let fits = "x".repeat(MAX_VALUE);
        assert_eq!(of(&fits), fits);
        assert_eq!(of(&format!("{fits}y")), format!("{fits}... (2049 bytes)"));
        let wide = "ä".repeat(MAX_VALUE);
        assert_eq!(
            of(&format!("x{wide}")),
            format!("x{}... (4097 bytes)", &wide[..2046])
        );
        // A value may be written in many parts.
        let parts = Cut(format_args!("{fits}{}{}", "a", "b")).to_string();
        assert_eq!(parts, format!("{fits}... (2050 bytes)"));
    }

    #[test]
    fn long_values_of_peers_are_cut_in_the_log() {
        struct Peer {
            name: String,
        }
        let log = Log::default();
        let (text, number) = ("t".repeat(100_000), 7);
        let peer = Peer { name: text.clone() };
        with_default(log.clone(), || {
            warn!(of: 1, %text, ?text, %peer.name, why = %text, other = ?text, number, count = number, "says {text}");
            info!("says {}, {number}", peer.name);
            error!(number, "says {text}");
        });
        let values = log.values.lock();
        let long = values.iter().filter(|(_, value)| value.len() > 100);
        for (name, value) in long.clone() {
            assert!(
                value.len() < MAX_VALUE + 40,
                "{name}: {} bytes",
                value.len()
            );
            assert!(value.contains("... (1000"), "{name}: {value}");
        }
        assert_eq!(long.count(), 8);
        let names: Vec<&str> = values.iter().take(8).map(|(name, _)| *name).collect();
        let expected = [
            "message",
            "text",
            "text",
            "peer.name",
            "why",
            "other",
            "number",
            "count",
        ];
        assert_eq!(names, expected);
        assert_eq!((&*values[6].1, &*values[7].1), ("7", "7"));
    }

    #[test]
    fn the_numbers_of_omitted_lines_are_logged_at_the_end_of_a_flood() {
        let log = Log::default();
        with_default(log.clone(), || {
            for number in 0..1000 {
                warn!(of: number % 2, peer = %number, "a peer sends nonsense: {}", "text");
            }
            let lines = log.lines.load(Ordering::Relaxed);
            assert!((10..=12).contains(&lines), "{lines}");
            report_omitted();
            report_omitted();
        });
        let lines = log.lines.load(Ordering::Relaxed);
        assert!((11..=13).contains(&lines), "{lines}");
        let omitted = log.omitted.load(Ordering::Relaxed);
        // Without the line of the report.
        assert_eq!(lines - 1 + omitted, 1000);
    }
}
