//! The task that listens to what happens in the directory.
//!
//! A process that ends, in whatever way, closes its lock file, which it had open for writing; the
//! kernel reports that to everybody who watches the directory.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::future::poll_fn;
use std::io::{self, ErrorKind};
use std::pin::Pin;
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;

use futures_core::Stream as _;
use inotify::{EventMask, EventStream, Inotify, WatchMask};
use tokio::time::Instant;

use super::HostError;
use super::place::{Id, Name, Place};
use super::shared::Shared;

pub(super) struct Watcher {
    events: EventStream<Vec<u8>>,
}

impl Watcher {
    /// Watches from now on. Must be called within a tokio runtime.
    pub(super) fn new(place: &Place) -> Result<Self, HostError> {
        let failed = |source| HostError::Watch {
            path: place.path().to_owned(),
            source,
        };
        let inotify = Inotify::init().map_err(failed)?;
        let mask = WatchMask::CLOSE_WRITE
            | WatchMask::MOVED_TO
            | WatchMask::DELETE
            | WatchMask::DELETE_SELF
            | WatchMask::ONLYDIR;
        let mut watches = inotify.watches();
        watches.add(place.pinned_path(), mask).map_err(failed)?;
        let buffer = vec![0; 16 * 1024];
        let events = inotify.into_event_stream(buffer).map_err(failed)?;
        Ok(Self { events })
    }

    /// Keeps the view up to date, for ever.
    ///
    /// The first change is read at once, and what follows it together after a pause: a process that
    /// registers a hundred agents replaces its file a hundred times, and everybody who read it each
    /// time would read for as long as the square of that.
    pub(super) async fn run(mut self, shared: Arc<Shared>) {
        let mut ending = Ending::default();
        loop {
            let news = tokio::select! {
                news = self.news() => news,
                () = ending.due() => Ok(News::default()),
            };
            let began = Instant::now();
            let handled = news
                .map_err(|source| HostError::Watch {
                    path: shared.place.path().to_owned(),
                    source,
                })
                .and_then(|news| handle(&shared, news, &mut ending));
            if let Err(error) = handled {
                tracing::error!(%error, "the view of the host's directory may be out of date");
                // Whatever it is (no descriptors left, say), not in a tight loop.
                tokio::time::sleep(Duration::from_millis(100)).await;
                ending.rescan = true;
            }
            tokio::time::sleep(pause_after(began.elapsed())).await;
        }
    }

    /// Everything that has happened since the last time, at least one thing.
    async fn news(&mut self) -> io::Result<News> {
        let mut news = News::default();
        poll_fn(|context| {
            // So many at most, to let others run.
            for _ in 0..4096 {
                match Pin::new(&mut self.events).poll_next(context) {
                    Poll::Ready(Some(event)) => {
                        let event = event?;
                        news.add(event.mask, event.name.as_deref().and_then(OsStr::to_str));
                    }
                    // The kernel does not end this.
                    Poll::Ready(None) => return Poll::Ready(Err(ErrorKind::UnexpectedEof.into())),
                    Poll::Pending if news.is_empty() => return Poll::Pending,
                    Poll::Pending => break,
                }
            }
            Poll::Ready(Ok(std::mem::take(&mut news)))
        })
        .await
    }
}

/// How long to let changes gather, after those before took so long to read: where there are many of
/// them, or little of the processor, reading leaves most of it to those who make them. Whoever
/// looks for a name that is not there yet does not wait for this.
fn pause_after(reading: Duration) -> Duration {
    const LEAST: Duration = Duration::from_millis(5);
    const MOST: Duration = Duration::from_millis(100);
    (reading * 8).clamp(LEAST, MOST)
}

/// What has happened, each thing once however often it did.
#[derive(Debug, Default)]
struct News {
    wrote: BTreeSet<Id>,
    ended: BTreeSet<Id>,
    sockets: bool,
    lost: bool,
}

impl News {
    fn add(&mut self, mask: EventMask, name: Option<&str>) {
        if mask.intersects(EventMask::Q_OVERFLOW | EventMask::DELETE_SELF | EventMask::IGNORED) {
            self.lost = true;
        }
        match name.and_then(Name::parse) {
            Some(Name::Entries(id)) if mask.contains(EventMask::MOVED_TO) => {
                self.wrote.insert(id);
            }
            Some(Name::Process(id))
                if mask.intersects(EventMask::CLOSE_WRITE | EventMask::DELETE) =>
            {
                self.ended.insert(id);
            }
            Some(Name::Socket(_)) => self.sockets = true,
            _ => {}
        }
    }

    fn is_empty(&self) -> bool {
        self.wrote.is_empty() && self.ended.is_empty() && !self.sockets && !self.lost
    }
}

fn handle(shared: &Shared, news: News, ending: &mut Ending) -> Result<(), HostError> {
    if news.lost || std::mem::take(&mut ending.rescan) {
        shared.rescan()?;
    }
    if news.sockets {
        shared.find_sockets()?;
    }
    for id in news.wrote {
        shared.process_wrote(id)?;
    }
    for id in news.ended {
        ending.add(id);
    }
    ending.handle(shared)
}

/// Processes that are ending.
///
/// The kernel reports the closing of a file just before it lets go of the lock, and somebody else
/// may be changing the directory when the remains are to be removed; so both are tried again,
/// some times.
#[derive(Debug, Default)]
struct Ending {
    processes: BTreeMap<Id, End>,
    rescan: bool,
}

#[derive(Debug)]
struct End {
    pause: Duration,
    due: Instant,
}

impl Ending {
    const FIRST_PAUSE: Duration = Duration::from_millis(1);
    /// After about a second it is not ending: somebody has only touched its lock file.
    const LAST_PAUSE: Duration = Duration::from_millis(512);

    fn add(&mut self, id: Id) {
        let end = End {
            pause: Self::FIRST_PAUSE,
            due: Instant::now(),
        };
        self.processes.insert(id, end);
    }

    async fn due(&self) {
        if self.rescan {
            return;
        }
        match self.processes.values().map(|end| end.due).min() {
            Some(due) => tokio::time::sleep_until(due).await,
            None => std::future::pending().await,
        }
    }

    fn handle(&mut self, shared: &Shared) -> Result<(), HostError> {
        let now = Instant::now();
        let due: Vec<Id> = self
            .processes
            .iter()
            .filter(|(_, end)| end.due <= now)
            .map(|(id, _)| *id)
            .collect();
        for id in due {
            let done = shared.process_ended(id)? && shared.try_bury(id)?;
            let Some(end) = self.processes.get_mut(&id) else {
                continue;
            };
            if done {
                shared.say_ended();
            }
            if done || end.pause > Self::LAST_PAUSE {
                self.processes.remove(&id);
            } else {
                end.due = now + end.pause;
                end.pause *= 2;
            }
        }
        Ok(())
    }
}
