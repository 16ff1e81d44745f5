//! The agent management system: its functions, and the agents that it lists for whom.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod common;

use common::{Management, OTHER, asker, id, local, message, text};
use fipa_acl::{Message, Performative};
use fipa_content::SlDialect;
use fipa_platform::{
    AgentState, AmsDescription, ApDescription, Asker, Constraints, Exception, Function, Platform,
    Resident, limits,
};

fn agent(name: &str) -> AmsDescription {
    AmsDescription {
        name: Some(id(name)),
        ..AmsDescription::default()
    }
}

/// Returns the names of the agents that the asker finds.
fn found(it: &mut Management, seconds: f64, asker: &Asker) -> Vec<String> {
    let search = Function::search_agents(&AmsDescription::default(), &Constraints::all());
    let answer = it.call(seconds, asker, &search).unwrap();
    let found = AmsDescription::found(&answer).unwrap();
    let names = found.iter().map(|it| it.name.as_ref().unwrap());
    names.map(|id| id.name().to_owned()).collect()
}

#[test]
fn agents_of_the_host_are_listed_without_registration() {
    let mut it = Management::new();
    assert_eq!(found(&mut it, 0.0, &local("arm")), ["arm", "rover"]);
    let registered = it.call(0.0, &local("arm"), &Function::register_agent(&agent("arm")));
    assert_eq!(registered, Err(Exception::AlreadyRegistered));
    let template = AmsDescription {
        state: Some(AgentState::Active),
        ..agent("ROVER")
    };
    let search = Function::search_agents(&template, &Constraints::all());
    let answer = it.call(0.0, &local("arm"), &search).unwrap();
    assert_eq!(
        text(&answer),
        "((result (action (agent-identifier :name ams@mts) (search (ams-agent-description :name \
         (agent-identifier :name ROVER) :state active) (search-constraints :max-results -1))) \
         (sequence (ams-agent-description :name (agent-identifier :name rover) :state active))))"
    );
    // Without max-results, one is returned.
    let search = Function::search_agents(&AmsDescription::default(), &Constraints::default());
    let answer = it.call(0.0, &local("arm"), &search).unwrap();
    assert_eq!(AmsDescription::found(&answer).unwrap().len(), 1);
}

#[test]
fn an_agent_of_the_host_sets_its_owner_and_state_until_it_ends() {
    let mut it = Management::new();
    let waiting = AmsDescription {
        ownership: Some("ACME".to_owned()),
        state: Some(AgentState::Waiting),
        ..agent("arm")
    };
    let modify = Function::modify_agent(&waiting);
    it.call(0.0, &local("arm"), &modify).unwrap();
    let refused = it.call(0.0, &local("rover"), &modify);
    assert_eq!(refused, Err(Exception::Unauthorised));
    let template = AmsDescription {
        name: None,
        ..waiting.clone()
    };
    let search = Function::search_agents(&template, &Constraints::all());
    let listed = |it: &mut Management| {
        let answer = it.call(0.0, &local("rover"), &search).unwrap();
        AmsDescription::found(&answer).unwrap()
    };
    assert_eq!(listed(&mut it), [waiting]);
    let deregister = it.call(
        0.0,
        &local("arm"),
        &Function::deregister_agent(&agent("arm")),
    );
    assert!(
        matches!(deregister, Err(Exception::InternalError(_))),
        "{deregister:?}"
    );
    // A new registration of the name is another agent.
    it.residents[0].registration += 1;
    assert_eq!(listed(&mut it), []);
    let unknown = it.call(
        0.0,
        &local("crane"),
        &Function::modify_agent(&agent("crane")),
    );
    assert_eq!(unknown, Err(Exception::NotRegistered));
}

#[test]
fn an_agent_of_another_platform_is_listed_for_that_platform_until_its_lease_ends() {
    let mut it = Management::new();
    let far = asker("far@jade", OTHER);
    let register = Function::register_agent(&agent("far@jade"));
    it.call(0.0, &far, &register).unwrap();
    let again = it.call(0.0, &far, &register);
    assert_eq!(again, Err(Exception::AlreadyRegistered));
    let peer = asker("peer@jade", OTHER);
    assert_eq!(found(&mut it, 0.0, &peer), ["arm", "rover", "far@jade"]);
    for stranger in [local("arm"), asker("x", Platform::Unproved)] {
        assert_eq!(found(&mut it, 0.0, &stranger), ["arm", "rover"]);
    }
    // It cannot take the name of an agent of this host, or register another agent.
    let arm = asker("arm", OTHER);
    let taken = it.call(0.0, &arm, &Function::register_agent(&agent("arm")));
    assert_eq!(taken, Err(Exception::AlreadyRegistered));
    let other = it.call(0.0, &far, &Function::register_agent(&agent("peer@jade")));
    assert_eq!(other, Err(Exception::Unauthorised));
    let mut unproved = peer.clone();
    unproved.is_proved = false;
    let refused = it.call(
        0.0,
        &unproved,
        &Function::register_agent(&agent("peer@jade")),
    );
    assert_eq!(refused, Err(Exception::Unauthorised));

    let lease = limits::LEASE.as_secs_f64();
    let modify = Function::modify_agent(&agent("far@jade"));
    it.call(10.0, &far, &modify).unwrap();
    assert_eq!(it.ams.poll_timeout(), Some(it.clock.after(lease + 10.0).at));
    assert_eq!(found(&mut it, lease, &peer).len(), 3);
    assert_eq!(found(&mut it, lease + 10.0, &peer).len(), 2);
    let gone = it.call(lease + 10.0, &far, &modify);
    assert_eq!(gone, Err(Exception::NotRegistered));
    it.call(lease + 10.0, &far, &register).unwrap();
    let deregister = Function::deregister_agent(&agent("far@jade"));
    it.call(lease + 10.0, &far, &deregister).unwrap();
    let again = it.call(lease + 10.0, &far, &deregister);
    assert_eq!(again, Err(Exception::NotRegistered));
}

#[test]
fn agents_of_other_platforms_are_bounded() {
    let mut it = Management::new();
    let mut register = |name: &str, platform| {
        let register = Function::register_agent(&agent(name));
        it.call(0.0, &asker(name, platform), &register)
    };
    let is_full = |answer: Result<Message, Exception>| match answer {
        Err(Exception::InternalError(words)) => words.contains("no room"),
        _ => false,
    };
    for number in 0..limits::FOREIGN_AGENTS_OF_PLATFORM {
        register(&format!("far-{number}"), OTHER).unwrap();
    }
    assert!(is_full(register("far", OTHER)));
    let mut count = limits::FOREIGN_AGENTS_OF_PLATFORM;
    while count < limits::FOREIGN_AGENTS {
        let platform = Platform::Proved([u8::try_from(count / 100 + 10).unwrap(); 32]);
        register(&format!("p-{count}"), platform).unwrap();
        count += 1;
    }
    assert!(is_full(register("late", Platform::Proved([99; 32]))));
}

#[test]
fn the_platform_is_described_for_the_standard_and_for_jade() {
    let mut it = Management::new();
    let get = Function::get_description();
    let answer = it.call(0.0, &local("arm"), &get).unwrap();
    let expected = ApDescription {
        name: "mts".to_owned(),
        services: vec![("tcp".to_owned(), vec!["tcp://192.0.2.1:7788".to_owned()])],
    };
    assert_eq!(ApDescription::found(&answer).unwrap(), expected);
    assert!(text(&answer).contains("(get-description)) (ap-description :name mts"));
    let mut jade = asker("x@jade", Platform::Unproved);
    jade.dialect = SlDialect::Jade;
    let answer = it.call(0.0, &jade, &get).unwrap();
    assert!(
        text(&answer).contains("(sequence (ap-description"),
        "{answer}"
    );
    assert_eq!(ApDescription::found(&answer).unwrap(), expected);
    let wrong = it.ask(
        &local("arm"),
        "((action (agent-identifier :name ams@mts) (get-description 1)))",
    );
    assert_eq!(wrong, Err(Exception::UnexpectedArgumentCount));
}

#[test]
fn mistakes_are_refused() {
    let mut it = Management::new();
    let arm = local("arm");
    let object = "ams-agent-description".to_owned();
    let action = |act: &str| format!("((action (agent-identifier :name ams@mts) {act}))");
    let parameter = |parameter: &str| (object.clone(), parameter.to_owned());
    let ((object_1, state), (object_2, name)) = (parameter("state"), parameter("name"));
    for (act, expected) in [
        ("(kill)", Exception::UnsupportedFunction("kill".to_owned())),
        (
            "(modify (ams-agent-description :name (agent-identifier :name arm) :state dead))",
            Exception::UnrecognisedParameterValue {
                object: object_1,
                parameter: state,
            },
        ),
        (
            "(modify (ams-agent-description :state active))",
            Exception::MissingParameter {
                object: object_2,
                parameter: name,
            },
        ),
        (
            "(register (df-agent-description))",
            Exception::UnexpectedArgument("df-agent-description".to_owned()),
        ),
    ] {
        assert_eq!(it.ask(&arm, &action(act)), Err(expected), "{act}");
    }
    let subscribe = message(Performative::Subscribe, "arm", b"?")
        .build()
        .unwrap();
    let answer = it.tell(0.0, &arm, &subscribe).unwrap();
    let unsupported = Exception::UnsupportedAct("subscribe".to_owned());
    assert_eq!(common::judged(answer), Err(unsupported));
}

#[test]
fn a_long_list_is_cut() {
    let mut it = Management::new();
    it.residents = (0..3000)
        .map(|number| Resident {
            name: format!("{number:0200}").into(),
            registration: number,
        })
        .collect();
    let search = Function::search_agents(&AmsDescription::default(), &Constraints::all());
    let answer = it.call(0.0, &local("arm"), &search).unwrap();
    let length = answer.content().unwrap().len();
    assert!(length < limits::RESULT_BYTES + 1024, "{length}");
    let count = AmsDescription::found(&answer).unwrap().len();
    assert!((100..=limits::RESULTS).contains(&count), "{count}");
}
