//! The exchange of directories: gateways on virtual time, with letters that arrive late or not at
//! all, drawn from a seed.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant, UNIX_EPOCH};

use fipa_sds::{
    Change, ContactDirectory, Directory, Entry, Exchange, ExchangeError, LetterKind,
    MergedDirectory, MtsId, OwnDfEntry, Present, Reach, Role, Source,
};
use fipa_transport::{Incarnation, Location, Mandate, PeerId, Principal};

/// Time for which the simulated service tries to deliver a letter.
const DEADLINE: Duration = Duration::from_secs(5);

struct Gateway {
    mts: MtsId,
    exchange: Exchange,
    agents: BTreeMap<String, Arc<Entry>>,
    /// The entries in its directory facilitator.
    df: BTreeMap<String, OwnDfEntry>,
}

/// A letter in transit: it arrives when the link is connected, or expires.
struct Letter {
    from: usize,
    to: usize,
    content: Vec<u8>,
    since: Instant,
    due: Instant,
}

struct World {
    now: Instant,
    gateways: Vec<Gateway>,
    letters: VecDeque<Letter>,
    /// Disconnected links.
    cut: Vec<(usize, usize)>,
    random: fastrand::Rng,
    sent: usize,
    next: u64,
    /// Milliseconds by which the clock of each host is ahead of that of the first one.
    clocks: Vec<u64>,
    /// The share of the letters that arrive and are not read.
    unread: f64,
    /// The proof of each gateway's links, and addresses of other gateways that it also lists.
    proofs: Vec<(Mandate, Principal, Vec<Location>)>,
}

fn location(index: usize) -> Location {
    let text = format!("tcp://10.0.0.{}:7788#{:016x}", index + 1, index + 1);
    text.parse().unwrap()
}

impl World {
    fn new(count: usize, seed: u64) -> Self {
        let gateways = (0..count).map(|index| Gateway {
            mts: MtsId::new("same-name-mts", Incarnation::from_u64(index as u64 + 1)),
            exchange: Exchange::new(seed ^ index as u64),
            agents: BTreeMap::new(),
            df: BTreeMap::new(),
        });
        Self {
            now: Instant::now(),
            gateways: gateways.collect(),
            letters: VecDeque::new(),
            cut: Vec::new(),
            random: fastrand::Rng::with_seed(seed),
            sent: 0,
            next: 1000,
            clocks: vec![0; count],
            unread: 0.0,
            proofs: vec![(Mandate::Unproved, Principal::Unproved, Vec::new()); count],
        }
    }

    fn connected(&self, one: usize, other: usize) -> bool {
        one != other && !self.cut.contains(&(one.min(other), one.max(other)))
    }

    /// Tells every gateway which others are connected.
    fn connect(&mut self) {
        for index in 0..self.gateways.len() {
            let others = (0..self.gateways.len()).filter(|other| self.connected(index, *other));
            let present: Vec<_> = others
                .map(|other| {
                    let (mandate, principal, also) = self.proofs[other].clone();
                    let mut locations = vec![location(other)];
                    locations.extend(also);
                    Present {
                        mts: self.gateways[other].mts.clone(),
                        locations,
                        mandate,
                        principal,
                    }
                })
                .collect();
            let now = self.now;
            self.gateways[index]
                .exchange
                .handle_neighbors(now, &present);
        }
    }

    fn join(&mut self, index: usize, name: &str) {
        self.appear(index, name);
        let gateway = &mut self.gateways[index];
        gateway
            .exchange
            .handle_own(self.now, gateway.agents.values());
    }

    /// Adds an agent without telling the exchange.
    fn appear(&mut self, index: usize, name: &str) {
        self.next += 1;
        let mts = self.gateways[index].mts.clone();
        let entry = Entry {
            name: name.into(),
            agent_type: "arm".to_owned(),
            incarnation: Incarnation::from_u64(self.next),
            locations: vec!["shm://here".parse().unwrap()],
            mts,
            description: "né à \"côté\"".to_owned(),
            registered: UNIX_EPOCH + Duration::from_millis(self.clocks[index] + self.next),
            source: Source::Host,
            reach: Reach::Local,
            peer: PeerId::THIS_HOST,
            role: Role::Agent,
        };
        let gateway = &mut self.gateways[index];
        gateway.agents.insert(name.to_owned(), Arc::new(entry));
        gateway
            .exchange
            .handle_own(self.now, gateway.agents.values());
    }

    /// Registers an agent with the directory facilitator of its gateway, or changes its description.
    fn describe(&mut self, index: usize, name: &str, text: &str, lease: Option<Duration>) {
        let gateway = &mut self.gateways[index];
        let entry = OwnDfEntry {
            name: name.into(),
            incarnation: gateway.agents[name].incarnation,
            text: text.into(),
            addresses: Vec::new(),
            lease: lease.map(|time_left| self.now + time_left),
        };
        gateway.df.insert(name.to_owned(), entry);
        self.update_df(index);
    }

    fn update_df(&mut self, index: usize) {
        let gateway = &mut self.gateways[index];
        let all = gateway.df.values().cloned().collect();
        let others = gateway.exchange.handle_own_df(self.now, all);
        assert!(others.is_empty(), "{others:?}");
    }

    /// Returns the gateway, the agent and the text of each DF entry that a gateway has received.
    fn df_entries(&self, index: usize) -> BTreeSet<(usize, String, String)> {
        let entries = self.gateways[index].exchange.directory().df_entries();
        let entries = entries.iter().map(|entry| {
            let gateway = usize::try_from(entry.gateway.as_u64() - 1).unwrap();
            (gateway, entry.name.to_string(), entry.text.to_string())
        });
        entries.collect()
    }

    /// Returns the DF entries of present agents of the connected gateways.
    fn expected_df(&self, index: usize) -> BTreeSet<(usize, String, String)> {
        let others = 0..self.gateways.len();
        let others = others.filter(|other| self.connected(index, *other));
        others
            .flat_map(|other| {
                let gateway = &self.gateways[other];
                let present = gateway.df.values().filter(|entry| {
                    let agent = gateway.agents.get(&*entry.name);
                    agent.is_some_and(|agent| agent.incarnation == entry.incarnation)
                });
                present.map(move |entry| (other, entry.name.to_string(), entry.text.to_string()))
            })
            .collect()
    }

    fn leave(&mut self, index: usize, name: &str) {
        let gateway = &mut self.gateways[index];
        gateway.agents.remove(name);
        gateway
            .exchange
            .handle_own(self.now, gateway.agents.values());
    }

    /// Passes the goodbye of the first gateway to the second one. Returns its receivers.
    fn say_goodbye(&mut self) -> Vec<Incarnation> {
        let (to, goodbye) = self.gateways[0].exchange.goodbye();
        let from = self.gateways[0].mts.incarnation;
        let receiver = &mut self.gateways[1].exchange;
        receiver.handle_letter(self.now, from, &goodbye).unwrap();
        to
    }

    /// Advances the time.
    fn run(&mut self, time: Duration) {
        self.step();
        let end = self.now + time;
        while self.now < end {
            let soon = self.now + Duration::from_millis(1);
            let gateways = self.gateways.iter();
            let timeouts = gateways.filter_map(|gateway| gateway.exchange.poll_timeout());
            let expiries = self.letters.iter().map(|letter| letter.since + DEADLINE);
            // A letter that could not arrive waits for its link, or expires.
            let arrivals = self.letters.iter().map(|letter| letter.due);
            let arrivals = arrivals.filter(|due| *due > self.now);
            let next = timeouts.chain(expiries).chain(arrivals).min();
            self.now = next.unwrap_or(end).max(soon).min(end);
            self.step();
        }
    }

    fn step(&mut self) {
        let now = self.now;
        for from in 0..self.gateways.len() {
            let exchange = &mut self.gateways[from].exchange;
            exchange.handle_timeout(now);
            while let Some((to, content)) = exchange.poll_letter(now) {
                assert!(content.len() < Exchange::MAX_CONTENT);
                self.sent += 1;
                let delay = Duration::from_millis(self.random.u64(1..40));
                self.letters.push_back(Letter {
                    from,
                    to: usize::try_from(to.as_u64() - 1).unwrap(),
                    content,
                    since: now,
                    due: now + delay,
                });
            }
            let due = exchange.poll_timeout();
            assert!(
                due.is_none_or(|due| due > now),
                "the timeout did not advance"
            );
        }
        // In order for each pair: a letter that waits blocks those behind it.
        let mut waiting = VecDeque::new();
        let mut held: Vec<(usize, usize)> = Vec::new();
        while let Some(letter) = self.letters.pop_front() {
            let pair = (letter.from, letter.to);
            let expired = now >= letter.since + DEADLINE;
            let goes = self.connected(letter.from, letter.to) && now >= letter.due;
            if held.contains(&pair) || !(goes || expired) {
                held.push(pair);
                waiting.push_back(letter);
                continue;
            }
            if goes && !expired {
                let from = self.gateways[letter.from].mts.incarnation;
                let receiver = &mut self.gateways[letter.to].exchange;
                if self.random.f64() < self.unread {
                    receiver.handle_unread(now, from);
                } else {
                    match receiver.handle_letter(now, from, &letter.content) {
                        Ok(()) | Err(ExchangeError::NotConnected) => {}
                        Err(error) => panic!("{error}"),
                    }
                }
            }
            let to = self.gateways[letter.to].mts.incarnation;
            let sender = &mut self.gateways[letter.from].exchange;
            sender.handle_sent(now, to, goes && !expired);
        }
        self.letters = waiting;
    }

    /// Returns the gateway and the registration of the agent that a gateway knows by this name.
    fn holder(&self, at: usize, name: &str) -> Option<(usize, Incarnation)> {
        let entry = self.gateways[at].exchange.directory().known(name)?;
        let owner = usize::try_from(entry.mts.incarnation.as_u64() - 1).unwrap();
        Some((owner, entry.incarnation))
    }

    /// Whether every gateway has exactly the agents of its connected gateways, and their DF entries.
    fn agrees(&self) -> bool {
        (0..self.gateways.len()).all(|index| {
            if self.df_entries(index) != self.expected_df(index) {
                return false;
            }
            let expected = (0..self.gateways.len())
                .filter(|other| self.connected(index, *other))
                .flat_map(|other| self.gateways[other].agents.values())
                .fold(
                    BTreeMap::<&str, Vec<&Arc<Entry>>>::new(),
                    |mut all, entry| {
                        all.entry(&entry.name).or_default().push(entry);
                        all
                    },
                );
            let known = self.gateways[index].exchange.directory().entries();
            // Of several agents of one name, each host may have another one.
            known.len() == expected.len()
                && known.iter().zip(expected.values()).all(|(known, entries)| {
                    entries.iter().any(|entry| {
                        let owner = usize::try_from(entry.mts.incarnation.as_u64() - 1).unwrap();
                        let (principal, at) = (self.proofs[owner].1, [location(owner)]);
                        **known
                            == Entry {
                                locations: vec![location(owner)],
                                source: Source::Exchange,
                                reach: Reach::Remote {
                                    gateway: entry.mts.incarnation,
                                },
                                peer: PeerId::of(principal, at.first()),
                                ..Entry::clone(entry)
                            }
                    })
                })
        })
    }
}

#[test]
fn neighbors_receive_each_others_agents() {
    let mut world = World::new(3, 1);
    for number in 0..10 {
        world.join(0, &format!("arm_{number}"));
    }
    world.join(1, "camera");
    world.connect();
    let directory = world.gateways[1].exchange.directory();
    let mut watch = directory.watch();
    world.run(Duration::from_millis(300));
    assert!(world.agrees());
    let mut joined = 0;
    while let Some(Change::Joined(entry)) = watch.try_next() {
        assert_eq!(entry.source, Source::Exchange);
        joined += 1;
    }
    assert_eq!(joined, 10);
    world.leave(0, "arm_3");
    world.join(0, "arm_4");
    world.run(Duration::from_millis(300));
    assert!(world.agrees());
    assert!(matches!(
        watch.try_next(),
        Some(Change::Left(_) | Change::Changed { .. })
    ));
}

#[test]
fn df_entries_travel_with_their_agents() {
    let mut world = World::new(3, 11);
    for name in ["crane", "arm", "rover"] {
        world.join(0, name);
    }
    world.describe(0, "crane", "lifting", None);
    world.connect();
    world.describe(0, "arm", "gripping", Some(Duration::from_secs(7200)));
    world.run(Duration::from_millis(300));
    assert!(world.agrees());
    assert_eq!(world.df_entries(1).len(), 2);
    // A change of the description, and its end.
    world.describe(0, "crane", "towing", None);
    world.gateways[0].df.remove("arm");
    world.update_df(0);
    world.run(Duration::from_millis(300));
    assert!(world.agrees());
    assert_eq!(
        world.df_entries(2),
        [(0, "crane".to_owned(), "towing".to_owned())].into()
    );
    // The entry belongs to a registration.
    world.join(0, "crane");
    world.run(Duration::from_millis(300));
    assert!(world.df_entries(1).is_empty());
    world.describe(0, "crane", "again", None);
    world.describe(0, "rover", "driving", None);
    world.run(Duration::from_millis(300));
    world.leave(0, "rover");
    world.run(Duration::from_millis(300));
    assert!(world.agrees());
    assert_eq!(world.df_entries(1).len(), 1);
    // It ends with the connection, and is there again with it.
    world.cut = vec![(0, 1)];
    world.connect();
    world.run(Exchange::MEMORY + Duration::from_secs(1));
    assert!(world.agrees());
    assert!(world.df_entries(1).is_empty());
    world.cut.clear();
    world.connect();
    world.run(Duration::from_secs(3));
    assert!(world.agrees());
    assert_eq!(world.df_entries(1).len(), 1);
    world.say_goodbye();
    assert!(world.df_entries(1).is_empty());
}

#[test]
fn df_entries_are_renewed_before_they_end() {
    let mut world = World::new(2, 12);
    for (name, lease) in [("crane", None), ("arm", Some(100_000)), ("rover", Some(50))] {
        world.join(0, name);
        world.describe(0, name, name, lease.map(Duration::from_secs));
    }
    world.connect();
    let hour = Exchange::MAX_DF_LEASE;
    for _ in 0..50 {
        world.run(hour / 10);
        for entry in world.gateways[1].exchange.directory().df_entries() {
            let time_left = entry.ends.saturating_duration_since(world.now);
            match &*entry.name {
                // Its lease is not renewed; the directory facilitator there removes it.
                "rover" => assert!(time_left.is_zero()),
                name => {
                    assert!(
                        time_left > hour / 2 && time_left <= hour,
                        "{name}: {time_left:?}"
                    );
                    assert_eq!(entry.has_lease, name == "arm");
                }
            }
        }
    }
    assert!(world.sent < 4000, "{} letters", world.sent);
}

#[test]
fn large_df_entries_take_several_letters() {
    let mut world = World::new(2, 13);
    let count = Exchange::MAX_DF_BYTES / Exchange::MAX_DF_ENTRY;
    for number in 0..count {
        let name = format!("agent_{number}");
        world.join(0, &name);
        // Each character takes six in a letter.
        let text = "\u{1}".repeat(Exchange::MAX_DF_ENTRY);
        world.describe(0, &name, &text, None);
    }
    world.connect();
    world.run(Duration::from_secs(2));
    assert!(world.agrees());
    assert_eq!(world.df_entries(1).len(), count);
}

#[test]
fn hundreds_that_start_at_once_make_few_letters() {
    let mut world = World::new(2, 2);
    world.connect();
    world.run(Duration::from_millis(500));
    let before = world.sent;
    for number in 0..500 {
        world.join(0, &format!("zero_{number}"));
        world.join(1, &format!("one_{number}"));
        world.step();
    }
    world.run(Duration::from_secs(2));
    assert!(world.agrees());
    let letters = world.sent - before;
    assert!(letters <= 12, "{letters} letters");
    // Without changes, few letters are sent.
    let before = world.sent;
    world.run(Duration::from_secs(60));
    let letters = world.sent - before;
    assert!((2..=10).contains(&letters), "{letters} letters");
}

#[test]
fn many_agents_take_several_letters_and_may_change_meanwhile() {
    let mut world = World::new(2, 3);
    for number in 0..600 {
        world.appear(0, &format!("agent_{number:04}"));
    }
    world.join(0, "last");
    world.connect();
    for number in 0..60 {
        world.run(Duration::from_millis(5));
        world.leave(0, &format!("agent_{:04}", number * 7));
        world.join(0, &format!("between_{number}"));
    }
    world.run(Duration::from_secs(2));
    assert!(world.agrees());
    // More changes than the log holds happen before a letter arrives.
    world.cut.push((0, 1));
    for _ in 0..8 {
        for number in 0..600 {
            world.appear(0, &format!("agent_{number:04}"));
        }
        world.join(0, "last");
    }
    world.cut.clear();
    world.run(Duration::from_secs(12));
    assert!(world.agrees());
}

#[test]
fn a_list_of_which_parts_arrived_and_were_not_read_is_sent_again() {
    for seed in 0..20 {
        let mut world = World::new(3, seed);
        for number in 0..900 {
            world.appear(0, &format!("agent_{number:04}"));
        }
        world.join(0, "last");
        world.connect();
        world.unread = 0.4;
        for number in 0..20 {
            world.run(Duration::from_millis(200));
            world.leave(0, &format!("agent_{:04}", number * 7));
            world.join(1, &format!("between_{number}"));
        }
        // Also if no agent changes afterwards.
        world.unread = 0.0;
        world.run(Duration::from_secs(3));
        assert!(world.agrees(), "seed {seed}");
    }
}

#[test]
fn the_kind_of_a_letter_is_read_from_its_beginning() {
    let (mut exchange, now) = (with_neighbor(), Instant::now());
    let mut kinds = Vec::new();
    let mut send = |exchange: &mut Exchange, now| {
        let (to, content) = exchange.poll_letter(now).unwrap();
        exchange.handle_sent(now, to, true);
        kinds.push(Exchange::letter_kind(&content));
    };
    // The second part of a list follows at once, then changes.
    let mut world = World::new(1, 1);
    for number in 0..300 {
        world.appear(0, &format!("agent_{number:04}"));
    }
    exchange.handle_own(now, world.gateways[0].agents.values());
    let later = now + Duration::from_secs(1);
    send(&mut exchange, later);
    send(&mut exchange, later);
    send(&mut exchange, later + Duration::from_secs(60));
    let (_, goodbye) = exchange.goodbye();
    kinds.push(Exchange::letter_kind(&goodbye));
    let expected = [
        LetterKind::NewList,
        LetterKind::List,
        LetterKind::List,
        LetterKind::Other,
    ];
    assert_eq!(kinds, expected);
    for other in ["", "{}", r#"{"version":1,"tell":"again"}"#] {
        assert_eq!(Exchange::letter_kind(other.as_bytes()), LetterKind::Other);
    }
}

#[test]
fn entries_leave_with_their_gateway() {
    let mut world = World::new(2, 4);
    world.join(0, "arm");
    world.connect();
    world.run(Duration::from_millis(300));
    let directory = world.gateways[1].exchange.directory();
    assert!(directory.lookup("arm").is_some());
    // A brief disconnect has no effect.
    let now = world.now;
    world.gateways[1].exchange.handle_neighbors(now, &[]);
    world.run(Exchange::MEMORY / 2);
    assert!(directory.lookup("arm").is_some());
    world.connect();
    world.run(Exchange::MEMORY * 2);
    assert!(directory.lookup("arm").is_some());
    let now = world.now;
    world.gateways[1].exchange.handle_neighbors(now, &[]);
    world.run(Exchange::MEMORY + Duration::from_millis(10));
    assert!(directory.lookup("arm").is_none());
    // It reconnects, without having noticed the disconnect.
    world.connect();
    world.run(Duration::from_secs(20));
    assert!(world.agrees());
    // A goodbye removes the agents at once.
    assert_eq!(world.say_goodbye(), [Incarnation::from_u64(2)]);
    assert!(directory.lookup("arm").is_none());
}

#[test]
fn agents_of_a_gateway_that_is_gone_are_lost_for_an_hour() {
    let mut world = World::new(2, 4);
    world.join(0, "arm");
    world.join(0, "leg");
    world.connect();
    world.run(Duration::from_millis(300));
    let directory = world.gateways[1].exchange.directory();
    let lost = |name: &str| directory.view().lost_agent(name);
    let at = directory.lookup("arm").unwrap().locations.clone();
    let disconnect = |world: &mut World| {
        let now = world.now;
        world.gateways[1].exchange.handle_neighbors(now, &[]);
        assert!(lost("arm").is_none(), "a broken connection may return");
        world.run(Exchange::MEMORY + Duration::from_millis(10));
    };
    disconnect(&mut world);
    assert!(directory.lookup("arm").is_none());
    let seen = lost("arm").unwrap();
    assert_eq!(seen.locations, at);
    let ago = seen.registered.elapsed().unwrap();
    assert!(
        ago >= Exchange::MEMORY,
        "its gateway was last seen before: {ago:?}"
    );
    assert!(lost("leg").is_some() && lost("wheel").is_none());
    assert_eq!(directory.view().lost_agents().len(), 2);
    world.run(Exchange::LOST);
    assert!(directory.view().lost_agents().is_empty());

    // An agent that left in the meantime does not exist after its gateway has returned.
    world.connect();
    world.run(Duration::from_secs(20));
    disconnect(&mut world);
    assert_eq!(directory.view().lost_agents().len(), 2);
    world.leave(0, "leg");
    world.connect();
    world.run(Duration::from_secs(20));
    assert!(directory.lookup("arm").is_some() && directory.lookup("leg").is_none());
    assert!(directory.view().lost_agents().is_empty());

    // The agents of a gateway that says goodbye are lost at once.
    world.say_goodbye();
    assert!(directory.lookup("arm").is_none() && lost("arm").is_some());
    let now = world.now;
    world.gateways[1].exchange.handle_neighbors(now, &[]);
    world.run(Exchange::MEMORY * 2);
    assert_eq!(directory.view().lost_agents().len(), 1);
}

/// Also those that another directory has, while the connection has not ended yet.
#[test]
fn entries_of_a_gateway_without_trust_end_at_once() {
    let mut world = World::new(2, 4);
    let certificate = |number| Principal::Certificate([number; 32]);
    world.proofs[0] = (Mandate::Certified([].into()), certificate(1), Vec::new());
    world.join(0, "arm");
    world.describe(0, "arm", "gripping", None);
    world.connect();
    world.run(Duration::from_millis(300));
    let gateway = Incarnation::from_u64(1);
    let contacts = Arc::new(ContactDirectory::new());
    let recorded = contacts.record_sender(
        world.now,
        "leg",
        Incarnation::from_u64(7),
        location(0).with_incarnation(gateway),
    );
    assert_eq!(recorded, Ok(None));
    let directory = world.gateways[1].exchange.directory();
    let all = MergedDirectory::new(vec![
        Arc::clone(&contacts) as _,
        Arc::clone(&directory) as _,
    ]);
    let lists = |name: &str| all.lookup(name).is_some();
    assert!(lists("arm") && lists("leg"));

    let withdraw = |world: &mut World, number: Option<u8>| {
        let gateways = number.map(|number| (gateway, certificate(number)));
        world.gateways[1].exchange.handle_withdrawn(gateways);
    };
    withdraw(&mut world, Some(1));
    assert!(!lists("arm") && !lists("leg"));
    assert!(world.df_entries(1).is_empty());
    world.connect();
    world.run(Duration::from_secs(20));
    assert!(!lists("arm") && !lists("leg"));
    assert!(
        directory.view().lost_agents().is_empty(),
        "a lost agent may return"
    );

    // Trust that is restored.
    withdraw(&mut world, None);
    assert!(lists("leg"));
    world.connect();
    world.run(Duration::from_secs(20));
    assert!(lists("arm"));
    // The service of another certificate.
    withdraw(&mut world, Some(2));
    assert!(lists("arm") && lists("leg"));
    withdraw(&mut world, Some(1));
    world.proofs[0].1 = certificate(2);
    world.connect();
    world.run(Duration::from_secs(20));
    assert!(lists("arm") && lists("leg"));

    contacts.withdraw(&[gateway].into());
    assert!(lists("arm") && !lists("leg"));
}

/// A gateway that is killed and restarted has another incarnation at the same location: the entries
/// of the old one are removed with the first letter of the new one.
#[test]
fn another_incarnation_at_a_location_replaces_the_one_that_is_gone() {
    let mut world = World::new(2, 4);
    world.join(0, "arm");
    world.connect();
    world.run(Duration::from_millis(300));
    let directory = world.gateways[1].exchange.directory();
    let old = world.gateways[0].mts.incarnation;
    let gateway = || directory.lookup("arm").map(|entry| entry.mts.incarnation);
    assert_eq!(gateway(), Some(old));

    let new = Incarnation::from_u64(77);
    let at = location(0).with_incarnation(new);
    let known = Present::unproved(world.gateways[0].mts.clone(), vec![location(0)]);
    let restarted = Present::unproved(MtsId::new("same-name-mts", new), vec![at]);
    let letter = br#"{"version":1,"tell":{"full":{"version":1,"first":true,"last":true,"agents":
        [{"name":"arm","type":"arm","id":"00000000000003e9","registered":1001}]}}}"#;
    let now = world.now;
    let exchange = &mut world.gateways[1].exchange;
    // A connection with the old one appears open: its entries stay.
    exchange.handle_neighbors(now, &[known, restarted.clone()]);
    exchange.handle_letter(now, new, letter).unwrap();
    assert!(directory.speaks_for(old));
    // It ends: its entries leave at once, and those of the new one are there.
    exchange.handle_neighbors(now, std::slice::from_ref(&restarted));
    assert!(!directory.speaks_for(old));
    assert_eq!(gateway(), Some(new));

    // The connection with the old one ends first: its entries stay until the new one has sent its
    // own.
    let newer = Incarnation::from_u64(78);
    let at = location(0).with_incarnation(newer);
    let started_again = Present::unproved(MtsId::new("same-name-mts", newer), vec![at]);
    exchange.handle_neighbors(now, &[]);
    exchange.handle_neighbors(now, std::slice::from_ref(&started_again));
    assert_eq!(gateway(), Some(new));
    exchange.handle_letter(now, newer, letter).unwrap();
    assert_eq!(gateway(), Some(newer));
    assert!(!directory.speaks_for(new));

    // The connection with the old one appears open, but it does not answer.
    let newest = Incarnation::from_u64(79);
    let at = location(0).with_incarnation(newest);
    let both = [
        started_again,
        Present::unproved(MtsId::new("same-name-mts", newest), vec![at]),
    ];
    exchange.handle_neighbors(now, &both);
    let silent = location(0).with_incarnation(newer);
    assert!(!exchange.handle_silence(now, &silent));
    assert_eq!(
        gateway(),
        Some(newer),
        "no other gateway has sent its agents"
    );
    exchange.handle_letter(now, newest, letter).unwrap();
    assert!(exchange.handle_silence(now, &silent));
    assert!(!directory.speaks_for(newer));
    assert_eq!(gateway(), Some(newest));
    // It is asked for its agents, in case that it is still running.
    let later = now + Duration::from_secs(1);
    let asked: Vec<_> = std::iter::from_fn(|| exchange.poll_letter(later)).collect();
    assert!(asked.iter().any(|(to, _)| *to == newer), "{asked:?}");
}

/// An announcement by multicast may be newer than the entries of a disconnected gateway.
#[test]
fn agents_of_a_disconnected_gateway_are_dropped_if_another_directory_has_them() {
    let mut world = World::new(2, 4);
    world.join(0, "arm");
    world.join(0, "leg");
    world.connect();
    world.run(Duration::from_millis(300));
    let directory = world.gateways[1].exchange.directory();
    let (is_arm, now) = (|entry: &Entry| &*entry.name == "arm", world.now);
    let exchange = &mut world.gateways[1].exchange;
    exchange.leave_to_others(is_arm);
    assert!(
        directory.lookup("arm").is_some(),
        "the gateway is connected"
    );
    exchange.handle_neighbors(now, &[]);
    exchange.leave_to_others(is_arm);
    assert!(directory.lookup("arm").is_none());
    assert!(directory.lookup("leg").is_some());
    world.connect();
    world.run(Duration::from_millis(1500));
    assert!(world.agrees());
}

/// A letter may arrive before its sender is reported as connected.
#[test]
fn entries_that_arrived_too_early_are_requested_again() {
    let mut world = World::new(2, 6);
    world.join(0, "arm");
    let now = world.now;
    let present = [Present::unproved(
        world.gateways[1].mts.clone(),
        vec![location(1)],
    )];
    world.gateways[0].exchange.handle_neighbors(now, &present);
    world.run(Duration::from_millis(200));
    assert!(!world.agrees());
    world.connect();
    world.run(Duration::from_millis(1500));
    assert!(world.agrees());
}

/// A peer can connect under many incarnations, and send letters that arrive before these are reported as connected.
#[test]
fn gateways_that_never_become_neighbors_keep_no_others_from_being_asked() {
    let mut world = World::new(2, 6);
    world.join(0, "arm");
    let now = world.now;
    let again = br#"{"version":1,"tell":"again"}"#;
    for stranger in 0..10_000 {
        let stranger = Incarnation::from_u64(1_000_000 + stranger);
        let result = world.gateways[1]
            .exchange
            .handle_letter(now, stranger, again);
        assert!(matches!(result, Err(ExchangeError::NotConnected)));
    }
    let present = [Present::unproved(
        world.gateways[1].mts.clone(),
        vec![location(1)],
    )];
    world.gateways[0].exchange.handle_neighbors(now, &present);
    world.run(Duration::from_millis(200));
    assert!(!world.agrees());
    world.connect();
    world.run(Duration::from_millis(1500));
    assert!(world.agrees());
}

/// A small letter costs no copy of all agents of its sender.
#[test]
fn the_agents_of_a_gateway_are_bounded_also_by_changes() {
    let mut exchange = with_neighbor();
    let from = Incarnation::from_u64(7);
    let agent = |number: usize| {
        format!(
            r#"{{"name":"agent_{number}","id":"{:016x}","registered":0}}"#,
            100 + number
        )
    };
    let tell = |exchange: &mut Exchange, text: String| {
        exchange.handle_letter(Instant::now(), from, text.as_bytes())
    };
    let first =
        r#"{"version":1,"tell":{"full":{"version":0,"first":true,"last":true,"agents":[]}}}"#;
    tell(&mut exchange, first.to_owned()).unwrap();
    let mut version = 0;
    let mut change = |exchange: &mut Exchange, joined: &[usize], removed: &[usize]| {
        let joined: Vec<String> = joined.iter().map(|number| agent(*number)).collect();
        let removed: Vec<String> = removed
            .iter()
            .map(|it| format!(r#""agent_{it}""#))
            .collect();
        let (joined, removed, next) = (joined.join(","), removed.join(","), version + 1);
        let result = tell(
            exchange,
            format!(
                r#"{{"version":1,"tell":{{"changes":{{"from":{version},"to":{next},"agents":[{joined}],"left":[{removed}]}}}}}}"#
            ),
        );
        if result.is_ok() {
            version = next;
        }
        result
    };
    let all: Vec<usize> = (0..Exchange::MAX_AGENTS).collect();
    for part in all.chunks(1000) {
        change(&mut exchange, part, &[]).unwrap();
    }
    let directory = exchange.directory();
    let listed = directory.entries().len();
    // The names are charged, too.
    assert!(
        (Exchange::MAX_AGENTS * 19 / 20..Exchange::MAX_AGENTS).contains(&listed),
        "{listed}"
    );
    // One that leaves and returns, one that is named twice, and unknown ones.
    change(&mut exchange, &[3, 4, 4], &[3, 3, 1_000_000]).unwrap();
    assert_eq!(directory.entries().len(), listed);
    change(&mut exchange, &[20_000], &[5, 1_000_000]).unwrap();
    assert_eq!(directory.entries().len(), listed);
    assert!(directory.known("agent_5").is_none());
    assert!(directory.known("agent_3").is_some());
    assert!(directory.known("agent_20000").is_some());
}

#[test]
fn the_agents_of_a_gateway_follow_its_location() {
    let mut world = World::new(2, 5);
    world.join(0, "arm");
    world.connect();
    world.run(Duration::from_millis(300));
    let elsewhere: Location = "tcp://10.0.0.99:1#0000000000000001".parse().unwrap();
    let (mts, now) = (world.gateways[0].mts.clone(), world.now);
    let present = [Present::unproved(mts, vec![elsewhere.clone()])];
    world.gateways[1].exchange.handle_neighbors(now, &present);
    let entry = world.gateways[1]
        .exchange
        .directory()
        .lookup("arm")
        .unwrap();
    assert_eq!(entry.locations, [elsewhere]);
}

/// The peer decides how often its connections begin and end, and at which addresses.
#[test]
fn the_agents_of_a_gateway_that_moves_all_the_time_follow_at_a_rate() {
    let mut world = World::new(2, 5);
    for number in 0..300 {
        world.join(0, &format!("agent_{number}"));
    }
    world.connect();
    world.run(Duration::from_secs(2));
    let mts = world.gateways[0].mts.clone();
    let (mut now, exchange) = (world.now, &mut world.gateways[1].exchange);
    let directory = exchange.directory();
    assert_eq!(directory.entries().len(), 300);
    let at = |port: u16| -> Vec<Location> {
        let text = format!("tcp://10.0.0.99:{port}#0000000000000001");
        vec![text.parse().unwrap()]
    };
    let is_moved_to = |now: Instant, port: u16, exchange: &mut Exchange| {
        exchange.handle_neighbors(now, &[Present::unproved(mts.clone(), at(port))]);
        directory.lookup("agent_0").unwrap().locations == at(port)
    };
    let moves = (1..=100).filter(|port| is_moved_to(now, *port, exchange));
    let moves = moves.count();
    // One from the former address, four from the other one.
    assert_eq!(moves, 5);
    while exchange.poll_letter(now).is_some() {}
    // They follow to the last place.
    let due = exchange.poll_timeout().unwrap();
    assert!(now < due && due < now + Duration::from_secs(1));
    now = due;
    assert!(is_moved_to(now, 100, exchange));
    // The wait ends with the connection.
    assert!(is_moved_to(now + Duration::from_secs(9), 101, exchange));
    now += Duration::from_secs(9);
    while is_moved_to(now, 102, exchange) && is_moved_to(now, 103, exchange) {}
    exchange.handle_neighbors(now, &[]);
    assert!(
        exchange
            .poll_timeout()
            .is_some_and(|due| due >= now + Exchange::MEMORY)
    );
}

/// Links are disconnected and restored in random order; the gateways notice, or not.
#[test]
fn after_every_healing_all_agree_within_ten_seconds() {
    let seeds = std::env::var("FIPA_SIM_SEEDS")
        .ok()
        .and_then(|seeds| seeds.parse().ok());
    for seed in 0..seeds.unwrap_or(40) {
        let mut world = World::new(4, seed);
        world.connect();
        for round in 0..6 {
            for _ in 0..world.random.usize(0..4) {
                let (one, other) = (world.random.usize(0..4), world.random.usize(0..4));
                if one != other {
                    world.cut.push((one.min(other), one.max(other)));
                }
            }
            let noticed = world.random.bool();
            if noticed {
                world.connect();
            }
            for _ in 0..world.random.usize(0..30) {
                let index = world.random.usize(0..4);
                // Includes names that several gateways claim.
                let name = format!("agent_{}", world.random.usize(0..20));
                if world.random.bool() {
                    world.join(index, &name);
                    if world.random.bool() {
                        let text = format!("{index} {name} {round}");
                        world.describe(index, &name, &text, None);
                    }
                } else {
                    world.leave(index, &name);
                }
                let pause = world.random.u64(0..400);
                world.run(Duration::from_millis(pause));
            }
            world.cut.clear();
            world.connect();
            world.run(Duration::from_secs(10));
            assert!(world.agrees(), "FIPA_SIM_SEEDS: seed {seed}, round {round}");
        }
    }
}

#[test]
fn after_a_split_each_host_keeps_the_agent_that_was_announced_to_it_first() {
    for ahead in [0, 1_000_000_000] {
        let mut world = World::new(3, 6);
        // The clock of the second host, or those of the others, stand at 1970.
        world.clocks = vec![ahead, 1_000_000_000 - ahead, ahead];
        world.cut = vec![(0, 1), (1, 2)];
        world.connect();
        world.join(0, "arm");
        world.run(Duration::from_secs(1));
        world.join(1, "arm");
        world.run(Duration::from_secs(1));
        world.cut.clear();
        world.connect();
        world.run(Duration::from_secs(10));
        let owner = |world: &World, at| world.holder(at, "arm").map(|(owner, _)| owner);
        // The two hosts know of each other's agent, and report it.
        let owners = [0, 1, 2].map(|at| owner(&world, at));
        assert_eq!(owners, [Some(1), Some(0), Some(0)]);
        let contested = world.gateways[2].exchange.directory().contested();
        assert_eq!(contested.len(), 1);
        let (holder, other) = &contested[0];
        let of = |entry: &Arc<Entry>| entry.mts.incarnation.as_u64() - 1;
        assert_eq!((of(holder), of(other)), (0, 1));
        // A cut of less than the time after which a host is lost changes nothing.
        world.cut = vec![(0, 2)];
        world.connect();
        world.run(Exchange::MEMORY / 2);
        assert_eq!(owner(&world, 2), Some(0));
        world.cut.clear();
        world.connect();
        world.run(Duration::from_secs(10));
        assert_eq!(owner(&world, 2), Some(0));
        // A lost host has lost the name.
        world.cut = vec![(0, 2)];
        world.connect();
        world.run(Exchange::MEMORY + Duration::from_millis(10));
        assert_eq!(owner(&world, 2), Some(1));
        world.cut.clear();
        world.connect();
        world.run(Duration::from_secs(10));
        assert_eq!(owner(&world, 2), Some(1));
        world.leave(1, "arm");
        world.run(Duration::from_secs(1));
        assert_eq!(owner(&world, 2), Some(0));
        assert_eq!(world.gateways[2].exchange.directory().contested(), []);
    }
}

/// Hosts with any clocks register agents with a few names; links break for a moment.
#[test]
fn a_name_moves_only_after_its_agent_has_left() {
    const NAMES: usize = 4;
    for seed in 0..40 {
        let mut world = World::new(4, seed);
        world.clocks = (0..4).map(|_| world.random.u64(0..2_000_000)).collect();
        world.connect();
        let mut before = BTreeMap::new();
        for _ in 0..150 {
            let (index, name) = (world.random.usize(0..4), world.random.usize(0..NAMES));
            let name = format!("agent_{name}");
            match world.random.u32(0..5) {
                0 | 1 if !world.gateways[index].agents.contains_key(&name) => {
                    world.join(index, &name);
                }
                2 => world.leave(index, &name),
                3 => {
                    let other = (index + 1) % 4;
                    world.cut = vec![(index.min(other), index.max(other))];
                    if world.random.bool() {
                        world.connect();
                    }
                    let ms = world.random.u64(1..4000);
                    world.run(Duration::from_millis(ms));
                    world.cut.clear();
                    world.connect();
                }
                _ => {}
            }
            let ms = world.random.u64(0..300);
            world.run(Duration::from_millis(ms));
            for at in 0..4 {
                for name in (0..NAMES).map(|name| format!("agent_{name}")) {
                    let now = world.holder(at, &name);
                    let key = (at, name);
                    let was = before.get(&key).copied().flatten();
                    if let Some((owner, agent)) = was
                        && now != was
                    {
                        let agents: &BTreeMap<String, Arc<Entry>> = &world.gateways[owner].agents;
                        let stays = agents.get(&key.1).is_some_and(|it| it.incarnation == agent);
                        assert!(!stays, "seed {seed}: {key:?} went from {was:?} to {now:?}");
                    }
                    before.insert(key, now);
                }
            }
        }
        world.run(Duration::from_secs(10));
        assert!(world.agrees(), "seed {seed}");
    }
}

fn handle(exchange: &mut Exchange, content: &str) -> Result<(), ExchangeError> {
    let from = Incarnation::from_u64(7);
    exchange.handle_letter(Instant::now(), from, content.as_bytes())
}

fn with_neighbor() -> Exchange {
    let mut exchange = Exchange::new(0);
    let mts = MtsId::new("hostile", Incarnation::from_u64(7));
    exchange.handle_neighbors(Instant::now(), &[Present::unproved(mts, vec![location(6)])]);
    exchange
}

#[test]
fn unknown_senders_and_malformed_letters_are_rejected() {
    let mut exchange = with_neighbor();
    let stranger = Incarnation::from_u64(8);
    let again = br#"{"version":1,"tell":"again"}"#;
    assert!(matches!(
        exchange.handle_letter(Instant::now(), stranger, again),
        Err(ExchangeError::NotConnected)
    ));
    for nonsense in [
        "",
        "again",
        r#"{"version":2,"tell":"again"}"#,
        r#"{"version":1,"tell":"nothing"}"#,
        r#"{"version":1,"tell":{"full":{"version":1}}}"#,
        &format!("{}1{}", "[".repeat(100_000), "]".repeat(100_000)),
    ] {
        assert!(matches!(
            handle(&mut exchange, nonsense),
            Err(ExchangeError::Malformed(_))
        ));
    }
    let large = " ".repeat(Exchange::MAX_CONTENT + 1);
    assert!(matches!(
        handle(&mut exchange, &large),
        Err(ExchangeError::TooLarge(_))
    ));
    assert!(exchange.directory().entries().is_empty());
}

#[test]
fn invalid_agents_are_left_out() {
    let mut exchange = with_neighbor();
    let agents = r#"[{"name":"","id":"0000000000000001","registered":1},
        {"name":"a\nb","id":"0000000000000001","registered":1},
        {"name":"arm_.*","id":"0000000000000001","registered":1},
        {"name":"arm\u202eleft","id":"0000000000000001","registered":1},
        {"name":"arm\u009b31m","id":"0000000000000001","registered":1},
        {"name":"absent","id":"0000000000000000","registered":1},
        {"name":"good","id":"0000000000000001","registered":99999999999999999,"more":[]}]"#;
    let full = format!(
        r#"{{"version":1,"tell":{{"full":{{"version":0,"first":true,"last":true,"agents":{agents}}}}}}}"#
    );
    handle(&mut exchange, &full).unwrap();
    let entries = exchange.directory().entries();
    assert_eq!(entries.len(), 1);
    assert_eq!(&*entries[0].name, "good");
    assert_eq!(entries[0].locations, [location(6)]);
}

#[test]
fn the_number_of_agents_of_a_neighbor_is_bounded() {
    let mut exchange = with_neighbor();
    let part = |part: usize, last: bool| {
        let agents: Vec<String> = (0..5000)
            .map(|number| {
                format!(
                    r#"{{"name":"agent {part} {number}","id":"{:016x}","registered":1}}"#,
                    number + 1
                )
            })
            .collect();
        let (first, agents) = (part == 0, agents.join(","));
        format!(
            r#"{{"version":1,"tell":{{"full":{{"version":9,"first":{first},"last":{last},"agents":[{agents}]}}}}}}"#
        )
    };
    for (number, last) in [(0, false), (1, false), (2, true)] {
        handle(&mut exchange, &part(number, last)).unwrap();
    }
    let listed = exchange.directory().entries();
    assert!(
        (4500..=Exchange::MAX_AGENTS).contains(&listed.len()),
        "{}",
        listed.len()
    );
    assert!(
        listed
            .iter()
            .all(|entry| entry.name.starts_with("agent 0 "))
    );
    // A part of an unknown list does not fit the stored state, and all entries are requested.
    handle(&mut exchange, &part(3, true)).unwrap();
    assert_eq!(exchange.directory().entries().len(), listed.len());
    let now = Instant::now() + Duration::from_millis(1);
    let (to, question) = exchange.poll_letter(now).unwrap();
    assert_eq!(to, Incarnation::from_u64(7));
    assert_eq!(question, br#"{"version":1,"tell":"again"}"#);
    // Frequent requests are answered at a limited rate.
    exchange.handle_sent(now, to, true);
    let mut answers = 0;
    for millis in 0..3000 {
        let now = now + Duration::from_millis(millis);
        let again = br#"{"version":1,"tell":"again"}"#;
        exchange.handle_letter(now, to, again).unwrap();
        while exchange.poll_letter(now).is_some() {
            answers += 1;
            exchange.handle_sent(now, to, true);
        }
    }
    assert!((2..=4).contains(&answers), "{answers}");
    // The number of neighbors is limited.
    let crowd: Vec<_> = (0..2000)
        .map(|number| {
            Present::unproved(
                MtsId::new("x", Incarnation::from_u64(number + 1)),
                vec![location(0)],
            )
        })
        .collect();
    exchange.handle_neighbors(now, &crowd);
    let (known, _) = exchange.goodbye();
    assert_eq!(known.len(), Exchange::MAX_NEIGHBORS);
}

/// Returns the letters with all agents of a gateway: `count` names that begin with `prefix`, with descriptions of
/// this length.
fn full(prefix: &str, count: usize, description: usize) -> Vec<String> {
    let names: Vec<String> = (0..count)
        .map(|number| format!("{prefix}{number}"))
        .collect();
    let description = "d".repeat(description);
    let parts = names.chunks(300).collect::<Vec<_>>();
    let letter = |(number, part): (usize, &&[String])| {
        let agents = part.iter().map(|name| {
            let id: u64 = name.bytes().fold(7, |id, byte| id * 31 % 0x7fff_ffff_ffff + u64::from(byte));
            format!(
                r#"{{"name":"{name}","id":"{id:016x}","description":"{description}","registered":1}}"#
            )
        });
        let agents: Vec<String> = agents.collect();
        let (first, last) = (number == 0, number + 1 == parts.len());
        format!(
            r#"{{"version":1,"tell":{{"full":{{"version":1,"first":{first},"last":{last},"agents":[{}]}}}}}}"#,
            agents.join(",")
        )
    };
    parts.iter().enumerate().map(letter).collect()
}

/// Neighbors at these hosts, with incarnations from 1.
fn present(hosts: impl IntoIterator<Item = usize>) -> Vec<Present> {
    let present = hosts.into_iter().enumerate().map(|(number, host)| {
        let incarnation = Incarnation::from_u64(number as u64 + 1);
        let at = format!("tcp://10.0.{}.{}:{}", host / 256, host % 256, number + 1);
        let at = at
            .parse::<Location>()
            .unwrap()
            .with_incarnation(incarnation);
        Present::unproved(MtsId::new("x", incarnation), vec![at])
    });
    present.collect()
}

fn count(exchange: &Exchange, prefix: &str) -> usize {
    let entries = exchange.directory().entries();
    entries
        .iter()
        .filter(|it| it.name.starts_with(prefix))
        .count()
}

fn tell_all(exchange: &mut Exchange, from: u64, letters: &[String]) {
    for letter in letters {
        let from = Incarnation::from_u64(from);
        exchange
            .handle_letter(Instant::now(), from, letter.as_bytes())
            .unwrap();
    }
}

#[test]
fn peers_with_the_longest_lists_are_cut_and_a_small_one_is_complete() {
    let mut exchange = Exchange::new(0);
    // Twelve hosts, and four more gateways at the last of them.
    let now = Instant::now();
    exchange.handle_neighbors(now, &present((0..12).chain([11; 4])));
    for liar in 2..=16 {
        tell_all(
            &mut exchange,
            liar,
            &full(&format!("liar-{liar}-"), 3000, 1000),
        );
    }
    tell_all(&mut exchange, 1, &full("honest-", 50, 100));
    assert_eq!(count(&exchange, "honest-"), 50);
    // Eleven hosts share what is left.
    let lists: Vec<usize> = (2..=16)
        .map(|it| count(&exchange, &format!("liar-{it}-")))
        .collect();
    let of_host = lists[0];
    assert!((900..1100).contains(&of_host), "{lists:?}");
    assert!(
        lists[..10].iter().all(|it| it.abs_diff(of_host) <= 1),
        "{lists:?}"
    );
    let at_last: usize = lists[10..].iter().sum();
    assert!(at_last.abs_diff(of_host) <= 5, "{lists:?}");
    // Changes are bounded as well, and the honest agents stay.
    let more: Vec<String> = full("more-", 300, 1000);
    let changes = more[0].replace(
        r#""full":{"version":1,"first":true,"last":true,"#,
        r#""changes":{"from":1,"to":2,"#,
    );
    tell_all(&mut exchange, 5, &[changes]);
    assert_eq!(count(&exchange, "honest-"), 50);
    let after = count(&exchange, "liar-5-") + count(&exchange, "more-");
    assert!(after <= of_host + 10, "{after} after {of_host}");
    // A list that was cut is requested again when others left.
    let later = now + Duration::from_secs(60);
    exchange.handle_neighbors(later, &present([0, 1, 2]));
    while let Some((to, _)) = exchange.poll_letter(later) {
        exchange.handle_sent(later, to, true);
    }
    exchange.handle_timeout(later + Exchange::MEMORY);
    exchange.handle_timeout(later + Exchange::MEMORY);
    let asked = |exchange: &mut Exchange| {
        let mut asked = Vec::new();
        let end = later + Exchange::MEMORY;
        while let Some((to, letter)) = exchange.poll_letter(end) {
            if letter == br#"{"version":1,"tell":"again"}"# {
                asked.push(to.as_u64());
            }
            exchange.handle_sent(end, to, true);
        }
        asked.sort_unstable();
        asked
    };
    assert_eq!(asked(&mut exchange), [2, 3]);
    tell_all(&mut exchange, 2, &full("liar-2-", 3000, 1000));
    assert!(count(&exchange, "liar-2-") > 1300);
    exchange.handle_timeout(later + Duration::from_secs(60));
    assert_eq!(count(&exchange, "honest-"), 50);
    assert_eq!(asked(&mut exchange), [] as [u64; 0]);
}

#[test]
fn gateways_of_one_host_keep_no_other_host_from_being_a_neighbor() {
    let mut exchange = Exchange::new(0);
    let hosts = std::iter::repeat_n(1, Exchange::MAX_NEIGHBORS).chain([2, 3, 2]);
    let all = present(hosts);
    let (crowd, others) = all.split_at(Exchange::MAX_NEIGHBORS);
    exchange.handle_neighbors(Instant::now(), crowd);
    tell_all(&mut exchange, 1, &full("crowd-", 10, 0));
    for _ in 0..3 {
        exchange.handle_neighbors(Instant::now(), &all);
        let (known, _) = exchange.goodbye();
        assert_eq!(known.len(), Exchange::MAX_NEIGHBORS);
        assert!(others.iter().all(|it| known.contains(&it.mts.incarnation)));
    }
    assert_eq!(count(&exchange, "crowd-"), 10);
}

#[test]
fn incomplete_lists_of_many_neighbors_are_bounded() {
    let mut exchange = Exchange::new(0);
    exchange.handle_neighbors(Instant::now(), &present(0..20));
    let never_ends: Vec<String> = full("x", 3000, 1000);
    for liar in 2..=20 {
        tell_all(&mut exchange, liar, &never_ends[..9]);
    }
    let honest = full("honest-", 700, 100);
    tell_all(&mut exchange, 1, &honest[..1]);
    for liar in 2..=20 {
        tell_all(&mut exchange, liar, &never_ends[..9]);
    }
    tell_all(&mut exchange, 1, &honest[1..]);
    assert_eq!(count(&exchange, ""), 700);
}

/// Transports close a connection after 60 s without a letter.
#[test]
fn a_neighbor_gets_a_letter_every_15_seconds_without_changes() {
    let start = Instant::now();
    let mut exchange = Exchange::new(0);
    exchange.handle_neighbors(start, &present([0]));
    let (mut now, mut times) = (start, Vec::new());
    while now < start + Duration::from_secs(120) {
        now = exchange.poll_timeout().unwrap().max(now);
        exchange.handle_timeout(now);
        while let Some((to, _)) = exchange.poll_letter(now) {
            times.push(now);
            exchange.handle_sent(now, to, true);
        }
    }
    let pauses = times.windows(2).map(|pair| pair[1] - pair[0]);
    assert!(times.len() > 7 && pauses.max() <= Some(Duration::from_secs(15)));
}

#[test]
fn an_incomplete_list_ends_unless_it_grows() {
    let start = Instant::now();
    let letters = full("arm-", 900, 0);
    let from = Incarnation::from_u64(1);
    let connected = || {
        let mut exchange = Exchange::new(0);
        exchange.handle_neighbors(start, &present([0]));
        // The own list goes to the neighbor.
        let first = start + Duration::from_secs(1);
        assert!(exchange.poll_letter(first).is_some());
        exchange.handle_sent(first, from, true);
        exchange
    };
    let pause = Duration::from_secs(50);

    let mut slow = connected();
    let mut now = start;
    for letter in &letters {
        now += pause;
        slow.handle_timeout(now);
        slow.handle_letter(now, from, letter.as_bytes()).unwrap();
    }
    assert_eq!(count(&slow, ""), 900);

    let mut stopped = connected();
    let at = |seconds| start + Duration::from_secs(seconds);
    stopped
        .handle_letter(at(1), from, letters[0].as_bytes())
        .unwrap();
    // Repeated agents are no progress.
    let more = letters[0].replace(r#""first":true"#, r#""first":false"#);
    stopped
        .handle_letter(at(50), from, more.as_bytes())
        .unwrap();
    while let Some((to, _)) = stopped.poll_letter(at(50)) {
        stopped.handle_sent(at(50), to, true);
    }
    assert_eq!(stopped.poll_timeout(), Some(at(61)));
    stopped.handle_timeout(at(61));
    let (_, asked) = stopped.poll_letter(at(61)).unwrap();
    assert!(String::from_utf8(asked).unwrap().contains("again"));
    for letter in &letters[1..] {
        stopped
            .handle_letter(at(62), from, letter.as_bytes())
            .unwrap();
    }
    assert_eq!(count(&stopped, ""), 0);
}

#[test]
fn incomplete_lists_of_one_host_drop_no_list_of_another() {
    let mut exchange = Exchange::new(0);
    let hosts = std::iter::once(0).chain(std::iter::repeat_n(1, 64));
    exchange.handle_neighbors(Instant::now(), &present(hosts));
    let honest = full("honest-", 1500, 0);
    tell_all(&mut exchange, 1, &honest[..4]);
    for liar in 2..=65 {
        let never_ends = full(&format!("x{liar}-"), 618, 0);
        tell_all(&mut exchange, liar, &never_ends[..2]);
    }
    tell_all(&mut exchange, 1, &honest[4..]);
    assert_eq!(count(&exchange, "honest-"), 1500);
}

/// Returns a letter with all agents: their names, and the values of their key `df`.
fn full_with_df(agents: &[(String, String)]) -> String {
    let agents: Vec<String> = agents
        .iter()
        .enumerate()
        .map(|(number, (name, df))| {
            format!(
                r#"{{"name":"{name}","id":"{:016x}","registered":1,"df":{df}}}"#,
                number + 100
            )
        })
        .collect();
    format!(
        r#"{{"version":1,"tell":{{"full":{{"version":1,"first":true,"last":true,"agents":[{}]}}}}}}"#,
        agents.join(",")
    )
}

#[test]
fn df_entries_of_a_neighbor_are_bounded_and_its_agents_stay() {
    let mut exchange = with_neighbor();
    let many: Vec<(String, String)> = (0..4500)
        .map(|number| (format!("a{number}"), r#"{"entry":"lifting"}"#.to_owned()))
        .collect();
    handle(&mut exchange, &full_with_df(&many)).unwrap();
    let directory = exchange.directory();
    assert_eq!(directory.entries().len(), 4500);
    assert_eq!(directory.df_entries().len(), Exchange::MAX_DF_ENTRIES);
    // In changes, too.
    for from in 1..100 {
        let agents: Vec<String> = (0..90)
            .map(|number| {
                let name = (from * 90 + number) % 4500;
                format!(
                    r#"{{"name":"a{name}","id":"{:016x}","registered":1,"df":{{"entry":"{}"}}}}"#,
                    name + 100,
                    "x".repeat(Exchange::MAX_DF_ENTRY)
                )
            })
            .collect();
        let changes = format!(
            r#"{{"version":1,"tell":{{"changes":{{"from":{from},"to":{},"agents":[{}]}}}}}}"#,
            from + 1,
            agents.join(",")
        );
        handle(&mut exchange, &changes).unwrap();
        let entries = directory.df_entries();
        assert!(entries.len() <= Exchange::MAX_DF_ENTRIES);
        let bytes: usize = entries.iter().map(|entry| entry.text.len()).sum();
        assert!(bytes <= Exchange::MAX_DF_BYTES, "{bytes}");
    }
    // 100,000 entries are more agents than a neighbor may have.
    for part in 0..12 {
        let agents: Vec<_> = (0..9000)
            .map(|number| (format!("{part}.{number}"), r#"{"entry":""}"#.to_owned()))
            .collect();
        let letter = full_with_df(&agents)
            .replace(r#""first":true"#, &format!(r#""first":{}"#, part == 0))
            .replace(r#""last":true"#, &format!(r#""last":{}"#, part == 11));
        handle(&mut exchange, &letter).unwrap();
    }
    assert!(directory.entries().len() <= Exchange::MAX_AGENTS);
    let entries = directory.df_entries();
    assert!((1..=Exchange::MAX_DF_ENTRIES).contains(&entries.len()));
    assert!(entries.iter().all(|df| directory.known(&df.name).is_some()));
    exchange.handle_neighbors(Instant::now(), &[]);
    exchange.handle_timeout(Instant::now() + Exchange::MEMORY);
    assert!(directory.df_entries().is_empty());
}

#[test]
fn df_entries_that_are_too_long_or_of_others_are_ignored() {
    let mts = MtsId::new("hostile", Incarnation::from_u64(7));
    let mut exchange = Exchange::new(0);
    let certified = Present {
        mandate: Mandate::Certified((1..5).map(|number| format!("own_{number}")).collect()),
        principal: Principal::Certificate([7; 32]),
        ..Present::unproved(mts, vec![location(6)])
    };
    exchange.handle_neighbors(Instant::now(), &[certified]);
    let df = |text: &str| format!(r#"{{"entry":"{text}"}}"#);
    let agents = [
        ("own_1".to_owned(), df("lifting")),
        (
            "own_2".to_owned(),
            df(&"x".repeat(Exchange::MAX_DF_ENTRY + 1)),
        ),
        ("own_3".to_owned(), r#"{"entry":"","lease":0}"#.to_owned()),
        (
            "own_4".to_owned(),
            format!(r#"{{"entry":"","lease":{}}}"#, u64::MAX),
        ),
        // Its certificate does not name this agent.
        ("crane".to_owned(), df("lifting")),
    ];
    let now = Instant::now();
    handle(&mut exchange, &full_with_df(&agents)).unwrap();
    let directory = exchange.directory();
    assert_eq!(directory.entries().len(), 4);
    let mut entries = directory.df_entries();
    entries.sort_by(|one, other| one.name.cmp(&other.name));
    let names: Vec<&str> = entries.iter().map(|entry| &*entry.name).collect();
    assert_eq!(names, ["own_1", "own_4"]);
    for entry in entries {
        assert_eq!(entry.gateway, Incarnation::from_u64(7));
        assert!(entry.ends <= now + Exchange::MAX_DF_LEASE + Duration::from_secs(60));
    }
    // A coalition has none.
    let coalition = full_with_df(&[("own_1".to_owned(), df("x"))]).replace(
        r#""df""#,
        r#""coalition":{"members":["own_2"],"leader":"own_2"},"df""#,
    );
    handle(&mut exchange, &coalition).unwrap();
    assert_eq!(directory.entries().len(), 1);
    assert!(directory.df_entries().is_empty());
}

/// Three gateways with certificates, and a fourth one that sends false entries: names, registrations
/// and addresses of the others, and the incarnations of their gateways.
struct HostileLoad {
    world: World,
    liar: usize,
    /// Whether the liar has a trusted certificate. If so, it may keep a name or a registration that
    /// it was the first to claim.
    is_certified: bool,
    version: u64,
    /// Agents of a gateway that another gateway has listed.
    listed: BTreeMap<(usize, String), usize>,
}

impl HostileLoad {
    fn new(seed: u64) -> Self {
        let mut world = World::new(4, seed);
        let liar = 3;
        let is_certified = seed.is_multiple_of(2);
        for (index, proof) in world.proofs.iter_mut().enumerate() {
            let at = u8::try_from(index).unwrap();
            *proof = match index == liar && !is_certified {
                true => (Mandate::Unproved, Principal::Unproved, Vec::new()),
                false => (
                    Mandate::Certified([].into()),
                    Principal::Certificate([at; 32]),
                    Vec::new(),
                ),
            };
        }
        world.connect();
        Self {
            world,
            liar,
            is_certified,
            version: 0,
            listed: BTreeMap::new(),
        }
    }

    fn honest(&mut self) -> usize {
        self.world.random.usize(..self.liar)
    }

    fn act(&mut self) {
        match self.world.random.u32(..12) {
            0 => {
                let (at, number) = (self.honest(), self.world.next);
                let name = format!("agent_{number}");
                self.world.join(at, &name);
                if number % 2 == 0 {
                    self.world
                        .describe(at, &name, &format!("{at} {name}"), None);
                }
            }
            1 => {
                let at = self.honest();
                let name = self.world.gateways[at].agents.keys().next().cloned();
                if let Some(name) = name {
                    self.world.leave(at, &name);
                }
            }
            2 => {
                let (one, other) = (self.honest(), self.honest());
                if one != other {
                    self.world.cut = vec![(one.min(other), one.max(other))];
                    self.world.connect();
                    // Shorter than the time for which the agents are remembered.
                    let ms = self.world.random.u64(1..4000);
                    self.pass(Duration::from_millis(ms));
                    self.world.cut.clear();
                    self.world.connect();
                }
            }
            3 => {
                let other = self.honest();
                let of_other = location(other);
                let own = self.world.gateways[self.liar].mts.incarnation;
                self.world.proofs[self.liar].2 = vec![of_other.with_incarnation(own)];
                self.world.connect();
            }
            4 => {
                let (at, other) = (self.honest(), self.honest());
                let now = self.world.now;
                self.world.gateways[at]
                    .exchange
                    .handle_silence(now, &location(other));
            }
            5 => {
                let ms = self.world.random.u64(1..300);
                self.pass(Duration::from_millis(ms));
            }
            _ => self.lie(),
        }
        self.check();
    }

    /// Passes time in small steps with a check after each.
    fn pass(&mut self, time: Duration) {
        let end = self.world.now + time;
        while self.world.now < end {
            let step = Duration::from_millis(50).min(end - self.world.now);
            self.world.run(step);
            if self.world.random.u32(..4) == 0 {
                self.lie();
            }
            self.check();
        }
    }

    /// The liar sends one letter to an honest gateway.
    fn lie(&mut self) {
        let at = self.honest();
        self.version += 1;
        let part = match self.world.random.u32(..8) {
            0 => serde_json::json!("goodbye"),
            1 => serde_json::json!("again"),
            how => {
                let count = self.world.random.usize(..4);
                let agents: Vec<_> = (0..count).map(|_| self.entry(at)).collect();
                let version = self.version;
                match how {
                    2 | 3 => serde_json::json!({ "changes": {
                        "from": version - 1, "to": version, "agents": agents,
                        "left": self.world.gateways[at].agents.keys().collect::<Vec<_>>() } }),
                    _ => serde_json::json!({ "full": {
                        "version": version, "first": true, "last": true, "agents": agents } }),
                }
            }
        };
        let content = serde_json::json!({ "version": 1, "tell": part }).to_string();
        let from = self.world.gateways[self.liar].mts.incarnation;
        let now = self.world.now;
        let taken = self.world.gateways[at]
            .exchange
            .handle_letter(now, from, content.as_bytes());
        // A gateway without a connection is a stranger; nothing else is wrong with the letters.
        assert!(
            matches!(taken, Ok(()) | Err(ExchangeError::NotConnected)),
            "{taken:?}"
        );
    }

    /// A false entry for this gateway.
    fn entry(&mut self, at: usize) -> serde_json::Value {
        let honest: Vec<(String, Incarnation)> = self.world.gateways[..self.liar]
            .iter()
            .flat_map(|gateway| gateway.agents.values())
            .filter(|entry| {
                let known = self.world.gateways[at].exchange.directory();
                !self.is_certified || known.known(&entry.name).is_some()
            })
            .map(|entry| (entry.name.to_string(), entry.incarnation))
            .collect();
        let random = &mut self.world.random;
        let mut one = || match honest.is_empty() {
            true => None,
            false => Some(honest[random.usize(..honest.len())].clone()),
        };
        let (named, registered) = (one(), one());
        let name = match random.u32(..3) {
            0 => named.map(|(name, _)| name),
            _ => None,
        };
        let id = match random.u32(..4) {
            0 => Some(Incarnation::from_u64(random.u64(1..=self.liar as u64))),
            1 => None,
            _ => registered.map(|(_, id)| id),
        };
        let mut entry = serde_json::json!({
            "name": name.unwrap_or_else(|| format!("liar_{}", random.u32(..4))),
            "id": id.unwrap_or_else(|| Incarnation::from_u64(random.u64(1 << 40..))).to_string(),
            "registered": 1,
        });
        if random.bool() {
            let long = random.usize(..2) * (Exchange::MAX_DF_ENTRY + random.usize(..2));
            entry["df"] = serde_json::json!({ "entry": format!("liar{}", "x".repeat(long)) });
            if random.bool() {
                entry["df"]["lease"] = random.u64(..).into();
            }
        }
        if random.u32(..8) == 0 {
            entry["coalition"] = serde_json::json!({ "members": ["liar_0"], "leader": "liar_0" });
        }
        entry
    }

    /// Agents that an honest gateway has listed at their own gateway stay there, and letters for
    /// their registrations go there, until they leave.
    fn check(&mut self) {
        let world = &self.world;
        self.listed.retain(|(_, name), owner| {
            let agents = &world.gateways[*owner].agents;
            agents.contains_key(name)
        });
        for at in 0..self.liar {
            let known = world.gateways[at].exchange.directory();
            let others = (0..self.liar).filter(|other| *other != at);
            for (owner, agent) in
                others.flat_map(|it| world.gateways[it].agents.values().map(move |of| (it, of)))
            {
                let is_owners = |entry: &Arc<Entry>| entry.mts.incarnation == agent.mts.incarnation;
                let key = (at, agent.name.to_string());
                let holder = known.known(&agent.name);
                if holder.as_ref().is_some_and(is_owners) {
                    let registered = known.known_incarnation(agent.incarnation);
                    assert_eq!(registered, holder, "the registration of another agent");
                    self.listed.insert(key, owner);
                } else if self.listed.contains_key(&key) {
                    panic!(
                        "{} of {owner} has vanished from {at}: {holder:?}",
                        agent.name
                    );
                }
            }
            // A DF entry is that of the gateway that sent it.
            for (gateway, name, text) in world.df_entries(at) {
                match gateway == self.liar {
                    true => assert!(text.starts_with("liar"), "{text}"),
                    false => assert_eq!(text, format!("{gateway} {name}")),
                }
            }
        }
    }

    /// In the end, every honest gateway has the agents of the others, and their DF entries.
    fn finish(&mut self) {
        for _ in 0..40 {
            self.pass(Duration::from_millis(500));
        }
        for at in 0..self.liar {
            let known = self.world.gateways[at].exchange.directory();
            let mut entries = self.world.df_entries(at);
            entries.retain(|(gateway, ..)| *gateway != self.liar);
            assert_eq!(entries, self.world.expected_df(at), "{at}");
            for owner in (0..self.liar).filter(|owner| *owner != at) {
                for agent in self.world.gateways[owner].agents.values() {
                    let holder = known.known(&agent.name);
                    let holder = holder.map(|entry| entry.mts.incarnation);
                    assert_eq!(
                        holder,
                        Some(agent.mts.incarnation),
                        "{} at {at}",
                        agent.name
                    );
                }
            }
        }
    }
}

/// `FIPA_EXCHANGE_SEEDS` is the number of seeds, `FIPA_EXCHANGE_SEED` is a single one.
#[test]
fn a_neighbor_that_lies_neither_removes_nor_takes_over_agents_of_others() {
    let number = |name: &str| std::env::var(name).ok()?.parse::<u64>().ok();
    let seeds = match number("FIPA_EXCHANGE_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FIPA_EXCHANGE_SEEDS").unwrap_or(10),
    };
    for seed in seeds {
        println!("seed {seed}");
        let mut load = HostileLoad::new(seed);
        for _ in 0..120 {
            load.act();
        }
        load.finish();
    }
}
