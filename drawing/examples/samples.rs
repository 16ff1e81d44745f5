//! Writes samples into a directory, to look at after a change. `fipa protocol draw` draws automata.
//!
//! ```console
//! $ cargo run -p fipa-drawing --example samples -- /tmp/samples
//! ```

use std::error::Error;
use std::path::Path;

use fipa_drawing::{
    Arrow, Bar, Bars, Body, Color, Group, Interval, Line, Mark, Note, Page, Plane, Plot, Pose,
    Section, Sequence, Shape, Step, Timeline, TimelineRow,
};

fn main() -> Result<(), Box<dyn Error>> {
    let directory = std::env::args().nth(1).ok_or("give a directory")?;
    let directory = Path::new(&directory);
    std::fs::create_dir_all(directory)?;
    let page = Page {
        title: "Docking of two robots".to_owned(),
        text:
            "Two rovers dock at one station. The lock of the station has one holder at a time. The \
               program of rover_1 is killed while it holds the lock, and its lease ends."
                .to_owned(),
        sections: vec![
            Section::new("Letters", sequence()),
            Section {
                text: "Label: holder and fence.".to_owned(),
                ..Section::new("Locks", locks())
            },
            Section::new("Coalitions", coalitions()),
            Section::new("Paths", plane()),
        ],
    };
    for (name, svg) in [
        ("sequence", sequence().svg()),
        ("locks", locks().svg()),
        ("coalitions", coalitions().svg()),
        ("plane", plane().svg()),
        ("page", page.svg()),
        ("plot", plot().svg()),
        ("bars", bars().svg()),
    ] {
        std::fs::write(directory.join(format!("{name}.svg")), svg)?;
    }
    Ok(())
}

fn arrow(time: f64, from: &str, to: &str, label: &str) -> Arrow {
    Arrow {
        from: from.to_owned(),
        to: to.to_owned(),
        label: label.to_owned(),
        time: format!("{time:.1} s"),
        ..Arrow::default()
    }
}

fn note(time: f64, lane: &str, text: &str) -> Step {
    Step::Note(Note {
        lane: lane.to_owned(),
        text: text.to_owned(),
        time: format!("{time:.1} s"),
    })
}

fn sequence() -> Sequence {
    let mut steps: Vec<Step> = [
        arrow(0.1, "station", "rover_1", "cfp"),
        arrow(0.1, "station", "rover_2", "cfp"),
        arrow(0.3, "rover_1", "station", "propose (3.5 m)"),
        arrow(0.4, "rover_2", "station", "propose (7.1 m)"),
        arrow(0.5, "station", "rover_1", "accept-proposal"),
        arrow(0.5, "station", "rover_2", "reject-proposal"),
        arrow(0.9, "rover_1", "locks@host_a", "request (lock berth)"),
        arrow(1.0, "locks@host_a", "rover_1", "inform (fence 7)"),
    ]
    .map(Step::Arrow)
    .into();
    for round in 0..14 {
        let time = 1.2 + f64::from(round) * 0.2;
        steps.push(Step::Arrow(arrow(time, "station", "rover_1", "align")));
        steps.push(Step::Arrow(arrow(
            time + 0.1,
            "rover_1",
            "station",
            "inform",
        )));
    }
    steps.push(note(4.6, "rover_1", "killed"));
    steps.push(Step::Arrow(Arrow {
        failed: Some("no such agent".to_owned()),
        ..arrow(4.9, "station", "rover_1", "align")
    }));
    steps.push(note(7.0, "locks@host_a", "lease of rover_1 ended"));
    steps.push(Step::Arrow(Arrow {
        violation: Some(
            "inform from rover_2 to station breaks fipa-request: the request was refused; expected \
             no further message"
                .to_owned(),
        ),
        ..arrow(7.4, "rover_2", "station", "inform")
    }));
    steps.push(Step::Arrow(arrow(7.9, "rover_2", "rover_2", "plan again")));
    steps.push(Step::Arrow(arrow(
        8.1,
        "rover_2",
        "locks@host_a",
        "request (lock berth)",
    )));
    steps.push(Step::Arrow(arrow(
        8.2,
        "locks@host_a",
        "rover_2",
        "inform (fence 8)",
    )));
    Sequence {
        lanes: ["station", "rover_1", "rover_2", "locks@host_a"]
            .map(str::to_owned)
            .into(),
        steps,
    }
}

fn interval(label: &str, from: f64, until: Option<f64>, color: usize) -> Interval {
    Interval {
        label: label.to_owned(),
        from,
        until,
        color: Color::nth(color),
    }
}

fn row(name: &str, intervals: Vec<Interval>) -> TimelineRow {
    TimelineRow {
        name: name.to_owned(),
        intervals,
    }
}

fn marks() -> Vec<Mark> {
    [
        (4.6, "rover_1 killed"),
        (5.0, "link cut"),
        (11.2, "link back"),
    ]
    .map(|(at, label)| Mark {
        at,
        label: label.to_owned(),
    })
    .into()
}

fn locks() -> Timeline {
    let mut short = Vec::new();
    for number in 0..9 {
        let from = 1.0 + f64::from(number) * 0.5;
        let label = format!("rover_{} #{}", number % 3 + 1, number + 20);
        short.push(interval(
            &label,
            from,
            Some(from + 0.3),
            number as usize % 3,
        ));
    }
    Timeline {
        rows: vec![
            row(
                "berth",
                vec![
                    interval("rover_1 #7", 1.0, Some(7.0), 0),
                    interval("rover_2 #8", 8.2, Some(12.4), 1),
                    interval("rover_3 #9", 12.5, None, 2),
                ],
            ),
            row("charger", short),
            row(
                "corridor between the halls",
                vec![interval("rover_2 #3", 0.2, Some(0.9), 1)],
            ),
        ],
        marks: marks(),
        until: Some(14.0),
    }
}

fn coalitions() -> Timeline {
    Timeline {
        rows: vec![
            row(
                "rover_1",
                vec![
                    interval("dock (leader)", 0.5, Some(4.6), 0),
                    interval("carry", 9.0, None, 1),
                ],
            ),
            row(
                "rover_2",
                vec![
                    interval("dock", 0.6, Some(5.2), 0),
                    interval("dock (leader)", 5.3, None, 0),
                    interval("carry", 3.0, Some(10.5), 1),
                ],
            ),
            row("rover_3", vec![interval("carry (leader)", 2.8, None, 1)]),
        ],
        marks: marks(),
        until: Some(14.0),
    }
}

fn plane() -> Plane {
    let robot = Shape::Circle { radius: 0.25 };
    let path = |number: i32, color: usize, of: fn(f64) -> (f64, f64, f64)| Body {
        name: format!("rover_{number}"),
        shape: robot,
        color: Color::nth(color),
        poses: (0..=200)
            .map(|step| of(f64::from(step) / 200.0))
            .map(|(x, y, heading)| Pose { x, y, heading })
            .collect(),
    };
    let fixed = |name: &str, (length, width), (x, y, heading): (f64, f64, f64)| Body {
        name: name.to_owned(),
        shape: Shape::Rectangle { length, width },
        color: Color(0x66, 0x70, 0x7a),
        poses: vec![Pose { x, y, heading }],
    };
    Plane {
        bodies: vec![
            fixed("station", (1.6, 1.0), (5.0, 2.0, 0.0)),
            fixed("charger", (0.4, 0.4), (1.0, -0.6, 0.4)),
            path(1, 0, |at| (4.0 * at, 2.0 + (6.0 * at).sin() * 0.6, 0.0)),
            path(2, 1, |at| (8.5 - 2.4 * at, 4.0 - 2.2 * at, -2.3)),
            path(3, 2, |at| (3.0 + at, -0.5 + 1.2 * at * at, 1.0)),
            path(4, 3, |at| (3.4 + at, -0.9 + 1.2 * at, 0.8)),
        ],
    }
}

fn micros(value: f64) -> String {
    format!("{value} µs")
}

fn plot() -> Plot {
    let sizes = [100.0, 1024.0, 65_536.0, 1_048_576.0];
    let line = |name: &str, number, thin, start: f64| Line {
        name: name.to_owned(),
        color: Color::nth(number),
        thin,
        points: sizes.map(|size| (size, start + size / 4000.0)).into(),
    };
    Plot {
        title: "Time of a letter".to_owned(),
        subtitle: "A sample without measurement".to_owned(),
        x: "content".to_owned(),
        x_marks: sizes.map(|size| (size, format!("{size} B"))).into(),
        unit: micros,
        lines: vec![
            line("agents via shm, filled, spinning", 0, false, 1.1),
            line("raw iceoryx2", 0, true, 0.6),
            line("agents via tcp, blocking", 1, false, 24.0),
            line("raw tcp, blocking", 1, true, 19.0),
        ],
    }
}

fn bars() -> Bars {
    let bar = |series, value| Bar {
        series,
        value,
        deviation: value / 8.0,
        mark: Some(value * 1.7),
    };
    let group = |name: &str, value: f64| Group {
        name: name.to_owned(),
        bars: vec![bar(0, value), bar(1, value * 2.0)],
    };
    Bars {
        title: "Time of encoding and decoding".to_owned(),
        series: vec!["encode".to_owned(), "decode".to_owned()],
        mark: "another library".to_owned(),
        groups: vec![
            group("bit-efficient message", 1.2),
            group("string message", 4.0),
            group("XML message in bit-efficient envelope", 31.0),
        ],
        unit: micros,
        logarithmic: true,
    }
}
