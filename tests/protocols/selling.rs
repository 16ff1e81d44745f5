//! The iterated contract net, auctions, and contract nets that are cancelled or disturbed.

use super::*;

/// Registers a rover, and agents of another process.
async fn rover_and<const N: usize>(names: [&str; N]) -> (Agent, [Agent; N]) {
    let (here, there) = two(&["monitor.check=enforce"]).await;
    let rover = here.register("rover").await.unwrap();
    (rover, registered(&there, names).await)
}

fn ids(agents: &[Agent]) -> Vec<AgentId> {
    agents.iter().map(|agent| agent.id().clone()).collect()
}

fn cfp(agent: &Agent, content: &str) -> MessageBuilder {
    agent.message(Performative::Cfp).content(content.to_owned())
}

fn name(message: &Message) -> &str {
    message.sender().unwrap().name()
}

fn from<'m>(messages: &'m [Message], sender: &str) -> &'m Message {
    let mut messages = messages.iter();
    messages.find(|message| name(message) == sender).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn an_iterated_contract_net_calls_some_participants_again() {
    let (rover, arms) = rover_and(["cheap", "dear", "stubborn"]).await;
    let called = ids(&arms);
    // Proposes these prices in turn. Returns the number of calls, and whether a proposal was accepted.
    let bid = async |arm: &Agent, prices: &[&'static str]| {
        let call = next_message(arm).await.unwrap();
        let mut task = arm.take_part(&call).unwrap();
        let mut calls = 1;
        for price in prices {
            if task.propose(*price, TIMEOUT).await.unwrap() {
                assert_eq!(text(task.message()), "yours");
                task.reply(Reply::Inform("carried".into())).await.unwrap();
                return (calls, true);
            }
            match task.next_call(TIMEOUT).await.unwrap() {
                Some(call) => assert_eq!(text(&call), "cheaper?"),
                None => return (calls, false),
            }
            calls += 1;
        }
        task.reply(Reply::Refuse("no".into())).await.unwrap();
        (calls, false)
    };
    let initiator = async {
        let mut net = rover
            .protocols()
            .iterated_contract_net(cfp(&rover, "carry"), &called, TIMEOUT)
            .await
            .unwrap();
        assert_eq!(net.bids().proposals.len(), 3);
        let some = [
            from(&net.bids().proposals, "cheap").clone(),
            from(&net.bids().proposals, "stubborn").clone(),
        ];
        net.call_again(&some, cfp(&rover, "cheaper?"), TIMEOUT)
            .await
            .unwrap();
        let bids = net.bids().clone();
        assert_eq!((bids.proposals.len(), bids.refusals.len()), (1, 1));
        assert!(bids.silent.is_empty() && bids.violations.is_empty());
        let results = net.award(&bids.proposals, "yours", TIMEOUT).await.unwrap();
        assert_eq!(results[0].agent, "cheap");
        assert_eq!(text(results[0].result.as_ref().unwrap()), "carried");
    };
    let (_, cheap, dear, stubborn) = tokio::join!(
        initiator,
        bid(&arms[0], &["20", "10"]),
        bid(&arms[1], &["99"]),
        bid(&arms[2], &["30"])
    );
    assert_eq!(cheap, (2, true));
    assert_eq!(dear, (1, false), "rejected");
    assert_eq!(stubborn, (2, false));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_call_in_a_contract_net_is_refused() {
    let (rover, arms) = rover_and(["arm"]).await;
    let initiator = async {
        let mut net = rover
            .contract_net(cfp(&rover, "carry"), &ids(&arms), TIMEOUT)
            .await
            .unwrap();
        let bids = net.bids().proposals.clone();
        let again = net.call_again(&bids, cfp(&rover, "cheaper?"), TIMEOUT);
        assert!(matches!(again.await, Err(DialogueError::WouldViolate(_))));
        // The proposals can still be awarded.
        let results = net.award(&bids, "", TIMEOUT).await.unwrap();
        assert!(results[0].result.is_ok());
    };
    let participant = async {
        let call = arms[0].receive().await.unwrap();
        let mut task = arms[0].take_part(&call).unwrap();
        assert!(task.propose("10", TIMEOUT).await.unwrap());
        task.reply(Reply::Inform("done".into())).await.unwrap();
    };
    tokio::join!(initiator, participant);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_violation_by_one_participant_does_not_affect_the_others() {
    // The arms do not check what they send.
    let unchecked = config(&[]);
    let mut checked = config(&["monitor.check=enforce"]);
    checked.domain.clone_from(&unchecked.domain);
    let (here, there) = (
        Domain::open(&checked).await.unwrap(),
        Domain::open(&unchecked).await.unwrap(),
    );
    let rover = here.register("rover").await.unwrap();
    let arms = registered(&there, ["wild", "tame"]).await;
    let [wild, tame] = &arms;
    let participants = async {
        let call = next_message(wild).await.unwrap().into_message();
        let early = wild.reply(&call, Performative::Inform).build().unwrap();
        wild.send(early).await.unwrap();
        let late = wild.reply(&call, Performative::Propose).build().unwrap();
        wild.send(late).await.unwrap();
        let call = next_message(tame).await.unwrap();
        let mut task = tame.take_part(&call).unwrap();
        assert!(task.propose("10", TIMEOUT).await.unwrap());
        // Arrives while the other agent works.
        let wrong = wild
            .reply(call.message(), Performative::Agree)
            .build()
            .unwrap();
        wild.send(wrong).await.unwrap();
        task.reply(Reply::Inform("done".into())).await.unwrap();
    };
    let initiator = async {
        let mut net = rover
            .contract_net(cfp(&rover, "carry"), &ids(&arms), TIMEOUT)
            .await
            .unwrap();
        let bids = net.bids().clone();
        assert_eq!(bids.proposals.len(), 2);
        let [violation] = &bids.violations[..] else {
            panic!("{bids:?}");
        };
        assert_eq!(
            (violation.sender.as_str(), violation.kind),
            ("wild", ViolationKind::OutOfOrder)
        );
        let tame = from(&bids.proposals, "tame").clone();
        let results = net.award(&[tame], "", TIMEOUT).await.unwrap();
        assert_eq!(results.len(), 1);
        assert!(results[0].result.is_ok());
    };
    tokio::join!(participants, initiator);
}

#[tokio::test(flavor = "multi_thread")]
async fn winners_do_not_wait_for_losers() {
    let config = config(&["monitor.check=enforce", "mts.queue=1"]);
    let (here, there) = (
        Domain::open(&config).await.unwrap(),
        Domain::open(&config).await.unwrap(),
    );
    let rover = here.register("rover").await.unwrap();
    let arms = registered(&there, ["loser", "winner"]).await;
    let [loser, winner] = &arms;
    let (proposed, first) = tokio::sync::oneshot::channel();
    let (done, finished) = tokio::sync::oneshot::channel();
    let loses = async {
        let call = next_message(loser).await.unwrap().into_message();
        let bid = loser.reply(&call, Performative::Propose).build().unwrap();
        loser.send(bid).await.unwrap();
        // The letter fills its queue, so that the rejection has to wait.
        let full = loser.message(Performative::Inform);
        let full = full.receiver(loser.id().clone()).content("full");
        loser.send(full.build().unwrap()).await.unwrap();
        proposed.send(()).unwrap();
        finished.await.unwrap();
        assert_eq!(text(next_message(loser).await.unwrap().message()), "full");
        let rejected = next_message(loser).await.unwrap().into_message();
        assert_eq!(*rejected.performative(), Performative::RejectProposal);
    };
    let wins = async {
        let call = next_message(winner).await.unwrap();
        first.await.unwrap();
        let mut task = winner.take_part(&call).unwrap();
        assert!(task.propose("10", TIMEOUT).await.unwrap());
        task.reply(Reply::Inform("done".into())).await.unwrap();
        done.send(()).unwrap();
    };
    let initiator = async {
        let mut net = rover
            .contract_net(cfp(&rover, "carry"), &ids(&arms), TIMEOUT)
            .await
            .unwrap();
        let bids = net.bids().proposals.clone();
        assert_eq!(name(&bids[0]), "loser", "it is answered first");
        let results = net.award(&bids[1..], "", TIMEOUT).await.unwrap();
        assert_eq!(results.len(), 1);
        assert!(results[0].result.is_ok(), "{results:?}");
    };
    tokio::join!(loses, wins, initiator);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_contract_net_is_cancelled_with_all_open_participants() {
    let (rover, arms) = rover_and(["waiting", "thinking", "refusing"]).await;
    let [waiting, thinking, refusing] = &arms;
    let waits = async {
        let call = next_message(waiting).await.unwrap();
        let mut task = waiting.take_part(&call).unwrap();
        let cancelled = task.propose("10", TIMEOUT).await;
        assert!(matches!(cancelled, Err(DialogueError::Cancelled(_))));
        let nothing = task.confirm_cancel().await.unwrap();
        task.reply(nothing).await.unwrap();
    };
    let thinks = async {
        let call = next_message(thinking).await.unwrap();
        let mut task = thinking.take_part(&call).unwrap();
        task.cancelled().await.unwrap();
        let nothing = task.confirm_cancel().await.unwrap();
        task.reply(nothing).await.unwrap();
    };
    let refuses = async {
        let call = next_message(refusing).await.unwrap();
        respond(refusing, &call, async |_| Ok(Reply::Refuse("no".into())))
            .await
            .unwrap();
    };
    let initiator = async {
        // Long enough for the two that answer; the third never does.
        let timeout = Duration::from_secs(6);
        let net = rover
            .contract_net(cfp(&rover, "carry"), &ids(&arms), timeout)
            .await
            .unwrap();
        assert_eq!(net.bids().silent, ["thinking"]);
        net.cancel(TIMEOUT).await.unwrap();
    };
    tokio::join!(initiator, waits, thinks, refuses);
    let message = refusing.try_receive().unwrap();
    assert!(message.is_none(), "its conversation has ended already");
}

/// Bids at acceptable prices. Returns the numbers of calls and of accepted bids, and the request to the
/// winner.
async fn bidder(
    agent: &Agent,
    accepts: impl Fn(u32) -> bool,
    buys: usize,
) -> (usize, usize, Option<String>) {
    let opening = next_message(agent).await.unwrap();
    assert_eq!(text(opening.message()), "a crate");
    let mut task = agent.take_part(&opening).unwrap();
    let (mut calls, mut bought) = (0, 0);
    while let Some(call) = task.next_call(TIMEOUT).await.unwrap() {
        calls += 1;
        let price = text(&call).parse().unwrap();
        if accepts(price) && task.state() != "called-leading" && bought < buys {
            bought += usize::from(task.propose("", TIMEOUT).await.unwrap());
        }
    }
    let mut asked = None;
    if task.state() == "won" {
        asked = Some(text(&task.next(TIMEOUT).await.unwrap()).to_owned());
    }
    (calls, bought, asked)
}

#[tokio::test(flavor = "multi_thread")]
async fn the_last_bidder_wins_an_english_auction() {
    let (rover, arms) = rover_and(["rich", "poor"]).await;
    let mut bidders = ids(&arms);
    bidders.push(AgentId::new("unknown").unwrap());
    let auctioneer = async {
        let opening = rover.message(Performative::Inform).content("a crate");
        let mut auction = rover
            .protocols()
            .english_auction(opening, &bidders)
            .await
            .unwrap();
        assert_eq!(auction.bidders(), ids(&arms));
        // Both bid, and one bid is accepted. The next call rejects the other one.
        let bids = auction.call("10", TIMEOUT).await.unwrap();
        assert_eq!(bids.proposals.len(), 2);
        auction
            .accept(from(&bids.proposals, "poor"), "yours")
            .await
            .unwrap();
        assert_eq!(auction.leader().unwrap().name(), "poor");
        let twice = auction.accept(from(&bids.proposals, "poor"), "").await;
        assert!(matches!(twice, Err(DialogueError::WouldViolate(_))));
        let moment = Duration::from_secs(5);
        let bids = auction.call("20", moment).await.unwrap();
        assert_eq!(bids.silent, ["poor"], "it leads");
        auction.accept(&bids.proposals[0], "").await.unwrap();
        // 30 is too much for the other bidder.
        let bids = auction.call("30", moment).await.unwrap();
        assert_eq!(bids.proposals, []);
        auction.close("sold").await.unwrap();
        assert_eq!(auction.leader().unwrap().name(), "rich");
        assert!(auction.close("sold again").await.is_err());
        auction.ask_winner("take it").await.unwrap();
    };
    let (_, rich, poor) = tokio::join!(
        auctioneer,
        bidder(&arms[0], |price| price <= 50, 9),
        bidder(&arms[1], |price| price <= 10, 9)
    );
    assert_eq!(rich, (3, 1, Some("take it".to_owned())));
    assert_eq!(poor, (3, 1, None), "outbid");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dutch_auction_continues_while_goods_are_left() {
    let (rover, arms) = rover_and(["eager", "patient"]).await;
    let auctioneer = async {
        let opening = rover.message(Performative::Inform).content("a crate");
        let mut auction = rover
            .protocols()
            .dutch_auction(opening, &ids(&arms))
            .await
            .unwrap();
        let mut sold = Vec::new();
        let mut price = 40;
        while sold.len() < 2 {
            let moment = Duration::from_secs(5);
            let bids = auction.call(price.to_string(), moment).await.unwrap();
            if let Some(first) = bids.proposals.first() {
                auction.accept(first, "").await.unwrap();
                let buyer = auction.leader().unwrap().name().to_owned();
                sold.push((buyer, price));
            }
            price -= 10;
        }
        auction.close("all gone").await.unwrap();
        // A Dutch auction has no request to the winner.
        let asked = auction.ask_winner("take it").await;
        assert!(matches!(asked, Err(DialogueError::WouldViolate(_))));
        sold
    };
    let (sold, eager, patient) = tokio::join!(
        auctioneer,
        bidder(&arms[0], |price| price <= 30, 1),
        bidder(&arms[1], |price| price <= 10, 1)
    );
    let name = |name: &str, price| (name.to_owned(), price);
    assert_eq!(sold, [name("eager", 30), name("patient", 10)]);
    assert_eq!((eager.1, patient.1), (1, 1));
    assert_eq!((eager.0, patient.0), (4, 4));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_auction_without_a_bid_has_no_winner() {
    let (rover, arms) = rover_and(["arm"]).await;
    let auctioneer = async {
        let opening = rover.message(Performative::Inform).content("a crate");
        let mut auction = rover
            .protocols()
            .english_auction(opening, &ids(&arms))
            .await
            .unwrap();
        let moment = Duration::from_secs(1);
        assert!(
            auction
                .call("10", moment)
                .await
                .unwrap()
                .proposals
                .is_empty()
        );
        auction.close("not sold").await.unwrap();
        let no_winner = auction.ask_winner("take it").await;
        assert!(matches!(no_winner, Err(DialogueError::NoWinner)));
    };
    let (_, bid) = tokio::join!(auctioneer, bidder(&arms[0], |_| false, 0));
    assert_eq!(bid, (1, 0, None));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bid_that_crosses_the_next_call_does_not_count() {
    let (rover, arms) = rover_and(["arm"]).await;
    let [arm] = &arms;
    let (first_over, ended) = tokio::sync::oneshot::channel();
    let auctioneer = async {
        let opening = rover.message(Performative::Inform).content("a crate");
        let mut auction = rover
            .protocols()
            .english_auction(opening, &ids(&arms))
            .await
            .unwrap();
        let moment = Duration::from_secs(1);
        let bids = auction.call("10", moment).await.unwrap();
        assert_eq!(bids.silent, ["arm"]);
        first_over.send(()).unwrap();
        let bids = auction.call("20", TIMEOUT).await.unwrap();
        assert_eq!(bids.proposals.len(), 1);
        assert_eq!(text(&bids.proposals[0]), "for 20");
        assert!(bids.violations.is_empty());
        auction.accept(&bids.proposals[0], "").await.unwrap();
        auction.close("sold").await.unwrap();
        auction.ask_winner("take it").await.unwrap();
    };
    let participant = async {
        let opening = next_message(arm).await.unwrap();
        let mut task = arm.take_part(&opening).unwrap();
        task.next_call(TIMEOUT).await.unwrap().unwrap();
        // The time of the first call is over when this bid is sent.
        ended.await.unwrap();
        assert!(!task.propose("for 10", TIMEOUT).await.unwrap());
        let second = task.next_call(TIMEOUT).await.unwrap().unwrap();
        assert_eq!(text(&second), "20");
        assert!(task.propose("for 20", TIMEOUT).await.unwrap());
        assert!(task.next_call(TIMEOUT).await.unwrap().is_none());
        assert_eq!(text(&task.next(TIMEOUT).await.unwrap()), "take it");
    };
    tokio::join!(auctioneer, participant);
}
