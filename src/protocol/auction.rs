//! Selling: the English auction (FIPA00031) and the Dutch one (FIPA00032).

use std::time::Duration;

use bytes::Bytes;
use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_mts::Sending;

use super::bids::Bids;
use super::dialogue::{Dialogue, DialogueError, after, name_of, settle, unreached};
use crate::agent::Agent;

impl Agent {
    /// Opens an English auction (FIPA00031), in which the price rises: the message, an `inform`, tells
    /// the bidders so. Bidders that cannot be reached are left out.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::{AgentId, Performative};
    ///
    /// let bidders = ["arm_1", "arm_2"].map(AgentId::new).into_iter().collect::<Result<Vec<_>, _>>()?;
    /// let opening = agent.message(Performative::Inform).content("(for-sale crate)");
    /// let mut auction = agent.english_auction(opening, &bidders).await?;
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
    /// When the message is none that begins the protocol, or cannot be sent.
    pub async fn english_auction(
        &self,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Auction<'_>, DialogueError> {
        Auction::open(self, "fipa-auction-english", opening, bidders).await
    }

    /// Opens a Dutch auction (FIPA00032), in which the price falls until somebody bids, and goes on
    /// while something is left; see [`english_auction`](Self::english_auction).
    ///
    /// # Errors
    /// See [`english_auction`](Self::english_auction).
    pub async fn dutch_auction(
        &self,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Auction<'_>, DialogueError> {
        Auction::open(self, "fipa-auction-dutch", opening, bidders).await
    }
}

/// An auction, as the auctioneer has it. Dropped, it is not closed: the bidders are told nothing.
///
/// FIPA defines no cancelling of auctions.
#[must_use = "an auction goes on until it is closed"]
pub struct Auction<'a> {
    dialogue: Dialogue<'a>,
    /// Who can be called.
    bidders: Vec<AgentId>,
    /// Bids that are not decided upon.
    undecided: Vec<Message>,
    /// The last bid that was accepted.
    leader: Option<Message>,
}

impl<'a> Auction<'a> {
    async fn open(
        agent: &'a Agent,
        protocol: &str,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Self, DialogueError> {
        let opening = opening.receivers(bidders.to_vec());
        let (dialogue, told) = Dialogue::open(agent, protocol, opening, None).await?;
        let mut auction = Self {
            dialogue,
            bidders: bidders.to_vec(),
            undecided: Vec::new(),
            leader: None,
        };
        auction.lose(unreached(&told));
        Ok(auction)
    }

    /// The conversation's id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// Who can still be called.
    #[must_use]
    pub fn bidders(&self) -> &[AgentId] {
        &self.bidders
    }

    /// Who bid last of those whose bid was accepted.
    #[must_use]
    pub fn leader(&self) -> Option<&AgentId> {
        self.leader.as_ref()?.sender()
    }

    /// Calls a price to all bidders (`cfp`) and collects the bids that come within `patience`; it does
    /// not wait longer than until all have bid. Bids of the call before that were not accepted are
    /// rejected first. What is bid too late for its call does not count: its bidder has been
    /// called anew.
    ///
    /// # Errors
    /// When the call cannot be sent.
    pub async fn call(
        &mut self,
        price: impl Into<Bytes>,
        patience: Duration,
    ) -> Result<Bids, DialogueError> {
        let rejections = self.reject_undecided()?;
        let due = after(patience);
        let mut bids = Bids::default();
        if self.bidders.is_empty() {
            settle(rejections, due).await;
            return Ok(bids);
        }
        let call = self.message(Performative::Cfp, price);
        let told = self.dialogue.tell(call, due).await?;
        bids.silent.extend(unreached(&told).map(str::to_owned));
        self.lose(unreached(&told));
        let names = self.bidders.iter().map(|bidder| bidder.name().to_owned());
        let mut called: Vec<String> = names.collect();
        while !called.is_empty() {
            let Some((answer, over)) = bids.next(&mut self.dialogue, due).await? else {
                break;
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

    /// Accepts a bid of the last call. `content` says for what price, for example.
    ///
    /// # Errors
    /// When it is none of the last call, was decided upon before, or the answer does not arrive.
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

    /// Ends the auction and tells all bidders so (`inform`); bids that were not accepted are rejected
    /// first.
    ///
    /// # Errors
    /// When it was closed before, or the message cannot be sent.
    pub async fn close(&mut self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        let rejections = self.reject_undecided()?;
        if !self.bidders.is_empty() {
            let end = self.message(Performative::Inform, content);
            let told = self.dialogue.tell(end, None).await?;
            self.lose(unreached(&told));
        }
        settle(rejections, None).await;
        Ok(())
    }

    /// Asks the winner of an English auction that is closed to take what was sold (`request`); where
    /// the reserve was not met, it is not asked. There is no more to be said in the auction then.
    ///
    /// # Errors
    /// When the auction is not closed, nobody has won it ([`DialogueError::NoWinner`]), or the
    /// message does not arrive.
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

    /// All at once, so that nobody waits for who cannot be reached any more.
    fn reject_undecided(&mut self) -> Result<Vec<Sending>, DialogueError> {
        let mut rejections = Vec::new();
        while let Some(bid) = self.undecided.pop() {
            let act = Performative::RejectProposal;
            rejections.push(self.dialogue.post_answer(&bid, act, "", None)?);
        }
        Ok(rejections)
    }

    /// These cannot be called any more.
    fn lose<'n>(&mut self, names: impl Iterator<Item = &'n str>) {
        for name in names {
            self.bidders.retain(|bidder| bidder.name() != name);
        }
    }
}
