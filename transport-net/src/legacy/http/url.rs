//! Addresses of HTTP: `host:port/path`, the part of a URL behind `http://` or `https://`.

use std::fmt;

use fipa_transport::Kind;

use crate::address::{self, AddressError};

/// The port of an address without one; JADE's.
pub(super) const DEFAULT_PORT: u16 = 7778;

/// The path of an address without one, and of this project's endpoints.
pub(super) const PATH: &str = "/acc";

/// The address of a platform.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Url {
    /// Host and port, as needed for dialing.
    target: String,
    path: String,
    scheme: Kind,
}

impl Url {
    /// Parses the address of a location of this kind.
    ///
    /// # Errors
    /// When the text is not an address with an optional port and path.
    pub(super) fn parse(scheme: Kind, address: &str) -> Result<Self, AddressError> {
        let (authority, path) = match address.find('/') {
            Some(at) => address.split_at(at),
            None => (address, PATH),
        };
        let has_port = match authority.rfind(']') {
            Some(end) => authority.len() > end + 1,
            None => authority.contains(':'),
        };
        let target = match has_port {
            true => authority.to_owned(),
            false => format!("{authority}:{DEFAULT_PORT}"),
        };
        address::target(&target)?;
        if !path.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err(AddressError::Syntax(address.chars().take(80).collect()));
        }
        Ok(Self {
            target,
            path: path.to_owned(),
            scheme,
        })
    }

    /// Host and port, for dialing.
    pub(super) fn target(&self) -> &str {
        &self.target
    }

    /// The host without its port, the scope and the brackets of an IPv6 address.
    #[cfg(feature = "secure")]
    pub(super) fn name(&self) -> &str {
        let host = self
            .target
            .rsplit_once(':')
            .map_or(&*self.target, |(host, _)| host);
        let host = host.strip_prefix('[').unwrap_or(host);
        let host = host.strip_suffix(']').unwrap_or(host);
        host.split('%').next().unwrap_or(host)
    }

    /// Host and port for a request. The scope of an IPv6 address is not sent (RFC 6874 clause 4).
    pub(super) fn host(&self) -> String {
        match self.target.split_once('%') {
            Some((address, rest)) => {
                let behind = rest.split_once(']').map_or("", |(_, behind)| behind);
                format!("{address}]{behind}")
            }
            None => self.target.clone(),
        }
    }
}

impl fmt::Display for Url {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}{}", self.scheme, self.host(), self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_and_path_have_defaults() {
        for (address, target, url) in [
            ("10.0.0.1", "10.0.0.1:7778", "http://10.0.0.1:7778/acc"),
            (
                "jade.local/x/y",
                "jade.local:7778",
                "http://jade.local:7778/x/y",
            ),
            ("[::1]:80", "[::1]:80", "http://[::1]:80/acc"),
            ("[::1]/acc", "[::1]:7778", "http://[::1]:7778/acc"),
            ("[fe80::1%7]:1/", "[fe80::1%7]:1", "http://[fe80::1]:1/"),
        ] {
            let parsed = Url::parse(Kind::Http, address).unwrap();
            assert_eq!(parsed.target(), target);
            assert_eq!(parsed.to_string(), url);
        }
        let secure = Url::parse(Kind::Https, "[fe80::1%7]:1/x").unwrap();
        assert_eq!(secure.to_string(), "https://[fe80::1]:1/x");
        for wrong in [
            "",
            "/acc",
            ":1/acc",
            "a:b@c:1/acc",
            "10.0.0.1:x",
            "a:1/\u{e9}",
        ] {
            assert!(Url::parse(Kind::Https, wrong).is_err(), "{wrong}");
        }
    }
}
