//! Agents that a `reply-to` names: they receive replies instead of the initiator and may continue in
//! its place (FIPA00061, FIPA00034).

use super::*;

fn recruit(words: &'static str) -> Header<'static> {
    say_in("fipa-recruiting", words)
}

#[test]
fn replies_may_go_to_the_agents_in_reply_to() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben").reply_to(["zoe"]));
    stage.right(request("agree ben>zoe"));
    assert_eq!(
        stage.wrong(request("inform ben>cid")).kind,
        Kind::WrongReceiver
    );
    stage.right(request("inform ben>ann,zoe"));
}

#[test]
fn recruited_agents_answer_the_agent_in_reply_to() {
    let mut stage = Stage::observer();
    stage.right(recruit("proxy ann>rec"));
    stage.right(recruit("agree rec>ann"));
    stage.right(say_in("fipa-query", "query-ref rec>ben").reply_to(["ann"]));
    stage.right(recruit("inform rec>ann"));
    stage.right(say_in("fipa-query", "agree ben>ann"));
    stage.right(say_in("fipa-query", "inform ben>ann"));
    stage.wrong(recruit("inform rec>ann"));
}

/// A recruited contract net up to its proposals, which are sent to dan.
fn recruited(monitor: Monitor) -> Stage {
    let mut stage = Stage::new(monitor);
    stage.right(recruit("proxy ann>rec"));
    stage.right(recruit("agree rec>ann"));
    stage.right(say("cfp rec>ben,cid").reply_to(["dan"]));
    stage.right(recruit("inform rec>ann"));
    stage.right(say("propose ben>dan").reply_with("b"));
    stage.right(say("propose cid>dan"));
    stage
}

#[test]
fn the_receiver_of_recruited_proposals_accepts_one() {
    let mut stage = recruited(Monitor::observer(library()));
    assert_eq!(
        stage.wrong(say("accept-proposal zoe>ben")).kind,
        Kind::Stranger
    );
    let unasked = say("accept-proposal dan>ben").in_reply_to("x");
    assert_eq!(stage.wrong(unasked).kind, Kind::WrongReply);
    let accept = say("accept-proposal dan>ben").in_reply_to("b");
    assert_eq!(stage.right(accept), "accepted");
    assert_eq!(stage.right(say("reject-proposal dan>cid")), "rejected");
    let again = stage.wrong(say("accept-proposal dan>ben"));
    assert_eq!(again.kind, Kind::Unexpected);
    assert_eq!(again.participant.as_deref(), Some("ben"));
    assert_eq!(stage.right(say("inform ben>dan")), "done");
}

#[test]
fn a_continuing_agent_cannot_add_participants() {
    let mut stage = recruited(Monitor::observer(library()));
    for words in ["cfp dan>eve", "cfp dan>eve,ben", "cfp dan>arm_.*"] {
        assert_eq!(stage.wrong(say(words)).kind, Kind::WrongReceiver, "{words}");
    }
    // The recruiter can, and dan may continue its multicast.
    stage.right(say("cfp rec>arm_.*"));
    stage.right(say("cancel dan>arm_.*"));
    stage.right(say("inform arm_1>dan"));
}

#[test]
fn a_continuing_agent_may_cancel_and_name_further_agents() {
    let mut stage = Stage::observer();
    let subscribe = |words| say_in("fipa-subscribe", words);
    stage.right(subscribe("subscribe ann>ben").reply_to(["dan"]));
    stage.right(subscribe("inform ben>dan"));
    assert_eq!(
        stage.wrong(subscribe("inform ben>eve")).kind,
        Kind::WrongReceiver
    );
    assert_eq!(
        stage.right(subscribe("cancel dan>ben").reply_to(["eve"])),
        "cancelling"
    );
    assert_eq!(stage.right(subscribe("failure ben>eve")), "active");
    stage.right(subscribe("cancel eve>ben"));
    assert_eq!(stage.right(subscribe("inform ben>eve")), "cancelled");
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    stage.right(request("agree ben>ann").reply_to(["dan"]));
    // It names an agent that continues in the place of the participant.
    assert_eq!(
        stage.wrong(request("cancel dan>ben")).kind,
        Kind::WrongReceiver
    );
    assert_eq!(stage.right(request("inform dan>ann")), "done");
}

#[test]
fn a_participant_in_reply_to_may_continue_with_the_others() {
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben,cid").reply_to(["ben"]));
    stage.right(say("propose ben>ann"));
    stage.right(say("propose cid>ben"));
    assert_eq!(stage.right(say("accept-proposal ben>cid")), "accepted");
    // Each of its two parts has violations of its own.
    assert_eq!(
        stage.wrong(say("accept-proposal ben>cid")).kind,
        Kind::Unexpected
    );
    assert_eq!(stage.wrong(say("inform ben>ann")).kind, Kind::OutOfOrder);
    stage.right(say("accept-proposal ann>ben"));
    stage.right(say("inform cid>ben"));
    stage.right(say("inform ben>ann"));
}

#[test]
fn a_continuing_agent_receives_failure_reports() {
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben").reply_to(["dan"]));
    stage.right(say("propose ben>dan").reply_with("b"));
    stage.right(say("accept-proposal dan>ben").reply_with("d"));
    let lost = say("failure host-mts>dan")
        .undelivered_to("ben")
        .in_reply_to("d");
    assert_eq!(stage.right(lost), "undelivered");
    assert_eq!(stage.right(say("accept-proposal dan>ben")), "accepted");
    assert_eq!(
        stage.wrong(say("failure host-mts>zoe")).kind,
        Kind::Stranger
    );
}

#[test]
fn with_one_state_a_continuing_agent_has_the_role_of_the_initiator() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="cfp" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="propose" from="b" to="a" target="3"/></state>
        <state id="3"><transition performative="accept-proposal" from="a" to="b" target="4"/></state>
        <state id="4" final="yes"/></scxml>"#;
    let own = |words| say_in("own", words);
    let library = library_with("own", text);
    let mut stage = Stage::new(Monitor::observer(Arc::clone(&library)));
    stage.right(own("cfp ann>ben").reply_to(["dan"]).reply_with("a"));
    stage.right(own("propose ben>dan").in_reply_to("a").reply_with("b"));
    let unasked = own("accept-proposal dan>ben").in_reply_to("a");
    assert_eq!(stage.wrong(unasked).kind, Kind::WrongReply);
    let accept = own("accept-proposal dan>ben").in_reply_to("b");
    assert_eq!(stage.right(accept), "4");
    // The monitor of dan does not know the roles: every message that the initiator may send fits.
    let mut stage = Stage::new(Monitor::agent(library, "dan"));
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    for words in [
        "propose ben>dan",
        "accept-proposal dan>ben",
        "accept-proposal dan>cid",
        "cancel dan>ben",
    ] {
        assert_eq!(stage.check(&own(words)), elsewhere, "{words}");
    }
    assert_eq!(stage.wrong(own("inform dan>ben")).kind, Kind::Unexpected);
}

#[test]
fn recruited_agents_accept_messages_of_the_agent_in_reply_to() {
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    stage.right(say("cfp rec>ben,cid").reply_to(["dan"]));
    stage.right(say("propose ben>dan"));
    assert_eq!(
        stage.wrong(say("accept-proposal zoe>ben")).kind,
        Kind::Stranger
    );
    assert_eq!(stage.right(say("accept-proposal dan>ben")), "accepted");
    assert_eq!(stage.right(say("inform ben>dan")), "done");
}

/// A monitor of dan, which has not seen the beginning of the conversation.
fn as_dan(with: impl FnOnce(&mut Stage)) -> Stage {
    let mut stage = Stage::new(Monitor::agent(library(), "dan"));
    with(&mut stage);
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    assert_eq!(stage.check(&say("propose ben>dan")), elsewhere);
    stage
}

#[test]
fn an_agent_that_joins_late_is_checked_from_its_first_answer_on() {
    let mut stage = as_dan(|stage| {
        // Not before dan has received a proposal.
        assert_eq!(
            stage.wrong(say("accept-proposal dan>ben")).kind,
            Kind::NotOpened
        );
    });
    for (words, kind) in [
        ("accept-proposal dan>eve", Kind::WrongReceiver),
        ("inform dan>ben", Kind::Unexpected),
        ("subscribe dan>ben", Kind::Unexpected),
    ] {
        assert_eq!(stage.wrong(say(words)).kind, kind, "{words}");
    }
    let accept = say("accept-proposal dan>ben");
    let Verdict::Accepted(accepted) = stage.check(&accept) else {
        panic!();
    };
    assert_eq!((accepted.state, accepted.elsewhere), ("accepted", true));
    assert_eq!(stage.wrong(accept).kind, Kind::Unexpected);
    assert_eq!(stage.right(say("inform ben>dan")), "done");
    assert_eq!(
        stage.wrong(say("accept-proposal dan>ben")).kind,
        Kind::Ended
    );
    stage.pass(61);
    assert!(stage.monitor.is_empty(), "it was over");
}

#[test]
fn an_agent_that_joins_late_infers_participants_from_their_answers() {
    let mut stage = as_dan(|_| {});
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    assert_eq!(stage.check(&say("propose cid>dan")), elsewhere);
    stage.right(say("reject-proposal dan>cid"));
    // Dan has not received the second call of ann, and does not know the initiator.
    assert_eq!(stage.check(&say("propose cid>dan")), elsewhere);
    stage.right(say("accept-proposal dan>cid,ben"));
    // Ann may begin another one with the same identifier.
    assert_eq!(stage.right(say("cfp ann>dan")), "called");
    assert_eq!(stage.right(say("refuse dan>ann")), "refused");
    // A message that is no answer in this protocol is a violation in every state.
    assert_eq!(stage.wrong(say("agree ben>dan")).kind, Kind::Unexpected);
    // An enclosing protocol is unknown too.
    assert_eq!(stage.check(&recruit("inform rec>dan")), elsewhere);
    assert_eq!(stage.monitor.len(), 2);
    // The state is unknown, so the end of the conversation is not reported.
    assert_eq!(stage.pass(100_000), []);
    assert!(stage.monitor.is_empty());
}

#[test]
fn an_initiator_with_reply_to_does_not_receive_all_messages() {
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    let due = Time::from_system_time(stage.now + Duration::from_secs(5)).unwrap();
    stage.right(say("cfp ann>ben,cid").reply_to(["dan"]).reply_by(due));
    // Ann has not received the proposal to dan or its acceptance.
    let done = || say("inform ben>ann,dan").reply_with("b");
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    assert_eq!(stage.check(&done()), elsewhere);
    assert_eq!(stage.wrong(done()).kind, Kind::Repeated);
    // She knows the participants and the possible answers.
    for (words, kind) in [
        ("inform eve>ann", Kind::Stranger),
        ("agree cid>ann", Kind::Unexpected),
        ("cfp cid>ann", Kind::Unexpected),
        ("accept-proposal ann>cid", Kind::OutOfOrder),
    ] {
        assert_eq!(stage.wrong(say(words)).kind, kind, "{words}");
    }
    // Her monitor does not know whether a message is overdue.
    assert_eq!(stage.pass(6), []);
    assert_eq!(stage.pass(100_000), []);
    assert!(stage.monitor.is_empty());
    // The same holds within another conversation.
    let mut stage = Stage::new(Monitor::agent(library(), "rec"));
    stage.right(recruit("proxy ann>rec"));
    stage.right(recruit("agree rec>ann"));
    stage.right(say("cfp rec>ben").reply_to(["ann"]));
    assert_eq!(stage.check(&say("inform ben>rec")), elsewhere);
    // An initiator that names itself receives all answers.
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(say("cfp ann>ben").reply_to(["ann"]));
    assert_eq!(stage.wrong(say("inform ben>ann")).kind, Kind::OutOfOrder);
}

#[test]
fn an_answer_that_may_lead_to_several_states_is_not_checked() {
    let text = r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol" f:scope="participant">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="b" to="a" target="3"/></state>
        <state id="3"><transition performative="confirm" from="a" to="b" target="4"/></state>
        <state id="4"><transition performative="inform" from="b" to="a" target="5"/></state>
        <state id="5" final="yes"/></scxml>"#;
    let own = |words| say_in("own", words);
    let mut stage = Stage::new(Monitor::agent(library_with("own", text), "dan"));
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    assert_eq!(stage.check(&own("inform ben>dan")), elsewhere);
    assert_eq!(stage.check(&own("confirm dan>ben")), elsewhere);
    assert_eq!(
        stage.wrong(own("disconfirm dan>ben")).kind,
        Kind::Unexpected
    );
    let stranger = stage.wrong(own("confirm dan>cid"));
    assert_eq!(stranger.kind, Kind::WrongReceiver);
    // The same holds after an undelivered message.
    let lost = own("failure host-mts>dan").undelivered_to("ben");
    assert_eq!(stage.right(lost), "elsewhere");
    assert_eq!(stage.check(&own("confirm dan>ben")), elsewhere);
}

#[test]
fn the_initiator_of_a_recruiting_continues_with_the_recruited_agents() {
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(recruit("proxy ann>rec"));
    stage.right(recruit("agree rec>ann"));
    let early = stage.wrong(say("accept-proposal ann>ben"));
    assert_eq!(early.kind, Kind::WrongProtocol);
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    assert_eq!(stage.check(&say("propose ben>ann")), elsewhere);
    stage.right(recruit("inform rec>ann"));
    assert_eq!(stage.check(&say("propose cid>ann")), elsewhere);
    assert_eq!(stage.right(say("accept-proposal ann>ben")), "accepted");
    assert_eq!(stage.right(say("reject-proposal ann>cid")), "rejected");
    assert_eq!(
        stage.wrong(say("accept-proposal ann>cid")).kind,
        Kind::Ended
    );
    assert_eq!(stage.right(say("inform ben>ann")), "done");
    assert_eq!(stage.monitor.len(), 2, "both in one within the recruiting");
    let again = stage.wrong(recruit("inform rec>ann"));
    assert_eq!(again.kind, Kind::Unexpected);
}

#[test]
fn unchecked_answers_keep_a_conversation_from_being_removed() {
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    let mut stage = as_dan(|_| {});
    stage.pass(80_000);
    assert_eq!(stage.check(&say("propose ben>dan")), elsewhere);
    stage.pass(20_000);
    assert_eq!(stage.monitor.len(), 1);
    // Within another conversation, they keep that one too.
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(recruit("proxy ann>rec"));
    stage.right(recruit("agree rec>ann"));
    for _ in 0..2 {
        stage.pass(80_000);
        assert_eq!(stage.check(&say("propose ben>ann")), elsewhere);
    }
    stage.pass(20_000);
    assert_eq!(stage.monitor.len(), 2);
    assert_eq!(stage.pass(80_000).len(), 1, "the recruiting is abandoned");
    assert!(stage.monitor.is_empty());
}

#[test]
fn the_limits_apply_to_conversations_that_began_elsewhere() {
    let mut limits = MonitorLimits::default();
    (limits.conversations, limits.participants, limits.embedded) = (4, 3, 1);
    let monitor = Monitor::agent(library(), "dan").with_limits(limits);
    let mut stage = Stage::new(monitor);
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    for number in 0..20 {
        let answer = say("propose ben>dan").conversation_id(number.to_string());
        assert_eq!(stage.check(&answer), elsewhere);
    }
    assert_eq!(stage.monitor.len(), 4);
    // Participants: the fourth is not kept.
    for words in [
        "propose 1>dan",
        "propose 2>dan",
        "propose 3>dan",
        "propose 4>dan",
    ] {
        assert_eq!(stage.check(&say(words)), elsewhere);
    }
    stage.right(say("accept-proposal dan>3"));
    let fourth = stage.wrong(say("accept-proposal dan>4"));
    assert_eq!(fourth.kind, Kind::WrongReceiver);
    // Bytes: the answers of too long names are not kept.
    let share = 1 << 14;
    let mut small = MonitorLimits::default();
    small.bytes = share * 8;
    let mut stage = Stage::new(Monitor::agent(library(), "dan").with_limits(small));
    for number in 0..20 {
        let answer = say("propose ben>dan").sender(format!("{number:x<2000}"));
        assert_eq!(stage.check(&answer.reply_with("bid")), elsewhere);
        assert!(stage.monitor.bytes() <= share, "{number}");
    }
    assert!(stage.monitor.bytes() > share / 2);
    // Embedded conversations.
    let monitor = Monitor::agent(library(), "ann").with_limits(limits);
    let mut stage = Stage::new(monitor);
    stage.right(recruit("proxy ann>rec"));
    stage.right(recruit("agree rec>ann"));
    assert_eq!(stage.check(&say("propose ben>ann")), elsewhere);
    assert_eq!(
        stage.check(&say_in("fipa-query", "inform ben>ann")),
        elsewhere
    );
    assert_eq!(stage.monitor.len(), 2);
}
