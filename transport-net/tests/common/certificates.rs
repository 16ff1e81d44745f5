//! Keys and certificates made for one test.

use std::time::{Duration, SystemTime};

use fipa_transport_net::secure::{Certificate, Credentials, Rules, Security, alternative_names};
use rcgen::{CertificateParams, KeyPair, SanType};
use rustls::pki_types::PrivateKeyDer;

/// A host with a key and a certificate of its own.
pub(crate) struct Host {
    pub(crate) certificate: Certificate,
    key: KeyPair,
}

impl Host {
    /// A host whose service has this name and speaks for these agents, or for all when there are
    /// none.
    pub(crate) fn new(name: &str, agents: &[&str]) -> Self {
        let day = Duration::from_secs(86_400);
        let now = SystemTime::now();
        Self::valid(name, agents, now - day, now + day)
    }

    /// One whose certificate holds from then until then.
    pub(crate) fn valid(name: &str, agents: &[&str], from: SystemTime, until: SystemTime) -> Self {
        let agents: Vec<String> = agents.iter().map(|agent| (*agent).to_owned()).collect();
        let mut params = CertificateParams::default();
        params.subject_alt_names = alternative_names(name, &agents)
            .into_iter()
            .map(|uri| SanType::URI(uri.try_into().unwrap()))
            .collect();
        params.not_before = from.into();
        params.not_after = until.into();
        let key = KeyPair::generate().unwrap();
        let signed = params.self_signed(&key).unwrap();
        Self {
            certificate: Certificate::from_der(signed.der().to_vec()).unwrap(),
            key,
        }
    }

    /// What it knows, and whom.
    pub(crate) fn credentials(&self, trusted: &[&Self]) -> Credentials {
        Credentials {
            own: self.certificate.clone(),
            key: PrivateKeyDer::Pkcs8(self.key.serialize_der().into()),
            trusted: trusted
                .iter()
                .map(|host| host.certificate.clone())
                .collect(),
        }
    }

    /// It speaks with these and nobody else, on loopback too.
    pub(crate) fn security(&self, trusted: &[&Self]) -> Security {
        let rules = Rules {
            loopback: true,
            ..Rules::default()
        };
        Security::new(self.credentials(trusted), rules).unwrap()
    }

    /// Somebody who has its certificate, which is no secret, and not its key.
    pub(crate) fn thief(&self) -> Self {
        Self {
            certificate: self.certificate.clone(),
            key: KeyPair::generate().unwrap(),
        }
    }

    /// This certificate, with somebody else's key.
    pub(crate) fn with_key_of(mut self, other: &Self) -> Self {
        self.key = KeyPair::try_from(other.key.serialize_der()).unwrap();
        self
    }
}
