//! The reports of the processes: what each of them claims to have done or seen. Together, they are the recording.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::time::{SystemTime, UNIX_EPOCH};

use fipa::error::ErrorChain;
use fipa::locks::{AdmitError, Fence, OwnerEvent};
use fipa::{Agent, MessageBuilder};
use serde::{Deserialize, Serialize};

use crate::face::{Contact, Face};
use crate::geometry::Pose;

/// A claim of one process, one JSON document in a line.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[expect(clippy::exhaustive_structs, reason = "it is the form of the recording")]
pub struct Report {
    /// The time in microseconds since 1970, by the clock of the machine.
    pub at: u64,
    /// The name of the process.
    pub by: String,
    /// The claim.
    #[serde(flatten)]
    pub claim: Claim,
}

/// A claim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "claim", rename_all = "snake_case")]
#[expect(missing_docs, reason = "the names of the fields say what they are")]
#[non_exhaustive]
pub enum Claim {
    /// The process is ready.
    Ready,
    /// The launcher has started the scenario.
    Started { fault: String, seed: u64 },
    /// The launcher has caused a fault.
    Fault { what: String },
    /// The world: the true poses.
    Poses { poses: BTreeMap<String, Pose> },
    /// The world: an interface has latched.
    Closed { contact: Contact },
    /// The world: an interface has opened.
    Opened { face: Face },
    /// A gateway listens here.
    Listening { locations: Vec<String> },
    /// A gateway shows its domain on this page.
    Page { link: String },
    /// The launcher waits for a line of standard input before this step.
    Waits { step: String },
    /// A watcher: a letter of its host. `fences` has those of the message.
    Letter {
        sender: String,
        receiver: String,
        performative: String,
        protocol: String,
        conversation: String,
        fences: Vec<String>,
    },
    /// The operator: the agents with a service.
    Found {
        service: String,
        agents: Vec<String>,
    },
    /// A robot: its announced cost.
    Bid { item: String, cost: f64 },
    /// The operator: the bids for an item, and the robot that is to fetch it.
    Award {
        item: String,
        bids: BTreeMap<String, f64>,
        robot: String,
    },
    /// A robot: the item is in its gripper, or it stands in front of it.
    Fetched { item: String, held: bool },
    /// The master: it holds these locks.
    Locked { fences: BTreeMap<String, String> },
    /// The master: it has released its locks.
    Released { fences: BTreeMap<String, String> },
    /// An owner: a grant.
    Granted {
        resource: String,
        holder: String,
        fence: String,
    },
    /// An owner: the end of a grant.
    Ended {
        resource: String,
        holder: String,
        fence: String,
        how: String,
    },
    /// The master: a step of the guidance, and the error that the camera shows, in millimeters.
    Step {
        conversation: String,
        error_mm: f64,
        phase: String,
    },
    /// The master: the client is in place, and the latch comes next.
    Aligned { conversation: String },
    /// An item or a client: it obeys a command.
    Admitted {
        action: String,
        resource: String,
        fence: String,
    },
    /// An item or a client: it does not obey.
    Refused { action: String, reason: String },
    /// An item: its interface holds another one.
    Latched { contact: Contact },
    /// An item: its interface is open.
    Unlatched { face: Face },
    /// The client: it feels the contact.
    Confirmed { contact: Contact },
    /// The master: the result of a docking.
    Docked {
        conversation: String,
        contact: Contact,
        steps: u32,
        seconds: f64,
    },
    /// The master: the docking has ended without a contact.
    NotDocked {
        conversation: String,
        reason: String,
    },
    /// A member: the coalition as it sees it.
    Coalition {
        name: String,
        members: Vec<String>,
        leader: Option<String>,
    },
    /// An agent notices a fault.
    Noticed { what: String },
    /// An image of a camera, which the leader was asked for.
    Image {
        of: String,
        bytes: usize,
        marker: Option<String>,
    },
    /// The operator: the end of the scenario.
    Finished {
        stack: Vec<String>,
        reason: Option<String>,
    },
    /// The checker: what it has found.
    Checked {
        passed: Vec<String>,
        failed: Vec<String>,
    },
    /// The process has ended with an error.
    Broken { error: String },
}

/// Writes the claims of one process to standard output.
#[derive(Debug, Clone)]
pub struct Reporter(String);

impl Reporter {
    /// Creates the reporter of a process.
    #[must_use]
    pub fn new(name: &str) -> Self {
        Self(name.to_owned())
    }

    /// Writes a claim.
    pub fn claim(&self, claim: Claim) {
        self.claim_at(now(), claim);
    }

    /// Writes a claim about this time, in microseconds since 1970.
    pub(crate) fn claim_at(&self, at: u64, claim: Claim) {
        let report = Report {
            at,
            by: self.0.clone(),
            claim,
        };
        // The launcher may have ended; then standard input ends too.
        if let Ok(line) = serde_json::to_string(&report) {
            let mut out = std::io::stdout().lock();
            let _ = writeln!(out, "{line}").and_then(|()| out.flush());
        }
    }

    /// Reports that a fault was noticed.
    pub fn noticed(&self, what: impl ToString) {
        self.claim(Claim::Noticed {
            what: what.to_string(),
        });
    }
}

/// Returns the present time, in microseconds since 1970.
pub(crate) fn now() -> u64 {
    micros(SystemTime::now())
}

/// Returns a time in microseconds since 1970.
pub(crate) fn micros(time: SystemTime) -> u64 {
    let since = time.duration_since(UNIX_EPOCH);
    since.map_or(0, |since| {
        u64::try_from(since.as_micros()).unwrap_or(u64::MAX)
    })
}

impl Reporter {
    /// Reports an event of an owner.
    pub(crate) fn owner(&self, resource: &str, event: OwnerEvent) {
        let resource = resource.to_owned();
        let shown = |fence: Option<Fence>| fence.map(|it| it.to_string()).unwrap_or_default();
        match event {
            OwnerEvent::Granted { holder, fence } => self.claim(Claim::Granted {
                resource,
                holder,
                fence: shown(fence),
            }),
            OwnerEvent::Ended { holder, fence, how } => self.claim(Claim::Ended {
                resource,
                holder,
                fence: shown(fence),
                how: format!("{how:?}").to_lowercase(),
            }),
            other => self.noticed(format!("{resource}: {other:?}")),
        }
    }

    /// Reports whether a command is obeyed. Returns the reason if it is not.
    pub(crate) fn admission(
        &self,
        action: &str,
        resource: &str,
        checked: Result<Fence, AdmitError>,
    ) -> Result<(), String> {
        let action = action.to_owned();
        match checked {
            Ok(fence) => {
                self.claim(Claim::Admitted {
                    action,
                    resource: resource.to_owned(),
                    fence: fence.to_string(),
                });
                Ok(())
            }
            Err(error) => {
                let reason = error.to_string();
                self.claim(Claim::Refused {
                    action,
                    reason: reason.clone(),
                });
                Err(reason)
            }
        }
    }

    /// Sends a message, and reports a receiver that it does not reach. Returns whether it reaches all.
    pub(crate) async fn send(&self, agent: &Agent, message: MessageBuilder) -> bool {
        match agent.send(message).await {
            Ok(deliveries) if deliveries.all_succeeded() => return true,
            Ok(deliveries) => self.noticed(deliveries),
            Err(error) => self.noticed(ErrorChain(&error)),
        }
        false
    }
}
