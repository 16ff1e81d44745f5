//! `fipa publish`: an agent that publishes a topic.

use std::io::{self, BufRead, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use clap::Args;
use fipa::error::ErrorChain;
use fipa::topics::{NotificationResult, Notified, Publication, Publisher, Topic};
use fipa::{Agent, AgentId, Config, Domain, RegisterOptions};
use fipa_acl::{escape, escape_name};
use serde_json::json;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{Interval, MissedTickBehavior};

use super::send::repeat;
use crate::input;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::{self, Failure};

/// Publish a topic
///
/// Registers an agent that notifies all subscribers to a topic (FIPA00035), until Ctrl-C. The newest value is latched:
/// a new subscriber gets it at once. A slow subscriber does not slow the command, unless it asks for all values.
///
/// Without --rate, the value is published once and stays. With `-` as the value, each line of the standard input is
/// published; the command ends with the input, when all subscribers have the last line.
///
/// `fipa subscribe NAME TOPIC` prints the values, and `fipa topics NAME` shows the subscribers.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa publish battery charge 80.5
  fipa publish clock ticks tick --rate 2
  vmstat -n 1 | fipa publish host load -
  fipa publish camera image --content-file picture.jpg --type image/jpeg --rate 30

In another terminal:
  fipa subscribe battery charge

JSON, one object on each line:
  { \"publishing\": topic, \"agent\": name }        when subscribers can subscribe
  { \"number\": of the value, from 1, \"subscriber\": name,
    \"result\": \"delivered\", \"sent\", \"replaced\", \"too slow\", \"ended\" or \"failed\" }
  { \"published\": number of values, \"delivered\", \"sent\", \"replaced\" and \"failed\": numbers of results }  at the end")]
pub(crate) struct Arguments {
    /// Name of the agent
    name: AgentId,

    /// Name of the topic
    topic: String,

    /// Value; - for the lines of the standard input
    #[arg(required_unless_present = "content_file")]
    value: Option<String>,

    /// Value: the bytes of this file, which is read for each publication
    #[arg(long, value_name = "FILE", conflicts_with = "value")]
    content_file: Option<PathBuf>,

    /// Media type of the values, which `fipa topics` shows, for example image/jpeg
    #[arg(long = "type", value_name = "TYPE")]
    media_type: Option<String>,

    /// Publish the value this number of times per second, for example 30 or 0.5. The topic is a stream then: a
    /// subscriber gets the newest value unless it asks for others
    #[arg(long, value_name = "N", value_parser = repeat::rate)]
    rate: Option<f64>,

    /// End after this number of values
    #[arg(long, short, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,

    /// End after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
    time: Option<Duration>,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,
}

/// Maximum length in bytes of a line of the standard input.
const MAX_LINE: u64 = 1 << 20;

/// The values that are published.
enum Values {
    One(Bytes),
    /// A file that is read for each publication, and the configuration with the limit of its length.
    File(PathBuf, Box<Config>),
    Lines(mpsc::Receiver<io::Result<Vec<u8>>>),
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let register = async |domain: &Domain| {
        let options = RegisterOptions {
            agent_type: "publisher".to_owned(),
            ..RegisterOptions::default()
        };
        membership::register(domain, arguments.name.name(), options, &config).await
    };
    let publish =
        async |agent: &Agent, stop: &mut Stop| publish(agent, &arguments, &config, stop).await;
    membership::run_agent(&config, register, publish)
}

async fn publish(
    agent: &Agent,
    arguments: &Arguments,
    config: &Config,
    stop: &mut Stop,
) -> Result<(), Failure> {
    let mut topic = Topic::new(arguments.topic.clone()).latched(1);
    if let Some(media_type) = &arguments.media_type {
        topic = topic.media_type(media_type);
    }
    if let Some(rate) = arguments.rate {
        topic = topic.rate(rate);
    }
    let publisher = agent.publisher(topic).map_err(|error| {
        Failure::failed(
            format!("cannot publish: {}", ErrorChain(&error)),
            format!("topic {:?}", arguments.topic),
            "remove fipa-subscribe from your own protocol files",
        )
    })?;
    match arguments.json {
        true => {
            output::json_line(&json!({ "publishing": arguments.topic, "agent": agent.name() }))?
        }
        false => output::text(&format!(
            "publishing {} as {}; press Ctrl-C to stop\n",
            escape(&arguments.topic),
            escape_name(agent.name())
        ))?,
    }
    let mut values = match (&arguments.value, &arguments.content_file) {
        (_, Some(file)) if file == Path::new("-") => {
            Values::One(input::content(file, config)?.into())
        }
        (_, Some(file)) => Values::File(file.clone(), Box::new(config.clone())),
        (Some(value), None) if value == "-" => Values::Lines(lines_of_input()?),
        (value, None) => Values::One(value.clone().unwrap_or_default().into()),
    };
    let mut tally = Tally::default();
    let ended = tokio::select! {
        ended = publish_all(&publisher, &mut values, arguments, &mut tally) => ended,
        () = stop.requested() => Ok(()),
        () = options::after(arguments.time) => Ok(()),
    };
    tally.print(arguments.json)?;
    ended
}

async fn publish_all(
    publisher: &Publisher,
    values: &mut Values,
    arguments: &Arguments,
    tally: &mut Tally,
) -> Result<(), Failure> {
    let mut ticks = arguments.rate.map(|rate| {
        // At least the resolution of the timer.
        let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / rate));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        ticks
    });
    let mut results = JoinSet::new();
    let mut is_input_over = false;
    loop {
        let published = tally.published;
        let is_over = is_input_over || arguments.count.is_some_and(|count| published >= count);
        if is_over && results.is_empty() {
            return Ok(());
        }
        // A value without a rate stays, for subscribers to come.
        let has_next = ticks.is_some() || published == 0 || values.is_input();
        tokio::select! {
            biased;
            Some(result) = results.join_next() => {
                if let Ok((number, results)) = result {
                    tally.add(number, results, arguments.json)?;
                }
            }
            value = due(&mut ticks, values), if has_next && !is_over => match value? {
                Some(value) => {
                    let publication = publisher.publish(value).await;
                    tally.published += 1;
                    results.spawn(settled(publication));
                }
                None => is_input_over = true,
            },
            else => std::future::pending().await,
        }
    }
}

async fn settled(publication: Publication) -> (u64, Vec<Notified>) {
    (publication.number(), publication.results().await)
}

/// Waits for the next value and the time at which it is due. Dropping the future loses no value.
async fn due(ticks: &mut Option<Interval>, values: &mut Values) -> Result<Option<Bytes>, Failure> {
    repeat::tick(ticks).await;
    values.next().await
}

/// Starts reading the lines of the standard input. The thread ends with the process at the latest.
fn lines_of_input() -> Result<mpsc::Receiver<io::Result<Vec<u8>>>, Failure> {
    let (sender, lines) = mpsc::channel(1);
    let reading = std::thread::Builder::new().spawn(move || {
        let mut input = io::stdin().lock();
        loop {
            let mut line = Vec::new();
            let read = input.by_ref().take(MAX_LINE).read_until(b'\n', &mut line);
            if line.last() == Some(&b'\n') {
                line.pop();
            }
            let line = match read {
                Ok(0) => return,
                Ok(_) => Ok(line),
                Err(error) => Err(error),
            };
            let is_last = line.is_err();
            // Without a receiver, the command has ended.
            if sender.blocking_send(line).is_err() || is_last {
                return;
            }
        }
    });
    reading.map_err(|error| cannot_read(&error))?;
    Ok(lines)
}

fn cannot_read(error: &io::Error) -> Failure {
    Failure::failed(
        format!("cannot read: {error}"),
        "standard input",
        "give the value as an argument instead of -",
    )
}

impl Values {
    fn is_input(&self) -> bool {
        matches!(self, Self::Lines(_))
    }

    /// Returns the next value. `None` at the end of the input.
    async fn next(&mut self) -> Result<Option<Bytes>, Failure> {
        match self {
            Self::One(value) => Ok(Some(value.clone())),
            Self::File(file, config) => Ok(Some(input::content(file, config)?.into())),
            Self::Lines(lines) => match lines.recv().await {
                Some(line) => Ok(Some(line.map_err(|error| cannot_read(&error))?.into())),
                None => Ok(None),
            },
        }
    }
}

/// The results so far.
#[derive(Debug, Default)]
struct Tally {
    published: u64,
    delivered: u64,
    sent: u64,
    replaced: u64,
    failed: u64,
}

impl Tally {
    /// Counts the results of a value. Prints those that failed, or all as JSON.
    fn add(&mut self, number: u64, results: Vec<Notified>, json: bool) -> Result<(), Failure> {
        use fipa::Outcome;
        for Notified { subscriber, result } in results {
            let (text, count) = match &result {
                NotificationResult::Outcome(Outcome::Delivered { .. }) => {
                    ("delivered", &mut self.delivered)
                }
                NotificationResult::Outcome(Outcome::Sent { .. }) => ("sent", &mut self.sent),
                NotificationResult::Replaced => ("replaced", &mut self.replaced),
                NotificationResult::TooSlow => ("too slow", &mut self.failed),
                NotificationResult::Ended => ("ended", &mut self.failed),
                _ => ("failed", &mut self.failed),
            };
            *count += 1;
            if json {
                output::json_line(
                    &json!({ "number": number, "subscriber": subscriber, "result": text }),
                )?;
            } else if let NotificationResult::Outcome(outcome @ Outcome::Failed { .. }) = &result {
                let subscriber = escape_name(&subscriber);
                report::warn(&format!("value {number}: {subscriber}: {outcome}"));
            } else if matches!(result, NotificationResult::TooSlow) {
                let subscriber = escape_name(&subscriber);
                report::warn(&format!(
                    "value {number}: {subscriber} is too slow for all values"
                ));
            }
        }
        Ok(())
    }

    fn print(&self, json: bool) -> Result<(), Failure> {
        let Self {
            published,
            delivered,
            sent,
            replaced,
            failed,
        } = self;
        match json {
            true => output::json_line(&json!({
                "published": published, "delivered": delivered, "sent": sent,
                "replaced": replaced, "failed": failed,
            })),
            false => output::text(&format!(
                "{published} published: {delivered} delivered, {sent} sent without a confirmation, \
                 {replaced} replaced by newer ones, {failed} failed\n"
            )),
        }
    }
}
