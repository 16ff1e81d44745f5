//! The bodies of the world: they move, meet, and see each other.

use std::collections::BTreeMap;
use std::fmt;

use fastrand::Rng;

use crate::face::{Contact, Face};
use crate::geometry::{Pose, Twist};
use crate::hardware::Sight;

/// Maximum error of the position at which an interface latches, in meters.
const REACH: f64 = 0.008;
/// Maximum error of the angle at which an interface latches, in radians.
const TURN: f64 = 0.05;
/// Maximum error of the position at which the gripper holds an item, in meters.
const GRIP: f64 = 0.1;
/// Maximum distance at which a camera sees another interface, in meters.
const SIGHT: f64 = 1.2;
/// A motor stops this long after its last command, in seconds.
const DEAD_MAN: f64 = 0.3;

struct Body {
    pose: Pose,
    /// The error of its own measurement of its pose.
    bias: Pose,
    sides: BTreeMap<&'static str, Pose>,
    twist: Twist,
    /// The time at which the motor stops, in seconds.
    until: f64,
}

/// The truth.
pub struct World {
    bodies: BTreeMap<String, Body>,
    contacts: Vec<Contact>,
    /// The body with the gripper, and the item in it.
    gripped: Option<(String, String)>,
    rng: Rng,
    /// The time of the last step, in seconds.
    now: f64,
}

impl fmt::Debug for World {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("World")
            .field("contacts", &self.contacts)
            .finish_non_exhaustive()
    }
}

impl World {
    /// Places the two robots and the two items. The seed decides where exactly.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        let mut rng = Rng::with_seed(seed);
        let item = [
            ("a", Pose::new(-0.1, 0.0, std::f64::consts::PI)),
            ("b", Pose::new(0.1, 0.0, 0.0)),
        ];
        let mut bodies = BTreeMap::new();
        for (name, at, sides) in [
            (
                "crex",
                Pose::new(0.0, 0.0, 0.0),
                &[("top", Pose::new(0.3, 0.0, 0.0))][..],
            ),
            (
                "sherpa",
                Pose::new(3.2, -2.0, 1.5),
                &[("gripper", Pose::new(0.4, 0.0, 0.0))][..],
            ),
            ("payload_1", Pose::new(1.8, 0.8, 0.3), &item[..]),
            ("payload_2", Pose::new(2.4, -1.0, -0.3), &item[..]),
        ] {
            let mut about = |scale: f64| (rng.f64() * 2.0 - 1.0) * scale;
            let body = Body {
                pose: at.then(Pose::new(about(0.3), about(0.3), about(0.3))),
                bias: Pose::new(about(0.02), about(0.02), about(0.02)),
                sides: sides.iter().copied().collect(),
                twist: Twist::default(),
                until: 0.0,
            };
            bodies.insert(name.to_owned(), body);
        }
        Self {
            bodies,
            contacts: Vec::new(),
            gripped: None,
            rng,
            now: 0.0,
        }
    }

    /// Moves all bodies up to this time, in seconds.
    pub fn advance(&mut self, now: f64) {
        let moving: Vec<(String, Twist, f64)> = self
            .bodies
            .iter()
            .map(|(name, body)| (name.clone(), body.twist, body.until.min(now) - self.now))
            .filter(|(_, twist, seconds)| *seconds > 0.0 && *twist != Twist::default())
            .collect();
        for (name, twist, seconds) in moving {
            let Some(before) = self.pose(&name) else {
                continue;
            };
            let moved = before.then(twist.within(seconds)).then(before.inverse());
            for other in self.joined(&name) {
                if let Some(body) = self.bodies.get_mut(&other) {
                    body.pose = moved.then(body.pose);
                }
            }
        }
        self.now = now.max(self.now);
    }

    /// Returns the true pose of a body.
    #[must_use]
    pub fn pose(&self, name: &str) -> Option<Pose> {
        self.bodies.get(name).map(|body| body.pose)
    }

    /// Returns the true poses of all bodies.
    #[must_use]
    pub fn poses(&self) -> BTreeMap<String, Pose> {
        let all = self.bodies.iter();
        all.map(|(name, body)| (name.clone(), body.pose)).collect()
    }

    /// Returns the latched interfaces.
    #[must_use]
    pub fn contacts(&self) -> &[Contact] {
        &self.contacts
    }

    /// Returns the pose that a body measures of itself.
    #[must_use]
    pub fn encoder(&self, name: &str) -> Option<Pose> {
        let body = self.bodies.get(name)?;
        Some(body.pose.then(body.bias))
    }

    /// Drives a body at this velocity for a short time.
    pub fn drive(&mut self, name: &str, twist: Twist) {
        let finite = [twist.x, twist.y, twist.yaw]
            .iter()
            .all(|it| it.is_finite());
        if let Some(body) = self.bodies.get_mut(name).filter(|_| finite) {
            body.twist = twist;
            body.until = self.now + DEAD_MAN;
        }
    }

    /// Returns the interface that the camera at an interface sees, with noise.
    pub fn look(&mut self, face: &Face) -> Option<Sight> {
        let camera = self.at(face)?;
        let sees = |other: &Face| {
            let seen = camera.sees(self.at(other)?);
            (seen.x > -0.05 && seen.distance() < SIGHT).then(|| (other.clone(), seen))
        };
        let group = self.joined(&face.body);
        let others = self
            .faces()
            .filter(|other| !group.contains(&other.body) && self.is_free(other));
        let all = others.filter_map(|other| sees(&other));
        let (marker, seen) =
            all.min_by(|(_, left), (_, right)| left.distance().total_cmp(&right.distance()))?;
        let mut noise = |scale: f64| (self.rng.f64() * 2.0 - 1.0) * scale;
        let scale = 0.001 + 0.01 * seen.distance();
        let pose = Pose::new(
            seen.x + noise(scale),
            seen.y + noise(scale),
            seen.yaw + noise(scale),
        );
        Some(Sight { marker, pose })
    }

    /// Latches an interface to the one in front of it. Returns that one, if it is close enough.
    pub fn latch(&mut self, face: &Face) -> Option<Contact> {
        let here = self.at(face).filter(|_| self.is_free(face))?;
        let turned = here.then(Pose::new(0.0, 0.0, std::f64::consts::PI));
        let fits = |other: &Face| {
            let seen = self.at(other).map(|other| turned.sees(other));
            seen.is_some_and(|seen| seen.distance() < REACH && seen.yaw.abs() < TURN)
        };
        let other = self
            .faces()
            .find(|other| other.body != face.body && self.is_free(other) && fits(other))?;
        let contact = Contact {
            face: face.clone(),
            other,
        };
        self.contacts.push(contact.clone());
        Some(contact)
    }

    /// Opens an interface. Returns whether it was latched.
    pub fn open(&mut self, face: &Face) -> bool {
        let before = self.contacts.len();
        self.contacts.retain(|contact| contact.face != *face);
        self.contacts.len() != before
    }

    /// Returns the interface that holds, or is held by, this one.
    #[must_use]
    pub fn contact(&self, face: &Face) -> Option<&Face> {
        self.contacts.iter().find_map(|contact| match contact {
            Contact { face: it, other } if it == face => Some(other),
            Contact {
                face: other,
                other: it,
            } if it == face => Some(other),
            _ => None,
        })
    }

    /// Closes or opens the gripper of a body. Returns whether it holds an item now.
    pub fn grip(&mut self, name: &str, close: bool) -> bool {
        self.gripped = None;
        let gripper = Face {
            body: name.to_owned(),
            side: "gripper".to_owned(),
        };
        let Some(here) = self.at(&gripper).filter(|_| close) else {
            return false;
        };
        let near = |other: &Face| {
            self.at(other)
                .is_some_and(|other| here.sees(other).distance() < GRIP)
        };
        let found = self
            .faces()
            .find(|other| other.body != name && other.side == "b" && near(other));
        self.gripped = found.map(|other| (name.to_owned(), other.body));
        self.gripped.is_some()
    }

    fn faces(&self) -> impl Iterator<Item = Face> {
        self.bodies.iter().flat_map(|(name, body)| {
            let sides = body.sides.keys().filter(|side| **side != "gripper");
            sides.map(|side| Face {
                body: name.clone(),
                side: (*side).to_owned(),
            })
        })
    }

    fn at(&self, face: &Face) -> Option<Pose> {
        let body = self.bodies.get(&face.body)?;
        body.sides
            .get(face.side.as_str())
            .map(|side| body.pose.then(*side))
    }

    fn is_free(&self, face: &Face) -> bool {
        self.contact(face).is_none()
    }

    /// Returns the bodies that move with a body, itself among them.
    fn joined(&self, name: &str) -> Vec<String> {
        let mut group = vec![name.to_owned()];
        let mut at = 0;
        while let Some(from) = group.get(at).cloned() {
            let latched = self
                .contacts
                .iter()
                .map(|it| (it.face.body.as_str(), it.other.body.as_str()));
            let gripped = self
                .gripped
                .iter()
                .map(|(one, other)| (one.as_str(), other.as_str()));
            for (one, other) in latched.chain(gripped) {
                let next = match from.as_str() {
                    from if from == one => other,
                    from if from == other => one,
                    _ => continue,
                };
                if !group.iter().any(|known| known == next) {
                    group.push(next.to_owned());
                }
            }
            at += 1;
        }
        group
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use super::*;

    fn face(text: &str) -> Face {
        text.to_owned().try_into().unwrap()
    }

    /// Places the interface of crex exactly in front of this interface, off by `error` meters.
    fn approach(world: &mut World, at: &str, error: f64) {
        let target = world.at(&face(at)).unwrap();
        let target = target.then(Pose::new(error, 0.0, std::f64::consts::PI));
        let crex = world.bodies.get_mut("crex").unwrap();
        crex.pose = target.then(crex.sides["top"].inverse());
    }

    #[test]
    fn an_interface_latches_only_what_is_within_its_reach() {
        let mut world = World::new(1);
        approach(&mut world, "payload_1/a", 0.009);
        assert_eq!(world.latch(&face("payload_1/a")), None);
        approach(&mut world, "payload_1/a", 0.007);
        let contact = world.latch(&face("payload_1/a")).unwrap();
        assert_eq!(contact.other, face("crex/top"));
        assert_eq!(world.contact(&face("crex/top")), Some(&face("payload_1/a")));
        assert!(world.open(&face("payload_1/a")) && !world.open(&face("payload_1/a")));
    }

    #[test]
    fn latched_bodies_move_together_and_a_motor_stops_without_commands() {
        let mut world = World::new(2);
        approach(&mut world, "payload_1/a", 0.0);
        world.latch(&face("payload_1/a")).unwrap();
        let before = world
            .pose("crex")
            .unwrap()
            .sees(world.pose("payload_1").unwrap());
        let start = world.pose("crex").unwrap();
        let twist = Twist {
            x: 1.0,
            y: 0.0,
            yaw: 0.5,
        };
        world.drive("crex", twist);
        world.advance(10.0);
        let after = world
            .pose("crex")
            .unwrap()
            .sees(world.pose("payload_1").unwrap());
        assert!(before.sees(after).distance() < 1e-9);
        let way = start.sees(world.pose("crex").unwrap()).distance();
        assert!((way - DEAD_MAN).abs() < 1e-9, "{way}");
    }

    #[test]
    fn a_camera_sees_the_nearest_free_interface_of_another_body() {
        let mut world = World::new(3);
        approach(&mut world, "payload_1/a", 0.5);
        let sight = world.look(&face("payload_1/a")).unwrap();
        assert_eq!(sight.marker, face("crex/top"));
        assert!((sight.pose.x - 0.5).abs() < 0.01, "{sight:?}");
        approach(&mut world, "payload_1/a", 2.0);
        assert_eq!(world.look(&face("payload_1/a")), None);
    }
}
