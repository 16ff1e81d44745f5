//! Any text and any number makes a well-formed, bounded document.

use proptest::prelude::*;
use quick_xml::events::Event;

use crate::{
    Arrow, Automaton, Bar, Bars, Body, Color, Group, Interval, Line, Mark, Note, Page, Plane, Plot,
    Pose, Row, Section, Sequence, Shape, State, Step, Timeline, TimelineRow,
};

/// Fails unless a document is well-formed, has only finite numbers, and is not larger than expected.
fn check(svg: &str) {
    let mut reader = quick_xml::Reader::from_str(svg);
    reader.config_mut().check_end_names = true;
    let mut depth = 0;
    loop {
        match reader.read_event().unwrap() {
            Event::Start(tag) => {
                depth += 1;
                check_attributes(&tag);
            }
            Event::Empty(tag) => check_attributes(&tag),
            Event::End(_) => depth -= 1,
            Event::Text(text) => {
                let text = text.into_inner();
                let allowed = |c: char| c == '\n' || (!c.is_control() && c != '\u{ffff}');
                assert!(text.chars().all(allowed), "{text:?}");
            }
            Event::Eof => break,
            _ => {}
        }
    }
    assert_eq!(depth, 0);
    assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n"));
    assert!(svg.len() < 3_000_000, "{} bytes", svg.len());
}

fn check_attributes(tag: &quick_xml::events::BytesStart<'_>) {
    for attribute in tag.attributes() {
        let attribute = attribute.unwrap();
        let value = attribute.value;
        assert!(!value.contains("NaN") && !value.contains("inf"), "{value}");
    }
}

fn number() -> impl Strategy<Value = f64> {
    let strange = [
        f64::NAN,
        f64::INFINITY,
        f64::NEG_INFINITY,
        1e300,
        -1e300,
        0.0,
        -0.0,
        1e-300,
    ];
    prop_oneof![
        -100.0..100.0_f64,
        prop::sample::select(strange.to_vec()),
        any::<f64>()
    ]
}

fn text() -> impl Strategy<Value = String> {
    prop_oneof![any::<String>(), "[a-d<&>\"' ]{0,4}", "[a-z ]{0,300}"]
}

fn arrow() -> impl Strategy<Value = Step> {
    let reason = || prop::option::weighted(0.2, text());
    let all = (text(), text(), text(), text(), reason(), reason());
    all.prop_map(|(from, to, label, time, violation, failed)| {
        Step::Arrow(Arrow {
            from,
            to,
            label,
            time,
            violation,
            failed,
        })
    })
}

fn sequence() -> impl Strategy<Value = Sequence> {
    let note = (text(), text(), text())
        .prop_map(|(lane, text, time)| Step::Note(Note { lane, text, time }));
    let steps = prop::collection::vec(prop_oneof![4 => arrow(), 1 => note], 0..60);
    let lanes = prop::collection::vec(text(), 0..20);
    (lanes, steps).prop_map(|(lanes, steps)| Sequence { lanes, steps })
}

fn timeline() -> impl Strategy<Value = Timeline> {
    let interval = (text(), number(), prop::option::of(number()), any::<usize>());
    let interval = interval.prop_map(|(label, from, until, color)| Interval {
        label,
        from,
        until,
        color: Color::nth(color),
    });
    let row = (text(), prop::collection::vec(interval, 0..20));
    let row = row.prop_map(|(name, intervals)| TimelineRow { name, intervals });
    let mark = (number(), text()).prop_map(|(at, label)| Mark { at, label });
    let rows = prop::collection::vec(row, 0..10);
    let marks = prop::collection::vec(mark, 0..10);
    (rows, marks, prop::option::of(number())).prop_map(|(rows, marks, until)| Timeline {
        rows,
        marks,
        until,
    })
}

fn plane() -> impl Strategy<Value = Plane> {
    let circle = number().prop_map(|radius| Shape::Circle { radius });
    let rectangle = (number(), number());
    let rectangle = rectangle.prop_map(|(length, width)| Shape::Rectangle { length, width });
    let pose = (number(), number(), number());
    let pose = pose.prop_map(|(x, y, heading)| Pose { x, y, heading });
    let poses = prop::collection::vec(pose, 0..20);
    let body = (
        text(),
        prop_oneof![circle, rectangle],
        any::<usize>(),
        poses,
    );
    let body = body.prop_map(|(name, shape, color, poses)| Body {
        name,
        shape,
        color: Color::nth(color),
        poses,
    });
    prop::collection::vec(body, 0..10).prop_map(|bodies| Plane { bodies })
}

fn automaton() -> impl Strategy<Value = Automaton> {
    let row = (
        text(),
        prop::option::of(0..9_usize),
        any::<bool>(),
        prop::option::of(0..9_usize),
    );
    let row = row.prop_map(|(text, role, dashed, target)| Row {
        text,
        role,
        dashed,
        target,
    });
    let state = (text(), any::<bool>(), prop::collection::vec(row, 0..6));
    let state = state.prop_map(|(name, is_final, rows)| State {
        name,
        is_final,
        rows,
    });
    let texts = || prop::collection::vec(text(), 0..6);
    let states = prop::collection::vec(state, 0..8);
    (text(), texts(), states, any::<usize>(), texts()).prop_map(
        |(title, roles, states, initial, legend)| Automaton {
            title,
            roles,
            states,
            initial,
            legend,
        },
    )
}

fn unit(value: f64) -> String {
    format!("{value} <&>")
}

proptest! {
    #[test]
    fn sequences_are_well_formed(drawing in sequence()) {
        check(&drawing.svg());
    }

    #[test]
    fn timelines_are_well_formed(drawing in timeline()) {
        check(&drawing.svg());
    }

    #[test]
    fn plans_are_well_formed(drawing in plane()) {
        check(&drawing.svg());
    }

    #[test]
    fn automata_are_well_formed(drawing in automaton()) {
        check(&drawing.svg());
    }

    #[test]
    fn pages_are_well_formed(
        title in text(), text in text(), sequence in sequence(), timeline in timeline(), plane in plane()
    ) {
        let sections = vec![
            Section::new(title.clone(), sequence),
            Section::new(text.clone(), timeline),
            Section { text: text.clone(), ..Section::new("plan", plane) },
            Section::default(),
        ];
        check(&Page { title, text, sections }.svg());
    }

    #[test]
    fn measurements_are_well_formed(
        title in text(),
        values in prop::collection::vec((0..3_usize, number(), number(), prop::option::of(number())), 0..20),
        logarithmic in any::<bool>(),
    ) {
        let bars = values.iter().map(|(series, value, deviation, mark)| Bar {
            series: *series, value: *value, deviation: *deviation, mark: *mark,
        });
        let group = Group { name: title.clone(), bars: bars.collect() };
        check(&Bars {
            title: title.clone(),
            series: vec![title.clone(); 3],
            mark: title.clone(),
            groups: vec![group; 2],
            unit,
            logarithmic,
        }.svg());
        let line = Line {
            name: title.clone(),
            points: values.iter().map(|(_, x, y, _)| (*x, *y)).collect(),
            ..Line::default()
        };
        check(&Plot {
            title: title.clone(),
            subtitle: title.clone(),
            x: title.clone(),
            x_marks: values.iter().map(|(_, x, _, _)| (*x, title.clone())).collect(),
            unit,
            lines: vec![line; 2],
        }.svg());
    }
}

#[test]
fn drawings_are_bounded() {
    let step = |number: usize| {
        Step::Arrow(Arrow {
            from: format!("agent {}", number % 900),
            to: "long ".repeat(10_000),
            label: format!("{number}"),
            ..Arrow::default()
        })
    };
    let sequence = Sequence {
        lanes: Vec::new(),
        steps: (0..2_000).map(step).collect(),
    };
    let interval = |number: usize| Interval {
        label: format!("holder {number}"),
        from: number as f64,
        until: Some(number as f64 + 0.5),
        color: Color::nth(number),
    };
    let row = TimelineRow {
        name: "lock".to_owned(),
        intervals: (0..100_000).map(interval).collect(),
    };
    let mark = |number: usize| Mark {
        at: number as f64,
        label: "killed".to_owned(),
    };
    let timeline = Timeline {
        rows: vec![row; 3],
        marks: (0..1_000).map(mark).collect(),
        until: None,
    };
    let pose = |number: usize| Pose {
        x: (number as f64 / 50.0).sin(),
        y: number as f64 / 1000.0,
        heading: 0.0,
    };
    let body = Body {
        poses: (0..100_000).map(pose).collect(),
        ..Body::default()
    };
    let plane = Plane {
        bodies: vec![body; 3],
    };
    check(&sequence.svg());
    check(&timeline.svg());
    let drawn = plane.svg();
    check(&drawn);
    assert!(drawn.len() < 60_000, "{} bytes", drawn.len());
}

#[test]
fn empty_drawings_are_well_formed() {
    check(&Sequence::default().svg());
    check(&Timeline::default().svg());
    check(&Plane::default().svg());
    check(&Automaton::default().svg());
    check(&Page::default().svg());
}
