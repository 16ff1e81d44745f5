//! Checks the processes of the domain on this host.

use super::{Area, Check, Severity};
use crate::Config;
use crate::admin::stopped::StoppedAgent;

const AREA: Area = Area("processes");

const CHECK: &str = "stopped processes";

/// Adds one check for each stopped process.
pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    // An error has a check of its own, that of the directory of the domain.
    let mut stopped = StoppedAgent::all(config).unwrap_or_default();
    // A process may have several agents.
    stopped.sort_by_key(|it| it.process);
    stopped.dedup_by_key(|it| it.process);
    if stopped.is_empty() {
        checks.push(AREA.fine(CHECK, "no process of an agent is stopped"));
    }
    checks.extend(
        stopped
            .iter()
            .map(|agent| AREA.problem(CHECK, Severity::Warning, agent.to_string(), agent.remedy())),
    );
}
