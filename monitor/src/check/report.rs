//! Descriptions of violations: the message, the state of the conversation, the expected messages.

use crate::check::outcome::{Denied, Fault};
use crate::conversation::Conversation;
use crate::conversation::names::Names;
use crate::conversation::party::{Party, Tail};
use crate::conversation::state::{CANCELLING, FAILED, state_name};
use crate::conversation::table::Table;
use crate::protocol::machine::{Machine, Roles, Scope, State};
use crate::verdict::{Expected, ReplyMismatch, Violation, ViolationKind as Kind};
use crate::{Header, Library};

/// Maximum number of receivers in a violation.
const MAX_NAMED: usize = 16;

/// Maximum length of a text of a message in a violation, in bytes.
const MAX_SHOWN: usize = 4_096;

/// Shortens a text of a message.
fn shown(text: &str) -> String {
    let mut end = text.len().min(MAX_SHOWN);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    text.get(..end).unwrap_or_default().to_owned()
}

pub(crate) fn violation(
    library: &Library,
    table: &Table,
    names: &Names,
    header: &Header<'_>,
    denied: Denied,
) -> Violation {
    let mut violation = Violation {
        kind: Kind::NotOpened,
        protocol: shown(header.protocol_name().unwrap_or_default()),
        conversation_id: shown(header.conversation().unwrap_or_default()),
        performative: shown(header.act().name()),
        sender: shown(header.sender_name().unwrap_or_default()),
        receivers: header
            .receiver_names()
            .iter()
            .take(MAX_NAMED)
            .map(|name| shown(name))
            .collect(),
        participant: None,
        state: None,
        expected: Vec::new(),
        reply: None,
        similar: None,
    };
    let (fault, at) = match denied {
        Denied::Fault(fault, at) => (fault, at),
        Denied::NotOpened(machine) => {
            if let Some(machine) = library.machine(machine) {
                machine.name().clone_into(&mut violation.protocol);
                violation.expected = expected(machine, machine.initial(), None, names, None);
            }
            return violation;
        }
        Denied::Refused(kind, similar) => {
            violation.kind = kind;
            let machine = similar.and_then(|machine| library.machine(machine));
            violation.similar = machine.map(|machine| machine.name().to_owned());
            return violation;
        }
        // The caller handles this case.
        Denied::Unchecked(_) => return violation,
    };
    let Fault {
        kind,
        state,
        participant,
    } = fault;
    violation.kind = kind;
    let Some(slot) = table.slot(at) else {
        return violation;
    };
    let conversation = &slot.conversation;
    let Some(machine) = library.machine(conversation.machine) else {
        return violation;
    };
    machine.name().clone_into(&mut violation.protocol);
    if let Some(state) = state {
        violation.state = Some(state_name(machine, state).to_owned());
        let name = participant.as_deref();
        let resume = || {
            let mut parties = conversation.parties.iter();
            let concerned = |party: &&Party| name.is_none_or(|name| names.is(party.peer, name));
            let party = parties.find(concerned);
            party.and_then(|party| machine.state(party.resume))
        };
        let own = match state {
            FAILED => resume(),
            own => machine.state(own),
        };
        if let Some(own) = own {
            violation.expected = expected(machine, own, Some(conversation), names, name);
        } else if state == CANCELLING {
            violation.expected = vec![Expected {
                performative: "inform, failure".to_owned(),
                from: "the other side".to_owned(),
                to: "the side that canceled".to_owned(),
            }];
        }
    }
    if kind == Kind::WrongReply {
        let sender = header.sender_name().unwrap_or_default();
        let (party, by_initiator) = match participant.as_deref() {
            Some(name) => {
                let party = conversation.party(names, name).map(|(_, party)| party);
                (party.or(conversation.unnamed()), name != sender)
            }
            // With one state for all participants.
            None => {
                let leads = conversation.speaks_for_initiator(names, sender);
                (conversation.parties.first(), leads)
            }
        };
        let other = usize::from(by_initiator);
        violation.reply = party.map(|party| ReplyMismatch {
            expected: party.asked_text(other).to_owned(),
            received: Tail::of(header.in_reply_to_text().unwrap_or_default())
                .text()
                .to_owned(),
        });
    }
    violation.participant = participant;
    violation
}

/// Returns the messages that a state allows. Roles are replaced by the names of their agents if
/// these are known.
fn expected(
    machine: &Machine,
    state: &State,
    conversation: Option<&Conversation>,
    names: &Names,
    participant: Option<&str>,
) -> Vec<Expected> {
    let named = |roles: &Roles| {
        agent_of(machine, roles, conversation, names, participant)
            .unwrap_or_else(|| roles.text.clone())
    };
    let mut all: Vec<Expected> = Vec::new();
    for step in &state.steps {
        let (from, to) = (named(&step.from), named(&step.to));
        let performative = step.acts.shown();
        let same = all.iter_mut().find(|one| one.from == from && one.to == to);
        match same {
            Some(one)
                if one
                    .performative
                    .split(", ")
                    .any(|part| part == performative) => {}
            Some(one) => {
                one.performative.push_str(", ");
                one.performative.push_str(&performative);
            }
            None => all.push(Expected {
                performative,
                from,
                to,
            }),
        }
    }
    all
}

/// Returns the name of the agent with a role, if it is known.
fn agent_of(
    machine: &Machine,
    roles: &Roles,
    conversation: Option<&Conversation>,
    names: &Names,
    participant: Option<&str>,
) -> Option<String> {
    let conversation = conversation?;
    let role = roles.one()?;
    if role == machine.initiator {
        return Some(names.text(conversation.initiator).to_owned());
    }
    match machine.scope {
        Scope::Participant => participant.map(str::to_owned),
        Scope::Conversation => {
            let mut bound = conversation.bound.iter();
            let bound = bound.find(|bound| bound.role == role)?;
            Some(names.text(bound.agent).to_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shown_texts_end_with_a_whole_character() {
        let long = format!("x{}", "\u{e4}".repeat(3_000));
        assert_eq!(shown(&long), long[..MAX_SHOWN - 1]);
        assert_eq!(shown(&long[1..]), long[1..=MAX_SHOWN]);
        assert_eq!(shown("x"), "x");
    }
}
