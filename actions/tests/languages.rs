//! The ontology in FIPA-SL and in JSON.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use fipa_acl::AgentId;
use fipa_actions::{
    ActionAnswer, ActionDescription, ActionLimits, Ask, Executor, Failure, Goal, GoalRef, Json,
    Language, OfferOptions, ParameterDescription, Policy, Progress, Refusal, Sl, Type, language,
};
use fipa_content::Term;

const LANGUAGES: [&dyn Language; 2] = [&Sl, &Json];

fn crex() -> AgentId {
    AgentId::new("crex").unwrap()
}

fn goal(act: &str) -> Goal {
    let text = format!("((action (agent-identifier :name crex) {act}))");
    match Sl.read_ask(text.as_bytes()).unwrap() {
        (robot, Ask::Goal(goal)) if robot == "crex" => goal,
        other => panic!("{other:?}"),
    }
}

fn asks() -> Vec<Ask> {
    let full = "(dock :target (pose :x 1.5 :y -2) :through (sequence (pose) 3) :gentle true \
                :note \"two words\" :goal \"rover 7\" :deadline 30000 :fence \"7.42@crane\")";
    vec![
        Ask::Goal(goal(full)),
        Ask::Goal(goal("(stop)")),
        Ask::Actions,
        Ask::Status,
        Ask::StatusOf("17".into()),
        Ask::StatusOf(GoalRef::from("rover 7").of("17")),
        Ask::Cancel("17".into()),
        Ask::Cancel(GoalRef::from("rover 7").of("rover")),
        Ask::CancelAll("7".to_owned()),
        Ask::CancelAll("two words".to_owned()),
    ]
}

fn refusals() -> Vec<Refusal> {
    let text = || "a (b) \"c\" 7".to_owned();
    vec![
        Refusal::Malformed(text()),
        Refusal::TooLarge(7),
        Refusal::NotThisAgent("7".to_owned()),
        Refusal::UnknownAction(text()),
        Refusal::UnknownGoal(text()),
        Refusal::AmbiguousGoal("7".to_owned()),
        Refusal::NotOperator(text()),
        Refusal::MissingParameter(text()),
        Refusal::UnknownParameter(text()),
        Refusal::RepeatedParameter(text()),
        Refusal::WrongType(text(), text(), text()),
        Refusal::WrongUnit(text(), text(), String::new()),
        Refusal::OutOfRange(text(), text(), text()),
        Refusal::MissingFence,
        Refusal::UncheckedFence,
        Refusal::StaleFence(text()),
        Refusal::Busy(text()),
        Refusal::QueueFull(text()),
        Refusal::TooManyGoals,
        Refusal::UsedId(text()),
        Refusal::Rejected(text()),
        Refusal::Rejected(String::new()),
    ]
}

fn failures() -> Vec<Failure> {
    vec![
        Failure::Failed("no (power)".to_owned()),
        Failure::Failed(String::new()),
        Failure::Cancelled,
        Failure::CancelledBy("7".to_owned()),
        Failure::ClientGone,
        Failure::DeadlinePassed,
        Failure::Preempted,
        Failure::Withdrawn,
        Failure::StaleFence(
            "1.1@cr \"a\" (ne)#bay".to_owned(),
            "1.2@crane#bay".to_owned(),
        ),
        Failure::Ended,
        Failure::Forgotten,
    ]
}

fn descriptions() -> Vec<ActionDescription> {
    let mut dock = ActionDescription::new("dock");
    dock.description = Some("Docks (gently)".to_owned());
    dock.policy = Policy::Queue(3);
    dock.fenced = true;
    dock.result = Type::Any;
    let speed = ParameterDescription::of::<Option<f64>>("speed");
    let speed = speed.unit("m/s").range(0.0..).default(&0.25).unwrap();
    dock.parameters.push(speed.described("the speed"));
    dock.parameters
        .push(ParameterDescription::of::<Vec<u8>>("through"));
    dock.parameters
        .push(ParameterDescription::of::<f64>("any").range(..));
    vec![ActionDescription::new("stop"), dock]
}

/// Returns the status of a goal with everything, and of one without.
fn status() -> Vec<fipa_actions::GoalStatus> {
    let mut executor = Executor::new(ActionLimits::default());
    let mut drive = ActionDescription::new("drive");
    drive.policy = Policy::Queue(3);
    executor.offer(drive, OfferOptions::default()).unwrap();
    for (conversation, id) in [(1, "a"), (2, "b"), (3, "c")] {
        let goal = Goal::of("drive", Vec::new());
        executor
            .request(0, conversation, "rover", id, goal)
            .unwrap();
    }
    let numbers: Vec<u64> = ["a", "b", "c"]
        .map(|id| executor.find("rover", id).unwrap())
        .into();
    let pose = Term::parse("(pose :through (sequence 1 \"7\") :x 1.5)").unwrap();
    let half = Progress::fraction(0.5).note("half");
    executor.progress(5, numbers[0], half.value(&pose.into_owned()).unwrap());
    executor.cancel_by(6, "boss", numbers[2]);
    while executor.poll_output().is_some() {}
    let all = numbers
        .iter()
        .map(|number| executor.status_of(9, *number).unwrap());
    let mut all: Vec<_> = all.collect();
    assert!(all[0].progress.as_ref().unwrap().value.is_some());
    assert_eq!(
        all[2].failure,
        Some(Failure::CancelledBy("boss".to_owned()))
    );
    all[1].result = Some(Term::from("two words"));
    all
}

#[test]
fn messages_to_robots_survive_both_languages() {
    for language in LANGUAGES {
        for ask in asks() {
            let text = language.write_ask(&crex(), &ask).unwrap();
            let read = language.read_ask(&text);
            let shown = String::from_utf8_lossy(&text);
            let (robot, mut read) = read.unwrap_or_else(|error| panic!("{shown}: {error}"));
            // JSON has no order of members.
            let mut sent = ask.clone();
            for goal in [&mut read, &mut sent] {
                if let Ask::Goal(goal) = goal {
                    goal.arguments.sort_by(|a, b| a.name.cmp(&b.name));
                }
            }
            assert_eq!((robot.as_str(), read), ("crex", sent), "{shown}");
        }
    }
}

#[test]
fn answers_survive_both_languages() {
    let to = Ask::Goal(goal("(dock :goal a)"));
    for language in LANGUAGES {
        let write =
            |to: &Ask, answer: &ActionAnswer| language.write_answer(&crex(), to, answer).unwrap();
        let value = Term::parse("(docked :at (sequence 1 2) :charge 0.5)")
            .unwrap()
            .into_owned();
        for answer in [
            ActionAnswer::Agreed { queued: true },
            ActionAnswer::Agreed { queued: false },
            ActionAnswer::Done(None),
            ActionAnswer::Done(Some(value)),
            ActionAnswer::Done(Some(Term::from("words here"))),
        ] {
            let text = write(&to, &answer);
            assert_eq!(language.read_answer(&to, &text).unwrap(), answer);
        }
        for (to, answer) in [
            (Ask::Actions, ActionAnswer::Actions(descriptions())),
            (Ask::Actions, ActionAnswer::Actions(Vec::new())),
            (Ask::Status, ActionAnswer::Status(status())),
            (Ask::StatusOf("a".into()), ActionAnswer::Status(Vec::new())),
            (Ask::StatusOf("a".into()), ActionAnswer::Status(status())),
            (Ask::Cancel("a".into()), ActionAnswer::Status(status())),
            (
                Ask::CancelAll("a".to_owned()),
                ActionAnswer::Status(Vec::new()),
            ),
        ] {
            let text = write(&to, &answer);
            let read = language.read_answer(&to, &text);
            let shown = String::from_utf8_lossy(&text);
            let read = read.unwrap_or_else(|error| panic!("{shown}: {error}"));
            assert_eq!(read, answer, "{shown}");
        }
        for (is_refusal, answer) in (refusals()
            .into_iter()
            .map(|it| (true, ActionAnswer::Refused(it))))
        .chain(
            failures()
                .into_iter()
                .map(|it| (false, ActionAnswer::Failed(it))),
        ) {
            let text = write(&to, &answer);
            let read = language.read_rejection(is_refusal, &text).unwrap();
            assert_eq!(read, answer);
        }
    }
}

#[test]
fn the_examples_of_the_book_are_what_is_written() {
    let to = Ask::Goal(goal("(dock :target (pose :x 1.5 :y 0.2) :goal c1-7)"));
    let sl = |answer: ActionAnswer| {
        let text = Sl.write_answer(&crex(), &to, &answer).unwrap();
        String::from_utf8(text).unwrap()
    };
    let robot = "(agent-identifier :name crex)";
    assert_eq!(
        sl(ActionAnswer::Agreed { queued: false }),
        format!("((action {robot} (dock :goal c1-7)) executing)")
    );
    assert_eq!(
        sl(ActionAnswer::Done(None)),
        format!("((done (action {robot} (dock :goal c1-7))))")
    );
    let refusal = Refusal::OutOfRange("speed".into(), "0 to 0.5".into(), "0.6".into());
    assert_eq!(
        sl(ActionAnswer::Refused(refusal)),
        format!("((action {robot} (dock :goal c1-7)) (out-of-range speed \"0 to 0.5\" \"0.6\"))")
    );
    let query = Sl.write_ask(&crex(), &Ask::Actions).unwrap();
    assert_eq!(
        String::from_utf8(query).unwrap(),
        format!("((all ?x (offers {robot} ?x)))")
    );
    let json = Json.write_ask(&crex(), &to).unwrap();
    assert_eq!(
        String::from_utf8(json).unwrap(),
        "{\"agent\":\"crex\",\"goal\":{\"action\":\"dock\",\"arguments\":{\"target\":{\"@\":\"pose\",\
         \"x\":1.5,\"y\":0.2}},\"id\":\"c1-7\"}}"
    );
}

#[test]
fn other_notations_are_read_and_wrong_ones_are_errors() {
    // Another variable, and a word for an action without arguments.
    let query = b"((all ?status (performs (agent-identifier :name crex) ?status)))";
    assert_eq!(Sl.read_ask(query).unwrap().1, Ask::Status);
    assert_eq!(goal("stop"), Goal::of("stop", Vec::new()));
    for wrong in [
        "((action (agent-identifier :name crex) (dock 1 2)))",
        "((action (agent-identifier :name crex) (dock :deadline -1)))",
        "((action (agent-identifier :name crex) (dock :deadline soon)))",
        "((action crex (dock)))",
        "((iota ?x (offers (agent-identifier :name crex) ?x)))",
        "((all ?x (likes (agent-identifier :name crex) ?x)))",
        "((action (agent-identifier :name crex) (cancel-goals)))",
        "((action (agent-identifier :name crex) cancel-goals))",
        "((action (agent-identifier :name crex) (cancel-goals :client a)))",
        "((action (agent-identifier :name crex) (cancel-goals :goal a :action b)))",
        "((action (agent-identifier :name crex) (cancel-goals :goal a :deadline 1)))",
        "((action (agent-identifier :name crex) (cancel-goals :action a :action b)))",
        "((action (agent-identifier :name crex) (cancel-goals :goal a :force true)))",
        "((all ?x (performs (agent-identifier :name crex) (set) ?x)))",
        "((done (action (agent-identifier :name crex) (dock))))",
        "",
        "(",
    ] {
        assert!(Sl.read_ask(wrong.as_bytes()).is_err(), "{wrong}");
    }
    for wrong in [
        "{}",
        "{\"agent\":\"crex\"}",
        "{\"agent\":\"crex\",\"query\":\"status\",\"goal\":{\"action\":\"a\"}}",
        "{\"agent\":\"crex\",\"goal\":{\"action\":\"a\",\"deadline\":-1}}",
        "{\"agent\":\"crex\",\"goal\":{\"action\":\"a\",\"arguments\":{\"x\":{\"@\":1}}}}",
        "{\"agent\":\"crex\",\"goal\":{\"action\":\"cancel-goals\"}}",
        "{\"agent\":\"crex\",\"cancel\":{}}",
        "{\"agent\":\"crex\",\"cancel\":{\"goal\":\"a\",\"action\":\"b\"}}",
        "{\"agent\":\"crex\",\"cancel\":{\"client\":\"a\"}}",
        "{\"agent\":\"crex\",\"cancel\":{\"goal\":\"a\",\"force\":true}}",
        "{\"agent\":\"crex\",\"query\":\"status\",\"client\":\"a\"}",
        "{\"agent\":\"crex\",\"query\":\"status\",\"cancel\":{\"goal\":\"a\"}}",
        "[",
    ] {
        assert!(Json.read_ask(wrong.as_bytes()).is_err(), "{wrong}");
    }
    let deep = format!("{{\"agent\":\"a\",\"goal\":{}", "[".repeat(100_000));
    assert!(Json.read_ask(deep.as_bytes()).is_err());
}

#[test]
fn languages_are_found_by_their_names() {
    for (name, expected) in [
        (None, Some("fipa-sl")),
        (Some("FIPA-SL0"), Some("fipa-sl")),
        (Some("fipa-sl2"), Some("fipa-sl")),
        (Some("JSON"), Some("json")),
        (Some("prolog"), None),
    ] {
        assert_eq!(language(name).map(Language::name), expected);
    }
}

/// Random bytes and damaged messages give an error or a message that can be written again.
#[test]
fn any_bytes_are_read_without_a_panic() {
    let mut random = fastrand::Rng::with_seed(7);
    let mut texts = Vec::new();
    for language in LANGUAGES {
        texts.extend(
            asks()
                .iter()
                .map(|ask| language.write_ask(&crex(), ask).unwrap()),
        );
    }
    for _ in 0..20_000 {
        let mut text = texts[random.usize(..texts.len())].clone();
        for _ in 0..random.usize(..4) {
            let at = random.usize(..text.len());
            match random.u8(..3) {
                0 => text[at] = random.u8(..),
                1 => drop(text.remove(at)),
                _ => text.insert(at, b"() :\"{}[]?#@0"[random.usize(..13)]),
            }
            if text.is_empty() {
                break;
            }
        }
        for language in LANGUAGES {
            if let Ok((robot, ask)) = language.read_ask(&text) {
                let robot = AgentId::new(robot).ok();
                let written = robot.and_then(|robot| language.write_ask(&robot, &ask).ok());
                if let Some(written) = written {
                    assert!(language.read_ask(&written).is_ok(), "{text:?}");
                }
            }
            let _ = language.read_answer(&Ask::Status, &text);
            let _ = language.read_rejection(true, &text);
        }
    }
}
