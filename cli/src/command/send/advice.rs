//! What to do when a message was not delivered.

use fipa::{Agent, Config, Deliveries, FailureReason, Outcome, Pattern, Role, is_pattern};

use crate::report::Failure;

/// One failure for every reason there is, with the receivers it is about.
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
        let advice = match reason {
            FailureReason::NoSuchAgent => no_such_agent(&names, agent, config),
            other => advice(other, config),
        };
        Failure::failed(
            format!("not delivered: {reason}"),
            receivers(&names),
            advice,
        )
    };
    reasons.into_iter().map(failure).collect()
}

/// Names of receivers, for people.
pub(super) fn receivers(names: &[&str]) -> String {
    let quoted: Vec<String> = names.iter().map(|name| format!("{name:?}")).collect();
    quoted.join(", ")
}

fn no_such_agent(names: &[&str], agent: &Agent, config: &Config) -> String {
    let patterns = names.iter().filter(|name| is_pattern(name));
    if let Some(error) = patterns.filter_map(|name| Pattern::new(name).err()).next() {
        return error.to_string();
    }
    let entries = agent.domain().directory().entries();
    let gateway = entries.iter().find(|entry| entry.role == Role::Gateway);
    let domain = &config.domain;
    match gateway {
        Some(gateway) => format!(
            "`fipa agents` lists who is there in the domain {domain:?}; on other hosts, only \
             those are known that the gateway {:?} has found",
            gateway.name
        ),
        None => format!(
            "`fipa agents` lists who is there in the domain {domain:?}; no gateway is running \
             here, so agents of other hosts are not known: start one with `fipa up`"
        ),
    }
}

fn advice(reason: FailureReason, config: &Config) -> String {
    match reason {
        FailureReason::QueueFull => {
            "it takes its messages too slowly: give it more time with --deadline, or a longer \
             queue with mts.queue and mts.queue_bytes"
                .to_owned()
        }
        FailureReason::Unreachable => {
            "see above what was tried; `fipa agents` shows where it should be".to_owned()
        }
        FailureReason::TooLarge => format!(
            "send it in pieces, or allow larger letters with transport.shm.max_letter (here {} \
             bytes) in the configuration of both sides",
            config.transport.shm.max_letter
        ),
        FailureReason::Inexpressible => {
            "see above which parameter the peer's dialect has no form for: change or leave out that \
             parameter"
                .to_owned()
        }
        FailureReason::Unsupported => {
            "see above the transports of the peer, which this program does not have: have the peer \
             listen on TCP, too"
                .to_owned()
        }
        FailureReason::TimedOut => {
            "give it more time with --deadline; see above what was tried".to_owned()
        }
        FailureReason::Unconfirmed => {
            "it may or may not have got it: ask it before you send it again".to_owned()
        }
        FailureReason::Loop => {
            "gateways hand it to each other: see the locations in `fipa agents`, and \
             discovery.static of their configurations"
                .to_owned()
        }
        _ => "see above who did not take it, and its log".to_owned(),
    }
}
