//! The proved identity of the peer of a connection, and its consequences for letters.
//!
//! Without TLS, peers prove nothing, and letters are not restricted. A transport reads no letter and
//! writes none after [`Proof::check`] has failed: frames are read and written by `link`, HTTP by
//! `http::guarded`.

use fipa_transport::{Mandate, Principal};

#[cfg(feature = "secure")]
use std::sync::Arc;

use crate::end::ConnectionEnd;
#[cfg(feature = "secure")]
use crate::secure::{Certificate, Trust};

/// The proved identity of a peer.
#[derive(Debug, Clone, Default)]
pub(crate) struct Proof {
    #[cfg(feature = "secure")]
    trust: Option<Arc<Trust>>,
}

#[cfg(feature = "secure")]
impl From<Trust> for Proof {
    fn from(trust: Trust) -> Self {
        Self {
            trust: Some(Arc::new(trust)),
        }
    }
}

impl Proof {
    /// Returns the trusted certificate whose key the peer has proved to have.
    #[cfg(feature = "secure")]
    fn certificate(&self) -> Option<&Certificate> {
        self.trust.as_ref()?.certificate()
    }

    /// Returns an error text when the certificate names another service than `name`.
    pub(crate) fn contradicts(&self, name: &str) -> Option<String> {
        #[cfg(feature = "secure")]
        if let Some(certificate) = self.certificate() {
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
        if let Some(certificate) = self.certificate() {
            return certificate.certified().speaks_for(agent);
        }
        let _unproved = agent;
        true
    }

    /// Returns the agents that the peer may speak for.
    pub(crate) fn mandate(&self) -> Mandate {
        #[cfg(feature = "secure")]
        if let Some(certificate) = self.certificate() {
            return certificate.certified().mandate().clone();
        }
        Mandate::Unproved
    }

    /// Whether there are agents that the peer may not speak for.
    pub(crate) fn restricts(&self) -> bool {
        #[cfg(feature = "secure")]
        if let Some(certificate) = self.certificate() {
            return !certificate.certified().agents().is_empty();
        }
        false
    }

    /// Returns the certificate whose key the peer has proved to have, if any.
    pub(crate) fn principal(&self) -> Option<Principal> {
        #[cfg(feature = "secure")]
        if let Some(certificate) = self.certificate() {
            let fingerprint = certificate.fingerprint();
            return Some(Principal::Certificate(fingerprint.into_bytes()));
        }
        None
    }

    /// Checks that what the peer has proved still counts. Once it does not, every check fails.
    ///
    /// # Errors
    /// The reason for which the connection ends.
    pub(crate) fn check(&self) -> Result<(), ConnectionEnd> {
        #[cfg(feature = "secure")]
        if let Some(trust) = &self.trust {
            return trust.check();
        }
        Ok(())
    }

    /// Whether the peer has proved an identity that is no longer trusted. One that has expired still is.
    #[cfg(all(feature = "secure", feature = "http"))]
    pub(crate) fn is_distrusted(&self) -> bool {
        matches!(self.check(), Err(ConnectionEnd::Distrusted))
    }

    /// Waits until what the peer has proved no longer counts.
    pub(crate) async fn withdrawn(&self) -> ConnectionEnd {
        #[cfg(feature = "secure")]
        if let Some(trust) = &self.trust {
            return trust.ended().await;
        }
        std::future::pending().await
    }
}
