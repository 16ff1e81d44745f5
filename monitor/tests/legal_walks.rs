//! Random legal conversations among agents with slow routes: no message is refused, neither by the
//! monitors of the agents nor by an observer.
//!
//! The agents follow their protocols by what they have sent and received. Letters cross, are not
//! delivered and are sent again, go to groups, and carry `in-reply-to` or not. Monitors forget
//! conversations, restart, and move with their agents. An intruder guesses identifiers.
//!
//! `FIPA_WALK_STEPS` sets the number of steps for each seed, `FIPA_WALK_SEEDS` the number of seeds, and
//! `FIPA_WALK_FIRST` the first one. `FIPA_WALK_SEED` repeats one seed.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::cell::RefCell;
use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, SystemTime};

use fastrand::Rng;
use fipa_acl::Performative;
use fipa_monitor::{
    Header, History, Library, Machine, Monitor, MonitorLimits, Scope, State, Transition,
};
use regex::Regex;

const AGENTS: [&str; 5] = ["ann", "ben", "cid", "dan", "eve"];

static ACTS: LazyLock<Vec<&'static str>> = LazyLock::new(|| {
    let names = Performative::STANDARD.iter();
    names.map(|act| &*act.as_str().to_owned().leak()).collect()
});

/// A letter to one receiver.
#[derive(Debug, Clone)]
struct Letter {
    talk: usize,
    act: &'static str,
    from: usize,
    to: usize,
    /// The receivers in the message.
    named: Vec<&'static str>,
    /// The members of a group that is among them.
    members: Vec<&'static str>,
    reply_with: Option<String>,
    in_reply_to: Option<String>,
}

/// One side of a conversation between two agents, as the agent of that side knows it.
#[derive(Debug, Clone, Default)]
struct View {
    state: String,
    /// The `reply-with` of the last message that the agent sent, and of the last that it received.
    sent: Option<String>,
    received: Option<String>,
    /// The `reply-with` of its cancel.
    canceled: Option<String>,
    over: bool,
}

struct Talk<'l> {
    id: String,
    machine: &'l Machine,
    initiator: usize,
    participants: Vec<usize>,
    /// The views of the initiator and of the participant, for each participant.
    views: Vec<[View; 2]>,
    /// Whether its agents write `in-reply-to`.
    replies: bool,
    /// The participants that have sent a message which only one of them may send, such as a token.
    only: HashMap<&'static str, usize>,
    token: Token,
}

/// The agent that has the token of a lock. Without it, the initiator does not enter (`confirm`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Token {
    None,
    OfInitiator,
    OfParticipant,
}

struct World<'l> {
    rng: Rng,
    library: &'l Library,
    shared: Arc<Library>,
    monitors: Vec<Monitor>,
    observer: Monitor,
    talks: Vec<Talk<'l>>,
    /// Letters under way, one queue for each pair of agents.
    under_way: Vec<VecDeque<Letter>>,
    now: SystemTime,
    texts: u64,
    log: Vec<String>,
    counts: [u64; 5],
}

fn options<'m>(machine: &'m Machine, id: &str) -> Vec<&'m Transition> {
    let state = machine.states().iter().find(|state| state.id() == id);
    let mut all = Vec::new();
    for step in state.map_or(&[][..], State::transitions) {
        all.push(step);
        if step.is_optional() {
            all.extend(options(machine, machine.target(step)));
        }
    }
    all
}

fn matches(pattern: &str, text: &str) -> bool {
    thread_local! {
        static KNOWN: RefCell<HashMap<String, Regex>> = RefCell::default();
    }
    pattern == text
        || KNOWN.with_borrow_mut(|known| {
            let compiled = || Regex::new(&format!("^(?:{pattern})$")).unwrap();
            let known = known.entry(pattern.to_owned()).or_insert_with(compiled);
            known.is_match(text)
        })
}

/// Whether its messages are repeated without `reply-with`.
fn is_of_locks(machine: &Machine) -> bool {
    let of_locks = ["dlm_", "owner_queue", "ricart_agrawala", "suzuki_kasami"];
    of_locks
        .iter()
        .any(|prefix| machine.name().starts_with(prefix))
}

/// Whether both sides may send in one state, so that messages cross.
fn is_mixed(machine: &Machine) -> bool {
    let begins = |step: &&Transition| step.from() == machine.initiator();
    machine.states().iter().any(|state| {
        let all = options(machine, state.id());
        all.iter().any(begins) && !all.iter().all(begins)
    })
}

impl<'l> World<'l> {
    fn new(seed: u64, library: &'l Library) -> Self {
        let shared = Arc::new(library.clone());
        let mut world = Self {
            rng: Rng::with_seed(seed),
            library,
            monitors: Vec::new(),
            observer: Monitor::observer(Arc::clone(&shared)),
            shared,
            talks: Vec::new(),
            under_way: vec![VecDeque::new(); AGENTS.len() * AGENTS.len()],
            now: SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000),
            texts: 0,
            log: Vec::new(),
            counts: [0; 5],
        };
        for agent in 0..AGENTS.len() {
            let monitor = world.monitor(agent, History::Complete);
            world.monitors.push(monitor);
        }
        world
    }

    fn monitor(&mut self, agent: usize, history: History) -> Monitor {
        let mut limits = MonitorLimits::default();
        // Some monitors forget conversations.
        limits.conversations = if self.rng.bool() { 6 } else { 100_000 };
        let monitor = Monitor::agent(Arc::clone(&self.shared), AGENTS[agent]);
        monitor.with_limits(limits).with_history(history)
    }

    fn text(&mut self) -> String {
        self.texts += 1;
        format!("t{}", self.texts)
    }

    fn header(&self, letter: &Letter) -> Header<'static> {
        let talk = &self.talks[letter.talk];
        let mut header = Header::new(letter.act.parse().unwrap())
            .sender(AGENTS[letter.from])
            .receivers(letter.named.clone())
            .protocol(talk.machine.name().to_owned())
            .conversation_id(talk.id.clone());
        if let Some(text) = &letter.reply_with {
            header = header.reply_with(text.clone());
        }
        if let Some(text) = &letter.in_reply_to {
            header = header.in_reply_to(text.clone());
        }
        header
    }

    fn judge(&mut self, by: Option<usize>, header: &Header<'_>, what: String) {
        let now = self.now;
        let monitor = match by {
            Some(agent) => &mut self.monitors[agent],
            None => &mut self.observer,
        };
        let verdict = monitor.check(header, now);
        let by = by.map_or("observer", |agent| AGENTS[agent]);
        self.log.push(format!("{by}: {what}"));
        self.counts[usize::from(!verdict.is_accepted())] += 1;
        if let Some(violation) = verdict.violation() {
            let id = format!("{:?}", violation.conversation_id);
            let concerns = |line: &&String| line.contains(&id) || !line.contains(':');
            let own: Vec<&String> = self.log.iter().filter(concerns).collect();
            let last = &own[own.len().saturating_sub(60)..];
            panic!("{by}: {violation}\n{last:#?}");
        }
    }

    fn begin(&mut self) {
        let machines: Vec<&'l Machine> = self.library.iter().collect();
        let machine = machines[self.rng.usize(..machines.len())];
        let embeds = machine
            .states()
            .iter()
            .any(|state| !state.subprotocols().is_empty());
        // In this test, a cancel is that of another protocol.
        let is_cancel = machine.name() == "fipa-cancel";
        if machine.scope() != Scope::Participant || embeds || is_cancel {
            return;
        }
        let initiator = self.rng.usize(..AGENTS.len());
        let mut participants: Vec<usize> = (0..AGENTS.len())
            .filter(|other| *other != initiator)
            .collect();
        self.rng.shuffle(&mut participants);
        participants.truncate(self.rng.usize(1..=3));
        let view = View {
            state: machine.initial().id().to_owned(),
            ..View::default()
        };
        let number = self.talks.len();
        self.talks.push(Talk {
            id: format!("c{number}"),
            machine,
            initiator,
            views: vec![[view.clone(), view]; participants.len()],
            participants,
            replies: !is_of_locks(machine) && (is_mixed(machine) || self.rng.bool()),
            only: HashMap::new(),
            token: match machine.name().starts_with("suzuki_kasami") {
                false => Token::None,
                true if self.rng.bool() => Token::OfInitiator,
                true => Token::OfParticipant,
            },
        });
        let everyone: Vec<usize> = (0..self.talks[number].participants.len()).collect();
        self.speak(number, &everyone, true);
    }

    /// One side sends a message that its view allows, to these participants.
    fn speak(&mut self, number: usize, to: &[usize], by_initiator: bool) {
        let side = usize::from(!by_initiator);
        let talk = &self.talks[number];
        let machine = talk.machine;
        let first = &talk.views[to[0]][side];
        if first.over {
            return;
        }
        let mut choices: Vec<(&'static str, String)> = Vec::new();
        if first.canceled.is_none() {
            for step in options(machine, &first.state) {
                let passes = |act: &str| {
                    let other = talk.only.get(act).is_some_and(|at| *at != to[0]);
                    let has_token = match (talk.token, act) {
                        (Token::OfInitiator, "request") => talk.only.contains_key("propagate"),
                        (Token::OfInitiator, "propagate") => {
                            by_initiator
                                || machine.name() != "suzuki_kasami"
                                    && talk.only.contains_key("propagate")
                        }
                        (Token::OfParticipant, "confirm") => false,
                        // In the basic variant, the token is passed once.
                        (Token::OfParticipant, "propagate") => {
                            machine.name() != "suzuki_kasami"
                                || !talk.only.contains_key("propagate")
                        }
                        _ => true,
                    };
                    has_token && (by_initiator || step.at_most() != Some(1) || !other)
                };
                let own = (step.from() == machine.initiator()) == by_initiator;
                let full = step.at_most().is_some_and(|most| {
                    let there = |views: &&[View; 2]| views[0].state == machine.target(step);
                    talk.views.iter().filter(there).count() + to.len() > usize::from(most)
                });
                if own && !full {
                    let fits = ACTS.iter().filter(|act| matches(step.performative(), act));
                    let fits = fits.filter(|act| passes(act));
                    choices.extend(fits.map(|act| (*act, machine.target(step).to_owned())));
                }
            }
        }
        let begun = first.state != machine.initial().id();
        let ended = options(machine, &first.state).is_empty();
        let mut states = machine.states().iter();
        let is_final = states.any(|state| state.id() == first.state && state.is_final());
        let cancels = machine.cancel() != fipa_monitor::Cancel::Nobody && by_initiator;
        if cancels && begun && !ended && first.canceled.is_none() && self.rng.u8(..) < 25 {
            choices = vec![("cancel", first.state.clone())];
        } else if !by_initiator && begun && !ended && !is_final && self.rng.u8(..) < 3 {
            choices = vec![("not-understood", first.state.clone())];
        }
        if choices.is_empty() {
            return;
        }
        let (act, target) = choices[self.rng.usize(..choices.len())].clone();
        self.post(number, to, by_initiator, act, &target, None);
    }

    fn post(
        &mut self,
        number: usize,
        to: &[usize],
        by_initiator: bool,
        act: &'static str,
        target: &str,
        answers: Option<String>,
    ) {
        let side = usize::from(!by_initiator);
        let text = self.text();
        let grouped = to.len() > 1 && by_initiator && self.rng.bool();
        let lost = to.len() == 1 && self.rng.u8(..) < 12;
        let talk = &self.talks[number];
        let from = match by_initiator {
            true => talk.initiator,
            false => talk.participants[to[0]],
        };
        let receivers: Vec<usize> = match by_initiator {
            true => to.iter().map(|at| talk.participants[*at]).collect(),
            false => vec![talk.initiator],
        };
        let names: Vec<&'static str> = receivers.iter().map(|to| AGENTS[*to]).collect();
        let received = talk.views[to[0]][side].received.clone();
        let in_reply_to = match to.len() {
            1 => answers.or(received).filter(|_| talk.replies),
            _ => None,
        };
        let mut letter = Letter {
            talk: number,
            act,
            from,
            to: receivers[0],
            named: if grouped {
                vec!["platoon"]
            } else {
                names.clone()
            },
            members: if grouped { names.clone() } else { Vec::new() },
            reply_with: (talk.replies || act == "cancel").then(|| text.clone()),
            in_reply_to,
        };
        if !self.talks[number].replies {
            letter.reply_with = None;
        }
        let mut header = self.header(&letter);
        if grouped {
            header = header.group("platoon", letter.members.clone());
        }
        let what = format!("sends {act} in {:?}: {letter:?}", self.talks[number].id);
        self.judge(Some(from), &header, what);
        if lost {
            self.counts[2] += 1;
            let (now, receiver) = (self.now, AGENTS[receivers[0]]);
            // The own service knows it at once, and another one sends a letter.
            let is_reported = self.rng.bool();
            self.log.push(format!(
                "lost: {is_reported} in {:?}",
                self.talks[number].id
            ));
            if is_reported {
                let report = Header::new(Performative::Failure)
                    .sender("host-mts")
                    .receivers([AGENTS[from]])
                    .protocol(self.talks[number].machine.name().to_owned())
                    .conversation_id(self.talks[number].id.clone())
                    .undelivered_to(receiver);
                self.monitors[from].check(&report, now);
            } else {
                self.monitors[from].undelivered(&header, receiver, now);
            }
            return;
        }
        if !by_initiator {
            self.talks[number].only.insert(act, to[0]);
        }
        for (at, receiver) in to.iter().zip(&receivers) {
            let view = &mut self.talks[number].views[*at][side];
            if act == "cancel" {
                view.canceled = Some(text.clone());
            } else if answers_cancel(view) {
                // The answer to a cancel leaves the state.
            } else {
                view.state = target.to_owned();
                view.sent = Some(text.clone());
                view.received = None;
            }
            view.over |= act == "not-understood";
            let copy = Letter {
                to: *receiver,
                ..letter.clone()
            };
            let observed = self.header(&letter).copy_for(AGENTS[*receiver]);
            let what = format!(
                "{act} in {:?} to {}",
                self.talks[number].id, AGENTS[*receiver]
            );
            self.judge(None, &observed, what);
            self.under_way[from * AGENTS.len() + receiver].push_back(copy);
        }
    }

    fn deliver(&mut self) {
        let queue = self.rng.usize(..self.under_way.len());
        let Some(letter) = self.under_way[queue].pop_front() else {
            return;
        };
        let header = self.header(&letter);
        let what = format!(
            "gets {} in {:?}: {letter:?}",
            letter.act, self.talks[letter.talk].id
        );
        self.judge(Some(letter.to), &header, what);
        let number = letter.talk;
        let talk = &mut self.talks[number];
        let by_initiator = letter.from == talk.initiator;
        let peer = if by_initiator { letter.to } else { letter.from };
        let at = talk
            .participants
            .iter()
            .position(|agent| *agent == peer)
            .unwrap();
        let machine = talk.machine;
        let view = &mut talk.views[at][usize::from(by_initiator)];
        if view.over {
            return;
        }
        if letter.act == "not-understood" {
            view.over = true;
            return;
        }
        if letter.act == "cancel" {
            let act = if self.rng.u8(..) < 60 {
                "failure"
            } else {
                "inform"
            };
            let state = view.state.clone();
            if act == "inform" {
                view.over = true;
            }
            self.answer_cancel(number, at, act, &state, letter.reply_with.clone());
            return;
        }
        let answer = ["inform", "failure"].contains(&letter.act);
        let told = letter.in_reply_to.is_some() && letter.in_reply_to == view.canceled;
        if view.canceled.is_some() && answer && (told || !talk.replies) {
            view.canceled = None;
            // Without `in-reply-to`, the agent takes the first answer for that to its cancel.
            view.over = letter.act == "inform" || !talk.replies;
            return;
        }
        if letter.act == "propagate" && !by_initiator {
            talk.token = Token::OfInitiator;
        }
        // An answer to an earlier message is void.
        if letter.in_reply_to.is_some() && view.sent.is_some() && letter.in_reply_to != view.sent {
            self.counts[3] += 1;
            return;
        }
        let step = options(machine, &view.state).into_iter().find(|step| {
            matches(step.performative(), letter.act)
                && (step.from() == machine.initiator()) == by_initiator
        });
        if let Some(step) = step {
            view.state = machine.target(step).to_owned();
            view.received.clone_from(&letter.reply_with);
        }
    }

    fn answer_cancel(
        &mut self,
        number: usize,
        at: usize,
        act: &'static str,
        state: &str,
        to: Option<String>,
    ) {
        let kept = self.talks[number].views[at][1].clone();
        self.post(number, &[at], false, act, state, to);
        // The answer is no step of the protocol itself.
        let view = &mut self.talks[number].views[at][1];
        (view.state, view.sent, view.received) = (kept.state, kept.sent, kept.received);
    }

    /// An intruder uses the identifier of another conversation.
    fn intrude(&mut self) {
        let number = self.rng.usize(..self.talks.len());
        let receiver = self.rng.usize(..AGENTS.len());
        let machines: Vec<&Machine> = self.library.iter().collect();
        let machine = machines[self.rng.usize(..machines.len())];
        let begins = options(machine, machine.initial().id())[0].performative();
        let begins = ACTS.iter().find(|act| matches(begins, act)).unwrap();
        let act = match self.rng.bool() {
            true => ACTS[self.rng.usize(..ACTS.len())],
            false => begins,
        };
        // Sometimes the next identifier.
        let number = number.max(self.talks.len() * usize::from(self.rng.bool()));
        let header = Header::new(act.parse().unwrap())
            .sender("mallory")
            .receivers([AGENTS[receiver]])
            .protocol(machine.name())
            .conversation_id(format!("c{number}"));
        let now = self.now;
        self.log
            .push(format!("mallory: {act} in {:?}", format!("c{number}")));
        self.monitors[receiver].check(&header, now);
        self.observer.check(&header, now);
    }

    /// An agent moves, and takes its conversations along.
    fn move_agent(&mut self) {
        let agent = self.rng.usize(..AGENTS.len());
        let taken = self.monitors[agent].snapshot(self.now);
        let mut monitor = self.monitor(agent, History::Unknown);
        self.counts[4] += monitor.restore(&taken, self.now).unwrap() as u64;
        self.monitors[agent] = monitor;
        self.log.push(format!("move of {}", AGENTS[agent]));
    }

    fn step(&mut self) {
        self.now += Duration::from_millis(self.rng.u64(0..60));
        match self.rng.u8(..) {
            0..8 => self.begin(),
            8 => {
                let agent = self.rng.usize(..AGENTS.len());
                self.monitors[agent] = self.monitor(agent, History::Unknown);
                self.log.push(format!("restart of {}", AGENTS[agent]));
            }
            9 => self.move_agent(),
            10..20 if !self.talks.is_empty() => self.intrude(),
            20..80 if !self.talks.is_empty() => {
                // One of the last conversations.
                let recent = self.talks.len().saturating_sub(8);
                let number = self.rng.usize(recent..self.talks.len());
                let at = self.rng.usize(..self.talks[number].participants.len());
                let by_initiator = self.rng.bool();
                self.speak(number, &[at], by_initiator);
            }
            _ => self.deliver(),
        }
        if self.log.len() > 6_000 {
            self.log.drain(..3_000);
        }
        if self.rng.u8(..) == 0 {
            let now = self.now;
            for monitor in &mut self.monitors {
                monitor.handle_timeout(now);
            }
            self.observer.handle_timeout(now);
        }
    }
}

/// Whether the view is that of a participant that has agreed to a cancel.
fn answers_cancel(view: &View) -> bool {
    view.over
}

#[test]
fn no_legal_message_is_refused() {
    let number = |name: &str| {
        let text = std::env::var(name).ok();
        text.map(|text| text.parse::<u64>().unwrap())
    };
    let steps = number("FIPA_WALK_STEPS").unwrap_or(5_000);
    let repeated = number("FIPA_WALK_SEED");
    let first = repeated.or_else(|| number("FIPA_WALK_FIRST")).unwrap_or(0);
    let count = repeated.map_or_else(|| number("FIPA_WALK_SEEDS").unwrap_or(30), |_| 1);
    let library = Library::standard();
    let mut all = [0; 5];
    for seed in first..first + count {
        println!("seed {seed}");
        let mut world = World::new(seed, &library);
        for _ in 0..steps {
            world.step();
        }
        for (sum, count) in all.iter_mut().zip(world.counts) {
            *sum += count;
        }
    }
    let [accepted, unchecked, lost, crossed, moved] = all;
    println!(
        "{accepted} accepted, {unchecked} unchecked, {lost} lost, {crossed} crossed, {moved} moved"
    );
    // A single walk may have few events of one kind.
    if repeated.is_none() {
        assert!(accepted > steps && unchecked > steps / 20 && lost > 0 && crossed > 0 && moved > 0);
    }
}
