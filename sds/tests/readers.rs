//! Conformance of back ends that are only read here: static gateways, contacts, entries of
//! neighbors, and the merged view of all. Writable back ends also run the suite in `common`.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_sds::{
    Change, ContactDirectory, DeregisterError, Directory, Exchange, ExchangeDirectory, Matcher,
    MemoryDirectory, MergedDirectory, MtsId, Present, Query, Reach, RegisterError, Registration,
    Resolution, Source, StaticDirectory, resolve,
};
use fipa_transport::{Incarnation, Location};

const NAMES: [&str; 3] = ["arm_left", "arm_right", "camera"];

fn location(number: u64) -> Location {
    format!("tcp://10.0.0.{number}:7788#{number:016x}")
        .parse()
        .unwrap()
}

/// Checks a directory with the agents [`NAMES`], of which `camera` is at 10.0.0.3.
fn conforms(directory: &dyn Directory, source: Source) {
    let entries = directory.entries();
    let names: Vec<&str> = entries.iter().map(|entry| &*entry.name).collect();
    assert_eq!(names, NAMES, "by name");
    assert!(
        Arc::ptr_eq(&entries, &directory.entries()),
        "nothing has changed"
    );
    for entry in entries.iter() {
        assert_eq!(entry.source, source);
        assert!(matches!(entry.reach, Reach::Remote { .. }));
        assert_eq!(entry.check(), Ok(()));
        assert_eq!(directory.lookup(&entry.name).as_ref(), Some(entry));
        assert_eq!(directory.known(&entry.name).as_ref(), Some(entry));
        if entry.incarnation.is_known() {
            let found = directory.by_incarnation(entry.incarnation);
            assert_eq!(found.as_ref(), Some(entry));
        }
    }
    assert_eq!(directory.lookup("arm_"), None);
    assert_eq!(directory.by_incarnation(Incarnation::UNKNOWN), None);
    assert_eq!(directory.by_incarnation(Incarnation::from_u64(999)), None);

    let matcher = |text| Some(Matcher::parse(text).unwrap());
    let none = Query::all;
    for (query, expected) in [
        (none(), &NAMES[..]),
        (
            Query {
                name: matcher("arm_.*"),
                ..none()
            },
            &NAMES[..2],
        ),
        (
            Query {
                name: matcher("camera"),
                ..none()
            },
            &NAMES[2..],
        ),
        (
            Query {
                location: matcher(r"tcp://10\.0\.0\.3:.*"),
                ..none()
            },
            &NAMES[2..],
        ),
        (
            Query {
                location: matcher("udp://.*"),
                ..none()
            },
            &[],
        ),
        (
            Query {
                agent_type: matcher("nothing like it"),
                ..none()
            },
            &[],
        ),
        (
            Query {
                description: matcher(".+"),
                name: matcher("arm"),
                ..none()
            },
            &[],
        ),
    ] {
        let found = directory.search(&query);
        let names: Vec<&str> = found.iter().map(|entry| &*entry.name).collect();
        assert_eq!(names, expected, "{query:?}");
    }

    let stranger = Registration::new("stranger", Incarnation::random(), Vec::new());
    assert!(matches!(
        directory.register(stranger),
        Err(RegisterError::ReadOnly)
    ));
    assert!(matches!(
        directory.deregister("camera", Incarnation::random()),
        Err(DeregisterError::ReadOnly)
    ));
}

/// Checks that the departure of an agent is reported, in order.
fn tells_departures(directory: &dyn Directory, leave: impl FnOnce()) {
    let mut watch = directory.watch();
    assert_eq!(watch.try_next(), None);
    let generation = directory.generation();
    let all = directory.entries().len();
    leave();
    assert_ne!(directory.generation(), generation);
    let mut departures = 0;
    while let Some(change) = watch.try_next() {
        assert!(matches!(change, Change::Left(_)), "{change:?}");
        departures += 1;
    }
    assert!(departures > 0);
    assert_eq!(directory.entries().len(), all - departures);
}

fn contacts() -> (Instant, ContactDirectory) {
    let (now, contacts) = (Instant::now(), ContactDirectory::new());
    for (number, name) in (1..).zip(NAMES) {
        let incarnation = Incarnation::from_u64(number + 100);
        contacts
            .record_sender(now, name, incarnation, location(number))
            .unwrap();
    }
    (now, contacts)
}

/// Another back end that has the agents.
fn named() -> StaticDirectory {
    let agents = NAMES.map(|name| (name, vec![location(1)]));
    StaticDirectory::new(agents).unwrap()
}

/// Returns an exchange in which each agent was sent by a different gateway.
fn exchange() -> (Instant, Exchange, Arc<ExchangeDirectory>) {
    let (now, mut exchange) = (Instant::now(), Exchange::new(0));
    let gateways: Vec<_> = (1..=3)
        .map(|number| {
            Present::unproved(
                MtsId::new("mts", Incarnation::from_u64(number)),
                vec![location(number)],
            )
        })
        .collect();
    exchange.handle_neighbors(now, &gateways);
    for (number, name) in (1..).zip(NAMES) {
        let id = number + 100;
        let exchanged = format!(
            r#"{{"version":1,"tell":{{"full":{{"version":1,"first":true,"last":true,
            "agents":[{{"name":"{name}","id":"{id:016x}","registered":5}}]}}}}}}"#
        );
        let from = Incarnation::from_u64(number);
        exchange
            .handle_letter(now, from, exchanged.as_bytes())
            .unwrap();
    }
    let directory = exchange.directory();
    (now, exchange, directory)
}

#[test]
fn static_gateways_conform() {
    let gateways = (1..)
        .zip(NAMES)
        .map(|(number, name)| (name, vec![location(number)]));
    let gateways = StaticDirectory::new(gateways).unwrap();
    conforms(&gateways, Source::Static);
    // Patterns do not match gateways.
    assert_eq!(resolve(&gateways, "arm_.*", "x").unwrap(), Resolution::None);
}

#[test]
fn contacts_conform() {
    let (now, contacts) = contacts();
    conforms(&contacts, Source::Contact);
    tells_departures(&contacts, || {
        contacts.forget(now, &named());
    });
}

#[test]
fn entries_of_neighbors_conform() {
    let (now, mut exchange, directory) = exchange();
    conforms(&*directory, Source::Exchange);
    tells_departures(&*directory, || {
        exchange.handle_neighbors(now, &[]);
        exchange.handle_timeout(now + Exchange::MEMORY + Duration::from_millis(1));
    });
}

#[test]
fn merged_views_of_them_conform() {
    let (_, _, exchanged) = exchange();
    let (now, contacts) = contacts();
    let contacts = Arc::new(contacts);
    let empty = StaticDirectory::new::<&str>([]).unwrap();
    let view = MergedDirectory::new(vec![Arc::new(empty), exchanged, contacts.clone()]);
    // Exchanged entries are kept for longer than contacts; each states its source.
    conforms(&view, Source::Exchange);
    let only_heard = MergedDirectory::new(vec![contacts.clone()]);
    conforms(&only_heard, Source::Contact);
    tells_departures(&only_heard, || {
        contacts.forget(now, &named());
    });
    // A writable directory makes the view writable.
    let memory = Arc::new(MemoryDirectory::new(MtsId::new(
        "own",
        Incarnation::random(),
    )));
    let view = MergedDirectory::new(vec![contacts, memory.clone()]);
    let own = Registration::new("own", Incarnation::random(), Vec::new());
    view.register(own.clone()).unwrap();
    assert!(memory.lookup("own").is_some());
    view.deregister("own", own.incarnation).unwrap();
}
