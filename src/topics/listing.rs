//! The topics of an agent in the directory facilitator of its host, as services of the type [`TOPIC`].

use std::sync::Weak;
use std::time::{Duration, SystemTime};

use fipa_acl::{ErrorChain, Time, escape_name};
use fipa_content::{Number, Term};
use fipa_platform::{Property, ServiceDescription};
use fipa_sds::{Change, Watch};
use fipa_transport::Incarnation;
use tokio::time::Instant;

use crate::agent::AgentCore;
use crate::agent::topics::TopicStatus;
use crate::platform::{self, TOPIC};
use crate::protocol::Server;

/// Property of such a service: the media type of the contents, a string.
const MEDIA_TYPE: &str = "media-type";

/// Property of such a service: the declared notifications per second, a number.
const RATE: &str = "rate";

/// Delay before the second attempt after a failure. It doubles with each failure.
const FIRST_PAUSE: Duration = Duration::from_secs(1);

/// Maximum delay between two attempts.
const MAX_PAUSE: Duration = Duration::from_secs(60);

/// The topics as the directory facilitator lists them.
struct Listed {
    facilitator: Incarnation,
    services: Vec<ServiceDescription>,
    /// The time at which half of the lease is over.
    renewal: Option<Instant>,
}

/// Keeps the topics of an agent in the directory facilitator until the agent ends: after a change of the topics, after
/// a restart of the gateway, and before the lease ends. Also keeps the server that answers questions for them.
pub(super) async fn list(agent: Weak<AgentCore>, _answers: Server) {
    let Some(core) = agent.upgrade() else {
        return;
    };
    let changed = core.topics.changed();
    let mut directory = core.endpoint.domain.directory().watch();
    drop(core);
    let mut listed: Option<Listed> = None;
    let mut pause = FIRST_PAUSE;
    loop {
        let Some(core) = agent.upgrade() else {
            return;
        };
        let mut due = listed.as_ref().and_then(|listed| listed.renewal);
        if let Some((df, facilitator)) = platform::local_facilitator(&core) {
            let services = services(&core.topics.status());
            let is_current = match &listed {
                None => services.is_empty(),
                Some(listed) => {
                    listed.facilitator == facilitator
                        && listed.services == services
                        && listed.renewal.is_none_or(|due| Instant::now() < due)
                }
            };
            if !is_current {
                match platform::replace_topics(&core, df, &services).await {
                    Ok(lease_end) => {
                        let renewal = lease_end.map(half_way_to);
                        (due, pause) = (renewal, FIRST_PAUSE);
                        listed = Some(Listed {
                            facilitator,
                            services,
                            renewal,
                        });
                    }
                    Err(error) => {
                        let name = &*core.endpoint.name;
                        tracing::debug!(agent = %escape_name(name), error = %ErrorChain(&error), "the topics are not listed");
                        due = Some(Instant::now() + pause);
                        pause = (pause * 2).min(MAX_PAUSE);
                    }
                }
            }
        }
        drop(core);
        let is_due = async {
            match due {
                Some(due) => tokio::time::sleep_until(due).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = changed.notified() => {}
            () = is_due => {}
            is_open = facilitator_changes(&mut directory) => if !is_open {
                return;
            },
        }
    }
}

fn half_way_to(end: Time) -> Instant {
    let now = SystemTime::now();
    let left = end.to_system_time(now).duration_since(now);
    Instant::now() + left.unwrap_or_default() / 2
}

/// Waits for the next change of a platform agent. Returns false if the domain is closed.
async fn facilitator_changes(directory: &mut Watch) -> bool {
    while let Some(change) = directory.next().await {
        let concerns = |change: &Change| match change {
            Change::Joined(entry) | Change::Left(entry) => entry.is_platform_agent(),
            Change::Changed { before, after } => {
                before.is_platform_agent() || after.is_platform_agent()
            }
            _ => true,
        };
        if change.single().iter().any(concerns) {
            return true;
        }
    }
    false
}

/// Returns the services that describe topics.
fn services(topics: &[TopicStatus]) -> Vec<ServiceDescription> {
    let mut services: Vec<ServiceDescription> = topics.iter().map(service).collect();
    // An agent may have several publishers of a topic.
    services.dedup_by(|one, other| one.name == other.name);
    services
}

fn service(topic: &TopicStatus) -> ServiceDescription {
    let media_type = topic.media_type.clone();
    let media_type = media_type.map(|media_type| Property::new(MEDIA_TYPE, Term::from(media_type)));
    let rate = topic.rate.and_then(Number::from_f64);
    let rate = rate.map(|rate| Property::new(RATE, Term::Number(rate)));
    ServiceDescription {
        properties: media_type.into_iter().chain(rate).collect(),
        ..ServiceDescription::new(topic.name.clone(), TOPIC)
    }
}
