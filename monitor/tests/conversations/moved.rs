//! Conversations of an agent that moves: the next monitor of the agent continues them.

use fastrand::Rng;
use fipa_monitor::SnapshotError;

use super::*;

fn moved(stage: &Stage, agent: &str) -> Stage {
    moved_with(library(), stage, agent)
}

fn moved_with(library: Arc<Library>, stage: &Stage, agent: &str) -> Stage {
    let mut monitor = Monitor::agent(library, agent);
    let taken = stage.monitor.snapshot(stage.now);
    let restored = monitor.restore(&taken, stage.now).unwrap();
    assert_eq!(restored, stage.monitor.len());
    assert_eq!(monitor.bytes(), stage.monitor.bytes());
    Stage {
        monitor,
        now: stage.now,
    }
}

/// A participant and an initiator in conversations of each kind of state.
fn filled() -> Stage {
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    stage.right(request("request ann>ben").reply_with("q"));
    stage.right(request("agree ben>ann").in_reply_to("q").reply_with("a"));
    let call = |words| say(words).conversation_id("calls");
    stage.right(call("cfp ben>ann,cid").reply_with("call"));
    stage.right(call("propose ann>ben").in_reply_to("call"));
    let pattern = |words| say(words).conversation_id("pattern");
    stage.right(pattern("cfp ben>arm_.*"));
    stage.right(pattern("propose arm_1>ben"));
    let news = |words| say_in("fipa-subscribe", words).conversation_id("news");
    stage.right(news("subscribe ben>ann").reply_with("s"));
    stage.right(news("agree ann>ben"));
    stage.right(news("cancel ben>ann").reply_with("x"));
    let query = |words| say_in("fipa-query", words).conversation_id("query");
    stage.right(query("query-if cid>ben").reply_to(["dan"]));
    let broken = |words| request(words).conversation_id("broken");
    stage.right(broken("request cid>ben"));
    stage.right(broken("not-understood ben>cid"));
    stage
}

#[test]
fn the_next_monitor_has_the_same_states() {
    let mut stage = moved(&filled(), "ben");
    // The fingerprints are the same.
    let answer = || request("inform ben>ann");
    assert_eq!(
        stage.wrong(answer().in_reply_to("other")).kind,
        Kind::WrongReply
    );
    assert_eq!(
        stage.wrong(request("agree ben>ann").reply_with("a")).kind,
        Kind::Repeated
    );
    assert_eq!(
        stage.wrong(request("refuse ben>ann")).kind,
        Kind::Unexpected
    );
    assert_eq!(stage.right(answer().in_reply_to("q")), "done");
    let call = |words| say(words).conversation_id("calls");
    assert_eq!(stage.wrong(call("propose dan>ben")).kind, Kind::Stranger);
    stage.right(call("accept-proposal ben>ann"));
    assert_eq!(
        stage.wrong(call("accept-proposal ben>cid")).kind,
        Kind::OutOfOrder
    );
    let pattern = |words| say(words).conversation_id("pattern");
    stage.right(pattern("propose arm_2>ben"));
    stage.right(pattern("accept-proposal ben>arm_1"));
    let news = |words| say_in("fipa-subscribe", words).conversation_id("news");
    assert_eq!(
        stage.right(news("inform ann>ben").in_reply_to("s")),
        "cancelling"
    );
    assert_eq!(
        stage.right(news("inform ann>ben").in_reply_to("x")),
        "cancelled"
    );
    let query = |words| say_in("fipa-query", words).conversation_id("query");
    stage.right(query("inform ben>dan"));
    let broken = |words| request(words).conversation_id("broken");
    assert_eq!(stage.wrong(broken("agree ben>cid")).kind, Kind::Ended);
    // Nothing crosses a cancel that has its answer.
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    stage.right(news("subscribe ben>ann"));
    stage.right(news("cancel ben>ann").reply_with("x"));
    stage.right(news("inform ann>ben").in_reply_to("x"));
    let mut stage = moved(&stage, "ben");
    assert_eq!(stage.wrong(news("inform ann>ben")).kind, Kind::Ended);
}

#[test]
fn the_side_that_spoke_last_and_the_side_that_canceled_move_along() {
    // Messages of the other side may cross a not-understood.
    let mut ann = Stage::new(Monitor::agent(library(), "ann"));
    ann.right(request("request ann>ben"));
    ann.right(request("agree ben>ann"));
    ann.right(request("not-understood ann>ben"));
    let mut ann = moved(&ann, "ann");
    assert_eq!(ann.right(request("inform ben>ann")), "not-understood");
    let mut ben = Stage::new(Monitor::agent(library(), "ben"));
    ben.right(request("request ann>ben"));
    ben.right(request("not-understood ben>ann"));
    let mut ben = moved(&ben, "ben");
    assert_eq!(ben.right(request("cancel ann>ben")), "not-understood");
    // Messages of the other side may cross a cancel.
    let text = r#"<scxml initial="1" xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="participant"
        fipa:cancel="anyone">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="a" to="b" target="2"/>
            <transition performative="inform" from="b" to="a" target="2"/></state></scxml>"#;
    let own = |words| say_in("own", words);
    for (cancel, inform) in [
        ("cancel ben>ann", "inform ann>ben"),
        ("cancel ann>ben", "inform ben>ann"),
    ] {
        let canceling = &cancel[7..10];
        let library = library_with("own", text);
        let monitor = Monitor::agent(Arc::clone(&library), canceling);
        let mut stage = Stage::new(monitor);
        stage.right(own("request ann>ben").reply_with("q"));
        stage.right(own(cancel).reply_with("x"));
        // Either inform may be the answer to the cancel.
        assert_eq!(stage.right(own(inform)), "cancelled");
        let mut stage = moved_with(library, &stage, canceling);
        assert_eq!(stage.right(own(inform)), "cancelled", "{canceling}");
    }
}

#[test]
fn embedded_conversations_move_along() {
    let broker = |words| say_in("fipa-brokering", words);
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    stage.right(broker("proxy ann>ben"));
    stage.right(broker("agree ben>ann"));
    stage.right(request("request ben>cid"));
    stage.right(say_in("fipa-query", "query-if ben>dan"));
    assert_eq!(stage.monitor.len(), 3);
    let mut stage = moved(&stage, "ben");
    assert_eq!(stage.wrong(request("agree dan>ben")).kind, Kind::Stranger);
    stage.right(say_in("fipa-query", "inform dan>ben"));
    stage.right(request("agree cid>ben"));
    stage.right(broker("inform ben>ann"));
}

#[test]
fn deadlines_move_along() {
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    let due = Time::from_system_time(stage.now + Duration::from_secs(10)).unwrap();
    stage.right(say("cfp ben>ann").reply_by(due));
    stage.pass(4);
    let mut stage = moved(&stage, "ben");
    assert_eq!(stage.pass(5), []);
    assert!(matches!(&stage.pass(2)[..], [Event::Overdue { .. }]));
}

#[test]
fn uncertain_conversations_are_left_out() {
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    stage.right(request("request ben>ann"));
    let now = stage.now;
    stage
        .monitor
        .undelivered(&request("request ben>ann"), "ann", now);
    stage.right(say("cfp ben>ann").reply_to(["dan"]).conversation_id("d"));
    stage.right(request("request ben>ann").conversation_id("e"));
    let mut next = Monitor::agent(library(), "ben").with_history(History::Unknown);
    assert_eq!(next.restore(&stage.monitor.snapshot(now), now), Ok(1));
    let mut next = Stage { monitor: next, now };
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    assert_ne!(
        next.check(&request("inform ann>ben").conversation_id("d")),
        unknown
    );
    assert_eq!(next.check(&request("cancel ben>ann")), unknown);
    next.right(request("agree ann>ben").conversation_id("e"));
    // So are conversations with a message that a service reported, those of protocols with several roles, and
    // those whose first message may have been a later one.
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="b" to="c" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#;
    let with_own = library_with("own", text);
    let mut stage = Stage::new(Monitor::agent(Arc::clone(&with_own), "ben"));
    stage.right(request("request ben>ann"));
    stage.right(request("failure mts>ben").undelivered_to("ann"));
    stage.right(say_in("own", "request ann>ben").conversation_id("own"));
    stage.monitor.set_history(History::Unknown);
    let iterated = say_in("fipa-iterated-contract-net", "cfp ben>ann");
    stage.right(iterated.conversation_id("calls"));
    // This message can only be the first one.
    stage.right(request("request ben>ann").conversation_id("e"));
    assert_eq!(stage.monitor.len(), 4);
    let mut next = Monitor::agent(with_own, "ben").with_history(History::Unknown);
    assert_eq!(next.restore(&stage.monitor.snapshot(now), now), Ok(1));
    let mut next = Stage { monitor: next, now };
    next.right(request("agree ann>ben").conversation_id("e"));
    // An observer belongs to no agent.
    let empty = Stage::observer().monitor.snapshot(now);
    let mut ben = Monitor::agent(library(), "ben");
    assert!(matches!(
        ben.restore(&empty, now),
        Err(SnapshotError::OtherAgent { .. })
    ));
}

#[test]
fn the_limits_of_the_next_monitor_hold() {
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    for number in 0..100 {
        stage.right(request("request ann>ben").conversation_id(number.to_string()));
        stage.pass(2);
    }
    let taken = stage.monitor.snapshot(stage.now);
    let mut limits = MonitorLimits::default();
    limits.conversations = 10;
    let mut next = Monitor::agent(library(), "ben").with_limits(limits);
    assert_eq!(
        next.restore(&taken, stage.now),
        Ok(8),
        "the share of a peer"
    );
    let mut next = Stage {
        monitor: next,
        now: stage.now,
    };
    // The latest are kept, and the others are unknown.
    next.right(request("agree ben>ann").conversation_id("99"));
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    assert_eq!(
        next.check(&request("agree ben>ann").conversation_id("3")),
        unknown
    );
    limits.bytes = taken.len() - 1;
    let mut next = Monitor::agent(library(), "ben").with_limits(limits);
    let refused = next.restore(&taken, stage.now);
    assert!(
        matches!(refused, Err(SnapshotError::TooLarge(_))),
        "{refused:?}"
    );
    // A snapshot has at most as many bytes as the conversations may have.
    limits.conversations = 100_000;
    limits.bytes = 4_000;
    let mut small = Stage::new(Monitor::agent(library(), "ben").with_limits(limits));
    for number in 0..100 {
        small.check(&request("request ben>ann").conversation_id(number.to_string()));
    }
    assert!(small.monitor.snapshot(small.now).len() <= 4_000);
}

#[test]
fn other_bytes_are_refused_without_effect() {
    let stage = filled();
    let taken = stage.monitor.snapshot(stage.now);
    let fresh = || Monitor::agent(library_once(), "ben");
    let refused = |bytes: &[u8]| {
        let mut monitor = fresh();
        let refused = monitor.restore(bytes, stage.now).unwrap_err();
        assert!(monitor.is_empty() && monitor.bytes() == 0);
        refused
    };
    for end in 0..taken.len() {
        refused(&taken[..end]);
    }
    assert_eq!(
        refused(b"{\"conversations\":[]}"),
        SnapshotError::NotASnapshot
    );
    let mut longer = taken.clone();
    longer.push(0);
    assert!(matches!(refused(&longer), SnapshotError::Malformed(_)));
    let mut newer = taken.clone();
    newer[8] = 2;
    assert_eq!(refused(&newer), SnapshotError::Version(2));
    let mut ann = Monitor::agent(library(), "ann");
    let other = ann.restore(&taken, stage.now);
    assert!(
        matches!(other, Err(SnapshotError::OtherAgent { .. })),
        "{other:?}"
    );
    let mut twice = fresh();
    twice.restore(&taken, stage.now).unwrap();
    assert_eq!(twice.restore(&taken, stage.now), Err(SnapshotError::InUse));
    // Names of the same length.
    let replaced = |from: &str, to: &str| {
        let mut bytes = taken.clone();
        let mut found = 0;
        for at in 0..bytes.len() - from.len() {
            // After the name of the agent itself.
            if at > 20 && &bytes[at..at + from.len()] == from.as_bytes() {
                bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
                found += 1;
            }
        }
        assert!(found > 0, "{from}");
        refused(&bytes)
    };
    assert_eq!(
        replaced("agreed", "AGREED"),
        SnapshotError::Malformed("an unknown state")
    );
    assert_eq!(
        replaced("ben", "eve"),
        SnapshotError::Malformed("a conversation without the agent")
    );
    assert_eq!(
        replaced("cid", "ann"),
        SnapshotError::Malformed("participants that do not fit the protocol")
    );
}

/// Changed snapshots are refused without effect, or restored within the limits. Then no message and no
/// timeout makes the monitor fail.
#[test]
fn changed_bytes_do_no_harm() {
    let stage = filled();
    let taken = stage.monitor.snapshot(stage.now);
    let mut rng = Rng::with_seed(7);
    let (mut refused, mut restored) = (0, 0);
    for _ in 0..5_000 {
        let mut bytes = taken.clone();
        for _ in 0..rng.usize(1..4) {
            let at = rng.usize(..bytes.len());
            match rng.u8(..8) {
                0 => drop(bytes.remove(at)),
                1 => bytes.insert(at, rng.u8(..)),
                2 => bytes[at] = u8::MAX,
                3 => bytes[at] = bytes[at].wrapping_add(1),
                _ => bytes[at] ^= 1 << rng.u8(..8),
            }
        }
        let mut monitor = Monitor::agent(library_once(), "ben");
        if monitor.restore(&bytes, stage.now).is_err() {
            assert!(monitor.is_empty() && monitor.bytes() == 0);
            refused += 1;
            continue;
        }
        restored += 1;
        for (words, id) in [
            ("agree ben>ann", "c"),
            ("inform ann>ben", "news"),
            ("propose cid>ben", "calls"),
            ("cancel ben>ann", "calls"),
            ("failure ann>ben", "pattern"),
            ("not-understood cid>ben", "query"),
            ("inform cid>ben", "broken"),
        ] {
            let (act, _) = words.split_once(' ').unwrap();
            let (from, to) = words[act.len() + 1..].split_once('>').unwrap();
            let header = Header::new(act.parse().unwrap()).sender(from);
            let header = header.receivers([to]).conversation_id(id);
            monitor.check(&header.in_reply_to("q").reply_with("r"), stage.now);
            let _ = monitor.snapshot(stage.now);
        }
        monitor.handle_timeout(stage.now + Duration::from_secs(1_000_000));
        assert!(monitor.is_empty() && monitor.bytes() == 0);
    }
    assert!(refused > 500 && restored > 100, "{refused} {restored}");
}

#[test]
fn a_snapshot_has_at_most_the_bytes_of_the_limit() {
    // The names of its states make a snapshot larger than the conversations are.
    let text = format!(
        r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="{0}"/></state>
        <state id="{0}"><transition performative="agree" from="b" to="a" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#,
        "x".repeat(250)
    );
    let library = library_with("own", &text);
    let own = |number: u8| say_in("own", "request ben>ann").conversation_id(format!("{number:02}"));
    let taken = |bytes| {
        let mut limits = MonitorLimits::default();
        limits.bytes = bytes;
        let monitor = Monitor::agent(Arc::clone(&library), "ben").with_limits(limits);
        let mut stage = Stage::new(monitor);
        for number in 0..20 {
            stage.right(own(number));
        }
        assert_eq!(stage.monitor.len(), 20);
        stage.monitor.snapshot(stage.now)
    };
    let whole = taken(1 << 20);
    assert_eq!(taken(whole.len()).len(), whole.len());
    let less = taken(whole.len() - 1);
    let mut stage = Stage::new(Monitor::agent(Arc::clone(&library), "ben"));
    assert_eq!(stage.monitor.restore(&less, stage.now), Ok(19));
    // The latest are kept.
    let answer =
        |number: u8| say_in("own", "agree ann>ben").conversation_id(format!("{number:02}"));
    for number in 1..20 {
        assert_eq!(stage.right(answer(number)), "3");
    }
    assert!(!stage.check(&answer(0)).is_accepted());
}

/// A conversation of a snapshot, as another program may write it.
struct Written {
    protocol: &'static str,
    id: String,
    initiator: String,
    /// Names of participants, each in this state.
    parties: Vec<String>,
    state: &'static str,
    flags: u8,
    unnamed: u8,
    bound: Vec<(u8, String)>,
    reply_to: Vec<String>,
    delegates: Vec<(u32, String)>,
}

fn names(count: usize) -> Vec<String> {
    (0..count).map(|number| format!("{number}")).collect()
}

fn with_ben(count: usize) -> Vec<String> {
    [names(count), vec!["ben".to_owned()]].concat()
}

/// These agents, each with an index.
fn indexed<N: Copy>(index: N, count: usize) -> Vec<(N, String)> {
    let names = names(count).into_iter();
    names.map(|name| (index, name)).collect()
}

impl Written {
    /// A conversation in which ann has asked ben, with a state for each participant.
    fn per_participant() -> Self {
        Self {
            protocol: "fipa-request",
            id: "c".to_owned(),
            initiator: "ann".to_owned(),
            parties: vec!["ben".to_owned()],
            state: "requested",
            flags: 1,
            unnamed: 0,
            bound: Vec::new(),
            reply_to: Vec::new(),
            delegates: Vec::new(),
        }
    }

    /// The same with one state.
    fn per_conversation() -> Self {
        Self {
            protocol: "own",
            parties: vec![String::new()],
            state: "2",
            bound: vec![(0, "ann".to_owned()), (1, "ben".to_owned())],
            ..Self::per_participant()
        }
    }

    /// Appends the conversation to the snapshot of a monitor without one.
    fn after(&self, empty: &[u8]) -> Vec<u8> {
        fn count(out: &mut Vec<u8>, count: usize) {
            out.extend(u32::try_from(count).unwrap().to_le_bytes());
        }
        fn text(out: &mut Vec<u8>, text: &str) {
            out.extend(u16::try_from(text.len()).unwrap().to_le_bytes());
            out.extend(text.as_bytes());
        }
        let party = |out: &mut Vec<u8>, name: &str| {
            text(out, name);
            for _ in 0..3 {
                out.push(0);
                text(out, self.state);
            }
            out.extend([self.flags, 19, 0]);
            // The values of `reply-with` of each side, of the cancel, and the deadline: none.
            out.extend([0; 2 * (8 + 2 + 6 * 4) + 8 + 8]);
        };
        let mut out = empty[..empty.len() - 4].to_vec();
        count(&mut out, 1);
        for name in [self.protocol, &self.id, "ann", &self.initiator] {
            text(&mut out, name);
        }
        count(&mut out, self.parties.len());
        for name in &self.parties {
            party(&mut out, name);
        }
        out.push(self.unnamed);
        if self.unnamed == 1 {
            party(&mut out, "");
        }
        count(&mut out, self.bound.len());
        for (role, name) in &self.bound {
            out.push(*role);
            text(&mut out, name);
        }
        count(&mut out, self.reply_to.len());
        for name in &self.reply_to {
            text(&mut out, name);
        }
        count(&mut out, self.delegates.len());
        for (party, name) in &self.delegates {
            count(&mut out, *party as usize);
            text(&mut out, name);
        }
        count(&mut out, 0);
        out
    }
}

#[test]
fn conversations_that_no_monitor_writes_are_refused() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="agree" from="b" to="a" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#;
    let library = library_with("own", text);
    let mut limits = MonitorLimits::default();
    limits.participants = 100;
    let restored = |change: fn(&mut Written), written: fn() -> Written| {
        let mut stage = Stage::new(Monitor::agent(Arc::clone(&library), "ben").with_limits(limits));
        let empty = stage.monitor.snapshot(stage.now);
        let mut written = written();
        change(&mut written);
        let restored = stage.monitor.restore(&written.after(&empty), stage.now);
        if restored.is_ok() {
            let answer = say_in(written.protocol, "agree ben>ann");
            stage.right(answer.conversation_id(written.id.clone()));
        } else {
            assert!(stage.monitor.is_empty() && stage.monitor.bytes() == 0);
        }
        restored
    };
    let malformed = |what| Err(SnapshotError::Malformed(what));
    let too_large = |what| Err(SnapshotError::TooLarge(what));
    let unfit = "participants that do not fit the protocol";
    let per_participant: Vec<(fn(&mut Written), _)> = vec![
        (|_| (), Ok(1)),
        (|it| it.flags = 7, Ok(1)),
        (|it| it.flags = 8, malformed("a flag")),
        (|it| it.id = "x".repeat(4_096), Ok(1)),
        (
            |it| it.id = "x".repeat(4_097),
            too_large("length of a name"),
        ),
        (
            |it| it.initiator.clear(),
            malformed("an agent without name"),
        ),
        (|it| it.state = "lifted", malformed("an unknown state")),
        (|it| it.parties = with_ben(99), Ok(1)),
        (
            |it| it.parties = with_ben(100),
            too_large("number of participants"),
        ),
        (
            |it| it.parties = names(3),
            malformed("a conversation without the agent"),
        ),
        (|it| it.parties.push("ben".to_owned()), malformed(unfit)),
        (|it| it.parties.push(String::new()), malformed(unfit)),
        (|it| it.parties.clear(), malformed(unfit)),
        (|it| it.unnamed = 1, Ok(1)),
        (|it| it.unnamed = 2, malformed("a flag")),
        (|it| it.bound.push((0, "ann".to_owned())), malformed(unfit)),
        (|it| it.reply_to = names(64), Ok(1)),
        (
            |it| it.reply_to = names(65),
            too_large("number of agents in reply-to"),
        ),
        (
            |it| {
                it.reply_to = names(30);
                it.delegates = indexed(0, 34);
            },
            Ok(1),
        ),
        (
            |it| {
                it.reply_to = names(30);
                it.delegates = indexed(0, 35);
            },
            too_large("number of agents in reply-to"),
        ),
        (
            |it| it.delegates.push((1, "dan".to_owned())),
            malformed("an unknown participant"),
        ),
        (
            |it| {
                it.parties = names(1);
                it.delegates.push((0, "ben".to_owned()));
            },
            Ok(1),
        ),
        (
            |it| {
                it.parties = names(1);
                it.delegates.push((0, "dan".to_owned()));
            },
            malformed("a conversation without the agent"),
        ),
    ];
    for (number, (change, expected)) in per_participant.into_iter().enumerate() {
        let found = restored(change, Written::per_participant);
        assert_eq!(found, expected, "{number}");
    }
    let per_conversation: Vec<(fn(&mut Written), _)> = vec![
        (|_| (), Ok(1)),
        (|it| it.bound.extend(indexed(1, 99)), Ok(1)),
        (
            |it| it.bound.extend(indexed(1, 100)),
            too_large("number of agents with roles"),
        ),
        (
            |it| it.bound[1].1 = "cid".to_owned(),
            malformed("a conversation without the agent"),
        ),
        (|it| it.bound[1].0 = 2, malformed("an unknown role")),
        (|it| it.unnamed = 1, malformed(unfit)),
        (|it| it.parties.push(String::new()), malformed(unfit)),
        (|it| it.parties = names(1), malformed(unfit)),
        (|it| it.parties.clear(), malformed(unfit)),
        (
            |it| it.delegates.push((0, "dan".to_owned())),
            malformed(unfit),
        ),
        (|it| it.reply_to.push("dan".to_owned()), Ok(1)),
        (
            |it| {
                it.initiator = "ben".to_owned();
                it.reply_to.push("dan".to_owned());
            },
            malformed("a conversation that continues elsewhere"),
        ),
    ];
    for (number, (change, expected)) in per_conversation.into_iter().enumerate() {
        let found = restored(change, Written::per_conversation);
        assert_eq!(found, expected, "{number}");
    }
}
