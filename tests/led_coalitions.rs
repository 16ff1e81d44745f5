//! Coalitions whose leader holds a lock: the leader is killed, suspended or resigns, and another member leads.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
#![allow(clippy::print_stdout, reason = "a child process reports by its output")]

mod support;

use std::io::{BufRead, BufReader};
use std::process::Stdio;
use std::time::Duration;

use fipa::blocking::Wait;
use fipa::coalitions::{CoalitionOptions, LedCoalition, Membership};
use fipa::locks::{AdmitError, OwnOptions};
use fipa::{
    Agent, Change, Config, Deliveries, Domain, FailureReason, Gateway, Kind, Outcome, Performative,
    Role,
};
use fipa_testbed::{ChildGuard, ignored_test, until_async};
use support::{config, inform, load, mark};

/// Time limit of all calls, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

/// A lease that a test waits for.
fn options() -> CoalitionOptions {
    CoalitionOptions {
        lock: OwnOptions {
            lease: Duration::from_secs(2),
            volatile: true,
            forget: true,
            ..OwnOptions::default()
        },
        ..CoalitionOptions::default()
    }
}

async fn found(agent: &Agent, name: &str, members: &[&str]) -> LedCoalition {
    let members = members.iter().copied();
    agent
        .found_coalition(name, members, options())
        .await
        .unwrap()
}

async fn until_led(domain: &Domain, coalition: &str, leader: Option<&str>) {
    let listed = || {
        let entry = domain.directory().lookup(coalition)?;
        match &entry.role {
            Role::Coalition(members) => Some(members.leader().map(ToString::to_string)),
            _ => None,
        }
    };
    let leader = leader.map(ToOwned::to_owned);
    let what = format!("{coalition} is led by {leader:?}");
    until_async(&what, || listed().as_ref() == Some(&leader)).await;
}

async fn content(agent: &Agent) -> String {
    let received = agent.receive_within(TIMEOUT).await.unwrap().unwrap();
    String::from_utf8(received.message().content().unwrap().to_vec()).unwrap()
}

fn to(sent: &Deliveries) -> Vec<&str> {
    sent.0.iter().map(|one| &*one.receiver).collect()
}

fn command(from: &Membership, agent: &Agent, to: &str) -> fipa::Message {
    let command = agent.message(Performative::Request).receiver(to);
    from.guard(command)
        .unwrap()
        .content("(fold)")
        .build()
        .unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn members_lead_in_their_order_and_refuse_the_commands_of_earlier_leaders() {
    let (here, there) = support::two(&config(&[])).await;
    let item = here.register("item").await.unwrap();
    let (crex, arm) = (
        there.register("crex").await.unwrap(),
        here.register("arm").await.unwrap(),
    );
    let hand = there.register("hand").await.unwrap();
    let robot = found(&item, "robot", &["crex", "arm", "hand", "item"]).await;
    assert!(robot.members().is_vacant());

    // The letter waits for the first leader.
    let letter = inform(&item, "robot", "first");
    let sending = tokio::spawn(async move { (item.send(letter).await, item) });
    let in_arm = arm.join_coalition("robot").unwrap();
    let in_crex = crex.join_coalition("robot").unwrap();
    let in_hand = hand.join_coalition("robot").unwrap();
    in_crex.leads().await.unwrap();
    assert_eq!(content(&crex).await, "first");
    let (sent, item) = sending.await.unwrap();
    let sent = sent.unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    assert_eq!(to(&sent), ["crex"]);
    assert!(!in_arm.state().leads);
    let refused = in_arm
        .guard(arm.message(Performative::Request))
        .unwrap_err();
    assert_eq!(refused.coalition, "robot");

    let early = command(&in_crex, &crex, "arm");
    let late = command(&in_crex, &crex, "arm");
    in_arm.check(&early).unwrap();
    in_hand.check(&early).unwrap();
    in_hand.check(&early).unwrap();
    robot.check(&early).unwrap();
    in_crex.resign();
    in_arm.leads().await.unwrap();
    until_led(&here, "robot", Some("arm")).await;
    assert!(matches!(in_arm.check(&late), Err(AdmitError::Stale { .. })));
    // This member has no command of the next leader yet.
    until_async("the late command is refused", || {
        matches!(in_hand.check(&late), Err(AdmitError::Stale { .. }))
    })
    .await;
    assert!(robot.check(&late).is_err());
    let next = command(&in_arm, &arm, "crex");
    in_crex.check(&next).unwrap();
    assert!(matches!(
        in_crex.check(&late),
        Err(AdmitError::Stale { .. })
    ));
    assert!(in_crex.check(&inform(&item, "crex", "no fence")).is_err());

    // A leader that is no member any more has no lock.
    robot.change(["crex", "item"]).await.unwrap();
    until_led(&there, "robot", Some("crex")).await;
    until_async("the arm does not lead", || !in_arm.state().leads).await;
    assert!(robot.check(&next).is_err());

    // After the end of the coalition, letters fail.
    robot.dissolve().await.unwrap();
    until_async("the end is known", || in_crex.state().members.is_none()).await;
    assert!(!in_crex.state().leads);
    let sent = item.send(inform(&item, "robot", "end")).await.unwrap();
    assert!(matches!(
        sent.0[0].outcome,
        Outcome::Failed {
            reason: FailureReason::NoSuchAgent,
            ..
        }
    ));
    here.close().await;
    there.close().await;
}

/// The founder may not have listed the leader when it resigns.
#[tokio::test(flavor = "multi_thread")]
async fn the_next_member_leads_after_a_leader_that_resigns_at_once() {
    let domain = Domain::open(&config(&[])).await.unwrap();
    let item = domain.register("item").await.unwrap();
    let (crex, arm) = (
        domain.register("crex").await.unwrap(),
        domain.register("arm").await.unwrap(),
    );
    for robot in ["robot_1", "robot_2", "robot_3"] {
        let _robot = found(&item, robot, &["crex", "arm"]).await;
        let in_crex = crex.join_coalition(robot).unwrap();
        in_crex.leads().await.unwrap();
        let in_arm = arm.join_coalition(robot).unwrap();
        in_crex.resign();
        in_arm.leads().await.unwrap();
    }
    domain.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_to_a_vacant_coalition_fails_at_its_deadline_or_with_the_coalition() {
    let domain = Domain::open(&config(&[])).await.unwrap();
    let item = domain.register("item").await.unwrap();
    let sender = domain.register("sender").await.unwrap();
    let robot = found(&item, "robot", &["crex", "item"]).await;
    let letter = inform(&sender, "robot", "late");
    let sent = sender.send_within(letter, Duration::from_millis(300)).await;
    let sent = sent.unwrap();
    assert!(matches!(
        sent.0[0].outcome,
        Outcome::Failed {
            reason: FailureReason::TimedOut,
            ..
        }
    ));
    // Letters to other agents do not wait.
    let waiting = sender.send(inform(&sender, "robot", "waits"));
    let waiting = tokio::spawn(waiting);
    let sent = sender.send(inform(&sender, "item", "goes")).await.unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    assert!(!waiting.is_finished());
    drop(robot);
    let sent = waiting.await.unwrap().unwrap();
    assert!(matches!(
        sent.0[0].outcome,
        Outcome::Failed {
            reason: FailureReason::NoSuchAgent,
            ..
        }
    ));
    domain.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn coalitions_merge_and_split_in_one_change() {
    let domain = Domain::open(&config(&[])).await.unwrap();
    let item = domain.register("item").await.unwrap();
    let (crex, arm) = (
        domain.register("crex").await.unwrap(),
        domain.register("arm").await.unwrap(),
    );
    let robot = found(&item, "robot", &["crex", "item"]).await;
    let stack = found(&item, "stack", &["arm", "camera"]).await;
    let in_robot = crex.join_coalition("robot").unwrap();
    let in_stack = arm.join_coalition("stack").unwrap();
    in_robot.leads().await.unwrap();
    in_stack.leads().await.unwrap();
    until_led(&domain, "robot", Some("crex")).await;
    until_led(&domain, "stack", Some("arm")).await;

    let mut changes = domain.directory().watch();
    robot.merge(stack).await.unwrap();
    let Some(Change::Together(together)) = changes.next().await else {
        panic!("the merge is not one change");
    };
    assert_eq!(together.len(), 2);
    assert!(domain.directory().lookup("stack").is_none());
    let names: Vec<String> = robot
        .members()
        .names()
        .iter()
        .map(ToString::to_string)
        .collect();
    assert_eq!(names, ["crex", "item", "arm", "camera"]);
    assert_eq!(robot.members().leader().map(|it| &**it), Some("crex"));
    until_async("the lock of the other one ends", || !in_stack.state().leads).await;

    // The leader is among those that part.
    let in_parting = crex.join_coalition("parting").unwrap();
    let parting = robot.split("parting", ["crex", "camera"], options());
    let parting = parting.await.unwrap();
    in_parting.leads().await.unwrap();
    until_async("the leader is listed", || {
        parting.members().leader().is_some()
    })
    .await;
    assert!(robot.members().is_vacant());
    let in_robot = arm.join_coalition("robot").unwrap();
    in_robot.leads().await.unwrap();

    let stranger = robot
        .split("other", ["stranger"], options())
        .await
        .unwrap_err();
    assert!(stranger.to_string().contains("stranger"), "{stranger}");
    let twice = item
        .found_coalition("robot", ["a"], options())
        .await
        .unwrap_err();
    assert!(twice.to_string().contains("cannot be owned"), "{twice}");
    domain.close().await;
}

/// A process with an agent that founds a coalition or takes part in it, and answers letters.
struct Process(ChildGuard);

impl Process {
    fn start(config: &str, name: &str, founds: &str) -> Self {
        let mut command = ignored_test("inside_process");
        command
            .env("FIPA_COALITION_CONFIG", config)
            .env("FIPA_COALITION_NAME", name)
            .env("FIPA_COALITION_FOUNDS", founds)
            .stdin(Stdio::null())
            .stdout(Stdio::piped());
        let mut process = ChildGuard::start(&mut command);
        let output = process.child().stdout.take().unwrap();
        let mut lines = BufReader::new(output).lines().map_while(Result::ok);
        assert!(lines.any(|line| line == "joined"), "{name}");
        Self(process)
    }
}

#[test]
#[ignore = "is run by the other tests in a process of its own"]
fn inside_process() {
    let variable = |name: &str| std::env::var(format!("FIPA_COALITION_{name}")).unwrap();
    let config = load(variable("CONFIG").lines());
    let domain = Domain::open(&config).wait().unwrap();
    let agent = domain.register(&variable("NAME")).wait().unwrap();
    let founds = variable("FOUNDS");
    if !founds.is_empty() {
        let members: Vec<&str> = founds.split(' ').collect();
        let founded = agent.found_coalition("robot", members, options());
        let _robot = founded.wait().unwrap();
        println!("\njoined");
        // Until the process is killed.
        std::thread::sleep(TIMEOUT);
        return;
    }
    let membership = agent.join_coalition("robot").unwrap();
    println!("\njoined");
    loop {
        let received = agent.receive().wait().unwrap();
        // The founder lists the leader, and this agent may get the letter before the grant.
        membership.leads().wait().unwrap();
        let reply = agent.reply(received.message(), Performative::Inform);
        agent.send(reply).wait().unwrap();
    }
}

/// Sends a letter to the coalition, and returns the agent that answers.
async fn who_leads(agent: &Agent) -> String {
    let question = agent.message(Performative::QueryRef).receiver("robot");
    let question = question.conversation_id(mark()).content("who");
    let sent = agent.send(question).await.unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    let answer = agent.receive_within(TIMEOUT).await.unwrap().unwrap();
    answer.message().sender().unwrap().name().to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_next_member_leads_when_the_leader_is_killed_or_suspended() {
    let set = format!("domain=led-{}\ndiscovery.mdns=false", mark());
    let domain = Domain::open(&load(set.lines())).await.unwrap();
    let operator = domain.register("operator").await.unwrap();
    let founder = Process::start(&set, "item", "a b c item");
    let mut a = Process::start(&set, "a", "");
    until_led(&domain, "robot", Some("a")).await;
    let b = Process::start(&set, "b", "");
    let c = Process::start(&set, "c", "");
    assert_eq!(who_leads(&operator).await, "a");

    a.0.kill();
    until_async("the end of the leader is known", || {
        domain.directory().known("a").is_none()
    })
    .await;
    // This letter waits, or reaches the next leader.
    assert_eq!(who_leads(&operator).await, "b");
    until_led(&domain, "robot", Some("b")).await;

    b.0.signal("-STOP");
    until_led(&domain, "robot", Some("c")).await;
    assert_eq!(who_leads(&operator).await, "c");
    b.0.signal("-CONT");
    assert_eq!(who_leads(&operator).await, "c");

    // With the founder, the coalition ends.
    drop(founder);
    until_async("the coalition is dissolved", || {
        domain.directory().lookup("robot").is_none()
    })
    .await;
    drop((b, c));
    domain.close().await;
}

async fn host(peer: Option<&Gateway>) -> (Gateway, Domain, String) {
    let mark = mark();
    let mut set = vec![
        format!("domain=led-{mark}"),
        format!("mts.name=gateway-{mark}"),
        "discovery.mdns=false".to_owned(),
    ];
    if let Some(peer) = peer {
        let mut locations = peer.locations().into_iter();
        let tcp = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
        let address = tcp.address();
        set.push(format!(
            "discovery.static={{ peer = [\"tcp://{address}\"] }}"
        ));
    }
    let config: Config = load(set.clone());
    let gateway = Gateway::open(&config).await.unwrap();
    (
        gateway,
        Domain::open(&config).await.unwrap(),
        set.join("\n"),
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn a_member_of_another_host_leads_when_the_leader_is_killed() {
    let (near_gateway, near, near_set) = host(None).await;
    let (_far_gateway, far, far_set) = host(Some(&near_gateway)).await;
    let operator = far.register("operator").await.unwrap();
    let _item = Process::start(&near_set, "item", "a b item");
    until_led(&far, "robot", None).await;
    let mut a = Process::start(&near_set, "a", "");
    until_led(&far, "robot", Some("a")).await;
    assert_eq!(who_leads(&operator).await, "a");
    let _b = Process::start(&far_set, "b", "");
    until_async("the member of the other host is known", || {
        near.directory().lookup("b").is_some()
    })
    .await;
    a.0.kill();
    until_led(&near, "robot", Some("b")).await;
    until_led(&far, "robot", Some("b")).await;
    assert_eq!(who_leads(&operator).await, "b");
    drop((_item, _b));
    near.close().await;
    far.close().await;
}
