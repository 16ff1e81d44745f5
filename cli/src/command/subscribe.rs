//! `fipa subscribe`: prints the values of a topic, or their rate.

use std::time::{Duration, Instant};

use clap::Args;
use fipa::protocol::{DialogueError, Keep, Notification, Subscription};
use fipa::{Agent, AgentId, Performative};
use fipa_acl::{escape, escape_name};
use serde_json::{Value, json};
use tokio::time::MissedTickBehavior;

use super::request::{self, CANCEL_WITHIN, Opening, line, unless_stopped};
use crate::complete;
use crate::membership::Stop;
use crate::options::{self, Global};
use crate::output::{self, Reader};
use crate::report::{self, Failure};

/// Print the values of a topic
///
/// Leads the protocol fipa-subscribe (FIPA00035): prints the content of each notification until Ctrl-C, which cancels
/// the subscription. Gaps are reported on standard error. A silent host of the agent is reported and does not end the
/// command. The exit code is 1 if the agent refuses, ends the subscription, leaves or dies.
///
/// At the end, standard error has the number of values, and their rate and intervals at this receiver. The summary is
/// omitted with --json and for one value.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa subscribe battery charge
  fipa subscribe battery charge --once
  fipa subscribe camera image --rate           the rate, and no values
  fipa subscribe camera image --raw --once > image.jpg      the newest image
  fipa subscribe door events --keep all
  fipa subscribe battery charge --json | jq -r .notification.content

JSON, one object on each line:
  { \"subscribed\": name }                     when the agent has agreed
  { \"notification\": the message as `fipa decode` prints it,
    \"missed\": number of notifications before it that were replaced or failed,
    \"age_ms\": time since the publication by the clocks of both hosts, or null }
With --rate, one object for each second after the first one:
  { \"values\": number, \"missed\": number, \"bytes\": length of the newest value, or null,
    \"rate\": Hz, \"min\", \"avg\" and \"max\": interval in milliseconds, if there was an interval }")]
pub(crate) struct Arguments {
    /// Name of the agent
    #[arg(add = complete::agents())]
    name: AgentId,

    /// Topic of the publisher; for an agent of another platform, the content of the subscription
    #[arg(value_name = "TOPIC")]
    content: String,

    /// Notifications to get if this command is slower than the publisher: all, latest(N), or auto, which is the newest
    /// one of a stream and all of others. A topic is a stream if its publisher declares a rate or loans the contents
    #[arg(long, value_name = "KEEP", default_value = "auto")]
    keep: Keep,

    /// Print the messages with all parameters
    #[arg(long, conflicts_with = "json")]
    full: bool,

    /// Print the bytes of the contents unchanged and without line ends, for a file or another program
    #[arg(long, conflicts_with_all = ["json", "full"])]
    raw: bool,

    /// Print the rate at this receiver once a second, and no values
    #[arg(long, conflicts_with_all = ["full", "raw"])]
    rate: bool,

    /// End after this number of notifications
    #[arg(long, short, value_name = "N")]
    count: Option<u64>,

    /// End after one notification, as --count 1
    #[arg(long, conflicts_with = "count")]
    once: bool,

    /// End after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
    time: Option<Duration>,

    /// Maximum wait for the agreement, for example 10s
    #[arg(long, value_name = "TIME", default_value = "10s", value_parser = options::duration)]
    timeout: Duration,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    opening: Opening,
}

pub(crate) fn run(mut arguments: Arguments, global: &Global) -> Result<(), Failure> {
    if arguments.once {
        arguments.count = Some(1);
    }
    arguments
        .opening
        .run("subscribe", global, async |agent, stop| {
            follow(agent, &arguments, stop).await
        })
}

async fn follow(agent: &Agent, arguments: &Arguments, stop: &mut Stop) -> Result<(), Failure> {
    let Arguments { name, content, .. } = arguments;
    let act = Performative::Subscribe;
    let opening = arguments.opening.message(agent, act, name, content);
    let opening = opening.await?;
    let subscribed = tokio::select! {
        subscribed = agent.subscribe_keeping(arguments.keep, opening, arguments.timeout) => subscribed,
        () = stop.requested() => return Ok(()),
    };
    let mut subscription = subscribed.map_err(|error| failed(&error, name))?;
    let mut reachability = subscription.reachability();
    match arguments.json {
        true => output::json_line(&json!({ "subscribed": name.name() }))?,
        // The output has the contents alone.
        false => report::hint(&format!(
            "subscribed to {}; press Ctrl-C to stop",
            escape_name(name.name())
        )),
    }
    let mut reader = Reader::of_output();
    let mut all = Arrivals::default();
    let print = async {
        tokio::select! {
            printed = print_all(&mut subscription, &mut all, arguments) => printed,
            () = reader.gone() => Ok(()),
            () = options::after(arguments.time) => Ok(()),
        }
    };
    let printed = unless_stopped(print, &mut reachability, stop).await;
    if !arguments.json && arguments.count != Some(1) {
        report::note(&all.summary());
    }
    match printed {
        Some(Err(failure)) => Err(failure),
        Some(Ok(())) | None => {
            Stop::ending();
            if let Err(error) = subscription.cancel(CANCEL_WITHIN).await {
                report::warn(&format!("the subscription was not canceled: {error}"));
            }
            Ok(())
        }
    }
}

/// The error report of a subscription.
fn failed(error: &DialogueError, name: &AgentId) -> Failure {
    let place = || format!("{:?}", name.name());
    match error {
        DialogueError::Refused(message) => {
            let content = message.content().map_or(&[][..], |content| content);
            let reason = String::from_utf8_lossy(content);
            Failure::failed(
                format!("the subscription is refused: {}", escape(&reason)),
                place(),
                format!(
                    "`fipa topics {}` lists the topics",
                    escape_name(name.name())
                ),
            )
        }
        DialogueError::NotDelivered { .. }
            if let Some((publisher, topic)) = options::of_publisher(name.name()) =>
        {
            let help = format!(
                "the agent and the topic are two arguments: `fipa subscribe {publisher} {topic}`"
            );
            Failure::failed(request::in_full(error), place(), help)
        }
        _ => request::failed(error, name),
    }
}

/// Time between two lines of --rate.
const INTERVAL: Duration = Duration::from_secs(1);

/// Prints each notification or the rate, and counts all notifications.
async fn print_all(
    subscription: &mut Subscription,
    all: &mut Arrivals,
    arguments: &Arguments,
) -> Result<(), Failure> {
    let mut of_second = Arrivals::default();
    let mut seconds = tokio::time::interval_at((Instant::now() + INTERVAL).into(), INTERVAL);
    seconds.set_missed_tick_behavior(MissedTickBehavior::Delay);
    while arguments.count.is_none_or(|most| all.values < most) {
        let received = tokio::select! {
            received = subscription.next() => received,
            _ = seconds.tick(), if arguments.rate => {
                match arguments.json {
                    true => output::json_line(&of_second.json())?,
                    false => output::text(&format!("{}\n", of_second.text()))?,
                }
                of_second = of_second.following();
                continue;
            }
        };
        let notification = match received {
            Ok(notification) => notification,
            // Reported as a change of the reachability.
            Err(DialogueError::Unreachable { .. }) => continue,
            Err(error) => return Err(failed(&error, &arguments.name)),
        };
        let now = Instant::now();
        all.add(now, &notification);
        of_second.add(now, &notification);
        if !arguments.rate {
            print(&notification, arguments)?;
        }
    }
    Ok(())
}

/// The number of the values that arrived in a time, and their intervals.
#[derive(Debug, Default)]
struct Arrivals {
    values: u64,
    /// The values that were replaced or failed.
    missed: u64,
    /// The length of the newest value.
    bytes: Option<usize>,
    /// The arrival of the newest value, which may be before the time.
    last: Option<Instant>,
    intervals: u32,
    sum: Duration,
    min: Duration,
    max: Duration,
}

impl Arrivals {
    fn add(&mut self, now: Instant, notification: &Notification) {
        let bytes = notification.content().map_or(0, |content| content.len());
        self.add_value(now, bytes, notification.missed());
    }

    fn add_value(&mut self, now: Instant, bytes: usize, missed: u64) {
        if let Some(last) = self.last {
            let interval = now.saturating_duration_since(last);
            self.min = match self.intervals {
                0 => interval,
                _ => self.min.min(interval),
            };
            self.max = self.max.max(interval);
            self.sum += interval;
            self.intervals = self.intervals.saturating_add(1);
        }
        self.last = Some(now);
        self.values += 1;
        self.missed += missed;
        self.bytes = Some(bytes);
    }

    /// Returns the start of the next time, in which the first interval begins at the newest value of this one.
    fn following(&self) -> Self {
        Self {
            last: self.last,
            ..Self::default()
        }
    }

    /// The values per second and the average interval, if there was an interval.
    fn average(&self) -> Option<(f64, Duration)> {
        let average = self.sum.checked_div(self.intervals)?;
        let hertz = f64::from(self.intervals) / self.sum.as_secs_f64();
        hertz.is_finite().then_some((hertz, average))
    }

    fn text(&self) -> String {
        let Some(bytes) = self.bytes else {
            return "no values".to_owned();
        };
        let rate = match self.average() {
            Some((hertz, average)) => {
                let [average, min, max] = [average, self.min, self.max].map(millis);
                format!("{hertz:.1} Hz, {average:.1} ms on average (min {min:.1}, max {max:.1}), ")
            }
            None => String::new(),
        };
        format!("{rate}{bytes} B, {} missed", self.missed)
    }

    /// The line at the end of the command.
    fn summary(&self) -> String {
        match self.values {
            0 => self.text(),
            1 => format!("1 value: {}", self.text()),
            values => format!("{values} values: {}", self.text()),
        }
    }

    fn json(&self) -> Value {
        let mut json = json!({
            "values": self.values, "missed": self.missed, "bytes": self.bytes,
        });
        if let Some((hertz, average)) = self.average() {
            json["rate"] = hertz.into();
            json["min"] = millis(self.min).into();
            json["avg"] = millis(average).into();
            json["max"] = millis(self.max).into();
        }
        json
    }
}

fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

fn print(notification: &Notification, arguments: &Arguments) -> Result<(), Failure> {
    if arguments.json {
        let mut line = line("notification", notification);
        line["missed"] = notification.missed().into();
        let age = notification.age().map(|age| age.as_millis());
        line["age_ms"] = json!(age);
        return output::json_line(&line);
    }
    match notification.missed() {
        0 => {}
        missed => report::note(&format!("{missed} missed")),
    }
    let content = notification.content().map_or(&[][..], |content| content);
    if arguments.raw {
        return output::bytes(content);
    }
    output::text(&match arguments.full {
        true => format!("{notification}\n"),
        false => match std::str::from_utf8(content) {
            Ok(text) => format!("{}\n", escape(text)),
            Err(_) => format!(
                "{} bytes that are no text; --raw prints them\n",
                content.len()
            ),
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_that_of_the_intervals_of_the_time() {
        let mut arrivals = Arrivals::default();
        assert_eq!(arrivals.summary(), "no values");
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        arrivals.add_value(at(0), 17, 0);
        assert_eq!(arrivals.summary(), "1 value: 17 B, 0 missed");
        arrivals.add_value(at(40), 17, 0);
        arrivals.add_value(at(100), 18, 2);
        let rate = "20.0 Hz, 50.0 ms on average (min 40.0, max 60.0), 18 B, 2 missed";
        assert_eq!(arrivals.summary(), format!("3 values: {rate}"));
        let mut next = arrivals.following();
        assert_eq!(next.text(), "no values");
        next.add_value(at(150), 9, 0);
        let rate = "20.0 Hz, 50.0 ms on average (min 50.0, max 50.0), 9 B, 0 missed";
        assert_eq!(next.text(), rate);
        assert_eq!(next.json()["avg"], 50.0);
    }
}
