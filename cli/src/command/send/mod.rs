//! `fipa send`: sends one message and prints its outcomes.

mod advice;
pub(super) mod repeat;
mod settle;

use std::collections::HashSet;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use clap::Args;
use fipa::error::ErrorChain;
use fipa::locks::{Fence, with_fences};
use fipa::monitor::History;
use fipa::protocol::{PartnerEvent, PartnerWatch};
use fipa::{
    Agent, AgentId, Config, Deliveries, Delivery, DeliveryFailure, Incarnation, Incoming, Matcher,
    Message, Performative, RegisterOptions, Time,
};
use fipa_acl::json::message_to_json;
use indicatif::{HumanBytes, ProgressBar, ProgressStyle};
use serde_json::{Value, json};

use super::protocol;
use super::request::shown;
use crate::options::{self, Global};
use crate::report::{self, Failure};
use crate::{complete, input, membership, output};

use self::settle::Settled;

/// Send one message and print its outcome
///
/// Registers a temporary agent, sends the message to every receiver and prints one outcome per
/// receiver: delivered (the letter is in the receiver's queue), sent (the peer cannot confirm) or
/// failed. Each outcome has the route of the letter and the failed attempts before it. With --wait it
/// also prints the first reply.
///
/// Works with and without a gateway; agents on other hosts are reachable while a gateway is running
/// (`fipa up`). The exit code is 0 only if no outcome is failed and, with --wait, a reply was
/// received. The wait ends at once when the receiver leaves or dies. A FIPA failure message about the letter from a message transport service does not count
/// as a reply.
///
/// With --answers the command waits for several replies. At the end of the wait it answers every
/// proposal: with accept-proposal if --accept names its sender, and otherwise with reject-proposal. It
/// then waits for the results of the accepted ones.
///
/// With --count or --rate the message is sent repeatedly. The command then prints failed outcomes, and a
/// summary at the end.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa send arm_1 hello
  fipa send --to arm_1 --performative request --content '(lift sample-3)' --wait
  fipa send --to 'arm_.*' --content stop               to all agents whose names match
  fipa send --to camera --content-file picture.raw --deadline 30s
  fipa send --to echo@jade --address http://10.0.0.7:7778/acc --wait    an agent of another platform
  head -c 4096 /dev/urandom | fipa send --to camera --content-file - --json
  fipa send --to camera --content x --rate 10 --count 100
  fipa send --to camera --content x --rate 10 --numbered
  fipa send --to 'arm_.*' -p cfp --protocol fipa-contract-net --content '(carry crate)' \\
      --wait --answers 3 --accept arm_2

JSON:
  { \"deliveries\": [ { \"receiver\": name, \"outcome\": \"delivered\", \"sent\" or \"failed\",
                      \"via\": transport, unless failed, \"reason\": text, if failed,
                      \"attempts\": [ { \"via\", \"location\", \"error\" } ] } ],
    \"reply\": the reply as `fipa decode` prints it, if one was received; with --answers
             \"replies\": [ reply ],
    \"accepted\" and \"rejected\": [ name ], the senders of proposals, if there are any,
    \"results\": [ the last messages of the accepted agents ],
    \"failures\": [ { \"from\": name, \"receiver\": name or null, \"reason\": text } ], the failure
                messages about the letter, if any were received with --wait,
    \"gone\": [ name ], the receivers that left or died before they replied, if there are any }

With --count or --rate, one object on each line:
  { \"number\": of the message, from 1, \"deliveries\": as above }
  { \"messages\": number, \"delivered\", \"sent\" and \"failed\": numbers of outcomes,
    \"seconds\": number }  at the end")]
pub(crate) struct Arguments {
    /// Name of the receiver, or a pattern such as 'arm_.*'; repeatable
    #[arg(long, value_name = "NAME", add = complete::agents())]
    to: Vec<AgentId>,

    #[command(flatten)]
    addresses: membership::Addresses,

    /// Name of the sending agent [default: a random, unused name]
    #[arg(long, value_name = "NAME")]
    from: Option<AgentId>,

    /// Performative: inform, request, query-ref and so on, or a word of your own
    #[arg(long, short, default_value = "inform", value_name = "ACT")]
    performative: Performative,

    /// Content of the message
    #[arg(long, value_name = "TEXT", conflicts_with = "content_file")]
    content: Option<String>,

    /// Content of the message: the bytes of this file; - for standard input
    #[arg(long, value_name = "FILE")]
    content_file: Option<PathBuf>,

    /// Deadline of the delivery, for example 30s [default: mts.deadline]
    #[arg(long, value_name = "TIME", value_parser = deadline)]
    deadline: Option<Duration>,

    /// Wait for a reply
    #[arg(long)]
    wait: bool,

    /// Number of replies to wait for
    #[arg(long, value_name = "N", requires = "wait",
          value_parser = clap::value_parser!(u32).range(1..=10_000))]
    answers: Option<u32>,

    /// Accept the proposal of this agent; others are rejected; repeatable
    #[arg(long, value_name = "NAME", requires = "wait")]
    accept: Vec<AgentId>,

    /// Send the message this number of times [default with --rate: until Ctrl-C]
    #[arg(long, short, value_name = "N", conflicts_with = "wait",
          value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,

    /// Send this number of messages per second, for example 10 or 0.5 [default with --count: each one
    /// after the outcome of the one before]
    #[arg(long, value_name = "N", conflicts_with = "wait", value_parser = repeat::rate)]
    rate: Option<f64>,

    /// With --count or --rate: append the number of the message to its content, after a space
    #[arg(long, conflicts_with = "wait")]
    numbered: bool,

    /// With --count or --rate: end after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", conflicts_with = "wait",
          value_parser = options::duration)]
    time: Option<Duration>,

    /// Maximum wait for the replies, for example 10s
    #[arg(long, value_name = "TIME", default_value = "10s", requires = "wait",
          value_parser = options::duration)]
    timeout: Duration,

    /// Print JSON
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    parameters: Parameters,

    /// Name of the receiver: a short form of --to
    #[arg(value_name = "NAME", required_unless_present = "to", add = complete::agents())]
    receiver: Option<AgentId>,

    /// Content of the message: a short form of --content
    #[arg(value_name = "TEXT", conflicts_with_all = ["content", "content_file"])]
    text: Option<String>,
}

/// The other parameters of a message (FIPA00061).
#[derive(Debug, Args)]
#[command(next_help_heading = "Parameters of the message")]
struct Parameters {
    /// Interaction protocol, for example fipa-request
    #[arg(long, value_name = "WORD")]
    protocol: Option<String>,

    /// Conversation identifier [default with --wait: a random one]
    #[arg(long, value_name = "TEXT")]
    conversation_id: Option<String>,

    /// Expected in-reply-to of the reply [default with --wait: a random text]
    #[arg(long, value_name = "TEXT")]
    reply_with: Option<String>,

    /// Agent that receives the replies instead of the sender; repeatable
    #[arg(long, value_name = "NAME", conflicts_with = "wait")]
    reply_to: Vec<AgentId>,

    /// Value of the reply-with parameter of the message that this message answers
    #[arg(long, value_name = "TEXT")]
    in_reply_to: Option<String>,

    /// Latest time of a reply, for example 30s (from now) or 2030-01-31T12:00:00Z
    #[arg(long, value_name = "TIME", value_parser = reply_by)]
    reply_by: Option<Time>,

    /// Fence of a lock of the receiver's resource: the FIPA_FENCE of `fipa lock`; repeatable
    #[arg(long, value_name = "FENCE")]
    fence: Vec<Fence>,

    /// Language of the content
    #[arg(long, value_name = "TEXT")]
    language: Option<String>,

    /// Encoding of the content
    #[arg(long, value_name = "TEXT")]
    encoding: Option<String>,

    /// Ontology of the content
    #[arg(long, value_name = "TEXT")]
    ontology: Option<String>,
}

pub(crate) fn run(mut arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    if let Some(receiver) = arguments.receiver.take() {
        if !arguments.to.is_empty() {
            return Err(Failure::wrong_usage(
                format!("{:?} is given beside --to", receiver.name()),
                "NAME",
                "write `fipa send NAME TEXT`, or `fipa send --to NAME --content TEXT`",
            ));
        }
        arguments.to.push(receiver);
        arguments.content = arguments.text.take().or(arguments.content);
    }
    if arguments.addresses.is_given() && arguments.to.len() != 1 {
        return Err(Failure::wrong_usage(
            "--address is the address of one receiver",
            "--address",
            "give --to once, and send to the other receivers by another command",
        ));
    }
    report::warn_of_performatives([&arguments.performative]);
    if let Some(named) = &arguments.parameters.protocol {
        protocol::warn_if_misspelled(named, global);
    }
    // Read before the domain is joined: input from a terminal can take long.
    let content = match (arguments.content.take(), &arguments.content_file) {
        (Some(text), _) => Some(text.into_bytes()),
        (None, Some(file)) => Some(input::content(file, &config)?),
        (None, None) => None,
    };
    let is_repeated = arguments.count.is_some() || arguments.rate.is_some();
    for (given, what, option) in [
        (
            arguments.time.is_some(),
            "--for limits repeated sending",
            "--for",
        ),
        (
            arguments.numbered,
            "--numbered is for repeated sending",
            "--numbered",
        ),
    ] {
        if given && !is_repeated {
            let help = "give --rate or --count, too";
            return Err(Failure::wrong_usage(what, option, help));
        }
    }
    if is_repeated {
        return options::block_on(repeat::send(arguments, content, &config))?;
    }
    membership::run(async {
        // A wait ends at once when the receiver leaves, which the kernel reports.
        let domain = match arguments.wait {
            true => membership::join(&config).await?,
            false => membership::join_briefly(&config).await?,
        };
        let agent = register(&domain, &arguments, &config).await?;
        let done = match located(&agent, &arguments).await {
            Ok(to) => {
                arguments.to = to;
                converse(&agent, &arguments, content, &config).await
            }
            Err(failure) => Err(failure),
        };
        drop(agent);
        domain.close().await;
        done
    })
}

/// Registers the sending agent.
async fn register(
    domain: &fipa::Domain,
    arguments: &Arguments,
    config: &Config,
) -> Result<Agent, Failure> {
    let name = match &arguments.from {
        Some(id) => id.name().to_owned(),
        None => format!("fipa-send-{}", Incarnation::random()),
    };
    let options = RegisterOptions {
        agent_type: "fipa-send".to_owned(),
        ..RegisterOptions::default()
    };
    let agent = membership::register(domain, &name, options, config).await?;
    if arguments.from.is_none() {
        // No earlier agent had this name.
        agent.protocols().set_history(History::Complete);
    }
    Ok(agent)
}

fn not_sent(error: &fipa::error::SendError) -> Failure {
    Failure::failed(
        format!("cannot send the message: {}", ErrorChain(error)),
        "this process",
        advice::not_sent(error),
    )
}

/// Returns the receivers, with their address if one is given.
async fn located(agent: &Agent, arguments: &Arguments) -> Result<Vec<AgentId>, Failure> {
    match arguments.to.as_slice() {
        [to] => {
            let to = arguments.addresses.of(agent, to).await?;
            Ok(vec![to])
        }
        several => Ok(several.to_vec()),
    }
}

/// Content from this size is sent with a line that shows the progress, in bytes.
const LARGE: usize = 1 << 20;

/// A line for large content, which can take long over a network. It is not drawn when standard error is no
/// terminal. It has no bar, because a transport does not report the bytes that have arrived.
fn progress(size: usize, deadline: Duration) -> ProgressBar {
    if size < LARGE {
        return ProgressBar::hidden();
    }
    let progress = ProgressBar::new_spinner();
    let style = ProgressStyle::with_template("{spinner} {msg}: {elapsed}");
    progress.set_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()));
    let deadline = humantime::format_duration(deadline);
    progress.set_message(format!(
        "sending {}, at most {deadline}",
        HumanBytes(size as u64)
    ));
    progress.enable_steady_tick(Duration::from_millis(200));
    progress
}

/// Sorts outcomes by the order in which the receivers were given. Members of coalitions are last.
fn in_order_given(deliveries: &mut Deliveries, to: &[AgentId]) {
    let names = to
        .iter()
        .map(|id| (id.name(), Matcher::parse(id.name()).ok()));
    let names: Vec<(&str, Option<Matcher>)> = names.collect();
    let place = |delivery: &Delivery| {
        let receiver = &*delivery.receiver;
        let is_named = |(name, matcher): &(&str, Option<Matcher>)| {
            let is_match = |matcher: &Matcher| matcher.matches(receiver);
            *name == receiver || matcher.as_ref().is_some_and(is_match)
        };
        names.iter().position(is_named).unwrap_or(names.len())
    };
    deliveries.0.sort_by_cached_key(place);
}

/// Sends the message, waits for the replies if requested, and prints the outcomes and the replies.
async fn converse(
    agent: &Agent,
    arguments: &Arguments,
    content: Option<Vec<u8>>,
    config: &Config,
) -> Result<(), Failure> {
    let message = message(agent, arguments, content)?;
    let deadline = arguments.deadline.unwrap_or(config.mts.deadline);
    // Before the message is sent, so that no departure is missed.
    let mut partners = agent.watch_partners();
    let progress = progress(
        message.content().map_or(0, |content| content.len()),
        deadline,
    );
    let sent = agent.send_within(message.clone(), deadline).await;
    progress.finish_and_clear();
    let mut deliveries = sent.map_err(|error| not_sent(&error))?;
    in_order_given(&mut deliveries, &arguments.to);
    if !arguments.json {
        output::text(&format!("{deliveries}\n"))?;
    }
    let any_succeeded = deliveries.0.iter().any(|one| one.outcome.is_success());
    let mut answers = Answers::default();
    let mut settled = Settled::default();
    if arguments.wait && any_succeeded {
        let sent = deliveries.0.iter().filter(|one| one.outcome.is_success());
        let reached: Vec<&str> = sent.map(|one| &*one.receiver).collect();
        answers = wait(agent, &message, &mut partners, &reached, arguments).await?;
        settled = settle::proposals(agent, &message, &answers, arguments).await?;
    }
    if arguments.json {
        let mut json = json!({ "deliveries": deliveries });
        let mut replies = answers
            .replies
            .iter()
            .map(|it| message_to_json(it.message()));
        if arguments.answers.is_some() {
            json["replies"] = replies.collect();
        } else if let Some(reply) = replies.next() {
            json["reply"] = reply;
        }
        settled.add_to(&mut json);
        if !answers.failures.is_empty() {
            let failures = answers.failures.iter().map(FailureMessage::json);
            json["failures"] = failures.collect();
        }
        if !answers.gone.is_empty() {
            json["gone"] = json!(answers.gone);
        }
        output::json(&json)?;
    }
    let no_reply = answers
        .timed_out
        .then(|| no_reply(&deliveries, &answers, arguments));
    let failures = advice::failures(&deliveries, agent, config);
    let reported = answers.failures.iter().map(FailureMessage::failure);
    let is_short = answers.replies.len() < arguments.replies();
    let gone = is_short.then(|| gone(&answers.gone));
    let all = failures.into_iter().chain(reported);
    let all = all.chain(gone.flatten()).chain(no_reply);
    Failure::all(all.chain(settled.failures))
}

impl Arguments {
    /// Number of replies to wait for.
    fn replies(&self) -> usize {
        self.answers.map_or(1, |answers| answers as usize)
    }
}

/// The messages received during the wait for a reply.
#[derive(Debug, Default)]
struct Answers {
    replies: Vec<Incoming>,
    failures: Vec<FailureMessage>,
    /// The receivers that left or died before they replied.
    gone: Vec<String>,
    timed_out: bool,
}

/// A FIPA failure message about the delivery of the letter.
#[derive(Debug)]
struct FailureMessage {
    from: String,
    failure: DeliveryFailure,
}

impl FailureMessage {
    fn of(message: &Message) -> Option<Self> {
        let from = message.sender().map_or("", AgentId::name).to_owned();
        let failure = DeliveryFailure::read(message)?;
        Some(Self { from, failure })
    }

    fn json(&self) -> Value {
        let DeliveryFailure { receiver, reason } = &self.failure;
        json!({ "from": self.from, "receiver": receiver, "reason": reason })
    }

    fn failure(&self) -> Failure {
        let DeliveryFailure { receiver, reason } = &self.failure;
        let receiver = receiver.as_deref().unwrap_or("a receiver");
        Failure::failed(
            format!("not delivered: {reason}"),
            format!("{receiver:?}, in a failure message from {:?}", self.from),
            "check the receiver with `fipa agents`, and the log of that message transport service",
        )
    }
}

fn message(
    agent: &Agent,
    arguments: &Arguments,
    content: Option<Vec<u8>>,
) -> Result<Message, Failure> {
    let given = &arguments.parameters;
    let mut builder = agent
        .message(arguments.performative.clone())
        .receivers(arguments.to.iter().cloned());
    for agent in &given.reply_to {
        builder = builder.reply_to(agent.clone());
    }
    if let Some(content) = content {
        builder = builder.content(content);
    }
    let unique = || arguments.wait.then(|| Incarnation::random().to_string());
    if let Some(text) = given.conversation_id.clone().or_else(unique) {
        builder = builder.conversation_id(text);
    }
    if let Some(text) = given.reply_with.clone().or_else(unique) {
        builder = builder.reply_with(text);
    }
    if let Some(text) = &given.in_reply_to {
        builder = builder.in_reply_to(text);
    }
    if let Some(text) = &given.protocol {
        builder = builder.protocol(text);
    }
    if let Some(text) = &given.language {
        builder = builder.language(text);
    }
    if let Some(text) = &given.encoding {
        builder = builder.encoding(text);
    }
    if let Some(text) = &given.ontology {
        builder = builder.ontology(text);
    }
    if let Some(time) = given.reply_by {
        builder = builder.reply_by(time);
    }
    builder = with_fences(builder, &given.fence);
    builder.build().map_err(|error| {
        Failure::wrong_usage(
            error.to_string(),
            "the command line",
            "`fipa send --help` describes the parameters of a message",
        )
    })
}

/// Waits for the replies of the `reached` receivers, prints them, and collects failure messages about the
/// letter. The wait ends early when no further reply can come.
async fn wait(
    agent: &Agent,
    message: &Message,
    partners: &mut PartnerWatch,
    reached: &[&str],
    arguments: &Arguments,
) -> Result<Answers, Failure> {
    let mut answers = Answers::default();
    for receiver in reached {
        partners.add(receiver);
    }
    let all = async {
        while !answers.are_complete(reached, arguments.replies()) {
            let received = tokio::select! {
                // A reply that has arrived precedes the end of its sender.
                biased;
                received = agent.receive() => received,
                event = partners.next() => {
                    answers.note(event);
                    continue;
                }
            };
            match received {
                // The library has logged the violation.
                Ok(incoming) if incoming.violation().is_some() => {}
                // A message of this process to its own agent; the outcomes have it already.
                Ok(incoming) if incoming.via.is_none() => {}
                Ok(incoming) if incoming.message().is_reply_to(message) => {
                    match FailureMessage::of(incoming.message()) {
                        Some(failure) => answers.failures.push(failure),
                        None => {
                            if !arguments.json {
                                output::text(&format!("reply: {}\n", shown(incoming.message())))?;
                            }
                            answers.replies.push(incoming);
                        }
                    }
                }
                Ok(other) => report::warn(&format!("ignored, not a reply: {}", other.message())),
                Err(error) => {
                    return Err(Failure::failed(
                        format!("cannot wait for a reply: {}", ErrorChain(&error)),
                        format!("agent {:?}", agent.name()),
                        "send the message again",
                    ));
                }
            }
        }
        Ok(())
    };
    match tokio::time::timeout(arguments.timeout, all).await {
        Ok(ended) => ended?,
        Err(_) => answers.timed_out = true,
    }
    Ok(answers)
}

impl Answers {
    /// Whether there are as many replies as wanted, or no further one can come: each receiver is gone or
    /// has a failure message, or has replied if one reply of each is enough.
    fn are_complete(&self, reached: &[&str], wanted: usize) -> bool {
        let ended = self.failures.len() + self.gone.len();
        if self.replies.len() >= wanted || ended >= reached.len() {
            return true;
        }
        let repliers = self.replies.iter().filter_map(|it| it.message().sender());
        let failed = self
            .failures
            .iter()
            .filter_map(|it| it.failure.receiver.as_deref());
        let gone = self.gone.iter().map(String::as_str);
        let ended: HashSet<&str> = repliers
            .map(AgentId::name)
            .chain(failed)
            .chain(gone)
            .collect();
        wanted <= reached.len() && reached.iter().all(|name| ended.contains(name))
    }

    /// Notes an event of a receiver, and prints it unless the command ends with it.
    fn note(&mut self, event: PartnerEvent) {
        match event {
            PartnerEvent::Gone { agent } => self.gone.push(agent),
            PartnerEvent::Unreachable { agent, since } => report::warn(&format!(
                "the host of {agent:?} has been silent for {} s; still waiting",
                since.elapsed().as_secs()
            )),
            PartnerEvent::Returned { agent } => {
                report::warn(&format!("the host of {agent:?} answers again"));
            }
            // A later version may report more; it has no text here.
            _ => {}
        }
    }
}

/// The failure of receivers that are gone, if there are any.
fn gone(names: &[String]) -> Option<Failure> {
    let quoted: Vec<&str> = names.iter().map(String::as_str).collect();
    (!names.is_empty()).then(|| {
        Failure::failed(
            "gone before it replied: it has left, or its process has ended",
            advice::receivers(&quoted),
            "start the agent again, and check its log",
        )
    })
}

fn no_reply(deliveries: &Deliveries, answers: &Answers, arguments: &Arguments) -> Failure {
    let reached = deliveries.0.iter().filter(|one| one.outcome.is_success());
    let reached: Vec<&str> = reached.map(|one| &*one.receiver).collect();
    let timeout = humantime::format_duration(arguments.timeout);
    Failure::failed(
        match answers.replies.len() {
            0 => format!("no reply within {timeout}"),
            some => format!("{some} of {} replies within {timeout}", arguments.replies()),
        },
        advice::receivers(&reached),
        "check whether the receiver answers such messages, or wait longer with --timeout",
    )
}

/// Parses a deadline, with the limits of `mts.deadline`.
fn deadline(text: &str) -> Result<Duration, String> {
    let deadline = options::duration(text)?;
    if deadline.is_zero() || deadline > Duration::from_secs(3600) {
        return Err("expected more than 0 and at most 1h".to_owned());
    }
    Ok(deadline)
}

fn reply_by(text: &str) -> Result<Time, String> {
    let from_now = humantime::parse_duration(text)
        .ok()
        .and_then(|span| SystemTime::now().checked_add(span))
        .map(Time::from_system_time);
    let time = from_now.unwrap_or_else(|| Time::from_rfc3339(text).or_else(|_| text.parse()));
    time.map_err(|error| error.to_string())
}
