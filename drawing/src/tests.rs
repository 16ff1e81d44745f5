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
    let current = any::<Option<usize>>();
    (text(), texts(), states, any::<usize>(), current, texts()).prop_map(
        |(title, roles, states, initial, current, legend)| Automaton {
            title,
            roles,
            states,
            initial,
            current,
            legend,
        },
    )
}

fn unit(value: f64) -> String {
    format!("{value} <&>")
}

/// A text of a document with its edges.
struct Place {
    text: String,
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
}

/// Returns the texts of a document.
fn places(svg: &str) -> Vec<Place> {
    let mut reader = quick_xml::Reader::from_str(svg);
    let mut corners: Vec<(f64, f64)> = Vec::new();
    let mut places: Vec<Place> = Vec::new();
    // The text element that begins: position, font size, share of the width left of the position, and weight.
    let mut begun = None;
    loop {
        match reader.read_event().unwrap() {
            Event::Start(tag) => {
                let value = |name: &str| {
                    let attribute = tag.try_get_attribute(name).unwrap();
                    attribute.map_or_else(String::new, |it| it.value.into_owned())
                };
                let number = |text: &str| text.parse::<f64>().unwrap_or_default();
                let (x, y) = corners.last().copied().unwrap_or_default();
                let moved = value("transform");
                let moved = moved.trim_start_matches("translate(").trim_end_matches(')');
                let (right, down) = moved.split_once(' ').unwrap_or_default();
                corners.push((x + number(right), y + number(down)));
                let size = number(&value("font-size"));
                let share = match value("text-anchor").as_str() {
                    "middle" => 0.5,
                    "end" => 1.0,
                    _ => 0.0,
                };
                let at = (x + number(&value("x")), y + number(&value("y")));
                begun = (size > 0.0).then_some((at, size, share, value("font-weight") == "bold"));
            }
            Event::End(_) => {
                corners.pop();
                begun = None;
            }
            Event::Text(text) => {
                if let Some(((x, y), size, share, bold)) = begun {
                    let text = text.into_inner().into_owned();
                    let length = crate::text::width(&text, size, bold);
                    places.push(Place {
                        text,
                        left: x - length * share,
                        right: x + length * (1.0 - share),
                        top: y - size * 0.7,
                        bottom: y + size * 0.1,
                    });
                }
            }
            Event::Eof => break,
            _ => {}
        }
    }
    places
}

/// Fails if two texts overlap, or if a text leaves the document.
fn check_places(svg: &str, width: f64) {
    let places = places(svg);
    for (at, one) in places.iter().enumerate() {
        let is_inside = one.left >= -0.2 && one.right <= width + 0.2;
        assert!(is_inside, "{} leaves the document: {svg}", one.text);
        for other in &places[at + 1..] {
            let is_apart = one.right <= other.left
                || other.right <= one.left
                || one.bottom <= other.top
                || other.bottom <= one.top;
            assert!(is_apart, "{} and {} overlap: {svg}", one.text, other.text);
        }
    }
}

fn word() -> impl Strategy<Value = String> {
    "[a-zA-Z_0-9 @.-]{1,24}"
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn texts_of_sequences_do_not_overlap(
        steps in prop::collection::vec((0..7_usize, 0..7_usize, word(), 0..6_usize), 0..40),
        names in prop::collection::vec(word(), 7),
    ) {
        let step = |(at, (from, to, label, kind)): (usize, &(usize, usize, String, usize))| {
            let (from, to) = (names[*from].clone(), names[*to].clone());
            let time = format!("{at}.123 s");
            match kind {
                0 => Step::Note(Note { lane: from, text: label.clone(), time }),
                1 => Step::Arrow(Arrow {
                    from, to, label: label.clone(), time, violation: Some(label.repeat(20)), failed: None,
                }),
                _ => Step::Arrow(Arrow { from, to, label: format!("{kind}"), time, ..Arrow::default() }),
            }
        };
        let sequence = Sequence { lanes: Vec::new(), steps: steps.iter().enumerate().map(step).collect() };
        check_places(&sequence.svg(), sequence.canvas().width);
    }

    #[test]
    fn texts_of_timelines_do_not_overlap(
        rows in prop::collection::vec(
            (word(), prop::collection::vec((word(), 0.0..60.0_f64, prop::option::of(0.0..20.0_f64)), 0..25)), 0..6),
        marks in prop::collection::vec((0.0..80.0_f64, word()), 0..8),
    ) {
        let interval = |(label, from, time): (String, f64, Option<f64>)| {
            Interval { label, from, until: time.map(|time| from + time), color: Color::nth(0) }
        };
        let row = |(name, intervals): (String, Vec<_>)| {
            TimelineRow { name, intervals: intervals.into_iter().map(interval).collect() }
        };
        let timeline = Timeline {
            rows: rows.into_iter().map(row).collect(),
            marks: marks.into_iter().map(|(at, label)| Mark { at, label }).collect(),
            until: None,
        };
        check_places(&timeline.svg(), 800.0);
    }

    #[test]
    fn texts_of_plans_do_not_overlap(
        bodies in prop::collection::vec(
            (word(), 0.1..1.0_f64, prop::collection::vec((-9.0..9.0_f64, -9.0..9.0_f64), 1..9)), 0..20),
    ) {
        let body = |(name, radius, poses): (String, f64, Vec<(f64, f64)>)| Body {
            name,
            shape: Shape::Circle { radius },
            color: Color::nth(0),
            poses: poses.into_iter().map(|(x, y)| Pose { x, y, heading: 1.0 }).collect(),
        };
        let plane = Plane { bodies: bodies.into_iter().map(body).collect() };
        check_places(&plane.svg(), 800.0);
    }

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
