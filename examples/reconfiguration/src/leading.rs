//! The lead of the merged robot. Its first member has motors, and an item has none: the item leads only while that
//! member is away or does not answer.

use std::time::Duration;

use fipa::Agent;
use fipa::coalitions::Membership;
use tokio::time::{Instant, sleep_until};

/// Time from one offer of the lead to the next one, if the first member did not take it: its process may be stopped.
const PAUSE: Duration = Duration::from_secs(4);
const MAX_PAUSE: Duration = Duration::from_secs(60);

/// Gives the lead back when the first member is in the directory. Offers that the member does not take become rare.
pub(crate) async fn give_back(agent: Agent, membership: Membership) {
    let directory = agent.domain().directory();
    let (mut entries, mut changes) = (directory.watch(), membership.changes());
    let (mut pause, mut next) = (PAUSE, Instant::now());
    loop {
        let state = membership.state();
        let members = state.members.as_ref();
        let first = members.and_then(|it| it.names().first());
        let first = first.filter(|first| ***first != *agent.name());
        if first.is_some() && members.and_then(|it| it.leader()) == first {
            (pause, next) = (PAUSE, Instant::now());
        }
        let is_back = first.is_some_and(|first| directory.lookup(first).is_some());
        let waits = state.leads && is_back;
        if waits && Instant::now() >= next {
            membership.resign();
            next = Instant::now() + pause;
            pause = MAX_PAUSE.min(pause * 2);
        }
        tokio::select! {
            changed = entries.next() => if changed.is_none() {
                return;
            },
            changed = changes.next() => if changed.is_none() {
                return;
            },
            () = sleep_until(next), if waits => {}
        }
    }
}
