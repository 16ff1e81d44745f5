//! Failure messages to legacy peers beyond their rates: the rest is reported in one message for each sender.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::Letter;
use fipa_transport::{LegacySource, quota_address};

use super::undelivered::{FailureTarget, Undelivered};
use super::{Core, Now};
use crate::failure::Failed;

/// Time from the first failure without a message of its own until the summary.
const AFTER: Duration = Duration::from_secs(1);
/// Maximum number of senders with a summary.
const MAX_SENDERS: usize = 256;
/// Maximum number of them at one address.
const MAX_OF_ADDRESS: usize = 32;
/// Maximum number of summaries that one call sends.
const AT_ONCE: usize = 16;

/// Failures that are to be reported together, by the address and the name of the sender.
#[derive(Debug, Default)]
pub(super) struct Summaries(BTreeMap<(IpAddr, String), Summary>);

#[derive(Debug)]
struct Summary {
    due: Instant,
    from: LegacySource,
    failed: Arc<Failed>,
    /// The first failure, without the letter.
    first: Undelivered,
}

impl Summaries {
    /// Adds a failure to the summary of its sender. Returns whether there is room for it.
    pub(super) fn add(
        &mut self,
        now: Instant,
        (from, failed): (LegacySource, &Arc<Failed>),
        undelivered: Undelivered,
    ) -> bool {
        let sender = (quota_address(from.address), failed.sender.name().to_owned());
        if let Some(summary) = self.0.get_mut(&sender) {
            summary.first.count = summary.first.count.saturating_add(undelivered.count);
            return true;
        }
        let of_address = self.0.range((sender.0, String::new())..);
        let of_address = of_address.take_while(|((address, _), _)| *address == sender.0);
        if self.0.len() >= MAX_SENDERS || of_address.take(MAX_OF_ADDRESS).count() == MAX_OF_ADDRESS
        {
            return false;
        }
        let first = Undelivered {
            letter: Letter::default(),
            ..undelivered
        };
        let summary = Summary {
            due: now + AFTER,
            from,
            failed: Arc::clone(failed),
            first,
        };
        self.0.insert(sender, summary);
        true
    }

    /// Time of the next summary.
    pub(super) fn due(&self) -> Option<Instant> {
        self.0.values().map(|summary| summary.due).min()
    }

    /// Removes a summary whose time has come.
    fn pop(&mut self, now: Instant) -> Option<Undelivered> {
        let (sender, _) = self.0.iter().find(|(_, summary)| summary.due <= now)?;
        let sender = sender.clone();
        let Summary {
            from,
            failed,
            first,
            ..
        } = self.0.remove(&sender)?;
        Some(Undelivered {
            sender: FailureTarget::LegacyPeer { from, failed },
            ..first
        })
    }
}

impl Core {
    /// Sends the summaries whose time has come. One beyond the rate of its sender waits again.
    pub(super) fn summarize(&mut self, now: Now) {
        for _ in 0..AT_ONCE {
            let Some(summary) = self.summaries.pop(now.instant) else {
                break;
            };
            self.table.undelivered.push_back(summary);
        }
    }
}
