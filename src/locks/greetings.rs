//! The rate and the order in which an agent asks others for a sign of life. No I/O, no clock.

use std::collections::{HashMap, HashSet, VecDeque};
use std::net::{IpAddr, Ipv4Addr};
use std::time::{Duration, Instant};

use fipa_locking::LockPeer;
use fipa_transport::{PeerId, TokenBucket};

use crate::protocol::peer_shares::PeerShares;

/// Greetings a second to the agents that one peer announces, and of them at once.
const OF_PEER: (f64, f64) = (20.0, 256.0);
/// Greetings a second to all agents, and of them at once.
const OF_ALL: (f64, f64) = (100.0, 512.0);
/// Time after which the agents that wait are looked at again.
const PAUSE: Duration = Duration::from_millis(50);
/// Maximum number of agents that wait. One peer alone gets a quarter of it.
const MAX_WAITING: usize = 16_384;
/// Maximum number of peers that are known by their address only and whose rate is remembered. Beyond it, they have one
/// rate together. As many others have a rate of their own: this host, and peers that have proved a key.
const MAX_PEERS: usize = 256;
/// Time between two readings of the directory for agents that found no place among those that wait.
const READ_AGAIN: Duration = Duration::from_secs(30);

/// The agents that were greeted, and those that wait for it.
///
/// Each peer has a rate of its own. Those that have agents that wait take turns, so a peer that announces thousands of
/// agents, or the same ones again and again, delays the greetings of its own agents only.
#[derive(Debug)]
pub(super) struct Greetings {
    /// The agents that were greeted or wait.
    known: HashSet<LockPeer>,
    /// The known agents that wait for a greeting.
    waiting: HashSet<LockPeer>,
    peers: HashMap<PeerId, OfPeer>,
    /// The peers with agents that wait, in the order of their turns.
    turns: VecDeque<PeerId>,
    places: PeerShares,
    all: TokenBucket,
    /// Time at which the agents that wait are looked at.
    next: Option<Instant>,
    /// Time at which the directory is read again.
    read_again: Option<Instant>,
}

#[derive(Debug)]
struct OfPeer {
    bucket: TokenBucket,
    /// Agents that wait, and some that have left.
    queue: VecDeque<LockPeer>,
    /// Whether the peer is known by its address only.
    is_address: bool,
}

impl Greetings {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            known: HashSet::new(),
            waiting: HashSet::new(),
            peers: HashMap::new(),
            turns: VecDeque::new(),
            places: PeerShares::new(MAX_WAITING),
            all: TokenBucket::new(OF_ALL.1, now),
            next: None,
            read_again: None,
        }
    }

    /// Handles an agent that this peer announces. Returns whether it is greeted now: not if it was before, and not if it
    /// has to wait.
    pub(super) fn announced(&mut self, now: Instant, by: &PeerId, agent: &LockPeer) -> bool {
        if self.known.contains(agent) {
            return false;
        }
        let by = &self.remember(now, by);
        let is_first = match self.peers.get(by) {
            Some(of_peer) => of_peer.queue.is_empty(),
            None => {
                self.incomplete(now);
                return false;
            }
        };
        if is_first && self.turns.is_empty() && self.spend(now, by) {
            self.known.insert(agent.clone());
            return true;
        }
        if !self.places.take(by) {
            self.incomplete(now);
            return false;
        }
        if let Some(of_peer) = self.peers.get_mut(by) {
            of_peer.queue.push_back(agent.clone());
        }
        if is_first {
            self.turns.push_back(by.clone());
            // A peer that has its rate left is not delayed by those that have used theirs up.
            self.next = Some(now);
        }
        self.known.insert(agent.clone());
        self.waiting.insert(agent.clone());
        self.next = self.next.or(Some(now + PAUSE));
        false
    }

    /// Handles an agent that has left the directory.
    pub(super) fn forget(&mut self, agent: &LockPeer) {
        self.known.remove(agent);
        self.waiting.remove(agent);
    }

    /// Keeps these agents only.
    pub(super) fn retain(&mut self, is_present: impl Fn(&LockPeer) -> bool) {
        self.known.retain(&is_present);
        self.waiting.retain(is_present);
    }

    /// Returns the time at which to call [`due`](Self::due) and [`reads_again`](Self::reads_again).
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        match (self.next, self.read_again) {
            (Some(one), Some(two)) => Some(one.min(two)),
            (one, two) => one.or(two),
        }
    }

    /// Returns the agents to greet now.
    pub(super) fn due(&mut self, now: Instant) -> Vec<LockPeer> {
        let mut due = Vec::new();
        if self.next.is_none_or(|next| now < next) {
            return due;
        }
        // Each round gives each peer that has its rate left one greeting.
        let mut idle = 0;
        while idle < self.turns.len()
            && let Some(by) = self.turns.pop_front()
        {
            let first = self.first_waiting(&by);
            idle += 1;
            if let Some(agent) = first
                && self.spend(now, &by)
            {
                self.take_first(&by);
                self.waiting.remove(&agent);
                due.push(agent);
                idle = 0;
            }
            match self.first_waiting(&by) {
                Some(_) => self.turns.push_back(by),
                None => idle = 0,
            }
        }
        self.next = (!self.turns.is_empty()).then(|| now + PAUSE);
        due
    }

    /// Whether the directory has to be read for agents that found no place.
    pub(super) fn reads_again(&mut self, now: Instant) -> bool {
        self.read_again.take_if(|at| *at <= now).is_some()
    }

    /// Returns the first agent of this peer that waits, and drops those in front of it that have left.
    fn first_waiting(&mut self, by: &PeerId) -> Option<LockPeer> {
        loop {
            let first = self.peers.get(by)?.queue.front()?.clone();
            if self.waiting.contains(&first) {
                return Some(first);
            }
            self.take_first(by);
        }
    }

    fn take_first(&mut self, by: &PeerId) {
        if let Some(of_peer) = self.peers.get_mut(by)
            && of_peer.queue.pop_front().is_some()
        {
            self.places.release(by);
        }
    }

    fn incomplete(&mut self, now: Instant) {
        self.read_again.get_or_insert(now + READ_AGAIN);
    }

    /// Takes the rate of one greeting. Returns whether there was enough.
    fn spend(&mut self, now: Instant, by: &PeerId) -> bool {
        let Some(of_peer) = self.peers.get_mut(by) else {
            return false;
        };
        let (rate, burst) = OF_PEER;
        // A greeting without its rate waits for the next turn of its peer.
        if !of_peer.bucket.clone().take_of(1.0, rate, burst, now) {
            return false;
        }
        let (all, burst_of_all) = OF_ALL;
        self.all.take_of(1.0, all, burst_of_all, now)
            && of_peer.bucket.take_of(1.0, rate, burst, now)
    }

    /// Remembers a peer, if there is room. Returns the one whose rate its agents take.
    fn remember(&mut self, now: Instant, by: &PeerId) -> PeerId {
        if self.peers.contains_key(by) {
            return by.clone();
        }
        let is_address = by.as_str().parse::<IpAddr>().is_ok();
        let count = |it: &Self| {
            let peers = it.peers.values();
            peers.filter(|it| it.is_address == is_address).count()
        };
        if count(self) >= MAX_PEERS {
            let (rate, burst) = OF_PEER;
            let full = Duration::from_secs_f64(burst / rate);
            // The bucket of a peer that is forgotten is as full as that of a new one.
            self.peers.retain(|_, it| {
                !it.queue.is_empty() || now.saturating_duration_since(it.bucket.asked()) < full
            });
        }
        let by = match count(self) < MAX_PEERS {
            true => by.clone(),
            false => PeerId::of_ip(Ipv4Addr::UNSPECIFIED.into()),
        };
        self.peers.entry(by.clone()).or_insert_with(|| OfPeer {
            bucket: TokenBucket::new(OF_PEER.1, now),
            queue: VecDeque::new(),
            is_address,
        });
        by
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn peer(number: u8) -> PeerId {
        PeerId::of_ip([192, 0, 2, number].into())
    }

    fn agent(name: &str, number: u64) -> LockPeer {
        LockPeer::new(&format!("{name}-{number}"), number + 1).unwrap()
    }

    /// Greets what is due until this time, and returns it.
    fn run(greetings: &mut Greetings, until: Instant) -> Vec<(Instant, LockPeer)> {
        let mut all = Vec::new();
        while let Some(now) = greetings.poll_timeout().filter(|at| *at <= until) {
            all.extend(greetings.due(now).into_iter().map(|it| (now, it)));
            greetings.reads_again(now);
        }
        all
    }

    #[test]
    fn thousands_of_agents_of_one_peer_are_greeted_at_its_rate() {
        let now = Instant::now();
        let mut greetings = Greetings::new(now);
        let at_once = (0..4_000).filter(|it| greetings.announced(now, &peer(1), &agent("a", *it)));
        assert_eq!(at_once.count(), 256);
        let later = run(&mut greetings, now + 10 * SECOND);
        assert!(later.len().abs_diff(200) <= 2, "{}", later.len());
        let rest = run(&mut greetings, now + 300 * SECOND);
        assert_eq!(256 + later.len() + rest.len(), 4_000);
        assert_eq!(greetings.poll_timeout(), None);
    }

    #[test]
    fn agents_that_come_and_go_for_ever_are_greeted_at_the_rate_of_their_peer() {
        let begun = Instant::now();
        let mut greetings = Greetings::new(begun);
        let mut count = 0;
        for round in 0..1_000 {
            let now = begun + Duration::from_millis(10) * round;
            count += run(&mut greetings, now).len();
            for number in 0..50 {
                let one = agent("a", number);
                count += usize::from(greetings.announced(now, &peer(1), &one));
                greetings.forget(&one);
            }
        }
        assert!(count <= 256 + 20 * 10 + 1, "{count}");
        assert!(greetings.known.is_empty() && greetings.waiting.is_empty());
        assert!(greetings.peers[&peer(1)].queue.len() <= MAX_WAITING / 4);
    }

    #[test]
    fn newcomers_of_other_peers_do_not_wait_for_a_storm() {
        let now = Instant::now();
        let mut greetings = Greetings::new(now);
        for number in 0..10_000 {
            greetings.announced(now, &peer(1), &agent("storm", number));
        }
        run(&mut greetings, now + SECOND);
        for (number, by) in [(0, PeerId::THIS_HOST), (1, peer(2)), (2, peer(3))] {
            let at = now + SECOND;
            let newcomer = agent("honest", number);
            let at_once = greetings.announced(at, &by, &newcomer);
            let greeted = run(&mut greetings, at).into_iter().map(|(_, it)| it);
            let mut greeted = greeted.collect::<Vec<_>>();
            assert!(at_once || greeted.contains(&newcomer), "{greeted:?}");
            greeted.retain(|it| it.name().starts_with("storm"));
            assert!(greeted.len() <= 1, "{greeted:?}");
        }
    }

    #[test]
    fn many_peers_have_a_rate_together_and_take_turns() {
        let now = Instant::now();
        let mut greetings = Greetings::new(now);
        let mut count = 0;
        for by in 0..200 {
            for number in 0..40 {
                let one = agent(&format!("of-{by}"), number);
                count += usize::from(greetings.announced(now, &peer(by), &one));
            }
        }
        let at = now + 10 * SECOND;
        assert!(!greetings.announced(now, &PeerId::THIS_HOST, &agent("honest", 0)));
        let greeted = run(&mut greetings, at);
        count += greeted.len();
        assert!(count <= 512 + 10 * 100 + 1, "{count}");
        let (greeted, _) = greeted
            .iter()
            .find(|(_, it)| *it == agent("honest", 0))
            .unwrap();
        assert!(*greeted <= now + 3 * SECOND);
    }

    #[test]
    fn agents_that_find_no_place_are_greeted_later() {
        let now = Instant::now();
        let mut greetings = Greetings::new(now);
        let all: Vec<LockPeer> = (0..6_000).map(|it| agent("a", it)).collect();
        let mut greeted: HashSet<LockPeer> = HashSet::new();
        let mut at = now;
        for _ in 0..20 {
            let some = all.iter();
            greeted.extend(
                some.filter(|it| greetings.announced(at, &peer(1), it))
                    .cloned(),
            );
            let until = at + 30 * SECOND;
            while greetings.poll_timeout().is_some_and(|next| next <= until) {
                at = greetings.poll_timeout().unwrap();
                greeted.extend(greetings.due(at));
                if greetings.reads_again(at) {
                    break;
                }
            }
        }
        assert_eq!(greeted.len(), all.len());
    }

    #[test]
    fn the_number_of_remembered_peers_is_bounded() {
        let now = Instant::now();
        let mut greetings = Greetings::new(now);
        for number in 0..3_000_u32 {
            let by = PeerId::of_ip(Ipv4Addr::from(number).into());
            greetings.announced(now, &by, &agent("a", number.into()));
            // The peers beyond the bound have one entry together.
            assert!(greetings.peers.len() <= MAX_PEERS + 1);
        }
        assert!(greetings.poll_timeout().is_some());
        let later = now + 300 * SECOND;
        run(&mut greetings, later);
        assert!(greetings.announced(later, &PeerId::THIS_HOST, &agent("b", 0)));
    }

    #[test]
    fn a_flood_of_addresses_delays_this_host_and_peers_with_keys_for_seconds_only() {
        let now = Instant::now();
        let mut greetings = Greetings::new(now);
        for number in 1..5_000_u32 {
            let by = PeerId::of_ip(Ipv4Addr::from(number).into());
            for agents in 0..3 {
                let one = agent("flood", u64::from(number * 3 + agents));
                greetings.announced(now, &by, &one);
            }
        }
        let key = PeerId::of(fipa_transport::Principal::Certificate([7; 32]), None);
        let honest = [(PeerId::THIS_HOST, 0), (key, 1)];
        for (by, number) in &honest {
            greetings.announced(now, by, &agent("honest", *number));
        }
        let greeted = run(&mut greetings, now + 6 * SECOND);
        for (by, number) in honest {
            let is_it = |(_, it): &(Instant, LockPeer)| *it == agent("honest", number);
            assert!(greeted.iter().any(is_it), "{by}");
        }
    }
}
