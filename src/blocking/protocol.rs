//! The calls of [`crate::protocol`] under the same names, blocking.

use std::fmt::Display;
use std::ops::Deref;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::{Message, MessageBuilder, Performative};

use tokio::runtime::Handle;

use super::{Agent, Background, Waiter};
use crate::domain::background;
use crate::protocol::{
    Auction, Awarded, Bids, ContractNet, Decision, DialogueError, PartnerEvent, PartnerWatch,
    Proxied, Publisher, Reply, Request, Server, Subscription, Task,
};
use crate::{AgentId, AgentIdError, Incoming};

/// One side of a conversation with blocking calls: a [`Request`], [`Subscription`], [`ContractNet`],
/// [`Auction`], [`Proxied`] or [`Task`], or a [`Server`], [`Publisher`] or [`PartnerWatch`]. Dereferences to that type for the calls that do not wait.
#[derive(Debug)]
#[must_use = "the conversation goes on with the calls of the inner type"]
pub struct Side<T> {
    inner: T,
    runtime: Waiter,
    /// Keeps the background thread running; `None` for a conversation that runs on it.
    _background: Option<Background>,
}

impl<T> Deref for Side<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.inner
    }
}

impl Agent {
    fn side<T>(
        &self,
        begin: impl Future<Output = Result<T, DialogueError>>,
    ) -> Result<Side<T>, DialogueError> {
        let inner = self.runtime.block_on(begin)?;
        Ok(self.side_of(inner))
    }

    fn side_of<T>(&self, inner: T) -> Side<T> {
        Side {
            inner,
            runtime: self.runtime.waiter.clone(),
            _background: Some(self.runtime.clone()),
        }
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
        timeout: Duration,
    ) -> Result<Side<Request>, DialogueError> {
        self.side(self.agent.request(request, timeout))
    }

    /// See [`crate::Agent::query`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn query(
        &self,
        query: MessageBuilder,
        timeout: Duration,
    ) -> Result<Side<Request>, DialogueError> {
        self.side(self.agent.query(query, timeout))
    }

    /// See [`crate::Agent::request_when`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn request_when(
        &self,
        request: MessageBuilder,
        timeout: Duration,
    ) -> Result<Side<Request>, DialogueError> {
        self.side(self.agent.request_when(request, timeout))
    }

    /// See [`crate::Agent::propose`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn propose(
        &self,
        proposal: MessageBuilder,
        timeout: Duration,
    ) -> Result<Decision, DialogueError> {
        self.runtime.block_on(self.agent.propose(proposal, timeout))
    }

    /// See [`crate::Agent::subscribe`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn subscribe(
        &self,
        subscribe: MessageBuilder,
        timeout: Duration,
    ) -> Result<Side<Subscription>, DialogueError> {
        self.side(self.agent.subscribe(subscribe, timeout))
    }

    /// See [`crate::Agent::contract_net`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn contract_net<A>(
        &self,
        call: MessageBuilder,
        receivers: &[A],
        timeout: Duration,
    ) -> Result<Side<ContractNet>, DialogueError>
    where
        A: Clone + TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        self.side(self.agent.contract_net(call, receivers, timeout))
    }

    /// See [`crate::Agent::iterated_contract_net`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn iterated_contract_net<A>(
        &self,
        call: MessageBuilder,
        receivers: &[A],
        timeout: Duration,
    ) -> Result<Side<ContractNet>, DialogueError>
    where
        A: Clone + TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        self.side(self.agent.iterated_contract_net(call, receivers, timeout))
    }

    /// See [`crate::Agent::english_auction`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn english_auction(
        &self,
        opening: MessageBuilder,
        bidders: &[AgentId],
    ) -> Result<Side<Auction>, DialogueError> {
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
    ) -> Result<Side<Auction>, DialogueError> {
        self.side(self.agent.dutch_auction(opening, bidders))
    }

    /// See [`crate::Agent::brokering`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn brokering(
        &self,
        proxy: MessageBuilder,
        timeout: Duration,
    ) -> Result<Side<Proxied>, DialogueError> {
        self.side(self.agent.brokering(proxy, timeout))
    }

    /// See [`crate::Agent::recruiting`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn recruiting(
        &self,
        proxy: MessageBuilder,
        timeout: Duration,
    ) -> Result<Side<Proxied>, DialogueError> {
        self.side(self.agent.recruiting(proxy, timeout))
    }

    /// See [`crate::Agent::take_part`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn take_part(&self, first: &Incoming) -> Result<Side<Task>, DialogueError> {
        Ok(self.side_of(self.agent.take_part(first)?))
    }

    /// Serves a protocol like [`crate::Agent::serve`]. The handler runs in a thread of its own for each
    /// conversation.
    ///
    /// ```no_run
    /// # fn example(agent: fipa::blocking::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use fipa::blocking::Side;
    /// use fipa::protocol::{DialogueError, Reply, Task};
    ///
    /// let mut server = agent.serve("fipa-request", |mut task: Side<Task>| {
    ///     task.agree("")?;
    ///     Ok::<_, DialogueError>(Reply::Inform("done".into()))
    /// })?;
    /// server.ended();
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// As for the async call.
    pub fn serve<H, E>(&self, protocol: &str, handler: H) -> Result<Side<Server>, DialogueError>
    where
        H: Fn(Side<Task>) -> Result<Reply, E> + Send + Sync + 'static,
        E: Display + Send + 'static,
    {
        let handler = Arc::new(handler);
        let runtime = self.runtime.waiter.clone();
        let _context = self.runtime.enter();
        let server = self.agent.serve(protocol, move |task| {
            let (handler, side) = (Arc::clone(&handler), of_served(task, &runtime));
            async move {
                let runtime = Handle::current();
                match background::try_run(&runtime, move |_| handler(side)).await {
                    Ok(handled) => handled.map_err(|error| error.to_string()),
                    Err(error) => Err(error.to_string()),
                }
            }
        })?;
        Ok(self.side_of(server))
    }

    /// See [`crate::Agent::publisher`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn publisher(&self, topic: impl Into<Bytes>) -> Result<Side<Publisher>, DialogueError> {
        let _context = self.runtime.enter();
        Ok(self.side_of(self.agent.publisher(topic)?))
    }

    /// See [`crate::Agent::watch_partners`].
    pub fn watch_partners(&self) -> Side<PartnerWatch> {
        self.side_of(self.agent.watch_partners())
    }
}

/// Creates the side of a handler, which must not keep the runtime that it runs on.
fn of_served(task: Task, runtime: &Waiter) -> Side<Task> {
    Side {
        inner: task,
        runtime: runtime.clone(),
        _background: None,
    }
}

impl Side<Server> {
    /// See [`Server::ended`].
    pub fn ended(&mut self) {
        self.runtime.block_on(self.inner.ended());
    }
}

impl Side<Publisher> {
    /// See [`Publisher::publish`].
    pub fn publish(&self, content: impl Into<Bytes>) -> usize {
        self.runtime.block_on(self.inner.publish(content))
    }
}

impl Side<PartnerWatch> {
    /// See [`PartnerWatch::add`].
    pub fn add(&mut self, agent: &str) {
        self.inner.add(agent);
    }

    /// See [`PartnerWatch::remove`].
    pub fn remove(&mut self, agent: &str) {
        self.inner.remove(agent);
    }

    /// Waits up to `timeout` for the next event; see [`PartnerWatch::next`].
    pub fn next_within(&mut self, timeout: Duration) -> Option<PartnerEvent> {
        let inner = &mut self.inner;
        self.runtime
            .block_on(async { tokio::time::timeout(timeout, inner.next()).await.ok() })
    }
}

impl Side<Subscription> {
    /// Waits up to `timeout` for the next notification; returns `None` if none arrives. See
    /// [`Subscription::next`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn next_within(&mut self, timeout: Duration) -> Result<Option<Message>, DialogueError> {
        let inner = &mut self.inner;
        self.runtime.block_on(async {
            match tokio::time::timeout(timeout, inner.next()).await {
                Ok(received) => received.map(Some),
                Err(_) => Ok(None),
            }
        })
    }
}

/// Defines the blocking calls of one type, each with a link to the documentation of the async call.
macro_rules! blocking {
    ($side:ident: $(
        $(#[$kind:ident])? fn $name:ident($($argument:ident: $type:ty),*) -> $output:ty;
    )*) => {
        #[allow(clippy::should_implement_trait, reason = "unlike an iterator, it goes on after an error")]
        impl Side<$side> {
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
    fn cancel(timeout: Duration) -> bool;
}

blocking! { Subscription:
    fn next() -> Message;
    #[last] fn cancel(timeout: Duration) -> ();
}

blocking! { ContractNet:
    fn call_again(invited: &[Message], call: MessageBuilder, timeout: Duration) -> ();
    fn award(accepted: &[Message], content: &str, timeout: Duration) -> Vec<Awarded>;
    #[last] fn cancel(timeout: Duration) -> ();
}

blocking! { Auction:
    fn call(price: impl Into<Bytes>, timeout: Duration) -> Bids;
    fn accept(bid: &Message, content: impl Into<Bytes>) -> ();
    fn close(content: impl Into<Bytes>) -> ();
    #[last] fn ask_winner(content: impl Into<Bytes>) -> ();
}

blocking! { Proxied:
    fn next(timeout: Duration) -> Message;
    fn answer(
        to: &Message,
        act: Performative,
        content: impl Into<Bytes>,
        timeout: Duration
    ) -> ();
    #[last] fn cancel(timeout: Duration) -> ();
}

blocking! { Task:
    fn agree(content: impl Into<Bytes>) -> ();
    fn inform(content: impl Into<Bytes>) -> ();
    fn propose(content: impl Into<Bytes>, timeout: Duration) -> bool;
    fn next_call(timeout: Duration) -> Option<Message>;
    fn next(timeout: Duration) -> Message;
    fn pass_on(message: MessageBuilder, timeout: Duration) -> ();
    fn next_answer(timeout: Duration) -> Option<Message>;
    fn forward(answer: &Message) -> ();
    fn confirm_cancel() -> Reply;
    #[last] fn reply(reply: Reply) -> ();
}

impl Side<Task> {
    /// Waits up to `timeout` for a cancel of the initiator, and returns whether it came. For a
    /// participant that checks between two steps of its work; see [`Task::cancelled`].
    ///
    /// # Errors
    /// As for the async call.
    pub fn cancelled(&mut self, timeout: Duration) -> Result<bool, DialogueError> {
        self.runtime.block_on(async {
            match tokio::time::timeout(timeout, self.inner.cancelled()).await {
                Ok(cancelled) => cancelled.map(|()| true),
                Err(_) => Ok(false),
            }
        })
    }
}
