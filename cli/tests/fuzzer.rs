//! A protocol fuzzer against running gateways, over every transport that they listen on, while an
//! honest pair talks through each: no crash, no stall, no leak.
//!
//! `FIPA_FUZZ_SECONDS` is how long each of the two gateways, one in the clear and one with keys, is
//! shot at (3 by default); `FIPA_FUZZ_SEED` repeats the decisions of an earlier run, though not the
//! machine's.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]
#![allow(clippy::print_stdout, reason = "what it came to is worth knowing")]

mod fuzzing;
mod siege;

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use fastrand::Rng;
use fipa::Incarnation;
use fipa::keys::Keys;
use fuzzing::trusted::{client, quic};
use fuzzing::{Writer, datagram, stream};
use siege::{Gateway, Pair, Usage, percentiles, until};
use tempfile::TempDir;

/// Conversations at a time.
const AT_ONCE: usize = 12;

/// Descriptors that may be open afterwards and were not before: connections of the gateway's own
/// that come and go.
const DESCRIPTORS: usize = 8;

/// Memory that may be taken afterwards beside a quarter more than before, in KiB: what the allocator
/// keeps of the largest conversations. Gateways have about 36 MiB and grew by 1 MiB in three seconds
/// and by 5 MiB in ten minutes with 220,000 conversations; so what leaves 64 KiB behind for each is
/// found within a minute, and what leaves a few hundred bytes within ten.
const RESIDENT: u64 = 12 << 10;

/// Ways to talk to a gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    /// Frames over TCP.
    Frames,
    /// A letter of an old peer.
    OldPeer,
    /// Datagrams that begin a UDP connection, or none.
    Datagrams,
    /// A UDP connection.
    Udp,
    /// The beginning of a TLS handshake.
    Handshake,
    /// Frames over TLS, as a trusted peer.
    Tls,
    /// Datagrams that begin a QUIC connection, or none.
    QuicDatagrams,
    /// A QUIC connection as a trusted peer.
    Quic,
    /// The same with datagrams that are spoilt on the way.
    SpoiltQuic,
}

use Way::*;
const CLEAR: [Way; 4] = [Frames, OldPeer, Datagrams, Udp];
const SECURED: [Way; 7] = [
    Frames,
    OldPeer,
    Handshake,
    Tls,
    QuicDatagrams,
    Quic,
    SpoiltQuic,
];

/// What was done by one way.
#[derive(Debug, Default)]
struct Tally {
    conversations: AtomicU64,
    /// Conversations in which the gateway let the other side in.
    let_in: AtomicU64,
    bytes: AtomicU64,
}

/// Two gateways, one of which is shot at.
struct Range {
    pair: Pair,
    target: Arc<Target>,
    /// Until everything has ended.
    _place: TempDir,
}

/// Where to shoot, and how.
struct Target {
    ways: &'static [Way],
    tcp: SocketAddr,
    datagrams: SocketAddr,
    tls: Option<Arc<rustls::ClientConfig>>,
    quic: Option<quinn::ClientConfig>,
    receivers: Vec<String>,
    known: Vec<(String, Incarnation)>,
    claimed: Vec<Incarnation>,
    /// What a peer of ours begins a handshake with, over TCP and in a datagram.
    begun: [Vec<u8>; 2],
}

impl Range {
    fn new(secured: bool) -> Self {
        let place = tempfile::Builder::new()
            .prefix("fuzzer-")
            .tempdir()
            .unwrap();
        let pair = Pair::new(place.path(), secured, "fuzzed");
        let tls = secured.then(|| {
            let rogue = siege::keys(place.path().join("rogue"), "rogue");
            siege::befriend(&Keys::at(place.path().join("target")), &rogue);
            client(&rogue, "rogue")
        });
        let quic = tls.as_ref().map(quic);
        let begun = |tls, quic| {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build();
            let packet = runtime.unwrap().block_on(datagram::initial(quic));
            [stream::client_hello(tls), packet]
        };
        let known = pair.registrations();
        // Without keys nothing separates strangers: one that claims to be the other host's is believed.
        let claimed = known
            .iter()
            .filter(|(name, _)| secured || name == "arm" || name == "target");
        let target = Target {
            claimed: claimed.map(|(_, life)| *life).collect(),
            known,
            ways: if secured { &SECURED } else { &CLEAR },
            tcp: pair.gateway.at("tcp"),
            datagrams: pair.gateway.at(if secured { "quic" } else { "udp" }),
            begun: match (&tls, &quic) {
                (Some(tls), Some(quic)) => begun(tls, quic),
                _ => Default::default(),
            },
            tls,
            quic,
            receivers: ["arm", "target", "rover", "nobody", "ar[lm]"]
                .map(str::to_owned)
                .into(),
        };
        Self {
            pair,
            target: Arc::new(target),
            _place: place,
        }
    }

    /// Shoots for so long, and waits until the gateway has got over it.
    fn shoot(&self, seconds: u64, seed: u64) -> Vec<Tally> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let tallies: Arc<Vec<Tally>> =
            Arc::new(self.target.ways.iter().map(|_| Tally::default()).collect());
        let until = Instant::now() + Duration::from_secs(seconds);
        let next = Arc::new(AtomicU64::new(0));
        let shooting = (0..AT_ONCE).map(|_| {
            let (target, tallies, next) = (self.target.clone(), tallies.clone(), next.clone());
            runtime.spawn(async move {
                while Instant::now() < until {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    target.converse(seed.wrapping_add(number), &tallies).await;
                }
            })
        });
        for one in shooting.collect::<Vec<_>>() {
            runtime.block_on(one).unwrap();
        }
        runtime.shutdown_timeout(Duration::from_secs(5));
        Arc::into_inner(tallies).unwrap()
    }
}

impl Target {
    /// One conversation, as the seed has it.
    async fn converse(&self, seed: u64, tallies: &[Tally]) {
        let mut random = Rng::with_seed(seed);
        let at = random.usize(..self.ways.len());
        let way = self.ways[at];
        let mut choices = random.fork();
        let mut writer = Writer {
            random: &mut random,
            name: "rogue",
            receivers: &self.receivers,
            known: &self.known,
            claimed: &self.claimed,
        };
        let bytes = match way {
            Frames => {
                let script = writer.frames();
                Some(stream::plain(self.tcp, script).await)
            }
            OldPeer => {
                let script = writer.old_peer();
                Some(stream::plain(self.tcp, script).await)
            }
            Datagrams | QuicDatagrams => {
                let pieces = match way {
                    QuicDatagrams => self.begun[1].clone(),
                    _ => writer.parcel(),
                };
                let script = writer.recorded(&vec![pieces; 8]);
                Some(datagram::raw(self.datagrams, script).await)
            }
            Udp => datagram::udp(self.datagrams, &mut writer).await,
            Handshake => {
                let script = writer.recorded(&self.begun[..1]);
                Some(stream::plain(self.tcp, script).await)
            }
            Tls => {
                let script = writer.frames();
                stream::secured(self.tcp, self.tls.clone().unwrap(), script).await
            }
            Quic | SpoiltQuic => {
                let script = writer.frames();
                let (config, spoilt) = (self.quic.clone().unwrap(), way == SpoiltQuic);
                datagram::quic(self.datagrams, config, script, &mut choices, spoilt).await
            }
        };
        let tally = &tallies[at];
        tally.conversations.fetch_add(1, Ordering::Relaxed);
        if let Some(bytes) = bytes {
            tally.let_in.fetch_add(1, Ordering::Relaxed);
            tally.bytes.fetch_add(bytes, Ordering::Relaxed);
        }
    }
}

/// A gateway that has got over what was done to it.
fn settled(gateway: &Gateway, is: impl Fn(&Usage) -> bool) -> Usage {
    until("the gateway lets go of what it took", || {
        is(&gateway.usage())
    });
    gateway.usage()
}

fn fuzz(secured: bool) {
    let seconds = siege::number("FIPA_FUZZ_SECONDS").unwrap_or(3);
    let seed = siege::number("FIPA_FUZZ_SEED").unwrap_or_else(|| fastrand::u64(..));
    let what = if secured { "with keys" } else { "in the clear" };
    println!("{what}: FIPA_FUZZ_SEED={seed}, {seconds} s");
    let range = Range::new(secured);
    let talk = range.pair.rover.talk("arm");
    talk.goes_on(100);
    let at_first = range.pair.gateway.usage();
    let calm = move |usage: &Usage| usage.descriptors <= at_first.descriptors + DESCRIPTORS;

    // What a gateway takes once and keeps, it takes in the warm-up.
    range.shoot(seconds.div_ceil(10), seed.rotate_left(32));
    let before = settled(&range.pair.gateway, calm);
    let tallies = range.shoot(seconds, seed);
    let after = settled(&range.pair.gateway, |usage| {
        calm(usage) && usage.resident <= before.resident * 5 / 4 + RESIDENT
    });
    talk.goes_on(100);
    let took = talk.take();
    talk.end();

    for (way, tally) in range.target.ways.iter().zip(&tallies) {
        let of = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let (all, let_in) = (of(&tally.conversations), of(&tally.let_in));
        println!(
            "  {way:?}: {all} conversations, {let_in} of them let in, {} bytes",
            of(&tally.bytes)
        );
        assert!(let_in > 0, "{way:?} was never tried in earnest");
    }
    println!("  at first {at_first:?}\n  warm     {before:?}\n  after    {after:?}");
    let strange = range.pair.strange();
    println!("  {strange} letters of the fuzzer came to the honest agent");
    assert!(strange > 0, "nothing got past admission");
    let letters = took.len();
    assert!(letters > 0, "the honest pair said nothing");
    let (median, last) = percentiles(took);
    println!("  {letters} honest letters and answers: median {median:.1?}, 99 % {last:.1?}");
    range.pair.end();
}

#[test]
fn a_gateway_in_the_clear_bears_nonsense() {
    fuzz(false);
}

#[test]
fn a_gateway_with_keys_bears_nonsense_also_from_those_it_trusts() {
    fuzz(true);
}
