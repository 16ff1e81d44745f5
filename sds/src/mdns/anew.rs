//! When the mDNS library is started anew.
//!
//! We do not browse with the library ([`super::browse`]), but it keeps what it hears all the same,
//! if the packet introduces no service, and for ever. It has no bound, and no way to make it
//! forget. So it is looked at every two seconds, and when it keeps too much it is ended, without a
//! goodbye, and another one started, which is told of our own agents again. Between the two is a
//! pause that grows while the flood goes on: what is bounded is the memory, and how often our
//! agents are announced again. Others' agents have nothing to do with it.

use std::collections::HashMap;
use std::time::{Duration, Instant};

/// How often the library is asked how much it keeps.
pub(super) const INTERVAL: Duration = Duration::from_secs(2);
/// Most records that it may keep. None is longer than the packet it came in, which has at most
/// [`MAX_PACKET`](super::packet::MAX_PACKET) bytes.
pub(super) const MAX_CACHED: u64 = 40_000;
/// Most times at which it has something to do; every record heard adds two, known or not, which
/// stay for as long as the record says that it is good.
const MAX_TIMERS: u64 = 1_000_000;
/// The first pause. What has been said goodbye to rests for as long.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// The longest: nobody's records of us expire in that time, and nobody asks for them twice.
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// A flood is over when the library has kept little for that long.
const CALM: Duration = Duration::from_secs(120);

/// What the library keeps, if that is too much.
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

/// How long the pauses are.
#[derive(Debug)]
pub(super) struct Pauses {
    started: Instant,
    last: Duration,
}

impl Pauses {
    /// The library is started for the first time.
    pub(super) fn new(now: Instant) -> Self {
        Self {
            started: now,
            last: Duration::ZERO,
        }
    }

    /// The library is ended: for how long it is to be without one.
    pub(super) fn ended(&mut self, now: Instant) -> Duration {
        if now >= self.started + CALM {
            self.last = Duration::ZERO;
        }
        self.last = (self.last * 2).clamp(FIRST_PAUSE, LONGEST_PAUSE);
        self.last
    }

    /// It is started again.
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
    use crate::{Directory, Mts, Registration};

    /// A directory on loopback, alone on its port. In a test with one thread its task does not run as
    /// long as nothing is awaited.
    pub(in crate::mdns) fn directory() -> MdnsDirectory {
        let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr();
        let config = MdnsConfig {
            interfaces: vec!["lo".to_owned()],
            port: free.unwrap().port(),
            ..MdnsConfig::new(Mts::new("own", Incarnation::random()))
        };
        MdnsDirectory::open(config).unwrap()
    }

    #[test]
    fn all_kinds_of_records_count() {
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
    async fn beacons_say_what_they_said_last_while_there_is_no_library() {
        let directory = directory();
        let life = Incarnation::random();
        let at = || vec!["tcp://127.0.0.1:7788#00000000000000aa".parse().unwrap()];
        directory
            .register(Registration::new("arm", life, at()))
            .unwrap();
        let said = directory.shared.announced();
        directory.shared.end_daemon().unwrap();
        let leg = Registration::new("leg", Incarnation::random(), at());
        directory.register(leg).unwrap();
        directory.deregister("arm", life).unwrap();
        assert_eq!(directory.shared.announced(), said);
        // Then there is somebody to be asked about what has changed.
        assert!(directory.shared.start_daemon());
        assert_ne!(directory.shared.announced(), said);
    }
}
