//! Contacts: agents of other hosts that become known by their letters, so that they can be answered.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Instant;

use fipa_acl::{Letter, Message};
use fipa_sds::{Reach, Source};
use fipa_transport::{Hop, Incarnation, LegacySource};

use super::action::Action;
use super::failures::{Stated, stated};
use super::limits::{Rate, SenderLimit};
use super::{Core, Now};
use crate::dial::Claim;
use crate::failure::sender_of;
use crate::stamp::EnvelopeParts;

/// Maximum number of agents in the `reply-to` of a legacy peer's letter that become known by it.
const MAX_REPLY_TO: usize = 4;

/// An agent to which answers may go: the sender of a legacy peer's letter, or one of its `reply-to`.
#[derive(Debug)]
pub(super) struct Answered {
    pub(super) name: String,
    pub(super) stated: Vec<Stated>,
    pub(super) is_sender: bool,
}

/// Returns the agents of a letter to which answers may go, with their addresses. The host name that the sender has
/// in its own address stands for the source of the letter; other host names in `reply-to` are left out.
pub(super) fn answered(message: &Message, letter: &Letter, from: LegacySource) -> Vec<Answered> {
    let mut all = Vec::new();
    let mut hosts: Vec<String> = Vec::new();
    if let Some(sender) = sender_of(message, letter) {
        let stated = stated(sender.addresses().iter().map(|it| &**it), from);
        hosts.extend(stated.iter().filter_map(|it| it.host.clone()));
        all.push(Answered {
            name: sender.name().to_owned(),
            stated,
            is_sender: true,
        });
    }
    for agent in message.reply_to().iter().take(MAX_REPLY_TO) {
        if all.iter().any(|known| known.name == agent.name()) {
            continue;
        }
        let mut stated = stated(agent.addresses().iter().map(|it| &**it), from);
        stated.retain(|it| it.host.as_ref().is_none_or(|host| hosts.contains(host)));
        all.push(Answered {
            name: agent.name().to_owned(),
            stated,
            is_sender: false,
        });
    }
    all
}

/// Limits the rate at which agents become known by their letters: each is published to the processes of the host.
/// The agents of a platform have one address and may begin together, so a burst is larger than the rate.
pub(super) fn contact_limit() -> SenderLimit {
    SenderLimit::new(
        Rate::of(2.0),
        Rate::with_burst(50.0, 1000.0),
        Rate::with_burst(200.0, 4000.0),
    )
}

/// The rate at which agents become known by their letters is exceeded.
#[derive(Debug)]
pub(super) struct TooManyContacts;

impl Core {
    /// Reports the sender of a letter with this envelope as a contact if it is unknown, or known as a contact at
    /// another location, so that it can be answered. Returns whether it did.
    ///
    /// # Errors
    /// If too many agents have become known by their letters. A gateway announces its agents, so the directory may soon
    /// list the sender.
    pub(super) fn report_contact(
        &mut self,
        now: Instant,
        agent: Incarnation,
        envelope: EnvelopeParts,
        from: &Hop,
    ) -> Result<bool, TooManyContacts> {
        let view = &self.table.view;
        if !agent.is_known() {
            return Ok(false);
        }
        let registered = view.registered(agent);
        if let Some(known) = &registered {
            if known.source != Source::Contact {
                return Ok(false);
            }
            if known.locations.first() == Some(&from.location) {
                let name = Arc::clone(&known.name);
                self.table
                    .actions
                    .push_back(Action::ContactSeenAgain { name });
                return Ok(false);
            }
        }
        // A letter that was forwarded by the receiver's previous gateway does not come from the
        // sender's location.
        let Some(name) = envelope.sender.filter(|_| envelope.stamps <= 1) else {
            return Ok(false);
        };
        // The gateway of an agent may register its name again, before its directory says so.
        let gateway = from.location.incarnation();
        let is_taken = match registered {
            Some(known) => *known.name != name,
            None => view.named(&name).is_some_and(|known| {
                known.source != Source::Contact && known.reach != Reach::Remote { gateway }
            }),
        };
        if is_taken {
            return Ok(false);
        }
        let address = from.location.authority().parse::<SocketAddr>();
        let address = address.ok().map(|it| it.ip().to_canonical());
        if !self.contact_limit.take(now, address, &name) {
            tracing::debug!(at = %from.location, %name, "rate limit of new agents exceeded");
            return Err(TooManyContacts);
        }
        let location = from.location.clone();
        self.is_ahead = true;
        self.table.actions.push_back(Action::ContactSeen {
            name,
            agent,
            location,
            host: None,
        });
        Ok(true)
    }

    /// Reports an agent of a legacy peer as a contact, at the location that it states as its own. Only for an
    /// agent that is unknown, or known as a contact. Returns whether it did.
    fn report_legacy_contact(
        &mut self,
        now: Now,
        (name, stated): (String, Stated),
        from: IpAddr,
    ) -> bool {
        if !self.table.config.forwards {
            return false;
        }
        let Stated { location, host, .. } = stated;
        if let Some(known) = self.table.view.named(&name) {
            if !known.is_unregistered_contact() {
                return false;
            }
            if known.locations.contains(&location) {
                let address = location.authority().parse::<SocketAddr>();
                if address.is_ok_and(|address| address.ip().to_canonical() == from) {
                    let name = Arc::clone(&known.name);
                    self.table
                        .actions
                        .push_back(Action::ContactSeenAgain { name });
                }
                return false;
            }
        }
        if !self
            .legacy_contact_limit
            .take(now.instant, Some(from), &name)
        {
            tracing::debug!(%from, "rate limit of new agents of legacy peers exceeded; this one cannot be answered");
            return false;
        }
        self.is_ahead = true;
        self.table.actions.push_back(Action::ContactSeen {
            name,
            agent: Incarnation::UNKNOWN,
            location,
            host,
        });
        true
    }

    /// Reports the agents of a legacy peer's letter to which answers may go as contacts, as far as their addresses may
    /// be dialed. Returns whether it reported one.
    pub(super) fn report_answered(
        &mut self,
        now: Now,
        answered: Vec<Answered>,
        from: IpAddr,
    ) -> bool {
        let mut has_reported = false;
        let mut endpoints: Vec<SocketAddr> = Vec::new();
        for agent in answered {
            let claim = |at: SocketAddr| match agent.is_sender {
                true => Claim::Return(from),
                false => Claim::Received {
                    is_host: at.ip().to_canonical() == from.to_canonical(),
                    // Answers to the sender go there, too.
                    is_endpoint: endpoints.contains(&at),
                },
            };
            let mut stated = agent.stated.into_iter();
            let Some(stated) = stated.find(|it| self.permits(it.at, claim(it.at))) else {
                continue;
            };
            if agent.is_sender {
                endpoints.push(stated.at);
            }
            has_reported |= self.report_legacy_contact(now, (agent.name, stated), from);
        }
        has_reported
    }
}
