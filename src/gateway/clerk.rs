//! The clerk: the agent that the gateway itself is. It has the gateway's name and incarnation, is
//! written to by agents of this host and by other gateways, and answers.
//!
//! Letters are told apart by their ontology. What nobody here understands is answered so, when an
//! answer was asked for.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::error::Error;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative, escape};
use fipa_mts::core::{Received, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Directory, EXCHANGE_ONTOLOGY, Matcher, Query};
use fipa_transport::Incarnation;
use parking_lot::Mutex;

use super::exchange::{Exchanging, MANAGEMENT_ONTOLOGY};
use super::neighbours::Neighbours;
use crate::routes;
use crate::service::Service;

/// How long an answer may be under way.
const ANSWER_DEADLINE: Duration = Duration::from_secs(5);

/// Longest text of a notice that is logged, in characters.
const MAX_NOTICE: usize = 1024;

/// The agent that the gateway itself is.
pub(crate) struct Clerk {
    pub(crate) service: Arc<Service>,
    pub(crate) id: AgentId,
    pub(crate) neighbours: Arc<Neighbours>,
    pub(crate) view: Arc<dyn Directory>,
    pub(super) exchange: Arc<Exchanging>,
    /// When a notice of each gateway was last logged.
    pub(super) notices: Mutex<HashMap<Incarnation, Instant>>,
}

impl Clerk {
    /// Reads and answers until the service ends.
    pub(crate) async fn run(self) {
        let (mts, own) = (&self.service.mts, self.service.own.incarnation);
        while let Some(received) = mts.receive(own).await {
            match Message::decode(received.letter.payload()) {
                Ok(message) => self.handle(&message, &received),
                Err(error) => tracing::info!(%error, "a letter to the gateway makes no sense"),
            }
        }
    }

    fn handle(&self, message: &Message, received: &Received) {
        let sender = received.sender;
        if message.ontology() == Some(EXCHANGE_ONTOLOGY)
            && *message.performative() == Performative::Inform
        {
            // A gateway speaks for itself, on its own connections.
            if received.service != sender {
                tracing::info!(
                    "what a gateway tells was not used: it came over another's connection"
                );
                return;
            }
            let content = message.content().map(|content| &content[..]);
            return self.exchange.received(sender, content.unwrap_or_default());
        }
        if message.ontology() == Some(MANAGEMENT_ONTOLOGY)
            && *message.performative() == Performative::Failure
            && received.service == sender
        {
            return self.log_notice(sender, message);
        }
        let asked = matches!(
            message.performative(),
            Performative::Request
                | Performative::QueryIf
                | Performative::QueryRef
                | Performative::Subscribe
        );
        if !asked {
            tracing::debug!(performative = %message.performative(), "nothing to be done about it");
            return;
        }
        match message.ontology() {
            // Routes name the incarnations of agents and gateways, and are for this host only.
            Some(routes::ONTOLOGY) if received.remote => {
                self.answer(message, sender, Performative::Refuse, |answer| {
                    answer.content("routes are told to agents of the gateway's host only")
                });
            }
            Some(routes::ONTOLOGY) => self.tell_routes(message, sender),
            _ => self.answer(message, sender, Performative::NotUnderstood, |answer| {
                answer.content("the gateway does not know this ontology")
            }),
        }
    }

    /// Another gateway tells the operator of this one about a name. One notice a second of each gateway
    /// is logged.
    fn log_notice(&self, gateway: Incarnation, message: &Message) {
        let now = Instant::now();
        let mut notices = self.notices.lock();
        notices.retain(|_, told| now.saturating_duration_since(*told) < Duration::from_secs(1));
        let all = self.neighbours.all();
        let neighbour = all.iter().find(|it| it.entry.incarnation == gateway);
        if let Some(neighbour) = neighbour
            && let Entry::Vacant(place) = notices.entry(gateway)
        {
            place.insert(now);
            let content = message.content().map(|content| &content[..]);
            let text = String::from_utf8_lossy(content.unwrap_or_default());
            let text: String = text.chars().take(MAX_NOTICE).collect();
            let (gateway, notice) = (escape(&neighbour.entry.name), escape(&text));
            tracing::warn!(%gateway, %notice, "another gateway tells of a name");
        }
    }

    fn tell_routes(&self, message: &Message, sender: Incarnation) {
        match self.report_for(message) {
            Ok(content) => self.answer(message, sender, Performative::Inform, |answer| {
                answer.language("json").content(content)
            }),
            Err(error) => self.answer(message, sender, Performative::NotUnderstood, |answer| {
                answer.content(error.to_string())
            }),
        }
    }

    fn report_for(&self, message: &Message) -> Result<Vec<u8>, Box<dyn Error>> {
        let query = match message.content() {
            Some(receivers) if !receivers.is_empty() => {
                Query::by_name(Matcher::parse(std::str::from_utf8(receivers)?)?)
            }
            _ => Query::all(),
        };
        let entries = routes::agents(&*self.view, &query);
        let neighbours = self.neighbours.all().into_iter();
        let report = routes::Report {
            neighbours: neighbours.map(Into::into).collect(),
            ..self.service.report(&entries)
        };
        Ok(serde_json::to_vec(&report)?)
    }

    /// Answers to the very life of an agent that asked.
    fn answer(
        &self,
        message: &Message,
        sender: Incarnation,
        performative: Performative,
        fill: impl FnOnce(fipa_acl::MessageBuilder) -> fipa_acl::MessageBuilder,
    ) {
        let Some(to) = self.view.by_incarnation(sender) else {
            tracing::info!("who has asked the gateway is not known any more");
            return;
        };
        let answer = message.reply(performative).sender(self.id.clone());
        match fill(answer).build() {
            Ok(answer) => self.send(&answer, &to),
            Err(error) => tracing::warn!(%error, "the gateway could not answer"),
        }
    }

    /// Sends a message in the gateway's name.
    pub(crate) fn send(&self, message: &Message, to: &fipa_sds::Entry) {
        match letter_for(message, SystemTime::now()) {
            Ok(letter) => {
                let submission = Submission {
                    sender: self.service.own.incarnation,
                    letter,
                    receivers: Vec::new(),
                    deadline: ANSWER_DEADLINE,
                };
                // It is on its way; when it fails, whoever waits for it asks again.
                drop(self.service.mts.send_to(submission, to));
            }
            Err(error) => tracing::warn!(%error, "the gateway could not write"),
        }
    }
}
