//! Observes the domain while pages show it.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::admin::watch::{Event, WatchOptions};
use fipa::error::ErrorChain;
use fipa::locks::ResourceStatus;
use fipa::monitor::Library;
use fipa::{Agent, Config, Domain, Incarnation, RegisterOptions};
use parking_lot::Mutex;
use tokio::sync::{Notify, mpsc};
use tokio::time::{Instant, MissedTickBehavior};

use super::goals::{Cancelled, Robots};
use super::offers::{self, Offers};
use super::orders::{OrderError, Orders};
use super::picture::{Picture, Wanted};
use super::view::View;
use crate::command::top::{self, Observer};
use crate::command::watch::checker::Checker;
use crate::membership;
use crate::report::Failure;

/// Time after the last question for which the domain is observed: a page that is opened again shows what happened.
const KEPT: Duration = Duration::from_secs(600);

/// Time between two looks into the directory.
const INTERVAL: Duration = Duration::from_secs(1);

/// Time that rates and percentiles cover.
const WINDOW: Duration = Duration::from_secs(5);

/// Time between two questions to the owners of locks, and maximum wait for their answers.
const LOCKS_INTERVAL: Duration = Duration::from_secs(2);

/// Time between two questions to the robots.
const GOALS_INTERVAL: Duration = Duration::from_secs(1);

/// Time before the next attempt to observe the domain.
const RETRY: Duration = Duration::from_secs(5);

/// The state of the domain for all pages.
pub(super) struct Observation {
    pub(super) offers: Arc<Offers>,
    pub(super) orders: Orders,
    picture: Mutex<Picture>,
    /// Wakes the task that observes.
    wanted: Notify,
    /// Ends the task that observes.
    stopped: Notify,
    last: Mutex<Instant>,
    last_locks: Mutex<Option<Instant>>,
}

impl Observation {
    pub(super) fn new(orders: Orders) -> Arc<Self> {
        let picture = Picture::new(orders.are_permitted());
        Arc::new(Self {
            offers: Arc::default(),
            orders,
            picture: Mutex::new(picture),
            wanted: Notify::new(),
            stopped: Notify::new(),
            last: Mutex::new(Instant::now()),
            last_locks: Mutex::default(),
        })
    }

    /// Ends the task that observes.
    pub(super) fn stop(&self) {
        self.stopped.notify_one();
    }

    /// Returns a view, and keeps the domain observed.
    pub(super) fn view(&self, wanted: &Wanted) -> Arc<View> {
        if *wanted == Wanted::Locks {
            *self.last_locks.lock() = Some(Instant::now());
        }
        self.keep();
        let mut view = self.picture.lock().view(wanted);
        if let Wanted::Agent { name, topic } = wanted {
            self.offers.look_at(name, topic.as_deref());
            self.offers.put(name, Arc::make_mut(&mut view));
        }
        view
    }

    /// Whether a page shows locks and goals.
    fn shows_locks(&self) -> bool {
        let last = *self.last_locks.lock();
        last.is_some_and(|last| last.elapsed() <= 2 * LOCKS_INTERVAL)
    }

    /// Cancels a goal for a client of the page, and shows it.
    pub(super) async fn cancel(&self, order: &[u8]) -> Result<Cancelled, OrderError> {
        self.orders.cancel(order, &self.picture).await
    }

    /// Keeps the domain observed.
    pub(super) fn keep(&self) {
        *self.last.lock() = Instant::now();
        self.wanted.notify_one();
    }

    /// Whether a page has shown the domain lately.
    fn is_kept(&self) -> bool {
        self.last.lock().elapsed() < KEPT
    }
}

/// Observes the domain whenever pages show it, until it is stopped.
pub(super) async fn run(observation: Arc<Observation>, library: Arc<Library>, config: Config) {
    let mut is_stopped = false;
    while !is_stopped {
        is_stopped = tokio::select! {
            () = observation.stopped.notified() => true,
            () = observation.wanted.notified() => {
                // The last observation has left a wake-up behind.
                if !observation.is_kept() {
                    continue;
                }
                let observed = observe(&observation, &library, &config).await;
                match observed {
                    Ok(is_stopped) => {
                        *observation.picture.lock() = Picture::new(observation.orders.are_permitted());
                        is_stopped
                    }
                    Err(failure) => {
                        let mut picture = Picture::new(observation.orders.are_permitted());
                        picture.fail(failure.problem());
                        *observation.picture.lock() = picture;
                        let stopped = observation.stopped.notified();
                        tokio::time::timeout(RETRY, stopped).await.is_ok()
                    }
                }
            }
        };
    }
}

/// Observes the domain until no page has shown it for a while. Returns whether the task has been stopped.
async fn observe(
    observation: &Observation,
    library: &Arc<Library>,
    config: &Config,
) -> Result<bool, Failure> {
    let domain = membership::join_briefly(config).await?;
    let observed = follow(
        observation,
        config,
        &domain,
        Checker::new(Arc::clone(library)),
    )
    .await;
    domain.close().await;
    observed
}

async fn follow(
    observation: &Observation,
    config: &Config,
    domain: &Domain,
    checker: Checker,
) -> Result<bool, Failure> {
    let status_asker = membership::asker(domain).await?;
    let asker = Arc::new(register(domain, config).await?);
    let robots = Robots::default();
    let own = vec![status_asker.name().to_owned(), asker.name().to_owned()];
    let mut watcher = membership::watch(config, WatchOptions::default()).await?;
    let mut observer = Observer::new(WINDOW, checker, own, config, &watcher);
    let (sender, mut reports) = mpsc::channel(1);
    let (locks_sender, mut locks) = mpsc::channel(1);
    let mut ticks = tokio::time::interval(INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let watching = async {
        loop {
            tokio::select! {
                event = watcher.next() => {
                    let checked = observer.event(&event, &watcher);
                    if let (Event::Letter(passage), Some(_)) = (&event, &checked) {
                        robots.notice(passage);
                    }
                    observation.picture.lock().handle(&event, checked.as_ref());
                }
                Some(report) = reports.recv() => observer.report(report),
                Some(locks) = locks.recv() => observation.picture.lock().take_locks(locks),
                _ = ticks.tick() => {
                    let counted = observer.snapshot(&watcher);
                    let entries = watcher.directory().entries();
                    observation.picture.lock().look(SystemTime::now(), &entries, counted);
                    if !observation.is_kept() {
                        return;
                    }
                }
            }
        }
    };
    let is_stopped = tokio::select! {
        () = watching => false,
        () = top::ask(status_asker, sender) => false,
        () = ask_for_locks(observation, &asker, locks_sender) => false,
        () = offers::serve(&observation.offers, &asker) => false,
        () = ask_for_goals(observation, &robots, &asker) => false,
        () = observation.orders.serve(domain, config) => false,
        () = observation.stopped.notified() => true,
    };
    Ok(is_stopped)
}

async fn register(domain: &Domain, config: &Config) -> Result<Agent, Failure> {
    let name = format!("fipa-dashboard-{}", Incarnation::random());
    let options = RegisterOptions {
        agent_type: fipa::admin::routes::ASKER_TYPE.to_owned(),
        ..RegisterOptions::default()
    };
    membership::register(domain, &name, options, config).await
}

/// Asks the owners of all locks again and again while a page shows them.
async fn ask_for_locks(
    observation: &Observation,
    agent: &Agent,
    found: mpsc::Sender<Vec<ResourceStatus>>,
) {
    loop {
        tokio::time::sleep(LOCKS_INTERVAL).await;
        if !observation.shows_locks() {
            continue;
        }
        match agent.query_locks(LOCKS_INTERVAL).await {
            Ok(locks) => {
                if found.send(locks).await.is_err() {
                    return;
                }
            }
            Err(error) => {
                tracing::debug!(error = %ErrorChain(&error), "the owners of locks cannot be asked")
            }
        }
    }
}

/// Asks all robots for their goals again and again while a page shows them.
async fn ask_for_goals(observation: &Observation, robots: &Robots, agent: &Arc<Agent>) {
    loop {
        tokio::time::sleep(GOALS_INTERVAL).await;
        if observation.shows_locks() {
            let page_agent = observation.orders.agent();
            let goals = robots.ask(agent, page_agent.as_ref()).await;
            observation.picture.lock().goals.take(&goals);
        }
    }
}
