//! The agent management system and the directory facilitator of gateways, used over letters.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::time::{Duration, SystemTime};

use fipa::platform::{
    AgentDescription, AmsDescription, Df, Exception, PlatformError, ServiceDescription, limits,
};
use fipa::{AgentId, Config, Domain, Gateway, Kind, Performative, Time, blocking};
use fipa_testbed::until_async;

/// Time limit of all waits, which a passing test does not reach.
const PATIENCE: Duration = Duration::from_secs(60);

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
    AgentDescription {
        services: vec![ServiceDescription::of_type("lifting")],
        ..AgentDescription::default()
    }
}

/// Returns a description with one service of this name.
fn lifting_as(name: &str) -> AgentDescription {
    AgentDescription {
        services: vec![ServiceDescription::new(name, "lifting")],
        ..AgentDescription::default()
    }
}

fn names<'a>(ids: impl IntoIterator<Item = &'a Option<AgentId>>) -> Vec<String> {
    let ids = ids.into_iter().flatten();
    ids.map(|id| id.name().to_owned()).collect()
}

/// Waits for the next notification.
async fn next(notifications: &mut fipa::platform::Notifications) -> Vec<AgentDescription> {
    let next = tokio::time::timeout(PATIENCE, notifications.next()).await;
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
    notifications.cancel(PATIENCE).await.unwrap();
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
    assert!(lease <= limits::LEASE + PATIENCE, "{lease:?}");
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
    let ended = tokio::time::timeout(PATIENCE, wait).await;
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
    // The agent registers with the other host, too: that description hides the one that has travelled.
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
    support::next_millisecond().await;
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
    until_async("both gateways", || third.neighbours().len() == 2).await;
    finds(&df, &["crane"]).await;
    let mut notifications = df.subscribe(&lifting()).await.unwrap();
    let mut shown = service(&next(&mut notifications).await);
    while shown != "lift-1" {
        shown = service(&next(&mut notifications).await);
    }
    // The other agent gets the name.
    drop(first);
    let mut changed = next(&mut notifications).await;
    if changed[0].services.is_empty() {
        changed = next(&mut notifications).await;
    }
    assert_eq!(service(&changed), "lift-2");
    for domain in [at_one, at_two, at_third] {
        domain.close().await;
    }
    for gateway in [one, two, third] {
        gateway.close().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_gateways_with_one_name_the_later_names_its_agents_otherwise() {
    let same = format!("mts.name=robot-{}", std::process::id());
    let [(near, at_home), (far, abroad)] = two_hosts(&[&same]).await;
    assert_eq!(near.name(), far.name());
    let listed = |domain: &Domain, prefix: &str| {
        let entries = domain.directory().entries();
        let all = entries.iter().filter(|it| it.name.starts_with(prefix));
        all.map(|it| it.name.to_string()).collect::<Vec<_>>()
    };
    for prefix in ["ams@", "df@"] {
        let plain = format!("{prefix}{}", near.name());
        for domain in [&at_home, &abroad] {
            until_async("two agents", || listed(domain, prefix).len() == 2).await;
            let names = listed(domain, prefix);
            assert_eq!(names[0], plain);
            let digits = names[1].strip_prefix(&format!("{plain}-")).unwrap();
            assert!(digits.len() == 4 && digits.chars().all(|c| c.is_ascii_hexdigit()));
        }
    }
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
    assert_ne!(facilitator.id(), df.id());
    // Only the description of its own host is one that an agent can change.
    let refused = facilitator.modify(lifting()).await;
    assert!(refused.is_err(), "{refused:?}");
    finds(&facilitator, &["rover"]).await;
    for domain in [at_home, abroad] {
        domain.close().await;
    }
    far.close().await;
    near.close().await;
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

#[test]
fn a_process_without_a_runtime_uses_the_same_calls() {
    let config = config(&[]);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let gateway = runtime.block_on(Gateway::open(&config)).unwrap();
    let domain = blocking::Domain::open(&config).unwrap();
    let crane = domain.register("crane").unwrap();
    let rover = domain.register("rover").unwrap();
    let mut notifications = rover.df().unwrap().subscribe(&lifting()).unwrap();
    let service = ServiceDescription::new("lift-1", "lifting");
    let df = crane.df().unwrap();
    df.register_service(service).unwrap();
    assert_eq!(notifications.next().unwrap().len(), 1);
    assert_eq!(df.search(&lifting()).unwrap().len(), 1);
    df.deregister().unwrap();
    assert!(notifications.next().unwrap()[0].services.is_empty());
    notifications.cancel(PATIENCE).unwrap();
    let ams = rover.ams().unwrap();
    assert_eq!(ams.description().unwrap().name, gateway.name());
    drop((crane, rover));
    domain.close();
    runtime.block_on(gateway.close());
}
