//! Checks the directory of the domain.

use fipa_acl::ErrorChain;

use super::{Area, Check, Verdict};
use crate::Config;
use crate::domain_dir::DomainDir;

const AREA: Area = Area("domain");

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    checks.push(directory(&DomainDir::of(&config.domain)));
}

fn directory(dir: &DomainDir) -> Check {
    const CHECK: &str = "directory of the domain";
    let path = dir.path();
    match dir.exists() {
        Ok(true) => AREA.fine(CHECK, format!("{} is private", path.display())),
        Ok(false) => {
            let found = format!(
                "{} does not exist yet; the first process creates it",
                path.display()
            );
            AREA.fine(CHECK, found)
        }
        Err(error) => AREA.problem(
            CHECK,
            Verdict::Bad,
            ErrorChain(&error).to_string(),
            "follow the remedy above; until then no process can join the domain",
        ),
    }
}
