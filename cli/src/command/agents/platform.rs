//! `fipa agents --platform`: the agents of another platform, from its agent management system.
//!
//! The address of a platform does not state the name of its agent management system. A platform answers a
//! message to an agent that it does not have with a failure from that system (FIPA00023 clause 6.3, and
//! JADE), so such a message asks for the name.

use std::time::Duration;

use fipa::platform::AmsDescription;
use fipa::{Agent, AgentId, Config, Incarnation, Matcher, Performative};

use crate::command::ams::{Listed, name};
use crate::command::df::asking;
use crate::membership;
use crate::report::Failure;

/// Time limit of the answer of the platform.
const TIMEOUT: Duration = Duration::from_secs(20);

/// Lists the agents of the platform at this address.
pub(super) fn run(
    address: &str,
    pattern: Option<&Matcher>,
    config: &Config,
    json: bool,
) -> Result<(), Failure> {
    let mut listed = membership::run(async {
        let domain = membership::join(config).await?;
        let listed = async {
            let agent = asking(&domain, "agents", config).await?;
            let addresses = [address.to_owned()];
            let ams = management(&agent, &addresses).await?;
            let ams = membership::introduce(&agent, ams, &addresses).await?;
            let template = AmsDescription::default();
            Listed::of(&agent, &agent.ams_of(ams), &template, config).await
        };
        let listed = listed.await;
        domain.close().await;
        listed
    })?;
    if let Some(pattern) = pattern {
        listed.agents.retain(|agent| pattern.matches(&name(agent)));
    }
    listed.print(json)
}

/// Beginning of the name of the agent that a platform is asked for and does not have. It is no agent, so it is not
/// listed.
pub(super) const PROBED: &str = "fipa-unknown-";

/// Asks for the agent management system of the platform.
async fn management(agent: &Agent, addresses: &[String]) -> Result<AgentId, Failure> {
    let failed = |what: String| {
        Failure::failed(
            what,
            addresses.join(", "),
            "check the address, or name the system: `fipa ams --ams NAME --address ADDRESS`",
        )
    };
    let unknown = AgentId::new(format!("{PROBED}{}", Incarnation::random()));
    let unknown = unknown.map_err(|error| failed(error.to_string()))?;
    let unknown = membership::introduce(agent, unknown, addresses).await?;
    // JADE does not parse a bare word that begins with a digit.
    let conversation = format!("c{}", Incarnation::random());
    let probe = agent
        .message(Performative::Request)
        .receiver(unknown)
        .conversation_id(conversation.as_str())
        .language("fipa-sl0")
        .ontology("FIPA-Agent-Management")
        .content("((action (agent-identifier :name ams) (get-description)))");
    let sent = agent.send(probe).await;
    let sent = sent.map_err(|error| failed(error.to_string()))?;
    if !sent.all_succeeded() {
        return Err(failed(sent.to_string()));
    }
    let answer = async {
        loop {
            let received = agent.receive().await;
            let message = received
                .map_err(|error| failed(error.to_string()))?
                .into_message();
            let is_answer = *message.performative() == Performative::Failure
                && message.conversation_id() == Some(conversation.as_str());
            if let Some(sender) = message.sender().filter(|_| is_answer) {
                return Ok::<_, Failure>(sender.clone());
            }
        }
    };
    match tokio::time::timeout(TIMEOUT, answer).await {
        Ok(Ok(sender)) if sender.name().starts_with("ams@") => {
            AgentId::new(sender.name()).map_err(|error| failed(error.to_string()))
        }
        Ok(Ok(sender)) => Err(failed(format!(
            "the failure message is from {}, not from an agent management system",
            fipa_acl::escape(sender.name())
        ))),
        Ok(Err(error)) => Err(error),
        Err(_) => Err(failed("the platform did not answer".to_owned())),
    }
}
