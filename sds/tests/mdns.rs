//! The directory of the network, on the loopback interface.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

mod common;

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::time::{Duration, UNIX_EPOCH};

use common::mdns::{free_port, open};
use common::{conforms, next, registration};
use fipa_sds::{
    Change, Directory, MdnsDirectory, Members, Reach, RegisterError, Registration, Role, Source,
};
use fipa_testbed::{ChildGuard, PacketRepeater, until_some_async};
use fipa_transport::{Incarnation, Location};

#[tokio::test(flavor = "multi_thread")]
async fn mdns_conforms() {
    let port = free_port();
    let (one, two) = (open(port, "one"), open(port, "two"));
    conforms(&one, &two).await;
    assert_eq!(one.status().last_error, None);
    assert_eq!(two.status().last_error, None);
    assert_eq!(two.status().refused, 0);
}

#[tokio::test]
async fn entries_are_marked_and_ones_own_are_not_read_back() {
    let port = free_port();
    let (one, two) = (open(port, "one"), open(port, "two"));
    one.register(registration("arm")).unwrap();
    two.register(registration("leg")).unwrap();
    let arm = until_some_async("arm", || two.lookup("arm")).await;
    let leg = until_some_async("leg", || one.lookup("leg")).await;
    assert_eq!(leg.source, Source::Mdns);
    assert_eq!(leg.mts.shown(), "two");
    let gateway = leg.mts.incarnation;
    assert_eq!(leg.reach, Reach::Remote { gateway });
    // By now each directory has received both.
    assert_eq!(one.entries().to_vec(), [leg]);
    assert_eq!(two.entries().to_vec(), [arm]);
    assert_eq!((one.status().announced, one.status().known), (1, 1));
}

#[tokio::test]
async fn closing_says_goodbye() {
    let port = free_port();
    let (one, two) = (open(port, "one"), open(port, "two"));
    one.register(registration("arm")).unwrap();
    let mut watch = two.watch();
    assert!(matches!(next(&mut watch).await, Change::Joined(_)));
    one.close();
    assert!(matches!(next(&mut watch).await, Change::Left(_)));
    assert!(matches!(
        one.register(registration("leg")),
        Err(RegisterError::Closed)
    ));
}

/// Two directories register one name before they can know of each other; `first` and `second` are the
/// times of their hosts. Both agents stay announced, and none takes the name from the other.
async fn conflict(first: u64, second: u64) {
    let port = free_port();
    let (one, two) = (open(port, "one"), open(port, "two"));
    let witness = open(port, "witness");
    let agent = |millis| {
        let mut agent = registration("arm");
        agent.registered = UNIX_EPOCH + Duration::from_millis(millis);
        agent
    };
    let (agent_one, agent_two) = (agent(first), agent(second));
    one.register(agent_one.clone()).unwrap();
    two.register(agent_two.clone()).unwrap();
    let known = |directory: &MdnsDirectory| Some(directory.known("arm")?.incarnation);
    until_some_async("each other's agent, and both records", || {
        let known = (known(&one)?, known(&two)?);
        let each = known == (agent_two.incarnation, agent_one.incarnation);
        (each && witness.status().known == 2).then_some(())
    })
    .await;
    assert_eq!((one.status().announced, two.status().announced), (1, 1));
    let holder = known(&witness).unwrap();
    let (directory, leaving, staying) = match holder == agent_one.incarnation {
        true => (&one, &agent_one, &agent_two),
        false => (&two, &agent_two, &agent_one),
    };
    directory.deregister("arm", leaving.incarnation).unwrap();
    until_some_async("the other one has the name", || {
        (known(&witness)? == staying.incarnation).then_some(())
    })
    .await;
}

#[tokio::test]
async fn of_two_agents_of_one_name_both_are_announced() {
    conflict(1000, 2000).await;
}

#[tokio::test]
async fn of_two_agents_of_one_name_both_are_announced_in_the_other_order() {
    conflict(2000, 1000).await;
}

#[tokio::test]
async fn an_agent_that_is_announced_keeps_its_name_whatever_time_another_one_states() {
    let port = free_port();
    let (one, two) = (open(port, "one"), open(port, "two"));
    let witness = open(port, "witness");
    let first = one.register(registration("arm")).unwrap();
    until_some_async("the first", || witness.known("arm").zip(two.known("arm"))).await;
    let later = Registration {
        registered: UNIX_EPOCH,
        ..registration("arm")
    };
    let later = two.register(later).unwrap();
    until_some_async("both", || {
        let known = one.known("arm")?;
        (known.incarnation == later.incarnation && witness.status().known == 2).then_some(())
    })
    .await;
    let held = witness.known("arm").unwrap();
    assert_eq!(held.incarnation, first.incarnation);
}

#[tokio::test]
async fn different_names_may_share_a_label() {
    let port = free_port();
    let (one, two) = (open(port, "one"), open(port, "two"));
    // The same label on the network, where case does not matter.
    one.register(registration("Arm")).unwrap();
    two.register(registration("aRM")).unwrap();
    until_some_async("both", || one.lookup("aRM").zip(two.lookup("Arm"))).await;
    assert_eq!((one.status().known, two.status().known), (1, 1));
    assert_eq!((one.status().announced, two.status().announced), (1, 1));
}

/// A gateway repeatedly splits a coalition and merges the parts, and the other one watches: every
/// member belongs to exactly one coalition at any time.
#[tokio::test(flavor = "multi_thread")]
async fn mergers_and_splits_are_visible_at_once() {
    let port = free_port();
    let (one, two) = (open(port, "one"), open(port, "two"));
    let mut watch = two.watch();
    let ids = [Incarnation::random(), Incarnation::random()];
    let coalition = |name: &str, id, members: &[&str]| {
        let mut coalition = registration(name);
        coalition.incarnation = id;
        coalition.role = Role::Coalition(Members::new(members.iter().copied(), None).unwrap());
        coalition
    };
    let whole = coalition("Whole", ids[0], &["a", "b", "c"]);
    let registered = one.update(&[], vec![whole.clone()]);
    assert!(registered.joined[0].is_ok());
    let mut seen: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut look = async |until: usize| {
        while seen.len() != until {
            let change = next(&mut watch).await;
            for single in change.single() {
                match single {
                    Change::Joined(entry) | Change::Changed { after: entry, .. } => {
                        let Role::Coalition(members) = &entry.role else {
                            continue;
                        };
                        let names = members.names().iter().map(ToString::to_string);
                        seen.insert(entry.name.to_string(), names.collect());
                    }
                    Change::Left(entry) => drop(seen.remove(&*entry.name)),
                    other => panic!("{other:?}"),
                }
            }
            let mut members: Vec<&str> = seen.values().flatten().map(String::as_str).collect();
            members.sort_unstable();
            assert_eq!(members, ["a", "b", "c"], "{seen:?}");
        }
    };
    look(1).await;
    for round in 0..2 {
        // The part has another name each time, because a withdrawn label rests.
        let part = format!("Part {round}");
        let rest = coalition("Whole", ids[0], &["b", "c"]);
        let parting = coalition(&part, ids[1], &["a"]);
        let split = one.update(&[], vec![rest, parting]);
        assert!(split.joined.iter().all(Result::is_ok), "{split:?}");
        look(2).await;
        let merged = one.update(&[(part.into(), ids[1])], vec![whole.clone()]);
        assert!(merged.removed[0].is_ok() && merged.joined[0].is_ok());
        look(1).await;
    }
    // Its end is visible at once, although no further beacon follows.
    one.close();
    assert!(matches!(next(&mut watch).await, Change::Left(_)));
    assert_eq!(two.entries().len(), 0);
}

#[tokio::test]
async fn large_entries_are_announced_and_too_large_ones_refused() {
    let port = free_port();
    let (one, two) = (open(port, "one"), open(port, "two"));
    let mut large = registration("large");
    large.description = "x".repeat(1024);
    let location = |number: usize, len: usize| -> Location {
        let address = format!("{number}{}", "y".repeat(len - 1));
        format!("quic://{address}").parse().unwrap()
    };
    large.locations = (0..8).map(|number| location(number, 400)).collect();
    one.register(large.clone()).unwrap();
    let found = until_some_async("large", || two.lookup("large")).await;
    assert_eq!(found.locations, large.locations);
    assert_eq!(found.description, large.description);

    let three = open(port, &"m".repeat(1024));
    let mut huge = registration(&"n".repeat(1024));
    huge.description = "x".repeat(1024);
    huge.agent_type = "x".repeat(255);
    huge.locations = (0..8)
        .map(|number| location(number, 512).with_incarnation(Incarnation::random()))
        .collect();
    match three.register(huge) {
        Err(RegisterError::Full(why)) => assert!(why.contains("8000"), "{why}"),
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_gateway_that_vanished_is_noticed_by_verification() {
    let port = free_port();
    let two = open(port, "two");
    let (peer, gateway) = announcing(port, &two).await;
    // Its beacons continue, so that only the verification can detect it.
    let mut repeater = PacketRepeater::capture(&gateway, Ipv4Addr::LOCALHOST, port);
    drop(peer);
    repeater.start();
    assert!(two.lookup("Arm").is_some());
    two.verify("Arm");
    until_some_async("gone", || two.lookup("Arm").is_none().then_some(())).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_gateway_that_vanished_is_noticed_by_its_silence() {
    let port = free_port();
    let two = open(port, "two");
    let (peer, _) = announcing(port, &two).await;
    drop(peer);
    // No query is sent for it, and its record is valid for two minutes.
    until_some_async("gone", || two.lookup("Arm").is_none().then_some(())).await;
}

/// A process that announces an agent, has been found, and ends without a goodbye when dropped; and
/// the label of its beacons.
async fn announcing(port: u16, by: &MdnsDirectory) -> (ChildGuard, String) {
    let mut process = std::process::Command::new(std::env::current_exe().unwrap());
    let process = process
        .args(["--exact", "announcing_process", "--ignored", "-q"])
        .env("FIPA_SDS_TEST_PORT", port.to_string());
    let peer = ChildGuard::start(process);
    let found = until_some_async("the other process", || by.lookup("Arm")).await;
    assert_eq!(found.mts.shown(), "elsewhere");
    (peer, format!("{}\x0d_fipa_gateway", found.mts.incarnation))
}

#[test]
#[ignore = "is the other process of another test"]
fn announcing_process() {
    let port = std::env::var("FIPA_SDS_TEST_PORT").expect("started by another test");
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _context = runtime.enter();
    let directory = open(port.parse().unwrap(), "elsewhere");
    directory.register(registration("Arm")).unwrap();
    loop {
        std::thread::park();
    }
}
