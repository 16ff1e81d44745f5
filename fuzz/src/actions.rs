//! Goals of malicious clients and of an honest one, in random bytes of both content languages.
//!
//! * An admitted goal has arguments of the described types and ranges.
//! * Each admitted goal starts at most once. Each of its conversations gets either at most one refusal, or an agree and
//!   then at most one outcome.
//! * The goals and their bytes stay within their bounds.
//! * The goal of the honest client is not changed by others, also not by cancels.

use std::collections::{HashMap, HashSet};

use fipa_acl::AgentId;
use fipa_actions::{
    ActionDescription, ActionLimits, Ask, Executor, Failure, Goal, Json, Language, OfferOptions,
    Orphans, Output, ParameterDescription, Policy, Progress, Sl,
};
use fipa_content::Term;

use crate::input::Input;

const HONEST: &str = "crane";
const CLIENTS: [&str; 3] = ["rover", "arm", "probe"];
const LANGUAGES: [&dyn Language; 2] = [&Sl, &Json];
const ACTS: [&str; 9] = [
    "(drive :speed 0.25)",
    "(drive :speed (quantity :value 0.1 :unit m/s) :goal a :deadline 100)",
    "(say :text \"some words\" :goal b)",
    "(say :text x :fence \"1.2@crane\")",
    "(hold)",
    "(fly :height 3)",
    "(cancel-goals :goal a)",
    "(cancel-goals :goal mine :client crane)",
    "(cancel-goals :action hold)",
];

/// The last output that a conversation got.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Told {
    Nothing,
    Agreed,
    Ended,
}

fn offered() -> [(ActionDescription, OfferOptions); 3] {
    let mut drive = ActionDescription::new("drive");
    drive.policy = Policy::Preempt;
    let speed = ParameterDescription::of::<f64>("speed").unit("m/s");
    drive.parameters.push(speed.range(0.0..=0.5));
    let mut say = ActionDescription::new("say");
    say.policy = Policy::Queue(4);
    say.parameters
        .push(ParameterDescription::of::<String>("text"));
    let fenced = OfferOptions {
        gate: Some(Box::new(|fence| fence.starts_with('1'))),
        orphans: Orphans::Continue,
        decides: true,
        ..OfferOptions::default()
    };
    let several = OfferOptions {
        concurrency: 3,
        ..OfferOptions::default()
    };
    [
        (drive, OfferOptions::default()),
        (say, fenced),
        (ActionDescription::new("hold"), several),
    ]
}

/// Returns a message to the robot, with some of its bytes replaced.
fn content(input: &mut Input<'_>, language: &dyn Language) -> Vec<u8> {
    let robot = AgentId::new("crex").expect("a name");
    let act = input.one_of(&ACTS);
    let sl = format!("((action (agent-identifier :name crex) {act}))");
    let (_, ask) = Sl.read_ask(sl.as_bytes()).expect("an act");
    let mut content = language.write_ask(&robot, &ask).expect("a content");
    for _ in 0..input.below(4) {
        let place = usize::from(u16::from_le_bytes([input.byte(), input.byte()]));
        let place = place % (content.len() + 1);
        let (remove, insert) = (input.below(12), input.bytes(40));
        let end = (place + remove).min(content.len());
        drop(content.splice(place..end, insert.iter().copied()));
    }
    content
}

/// Runs an executor with the goals and events that the bytes encode.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let limits = ActionLimits {
        goals: 12,
        goals_of_client: 6,
        ended: 12,
        ended_of_client: 4,
        bytes_of_client: 2_000,
        ..ActionLimits::default()
    };
    let mut executor = Executor::new(limits.clone());
    for (description, options) in offered() {
        executor.offer(description, options).expect("an action");
    }
    let honest = Goal::of("hold", Vec::new());
    executor
        .request(0, 0, HONEST, "mine", honest)
        .expect("a goal");
    let (mut now, mut conversation) = (0_u64, 0_u64);
    let mut running = Vec::new();
    let mut open = HashMap::from([(0, Told::Nothing)]);
    let mut started = HashSet::new();
    loop {
        executor.handle_timeout(now);
        while let Some(output) = executor.poll_output() {
            match output {
                Output::Start(start) => {
                    assert!(started.insert(start.goal), "started twice");
                    if start.action == "drive" {
                        let [speed] = &start.arguments[..] else {
                            panic!("{start:?}")
                        };
                        let Term::Number(speed) = &speed.value else {
                            panic!("{start:?}")
                        };
                        assert!((0.0..=0.5).contains(&speed.as_f64().expect("a number")));
                    }
                    if start.action == "say" {
                        assert!(matches!(start.arguments[0].value, Term::String(_)));
                    }
                    if &*start.client != HONEST {
                        running.push(start.goal);
                    }
                }
                Output::Abort { goal } => {
                    executor.ended(now, goal, Err(Failure::Ended));
                    running.retain(|it| *it != goal);
                }
                Output::Agree { conversation, .. } => {
                    let before = open.insert(conversation, Told::Agreed);
                    assert_eq!(before, Some(Told::Nothing));
                }
                Output::Refuse { conversation, .. } => {
                    let before = open.insert(conversation, Told::Ended);
                    assert_eq!(before, Some(Told::Nothing));
                }
                Output::Finish { conversation, .. } => {
                    let before = open.insert(conversation, Told::Ended);
                    assert_eq!(before, Some(Told::Agreed));
                }
                _ => {}
            }
        }
        assert!(executor.open() <= limits.goals);
        assert!(executor.stored() <= limits.goals + limits.ended);
        assert!(executor.stored_bytes() <= 8 * limits.bytes_of_client);
        assert!(executor.poll_timeout().is_none_or(|due| due > now));
        let mine = executor.find(HONEST, "mine").expect("the honest goal");
        let mine = executor.status_of(now, mine).expect("the honest goal");
        assert!(!mine.state.is_over(), "{mine:?}");
        if input.is_empty() {
            return;
        }
        match input.below(8) {
            0 => {
                now += u64::from(input.byte()) * 50;
                executor.handle_timeout(now);
            }
            1 => executor.cancel(now, 1 + input.number() % 64),
            2 => executor.gone(now, 1 + input.number() % 64),
            3 | 4 => {
                if let Some(goal) = running.pop() {
                    let length = usize::from(input.byte()) * 8;
                    let result = match input.below(3) {
                        0 => Ok(None),
                        1 => Ok(Some(Term::from("r".repeat(length)))),
                        _ => Err(Failure::Failed("e".repeat(length))),
                    };
                    executor.ended(now, goal, result);
                }
            }
            5 => {
                if let Some(goal) = running.last() {
                    if input.below(2) == 0 {
                        executor.accept(*goal);
                    }
                    let part = f64::from_bits(input.u64());
                    executor.progress(now, *goal, Progress::fraction(part));
                }
            }
            _ => {
                let language = LANGUAGES[input.below(2)];
                let content = content(&mut input, language);
                let client = input.one_of(&CLIENTS);
                // No client is an operator, so each finds its own goals only.
                let goal = match language.read_ask(&content) {
                    Ok((_, Ask::Goal(goal))) => goal,
                    Ok((_, Ask::Cancel(named))) => {
                        if let Ok(goal) = executor.find_for(client, false, &named) {
                            let found = executor.status_of(now, goal).expect("a goal");
                            assert_eq!((&*found.client, found.goal), (client, named.id));
                            executor.cancel_by(now, client, goal);
                        }
                        continue;
                    }
                    Ok((_, Ask::CancelAll(action))) => {
                        assert!(executor.open_of(client, false, &action).is_err());
                        continue;
                    }
                    _ => continue,
                };
                conversation += 1;
                let id = goal.id.clone().unwrap_or_else(|| conversation.to_string());
                let requested = executor.request(now, conversation, client, &id, goal);
                open.insert(
                    conversation,
                    match requested {
                        Ok(()) => Told::Nothing,
                        Err(_) => Told::Ended,
                    },
                );
            }
        }
    }
}
