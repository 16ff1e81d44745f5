//! `fipa coalition`: one shared name for several agents.

use clap::Args;
use fipa::error::{CoalitionError, ErrorChain};
use fipa::{AgentId, Coalition, Config, Domain, RegisterOptions};
use fipa_acl::escape;

use crate::complete;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Form a coalition: one shared name for several agents
///
/// A message to the name of the coalition is delivered to all members except its sender, or only to
/// the leader if there is one. Members are found by name: they may be on any host, move to another
/// host, or register later. The coalition exists until Ctrl-C.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa coalition platoon rover_1 rover_2 rover_3
  fipa coalition arms arm_left arm_right --leader arm_left

In another terminal:
  fipa agents platoon
  fipa send --to platoon --content forward")]
pub(crate) struct Arguments {
    /// Name of the coalition
    name: AgentId,

    /// Names of the members
    #[arg(required = true, value_name = "MEMBER", add = complete::agents())]
    members: Vec<AgentId>,

    /// Member that receives all messages to the coalition
    #[arg(long, value_name = "MEMBER")]
    leader: Option<AgentId>,

    /// Type of the coalition, for `fipa agents --type`
    #[arg(long = "type", value_name = "TYPE", default_value = "")]
    agent_type: String,

    /// Description of the coalition, for `fipa agents --description`
    #[arg(long, value_name = "TEXT", default_value = "")]
    description: String,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(async {
        let mut stop = Stop::listen()?;
        let domain = stop.during(membership::join(&config)).await?;
        let formed = stop.during(form(&domain, &arguments, &config)).await;
        let done = match formed {
            Ok(coalition) => {
                let members = match coalition.members().names().len() {
                    1 => "1 member".to_owned(),
                    several => format!("{several} members"),
                };
                let done = output::text(&format!(
                    "coalition {} of domain {} has {members}; press Ctrl-C to dissolve it\n",
                    escape(coalition.name()),
                    config.domain,
                ));
                stop.requested().await;
                Stop::ending();
                done
            }
            Err(failure) => Err(failure),
        };
        domain.close().await;
        done
    })?
}

async fn form(
    domain: &Domain,
    arguments: &Arguments,
    config: &Config,
) -> Result<Coalition, Failure> {
    let options = RegisterOptions {
        agent_type: arguments.agent_type.clone(),
        description: arguments.description.clone(),
    };
    let name = arguments.name.name();
    let members = arguments.members.iter().map(AgentId::name);
    let leader = arguments.leader.as_ref().map(AgentId::name);
    let formed = domain.form(name, members, leader, options).await;
    formed.map_err(|error| match error {
        CoalitionError::Register(error) => membership::not_registered(error, name, config),
        other => Failure::wrong_usage(
            ErrorChain(&other).to_string(),
            "the command line",
            "change the members or the leader",
        ),
    })
}
