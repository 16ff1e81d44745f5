//! The electro-mechanical interfaces of bodies.

use std::fmt;

use serde::{Deserialize, Serialize};

/// An electro-mechanical interface of a body.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
#[expect(
    clippy::exhaustive_structs,
    reason = "an interface has no further part"
)]
pub struct Face {
    /// The name of the body.
    pub body: String,
    /// The name of the interface at its body.
    pub side: String,
}

impl fmt::Display for Face {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.body, self.side)
    }
}

impl From<Face> for String {
    fn from(face: Face) -> Self {
        face.to_string()
    }
}

impl TryFrom<String> for Face {
    type Error = &'static str;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        let (body, side) = text.split_once('/').ok_or("expected BODY/SIDE")?;
        Ok(Self {
            body: body.to_owned(),
            side: side.to_owned(),
        })
    }
}

/// Two interfaces that are latched.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[expect(clippy::exhaustive_structs, reason = "a contact has no further part")]
pub struct Contact {
    /// The interface that has latched.
    pub face: Face,
    /// The interface that it holds.
    pub other: Face,
}
