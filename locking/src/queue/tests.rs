use fastrand::Rng;

use super::*;

const TIMEOUT: Millis = 10;

fn peer(number: usize) -> LockPeer {
    LockPeer::new(&format!("agent{number}"), 1).unwrap()
}

fn queue() -> Queue {
    let mut queue = Queue::default();
    queue.be_fair(TIMEOUT);
    queue
}

/// What the queue has to do, in plain lists.
#[derive(Default)]
struct Expected {
    /// Agents in order, with the numbers of their conversations.
    order: Vec<(usize, u64)>,
    suspected: Vec<usize>,
    moved: Vec<usize>,
    /// Agents that were asked for a sign of life, and the end of the wait.
    asked: Vec<(usize, Millis)>,
    last_places_sent: Vec<(usize, u64, u32)>,
}

impl Expected {
    fn forget(&mut self, agent: usize) {
        self.order.retain(|(it, _)| *it != agent);
        self.moved.retain(|it| *it != agent);
        self.sign_of_life(agent);
    }

    fn sign_of_life(&mut self, agent: usize) {
        self.suspected.retain(|it| *it != agent);
        self.asked.retain(|(it, _)| *it != agent);
    }

    /// The agent whose turn it is, and the agents that are asked for a sign of life.
    fn next(&mut self, now: Millis) -> (Option<usize>, Vec<usize>) {
        loop {
            let Some(&(first, conversation)) = self.order.first() else {
                return (None, Vec::new());
            };
            if !self.suspected.contains(&first) {
                return (Some(first), Vec::new());
            }
            let until = self.asked.iter().find(|(it, _)| *it == first);
            match until {
                Some((_, until)) if now < *until => return (None, Vec::new()),
                Some(_) if self.moved.contains(&first) => self.forget(first),
                Some(_) => {
                    self.asked.retain(|(it, _)| *it != first);
                    self.moved.push(first);
                    self.order.remove(0);
                    self.order.push((first, conversation));
                }
                None => {
                    let agents = self.order.iter().map(|(agent, _)| *agent);
                    let is_new = |agent: &usize| {
                        self.suspected.contains(agent)
                            && !self.asked.iter().any(|(it, _)| it == agent)
                    };
                    let asked: Vec<_> = agents.take_while(is_new).collect();
                    self.asked
                        .extend(asked.iter().map(|agent| (*agent, now + TIMEOUT)));
                    return (None, asked);
                }
            }
        }
    }

    fn tell(&mut self) -> Vec<(usize, u64, u32)> {
        let first = self.order.iter().zip(1..=MAX_PLACE);
        let now: Vec<_> = first
            .map(|((agent, of), place)| (*agent, *of, place))
            .collect();
        let before = std::mem::replace(&mut self.last_places_sent, now.clone());
        now.into_iter().filter(|it| !before.contains(it)).collect()
    }
}

#[test]
fn random_requests_losses_and_signs_of_life_keep_the_order() {
    for seed in 0..300 {
        let mut rng = Rng::with_seed(seed);
        let (mut queue, mut expected) = (queue(), Expected::default());
        let mut now = 0;
        for conversation in 1..200_u64 {
            let agent = rng.usize(..14);
            let of = |number| Conversation::new("x".into(), number);
            let mut out = Vec::new();
            match rng.u8(..10) {
                0..4 => {
                    // A new request, which replaces the one before.
                    queue.add(&peer(agent), &of(conversation), Some(now));
                    expected.sign_of_life(agent);
                    match expected.order.iter_mut().find(|(it, _)| *it == agent) {
                        Some(known) => known.1 = conversation,
                        None => expected.order.push((agent, conversation)),
                    }
                }
                4 => {
                    // A late copy of an earlier request.
                    let known = expected.order.iter().find(|(it, _)| *it == agent);
                    if let Some((_, number)) = known {
                        assert!(!queue.add(&peer(agent), &of(number - 1), Some(now)));
                    }
                }
                5 => {
                    let known = expected.order.iter().find(|(it, _)| *it == agent);
                    let number = known.map_or(0, |(_, number)| *number);
                    // The withdrawal of another request changes nothing.
                    queue.withdraw(&peer(agent), &of(number + 1));
                    queue.withdraw(&peer(agent), &of(number));
                    expected.forget(agent);
                }
                6 => {
                    queue.lost(&peer(agent), true);
                    expected.forget(agent);
                }
                7 => {
                    queue.lost(&peer(agent), false);
                    let waits = expected.order.iter().any(|(it, _)| *it == agent);
                    if waits && !expected.suspected.contains(&agent) {
                        expected.suspected.push(agent);
                    }
                }
                8 => {
                    queue.sign_of_life(&peer(agent));
                    expected.sign_of_life(agent);
                }
                _ => {
                    let next = queue.next(now, OwnerGate::Open, &mut out);
                    let served = next.and_then(|next| queue.remove(next));
                    let (due, asked) = expected.next(now);
                    assert_eq!(served.map(|it| it.peer), due.map(peer), "seed {seed}");
                    let probes: Vec<_> = asked
                        .into_iter()
                        .map(|agent| OwnerStep::Probe {
                            to: peer(agent),
                            at: now,
                        })
                        .collect();
                    assert_eq!(out, probes, "seed {seed}");
                    if let Some(agent) = due {
                        expected.forget(agent);
                    }
                    now += rng.u64(..2 * TIMEOUT);
                }
            }
            out.clear();
            queue.tell(&mut out);
            let places = expected.tell().into_iter().map(|(agent, number, place)| {
                let (to, conversation) = (peer(agent), of(number));
                let act = Act::Place { place };
                OwnerStep::Send {
                    to,
                    conversation,
                    act,
                }
            });
            assert_eq!(out, places.collect::<Vec<_>>(), "seed {seed}");
            let order: Vec<_> = queue.iter().map(|waiter| waiter.peer.clone()).collect();
            let agents: Vec<_> = expected.order.iter().map(|it| peer(it.0)).collect();
            assert_eq!(order, agents, "seed {seed}");
        }
        // Without signs of life, the queue is empty after a bounded number of turns.
        for agent in 0..14 {
            queue.lost(&peer(agent), false);
        }
        for _ in 0..3 * 14 {
            let next = queue.next(now, OwnerGate::Open, &mut Vec::new());
            assert_eq!(next, None);
            now += TIMEOUT;
        }
        assert_eq!(queue.iter().count(), 0, "seed {seed}");
    }
}

#[test]
fn places_of_the_life_before_sort_the_queue_in_any_order_of_arrival() {
    for seed in 0..200 {
        let mut rng = Rng::with_seed(seed);
        // Agents 0 to 7 have places, the others have none.
        let mut arrival: Vec<usize> = (0..12).collect();
        rng.shuffle(&mut arrival);
        let mut queue = queue();
        for agent in &arrival {
            let conversation = Conversation::new("x".into(), 1);
            queue.add(&peer(*agent), &conversation, Some(0));
            if *agent < MAX_PLACE as usize {
                queue.sort_in(&peer(*agent), 1 + *agent as u32);
            }
        }
        let without = arrival
            .iter()
            .copied()
            .filter(|it| *it >= MAX_PLACE as usize);
        let expected = (0..MAX_PLACE as usize).chain(without).map(peer);
        let order = queue.iter().map(|waiter| waiter.peer.clone());
        assert_eq!(
            order.collect::<Vec<_>>(),
            expected.collect::<Vec<_>>(),
            "seed {seed}"
        );
    }
}
