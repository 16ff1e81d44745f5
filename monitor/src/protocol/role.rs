//! Roles of a protocol, and sets of them.

use std::ops::{BitAnd, BitAndAssign, BitOr, BitOrAssign, Not};

/// Index of a role in [`Machine::roles`](crate::Machine::roles), below
/// [`MAX_ROLES`](crate::protocol::machine::MAX_ROLES).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(transparent)]
pub(crate) struct Role(u8);

impl Role {
    pub(crate) const fn new(index: u8) -> Self {
        Self(index)
    }

    pub(crate) const fn get(self) -> u8 {
        self.0
    }

    #[inline]
    pub(crate) fn index(self) -> usize {
        usize::from(self.0)
    }
}

/// A set of roles: a bit for each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
#[repr(transparent)]
pub(crate) struct RoleSet(u32);

impl RoleSet {
    pub(crate) const ALL: Self = Self(u32::MAX);
    pub(crate) const NONE: Self = Self(0);

    /// The first roles of a protocol, so many.
    pub(crate) fn first(count: usize) -> Self {
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        Self(
            u32::MAX
                .checked_shl(count)
                .map_or(u32::MAX, |others| !others),
        )
    }

    #[inline]
    pub(crate) fn of(role: Role) -> Self {
        Self(1_u32.checked_shl(u32::from(role.0)).unwrap_or(0))
    }

    #[inline]
    pub(crate) fn is_empty(self) -> bool {
        self.0 == 0
    }

    #[inline]
    pub(crate) fn contains(self, role: Role) -> bool {
        self.intersects(Self::of(role))
    }

    #[inline]
    pub(crate) fn intersects(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }

    /// The role of a set with one role.
    #[inline]
    pub(crate) fn only(self) -> Option<Role> {
        let role = u8::try_from(self.0.trailing_zeros()).ok()?;
        self.0.is_power_of_two().then_some(Role(role))
    }

    pub(crate) fn iter(self) -> impl Iterator<Item = Role> + Clone {
        (0_u8..32)
            .map(Role)
            .filter(move |role| self.contains(*role))
    }
}

impl FromIterator<Role> for RoleSet {
    #[inline]
    fn from_iter<T: IntoIterator<Item = Role>>(roles: T) -> Self {
        roles
            .into_iter()
            .fold(Self::NONE, |all, role| all | Self::of(role))
    }
}

impl BitOr for RoleSet {
    type Output = Self;

    #[inline]
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl BitAnd for RoleSet {
    type Output = Self;

    #[inline]
    fn bitand(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }
}

impl BitOrAssign for RoleSet {
    #[inline]
    fn bitor_assign(&mut self, other: Self) {
        self.0 |= other.0;
    }
}

impl BitAndAssign for RoleSet {
    #[inline]
    fn bitand_assign(&mut self, other: Self) {
        self.0 &= other.0;
    }
}

impl Not for RoleSet {
    type Output = Self;

    #[inline]
    fn not(self) -> Self {
        Self(!self.0)
    }
}

/// The roles of the sender and of the receivers of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MessageRoles {
    pub(crate) from: RoleSet,
    pub(crate) to: RoleSet,
}

impl MessageRoles {
    pub(crate) const NONE: Self = Self {
        from: RoleSet::NONE,
        to: RoleSet::NONE,
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_have_the_roles_of_which_they_are_made() {
        let all = RoleSet::first(32);
        assert_eq!((all, RoleSet::first(0)), (RoleSet::ALL, RoleSet::NONE));
        let some: RoleSet = [3, 31].map(Role::new).into_iter().collect();
        assert!(some.contains(Role::new(31)) && !some.contains(Role::new(0)));
        assert_eq!(some.iter().map(Role::get).collect::<Vec<_>>(), [3, 31]);
        assert_eq!((some.only(), RoleSet::NONE.only()), (None, None));
        assert_eq!(RoleSet::of(Role::new(31)).only(), Some(Role::new(31)));
    }
}
