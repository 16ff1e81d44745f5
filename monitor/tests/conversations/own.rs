//! Monitors of one agent: a message that the monitor cannot check is no violation.

use super::*;

#[test]
fn an_agents_monitor_ignores_the_other_receivers_of_a_message() {
    let iterated = |words| say_in("fipa-iterated-contract-net", words);
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    stage.right(iterated("cfp ann>ben,cid"));
    stage.right(iterated("propose ben>ann"));
    // Only ann knows whether cid has proposed too.
    assert_eq!(stage.right(iterated("cfp ann>cid,ben")), "called");
    assert_eq!(
        stage.wrong(iterated("cfp ann>ben,cid")).kind,
        Kind::OutOfOrder
    );
    let mut stage = Stage::observer();
    stage.right(iterated("cfp ann>ben,cid"));
    stage.right(iterated("propose ben>ann"));
    assert_eq!(
        stage.wrong(iterated("cfp ann>cid,ben")).kind,
        Kind::OutOfOrder
    );
}

#[test]
fn answers_of_recruited_agents_are_not_checked_for_the_initiator() {
    let recruit = |words| say_in("fipa-recruiting", words);
    let mut stage = Stage::new(Monitor::agent(library(), "ann"));
    stage.right(recruit("proxy ann>rec"));
    let answer = || say_in("fipa-query", "inform ben>ann");
    // No agent can have been asked yet.
    assert_eq!(stage.wrong(answer()).kind, Kind::WrongProtocol);
    stage.right(recruit("agree rec>ann"));
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    assert_eq!(stage.check(&answer()), elsewhere);
    stage.right(recruit("inform rec>ann"));
    assert_eq!(stage.check(&answer()), elsewhere);
    // A participant of the recruiting is no stranger.
    let known = stage.wrong(say_in("fipa-query", "inform rec>ann"));
    assert_eq!(known.kind, Kind::NotOpened);
    // The inform may answer a cancel, so the state is unknown.
    let own = say_in("fipa-query", "query-ref ann>ben");
    assert_eq!(stage.check(&own), elsewhere);
    let own = stage.wrong(request("request ann>ben"));
    assert_eq!(own.kind, Kind::WrongProtocol);
    // The recruiter itself has begun all embedded conversations.
    let mut stage = Stage::new(Monitor::agent(library(), "rec"));
    stage.right(recruit("proxy ann>rec"));
    stage.right(recruit("agree rec>ann"));
    let stranger = stage.wrong(say_in("fipa-query", "inform ben>rec"));
    assert_eq!(stranger.kind, Kind::WrongProtocol);
}

#[test]
fn answers_are_not_checked_for_an_agent_that_a_reply_to_names() {
    // Only ann and ben know that dan receives the answers.
    let mut stage = Stage::new(Monitor::agent(library(), "dan"));
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    for words in ["agree ben>dan", "agree ben>dan", "not-understood cid>dan"] {
        assert_eq!(stage.check(&say_in("fipa-query", words)), elsewhere);
    }
    // It follows the earlier message of ben, or answers a cancel of ann.
    let answer = say_in("fipa-query", "inform ben>dan");
    let Verdict::Accepted(accepted) = stage.check(&answer) else {
        panic!("it follows the earlier message of ben");
    };
    assert_eq!((accepted.state, accepted.elsewhere), ("elsewhere", true));
    let bid = say_in("fipa-contract-net", "propose ben>dan");
    assert_eq!(stage.check(&bid.conversation_id("d")), elsewhere);
    assert_eq!(stage.monitor.len(), 2);
    let mut stage = Stage::new(Monitor::agent(library(), "dan"));
    // Not an answer in any state, or only a message of the initiator, or a message of dan.
    for (protocol, words) in [
        ("fipa-query", "propose ben>dan"),
        ("fipa-query", "inform dan>ben"),
    ] {
        let wrong = stage.wrong(say_in(protocol, words));
        assert_eq!(wrong.kind, Kind::NotOpened, "{words}");
    }
    // It may answer these.
    assert_eq!(
        stage.check(&say_in("fipa-query", "not-understood dan>ben")),
        Verdict::Unchecked(Unchecked::AnswersViolation)
    );
    // Another agent may have named dan in a reply-to, or dan has forgotten the conversation.
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    for (protocol, words) in [
        ("fipa-query", "cancel ben>dan"),
        ("fipa-contract-net", "accept-proposal ben>dan"),
    ] {
        let header = say_in(protocol, words).conversation_id("e");
        assert_eq!(stage.check(&header), unknown, "{words}");
    }
    // So its answer is not checked either.
    let answer = say_in("fipa-contract-net", "inform dan>ben").conversation_id("e");
    assert_eq!(stage.check(&answer), unknown);
    // A message that begins a conversation is checked.
    stage.right(say_in("fipa-query", "query-ref ben>dan"));
    let wrong = stage.wrong(say_in("fipa-query", "inform ben>dan"));
    assert_eq!(wrong.kind, Kind::WrongSender);
    // An observer sees the beginning of every conversation.
    let mut stage = Stage::observer();
    let wrong = stage.wrong(say_in("fipa-query", "inform ben>dan"));
    assert_eq!(wrong.kind, Kind::NotOpened);
}

#[test]
fn after_a_restart_a_failure_may_answer_a_cancel_of_before() {
    let subscribe = |words| say_in("fipa-subscribe", words);
    let joined = || {
        let monitor = Monitor::agent(library(), "ben").with_history(History::Unknown);
        let mut stage = Stage::new(monitor);
        let agree = subscribe("agree dan>ben").reply_with("2").in_reply_to("1");
        stage.check(&agree);
        stage
    };
    let mut stage = joined();
    let answer = subscribe("failure dan>ben").in_reply_to("unseen");
    assert_eq!(stage.right(answer), "elsewhere");
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    let informed = subscribe("inform dan>ben").reply_with("3");
    assert_eq!(stage.check(&informed), elsewhere);
    assert_eq!(stage.check(&subscribe("cancel ben>dan")), elsewhere);
    // The agent knows its own cancel.
    let mut stage = joined();
    assert_eq!(stage.right(subscribe("cancel ben>dan")), "cancelling");
    assert_eq!(stage.right(subscribe("inform dan>ben")), "cancelled");
}
