//! Brokering and recruiting.

use super::*;

/// Registers agents, each in a membership of its own, with `monitor.check=enforce`.
async fn enforcing<const N: usize>(names: [&str; N]) -> [Agent; N] {
    let config = config(&["monitor.check=enforce"]);
    let mut agents = Vec::new();
    for name in names {
        let domain = Domain::open(&config).await.unwrap();
        agents.push(domain.register(name).await.unwrap());
    }
    agents.try_into().ok().unwrap()
}

/// Registers a rover, a broker or recruiter, and an arm.
async fn three(go_between: &str) -> [Agent; 3] {
    enforcing(["rover", go_between, "arm"]).await
}

fn proxy(rover: &Agent, go_between: &Agent) -> MessageBuilder {
    to(rover, Performative::Proxy, go_between, "any arm: load?")
}

fn query(from: &Agent, arm: &str) -> MessageBuilder {
    from.message(Performative::QueryRef)
        .receiver(AgentId::new(arm).unwrap())
        .protocol("fipa-query")
        .content("load?")
}

/// Agrees to a query and answers it.
async fn answer(arm: &Agent) -> Message {
    let first = next_message(arm).await.unwrap();
    assert_eq!(first.message().protocol(), Some("fipa-query"));
    respond(arm, &first, async |task| {
        task.agree("wait").await?;
        Ok(Reply::Inform("42".into()))
    })
    .await
    .unwrap();
    first.into_message()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_broker_forwards_answers() {
    let [rover, broker, arm] = three("broker").await;
    let initiator = async {
        let proxy = proxy(&rover, &broker);
        let mut answers = rover.protocols().brokering(proxy, TIMEOUT).await.unwrap();
        let agreed = answers.next(TIMEOUT).await.unwrap();
        assert_eq!(*agreed.performative(), Performative::Agree);
        let informed = answers.next(TIMEOUT).await.unwrap();
        assert_eq!(*informed.performative(), Performative::Inform);
        assert_eq!(informed.sender().unwrap().name(), "broker");
        assert_eq!(text(&informed), "42");
        assert_eq!(informed.language(), Some("fipa-sl"));
        let failed = answers.next(TIMEOUT).await;
        assert!(matches!(&failed, Err(DialogueError::Failed(why)) if text(why) == "no more"));
    };
    let goes_between = async {
        let first = next_message(&broker).await.unwrap();
        let mut task = broker.take_part(&first).unwrap();
        // It cannot pass a message on before it has agreed.
        let early = task.pass_on(query(&broker, "arm"), TIMEOUT).await;
        assert!(matches!(early, Err(DialogueError::WouldViolate(_))));
        task.agree("").await.unwrap();
        // What was not delivered may be sent again.
        for _ in 0..2 {
            let lost = task.pass_on(query(&broker, "unknown"), TIMEOUT).await;
            assert!(matches!(lost, Err(DialogueError::NotDelivered { .. })));
        }
        task.pass_on(query(&broker, "arm"), TIMEOUT).await.unwrap();
        task.inform("passed on").await.unwrap();
        let mut passed = 0;
        while let Some(answer) = task.next_answer(TIMEOUT).await.unwrap() {
            let mut answer = answer;
            if *answer.performative() == Performative::Inform {
                let again = broker.message(Performative::Inform).language("fipa-sl");
                let content = answer.content().unwrap().clone();
                answer = again.content(content).build().unwrap();
            }
            task.forward(&answer).await.unwrap();
            passed += 1;
        }
        assert_eq!(passed, 2);
        task.reply(Reply::Failure("no more".into())).await.unwrap();
    };
    tokio::join!(initiator, goes_between, answer(&arm));
}

#[tokio::test(flavor = "multi_thread")]
async fn recruited_agents_answer_the_initiator_directly() {
    let [rover, recruiter, arm] = three("recruiter").await;
    let initiator = async {
        let proxy = proxy(&rover, &recruiter);
        let mut answers = rover.protocols().recruiting(proxy, TIMEOUT).await.unwrap();
        for act in [Performative::Agree, Performative::Inform] {
            let answer = answers.next(TIMEOUT).await.unwrap();
            assert_eq!(*answer.performative(), act);
            assert_eq!(answer.sender().unwrap().name(), "arm");
        }
        let none = answers.next(Duration::from_millis(100)).await;
        assert!(matches!(none, Err(DialogueError::TimedOut)));
    };
    let (early, answered) = tokio::sync::oneshot::channel();
    let goes_between = async {
        let first = next_message(&recruiter).await.unwrap();
        let mut task = recruiter.take_part(&first).unwrap();
        task.agree("").await.unwrap();
        task.pass_on(query(&recruiter, "arm"), TIMEOUT)
            .await
            .unwrap();
        // The answers may arrive before the report of the recruiter.
        answered.await.unwrap();
        task.inform("recruited").await.unwrap();
        assert!(task.next_answer(TIMEOUT).await.unwrap().is_none());
    };
    let recruited = async {
        let first = answer(&arm).await;
        assert_eq!(first.reply_to()[0].name(), "rover");
        assert_eq!(first.sender().unwrap().name(), "recruiter");
        early.send(()).unwrap();
    };
    tokio::join!(initiator, goes_between, recruited);
}

/// Passes a call for proposals on to the arm, with this agent as its `reply-to`.
async fn recruit(recruiter: &Agent, reply_to: Option<&Agent>) {
    let first = next_message(recruiter).await.unwrap();
    let mut task = recruiter.take_part(&first).unwrap();
    task.agree("").await.unwrap();
    let mut call = recruiter
        .message(Performative::Cfp)
        .receiver(AgentId::new("arm").unwrap())
        .protocol("fipa-contract-net")
        .content("lift?");
    if let Some(agent) = reply_to {
        call = call.reply_to(agent.id().clone());
    }
    task.pass_on(call, TIMEOUT).await.unwrap();
    task.inform("recruited").await.unwrap();
}

async fn propose(arm: &Agent) {
    let first = next_message(arm).await.unwrap();
    respond(arm, &first, async |task| {
        assert!(task.propose("20", TIMEOUT).await?);
        Ok(Reply::Inform(task.message().content().unwrap().clone()))
    })
    .await
    .unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_initiator_accepts_the_proposal_of_a_recruited_agent() {
    let [rover, recruiter, arm] = three("recruiter").await;
    let initiator = async {
        let proxy = proxy(&rover, &recruiter);
        let mut answers = rover.protocols().recruiting(proxy, TIMEOUT).await.unwrap();
        let proposal = answers.next(TIMEOUT).await.unwrap();
        assert_eq!(*proposal.performative(), Performative::Propose);
        let early = answers.answer(&proposal, Performative::Cfp, "", TIMEOUT);
        assert!(matches!(early.await, Err(DialogueError::WouldViolate(_))));
        let accept = answers.answer(&proposal, Performative::AcceptProposal, "do", TIMEOUT);
        accept.await.unwrap();
        let done = answers.next(TIMEOUT).await.unwrap();
        assert_eq!(*done.performative(), Performative::Inform);
        assert_eq!(text(&done), "do");
        let again = answers.answer(&proposal, Performative::AcceptProposal, "", TIMEOUT);
        assert!(matches!(again.await, Err(DialogueError::WouldViolate(_))));
    };
    tokio::join!(initiator, recruit(&recruiter, None), propose(&arm));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_designated_receiver_accepts_the_proposal_of_a_recruited_agent() {
    let [rover, recruiter, arm, base] = enforcing(["rover", "recruiter", "arm", "base"]).await;
    let initiator = async {
        let proxy = proxy(&rover, &recruiter);
        let _answers = rover.protocols().recruiting(proxy, TIMEOUT).await.unwrap();
    };
    let designated = async {
        let proposal = next_message(&base).await.unwrap().into_message();
        assert_eq!(*proposal.performative(), Performative::Propose);
        let accept = base.reply(&proposal, Performative::AcceptProposal);
        let accept = accept.content("do").build().unwrap();
        base.send(accept.clone()).await.unwrap();
        // The protocol is enforced as for agents that began the conversation.
        let again = base.send(accept).await;
        assert!(matches!(again, Err(SendError::Violation(_))), "{again:?}");
        let done = next_message(&base).await.unwrap().into_message();
        assert_eq!(*done.performative(), Performative::Inform);
    };
    let goes_between = recruit(&recruiter, Some(&base));
    tokio::join!(initiator, goes_between, propose(&arm), designated);
}

#[tokio::test(flavor = "multi_thread")]
async fn recruited_agents_answer_the_designated_receiver() {
    // The base gets no message before the answers.
    let [rover, recruiter, arm, base] = enforcing(["rover", "recruiter", "arm", "base"]).await;
    let initiator = async {
        let proxy = proxy(&rover, &recruiter);
        let _answers = rover.protocols().recruiting(proxy, TIMEOUT).await.unwrap();
    };
    let goes_between = async {
        let first = next_message(&recruiter).await.unwrap();
        let mut task = recruiter.take_part(&first).unwrap();
        task.agree("").await.unwrap();
        let query = query(&recruiter, "arm").reply_to(base.id().clone());
        task.pass_on(query, TIMEOUT).await.unwrap();
        task.inform("recruited").await.unwrap();
    };
    let designated = async {
        for act in [Performative::Agree, Performative::Inform] {
            let answer = next_message(&base).await.unwrap().into_message();
            assert_eq!(*answer.performative(), act);
            assert_eq!(answer.sender().unwrap().name(), "arm");
        }
    };
    tokio::join!(initiator, goes_between, answer(&arm), designated);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_broker_or_recruiter_may_refuse_or_find_no_agent() {
    let [rover, broker, _arm] = three("broker").await;
    let initiator = async {
        let refused = rover
            .protocols()
            .brokering(proxy(&rover, &broker), TIMEOUT)
            .await;
        assert!(matches!(refused.err(), Some(DialogueError::Refused(_))));
        let none = rover
            .protocols()
            .recruiting(proxy(&rover, &broker), TIMEOUT)
            .await;
        assert!(matches!(none.err(), Some(DialogueError::Failed(_))));
        let moment = Duration::from_secs(5);
        let silent = rover
            .protocols()
            .brokering(proxy(&rover, &broker), moment)
            .await;
        assert!(matches!(silent.err(), Some(DialogueError::TimedOut)));
    };
    let goes_between = async {
        let first = next_message(&broker).await.unwrap();
        respond(&broker, &first, async |_| Ok(Reply::Refuse("no".into())))
            .await
            .unwrap();
        let first = next_message(&broker).await.unwrap();
        respond(&broker, &first, async |task| {
            task.agree("").await?;
            Ok(Reply::Failure("no match".into()))
        })
        .await
        .unwrap();
    };
    tokio::join!(initiator, goes_between);
}

#[tokio::test(flavor = "multi_thread")]
async fn brokering_is_cancelled() {
    let [rover, broker, arm] = three("broker").await;
    let initiator = async {
        let proxy = proxy(&rover, &broker);
        let answers = rover.protocols().brokering(proxy, TIMEOUT).await.unwrap();
        answers.cancel(TIMEOUT).await.unwrap();
    };
    let goes_between = async {
        let first = next_message(&broker).await.unwrap();
        let mut task = broker.take_part(&first).unwrap();
        task.agree("").await.unwrap();
        task.pass_on(query(&broker, "arm"), TIMEOUT).await.unwrap();
        task.inform("passed on").await.unwrap();
        // The arm never answers.
        let cancelled = task.next_answer(TIMEOUT).await;
        assert!(matches!(cancelled, Err(DialogueError::Cancelled(_))));
        let nothing = task.confirm_cancel().await.unwrap();
        task.reply(nothing).await.unwrap();
    };
    tokio::join!(initiator, goes_between);
    assert!(arm.try_receive().unwrap().is_some());
}
