//! The proved identity of the peer of a connection, and its consequences for letters.
//!
//! Without TLS, peers prove nothing, and letters are not restricted.

use fipa_transport::{Mandate, Principal};

#[cfg(feature = "secure")]
use std::time::{Duration, Instant, SystemTime};

#[cfg(feature = "secure")]
use tokio::time::sleep_until;

use crate::end::ConnectionEnd;
#[cfg(feature = "secure")]
use crate::secure::{Certificate, Security};

/// The proved identity of a peer.
#[derive(Debug, Clone, Default)]
pub(crate) struct Proof {
    #[cfg(feature = "secure")]
    certificate: Option<(Security, Certificate)>,
}

impl Proof {
    /// Creates the proof of a peer that has this certificate and its key.
    #[cfg(feature = "secure")]
    pub(crate) fn of(security: &Security, certificate: Certificate) -> Self {
        Self {
            certificate: Some((security.clone(), certificate)),
        }
    }

    /// Returns an error text when the certificate names another service than `name`.
    pub(crate) fn contradicts(&self, name: &str) -> Option<String> {
        #[cfg(feature = "secure")]
        if let Some((_, certificate)) = &self.certificate {
            let proved = certificate.certified().mts();
            return (proved != name).then(|| {
                format!("the peer calls itself {name:?}, but its certificate names {proved:?}")
            });
        }
        let _unproved = name;
        None
    }

    /// Whether the peer may send and receive letters for the agent with this name.
    pub(crate) fn speaks_for(&self, agent: &str) -> bool {
        #[cfg(feature = "secure")]
        if let Some((_, certificate)) = &self.certificate {
            return certificate.certified().speaks_for(agent);
        }
        let _unproved = agent;
        true
    }

    /// Returns the agents that the peer may speak for.
    pub(crate) fn mandate(&self) -> Mandate {
        #[cfg(feature = "secure")]
        if let Some((_, certificate)) = &self.certificate {
            return certificate.certified().mandate().clone();
        }
        Mandate::Unproved
    }

    /// Whether there are agents that the peer may not speak for.
    pub(crate) fn restricts(&self) -> bool {
        #[cfg(feature = "secure")]
        if let Some((_, certificate)) = &self.certificate {
            return !certificate.certified().agents().is_empty();
        }
        false
    }

    /// Returns the certificate whose key the peer has proved to have, if any.
    pub(crate) fn principal(&self) -> Option<Principal> {
        #[cfg(feature = "secure")]
        if let Some((_, certificate)) = &self.certificate {
            let fingerprint = certificate.fingerprint();
            return Some(Principal::Certificate(fingerprint.into_bytes()));
        }
        None
    }

    /// Waits until the peer is no longer trusted or its certificate expires.
    pub(crate) async fn withdrawn(&self) -> ConnectionEnd {
        #[cfg(feature = "secure")]
        if let Some((security, certificate)) = &self.certificate {
            let mut changes = security.changes();
            let left = certificate.left(SystemTime::now());
            let mut expiry = Expiry::new(Instant::now(), left);
            while security.trusts(certificate.fingerprint()) {
                let next_check = expiry.next_check(Instant::now());
                tokio::select! {
                    changed = changes.changed() => if changed.is_err() {
                        break;
                    },
                    () = sleep_until(next_check.into()) => {}
                }
                let left = || certificate.left(SystemTime::now());
                if expiry.has_passed(Instant::now(), left) {
                    return ConnectionEnd::Expired;
                }
            }
            return ConnectionEnd::Distrusted;
        }
        std::future::pending().await
    }
}

/// The end of a certificate's validity, as a connection with its holder measures it.
///
/// The remaining time is computed from the calendar once and measured on the monotonic clock:
/// setting the calendar ahead ends no connection. The calendar is read again when the time is up.
#[cfg(feature = "secure")]
#[derive(Debug)]
struct Expiry {
    ends: Instant,
}

#[cfg(feature = "secure")]
impl Expiry {
    /// The maximum time between two checks.
    const LONGEST_SLEEP: Duration = Duration::from_secs(86_400);

    /// The expiry of a certificate that is valid for this time.
    fn new(now: Instant, left: Duration) -> Self {
        const CENTURY: Duration = Duration::from_secs(100 * 365 * 86_400);
        Self {
            ends: now + left.min(CENTURY),
        }
    }

    /// The time of the next check.
    fn next_check(&self, now: Instant) -> Instant {
        self.ends.min(now + Self::LONGEST_SLEEP)
    }

    /// Whether the certificate has expired by both clocks. `left` is the remaining time by the
    /// calendar.
    fn has_passed(&mut self, now: Instant, left: impl FnOnce() -> Duration) -> bool {
        if now < self.ends {
            return false;
        }
        let left = left();
        *self = Self::new(now, left);
        left.is_zero()
    }
}

#[cfg(all(test, feature = "secure"))]
#[expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
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
            let made = params.self_signed(&KeyPair::generate().unwrap()).unwrap();
            let certificate = Certificate::from_der(made.der().to_vec()).unwrap();
            let start = Instant::now();
            let expiry = Expiry::new(start, certificate.left(calendar));
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
            let left = || self.certificate.left(self.calendar);
            self.expiry.has_passed(self.now, left)
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
