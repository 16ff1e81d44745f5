//! Protocols with three or more roles: their projections, the defects of others, and the monitors of
//! their agents.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fastrand::Rng;
use fipa_acl::Performative;
use fipa_monitor::projection::{Defect, Local, Projection};
use fipa_monitor::{
    Header, History, Library, Machine, Monitor, Scope, Unchecked, Verdict, ViolationKind as Kind,
};

/// Docking of a drone at a station, which a mediator arranges.
const DOCKING: &str = r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol">
    <state id="1"><transition performative="request" from="drone" to="mediator" target="2"/></state>
    <state id="2">
        <transition performative="query-if" from="mediator" to="station" target="3"/>
        <transition performative="refuse" from="mediator" to="drone" target="done"/>
    </state>
    <state id="3">
        <transition performative="confirm" from="station" to="mediator" target="4"/>
        <transition performative="disconfirm" from="station" to="mediator" target="5"/>
    </state>
    <state id="4"><transition performative="agree" from="mediator" to="drone" target="6"/></state>
    <state id="5"><transition performative="refuse" from="mediator" to="drone" target="done"/></state>
    <state id="6"><transition performative="inform" from="drone" to="station" target="7"/></state>
    <state id="7"><transition performative="inform" from="station" to="mediator" target="8"/></state>
    <state id="8"><transition performative="inform" from="mediator" to="drone" target="done"/></state>
    <state id="done" final="yes"/></scxml>"#;

fn machine(text: &str) -> Machine {
    Machine::read("own", text).unwrap()
}

/// The standard protocols and this one.
fn library_with(machine: Machine) -> Arc<Library> {
    let mut library = Library::standard();
    library.add(machine).unwrap();
    Arc::new(library)
}

/// The states and messages of a projection: `state: act from>to`.
fn shown(local: &Local) -> Vec<String> {
    let states = local.states().iter();
    let shown = states.flat_map(|state| {
        state.steps().iter().map(|step| {
            format!(
                "{}: {} {}>{} {}",
                state.names().join("|"),
                step.performative(),
                local.from(step),
                local.to(step),
                local.states()[step.target()].names().join("|")
            )
        })
    });
    shown.collect()
}

#[test]
fn a_projection_hides_the_messages_of_other_roles() {
    let docking = machine(DOCKING);
    let projection = docking.projection().unwrap();
    let roles: Vec<&str> = projection.locals().iter().map(Local::role).collect();
    assert_eq!(roles, ["drone", "mediator", "station"]);
    assert_eq!(
        shown(&projection.locals()[2]),
        [
            "1|2|done: query-if mediator>station 3",
            "3: confirm station>mediator 4|6",
            "3: disconfirm station>mediator 5|done",
            "4|6: inform drone>station 7",
            "7: inform station>mediator 8|done",
        ]
    );
    // Only the message of the drone to the station is hidden from the mediator.
    let mediator = projection.locals()[1].states().len();
    assert_eq!(mediator, docking.states().len() - 1);
    assert_eq!(Projection::defects(&docking), []);
    // The state of a station that was not asked may be the last one.
    assert!(projection.locals()[2].states()[0].is_final());
    assert!(!projection.locals()[0].states()[0].is_final());
}

#[test]
fn all_standard_protocols_are_inside_the_class() {
    for machine in Library::standard().iter() {
        // Its answers have any receivers. It has one role, and is checked as a whole.
        if machine.name() == "dlm_discover" {
            continue;
        }
        assert_eq!(Projection::defects(machine), [], "{}", machine.name());
        assert!(machine.scope() == Scope::Participant || machine.projection().is_some());
    }
}

fn defects(states: &str) -> Vec<Defect> {
    let machine = machine(&format!(r#"<scxml initial="1">{states}</scxml>"#));
    let defects = Projection::defects(&machine);
    assert_eq!(machine.projection().is_none(), !defects.is_empty());
    defects
}

#[test]
fn a_role_that_is_not_told_cannot_know_when_to_speak() {
    let found = defects(
        r#"<state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="c" to="a" target="3"/></state>
        <state id="3"><transition performative="confirm" from="a" to="c" target="4"/></state>
        <state id="4" final="yes"/>"#,
    );
    let not_told = Defect::NotTold {
        role: "c".into(),
        performative: "inform".into(),
        state: "2".into(),
        other: "1".into(),
    };
    assert!(found.contains(&not_told), "{found:?}");
    let text = not_told.to_string();
    assert!(
        text.starts_with("c cannot know when to send inform"),
        "{text}"
    );
}

#[test]
fn two_roles_must_not_decide_the_same_choice() {
    let found = defects(
        r#"<state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="request" from="b" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="b" target="4"/>
            <transition performative="refuse" from="b" to="c" target="4"/></state>
        <state id="4" final="yes"/>"#,
    );
    let mixed = Defect::MixedChoice {
        state: "3".into(),
        one: "c".into(),
        other: "b".into(),
    };
    assert!(found.contains(&mixed), "{found:?}");
    // Both messages wait for a receiver that has gone on.
    let crossed = |defect: &Defect| matches!(defect, Defect::Unexpected { .. });
    assert!(found.iter().any(crossed), "{found:?}");
    // Independent messages are no choice.
    let none = defects(
        r#"<state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="b" to="a" target="3"/>
            <transition performative="request" from="a" to="c" target="4"/></state>
        <state id="3"><transition performative="request" from="a" to="c" target="5"/></state>
        <state id="4"><transition performative="inform" from="b" to="a" target="5"/></state>
        <state id="5" final="yes"/>"#,
    );
    assert_eq!(none, []);
}

#[test]
fn messages_of_two_roles_may_cross() {
    let crossing = machine(
        r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="b" to="a" target="3"/>
            <transition performative="confirm" from="a" to="b" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#,
    );
    assert_eq!(Projection::defects(&crossing), []);
}

#[test]
fn a_choice_that_a_waiting_role_is_not_told_is_a_deadlock() {
    let found = defects(
        r#"<state id="1"><transition performative="request" from="a" to="b" target="2"/>
            <transition performative="propose" from="a" to="b" target="3"/></state>
        <state id="2"><transition performative="request" from="b" to="c" target="4"/></state>
        <state id="3"><transition performative="request" from="b" to="c" target="5"/></state>
        <state id="4"><transition performative="agree" from="c" to="b" target="6"/></state>
        <state id="5"><transition performative="refuse" from="c" to="b" target="6"/></state>
        <state id="6" final="yes"/>"#,
    );
    // The station is told the same in both cases, and may answer with the wrong one.
    assert!(
        found
            .iter()
            .any(|defect| matches!(defect, Defect::NotTold { role, .. } if role == "c")),
        "{found:?}"
    );
    let unexpected = |defect: &Defect| matches!(defect, Defect::Unexpected { from, to, .. } if from == "c" && to == "b");
    assert!(found.iter().any(unexpected), "{found:?}");
    let text = r#"<state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from=".*" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="a" target="4"/></state>
        <state id="4" final="yes"/>"#;
    let found = defects(text);
    assert!(
        matches!(&found[..], [Defect::Pattern { what: "from", .. }]),
        "{found:?}"
    );
}

/// The pairs of equal defects.
fn repeated(found: &[Defect]) -> usize {
    let after = |at: usize| found.iter().skip(at + 1);
    let equal = found.iter().enumerate();
    equal
        .map(|(at, one)| after(at).filter(|other| *other == one).count())
        .sum()
}

#[test]
fn few_defects_of_an_exploration_are_reported_once() {
    // The queries wait for a receiver that has gone on.
    let acts =
        "agree|refuse|propose|confirm|disconfirm|failure|inform-if|inform-ref|query-if|query-ref";
    let text = |acts| {
        format!(
            r#"<state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="{acts}" from="a" to="b" target="3"/>
                <transition performative="inform" from="b" to="c" target="4"/></state>
            <state id="3" final="yes"/><state id="4" final="yes"/>"#
        )
    };
    for (acts, count) in [("agree|refuse", 2), (acts, 8)] {
        let found = defects(&text(acts));
        let waits = |defect: &&Defect| matches!(defect, Defect::Unexpected { .. });
        assert_eq!(found.iter().filter(waits).count(), count, "{found:?}");
        assert_eq!(repeated(&found), 0, "{found:?}");
    }
}

#[test]
fn roles_that_take_crossing_messages_for_different_choices_wait_for_ever() {
    let found = defects(
        r#"<state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="confirm" from="a" to="b" target="3"/>
            <transition performative="inform" from="b" to="a" target="4"/></state>
        <state id="3"><transition performative="inform" from="b" to="a" target="5"/></state>
        <state id="4"><transition performative="confirm" from="a" to="b" target="6"/></state>
        <state id="5"><transition performative="query-if" from="a" to="c" target="7"/></state>
        <state id="6"><transition performative="refuse" from="a" to="b" target="7"/></state>
        <state id="7" final="yes"/>"#,
    );
    let waiting = vec![("b".to_owned(), "6".to_owned())];
    let deadlock = Defect::Deadlock { waiting };
    assert!(found.contains(&deadlock), "{found:?}");
    assert_eq!(deadlock.to_string(), r#"deadlock: b waits in state "6""#);
    let waiting = [("b", "6"), ("c", "5")].map(|(role, state)| (role.into(), state.into()));
    let both = Defect::Deadlock {
        waiting: waiting.into(),
    };
    let text = r#"deadlock: b waits in state "6", c waits in state "5""#;
    assert_eq!(both.to_string(), text);
}

/// Each agent has a clock, so that a timeout counts as told.
#[test]
fn a_timeout_may_lead_to_a_state_that_no_message_shows() {
    let text = r#"<scxml initial="1" xmlns:f="urn:fipa-rs:protocol">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="b" to="c" target="3"/>
            <transition f:after="10s" target="4"/></state>
        <state id="3"><transition performative="agree" from="c" to="a" target="6"/></state>
        <state id="4"><transition performative="refuse" from="b" to="c" target="5"/>
            <transition f:after="10s" target="3"/></state>
        <state id="5"><transition performative="failure" from="a" to="c" target="6"/></state>
        <state id="6" final="yes"/></scxml>"#;
    let timed = machine(text);
    let projection = timed.projection().unwrap();
    assert_eq!(
        shown(&projection.locals()[0]),
        [
            "1: request a>b 2|3|4|5",
            "2|3|4|5: agree c>a 6",
            "2|3|4|5: failure a>c 6",
        ]
    );
    assert_eq!(
        shown(&projection.locals()[1]),
        [
            "1: request a>b 2|3|4|6",
            "2|3|4|6: inform b>c 3|6",
            "2|3|4|6: refuse b>c 5|6",
        ]
    );
    let mut ann = stage_with(timed, "ann");
    ann.right(&["request ann>ben", "failure ann>cid"]);
}

struct Stage {
    monitor: Monitor,
    now: SystemTime,
}

/// The monitor of an agent in the docking protocol.
fn stage(agent: &str) -> Stage {
    stage_with(machine(DOCKING), agent)
}

/// The monitor of an agent in this protocol.
fn stage_with(machine: Machine, agent: &str) -> Stage {
    Stage {
        monitor: Monitor::agent(library_with(machine), agent),
        now: SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000),
    }
}

/// The message and its receiver.
fn header_of(words: &'static str) -> (Header<'static>, &'static str) {
    let (act, agents) = words.split_once(' ').unwrap();
    let (from, to) = agents.split_once('>').unwrap();
    let header = Header::new(act.parse().unwrap())
        .sender(from)
        .receivers([to])
        .protocol("own")
        .conversation_id("c");
    (header, to)
}

impl Stage {
    fn check(&mut self, words: &'static str) -> Verdict<'_> {
        self.monitor.check(&header_of(words).0, self.now)
    }

    fn right(&mut self, all: &[&'static str]) {
        for words in all {
            let verdict = self.check(words);
            assert!(verdict.is_accepted(), "{words}: {verdict:?}");
        }
    }

    /// A message of the agent was not delivered.
    fn lost(&mut self, words: &'static str) {
        let (header, receiver) = header_of(words);
        self.monitor.undelivered(&header, receiver, self.now);
    }

    fn wrong(&mut self, words: &'static str) -> Kind {
        let verdict = self.check(words);
        verdict
            .violation()
            .unwrap_or_else(|| panic!("{words}: {verdict:?}"))
            .kind
    }
}

#[test]
fn each_agent_checks_what_it_sees() {
    // The station was not told the first message.
    let mut station = stage("sta");
    station.right(&["query-if med>sta"]);
    assert_eq!(station.wrong("inform sta>med"), Kind::Unexpected);
    assert_eq!(station.wrong("agree med>sta"), Kind::Unexpected);
    station.right(&["confirm sta>med"]);
    let now = station.now;
    let wrong = station.monitor.check(&header_of("agree med>sta").0, now);
    assert_eq!(wrong.violation().unwrap().state.as_deref(), Some("4"));
    // It does not know the drone yet, but the mediator is not the drone.
    assert_eq!(station.wrong("inform med>sta"), Kind::Unexpected);
    station.right(&["inform dro>sta"]);
    assert_eq!(station.wrong("inform sta>dro"), Kind::Unexpected);
    station.right(&["inform sta>med"]);
    assert_eq!(station.wrong("inform sta>med"), Kind::Ended);
    let mut drone = stage("dro");
    for (words, opened) in [("request dro>med", true), ("agree med>dro", false)] {
        let Verdict::Accepted(accepted) = drone.check(words) else {
            panic!("{words}");
        };
        assert_eq!(accepted.opened, opened, "{words}");
    }
    let mut drone = stage("dro");
    drone.right(&["request dro>med"]);
    assert_eq!(drone.wrong("inform dro>sta"), Kind::Unexpected);
    drone.right(&["agree med>dro", "inform dro>sta", "inform med>dro"]);
    let mut mediator = stage("med");
    mediator.right(&["request dro>med", "query-if med>sta", "disconfirm sta>med"]);
    assert_eq!(mediator.wrong("agree med>dro"), Kind::Unexpected);
    mediator.right(&["refuse med>dro"]);
    assert_eq!(mediator.monitor.len(), 1);
    mediator.now += Duration::from_secs(100);
    mediator.monitor.handle_timeout(mediator.now);
    assert!(mediator.monitor.is_empty(), "it is over");
}

#[test]
fn a_message_may_overtake_one_of_another_sender() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="request" from="a" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="b" target="4"/></state>
        <state id="4"><transition performative="agree" from="b" to="a" target="5"/></state>
        <state id="5" final="yes"/></scxml>"#;
    let mut stage = stage_with(machine(text), "ben");
    // The inform of cid overtakes the request of ann.
    stage.right(&["inform cid>ben"]);
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    assert_eq!(stage.check("agree ben>ann"), unknown);
    stage.right(&["request ann>ben"]);
    stage.right(&["agree ben>ann"]);
    assert_eq!(stage.wrong("inform cid>ben"), Kind::Ended);
}

#[test]
fn the_rules_of_all_protocols_and_unknown_history_apply() {
    let mut drone = stage("dro");
    drone.right(&["request dro>med", "not-understood med>dro"]);
    assert_eq!(drone.wrong("inform dro>sta"), Kind::Ended);
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    let mut drone = stage("dro");
    drone.right(&["request dro>med"]);
    assert_eq!(drone.check("cancel dro>med"), elsewhere);
    // The agent may have restarted.
    let mut drone = stage("dro");
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    assert_eq!(drone.wrong("inform dro>sta"), Kind::NotOpened);
    assert_eq!(drone.wrong("subscribe med>dro"), Kind::NotOpened);
    assert_eq!(drone.check("confirm med>dro"), unknown);
    let mut drone = stage("dro");
    drone.monitor = drone.monitor.with_history(History::Unknown);
    assert_eq!(drone.check("inform dro>sta"), unknown);
}

#[test]
fn an_undelivered_message_can_be_sent_again() {
    let mut drone = stage("dro");
    drone.right(&["request dro>med"]);
    assert_eq!(drone.wrong("request dro>med"), Kind::Unexpected);
    drone.lost("request dro>med");
    drone.right(&["request dro>med"]);
    drone.lost("request dro>med");
    // It had arrived after all.
    drone.right(&["agree med>dro"]);
    assert_eq!(drone.wrong("request dro>med"), Kind::Unexpected);
    // An answered message has arrived.
    drone.lost("request dro>med");
    assert_eq!(drone.wrong("request dro>med"), Kind::Unexpected);
    // The mediator knows that the station has the message.
    drone.right(&["inform dro>sta", "inform med>dro"]);
    drone.lost("inform dro>sta");
    assert_eq!(drone.wrong("inform dro>sta"), Kind::Ended);
    // Another station has the role instead.
    let mut mediator = stage("med");
    mediator.right(&["request dro>med", "query-if med>sta"]);
    assert_eq!(mediator.wrong("query-if med>old"), Kind::WrongReceiver);
    mediator.lost("query-if med>sta");
    mediator.right(&["query-if med>old"]);
    assert_eq!(mediator.wrong("confirm sta>med"), Kind::Stranger);
    mediator.right(&["confirm old>med", "agree med>dro"]);
    mediator.lost("agree med>dro");
    mediator.right(&["agree med>dro"]);
    // A `not-understood` that was not delivered ends nothing.
    mediator.right(&["not-understood med>old"]);
    assert_eq!(mediator.wrong("agree med>dro"), Kind::Ended);
    mediator.lost("not-understood med>old");
    mediator.right(&["inform old>med", "inform med>dro"]);
    // Reports about other messages than the last one take nothing back.
    let mut drone = stage("dro");
    drone.right(&["request dro>med", "agree med>dro", "inform dro>sta"]);
    drone.lost("request dro>med");
    assert_eq!(drone.wrong("inform dro>sta"), Kind::Unexpected);
    let (header, receiver) = header_of("inform dro>sta");
    let now = drone.now;
    let other = header.reply_with("other");
    drone.monitor.undelivered(&other, receiver, now);
    assert_eq!(drone.wrong("inform dro>sta"), Kind::Unexpected);
    drone.lost("inform dro>sta");
    drone.right(&["inform dro>sta", "inform med>dro"]);
}

#[test]
fn a_message_of_another_role_leaves_the_last_one_open() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="request" from="a" to="c" target="3"/>
            <transition performative="inform" from="b" to="a" target="4"/></state>
        <state id="3"><transition performative="inform" from="b" to="a" target="5"/></state>
        <state id="4"><transition performative="request" from="a" to="c" target="5"/></state>
        <state id="5" final="yes"/></scxml>"#;
    let joint = machine(text);
    assert!(joint.projection().is_some());
    let mut stage = stage_with(joint, "ann");
    stage.right(&["request ann>ben", "request ann>cid", "inform ben>ann"]);
    stage.lost("request ann>cid");
    stage.right(&["request ann>cid"]);
    assert_eq!(stage.wrong("request ann>cid"), Kind::Ended);
}

#[test]
fn an_agent_that_was_asked_to_take_one_role_may_claim_another() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="request" from="b" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="a" target="4"/></state>
        <state id="4" final="yes"/></scxml>"#;
    let asked = || {
        let mut stage = stage_with(machine(text), "ann");
        stage.right(&["request ann>ben"]);
        stage.lost("request ann>ben");
        stage
    };
    // Whether the request arrived is unknown if ben does not have the role c.
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    let mut ann = asked();
    ann.right(&["inform ben>ann"]);
    assert_eq!(ann.check("request ann>cid"), unknown);
    assert_eq!(ann.check("inform cid>ann"), unknown);
    // The agent that was asked of a role claims nothing with it.
    let mut drone = stage("dro");
    drone.right(&["request dro>med"]);
    drone.lost("request dro>med");
    drone.right(&["agree med>dro"]);
    assert_eq!(drone.wrong("request dro>med"), Kind::Unexpected);
}

#[test]
fn an_outsider_ends_no_conversation_of_roles() {
    for act in ["not-understood", "failure", "cancel"] {
        let mut mediator = stage("med");
        mediator.right(&["request dro>med", "query-if med>sta"]);
        let words: &'static str = format!("{act} mallory>med").leak();
        assert_eq!(mediator.wrong(words), Kind::Stranger, "{act}");
        mediator.right(&["confirm sta>med", "agree med>dro"]);
    }
    // Only the receiver of an undelivered message can answer it: it may have arrived.
    let mut drone = stage("dro");
    drone.right(&["request dro>med"]);
    drone.lost("request dro>med");
    assert_eq!(drone.wrong("refuse mallory>dro"), Kind::Unexpected);
    drone.right(&["request dro>med"]);
    drone.lost("request dro>med");
    drone.right(&["refuse med>dro"]);
    let mut drone = stage("dro");
    drone.right(&["request dro>med"]);
    drone.lost("request dro>med");
    drone.right(&["request dro>other", "refuse other>dro"]);
    // So it is with two receivers.
    let mut drone = stage("dro");
    let both = header_of("request dro>med").0.receivers(["med", "old"]);
    let now = drone.now;
    assert!(drone.monitor.check(&both, now).is_accepted());
    drone.monitor.undelivered(&both, "med", now);
    assert_eq!(drone.wrong("refuse mallory>dro"), Kind::Unexpected);
    drone.right(&["refuse old>dro"]);
    // An agent that sends the first message has its role, also if the message was not delivered.
    let mut drone = stage("dro");
    drone.right(&["request dro>med"]);
    drone.lost("request dro>med");
    drone.right(&["request mallory>dro", "request dro>med", "refuse med>dro"]);
    assert_eq!(drone.monitor.len(), 2);
    // With two conversations of one identifier, the message may belong to another one.
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    let mut drone = stage("dro");
    drone.right(&["request dro>med", "request mallory>dro"]);
    assert_eq!(drone.monitor.len(), 2);
    assert_eq!(drone.check("confirm med>dro"), unknown);
    // An answered message has arrived, so its receiver keeps the role.
    let mut drone = stage("dro");
    drone.right(&["request dro>med", "agree med>dro"]);
    drone.lost("request dro>med");
    drone.right(&["inform dro>sta"]);
    assert_eq!(drone.wrong("inform mallory>dro"), Kind::Stranger);
    drone.right(&["inform med>dro"]);
    // The station does not know the agent that is the drone.
    let mut station = stage("sta");
    station.right(&["query-if med>sta", "confirm sta>med", "inform dro>sta"]);
    assert_eq!(station.wrong("confirm sta>med"), Kind::Unexpected);
    let mut station = stage("sta");
    station.right(&["query-if med>sta", "confirm sta>med"]);
    station.lost("confirm sta>med");
    station.right(&["inform mallory>sta"]);
    assert_eq!(station.check("confirm sta>med"), unknown);
    let mut station = stage("sta");
    station.right(&["query-if med>sta", "confirm sta>med", "inform mallory>sta"]);
    assert_eq!(station.check("inform dro>sta"), unknown);
    station.right(&["inform sta>med"]);
    let mut station = stage("sta");
    station.right(&["query-if med>sta", "confirm sta>med", "inform mallory>sta"]);
    station.right(&["not-understood mallory>sta"]);
    assert_eq!(station.check("inform sta>med"), unknown);
    let mut station = stage("sta");
    station.right(&["query-if med>sta"]);
    let elsewhere = Verdict::Unchecked(Unchecked::BegunElsewhere);
    assert_eq!(station.check("not-understood mallory>sta"), elsewhere);
    station.right(&["confirm sta>med", "inform dro>sta", "inform sta>med"]);
}

#[test]
fn an_outsider_decides_no_role_of_an_agent() {
    // The agents ben and cid get the same first message.
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="request" from="a" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="b" target="4"/></state>
        <state id="4"><transition performative="agree" from="b" to="a" target="5"/></state>
        <state id="5" final="yes"/></scxml>"#;
    let stage = |agent| stage_with(machine(text), agent);
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    // The inform of the outsider would show that cid has the role b.
    for order in [
        ["inform mallory>cid", "request ann>cid"],
        ["request ann>cid", "inform mallory>cid"],
    ] {
        let mut cid = stage("cid");
        cid.right(&order);
        assert_eq!(cid.check("inform cid>ben"), unknown, "{order:?}");
    }
    // An agent that sends the message of a role has it.
    for order in [
        ["inform cid>ben", "request ann>ben"],
        ["request ann>ben", "inform cid>ben"],
    ] {
        let mut ben = stage("ben");
        ben.right(&order);
        ben.right(&["agree ben>ann"]);
        assert_eq!(ben.wrong("agree ben>ann"), Kind::Ended, "{order:?}");
    }
    let mut cid = stage("cid");
    cid.right(&["request ann>cid"]);
    assert_eq!(cid.wrong("confirm cid>ben"), Kind::Unexpected);
    // Both roles send an inform, so it does not show which one cid has.
    let both = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="request" from="a" to="c" target="3"/></state>
        <state id="3"><transition performative="propose" from="c" to="b" target="4"/></state>
        <state id="4"><transition performative="inform" from="b" to="a" target="5"/></state>
        <state id="5"><transition performative="confirm" from="a" to="c" target="6"/></state>
        <state id="6"><transition performative="inform" from="c" to="a" target="7"/></state>
        <state id="7"><transition performative="disconfirm" from="c" to="a" target="8"/></state>
        <state id="8" final="yes"/></scxml>"#;
    let mut cid = stage_with(machine(both), "cid");
    cid.right(&["request ann>cid", "propose mallory>cid", "inform cid>ann"]);
    assert_eq!(cid.check("disconfirm cid>ann"), unknown);
    // A message that comes too early for another role leaves the role certain.
    let early = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="query-ref" from="a" to="d" target="3"/></state>
        <state id="3"><transition performative="query-if" from="a" to="c" target="4"/></state>
        <state id="4"><transition performative="inform" from="c" to="d" target="5"/></state>
        <state id="5"><transition performative="inform" from="c" to="b" target="6"/></state>
        <state id="6"><transition performative="agree" from="b" to="a" target="7"/></state>
        <state id="7" final="yes"/></scxml>"#;
    let mut ben = stage_with(machine(early), "ben");
    ben.right(&["request ann>ben", "inform cid>ben"]);
    assert_eq!(ben.wrong("propose ben>ann"), Kind::Unexpected);
    // The second request to ben may be the first one again, or that to the role c.
    let mut ann = stage("ann");
    ann.right(&["request ann>ben"]);
    ann.lost("request ann>ben");
    ann.right(&["request ann>ben", "agree mallory>ann"]);
    assert_eq!(ann.check("request ann>cid"), unknown);
    assert_eq!(ann.check("agree ben>ann"), unknown);
}

/// Random runs of the roles with slow routes, undelivered messages, restarts and an intruder: no monitor
/// refuses a message.
#[test]
fn no_message_of_a_projected_protocol_is_refused() {
    let number = |name: &str| {
        std::env::var(name)
            .ok()
            .map(|text| text.parse::<u64>().unwrap())
    };
    let runs = number("FIPA_WALK_SEEDS").unwrap_or(2_000);
    // Two messages of the last role may overtake one of the first.
    let relay = |second| {
        format!(
            r#"<scxml initial="1">
            <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="{second}" from="a" to="c" target="3"/></state>
            <state id="3"><transition performative="inform" from="c" to="b" target="4"/></state>
            <state id="4"><transition performative="confirm" from="c" to="b" target="5"/></state>
            <state id="5"><transition performative="agree" from="b" to="a" target="6"/></state>
            <state id="6" final="yes"/></scxml>"#
        )
    };
    for (text, few) in [
        (DOCKING, 8),
        (&relay("query-if"), 16),
        // The first message does not show the role.
        (&relay("request"), 16),
    ] {
        let (said, lost, unchecked) = walk(&machine(text), runs);
        assert!(said > runs * 4 && lost > runs / 8 && unchecked > runs / few);
    }
}

/// Returns the numbers of messages, of undelivered ones and of unchecked ones.
fn walk(protocol: &Machine, runs: u64) -> (u64, u64, u64) {
    let locals = protocol.projection().unwrap().locals();
    let library = library_with(protocol.clone());
    let now = SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000);
    let names = ["dro", "med", "sta"];
    let (mut said, mut ended, mut lost, mut unchecked) = (0, 0, 0, 0);
    for seed in 0..runs {
        let mut rng = Rng::with_seed(seed);
        let mut monitors = names.map(|name| Monitor::agent(Arc::clone(&library), name));
        // In every second run, monitors restart, evict conversations and get messages of an intruder.
        let disturbed = seed % 2 == 1;
        let mut log = Vec::new();
        let mut states = [0; 3];
        let mut queues: Vec<VecDeque<String>> = vec![VecDeque::new(); 9];
        let mut idle = 0;
        while idle < 600 {
            idle += 1;
            let role = rng.usize(..3);
            if disturbed && rng.u8(..) < 3 {
                let monitor = Monitor::agent(Arc::clone(&library), names[role]);
                monitors[role] = monitor.with_history(History::Unknown);
                log.push(format!("restart of {}", names[role]));
            } else if disturbed && rng.u8(..) < 6 {
                let act = rng.choice(&Performative::STANDARD).unwrap().clone();
                let header = Header::new(act).sender("mallory").receivers([names[role]]);
                let header = header.protocol("own").conversation_id("c");
                log.push(format!("{} mallory>{}", header.performative(), names[role]));
                monitors[role].check(&header, now);
            }
            let state = &locals[role].states()[states[role]];
            let Some(step) = rng.choice(state.steps()) else {
                continue;
            };
            let index = |name: &str| {
                locals
                    .iter()
                    .position(|local| local.role() == name)
                    .unwrap()
            };
            let (from, to) = (index(locals[role].from(step)), index(locals[role].to(step)));
            let queue = &mut queues[from * 3 + to];
            if from != role && queue.front().map(String::as_str) != Some(step.performative()) {
                continue;
            }
            let header = Header::new(step.performative().parse().unwrap())
                .sender(names[from])
                .receivers([names[to]])
                .protocol("own")
                .conversation_id("c");
            let verdict = monitors[role].check(&header, now);
            log.push(format!("{}: {}", names[role], header.performative()));
            let is_unchecked = disturbed && matches!(verdict, Verdict::Unchecked(_));
            assert!(
                verdict.is_accepted() || is_unchecked,
                "seed {seed}: {header:?}: {verdict:?}\n{log:#?}"
            );
            unchecked += u64::from(is_unchecked);
            if from == role && rng.u8(..) < 12 {
                monitors[role].undelivered(&header, names[to], now);
                lost += 1;
                continue;
            }
            let queue = &mut queues[from * 3 + to];
            match from == role {
                true => queue.push_back(step.performative().to_owned()),
                false => drop(queue.pop_front()),
            }
            states[role] = step.target();
            idle = 0;
            said += 1;
        }
        ended += usize::from(
            locals
                .iter()
                .zip(states)
                .all(|(local, at)| local.states()[at].is_final()),
        );
    }
    assert_eq!(ended as u64, runs);
    (said, lost, unchecked)
}

#[test]
fn early_messages_are_taken_in_the_order_of_their_senders() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="d" target="2"/></state>
        <state id="2"><transition performative="request" from="a" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="d" target="4"/></state>
        <state id="4"><transition performative="confirm" from="c" to="d" target="5"/></state>
        <state id="5"><transition performative="request" from="c" to="b" target="6"/></state>
        <state id="6"><transition performative="agree" from="b" to="d" target="7"/></state>
        <state id="7"><transition performative="inform" from="d" to="a" target="8"/></state>
        <state id="8" final="yes"/></scxml>"#;
    // The messages of ben and cid overtake that of ann.
    let mut dan = stage_with(machine(text), "dan");
    dan.right(&["agree ben>dan", "inform cid>dan", "confirm cid>dan"]);
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    assert_eq!(dan.check("inform dan>ann"), unknown);
    dan.right(&["request ann>dan", "inform dan>ann"]);
    // The messages of cid arrive in their order.
    let mut dan = stage_with(machine(text), "dan");
    dan.right(&["inform cid>dan", "confirm cid>dan", "request ann>dan"]);
    dan.right(&["agree ben>dan", "inform dan>ann"]);
    let mut dan = stage_with(machine(text), "dan");
    dan.right(&["inform cid>dan"]);
    assert_eq!(dan.check("inform cid>dan"), unknown);
    let mut dan = stage_with(machine(text), "dan");
    dan.right(&["confirm cid>dan"]);
    for words in ["inform cid>dan", "confirm cid>dan"] {
        assert_eq!(dan.check(words), unknown, "{words}");
    }
}

#[test]
fn an_early_message_decides_a_choice_of_its_sender() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="d" target="2"/></state>
        <state id="2"><transition performative="query-if" from="a" to="c" target="3"/></state>
        <state id="3"><transition performative="inform" from="c" to="d" target="4"/>
            <transition performative="refuse" from="c" to="d" target="5"/></state>
        <state id="4"><transition performative="inform" from="d" to="a" target="6"/></state>
        <state id="5"><transition performative="failure" from="d" to="a" target="6"/></state>
        <state id="6" final="yes"/></scxml>"#;
    for (early, last) in [
        ("inform cid>dan", "inform dan>ann"),
        ("refuse cid>dan", "failure dan>ann"),
    ] {
        let mut dan = stage_with(machine(text), "dan");
        dan.right(&[early, "request ann>dan", last]);
    }
}

#[test]
fn an_agent_sends_no_early_message_of_another_role() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="d" target="2"/></state>
        <state id="2"><transition performative="query-if" from="a" to="b" target="3"/></state>
        <state id="3"><transition performative="agree" from="b" to="d" target="4"/></state>
        <state id="4"><transition performative="cfp" from="b" to="c" target="5"/></state>
        <state id="5"><transition performative="confirm" from="c" to="d" target="6"/></state>
        <state id="6"><transition performative="inform" from="c" to="a" target="7"/></state>
        <state id="7"><transition performative="disconfirm" from="a" to="d" target="8"/></state>
        <state id="8"><transition performative="inform" from="d" to="a" target="9"/></state>
        <state id="9" final="yes"/></scxml>"#;
    let begun = || {
        let mut dan = stage_with(machine(text), "dan");
        dan.right(&["request ann>dan"]);
        dan
    };
    let mut dan = begun();
    for words in ["confirm ann>dan", "propose ann>dan", "agree ann>dan"] {
        assert_eq!(dan.wrong(words), Kind::Unexpected, "{words}");
    }
    let mut dan = begun();
    dan.right(&["disconfirm ann>dan", "confirm cid>dan", "agree ben>dan"]);
    dan.right(&["inform dan>ann"]);
}

#[test]
fn a_conversation_is_over_when_the_role_has_nothing_more_to_do() {
    let text = |answer| {
        format!(
            r#"<scxml initial="1">
            <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="inform" from="b" to="c" target="3"/>{answer}</state>
            <state id="3" final="yes"/></scxml>"#
        )
    };
    let refusal = r#"<transition performative="refuse" from="b" to="a" target="3"/>"#;
    for (answer, is_over) in [("", true), (refusal, false)] {
        let mut ann = stage_with(machine(&text(answer)), "ann");
        let Verdict::Accepted(accepted) = ann.check("request ann>ben") else {
            panic!("{answer}");
        };
        // Without an answer, ben may have informed cid.
        assert_eq!((accepted.over, accepted.complete), (is_over, true));
        ann.now += Duration::from_secs(100);
        ann.monitor.handle_timeout(ann.now);
        assert_eq!(ann.monitor.is_empty(), is_over);
        if !is_over {
            ann.right(&["refuse ben>ann"]);
        }
    }
}

#[test]
fn the_report_of_a_service_is_no_message_of_a_role() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="request" from="b" to="c" target="3"/></state>
        <state id="3"><transition performative="failure" from="c" to="a" target="4"/></state>
        <state id="4" final="yes"/></scxml>"#;
    let mut ann = stage_with(machine(text), "ann");
    let other = |words| header_of(words).0.protocol("fipa-request");
    ann.right(&["request ann>ben"]);
    // Another conversation with this identifier.
    for words in ["request eve>ann", "agree ann>eve"] {
        let now = ann.now;
        assert!(ann.monitor.check(&other(words), now).is_accepted());
    }
    let lost = Header::new(Performative::Failure)
        .sender("mts")
        .receivers(["ann"])
        .conversation_id("c")
        .undelivered_to("eve");
    let Verdict::Accepted(accepted) = ann.monitor.check(&lost, ann.now) else {
        panic!("it belongs to the other conversation");
    };
    assert_eq!(accepted.state, "undelivered");
    ann.right(&["failure cid>ann"]);
}
