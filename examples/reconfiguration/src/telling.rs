//! The reports in words, one line each.

use crate::report::{Claim, Report};

/// Returns a report as a line, or nothing for the many that only the picture and the checker need.
#[must_use]
pub fn told(report: &Report) -> Option<String> {
    let by = &report.by;
    Some(match &report.claim {
        Claim::Started { fault, seed } => format!("fault: {fault}, seed {seed}"),
        Claim::Fault { what } => format!("FAULT: {what}"),
        Claim::Page { link } => format!("{by} shows the robots at {link}"),
        Claim::Waits { step } => format!("press Enter to {step}"),
        Claim::Found { service, agents } => {
            format!("{by} finds the service {service}: {}", agents.join(", "))
        }
        Claim::Bid { item, cost } => format!("{by} offers to fetch {item} for {cost:.2} m"),
        Claim::Award { item, robot, .. } => format!("{by} awards {item} to {robot}"),
        Claim::Fetched { item, held: true } => format!("{by} has {item} in its gripper"),
        Claim::Fetched { item, held: false } => format!("{by} stands in front of {item}"),
        Claim::Locked { fences } => {
            let names: Vec<&str> = fences.keys().map(String::as_str).collect();
            format!("{by} holds {}", names.join(", "))
        }
        Claim::Ended {
            resource,
            holder,
            how,
            ..
        } if how != "released" => {
            format!("{by}: the lock of {holder} for {resource} has {how}")
        }
        Claim::Aligned { .. } => format!("{by} sees an error below 5 mm twice"),
        Claim::Refused { action, reason } => format!("{by} refuses to {action}: {reason}"),
        Claim::Latched { contact } => {
            format!("{by} has latched {} to {}", contact.face, contact.other)
        }
        Claim::Unlatched { face } => format!("{by} reports {face} unlatched"),
        Claim::Confirmed { contact } => format!("{by} confirms the contact with {}", contact.face),
        Claim::Docked { steps, seconds, .. } => {
            format!("{by} has docked it in {steps} steps, {seconds:.1} s")
        }
        Claim::NotDocked { reason, .. } => format!("{by} has not docked it: {reason}"),
        Claim::Coalition {
            name,
            members,
            leader,
        } if !members.is_empty() => {
            let leader = leader.as_deref().unwrap_or("no member yet");
            format!("{name} is {}, led by {leader}", members.join(", "))
        }
        Claim::Coalition { name, .. } => format!("{name} is dissolved"),
        Claim::Noticed { what } => format!("{by} notices: {what}"),
        Claim::Image { of, bytes, .. } => format!("{by} has an image of {bytes} bytes from {of}"),
        Claim::Finished {
            stack,
            reason: None,
        } => format!("{by} has its stack: {}", stack.join(", ")),
        Claim::Finished {
            stack,
            reason: Some(reason),
        } => format!("{by} ends with {} items: {reason}", stack.len()),
        Claim::Broken { error } => format!("{by} has failed: {error}"),
        _ => return None,
    })
}
