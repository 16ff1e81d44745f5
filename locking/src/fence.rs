//! Fences, and their check by a device.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use crate::{LockPeer, NameError, Resource};

/// A fence: the number of a grant. The fences of a resource strictly rise, also over the restarts of its
/// owner (see [`OwnerState`](crate::OwnerState)). A fence says nothing to another owner, and nothing about
/// another resource.
///
/// The text is `<epoch>.<number>.<run>@<owner>#<resource>`, for example
/// `7.42.5a31c0e4d2b19f07@crane#bay`. The run is 64 random bits of the owner's run, in hexadecimal digits.
/// In the name of the owner, `%` is `%25`, and `#` is `%23`.
///
/// The order of fences is that of their grants only if they have the same owner and resource. The runs
/// have no order: of two fences with the same epoch and different runs, neither is the later one.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Fence {
    owner: Arc<str>,
    resource: Resource,
    epoch: u64,
    number: u64,
    run: u64,
}

/// Position of a fence among those of its owner and resource.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Position {
    /// Number of the life of the owner.
    pub(crate) epoch: u64,
    /// Number of the grant in that life.
    pub(crate) number: u64,
}

impl Fence {
    pub(crate) fn new(
        owner: &LockPeer,
        resource: &Resource,
        Position { epoch, number }: Position,
        run: u64,
    ) -> Self {
        Self {
            owner: owner.shared_name().clone(),
            resource: resource.clone(),
            epoch,
            number,
            run,
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

    /// Number of the owner's life. An owner that learns of a fence with a higher number raises it.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Random bits of the owner's life, for comparisons of equality only.
    #[must_use]
    pub fn run(&self) -> u64 {
        self.run
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
            "{}.{}.{:016x}@{owner}#{}",
            self.epoch, self.number, self.run, self.resource
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
    #[error(
        "a fence has the form <epoch>.<number>.<run>@<owner>#<resource>, for example \
         7.42.5a31c0e4d2b19f07@crane#bay"
    )]
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
        let (epoch, rest) = position.split_once('.').ok_or(FenceError::Form)?;
        let (number, run) = rest.split_once('.').ok_or(FenceError::Form)?;
        let digits = |text: &str| match text.bytes().all(|byte| byte.is_ascii_digit()) {
            true => text.parse().map_err(|_| FenceError::Form),
            false => Err(FenceError::Form),
        };
        // One text per fence, so that texts can be compared.
        let is_digit = |byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
        if run.len() != 16 || !run.bytes().all(is_digit) {
            return Err(FenceError::Form);
        }
        let run = u64::from_str_radix(run, 16).map_err(|_| FenceError::Form)?;
        let owner = LockPeer::new(&owner.replace("%23", "#").replace("%25", "%"), 0)?;
        let resource = Resource::new(resource)?;
        let position = Position {
            epoch: digits(epoch)?,
            number: digits(number)?,
        };
        Ok(Self::new(&owner, &resource, position, run))
    }
}

/// Check of fences by a device that is not the owner: it admits a fence of its owner and resource that is
/// at least the highest that it has admitted. Of two runs with the same epoch, it admits the first one that
/// it hears of.
///
/// The owner itself uses [`Locks::admit`](crate::Locks::admit), which also refuses a fence as soon as
/// its grant ends.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Admission {
    owner: String,
    resource: Resource,
    highest: Option<Fence>,
}

/// Reason for which a device does not admit a fence.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NotAdmitted {
    /// The fence is of another owner, or for another resource.
    #[error("the fence is of another owner, or for another resource")]
    Foreign,
    /// The device has admitted a later fence of the same run.
    #[error("the device has admitted the later fence {highest}")]
    Stale {
        /// The highest fence that was admitted.
        highest: Fence,
    },
    /// The device has admitted a fence of another run, with the same epoch or a higher one. Either the
    /// fence is old, or its owner has started without knowing of that run. The owner's next grants are
    /// admitted when it is told of the highest fence ([`Locks::saw`](crate::Locks::saw)).
    #[error("the device has admitted the fence {highest} of another run of the owner")]
    OtherRun {
        /// The highest fence that was admitted.
        highest: Fence,
    },
}

impl Admission {
    /// Creates a check that admits each fence of `owner` for `resource`. A device that restarts passes the
    /// fence that [`highest`](Self::highest) returned to [`admit`](Self::admit) first.
    ///
    /// # Errors
    /// The name of the resource is not valid.
    pub fn new(owner: &str, resource: &str) -> Result<Self, NameError> {
        Ok(Self {
            owner: owner.to_owned(),
            resource: Resource::new(resource)?,
            highest: None,
        })
    }

    /// Name of the owner.
    #[must_use]
    pub fn owner(&self) -> &str {
        &self.owner
    }

    /// The resource.
    #[must_use]
    pub fn resource(&self) -> &Resource {
        &self.resource
    }

    /// The highest fence that was admitted.
    #[must_use]
    pub fn highest(&self) -> Option<&Fence> {
        self.highest.as_ref()
    }

    /// Whether the fence is admitted.
    pub fn admit(&mut self, fence: &Fence) -> bool {
        self.check(fence).is_ok()
    }

    /// Admits a fence.
    ///
    /// # Errors
    /// The fence is not admitted. A device that answers with the reason passes on its highest fence.
    pub fn check(&mut self, fence: &Fence) -> Result<(), NotAdmitted> {
        if fence.owner() != self.owner || fence.resource != self.resource {
            return Err(NotAdmitted::Foreign);
        }
        if let Some(highest) = &self.highest {
            let is_same_run = fence.run == highest.run;
            if fence.epoch <= highest.epoch && !is_same_run {
                let highest = highest.clone();
                return Err(NotAdmitted::OtherRun { highest });
            }
            if fence.position() < highest.position() {
                let highest = highest.clone();
                return Err(NotAdmitted::Stale { highest });
            }
        }
        self.highest = Some(fence.clone());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RUN: &str = "5a31c0e4d2b19f07";

    #[test]
    fn fences_are_text() {
        for (owner, resource, text) in [
            (
                "crane@bay",
                "dock 1",
                "7.42.5a31c0e4d2b19f07@crane@bay#dock 1",
            ),
            ("a#b%23", "#c%", "7.42.5a31c0e4d2b19f07@a%23b%2523##c%"),
        ] {
            let owner = LockPeer::new(owner, 1).unwrap();
            let resource = Resource::new(resource).unwrap();
            let run = u64::from_str_radix(RUN, 16).unwrap();
            let fence = Fence::new(
                &owner,
                &resource,
                Position {
                    epoch: 7,
                    number: 42,
                },
                run,
            );
            assert_eq!(fence.to_string(), text);
            assert_eq!(text.parse(), Ok(fence));
        }
        for wrong in [
            "",
            "7.42",
            "7.42@crane#bay",
            "7@crane#bay",
            "+7.1.5a31c0e4d2b19f07@crane#bay",
            "7.1.5a31c0e4d2b19f07@#bay",
            "7.1.5a31c0e4d2b19f07@crane",
            "7.1.5a31c0e4d2b19f07@crane#",
            "a.1.5a31c0e4d2b19f07@b#c",
            "1.99999999999999999999.5a31c0e4d2b19f07@a#b",
            "1.1.@a#b",
            "1.1.5a31c0e4d2b19f0@a#b",
            "1.1.05a31c0e4d2b19f07@a#b",
            "1.1.5A31c0e4d2b19f07@a#b",
            "1.1.+a31c0e4d2b19f07@a#b",
            "1.1.5a31c0e4d2b19f07.1@a#b",
        ] {
            assert!(wrong.parse::<Fence>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_device_admits_no_lower_and_no_foreign_fence() {
        let fence = |text: &str| {
            let (position, names) = text.split_once('@').unwrap();
            format!("{position}.{RUN}@{names}")
                .parse::<Fence>()
                .unwrap()
        };
        let mut admission = Admission::new("crane", "bay").unwrap();
        assert_eq!(admission.highest(), None);
        assert!(admission.admit(&fence("1.5@crane#bay")));
        assert!(admission.admit(&fence("1.5@crane#bay")));
        assert!(!admission.admit(&fence("1.4@crane#bay")));
        for foreign in ["9.9@arm#bay", "9.9@crane#dock"] {
            let refused = admission.check(&fence(foreign));
            assert_eq!(refused, Err(NotAdmitted::Foreign));
        }
        assert!(admission.admit(&fence("2.1@crane#bay")));
        let highest = fence("2.1@crane#bay");
        let refused = admission.check(&fence("1.6@crane#bay"));
        let stale = NotAdmitted::Stale {
            highest: highest.clone(),
        };
        assert_eq!(refused, Err(stale));
        assert_eq!(admission.highest(), Some(&highest));
    }

    #[test]
    fn of_two_runs_with_one_epoch_a_device_admits_the_first() {
        let fence = |text: &str| text.parse::<Fence>().unwrap();
        let first = fence("1.3.5a31c0e4d2b19f07@crane#bay");
        let mut admission = Admission::new("crane", "bay").unwrap();
        assert!(admission.admit(&first));
        for other_run in [
            "1.3.0000000000000001@crane#bay",
            "1.9.0000000000000001@crane#bay",
            "0.9.ffffffffffffffff@crane#bay",
        ] {
            let refused = admission.check(&fence(other_run));
            let highest = first.clone();
            assert_eq!(refused, Err(NotAdmitted::OtherRun { highest }));
        }
        assert!(admission.admit(&fence("2.1.0000000000000001@crane#bay")));
        let late = admission.check(&first);
        assert!(matches!(late, Err(NotAdmitted::OtherRun { .. })));
    }
}
