//! Names that are reserved for the agents of a gateway.

use std::sync::Arc;

use fipa_transport::Incarnation;

/// Number of digits of a [second name](second_name).
const DIGITS: usize = 8;

/// Returns the gateway for which a name is reserved: `X` for `ams@X` and `df@X`, and for the
/// [second names](second_name) of these agents. Any other name is free for every agent.
#[must_use]
pub fn reserved_for(name: &str) -> Option<&str> {
    let (agent, gateway) = name.split_once('@')?;
    let rest = ["ams", "df"].iter().find_map(|it| agent.strip_prefix(it))?;
    (rest.is_empty() || rest.strip_prefix('-').is_some_and(is_digits)).then_some(gateway)
}

/// Returns the second name of an agent of this gateway: `df-1f02c3d4@crex` for `df@crex`, and
/// `pages-1f02c3d4` for `pages`. Other hosts reach the agent by it when they know another agent by the
/// first name. It belongs to the same gateway as the first name.
#[must_use]
pub fn second_name(name: &str, gateway: Incarnation) -> Arc<str> {
    let digits = gateway.as_u64() & 0xffff_ffff;
    match name.split_once('@') {
        Some((agent, at)) => format!("{agent}-{digits:0DIGITS$x}@{at}").into(),
        None => format!("{name}-{digits:0DIGITS$x}").into(),
    }
}

fn is_digits(text: &str) -> bool {
    let is_digit = |byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
    text.len() == DIGITS && text.bytes().all(is_digit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_names_of_platform_agents_are_reserved_for_their_gateway() {
        for (name, gateway) in [
            ("df@crex", Some("crex")),
            ("ams@crex", Some("crex")),
            ("df@a@b", Some("a@b")),
            ("ams-1f02c3d4@crex", Some("crex")),
            ("df", None),
            ("dfa@crex", None),
            ("df-@crex", None),
            ("df-1f02c3d@crex", None),
            ("df-1F02C3D4@crex", None),
            ("df-1f02c3d4a@crex", None),
            ("rover@crex", None),
            ("x-df@crex", None),
        ] {
            assert_eq!(reserved_for(name), gateway, "{name}");
        }
    }

    #[test]
    fn a_second_name_belongs_to_the_gateway_of_the_first() {
        let gateway = Incarnation::from_u64(0xabcd_0123_0000_00ff);
        for (first, second) in [
            ("df@crex", "df-000000ff@crex"),
            ("ams@a@b", "ams-000000ff@a@b"),
            ("pages", "pages-000000ff"),
        ] {
            assert_eq!(*second_name(first, gateway), *second);
            assert_eq!(reserved_for(second), reserved_for(first), "{second}");
        }
    }
}
