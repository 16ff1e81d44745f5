//! The checker: a program that reads the recording and the directory, and judges the end.
//!
//! It shares the form of the recording with the other programs, and none of their decisions.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use fipa::locks::{Fence, ResourceStatus};
use fipa::{Domain, Role};
use tokio::time::Instant;

use crate::COALITION;
use crate::face::Contact;
use crate::part::{Failed, Part, Stop};
use crate::report::{Claim, Report, Reporter};

/// Maximum time until the directory and the locks show the end.
const SETTLED: Duration = Duration::from_secs(10);
/// Time between two looks at the directory.
const PAUSE: Duration = Duration::from_millis(200);
/// Maximum error before a latch, in millimeters.
const ALIGNED: f64 = 5.0;
/// The robot that gets the stack, and the one that guides it.
const CLIENT: &str = "crex";
const MASTER: &str = "sherpa";

/// A check: its name, and its result or the reason why it failed.
type Check = (&'static str, Result<(), String>);

/// Runs the checker.
///
/// # Errors
/// If the recording cannot be read, or the domain cannot be opened.
pub(crate) async fn run(part: &Part) -> Result<(), Failed> {
    let domain = Domain::open(&part.config()?).await?;
    let agent = domain.register(&part.name).await?;
    let until = Instant::now() + SETTLED;
    let checks = loop {
        let recording = Recording::read(part)?;
        let locks = agent.query_locks(Duration::from_secs(2)).await?;
        let coalition = domain.directory().lookup(COALITION);
        let listed = coalition.and_then(|entry| match &entry.role {
            Role::Coalition(members) => {
                let names = members.names().iter().map(ToString::to_string).collect();
                Some((names, members.leader().map(ToString::to_string)))
            }
            _ => None,
        });
        let mut checks = recording.checks();
        checks.push(("no interface is locked", free(&locks)));
        checks.push((
            "the coalition is what is joined",
            recording.structure(listed),
        ));
        if checks.iter().all(|(_, result)| result.is_ok()) || Instant::now() >= until {
            break checks;
        }
        tokio::time::sleep(PAUSE).await;
    };
    let (mut passed, mut failed) = (Vec::new(), Vec::new());
    for (name, result) in checks {
        match result {
            Ok(()) => passed.push(name.to_owned()),
            Err(reason) => failed.push(format!("{name}: {reason}")),
        }
    }
    Reporter::new(&part.name).claim(Claim::Checked { passed, failed });
    Stop::default().requested().await;
    drop(agent);
    domain.close().await;
    Ok(())
}

/// No agent holds a resource but the leader its coalition.
fn free(locks: &[ResourceStatus]) -> Result<(), String> {
    let held = locks
        .iter()
        .find(|lock| lock.holder.is_some() && !lock.resource.starts_with("coalition/"));
    match held {
        None => Ok(()),
        Some(lock) => Err(format!(
            "{} is held by {}",
            lock.resource,
            lock.holder.as_deref().unwrap_or_default()
        )),
    }
}

/// The members and the leader of the coalition, as the directory lists them.
type Listed = Option<(BTreeSet<String>, Option<String>)>;

struct Recording {
    reports: Vec<Report>,
}

impl Recording {
    fn read(part: &Part) -> Result<Self, Failed> {
        let text = std::fs::read_to_string(&part.recording)?;
        // The launcher may be writing the last line.
        let mut reports: Vec<Report> = text
            .lines()
            .filter_map(|line| serde_json::from_str(line).ok())
            .collect();
        reports.sort_by_key(|report| report.at);
        Ok(Self { reports })
    }

    fn checks(&self) -> Vec<Check> {
        vec![
            (
                "each robot that fetches an item has the lowest costs",
                self.awards(),
            ),
            ("each contact has a live fence", self.fences()),
            ("the fences of a resource rise", self.rising()),
            ("each report of a contact is true", self.contacts()),
            (
                "each confirmation was sent by the one who gave it",
                self.letters(),
            ),
            ("each docking was aligned twice", self.alignments()),
            ("each docking and each lock has an end", self.ends()),
            ("no stranger is a member", self.strangers()),
            ("what the operator reports is joined", self.stack()),
            ("the fault was noticed", self.noticed()),
        ]
    }

    /// Returns what a claim of this kind says, with its time and its source.
    fn all<'a, T>(&'a self, of: impl Fn(&'a Claim) -> Option<T>) -> Vec<(u64, &'a str, T)> {
        let found = self
            .reports
            .iter()
            .filter_map(|it| Some((it.at, it.by.as_str(), of(&it.claim)?)));
        found.collect()
    }

    fn awards(&self) -> Result<(), String> {
        let bids = self.all(|claim| match claim {
            Claim::Bid { item, cost } => Some((item, *cost)),
            _ => None,
        });
        let awards = self.all(|claim| match claim {
            Claim::Award { item, robot, .. } => Some((item, robot)),
            _ => None,
        });
        let cost = |robot: &str, item: &str| {
            let bid = bids
                .iter()
                .find(|(_, by, (of, _))| *by == robot && *of == item);
            bid.map(|(_, _, (_, cost))| *cost)
                .ok_or_else(|| format!("{robot} has not bid for {item}"))
        };
        let [(_, _, (one, to_one)), (_, _, (other, to_other))] = awards.as_slice() else {
            return Err(format!("{} awards, not 2", awards.len()));
        };
        let sum = cost(to_one, one)? + cost(to_other, other)?;
        let crossed = cost(to_other, one)? + cost(to_one, other)?;
        match sum <= crossed && to_one != to_other {
            true => Ok(()),
            false => Err(format!(
                "{to_one} got {one} and {to_other} got {other}: {sum:.2} m, not {crossed:.2} m"
            )),
        }
    }

    /// Returns the contacts that the world has made.
    fn closed(&self) -> Vec<(u64, &Contact)> {
        let closed = self.all(|claim| match claim {
            Claim::Closed { contact } => Some(contact),
            _ => None,
        });
        closed
            .into_iter()
            .map(|(at, _, contact)| (at, contact))
            .collect()
    }

    fn fences(&self) -> Result<(), String> {
        for (at, contact) in self.closed() {
            let face = contact.face.to_string();
            let admitted = self.all(|claim| match claim {
                Claim::Admitted {
                    action,
                    resource,
                    fence,
                } if action == "latch" && *resource == face => Some(fence),
                _ => None,
            });
            let Some((_, _, fence)) = admitted.iter().rev().find(|(then, ..)| *then <= at) else {
                return Err(format!("{face} latched without a fence"));
            };
            let granted = self.all(|claim| match claim {
                Claim::Granted { fence: it, .. } if it == *fence => Some(()),
                _ => None,
            });
            let ended = self.all(|claim| match claim {
                Claim::Ended { fence: it, .. } if it == *fence => Some(()),
                _ => None,
            });
            if granted.is_empty() || ended.iter().any(|(then, ..)| *then < at) {
                return Err(format!("{face} latched with {fence}, which was not live"));
            }
        }
        Ok(())
    }

    fn rising(&self) -> Result<(), String> {
        let mut highest: BTreeMap<&str, Fence> = BTreeMap::new();
        for (_, _, (resource, text)) in self.all(|claim| match claim {
            Claim::Admitted {
                resource, fence, ..
            } => Some((resource, fence)),
            _ => None,
        }) {
            let fence: Fence = text.parse().map_err(|_| format!("{text} is no fence"))?;
            let lower = highest
                .get(resource.as_str())
                .is_some_and(|known| fence.position() < known.position());
            if lower {
                return Err(format!("{resource} admitted {text} after a higher one"));
            }
            highest.insert(resource, fence);
        }
        Ok(())
    }

    fn contacts(&self) -> Result<(), String> {
        let closed = self.closed();
        for (at, by, contact) in self.all(|claim| match claim {
            Claim::Latched { contact }
            | Claim::Confirmed { contact }
            | Claim::Docked { contact, .. } => Some(contact),
            _ => None,
        }) {
            if !closed
                .iter()
                .any(|(then, it)| *it == contact && *then <= at)
            {
                return Err(format!(
                    "{by} reports that {} holds {}, which is not so",
                    contact.face, contact.other
                ));
            }
        }
        Ok(())
    }

    /// Returns the senders of the letters of the docking protocol with this act.
    fn docking_letters(&self, act: &str) -> Vec<(&str, &str)> {
        let letters = self.all(|claim| match claim {
            Claim::Letter {
                sender,
                receiver,
                performative,
                protocol,
                ..
            } if protocol == "dock" && performative == act => {
                Some((sender.as_str(), receiver.as_str()))
            }
            _ => None,
        });
        letters.into_iter().map(|(_, _, letter)| letter).collect()
    }

    fn letters(&self) -> Result<(), String> {
        let confirms = self.docking_letters("confirm");
        let count = |from: &str, to: &dyn Fn(&str) -> bool| {
            confirms
                .iter()
                .filter(|(sender, receiver)| *sender == from && to(receiver))
                .count()
        };
        let claimed = |by: &str| {
            self.all(|claim| match claim {
                Claim::Confirmed { .. } if by == CLIENT => Some(()),
                Claim::Docked { .. } if by == MASTER => Some(()),
                _ => None,
            })
            .len()
        };
        let by_client = count(CLIENT, &|to| to == MASTER);
        let by_master = count(MASTER, &|to| to != CLIENT);
        if by_client != claimed(CLIENT) || by_master != claimed(MASTER) {
            let (client, master) = (claimed(CLIENT), claimed(MASTER));
            return Err(format!(
                "{CLIENT} reports {client} and sent {by_client}, {MASTER} reports {master} and sent {by_master}"
            ));
        }
        Ok(())
    }

    fn alignments(&self) -> Result<(), String> {
        for (_, _, conversation) in self.all(|claim| match claim {
            Claim::Docked { conversation, .. } => Some(conversation),
            _ => None,
        }) {
            let steps = self.all(|claim| match claim {
                Claim::Step {
                    conversation: it,
                    error_mm,
                    ..
                } if it == conversation => Some(*error_mm),
                _ => None,
            });
            let last = steps.iter().rev().take(2);
            if steps.len() < 2 || last.clone().any(|(_, _, error)| *error >= ALIGNED) {
                return Err(format!(
                    "the last errors of {conversation} are not below {ALIGNED} mm"
                ));
            }
        }
        Ok(())
    }

    fn ends(&self) -> Result<(), String> {
        let ended: BTreeSet<&String> = self
            .all(|claim| match claim {
                Claim::Docked { conversation, .. } | Claim::NotDocked { conversation, .. } => {
                    Some(conversation)
                }
                _ => None,
            })
            .into_iter()
            .map(|(_, _, conversation)| conversation)
            .collect();
        let begun = self.all(|claim| match claim {
            Claim::Step { conversation, .. } => Some(conversation),
            _ => None,
        });
        if let Some((_, _, open)) = begun
            .iter()
            .find(|(_, _, conversation)| !ended.contains(conversation))
        {
            return Err(format!("the docking {open} has no end"));
        }
        let locked = self
            .all(|claim| matches!(claim, Claim::Locked { .. }).then_some(()))
            .len();
        let released = self
            .all(|claim| matches!(claim, Claim::Released { .. }).then_some(()))
            .len();
        match locked == released {
            true => Ok(()),
            false => Err(format!(
                "{MASTER} has locked {locked} times and released {released} times"
            )),
        }
    }

    fn strangers(&self) -> Result<(), String> {
        for (_, _, members) in self.all(|claim| match claim {
            Claim::Coalition { members, .. } => Some(members),
            _ => None,
        }) {
            let stranger = members
                .iter()
                .find(|it| *it != CLIENT && !it.starts_with("payload_"));
            if let Some(stranger) = stranger {
                return Err(format!("{stranger} was listed as a member"));
            }
        }
        Ok(())
    }

    /// Returns the bodies that are joined to the client, itself among them.
    fn joined(&self) -> BTreeSet<String> {
        let mut contacts: Vec<&Contact> = Vec::new();
        for report in &self.reports {
            match &report.claim {
                Claim::Closed { contact } => contacts.push(contact),
                Claim::Opened { face } => contacts.retain(|contact| contact.face != *face),
                _ => {}
            }
        }
        let mut joined = BTreeSet::from([CLIENT.to_owned()]);
        // Each pass finds at least one more body, or is the last one.
        for _ in 0..=contacts.len() {
            for contact in &contacts {
                let (one, other) = (&contact.face.body, &contact.other.body);
                if joined.contains(one) || joined.contains(other) {
                    joined.insert(one.clone());
                    joined.insert(other.clone());
                }
            }
        }
        joined
    }

    fn structure(&self, listed: Listed) -> Result<(), String> {
        let joined = self.joined();
        match listed {
            None if joined.len() == 1 => Ok(()),
            None => Err(format!(
                "{joined:?} are joined, and {COALITION} is not listed"
            )),
            Some((members, leader)) if members == joined && leader.as_deref() == Some(CLIENT) => {
                Ok(())
            }
            Some((members, leader)) => Err(format!(
                "{members:?} are listed with the leader {leader:?}, and {joined:?} are joined"
            )),
        }
    }

    fn stack(&self) -> Result<(), String> {
        let finished = self.all(|claim| match claim {
            Claim::Finished { stack, reason } => Some((stack, reason)),
            _ => None,
        });
        let Some((_, _, (stack, reason))) = finished.last() else {
            return Err("the operator has not finished".to_owned());
        };
        let joined = self.joined();
        let reported: BTreeSet<String> = stack.iter().cloned().chain([CLIENT.to_owned()]).collect();
        if joined != reported {
            return Err(format!(
                "{reported:?} are reported, and {joined:?} are joined"
            ));
        }
        let fault = self.fault();
        let may_miss = ["item-killed", "cancel"].contains(&fault.as_str());
        match (stack.len(), reason) {
            (2, None) => Ok(()),
            (_, Some(_)) if may_miss => Ok(()),
            (number, reason) => Err(format!(
                "{number} items are docked: {}",
                reason.as_deref().unwrap_or("no reason")
            )),
        }
    }

    fn fault(&self) -> String {
        let started = self.all(|claim| match claim {
            Claim::Started { fault, .. } => Some(fault),
            _ => None,
        });
        started
            .first()
            .map(|(_, _, fault)| (*fault).clone())
            .unwrap_or_default()
    }

    /// An agent that can see the fault reports it.
    fn noticed(&self) -> Result<(), String> {
        let says = |words: &str| {
            let all = self.all(|claim| match claim {
                Claim::Noticed { what } => Some(what),
                Claim::NotDocked { reason, .. } | Claim::Refused { reason, .. } => Some(reason),
                _ => None,
            });
            all.iter().any(|(_, _, what)| what.contains(words))
        };
        let expected: &[&str] = match self.fault().as_str() {
            "item-killed" => &["is gone"],
            "link-cut" => &["unreachable"],
            "master-stopped" => &["is stale"],
            "cancel" => &["cancelled"],
            "rogue" => &[
                "accept-proposal from rogue",
                "confirm from rogue",
                "is stale",
                "has no fence of",
            ],
            _ => &[],
        };
        match expected.iter().find(|words| !says(words)) {
            None => Ok(()),
            Some(words) => Err(format!("no agent reports {words:?}")),
        }
    }
}
