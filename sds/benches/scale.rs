//! The exchange of directories between many hosts, on virtual time: letters, bytes and processor time of one host
//! when all start, when one agent registers, and in an idle hour. Prints a table and the exponents of growth.
//!
//! All hosts have the same number of agents, and each host is connected with all others. One host has all
//! others as neighbors; each of the others has only that one as a neighbor, because the load of all hosts is the
//! same. A letter arrives after one millisecond.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench for a terminal"
)]

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant, UNIX_EPOCH};

use fipa_sds::{Directory, Entry, Exchange, MtsId, Present, Reach, Role, Source};
use fipa_transport::{Incarnation, Location, Mandate, Principal};

const LATENCY: Duration = Duration::from_millis(1);

/// A gateway with its agents.
struct Gateway {
    mts: MtsId,
    exchange: Exchange,
    agents: Vec<Arc<Entry>>,
}

impl Gateway {
    fn new(host: u64, agents: u64) -> Self {
        let mts = MtsId::new(format!("gateway_{host}"), Incarnation::from_u64(host));
        let agents = (0..agents).map(|agent| entry(&mts, host, agent)).collect();
        Self {
            exchange: Exchange::new(host),
            mts,
            agents,
        }
    }

    fn present(&self) -> Present {
        let host = self.mts.incarnation.as_u64();
        let text = format!("tcp://10.{}.{}.1:7788#{host:016x}", host / 256, host % 256);
        Present {
            mts: self.mts.clone(),
            locations: vec![text.parse::<Location>().unwrap()],
            mandate: Mandate::Unproved,
            principal: Principal::Unproved,
        }
    }

    fn tell_own(&mut self, now: Instant) {
        self.exchange.handle_own(now, &self.agents);
    }
}

fn entry(mts: &MtsId, host: u64, agent: u64) -> Arc<Entry> {
    Arc::new(Entry {
        name: format!("arm_{host}_{agent}").into(),
        agent_type: "arm".to_owned(),
        incarnation: Incarnation::from_u64((host << 32) + agent + 1),
        locations: vec!["shm://here".parse().unwrap()],
        mts: mts.clone(),
        description: "lifts up to 20 kg".to_owned(),
        registered: UNIX_EPOCH + Duration::from_millis(host),
        source: Source::Host,
        reach: Reach::Local,
        peer: fipa_transport::PeerId::THIS_HOST,
        role: Role::Agent,
    })
}

/// Load of the observed host.
#[derive(Debug, Default, Clone, Copy)]
struct Load {
    letters: u64,
    bytes: u64,
    /// Processor time of this host for its letters and for those of its neighbors.
    spent: Duration,
    /// Virtual time until no letter was under way.
    until: Duration,
}

struct World {
    now: Instant,
    hub: Gateway,
    others: Vec<Gateway>,
    /// Letters under way: from the hub or to it, the other host, the content, and the time of the arrival.
    letters: VecDeque<(bool, usize, Vec<u8>, Instant)>,
    load: Load,
}

impl World {
    fn new(hosts: u64, agents: u64) -> Self {
        Self {
            now: Instant::now(),
            hub: Gateway::new(1, agents),
            others: (2..=hosts).map(|host| Gateway::new(host, agents)).collect(),
            letters: VecDeque::new(),
            load: Load::default(),
        }
    }

    /// Connects all hosts, which send all their agents.
    fn start(&mut self) {
        let now = self.now;
        let present: Vec<Present> = self.others.iter().map(Gateway::present).collect();
        let hub = self.hub.present();
        for other in &mut self.others {
            other.tell_own(now);
            other
                .exchange
                .handle_neighbors(now, std::slice::from_ref(&hub));
        }
        self.spend(|hub| {
            hub.tell_own(now);
            hub.exchange.handle_neighbors(now, &present);
        });
    }

    /// Counts the time of the hub.
    fn spend<T>(&mut self, work: impl FnOnce(&mut Gateway) -> T) -> T {
        let began = Instant::now();
        let result = work(&mut self.hub);
        self.load.spent += began.elapsed();
        result
    }

    fn next(&self) -> Option<Instant> {
        let others = self.others.iter();
        let timeouts = others.filter_map(|other| other.exchange.poll_timeout());
        let own = self.hub.exchange.poll_timeout();
        let arrival = self.letters.front().map(|(.., at)| *at);
        timeouts.chain(own).chain(arrival).min()
    }

    /// Runs for this time, and returns the load of the hub.
    fn run(&mut self, time: Duration) -> Load {
        let began = self.now;
        self.step();
        while let Some(next) = self.next().filter(|next| *next <= began + time) {
            self.now = next.max(self.now);
            self.step();
        }
        self.now = began + time;
        std::mem::take(&mut self.load)
    }

    fn step(&mut self) {
        let now = self.now;
        self.spend(|hub| hub.exchange.handle_timeout(now));
        while let Some((to, content)) = self.spend(|hub| hub.exchange.poll_letter(now)) {
            self.load.letters += 1;
            self.load.bytes += content.len() as u64;
            let other = usize::try_from(to.as_u64() - 2).unwrap();
            self.letters
                .push_back((true, other, content, now + LATENCY));
        }
        for (index, other) in self.others.iter_mut().enumerate() {
            if other.exchange.poll_timeout().is_none_or(|due| due > now) {
                continue;
            }
            other.exchange.handle_timeout(now);
            while let Some((_, content)) = other.exchange.poll_letter(now) {
                self.letters
                    .push_back((false, index, content, now + LATENCY));
            }
        }
        let own = self.hub.mts.incarnation;
        while let Some((from_hub, index, content, _)) =
            self.letters.pop_front_if(|(.., at)| *at <= now)
        {
            let other = self.others[index].mts.incarnation;
            let exchange = &mut self.others[index].exchange;
            if from_hub {
                exchange.handle_letter(now, own, &content).unwrap();
                self.spend(|hub| hub.exchange.handle_sent(now, other, true));
            } else {
                exchange.handle_sent(now, own, true);
                self.spend(|hub| hub.exchange.handle_letter(now, other, &content))
                    .unwrap();
            }
        }
    }

    /// Runs until all hosts have the agents that they need, at most for this time.
    fn run_until_known(&mut self, most: Duration) -> Load {
        let began = self.now;
        let mut load = Load::default();
        while !self.is_known() {
            assert!(self.now < began + most, "the hosts never agree");
            let part = self.run(Duration::from_millis(1));
            load.letters += part.letters;
            load.bytes += part.bytes;
            load.spent += part.spent;
        }
        load.until = self.now - began;
        load
    }

    fn is_known(&self) -> bool {
        let known = |gateway: &Gateway| gateway.exchange.directory().entries().len();
        let theirs: usize = self.others.iter().map(|other| other.agents.len()).sum();
        known(&self.hub) == theirs
            && self
                .others
                .iter()
                .all(|other| known(other) == self.hub.agents.len())
    }
}

/// Returns the exponent of growth of a value from the first row to the last one.
fn exponent(rows: &[(u64, [f64; 8])], column: usize) -> f64 {
    let (first, last) = (rows.first().unwrap(), rows.last().unwrap());
    (last.1[column] / first.1[column]).ln() / (last.0 as f64 / first.0 as f64).ln()
}

fn main() {
    // `cargo test --benches` only builds it.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    println!(
        "{:>6} {:>7} | {:>22} {:>9} | {:>22} {:>9} | {:>16} {:>9}",
        "hosts",
        "agents",
        "start: letters, kB, ms",
        "known s",
        "1 agent: letters, kB, ms",
        "known s",
        "idle: kB/s, ‰ core",
        "letters/s"
    );
    // The hosts that an exchange connects with are limited.
    let most = Exchange::MAX_NEIGHBORS as u64 + 1;
    for agents in [10, 40] {
        let mut rows = Vec::new();
        for hosts in [10, 100, most] {
            let mut world = World::new(hosts, agents);
            world.start();
            let start = world.run_until_known(Duration::from_secs(60));
            world.run(Duration::from_secs(60));
            let hub = entry(&world.hub.mts, 1, agents);
            world.hub.agents.push(hub);
            let now = world.now;
            world.spend(|hub| hub.tell_own(now));
            let one = world.run_until_known(Duration::from_secs(60));
            world.run(Duration::from_secs(60));
            let idle = world.run(Duration::from_secs(3600));
            let row = [
                start.letters as f64,
                start.bytes as f64 / 1e3,
                start.spent.as_secs_f64() * 1e3,
                one.letters as f64,
                one.bytes as f64 / 1e3,
                one.spent.as_secs_f64() * 1e3,
                idle.bytes as f64 / 1e3 / 3600.0,
                idle.spent.as_secs_f64() / 3.6,
            ];
            println!(
                "{hosts:>6} {:>7} | {:>6} {:>7.0} {:>7.1} {:>9.3} | {:>6} {:>7.1} {:>7.2} {:>9.3} | {:>8.3} {:>7.3} {:>9.2}",
                hosts * agents,
                start.letters,
                row[1],
                row[2],
                start.until.as_secs_f64(),
                one.letters,
                row[4],
                row[5],
                one.until.as_secs_f64(),
                row[6],
                row[7],
                idle.letters as f64 / 3600.0,
            );
            rows.push((hosts, row));
        }
        let names = [
            "start letters",
            "start bytes",
            "start time",
            "agent letters",
            "agent bytes",
            "agent time",
            "idle bytes",
            "idle time",
        ];
        let exponents: Vec<String> = names
            .iter()
            .enumerate()
            .map(|(column, name)| format!("{name} {:.2}", exponent(&rows, column)))
            .collect();
        println!(
            "growth with the number of hosts, exponents: {}",
            exponents.join(", ")
        );
    }
}
