//! The lead of the merged robot. Its first member has motors, and an item has none: the item leads only while that
//! member is away or does not answer.

use fipa::Agent;
use fipa::coalitions::Membership;

/// Gives the lead back when the first member is in the directory. The agent keeps the lead if that member did not take it
/// the last time, for example because its process is stopped.
pub(crate) async fn give_back(agent: Agent, membership: Membership) {
    let directory = agent.domain().directory();
    let (mut entries, mut changes) = (directory.watch(), membership.changes());
    // The registration of the first member that has not taken the lead.
    let mut given_to = None;
    loop {
        let state = membership.state();
        let members = state.members.as_ref();
        let first = members.and_then(|it| it.names().first());
        let first = first.filter(|first| ***first != *agent.name());
        if first.is_some() && members.and_then(|it| it.leader()) == first {
            given_to = None;
        }
        let back = first.and_then(|first| directory.lookup(first));
        let back = back.map(|entry| entry.incarnation);
        if state.leads && back.is_some() && back != given_to {
            given_to = back;
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
