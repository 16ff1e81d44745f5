//! What the peer of a connection has proved about itself, and what follows for its letters.
//!
//! Without TLS nothing is proved, and nothing follows.

use fipa_transport::{Mandate, Principal};

#[cfg(feature = "secure")]
use std::time::{Duration, SystemTime};

#[cfg(feature = "secure")]
use tokio::time::{Instant, sleep_until};

use crate::end::End;
#[cfg(feature = "secure")]
use crate::secure::{Certificate, Security};

/// What a peer has proved about itself.
#[derive(Debug, Clone, Default)]
pub(crate) struct Proof {
    #[cfg(feature = "secure")]
    certificate: Option<(Security, Certificate)>,
}

impl Proof {
    /// The peer has this certificate and its key.
    #[cfg(feature = "secure")]
    pub(crate) fn of(security: &Security, certificate: Certificate) -> Self {
        Self {
            certificate: Some((security.clone(), certificate)),
        }
    }

    /// What is wrong with a peer that introduces itself by this name.
    pub(crate) fn contradicts(&self, name: &str) -> Option<String> {
        #[cfg(feature = "secure")]
        if let Some((_, certificate)) = &self.certificate {
            let proved = certificate.certified().mts();
            return (proved != name).then(|| {
                format!("it calls itself {name:?}, and its certificate is of {proved:?}")
            });
        }
        let _unproved = name;
        None
    }

    /// Whether the peer may speak for the agent with this name, and take letters for it.
    pub(crate) fn speaks_for(&self, agent: &str) -> bool {
        #[cfg(feature = "secure")]
        if let Some((_, certificate)) = &self.certificate {
            return certificate.certified().speaks_for(agent);
        }
        let _unproved = agent;
        true
    }

    /// The agents that the peer may speak for beside itself.
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

    /// The certificate whose key the peer has, if it has proved one.
    pub(crate) fn principal(&self) -> Option<Principal> {
        #[cfg(feature = "secure")]
        if let Some((_, certificate)) = &self.certificate {
            let fingerprint = certificate.fingerprint();
            return Some(Principal::Certificate(fingerprint.into_bytes()));
        }
        None
    }

    /// Waits until the peer is not trusted any more, or its certificate expires.
    ///
    /// The time until then is taken from the calendar once and counts on the clock that never jumps: a
    /// calendar that is set ahead ends no connection. The calendar is asked again when the time is up.
    pub(crate) async fn withdrawn(&self) -> End {
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
                        return End::Expired;
                    }
                    ends = after(left);
                }
            }
            return End::Distrusted;
        }
        std::future::pending().await
    }
}

/// The longest time for which a timer is set.
#[cfg(feature = "secure")]
const LONGEST_SLEEP: Duration = Duration::from_secs(86_400);

/// So much later; what no clock reaches is cut to a century.
#[cfg(feature = "secure")]
fn after(time: Duration) -> Instant {
    const CENTURY: Duration = Duration::from_secs(100 * 365 * 86_400);
    Instant::now() + time.min(CENTURY)
}
