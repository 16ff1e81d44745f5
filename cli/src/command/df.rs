//! `fipa df`: registers, finds and watches services.

use std::pin::pin;
use std::time::{Duration, SystemTime};

use clap::{Args, Subcommand};
use fipa::platform::{AgentDescription, Df, PlatformError, Property, ServiceDescription};
use fipa::{Agent, AgentId, Config, Incarnation, RegisterOptions, Time};
use fipa_acl::escape;
use fipa_content::{Number, Term};
use serde_json::{Value, json};

use super::request::in_full;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Register, find and watch services of agents
///
/// Services are listed by the directory facilitator (DF) of a gateway (FIPA00023). Agents of this host and
/// of others use it by FIPA messages. Without --df, that of this host is used. It also lists the services
/// that agents of connected hosts have registered with their own gateways. After a search at the DF of another
/// platform, letters to the found agents reach them by their names.
#[derive(Debug, Subcommand)]
#[command(after_help = "\
Examples:
  fipa df register crane lifting
  fipa df search --type lifting
  fipa df search --df df@crex-mts --json
  fipa df search --type lifting --property load=5
  fipa df search --df df@jade --address http://10.0.0.7:7778/acc    at a JADE platform
  fipa df watch --type lifting")]
pub(crate) enum Arguments {
    /// Run an agent that offers a service
    ///
    /// Registers the agent and its service, until Ctrl-C. The service is then deregistered.
    #[command(after_help = "\
Examples:
  fipa df register crane lifting
  fipa df register crane lifting --service lift-1 --property load=5
  fipa df register crane lifting --property indoor=true --property 'model=\"5\"'
  fipa df register crane lifting --df df@crex-mts     in the DF of another host")]
    Register {
        /// Name of the agent
        agent: AgentId,
        /// Type of the service
        service_type: String,
        /// Name of the service [default: the type]
        #[arg(long, value_name = "NAME")]
        service: Option<String>,
        /// Property of the service; repeatable
        ///
        /// true and false are truth values, 5 is an integer and 0.5 a floating point number. Any other value,
        /// and one in quotation marks, is a string.
        #[arg(long, value_name = "NAME=VALUE", value_parser = property)]
        property: Vec<Property>,
        #[command(flatten)]
        server: Server,
    },

    /// List the services that match
    #[command(after_help = "\
Examples:
  fipa df search --type lifting
  fipa df search --property load=5              the integer 5
  fipa df search --property load=5.0            the floating point number
  fipa df search --property indoor=true         the truth value
  fipa df search --property 'model=\"5\"'       the string 5
  fipa df search --property color=red           the string red

JSON:
  { \"df\": name, \"agents\": [ { \"name\", \"lease\": time or null, \"protocols\", \"ontologies\",
    \"languages\", \"services\": [ { \"name\", \"type\", \"ownership\", \"protocols\", \"ontologies\",
    \"languages\", \"properties\": { name: value in SL } } ] } ] }")]
    Search {
        #[command(flatten)]
        template: Template,
        #[command(flatten)]
        server: Server,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },

    /// Print the services that match, and each change of them, until Ctrl-C
    #[command(after_help = "\
JSON, one object on a line:
  { \"event\": \"watching\", \"df\": name }
  { \"event\": \"changed\", \"agent\": as `fipa df search --json` prints it }
  { \"event\": \"left\", \"name\": name of the agent }")]
    Watch {
        #[command(flatten)]
        template: Template,
        #[command(flatten)]
        server: Server,
        /// End after this number of changes
        #[arg(long, short, value_name = "N")]
        count: Option<u64>,
        /// End after this time, for example 10s
        #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
        time: Option<Duration>,
        /// Print JSON, one object on a line
        #[arg(long)]
        json: bool,
    },
}

#[derive(Debug, Args)]
pub(crate) struct Server {
    /// Name of the directory facilitator [default: that of this host]
    #[arg(long, value_name = "NAME")]
    df: Option<AgentId>,

    /// Address of the directory facilitator, if it is not in the directory; repeatable
    #[arg(long, value_name = "ADDRESS", requires = "df", value_parser = membership::address)]
    address: Vec<String>,
}

#[derive(Debug, Args)]
pub(crate) struct Template {
    /// Only services of this type
    #[arg(long = "type", value_name = "TYPE")]
    service_type: Option<String>,

    /// Only services of this name
    #[arg(long, value_name = "NAME")]
    service: Option<String>,

    /// Only services of this agent
    #[arg(long, value_name = "NAME")]
    agent: Option<AgentId>,

    /// Only services with this property; repeatable
    ///
    /// true and false are truth values, 5 is an integer and 0.5 a floating point number. Any other value,
    /// and one in quotation marks, is a string. A string matches in any case, a number by its value. An
    /// integer matches no floating point number.
    #[arg(long, value_name = "NAME=VALUE", value_parser = property)]
    property: Vec<Property>,
}

fn property(text: &str) -> Result<Property, String> {
    let parts = text.split_once('=');
    let (name, value) = parts.ok_or("expected NAME=VALUE such as load=5")?;
    Ok(Property::new(name, property_value(value)?))
}

/// Returns the typed value of a property: a truth value, a number, or a string, which may be in quotation
/// marks as in SL.
fn property_value(text: &str) -> Result<Term<'static>, String> {
    if let Some(behind) = text.strip_prefix('"') {
        let inner = behind.strip_suffix('"');
        let inner = inner.ok_or("expected a quotation mark at the end of the value, too")?;
        return Ok(Term::from(inner.replace("\\\"", "\"")));
    }
    Ok(match text {
        "true" => Term::Boolean(true),
        "false" => Term::Boolean(false),
        _ => match Number::new(text) {
            Some(number) => Term::Number(number.into_owned()),
            None => Term::from(text.to_owned()),
        },
    })
}

impl Template {
    fn description(&self) -> AgentDescription {
        let service = ServiceDescription {
            name: self.service.clone(),
            service_type: self.service_type.clone(),
            properties: self.property.clone(),
            ..ServiceDescription::default()
        };
        let services = match service == ServiceDescription::default() {
            true => Vec::new(),
            false => vec![service],
        };
        AgentDescription {
            name: self.agent.clone(),
            services,
            ..AgentDescription::default()
        }
    }
}

impl Server {
    async fn of<'a>(&self, agent: &'a Agent, config: &Config) -> Result<Df<'a>, Failure> {
        match &self.df {
            Some(df) => {
                let df = membership::introduce(agent, df.clone(), &self.address).await?;
                Ok(agent.df_of(df))
            }
            None => agent.df().map_err(|error| failed(&error, config)),
        }
    }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    match arguments {
        Arguments::Register {
            agent,
            service_type,
            service,
            property,
            server,
        } => {
            let service = ServiceDescription {
                properties: property,
                ..ServiceDescription::new(
                    service.unwrap_or_else(|| service_type.clone()),
                    service_type,
                )
            };
            options::block_on(register(&agent, service, &server, &config))?
        }
        Arguments::Search {
            template,
            server,
            json,
        } => search(&template, &server, json, &config),
        Arguments::Watch {
            template,
            server,
            count,
            time,
            json,
        } => options::block_on(watch(&template, &server, (count, time), json, &config))?,
    }
}

/// The error report of a call to an agent of a platform.
pub(super) fn failed(error: &PlatformError, config: &Config) -> Failure {
    let help = match error {
        PlatformError::NoAgent(_) => {
            "start a gateway (`fipa up`), or name the agent of another host; `fipa agents` lists them"
        }
        PlatformError::Rejected(_) => "change the request",
        _ => {
            "check with `fipa agents` whether the agent is known, and with `fipa watch` its answers"
        }
    };
    let problem = match error {
        PlatformError::Dialogue(error) => in_full(error),
        other => other.to_string(),
    };
    Failure::failed(problem, format!("domain {:?}", config.domain), help)
}

/// Registers an agent with a random name, which asks the agents of a platform.
pub(super) async fn asking(
    domain: &fipa::Domain,
    command: &str,
    config: &Config,
) -> Result<Agent, Failure> {
    let name = format!("fipa-{command}-{}", Incarnation::random());
    membership::register(domain, &name, RegisterOptions::default(), config).await
}

async fn register(
    name: &AgentId,
    service: ServiceDescription,
    server: &Server,
    config: &Config,
) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let done = async {
        let agent = stop
            .during(membership::register(
                &domain,
                name.name(),
                RegisterOptions::default(),
                config,
            ))
            .await?;
        let df = server.of(&agent, config).await?;
        let service_type = service.service_type.clone().unwrap_or_default();
        let registered = df.register_service(service).await;
        let registered = registered.map_err(|error| failed(&error, config))?;
        output::text(&format!(
            "agent {} offers {} at {}{}; press Ctrl-C to stop\n",
            escape(agent.name()),
            escape(&service_type),
            escape(df.id().name()),
            until(registered.lease_time),
        ))?;
        let mut lease = registered.lease_time;
        loop {
            tokio::select! {
                () = stop.requested() => break,
                () = half(lease) => {
                    let renewed = df.modify(AgentDescription {
                        lease_time: None,
                        ..registered.clone()
                    });
                    let renewed = renewed.await.map_err(|error| failed(&error, config))?;
                    lease = renewed.lease_time;
                }
                // Letters to the agent are not answered.
                received = agent.receive() => drop(received),
            }
        }
        Stop::ending();
        df.deregister()
            .await
            .map_err(|error| failed(&error, config))
    };
    let done = done.await;
    domain.close().await;
    done
}

/// Waits for half of the time until a lease ends.
async fn half(lease: Option<Time>) {
    let now = SystemTime::now();
    let lease_left = lease.map(|lease| lease.to_system_time(now).duration_since(now));
    match lease_left {
        Some(lease_left) => tokio::time::sleep(lease_left.unwrap_or_default() / 2).await,
        None => std::future::pending().await,
    }
}

fn until(lease: Option<Time>) -> String {
    let lease = lease.and_then(Time::to_rfc3339);
    lease.map_or_else(String::new, |lease| format!(" until {lease}"))
}

fn search(
    template: &Template,
    server: &Server,
    as_json: bool,
    config: &Config,
) -> Result<(), Failure> {
    let (df, found) = membership::run(async {
        let domain = membership::join(config).await?;
        let found = async {
            let agent = asking(&domain, "df", config).await?;
            let df = server.of(&agent, config).await?;
            let found = df.search(&template.description()).await;
            let found = found.map_err(|error| failed(&error, config))?;
            if server.df.is_some() {
                let agents = found.iter().filter_map(|it| it.name.as_ref());
                membership::introduce_found(&agent, agents).await;
            }
            Ok((df.id().clone(), found))
        };
        let found = found.await;
        domain.close().await;
        found
    })?;
    if as_json {
        let agents: Vec<Value> = found.iter().map(value).collect();
        return output::json(&json!({ "df": df.name(), "agents": agents }));
    }
    if found.is_empty() {
        return output::text(&format!("{} knows no such service\n", escape(df.name())));
    }
    let mut table = output::table(["AGENT", "TYPE", "SERVICE", "PROPERTIES", "LEASE"]);
    table.add_rows(found.iter().flat_map(rows));
    output::text(&format!("{}\n", table.trim_fmt()))
}

/// One row per service, and one for an agent without services.
fn rows(description: &AgentDescription) -> Vec<[String; 5]> {
    let agent = agent_name(description);
    let lease = description.lease_time.and_then(Time::to_rfc3339);
    let row = |service: &ServiceDescription| {
        let text = |text: &Option<String>| escape(text.as_deref().unwrap_or("-")).into_owned();
        let properties = service.properties.iter().map(|property| {
            let value = property.value.as_ref().map(ToString::to_string);
            let value = value.unwrap_or_default();
            format!("{}={}", escape(&property.name), escape(&value))
        });
        [
            escape(&agent).into_owned(),
            text(&service.service_type),
            text(&service.name),
            properties.collect::<Vec<_>>().join(" "),
            lease.clone().unwrap_or_else(|| "-".to_owned()),
        ]
    };
    match description.services.is_empty() {
        true => vec![row(&ServiceDescription::default())],
        false => description.services.iter().map(row).collect(),
    }
}

fn agent_name(description: &AgentDescription) -> String {
    let name = description.name.as_ref();
    name.map_or_else(String::new, |id| id.name().to_owned())
}

fn value(description: &AgentDescription) -> Value {
    let services = description.services.iter().map(|service| {
        let properties = service.properties.iter();
        let properties = properties.map(|property| {
            let value = property.value.as_ref().map(ToString::to_string);
            (property.name.clone(), json!(value))
        });
        let properties: serde_json::Map<String, Value> = properties.collect();
        json!({
            "name": service.name,
            "type": service.service_type,
            "ownership": service.ownership,
            "protocols": service.protocols,
            "ontologies": service.ontologies,
            "languages": service.languages,
            "properties": properties,
        })
    });
    json!({
        "name": agent_name(description),
        "lease": description.lease_time.and_then(Time::to_rfc3339),
        "protocols": description.protocols,
        "ontologies": description.ontologies,
        "languages": description.languages,
        "services": services.collect::<Vec<_>>(),
    })
}

async fn watch(
    template: &Template,
    server: &Server,
    (count, time): (Option<u64>, Option<Duration>),
    as_json: bool,
    config: &Config,
) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let done = async {
        let agent = stop.during(asking(&domain, "df", config)).await?;
        let df = server.of(&agent, config).await?;
        let notifications = df.subscribe(&template.description()).await;
        let mut notifications = notifications.map_err(|error| failed(&error, config))?;
        let name = df.id().name();
        match as_json {
            true => output::json_line(&json!({ "event": "watching", "df": name }))?,
            false => output::text(&format!(
                "watching the services at {}; press Ctrl-C to stop\n",
                escape(name)
            ))?,
        }
        let (mut shown, mut reader) = (0, output::Reader::of_output());
        let mut over = pin!(options::after(time));
        while count.is_none_or(|count| shown < count) {
            let changed = tokio::select! {
                changed = notifications.next() => changed,
                () = stop.requested() => break,
                () = reader.gone() => break,
                () = &mut over => break,
            };
            for description in changed.map_err(|error| failed(&error, config))? {
                shown += 1;
                output::text(&change(&description, as_json))?;
            }
        }
        Stop::ending();
        // The end of this agent ends the subscription at the DF of this host, a failed delivery at
        // others.
        drop(notifications.cancel(Duration::from_secs(1)).await);
        Ok(())
    };
    let done = done.await;
    domain.close().await;
    done
}

/// The lines of a changed description.
fn change(description: &AgentDescription, as_json: bool) -> String {
    let bare = AgentDescription {
        name: description.name.clone(),
        ..AgentDescription::default()
    };
    let has_left = *description == bare;
    if as_json {
        let event = match has_left {
            true => json!({ "event": "left", "name": agent_name(description) }),
            false => json!({ "event": "changed", "agent": value(description) }),
        };
        return format!("{}\n", output::visible_in_json(&event.to_string()));
    }
    if has_left {
        return format!("left     {}\n", escape(&agent_name(description)));
    }
    let rows = rows(description).into_iter();
    let lines = rows.map(|[agent, service_type, service, properties, _]| {
        let line = format!("offered  {agent}  {service_type}  {service}  {properties}");
        format!("{}\n", line.trim_end())
    });
    lines.collect()
}
