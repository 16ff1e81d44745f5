//! Signs of life between gateways: whether registrations on other hosts still exist.
//!
//! Agents of this host ask about registrations that their calls wait for. [`Questions`] collects them,
//! without I/O, into one letter per gateway at a time, and passes the answers on. [`GatewayAgent`] is the
//! shell.
//!
//! A gateway answers questions about registrations of its own host only, and its answers count only for
//! its own registrations.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, ErrorChain, Message, Performative};
use fipa_mts::core::Received;
use fipa_sds::{Directory, Entry, Reach, Role, Source};
use fipa_transport::{Incarnation, PeerId, TokenBucket, log_limit};

use super::GatewayAgent;
use crate::domain::presence::{self, Answer, Asked, MAX_ASKED};

/// Time for which further questions to a gateway wait for its answer to the previous letter.
const IN_FLIGHT: Duration = Duration::from_millis(200);
/// Time after which an agent's question without an answer is forgotten. The agent asks again earlier.
const MEMORY: Duration = Duration::from_secs(30);
/// Maximum number of remembered questions.
const MAX_QUESTIONS: usize = 4_096;

/// Bytes of questions that one peer may send at once, and a second afterwards. Four questions of the largest size a
/// second are more than a gateway asks that has no answer.
const QUESTION_BYTES: f64 = 512.0 * 1024.0;
const QUESTION_BYTES_PER_SECOND: f64 = 64.0 * 1024.0;

/// The rates of the questions of other gateways: the letters to the gateway wait while one is answered.
#[derive(Debug, Default)]
pub(in crate::gateway) struct QuestionRates {
    /// The peers that asked within the time in which a bucket fills.
    rate_limits: HashMap<PeerId, TokenBucket>,
}

impl QuestionRates {
    /// Whether a question of this length is answered.
    fn admits(&mut self, now: Instant, peer: &PeerId, len: usize) -> bool {
        let memory = Duration::from_secs_f64(QUESTION_BYTES / QUESTION_BYTES_PER_SECOND);
        if !self.rate_limits.contains_key(peer) {
            self.rate_limits
                .retain(|_, bucket| now.saturating_duration_since(bucket.asked()) < memory);
        }
        let bucket = self.rate_limits.entry(peer.clone());
        let bucket = bucket.or_insert_with(|| TokenBucket::new(QUESTION_BYTES, now));
        let (rate, burst) = (QUESTION_BYTES_PER_SECOND, QUESTION_BYTES);
        bucket.take_of(len as f64, rate, burst, now)
    }
}

/// The questions of agents of this host that other gateways are to answer.
#[derive(Debug, Default)]
pub(in crate::gateway) struct Questions {
    of: HashMap<Incarnation, OfGateway>,
    /// The letters that wait for an answer, by agent and conversation.
    open: HashMap<(Incarnation, String), Open>,
}

/// The questions to one gateway.
#[derive(Debug, Default)]
struct OfGateway {
    /// The registrations to ask for in the next letter.
    due: HashSet<Incarnation>,
    /// The registrations of the letters without an answer.
    asked: HashSet<Incarnation>,
    sent: Option<Instant>,
}

/// The question of an agent.
#[derive(Debug)]
struct Open {
    question: Message,
    since: Instant,
    registrations: Vec<Asked>,
}

/// An answer for an agent of this host.
#[derive(Debug)]
pub(super) struct Reply {
    pub(super) agent: Incarnation,
    pub(super) question: Message,
    pub(super) answer: Answer,
}

impl Questions {
    /// Handles the question of an agent about registrations on other hosts.
    pub(super) fn handle_question(
        &mut self,
        now: Instant,
        agent: Incarnation,
        question: &Message,
        registrations: Vec<Asked>,
    ) {
        self.forget(now);
        let conversation = question.conversation_id().unwrap_or_default().to_owned();
        let key = (agent, conversation);
        if self.open.len() >= MAX_QUESTIONS && !self.open.contains_key(&key) {
            return;
        }
        for Asked { id, mts } in &registrations {
            self.of.entry(*mts).or_default().due.insert(*id);
        }
        let open = Open {
            question: question.clone(),
            since: now,
            registrations,
        };
        self.open.insert(key, open);
    }

    /// Handles the answer of a gateway. `None` means that it does not answer such questions.
    pub(super) fn handle_answer(
        &mut self,
        now: Instant,
        from: Incarnation,
        answer: Option<&Answer>,
    ) -> Vec<Reply> {
        self.forget(now);
        let Some(gateway) = self.of.get_mut(&from) else {
            return Vec::new();
        };
        gateway.sent = None;
        let asked = std::mem::take(&mut gateway.asked);
        let (registered, gone): (HashSet<_>, HashSet<_>) = match answer {
            Some(answer) => (
                answer.here.iter().copied().collect(),
                answer.gone.iter().copied().collect(),
            ),
            None => (HashSet::new(), HashSet::new()),
        };
        let mut replies = Vec::new();
        self.open.retain(|(agent, _), open| {
            let mut settled = Answer::default();
            open.registrations.retain(|Asked { id, mts }| {
                if *mts != from || !asked.contains(id) {
                    return true;
                }
                match answer {
                    Some(_) if registered.contains(id) => settled.here.push(*id),
                    Some(_) if gone.contains(id) => settled.gone.push(*id),
                    Some(_) => return true,
                    None => settled.unsupported.push(*id),
                }
                false
            });
            if settled != Answer::default() {
                replies.push(Reply {
                    agent: *agent,
                    question: open.question.clone(),
                    answer: settled,
                });
            }
            !open.registrations.is_empty()
        });
        replies
    }

    /// Returns the next letter: the gateway, and the registrations to ask it for.
    pub(super) fn poll_letter(&mut self, now: Instant) -> Option<(Incarnation, Vec<Asked>)> {
        for (gateway, of) in &mut self.of {
            let waits = of.sent.is_some_and(|sent| now < sent + IN_FLIGHT);
            if of.due.is_empty() || waits {
                continue;
            }
            let ids: Vec<Incarnation> = of.due.iter().copied().take(MAX_ASKED).collect();
            for id in &ids {
                of.due.remove(id);
                of.asked.insert(*id);
            }
            of.sent = Some(now);
            let mts = *gateway;
            let ask = ids.into_iter().map(|id| Asked { id, mts });
            return Some((mts, ask.collect()));
        }
        None
    }

    /// Forgets the questions that no gateway has answered in time.
    fn forget(&mut self, now: Instant) {
        self.open
            .retain(|_, open| now.saturating_duration_since(open.since) < MEMORY);
        let open = self.open.values().flat_map(|open| &open.registrations);
        let gateways: HashSet<Incarnation> = open.map(|asked| asked.mts).collect();
        self.of.retain(|gateway, _| gateways.contains(gateway));
    }
}

impl GatewayAgent {
    /// Handles a letter about registrations.
    pub(super) fn handle_presence(&self, message: &Message, received: &Received) {
        let content = message.content().map(|content| &content[..]);
        let content = content.unwrap_or_default();
        let is_gateway = received.service == received.sender;
        let now = Instant::now();
        match message.performative() {
            Performative::QueryRef
                if received.remote
                    && !self
                        .question_rates
                        .lock()
                        .admits(now, &received.peer, content.len()) =>
            {
                log_limit::info!(of: received.service, "ignored a question about agents: too many of one peer");
            }
            Performative::QueryRef => match presence::read_question(content) {
                // Another gateway asks about agents of this host.
                Ok(asked) if received.remote && is_gateway => {
                    let answer = self.presence_of(&asked);
                    self.answer_presence(message, received.sender, answer);
                }
                Ok(_) if received.remote => {
                    log_limit::info!(of: received.service, "ignored a question about agents: not from a gateway");
                }
                Ok(asked) => self.handle_local_question(message, received.sender, asked),
                Err(error) => {
                    log_limit::info!(of: received.service, error = %ErrorChain(&error), "ignored a question about agents")
                }
            },
            Performative::Inform if is_gateway => match presence::read_answer(content) {
                Ok(answer) => self.pass_on(received.sender, Some(&answer)),
                Err(error) => {
                    log_limit::info!(of: received.service, error = %ErrorChain(&error), "ignored an answer about agents")
                }
            },
            // The version of the other gateway has no such questions.
            Performative::NotUnderstood if is_gateway => self.pass_on(received.sender, None),
            act => tracing::debug!(performative = %act, "ignored a letter about agents"),
        }
    }

    /// Answers the question of an agent of this host as far as this gateway can, and asks other gateways
    /// for the rest.
    fn handle_local_question(&self, message: &Message, agent: Incarnation, asked: Vec<Asked>) {
        let mut answer = Answer::default();
        let mut others = Vec::new();
        for Asked { id, mts } in asked {
            let known = self.service.host.known_incarnation(id);
            match known {
                Some(entry) if entry.reach == Reach::Local => answer.here.push(id),
                _ if !mts.is_known() => answer.unsupported.push(id),
                // Only the gateway that lists the agent to the one that asks: another gateway may list the
                // registration for an agent of its own.
                _ => others.push(Asked { id, mts }),
            }
        }
        if answer != Answer::default() {
            self.answer_presence(message, agent, answer);
        }
        if !others.is_empty() {
            let now = Instant::now();
            let mut questions = self.questions.lock();
            questions.handle_question(now, agent, message, others);
            drop(questions);
            self.ask_gateways();
        }
    }

    fn pass_on(&self, from: Incarnation, answer: Option<&Answer>) {
        let replies = self
            .questions
            .lock()
            .handle_answer(Instant::now(), from, answer);
        for reply in replies {
            self.answer_presence(&reply.question, reply.agent, reply.answer);
        }
        self.ask_gateways();
    }

    /// Returns the state of these registrations on this host.
    fn presence_of(&self, asked: &[Asked]) -> Answer {
        let host = &self.service.host;
        let is_here = |id: Incarnation| {
            let entry = host.known_incarnation(id);
            entry.is_some_and(|entry| entry.reach == Reach::Local && entry.role == Role::Agent)
        };
        if asked.iter().any(|asked| !is_here(asked.id)) {
            host.refresh();
        }
        let (registered, gone) = asked
            .iter()
            .map(|asked| asked.id)
            .partition(|id| is_here(*id));
        Answer {
            here: registered,
            gone,
            ..Answer::default()
        }
    }

    fn answer_presence(&self, question: &Message, to: Incarnation, answer: Answer) {
        self.answer(question, to, Performative::Inform, |reply| {
            reply.language("json").content(presence::answer(answer))
        });
    }

    /// Sends the questions that are due to other gateways.
    fn ask_gateways(&self) {
        while let Some((gateway, asked)) = {
            let mut questions = self.questions.lock();
            questions.poll_letter(Instant::now())
        } {
            // Without a way to the gateway, the question stays without an answer.
            let Some(entry) = self.entry_of_gateway(gateway, &asked) else {
                continue;
            };
            let question = AgentId::new(&*entry.name).map(|receiver| {
                Message::builder(Performative::QueryRef)
                    .sender(self.id.clone())
                    .receiver(receiver)
                    .ontology(presence::ONTOLOGY)
                    .language("json")
                    .content(presence::question(&asked))
            });
            match question.map(|question| question.build()) {
                Ok(Ok(question)) => self.send(&question, &entry),
                Ok(Err(error)) => {
                    log_limit::warn!(error = %ErrorChain(&error), "cannot ask another gateway")
                }
                Err(error) => {
                    log_limit::warn!(error = %ErrorChain(&error), "cannot ask another gateway")
                }
            }
        }
    }

    /// Returns an entry of a gateway: of the neighbor, or with the locations of one of its agents.
    fn entry_of_gateway(&self, gateway: Incarnation, asked: &[Asked]) -> Option<Arc<Entry>> {
        let neighbors = self.neighbors.all().into_iter();
        let mut neighbors = neighbors.map(|neighbor| neighbor.entry);
        if let Some(entry) = neighbors.find(|entry| entry.incarnation == gateway) {
            return Some(entry);
        }
        let mut agents = asked
            .iter()
            .filter_map(|asked| self.view.known_incarnation(asked.id));
        let agent = agents.find(|agent| agent.mts.incarnation == gateway)?;
        Some(Arc::new(Entry {
            name: agent.mts.name.clone()?,
            agent_type: String::new(),
            incarnation: gateway,
            locations: agent.locations.clone(),
            mts: agent.mts.clone(),
            description: String::new(),
            registered: agent.registered,
            source: Source::Contact,
            reach: Reach::Remote { gateway },
            peer: agent.peer.clone(),
            role: Role::Gateway,
        }))
    }
}

/// Runs [`Questions`] with questions of agents and answers of gateways, for the fuzz target.
///
/// * Every content is a question or an answer, or is refused. Those that are read are the same after
///   they are written and read again.
/// * A gateway is asked for its own registrations, and its answers count for these only.
/// * The memory is bounded.
#[cfg(feature = "fuzzing")]
pub(crate) fn play(bytes: &[u8]) {
    if let Ok(asked) = presence::read_question(bytes) {
        let again = presence::read_question(&presence::question(&asked));
        assert!(again.is_ok_and(|again| again == asked));
    }
    if let Ok(answer) = presence::read_answer(bytes) {
        let again = presence::read_answer(&presence::answer(answer.clone()));
        assert!(again.is_ok_and(|again| again == answer));
    }
    let id = |number: u8| Incarnation::from_u64(u64::from(number) + 1);
    let (mut questions, mut now) = (Questions::default(), Instant::now());
    // The gateways that were asked for each registration.
    let mut asked_at: HashSet<(Incarnation, Incarnation)> = HashSet::new();
    for step in bytes.chunks_exact(4) {
        let &[kind, one, other, gateway] = step else {
            continue;
        };
        let from = id(gateway % 4);
        let replies = match kind % 4 {
            0 => {
                let conversation = (one % 8).to_string();
                let question = Message::builder(Performative::QueryRef);
                let Ok(question) = question.conversation_id(conversation).build() else {
                    continue;
                };
                let asked = [one, other].map(|number| Asked {
                    id: id(number),
                    mts: from,
                });
                questions.handle_question(now, id(other % 4), &question, asked.to_vec());
                Vec::new()
            }
            1 => {
                let answer = Answer {
                    here: vec![id(one)],
                    gone: vec![id(other)],
                    ..Answer::default()
                };
                questions.handle_answer(now, from, Some(&answer))
            }
            2 => questions.handle_answer(now, from, None),
            _ => {
                now += Duration::from_millis(u64::from(one) * 20);
                questions.forget(now);
                Vec::new()
            }
        };
        for Reply { answer, .. } in replies {
            let mut settled = answer.here.iter().chain(&answer.gone);
            assert!(settled.all(|id| asked_at.contains(&(*id, from))));
            let mut settled = answer.unsupported.iter();
            assert!(settled.all(|id| asked_at.contains(&(*id, from))));
        }
        let mut letters = 0;
        while let Some((gateway, ask)) = questions.poll_letter(now) {
            letters += 1;
            assert!(letters <= 4, "one letter to each gateway at a time");
            assert!(ask.len() <= MAX_ASKED);
            for Asked { id, mts } in ask {
                assert_eq!(mts, gateway);
                asked_at.insert((id, gateway));
            }
        }
        assert!(questions.open.len() <= MAX_QUESTIONS && questions.of.len() <= 4);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(number: u64) -> Incarnation {
        Incarnation::from_u64(number)
    }

    fn question(conversation: &str) -> Message {
        let message = Message::builder(Performative::QueryRef);
        message.conversation_id(conversation).build().unwrap()
    }

    fn asked(registration: u64, gateway: u64) -> Asked {
        Asked {
            id: id(registration),
            mts: id(gateway),
        }
    }

    #[test]
    fn questions_of_one_peer_have_a_rate() {
        let (mut rates, now) = (QuestionRates::default(), Instant::now());
        let peer = |last: u8| PeerId::of_ip([10, 0, 0, last].into());
        let largest = 64 << 10;
        let admitted = |rates: &mut QuestionRates, now, last| {
            let asked = (0..100).filter(|_| rates.admits(now, &peer(last), largest));
            asked.count()
        };
        assert_eq!(admitted(&mut rates, now, 1), 8);
        assert_eq!(admitted(&mut rates, now, 2), 8, "another peer");
        assert_eq!(admitted(&mut rates, now + Duration::from_secs(2), 1), 2);
        for last in 3..=255 {
            rates.admits(now, &peer(last), largest);
        }
        rates.admits(now + Duration::from_secs(60), &peer(0), largest);
        assert_eq!(rates.rate_limits.len(), 1, "the others are forgotten");
    }

    fn registered(registrations: &[u64]) -> Answer {
        Answer {
            here: registrations.iter().copied().map(id).collect(),
            ..Answer::default()
        }
    }

    #[test]
    fn one_letter_at_a_time_asks_a_gateway_for_all_agents() {
        let (mut questions, begun) = (Questions::default(), Instant::now());
        let at = |ms| begun + Duration::from_millis(ms);
        questions.handle_question(at(0), id(1), &question("a"), vec![asked(10, 70)]);
        assert_eq!(
            questions.poll_letter(at(0)),
            Some((id(70), vec![asked(10, 70)]))
        );
        assert_eq!(questions.poll_letter(at(0)), None);
        let both = vec![asked(11, 70), asked(12, 71)];
        questions.handle_question(at(1), id(1), &question("b"), both);
        questions.handle_question(at(2), id(2), &question("a"), vec![asked(11, 70)]);
        let other = questions.poll_letter(at(2));
        assert_eq!(other, Some((id(71), vec![asked(12, 71)])));
        assert_eq!(questions.poll_letter(at(2)), None, "waits for the answer");
        let replies = questions.handle_answer(at(9), id(70), Some(&registered(&[10])));
        assert_eq!(replies.len(), 1);
        assert_eq!(
            (replies[0].agent, &replies[0].answer),
            (id(1), &registered(&[10]))
        );
        let next = questions.poll_letter(at(9));
        assert_eq!(next, Some((id(70), vec![asked(11, 70)])));
        let replies = questions.handle_answer(at(10), id(70), Some(&registered(&[11])));
        let mut agents: Vec<_> = replies.iter().map(|reply| reply.agent).collect();
        agents.sort();
        assert_eq!(agents, [id(1), id(2)]);
        // The question about the other gateway is still open.
        let replies = questions.handle_answer(at(11), id(71), Some(&registered(&[12])));
        assert_eq!(replies[0].question.conversation_id(), Some("b"));
        assert!(questions.open.is_empty());
    }

    #[test]
    fn a_gateway_answers_for_its_own_registrations_only() {
        let (mut questions, now) = (Questions::default(), Instant::now());
        questions.handle_question(now, id(1), &question("a"), vec![asked(10, 70)]);
        questions.handle_question(now, id(1), &question("b"), vec![asked(11, 71)]);
        while questions.poll_letter(now).is_some() {}
        let gone = Answer {
            gone: vec![id(10)],
            ..Answer::default()
        };
        assert!(questions.handle_answer(now, id(71), Some(&gone)).is_empty());
        assert!(questions.handle_answer(now, id(72), Some(&gone)).is_empty());
        let replies = questions.handle_answer(now, id(70), Some(&gone));
        assert_eq!(replies[0].answer, gone);
    }

    #[test]
    fn a_gateway_without_such_questions_is_unsupported() {
        let (mut questions, now) = (Questions::default(), Instant::now());
        questions.handle_question(now, id(1), &question("a"), vec![asked(10, 70)]);
        while questions.poll_letter(now).is_some() {}
        let replies = questions.handle_answer(now, id(70), None);
        assert_eq!(replies[0].answer.unsupported, [id(10)]);
    }

    #[test]
    fn a_silent_gateway_is_asked_again_and_its_questions_are_forgotten() {
        let (mut questions, begun) = (Questions::default(), Instant::now());
        let at = |ms| begun + Duration::from_millis(ms);
        let ask = |questions: &mut Questions, now| {
            questions.handle_question(now, id(1), &question("a"), vec![asked(10, 70)]);
            questions.poll_letter(now).is_some()
        };
        assert!(ask(&mut questions, at(0)));
        assert!(!ask(&mut questions, at(199)));
        assert!(ask(&mut questions, at(200)));
        assert_eq!(questions.open.len(), 1);
        questions.forget(at(40_000));
        assert!(questions.open.is_empty() && questions.of.is_empty());
        for number in 0..MAX_QUESTIONS as u64 + 10 {
            let of = question(&number.to_string());
            questions.handle_question(at(50_000), id(1), &of, vec![asked(10, 70)]);
        }
        assert_eq!(questions.open.len(), MAX_QUESTIONS);
    }
}
