//! Trust in the peer of one connection, for as long as the connection is open.
//!
//! A handshake proves a peer once, and connections last. [`Security`] gives out the result of a
//! handshake only as a [`Trust`], which is judged again when the credentials change and when a
//! certificate ends. Trust that has ended does not return to its connection.

use std::time::{Duration, Instant, SystemTime};

use parking_lot::Mutex;
#[cfg(feature = "http")]
use rustls::pki_types::{CertificateDer, ServerName};
use tokio::time::sleep_until;

#[cfg(feature = "http")]
use super::certificate::{last_second, left_until};
use super::{Certificate, Security, advice};
use crate::end::ConnectionEnd;

/// The trust in the peer of a connection.
#[derive(Debug)]
pub(crate) struct Trust {
    security: Security,
    evidence: Evidence,
    judged: Mutex<Judged>,
}

/// The certificates that a peer has presented, with the key of the first one.
#[derive(Debug)]
pub(super) enum Evidence {
    /// A trusted certificate.
    Listed(Certificate),
    /// The certificates of a platform, from its own to that of an authority.
    #[cfg(feature = "http")]
    Chain(Chain),
}

/// A chain of certificates that proves the host name of a platform.
#[cfg(feature = "http")]
#[derive(Debug)]
pub(super) struct Chain {
    pub(super) presented: Vec<CertificateDer<'static>>,
    pub(super) name: ServerName<'static>,
    /// The last seconds at which its certificates are valid, since 1970-01-01 00:00 UTC.
    pub(super) ends: Vec<i64>,
}

/// The latest judgment.
#[derive(Debug)]
struct Judged {
    /// The [revision](Security::revision) of the credentials that it is based on.
    revision: u64,
    expiry: Expiry,
    /// The reason for which the trust has ended.
    end: Option<ConnectionEnd>,
}

impl Trust {
    /// Creates the trust that a handshake has established with credentials of this revision.
    pub(super) fn new(security: &Security, revision: u64, evidence: Evidence) -> Self {
        let time_left = security.time_left(&evidence, SystemTime::now());
        Self {
            judged: Mutex::new(Judged {
                revision,
                expiry: Expiry::new(Instant::now(), time_left),
                end: None,
            }),
            security: security.clone(),
            evidence,
        }
    }

    /// Returns the trusted certificate of the peer. `None` if an authority proves the peer.
    pub(crate) fn certificate(&self) -> Option<&Certificate> {
        match &self.evidence {
            Evidence::Listed(certificate) => Some(certificate),
            #[cfg(feature = "http")]
            Evidence::Chain(_) => None,
        }
    }

    /// Checks that the peer is still trusted. Once the trust has ended, every check fails.
    ///
    /// # Errors
    /// The reason for which the trust has ended.
    pub(crate) fn check(&self) -> Result<(), ConnectionEnd> {
        self.judge(Instant::now()).map(|_| ())
    }

    /// Waits until the trust has ended.
    pub(crate) async fn ended(&self) -> ConnectionEnd {
        // Subscribed before the first judgment, so that no change is missed.
        let mut changes = self.security.changes();
        loop {
            let next = match self.judge(Instant::now()) {
                Ok(next) => next,
                Err(end) => return end,
            };
            tokio::select! {
                // The sender exists as long as `security`.
                _ = changes.changed() => {}
                () = sleep_until(next.into()) => {}
            }
        }
    }

    /// Returns the time of the next judgment if no credentials change before.
    fn judge(&self, now: Instant) -> Result<Instant, ConnectionEnd> {
        let mut judged = self.judged.lock();
        if let Some(end) = &judged.end {
            return Err(end.clone());
        }
        let revision = self.security.revision();
        let is_trusted = revision == judged.revision || self.security.still_trusts(&self.evidence);
        judged.revision = revision;
        let time_left = || self.security.time_left(&self.evidence, SystemTime::now());
        let end = match is_trusted {
            false => ConnectionEnd::Distrusted,
            true if judged.expiry.has_passed(now, time_left) => {
                ConnectionEnd::Expired(advice::expired())
            }
            true => return Ok(judged.expiry.next_check(now)),
        };
        judged.end = Some(end.clone());
        Err(end)
    }
}

#[cfg(feature = "http")]
impl Chain {
    /// Creates the chain of these certificates. `None` if one cannot be parsed.
    pub(super) fn new(
        presented: &[CertificateDer<'_>],
        name: &ServerName<'static>,
    ) -> Option<Self> {
        let ends = presented.iter().map(|it| last_second(it));
        Some(Self {
            ends: ends.collect::<Option<_>>()?,
            presented: presented.iter().map(|it| it.clone().into_owned()).collect(),
            name: name.clone(),
        })
    }

    /// Returns the time from `now` until the next of its certificates ends.
    pub(super) fn next_end(&self, now: SystemTime) -> Duration {
        let ends = self.ends.iter();
        let time_left = ends.map(|end| left_until(*end, now));
        time_left
            .filter(|time_left| !time_left.is_zero())
            .min()
            .unwrap_or_default()
    }
}

/// The end of the validity of certificates, as a connection with their holder measures it.
///
/// The remaining time is computed from the calendar once and measured on the monotonic clock:
/// setting the calendar ahead ends no connection. The calendar is read again when the time is up.
#[derive(Debug)]
struct Expiry {
    ends: Instant,
}

impl Expiry {
    /// The maximum time between two checks.
    const LONGEST_SLEEP: Duration = Duration::from_secs(86_400);

    /// The expiry of a certificate that is valid for this time.
    fn new(now: Instant, time_left: Duration) -> Self {
        const CENTURY: Duration = Duration::from_secs(100 * 365 * 86_400);
        Self {
            ends: now + time_left.min(CENTURY),
        }
    }

    /// The time of the next check.
    fn next_check(&self, now: Instant) -> Instant {
        self.ends.min(now + Self::LONGEST_SLEEP)
    }

    /// Whether the certificate has expired by both clocks. `left` is the remaining time by the
    /// calendar.
    fn has_passed(&mut self, now: Instant, time_left: impl FnOnce() -> Duration) -> bool {
        if now < self.ends {
            return false;
        }
        let time_left = time_left();
        *self = Self::new(now, time_left);
        time_left.is_zero()
    }
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair, SanType};

    use super::*;
    use crate::secure::alternative_names;

    const DAY: Duration = Duration::from_secs(86_400);
    const YEAR: Duration = Duration::from_secs(365 * 86_400);

    /// A connection with a peer whose certificate expires after ten days, and the clocks of this host.
    struct Scene {
        certificate: Certificate,
        start: Instant,
        now: Instant,
        calendar: SystemTime,
        expiry: Expiry,
    }

    impl Scene {
        fn new() -> Self {
            let calendar = SystemTime::UNIX_EPOCH + 50 * YEAR;
            let mut params = CertificateParams::default();
            for uri in alternative_names("crex-mts", &[]) {
                let uri = uri.try_into().unwrap();
                params.subject_alt_names.push(SanType::URI(uri));
            }
            params.not_before = (calendar - DAY).into();
            params.not_after = (calendar + 10 * DAY).into();
            let signed = params.self_signed(&KeyPair::generate().unwrap()).unwrap();
            let certificate = Certificate::from_der(signed.der().to_vec()).unwrap();
            let start = Instant::now();
            let expiry = Expiry::new(start, certificate.time_left(calendar));
            Self {
                certificate,
                start,
                now: start,
                calendar,
                expiry,
            }
        }

        /// Time passes, by both clocks.
        fn passes(&mut self, time: Duration) {
            self.now += time;
            self.calendar += time;
        }

        fn has_expired(&mut self) -> bool {
            let time_left = || self.certificate.time_left(self.calendar);
            self.expiry.has_passed(self.now, time_left)
        }

        /// Sleeps until each next check. Returns the time on the monotonic clock after which the
        /// connection ends.
        fn ends_after(&mut self) -> Duration {
            for _ in 0..2000 {
                let sleep = self.expiry.next_check(self.now) - self.now;
                assert!(sleep <= DAY);
                self.passes(sleep);
                if self.has_expired() {
                    return self.now - self.start;
                }
            }
            panic!("the connection never ends");
        }
    }

    /// Within the last second of the certificate.
    fn is_ten_days(time: Duration) -> bool {
        (10 * DAY..=10 * DAY + Duration::from_secs(1)).contains(&time)
    }

    #[test]
    fn a_connection_ends_when_the_certificate_of_its_peer_expires() {
        assert!(is_ten_days(Scene::new().ends_after()));
    }

    #[test]
    fn a_clock_that_jumps_ahead_and_back_ends_no_connection() {
        let mut scene = Scene::new();
        scene.passes(DAY);
        scene.calendar += YEAR;
        assert!(!scene.has_expired());
        scene.passes(DAY);
        assert!(!scene.has_expired());
        scene.calendar -= YEAR;
        assert!(is_ten_days(scene.ends_after()));
    }

    #[test]
    fn a_clock_that_stays_ahead_ends_a_connection_only_when_its_time_is_up() {
        let mut scene = Scene::new();
        scene.calendar += YEAR;
        assert!(is_ten_days(scene.ends_after()));
    }

    #[test]
    fn a_clock_that_jumps_back_ends_no_connection() {
        let mut scene = Scene::new();
        scene.calendar -= YEAR;
        assert!(!scene.has_expired());
        scene.passes(10 * DAY);
        assert!(
            !scene.has_expired(),
            "the certificate is valid by the calendar"
        );
        // The clock is set right, a day before it would have been.
        scene.calendar += YEAR - 2 * DAY;
        let ends = scene.ends_after();
        assert!(ends >= 10 * DAY, "{ends:?}");
    }

    #[test]
    fn a_clock_before_the_first_calendar_year_ends_no_connection() {
        let mut scene = Scene::new();
        scene.calendar = SystemTime::UNIX_EPOCH - DAY;
        scene.passes(10 * DAY);
        assert!(!scene.has_expired());
    }
}
