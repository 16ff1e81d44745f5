//! No agent has the name of a pattern: it would intercept the letters to the agents that the pattern
//! matches. The tests of the other back ends are in `proved.rs` and in the modules of mDNS.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::time::Instant;

use fipa_sds::{
    ContactDirectory, ContactError, Directory, EntryError, HostConfig, HostDirectory,
    MemoryDirectory, MtsId, NameError, RegisterError, Registration, StaticDirectory,
};
use fipa_transport::{Incarnation, Location};

const PATTERNS: [&str; 10] = [
    "arm_.*",
    "arm_?",
    "arm_+",
    "[a]rm",
    "(arm)",
    "arm{2}",
    "arm|rover",
    "^arm",
    "arm$",
    r"arm\d",
];

const MTS: Incarnation = Incarnation::from_u64(1);

fn location() -> Location {
    "tcp://192.0.2.1:7788#0000000000000001".parse().unwrap()
}

fn is_pattern(error: &EntryError, name: &str) -> bool {
    matches!(error, EntryError::Name(NameError::Pattern(refused_name)) if refused_name == name)
}

/// Registers each name, then one that is no pattern.
fn refuses(directory: &dyn Directory) {
    let arm = Incarnation::from_u64(2);
    for name in PATTERNS {
        match directory.register(Registration::new(name, arm, vec![location()])) {
            Err(RegisterError::Invalid(error)) => assert!(is_pattern(&error, name), "{error:?}"),
            other => panic!("{name}: {other:?}"),
        }
        assert!(directory.known(name).is_none());
    }
    let registration = Registration::new("arm_1", arm, vec![location()]);
    assert!(directory.register(registration).is_ok());
}

#[tokio::test]
async fn they_are_refused_at_registration() {
    refuses(&MemoryDirectory::new(MtsId::new("mts", MTS)));
    let home = tempfile::tempdir().unwrap();
    let config = HostConfig {
        brief: false,
        users: fipa_transport::DomainUsers::This,
        dir: home.path().join("domain"),
        mts: MtsId::new("mts", MTS),
        gateway: false,
    };
    refuses(&HostDirectory::open(config).unwrap());
}

#[test]
fn they_are_refused_as_senders_of_letters_and_in_the_configuration() {
    let contacts = ContactDirectory::new();
    for name in PATTERNS {
        let recorded = contacts.record_sender(Instant::now(), name, MTS, location());
        let Err(ContactError::Entry(refused)) = recorded else {
            panic!("{name} is a contact");
        };
        assert!(is_pattern(&refused, name));
        let named = StaticDirectory::new([(name, vec![location()])]);
        assert!(is_pattern(&named.unwrap_err(), name));
    }
    assert_eq!(contacts.entries().len(), 0);
}
