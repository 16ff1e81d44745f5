//! The connections of the hardware to the world.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{UnixListener, UnixStream};

use super::World;
use crate::face::Face;
use crate::hardware::{Answer, Ask, IMAGE, Sight};
use crate::part::{Failed, Part, Stop};
use crate::report::{Claim, Reporter};

/// Time between two reports of all poses.
const POSES: Duration = Duration::from_millis(200);

struct Server {
    world: Mutex<World>,
    started: Instant,
    reporter: Reporter,
}

impl Server {
    /// Returns the world at the present time.
    fn world(&self) -> MutexGuard<'_, World> {
        let mut world = self.world.lock().unwrap_or_else(PoisonError::into_inner);
        world.advance(self.started.elapsed().as_secs_f64());
        world
    }
}

/// Runs the world until standard input ends.
///
/// # Errors
/// If the socket cannot be made.
pub async fn run(part: &Part) -> Result<(), Failed> {
    let listener = UnixListener::bind(&part.world)?;
    let server = Arc::new(Server {
        world: Mutex::new(World::new(part.seed)),
        started: Instant::now(),
        reporter: Reporter::new(&part.name),
    });
    server.reporter.claim(Claim::Ready);
    let mut stop = Stop::default();
    let mut poses = tokio::time::interval(POSES);
    loop {
        tokio::select! {
            connection = listener.accept() => {
                let (stream, _) = connection?;
                tokio::spawn(serve(Arc::clone(&server), stream));
            }
            _ = poses.tick() => {
                let poses = server.world().poses();
                server.reporter.claim(Claim::Poses { poses });
            }
            () = stop.requested() => return Ok(()),
        }
    }
}

/// Serves one connection until its process ends.
async fn serve(server: Arc<Server>, stream: UnixStream) -> io::Result<()> {
    let (reader, mut writer) = stream.into_split();
    let mut lines = BufReader::new(reader).lines();
    let Some(name) = lines.next_line().await? else {
        return Ok(());
    };
    while let Some(line) = lines.next_line().await? {
        let ask: Ask = serde_json::from_str(&line)?;
        let (answer, image) = answer(&server, &name, ask);
        let mut line = serde_json::to_vec(&answer)?;
        line.push(b'\n');
        writer.write_all(&line).await?;
        if let Some(image) = image {
            writer.write_all(&image).await?;
        }
    }
    Ok(())
}

fn answer(server: &Server, name: &str, ask: Ask) -> (Answer, Option<Vec<u8>>) {
    let face = |side: String| Face {
        body: name.to_owned(),
        side,
    };
    let mut world = server.world();
    let answer = match ask {
        Ask::Encoder => Answer::Pose(world.encoder(name).unwrap_or_default()),
        Ask::Drive(twist) => {
            world.drive(name, twist);
            Answer::Done(true)
        }
        Ask::Camera { side } => {
            let sight = world.look(&face(side));
            drop(world);
            return (Answer::Image, Some(image(sight.as_ref())));
        }
        Ask::Latch { side } => {
            let contact = world.latch(&face(side));
            if let Some(contact) = &contact {
                let contact = contact.clone();
                server.reporter.claim(Claim::Closed { contact });
            }
            Answer::Done(contact.is_some())
        }
        Ask::Open { side } => {
            let face = face(side);
            let was_latched = world.open(&face);
            if was_latched {
                server.reporter.claim(Claim::Opened { face });
            }
            Answer::Done(was_latched)
        }
        Ask::Contact { side } => Answer::Contact(world.contact(&face(side)).cloned()),
        Ask::Grip { close } => Answer::Done(world.grip(name, close)),
    };
    (answer, None)
}

/// Draws what a camera sees; see [`Sight::find`].
fn image(sight: Option<&Sight>) -> Vec<u8> {
    let sight = sight.and_then(|sight| serde_json::to_vec(sight).ok());
    let sight = sight.unwrap_or_default();
    let mut image = u16::try_from(sight.len())
        .unwrap_or_default()
        .to_be_bytes()
        .to_vec();
    image.extend(sight);
    image.resize(IMAGE, 0x7f);
    image
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use super::*;
    use crate::geometry::Pose;

    #[test]
    fn an_image_has_what_the_camera_sees() {
        let sight = Sight {
            marker: String::from("crex/top").try_into().unwrap(),
            pose: Pose::new(0.1, -0.2, 3.0),
        };
        let drawn = image(Some(&sight));
        assert_eq!((drawn.len(), Sight::find(&drawn)), (IMAGE, Some(sight)));
        assert_eq!(Sight::find(&image(None)), None);
        assert_eq!(Sight::find(&[]), None);
    }
}
