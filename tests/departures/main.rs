//! Partners that leave or die, and hosts that become silent, during a conversation. The partners are
//! processes of their own, which the tests kill with SIGKILL or stop with SIGSTOP.
//!
//! Every call has a timeout of one minute, its own or that of `patient`. A call that waits for it fails the
//! test with another error.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod process;
#[path = "../support/mod.rs"]
mod support;

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa::actions::{ActionError, GoalHandle, GoalState, Robot};
use fipa::blocking::Wait;
use fipa::protocol::{DialogueError, PartnerEvent, Reachability};
use fipa::{Agent, AgentId, Domain, Gateway, Kind, Message, MessageBuilder, Performative};
use process::Process;
use rustix::process::Signal;

/// Time limit of all calls, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

#[test]
#[ignore = "started by the other tests"]
fn process_entry() {
    process::run();
}

/// Waits for a result of a call that has no timeout of its own.
async fn patient<T>(call: impl Future<Output = T>) -> T {
    let ended = tokio::time::timeout(TIMEOUT, call).await;
    ended.expect("the call has not ended")
}

/// Returns the settings of a host that no other test uses.
fn host(set: &[&str]) -> Vec<String> {
    let mark = support::mark();
    let own = [
        format!("domain=gone-{mark}"),
        format!("mts.name=gateway-{mark}"),
        "discovery.mdns=false".to_owned(),
        "mts.deadline=1min".to_owned(),
    ];
    let set = set.iter().map(|setting| (*setting).to_owned());
    own.into_iter().chain(set).collect()
}

fn to(agent: &Agent, act: Performative, receiver: &str) -> MessageBuilder {
    agent.message(act).receiver(AgentId::new(receiver).unwrap())
}

fn text(message: &Message) -> &str {
    std::str::from_utf8(message.content().unwrap()).unwrap()
}

/// Requires that this result is the end of an agent.
#[track_caller]
fn gone<T: std::fmt::Debug>(result: &Result<T, DialogueError>, name: &str) {
    match result {
        Err(DialogueError::Gone { agent }) if agent == name => {}
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_partner_ends_every_call_that_waits_for_it() {
    let host = host(&[]);
    let domain = Domain::open(&support::load(host.clone())).await.unwrap();
    let rover = Arc::new(domain.register("rover").await.unwrap());
    let mut arm = Process::start("arm", &host);
    let ask = |act| to(&rover, act, "arm");

    let request = rover.request(ask(Performative::Request), TIMEOUT).await;
    let mut request = request.unwrap();
    assert!(request.agreed().await.unwrap());
    let query = rover.query(ask(Performative::QueryRef), TIMEOUT).await;
    let when = rover
        .protocols()
        .request_when(ask(Performative::RequestWhen), TIMEOUT);
    let mut when = when.await.unwrap();
    let charge = rover.subscribe(ask(Performative::Subscribe), TIMEOUT).await;
    let mut charge = charge.unwrap();
    assert_eq!(text(&patient(charge.next()).await.unwrap()), "first");
    let proxy = rover
        .protocols()
        .brokering(ask(Performative::Proxy), TIMEOUT)
        .await;
    let mut proxied = proxy.unwrap();
    let arms = [AgentId::new("arm").unwrap()];
    let call = rover.message(Performative::Cfp);
    let mut net = rover.contract_net(call, &arms, TIMEOUT).await.unwrap();
    let bid = net.bids().proposals[0].clone();
    let opening = rover.message(Performative::Inform);
    let mut auction = rover
        .protocols()
        .english_auction(opening, &arms)
        .await
        .unwrap();
    let to_cancel = rover.request(ask(Performative::Request), TIMEOUT).await;
    let mut to_cancel = to_cancel.unwrap();
    assert!(to_cancel.agreed().await.unwrap());

    let proposing = Arc::clone(&rover);
    let proposed = tokio::spawn(async move {
        let proposal = to(&proposing, Performative::Propose, "arm");
        let decided = proposing.protocols().propose(proposal, TIMEOUT).await;
        (decided, Instant::now())
    });
    let awarded = tokio::spawn(async move {
        let awarded = net.award(&[bid], "", TIMEOUT).await;
        (awarded, Instant::now())
    });
    let called = tokio::spawn(async move {
        let bids = auction.call("10", TIMEOUT).await;
        (bids, Instant::now(), auction)
    });
    let notified = tokio::spawn(async move {
        let notified = patient(charge.next()).await;
        (notified, Instant::now(), charge)
    });
    let answered = tokio::spawn(async move {
        let answered = proxied.next(TIMEOUT).await;
        (answered, Instant::now())
    });
    let informed = tokio::spawn(async move {
        let result = request.result().await;
        (result, Instant::now())
    });
    arm.got(&["propose", "accept-proposal", "call", "subscribe", "proxy"]);
    arm.kill();
    let killed = Instant::now();

    let mut times = Vec::new();
    let (result, at) = informed.await.unwrap();
    gone(&result, "arm");
    times.push(("request", at));
    let (decided, at) = proposed.await.unwrap();
    gone(&decided, "arm");
    times.push(("propose", at));
    let (awarded, at) = awarded.await.unwrap();
    let awarded = awarded.unwrap();
    assert_eq!(awarded[0].agent, "arm");
    gone(&awarded[0].result, "arm");
    times.push(("award", at));
    let (bids, at, auction) = called.await.unwrap();
    let bids = bids.unwrap();
    assert_eq!(
        (&bids.gone[..], &bids.silent[..]),
        (&["arm".to_owned()][..], &["arm".to_owned()][..])
    );
    assert!(auction.bidders().is_empty());
    times.push(("auction", at));
    let (notified, at, mut charge) = notified.await.unwrap();
    gone(&notified, "arm");
    times.push(("subscription", at));
    // A later call ends at once, too.
    gone(&patient(charge.next()).await, "arm");
    let (answered, at) = answered.await.unwrap();
    gone(&answered, "arm");
    times.push(("proxied", at));
    gone(&query.unwrap().result().await, "arm");
    gone(&when.result().await, "arm");
    assert!(to_cancel.cancel(TIMEOUT).await.is_err());
    for (call, at) in times {
        println!(
            "{call}: {:?} after the kill",
            at.saturating_duration_since(killed)
        );
    }
}

#[test]
fn a_killed_partner_ends_a_blocking_call() {
    let host = host(&[]);
    let domain = Domain::open(&support::load(host.clone())).wait().unwrap();
    let rover = domain.register("rover").wait().unwrap();
    let mut arm = Process::start("arm", &host);
    let receiver = AgentId::new("arm").unwrap();
    let lift = rover
        .message(Performative::Request)
        .receiver(receiver.clone());
    let mut request = rover.request(lift, TIMEOUT).wait().unwrap();
    assert!(request.agreed().wait().unwrap());
    let charge = rover.message(Performative::Subscribe).receiver(receiver);
    let mut charge = rover.subscribe(charge, TIMEOUT).wait().unwrap();
    assert_eq!(text(&charge.next().wait().unwrap()), "first");
    let waiting = std::thread::spawn(move || charge.next().wait());
    arm.kill();
    gone(&request.result().wait(), "arm");
    gone(&waiting.join().unwrap(), "arm");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_participant_learns_that_its_initiator_was_killed() {
    let host = host(&[]);
    let domain = Domain::open(&support::load(host.clone())).await.unwrap();
    let rover = domain.register("rover").await.unwrap();
    let mut starter = Process::start("starter", &host);
    let first = patient(rover.receive()).await.unwrap();
    let mut task = rover.take_part(&first).unwrap();
    task.agree("").await.unwrap();
    starter.kill();
    gone(&patient(task.cancelled()).await, "starter");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_that_leaves_or_registers_again_is_gone() {
    let host = host(&[]);
    let (here, there) = (support::load(host.clone()), support::load(host.clone()));
    let here = Domain::open(&here).await.unwrap();
    let there = Domain::open(&there).await.unwrap();
    let rover = here.register("rover").await.unwrap();
    for registers_again in [false, true] {
        let arm = there.register("arm").await.unwrap();
        let request = to(&rover, Performative::Request, "arm");
        let mut request = rover.request(request, TIMEOUT).await.unwrap();
        let first = patient(arm.receive()).await.unwrap();
        let mut task = arm.take_part(&first).unwrap();
        task.agree("").await.unwrap();
        assert!(request.agreed().await.unwrap());
        // The agent is deregistered before its task is dropped.
        drop(arm);
        let again = match registers_again {
            true => Some(there.register("arm").await.unwrap()),
            false => None,
        };
        gone(&request.result().await, "arm");
        drop((again, task));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_answer_that_precedes_the_end_of_its_sender_counts() {
    let host = host(&[]);
    let here = Domain::open(&support::load(host.clone())).await.unwrap();
    let there = Domain::open(&support::load(host.clone())).await.unwrap();
    let rover = here.register("rover").await.unwrap();
    for _ in 0..20 {
        let arm = there.register("arm").await.unwrap();
        let request = to(&rover, Performative::Request, "arm");
        let mut request = rover.request(request, TIMEOUT).await.unwrap();
        let first = patient(arm.receive()).await.unwrap().into_message();
        let done = arm.reply(&first, Performative::Inform).content("done");
        arm.send(done.build().unwrap()).await.unwrap();
        drop(arm);
        assert_eq!(text(&request.result().await.unwrap()), "done");
    }
}

/// Two hosts: a gateway and a domain of this process, and a gateway process of another host.
struct TwoHosts {
    _near: Gateway,
    domain: Domain,
    far: Process,
    there: Vec<String>,
}

impl Drop for TwoHosts {
    /// Removes the files of the other host: all of its processes are killed.
    fn drop(&mut self) {
        self.far.kill();
        let there = support::load(self.there.clone());
        let opened = std::thread::spawn(move || Domain::open(&there).wait().is_ok());
        assert!(opened.join().unwrap_or(false), "files are left");
    }
}

impl TwoHosts {
    async fn start(set: &[&str]) -> Self {
        let there = host(set);
        let far = Process::start("gateway", &there);
        let address = far.address.clone().unwrap();
        let knows = format!("discovery.static={{ far = [\"tcp://{address}\"] }}");
        let here = support::load(host(&[set, &[&knows]].concat()));
        Self {
            _near: Gateway::open(&here).await.unwrap(),
            domain: Domain::open(&here).await.unwrap(),
            far,
            there,
        }
    }

    /// Starts hosts of which the other one opens the connection, so that its gateway may start again.
    async fn start_dialed(set: &[&str]) -> Self {
        let here = support::load(host(set));
        let near = Gateway::open(&here).await.unwrap();
        let mut locations = near.locations().into_iter();
        let location = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
        let knows = format!(
            "discovery.static={{near=[\"tcp://{}\"]}}",
            location.address()
        );
        let there = host(&[set, &[&knows]].concat());
        Self {
            _near: near,
            domain: Domain::open(&here).await.unwrap(),
            far: Process::start("gateway", &there),
            there,
        }
    }

    /// Starts an agent on the other host, and waits until this host knows it.
    async fn agent(&self, name: &str) -> Process {
        let process = Process::start(name, &self.there);
        let started = Instant::now();
        while self.domain.directory().lookup(name).is_none() {
            assert!(started.elapsed() < TIMEOUT, "{name} was not found");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        process
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_partner_on_another_host_ends_the_call() {
    let hosts = TwoHosts::start(&[]).await;
    let mut arm = hosts.agent("arm").await;
    let rover = hosts.domain.register("rover").await.unwrap();
    let request = to(&rover, Performative::Request, "arm");
    let mut request = rover.request(request, TIMEOUT).await.unwrap();
    assert!(request.agreed().await.unwrap());
    let charge = to(&rover, Performative::Subscribe, "arm");
    let mut charge = rover.subscribe(charge, TIMEOUT).await.unwrap();
    assert_eq!(text(&patient(charge.next()).await.unwrap()), "first");
    let waiting = tokio::spawn(async move { patient(charge.next()).await });
    let mut partners = rover.watch_partners();
    partners.add("arm");
    arm.kill();
    let killed = Instant::now();
    gone(&request.result().await, "arm");
    println!("request: {:?} after the kill", killed.elapsed());
    gone(&waiting.await.unwrap(), "arm");
    let event = patient(partners.next()).await;
    let agent = "arm".to_owned();
    assert_eq!(event, PartnerEvent::Gone { agent });
    // The letters about the agent never reach the application.
    drop(partners);
    assert!(rover.try_receive().unwrap().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_silent_host_is_reported_and_the_call_goes_on_when_it_returns() {
    let hosts = TwoHosts::start(&["monitor.heartbeat=1s"]).await;
    let mut arm = hosts.agent("arm").await;
    let rover = Arc::new(hosts.domain.register("rover").await.unwrap());
    let request = to(&rover, Performative::Request, "arm");
    let mut request = rover.request(request, TIMEOUT).await.unwrap();
    assert!(request.agreed().await.unwrap());
    let mut reachability = request.reachability();
    assert!(reachability.unreachable().is_empty());
    let short = to(&rover, Performative::Request, "arm");
    let mut short = rover.request(short, Duration::from_secs(5)).await.unwrap();
    let charge = to(&rover, Performative::Subscribe, "arm");
    let mut charge = rover.subscribe(charge, TIMEOUT).await.unwrap();
    assert_eq!(text(&patient(charge.next()).await.unwrap()), "first");

    hosts.far.signal(Signal::STOP);
    let result = tokio::spawn(async move { request.result().await });
    let impatient = tokio::spawn(async move { short.result().await });
    until_reachable(&mut reachability, false).await;
    let silent = reachability.unreachable();
    assert_eq!(silent[0].agent, "arm");
    assert!(silent[0].since <= Instant::now());
    let silence = patient(charge.next()).await;
    let is_silence =
        matches!(&silence, Err(DialogueError::Unreachable { agent, .. }) if agent == "arm");
    assert!(is_silence, "{silence:?}");
    // The timeout of this request ends first.
    let impatient = impatient.await.unwrap();
    let is_silence = matches!(impatient, Err(DialogueError::Unreachable { .. }));
    assert!(is_silence, "{impatient:?}");
    assert!(!result.is_finished());

    hosts.far.signal(Signal::CONT);
    until_reachable(&mut reachability, true).await;
    arm.finish();
    assert_eq!(text(&result.await.unwrap().unwrap()), "done");
    assert_eq!(text(&patient(charge.next()).await.unwrap()), "second");
}

/// Waits until all partners are reachable, or one is not. A busy machine is silent for a moment, too.
async fn until_reachable(reachability: &mut Reachability, wanted: bool) {
    while reachability.unreachable().is_empty() != wanted {
        assert!(patient(reachability.changed()).await);
    }
}

/// A robot takes four requests for one goal.
#[tokio::test(flavor = "multi_thread")]
async fn a_goal_goes_on_although_its_host_is_silent_again_and_again() {
    let hosts = TwoHosts::start(&["monitor.heartbeat=1s"]).await;
    let mut process = hosts.agent("robot").await;
    let rover = Arc::new(hosts.domain.register("rover").await.unwrap());
    let robot = rover.robot(AgentId::new("robot").unwrap());
    let goal = robot.invoke("hold", &()).await.unwrap();
    let mut progress = goal.progress().await.unwrap();
    let all_progress = async {
        let mut last = None;
        while let Some(status) = patient(progress.next()).await.unwrap() {
            last = Some(status.state);
        }
        last
    };
    let mut reachability = goal.reachability();
    let id = goal.id().to_owned();
    let watched = async {
        for _ in 0..5 {
            hosts.far.signal(Signal::STOP);
            until_reachable(&mut reachability, false).await;
            hosts.far.signal(Signal::CONT);
            until_reachable(&mut reachability, true).await;
            let status = robot.status_of(id.as_str()).await.unwrap();
            assert_eq!(status.state, GoalState::Executing);
        }
        process.finish();
    };
    let (result, (), last) = tokio::join!(goal.result::<String>(), watched, all_progress);
    assert_eq!(result.unwrap(), "done");
    assert_eq!(last, Some(GoalState::Done));
    let unread = rover.try_receive().unwrap();
    assert!(unread.is_none(), "{unread:?}");
}

/// Repeats a call until it succeeds: the first connection may need longer than a letter has.
async fn repeated<T>(mut call: impl AsyncFnMut() -> Result<T, ActionError>) -> T {
    let succeeded = async {
        loop {
            if let Ok(result) = call().await {
                break result;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    patient(succeeded).await
}

/// Sends the goal of an action that goes on.
async fn held<'a>(robot: &Robot<'a>) -> GoalHandle<'a> {
    let goal = robot.goal("hold", &()).unwrap();
    repeated(async || robot.send(goal.clone()).await).await
}

/// Letters of the robot fail at their deadline, which is shorter than the silence.
#[tokio::test(flavor = "multi_thread")]
async fn progress_goes_on_after_letters_were_not_delivered() {
    let hosts = TwoHosts::start(&["monitor.heartbeat=1s", "mts.deadline=1s"]).await;
    let mut process = hosts.agent("robot").await;
    let rover = hosts.domain.register("rover").await.unwrap();
    let robot = rover.robot(AgentId::new("robot").unwrap());
    let goal = held(&robot).await;
    let mut progress = repeated(async || goal.progress().await).await;
    let mut step = async || {
        let status = patient(progress.next()).await.unwrap().unwrap();
        let note = status.progress.and_then(|it| it.note).unwrap();
        note.parse::<u64>().unwrap()
    };
    step().await;
    hosts.far.signal(Signal::STOP);
    tokio::time::sleep(Duration::from_secs(4)).await;
    hosts.far.signal(Signal::CONT);
    let returned = Instant::now();
    // Only a later letter than those that failed has it.
    while step().await < 45 {
        assert!(returned.elapsed() < TIMEOUT, "no further progress");
    }
    process.finish();
    assert_eq!(goal.result::<String>().await.unwrap(), "done");
}

/// Without a gateway, the host of the robot knows no agent of another host.
#[tokio::test(flavor = "multi_thread")]
async fn notifications_go_on_after_the_gateway_of_the_robot_was_away() {
    let mut hosts = TwoHosts::start_dialed(&[]).await;
    let _process = hosts.agent("robot").await;
    let rover = hosts.domain.register("rover").await.unwrap();
    let robot = rover.robot(AgentId::new("robot").unwrap());
    let goal = robot.invoke("hold", &()).await.unwrap();
    let mut progress = goal.progress().await.unwrap();
    let mut step = async || {
        let status = patient(progress.next()).await.unwrap().unwrap();
        let note = status.progress.and_then(|it| it.note).unwrap();
        note.parse::<u64>().unwrap()
    };
    let subscribe = to(&rover, Performative::Subscribe, "robot").content("count");
    let mut counts = rover.subscribe(subscribe, TIMEOUT).await.unwrap();
    let mut count = async || loop {
        match patient(counts.next()).await {
            Err(DialogueError::Unreachable { .. }) => {}
            number => {
                let number = number.unwrap();
                assert!(!number.is_restart(), "the subscription has ended");
                break text(&number).parse::<u64>().unwrap();
            }
        }
    };
    let before = (step().await, count().await);
    hosts.far.kill();
    // The robot sends notifications meanwhile.
    tokio::time::sleep(Duration::from_secs(2)).await;
    hosts.far = Process::start("gateway", &hosts.there);
    while step().await < before.0 + 60 {}
    while count().await < before.1 + 60 {}
}

/// The letter with the result fails at its deadline, and no silence is long enough to be an event.
#[tokio::test(flavor = "multi_thread")]
async fn a_result_that_was_not_delivered_is_asked_for() {
    let hosts = TwoHosts::start(&["monitor.heartbeat=60s", "mts.deadline=1s"]).await;
    let mut process = hosts.agent("robot").await;
    let rover = hosts.domain.register("rover").await.unwrap();
    let robot = rover.robot(AgentId::new("robot").unwrap());
    let mut goal = held(&robot).await;
    hosts.far.signal(Signal::STOP);
    process.finish();
    tokio::time::sleep(Duration::from_secs(4)).await;
    hosts.far.signal(Signal::CONT);
    let delivered = tokio::time::timeout(Duration::from_secs(2), goal.outcome()).await;
    assert!(delivered.is_err(), "{delivered:?}");
    let result = tokio::time::timeout(TIMEOUT * 3, goal.result::<String>()).await;
    assert_eq!(result.unwrap().unwrap(), "done");
}
