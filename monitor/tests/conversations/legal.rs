//! Legal conversations: coalitions, long conversations, restarts, undelivered and crossing messages, and
//! delegates. No message is refused.

use super::*;

fn subscribe(words: &'static str) -> Header<'static> {
    say_in("fipa-subscribe", words)
}

const UNKNOWN: Verdict<'static> = Verdict::Unchecked(Unchecked::UnknownHistory);

#[test]
fn a_coalition_is_resolved_as_of_the_sending() {
    // The initiator.
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(say("cfp ann>platoon").group("platoon", ["ann", "ben", "cid"]));
    stage.right(say("propose ben>ann"));
    stage.right(say("propose cid>ann"));
    stage.right(say("accept-proposal ann>ben"));
    stage.right(say("reject-proposal ann>cid"));
    assert_eq!(stage.right(say("inform ben>ann")), "done");
    // An agent that was not asked.
    assert_eq!(stage.wrong(say("propose dan>ann")).kind, Kind::Stranger);
    // A member. Its letter names the coalition.
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    stage.right(say("cfp ann>platoon"));
    assert_eq!(stage.right(say("propose ben>ann")), "proposed");
    assert_eq!(stage.right(say("accept-proposal ann>platoon")), "accepted");
    assert_eq!(stage.right(say("inform ben>ann")), "done");
    // A coalition with a leader has one receiver.
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(request("request ann>platoon").group("platoon", ["cid"]));
    assert_eq!(stage.right(request("inform cid>ann")), "done");
    // A pattern that is resolved.
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(say("cfp ann>arm_.*").group("arm_.*", ["arm_1", "arm_2"]));
    stage.right(say("refuse arm_1>ann"));
    stage.right(say("refuse arm_2>ann"));
    assert_eq!(stage.wrong(say("refuse arm_3>ann")).kind, Kind::Stranger);
    // A group without another member.
    let alone = say("cfp ann>platoon").group("platoon", ["ann"]);
    let alone = alone.conversation_id("alone");
    let alone_unchecked = Verdict::Unchecked(Unchecked::NoReceiver);
    assert_eq!(stage.check(&alone), alone_unchecked);
}

#[test]
fn the_result_of_a_long_action_is_accepted() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    stage.right(request("agree ben>ann"));
    assert_eq!(stage.pass(90 * 60), []);
    assert_eq!(stage.right(request("inform ben>ann")), "done");
}

#[test]
fn the_age_of_a_conversation_does_not_depend_on_the_wall_clock() {
    let mut monitor = Monitor::observer(library());
    let wall = SystemTime::UNIX_EPOCH + START;
    let day = Duration::from_secs(24 * 60 * 60);
    let at = |wall, secs| Moment::new(wall, Duration::from_secs(secs));
    let begin = request("request ann>ben");
    assert!(monitor.check(&begin, at(wall, 100)).is_accepted());
    // The wall clock is set 30 days ahead.
    assert_eq!(monitor.handle_timeout(at(wall + 30 * day, 101)), []);
    let agree = request("agree ben>ann");
    assert!(
        monitor
            .check(&agree, at(wall + 30 * day, 102))
            .is_accepted()
    );
    assert_eq!(
        monitor.poll_elapsed(),
        Some(day + Duration::from_millis(102_001))
    );
    let due = monitor.poll_timeout();
    assert_eq!(due, Some(wall + 31 * day + Duration::from_millis(1)));
    assert_eq!(monitor.handle_timeout(at(wall, 86_600)).len(), 1);
    // A `reply-by` is a time of the wall clock.
    let due = Time::from_system_time(wall + Duration::from_secs(5)).unwrap();
    let call = say("cfp ann>ben").reply_by(due);
    assert!(monitor.check(&call, at(wall, 86_600)).is_accepted());
    assert_eq!(monitor.handle_timeout(at(wall, 86_604)), []);
    assert_eq!(monitor.handle_timeout(at(wall, 86_606)).len(), 1);
}

#[test]
fn unknown_history_is_unchecked() {
    for name in ["ann", "ben"] {
        let monitor = Monitor::agent(library(), name).with_history(History::Unknown);
        let mut stage = Stage::new(monitor);
        for words in ["agree ben>ann", "cancel ann>ben", "inform ben>ann"] {
            let header = request(words);
            assert!(
                stage.check(&header).violation().is_none(),
                "{name}: {words}"
            );
        }
        let contract = [
            "propose ben>ann",
            "accept-proposal ann>ben",
            "inform ben>ann",
        ];
        for words in contract {
            let header = say(words).conversation_id("d");
            assert!(
                stage.check(&header).violation().is_none(),
                "{name}: {words}"
            );
        }
        // A conversation that certainly begins is checked.
        stage.right(request("request ann>ben").conversation_id("e"));
        let wrong = stage.wrong(request("inform ann>ben").conversation_id("e"));
        assert_eq!(wrong.kind, Kind::WrongSender);
    }
    let mut stage = Stage::new(Monitor::observer(library()).with_history(History::Unknown));
    assert_eq!(stage.check(&request("agree ben>ann")), UNKNOWN);
    // Without this setting, an agent that sends first knows that the conversation did not begin.
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    assert_eq!(stage.wrong(request("agree ben>ann")).kind, Kind::NotOpened);
}

#[test]
fn a_first_message_may_be_a_later_one_of_an_unknown_conversation() {
    let auction = |words| say_in("fipa-auction-english", words);
    let stage = || {
        let monitor = Monitor::agent(library(), "ben").with_history(History::Unknown);
        Stage::new(monitor)
    };
    // The end of an auction that began before the restart, not its announcement.
    let mut ended = stage();
    ended.right(auction("inform auc>ben"));
    assert_eq!(ended.check(&auction("request auc>ben")), UNKNOWN);
    assert!(ended.monitor.is_empty());
    // A call shows that it was the announcement.
    let mut begun = stage();
    begun.right(auction("inform auc>ben"));
    begun.right(auction("cfp auc>ben"));
    let wrong = begun.wrong(auction("request auc>ben"));
    assert_eq!(wrong.kind, Kind::OutOfOrder);
}

#[test]
fn an_evicted_conversation_is_unchecked() {
    let mut limits = MonitorLimits::default();
    limits.conversations = 4;
    let monitor = Monitor::agent(library(), "ben").with_limits(limits);
    let mut stage = Stage::new(monitor);
    for number in 0..8 {
        stage.right(request("request ben>ann").conversation_id(format!("{number}")));
    }
    let late = |id: &'static str| request("agree ann>ben").conversation_id(id);
    assert!(stage.check(&late("0")).violation().is_none());
    assert!(stage.check(&late("7")).is_accepted());
    // Its own message to an evicted conversation.
    let own = request("cancel ben>ann").conversation_id("1");
    assert_eq!(stage.check(&own), UNKNOWN);
}

#[test]
fn an_undelivered_message_can_be_sent_again() {
    let ask = || request("request ann>ben").reply_with("q");
    for name in [None, Some("ann")] {
        let mut stage = Stage::new(match name {
            None => Monitor::observer(library()),
            Some(name) => Monitor::agent(library(), name),
        });
        stage.right(ask());
        assert_eq!(stage.wrong(ask()).kind, Kind::Repeated);
        let now = stage.now;
        stage.monitor.undelivered(&ask(), "ben", now);
        assert_eq!(stage.right(ask()), "requested");
        // The first copy arrived after all, and was answered.
        stage.monitor.undelivered(&ask(), "ben", now);
        assert_eq!(stage.right(request("agree ben>ann")), "agreed");
        // The answer proves the delivery, so a later report changes nothing.
        stage.monitor.undelivered(&ask(), "ben", now);
        assert_eq!(stage.wrong(ask()).kind, Kind::Repeated);
        // So it is with an answer, with a cancel, and with one of several receivers.
        stage
            .monitor
            .undelivered(&request("agree ben>ann"), "ann", now);
        assert_eq!(stage.right(request("agree ben>ann")), "agreed");
        let cancel = || request("cancel ann>ben").reply_with("x");
        stage.right(cancel());
        assert_eq!(stage.wrong(cancel()).kind, Kind::Unexpected);
        stage.monitor.undelivered(&cancel(), "ben", now);
        assert_eq!(stage.right(cancel()), "cancelling");
        stage.right(say("cfp ann>ben,cid").conversation_id("d"));
        let call = || say("cfp ann>ben,cid").conversation_id("d");
        stage.monitor.undelivered(&call(), "cid", now);
        let again = |to: &'static str| call().receivers([to]);
        assert_eq!(stage.wrong(again("ben")).kind, Kind::Unexpected);
        assert_eq!(stage.right(again("cid")), "called");
    }
    // Other messages, and other conversations.
    let mut stage = Stage::observer();
    stage.right(ask());
    let now = stage.now;
    for other in [
        request("request ann>ben").reply_with("other"),
        request("agree ann>ben").reply_with("q"),
        ask().conversation_id("d"),
        ask().protocol("fipa-query"),
    ] {
        stage.monitor.undelivered(&other, "ben", now);
        assert_eq!(stage.wrong(ask()).kind, Kind::Repeated);
    }
    stage.monitor.undelivered(&ask(), "cid", now);
    assert_eq!(stage.wrong(ask()).kind, Kind::Repeated);
    let of_mallory = request("request mallory>ben").reply_with("q");
    stage.monitor.undelivered(&of_mallory, "ben", now);
    assert_eq!(stage.wrong(ask()).kind, Kind::Repeated);
    // A participant that a `reply-to` names is a participant.
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben").reply_to(["ben"]));
    let agree = || request("agree ben>ann").reply_with("a");
    stage.right(agree());
    stage.monitor.undelivered(&agree(), "ann", now);
    assert_eq!(stage.right(agree()), "agreed");
}

#[test]
fn a_bid_that_crosses_an_undelivered_closing_is_a_bid() {
    let dutch = |text| say_in("fipa-auction-dutch", text);
    let closing = || dutch("inform ann>ben").reply_with("closing");
    // With `in-reply-to` and without it.
    for answered in [Some("price"), None] {
        let bid = || match answered {
            Some(text) => dutch("propose ben>ann").in_reply_to(text),
            None => dutch("propose ben>ann"),
        };
        for name in [None, Some("ann")] {
            let mut stage = Stage::new(match name {
                None => Monitor::observer(library()),
                Some(name) => Monitor::agent(library(), name),
            });
            stage.right(dutch("inform ann>ben").reply_with("opening"));
            stage.right(dutch("cfp ann>ben").reply_with("price"));
            assert_eq!(stage.right(closing()), "closed");
            let now = stage.now;
            stage.monitor.undelivered(&closing(), "ben", now);
            // The bid fits the state before the closing, which has not arrived.
            assert_eq!(stage.right(bid().reply_with("bid")), "bidding");
            let again = dutch("inform ann>ben").reply_with("again");
            assert_eq!(stage.right(again.in_reply_to("bid")), "closed");
        }
        // A letter of the message transport service reports it.
        for is_repeated in [false, true] {
            let mut stage = Stage::observer();
            stage.right(dutch("inform ann>ben").reply_with("opening"));
            stage.right(dutch("cfp ann>ben").reply_with("price"));
            stage.right(closing());
            let lost = dutch("failure mts>ann").undelivered_to("ben");
            assert_eq!(stage.right(lost), "undelivered");
            if !is_repeated {
                assert_eq!(stage.right(bid().reply_with("bid")), "bidding");
            }
            assert_eq!(stage.right(closing()), "closed");
            // The bid crosses the second closing.
            if is_repeated {
                assert_eq!(stage.right(bid().reply_with("bid")), "closed");
            }
        }
    }
}

#[test]
fn a_reported_message_has_arrived_or_not() {
    let dutch = |text| say_in("fipa-auction-dutch", text);
    for name in [None, Some("ann")] {
        let begun = || {
            let mut stage = Stage::new(match name {
                None => Monitor::observer(library()),
                Some(name) => Monitor::agent(library(), name),
            });
            stage.right(dutch("inform ann>ben").reply_with("opening"));
            stage.right(dutch("cfp ann>ben").reply_with("price"));
            stage.right(dutch("inform ann>ben").reply_with("closing"));
            let lost = dutch("failure mts>ann").undelivered_to("ben");
            assert_eq!(stage.right(lost.in_reply_to("closing")), "undelivered");
            stage
        };
        // The bid that answers the call is one, so it can be accepted.
        let mut stage = begun();
        let bid = dutch("propose ben>ann").in_reply_to("price");
        assert_eq!(stage.right(bid.reply_with("bid")), "bidding");
        stage.right(dutch("accept-proposal ann>ben").in_reply_to("bid"));
        // A bid that answers no call of the auctioneer is wrong.
        let mut stage = begun();
        let bid = dutch("propose ben>ann").in_reply_to("other");
        assert_eq!(stage.wrong(bid).kind, Kind::WrongReply);
    }
    // Another answer replaces one that was not delivered.
    for lost in ["agree ben>ann", "not-understood ben>ann"] {
        for mut stage in monitors("ben") {
            stage.right(request("request ann>ben").reply_with("q"));
            stage.right(request(lost).in_reply_to("q"));
            stage.right(request("failure mts>ben").undelivered_to("ann"));
            stage.right(request("refuse ben>ann").in_reply_to("q"));
        }
    }
    // Several agents that speak for the initiator get the report.
    for mut stage in monitors("ann") {
        stage.right(request("request ann>ben").reply_to(["dan"]));
        stage.right(request("agree ben>ann"));
        stage.right(request("not-understood ann>ben"));
        let lost = request("failure mts>ann,dan").undelivered_to("ben");
        assert_eq!(stage.right(lost), "agreed");
        stage.right(request("not-understood ann>ben"));
    }
    // A report begins no conversation.
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    for (words, to) in [("failure mts>ann", "ben"), ("failure mts>ben", "ann")] {
        let lost = request(words).undelivered_to(to);
        let Verdict::Accepted(accepted) = stage.check(&lost) else {
            panic!("it belongs to the conversation");
        };
        assert!(!accepted.opened);
    }
    // A message that crosses a cancel can be the undelivered one.
    for mut stage in monitors("ben") {
        stage.right(request("request ann>ben"));
        stage.right(request("cancel ann>ben"));
        stage.right(request("agree ben>ann"));
        stage.right(request("failure mts>ben").undelivered_to("ann"));
        stage.right(request("agree ben>ann"));
    }
}

#[test]
fn a_message_that_fits_after_an_uncertain_one_is_no_late_one() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="propose" from="b" to="a" target="5"/>
            <transition performative="inform" from="a" to="b" target="3"/></state>
        <state id="3"><transition performative="cfp" from="a" to="b" target="4"/></state>
        <state id="4"><transition performative="propose" from="b" to="a" target="5"/></state>
        <state id="5" final="yes"/></scxml>"#;
    let own = |words| say_in("own", words);
    let mut stage = Stage::new(Monitor::observer(library_with("own", text)));
    for words in ["request ann>ben", "inform ann>ben", "cfp ann>ben"] {
        stage.right(own(words));
    }
    let now = stage.now;
    stage.monitor.undelivered(&own("cfp ann>ben"), "ben", now);
    // It has crossed the inform, or answers the call, which has arrived then.
    assert_eq!(stage.right(own("propose ben>ann")), "5");
}

#[test]
fn a_message_before_the_last_is_not_taken_back() {
    for mut stage in monitors("ann") {
        stage.right(request("request ann>ben"));
        stage.right(request("not-understood ben>ann"));
        let now = stage.now;
        let before = request("request ann>ben");
        stage.monitor.undelivered(&before, "ben", now);
        assert_eq!(stage.wrong(request("agree ben>ann")).kind, Kind::Ended);
    }
}

#[test]
fn messages_that_cross_a_not_understood_answer_the_message_before_it() {
    let english = |text| say_in("fipa-auction-english", text);
    let mut stage = Stage::observer();
    stage.right(english("inform ann>ben").reply_with("opening"));
    stage.right(english("cfp ann>ben").reply_with("price"));
    let bid = english("propose ben>ann").in_reply_to("price");
    stage.right(bid.reply_with("bid"));
    stage.right(english("not-understood ben>ann").reply_with("what"));
    // The auctioneer has received the bid only, so that ben leads until the end.
    stage.right(english("accept-proposal ann>ben").in_reply_to("bid"));
    stage.right(english("cfp ann>ben").reply_with("higher"));
    stage.right(english("inform ann>ben"));
    stage.right(english("request ann>ben"));
    assert_eq!(stage.wrong(english("request ben>ann")).kind, Kind::Ended);
}

#[test]
fn an_undelivered_message_of_either_side_of_one_state_can_be_sent_again() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="agree" from="b" to="a" target="3"/></state>
        <state id="3"><transition performative="inform" from="a" to="b" target="4"/></state>
        <state id="4" final="yes"/></scxml>"#;
    let own = |words| say_in("own", words);
    let library = library_with("own", text);
    for name in [None, Some("ann"), Some("ben")] {
        let library = Arc::clone(&library);
        let mut stage = Stage::new(match name {
            None => Monitor::observer(library),
            Some(name) => Monitor::agent(library, name),
        });
        let all = ["request ann>ben", "agree ben>ann", "inform ann>ben"];
        for (words, receiver) in all.into_iter().zip(["ben", "ann", "ben"]) {
            stage.right(own(words));
            stage.wrong(own(words));
            let now = stage.now;
            stage.monitor.undelivered(&own(words), receiver, now);
            stage.right(own(words));
        }
    }
}

/// The monitors of all agents, and of this one.
fn monitors(agent: &str) -> [Stage; 2] {
    [
        Stage::observer(),
        Stage::new(Monitor::agent(library(), agent)),
    ]
}

#[test]
fn after_an_undelivered_not_understood_the_conversation_goes_on() {
    for mut stage in monitors("ben") {
        let not_understood = || request("not-understood ben>ann").in_reply_to("q");
        stage.right(request("request ann>ben").reply_with("q"));
        assert_eq!(stage.right(not_understood()), "not-understood");
        let now = stage.now;
        stage.monitor.undelivered(&not_understood(), "ann", now);
        // It is sent again, and lost again.
        assert_eq!(stage.right(not_understood()), "not-understood");
        stage.monitor.undelivered(&not_understood(), "ann", now);
        assert_eq!(stage.right(request("agree ben>ann")), "agreed");
        assert_eq!(stage.right(request("inform ben>ann")), "done");
        assert_eq!(stage.wrong(not_understood()).kind, Kind::Ended);
    }
}

#[test]
fn an_answer_that_is_lost_several_times_is_sent_again() {
    for mut stage in monitors("ben") {
        stage.right(request("request ann>ben").reply_with("q"));
        for text in ["1", "2", "3"] {
            let agree = || request("agree ben>ann").reply_with(text).in_reply_to("q");
            assert_eq!(stage.right(agree()), "agreed", "{text}");
            let now = stage.now;
            stage.monitor.undelivered(&agree(), "ann", now);
        }
        assert_eq!(stage.right(request("refuse ben>ann")), "refused");
    }
}

#[test]
fn an_undelivered_answer_to_a_cancel_is_sent_again() {
    for act in ["inform ben>ann", "failure ben>ann"] {
        for mut stage in monitors("ben") {
            stage.right(request("request ann>ben"));
            stage.right(request("agree ben>ann"));
            stage.right(request("cancel ann>ben").reply_with("x"));
            let answer = || request(act).in_reply_to("x");
            let state = stage.right(answer());
            let now = stage.now;
            stage.monitor.undelivered(&answer(), "ann", now);
            assert_eq!(stage.right(answer()), state);
        }
    }
}

#[test]
fn a_cancel_of_uncertain_delivery_may_be_answered() {
    for (act, state) in [
        ("inform ben>ann", "cancelled"),
        ("failure ben>ann", "agreed"),
    ] {
        for mut stage in monitors("ann") {
            stage.right(request("request ann>ben").reply_with("q"));
            stage.right(request("agree ben>ann").in_reply_to("q"));
            let cancel = || request("cancel ann>ben").reply_with("x");
            stage.right(cancel());
            let now = stage.now;
            stage.monitor.undelivered(&cancel(), "ben", now);
            assert_eq!(stage.right(request(act).in_reply_to("x")), state);
        }
    }
}

#[test]
fn a_bid_belongs_to_the_last_call_that_was_delivered() {
    let english = |text| say_in("fipa-auction-english", text);
    for mut stage in monitors("ann") {
        stage.right(english("inform ann>ben").reply_with("opening"));
        stage.right(english("cfp ann>ben").reply_with("1"));
        stage.right(english("cfp ann>ben").reply_with("2"));
        let lost = || english("cfp ann>ben").reply_with("3");
        stage.right(lost());
        let now = stage.now;
        stage.monitor.undelivered(&lost(), "ben", now);
        // The first bid is too late, the second answers the last call.
        let Verdict::Accepted(first) =
            stage.check(&english("propose ben>ann").in_reply_to("1").reply_with("a"))
        else {
            panic!();
        };
        assert!(first.void);
        let second = english("propose ben>ann").in_reply_to("2").reply_with("b");
        assert_eq!(stage.right(second), "bidding");
        let accepted = english("accept-proposal ann>ben").in_reply_to("b");
        assert_eq!(stage.right(accepted), "leading");
    }
    // The call arrived after all.
    for mut stage in monitors("ann") {
        stage.right(english("inform ann>ben").reply_with("opening"));
        stage.right(english("cfp ann>ben").reply_with("1"));
        let call = || english("cfp ann>ben").reply_with("2");
        stage.right(call());
        let now = stage.now;
        stage.monitor.undelivered(&call(), "ben", now);
        let bid = english("propose ben>ann").in_reply_to("2");
        assert_eq!(stage.right(bid), "bidding");
    }
}

#[test]
fn a_bid_may_answer_a_call_that_the_monitor_does_not_remember() {
    let dutch = |text| say_in("fipa-auction-dutch", text);
    for mut stage in monitors("ann") {
        stage.right(dutch("inform ann>ben").reply_with("opening"));
        for number in 0..9 {
            let call = dutch("cfp ann>ben").reply_with(number.to_string());
            assert_eq!(stage.right(call), "called");
        }
        let bid = dutch("propose ben>ann").in_reply_to("0");
        let Verdict::Accepted(bid) = stage.check(&bid) else {
            panic!();
        };
        assert!(bid.void);
        stage.right(dutch("propose ben>ann").in_reply_to("8").reply_with("a"));
    }
    // Few messages are all known.
    for mut stage in monitors("ann") {
        stage.right(dutch("inform ann>ben").reply_with("opening"));
        stage.right(dutch("cfp ann>ben").reply_with("1"));
        let bid = dutch("propose ben>ann").in_reply_to("0");
        assert_eq!(stage.wrong(bid).kind, Kind::WrongReply);
    }
}

#[test]
fn each_participant_of_a_forgotten_conversation_may_be_in_a_later_state() {
    let english = |text| say_in("fipa-auction-english", text);
    let monitor = Monitor::agent(library(), "ann").with_history(History::Unknown);
    let mut stage = Stage::new(monitor);
    // The auction begins for ben.
    stage.right(english("inform ann>ben"));
    stage.right(english("cfp ann>ben"));
    // It ends for cid, whose bid crosses the end.
    stage.right(english("inform ann>cid"));
    assert_eq!(stage.check(&english("propose cid>ann")), UNKNOWN);
    // The end is not delivered, so the auction goes on for ben.
    let monitor = Monitor::agent(library(), "ann").with_history(History::Unknown);
    let mut stage = Stage::new(monitor);
    let end = || english("inform ann>ben").reply_with("3");
    stage.right(end());
    let now = stage.now;
    stage.monitor.undelivered(&end(), "ben", now);
    stage.right(english("cfp ann>ben").reply_with("4"));
    let bid = english("propose ben>ann").in_reply_to("2");
    assert_eq!(stage.check(&bid), UNKNOWN);
}

/// An announcement, calls, the end and what follows it. The announcement looks like the end.
const AUCTION: &str = r#"
    <state id="1"><transition performative="inform" from="a" to="b" target="2"/></state>
    <state id="2"><transition performative="cfp" from="a" to="b" target="3"/>
        <transition performative="inform" from="a" to="b" target="2"/>
        <transition performative="propose" from="b" to="a" target="2"/></state>
    <state id="3"><transition performative="inform" from="a" to="b" target="4"/></state>
    <state id="4"><transition performative="inform" from="a" to="b" target="4"/>
        <transition performative="request" from="a" to="b" target="5"/></state>
    <state id="5" final="yes"/></scxml>"#;

#[test]
fn a_forgotten_conversation_of_one_state_may_be_in_a_later_state() {
    let own = |words| say_in("own", words);
    let restarted = || {
        let library = library_with("own", &format!(r#"<scxml initial="1">{AUCTION}"#));
        Stage::new(Monitor::observer(library).with_history(History::Unknown))
    };
    let mut stage = restarted();
    stage.right(own("inform ann>ben"));
    assert_eq!(stage.check(&own("request ann>ben")), UNKNOWN);
    // A call shows that the auction has begun, and a later message like the first one does not change it.
    let mut stage = restarted();
    for words in ["inform ann>ben", "cfp ann>ben", "inform ann>ben"] {
        stage.right(own(words));
    }
    assert_eq!(stage.wrong(own("cfp ann>ben")).kind, Kind::Unexpected);
}

#[test]
fn a_message_that_changes_no_state_shows_none() {
    let own = |words| say_in("own", words);
    let head = r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol" f:scope="participant">"#;
    let library = library_with("own", &format!("{head}{AUCTION}"));
    let all: [&dyn Fn(&mut Stage); 5] = [
        // A call that was not delivered, and calls to both participants after it.
        &|stage| {
            stage.right(own("inform ann>cid"));
            stage.right(own("cfp ann>ben"));
            let lost = own("failure mts>ann").undelivered_to("ben");
            assert_eq!(stage.right(lost), "undelivered");
            stage.right(own("cfp ann>ben"));
            stage.right(own("cfp ann>cid"));
        },
        // A void answer.
        &|stage| {
            stage.right(own("inform ann>ben").reply_with("2"));
            stage.right(own("propose ben>ann").in_reply_to("1"));
        },
        // A cancel that was not delivered.
        &|stage| {
            stage.right(own("cancel ann>ben"));
            let lost = own("failure mts>ann").undelivered_to("ben");
            assert_eq!(stage.right(lost), "undelivered");
        },
        // A cancel that failed.
        &|stage| {
            stage.right(own("cancel ann>ben"));
            assert_eq!(stage.right(own("failure ben>ann")), "2");
        },
        &|stage| {
            stage.right(own("cancel ann>ben").reply_with("x"));
            assert_eq!(stage.right(own("failure ben>ann").in_reply_to("x")), "2");
        },
    ];
    for between in all {
        let monitor = Monitor::agent(Arc::clone(&library), "ann").with_history(History::Unknown);
        let mut stage = Stage::new(monitor);
        stage.right(own("inform ann>ben").reply_with("1"));
        between(&mut stage);
        // The inform may have been the end.
        assert_eq!(stage.check(&own("request ann>ben")), UNKNOWN);
    }
}

#[test]
fn a_message_to_a_pattern_shows_the_state_of_its_members_only() {
    let english = |text| say_in("fipa-auction-english", text);
    let restarted = || {
        let monitor = Monitor::agent(library(), "ann").with_history(History::Unknown);
        Stage::new(monitor)
    };
    // A call to the members shows that the auction has begun for them.
    let mut stage = restarted();
    stage.right(english("inform ann>arm_.*"));
    stage.right(english("cfp ann>arm_.*"));
    let early = stage.wrong(english("accept-proposal ann>arm_.*"));
    assert_eq!(early.state.as_deref(), Some("called"));
    // The inform alone may have been the end of an auction.
    let mut stage = restarted();
    stage.right(english("inform ann>arm_.*"));
    assert_eq!(stage.check(&english("request ann>arm_.*")), UNKNOWN);
    // A call does not show the state of ben.
    let mut stage = restarted();
    stage.right(english("inform ann>ben"));
    stage.right(english("inform ann>arm_.*"));
    stage.right(english("cfp ann>arm_.*"));
    assert_eq!(stage.check(&english("propose ben>ann")), UNKNOWN);
}

#[test]
fn an_undelivered_message_that_may_have_been_a_later_one_leaves_an_unknown_state() {
    let iterated = |text| say_in("fipa-iterated-contract-net", text);
    let restarted = || {
        let monitor = Monitor::agent(library(), "ann").with_history(History::Unknown);
        Stage::new(monitor)
    };
    // The second call is the first message after the restart.
    let call = || iterated("cfp ann>ben").reply_with("2");
    for next in [
        "accept-proposal ann>ben",
        "reject-proposal ann>ben",
        "failure ben>ann",
    ] {
        let mut stage = restarted();
        stage.right(call());
        let now = stage.now;
        stage.monitor.undelivered(&call(), "ben", now);
        assert_eq!(stage.check(&iterated(next)), UNKNOWN, "{next}");
    }
    let mut stage = restarted();
    stage.right(call());
    let now = stage.now;
    stage.monitor.undelivered(&call(), "ben", now);
    assert_eq!(stage.right(call()), "called", "it may be sent again");
    // If it was delivered, the state is known.
    let mut stage = restarted();
    stage.right(call());
    let early = stage.wrong(iterated("accept-proposal ann>ben"));
    assert_eq!(early.kind, Kind::OutOfOrder);
    // So it is after a report of another message.
    let mut stage = restarted();
    stage.right(call());
    let other = iterated("cfp ann>ben").reply_with("1");
    stage.monitor.undelivered(&other, "ben", now);
    stage.wrong(iterated("accept-proposal ann>ben"));
    // A monitor that knows all conversations knows that this one had not begun.
    let named = || call().reply_to(["dan"]);
    for call in [call(), named()] {
        let mut stage = Stage::observer();
        stage.right(call.clone());
        stage.monitor.undelivered(&call, "ben", now);
        stage.wrong(iterated("accept-proposal ann>ben"));
    }
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(call());
    stage.monitor.undelivered(&call(), "ben", now);
    stage.wrong(iterated("accept-proposal ann>ben"));
}

#[test]
fn the_first_message_after_a_restart_may_begin_another_round() {
    let text = |next| {
        format!(
            r#"<scxml initial="1" xmlns:fipa="urn:fipa-rs:protocol" fipa:scope="participant">
            <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="inform" from="b" to="a" target="{next}"/>
                <transition performative="refuse" from="b" to="a" target="3"/></state>
            <state id="3" final="yes"/></scxml>"#
        )
    };
    let own = |words| say_in("own", words);
    for (next, history, is_known) in [
        ("1", History::Unknown, false),
        ("1", History::Complete, true),
        ("3", History::Unknown, true),
    ] {
        let library = library_with("own", &text(next));
        let monitor = Monitor::agent(library, "ann").with_history(history);
        let mut stage = Stage::new(monitor);
        stage.right(own("request ann>ben"));
        let now = stage.now;
        let request = own("request ann>ben");
        stage.monitor.undelivered(&request, "ben", now);
        stage.right(own("cancel ann>ben"));
        stage.right(own("failure ben>ann"));
        // After another round, the cancel does not show that the request arrived.
        let verdict = stage.check(&own("request ann>ben"));
        match is_known {
            true => assert!(verdict.violation().is_some(), "{verdict:?}"),
            false => assert_eq!(verdict, UNKNOWN),
        }
    }
}

#[test]
fn messages_go_to_the_delegate_of_a_participant() {
    for name in [None, Some("ann")] {
        let mut stage = Stage::new(match name {
            None => Monitor::observer(library()),
            Some(name) => Monitor::agent(library(), name),
        });
        stage.right(say("cfp ann>ben,cid"));
        stage.right(say("propose ben>ann").reply_to(["dan"]).reply_with("b"));
        stage.right(say("propose cid>ann"));
        // FIPA00061: later messages go to the agent in reply-to.
        let accept = || say("accept-proposal ann>dan").in_reply_to("b");
        assert_eq!(stage.right(accept()), "accepted");
        assert_eq!(stage.wrong(accept()).kind, Kind::Unexpected);
        assert_eq!(stage.right(say("inform dan>ann")), "done");
        assert_eq!(stage.wrong(say("inform ben>ann")).kind, Kind::Ended);
        assert_eq!(stage.right(say("accept-proposal ann>cid")), "accepted");
    }
    // The delegate does not know the beginning.
    let mut stage = Stage::new(Monitor::agent(library(), "dan"));
    assert_eq!(stage.check(&say("accept-proposal ann>dan")), UNKNOWN);
    assert_eq!(stage.check(&say("inform dan>ann")), UNKNOWN);
    // With one state for all.
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="cfp" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="propose" from="b" to="a" target="3"/></state>
        <state id="3"><transition performative="accept-proposal" from="a" to="b" target="4"/></state>
        <state id="4"><transition performative="inform" from="b" to="a" target="5"/></state>
        <state id="5" final="yes"/></scxml>"#;
    let mut stage = Stage::new(Monitor::observer(library_with("own", text)));
    let own = |words| say_in("own", words);
    stage.right(own("cfp ann>ben"));
    stage.right(own("propose ben>ann").reply_to(["dan"]));
    stage.right(own("accept-proposal ann>dan"));
    assert_eq!(stage.right(own("inform dan>ann")), "5");
}

#[test]
fn not_understood_answers_nonsense() {
    for agent in [None, Some("ben")] {
        let mut stage = Stage::new(match agent {
            None => Monitor::observer(library()),
            Some(name) => Monitor::agent(library(), name),
        });
        stage.right(request("request ann>ben"));
        stage.right(request("refuse ben>ann"));
        let violation = stage.wrong(request("confirm ann>ben"));
        assert_eq!(violation.kind, Kind::Ended);
        let answered = Verdict::Unchecked(Unchecked::AnswersViolation);
        let answer = request("not-understood ben>ann");
        assert_eq!(stage.check(&answer), answered);
        // A violation has one answer.
        assert_eq!(stage.wrong(answer).kind, Kind::Ended);
        // Nonsense of a stranger.
        stage.wrong(request("confirm zoe>ben"));
        let other = stage.check(&request("not-understood ben>zoe"));
        assert_eq!(other, answered);
    }
}

#[test]
fn a_bid_may_answer_an_earlier_call() {
    let auction = |words| say_in("fipa-auction-dutch", words);
    let bid = |text: &str| auction("propose ben>auc").in_reply_to(text.to_owned());
    let mut stage = Stage::observer();
    stage.right(auction("inform auc>ben"));
    for number in 1..=9 {
        stage.right(auction("cfp auc>ben").reply_with(format!("call {number}")));
    }
    // A bounded number of calls is remembered.
    for (text, late) in [("call 7", true), ("call 3", true), ("call 9", false)] {
        let Verdict::Accepted(accepted) = stage.monitor.check(&bid(text), stage.now) else {
            panic!("{text}");
        };
        assert_eq!((accepted.late, accepted.void), (late, late), "{text}");
    }
}

#[test]
fn a_wrong_reply_names_the_expected_and_the_received_value() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben").reply_with("q1"));
    let wrong = stage.wrong(request("agree ben>ann").in_reply_to("q0"));
    let reply = wrong.reply.as_ref().unwrap();
    assert_eq!((&*reply.expected, &*reply.received), ("q1", "q0"));
    let text = wrong.to_string();
    assert!(text.contains(r#"expected "q1", received "q0""#), "{text}");
    // Each participant has its own value.
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben").reply_with("b"));
    stage.right(say("cfp ann>cid").reply_with("c"));
    let wrong = stage.wrong(say("propose cid>ann").in_reply_to("b"));
    let reply = wrong.reply.as_ref().unwrap();
    assert_eq!((&*reply.expected, &*reply.received), ("c", "b"));
    // The members of a pattern have one value until they answer.
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>arm_.*").reply_with("call"));
    let wrong = stage.wrong(say("propose arm_1>ann").in_reply_to("other"));
    let reply = wrong.reply.as_ref().unwrap();
    assert_eq!((&*reply.expected, &*reply.received), ("call", "other"));
    // So it is for each side, and for the agents that continue in its place.
    for (words, expected) in [
        ("inform ben>ann", "accept"),
        ("inform dan>ann", "accept"),
        ("reject-proposal ann>ben", "bid"),
        ("reject-proposal eve>ben", "bid"),
        ("reject-proposal ann>dan", "bid"),
    ] {
        let mut stage = Stage::observer();
        stage.right(say("cfp ann>ben").reply_to(["eve"]).reply_with("call"));
        let bid = say("propose ben>ann").in_reply_to("call");
        stage.right(bid.reply_to(["dan"]).reply_with("bid"));
        if expected == "accept" {
            stage.right(say("accept-proposal ann>ben").reply_with("accept"));
        }
        let wrong = stage.wrong(say(words).in_reply_to("other"));
        assert_eq!(wrong.kind, Kind::WrongReply, "{words}");
        assert_eq!(wrong.reply.unwrap().expected, expected, "{words}");
    }
}

#[test]
fn several_informs_may_cross_a_cancel() {
    for end in ["inform", "failure"] {
        let mut stage = Stage::observer();
        stage.right(subscribe("subscribe ann>ben"));
        stage.right(subscribe("inform ben>ann"));
        stage.right(subscribe("cancel ann>ben"));
        // fipa_services does not write `in-reply-to`.
        for _ in 0..5 {
            assert_eq!(stage.right(subscribe("inform ben>ann")), "cancelled");
        }
        match end {
            // The cancel failed, so the subscription continues and can be canceled again.
            "failure" => {
                assert_eq!(stage.right(subscribe("failure ben>ann")), "active");
                stage.right(subscribe("inform ben>ann"));
                stage.right(subscribe("cancel ann>ben"));
            }
            _ => assert_eq!(stage.wrong(subscribe("agree ben>ann")).kind, Kind::Ended),
        }
    }
}

#[test]
fn the_copies_of_a_multicast_are_one_message() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="query-if" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="b" to="a" target="2"/></state>
        </scxml>"#;
    let mut stage = Stage::new(Monitor::observer(library_with("own", text)));
    let own = |words| say_in("own", words);
    let copy = |to: &'static str| own("query-if ann>ben,cid,dan").copy_for(to);
    stage.right(copy("ben"));
    stage.right(copy("cid"));
    // An answer comes before the last copy.
    stage.right(own("inform ben>ann"));
    stage.right(copy("dan"));
    stage.right(own("inform dan>ann"));
    stage.right(own("inform cid>ann"));
    // A second message to one of them is another message.
    assert_eq!(stage.wrong(copy("cid")).kind, Kind::Unexpected);
    let alone = own("query-if ann>eve").copy_for("eve");
    assert_eq!(stage.wrong(alone).kind, Kind::WrongReceiver);
    // The receiver may be a coalition.
    let mut stage = Stage::new(Monitor::observer(library_with("own", text)));
    for member in ["ben", "cid"] {
        stage.right(own("query-if ann>platoon").copy_for(member));
    }
}

#[test]
fn the_copies_of_several_messages_may_mix() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="query-if" from="a" to="b" target="3"/></state>
        <state id="3"><transition performative="inform" from="a" to="b" target="4"/></state>
        <state id="4"><transition performative="confirm" from="a" to="b" target="5"/></state>
        <state id="5"><transition performative="agree" from="a" to="b" target="6"/></state>
        <state id="6" final="yes"/></scxml>"#;
    let mut stage = Stage::new(Monitor::observer(library_with("own", text)));
    let copy = |words, to: &'static str| say_in("own", words).copy_for(to);
    let all = [
        "request ann>ben,cid",
        "query-if ann>ben,cid",
        "inform ann>ben,cid",
        "confirm ann>ben,cid",
        "agree ann>ben,cid",
    ];
    for words in all {
        stage.right(copy(words, "ben"));
    }
    // Of five messages, the first is forgotten.
    for (number, words) in all.into_iter().enumerate() {
        let verdict = stage.check(&copy(words, "cid"));
        assert_eq!(verdict.is_accepted(), number > 0, "{words}: {verdict:?}");
    }
}

#[test]
fn a_message_that_was_sent_again_after_its_outcome_cannot_be_sent_a_third_time() {
    let request = || request("request ann>ben").reply_with("w");
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(request());
    stage.monitor.undelivered(&request(), "ben", stage.now);
    stage.right(request());
    stage.right(say_in("fipa-request", "agree ben>ann").in_reply_to("w"));
    assert_eq!(stage.wrong(request()).kind, Kind::Repeated);
}
