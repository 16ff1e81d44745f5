//! The users and groups of this host, as `/etc/passwd` and `/etc/group` list them.
//!
//! Users of a directory service (LDAP, SSSD) are not in these files: they have no name here, and their groups are
//! configured by their numbers.

use std::fs;

use fipa_acl::escape;

/// Returns the name of a user with its number. Users that are not in `/etc/passwd` have no name.
pub(crate) fn user_name(number: u32) -> String {
    named("user", &users(), number)
}

/// Returns the name of a group with its number. Groups that are not in `/etc/group` have no name.
pub(crate) fn group_name(number: u32) -> String {
    named("group", &groups(), number)
}

fn named(kind: &str, lines: &str, number: u32) -> String {
    match name_in(lines, number) {
        Some(name) => format!("{kind} {} ({number})", escape(name)),
        None => format!("{kind} {number}"),
    }
}

/// Returns the number of a user, who is given by name or number.
pub(crate) fn user_number(user: &str) -> Option<u32> {
    user.parse().ok().or_else(|| number_in(&users(), user))
}

/// Returns the number of a group, which is given by its name or its number.
pub(crate) fn group_number(group: &str) -> Option<u32> {
    group.parse().ok().or_else(|| number_in(&groups(), group))
}

/// Whether a user is a member of a group.
pub(crate) fn is_member(user: u32, group: u32) -> bool {
    is_member_in(&users(), &groups(), user, group)
}

fn users() -> String {
    fs::read_to_string("/etc/passwd").unwrap_or_default()
}

fn groups() -> String {
    fs::read_to_string("/etc/group").unwrap_or_default()
}

/// The name, the number and the fourth field of each line: the primary group of a user, or the members of a group.
fn lines(text: &str) -> impl Iterator<Item = (&str, u32, &str)> {
    text.lines().filter_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next().filter(|name| !name.is_empty())?;
        let number = fields.nth(1)?.parse().ok()?;
        Some((name, number, fields.next().unwrap_or_default()))
    })
}

fn name_in(text: &str, number: u32) -> Option<&str> {
    let found = lines(text).find(|(_, found, _)| *found == number)?;
    Some(found.0)
}

fn number_in(text: &str, name: &str) -> Option<u32> {
    let found = lines(text).find(|(found, _, _)| *found == name)?;
    Some(found.1)
}

fn is_member_in(users: &str, groups: &str, user: u32, group: u32) -> bool {
    let Some((name, _, primary)) = lines(users).find(|(_, number, _)| *number == user) else {
        return false;
    };
    primary.parse() == Ok(group)
        || lines(groups).any(|(_, number, members)| {
            number == group && members.split(',').any(|member| member == name)
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    const USERS: &str = "root:x:0:0:root:/root:/bin/sh\nrobot:x:1001:1002::/home/robot:/bin/sh\n\
                         eye:x:1003:1003::/:/bin/sh\n";
    const GROUPS: &str = "root:x:0:\nrobot:x:1002:\ncrew:x:1004:pi,eye\nempty:x:1005\n";

    #[test]
    fn names_are_read_from_their_lines() {
        assert_eq!(name_in(USERS, 1001), Some("robot"));
        assert_eq!(name_in(USERS, 1), None);
        assert_eq!(name_in("broken\n:x:5\nx:y:z\n", 5), None);
        assert_eq!(number_in(GROUPS, "crew"), Some(1004));
        assert_eq!(number_in(GROUPS, "cre"), None);
        assert_eq!(group_number("1004"), Some(1004));
    }

    #[test]
    fn members_have_the_group_as_their_first_one_or_are_in_its_line() {
        let is_member = |user, group| is_member_in(USERS, GROUPS, user, group);
        assert!(is_member(1001, 1002) && is_member(1003, 1004));
        assert!(!is_member(1001, 1004) && !is_member(1003, 1002) && !is_member(1003, 1005));
        // Not in the file of users.
        assert!(!is_member(7, 1002));
    }
}
