//! Actions between agents: lists, goals, progress, cancels, refusals, and robots and clients that die.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[path = "../../examples/actions.rs"]
#[allow(dead_code, reason = "the test has a domain of its own")]
mod example;
mod process;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use fipa::actions::{
    Action, ActionError, Execution, Failure, Goal, GoalRef, GoalState, OfferError,
    ParameterDescription, Policy, Progress, Refusal, Term, Type,
};
use fipa::blocking::{Wait, on_thread};
use fipa::protocol::{DialogueError, Reply, Task};
use fipa::topics::Topic;
use fipa::{AgentId, Domain, FailureReason, Performative};
use fipa_testbed::until_async;
use process::{endless, forever};
use serde::{Deserialize, Serialize};
use support::{config, load, mark, two};
use tokio::sync::Semaphore;

/// Time limit of all waits, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

#[test]
#[ignore = "started by the other tests"]
fn process_entry() {
    process::run();
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename = "pose")]
struct Pose {
    x: f64,
    y: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Dock {
    target: Pose,
    speed: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename = "docked")]
struct Docked {
    charge: f64,
}

fn dock() -> Action {
    let speed = ParameterDescription::of::<f64>("speed").unit("m/s");
    Action::new("dock")
        .described("Docks")
        .parameter::<Pose>("target", "m; frame crex/base")
        .with(speed.range(0.0..=0.5).default(&0.25).unwrap())
        .result::<Docked>()
}

fn target() -> Dock {
    Dock {
        target: Pose { x: 1.5, y: 0.2 },
        speed: None,
    }
}

/// Returns the settings of a host that no other test uses, for several processes.
fn host() -> Vec<String> {
    vec![
        format!("domain=actions-{}", mark()),
        "discovery.mdns=false".to_owned(),
        "mts.deadline=30s".to_owned(),
    ]
}

fn patient() -> fipa::Config {
    config(&["mts.deadline=30s"])
}

fn crex() -> AgentId {
    AgentId::new("crex").unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn actions_are_listed_invoked_with_progress_and_cancelled() {
    let (here, there) = two(&patient()).await;
    let robot = here.register("crex").await.unwrap();
    let step = Arc::new(Semaphore::new(0));
    let steps = Arc::clone(&step);
    let offered = robot.offer(dock(), move |goal: Dock, run: Execution| {
        let steps = Arc::clone(&steps);
        async move {
            assert_eq!(goal.target, Pose { x: 1.5, y: 0.2 });
            assert_eq!(goal.speed, Some(0.25), "the default");
            for part in [0.25, 0.5] {
                run.progress(Progress::fraction(part).note("near"));
                steps.acquire().await.unwrap().forget();
            }
            Ok::<_, String>(Docked { charge: 0.8 })
        }
    });
    let _offers = (
        offered.unwrap(),
        robot
            .offer(endless("drive"), |(): (), run| forever(run))
            .unwrap(),
        robot
            .offer(endless("blink"), |(): (), run| forever(run))
            .unwrap(),
    );

    let rover = there.register("rover").await.unwrap();
    for crex in [rover.robot(crex()), rover.robot(crex()).in_json()] {
        let actions = crex.actions().await.unwrap();
        let names: Vec<&str> = actions.iter().map(|it| &*it.name).collect();
        assert_eq!(names, ["blink", "dock", "drive"]);
        let [pose, speed] = &actions[1].parameters[..] else {
            panic!("{actions:?}");
        };
        assert_eq!(pose.value_type.to_string(), "pose(x: number, y: number)");
        assert_eq!(pose.unit.as_deref(), Some("m; frame crex/base"));
        assert_eq!(speed.range.unwrap().max, Some(0.5));
        assert_eq!(speed.default.as_ref().unwrap().to_string(), "0.25");
        assert_eq!(actions[1].description.as_deref(), Some("Docks"));
        assert!(matches!(&actions[1].result, Type::Structure { name, .. } if name == "docked"));

        let goal = crex.invoke("dock", &target()).await.unwrap();
        let mut progress = goal.progress().await.unwrap();
        let mut parts = Vec::new();
        let last = loop {
            // A future that is dropped loses no status.
            let status = tokio::select! {
                biased;
                status = progress.next() => status.unwrap().unwrap(),
                () = std::future::ready(()) => {
                    tokio::task::yield_now().await;
                    continue;
                }
            };
            if status.state.is_over() {
                break status;
            }
            let Some(now) = status.progress else { continue };
            assert_eq!(now.note.as_deref(), Some("near"));
            let part = now.fraction.unwrap();
            if parts.last() != Some(&part) {
                parts.push(part);
                step.add_permits(1);
            }
        };
        assert_eq!(parts, [0.25, 0.5]);
        assert_eq!(last.state, GoalState::Done);
        assert_eq!(progress.next().await.unwrap(), None);
        let docked: Docked = goal.result().await.unwrap();
        assert_eq!(docked, Docked { charge: 0.8 });

        let mut goal = crex.invoke("drive", &()).await.unwrap();
        let running = crex.status().await.unwrap();
        assert_eq!(running.len(), 1);
        assert_eq!(
            (&*running[0].action, &*running[0].client),
            ("drive", "rover")
        );
        assert_eq!(running[0].goal, goal.id());
        assert!(goal.cancel(TIMEOUT).await.unwrap());
        assert_eq!(crex.status().await.unwrap(), []);
    }
}

/// An agent serves all requests first, and then offers an action and publishes a topic.
#[tokio::test(flavor = "multi_thread")]
async fn goals_and_subscriptions_do_not_go_to_the_server_of_their_protocol() {
    let (here, there) = two(&patient()).await;
    let robot = here.register("crex").await.unwrap();
    let answer = |_: Task| async { Ok::<_, Infallible>(Reply::Inform("served".into())) };
    let _requests = robot.serve("fipa-request", answer).unwrap();
    let _subscriptions = robot.serve("fipa-subscribe", answer).unwrap();
    let _offer = robot
        .offer(Action::new("blink"), |(): (), _: Execution| async {
            Ok::<_, String>(())
        })
        .unwrap();
    let topic = robot.publisher(Topic::new("pose").latched(1)).unwrap();
    topic.publish("(0 0)").await;

    let rover = there.register("rover").await.unwrap();
    rover
        .robot(crex())
        .invoke("blink", &())
        .await
        .unwrap()
        .result::<()>()
        .await
        .unwrap();
    let lift = rover.message(Performative::Request).receiver("crex");
    let mut lift = rover.request(lift.content("lift"), TIMEOUT).await.unwrap();
    assert_eq!(lift.result().await.unwrap().content().unwrap(), "served");
    let pose = rover.message(Performative::Subscribe).receiver("crex");
    let mut pose = rover
        .subscribe(pose.content("pose"), TIMEOUT)
        .await
        .unwrap();
    assert_eq!(pose.next().await.unwrap().content().unwrap(), "(0 0)");
}

#[tokio::test(flavor = "multi_thread")]
async fn refusals_are_typed_and_wrong_goals_reach_no_handler() {
    let (here, there) = two(&patient()).await;
    let robot = here.register("crex").await.unwrap();
    let runs = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&runs);
    let _offer = robot
        .offer(dock(), move |_: Dock, _: Execution| {
            counted.fetch_add(1, Ordering::Relaxed);
            async { Ok::<_, String>(Docked { charge: 0.8 }) }
        })
        .unwrap();
    // The handler takes fewer values than the description says.
    let small = Action::new("count").parameter::<i64>("number", "");
    let counted = Arc::clone(&runs);
    #[derive(Serialize, Deserialize)]
    struct Count {
        number: u8,
    }
    let _count = robot
        .offer(small, move |_: Count, _: Execution| {
            counted.fetch_add(1, Ordering::Relaxed);
            async { Ok::<(), String>(()) }
        })
        .unwrap();
    let rover = there.register("rover").await.unwrap();
    let wrong_target = |x: &str| format!("(dock :target (pose :x {x} :y 0.2))");
    let text = |text: &str| text.to_owned();
    for crex in [rover.robot(crex()), rover.robot(crex()).in_json()] {
        for (goal, expected) in [
            (
                wrong_target("far"),
                Refusal::WrongType(text("target.x"), text("number"), text("string")),
            ),
            (
                text("(dock :target (pose :x 1))"),
                Refusal::WrongType(text("target.y"), text("number"), text("nothing")),
            ),
            (text("(dock)"), Refusal::MissingParameter(text("target"))),
            (
                text("(dock :target (pose :x 1 :y 1) :speed 0.75)"),
                Refusal::OutOfRange(text("speed"), text("0 to 0.5"), text("0.75")),
            ),
            (
                text("(dock :target (pose :x 1 :y 1) :speed (quantity :value 1 :unit km/h))"),
                Refusal::WrongUnit(text("speed"), text("m/s"), text("km/h")),
            ),
            (
                text("(dock :target (pose :x 1 :y 1) :fence \"1.1@crane\")"),
                Refusal::UncheckedFence,
            ),
            (text("(fly :height 3)"), Refusal::UnknownAction(text("fly"))),
        ] {
            let goal = parsed(&goal);
            match crex.send(goal.clone()).await {
                Err(ActionError::Refused(refusal)) => assert_eq!(refusal, expected, "{goal:?}"),
                other => panic!("{goal:?}: {other:?}"),
            }
        }
        match crex.invoke("count", &Count16 { number: 300 }).await {
            Err(ActionError::Refused(Refusal::WrongType(parameter, ..))) => {
                assert_eq!(parameter, "number");
            }
            other => panic!("{other:?}"),
        }
    }
    // Contents that are no goals at all.
    for (language, content) in [
        ("fipa-sl", "((("),
        ("json", "{"),
        ("fipa-sl", ""),
        ("klingon", "x"),
    ] {
        let request = rover
            .message(Performative::Request)
            .receiver(crex())
            .ontology(fipa::actions::ONTOLOGY)
            .language(language)
            .content(content);
        let mut request = rover.request(request, TIMEOUT).await.unwrap();
        let refused = request.result().await;
        assert!(
            matches!(refused, Err(DialogueError::Refused(_))),
            "{refused:?}"
        );
    }
    assert_eq!(runs.load(Ordering::Relaxed), 0);
    rover
        .robot(crex())
        .invoke("count", &Count16 { number: 3 })
        .await
        .unwrap()
        .result::<()>()
        .await
        .unwrap();
    assert_eq!(runs.load(Ordering::Relaxed), 1);
}

#[derive(Serialize)]
struct Count16 {
    number: u16,
}

/// Reads a goal in SL, with its fence.
fn parsed(act: &str) -> Goal {
    let term = Term::parse(act.as_bytes()).unwrap().into_owned();
    let term = term.as_functional().unwrap();
    let mut goal = Goal::of(&*term.symbol, Vec::new());
    for parameter in term.parameters() {
        match &*parameter.name {
            "fence" => goal.fence = parameter.value.as_str().map(str::to_owned),
            _ => goal.arguments.push(parameter.clone()),
        }
    }
    goal
}

#[tokio::test(flavor = "multi_thread")]
async fn a_goal_that_is_sent_again_runs_once() {
    let (here, there) = two(&patient()).await;
    let robot = here.register("crex").await.unwrap();
    let runs = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&runs);
    let go = Arc::new(Semaphore::new(0));
    let gate = Arc::clone(&go);
    let _offer = robot
        .offer(dock(), move |_: Dock, _: Execution| {
            let (gate, counted) = (Arc::clone(&gate), Arc::clone(&counted));
            async move {
                let run = counted.fetch_add(1, Ordering::Relaxed);
                gate.acquire().await.unwrap().forget();
                Ok::<_, String>(Docked { charge: run as f64 })
            }
        })
        .unwrap();
    let rover = there.register("rover").await.unwrap();
    let crex = rover.robot(crex());
    let first = crex.invoke("dock", &target()).await.unwrap();
    let goal = first.goal().clone();
    let second = crex.send(goal.clone()).await.unwrap();
    go.add_permits(1);
    for handle in [first, second] {
        let docked: Docked = handle.result().await.unwrap();
        assert_eq!(docked.charge, 0.0);
    }
    let third = crex.send(goal.clone()).await.unwrap();
    let docked: Docked = third.result().await.unwrap();
    assert_eq!(docked.charge, 0.0);
    assert_eq!(runs.load(Ordering::Relaxed), 1);
    let other = Goal {
        arguments: crex
            .goal(
                "dock",
                &Dock {
                    speed: Some(0.1),
                    ..target()
                },
            )
            .unwrap()
            .arguments,
        ..goal
    };
    let used = crex.send(other).await;
    assert!(
        matches!(used, Err(ActionError::Refused(Refusal::UsedId(_)))),
        "{used:?}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn deadlines_policies_and_withdrawals_end_goals() {
    let (here, there) = two(&patient()).await;
    let robot = here.register("crex").await.unwrap();
    let drive = endless("drive").policy(Policy::Preempt);
    let offer = robot.offer(drive, |(): (), run| forever(run)).unwrap();
    let rover = there.register("rover").await.unwrap();
    let crex = rover.robot(crex());
    let mut goal = crex.goal("drive", &()).unwrap();
    goal.deadline = Some(50);
    let late = crex.send(goal).await.unwrap().result::<()>().await;
    assert!(
        matches!(late, Err(ActionError::Failed(Failure::DeadlinePassed))),
        "{late:?}"
    );

    let first = crex.invoke("drive", &()).await.unwrap();
    let second = crex.invoke("drive", &()).await.unwrap();
    let preempted = first.result::<()>().await;
    assert!(
        matches!(preempted, Err(ActionError::Failed(Failure::Preempted))),
        "{preempted:?}"
    );
    let mut updates = crex.watch_status().await.unwrap();
    assert_eq!(updates.next().await.unwrap().len(), 1);
    drop(offer);
    let withdrawn = second.result::<()>().await;
    assert!(
        matches!(withdrawn, Err(ActionError::Failed(Failure::Withdrawn))),
        "{withdrawn:?}"
    );
    while !updates.next().await.unwrap().is_empty() {}
    updates.cancel(TIMEOUT).await.unwrap();
    assert_eq!(crex.actions().await.unwrap(), []);
    let unknown = crex.invoke("drive", &()).await;
    assert!(matches!(
        unknown,
        Err(ActionError::Refused(Refusal::UnknownAction(_)))
    ));

    // A handler that fails, and one that panics.
    let _fails = robot
        .offer(Action::new("fail"), |(): (), _: Execution| async {
            Err::<(), _>("no power")
        })
        .unwrap();
    let failed = crex.invoke("fail", &()).await.unwrap().result::<()>().await;
    let power = Failure::Failed("no power".to_owned());
    assert!(matches!(failed, Err(ActionError::Failed(failure)) if failure == power));
    let undescribed = robot.offer(Action::new("turn"), |_: Dock, run| forever(run));
    assert!(matches!(undescribed, Err(OfferError::Undescribed(name)) if name == "target"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_handler_that_decides_accepts_or_rejects_goals() {
    let (here, there) = two(&patient()).await;
    let robot = here.register("crex").await.unwrap();
    let go = Arc::new(Semaphore::new(0));
    let (gate, asked) = (Arc::clone(&go), Arc::new(Semaphore::new(0)));
    let asks = Arc::clone(&asked);
    let reach = Action::new("reach").parameter::<f64>("distance", "m");
    let _offers = (
        robot
            .offer(
                reach.decided_by_handler(),
                move |goal: BTreeMap<String, f64>, run: Execution| {
                    let (gate, asks) = (Arc::clone(&gate), Arc::clone(&asks));
                    async move {
                        asks.add_permits(1);
                        if goal["distance"] > 0.8 {
                            return Err("out of reach");
                        }
                        tokio::select! {
                            permit = gate.acquire() => permit.unwrap().forget(),
                            _ = run.stopped() => return Err("stopped"),
                        }
                        run.accept();
                        gate.acquire().await.unwrap().forget();
                        Ok(goal["distance"])
                    }
                },
            )
            .unwrap(),
        robot
            .offer(
                Action::new("look").decided_by_handler(),
                |(): (), _: Execution| async { Ok::<_, String>("a crate") },
            )
            .unwrap(),
        robot
            .offer(
                Action::new("jump").decided_by_handler(),
                |(): (), run: Execution| async move {
                    run.stopped().await;
                    Ok::<_, String>(2)
                },
            )
            .unwrap(),
    );
    let rover = there.register("rover").await.unwrap();
    let crex = rover.robot(crex());
    let reach = |distance: f64| {
        let arguments = BTreeMap::from([("distance", distance)]);
        crex.goal("reach", &arguments).unwrap()
    };
    for crex in [crex.clone(), crex.clone().in_json()] {
        let far = reach(0.9);
        for _ in 0..2 {
            let refused = crex.send(far.clone()).await;
            let Err(ActionError::Refused(Refusal::Rejected(reason))) = refused else {
                panic!("{refused:?}");
            };
            assert_eq!(reason, "out of reach");
        }
        asked.acquire().await.unwrap().forget();
        // The client waits until the handler accepts.
        let mut near = crex.propose(reach(0.5)).await.unwrap();
        asked.acquire().await.unwrap().forget();
        let early = tokio::time::timeout(Duration::from_millis(50), near.accepted());
        assert!(early.await.is_err());
        go.add_permits(1);
        near.accepted().await.unwrap();
        go.add_permits(1);
        assert_eq!(near.result::<f64>().await.unwrap(), 0.5);
        // A result accepts the goal.
        let look = crex.invoke("look", &()).await.unwrap();
        assert_eq!(look.result::<String>().await.unwrap(), "a crate");
    }
    // A cancel comes before the decision.
    let mut near = crex.propose(reach(0.6)).await.unwrap();
    asked.acquire().await.unwrap().forget();
    assert!(near.cancel(TIMEOUT).await.unwrap());
    let status = crex.status_of(near.id()).await.unwrap();
    assert_eq!(status.state, GoalState::Failed);
    let mut jump = crex.propose(crex.goal("jump", &()).unwrap()).await.unwrap();
    assert!(!jump.cancel(TIMEOUT).await.unwrap(), "it is done");
    jump.accepted().await.unwrap();
    assert_eq!(jump.result::<i64>().await.unwrap(), 2);
    // The time of the goal is over.
    let limited = Goal {
        deadline: Some(50),
        ..reach(0.6)
    };
    let late = crex.send(limited).await;
    let Err(ActionError::Refused(Refusal::Rejected(reason))) = late else {
        panic!("{late:?}");
    };
    assert_eq!(reason, "the deadline passed");
}

/// The time for an answer is shorter than the decision. The robot reports that it has the goal.
#[tokio::test(flavor = "multi_thread")]
async fn a_client_waits_for_a_late_decision() {
    let (here, there) = two(&config(&["mts.deadline=3s"])).await;
    let robot = here.register("crex").await.unwrap();
    let slow = Action::new("plan").decided_by_handler();
    let _offer = robot
        .offer(slow, |(): (), run: Execution| async move {
            tokio::time::sleep(Duration::from_secs(7)).await;
            run.accept();
            Ok::<_, String>(())
        })
        .unwrap();
    let rover = there.register("rover").await.unwrap();
    let plan = rover.robot(crex()).invoke("plan", &()).await.unwrap();
    plan.result::<()>().await.unwrap();
}

/// The robot answers the goal and the question for its status at the same time, when the goal is over.
#[tokio::test(flavor = "multi_thread")]
async fn a_decision_that_crosses_the_question_for_it_counts() {
    let mut host = host();
    host.push("mts.deadline=6s".to_owned());
    let domain = Domain::open(&load(host.clone())).await.unwrap();
    let _robot = process::start("robot", &host);
    let rover = domain.register("rover").await.unwrap();
    let robot = rover.robot(AgentId::new("robot").unwrap());
    let think = robot.invoke("think", &()).await.unwrap();
    think.result::<()>().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn an_answer_that_arrives_while_the_robot_is_asked_for_the_status_counts() {
    let (here, there) = two(&config(&["mts.deadline=5s"])).await;
    let (rover, robot) = (
        here.register("rover").await.unwrap(),
        there.register("crex").await.unwrap(),
    );
    let crex = rover.robot(crex());
    let answering = async {
        let goal = robot.receive().await.unwrap();
        let question = robot.receive().await.unwrap();
        assert_eq!(question.message().protocol(), Some("fipa-query"));
        let agree = robot.reply(goal.message(), Performative::Agree);
        let sent = robot.send(agree.build().unwrap()).await.unwrap();
        assert!(sent.all_succeeded(), "{sent}");
        // The question is not answered.
    };
    let both = async { tokio::join!(crex.invoke("jump", &()), answering) };
    let (goal, ()) = tokio::time::timeout(TIMEOUT, both).await.unwrap();
    assert!(goal.is_ok(), "{goal:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_that_is_killed_ends_the_handle() {
    let host = host();
    let domain = Domain::open(&load(host.clone())).await.unwrap();
    let mut robot = process::start("robot", &host);
    let rover = domain.register("rover").await.unwrap();
    let robot_id = AgentId::new("robot").unwrap();
    let goal = rover.robot(robot_id).invoke("drive", &()).await.unwrap();
    let mut progress = goal.progress().await.unwrap();
    let first = progress.next().await.unwrap().unwrap();
    assert_eq!(first.state, GoalState::Executing);
    let waiting = tokio::spawn(async move {
        loop {
            if let Err(error) = progress.next().await {
                return error;
            }
        }
    });
    robot.kill();
    let is_gone = |error: &ActionError| matches!(error, ActionError::Dialogue(DialogueError::Gone { agent }) if agent == "robot");
    let ended = tokio::time::timeout(TIMEOUT, goal.result::<()>())
        .await
        .unwrap();
    assert!(ended.as_ref().is_err_and(is_gone), "{ended:?}");
    let ended = tokio::time::timeout(TIMEOUT, waiting)
        .await
        .unwrap()
        .unwrap();
    assert!(is_gone(&ended), "{ended:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_goal_of_a_killed_client_is_cancelled_unless_the_action_says_otherwise() {
    let host = host();
    let domain = Domain::open(&load(host.clone())).await.unwrap();
    let rover = domain.register("rover").await.unwrap();
    let stopped = Arc::new(Semaphore::new(0));
    let mut offers = Vec::new();
    for name in ["drive", "orphan"] {
        let stopped = Arc::clone(&stopped);
        let offered = rover.offer(endless(name), move |(): (), run: Execution| {
            let stopped = Arc::clone(&stopped);
            async move {
                let cause = run.stopped().await;
                stopped.add_permits(1);
                Err::<(), _>(format!("{cause:?}"))
            }
        });
        offers.push(offered.unwrap());
    }
    let mut client = process::start("client", &host);
    let observer = domain.register("observer").await.unwrap();
    let robot = observer.robot(AgentId::new("rover").unwrap());
    let mut updates = robot.watch_status().await.unwrap();
    assert_eq!(updates.next().await.unwrap().len(), 2);
    client.kill();
    let cancelled = tokio::time::timeout(TIMEOUT, stopped.acquire()).await;
    cancelled.unwrap().unwrap().forget();
    loop {
        let running = updates.next().await.unwrap();
        if running.len() == 1 {
            assert_eq!(running[0].action, "orphan");
            break;
        }
    }
    assert_eq!(stopped.available_permits(), 0);
    offers.clear();
    until_async("the orphan stops", || stopped.available_permits() == 1).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn access_rules_can_name_actions() {
    let host = host();
    let lax = Domain::open(&load(host.clone())).await.unwrap();
    let rules = "access.deny={ \"rover\" = [\"crex action=drive\"] }".to_owned();
    let strict = load(host.into_iter().chain([rules]));
    let strict = Domain::open(&strict).await.unwrap();
    let robot = strict.register("crex").await.unwrap();
    let runs = Arc::new(AtomicUsize::new(0));
    let mut offers = Vec::new();
    for name in ["drive", "stop"] {
        let runs = Arc::clone(&runs);
        let offered = robot.offer(Action::new(name), move |(): (), _: Execution| {
            runs.fetch_add(1, Ordering::Relaxed);
            async { Ok::<(), String>(()) }
        });
        offers.push(offered.unwrap());
    }
    let (rover, arm) = (
        lax.register("rover").await.unwrap(),
        lax.register("arm").await.unwrap(),
    );
    for from in [rover.robot(crex()), rover.robot(crex()).in_json()] {
        let denied = from.invoke("drive", &()).await;
        assert!(
            matches!(
                denied,
                Err(ActionError::Dialogue(DialogueError::NotDelivered {
                    reason: FailureReason::Refused,
                    ..
                }))
            ),
            "{denied:?}"
        );
        let stop = from.invoke("stop", &()).await.unwrap();
        stop.result::<()>().await.unwrap();
    }
    let other = arm.robot(crex()).invoke("drive", &()).await.unwrap();
    other.result::<()>().await.unwrap();
    assert_eq!(runs.load(Ordering::Relaxed), 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_operator_cancels_goals_of_others_and_reads_their_results() {
    let host = host();
    let lax = Domain::open(&load(host.clone())).await.unwrap();
    let rules = "access.operators=boss,desk_[0-9]+".to_owned();
    let strict = load(host.iter().cloned().chain([rules]));
    let strict = Domain::open(&strict).await.unwrap();
    let robot = strict.register("crex").await.unwrap();
    let at = Pose { x: 1.5, y: 0.2 };
    let near = at.clone();
    let drive = Action::new("drive").concurrency(8);
    let drive = robot.offer(drive, move |(): (), run: Execution| {
        run.progress(Progress::fraction(0.5).value(&near).unwrap());
        forever(run)
    });
    let count = robot.offer(Action::new("count"), |(): (), _: Execution| async {
        Ok::<u8, String>(7)
    });
    let _offers = (drive.unwrap(), count.unwrap());
    let (rover, arm, boss) = (
        lax.register("rover").await.unwrap(),
        lax.register("arm").await.unwrap(),
        lax.register("boss").await.unwrap(),
    );
    let is_refused = |error: &ActionError, expected: &Refusal| matches!(error, ActionError::Refused(refusal) if refusal == expected);
    let no_operator = Refusal::NotOperator("arm".to_owned());
    for (client, stranger, operator) in [
        (rover.robot(crex()), arm.robot(crex()), boss.robot(crex())),
        (
            rover.robot(crex()).in_json(),
            arm.robot(crex()).in_json(),
            boss.robot(crex()).in_json(),
        ),
    ] {
        let mut goal = client.invoke("drive", &()).await.unwrap();
        let mut progress = goal.progress().await.unwrap();
        let value = loop {
            let status = progress.next().await.unwrap().unwrap();
            if let Some(value) = status.progress.and_then(|it| it.value) {
                break value;
            }
        };
        assert_eq!(value.read::<Pose>().unwrap(), at);

        let id = goal.id().to_owned();
        let of_rover = GoalRef::from(&*id).of("rover");
        for error in [
            stranger.cancel(&*id).await.unwrap_err(),
            stranger.cancel(of_rover.clone()).await.unwrap_err(),
            stranger.status_of(of_rover.clone()).await.unwrap_err(),
            stranger.cancel_all("drive").await.unwrap_err(),
        ] {
            assert!(is_refused(&error, &no_operator), "{error:?}");
        }
        let status = operator.status_of(&*id).await.unwrap();
        assert_eq!(status.state, GoalState::Executing);
        assert_eq!((&*status.client, &*status.action), ("rover", "drive"));
        assert_eq!(status.progress.unwrap().value, Some(value));

        let by_boss = Failure::CancelledBy("boss".to_owned());
        let cancelled = operator.cancel(of_rover).await.unwrap();
        assert_eq!(cancelled.state, GoalState::Failed);
        assert_eq!(cancelled.failure.as_ref(), Some(&by_boss));
        let told = goal.outcome().await.unwrap_err();
        assert!(
            matches!(&told, ActionError::Failed(failure) if *failure == by_boss),
            "{told:?}"
        );
        assert_eq!(operator.cancel(&*id).await.unwrap().failure, Some(by_boss));
        let unknown = operator.cancel("no such goal").await.unwrap_err();
        let expected = Refusal::UnknownGoal("no such goal".to_owned());
        assert!(is_refused(&unknown, &expected), "{unknown:?}");

        let goals = [
            client.invoke("drive", &()).await.unwrap(),
            stranger.invoke("drive", &()).await.unwrap(),
        ];
        let cancelled = operator.cancel_all("drive").await.unwrap();
        let clients: Vec<_> = cancelled.iter().map(|goal| &*goal.client).collect();
        assert_eq!(clients, ["rover", "arm"]);
        assert_eq!(operator.cancel_all("drive").await.unwrap(), []);
        drop(goals);

        // A client needs no rule for its own goal.
        let goal = client.invoke("drive", &()).await.unwrap();
        let cancelled = client.cancel(goal.id()).await.unwrap();
        assert_eq!(cancelled.failure, Some(Failure::Cancelled));
        let goal = client.invoke("count", &()).await.unwrap();
        let id = goal.id().to_owned();
        assert_eq!(goal.result::<u8>().await.unwrap(), 7);
        for from in [&client, &operator] {
            let done = from.status_of(&*id).await.unwrap();
            assert_eq!(done.state, GoalState::Done);
            assert_eq!(done.result, Some(Term::parse("7").unwrap()));
        }
    }

    // The name in the message alone makes no operator.
    let content = "((action (agent-identifier :name crex) (cancel-goals :action drive)))";
    let forged = arm
        .message(Performative::Request)
        .sender(AgentId::new("boss").unwrap())
        .receiver(crex())
        .protocol("fipa-request")
        .conversation_id("forged")
        .ontology(fipa::actions::ONTOLOGY)
        .content(content);
    let goal = rover.robot(crex()).invoke("drive", &()).await.unwrap();
    let sent = arm.send(forged).await;
    assert!(!sent.is_ok_and(|it| it.all_succeeded()), "a forged cancel");
    let status = boss.robot(crex()).status_of(goal.id()).await.unwrap();
    assert_eq!(status.state, GoalState::Executing);

    let reloaded = strict.reload(&load(host)).unwrap();
    assert_eq!(reloaded.applied, ["access.operators"]);
    let error = boss.robot(crex()).cancel(goal.id()).await.unwrap_err();
    let expected = Refusal::NotOperator("boss".to_owned());
    assert!(is_refused(&error, &expected), "{error:?}");
}

#[cfg(feature = "protocols")]
#[tokio::test(flavor = "multi_thread")]
async fn a_goal_runs_only_with_the_fence_of_the_live_lock() {
    use fipa::locks::{Admission, OwnOptions};
    let (here, there) = two(&patient()).await;
    let robot = here.register("crex").await.unwrap();
    let crane = here.register("crane").await.unwrap();
    let bay = crane
        .own(
            "bay",
            OwnOptions {
                forget: true,
                ..OwnOptions::default()
            },
        )
        .await
        .unwrap();
    let gate = here.register("gate").await.unwrap();
    let other = gate
        .own(
            "door",
            OwnOptions {
                forget: true,
                ..OwnOptions::default()
            },
        )
        .await
        .unwrap();
    let ran = Arc::new(AtomicUsize::new(0));
    let counter = Arc::clone(&ran);
    let action = Action::new("enter").fenced_by(Admission::new("crane", "bay").unwrap());
    let _offer = robot
        .offer(action, move |(): (), _run: Execution| {
            counter.fetch_add(1, Ordering::Relaxed);
            async { Ok::<_, String>(()) }
        })
        .unwrap();

    let rover = there.register("rover").await.unwrap();
    let crex = rover.robot(crex());
    assert!(crex.actions().await.unwrap()[0].fenced);
    let with = |fence: Option<&fipa::locks::Fence>| {
        let mut goal = crex.goal("enter", &()).unwrap();
        goal.fence = fence.map(ToString::to_string);
        goal
    };
    let refusal = |sent: Result<_, ActionError>| match sent.map(drop) {
        Err(ActionError::Refused(reason)) => reason,
        other => panic!("{other:?}"),
    };
    let lock = rover.lock_within("bay", TIMEOUT).await.unwrap();
    let first = lock.fence().unwrap().clone();
    let mut goal = crex.send(with(Some(&first))).await.unwrap();
    assert_eq!(goal.outcome().await.unwrap(), None);
    lock.release();
    let lock = rover.lock_within("bay", TIMEOUT).await.unwrap();
    let second = lock.fence().unwrap().clone();
    let mut goal = crex.send(with(Some(&second))).await.unwrap();
    assert_eq!(goal.outcome().await.unwrap(), None);
    // The reason names the fence.
    let stale = refusal(crex.send(with(Some(&first))).await);
    assert_eq!(stale, Refusal::StaleFence(first.to_string()));
    assert!(stale.to_string().contains(&first.to_string()), "{stale}");
    assert_eq!(refusal(crex.send(with(None)).await), Refusal::MissingFence);
    let door = rover.lock_within("door", TIMEOUT).await.unwrap();
    let foreign = refusal(crex.send(with(door.fence())).await);
    assert!(matches!(foreign, Refusal::StaleFence(_)), "{foreign}");
    let mut invented = with(None);
    invented.fence = Some("no fence".to_owned());
    assert!(matches!(
        refusal(crex.send(invented).await),
        Refusal::StaleFence(_)
    ));
    assert_eq!(ran.load(Ordering::Relaxed), 2);
    drop((lock, door));
    bay.release().await;
    other.release().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn actions_of_a_robot_on_another_host_are_invoked_and_cancelled() {
    use fipa::{Gateway, Kind};
    let host = |set: &str| config(&["mts.deadline=30s", set]);
    let far_config = host("mts.transports=shm,unix,tcp");
    let far_gateway = Gateway::open(&far_config).await.unwrap();
    let locations = far_gateway.locations();
    let at = locations.iter().find(|it| it.kind() == Kind::Tcp).unwrap();
    let far = Domain::open(&far_config).await.unwrap();
    let peer = format!(
        "discovery.static={{ \"far\" = [\"tcp://{}\"] }}",
        at.address()
    );
    let near_config = host(&peer);
    let near_gateway = Gateway::open(&near_config).await.unwrap();
    let near = Domain::open(&near_config).await.unwrap();

    let robot = far.register("crex").await.unwrap();
    let offered = robot.offer(dock(), |goal: Dock, run: Execution| async move {
        run.progress(Progress::fraction(goal.target.x));
        Ok::<_, String>(Docked { charge: 0.8 })
    });
    let drive = robot.offer(endless("drive"), |(): (), run| forever(run));
    let _offers = (offered.unwrap(), drive.unwrap());
    let rover = near.register("rover").await.unwrap();
    for (domain, name) in [(&near, "crex"), (&far, "rover")] {
        until_async(name, || domain.directory().lookup(name).is_some()).await;
    }
    let crex = rover.robot(crex());
    let names: Vec<String> = crex
        .actions()
        .await
        .unwrap()
        .into_iter()
        .map(|it| it.name)
        .collect();
    assert_eq!(names, ["dock", "drive"]);
    let goal = crex.invoke("dock", &target()).await.unwrap();
    assert_eq!(
        goal.result::<Docked>().await.unwrap(),
        Docked { charge: 0.8 }
    );
    let wrong = crex.invoke("dock", &()).await.map(drop);
    let refused = matches!(
        wrong,
        Err(ActionError::Refused(Refusal::MissingParameter(_)))
    );
    assert!(refused, "{wrong:?}");
    let mut goal = crex.invoke("drive", &()).await.unwrap();
    assert!(goal.cancel(TIMEOUT).await.unwrap());
    assert_eq!(crex.status().await.unwrap(), []);
    near.close().await;
    near_gateway.close().await;
    far.close().await;
    far_gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_example_works() {
    let (here, there) = two(&patient()).await;
    let robot = here.register("crex").await.unwrap();
    let offers = example::offer(&robot).unwrap();
    assert_eq!(offers.len(), 3);
    let rover = there.register("rover").await.unwrap();
    example::client(&rover.robot(crex())).await.unwrap();
}

#[test]
fn handlers_that_block_run_on_threads() {
    let config = patient();
    let open = || Domain::open(&config).wait().unwrap();
    let (here, there) = (open(), open());
    let robot = here.register("crex").wait().unwrap();
    let _dock = robot
        .offer(dock(), |goal: Dock, run: Execution| {
            on_thread(move || {
                run.progress(Progress::fraction(0.5));
                Ok::<_, String>(Docked {
                    charge: goal.target.x,
                })
            })
        })
        .unwrap();
    let _drive = robot
        .offer(Action::new("drive"), |(): (), run: Execution| {
            on_thread(move || {
                while run.stop_cause().is_none() {
                    std::thread::sleep(Duration::from_millis(5));
                }
                Err::<(), _>("stopped")
            })
        })
        .unwrap();
    let _jump = robot
        .offer(Action::new("jump"), |(): (), _: Execution| {
            on_thread(|| -> Result<(), String> { panic!("too high") })
        })
        .unwrap();
    let rover = there.register("rover").wait().unwrap();
    let crex = rover.robot(crex());
    let mut drive = crex.invoke("drive", &()).wait().unwrap();
    let docked = crex.invoke("dock", &target()).wait().unwrap();
    let docked: Docked = docked.result().wait().unwrap();
    assert_eq!(docked.charge, 1.5);
    assert!(drive.cancel(TIMEOUT).wait().unwrap());
    let jump = crex.invoke("jump", &()).wait().unwrap();
    let jumped = jump.result::<()>().wait().unwrap_err().to_string();
    assert!(jumped.contains("panicked: too high"), "{jumped}");
    assert_eq!(crex.status().wait().unwrap(), []);
}
