//! Configurations and messages that several tests use.

#![allow(dead_code, reason = "no test uses all items")]
#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::sync::atomic::{AtomicU32, Ordering};

use fipa::config::Sources;
use fipa::{Agent, AgentId, Config, Domain, Message, Performative};

/// Loads a configuration with these settings alone.
pub(crate) fn load<S: Into<String>>(set: impl IntoIterator<Item = S>) -> Config {
    Config::load(&Sources {
        set: set.into_iter().map(Into::into).collect(),
        ..Sources::default()
    })
    .unwrap()
}

/// Returns a part of a name that no other test uses.
pub(crate) fn mark() -> String {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    format!("{}-{number}", std::process::id())
}

/// Loads a configuration for a domain and a gateway that no other test uses, without mDNS.
pub(crate) fn config(set: &[&str]) -> Config {
    let mark = mark();
    let own = [
        format!("domain=test-{mark}"),
        format!("mts.name=gateway-{mark}"),
        "discovery.mdns=false".to_owned(),
    ];
    let set = set.iter().map(|setting| (*setting).to_owned());
    load(own.into_iter().chain(set))
}

/// Opens two memberships in one domain, which represent two processes.
pub(crate) async fn two(config: &Config) -> (Domain, Domain) {
    let member = || async { Domain::open(config).await.unwrap() };
    (member().await, member().await)
}

/// Builds an `inform` with this content.
pub(crate) fn inform(from: &Agent, to: &str, content: impl AsRef<[u8]>) -> Message {
    from.message(Performative::Inform)
        .receiver(AgentId::new(to).unwrap())
        .content(content.as_ref().to_vec())
        .build()
        .unwrap()
}
