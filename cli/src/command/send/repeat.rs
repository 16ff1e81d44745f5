//! Sends a message repeatedly.

use std::time::{Duration, Instant};

use fipa::error::SendError;
use fipa::{Agent, Config, Deliveries, Outcome};
use serde_json::json;
use tokio::task::{JoinError, JoinSet};
use tokio::time::Interval;

use super::{Arguments, in_order_given, located, message, not_sent, register};
use crate::membership::{self, Stop};
use crate::options;
use crate::output::{self, Reader};
use crate::report::Failure;

/// Maximum number of messages without outcomes. Beyond it, sending waits.
const MAX_UNDER_WAY: usize = 256;

/// Parses a number of messages per second.
pub(in crate::command) fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if (0.001..=1e6).contains(&rate) => Ok(rate),
        _ => Err("expected messages per second, from 0.001 to 1000000".to_owned()),
    }
}

/// Sends the message until its count is reached or a signal arrives.
pub(super) async fn send(
    mut arguments: Arguments,
    content: Option<Vec<u8>>,
    config: &Config,
) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let agent = stop.during(register(&domain, &arguments, config)).await?;
    match located(&agent, &arguments).await {
        Ok(to) => arguments.to = to,
        Err(failure) => {
            drop(agent);
            domain.close().await;
            return Err(failure);
        }
    }
    let arguments = &arguments;
    let mut tally = Tally::default();
    let began = Instant::now();
    let mut reader = Reader::of_output();
    let ended = tokio::select! {
        ended = send_all(&agent, arguments, content, config, &mut tally) => ended,
        () = stop.requested() => Ok(()),
        () = reader.gone() => Ok(()),
        () = options::after(arguments.time) => Ok(()),
    };
    let seconds = began.elapsed().as_secs_f64();
    Stop::ending();
    drop(agent);
    domain.close().await;
    ended?;
    let Tally {
        messages,
        delivered,
        sent,
        failed,
    } = tally;
    match arguments.json {
        true => output::json_line(&json!({
            "messages": messages, "delivered": delivered, "sent": sent, "failed": failed, "seconds": seconds,
        }))?,
        false => output::text(&format!(
            "{messages} messages in {seconds:.1} s: {delivered} outcomes delivered, {sent} sent without a confirmation, {failed} failed\n"
        ))?,
    }
    Failure::all((failed > 0).then(|| {
        Failure::failed(
            format!("{failed} outcomes are failures"),
            "the receivers",
            "the output has the reasons; `fipa send` without --count prints advice",
        )
    }))
}

type Sent = (u64, Result<Deliveries, SendError>);

async fn send_all(
    agent: &Agent,
    arguments: &Arguments,
    content: Option<Vec<u8>>,
    config: &Config,
    tally: &mut Tally,
) -> Result<(), Failure> {
    let numbered = |number| {
        let mut content = content.clone();
        if arguments.numbered {
            content
                .get_or_insert_default()
                .extend(format!(" {number}").bytes());
        }
        message(agent, arguments, content)
    };
    // Large content is shared by all copies.
    let same = message(agent, arguments, content.clone())?;
    let deadline = arguments.deadline.unwrap_or(config.mts.deadline);
    let mut starts = arguments.rate.map(|rate| {
        // At least the resolution of the timer, which catches up.
        tokio::time::interval(Duration::from_secs_f64(1.0 / rate))
    });
    let most = match starts {
        Some(_) => MAX_UNDER_WAY,
        None => 1,
    };
    let mut under_way: JoinSet<Sent> = JoinSet::new();
    let mut next = 1;
    loop {
        let is_over = arguments.count.is_some_and(|count| next > count);
        if is_over && under_way.is_empty() {
            return Ok(());
        }
        tokio::select! {
            Some(sent) = under_way.join_next() => tally.add(sent, arguments)?,
            () = tick(&mut starts), if !is_over && under_way.len() < most => {
                let message = match arguments.numbered {
                    true => numbered(next)?,
                    false => same.clone(),
                };
                let (number, sending) = (next, agent.send_within(message, deadline));
                under_way.spawn(async move { (number, sending.await) });
                next += 1;
            }
        }
    }
}

pub(in crate::command) async fn tick(starts: &mut Option<Interval>) {
    if let Some(starts) = starts {
        starts.tick().await;
    }
}

/// The outcomes so far.
#[derive(Debug, Default)]
struct Tally {
    messages: u64,
    delivered: u64,
    /// Number of outcomes of legacy peers, which confirm nothing.
    sent: u64,
    failed: u64,
}

impl Tally {
    /// Counts the outcomes of a message. Prints those that failed, or all as JSON.
    fn add(&mut self, sent: Result<Sent, JoinError>, arguments: &Arguments) -> Result<(), Failure> {
        let json = arguments.json;
        let Ok((number, sent)) = sent else {
            return Ok(());
        };
        let mut deliveries = sent.map_err(|error| not_sent(&error))?;
        in_order_given(&mut deliveries, &arguments.to);
        self.messages += 1;
        if json {
            output::json_line(&json!({ "number": number, "deliveries": deliveries }))?;
        }
        for delivery in deliveries.0 {
            match delivery.outcome {
                Outcome::Delivered { .. } => self.delivered += 1,
                Outcome::Sent { .. } => self.sent += 1,
                _ => {
                    self.failed += 1;
                    if !json {
                        let one = Deliveries(vec![delivery]);
                        output::text(&format!("message {number}: {one}\n"))?;
                    }
                }
            }
        }
        Ok(())
    }
}
