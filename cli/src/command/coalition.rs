//! `fipa coalition`: one name for several agents.

use clap::Args;
use fipa::{AgentId, CoalitionError, Domain, RegisterOptions};
use fipa_acl::escape;

use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Form a coalition: one name for several agents
///
/// A message to that name reaches all members but its sender, or only the leader when there is
/// one. Members are named, not held: they may be on any host, move, and come later. The coalition
/// lasts until Ctrl-C.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa coalition platoon rover_1 rover_2 rover_3
  fipa coalition arms arm_left arm_right --leader arm_left

In another terminal:
  fipa agents platoon
  fipa send --to platoon --content forward")]
pub(crate) struct Arguments {
    /// The name of the coalition
    name: AgentId,

    /// The names of its members
    #[arg(required = true, value_name = "MEMBER")]
    members: Vec<AgentId>,

    /// The member that gets all messages to the coalition
    #[arg(long, value_name = "MEMBER")]
    leader: Option<AgentId>,

    /// What kind of coalition it is, for `fipa agents --type`
    #[arg(long = "type", value_name = "TYPE", default_value = "")]
    agent_type: String,

    /// What it says about itself
    #[arg(long, value_name = "TEXT", default_value = "")]
    description: String,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(async {
        let mut stop = Stop::listen()?;
        let domain = membership::join(&config).await?;
        let formed = form(&domain, &arguments).map_err(|error| match error {
            CoalitionError::Register(error) => {
                membership::not_registered(error, arguments.name.name(), &config)
            }
            other => Failure::wrong_usage(
                other.to_string(),
                "the command line",
                "name other members or another leader",
            ),
        });
        let told = match formed {
            Ok(coalition) => {
                let members = match coalition.members().names().len() {
                    1 => "1 member".to_owned(),
                    several => format!("{several} members"),
                };
                let told = output::text(&format!(
                    "{} of the domain {} has {members}; Ctrl-C dissolves it\n",
                    escape(coalition.name()),
                    config.domain,
                ));
                stop.requested().await;
                Stop::ending();
                told
            }
            Err(failure) => Err(failure),
        };
        domain.close().await;
        told
    })?
}

fn form(domain: &Domain, arguments: &Arguments) -> Result<fipa::Coalition, CoalitionError> {
    let options = RegisterOptions {
        agent_type: arguments.agent_type.clone(),
        description: arguments.description.clone(),
    };
    let members = arguments.members.iter().map(AgentId::name);
    let leader = arguments.leader.as_ref().map(AgentId::name);
    domain.form(arguments.name.name(), members, leader, options)
}
