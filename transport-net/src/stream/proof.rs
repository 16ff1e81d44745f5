//! What the peer of a connection has proved about itself, and what follows for its letters.
//!
//! Without TLS nothing is proved, and nothing follows.

use fipa_transport::Principal;

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

    /// Waits until the peer is not trusted any more.
    pub(crate) async fn withdrawn(&self) {
        #[cfg(feature = "secure")]
        if let Some((security, certificate)) = &self.certificate {
            let mut changes = security.changes();
            while security.trusts(certificate.fingerprint()) {
                if changes.changed().await.is_err() {
                    break;
                }
            }
            return;
        }
        std::future::pending().await
    }
}
