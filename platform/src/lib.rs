//! The two agents of every FIPA platform (FIPA00023): the agent management system ([`Ams`]) lists the
//! agents of the platform, and the directory facilitator ([`Df`]) lists the services of agents.
//!
//! Both are cores without sockets, threads and clocks: messages, the asker and [`PlatformTime`] go in,
//! [`PlatformAnswer`]s come out. Registration, deregistration, modification and search follow
//! `fipa-request`, subscriptions to the directory facilitator follow `fipa-subscribe`, in the ontology
//! [`ONTOLOGY`] and the language FIPA-SL. [`AgentDescription`] and the other descriptions are the
//! objects of that ontology; [`Exception`] has the reasons of refusals and failures. [`Function`]
//! builds the requests of clients, and [`found`], [`notified`] and [`Exception::of`] read the answers.
//!
//! ```
//! use std::time::{Instant, SystemTime};
//!
//! use fipa_acl::{AgentId, Message, Performative};
//! use fipa_platform::{
//!     AgentDescription, Asker, Constraints, Df, Function, PlatformTime, ONTOLOGY, Platform,
//!     ServiceDescription, found,
//! };
//!
//! let df = AgentId::new("df@crex-mts")?;
//! let mut facilitator = Df::new(df.clone());
//! let crane = AgentDescription {
//!     name: Some(AgentId::new("crane")?),
//!     services: vec![ServiceDescription::new("lift-1", "lifting")],
//!     ..AgentDescription::default()
//! };
//! let template = AgentDescription::from(ServiceDescription::of_type("lifting"));
//! let now = PlatformTime { at: Instant::now(), wall: SystemTime::now() };
//! for (sender, function) in [
//!     ("crane", Function::register(&crane)),
//!     ("rover", Function::search(&template, &Constraints::all())),
//! ] {
//!     let request = Message::builder(Performative::Request)
//!         .sender(AgentId::new(sender)?)
//!         .receiver(df.clone())
//!         .ontology(ONTOLOGY)
//!         .language("fipa-sl0")
//!         .content(function.content(&df)?)
//!         .build()?;
//!     let asker = Asker::new(AgentId::new(sender)?, 0, Platform::Host);
//!     facilitator.handle_message(now, &asker, &request);
//! }
//! let registered = facilitator.poll_answer().expect("an answer to each request").message;
//! assert_eq!(*registered.performative(), Performative::Inform);
//! let answer = facilitator.poll_answer().expect("an answer to each request").message;
//! assert_eq!(found(&answer)?, [crane]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Trust
//!
//! The caller states in [`Asker`] the agent and the platform that the connection of a letter proves.
//! An agent registers, modifies and deregisters its own description only. Searches need no proof, subscriptions do.
//!
//! Descriptions of agents of a host travel to the directory facilitators of other hosts
//! ([`Df::poll_local`], [`Df::handle_remote`]), so that searches there find them. The caller decides which
//! gateway may speak for an agent.
//!
//! # Successors
//!
//! [`Df::keep`] and [`Ams::keep`] return what a successor takes over with [`Df::take_over`] and
//! [`Ams::take_over`]: the descriptions with their remaining leases, and the subscriptions of agents
//! without a registration, such as those of JADE. Other subscribers see the end of the agent and subscribe
//! again.
//!
//! # Bounds
//!
//! | | in all | of a platform of another host |
//! |---|---|---|
//! | descriptions in the DF | [`limits::DESCRIPTIONS`] | [`limits::DESCRIPTIONS_OF_PLATFORM`] |
//! | … of all other hosts | [`limits::FOREIGN_DESCRIPTIONS`] | |
//! | … from the DFs of other hosts | [`limits::REMOTE_DESCRIPTIONS`] | the caller's bound |
//! | subscriptions to the DF | [`limits::SUBSCRIPTIONS`] | [`limits::SUBSCRIPTIONS_OF_PLATFORM`] |
//! | … of all other hosts | [`limits::FOREIGN_SUBSCRIPTIONS`] | |
//! | agents of other hosts in the AMS | [`limits::FOREIGN_AGENTS`] | [`limits::FOREIGN_AGENTS_OF_PLATFORM`] |
//!
//! All platforms without proof of identity share the bound of one platform. [`limits`] has the bounds
//! of single requests, descriptions and answers.
//!
//! Not in this crate: the transport of the messages, and the decision which platform a letter comes
//! from (the gateway in the crate `fipa`).

mod ams;
mod answer;
mod client;
mod description;
mod df;
mod exception;
pub mod limits;
mod matching;
mod remote;
mod request;
mod slots;
mod stored;
mod subscription;

use std::sync::Arc;
use std::time::{Instant, SystemTime};

use fipa_acl::{AgentId, Message};
use fipa_content::SlDialect;
use serde::{Deserialize, Serialize};

pub use ams::{Ams, Resident};
pub use client::{AnswerError, Function, found, notified, registered, subscription};
pub use description::{
    AgentDescription, AgentState, AmsDescription, ApDescription, Constraints, Property,
    ServiceDescription,
};
pub use df::Df;
pub use exception::Exception;
pub use remote::{LocalEntry, RemoteEntry};
pub use stored::{StoredDescription, StoredSubscription};
pub use subscription::SubscriptionId;

/// The ontology of agent management (FIPA00023). Its case is ignored on reading.
pub const ONTOLOGY: &str = "fipa-agent-management";

/// The current time.
#[derive(Debug, Clone, Copy)]
#[allow(
    clippy::exhaustive_structs,
    reason = "the shells of the cores create it"
)]
pub struct PlatformTime {
    /// The time by which leases end. A change of the clock of the host does not affect it.
    pub at: Instant,
    /// The time by which the date-times of messages are read and written.
    pub wall: SystemTime,
}

/// The agent that sent a message, as far as its connection proves it.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Asker {
    /// The identifier of the agent, with which answers name their receiver.
    pub id: AgentId,
    /// A number of the caller that identifies this registration of the agent; 0 if it has none, because its
    /// platform tells no registrations. Answers carry it.
    pub registration: u64,
    /// The platform of the agent.
    pub platform: Platform,
    /// Whether the connection proves the name. An agent without proof can search only.
    pub is_proved: bool,
    /// The dialect of SL that the agent writes and reads.
    pub dialect: SlDialect,
    /// The identifier by which it asked the agent of this crate, if that is not the agent's own but
    /// another one of it. Answers have it as their sender.
    pub asked: Option<AgentId>,
}

impl Asker {
    /// Returns an asker with a proved name, and the standard dialect. A long identifier is shortened to
    /// the name.
    #[must_use]
    pub fn new(id: AgentId, registration: u64, platform: Platform) -> Self {
        const BYTES: usize = 1024;
        let bytes: usize = id.addresses().iter().map(|it| it.len() + 1).sum();
        let is_short = bytes <= BYTES && id.resolvers().is_empty() && id.user_defined().is_empty();
        let short = (!is_short).then(|| AgentId::new(id.name()).ok());
        Self {
            id: short.flatten().unwrap_or(id),
            registration,
            platform,
            is_proved: true,
            dialect: SlDialect::Standard,
            asked: None,
        }
    }

    /// Returns the identifier of the agent of this crate in this conversation.
    pub(crate) fn asked<'a>(&'a self, own: &'a AgentId) -> &'a AgentId {
        self.asked.as_ref().unwrap_or(own)
    }
}

/// The platform of an agent, which owns the bounds that the agent uses up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(clippy::exhaustive_enums, reason = "callers decide by it")]
pub enum Platform {
    /// This host.
    Host,
    /// Another host that proved its identity: the fingerprint of its certificate.
    Proved([u8; 32]),
    /// Another host without proof of identity. All such hosts count as one platform.
    Unproved,
}

/// Returns the addresses under which the platform of an asker, with this identifier, reaches the agents of this host;
/// empty if it needs none. Answers have them in the identifiers of agents of this host without addresses; those of agents
/// of other hosts have the addresses of the same transports there.
pub type AddressBook = Arc<dyn Fn(&AgentId) -> Vec<String> + Send + Sync>;

/// Returns the addresses under which the platform of an asker reaches the agents of this host.
pub(crate) fn addresses_for(book: Option<&AddressBook>, asker: &Asker) -> Vec<String> {
    match book {
        Some(book) if asker.platform != Platform::Host => book(&asker.id),
        _ => Vec::new(),
    }
}

/// Returns an identifier with these addresses if it has none.
pub(crate) fn located(id: AgentId, addresses: &[String]) -> AgentId {
    if !id.addresses().is_empty() {
        return id;
    }
    addresses.iter().fold(id, |id, address| {
        let with = id.clone().with_address(address.as_str());
        with.unwrap_or(id)
    })
}

/// A message that an agent of this crate sends.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct PlatformAnswer {
    /// The name of the receiving agent.
    pub to: Arc<str>,
    /// The registration of the receiving agent: see [`Asker::registration`].
    pub registration: u64,
    /// The message.
    pub message: Message,
    /// The subscription, if the message is a notification of it. The caller reports the outcome of its
    /// delivery with [`Df::handle_sent`].
    pub notification: Option<SubscriptionId>,
}
