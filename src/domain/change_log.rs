//! Log lines about agents that join and leave, at the level `info`. A process whose subscriber takes no such lines
//! starts no task for them.

use std::sync::Arc;

use fipa_acl::escape_name;
use fipa_sds::{Change, Directory, Entry, Reach, Watch};
use fipa_transport::log_limit;
use tokio::runtime::Handle;
use tokio::task::JoinHandle;
use tracing::Level;

/// Starts a task that logs the agents in the directory and their changes. Returns `None` without a subscriber for
/// these lines.
pub(crate) fn start(view: &dyn Directory, runtime: &Handle) -> Option<JoinHandle<()>> {
    if !tracing::enabled!(Level::INFO) {
        return None;
    }
    let changes = view.watch();
    let present = view.entries();
    Some(runtime.spawn(run(present.iter().cloned().collect(), changes)))
}

async fn run(present: Vec<Arc<Entry>>, mut changes: Watch) {
    for entry in &present {
        log_entry("present", entry);
    }
    drop(present);
    while let Some(change) = changes.next().await {
        log(&change);
    }
}

fn log(change: &Change) {
    match change {
        Change::Together(changes) => changes.iter().for_each(log),
        Change::Joined(entry) => log_entry("joined", entry),
        Change::Changed { after, .. } => log_entry("changed", after),
        Change::Left(entry) => log_entry("left", entry),
        Change::Lagged => log_limit::info!("some changes are not listed: too many at once"),
    }
}

fn log_entry(change: &str, entry: &Entry) {
    let reach = match entry.reach {
        Reach::Local => "this host",
        Reach::Remote { .. } => "another host",
    };
    log_limit::info!(
        of: &*entry.name, name = %escape_name(&entry.name),
        reach,
        mts = %escape_name(entry.mts.shown()),
        "{change}"
    );
}
