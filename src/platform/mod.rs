//! The directory facilitator and the agent management system of a platform (FIPA00023), as calls.
//!
//! Every gateway runs both. [`Agent::df`] and [`Agent::ams`] use those of this host;
//! [`Agent::df_of`] and [`Agent::ams_of`] use those of any platform, for example of another robot or of
//! JADE.
//!
//! ```no_run
//! use fipa::platform::{AgentDescription, ServiceDescription};
//!
//! # async fn example(crane: fipa::Agent, rover: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
//! crane
//!     .df()?
//!     .register_service(ServiceDescription::new("lift-1", "lifting"))
//!     .await?;
//!
//! let lifting = AgentDescription::from(ServiceDescription::of_type("lifting"));
//! for found in rover.df()?.search(&lifting).await? {
//!     println!("{:?}", found.name);
//! }
//! # Ok(())
//! # }
//! ```
//!
//! A description of an agent of the same host stays in its directory facilitator as long as the agent is
//! registered, or until its lease ends. A description of an agent of another host has a lease of at most
//! [`limits::LEASE`]; [`Df::modify`] renews it.
//!
//! Searches and subscriptions also return what agents of other hosts have registered with the directory
//! facilitators of their own gateways, as far as those gateways are connected. A description with a `scope`
//! other than `global` stays in its directory facilitator.
//!
//! Not in this module: the agents themselves (`fipa-platform`, and the gateway).

mod notifications;

use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{AgentId, Message, MessageBuilder, Performative, Time};
use fipa_content::PrintError;
pub use fipa_platform::{
    AgentDescription, AgentState, AmsDescription, AnswerError, ApDescription, Constraints,
    Exception, ONTOLOGY, Property, ServiceDescription, limits,
};
use fipa_platform::{Function, found, registered, subscription};
use fipa_sds::{Entry, Reach};
use fipa_transport::Incarnation;

pub use self::notifications::Notifications;
use crate::agent::{Agent, AgentCore};
use crate::domain::directory_view::DirectoryView;
use crate::protocol::{DialogueError, Request, Subscription};

/// The error of a call to a directory facilitator or an agent management system.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlatformError {
    /// This host has no such agent.
    #[error(
        "no {0} is registered on this host; start a gateway (`fipa up`), or turn the agent on \
         (`[platform]` of its configuration)"
    )]
    NoAgent(&'static str),
    /// The agent refused, failed or did not understand. Holds its reason.
    #[error("{0}")]
    Rejected(Exception),
    /// The conversation failed.
    #[error(transparent)]
    Dialogue(DialogueError),
    /// The answer cannot be read.
    #[error(transparent)]
    Answer(#[from] AnswerError),
    /// A description cannot be written.
    #[error(transparent)]
    Print(#[from] PrintError),
}

impl From<DialogueError> for PlatformError {
    fn from(error: DialogueError) -> Self {
        let reason = match &error {
            DialogueError::Refused(message)
            | DialogueError::Failed(message)
            | DialogueError::NotUnderstood(message) => Exception::of(message),
            _ => None,
        };
        reason.map_or(Self::Dialogue(error), Self::Rejected)
    }
}

impl Agent {
    /// Returns the directory facilitator of this host, which lists services of agents.
    ///
    /// # Errors
    /// If this host has none: it needs a gateway.
    pub fn df(&self) -> Result<Df<'_>, PlatformError> {
        let df = self.platform_agent(Entry::DF_TYPE);
        let df = df.ok_or(PlatformError::NoAgent("directory facilitator"))?;
        Ok(self.df_of(df))
    }

    /// Returns the directory facilitator with this identifier.
    #[must_use]
    pub fn df_of(&self, df: AgentId) -> Df<'_> {
        Df(Client {
            agent: self,
            server: df,
        })
    }

    /// Returns the agent management system of this host, which lists its agents.
    ///
    /// # Errors
    /// If this host has none: it needs a gateway.
    pub fn ams(&self) -> Result<Ams<'_>, PlatformError> {
        let ams = self.platform_agent(Entry::AMS_TYPE);
        let ams = ams.ok_or(PlatformError::NoAgent("agent management system"))?;
        Ok(self.ams_of(ams))
    }

    /// Returns the agent management system with this identifier.
    #[must_use]
    pub fn ams_of(&self, ams: AgentId) -> Ams<'_> {
        Ams(Client {
            agent: self,
            server: ams,
        })
    }

    fn platform_agent(&self, agent_type: &str) -> Option<AgentId> {
        platform_agent(&self.core, agent_type).map(|(id, _)| id)
    }
}

/// Returns the directory facilitator of the host of an agent, and its registration.
pub(crate) fn local_facilitator(agent: &AgentCore) -> Option<(AgentId, Incarnation)> {
    platform_agent(agent, Entry::DF_TYPE)
}

fn platform_agent(agent: &AgentCore, agent_type: &str) -> Option<(AgentId, Incarnation)> {
    let directory = agent.endpoint.domain.directory();
    directory.refresh();
    let entries = directory.entries();
    let here = entries.iter().filter(|entry| {
        entry.reach == Reach::Local && entry.is_platform_agent() && entry.agent_type == agent_type
    });
    // The agent may have a second name for other hosts, which is longer.
    let own = here.min_by_key(|entry| entry.name.len())?;
    Some((AgentId::new(&*own.name).ok()?, own.incarnation))
}

/// The type of a service that is a topic; see [`topics`](crate::topics).
pub(crate) const TOPIC: &str = "topic";

fn is_topic(service: &ServiceDescription) -> bool {
    service.service_type.as_deref() == Some(TOPIC)
}

/// Whether a description has no other parts than topics.
fn has_only_topics(description: &AgentDescription) -> bool {
    description.services.iter().all(is_topic)
        && description.protocols.is_empty()
        && description.ontologies.is_empty()
        && description.languages.is_empty()
}

/// Adds the topics of the description that an agent has.
fn with_topics(mut description: AgentDescription, known: AgentDescription) -> AgentDescription {
    let is_new = |topic: &ServiceDescription| {
        let mut given = description.services.iter();
        is_topic(topic) && !given.any(|service| service.name == topic.name)
    };
    let topics: Vec<_> = known.services.into_iter().filter(is_new).collect();
    description.services.extend(topics);
    description
}

/// Replaces the topics of an agent in its directory facilitator, as far as the description then still travels to other
/// hosts. Returns the end of the lease.
pub(crate) async fn replace_topics(
    agent: &Arc<AgentCore>,
    df: AgentId,
    topics: &[ServiceDescription],
) -> Result<Option<Time>, PlatformError> {
    let df = Server {
        core: Arc::clone(agent),
        id: df,
    };
    let changed = df.change_description(|own| {
        own.services.retain(|service| !is_topic(service));
        let travels = own.travels();
        for topic in topics {
            own.services.push(topic.clone());
            if travels && !own.travels() {
                own.services.pop();
                break;
            }
        }
    });
    Ok(changed.await?.lease_time)
}

/// A directory facilitator.
#[derive(Debug, Clone)]
pub struct Df<'a>(Client<'a>);

impl<'a> Df<'a> {
    /// Returns the identifier of the directory facilitator.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        &self.0.server
    }

    /// Adds a service to the description of this agent, or replaces its service of the same name.
    /// Returns the description, with its lease.
    ///
    /// # Errors
    /// If the directory facilitator refuses, fails or does not answer.
    pub async fn register_service(
        &self,
        service: ServiceDescription,
    ) -> Result<AgentDescription, PlatformError> {
        let changed = self.0.server();
        let changed = changed.change_description(|own| {
            own.services.retain(|other| other.name != service.name);
            own.services.push(service.clone());
        });
        changed.await
    }

    /// Registers a description of this agent. Its name, if it is missing, is that of this agent. Returns
    /// the description, with its lease.
    ///
    /// # Errors
    /// If the agent has a description already ([`Exception::AlreadyRegistered`]), or the directory
    /// facilitator refuses, fails or does not answer.
    pub async fn register(
        &self,
        description: AgentDescription,
    ) -> Result<AgentDescription, PlatformError> {
        let (server, description) = (self.0.server(), self.named(description));
        let _turn = server.core.topics.describing.lock().await;
        let registered = server.register(&description).await;
        let already = Exception::AlreadyRegistered;
        if !matches!(&registered, Err(PlatformError::Rejected(reason)) if *reason == already) {
            return registered;
        }
        // The list of topics may have registered the agent.
        match server.listed_topics().await? {
            Some(known) if has_only_topics(&known) => {
                server.modify(&with_topics(description, known)).await
            }
            _ => registered,
        }
    }

    /// Replaces the description of this agent, and renews its lease. The services that are
    /// [topics](crate::topics) of this agent stay.
    ///
    /// # Errors
    /// If the agent has no description ([`Exception::NotRegistered`]), or the directory
    /// facilitator refuses, fails or does not answer.
    pub async fn modify(
        &self,
        description: AgentDescription,
    ) -> Result<AgentDescription, PlatformError> {
        let (server, mut description) = (self.0.server(), self.named(description));
        let _turn = server.core.topics.describing.lock().await;
        if let Some(known) = server.listed_topics().await? {
            description = with_topics(description, known);
        }
        server.modify(&description).await
    }

    /// Removes the description of this agent. The services that are [topics](crate::topics) of this agent stay.
    ///
    /// # Errors
    /// See [`modify`](Self::modify).
    pub async fn deregister(&self) -> Result<(), PlatformError> {
        let server = self.0.server();
        let _turn = server.core.topics.describing.lock().await;
        match server.listed_topics().await? {
            Some(known) if !has_only_topics(&known) => {
                let none = self.named(AgentDescription::default());
                server.modify(&with_topics(none, known)).await.map(drop)
            }
            _ => server.deregister().await,
        }
    }

    /// Returns the descriptions that match a template: each slot of the template has its counterpart in
    /// the description, texts in any case. An answer has at most [`limits::RESULTS`] descriptions.
    ///
    /// # Errors
    /// If the directory facilitator refuses, fails or does not answer.
    pub async fn search(
        &self,
        template: &AgentDescription,
    ) -> Result<Vec<AgentDescription>, PlatformError> {
        self.search_within(template, &Constraints::all()).await
    }

    /// Searches like [`search`](Self::search), within these bounds.
    ///
    /// # Errors
    /// See [`search`](Self::search).
    pub async fn search_within(
        &self,
        template: &AgentDescription,
        constraints: &Constraints,
    ) -> Result<Vec<AgentDescription>, PlatformError> {
        self.0.server().search(template, constraints).await
    }

    /// Subscribes to the descriptions that match a template. The first notification has those that
    /// match now, if there are any.
    ///
    /// # Errors
    /// If the directory facilitator refuses, fails or does not answer.
    pub async fn subscribe(
        &self,
        template: &AgentDescription,
    ) -> Result<Notifications, PlatformError> {
        Notifications::begin(self.0.server(), template).await
    }

    fn named(&self, description: AgentDescription) -> AgentDescription {
        AgentDescription {
            name: description.name.or_else(|| Some(self.0.agent.id().clone())),
            ..description
        }
    }
}

/// An agent management system.
#[derive(Debug, Clone)]
pub struct Ams<'a>(Client<'a>);

impl Ams<'_> {
    /// Returns the identifier of the agent management system.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        &self.0.server
    }

    /// Returns the agents of the platform that match a template. An answer has at most
    /// [`limits::RESULTS`] descriptions.
    ///
    /// # Errors
    /// If the agent management system refuses, fails or does not answer.
    pub async fn search(
        &self,
        template: &AmsDescription,
    ) -> Result<Vec<AmsDescription>, PlatformError> {
        let search = Function::search_agents(template, &Constraints::all());
        let answer = self.0.request(&search).await?;
        Ok(AmsDescription::found(&answer)?)
    }

    /// Returns the description of the platform.
    ///
    /// # Errors
    /// See [`search`](Self::search).
    pub async fn description(&self) -> Result<ApDescription, PlatformError> {
        let answer = self.0.request(&Function::get_description()).await?;
        Ok(ApDescription::found(&answer)?)
    }

    /// Registers this agent. An agent of the host of the agent management system is registered already.
    ///
    /// # Errors
    /// See [`search`](Self::search).
    pub async fn register(&self, description: &AmsDescription) -> Result<(), PlatformError> {
        let register = Function::register_agent(description);
        self.0.request(&register).await.map(drop)
    }

    /// Sets the owner and the state of this agent, and renews its lease.
    ///
    /// # Errors
    /// See [`search`](Self::search).
    pub async fn modify(&self, description: &AmsDescription) -> Result<(), PlatformError> {
        let modify = Function::modify_agent(description);
        self.0.request(&modify).await.map(drop)
    }

    /// Deregisters this agent.
    ///
    /// # Errors
    /// See [`search`](Self::search).
    pub async fn deregister(&self) -> Result<(), PlatformError> {
        let own = AmsDescription {
            name: Some(self.0.agent.id().clone()),
            ..AmsDescription::default()
        };
        let deregister = Function::deregister_agent(&own);
        self.0.request(&deregister).await.map(drop)
    }
}

/// An agent of this process that asks an agent of a platform.
#[derive(Debug, Clone)]
struct Client<'a> {
    agent: &'a Agent,
    server: AgentId,
}

impl Client<'_> {
    fn server(&self) -> Server {
        Server {
            core: Arc::clone(&self.agent.core),
            id: self.server.clone(),
        }
    }

    async fn request(&self, function: &Function) -> Result<Message, PlatformError> {
        self.server().request(function).await
    }
}

/// An agent of a platform, and the agent of this process that asks it. It is no handle of that agent.
#[derive(Clone)]
struct Server {
    core: Arc<AgentCore>,
    id: AgentId,
}

impl Server {
    fn directory(&self) -> DirectoryView<'_> {
        self.core.endpoint.domain.directory()
    }

    fn timeout(&self) -> Duration {
        self.core.endpoint.domain.inner.answer_timeout()
    }

    fn message(
        &self,
        performative: Performative,
        language: &str,
        content: Vec<u8>,
    ) -> MessageBuilder {
        self.core
            .message(performative)
            .receiver(self.id.clone())
            .ontology(ONTOLOGY)
            .language(language)
            .content(content)
    }

    async fn request(&self, function: &Function) -> Result<Message, PlatformError> {
        let content = function.content(&self.id)?;
        let request = self.message(Performative::Request, "fipa-sl0", content);
        let begun = Request::begin(&self.core, "fipa-request", request, self.timeout());
        Ok(begun.await?.result().await?)
    }

    async fn register(
        &self,
        description: &AgentDescription,
    ) -> Result<AgentDescription, PlatformError> {
        let answer = self.request(&Function::register(description)).await?;
        Ok(registered(&answer)?)
    }

    async fn modify(
        &self,
        description: &AgentDescription,
    ) -> Result<AgentDescription, PlatformError> {
        let answer = self.request(&Function::modify(description)).await?;
        Ok(registered(&answer)?)
    }

    async fn deregister(&self) -> Result<(), PlatformError> {
        let function = Function::deregister(&self.core.endpoint.id);
        self.request(&function).await.map(drop)
    }

    async fn search(
        &self,
        template: &AgentDescription,
        constraints: &Constraints,
    ) -> Result<Vec<AgentDescription>, PlatformError> {
        let answer = self
            .request(&Function::search(template, constraints))
            .await?;
        Ok(found(&answer)?)
    }

    /// Returns an empty description of this agent.
    fn own(&self) -> AgentDescription {
        AgentDescription {
            name: Some(self.core.endpoint.id.clone()),
            ..AgentDescription::default()
        }
    }

    /// Returns the description of this agent if it publishes topics and has one.
    async fn listed_topics(&self) -> Result<Option<AgentDescription>, PlatformError> {
        match self.core.topics.is_empty() {
            true => Ok(None),
            false => Ok(self.search(&self.own(), &Constraints::all()).await?.pop()),
        }
    }

    /// Changes the description of this agent, which is registered if necessary and deregistered if nothing is left.
    async fn change_description(
        &self,
        change: impl Fn(&mut AgentDescription),
    ) -> Result<AgentDescription, PlatformError> {
        let _turn = self.core.topics.describing.lock().await;
        let mut own = self.own();
        if let Some(mut known) = self.search(&own, &Constraints::all()).await?.pop() {
            // The lease begins again.
            known.lease_time = None;
            change(&mut known);
            let changed = match known == own {
                true => self.deregister().await.map(|()| known),
                false => self.modify(&known).await,
            };
            match changed {
                // That description is in the directory facilitator of another host.
                Err(PlatformError::Rejected(Exception::NotRegistered)) => {}
                changed => return changed,
            }
        }
        change(&mut own);
        self.register(&own).await
    }

    async fn subscribe(&self, template: &AgentDescription) -> Result<Subscription, PlatformError> {
        let content = subscription(&self.id, template)?;
        let message = self.message(Performative::Subscribe, "fipa-sl2", content);
        Ok(Subscription::begin(&self.core, message, self.timeout()).await?)
    }
}
