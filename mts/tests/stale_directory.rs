//! A view of the directory that is out of date: the receiver was registered again, and a refresh
//! shows that.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Directory, Entry, MemoryDirectory, MtsId, Registration, Subscriber};
use fipa_transport::{Answer, Conclusion, FailureReason, Incarnation, Kind, Location, Outcome};
use parking_lot::Mutex;

/// Shows an earlier registration until it is refreshed.
struct Behind {
    shown: MemoryDirectory,
    news: Mutex<Option<Registration>>,
    gone: Incarnation,
}

impl Directory for Behind {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        self.shown.known(name)
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.shown.known_incarnation(incarnation)
    }

    fn refresh(&self) {
        if let Some(news) = self.news.lock().take() {
            self.shown.deregister("arm", self.gone).unwrap();
            self.shown.register(news).unwrap();
        }
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        self.shown.entries()
    }

    fn generation(&self) -> u64 {
        self.shown.generation()
    }

    fn subscribe(&self, subscriber: &Subscriber) {
        self.shown.subscribe(subscriber);
    }
}

const OWN: Incarnation = Incarnation::from_u64(1);
const FIRST: Incarnation = Incarnation::from_u64(2);
const SECOND: Incarnation = Incarnation::from_u64(3);
const ROVER: Incarnation = Incarnation::from_u64(4);

/// A core of the agent `rover`, whose directory shows the first registration of `arm`.
struct Sender {
    core: Core,
    directory: Arc<Behind>,
    now: Now,
    /// The registrations to which letters were dispatched, in turn.
    receivers: Vec<Incarnation>,
    outcomes: Vec<Outcome>,
}

impl Sender {
    /// `is_shown_by_refresh` is whether a refresh shows the second registration.
    fn new(is_shown_by_refresh: bool, config: CoreConfig) -> Self {
        let shown = MemoryDirectory::new(MtsId::new("mts", OWN));
        shown.register(arm(FIRST)).unwrap();
        let directory = Arc::new(Behind {
            shown,
            news: Mutex::new(is_shown_by_refresh.then(|| arm(SECOND))),
            gone: FIRST,
        });
        let mut core = Core::new(config, directory.view());
        core.register("rover".into(), ROVER);
        Self {
            core,
            directory,
            now: Now {
                instant: Instant::now(),
                utc: SystemTime::UNIX_EPOCH,
            },
            receivers: Vec::new(),
            outcomes: Vec::new(),
        }
    }

    fn send(&mut self) {
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .build()
            .unwrap();
        let submission = Submission {
            sender: ROVER,
            letter: letter_for(&message, self.now.utc).unwrap(),
            receivers: vec!["arm".into()],
            deadline: Duration::from_secs(60),
        };
        self.core.submit(self.now, submission);
    }

    /// Carries out the actions of the core. `answer` has the answer to a letter for a registration.
    fn carry_out(&mut self, answer: impl Fn(Incarnation, u64) -> Option<Answer>) {
        while let Some(action) = self.core.poll_action() {
            match action {
                Action::Dispatch {
                    attempt, parcel, ..
                } => {
                    let receiver = parcel.stream.receiver;
                    self.receivers.push(receiver);
                    if let Some(answer) = answer(receiver, parcel.sequence) {
                        let answered = Conclusion::Answered(answer);
                        self.core.handle_conclusion(self.now, attempt, answered);
                    }
                }
                Action::Outcome { outcome, .. } => self.outcomes.push(outcome),
                Action::Refresh { number } => {
                    self.directory.refresh();
                    self.core.set_view(self.directory.view());
                    self.core.handle_refreshed(self.now, number);
                }
                _ => {}
            }
        }
    }

    /// Carries out the actions until a time after the present.
    fn run(&mut self, duration: Duration) {
        let end = self.now.instant + duration;
        loop {
            self.carry_out(only_second);
            match self.core.poll_timeout().filter(|due| *due <= end) {
                Some(due) => self.now.instant = due.max(self.now.instant),
                None => break,
            }
            self.core.handle_timeout(self.now);
        }
        self.now.instant = end;
    }
}

fn config() -> CoreConfig {
    CoreConfig::new("mts", OWN, vec![Kind::Shm])
}

fn arm(registration: Incarnation) -> Registration {
    let location: Location = "shm://0000000000000009#0000000000000009".parse().unwrap();
    Registration::new("arm", registration, vec![location])
}

/// The answer of a service that has only the second registration.
fn only_second(receiver: Incarnation, _: u64) -> Option<Answer> {
    Some(match receiver == SECOND {
        true => Answer::Accepted,
        false => Answer::failed(FailureReason::NoSuchAgent, "not here"),
    })
}

#[test]
fn a_letter_to_an_earlier_registration_goes_to_the_current_one() {
    let mut sender = Sender::new(true, config());
    sender.send();
    sender.carry_out(only_second);
    assert_eq!(sender.receivers, [FIRST, SECOND]);
    assert!(
        matches!(sender.outcomes[..], [Outcome::Delivered { .. }]),
        "{:?}",
        sender.outcomes
    );
}

#[test]
fn a_letter_waits_for_the_directory_when_the_service_does_not_know_the_receiver() {
    let mut sender = Sender::new(false, config());
    sender.send();
    sender.run(Duration::from_millis(200));
    assert_eq!(sender.outcomes, []);
    *sender.directory.news.lock() = Some(arm(SECOND));
    sender.directory.refresh();
    sender.core.set_view(sender.directory.view());
    sender.core.handle_directory_change(sender.now);
    sender.run(Duration::from_millis(800));
    assert_eq!(sender.receivers.last(), Some(&SECOND));
    assert!(
        matches!(sender.outcomes[..], [Outcome::Delivered { .. }]),
        "{:?}",
        sender.outcomes
    );
}

#[test]
fn a_letter_to_an_agent_that_only_the_directory_knows_fails_after_two_seconds() {
    let mut sender = Sender::new(false, config());
    sender.send();
    sender.run(Duration::from_millis(1900));
    assert_eq!(sender.outcomes, []);
    sender.run(Duration::from_millis(700));
    let [Outcome::Failed { reason, attempts }] = &sender.outcomes[..] else {
        panic!("{:?}", sender.outcomes);
    };
    assert_eq!(*reason, FailureReason::NoSuchAgent);
    assert!(attempts.iter().all(|it| it.error.detail == "not here"));
    // The pauses rise to half a second.
    assert!(sender.receivers.len() <= 12, "{}", sender.receivers.len());
}

/// A receiver remembers as many letters as a lane has. If it took more while the answer to one is
/// missing, it could not say any more whether it has that one.
#[test]
fn no_more_letters_go_than_the_receiver_remembers_while_an_answer_is_missing() {
    let lane = 4;
    let mut sender = Sender::new(false, CoreConfig { lane, ..config() });
    for _ in 0..3 * lane {
        sender.send();
        // Sequence numbers begin with 1.
        sender.carry_out(|_, sequence| (sequence > 1).then_some(Answer::Accepted));
    }
    assert_eq!(sender.receivers.len(), lane);
    assert!(sender.outcomes.iter().all(|outcome| match outcome {
        Outcome::Delivered { .. } => true,
        Outcome::Failed { reason, .. } => *reason == FailureReason::QueueFull,
        _ => false,
    }));
}
