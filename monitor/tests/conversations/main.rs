//! Verdicts on whole conversations: several participants, crossing and repeated messages, timeouts,
//! embedded conversations, and the removal of conversations.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod designated;
mod details;
mod guards;
mod hostile;
mod legal;
mod moved;
mod own;
mod plain;

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Message, MessageView, Performative, Time};
use fipa_monitor::{
    Event, Header, History, Library, Machine, Moment, Monitor, MonitorLimits, MonitorPolicy,
    Unchecked, Verdict, Violation, ViolationKind as Kind,
};

const START: Duration = Duration::from_secs(1_700_000_000);

/// A monitor and a simulated clock.
struct Stage {
    monitor: Monitor,
    now: SystemTime,
}

fn library() -> Arc<Library> {
    Arc::new(Library::standard())
}

/// The standard protocols, which are read once.
fn library_once() -> Arc<Library> {
    static ONCE: std::sync::LazyLock<Arc<Library>> = std::sync::LazyLock::new(library);
    Arc::clone(&ONCE)
}

/// The standard protocols and one of this text.
fn library_with(name: &str, text: &str) -> Arc<Library> {
    let mut library = Library::standard();
    library.add(Machine::read(name, text).unwrap()).unwrap();
    Arc::new(library)
}

impl Stage {
    fn new(monitor: Monitor) -> Self {
        let now = SystemTime::UNIX_EPOCH + START;
        Self { monitor, now }
    }

    fn observer() -> Self {
        Self::new(Monitor::observer(library()))
    }

    fn check(&mut self, header: &Header<'_>) -> Verdict<'_> {
        self.monitor.check(header, self.now)
    }

    /// Checks a message that must be accepted. Returns the new state.
    fn right(&mut self, header: Header<'_>) -> String {
        match self.check(&header) {
            Verdict::Accepted(accepted) => accepted.state.to_owned(),
            other => panic!("{header:?}: {other:?}"),
        }
    }

    fn wrong(&mut self, header: Header<'_>) -> Violation {
        match self.check(&header) {
            Verdict::Violation(violation) => *violation,
            other => panic!("{header:?}: {other:?}"),
        }
    }

    fn pass(&mut self, seconds: u64) -> Vec<Event> {
        self.now += Duration::from_secs(seconds);
        self.monitor.handle_timeout(self.now)
    }
}

fn act(name: &str) -> Performative {
    name.parse().unwrap()
}

/// The message `"cfp ann>ben,cid"` in conversation c of the contract net.
fn say(words: &'static str) -> Header<'static> {
    say_in("fipa-contract-net", words)
}

fn say_in(protocol: &'static str, words: &'static str) -> Header<'static> {
    let (name, agents) = words.split_once(' ').unwrap();
    let (from, to) = agents.split_once('>').unwrap();
    Header::new(act(name))
        .sender(from)
        .receivers(to.split(','))
        .protocol(protocol)
        .conversation_id("c")
}

fn request(words: &'static str) -> Header<'static> {
    say_in("fipa-request", words)
}

#[test]
fn each_participant_has_a_state_of_its_own() {
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben,cid,dan,eve"));
    stage.right(say("propose ben>ann"));
    stage.right(say("refuse cid>ann"));
    stage.right(say("propose dan>ann"));
    // A message to several agents must fit all of them. Otherwise it changes no state.
    let violation = stage.wrong(say("reject-proposal ann>ben,eve"));
    assert_eq!(violation.participant.as_deref(), Some("eve"));
    assert_eq!(violation.state.as_deref(), Some("called"));
    stage.right(say("accept-proposal ann>ben"));
    stage.right(say("reject-proposal ann>dan"));
    stage.right(say("propose eve>ann"));
    let Verdict::Accepted(accepted) = stage.check(&say("inform ben>ann")) else {
        panic!();
    };
    assert!(
        accepted.ended && !accepted.complete,
        "eve has no answer yet"
    );
    let Verdict::Accepted(accepted) = stage.check(&say("reject-proposal ann>eve")) else {
        panic!();
    };
    assert!(accepted.complete);
    assert_eq!(stage.wrong(say("inform dan>ann")).kind, Kind::Ended);
}

#[test]
fn a_call_may_be_sent_in_several_letters_or_to_a_pattern() {
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben"));
    stage.right(say("cfp ann>cid"));
    stage.right(say("propose cid>ann"));
    stage.right(say("propose ben>ann"));
    assert_eq!(stage.wrong(say("cfp ann>ben")).kind, Kind::Unexpected);
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>arm_.*"));
    stage.right(say("propose arm_1>ann"));
    stage.right(say("refuse arm_2>ann"));
    stage.right(say("accept-proposal ann>arm_1"));
    assert_eq!(stage.wrong(say("inform arm_3>ann")).kind, Kind::OutOfOrder);
    stage.right(say("inform arm_1>ann"));
}

#[test]
fn a_violation_describes_message_state_and_expected_messages() {
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben"));
    let violation = stage.wrong(say("inform ben>ann"));
    assert_eq!(violation.kind, Kind::OutOfOrder);
    assert_eq!(
        violation.to_string(),
        "inform from ben to ann breaks fipa-contract-net in conversation \"c\": the message is \
         too early, a step is missing; state \"called\" with ben; expected refuse, propose from ben to ann"
    );
    assert_eq!(stage.wrong(say("propose ann>ben")).kind, Kind::WrongSender);
    assert_eq!(
        stage.wrong(say("propose ben>cid")).kind,
        Kind::WrongReceiver
    );
    assert_eq!(
        stage.wrong(say("propose ben>ann,cid")).kind,
        Kind::WrongReceiver
    );
    assert_eq!(stage.wrong(say("propose cid>ann")).kind, Kind::Stranger);
    assert_eq!(stage.wrong(say("subscribe ben>ann")).kind, Kind::Unexpected);
    let other = stage.wrong(request("request ann>ben"));
    assert_eq!(other.kind, Kind::WrongProtocol);
    assert_eq!(other.protocol, "fipa-contract-net");
    let unknown = say("propose ben>ann").conversation_id("another");
    let unknown = stage.wrong(unknown);
    assert_eq!(unknown.kind, Kind::NotOpened);
    assert!(
        unknown
            .to_string()
            .ends_with("expected cfp from initiator to participant")
    );
    assert_eq!(stage.right(say("propose ben>ann")), "proposed");
}

#[test]
fn messages_without_conversation_protocol_or_agents_are_unchecked() {
    let mut stage = Stage::observer();
    for (header, why) in [
        (
            Header::new(act("cfp")).sender("ann").receivers(["ben"]),
            Unchecked::NoConversation,
        ),
        (
            Header::new(act("cfp")).conversation_id("c"),
            Unchecked::NoSender,
        ),
        (
            Header::new(act("cfp")).sender("ann").conversation_id("c"),
            Unchecked::NoReceiver,
        ),
        (
            Header::new(act("cfp"))
                .sender("ann")
                .receivers(["ben"])
                .conversation_id("c"),
            Unchecked::NoProtocol,
        ),
        (say_in("dance", "cfp ann>ben"), Unchecked::UnknownProtocol),
        (
            say("cfp ann>ben").conversation_id("c".repeat(5_000)),
            Unchecked::TooLarge,
        ),
        (
            say("cfp ann>ben").receivers(vec!["ben"; 2_000]),
            Unchecked::TooLarge,
        ),
    ] {
        assert_eq!(stage.check(&header), Verdict::Unchecked(why));
    }
    assert!(stage.monitor.is_empty());
}

#[test]
fn a_message_without_protocol_belongs_to_its_conversation() {
    let mut stage = Stage::observer();
    stage.right(say_in("contractNet", "cfp ann>ben"));
    let header = Header::new(act("propose"))
        .sender("ben")
        .receivers(["ann"])
        .conversation_id("c");
    stage.right(header);
    stage.right(say("accept-proposal ann>ben"));
}

#[test]
fn messages_and_their_views_have_the_same_verdicts() {
    let mut ours = Message::builder(Performative::Request)
        .sender(AgentId::new("ann").unwrap())
        .receiver(AgentId::new("ben").unwrap())
        .protocol("fipa-request")
        .conversation_id("c 1")
        .reply_with("r \"1\"");
    ours = ours.reply_by(Time::after(Duration::from_secs(5)).unwrap());
    let message = ours.build().unwrap();
    let payload = message.to_payload();
    let view = MessageView::parse_payload(&payload).unwrap();
    let answer = message
        .reply(Performative::Agree)
        .sender(AgentId::new("ben").unwrap());
    let answer = answer.build().unwrap();
    for first in [Header::from(&message), Header::from(&view)] {
        let mut stage = Stage::observer();
        assert_eq!(stage.right(first), "requested");
        assert_eq!(stage.right(Header::from(&answer)), "agreed");
    }
    let mut stage = Stage::observer();
    stage.right(Header::from(&message).receivers(["cid"]));
    assert_eq!(
        stage.wrong(Header::from(&answer)).kind,
        Kind::Stranger,
        "the copy went to cid"
    );
}

#[test]
fn in_reply_to_must_match_reply_with() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben").reply_with("q1"));
    let wrong = stage.wrong(request("agree ben>ann").in_reply_to("q0"));
    assert_eq!(wrong.kind, Kind::WrongReply);
    stage.right(request("agree ben>ann").in_reply_to("q1").reply_with("a1"));
    let again = request("agree ben>ann").in_reply_to("q1").reply_with("a1");
    assert_eq!(stage.wrong(again).kind, Kind::Repeated);
    // fipa_services does not write `in-reply-to`.
    stage.right(request("inform ben>ann"));
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben").reply_with("q1"));
    let again = request("request ann>ben").reply_with("q1");
    assert_eq!(stage.wrong(again).kind, Kind::Repeated);
    let another = request("request ann>ben").reply_with("q2");
    assert_eq!(stage.wrong(another).kind, Kind::Unexpected);
}

#[test]
fn messages_that_cross_a_cancel_are_accepted() {
    let subscribe = |words| say_in("fipa-subscribe", words);
    let mut stage = Stage::observer();
    stage.right(subscribe("subscribe ann>ben").reply_with("s"));
    stage.right(subscribe("agree ben>ann"));
    assert_eq!(
        stage.right(subscribe("cancel ann>ben").reply_with("x")),
        "cancelling"
    );
    // A crossing message: the answer to the subscription, not to the cancel.
    assert_eq!(
        stage.right(subscribe("inform ben>ann").in_reply_to("s")),
        "cancelling"
    );
    let wrong = stage.wrong(subscribe("refuse ben>ann").in_reply_to("s"));
    assert_eq!(wrong.state.as_deref(), Some("cancelling"));
    assert_eq!(
        stage.right(subscribe("failure ben>ann").in_reply_to("x")),
        "active"
    );
    stage.right(subscribe("inform ben>ann").in_reply_to("s"));
    stage.right(subscribe("cancel ann>ben").reply_with("y"));
    assert_eq!(
        stage.right(subscribe("inform ben>ann").in_reply_to("y")),
        "cancelled"
    );
    assert_eq!(
        stage
            .wrong(subscribe("inform ben>ann").in_reply_to("s"))
            .kind,
        Kind::Ended
    );
    // Without `in-reply-to`, either inform may be the answer to the cancel: a second one may come.
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    stage.right(request("cancel ann>ben"));
    assert_eq!(stage.right(request("inform ben>ann")), "cancelled");
    assert_eq!(stage.right(request("inform ben>ann")), "cancelled");
    stage.wrong(request("inform ben>ann"));
    // In the standard, a participant cannot cancel.
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    stage.wrong(request("cancel ben>ann"));
}

#[test]
fn an_agent_that_received_the_end_cannot_cancel() {
    let run = |monitor| {
        let mut stage = Stage::new(monitor);
        stage.right(request("request ann>ben"));
        stage.right(request("inform ben>ann"));
        stage.check(&request("cancel ann>ben")).is_accepted()
    };
    assert!(
        run(Monitor::observer(library())),
        "it may have crossed the inform"
    );
    assert!(run(Monitor::agent(library(), "ben")), "likewise");
    assert!(
        !run(Monitor::agent(library(), "ann")),
        "she had received it"
    );
}

#[test]
fn an_undelivered_letter_can_be_sent_again() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben").reply_with("1"));
    assert_eq!(
        stage.right(
            request("failure host-mts>ann")
                .undelivered_to("ben")
                .in_reply_to("1")
        ),
        "undelivered"
    );
    assert_eq!(
        stage.right(request("request ann>ben").reply_with("2")),
        "requested"
    );
    // The report does not name a message: it concerns the last one.
    let lost = request("failure host-mts>ann").undelivered_to("ben");
    assert_eq!(stage.right(lost), "undelivered");
    assert_eq!(
        stage.right(request("agree ben>ann")),
        "agreed",
        "it had arrived after all"
    );
    // With several participants, it concerns one of them.
    let mut stage = Stage::observer();
    stage.right(say("cfp ann>ben,cid"));
    let lost = |receiver| say("failure host-mts>ann").undelivered_to(receiver);
    assert_eq!(stage.right(lost("cid")), "undelivered");
    stage.right(say("propose ben>ann"));
    assert_eq!(stage.right(say("cfp ann>cid")), "called");
    // A report about an agent that takes no part changes nothing, and neither does a report to one.
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    assert_eq!(stage.check(&lost("dan")), unknown);
    let to_outsider = say("failure host-mts>dan").undelivered_to("cid");
    assert_eq!(stage.check(&to_outsider), unknown);
    stage.right(say("propose cid>ann"));
}

#[test]
fn an_agent_may_send_to_itself() {
    let mut stage = Stage::observer();
    for words in ["request ann>ann", "agree ann>ann", "inform ann>ann"] {
        stage.right(request(words));
    }
    stage.wrong(request("inform ann>ann"));
}

#[test]
fn overdue_messages_are_reported_and_late_answers_are_marked() {
    let mut stage = Stage::observer();
    let by = |stage: &Stage| Time::from_system_time(stage.now + Duration::from_secs(5)).unwrap();
    let due = by(&stage);
    stage.right(say("cfp ann>ben,cid").reply_by(due));
    stage.right(say("propose ben>ann"));
    let next = stage.monitor.poll_timeout().unwrap();
    assert!(next > stage.now + Duration::from_secs(5) && next < stage.now + Duration::from_secs(6));
    assert_eq!(stage.pass(5), [], "not yet");
    let overdue = Event::Overdue {
        protocol: "fipa-contract-net".into(),
        conversation_id: "c".into(),
        participant: Some("cid".into()),
        state: "called".into(),
        next: Some("expired".into()),
    };
    assert_eq!(stage.pass(1), [overdue]);
    let Verdict::Accepted(late) = stage.check(&say("propose cid>ann")) else {
        panic!();
    };
    assert!(late.late);
    stage.wrong(say("accept-proposal ann>cid"));
    stage.right(say("reject-proposal ann>cid"));
    stage.right(say("accept-proposal ann>ben"));
    // Without a timeout transition, an answer is only marked as late.
    let due = by(&stage);
    let ask = request("request ann>ben")
        .conversation_id("r")
        .reply_by(due);
    stage.right(ask);
    let events = stage.pass(60);
    assert!(
        matches!(&events[..], [Event::Overdue { next: None, .. }]),
        "{events:?}"
    );
    let agree = request("agree ben>ann").conversation_id("r");
    let Verdict::Accepted(late) = stage.check(&agree) else {
        panic!();
    };
    assert!(late.late && late.state == "agreed");
    // The same holds without a call of `handle_timeout`.
    let due = by(&stage);
    stage.right(say("cfp ann>ben").conversation_id("d").reply_by(due));
    stage.now += Duration::from_secs(9);
    assert_eq!(
        stage.right(say("propose ben>ann").conversation_id("d")),
        "late"
    );
}

#[test]
fn states_have_timeouts_of_their_own() {
    let text = r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol" f:scope="participant">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="b" to="a" target="3"/>
            <transition f:after="500ms" target="gone"/></state>
        <state id="3" final="yes"/><state id="gone" final="yes"/></scxml>"#;
    let mut library = Library::empty();
    library.read("own", text).unwrap();
    let mut stage = Stage::new(Monitor::observer(Arc::new(library)));
    stage.right(say_in("own", "request ann>ben"));
    let [
        Event::Overdue {
            next: Some(next), ..
        },
    ] = &stage.pass(1)[..]
    else {
        panic!();
    };
    assert_eq!(next, "gone");
    assert_eq!(
        stage.wrong(say_in("own", "inform ben>ann")).kind,
        Kind::Ended
    );
}

#[test]
fn brokers_run_embedded_protocols() {
    let broker = |words| say_in("fipa-brokering", words);
    let mut stage = Stage::observer();
    stage.right(broker("proxy ann>bro"));
    // Too early: this is another conversation with the same identifier.
    stage.right(say_in("fipa-propose", "propose bro>zoe"));
    stage.right(broker("agree bro>ann"));
    stage.right(say_in("fipa-query", "query-ref bro>ben,cid"));
    // The report of a message transport service begins no conversation.
    let lost = say_in("fipa-request", "failure bro>ann").undelivered_to("bro");
    assert_eq!(
        stage.check(&lost),
        Verdict::Unchecked(Unchecked::UnknownHistory)
    );
    stage.right(say_in("fipa-request", "request bro>dan"));
    // A violation in the existing query does not begin another one.
    let own = stage.wrong(say_in("fipa-query", "inform bro>cid"));
    assert_eq!(own.kind, Kind::WrongSender);
    assert_eq!(
        stage.wrong(say_in("fipa-query", "query-ref ann>ben")).kind,
        Kind::Stranger
    );
    stage.wrong(broker("confirm bro>ann"));
    stage.right(broker("inform bro>ann"));
    stage.right(say_in("fipa-query", "inform ben>bro"));
    stage.right(broker("inform bro>ann"));
    stage.wrong(say_in("fipa-query", "inform ben>bro"));
    stage.right(say_in("fipa-query", "refuse cid>bro"));
    stage.right(broker("refuse bro>ann"));
    stage.right(say_in("fipa-request", "agree dan>bro"));
    stage.right(say_in("fipa-query", "query-if bro>eve"));
    assert_eq!(
        stage.check(&say_in("dance", "cfp bro>eve")),
        Verdict::Unchecked(Unchecked::UnknownProtocol)
    );
    stage.right(broker("failure bro>ann"));
    assert_eq!(stage.wrong(broker("inform bro>ann")).kind, Kind::Ended);
    assert_eq!(
        stage.monitor.len(),
        4,
        "eve came into the query that was there"
    );
    stage.pass(100_000);
    assert!(
        stage.monitor.is_empty(),
        "removed with its embedded conversations"
    );
}

#[test]
fn a_bid_that_crosses_the_next_call_is_late_and_no_violation() {
    let auction = |words| say_in("fipa-auction-english", words);
    let call = |text| auction("cfp auc>ben").reply_with(text);
    let bid = |text| auction("propose ben>auc").in_reply_to(text);
    for name in [None, Some("auc")] {
        let mut stage = Stage::new(match name {
            None => Monitor::observer(library()),
            Some(name) => Monitor::agent(library(), name),
        });
        stage.right(auction("inform auc>ben"));
        stage.right(call("10"));
        stage.right(call("20"));
        assert_eq!(stage.wrong(bid("5")).kind, Kind::WrongReply);
        let late = bid("10");
        let Verdict::Accepted(accepted) = stage.check(&late) else {
            panic!();
        };
        assert_eq!((accepted.state, accepted.late), ("called", true));
        assert!(accepted.void);
        // The bid was void: it cannot be accepted, and the last call can still be answered.
        stage.wrong(auction("accept-proposal auc>ben"));
        assert_eq!(stage.right(bid("20")), "bidding");
    }
    // The bidder has received the last call, or the call arrives after the bid was sent.
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    stage.right(auction("inform auc>ben"));
    stage.right(call("10"));
    stage.right(call("20"));
    assert_eq!(stage.wrong(bid("10")).kind, Kind::WrongReply);
    stage.right(bid("20"));
    assert_eq!(stage.right(call("30")), "called");
    stage.right(bid("30"));
    assert_eq!(stage.right(auction("inform auc>ben")), "closed");
}

#[test]
fn ended_and_abandoned_conversations_are_removed() {
    let mut stage = Stage::observer();
    for id in ["done", "open", "won"] {
        stage.right(request("request ann>ben").conversation_id(id));
    }
    stage.right(request("inform ben>ann").conversation_id("done"));
    stage.pass(60);
    assert_eq!(stage.monitor.len(), 3);
    assert_eq!(stage.pass(1), []);
    assert_eq!(stage.monitor.len(), 2);
    let abandoned = |id: &str| Event::Abandoned {
        protocol: "fipa-request".into(),
        conversation_id: id.into(),
    };
    stage.pass(80_000);
    stage.right(request("agree ben>ann").conversation_id("won"));
    assert_eq!(stage.pass(20_000), [abandoned("open")]);
    // The monitor does not know a conversation that it has removed before its end.
    let late = request("agree ben>ann").conversation_id("open");
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    assert_eq!(stage.check(&late), unknown);
    let ended = request("agree ben>ann").conversation_id("done");
    assert_eq!(stage.wrong(ended).kind, Kind::NotOpened);
    assert_eq!(stage.pass(80_000), [abandoned("won")]);
    assert!(stage.monitor.is_empty());
    assert_eq!(stage.monitor.poll_timeout(), None);
}

#[test]
fn the_limits_are_enforced() {
    let mut limits = MonitorLimits::default();
    (limits.conversations, limits.participants, limits.embedded) = (3, 4, 2);
    let mut stage = Stage::new(Monitor::observer(library()).with_limits(limits));
    for id in ["1", "2", "3"] {
        stage.right(request("request ann>ben").conversation_id(id));
    }
    stage.right(request("inform ben>ann").conversation_id("2"));
    stage.right(request("request ann>ben").conversation_id("4"));
    assert_eq!(
        (stage.monitor.len(), stage.monitor.forgotten()),
        (3, 0),
        "2 was over"
    );
    // A message that begins no conversation evicts none.
    stage.wrong(request("agree ann>ben").conversation_id("5"));
    assert_eq!(stage.monitor.forgotten(), 0);
    stage.right(request("request ann>ben").conversation_id("5"));
    assert_eq!(stage.monitor.forgotten(), 1, "1 was the oldest");
    stage.right(request("agree ben>ann").conversation_id("3"));
    assert_eq!(
        stage.check(&request("agree ben>ann").conversation_id("1")),
        Verdict::Unchecked(Unchecked::UnknownHistory)
    );
    // Participants.
    stage.right(say("cfp ann>1,2,3"));
    stage.right(say("cfp ann>4"));
    assert_eq!(stage.wrong(say("cfp ann>5")).kind, Kind::TooMany);
    let id = "all at once";
    stage.right(say("cfp ann>1,2,3,4").conversation_id(id));
    let more = say("cfp ann>1,2,3,4,5").conversation_id("too many");
    let too_large = Verdict::Unchecked(Unchecked::TooLarge);
    assert_eq!(stage.check(&more), too_large);
    // Embedded conversations.
    let mut stage = Stage::new(Monitor::observer(library()).with_limits({
        limits.conversations = 100;
        limits
    }));
    stage.right(say_in("fipa-brokering", "proxy ann>bro"));
    stage.right(say_in("fipa-brokering", "agree bro>ann"));
    for _ in 0..2 {
        stage.right(request("request bro>ben"));
        stage.right(request("inform ben>bro"));
    }
    assert_eq!(stage.wrong(request("request bro>ben")).kind, Kind::TooMany);
}
