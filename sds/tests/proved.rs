//! Names that several gateways claim, some over links that prove the agents that they may speak
//! for.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_sds::{
    Change, ContactDirectory, Directory, Entry, Exchange, ExchangeDirectory, MergedDirectory,
    MtsId, Present, StaticDirectory, Subscriber,
};
use fipa_transport::{Incarnation, Location, Mandate, PeerId, Principal};

/// Offset between the number of a gateway and that of its agent.
const fn agent_of(gateway: u64) -> Incarnation {
    Incarnation::from_u64(gateway + 1000)
}

fn location(gateway: u64) -> Location {
    let text = format!("tcp://10.0.0.{gateway}:7788#{gateway:016x}");
    text.parse().unwrap()
}

fn certified(agents: &[&str]) -> Mandate {
    Mandate::Certified(agents.iter().map(|agent| (*agent).to_owned()).collect())
}

/// The certificate of the gateway with this number.
fn certificate(gateway: u64) -> Principal {
    let mut fingerprint = [0; 32];
    fingerprint[..8].copy_from_slice(&gateway.to_be_bytes());
    Principal::Certificate(fingerprint)
}

fn present(gateway: u64, mandate: Mandate) -> Present {
    Present {
        mts: MtsId::new(format!("mts-{gateway}"), Incarnation::from_u64(gateway)),
        locations: vec![location(gateway)],
        mandate,
        principal: certificate(gateway),
    }
}

struct Bench {
    now: Instant,
    exchange: Exchange,
    neighbors: Vec<Present>,
    versions: u64,
}

impl Bench {
    fn new(neighbors: Vec<Present>) -> Self {
        let mut bench = Self {
            now: Instant::now(),
            exchange: Exchange::new(0),
            neighbors,
            versions: 0,
        };
        bench.connect();
        bench
    }

    fn connect(&mut self) {
        self.exchange.handle_neighbors(self.now, &self.neighbors);
    }

    /// The gateway sends its list of agents, each with this time of registration.
    fn tell(&mut self, gateway: u64, agents: &[&str], registered: u64) {
        self.tell_as(gateway, agent_of(gateway), agents, registered);
    }

    /// The gateway sends its list of agents, each with this registration.
    fn tell_as(&mut self, gateway: u64, id: Incarnation, agents: &[&str], registered: u64) {
        self.versions += 1;
        let version = self.versions;
        let agents: Vec<String> = agents
            .iter()
            .map(|name| format!(r#"{{"name":"{name}","id":"{id}","registered":{registered}}}"#))
            .collect();
        let content = format!(
            r#"{{"version":1,"tell":{{"full":{{"version":{version},"first":true,"last":true,
            "agents":[{}]}}}}}}"#,
            agents.join(",")
        );
        let from = Incarnation::from_u64(gateway);
        let taken = self
            .exchange
            .handle_letter(self.now, from, content.as_bytes());
        taken.unwrap();
    }

    fn holder(&self, name: &str) -> Option<u64> {
        let entry = self.exchange.directory().known(name)?;
        Some(entry.mts.incarnation.as_u64())
    }
}

#[test]
fn agents_that_the_certificate_does_not_name_are_left_out() {
    let mut bench = Bench::new(vec![present(1, certified(&["rover", "arm_*"]))]);
    bench.tell(1, &["rover", "arm_1", "crex", "arm"], 5);
    let directory = bench.exchange.directory();
    let names: Vec<String> = directory
        .entries()
        .iter()
        .map(|it| it.name.to_string())
        .collect();
    assert_eq!(names, ["arm_1", "rover"]);
    // The user trusts another certificate of that gateway: it sends all agents again.
    bench.neighbors = vec![present(1, certified(&["crex"]))];
    bench.connect();
    assert_eq!(directory.entries().len(), 0);
    bench.tell(1, &["rover", "crex"], 5);
    assert_eq!(
        (bench.holder("rover"), bench.holder("crex")),
        (None, Some(1))
    );
}

#[test]
fn agents_whose_names_are_patterns_are_left_out() {
    for mandate in [Mandate::Unproved, certified(&[]), certified(&["arm_*"])] {
        let mut bench = Bench::new(vec![present(1, mandate)]);
        bench.tell(1, &["arm_.*", "arm_1", "arm_(1|2)", "arm_?"], 5);
        let entries = bench.exchange.directory().entries();
        let names: Vec<&str> = entries.iter().map(|entry| &*entry.name).collect();
        assert_eq!(names, ["arm_1"]);
    }
}

#[test]
fn the_names_of_platform_agents_count_from_the_gateway_of_that_name_only() {
    for mandate in [Mandate::Unproved, certified(&[])] {
        let mut bench = Bench::new(vec![present(1, mandate.clone()), present(2, mandate)]);
        let names = [
            "df@mts-1",
            "ams@mts-1",
            "df-000000ff@mts-1",
            "df@mts-2",
            "ams-000000ff@mts-2",
            "arm@mts-2",
        ];
        bench.tell(1, &names, 5);
        let directory = bench.exchange.directory();
        let entries = directory.entries();
        let known: Vec<&str> = entries.iter().map(|entry| &*entry.name).collect();
        let own = ["ams@mts-1", "arm@mts-2", "df-000000ff@mts-1", "df@mts-1"];
        assert_eq!(known, own);
        bench.tell(2, &names, 4);
        assert_eq!(bench.holder("df@mts-1"), Some(1));
        assert_eq!(bench.holder("df@mts-2"), Some(2));
    }
}

#[test]
fn a_proved_claim_precedes_an_earlier_one_without_proof() {
    let mut bench = Bench::new(vec![
        present(1, Mandate::Unproved),
        present(2, certified(&[])),
    ]);
    bench.tell(1, &["rover"], 1);
    assert_eq!(bench.holder("rover"), Some(1));
    bench.tell(2, &["rover"], 9);
    assert_eq!(bench.holder("rover"), Some(2));
    bench.tell(1, &["rover"], 0);
    assert_eq!(bench.holder("rover"), Some(2));
    bench.tell(2, &[], 0);
    assert_eq!(bench.holder("rover"), Some(1));
}

/// Registrations are public, so another gateway can announce one for an agent of its own, also before the real one.
#[test]
fn the_sender_of_a_letter_is_the_agent_that_its_peer_vouches_for() {
    let mut bench = Bench::new(vec![present(1, certified(&[])), present(2, certified(&[]))]);
    let registration = Incarnation::from_u64(77);
    bench.tell_as(1, registration, &["stray"], 5);
    bench.tell_as(2, registration, &["crane"], 5);
    let directory = bench.exchange.directory();
    let sender = |name: &str, gateway| {
        let peer = PeerId::of(certificate(gateway), None);
        let entry = directory.sender(registration, name, &peer)?;
        Some(entry.name.to_string())
    };
    assert_eq!(sender("crane", 2).as_deref(), Some("crane"));
    // It does not matter which name the other gateway writes into its letters.
    assert_eq!(sender("stray", 1).as_deref(), Some("stray"));
    assert_eq!(sender("crane", 1).as_deref(), Some("stray"));
    assert_eq!(sender("stray", 2), None);
    assert_eq!(sender("crane", 3), None);
}

#[test]
fn the_first_of_two_proved_claims_keeps_the_name_until_it_leaves() {
    let mut bench = Bench::new(vec![present(1, certified(&[])), present(2, certified(&[]))]);
    bench.tell(1, &["rover"], 50);
    // The time of registration is only a claim.
    bench.tell(2, &["rover"], 1);
    assert_eq!(bench.holder("rover"), Some(1));
    let contested = bench.exchange.directory().contested();
    let claims = contested.iter().map(|(holder, other)| {
        (
            holder.mts.incarnation.as_u64(),
            other.mts.incarnation.as_u64(),
        )
    });
    assert_eq!(claims.collect::<Vec<_>>(), [(1, 2)]);
    // The holder sends the same entry again, or an update, and keeps the name.
    bench.tell(1, &["rover"], 99);
    assert_eq!(bench.holder("rover"), Some(1));
    // An agent that moves is not locked out: it leaves one gateway.
    bench.tell(1, &[], 0);
    assert_eq!(bench.holder("rover"), Some(2));
    assert!(bench.exchange.directory().contested().is_empty());
    // The same applies to an agent whose host is lost.
    bench.tell(1, &["rover"], 0);
    assert_eq!(bench.holder("rover"), Some(2));
    bench.neighbors.remove(1);
    bench.connect();
    bench.exchange.handle_timeout(bench.now + Exchange::MEMORY);
    assert_eq!(bench.holder("rover"), Some(1));
}

#[test]
fn many_conflicts_of_one_peer_do_not_hide_those_of_others() {
    let of = |gateway: u64, certificate_of: u64| Present {
        principal: certificate(certificate_of),
        ..present(gateway, certified(&[]))
    };
    // Gateways 1 and 2 have one certificate; 5 claims the names of 1, too.
    let mut bench = Bench::new(vec![of(1, 1), of(2, 1), of(3, 3), of(4, 4), of(5, 5)]);
    let names: Vec<String> = (0..1100).map(|number| format!("a_{number:04}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    bench.tell(1, &names, 1);
    bench.tell(2, &names, 1);
    bench.tell(3, &["rover"], 1);
    bench.tell(4, &["rover"], 1);
    let contested = |bench: &Bench| {
        let pairs = bench.exchange.directory().contested().into_iter();
        let pairs = pairs.map(|(holder, other)| {
            let of = |entry: &Entry| entry.mts.incarnation.as_u64();
            (other.name.to_string(), of(&holder), of(&other))
        });
        pairs.collect::<Vec<_>>()
    };
    assert_eq!(contested(&bench), [("rover".to_owned(), 3, 4)]);
    bench.tell(5, &names, 1);
    let pairs = contested(&bench);
    assert_eq!(pairs.len(), ExchangeDirectory::MAX_CONTESTED);
    assert!(pairs[..2].contains(&("rover".to_owned(), 3, 4)));
    // A peer whose names another one took first has its real conflict listed, too.
    bench.tell(1, &names, 1);
    let mut own = names.clone();
    own.push("rover");
    bench.tell(5, &own, 1);
    assert!(contested(&bench).contains(&("rover".to_owned(), 3, 5)));
}

#[test]
fn a_gateway_that_restarts_at_another_address_takes_its_agents_back() {
    // Gateway 2 is gateway 1 after a restart; gateway 3 has another name.
    let restarted = |gateway: u64, name: &str| Present {
        mts: MtsId::new(name, Incarnation::from_u64(gateway)),
        principal: certificate(1),
        ..present(gateway, certified(&[]))
    };
    for (name, holder) in [("mts-1", 2), ("mts-3", 1)] {
        let mut bench = Bench::new(vec![restarted(1, "mts-1"), restarted(2, name)]);
        bench.tell(1, &["rover"], 5);
        bench.tell(2, &["rover"], 5);
        assert_eq!(bench.holder("rover"), Some(1), "both are connected");
        bench.neighbors.remove(0);
        bench.connect();
        assert_eq!(bench.holder("rover"), Some(holder), "{name}");
    }
}

#[test]
fn proved_agents_of_a_disconnected_gateway_are_kept() {
    for (mandate, stays) in [(Mandate::Unproved, false), (certified(&[]), true)] {
        let mut bench = Bench::new(vec![present(1, mandate)]);
        bench.tell(1, &["rover"], 5);
        bench.neighbors.clear();
        bench.connect();
        bench.exchange.leave_to_others(|_| true);
        assert_eq!(bench.holder("rover").is_some(), stays);
    }
}

#[test]
fn without_proof_the_first_claim_has_the_name_too() {
    let unproved = [1, 2].map(|gateway| present(gateway, Mandate::Unproved));
    let mut bench = Bench::new(unproved.to_vec());
    bench.tell(1, &["rover"], 50);
    bench.tell(2, &["rover"], 1);
    assert_eq!(bench.holder("rover"), Some(1));
    let contested = bench.exchange.directory().contested();
    let gateways = contested.iter().map(|(holder, other)| {
        let of = |entry: &Entry| entry.mts.incarnation.as_u64();
        (of(holder), of(other))
    });
    assert_eq!(gateways.collect::<Vec<_>>(), [(1, 2)]);
    bench.tell(1, &[], 50);
    assert_eq!(bench.holder("rover"), Some(2));
}

/// A directory of announcements, without connections to the gateways.
struct Announced(Arc<ExchangeDirectory>);

impl Directory for Announced {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        self.0.known(name)
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.0.known_incarnation(incarnation)
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        self.0.entries()
    }

    fn generation(&self) -> u64 {
        self.0.generation()
    }

    fn subscribe(&self, subscriber: &Subscriber) {
        self.0.subscribe(subscriber);
    }
}

#[test]
fn an_agent_of_a_connected_gateway_precedes_one_that_is_only_announced() {
    let bench = |gateway| Bench::new(vec![present(gateway, Mandate::Unproved)]);
    let (mut announced, mut connected) = (bench(1), bench(2));
    announced.tell(1, &["rover", "arm"], 1);
    connected.tell(2, &["rover", "arm"], 50);
    let legacy = StaticDirectory::new([("arm", vec!["tcp://10.0.0.9:1;jade".parse().unwrap()])]);
    let merged = MergedDirectory::new(vec![
        Arc::new(Announced(announced.exchange.directory())),
        connected.exchange.directory(),
        Arc::new(legacy.unwrap()),
    ]);
    let gateway = |entry: Option<Arc<Entry>>| entry.map(|it| it.mts.incarnation.as_u64());
    assert_eq!(gateway(merged.known("rover")), Some(2));
    assert_eq!(gateway(merged.view().named("rover")), Some(2));
    // The configuration of the owner precedes both.
    assert_eq!(gateway(merged.known("arm")), Some(0));
    let entries = merged.entries();
    let of_entries: Vec<_> = entries
        .iter()
        .map(|it| gateway(Some(Arc::clone(it))))
        .collect();
    assert_eq!(of_entries, [Some(0), Some(2)]);
    connected.tell(2, &[], 50);
    assert_eq!(gateway(merged.known("rover")), Some(1));
}

#[test]
fn a_registration_that_another_neighbor_claims_stays_with_its_agent() {
    let mut bench = Bench::new(vec![
        present(1, certified(&[])),
        present(2, certified(&["crex", "drex"])),
        present(3, Mandate::Unproved),
    ]);
    let directory = bench.exchange.directory();
    let agent = || Some(directory.known_incarnation(agent_of(1))?.name.to_string());
    // Without proof, a claim counts only until that of a certificate.
    bench.tell_as(3, agent_of(1), &["stray"], 0);
    assert_eq!(agent().as_deref(), Some("stray"));
    bench.tell(1, &["rover"], 5);
    assert_eq!(agent().as_deref(), Some("rover"));
    for claimed in [&["crex", "drex"][..], &["drex"], &[]] {
        bench.tell_as(2, agent_of(1), claimed, 0);
        assert_eq!(agent().as_deref(), Some("rover"), "{claimed:?}");
    }
    // The agent is updated.
    bench.tell_as(2, agent_of(1), &["crex"], 0);
    bench.tell(1, &["rover"], 9);
    assert_eq!(agent().as_deref(), Some("rover"));
    bench.tell(1, &[], 0);
    assert_eq!(agent().as_deref(), Some("crex"), "the proved claim");
    bench.tell(2, &[], 0);
    assert_eq!(agent().as_deref(), Some("stray"));
    bench.tell(3, &[], 0);
    assert_eq!(agent(), None);
}

/// Every gateway chooses the addresses that it lists, and its name.
#[test]
fn a_gateway_that_lists_the_address_of_another_does_not_replace_it() {
    let liar = Present {
        mts: MtsId::new("mts-1", Incarnation::from_u64(2)),
        locations: vec![location(2), location(1)],
        ..present(2, certified(&[]))
    };
    let mut bench = Bench::new(vec![present(1, certified(&[])), liar]);
    bench.tell(1, &["rover"], 5);
    bench.tell(2, &["crex"], 5);
    assert!(!bench.exchange.handle_silence(bench.now, &location(1)));
    bench.neighbors.remove(0);
    bench.connect();
    assert_eq!(bench.holder("rover"), Some(1), "remembered for a while");
    bench.exchange.handle_timeout(bench.now + Exchange::MEMORY);
    assert_eq!(bench.holder("rover"), None);
}

/// A view of unproved entries, listed first, and those of neighbors.
fn merged(bench: &Bench, unproved: Arc<dyn Directory>) -> MergedDirectory {
    MergedDirectory::new(vec![unproved, bench.exchange.directory()])
}

fn contact(name: &str, gateway: u64, agent: u64) -> Arc<ContactDirectory> {
    let contacts = ContactDirectory::new();
    let agent = Incarnation::from_u64(agent);
    contacts
        .record_sender(Instant::now(), name, agent, location(gateway))
        .unwrap();
    Arc::new(contacts)
}

#[test]
fn in_a_merged_view_proved_entries_come_first() {
    let mut bench = Bench::new(vec![present(1, certified(&[]))]);
    let view = merged(&bench, contact("rover", 66, 6));
    let mut watch = view.watch();
    assert_eq!(view.known("rover").unwrap().mts.incarnation.as_u64(), 66);
    // Its stated registration is long after the contact.
    bench.tell(1, &["rover"], 200_000_000_000_000);
    let is_proved = |view: &MergedDirectory| {
        let all = [view.known("rover"), view.entries().first().cloned()];
        all.map(|entry| entry.unwrap().mts.incarnation.as_u64()) == [1, 1]
    };
    assert!(is_proved(&view));
    assert!(matches!(
        watch.try_next(),
        Some(Change::Changed { .. } | Change::Left(_))
    ));
    assert!(view.mandate(Incarnation::from_u64(1)).is_proved());
    // A merged view of merged views has the same result.
    let outer = MergedDirectory::new(vec![contact("rover", 67, 7), Arc::new(view)]);
    assert!(is_proved(&outer));
}

#[test]
fn in_a_merged_view_an_unproved_entry_takes_no_registration_of_a_proved_one() {
    let mut bench = Bench::new(vec![present(1, certified(&[]))]);
    let view = merged(&bench, contact("crex", 66, agent_of(1).as_u64()));
    let agent = || Some(view.known_incarnation(agent_of(1))?.name.to_string());
    assert_eq!(agent().as_deref(), Some("crex"));
    bench.tell(1, &["rover"], 9);
    assert_eq!(agent().as_deref(), Some("rover"));
    assert!(view.known("crex").is_some(), "the name is free");
}

#[test]
fn entries_of_the_configuration_precede_proved_ones() {
    let mut bench = Bench::new(vec![present(1, certified(&[]))]);
    let old = StaticDirectory::new([("rover", vec![location(9)])]).unwrap();
    let view = merged(&bench, Arc::new(old));
    bench.tell(1, &["rover"], 1);
    assert_ne!(view.known("rover").unwrap().mts.incarnation.as_u64(), 1);
}

#[test]
fn other_directories_cannot_say_more_of_a_gateway_than_its_certificate() {
    let mut bench = Bench::new(Vec::new());
    let view = merged(&bench, contact("crex", 1, 6));
    let mut watch = view.watch();
    assert!(view.known("crex").is_some());
    bench.neighbors = vec![present(1, certified(&["rover"]))];
    bench.connect();
    // A connection with the gateway proves that it does not speak for that name.
    assert!(view.known("crex").is_none());
    assert!(view.entries().is_empty());
    assert_eq!(watch.try_next(), Some(Change::Lagged));
    bench.neighbors.clear();
    bench.connect();
    bench
        .exchange
        .handle_timeout(bench.now + Exchange::MEMORY + Duration::from_millis(1));
    assert!(view.known("crex").is_some(), "nothing is proved any more");
}
