//! Checks the directory of the domain.

use std::path::Path;

use fipa_acl::ErrorChain;
use fipa_transport::DomainUsers;

use super::{Area, Check, Severity};
use crate::Config;
use crate::domain::accounts::group_name;
use crate::domain::files::{DomainDir, DomainDirError};
use crate::domain::user_dir::Holder;

const AREA: Area = Area("domain");

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    let dir = DomainDir::of(config);
    checks.push(directory(&dir));
    checks.push(writing(&dir));
}

const WRITING: &str = "room in the directory of the domain";

/// Writes a file in the directory.
fn writing(dir: &DomainDir) -> Check {
    match dir.check_writable() {
        Ok(()) => AREA.fine(WRITING, "a file can be written there"),
        Err(DomainDirError::NotWritable {
            path,
            problem,
            remedy,
            source,
        }) => AREA.problem(
            WRITING,
            Severity::Bad,
            format!("{}: {problem} ({source})", path.display()),
            remedy,
        ),
        Err(error) => AREA.problem(
            WRITING,
            Severity::Bad,
            ErrorChain(&error).to_string(),
            "follow the remedy above; until then no process can join the domain",
        ),
    }
}

const CHECK: &str = "directory of the domain";

fn directory(dir: &DomainDir) -> Check {
    let path = dir.path();
    match dir.exists() {
        Ok(true) => match dir.name_held_by() {
            None => AREA.fine(CHECK, private(dir)),
            Some(holder) => name_held(&path, holder),
        },
        Ok(false) => {
            let found = format!(
                "{} does not exist yet; the first process creates it",
                path.display()
            );
            AREA.fine(CHECK, found)
        }
        Err(error) => AREA.problem(
            CHECK,
            Severity::Bad,
            ErrorChain(&error).to_string(),
            "follow the remedy above; until then no process can join the domain",
        ),
    }
}

/// Describes a directory that no other user can enter.
fn private(dir: &DomainDir) -> String {
    let path = dir.path();
    match dir.users() {
        Ok(DomainUsers::Group(group)) => {
            format!(
                "{} is shared by the members of {}",
                path.display(),
                group_name(group)
            )
        }
        _ => format!("{} is private", path.display()),
    }
}

/// Reports what holds the name of the directory in `/tmp`.
fn name_held(path: &Path, holder: Holder) -> Check {
    let own = rustix::process::geteuid().as_raw();
    AREA.problem(
        CHECK,
        Severity::Warning,
        format!(
            "{} is private; the domains of this user are not in /tmp/fipa-{own}, because {holder} holds that name",
            path.display(),
        ),
        format!(
            "reserve the name at boot: write the line `d /tmp/fipa-{own} 0700 {own}` into a file in \
             /etc/tmpfiles.d, and restart the host"
        ),
    )
}
