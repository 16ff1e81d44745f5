//! What the interfaces report in JSON.

use fipa::coalitions::CoalitionState;
use fipa::protocol::Bids;
use fipa::{AgentId, Change, Message};
use serde_json::{Value, json};

/// Lists the changes of a directory that took effect at once one by one: objects with `change` (`joined`, `changed`,
/// `left` or `lagged`) and `agent`.
#[must_use]
pub fn flattened(change: &Change) -> Vec<Value> {
    match change {
        Change::Joined(entry) => vec![json!({ "change": "joined", "agent": entry })],
        Change::Changed { after, .. } => vec![json!({ "change": "changed", "agent": after })],
        Change::Left(entry) => vec![json!({ "change": "left", "agent": entry })],
        Change::Lagged => vec![json!({ "change": "lagged" })],
        Change::Together(changes) => changes.iter().flat_map(flattened).collect(),
    }
}

/// Reports the state of a coalition: `members`, `leader` (null if there is none at present) and `leads`.
#[must_use]
pub fn coalition(state: &CoalitionState) -> Value {
    let members = state.members.as_ref();
    json!({
        "members": members.map(|members| members.names()),
        "leader": members.and_then(|members| members.leader()),
        "leads": state.leads,
    })
}

/// Reports the answers to a call for proposals: the number of `proposals`, and the agents that have answered otherwise.
/// The `refusals` are objects with `agent` and `reason`.
#[must_use]
pub fn bids(bids: &Bids) -> Value {
    let refusals: Vec<Value> = bids.refusals.iter().map(refusal).collect();
    let violations: Vec<String> = bids.violations.iter().map(ToString::to_string).collect();
    json!({
        "proposals": bids.proposals.len(),
        "refusals": refusals,
        "silent": bids.silent,
        "unreached": bids.unreached,
        "gone": bids.gone,
        "violations": violations,
    })
}

fn refusal(message: &Message) -> Value {
    json!({
        "agent": message.sender().map(AgentId::name),
        "reason": String::from_utf8_lossy(message.content().map_or(&[][..], |content| content)),
    })
}
