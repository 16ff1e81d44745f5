//! The leader in Rust. Usage: `lead NAME PARTNER`

#![allow(clippy::print_stdout, reason = "the program prints its observations")]

use std::fmt::Display;
use std::time::Duration;

use fipa::Performative::{Inform, Propose, Request, Subscribe};
use fipa::config::Sources;
use fipa::locks::Fence;
use fipa::protocol::{DialogueError, Keep};
use fipa::{Agent, AgentId, Config, Domain, Error, Message, MessageBuilder, Result};
use fipa_bindings::{Failure, FailureKind};
use serde::Serialize;

/// A time limit that no step reaches.
const LONG: Duration = Duration::from_secs(60);
/// A time limit that passes.
const SHORT: Duration = Duration::from_secs(3);

fn step(name: &str, observed: impl Display) {
    println!("{name}: {observed}");
}

/// Prints the failure of a step that must fail.
fn fails<T>(name: &str, result: Result<T, impl Into<Error>>) {
    match result.map_err(Failure::of) {
        Ok(_) => step(name, "no failure"),
        Err(failure) => step(name, format!("{:?}: {failure}", failure.kind)),
    }
}

/// Waits for a letter of a conversation. Others are late messages of conversations that have ended.
async fn receive(agent: &Agent, conversation: &str) -> Result<Message> {
    loop {
        let message = agent.receive().await?.into_message();
        if message.conversation_id() == Some(conversation) {
            return Ok(message);
        }
    }
}

/// Requests an action, and returns the content of the answer.
async fn ask(
    agent: &Agent,
    request: MessageBuilder,
    limit: Duration,
) -> Result<String, DialogueError> {
    Ok(agent.request(request, limit).await?.result().await?.text())
}

#[tokio::main]
async fn main() -> Result<()> {
    let mut names = std::env::args().skip(1);
    let (own, partner) = (
        names.next().unwrap_or_default(),
        names.next().unwrap_or_default(),
    );
    let (own, partner) = (own.as_str(), partner.as_str());
    let domain = Domain::from_environment().await?;
    let agent = domain.register(own).await?;
    step("register", agent.name());
    if let Err(error) = domain.register(partner).await {
        step("register the partner", kind(error));
    }
    letters(&agent, partner).await?;
    requests(&agent, partner).await?;
    goals(&agent, partner).await?;
    notifications(&agent, partner).await?;
    locks(&agent, partner).await?;
    violations(&agent, partner).await?;

    let request = agent.message(Request).receiver(partner).content("wait");
    let mut request = agent.request(request, LONG * 60).await?;
    step("request without an end", request.agreed().await?);
    fails("the partner is killed", request.result().await);
    domain.close().await;
    Ok(())
}

async fn letters(agent: &Agent, partner: &str) -> Result<()> {
    let inform = |conversation: &str| {
        agent
            .message(Inform)
            .receiver(partner)
            .conversation_id(conversation)
    };
    let hello = inform("inform")
        .content("Grüße, 起重机 🏗")
        .language("text")
        .reply_with("q1");
    agent.send(hello).await?;
    let answer = receive(agent, "inform").await?;
    step("inform", answer.text());
    step("in reply to", answer.in_reply_to().unwrap_or_default());
    step("sender", answer.sender().map_or("", AgentId::name));

    let mut loan = agent.loan(inform("loan"), 1_000_000)?;
    fill(loan.content_mut());
    agent.send_loan(loan).await?;
    step("loan", receive(agent, "loan").await?.text());

    let mut content = vec![0; 64_000_000];
    fill(&mut content);
    agent.send(inform("large").content(content)).await?;
    step("large", receive(agent, "large").await?.text());

    let unknown = agent
        .message(Inform)
        .receiver("missing")
        .conversation_id("unknown");
    let outcomes = agent.send_within(unknown.content(""), SHORT).await?;
    if !outcomes.all_succeeded() {
        step(
            "unknown receiver",
            format!("{:?}: {outcomes}", FailureKind::NotDelivered),
        );
    }
    step("report", receive(agent, "unknown").await?.performative());

    let both = agent
        .message(Inform)
        .receivers([partner, &format!("{partner}_2")]);
    agent
        .send(both.conversation_id("both").content("both"))
        .await?;
    let mut answers = Vec::new();
    for _ in 0..2 {
        let answer = receive(agent, "both").await?;
        answers.push(format!(
            "{} {}",
            answer.sender().map_or("", AgentId::name),
            answer.text()
        ));
    }
    answers.sort();
    step("multicast", answers.join("; "));
    Ok(())
}

async fn requests(agent: &Agent, partner: &str) -> Result<()> {
    let request = |content: &'static str| agent.message(Request).receiver(partner).content(content);
    let mut lift = agent.request(request("lift"), LONG).await?;
    step("agreed", lift.agreed().await?);
    step("answer", lift.result().await?.text());
    for (name, content, limit) in [
        ("refused", "drop", LONG),
        ("failed", "throw", LONG),
        ("timed out", "wait", SHORT),
    ] {
        fails(name, ask(agent, request(content), limit).await);
    }
    let mut wait = agent.request(request("wait"), LONG).await?;
    wait.agreed().await?;
    wait.cancel(LONG).await?;
    fails("cancelled", wait.result().await);
    Ok(())
}

#[derive(Serialize)]
struct Goal<T> {
    to: T,
}

async fn goals(agent: &Agent, partner: &str) -> Result<()> {
    let robot = agent.robot(AgentId::new(partner)?);
    let goal = robot.invoke("count", &Goal { to: 7 }).await?;
    let mut progress = goal.progress().await?;
    while let Some(status) = progress.next().await? {
        if let Some(note) = status.progress.and_then(|progress| progress.note) {
            step("progress", note);
            break;
        }
    }
    let go = agent.message(Request).receiver(partner).content("go");
    ask(agent, go, LONG).await?;
    step("result", goal.result::<u32>().await?);

    fails(
        "wrong goal",
        robot.invoke("count", &Goal { to: "far" }).await,
    );
    let mut goal = robot.invoke("count", &Goal { to: 8 }).await?;
    goal.cancel(LONG).await?;
    fails("cancelled goal", goal.outcome().await);
    Ok(())
}

async fn notifications(agent: &Agent, partner: &str) -> Result<()> {
    let subscribe = agent.message(Subscribe).receiver(partner).content("charge");
    let mut charge = agent.subscribe_keeping(Keep::All, subscribe, LONG).await?;
    step("notification", charge.next().await?.message().text());
    for percent in ["publish 80", "publish 70 ☀"] {
        let publish = agent.message(Request).receiver(partner).content(percent);
        ask(agent, publish, LONG).await?;
        step("notification", charge.next().await?.message().text());
    }
    Ok(charge.cancel(LONG).await?)
}

async fn locks(agent: &Agent, partner: &str) -> Result<()> {
    let request = |content: &'static str| agent.message(Request).receiver(partner).content(content);
    step("no fence", ask(agent, request("dock"), LONG).await?);
    let lock = agent.lock_within("bay", LONG).await?;
    step(
        "fence",
        ask(agent, lock.guard(request("dock")), LONG).await?,
    );
    step("locked", ask(agent, request("lock 200"), LONG).await?);
    let fence = lock.fence().cloned();
    lock.release();
    let answer = ask(agent, request("lock 60000"), LONG).await?;
    let (late, other) = answer.split_once(' ').unwrap_or((&answer, ""));
    step("late command", late);
    let is_greater = other.parse::<Fence>().ok() > fence;
    step("next fence is greater", is_greater);
    Ok(())
}

/// Sends a message that answers no request: through a domain that checks what it sends, and through one that does not.
async fn violations(agent: &Agent, partner: &str) -> Result<()> {
    let propose = |agent: &Agent| {
        let propose = agent.message(Propose).receiver(partner).content("");
        propose
            .protocol("fipa-request")
            .conversation_id("violation")
    };
    let mut sources = Sources::from_environment();
    sources.set.push("monitor.check=enforce".to_owned());
    let strict = Domain::open(&Config::load(&sources)?).await?;
    let other = strict.register(&format!("{}_strict", agent.name())).await?;
    fails("violation", other.send(propose(&other)).await);
    strict.close().await;
    agent.send(propose(agent)).await?;
    step(
        "violation at the partner",
        receive(agent, "violation report").await?.text(),
    );
    Ok(())
}

/// Writes bytes in a pattern.
fn fill(content: &mut [u8]) {
    for (byte, value) in content.iter_mut().zip((0..=250_u8).cycle()) {
        *byte = value;
    }
}

/// Returns the name of the kind of an error.
fn kind(error: impl Into<Error>) -> String {
    format!("{:?}", Failure::of(error).kind)
}
