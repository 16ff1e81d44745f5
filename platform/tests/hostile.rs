//! Terms of any depth, size and kind get a typed refusal, in bounded memory.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod common;

use common::{Facilitator, Management, OTHER, asker, judged, lifting, local, message, request};
use fastrand::Rng;
use fipa_acl::{Message, Performative};
use fipa_platform::{
    AgentDescription, Constraints, Exception, Function, Property, ServiceDescription, limits,
};

fn content() -> Exception {
    Exception::UnrecognisedValue("content".to_owned())
}

#[test]
fn terms_of_any_depth_are_refused_or_executed_as_a_whole() {
    let mut it = Facilitator::new();
    for depth in [
        1, 100, 115, 116, 117, 118, 119, 120, 121, 122, 123, 128, 129, 4000,
    ] {
        let value = [&"(f ".repeat(depth)[..], "x", &")".repeat(depth)].concat();
        let name = format!("a-{depth}");
        let register = format!(
            "((action (agent-identifier :name df@mts) (register (df-agent-description :name \
             (agent-identifier :name {name}) :services (set (service-description :name s :type t \
             :properties (set (property :name p :value {value}))))))))"
        );
        let registered = it.ask(&local(&name), &register);
        let all = it.names(0.0, &AgentDescription::default());
        // What is registered can be found again, and what is refused is not there.
        assert_eq!(all.contains(&name), registered.is_ok(), "{depth}");
        match registered {
            Ok(_) => assert!(depth <= limits::DESCRIPTION_PARTS / 2),
            Err(Exception::InternalError(words)) => assert!(words.contains("too large")),
            Err(reason) => assert_eq!(reason, content()),
        }
    }
}

#[test]
fn contents_of_any_size_are_refused() {
    let mut it = Facilitator::new();
    let mut ams = Management::new();
    for length in [limits::CONTENT + 1, 1 << 20] {
        let filler = "a ".repeat(length / 2);
        let wide = format!("((action (agent-identifier :name df@mts) (search {filler})))");
        assert_eq!(it.ask(&local("rover"), &wide), Err(content()));
        assert_eq!(ams.ask(&local("rover"), &wide), Err(content()));
    }
    // Many parts within the bound of the content.
    let parts = "a ".repeat(limits::DESCRIPTION_PARTS);
    for slot in ["languages", "protocols", "ontologies", "scope"] {
        let wide = format!(
            "((action (agent-identifier :name df@mts) (register (df-agent-description :name \
             (agent-identifier :name rover) :{slot} (set {parts})))))"
        );
        let refused = it.ask(&local("rover"), &wide);
        assert!(
            matches!(refused, Err(Exception::InternalError(_))),
            "{slot}"
        );
        let wide = wide
            .replace("(register", "(search")
            .replace(")))))", ") (search-constraints)))");
        let wide = wide.replace(&format!("(set {parts})"), &format!("(set {parts}))"));
        let refused = it.ask(&local("rover"), &wide);
        assert!(refused.is_err(), "{slot}");
    }
    let long = AgentDescription {
        languages: vec!["x".repeat(limits::DESCRIPTION_BYTES)],
        ..lifting("rover")
    };
    let refused = it.call(0.0, &local("rover"), &Function::register(&long));
    assert!(matches!(refused, Err(Exception::InternalError(_))));
    let id = Constraints {
        search_id: Some("x".repeat(limits::SEARCH_IDS.1 + 1)),
        ..Constraints::all()
    };
    let search = Function::search(&AgentDescription::default(), &id);
    let refused = it.call(0.0, &local("rover"), &search);
    assert!(matches!(
        refused,
        Err(Exception::UnrecognisedParameterValue { .. })
    ));
}

/// Descriptions and templates that differ in their last part only need the most comparisons.
#[test]
fn the_work_of_a_search_is_bounded() {
    let mut it = Facilitator::new();
    let services = |count: usize, last: &str| -> Vec<ServiceDescription> {
        (0..count)
            .map(|_| ServiceDescription {
                properties: vec![Property::new(
                    "p",
                    fipa_content::Term::from(last.to_owned()),
                )],
                ..ServiceDescription::new("s", "t")
            })
            .collect()
    };
    // Three parts and the property make one service.
    let per_service = 6;
    for number in 0..limits::DESCRIPTIONS_OF_PLATFORM {
        let name = format!("far-{number}");
        let description = AgentDescription {
            services: services((limits::DESCRIPTION_PARTS - 2) / per_service, "one"),
            ..lifting(&name)
        };
        let register = Function::register(&description);
        it.call(0.0, &asker(&name, OTHER), &register).unwrap();
    }
    let mut wanted = services(limits::TEMPLATE_PARTS / per_service - 1, "one");
    wanted.extend(services(1, "two"));
    let template = AgentDescription {
        services: wanted,
        ..AgentDescription::default()
    };
    assert!(it.names(0.0, &template).is_empty());
    // A hundred texts each, and a template that compares with all of them, many times.
    let many = |names: usize, last: &str| AgentDescription {
        languages: (1..names)
            .map(|number| format!("l-{number}"))
            .chain([last.to_owned()])
            .collect(),
        ..AgentDescription::default()
    };
    for number in 0..400 {
        let name = format!("here-{number}");
        let description = AgentDescription {
            name: Some(common::id(&name)),
            ..many(120, "last")
        };
        let register = Function::register(&description);
        it.call(0.0, &local(&name), &register).unwrap();
    }
    let search = Function::search(&many(30, "other"), &Constraints::all());
    let refused = it.call(0.0, &local("rover"), &search);
    assert!(
        matches!(&refused, Err(Exception::InternalError(words)) if words.contains("comparisons")),
        "{refused:?}"
    );
    let wide = AgentDescription {
        languages: vec!["x".to_owned(); limits::TEMPLATE_PARTS + 1],
        ..AgentDescription::default()
    };
    let search = Function::search(&wide, &Constraints::all());
    let refused = it.call(0.0, &local("rover"), &search);
    assert!(matches!(refused, Err(Exception::InternalError(words)) if words.contains("template")));
}

#[test]
fn a_long_answer_is_cut() {
    let mut it = Facilitator::new();
    for number in 0..200 {
        let name = format!("crane-{number}");
        let description = AgentDescription {
            languages: vec!["x".repeat(4000)],
            ..lifting(&name)
        };
        let register = Function::register(&description);
        it.call(0.0, &local(&name), &register).unwrap();
    }
    let search = Function::search(&AgentDescription::default(), &Constraints::all());
    let answer = it.call(0.0, &local("rover"), &search).unwrap();
    assert!(answer.content().unwrap().len() < limits::RESULT_BYTES + 1024);
    let count = fipa_platform::found(&answer).unwrap().len();
    assert!((50..200).contains(&count), "{count}");
}

/// Mutations of valid requests never panic, and are answered at most once.
#[test]
fn random_contents_are_answered_once() {
    let seed = std::env::var("FIPA_FUZZ_SEED").ok();
    let seed = seed.map_or_else(|| fastrand::u64(..), |seed| seed.parse().unwrap());
    println!("FIPA_FUZZ_SEED={seed}");
    let mut random = Rng::with_seed(seed);
    let (mut df, mut ams) = (Facilitator::new(), Management::new());
    let id = common::id("df@mts");
    let seeds: Vec<Vec<u8>> = [
        Function::register(&lifting("rover")),
        Function::modify(&lifting("rover")),
        Function::deregister(&id),
        Function::search(&common::all_lifting(), &Constraints::all()),
        Function::get_description(),
    ]
    .iter()
    .map(|function| function.content(&id).unwrap())
    .chain([fipa_platform::subscription(&id, &common::all_lifting()).unwrap()])
    .collect();
    for _ in 0..3000 {
        let mut bytes = seeds[random.usize(..seeds.len())].clone();
        for _ in 0..random.usize(..6) {
            let other = &seeds[random.usize(..seeds.len())];
            let at = random.usize(..bytes.len());
            match random.u8(..4) {
                0 => bytes[at] = b"()\": \0?#a9"[random.usize(..10)],
                1 => drop(bytes.drain(at..(at + random.usize(..12)).min(bytes.len()))),
                2 => {
                    let end = at.min(other.len());
                    bytes.truncate(at);
                    bytes.extend_from_slice(&other[end..]);
                }
                _ => bytes.insert(at, random.u8(..)),
            }
            if bytes.is_empty() {
                bytes.push(b'(');
            }
        }
        let act = match random.u8(..3) {
            0 => Performative::Subscribe,
            _ => Performative::Request,
        };
        let message: Message = message(act, "rover", &bytes).build().unwrap();
        let first = df.tell(0.0, &local("rover"), &message).unwrap();
        assert!(first.notification.is_none());
        while let Some(more) = df.df.poll_answer() {
            assert!(more.notification.is_some());
        }
        ams.tell(0.0, &local("rover"), &message).unwrap();
        assert_eq!(ams.ams.poll_answer(), None);
    }
    let deregister = request("rover", &seeds[2]);
    drop(judged(df.tell(0.0, &local("rover"), &deregister).unwrap()));
}
