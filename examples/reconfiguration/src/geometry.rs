//! Poses and motions in the plane.

use serde::{Deserialize, Serialize};

/// A pose: the position in meters, and the angle of the x axis in radians. Also the transform from the frame of the
/// pose into the frame in which it is given.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[expect(
    clippy::exhaustive_structs,
    reason = "a pose in the plane has no further part"
)]
pub struct Pose {
    /// The position along the x axis, in meters.
    pub x: f64,
    /// The position along the y axis, in meters.
    pub y: f64,
    /// The angle, in radians, from −π to π.
    pub yaw: f64,
}

impl Pose {
    /// Returns a pose.
    #[must_use]
    pub const fn new(x: f64, y: f64, yaw: f64) -> Self {
        Self { x, y, yaw }
    }

    /// Returns the pose `inner`, which is given in the frame of this pose, in the outer frame.
    #[must_use]
    pub fn then(self, inner: Self) -> Self {
        let (sin, cos) = self.yaw.sin_cos();
        Self {
            x: self.x + cos * inner.x - sin * inner.y,
            y: self.y + sin * inner.x + cos * inner.y,
            yaw: wrapped(self.yaw + inner.yaw),
        }
    }

    /// Returns the outer frame in the frame of this pose.
    #[must_use]
    pub fn inverse(self) -> Self {
        let (sin, cos) = self.yaw.sin_cos();
        Self {
            x: -(cos * self.x + sin * self.y),
            y: sin * self.x - cos * self.y,
            yaw: wrapped(-self.yaw),
        }
    }

    /// Returns the distance of the origin, in meters.
    #[must_use]
    pub fn distance(self) -> f64 {
        self.x.hypot(self.y)
    }

    /// Returns the pose `outer`, seen from this pose.
    #[must_use]
    pub fn sees(self, outer: Self) -> Self {
        self.inverse().then(outer)
    }
}

/// A velocity in the frame of the body.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[expect(
    clippy::exhaustive_structs,
    reason = "a velocity in the plane has no further part"
)]
pub struct Twist {
    /// The velocity along the x axis, in meters per second.
    pub x: f64,
    /// The velocity along the y axis, in meters per second.
    pub y: f64,
    /// The angular velocity, in radians per second.
    pub yaw: f64,
}

impl Twist {
    /// Returns the velocity that leads to a pose, which is given in the frame of the body: the slower the closer.
    #[must_use]
    pub fn towards(target: Pose) -> Self {
        /// Part of the remaining way per second.
        const GAIN: f64 = 2.5;
        const MAX_SPEED: f64 = 0.8;
        const MAX_TURN: f64 = 1.5;
        let slower = (MAX_SPEED / (GAIN * target.distance()).max(f64::MIN_POSITIVE)).min(1.0);
        Self {
            x: GAIN * target.x * slower,
            y: GAIN * target.y * slower,
            yaw: (GAIN * target.yaw).clamp(-MAX_TURN, MAX_TURN),
        }
    }

    /// Returns the velocity of a body whose part at `part` has this velocity in the frame of the part.
    #[must_use]
    pub fn of_body(self, part: Pose) -> Self {
        let (sin, cos) = part.yaw.sin_cos();
        Self {
            x: cos * self.x - sin * self.y + self.yaw * part.y,
            y: sin * self.x + cos * self.y - self.yaw * part.x,
            yaw: self.yaw,
        }
    }

    /// Returns the motion within a time, in seconds.
    #[must_use]
    pub fn within(self, seconds: f64) -> Pose {
        Pose::new(self.x * seconds, self.y * seconds, self.yaw * seconds)
    }
}

fn wrapped(angle: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    angle - turn * (angle / turn).round()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(left: Pose, right: Pose) {
        let seen = left.sees(right);
        assert!(
            seen.distance() < 1e-9 && seen.yaw.abs() < 1e-9,
            "{left:?} {right:?}"
        );
    }

    #[test]
    fn a_pose_and_its_inverse_cancel() {
        let pose = Pose::new(1.0, -2.0, 2.5);
        near(pose.then(pose.inverse()), Pose::default());
        near(pose.inverse().then(pose), Pose::default());
        let other = Pose::new(0.3, 0.7, -3.0);
        near(pose.then(pose.sees(other)), other);
    }

    #[test]
    fn a_part_gets_the_velocity_that_was_asked_for() {
        let part = Pose::new(0.5, 0.2, 0.7);
        let wanted = Twist {
            x: 0.1,
            y: -0.2,
            yaw: 0.3,
        };
        let short = 1e-6;
        let moved = wanted.of_body(part).within(short).then(part);
        let seen = part.sees(moved);
        assert!((seen.x / short - wanted.x).abs() < 1e-4, "{seen:?}");
        assert!((seen.y / short - wanted.y).abs() < 1e-4, "{seen:?}");
    }
}
