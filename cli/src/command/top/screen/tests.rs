//! Tests of the screen on a terminal in memory.

use std::time::{Duration, Instant, SystemTime};

use fipa::admin::watch::Fate;
use fipa::{Kind, Outcome};
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use unicode_width::UnicodeWidthStr;

use super::*;
use crate::command::top::meter::{Meter, Observed, tests::named};
use crate::command::top::peers::Peers;
use crate::command::top::peers::tests::report;
use crate::command::top::table::Surroundings;
use crate::command::top::view::Filter;

/// A domain in which `rover` sends to `arm_1`, and fails to send to a name that does not exist.
fn snapshot(names: &[&str]) -> Snapshot {
    let start = Instant::now();
    let mut meter = Meter::new(start, Duration::from_secs(5));
    let now = start + Duration::from_secs(5);
    let mut peers = Peers::default();
    peers.handle_report(now, Some(report()));
    meter.register(now, names.iter().copied());
    for number in 0..20 {
        let outcome = Outcome::Delivered {
            via: Kind::Shm,
            attempts: Vec::new(),
        };
        let letter = named(number, "rover", "arm_1", Fate::Settled(outcome));
        let passage = &letter;
        let host = (number % 2 == 0).then_some("crex-mts");
        meter.letter(now, &Observed { passage, host }, number == 0);
    }
    let letter = named(
        100,
        "rover",
        "nowhere",
        Fate::Settled(Outcome::Failed {
            reason: fipa_transport::FailureReason::NoSuchAgent,
            attempts: Vec::new(),
        }),
    );
    let passage = &letter;
    meter.letter(
        now,
        &Observed {
            passage,
            host: None,
        },
        false,
    );
    meter.lose(3);
    let surroundings = Surroundings {
        domain: "default".to_owned(),
        host: "sherpa".to_owned(),
        time: SystemTime::UNIX_EPOCH + Duration::from_secs(50_000),
        here: names.len(),
        elsewhere: 4,
        processes: 2,
        gateway: Some("sherpa-mts".to_owned()),
        problem: None,
    };
    let rows = peers.rows(now, &meter);
    Snapshot::new(now, &meter, rows, surroundings)
}

fn drawn(snapshot: &Snapshot, view: &View, width: u16, height: u16) -> Vec<String> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    let palette = Palette { color: true };
    terminal
        .draw(|frame| draw(frame, snapshot, view, palette))
        .unwrap();
    let text = terminal.backend().to_string();
    let lines = text.lines().map(|line| {
        let line = line.trim_start_matches('"');
        let line = line.split_once('"').map_or(line, |(line, _)| line);
        line.trim_end().to_owned()
    });
    lines.collect()
}

fn view() -> View {
    View::new(Column::Sent, None)
}

#[test]
fn a_domain_on_80_columns() {
    let lines = drawn(&snapshot(&["rover", "arm_1", "camera"]), &view(), 80, 24);
    assert_eq!(lines, GOLDEN_80, "{}", lines.join("\n"));
}

#[test]
fn a_domain_on_40_columns() {
    let lines = drawn(&snapshot(&["rover", "arm_1", "camera"]), &view(), 40, 12);
    assert_eq!(lines, GOLDEN_40, "{}", lines.join("\n"));
}

#[rustfmt::skip]
const GOLDEN_80: [&str; 24] = [
    "fipa top: domain default on sherpa                                  13:53:20 UTC",
    "agents 3 here, 4 elsewhere  processes 2  gateway sherpa-mts",
    "letters 4.2/s  failures 0.2/s  violations 1  lost 3  median 20 ms  p99 20 ms",
    "",
    "AGENT                     SENT/s▼  RECV/s  FAIL/s   VIOL   MEDIAN      P99 VIA",
    "rover                         4.2       0     0.2      1    20 ms    20 ms shm",
    "arm_1                           0     4.0       0      0        -        - shm",
    "camera                          0       0       0      0        -        - -",
    "",
    "HOST           STATE          TO/s FROM/s   MEDIAN TRANSPORTS  SECURITY  RETRIES",
    "bert-mts       lost 5s           0      0        - -           -               0",
    "crex-mts       up 1m 0s        2.0      0    20 ms tcp         encrypted       7",
    "lander         no answer         0      0        - -           -               0",
    "",
    "",
    "",
    "",
    "",
    "",
    "",
    "",
    "",
    "",
    "q quit  ←→ sort  r reverse  / filter  p pause  ? help",
];

#[rustfmt::skip]
const GOLDEN_40: [&str; 12] = [
    "fipa top: domain default …  13:53:20 UTC",
    "agents 3 here, 4 elsewhere  processes 2",
    "gateway sherpa-mts",
    "letters 4.2/s  failures 0.2/s",
    "violations 1  lost 3  median 20 ms",
    "p99 20 ms",
    "AGENT            SENT/s▼  RECV/s  FAIL/s",
    "rover                4.2       0     0.2",
    "… 2 more of 3 agents",
    "HOST          STATE          TO/s FROM/s",
    "… 3 more of 3 hosts",
    "q quit  ←→ sort  r reverse  / filter  p…",
];

#[test]
fn hostile_and_wide_names_do_not_break_the_lines() {
    let names = [
        "机器人手臂_1",
        "\u{1b}[2J\nx",
        "e\u{301}\u{202e}gnp",
        "🤖🤖🤖🤖🤖🤖🤖🤖🤖🤖",
        "a b",
    ];
    let snapshot = snapshot(&names);
    for width in [1, 2, 3, 20, 40, 61, 80, 200] {
        let lines = drawn(&snapshot, &view(), width, 24);
        assert_eq!(lines.len(), 24);
        for line in &lines {
            assert!(line.width() <= usize::from(width), "{width}: {line:?}");
            assert!(!line.contains(fipa_acl::is_unprintable), "{line:?}");
        }
    }
    let lines = drawn(&snapshot, &view(), 80, 24);
    // The columns after a wide name are in their places.
    let of = |name: &str| lines.iter().find(|line| line.contains(name)).unwrap();
    let (wide, plain) = (of("机器人手臂_1"), of("rover"));
    assert_eq!(wide.width(), plain.width() - "shm".width() + "-".width());
}

#[test]
fn all_sizes_can_be_drawn() {
    let snapshot = snapshot(&["rover", "arm_1"]);
    let mut help = view();
    help.help = true;
    let mut input = view();
    input.handle_key(KeyEvent::new(KeyCode::Char('/'), KeyModifiers::NONE));
    for width in 1..90 {
        for height in 1..26 {
            for view in [&view(), &help, &input] {
                drawn(&snapshot, view, width, height);
            }
        }
    }
}

#[test]
fn a_long_list_says_how_many_agents_are_left_out_and_scrolls() {
    let names: Vec<String> = (0..100)
        .map(|number| format!("agent_{number:02}"))
        .collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let snapshot = snapshot(&names);
    let mut view = View::new(Column::Agent, None);
    let lines = drawn(&snapshot, &view, 80, 24);
    let shown = |lines: &[String]| {
        let agents = lines.iter().filter(|line| line.starts_with("agent_"));
        agents.count()
    };
    let number = shown(&lines);
    assert!(number > 5, "{lines:?}");
    let more = format!("… {} more of 102 agents", 102 - number);
    assert!(lines.contains(&more), "{lines:?}");
    view.first = 50;
    let lines = drawn(&snapshot, &view, 80, 24);
    assert!(
        lines.iter().any(|line| line.starts_with("agent_50")),
        "{lines:?}"
    );
    // Beyond the end, the last agents are shown.
    view.first = usize::MAX;
    let lines = drawn(&snapshot, &view, 80, 24);
    assert!(
        lines.iter().any(|line| line.starts_with("rover")),
        "{lines:?}"
    );
}

#[test]
fn the_filter_and_the_pause_are_visible() {
    let snapshot = snapshot(&["rover", "arm_1", "arm_2"]);
    let mut view = View::new(Column::Failed, Filter::parse("arm_.*").ok());
    view.paused = true;
    let lines = drawn(&snapshot, &view, 80, 24);
    assert!(lines[0].contains(" PAUSED "), "{lines:?}");
    let agents = lines.iter().skip(5).take_while(|line| !line.is_empty());
    let names: Vec<&str> = agents.filter_map(|line| line.split(' ').next()).collect();
    assert_eq!(names, ["arm_1", "arm_2"], "{lines:#?}");
    let title = &lines[4];
    assert!(title.starts_with("AGENT matching arm_.*"), "{title}");
    assert!(title.contains("FAIL/s▼"), "{title}");
}
