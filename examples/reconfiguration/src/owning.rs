//! The resources that an agent owns.

use std::sync::Arc;

use fipa::Agent;
use fipa::coalitions::CoalitionOptions;
use fipa::locks::{OwnError, OwnOptions, Owned, OwnerEvent};
use tokio::sync::Notify;

use crate::LEASE;
use crate::report::Reporter;

/// The options of the locks of this application. Its domains are new, so that no earlier owner exists.
fn own_options() -> OwnOptions {
    OwnOptions {
        lease: LEASE,
        volatile: true,
        forget: true,
        ..OwnOptions::default()
    }
}

/// The options of the coalition.
pub(crate) fn coalition_options() -> CoalitionOptions {
    CoalitionOptions {
        lock: own_options(),
        ..CoalitionOptions::default()
    }
}

/// Owns two resources, and reports their grants. `ended` is notified at the end of each.
pub(crate) async fn own_all(
    agent: &Agent,
    [one, other]: &[String; 2],
    reporter: &Reporter,
    ended: &Arc<Notify>,
) -> Result<[Arc<Owned>; 2], OwnError> {
    let (one, other) = tokio::try_join!(
        agent.own(one, own_options()),
        agent.own(other, own_options())
    )?;
    let owned = [one, other].map(Arc::new);
    for owned in &owned {
        let (owned, reporter, ended) = (Arc::clone(owned), reporter.clone(), Arc::clone(ended));
        tokio::spawn(async move {
            while let Some(event) = owned.next().await {
                let is_end = matches!(event, OwnerEvent::Ended { .. });
                reporter.owner(owned.resource(), event);
                if is_end {
                    ended.notify_one();
                }
            }
        });
    }
    Ok(owned)
}
