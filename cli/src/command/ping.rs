//! `fipa ping`: measures the round trips of letters to one agent.

use std::time::{Duration, Instant};

use clap::Args;
use fipa::error::ErrorChain;
use fipa::{
    Agent, AgentId, Config, Deliveries, Incarnation, Outcome, Performative, RegisterOptions,
};
use fipa_acl::escape_name;
use serde_json::json;
use tokio::time::MissedTickBehavior;

use crate::complete;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output::{self, Reader};
use crate::report::{self, Failure};

/// Ontology of the messages, so that an agent can ignore them.
const ONTOLOGY: &str = "fipa-ping";

/// Measure the round trips of letters to an agent
///
/// Sends one inform per second with the ontology fipa-ping and prints the time until the confirmation
/// that it is in the queue of the agent. The agent receives these messages like others; it need not
/// answer. A summary at the end has the number of pings and the least, average and greatest time and the
/// standard deviation. The exit code is 0 only if every ping was delivered.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa ping arm_1                            until Ctrl-C
  fipa ping arm_1 -c 5
  fipa ping arm_1 --for 1min
  fipa ping arm_1 --count 1000 --interval 10ms --size 1KiB --json | tail -n 1

JSON, one object on each line:
  { \"ping\": number, \"outcome\", \"via\" or \"reason\", \"milliseconds\": number, if it was delivered }
  { \"pings\": number, \"delivered\": number, \"min\", \"avg\", \"max\", \"mdev\": milliseconds, if any was
    delivered }                              at the end")]
pub(crate) struct Arguments {
    /// Name of the agent
    #[arg(add = complete::agents())]
    name: AgentId,

    /// End after this number of pings [default: until Ctrl-C]
    #[arg(long, short, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,

    /// Time between the starts of two pings, for example 100ms
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = interval)]
    interval: Duration,

    /// Size of the content, for example 64KiB or 1000 (bytes)
    #[arg(long, value_name = "SIZE", default_value = "0", value_parser = content_size)]
    size: usize,

    /// End after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
    time: Option<Duration>,

    #[command(flatten)]
    addresses: membership::Addresses,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,
}

fn interval(text: &str) -> Result<Duration, String> {
    let interval = options::duration(text)?;
    match interval.is_zero() {
        true => Err("expected more than 0".to_owned()),
        false => Ok(interval),
    }
}

/// Parses the size of the content, at most 16 MiB.
fn content_size(text: &str) -> Result<usize, String> {
    let size = usize::try_from(options::size(text)?).ok();
    let size = size.filter(|size| *size <= MAX_CONTENT);
    size.ok_or_else(|| "the content may have at most 16MiB".to_owned())
}

/// Maximum size of the content of a ping, in bytes.
const MAX_CONTENT: usize = 16 << 20;

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(ping(&arguments, &config))?
}

async fn ping(arguments: &Arguments, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let name = format!("fipa-ping-{}", Incarnation::random());
    let options = RegisterOptions {
        agent_type: "fipa-ping".to_owned(),
        ..RegisterOptions::default()
    };
    let agent = stop
        .during(membership::register(&domain, &name, options, config))
        .await?;
    let mut tally = Tally::default();
    let mut reader = Reader::of_output();
    let ended = tokio::select! {
        ended = ping_all(&agent, arguments, &mut tally) => ended,
        () = stop.requested() => Ok(()),
        () = reader.gone() => Ok(()),
        () = options::after(arguments.time) => Ok(()),
    };
    let receiver = arguments.name.name();
    let stopped = membership::stopped(&agent, receiver);
    Stop::ending();
    drop(agent);
    domain.close().await;
    ended?;
    match arguments.json {
        true => output::json_line(&tally.json())?,
        false => output::text(&tally.text(receiver))?,
    }
    let failed = tally.pings - tally.delivered();
    Failure::all((failed > 0).then(|| {
        let help = match stopped {
            Some(stopped) => stopped.advice(),
            None => {
                "`fipa routes` shows the route to the agent, and `fipa agents` whether it is known"
                    .to_owned()
            }
        };
        Failure::failed(
            format!("{failed} of {} pings were not delivered", tally.pings),
            format!("{receiver:?}"),
            help,
        )
    }))
}

async fn ping_all(agent: &Agent, arguments: &Arguments, tally: &mut Tally) -> Result<(), Failure> {
    let mut starts = tokio::time::interval(arguments.interval);
    let to = arguments.addresses.of(agent, &arguments.name).await?;
    starts.set_missed_tick_behavior(MissedTickBehavior::Delay);
    // The first ping fails only after the deadline.
    if let Some(stopped) = membership::stopped(agent, to.name()) {
        report::warn(&stopped.advice());
    }
    let content = vec![b'.'; arguments.size];
    while arguments.count.is_none_or(|count| tally.pings < count) {
        starts.tick().await;
        let message = agent
            .message(Performative::Inform)
            .receiver(&to)
            .ontology(ONTOLOGY)
            .content(content.clone());
        let began = Instant::now();
        let deliveries = agent.send(message).await.map_err(|error| {
            Failure::failed(
                ErrorChain(&error).to_string(),
                "this process",
                "check the name of the agent",
            )
        })?;
        let time = began.elapsed();
        let is_delivered = !deliveries.0.is_empty() && deliveries.all_succeeded();
        tally.add(is_delivered.then_some(time));
        print(&deliveries, tally.pings, time, arguments.json)?;
    }
    Ok(())
}

fn print(deliveries: &Deliveries, number: u64, time: Duration, json: bool) -> Result<(), Failure> {
    for delivery in &deliveries.0 {
        let is_delivered = delivery.outcome.is_success();
        if json {
            let mut line = json!({ "ping": number });
            match &delivery.outcome {
                Outcome::Failed { reason, .. } => {
                    line["outcome"] = "failed".into();
                    line["reason"] = reason.to_string().into();
                }
                outcome => {
                    line["outcome"] = "delivered".into();
                    line["via"] = outcome.via().map(|via| via.name()).into();
                    line["milliseconds"] = millis(time).into();
                }
            }
            output::json_line(&line)?;
            continue;
        }
        let time = match is_delivered {
            true => format!(", {:.3} ms", millis(time)),
            false => String::new(),
        };
        let (receiver, outcome) = (escape_name(&delivery.receiver), &delivery.outcome);
        output::text(&format!("{receiver}: ping {number}, {outcome}{time}\n"))?;
    }
    Ok(())
}

fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// The round trips so far, in milliseconds.
#[derive(Debug, Default)]
struct Tally {
    pings: u64,
    delivered: u64,
    min: f64,
    max: f64,
    sum: f64,
    sum_of_squares: f64,
}

impl Tally {
    /// Adds a ping, with its time if it was delivered.
    fn add(&mut self, time: Option<Duration>) {
        self.pings += 1;
        let Some(time) = time.map(millis) else {
            return;
        };
        self.min = match self.delivered {
            0 => time,
            _ => self.min.min(time),
        };
        self.max = self.max.max(time);
        self.sum += time;
        self.sum_of_squares += time * time;
        self.delivered += 1;
    }

    fn delivered(&self) -> u64 {
        self.delivered
    }

    /// Returns the average and the standard deviation.
    fn average(&self) -> (f64, f64) {
        let count = self.delivered as f64;
        let average = self.sum / count;
        let variance = self.sum_of_squares / count - average * average;
        // Rounding can make the difference negative.
        (average, variance.max(0.0).sqrt())
    }

    fn text(&self, receiver: &str) -> String {
        let Self {
            pings,
            delivered,
            min,
            max,
            ..
        } = self;
        let mut text = format!(
            "{}: {pings} pings, {delivered} delivered",
            escape_name(receiver)
        );
        if *delivered > 0 {
            let (average, deviation) = self.average();
            text.push_str(&format!(
                "; round trip min/avg/max/mdev = {min:.3}/{average:.3}/{max:.3}/{deviation:.3} ms"
            ));
        }
        text.push('\n');
        text
    }

    fn json(&self) -> serde_json::Value {
        let mut json = json!({ "pings": self.pings, "delivered": self.delivered });
        if self.delivered > 0 {
            let (average, deviation) = self.average();
            for (key, value) in [
                ("min", self.min),
                ("avg", average),
                ("max", self.max),
                ("mdev", deviation),
            ] {
                json[key] = value.into();
            }
        }
        json
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_has_the_deviation_of_the_delivered_pings() {
        let mut tally = Tally::default();
        assert_eq!(tally.text("arm"), "arm: 0 pings, 0 delivered\n");
        for time in [Some(2), None, Some(4), Some(4), Some(6)] {
            tally.add(time.map(Duration::from_millis));
        }
        assert_eq!(
            tally.text("a\u{9b}m"),
            "a\\u{9b}m: 5 pings, 4 delivered; round trip min/avg/max/mdev = \
             2.000/4.000/6.000/1.414 ms\n"
        );
        assert_eq!(tally.json()["min"], 2.0);
    }
}
