//! The program of the operator: it asks for a stack of two items on a robot.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use fipa::platform::{AgentDescription, ServiceDescription};
use fipa::protocol::ContractNet;
use fipa::{Agent, AgentId, Domain, Message, Performative};

use crate::fetching;
use crate::part::{Failed, Part, Stop};
use crate::report::{Claim, Reporter};
use crate::sherpa::{self, Dock, DockResult};
use crate::words::{self, Fetch};
use crate::{COALITION, Fault};

/// Maximum wait for the answers of a step.
const TIMEOUT: Duration = Duration::from_secs(20);
/// Time between two searches.
const PAUSE: Duration = Duration::from_millis(100);
/// Maximum time after which a further attempt to dock an item begins. After a cut of the link, the guide waits twice as
/// long as [`sherpa::TIMEOUT`](crate::sherpa::TIMEOUT) at most in the usual case, and refuses others until then.
const ATTEMPTS: Duration = Duration::from_secs(45);
/// Time between two attempts.
const BREAK: Duration = Duration::from_secs(2);
/// The robot that gets the stack.
const CLIENT: &str = "crex";

/// Runs the program.
pub(crate) async fn run(part: &Part) -> Result<(), Failed> {
    let domain = Domain::open(&part.config()?).await?;
    let agent = domain.register(&part.name).await?;
    let operator = Operator {
        part,
        agent,
        reporter: Reporter::new(&part.name),
    };
    operator.reporter.claim(Claim::Ready);
    let mut stop = Stop::default();
    tokio::select! {
        (stack, reason) = operator.work() => {
            let reason = reason.map(|it| it.to_string());
            operator.reporter.claim(Claim::Finished { stack, reason });
            stop.requested().await;
        }
        () = stop.requested() => {}
    }
    drop(operator);
    domain.close().await;
    Ok(())
}

struct Operator<'a> {
    part: &'a Part,
    agent: Agent,
    reporter: Reporter,
}

impl Operator<'_> {
    /// Has the items fetched and docked. Returns those that are docked, and the reason if some are not.
    async fn work(&self) -> (Vec<String>, Option<Failed>) {
        let mut stack = Vec::new();
        let reason = self.stack(&mut stack).await.err();
        (stack, reason)
    }

    async fn stack(&self, stack: &mut Vec<String>) -> Result<(), Failed> {
        let robots = self.find(fetching::SERVICE, 2).await?;
        let items = self.find("payload", 2).await?;
        let guides = self.find(sherpa::SERVICE, 1).await?;
        let guide = guides
            .first()
            .and_then(|guide| guide.name.clone())
            .ok_or("no guide")?;
        // The robot that gets the stack docks first: the other one holds its item until it comes.
        for item in self.allocate(&robots, &items).await? {
            self.dock(&guide, &item, stack).await?;
            stack.push(item);
        }
        let look = self
            .agent
            .message(Performative::Request)
            .receiver(COALITION);
        let mut request = self.agent.request(look.content("look"), TIMEOUT).await?;
        request.result().await?;
        Ok(())
    }

    /// Waits until this number of agents has a service.
    async fn find(&self, service: &str, number: usize) -> Result<Vec<AgentDescription>, Failed> {
        let template = ServiceDescription::of_type(service).into();
        loop {
            let found = self.agent.df()?.search(&template).await?;
            if found.len() >= number {
                let names = found.iter().filter_map(|it| it.name.as_ref());
                self.reporter.claim(Claim::Found {
                    service: service.to_owned(),
                    agents: names.map(|name| name.name().to_owned()).collect(),
                });
                return Ok(found);
            }
            tokio::time::sleep(PAUSE).await;
        }
    }

    /// Calls for proposals for each item, and awards each to one robot so that the sum of the costs is lowest. Returns
    /// the items in the order of docking.
    async fn allocate(
        &self,
        robots: &[AgentDescription],
        items: &[AgentDescription],
    ) -> Result<Vec<String>, Failed> {
        let robots: Vec<AgentId> = robots.iter().filter_map(|it| it.name.clone()).collect();
        let mut nets = Vec::new();
        for item in items {
            let name = item.name.as_ref().ok_or("an item has no name")?.name();
            let pose = item.services.iter().find_map(words::pose);
            let fetch = Fetch {
                item: name.to_owned(),
                pose: pose.ok_or("an item has no pose")?,
            };
            let call = self.agent.message(Performative::Cfp);
            let call = call.content(words::say(&fetch));
            let net = self.agent.contract_net(call, &robots, TIMEOUT).await?;
            let bids: Bids = net.bids().proposals.iter().filter_map(bid).collect();
            nets.push((fetch.item, net, bids));
        }
        let [(first, net_1, bids_1), (second, net_2, bids_2)] = nets.as_mut_slice() else {
            return Err("expected two items".into());
        };
        let other = robots
            .iter()
            .find(|it| it.name() != CLIENT)
            .ok_or("one robot only")?;
        let cost = |bids: &Bids, robot: &str| bids.get(robot).map_or(f64::INFINITY, |bid| bid.0);
        let straight = cost(bids_1, CLIENT) + cost(bids_2, other.name());
        let crossed = cost(bids_2, CLIENT) + cost(bids_1, other.name());
        let (to_first, to_second) = match straight <= crossed {
            true => (CLIENT, other.name()),
            false => (other.name(), CLIENT),
        };
        // Both robots work at the same time.
        let (one, two) = tokio::join!(
            self.award(first, net_1, bids_1, to_first),
            self.award(second, net_2, bids_2, to_second)
        );
        one?;
        two?;
        let mut order = vec![first.clone(), second.clone()];
        if to_first != CLIENT {
            order.reverse();
        }
        Ok(order)
    }

    async fn award(
        &self,
        item: &str,
        net: &mut ContractNet,
        bids: &Bids,
        robot: &str,
    ) -> Result<(), Failed> {
        self.reporter.claim(Claim::Award {
            item: item.to_owned(),
            bids: bids
                .iter()
                .map(|(name, bid)| (name.clone(), bid.0))
                .collect(),
            robot: robot.to_owned(),
        });
        let (_, proposal) = bids.get(robot).ok_or("no bid")?;
        for awarded in net
            .award(std::slice::from_ref(proposal), "", TIMEOUT)
            .await?
        {
            awarded.result?;
        }
        Ok(())
    }

    /// Has an item docked in front of the stack.
    async fn dock(&self, guide: &AgentId, item: &str, stack: &[String]) -> Result<(), Failed> {
        let with = match stack.last() {
            Some(last) => format!("{last}/b"),
            None => format!("{CLIENT}/top"),
        };
        let goal = Dock {
            item: item.to_owned(),
            client: CLIENT.to_owned(),
            with,
        };
        let until = Instant::now() + ATTEMPTS;
        let mut attempt = 1;
        loop {
            match self.attempt(guide, &goal).await {
                Ok(_) => return Ok(()),
                Err(error) if Instant::now() >= until || self.gives_up(item).await => {
                    return Err(error);
                }
                Err(error) => self
                    .reporter
                    .noticed(format!("attempt {attempt} to dock {item}: {error}")),
            }
            attempt += 1;
            tokio::time::sleep(BREAK).await;
        }
    }

    /// Whether no further attempt can succeed, or the operator wants none.
    async fn gives_up(&self, item: &str) -> bool {
        let directory = self.agent.domain().directory();
        let until = Instant::now() + TIMEOUT;
        // The host of the item may be silent, and return.
        while directory.lookup(item).is_none()
            && directory.lost_agent(item).is_some()
            && Instant::now() < until
        {
            tokio::time::sleep(PAUSE).await;
        }
        directory.lookup(item).is_none() || self.part.fault == Some(Fault::Cancel)
    }

    async fn attempt(&self, guide: &AgentId, goal: &Dock) -> Result<DockResult, Failed> {
        let robot = self.agent.robot(guide.clone());
        let mut handle = robot.invoke("dock", goal).await?;
        if self.part.fault == Some(Fault::Cancel) {
            let mut progress = handle.progress().await?;
            while let Some(status) = progress.next().await? {
                let note = status.progress.and_then(|it| it.note);
                if note.as_deref() == Some("align") {
                    break;
                }
            }
            if handle.cancel(TIMEOUT).await? {
                return Err("the operator has cancelled".into());
            }
        }
        Ok(handle.result().await?)
    }
}

/// The bids for one item: by robot, its cost and its proposal.
type Bids = BTreeMap<String, (f64, Message)>;

fn bid(proposal: &Message) -> Option<(String, (f64, Message))> {
    let cost: f64 = words::hear(proposal)?;
    let robot = proposal.sender()?.name().to_owned();
    cost.is_finite().then(|| (robot, (cost, proposal.clone())))
}
