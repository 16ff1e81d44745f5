//! Messages to the agent management system and the directory facilitator from malicious agents of this
//! host and of others, and from an honest one.
//!
//! * Each message gets at most one answer, which goes to the agent that sent the message.
//! * The description of the honest agent is changed by that agent only.
//! * Subscriptions and descriptions stay within their bounds, also those from other hosts.

use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_platform::{
    AgentDescription, Ams, AmsDescription, ApDescription, Asker, Constraints, Df, Function,
    ONTOLOGY, Platform, PlatformTime, RemoteEntry, Resident, ServiceDescription, found, limits,
    subscription,
};

use crate::input::Input;

const HONEST: &str = "crane";
const NAMES: [&str; 4] = ["rover", "arm", HONEST, "df@mts"];
const PLATFORMS: [Platform; 4] = [
    Platform::Host,
    Platform::Proved([1; 32]),
    Platform::Proved([2; 32]),
    Platform::Unproved,
];

fn id(name: &str) -> AgentId {
    AgentId::new(name).expect("a name")
}

fn description(name: &str) -> AgentDescription {
    AgentDescription {
        name: Some(id(name)),
        services: vec![ServiceDescription::new("lift-1", "lifting")],
        ..AgentDescription::default()
    }
}

/// Returns an agent that is not the honest one: of another host, with another name, or without proof.
fn asker(input: &mut Input<'_>) -> Asker {
    let (name, platform) = (input.one_of(&NAMES), input.one_of(&PLATFORMS));
    let mut asker = Asker::new(id(name), u64::from(input.byte()), platform);
    asker.is_proved = input.below(4) != 0;
    if input.below(4) == 0 {
        asker.dialect = fipa_content::SlDialect::Jade;
    }
    if name == HONEST && platform == Platform::Host {
        asker.is_proved = false;
    }
    asker
}

/// Returns the content of a valid request, with some of its bytes replaced.
fn content(input: &mut Input<'_>) -> Vec<u8> {
    let agent = id(if input.below(2) == 0 {
        "df@mts"
    } else {
        "ams@mts"
    });
    let own = input.one_of(&NAMES);
    let management = AmsDescription {
        name: Some(id(own)),
        ..AmsDescription::default()
    };
    let template = AgentDescription {
        name: None,
        ..description(own)
    };
    let content = match input.below(10) {
        0 => Function::register(&description(own)).content(&agent),
        1 => Function::modify(&description(own)).content(&agent),
        2 => Function::deregister(&id(own)).content(&agent),
        3 => Function::search(&template, &Constraints::all()).content(&agent),
        4 => Function::register_agent(&management).content(&agent),
        5 => Function::modify_agent(&management).content(&agent),
        6 => Function::deregister_agent(&management).content(&agent),
        7 => Function::get_description().content(&agent),
        8 => subscription(&agent, &template),
        _ => return input.long_bytes().to_vec(),
    };
    let mut content = content.expect("a content");
    for _ in 0..input.below(4) {
        let place = usize::from(u16::from_le_bytes([input.byte(), input.byte()]));
        let place = place % (content.len() + 1);
        let (remove, insert) = (input.below(12), input.bytes(40));
        let end = (place + remove).min(content.len());
        drop(content.splice(place..end, insert.iter().copied()));
    }
    content
}

/// Returns what the directory facilitators of other hosts sent: valid texts, some of them with other
/// bytes, or any text.
fn remote(input: &mut Input<'_>, now: PlatformTime) -> Vec<RemoteEntry> {
    let one = |input: &mut Input<'_>| {
        let name = input.one_of(&NAMES);
        let text = match input.below(6) {
            0 => input.long_bytes().to_vec(),
            1 => b"(df-agent-description)".to_vec(),
            _ => {
                let mut text = description(name).to_term().to_string().into_bytes();
                for _ in 0..input.below(3) {
                    let place = usize::from(input.byte()) % (text.len() + 1);
                    let (remove, insert) = (input.below(12), input.bytes(40));
                    let end = (place + remove).min(text.len());
                    drop(text.splice(place..end, insert.iter().copied()));
                }
                text
            }
        };
        RemoteEntry {
            name: name.into(),
            source: u64::from(input.byte() % 3),
            text: String::from_utf8_lossy(&text).into(),
            addresses: vec![String::from_utf8_lossy(input.bytes(40)).into()],
            ends: now.at + input.time().min(Duration::from_secs(3600)),
            has_lease: input.below(2) == 0,
        }
    };
    (0..input.below(4)).map(|_| one(input)).collect()
}

fn message(input: &mut Input<'_>, from: &Asker) -> Option<Message> {
    let act = match input.below(8) {
        0 => Performative::Subscribe,
        1 => Performative::Cancel,
        2 => input.one_of(&[
            Performative::Inform,
            Performative::Failure,
            Performative::QueryRef,
            Performative::NotUnderstood,
        ]),
        _ => Performative::Request,
    };
    let language = input.one_of(&["fipa-sl0", "fipa-sl0", "FIPA-SL", "prolog"]);
    let message = Message::builder(act)
        .sender(from.id.clone())
        .ontology(input.one_of(&[ONTOLOGY, ONTOLOGY, "FIPA-Agent-Management", "x"]))
        .language(language)
        .conversation_id(input.one_of(&["a", "b", "c"]))
        .content(content(input));
    message.build().ok()
}

/// Runs both agents with the messages and events that the bytes encode.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let mut now = PlatformTime {
        at: Instant::now(),
        wall: SystemTime::UNIX_EPOCH + Duration::from_secs(1_795_348_800),
    };
    let mut df = Df::new(id("df@mts"));
    let mut ams = Ams::new(id("ams@mts"), ApDescription::default());
    let residents = ["arm", HONEST, "rover"].map(|name| Resident {
        name: name.into(),
        registration: 7,
    });
    let honest = Asker::new(id(HONEST), 7, Platform::Host);
    let register = Function::register(&description(HONEST)).content(&id("df@mts"));
    let register = request(register.expect("a content"));
    df.handle_message(now, &honest, &register);
    assert_eq!(
        df.poll_answer().map(|it| it.message.performative().clone()),
        Some(Performative::Inform)
    );
    while !input.is_empty() {
        match input.below(9) {
            8 => {
                let entries = remote(&mut input, now);
                df.handle_remote(now, &entries);
                let known = df.remote_descriptions().count();
                assert!(known <= entries.len());
                drop(df.poll_local());
            }
            0 => {
                let passed = input.time().min(Duration::from_secs(7200));
                now.at += passed;
                now.wall += passed;
                df.handle_timeout(now.at);
                ams.handle_timeout(now.at);
            }
            1 => {
                // All agents of this host but the honest one and those of this number end.
                let kept = u64::from(input.byte());
                df.handle_departures(now.at, |name, registration| {
                    name == HONEST || registration == kept
                });
            }
            2 => {
                let from = asker(&mut input);
                let Some(message) = message(&mut input, &from) else {
                    continue;
                };
                ams.handle_message(now, &from, &message, &residents);
                if let Some(answer) = ams.poll_answer() {
                    assert_eq!(answer.registration, from.registration);
                    assert_eq!(*answer.to, *from.id.name());
                }
                assert!(ams.poll_answer().is_none());
            }
            _ => {
                let from = asker(&mut input);
                let Some(message) = message(&mut input, &from) else {
                    continue;
                };
                df.handle_message(now, &from, &message);
                let mut answered = false;
                let mut notified = Vec::new();
                while let Some(answer) = df.poll_answer() {
                    match answer.notification {
                        Some(id) => notified.push(id),
                        // A subscription that ended for another one.
                        None if answer.message.conversation_id() != message.conversation_id()
                            || answer.registration != from.registration => {}
                        None => {
                            assert!(!answered, "two answers");
                            answered = true;
                            assert_eq!(*answer.to, *from.id.name());
                        }
                    }
                }
                for id in notified {
                    df.handle_sent(now.at, id, input.byte() % 8 != 0);
                }
            }
        }
        while df.poll_answer().is_some() {}
        assert!(df.descriptions().count() <= limits::DESCRIPTIONS);
        assert!(df.subscriptions() <= limits::SUBSCRIPTIONS);
        assert!(ams.foreign().count() <= limits::FOREIGN_AGENTS);
        // Each lease that has ended is gone after a timeout.
        df.handle_timeout(now.at);
        while df.poll_answer().is_some() {}
        assert!(df.poll_timeout().is_none_or(|due| due > now.at));
        let own = df
            .descriptions()
            .find(|it| it.name.as_ref().is_some_and(|id| id.name() == HONEST));
        assert_eq!(own, Some(&description(HONEST)));
    }
    // Whatever was registered is found, and can be read again.
    let search = Function::search(&AgentDescription::default(), &Constraints::all());
    let search = request(search.content(&id("df@mts")).expect("a content"));
    df.handle_message(now, &honest, &search);
    while let Some(answer) = df.poll_answer() {
        if answer.notification.is_none() {
            let all = found(&answer.message).expect("the result of a search");
            assert!(all.contains(&description(HONEST)));
        }
    }
}

fn request(content: Vec<u8>) -> Message {
    let request = Message::builder(Performative::Request)
        .sender(id(HONEST))
        .ontology(ONTOLOGY)
        .language("fipa-sl0")
        .content(content);
    request.build().expect("a message")
}
