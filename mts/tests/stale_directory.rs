//! A view of the directory that is out of date: the receiver was registered again, and a refresh
//! shows that.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Directory, Entry, MemoryDirectory, Mts, Registration, Subscriber};
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

#[test]
fn a_letter_to_an_earlier_registration_goes_to_the_current_one() {
    let [own, first, second, rover] = [1, 2, 3, 4].map(Incarnation::from_u64);
    let location: Location = "shm://0000000000000009#0000000000000009".parse().unwrap();
    let arm = |life| Registration::new("arm", life, vec![location.clone()]);
    let shown = MemoryDirectory::new(Mts::new("mts", own));
    shown.register(arm(first)).unwrap();
    let directory = Arc::new(Behind {
        shown,
        news: Mutex::new(Some(arm(second))),
        gone: first,
    });
    let config = CoreConfig::new("mts", own, vec![Kind::Shm]);
    let mut core = Core::new(config, directory.view());
    let now = Now {
        instant: Instant::now(),
        utc: SystemTime::UNIX_EPOCH,
    };
    core.register("rover".into(), rover);
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap();
    let submission = Submission {
        sender: rover,
        letter: letter_for(&message, now.utc).unwrap(),
        receivers: vec!["arm".into()],
        deadline: Duration::from_secs(5),
    };
    core.send(now, submission);

    let mut lives = Vec::new();
    let mut outcomes = Vec::new();
    while let Some(action) = core.poll_action() {
        match action {
            Action::Dispatch {
                attempt, parcel, ..
            } => {
                let life = parcel.stream.receiver;
                lives.push(life);
                let answer = match life == second {
                    true => Answer::Accepted,
                    false => Answer::failed(FailureReason::NoSuchAgent, ""),
                };
                core.handle_conclusion(now, attempt, Conclusion::Answered(answer));
            }
            Action::Outcome { outcome, .. } => outcomes.push(outcome),
            Action::Refresh { number } => {
                directory.refresh();
                core.set_view(directory.view());
                core.handle_refreshed(now, number);
            }
            _ => {}
        }
    }
    assert_eq!(lives, [first, second]);
    assert!(
        matches!(outcomes[..], [Outcome::Delivered { .. }]),
        "{outcomes:?}"
    );
}
