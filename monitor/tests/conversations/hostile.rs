//! Messages of hostile peers: they take a bounded part of the memory, and cannot evade the checks.

use super::*;

fn enforced(policy: MonitorPolicy) -> Stage {
    Stage::new(Monitor::agent(library(), "ben").with_policy(policy))
}

#[test]
fn a_peer_evicts_only_its_own_conversations() {
    let mut limits = MonitorLimits::default();
    limits.conversations = 800;
    let monitor = Monitor::agent(library(), "ben").with_limits(limits);
    let mut stage = Stage::new(monitor);
    stage.right(request("request ann>ben").conversation_id("ann 1"));
    for number in 0..5_000 {
        let id = format!("flood {number}");
        stage.right(request("request mallory>ben").conversation_id(id));
    }
    assert_eq!(stage.monitor.len(), 101, "an eighth");
    assert_eq!(stage.monitor.forgotten(), 4_900);
    assert_eq!(
        stage.right(request("agree ben>ann").conversation_id("ann 1")),
        "agreed"
    );
    // The peer may claim many names: its connection tells them apart.
    for number in 0..5_000 {
        let id = format!("flood {number}");
        let header = request("request mallory>ben").sender(format!("m{number}"));
        stage.right(header.conversation_id(id).peer("host of mallory"));
    }
    assert_eq!(
        stage.right(request("inform ben>ann").conversation_id("ann 1")),
        "done"
    );
}

#[test]
fn a_later_message_may_not_name_more_bytes_than_the_share_of_a_peer() {
    let mut limits = MonitorLimits::default();
    limits.bytes = 1 << 20;
    let mut stage = Stage::new(Monitor::agent(library(), "ben").with_limits(limits));
    stage.right(request("request ann>ben"));
    let long = |number: usize| format!("{number}{}", "x".repeat(4_000));
    let agree = request("agree ben>ann").reply_to((0..60).map(long));
    assert_eq!(stage.wrong(agree).kind, Kind::TooMany);
    assert!(stage.monitor.bytes() < (1 << 20) / 8);
    stage.right(request("agree ben>ann").reply_to([long(0)]));
}

#[test]
fn a_conversation_at_its_share_of_bytes_continues_if_it_does_not_grow() {
    let long = || "x".repeat(4_000);
    let call = || {
        let call = say("cfp ann>ben").receivers([long(), "ben".to_owned()]);
        call.reply_with("call")
    };
    let called = |share: usize| {
        let mut limits = MonitorLimits::default();
        limits.bytes = share * 8;
        let mut stage = Stage::new(Monitor::observer(library_once()).with_limits(limits));
        let is_accepted = stage.check(&call()).is_accepted();
        is_accepted.then_some((share, stage))
    };
    let (share, mut stage) = (4_000..8_000).find_map(called).unwrap();
    // The bytes that an undelivered message needs are not limited.
    let now = stage.now;
    for receiver in [&*long(), "ben"] {
        stage.monitor.undelivered(&call(), receiver, now);
    }
    assert!(stage.monitor.bytes() > share);
    assert_eq!(stage.right(call()), "called");
    let answer = |words| say(words).sender(long());
    assert_eq!(stage.right(answer("propose ben>ann")), "proposed");
    let accept = say("accept-proposal ann>ben").receivers([long()]);
    assert_eq!(stage.right(accept), "accepted");
    assert_eq!(stage.wrong(say("cfp ann>cid")).kind, Kind::TooMany);
    let named = answer("inform ben>ann").reply_to(["dan"]);
    assert_eq!(stage.wrong(named).kind, Kind::TooMany);
    assert_eq!(stage.right(answer("inform ben>ann")), "done");
}

#[test]
fn a_report_of_many_undelivered_messages_does_not_exceed_the_share_of_a_peer() {
    let (mut refused, mut taken) = (0, 0);
    for share in (2_000..40_000).step_by(500) {
        let mut limits = MonitorLimits::default();
        limits.bytes = share * 8;
        let mut stage = Stage::new(Monitor::observer(library_once()).with_limits(limits));
        let all = || (0..20).map(|number| format!("arm {number}"));
        if !stage
            .check(&say("cfp ann>ben").receivers(all()))
            .is_accepted()
        {
            continue;
        }
        for sender in all() {
            stage.right(say("propose ben>ann").sender(sender));
        }
        let before = stage.monitor.bytes();
        let lost = say("failure mts>ben")
            .receivers(all())
            .undelivered_to("ann");
        match stage.check(&lost).is_accepted() {
            true => taken += usize::from(stage.monitor.bytes() > before),
            false => refused += 1,
        }
        assert!(stage.monitor.bytes() <= share, "{share}");
    }
    assert!(refused > 0 && taken > 0, "{refused} and {taken}");
}

#[test]
fn a_conversation_cannot_grow_beyond_the_share_of_a_peer() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="cfp" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="propose" from="b" to="a" target="2"/></state>
        </scxml>"#;
    let library = library_with("plain", text);
    let names = |length: usize, count| (0..count).map(move |number| format!("{number:x<length$}"));
    for protocol in ["plain", "fipa-contract-net"] {
        let cfp = || say_in(protocol, "cfp ann>ben").reply_with("call");
        for (length, reply_to, share) in [(1, 0, 1 << 13), (9, 3, 1 << 14), (4_000, 0, 1 << 17)] {
            let mut limits = MonitorLimits::default();
            limits.bytes = share * 8;
            let mut accepted = 0;
            for count in 1..300 {
                let monitor = Monitor::observer(Arc::clone(&library)).with_limits(limits);
                let mut stage = Stage::new(monitor);
                let header = cfp().receivers(names(length, count));
                let verdict = stage.check(&header.reply_to(names(length + 1, reply_to)));
                accepted += usize::from(verdict.is_accepted());
                let bytes = stage.monitor.bytes();
                assert!(bytes <= share, "{protocol}: {count} names: {bytes} bytes");
            }
            assert!((10..299).contains(&accepted), "{protocol}: {accepted}");
            // In several messages.
            let mut stage = Stage::new(Monitor::observer(Arc::clone(&library)).with_limits(limits));
            stage.right(say_in(protocol, "cfp ann>ben"));
            let mut refused = 0;
            for number in 0..400 {
                let name = format!("{number:x<length$}");
                let header = match protocol {
                    "plain" => say_in(protocol, "propose ben>ann").reply_to([name]),
                    _ => cfp().receivers([name]),
                };
                refused += usize::from(!stage.check(&header).is_accepted());
                let bytes = stage.monitor.bytes();
                assert!(bytes <= share, "{protocol}: {number}: {bytes} bytes");
            }
            assert!(refused > 0, "{protocol}");
        }
    }
}

#[test]
fn members_of_a_pattern_and_agents_with_several_roles_are_bounded() {
    let share = 1 << 17;
    let mut limits = MonitorLimits::default();
    limits.bytes = share * 8;
    let long = |number: usize| format!("{number:x<4000}");
    let mut stage = Stage::new(Monitor::observer(library()).with_limits(limits));
    stage.right(say("cfp ann>arm_.*"));
    let mut taken = 0;
    for number in 0..100 {
        let answer = say("propose ben>ann")
            .sender(long(number))
            .reply_with("bid");
        taken += usize::from(stage.check(&answer).is_accepted());
        assert!(stage.monitor.bytes() <= share, "{number}");
    }
    assert!((20..40).contains(&taken), "{taken}");
    // The agents in the `reply-to` of ben get both of its roles.
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="cfp" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="inform" from="a" to="c" target="3"/></state>
        <state id="3"><transition performative="propose" from="b|c" to="a" target="3"/></state>
        </scxml>"#;
    let own = |words| say_in("own", words);
    for (count, fits) in [(10, true), (20, false)] {
        let library = library_with("own", text);
        let mut stage = Stage::new(Monitor::observer(library).with_limits(limits));
        stage.right(own("cfp ann>ben"));
        stage.right(own("inform ann>ben"));
        let answer = own("propose ben>ann").reply_to((0..count).map(long));
        assert_eq!(stage.check(&answer).is_accepted(), fits, "{count}");
        assert!(stage.monitor.bytes() <= share, "{count}");
    }
}

#[test]
fn the_copies_of_a_message_are_bounded() {
    let text = |to| {
        format!(
            r#"<scxml initial="1">
            <state id="1"><transition performative="request" from="a" to="{to}" target="2"/></state>
            <state id="2"><transition performative="agree" from="b" to="a" target="2"/>
                <transition performative="inform" from="a" to="c" target="2"/></state></scxml>"#
        )
    };
    let own = |words| say_in("plain", words);
    let receiver = |number: usize| format!("{number:x<100}");
    for (to, share, participants, accepted) in [
        ("b", 1 << 14, 1_000, 20..140),
        // The initiator is one of the agents with roles.
        ("b", 1 << 20, 30, 29..30),
        ("b|c", 1 << 20, 30, 30..31),
    ] {
        let mut limits = MonitorLimits::default();
        (limits.bytes, limits.participants) = (share * 8, participants);
        let library = library_with("plain", &text(to));
        let mut stage = Stage::new(Monitor::observer(library).with_limits(limits));
        let mut taken = 0;
        for number in 0..500 {
            let copy = own("request ann>ben,cid").copy_for(receiver(number));
            let verdict = stage.check(&copy);
            let kind = verdict.violation().map(|violation| violation.kind);
            assert!(kind.is_none_or(|kind| kind == Kind::TooMany), "{kind:?}");
            taken += usize::from(kind.is_none());
            assert!(stage.monitor.bytes() <= share, "{number}");
        }
        assert!(accepted.contains(&taken), "{taken}");
        stage.right(own("agree ben>ann").sender(receiver(3)));
    }
}

#[test]
fn the_bytes_of_a_peer_are_bounded() {
    let mut limits = MonitorLimits::default();
    limits.bytes = 8 << 20;
    let monitor = Monitor::agent(library(), "ben").with_limits(limits);
    let mut stage = Stage::new(monitor);
    stage.right(request("request ann>ben").conversation_id("ann 1"));
    let long = |number: usize| format!("{number}{}", "x".repeat(4_000));
    for number in 0..200 {
        let header = request("request mallory>ben").conversation_id(format!("{number}"));
        stage.right(header.reply_to((0..64).map(long)));
        assert!(stage.monitor.bytes() < (1 << 20) + 4_096);
    }
    let header = request("agree ben>ann").conversation_id("ann 1");
    assert_eq!(stage.right(header), "agreed");
    // A conversation that grows is charged too.
    let mut stage = Stage::new(Monitor::observer(library()).with_limits(limits));
    for number in 0..400 {
        let header = say("cfp ann>ben").receivers([long(number)]);
        let id = format!("{}", number % 20);
        stage.check(&header.conversation_id(id));
        assert!(stage.monitor.bytes() < 1 << 20);
    }
    // A single conversation that is larger than the part of a peer is refused.
    let header = say("cfp ann>ben").receivers((0..300).map(long));
    assert_eq!(stage.wrong(header.conversation_id("x")).kind, Kind::TooMany);
    stage.pass(100_000);
    assert_eq!(stage.monitor.bytes(), 0);
}

#[test]
fn what_is_too_large_to_check_is_refused_for_an_agent() {
    let mut stage = enforced(MonitorPolicy::default());
    let many = (0..2_000).map(|number| number.to_string());
    for header in [
        request("agree ann>ben").conversation_id("c".repeat(5_000)),
        request("agree ann>ben").reply_to(many.clone()),
        request("agree ann>ben").receivers(many.clone()),
        request("agree ann>ben").sender("x".repeat(5_000)),
        request("agree ann>ben").peer("x".repeat(5_000)),
        request("request ben>platoon").group("platoon", many),
    ] {
        assert_eq!(stage.wrong(header).kind, Kind::TooLarge);
    }
    let refused = stage.wrong(request("agree ann>ben").sender("x".repeat(50_000)));
    assert!(refused.to_string().len() < 10_000, "it is shortened");
}

#[test]
fn a_policy_refuses_messages_without_a_conversation() {
    let no_id = || {
        Header::new(act("request"))
            .sender("ann")
            .receivers(["ben"])
            .protocol("fipa-request")
    };
    let reqest = || say_in("fipa-reqest", "request ann>ben");
    let unsolicited = || say_in("fipa-contract-net", "accept-proposal ann>ben");
    let answer = || request("inform ann>ben").conversation_id("d");
    let mut lax = enforced(MonitorPolicy::default());
    for (header, why) in [
        (no_id(), Unchecked::NoConversation),
        (reqest(), Unchecked::UnknownProtocol),
        (unsolicited(), Unchecked::UnknownHistory),
        (answer(), Unchecked::BegunElsewhere),
    ] {
        assert_eq!(lax.check(&header), Verdict::Unchecked(why));
    }
    let mut strict = enforced(MonitorPolicy::strict());
    for (header, kind, reason) in [
        (no_id(), Kind::NoConversation, "no conversation-id"),
        (
            reqest(),
            Kind::Misspelled,
            "a known protocol is fipa-request",
        ),
        (unsolicited(), Kind::Unsolicited, "only continues one"),
        (answer(), Kind::Unsolicited, "only continues one"),
    ] {
        let refused = strict.wrong(header);
        assert_eq!(refused.kind, kind);
        assert!(refused.kind.depends_on_policy());
        assert!(refused.to_string().contains(reason), "{refused}");
    }
    assert!(strict.monitor.is_empty());
    // What the policy does not name passes.
    let other = say_in("dance", "cfp ann>ben");
    let unknown = Verdict::Unchecked(Unchecked::UnknownProtocol);
    assert_eq!(strict.check(&other), unknown);
    strict.right(request("request ann>ben"));
    let mut policy = MonitorPolicy::strict();
    policy.exempt.insert("FIPA-Request".into());
    policy.exempt.insert("fipa-contract-net".into());
    let mut exempt = enforced(policy);
    for header in [no_id(), reqest(), unsolicited(), answer()] {
        assert!(exempt.check(&header).violation().is_none());
    }
    assert!(!Kind::NotOpened.depends_on_policy());
}

#[test]
fn a_message_of_a_conversation_that_may_have_begun_is_not_unsolicited() {
    let answer = || request("inform ann>ben").conversation_id("d");
    let unknown = |stage: &mut Stage| {
        let verdict = stage.check(&answer());
        assert!(matches!(verdict, Verdict::Unchecked(_)), "{verdict:?}");
    };
    // The agent continues conversations of an earlier registration, or a `reply-to` names it.
    let mut stage = enforced(MonitorPolicy::strict());
    stage.monitor.set_history(History::Unknown);
    unknown(&mut stage);
    let mut stage = enforced(MonitorPolicy::strict());
    stage.monitor.expect("d");
    unknown(&mut stage);
    let other = request("inform ann>ben").conversation_id("e");
    assert_eq!(stage.wrong(other).kind, Kind::Unsolicited);
    // The monitor has removed the conversation after its idle time.
    let mut stage = enforced(MonitorPolicy::strict());
    stage.right(request("request ben>ann").conversation_id("d"));
    stage.pass(100_000);
    assert!(stage.monitor.is_empty());
    unknown(&mut stage);
}

#[test]
fn an_impossible_message_is_a_violation_whatever_came_before() {
    let mut stage = Stage::new(Monitor::agent(library(), "ben").with_history(History::Unknown));
    for header in [
        request("subscribe ann>ben"),
        request("propose ben>ann"),
        say_in("fipa-auction-english", "cancel ann>ben"),
    ] {
        assert_eq!(stage.wrong(header).kind, Kind::NotOpened);
    }
}

#[test]
fn a_guessed_identifier_does_not_block_its_owner() {
    // Mallory knows the next identifier of ben.
    for words in ["inform mallory>ben", "request mallory>ben"] {
        for protocol in ["fipa-request", "fipa-auction-english", "fipa-brokering"] {
            let monitors = [
                Monitor::agent(library(), "ben"),
                Monitor::agent(library(), "ann"),
                Monitor::observer(library()),
            ];
            for (number, monitor) in monitors.into_iter().enumerate() {
                let mut stage = Stage::new(monitor);
                // The monitor of ann does not get the message.
                if number != 1 {
                    stage.check(&say_in(protocol, words));
                }
                stage.right(request("request ben>ann"));
                stage.right(request("agree ann>ben"));
                stage.right(request("inform ann>ben"));
            }
        }
    }
    // Many names cannot block it either.
    let mut stage = Stage::new(Monitor::agent(library(), "ben"));
    for number in 0..100 {
        let guessed = request("request mallory>ben").sender(format!("m{number}"));
        stage.right(guessed);
    }
    assert_eq!(stage.monitor.len(), 8);
    stage.right(request("request ben>ann"));
    for number in 0..100 {
        let guessed = request("request mallory>ben").sender(format!("n{number}"));
        stage.right(guessed);
    }
    stage.right(request("inform ann>ben"));
    assert_eq!(stage.monitor.len(), 8);
    assert_eq!(stage.monitor.forgotten(), 193, "all but 7 of 200");
}

#[test]
fn a_message_that_fits_no_conversation_is_reported_with_the_last_that_began() {
    let mut stage = Stage::observer();
    let other = |words| request(words).conversation_id("other");
    stage.right(other("request ann>ben"));
    stage.right(other("refuse ben>ann"));
    stage.right(request("request ann>ben"));
    stage.right(request("agree ben>ann"));
    // The next conversation takes the place of the ended one in the table.
    stage.pass(100);
    assert_eq!(stage.monitor.len(), 1);
    let last = stage.right(request("request cid>ben"));
    let violation = stage.wrong(request("inform ben>dan"));
    assert_eq!(violation.state, Some(last));
}

#[test]
fn conversations_with_one_identifier_are_independent() {
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    stage.right(request("request cid>dan"));
    stage.right(say("cfp eve>ben"));
    assert_eq!(stage.monitor.len(), 3);
    stage.right(request("agree ben>ann"));
    stage.right(request("refuse dan>cid"));
    stage.right(say("propose ben>eve"));
    assert_eq!(stage.wrong(request("agree ben>ann")).kind, Kind::Unexpected);
    assert_eq!(stage.right(request("inform ben>ann")), "done");
}

#[test]
fn a_message_to_many_agents_is_judged_in_linear_steps() {
    // The number of comparisons of names is that of the names, whatever their order.
    let names = |prefix: &'static str| (0..500).map(move |number| format!("{prefix}{number}"));
    let mut stage = Stage::observer();
    let twice = names("agent ").chain(names("agent "));
    stage.right(say("cfp ann>ben").receivers(twice));
    stage.right(say("cfp ann>ben").receivers(names("other ")));
    for name in names("other ").chain(names("agent ")) {
        stage.right(say("propose ben>ann").sender(name));
    }
    let all = names("other ").chain(names("agent "));
    stage.right(say("reject-proposal ann>ben").receivers(all));
}

#[test]
fn an_outsider_reports_no_undelivered_message() {
    let of_dan = || {
        let agent = Stage::new(Monitor::agent(library(), "dan"));
        [agent, Stage::observer()]
    };
    for mut stage in of_dan() {
        stage.right(say("cfp dan>cid"));
        stage.right(say("cancel dan>cid"));
        let forged = stage.wrong(say("failure mallory>dan"));
        assert_eq!(forged.kind, Kind::Stranger);
        assert_eq!(stage.right(say("refuse cid>dan")), "cancelling");
        assert_eq!(stage.right(say("inform cid>dan")), "cancelled");
    }
    for mut stage in of_dan() {
        stage.right(say("cfp dan>cid"));
        stage.wrong(say("failure mallory>dan"));
        assert_eq!(stage.wrong(say("cfp dan>cid")).kind, Kind::Unexpected);
        assert_eq!(stage.right(say("propose cid>dan")), "proposed");
        stage.wrong(say("failure mallory>cid"));
        assert_eq!(stage.right(say("accept-proposal dan>cid")), "accepted");
        // The service of an outsider reports messages to the outsider only.
        stage.check(&say("failure mts>dan").undelivered_to("mallory"));
        assert_eq!(stage.right(say("inform cid>dan")), "done");
    }
    // With a state for all participants.
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="i" to="B" target="2"/></state>
        <state id="2"><transition performative="agree" from="B" to="i" target="3"/></state>
        <state id="3" final="yes"/></scxml>"#;
    let own = |words| say_in("plain", words);
    let mut stage = Stage::new(Monitor::observer(library_with("plain", text)));
    stage.right(own("request ann>ben"));
    let forged = stage.wrong(own("failure mallory>ann"));
    assert_eq!(forged.kind, Kind::Stranger);
    let of_mallory = own("failure mts>ann").undelivered_to("mallory");
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    assert_eq!(stage.check(&of_mallory), unknown);
    assert_eq!(stage.right(own("agree ben>ann")), "3");
    let lost = own("failure mts>ben").undelivered_to("ann");
    assert_eq!(stage.right(lost), "undelivered");
}

#[test]
fn a_report_of_a_service_is_no_violation_and_begins_nothing() {
    let mut strict = MonitorPolicy::default();
    strict.unsolicited = true;
    let monitor = Monitor::agent(library(), "ann").with_policy(strict);
    let mut stage = Stage::new(monitor);
    let unknown = Verdict::Unchecked(Unchecked::UnknownHistory);
    let lost = || request("failure mts>ann").undelivered_to("ben");
    assert_eq!(stage.check(&lost()), unknown);
    assert!(stage.monitor.is_empty());
    // A service is no member of a multicast.
    stage.right(say("cfp ann>arm_.*"));
    let lost = say("failure mts>ann").undelivered_to("arm_1");
    stage.right(lost);
    assert_eq!(stage.monitor.len(), 1);
    // A report to an agent that takes no part changes nothing.
    let mut stage = Stage::observer();
    stage.right(request("request ann>ben"));
    let lost = request("failure mts>ann,dan").undelivered_to("ben");
    assert_eq!(stage.check(&lost), unknown);
    assert_eq!(stage.right(request("agree ben>ann")), "agreed");
}

/// Within a second, the list of conversations is not sorted anew.
#[test]
fn the_oldest_conversation_of_a_peer_cannot_grow_beyond_its_share() {
    let mut limits = MonitorLimits::default();
    limits.bytes = 8 << 20;
    let mut stage = Stage::new(Monitor::observer(library()).with_limits(limits));
    let long = |number: usize| format!("{number}{}", "x".repeat(4_000));
    let call = |id: usize, number| {
        let header = say("cfp ann>ben").receivers([long(number)]);
        header.conversation_id(format!("{id}"))
    };
    for id in 0..20 {
        stage.right(call(id, id));
    }
    for number in 20..260 {
        stage.right(call(0, number));
        assert!(stage.monitor.bytes() <= 1 << 20);
    }
    assert!(stage.monitor.len() < 20);
}

#[test]
fn no_conversation_is_evicted_before_the_limit_of_bytes() {
    const COUNT: usize = 40;
    // The conversations of the agent count toward the total, and those of a peer toward its share.
    for (words, parts) in [("request ben>ann", 1), ("request ann>ben", 8)] {
        let filled = |bytes| {
            let mut limits = MonitorLimits::default();
            limits.bytes = bytes * parts;
            let mut stage = Stage::new(Monitor::agent(library_once(), "ben").with_limits(limits));
            for number in 0..COUNT {
                stage.right(request(words).conversation_id(format!("{number:02}")));
            }
            (stage.monitor.len(), stage.monitor.bytes())
        };
        let (_, bytes) = filled(1 << 20);
        assert_eq!(filled(bytes), (COUNT, bytes));
        assert_eq!(filled(bytes - 1), (COUNT - 1, bytes / COUNT * (COUNT - 1)));
    }
}

#[test]
fn no_message_exceeds_a_share_of_any_size() {
    let text = r#"<scxml initial="1">
        <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
        <state id="2"><transition performative="agree" from="b" to="a" target="3"/></state>
        <state id="3"><transition performative="inform" from="a|b" to="a|b" target="3"/></state>
        </scxml>"#;
    let library = library_with("own", text);
    let long = |name: &str| format!("{name:x<100}");
    let ask = |to: &str| {
        let header = say_in("own", "request ann>ben,cid,dan").sender(long("ann"));
        header.reply_with("q").copy_for(long(to))
    };
    let mut accepted = [0; 3];
    for share in 400..3_000 {
        let mut limits = MonitorLimits::default();
        limits.bytes = share * 8;
        let monitor = Monitor::observer(Arc::clone(&library)).with_limits(limits);
        let mut stage = Stage::new(monitor);
        for (to, accepted) in ["ben", "cid", "dan"].into_iter().zip(&mut accepted) {
            *accepted += usize::from(stage.check(&ask(to)).is_accepted());
            let bytes = stage.monitor.bytes();
            assert!(bytes <= share, "{to}: {bytes} > {share}");
        }
        // A message that adds no agent needs no space.
        if stage.monitor.len() == 1 && accepted[0] > 0 {
            let header = |words, from, to| {
                let header = say_in("own", words).sender(long(from));
                header.receivers([long(to)])
            };
            stage.right(header("agree ben>ann", "ben", "ann"));
            stage.right(header("inform ann>ben", "ann", "ben"));
        }
    }
    let [first, second, third] = accepted;
    assert!(
        first > second && second > third && third > 0,
        "{accepted:?}"
    );
}

#[test]
fn a_conversation_beyond_the_share_of_its_peer_evicts_others_if_the_whole_is_too_large() {
    let long = || "x".repeat(4_000);
    let call = || {
        let call = say("cfp ann>ben").receivers([long(), "ben".to_owned()]);
        call.reply_with("call")
    };
    let observer = |share: usize| {
        let mut limits = MonitorLimits::default();
        limits.bytes = share * 8;
        Stage::new(Monitor::observer(library_once()).with_limits(limits))
    };
    let called = |share: usize| {
        let mut stage = observer(share);
        let is_accepted = stage.check(&call()).is_accepted();
        is_accepted.then_some((share, stage.monitor.bytes()))
    };
    let (share, bytes) = (4_000..8_000).find_map(called).unwrap();
    let mut stage = observer(share);
    // Other peers have nearly all of the rest.
    let mut small = 0;
    for number in 0.. {
        let before = stage.monitor.bytes();
        if before + small + bytes > share * 8 {
            break;
        }
        let header = request("request dan>ben").sender(format!("{number:03}"));
        stage.right(header.conversation_id(format!("{number:03}")));
        small = stage.monitor.bytes() - before;
    }
    stage.right(call());
    assert_eq!(stage.monitor.forgotten(), 0);
    // The bytes that an undelivered message needs are not limited by the share.
    let now = stage.now;
    for receiver in [&*long(), "ben"] {
        stage.monitor.undelivered(&call(), receiver, now);
    }
    assert!(stage.monitor.forgotten() > 0);
    assert!(stage.monitor.bytes() <= share * 8);
    assert_eq!(stage.right(call()), "called");
}
