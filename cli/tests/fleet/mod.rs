//! Three hosts in network namespaces, each with a gateway process and an agent. The agents send
//! letters to each other, and every letter is checked.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stderr, reason = "the test prints the outcomes")]

use std::collections::{BTreeMap, HashMap};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::task::Poll;
use std::time::{Duration, Instant};

use fipa::config::Sources;
use fipa::{
    Agent, AgentId, Config, Deliveries, Domain, FailureReason, Kind, Outcome, Performative,
};
use fipa_testbed::{ChildGuard, Family, Host, Network};
use parking_lot::Mutex;
use tokio::runtime::Runtime;

use crate::hosts::{self, PORT, filter, keys, make_keys, nft};

/// Timeout for hanging tests. No step is expected to take this long.
const WATCHDOG: Duration = Duration::from_secs(90);
/// Letters in flight from one sender to one receiver.
const IN_FLIGHT: usize = 8;
/// Pause between batches, so that the traffic lasts longer than the faults.
const PAUSE: Duration = Duration::from_millis(8);
/// Consecutive deliveries that prove that traffic has resumed.
const IN_A_ROW: u64 = 40;

/// Settings of a fleet.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    /// The addresses of the hosts. With those of both families, the hosts use the IPv4 addresses.
    pub(crate) family: Family,
    /// `mts.transports` of every process.
    pub(crate) transports: &'static [&'static str],
    /// `mts.deadline` of every letter.
    pub(crate) deadline: Duration,
    /// A host whose address the others do not have, so that it dials them.
    pub(crate) dials: Option<usize>,
    /// A host that has no addresses of the others, so that they dial it at one of [`ADDRESSES`].
    pub(crate) is_dialed: Option<usize>,
}

impl Default for Plan {
    fn default() -> Self {
        Self {
            family: Family::Both,
            transports: &["shm", "unix", "tcp"],
            deadline: Duration::from_secs(3),
            dials: None,
            is_dialed: None,
        }
    }
}

/// The usual and the temporary address of the second host.
pub(crate) const ADDRESSES: [&str; 2] = ["10.99.0.2", "10.99.0.52"];

impl Plan {
    /// The static addresses of a host in the configuration of the others.
    fn addresses(&self, network: &Network, at: usize) -> Vec<String> {
        if self.is_dialed == Some(at) {
            return ADDRESSES.map(str::to_owned).to_vec();
        }
        match self.family {
            Family::Both => vec![network.host(at).ipv4().to_string()],
            _ => network.host(at).addresses(),
        }
    }

    /// The addresses on which the gateways listen.
    fn listen(&self) -> &'static str {
        match self.family {
            Family::Both => "0.0.0.0",
            _ => "*",
        }
    }

    /// Whether host `at` has the address of host `other`.
    fn has_address(&self, at: usize, other: usize) -> bool {
        other != at && self.dials != Some(other) && self.is_dialed != Some(at)
    }

    /// Whether the hosts need keys: QUIC requires them.
    fn has_keys(&self) -> bool {
        self.transports.contains(&"quic")
    }
}

/// The hosts with their gateways and agents.
pub(crate) struct Fleet {
    pub(crate) network: Network,
    parties: Vec<Party>,
    accounts: Arc<Accounts>,
}

/// A gateway and an agent on one host.
struct Party {
    settings: Vec<String>,
    gateway: Mutex<Option<ChildGuard>>,
    runtime: Runtime,
    agent: Arc<Agent>,
}

/// The accounts of all letters.
#[derive(Default)]
struct Accounts {
    /// By pair of hosts.
    pairs: Mutex<BTreeMap<(usize, usize), Account>>,
    stop: AtomicBool,
}

#[derive(Default)]
struct Account {
    sent: u64,
    outcomes: HashMap<u64, Outcome>,
    taken: Vec<u64>,
    /// Consecutive deliveries since the last reset.
    in_a_row: u64,
    failed_since: u64,
}

impl Fleet {
    /// Three hosts whose gateways know each other by address, and whose agents know each other.
    pub(crate) fn new(plan: &Plan) -> Self {
        // Files of killed processes vanish with the test.
        if plan.has_keys() {
            make_keys(3);
        }
        let network = Network::of(plan.family, 3);
        let accounts = Arc::new(Accounts::default());
        let parties = (0..3).map(|at| Party::new(&network, at, plan)).collect();
        let fleet = Self {
            network,
            parties,
            accounts,
        };
        fleet.wait("all agents know each other", || {
            let pairs = (0..3).flat_map(|from| (0..3).map(move |to| (from, to)));
            pairs.filter(|(from, to)| from != to).all(|(from, to)| {
                let directory = fleet.parties[from].agent.domain().directory();
                directory.lookup(&name(to)).is_some()
            })
        });
        fleet
    }

    /// Sends letters between all agents while `faults` runs, and then until traffic has resumed. Sends
    /// at least `letters` in total and checks every one.
    pub(crate) fn through(&self, letters: u64, faults: impl FnOnce(&Self)) {
        *self.accounts.pairs.lock() = pairs().map(|pair| (pair, Account::default())).collect();
        self.accounts.stop.store(false, Ordering::Release);
        let readers: Vec<_> = (0..3).map(|at| self.read(at)).collect();
        let writers: Vec<_> = pairs().map(|pair| self.write(pair)).collect();
        faults(self);
        for account in self.accounts.pairs.lock().values_mut() {
            (account.in_a_row, account.failed_since) = (0, 0);
        }
        self.wait("traffic resumes and enough letters are sent", || {
            let all = self.accounts.pairs.lock();
            let resumed = all.values().all(|account| account.in_a_row >= IN_A_ROW);
            resumed && all.values().map(|account| account.sent).sum::<u64>() >= letters
        });
        self.accounts.stop.store(true, Ordering::Release);
        for (at, writer) in writers {
            self.finish(at, writer);
        }
        // A delivered letter is at least in the queue of its receiver.
        self.wait("delivered letters are received", || {
            let all = self.accounts.pairs.lock();
            all.values().all(|account| {
                let delivered = account.outcomes.iter();
                let mut delivered =
                    delivered.filter(|(_, it)| matches!(it, Outcome::Delivered { .. }));
                delivered.all(|(number, _)| account.taken.contains(number))
            })
        });
        for (at, reader) in readers {
            reader.abort();
            let _ = self.parties[at].runtime.block_on(reader);
        }
        self.check();
    }

    fn finish(&self, at: usize, writer: tokio::task::JoinHandle<()>) {
        let ended = async { tokio::time::timeout(WATCHDOG, writer).await };
        let ended = self.parties[at].runtime.block_on(ended);
        ended.expect("letters without an outcome").unwrap();
    }

    fn read(&self, at: usize) -> (usize, tokio::task::JoinHandle<()>) {
        let (agent, accounts) = (Arc::clone(&self.parties[at].agent), self.accounts.clone());
        let task = async move {
            loop {
                let message = agent.receive().await.unwrap().into_message();
                // A failed letter causes a failure message, too.
                if *message.performative() != Performative::Inform {
                    continue;
                }
                let from = number_of(message.sender().unwrap().name());
                let text = std::str::from_utf8(message.content().unwrap()).unwrap();
                let number = text.parse().unwrap();
                let mut pairs = accounts.pairs.lock();
                pairs.get_mut(&(from, at)).unwrap().taken.push(number);
            }
        };
        (at, self.parties[at].runtime.spawn(task))
    }

    fn write(&self, (from, to): (usize, usize)) -> (usize, tokio::task::JoinHandle<()>) {
        // Letters of an earlier run may still be delivered, so numbers are never reused.
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let (agent, accounts) = (Arc::clone(&self.parties[from].agent), self.accounts.clone());
        let task = async move {
            while !accounts.stop.load(Ordering::Acquire) {
                let numbers: Vec<u64> = (0..IN_FLIGHT)
                    .map(|_| NEXT.fetch_add(1, Ordering::Relaxed))
                    .collect();
                accounts.of((from, to)).sent += IN_FLIGHT as u64;
                let sending = numbers.iter().map(|number| send(&agent, to, *number));
                let outcomes = all(sending).await;
                for (number, deliveries) in numbers.into_iter().zip(outcomes) {
                    accounts.of((from, to)).note(number, deliveries);
                }
                tokio::time::sleep(PAUSE).await;
            }
        };
        (from, self.parties[from].runtime.spawn(task))
    }

    /// Checks outcome, uniqueness and order of every letter of the last run.
    fn check(&self) {
        for ((from, to), account) in self.accounts.pairs.lock().iter() {
            let pair = format!("{} to {}", name(*from), name(*to));
            let count = account.outcomes.len() as u64;
            assert_eq!(count, account.sent, "{pair}: letters without an outcome");
            assert!(
                account.taken.is_sorted_by(|a, b| a < b),
                "{pair}: duplicate or out of order: {:?}",
                account.taken.windows(2).find(|two| two[0] >= two[1])
            );
            for (number, outcome) in &account.outcomes {
                let taken = account.taken.binary_search(number).is_ok();
                match outcome {
                    Outcome::Delivered { .. } => assert!(taken, "{pair}, {number}: lost"),
                    Outcome::Failed {
                        reason: FailureReason::Unconfirmed,
                        ..
                    } => {}
                    other => assert!(!taken, "{pair}, {number} was taken, but {other}"),
                }
            }
        }
        let accounts = self.accounts.pairs.lock();
        for ((from, to), account) in accounts.iter() {
            let mut by_reason: BTreeMap<String, u64> = BTreeMap::new();
            for outcome in account.outcomes.values() {
                let key = match outcome {
                    Outcome::Failed { reason, .. } => format!("failed: {reason}"),
                    other => format!("via {}", other.via().unwrap()),
                };
                *by_reason.entry(key).or_default() += 1;
            }
            eprintln!("  {} to {}: {by_reason:?}", name(*from), name(*to));
        }
    }

    /// Number of failed letters of a pair.
    pub(crate) fn failed(&self, from: usize, to: usize) -> usize {
        let account = self.accounts.of((from, to));
        let outcomes = account.outcomes.values();
        outcomes.filter(|outcome| !outcome.is_success()).count()
    }

    /// Waits until [`IN_A_ROW`] further letters of every pair within `hosts` were delivered.
    pub(crate) fn until_delivered(&self, hosts: &[usize]) {
        for account in self.accounts.pairs.lock().values_mut() {
            account.in_a_row = 0;
        }
        self.wait("letters are delivered", || {
            let all = self.accounts.pairs.lock();
            let mut among = all
                .iter()
                .filter(|((from, to), _)| hosts.contains(from) && hosts.contains(to));
            among.all(|(_, account)| account.in_a_row >= IN_A_ROW)
        });
    }

    /// Waits until further letters of a pair fail.
    pub(crate) fn until_failing(&self, from: usize, to: usize) {
        self.accounts.of((from, to)).failed_since = 0;
        self.wait("letters fail", || {
            self.accounts.of((from, to)).failed_since >= IN_FLIGHT as u64
        });
    }

    /// Kills a gateway, as a crash does: peers get no notification.
    pub(crate) fn kill_gateway(&self, at: usize) {
        drop(self.parties[at].gateway.lock().take());
    }

    pub(crate) fn start_gateway(&self, at: usize) {
        let party = &self.parties[at];
        let gateway = start_gateway(self.network.host(at), &party.settings);
        *party.gateway.lock() = Some(gateway);
    }

    /// Drops this percentage of the packets of a protocol (`tcp`, `udp`) from other hosts on every host.
    pub(crate) fn lose(&self, protocol: &str, percent: u32) {
        for host in self.network.hosts() {
            let packets = format!("meta l4proto {protocol} numgen random mod 100 < {percent}");
            filter(host, &format!("iifname eth0 {packets} drop"));
        }
    }

    /// Silently drops all packets of a protocol (`tcp`, `udp`) between hosts.
    pub(crate) fn block(&self, protocol: &str) {
        for host in self.network.hosts() {
            filter(host, &format!("iifname eth0 meta l4proto {protocol} drop"));
        }
    }

    /// Whether letters of every pair were delivered via this transport.
    pub(crate) fn delivered_via(&self, kind: Kind) -> bool {
        let all = self.accounts.pairs.lock();
        let delivered =
            |account: &Account| account.outcomes.values().any(|it| it.via() == Some(kind));
        all.values().all(delivered)
    }

    /// Undoes [`lose`](Self::lose) and [`block`](Self::block).
    pub(crate) fn restore(&self) {
        for host in self.network.hosts() {
            nft(host, "flush ruleset");
        }
    }

    fn wait(&self, what: &str, condition: impl Fn() -> bool) {
        let started = Instant::now();
        while !condition() {
            assert!(
                started.elapsed() < WATCHDOG,
                "timed out: {what}{}",
                self.summary()
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn summary(&self) -> String {
        let mut text = String::new();
        for ((from, to), account) in self.accounts.pairs.lock().iter() {
            let last = account.outcomes.keys().max();
            let last = last.map(|last| account.outcomes[last].to_string());
            text.push_str(&format!(
                "\n  {} to {}: {} sent, {} in a row, last {}",
                name(*from),
                name(*to),
                account.sent,
                account.in_a_row,
                last.unwrap_or_default()
            ));
        }
        text
    }
}

impl Accounts {
    fn of(&self, pair: (usize, usize)) -> parking_lot::MappedMutexGuard<'_, Account> {
        parking_lot::MutexGuard::map(self.pairs.lock(), |pairs| pairs.get_mut(&pair).unwrap())
    }
}

impl Account {
    fn note(&mut self, number: u64, deliveries: Deliveries) {
        let [delivery] = <[_; 1]>::try_from(deliveries.0).unwrap();
        if delivery.outcome.is_success() {
            self.in_a_row += 1;
        } else {
            self.in_a_row = 0;
            self.failed_since += 1;
        }
        let before = self.outcomes.insert(number, delivery.outcome);
        assert_eq!(before, None, "two outcomes of letter {number}");
    }
}

/// Whether a transport connects hosts.
fn is_between_hosts(kind: &str) -> bool {
    !["shm", "unix"].contains(&kind)
}

impl Party {
    fn new(network: &Network, at: usize, plan: &Plan) -> Self {
        let host = network.host(at);
        let known = (0..3).filter(|other| plan.has_address(at, *other));
        let peers = known.map(|other| {
            let addresses = plan.addresses(network, other);
            let kinds = plan.transports.iter().filter(|kind| is_between_hosts(kind));
            let locations: Vec<String> = kinds
                .flat_map(|kind| addresses.iter().map(move |it| (kind, it)))
                .map(|(kind, address)| format!("\"{kind}://{address}:{PORT}\""))
                .collect();
            format!("gateway{other} = [{}]", locations.join(", "))
        });
        let peers: Vec<String> = peers.collect();
        let transports = plan.transports.join(",");
        let mut settings = vec![
            format!("domain=host{at}"),
            "discovery.mdns=false".to_owned(),
            match plan.has_keys() {
                true => format!("security.keys={}", keys(at).dir().display()),
                false => "security.insecure=true".to_owned(),
            },
            format!("mts.name=gateway{at}"),
            format!("mts.transports={transports}"),
            format!("mts.deadline={}ms", plan.deadline.as_millis()),
            format!("discovery.static={{ {} }}", peers.join(", ")),
        ];
        for kind in plan.transports.iter().filter(|kind| is_between_hosts(kind)) {
            settings.push(format!(
                "transport.{kind}.listen=[\"{}:{PORT}\"]",
                plan.listen()
            ));
        }
        let gateway = start_gateway(host, &settings);
        let config = Config::load(&Sources {
            set: settings.clone(),
            ..Sources::default()
        })
        .unwrap();
        let (runtime, agent) = host.enter(|| {
            let mut builder = tokio::runtime::Builder::new_multi_thread();
            let runtime = builder.worker_threads(2).enable_all().build().unwrap();
            let domain = runtime.block_on(Domain::open(&config)).unwrap();
            let agent = runtime
                .block_on(async { domain.register(&name(at)).await })
                .unwrap();
            (runtime, Arc::new(agent))
        });
        Self {
            settings,
            gateway: Mutex::new(Some(gateway)),
            runtime,
            agent,
        }
    }
}

fn start_gateway(host: &Host, settings: &[String]) -> ChildGuard {
    let (gateway, ready) = ChildGuard::until_ready(&mut hosts::gateway(host, settings));
    assert!(ready.starts_with('{'), "the gateway is not ready: {ready}");
    gateway
}

async fn send(agent: &Agent, to: usize, number: u64) -> Deliveries {
    let message = agent
        .message(Performative::Inform)
        .receiver(AgentId::new(&*name(to)).unwrap())
        .content(number.to_string())
        .build()
        .unwrap();
    agent.send(message).await.unwrap()
}

/// Polls all futures in order, so that their letters are sent in this order.
async fn all<F: Future>(futures: impl Iterator<Item = F>) -> Vec<F::Output> {
    let mut pending: Vec<Pin<Box<F>>> = futures.map(Box::pin).collect();
    let mut done: Vec<Option<F::Output>> = pending.iter().map(|_| None).collect();
    std::future::poll_fn(move |context| {
        for (future, done) in pending.iter_mut().zip(&mut done) {
            if done.is_none()
                && let Poll::Ready(output) = future.as_mut().poll(context)
            {
                *done = Some(output);
            }
        }
        if done.iter().all(Option::is_some) {
            return Poll::Ready(done.iter_mut().filter_map(Option::take).collect());
        }
        Poll::Pending
    })
    .await
}

fn pairs() -> impl Iterator<Item = (usize, usize)> {
    let all = (0..3).flat_map(|from| (0..3).map(move |to| (from, to)));
    all.filter(|(from, to)| from != to)
}

fn name(at: usize) -> String {
    format!("agent{at}")
}

fn number_of(name: &str) -> usize {
    name.strip_prefix("agent").unwrap().parse().unwrap()
}
