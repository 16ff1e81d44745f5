//! The hardware of a robot or an item: motors, encoders, interfaces, a gripper and a camera. On a real robot, the
//! functions of this module call its drivers; here, they ask the process of the world.

use std::path::Path;

use serde::{Deserialize, Serialize};
use thiserror::Error;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::UnixStream;

use crate::face::Face;
use crate::geometry::{Pose, Twist};

/// Length of the image of a camera, in bytes.
pub const IMAGE: usize = 1_000_000;

/// A question or a command to the hardware, one JSON document in a line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Ask {
    Encoder,
    Drive(Twist),
    Camera { side: String },
    Latch { side: String },
    Open { side: String },
    Contact { side: String },
    Grip { close: bool },
}

/// The answer to an [`Ask`]. The bytes of an image follow its line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Answer {
    Pose(Pose),
    Done(bool),
    Contact(Option<Face>),
    Image,
}

/// The interface that a camera sees.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[expect(clippy::exhaustive_structs, reason = "a sight has no further part")]
pub struct Sight {
    /// The marker on the interface.
    pub marker: Face,
    /// Its pose in the frame of the camera.
    pub pose: Pose,
}

impl Sight {
    /// Finds the marker in an image, which begins with a length (u16, big-endian) and as many bytes of JSON.
    #[must_use]
    pub fn find(image: &[u8]) -> Option<Self> {
        let (len, rest) = image.split_first_chunk::<2>()?;
        let header = rest.get(..usize::from(u16::from_be_bytes(*len)))?;
        serde_json::from_slice(header).ok()
    }
}

/// The error of the hardware.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum HardwareError {
    /// The hardware does not answer.
    #[error("the hardware does not answer")]
    Lost(#[from] std::io::Error),
    /// The hardware has ended.
    #[error("the hardware has ended")]
    Ended,
    /// The hardware gives an answer of another kind.
    #[error("the hardware answers something else: {0:?}")]
    Unexpected(String),
}

/// A connection to the hardware of one body.
#[derive(Debug)]
pub struct Hardware(BufReader<UnixStream>);

impl Hardware {
    /// Connects to the hardware of this body.
    ///
    /// # Errors
    /// If there is none.
    pub async fn connect(world: &Path, name: &str) -> Result<Self, HardwareError> {
        let mut stream = UnixStream::connect(world).await?;
        stream.write_all(format!("{name}\n").as_bytes()).await?;
        Ok(Self(BufReader::new(stream)))
    }

    /// Reads the pose that the body measures of itself.
    ///
    /// # Errors
    /// See [`HardwareError`]; so do the other methods.
    pub async fn encoder(&mut self) -> Result<Pose, HardwareError> {
        match self.ask(&Ask::Encoder).await? {
            Answer::Pose(pose) => Ok(pose),
            other => unexpected(&other),
        }
    }

    /// Drives at this velocity. The motor stops 0.3 s after the last command.
    ///
    /// # Errors
    /// See [`HardwareError`].
    pub async fn drive(&mut self, twist: Twist) -> Result<(), HardwareError> {
        self.command(&Ask::Drive(twist)).await.map(drop)
    }

    /// Stops the motors.
    ///
    /// # Errors
    /// See [`HardwareError`].
    pub async fn stop(&mut self) -> Result<(), HardwareError> {
        self.drive(Twist::default()).await
    }

    /// Drives until a part of the body is within 2 cm of a pose. `part` is its pose at the body.
    ///
    /// # Errors
    /// See [`HardwareError`].
    pub async fn drive_to(&mut self, target: Pose, part: Pose) -> Result<(), HardwareError> {
        const PERIOD: std::time::Duration = std::time::Duration::from_millis(20);
        loop {
            let seen = self.encoder().await?.then(part).sees(target);
            if seen.distance() < 0.02 && seen.yaw.abs() < 0.02 {
                return self.stop().await;
            }
            self.drive(Twist::towards(seen).of_body(part)).await?;
            tokio::time::sleep(PERIOD).await;
        }
    }

    /// Takes an image with the camera at an interface, and writes it to `image`, which has [`IMAGE`] bytes.
    ///
    /// # Errors
    /// See [`HardwareError`].
    pub async fn camera(&mut self, side: &str, image: &mut [u8]) -> Result<(), HardwareError> {
        let side = side.to_owned();
        match self.ask(&Ask::Camera { side }).await? {
            Answer::Image => Ok(self.0.read_exact(image).await.map(drop)?),
            other => unexpected(&other),
        }
    }

    /// Latches an interface to the one in front of it. Returns whether it has latched.
    ///
    /// # Errors
    /// See [`HardwareError`].
    pub async fn latch(&mut self, side: &str) -> Result<bool, HardwareError> {
        let side = side.to_owned();
        self.command(&Ask::Latch { side }).await
    }

    /// Opens an interface. Returns whether it was latched.
    ///
    /// # Errors
    /// See [`HardwareError`].
    pub async fn open(&mut self, side: &str) -> Result<bool, HardwareError> {
        let side = side.to_owned();
        self.command(&Ask::Open { side }).await
    }

    /// Returns the interface that touches this one, if one is latched.
    ///
    /// # Errors
    /// See [`HardwareError`].
    pub async fn contact(&mut self, side: &str) -> Result<Option<Face>, HardwareError> {
        let side = side.to_owned();
        match self.ask(&Ask::Contact { side }).await? {
            Answer::Contact(contact) => Ok(contact),
            other => unexpected(&other),
        }
    }

    /// Closes or opens the gripper. Returns whether it holds an item now.
    ///
    /// # Errors
    /// See [`HardwareError`].
    pub async fn grip(&mut self, close: bool) -> Result<bool, HardwareError> {
        self.command(&Ask::Grip { close }).await
    }

    async fn command(&mut self, ask: &Ask) -> Result<bool, HardwareError> {
        match self.ask(ask).await? {
            Answer::Done(done) => Ok(done),
            other => unexpected(&other),
        }
    }

    async fn ask(&mut self, ask: &Ask) -> Result<Answer, HardwareError> {
        let mut line = serde_json::to_vec(ask).map_err(std::io::Error::from)?;
        line.push(b'\n');
        self.0.get_mut().write_all(&line).await?;
        let mut answer = String::new();
        if self.0.read_line(&mut answer).await? == 0 {
            return Err(HardwareError::Ended);
        }
        serde_json::from_str(&answer).map_err(|_| HardwareError::Unexpected(answer))
    }
}

fn unexpected<T>(answer: &Answer) -> Result<T, HardwareError> {
    Err(HardwareError::Unexpected(format!("{answer:?}")))
}
