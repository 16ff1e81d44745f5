//! Fences, and their check by a device.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use crate::{NameError, Peer, Resource};

/// A fence: the number of a grant. The fences of a resource strictly rise, also over the restarts of its
/// owner with the same state file. A fence says nothing to another owner, and nothing about another
/// resource.
///
/// The text is `<epoch>.<number>@<owner>#<resource>`, for example `7.42@crane#bay`. In the name of the
/// owner, `%` is `%25`, and `#` is `%23`. The order of fences is that of their grants only if they have the
/// same owner and resource.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Fence {
    owner: Arc<str>,
    resource: Resource,
    epoch: u64,
    number: u64,
}

impl Fence {
    pub(crate) fn new(owner: &Peer, resource: &Resource, epoch: u64, number: u64) -> Self {
        Self {
            owner: owner.shared_name().clone(),
            resource: resource.clone(),
            epoch,
            number,
        }
    }

    /// Name of the owner that granted the fence.
    #[must_use]
    pub fn owner(&self) -> &str {
        &self.owner
    }

    /// Name of the resource.
    #[must_use]
    pub fn resource(&self) -> &str {
        self.resource.as_str()
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

    /// Position among the fences of its owner and resource.
    #[must_use]
    pub fn position(&self) -> (u64, u64) {
        (self.epoch, self.number)
    }
}

impl fmt::Display for Fence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let owner = self.owner.replace('%', "%25").replace('#', "%23");
        write!(
            f,
            "{}.{}@{owner}#{}",
            self.epoch, self.number, self.resource
        )
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
    #[error("a fence has the form <epoch>.<number>@<owner>#<resource>, for example 7.42@crane#bay")]
    Form,
    /// The name of the owner or of the resource is not valid.
    #[error("the owner or the resource of a fence: {0}")]
    Name(#[from] NameError),
}

impl FromStr for Fence {
    type Err = FenceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (position, names) = text.split_once('@').ok_or(FenceError::Form)?;
        let (owner, resource) = names.split_once('#').ok_or(FenceError::Form)?;
        let (epoch, number) = position.split_once('.').ok_or(FenceError::Form)?;
        let digits = |text: &str| match text.bytes().all(|byte| byte.is_ascii_digit()) {
            true => text.parse().map_err(|_| FenceError::Form),
            false => Err(FenceError::Form),
        };
        let owner = Peer::new(&owner.replace("%23", "#").replace("%25", "%"), 0)?;
        let resource = Resource::new(resource)?;
        let fence = Self::new(&owner, &resource, digits(epoch)?, digits(number)?);
        Ok(fence)
    }
}

/// Check of fences by a device that is not the owner: it admits a fence of its owner and resource that is
/// at least the highest that it has admitted.
///
/// The owner itself uses [`Locks::admit`](crate::Locks::admit), which also refuses a fence as soon as
/// its grant ends.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Admission {
    owner: String,
    resource: Resource,
    highest: (u64, u64),
}

impl Admission {
    /// Creates a check that admits each fence of `owner` for `resource`. A device that restarts passes the fence
    /// that [`highest`](Self::highest) returned to [`admit`](Self::admit) first.
    ///
    /// # Errors
    /// The name of the resource is not valid.
    pub fn new(owner: &str, resource: &str) -> Result<Self, NameError> {
        Ok(Self {
            owner: owner.to_owned(),
            resource: Resource::new(resource)?,
            highest: (0, 0),
        })
    }

    /// Epoch and number of the highest fence that was admitted.
    #[must_use]
    pub fn highest(&self) -> (u64, u64) {
        self.highest
    }

    /// Whether the fence is admitted.
    pub fn admit(&mut self, fence: &Fence) -> bool {
        let is_ours = fence.owner() == self.owner && fence.resource == self.resource;
        let admitted = is_ours && fence.position() >= self.highest;
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
        for (owner, resource, text) in [
            ("crane@bay", "dock 1", "7.42@crane@bay#dock 1"),
            ("a#b%23", "#c%", "7.42@a%23b%2523##c%"),
        ] {
            let owner = Peer::new(owner, 1).unwrap();
            let fence = Fence::new(&owner, &Resource::new(resource).unwrap(), 7, 42);
            assert_eq!(fence.to_string(), text);
            assert_eq!(text.parse(), Ok(fence));
        }
        for wrong in [
            "",
            "7.42",
            "7@crane#bay",
            "+7.1@crane#bay",
            "7.1@#bay",
            "7.1@crane",
            "7.1@crane#",
            "a.1@b#c",
            "1.99999999999999999999@a#b",
        ] {
            assert!(wrong.parse::<Fence>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_device_admits_no_lower_and_no_foreign_fence() {
        let fence = |text: &str| text.parse::<Fence>().unwrap();
        let mut admission = Admission::new("crane", "bay").unwrap();
        assert!(admission.admit(&fence("1.5@crane#bay")));
        assert!(admission.admit(&fence("1.5@crane#bay")));
        assert!(!admission.admit(&fence("1.4@crane#bay")));
        assert!(!admission.admit(&fence("9.9@arm#bay")));
        assert!(!admission.admit(&fence("9.9@crane#dock")));
        assert!(admission.admit(&fence("2.1@crane#bay")));
        assert!(!admission.admit(&fence("1.6@crane#bay")));
        assert_eq!(admission.highest(), (2, 1));
    }
}
