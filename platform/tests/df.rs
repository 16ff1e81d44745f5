//! The directory facilitator: its functions, and the order of its refusals (FIPA00023).

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod common;

use common::{
    Facilitator, OTHER, all_lifting, asker, id, lifting, local, message, names, request, text, wall,
};
use fipa_acl::{Message, Performative, Time};
use fipa_content::SlDialect;
use fipa_platform::{
    AgentDescription, Asker, Constraints, Exception, Function, Platform, Property,
    ServiceDescription, found, limits, notified, registered, subscription,
};
use std::time::Duration;

fn missing(object: &str, parameter: &str) -> Exception {
    let (object, parameter) = (object.to_owned(), parameter.to_owned());
    Exception::MissingParameter { object, parameter }
}

#[test]
fn a_description_is_registered_found_modified_and_deregistered() {
    let mut it = Facilitator::new();
    let crane = local("crane");
    let answer = it.register(&crane).unwrap();
    assert_eq!(
        text(&answer),
        "((done (action (agent-identifier :name df@mts) (register (df-agent-description :name \
         (agent-identifier :name crane) :services (set (service-description :name crane-lift :type \
         lifting)))))))"
    );
    assert_eq!(answer.in_reply_to(), Some("rw"));
    assert_eq!(answer.conversation_id(), Some("c-1"));
    assert_eq!(answer.protocol(), Some("fipa-request"));
    assert_eq!(answer.receivers(), [id("crane")]);
    assert_eq!(registered(&answer).unwrap(), lifting("crane"));
    assert_eq!(it.register(&crane), Err(Exception::AlreadyRegistered));
    assert_eq!(it.names(0.0, &all_lifting()), ["crane"]);

    let towing = AgentDescription {
        services: vec![ServiceDescription::new("tow-1", "towing")],
        ..lifting("crane")
    };
    it.call(0.0, &crane, &Function::modify(&towing)).unwrap();
    assert!(it.names(0.0, &all_lifting()).is_empty());
    let deregister = Function::deregister(&id("crane"));
    it.call(0.0, &crane, &deregister).unwrap();
    assert!(it.names(0.0, &AgentDescription::default()).is_empty());
    let again = it.call(0.0, &crane, &deregister);
    assert_eq!(again, Err(Exception::NotRegistered));
    let modified = it.call(0.0, &crane, &Function::modify(&towing));
    assert_eq!(modified, Err(Exception::NotRegistered));
}

#[test]
fn an_agent_changes_its_own_description_only() {
    let mut it = Facilitator::new();
    it.register(&local("crane")).unwrap();
    for function in [
        Function::register(&lifting("other")),
        Function::modify(&lifting("crane")),
        Function::deregister(&id("crane")),
    ] {
        let refused = it.call(0.0, &local("rover"), &function);
        assert_eq!(refused, Err(Exception::Unauthorised));
        // The same name at another platform, and without proof.
        let mut unproved = local("crane");
        unproved.is_proved = false;
        let refused = it.call(0.0, &unproved, &function);
        assert_eq!(refused, Err(Exception::Unauthorised));
    }
    for function in [
        Function::modify(&lifting("crane")),
        Function::deregister(&id("crane")),
    ] {
        let refused = it.call(0.0, &asker("crane", OTHER), &function);
        assert_eq!(refused, Err(Exception::Unauthorised));
    }
    let taken = it.register(&asker("crane", OTHER));
    assert_eq!(taken, Err(Exception::AlreadyRegistered));
    assert_eq!(it.names(0.0, &all_lifting()), ["crane"]);
}

/// `fipa df` and JADE write the same values in other ways.
#[test]
fn values_of_properties_are_compared_by_their_types() {
    let mut it = Facilitator::new();
    let value = |text: &'static str| fipa_content::Term::parse(text).unwrap();
    let crane = local("crane");
    let registered = ServiceDescription {
        properties: vec![
            Property::new("indoor", value("true")),
            Property::new("load", value("5")),
            Property::new("range", value("1.0E10")),
            Property::new("model", value("\"5\"")),
            Property::new("size", value("\".5\"")),
            Property::new("color", value("red")),
        ],
        ..ServiceDescription::new("lift-1", "lifting")
    };
    assert_eq!(registered.property("load"), Some(&value("5")));
    assert_eq!(registered.property("weight"), None);
    let description = AgentDescription {
        services: vec![registered],
        ..lifting("crane")
    };
    it.call(0.0, &crane, &Function::register(&description))
        .unwrap();
    for (name, text, is_found) in [
        ("indoor", "true", true),
        ("indoor", "TRUE", true),
        ("indoor", "false", false),
        ("indoor", "\"true\"", false),
        ("load", "5", true),
        ("load", "+5", true),
        ("load", "0x5", true),
        ("load", "6", false),
        ("load", "5.0", false),
        ("load", "\"5\"", false),
        ("range", "1e10", true),
        ("range", "10000000000.", true),
        ("range", "10000000000", false),
        ("range", "1e11", false),
        ("model", "\"5\"", true),
        ("model", "5", false),
        // JADE writes this text without quotation marks.
        ("size", ".5", true),
        ("size", "0.5", false),
        ("color", "\"RED\"", true),
    ] {
        let template = AgentDescription {
            services: vec![ServiceDescription {
                properties: vec![Property::new(name, value(text))],
                ..ServiceDescription::default()
            }],
            ..AgentDescription::default()
        };
        let found = it.names(0.0, &template);
        assert_eq!(!found.is_empty(), is_found, "{name}={text}");
    }
}

#[test]
fn a_template_matches_descriptions_with_all_of_its_slots() {
    let mut it = Facilitator::new();
    let full = AgentDescription {
        protocols: vec!["fipa-request".to_owned()],
        ontologies: vec!["cranes".to_owned(), "loads".to_owned()],
        languages: vec!["fipa-sl0".to_owned()],
        services: vec![
            ServiceDescription::new("tow-1", "towing"),
            ServiceDescription {
                ownership: Some("ACME".to_owned()),
                properties: vec![
                    Property::new("load", fipa_content::Term::from("5 t")),
                    Property::new("color", fipa_content::Term::from("red")),
                ],
                ..ServiceDescription::new("lift-1", "lifting")
            },
        ],
        ..lifting("crane")
    };
    let crane = local("crane");
    it.call(0.0, &crane, &Function::register(&full)).unwrap();
    it.register(&local("arm")).unwrap();

    let service = |service| AgentDescription {
        services: vec![service],
        ..AgentDescription::default()
    };
    let property = |name: &str, value: Option<&'static str>| {
        service(ServiceDescription {
            properties: vec![Property {
                name: name.to_owned(),
                value: value.map(fipa_content::Term::from),
            }],
            ..ServiceDescription::of_type("lifting")
        })
    };
    let nothing = AgentDescription::default;
    let cases: [(AgentDescription, &[&str]); 12] = [
        (nothing(), &["arm", "crane"]),
        (all_lifting(), &["arm", "crane"]),
        (service(ServiceDescription::of_type("towing")), &["crane"]),
        (
            AgentDescription {
                name: Some(id("CRANE")),
                ..nothing()
            },
            &["crane"],
        ),
        (
            AgentDescription {
                ontologies: vec!["loads".to_owned()],
                ..nothing()
            },
            &["crane"],
        ),
        (
            AgentDescription {
                ontologies: vec!["loads".to_owned(), "ships".to_owned()],
                ..nothing()
            },
            &[],
        ),
        // One service has the type, another one the name.
        (service(ServiceDescription::new("tow-1", "lifting")), &[]),
        (property("load", None), &["crane"]),
        (property("load", Some("5 T")), &["crane"]),
        (property("load", Some("6 t")), &[]),
        (property("weight", None), &[]),
        (
            service(ServiceDescription {
                ownership: Some("acme".to_owned()),
                ..ServiceDescription::default()
            }),
            &["crane"],
        ),
    ];
    for (template, expected) in cases {
        assert_eq!(it.names(0.0, &template), expected, "{template:?}");
    }
    let answer = it.call(
        0.0,
        &local("searcher"),
        &Function::search(
            &service(ServiceDescription::of_type("towing")),
            &Constraints::all(),
        ),
    );
    assert_eq!(found(&answer.unwrap()).unwrap(), [full]);
}

#[test]
fn constraints_bound_a_search() {
    let mut it = Facilitator::new();
    for number in 0..3 {
        it.register(&local(&format!("crane-{number}"))).unwrap();
    }
    let mut count = |max_results: Option<i64>, search_id: Option<&str>| {
        let constraints = Constraints {
            max_depth: Some(3),
            max_results,
            search_id: search_id.map(str::to_owned),
        };
        let search = Function::search(&all_lifting(), &constraints);
        let answer = it.call(0.0, &local("searcher"), &search);
        answer.map(|answer| found(&answer).unwrap().len())
    };
    assert_eq!(count(None, None), Ok(1));
    assert_eq!(count(Some(0), None), Ok(0));
    assert_eq!(count(Some(2), None), Ok(2));
    assert_eq!(count(Some(-1), Some("s-1")), Ok(3));
    let served = Exception::InternalError("search-id already served".to_owned());
    assert_eq!(count(Some(-1), Some("s-1")), Err(served));
    // The number of remembered identifiers is bounded; the oldest are forgotten.
    for number in 0..limits::SEARCH_IDS.0 {
        count(Some(0), Some(&format!("n-{number}"))).unwrap();
    }
    assert_eq!(count(Some(-1), Some("s-1")), Ok(3));
}

/// FIPA00023 clause 6.3: a message with several mistakes is refused for the first one in this order.
#[test]
fn mistakes_are_reported_in_the_order_of_the_standard() {
    let mut it = Facilitator::new();
    let rover = local("rover");
    let reason = |it: &mut Facilitator, message: Message| {
        let answer = it.tell(0.0, &local("rover"), &message).unwrap();
        common::judged(answer).unwrap_err()
    };
    let action = |act: &str| format!("((action (agent-identifier :name df@mts) {act}))");
    let own = "(df-agent-description :name (agent-identifier :name rover)";
    // Act, language, ontology, content.
    let wrong = message(Performative::QueryRef, "rover", b"(");
    let wrong = wrong.language("prolog").ontology("x").build().unwrap();
    let unsupported = Exception::UnsupportedAct("query-ref".to_owned());
    assert_eq!(reason(&mut it, wrong), unsupported);
    let wrong = message(Performative::Request, "rover", b"(");
    let wrong = wrong.language("prolog").ontology("x").build().unwrap();
    let unsupported = |value: &str| Exception::UnsupportedValue(value.to_owned());
    assert_eq!(reason(&mut it, wrong), unsupported("language"));
    let wrong = message(Performative::Request, "rover", b"(").ontology("x");
    assert_eq!(
        reason(&mut it, wrong.build().unwrap()),
        unsupported("ontology")
    );
    let content = Exception::UnrecognisedValue("content".to_owned());
    for unreadable in [
        "(",
        "((p))",
        "((action rover (search)))",
        "()",
        "((action x y z))",
    ] {
        assert_eq!(
            it.ask(&rover, unreadable),
            Err(content.clone()),
            "{unreadable}"
        );
    }
    // Authorization, function, arguments, parameters, execution.
    let text = |text: &str| text.to_owned();
    let object = "df-agent-description";
    let unexpected = |object: &str, parameter: &str| Exception::UnexpectedParameter {
        object: object.to_owned(),
        parameter: parameter.to_owned(),
    };
    let unrecognised = |object: &str, parameter: &str| Exception::UnrecognisedParameterValue {
        object: object.to_owned(),
        parameter: parameter.to_owned(),
    };
    let other = "(df-agent-description :name (agent-identifier :name x) :wrong 1)";
    let search = |rest: &str| format!("(search (df-agent-description) {rest})");
    let cases = [
        (
            format!("(register {other} {other})"),
            Exception::Unauthorised,
        ),
        (text("(fly)"), Exception::UnsupportedFunction(text("fly"))),
        (text("fly"), Exception::UnsupportedFunction(text("fly"))),
        (text("(register)"), Exception::MissingArgument(text(object))),
        (text("register"), Exception::MissingArgument(text(object))),
        (
            text("(register :description (df-agent-description))"),
            Exception::UnexpectedArgument(text("description")),
        ),
        (
            format!("(register {own}) 1)"),
            Exception::UnexpectedArgumentCount,
        ),
        (
            text("(register (ams-agent-description))"),
            Exception::UnexpectedArgument(text("ams-agent-description")),
        ),
        (
            text("(register (df-agent-description))"),
            missing(object, "name"),
        ),
        (
            text("(deregister (df-agent-description))"),
            missing(object, "name"),
        ),
        (
            text("(register (df-agent-description :name 5))"),
            unrecognised(object, "name"),
        ),
        (
            format!("(register {own} :wrong 1))"),
            unexpected(object, "wrong"),
        ),
        (
            format!("(register {own} :languages (set a) :languages (set b)))"),
            unexpected(object, "languages"),
        ),
        (
            format!("(register {own} :languages a))"),
            unrecognised(object, "languages"),
        ),
        (
            format!("(register {own} :services (set (service-description :type a))))"),
            missing("service-description", "name"),
        ),
        (
            format!("(register {own} :services (set (service-description :name a))))"),
            missing("service-description", "type"),
        ),
        (
            format!("(register {own} :services (set (pose :name a))))"),
            unrecognised(object, "services"),
        ),
        (
            format!("(register {own} :lease-time 20200101T000000000Z))"),
            unrecognised(object, "lease-time"),
        ),
        (format!("(modify {own}))"), Exception::NotRegistered),
        (
            text("(search (df-agent-description))"),
            Exception::MissingArgument(text("search-constraints")),
        ),
        (
            search("(search-constraints :max-results many)"),
            unrecognised("search-constraints", "max-results"),
        ),
        (
            search("(search-constraints :max-width 1)"),
            unexpected("search-constraints", "max-width"),
        ),
    ];
    for (act, expected) in cases {
        assert_eq!(it.ask(&rover, &action(&act)), Err(expected), "{act}");
    }
    // An action of another agent.
    let other = "((action (agent-identifier :name arm) (search (df-agent-description) (search-constraints))))";
    assert_eq!(it.ask(&rover, other), Err(Exception::Unauthorised));
    // User-defined slots are allowed, and case does not matter.
    let allowed =
        action(&format!("(Register {own} :X-color red))")).replace("df-agent", "DF-agent");
    it.ask(&rover, &allowed).unwrap();
}

#[test]
fn an_answer_to_an_answer_is_never_sent() {
    let mut it = Facilitator::new();
    for act in [
        Performative::Inform,
        Performative::Failure,
        Performative::NotUnderstood,
        Performative::Refuse,
        Performative::Agree,
        Performative::AcceptProposal,
    ] {
        let message = message(act, "rover", b"?").build().unwrap();
        assert_eq!(it.tell(0.0, &local("rover"), &message), None);
    }
}

#[test]
fn answers_go_to_the_asker_and_nowhere_else() {
    let mut it = Facilitator::new();
    let search = Function::search(&all_lifting(), &Constraints::all());
    let content = search.content(&id("df@mts")).unwrap();
    let request = message(Performative::Request, "victim", &content);
    let request = request.reply_to(id("victim")).build().unwrap();
    let answer = it.tell(0.0, &asker("rover", OTHER), &request).unwrap();
    assert_eq!((&*answer.to, answer.registration), ("rover", 5));
    assert_eq!(answer.message.receivers(), [id("rover")]);
}

#[test]
fn leases_are_capped_and_end() {
    let mut it = Facilitator::new();
    let until = |seconds| {
        let time = Time::from_system_time(wall() + Duration::from_secs(seconds));
        Some(time.unwrap())
    };
    let with_lease = |name: &str, lease_time| AgentDescription {
        lease_time,
        ..lifting(name)
    };
    let hour = limits::LEASE.as_secs();
    // Of this host: no lease, and a long one. Of another: none, a short one and a long one.
    for (name, platform, asked, granted) in [
        ("a", Platform::Host, None, None),
        ("b", Platform::Host, until(9 * hour), until(9 * hour)),
        ("c", OTHER, None, until(hour)),
        ("d", OTHER, until(10), until(10)),
        ("e", OTHER, until(9 * hour), until(hour)),
    ] {
        let register = Function::register(&with_lease(name, asked));
        let answer = it.call(0.0, &asker(name, platform), &register).unwrap();
        assert_eq!(
            registered(&answer).unwrap(),
            with_lease(name, granted),
            "{name}"
        );
    }
    let hour = hour as f64;
    assert_eq!(it.names(0.0, &all_lifting()), ["a", "b", "c", "d", "e"]);
    assert_eq!(it.df.poll_timeout(), Some(it.clock.after(10.0).at));
    assert_eq!(it.names(10.0, &all_lifting()), ["a", "b", "c", "e"]);
    // A modification renews the lease.
    let renew = Function::modify(&lifting("e"));
    it.call(20.0, &asker("e", OTHER), &renew).unwrap();
    assert_eq!(it.names(hour, &all_lifting()), ["a", "b", "e"]);
    it.df.handle_timeout(it.clock.after(hour + 20.0).at);
    let remaining: Vec<_> = it.df.descriptions().cloned().collect();
    assert_eq!(names(&remaining), ["a", "b"]);
    assert_eq!(it.df.poll_timeout(), Some(it.clock.after(9.0 * hour).at));
    // Relative times become absolute.
    let relative = Time::after(Duration::from_secs(30)).unwrap();
    let register = Function::register(&with_lease("f", Some(relative)));
    let answer = it.call(0.0, &local("f"), &register).unwrap();
    assert_eq!(registered(&answer).unwrap().lease_time, until(30));
}

#[test]
fn what_an_agent_of_this_host_registered_ends_with_it() {
    let mut it = Facilitator::new();
    it.register(&local("crane")).unwrap();
    it.register(&local("arm")).unwrap();
    it.register(&asker("far", OTHER)).unwrap();
    subscribe(&mut it, &local("crane"), "s-1");
    assert!(it.df.poll_answer().unwrap().notification.is_some());
    assert_eq!(it.df.subscriptions(), 1);
    let now = it.clock.after(1.0).at;
    it.df
        .handle_departures(now, |name, registration| (name, registration) == ("arm", 3));
    assert_eq!(it.names(1.0, &all_lifting()), ["arm", "far"]);
    assert_eq!(it.df.subscriptions(), 0);
    // Another registration of the same name is not the agent that registered the description.
    it.df.handle_departures(now, |name, _| name == "none");
    assert_eq!(it.names(1.0, &all_lifting()), ["far"]);
}

fn subscribe_message(from: &str, conversation: &str) -> Message {
    let content = subscription(&id("df@mts"), &all_lifting()).unwrap();
    let subscribe = message(Performative::Subscribe, from, &content);
    let subscribe = subscribe.language("fipa-sl2").protocol("fipa-subscribe");
    subscribe.conversation_id(conversation).build().unwrap()
}

fn subscribe(it: &mut Facilitator, asker: &Asker, conversation: &str) {
    let message = subscribe_message(asker.id.name(), conversation);
    let agreed = it.tell(0.0, asker, &message).unwrap().message;
    assert_eq!(*agreed.performative(), Performative::Agree, "{agreed}");
}

#[test]
fn a_subscriber_is_notified_of_each_change() {
    let mut it = Facilitator::new();
    it.register(&local("crane")).unwrap();
    let rover = local("rover");
    subscribe(&mut it, &rover, "s-1");
    let next = |it: &mut Facilitator| {
        let answer = it.df.poll_answer()?;
        let id = answer.notification?;
        assert_eq!(*answer.message.performative(), Performative::Inform);
        assert_eq!(answer.message.conversation_id(), Some("s-1"));
        assert_eq!(answer.message.in_reply_to(), Some("rw"));
        Some((id, notified(&answer.message).unwrap()))
    };
    // The first notification has what is there.
    let (id_, first) = next(&mut it).unwrap();
    assert_eq!(first, [lifting("crane")]);
    // While it is under way, changes are collected.
    it.register(&local("arm")).unwrap();
    it.call(0.0, &local("crane"), &Function::deregister(&id("crane")))
        .unwrap();
    let unrelated = AgentDescription {
        services: vec![ServiceDescription::new("tow-1", "towing")],
        ..lifting("tug")
    };
    it.call(0.0, &local("tug"), &Function::register(&unrelated))
        .unwrap();
    assert_eq!(next(&mut it), None);
    assert_eq!(it.df.poll_timeout(), None);
    it.df.handle_timeout(it.clock.after(10.0).at);
    assert_eq!(next(&mut it), None, "the first one is under way");
    it.df.handle_sent(it.clock.after(0.1).at, id_, true);
    assert_eq!(next(&mut it), None, "too early");
    let pause = limits::NOTIFICATION_PAUSE.as_secs_f64();
    assert_eq!(it.df.poll_timeout(), Some(it.clock.after(pause).at));
    it.df.handle_timeout(it.clock.after(pause).at);
    let (id_, second) = next(&mut it).unwrap();
    let gone = AgentDescription {
        name: Some(id("crane")),
        ..AgentDescription::default()
    };
    assert_eq!(second, [lifting("arm"), gone]);
    // A description that no longer matches is reported as it is now.
    it.df.handle_sent(it.clock.after(1.0).at, id_, true);
    let towing = AgentDescription {
        name: Some(id("arm")),
        ..unrelated
    };
    let modify = Function::modify(&towing);
    let content = modify.content(&id("df@mts")).unwrap();
    let request = request("arm", &content);
    it.df
        .handle_message(it.clock.after(5.0), &local("arm"), &request);
    assert!(it.df.poll_answer().unwrap().notification.is_none());
    let (id_, third) = next(&mut it).unwrap();
    assert_eq!(third, [towing]);
    // A subscriber that cannot be reached is forgotten.
    it.df.handle_sent(it.clock.after(6.0).at, id_, false);
    assert_eq!(it.df.subscriptions(), 0);
}

#[test]
fn a_subscription_is_cancelled_by_its_subscriber() {
    let mut it = Facilitator::new();
    subscribe(&mut it, &local("rover"), "s-1");
    let cancel = message(Performative::Cancel, "rover", b"").conversation_id("s-1");
    let cancel = cancel.build().unwrap();
    let other = it.tell(0.0, &local("crane"), &cancel).unwrap().message;
    assert_eq!(*other.performative(), Performative::Failure);
    assert_eq!(it.df.subscriptions(), 1);
    let done = it.tell(0.0, &local("rover"), &cancel).unwrap().message;
    assert_eq!(*done.performative(), Performative::Inform);
    assert_eq!(it.df.subscriptions(), 0);
}

#[test]
fn a_subscription_without_proof_or_with_another_query_is_refused() {
    let mut it = Facilitator::new();
    let mut unproved = local("rover");
    unproved.is_proved = false;
    let subscribe = subscribe_message("rover", "s-1");
    let answer = it.tell(0.0, &unproved, &subscribe).unwrap();
    assert_eq!(common::judged(answer), Err(Exception::Unauthorised));
    for content in [
        "((iota ?x (p ?x)))",
        "((action (agent-identifier :name df@mts) (search (df-agent-description) (search-constraints))))",
    ] {
        let other = message(Performative::Subscribe, "rover", content.as_bytes());
        let answer = it
            .tell(0.0, &local("rover"), &other.build().unwrap())
            .unwrap();
        let content = Exception::UnrecognisedValue("content".to_owned());
        assert_eq!(common::judged(answer), Err(content));
    }
    assert_eq!(it.df.subscriptions(), 0);
}

#[test]
fn descriptions_are_bounded_per_platform_and_in_all() {
    let mut it = Facilitator::new();
    let is_full = |refused: Result<Message, Exception>| matches!(refused, Err(Exception::InternalError(words)) if words.contains("no room"));
    for number in 0..limits::DESCRIPTIONS_OF_PLATFORM {
        it.register(&asker(&format!("far-{number}"), OTHER))
            .unwrap();
    }
    assert!(is_full(it.register(&asker("far", OTHER))));
    // All platforms without proof are one.
    for number in 0..limits::DESCRIPTIONS_OF_PLATFORM {
        let name = format!("unproved-{number}");
        it.register(&asker(&name, Platform::Unproved)).unwrap();
    }
    assert!(is_full(it.register(&asker("unproved", Platform::Unproved))));
    // Other hosts leave room for this one.
    let (foreign, of_one) = (
        limits::FOREIGN_DESCRIPTIONS,
        limits::DESCRIPTIONS_OF_PLATFORM,
    );
    for platform in 1..u8::try_from(foreign / of_one - 1).unwrap() {
        for number in 0..limits::DESCRIPTIONS_OF_PLATFORM {
            let name = format!("p-{platform}-{number}");
            let of = Platform::Proved([platform; 32]);
            it.register(&asker(&name, of)).unwrap();
        }
    }
    assert!(is_full(
        it.register(&asker("late", Platform::Proved([99; 32])))
    ));
    for number in foreign..limits::DESCRIPTIONS {
        it.register(&local(&format!("here-{number}"))).unwrap();
    }
    assert!(is_full(it.register(&local("here"))));
    assert_eq!(it.df.descriptions().count(), limits::DESCRIPTIONS);
    // An end of one makes room for another.
    it.call(
        0.0,
        &asker("far-0", OTHER),
        &Function::deregister(&id("far-0")),
    )
    .unwrap();
    it.register(&asker("far", OTHER)).unwrap();
}

#[test]
fn subscriptions_are_bounded_per_agent_platform_and_in_all() {
    let mut it = Facilitator::new();
    let agree = |it: &mut Facilitator, asker: &Asker, conversation: &str| {
        let message = subscribe_message(asker.id.name(), conversation);
        let answer = it.tell(0.0, asker, &message).unwrap().message;
        while it.df.poll_answer().is_some() {}
        *answer.performative() == Performative::Agree
    };
    for number in 0..limits::SUBSCRIPTIONS_OF_AGENT {
        assert!(agree(&mut it, &local("rover"), &format!("s-{number}")));
    }
    assert!(!agree(&mut it, &local("rover"), "one more"));
    // The same conversation replaces its subscription, and needs no further room.
    assert!(agree(&mut it, &local("rover"), "s-1"));
    let before = it.df.subscriptions();
    for platform in 0..8 {
        for number in 0..limits::SUBSCRIPTIONS_OF_PLATFORM {
            let of = Platform::Proved([platform; 32]);
            let far = asker(&format!("far-{number}"), of);
            let is_free = it.df.subscriptions() - before < limits::FOREIGN_SUBSCRIPTIONS;
            assert_eq!(agree(&mut it, &far, "s"), is_free);
        }
    }
    let all = it.df.subscriptions();
    assert_eq!(all - before, limits::FOREIGN_SUBSCRIPTIONS);
    // A further one of a platform ends its oldest, which is told.
    let message = subscribe_message("new", "s");
    let far = asker("new", Platform::Proved([0; 32]));
    it.df.handle_message(it.clock.after(0.0), &far, &message);
    let ended = it.df.poll_answer().unwrap();
    assert_eq!(&*ended.to, "far-0");
    assert_eq!(*ended.message.performative(), Performative::Failure);
    assert_eq!(it.df.subscriptions(), all);
    let mut number = 0;
    while it.df.subscriptions() < limits::SUBSCRIPTIONS {
        number += 1;
        assert!(agree(&mut it, &local(&format!("here-{number}")), "s"));
    }
    assert!(!agree(&mut it, &local("here"), "s"));
}

#[test]
fn a_jade_agent_is_answered_in_its_dialect() {
    let mut it = Facilitator::new();
    let mut jade = asker("jade@host", Platform::Unproved);
    jade.dialect = SlDialect::Jade;
    let wrong = message(Performative::Request, "jade@host", b"((p))").language("prolog");
    let answer = it.tell(0.0, &jade, &wrong.build().unwrap()).unwrap();
    assert_eq!(text(&answer.message), "((Unsupported-value language))");
    assert_eq!(
        Exception::of(&answer.message),
        Some(Exception::UnsupportedValue("language".to_owned()))
    );
    let request = request("jade@host", b"((action (agent-identifier :name df@mts) (deregister (df-agent-description :name (agent-identifier :name jade@host)))))");
    let answer = it.tell(0.0, &jade, &request).unwrap();
    // SLCodec has a blank after the last of several expressions.
    assert_eq!(
        text(&answer.message),
        "((action (agent-identifier :name df@mts) (deregister (df-agent-description :name \
         (agent-identifier :name jade@host)))) not-registered )"
    );
}

#[test]
fn a_long_notification_goes_on_with_the_next() {
    let mut it = Facilitator::new();
    for number in 0..30 {
        let name = format!("crane-{number:02}");
        let long = AgentDescription {
            languages: vec!["x".repeat(7000)],
            ..lifting(&name)
        };
        it.call(0.0, &local(&name), &Function::register(&long))
            .unwrap();
    }
    subscribe(&mut it, &local("rover"), "s-1");
    let (mut all, mut count) = (Vec::new(), 0);
    while let Some(answer) = it.df.poll_answer() {
        let length = answer.message.content().unwrap().len();
        assert!(length < limits::NOTIFICATION_BYTES + 1024, "{length}");
        all.extend(notified(&answer.message).unwrap());
        count += 1;
        let now = it.clock.after(f64::from(count)).at;
        it.df.handle_sent(now, answer.notification.unwrap(), true);
    }
    assert_eq!((names(&all).len(), count), (30, 4));
}
