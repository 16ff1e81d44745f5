//! Descriptions from the directory facilitators of other hosts.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod common;

use std::sync::Arc;
use std::time::Duration;

use common::{Facilitator, OTHER, all_lifting, asker, id, lifting, local, message, names};
use fipa_acl::{AgentId, Performative, Time};
use fipa_platform::{
    AgentDescription, Asker, Constraints, Df, Exception, Function, LocalEntry, Platform, Property,
    RemoteEntry, ServiceDescription, found, limits, notified, subscription,
};

/// Two facilitators, and what the exchange carries between them.
struct Hosts {
    near: Facilitator,
    far: Facilitator,
}

impl Hosts {
    fn new() -> Self {
        Self {
            near: Facilitator::new(),
            far: Facilitator::new(),
        }
    }

    /// Carries the descriptions of the near host to the far one.
    fn carry(&mut self, seconds: f64) {
        let Some(local) = self.near.df.poll_local() else {
            return;
        };
        let now = self.far.clock.after(seconds);
        let entries = local.into_iter().map(|entry| RemoteEntry {
            name: entry.name,
            source: 1,
            text: entry.text.unwrap(),
            addresses: Vec::new(),
            ends: entry.lease.unwrap_or(now.at + limits::LEASE),
            has_lease: entry.lease.is_some(),
        });
        let entries: Vec<RemoteEntry> = entries.collect();
        assert!(!self.far.df.handle_remote(now, &entries));
    }
}

fn remote(source: u64, name: &str, text: &str, clock: common::Clock) -> RemoteEntry {
    RemoteEntry {
        name: name.into(),
        source,
        text: text.into(),
        addresses: Vec::new(),
        ends: clock.after(3600.0).at,
        has_lease: false,
    }
}

/// Returns the text of a description, as the directory facilitator of its host writes it.
fn text_of(description: &AgentDescription) -> Arc<str> {
    let mut it = Facilitator::new();
    let name = description.name.as_ref().unwrap().name().to_owned();
    it.call(0.0, &local(&name), &Function::register(description))
        .unwrap();
    let local = it.df.poll_local().unwrap();
    local[0].text.clone().unwrap()
}

fn of(source: u64, description: &AgentDescription, clock: common::Clock) -> RemoteEntry {
    let name = description.name.as_ref().unwrap().name();
    remote(source, name, &text_of(description), clock)
}

/// A description with each slot.
fn full(name: &str) -> AgentDescription {
    let set = |text: &str| vec![text.to_owned()];
    AgentDescription {
        protocols: set("fipa-request"),
        ontologies: set("né \"loads\" \\ (x)"),
        languages: set("fipa-sl"),
        scope: set("Global"),
        services: vec![ServiceDescription {
            ownership: Some("ACME".to_owned()),
            properties: vec![Property::new("load", "5 t\nand more")],
            ..ServiceDescription::new("lift-1", "lifting")
        }],
        ..lifting(name)
    }
}

#[test]
fn a_description_is_found_on_another_host_until_it_ends() {
    let mut hosts = Hosts::new();
    let register = Function::register(&full("crane"));
    hosts.near.call(0.0, &local("crane"), &register).unwrap();
    hosts.near.register(&local("arm")).unwrap();
    hosts.carry(0.0);
    let search = Function::search(&all_lifting(), &Constraints::all());
    let answer = hosts.far.call(0.0, &local("rover"), &search).unwrap();
    assert_eq!(found(&answer).unwrap(), [lifting("arm"), full("crane")]);
    // One description, as FIPA00023 has it, if the search does not ask for more.
    let one = Function::search(&all_lifting(), &Constraints::default());
    let answer = hosts.far.call(0.0, &local("rover"), &one).unwrap();
    assert_eq!(found(&answer).unwrap().len(), 1);
    // It belongs to the other directory facilitator.
    assert_eq!(hosts.far.df.descriptions().count(), 0);
    assert_eq!(hosts.far.df.poll_local(), None);
    let deregister = Function::deregister(&id("crane"));
    let refused = hosts.far.call(0.0, &local("crane"), &deregister);
    assert_eq!(refused.unwrap_err(), Exception::NotRegistered);
    hosts.near.call(0.0, &local("crane"), &deregister).unwrap();
    hosts.carry(1.0);
    assert_eq!(hosts.far.names(1.0, &all_lifting()), ["arm"]);
    // An agent that ends is reported to the other host.
    let now = hosts.near.clock.after(1.0).at;
    hosts.near.df.handle_departures(now, |_, _| false);
    hosts.carry(2.0);
    assert!(hosts.far.names(2.0, &all_lifting()).is_empty());
    assert_eq!(hosts.far.df.poll_timeout(), None);
}

#[test]
fn descriptions_of_agents_of_this_host_travel_in_the_order_of_their_registration() {
    let mut it = Facilitator::new();
    assert_eq!(it.df.poll_local(), None);
    for name in ["rover", "crane"] {
        it.register(&local(name)).unwrap();
    }
    // Not those of agents of other hosts, nor those whose scope is this host.
    it.register(&asker("jade", OTHER)).unwrap();
    let here = AgentDescription {
        scope: vec!["local".to_owned()],
        ..lifting("hermit")
    };
    it.call(0.0, &local("hermit"), &Function::register(&here))
        .unwrap();
    it.register(&local("arm")).unwrap();
    it.call(0.0, &local("rover"), &Function::modify(&full("rover")))
        .unwrap();
    let names = |local: &[LocalEntry]| -> Vec<String> {
        local.iter().map(|entry| entry.name.to_string()).collect()
    };
    let all = it.df.poll_local().unwrap();
    assert_eq!(names(&all), ["rover", "crane", "arm"]);
    assert_eq!(all[0].registration, "rover".len() as u64);
    assert_eq!(it.df.poll_local(), None);
    // Those that are too large cannot travel.
    let large = [
        AgentDescription {
            languages: vec!["x".to_owned(); limits::REMOTE_PARTS + 1],
            ..lifting("arm")
        },
        AgentDescription {
            languages: vec!["x".repeat(limits::REMOTE_BYTES)],
            ..lifting("arm")
        },
    ];
    for description in large {
        it.call(0.0, &local("arm"), &Function::modify(&description))
            .unwrap();
        let all = it.df.poll_local().unwrap();
        assert_eq!(all[2].text, None);
        assert!(all[1].text.is_some());
    }
}

#[test]
fn an_asker_of_another_platform_gets_the_addresses_of_its_transport() {
    let mut far = Facilitator::new();
    let here = "http://10.0.0.1:7778/acc".to_owned();
    let at_home = here.clone();
    far.df = Df::new(id("df@mts")).with_addresses(Arc::new(move |_| vec![at_home.clone()]));
    far.register(&local("arm")).unwrap();
    let crane = |addresses: &[&str]| RemoteEntry {
        addresses: addresses.iter().map(|&it| it.to_owned()).collect(),
        ..of(1, &lifting("crane"), far.clock)
    };
    let addresses = |it: &mut Facilitator, asker: &Asker| -> Vec<Vec<String>> {
        let search = Function::search(&all_lifting(), &Constraints::all());
        let answer = it.call(0.0, asker, &search).unwrap();
        let found = found(&answer).unwrap();
        let names = found.iter().filter_map(|it| it.name.as_ref());
        let of = |id: &AgentId| id.addresses().iter().map(ToString::to_string).collect();
        names.map(of).collect()
    };
    let first = ["https://10.0.0.2/acc", "http://10.0.0.2:7778/acc", "http:"];
    let (first, moved) = (crane(&first), crane(&["http://10.0.0.3:7778/acc"]));
    let now = far.clock.after(0.0);
    far.df.handle_remote(now, &[first]);
    let jade = asker("jade", Platform::Unproved);
    let there = "http://10.0.0.2:7778/acc".to_owned();
    assert_eq!(
        addresses(&mut far, &jade),
        [vec![here.clone()], vec![there]]
    );
    // The description is the same.
    far.df.handle_remote(now, &[moved]);
    let there = "http://10.0.0.3:7778/acc".to_owned();
    assert_eq!(addresses(&mut far, &jade), [vec![here], vec![there]]);
    // Agents of this host need none.
    assert_eq!(
        addresses(&mut far, &local("rover")),
        [vec![], Vec::<String>::new()]
    );
}

#[test]
fn leases_are_told_by_the_clock_of_the_reader() {
    let mut hosts = Hosts::new();
    let clock = hosts.near.clock;
    let leased = AgentDescription {
        lease_time: Some(Time::from_system_time(clock.after(60.0).wall).unwrap()),
        ..lifting("crane")
    };
    hosts
        .near
        .call(0.0, &local("crane"), &Function::register(&leased))
        .unwrap();
    let local_entries = hosts.near.df.poll_local().unwrap();
    let text = local_entries[0].text.clone().unwrap();
    assert!(!text.contains("lease"), "{text}");
    assert_eq!(local_entries[0].lease, Some(clock.after(60.0).at));
    // The lease has 50 s left when it arrives.
    let far = hosts.far.clock;
    let entry = RemoteEntry {
        ends: far.after(50.0).at,
        has_lease: true,
        ..remote(1, "crane", &text, far)
    };
    let mut it = hosts.far;
    it.df
        .handle_remote(far.after(0.0), std::slice::from_ref(&entry));
    let search = Function::search(&all_lifting(), &Constraints::all());
    let lease = |it: &mut Facilitator, seconds| {
        let answer = it.call(seconds, &local("rover"), &search).unwrap();
        let found = found(&answer).unwrap();
        found.first().and_then(|it| it.lease_time)
    };
    let at = |seconds| Time::from_system_time(far.after(seconds).wall).ok();
    assert_eq!(lease(&mut it, 0.0), at(50.0));
    assert_eq!(it.df.poll_timeout(), Some(far.after(50.0).at));
    // Renewed, and ended.
    let renewed = RemoteEntry {
        ends: far.after(90.0).at,
        ..entry.clone()
    };
    it.df
        .handle_remote(far.after(10.0), std::slice::from_ref(&renewed));
    assert_eq!(lease(&mut it, 60.0), at(90.0));
    it.df.handle_timeout(far.after(90.0).at);
    assert_eq!(it.df.remote_descriptions().count(), 0);
    assert_eq!(it.df.poll_timeout(), None);
    // The exchange may still have it.
    it.df.handle_remote(far.after(91.0), &[renewed]);
    assert_eq!(it.df.remote_descriptions().count(), 0);
}

#[test]
fn texts_that_are_not_the_description_of_their_agent_are_ignored() {
    let mut it = Facilitator::new();
    let clock = it.clock;
    let good = text_of(&lifting("good"));
    let bad = text_of(&lifting("bad"));
    let part = |part: &str, count: usize| part.repeat(count);
    let nested = |open: &str, depth: usize| {
        format!(
            "(df-agent-description :name (agent-identifier :name bad) :services (set \
             (service-description :name s :type t :properties (set (property :name p :value {}x{})))))",
            part(open, depth),
            part(")", depth)
        )
    };
    let texts = [
        String::new(),
        "x".to_owned(),
        "(".to_owned(),
        good.to_string(),
        format!("{bad} {bad}"),
        format!("{bad})) (= x (sequence {bad}"),
        format!("{bad}))) ((= x (sequence {bad}"),
        bad.replace("df-agent-description", "ams-agent-description"),
        bad.replace(":name bad", ":name bad :nonsense 1"),
        bad.replace(":type lifting", ""),
        bad.replace(":name (agent-identifier :name bad)", ""),
        bad.replace(":services", ":languages (set \"\0\") :services"),
        nested("(f ", 60),
        nested("(sequence ", 124),
        nested("(f ", 4000),
        format!(
            "(df-agent-description :name (agent-identifier :name bad) :languages (set {}))",
            part("x ", limits::REMOTE_PARTS)
        ),
        format!(
            "(df-agent-description :name (agent-identifier :name bad) :languages (set {}))",
            part("x", limits::REMOTE_BYTES)
        ),
    ];
    for text in texts {
        let entries = [
            remote(1, "bad", &text, clock),
            remote(2, "good", &good, clock),
        ];
        it.df.handle_remote(clock.after(0.0), &entries);
        let all = it.names(0.0, &AgentDescription::default());
        assert_eq!(all, ["good"], "{text}");
    }
    // A deep value that fits is read, and can be read again in an answer.
    let deep = remote(1, "bad", &nested("(sequence ", 50), clock);
    it.df.handle_remote(clock.after(0.0), &[deep]);
    assert_eq!(it.names(0.0, &all_lifting()), Vec::<String>::new());
    assert_eq!(it.names(0.0, &AgentDescription::default()), ["bad"]);
}

fn subscribe(it: &mut Facilitator) {
    let content = subscription(&id("df@mts"), &all_lifting()).unwrap();
    let subscribe = message(Performative::Subscribe, "rover", &content)
        .language("fipa-sl2")
        .conversation_id("s-1");
    let agreed = it
        .tell(0.0, &local("rover"), &subscribe.build().unwrap())
        .unwrap()
        .message;
    assert_eq!(*agreed.performative(), Performative::Agree, "{agreed}");
}

/// Returns the next notification, and confirms its delivery.
fn next(it: &mut Facilitator, seconds: f64) -> Vec<AgentDescription> {
    let now = it.clock.after(seconds).at;
    it.df.handle_timeout(now);
    let Some(answer) = it.df.poll_answer() else {
        return Vec::new();
    };
    let id = answer.notification.expect("a notification");
    it.df.handle_sent(now, id, true);
    notified(&answer.message).unwrap()
}

fn gone(name: &str) -> AgentDescription {
    AgentDescription {
        name: Some(id(name)),
        ..AgentDescription::default()
    }
}

#[test]
fn subscribers_learn_of_descriptions_that_come_and_go() {
    let mut it = Facilitator::new();
    let clock = it.clock;
    let crane = of(1, &lifting("crane"), clock);
    it.df
        .handle_remote(clock.after(0.0), std::slice::from_ref(&crane));
    subscribe(&mut it);
    assert_eq!(next(&mut it, 0.0), [lifting("crane")]);
    // A longer lease is no change of the services.
    let renewed = RemoteEntry {
        ends: clock.after(7200.0).at,
        ..crane.clone()
    };
    it.df.handle_remote(
        clock.after(1.0),
        &[renewed.clone(), of(1, &full("arm"), clock)],
    );
    assert_eq!(next(&mut it, 1.0), [full("arm")]);
    let towing = AgentDescription {
        services: vec![ServiceDescription::new("tow-1", "towing")],
        ..lifting("arm")
    };
    it.df
        .handle_remote(clock.after(2.0), &[renewed.clone(), of(1, &towing, clock)]);
    assert_eq!(next(&mut it, 2.0), [towing]);
    it.df.handle_remote(clock.after(3.0), &[renewed]);
    assert_eq!(next(&mut it, 3.0), []);
    // The agent is now at another host.
    let moved = RemoteEntry { source: 2, ..crane };
    it.df.handle_remote(clock.after(4.0), &[moved]);
    assert_eq!(next(&mut it, 4.0), [lifting("crane")]);
    assert_eq!(next(&mut it, 3601.0), [gone("crane")]);
    assert_eq!(next(&mut it, 3602.0), []);
}

#[test]
fn an_entry_of_this_facilitator_hides_that_of_another() {
    let mut it = Facilitator::new();
    let clock = it.clock;
    let elsewhere = full("crane");
    it.df
        .handle_remote(clock.after(0.0), &[of(1, &elsewhere, clock)]);
    subscribe(&mut it);
    assert_eq!(next(&mut it, 0.0), std::slice::from_ref(&elsewhere));
    // The agent of the other host also registers here.
    let crane = asker("crane", OTHER);
    it.call(1.0, &crane, &Function::register(&lifting("crane")))
        .unwrap();
    let here = next(&mut it, 1.0);
    assert_eq!(here.len(), 1);
    assert_eq!(here[0].services, lifting("crane").services);
    let search = Function::search(&all_lifting(), &Constraints::all());
    let answer = it.call(1.0, &local("rover"), &search).unwrap();
    assert_eq!(found(&answer).unwrap(), here);
    // A change there is not visible.
    it.df
        .handle_remote(clock.after(2.0), &[of(1, &lifting("crane"), clock)]);
    assert_eq!(next(&mut it, 2.0), []);
    it.df
        .handle_remote(clock.after(3.0), &[of(1, &elsewhere, clock)]);
    it.call(3.0, &crane, &Function::deregister(&id("crane")))
        .unwrap();
    assert_eq!(next(&mut it, 3.0), [elsewhere]);
}

#[test]
fn a_host_that_changes_its_descriptions_all_the_time_ends_no_subscription() {
    let mut it = Facilitator::new();
    let clock = it.clock;
    subscribe(&mut it);
    let honest = of(2, &lifting("crane"), clock);
    let pause = limits::REMOTE_PAUSE.as_secs_f64();
    let mut seen = Vec::new();
    for round in 0..150 {
        let seconds = f64::from(round) * pause;
        let new = |number| {
            let mut large = lifting(&format!("a-{round}-{number}"));
            large.languages = vec!["x".repeat(3000)];
            of(1, &large, clock)
        };
        let mut entries: Vec<RemoteEntry> = (0..40).map(new).collect();
        entries.extend((round > 3).then(|| honest.clone()));
        let has_more = it.df.handle_remote(clock.after(seconds), &entries);
        assert!(has_more);
        let liars = it.df.remote_descriptions().count();
        assert!(liars <= limits::REMOTE_CHANGES + 1, "{liars}");
        seen.extend(names(&next(&mut it, seconds)));
        assert_eq!(it.df.subscriptions(), 1, "{round}");
    }
    assert!(seen.contains(&"crane".to_owned()));
}

#[test]
fn hosts_take_turns_in_an_answer_that_is_cut() {
    let mut it = Facilitator::new();
    let clock = it.clock;
    let mut entries: Vec<RemoteEntry> = (0..200)
        .map(|number| {
            let mut large = lifting(&format!("a-{number}"));
            large.languages = vec!["x".repeat(3500)];
            of(1, &large, clock)
        })
        .collect();
    entries.push(of(2, &lifting("crane"), clock));
    let mut seconds = 0.0;
    while it.df.handle_remote(clock.after(seconds), &entries) {
        seconds += limits::REMOTE_PAUSE.as_secs_f64();
    }
    assert_eq!(it.df.remote_descriptions().count(), 201);
    let found = it.names(0.0, &all_lifting());
    assert!(found.len() < 100, "{}", found.len());
    assert!(found.contains(&"crane".to_owned()));
}

#[test]
fn the_number_of_remote_descriptions_is_bounded() {
    let mut it = Facilitator::new();
    let clock = it.clock;
    let text = text_of(&lifting("x"));
    let entries: Vec<RemoteEntry> = (0..limits::REMOTE_DESCRIPTIONS + 500)
        .map(|number| {
            let name = format!("x{number}");
            let source = number as u64 / 32;
            remote(
                source,
                &name,
                &text.replace(":name x)", &format!(":name {name})")),
                clock,
            )
        })
        .collect();
    it.df.handle_remote(clock.after(0.0), &entries);
    let count = it.df.remote_descriptions().count();
    assert_eq!(count, limits::REMOTE_DESCRIPTIONS);
    // Agents of this host have their own room.
    it.register(&local("crane")).unwrap();
    let found = it.names(0.0, &all_lifting());
    assert_eq!(found.len(), limits::RESULTS);
    assert!(found.contains(&"crane".to_owned()));
    it.df.handle_remote(clock.after(0.0), &[]);
    assert_eq!(it.names(0.0, &all_lifting()), ["crane"]);
}

/// Prints its time, with `--nocapture`.
#[test]
fn a_search_with_the_most_comparisons_is_answered() {
    let mut it = Facilitator::new();
    let clock = it.clock;
    let texts = |count: usize, last: &str| -> Vec<String> {
        let texts = (1..count).map(|number| format!("l-{number:02}"));
        texts.chain([last.to_owned()]).collect()
    };
    let entries: Vec<RemoteEntry> = (0..limits::REMOTE_DESCRIPTIONS)
        .map(|number| {
            let name = format!("x{number}");
            let languages = texts(limits::REMOTE_PARTS - 1, "last").join(" ");
            let text = format!(
                "(df-agent-description :name (agent-identifier :name {name}) :languages (set {languages}))"
            );
            remote(number as u64 / 32, &name, &text, clock)
        })
        .collect();
    let began = std::time::Instant::now();
    it.df.handle_remote(clock.after(0.0), &entries);
    println!("{} read in {:?}", entries.len(), began.elapsed());
    let template = AgentDescription {
        languages: texts(limits::REMOTE_PARTS - 1, "none").split_off(limits::REMOTE_PARTS - 2 - 30),
        ..AgentDescription::default()
    };
    let search = Function::search(&template, &Constraints::all());
    let mut times: Vec<Duration> = (0..3)
        .map(|_| {
            let began = std::time::Instant::now();
            let answer = it.call(0.0, &local("rover"), &search).unwrap();
            assert!(found(&answer).unwrap().is_empty());
            began.elapsed()
        })
        .collect();
    times.sort();
    println!(
        "search: {:?} to {:?}, median {:?}",
        times[0], times[2], times[1]
    );
}
