//! The order in which members ask for the lock of the leader.

use std::sync::Arc;
use std::time::Duration;

/// Time that a member gives each registered member before it in the order to ask for the lock of the leader.
pub const TURN: Duration = Duration::from_secs(1);

/// Returns the time after the beginning of a vacancy at which `own` asks for the lock, if it is a member. The first one
/// is the member that follows the last leader in the list, and the last leader is the last one. Members that are not
/// registered are left out.
pub(super) fn turn_of(
    own: &str,
    members: &[Arc<str>],
    last_leader: Option<&str>,
    is_registered: impl Fn(&str) -> bool,
) -> Option<Duration> {
    let position = |name: &str| members.iter().position(|member| **member == *name);
    let first = last_leader.and_then(position).map_or(0, |last| last + 1);
    let order = members.iter().cycle().skip(first).take(members.len());
    let mut turn = Duration::ZERO;
    for member in order {
        if **member == *own {
            // The others may not know that it led, and then count from the first member.
            let led = last_leader == Some(own);
            return Some(if led { turn + TURN } else { turn });
        }
        if is_registered(member) {
            turn += TURN;
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_ask_in_the_order_of_the_list_after_the_last_leader() {
        let members: Vec<Arc<str>> = ["a", "b", "c", "d"].map(Into::into).into();
        let turns = |last: Option<&str>| {
            ["a", "b", "c", "d"].map(|own| {
                let turn = turn_of(own, &members, last, |name| name != "c");
                turn.unwrap().as_secs()
            })
        };
        assert_eq!(turns(None), [0, 1, 2, 2]);
        assert_eq!(turns(Some("a")), [3, 0, 1, 1]);
        assert_eq!(turns(Some("c")), [1, 2, 4, 0]);
        assert_eq!(turns(Some("d")), [0, 1, 2, 3]);
        assert_eq!(turns(Some("left")), [0, 1, 2, 2]);
        assert_eq!(turn_of("e", &members, None, |_| true), None);
        assert_eq!(turn_of("e", &[], Some("a"), |_| true), None);
    }
}
