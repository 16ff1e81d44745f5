//! The decisions about goals, on a clock of the test.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::collections::HashMap;

use fipa_actions::{
    ActionDescription, ActionLimits, Cause, Executor, Failure, Goal, GoalRef, GoalState,
    MAX_PROGRESS, OfferOptions, OfferRefused, Orphans, Output, ParameterDescription, Policy,
    Progress, ProgressError, Refusal,
};
use fipa_content::{Parameter, Term};

fn action(name: &str, policy: Policy) -> ActionDescription {
    let mut action = ActionDescription::new(name);
    action.policy = policy;
    let speed = ParameterDescription::of::<f64>("speed");
    let speed = speed.unit("m/s").range(0.0..=0.5).default(&0.25).unwrap();
    action.parameters.push(speed);
    action
}

fn with(policy: Policy) -> Executor {
    let mut executor = Executor::new(ActionLimits::default());
    let options = OfferOptions::default();
    executor.offer(action("drive", policy), options).unwrap();
    executor
}

fn goal(arguments: &str) -> Goal {
    let act = format!("(drive {arguments})");
    let Term::Functional(term) = Term::parse(act.as_bytes()).unwrap().into_owned() else {
        panic!("{act}");
    };
    Goal::of("drive", term.parameters().to_vec())
}

/// Returns the outputs, without the changes of the status and the agrees.
fn outputs(executor: &mut Executor) -> Vec<Output> {
    let all = std::iter::from_fn(|| executor.poll_output());
    let told = all.filter(|it| !matches!(it, Output::Changed { .. } | Output::Agree { .. }));
    told.collect()
}

/// Requires the start of a goal, and returns its number.
#[track_caller]
fn started(executor: &mut Executor) -> u64 {
    match &outputs(executor)[..] {
        [Output::Start(running)] => running.goal,
        other => panic!("{other:?}"),
    }
}

fn finish(conversation: u64, outcome: Result<Option<Term<'static>>, Failure>) -> Output {
    Output::Finish {
        conversation,
        outcome,
    }
}

#[test]
fn a_goal_runs_with_its_defaults_and_its_outcome_reaches_its_conversation() {
    let mut executor = with(Policy::Reject);
    assert_eq!(executor.request(0, 1, "rover", "a", goal("")), Ok(()));
    let [Output::Start(running)] = &outputs(&mut executor)[..] else {
        panic!()
    };
    let speed = Term::parse("0.25").unwrap();
    let expected = Parameter {
        name: "speed".into(),
        value: speed,
    };
    assert_eq!(running.arguments, [expected]);
    let goal = running.goal;
    executor.ended(5, goal, Ok(Some(Term::from("there"))));
    let outcome = finish(1, Ok(Some(Term::from("there"))));
    assert_eq!(outputs(&mut executor), [outcome]);
    assert_eq!(executor.open(), 0);
}

#[test]
fn a_refusal_names_the_parameter_and_the_reason() {
    let mut executor = with(Policy::Reject);
    let text = |text: &str| text.to_owned();
    let unit = "(quantity :value 3 :unit km/h)";
    for (arguments, expected) in [
        (
            ":speed fast",
            Refusal::WrongType(text("speed"), text("number"), text("string")),
        ),
        (
            ":speed 0.6",
            Refusal::OutOfRange(text("speed"), text("0 to 0.5"), text("0.6")),
        ),
        (
            &format!(":speed {unit}"),
            Refusal::WrongUnit(text("speed"), text("m/s"), text("km/h")),
        ),
        (":pace 0.1", Refusal::UnknownParameter(text("pace"))),
        (
            ":speed 0.1 :speed 0.2",
            Refusal::RepeatedParameter(text("speed")),
        ),
    ] {
        let refused = executor.request(0, 1, "rover", "a", goal(arguments));
        assert_eq!(refused, Err(expected), "{arguments}");
    }
    let known_unit = goal(":speed (quantity :value 0.3 :unit m/s)");
    assert_eq!(executor.request(0, 1, "rover", "a", known_unit), Ok(()));
    let other = Goal::of("fly", Vec::new());
    let unknown = executor.request(0, 2, "rover", "b", other);
    assert_eq!(unknown, Err(Refusal::UnknownAction(text("fly"))));
    let fence = Goal {
        fence: Some(text("1.1@crane")),
        ..goal("")
    };
    let unchecked = executor.request(0, 2, "rover", "b", fence);
    assert_eq!(unchecked, Err(Refusal::UncheckedFence));
}

#[test]
fn the_policies_reject_queue_and_preempt() {
    let mut executor = with(Policy::Reject);
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let busy = executor.request(0, 2, "rover", "b", goal(""));
    assert_eq!(busy, Err(Refusal::Busy("drive".to_owned())));

    let mut executor = with(Policy::Queue(1));
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let first = started(&mut executor);
    assert_eq!(executor.request(0, 2, "rover", "b", goal("")), Ok(()));
    let full = executor.request(0, 3, "rover", "c", goal(""));
    assert_eq!(full, Err(Refusal::QueueFull("drive".to_owned())));
    assert_eq!(executor.status(9)[1].state, GoalState::Queued);
    executor.ended(1, first, Ok(None));
    let all = outputs(&mut executor);
    assert!(matches!(&all[..], [Output::Finish { .. }, Output::Start(next)] if next.id == "b"));

    let mut executor = with(Policy::Preempt);
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let first = started(&mut executor);
    assert_eq!(executor.request(0, 2, "arm", "b", goal("")), Ok(()));
    let stop = Output::Stop {
        goal: first,
        cause: Cause::Preempted,
    };
    assert_eq!(outputs(&mut executor), [stop]);
    // The goal that waits gives way to a third one.
    assert_eq!(executor.request(0, 3, "rover", "c", goal("")), Ok(()));
    assert_eq!(outputs(&mut executor), [finish(2, Err(Failure::Preempted))]);
    executor.ended(1, first, Err(Failure::Failed("stopped".to_owned())));
    let all = outputs(&mut executor);
    assert_eq!(all[0], finish(1, Err(Failure::Preempted)));
    assert!(matches!(&all[1], Output::Start(next) if next.id == "c"));
}

#[test]
fn a_goal_that_is_sent_again_runs_once() {
    let mut executor = with(Policy::Queue(9));
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let number = started(&mut executor);
    // The client sends it again while it runs.
    assert_eq!(executor.request(1, 2, "rover", "a", goal("")), Ok(()));
    assert_eq!(outputs(&mut executor), []);
    executor.gone(2, 1);
    assert_eq!(
        outputs(&mut executor),
        [],
        "the other conversation is there"
    );
    executor.ended(3, number, Ok(None));
    assert_eq!(outputs(&mut executor), [finish(2, Ok(None))]);
    // And after its end.
    executor.request(4, 3, "rover", "a", goal("")).unwrap();
    assert_eq!(outputs(&mut executor), [finish(3, Ok(None))]);
    let other = executor.request(4, 4, "rover", "a", goal(":speed 0.1"));
    assert_eq!(other, Err(Refusal::UsedId("a".to_owned())));
    // The id of another client is another goal.
    executor.request(4, 5, "arm", "a", goal("")).unwrap();
    started(&mut executor);
    // The outcome is stored for a while.
    let retention = ActionLimits::default().retention;
    executor.handle_timeout(3 + retention);
    executor.ended(3 + retention, number + 1, Ok(None));
    outputs(&mut executor);
    executor
        .request(4 + retention, 6, "rover", "a", goal(""))
        .unwrap();
    started(&mut executor);
}

/// Returns what the clients are told.
fn told(executor: &mut Executor) -> Vec<Output> {
    let all = std::iter::from_fn(|| executor.poll_output());
    let told = all.filter(|it| {
        matches!(
            it,
            Output::Agree { .. } | Output::Refuse { .. } | Output::Finish { .. }
        )
    });
    told.collect()
}

fn agree(conversation: u64, queued: bool) -> Output {
    Output::Agree {
        conversation,
        queued,
    }
}

fn refuse(conversation: u64, reason: &str) -> Output {
    let reason = Refusal::Rejected(reason.to_owned());
    Output::Refuse {
        conversation,
        reason,
    }
}

fn deciding(policy: Policy) -> Executor {
    let mut executor = Executor::new(ActionLimits::default());
    let options = OfferOptions {
        decides: true,
        ..OfferOptions::default()
    };
    executor.offer(action("drive", policy), options).unwrap();
    executor
}

#[test]
fn a_client_learns_at_once_whether_its_goal_waits() {
    let mut executor = with(Policy::Queue(1));
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    assert_eq!(told(&mut executor), [agree(1, false)]);
    executor.request(0, 2, "rover", "b", goal("")).unwrap();
    assert_eq!(told(&mut executor), [agree(2, true)]);
    // A repeat learns it, too.
    executor.request(1, 3, "rover", "b", goal("")).unwrap();
    assert_eq!(told(&mut executor), [agree(3, true)]);
    let first = executor.find("rover", "a").unwrap();
    executor.accept(first);
    assert_eq!(told(&mut executor), [], "it is accepted already");
    executor.ended(2, first, Ok(None));
    assert_eq!(told(&mut executor), [finish(1, Ok(None))]);
    executor.request(3, 4, "rover", "a", goal("")).unwrap();
    assert_eq!(told(&mut executor), [agree(4, false), finish(4, Ok(None))]);
}

#[test]
fn a_handler_that_decides_accepts_a_goal_once_for_all_its_conversations() {
    let mut executor = deciding(Policy::Reject);
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let number = started(&mut executor);
    executor.request(1, 2, "rover", "a", goal("")).unwrap();
    assert_eq!(told(&mut executor), []);
    executor.accept(number);
    assert_eq!(told(&mut executor), [agree(1, false), agree(2, false)]);
    executor.accept(number);
    assert_eq!(told(&mut executor), []);
    executor.request(2, 3, "rover", "a", goal("")).unwrap();
    assert_eq!(told(&mut executor), [agree(3, false)]);
    let failure = || Err(Failure::Failed("no power".to_owned()));
    executor.ended(3, number, failure());
    let ends = [1, 2, 3].map(|conversation| finish(conversation, failure()));
    assert_eq!(told(&mut executor), ends);
    executor.accept(number);
    executor.accept(77);
    assert_eq!(told(&mut executor), []);
}

#[test]
fn a_goal_that_its_handler_rejects_is_refused_also_when_it_is_sent_again() {
    let mut executor = deciding(Policy::Reject);
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let number = started(&mut executor);
    executor.request(0, 2, "rover", "a", goal("")).unwrap();
    let reason = "out of reach";
    executor.ended(1, number, Err(Failure::Failed(reason.to_owned())));
    assert_eq!(told(&mut executor), [refuse(1, reason), refuse(2, reason)]);
    let again = executor.request(2, 3, "rover", "a", goal(""));
    assert_eq!(again, Err(Refusal::Rejected(reason.to_owned())));
    assert_eq!(told(&mut executor), []);
    let status = executor.status_of(2, number).unwrap();
    assert_eq!(status.state, GoalState::Failed);
    // A result is an acceptance.
    executor.request(3, 4, "rover", "b", goal("")).unwrap();
    let number = started(&mut executor);
    executor.ended(4, number, Ok(None));
    assert_eq!(told(&mut executor), [agree(4, false), finish(4, Ok(None))]);
    // A reason that is too long to be stored.
    let limits = ActionLimits {
        bytes_of_client: 100,
        ..ActionLimits::default()
    };
    let mut small = Executor::new(limits);
    let options = OfferOptions {
        decides: true,
        ..OfferOptions::default()
    };
    small
        .offer(action("drive", Policy::Reject), options)
        .unwrap();
    small.request(0, 1, "rover", "a", goal("")).unwrap();
    let number = started(&mut small);
    small.ended(1, number, Err(Failure::Failed(reason.to_owned())));
    let again = small.request(2, 2, "rover", "a", goal(""));
    assert!(matches!(again, Err(Refusal::Rejected(_))), "{again:?}");
}

#[test]
fn a_goal_that_waits_for_a_handler_that_decides_is_accepted_when_it_runs() {
    let mut executor = deciding(Policy::Queue(4));
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let first = started(&mut executor);
    for (conversation, id) in [(2, "b"), (3, "c"), (4, "d")] {
        executor
            .request(0, conversation, "rover", id, goal(""))
            .unwrap();
    }
    executor.accept(first + 1);
    executor.accept(first);
    assert_eq!(told(&mut executor), [agree(1, false)]);
    // One that is cancelled in the queue is refused.
    executor.cancel(1, 3);
    assert_eq!(told(&mut executor), [refuse(3, "cancelled by the client")]);
    executor.ended(2, first, Ok(None));
    assert_eq!(told(&mut executor), [finish(1, Ok(None))]);
    executor.accept(first + 1);
    assert_eq!(told(&mut executor), [agree(2, false)]);
    executor.withdraw(3, "drive");
    assert_eq!(told(&mut executor), [refuse(4, "the action was withdrawn")]);
}

#[test]
fn a_goal_can_stop_before_its_handler_decides() {
    for cause in [
        Cause::Cancelled,
        Cause::DeadlinePassed,
        Cause::ClientGone,
        Cause::CancelledByOperator,
    ] {
        let mut executor = deciding(Policy::Reject);
        let limited = Goal {
            deadline: Some(1_000),
            ..goal("")
        };
        executor.request(0, 1, "rover", "a", limited).unwrap();
        let goal = started(&mut executor);
        match cause {
            Cause::Cancelled => executor.cancel(1, 1),
            Cause::ClientGone => executor.gone(1, 1),
            Cause::CancelledByOperator => executor.cancel_by(1, "boss", goal),
            _ => executor.handle_timeout(1_000),
        }
        assert_eq!(outputs(&mut executor), [Output::Stop { goal, cause }]);
        let abort = executor.poll_timeout().unwrap();
        executor.handle_timeout(abort);
        assert_eq!(outputs(&mut executor), [Output::Abort { goal }]);
        executor.ended(abort, goal, Err(Failure::Ended));
        let reason = match cause {
            Cause::Cancelled => "cancelled by the client",
            Cause::CancelledByOperator => "cancelled by the operator boss",
            _ => "the deadline passed",
        };
        let expected = match cause {
            Cause::ClientGone => vec![],
            _ => vec![refuse(1, reason)],
        };
        assert_eq!(told(&mut executor), expected, "{cause:?}");
        assert_eq!(executor.open(), 0);
    }
}

#[test]
fn a_cancel_a_deadline_and_a_dead_client_stop_a_goal() {
    let mut executor = with(Policy::Reject);
    for (at, cause, failure) in [
        (0, Cause::Cancelled, Failure::Cancelled),
        (10_000, Cause::DeadlinePassed, Failure::DeadlinePassed),
        (20_000, Cause::ClientGone, Failure::ClientGone),
    ] {
        let id = at.to_string();
        let limited = Goal {
            deadline: Some(1_000),
            ..goal("")
        };
        executor.request(at, 1, "rover", &id, limited).unwrap();
        let goal = started(&mut executor);
        match cause {
            Cause::Cancelled => executor.cancel(at, 1),
            Cause::ClientGone => executor.gone(at, 1),
            _ => {
                assert_eq!(executor.poll_timeout(), Some(at + 1_000));
                executor.handle_timeout(at + 1_000);
            }
        }
        assert_eq!(outputs(&mut executor), [Output::Stop { goal, cause }]);
        // The handler does not stop, so it is ended.
        let abort = executor.poll_timeout().unwrap();
        executor.handle_timeout(abort);
        assert_eq!(outputs(&mut executor), [Output::Abort { goal }]);
        executor.ended(abort, goal, Err(Failure::Ended));
        let expected = match cause {
            Cause::ClientGone => vec![],
            _ => vec![finish(1, Err(failure))],
        };
        assert_eq!(outputs(&mut executor), expected);
    }
    // A result counts although the goal was to stop.
    executor
        .request(50_000, 1, "rover", "late", goal(""))
        .unwrap();
    let goal = started(&mut executor);
    executor.cancel(50_000, 1);
    executor.ended(50_001, goal, Ok(None));
    assert_eq!(outputs(&mut executor)[1], finish(1, Ok(None)));
}

#[test]
fn an_operator_cancels_goals_of_other_clients_and_others_do_not() {
    let mut executor = with(Policy::Queue(8));
    for (conversation, client, id) in [(1, "rover", "a"), (2, "arm", "a"), (3, "arm", "b")] {
        executor
            .request(0, conversation, client, id, goal(""))
            .unwrap();
    }
    let first = started(&mut executor);
    let of = |client: &str| GoalRef::from("a").of(client);
    let refused = |agent: &str| Err(Refusal::NotOperator(agent.to_owned()));
    let unknown = |id: &str| Err(Refusal::UnknownGoal(id.to_owned()));
    for (agent, is_operator, named, found) in [
        ("rover", false, "a".into(), Ok(first)),
        ("rover", false, of("rover"), Ok(first)),
        ("rover", false, of("arm"), refused("rover")),
        ("rover", false, "b".into(), refused("rover")),
        ("rover", false, "c".into(), refused("rover")),
        ("rover", false, GoalRef::from("c").of("rover"), unknown("c")),
        ("rover", true, "a".into(), Ok(first)),
        ("boss", true, of("rover"), Ok(first)),
        ("boss", true, "b".into(), Ok(first + 2)),
        ("boss", true, of("crane"), unknown("a")),
        ("boss", true, "c".into(), unknown("c")),
        (
            "boss",
            true,
            "a".into(),
            Err(Refusal::AmbiguousGoal("a".to_owned())),
        ),
    ] {
        let result = executor.find_for(agent, is_operator, &named);
        assert_eq!(result, found, "{agent} {named:?}");
    }
    let refusal = executor.open_of("rover", false, "drive");
    assert_eq!(refusal, Err(Refusal::NotOperator("rover".to_owned())));
    let refusal = executor.open_of("boss", true, "fly");
    assert_eq!(refusal, Err(Refusal::UnknownAction("fly".to_owned())));
    let open = executor.open_of("boss", true, "drive").unwrap();
    assert_eq!(open, [first, first + 1, first + 2]);

    let by = |name: &str| Err(Failure::CancelledBy(name.to_owned()));
    executor.cancel_by(1, "boss", first + 1);
    assert_eq!(outputs(&mut executor), [finish(2, by("boss"))]);
    // The goal that has ended does not count beside one that runs.
    assert_eq!(executor.find_for("boss", true, &"a".into()), Ok(first));
    executor.cancel_by(2, "boss", first);
    executor.cancel_by(2, "chief", first);
    executor.cancel(2, 1);
    let cause = Cause::CancelledByOperator;
    assert_eq!(
        outputs(&mut executor),
        [Output::Stop { goal: first, cause }]
    );
    executor.ended(3, first, Err(Failure::Failed("stopped".to_owned())));
    let [finished, Output::Start(_)] = &outputs(&mut executor)[..] else {
        panic!()
    };
    assert_eq!(*finished, finish(1, by("boss")));
    executor.cancel_by(4, "arm", first + 2);
    let cause = Cause::Cancelled;
    let goal = first + 2;
    assert_eq!(outputs(&mut executor), [Output::Stop { goal, cause }]);
    executor.ended(4, first + 2, Ok(Some(Term::from("there"))));
    executor.cancel_by(5, "boss", first + 2);
    assert_eq!(executor.result_of(first + 2), Some(&Term::from("there")));
    assert_eq!(executor.result_of(first), None);
}

#[test]
fn the_value_of_a_progress_is_bounded() {
    let long = "x".repeat(MAX_PROGRESS + 1);
    let error = Progress::default().value(&long).unwrap_err();
    assert_eq!(error, ProgressError::TooLarge(MAX_PROGRESS + 1));
    let mut executor = with(Policy::Reject);
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let goal = started(&mut executor);
    let mut value = |value| {
        let progress = Progress {
            value: Some(Term::from(value)),
            ..Progress::fraction(0.5)
        };
        executor.progress(1, goal, progress);
        // The list of all goals could become long.
        assert_eq!(
            executor.status(1)[0].progress,
            Some(Progress::fraction(0.5))
        );
        executor.status_of(1, goal).unwrap().progress.unwrap().value
    };
    assert_eq!(value("near".to_owned()), Some(Term::from("near")));
    assert_eq!(value(long), None);
    assert_eq!(value("near".to_owned()), Some(Term::from("near")));
    executor.ended(2, goal, Ok(None));
    let ended = executor.status_of(2, goal).unwrap();
    assert_eq!(ended.progress, Some(Progress::fraction(0.5)), "not stored");
}

#[test]
fn an_orphan_goes_on_if_the_action_says_so() {
    let mut executor = Executor::new(ActionLimits::default());
    let options = OfferOptions {
        orphans: Orphans::Continue,
        ..OfferOptions::default()
    };
    executor
        .offer(action("drive", Policy::Reject), options)
        .unwrap();
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    started(&mut executor);
    executor.gone(1, 1);
    assert_eq!(outputs(&mut executor), []);
    assert_eq!(executor.open(), 1);
}

#[test]
fn progress_is_limited_and_the_last_one_is_reported() {
    let mut executor = with(Policy::Reject);
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let goal = started(&mut executor);
    let mut reports = Vec::new();
    for now in 0..1_000 {
        executor.progress(now, goal, Progress::fraction(now as f64));
        executor.handle_timeout(now);
        while let Some(output) = executor.poll_output() {
            assert_eq!(output, Output::Changed { goal });
            reports.push(now);
        }
    }
    assert_eq!(reports, [0, 100, 200, 300, 400, 500, 600, 700, 800, 900]);
    let due = executor.poll_timeout().unwrap();
    assert_eq!(due, 1_000, "the last one is still to be reported");
    executor.handle_timeout(due);
    assert_eq!(executor.poll_output(), Some(Output::Changed { goal }));
    executor.progress(2_000, goal, Progress::fraction(f64::NAN));
    let status = executor.status_of(2_000, goal).unwrap();
    assert_eq!(status.progress.unwrap().fraction, None);
}

#[test]
fn a_fence_is_checked_on_arrival_and_after_a_wait() {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    let valid = Arc::new(AtomicBool::new(true));
    let gate = Arc::clone(&valid);
    let mut executor = Executor::new(ActionLimits::default());
    let mut description = action("drive", Policy::Queue(5));
    description.fenced = true;
    let options = OfferOptions {
        gate: Some(Box::new(move |fence| {
            fence == "1.2@crane" || fence == "1.1@crane" && gate.load(Ordering::Relaxed)
        })),
        ..OfferOptions::default()
    };
    executor.offer(description, options).unwrap();
    let fenced = |fence: &str| Goal {
        fence: Some(fence.to_owned()),
        ..goal("")
    };
    let missing = executor.request(0, 1, "rover", "a", goal(""));
    assert_eq!(missing, Err(Refusal::MissingFence));
    let stale = executor.request(0, 1, "rover", "a", fenced("1.0@crane"));
    assert_eq!(stale, Err(Refusal::StaleFence("1.0@crane".to_owned())));
    executor
        .request(0, 1, "rover", "a", fenced("1.1@crane"))
        .unwrap();
    let first = started(&mut executor);
    executor
        .request(0, 2, "rover", "b", fenced("1.1@crane"))
        .unwrap();
    executor
        .request(0, 3, "rover", "c", fenced("1.1@crane"))
        .unwrap();
    valid.store(false, Ordering::Relaxed);
    // No later fence is known.
    executor.ended(10, first, Ok(None));
    let refused = |last: &str| {
        let fence = "1.1@crane".to_owned();
        Err(Failure::StaleFence(fence, last.to_owned()))
    };
    assert_eq!(
        outputs(&mut executor),
        [
            finish(1, Ok(None)),
            finish(2, refused("1.1@crane")),
            finish(3, refused("1.1@crane"))
        ]
    );

    // The next holder's goal is admitted while one of the last holder waits.
    valid.store(true, Ordering::Relaxed);
    executor
        .request(20, 4, "rover", "d", fenced("1.1@crane"))
        .unwrap();
    let fourth = started(&mut executor);
    executor
        .request(20, 5, "rover", "e", fenced("1.1@crane"))
        .unwrap();
    executor
        .request(20, 6, "sherpa", "f", fenced("1.2@crane"))
        .unwrap();
    valid.store(false, Ordering::Relaxed);
    executor.ended(30, fourth, Ok(None));
    let all = outputs(&mut executor);
    let stale = finish(5, refused("1.2@crane"));
    assert!(all.contains(&stale), "{all:?}");
    let failure = refused("1.2@crane").unwrap_err().to_string();
    assert!(failure.contains("1.1@crane") && failure.contains("1.2@crane"));
    let has_started = all.iter().any(|output| matches!(output, Output::Start(_)));
    assert!(has_started, "{all:?}");
}

#[test]
fn a_withdrawn_action_ends_its_goals_and_can_be_offered_again() {
    let mut executor = with(Policy::Queue(5));
    executor.request(0, 1, "rover", "a", goal("")).unwrap();
    let first = started(&mut executor);
    executor.request(0, 2, "rover", "b", goal("")).unwrap();
    executor.withdraw(1, "drive");
    let stop = Output::Stop {
        goal: first,
        cause: Cause::Withdrawn,
    };
    assert_eq!(
        outputs(&mut executor),
        [finish(2, Err(Failure::Withdrawn)), stop]
    );
    executor.ended(2, first, Err(Failure::Ended));
    assert_eq!(outputs(&mut executor), [finish(1, Err(Failure::Withdrawn))]);
    let again = action("drive", Policy::Reject);
    executor
        .offer(again.clone(), OfferOptions::default())
        .unwrap();
    let twice = executor.offer(again, OfferOptions::default());
    assert_eq!(twice, Err(OfferRefused::Offered("drive".to_owned())));
}

#[test]
fn descriptions_that_cannot_be_met_are_not_offered() {
    let mut executor = Executor::new(ActionLimits::default());
    let mut reserved = ActionDescription::new("drive");
    reserved
        .parameters
        .push(ParameterDescription::of::<f64>("fence"));
    let refused = executor.offer(reserved, OfferOptions::default());
    assert_eq!(refused, Err(OfferRefused::Name("fence".to_owned())));
    let reserved = ActionDescription::new("cancel-goals");
    let refused = executor.offer(reserved, OfferOptions::default());
    assert_eq!(refused, Err(OfferRefused::Name("cancel-goals".to_owned())));
    let mut wrong = ActionDescription::new("drive");
    let speed = ParameterDescription::of::<f64>("speed").range(0.0..=0.5);
    wrong.parameters.push(speed.default(&3).unwrap());
    let refused = executor.offer(wrong, OfferOptions::default());
    assert_eq!(refused, Err(OfferRefused::Default("speed".to_owned())));
}

#[test]
fn a_client_that_repeats_its_goals_takes_no_more_conversations_than_goals() {
    let limits = ActionLimits {
        goals_of_client: 5,
        ..ActionLimits::default()
    };
    let mut executor = Executor::new(limits);
    let options = OfferOptions {
        concurrency: 10,
        ..OfferOptions::default()
    };
    let drive = action("drive", Policy::Reject);
    executor.offer(drive, options).unwrap();
    let mut accepted = 0;
    for conversation in 0..20 {
        let id = (conversation / 3).to_string();
        let request = executor.request(0, conversation, "rover", &id, goal(""));
        accepted += u32::from(request.is_ok());
    }
    assert_eq!(accepted, 5);
    let other = executor.request(0, 50, "arm", "a", goal(""));
    assert_eq!(other, Ok(()));
    // A conversation that ends makes room for another one.
    executor.gone(1, 0);
    let again = executor.request(1, 60, "rover", "0", goal(""));
    assert_eq!(again, Ok(()));
}

/// A client with many names, ids and large values stays within the bounds, and does not evict the goals
/// of another client.
#[test]
fn hostile_goals_take_bounded_memory() {
    let limits = ActionLimits {
        goals: 40,
        goals_of_client: 10,
        ended: 60,
        ended_of_client: 12,
        bytes_of_client: 20_000,
        ..ActionLimits::default()
    };
    for seed in 0..4 {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut executor = Executor::new(limits.clone());
        let mut text = ActionDescription::new("say");
        text.policy = Policy::Queue(1_000);
        text.parameters
            .push(ParameterDescription::of::<String>("text"));
        let decides = seed % 2 == 1;
        let options = OfferOptions {
            decides,
            ..OfferOptions::default()
        };
        executor.offer(text, options).unwrap();
        let say = |length: usize| {
            let value = Term::from("x".repeat(length));
            Goal::of(
                "say",
                vec![Parameter {
                    name: "text".into(),
                    value,
                }],
            )
        };
        executor.request(0, 0, "honest", "mine", say(10)).unwrap();
        let mut running = vec![started(&mut executor)];
        // The honest client and the others get an agree or a refusal once, and an outcome after an agree.
        let mut agreed = HashMap::from([(0, !decides)]);
        let mut now = 0;
        for step in 1..3_000_u64 {
            now += random.u64(..20);
            let client = format!("client-{}", random.u8(..5));
            match random.u8(..6) {
                0..=2 => {
                    let id = random.u16(..).to_string();
                    let goal = say(random.usize(..4_000));
                    if executor.request(now, step, &client, &id, goal).is_ok() {
                        agreed.insert(step, false);
                    }
                }
                3 => executor.cancel(now, random.u64(1..=step)),
                4 => executor.gone(now, random.u64(1..=step)),
                _ if random.u8(..4) == 0 => {
                    if let Some(&goal) = running.last() {
                        executor.accept(goal);
                    }
                }
                _ => {
                    if let Some(goal) = running.pop() {
                        let value = Term::from("y".repeat(random.usize(..9_000)));
                        let fails = random.u8(..3) == 0;
                        let failure = Failure::Failed("no power".to_owned());
                        let outcome = if fails { Err(failure) } else { Ok(Some(value)) };
                        // The honest goal ends first.
                        let outcome = if goal == 1 { Ok(None) } else { outcome };
                        executor.ended(now, goal, outcome);
                    }
                }
            }
            executor.handle_timeout(now);
            while let Some(output) = executor.poll_output() {
                match output {
                    Output::Start(start) => running.push(start.goal),
                    Output::Abort { goal } => {
                        executor.ended(now, goal, Err(Failure::Ended));
                        running.retain(|it| *it != goal);
                    }
                    Output::Agree { conversation, .. } => {
                        let before = agreed.insert(conversation, true);
                        assert_eq!(before, Some(false), "seed {seed}");
                    }
                    Output::Refuse { conversation, .. } => {
                        assert!(decides, "seed {seed}");
                        assert_eq!(agreed.remove(&conversation), Some(false), "seed {seed}");
                    }
                    Output::Finish { conversation, .. } => {
                        assert_eq!(agreed.remove(&conversation), Some(true), "seed {seed}");
                    }
                    _ => {}
                }
            }
            assert!(executor.open() <= 40, "seed {seed}");
            assert!(executor.stored() <= 100, "seed {seed}");
            assert!(executor.stored_bytes() <= 8 * 20_000, "seed {seed}");
            assert!(running.len() <= 1, "seed {seed}");
        }
        // The honest goal ended first and was never evicted by others.
        let status = executor.find("honest", "mine");
        assert!(status.is_some(), "seed {seed}");
    }
}
