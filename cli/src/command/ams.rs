//! `fipa ams`: lists the agents of a platform.

use clap::Args;
use fipa::platform::{AgentState, Ams, AmsDescription, ApDescription};
use fipa::{Agent, AgentId, Config};
use fipa_acl::escape;
use serde_json::{Value, json};

use super::df::{asking, failed};
use crate::membership;
use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// List the agents of a platform as its agent management system reports them
///
/// Every platform after FIPA has an agent management system (AMS, FIPA00023), which agents ask by
/// messages. Without --ams, that of this host is asked. `fipa agents` reads the directory of this host
/// instead, and lists the agents of all hosts.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa ams
  fipa ams --state active
  fipa ams --ams ams@crex-mts --json
  fipa ams --ams ams@jade --address http://10.0.0.7:7778/acc    of a JADE platform

JSON:
  { \"ams\": name, \"platform\": { \"name\", \"services\": { transport: [address] } },
    \"agents\": [ { \"name\", \"ownership\": text or null, \"state\" } ] }")]
pub(crate) struct Arguments {
    /// Name of the agent management system [default: that of this host]
    #[arg(long, value_name = "NAME")]
    ams: Option<AgentId>,

    /// Address of the agent management system, if it is not in the directory; repeatable
    #[arg(long, value_name = "ADDRESS", requires = "ams", value_parser = membership::address)]
    address: Vec<String>,

    /// Only the agent with this name
    #[arg(long, value_name = "NAME")]
    agent: Option<AgentId>,

    /// Only agents of this owner
    #[arg(long, value_name = "OWNER")]
    ownership: Option<String>,

    /// Only agents in this state: initiated, active, suspended, waiting or transit
    #[arg(long, value_name = "STATE", value_parser = state)]
    state: Option<AgentState>,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn state(text: &str) -> Result<AgentState, String> {
    let state = AgentState::of(text);
    state.ok_or_else(|| "expected initiated, active, suspended, waiting or transit".to_owned())
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let template = AmsDescription {
        name: arguments.agent,
        ownership: arguments.ownership,
        state: arguments.state,
    };
    let listed = membership::run(async {
        let domain = membership::join(&config).await?;
        let asked = async {
            let agent = asking(&domain, "ams", &config).await?;
            let ams = match arguments.ams {
                Some(ams) => {
                    let ams = membership::introduce(&agent, ams, &arguments.address).await?;
                    agent.ams_of(ams)
                }
                None => agent.ams().map_err(|error| failed(&error, &config))?,
            };
            Listed::of(&agent, &ams, &template, &config).await
        };
        let asked = asked.await;
        domain.close().await;
        asked
    })?;
    listed.print(arguments.json)
}

/// The agents of a platform.
pub(super) struct Listed {
    ams: AgentId,
    platform: ApDescription,
    pub(super) agents: Vec<AmsDescription>,
}

impl Listed {
    /// Asks an agent management system for the agents that match the template.
    pub(super) async fn of(
        agent: &Agent,
        ams: &Ams<'_>,
        template: &AmsDescription,
        config: &Config,
    ) -> Result<Self, Failure> {
        let platform = ams.description().await;
        let platform = platform.map_err(|error| failed(&error, config))?;
        let agents = ams.search(template).await;
        let mut agents = agents.map_err(|error| failed(&error, config))?;
        // The agent of this command is not of interest.
        agents.retain(|it| it.name.as_ref().is_none_or(|id| !id.same_agent(agent.id())));
        Ok(Self {
            ams: ams.id().clone(),
            platform,
            agents,
        })
    }

    pub(super) fn print(&self, json: bool) -> Result<(), Failure> {
        let Self {
            ams,
            platform,
            agents,
        } = self;
        if json {
            return output::json(&value(ams, platform, agents));
        }
        let mut text = format!(
            "platform {} of {}\n",
            escape(&platform.name),
            escape(ams.name())
        );
        for (name, addresses) in &platform.services {
            let addresses = addresses.join(" ");
            text.push_str(&format!("{} {}\n", escape(name), escape(&addresses)));
        }
        let mut table = output::table(["AGENT", "STATE", "OWNER"]);
        table.add_rows(agents.iter().map(|agent| {
            let state = agent.state.map(AgentState::as_str);
            [
                escape(&name(agent)).into_owned(),
                state.unwrap_or("-").to_owned(),
                escape(agent.ownership.as_deref().unwrap_or("-")).into_owned(),
            ]
        }));
        output::text(&format!("{text}{}\n", table.trim_fmt()))
    }
}

pub(super) fn name(agent: &AmsDescription) -> String {
    let name = agent.name.as_ref();
    name.map_or_else(String::new, |id| id.name().to_owned())
}

fn value(ams: &AgentId, platform: &ApDescription, agents: &[AmsDescription]) -> Value {
    let services = platform.services.iter();
    let services = services.map(|(name, addresses)| (name.clone(), json!(addresses)));
    let services: serde_json::Map<String, Value> = services.collect();
    let agents = agents.iter().map(|agent| {
        json!({
            "name": name(agent),
            "ownership": agent.ownership,
            "state": agent.state.map(AgentState::as_str),
        })
    });
    json!({
        "ams": ams.name(),
        "platform": { "name": platform.name, "services": services },
        "agents": agents.collect::<Vec<_>>(),
    })
}
