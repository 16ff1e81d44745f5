//! Indexes into the tables of a monitor. An absent one takes no memory of its own.

use std::num::NonZeroU32;

/// A number below [`u32::MAX`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(transparent)]
pub(crate) struct NonMaxU32(NonZeroU32);

impl NonMaxU32 {
    const MAX: Self = Self(NonZeroU32::MAX);

    #[inline]
    pub(crate) const fn new(number: u32) -> Option<Self> {
        match NonZeroU32::new(number.wrapping_add(1)) {
            Some(next) => Some(Self(next)),
            None => None,
        }
    }

    #[inline]
    pub(crate) const fn get(self) -> u32 {
        self.0.get().wrapping_sub(1)
    }
}

/// Defines a newtype of an index.
macro_rules! index {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[repr(transparent)]
        pub(crate) struct $name(NonMaxU32);

        impl $name {
            /// Saturates. The limits of a monitor keep its tables much smaller.
            #[inline]
            pub(crate) fn new(index: usize) -> Self {
                let index = u32::try_from(index).ok().and_then(NonMaxU32::new);
                Self(index.unwrap_or(NonMaxU32::MAX))
            }

            #[inline]
            pub(crate) fn get(self) -> usize {
                self.0.get() as usize
            }
        }
    };
}

index! {
    /// Index of a conversation in [`Table`](crate::conversation::table::Table).
    SlotIndex
}

index! {
    /// Index of a party in its conversation.
    PartyIndex
}

index! {
    /// Index of a name in [`Names`](crate::conversation::names::Names).
    Name
}

impl Name {
    /// Index of a name, and one that is in no table without a name. It needs no branch, because this is how both are
    /// stored.
    #[inline]
    pub(crate) fn index_of(name: Option<Self>) -> usize {
        name.map_or(u32::MAX, |name| name.0.get()) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_absent_index_takes_no_memory() {
        assert_eq!(size_of::<Option<SlotIndex>>(), 4);
        assert_eq!(size_of::<Option<Name>>(), 4);
        assert_eq!(size_of::<Option<PartyIndex>>(), 4);
    }

    #[test]
    fn numbers_below_the_maximum_are_kept_in_their_order() {
        let number = |number| NonMaxU32::new(number).unwrap();
        for known in [0, 1, 7, u32::MAX - 1] {
            assert_eq!(number(known).get(), known);
        }
        assert_eq!(NonMaxU32::new(u32::MAX), None);
        assert!(number(0) < number(1) && number(1) < number(u32::MAX - 1));
    }
}
