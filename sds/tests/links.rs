//! Three hosts whose links are disconnected and restored: after every restoration all views agree,
//! although announcements and goodbyes were missed and names were registered twice in the meantime.
//!
//! Needs root, and the Debian package iproute2. Without them the test reports that it is skipped;
//! in CI it fails.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use common::registration;
use fipa_sds::{Directory, MdnsConfig, MdnsDirectory, MtsId};
use fipa_testbed::{Family, Host, Network, until};
use fipa_transport::Incarnation;
use tokio::runtime::Runtime;

/// Defines a test for the harness, and the ignored test that it runs in separate namespaces.
macro_rules! in_family {
    ($name:ident, $inside:ident, $family:expr) => {
        #[test]
        fn $name() {
            fipa_testbed::isolated(stringify!($inside), &[]);
        }

        #[test]
        #[ignore = "is run by the other test in namespaces of its own"]
        fn $inside() {
            fipa_testbed::enter();
            views_agree_after_every_healing($family);
        }
    };
}

in_family!(
    views_agree_after_every_healing_over_ipv4,
    inside_views_agree_over_ipv4,
    Family::V4
);

in_family!(
    views_agree_after_every_healing_over_ipv6,
    inside_views_agree_over_ipv6,
    Family::UniqueLocal
);

in_family!(
    views_agree_after_every_healing_on_one_link,
    inside_views_agree_on_one_link,
    Family::LinkLocal
);

in_family!(
    views_agree_after_every_healing_over_all_addresses,
    inside_views_agree_over_all_addresses,
    Family::Both
);

fn views_agree_after_every_healing(family: Family) {
    let seed = std::env::var("FIPA_LINKS_SEED").ok();
    let seed = seed.map_or(4, |seed| seed.parse().unwrap());
    println!("FIPA_LINKS_SEED={seed}");
    let mut random = fastrand::Rng::with_seed(seed);
    let network = Network::of(family, 3);
    let mut members: Vec<Member> = network.hosts().iter().map(Member::new).collect();
    for round in 0..4 {
        let mut cut = Vec::new();
        for _ in 0..8 {
            match random.usize(0..4) {
                0 => {
                    let index = random.usize(0..members.len());
                    if cut.contains(&index) {
                        cut.retain(|other| *other != index);
                        network.host(index).plug();
                    } else {
                        cut.push(index);
                        network.host(index).unplug();
                    }
                }
                choice => {
                    let member = random.choice(&mut members).unwrap();
                    let name = format!("agent {}", random.usize(0..8));
                    member.change(&name, choice > 1);
                }
            }
            std::thread::sleep(Duration::from_millis(random.u64(0..900)));
        }
        for index in cut {
            network.host(index).plug();
        }
        let healed = Instant::now();
        agree(&mut members);
        println!(
            "round {round}: all agree {:.1?} after healing",
            healed.elapsed()
        );
    }

    // A host that disconnects without traffic to it is detected, and so is its return.
    members[0].change("last", true);
    agree(&mut members);
    network.host(0).unplug();
    let vanished = Instant::now();
    until("its agents are gone elsewhere", || {
        members[1..]
            .iter()
            .all(|member| member.directory.known("last").is_none())
    });
    println!("gone {:.1?} after it vanished", vanished.elapsed());
    network.host(0).plug();
    let healed = Instant::now();
    agree(&mut members);
    println!("back {:.1?} after healing", healed.elapsed());

    // Its interface goes down and comes back with another address.
    network.host(0).ip("link set eth0 down");
    network.host(0).flush();
    members[0].change("meanwhile", true);
    std::thread::sleep(Duration::from_secs(1));
    network.host(0).come_up(77);
    let healed = Instant::now();
    agree(&mut members);
    println!(
        "agreed {:.1?} after the change of address",
        healed.elapsed()
    );
    // A disconnect for a long time, without any host to query, is not an error.
    for member in &members {
        assert!(member.directory.status().refused == 0);
    }
}

/// The directory of one host's gateway.
struct Member {
    directory: MdnsDirectory,
    own: BTreeMap<String, Incarnation>,
    /// Its worker threads are in the host's namespace.
    _runtime: Runtime,
}

impl Member {
    fn new(host: &Host) -> Self {
        host.enter(|| {
            let runtime = tokio::runtime::Builder::new_multi_thread()
                .worker_threads(1)
                .enable_all()
                .build()
                .unwrap();
            let config = MdnsConfig {
                interfaces: vec!["eth0".to_owned()],
                ..MdnsConfig::new(MtsId::new(host.name(), Incarnation::random()))
            };
            let directory = {
                let _context = runtime.enter();
                MdnsDirectory::open(config).unwrap()
            };
            Self {
                directory,
                own: BTreeMap::new(),
                _runtime: runtime,
            }
        })
    }

    /// Registers an agent of that name, or deregisters it.
    fn change(&mut self, name: &str, joins: bool) {
        if let Some(incarnation) = self.own.remove(name) {
            self.directory.deregister(name, incarnation).unwrap();
        }
        if joins {
            let agent = registration(name);
            self.directory.register(agent.clone()).unwrap();
            self.own.insert(name.to_owned(), agent.incarnation);
        }
    }

    /// The agents of other hosts in this host's view.
    fn view(&self) -> BTreeMap<String, Incarnation> {
        let entries = self.directory.entries();
        entries
            .iter()
            .map(|entry| (entry.name.to_string(), entry.incarnation))
            .collect()
    }
}

/// Waits until each view has every name of the other hosts, each with one of their registrations.
fn agree(members: &mut [Member]) {
    let started = Instant::now();
    loop {
        let views: Vec<_> = members.iter().map(Member::view).collect();
        let agrees = |(index, view): (usize, &BTreeMap<String, Incarnation>)| {
            let others = members.iter().enumerate();
            let others = others.filter(|(other, _)| *other != index);
            let mut names: BTreeMap<&String, BTreeSet<Incarnation>> = BTreeMap::new();
            for (name, incarnation) in others.flat_map(|(_, member)| &member.own) {
                names.entry(name).or_default().insert(*incarnation);
            }
            names.len() == view.len()
                && names
                    .iter()
                    .all(|(name, all)| view.get(*name).is_some_and(|it| all.contains(it)))
        };
        if views.iter().enumerate().all(agrees) {
            return;
        }
        assert!(
            started.elapsed() < common::WATCHDOG,
            "they do not agree: {views:#?}"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
}
