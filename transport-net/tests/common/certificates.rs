//! Keys and certificates generated for one test.

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
    /// Creates a host whose service has this name and speaks for these agents, or for all if there
    /// are none.
    pub(crate) fn new(name: &str, agents: &[&str]) -> Self {
        let day = Duration::from_secs(86_400);
        let now = SystemTime::now();
        Self::valid(name, agents, now - day, now + day)
    }

    /// Creates a host whose certificate is valid in this period.
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

    /// Creates a host with a certificate of an authority for this host name, which ends at this time.
    pub(crate) fn named(
        name: &str,
        host: &str,
        authority: &rcgen::Issuer<'static, KeyPair>,
        until: SystemTime,
    ) -> Self {
        let mut params = CertificateParams::new([host.to_owned()]).unwrap();
        params.not_after = until.into();
        for uri in alternative_names(name, &[]) {
            params
                .subject_alt_names
                .push(SanType::URI(uri.try_into().unwrap()));
        }
        let key = KeyPair::generate().unwrap();
        let signed = params.signed_by(&key, authority).unwrap();
        Self {
            certificate: Certificate::from_der(signed.der().to_vec()).unwrap(),
            key,
        }
    }

    /// Returns its credentials with these trusted peers.
    pub(crate) fn credentials(&self, trusted: &[&Self]) -> Credentials {
        Credentials {
            own: self.certificate.clone(),
            key: PrivateKeyDer::Pkcs8(self.key.serialize_der().into()),
            trusted: trusted
                .iter()
                .map(|host| host.certificate.clone())
                .collect(),
            revoked: Vec::new(),
        }
    }

    /// Returns its security, which admits only these peers, on loopback too.
    pub(crate) fn security(&self, trusted: &[&Self]) -> Security {
        let rules = Rules {
            loopback: true,
            ..Rules::default()
        };
        Security::new(self.credentials(trusted), rules).unwrap()
    }

    /// Returns a host with the same certificate, which is public, but another key.
    pub(crate) fn thief(&self) -> Self {
        Self {
            certificate: self.certificate.clone(),
            key: KeyPair::generate().unwrap(),
        }
    }

    /// Returns this certificate with the key of another host.
    pub(crate) fn with_key_of(mut self, other: &Self) -> Self {
        self.key = KeyPair::try_from(other.key.serialize_der()).unwrap();
        self
    }
}
