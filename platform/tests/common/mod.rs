//! Askers, messages and answers of the tests.

#![allow(dead_code, reason = "each test file uses a part")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_platform::{
    AgentDescription, Ams, ApDescription, Asker, Constraints, Df, Exception, Function, ONTOLOGY,
    Platform, PlatformAnswer, PlatformTime, Resident, ServiceDescription,
};

pub(crate) const OTHER: Platform = Platform::Proved([7; 32]);

pub(crate) fn id(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

/// The clocks of a test, which start at 2026-11-22 12:00 UTC.
#[derive(Clone, Copy)]
pub(crate) struct Clock(Instant);

impl Clock {
    pub(crate) fn start() -> Self {
        Self(Instant::now())
    }

    pub(crate) fn after(self, seconds: f64) -> PlatformTime {
        let passed = Duration::from_secs_f64(seconds);
        PlatformTime {
            at: self.0 + passed,
            wall: wall() + passed,
        }
    }
}

pub(crate) fn wall() -> SystemTime {
    UNIX_EPOCH + Duration::from_secs(1_795_348_800)
}

/// Returns an agent of this host, or of another platform, whose registration is the length of its name.
pub(crate) fn asker(name: &str, platform: Platform) -> Asker {
    Asker::new(id(name), name.len() as u64, platform)
}

pub(crate) fn local(name: &str) -> Asker {
    asker(name, Platform::Host)
}

pub(crate) fn message(act: Performative, from: &str, content: &[u8]) -> MessageBuilder {
    Message::builder(act)
        .sender(id(from))
        .ontology(ONTOLOGY)
        .language("fipa-sl0")
        .reply_with("rw")
        .content(content.to_vec())
}

pub(crate) fn request(from: &str, content: &[u8]) -> Message {
    let request = message(Performative::Request, from, content);
    let request = request.protocol("fipa-request").conversation_id("c-1");
    request.build().unwrap()
}

pub(crate) fn text(message: &Message) -> String {
    String::from_utf8(message.content().unwrap().to_vec()).unwrap()
}

/// Returns a description with one service.
pub(crate) fn lifting(name: &str) -> AgentDescription {
    AgentDescription {
        name: Some(id(name)),
        services: vec![ServiceDescription::new(format!("{name}-lift"), "lifting")],
        ..AgentDescription::default()
    }
}

/// Returns the template of all agents that lift.
pub(crate) fn all_lifting() -> AgentDescription {
    ServiceDescription::of_type("LIFTING").into()
}

/// A directory facilitator under test.
pub(crate) struct Facilitator {
    pub(crate) df: Df,
    pub(crate) clock: Clock,
}

impl Facilitator {
    pub(crate) fn new() -> Self {
        Self {
            df: Df::new(id("df@mts")),
            clock: Clock::start(),
        }
    }

    /// Sends a message, and returns the answer if there is one.
    pub(crate) fn tell(
        &mut self,
        seconds: f64,
        asker: &Asker,
        message: &Message,
    ) -> Option<PlatformAnswer> {
        let now = self.clock.after(seconds);
        self.df.handle_message(now, asker, message);
        self.df.poll_answer()
    }

    /// Requests the function in this content. Returns the answer, or the reason of its refusal.
    pub(crate) fn ask(&mut self, asker: &Asker, content: &str) -> Result<Message, Exception> {
        let request = request(asker.id.name(), content.as_bytes());
        judged(self.tell(0.0, asker, &request).unwrap())
    }

    pub(crate) fn call(
        &mut self,
        seconds: f64,
        asker: &Asker,
        function: &Function,
    ) -> Result<Message, Exception> {
        let content = function.content(&id("df@mts")).unwrap();
        let request = request(asker.id.name(), &content);
        judged(self.tell(seconds, asker, &request).unwrap())
    }

    pub(crate) fn register(&mut self, asker: &Asker) -> Result<Message, Exception> {
        let description = lifting(asker.id.name());
        self.call(0.0, asker, &Function::register(&description))
    }

    /// Returns the names of the matching descriptions.
    pub(crate) fn names(&mut self, seconds: f64, template: &AgentDescription) -> Vec<String> {
        let search = Function::search(template, &Constraints::all());
        let answer = self.call(seconds, &local("searcher"), &search).unwrap();
        let found = fipa_platform::found(&answer).unwrap();
        names(&found)
    }
}

/// Returns the names of the agents of descriptions.
pub(crate) fn names(descriptions: &[AgentDescription]) -> Vec<String> {
    let names = descriptions.iter().map(|it| it.name.as_ref().unwrap());
    names.map(|id| id.name().to_owned()).collect()
}

/// An agent management system under test, with the agents `arm` and `rover` of this host.
pub(crate) struct Management {
    pub(crate) ams: Ams,
    pub(crate) clock: Clock,
    pub(crate) residents: Vec<Resident>,
}

impl Management {
    pub(crate) fn new() -> Self {
        let platform = ApDescription {
            name: "mts".to_owned(),
            services: vec![("tcp".to_owned(), vec!["tcp://192.0.2.1:7788".to_owned()])],
        };
        let residents = ["arm", "rover"].map(|name| Resident {
            name: name.into(),
            registration: name.len() as u64,
        });
        Self {
            ams: Ams::new(id("ams@mts"), platform),
            clock: Clock::start(),
            residents: residents.to_vec(),
        }
    }

    pub(crate) fn tell(
        &mut self,
        seconds: f64,
        asker: &Asker,
        message: &Message,
    ) -> Option<PlatformAnswer> {
        let now = self.clock.after(seconds);
        self.ams
            .handle_message(now, asker, message, &self.residents);
        self.ams.poll_answer()
    }

    pub(crate) fn ask(&mut self, asker: &Asker, content: &str) -> Result<Message, Exception> {
        let request = request(asker.id.name(), content.as_bytes());
        judged(self.tell(0.0, asker, &request).unwrap())
    }

    pub(crate) fn call(
        &mut self,
        seconds: f64,
        asker: &Asker,
        function: &Function,
    ) -> Result<Message, Exception> {
        let content = function.content(&id("ams@mts")).unwrap();
        let request = request(asker.id.name(), &content);
        judged(self.tell(seconds, asker, &request).unwrap())
    }
}

/// Returns the answer if it is an `inform`, else its reason. The performative is that of the reason.
pub(crate) fn judged(answer: PlatformAnswer) -> Result<Message, Exception> {
    let message = answer.message;
    if *message.performative() == Performative::Inform {
        return Ok(message);
    }
    let reason = Exception::of(&message).unwrap_or_else(|| panic!("{message}"));
    assert_eq!(*message.performative(), reason.performative(), "{message}");
    Err(reason)
}
