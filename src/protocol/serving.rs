//! Servers of a protocol: a handler per opening message.

use std::fmt::Display;
use std::sync::Arc;

use fipa_acl::{ErrorChain, Message, escape};
use fipa_transport::log_limit;
use parking_lot::Mutex;
use tokio::task::{JoinError, JoinHandle};

use super::dialogue::{DialogueError, opens};
use super::participant::{Farewell, Home, Reply, Task};
use crate::agent::demultiplexer::{Opens, Precedence};
use crate::agent::incoming::Incoming;
use crate::agent::reader_key::ReaderKey;
use crate::agent::{Agent, AgentCore};
use crate::protocol::peer_shares::PeerPlaces;

/// Maximum number of handlers of one server that run at the same time. One host alone gets a quarter of them. Further
/// initiators of a host that has its share are refused.
const MAX_HANDLERS: usize = 4_096;

impl Agent {
    /// Serves a protocol: each message that begins a conversation of it runs the handler, in a task of
    /// its own on the current tokio runtime. The handler returns the last message. An error becomes a
    /// `failure` with the text of the error, or a `not-understood` if the handler has sent nothing.
    ///
    /// Conversations about the actions and topics of the agent go to those, and not to the handler.
    ///
    /// Messages that have arrived before this call and that the application has not received go to the handler, too,
    /// however old they are.
    ///
    /// The other messages go to [`receive`](Self::receive). If the application never calls `receive`,
    /// the earliest of 1,024 unread messages is dropped, with a warning in the log.
    ///
    /// ```no_run
    /// use fipa::protocol::{DialogueError, Reply, Task};
    ///
    /// async fn lift(mut task: Task) -> Result<Reply, DialogueError> {
    ///     if task.message().content().is_none() {
    ///         return Ok(Reply::Refuse("lift what?".into()));
    ///     }
    ///     task.agree("").await?;
    ///     Ok(Reply::Inform("done".into()))
    /// }
    ///
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// let mut server = agent.serve("fipa-request", lift)?;
    /// server.ended().await;
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// If the protocol is unknown.
    pub fn serve<H, F, E>(&self, protocol: &str, handler: H) -> Result<Server, DialogueError>
    where
        H: Fn(Task) -> F + Send + Sync + 'static,
        F: Future<Output = Result<Reply, E>> + Send + 'static,
        E: Display + Send + 'static,
    {
        let all = Precedence::Protocol;
        start(&self.core, protocol, |_| true, all, handler)
    }
}

/// Serves the conversations of a protocol whose first message meets a condition; see [`Agent::serve`].
pub(crate) fn serve_those<H, F, E>(
    core: &Arc<AgentCore>,
    protocol: &str,
    also: impl Fn(&Message) -> bool + Send + Sync + 'static,
    handler: H,
) -> Result<Server, DialogueError>
where
    H: Fn(Task) -> F + Send + Sync + 'static,
    F: Future<Output = Result<Reply, E>> + Send + 'static,
    E: Display + Send + 'static,
{
    start(core, protocol, also, Precedence::Part, handler)
}

fn start<H, F, E>(
    core: &Arc<AgentCore>,
    protocol: &str,
    also: impl Fn(&Message) -> bool + Send + Sync + 'static,
    precedence: Precedence,
    handler: H,
) -> Result<Server, DialogueError>
where
    H: Fn(Task) -> F + Send + Sync + 'static,
    F: Future<Output = Result<Reply, E>> + Send + 'static,
    E: Display + Send + 'static,
{
    let opens = opening(core, protocol, also)?;
    let runtime = &core.endpoint.domain.inner.service.runtime;
    let running = PeerPlaces::new(MAX_HANDLERS);
    let queue = ServedQueue::new(core, opens, precedence);
    let run = run(queue, handler, running.clone());
    Ok(Server {
        task: runtime.spawn(run),
        running,
    })
}

/// A running server; see [`Agent::serve`]. Dropping it ends the acceptance of further conversations.
/// Running handlers continue.
#[derive(Debug)]
#[must_use = "dropping the server ends it"]
pub struct Server {
    task: JoinHandle<()>,
    running: PeerPlaces,
}

impl Server {
    /// Returns the number of running handlers.
    #[must_use]
    pub fn running(&self) -> usize {
        self.running.taken()
    }

    /// Waits until the agent is deregistered or the domain is closed.
    pub async fn ended(&mut self) {
        // The task cannot panic, and only dropping the server aborts it.
        let _ = (&mut self.task).await;
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The messages that begin a conversation of one protocol. Dropping it ends the server.
pub(crate) struct ServedQueue {
    core: Arc<AgentCore>,
    key: ReaderKey,
}

impl ServedQueue {
    pub(crate) fn new(core: &Arc<AgentCore>, opens: Opens, precedence: Precedence) -> Self {
        Self {
            key: core.demultiplexer.serve(opens, precedence),
            core: Arc::clone(core),
        }
    }

    pub(crate) fn agent(&self) -> &Arc<AgentCore> {
        &self.core
    }

    /// Waits for the next message. Returns `None` if the agent receives no further messages.
    pub(crate) async fn next(&self) -> Option<Incoming> {
        let endpoint = &self.core.endpoint;
        let next = self.core.demultiplexer.next_served(endpoint, &self.key);
        next.await.ok()
    }
}

impl Drop for ServedQueue {
    fn drop(&mut self) {
        self.core.demultiplexer.end_serving(&self.key);
    }
}

/// Decides whether a message begins a conversation of this protocol, for a server.
pub(crate) fn opening(
    core: &AgentCore,
    protocol: &str,
    also: impl Fn(&Message) -> bool + Send + Sync + 'static,
) -> Result<Opens, DialogueError> {
    let library = Arc::clone(core.endpoint.domain.inner.rules.library());
    let machine = library.find(protocol);
    let machine = machine.ok_or(DialogueError::Unchecked(
        fipa_monitor::Unchecked::UnknownProtocol,
    ))?;
    let name = machine.name().to_owned();
    let agent = Arc::clone(&core.endpoint.name);
    Ok(Box::new(move |message| {
        let called = message.protocol().and_then(|name| library.find(name));
        called.is_some_and(|machine| machine.name() == name)
            && also(message)
            && opens(&library, &agent, message)
    }))
}

async fn run<H, F, E>(queue: ServedQueue, handler: H, places: PeerPlaces)
where
    H: Fn(Task) -> F + Send + Sync + 'static,
    F: Future<Output = Result<Reply, E>> + Send + 'static,
    E: Display + Send + 'static,
{
    while let Some(first) = queue.next().await {
        let Some(place) = places.take(first.peer()) else {
            refuse(queue.agent(), &first, "busy");
            continue;
        };
        let home: Home = Arc::new(Mutex::new(None));
        let task = match Task::join(queue.agent(), &first, Some(Arc::clone(&home))) {
            Ok(task) => task,
            Err(error) => {
                log_limit::warn!(error = %ErrorChain(&error), "cannot take part in a conversation");
                continue;
            }
        };
        let handled = tokio::spawn(handler(task));
        tokio::spawn(async move {
            let handled = handled.await;
            // The handler may have sent the last message by itself.
            let farewell = home.lock().take();
            finish(farewell, handled).await;
            drop(place);
        });
    }
}

/// Refuses a conversation that this message begins.
pub(crate) fn refuse(core: &Arc<AgentCore>, first: &Incoming, reason: &str) {
    let home: Home = Arc::new(Mutex::new(None));
    match Task::join(core, first, Some(Arc::clone(&home))) {
        Ok(task) => drop(task),
        Err(error) => tracing::debug!(error = %ErrorChain(&error), "cannot refuse a conversation"),
    }
    let farewell = home.lock().take();
    if let Some(farewell) = farewell {
        farewell.refuse(reason);
    }
}

/// Sends the result of a handler to the initiator.
async fn finish<E: Display>(
    farewell: Option<Farewell>,
    handled: Result<Result<Reply, E>, JoinError>,
) {
    let failed = match handled {
        Ok(Ok(reply)) => match farewell {
            Some(farewell) => farewell.reply(reply).await.err().map(|it| it.to_string()),
            None => None,
        },
        Ok(Err(error)) => {
            let reason = error.to_string();
            if let Some(farewell) = farewell {
                farewell.fail(&reason);
            }
            Some(reason)
        }
        Err(error) => {
            if let Some(farewell) = farewell {
                farewell.fail("the handler of the participant has ended unexpectedly");
            }
            Some(error.to_string())
        }
    };
    if let Some(error) = failed {
        log_limit::warn!(error = %escape(&error), "the handler of a conversation failed");
    }
}
