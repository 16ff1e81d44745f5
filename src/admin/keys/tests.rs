//! Tests of keys in temporary directories.

use super::*;

fn keys() -> (tempfile::TempDir, Keys) {
    let dir = tempfile::tempdir().unwrap();
    let keys = Keys::at(dir.path().join("keys"));
    (dir, keys)
}

#[test]
fn a_certificate_has_the_given_names_and_validity() {
    let (_dir, keys) = keys();
    let agents = ["arm_1".to_owned(), "Käptn *".to_owned()];
    let made = keys.init("crex mts/1", &agents, VALID).unwrap();
    assert_eq!(keys.own().unwrap(), made);
    assert_eq!(made.certified().mts(), "crex mts/1");
    assert_eq!(made.certified().agents(), agents);
    let (from, until) = made.validity();
    assert!(until - from >= i64::try_from(VALID.as_secs()).unwrap());
    assert!(matches!(
        keys.init("crex", &[], VALID),
        Err(KeysError::Exists(_))
    ));
    assert_eq!(keys.own().unwrap(), made);
}

/// The owner of the other host would read them as patterns, and no agent has such a name.
#[test]
fn names_that_are_patterns_are_refused() {
    let (_dir, keys) = keys();
    for mts in ["*", "crex*", "crex-mts|rover-mts", "(none)"] {
        let refused = keys.init(mts, &[], VALID).unwrap_err();
        let KeysError::Certificate(CertificateError::Gateway(named)) = &refused else {
            panic!("{mts}: {refused:?}");
        };
        assert_eq!(named, mts);
    }
    for (agent, advice) in [
        ("a*b", "as in a*,"),
        ("arm_[12]", "as in arm_*,"),
        ("**", "as in *,"),
        (r"arm\.left", "as in arm*,"),
    ] {
        let agents = ["arm".to_owned(), agent.to_owned()];
        let refused = keys.init("crex-mts", &agents, VALID).unwrap_err();
        let KeysError::Certificate(error @ CertificateError::Agent(named)) = &refused else {
            panic!("{agent}: {refused:?}");
        };
        assert_eq!(named, agent);
        assert!(error.to_string().contains(advice), "{error}");
    }
    for name in ["crex ", " crex", "crex\u{3164}", "arm\u{fe0f}"] {
        let refused = keys.init(name, &[], VALID).unwrap_err();
        assert!(
            matches!(refused, KeysError::Certificate(CertificateError::Name(_))),
            "{name:?}"
        );
    }
    assert!(!keys.own_file().exists());
    keys.init("crex-mts", &["*".to_owned(), "arm_*".to_owned()], VALID)
        .unwrap();
}

#[test]
fn a_revoked_certificate_cannot_be_trusted_again() {
    let ((_a, crex), (_b, rover)) = (keys(), keys());
    let made = crex.init("crex-mts", &[], VALID).unwrap();
    rover.init("rover-mts", &[], VALID).unwrap();
    let before = rover.stamp();
    let pem = fs::read(crex.own_file()).unwrap();
    assert_eq!(rover.trust(&pem).unwrap(), std::slice::from_ref(&made));
    assert_eq!(rover.trust(&pem).unwrap().len(), 1, "twice is once");
    assert_ne!(rover.stamp(), before);
    assert_eq!(
        rover.credentials(geteuid().as_raw()).unwrap().trusted.len(),
        1
    );
    assert!(matches!(
        rover.revoke("unknown"),
        Err(KeysError::Which { found: 0, .. })
    ));
    let fingerprint = made.fingerprint().to_string();
    assert_eq!(rover.revoke(&fingerprint[..12]).unwrap().len(), 1);
    assert_eq!(rover.trusted().unwrap(), []);
    assert_eq!(rover.revoked().unwrap(), [made]);
    assert!(matches!(rover.trust(&pem), Err(KeysError::Revoked(_))));
}

#[test]
fn a_renewed_key_is_used_after_the_switch() {
    let (_dir, keys) = keys();
    assert!(matches!(keys.renew(VALID), Err(KeysError::Missing(_))));
    let first = keys.init("crex", &["crex".to_owned()], VALID).unwrap();
    assert!(matches!(keys.switch(), Err(KeysError::NoNext(_))));
    assert_eq!(keys.next().unwrap(), None);
    let next = keys.renew(VALID).unwrap();
    assert_eq!(keys.own().unwrap(), first);
    assert_eq!(keys.next().unwrap().as_ref(), Some(&next));
    assert_eq!(keys.switch().unwrap(), next);
    assert_eq!(next.certified(), first.certified());
    assert_ne!(next.fingerprint(), first.fingerprint());
    assert_eq!(keys.credentials(geteuid().as_raw()).unwrap().own, next);
}

/// Each call can be repeated after a cut, and what it has reported stays.
#[test]
fn no_cut_of_power_leaves_unusable_keys_or_forgets_a_reported_change() {
    let peer = {
        let (_dir, keys) = keys();
        keys.init("crex", &[], VALID).unwrap();
        fs::read(keys.own_file()).unwrap()
    };
    let at = |root: &Path| Keys::at(root.join("fipa/keys"));
    let own = |root: &Path| at(root).credentials(geteuid().as_raw()).unwrap().own;
    let init = |root: &Path| at(root).init("rover", &[], VALID).unwrap();
    let begun = |root: &Path| drop(init(root));
    let renewed = |root: &Path| drop((init(root), at(root).renew(VALID).unwrap()));
    let trusting = |root: &Path| drop((init(root), at(root).trust(&peer).unwrap()));
    let mut cuts = durable::cuts::of(
        |_| {},
        init,
        |root, made| match made {
            Some(made) => assert_eq!(own(root), *made),
            None if at(root).own_file().exists() => drop(own(root)),
            None => assert_eq!(init(root), own(root)),
        },
    );
    cuts += durable::cuts::of(
        begun,
        |root| (own(root), at(root).renew(VALID).unwrap()),
        |root, made| {
            let next = match at(root).next().unwrap() {
                Some(next) => next,
                None => at(root).renew(VALID).unwrap(),
            };
            if let Some((before, made)) = made {
                assert_eq!((&own(root), &next), (before, made));
            }
            assert_eq!(at(root).switch().unwrap(), next);
            assert_eq!(own(root), next);
        },
    );
    cuts += durable::cuts::of(
        renewed,
        |root| at(root).switch().unwrap(),
        |root, made| {
            let found = own(root);
            assert!(made.is_none_or(|made| *made == found));
            let switched = at(root).switch();
            assert!(matches!(switched, Ok(_) | Err(KeysError::NoNext(_))));
            assert!(switched.is_ok() || own(root) == found);
        },
    );
    cuts += durable::cuts::of(
        begun,
        |root| at(root).trust(&peer).unwrap(),
        |root, trusted| {
            let found = at(root).credentials(geteuid().as_raw()).unwrap().trusted;
            assert!(trusted.is_none_or(|trusted| *trusted == found));
            assert_eq!(at(root).trust(&peer).unwrap().len(), 1);
        },
    );
    cuts += durable::cuts::of(
        trusting,
        |root| at(root).revoke("crex").unwrap(),
        |root, revoked| {
            let credentials = at(root).credentials(geteuid().as_raw()).unwrap();
            assert_ne!(credentials.trusted.len(), credentials.revoked.len());
            assert!(revoked.is_none() || credentials.trusted.is_empty());
        },
    );
    cuts += durable::cuts::of(
        trusting,
        |root| at(root).distrust("crex").unwrap(),
        |root, ended| {
            let trusted = at(root).credentials(geteuid().as_raw()).unwrap().trusted;
            assert!(ended.is_none() || trusted.is_empty());
        },
    );
    assert!(cuts > 8_000, "{cuts}");
}

#[test]
fn a_validity_of_zero_or_beyond_the_year_9999_is_refused() {
    let (_dir, keys) = keys();
    let beyond = Duration::from_secs(8000 * 365 * 86_400);
    for valid in [Duration::ZERO, beyond, Duration::MAX] {
        let refused = keys.init("crex", &[], valid);
        assert!(matches!(refused, Err(KeysError::Validity(it)) if it == valid));
    }
    assert!(!keys.dir().exists(), "a refused call creates nothing");
    keys.init("crex", &[], beyond / 2).unwrap();
}

#[test]
fn an_unreadable_certificate_does_not_prevent_revoking_another() {
    let ((_a, crex), (_b, rover)) = (keys(), keys());
    crex.init("crex-mts", &[], VALID).unwrap();
    rover.trust(&fs::read(crex.own_file()).unwrap()).unwrap();
    fs::write(rover.dir().join("trusted/junk.pem"), b"junk").unwrap();
    let unread = rover.revoke("another-mts");
    assert!(matches!(unread, Err(KeysError::Contents { .. })));
    assert_eq!(rover.revoke("crex-mts").unwrap().len(), 1);
    assert_eq!(rover.confirmed().0, []);
}

#[test]
fn a_directory_that_other_users_can_write_is_refused() {
    use std::os::unix::fs::PermissionsExt as _;
    let ((_a, crex), (_b, rover)) = (keys(), keys());
    crex.init("crex", &[], VALID).unwrap();
    rover.init("rover", &[], VALID).unwrap();
    rover.trust(&fs::read(crex.own_file()).unwrap()).unwrap();
    for dir in [rover.dir().to_owned(), rover.dir().join("trusted")] {
        for (mode, fits) in [(0o777, false), (0o770, false), (0o755, true)] {
            fs::set_permissions(&dir, fs::Permissions::from_mode(mode)).unwrap();
            let used = rover.credentials(geteuid().as_raw());
            let refused = matches!(used, Err(KeysError::Writable(it)) if it == dir);
            assert_eq!(refused, !fits, "{mode:o}");
        }
    }
}

#[test]
fn a_key_that_other_users_can_read_is_refused() {
    use std::os::unix::fs::PermissionsExt as _;
    let (_dir, keys) = keys();
    keys.init("crex", &[], VALID).unwrap();
    let file = keys.dir().join("own.key");
    assert_eq!(fs::metadata(&file).unwrap().mode() & 0o777, 0o600);
    fs::set_permissions(&file, fs::Permissions::from_mode(0o640)).unwrap();
    assert!(matches!(
        keys.credentials(geteuid().as_raw()),
        Err(KeysError::Readable(_))
    ));
}

#[test]
fn text_that_is_not_a_certificate_is_refused() {
    let (_dir, keys) = keys();
    for wrong in [
        &b""[..],
        b"hello",
        b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
    ] {
        assert!(keys.trust(wrong).is_err());
    }
    assert!(matches!(keys.own(), Err(KeysError::Missing(_))));
    keys.init("crex", &[], VALID).unwrap();
    fs::write(keys.own_file(), b"hello").unwrap();
    assert!(matches!(keys.own(), Err(KeysError::Contents { .. })));
}

/// Makes the PEM text of a certificate with these alternative names.
fn named(uris: &[&str]) -> Vec<u8> {
    let mut params = CertificateParams::default();
    for uri in uris {
        let uri = (*uri).try_into().unwrap();
        params.subject_alt_names.push(SanType::URI(uri));
    }
    let key = KeyPair::generate().unwrap();
    params.self_signed(&key).unwrap().pem().into_bytes()
}

#[test]
fn a_name_with_control_characters_is_refused() {
    let (_dir, keys) = keys();
    let forged = "urn:fipa:mts:crex%0A%20%20fingerprint%20";
    for uris in [
        &[forged][..],
        &["urn:fipa:mts:crex", "urn:fipa:agent:arm%1B%5B2J"],
        &["urn:fipa:mts:crex%C2%9B31m"],
        &["urn:fipa:mts:crex", "urn:fipa:agent:arm%E2%80%AEtfel"],
        &["urn:fipa:mts:cr%E2%80%8Bex"],
        &["urn:fipa:mts:"],
        &[&format!("urn:fipa:mts:{}", "x".repeat(1025))],
    ] {
        let error = keys.trust(&named(uris)).unwrap_err();
        assert!(
            matches!(error, KeysError::Certificate(CertificateError::Name(_))),
            "{error:?}"
        );
        assert!(!error.to_string().contains('\n'), "{error}");
    }
    let trusted = keys.trust(&named(&[
        "urn:fipa:mts:crex%20mts",
        "urn:fipa:agent:arm_%2A",
    ]));
    assert_eq!(trusted.unwrap()[0].certified().agents(), ["arm_*"]);
}

#[test]
fn a_certificate_that_other_users_can_write_is_not_trusted() {
    use std::os::unix::fs::PermissionsExt as _;
    let ((_a, crex), (_b, rover)) = (keys(), keys());
    let made = crex.init("crex-mts", &[], VALID).unwrap();
    rover.init("rover-mts", &[], VALID).unwrap();
    rover.trust(&fs::read(crex.own_file()).unwrap()).unwrap();
    let file = rover.file("trusted", made.fingerprint());
    let chmod = |mode| fs::set_permissions(&file, fs::Permissions::from_mode(mode)).unwrap();
    for mode in [0o664, 0o646] {
        chmod(mode);
        assert!(matches!(rover.trusted(), Err(KeysError::Writable(path)) if path == file));
        assert!(rover.credentials(geteuid().as_raw()).is_err());
        let (confirmed, unconfirmed) = rover.confirmed();
        assert_eq!((confirmed.len(), unconfirmed.len()), (0, 1));
    }
    chmod(0o644);
    assert_eq!(rover.trusted().unwrap(), std::slice::from_ref(&made));
    if geteuid().is_root() {
        std::os::unix::fs::chown(&file, Some(65_534), None).unwrap();
        assert!(matches!(rover.trusted(), Err(KeysError::Writable(_))));
    }
}

/// An operator makes the keys of a service with `sudo`.
#[test]
#[allow(clippy::print_stderr, reason = "a skipped test says so")]
fn what_root_creates_in_a_directory_of_another_user_belongs_to_that_user() {
    use std::os::unix::fs::{PermissionsExt as _, chown};

    if !geteuid().is_root() {
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "this test needs root");
        eprintln!("SKIPPED, not a success: this test needs root");
        return;
    }
    const USER: u32 = 61_234;
    const GROUP: u32 = 61_235;
    let (_other, crex) = keys();
    let made = crex.init("crex", &[], VALID).unwrap();
    assert_eq!(fs::metadata(crex.own_key()).unwrap().uid(), 0);
    let pem = fs::read(crex.own_file()).unwrap();

    let state = tempfile::tempdir().unwrap();
    chown(state.path(), Some(USER), Some(GROUP)).unwrap();
    let rover = Keys::at(state.path().join("fipa/keys"));
    rover.init("rover", &[], VALID).unwrap();
    rover.trust(&pem).unwrap();
    assert_eq!(rover.trusted().unwrap(), std::slice::from_ref(&made));
    rover.renew(VALID).unwrap();
    rover.switch().unwrap();
    rover.revoke("crex").unwrap();
    let mut found = Vec::new();
    let mut directories = vec![state.path().join("fipa")];
    while let Some(directory) = directories.pop() {
        for entry in fs::read_dir(&directory).unwrap() {
            let path = entry.unwrap().path();
            let meta = fs::metadata(&path).unwrap();
            assert_eq!((meta.uid(), meta.gid()), (USER, GROUP), "{path:?}");
            let mode = meta.permissions().mode() & 0o7777;
            found.push((
                path.strip_prefix(rover.dir()).unwrap_or(&path).to_owned(),
                mode,
            ));
            if meta.is_dir() {
                directories.push(path);
            }
        }
    }
    let revoked = format!("revoked/{}.pem", made.fingerprint());
    let mut expected = vec![
        (PathBuf::new(), 0o700),
        ("own.key".into(), 0o600),
        ("own.pem".into(), 0o644),
        ("revoked".into(), 0o700),
        (revoked.into(), 0o644),
        ("trusted".into(), 0o700),
    ];
    found.sort();
    expected.sort();
    assert_eq!(found, expected);

    // A gateway of root does not use them, because that user can change them. Commands of root examine them.
    let refused = rover.credentials_of("rover").unwrap_err();
    assert!(matches!(refused, KeysError::Readable(_)), "{refused}");
    let examined = rover.examined_credentials_of("rover").unwrap();
    assert_eq!(examined.revoked, [made.fingerprint()]);
    let third = rover.dir().join("revoked/third.pem");
    fs::write(&third, &pem).unwrap();
    chown(&third, Some(USER + 1), None).unwrap();
    assert!(matches!(rover.revoked(), Err(KeysError::Writable(path)) if path == third));
}
