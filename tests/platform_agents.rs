//! The agent management system and the directory facilitator of gateways, used over letters.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[path = "support/stranger.rs"]
mod stranger;
mod support;

use std::time::{Duration, SystemTime};

use fipa::platform::{
    AgentDescription, AmsDescription, Df, Exception, PlatformError, Property, ServiceDescription,
    limits,
};
use fipa::topics::Topic;
use fipa::{AgentId, Config, Domain, Gateway, Kind, Message, Performative, Reach, Time};
use fipa_sds::{Directory as _, EXCHANGE_ONTOLOGY, MdnsConfig, MdnsDirectory, MtsId, Registration};
use fipa_testbed::until_async;
use fipa_transport::Incarnation;
use stranger::Stranger;

/// Time limit of all waits, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

fn config(set: &[&str]) -> Config {
    support::config(&[&["mts.deadline=30s"], set].concat())
}

async fn host(config: &Config) -> (Gateway, Domain) {
    let gateway = Gateway::open(config).await.unwrap();
    (gateway, Domain::open(config).await.unwrap())
}

/// Starts two hosts that know each other from their configuration.
async fn two_hosts(set: &[&str]) -> [(Gateway, Domain); 2] {
    let near = host(&config(set)).await;
    let locations = near.0.locations();
    let at = locations.iter().find(|it| it.kind() == Kind::Tcp).unwrap();
    let peer = format!(
        "discovery.static={{ \"near\" = [\"tcp://{}\"] }}",
        at.address()
    );
    let far = host(&config(&[set, &[&*peer]].concat())).await;
    [near, far]
}

async fn knows(domain: &Domain, name: &str) {
    until_async(name, || domain.directory().lookup(name).is_some()).await;
}

fn lifting() -> AgentDescription {
    ServiceDescription::of_type("lifting").into()
}

/// Returns a description with one service of this name.
fn lifting_as(name: &str) -> AgentDescription {
    ServiceDescription::new(name, "lifting").into()
}

fn names<'a>(ids: impl IntoIterator<Item = &'a Option<AgentId>>) -> Vec<String> {
    let ids = ids.into_iter().flatten();
    ids.map(|id| id.name().to_owned()).collect()
}

/// Waits for the next notification.
async fn next(notifications: &mut fipa::platform::Notifications) -> Vec<AgentDescription> {
    let next = tokio::time::timeout(TIMEOUT, notifications.next()).await;
    next.unwrap().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn services_are_registered_found_and_watched() {
    let config = config(&[]);
    let (gateway, domain) = host(&config).await;
    let rover = domain.register("rover").await.unwrap();
    let crane = domain.register("crane").await.unwrap();
    let df = rover.df().unwrap();
    assert_eq!(df.id().name(), format!("df@{}", gateway.name()));
    let mut notifications = df.subscribe(&lifting()).await.unwrap();
    let facilitator = crane.df().unwrap();
    for (name, service_type) in [("lift-1", "lifting"), ("tow-1", "towing")] {
        let service = ServiceDescription::new(name, service_type);
        facilitator.register_service(service).await.unwrap();
    }
    let found = df.search(&lifting()).await.unwrap();
    assert_eq!(found.len(), 1);
    assert_eq!(found[0].name.as_ref().unwrap().name(), "crane");
    assert_eq!(found[0].services.len(), 2);
    // Both registrations, in one notification or two.
    let mut services = 0;
    while services < 2 {
        let changed = next(&mut notifications).await;
        assert_eq!(changed.len(), 1);
        services = changed[0].services.len();
    }
    let again = facilitator.register(lifting()).await;
    let missing = matches!(
        &again,
        Err(PlatformError::Rejected(Exception::MissingParameter { parameter, .. }))
            if parameter == "name"
    );
    assert!(missing, "{again:?}");
    let again = facilitator.register(AgentDescription::default()).await;
    assert!(matches!(
        again,
        Err(PlatformError::Rejected(Exception::AlreadyRegistered))
    ));
    // The description ends with its agent.
    drop(crane);
    let gone = next(&mut notifications).await;
    assert_eq!(names(gone.iter().map(|it| &it.name)), ["crane"]);
    assert!(gone[0].services.is_empty());
    assert!(df.search(&lifting()).await.unwrap().is_empty());
    notifications.cancel(TIMEOUT).await.unwrap();
    domain.close().await;
    gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_agents_and_the_platform_are_listed() {
    let config = config(&[]);
    let (gateway, domain) = host(&config).await;
    let rover = domain.register("rover").await.unwrap();
    let ams = rover.ams().unwrap();
    let all = ams.search(&AmsDescription::default()).await.unwrap();
    let own = gateway.name();
    let expected = [
        format!("ams@{own}"),
        format!("df@{own}"),
        "rover".to_owned(),
    ];
    assert_eq!(names(all.iter().map(|it| &it.name)), expected);
    let description = ams.description().await.unwrap();
    assert_eq!(description.name, own);
    let locations = gateway.locations();
    let tcp = locations.iter().find(|it| it.kind() == Kind::Tcp).unwrap();
    let addresses = vec![format!("tcp://{}", tcp.address())];
    assert_eq!(description.services, [("tcp".to_owned(), addresses)]);
    let named = AmsDescription {
        name: Some(rover.id().clone()),
        ownership: Some("ACME".to_owned()),
        ..AmsDescription::default()
    };
    ams.modify(&named).await.unwrap();
    let found = ams.search(&named).await.unwrap();
    assert_eq!(names(found.iter().map(|it| &it.name)), ["rover"]);
    assert!(ams.register(&named).await.is_err());
    // Patterns address agents of robots.
    let to_all = rover
        .message(Performative::Inform)
        .receiver(AgentId::new(".*").unwrap())
        .build()
        .unwrap();
    let sent = rover.send(to_all).await.unwrap();
    assert!(!sent.all_succeeded(), "{sent}");
    domain.close().await;
    gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_of_another_host_registers_itself_for_a_time() {
    let [(near, at_home), (far, abroad)] = two_hosts(&[]).await;
    let rover = at_home.register("rover").await.unwrap();
    let crane = abroad.register("crane").await.unwrap();
    let [df, ams] = ["df", "ams"].map(|it| AgentId::new(format!("{it}@{}", near.name())).unwrap());
    knows(&abroad, df.name()).await;
    knows(&abroad, ams.name()).await;
    knows(&at_home, "crane").await;
    let before = SystemTime::now();
    let facilitator = crane.df_of(df);
    let service = ServiceDescription::new("lift-1", "lifting");
    let registered = facilitator.register_service(service).await.unwrap();
    let ends = registered.lease_time.unwrap().to_system_time(before);
    let lease = ends.duration_since(before).unwrap();
    assert!(lease <= limits::LEASE + TIMEOUT, "{lease:?}");
    let found = rover.df().unwrap().search(&lifting()).await.unwrap();
    assert_eq!(found, [registered]);
    // The agent management system lists it for agents of its platform only.
    let own = AmsDescription {
        name: Some(crane.id().clone()),
        ..AmsDescription::default()
    };
    let management = crane.ams_of(ams);
    management.register(&own).await.unwrap();
    assert_eq!(management.search(&own).await.unwrap().len(), 1);
    let here = rover.ams().unwrap().search(&own).await.unwrap();
    assert!(here.is_empty(), "{here:?}");
    management.deregister().await.unwrap();
    // It cannot change the description of an agent of this host.
    let rovers = AgentDescription {
        name: Some(rover.id().clone()),
        ..lifting()
    };
    let refused = facilitator.register(rovers).await;
    assert!(matches!(
        refused,
        Err(PlatformError::Rejected(Exception::Unauthorised))
    ));
    for domain in [at_home, abroad] {
        domain.close().await;
    }
    far.close().await;
    near.close().await;
}

/// Waits until a search for lifting finds these agents.
async fn finds(df: &Df<'_>, expected: &[&str]) {
    let mut found = Vec::new();
    let wait = async {
        loop {
            found = names(
                df.search(&lifting())
                    .await
                    .unwrap()
                    .iter()
                    .map(|it| &it.name),
            );
            if found == expected {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let ended = tokio::time::timeout(TIMEOUT, wait).await;
    assert!(ended.is_ok(), "{found:?} instead of {expected:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn services_of_agents_of_another_host_are_found_here_until_they_end() {
    let [(near, at_home), (far, abroad)] = two_hosts(&[]).await;
    let rover = at_home.register("rover").await.unwrap();
    let crane = abroad.register("crane").await.unwrap();
    let df = rover.df().unwrap();
    let mut notifications = df.subscribe(&lifting()).await.unwrap();
    let facilitator = crane.df().unwrap();
    assert_ne!(df.id(), facilitator.id());
    let service = ServiceDescription::new("lift-1", "lifting");
    let registered = facilitator.register_service(service).await.unwrap();
    assert_eq!(
        next(&mut notifications).await,
        std::slice::from_ref(&registered)
    );
    assert_eq!(df.search(&lifting()).await.unwrap(), [registered]);
    let towing = ServiceDescription::new("tow-1", "towing");
    let changed = facilitator.register_service(towing).await.unwrap();
    assert_eq!(next(&mut notifications).await, [changed]);
    // A lease ends there, too.
    let ends = SystemTime::now() + Duration::from_secs(2);
    let leased = AgentDescription {
        lease_time: Some(Time::from_system_time(ends).unwrap()),
        ..lifting_as("lift-2")
    };
    facilitator.modify(leased).await.unwrap();
    let mut changed = next(&mut notifications).await;
    if !changed[0].services.is_empty() {
        assert!(changed[0].lease_time.is_some());
        changed = next(&mut notifications).await;
    }
    assert_eq!(names(changed.iter().map(|it| &it.name)), ["crane"]);
    assert!(changed[0].services.is_empty());
    assert!(df.search(&lifting()).await.unwrap().is_empty());
    // The agent ends.
    facilitator
        .register_service(ServiceDescription::new("lift-3", "lifting"))
        .await
        .unwrap();
    assert_eq!(next(&mut notifications).await.len(), 1);
    drop(crane);
    let ended = next(&mut notifications).await;
    assert!(ended[0].services.is_empty());
    finds(&df, &[]).await;
    // The gateway ends.
    let arm = abroad.register("arm").await.unwrap();
    arm.df()
        .unwrap()
        .register_service(ServiceDescription::new("lift-4", "lifting"))
        .await
        .unwrap();
    assert_eq!(next(&mut notifications).await.len(), 1);
    far.close().await;
    let ended = next(&mut notifications).await;
    assert_eq!(names(ended.iter().map(|it| &it.name)), ["arm"]);
    assert!(ended[0].services.is_empty());
    finds(&df, &[]).await;
    for domain in [at_home, abroad] {
        domain.close().await;
    }
    near.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_description_travels_from_the_gateway_of_its_agent_only() {
    let [(near, at_home), (far, abroad)] = two_hosts(&[]).await;
    let rover = at_home.register("rover").await.unwrap();
    let crane = abroad.register("crane").await.unwrap();
    knows(&at_home, "crane").await;
    let own = crane.df().unwrap();
    own.register_service(ServiceDescription::new("lift-1", "lifting"))
        .await
        .unwrap();
    let df = rover.df().unwrap();
    finds(&df, &["crane"]).await;
    // The agent registers with the other host, too: that description hides the one that has traveled.
    let there = crane.df_of(df.id().clone());
    knows(&abroad, df.id().name()).await;
    let here = there
        .register_service(ServiceDescription::new("lift-2", "lifting"))
        .await
        .unwrap();
    assert_eq!(here.services.len(), 1);
    assert!(here.lease_time.is_some());
    assert_eq!(df.search(&lifting()).await.unwrap(), [here]);
    // It does not travel back, and the one of its own host stays as it is.
    let at_own = own.search(&lifting()).await.unwrap();
    assert_eq!(at_own.len(), 1);
    assert_eq!(at_own[0].services[0].name.as_deref(), Some("lift-1"));
    there.deregister().await.unwrap();
    assert_eq!(df.search(&lifting()).await.unwrap(), at_own);
    // A description for this host only, and one that is too large, stay.
    for stays in [
        AgentDescription {
            scope: vec!["local".to_owned()],
            ..lifting_as("lift-3")
        },
        AgentDescription {
            languages: vec!["x".to_owned(); limits::REMOTE_PARTS],
            ..lifting_as("lift-4")
        },
    ] {
        own.modify(stays).await.unwrap();
        finds(&df, &[]).await;
        assert_eq!(own.search(&lifting()).await.unwrap().len(), 1);
        let back = own.modify(lifting_as("lift-5")).await.unwrap();
        finds(&df, &["crane"]).await;
        assert_eq!(df.search(&lifting()).await.unwrap(), [back]);
    }
    for domain in [at_home, abroad] {
        domain.close().await;
    }
    far.close().await;
    near.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_agents_with_one_name_that_which_holds_it_is_found() {
    let (one, at_one) = host(&config(&[])).await;
    let (two, at_two) = host(&config(&[])).await;
    // These two hosts do not know each other; a third one knows both.
    let first = at_one.register("crane").await.unwrap();
    let second = at_two.register("crane").await.unwrap();
    for (agent, name) in [(&first, "lift-1"), (&second, "lift-2")] {
        let df = agent.df().unwrap();
        df.register_service(ServiceDescription::new(name, "lifting"))
            .await
            .unwrap();
    }
    let peers = [("one", &one), ("two", &two)].map(|(name, gateway)| {
        let locations = gateway.locations();
        let at = locations.iter().find(|it| it.kind() == Kind::Tcp).unwrap();
        format!("{name} = [\"tcp://{}\"]", at.address())
    });
    let peers = format!("discovery.static={{ {} }}", peers.join(", "));
    let (third, at_third) = host(&config(&[&*peers])).await;
    let rover = at_third.register("rover").await.unwrap();
    let df = rover.df().unwrap();
    let service = |found: &[AgentDescription]| found[0].services[0].name.clone().unwrap();
    until_async("both gateways", || third.neighbors().len() == 2).await;
    finds(&df, &["crane"]).await;
    let holder = third.directory().known("crane").unwrap().incarnation;
    let (leaving, staying, expected) = match holder == first.incarnation() {
        true => (first, second, ["lift-1", "lift-2"]),
        false => (second, first, ["lift-2", "lift-1"]),
    };
    let mut notifications = df.subscribe(&lifting()).await.unwrap();
    let mut shown = service(&next(&mut notifications).await);
    while shown != expected[0] {
        shown = service(&next(&mut notifications).await);
    }
    // The other agent gets the name.
    drop(leaving);
    let mut changed = next(&mut notifications).await;
    if changed[0].services.is_empty() {
        changed = next(&mut notifications).await;
    }
    assert_eq!(service(&changed), expected[1]);
    drop(staying);
    for domain in [at_one, at_two, at_third] {
        domain.close().await;
    }
    for gateway in [one, two, third] {
        gateway.close().await;
    }
}

/// The prefixes of the names of a gateway's agents.
const PREFIXES: [&str; 2] = ["ams", "df"];

/// Returns the second names of the agents with this prefix that a domain knows, those of other hosts
/// or its own.
fn second_names(domain: &Domain, prefix: &str, gateway: &str, is_remote: bool) -> Vec<String> {
    let entries = domain.directory().entries();
    let wanted = entries.iter().filter(|entry| {
        let digits = entry.name.strip_prefix(&format!("{prefix}-"));
        let digits = digits.and_then(|rest| rest.strip_suffix(&format!("@{gateway}")));
        digits.is_some_and(|it| it.len() == 8) && (entry.reach != Reach::Local) == is_remote
    });
    wanted.map(|it| it.name.to_string()).collect()
}

/// Checks that the agents of the gateway have their names, and that letters of its host reach them.
async fn keeps_its_names(gateway: &Gateway, domain: &Domain, agent: &str) {
    for prefix in PREFIXES {
        let name = format!("{prefix}@{}", gateway.name());
        for known in [
            domain.directory().lookup(&name),
            gateway.directory().lookup(&name),
        ] {
            let known = known.unwrap();
            assert_eq!(known.reach, Reach::Local, "{name}");
            assert_eq!(known.mts.incarnation, gateway.incarnation(), "{name}");
        }
    }
    let agent = domain.register(agent).await.unwrap();
    assert_eq!(
        agent.df().unwrap().id().name(),
        format!("df@{}", gateway.name())
    );
    // By the name, as a letter that is written by hand.
    let df = agent.df_of(AgentId::new(format!("df@{}", gateway.name())).unwrap());
    let own = df.register_service(ServiceDescription::new("a", "painting"));
    assert_eq!(own.await.unwrap().lease_time, None, "it is of this host");
    let ams = agent.ams_of(AgentId::new(format!("ams@{}", gateway.name())).unwrap());
    assert_eq!(ams.description().await.unwrap().name, gateway.name());
}

#[tokio::test(flavor = "multi_thread")]
async fn gateways_with_one_name_keep_it_and_reach_each_other_by_second_names() {
    let same = format!("mts.name=robot-{}", support::mark());
    let [(near, at_home), (far, abroad)] = two_hosts(&[&same]).await;
    assert_eq!(near.name(), far.name());
    for prefix in PREFIXES {
        for domain in [&at_home, &abroad] {
            until_async("the second name of the other host", || {
                second_names(domain, prefix, near.name(), true).len() == 1
                    && second_names(domain, prefix, near.name(), false).len() == 1
            })
            .await;
        }
        let [here, there] =
            [&at_home, &abroad].map(|domain| second_names(domain, prefix, near.name(), false));
        assert_ne!(here, there);
        assert_eq!(second_names(&abroad, prefix, near.name(), true), here);
        assert_eq!(second_names(&at_home, prefix, near.name(), true), there);
    }
    keeps_its_names(&near, &at_home, "painter").await;
    keeps_its_names(&far, &abroad, "sprayer").await;
    // Each agent uses the directory facilitator of its own host.
    let rover = abroad.register("rover").await.unwrap();
    let df = rover.df().unwrap();
    let own = df
        .register_service(ServiceDescription::new("a", "lifting"))
        .await;
    assert_eq!(own.unwrap().lease_time, None);
    assert_eq!(df.search(&lifting()).await.unwrap().len(), 1);
    let other = at_home.register("other").await.unwrap();
    let facilitator = other.df().unwrap();
    assert_eq!(facilitator.id(), df.id(), "the names are equal");
    // Only the description of its own host is one that an agent can change.
    let refused = facilitator.modify(lifting()).await;
    assert!(refused.is_err(), "{refused:?}");
    finds(&facilitator, &["rover"]).await;
    // The other host's by the second name: requests, and notifications of a subscription.
    let second = second_names(&at_home, "df", near.name(), true).remove(0);
    let there = other.df_of(AgentId::new(second).unwrap());
    assert_eq!(there.search(&lifting()).await.unwrap().len(), 1);
    let mut notifications = there.subscribe(&lifting()).await.unwrap();
    assert_eq!(next(&mut notifications).await.len(), 1);
    let registered = there.register(lifting_as("b")).await.unwrap();
    assert!(registered.lease_time.is_some());
    let noticed = next(&mut notifications).await;
    assert_eq!(names(noticed.iter().map(|it| &it.name)), ["other"]);
    notifications.cancel(TIMEOUT).await.unwrap();
    let second = second_names(&at_home, "ams", near.name(), true).remove(0);
    let there = other.ams_of(AgentId::new(second).unwrap());
    let description = there.description().await.unwrap();
    let addresses = description.services.iter().flat_map(|(_, all)| all);
    let locations = far.locations();
    let tcp = locations.iter().find(|it| it.kind() == Kind::Tcp).unwrap();
    assert!(
        addresses
            .clone()
            .any(|it| *it == format!("tcp://{}", tcp.address()))
    );
    for domain in [at_home, abroad] {
        domain.close().await;
    }
    far.close().await;
    near.close().await;
}

/// Makes the stranger announce these agents, and waits until the gateway knows the agent `seen`.
async fn announce(stranger: &mut Stranger, gateway: &Gateway, names: &[String], seen: &str) {
    let agents = names.iter().map(|name| {
        let id = Incarnation::random();
        format!(r#"{{"name":"{name}","id":"{id}","registered":1}}"#)
    });
    let agents: Vec<String> = agents.collect();
    let content = format!(
        r#"{{"version":1,"tell":{{"full":{{"version":1,"first":true,"last":true,"agents":[{}]}}}}}}"#,
        agents.join(",")
    );
    // The gateway ignores letters of a gateway that it does not know yet.
    let known = async {
        while gateway.directory().known(seen).is_none() {
            let message = Message::builder(Performative::Inform).ontology(EXCHANGE_ONTOLOGY);
            stranger.send(message.content(content.clone()));
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(TIMEOUT, known).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stranger_over_tcp_takes_no_name_of_a_gateways_agents() {
    let (gateway, domain) = host(&config(&[])).await;
    let own = gateway.name().to_owned();
    // One that does not even claim to be that gateway.
    let mut liar = Stranger::new("liar", &gateway);
    let names = [
        "decoy".to_owned(),
        "df@liar".to_owned(),
        format!("df@{own}"),
        format!("ams@{own}"),
        "df@nowhere".to_owned(),
        "ams-00000000@nowhere".to_owned(),
    ];
    announce(&mut liar, &gateway, &names, "decoy").await;
    let known = |name: &str| gateway.directory().known(name).is_some();
    assert!(known("df@liar"), "its own");
    assert!(!known("df@nowhere") && !known("ams-00000000@nowhere"));
    keeps_its_names(&gateway, &domain, "painter").await;
    // One that claims to have the same name.
    let mut namesake = Stranger::new(&own, &gateway);
    let names = [
        "bait".to_owned(),
        format!("df@{own}"),
        format!("ams@{own}"),
        own.clone(),
    ];
    announce(&mut namesake, &gateway, &names, "bait").await;
    for prefix in PREFIXES {
        until_async("a second name", || {
            second_names(&domain, prefix, &own, false).len() == 1
        })
        .await;
    }
    keeps_its_names(&gateway, &domain, "sprayer").await;
    let known = domain.directory().lookup(&own).unwrap();
    assert_eq!(known.incarnation, gateway.incarnation());
    domain.close().await;
    gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_announcement_by_mdns_takes_no_name_of_a_gateways_agents() {
    let config = config(&["discovery.mdns=true", "discovery.interfaces=lo"]);
    let (gateway, domain) = host(&config).await;
    let own = gateway.name().to_owned();
    let namesake = MdnsDirectory::open(MdnsConfig {
        interfaces: vec!["lo".to_owned()],
        ..MdnsConfig::new(MtsId::new(&*own, Incarnation::random()))
    });
    let namesake = namesake.unwrap();
    let at: fipa::Location = "tcp://127.0.0.1:9".parse().unwrap();
    for prefix in PREFIXES {
        let registration = Registration {
            registered: SystemTime::UNIX_EPOCH,
            ..Registration::new(
                format!("{prefix}@{own}"),
                Incarnation::random(),
                vec![at.clone()],
            )
        };
        namesake.register(registration).unwrap();
    }
    for prefix in PREFIXES {
        until_async("a second name", || {
            second_names(&domain, prefix, &own, false).len() == 1
        })
        .await;
    }
    keeps_its_names(&gateway, &domain, "painter").await;
    namesake.close();
    domain.close().await;
    gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn no_process_and_no_other_platform_takes_the_name_of_a_gateways_agent() {
    let (gateway, domain) = host(&config(&["platform.df=false"])).await;
    let own = gateway.name();
    for name in [
        format!("df@{own}"),
        format!("df-00000000@{own}"),
        "ams@elsewhere".to_owned(),
    ] {
        let refused = domain.register(&name).await;
        let reason = refused.map(drop).unwrap_err();
        let reason = fipa_acl::ErrorChain(&reason).to_string();
        assert!(
            reason.contains("reserved for an agent of the gateway"),
            "{reason}"
        );
    }
    let rover = domain.register("rover").await.unwrap();
    let entry = domain.directory().lookup(own).unwrap();
    for (name, is_reserved) in [(format!("df@{own}"), true), ("df@jade".to_owned(), false)] {
        let id = AgentId::new(&*name).unwrap();
        let id = id.with_address("tcp://127.0.0.1:9;fipa-services").unwrap();
        let introduced = fipa::admin::contact::introduce(&rover, &entry, &id, TIMEOUT).await;
        match introduced {
            Ok(()) => assert!(!is_reserved, "{name}"),
            Err(error) => {
                let error = fipa_acl::ErrorChain(&error).to_string();
                assert!(is_reserved && error.contains("reserved"), "{name}: {error}");
            }
        }
    }
    domain.close().await;
    gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_configuration_names_the_agents_and_turns_them_off() {
    let (gateway, domain) = host(&config(&["platform.ams=false", "platform.df=pages"])).await;
    let rover = domain.register("rover").await.unwrap();
    assert_eq!(rover.df().unwrap().id().name(), "pages");
    assert!(
        rover
            .df()
            .unwrap()
            .search(&lifting())
            .await
            .unwrap()
            .is_empty()
    );
    assert!(matches!(rover.ams(), Err(PlatformError::NoAgent(_))));
    drop(rover);
    domain.close().await;
    gateway.close().await;
}

/// Searches until the names of the services that match are these.
async fn until_listed(df: &Df<'_>, template: &AgentDescription, names: &[&str]) {
    let listed = async || {
        let found = df.search(template).await.unwrap();
        let services = found.iter().flat_map(|it| &it.services);
        let mut found: Vec<String> = services.filter_map(|it| it.name.clone()).collect();
        found.sort_unstable();
        found
    };
    let until = tokio::time::Instant::now() + TIMEOUT;
    loop {
        let found = listed().await;
        if found == names {
            return;
        }
        assert!(tokio::time::Instant::now() < until, "{found:?}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// The application describes its agent while topics come and go.
#[tokio::test(flavor = "multi_thread")]
async fn topics_are_listed_beside_the_services_of_the_application() {
    let [(_gateway, near), (_far_gateway, far)] = two_hosts(&[]).await;
    let camera = near.register("camera").await.unwrap();
    let viewer = far.register("viewer").await.unwrap();
    let image = Topic::new("image").media_type("image/jpeg").rate(30.0);
    let image = camera.publisher(image).unwrap();
    let own = AgentDescription {
        name: Some(camera.id().clone()),
        ..AgentDescription::default()
    };
    let df = camera.df().unwrap();
    until_listed(&df, &own, &["image"]).await;
    df.register(lifting_as("lift-1")).await.unwrap();
    until_listed(&df, &own, &["image", "lift-1"]).await;
    let charge = camera.publisher("charge").unwrap();
    until_listed(&df, &own, &["charge", "image", "lift-1"]).await;
    df.modify(lifting_as("lift-2")).await.unwrap();
    until_listed(&df, &own, &["charge", "image", "lift-2"]).await;

    knows(&far, "camera").await;
    let images = AgentDescription {
        services: vec![ServiceDescription {
            properties: vec![Property::new("media-type", "image/jpeg")],
            ..ServiceDescription::of_type("topic")
        }],
        ..AgentDescription::default()
    };
    until_listed(
        &viewer.df().unwrap(),
        &images,
        &["charge", "image", "lift-2"],
    )
    .await;

    df.deregister().await.unwrap();
    until_listed(&df, &own, &["charge", "image"]).await;
    drop(charge);
    until_listed(&df, &own, &["image"]).await;
    drop(image);
    until_listed(&df, &own, &[]).await;
    assert!(df.search(&own).await.unwrap().is_empty());
}

#[tokio::test(flavor = "multi_thread")]
async fn topics_are_listed_by_the_next_gateway() {
    let config = config(&[]);
    let (gateway, domain) = host(&config).await;
    let camera = domain.register("camera").await.unwrap();
    let viewer = domain.register("viewer").await.unwrap();
    let _image = camera.publisher("image").unwrap();
    let topics = ServiceDescription::of_type("topic").into();
    until_listed(&viewer.df().unwrap(), &topics, &["image"]).await;
    gateway.close().await;
    until_async("the directory facilitator ends", || viewer.df().is_err()).await;
    let _next = Gateway::open(&self::config(&[&format!("domain={}", config.domain)])).await;
    until_async("a directory facilitator", || viewer.df().is_ok()).await;
    until_listed(&viewer.df().unwrap(), &topics, &["image"]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_of_another_host_tells_its_topics() {
    let [(_gateway, near), (_far_gateway, far)] = two_hosts(&[]).await;
    let camera = near.register("camera").await.unwrap();
    let viewer = far.register("viewer").await.unwrap();
    knows(&far, "camera").await;
    knows(&near, "viewer").await;
    let image = camera.publisher(Topic::new("image").rate(30.0)).unwrap();
    let _charge = camera.publisher("charge").unwrap();
    let subscribe = viewer.message(Performative::Subscribe).receiver("camera");
    let mut images = viewer
        .subscribe(subscribe.content("image"), TIMEOUT)
        .await
        .unwrap();
    for _ in 0..2 {
        assert_eq!(image.publish(vec![7; 1000]).await.delivered().await, 1);
        images.next().await.unwrap();
    }
    let topics = viewer.topics_of(camera.id()).await.unwrap();
    let names: Vec<&str> = topics.iter().map(|it| &*it.name).collect();
    assert_eq!(names, ["charge", "image"]);
    assert_eq!((topics[0].published, topics[0].bytes), (0, None));
    let image = &topics[1];
    assert_eq!((image.published, image.bytes), (2, Some(1000)));
    assert_eq!((image.rate, image.subscribers), (Some(30.0), 1));
    assert!(image.measured_rate.is_some());
    let subscriber = &image.first_subscribers[0];
    assert_eq!(
        (&*subscriber.name, &*subscriber.keep),
        ("viewer", "latest(1)")
    );
    assert_eq!((subscriber.delivered, subscriber.failed), (2, 0));
}
