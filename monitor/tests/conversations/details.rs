//! Details: the expected messages of violations, and bounds that are met exactly.

use super::*;

fn stage_of(text: &str) -> Stage {
    Stage::new(Monitor::observer(library_with("own", text)))
}

fn own(words: &'static str) -> Header<'static> {
    say_in("own", words)
}

fn expected(violation: &Violation) -> Vec<String> {
    let all = violation.expected.iter();
    let shown = all.map(|one| format!("{} {}>{}", one.performative, one.from, one.to));
    shown.collect()
}

#[test]
fn expected_messages_are_those_of_the_concerned_participant() {
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben,cid"));
    stage.right(say("propose ben>ann"));
    // A message to each participant was not delivered, in different states.
    stage.right(say("failure ams>ben").undelivered_to("ann"));
    stage.right(say("refuse cid>ann"));
    stage.right(say("failure ams>cid").undelivered_to("ann"));
    let violation = stage.wrong(say("confirm ben>ann"));
    assert_eq!(violation.state.as_deref(), Some("undelivered"));
    assert_eq!(
        expected(&violation),
        ["accept-proposal, reject-proposal ann>ben"]
    );
    let violation = stage.wrong(say("confirm cid>ann"));
    assert_eq!(expected(&violation), Vec::<String>::new(), "it had refused");
}

#[test]
fn after_an_undelivered_message_those_after_it_are_expected() {
    let english = |text| say_in("fipa-auction-english", text);
    for mut stage in [
        Stage::observer(),
        Stage::new(Monitor::agent(library(), "ann")),
    ] {
        stage.right(english("inform ann>ben").reply_with("opening"));
        let call = |text| english("cfp ann>ben").reply_with(text);
        for text in ["1", "2", "3"] {
            stage.right(call(text));
        }
        let now = stage.now;
        stage.monitor.undelivered(&call("3"), "ben", now);
        let answers = [
            "propose ben>ann".to_owned(),
            "cfp, inform ann>ben".to_owned(),
        ];
        let violation = stage.wrong(english("confirm ben>ann"));
        assert_eq!(violation.state.as_deref(), Some("undelivered"));
        assert_eq!(expected(&violation), answers);
        // A bid for an earlier call does not show whether the last one arrived.
        let state = stage.right(english("propose ben>ann").in_reply_to("1"));
        assert_eq!(state, "undelivered");
        let violation = stage.wrong(english("confirm ben>ann"));
        assert_eq!(expected(&violation), answers);
    }
}

#[test]
fn the_answer_to_a_cancel_is_expected_during_the_cancel() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    stage.right(request("cancel ann>ben"));
    let violation = stage.wrong(request("propose ben>ann"));
    let [answer] = &violation.expected[..] else {
        panic!("{violation:?}");
    };
    assert_eq!(answer.performative, "inform, failure");
    // Only during a cancel.
    stage.right(request("inform ben>ann"));
    let violation = stage.wrong(request("agree ben>ann"));
    assert_eq!(expected(&violation), Vec::<String>::new());
}

#[test]
fn expected_messages_are_grouped_by_sender_and_receiver() {
    let mut stage = stage_of(
        r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2">
            <transition performative="agree" from="b" to="a" target="3"/>
            <transition performative="inform" from="b" to="c" target="3"/>
            <transition performative="refuse" from="b" to="a" target="3"/>
            <transition performative="propose" from="c" to="a" target="3"/>
            <transition performative="refuse" from="b" to="a" target="3"/>
            <transition performative="confirm" from="a|b" to="c" target="3"/>
        </state>
        <state id="3" final="yes"/></scxml>"#,
    );
    stage.right(own("request ann>ben"));
    let violation = stage.wrong(own("subscribe ben>ann"));
    assert_eq!(
        expected(&violation),
        [
            "agree, refuse ben>ann",
            "inform ben>c",
            "propose c>ann",
            "confirm a|b>c"
        ]
    );
}

#[test]
fn the_initiator_need_not_be_the_first_role_of_the_file() {
    let text = r#"<scxml initial="start" xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="participant">
        <state id="asked">
            <transition performative="inform" from="arm" to="rover" target="done"/>
            <transition performative="propose" from="arm" to="rover" target="proposed"/>
        </state>
        <state id="proposed">
            <transition performative="accept-proposal" from="rover" to="arm" target="done"/>
        </state>
        <state id="start">
            <transition performative="request" from="rover" to="arm" target="asked"/>
            <transition performative="query-ref" from="rover" to="arm" target="asked"/>
        </state>
        <state id="done" final="yes"/></scxml>"#;
    let mut stage = stage_of(text);
    stage.right(own("request ann>ben,cid"));
    assert_eq!(stage.wrong(own("inform ann>ben")).kind, Kind::WrongSender);
    stage.right(own("inform ben>ann"));
    assert_eq!(stage.right(own("inform cid>ann")), "done");
    let mut stage = Stage::new(Monitor::agent(library_with("own", text), "dan"));
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    assert_eq!(stage.check(&own("inform ben>dan")), elsewhere);
    assert_eq!(stage.check(&own("propose cid>dan")), elsewhere);
    assert_eq!(stage.right(own("accept-proposal dan>cid")), "done");
}

#[test]
fn a_failure_of_a_party_ends_only_protocols_in_the_format_of_fipa_acl() {
    let text = r#"<scxml initial="1" NAMESPACE>
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="b" to="a" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#;
    let plain = text.replace("NAMESPACE", "");
    let mut stage = stage_of(&plain);
    stage.right(own("request ann>ben"));
    assert_eq!(stage.right(own("failure ben>ann")), "undelivered");
    let ours = r#"xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="conversation""#;
    let mut stage = stage_of(&text.replace("NAMESPACE", ours));
    stage.right(own("request ann>ben"));
    assert_eq!(stage.wrong(own("failure ben>ann")).kind, Kind::Unexpected);
}

#[test]
fn the_limit_of_participants_is_exact() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="agree" from="b" to="a" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#;
    let mut limits = MonitorLimits::default();
    limits.participants = 2;
    let monitor = Monitor::observer(library_with("own", text)).with_limits(limits);
    assert!(monitor.library().find("own").is_some());
    let mut stage = Stage::new(monitor);
    stage.right(own("request ann>ben"));
    stage.right(own("agree ben>ann"));
    // Each agent counts once.
    let limited = |library| Stage::new(Monitor::observer(library).with_limits(limits));
    let mut stage = limited(library_with("own", text));
    stage.right(own("request ann>ben,cid"));
    assert_eq!(stage.right(own("agree cid>ann")), "3");
    let mut stage = limited(library_with("own", text));
    stage.right(own("request ann>ben,cid").reply_to(["1", "2", "3"]));
    let three = text.replace(
        r#"to="a" target="3"/>"#,
        r#"to="a" target="3"/>
        <transition performative="inform" from="a" to="c" target="2"/>"#,
    );
    let mut stage = limited(library_with("own", &three));
    stage.right(own("request ann>ben,cid"));
    assert_eq!(stage.wrong(own("inform ann>dan")).kind, Kind::TooMany);
    let mut stage = limited(library());
    let call = say("cfp ann>ben,cid").reply_to(["1", "2", "3"]);
    assert_eq!(stage.right(call), "called");
    stage.right(say("propose ben>ann,1"));
    assert_eq!(stage.wrong(say("cfp ann>dan")).kind, Kind::TooMany);
    // The receivers of the whole message count.
    let mut stage = limited(library_with("own", text));
    for (count, is_checked) in [(2, true), (3, false)] {
        let names = (0..count).map(|number| format!("{number}"));
        let copy = own("request ann>ben").receivers(names).copy_for("0");
        let verdict = stage.check(&copy.conversation_id("copies"));
        match is_checked {
            true => assert!(verdict.is_accepted(), "{verdict:?}"),
            false => assert_eq!(verdict, Verdict::Unchecked(Unchecked::TooLarge)),
        }
    }
}

#[test]
fn an_answer_that_crossed_an_undelivered_cancel_is_accepted() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    stage.right(request("agree ben>ann"));
    stage.right(request("cancel ann>ben"));
    // This may be the result or the answer to the cancel.
    assert_eq!(stage.right(request("inform ben>ann")), "cancelled");
    let lost = request("failure ams>ben").undelivered_to("ann");
    assert_eq!(stage.right(lost), "cancelling");
    // The result and the answer to the cancel.
    assert_eq!(stage.right(request("inform ben>ann")), "cancelled");
    assert_eq!(stage.right(request("inform ben>ann")), "cancelled");
    assert_eq!(stage.wrong(request("inform ben>ann")).kind, Kind::Ended);
}

#[test]
fn an_undelivered_cancel_that_a_message_crossed_is_taken_back() {
    let subscribe = |words| say_in("fipa-subscribe", words);
    for (lost, is_taken_back) in [("x", true), ("another", false)] {
        let mut stage = Stage::new(Monitor::agent(library(), "ann"));
        stage.right(subscribe("subscribe ann>ben").reply_with("s"));
        stage.right(subscribe("agree ben>ann").in_reply_to("s"));
        let cancel = |id| subscribe("cancel ann>ben").reply_with(id);
        stage.right(cancel("x"));
        stage.right(subscribe("inform ben>ann").in_reply_to("s"));
        let now = stage.now;
        stage.monitor.undelivered(&cancel(lost), "ben", now);
        match is_taken_back {
            true => assert_eq!(stage.right(cancel("y")), "cancelling"),
            false => drop(stage.wrong(cancel("y"))),
        }
    }
    // An answer shows that the cancel arrived.
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    let cancel = || subscribe("cancel ann>ben").reply_with("x");
    stage.right(subscribe("subscribe ann>ben"));
    stage.right(cancel());
    stage.right(subscribe("not-understood ben>ann").in_reply_to("x"));
    let now = stage.now;
    stage.monitor.undelivered(&cancel(), "ben", now);
    assert_eq!(stage.wrong(cancel()).kind, Kind::Ended);
    // Without `in-reply-to`, the message may have been the answer.
    for (answered, is_taken_back) in [(None, true), (Some("x"), false)] {
        let mut stage = Stage::new(Monitor::agent(library(), "ann"));
        stage.right(subscribe("subscribe ann>ben"));
        stage.right(subscribe("agree ben>ann"));
        let cancel = || subscribe("cancel ann>ben").reply_with("x");
        stage.right(cancel());
        let inform = subscribe("inform ben>ann");
        let inform = match answered {
            Some(text) => inform.in_reply_to(text),
            None => inform,
        };
        assert_eq!(stage.right(inform), "cancelled");
        let now = stage.now;
        stage.monitor.undelivered(&cancel(), "ben", now);
        match is_taken_back {
            true => assert_eq!(stage.right(cancel()), "cancelling"),
            false => assert_eq!(stage.wrong(cancel()).kind, Kind::Ended),
        }
    }
}

#[test]
fn valid_deadlines_are_kept_among_many_stale_ones() {
    let mut stage = Stage::observer();
    let due = Time::from_system_time(stage.now + Duration::from_secs(50)).unwrap();
    stage.right(say("cfp ann>ben").reply_by(due));
    // Stale deadlines, many more than there are conversations.
    for number in 0..3_000 {
        let id = format!("s{number}");
        let subscribe = say_in("fipa-contract-net", "cfp ann>ben").conversation_id(id.clone());
        stage.right(subscribe.reply_by(due));
        let refuse = say_in("fipa-contract-net", "refuse ben>ann").conversation_id(id);
        stage.right(refuse);
    }
    let overdue = stage.pass(51);
    let ids: Vec<&str> = overdue
        .iter()
        .filter_map(|event| match event {
            Event::Overdue {
                conversation_id, ..
            } => Some(conversation_id.as_str()),
            _ => None,
        })
        .collect();
    assert_eq!(ids, ["c"]);
}

#[test]
fn the_number_of_agents_in_reply_to_is_bounded() {
    let names = |from: usize, to| (from..=to).map(|number| format!("d{number}"));
    let mut stage = Stage::observer();
    let too_large = request("request ann>ben").reply_to(names(1, 65));
    assert_eq!(
        stage.check(&too_large),
        Verdict::Unchecked(Unchecked::TooLarge)
    );
    stage.right(request("request ann>ben").reply_to(names(1, 64)));
    stage.right(request("agree ben>d64"));
    // Several messages cannot name more either.
    let more = stage.wrong(request("inform ben>d64").reply_to(["one more"]));
    assert_eq!(more.kind, Kind::TooMany);
    stage.right(request("inform ben>d64").reply_to(["d1"]));
}

#[test]
fn a_cancel_to_an_agent_without_a_message_is_refused() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    for words in ["cancel ann>cid", "not-understood ann>cid"] {
        assert_eq!(
            stage.wrong(request(words)).kind,
            Kind::Unexpected,
            "{words}"
        );
    }
    assert_eq!(stage.right(request("cancel ann>ben")), "cancelling");
}

#[test]
fn in_reply_to_is_compared_with_the_other_side_only() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben").reply_with("q"));
    stage.right(request("agree ben>ann").in_reply_to("q").reply_with("a"));
    let inform = request("inform ben>ann").in_reply_to("q");
    let Verdict::Accepted(accepted) = stage.check(&inform) else {
        panic!("it answers the request");
    };
    assert!(accepted.over && !accepted.void);
}

#[test]
fn in_reply_to_is_not_compared_among_three_participants() {
    let mut stage = stage_of(
        r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="propagate" from="b" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="a" target="4"/></state>
        <state id="4" final="yes"/></scxml>"#,
    );
    stage.right(own("request ann>ben").reply_with("q"));
    stage.right(own("propagate ben>cid").reply_with("p"));
    assert_eq!(stage.right(own("inform cid>ann").in_reply_to("p")), "4");
}

#[test]
fn the_side_that_canceled_must_wait_for_the_answer() {
    let mut stage = Stage::observer();
    let ask = || request("request ann>ben").reply_with("q");
    stage.right(ask());
    stage.right(request("cancel ann>ben"));
    assert_eq!(stage.wrong(ask()).kind, Kind::Repeated);
    let other = stage.wrong(request("confirm ann>ben"));
    assert_eq!(other.kind, Kind::Unexpected);
}

#[test]
fn the_answer_of_a_multicast_member_adds_it_as_participant() {
    let mut stage = Stage::observer();
    let mut opens = |words| match stage.check(&say(words)) {
        Verdict::Accepted(accepted) => accepted.opened,
        other => panic!("{words}: {other:?}"),
    };
    assert!(opens("cfp ann>arm_.*"));
    assert!(opens("propose arm_1>ann"));
    assert!(opens("refuse arm_2>ann"));
    assert!(!opens("accept-proposal ann>arm_1"));
}

#[test]
fn a_message_at_its_deadline_is_not_late() {
    let mut stage = Stage::observer();
    let due = Time::from_system_time(stage.now + Duration::from_secs(5)).unwrap();
    stage.right(say("cfp ann>ben,cid").reply_by(due));
    stage.now += Duration::from_secs(5);
    let Verdict::Accepted(accepted) = stage.check(&say("propose ben>ann")) else {
        panic!("it is in time");
    };
    assert_eq!((accepted.state, accepted.late), ("proposed", false));
    stage.now += Duration::from_millis(1);
    let Verdict::Accepted(accepted) = stage.check(&say("propose cid>ann")) else {
        panic!("it is told to be late");
    };
    assert_eq!((accepted.state, accepted.late), ("late", true));
}

#[test]
fn the_initiator_may_begin_embedded_protocols() {
    let mut stage = stage_of(
        r#"<scxml initial="start" xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="participant">
        <state id="asked">
            <transition performative="inform" from="arm" to="rover" target="done"/>
            <subprotocol name="fipa-.*" from="rover"/>
        </state>
        <state id="start">
            <transition performative="subscribe" from="rover" to="arm" target="asked"/>
        </state>
        <state id="done" final="yes"/></scxml>"#,
    );
    stage.right(own("subscribe ann>ben"));
    assert_eq!(stage.right(request("request ann>cid")), "requested");
    assert_eq!(stage.right(request("inform cid>ann")), "done");
    // The other role cannot: this is another conversation with the same identifier.
    let separate = request("request ben>dan");
    assert_eq!(stage.right(separate), "requested");
    assert_eq!(stage.monitor.len(), 3);
}

#[test]
fn not_understood_during_a_cancel_ends_the_conversation() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben").reply_with("q"));
    stage.right(request("cancel ann>ben").reply_with("x"));
    let crossing = request("not-understood ben>ann").in_reply_to("q");
    assert_eq!(stage.right(crossing), "not-understood");
    let result = request("inform ben>ann").in_reply_to("q");
    assert_eq!(stage.wrong(result).kind, Kind::Ended);
}

/// The messages in the order in which each agent, and a monitor of all, sends or receives them: the messages of
/// `first` cross those of `second`, which the other agent sends.
fn crossing(
    opening: &[Header<'static>],
    (ann, ben): (&[Header<'static>], &[Header<'static>]),
    mut check: impl FnMut(Stage),
) {
    for (name, is_ann_first) in [
        (None, true),
        (None, false),
        (Some("ann"), true),
        (Some("ben"), false),
    ] {
        let mut stage = Stage::new(match name {
            None => Monitor::observer(library()),
            Some(name) => Monitor::agent(library(), name),
        });
        let (first, second) = match is_ann_first {
            true => (ann, ben),
            false => (ben, ann),
        };
        for message in opening.iter().chain(first).chain(second) {
            stage.right(message.clone());
        }
        check(stage);
    }
}

#[test]
fn a_cancel_that_crosses_a_not_understood_is_answered() {
    for act in ["failure", "inform", "not-understood"] {
        for told_apart in [true, false] {
            let opening = [request("request ann>ben").reply_with("q")];
            let cancel = [request("cancel ann>ben").reply_with("x")];
            let not_understood = [request("not-understood ben>ann").in_reply_to("q")];
            crossing(&opening, (&cancel, &not_understood), |mut stage| {
                let answer = say_in("fipa-request", act_of_ben(act));
                let answer = match told_apart {
                    true => answer.in_reply_to("x"),
                    false => answer,
                };
                assert_eq!(stage.right(answer), "not-understood");
                let result = request("inform ben>ann").in_reply_to("x");
                assert_eq!(stage.wrong(result).kind, Kind::Ended);
            });
        }
    }
}

fn act_of_ben(act: &str) -> &'static str {
    match act {
        "failure" => "failure ben>ann",
        "inform" => "inform ben>ann",
        _ => "not-understood ben>ann",
    }
}

#[test]
fn the_side_that_canceled_may_not_understand_a_message_that_crossed_the_cancel() {
    let opening = [say("cfp ann>ben").reply_with("q")];
    let cancel = say("cancel ann>ben").reply_with("x");
    let propose = say("propose ben>ann").in_reply_to("q").reply_with("p");
    let not_understood = || say("not-understood ann>ben").in_reply_to("p");
    for act in ["failure", "inform", "not-understood"] {
        let answer = || say(act_of_ben(act)).in_reply_to("x");
        crossing(
            &opening,
            (
                std::slice::from_ref(&cancel),
                std::slice::from_ref(&propose),
            ),
            |mut stage| {
                // The participant answers the cancel after the not-understood.
                assert_eq!(stage.right(not_understood()), "not-understood");
                assert_eq!(stage.right(answer()), "not-understood");
            },
        );
        // The participant has answered the cancel before. The initiator has not received the answer.
        let answered = [propose.clone(), cancel.clone(), answer()];
        let all = Stage::observer();
        let ben = Stage::new(Monitor::agent(library(), "ben"));
        for mut stage in [all, ben] {
            stage.right(opening[0].clone());
            for message in &answered {
                stage.right(message.clone());
            }
            let state = stage.right(not_understood());
            let expected = match act {
                "inform" => "cancelled",
                _ => "not-understood",
            };
            assert_eq!(state, expected, "{act}");
        }
    }
}

#[test]
fn a_participant_that_canceled_may_not_understand_a_message_that_crossed_the_cancel() {
    let text = r#"<scxml initial="1" xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="participant" fipa:cancel="anyone">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="query-if" from="a" to="b" target="3"/></state>
        <state id="3"><transition performative="agree" from="b" to="a" target="4"/></state>
        <state id="4" final="yes"/></scxml>"#;
    for act in ["failure", "inform", "not-understood"] {
        for name in [None, Some("ann"), Some("ben")] {
            let library = library_with("own", text);
            let mut stage = Stage::new(match name {
                None => Monitor::observer(library),
                Some(name) => Monitor::agent(library, name),
            });
            stage.right(own("request ann>ben").reply_with("q"));
            let cancel = own("cancel ben>ann").reply_with("x");
            let query = own("query-if ann>ben").reply_with("r");
            let both = match name {
                Some("ann") => [query, cancel],
                _ => [cancel, query],
            };
            for message in both {
                stage.right(message);
            }
            let not_understood = own("not-understood ben>ann").in_reply_to("r");
            assert_eq!(stage.right(not_understood), "not-understood");
            let answer = match act {
                "failure" => "failure ann>ben",
                "inform" => "inform ann>ben",
                _ => "not-understood ann>ben",
            };
            assert_eq!(stage.right(own(answer).in_reply_to("x")), "not-understood");
        }
    }
}

#[test]
fn a_repeated_acceptance_is_a_violation() {
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben"));
    stage.right(say("propose ben>ann"));
    let accept = || say("accept-proposal ann>ben").reply_with("a");
    stage.right(accept());
    assert_eq!(stage.wrong(accept()).kind, Kind::Repeated);
}

const ONE_STATE: &str = r#"<scxml initial="1">
    <state id="2"><transition performative="agree" from="b" to="a" target="3"/></state>
    <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
    <state id="3" final="yes"/></scxml>"#;

#[test]
fn a_receiver_that_is_named_twice_is_accepted() {
    let mut stage = stage_of(ONE_STATE);
    stage.right(own("request ann>ben,ben"));
    assert_eq!(stage.right(own("agree ben>ann")), "3");
}

#[test]
fn the_initiator_may_name_itself_and_others_in_reply_to() {
    let mut stage = stage_of(ONE_STATE);
    stage.right(own("request ann>ben").reply_to(["ann", "dan"]));
    assert_eq!(stage.right(own("agree ben>ann,dan")), "3");
    let mut limits = MonitorLimits::default();
    limits.participants = 4;
    let monitor = Monitor::observer(library_with("own", ONE_STATE)).with_limits(limits);
    let mut stage = Stage::new(monitor);
    stage.right(own("request ann>ben").reply_to(["dan", "eve"]));
    assert_eq!(stage.right(own("agree ben>ann,dan,eve")), "3");
}

#[test]
fn many_agents_in_reply_to_have_the_role_of_the_initiator() {
    let names = || (0..20).map(|number| format!("d{number}"));
    let mut stage = stage_of(ONE_STATE);
    stage.right(own("request ann>ben").reply_to(names()));
    let other = own("agree ben>ann").receivers(names().chain(["zoe".to_owned()]));
    assert_eq!(stage.wrong(other).kind, Kind::WrongReceiver);
    assert_eq!(stage.right(own("agree ben>ann").receivers(names())), "3");
}

#[test]
fn many_participants_have_independent_states() {
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>1,2,3,4,5,6,7,8,9,10"));
    stage.right(say("refuse 9>ann"));
    assert_eq!(stage.wrong(say("propose 9>ann")).kind, Kind::Ended);
    assert_eq!(stage.right(say("propose 10>ann")), "proposed");
    assert_eq!(stage.right(say("propose 1>ann")), "proposed");
    assert!(!stage.monitor.is_empty());
}

#[test]
fn texts_of_the_maximum_length_are_accepted() {
    let mut stage = Stage::observer();
    let with = |length| request("request ann>ben").conversation_id("x".repeat(length));
    stage.right(with(4_096));
    let too_large = Verdict::Unchecked(Unchecked::TooLarge);
    assert_eq!(stage.check(&with(4_097)), too_large);
}

#[test]
fn the_end_of_an_embedded_conversation_does_not_end_the_outer_one() {
    let mut stage = Stage::observer();
    let broker = |words| say_in("fipa-brokering", words);
    stage.right(broker("proxy ann>bro"));
    stage.right(broker("agree bro>ann"));
    stage.right(request("request bro>ben"));
    stage.right(request("inform ben>bro"));
    // A conversation is removed one minute after its end, or a day after its last message.
    assert_eq!(stage.pass(120), []);
    stage.right(broker("inform bro>ann"));
}

#[test]
fn a_conversation_that_a_timeout_ended_is_kept_as_long_as_any_ended_one() {
    let mut stage = stage_of(
        r#"<scxml initial="1" xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="participant">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2">
            <transition performative="agree" from="b" to="a" target="3"/>
            <transition fipa:after="30s" target="3"/>
        </state>
        <state id="3" final="yes"/></scxml>"#,
    );
    stage.right(own("request ann>ben"));
    assert!(matches!(&stage.pass(31)[..], [Event::Overdue { .. }]));
    assert_eq!(stage.pass(61), []);
    assert!(stage.monitor.is_empty());
}

#[test]
fn the_cancel_protocol_runs_within_the_conversation_that_it_cancels() {
    let cancel = |words| say_in("fipa-cancel", words);
    for mut stage in [
        Stage::observer(),
        Stage::new(Monitor::agent(library(), "ann")),
        Stage::new(Monitor::agent(library(), "ben")),
    ] {
        stage.right(request("request ann>ben"));
        stage.right(request("agree ben>ann"));
        stage.wrong(cancel("cancel ben>ann"));
        assert_eq!(stage.right(cancel("cancel ann>ben")), "cancelling");
        assert_eq!(stage.right(cancel("failure ben>ann")), "agreed");
        assert_eq!(stage.right(cancel("cancel ann>ben")), "cancelling");
        assert_eq!(stage.right(cancel("inform ben>ann")), "cancelled");
        assert_eq!(stage.monitor.len(), 1, "it is the same conversation");
        // It is also a protocol of its own, in a conversation of its own.
        let own = |words| cancel(words).conversation_id("d");
        assert_eq!(stage.right(own("cancel ann>ben")), "cancelling");
        assert_eq!(stage.right(own("inform ben>ann")), "cancelled");
    }
    // A protocol that cannot be canceled.
    let mut stage = Stage::observer();
    stage.right(say_in("fipa-auction-english", "inform ann>ben"));
    stage.wrong(cancel("cancel ann>ben"));
}

#[test]
fn a_participant_may_join_a_finished_conversation_of_its_initiator() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    stage.right(request("inform ben>ann"));
    // The initiator asks another agent.
    let Verdict::Accepted(accepted) = stage.check(&request("request ann>cid")) else {
        panic!("it is accepted");
    };
    assert!(accepted.opened && !accepted.complete);
    stage.right(request("agree cid>ann"));
    assert_eq!(stage.right(request("inform cid>ann")), "done");
    assert_eq!(stage.wrong(request("inform ben>ann")).kind, Kind::Ended);
    assert_eq!(stage.wrong(request("request ann>ben")).kind, Kind::Ended);
    assert_eq!(stage.monitor.len(), 1);
    // Another agent that uses the identifier begins another conversation.
    stage.right(request("request dan>ben"));
    assert_eq!(stage.right(request("agree ben>dan")), "agreed");
    assert_eq!(stage.monitor.len(), 2);
}

#[test]
fn a_monitor_of_one_conversation_refuses_protocols_that_cannot_run_within_it() {
    let proxy = |words| say_in("fipa-brokering", words);
    let query = || say_in("fipa-query", "query-ref ben>cid");
    let agent = || Monitor::agent(library(), "ben");
    let mut stage = Stage::new(agent().with_one_conversation());
    stage.right(proxy("proxy ann>ben"));
    assert_eq!(stage.wrong(query()).kind, Kind::WrongProtocol);
    stage.right(proxy("agree ben>ann"));
    stage.right(query());
    // By default, the agent begins another conversation with the same identifier.
    let mut stage = Stage::new(agent());
    stage.right(proxy("proxy ann>ben"));
    stage.right(query());
    assert_eq!(stage.monitor.len(), 2);
}

#[test]
fn a_message_with_another_in_reply_to_than_the_cancel_may_have_crossed_it() {
    let news = |words| say_in("fipa-subscribe", words);
    let mut stage = Stage::observer();
    stage.right(news("subscribe ann>ben").reply_with("s"));
    stage.right(news("agree ben>ann"));
    stage.right(news("cancel ann>ben").reply_with("x"));
    assert_eq!(stage.right(news("inform ben>ann")), "cancelled");
    let crossed = news("inform ben>ann").in_reply_to("s");
    assert_eq!(stage.right(crossed), "cancelled");
    let answer = news("inform ben>ann").in_reply_to("x");
    assert_eq!(stage.right(answer), "cancelled");
}

#[test]
fn a_cancel_has_one_answer_that_is_told_apart() {
    let news = |words| say_in("fipa-subscribe", words);
    let mut stage = Stage::observer();
    stage.right(news("subscribe ann>ben"));
    stage.right(news("agree ben>ann"));
    stage.right(news("cancel ann>ben").reply_with("x"));
    assert_eq!(stage.right(news("inform ben>ann")), "cancelled");
    let failed = news("failure ben>ann").in_reply_to("x");
    let going_on = stage.right(failed);
    // The next message is one of the subscription.
    let next = news("inform ben>ann").in_reply_to("x");
    assert_eq!(stage.right(next), going_on);
}

#[test]
fn the_answer_to_a_cancel_is_no_step_of_the_protocol() {
    let text = r#"<scxml initial="1" xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="participant">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform|failure" from="b" to="a" target="2"/>
            <transition performative="agree" from="a" to="b" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#;
    for (crossing, answer, state) in [
        ("failure ben>ann", "inform ben>ann", "cancelled"),
        ("failure ben>ann", "failure ben>ann", "2"),
        (
            "failure ben>ann",
            "not-understood ben>ann",
            "not-understood",
        ),
        ("inform ben>ann", "failure ben>ann", "2"),
    ] {
        let library = library_with("own", text);
        for monitor in [
            Monitor::observer(Arc::clone(&library)),
            Monitor::agent(Arc::clone(&library), "ann"),
        ] {
            let mut stage = Stage::new(monitor);
            stage.right(own("request ann>ben").reply_with("q"));
            stage.right(own("inform ben>ann").reply_with("r"));
            stage.right(own("cancel ann>ben").reply_with("x"));
            // This may be the answer to the cancel. The next message shows that it is not.
            stage.right(own(crossing));
            let answer = own(answer).in_reply_to("x").reply_with("z");
            assert_eq!(stage.right(answer), state);
            if state == "2" {
                assert_eq!(stage.right(own("agree ann>ben").in_reply_to("r")), "3");
            }
        }
    }
}

#[test]
fn a_message_to_several_names_of_one_party_is_one_step() {
    let text = r#"<scxml initial="1" xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="participant">
        <state id="1"><transition performative="cfp" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="propose" from="b" to="a" target="3"/>
            <transition performative="reject-proposal" from="a" to="b" target="4"/></state>
        <state id="3"><transition performative="inform" from="b" to="a" target="3"/>
            <transition performative="reject-proposal" from="a" to="b" target="4"/></state>
        <state id="4" final="yes"/></scxml>"#;
    // The last message crosses the rejection, so it fits the state before it.
    let mut stage = stage_of(text);
    stage.right(own("cfp ann>arm_.*,leg_.*"));
    stage.right(own("reject-proposal ann>arm_.*,leg_.*"));
    assert_eq!(stage.right(own("propose arm_1>ann")), "4");
    let mut stage = stage_of(text);
    stage.right(own("cfp ann>ben"));
    stage.right(own("propose ben>ann").reply_to(["dan"]));
    stage.right(own("reject-proposal ann>ben,dan"));
    assert_eq!(stage.right(own("inform ben>ann")), "4");
}

#[test]
fn the_only_role_of_a_protocol_is_that_of_an_agent_in_reply_to() {
    let mut stage = stage_of(
        r#"<scxml initial="1">
        <state id="1"><transition performative="inform" from=".*" to=".*" target="2"/></state>
        <state id="2"><transition performative="confirm" from=".*" to="b" target="2"/>
            <transition performative="disconfirm" from="b" to=".*" target="2"/></state>
        </scxml>"#,
    );
    stage.right(own("inform ann>ben").reply_to(["dan"]));
    assert_eq!(stage.wrong(own("agree ann>dan")).kind, Kind::Unexpected);
    stage.right(own("disconfirm dan>ann").conversation_id("c"));
    for _ in 0..2 {
        stage.right(own("confirm ann>dan"));
    }
    assert_eq!(stage.wrong(own("confirm ann>ben")).kind, Kind::Stranger);
}

#[test]
fn of_conversations_with_one_identifier_the_one_with_the_protocol_is_meant() {
    let broker = |words| say_in("fipa-brokering", words);
    let mut stage = stage_of(ONE_STATE);
    stage.right(broker("proxy ann>ben"));
    stage.right(broker("agree ben>ann"));
    stage.right(say_in("fipa-query", "query-if ben>dan"));
    stage.right(request("request ben>cid"));
    // A later conversation has the same agents, and another protocol.
    stage.right(own("request eve>ben,cid"));
    assert_eq!(stage.monitor.len(), 4);
    assert_eq!(stage.right(request("agree cid>ben")), "agreed");
    assert_eq!(stage.right(own("agree cid>eve")), "3");
}

#[test]
fn the_cancel_protocol_is_a_subprotocol_where_the_file_says_so() {
    let cancel = |words| say_in("fipa-cancel", words);
    // Another protocol within the conversation does not matter.
    let mut stage = Stage::observer();
    let broker = |words| say_in("fipa-brokering", words);
    stage.right(broker("proxy ann>bro"));
    stage.right(broker("agree bro>ann"));
    stage.right(request("request bro>ben"));
    assert_eq!(stage.right(cancel("cancel ann>bro")), "cancelling");
    assert_eq!(stage.monitor.len(), 2);
    let mut stage = stage_of(
        r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><subprotocol name="fipa-cancel" from="a"/>
            <transition performative="agree" from="b" to="a" target="3"/></state>
        <state id="3"><transition performative="inform" from="b" to="a" target="4"/></state>
        <state id="4" final="yes"/></scxml>"#,
    );
    stage.right(own("request ann>ben"));
    stage.right(cancel("cancel ann>ben"));
    assert_eq!(stage.monitor.len(), 2);
    // It goes on where it cannot begin.
    assert_eq!(stage.right(own("agree ben>ann")), "3");
    assert_eq!(stage.right(cancel("inform ben>ann")), "cancelled");
    assert_eq!(stage.right(own("inform ben>ann")), "4");
}

#[test]
fn an_agent_may_name_others_with_its_first_message_in_a_role() {
    let mut stage = stage_of(
        r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="c" to="a" target="3"/></state>
        <state id="3"><transition performative="agree" from="c" to="a" target="4"/></state>
        <state id="4"><transition performative="confirm" from="a" to="c" target="4"/></state>
        </scxml>"#,
    );
    stage.right(own("request ann>ben"));
    stage.right(own("inform cid>ann").reply_to(["dan"]));
    stage.wrong(own("agree ben>ann"));
    assert_eq!(stage.right(own("agree dan>ann")), "4");
}
