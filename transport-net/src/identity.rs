//! The identity of an endpoint.

use fipa_transport::Incarnation;

/// The identity with which a message transport service introduces itself to its peers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Name of the message transport service; at most [`Identity::MAX_TEXT`] bytes.
    pub name: String,
    /// The incarnation of this service. Must be known: peers identify the service by it, and refuse
    /// another service that has taken over its port.
    pub incarnation: Incarnation,
    /// The domain of the service; at most [`Identity::MAX_TEXT`] bytes.
    pub domain: String,
    /// Identifier of this host, for example its machine id; at most [`Identity::MAX_TEXT`] bytes.
    /// Peers with the same host and domain count as local.
    pub host: String,
}

impl Identity {
    /// Maximum length of a text in an identity, in bytes.
    pub const MAX_TEXT: usize = 255;

    /// Returns an error text when the identity is not valid.
    pub(crate) fn fault(&self) -> Option<String> {
        if !self.incarnation.is_known() {
            return Some("the identity of a network transport needs a known incarnation".into());
        }
        [
            ("name", &self.name),
            ("domain", &self.domain),
            ("host", &self.host),
        ]
        .into_iter()
        .find(|(_, text)| text.len() > Self::MAX_TEXT)
        .map(|(what, text)| {
            let (len, max) = (text.len(), Self::MAX_TEXT);
            format!("the {what} in the identity has {len} bytes; at most {max} are allowed")
        })
    }

    /// Whether the other identity is of another host, or of another domain, which counts as one.
    #[cfg(feature = "ip")]
    pub(crate) fn is_remote(&self, other: &Self) -> bool {
        self.host != other.host || self.domain != other.domain
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identity() -> Identity {
        Identity {
            name: "crex-mts".into(),
            incarnation: Incarnation::from_u64(1),
            domain: "default".into(),
            host: "crex".into(),
        }
    }

    #[test]
    fn an_identity_that_does_not_fit_a_hello_is_reported() {
        assert_eq!(identity().fault(), None);
        let unknown = Identity {
            incarnation: Incarnation::UNKNOWN,
            ..identity()
        };
        assert!(unknown.fault().unwrap().contains("incarnation"));
        let long = Identity {
            domain: "x".repeat(256),
            ..identity()
        };
        assert!(long.fault().unwrap().contains("domain"));
    }

    #[cfg(feature = "ip")]
    #[test]
    fn another_host_or_another_domain_is_remote() {
        let other_host = Identity {
            host: "sherpa".into(),
            ..identity()
        };
        let other_domain = Identity {
            domain: "test".into(),
            ..identity()
        };
        assert!(!identity().is_remote(&identity()));
        assert!(identity().is_remote(&other_host));
        assert!(identity().is_remote(&other_domain));
    }
}
