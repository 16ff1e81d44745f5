//! Indexes of states and of protocols.

/// Index of a state in [`Machine::states`](crate::Machine::states), or one of the numbers above all of them for
/// the states that all protocols have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(transparent)]
pub(crate) struct StateId(u16);

impl StateId {
    pub(crate) const FIRST: Self = Self(0);

    /// Saturates. A file has far fewer states.
    #[inline]
    pub(crate) fn new(index: usize) -> Self {
        Self(u16::try_from(index).unwrap_or(u16::MAX))
    }

    /// The state common to all protocols with this number, counted from the highest index down.
    pub(crate) const fn common(number: u16) -> Self {
        Self(u16::MAX - number)
    }

    #[inline]
    pub(crate) fn index(self) -> usize {
        usize::from(self.0)
    }
}

/// Index of a protocol in its [`Library`](crate::Library).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(transparent)]
pub(crate) struct MachineIndex(u16);

impl MachineIndex {
    pub(crate) const FIRST: Self = Self(0);

    /// Saturates. A library has at most 256 protocols.
    #[inline]
    pub(crate) fn new(index: usize) -> Self {
        Self(u16::try_from(index).unwrap_or(u16::MAX))
    }

    #[inline]
    pub(crate) fn index(self) -> usize {
        usize::from(self.0)
    }
}
