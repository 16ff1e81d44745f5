//! The proved identity of the peer of a connection, and its consequences for letters.
//!
//! Without TLS, peers prove nothing, and letters are not restricted.

use fipa_transport::{Mandate, Principal};

#[cfg(feature = "secure")]
use std::time::{Duration, SystemTime};

#[cfg(feature = "secure")]
use tokio::time::{Instant, sleep_until};

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
    ///
    /// The remaining time is computed from the calendar once and measured on the monotonic clock:
    /// setting the calendar ahead ends no connection. The calendar is read again when the time is
    /// up.
    pub(crate) async fn withdrawn(&self) -> ConnectionEnd {
        #[cfg(feature = "secure")]
        if let Some((security, certificate)) = &self.certificate {
            let mut changes = security.changes();
            let mut ends = after(certificate.left(SystemTime::now()));
            while security.trusts(certificate.fingerprint()) {
                tokio::select! {
                    changed = changes.changed() => if changed.is_err() {
                        break;
                    },
                    () = sleep_until(ends.min(after(LONGEST_SLEEP))) => {}
                }
                if ends <= Instant::now() {
                    let left = certificate.left(SystemTime::now());
                    if left.is_zero() {
                        return ConnectionEnd::Expired;
                    }
                    ends = after(left);
                }
            }
            return ConnectionEnd::Distrusted;
        }
        std::future::pending().await
    }
}

/// Maximum duration of a timer.
#[cfg(feature = "secure")]
const LONGEST_SLEEP: Duration = Duration::from_secs(86_400);

/// Returns the instant after `time`, which is cut to a century to avoid overflow.
#[cfg(feature = "secure")]
fn after(time: Duration) -> Instant {
    const CENTURY: Duration = Duration::from_secs(100 * 365 * 86_400);
    Instant::now() + time.min(CENTURY)
}
