//! The agent management system: the agents of the platform (FIPA00023 clause 4.2).

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, Performative};
use fipa_content::{Content, SlDialect, Term, Wff};

use crate::answer;
use crate::description::{AMS_DESCRIPTION, CONSTRAINTS, Constraints, matches_agent};
use crate::exception::Exception;
use crate::matching::max_results;
use crate::request::{self, Rejection, Request};
use crate::stored::{StoredDescription, Text, lease_left, read_object};
use crate::{
    AddressBook, AgentState, AmsDescription, ApDescription, Asker, Platform, PlatformAnswer,
    PlatformTime, addresses_for, limits, located,
};

/// The agent management system of a platform.
///
/// The agents of this host are those of the directory: the caller passes them with each message.
/// An agent that another platform registers is listed until its lease ends, and for agents of the same
/// platform only. A platform thus cannot place names in the lists of others.
///
/// The calls are those of [`Df`](crate::Df).
pub struct Ams {
    id: AgentId,
    platform: ApDescription,
    /// The owners and states that agents of this host have set for themselves.
    residents: BTreeMap<Arc<str>, (u64, AmsDescription)>,
    /// The agents that platforms of other hosts have registered.
    foreign: BTreeMap<(Platform, Arc<str>), Foreign>,
    answers: VecDeque<PlatformAnswer>,
    revision: u64,
    addresses: Option<AddressBook>,
}

impl fmt::Debug for Ams {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ams")
            .field("id", &self.id)
            .finish_non_exhaustive()
    }
}

/// An agent of this host.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(
    clippy::exhaustive_structs,
    reason = "the shell of the core creates it"
)]
pub struct Resident {
    /// The name of the agent.
    pub name: Arc<str>,
    /// Its registration: see [`Asker::registration`].
    pub registration: u64,
}

struct Foreign {
    description: AmsDescription,
    ends: Instant,
}

impl Ams {
    /// Creates an agent management system. The identifier is its own, the description that of its
    /// platform.
    #[must_use]
    pub fn new(id: AgentId, platform: ApDescription) -> Self {
        Self {
            id,
            platform,
            residents: BTreeMap::new(),
            foreign: BTreeMap::new(),
            answers: VecDeque::new(),
            revision: 0,
            addresses: None,
        }
    }

    /// Adds addresses to the agents of this host in answers.
    #[must_use]
    pub fn with_addresses(self, addresses: AddressBook) -> Self {
        Self {
            addresses: Some(addresses),
            ..self
        }
    }

    /// Changes the description of the platform.
    pub fn describe(&mut self, platform: ApDescription) {
        self.platform = platform;
    }

    /// Handles a message to the agent. `residents` are the agents of this host, sorted by name.
    pub fn handle_message(
        &mut self,
        now: PlatformTime,
        asker: &Asker,
        message: &Message,
        residents: &[Resident],
    ) {
        self.handle_timeout(now.at);
        let (act, content) = match message.performative() {
            Performative::Request => match self.request(now, asker, message, residents) {
                Ok(content) => (Performative::Inform, content),
                Err(rejection) => answer::rejected(message, asker, rejection),
            },
            act if request::expects_answer(act) => {
                let reason = Exception::UnsupportedAct(act.as_str().to_owned());
                answer::rejected(message, asker, reason.into())
            }
            _ => return,
        };
        let answer = answer::reply(message, asker, &self.id, act).content(content);
        self.answers.extend(answer::to_asker(asker, answer));
    }

    /// Ends leases.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.foreign.retain(|_, agent| agent.ends > now);
    }

    /// Returns the time of the next call of [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.foreign.values().map(|agent| agent.ends).min()
    }

    /// Returns the next message to be sent.
    pub fn poll_answer(&mut self) -> Option<PlatformAnswer> {
        self.answers.pop_front()
    }

    /// Returns what a successor takes over: the owners and states that agents of this host have set, and
    /// the agents that platforms of other hosts have registered.
    #[must_use]
    pub fn keep(&self, now: Instant) -> Vec<StoredDescription> {
        let residents = self.residents.iter().map(|(name, (registration, set))| {
            let owner = (Platform::Host, name, *registration);
            (owner, set, None)
        });
        let foreign = self.foreign.iter().map(|((platform, name), agent)| {
            let owner = (*platform, name, 0);
            (owner, &agent.description, Some(agent.ends))
        });
        let all = residents.chain(foreign);
        let all = all.filter_map(|((platform, name, registration), description, ends)| {
            Some(StoredDescription {
                name: Arc::clone(name),
                registration,
                platform,
                lease_left: lease_left(now, ends),
                text: Text::of_term(&description.to_term())?,
            })
        });
        all.collect()
    }

    /// Returns a number that differs from an earlier one if [`keep`](Self::keep) may return something
    /// else than it did then.
    #[must_use]
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// Takes over what a predecessor kept, `elapsed` before now. Left out are descriptions that are not
    /// valid, of agents of this host that are not among the `residents`, and of platforms that do not
    /// `stay`.
    pub fn take_over(
        &mut self,
        now: Instant,
        elapsed: Duration,
        descriptions: &[StoredDescription],
        residents: &[Resident],
        stays: impl Fn(Platform) -> bool,
    ) {
        for stored in descriptions.iter().filter(|stored| stays(stored.platform)) {
            let read = |term: &Term<'_>| AmsDescription::from_term(term).ok();
            let Some(description) = read_object(stored.text.as_bytes(), read) else {
                continue;
            };
            let name = description.name.as_ref();
            let is_own = name.is_some_and(|name| *name.name() == *stored.name);
            if !is_own || is_too_large(&description) {
                continue;
            }
            let name = Arc::clone(&stored.name);
            if stored.platform == Platform::Host {
                if registration_of(residents, &name) == Some(stored.registration) {
                    self.residents
                        .insert(name, (stored.registration, description));
                }
            } else if let Some(ends) = stored.ends(now, elapsed)
                && ends > now
                && self.has_room(stored.platform)
            {
                let key = (stored.platform, name);
                self.foreign.insert(key, Foreign { description, ends });
            }
        }
    }

    /// Returns the agents that platforms of other hosts have registered.
    pub fn foreign(&self) -> impl Iterator<Item = (Platform, &AmsDescription)> {
        let agents = self.foreign.iter();
        agents.map(|((platform, _), agent)| (*platform, &agent.description))
    }

    fn request<'m>(
        &mut self,
        now: PlatformTime,
        asker: &Asker,
        message: &'m Message,
        residents: &[Resident],
    ) -> Result<Vec<u8>, Rejection<'m>> {
        let request = Request::read(message, asker, &self.id)?;
        let answer = self.execute(now, asker, &request, residents);
        answer.map_err(|reason| Rejection::of(request.action, reason))
    }

    fn execute(
        &mut self,
        now: PlatformTime,
        asker: &Asker,
        request: &Request<'_>,
        residents: &[Resident],
    ) -> Result<Vec<u8>, Exception> {
        match &*request.function {
            "register" => {
                let description = own_description(asker, request)?;
                self.register(now, asker, description, residents)?;
                Ok(request.done.clone())
            }
            "modify" => {
                let description = own_description(asker, request)?;
                self.modify(now, asker, description, residents)?;
                Ok(request.done.clone())
            }
            "deregister" => {
                own_description(asker, request)?;
                self.deregister(asker, residents)?;
                Ok(request.done.clone())
            }
            "search" => {
                let [template, constraints] = request.arguments([AMS_DESCRIPTION, CONSTRAINTS])?;
                let template = AmsDescription::from_term(template)?;
                let constraints = Constraints::from_term(constraints)?;
                let found = self.search(asker, &template, &constraints, residents)?;
                answer::search_result(request, found, asker.dialect)
            }
            "get-description" => {
                request.arguments([])?;
                let description = self.platform.to_term();
                // The standard returns the description, JADE a sequence of one.
                let value = match asker.dialect {
                    SlDialect::Jade => Term::Sequence(vec![description]),
                    _ => description,
                };
                let action = Box::new(request.action.clone().into());
                let result = Wff::Result(action, Box::new(value));
                answer::printed(asker.dialect, &Content::from(result))
            }
            other => Err(Exception::UnsupportedFunction(other.to_owned())),
        }
    }

    fn register(
        &mut self,
        now: PlatformTime,
        asker: &Asker,
        description: AmsDescription,
        residents: &[Resident],
    ) -> Result<(), Exception> {
        let key = key(asker);
        if is_resident(residents, &key.1) || self.foreign.contains_key(&key) {
            return Err(Exception::AlreadyRegistered);
        }
        if asker.platform == Platform::Host {
            let words = "an agent of this host registers with the directory of the host";
            return Err(Exception::InternalError(words.to_owned()));
        }
        if !self.has_room(asker.platform) {
            let words = "no room for a further agent of this platform";
            return Err(Exception::InternalError(words.to_owned()));
        }
        let ends = now.at + limits::LEASE;
        self.foreign.insert(key, Foreign { description, ends });
        self.revision += 1;
        Ok(())
    }

    /// Whether a further agent of this platform may register.
    fn has_room(&self, platform: Platform) -> bool {
        let same = self.foreign.keys().filter(|(of, _)| *of == platform);
        self.foreign.len() < limits::FOREIGN_AGENTS
            && same.count() < limits::FOREIGN_AGENTS_OF_PLATFORM
    }

    fn modify(
        &mut self,
        now: PlatformTime,
        asker: &Asker,
        description: AmsDescription,
        residents: &[Resident],
    ) -> Result<(), Exception> {
        let key = key(asker);
        self.revision += 1;
        if asker.platform == Platform::Host && is_resident(residents, &key.1) {
            // Of agents that have ended, nothing is kept.
            self.residents.retain(|name, (registration, _)| {
                registration_of(residents, name) == Some(*registration)
            });
            let known = (asker.registration, description);
            self.residents.insert(key.1, known);
            return Ok(());
        }
        match self.foreign.get_mut(&key) {
            Some(known) => {
                known.description = description;
                known.ends = now.at + limits::LEASE;
                Ok(())
            }
            None => Err(Exception::NotRegistered),
        }
    }

    fn deregister(&mut self, asker: &Asker, residents: &[Resident]) -> Result<(), Exception> {
        let key = key(asker);
        if self.foreign.remove(&key).is_some() {
            self.revision += 1;
            return Ok(());
        }
        if asker.platform == Platform::Host && is_resident(residents, &key.1) {
            // The registration belongs to the process of the agent.
            let words = "an agent of this host is deregistered by its own process";
            return Err(Exception::InternalError(words.to_owned()));
        }
        Err(Exception::NotRegistered)
    }

    fn search(
        &self,
        asker: &Asker,
        template: &AmsDescription,
        constraints: &Constraints,
        residents: &[Resident],
    ) -> Result<Vec<Vec<u8>>, Exception> {
        let most = max_results(constraints.max_results);
        let (mut found, mut bytes) = (Vec::new(), 0);
        let residents = residents.iter().filter_map(|resident| {
            let set = self.residents.get(&resident.name);
            let set = set.filter(|(registration, _)| *registration == resident.registration);
            let set = set.map(|(_, set)| set);
            Some(AmsDescription {
                name: Some(AgentId::new(&*resident.name).ok()?),
                ownership: set.and_then(|set| set.ownership.clone()),
                state: Some(set.and_then(|set| set.state).unwrap_or(AgentState::Active)),
            })
        });
        let foreign = self.foreign.iter();
        let foreign = foreign
            .filter(|((platform, _), _)| *platform == asker.platform)
            .map(|(_, agent)| agent.description.clone());
        let addresses = addresses_for(self.addresses.as_ref(), asker);
        let residents = residents.map(|description| (description, &addresses[..]));
        for (mut description, addresses) in residents.chain(foreign.map(|it| (it, &[][..]))) {
            if found.len() >= most {
                break;
            }
            if !matches(template, &description) {
                continue;
            }
            description.name = description.name.map(|name| located(name, addresses));
            let Ok(text) = request::print(asker.dialect, &description.to_term()) else {
                continue;
            };
            if !found.is_empty() && bytes + text.len() > limits::RESULT_BYTES {
                break;
            }
            bytes += text.len();
            found.push(text);
        }
        Ok(found)
    }
}

fn key(asker: &Asker) -> (Platform, Arc<str>) {
    (asker.platform, asker.id.name().into())
}

fn is_resident(residents: &[Resident], name: &str) -> bool {
    registration_of(residents, name).is_some()
}

fn registration_of(residents: &[Resident], name: &str) -> Option<u64> {
    let found = residents.binary_search_by(|resident| (*resident.name).cmp(name));
    let resident = residents.get(found.ok()?)?;
    Some(resident.registration)
}

fn is_too_large(description: &AmsDescription) -> bool {
    let size = description.size();
    size.parts > limits::TEMPLATE_PARTS || size.bytes > limits::DESCRIPTION_BYTES
}

/// Returns the description in the request, which is the asker's own.
fn own_description(asker: &Asker, request: &Request<'_>) -> Result<AmsDescription, Exception> {
    request::authorize(asker, request)?;
    let [description] = request.arguments([AMS_DESCRIPTION])?;
    let description = AmsDescription::from_term(description)?;
    if description.name.is_none() {
        return Err(Exception::missing(AMS_DESCRIPTION, "name"));
    }
    if is_too_large(&description) {
        let words = "the description is too large";
        return Err(Exception::InternalError(words.to_owned()));
    }
    Ok(AmsDescription {
        state: description.state.or(Some(AgentState::Active)),
        ..description
    })
}

/// Whether a description matches the template (FIPA00023 clause 6.4.2.1).
fn matches(template: &AmsDescription, description: &AmsDescription) -> bool {
    let name = match (&template.name, &description.name) {
        (None, _) => true,
        (Some(template), Some(agent)) => matches_agent(template, agent),
        (Some(_), None) => false,
    };
    let ownership = match (&template.ownership, &description.ownership) {
        (None, _) => true,
        (Some(template), Some(owner)) => template.eq_ignore_ascii_case(owner),
        (Some(_), None) => false,
    };
    name && ownership
        && template
            .state
            .is_none_or(|it| Some(it) == description.state)
}
