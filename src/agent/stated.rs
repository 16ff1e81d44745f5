//! Letters to agents that no directory lists, at the addresses in their identifiers.
//!
//! Only the gateway of this host reaches other platforms. Before the first letter to such an agent, its
//! [introduction](crate::admin::contact) makes the gateway list it in the directory of this host. The letter, and all later
//! ones of the same agent, wait meanwhile, so that they stay in order. A name that the directory has is sent there,
//! and its addresses are ignored.

use std::collections::{HashMap, VecDeque};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, ErrorChain, Letter};
use fipa_mts::{Mts, Sending};
use fipa_sds::{Directory, Entry};
use fipa_transport::{Attempt, Incarnation, Location, TransportError, TransportErrorKind};
use parking_lot::Mutex;
use tokio::sync::oneshot;

use crate::admin::{contact, routes};
use crate::{Domain, RegisterOptions};

/// Maximum time for the answer of the gateway to an introduction. It may resolve host names.
const TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum number of letters of an agent that wait for introductions.
const MAX_WAITING: usize = 1024;

/// Maximum number of bytes of them.
const MAX_WAITING_BYTES: usize = 64 << 20;

/// Time for which a refused introduction is not repeated. It doubles with each refusal.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// Maximum length of an address that is remembered, in bytes.
const MAX_ADDRESS: usize = 1024;

/// Maximum number of identifiers whose introductions are remembered.
const MAX_REMEMBERED: usize = 256;

/// The introductions of this process.
#[derive(Debug, Default)]
pub(crate) struct Introductions(Mutex<HashMap<Key, Introduced>>);

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Key {
    name: String,
    addresses: Vec<String>,
    is_received: bool,
}

impl Key {
    fn of(id: &AgentId) -> Self {
        let addresses = id.addresses().iter().take(contact::MAX_ADDRESSES);
        // A longer one is no location.
        let addresses = addresses.filter(|it| it.len() <= MAX_ADDRESS);
        Self {
            name: id.name().to_owned(),
            addresses: addresses.cloned().collect(),
            is_received: id.is_received(),
        }
    }
}

#[derive(Debug, Clone)]
enum Introduced {
    Accepted,
    Refused {
        why: Arc<str>,
        until: Instant,
        pause: Duration,
    },
}

impl Introductions {
    /// Whether the receiver is introduced before a letter is sent to it: it has addresses, and no directory lists it.
    /// Addresses that this program gives also replace those of an agent that is known by a letter only.
    fn needs(&self, id: &AgentId, directory: &dyn Directory) -> bool {
        if id.addresses().is_empty() {
            return false;
        }
        match directory.lookup(id.name()) {
            None => true,
            Some(known) => {
                let is_accepted = || {
                    let known = self.0.lock();
                    matches!(known.get(&Key::of(id)), Some(Introduced::Accepted))
                };
                known.is_unregistered_contact() && !id.is_received() && !is_accepted()
            }
        }
    }

    /// Returns the reason for which an introduction was refused shortly before.
    fn refusal(&self, now: Instant, key: &Key) -> Option<Arc<str>> {
        match self.0.lock().get(key) {
            Some(Introduced::Refused { why, until, .. }) if *until > now => Some(Arc::clone(why)),
            _ => None,
        }
    }

    fn remember(&self, now: Instant, key: Key, result: &Result<(), Arc<str>>) {
        let mut all = self.0.lock();
        let introduced = match result {
            Ok(()) => Introduced::Accepted,
            Err(why) => {
                let pause = match all.get(&key) {
                    Some(Introduced::Refused { pause, .. }) => (*pause * 2).min(LONGEST_PAUSE),
                    _ => FIRST_PAUSE,
                };
                Introduced::Refused {
                    why: Arc::clone(why),
                    until: now + pause,
                    pause,
                }
            }
        };
        if all.len() >= MAX_REMEMBERED && !all.contains_key(&key) {
            all.clear();
        }
        all.insert(key, introduced);
    }

    /// Records that the gateway accepted the introduction of an agent.
    pub(crate) fn accepted(&self, id: &AgentId) {
        self.remember(Instant::now(), Key::of(id), &Ok(()));
    }

    /// Introduces an agent to the gateway of this host.
    async fn introduce(
        &self,
        domain: &Domain,
        id: &AgentId,
        timeout: Duration,
    ) -> Result<(), Arc<str>> {
        let key = Key::of(id);
        if let Some(why) = self.refusal(Instant::now(), &key) {
            return Err(why);
        }
        // Not remembered: a gateway may start at any moment.
        let gateway = gateway_of(domain)?;
        let asked = ask(domain, &gateway, id, timeout.min(TIMEOUT)).await;
        let asked = asked.map_err(Arc::from);
        self.remember(Instant::now(), key, &asked);
        asked
    }
}

/// Returns the entry of the gateway of this host.
fn gateway_of(domain: &Domain) -> Result<Arc<Entry>, Arc<str>> {
    let entries = domain.inner.service.host.entries();
    let gateway = entries.iter().find(|entry| entry.is_own_gateway()).cloned();
    gateway.ok_or_else(|| {
        "no gateway is running on this host, and only gateways reach other platforms; start one with `fipa up`".into()
    })
}

async fn ask(
    domain: &Domain,
    gateway: &Entry,
    id: &AgentId,
    timeout: Duration,
) -> Result<(), String> {
    let options = RegisterOptions {
        agent_type: routes::ASKER_TYPE.to_owned(),
        ..RegisterOptions::default()
    };
    let name = format!("fipa-contact-{}", Incarnation::random());
    let asker = domain.register_with(&name, options).await;
    let asker = asker.map_err(|error| ErrorChain(&error).to_string())?;
    let introduced = contact::introduce(&asker, gateway, id, timeout).await;
    introduced.map_err(|error| match error {
        contact::IntroduceError::Refused(why) => why,
        other => ErrorChain(&other).to_string(),
    })
}

/// The letters of an agent that wait for introductions.
#[derive(Default)]
pub(crate) struct HeldLetters(Arc<Held>);

#[derive(Default)]
struct Held {
    /// Number of letters that wait or are about to be sent. While it is not zero, all letters wait.
    count: AtomicUsize,
    queue: Mutex<Queue>,
}

#[derive(Default)]
struct Queue {
    letters: VecDeque<HeldLetter>,
    bytes: usize,
    is_closed: bool,
}

struct HeldLetter {
    letter: Letter,
    receivers: Vec<AgentId>,
    until: Instant,
    sent: oneshot::Sender<Vec<Sending>>,
}

/// A letter that waits. It yields what was sent, or ends without a value if the agent ends.
pub(crate) type Waiting = oneshot::Receiver<Vec<Sending>>;

/// The error of [`HeldLetters::hold`]: too many letters wait. Returns the letter.
pub(crate) struct Full;

impl HeldLetters {
    /// Whether a letter to these receivers has to wait.
    pub(crate) fn must_hold(&self, domain: &Domain, receivers: &[AgentId]) -> bool {
        let (introductions, host) = (&domain.inner.introductions, &*domain.inner.service.host);
        self.0.count.load(Ordering::Acquire) > 0
            || receivers.iter().any(|it| introductions.needs(it, host))
    }

    /// Makes a letter wait until its receivers are introduced, and sends it then.
    pub(crate) fn hold(
        &self,
        domain: &Domain,
        sender: Incarnation,
        (letter, receivers): (Letter, &[AgentId]),
        deadline: Duration,
    ) -> Result<Waiting, Full> {
        let (sent, waiting) = oneshot::channel();
        let mut queue = self.0.queue.lock();
        let (count, bytes) = (queue.letters.len(), queue.bytes);
        let is_full = bytes > 0 && bytes + letter.len() > MAX_WAITING_BYTES;
        if count >= MAX_WAITING || is_full {
            return Err(Full);
        }
        queue.bytes += letter.len();
        queue.letters.push_back(HeldLetter {
            letter,
            receivers: receivers.to_vec(),
            until: Instant::now() + deadline,
            sent,
        });
        // The task that sends the letters ends when it finds none, with the queue locked.
        if self.0.count.fetch_add(1, Ordering::AcqRel) == 0 {
            let (held, domain) = (Arc::clone(&self.0), domain.clone());
            let runtime = domain.inner.service.runtime.clone();
            runtime.spawn(send_all(held, domain, sender));
        }
        Ok(waiting)
    }

    /// Drops the letters that wait, because the agent ends.
    pub(crate) fn close(&self) {
        let mut queue = self.0.queue.lock();
        queue.is_closed = true;
        queue.letters.clear();
        queue.bytes = 0;
    }
}

/// Sends the letters of an agent in their order until none waits.
fn send_all(
    held: Arc<Held>,
    domain: Domain,
    sender: Incarnation,
) -> Pin<Box<dyn Future<Output = ()> + Send>> {
    Box::pin(async move {
        loop {
            let next = {
                let mut queue = held.queue.lock();
                let next = queue.letters.pop_front();
                match &next {
                    Some(letter) => queue.bytes -= letter.letter.len(),
                    None => held.count.store(0, Ordering::Release),
                }
                next
            };
            let Some(next) = next else {
                return;
            };
            let refused = introduce_all(&domain, &next).await;
            // A letter of an agent that has ended is not sent.
            let is_closed = held.queue.lock().is_closed;
            if !is_closed {
                let sent = send(
                    &domain.inner.service.mts,
                    sender,
                    next.letter,
                    &next.receivers,
                    next.until,
                    refused,
                );
                // The caller may not wait for the outcomes.
                drop(next.sent.send(sent));
            }
        }
    })
}

/// Introduces the receivers of a letter that no directory lists. Returns those that cannot be reached, with the
/// reasons.
async fn introduce_all(domain: &Domain, letter: &HeldLetter) -> Vec<(AgentId, Arc<str>)> {
    let introductions = &domain.inner.introductions;
    let mut refused = Vec::new();
    for receiver in &letter.receivers {
        // The directory may have it by now.
        if !introductions.needs(receiver, &*domain.inner.service.host) {
            continue;
        }
        let left = letter.until.saturating_duration_since(Instant::now());
        if let Err(why) = introductions.introduce(domain, receiver, left).await {
            refused.push((receiver.clone(), why));
        }
    }
    refused
}

fn send(
    mts: &Mts,
    sender: Incarnation,
    letter: Letter,
    receivers: &[AgentId],
    until: Instant,
    refused: Vec<(AgentId, Arc<str>)>,
) -> Vec<Sending> {
    let mut sent = Vec::new();
    let reached = receivers
        .iter()
        .filter(|it| !refused.iter().any(|(other, _)| other == *it));
    let reached: Vec<AgentId> = reached.cloned().collect();
    if !reached.is_empty() {
        let left = until.saturating_duration_since(Instant::now());
        sent.push(mts.submit_to_agents(sender, letter.clone(), &reached, left));
    }
    for (receiver, why) in refused {
        let addresses = receiver.addresses().iter();
        let location = addresses
            .filter_map(|it| it.parse::<Location>().ok())
            .next();
        let attempt = location.map(|location| Attempt {
            via: location.kind(),
            location,
            error: TransportError::new(TransportErrorKind::Refused, &*why),
        });
        let attempts = attempt.into_iter().collect();
        sent.push(mts.fail_unreachable(sender, letter.clone(), receiver.name().into(), attempts));
    }
    sent
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refused_introduction_is_repeated_after_a_growing_pause() {
        let introductions = Introductions::default();
        let id = AgentId::new("echo@jade")
            .unwrap()
            .with_address("http://10.0.0.7/acc");
        let key = Key::of(&id.unwrap().received());
        let start = Instant::now();
        let mut at = start;
        for pause in [500, 1000, 2000, 4000, 8000, 16_000, 32_000, 60_000, 60_000] {
            assert_eq!(introductions.refusal(at, &key), None);
            introductions.remember(at, key.clone(), &Err("no".into()));
            let pause = Duration::from_millis(pause);
            let before = at + pause - Duration::from_millis(1);
            assert!(introductions.refusal(before, &key).is_some());
            at += pause;
        }
        introductions.remember(at, key.clone(), &Ok(()));
        introductions.remember(at, key.clone(), &Err("no".into()));
        assert_eq!(introductions.refusal(at + FIRST_PAUSE, &key), None);
        // Another identifier of the same name is another introduction.
        let own = Key {
            is_received: false,
            ..key.clone()
        };
        assert_eq!(introductions.refusal(at, &own), None);
        for number in 0..2 * MAX_REMEMBERED {
            let other = Key {
                name: number.to_string(),
                ..key.clone()
            };
            introductions.remember(at, other, &Ok(()));
        }
        assert!(introductions.0.lock().len() <= MAX_REMEMBERED);
    }
}
