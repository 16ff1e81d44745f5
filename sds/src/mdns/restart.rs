//! Restarts of the mDNS library.
//!
//! This crate does not browse with the library ([`super::browse`]), but the library caches received
//! records all the same, and keeps those of packets that introduce no service forever. Its cache
//! has no limit and cannot be cleared. The cache size is therefore checked every two to three seconds
//! while the process works ([`CacheCheck`]). A library whose cache is too large is stopped without a
//! goodbye, and a new one is started, to which this gateway's own agents are registered again. The
//! pause in between grows while the flood continues, which bounds the memory and the rate of repeated
//! announcements. The entries of other gateways' agents are not affected.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// Minimum time between two checks of the cache size.
const INTERVAL: Duration = Duration::from_secs(2);
/// Processor time of the process after which the cache size is checked. In this time, the library can
/// cache only a part of [`MAX_CACHED`] records.
const WORK: Duration = Duration::from_millis(10);
/// Maximum number of cached records. A record is at most as long as its packet, which has at most
/// [`MAX_PACKET`](super::packet::MAX_PACKET) bytes.
pub(super) const MAX_CACHED: u64 = 40_000;
/// Maximum number of timers in the library. Every received record, cached or not, adds two, which
/// stay until the record expires.
const MAX_TIMERS: u64 = 1_000_000;
/// The first pause. A name also rests for this long after a goodbye.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// The longest pause: no cached record of this gateway expires in that time, and no other host
/// queries for it twice.
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// A flood is over when the library ran for this long.
const CALM: Duration = Duration::from_secs(120);

/// Describes the cache size if it is too large.
pub(super) fn is_too_much(metrics: &HashMap<String, i64>) -> Option<String> {
    let count = |value: &i64| u64::try_from(*value).unwrap_or_default();
    let cached = metrics
        .iter()
        .filter(|(name, _)| name.starts_with("cached-"))
        .fold(0_u64, |sum, (_, value)| sum.saturating_add(count(value)));
    let timers = metrics.get("timer").map_or(0, count);
    if cached > MAX_CACHED {
        return Some(format!("{cached} records, more than {MAX_CACHED}"));
    }
    (timers > MAX_TIMERS).then(|| format!("{timers} timers, more than {MAX_TIMERS}"))
}

/// Returns the processor time that this process has used.
pub(super) fn work() -> Duration {
    let used = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Duration::try_from(used).unwrap_or_default()
}

/// Decides when the cache size is checked. A check wakes two threads, and the cache of an idle process
/// does not grow. Not all packets that the library caches arrive at the sockets of this crate, so the
/// processor time decides.
#[derive(Debug)]
pub(super) struct CacheCheck {
    next: Instant,
    /// Processor time at the last check.
    work: Duration,
}

impl CacheCheck {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            next: now + INTERVAL,
            work: Duration::ZERO,
        }
    }

    /// Whether the cache size is to be checked, given the processor time that the process has used.
    pub(super) fn is_due(&self, now: Instant, work: impl FnOnce() -> Duration) -> bool {
        now >= self.next && work() >= self.work + WORK
    }

    /// Records that the library was asked; `work` is `None` if it was too busy.
    pub(super) fn asked(&mut self, now: Instant, work: Option<Duration>) {
        self.next = now + INTERVAL;
        if let Some(work) = work {
            self.work = work;
        }
    }
}

/// Computes the pauses between stop and restart of the library.
#[derive(Debug)]
pub(super) struct Pauses {
    started: Instant,
    last: Duration,
}

impl Pauses {
    /// Records the first start of the library.
    pub(super) fn new(now: Instant) -> Self {
        Self {
            started: now,
            last: Duration::ZERO,
        }
    }

    /// Records the stop of the library, and returns the pause before the restart.
    pub(super) fn ended(&mut self, now: Instant) -> Duration {
        if now >= self.started + CALM {
            self.last = Duration::ZERO;
        }
        self.last = (self.last * 2).clamp(FIRST_PAUSE, LONGEST_PAUSE);
        self.last
    }

    /// Records the restart.
    pub(super) fn started(&mut self, now: Instant) {
        self.started = now;
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::net::UdpSocket;

    use fipa_transport::Incarnation;

    use super::super::{MdnsConfig, MdnsDirectory};
    use super::*;
    use crate::{Directory, MtsId, Registration};

    /// Opens a directory on loopback with a port of its own. In a single-threaded test its task
    /// does not run until the test awaits.
    pub(in crate::mdns) fn directory() -> MdnsDirectory {
        let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr();
        let config = MdnsConfig {
            interfaces: vec!["lo".to_owned()],
            port: free.unwrap().port(),
            ..MdnsConfig::new(MtsId::new("own", Incarnation::random()))
        };
        MdnsDirectory::open(config).unwrap()
    }

    #[test]
    fn records_of_all_types_are_counted() {
        let metrics = |of: &[(&str, u64)]| {
            let of = of.iter();
            of.map(|(name, value)| ((*name).to_owned(), i64::try_from(*value).unwrap()))
                .collect()
        };
        let half = MAX_CACHED / 2;
        let other = ("respond", u64::from(u32::MAX));
        assert_eq!(is_too_much(&metrics(&[])), None);
        let enough = [("cached-ptr", half), ("cached-addr", half), other];
        assert_eq!(is_too_much(&metrics(&enough)), None);
        let too_many = [enough[0], enough[1], ("cached-nsec", 1)];
        let why = is_too_much(&metrics(&too_many)).unwrap();
        assert!(why.contains("40001 records"), "{why}");
        assert_eq!(is_too_much(&metrics(&[("timer", MAX_TIMERS)])), None);
        assert!(is_too_much(&metrics(&[("timer", MAX_TIMERS + 1)])).is_some());
        let negative = HashMap::from([("cached-ptr".to_owned(), -1)]);
        assert_eq!(is_too_much(&negative), None);
    }

    #[test]
    fn the_cache_of_an_idle_process_is_not_checked() {
        let begun = Instant::now();
        let at = |seconds| begun + Duration::from_secs(seconds);
        let milliseconds = Duration::from_millis;
        let mut check = CacheCheck::new(begun);
        let due = |check: &CacheCheck, now, work| check.is_due(at(now), || milliseconds(work));
        assert!(!due(&check, 1, 1000), "too early");
        assert!(due(&check, 2, 1000));
        check.asked(at(2), Some(milliseconds(1000)));
        assert!(!due(&check, 3600, 1009), "idle");
        // Small work adds up.
        assert!(due(&check, 3600, 1010));
        check.asked(at(3600), None);
        assert!(!due(&check, 3601, 1010));
        assert!(due(&check, 3602, 1010), "a busy library is asked again");
    }

    #[test]
    fn the_processor_time_grows_with_work() {
        let before = work();
        while work() < before + WORK {
            std::hint::black_box(Instant::now());
        }
    }

    #[test]
    fn pauses_grow_while_the_flood_goes_on() {
        let mut now = Instant::now();
        let mut pauses = Pauses::new(now);
        let mut seconds = Vec::new();
        for _ in 0..8 {
            now += Duration::from_secs(3);
            let pause = pauses.ended(now);
            seconds.push(pause.as_secs());
            now += pause;
            pauses.started(now);
        }
        assert_eq!(seconds, [1, 2, 4, 8, 16, 30, 30, 30]);
        assert_eq!(pauses.ended(now + CALM), FIRST_PAUSE);
    }

    #[tokio::test]
    async fn beacons_are_unchanged_while_the_library_is_stopped() {
        let directory = directory();
        let incarnation = Incarnation::random();
        let at = || vec!["tcp://127.0.0.1:7788#00000000000000aa".parse().unwrap()];
        directory
            .register(Registration::new("arm", incarnation, at()))
            .unwrap();
        let before = directory.shared.announced();
        directory.shared.end_daemon().unwrap();
        let leg = Registration::new("leg", Incarnation::random(), at());
        directory.register(leg).unwrap();
        directory.deregister("arm", incarnation).unwrap();
        assert_eq!(directory.shared.announced(), before);
        // A running library can answer queries for the changes.
        assert!(directory.shared.start_daemon());
        assert_ne!(directory.shared.announced(), before);
    }
}
