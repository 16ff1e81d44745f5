//! Three hosts with a gateway process each, whose links are cut and restored in a seeded random order.
//! After every repair the processes of all hosts list the same agents again, although announcements
//! and goodbyes were lost in between. The failure of a gateway that sent no goodbye is detected by the
//! hosts that send letters to its agents.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stdout, reason = "the test prints its times")]

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use fipa::config::Sources;
use fipa::{Agent, AgentId, Config, Domain, Incarnation, Performative, Role};
use fipa_testbed::{ChildGuard, Host, Network, PacketRepeater, enter, isolated, until};
use tokio::runtime::{Builder, Runtime};

#[test]
fn processes_agree_after_every_link_repair() {
    isolated("inside_processes_agree_after_every_link_repair", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_processes_agree_after_every_link_repair() {
    enter();
    let seed = std::env::var("FIPA_LINKS_SEED").ok();
    let seed = seed.map_or(3, |seed| seed.parse().unwrap());
    println!("FIPA_LINKS_SEED={seed}");
    let mut random = fastrand::Rng::with_seed(seed);
    let network = Network::new(3);
    let mut robots: Vec<Robot> = network.hosts().iter().map(Robot::start).collect();
    for robot in &mut robots {
        robot.toggle(0);
    }
    agree(&robots);
    for round in 0..3 {
        let mut cut = BTreeSet::new();
        for _ in 0..6 {
            let at = random.usize(0..robots.len());
            match random.usize(0..3) {
                0 if cut.remove(&at) => network.host(at).plug(),
                0 => {
                    cut.insert(at);
                    network.host(at).unplug();
                }
                _ => robots[at].toggle(random.usize(0..4)),
            }
            std::thread::sleep(Duration::from_millis(random.u64(0..600)));
        }
        for at in cut {
            network.host(at).plug();
        }
        let repaired = Instant::now();
        agree(&robots);
        println!(
            "round {round}: all agree {:.1?} after the repair",
            repaired.elapsed()
        );
    }

    // A killed gateway sends no goodbye. Its beacons are repeated, so hosts that only listen keep its
    // entries. A host that sends a letter to one of its agents detects the failure and removes them.
    robots[2].set_registered(0, true);
    agree(&robots);
    let gone = robots[2].agents.keys().next().unwrap().clone();
    let gateway = robots[0].gateway_of(&gone);
    let mut repeater = network.host(2).enter(|| {
        let beacon = format!("{gateway}\x0d_fipa_gateway");
        PacketRepeater::capture(&beacon, network.host(2).ipv4(), 5353)
    });
    robots[2].gateway = None;
    repeater.start();
    let killed = Instant::now();
    robots[0].fails_to_reach(&gone);
    until("the sender detects the failure", || {
        !robots[0].view().contains(&gone)
    });
    println!("detected {:.1?} after the kill", killed.elapsed());

    // A host that sent no letter detects the failure when the beacons end.
    drop(repeater);
    let silent = Instant::now();
    until("the missing beacons are detected", || {
        !robots[1].view().contains(&gone)
    });
    println!("detected {:.1?} after the last beacon", silent.elapsed());
}

/// A host with a gateway process and agents that are registered and deregistered.
struct Robot {
    name: String,
    gateway: Option<ChildGuard>,
    domain: Domain,
    agents: BTreeMap<String, Agent>,
    writer: Agent,
    runtime: Runtime,
}

impl Robot {
    fn start(host: &Host) -> Self {
        let name = host.name().to_owned();
        let set = [
            format!("domain={name}"),
            format!("mts.name={name}-mts"),
            format!("transport.tcp.listen=[\"{}:0\"]", host.ipv4()),
            "mts.deadline=2s".to_owned(),
            "security.insecure=true".to_owned(),
        ];
        let mut up = host.command(env!("CARGO_BIN_EXE_fipa"));
        for setting in &set {
            up.args(["--set", setting]);
        }
        let (gateway, _ready) = ChildGuard::until_ready(up.arg("up"));
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let config = Config::load(&Sources {
            set: set.to_vec(),
            ..Sources::default()
        });
        let domain = runtime.block_on(Domain::open(&config.unwrap())).unwrap();
        let writer = runtime
            .block_on(domain.register(&format!("{name}.writer")))
            .unwrap();
        Self {
            name,
            gateway: Some(gateway),
            domain,
            agents: BTreeMap::new(),
            writer,
            runtime,
        }
    }

    /// Registers the agent of this number, or deregisters it if it is registered.
    fn toggle(&mut self, number: usize) {
        let name = self.name_of(number);
        self.set_registered(number, !self.agents.contains_key(&name));
    }

    fn set_registered(&mut self, number: usize, registered: bool) {
        let name = self.name_of(number);
        match self.agents.remove(&name) {
            Some(agent) if registered => drop(self.agents.insert(name, agent)),
            None if registered => {
                let agent = self.runtime.block_on(self.domain.register(&name)).unwrap();
                self.agents.insert(name, agent);
            }
            _ => {}
        }
    }

    fn name_of(&self, number: usize) -> String {
        format!("{}.agent {number}", self.name)
    }

    /// The agents of all hosts in the directory of a process of this host.
    fn view(&self) -> BTreeSet<String> {
        let directory = self.domain.directory();
        directory.refresh();
        let entries = directory.entries();
        let agents = entries
            .iter()
            .filter(|entry| entry.role == Role::Agent && !entry.is_platform_agent());
        agents.map(|entry| entry.name.to_string()).collect()
    }

    /// The gateway of this agent.
    fn gateway_of(&self, name: &str) -> Incarnation {
        let entry = self.domain.directory().known(name).unwrap();
        entry.mts.incarnation
    }

    fn fails_to_reach(&self, name: &str) {
        let message = self
            .writer
            .message(Performative::Inform)
            .receiver(AgentId::new(name).unwrap())
            .build()
            .unwrap();
        let sent = self.runtime.block_on(self.writer.send(message)).unwrap();
        assert!(!sent.all_succeeded(), "{sent}");
    }
}

/// Waits until every host lists exactly the registered agents.
fn agree(robots: &[Robot]) {
    let all: BTreeSet<String> = robots
        .iter()
        .flat_map(|robot| {
            let agents = robot.agents.keys().cloned();
            agents.chain([robot.writer.name().to_owned()])
        })
        .collect();
    until("all hosts agree", || {
        robots.iter().all(|robot| robot.view() == all)
    });
}
