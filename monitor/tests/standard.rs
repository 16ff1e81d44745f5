//! Checks the protocols against tables of the standard.
//!
//! The tables below are written by hand from FIPA00026 to FIPA00036, not generated from the files that
//! they check. `>` is a message of the initiator, `<` a message of the participant, and `!` the
//! expiration of the call's `reply-by`. States with a name that begins with F are final. Of two rows
//! that fit, the first counts. `*` is any performative. [`Walk::by_common_rules`] has the rules of all
//! protocols: not-understood and cancel.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{Performative, Time};
use fipa_monitor::{Header, Library, Monitor, Verdict};

type Row = (&'static str, char, &'static str, &'static str);

struct Table {
    name: &'static str,
    rows: &'static [Row],
    cancel: bool,
}

/// FIPA00026: agree may be skipped.
const REQUEST: Table = Table {
    name: "fipa-request",
    rows: &[
        ("0", '>', "request", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "agree", "2"),
        ("1", '<', "inform", "F"),
        ("1", '<', "failure", "F"),
        ("2", '<', "failure", "F"),
        ("2", '<', "inform", "F"),
    ],
    cancel: true,
};

/// FIPA00027.
const QUERY: Table = Table {
    name: "fipa-query",
    rows: &[
        ("0", '>', "query-if", "1"),
        ("0", '>', "query-ref", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "agree", "2"),
        ("1", '<', "failure", "F"),
        ("1", '<', "inform", "F"),
        ("2", '<', "failure", "F"),
        ("2", '<', "inform", "F"),
    ],
    cancel: true,
};

/// Additional answers of the agents of fipa_acl.
const ROCK_QUERY: Table = Table {
    name: "query",
    rows: &[
        ("0", '>', "query-if", "1"),
        ("0", '>', "query-ref", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "agree", "2"),
        ("1", '<', "failure", "F"),
        ("1", '<', "inform", "F"),
        ("1", '<', "inform-if", "F"),
        ("1", '<', "inform-ref", "F"),
        ("2", '<', "failure", "F"),
        ("2", '<', "inform", "F"),
        ("2", '<', "inform-if", "F"),
        ("2", '<', "inform-ref", "F"),
    ],
    cancel: true,
};

/// FIPA00028: agree must not be skipped.
const REQUEST_WHEN: Table = Table {
    name: "fipa-request-when",
    rows: &[
        ("0", '>', "request-when", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "agree", "2"),
        ("2", '<', "failure", "F"),
        ("2", '<', "inform", "F"),
    ],
    cancel: true,
};

/// FIPA00036.
const PROPOSE: Table = Table {
    name: "fipa-propose",
    rows: &[
        ("0", '>', "propose", "1"),
        ("1", '<', "accept-proposal", "F"),
        ("1", '<', "reject-proposal", "F"),
    ],
    cancel: true,
};

/// FIPA00035: inform may be repeated.
const SUBSCRIBE: Table = Table {
    name: "fipa-subscribe",
    rows: &[
        ("0", '>', "subscribe", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "agree", "2"),
        ("1", '<', "inform", "2"),
        ("1", '<', "failure", "F"),
        ("2", '<', "inform", "2"),
        ("2", '<', "failure", "F"),
    ],
    cancel: true,
};

/// FIPA00029. Late proposals are rejected.
const CONTRACT_NET: Table = Table {
    name: "fipa-contract-net",
    rows: &[
        ("0", '>', "cfp", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "propose", "2"),
        ("1", '!', "", "Fexpired"),
        ("2", '>', "reject-proposal", "F"),
        ("2", '>', "accept-proposal", "3"),
        ("3", '<', "failure", "F"),
        ("3", '<', "inform", "F"),
        ("Fexpired", '<', "refuse", "F"),
        ("Fexpired", '<', "propose", "late"),
        ("late", '>', "reject-proposal", "F"),
    ],
    cancel: true,
};

/// FIPA00030: a proposal may be answered with a revised call.
const ITERATED_CONTRACT_NET: Table = Table {
    name: "fipa-iterated-contract-net",
    rows: &[
        ("0", '>', "cfp", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "propose", "2"),
        ("1", '!', "", "Fexpired"),
        ("2", '>', "reject-proposal", "F"),
        ("2", '>', "accept-proposal", "3"),
        ("2", '>', "cfp", "1"),
        ("3", '<', "failure", "F"),
        ("3", '<', "inform", "F"),
        ("Fexpired", '<', "refuse", "F"),
        ("Fexpired", '<', "propose", "late"),
        ("late", '>', "reject-proposal", "F"),
    ],
    cancel: true,
};

/// FIPA00031 for one bidder. A second call after its bid was accepted means that another bidder
/// leads.
const ENGLISH: Table = Table {
    name: "fipa-auction-english",
    rows: &[
        ("0", '>', "inform", "1"),
        ("1", '>', "cfp", "2"),
        ("2", '<', "propose", "bid"),
        ("2", '>', "cfp", "2"),
        ("2", '>', "inform", "F"),
        ("bid", '>', "accept-proposal", "leads"),
        ("bid", '>', "reject-proposal", "lost"),
        // The bid crossed the next call or the end.
        ("bid", '>', "cfp", "2"),
        ("bid", '>', "inform", "F"),
        ("lost", '>', "cfp", "2"),
        ("lost", '>', "inform", "F"),
        ("leads", '>', "cfp", "2 leading"),
        ("leads", '>', "inform", "F3"),
        ("2 leading", '<', "propose", "bid leading"),
        ("2 leading", '>', "cfp", "2"),
        ("2 leading", '>', "inform", "F3"),
        ("bid leading", '>', "accept-proposal", "leads"),
        ("bid leading", '>', "reject-proposal", "lost"),
        // The bid of the leader crossed the next call or the end.
        ("bid leading", '>', "cfp", "2"),
        ("bid leading", '>', "inform", "F3"),
        ("F3", '>', "request", "F"),
    ],
    cancel: false,
};

/// FIPA00032 for one bidder.
const DUTCH: Table = Table {
    name: "fipa-auction-dutch",
    rows: &[
        ("0", '>', "inform", "1"),
        ("1", '>', "cfp", "2"),
        ("2", '>', "cfp", "2"),
        ("2", '<', "propose", "3"),
        ("2", '>', "inform", "F"),
        ("3", '>', "accept-proposal", "Fbought"),
        ("3", '>', "reject-proposal", "Flate"),
        // The bid crossed the next call or the end.
        ("3", '>', "cfp", "2"),
        ("3", '>', "inform", "F"),
        ("Fbought", '>', "cfp", "2"),
        ("Fbought", '>', "inform", "F"),
        ("Flate", '>', "cfp", "2"),
        ("Flate", '>', "inform", "F"),
    ],
    cancel: false,
};

/// FIPA00033: in 3, all answers of the targets are forwarded.
const BROKERING: Table = Table {
    name: "fipa-brokering",
    rows: &[
        ("0", '>', "proxy", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "agree", "2"),
        ("2", '<', "failure", "F"),
        ("2", '<', "inform", "F3"),
        ("F3", '<', "failure", "F"),
        ("F3", '<', "*", "F3"),
    ],
    cancel: true,
};

/// FIPA00034: the answers of the recruited agents are not part of it.
const RECRUITING: Table = Table {
    name: "fipa-recruiting",
    rows: &[
        ("0", '>', "proxy", "1"),
        ("1", '<', "refuse", "F"),
        ("1", '<', "agree", "2"),
        ("2", '<', "failure", "F"),
        ("2", '<', "inform", "Fproxied"),
        // Further messages between the two belong to the embedded protocol.
        ("Fproxied", '#', "", "Fproxied"),
    ],
    cancel: true,
};

/// The cancel meta-protocol by itself.
const CANCEL: Table = Table {
    name: "fipa-cancel",
    rows: &[
        ("0", '>', "cancel", "1"),
        ("1", '<', "inform", "F"),
        ("1", '<', "failure", "F"),
    ],
    cancel: false,
};

const TABLES: [Table; 13] = [
    REQUEST,
    QUERY,
    ROCK_QUERY,
    REQUEST_WHEN,
    PROPOSE,
    SUBSCRIBE,
    CONTRACT_NET,
    ITERATED_CONTRACT_NET,
    ENGLISH,
    DUTCH,
    BROKERING,
    RECRUITING,
    CANCEL,
];

/// A conversation and its state in the table.
struct Walk<'t> {
    table: &'t Table,
    monitor: Monitor,
    now: SystemTime,
    state: &'static str,
    /// The state before.
    before: &'static str,
    last: char,
}

impl<'t> Walk<'t> {
    fn new(table: &'t Table, library: &Arc<Library>) -> Self {
        Self {
            table,
            monitor: Monitor::observer(Arc::clone(library)),
            now: SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000),
            state: "0",
            before: "-",
            last: '-',
        }
    }

    fn along(table: &'t Table, library: &Arc<Library>, path: &[Row]) -> Self {
        let mut walk = Self::new(table, library);
        for row in path {
            walk.step(*row);
        }
        walk
    }

    /// Takes the transition of a row, which must be accepted.
    fn step(&mut self, (_, side, act, to): Row) {
        let before = self.state;
        if side == '!' {
            self.now += Duration::from_secs(10);
            // A timeout does not cross messages.
            self.before = "-";
            self.state = to;
            return;
        }
        let act = if act == "*" { "request" } else { act };
        let name = self.table.name;
        let over = !self.table.rows.iter().any(|row| row.0 == to);
        let verdict = self.say(side, &act.parse().unwrap());
        match verdict {
            Verdict::Accepted(accepted) => {
                assert_eq!(accepted.protocol, name);
                let ended = to.starts_with('F');
                assert_eq!(accepted.over, ended && over, "{name}: {before} {side}{act}");
                let so = (accepted.ended, accepted.complete, accepted.opened);
                assert_eq!(
                    so,
                    (ended, ended, before == "0"),
                    "{name}: {before} {side}{act}"
                );
            }
            other => panic!("{name}: {before} {side}{act}: {other:?}"),
        }
        self.before = before;
        self.state = to;
        self.last = side;
    }

    fn say(&mut self, side: char, act: &Performative) -> Verdict<'_> {
        let (from, to) = match side {
            '>' => ("ann", "ben"),
            _ => ("ben", "ann"),
        };
        let mut header = Header::new(act.clone())
            .sender(from)
            .receivers([to])
            .protocol(self.table.name)
            .conversation_id("c");
        if side == '>' {
            let due = Time::from_system_time(self.now + Duration::from_secs(5)).unwrap();
            header = header.reply_by(due);
        }
        self.monitor.check(&header, self.now)
    }

    fn row(&self, side: char, act: &str) -> Option<Row> {
        let here = |row: &&Row| row.0 == self.state && row.1 == side;
        let mut rows = self.table.rows.iter().filter(here);
        rows.find(|row| row.2 == act || row.2 == "*").copied()
    }

    /// The rules of every protocol.
    fn by_common_rules(&self, side: char, act: &str) -> bool {
        let ended = self.state.starts_with('F');
        let over = ended && !self.table.rows.iter().any(|row| row.0 == self.state);
        if self.state == "0" {
            return false;
        }
        match act {
            // Allowed at any time; after the last message, only for its receiver.
            "not-understood" => !ended || side != self.last,
            // Allowed for the initiator before it has received the end.
            "cancel" => self.table.cancel && side == '>' && (!over || self.last == '<'),
            _ => {
                // A message that crossed the last one of the other side.
                let mut rows = self.table.rows.iter();
                let allows = |row: &Row| (row.0, row.1, row.2) == (self.before, side, act);
                side != self.last && rows.any(allows)
            }
        }
    }
}

/// The shortest path to each state, for each side that may have sent the last message.
fn shortest_paths(table: &Table) -> Vec<Vec<Row>> {
    let mut seen = HashSet::from([("0", '-')]);
    let mut paths: Vec<Vec<Row>> = vec![Vec::new()];
    let mut next = 0;
    while let Some(path) = paths.get(next).cloned() {
        next += 1;
        let state = path.last().map_or("0", |row| row.3);
        let last = path.iter().rev().find(|row| row.1 != '!');
        for row in table.rows.iter().filter(|row| row.0 == state) {
            let last = match row.1 {
                '#' => continue,
                '!' => last.map_or('-', |row| row.1),
                side => side,
            };
            if seen.insert((row.3, last)) {
                let mut longer = path.clone();
                longer.push(*row);
                paths.push(longer);
            }
        }
    }
    paths
}

#[test]
fn every_performative_is_checked_in_every_state() {
    let library = Arc::new(Library::standard());
    let mut wrong = 0;
    for table in &TABLES {
        for path in shortest_paths(table) {
            for side in ['>', '<'] {
                for act in &Performative::STANDARD {
                    let mut walk = Walk::along(table, &library, &path);
                    let right = walk.row(side, act.as_str()).is_some()
                        || walk.by_common_rules(side, act.as_str());
                    let (name, state) = (table.name, walk.state);
                    let opened_by_other = state == "0" && side == '<';
                    let verdict = walk.say(side, act);
                    if opened_by_other && walk_begins(table, act) {
                        // The sender of the first message is the initiator; its name does not matter.
                        assert!(verdict.is_accepted());
                        continue;
                    }
                    let what = format!("{name}: {side}{act} in {state}: {verdict:?}");
                    assert_eq!(verdict.is_accepted(), right, "{what}");
                    assert_eq!(verdict.violation().is_some(), !right, "{what}");
                    wrong += usize::from(!right);
                }
            }
        }
    }
    assert!(wrong > 2_000, "{wrong}");
}

fn walk_begins(table: &Table, act: &Performative) -> bool {
    let mut rows = table.rows.iter();
    rows.any(|row| row.0 == "0" && row.2 == act.as_str())
}

#[test]
fn every_path_to_an_end_is_accepted() {
    let library = Arc::new(Library::standard());
    for table in &TABLES {
        let mut used = HashSet::new();
        let mut paths = vec![Vec::<Row>::new()];
        let mut walked = 0;
        while let Some(path) = paths.pop() {
            let state = path.last().map_or("0", |row| row.3);
            if state.starts_with('F') {
                Walk::along(table, &library, &path);
                walked += 1;
            }
            let onwards = table
                .rows
                .iter()
                .filter(|row| row.0 == state && row.1 != '#');
            for row in onwards {
                used.insert((row.0, row.1, row.2));
                // Every loop at most twice.
                let times = path.iter().filter(|other| *other == row).count();
                if times < 2 && path.len() < 10 {
                    let mut longer = path.clone();
                    longer.push(*row);
                    paths.push(longer);
                }
            }
        }
        let rows = table.rows.iter().filter(|row| row.1 != '#').count();
        assert_eq!(used.len(), rows, "{}", table.name);
        assert!(walked > 1, "{}", table.name);
    }
}

/// Paths to an end without timeouts, which would affect all participants.
fn timeless_paths(table: &Table) -> Vec<Vec<Row>> {
    let mut found = Vec::new();
    let mut paths = vec![Vec::<Row>::new()];
    while let Some(path) = paths.pop() {
        let state = path.last().map_or("0", |row| row.3);
        if state.starts_with('F') {
            found.push(path.clone());
        }
        let here = table.rows.iter().filter(|row| row.0 == state);
        for row in here.filter(|row| !matches!(row.1, '!' | '#')) {
            if !path.contains(row) {
                paths.push([&path[..], &[*row]].concat());
            }
        }
    }
    found
}

#[test]
fn several_participants_have_independent_states() {
    let library = Arc::new(Library::standard());
    for table in &TABLES {
        let paths = timeless_paths(table);
        let mut walked = 0;
        'paths: for (number, first) in paths.iter().enumerate() {
            // The first message goes to all three. Each then takes another path.
            let [second, third] = [1, 3].map(|other| &paths[(number + other) % paths.len()]);
            if first[0] != second[0] || first[0] != third[0] {
                continue;
            }
            walked += 1;
            let mut walk = Walk::new(table, &library);
            let say = |walk: &mut Walk<'_>, from: &str, to: &[&str], act: &str| {
                let act = if act == "*" { "request" } else { act };
                let header = Header::new(act.parse().unwrap())
                    .sender(from.to_owned())
                    .receivers(to.iter().map(|name| (*name).to_owned()))
                    .protocol(table.name)
                    .conversation_id("c");
                match walk.monitor.check(&header, walk.now) {
                    Verdict::Accepted(accepted) => (accepted.ended, accepted.complete),
                    other => panic!("{}: {act} from {from} to {to:?}: {other:?}", table.name),
                }
            };
            say(&mut walk, "ann", &["ben", "cid", "dan"], first[0].2);
            let (mut ends, mut leads) = ([false; 3], [false; 3]);
            for at in 1..first.len().max(second.len()).max(third.len()) {
                for (index, path) in [first, second, third].into_iter().enumerate() {
                    let Some((_, side, act, to)) = path.get(at) else {
                        continue;
                    };
                    let peer = ["ben", "cid", "dan"][index];
                    let (from, receiver) = if *side == '>' {
                        ("ann", peer)
                    } else {
                        (peer, "ann")
                    };
                    // Only one bidder leads.
                    leads[index] = *to == "leads";
                    if leads.iter().filter(|leads| **leads).count() > 1 {
                        continue 'paths;
                    }
                    let (ended, complete) = say(&mut walk, from, &[receiver], act);
                    ends[index] = to.starts_with('F');
                    assert_eq!((ended, complete), (ends[index], ends == [true; 3]));
                }
            }
        }
        assert!(walked > 1, "{}", table.name);
    }
}

#[test]
fn a_cancel_ends_or_resumes_every_protocol() {
    let library = Arc::new(Library::standard());
    let [inform, failure, cancel] =
        ["inform", "failure", "cancel"].map(|act| act.parse::<Performative>().unwrap());
    for table in TABLES.iter().filter(|table| table.cancel) {
        for path in shortest_paths(table) {
            let state = path.last().map_or("0", |row| row.3);
            if state == "0" || state.starts_with('F') {
                continue;
            }
            let name = table.name;
            // The cancel succeeds: only crossing messages may follow.
            let mut walk = Walk::along(table, &library, &path);
            assert!(walk.say('>', &cancel).is_accepted(), "{name} {state}");
            assert!(!walk.say('>', &cancel).is_accepted(), "{name} {state}");
            let verdict = walk.say('<', &inform);
            let Verdict::Accepted(accepted) = verdict else {
                panic!("{name} {state}: {verdict:?}");
            };
            assert_eq!((accepted.state, accepted.ended), ("cancelled", true));
            for act in &Performative::STANDARD {
                assert!(!walk.say('>', act).is_accepted(), "{name} {state} {act}");
            }
            // The cancel fails: the protocol continues in its state.
            let mut walk = Walk::along(table, &library, &path);
            walk.say('>', &cancel);
            assert!(walk.say('<', &failure).is_accepted(), "{name} {state}");
            let onwards = table.rows.iter().filter(|row| row.0 == state);
            let row = onwards.clone().find(|row| !matches!(row.1, '!' | '#'));
            walk.step(*row.unwrap());
        }
    }
}
