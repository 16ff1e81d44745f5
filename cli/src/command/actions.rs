//! `fipa actions`: lists the actions of robots and the goals that they run, and cancels goals.

use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use fipa::actions::{
    ActionDescription, ActionError, GoalRef, GoalStatus, ParameterDescription, Policy, Refusal,
    Term, Type,
};
use fipa::protocol::DialogueError;
use fipa::{Agent, AgentId, Config, RegisterOptions};
use fipa_acl::escape;
use serde_json::{Value, json};

use super::ask::{agents_of_this_host, ask_all};
use super::df::asking;
use super::request::in_full;
use crate::complete;
use crate::membership;
use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// List the actions that a robot offers or the goals that it runs, show or cancel goals
///
/// Without a robot, all agents of this host are asked, and those that offer actions are listed.
///
/// --goal, --cancel and --cancel-all are for the operators of the robot: the agents that `access.operators` of the robot's
/// configuration names. The name of this command's agent is that of --agent. A client needs no such rule for its own
/// goals. --cancel and --cancel-all wait until the goals have ended; their clients get the name of the operator.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa actions
  fipa actions crex
  fipa actions crex --goals
  fipa actions crex --goal lift-17 --agent boss
  fipa actions crex --cancel lift-17 --agent boss
  fipa actions crex --cancel-all drive --agent boss
  fipa actions crex --json

JSON:
  [ { \"robot\": name, \"actions\": [ { \"name\", \"description\", \"policy\", \"fenced\", \"result\": type,
      \"parameters\": [ { \"name\", \"type\", \"unit\", \"min\", \"max\", \"default\": value in SL,
      \"description\", \"optional\" } ] } ] } ]
  with --goals, --goal, --cancel and --cancel-all: [ { \"robot\": name, \"goals\": [ { \"goal\", \"action\",
      \"client\", \"state\", \"age_ms\", \"fraction\", \"note\", \"value\": value in SL or null,
      \"result\": value in SL or null, \"failure\": text or null } ] } ]
  \"value\" and \"result\" are null with --goals")]
pub(crate) struct Arguments {
    /// Name of the robot [default: all agents of this host]
    #[arg(add = complete::agents())]
    robot: Option<AgentId>,

    /// List the goals that run or wait
    #[arg(long)]
    goals: bool,

    /// Show the state, the progress and the result of the goal with this id
    #[arg(long, value_name = "ID", requires = "robot", conflicts_with = "goals")]
    goal: Option<String>,

    /// Cancel the goal with this id
    #[arg(long, value_name = "ID", requires = "robot", conflicts_with_all = ["goals", "goal"])]
    cancel: Option<String>,

    /// Cancel all goals of this action
    #[arg(long, value_name = "ACTION", requires = "robot", conflicts_with_all = ["goals", "goal", "cancel"])]
    cancel_all: Option<String>,

    /// With --goal and --cancel: name of the client of the goal, if several clients have a goal with this id
    #[arg(long, value_name = "NAME", conflicts_with_all = ["goals", "cancel_all"])]
    client: Option<AgentId>,

    /// Name of the asking agent [default: a random, unused name]
    #[arg(long, value_name = "NAME")]
    agent: Option<AgentId>,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The answer of one robot.
enum Listed {
    Actions(Vec<ActionDescription>),
    Goals(Vec<GoalStatus>),
    /// Goals that were asked for or cancelled.
    Named(Vec<GoalStatus>),
}

impl Arguments {
    /// Names the goal of --goal or --cancel.
    fn named(&self, id: &str) -> GoalRef {
        let goal = GoalRef::from(id);
        match &self.client {
            Some(client) => goal.of(client.name()),
            None => goal,
        }
    }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let found = membership::run(async {
        let domain = membership::join(&config).await?;
        let found = async {
            let agent = Arc::new(match &arguments.agent {
                Some(id) => {
                    let options = RegisterOptions::default();
                    membership::register(&domain, id.name(), options, &config).await?
                }
                None => asking(&domain, "actions", &config).await?,
            });
            match &arguments.robot {
                Some(robot) => {
                    let listed = ask(&agent, robot, &arguments).await;
                    let listed = listed.map_err(|error| failed(&error, robot, &config))?;
                    Ok(vec![(robot.name().to_owned(), listed)])
                }
                None => Ok(all(&agent, arguments.goals).await),
            }
        };
        let found = found.await;
        domain.close().await;
        found
    })?;
    if arguments.json {
        let found = found.iter().map(|(robot, listed)| match listed {
            Listed::Actions(all) => {
                let all: Vec<Value> = all.iter().map(description).collect();
                json!({ "robot": robot, "actions": all })
            }
            Listed::Goals(all) | Listed::Named(all) => {
                let all: Vec<Value> = all.iter().map(status).collect();
                json!({ "robot": robot, "goals": all })
            }
        });
        return output::json(&found.collect::<Vec<_>>());
    }
    if found.is_empty() {
        return output::text("no agent of this host offers actions\n");
    }
    let mut text = String::new();
    for (robot, listed) in &found {
        match listed {
            Listed::Actions(all) if all.is_empty() => {
                text.push_str(&format!("{} offers no actions\n", escape(robot)));
            }
            Listed::Actions(all) => {
                for action in all {
                    text.push_str(&described(robot, action));
                }
            }
            Listed::Goals(all) => text.push_str(&goals(robot, all)),
            Listed::Named(all) if all.is_empty() => {
                text.push_str(&format!("{} runs no goals of this action\n", escape(robot)));
            }
            Listed::Named(all) => all.iter().for_each(|goal| text.push_str(&named(goal))),
        }
    }
    output::text(&text)
}

/// Asks one robot for the list, or for what the options name.
async fn ask(agent: &Agent, robot: &AgentId, arguments: &Arguments) -> Result<Listed, ActionError> {
    let of = agent.robot(robot.clone());
    Ok(Listed::Named(match arguments {
        Arguments { goal: Some(id), .. } => vec![of.status_of(arguments.named(id)).await?],
        Arguments {
            cancel: Some(id), ..
        } => vec![of.cancel(arguments.named(id)).await?],
        Arguments {
            cancel_all: Some(action),
            ..
        } => of.cancel_all(action).await?,
        _ => return list(agent, robot, arguments.goals).await,
    }))
}

async fn list(agent: &Agent, robot: &AgentId, goals: bool) -> Result<Listed, ActionError> {
    let robot = agent.robot(robot.clone());
    match goals {
        true => robot.status().await.map(Listed::Goals),
        false => robot.actions().await.map(Listed::Actions),
    }
}

/// Asks all agents of this host at the same time. Those that do not answer in time offer no actions.
async fn all(agent: &Arc<Agent>, goals: bool) -> Vec<(String, Listed)> {
    let answers = ask_all(agents_of_this_host(agent), |robot| {
        let agent = Arc::clone(agent);
        async move { list(&agent, &robot, goals).await }
    });
    let answers = answers.await.into_iter();
    let offered = answers.filter_map(|(name, listed)| Some((name, listed?)));
    offered.collect()
}

/// The error report of a call about actions.
pub(super) fn failed(error: &ActionError, robot: &AgentId, config: &Config) -> Failure {
    let no_operator;
    let help = match error {
        ActionError::Refused(Refusal::NotOperator(name)) => {
            no_operator = format!(
                "set `[access] operators = [{:?}]` in the configuration of the robot, or ask as an operator with \
                 --agent NAME",
                escape(name)
            );
            &no_operator
        }
        ActionError::Refused(Refusal::UnknownGoal(_)) => {
            "`fipa actions ROBOT --goals` lists the goals that run; an ended one is stored for ten minutes"
        }
        ActionError::Refused(Refusal::AmbiguousGoal(_)) => {
            "name the client with --client; `fipa actions ROBOT --goals` lists the clients"
        }
        ActionError::Refused(_) => {
            "`fipa actions ROBOT` shows the parameters, and --goals the goals that run"
        }
        ActionError::Failed(_) => {
            "the robot reports the reason; send the goal again when it is gone"
        }
        ActionError::Answer(_)
        | ActionError::Dialogue(DialogueError::TimedOut | DialogueError::NotUnderstood(_)) => {
            "the agent may offer no actions; `fipa actions` lists the agents that do"
        }
        _ => {
            "check with `fipa agents` whether the agent is known, and with `fipa watch` its answers"
        }
    };
    let problem = match error {
        ActionError::Dialogue(error) => in_full(error),
        other => fipa::error::ErrorChain(other).to_string(),
    };
    Failure::failed(
        problem,
        format!("robot {}, domain {:?}", escape(robot.name()), config.domain),
        help,
    )
}

/// The lines of one action.
fn described(robot: &str, action: &ActionDescription) -> String {
    let mut text = format!("{} {}", escape(robot), escape(&action.name));
    if let Some(words) = &action.description {
        text.push_str(&format!(": {}", escape(words)));
    }
    text.push('\n');
    let mut table = output::rows();
    table.add_rows(action.parameters.iter().map(parameter));
    if action.result != Type::Nothing {
        let result = escape(&action.result.to_string()).into_owned();
        table.add_row(["result".to_owned(), result]);
    }
    table.add_row(["while it runs".to_owned(), policy(action.policy)]);
    if action.fenced {
        table.add_row(["needs".to_owned(), "the fence of a lock".to_owned()]);
    }
    for column in table.column_iter_mut() {
        column.set_padding((2, 1));
    }
    text.push_str(&format!("{}\n", table.trim_fmt()));
    text
}

fn policy(policy: Policy) -> String {
    match policy {
        Policy::Queue(longest) => format!("up to {longest} goals wait"),
        Policy::Preempt => "a new goal takes its place".to_owned(),
        _ => "a goal beyond those that may run at once is refused".to_owned(),
    }
}

fn parameter(parameter: &ParameterDescription) -> [String; 3] {
    let mut facts = Vec::new();
    if let Some(unit) = &parameter.unit {
        facts.push(escape(unit).into_owned());
    }
    if let Some(range) = &parameter.range {
        facts.push(range.to_string());
    }
    if let Some(default) = &parameter.default {
        facts.push(format!("default {}", escape(&default.to_string())));
    }
    if parameter.optional {
        facts.push("optional".to_owned());
    }
    if let Some(words) = &parameter.description {
        facts.push(escape(words).into_owned());
    }
    [
        format!("{}=", escape(&parameter.name)),
        escape(&parameter.value_type.to_string()).into_owned(),
        facts.join("; "),
    ]
}

fn goals(robot: &str, all: &[GoalStatus]) -> String {
    if all.is_empty() {
        return format!("{} runs no goals\n", escape(robot));
    }
    let mut table = output::table([
        "ROBOT", "GOAL", "ACTION", "CLIENT", "STATE", "AGE", "PROGRESS",
    ]);
    table.add_rows(all.iter().map(|goal| {
        [
            escape(robot).into_owned(),
            escape(&goal.goal).into_owned(),
            escape(&goal.action).into_owned(),
            escape(&goal.client).into_owned(),
            goal.state.as_str().to_owned(),
            humantime::format_duration(Duration::from_millis(goal.age)).to_string(),
            progress(goal),
        ]
    }));
    format!("{}\n", table.trim_fmt())
}

/// The lines of a goal that was asked for or cancelled.
fn named(goal: &GoalStatus) -> String {
    let value = |value: &Term<'_>| escape(&value.to_string()).into_owned();
    let age = humantime::format_duration(Duration::from_millis(goal.age)).to_string();
    let progress = goal.progress.as_ref();
    let mut table = output::rows();
    for (name, text) in [
        ("goal", Some(escape(&goal.goal).into_owned())),
        ("action", Some(escape(&goal.action).into_owned())),
        ("client", Some(escape(&goal.client).into_owned())),
        ("state", Some(goal.state.as_str().to_owned())),
        ("age", Some(age)),
        ("progress", progress.map(|_| self::progress(goal))),
        (
            "value",
            progress.and_then(|it| it.value.as_ref()).map(value),
        ),
        ("result", goal.result.as_ref().map(value)),
        ("failure", goal.failure.as_ref().map(ToString::to_string)),
    ] {
        if let Some(text) = text {
            table.add_row([name.to_owned(), text]);
        }
    }
    format!("{}\n", table.trim_fmt())
}

/// The progress of a goal in one line.
fn progress(goal: &GoalStatus) -> String {
    let Some(progress) = &goal.progress else {
        return "-".to_owned();
    };
    let part = progress
        .fraction
        .map(|part| format!("{:.0} %", part * 100.0));
    let note = progress
        .note
        .as_deref()
        .map(|note| escape(note).into_owned());
    let parts: Vec<String> = part.into_iter().chain(note).collect();
    parts.join(" ")
}

fn description(action: &ActionDescription) -> Value {
    let parameters = action.parameters.iter().map(|parameter| {
        json!({
            "name": parameter.name,
            "type": parameter.value_type.to_string(),
            "unit": parameter.unit,
            "min": parameter.range.and_then(|range| range.min),
            "max": parameter.range.and_then(|range| range.max),
            "default": parameter.default.as_ref().map(ToString::to_string),
            "description": parameter.description,
            "optional": parameter.optional,
        })
    });
    json!({
        "name": action.name,
        "description": action.description,
        "policy": match action.policy {
            Policy::Queue(longest) => json!({ "queue": longest }),
            Policy::Preempt => json!("preempt"),
            _ => json!("reject"),
        },
        "fenced": action.fenced,
        "result": action.result.to_string(),
        "parameters": parameters.collect::<Vec<_>>(),
    })
}

/// The status of a goal as JSON.
fn status(goal: &GoalStatus) -> Value {
    let progress = goal.progress.as_ref();
    json!({
        "goal": goal.goal,
        "action": goal.action,
        "client": goal.client,
        "state": goal.state.as_str(),
        "age_ms": goal.age,
        "fraction": progress.and_then(|progress| progress.fraction),
        "note": progress.and_then(|progress| progress.note.as_deref()),
        "value": progress.and_then(|progress| progress.value.as_ref()).map(ToString::to_string),
        "result": goal.result.as_ref().map(ToString::to_string),
        "failure": goal.failure.as_ref().map(ToString::to_string),
    })
}
