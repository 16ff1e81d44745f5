//! `fipa do`: invokes an action of a robot, with its progress and its result.

use std::borrow::Cow;
use std::io::IsTerminal;
use std::pin::pin;
use std::time::Duration;

use clap::Args;
use fipa::actions::{
    ActionDescription, ActionError, Goal, GoalHandle, GoalStatus, ProgressUpdates, Robot, Term,
    Type,
};
use fipa::{AgentId, Config, RegisterOptions};
use fipa_acl::escape;
use fipa_content::{Arguments as TermArguments, FunctionalTerm, Number, Parameter, Printer};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use super::actions::failed;
use super::df::asking;
use crate::complete;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Time that a robot has to stop after Ctrl-C.
const STOP: Duration = Duration::from_secs(15);

/// Let a robot perform an action
///
/// Sends a goal, shows its progress on a terminal, and prints the result. Ctrl-C cancels the goal and waits until the
/// robot has stopped; a second Ctrl-C ends the command at once, and the robot then cancels the goal by
/// itself.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa do crex drive distance=1.5
  fipa do crex drive distance='1.5 m' speed=0.2
  fipa do crex dock 'target=(pose :x 1.5 :y 0.2 :yaw 3.1)'
  fipa do crex dock target.x=1.5 target.y=0.2 target.yaw=3.1
  fipa do crex lift --deadline 30s --json
  fipa do crex lift --agent operator --id lift-17

Values are texts, numbers, true, false, or any value in FIPA-SL. A value with a
unit after a blank is accepted if the unit is that of the parameter.
`fipa actions ROBOT` shows the parameters.

Exit codes:
  0  done
  1  refused, failed, cancelled, or not reached
  2  an invalid command line

JSON, one object on a line:
  { \"event\": \"accepted\", \"goal\": id }
  { \"event\": \"progress\", \"state\", \"fraction\", \"note\", \"value\": value in SL or null }
  { \"event\": \"done\", \"result\": value in SL or null }")]
pub(crate) struct Arguments {
    /// Name of the robot
    #[arg(add = complete::agents())]
    robot: AgentId,

    /// Name of the action
    action: String,

    /// Parameters
    #[arg(value_name = "KEY=VALUE", value_parser = pair)]
    parameters: Vec<(String, String)>,

    /// Time for the action; without it, there is no limit
    #[arg(long, value_name = "TIME", value_parser = humantime::parse_duration)]
    deadline: Option<Duration>,

    /// Fence of a lock, if the action needs one
    #[arg(long, value_name = "FENCE")]
    fence: Option<String>,

    /// Id of the goal. A goal that the same agent sends again with its id does not run again: the command shows
    /// its progress and outcome. Needs `--agent` [default: a new one]
    #[arg(long, value_name = "ID", requires = "agent")]
    id: Option<String>,

    /// Name of the agent that sends the goal [default: a random, unused name]
    #[arg(long, value_name = "NAME")]
    agent: Option<AgentId>,
    #[command(flatten)]
    addresses: membership::Addresses,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,
}

fn pair(text: &str) -> Result<(String, String), String> {
    let parts = text.split_once('=');
    let (name, value) = parts.ok_or("expected KEY=VALUE such as speed=0.5")?;
    if name.is_empty() {
        return Err("expected a name before `=`".to_owned());
    }
    Ok((name.to_owned(), value.to_owned()))
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(perform(&arguments, &config))?
}

async fn perform(arguments: &Arguments, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let done = async {
        let agent = match &arguments.agent {
            Some(id) => {
                let options = RegisterOptions::default();
                stop.during(membership::register(&domain, id.name(), options, config))
                    .await?
            }
            None => stop.during(asking(&domain, "do", config)).await?,
        };
        let robot = arguments.addresses.of(&agent, &arguments.robot).await?;
        let robot = agent.robot(robot);
        let report = |error: &ActionError| failed(error, &arguments.robot, config);
        let sent = async {
            let goal = goal(arguments, &robot).await.map_err(|error| match error {
                GoalError::Usage(text) => {
                    Failure::wrong_usage(text, "the command line", "see `fipa actions ROBOT`")
                }
                GoalError::Robot(error) => report(&error),
            })?;
            robot.propose(goal).await.map_err(|error| report(&error))
        };
        let early = || cancelled(arguments, "before it was accepted");
        let mut handle = tokio::select! {
            sent = sent => sent?,
            () = stop.requested() => return Err(early()),
        };
        tokio::select! {
            accepted = handle.accepted() => accepted.map_err(|error| report(&error))?,
            () = stop.requested() => {
                Stop::ending();
                if handle.cancel(STOP).await.map_err(|error| report(&error))? {
                    return Err(early());
                }
            }
        }
        follow(arguments, handle, &mut stop, &report).await
    };
    let done = done.await;
    domain.close().await;
    done
}

/// Shows the progress of a goal and prints its result.
async fn follow(
    arguments: &Arguments,
    mut handle: GoalHandle<'_>,
    stop: &mut Stop,
    report: &impl Fn(&ActionError) -> Failure,
) -> Result<(), Failure> {
    if arguments.json {
        output::json_line(&json!({ "event": "accepted", "goal": handle.id() }))?;
    }
    let mut shown = Shown::new(arguments);
    // A goal that has ended and is not stored any more has no progress.
    let mut updates = handle.progress().await.ok();
    let outcome = loop {
        let outcome = {
            let mut outcome = pin!(handle.outcome());
            loop {
                tokio::select! {
                    biased;
                    status = next(&mut updates), if updates.is_some() => match status {
                        Some(status) => shown.show(&status)?,
                        None => updates = None,
                    },
                    outcome = &mut outcome => break Some(outcome),
                    () = stop.requested() => break None,
                }
            }
        };
        if let Some(outcome) = outcome {
            break outcome;
        }
        Stop::ending();
        let stopped = handle.cancel(STOP).await.map_err(|error| report(&error))?;
        if stopped {
            shown.end();
            return Err(cancelled(arguments, "while it ran"));
        }
    };
    shown.end();
    let result = outcome.map_err(|error| report(&error))?;
    let text = result.as_ref().map(|value| value.to_string());
    if arguments.json {
        return output::json_line(&json!({ "event": "done", "result": text }));
    }
    match result {
        None => output::text("done\n"),
        Some(value) => {
            let printed = Printer::new().indented().print(&value);
            let printed = printed.unwrap_or_default();
            let printed = String::from_utf8_lossy(&printed).into_owned();
            let lines: Vec<_> = printed.lines().map(escape).collect();
            output::text(&format!("{}\n", lines.join("\n")))
        }
    }
}

/// Returns the next status, `None` at the end of the goal or of the subscription.
async fn next(updates: &mut Option<ProgressUpdates>) -> Option<GoalStatus> {
    let next = match updates {
        Some(updates) => updates.next().await,
        None => std::future::pending().await,
    };
    next.unwrap_or_else(|error| {
        tracing::debug!(%error, "no further progress");
        None
    })
}

fn cancelled(arguments: &Arguments, when: &str) -> Failure {
    Failure::failed(
        format!("the goal was cancelled {when}"),
        format!(
            "robot {}, action {}",
            escape(arguments.robot.name()),
            escape(&arguments.action)
        ),
        "run the command again to send a new goal",
    )
}

/// The progress as it is shown: a bar on a terminal, or JSON.
struct Shown {
    bar: Option<ProgressBar>,
    as_json: bool,
}

impl Shown {
    fn new(arguments: &Arguments) -> Self {
        let is_terminal = std::io::stderr().is_terminal() && !arguments.json;
        let bar = is_terminal.then(|| {
            let style = ProgressStyle::with_template("{bar:40} {pos:>3} % {wide_msg}");
            let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
            ProgressBar::new(100).with_style(style)
        });
        Self {
            bar,
            as_json: arguments.json,
        }
    }

    fn show(&mut self, status: &GoalStatus) -> Result<(), Failure> {
        if status.state.is_over() {
            return Ok(());
        }
        let progress = status.progress.as_ref();
        let part = progress.and_then(|progress| progress.fraction);
        let note = progress.and_then(|progress| progress.note.as_deref());
        let value = progress.and_then(|progress| progress.value.as_ref());
        let value = value.map(ToString::to_string);
        if self.as_json {
            let state = status.state.as_str();
            return output::json_line(&json!({
                "event": "progress", "state": state, "fraction": part, "note": note, "value": value,
            }));
        }
        let Some(bar) = &self.bar else {
            return Ok(());
        };
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a part from 0 to 1"
        )]
        bar.set_position((part.unwrap_or_default().clamp(0.0, 1.0) * 100.0) as u64);
        let words = note.unwrap_or_else(|| status.state.as_str());
        let words = [Some(words), value.as_deref()].into_iter().flatten();
        let words = words.collect::<Vec<_>>().join(" ");
        bar.set_message(escape(&words).into_owned());
        Ok(())
    }

    fn end(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

/// The error of a goal that is not sent.
enum GoalError {
    Usage(String),
    Robot(ActionError),
}

/// Creates the goal of the command line, with values of the types that the robot describes.
async fn goal(arguments: &Arguments, robot: &Robot<'_>) -> Result<Goal, GoalError> {
    let described = robot.actions().await.map_err(GoalError::Robot)?;
    let action = described.iter().find(|it| it.name == arguments.action);
    let parameters = parameters(&arguments.parameters, action)?;
    let mut goal = robot
        .goal(&arguments.action, &())
        .map_err(|error| GoalError::Robot(error.into()))?;
    goal.arguments = parameters;
    goal.fence.clone_from(&arguments.fence);
    if let Some(id) = &arguments.id {
        goal.id = Some(id.clone());
    }
    let milliseconds = arguments.deadline.map(|it| it.as_millis());
    goal.deadline = milliseconds.map(|it| u64::try_from(it).unwrap_or(u64::MAX));
    Ok(goal)
}

/// Reads the parameters. `target.x=1` sets a field of the structure `target`.
fn parameters(
    given: &[(String, String)],
    action: Option<&ActionDescription>,
) -> Result<Vec<Parameter<'static>>, GoalError> {
    let mut parameters: Vec<Parameter<'static>> = Vec::new();
    for (key, text) in given {
        let (name, field) = match key.split_once('.') {
            Some((name, field)) => (name, Some(field)),
            None => (&**key, None),
        };
        let description = action.and_then(|it| it.parameters.iter().find(|it| it.name == name));
        let described = description.map(|it| &it.value_type);
        let Some(field) = field else {
            let value = value(
                text,
                described,
                description.and_then(|it| it.unit.as_deref()),
            );
            let name = Cow::Owned(name.to_owned());
            parameters.push(Parameter { name, value });
            continue;
        };
        let Some(Type::Structure {
            name: symbol,
            fields,
        }) = described
        else {
            return Err(GoalError::Usage(format!(
                "{} is no field of a structure: the parameter {} is {}",
                escape(key),
                escape(name),
                described.map_or_else(|| "unknown".to_owned(), ToString::to_string),
            )));
        };
        let of = fields.iter().find(|it| it.name == field);
        let slot = Parameter {
            name: Cow::Owned(field.to_owned()),
            value: value(text, of.map(|it| &it.value_type), None),
        };
        let known = parameters.iter_mut().find(|it| it.name == name);
        match known.map(|it| &mut it.value) {
            None => parameters.push(Parameter {
                name: Cow::Owned(name.to_owned()),
                value: Term::Functional(FunctionalTerm {
                    symbol: Cow::Owned(symbol.clone()),
                    arguments: TermArguments::Parameters(vec![slot]),
                }),
            }),
            Some(Term::Functional(FunctionalTerm {
                arguments: TermArguments::Parameters(slots),
                ..
            })) => slots.push(slot),
            Some(_) => {
                let name = escape(name).into_owned();
                return Err(GoalError::Usage(format!(
                    "the parameter {name} is given twice"
                )));
            }
        }
    }
    Ok(parameters)
}

/// Reads a value of a parameter of this type.
fn value(text: &str, described: Option<&Type>, unit: Option<&str>) -> Term<'static> {
    if matches!(described, Some(Type::String)) {
        return Term::from(text.to_owned());
    }
    if let Some((number, with)) = text.split_once(' ')
        && let Some(number) = Number::new(number)
        && (unit.is_some() || matches!(described, Some(Type::Number | Type::Integer)))
    {
        let slot = |name: &'static str, value| Parameter {
            name: Cow::Borrowed(name),
            value,
        };
        let number = Term::Number(number.into_owned());
        let unit = Term::from(with.trim().to_owned());
        return Term::Functional(FunctionalTerm {
            symbol: Cow::Borrowed("quantity"),
            arguments: TermArguments::Parameters(vec![slot("value", number), slot("unit", unit)]),
        });
    }
    match Term::parse(text.as_bytes()) {
        Ok(term) => term.into_owned(),
        Err(_) => Term::from(text.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_have_the_described_types() {
        let print = |text, described: Option<&Type>, unit| value(text, described, unit).to_string();
        assert_eq!(print("7", Some(&Type::String), None), "\"7\"");
        assert_eq!(print("7", Some(&Type::Number), Some("m")), "7");
        assert_eq!(
            print("7 cm", Some(&Type::Number), Some("m")),
            "(quantity :value 7 :unit cm)"
        );
        assert_eq!(print("(pose :x 1)", None, None), "(pose :x 1)");
        assert_eq!(print("two words", None, None), "\"two words\"");
    }
}
