//! The roles of the agents of a conversation.

use std::ops::{Deref, Range};

use smallvec::SmallVec;

use crate::conversation::ids::Name;
use crate::protocol::role::Role;

/// A role and the agent that has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RoleBinding {
    pub(crate) role: Role,
    pub(crate) agent: Name,
}

/// The roles of agents. Most conversations have one state for each participant, and no roles.
#[derive(Debug, Default)]
pub(crate) struct Bound {
    bindings: Option<Box<SmallVec<[RoleBinding; 2]>>>,
}

impl Bound {
    pub(crate) fn push(&mut self, binding: RoleBinding) {
        self.bindings.get_or_insert_default().push(binding);
    }

    /// Removes these bindings and returns them.
    pub(crate) fn remove(&mut self, range: Range<usize>) -> SmallVec<[RoleBinding; 2]> {
        let bindings = self.bindings.as_deref_mut();
        let removed = bindings.map(|bindings| bindings.drain(range).collect());
        removed.unwrap_or_default()
    }

    /// Returns an upper bound of the bytes that so many more bindings allocate.
    pub(crate) fn growth(&self, added: usize) -> usize {
        match added {
            0 => 0,
            _ => {
                let buffer = (self.len() + added).next_power_of_two();
                buffer * size_of::<RoleBinding>() + size_of::<SmallVec<[RoleBinding; 2]>>()
            }
        }
    }

    /// Bytes that the bindings have allocated.
    #[inline]
    pub(crate) fn allocated(&self) -> usize {
        self.bindings.as_deref().map_or(0, |bindings| {
            let spilled = match bindings.spilled() {
                true => bindings.capacity() * size_of::<RoleBinding>(),
                false => 0,
            };
            size_of::<SmallVec<[RoleBinding; 2]>>() + spilled
        })
    }
}

impl Deref for Bound {
    type Target = [RoleBinding];

    fn deref(&self) -> &[RoleBinding] {
        self.bindings.as_deref().map_or(&[], |bindings| bindings)
    }
}
