//! The contents of the letters: JSON.

use fipa::Message;
#[cfg(feature = "robots")]
use fipa::platform::ServiceDescription;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::face::{Contact, Face};
#[cfg(feature = "robots")]
use crate::geometry::{Pose, Twist};

/// The name of the protocol of a docking, `dock.scxml`.
pub(crate) const DOCK: &str = "dock";

#[cfg(feature = "robots")]
/// The topic of the pose of a free interface, in meters and radians.
pub(crate) const POSE: &str = "pose";

/// The topic of the images of an item.
pub(crate) const IMAGES: &str = "camera/image";

/// The master asks a client and an item to dock.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Docking {
    /// The interface of the item.
    pub(crate) face: Face,
    /// The interface that comes to it, which the client carries.
    pub(crate) with: Face,
    /// The agent that moves.
    pub(crate) client: String,
    /// The name of the merged robot.
    pub(crate) coalition: String,
}

impl Docking {
    /// Returns the contact for which the master asks.
    pub(crate) fn contact(&self) -> Contact {
        Contact {
            face: self.face.clone(),
            other: self.with.clone(),
        }
    }
}

#[cfg(feature = "robots")]
/// The master guides the client.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Drive {
    /// The velocity of the interface that is to dock, in its frame.
    pub(crate) twist: Twist,
}

#[cfg(feature = "robots")]
/// The operator calls for proposals to fetch an item.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Fetch {
    pub(crate) item: String,
    /// Where it lies.
    pub(crate) pose: Pose,
}

/// The leader asks the founder of the coalition for other members.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Members {
    pub(crate) members: Vec<String>,
}

/// Writes a content.
pub(crate) fn say(words: &impl Serialize) -> String {
    // The words have text keys and finite numbers only, so this cannot fail.
    serde_json::to_string(words).unwrap_or_default()
}

/// Returns the bytes of a content.
pub(crate) fn bytes(message: &Message) -> &[u8] {
    message.content().map_or(&[], |content| content)
}

#[cfg(feature = "robots")]
/// Returns the pose that the directory lists with a service.
pub(crate) fn pose(service: &ServiceDescription) -> Option<Pose> {
    serde_json::from_str(service.property("pose")?.as_str()?).ok()
}

/// Reads a content.
pub(crate) fn hear<T: DeserializeOwned>(message: &Message) -> Option<T> {
    serde_json::from_slice(bytes(message)).ok()
}
