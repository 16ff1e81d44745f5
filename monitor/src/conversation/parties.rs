//! The parties of a conversation.

use std::ops::{Deref, DerefMut};

use crate::conversation::party::{Details, Party};

/// The parties of a conversation. A single one needs no allocation, and is in the cache line after the other
/// fields: see [`Slot`](crate::conversation::table::Slot).
#[derive(Debug)]
pub(crate) enum Parties {
    /// No party, and a buffer for the next one.
    None(Option<Box<Details>>),
    One(Party),
    Many(Vec<Party>),
}

impl Parties {
    pub(crate) fn push(&mut self, mut party: Party) {
        match std::mem::take(self) {
            Self::None(buffer) => {
                party.details = party.details.or(buffer);
                *self = Self::One(party);
            }
            Self::One(first) => *self = Self::Many(vec![first, party]),
            Self::Many(mut all) => {
                all.push(party);
                *self = Self::Many(all);
            }
        }
    }

    // Most conversations have one party.
    #[cold]
    fn none_or_many(&self) -> &[Party] {
        match self {
            Self::Many(all) => all,
            _ => &[],
        }
    }

    #[cold]
    fn none_or_many_mut(&mut self) -> &mut [Party] {
        match self {
            Self::Many(all) => all,
            _ => &mut [],
        }
    }

    /// Removes the parties. A buffer of the first one is kept.
    pub(crate) fn clear(&mut self) {
        let mut buffer = match std::mem::take(self) {
            Self::None(buffer) => buffer,
            Self::One(party) => party.details,
            Self::Many(_) => None,
        };
        if let Some(buffer) = &mut buffer {
            **buffer = Details::default();
        }
        *self = Self::None(buffer);
    }

    /// Bytes that the parties have allocated.
    #[inline]
    pub(crate) fn allocated(&self) -> usize {
        match self {
            Self::One(party) => party.allocated(),
            Self::None(buffer) => buffer.as_ref().map_or(0, |_| size_of::<Details>()),
            Self::Many(all) => {
                let own = all.capacity() * size_of::<Party>();
                own + all.iter().map(Party::allocated).sum::<usize>()
            }
        }
    }

    /// Returns an upper bound of the bytes that so many more parties allocate. Each party may still allocate
    /// its details.
    pub(crate) fn growth(&self, added: usize) -> usize {
        let buffer = |len: usize| match len {
            0 | 1 => 0,
            many => many.next_power_of_two() * size_of::<Party>(),
        };
        let without_details = self.iter().filter(|party| party.details.is_none());
        let details = (without_details.count() + added) * size_of::<Details>();
        buffer(self.len() + added) - buffer(self.len()) + details
    }
}

impl Default for Parties {
    fn default() -> Self {
        Self::None(None)
    }
}

impl Deref for Parties {
    type Target = [Party];

    #[inline]
    fn deref(&self) -> &[Party] {
        match self {
            Self::One(party) => std::slice::from_ref(party),
            others => others.none_or_many(),
        }
    }
}

impl DerefMut for Parties {
    #[inline]
    fn deref_mut(&mut self) -> &mut [Party] {
        match self {
            Self::One(party) => std::slice::from_mut(party),
            others => others.none_or_many_mut(),
        }
    }
}
