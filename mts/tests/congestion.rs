//! A mailbox with a limited number of letters, and more receivers behind it than that.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Directory, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, AttemptId, Conclusion, Incarnation, Kind, Outcome, TransportError, TransportErrorKind,
};

const RECEIVERS: usize = 40;
const WINDOW: usize = 16;

#[test]
fn only_an_attempt_that_ended_frees_room() {
    let own = Incarnation::from_u64(1);
    let directory = MemoryDirectory::new(MtsId::new("mts", own));
    let location: fipa_transport::Location =
        "shm://0000000000000009#0000000000000009".parse().unwrap();
    for number in 0..RECEIVERS {
        let incarnation = Incarnation::from_u64(100 + number as u64);
        let agent = Registration::new(format!("arm_{number}"), incarnation, vec![location.clone()]);
        directory.register(agent).unwrap();
    }
    let config = CoreConfig::new("mts", own, vec![Kind::Shm]);
    let mut core = Core::new(config, Arc::new(directory));
    let now = Now {
        instant: Instant::now(),
        utc: SystemTime::UNIX_EPOCH,
    };
    let rover = Incarnation::from_u64(2);
    core.register("rover".into(), rover);
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm_.*").unwrap())
        .build()
        .unwrap();
    let submission = Submission {
        sender: rover,
        letter: letter_for(&message, now.utc).unwrap(),
        receivers: vec!["arm_.*".into()],
        deadline: Duration::from_secs(5),
    };
    let (_, expected) = core.submit(now, submission);
    // A pattern is matched after a refresh.
    assert_eq!(expected, None);

    let mut under_way: VecDeque<AttemptId> = VecDeque::new();
    let (mut tries, mut delivered) = (0, 0);
    // No time passes: lanes that wait for room are woken by the attempts that free it.
    loop {
        while let Some(action) = core.poll_action() {
            match action {
                Action::Dispatch { attempt, .. } => {
                    tries += 1;
                    assert!(tries <= 2 * RECEIVERS, "tried again and again");
                    if under_way.len() < WINDOW {
                        under_way.push_back(attempt);
                    } else {
                        let full = TransportError::new(
                            TransportErrorKind::Congested,
                            "the window is full",
                        );
                        core.handle_conclusion(now, attempt, Conclusion::NotSent(full));
                    }
                }
                Action::Outcome { outcome, .. } => {
                    assert!(matches!(outcome, Outcome::Delivered { .. }), "{outcome:?}");
                    delivered += 1;
                }
                Action::Refresh { number } => core.handle_refreshed(now, number),
                Action::Resolved { outcomes, .. } => assert_eq!(outcomes, RECEIVERS),
                _ => {}
            }
        }
        let Some(first) = under_way.pop_front() else {
            break;
        };
        core.handle_conclusion(now, first, Conclusion::Answered(Answer::Accepted));
    }
    assert_eq!(delivered, RECEIVERS);
    // One attempt for each receiver, and a second one for those that found no room.
    assert_eq!(tries, RECEIVERS + (RECEIVERS - WINDOW));
}

/// A lane without room holds letters back while others leave it, and refuses them when it stands still.
#[test]
fn a_full_lane_that_moves_holds_letters_back() {
    let own = Incarnation::from_u64(1);
    let directory = MemoryDirectory::new(MtsId::new("mts", own));
    let location = "shm://0000000000000009#0000000000000009".parse().unwrap();
    let arm = Registration::new("arm", Incarnation::from_u64(100), vec![location]);
    directory.register(arm).unwrap();
    let config = CoreConfig::new("mts", own, vec![Kind::Shm]);
    let lane = config.lane;
    let mut core = Core::new(config, Arc::new(directory));
    let rover = Incarnation::from_u64(2);
    core.register("rover".into(), rover);
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap();
    let start = Instant::now();
    let at = |ms: u64| Now {
        instant: start + Duration::from_millis(ms),
        utc: SystemTime::UNIX_EPOCH,
    };
    let letter = letter_for(&message, SystemTime::UNIX_EPOCH).unwrap();
    let send = |core: &mut Core, now: Now| {
        let submission = Submission {
            sender: rover,
            letter: letter.clone(),
            receivers: vec!["arm".into()],
            deadline: Duration::from_secs(60),
        };
        core.submit(now, submission);
    };
    // The letters that were dispatched, and whether a letter failed.
    let look = |core: &mut Core| {
        let (mut attempts, mut failed) = (Vec::new(), false);
        while let Some(action) = core.poll_action() {
            match action {
                Action::Dispatch { attempt, .. } => attempts.push(attempt),
                Action::Outcome { outcome, .. } => {
                    failed |= matches!(outcome, Outcome::Failed { .. });
                }
                _ => {}
            }
        }
        (attempts, failed)
    };
    for _ in 0..lane {
        send(&mut core, at(0));
    }
    let (attempts, failed) = look(&mut core);
    assert!(!failed);
    send(&mut core, at(0));
    assert!(look(&mut core).1, "the lane has not moved");
    core.handle_conclusion(at(500), attempts[0], Conclusion::Answered(Answer::Accepted));
    for _ in 0..3 * lane + 1 {
        send(&mut core, at(600));
    }
    assert!(!look(&mut core).1);
    // Its memory is bounded.
    send(&mut core, at(600));
    assert!(look(&mut core).1, "too many letters are held back");
    core.handle_conclusion(at(600), attempts[1], Conclusion::Answered(Answer::Accepted));
    send(&mut core, at(1700));
    assert!(look(&mut core).1, "the lane stands still");
}
