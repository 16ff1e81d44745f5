//! The protocols of locks in the library of `fipa-monitor`: all that the cores and `distributed_locking` send
//! fits them, and wrong messages do not.

use std::sync::{Arc, LazyLock};
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_locking::{Algorithm, LockMessage, LockPeer, Millis, codec};
use fipa_monitor::{Header, History, Library, Monitor, MonitorPolicy, Verdict};

const RECORDED: &str = include_str!("../vectors/distributed_locking.txt");

static LIBRARY: LazyLock<Arc<Library>> = LazyLock::new(|| Arc::new(Library::standard()));

/// The monitor of one registration, as an agent has it that enforces protocols.
pub(crate) struct Checked {
    monitor: Monitor,
    kind: Algorithm,
}

impl Checked {
    pub(crate) fn new(kind: Algorithm, me: &LockPeer) -> Self {
        let monitor = Monitor::agent(Arc::clone(&LIBRARY), me.name());
        // An earlier registration of the name may have begun conversations.
        let history = match me.registration() {
            1 => History::Complete,
            _ => History::Unknown,
        };
        let monitor = monitor
            .with_policy(MonitorPolicy::strict())
            .with_history(history);
        Self { monitor, kind }
    }

    /// Checks a message that this agent sends or receives.
    pub(crate) fn check(
        &mut self,
        now: Millis,
        from: &LockPeer,
        to: &LockPeer,
        message: &LockMessage,
    ) {
        let id = |peer: &LockPeer| AgentId::new(peer.name()).unwrap();
        let written = codec::encode(message, self.kind, &id(from), &id(to)).unwrap();
        let now = SystemTime::UNIX_EPOCH + Duration::from_millis(now);
        let verdict = self.monitor.check(&Header::from(&written), now);
        let violation = verdict.violation();
        assert!(
            violation.is_none(),
            "{now:?} {from:?} to {to:?}: {}",
            violation.unwrap()
        );
    }
}

fn id(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

/// Reads a line of the recording. None for a heading.
fn recorded(line: &str) -> Option<Message> {
    let (agents, rest) = line.trim_start().split_once(",  ")?;
    let (sender, receivers) = agents.split_once(" -> ")?;
    let (performative, rest) = rest.split_once(" protocol=")?;
    let (protocol, rest) = rest.split_once(" conv=")?;
    let (conversation, rest) = rest.split_once(" lang=")?;
    let (language, content) = rest.split_once(" content='")?;
    let mut message = Message::builder(performative.parse::<Performative>().ok()?)
        .sender(id(sender))
        .protocol(protocol)
        .conversation_id(conversation)
        .content(content.strip_suffix('\'')?.replace("\\n", "\n"));
    for receiver in receivers.split(',') {
        message = message.receiver(id(receiver));
    }
    if !language.is_empty() {
        message = message.language(language);
    }
    message.build().ok()
}

fn judged(monitor: &mut Monitor, message: &Message) -> Option<String> {
    let verdict = monitor.check(&Header::from(message), SystemTime::UNIX_EPOCH);
    match &verdict {
        Verdict::Accepted(_) => None,
        other => Some(format!("{other:?}")),
    }
}

/// An observer, and each agent by itself, accept the recorded messages. They are read and written again.
#[test]
fn the_recorded_messages_of_the_cpp_library_fit() {
    let library = Arc::clone(&LIBRARY);
    let new = || {
        let names = ["agent1", "agent2", "agent3"];
        let agents = names.map(|name| (name, Monitor::agent(Arc::clone(&library), name)));
        (Monitor::observer(Arc::clone(&library)), agents)
    };
    let (mut observer, mut agents) = new();
    let mut kind = Algorithm::default();
    let mut messages = 0;
    for line in RECORDED.lines() {
        if let Some(name) = line.strip_prefix("== ") {
            kind = *Algorithm::ALL
                .iter()
                .find(|kind| kind.protocol() == name)
                .unwrap();
            (observer, agents) = new();
        }
        let Some(message) = recorded(line) else {
            assert!(!line.contains("->"), "{line}");
            continue;
        };
        messages += 1;
        assert_eq!(judged(&mut observer, &message), None, "{line}");
        for (name, monitor) in &mut agents {
            let takes_part = message.sender().unwrap().name() == *name
                || message
                    .receivers()
                    .iter()
                    .any(|receiver| receiver.name() == *name);
            if takes_part {
                assert_eq!(judged(monitor, &message), None, "{name}: {line}");
            }
        }
        let read = codec::decode(&message, kind).unwrap_or_else(|error| panic!("{line}: {error}"));
        let (sender, receiver) = (message.sender().unwrap(), &message.receivers()[0]);
        let written = codec::encode(&read, kind, sender, receiver).unwrap();
        assert_eq!(written.content(), message.content(), "{line}");
        assert_eq!(written.language(), message.language(), "{line}");
        assert_eq!(written.performative(), message.performative(), "{line}");
    }
    assert!(messages > 70, "{messages}");
}

/// Plays messages such as `request ann>ben` in one conversation. Those after `!` are violations.
fn play(protocol: &str, words: &[&str]) {
    let library = Arc::clone(&LIBRARY);
    let observer = Monitor::observer(Arc::clone(&library));
    let agents = ["ann", "ben"].map(|name| {
        let monitor = Monitor::agent(Arc::clone(&library), name);
        monitor.with_policy(MonitorPolicy::strict())
    });
    for (index, mut monitor) in [observer].into_iter().chain(agents).enumerate() {
        for word in words {
            let legal = word.strip_prefix('!').unwrap_or(word);
            let (act, agents) = legal.split_once(' ').unwrap();
            let (from, to) = agents.split_once('>').unwrap();
            if index > 0 && ![from, to].contains(&["ann", "ben"][index - 1]) {
                continue;
            }
            let header = Header::new(act.parse().unwrap())
                .sender(from)
                .receivers([to]);
            let header = header.protocol(protocol).conversation_id("ann_1");
            let verdict = monitor.check(&header, SystemTime::UNIX_EPOCH);
            let is_wrong = verdict.violation().is_some();
            assert_eq!(
                is_wrong,
                legal != *word,
                "{protocol}, {index}: {word}: {verdict:?}"
            );
        }
    }
}

#[test]
fn wrong_messages_of_locks_are_violations() {
    for basic in ["ricart_agrawala", "suzuki_kasami"] {
        play(basic, &["request ann>ben", "!request ann>ben"]);
    }
    for protocol in ["ricart_agrawala", "ricart_agrawala_extended"] {
        // The participant answers before it is asked, and the initiator enters before the owner has agreed.
        play(
            protocol,
            &[
                "!agree ben>ann",
                "request ann>ben",
                "!confirm ann>ben",
                "!inform ben>ann",
            ],
        );
        // There is one owner.
        play(
            protocol,
            &[
                "request ann>ben",
                "request ann>cid",
                "agree ben>ann",
                "agree cid>ann",
                "confirm ann>ben",
                "inform ben>ann",
                "confirm ann>ben",
                "inform ben>ann",
                "disconfirm ann>ben",
                "!confirm ann>ben",
                "!request ann>ben",
            ],
        );
        play(protocol, &["request ann>ben", "!propagate ben>ann"]);
    }
    // A member agrees to a request once, and not while the initiator has entered.
    play(
        "ricart_agrawala",
        &[
            "request ann>ben",
            "agree ben>ann",
            "!agree ben>ann",
            "confirm ann>ben",
            "!agree ben>ann",
        ],
    );
    // There is one token.
    play(
        "suzuki_kasami",
        &[
            "request ann>ben",
            "request ann>cid",
            "propagate ben>ann",
            "!propagate ben>ann",
        ],
    );
    // A token that was never received cannot be returned.
    play(
        "suzuki_kasami_extended",
        &[
            "request ann>ben",
            "propagate ben>ann",
            "confirm ann>ben",
            "inform ben>ann",
            "propagate ann>ben",
            "!confirm ann>ben",
            "!request ann>ben",
        ],
    );
    // The token came for an earlier request.
    play(
        "suzuki_kasami_extended",
        &["request ann>ben", "propagate ann>ben", "!confirm ann>ben"],
    );
    for act in ["!propagate ben>ann", "!propagate ann>ben"] {
        play("suzuki_kasami_extended", &[act]);
    }
    play(
        "dlm_probe",
        &[
            "!confirm ben>ann",
            "request ann>ben",
            "confirm ben>ann",
            "!confirm ben>ann",
        ],
    );
}

/// The rules across participants: one of them gets the report, and one passes the token.
#[test]
fn a_second_owner_and_a_second_token_are_violations() {
    let library = Arc::clone(&LIBRARY);
    for (protocol, words) in [
        (
            "ricart_agrawala_extended",
            [
                "agree ben>ann",
                "agree cid>ann",
                "confirm ann>ben",
                "confirm ann>cid",
            ],
        ),
        (
            "suzuki_kasami",
            [
                "confirm ann>dan",
                "disconfirm ann>dan",
                "propagate ben>ann",
                "propagate cid>ann",
            ],
        ),
    ] {
        for mut monitor in [
            Monitor::observer(Arc::clone(&library)),
            Monitor::agent(Arc::clone(&library), "ann"),
        ] {
            let requests = ["request ann>ben", "request ann>cid"];
            let last = words.len() + 1;
            for (index, word) in requests.iter().chain(&words).enumerate() {
                let (act, agents) = word.split_once(' ').unwrap();
                let (from, to) = agents.split_once('>').unwrap();
                let header = Header::new(act.parse().unwrap())
                    .sender(from)
                    .receivers([to]);
                let header = header.protocol(protocol).conversation_id("ann_1");
                let verdict = monitor.check(&header, SystemTime::UNIX_EPOCH);
                assert_eq!(verdict.is_accepted(), index != last, "{word}: {verdict:?}");
            }
        }
    }
}
