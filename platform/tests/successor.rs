//! A successor takes over what its predecessor kept, through text as in a file.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod common;

use std::time::Duration;

use common::{
    Facilitator, Management, OTHER, all_lifting, asker, id, lifting, local, message, names,
};
use fipa_acl::{AgentId, Message, Performative, Time};
use fipa_content::{SlDialect, Term};
use fipa_platform::{
    AgentDescription, AgentState, AmsDescription, Asker, Constraints, Exception, Function,
    Platform, ServiceDescription, StoredDescription, StoredSubscription, limits, notified,
    subscription,
};

fn subscribe_message(from: &str, conversation: &str) -> Message {
    let content = subscription(&id("df@mts"), &all_lifting()).unwrap();
    let subscribe = message(Performative::Subscribe, from, &content);
    let subscribe = subscribe.language("fipa-sl2").protocol("fipa-subscribe");
    subscribe.conversation_id(conversation).build().unwrap()
}

/// Returns an agent of a platform that tells no registrations.
fn unregistered(name: &str, platform: Platform) -> Asker {
    Asker::new(id(name), 0, platform)
}

fn subscribe(it: &mut Facilitator, asker: &Asker, conversation: &str) {
    let message = subscribe_message(asker.id.name(), conversation);
    let answer = it.tell(0.0, asker, &message).unwrap();
    assert_eq!(*answer.message.performative(), Performative::Agree);
}

type Kept = (Vec<StoredDescription>, Vec<StoredSubscription>);

/// Passes what is kept through text.
fn stored(it: &Facilitator, seconds: f64) -> Kept {
    let stored = it.df.keep(it.clock.after(seconds).at);
    let text = serde_json::to_string(&stored).unwrap();
    let read = serde_json::from_str(&text).unwrap();
    assert_eq!(stored, read);
    read
}

/// Returns a facilitator that takes over `elapsed` seconds later.
fn successor(stored: &Kept, elapsed: f64, stays: impl Fn(Platform) -> bool) -> Facilitator {
    let mut it = Facilitator::new();
    let now = it.clock.after(0.0);
    let elapsed = Duration::from_secs_f64(elapsed);
    it.df.take_over(now, elapsed, (&stored.0, &stored.1), stays);
    it
}

/// Returns the descriptions of the next notification.
fn notification(it: &mut Facilitator, seconds: f64) -> Option<(Asker, Vec<AgentDescription>)> {
    it.df.handle_timeout(it.clock.after(seconds).at);
    let answer = it.df.poll_answer()?;
    let found = notified(&answer.message).unwrap();
    it.df
        .handle_sent(it.clock.after(seconds).at, answer.notification?, true);
    let to = answer.message.receivers()[0].clone();
    Some((Asker::new(to, answer.registration, OTHER), found))
}

/// Delivers all answers.
fn drain(it: &mut Facilitator) {
    while let Some(answer) = it.df.poll_answer() {
        if let Some(id) = answer.notification {
            it.df.handle_sent(it.clock.after(0.0).at, id, true);
        }
    }
}

/// A description with each slot, and a text that is not UTF-8.
fn full(name: &str) -> AgentDescription {
    let service = ServiceDescription::new("lift \"1\"", "lifting")
        .with_property("load", "12 kg")
        .with_property("raw", Term::Bytes(vec![0xff, 0, b'"'].into()));
    AgentDescription {
        languages: vec!["fipa-sl é".to_owned()],
        services: vec![service],
        ..lifting(name)
    }
}

#[test]
fn descriptions_come_back_with_their_leases() {
    let mut it = Facilitator::new();
    let leased = AgentDescription {
        lease_time: Some(Time::from_system_time(common::wall() + Duration::from_secs(60)).unwrap()),
        ..lifting("leased")
    };
    for (asker, description) in [
        (local("zebra"), full("zebra")),
        (local("crane"), lifting("crane")),
        (local("leased"), leased),
        (asker("jade", Platform::Unproved), lifting("jade")),
        (asker("far", OTHER), full("far")),
    ] {
        it.call(0.0, &asker, &Function::register(&description))
            .unwrap();
    }
    let before: Vec<_> = it.df.descriptions().cloned().collect();
    let file = stored(&it, 10.0);
    let mut next = successor(&file, 20.0, |_| true);
    assert!(next.df.descriptions().eq(&before));
    // The order of registration, which decides what travels to other hosts.
    let announced = next.df.poll_local().unwrap();
    let announced: Vec<&str> = announced.iter().map(|it| &*it.name).collect();
    assert_eq!(announced, ["zebra", "crane", "leased"]);
    // 60 seconds, of which 30 have passed.
    assert_eq!(next.names(29.0, &all_lifting()).len(), 5);
    assert_eq!(next.names(31.0, &all_lifting()).len(), 4);
    let hour = limits::LEASE.as_secs_f64();
    assert_eq!(next.names(hour - 31.0, &all_lifting()).len(), 4);
    assert_eq!(next.names(hour - 29.0, &all_lifting()), ["crane", "zebra"]);
    // Agents change what they registered with the predecessor.
    let deregister = Function::deregister(&id("crane"));
    next.call(0.0, &local("crane"), &deregister).unwrap();
    assert_eq!(
        next.register(&local("zebra")),
        Err(Exception::AlreadyRegistered)
    );
    // Agents that ended while there was no facilitator end with the first call.
    let late = successor(&file, 3600.0, |_| true);
    assert_eq!(late.df.descriptions().count(), 2);
}

#[test]
fn subscriptions_of_other_hosts_go_on_and_miss_nothing() {
    let mut it = Facilitator::new();
    let mut jade = unregistered("jade", Platform::Unproved);
    jade.dialect = SlDialect::Jade;
    let far = unregistered("far", OTHER);
    // The others subscribe again.
    let others = [local("rover"), asker("farther", OTHER)];
    for subscriber in [&jade, &far, &others[0], &others[1]] {
        subscribe(&mut it, subscriber, "s-1");
    }
    for name in ["crane", "arm"] {
        it.register(&local(name)).unwrap();
    }
    let mut first = Vec::new();
    while let Some(answer) = it.df.poll_answer() {
        first.push(answer);
    }
    // The first notification was on its way when the facilitator ended.
    assert_eq!(first.len(), 4);
    let file = stored(&it, 0.0);
    let mut next = successor(&file, 1.0, |_| true);
    assert_eq!(next.df.subscriptions(), 2);
    // An agent of this host ended meanwhile.
    let now = next.clock.after(0.0).at;
    next.df.handle_departures(now, |name, _| name != "arm");
    for subscriber in [&jade, &far] {
        let (to, found) = notification(&mut next, 0.0).unwrap();
        assert_eq!(to.id, subscriber.id);
        assert_eq!(to.registration, subscriber.registration);
        assert_eq!(names(&found), ["crane", "arm"]);
        assert!(found[1].services.is_empty());
    }
    assert!(notification(&mut next, 1.0).is_none());
    // The next successor does not repeat delivered notifications.
    let file = stored(&next, 1.0);
    let mut next = successor(&file, 1.0, |_| true);
    assert!(notification(&mut next, 0.0).is_none());
    next.register(&local("tower")).unwrap();
    assert!(notification(&mut next, 1.0).is_some());
    // The subscriber ends its subscription.
    let cancel = message(Performative::Cancel, "far", b"");
    let cancel = cancel.conversation_id("s-1").build().unwrap();
    next.tell(2.0, &far, &cancel).unwrap();
    assert_eq!(next.df.subscriptions(), 1);
}

#[test]
fn after_too_many_changes_all_that_match_are_told_again() {
    let mut it = Facilitator::new();
    subscribe(&mut it, &unregistered("far", OTHER), "s-1");
    for number in 0..300 {
        it.register(&local(&format!("crane-{number}"))).unwrap();
    }
    let mut next = successor(&stored(&it, 0.0), 1.0, |_| true);
    let mut announced = 0;
    let mut seconds = 0.0;
    while let Some((_, found)) = notification(&mut next, seconds) {
        announced += found.len();
        seconds += 1.0;
    }
    assert_eq!(announced, 300);
}

#[test]
fn platforms_without_trust_leave_nothing_and_their_end_is_told() {
    let mut it = Facilitator::new();
    for name in ["far", "farther"] {
        it.register(&asker(name, OTHER)).unwrap();
    }
    for subscriber in [
        unregistered("far", OTHER),
        unregistered("jade", Platform::Unproved),
    ] {
        subscribe(&mut it, &subscriber, "s-1");
        drain(&mut it);
    }
    let mut next = successor(&stored(&it, 0.0), 1.0, |platform| platform != OTHER);
    assert_eq!(next.df.descriptions().count(), 0);
    assert_eq!(next.df.subscriptions(), 1);
    let (to, found) = notification(&mut next, 0.0).unwrap();
    assert_eq!(to.id, id("jade"));
    assert_eq!(names(&found), ["far", "farther"]);
    assert!(found.iter().all(|it| it.services.is_empty()));
}

#[test]
fn what_is_not_valid_is_left_out() {
    let mut it = Facilitator::new();
    it.register(&local("crane")).unwrap();
    it.register(&asker("far", OTHER)).unwrap();
    subscribe(&mut it, &unregistered("far", OTHER), "s-1");
    let text = serde_json::to_string(&it.df.keep(it.clock.after(0.0).at)).unwrap();
    for (from, to) in [
        // Another agent, another object, a query for another facilitator.
        (":name crane)", ":name arm)"),
        ("df-agent-description", "ams-agent-description"),
        ("(set (", "(set (("),
        ("iota", "any"),
        ("df@mts", "df@other"),
    ] {
        assert!(text.contains(from), "{from} is not in {text}");
        let file: Kept = serde_json::from_str(&text.replace(from, to)).unwrap();
        let next = successor(&file, 0.0, |_| true);
        let all = next.df.descriptions().count() + next.df.subscriptions();
        assert!(all < 3, "{to}");
    }
    // Bounds hold, and no description of another host has a longer lease than such a host gets.
    let (mut file, _): Kept = serde_json::from_str(&text).unwrap();
    let mut far = file.pop().unwrap();
    far.lease_left = Some(u64::MAX);
    let json = serde_json::to_string(&far).unwrap();
    let all: Vec<StoredDescription> = (0..limits::DESCRIPTIONS_OF_PLATFORM + 10)
        .map(|number| serde_json::from_str(&json.replace("far", &format!("far{number}"))).unwrap())
        .collect();
    let mut next = successor(&(all, Vec::new()), 0.0, |_| true);
    assert_eq!(
        next.df.descriptions().count(),
        limits::DESCRIPTIONS_OF_PLATFORM
    );
    next.df.handle_timeout(next.clock.after(3601.0).at);
    assert_eq!(next.df.descriptions().count(), 0);
}

#[test]
fn the_revision_changes_with_what_is_kept() {
    let mut it = Facilitator::new();
    let mut before = (it.df.revision(), stored(&it, 0.0));
    let far = asker("far", OTHER);
    let crane = local("crane");
    let modified = Function::modify(&full("crane"));
    let steps: [&dyn Fn(&mut Facilitator); 6] = [
        &|it| drop(it.register(&crane)),
        &|it| subscribe(it, &unregistered("jade", OTHER), "s-1"),
        &|it| drop(it.call(0.0, &crane, &modified)),
        &|it| drop(it.register(&far)),
        &|it| drop(it.call(0.0, &crane, &Function::deregister(&id("crane")))),
        &|it| it.df.handle_timeout(it.clock.after(4000.0).at),
    ];
    for (number, step) in steps.iter().enumerate() {
        step(&mut it);
        drain(&mut it);
        let after = (it.df.revision(), stored(&it, 0.0));
        assert!(after.0 != before.0 && after.1 != before.1, "step {number}");
        before = after;
    }
    // Searches change nothing.
    it.names(4000.0, &all_lifting());
    assert_eq!(it.df.revision(), before.0);
}

#[test]
fn agents_and_owners_come_back() {
    let mut it = Management::new();
    let of = |name: &str, owner: &str| AmsDescription {
        name: Some(id(name)),
        ownership: Some(owner.to_owned()),
        state: Some(AgentState::Suspended),
    };
    for (asker, function) in [
        (local("arm"), Function::modify_agent(&of("arm", "me"))),
        (local("rover"), Function::modify_agent(&of("rover", "me"))),
        (
            asker("far", OTHER),
            Function::register_agent(&of("far", "x")),
        ),
        (
            asker("jade", Platform::Unproved),
            Function::register_agent(&of("jade", "x")),
        ),
    ] {
        let before = it.ams.revision();
        it.call(0.0, &asker, &function).unwrap();
        assert_ne!(it.ams.revision(), before);
    }
    let text = serde_json::to_string(&it.ams.keep(it.clock.after(0.0).at)).unwrap();
    let file: Vec<StoredDescription> = serde_json::from_str(&text).unwrap();
    let mut next = Management::new();
    // Another agent has the name of the one that ended.
    next.residents[1].registration = 77;
    let now = next.clock.after(0.0).at;
    let (ten, hour) = (Duration::from_secs(10), Duration::from_secs(3600));
    let stays = |platform| platform != OTHER;
    next.ams.take_over(now, ten, &file, &next.residents, stays);
    let search = Function::search_agents(&AmsDescription::default(), &Constraints::all());
    let answer = next.call(0.0, &asker("jade", Platform::Unproved), &search);
    let found = AmsDescription::found(&answer.unwrap()).unwrap();
    let active = AmsDescription {
        name: Some(id("rover")),
        ownership: None,
        state: Some(AgentState::Active),
    };
    assert_eq!(found, [of("arm", "me"), active, of("jade", "x")]);
    assert_eq!(next.ams.foreign().count(), 1);
    next.ams.handle_timeout(next.clock.after(3591.0).at);
    assert_eq!(next.ams.foreign().count(), 0);
    let mut late = Management::new();
    late.ams
        .take_over(now, hour, &file, &late.residents, |_| true);
    assert_eq!(late.ams.foreign().count(), 0);
}

#[test]
fn a_subscriber_that_asked_by_a_second_name_is_answered_from_it() {
    let mut it = Facilitator::new();
    let mut far = unregistered("far", OTHER);
    far.asked = Some(AgentId::new("df@mts~2").unwrap());
    let content = subscription(&id("df@mts~2"), &all_lifting()).unwrap();
    let subscribe = message(Performative::Subscribe, "far", &content).language("fipa-sl2");
    it.tell(0.0, &far, &subscribe.build().unwrap()).unwrap();
    let mut next = successor(&stored(&it, 0.0), 0.0, |_| true);
    next.register(&local("crane")).unwrap();
    next.df.handle_timeout(next.clock.after(0.0).at);
    let answer = next.df.poll_answer().unwrap();
    assert_eq!(answer.message.sender().unwrap().name(), "df@mts~2");
}
