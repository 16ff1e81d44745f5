//! The JSON format of the letters.
//!
//! ```json
//! { "version": 1, "tell": "again" }
//! { "version": 1, "tell": "goodbye" }
//! { "version": 1, "tell": { "full": { "version": 7, "first": true, "last": false, "agents": [agent] } } }
//! { "version": 1, "tell": { "changes": { "from": 7, "to": 9, "agents": [agent], "left": [name] } } }
//! agent = { "name", "type", "id", "description", "registered": milliseconds since 1970, UTC,
//!           "coalition": { "members": [name], "leader": name }, for a coalition; "leader" is left out if
//!                        it is not led, and empty if it has no leader at present
//!           "df": { "entry": text, "lease": remaining milliseconds }, for an agent with an entry
//!                 in the directory facilitator of the gateway; "lease" is left out without one }
//! ```
//!
//! The agents' location is not part of the format: it is that of the gateway that sent the letter.
//! Unknown keys are ignored, so that a later version may add some.

use std::sync::Arc;

use fipa_transport::Incarnation;
use serde::de::Error as _;
use serde::{Deserialize, Serialize};

use super::LetterKind;
use crate::entry::millis_of_time;
use crate::{Entry, Members, Role};

const VERSION: u32 = 1;

#[derive(Debug, Serialize, Deserialize)]
struct Envelope<T> {
    version: u32,
    tell: T,
}

/// One letter.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum ExchangeMessage {
    /// Requests all entries again.
    Again,
    /// The gateway is closing.
    Goodbye,
    Full(Full),
    Changes(Changes),
}

/// Some of the entries of this version. The letters from `first` to `last` contain all.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Full {
    pub(super) version: u64,
    pub(super) first: bool,
    pub(super) last: bool,
    pub(super) agents: Vec<Agent>,
}

/// The changes from one version to a later one.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Changes {
    pub(super) from: u64,
    pub(super) to: u64,
    /// New and changed agents.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) agents: Vec<Agent>,
    /// The names of the agents that are no longer there.
    #[serde(rename = "left", default, skip_serializing_if = "Vec::is_empty")]
    pub(super) removed: Vec<String>,
}

/// Returns the kind of a letter from its beginning, as this library writes it.
pub(super) fn kind(content: &[u8]) -> LetterKind {
    let Some(message) = content.strip_prefix(br#"{"version":1,"tell":{""#) else {
        return LetterKind::Other;
    };
    if message.starts_with(br#"changes":"#) {
        return LetterKind::List;
    }
    let Some(version) = message.strip_prefix(br#"full":{"version":"#) else {
        return LetterKind::Other;
    };
    let digits = version.iter().take_while(|byte| byte.is_ascii_digit());
    let rest = version.get(digits.count()..).unwrap_or_default();
    match rest.starts_with(br#","first":true,"#) {
        true => LetterKind::NewList,
        false => LetterKind::List,
    }
}

#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Agent {
    pub(super) name: String,
    #[serde(rename = "id")]
    pub(super) incarnation: Incarnation,
    #[serde(rename = "type", default, skip_serializing_if = "String::is_empty")]
    pub(super) agent_type: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub(super) description: String,
    pub(super) registered: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) coalition: Option<Members>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) df: Option<DfEntry>,
}

/// The entry of an agent in the directory facilitator of its gateway.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct DfEntry {
    /// The description of the agent in FIPA-SL, without its lease.
    pub(super) entry: String,
    /// The addresses at which agents of other platforms reach the agent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) addresses: Vec<String>,
    /// Milliseconds until the lease ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) lease: Option<u64>,
}

impl Agent {
    pub(super) fn of(entry: &Arc<Entry>, df: Option<DfEntry>) -> Self {
        Self {
            name: entry.name.to_string(),
            incarnation: entry.incarnation,
            agent_type: entry.agent_type.clone(),
            description: entry.description.clone(),
            registered: millis_of_time(entry.registered),
            coalition: match &entry.role {
                Role::Coalition(members) => Some(members.clone()),
                _ => None,
            },
            df,
        }
    }
}

pub(super) fn encode(tell: &ExchangeMessage) -> Vec<u8> {
    let version = VERSION;
    // Serialization of text, numbers and lists cannot fail.
    serde_json::to_vec(&Envelope { version, tell }).unwrap_or_default()
}

pub(super) fn decode(content: &[u8]) -> Result<ExchangeMessage, serde_json::Error> {
    let envelope: Envelope<ExchangeMessage> = serde_json::from_slice(content)?;
    match envelope.version {
        VERSION => Ok(envelope.tell),
        other => Err(serde_json::Error::custom(format!(
            "version {other} is not supported"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use fipa_transport::Incarnation;

    use super::*;
    use crate::{MtsId, Registration, Source};

    const LETTER: &str = concat!(
        r#"{"version":1,"tell":{"full":{"version":3,"first":true,"last":true,"agents":["#,
        r#"{"name":"crane","id":"0000000000000007","type":"arm","registered":1000,"#,
        r#""df":{"entry":"(df-agent-description :languages (set \"a\\n\"))","addresses":["http://10.0.0.1:7778/acc"],"lease":60000}},"#,
        r#"{"name":"rover","id":"0000000000000008","registered":1000,"df":{"entry":""}}]}}}"#
    );

    fn agent(name: &str, number: u64, agent_type: &str, df: DfEntry) -> Agent {
        let mts = MtsId::new("mts", Incarnation::from_u64(1));
        let registration = Registration {
            agent_type: agent_type.to_owned(),
            registered: crate::entry::time_of_millis(1000),
            ..Registration::new(name, Incarnation::from_u64(number), Vec::new())
        };
        let entry = registration.into_entry(&mts, Source::Host).unwrap();
        Agent::of(&Arc::new(entry), Some(df))
    }

    #[test]
    fn a_letter_with_df_entries_has_these_bytes() {
        let of = |entry: &str, lease: Option<u64>| DfEntry {
            entry: entry.to_owned(),
            addresses: lease
                .map(|_| "http://10.0.0.1:7778/acc".to_owned())
                .into_iter()
                .collect(),
            lease,
        };
        let text = r#"(df-agent-description :languages (set "a\n"))"#;
        let letter = ExchangeMessage::Full(Full {
            version: 3,
            first: true,
            last: true,
            agents: vec![
                agent("crane", 7, "arm", of(text, Some(60_000))),
                agent("rover", 8, "", of("", None)),
            ],
        });
        assert_eq!(String::from_utf8(encode(&letter)).unwrap(), LETTER);
        let ExchangeMessage::Full(read) = decode(LETTER.as_bytes()).unwrap() else {
            panic!("another letter");
        };
        assert_eq!(read.agents[0].df, Some(of(text, Some(60_000))));
        assert_eq!(read.agents[1].df, Some(of("", None)));
    }

    #[test]
    fn a_letter_that_is_cut_off_is_malformed() {
        for length in 0..LETTER.len() {
            assert!(decode(&LETTER.as_bytes()[..length]).is_err(), "{length}");
        }
    }

    #[test]
    fn df_entries_of_other_types_are_malformed_and_further_keys_are_ignored() {
        let letter = |df: &str| LETTER.replace(r#"{"entry":""}"#, df);
        for df in [
            r#""text""#,
            "{}",
            r#"{"entry":7}"#,
            r#"{"entry":"","addresses":"http://10.0.0.1:7778/acc"}"#,
            r#"{"entry":"","addresses":[1]}"#,
            r#"{"entry":"","lease":-1}"#,
            r#"{"entry":"","lease":1.5}"#,
            r#"{"entry":"","lease":18446744073709551616}"#,
        ] {
            assert!(decode(letter(df).as_bytes()).is_err(), "{df}");
        }
        let more = letter(r#"{"entry":"x","lease":null,"later":[1]}"#);
        assert!(decode(more.as_bytes()).is_ok());
    }
}
