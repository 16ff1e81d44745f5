//! Fences, and their check by a device.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use crate::{NameError, Peer};

/// A fence: the number of a grant. The fences of an owner strictly rise, also over its restarts with
/// the same state file. A fence says nothing to another owner.
///
/// The text is `<epoch>.<number>@<owner>`, for example `7.42@crane`. The order of fences is that of
/// their grants only if they have the same owner.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Fence {
    owner: Arc<str>,
    epoch: u64,
    number: u64,
}

impl Fence {
    pub(crate) fn new(owner: &Peer, epoch: u64, number: u64) -> Self {
        Self {
            owner: owner.shared_name().clone(),
            epoch,
            number,
        }
    }

    /// Name of the owner that granted the fence.
    #[must_use]
    pub fn owner(&self) -> &str {
        &self.owner
    }

    /// Number of the owner's life.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Number of the grant in the owner's life.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Position among the fences of its owner.
    #[must_use]
    pub fn position(&self) -> (u64, u64) {
        (self.epoch, self.number)
    }
}

impl fmt::Display for Fence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}@{}", self.epoch, self.number, self.owner)
    }
}

impl fmt::Debug for Fence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Error of reading a fence.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FenceError {
    /// The text does not have the form of a fence.
    #[error("a fence has the form <epoch>.<number>@<owner>, for example 7.42@crane")]
    Form,
    /// The owner's name is not valid.
    #[error("the owner of a fence: {0}")]
    Owner(#[from] NameError),
}

impl FromStr for Fence {
    type Err = FenceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (position, owner) = text.split_once('@').ok_or(FenceError::Form)?;
        let (epoch, number) = position.split_once('.').ok_or(FenceError::Form)?;
        let digits = |text: &str| match text.bytes().all(|byte| byte.is_ascii_digit()) {
            true => text.parse().map_err(|_| FenceError::Form),
            false => Err(FenceError::Form),
        };
        let owner = Peer::new(owner, 0)?;
        Ok(Self::new(&owner, digits(epoch)?, digits(number)?))
    }
}

/// Check of fences by a device that is not the owner: it admits a fence of its owner that is at least
/// the highest that it has admitted.
///
/// The owner itself uses [`Locks::admit`](crate::Locks::admit), which also refuses a fence as soon as
/// its grant ends.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Admission {
    owner: String,
    highest: (u64, u64),
}

impl Admission {
    /// Creates a check that admits each fence of `owner`. A device that restarts passes the fence
    /// that [`highest`](Self::highest) returned to [`admit`](Self::admit) first.
    #[must_use]
    pub fn new(owner: &str) -> Self {
        Self {
            owner: owner.to_owned(),
            highest: (0, 0),
        }
    }

    /// Epoch and number of the highest fence that was admitted.
    #[must_use]
    pub fn highest(&self) -> (u64, u64) {
        self.highest
    }

    /// Whether the fence is admitted.
    pub fn admit(&mut self, fence: &Fence) -> bool {
        let admitted = fence.owner() == self.owner && fence.position() >= self.highest;
        if admitted {
            self.highest = fence.position();
        }
        admitted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fences_are_text() {
        let owner = Peer::new("crane@bay", 1).unwrap();
        let fence = Fence::new(&owner, 7, 42);
        assert_eq!(fence.to_string(), "7.42@crane@bay");
        assert_eq!("7.42@crane@bay".parse(), Ok(fence));
        for wrong in [
            "",
            "7.42",
            "7@crane",
            "+7.1@crane",
            "7.1@",
            "a.1@b",
            "1.99999999999999999999@a",
        ] {
            assert!(wrong.parse::<Fence>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_device_admits_no_lower_and_no_foreign_fence() {
        let fence = |text: &str| text.parse::<Fence>().unwrap();
        let mut admission = Admission::new("crane");
        assert!(admission.admit(&fence("1.5@crane")));
        assert!(admission.admit(&fence("1.5@crane")));
        assert!(!admission.admit(&fence("1.4@crane")));
        assert!(!admission.admit(&fence("9.9@arm")));
        assert!(admission.admit(&fence("2.1@crane")));
        assert!(!admission.admit(&fence("1.6@crane")));
        assert_eq!(admission.highest(), (2, 1));
    }
}
