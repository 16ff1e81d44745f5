//! Subscriptions to the directory facilitator (FIPA00035).

use std::collections::{HashSet, VecDeque};
use std::sync::Arc;
use std::time::Instant;

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_content::{Content, ContentExpression, IdentifyingExpression, SlDialect, Term, Wff};

use crate::description::searched;
use crate::exception::Exception;
use crate::stored::{CHANGES, StoredSubscription};
use crate::{AgentDescription, Asker, limits, request};

/// The number of a subscription to a [`Df`](crate::Df).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SubscriptionId(pub(crate) u64);

/// A subscription.
pub(crate) struct Subscription {
    pub(crate) asker: Asker,
    /// For a successor, of an agent without a registration.
    stored: Option<StoredSubscription>,
    /// The message of the subscriber, without its content. Each notification answers it.
    pub(crate) message: Message,
    /// The text of the query, which each notification repeats.
    query: Vec<u8>,
    pub(crate) template: AgentDescription,
    /// The agents whose descriptions have changed since the last notification.
    pub(crate) changed: Changed,
    /// Whether the outcome of a notification is awaited.
    pub(crate) is_under_way: bool,
    /// The agents in that notification, if there is a copy for a successor.
    under_way: Vec<Arc<str>>,
    /// Earliest time of the next notification.
    pub(crate) not_before: Instant,
}

/// Agents in the order in which their descriptions changed, so that agents that change all the time do
/// not hold back the others.
#[derive(Debug, Default)]
pub(crate) struct Changed {
    order: VecDeque<Arc<str>>,
    names: HashSet<Arc<str>>,
}

impl Changed {
    /// Appends an agent, unless it is there.
    pub(crate) fn insert(&mut self, name: &Arc<str>) {
        if self.names.insert(Arc::clone(name)) {
            self.order.push_back(Arc::clone(name));
        }
    }

    /// Removes the first agent.
    pub(crate) fn pop_first(&mut self) -> Option<Arc<str>> {
        let first = self.order.pop_front()?;
        self.names.remove(&first);
        Some(first)
    }

    /// Puts back the first agent.
    pub(crate) fn put_back(&mut self, name: Arc<str>) {
        self.names.insert(Arc::clone(&name));
        self.order.push_front(name);
    }

    pub(crate) fn len(&self) -> usize {
        self.order.len()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.order.is_empty()
    }
}

impl Subscription {
    /// Reads a `subscribe` with the query for the results of a search:
    /// `((iota ?x (result (action df (search …)) ?x)))`. Returns the subscription, and the content of
    /// the answer that agrees.
    pub(crate) fn read(
        message: &Message,
        asker: &Asker,
        own: &AgentId,
        now: Instant,
    ) -> Result<(Self, Vec<u8>), Exception> {
        let content = request::content(message, asker, limits::SUBSCRIPTION_CONTENT)?;
        let query = match <[_; 1]>::try_from(content.expressions) {
            Ok([ContentExpression::Identifying(query)]) => query,
            _ => return Err(request::unrecognised_content()),
        };
        let template = template(&query, asker.asked(own))?;
        if parameters(message) > limits::SUBSCRIPTION_PARAMETERS {
            let words = "the parameters of the message are too long for a subscription";
            return Err(Exception::InternalError(words.to_owned()));
        }
        let unprintable = |_| request::unrecognised_content();
        let text = request::print(asker.dialect, &query).map_err(unprintable)?;
        // A notification nests the query one level deeper, and the agreement is not deeper than that.
        let agreed = agreement(&query);
        let agreed = request::print(asker.dialect, &agreed).map_err(unprintable)?;
        let equal = Wff::Equal(Box::new(query.into()), Box::new(Term::Boolean(true)));
        request::print(asker.dialect, &Content::from(equal)).map_err(unprintable)?;
        let stored = match asker.registration {
            1.. => None,
            0 => StoredSubscription::new(asker, without_content(message), &text),
        };
        let subscription = Self {
            asker: asker.clone(),
            stored,
            message: without_content(message)
                .build()
                .map_err(|_| request::unrecognised_content())?,
            query: text,
            template,
            changed: Changed::default(),
            is_under_way: false,
            under_way: Vec::new(),
            not_before: now,
        };
        Ok((subscription, agreed))
    }

    /// Returns the content of a notification about these descriptions.
    pub(crate) fn notification(&self, descriptions: &[Vec<u8>]) -> Vec<u8> {
        let mut text = b"((= ".to_vec();
        text.extend_from_slice(&self.query);
        text.extend_from_slice(b" (sequence");
        for description in descriptions {
            text.push(b' ');
            text.extend_from_slice(description);
        }
        text.extend_from_slice(b")))");
        text
    }

    /// Returns the copy for a successor.
    pub(crate) fn keep(&self) -> Option<StoredSubscription> {
        let mut copy = self.stored.clone()?;
        let changed = self.under_way.len() + self.changed.len();
        let all = self.under_way.iter().chain(&self.changed.order);
        copy.changed = (changed <= CHANGES).then(|| all.cloned().collect());
        Some(copy)
    }

    pub(crate) fn is_stored(&self) -> bool {
        self.stored.is_some()
    }

    /// Records that a notification about this agent leaves.
    pub(crate) fn leaves(&mut self, name: &Arc<str>) {
        if self.stored.is_some() {
            self.under_way.push(Arc::clone(name));
        }
    }

    /// Puts back the agent that was recorded last.
    pub(crate) fn stays(&mut self, name: Arc<str>) {
        self.under_way.pop();
        self.changed.put_back(name);
    }

    /// Records that the notification has arrived.
    pub(crate) fn arrived(&mut self) {
        self.is_under_way = false;
        self.under_way.clear();
    }

    pub(crate) fn dialect(&self) -> SlDialect {
        self.asker.dialect
    }

    /// Whether this is the subscription that the asker made with this conversation.
    pub(crate) fn is_of(&self, asker: &Asker, conversation: Option<&str>) -> bool {
        self.asker.registration == asker.registration
            && self.asker.platform == asker.platform
            && self.asker.id.same_agent(&asker.id)
            && self.message.conversation_id() == conversation
    }
}

/// Returns the content of an `agree`: the query, without a condition.
fn agreement<'a>(query: &IdentifyingExpression<'a>) -> Content<'a> {
    let query = ContentExpression::from(query.clone());
    Content::new([query, Wff::Truth(true).into()])
}

/// Returns the template of the search whose results a query asks for.
fn template(
    query: &IdentifyingExpression<'_>,
    own: &AgentId,
) -> Result<AgentDescription, Exception> {
    let action = searched(&query.wff).ok_or_else(request::unrecognised_content)?;
    let fipa_content::ActionExpression::Action { agent, act } = action else {
        return Err(request::unrecognised_content());
    };
    let agent = AgentId::try_from(agent).map_err(|_| request::unrecognised_content())?;
    if !agent.name().eq_ignore_ascii_case(own.name()) {
        return Err(Exception::Unauthorised);
    }
    let act = act.as_functional();
    let act = act.filter(|act| act.symbol.eq_ignore_ascii_case("search"));
    let act = act.ok_or_else(|| Exception::UnsupportedFunction("subscribe".to_owned()))?;
    match act.terms() {
        // JADE ignores the constraints of a subscription, too: each change is reported.
        [template] | [template, _] => checked_template(AgentDescription::from_term(template)?),
        [] => Err(Exception::MissingArgument(
            "df-agent-description".to_owned(),
        )),
        _ => Err(Exception::UnexpectedArgumentCount),
    }
}

/// Returns the template, if it is small enough to be compared with every description.
pub(crate) fn checked_template(template: AgentDescription) -> Result<AgentDescription, Exception> {
    match template.size().parts {
        0..=limits::TEMPLATE_PARTS => Ok(template),
        _ => Err(Exception::InternalError(format!(
            "a template has at most {} parts",
            limits::TEMPLATE_PARTS
        ))),
    }
}

/// Returns the length of the parameters that each notification repeats.
fn parameters(message: &Message) -> usize {
    let texts = [
        message.language(),
        message.ontology(),
        message.protocol(),
        message.conversation_id(),
        message.reply_with(),
    ];
    texts.into_iter().flatten().map(str::len).sum()
}

/// Returns a message with the parameters that answers repeat.
fn without_content(message: &Message) -> MessageBuilder {
    let mut copy = Message::builder(Performative::Subscribe);
    for (text, set) in [
        (
            message.language(),
            MessageBuilder::language as fn(MessageBuilder, _) -> _,
        ),
        (message.ontology(), MessageBuilder::ontology),
        (message.protocol(), MessageBuilder::protocol),
        (message.conversation_id(), MessageBuilder::conversation_id),
        (message.reply_with(), MessageBuilder::reply_with),
    ] {
        if let Some(text) = text {
            copy = set(copy, text);
        }
    }
    copy
}
