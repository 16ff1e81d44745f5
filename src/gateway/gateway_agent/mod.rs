//! The gateway agent answers the letters that agents of this host and other gateways send to the
//! gateway. It has the gateway's name and incarnation.
//!
//! The ontology of a letter selects its handler. Exchange letters are queued for another task, because they
//! take long; all others are answered at once. A request with an unknown ontology is answered
//! with `not-understood`.

pub(crate) mod questions;

use std::collections::{BTreeMap, BTreeSet};
use std::error::Error;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, ErrorChain, Message, Performative, escape, escape_name};
use fipa_mts::core::{Received, Submission};
use fipa_mts::dial::{Network, listened_at};
use fipa_mts::{Contacts as _, letter_for};
use fipa_sds::{Directory, EXCHANGE_ONTOLOGY, Entry, Matcher, Query};
use fipa_transport::{Incarnation, Location, log_limit};
use fipa_transport_net::{Refusals, RefusedDials};
use parking_lot::Mutex;
use tokio::task::JoinSet;

use self::questions::{QuestionRates, Questions};
use super::KnownPeers;
use super::exchange::{Exchanging, MANAGEMENT_ONTOLOGY};
use super::introductions::Grounds;
use super::namesakes::Namesakes;
use super::neighbors::Neighbors;
use super::open_listener::OpenListener;
use super::self_check::Arrivals;
use crate::admin::contact::{self, Introduced};
use crate::admin::routes;
use crate::domain::presence;
use crate::domain::report;
use crate::domain::service::Service;

/// Deadline for the delivery of an answer.
const ANSWER_DEADLINE: Duration = Duration::from_secs(5);

/// Maximum length of the logged text of a notice, in characters.
const MAX_NOTICE: usize = 1024;

/// The agent with the gateway's name and incarnation.
pub(crate) struct GatewayAgent {
    pub(crate) service: Arc<Service>,
    pub(crate) id: AgentId,
    pub(crate) neighbors: Arc<Neighbors>,
    pub(crate) view: Arc<dyn Directory>,
    pub(super) exchange: Arc<Exchanging>,
    pub(super) arrivals: Arrivals,
    pub(super) known_peers: Arc<KnownPeers>,
    /// The values of the configuration in use, by key.
    pub(super) configuration: Arc<Mutex<BTreeMap<String, String>>>,
    /// The HTTP listener, as soon as it is open.
    pub(super) http: Arc<OnceLock<OpenListener>>,
    /// The connections that were refused because of keys or versions.
    pub(super) refusals: Refusals,
    /// The connections of this gateway that peers refused.
    pub(super) refused_dials: RefusedDials,
    pub(super) namesakes: Arc<Namesakes>,
    /// The questions of agents of this host about agents of other hosts.
    pub(super) questions: Mutex<Questions>,
    pub(super) question_rates: Mutex<QuestionRates>,
    /// `contacts.networks` of the configuration.
    pub(super) networks: Vec<Network>,
}

/// Maximum number of introductions that are judged at a time.
const MAX_INTRODUCTIONS: usize = 16;

fn is_introduction(message: &Message) -> bool {
    message.ontology() == Some(contact::ONTOLOGY)
        && *message.performative() == Performative::Request
}

impl GatewayAgent {
    /// Reads and answers letters until the service ends.
    pub(crate) async fn run(self: Arc<Self>) {
        let (mts, own) = (&self.service.mts, self.service.own.incarnation);
        // They may resolve host names.
        let mut introductions = JoinSet::new();
        while let Some(received) = mts.receive(own).await {
            while introductions.try_join_next().is_some() {}
            match Message::decode(received.letter.payload()) {
                Ok(message) if is_introduction(&message) => {
                    let sender = received.sender;
                    let refusal = if received.remote {
                        Some("only agents of the gateway's host may introduce others")
                    } else if introductions.len() >= MAX_INTRODUCTIONS {
                        Some("the gateway resolves too many host names; try again")
                    } else {
                        None
                    };
                    if let Some(refusal) = refusal {
                        self.answer_introduction(&message, sender, Err(refusal.to_owned()));
                        continue;
                    }
                    let agent = Arc::clone(&self);
                    introductions.spawn(async move {
                        let introduced = agent.introduce(&message).await;
                        agent.answer_introduction(&message, sender, introduced);
                    });
                }
                Ok(message) => self.handle(&message, &received),
                Err(error) => {
                    log_limit::info!(of: received.service, %error, "cannot decode a letter to the gateway")
                }
            }
        }
    }

    fn handle(&self, message: &Message, received: &Received) {
        let sender = received.sender;
        if message.ontology() == Some(EXCHANGE_ONTOLOGY)
            && *message.performative() == Performative::Inform
        {
            // A gateway sends its own agents only, on its own connections.
            if received.service != sender {
                log_limit::info!(
                    of: received.service,
                    "ignored agents of a gateway: sent on a connection of another service"
                );
                return;
            }
            let content = message.content().map(|content| &content[..]);
            let content = content.unwrap_or_default();
            return self.exchange.received(&received.peer, sender, content);
        }
        if message.ontology() == Some(MANAGEMENT_ONTOLOGY)
            && *message.performative() == Performative::Failure
            && received.service == sender
        {
            return self.log_notice(sender, message);
        }
        if self.arrivals.handle(message, received) {
            return;
        }
        if message.ontology() == Some(presence::ONTOLOGY) {
            return self.handle_presence(message, received);
        }
        let asked = matches!(
            message.performative(),
            Performative::Request
                | Performative::QueryIf
                | Performative::QueryRef
                | Performative::Subscribe
        );
        if !asked {
            tracing::debug!(performative = %message.performative(), "ignored: no answer is required");
            return;
        }
        match message.ontology() {
            // Routes contain the incarnations of agents and gateways, which must not leave this
            // host.
            Some(routes::ONTOLOGY) if received.remote => {
                self.answer(message, sender, Performative::Refuse, |answer| {
                    answer.content("routes are available to agents of the gateway's host only")
                });
            }
            Some(routes::ONTOLOGY) => self.answer_routes(message, sender),
            _ => self.answer(message, sender, Performative::NotUnderstood, |answer| {
                answer.content("the gateway does not support this ontology")
            }),
        }
    }

    /// Records an agent of another platform at those of its locations that this gateway dials. Returns the reason if
    /// there are none.
    async fn introduce(&self, message: &Message) -> Result<(), String> {
        let content = message.content().map(|content| &content[..]);
        let introduced = contact::read(content.unwrap_or_default())?;
        let Introduced {
            name,
            locations,
            is_received,
        } = introduced;
        let used = locations.iter().filter(|it| self.service.uses(it.kind()));
        let used: Vec<Location> = used.cloned().collect();
        if used.is_empty() {
            let kinds: BTreeSet<_> = locations.iter().map(|it| it.kind().name()).collect();
            let kinds: Vec<_> = kinds.into_iter().collect();
            return Err(format!(
                "the gateway does not use {}; list it in mts.transports",
                kinds.join(" or ")
            ));
        }
        if let Some(known) = self.view.lookup(&name) {
            // Letters to a known name go where the directory says, whatever a received identifier states.
            if is_received {
                return Ok(());
            }
            let is_there = used.iter().any(|it| known.locations.contains(it));
            if !is_there && !known.is_unregistered_contact() {
                return Err("the directory lists another agent of this name".to_owned());
            }
        }
        let dialed = match is_received {
            false => used,
            true => {
                let grounds = Grounds {
                    takers: &self.known_peers.takers,
                    contacts: &self.known_peers.directory,
                    networks: &self.networks,
                    own: listened_at(&self.service.all_locations()),
                };
                let judged = grounds.judge(&used).await;
                if judged.permitted.is_empty() {
                    return Err(judged.reasons());
                }
                judged.permitted
            }
        };
        self.known_peers
            .introduce(&name, dialed, !is_received)
            .map_err(|error| ErrorChain(&error).to_string())?;
        self.known_peers.publish();
        Ok(())
    }

    fn answer_introduction(
        &self,
        message: &Message,
        sender: Incarnation,
        introduced: Result<(), String>,
    ) {
        match introduced {
            Ok(()) => self.answer(message, sender, Performative::Inform, |answer| answer),
            Err(reason) => self.answer(message, sender, Performative::Refuse, |answer| {
                answer.content(reason)
            }),
        }
    }

    /// Logs a notice about a name that another gateway sent to the operator of this one.
    fn log_notice(&self, gateway: Incarnation, message: &Message) {
        let all = self.neighbors.all();
        if let Some(neighbor) = all.iter().find(|it| it.entry.incarnation == gateway) {
            let content = message.content().map(|content| &content[..]);
            let text = String::from_utf8_lossy(content.unwrap_or_default());
            let text: String = text.chars().take(MAX_NOTICE).collect();
            let (gateway, notice) = (escape_name(&neighbor.entry.name), escape(&text));
            log_limit::warn!(of: neighbor.entry.incarnation, %gateway, %notice, "another gateway reports a problem with a name");
        }
    }

    fn answer_routes(&self, message: &Message, sender: Incarnation) {
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
        let entries = report::agents(&*self.view, &query);
        let neighbors = self.neighbors.all().into_iter();
        let report = routes::RouteReport {
            neighbors: neighbors.map(Into::into).collect(),
            lost: self.neighbors.lost(Instant::now()),
            refused: self.refusals.latest().into_iter().map(Into::into).collect(),
            refused_dials: self
                .refused_dials
                .latest()
                .into_iter()
                .map(Into::into)
                .collect(),
            contested: self.exchange.contested(),
            namesakes: self.namesakes.found(Instant::now()),
            configuration: self.configuration.lock().clone(),
            http: self.http.get().map(OpenListener::report),
            locations: self.service.shown_locations(),
            ..self.service.report(&entries)
        };
        Ok(serde_json::to_vec(&report)?)
    }

    /// Sends an answer to exactly the incarnation of the agent that asked.
    pub(super) fn answer(
        &self,
        message: &Message,
        sender: Incarnation,
        performative: Performative,
        fill: impl FnOnce(fipa_acl::MessageBuilder) -> fipa_acl::MessageBuilder,
    ) {
        let name = message.sender().map(AgentId::name);
        let Some(to) = name.and_then(|name| self.view.registered_as(sender, name)) else {
            log_limit::info!("dropping a reply: its requester is no longer registered");
            return;
        };
        let answer = message.reply(performative).sender(self.id.clone());
        match fill(answer).build() {
            Ok(answer) => self.send(&answer, &to),
            Err(error) => log_limit::warn!(%error, "cannot build a reply of the gateway"),
        }
    }

    /// Sends a message from the gateway.
    pub(crate) fn send(&self, message: &Message, to: &Entry) {
        match letter_for(message, SystemTime::now()) {
            Ok(letter) => {
                let submission = Submission {
                    sender: self.service.own.incarnation,
                    letter,
                    receivers: Vec::new(),
                    deadline: ANSWER_DEADLINE,
                };
                // The outcome is not awaited: a requester that gets no answer asks again.
                drop(self.service.mts.submit_to(submission, to));
            }
            Err(error) => {
                log_limit::warn!(error = %ErrorChain(&error), "cannot encode a letter of the gateway")
            }
        }
    }
}
