//! `fipa replay --into`: sends the letters of a recording again.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::pin::pin;
use std::time::{Instant, SystemTime};

use fipa::error::SendError;
use fipa::{Agent, Config, Deliveries, Domain, Incarnation, Matcher, Outcome, RegisterOptions};
use fipa_acl::{escape, escape_name};
use serde_json::json;
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinSet};

use super::{Arguments, prepare, recorded};
use crate::command::record::file::letter::RecordedLetter;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::report::{self, Failure};
use crate::{input, output};

/// Maximum number of senders.
const MAX_SENDERS: usize = 256;
/// Maximum number of letters that are read ahead.
const MAX_AHEAD: usize = 256;
/// Maximum number of letters whose outcomes are not known.
const MAX_UNDER_WAY: usize = 1024;

/// Numbers of letters.
#[derive(Debug, Default)]
struct Tally {
    letters: u64,
    sent: u64,
    failed: u64,
    left_out: BTreeMap<&'static str, u64>,
}

pub(super) fn run(arguments: &Arguments, domain: &str, global: &Global) -> Result<(), Failure> {
    let mut config = global.config()?;
    config.domain = domain.to_owned();
    if arguments.file == Path::new("-") {
        return Err(Failure::wrong_usage(
            "--into reads the recording twice",
            "standard input",
            "give the name of a file",
        ));
    }
    let senders = senders(arguments, domain)?;
    options::block_on(replay(arguments, &config, &senders))?
}

/// Refuses the domain of the recording.
fn check_domain(about: &BTreeMap<String, String>, domain: &str, live: bool) -> Result<(), Failure> {
    let recorded = about.get("domain");
    if live || recorded.is_some_and(|recorded| recorded != domain) {
        return Ok(());
    }
    let problem = match recorded {
        Some(_) => {
            "the letters were recorded in this domain, and sending them again can move its robots"
        }
        None => "the recording does not name its domain, which can be this one",
    };
    Err(Failure::wrong_usage(
        problem,
        format!("domain {}", escape_name(domain)),
        "give another domain, or --live if no robot can do harm",
    ))
}

/// Whether a letter is from or to one of the agents.
fn is_of(letter: &RecordedLetter, agents: &[Matcher]) -> bool {
    let traits = letter.traits();
    let of = |agent: &Matcher| {
        traits.sender.is_some_and(|sender| agent.matches(sender)) || agent.matches(traits.receiver)
    };
    agents.is_empty() || agents.iter().any(of)
}

/// Returns the senders of the letters that are sent. Refuses the domain of the recording.
fn senders(arguments: &Arguments, domain: &str) -> Result<BTreeSet<String>, Failure> {
    let mut senders = BTreeSet::new();
    let mut is_full = false;
    let contents = recorded::read(&arguments.file, |letter| {
        let sender = letter.message.as_ref().and_then(|message| message.sender());
        if let Some(sender) = sender
            && is_of(&letter, &arguments.only)
            && prepare::reason_to_leave_out(&letter, arguments.all).is_none()
        {
            is_full |= senders.len() >= MAX_SENDERS && !senders.contains(sender.name());
            if !is_full {
                senders.insert(sender.name().to_owned());
            }
        }
        Ok(())
    })?;
    check_domain(&contents.about, domain, arguments.live)?;
    match is_full {
        true => Err(Failure::failed(
            format!("the recording has more than {MAX_SENDERS} senders"),
            input::name(&arguments.file),
            "select agents with --only",
        )),
        false => Ok(senders),
    }
}

async fn replay(
    arguments: &Arguments,
    config: &Config,
    senders: &BTreeSet<String>,
) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let mut tally = Tally::default();
    let sent = async {
        let agents = stop.during(register(&domain, senders, config)).await?;
        let mut stopped = pin!(stop.requested());
        tokio::select! {
            sent = send_all(arguments, &agents, config, &mut tally) => sent,
            () = &mut stopped => Ok(()),
        }
    };
    let sent = sent.await;
    Stop::ending();
    domain.close().await;
    sent?;
    print(&tally, arguments.json)?;
    Failure::all((tally.failed > 0).then(|| {
        Failure::failed(
            format!("{} letters were not delivered", tally.failed),
            format!("domain {}", escape_name(&config.domain)),
            "`fipa agents` lists the agents of the domain; the receivers must have the recorded names",
        )
    }))
}

/// Registers an agent for each sender. Messages to it are received and dropped.
async fn register(
    domain: &Domain,
    senders: &BTreeSet<String>,
    config: &Config,
) -> Result<BTreeMap<String, Agent>, Failure> {
    let mut agents = BTreeMap::new();
    for sender in senders {
        let name = prepare::renamed(sender);
        let options = RegisterOptions::default();
        let agent = membership::register(domain, &name, options, config).await?;
        let receiving = agent.clone();
        tokio::spawn(async move { while receiving.receive().await.is_ok() {} });
        agents.insert(sender.clone(), agent);
    }
    Ok(agents)
}

async fn send_all(
    arguments: &Arguments,
    agents: &BTreeMap<String, Agent>,
    config: &Config,
    tally: &mut Tally,
) -> Result<(), Failure> {
    let (sender, mut letters) = mpsc::channel(MAX_AHEAD);
    let file = arguments.file.clone();
    let reading = tokio::task::spawn_blocking(move || {
        recorded::read_again(&file, |letter| {
            // Fails if the replay was stopped.
            let _ = sender.blocking_send(letter);
            Ok(())
        })
    });
    let run = format!("replay-{}", Incarnation::random());
    let began = Instant::now();
    let mut course = prepare::Course::new(arguments.speed);
    let mut under_way = JoinSet::new();
    while let Some(letter) = letters.recv().await {
        if !is_of(&letter, &arguments.only) {
            continue;
        }
        tally.letters += 1;
        if let Some(reason) = prepare::reason_to_leave_out(&letter, arguments.all) {
            *tally.left_out.entry(reason).or_default() += 1;
            continue;
        }
        let delay = course.delay(letter.at);
        tokio::time::sleep(delay.saturating_sub(began.elapsed())).await;
        let sender = letter.message.as_ref().and_then(|message| message.sender());
        let agent = sender.and_then(|sender| agents.get(sender.name()));
        let message = prepare::message(&letter, &run, SystemTime::now());
        let (Some(agent), Some(message)) = (agent, message) else {
            *tally
                .left_out
                .entry("the message cannot be built")
                .or_default() += 1;
            continue;
        };
        while under_way.len() >= MAX_UNDER_WAY {
            if let Some(sent) = under_way.join_next().await {
                tally.add(sent);
            }
        }
        // In the order of the recording: the letter is on its way when this returns.
        under_way.spawn(agent.send_within(message, config.mts.deadline));
        while let Some(sent) = under_way.try_join_next() {
            tally.add(sent);
        }
    }
    while let Some(sent) = under_way.join_next().await {
        tally.add(sent);
    }
    let read = reading.await.map_err(|error| {
        let help = "report this error, with the log of the command";
        Failure::failed(error.to_string(), "this process", help)
    })?;
    read.map(drop)
}

impl Tally {
    fn add(&mut self, sent: Result<Result<Deliveries, SendError>, JoinError>) {
        self.sent += 1;
        let is_failed = |outcome: &Outcome| matches!(outcome, Outcome::Failed { .. });
        match sent {
            Ok(Ok(deliveries)) => {
                let failed = deliveries.0.iter().any(|it| is_failed(&it.outcome));
                self.failed += u64::from(failed);
            }
            Ok(Err(error)) => {
                self.failed += 1;
                let error = fipa::error::ErrorChain(&error).to_string();
                report::warn(&format!("a letter was not sent: {}", escape(&error)));
            }
            Err(_) => self.failed += 1,
        }
    }
}

fn print(tally: &Tally, json: bool) -> Result<(), Failure> {
    let Tally {
        letters,
        sent,
        failed,
        left_out,
    } = tally;
    if json {
        return output::json_line(&json!({
            "letters": letters, "sent": sent, "failed": failed, "left_out": left_out,
        }));
    }
    let mut text = format!("{letters} letters: {sent} sent, {failed} of them not delivered\n");
    for (reason, number) in left_out {
        text.push_str(&format!("{number} left out: {reason}\n"));
    }
    output::text(&text)
}
