//! Remedies for messages that were not delivered.

use fipa::error::SendError;
use fipa::monitor::ViolationKind;
use fipa::{Agent, Config, Deliveries, FailureReason, Outcome, Pattern, Role, is_pattern};

use fipa_acl::escape_name;
use fipa_monitor::one_edit_apart;

use crate::membership;
use crate::output;
use crate::report::Failure;

/// One failure per reason, with the receivers that it concerns.
pub(super) fn failures(deliveries: &Deliveries, agent: &Agent, config: &Config) -> Vec<Failure> {
    let mut reasons: Vec<(FailureReason, Vec<&str>)> = Vec::new();
    for delivery in &deliveries.0 {
        let Outcome::Failed { reason, .. } = &delivery.outcome else {
            continue;
        };
        match reasons.iter_mut().find(|(known, _)| known == reason) {
            Some((_, names)) => names.push(&delivery.receiver),
            None => reasons.push((*reason, vec![&delivery.receiver])),
        }
    }
    let failure = |(reason, names): (FailureReason, Vec<&str>)| {
        let help = match reason {
            FailureReason::NoSuchAgent => no_such_agent(&names, agent, config),
            FailureReason::Unreachable => {
                lost_host(&names, agent).unwrap_or_else(|| advice(reason, config))
            }
            FailureReason::TimedOut | FailureReason::Unconfirmed | FailureReason::QueueFull => {
                stopped(&names, agent).unwrap_or_else(|| advice(reason, config))
            }
            other => advice(other, config),
        };
        Failure::failed(format!("not delivered: {reason}"), receivers(&names), help)
    };
    reasons.into_iter().map(failure).collect()
}

/// The remedy for a message that was not sent at all.
pub(super) fn not_sent(error: &SendError) -> String {
    let SendError::Violation(violation) = error else {
        return "`fipa send --help` describes the parameters of a message".to_owned();
    };
    let protocol = &violation.protocol;
    match violation.kind {
        ViolationKind::NoConversation => {
            "give --conversation-id; or list the protocol in monitor.exempt".to_owned()
        }
        ViolationKind::Misspelled => {
            "`fipa protocol list` lists the protocols; correct --protocol, or list the name in \
             monitor.exempt"
                .to_owned()
        }
        ViolationKind::NotOpened => format!(
            "begin the conversation with a message that `fipa protocol show {protocol:?}` lists \
             for the initial state; give --from if an earlier agent of this name began it"
        ),
        ViolationKind::Repeated | ViolationKind::Ended => {
            "give a new --conversation-id to begin another conversation".to_owned()
        }
        ViolationKind::TooLarge | ViolationKind::TooMany => {
            "use fewer receivers and shorter names and identifiers".to_owned()
        }
        _ => format!(
            "`fipa protocol show {protocol:?}` shows the messages that each state allows; \
             monitor.check=warn sends the message nevertheless"
        ),
    }
}

/// The quoted names of receivers.
pub(super) fn receivers(names: &[&str]) -> String {
    let quoted: Vec<String> = names.iter().map(|name| format!("{name:?}")).collect();
    quoted.join(", ")
}

fn no_such_agent(names: &[&str], agent: &Agent, config: &Config) -> String {
    let patterns = names.iter().filter(|name| is_pattern(name));
    if let Some(error) = patterns.filter_map(|name| Pattern::new(name).err()).next() {
        return error.to_string();
    }
    // In the shell, `arm_*` stands for what is `arm_.*` here.
    let is_glob = |name: &&&str| {
        let mut pairs = name.chars().zip(name.chars().skip(1));
        pairs.any(|(before, it)| it == '*' && (before.is_alphanumeric() || "_-".contains(before)))
    };
    let glob = names.iter().find(is_glob);
    if let Some(glob) = glob {
        return format!(
            "patterns are regular expressions: {:?} stands for any ending",
            glob.replace('*', ".*")
        );
    }
    let entries = agent.domain().directory().entries();
    let near = entries.iter().find(|entry| {
        let known = entry.name.to_ascii_lowercase();
        let is_near = |name: &&str| one_edit_apart(&known, &name.to_ascii_lowercase());
        entry.role == Role::Agent && names.iter().any(is_near)
    });
    if let Some(near) = near {
        return format!(
            "did you mean {:?}? `fipa agents` lists the agents of domain {:?}",
            near.name, config.domain
        );
    }
    let gateway = entries.iter().find(|entry| entry.role == Role::Gateway);
    let domain = &config.domain;
    match gateway {
        Some(gateway) => {
            let keys = match config.security.keys.is_empty() {
                true => "",
                false => "; agents of hosts that are not trusted are unknown (`fipa keys list`)",
            };
            format!(
                "`fipa agents` lists the agents of domain {domain:?}, and the agents on other hosts that \
                 gateway {:?} has discovered{keys}",
                gateway.name
            )
        }
        None => format!(
            "`fipa agents` lists the agents of domain {domain:?}; no gateway is running on this host, \
             so agents on other hosts are unknown: start one with `fipa up`"
        ),
    }
}

/// The remedy if the process of one of these agents is stopped.
fn stopped(names: &[&str], agent: &Agent) -> Option<String> {
    let mut names = names.iter();
    let stopped = names.find_map(|name| membership::stopped(agent, name))?;
    Some(format!(
        "{}. It may then take this message: if you send the message again, the receiver may get it twice",
        stopped.advice()
    ))
}

/// The remedy if the host of one of these agents was connected, and is gone.
fn lost_host(names: &[&str], agent: &Agent) -> Option<String> {
    let directory = agent.domain().directory();
    let lost = names.iter().find_map(|name| directory.lost_agent(name))?;
    let since = output::time_span(lost.registered.elapsed().unwrap_or_default());
    Some(format!(
        "its host {} was last seen {since} ago: check that it is switched on and that `fipa up` runs there; \
         `fipa doctor` shows refused connections",
        escape_name(lost.mts.shown())
    ))
}

fn advice(reason: FailureReason, config: &Config) -> String {
    match reason {
        FailureReason::QueueFull => {
            "the receiver reads its messages too slowly: increase --deadline, or its queue with \
             mts.queue and mts.queue_bytes"
                .to_owned()
        }
        FailureReason::Unreachable => {
            "see the attempts above; `fipa agents --long` shows the receiver's locations, and `fipa doctor` \
             checks the ports of known gateways"
                .to_owned()
        }
        FailureReason::TooLarge => format!(
            "split the message, or increase transport.shm.max_letter (now {} here) in the \
             configuration of both hosts",
            output::size(config.transport.shm.max_letter)
        ),
        FailureReason::NoRoom => format!(
            "shared memory is used up by letters that agents keep, and by loans: release them, or raise \
             transport.shm.capacity (now {} here)",
            output::size(config.transport.shm.capacity)
        ),
        FailureReason::Inexpressible => {
            "change or omit the parameter named above, which the peer's dialect cannot encode"
                .to_owned()
        }
        FailureReason::Unsupported => {
            "add the transport named above to mts.transports of the gateway, or configure the peer to \
             listen on TCP too"
                .to_owned()
        }
        FailureReason::TimedOut => "increase --deadline; see the attempts above".to_owned(),
        FailureReason::Unconfirmed => {
            "the message may have been delivered: if you send it again, the receiver may get it twice"
                .to_owned()
        }
        FailureReason::Loop => {
            "gateways forward the letter to each other: check the locations in `fipa agents`, and \
             discovery.static in their configurations"
                .to_owned()
        }
        _ => {
            "see the attempts above, and the log of the process that rejected the letter".to_owned()
        }
    }
}
