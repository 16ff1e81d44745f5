//! Looks for domains of other users on this machine. A domain belongs to one user or to a group, so their agents are
//! invisible to this user, which surprises when both domains have the same name.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, Metadata};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use rustix::process::geteuid;

use super::{Area, Check, Severity};
use crate::Config;
use crate::domain::accounts::user_name;
use crate::domain::user_dir::user_in;

const AREA: Area = Area("domain");
const CHECK: &str = "domains of other users";

/// Maximum number of entries of a directory that are read.
const MAX_ENTRIES: usize = 100_000;

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    let others = others(Path::new("/dev/shm"), Path::new("/tmp"), geteuid().as_raw());
    checks.push(report(&others, &config.domain));
}

/// The names of the domains of other users, as far as they are visible, by user.
type Others = BTreeMap<u32, BTreeSet<String>>;

/// Finds domains by the names and owners of their files: shared memory, and the directories in which the
/// domains of a user are, whose contents are private.
fn others(shared_memory: &Path, temporary: &Path, user: u32) -> Others {
    let mut found = Others::new();
    each(shared_memory, |name, metadata| {
        if metadata.uid() != user
            && let Some(domain) = domain_of(name)
        {
            let domains = found.entry(metadata.uid()).or_default();
            domains.insert(domain.to_owned());
        }
    });
    each(temporary, |name, metadata| {
        let owner = user_in(name);
        if metadata.is_dir() && owner == Some(metadata.uid()) && owner != Some(user) {
            found.entry(metadata.uid()).or_default();
        }
    });
    found
}

fn each(directory: &Path, mut examine: impl FnMut(&str, &Metadata)) {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    for entry in entries.take(MAX_ENTRIES) {
        let name = entry.file_name();
        if let Some(name) = name.to_str().filter(|name| name.starts_with("fipa"))
            && let Ok(metadata) = entry.metadata()
        {
            examine(name, &metadata);
        }
    }
}

/// Returns the domain in the name of a file in shared memory, `fipa_<domain>_<8 hexadecimal digits>_…`.
fn domain_of(file: &str) -> Option<&str> {
    let rest = file.strip_prefix("fipa_")?;
    let is_end = |at: usize| {
        let tail = rest.get(at + 1..at + 10);
        tail.is_some_and(|tail| {
            let (digits, last) = tail.split_at(8);
            last == "_" && digits.bytes().all(|byte| byte.is_ascii_hexdigit())
        })
    };
    let end = rest
        .match_indices('_')
        .map(|(at, _)| at)
        .find(|at| is_end(*at))?;
    rest.get(..end).filter(|domain| !domain.is_empty())
}

fn report(others: &Others, domain: &str) -> Check {
    if others.is_empty() {
        return AREA.fine(CHECK, "no other user runs a domain here");
    }
    let described = others.iter().map(|(user, domains)| {
        let user = user_name(*user);
        let domains: Vec<_> = domains.iter().map(|domain| format!("`{domain}`")).collect();
        match domains.as_slice() {
            [] => format!("{user} runs a domain here"),
            [domain] => format!("{user} runs a domain {domain} here"),
            several => format!("{user} runs the domains {} here", several.join(", ")),
        }
    });
    let found = described.collect::<Vec<_>>().join("; ");
    if !others.values().any(|domains| domains.contains(domain)) {
        return AREA.fine(CHECK, found);
    }
    AREA.problem(
        CHECK,
        Severity::Warning,
        format!("{found}; a domain belongs to one user, so this user does not see those agents"),
        "run the commands as the user of the domain (for example: sudo -u USER fipa agents), unless \
         separate domains are intended",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_domain_is_read_from_the_name_of_a_file() {
        for (file, domain) in [
            ("fipa_default_0123abcd_x.service", Some("default")),
            ("fipa_a_b_0123abcd_x", Some("a_b")),
            ("fipa__0123abcd_x", None),
            ("fipa_default_0123abc", None),
            ("fipa_default", None),
            ("other_default_0123abcd_x", None),
            ("fipa_d\u{e9}_0123abcd_", Some("d\u{e9}")),
        ] {
            assert_eq!(domain_of(file), domain, "{file}");
        }
    }

    #[test]
    fn a_domain_of_the_same_name_is_reported_with_its_user() {
        let directory = tempfile::tempdir().unwrap();
        let (shm, tmp) = (directory.path().join("shm"), directory.path().join("tmp"));
        for path in [&shm, &tmp] {
            fs::create_dir(path).unwrap();
        }
        fs::write(shm.join("fipa_default_0123abcd_x"), "").unwrap();
        let owner = geteuid().as_raw();
        fs::create_dir(tmp.join(format!("fipa-{owner}"))).unwrap();
        fs::create_dir(tmp.join("fipa-demo-17")).unwrap();
        assert_eq!(others(&shm, &tmp, owner), Others::new());
        // To any other user, this user is another one.
        let found = others(&shm, &tmp, owner.wrapping_add(1));
        assert_eq!(found.len(), 1);
        let same = report(&found, "default");
        assert_eq!(same.severity, Severity::Warning);
        let expected = format!("{} runs a domain `default` here", user_name(owner));
        assert!(same.found.starts_with(&expected), "{}", same.found);
        assert_eq!(report(&found, "another").severity, Severity::Fine);
        fs::remove_file(shm.join("fipa_default_0123abcd_x")).unwrap();
        let unnamed = report(&others(&shm, &tmp, owner.wrapping_add(1)), "default");
        assert!(
            unnamed.found.ends_with("runs a domain here"),
            "{}",
            unnamed.found
        );
    }
}
