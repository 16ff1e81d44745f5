//! Checks whether this machine meets the requirements of the configuration.
//!
//! Each area has a file with one function that examines it and adds its [`Check`]s. A new area is
//! a file here and a line in [`examine`]. The checks change nothing on the machine. The check of the
//! domain's directory writes a file without a name, the check of multicast sends mDNS queries, and the
//! check of static peers opens connections to them.

mod domain_dir;
#[cfg(feature = "net")]
mod gateway;
#[cfg(feature = "net")]
mod locations;
#[cfg(feature = "mdns")]
mod network;
mod other_users;
#[cfg(feature = "net")]
mod peers;
mod processes;
mod queues;
#[cfg(feature = "net")]
mod security;
#[cfg(feature = "shm")]
mod shm;

use serde::Serialize;

use crate::Config;

/// The result of one check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Check {
    /// The area, for example `shared memory`.
    pub area: &'static str,
    /// The name of the check, for example `size of /dev/shm`.
    pub check: &'static str,
    /// The severity.
    pub severity: Severity,
    /// The state that was found, as text.
    pub found: String,
    /// The remedy; `None` if the severity is [`Severity::Fine`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub advice: Option<String>,
}

/// The severity of a check, ordered from best to worst.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Severity {
    /// The requirement is met.
    Fine,
    /// The requirement is met now, but may fail under load or later.
    Warning,
    /// The requirement is not met: a part of the configuration does not work.
    Bad,
}

/// Examines all areas that the configuration uses. Blocks for some milliseconds, for three seconds if
/// `discovery.mdns` is on, because the check of multicast waits for answers, and for some seconds if
/// static peers do not answer.
#[must_use]
pub fn examine(config: &Config) -> Vec<Check> {
    let mut checks = Vec::new();
    domain_dir::examine(config, &mut checks);
    other_users::examine(config, &mut checks);
    processes::examine(config, &mut checks);
    #[cfg(feature = "shm")]
    if config.mts.transports.contains(&crate::Kind::Shm) {
        shm::examine(config, &mut checks);
    }
    #[cfg(feature = "mdns")]
    if config.discovery.mdns {
        network::examine(config, &mut checks);
    }
    #[cfg(feature = "net")]
    locations::examine(config, &mut checks);
    #[cfg(feature = "net")]
    peers::examine(config, &mut checks);
    #[cfg(feature = "net")]
    security::examine(std::time::SystemTime::now(), config, &mut checks);
    queues::examine(config, &mut checks);
    checks
}

/// Examines the gateway of this host by its report ([`routes::of_gateway`](crate::admin::routes::of_gateway) for
/// all receivers), or by the reason why it gave none: whether it runs with this configuration, whether its
/// connections are encrypted, which peers refuse its connections, which gateways have one name, and whether the ports of the gateways that it knows let this host in. Blocks
/// for some seconds if those do not answer.
#[cfg(feature = "net")]
#[must_use]
pub fn examine_gateway(
    config: &Config,
    report: Result<&crate::admin::routes::RouteReport, &str>,
) -> Vec<Check> {
    let mut checks = Vec::new();
    gateway::examine(config, report, &mut checks);
    checks
}

/// Builds the [`Check`]s of one area.
pub(crate) struct Area(pub(crate) &'static str);

impl Area {
    pub(crate) fn fine(&self, check: &'static str, found: impl Into<String>) -> Check {
        Check {
            area: self.0,
            check,
            severity: Severity::Fine,
            found: found.into(),
            advice: None,
        }
    }

    pub(crate) fn problem(
        &self,
        check: &'static str,
        severity: Severity,
        found: impl Into<String>,
        advice: impl Into<String>,
    ) -> Check {
        Check {
            severity,
            advice: Some(advice.into()),
            ..self.fine(check, found)
        }
    }
}
