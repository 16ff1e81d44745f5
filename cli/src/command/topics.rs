//! `fipa topics`: lists the topics of agents, their rates and their subscribers.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use fipa::admin::stopped::StoppedAgent;
use fipa::config::{Effective, Sources};
use fipa::platform::{AgentDescription, PlatformError, ServiceDescription};
use fipa::protocol::DialogueError;
use fipa::topics::{SubscriberStatus, TopicStatus, TopicsError};
use fipa::{Agent, AgentId, Config, Domain};
use fipa_acl::{escape, escape_name};
use serde_json::{Value, json};

use super::ask::{agents_of_this_host, ask_all};
use super::df::asking;
use super::request::in_full;
use crate::complete;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// List the topics of agents, with their rates and subscribers
///
/// Without an agent, all agents of this host and of connected hosts are listed that publish topics. Without a gateway,
/// all agents of this host are asked. With an agent, each subscriber is listed, too: they show why one of them gets
/// nothing.
///
/// TYPE is the media type that the publisher declares. RATE is the publisher's own rate over its last 32 values. The
/// number in parentheses is the declared rate. `fipa subscribe --rate` measures the rate at a receiver. BYTES is the
/// length of the newest value.
///
/// KEEP shows the values that a subscriber gets if it is slower than the publisher: all, or the newest ones. DELIVERED
/// counts values that are in the queue of the subscriber, REPLACED those that a newer one replaced before they left, FAILED
/// those that were lost. WAITING counts the values on their way and those that wait to leave. STATE is `stopped` for a
/// process of this host that does not run, for example after Ctrl-Z.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa topics
  fipa topics camera                  with the subscribers
  fipa topics camera --watch
  fipa topics --json

The values of a topic, and their rate at a receiver:
  fipa subscribe camera image
  fipa subscribe camera image --rate

JSON, with --watch one array on each line:
  [ { \"agent\": name, \"topics\": null if the agent does not answer, or [ { \"name\", \"media_type\", \"rate\": declared,
      \"measured_rate\", \"published\": number, \"bytes\", \"subscribers\": number,
      \"first_subscribers\": [ { \"name\", \"stopped\": process or null, \"keep\", \"delivered\", \"replaced\",
      \"failed\", \"waiting\", \"last_failure\" } ] } ] } ]")]
pub(crate) struct Arguments {
    /// Name of the agent [default: all agents that publish topics]
    #[arg(add = complete::agents())]
    agent: Option<AgentId>,

    /// Repeat the list each second until Ctrl-C
    #[arg(long, short)]
    watch: bool,

    /// With --watch: end after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", requires = "watch", value_parser = options::duration)]
    time: Option<Duration>,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Time between two lists of --watch.
const INTERVAL: Duration = Duration::from_secs(1);

/// Clears a terminal and moves the cursor to its first line.
const CLEAR: &str = "\x1b[2J\x1b[H";

/// The topics of agents by name; `None` if an agent does not answer.
pub(super) type Listed = BTreeMap<String, Option<Vec<TopicStatus>>>;

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    if !arguments.watch {
        return membership::run(async {
            let domain = membership::join(&config).await?;
            let listed = async {
                let agent = Arc::new(asking(&domain, "topics", &config).await?);
                let listed = list(&agent, &arguments, &config).await?;
                print(&agent, &listed, &arguments)
            };
            let listed = listed.await;
            domain.close().await;
            listed
        });
    }
    let register = async |domain: &Domain| asking(domain, "topics", &config).await;
    let watch = async |agent: &Agent, stop: &mut Stop| {
        let agent = Arc::new(agent.clone());
        let mut turns = tokio::time::interval(INTERVAL);
        turns.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let print_all = async {
            loop {
                turns.tick().await;
                let listed = list(&agent, &arguments, &config).await?;
                print(&agent, &listed, &arguments)?;
            }
        };
        tokio::select! {
            ended = print_all => ended,
            () = stop.requested() => Ok(()),
            () = options::after(arguments.time) => Ok(()),
        }
    };
    membership::run_agent(&config, register, watch)
}

async fn list(
    agent: &Arc<Agent>,
    arguments: &Arguments,
    config: &Config,
) -> Result<Listed, Failure> {
    if let Some(publisher) = &arguments.agent {
        return match agent.topics_of(publisher).await {
            Ok(topics) => Ok([(publisher.name().to_owned(), Some(topics))].into()),
            Err(error) => match no_agent(agent, publisher, config).await {
                Some(failure) => Err(failure),
                None => Err(failed(&error, publisher, agent, config)),
            },
        };
    }
    list_all(agent, config).await
}

/// The error report if no agent has this name and an agent publishes a topic of this name.
async fn no_agent(agent: &Arc<Agent>, name: &AgentId, config: &Config) -> Option<Failure> {
    let name = name.name();
    if agent.domain().directory().lookup(name).is_some() {
        return None;
    }
    let (topic, publishers) = publishers_of(agent, name, config).await?;
    let first = publishers.first()?;
    Some(Failure::failed(
        format!("there is no agent \"{}\"", escape(name)),
        format!("domain {}", config.domain),
        format!(
            "\"{}\" is a topic of {}: fipa topics {}",
            escape(&topic),
            publishers.join(", "),
            first
        ),
    ))
}

/// Returns the topic and its publishers as text, if there are any. The topic may have the slash of a name of ROS.
async fn publishers_of(
    agent: &Arc<Agent>,
    topic: &str,
    config: &Config,
) -> Option<(String, Vec<String>)> {
    let topic = topic.trim_start_matches('/');
    let all = list_all(agent, config).await.ok()?;
    let publishes = |topics: &Option<Vec<TopicStatus>>| {
        let mut topics = topics.iter().flatten();
        topics.any(|it| it.name == topic)
    };
    let found = all.iter().filter(|(_, topics)| publishes(topics));
    let found: Vec<String> = found
        .map(|(publisher, _)| escape_name(publisher).into_owned())
        .collect();
    (!found.is_empty()).then(|| (topic.to_owned(), found))
}

/// Maximum wait for the tip for a command line without an agent.
const TIP_WITHIN: Duration = Duration::from_secs(3);

/// The tip for `fipa subscribe` with one argument, an agent or the topic of one, if it is known.
pub(crate) fn tip_for_one_argument(name: &str, sources: &Sources) -> Option<String> {
    let config = Effective::load(sources).ok()?.into_config();
    let known = Domain::names(&config).ok()?;
    if known.is_empty() {
        return None;
    }
    if known.iter().any(|it| it == name) {
        let agent = escape_name(name);
        return Some(format!("fipa topics {agent} lists the topics of {agent}"));
    }
    let found = membership::run(async {
        let domain = membership::join_briefly(&config).await?;
        let found = async {
            let agent = Arc::new(asking(&domain, "topics", &config).await.ok()?);
            publishers_of(&agent, name, &config).await
        };
        let found = tokio::time::timeout(TIP_WITHIN, found).await;
        domain.close().await;
        Ok(found.ok().flatten())
    });
    let (topic, publishers) = found.ok().flatten()?;
    let topic = escape_name(&topic);
    Some(format!(
        "\"{topic}\" is a topic of {}: fipa subscribe {} {topic}",
        publishers.join(", "),
        publishers.first()?
    ))
}

/// Lists the topics of all agents that publish some.
pub(super) async fn list_all(agent: &Arc<Agent>, config: &Config) -> Result<Listed, Failure> {
    match agent.df() {
        Ok(df) => {
            let topics = AgentDescription::from(ServiceDescription::of_type("topic"));
            let found = df.search(&topics).await;
            let found = found.map_err(|error| super::df::failed(&error, config))?;
            let names = found.into_iter().filter_map(|it| it.name);
            Ok(topics_of_all(agent, names).await)
        }
        Err(PlatformError::NoAgent(_)) => {
            let mut listed = topics_of_all(agent, agents_of_this_host(agent)).await;
            // An agent without topics does not answer.
            listed.retain(|_, topics| topics.is_some());
            Ok(listed)
        }
        Err(error) => Err(super::df::failed(&error, config)),
    }
}

/// Asks agents for their topics at the same time.
async fn topics_of_all(
    agent: &Arc<Agent>,
    publishers: impl IntoIterator<Item = AgentId>,
) -> Listed {
    let answers = ask_all(publishers, |publisher| {
        let agent = Arc::clone(agent);
        async move { agent.topics_of(&publisher).await }
    });
    answers.await
}

fn print(agent: &Agent, listed: &Listed, arguments: &Arguments) -> Result<(), Failure> {
    let stopped = |subscriber: &SubscriberStatus| {
        let entry = agent.domain().directory().lookup(&subscriber.name)?;
        StoppedAgent::of(&entry)
    };
    if arguments.json {
        let agents = listed.iter().map(|(agent, topics)| {
            let topics = topics.as_ref();
            let topics = topics.map(|all| {
                all.iter()
                    .map(|it| status(it, stopped))
                    .collect::<Vec<Value>>()
            });
            json!({ "agent": agent, "topics": topics })
        });
        let agents: Vec<Value> = agents.collect();
        return match arguments.watch {
            true => output::json_line(&agents),
            false => output::json(&agents),
        };
    }
    let mut text = match arguments.watch && output::terminal_width().is_some() {
        true => CLEAR.to_owned(),
        false => String::new(),
    };
    if listed.values().flatten().all(Vec::is_empty) && listed.values().all(Option::is_some) {
        text.push_str("no agent publishes a topic\n");
        return output::text(&text);
    }
    let mut table = output::table(["AGENT", "TOPIC", "TYPE", "RATE", "BYTES", "SUBSCRIBERS"]);
    for (agent, topics) in listed {
        let agent = escape_name(agent).into_owned();
        match topics {
            Some(topics) => {
                for topic in topics {
                    let media_type = topic.media_type.as_deref();
                    table.add_row([
                        agent.clone(),
                        escape(&topic.name).into_owned(),
                        media_type.map_or_else(|| "-".to_owned(), |it| escape(it).into_owned()),
                        rate(topic),
                        topic
                            .bytes
                            .map_or_else(|| "-".to_owned(), |it| it.to_string()),
                        topic.subscribers.to_string(),
                    ]);
                }
            }
            None => {
                table.add_row([agent.as_str(), "(does not answer)", "-", "-", "-", "-"]);
            }
        }
    }
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{table}");
    if arguments.agent.is_some() {
        let topics = listed.values().flatten().flatten();
        for topic in topics.filter(|topic| !topic.first_subscribers.is_empty()) {
            let _ = write!(text, "\n{}", subscribers(topic, stopped));
        }
    }
    output::text(&text)
}

/// The subscribers of a topic, in a table.
fn subscribers(
    topic: &TopicStatus,
    stopped: impl Fn(&SubscriberStatus) -> Option<StoppedAgent>,
) -> String {
    let mut text = format!("subscribers to {}:\n", escape(&topic.name));
    let mut table = output::table([
        "SUBSCRIBER",
        "STATE",
        "KEEP",
        "DELIVERED",
        "REPLACED",
        "FAILED",
        "WAITING",
    ]);
    let mut reasons = String::new();
    for subscriber in &topic.first_subscribers {
        let name = escape_name(&subscriber.name);
        let stopped = stopped(subscriber);
        let state = stopped.as_ref().map_or("", |_| "stopped");
        table.add_row([
            name.clone().into_owned(),
            state.to_owned(),
            escape(&subscriber.keep).into_owned(),
            subscriber.delivered.to_string(),
            subscriber.replaced.to_string(),
            subscriber.failed.to_string(),
            subscriber.waiting.to_string(),
        ]);
        if let Some(stopped) = stopped {
            let _ = writeln!(reasons, "{}", stopped.advice());
        }
        if let Some(failure) = &subscriber.last_failure {
            let _ = writeln!(reasons, "{name}: last failure: {}", escape(failure));
        }
    }
    let _ = write!(text, "{table}\n{reasons}");
    let listed = topic.first_subscribers.len() as u64;
    if topic.subscribers > listed {
        let _ = writeln!(text, "and {} more", topic.subscribers - listed);
    }
    text
}

/// The measured rate, and in parentheses the declared one.
fn rate(topic: &TopicStatus) -> String {
    let measured = topic.measured_rate.map(|hertz| format!("{hertz:.1} Hz"));
    match (measured, topic.rate) {
        (Some(measured), Some(declared)) => format!("{measured} ({declared})"),
        (Some(measured), None) => measured,
        (None, Some(declared)) => format!("({declared} Hz)"),
        (None, None) => "-".to_owned(),
    }
}

fn status(
    topic: &TopicStatus,
    stopped: impl Fn(&SubscriberStatus) -> Option<StoppedAgent>,
) -> Value {
    let subscriber = |it: &SubscriberStatus| {
        json!({
            "name": it.name, "stopped": stopped(it).map(|it| it.process), "keep": it.keep, "delivered": it.delivered,
            "replaced": it.replaced, "failed": it.failed, "waiting": it.waiting, "last_failure": it.last_failure,
        })
    };
    let first: Vec<Value> = topic.first_subscribers.iter().map(subscriber).collect();
    json!({
        "name": topic.name, "media_type": topic.media_type, "rate": topic.rate,
        "measured_rate": topic.measured_rate, "published": topic.published, "bytes": topic.bytes,
        "subscribers": topic.subscribers, "first_subscribers": first,
    })
}

fn failed(error: &TopicsError, agent: &AgentId, asking: &Agent, config: &Config) -> Failure {
    let problem = match error {
        TopicsError::Dialogue(error) => in_full(error),
        other => fipa::error::ErrorChain(other).to_string(),
    };
    let as_topic;
    let as_stopped;
    let help = match error {
        _ if let Some(stopped) = membership::stopped(asking, agent.name()) => {
            as_stopped = stopped.advice();
            &as_stopped
        }
        TopicsError::Dialogue(DialogueError::NotDelivered { .. })
            if let Some((publisher, topic)) = options::of_publisher(agent.name()) =>
        {
            as_topic = format!(
                "the agent and the topic are two arguments: `fipa topics {publisher}` lists the topics, and \
                 `fipa subscribe {publisher} {topic}` prints the values"
            );
            &as_topic
        }
        TopicsError::Dialogue(DialogueError::TimedOut | DialogueError::NotUnderstood(_))
        | TopicsError::Parse(_)
        | TopicsError::Read(_) => {
            "the agent may publish no topics; `fipa topics` lists the agents that do"
        }
        _ => "`fipa agents` shows whether the agent is known, and whether its process is stopped",
    };
    Failure::failed(
        format!(
            "no list of topics from {}: {problem}",
            escape_name(agent.name())
        ),
        format!("domain {}", config.domain),
        help,
    )
}
