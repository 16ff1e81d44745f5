//! Three hosts in network namespaces, each with a gateway process and an agent, and letters
//! between all of them, every one of which is accounted for.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]
#![allow(
    clippy::print_stderr,
    reason = "what the letters came to is worth knowing"
)]

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
use fipa_testbed::{Host, Network, Running};
use parking_lot::Mutex;
use tokio::runtime::Runtime;

use crate::hosts::{self, PORT, filter, keys, make_keys, nft};

/// Ends what hangs. Nothing is expected to take this long.
const WATCHDOG: Duration = Duration::from_secs(90);
/// Letters of one sender to one receiver that are under way at a time.
const AT_ONCE: usize = 8;
/// Pause between them: so that traffic lasts longer than what happens to it.
const PAUSE: Duration = Duration::from_millis(8);
/// Letters delivered in a row that count as traffic that goes on.
const IN_A_ROW: u64 = 40;

/// What all parties have in common.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    /// `mts.transports` of every process.
    pub(crate) transports: &'static [&'static str],
    /// `mts.deadline` of every letter.
    pub(crate) deadline: Duration,
    /// A host of which the others are not told where it is, so that it dials them.
    pub(crate) dials: Option<usize>,
    /// A host that is not told where the others are, so that they dial it, at one of [`ADDRESSES`].
    pub(crate) is_dialled: Option<usize>,
}

impl Default for Plan {
    fn default() -> Self {
        Self {
            transports: &["shm", "unix", "tcp"],
            deadline: Duration::from_secs(3),
            dials: None,
            is_dialled: None,
        }
    }
}

/// The second host's address, and the other one that it has at times.
pub(crate) const ADDRESSES: [&str; 2] = ["10.99.0.2", "10.99.0.52"];

impl Plan {
    /// Where others look for a host.
    fn addresses(&self, network: &Network, at: usize) -> Vec<String> {
        if self.is_dialled == Some(at) {
            return ADDRESSES.map(str::to_owned).to_vec();
        }
        vec![network.host(at).ipv4().to_string()]
    }

    /// Whether one host is told where another is.
    fn tells(&self, at: usize, other: usize) -> bool {
        other != at && self.dials != Some(other) && self.is_dialled != Some(at)
    }

    /// QUIC is not spoken without.
    fn has_keys(&self) -> bool {
        self.transports.contains(&"quic")
    }
}

/// The hosts and who is on them.
pub(crate) struct Fleet {
    pub(crate) network: Network,
    parties: Vec<Party>,
    accounts: Arc<Accounts>,
}

/// A gateway and an agent on one host.
struct Party {
    settings: Vec<String>,
    gateway: Mutex<Option<Running>>,
    runtime: Runtime,
    agent: Arc<Agent>,
}

/// What became of every letter.
#[derive(Default)]
struct Accounts {
    /// Of each pair of hosts.
    pairs: Mutex<BTreeMap<(usize, usize), Account>>,
    stop: AtomicBool,
}

#[derive(Default)]
struct Account {
    sent: u64,
    outcomes: HashMap<u64, Outcome>,
    taken: Vec<u64>,
    /// Delivered since somebody last looked, in a row.
    in_a_row: u64,
    failed_since: u64,
}

impl Fleet {
    /// Three hosts whose gateways know each other by address, and whose agents know each other.
    pub(crate) fn new(plan: &Plan) -> Self {
        // What killed processes leave behind goes with the test.
        fipa_testbed::run("mount -t tmpfs tmpfs /dev/shm");
        if plan.has_keys() {
            make_keys(3);
        }
        let network = Network::new(3);
        let accounts = Arc::new(Accounts::default());
        let parties = (0..3).map(|at| Party::new(&network, at, plan)).collect();
        let fleet = Self {
            network,
            parties,
            accounts,
        };
        fleet.wait("everybody knows everybody", || {
            let pairs = (0..3).flat_map(|from| (0..3).map(move |to| (from, to)));
            pairs.filter(|(from, to)| from != to).all(|(from, to)| {
                let directory = fleet.parties[from].agent.domain().directory();
                directory.lookup(&name(to)).is_some()
            })
        });
        fleet
    }

    /// Sends letters from everybody to everybody while `weather` happens, then until they arrive
    /// again, and checks every one. At least `letters` in all.
    pub(crate) fn through(&self, letters: u64, weather: impl FnOnce(&Self)) {
        self.through_pairs(letters, |_, _| true, weather);
    }

    /// The same, where only some pairs are expected to get along in the end.
    pub(crate) fn through_pairs(
        &self,
        letters: u64,
        gets_along: impl Fn(usize, usize) -> bool,
        weather: impl FnOnce(&Self),
    ) {
        *self.accounts.pairs.lock() = pairs().map(|pair| (pair, Account::default())).collect();
        self.accounts.stop.store(false, Ordering::Release);
        let readers: Vec<_> = (0..3).map(|at| self.read(at)).collect();
        let writers: Vec<_> = pairs().map(|pair| self.write(pair)).collect();
        weather(self);
        for account in self.accounts.pairs.lock().values_mut() {
            (account.in_a_row, account.failed_since) = (0, 0);
        }
        self.wait("letters arrive again", || {
            let all = self.accounts.pairs.lock();
            let mut along = all.iter().filter(|((from, to), _)| gets_along(*from, *to));
            let resumed = along.all(|(_, account)| account.in_a_row >= IN_A_ROW);
            resumed && all.values().map(|account| account.sent).sum::<u64>() >= letters
        });
        self.accounts.stop.store(true, Ordering::Release);
        for (at, writer) in writers {
            self.finish(at, writer);
        }
        // What was delivered lies in a queue at least.
        self.wait("what was delivered is taken", || {
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
                let message = agent.receive().await.unwrap().message;
                // What failed is told by a failure message as well.
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
        // Letters of earlier weather may still come: numbers go on.
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let (agent, accounts) = (Arc::clone(&self.parties[from].agent), self.accounts.clone());
        let task = async move {
            while !accounts.stop.load(Ordering::Acquire) {
                let numbers: Vec<u64> = (0..AT_ONCE)
                    .map(|_| NEXT.fetch_add(1, Ordering::Relaxed))
                    .collect();
                accounts.of((from, to)).sent += AT_ONCE as u64;
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

    /// The promises, for every letter of the last weather.
    fn check(&self) {
        for ((from, to), account) in self.accounts.pairs.lock().iter() {
            let pair = format!("{} to {}", name(*from), name(*to));
            let count = account.outcomes.len() as u64;
            assert_eq!(count, account.sent, "{pair}: letters without an outcome");
            assert!(
                account.taken.is_sorted_by(|a, b| a < b),
                "{pair}: twice, or out of order: {:?}",
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
        let told = self.accounts.pairs.lock();
        for ((from, to), account) in told.iter() {
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

    /// How many letters of a pair have failed.
    pub(crate) fn failed(&self, from: usize, to: usize) -> usize {
        let account = self.accounts.of((from, to));
        let outcomes = account.outcomes.values();
        outcomes.filter(|outcome| !outcome.is_success()).count()
    }

    /// Waits until so many letters of every pair of which both are among `hosts` were delivered
    /// from now on.
    pub(crate) fn until_delivered(&self, hosts: &[usize]) {
        for account in self.accounts.pairs.lock().values_mut() {
            account.in_a_row = 0;
        }
        self.wait("letters arrive", || {
            let all = self.accounts.pairs.lock();
            let mut among = all
                .iter()
                .filter(|((from, to), _)| hosts.contains(from) && hosts.contains(to));
            among.all(|(_, account)| account.in_a_row >= IN_A_ROW)
        });
    }

    /// Waits until letters of a pair fail from now on.
    pub(crate) fn until_failing(&self, from: usize, to: usize) {
        self.accounts.of((from, to)).failed_since = 0;
        self.wait("letters fail", || {
            self.accounts.of((from, to)).failed_since >= AT_ONCE as u64
        });
    }

    /// Ends a gateway as a crash does, and says nothing to anybody.
    pub(crate) fn kill_gateway(&self, at: usize) {
        drop(self.parties[at].gateway.lock().take());
    }

    pub(crate) fn start_gateway(&self, at: usize) {
        let party = &self.parties[at];
        let gateway = start_gateway(self.network.host(at), &party.settings);
        *party.gateway.lock() = Some(gateway);
    }

    /// Lets so many of a hundred packets of a protocol (`tcp`, `udp`) that come from other hosts
    /// be lost on every host.
    pub(crate) fn lose(&self, protocol: &str, of_a_hundred: u32) {
        for host in self.network.hosts() {
            let what = format!("meta l4proto {protocol} numgen random mod 100 < {of_a_hundred}");
            filter(host, &format!("iifname eth0 {what} drop"));
        }
    }

    /// Lets nothing of a protocol (`tcp`, `udp`) through between hosts, and says nothing.
    pub(crate) fn pull(&self, protocol: &str) {
        for host in self.network.hosts() {
            filter(host, &format!("iifname eth0 meta l4proto {protocol} drop"));
        }
    }

    /// Whether letters of every pair were delivered by this transport.
    pub(crate) fn went_by(&self, kind: Kind) -> bool {
        let all = self.accounts.pairs.lock();
        let went = |account: &Account| account.outcomes.values().any(|it| it.via() == Some(kind));
        all.values().all(went)
    }

    /// Takes back what [`lose`](Self::lose) and [`pull`](Self::pull) did.
    pub(crate) fn lose_nothing(&self) {
        for host in self.network.hosts() {
            nft(host, "flush ruleset");
        }
    }

    fn wait(&self, what: &str, condition: impl Fn() -> bool) {
        let started = Instant::now();
        while !condition() {
            assert!(
                started.elapsed() < WATCHDOG,
                "never: {what}{}",
                self.stand()
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn stand(&self) -> String {
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

/// Whether a transport leads to other hosts.
fn is_beyond(kind: &str) -> bool {
    !["shm", "unix"].contains(&kind)
}

impl Party {
    fn new(network: &Network, at: usize, plan: &Plan) -> Self {
        let host = network.host(at);
        let known = (0..3).filter(|other| plan.tells(at, *other));
        let peers = known.map(|other| {
            let addresses = plan.addresses(network, other);
            let kinds = plan.transports.iter().filter(|kind| is_beyond(kind));
            let ways: Vec<String> = kinds
                .flat_map(|kind| addresses.iter().map(move |it| (kind, it)))
                .map(|(kind, address)| format!("\"{kind}://{address}:{PORT}\""))
                .collect();
            format!("gateway{other} = [{}]", ways.join(", "))
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
        for kind in plan.transports.iter().filter(|kind| is_beyond(kind)) {
            settings.push(format!("transport.{kind}.listen=[\"0.0.0.0:{PORT}\"]"));
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
                .block_on(async { domain.register(&name(at)) })
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

fn start_gateway(host: &Host, settings: &[String]) -> Running {
    let (gateway, ready) = Running::until_ready(&mut hosts::gateway(host, settings));
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

/// Polls all of them in their order, so that letters leave in it.
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
