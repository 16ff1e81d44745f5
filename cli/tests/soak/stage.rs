//! Three hosts with gateways, processes and moving agents, and the faults that the test injects.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{ChildStdin, Stdio};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use fastrand::Rng;
use fipa_testbed::{ChildGuard, Family, Network};
use parking_lot::Mutex;

use super::actor::{PART, Part};
use super::checker::{Life, Quiet};
use super::journal::now;
use crate::hosts::{PORT, filter, gateway, keys, make_keys, nft};

/// Timeout that ends a hung test.
const WATCHDOG: Duration = Duration::from_secs(90);
const HOSTS: usize = 3;
const PROCESSES_PER_HOST: usize = 2;
const MOVERS: usize = 2;
/// Transports between hosts.
const ORDERS: [&[&str]; 3] = [&["tcp"], &["udp", "tcp"], &["quic", "tcp"]];

/// A fault and its name in `FIPA_SOAK_FAULTS`.
type Fault = (&'static str, fn(&mut Stage));

/// All faults. A repeated entry makes its fault more frequent.
const FAULTS: [Fault; 15] = [
    ("kill", Stage::kill_process),
    ("kill", Stage::kill_process),
    ("restart", Stage::restart_process),
    ("kill-gateway", Stage::kill_gateway),
    ("stop", Stage::stop_process),
    ("stop-gateway", Stage::stop_gateway),
    ("cut", Stage::cut),
    ("cut", Stage::cut),
    ("filter", Stage::filter),
    ("filter", Stage::filter),
    ("address", Stage::change_address),
    ("move", Stage::move_agent),
    ("move", Stage::move_agent),
    ("burst", Stage::burst),
    ("burst", Stage::burst),
];

/// Returns the faults of this run: those that `FIPA_SOAK_FAULTS` names, or all.
fn faults() -> Vec<Fault> {
    let asked = std::env::var("FIPA_SOAK_FAULTS").unwrap_or_default();
    let all = FAULTS.iter().copied();
    let faults: Vec<Fault> = match asked.as_str() {
        "" => all.collect(),
        names => all
            .filter(|(name, _)| names.split(',').any(|it| it == *name))
            .collect(),
    };
    assert!(
        !faults.is_empty(),
        "FIPA_SOAK_FAULTS names no fault: {asked}"
    );
    faults
}

/// Returns the numbers of the addresses that a host can have.
fn numbers(at: usize) -> [u8; 3] {
    let at = at as u8;
    [at + 1, at + 51, at + 101]
}

/// The host with the policed link.
const POLICED: usize = HOSTS - 1;

/// Bits a second of that link, in millions, by default.
const MBITS: u64 = 10;

/// Returns the addresses of this run: those that `FIPA_SOAK_FAMILY` names, or any.
fn family(random: &mut Rng) -> Family {
    let drawn = Family::ALL[random.usize(..Family::ALL.len())];
    match std::env::var("FIPA_SOAK_FAMILY").as_deref() {
        Err(_) => drawn,
        Ok("ipv4") => Family::V4,
        Ok("ipv6") => Family::UniqueLocal,
        Ok("link") => Family::LinkLocal,
        Ok("both") => Family::Both,
        Ok(other) => panic!("FIPA_SOAK_FAMILY is ipv4, ipv6, link or both, not {other}"),
    }
}

/// Drops the packets of a host beyond `FIPA_SOAK_MBITS` in each direction; 0 for none. Returns the rate.
fn police(network: &Network) -> u64 {
    let rate = std::env::var("FIPA_SOAK_MBITS").map(|rate| rate.parse().unwrap());
    let rate = rate.unwrap_or(MBITS);
    let host = network.host(POLICED);
    if rate > 0 {
        nft(host, "add table inet police");
        let limit = format!(
            "limit rate over {} kbytes/second burst 128 kbytes drop",
            rate * 125
        );
        for (hook, name) in [("input", "iifname"), ("output", "oifname")] {
            let chain = format!("{{ type filter hook {hook} priority 0; }}");
            nft(host, &format!("add chain inet police {hook} {chain}"));
            nft(
                host,
                &format!("add rule inet police {hook} {name} eth0 {limit}"),
            );
        }
    }
    rate
}

/// State of a process.
enum State<T> {
    Runs(T),
    Stopped(T),
    /// The process has received the command to end.
    Ends(T),
    Down,
}

struct Host {
    settings: Vec<String>,
    gateway: State<ChildGuard>,
    starting: Option<JoinHandle<ChildGuard>>,
    address: usize,
    /// Whether its network has a fault.
    disturbed: bool,
}

/// A process with its agents. The stage restarts the process after its end.
struct Seat {
    host: usize,
    /// Agents that belong to this process at present.
    names: BTreeSet<String>,
    process: State<Process>,
}

struct Process {
    running: ChildGuard,
    input: ChildStdin,
    said: Arc<Mutex<Vec<String>>>,
    life: usize,
}

impl Process {
    fn tell(&mut self, line: &str) {
        // An error means that the process has ended; `notice_ends` reports that.
        let _ = writeln!(self.input, "{line}");
    }

    fn has_said(&self, line: &str) -> bool {
        self.said.lock().iter().any(|said| said == line)
    }

    fn count_left(&self, name: &str) -> usize {
        let deregistered = format!("left {name}");
        self.said
            .lock()
            .iter()
            .filter(|said| **said == deregistered)
            .count()
    }

    /// Whether the agent is registered in this process at present. Moving agents register and leave
    /// repeatedly.
    fn has(&self, name: &str) -> bool {
        let (registered, deregistered) = (format!("registered {name}"), format!("left {name}"));
        let said = self.said.lock();
        let last = said
            .iter()
            .rev()
            .find(|said| [&registered, &deregistered].contains(said));
        last == Some(&registered)
    }

    fn signal(&mut self, signal: &str) {
        self.running.signal(signal);
    }
}

/// The end of a fault.
#[derive(Debug, Clone, Copy)]
enum Repair {
    StartGateway(usize),
    StartProcess(usize),
    ContinueGateway(usize),
    ContinueProcess(usize),
    Network(usize),
}

/// An agent on its way to another process.
struct Move {
    name: String,
    /// The process that the agent leaves.
    life: usize,
    /// Number of times that the agent had left that process before.
    left_before: usize,
    to: usize,
}

pub(crate) struct Stage {
    network: Network,
    hosts: Vec<Host>,
    seats: Vec<Seat>,
    moves: Vec<Move>,
    repairs: Vec<(Instant, Repair)>,
    names: Vec<String>,
    faults: Vec<Fault>,
    random: Rng,
    proofs: u32,
    pub(crate) lives: Vec<Life>,
    pub(crate) quiet: Vec<Quiet>,
    pub(crate) counts: BTreeMap<&'static str, usize>,
    pub(crate) setup: String,
}

impl Stage {
    pub(crate) fn new(seed: u64) -> Self {
        let mut random = Rng::with_seed(seed);
        let order = ORDERS[random.usize(..ORDERS.len())];
        let mdns = random.bool();
        if order.contains(&"quic") {
            make_keys(HOSTS);
        }
        let family = family(&mut random);
        let network = Network::of(family, HOSTS as u8);
        let mbits = police(&network);
        let hosts = (0..HOSTS).map(|at| Host {
            settings: settings(&network, at, order, mdns),
            gateway: State::Down,
            starting: None,
            address: 0,
            disturbed: false,
        });
        let hosts: Vec<Host> = hosts.collect();
        let mut seats: Vec<Seat> = (0..HOSTS * PROCESSES_PER_HOST)
            .map(|seat| Seat {
                host: seat % HOSTS,
                names: BTreeSet::from([format!("fixed{seat}")]),
                process: State::Down,
            })
            .collect();
        for (mover, seat) in seats.iter_mut().take(MOVERS).enumerate() {
            seat.names.insert(format!("mover{mover}"));
        }
        let names = seats.iter().flat_map(|seat| seat.names.clone());
        let mut stage = Self {
            network,
            hosts,
            names: names.collect(),
            seats,
            faults: faults(),
            moves: Vec::new(),
            repairs: Vec::new(),
            random,
            proofs: 0,
            lives: Vec::new(),
            quiet: Vec::new(),
            counts: BTreeMap::new(),
            setup: format!(
                "{}, {}, {family:?}, a link of {mbits} Mbit/s",
                order.join("+"),
                if mdns { "mDNS" } else { "static peers" }
            ),
        };
        for at in 0..HOSTS {
            stage.start_gateway(at);
        }
        for seat in 0..stage.seats.len() {
            stage.start_process(seat);
        }
        stage.settle();
        stage
    }

    /// Injects faults for the duration `faults`, then none for at least the duration `quiet`.
    pub(crate) fn disturb(&mut self, faults: Duration, quiet: Duration) {
        if let Some(last) = self.quiet.last_mut() {
            last.end = now();
        }
        let end = Instant::now() + faults;
        while Instant::now() < end {
            self.fault();
            let until = Instant::now() + Duration::from_millis(self.random.u64(30..500));
            while Instant::now() < until {
                self.work(Instant::now());
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        let healed = self.settle();
        let waited = waited_for_processors();
        let proved = self.prove();
        let waited = waited_for_processors().saturating_sub(waited);
        std::thread::sleep(quiet);
        self.quiet.push(Quiet {
            healed,
            proved,
            end: now(),
            busy_percent: 100 * waited / (proved - healed).max(1),
        });
    }

    /// Stops new letters, waits until every letter has its outcomes, and ends all processes.
    pub(crate) fn close(&mut self) {
        if let Some(last) = self.quiet.last_mut() {
            last.end = now();
        }
        self.tell_all("rest");
        self.wait_for_all("idle");
        self.tell_all("quit");
        self.wait_for_all("bye");
    }

    fn tell_all(&mut self, line: &str) {
        for seat in &mut self.seats {
            if let State::Runs(process) = &mut seat.process {
                process.tell(line);
            }
        }
    }

    fn wait_for_all(&mut self, line: &str) {
        let started = Instant::now();
        loop {
            let mut processes = self.seats.iter().filter_map(|seat| match &seat.process {
                State::Runs(process) => Some(process),
                _ => None,
            });
            if processes.all(|process| process.has_said(line)) {
                return;
            }
            if line != "bye" {
                self.notice_ends();
            }
            assert!(
                started.elapsed() < WATCHDOG,
                "not all processes have written {line}: {}",
                self.stand()
            );
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn stand(&self) -> String {
        let seats = self.seats.iter().enumerate().map(|(at, seat)| {
            let (state, said) = match &seat.process {
                State::Runs(process) => (process.life.to_string(), process.said.lock().clone()),
                State::Stopped(_) => ("stopped".to_owned(), Vec::new()),
                State::Ends(process) => ("ending".to_owned(), process.said.lock().clone()),
                State::Down => ("down".to_owned(), Vec::new()),
            };
            let last: Vec<_> = said.iter().rev().take(4).collect();
            format!(
                "\n  seat {at} (host {}), life {state}, {:?}: {last:?}",
                seat.host, seat.names
            )
        });
        seats.collect()
    }

    /// Ends every fault and waits until all gateways and agents run. Returns the time of that
    /// moment.
    fn settle(&mut self) -> u64 {
        let started = Instant::now();
        loop {
            self.work(Instant::now() + WATCHDOG);
            let gateways = self
                .hosts
                .iter()
                .all(|host| matches!(host.gateway, State::Runs(_)));
            let agents = self.seats.iter().all(|seat| match &seat.process {
                State::Runs(process) => seat.names.iter().all(|name| process.has(name)),
                _ => false,
            });
            if gateways && agents && self.moves.is_empty() {
                return now();
            }
            assert!(
                started.elapsed() < WATCHDOG,
                "not all gateways and agents run: {}",
                self.stand()
            );
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Waits until every stream has delivered a letter that was sent after the last fault. Returns
    /// the time of that moment.
    fn prove(&mut self) -> u64 {
        self.proofs += 1;
        let token = self.proofs;
        self.tell_all(&format!("prove {token}"));
        self.wait_for_all(&format!("proved {token}"));
        now()
    }

    /// Carries out the repairs and restarts that are due, and panics if a process ended
    /// unexpectedly.
    fn work(&mut self, due: Instant) {
        self.notice_ends();
        let (due, later) = self.repairs.drain(..).partition(|(at, _)| *at <= due);
        self.repairs = later;
        let due: Vec<(Instant, Repair)> = due;
        for (_, repair) in due {
            self.repair(repair);
        }
        for host in &mut self.hosts {
            if host.starting.as_ref().is_some_and(JoinHandle::is_finished) {
                let started = host.starting.take().unwrap().join();
                host.gateway = State::Runs(started.expect("a gateway starts"));
            }
        }
        for at in 0..self.seats.len() {
            if let State::Ends(process) = &mut self.seats[at].process
                && let Some(status) = process.running.ended()
            {
                assert!(
                    status.success(),
                    "the process of seat {at} ended with {status}"
                );
                self.seats[at].process = State::Down;
                self.later(1..300, Repair::StartProcess(at));
            }
        }
        let (gone, waiting) = self.moves.drain(..).partition(|going: &Move| {
            let mut processes = self.seats.iter().filter_map(|seat| match &seat.process {
                State::Runs(process) | State::Stopped(process) | State::Ends(process) => {
                    Some(process)
                }
                State::Down => None,
            });
            let from = processes.find(|process| process.life == going.life);
            from.is_none_or(|process| process.count_left(&going.name) > going.left_before)
        });
        self.moves = waiting;
        let gone: Vec<Move> = gone;
        for Move { name, to, .. } in gone {
            let seat = &mut self.seats[to];
            seat.names.insert(name.clone());
            if let State::Runs(process) | State::Stopped(process) = &mut seat.process {
                process.tell(&format!("register {name}"));
            }
        }
    }

    fn notice_ends(&mut self) {
        for (at, seat) in self.seats.iter_mut().enumerate() {
            if let State::Runs(process) = &mut seat.process
                && let Some(status) = process.running.ended()
            {
                panic!("the process of seat {at} ended by itself: {status}");
            }
        }
        for (at, host) in self.hosts.iter_mut().enumerate() {
            if let State::Runs(gateway) = &mut host.gateway
                && let Some(status) = gateway.ended()
            {
                panic!("the gateway of host {at} ended by itself: {status}");
            }
        }
    }

    fn later(&mut self, milliseconds: std::ops::Range<u64>, repair: Repair) {
        let after = Duration::from_millis(self.random.u64(milliseconds));
        self.repairs.push((Instant::now() + after, repair));
    }

    fn count(&mut self, what: &'static str) {
        *self.counts.entry(what).or_default() += 1;
    }

    fn fault(&mut self) {
        let (_, fault) = self.faults[self.random.usize(..self.faults.len())];
        fault(self);
    }

    fn any_host(&mut self) -> usize {
        self.random.usize(..HOSTS)
    }

    fn any_seat(&mut self) -> usize {
        self.random.usize(..self.seats.len())
    }

    fn kill_process(&mut self) {
        let seat = self.any_seat();
        let state = std::mem::replace(&mut self.seats[seat].process, State::Down);
        let what = match &state {
            State::Down => return,
            State::Runs(_) => "processes killed",
            State::Stopped(_) => "stopped processes killed",
            State::Ends(_) => "ending processes killed",
        };
        self.count(what);
        if let State::Runs(mut process) | State::Stopped(mut process) | State::Ends(mut process) =
            state
        {
            process.signal("-KILL");
            let life = process.life;
            drop(process);
            self.lives[life].killed = Some(now());
        }
        let continues =
            |repair: &Repair| matches!(repair, Repair::ContinueProcess(it) if *it == seat);
        self.repairs.retain(|(_, repair)| !continues(repair));
        self.later(1..700, Repair::StartProcess(seat));
    }

    /// Ends a process in order. [`work`](Self::work) schedules its restart.
    fn restart_process(&mut self) {
        let seat = self.any_seat();
        let state = std::mem::replace(&mut self.seats[seat].process, State::Down);
        self.seats[seat].process = match state {
            State::Runs(mut process) => {
                process.tell("quit");
                self.count("orderly restarts");
                State::Ends(process)
            }
            other => other,
        };
    }

    fn kill_gateway(&mut self) {
        let at = self.any_host();
        let state = std::mem::replace(&mut self.hosts[at].gateway, State::Down);
        if let State::Down = state {
            return;
        }
        let stopped = matches!(state, State::Stopped(_));
        drop(state);
        self.count(if stopped {
            "stopped gateways killed"
        } else {
            "gateways killed"
        });
        self.repairs
            .retain(|(_, repair)| !matches!(repair, Repair::ContinueGateway(it) if *it == at));
        self.later(50..1200, Repair::StartGateway(at));
    }

    fn stop_process(&mut self) {
        let seat = self.any_seat();
        let state = std::mem::replace(&mut self.seats[seat].process, State::Down);
        self.seats[seat].process = match state {
            State::Runs(mut process) => {
                process.signal("-STOP");
                self.count("processes stopped");
                self.later(30..2000, Repair::ContinueProcess(seat));
                State::Stopped(process)
            }
            other => other,
        };
    }

    fn stop_gateway(&mut self) {
        let at = self.any_host();
        let state = std::mem::replace(&mut self.hosts[at].gateway, State::Down);
        self.hosts[at].gateway = match state {
            State::Runs(gateway) => {
                gateway.signal("-STOP");
                self.count("gateways stopped");
                self.later(30..2000, Repair::ContinueGateway(at));
                State::Stopped(gateway)
            }
            other => other,
        };
    }

    fn cut(&mut self) {
        let at = self.any_host();
        if std::mem::replace(&mut self.hosts[at].disturbed, true) {
            return;
        }
        if self.random.bool() {
            self.network.host(at).unplug();
            self.count("hosts unplugged");
        } else {
            self.network.host(at).ip("link set eth0 down");
            self.count("links down");
        }
        self.later(50..3000, Repair::Network(at));
    }

    fn filter(&mut self) {
        let at = self.any_host();
        if std::mem::replace(&mut self.hosts[at].disturbed, true) {
            return;
        }
        let protocol = ["tcp", "udp"][self.random.usize(..2)];
        let host = self.network.host(at);
        let what = format!("iifname eth0 meta l4proto {protocol}");
        let rule = match self.random.u8(..4) {
            0 => format!("{what} drop"),
            1 if protocol == "tcp" => format!("{what} reject with tcp reset"),
            2 => format!("{what} numgen random mod 100 < 10 drop"),
            _ => format!("{what} numgen random mod 100 < 40 drop"),
        };
        filter(host, &rule);
        self.count("packet filters");
        self.later(50..3000, Repair::Network(at));
    }

    fn change_address(&mut self) {
        let at = self.any_host();
        let host = &mut self.hosts[at];
        if host.disturbed {
            return;
        }
        let all = numbers(at);
        let next = (host.address + self.random.usize(1..all.len())) % all.len();
        host.address = next;
        self.network.host(at).move_to(all[next]);
        self.count("address changes");
    }

    fn move_agent(&mut self) {
        let name = format!("mover{}", self.random.usize(..MOVERS));
        let to = self.random.usize(..self.seats.len());
        let mut seats = self.seats.iter_mut().enumerate();
        let Some((from, seat)) = seats.find(|(_, seat)| seat.names.contains(&name)) else {
            return;
        };
        if from == to {
            return;
        }
        if let State::Runs(process) = &mut seat.process {
            let (life, left_before) = (process.life, process.count_left(&name));
            process.tell(&format!("leave {name}"));
            seat.names.remove(&name);
            self.moves.push(Move {
                name,
                life,
                left_before,
                to,
            });
            self.count("moves");
        }
    }

    /// An agent sends many letters at once.
    fn burst(&mut self) {
        let seat = self.any_seat();
        if let State::Runs(process) = &mut self.seats[seat].process {
            process.tell("burst");
            self.count("bursts");
        }
    }

    fn repair(&mut self, repair: Repair) {
        match repair {
            Repair::StartGateway(at) => self.start_gateway(at),
            Repair::StartProcess(seat) => self.start_process(seat),
            Repair::ContinueGateway(at) => {
                let state = std::mem::replace(&mut self.hosts[at].gateway, State::Down);
                self.hosts[at].gateway = match state {
                    State::Stopped(gateway) => {
                        gateway.signal("-CONT");
                        State::Runs(gateway)
                    }
                    other => other,
                };
            }
            Repair::ContinueProcess(seat) => {
                let state = std::mem::replace(&mut self.seats[seat].process, State::Down);
                self.seats[seat].process = match state {
                    State::Stopped(mut process) => {
                        process.signal("-CONT");
                        State::Runs(process)
                    }
                    other => other,
                };
            }
            Repair::Network(at) => {
                self.hosts[at].disturbed = false;
                let host = self.network.host(at);
                host.plug();
                host.come_up(numbers(at)[self.hosts[at].address]);
                nft(host, "add table inet weather");
                nft(host, "delete table inet weather");
            }
        }
    }

    fn start_gateway(&mut self, at: usize) {
        let mut command = gateway(self.network.host(at), &self.hosts[at].settings);
        // A stopped process may delay the gateway, so a thread waits for it.
        self.hosts[at].starting = Some(std::thread::spawn(move || {
            let (gateway, ready) = ChildGuard::until_ready(&mut command);
            assert!(ready.starts_with('{'), "the gateway is not ready: {ready}");
            gateway
        }));
    }

    fn start_process(&mut self, at: usize) {
        let life = self.lives.len();
        let log = fipa_testbed::directory().join(format!("log{life}"));
        let seat = &self.seats[at];
        let part = Part {
            seed: self.random.u64(..),
            log: log.to_str().unwrap().to_owned(),
            names: self.names.clone(),
            settings: self.hosts[seat.host].settings.clone(),
        };
        let mut command = self
            .network
            .host(seat.host)
            .command(std::env::current_exe().unwrap());
        command
            .args([
                "--ignored",
                "--exact",
                "--nocapture",
                "a_process_of_its_own",
            ])
            .env(PART, part.to_text())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped());
        let mut running = ChildGuard::start(&mut command);
        let input = running.child().stdin.take().unwrap();
        let said = Arc::<Mutex<Vec<String>>>::default();
        let (output, lines) = (running.child().stdout.take().unwrap(), said.clone());
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                lines.lock().push(line);
            }
        });
        let mut process = Process {
            running,
            input,
            said,
            life,
        };
        for name in &seat.names {
            process.tell(&format!("register {name}"));
        }
        self.seats[at].process = State::Runs(process);
        self.lives.push(Life { log, killed: None });
    }
}

/// Returns the total time in which a process of the machine waited for a processor, in
/// microseconds.
fn waited_for_processors() -> u64 {
    let pressure = std::fs::read_to_string("/proc/pressure/cpu").unwrap_or_default();
    let total = pressure.split("total=").nth(1);
    let total = total.and_then(|it| it.split_whitespace().next());
    total.and_then(|it| it.parse().ok()).unwrap_or(0)
}

fn settings(network: &Network, at: usize, order: &[&str], mdns: bool) -> Vec<String> {
    let mut settings = vec![
        format!("domain=host{at}"),
        format!("mts.name=gateway{at}"),
        format!("mts.transports=shm,unix,{}", order.join(",")),
        format!("discovery.mdns={mdns}"),
        "access.deny={ \".*\" = [\".* performative=cancel\"] }".to_owned(),
    ];
    for kind in order {
        settings.push(format!("transport.{kind}.listen=*:{PORT}"));
    }
    settings.push(match order.contains(&"quic") {
        true => format!("security.keys={}", keys(at).dir().display()),
        false => "security.insecure=true".to_owned(),
    });
    if !mdns {
        let peers = (0..HOSTS).filter(|other| *other != at).map(|other| {
            let host = network.host(other);
            let all = numbers(other).map(|number| host.addresses_with(number));
            let ways = order.iter().flat_map(|kind| {
                // An entry has few locations.
                let all = all.iter().filter_map(|of_number| of_number.first());
                all.map(move |address| format!("\"{kind}://{address}:{PORT}\""))
            });
            format!("gateway{other} = [{}]", ways.collect::<Vec<_>>().join(", "))
        });
        let peers: Vec<String> = peers.collect();
        settings.push(format!("discovery.static={{ {} }}", peers.join(", ")));
    }
    settings
}
