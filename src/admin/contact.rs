//! Agents of other platforms, such as JADE, at an address that the caller states.
//!
//! An agent that no directory lists is reached at an address of its identifier after the process has
//! [introduced](introduce) it to the gateway of its host. It is then in the directory of all
//! processes of the host, as if a letter of it had arrived.
//!
//! The introduction is a `request` to the gateway with the [`ONTOLOGY`]. Its content is JSON, the
//! answer an `inform` without content or a `refuse` with the reason:
//!
//! ```json
//! { "version": 1, "name": "echo@jade", "addresses": ["http://10.0.0.7:7778/acc"] }
//! ```
//!
//! `"received": true` says that the identifier was decoded: the gateway then dials its addresses only within the rules
//! of [`fipa_mts::dial`], and resolves host names once. Gateways accept introductions from processes of their own host
//! only.

use std::time::Duration;

use fipa_acl::{AgentId, Performative, escape};
use fipa_sds::Entry;
use fipa_transport::{Location, LocationError, Signature};
use serde::{Deserialize, Serialize};

use crate::Agent;
use crate::admin::routes::{self, AskError};

/// The ontology of an introduction.
pub const ONTOLOGY: &str = "fipa-mts-contact";

const VERSION: u32 = 1;

/// Maximum length of the content of an introduction, in bytes.
#[cfg(feature = "net")]
const MAX_CONTENT: usize = 8 << 10;

/// The error of [`introduce`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IntroduceError {
    /// The identifier has no address.
    #[error("the identifier of {} has no address", escape(.0))]
    NoAddress(String),
    /// An address is not a location of a legacy peer or platform.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// The gateway could not be asked.
    #[error("cannot introduce the agent to the gateway")]
    Ask(#[from] AskError),
    /// The gateway refused the introduction.
    #[error("the gateway refused the introduction: {}", escape(.0))]
    Refused(String),
}

/// An address at which no agent of a legacy peer or platform can be.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AddressError {
    /// The text is not an address.
    #[error("{} is not an address", escape(text))]
    Malformed {
        /// The text.
        text: String,
        /// The cause.
        source: LocationError,
    },
    /// It is the address of a service of this project, which announces its agents by itself.
    #[error(
        "{} is no address of a legacy peer; use http://host:port/acc for a platform, or append \
         ;fipa-services or ;jade",
        escape(.0)
    )]
    OwnProtocol(String),
}

#[derive(Debug, Serialize, Deserialize)]
struct Introduction {
    version: u32,
    name: String,
    addresses: Vec<String>,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    received: bool,
}

/// Maximum number of addresses of an identifier that are used.
pub(crate) const MAX_ADDRESSES: usize = Entry::MAX_LOCATIONS;

/// Introduces an agent of another platform to the gateway of this agent's host, at the first
/// addresses in its identifier, at most 8. The gateway uses those for which it has a transport, in their order: the next
/// one after a letter was certainly not sent to the one before. Of a [received](AgentId::is_received) identifier it uses
/// those that it may dial. Messages that reach the calling agent in the meantime are lost, so use an agent that serves
/// no other purpose. [`Agent::send`] introduces receivers with addresses by itself.
///
/// # Errors
/// If the identifier has no address, an address is not usable, the gateway cannot be asked within
/// `timeout`, or it refuses, for example because a directory lists another agent of this name.
pub async fn introduce(
    agent: &Agent,
    gateway: &Entry,
    id: &AgentId,
    timeout: Duration,
) -> Result<(), IntroduceError> {
    let addresses = id.addresses().iter().take(MAX_ADDRESSES);
    let mut addresses: Vec<String> = addresses.map(|it| (**it).to_owned()).collect();
    if id.is_received() {
        // Its platform may have addresses of other protocols, too.
        addresses.retain(|address| location(address).is_ok());
    }
    if addresses.is_empty() {
        return Err(IntroduceError::NoAddress(id.name().to_owned()));
    }
    for address in &addresses {
        location(address)?;
    }
    let introduction = Introduction {
        version: VERSION,
        name: id.name().to_owned(),
        addresses,
        received: id.is_received(),
    };
    let content = serde_json::to_string(&introduction)
        .map_err(|error| AskError::NotUnderstood(error.to_string()))?;
    let answer = routes::ask(agent, gateway, (ONTOLOGY, Some(content)), timeout).await?;
    match *answer.performative() {
        Performative::Inform => {
            agent.domain().inner.introductions.accepted(id);
            Ok(())
        }
        _ => {
            let reason = answer.content().map(|bytes| &bytes[..]).unwrap_or_default();
            let reason = String::from_utf8_lossy(reason).into_owned();
            Err(IntroduceError::Refused(reason))
        }
    }
}

/// Parses an address of an agent of a legacy peer or platform.
///
/// # Errors
/// If the text is not such an address.
pub fn location(text: &str) -> Result<Location, AddressError> {
    let location: Location = text.parse().map_err(|source| AddressError::Malformed {
        text: text.to_owned(),
        source,
    })?;
    match location.signature() {
        Signature::Frames => Err(AddressError::OwnProtocol(text.to_owned())),
        _ => Ok(location),
    }
}

/// An introduction that was read.
#[cfg(feature = "net")]
#[derive(Debug)]
pub(crate) struct Introduced {
    /// The name of the agent.
    pub(crate) name: String,
    /// Its locations, the preferred one first.
    pub(crate) locations: Vec<Location>,
    /// Whether they come from a decoded identifier.
    pub(crate) is_received: bool,
}

/// Reads an introduction.
///
/// # Errors
/// The reason why it is not one.
#[cfg(feature = "net")]
pub(crate) fn read(content: &[u8]) -> Result<Introduced, String> {
    if content.len() > MAX_CONTENT {
        return Err(format!("the content has more than {MAX_CONTENT} bytes"));
    }
    let introduction: Introduction =
        serde_json::from_slice(content).map_err(|error| error.to_string())?;
    if introduction.version != VERSION {
        return Err(format!("version {} is not supported", introduction.version));
    }
    let locations = introduction.addresses.iter().take(MAX_ADDRESSES);
    let locations: Result<Vec<Location>, AddressError> =
        locations.map(|address| location(address)).collect();
    let locations = locations.map_err(|error| error.to_string())?;
    Ok(Introduced {
        name: introduction.name,
        locations,
        is_received: introduction.received,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_addresses_of_legacy_peers_are_accepted() {
        assert!(location("http://10.0.0.7:7778/acc").is_ok());
        assert!(location("tcp://10.0.0.7:6789;fipa-services").is_ok());
        let own = location("tcp://10.0.0.7:7788");
        assert!(matches!(own, Err(AddressError::OwnProtocol(_))), "{own:?}");
        let malformed = location("jade");
        assert!(matches!(malformed, Err(AddressError::Malformed { .. })));
    }

    #[cfg(feature = "net")]
    #[test]
    fn an_introduction_that_is_malformed_or_too_long_is_refused() {
        let good = r#"{"version":1,"name":"echo@jade","addresses":["http://10.0.0.7:7778/acc"]}"#;
        let read_good = read(good.as_bytes()).unwrap();
        assert_eq!(
            (read_good.name.as_str(), read_good.locations.len()),
            ("echo@jade", 1)
        );
        assert!(!read_good.is_received);
        let received = good.replace("]}", "],\"received\":true}");
        assert!(read(received.as_bytes()).unwrap().is_received);
        for bad in [
            "",
            "{}",
            &good.replace(":1,", ":2,"),
            &good.replace("http", "tcp"),
            &good.replace("echo", &"e".repeat(MAX_CONTENT)),
        ] {
            assert!(read(bad.as_bytes()).is_err(), "{bad}");
        }
    }
}
