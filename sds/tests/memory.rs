//! The back ends within one process, and the merged view.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

mod common;

use std::sync::Arc;
use std::time::{Duration, UNIX_EPOCH};

use common::{conforms, next, registration};
use fipa_sds::{
    Change, Directory, MemoryDirectory, MergedDirectory, MtsId, RegisterError, Role,
    StaticDirectory, Watch,
};
use fipa_transport::Incarnation;

fn memory() -> MemoryDirectory {
    MemoryDirectory::new(MtsId::new("mts", Incarnation::random()))
}

#[tokio::test]
async fn memory_conforms() {
    let directory = memory();
    conforms(&directory, &directory).await;
}

#[tokio::test]
async fn a_merged_directory_conforms() {
    let gateways = StaticDirectory::new::<&str>([]).unwrap();
    let directory = MergedDirectory::new(vec![Arc::new(gateways), Arc::new(memory())]);
    conforms(&directory, &directory).await;
}

#[test]
fn static_gateways_are_read_only() {
    let location = "tcp://10.0.0.2:7788".parse().unwrap();
    let directory = StaticDirectory::new([("crex-mts", vec![location])]).unwrap();
    let entry = directory.lookup("crex-mts").unwrap();
    assert_eq!(entry.role, Role::Gateway);
    assert!(!entry.incarnation.is_known());
    assert!(matches!(
        directory.register(registration("x")),
        Err(RegisterError::ReadOnly)
    ));
    assert!(StaticDirectory::new([("", vec![])]).is_err());
}

#[tokio::test]
async fn a_slow_watcher_is_told_that_it_lagged() {
    let directory = memory();
    let mut watch = directory.watch();
    for number in 0..=Watch::CAPACITY {
        let agent = registration(&format!("agent_{number}"));
        directory.register(agent).unwrap();
    }
    assert_eq!(next(&mut watch).await, Change::Lagged);
    assert_eq!(directory.entries().len(), Watch::CAPACITY + 1);
    assert_eq!(watch.try_next(), None);
    directory.register(registration("last")).unwrap();
    assert!(matches!(next(&mut watch).await, Change::Joined(_)));
    drop(directory);
    assert_eq!(watch.next().await, None);
}

#[tokio::test]
async fn the_earlier_registration_is_seen_in_a_merged_view() {
    let (one, two) = (Arc::new(memory()), Arc::new(memory()));
    let merged = MergedDirectory::new(vec![one.clone(), two.clone()]);
    let mut watch = merged.watch();
    let at = |millis| UNIX_EPOCH + Duration::from_millis(millis);

    let mut later = registration("arm");
    later.registered = at(2000);
    one.register(later.clone()).unwrap();
    assert!(matches!(next(&mut watch).await, Change::Joined(_)));

    let mut earlier = registration("arm");
    earlier.registered = at(1000);
    two.register(earlier.clone()).unwrap();
    match next(&mut watch).await {
        Change::Changed { before, after } => {
            assert_eq!(before.incarnation, later.incarnation);
            assert_eq!(after.incarnation, earlier.incarnation);
        }
        other => panic!("{other:?}"),
    }
    let seen = merged.lookup("arm").unwrap();
    assert_eq!(seen.incarnation, earlier.incarnation);
    assert_eq!(merged.entries().to_vec(), [seen]);
    assert_eq!(merged.by_incarnation(later.incarnation), None);
    match merged.register(registration("arm")) {
        Err(RegisterError::AlreadyRegistered { holder }) => {
            assert_eq!(holder.incarnation, earlier.incarnation);
        }
        other => panic!("{other:?}"),
    }

    // The removal of an entry that is not visible is not reported.
    one.deregister("arm", later.incarnation).unwrap();
    assert_eq!(watch.try_next(), None);
    two.deregister("arm", earlier.incarnation).unwrap();
    assert!(matches!(next(&mut watch).await, Change::Left(_)));
    assert_eq!(merged.lookup("arm"), None);
}
