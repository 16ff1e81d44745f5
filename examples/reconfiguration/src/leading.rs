//! The lead of the merged robot. Its first member has motors, and an item has none: the item leads only while that
//! member is away.

use fipa::Agent;
use fipa::coalitions::Membership;

/// Gives the lead back when the first member is in the directory.
pub(crate) async fn give_back(agent: Agent, membership: Membership) {
    let directory = agent.domain().directory();
    let (mut entries, mut changes) = (directory.watch(), membership.changes());
    loop {
        let state = membership.state();
        let first = state.members.as_ref().and_then(|it| it.names().first());
        let is_back = first
            .is_some_and(|first| **first != *agent.name() && directory.lookup(first).is_some());
        if state.leads && is_back {
            membership.resign();
        }
        tokio::select! {
            changed = entries.next() => if changed.is_none() {
                return;
            },
            changed = changes.next() => if changed.is_none() {
                return;
            },
        }
    }
}
