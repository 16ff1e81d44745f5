//! Where the processes of the domain meet.

use super::{Area, Check, Verdict};
use crate::Config;
use crate::place::Place;

const AREA: Area = Area("domain");

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    checks.push(directory(&Place::of(&config.domain)));
}

fn directory(place: &Place) -> Check {
    const CHECK: &str = "directory of the domain";
    let path = place.path();
    match place.look() {
        Ok(true) => AREA.fine(CHECK, format!("{} is private", path.display())),
        Ok(false) => {
            let found = format!("{} is made when the first process starts", path.display());
            AREA.fine(CHECK, found)
        }
        Err(error) => AREA.wrong(
            CHECK,
            Verdict::Bad,
            error.to_string(),
            "no process can join the domain until that is so",
        ),
    }
}
