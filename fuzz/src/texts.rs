//! Untrusted texts: certificates and their names, locations, agent names, and patterns.
//!
//! * An accepted text is the same after it is written and read again.
//! * No accepted name contains unprintable characters.
//! * A name matches itself as the pattern of a legacy peer.

use fipa_acl::{is_unprintable, misleading_character};
use fipa_sds::{Matcher, Pattern, check_name, is_legacy_pattern, is_pattern};
use fipa_transport::Location;
use fipa_transport_net::fuzzing::certified;
use fipa_transport_net::secure::{Certificate, Certified, alternative_names};

/// Reads the bytes as the kind of text that the first byte selects.
pub fn play(bytes: &[u8]) {
    let Some((kind, rest)) = bytes.split_first() else {
        return;
    };
    if kind % 8 == 0 {
        if let Ok(certificate) = Certificate::from_der(rest.to_vec()) {
            names(certificate.certified());
            let _ = certificate.validity();
        }
        return;
    }
    let Ok(text) = std::str::from_utf8(rest) else {
        return;
    };
    match kind % 8 {
        1 | 2 => {
            let uris: Vec<&str> = text.split('\n').collect();
            match certified(&uris) {
                Ok(certified) => names(&certified),
                Err(error) => assert!(!error.to_string().contains(is_unprintable)),
            }
        }
        3 => location(text),
        4 => {
            let named = check_name(text);
            assert!(named.is_err() || misleading_character(text).is_none());
            let _ = (is_pattern(text), is_legacy_pattern(text));
            if let Err(error) = named {
                assert!(!error.to_string().contains(is_unprintable), "{error}");
            }
        }
        _ => {
            let (pattern, subject) = text.split_once('\n').unwrap_or((text, "arm_left"));
            match Pattern::new(pattern) {
                Ok(read) => {
                    assert_eq!(read.to_string(), pattern);
                    let _ = read.matches(subject);
                }
                Err(error) => drop(error.to_string()),
            }
            if let Ok(matcher) = Matcher::parse(pattern) {
                let matches = matcher.matches(pattern);
                assert!(matches || is_pattern(pattern), "a name matches itself");
                let _ = matcher.matches(subject);
            }
        }
    }
}

fn names(certified: &Certified) {
    let agents = certified.agents();
    for name in agents.iter().map(String::as_str).chain([certified.mts()]) {
        assert!(
            !name.is_empty() && misleading_character(name).is_none(),
            "{name:?}"
        );
    }
    let uris = alternative_names(certified.mts(), agents);
    let uris: Vec<&str> = uris.iter().map(String::as_str).collect();
    let again = super::texts::certified(&uris).expect("accepted names can be written");
    assert_eq!(&again, certified);
    assert!(certified.speaks_for(certified.mts()));
}

fn location(text: &str) {
    match text.parse::<Location>() {
        Ok(location) => {
            let shown = location.to_string();
            assert!(!shown.contains(char::is_control), "{shown:?}");
            assert_eq!(shown.parse().as_ref(), Ok(&location));
        }
        Err(error) => drop(error.to_string()),
    }
}
