//! Private parts of this crate that the fuzz targets in `fuzz/` call.

use std::time::Instant;

use fipa_transport::Incarnation;

use crate::access::rules::{self, LetterFacts};
use crate::config::{AccessRule, Config, ConfigError, Effective, Sources};

/// Parses and checks a text as the content of `fipa.toml`, with these overrides (`key=value`).
///
/// # Errors
/// Returns all mistakes.
pub fn config(text: &str, set: &[&str]) -> Result<Effective, ConfigError> {
    let sources = Sources {
        set: set.iter().map(|one| (*one).to_owned()).collect(),
        host_name: "here".to_owned(),
        ..Sources::default()
    };
    Effective::of_text(&sources, text.to_owned())
}

/// Runs the questions of gateways about registrations with these letters. Panics if a rule is broken.
#[cfg(feature = "net")]
pub fn presence(bytes: &[u8]) {
    crate::gateway::play_presence(bytes);
}

/// Reads the bytes as the file that a gateway leaves to its successor. Panics if a rule is broken.
#[cfg(feature = "net")]
pub fn gateway_state(bytes: &[u8]) {
    crate::gateway::play_state(bytes);
}

/// The access rules, and the rates of senders.
#[derive(Debug)]
pub struct Access(rules::Access);

/// Entries of rules, each a sender and its receivers.
pub type Lines<'a> = &'a [(&'a str, Vec<&'a str>)];

impl Access {
    /// Creates rules from these entries. Returns `None` if an entry cannot be parsed or there is
    /// nothing to check.
    #[must_use]
    pub fn new(deny: Lines<'_>, allow: Lines<'_>, rate: usize) -> Option<Self> {
        let lines = |lines: Lines<'_>| -> Vec<AccessRule> {
            let lines = lines.iter().map(|(sender, receivers)| AccessRule {
                sender: (*sender).to_owned(),
                receivers: receivers.iter().map(|it| (*it).to_owned()).collect(),
            });
            lines.collect()
        };
        let mut config = Config::for_host("here").access;
        (config.deny, config.allow, config.rate) = (lines(deny), lines(allow), rate);
        config.rules().ok().flatten().map(Self)
    }

    /// Whether the rules allow this letter.
    #[must_use]
    pub fn passes(
        &self,
        sender: &str,
        receiver: &str,
        performative: &str,
        protocol: Option<&str>,
    ) -> bool {
        let facts = LetterFacts {
            sender,
            user: None,
            receiver,
            performative,
            protocol,
            ontology: None,
            action: None,
        };
        self.0.judge(&facts).is_ok()
    }

    /// Whether the sender may send one more letter from the process with this number.
    pub fn may_send(&mut self, source: u64, sender: &str, now: Instant) -> bool {
        let source = fipa_mts::LetterSource::Process(Incarnation::from_u64(source));
        self.0.count(source, sender, now).is_ok()
    }
}
