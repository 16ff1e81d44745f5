//! SCXML files of users and their mistakes.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::time::Duration;

use fipa_monitor::scxml::{Doubt, MAX_FILE, Problem, ScxmlError, Warning};
use fipa_monitor::{After, Cancel, Machine, Scope};
use proptest::prelude::*;

/// A file in the format of fipa_acl, with blanks, comments and several spellings of yes.
const PLAIN: &str = "<scxml version=\"1.0\" initial=\"1\">

    <!-- lifting things -->
\t<state id=\"1\">
\t        <transition performative=\"request\" from=\"initiator\" to=\"B\" target=\"2\"/>
\t</state>
    <state id=\"2\" final=\"no\">
        <transition performative=\"refuse|failure\" from=\"B\" to=\"initiator\" target=\"3\" />
        <transition performative=\"inform\" from=\"B\" to=\"initiator\" target=\"4\"/>
    </state>
    <state id=\"3\" final=\"yes\">
        
    </state>
    <state id=\"4\" final=\"1\">
        <transition performative=\".*\" from=\"B\" to=\".*\" target=\"4\"/>
        <subprotocol name=\".*\" from=\"B\" proxied_to=\"initiator\"/> 
    </state>
</scxml>
";

fn mistakes(text: &str) -> Vec<(usize, Problem)> {
    let error = Machine::read("dir/own.scxml", text).unwrap_err();
    assert_eq!(error.file, "dir/own.scxml");
    let mistakes = error.mistakes.into_iter();
    mistakes
        .map(|mistake| (mistake.line, mistake.problem))
        .collect()
}

fn only(text: &str) -> (usize, Problem) {
    let mut all = mistakes(text);
    assert_eq!(all.len(), 1, "{all:?}");
    all.remove(0)
}

/// A file with this line 3 in its state "1", and with a final state "2" in line 5.
fn with(line: &str) -> String {
    format!(
        "<scxml initial=\"1\" xmlns:f=\"urn:fipa-rs:protocol\">\n<state id=\"1\">\n{line}\n\
         </state>\n<state id=\"2\" final=\"yes\"/>\n</scxml>"
    )
}

const GOOD: &str = r#"<transition performative="inform" from="a" to="b" target="2"/>"#;

#[test]
fn files_in_the_format_of_fipa_acl_are_read() {
    let machine = Machine::read("/robot/protocols/lift", PLAIN).unwrap();
    assert_eq!((machine.name(), machine.title()), ("lift", None));
    assert_eq!(machine.roles(), ["initiator", "B"]);
    assert_eq!(machine.initiator(), "initiator");
    assert_eq!(machine.scope(), Scope::Conversation);
    assert_eq!(machine.cancel(), Cancel::Anyone);
    let finals: Vec<bool> = machine
        .states()
        .iter()
        .map(|state| state.is_final())
        .collect();
    assert_eq!(finals, [false, false, true, true]);
    let refuse = &machine.states()[1].transitions()[0];
    assert_eq!(
        (refuse.performative(), refuse.from(), refuse.to()),
        ("refuse|failure", "B", "initiator")
    );
    assert_eq!(machine.target(refuse), "3");
    let sub = &machine.states()[3].subprotocols()[0];
    assert_eq!(
        (sub.name(), sub.from(), sub.proxied_to()),
        (".*", "B", Some("initiator"))
    );
    assert_eq!(machine.initial().id(), "1");
}

#[test]
fn attributes_of_the_namespace_are_read() {
    let text = r#"<?xml version="1.0"?>
<scxml initial="s" xmlns="http://www.w3.org/2005/07/scxml" xmlns:x="urn:fipa-rs:protocol"
  x:name="own-lift" x:aliases=" lift  heben " x:title="Lifting &amp; more" x:scope="participant" x:cancel="nobody">
  <state id="s"><transition performative="request" from="i" to="p" target="r"/></state>
  <state id="r">
    <transition performative="agree" from="p" to="i" target="a" x:optional="yes"/>
    <transition x:after="30s" target="f"/>
  </state>
  <state id="a"><transition performative="inform" from="p" to="i" target="f"/></state>
  <final id="f"/>
</scxml>"#;
    let machine = Machine::read("f.scxml", text).unwrap();
    assert_eq!(
        (machine.name(), machine.title()),
        ("own-lift", Some("Lifting & more"))
    );
    assert_eq!(machine.aliases(), ["lift", "heben"]);
    assert!(machine.is_called("HEBEN") && !machine.is_called("f"));
    assert_eq!(
        (machine.scope(), machine.cancel()),
        (Scope::Participant, Cancel::Nobody)
    );
    let state = &machine.states()[1];
    assert!(state.transitions()[0].is_optional());
    assert!(!machine.states()[0].transitions()[0].is_optional());
    let timeout = state.timeout().unwrap();
    assert_eq!(timeout.after(), After::Span(Duration::from_secs(30)));
    assert_eq!(machine.timeout_target(timeout), "f");
    assert!(machine.states()[3].is_final());
}

#[test]
fn mistakes_have_line_numbers() {
    for (line, expected) in [
        (
            r#"<transition performative="inform" from="a" to="b" target="3"/>"#,
            "there is no state \"3\"",
        ),
        (
            r#"<transition from="a" to="b" target="2"/>"#,
            "<transition> lacks the attribute \"performative\"",
        ),
        (
            r#"<transition performative="inform" to="b" target="2"/>"#,
            "lacks the attribute \"from\"",
        ),
        (
            r#"<transition performative="inform" from="a" target="2"/>"#,
            "lacks the attribute \"to\"",
        ),
        (
            r#"<transition performative="(" from="a" to="b" target="2"/>"#,
            "performative=\"(\" is not a regular expression: error: unclosed group",
        ),
        (
            r#"<transition performative="inform" from="a" to="b" target="2" f:optional="maybe"/>"#,
            "invalid value optional=\"maybe\"; expected yes",
        ),
        (
            r#"<transition f:after="tomorrow" target="2"/>"#,
            "invalid value after=\"tomorrow\"; expected reply-by",
        ),
        (
            r#"<transition f:after="25h" target="2"/>"#,
            "invalid value after=\"25h\"; expected reply-by",
        ),
        (
            r#"<subprotocol name=".*" from="c"/>"#,
            "role \"c\" is never bound",
        ),
        (
            r#"<transition performative="agree" from="c" to="a" target="2"/>"#,
            "the first message has several senders: c, a; only one role",
        ),
        (
            r#"<transition performative="inform|agree" from="a" to="b" target="1"/>"#,
            "\"inform\" from \"a\" to \"b\" leads to \"2\" and also to \"1\"",
        ),
    ] {
        let text = with(&format!("{line}{GOOD}"));
        let error = Machine::read("own.scxml", &text).unwrap_err();
        let first = error.to_string();
        let first = first.lines().next().unwrap();
        assert!(first.contains(expected), "{line}: {first}");
        let at = if expected.starts_with("the first") {
            2
        } else {
            3
        };
        assert!(first.starts_with(&format!("own.scxml:{at}: ")), "{first}");
    }
}

#[test]
fn errors_show_file_line_and_problem() {
    let again = GOOD
        .replace("inform", "inform|agree")
        .replace("\"2\"", "\"1\"");
    let ambiguous = format!("{GOOD}\n{again}");
    let far = format!("{GOOD}</state>\n<state id=\"far\" final=\"yes\">");
    for (text, expected) in [
        (
            with(&format!("{GOOD}\n{}", GOOD.replace("\"2\"", "\"done\""))),
            "a/own.scxml:4: there is no state \"done\"",
        ),
        (
            with(&far),
            "a/own.scxml:4: no transition leads to state \"far\"; remove it, or add a transition to it",
        ),
        (
            with(&ambiguous),
            "a/own.scxml:4: in state \"1\", \"inform\" from \"a\" to \"b\" leads to \"1\" and also to \"2\" \
             (line 3); keep one of them",
        ),
        (
            with(&format!(
                "{GOOD}\n<subprotocol name=\".*\" from=\"broker\"/>"
            )),
            "a/own.scxml:4: role \"broker\" is never bound: no message is sent to it, and it does \
             not begin; send it a message, or correct its name",
        ),
    ] {
        let error = Machine::read("a/own.scxml", &text).unwrap_err();
        assert_eq!(error.to_string(), expected);
    }
}

#[test]
fn missing_and_superfluous_items_are_mistakes() {
    assert_eq!(only("<scxml initial=\"1\"/>"), (1, Problem::NoState));
    assert_eq!(
        only("<statechart/>"),
        (1, Problem::NotScxml("statechart".into()))
    );
    let missing = |element, attribute| Problem::Missing { element, attribute };
    let text = with(GOOD).replace(" initial=\"1\"", "");
    assert_eq!(only(&text), (1, missing("scxml", "initial")));
    assert_eq!(
        only("<scxml initial=\"1\">\n<state/></scxml>"),
        (2, missing("state", "id"))
    );
    let text = with(GOOD).replace("<state id=\"2\" final=\"yes\"/>", "<state id=\"2\"/>");
    assert_eq!(only(&text), (5, Problem::DeadEnd("2".into())));
    let text = with(GOOD).replace("</scxml>", "<final id=\"far\"/></scxml>");
    assert_eq!(only(&text), (6, Problem::UnreachableState("far".into())));
    let text = with(GOOD).replace("</scxml>", "<final id=\"2\"/></scxml>");
    let problems = mistakes(&text);
    let twice = Problem::DuplicateState {
        id: "2".into(),
        first: 5,
    };
    assert!(problems.contains(&(6, twice)), "{problems:?}");
    let text = with(&GOOD.replace("to=", "f:later=\"1\" to="));
    assert!(matches!(only(&text), (3, Problem::UnknownAttribute { .. })));
    let text = with(&format!("<state id=\"3\"/>{GOOD}"));
    assert!(matches!(only(&text), (3, Problem::Misplaced { .. })));
    let never = format!(
        "{GOOD}</state><state id=\"3\">\n<transition performative=\"agree\" from=\"x\" to=\"a\" target=\"2\"/>"
    );
    let text = with(&never.replace("target=\"2\"/></state>", "target=\"3\"/></state>"));
    assert_eq!(only(&text), (4, Problem::UnboundRole("x".into())));
    let roles = with(GOOD).replace("initial", "f:scope=\"participant\" initial");
    let roles = roles.replace(
        "</state>",
        "<transition performative=\"agree\" from=\"a\" to=\"c\" target=\"2\"/></state>",
    );
    assert!(matches!(only(&roles), (1, Problem::RolesOfScope(3, _))));
    let circle =
        r#"<transition performative="inform" from="a" to="b" target="1" f:optional="yes"/>"#;
    let circle = with(&format!(
        "{circle}<transition performative=\"agree\" from=\"a\" to=\"b\" target=\"2\"/>"
    ));
    assert_eq!(only(&circle), (2, Problem::OptionalCircle("1".into())));
    let two = r#"<transition f:after="1s" target="2"/><transition f:after="2s" target="2"/>"#;
    assert_eq!(
        only(&with(&format!("{GOOD}{two}"))),
        (3, Problem::TwoTimeouts("1".into()))
    );
}

#[test]
fn a_message_of_a_role_to_itself_is_a_mistake() {
    let file = |from: &str, to: &str| {
        format!(
            "<scxml initial=\"1\">\n<state id=\"1\">{GOOD}</state>\n<state id=\"2\">\
             <transition performative=\"agree\" from=\"{from}\" to=\"{to}\" target=\"3\"/></state>\n\
             <state id=\"3\" final=\"yes\"/></scxml>"
        )
    };
    for (from, to) in [("a", "a"), ("b", "b"), ("b", "(b)")] {
        let (line, problem) = only(&file(from, to));
        assert_eq!((line, problem), (3, Problem::ToItself(from.to_owned())));
    }
    // Patterns for several roles are allowed.
    for (from, to) in [("a", "b"), (".*", ".*"), ("a", ".*"), ("a|b", "a|b")] {
        assert!(Machine::read("own", &file(from, to)).is_ok(), "{from} {to}");
    }
}

#[test]
fn warnings_stand_beside_mistakes() {
    let text = with(&GOOD.replace("inform", "infrom").replace("\"2\"", "\"3\""));
    let error = Machine::read_with_warnings("own", &text).unwrap_err();
    assert_eq!(error.mistakes.len(), 2, "{error}");
    let [Warning { line: 3, doubt }] = error.warnings.as_slice() else {
        panic!("{:?}", error.warnings);
    };
    assert!(
        matches!(doubt, Doubt::NearPerformative { performative, .. } if performative == "infrom")
    );
}

#[test]
fn unknown_elements_are_skipped_and_misplaced_elements_are_mistakes() {
    let others = "<datamodel/><onentry><log/><state id=\"no\"/></onentry>";
    let first = "<state id=\"1\">";
    for text in [
        with(GOOD).replace(first, &format!("{others}{first}")),
        with(&format!("{others}{GOOD}{others}")),
    ] {
        assert_eq!(Machine::read("own", &text).unwrap().states().len(), 2);
    }
    let sub = "<subprotocol name=\".*\" from=\"a\"/>";
    for (element, stray) in [("transition", GOOD), ("subprotocol", sub)] {
        let misplaced = Problem::Misplaced {
            element: element.into(),
            inside: "scxml".into(),
        };
        let text = with(GOOD).replace(first, &format!("{stray}{first}"));
        assert_eq!(only(&text), (2, misplaced));
    }
}

#[test]
fn an_element_of_several_lines_has_the_number_of_its_first() {
    let unknown = |id: &str| Problem::UnknownState {
        id: id.into(),
        nearest: None,
    };
    let bad = GOOD.replace("\"2\"", "\"9\"").replace(' ', "\n");
    // With and without lines in between, and behind a byte order mark.
    let lines = GOOD.matches(' ').count();
    for (between, second) in [("", 3 + lines), ("\n\n", 5 + lines)] {
        let text = with(&format!("{bad}{between}{bad}\n{GOOD}"));
        for text in [text.clone(), format!("\u{feff}{text}")] {
            let found = mistakes(&text);
            assert_eq!(found, [(3, unknown("9")), (second, unknown("9"))]);
        }
    }
}

#[test]
fn an_unknown_state_is_reported_with_a_similar_one() {
    let text = with(GOOD)
        .replace("id=\"2\"", "id=\"agreed\"")
        .replace("target=\"2\"", "target=\"agred\"");
    let nearest = Some("agreed".to_owned());
    let unknown = Problem::UnknownState {
        id: "agred".into(),
        nearest,
    };
    assert_eq!(mistakes(&text)[0], (3, unknown));
    let error = Machine::read("f", &text).unwrap_err().to_string();
    let first = "f:3: there is no state \"agred\"; did you mean \"agreed\"?\n";
    assert!(error.starts_with(first), "{error}");
}

#[test]
fn names_that_differ_in_one_character_or_in_case_are_similar() {
    for (known, written, near) in [
        ("agreed", "AGREED", true),
        ("agreed", "agreeds", true),
        ("agreed", "xagreed", true),
        ("agreed", "agreet", true),
        ("agreed", "bgreed", true),
        ("agreed", "agrxxd", false),
        ("agreed", "agreedss", false),
        ("agreed", "greeds", false),
        ("agreed", "agr", false),
        ("abc", "abd", true),
        ("abc", "abcd", true),
        ("ab", "ac", false),
        ("ab", "abc", false),
        ("größer", "grösser", false),
        ("größe", "größe1", true),
    ] {
        let text = with(GOOD)
            .replace("id=\"2\"", &format!("id=\"{known}\""))
            .replace("target=\"2\"", &format!("target=\"{written}\""));
        let nearest = match &mistakes(&text)[0].1 {
            Problem::UnknownState { nearest, .. } => nearest.clone(),
            other => panic!("{other:?}"),
        };
        assert_eq!(nearest, near.then(|| known.to_owned()), "{written}");
    }
}

#[test]
fn yes_and_no_are_written_in_several_ways() {
    let is_final = |word: &str| {
        let text = with(GOOD).replace("final=\"yes\"", &format!("final=\"{word}\""));
        // A state that is not final needs a transition.
        let text = text.replace("/>\n</scxml>", &format!(">{GOOD}</state>\n</scxml>"));
        let machine = Machine::read("f", &text).unwrap();
        machine.states()[1].is_final()
    };
    for word in ["yes", "true", "1"] {
        assert!(is_final(word), "{word}");
    }
    for word in ["no", "false", "0"] {
        assert!(!is_final(word), "{word}");
    }
}

#[test]
fn ambiguity_behind_an_optional_transition_is_a_mistake() {
    let text = with(&format!(
        "{}<transition performative=\"failure\" from=\"a\" to=\"b\" target=\"3\"/></state>\n<state id=\"3\">{GOOD}",
        r#"<transition performative="agree" from="a" to="b" target="3" f:optional="yes"/>"#
    ));
    assert!(Machine::read("f", &text).is_ok());
    let text = text.replace("performative=\"failure\"", "performative=\"inform\"");
    let (line, problem) = only(&text);
    let Problem::Ambiguous(both) = problem else {
        panic!("{problem:?}");
    };
    assert_eq!(
        (both.state.as_str(), both.performative.as_str()),
        ("1", "inform")
    );
    // The transition behind the optional one has the line of the state.
    assert_eq!((line, both.other_line), (2, 3));
}

#[test]
fn an_ambiguity_has_the_lines_of_both_transitions() {
    let step = |act: &str, target: &str| {
        format!(r#"<transition performative="{act}" from="a" to="b" target="{target}"/>"#)
    };
    let steps = [step("inform", "2"), step("agree", "1"), step("inform", "1")];
    let text = with(&steps.join("\n"));
    let (line, Problem::Ambiguous(both)) = only(&text) else {
        panic!("{text}");
    };
    assert_eq!((line, both.other_line), (5, 3));
    // A byte order mark is not part of the text.
    let (line, _) = only(&format!("\u{feff}{text}"));
    assert_eq!(line, 5);
}

#[test]
fn hostile_files_are_refused() {
    let is = |text: &str, words: &str| {
        let error = Machine::read("f", text).unwrap_err().to_string();
        assert!(error.contains(words), "{words}: {error}");
    };
    is(&" ".repeat(MAX_FILE + 1), "(maximum 1048576)");
    is("", "the file has no element");
    is("<!-- nothing else -->", "the file has no element");
    is(
        "<scxml initial='1'><state id='1'>",
        "the file ends inside an element",
    );
    is(
        "<!DOCTYPE scxml [<!ENTITY a \"aaaa\">]><scxml initial='&a;'/>",
        "document types are not supported",
    );
    is("<scxml initial='&bomb;'/>", "not well-formed XML");
    is("<scxml initial='1'></state></scxml>", "not well-formed XML");
    let deep = format!("<scxml initial='1'><a>{}", "<a>".repeat(100_000));
    is(&deep, "more than 32 levels");
    let states = "<state id='1'/>".repeat(1000);
    is(
        &format!("<scxml initial='1'>{states}</scxml>"),
        "more than 500 states",
    );
    let steps = "<transition target='1'/>".repeat(3000);
    is(
        &format!("<scxml initial='1'><state id='1'>{steps}</state></scxml>"),
        "more than 2000 transitions",
    );
    let long = "x".repeat(300);
    is(
        &format!("<scxml initial='{long}'/>"),
        "more than 256 bytes in an attribute",
    );
    let many: String = (0..100).map(|number| format!(" a{number}='1'")).collect();
    is(&format!("<scxml{many}/>"), "more than 64 attributes");
    let bomb = GOOD.replace("inform", r"(\w{1000}){1000}");
    is(&with(&bomb), "too large when compiled");
    let roles: String = (0..40)
        .map(|role| format!("<transition performative='p' from='a' to='r{role}' target='2'/>"))
        .collect();
    is(&with(&roles), "more than 32 roles");
}

/// Files at the limits are read, and files beyond them are refused.
#[test]
fn files_at_the_limits_are_read() {
    let allowed = |text: &str| drop(Machine::read("f", text).unwrap());
    let refused = |text: &str, words: &str| {
        let error = Machine::read("f", text).unwrap_err().to_string();
        assert!(error.contains(words), "{words}: {error}");
    };
    let step = |act: usize, to: &str, target: usize| {
        format!("<transition performative='p{act}' from='a' to='{to}' target='s{target}'/>")
    };
    // Each state has a transition to the next one.
    let chain = |states: usize, steps: usize, more: &str| {
        let inner = |at: usize| {
            let next = (at + 1).min(states - 1);
            (0..steps)
                .map(|act| step(act, "b", next))
                .collect::<String>()
        };
        let states = (0..states).map(|at| {
            let end = if at + 1 == states { more } else { "" };
            format!("<state id='s{at}'>{}{end}</state>", inner(at))
        });
        format!("<scxml initial='s0'>{}</scxml>", states.collect::<String>())
    };
    allowed(&chain(500, 1, ""));
    refused(&chain(501, 1, ""), "more than 500 states");
    allowed(&chain(500, 4, ""));
    let more = step(5, "b", 499);
    refused(&chain(500, 4, &more), "more than 2000 transitions");
    allowed(&chain(2, 100, ""));
    refused(&chain(2, 101, ""), "more than 100 transitions of a state");
    let roles = |roles: usize| {
        let steps: String = (1..roles)
            .map(|role| step(0, &format!("r{role}"), 1))
            .collect();
        format!("<scxml initial='s0'><state id='s0'>{steps}</state><final id='s1'/></scxml>")
    };
    allowed(&roles(32));
    refused(&roles(33), "more than 32 roles");
    let good = with(GOOD).replace(" xmlns:f=\"urn:fipa-rs:protocol\"", "");
    let and = |attributes: &str| good.replacen("<scxml", &format!("<scxml {attributes}"), 1);
    let name = |len: usize| format!("name='{}'", "x".repeat(len));
    allowed(&and(&name(256)));
    refused(&and(&name(257)), "more than 256 bytes in an attribute");
    // In addition to `initial`.
    let many = |count: usize| -> String { (0..count).map(|at| format!(" a{at}='1'")).collect() };
    allowed(&and(&many(63)));
    refused(&and(&many(64)), "more than 64 attributes");
    let deep = |levels: usize| {
        let inner = format!("{}{}</state>", "<x>".repeat(levels), "</x>".repeat(levels));
        good.replacen("</state>", &inner, 1)
    };
    allowed(&deep(32));
    refused(&deep(33), "more than 32 levels");
    let padded = |len: usize| format!("{good}{}", " ".repeat(len - good.len()));
    allowed(&padded(MAX_FILE));
    refused(&padded(MAX_FILE + 1), "(maximum 1048576)");
}

#[test]
fn spans_have_units() {
    let after = |span: &str| {
        let timeout = format!("{GOOD}<transition f:after=\"{span}\" target=\"2\"/>");
        let machine = Machine::read("f", &with(&timeout)).ok()?;
        match machine.initial().timeout()?.after() {
            After::Span(span) => Some(span),
            _ => None,
        }
    };
    for (span, ms) in [
        ("1ms", Some(1)),
        ("30s", Some(30_000)),
        ("2min", Some(120_000)),
        ("3h", Some(10_800_000)),
        ("24h", Some(86_400_000)),
        ("86400001ms", None),
        ("0s", None),
        ("3d", None),
        ("3", None),
        ("h", None),
        ("-1s", None),
        ("18446744073709551615h", None),
    ] {
        assert_eq!(after(span), ms.map(Duration::from_millis), "{span}");
    }
}

#[test]
fn overlapping_transitions_to_one_state_are_allowed() {
    let file = |one: [&str; 3], other: [&str; 3]| {
        let step = |[from, to, target]: [&str; 3]| {
            format!("<transition performative='inform' from='{from}' to='{to}' target='{target}'/>")
        };
        let first = "<transition performative='request' from='a' to='b|c' target='1'/>";
        let text = format!(
            "<scxml initial='0'><state id='0'>{first}</state><state id='1'>{}{}\
             <transition performative='agree' from='b' to='c' target='2'/>\
             <transition performative='agree' from='c' to='b' target='3'/></state>\
             <final id='2'/><final id='3'/></scxml>",
            step(one),
            step(other)
        );
        Machine::read("f", &text)
    };
    // The same target, other senders, and other receivers.
    assert!(file(["b", "a", "2"], ["b", "a", "2"]).is_ok());
    assert!(file(["b", "a", "2"], ["c", "a", "3"]).is_ok());
    assert!(file(["b", "a", "2"], ["b", "c", "3"]).is_ok());
    let error = file(["b", "a", "2"], ["b", "a|c", "3"]).unwrap_err();
    assert!(matches!(error.mistakes[0].problem, Problem::Ambiguous(_)));
}

#[test]
fn near_performatives_and_ignored_attributes_are_warnings() {
    let text = r#"<scxml version="1.0" initial="1" name="lift" xmlns:f="urn:fipa-rs:protocol">
        <state id="1" label="begin">
            <transition performative="reqest" from="a" to="b" target="2" optional="yes"/>
        </state>
        <state id="2">
            <transition performative="agree|refuze" from="b" to="a" target="3"/>
            <transition performative="my-act" from="b" to="a" target="3"/>
        </state>
        <state id="3" final="yes"/></scxml>"#;
    let (machine, warnings) = Machine::read_with_warnings("own", text).unwrap();
    assert_eq!(machine.name(), "own");
    let shown = |warning: &Warning| match &warning.doubt {
        Doubt::NearPerformative {
            performative,
            standard,
        } => (warning.line, format!("{performative} {standard}")),
        Doubt::Ignored {
            element, attribute, ..
        } => (warning.line, format!("{element} {attribute}")),
        other => panic!("{other}"),
    };
    let found: Vec<(usize, String)> = warnings.iter().map(shown).collect();
    let expected = [
        (1, "scxml name"),
        (2, "state label"),
        (3, "transition optional"),
        (3, "reqest request"),
        (6, "refuze refuse"),
    ];
    let expected = expected.map(|(line, text)| (line, text.to_owned()));
    assert_eq!(found, expected);
    let (_, none) = Machine::read_with_warnings("plain", PLAIN).unwrap();
    assert_eq!(none, []);
}

/// A reader with quadratic time would take very long for the largest allowed file.
#[test]
fn large_files_are_read_in_little_time() {
    use std::fmt::Write as _;
    let mut text = "<scxml initial=\"s0\">".to_owned();
    for state in 0..500 {
        write!(text, "<state id=\"s{state}\">").unwrap();
        for step in 0..4 {
            let target = (state + 1) % 500;
            write!(
                text,
                "<transition performative=\"p{state}x{step}.?\" from=\"a.?\" to=\"b\" target=\"s{target}\"/>"
            )
            .unwrap();
        }
        text.push_str("</state>");
    }
    text.push_str("</scxml>");
    let error: ScxmlError = Machine::read("f", &text).unwrap_err();
    // Only role b has a plain name, and it never begins.
    assert!(error.to_string().contains("never bound"), "{error}");
}

proptest! {
    #[test]
    fn any_text_is_a_machine_or_an_error(text in "[ -~\n]{0,200}") {
        let _ = Machine::read("f", &text);
    }

    #[test]
    fn a_damaged_file_is_a_machine_or_an_error(at in 0..PLAIN.len(), len in 0..40_usize, new in "[ -~]{0,6}") {
        let end = (at + len).min(PLAIN.len());
        let damaged = format!("{}{new}{}", &PLAIN[..at], &PLAIN[end..]);
        if let Err(error) = Machine::read("f", &damaged) {
            let lines = damaged.matches('\n').count() + 1;
            for mistake in &error.mistakes {
                prop_assert!((1..=lines).contains(&mistake.line), "{error}");
            }
        }
    }
}
