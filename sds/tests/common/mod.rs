//! Conformance suite of writable back ends.

// Each test binary uses only a part of this.
#![allow(dead_code, unreachable_pub)]

#[cfg(feature = "mdns")]
pub mod mdns;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, UNIX_EPOCH};

use fipa_sds::{
    Change, DeregisterError, Directory, Entry, Matcher, Members, Query, RegisterError,
    Registration, Role, Source, Watch, resolve,
};
use fipa_testbed::until_some_async;
use fipa_transport::Incarnation;

/// Ends a test that hangs; no condition below takes nearly as long.
pub const WATCHDOG: Duration = Duration::from_secs(60);

/// The next change.
pub async fn next(watch: &mut Watch) -> Change {
    let next = tokio::time::timeout(WATCHDOG, watch.next()).await;
    next.expect("a change").expect("the directory is there")
}

pub fn registration(name: &str) -> Registration {
    let mut registration = Registration::new(
        name,
        Incarnation::random(),
        vec![
            "shm://mailbox_1#00000000000000aa".parse().unwrap(),
            "tcp://127.0.0.1:7788#00000000000000aa".parse().unwrap(),
            "udp://[::1]:7789".parse().unwrap(),
        ],
    );
    registration.agent_type = "gripper".to_owned();
    registration.description = "the one with the señsor; = and \" inside".to_owned();
    registration
}

/// The parts of an entry that its owner supplied.
fn said(entry: &Entry) -> Registration {
    Registration {
        name: entry.name.clone(),
        agent_type: entry.agent_type.clone(),
        incarnation: entry.incarnation,
        locations: entry.locations.clone(),
        description: entry.description.clone(),
        registered: entry.registered,
        role: entry.role.clone(),
    }
}

/// Runs the suite: `writer` registers, and `reader` sees it, at once or later; they may be the
/// same.
pub async fn conforms(writer: &dyn Directory, reader: &dyn Directory) {
    entries_arrive_as_they_were_registered(writer, reader).await;
    names_survive_whatever_they_contain(writer, reader).await;
    a_name_has_one_owner(writer, reader).await;
    changes_are_told_in_order(writer, reader).await;
    searches_find(writer, reader).await;
    nonsense_is_refused(writer);
}

async fn entries_arrive_as_they_were_registered(writer: &dyn Directory, reader: &dyn Directory) {
    let mut asked = registration("arm_left");
    asked.role = Role::Gateway;
    let registered = writer.register(asked.clone()).unwrap();
    // Times have whole milliseconds.
    let lost = asked.registered.duration_since(registered.registered);
    assert!(lost.unwrap() < Duration::from_millis(1));
    asked.registered = registered.registered;
    assert_eq!(said(&registered), asked);

    let found = until_some_async("lookup", || reader.lookup("arm_left")).await;
    if found.source == Source::Mdns {
        // Other hosts do not get routes within this one.
        asked.locations.retain(|it| !it.kind().is_host_local());
    }
    assert_eq!(said(&found), asked);
    assert_eq!(found.mts, registered.mts);
    assert_eq!(
        reader.by_incarnation(asked.incarnation),
        Some(found.clone())
    );
    assert_eq!(reader.by_incarnation(Incarnation::UNKNOWN), None);
    assert_eq!(reader.lookup("arm_"), None);
    assert_eq!(reader.entries().to_vec(), [found]);
    assert!(
        Arc::ptr_eq(&reader.entries(), &reader.entries()),
        "nothing has changed"
    );

    writer.deregister("arm_left", asked.incarnation).unwrap();
    until_some_async("deregistered", || {
        reader.lookup("arm_left").is_none().then_some(())
    })
    .await;
    assert_eq!(reader.by_incarnation(asked.incarnation), None);
}

async fn names_survive_whatever_they_contain(writer: &dyn Directory, reader: &dyn Directory) {
    let names = [
        "a".to_owned(),
        "arm.left.".to_owned(),
        "arm!left".to_owned(),
        "arm.left".to_owned(),
        "ARM.left".to_owned(),
        "béla@192.0.2.2:1099/JADE".to_owned(),
        "2) ~ \u{1F980}".to_owned(),
        "x".repeat(63),
        "x".repeat(64),
        "é.".repeat(341),
    ];
    let expected: BTreeSet<String> = names.iter().cloned().collect();
    let registrations = names.map(|name| registration(&name));
    for registration in &registrations {
        writer.register(registration.clone()).unwrap();
    }
    until_some_async("all names", || {
        reader.refresh();
        let entries = reader.entries();
        let names: BTreeSet<_> = entries.iter().map(|entry| entry.name.to_string()).collect();
        (names == expected).then_some(())
    })
    .await;
    for registration in &registrations {
        let found = reader.lookup(&registration.name).unwrap();
        assert_eq!(found.incarnation, registration.incarnation);
        let (name, incarnation) = (&registration.name, registration.incarnation);
        writer.deregister(name, incarnation).unwrap();
    }
    until_some_async("all entries left", || {
        reader.entries().is_empty().then_some(())
    })
    .await;
}

async fn a_name_has_one_owner(writer: &dyn Directory, reader: &dyn Directory) {
    let first = registration("camera");
    writer.register(first.clone()).unwrap();
    match writer.register(registration("camera")) {
        Err(RegisterError::AlreadyRegistered { holder }) => {
            assert_eq!(holder.incarnation, first.incarnation);
        }
        other => panic!("{other:?}"),
    }
    for (name, incarnation) in [
        ("camera", Incarnation::random()),
        ("absent", first.incarnation),
    ] {
        assert!(matches!(
            writer.deregister(name, incarnation),
            Err(DeregisterError::NotRegistered(_))
        ));
    }
    writer.deregister("camera", first.incarnation).unwrap();
    let second = registration("camera");
    writer.register(second.clone()).unwrap();
    until_some_async("the second", || {
        reader.refresh();
        let found = reader.lookup("camera")?;
        (found.incarnation == second.incarnation).then_some(())
    })
    .await;
    writer.deregister("camera", second.incarnation).unwrap();
    until_some_async("gone", || reader.lookup("camera").is_none().then_some(())).await;
}

async fn changes_are_told_in_order(writer: &dyn Directory, reader: &dyn Directory) {
    let mut watch = reader.watch();
    assert_eq!(watch.try_next(), None);
    let generation = reader.generation();
    let mut one = registration("wheel");
    writer.register(one.clone()).unwrap();
    match next(&mut watch).await {
        Change::Joined(entry) => assert_eq!(entry.incarnation, one.incarnation),
        other => panic!("{other:?}"),
    }
    assert_ne!(reader.generation(), generation);
    one.description = "turned".to_owned();
    writer.register(one.clone()).unwrap();
    match next(&mut watch).await {
        Change::Changed { before, after } => {
            assert_ne!(before.description, "turned");
            assert_eq!(after.description, "turned");
            assert_eq!(after.registered, before.registered);
        }
        other => panic!("{other:?}"),
    }
    writer.deregister("wheel", one.incarnation).unwrap();
    match next(&mut watch).await {
        Change::Left(entry) => assert_eq!(entry.description, "turned"),
        other => panic!("{other:?}"),
    }
    assert_eq!(watch.try_next(), None);
}

async fn searches_find(writer: &dyn Directory, reader: &dyn Directory) {
    let mut agents = ["arm_left", "arm_right", "camera"].map(registration);
    agents[2].agent_type = "sensor".to_owned();
    agents[2].description = "sees".to_owned();
    agents[2].locations = vec!["tcp://192.0.2.7:1".parse().unwrap()];
    agents[2].registered = UNIX_EPOCH + Duration::from_millis(1_800_000_000_120);
    let members = Members::new(["arm_left", "camera"], None).unwrap();
    agents[1].role = Role::Coalition(members);
    for agent in &agents {
        writer.register(agent.clone()).unwrap();
    }
    for agent in &agents {
        until_some_async(&format!("finding {:?}", agent.name), || {
            reader.lookup(&agent.name)
        })
        .await;
    }
    let matcher = |text| Some(Matcher::parse(text).unwrap());
    let mts = reader.lookup("camera").unwrap().mts.shown().to_owned();
    let all = Query::all();
    for (query, expected) in [
        (all.clone(), "arm_left arm_right camera"),
        (
            Query {
                name: matcher("arm_.*"),
                ..all.clone()
            },
            "arm_left arm_right",
        ),
        (
            Query {
                agent_type: matcher("sensor"),
                ..all.clone()
            },
            "camera",
        ),
        (
            Query {
                location: matcher(r"tcp://192\.0\.2\.7:.+"),
                ..all.clone()
            },
            "camera",
        ),
        (
            Query {
                description: matcher("s[ei]+s"),
                ..all.clone()
            },
            "camera",
        ),
        (
            Query {
                description: matcher("sees"),
                ..all.clone()
            },
            "camera",
        ),
        (
            Query {
                location: matcher("tcp://192.0.2.7:1"),
                ..all.clone()
            },
            "camera",
        ),
        (
            Query {
                registered: matcher("2027-01-15T08:00:00.120Z"),
                ..all.clone()
            },
            "camera",
        ),
        (
            Query {
                registered: matcher("2027-01-15T.*"),
                ..all.clone()
            },
            "camera",
        ),
        (
            Query {
                mts: Some(Matcher::Exact(mts)),
                ..all.clone()
            },
            "arm_left arm_right camera",
        ),
        (
            Query {
                mts: matcher("absent.*"),
                ..all.clone()
            },
            "",
        ),
        (
            Query {
                member: matcher("arm_l.*"),
                ..all.clone()
            },
            "arm_right",
        ),
        (
            Query {
                name: matcher("arm.*"),
                agent_type: matcher("sensor"),
                ..all
            },
            "",
        ),
    ] {
        let found = reader.search(&query);
        let names: Vec<&str> = found.iter().map(|entry| &*entry.name).collect();
        assert_eq!(names.join(" "), expected);
    }
    // Neither the sender nor a coalition.
    let multicast = resolve(reader, "arm_.*|camera", "arm_left").unwrap();
    let camera = reader.lookup("camera").unwrap();
    assert_eq!(multicast, fipa_sds::Resolution::Multicast(vec![camera]));
    for agent in &agents {
        writer.deregister(&agent.name, agent.incarnation).unwrap();
    }
    until_some_async("all gone", || reader.entries().is_empty().then_some(())).await;
}

fn nonsense_is_refused(writer: &dyn Directory) {
    let good = registration("good");
    let mut cases = vec![
        registration(""),
        registration("a\nb"),
        registration(&"x".repeat(1025)),
    ];
    cases.push(Registration {
        agent_type: "x".repeat(Entry::MAX_TYPE + 1),
        ..good.clone()
    });
    cases.push(Registration {
        description: "bell\u{7}".to_owned(),
        ..good.clone()
    });
    cases.push(Registration {
        incarnation: Incarnation::UNKNOWN,
        ..good.clone()
    });
    let location = good.locations[0].clone();
    cases.push(Registration {
        locations: vec![location; Entry::MAX_LOCATIONS + 1],
        ..good
    });
    for case in cases {
        assert!(
            matches!(
                writer.register(case.clone()),
                Err(RegisterError::Invalid(_))
            ),
            "{case:?}"
        );
    }
}
