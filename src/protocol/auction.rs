//! The auctioneer's side of the English auction (FIPA00031) and the Dutch auction (FIPA00032).

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::{AgentId, Message, MessageBuilder, Performative};

use super::bids::{Bids, Next};
use super::dialogue::{Dialogue, DialogueError, after, name_of, settle, unreached};
use super::protocols::Protocols;
use super::reachability::Reachability;
use super::receivers::expand;
use crate::agent::AgentCore;
use crate::agent::delivery::Sent;

impl Protocols<'_> {
    /// Opens an English auction (FIPA00031), in which the price rises. The message, an `inform`,
    /// announces it to the bidders. Bidders that cannot be reached, or are gone, are left out.
    ///
    /// A pattern or a coalition among the bidders stands for the agents known now, which
    /// [`Auction::bidders`] returns. A name that is given twice counts once.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::{AgentId, Performative};
    ///
    /// let bidders = ["arm_1", "arm_2"].map(AgentId::new).into_iter().collect::<Result<Vec<_>, _>>()?;
    /// let opening = agent.message(Performative::Inform).content("(for-sale crate)");
    /// let mut auction = agent.protocols().english_auction(opening, &bidders).await?;
    /// for price in 10.. {
    ///     let bids = auction.call(price.to_string(), Duration::from_secs(1)).await?;
    ///     let Some(first) = bids.proposals.first() else { break };
    ///     auction.accept(first, "").await?;
    /// }
    /// auction.close("sold").await?;
    /// if let Some(winner) = auction.leader() {
    ///     println!("sold to {winner}");
    ///     auction.ask_winner("(take crate)").await?;
    /// }
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// If the message does not begin the protocol, or cannot be sent.
    pub async fn english_auction(
        self,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Auction, DialogueError> {
        Auction::open(self.core, "fipa-auction-english", opening, bidders).await
    }

    /// Opens a Dutch auction (FIPA00032), in which the price falls until an agent bids, and which
    /// continues while goods are left; see [`english_auction`](Self::english_auction).
    ///
    /// # Errors
    /// See [`english_auction`](Self::english_auction).
    pub async fn dutch_auction(
        self,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Auction, DialogueError> {
        Auction::open(self.core, "fipa-auction-dutch", opening, bidders).await
    }
}

/// The auctioneer's side of an auction. Dropping it does not close the auction, and sends nothing to
/// the bidders.
///
/// FIPA defines no cancel for auctions.
#[derive(Debug)]
#[must_use = "an auction goes on until it is closed"]
pub struct Auction {
    dialogue: Dialogue,
    /// The bidders that can be called.
    bidders: Vec<AgentId>,
    /// Bids of the last call without a decision.
    undecided: Vec<Message>,
    /// The last bid that was accepted.
    leader: Option<Message>,
}

impl Auction {
    async fn open(
        core: &Arc<AgentCore>,
        protocol: &str,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Self, DialogueError> {
        let bidders = expand(core, bidders).agents;
        let opening = opening.receivers(bidders.clone());
        let (dialogue, sent) = Dialogue::open(core, protocol, opening, None).await?;
        let mut auction = Self {
            dialogue,
            bidders,
            undecided: Vec::new(),
            leader: None,
        };
        auction.lose(unreached(&sent));
        Ok(auction)
    }

    /// Returns the conversation id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// Returns the bidders that can still be called.
    #[must_use]
    pub fn bidders(&self) -> &[AgentId] {
        &self.bidders
    }

    /// Returns a receiver of changes of the reachability of the bidders.
    #[must_use]
    pub fn reachability(&self) -> Reachability {
        self.dialogue.reachability()
    }

    /// Returns the bidder of the last accepted bid.
    #[must_use]
    pub fn leader(&self) -> Option<&AgentId> {
        self.leader.as_ref()?.sender()
    }

    /// Calls a price to all bidders (`cfp`) and collects the bids until all have bid, at most for
    /// `timeout`. Undecided bids of the previous call are rejected first. A bid that arrives after the
    /// time of its call is ignored, because its bidder has been called again.
    ///
    /// # Errors
    /// If the call cannot be sent.
    pub async fn call(
        &mut self,
        price: impl Into<Bytes>,
        timeout: Duration,
    ) -> Result<Bids, DialogueError> {
        let rejections = self.reject_undecided()?;
        let due = after(timeout);
        let mut bids = Bids::default();
        if self.bidders.is_empty() {
            settle(rejections, due).await;
            return Ok(bids);
        }
        let call = self.message(Performative::Cfp, price);
        let sent = self.dialogue.send(call, due).await?;
        unreached(&sent).for_each(|name| bids.miss(name));
        self.lose(unreached(&sent));
        let names = self.bidders.iter().map(|bidder| bidder.name().to_owned());
        let mut called: Vec<String> = names.collect();
        while !called.is_empty() {
            let (answer, over) = match bids.next(&mut self.dialogue, due).await? {
                Next::Answer(answer, over) => (*answer, over),
                Next::TimedOut => break,
                Next::Gone(agent) => {
                    self.lose([agent.as_str()].into_iter());
                    // Its bid can no longer be accepted.
                    self.undecided.retain(|bid| name_of(bid) != agent);
                    bids.proposals.retain(|bid| name_of(bid) != agent);
                    called.retain(|name| *name != agent);
                    bids.lose(&agent);
                    if self.dialogue.all_gone() {
                        break;
                    }
                    continue;
                }
                Next::Unreached(agent) => {
                    if let Some(at) = called.iter().position(|name| *name == agent) {
                        called.swap_remove(at);
                        self.lose([agent.as_str()].into_iter());
                        bids.miss(&agent);
                    }
                    continue;
                }
            };
            let from = name_of(&answer);
            if over {
                self.lose([from.as_str()].into_iter());
            }
            if *answer.performative() == Performative::Propose {
                self.undecided.push(answer.clone());
            }
            called.retain(|name| *name != from);
            bids.add(answer);
        }
        bids.silent.extend(called);
        settle(rejections, due).await;
        Ok(bids)
    }

    /// Accepts a bid of the last call. `content` is the content of the acceptance, for example the price.
    ///
    /// # Errors
    /// If the bid is not of the last call or already decided on, or if the answer is not delivered.
    pub async fn accept(
        &mut self,
        bid: &Message,
        content: impl Into<Bytes>,
    ) -> Result<(), DialogueError> {
        let act = Performative::AcceptProposal;
        let accepted = self.dialogue.answer(bid, act, content, None).await;
        if let Ok(()) | Err(DialogueError::NotDelivered { .. }) = accepted {
            self.undecided.retain(|undecided| undecided != bid);
        }
        accepted?;
        self.leader = Some(bid.clone());
        Ok(())
    }

    /// Ends the auction and informs all bidders (`inform`). Undecided bids are rejected first.
    ///
    /// # Errors
    /// If the auction is closed already, or the message cannot be sent.
    pub async fn close(&mut self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        let rejections = self.reject_undecided()?;
        if !self.bidders.is_empty() {
            let end = self.message(Performative::Inform, content);
            let sent = self.dialogue.send(end, None).await?;
            self.lose(unreached(&sent));
        }
        settle(rejections, None).await;
        Ok(())
    }

    /// Requests the winner of a closed English auction to take the goods (`request`), the last message
    /// of the auction. Do not call it if the reserve price was not met.
    ///
    /// # Errors
    /// If the auction is not closed, if it has no winner ([`DialogueError::NoWinner`]), or if the
    /// message is not delivered.
    pub async fn ask_winner(self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        let Self {
            mut dialogue,
            leader,
            ..
        } = self;
        let bid = leader.ok_or(DialogueError::NoWinner)?;
        let act = Performative::Request;
        dialogue.answer(&bid, act, content, None).await
    }

    fn message(&self, act: Performative, content: impl Into<Bytes>) -> MessageBuilder {
        let message = self.dialogue.agent().message(act);
        message.receivers(self.bidders.clone()).content(content)
    }

    /// Rejects the undecided bids without waiting for the outcomes, so that an unreachable bidder does
    /// not delay the others.
    fn reject_undecided(&mut self) -> Result<Vec<Sent>, DialogueError> {
        let mut rejections = Vec::new();
        while let Some(bid) = self.undecided.pop() {
            let act = Performative::RejectProposal;
            rejections.push(self.dialogue.post_answer(&bid, act, "", None)?);
        }
        Ok(rejections)
    }

    /// Removes bidders that can no longer be called.
    fn lose<'n>(&mut self, names: impl Iterator<Item = &'n str>) {
        for name in names {
            self.bidders.retain(|bidder| bidder.name() != name);
        }
    }
}
