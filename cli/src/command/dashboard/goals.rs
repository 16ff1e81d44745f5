//! The goals that agents run, while a page shows them.
//!
//! Each agent of this host is asked once. Those that offer actions are asked again and again, and so are agents of other
//! hosts to which a client has sent a goal through this host.

use std::collections::btree_map::Entry as Slot;
use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::actions::{ActionError, GoalRef, GoalStatus, ONTOLOGY, Refusal};
use fipa::admin::routes::ASKER_TYPE;
use fipa::admin::watch::Passage;
use fipa::{Agent, AgentId, Incarnation, Performative};
use parking_lot::Mutex;

use crate::command::ask::{ask_all, is_agent_of_this_host};

/// Maximum wait for the answers of the agents.
const ANSWER: Duration = Duration::from_secs(2);

/// Maximum number of agents that are asked.
const MAX_ROBOTS: usize = 2000;

/// Maximum number of goals of a robot. Further ones are left out.
const MAX_GOALS_OF_ROBOT: usize = 20;

/// Maximum length of the identifier of a goal and of the name of a client, in bytes. Goals with
/// longer ones are left out: a clipped text does not cancel them.
const MAX_KEY: usize = AgentId::MAX_NAME;

/// A goal that runs or waits.
#[derive(Debug)]
pub(super) struct RunningGoal {
    pub(super) robot: String,
    pub(super) status: GoalStatus,
    pub(super) since: SystemTime,
    /// Whether the robot has answered the last question.
    pub(super) is_answered: bool,
    /// Whether the robot lets the agent of the page cancel it; `None` if clients may only see.
    pub(super) may_cancel: Option<bool>,
}

/// A goal that a client of the page cancels.
#[derive(Debug)]
pub(super) struct Cancelled {
    pub(super) number: u64,
    pub(super) at: SystemTime,
    /// The agent of the page.
    pub(super) by: String,
    pub(super) robot: String,
    pub(super) goal: String,
    pub(super) client: String,
    /// The end of the goal, or why it is not known; `None` while the robot is asked.
    pub(super) outcome: Option<Result<GoalStatus, String>>,
}

/// The agents that may run goals, by name.
#[derive(Debug, Default)]
pub(super) struct Robots(Mutex<BTreeMap<String, Robot>>);

#[derive(Debug, Default)]
struct Robot {
    /// Unknown of an agent of another host.
    incarnation: Option<Incarnation>,
    /// Whether it offers actions, as soon as it is known.
    offers: Option<bool>,
    is_answered: bool,
    goals: Vec<(SystemTime, GoalStatus)>,
    /// A goal, and whether the robot lets the agent of the page cancel it.
    judged: Option<(GoalKey, bool)>,
}

/// A client and the identifier of its goal.
type GoalKey = (String, String);

fn key(status: &GoalStatus) -> GoalKey {
    (status.client.clone(), status.goal.clone())
}

/// The error of a question.
#[derive(Debug, thiserror::Error)]
enum QuestionError {
    #[error("no answer within {ANSWER:?}")]
    Silence,
    #[error(transparent)]
    Action(#[from] ActionError),
}

async fn within_time<T>(
    answer: impl Future<Output = Result<T, ActionError>>,
) -> Result<T, QuestionError> {
    let answer = tokio::time::timeout(ANSWER, answer).await;
    Ok(answer.map_err(|_| QuestionError::Silence)??)
}

impl Robots {
    /// Asks the agents for their goals. `page_agent` is the agent of the page, if clients may cancel goals.
    pub(super) async fn ask(
        &self,
        agent: &Arc<Agent>,
        page_agent: Option<&Arc<Agent>>,
    ) -> Vec<RunningGoal> {
        self.look(agent);
        let answers = ask_all(self.to_ask(), |robot| {
            let agent = Arc::clone(agent);
            within_time(async move { agent.robot(robot).status().await })
        });
        self.take(answers.await);
        if let Some(page_agent) = page_agent {
            self.judge(page_agent).await;
        }
        self.goals(page_agent.is_some())
    }

    /// Notices the robot of a letter about actions.
    pub(super) fn notice(&self, passage: &Passage) {
        let Some(message) = passage.message.as_ref() else {
            return;
        };
        if message.ontology() != Some(ONTOLOGY) {
            return;
        }
        let is_from_client = matches!(
            message.performative(),
            Performative::Request | Performative::QueryRef | Performative::Subscribe
        );
        let name = match is_from_client {
            true => Some(&*passage.receiver),
            false => passage.sender(),
        };
        let Some(name) = name else { return };
        let mut robots = self.0.lock();
        if robots.len() >= MAX_ROBOTS && !robots.contains_key(name) {
            return;
        }
        let robot = robots.entry(name.to_owned()).or_default();
        if robot.offers == Some(false) {
            robot.offers = None;
        }
    }

    /// Takes the agents in the directory. Agents that have left it are forgotten.
    fn look(&self, agent: &Agent) {
        let directory = agent.domain().directory();
        directory.refresh();
        let entries = directory.entries();
        let mut robots = self.0.lock();
        let entries: BTreeMap<&str, _> = entries.iter().map(|it| (&*it.name, it)).collect();
        robots.retain(|name, _| entries.contains_key(&**name));
        for (name, entry) in entries {
            if !is_agent_of_this_host(entry, agent) || *entry.agent_type == *ASKER_TYPE {
                continue;
            }
            let has_room = robots.len() < MAX_ROBOTS;
            let fresh = || Robot {
                incarnation: Some(entry.incarnation),
                ..Robot::default()
            };
            match robots.entry(name.to_owned()) {
                Slot::Vacant(slot) if has_room => drop(slot.insert(fresh())),
                Slot::Vacant(_) => {}
                Slot::Occupied(mut slot) => match slot.get().incarnation {
                    Some(known) if known == entry.incarnation => {}
                    None => slot.get_mut().incarnation = Some(entry.incarnation),
                    Some(_) => drop(slot.insert(fresh())),
                },
            }
        }
    }

    /// The agents that offer actions, and those that have not been asked.
    fn to_ask(&self) -> Vec<AgentId> {
        let robots = self.0.lock();
        let asked = robots.iter().filter(|(_, it)| it.offers != Some(false));
        asked
            .filter_map(|(name, _)| AgentId::new(&**name).ok())
            .collect()
    }

    /// Takes the answers.
    fn take(&self, answers: BTreeMap<String, Option<Vec<GoalStatus>>>) {
        let mut robots = self.0.lock();
        let now = SystemTime::now();
        for (name, answer) in answers {
            let Some(robot) = robots.get_mut(&name) else {
                continue;
            };
            robot.is_answered = answer.is_some();
            let Some(goals) = answer else {
                // A robot that is silent for a while keeps its goals.
                robot.offers.get_or_insert(false);
                continue;
            };
            robot.offers = Some(true);
            let before = std::mem::take(&mut robot.goals);
            let before: HashMap<(&str, &str), SystemTime> = before
                .iter()
                .map(|(since, it)| ((it.client.as_str(), it.goal.as_str()), *since))
                .collect();
            let is_short =
                |status: &GoalStatus| status.goal.len().max(status.client.len()) <= MAX_KEY;
            let began = |status: &GoalStatus| {
                let known = before.get(&(status.client.as_str(), status.goal.as_str()));
                // Computed once: the age and the clock do not advance at the same rate.
                let age = Duration::from_millis(status.age);
                known
                    .copied()
                    .unwrap_or_else(|| now.checked_sub(age).unwrap_or(now))
            };
            robot.goals = goals
                .into_iter()
                .filter(is_short)
                .take(MAX_GOALS_OF_ROBOT)
                .map(|status| (began(&status), status))
                .collect();
        }
    }

    /// Finds out which robots let the agent of the page cancel goals: it asks each for the result of a goal, which is for
    /// operators, too.
    async fn judge(&self, agent: &Arc<Agent>) {
        let unjudged: BTreeMap<String, GoalKey> = {
            let robots = self.0.lock();
            let unjudged = robots.iter().filter_map(|(name, robot)| {
                let first = key(&robot.goals.first()?.1);
                let is_judged = robot
                    .judged
                    .as_ref()
                    .is_some_and(|(goal, _)| *goal == first);
                (robot.is_answered && !is_judged).then(|| (name.clone(), first))
            });
            unjudged.collect()
        };
        let ids = unjudged
            .keys()
            .filter_map(|name| AgentId::new(&**name).ok());
        let answers = ask_all(ids, |robot| {
            let agent = Arc::clone(agent);
            let goal = unjudged.get(robot.name()).cloned().unwrap_or_default();
            within_time(async move {
                let (client, id) = goal;
                let robot = agent.robot(robot);
                match robot.status_of(GoalRef::from(id).of(client)).await {
                    Ok(_) => Ok(true),
                    Err(ActionError::Refused(Refusal::NotOperator(_))) => Ok(false),
                    Err(error) => Err(error),
                }
            })
        });
        let answers = answers.await;
        let mut robots = self.0.lock();
        for (name, goal) in unjudged {
            if let Some(Some(may_cancel)) = answers.get(&name)
                && let Some(robot) = robots.get_mut(&name)
            {
                robot.judged = Some((goal, *may_cancel));
            }
        }
    }

    fn goals(&self, has_control: bool) -> Vec<RunningGoal> {
        let robots = self.0.lock();
        let goals = robots.iter().flat_map(|(name, robot)| {
            robot.goals.iter().map(|(since, status)| RunningGoal {
                robot: name.clone(),
                status: status.clone(),
                since: *since,
                is_answered: robot.is_answered,
                may_cancel: has_control.then(|| robot.judged.as_ref().is_some_and(|(_, may)| *may)),
            })
        });
        goals.collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use serde_json::json;

    use super::*;

    fn status(goal: &str, age: u64) -> GoalStatus {
        let status = json!({
            "goal": goal, "action": "drive", "client": "rover", "state": "executing", "age": age, "progress": null,
            "failure": null, "result": null,
        });
        serde_json::from_value(status).unwrap()
    }

    fn robots() -> Robots {
        let robots = Robots::default();
        robots.0.lock().insert("crex".to_owned(), Robot::default());
        robots
    }

    /// The goals with their begins after this answer of the robot.
    fn taken(robots: &Robots, answer: Vec<GoalStatus>) -> Vec<(String, SystemTime)> {
        robots.take(BTreeMap::from([("crex".to_owned(), Some(answer))]));
        let goals = robots.goals(false).into_iter();
        goals.map(|it| (it.status.goal, it.since)).collect()
    }

    #[test]
    fn of_a_robot_with_any_number_of_goals_the_first_are_kept_with_their_begin() {
        let robots = robots();
        let answer = |age| -> Vec<GoalStatus> {
            (0..1000)
                .map(|goal| status(&format!("g-{goal}"), age))
                .collect()
        };
        let first = taken(&robots, answer(3_600_000));
        assert_eq!(first.len(), MAX_GOALS_OF_ROBOT);
        // Ages of a robot do not move the begin of a goal that is known.
        assert_eq!(taken(&robots, answer(1)), first);
    }

    #[test]
    fn a_goal_with_an_endless_identifier_is_left_out() {
        let answer = vec![status(&"g".repeat(MAX_KEY + 1), 1), status("g-1", 1)];
        let goals = taken(&robots(), answer).into_iter();
        let kept: Vec<String> = goals.map(|(goal, _)| goal).collect();
        assert_eq!(kept, ["g-1"]);
    }
}
