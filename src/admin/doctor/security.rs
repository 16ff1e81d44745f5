//! Checks the keys that decide which peers on other hosts are accepted.

use std::time::SystemTime;

use super::{Area, Check, Severity};
use crate::Config;

const AREA: Area = Area("security");
const KEYS: &str = "keys";

pub(super) fn examine(now: SystemTime, config: &Config, checks: &mut Vec<Check>) {
    if !config.security.keys.is_empty() {
        keys(now, config, checks);
    } else if config.security.insecure {
        checks.push(AREA.problem(
            KEYS,
            Severity::Warning,
            "there are none, and security.insecure is true: the gateway accepts every host that can \
             reach it, and letters are not encrypted",
            "make keys (`fipa keys init`) and set security.keys, unless every host on this network is \
             trusted",
        ));
    } else {
        checks.push(AREA.fine(
            KEYS,
            "there are none: the gateway listens on loopback addresses only",
        ));
    }
}

#[cfg(not(feature = "secure"))]
fn keys(_now: SystemTime, _config: &Config, checks: &mut Vec<Check>) {
    checks.push(AREA.problem(
        KEYS,
        Severity::Bad,
        "security.keys is set, but this program was built without the feature `secure`",
        "build it with the feature, or remove security.keys",
    ));
}

#[cfg(feature = "secure")]
fn keys(now: SystemTime, config: &Config, checks: &mut Vec<Check>) {
    use fipa_acl::ErrorChain;

    use crate::admin::keys::{Certificate, Holding, Keys, KeysError, Whose};

    let keys = Keys::at(&config.security.keys);
    let credentials = match keys.examined_credentials_of(&config.mts.name) {
        Ok(credentials) => credentials,
        Err(error) => {
            let advice = match error {
                KeysError::Name { .. } => {
                    "set mts.name to the name in the certificate, or make new keys in an empty directory"
                }
                _ => "check the directory in security.keys; `fipa keys list` shows its contents",
            };
            checks.push(AREA.problem(KEYS, Severity::Bad, ErrorChain(&error).to_string(), advice));
            return;
        }
    };
    if credentials.trusted.is_empty() {
        let advice = "pair this host with the other ones: `fipa keys pair`";
        let found = "no other host is trusted, so every connection from another host is refused";
        checks.push(AREA.problem(KEYS, Severity::Warning, found, advice));
    }
    let mut ending = |name: &str, certificate: &Certificate, whose: Whose| {
        let holding = Holding::at(now, certificate);
        let (Some(problem), Some(advice)) = (holding.problem(), holding.advice(now, whose)) else {
            return;
        };
        let severity = match holding {
            Holding::EndsSoon => Severity::Warning,
            _ => Severity::Bad,
        };
        let found = format!("the certificate of {name} {problem}");
        checks.push(AREA.problem(KEYS, severity, found, advice));
    };
    ending("this host", &credentials.own, Whose::Own);
    for trusted in &credentials.trusted {
        ending(trusted.certified().mts(), trusted, Whose::Peer);
    }
    if checks.iter().all(|check| check.area != AREA.0) {
        let count = credentials.trusted.len();
        checks.push(AREA.fine(KEYS, format!("trusted other hosts: {count}")));
    }
}

#[cfg(all(test, feature = "secure"))]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::admin::keys::{Keys, VALID};

    fn severities(config: &Config) -> Vec<(Severity, String)> {
        severities_at(SystemTime::now(), config)
    }

    fn severities_at(now: SystemTime, config: &Config) -> Vec<(Severity, String)> {
        let mut checks = Vec::new();
        examine(now, config, &mut checks);
        let severities = checks
            .into_iter()
            .map(|check| (check.severity, check.found));
        severities.collect()
    }

    #[test]
    fn configurations_that_accept_no_host_or_every_host_are_reported() {
        let mut config = Config::for_host("sherpa");
        assert_eq!(severities(&config)[0].0, Severity::Fine);
        config.security.insecure = true;
        assert_eq!(severities(&config)[0].0, Severity::Warning);
        config.security.insecure = false;
        let dir = tempfile::tempdir().unwrap();
        config.security.keys = dir.path().display().to_string();
        assert_eq!(severities(&config)[0].0, Severity::Bad, "no keys there");
        let keys = Keys::at(dir.path());
        keys.init(&config.mts.name, &[], VALID).unwrap();
        let found = severities(&config);
        assert_eq!(found.len(), 1);
        assert!(found[0].1.contains("no other host is trusted"));
        let other = tempfile::tempdir().unwrap();
        let other = Keys::at(other.path());
        other.init("crex-mts", &[], VALID / 1000).unwrap();
        keys.trust(&std::fs::read(other.own_file()).unwrap())
            .unwrap();
        let found = severities(&config);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].0, Severity::Warning);
        assert!(
            found[0].1.contains("crex-mts expires within"),
            "{}",
            found[0].1
        );
        config.mts.name = "another".to_owned();
        assert!(
            severities(&config)
                .iter()
                .any(|found| found.0 == Severity::Bad)
        );
    }

    #[test]
    fn the_validity_of_certificates_is_reported_by_the_clock_of_this_host() {
        const DAY: Duration = Duration::from_secs(86_400);
        let mut config = Config::for_host("sherpa");
        let dir = tempfile::tempdir().unwrap();
        let keys = Keys::at(dir.path().join("own"));
        config.security.keys = keys.dir().display().to_string();
        keys.init(&config.mts.name, &[], VALID).unwrap();
        // The certificate of the other host ends 100 days from now.
        let other = Keys::at(dir.path().join("other"));
        other.init("crex-mts", &[], 100 * DAY).unwrap();
        keys.trust(&std::fs::read(other.own_file()).unwrap())
            .unwrap();
        let created_at = SystemTime::now();
        let at = |now| match severities_at(now, &config).as_slice() {
            [(severity, found)] => (*severity, found.clone()),
            found => panic!("{found:?}"),
        };
        assert_eq!(at(created_at + 69 * DAY).0, Severity::Fine);
        for days in [71, 99] {
            let (severity, found) = at(created_at + days * DAY);
            assert_eq!(severity, Severity::Warning, "after {days} days");
            assert!(found.contains("crex-mts expires within 30 days"), "{found}");
        }
        let (severity, found) = at(created_at + 101 * DAY);
        assert_eq!(severity, Severity::Bad);
        assert!(found.contains("crex-mts has expired"), "{found}");
        // Keys begin a day before they are made, because clocks differ.
        assert_eq!(at(created_at - DAY / 2).0, Severity::Fine);
        for wrong in [created_at - 2 * DAY, SystemTime::UNIX_EPOCH] {
            let found = severities_at(wrong, &config);
            assert_eq!(found.len(), 2, "{found:?}");
            for (severity, found) in found {
                assert_eq!(severity, Severity::Bad);
                let cause = "is not valid yet by the clock of this host";
                assert!(found.contains(cause), "{found}");
            }
            assert_clock_comes_first(wrong, &config);
        }
        // Both certificates.
        assert_eq!(severities_at(created_at + 2 * VALID, &config).len(), 2);
        assert_clock_comes_first(created_at + 2 * VALID, &config);
    }

    /// Asserts that the advice about each certificate shows this time, and names the clock before the keys.
    fn assert_clock_comes_first(now: SystemTime, config: &Config) {
        let mut checks = Vec::new();
        examine(now, config, &mut checks);
        let shown = fipa_acl::Time::from_system_time(now).ok();
        let shown = shown.and_then(fipa_acl::Time::to_rfc3339);
        let clock =
            shown.map(|it| format!("the clock of this host shows {it}: set it if it is wrong"));
        for check in checks {
            let advice = check.advice.unwrap_or_default();
            let (first, then) = advice.split_once("; if it is right, ").unwrap_or_default();
            assert_eq!(Some(first), clock.as_deref());
            assert!(then.contains("`fipa keys renew`"), "{then}");
        }
    }
}
