//! A protocol fuzzer for running gateways, over every transport on which they listen. Meanwhile, an
//! honest pair of agents exchanges letters through each gateway. The gateways must not crash, stall
//! or leak.
//!
//! There are two gateways, one without and one with keys. `FIPA_FUZZ_SECONDS` is the duration of the
//! attack on each, in seconds (default: 4). `FIPA_FUZZ_SEED` repeats the random decisions of a run, but
//! not the timing.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stdout, reason = "the test prints its figures")]

mod fuzzing;
mod load;

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use fastrand::Rng;
use fipa::Incarnation;
use fipa::admin::keys::Keys;
use fipa_testbed::until;
use fuzzing::trusted::{client, quic};
use fuzzing::{Writer, datagram, stream};
use load::{Gateway, Pair, Usage, percentiles};
use tempfile::TempDir;

/// Concurrent conversations.
const AT_ONCE: usize = 12;

/// Time for which an attack may take longer on a busy machine.
const LONGER: Duration = Duration::from_secs(60);

/// Allowed increase of open descriptors: connections that the gateway opens and closes by itself.
const DESCRIPTORS: usize = 8;

/// Allowed increase of memory in addition to a quarter of the memory before, in KiB. The allocator
/// keeps memory of the largest conversations. A gateway has about 36 MiB and grows by 1 MiB in
/// three seconds and by 5 MiB in ten minutes with 220,000 conversations. So a leak of 64 KiB per
/// conversation is detected within a minute, and a leak of a few hundred bytes within ten minutes.
const RESIDENT: u64 = 12 << 10;

/// Attacks on a gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Attack {
    /// Frames over TCP.
    Frames,
    /// A letter of a legacy peer.
    LegacyPeer,
    /// Requests of a platform over HTTP.
    Http,
    /// Datagrams that may begin a UDP connection.
    Datagrams,
    /// A UDP connection.
    Udp,
    /// A UDT connection of a legacy peer.
    Udt,
    /// The start of a TLS handshake.
    Handshake,
    /// Frames over TLS, as a trusted peer.
    Tls,
    /// Datagrams that may begin a QUIC connection.
    QuicDatagrams,
    /// A QUIC connection as a trusted peer.
    Quic,
    /// A QUIC connection as a trusted peer, whose datagrams are corrupted.
    CorruptQuic,
}

use Attack::*;
const CLEAR: [Attack; 6] = [Frames, LegacyPeer, Http, Datagrams, Udp, Udt];
const SECURED: [Attack; 8] = [
    Frames,
    LegacyPeer,
    Http,
    Handshake,
    Tls,
    QuicDatagrams,
    Quic,
    CorruptQuic,
];

/// Counters of one attack.
#[derive(Debug, Default)]
struct Tally {
    conversations: AtomicU64,
    /// Conversations that the gateway accepted.
    accepted: AtomicU64,
    bytes: AtomicU64,
}

/// Two gateways, one of which is attacked.
struct Setup {
    pair: Pair,
    target: Arc<Target>,
    /// Removed after all processes have ended.
    _directory: TempDir,
}

/// The attacked gateway, and the attacks.
struct Target {
    attacks: &'static [Attack],
    tcp: SocketAddr,
    datagrams: SocketAddr,
    http: SocketAddr,
    /// Without keys only: peers over UDT prove nothing.
    udt: Option<SocketAddr>,
    tls: Option<Arc<rustls::ClientConfig>>,
    quic: Option<quinn::ClientConfig>,
    receivers: Vec<String>,
    /// Registrations of real agents and gateways, by name.
    known: Vec<(String, Incarnation)>,
    /// Registrations that the attacker claims.
    claimed: Vec<Incarnation>,
    /// The first bytes of a valid handshake, over TCP and in a datagram.
    handshakes: [Vec<u8>; 2],
}

impl Setup {
    fn new(secured: bool) -> Self {
        let directory = tempfile::Builder::new()
            .prefix("fuzzer-")
            .tempdir()
            .unwrap();
        let pair = Pair::new(directory.path(), secured, "fuzzed");
        let tls = secured.then(|| {
            let rogue = load::keys(directory.path().join("rogue"), "rogue");
            load::befriend(&Keys::at(directory.path().join("target")), &rogue);
            client(&rogue, "rogue")
        });
        let quic = tls.as_ref().map(quic);
        let handshakes = |tls, quic| {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build();
            let packet = runtime.unwrap().block_on(datagram::initial(quic));
            [stream::client_hello(tls), packet]
        };
        let known = pair.registrations();
        // A gateway without keys cannot disprove a claim to be the other host, so that claim is
        // left out.
        let claimed = known
            .iter()
            .filter(|(name, _)| secured || name == "arm" || name == "target");
        let target = Target {
            claimed: claimed.map(|(_, incarnation)| *incarnation).collect(),
            known,
            attacks: if secured { &SECURED } else { &CLEAR },
            tcp: pair.gateway.at("tcp"),
            http: pair.gateway.at("http"),
            udt: (!secured).then(|| pair.gateway.at("udt")),
            datagrams: pair.gateway.at(if secured { "quic" } else { "udp" }),
            handshakes: match (&tls, &quic) {
                (Some(tls), Some(quic)) => handshakes(tls, quic),
                _ => Default::default(),
            },
            tls,
            quic,
            receivers: ["arm", "target", "rover", "unknown", "ar[lm]"]
                .map(str::to_owned)
                .into(),
        };
        Self {
            pair,
            target: Arc::new(target),
            _directory: directory,
        }
    }

    /// Attacks the gateway for this number of seconds, and on a busy machine until it has accepted a
    /// conversation of each attack. Returns the counters of each attack.
    fn attack(&self, seconds: u64, seed: u64) -> Vec<Tally> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let tallies: Arc<Vec<Tally>> = Arc::new(
            self.target
                .attacks
                .iter()
                .map(|_| Tally::default())
                .collect(),
        );
        let until = Instant::now() + Duration::from_secs(seconds);
        let at_most = until + LONGER;
        let goes_on = move |tallies: &[Tally]| {
            let now = Instant::now();
            let is_missing = |it: &Tally| it.accepted.load(Ordering::Relaxed) == 0;
            now < until || (now < at_most && tallies.iter().any(is_missing))
        };
        let next = Arc::new(AtomicU64::new(0));
        let attackers = (0..AT_ONCE).map(|_| {
            let (target, tallies, next) = (self.target.clone(), tallies.clone(), next.clone());
            runtime.spawn(async move {
                while goes_on(&tallies) {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    target.converse(seed.wrapping_add(number), &tallies).await;
                }
            })
        });
        for one in attackers.collect::<Vec<_>>() {
            runtime.block_on(one).unwrap();
        }
        runtime.shutdown_timeout(Duration::from_secs(5));
        Arc::into_inner(tallies).unwrap()
    }
}

impl Target {
    /// Runs the conversation of this seed.
    async fn converse(&self, seed: u64, tallies: &[Tally]) {
        let mut random = Rng::with_seed(seed);
        let at = random.usize(..self.attacks.len());
        let attack = self.attacks[at];
        let mut choices = random.fork();
        let mut writer = Writer {
            random: &mut random,
            name: "rogue",
            receivers: &self.receivers,
            known: &self.known,
            claimed: &self.claimed,
        };
        let bytes = match attack {
            Frames => {
                let script = writer.frames();
                Some(stream::plain(self.tcp, script).await)
            }
            LegacyPeer => {
                let script = writer.legacy_peer();
                Some(stream::plain(self.tcp, script).await)
            }
            Http => {
                let script = writer.requests();
                Some(stream::plain(self.http, script).await)
            }
            Datagrams | QuicDatagrams => {
                let pieces = match attack {
                    QuicDatagrams => self.handshakes[1].clone(),
                    _ => writer.parcel(),
                };
                let script = writer.recorded(&vec![pieces; 8]);
                Some(datagram::raw(self.datagrams, script).await)
            }
            Udp => datagram::udp(self.datagrams, &mut writer).await,
            Udt => datagram::udt(self.udt.unwrap(), &mut writer).await,
            Handshake => {
                let script = writer.recorded(&self.handshakes[..1]);
                Some(stream::plain(self.tcp, script).await)
            }
            Tls => {
                let script = writer.frames();
                stream::secured(self.tcp, self.tls.clone().unwrap(), script).await
            }
            Quic | CorruptQuic => {
                let script = writer.frames();
                let (config, corrupt) = (self.quic.clone().unwrap(), attack == CorruptQuic);
                datagram::quic(self.datagrams, config, script, &mut choices, corrupt).await
            }
        };
        let tally = &tallies[at];
        tally.conversations.fetch_add(1, Ordering::Relaxed);
        if let Some(bytes) = bytes {
            tally.accepted.fetch_add(1, Ordering::Relaxed);
            tally.bytes.fetch_add(bytes, Ordering::Relaxed);
        }
    }
}

/// Waits until the usage of the gateway meets the condition, and returns it.
fn settled(gateway: &Gateway, is: impl Fn(&Usage) -> bool) -> Usage {
    until(
        "the gateway releases its resources",
        || is(&gateway.usage()),
    );
    gateway.usage()
}

fn fuzz(secured: bool) {
    let seconds = load::number("FIPA_FUZZ_SECONDS").unwrap_or(4);
    let seed = load::number("FIPA_FUZZ_SEED").unwrap_or_else(|| fastrand::u64(..));
    let mode = if secured { "with keys" } else { "without keys" };
    println!("{mode}: FIPA_FUZZ_SEED={seed}, {seconds} s");
    let setup = Setup::new(secured);
    let talk = setup.pair.rover.talk("arm");
    talk.goes_on(100);
    let at_first = setup.pair.gateway.usage();
    let calm = move |usage: &Usage| usage.descriptors <= at_first.descriptors + DESCRIPTORS;

    // The gateway makes its permanent allocations during the warm-up.
    setup.attack(seconds.div_ceil(10), seed.rotate_left(32));
    let before = settled(&setup.pair.gateway, calm);
    let tallies = setup.attack(seconds, seed);
    // Few letters pass on a busy machine.
    let timeout = Instant::now() + LONGER;
    while setup.pair.strange() == 0 && Instant::now() < timeout {
        setup.attack(1, fastrand::u64(..));
    }
    let after = settled(&setup.pair.gateway, |usage| {
        calm(usage) && usage.resident <= before.resident * 5 / 4 + RESIDENT
    });
    talk.goes_on(100);
    let took = talk.take();
    talk.end();

    for (attack, tally) in setup.target.attacks.iter().zip(&tallies) {
        let of = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let (all, accepted) = (of(&tally.conversations), of(&tally.accepted));
        println!(
            "  {attack:?}: {all} conversations, {accepted} of them accepted, {} bytes",
            of(&tally.bytes)
        );
        assert!(
            accepted > 0,
            "the gateway accepted no conversation of {attack:?}"
        );
    }
    println!("  at first      {at_first:?}\n  after warm-up {before:?}\n  at the end    {after:?}");
    let foreign = setup.pair.strange();
    println!("  {foreign} letters of the attacker arrived at the honest agent");
    assert!(foreign > 0, "no letter of the attacker passed admission");
    let letters = took.len();
    assert!(letters > 0, "the honest pair exchanged no letter");
    let (median, last) = percentiles(took);
    println!("  {letters} honest letters with answers: median {median:.1?}, 99 % {last:.1?}");
    setup.pair.end();
}

#[test]
fn a_gateway_without_keys_survives_malformed_input() {
    fuzz(false);
}

#[test]
fn a_gateway_with_keys_survives_malformed_input_also_of_trusted_peers() {
    fuzz(true);
}
