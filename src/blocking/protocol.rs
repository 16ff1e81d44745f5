//! The calls of [`crate::protocol`] under the same names, blocking.

use std::ops::Deref;
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::{Message, MessageBuilder, Performative};
use tokio::runtime::Runtime;

use super::Agent;
use crate::AgentId;
use crate::protocol::{
    Auction, Awarded, Bids, ContractNet, Decision, DialogueError, Proxied, Reply, Request,
    Subscription, Task,
};

/// One side of a conversation with blocking calls: a [`Request`], [`Subscription`], [`ContractNet`],
/// [`Auction`], [`Proxied`] or [`Task`]. Dereferences to that type for the calls that do not wait.
#[derive(Debug)]
#[must_use = "the conversation goes on with the calls of the inner type"]
pub struct Side<'a, T> {
    inner: T,
    runtime: &'a Runtime,
}

impl<T> Deref for Side<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.inner
    }
}

impl Agent {
    fn side<T>(
        &self,
        begin: impl Future<Output = Result<T, DialogueError>>,
    ) -> Result<Side<'_, T>, DialogueError> {
        Ok(Side {
            inner: self.runtime.block_on(begin)?,
            runtime: &self.runtime,
        })
    }

    /// See [`crate::Agent::request`].
    ///
    /// ```no_run
    /// # fn example(agent: fipa::blocking::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::{AgentId, Performative};
    ///
    /// let lift = agent
    ///     .message(Performative::Request)
    ///     .receiver(AgentId::new("arm_1")?)
    ///     .content("(lift crate)");
    /// println!("{}", agent.request(lift, Duration::from_secs(30))?.result()?);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// As for the async call.
    pub fn request(
        &self,
        request: MessageBuilder,
        patience: Duration,
    ) -> Result<Side<'_, Request<'_>>, DialogueError> {
        self.side(self.agent.request(request, patience))
    }

    /// See [`crate::Agent::query`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn query(
        &self,
        query: MessageBuilder,
        patience: Duration,
    ) -> Result<Side<'_, Request<'_>>, DialogueError> {
        self.side(self.agent.query(query, patience))
    }

    /// See [`crate::Agent::request_when`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn request_when(
        &self,
        request: MessageBuilder,
        patience: Duration,
    ) -> Result<Side<'_, Request<'_>>, DialogueError> {
        self.side(self.agent.request_when(request, patience))
    }

    /// See [`crate::Agent::propose`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn propose(
        &self,
        proposal: MessageBuilder,
        patience: Duration,
    ) -> Result<Decision, DialogueError> {
        self.runtime
            .block_on(self.agent.propose(proposal, patience))
    }

    /// See [`crate::Agent::subscribe`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn subscribe(
        &self,
        subscribe: MessageBuilder,
        patience: Duration,
    ) -> Result<Side<'_, Subscription<'_>>, DialogueError> {
        self.side(self.agent.subscribe(subscribe, patience))
    }

    /// See [`crate::Agent::contract_net`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn contract_net(
        &self,
        call: MessageBuilder,
        receivers: &[AgentId],
        patience: Duration,
    ) -> Result<Side<'_, ContractNet<'_>>, DialogueError> {
        self.side(self.agent.contract_net(call, receivers, patience))
    }

    /// See [`crate::Agent::iterated_contract_net`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn iterated_contract_net(
        &self,
        call: MessageBuilder,
        receivers: &[AgentId],
        patience: Duration,
    ) -> Result<Side<'_, ContractNet<'_>>, DialogueError> {
        self.side(self.agent.iterated_contract_net(call, receivers, patience))
    }

    /// See [`crate::Agent::english_auction`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn english_auction(
        &self,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Side<'_, Auction<'_>>, DialogueError> {
        self.side(self.agent.english_auction(opening, bidders))
    }

    /// See [`crate::Agent::dutch_auction`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn dutch_auction(
        &self,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Side<'_, Auction<'_>>, DialogueError> {
        self.side(self.agent.dutch_auction(opening, bidders))
    }

    /// See [`crate::Agent::brokering`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn brokering(
        &self,
        proxy: MessageBuilder,
        patience: Duration,
    ) -> Result<Side<'_, Proxied<'_>>, DialogueError> {
        self.side(self.agent.brokering(proxy, patience))
    }

    /// See [`crate::Agent::recruiting`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn recruiting(
        &self,
        proxy: MessageBuilder,
        patience: Duration,
    ) -> Result<Side<'_, Proxied<'_>>, DialogueError> {
        self.side(self.agent.recruiting(proxy, patience))
    }

    /// See [`crate::Agent::take_part`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn take_part(&self, first: &Message) -> Result<Side<'_, Task<'_>>, DialogueError> {
        Ok(Side {
            inner: self.agent.take_part(first)?,
            runtime: &self.runtime,
        })
    }
}

/// Defines the blocking calls of one type, each with a link to the documentation of the async call.
macro_rules! blocking {
    ($side:ident: $(
        $(#[$kind:ident])? fn $name:ident($($argument:ident: $type:ty),*) -> $output:ty;
    )*) => {
        #[allow(clippy::should_implement_trait, reason = "unlike an iterator, it goes on after an error")]
        impl Side<'_, $side<'_>> {
            $(blocking!(@ $($kind)? $side $name ($($argument: $type),*) $output);)*
        }
    };
    (@ last $side:ident $name:ident ($($argument:ident: $type:ty),*) $output:ty) => {
        #[doc = concat!("See [`", stringify!($side), "::", stringify!($name), "`].\n\n")]
        #[doc = "# Errors\nAs for the async call."]
        pub fn $name(self, $($argument: $type),*) -> Result<$output, DialogueError> {
            self.runtime.block_on(self.inner.$name($($argument),*))
        }
    };
    (@ $side:ident $name:ident ($($argument:ident: $type:ty),*) $output:ty) => {
        #[doc = concat!("See [`", stringify!($side), "::", stringify!($name), "`].\n\n")]
        #[doc = "# Errors\nAs for the async call."]
        pub fn $name(&mut self, $($argument: $type),*) -> Result<$output, DialogueError> {
            self.runtime.block_on(self.inner.$name($($argument),*))
        }
    };
}

blocking! { Request:
    fn agreed() -> bool;
    #[last] fn result() -> Message;
    #[last] fn cancel(patience: Duration) -> ();
}

blocking! { Subscription:
    fn next() -> Message;
    #[last] fn cancel(patience: Duration) -> ();
}

blocking! { ContractNet:
    fn call_again(invited: &[Message], call: MessageBuilder, patience: Duration) -> ();
    fn award(accepted: &[Message], content: &str, patience: Duration) -> Vec<Awarded>;
    #[last] fn cancel(patience: Duration) -> ();
}

blocking! { Auction:
    fn call(price: impl Into<Bytes>, patience: Duration) -> Bids;
    fn accept(bid: &Message, content: impl Into<Bytes>) -> ();
    fn close(content: impl Into<Bytes>) -> ();
    #[last] fn ask_winner(content: impl Into<Bytes>) -> ();
}

blocking! { Proxied:
    fn next(patience: Duration) -> Message;
    fn answer(
        to: &Message,
        act: Performative,
        content: impl Into<Bytes>,
        patience: Duration
    ) -> ();
    #[last] fn cancel(patience: Duration) -> ();
}

blocking! { Task:
    fn agree(content: impl Into<Bytes>) -> ();
    fn inform(content: impl Into<Bytes>) -> ();
    fn propose(content: impl Into<Bytes>, patience: Duration) -> bool;
    fn next_call(patience: Duration) -> Option<Message>;
    fn next(patience: Duration) -> Message;
    fn pass_on(message: MessageBuilder, patience: Duration) -> ();
    fn next_answer(patience: Duration) -> Option<Message>;
    fn forward(answer: &Message) -> ();
    fn confirm_cancel() -> Reply;
    #[last] fn reply(reply: Reply) -> ();
}

impl Side<'_, Task<'_>> {
    /// Waits up to `patience` for a cancel of the initiator, and returns whether it came. For a
    /// participant that checks between two steps of its work; see [`Task::cancelled`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn cancelled(&mut self, patience: Duration) -> Result<bool, DialogueError> {
        self.runtime.block_on(async {
            match tokio::time::timeout(patience, self.inner.cancelled()).await {
                Ok(cancelled) => cancelled.map(|()| true),
                Err(_) => Ok(false),
            }
        })
    }
}
