//! Rules about several participants: `at-most` and `when`.

use super::*;

fn auction(words: &'static str) -> Header<'static> {
    say_in("fipa-auction-english", words)
}

/// Two bids for one call.
fn bids(monitor: Monitor) -> Stage {
    let mut stage = Stage::new(monitor);
    for words in [
        "inform auc>ben,cid",
        "cfp auc>ben,cid",
        "propose ben>auc",
        "propose cid>auc",
    ] {
        stage.right(auction(words));
    }
    stage
}

#[test]
fn a_round_of_an_english_auction_has_one_winner() {
    for monitor in [
        Monitor::observer(library()),
        Monitor::agent(library(), "auc"),
    ] {
        let mut stage = bids(monitor);
        let both = stage.wrong(auction("accept-proposal auc>ben,cid"));
        assert_eq!(both.kind, Kind::Guard);
        stage.right(auction("accept-proposal auc>ben"));
        let second = stage.wrong(auction("accept-proposal auc>cid"));
        assert_eq!(second.kind, Kind::Guard);
        assert_eq!(second.participant.as_deref(), Some("ben"));
        assert_eq!(second.state.as_deref(), Some("leading"));
        stage.right(auction("reject-proposal auc>cid"));
        // Another bidder wins the next round.
        stage.right(auction("cfp auc>ben,cid"));
        stage.right(auction("propose cid>auc"));
        stage.right(auction("accept-proposal auc>cid"));
    }
}

/// Ricart and Agrawala's mutual exclusion: the section is entered when all agree.
const LOCK: &str = r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol" f:scope="participant">
    <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
    <state id="2"><transition performative="agree" from="b" to="a" target="3"/>
        <transition performative="refuse" from="b" to="a" target="5"/></state>
    <state id="3"><transition performative="confirm" from="a" to="b" target="4" f:when="all"/></state>
    <state id="4"><transition performative="inform" from="a" to="b" target="5"/></state>
    <state id="5" final="yes"/></scxml>"#;

fn locking(monitor: impl FnOnce(Arc<Library>) -> Monitor) -> Stage {
    Stage::new(monitor(library_with("lock", LOCK)))
}

fn lock(words: &'static str) -> Header<'static> {
    say_in("lock", words)
}

#[test]
fn a_transition_may_need_all_participants() {
    let mut stage = locking(Monitor::observer);
    stage.right(lock("request ann>ben,cid,dan"));
    stage.right(lock("agree ben>ann"));
    stage.right(lock("agree cid>ann"));
    let early = stage.wrong(lock("confirm ann>ben"));
    assert_eq!(early.kind, Kind::Guard);
    assert_eq!(early.participant.as_deref(), Some("dan"));
    let text = early.to_string();
    assert!(
        text.contains("the states of the other participants"),
        "{text}"
    );
    stage.right(lock("agree dan>ann"));
    stage.right(lock("confirm ann>ben"));
    stage.right(lock("confirm ann>cid,dan"));
}

#[test]
fn a_refusal_blocks_a_transition_that_needs_all_and_a_lost_participant_does_not() {
    let mut stage = locking(Monitor::observer);
    stage.right(lock("request ann>ben,cid"));
    stage.right(lock("agree ben>ann"));
    stage.right(lock("refuse cid>ann"));
    assert_eq!(stage.wrong(lock("confirm ann>ben")).kind, Kind::Guard);
    let mut stage = locking(Monitor::observer);
    let ask = lock("request ann>ben,cid").reply_with("q");
    stage.right(ask.clone());
    stage.right(lock("agree ben>ann"));
    let now = stage.now;
    stage.monitor.undelivered(&ask, "cid", now);
    stage.right(lock("confirm ann>ben"));
}

#[test]
fn a_participant_knows_only_its_own_state() {
    let mut stage = locking(|library| Monitor::agent(library, "ben"));
    stage.right(lock("request ann>ben,cid"));
    stage.right(lock("agree ben>ann"));
    assert_eq!(stage.right(lock("confirm ann>ben,cid")), "4");
    // An initiator whose answers go to another agent does not know the states.
    let mut stage = locking(|library| Monitor::agent(library, "ann"));
    stage.right(lock("request ann>ben,cid").reply_to(["dan"]));
    stage.right(lock("agree ben>ann"));
    stage.right(lock("confirm ann>ben"));
}

#[test]
fn guards_are_attributes_of_transitions_with_a_state_per_participant() {
    let machine = Machine::read("lock", LOCK).unwrap();
    let guarded = &machine.states()[2].transitions()[0];
    assert!(guarded.needs_all() && guarded.at_most().is_none());
    let library = library();
    let english = library.find("fipa-auction-english").unwrap();
    let all = english
        .states()
        .iter()
        .flat_map(|state| state.transitions());
    assert_eq!(
        all.filter_map(|step| step.at_most()).collect::<Vec<_>>(),
        [1, 1]
    );
    for (from, to, problem) in [
        (r#"f:when="all""#, r#"f:when="any""#, "expected all"),
        (r#"f:when="all""#, r#"f:at-most="0""#, "expected a number"),
        (r#"f:scope="participant""#, "", "require scope"),
    ] {
        let wrong = Machine::read("lock", &LOCK.replace(from, to)).unwrap_err();
        assert!(wrong.to_string().contains(problem), "{wrong}");
    }
}

#[test]
fn a_message_that_crosses_a_cancel_reaches_no_guarded_state() {
    let text = r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol" f:scope="participant" f:cancel="anyone">
        <state id="1"><transition performative="cfp" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="propose" from="b" to="a" target="3"/></state>
        <state id="3"><transition performative="accept-proposal" from="a" to="b" target="4" f:at-most="1"/></state>
        <state id="4" final="yes"/></scxml>"#;
    let own = |words| say_in("own", words);
    let mut stage = Stage::new(Monitor::observer(library_with("own", text)));
    stage.right(own("cfp ann>ben,cid"));
    for words in ["propose ben>ann", "propose cid>ann"] {
        stage.right(own(words));
    }
    for words in ["cancel ben>ann", "cancel cid>ann"] {
        assert_eq!(stage.right(own(words)), "cancelling");
    }
    assert_eq!(stage.right(own("accept-proposal ann>ben")), "cancelling");
}
