//! Random walks: the monitor and the reference get the same messages and have the same verdicts.
//!
//! `FIPA_WALK_STEPS` sets the number of messages for each seed, `FIPA_WALK_SEEDS` the number of seeds.
//! `FIPA_WALK_SEED` repeats one seed.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
#![expect(clippy::expect_used, reason = "likewise")]

mod reference;

use std::sync::{Arc, LazyLock};
use std::time::{Duration, SystemTime};

use fastrand::Rng;
use fipa_acl::{Performative, Time};
use fipa_monitor::{Header, Library, Machine, Monitor, MonitorLimits, State, Verdict};
use reference::{Reference, ReferenceVerdict, Words, matches, options};

static ACTS: LazyLock<Vec<&'static str>> = LazyLock::new(|| {
    let names = Performative::STANDARD.iter();
    names.map(|act| &*act.as_str().to_owned().leak()).collect()
});

const AGENTS: [&str; 6] = ["ann", "ben", "cid", "dan", "host-mts", "arm_.*"];

/// Files with all features of the format of fipa_acl and with the attributes of the namespace.
const OWN: [(&str, &str); 4] = [
    (
        "plain",
        r#"<scxml initial="1">
        <state id="1"><transition performative="request|propose" from="i" to="B" target="2"/></state>
        <state id="2">
            <transition performative="refuse" from="B" to="i" target="3"/>
            <transition performative="agree" from="B" to="i" target="4"/>
        </state>
        <state id="3" final="yes"/>
        <state id="4" final="yes">
            <transition performative="inform.*" from="B" to="i" target="4"/>
            <transition performative="failure" from="B" to="i" target="3"/>
            <subprotocol name=".*" from="B" proxied_to="i"/>
        </state></scxml>"#,
    ),
    (
        "three",
        r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2">
            <transition performative="propagate" from="b" to="c" target="3"/>
            <transition performative="agree" from="b" to="a" target="2"/>
        </state>
        <state id="3">
            <transition performative="inform" from="c" to="a|b" target="4"/>
            <transition performative="refuse" from=".*" to="a" target="2"/>
        </state>
        <state id="4" final="yes"><transition performative=".*" from="c" to=".*" target="4"/></state>
        </scxml>"#,
    ),
    (
        "timed",
        r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol" f:scope="participant" f:cancel="anyone">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2">
            <transition performative="agree" from="b" to="a" target="3" f:optional="yes"/>
            <transition f:after="4s" target="5"/>
        </state>
        <state id="3">
            <transition performative="propose" from="b" to="a" target="4" f:optional="yes"/>
            <transition performative="refuse" from="b" to="a" target="5"/>
        </state>
        <state id="4"><transition performative="inform" from="b" to="a" target="2"/>
            <transition performative="confirm" from="a" to="b" target="5"/></state>
        <state id="5" final="yes"/></scxml>"#,
    ),
    (
        "guarded",
        r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol" f:scope="participant">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2">
            <transition performative="agree" from="b" to="a" target="3" f:at-most="2"/>
            <transition performative="refuse" from="b" to="a" target="5"/>
        </state>
        <state id="3"><transition performative="confirm" from="a" to="b" target="4" f:when="all"/></state>
        <state id="4"><transition performative="inform" from="a" to="b" target="5"/></state>
        <state id="5" final="yes"/></scxml>"#,
    ),
];

fn library() -> Library {
    let mut library = Library::empty();
    // The answers of dlm_discover have any receivers, and no role but that of the initiator. The reference has
    // no such protocol.
    let standard = Library::standard();
    for machine in standard.iter().filter(|it| it.name() != "dlm_discover") {
        library.add(machine.clone()).unwrap();
    }
    for (name, text) in OWN {
        library.add(Machine::read(name, text).unwrap()).unwrap();
    }
    library
}

struct Walk<'l> {
    rng: Rng,
    library: &'l Library,
    reference: Reference<'l>,
    now: u64,
    texts: u64,
}

impl Walk<'_> {
    fn pick<T: Clone>(&mut self, from: &[T]) -> T {
        from[self.rng.usize(..from.len())].clone()
    }

    fn words(&mut self, id: String) -> Words {
        let act = self.pick(&ACTS);
        let from = self.pick(&AGENTS[..5]);
        let count = self.pick(&[1, 1, 1, 2, 3]);
        let to = (0..count).map(|_| self.pick(&AGENTS)).collect();
        let machines: Vec<&Machine> = self.library.iter().collect();
        let protocol = Some(self.pick(&machines).name().to_owned());
        let mut words = Words {
            act,
            from,
            to,
            protocol,
            id,
            reply_with: None,
            in_reply_to: None,
            reply_to: Vec::new(),
            undelivered_to: None,
            reply_by: None,
        };
        if self.rng.u8(..) < 230 {
            self.make_fitting(&mut words);
        }
        let text = |rng: &mut Rng, texts: u64| format!("t{}", rng.u64(0..=texts % 5));
        if self.rng.bool() {
            self.texts += 1;
            words.reply_with = Some(text(&mut self.rng, self.texts));
        }
        if self.rng.u8(..) < 60 {
            words.in_reply_to = Some(text(&mut self.rng, self.texts));
        }
        if self.rng.u8(..) < 40 {
            words.reply_to = vec![self.pick(&AGENTS[..5])];
        }
        // Often the report of a service.
        if words.act == "failure" && (words.from == "host-mts" || self.rng.u8(..) < 10) {
            words.undelivered_to = self.rng.bool().then(|| self.pick(&AGENTS));
        }
        if self.rng.u8(..) < 60 {
            words.reply_by = Some(self.now + self.rng.u64(1..8_000));
        }
        words
    }

    /// Mostly messages that a state allows. Otherwise conversations would not proceed.
    fn make_fitting(&mut self, words: &mut Words) {
        let Some((machine, initiators, talks)) = self.reference.states(&words.id) else {
            let machines: Vec<&Machine> = self.library.iter().collect();
            let machine = self.pick(&machines);
            words.protocol = Some(machine.name().to_owned());
            let mut first = options(machine, machine.initial().id());
            // Sometimes an answer in a conversation of other agents.
            if self.rng.u8(..) < 25 {
                first = machine
                    .states()
                    .iter()
                    .flat_map(State::transitions)
                    .collect();
                words.to = vec!["ann"];
            }
            let first = self.pick(&first);
            words.act = self.act(first.performative());
            return;
        };
        // The initiator, or another agent that receives replies.
        let initiator = match self.rng.bool() {
            true => initiators[0],
            false => self.pick(&initiators),
        };
        if self.rng.u8(..) < 40
            && machine
                .states()
                .iter()
                .any(|state| !state.subprotocols().is_empty())
        {
            // A message of an embedded protocol, from any agent.
            let inner = self.pick(&["fipa-request", "fipa-query", "fipa-contract-net", "plain"]);
            words.protocol = Some(inner.to_owned());
            let inner = self.library.find(inner).unwrap();
            let state = self.rng.usize(..inner.states().len());
            let choices = options(inner, inner.states()[state].id());
            if !choices.is_empty() {
                let choice = self.pick(&choices);
                words.act = self.act(choice.performative());
                words.to.truncate(1);
            }
            if let Some((peer, _)) = talks.first()
                && !peer.is_empty()
                && self.rng.bool()
            {
                words.from = peer;
            }
            return;
        }
        words.protocol = Some(machine.name().to_owned());
        if talks.is_empty() || self.rng.u8(..) < 20 {
            words.from = initiator;
            return;
        }
        let (peer, state) = self.pick(&talks);
        let peer = if peer.is_empty() {
            self.pick(&AGENTS[..5])
        } else {
            peer
        };
        let own = machine.states().iter().any(|own| own.id() == state);
        let common = [
            ("cancel", true),
            ("inform", false),
            ("failure", false),
            ("not-understood", false),
        ];
        let choices = if own {
            options(machine, &state)
        } else {
            Vec::new()
        };
        let from_initiator = if choices.is_empty() || self.rng.u8(..) < 25 {
            let (act, initiator) = self.pick(&common);
            words.act = act;
            initiator ^ (self.rng.u8(..) < 60)
        } else {
            let choice = self.pick(&choices);
            words.act = self.act(choice.performative());
            choice.from() == machine.initiator()
        };
        let outside = self.rng.u8(..) < 10;
        (words.from, words.to) = match (from_initiator, outside) {
            (_, true) => ("host-mts", vec![initiator]),
            (true, _) => (initiator, vec![peer]),
            (false, _) => (peer, vec![initiator]),
        };
        if from_initiator && self.rng.u8(..) < 60 {
            words.to.extend(
                talks
                    .iter()
                    .map(|(peer, _)| *peer)
                    .filter(|peer| !peer.is_empty()),
            );
        }
    }

    fn act(&mut self, pattern: &str) -> &'static str {
        let all = ACTS.iter().copied();
        let fitting: Vec<&str> = all.filter(|name| matches(pattern, name)).collect();
        self.pick(&fitting)
    }
}

fn header(words: &Words) -> Header<'_> {
    let mut header = Header::new(words.act.parse().unwrap())
        .sender(words.from)
        .receivers(words.to.iter().copied())
        .reply_to(words.reply_to.iter().copied())
        .conversation_id(words.id.as_str());
    if let Some(protocol) = &words.protocol {
        header = header.protocol(protocol.as_str());
    }
    if let Some(text) = &words.reply_with {
        header = header.reply_with(text.as_str());
    }
    if let Some(text) = &words.in_reply_to {
        header = header.in_reply_to(text.as_str());
    }
    if let Some(agent) = words.undelivered_to {
        header = header.undelivered_to(agent);
    }
    if let Some(due) = words.reply_by {
        header = header.reply_by(Time::from_system_time(at(due)).unwrap());
    }
    header
}

fn at(ms: u64) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_millis(ms)
}

/// Runs a walk. Returns the numbers of accepted messages, violations and unchecked messages.
fn walk(seed: u64, steps: u64) -> [u64; 3] {
    let library = library();
    let shared = Arc::new(library.clone());
    let mut rng = Rng::with_seed(seed);
    let agent = rng.bool().then_some("ann");
    let mut monitor = match agent {
        Some(name) => Monitor::agent(shared, name),
        None => Monitor::observer(shared),
    };
    // Other tests cover the removal of conversations.
    let mut limits = MonitorLimits::default();
    limits.ended = Duration::from_secs(1 << 40);
    limits.idle = limits.ended;
    limits.conversations = usize::try_from(steps).unwrap() + 1;
    monitor = monitor.with_limits(limits);
    let mut walk = Walk {
        rng,
        library: &library,
        reference: Reference::new(&library, agent),
        now: 1_700_000_000_000,
        texts: 0,
    };
    let mut counts = [0; 3];
    let mut ids: Vec<u64> = (0..8).collect();
    let mut log: Vec<String> = Vec::new();
    for step in 0..steps {
        // Conversations are replaced by new ones and get no further messages.
        if walk.rng.u8(..) < 12 {
            let place = walk.rng.usize(..ids.len());
            walk.reference.forget(&format!("c{}", ids[place]));
            ids[place] = 8 + step;
        }
        walk.now += walk.rng.u64(0..1_500);
        let id = format!("c{}", walk.pick(&ids));
        let words = walk.words(id);
        let expected = walk.reference.check(&words, walk.now);
        let header = header(&words);
        let verdict = monitor.check(&header, at(walk.now));
        let actual = match &verdict {
            Verdict::Accepted(right) => {
                counts[0] += 1;
                let flags = [right.opened, right.ended, right.complete, right.late];
                ReferenceVerdict::Accepted(right.state.to_owned(), flags)
            }
            Verdict::Violation(violation) => {
                counts[1] += 1;
                ReferenceVerdict::Violation(violation.kind.as_str())
            }
            _ => {
                counts[2] += 1;
                ReferenceVerdict::Unchecked
            }
        };
        log.push(format!("{words:?} -> {actual:?}"));
        if actual != expected {
            let own: Vec<&String> = log
                .iter()
                .filter(|line| line.contains(&format!("id: {:?}", words.id)))
                .collect();
            panic!(
                "seed {seed}, step {step}: {actual:?}, the reference expects {expected:?}\n{:#?}\n{verdict:?}",
                &own[own.len().saturating_sub(12)..]
            );
        }
        if log.len() > 4_000 {
            log.drain(..2_000);
        }
        if step % 1_000 == 0 && walk.rng.bool() {
            monitor.handle_timeout(at(walk.now));
        }
    }
    counts
}

#[test]
fn the_monitor_and_the_reference_agree() {
    let number = |name: &str| {
        std::env::var(name)
            .ok()
            .map(|text| text.parse::<u64>().unwrap())
    };
    let steps = number("FIPA_WALK_STEPS").unwrap_or(2_000);
    let seeds = number("FIPA_WALK_SEEDS").unwrap_or(50);
    let seeds = match number("FIPA_WALK_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..seeds,
    };
    let mut all = [0; 3];
    for seed in seeds {
        for (sum, count) in all.iter_mut().zip(walk(seed, steps)) {
            *sum += count;
        }
    }
    let [right, wrong, nothing] = all;
    println!("{right} accepted, {wrong} violations, {nothing} unchecked");
    assert!(
        right > steps / 4 && wrong > steps / 4,
        "a walk that sees both"
    );
}
