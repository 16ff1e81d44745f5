//! The parameters of a message that a monitor reads: all but the content.

use std::borrow::Cow;
use std::collections::HashSet;
use std::time::SystemTime;

use fipa_acl::{AgentId, Message, MessageView, Performative};
use smallvec::{Array, SmallVec};

use crate::protocol::act::{Act, FAILURE};

/// The parameters of a message that determine whether it fits its conversation.
///
/// A header is made from a [`Message`], from a [`MessageView`], or parameter by parameter. For a
/// letter, [`receivers`](Self::receivers) sets the receivers of its envelope. A header with up to two
/// receivers does not allocate.
#[derive(Debug, Clone)]
pub struct Header<'a> {
    performative: Cow<'a, Performative>,
    sender: Option<Cow<'a, str>>,
    receivers: SmallVec<[Cow<'a, str>; 2]>,
    reply_to: SmallVec<[Cow<'a, str>; 1]>,
    protocol: Option<Cow<'a, str>>,
    conversation_id: Option<Cow<'a, str>>,
    reply_with: Option<Cow<'a, str>>,
    in_reply_to: Option<Cow<'a, str>>,
    reply_by: Option<fipa_acl::Time>,
    /// Receivers that stand for several agents, and these agents.
    groups: Vec<(Cow<'a, str>, Vec<Cow<'a, str>>)>,
    /// All receivers of the message, if this is the copy for one of them.
    addressed: SmallVec<[Cow<'a, str>; 2]>,
    peer: Option<Cow<'a, str>>,
    undelivered_to: Option<Cow<'a, str>>,
}

impl<'a> Header<'a> {
    /// Creates a header with a performative only.
    #[must_use]
    pub fn new(performative: Performative) -> Self {
        Self::of_act(Cow::Owned(performative))
    }

    fn of_act(performative: Cow<'a, Performative>) -> Self {
        Self {
            performative,
            sender: None,
            receivers: SmallVec::new(),
            reply_to: SmallVec::new(),
            protocol: None,
            conversation_id: None,
            reply_with: None,
            in_reply_to: None,
            reply_by: None,
            groups: Vec::new(),
            addressed: SmallVec::new(),
            peer: None,
            undelivered_to: None,
        }
    }

    /// Sets the sender.
    #[must_use]
    pub fn sender(mut self, sender: impl Into<Cow<'a, str>>) -> Self {
        self.sender = Some(sender.into());
        self
    }

    /// Replaces the receivers. For a letter, these are the receivers in its envelope.
    #[must_use]
    pub fn receivers<N: Into<Cow<'a, str>>>(
        mut self,
        receivers: impl IntoIterator<Item = N>,
    ) -> Self {
        self.receivers = receivers.into_iter().map(Into::into).collect();
        self
    }

    /// Resolves a receiver that stands for several agents, a coalition or a pattern of names: these
    /// agents receive the message. The caller resolves it as of the time of the sending. The sender is
    /// not among the receivers of its own message.
    ///
    /// Without this, the members of a pattern are those that answer, and a coalition counts as an
    /// agent. The monitor of an agent needs it only for the messages that the agent sends.
    #[must_use]
    pub fn group<N: Into<Cow<'a, str>>>(
        mut self,
        receiver: impl Into<Cow<'a, str>>,
        members: impl IntoIterator<Item = N>,
    ) -> Self {
        let members = members.into_iter().map(Into::into).collect();
        self.groups.push((receiver.into(), members));
        self
    }

    /// Makes this the copy of the message for one receiver. An observer that gets each copy of a
    /// message by itself then knows that they are one message.
    #[must_use]
    pub fn copy_for(mut self, receiver: impl Into<Cow<'a, str>>) -> Self {
        self.addressed = std::mem::take(&mut self.receivers);
        self.receivers.push(receiver.into());
        self
    }

    /// Sets the peer to which a conversation belongs that this message begins. Without it, this is the
    /// sender. A caller that knows the connection of the message names it here, so that the memory of
    /// a peer with many agent names is bounded too: see [`MonitorLimits::bytes`](crate::MonitorLimits::bytes).
    #[must_use]
    pub fn peer(mut self, peer: impl Into<Cow<'a, str>>) -> Self {
        self.peer = Some(peer.into());
        self
    }

    /// Makes this the report of a message transport service that a message was not delivered to this
    /// agent. The caller has verified that the sender is the service of that agent, or the one that was to
    /// deliver the message. The monitor does not read the content, and every agent can name itself like a
    /// service: without this, a `failure` of an agent that takes no part is a violation.
    ///
    /// Such a report is never a violation. If it is no `failure`, this has no effect.
    #[must_use]
    pub fn undelivered_to(mut self, agent: impl Into<Cow<'a, str>>) -> Self {
        self.undelivered_to = Some(agent.into());
        self
    }

    /// Replaces the agents that receive replies instead of the sender.
    #[must_use]
    pub fn reply_to<N: Into<Cow<'a, str>>>(mut self, agents: impl IntoIterator<Item = N>) -> Self {
        self.reply_to = agents.into_iter().map(Into::into).collect();
        self
    }

    /// Sets the protocol.
    #[must_use]
    pub fn protocol(mut self, name: impl Into<Cow<'a, str>>) -> Self {
        self.protocol = Some(name.into());
        self
    }

    /// Sets the conversation identifier.
    #[must_use]
    pub fn conversation_id(mut self, id: impl Into<Cow<'a, str>>) -> Self {
        self.conversation_id = Some(id.into());
        self
    }

    /// Sets `reply-with`.
    #[must_use]
    pub fn reply_with(mut self, text: impl Into<Cow<'a, str>>) -> Self {
        self.reply_with = Some(text.into());
        self
    }

    /// Sets `in-reply-to`.
    #[must_use]
    pub fn in_reply_to(mut self, text: impl Into<Cow<'a, str>>) -> Self {
        self.in_reply_to = Some(text.into());
        self
    }

    /// Sets `reply-by`.
    #[must_use]
    pub fn reply_by(mut self, time: fipa_acl::Time) -> Self {
        self.reply_by = Some(time);
        self
    }

    /// Returns the performative.
    #[must_use]
    pub fn performative(&self) -> &Performative {
        &self.performative
    }

    pub(crate) fn act(&self) -> Act<'_> {
        Act::of(&self.performative)
    }

    /// Returns the name of the sender, if the message names one.
    #[must_use]
    pub fn sender_name(&self) -> Option<&str> {
        self.sender.as_deref()
    }

    pub(crate) fn receiver_names(&self) -> &[Cow<'a, str>] {
        &self.receivers
    }

    /// Number of the receivers with the members of groups.
    pub(crate) fn receiver_count(&self) -> usize {
        let members = self.groups.iter().map(|(_, members)| members.len());
        self.receivers.len() + members.sum::<usize>()
    }

    /// The members of each group.
    pub(crate) fn groups(&self) -> impl Iterator<Item = &[Cow<'a, str>]> {
        self.groups.iter().map(|(_, members)| members.as_slice())
    }

    /// Returns the receivers, if these are not the names in the header: groups are replaced by their
    /// members, and names that occur twice are left out.
    pub(crate) fn other_receivers(&self) -> Option<Vec<Cow<'_, str>>> {
        if self.groups.is_empty() && !has_duplicates(&self.receivers) {
            return None;
        }
        let mut known = HashSet::new();
        let mut all = Vec::new();
        for receiver in &self.receivers {
            let mut groups = self.groups.iter();
            let group = groups.find(|(name, _)| name == receiver);
            let members = match group {
                Some((_, members)) => &members[..],
                None => std::slice::from_ref(receiver),
            };
            for member in members {
                let own = group.is_some() && self.sender.as_ref() == Some(member);
                if !own && known.insert(&**member) {
                    all.push(Cow::Borrowed(&**member));
                }
            }
        }
        Some(all)
    }

    pub(crate) fn addressed(&self) -> &[Cow<'a, str>] {
        &self.addressed
    }

    pub(crate) fn peer_name(&self) -> Option<&str> {
        self.peer.as_deref()
    }

    pub(crate) fn undelivered_name(&self) -> Option<&str> {
        let name = self.undelivered_to.as_deref();
        name.filter(|_| self.act() == FAILURE)
    }

    pub(crate) fn reply_to_names(&self) -> &[Cow<'a, str>] {
        &self.reply_to
    }

    /// Returns the name of the protocol, if the message names one.
    #[must_use]
    pub fn protocol_name(&self) -> Option<&str> {
        self.protocol.as_deref()
    }

    /// Returns the conversation identifier, if the message has one.
    #[must_use]
    pub fn conversation(&self) -> Option<&str> {
        self.conversation_id.as_deref()
    }

    pub(crate) fn reply_with_text(&self) -> Option<&str> {
        self.reply_with.as_deref()
    }

    pub(crate) fn in_reply_to_text(&self) -> Option<&str> {
        self.in_reply_to.as_deref()
    }

    pub(crate) fn reply_by_time(&self, now: SystemTime) -> Option<SystemTime> {
        self.reply_by.map(|time| time.to_system_time(now))
    }
}

impl<'a> From<&'a Message> for Header<'a> {
    fn from(message: &'a Message) -> Self {
        Self {
            sender: message.sender().map(|sender| sender.name().into()),
            receivers: names(message.receivers()),
            reply_to: names(message.reply_to()),
            protocol: message.protocol().map(Cow::Borrowed),
            conversation_id: message.conversation_id().map(Cow::Borrowed),
            reply_with: message.reply_with().map(Cow::Borrowed),
            in_reply_to: message.in_reply_to().map(Cow::Borrowed),
            reply_by: message.reply_by(),
            ..Self::of_act(Cow::Borrowed(message.performative()))
        }
    }
}

impl<'a> From<&MessageView<'a>> for Header<'a> {
    fn from(view: &MessageView<'a>) -> Self {
        Self {
            sender: view.sender().map(|sender| sender.name().as_str()),
            receivers: view
                .receivers()
                .map(|agent| agent.name().as_str())
                .collect(),
            reply_to: view.reply_to().map(|agent| agent.name().as_str()).collect(),
            protocol: view.protocol().map(|name| name.as_str()),
            conversation_id: view.conversation_id().map(|text| text.as_str()),
            reply_with: view.reply_with().map(|text| text.as_str()),
            in_reply_to: view.in_reply_to().map(|text| text.as_str()),
            reply_by: view.reply_by(),
            ..Self::of_act(Cow::Owned(view.performative()))
        }
    }
}

/// The names of agents. Most messages have one receiver, for which this is faster than an iterator.
fn names<'a, A: Array<Item = Cow<'a, str>>>(agents: &'a [AgentId]) -> SmallVec<A> {
    let mut names = SmallVec::new();
    for agent in agents {
        names.push(Cow::Borrowed(agent.name()));
    }
    names
}

/// Whether a name occurs twice. The time is linear in the names.
#[inline]
fn has_duplicates(names: &[Cow<'_, str>]) -> bool {
    names.len() > 1 && has_equal(names)
}

fn has_equal(names: &[Cow<'_, str>]) -> bool {
    const FEW: usize = 8;
    if names.len() <= FEW {
        let mut names = names.iter().enumerate();
        let all = names.clone();
        return names.any(|(at, name)| all.clone().take(at).any(|(_, other)| other == name));
    }
    let mut known = HashSet::with_capacity(names.len());
    !names.iter().all(|name| known.insert(&**name))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use fipa_acl::Time;

    use super::*;

    #[test]
    fn a_message_and_its_view_have_the_same_header() {
        let id = |name| AgentId::new(name).unwrap();
        let now = SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let message = Message::builder(Performative::Cfp)
            .sender(id("ann"))
            .receiver(id("ben"))
            .receiver(id("cid"))
            .reply_to(id("dan"))
            .protocol("p")
            .conversation_id("c")
            .reply_with("w")
            .in_reply_to("r")
            .reply_by(Time::from_system_time(now).unwrap())
            .build()
            .unwrap();
        let payload = message.to_payload();
        let view = MessageView::parse_payload(&payload).unwrap();
        for header in [Header::from(&message), Header::from(&view)] {
            assert_eq!(header.act().name(), "cfp");
            assert_eq!(header.sender_name(), Some("ann"));
            assert_eq!(header.receiver_names(), ["ben", "cid"]);
            assert_eq!(header.reply_to_names(), ["dan"]);
            assert_eq!(header.protocol_name(), Some("p"));
            assert_eq!(header.conversation(), Some("c"));
            assert_eq!(header.reply_with_text(), Some("w"));
            assert_eq!(header.in_reply_to_text(), Some("r"));
            assert_eq!(header.reply_by_time(now), Some(now));
        }
    }

    #[test]
    fn groups_are_replaced_by_their_members_without_the_sender() {
        let header = Header::new(Performative::Cfp)
            .sender("ann")
            .receivers(["platoon", "ben", "dan"])
            .group("platoon", ["ann", "ben", "cid"]);
        assert_eq!(header.receiver_count(), 6);
        assert_eq!(header.other_receivers().unwrap(), ["ben", "cid", "dan"]);
        let twice = Header::new(Performative::Cfp).receivers(["ben", "cid", "ben"]);
        assert_eq!(twice.other_receivers().unwrap(), ["ben", "cid"]);
        let many: Vec<String> = (0..20).map(|number| number.to_string()).collect();
        let all = Header::new(Performative::Cfp).receivers(many.clone());
        assert_eq!(all.other_receivers(), None);
        let again = all.receivers(many.iter().chain([&many[3]]).cloned());
        assert_eq!(again.other_receivers().unwrap().len(), 20);
    }
}
