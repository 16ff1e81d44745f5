//! Single situations: legacy agents, withdrawal, discovery, two owners, silence after a restart, probes.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use fipa_locking::{
    Act, Action, Algorithm, AnyAlgorithm, ClaimId, Content, Conversation, Ending, Event, Failure,
    Fence, LockDialect, LockMessage, LockPeer, Locks, Millis, Options, OwnerState, Refusal,
    Resource, Token,
};

fn bay() -> Resource {
    Resource::new("bay").unwrap()
}

fn peer(name: &str) -> LockPeer {
    LockPeer::new(name, 1).unwrap()
}

/// One agent, its time, and the actions that it has made since the last look.
struct Agent {
    locks: Locks<AnyAlgorithm>,
    now: Millis,
    out: Vec<Action>,
}

impl Agent {
    fn new(name: &str, kind: Algorithm) -> Self {
        Self {
            locks: Locks::new(peer(name), kind, Options::default()),
            now: 0,
            out: Vec::new(),
        }
    }

    /// An established owner of the bay, with these members.
    fn owner(name: &str, kind: Algorithm, members: &[(&str, LockDialect)]) -> Self {
        let mut owner = Self::new(name, kind);
        for (member, dialect) in members {
            owner.locks.join(0, &peer(member), *dialect, &mut owner.out);
        }
        let state = OwnerState::first().next_life(Options::default().lease);
        owner.locks.own(0, &bay(), &state, &mut owner.out);
        owner.pass(1_000);
        owner.out.clear();
        owner
    }

    /// Lets the agent know the owner of the bay.
    fn owned_by(&mut self, owner: &str, dialect: LockDialect) {
        self.locks
            .owner_known(0, &bay(), &peer(owner), dialect, &mut self.out);
    }

    /// Passes time, with each timeout at its time.
    fn pass(&mut self, span: Millis) {
        let end = self.now + span;
        while let Some(due) = self.locks.poll_timeout().filter(|due| *due <= end) {
            self.now = due.max(self.now);
            self.locks.handle_timeout(self.now, &mut self.out);
        }
        self.now = end;
    }

    fn receive(&mut self, from: &str, dialect: LockDialect, conversation: &str, act: Act) {
        let message = LockMessage {
            conversation: Conversation::parse(conversation),
            dialect,
            algorithm: None,
            content: Content::Lock {
                resource: bay(),
                act,
            },
        };
        self.locks
            .handle(self.now, &peer(from), &message, &mut self.out);
    }

    /// The other owner of the bay.
    fn rival(&self) -> Option<String> {
        let mut all = self.locks.status(self.now);
        let rival = all.find(|it| it.resource == bay())?.rival?;
        Some(rival.name().to_owned())
    }

    fn lock(&mut self, within: Option<Millis>) -> ClaimId {
        self.locks.lock(self.now, &bay(), within, &mut self.out)
    }

    /// Acts that were sent since the last call, as receiver, conversation and act.
    fn sent(&mut self) -> Vec<(String, String, Act)> {
        let sent = self.out.iter().filter_map(|action| match action {
            Action::Send { to, message } => match &message.content {
                Content::Lock { act, .. } => {
                    let conversation = message.conversation.to_string();
                    Some((to.name().to_owned(), conversation, act.clone()))
                }
                Content::Probe | Content::Alive => None,
            },
            Action::Event(_) => None,
        });
        let sent = sent.collect();
        self.out.retain(|action| matches!(action, Action::Event(_)));
        sent
    }

    fn events(&mut self) -> Vec<Event> {
        let events = self.out.iter().filter_map(|action| match action {
            Action::Event(event) => Some(event.clone()),
            Action::Send { .. } => None,
        });
        let events = events.collect();
        self.out
            .retain(|action| matches!(action, Action::Send { .. }));
        events
    }
}

fn to(receiver: &str, conversation: &str, act: Act) -> (String, String, Act) {
    (receiver.to_owned(), conversation.to_owned(), act)
}

const LEGACY: LockDialect = LockDialect::Legacy;
const OWN: LockDialect = LockDialect::Own;

fn confirm(asked: Millis) -> Act {
    Act::Confirm { asked: Some(asked) }
}

fn fence_in(sent: &[(String, String, Act)]) -> Fence {
    let fence = sent.iter().find_map(|(.., act)| match act {
        Act::Granted { fence, .. } => Some(fence.clone()),
        _ => None,
    });
    fence.unwrap_or_else(|| panic!("no grant in {sent:?}"))
}

/// The recorded order of `distributed_locking`: the deferred agree precedes the report to the owner.
#[test]
fn an_early_confirm_waits_for_the_report_of_a_legacy_agent() {
    let members = [("agent2", LEGACY), ("agent3", OWN)];
    let mut owner = Agent::owner("agent1", Algorithm::RicartAgrawala, &members);
    owner.receive("agent2", LEGACY, "agent2_1", Act::Request { clock: 1 });
    let agree = Act::Agree { clock: 1 };
    assert_eq!(owner.sent(), [to("agent2", "agent2_1", agree)]);
    owner.receive("agent2", LEGACY, "agent2_1", Act::Confirm { asked: None });
    assert_eq!(owner.sent(), []);
    // Agent 2 has let agent 3 enter, and the owner agreed to it before.
    owner.receive("agent3", OWN, "agent3_2", confirm(7));
    assert_eq!(owner.sent(), []);
    owner.receive("agent2", LEGACY, "agent2_1", Act::Release);
    let sent = owner.sent();
    let fence = fence_in(&sent);
    assert!(owner.locks.admit(owner.now, &bay(), &fence));
    // A late or repeated report of agent 2 changes nothing.
    owner.receive("agent2", LEGACY, "agent2_1", Act::Release);
    assert!(owner.locks.admit(owner.now, &bay(), &fence));
}

#[test]
fn the_owner_defers_its_agree_while_a_grant_is_live() {
    let members = [("agent2", OWN), ("agent3", LEGACY)];
    let mut owner = Agent::owner("agent1", Algorithm::RicartAgrawala, &members);
    owner.receive("agent2", OWN, "agent2_1", confirm(1));
    owner.sent();
    owner.receive("agent3", LEGACY, "agent3_1", Act::Request { clock: 9 });
    assert_eq!(owner.sent(), []);
    owner.receive("agent2", OWN, "agent2_1", Act::Release);
    let agree = Act::Agree { clock: 9 };
    assert_eq!(owner.sent(), [to("agent3", "agent3_1", agree)]);
}

/// A legacy agent has no fence, so the resource cannot refuse an expired holder that still uses it.
#[test]
fn an_expired_holder_keeps_legacy_agents_out_until_it_is_proved_gone() {
    let members = [("agent2", OWN), ("agent3", LEGACY), ("agent4", OWN)];
    for proof in ["release", "departure", "force"] {
        let mut owner = Agent::owner("agent1", Algorithm::RicartAgrawala, &members);
        owner.receive("agent2", OWN, "agent2_1", confirm(1));
        let fence = fence_in(&owner.sent());
        owner.pass(15_000);
        assert!(!owner.locks.admit(owner.now, &bay(), &fence));
        owner.receive("agent3", LEGACY, "agent3_1", Act::Request { clock: 9 });
        assert_eq!(owner.sent(), []);
        owner.receive("agent4", OWN, "agent4_1", Act::Request { clock: 10 });
        assert_eq!(
            owner.sent(),
            [to("agent4", "agent4_1", Act::Agree { clock: 10 })]
        );
        match proof {
            "release" => owner.receive("agent2", OWN, "agent2_1", Act::Release),
            "departure" => owner
                .locks
                .depart(owner.now, &peer("agent2"), &mut owner.out),
            _ => owner.locks.force(owner.now, &bay(), &mut owner.out),
        }
        let agree = Act::Agree { clock: 10 };
        assert_eq!(owner.sent(), [to("agent3", "agent3_1", agree)], "{proof}");
    }
}

#[test]
fn a_silent_legacy_holder_is_replaced_only_by_force() {
    let members = [("agent2", LEGACY), ("agent3", OWN)];
    let mut owner = Agent::owner("agent1", Algorithm::RicartAgrawala, &members);
    owner.receive("agent2", LEGACY, "agent2_1", Act::Confirm { asked: None });
    owner.receive("agent3", OWN, "agent3_1", confirm(1));
    owner.events();
    owner.pass(8_000);
    let silent = Event::Silent {
        resource: bay(),
        holder: peer("agent2"),
    };
    assert!(owner.events().contains(&silent));
    owner.receive("agent3", OWN, "agent3_1", confirm(9_000));
    assert_eq!(owner.sent(), []);
    owner.locks.force(owner.now, &bay(), &mut owner.out);
    assert_eq!(
        fence_in(&owner.sent()).to_string(),
        "1.1.0000000000000000@agent1#bay"
    );
}

/// In Suzuki-Kasami legacy agents send no reports: the token is the report.
#[test]
fn a_legacy_agent_holds_the_resource_while_it_has_the_token() {
    let members = [("agent2", LEGACY), ("agent3", OWN)];
    let mut owner = Agent::owner("agent1", Algorithm::SuzukiKasamiExtended, &members);
    owner.receive(
        "agent2",
        LEGACY,
        "agent2_1",
        Act::RequestToken { number: 1 },
    );
    let sent = owner.sent();
    let [(_, conversation, Act::Token(token))] = &sent[..] else {
        panic!("{sent:?}");
    };
    assert_eq!(
        (conversation.as_str(), token.archive),
        ("agent2_1", Some(18))
    );
    // The token does not come back by itself, whatever time passes.
    owner.receive("agent3", OWN, "agent3_1", Act::RequestToken { number: 1 });
    owner.pass(4_000);
    assert_eq!(owner.sent(), []);
    let returned = Token {
        last: [("agent2".into(), 1)].into(),
        archive: Some(17),
        ..Token::default()
    };
    owner.receive("agent2", LEGACY, "agent1_0", Act::Token(returned));
    let sent = owner.sent();
    let [(receiver, conversation, Act::Token(token))] = &sent[..] else {
        panic!("{sent:?}");
    };
    assert_eq!(
        (receiver.as_str(), conversation.as_str()),
        ("agent3", "agent3_1")
    );
    assert_eq!(token.archive, Some(17), "the version that the peers write");
}

#[test]
fn a_lock_at_a_legacy_owner_has_no_fence() {
    let mut agent = Agent::new("agent2", Algorithm::RicartAgrawala);
    agent.locks.join(0, &peer("agent1"), LEGACY, &mut agent.out);
    let claim = agent.lock(None);
    assert!(matches!(
        &agent.sent()[..],
        [(_, _, Act::Query { claim: false })]
    ));
    agent.receive("agent1", LEGACY, "agent2_discover_0", Act::Owned);
    let request = Act::Request { clock: 1 };
    assert_eq!(agent.sent(), [to("agent1", "agent2_0", request)]);
    agent.receive("agent1", LEGACY, "agent2_0", Act::Agree { clock: 3 });
    let report = Act::Confirm { asked: None };
    assert_eq!(agent.sent(), [to("agent1", "agent2_0", report)]);
    assert_eq!(agent.events(), [Event::Acquired { claim }]);
    assert_eq!(agent.locks.fence(0, claim, &bay()), None);
    assert_eq!(agent.locks.remaining(0, claim), None);
    agent.locks.release(0, claim, &mut agent.out);
    assert_eq!(agent.sent(), [to("agent1", "agent2_0", Act::Release)]);
}

/// The lease of the grant before has ended, and the owner was suspended.
#[test]
fn a_late_owner_grants_no_withdrawn_request() {
    let members = [("agent2", OWN), ("agent3", OWN)];
    let mut owner = Agent::owner("agent1", Algorithm::default(), &members);
    owner.receive("agent2", OWN, "agent2_0", confirm(1));
    owner.receive("agent3", OWN, "agent3_0", confirm(1));
    owner.sent();
    owner.events();
    owner.now += Options::default().lease;
    owner.receive("agent3", OWN, "agent3_0", Act::Release);
    let sent = owner.sent();
    assert!(
        !sent
            .iter()
            .any(|(_, _, act)| matches!(act, Act::Granted { .. })),
        "{sent:?}"
    );
    let ended = owner.events();
    assert!(
        matches!(&ended[..], [Event::Ended { how: Ending::Expired, grant, .. }]
            if *grant.holder.name() == *"agent2"),
        "{ended:?}"
    );
}

/// The member joins while the owner has not agreed.
#[test]
fn an_agent_that_joins_during_a_request_is_asked() {
    for kind in [Algorithm::RicartAgrawala, Algorithm::RicartAgrawalaExtended] {
        for dialect in [LEGACY, OWN] {
            let mut agent = Agent::new("agent2", kind);
            agent.owned_by("agent1", LEGACY);
            agent.lock(None);
            agent.sent();
            agent
                .locks
                .join(0, &peer("agent0"), dialect, &mut agent.out);
            let request = Act::Request { clock: 1 };
            assert_eq!(agent.sent(), [to("agent0", "agent2_0", request)]);
            agent.receive("agent1", LEGACY, "agent2_0", Act::Agree { clock: 3 });
            assert_eq!(agent.events(), [], "{kind}");
            agent.receive("agent0", dialect, "agent2_0", Act::Agree { clock: 3 });
            assert!(matches!(&agent.events()[..], [Event::Acquired { .. }]));
        }
    }
}

/// An agent of `distributed_locking` that has an open request with a later clock, and does not know this one, agrees
/// and enters.
#[test]
fn a_legacy_agent_that_has_not_asked_is_asked_again_with_a_later_clock() {
    let mut agent = Agent::new("agent2", Algorithm::RicartAgrawala);
    agent.owned_by("agent1", LEGACY);
    agent.locks.join(0, &peer("agent3"), LEGACY, &mut agent.out);
    agent.lock(None);
    agent.receive("agent1", LEGACY, "agent2_0", Act::Agree { clock: 3 });
    agent.sent();
    // Its clock was 7.
    agent.receive("agent3", LEGACY, "agent2_0", Act::Agree { clock: 9 });
    let request = Act::Request { clock: 10 };
    let again = |receiver| to(receiver, "agent2_1", request.clone());
    assert_eq!(agent.sent(), [again("agent1"), again("agent3")]);
    agent.receive("agent1", LEGACY, "agent2_1", Act::Agree { clock: 12 });
    agent.receive("agent3", LEGACY, "agent2_0", Act::Agree { clock: 9 });
    assert_eq!(agent.events(), []);
    // After its use. It is not asked a third time.
    agent.receive("agent3", LEGACY, "agent2_1", Act::Agree { clock: 20 });
    assert!(matches!(&agent.events()[..], [Event::Acquired { .. }]));
}

/// The first request waits for the answers of the agents that were greeted, or for one second.
#[test]
fn the_first_request_waits_for_answers_to_greetings() {
    let mut agent = Agent::new("agent2", Algorithm::RicartAgrawala);
    agent.locks.expect(0, &peer("agent3"));
    agent.locks.expect(0, &peer("agent4"));
    agent.owned_by("agent1", OWN);
    agent.lock(None);
    assert_eq!(agent.sent(), []);
    let alive = |conversation| LockMessage {
        conversation: Conversation::parse(conversation),
        dialect: OWN,
        algorithm: None,
        content: Content::Alive,
    };
    let heard = alive("agent2_probe_0");
    let out = &mut agent.out;
    agent.locks.handle(0, &peer("agent3"), &heard, out);
    assert_eq!(agent.sent(), []);
    // Agent 4 uses no locks.
    agent.pass(999);
    assert_eq!(agent.sent(), []);
    agent.pass(1);
    let receivers: Vec<_> = agent.sent().into_iter().map(|(to, ..)| to).collect();
    assert_eq!(receivers, ["agent1", "agent3"]);

    // All have answered or left. Then nothing waits for those that start later.
    let mut agent = Agent::new("agent2", Algorithm::RicartAgrawala);
    agent.locks.expect(0, &peer("agent3"));
    agent.locks.expect(0, &peer("agent4"));
    agent.owned_by("agent1", OWN);
    agent.lock(None);
    agent.locks.depart(0, &peer("agent4"), &mut agent.out);
    assert_eq!(agent.sent(), []);
    let out = &mut agent.out;
    agent.locks.handle(0, &peer("agent3"), &heard, out);
    let receivers: Vec<_> = agent.sent().into_iter().map(|(to, ..)| to).collect();
    assert_eq!(receivers, ["agent1", "agent3"]);
    agent.locks.expect(0, &peer("agent5"));
    assert_ne!(agent.locks.poll_timeout(), Some(1_000));

    // The round of `try_lock` begins after the wait.
    let mut agent = Agent::new("agent2", Algorithm::RicartAgrawala);
    agent.locks.expect(0, &peer("agent4"));
    agent.owned_by("agent1", OWN);
    agent.locks.try_lock(0, &bay(), &mut agent.out);
    agent.pass(1_999);
    assert_eq!(agent.events(), []);
    agent.pass(1);
    assert!(matches!(&agent.events()[..], [Event::Failed { .. }]));
}

/// The recorded race of `distributed_locking`: another agent has queued our request in the token before it reached
/// the owner, which then knows the conversation of the request before only.
#[test]
fn the_token_returns_to_a_legacy_owner_in_the_conversation_in_which_it_came() {
    let mut agent = Agent::new("agent2", Algorithm::SuzukiKasamiExtended);
    agent.owned_by("agent1", LEGACY);
    let conversation = |agent: &mut Agent| {
        let sent = agent.sent();
        let of = |act: &Act| matches!(act, Act::RequestToken { .. } | Act::Token(_));
        let sent: Vec<_> = sent.into_iter().filter(|(.., act)| of(act)).collect();
        assert_eq!(sent.len(), 1, "{sent:?}");
        sent[0].1.clone()
    };
    let first = agent.lock(None);
    let asked = conversation(&mut agent);
    let token = || Act::Token(Token::default());
    agent.receive("agent1", LEGACY, &asked, token());
    agent.locks.release(0, first, &mut agent.out);
    assert_eq!(conversation(&mut agent), asked);
    let second = agent.lock(None);
    assert_ne!(conversation(&mut agent), asked);
    agent.receive("agent1", LEGACY, &asked, token());
    assert!(agent.locks.is_held(0, second));
    agent.locks.release(0, second, &mut agent.out);
    assert_eq!(conversation(&mut agent), asked);
}

#[test]
fn without_an_owner_a_claim_fails() {
    let mut agent = Agent::new("agent2", Algorithm::default());
    agent.locks.join(0, &peer("agent1"), OWN, &mut agent.out);
    let claim = agent.lock(None);
    agent.pass(2_000);
    let queries = agent.sent();
    assert_eq!(queries.len(), 2, "{queries:?}");
    let failure = Failure::NoOwner;
    let resource = bay();
    assert_eq!(
        agent.events(),
        [Event::Failed {
            claim,
            resource,
            failure
        }]
    );
}

#[test]
fn a_claim_that_ends_before_an_owner_is_found_says_so() {
    let mut agent = Agent::new("agent2", Algorithm::default());
    let claim = agent.lock(Some(300));
    let second = agent.lock(Some(300));
    agent.pass(300);
    let failed = |claim| Event::Failed {
        claim,
        resource: bay(),
        failure: Failure::OwnerNotFound,
    };
    let events = agent.events();
    assert_eq!(events.len(), 2, "{events:?}");
    assert!(events.contains(&failed(claim)) && events.contains(&failed(second)));
}

#[test]
fn a_withdrawn_request_is_answered_and_its_grant_released() {
    let mut agent = Agent::new("agent2", Algorithm::RicartAgrawalaExtended);
    for name in ["agent1", "agent3"] {
        agent.locks.join(0, &peer(name), OWN, &mut agent.out);
    }
    agent.owned_by("agent1", OWN);
    let claim = agent.lock(Some(300));
    agent.receive("agent3", OWN, "agent3_0", Act::Request { clock: 5 });
    agent.sent();
    // The time ends while two members have not agreed.
    agent.pass(300);
    let failure = Failure::TimedOut { ahead: Some(2) };
    let resource = bay();
    assert_eq!(
        agent.events(),
        [Event::Failed {
            claim,
            resource,
            failure
        }]
    );
    assert_eq!(
        agent.sent(),
        [to("agent3", "agent3_0", Act::Agree { clock: 5 })]
    );
    // Late agreements of the withdrawn request do not count for the next one.
    agent.lock(None);
    agent.sent();
    for name in ["agent1", "agent3"] {
        agent.receive(name, OWN, "agent2_0", Act::Agree { clock: 6 });
    }
    assert_eq!(agent.sent(), []);
    // A grant that crosses the withdrawal is released at once.
    let granted = Act::Granted {
        fence: "1.1.0000000000000000@agent1#bay".parse().unwrap(),
        lease: 15_000,
        asked: 200,
    };
    agent.receive("agent1", OWN, "agent2_0", granted);
    assert_eq!(agent.sent(), [to("agent1", "agent2_0", Act::Release)]);
}

#[test]
fn try_lock_withdraws_after_one_round() {
    let mut agent = Agent::new("agent2", Algorithm::RicartAgrawalaExtended);
    agent.locks.join(0, &peer("agent1"), OWN, &mut agent.out);
    agent.owned_by("agent1", OWN);
    let first = agent.locks.try_lock(0, &bay(), &mut agent.out);
    let second = agent.locks.try_lock(0, &bay(), &mut agent.out);
    let failed = |claim, ahead| Event::Failed {
        claim,
        resource: bay(),
        failure: Failure::TimedOut { ahead: Some(ahead) },
    };
    assert_eq!(agent.events(), [failed(second, 2)]);
    agent.pass(1_000);
    assert_eq!(agent.events(), [failed(first, 1)]);

    // The owner of a live grant needs no round.
    for kind in Algorithm::ALL {
        let mut owner = Agent::owner("agent1", kind, &[("agent2", OWN)]);
        owner.receive("agent2", OWN, "agent2_0", confirm(1));
        owner.sent();
        let now = owner.now;
        let claim = owner.locks.try_lock(now, &bay(), &mut owner.out);
        assert_eq!(owner.sent(), [], "{kind}");
        let is_failed =
            |event: &Event| matches!(event, Event::Failed { claim: of, .. } if *of == claim);
        assert!(owner.events().iter().any(is_failed), "{kind}");
    }
}

/// An answer to the repetition that came before the last one would cross it.
#[test]
fn a_repeated_report_that_waits_is_answered_once() {
    let members = [("agent2", OWN), ("agent3", OWN)];
    let mut owner = Agent::owner("agent1", Algorithm::default(), &members);
    owner.receive("agent2", OWN, "agent2_0", confirm(1));
    owner.receive("agent3", OWN, "agent3_0", confirm(1));
    owner.sent();
    // The lease has ended, and its timeout was not handled yet.
    owner.now += Options::default().lease;
    owner.receive("agent3", OWN, "agent3_0", confirm(2));
    let asked = owner.sent().into_iter().map(|(to, _, act)| match act {
        Act::Granted { asked, .. } => (to, asked),
        other => panic!("{other:?}"),
    });
    assert_eq!(asked.collect::<Vec<_>>(), [("agent3".to_owned(), 2)]);
}

#[test]
fn a_lost_owner_makes_the_resource_unreachable() {
    for proved in [true, false] {
        let mut agent = Agent::new("agent2", Algorithm::RicartAgrawalaExtended);
        agent.locks.join(0, &peer("agent1"), OWN, &mut agent.out);
        agent.owned_by("agent1", OWN);
        let claim = agent.lock(None);
        if proved {
            agent.locks.depart(0, &peer("agent1"), &mut agent.out);
        } else {
            agent.pass(8_000);
        }
        let failure = Failure::Unreachable {
            owner: peer("agent1"),
        };
        let resource = bay();
        assert_eq!(
            agent.events(),
            [Event::Failed {
                claim,
                resource,
                failure
            }]
        );
    }
}

#[test]
fn a_second_owner_is_refused_and_both_are_told() {
    let mut first = Agent::owner("agent1", Algorithm::default(), &[("agent2", OWN)]);
    let mut second = Agent::new("agent2", Algorithm::default());
    second.locks.join(0, &peer("agent1"), OWN, &mut second.out);
    let state = OwnerState::first().next_life(1_000);
    second.locks.own(0, &bay(), &state, &mut second.out);
    let claim = Act::Query { claim: true };
    assert_eq!(
        second.sent(),
        [to("agent1", "agent2_discover_0", claim.clone())]
    );
    first.receive("agent2", OWN, "agent2_discover_0", claim);
    let contested = Event::Contested {
        resource: bay(),
        by: peer("agent2"),
    };
    assert_eq!(first.events(), [contested]);
    for (_, conversation, act) in first.sent() {
        second.receive("agent1", OWN, &conversation, act);
    }
    let refused = Event::OwningRefused {
        resource: bay(),
        by: peer("agent1"),
    };
    assert_eq!(second.events(), [refused]);
    assert!(second.locks.owner(&bay()).is_none());
    assert!(first.locks.owner(&bay()).is_some());
    // It has given up.
    assert_eq!(first.rival(), None);
}

/// Two networks join.
#[test]
fn two_established_owners_name_each_other() {
    let mut first = Agent::owner("agent1", Algorithm::default(), &[]);
    assert_eq!(first.rival(), None);
    first.receive("agent2", OWN, "agent2_announce_0", Act::Owned);
    let contested = Event::Contested {
        resource: bay(),
        by: peer("agent2"),
    };
    assert_eq!(first.events(), [contested]);
    assert_eq!(first.rival().as_deref(), Some("agent2"));
    let now = first.now;
    first.locks.depart(now, &peer("agent2"), &mut first.out);
    assert_eq!(first.rival(), None);
}

#[test]
fn an_owner_is_silent_while_grants_of_its_life_before_may_be_live() {
    let before = OwnerState::first().next_life(15_000);
    let stored: OwnerState = before.to_string().parse().unwrap();
    let mut owner = Agent::new("agent1", Algorithm::default());
    owner.locks.join(0, &peer("agent2"), OWN, &mut owner.out);
    owner
        .locks
        .own(0, &bay(), &stored.next_life(15_000), &mut owner.out);
    owner.receive("agent2", OWN, "agent2_0", confirm(1));
    // An earlier fence is refused at once.
    let earlier = "1.7.0000000000000000@agent1#bay".parse().unwrap();
    assert!(!owner.locks.admit(0, &bay(), &earlier));
    owner.pass(14_999);
    owner.receive("agent2", OWN, "agent2_0", confirm(2));
    let of_lock = |(_, _, act): &(String, String, Act)| matches!(act, Act::Granted { .. });
    assert!(!owner.sent().iter().any(of_lock));
    // The waiter is probed, and answers.
    owner.pass(1);
    assert_eq!(
        fence_in(&owner.sent()).to_string(),
        "2.1.0000000000000000@agent1#bay"
    );
}

#[test]
fn several_resources_are_held_all_or_none() {
    let names = ["c", "a", "b"].map(|name| Resource::new(name).unwrap());
    let mut owner = Agent::new("agent1", Algorithm::RicartAgrawalaExtended);
    owner.locks.join(0, &peer("agent2"), OWN, &mut owner.out);
    for name in &names {
        let state = OwnerState::first().next_life(15_000);
        owner.locks.own(0, name, &state, &mut owner.out);
    }
    owner.pass(1_000);
    owner.out.clear();
    let message = |resource: &Resource, conversation: &str, act| LockMessage {
        conversation: Conversation::parse(conversation),
        dialect: OWN,
        algorithm: None,
        content: Content::Lock {
            resource: resource.clone(),
            act,
        },
    };
    // Agent 2 holds "b".
    let report = message(&names[2], "agent2_0", confirm(1));
    owner
        .locks
        .handle(owner.now, &peer("agent2"), &report, &mut owner.out);
    let claim = owner
        .locks
        .lock_all(owner.now, &names, Some(5_000), &mut owner.out);
    let asked: Vec<_> = owner
        .out
        .iter()
        .filter_map(|action| match action {
            Action::Send { message, .. } => match &message.content {
                Content::Lock {
                    resource,
                    act: Act::Request { .. },
                } => Some((message.conversation.to_string(), resource.clone())),
                _ => None,
            },
            Action::Event(_) => None,
        })
        .collect();
    assert_eq!(
        asked,
        [("agent1_0".to_owned(), names[1].clone())],
        "the first by name"
    );
    let agree = message(&names[1], "agent1_0", Act::Agree { clock: 1 });
    owner
        .locks
        .handle(owner.now, &peer("agent2"), &agree, &mut owner.out);
    assert!(owner.locks.fence(owner.now, claim, &names[1]).is_some());
    assert!(!owner.locks.is_held(owner.now, claim));
    owner.pass(5_000);
    assert!(owner.locks.fence(owner.now, claim, &names[1]).is_none());
    let failed = owner.events().into_iter().find_map(|event| match event {
        Event::Failed { resource, .. } => Some(resource),
        _ => None,
    });
    assert_eq!(failed, Some(names[2].clone()));
    assert!(
        owner
            .locks
            .owner(&names[1])
            .unwrap()
            .live(owner.now)
            .is_none()
    );
}

#[test]
fn a_dead_holder_is_replaced_at_once_and_its_late_command_refused() {
    let members = [("agent2", OWN), ("agent3", OWN)];
    let mut owner = Agent::owner("agent1", Algorithm::RicartAgrawalaExtended, &members);
    owner.receive("agent2", OWN, "agent2_0", confirm(1));
    let first = fence_in(&owner.sent());
    owner.receive("agent3", OWN, "agent3_0", confirm(1));
    assert_eq!(owner.sent(), []);
    owner.events();
    owner
        .locks
        .depart(owner.now, &peer("agent2"), &mut owner.out);
    let second = fence_in(&owner.sent());
    let gone = |event: &Event| {
        matches!(
            event,
            Event::Ended {
                how: Ending::Gone,
                ..
            }
        )
    };
    assert!(owner.events().iter().any(gone));
    assert!(!owner.locks.admit(owner.now, &bay(), &first));
    assert!(owner.locks.admit(owner.now, &bay(), &second));
    // Its late request is not granted.
    owner.receive("agent2", OWN, "agent2_1", confirm(2));
    owner.receive("agent3", OWN, "agent3_0", Act::Release);
    assert_eq!(owner.sent(), []);
}

#[test]
fn requests_of_one_peer_take_a_bounded_amount_of_memory() {
    for kind in Algorithm::ALL {
        let mut owner = Agent::owner("agent1", kind, &[("agent2", OWN)]);
        owner.receive("agent2", OWN, "agent2_0", confirm(1));
        for number in 1..=2_000_u64 {
            let conversation = format!("agent3_{number}");
            let clock = number;
            owner.receive("agent3", OWN, &conversation, Act::Request { clock });
            owner.receive("agent3", OWN, &conversation, Act::RequestToken { number });
            owner.receive("agent3", OWN, &conversation, confirm(number));
            owner.out.clear();
        }
        let status = owner.locks.status(owner.now).next().unwrap();
        assert_eq!(status.waiters, [peer("agent3")], "{kind}");
        let text = format!("{:?}", owner.locks);
        assert!(text.len() < 20_000, "{kind}: {} bytes", text.len());
    }
}

#[test]
fn an_agent_that_owns_nothing_refuses_reports() {
    let mut agent = Agent::new("agent1", Algorithm::default());
    agent.receive("agent2", OWN, "agent2_0", confirm(3));
    let refused = Act::Refused {
        reason: Refusal::NotOwner,
        asked: 3,
    };
    assert_eq!(agent.sent(), [to("agent2", "agent2_0", refused)]);
    // Any agent agrees to requests for resources that it does not use.
    agent.receive("agent2", OWN, "agent2_1", Act::Request { clock: 4 });
    assert_eq!(
        agent.sent(),
        [to("agent2", "agent2_1", Act::Agree { clock: 4 })]
    );
}

/// A report can wait longer than the lease. The holder uses the grant only after it is confirmed.
#[test]
fn a_grant_that_waited_longer_than_its_lease_is_renewed_before_use() {
    let mut agent = Agent::new("agent2", Algorithm::default());
    agent.locks.join(0, &peer("agent1"), OWN, &mut agent.out);
    agent.owned_by("agent1", OWN);
    let claim = agent.lock(None);
    agent.receive("agent1", OWN, "agent2_0", Act::Agree { clock: 1 });
    agent.now = 14_250;
    agent.sent();
    let fence: Fence = "1.1.0000000000000000@agent1#bay".parse().unwrap();
    let granted = |asked| Act::Granted {
        fence: "1.1.0000000000000000@agent1#bay".parse().unwrap(),
        lease: 15_000,
        asked,
    };
    agent.receive("agent1", OWN, "agent2_0", granted(0));
    assert!(!agent.locks.is_held(agent.now, claim));
    let asked = agent.now;
    let renew = Act::Renew {
        fence: fence.clone(),
        asked,
    };
    assert!(agent.sent().contains(&to("agent1", "agent2_0", renew)));
    agent.receive("agent1", OWN, "agent2_0", granted(asked));
    assert_eq!(agent.locks.fence(agent.now, claim, &bay()), Some(fence));
    assert_eq!(agent.locks.remaining(agent.now, claim), Some(14_250));
    // An answer to a request that this agent did not make, or makes later, does not count.
    agent.receive("agent1", OWN, "agent2_0", granted(asked + 10_000));
    assert_eq!(agent.locks.remaining(agent.now, claim), Some(14_250));
}

#[test]
fn a_peer_with_many_requests_takes_bounded_memory() {
    for kind in Algorithm::ALL {
        let names: Vec<String> = (0..50).map(|number| format!("member-{number}")).collect();
        let members = names.iter().map(|name| (name.as_str(), LockDialect::Own));
        let members: Vec<_> = members.chain([("rover", LockDialect::Own)]).collect();
        let mut owner = Agent::owner("crane", kind, &members);
        let requests = 100_000_u64;
        for number in 0..requests {
            let conversation = Conversation::new("rover".into(), number);
            let own = number % 2 == 0;
            let resource = match own {
                true => bay(),
                false => Resource::new(&format!("bay-{number}")).unwrap(),
            };
            let asked = Some(number);
            let act = match number % 12 {
                0 | 1 => Act::Request { clock: number },
                2 | 3 => Act::RequestToken { number },
                4 | 5 => Act::Confirm { asked },
                6 | 7 => Act::Release,
                8 | 9 => Act::Query { claim: !own },
                _ => Act::Owned,
            };
            let message = LockMessage {
                conversation,
                dialect: LockDialect::Own,
                algorithm: None,
                content: Content::Lock { resource, act },
            };
            let before = owner.out.len();
            let locks = &mut owner.locks;
            locks.handle(owner.now, &peer("rover"), &message, &mut owner.out);
            // The work for a message is bounded.
            assert!(owner.out.len() - before <= 8, "{kind}");
            owner.out.clear();
        }
        // Resources of others are bounded, and the peer waits for its own at most once.
        assert!(owner.locks.status(owner.now).count() <= 4_096, "{kind}");
        let core = owner.locks.owner(&bay()).unwrap();
        assert!(core.waiters().count() <= 1, "{kind}");
        let state = format!("{:?}", owner.locks).len();
        assert!(state < 4 << 20, "{kind}: {state} bytes");
    }
}

/// `distributed_locking` treats a second request in a conversation, and an announcement without a question, as
/// an error of the protocol.
#[test]
fn legacy_agents_get_neither_repetitions_nor_announcements() {
    for kind in [
        Algorithm::RicartAgrawalaExtended,
        Algorithm::SuzukiKasamiExtended,
    ] {
        let mut agent = Agent::new("agent2", kind);
        agent.locks.join(0, &peer("agent1"), LEGACY, &mut agent.out);
        agent.locks.join(0, &peer("agent3"), OWN, &mut agent.out);
        agent.receive("agent1", LEGACY, "agent2_discover_0", Act::Owned);
        agent.lock(None);
        let first = agent.sent();
        assert_eq!(first.len(), 2, "{first:?}");
        agent.pass(1_500);
        let repeated = agent.sent();
        // The token is the owner's, so no other agent needs a repetition.
        let expected = if kind.has_token() { 0 } else { 1 };
        assert_eq!(repeated.len(), expected, "{repeated:?}");
        assert!(repeated.iter().all(|(receiver, ..)| receiver == "agent3"));
    }
    let mut owner = Agent::owner("agent1", Algorithm::default(), &[]);
    owner
        .locks
        .join(owner.now, &peer("agent2"), LEGACY, &mut owner.out);
    assert_eq!(owner.sent(), []);
    owner
        .locks
        .join(owner.now, &peer("agent3"), OWN, &mut owner.out);
    assert!(matches!(&owner.sent()[..], [(to, _, Act::Owned)] if to == "agent3"));
    owner.receive("agent2", LEGACY, "agent2_0", Act::Query { claim: false });
    assert_eq!(owner.sent(), [to("agent2", "agent2_0", Act::Owned)]);
}

/// Several agents, and messages that take 1 ms. Lost agents neither receive nor send.
struct Group {
    agents: Vec<Agent>,
    lost: Vec<usize>,
    now: Millis,
}

impl Group {
    const NAMES: [&'static str; 4] = ["agent1", "agent2", "agent3", "agent4"];

    /// The first agent owns the bay.
    fn new(kind: Algorithm) -> Self {
        let mut agents: Vec<_> = Self::NAMES.map(|name| Agent::new(name, kind)).into();
        for (at, agent) in agents.iter_mut().enumerate() {
            for other in Self::NAMES.iter().enumerate().filter(|(it, _)| *it != at) {
                agent.locks.join(0, &peer(other.1), OWN, &mut agent.out);
            }
        }
        let owner = &mut agents[0];
        let state = OwnerState::first().next_life(Options::default().lease);
        owner.locks.own(0, &bay(), &state, &mut owner.out);
        let lost = Vec::new();
        let mut group = Self {
            agents,
            lost,
            now: 0,
        };
        group.pass_until(2_000, |_| false);
        group
    }

    /// Passes time until the condition holds. Returns whether it did before `end`.
    fn pass_until(&mut self, end: Millis, mut holds: impl FnMut(&mut Self) -> bool) -> bool {
        while self.now < end {
            if holds(self) {
                return true;
            }
            // Messages that were sent before this millisecond arrive now.
            let mut arriving = Vec::new();
            for (at, agent) in self.agents.iter_mut().enumerate() {
                agent.now = self.now;
                agent.out.retain(|action| match action {
                    Action::Send { to, message } => {
                        arriving.push((at, to.clone(), message.clone()));
                        false
                    }
                    Action::Event(_) => true,
                });
            }
            for (from, to, message) in arriving {
                let at = Self::NAMES.iter().position(|name| *name == to.name());
                let at = at.unwrap();
                if !self.lost.contains(&from) && !self.lost.contains(&at) {
                    let from = peer(Self::NAMES[from]);
                    let agent = &mut self.agents[at];
                    agent
                        .locks
                        .handle(self.now, &from, &message, &mut agent.out);
                }
            }
            for agent in &mut self.agents {
                if agent
                    .locks
                    .poll_timeout()
                    .is_some_and(|due| due <= self.now)
                {
                    agent.locks.handle_timeout(self.now, &mut agent.out);
                }
            }
            let sends = |agent: &Agent| {
                let mut actions = agent.out.iter();
                actions.any(|action| matches!(action, Action::Send { .. }))
            };
            // Nothing happens before the next timeout, unless messages are under way.
            let due = self.agents.iter().filter_map(|it| it.locks.poll_timeout());
            self.now = match self.agents.iter().any(sends) {
                true => self.now + 1,
                false => due.min().unwrap_or(end).clamp(self.now + 1, end),
            };
        }
        holds(self)
    }

    fn lock(&mut self, agent: usize) -> ClaimId {
        self.agents[agent].now = self.now;
        self.agents[agent].lock(None)
    }

    fn holds(&self, agent: usize, claim: ClaimId) -> bool {
        self.agents[agent].locks.is_held(self.now, claim)
    }
}

/// The bound of invariant 10, at all phases of a lease and of the probes: nothing proves the loss.
#[test]
fn a_lost_holder_or_waiter_delays_others_by_at_most_one_lease_and_one_probe_interval() {
    let options = Options::default();
    // Requests and reports after the end of the lease take some milliseconds.
    let bound = options.lease + options.probe_interval + 20;
    for kind in [
        Algorithm::RicartAgrawalaExtended,
        Algorithm::SuzukiKasamiExtended,
    ] {
        for phase in (0..options.lease).step_by(701) {
            for is_holder_lost in [true, false] {
                let mut group = Group::new(kind);
                let first = group.lock(1);
                assert!(group.pass_until(10_000, |it| it.holds(1, first)), "{kind}");
                let second = group.lock(2);
                let begin = group.now;
                group.pass_until(begin + phase / 2, |_| false);
                let third = group.lock(3);
                group.pass_until(begin + phase, |_| false);
                let from = group.now;
                if is_holder_lost {
                    group.lost.push(1);
                } else {
                    // The holder leaves when its next waiter is lost.
                    group.lost.push(2);
                    let holder = &mut group.agents[1];
                    holder.locks.release(from, first, &mut holder.out);
                }
                let next =
                    |it: &mut Group| is_holder_lost && it.holds(2, second) || it.holds(3, third);
                let end = from + bound;
                assert!(
                    group.pass_until(end, next),
                    "{kind}, {phase} ms, holder: {is_holder_lost}"
                );
                if is_holder_lost {
                    // The agent behind the next one is not delayed by the loss again.
                    let (next, claim, other, waiting) = match group.holds(2, second) {
                        true => (2, second, 3, third),
                        false => (3, third, 2, second),
                    };
                    let now = group.now;
                    let agent = &mut group.agents[next];
                    agent.locks.release(now, claim, &mut agent.out);
                    let end = now + 20;
                    assert!(
                        group.pass_until(end, |it| it.holds(other, waiting)),
                        "{kind}, {phase} ms"
                    );
                }
            }
        }
    }
}
