//! Protocols in the format of fipa_acl, with one state for all participants.

use super::*;

fn stage(text: &str) -> Stage {
    Stage::new(Monitor::observer(library_with("lift", text)))
}

/// A message of the protocol `lift`. The service `host-mts` reports that ben did not get a message.
fn lift(words: &'static str) -> Header<'static> {
    let header = say_in("lift", words);
    match words.contains(" host-mts>") {
        true => header.undelivered_to("ben"),
        false => header,
    }
}

const LIFT: &str = r#"<scxml initial="1">
    <state id="1"><transition performative="request" from="initiator" to="B" target="2"/></state>
    <state id="2">
        <transition performative="refuse" from="B" to="initiator" target="3"/>
        <transition performative="agree" from="B" to="initiator" target="4"/>
    </state>
    <state id="3" final="yes"/>
    <state id="4" final="yes">
        <transition performative="inform" from="B" to="initiator" target="4"/>
        <transition performative="failure" from="B" to="initiator" target="5"/>
    </state>
    <state id="5" final="yes"/></scxml>"#;

#[test]
fn a_conversation_has_one_state_for_all_participants() {
    let mut stage = stage(LIFT);
    stage.right(lift("request ann>ben,cid"));
    stage.right(lift("agree ben>ann"));
    assert_eq!(stage.wrong(lift("agree cid>ann")).kind, Kind::Unexpected);
    stage.right(lift("inform cid>ann"));
    assert_eq!(stage.wrong(lift("inform dan>ann")).kind, Kind::Stranger);
    assert_eq!(
        stage.wrong(lift("inform ben>dan")).kind,
        Kind::WrongReceiver
    );
    assert_eq!(stage.wrong(lift("inform ann>ben")).kind, Kind::WrongSender);
    stage.right(lift("inform ben>ann"));
    assert_eq!(stage.right(lift("failure ben>ann")), "5");
    assert_eq!(stage.wrong(lift("inform ben>ann")).kind, Kind::Ended);
}

#[test]
fn any_participant_may_cancel_and_fail() {
    for (words, state) in [
        ("not-understood ann>ben", "not-understood"),
        ("not-understood ben>ann", "not-understood"),
        ("cancel ann>ben", "cancelling"),
        ("cancel ben>ann", "cancelling"),
        ("failure ben>ann", "undelivered"),
        ("failure host-mts>ann", "undelivered"),
    ] {
        let mut stage = stage(LIFT);
        stage.right(lift("request ann>ben"));
        assert_eq!(stage.right(lift(words)), state, "{words}");
    }
    let mut stage = stage(LIFT);
    stage.right(lift("request ann>ben"));
    stage.right(lift("cancel ben>ann"));
    assert_eq!(stage.right(lift("inform ann>ben")), "cancelled");
}

/// Figure 6 of the paper about fipa_acl, with one difference: after a `failure` that answers a cancel,
/// the conversation continues, as in FIPA00026.
#[test]
fn every_protocol_has_the_common_states() {
    let after = |said: &[&'static str]| {
        let mut stage = stage(LIFT);
        stage.right(lift("request ann>ben"));
        let mut last = None;
        for words in said {
            match stage.check(&lift(words)) {
                Verdict::Accepted(accepted) => {
                    let state = accepted.state.to_owned();
                    last = Some((state, accepted.own, accepted.ended, accepted.over));
                }
                other => panic!("{said:?}, {words}: {other:?}"),
            }
        }
        (stage, last.unwrap())
    };
    for (said, state, own, over) in [
        (
            &["not-understood ben>ann"][..],
            "not-understood",
            false,
            true,
        ),
        (&["not-understood ann>ben"], "not-understood", false, true),
        (&["cancel ann>ben"], "cancelling", false, false),
        (
            &["cancel ann>ben", "inform ben>ann"],
            "cancelled",
            false,
            true,
        ),
        (&["cancel ann>ben", "failure ben>ann"], "2", true, false),
        (
            &["cancel ann>ben", "not-understood ben>ann"],
            "not-understood",
            false,
            true,
        ),
        (
            &["cancel ben>ann", "inform ann>ben"],
            "cancelled",
            false,
            true,
        ),
        (&["failure host-mts>ann"], "undelivered", false, true),
        (&["failure ben>ann"], "undelivered", false, true),
        // The transitions of the file take precedence.
        (&["agree ben>ann", "failure ben>ann"], "5", true, true),
    ] {
        let (mut stage, last) = after(said);
        assert_eq!(last, (state.to_owned(), own, over, over), "{said:?}");
        if said == ["not-understood ann>ben"] {
            // It was sent before the not-understood arrived.
            assert_eq!(stage.right(lift("agree ben>ann")), "not-understood");
            assert_eq!(stage.wrong(lift("agree ann>ben")).kind, Kind::Ended);
        } else if ["not-understood", "cancelled"].contains(&state) {
            assert_eq!(stage.wrong(lift("agree ben>ann")).kind, Kind::Ended);
        }
        // An undelivered message may be sent again, and a message before it may have arrived.
        if state == "undelivered" {
            assert_eq!(stage.wrong(lift("inform ben>ann")).kind, Kind::OutOfOrder);
            assert_eq!(stage.right(lift("agree ben>ann")), "4", "{said:?}");
        }
    }
    // None of these is allowed after the end.
    for words in [
        "cancel ben>ann",
        "failure ben>ann",
        "not-understood ben>ann",
    ] {
        let (mut stage, _) = after(&["refuse ben>ann"]);
        assert_eq!(stage.wrong(lift(words)).kind, Kind::Ended, "{words}");
    }
}

#[test]
fn roles_are_bound_at_their_first_use() {
    let mut stage = stage(
        r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="propagate" from="b" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="a|b" target="4"/></state>
        <state id="4" final="yes"><transition performative="my-.*" from=".*" to="a" target="4"/></state>
        </scxml>"#,
    );
    stage.right(lift("request ann>ben"));
    stage.right(lift("propagate ben>cid"));
    assert_eq!(stage.wrong(lift("inform dan>ann")).kind, Kind::Stranger);
    stage.wrong(lift("inform cid>dan"));
    stage.right(lift("inform cid>ann"));
    stage.right(lift("my-word zoe>ann"));
    stage.wrong(lift("your-word zoe>ann"));
    stage.wrong(lift("my-word ann>zoe"));
}

#[test]
fn subprotocols_begin_in_the_states_of_the_file() {
    let mut stage = stage(
        r#"<scxml initial="1">
        <state id="1"><transition performative="propagate" from="i" to="B" target="2"/></state>
        <state id="2" final="yes"><subprotocol name="fipa-.*" from="B"/></state></scxml>"#,
    );
    // An agent that is named twice has its role once.
    stage.right(lift("propagate ann>ben,ben"));
    stage.right(request("request ben>cid"));
    stage.right(request("agree cid>ben"));
    let query = stage.wrong(say_in("query", "query-if ben>cid"));
    assert_eq!(query.kind, Kind::WrongProtocol);
    stage.wrong(request("request ann>cid"));
    stage.wrong(lift("inform ben>ann"));
    stage.right(request("inform cid>ben"));
}
