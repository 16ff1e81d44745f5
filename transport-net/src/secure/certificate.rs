//! The contents of a certificate: its message transport service, the agents that this service may
//! speak for, and its validity.
//!
//! Service and agents are URIs in the subject alternative names (RFC 5280 section 4.2.1.6):
//! `urn:fipa:mts:NAME`, exactly once, and `urn:fipa:agent:NAME` for each agent; without any the
//! service may speak for every agent. Names are percent-encoded UTF-8; an agent's name that ends
//! with `*` stands for all names with that prefix. Names are checked when they are decoded. The agents of the
//! platform itself, `ams@NAME` and `df@NAME` (FIPA00023 clause 4), need no mention.
//!
//! Decisions about trust do not belong here.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use fipa_acl::{escape, is_pattern, misleading_character};
use fipa_transport::Mandate;
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, percent_decode_str, utf8_percent_encode};
use ring::digest::{SHA256, SHA256_OUTPUT_LEN, digest};
use rustls::pki_types::{CertificateDer, UnixTime};
use x509_parser::prelude::{FromDer, GeneralName, X509Certificate};

const MTS: &str = "urn:fipa:mts:";
const AGENT: &str = "urn:fipa:agent:";

/// Characters that are not escaped in a URI (RFC 3986 section 2.3).
const KEPT: &AsciiSet = &NON_ALPHANUMERIC
    .remove(b'-')
    .remove(b'.')
    .remove(b'_')
    .remove(b'~');

/// Maximum length of a name, in bytes.
const MAX_NAME: usize = 1024;

/// The local names of the agents of a platform.
const PLATFORM_AGENTS: [&str; 2] = ["ams", "df"];

/// Maximum number of agents in a certificate.
const MAX_AGENTS: usize = 1024;

/// The SHA-256 of a certificate's DER form; shown as 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Fingerprint([u8; SHA256_OUTPUT_LEN]);

impl Fingerprint {
    pub(super) fn of(certificate: &[u8]) -> Self {
        let mut fingerprint = [0; SHA256_OUTPUT_LEN];
        fingerprint.copy_from_slice(digest(&SHA256, certificate).as_ref());
        Self(fingerprint)
    }

    /// Returns the bytes.
    #[must_use]
    pub fn into_bytes(self) -> [u8; SHA256_OUTPUT_LEN] {
        self.0
    }
}

impl From<[u8; SHA256_OUTPUT_LEN]> for Fingerprint {
    fn from(fingerprint: [u8; SHA256_OUTPUT_LEN]) -> Self {
        Self(fingerprint)
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A parsed certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Certificate {
    der: CertificateDer<'static>,
    fingerprint: Fingerprint,
    certified: Arc<Certified>,
    /// In seconds since 1970-01-01 00:00 UTC.
    from: i64,
    until: i64,
}

/// The service of a certificate, and the agents that it may speak for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Certified {
    mts: String,
    /// The agents that the certificate names.
    agents: Vec<String>,
    /// Always [`Mandate::Certified`], with these agents and those of the platform.
    mandate: Mandate,
}

/// The reason for which a certificate cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CertificateError {
    /// The certificate is longer than 64 KiB.
    #[error("the certificate has {0} bytes; at most {max} are allowed", max = Certificate::MAX_LEN)]
    TooLong(usize),
    /// The bytes are not an X.509 certificate.
    #[error("not an X.509 certificate: {}", escape(.0))]
    Malformed(String),
    /// The certificate names no message transport service, or several.
    #[error(
        "the certificate names {0} message transport services ({MTS}…); exactly one is required"
    )]
    Services(usize),
    /// The certificate names more than 1,024 agents.
    #[error("the certificate names more than {MAX_AGENTS} agents")]
    Agents,
    /// A name is not UTF-8, empty, longer than 1,024 bytes, or has
    /// [misleading characters](fipa_acl::misleading_character).
    #[error(
        "{}: not a name (1 to {MAX_NAME} bytes of UTF-8 without control, format and invisible \
         characters, and without blanks at its ends)",
        escape(.0)
    )]
    Name(String),
    /// The name of the service is a pattern, so no gateway has it.
    #[error(
        "the certificate names the gateway {}, which is a pattern; give the gateway a name (mts.name) \
         without any of * + ? [ ( {{ | ^ $ \\",
        escape(.0)
    )]
    Gateway(String),
    /// The name of an agent is a pattern beyond a `*` at its end, so it stands for no agent.
    #[error(
        "the certificate names the agent {}; only a * at the end stands for other characters, as in \
         {}*, and + ? [ ( {{ | ^ $ \\ are in no name",
        escape(.0), escape(beginning(.0))
    )]
    Agent(String),
}

impl Certificate {
    /// Maximum length of a certificate, in bytes.
    pub const MAX_LEN: usize = 64 * 1024;

    /// Parses a certificate in DER form.
    ///
    /// # Errors
    /// When the bytes are not a certificate, or the certificate names no service.
    pub fn from_der(der: Vec<u8>) -> Result<Self, CertificateError> {
        if der.len() > Certificate::MAX_LEN {
            return Err(CertificateError::TooLong(der.len()));
        }
        let malformed = |error: &dyn fmt::Display| CertificateError::Malformed(error.to_string());
        let (rest, read) = X509Certificate::from_der(&der).map_err(|error| malformed(&error))?;
        if !rest.is_empty() {
            return Err(malformed(&format_args!("{} bytes behind it", rest.len())));
        }
        let names = read.subject_alternative_name();
        let names = names.map_err(|error| malformed(&error))?;
        let names = names.map_or(&[][..], |names| &names.value.general_names);
        let certified = Certified::of(names)?;
        let validity = read.validity();
        let (from, until) = (validity.not_before, validity.not_after);
        Ok(Self {
            fingerprint: Fingerprint::of(&der),
            certified: Arc::new(certified),
            from: from.timestamp(),
            until: until.timestamp(),
            der: der.into(),
        })
    }

    /// Returns the certificate in DER form.
    #[must_use]
    pub fn der(&self) -> &CertificateDer<'static> {
        &self.der
    }

    /// Returns the fingerprint, which identifies the certificate.
    #[must_use]
    pub fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    /// Returns the service and agents of the certificate.
    #[must_use]
    pub fn certified(&self) -> &Arc<Certified> {
        &self.certified
    }

    /// Returns the first and the last second at which the certificate is valid, since 1970-01-01
    /// 00:00 UTC.
    #[must_use]
    pub fn validity(&self) -> (i64, i64) {
        (self.from, self.until)
    }

    /// Returns the time from `now` until the certificate expires.
    pub(crate) fn time_left(&self, now: SystemTime) -> Duration {
        left_until(self.until, now)
    }

    /// Returns whether the certificate is valid at this time.
    pub(super) fn holds(&self, now: UnixTime) -> Holds {
        let now = i64::try_from(now.as_secs()).unwrap_or(i64::MAX);
        match now {
            now if now < self.from => Holds::NotYet,
            now if now > self.until => Holds::NoMore,
            _ => Holds::Now,
        }
    }
}

/// Returns the time from `now` until this last second of a validity is over.
pub(super) fn left_until(last: i64, now: SystemTime) -> Duration {
    let last = u64::try_from(last).unwrap_or(0);
    let end = Duration::from_secs(last.saturating_add(1));
    end.saturating_sub(now.duration_since(UNIX_EPOCH).unwrap_or_default())
}

/// Returns the last second at which a certificate in DER form is valid. `None` if it cannot be parsed.
#[cfg(feature = "http")]
pub(super) fn last_second(der: &[u8]) -> Option<i64> {
    if der.len() > Certificate::MAX_LEN {
        return None;
    }
    let (_, read) = X509Certificate::from_der(der).ok()?;
    Some(read.validity().not_after.timestamp())
}

/// The validity of a certificate at some time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Holds {
    NotYet,
    Now,
    NoMore,
}

impl Certified {
    fn of(names: &[GeneralName<'_>]) -> Result<Self, CertificateError> {
        let mut services = Vec::new();
        let mut agents = Vec::new();
        for name in names {
            let GeneralName::URI(uri) = name else {
                continue;
            };
            if let Some(encoded) = uri.strip_prefix(MTS) {
                let name = decoded(encoded)?;
                if is_pattern(&name) {
                    return Err(CertificateError::Gateway(name));
                }
                services.push(name);
            } else if let Some(encoded) = uri.strip_prefix(AGENT) {
                let name = decoded(encoded)?;
                if is_pattern(name.strip_suffix('*').unwrap_or(&name)) {
                    return Err(CertificateError::Agent(name));
                }
                agents.push(name);
            }
        }
        if agents.len() > MAX_AGENTS {
            return Err(CertificateError::Agents);
        }
        match <[String; 1]>::try_from(services) {
            Ok([mts]) => {
                let mut mandate = agents.clone();
                if !mandate.is_empty() {
                    mandate.extend(PLATFORM_AGENTS.map(|agent| format!("{agent}@{mts}")));
                }
                Ok(Self {
                    mts,
                    agents,
                    mandate: Mandate::Certified(mandate.into()),
                })
            }
            Err(services) => Err(CertificateError::Services(services.len())),
        }
    }

    /// Returns the name of the message transport service.
    #[must_use]
    pub fn mts(&self) -> &str {
        &self.mts
    }

    /// Returns the agents that the certificate names, which the service may speak for; a name that ends with `*` stands for all
    /// names with that prefix. Empty when the service may speak for every agent.
    #[must_use]
    pub fn agents(&self) -> &[String] {
        &self.agents
    }

    /// Whether the service may speak for the agent with this name: one that the certificate names, the
    /// service itself, or its `ams@NAME` or `df@NAME`.
    #[must_use]
    pub fn speaks_for(&self, name: &str) -> bool {
        self.mts == name || self.mandate.speaks_for(name)
    }

    /// Returns the agents that the service may speak for beside itself.
    pub(crate) fn mandate(&self) -> &Mandate {
        &self.mandate
    }
}

/// Parses the contents of a certificate with these URIs in its alternative names.
///
/// # Errors
/// When they cannot be used.
#[cfg(feature = "fuzzing")]
pub fn certified(uris: &[&str]) -> Result<Certified, CertificateError> {
    let names: Vec<GeneralName<'_>> = uris.iter().map(|uri| GeneralName::URI(uri)).collect();
    Certified::of(&names)
}

fn decoded(encoded: &str) -> Result<String, CertificateError> {
    let name = percent_decode_str(encoded).decode_utf8();
    match name {
        Ok(name) if is_name(&name) => Ok(name.into_owned()),
        _ => Err(CertificateError::Name(encoded.chars().take(80).collect())),
    }
}

/// Whether this is a valid name of a service or agent, or a valid prefix of an agent's name. A name
/// that is shown to the owner for a decision about trust must not look like another one.
fn is_name(name: &str) -> bool {
    !name.is_empty() && name.len() <= MAX_NAME && misleading_character(name).is_none()
}

/// Returns the part of a name before its first character of patterns.
fn beginning(name: &str) -> &str {
    let mut characters = name.char_indices();
    let first = characters.find(|(_, c)| is_pattern(c.encode_utf8(&mut [0; 4])));
    let end = first.map_or(name.len(), |(at, _)| at);
    name.get(..end).unwrap_or_default()
}

/// Returns the alternative names of a certificate with this service and these agents.
#[must_use]
pub fn alternative_names(mts: &str, agents: &[String]) -> Vec<String> {
    let encoded = |prefix: &str, name: &str| format!("{prefix}{}", utf8_percent_encode(name, KEPT));
    let mut names = vec![encoded(MTS, mts)];
    names.extend(agents.iter().map(|agent| encoded(AGENT, agent)));
    names
}
