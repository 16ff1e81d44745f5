//! The ontology in FIPA-SL.

use std::borrow::Cow;

use fipa_acl::AgentId;
use fipa_content::{
    ActionExpression, Arguments, Content, FunctionalTerm, Number, Parameter, Printer, Query,
    ReadError, ReferentialOperator, Term, Wff,
};

use crate::CANCEL;
use crate::language::{Language, LanguageError};
use crate::message::{ActionAnswer, Ask, Goal, GoalRef, parameter};

/// The predicate of offered actions: `(offers agent ?action)`.
const OFFERS: &str = "offers";

/// The predicate of goals: `(performs agent ?status)`, `(performs agent id ?status)`,
/// `(performs agent id client ?status)`.
const PERFORMS: &str = "performs";

/// FIPA-SL, the language without which no agent is: `fipa-sl`.
#[derive(Debug, Clone, Copy, Default)]
pub struct Sl;

impl Language for Sl {
    fn name(&self) -> &'static str {
        "fipa-sl"
    }

    fn write_ask(&self, robot: &AgentId, ask: &Ask) -> Result<Vec<u8>, LanguageError> {
        let content = match ask {
            Ask::Goal(goal) => action(robot, act(goal)).into(),
            Ask::Cancel(_) | Ask::CancelAll(_) => action(robot, reference(ask)).into(),
            _ => query(robot, ask).content(),
        };
        Ok(Printer::new().print(&content)?)
    }

    fn read_ask(&self, bytes: &[u8]) -> Result<(String, Ask), LanguageError> {
        let content = Content::parse(bytes)?;
        if let Ok(ActionExpression::Action { agent, act }) = content.action() {
            let agent = AgentId::try_from(agent).map_err(ReadError::from)?;
            let goal = goal(act.clone().into_owned())?;
            let ask = match goal.action == CANCEL {
                true => cancel(goal)?,
                false => Ask::Goal(goal),
            };
            return Ok((agent.name().to_owned(), ask));
        }
        asked(&Query::read(&content)?)
    }

    fn write_answer(
        &self,
        robot: &AgentId,
        to: &Ask,
        answer: &ActionAnswer,
    ) -> Result<Vec<u8>, LanguageError> {
        let reference = || action(robot, reference(to));
        let content = match answer {
            ActionAnswer::Agreed { queued } => {
                let state = if *queued { "queued" } else { "executing" };
                Content::of_refusal(reference(), Wff::Proposition(state.into()))
            }
            ActionAnswer::Done(None) => Wff::done(reference()).into(),
            ActionAnswer::Done(Some(value)) => {
                let of = Box::new(Term::from(reference()));
                Wff::Result(of, Box::new(value.clone())).into()
            }
            ActionAnswer::Refused(reason) => {
                Content::of_refusal(reference(), Wff::from_value(reason)?)
            }
            ActionAnswer::Failed(reason) => {
                Content::of_refusal(reference(), Wff::from_value(reason)?)
            }
            ActionAnswer::Actions(all) => query(robot, to).answer_all(all)?,
            ActionAnswer::Status(all) if matches!(to, Ask::Cancel(_) | Ask::CancelAll(_)) => {
                let all = all.iter().map(Term::from_value).collect::<Result<_, _>>()?;
                let of = Box::new(Term::from(reference()));
                Wff::Result(of, Box::new(Term::Set(all))).into()
            }
            ActionAnswer::Status(all) => query(robot, to).answer_all(all)?,
        };
        Ok(Printer::new().print(&content)?)
    }

    fn read_answer(&self, to: &Ask, bytes: &[u8]) -> Result<ActionAnswer, LanguageError> {
        let content = Content::parse(bytes)?;
        if let Ask::Goal(_) = to {
            if let Ok((_, Wff::Proposition(state))) = content.refusal() {
                let queued = state == "queued";
                return Ok(ActionAnswer::Agreed { queued });
            }
            return match content.wff()? {
                Wff::Done(..) => Ok(ActionAnswer::Done(None)),
                Wff::Result(_, value) => {
                    Ok(ActionAnswer::Done(Some(Term::clone(value).into_owned())))
                }
                _ => Err(LanguageError::Form("((done …)) or ((result …))")),
            };
        }
        // Other robots may repeat the query in another notation, so it is not compared.
        let (Wff::Equal(_, value) | Wff::Result(_, value)) = content.wff()? else {
            return Err(LanguageError::Form("((= (all …) (set …))) or ((result …))"));
        };
        let read = |error| LanguageError::Read(ReadError::Value(error));
        match to {
            Ask::Actions => value.read().map(ActionAnswer::Actions).map_err(read),
            _ => value.read().map(ActionAnswer::Status).map_err(read),
        }
    }

    fn read_rejection(
        &self,
        is_refusal: bool,
        bytes: &[u8],
    ) -> Result<ActionAnswer, LanguageError> {
        let content = Content::parse(bytes)?;
        let (_, reason) = content.refusal()?;
        let read = |error| LanguageError::Read(ReadError::Value(error));
        match is_refusal {
            true => reason.read().map(ActionAnswer::Refused).map_err(read),
            false => reason.read().map(ActionAnswer::Failed).map_err(read),
        }
    }
}

fn action(robot: &AgentId, act: Term<'static>) -> ActionExpression<'static> {
    ActionExpression::Action {
        agent: robot.into(),
        act,
    }
}

fn functional(symbol: &str, parameters: Vec<Parameter<'static>>) -> Term<'static> {
    let arguments = match parameters.is_empty() {
        true => Arguments::Terms(Vec::new()),
        false => Arguments::Parameters(parameters),
    };
    Term::Functional(FunctionalTerm {
        symbol: Cow::Owned(symbol.to_owned()),
        arguments,
    })
}

/// Returns the act of a goal.
fn act(goal: &Goal) -> Term<'static> {
    let mut parameters = goal.arguments.clone();
    if let Some(id) = &goal.id {
        parameters.push(parameter("goal", id.clone()));
    }
    if let Some(deadline) = goal.deadline {
        parameters.push(parameter("deadline", Term::Number(Number::from(deadline))));
    }
    if let Some(fence) = &goal.fence {
        parameters.push(parameter("fence", fence.clone()));
    }
    functional(&goal.action, parameters)
}

/// Returns the act that names the goal in answers.
fn reference(ask: &Ask) -> Term<'static> {
    match ask {
        Ask::Goal(goal) => {
            let id = goal.id.iter().map(|id| parameter("goal", id.clone()));
            functional(&goal.action, id.collect())
        }
        Ask::Actions => functional(OFFERS, Vec::new()),
        Ask::Status => functional(PERFORMS, Vec::new()),
        Ask::StatusOf(goal) => functional(PERFORMS, named(goal)),
        Ask::Cancel(goal) => functional(CANCEL, named(goal)),
        Ask::CancelAll(action) => functional(CANCEL, vec![parameter("action", action.clone())]),
    }
}

/// Returns the parameters that name a goal.
fn named(goal: &GoalRef) -> Vec<Parameter<'static>> {
    let client = goal.client.iter();
    let client = client.map(|name| parameter("client", name.clone()));
    [parameter("goal", goal.id.clone())]
        .into_iter()
        .chain(client)
        .collect()
}

/// Reads the act of a cancel, which has the form of a goal.
fn cancel(goal: Goal) -> Result<Ask, LanguageError> {
    const FORM: LanguageError = LanguageError::Form(
        "(cancel-goals :goal id), (cancel-goals :goal id :client name) or (cancel-goals :action name)",
    );
    if goal.deadline.is_some() || goal.fence.is_some() {
        return Err(FORM);
    }
    let (mut client, mut action) = (None, None);
    for Parameter { name, value } in goal.arguments {
        let slot = match &*name {
            "client" => &mut client,
            "action" => &mut action,
            _ => return Err(FORM),
        };
        let word = word(&value).ok_or(FORM)?;
        if slot.replace(word).is_some() {
            return Err(FORM);
        }
    }
    match (goal.id, client, action) {
        (Some(id), client, None) => Ok(Ask::Cancel(GoalRef { id, client })),
        (None, None, Some(action)) => Ok(Ask::CancelAll(action)),
        _ => Err(FORM),
    }
}

/// Reads an id or a name. In SL, one of digits only is a number.
fn word(term: &Term<'_>) -> Option<String> {
    match term {
        Term::String(text) => Some(text.clone().into_owned()),
        Term::Number(number) => Some(number.as_str().to_owned()),
        _ => None,
    }
}

/// Reads the act of a goal.
fn goal(act: Term<'static>) -> Result<Goal, LanguageError> {
    let term = match act {
        // An action without arguments may be a word.
        Term::String(name) => return Ok(Goal::of(name, Vec::new())),
        Term::Functional(term) => term,
        _ => {
            return Err(LanguageError::Form(
                "(action agent (name :parameter value …))",
            ));
        }
    };
    let parameters = match term.arguments {
        Arguments::Parameters(parameters) => parameters,
        Arguments::Terms(terms) if terms.is_empty() => Vec::new(),
        Arguments::Terms(_) => {
            return Err(LanguageError::Form("an action with named arguments"));
        }
    };
    let mut goal = Goal::of(term.symbol, Vec::with_capacity(parameters.len()));
    for parameter in parameters {
        match (&*parameter.name, parameter.value) {
            ("goal", Term::String(id)) => goal.id = Some(id.into_owned()),
            // An id of digits only is a number in SL.
            ("goal", Term::Number(id)) => goal.id = Some(id.as_str().to_owned()),
            ("deadline", Term::Number(time)) => {
                let time = time
                    .as_u64()
                    .ok_or(LanguageError::Form("a deadline in ms"))?;
                goal.deadline = Some(time);
            }
            ("fence", Term::String(fence)) => goal.fence = Some(fence.into_owned()),
            ("goal" | "deadline" | "fence", _) => {
                return Err(LanguageError::Form("a goal id, deadline or fence"));
            }
            (_, value) => {
                let name = parameter.name;
                goal.arguments.push(Parameter { name, value });
            }
        }
    }
    Ok(goal)
}

fn query(robot: &AgentId, ask: &Ask) -> Query {
    let variable = Term::Variable(Cow::Borrowed("x"));
    let robot = Term::from(robot);
    let wff = match ask {
        Ask::StatusOf(GoalRef { id, client }) => {
            let client = client.iter().map(|name| Term::from(name.clone()));
            let named = [robot, Term::from(id.clone())].into_iter().chain(client);
            Wff::predicate(PERFORMS, named.chain([variable]))
        }
        Ask::Status => Wff::predicate(PERFORMS, [robot, variable]),
        _ => Wff::predicate(OFFERS, [robot, variable]),
    };
    Query::all(["x"], wff)
}

/// Reads a query: the name of the robot, and what is asked.
fn asked(query: &Query) -> Result<(String, Ask), LanguageError> {
    const FORM: LanguageError =
        LanguageError::Form("(all ?x (offers agent ?x)) or (all ?x (performs agent ?x))");
    let expression = query.expression();
    let Wff::Predicate { symbol, arguments } = &expression.wff else {
        return Err(FORM);
    };
    if expression.operator != ReferentialOperator::All {
        return Err(FORM);
    }
    let (agent, ask) = match (&**symbol, &arguments[..]) {
        (OFFERS, [agent, Term::Variable(_)]) => (agent, Ask::Actions),
        (PERFORMS, [agent, Term::Variable(_)]) => (agent, Ask::Status),
        (PERFORMS, [agent, id, Term::Variable(_)]) => {
            (agent, Ask::StatusOf(word(id).ok_or(FORM)?.into()))
        }
        (PERFORMS, [agent, id, client, Term::Variable(_)]) => {
            let goal = GoalRef::from(word(id).ok_or(FORM)?);
            (agent, Ask::StatusOf(goal.of(word(client).ok_or(FORM)?)))
        }
        _ => return Err(FORM),
    };
    let agent = AgentId::try_from(agent).map_err(ReadError::from)?;
    Ok((agent.name().to_owned(), ask))
}
